"""The coordinates along which a scene looks the same at every place, also where velocities have to turn with them.

Coordinate i is cyclic if a matrix Ω of the velocities of the others, which nothing reads, leaves all as it is,

    ∂L/∂qᵢ + p·Ωq̇ = 0,   ∂Q/∂qᵢ + (∂Q/∂q̇) Ωq̇ + ΩᵀQ = 0,   ∂f/∂qᵢ = 0,   ∂a/∂qᵢ + (∂a/∂q̇) Ωq̇ = 0 where a = 0

Ω is zero for the angle of a wheel and for the place of its contact; with its yaw the velocity of that place turns. The
equations are linear in Ω. They are tested at random states, as they hold everywhere or nowhere.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax._analysis._scene_state import SceneState
from lagjax._equations import decide
from lagjax._interface import Layout, compile_for_one_call, is_concrete
from lagjax._scene import System

PyTree = Any

# States, beside two for each number of Ω; what rounding leaves of terms that cancel; and the numbers of Ω up to which
# it is sought: of more coordinates that nothing reads only those turn that constraints on velocities hold.
_STATES, _CANCELS, _MOST_TURNING = 8, 1e-9, 144


class SteadySymmetries(NamedTuple):
    """The cyclic coordinates, and for each coordinate the matrix Ω of velocities that turn with it."""

    cyclic: Bool[Array, " n"]
    turns: Float[Array, "n n n"]

    def rotation(self, qdot: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Σ q̇ᵢ Ωᵢ: velocities of a steady motion change by it, as fast as the scene turns."""
        return jnp.einsum("i,ijk->jk", jnp.where(self.cyclic, qdot, 0), jnp.asarray(self.turns, qdot.dtype))


def find_symmetries(scene: SceneState) -> SteadySymmetries:
    """The symmetries about the state of a scene; where its numbers are traced, about random ones."""
    n, random = scene.layout.size, np.random.default_rng(2)
    numbers = jax.tree.map(
        lambda x: x if is_concrete(x) else random.uniform(0.3, 1.2, x.shape).astype(x.dtype), scene.params
    )
    known = scene.concrete
    q, of_q, of_v = (np.asarray(scene.q), *scene.scales[:2]) if known else (np.ones(n), 0.5 * np.ones(n), np.ones(n))
    count = _STATES + 2 * min(n * n, _MOST_TURNING)
    draws = random.uniform(-1, 1, (2, count, n))
    states = np.asarray(q + 0.5 * of_q * draws[0], q.dtype), np.asarray(of_v * draws[1], q.dtype)
    arguments = scene.system, scene.layout, numbers
    with jax.ensure_compile_time_eval():
        values = [np.asarray(x) for x in _derivatives(*states, *arguments)]
        # One step arrives: a is affine in q̇, as d'Alembert's principle takes it.
        consistent = states[1]
        if values[-2].size:
            consistent = consistent - decide(np.nan_to_num(values[-1]), _CANCELS).least_norm(values[-2])
        of_rates = [np.asarray(x) for x in _derivatives(states[0], consistent, *arguments)[-3:]]
    values = [states[1], *values[:-3], consistent, of_rates[0], of_rates[2]]
    well = np.logical_and.reduce([np.isfinite(x).reshape(count, -1).all(axis=1) for x in values])
    if well.sum() < _STATES:
        raise ValueError(
            "The Lagrangian, a force or a constraint, or a derivative of it, is not finite at most states about "
            "(q, qdot): give a state in the middle of where motions take place."
        )
    return _solve_identities(*(x[well] for x in values))


@compile_for_one_call
def _derivatives(q: Array, qdot: Array, system: System, layout: Layout, params: PyTree) -> tuple:
    """∂L/∂q, p, Q, ∂Q/∂q, ∂Q/∂q̇, ∂f/∂q, ∂a/∂q, a and ∂a/∂q̇ at S states."""
    motion, numbers = system._motion(layout, params), eqx.filter(params, eqx.is_array_like)

    def derivatives(q, qdot):
        state = q, qdot, jnp.zeros((), q.dtype), numbers
        by_q, momentum = jax.grad(motion.lagrangian, argnums=(0, 1))(*state)
        of_force = jax.jacfwd(motion.nonconservative_force, argnums=(0, 1))(*state)
        by_place = jax.jacfwd(motion.constraints.f)(q, *state[2:])
        by_q_of_a, by_qdot_of_a = jax.jacfwd(motion.constraints.a, argnums=(0, 1))(*state)
        of_a = by_q_of_a, motion.constraints.a(*state), by_qdot_of_a
        return by_q, momentum, motion.nonconservative_force(*state), *of_force, by_place, *of_a

    return jax.vmap(derivatives)(q, qdot)


def _solve_identities(qdot, by_q, momentum, force, force_by_q, force_by_v, by_place, consistent, rate_by_q, rate_by_v):
    """The symmetries by the derivatives at S states."""
    n = qdot.shape[1]
    right = [x.reshape(-1, n) for x in (by_q, force_by_q, by_place, rate_by_q)]
    unread = np.logical_and.reduce([(x == 0).all(axis=0) for x in right])
    if unread.sum() ** 2 > _MOST_TURNING:
        unread = unread & (rate_by_v != 0).any(axis=(0, 1))
    among = np.flatnonzero(unread) if unread.sum() ** 2 <= _MOST_TURNING else np.zeros(0, int)
    of_l = momentum[:, among, None] * qdot[:, None, among]
    of_force = force_by_v[:, :, among, None] * qdot[:, None, None, among]
    of_force = of_force + force[:, None, among, None] * np.eye(n)[:, None, among]
    of_rates = rate_by_v[:, :, among, None] * consistent[:, None, None, among]
    of_place = np.zeros((by_place[..., 0].size, len(among) ** 2))
    left = [x.reshape(-1, len(among) ** 2) for x in (of_l, of_force, of_place, of_rates)]
    left, right = np.concatenate(left), -np.concatenate(right)
    sizes = np.maximum(np.abs(left).max(axis=1, initial=0), np.abs(right).max(axis=1))
    left, right = (x[sizes > 0] / sizes[sizes > 0, None] for x in (left, right))
    found = np.linalg.lstsq(left, right, rcond=_CANCELS)[0] if left.size else np.zeros((len(among) ** 2, n))
    cyclic = np.abs(left @ found - right).max(axis=0, initial=0) <= _CANCELS**0.75
    turns = np.zeros((n, n, n))
    turns[np.ix_(np.arange(n), among, among)] = (cyclic * found).T.reshape(n, len(among), len(among))
    turns[np.abs(turns) <= _CANCELS**0.75 * np.abs(turns).max(initial=0)] = 0.0
    return SteadySymmetries(cyclic, turns)
