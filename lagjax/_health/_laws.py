"""What can be asked of one state of a motion whose laws are known."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import LARGEST_SCALAR_SCENE, OPERATION_BUDGET
from lagjax._layout import Layout
from lagjax._motion import Motion
from lagjax._program import Unlowerable, lower
from lagjax._system import System


class Law(NamedTuple):
    """The equations of one mode, and which of its quantities are constant, read off its programs."""

    motion: Motion
    works: bool  # whether anything does: h is not constant
    conserved: tuple[int, ...] | None  # the coordinates on which nothing acts; None where that is not known
    names: tuple[str, ...]  # of its constraints

    @classmethod
    def of(cls, system: System, layout: Layout, params, mode: str) -> "Law":
        """The law of a system; `mode` is a prefix for the names."""
        motion, numbers = system.motion(layout, params), eqx.filter(params, eqx.is_array_like)
        names = system.constraint_names(layout, params) if motion.constrained else []
        works, conserved = _constants(system, motion, layout, numbers)
        return cls(motion, works, conserved, tuple((f"{mode}: " if mode else "") + name for name in names))


def _constants(system: System, motion: Motion, layout: Layout, numbers) -> tuple[bool, tuple[int, ...] | None]:
    """Whether anything does work, and the coordinates on which no force of any kind acts."""
    n = layout.size
    asked = (system.lagrangian, system.constraints, system.velocity_constraints)
    could_work = any("t" in function.extras for function in asked if function is not None) or any(
        part is not None for part in (motion.forces, motion.dissipation, motion.velocity_constraints)
    )
    if n > LARGEST_SCALAR_SCENE:
        return could_work, None

    def acting(*state):
        rows = motion.rows_and_targets(*state)[0] if motion.constrained else jnp.zeros((0, n), layout.dtype)
        return rows, motion.generalized_force(*state), _sources(motion, *state)

    q, t = jax.ShapeDtypeStruct((n,), layout.dtype), jax.ShapeDtypeStruct((), layout.dtype)
    try:
        program = lower(acting, q, q, t, numbers, budget=OPERATION_BUDGET)
    except Unlowerable:
        return could_work, None
    absent = np.array([program.constant(k) == 0 for k in range(len(program.outputs))])
    forces = n * (jax.eval_shape(acting, q, q, t, numbers)[0].shape[0] + 1)
    untouched = absent[:forces].reshape(-1, n).all(axis=0)
    return not absent[forces:].all(), tuple(np.flatnonzero(untouched).tolist())


def _sources(motion: Motion, q, qdot, t, params) -> jax.Array:
    """What can do work: ∂L/∂t, Q, ∂f/∂t and a(q, 0, t), end to end."""
    parts = [jax.grad(motion.lagrangian, argnums=2)(q, qdot, t, params)[None]]
    parts.append(motion.nonconservative_force(q, qdot, t, params))
    if motion.constraints is not None:
        parts.append(jax.jacfwd(motion.constraints, argnums=1)(q, t, params))
    if motion.velocity_constraints is not None:
        parts.append(motion.velocity_constraints(q, jnp.zeros_like(qdot), t, params))
    return jnp.concatenate(parts)


def _power(motion: Motion, q, qdot, t, params) -> jax.Array:
    """dh/dt = −∂L/∂t + Q·q̇ + λ·(G q̇), where G q̇ = −∂f/∂t, and −a(q, 0, t) for velocities."""
    n, sources = q.size, _sources(motion, q, qdot, t, params)
    power = -sources[0] + sources[1 : n + 1] @ qdot
    return power - motion.multipliers(q, qdot, t, params) @ sources[n + 1 :] if motion.constrained else power


class Found(NamedTuple):
    """What is found at a state."""

    kept: jax.Array  # h, then momenta
    slopes: jax.Array  # of these: Σ |∂c/∂yᵢ| (rtol|yᵢ| + atol)
    sizes: jax.Array  # Σ |∂c/∂yᵢ yᵢ|, with the terms of c
    power: jax.Array  # P, and its first two derivatives along the motion
    distances: jax.Array  # from the constraints
    rates: jax.Array
    mass: jax.Array  # smallest eigenvalue, condition, scaled condition
    finite: jax.Array  # derivatives of the acceleration


def found_at(law: Law, momenta: tuple[int, ...], tolerances, q, qdot, t, params) -> Found:
    """All of it at one state; `momenta` says of which coordinates."""
    motion, state = law.motion, (q, qdot, t, params)

    def kept(q, qdot):
        momentum = motion.momentum(q, qdot, t, params)
        return jnp.stack([motion.energy(q, qdot, t, params), *(momentum[i] for i in momenta)])

    by_q, by_qdot = map(jnp.abs, jax.jacrev(kept, argnums=(0, 1))(q, qdot))
    (rtol, atol), far, fast = tolerances, jnp.abs(q), jnp.abs(qdot)
    terms = jnp.abs(motion.momentum(*state)) @ fast + jnp.abs(motion.lagrangian(*state))
    distances, rates = _off(motion, *state) if motion.constrained else [jnp.zeros(0, q.dtype)] * 2
    return Found(
        kept=kept(q, qdot),
        slopes=by_q @ (rtol * far + atol) + by_qdot @ (rtol * fast + atol),
        sizes=(by_q @ far + by_qdot @ fast).at[0].add(terms),
        power=_power_and_rates(law, *state) if law.works else jnp.zeros(3, q.dtype),
        distances=distances,
        rates=rates,
        mass=_conditions(motion.mass_matrix(*state)),
        finite=_finite_gradient(law, *state),
    )


def _power_and_rates(law: Law, q, qdot, t, params) -> jax.Array:
    def along(function):
        def rate(q, qdot, t):
            acceleration = law.motion.acceleration(q, qdot, t, params)
            return jax.jvp(function, (q, qdot, t), (qdot, acceleration, jnp.ones_like(t)))[1]

        return rate

    def power(q, qdot, t):
        return _power(law.motion, q, qdot, t, params)

    once = along(power)
    return jnp.stack([power(q, qdot, t), once(q, qdot, t), along(once)(q, qdot, t)])


def _off(motion: Motion, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
    """How far q and q̇ are from the constraints, in their own units."""
    rows = motion.rows_and_targets(q, qdot, t, params)[0]
    rates = motion.velocity_saddle(q, qdot, t, params)[2]
    values, lengths = jnp.zeros_like(rates), jnp.sqrt(jnp.sum(rows**2, axis=1))
    if motion.constraints is not None:
        held = motion.constraints(q, t, params)
        values = values.at[: len(held)].set(held)
    distances, speeds = (jnp.where(off == 0, 0.0, jnp.abs(off) / lengths) for off in (values, rates))
    return distances, speeds


def _conditions(matrix: jax.Array) -> jax.Array:
    """The smallest eigenvalue, max|λ| / min|λ|, and the same after scaling to a unit diagonal."""
    diagonal = jnp.abs(jnp.diagonal(matrix))
    scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    values, scaled = (_eigenvalues(m) for m in (matrix, scale[:, None] * matrix * scale))
    spread = (jnp.max(jnp.abs(x)) / jnp.min(jnp.abs(x)) for x in (values, scaled))
    return jnp.stack([jnp.min(values), *spread])


def _eigenvalues(matrix: jax.Array) -> jax.Array:
    if matrix.shape == (1, 1):
        return matrix[0]
    if matrix.shape == (2, 2):  # LAPACK is called for one matrix after the other
        (a, c), (_, d) = matrix
        middle, radius = 0.5 * (a + d), jnp.hypot(0.5 * (a - d), c)
        larger = jnp.where(middle < 0, middle - radius, middle + radius)
        return jnp.stack([larger, jnp.where(larger == 0, 0.0, (a * d - c * c) / larger)])
    return jnp.linalg.eigvalsh(0.5 * (matrix + matrix.T))


def _finite_gradient(law: Law, q, qdot, t, params) -> jax.Array:
    """Whether all that the acceleration is solved from has finite derivatives: one pull-back, which a NaN spoils."""
    varied, fixed = eqx.partition(params, eqx.is_inexact_array)

    def total(q, qdot, t, varied):
        state = q, qdot, t, eqx.combine(varied, fixed)
        parts = law.motion.mass_matrix_and_force(*state)
        parts += law.motion.rows_and_targets(*state) if law.motion.constrained else ()
        return sum(jnp.sum(part) for part in parts)

    slopes = jax.grad(total, argnums=(0, 1, 2, 3))(q, qdot, t, varied)
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes)]))
