"""`CheckedScene`: the values and derivatives of a scene at a state and around it, from which `check` finds its results.

A `Sample` evaluates the scene: by its programs in NumPy, which compiles nothing, or else compiled by XLA.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._equations import Derivation, Motion, Sample, Scales, augment, derivation_of, numbers_of, saddle_many
from lagjax._interface import Layout, as_arrays
from lagjax._program import Unlowerable
from lagjax._scene import System
from lagjax._trust.checks._differences import step_ladder

_NEARBY = 4  # states with different positions, and as many with different velocities


class CheckedScene(NamedTuple):
    """A scene at a state, and the quantities evaluated there. All arrays are flat: n coordinates, m constraints."""

    system: System
    layout: Layout
    arguments: tuple  # q, qdot, t, params in the user's pytrees
    state: tuple  # q, q̇, t and the numbers in params
    sample: Sample  # the state, alone
    sizes: np.ndarray  # of q, then of q̇, and of the time along the motion
    steps: np.ndarray  # of the differences, (rungs, 2n + 1), along the same directions
    measured: "Measured"

    @classmethod
    def from_state(cls, system: System, layout: Layout, q, qdot, t, params) -> "CheckedScene":
        q, qdot, t, params = as_arrays((q, qdot, 1.0 * t, params), layout.dtype)
        state = layout.flatten(q), layout.flatten(qdot), jnp.asarray(t), eqx.filter(params, eqx.is_array_like)
        flat = [np.asarray(x) for x in state[:3]]
        here = Sample.from_scene(system, layout, flat[0][None], flat[1][None], flat[2], params)
        scales = _state_scales(here)
        sizes = _input_sizes(q, qdot, scales)
        steps, offsets = step_ladder(sizes, layout.dtype), _nearby_offsets(sizes, scales, layout.dtype)
        return cls(system, layout, (q, qdot, t, params), state, here, sizes, steps, _measure_states(here, offsets))

    @property
    def derivation(self) -> Derivation:
        return self.sample.derivation

    @property
    def motion(self):
        return self.derivation.motion

    @property
    def written_motion(self) -> Motion:
        """The equations with the functions of this very system; `derivation` may be of another with the same text."""
        return self.system._motion(self.layout, self.arguments[3])

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the 2n + 1 directions of differences: coordinates, velocities, and along the motion."""
        names = self.layout.names
        return (*names, *(f"d{name}" for name in names), "the motion")

    def sides(self) -> "Sides":
        """Return the outputs on both sides of the state, along every coordinate, velocity and the motion."""
        minus, plus = self.displaced_outputs()
        one, here = self.sample, self.measured
        drift = {
            "lagrangian_by_q": here.by_q, "given_force": here.extra,
            "dissipation_by_qdot": here.by_v_of_dissipation, "force": here.force,
        }  # fmt: skip
        if not self.derivation.is_lowered:
            by_v = here.by_v_of_dissipation
            of_terms = (here.by_q,), (here.momentum[0],), (here.mass[0],), drift.values(), (by_v,), (here.jacobian[0],)
            return Sides(minus, plus, np.zeros_like(here.here), tuple(_rounding(*terms) for terms in of_terms))
        noise = np.concatenate([value[0].ravel() for value in one.round_off(*_COMPARED).values()])
        lost = {name: value[0] for name, value in one.round_off(*_DERIVED).items()}
        of_drift = sum(lost[name] + np.finfo(self.layout.dtype).eps * abs(value) for name, value in drift.items())
        round_off = (
            lost["lagrangian_by_q"], lost["momentum"], lost["mass_matrix"], of_drift, lost["dissipation_by_qdot"],
            lost["jacobian"],
        )  # fmt: skip
        return Sides(minus, plus, noise, round_off)

    def displaced_outputs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the outputs of `Measured.here` at steps back and ahead, (2n + 1, rungs, outputs) each."""
        here, n, steps = self.point, self.layout.size, self.steps
        axes = np.eye(2 * n + 1, dtype=here.dtype)
        axes[-1, :n] = here[n:-1]
        moves = np.stack([-steps, steps]).transpose(2, 0, 1)[..., None] * axes[:, None, None]
        along = (here + moves).reshape(-1, 2 * n + 1).astype(here.dtype)
        sides = self.sample_at(along).flat(*_COMPARED).reshape(len(axes), 2, len(steps), -1)
        return sides[:, 0], sides[:, 1]

    @property
    def point(self) -> np.ndarray:
        """(q, q̇, t), (2n + 1,)."""
        return np.concatenate([np.ravel(x) for x in self.state[:3]])

    def sample_at(self, points: np.ndarray) -> Sample:
        """Return a `Sample` at S other points (q, q̇, t), (S, 2n + 1)."""
        n = self.layout.size
        return self.sample._replace(q=points[:, :n], qdot=points[:, n:-1], t=points[:, -1])

    @property
    def is_large(self) -> bool:
        """True if M and G are known only by products: `Measured` has their products with one vector, (…, 1)."""
        return self.derivation.form.is_sparse

    def line(self, direction: np.ndarray, steps: np.ndarray) -> "LineValues":
        """Return the scene's quantities at `steps` along a `direction` (2n + 1,): q, q̇ and the motion."""
        n, m, here = self.layout.size, self.measured, self.point
        moved = direction + direction[-1] * np.concatenate([here[n:-1], np.zeros(n + 1)])
        q, qdot, t, params = self.arguments
        line = LineValues(*_sum_weighted_outputs(self.system, q, qdot, t, params, moved.astype(here.dtype), steps))
        far, fast = np.abs(here[:n]), np.abs(here[n:-1])
        of_l = far @ np.abs(m.by_q) + fast @ np.abs(m.momentum[0])
        terms = line.terms + np.array([of_l, 0.0, fast @ np.abs(m.by_v_of_dissipation), 0.0, 0.0])
        return LineValues(*(np.asarray(x, float) for x in line._replace(terms=terms)))

    @property
    def lagrangian(self) -> np.ndarray:
        return self.measured.here[0]

    @property
    def dissipation(self) -> np.ndarray:
        return self.measured.here[1 + self.layout.size] if self.motion.dissipation is not None else np.zeros(())

    @property
    def residual(self) -> np.ndarray:
        """f, then a, at the state, (m,)."""
        count = self.measured.jacobian.shape[1]
        return self.measured.here[len(self.measured.here) - count :]

    @property
    def drift(self) -> np.ndarray:
        """(∂p/∂q) q̇ + ∂p/∂t at the state, (n,)."""
        m = self.measured
        return m.by_q + m.extra - m.by_v_of_dissipation - m.force

    @property
    def augmented(self) -> np.ndarray:
        """The augmented matrix K = M + GᵀW G (see `_linear`) of every state, (states, n, n); M without constraints."""
        return augment(self.measured.mass, self.measured.jacobian)[0]

    def solve_saddle(self) -> tuple[np.ndarray, np.ndarray]:
        """Return q̈ (n,) and λ (m,) at the state; of a large scene λ is empty."""
        m, n = self.measured, self.layout.size
        if m.acceleration is not None:
            return m.acceleration, np.zeros(0)
        x = self._solve_saddle(np.concatenate([m.force, m.gamma])[:, None])[:, 0]
        return x[:n], x[n:]

    def jacobian(self) -> np.ndarray:
        """Return ∂q̈/∂(q, q̇) at the state, (n, 2n), by the implicit function theorem; without programs, by JAX."""
        try:
            varied = _program_variation(self.derivation, self.state, *self.solve_saddle())
        except Unlowerable:
            return np.concatenate(_acceleration_slopes(self.system, *self.arguments), axis=1)
        return self._solve_saddle(-varied)[: self.layout.size]

    def _solve_saddle(self, b: np.ndarray) -> np.ndarray:
        """Solve M q̈ − Gᵀλ = b₁, G q̈ = b₂ for columns b (n + m, k): (q̈, λ), NaN if singular."""
        above, below = np.split(b[None], [self.layout.size], axis=1)
        return np.concatenate(saddle_many(self.measured.mass[:1], above, self.measured.jacobian[:1], below), axis=1)[0]


