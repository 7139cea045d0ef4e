"""Jumps of the acceleration that a motion of diffrax crosses: derivatives over its steps are wrong there.

A border u(y, t, p) = 0 at which the acceleration jumps from a⁻ to a⁺ adds (a⁻ − a⁺) δt to a tangent of the velocities,
with δt = −δu / u̇ (`_program._jump`). Steps of diffrax go across it and lack that: the derivative is not
inaccurate but another one. Where only the slope of the acceleration changes nothing is added to first derivatives, and
those over steps are right to their tolerance; nor where u depends on the time alone, for then δu = 0.

So every step that was taken is searched for a jump: on the straight line between its ends the half with the larger
change of the acceleration is halved again and again. What is smooth, or has a kink, changes by less and less. Beside a
jump that is found, the state or the parameters are moved a little, to see whether it moves with them.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from lagjax._equations import Motion
from lagjax._interface import halves
from lagjax._program import OPERATIONS

# On double numbers a bracket is 1e-9 of a step after 30 halvings, and 1e-6 of the largest acceleration is a jump: what
# is smooth would have to change a thousandfold within the step. On single numbers 14 halvings leave 6e-5 of a step.
_HALVINGS = {np.dtype("float64"): 30, np.dtype("float32"): 14}
_JUMPS = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-2}
# How far a state or parameters are moved, of themselves: much more than a bracket, much less than what matters.
_MOVED = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
_DRAWS = 2  # directions in which they are moved; along one the border may lie
_DECIDING = frozenset((
    *(name for name, row in OPERATIONS.items() if row.side is not None), "argmax", "argmin", "clamp", "reduce_max",
    "reduce_min", "scan", "while", "cond", "sort", "lagjax_locate",
))  # fmt: skip


def stop_derivatives(tree):
    """The pytree with `stop_gradient` of all its arrays."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def may_jump(motion: Motion, t, y, params) -> bool:
    """True if F or γ contain a decision (a comparison, |x|, sign, …); those of eliminations leave q̈ smooth."""
    parts = [motion.force, *([motion.constraints.gamma] if motion.constrained else [])]
    return any(_makes_decisions(jax.make_jaxpr(part)(*halves(y), t, params).jaxpr) for part in parts)


def _makes_decisions(jaxpr) -> bool:
    decides = any(equation.primitive.name in _DECIDING for equation in jaxpr.eqns)
    return decides or any(map(_makes_decisions, core.subjaxprs(jaxpr)))


def crosses_jump(field, varied, begin, end, params) -> jax.Array:
    """True if the step between two pairs (t, y) crosses a jump of the field that moves with the state or `varied`.

    `field(t, y, params)` is ẏ (2n,) of y = (q, q̇); `varied` a pair like (field, params), of Booleans.
    """
    (t0, y0), (t1, y1), dtype = begin, end, begin[1].dtype
    n = y0.size // 2

    def acceleration_at(s):
        return field(t0 + s * (t1 - t0), y0 + s * (y1 - y0), params)[n:]

    def halve(_, bracket):
        low, high, of_low, of_high = bracket
        middle = 0.5 * (low + high)
        of_middle = acceleration_at(middle)
        first = jnp.abs(of_middle - of_low).max() >= jnp.abs(of_high - of_middle).max()
        earlier, later = (low, middle, of_low, of_middle), (middle, high, of_middle, of_high)
        return jax.tree.map(lambda a, b: jnp.where(first, a, b), earlier, later)

    # XLA compiles each call of the field anew: there is one for both ends, one inside, and one for all states beside.
    ends = jnp.array([0, 1], dtype)
    whole = (*ends, *jax.lax.map(acceleration_at, ends))
    low, _, of_low, of_high = jax.lax.fori_loop(0, _HALVINGS[dtype], halve, whole)
    change = jnp.abs(of_high - of_low).max()
    jumps = change > _JUMPS[dtype] * jnp.maximum(jnp.abs(whole[2]), jnp.abs(whole[3])).max()
    t, y = t0 + low * (t1 - t0), y0 + low * (y1 - y0)
    size = _MOVED[dtype] * (jnp.abs(y0) + jnp.abs(y1 - y0) + 1e-3 * jnp.abs(y0).max())
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_DRAWS, y0.size))

    def accelerate_nearby(at):
        signs, by = at
        other, numbers = _perturb((field, params), varied, by)
        return other(t, y + signs * size, numbers)[n:]

    signs = jnp.asarray(np.concatenate([signs, -signs, np.zeros((2, y0.size))]), dtype)
    by = jnp.asarray([*[0.0] * 2 * _DRAWS, _MOVED[dtype], -_MOVED[dtype]], dtype)
    around = jax.lax.map(accelerate_nearby, (signs, by))
    return jumps & (jnp.abs(around - of_low).max(axis=1) > 0.5 * change).any()


def _perturb(tree, varied, by):
    """The pytree with each float of the leaves `varied` changed by `by` times a factor of its own."""
    draws = np.random.default_rng(1)

    def move(leaf, moves):
        if not (moves and eqx.is_inexact_array(leaf)):
            return leaf
        factors = draws.choice([-1.0, 1.0], np.shape(leaf)) * draws.uniform(0.5, 1.0, np.shape(leaf))
        return leaf * (1 + by * jnp.asarray(factors, leaf.dtype))

    return jax.tree.map(move, tree, varied)


class AdaptiveWrapper(diffrax.AbstractAdaptiveStepSizeController):
    """A controller of adaptive steps around another one, whose tolerances it has."""

    controller: eqx.AbstractVar[Any]

    @property
    def rtol(self):
        return self.controller.rtol

    @property
    def atol(self):
        return self.controller.atol

    @property
    def norm(self):
        return self.controller.norm


class JumpRecorder(diffrax.AbstractStepSizeController):
    """A step-size controller whose state also has a flag: an accepted step crossed a jump of the acceleration."""

    controller: Any
    field: Any
    varied: Any  # as for `crosses_jump`
    direction: Any = 1  # or −1, the sign of the time of diffrax, which integrates forward

    def wrap(self, direction):
        return type(self)(self.controller.wrap(direction), self.field, self.varied, direction)

    def init(self, *arguments):
        end, state = self.controller.init(*arguments)
        return end, (state, jnp.array(False))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        state, crossed = controller_state
        keep, *more, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        field, *step = stop_derivatives(
            (self.field, (t0 * self.direction, y0), (t1 * self.direction, y1_candidate), args)
        )
        here = keep & crosses_jump(field, self.varied, *step)
        return keep, *more, (state, crossed | here), result


class AdaptiveRecorder(JumpRecorder, AdaptiveWrapper):
    """`JumpRecorder` of a controller whose steps adapt."""