class Measured(NamedTuple):
    """Quantities at the state and nearby. A first axis of states has the state, then others in q, then in q̇."""

    by_q: Any  # ∂L/∂q, (n,)
    force: Any  # F = M q̈ − Gᵀλ, (n,)
    extra: Any  # the user's forces, (n,)
    by_v_of_dissipation: Any  # ∂D/∂q̇, (n,)
    gamma: Any  # γ of G q̈ = γ, (m,)
    momentum: Any  # (states, n)
    mass: Any  # (states, n, n)
    jacobian: Any  # G, (states, m, n)
    velocity: Any  # (states, n)
    power: Any  # Σ q̇ᵢ ∂D/∂q̇ᵢ, which D takes out of the motion, and Σ |q̇ᵢ ∂D/∂q̇ᵢ|, (states, 2)
    here: Any  # the outputs L, p, D (if there is one), f and a at the state, (outputs,)
    acceleration: Any = None  # q̈ of a large scene, (n,)


class LineValues(NamedTuple):
    """Weighted sums of each of L, p, D, f and a, (5,), along a line through the state."""

    here: Any
    terms: Any  # the sum of the sizes of what they consist of
    derivative: Any  # by automatic differentiation; of D by q̇ alone
    minus: Any  # at steps back, (rungs, 5)
    plus: Any  # at steps ahead, (rungs, 5)


class Sides(NamedTuple):
    """Outputs of `Measured.here` on both sides of the state, for finite differences, and their rounding errors."""

    minus: Any  # at steps back, (directions, rungs, outputs)
    plus: Any  # at steps ahead, (directions, rungs, outputs)
    noise: Any  # how far rounding may move `here`, (outputs,)
    round_off: Any  # how far it may move by_q, momentum, mass, drift, by_v_of_dissipation and the rows of G, each alike


def _state_scales(here: Sample) -> Scales:
    """Return the scales of coordinates, velocities and time at a state; 1 where the scene determines none."""
    q, v, t = (np.asarray(x, np.float64) for x in (here.q[0], here.qdot[0], here.t))

    def evaluated(name, q, v):
        return here._replace(q=q, qdot=v, t=t, scene=None).quantities(name)[name]

    try:
        scales = Scales.from_quantities(evaluated, q, v)
    except Unlowerable:
        scales = Scales(np.abs(q), np.abs(v), 1.0)
    return scales._replace(**{name: np.where(np.isfinite(x) & (x > 0), x, 1.0) for name, x in scales._asdict().items()})


def _input_sizes(q: PyTree, qdot: PyTree, scales: Scales) -> np.ndarray:
    """Return the size of every coordinate, of every velocity, and of the time along the motion, (2n + 1,).

    The size of a coordinate is its absolute value; if that is zero, the largest in its array, or its scale. One that is
    tiny beside the others (an angle that was projected to 1e-20) counts as a thousandth of that scale. The size of the
    time is the time in which the fastest coordinate moves by its size, or its scale if that is shorter.
    """

    def sizes_of(tree, scale):
        leaves = [np.abs(np.ravel(np.asarray(leaf, np.float64))) for leaf in jax.tree.leaves(tree)]
        largest = np.concatenate([np.full(x.size, x.max(initial=0.0)) for x in leaves])
        own = np.concatenate(leaves)
        return np.maximum(np.where(own > 0, own, np.where(largest > 0, largest, scale)), 1e-3 * scale)

    of_q, of_v = sizes_of(q, scales.q), sizes_of(qdot, scales.qdot)
    speed = np.abs(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(qdot)]))
    time = np.min(of_q / np.where(speed > 0, speed, np.inf), where=speed > 0, initial=float(scales.t))
    return np.concatenate([of_q, of_v, [time]])


def _nearby_offsets(sizes: np.ndarray, scales: Scales, dtype) -> np.ndarray:
    """Return offsets (1 + 2 · _NEARBY, 2n) from the state: zero, then random ones in q alone, then in q̇ alone."""
    # Their deviation is a tenth of the sizes. A coordinate that is small beside the others moves by a tenth of its
    # scale: it may be next to where the chart is singular, and has to leave that.
    n = len(scales.q)
    sizes = np.concatenate([np.maximum(sizes[:n], scales.q), sizes[n:-1]])
    moved = 0.1 * np.random.default_rng(0).standard_normal((2 * _NEARBY, 2 * n)) * sizes
    moved[:_NEARBY, n:] = 0
    moved[_NEARBY:, :n] = 0
    return np.concatenate([np.zeros((1, 2 * n)), moved]).astype(dtype)


_COMPARED = ("lagrangian", "momentum", "dissipation", "residual")
_AT_STATE = ("lagrangian_by_q", "force", "given_force", "dissipation_by_qdot", "gamma")
_MATRICES = ("mass_matrix", "jacobian")
_PRODUCTS = ("mass_by_some", "jacobian_by_some", "acceleration")  # in the place of M and G
_DERIVED = ("lagrangian_by_q", "momentum", "mass_matrix", "given_force", "dissipation_by_qdot", "force", "jacobian")


def _measure_states(here: Sample, offsets: np.ndarray) -> Measured:
    """Evaluate the quantities at the state and at `offsets` (states, 2n) from it."""
    n = here.derivation.layout.size
    velocity = here.qdot + offsets[:, n:]
    near = here._replace(q=here.q + offsets[:, :n], qdot=velocity)
    acceleration, power = None, np.zeros((len(offsets), 2))
    large = here.derivation.form.is_sparse
    of = near.quantities("momentum", *_AT_STATE, *(_PRODUCTS if large else _MATRICES))
    if large:
        acceleration = of["acceleration"][0]
        of |= {"mass_matrix": of["mass_by_some"][..., None], "jacobian": of["jacobian_by_some"][..., None]}
    if here.derivation.motion.dissipation is not None:
        damping = near._replace(q=here.q + 0 * offsets[:, :n]).quantities("dissipation_by_qdot")
        terms = damping["dissipation_by_qdot"] * velocity
        power = np.stack([terms.sum(axis=1), np.abs(terms).sum(axis=1)], axis=1)
    at_state, near_it = (of[name][0] for name in _AT_STATE), (of[name] for name in ("momentum", *_MATRICES))
    return Measured._make([*at_state, *near_it, velocity, power, here.flat(*_COMPARED)[0], acceleration])


@eqx.filter_jit
def _sum_weighted_outputs(system: System, q, qdot, t, params, direction, steps):
    """Return the weighted sums `LineValues` at `steps` along a `direction` (2n + 1,), by JAX."""
    layout = Layout.from_state(q, qdot)
    motion, n = derivation_of(system, layout, params).motion, layout.size
    numbers, along = eqx.filter(params, eqx.is_array_like), (direction[:n], direction[n:-1], direction[-1])
    state, constraints = (layout.flatten(q), layout.flatten(qdot), t), motion.constraints

    def dissipation(*state):
        return jnp.zeros_like(direction[0]) if motion.dissipation is None else motion.dissipation(*state, numbers)

    def outputs(q, v, t, size=lambda x: x):
        of_l, p = (function(q, v, t, numbers) for function in (motion.lagrangian, motion.momentum))
        parts = of_l, p, dissipation(q, v, t), constraints.f(q, t, numbers), constraints.a(q, v, t, numbers)
        weighted = [jnp.ravel(x) * jnp.cos(jnp.arange(1.0 * jnp.size(x))) for x in parts]  # which nothing cancels
        return jnp.stack([jnp.sum(size(x)) for x in weighted])

    def moved(step):
        return outputs(*(x + step * d for x, d in zip(state, along, strict=True)))

    here, derivative = jax.jvp(outputs, state, along)
    of_d = jax.jvp(lambda v: dissipation(state[0], v, t), (state[1],), (along[1],))[1]
    sides = (jax.lax.map(moved, sign * steps) for sign in (-1, 1))
    return here, outputs(*state, size=jnp.abs), derivative.at[2].set(of_d), *sides


def _program_variation(derivation: Derivation, state, acceleration, multipliers) -> np.ndarray:
    """Return ∂(M q̈ − Gᵀλ − F, G q̈ − γ)/∂(q, q̇), (n + m, 2n), at constant q̈ and λ, by scalar programs."""
    # It is one transposed derivative of the program of M, F, G and γ, for all n + m equations side by side.
    q, v, t, numbers = *map(np.asarray, state[:3]), numbers_of(state[3])
    n, m = len(q), len(multipliers)
    unit = np.eye(n + m, dtype=q.dtype)
    program = derivation.program("mass_matrix", "jacobian", "force", "gamma")
    # Numbers that do not vary, most of a large mass matrix, have no use for a cotangent of n + m numbers.
    varies = iter([program.constant(k) is None for k in range(n * n + m * n)])
    cotangents: list = [unit[i] * acceleration[j] if next(varies) else None for i in range(n) for j in range(n)]
    cotangents += [
        unit[n + k] * acceleration[i] - unit[i] * multipliers[k] if next(varies) else None
        for k in range(m)
        for i in range(n)
    ]
    cotangents += [-unit[i] for i in range(n + m)]
    derivatives = program.line.vjp([*q, *v, t, *numbers], cotangents)[: 2 * n]
    return np.stack([np.zeros(n + m) if bar is None else np.broadcast_to(bar, n + m) for bar in derivatives], axis=1)


def _rounding(*terms):
    """Return the rounding error of derivatives, like `terms[0]`: four round-offs of the sum of the largest terms."""
    size = sum(np.max(np.abs(term), initial=0.0) for term in terms)
    return np.full(terms[0].shape, 4 * np.finfo(terms[0].dtype).eps * size)


@eqx.filter_jit
def _acceleration_slopes(system: System, q, qdot, t, params):
    """Return ∂q̈/∂q and ∂q̈/∂q̇, (n, n) each."""
    layout, numbers = Layout.from_state(q, qdot), eqx.filter(params, eqx.is_array_like)
    state = layout.flatten(q), layout.flatten(qdot), t, numbers
    return jax.jacfwd(system._motion(layout, params).acceleration, argnums=(0, 1))(*state)
