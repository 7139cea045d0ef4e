"""The measurements at the states of a motion whose laws are known, in two ways.

`Law.measurements` takes a `Sample` of many states, which programs evaluate in NumPy without compiling anything.
`measurements_at` is the same for one state in JAX: for values that are being traced, and for scenes without programs.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import SADDLE, Derivation, Motion, Sample, derivation_of, distances, solve_saddle
from lagjax._interface import Layout
from lagjax._program import Program, Unlowerable, lower
from lagjax._scene import System

_CHUNK = 2**21  # numbers that programs return together, 16 MB
_STORED = 2**20  # values that a transposed derivative stores between its two passes, 8 MB
_DERIVATIVE_BUDGET = 20_000  # operations of the program that computes a doubtful derivative a second time


class Measurements(NamedTuple):
    """The measurements at one state; at S states every field has a first axis (S, …)."""

    conserved: Any  # c: h, then k − 1 momenta, (k,)
    slopes: Any  # Σ |∂c/∂yᵢ| (rtol|yᵢ| + atol), the error that one step may put into c, (k,)
    sizes: Any  # Σ |∂c/∂yᵢ yᵢ| and the terms of c, whose rounding c has, (k,)
    power: Any  # dh/dt, ()
    acceleration: Any  # q̈, (n,); zero where nothing does work
    distances: Any  # of q from the constraints, (m,)
    rates: Any  # the distances of q̇ from consistent ones, (m,)
    mass: Any  # smallest eigenvalue of M, its condition, its condition after scaling, (3,)
    finite: Any  # whether the derivatives of the acceleration are finite, ()


class Law(NamedTuple):
    """The equations of one mode, and which of its quantities are constant."""

    derivation: Derivation
    works: bool  # whether anything does work, so that h is not constant
    conserved: tuple[int, ...] | None  # the coordinates on which nothing acts; None where that is not known
    names: tuple[str, ...]  # the names of its constraints

    @property
    def motion(self) -> Motion:
        """The functions of the scene, in flat coordinates."""
        return self.derivation.motion

    @classmethod
    def from_system(cls, system: System, layout: Layout, params, mode: str) -> "Law":
        """The law of a system; `mode`, where it is not empty, is a prefix of the names of constraints."""
        derivation = derivation_of(system, layout, params)
        names = system.constraint_names(layout, params) if derivation.motion.constrained else []
        works, conserved = _constants(system, derivation)
        return cls(derivation, works, conserved, tuple((f"{mode}: " if mode else "") + name for name in names))

    # ---- by programs, in NumPy ----

    def measurements(self, momenta: tuple[int, ...], tolerances, sample: Sample) -> Measurements:
        """The `Measurements` at S states; `tolerances` are rtol and atol, () or (S,) each."""
        return sample.evaluate_in_parts(partial(self._measurements, momenta), self._portion(_QUANTITIES), *tolerances)

    def powers(self, sample: Sample) -> np.ndarray:
        """dh/dt at S states, shape (S,)."""
        return sample.evaluate_in_parts(self._powers, self._portion(_QUANTITIES))

    def accelerations(self, sample: Sample) -> np.ndarray:
        """q̈ at S states, shape (S, n)."""
        return sample.evaluate_in_parts(Sample.solve_acceleration, self._portion(SADDLE))

    def _portion(self, names: tuple[str, ...]) -> int:
        """The number of states of which programs return these quantities together."""
        return max(1, _CHUNK // sum(self.derivation.count(name) for name in names))

    def _measurements(self, momenta, sample: Sample, *tolerances) -> Measurements:
        q, qdot, of = sample.q, sample.qdot, sample.quantities(*_QUANTITIES)
        (rtol, atol), far, fast = (np.reshape(x, (-1, 1)) for x in tolerances), np.abs(q), np.abs(qdot)
        with np.errstate(all="ignore"):
            energy = np.einsum("si,si->s", of["momentum"], qdot) - of["lagrangian"]
            conserved = np.concatenate([energy[:, None], of["momentum"][:, list(momenta)]], axis=1)
            by_q = np.abs(np.concatenate([of["energy_by_q"][:, None], sample.momenta_by_q(momenta)], axis=1))
            of_energy = np.einsum("sij,sj->si", of["mass_matrix"], qdot)[:, None]
            by_qdot = np.abs(np.concatenate([of_energy, of["mass_matrix"][:, list(momenta)]], axis=1))
            sizes = np.einsum("ski,si->sk", by_q, far) + np.einsum("ski,si->sk", by_qdot, fast)
            sizes[:, 0] += np.einsum("si,si->s", np.abs(of["momentum"]), fast) + np.abs(of["lagrangian"])
            slopes = np.einsum("ski,si->sk", by_q, rtol * far + atol)
            slopes += np.einsum("ski,si->sk", by_qdot, rtol * fast + atol)
            off_q, off_qdot = distances(of["residual"], of["rates"], of["jacobian"], self.derivation.position_count)
            power, acceleration = np.zeros(len(q), q.dtype), np.zeros_like(q)
            if self.works:
                acceleration, multipliers = solve_saddle(of)
                power = _power_of(of, qdot, multipliers)
            return Measurements(
                conserved, slopes, sizes, power, acceleration, off_q, off_qdot,
                _conditions(of["mass_matrix"]), self._finite(sample),
            )  # fmt: skip

    def _powers(self, sample: Sample) -> np.ndarray:
        if not self.works:
            return np.zeros(len(sample.q), sample.q.dtype)
        driven = not self.derivation.absent("driving").all()
        of = sample.quantities(*_SOURCES, *(SADDLE if driven else ()))
        with np.errstate(all="ignore"):
            return _power_of(of, sample.qdot, solve_saddle(of)[1] if driven else np.zeros_like(of["driving"]))

    def _finite(self, sample: Sample) -> np.ndarray:
        """True if M, F, G and γ have finite derivatives by all inputs at S states, (S,).

        One transposed derivative of the sum of them all is taken, which a single NaN makes NaN. The program's own
        operations answer first. Where they say no, the program may have written a power as a root, or the user may have
        given a rule for a derivative: there the derivative of the functions themselves decides.
        """
        program = self.derivation.program(*SADDLE)

        def finite_at(part: Sample):
            bars = program.vjp_many(part.columns, [1.0] * len(program.outputs))
            flags = [np.isfinite(np.broadcast_to(bar, len(part.q))) for bar in bars if bar is not None]
            return np.broadcast_to(np.all(flags, axis=0), len(part.q))

        finite = sample.evaluate_in_parts(finite_at, max(1, _STORED // len(program.nodes)))
        if finite.all():
            return finite
        doubtful = [x if np.ndim(x) == 0 else x[~finite] for x in sample.columns]
        try:
            slopes = self._total_slopes.evaluate_many(doubtful)
        except Unlowerable:
            return finite
        finite = finite.copy()
        finite[~finite] = np.isfinite(slopes).all(axis=0)
        return finite

    @property
    def _total_slopes(self) -> Program:
        motion = self.derivation.motion
        return lower(
            lambda *state: _slopes_of_all(motion, *state), *self.derivation.state_shapes, budget=_DERIVATIVE_BUDGET
        )


_SOURCES = ("lagrangian_by_t", "nonconservative_force", "driving")
_QUANTITIES = ("lagrangian", "momentum", "energy_by_q", "residual", "rates", *SADDLE, *_SOURCES)


def _power_of(of: dict[str, np.ndarray], qdot, multipliers) -> np.ndarray:
    """dh/dt = −∂L/∂t + Q·q̇ + λ·(G q̇), where G q̇ = −∂f/∂t, and −a(q, 0, t) for velocities."""
    power = -of["lagrangian_by_t"] + np.einsum("si,si->s", of["nonconservative_force"], qdot)
    return power - np.einsum("sk,sk->s", multipliers, of["driving"])


def _conditions(matrix):
    """The smallest eigenvalue of symmetric matrices (…, n, n), max|λ| / min|λ|, and that ratio after scaling, (…, 3).

    For arrays of NumPy or JAX. The matrix and the one scaled to a unit diagonal go into one call: LAPACK's kernels side
    by side in one program of JAX deadlock (`_linear`).
    """
    xp = matrix.__array_namespace__()
    diagonal = xp.abs(xp.diagonal(matrix, axis1=-2, axis2=-1))
    scale = 1 / xp.sqrt(xp.where(diagonal > 0, diagonal, 1))
    values, scaled = _eigenvalues(xp, xp.stack([matrix, scale[..., :, None] * matrix * scale[..., None, :]]))
    spread = (xp.max(xp.abs(x), axis=-1) / xp.min(xp.abs(x), axis=-1) for x in (values, scaled))
    return xp.stack([xp.min(values, axis=-1), *spread], axis=-1)


def _eigenvalues(xp, matrix):
    """The eigenvalues (…, n) of symmetric matrices (…, n, n); NaN where a matrix is not finite."""
    n = matrix.shape[-1]
    if n == 1:
        return matrix[..., 0]
    if n == 2:  # a closed form keeps the digits of the smaller one, and LAPACK is called for one matrix after the other
        a, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
        middle, radius = 0.5 * (a + d), xp.hypot(0.5 * (a - d), c)
        larger = xp.where(middle < 0, middle - radius, middle + radius)
        smaller = xp.where(larger == 0, 0.0, (a * d - c * c) / xp.where(larger == 0, 1.0, larger))
        return xp.stack([larger, smaller], axis=-1)
    if xp is np and not np.any(matrix[..., ~np.eye(n, dtype=bool)]):  # bodies: LAPACK would take n³ operations
        return np.sort(np.diagonal(matrix, axis1=-2, axis2=-1), axis=-1)
    finite = xp.isfinite(matrix).all(axis=(-2, -1))  # NumPy's LAPACK raises where one is not
    symmetric = 0.5 * (matrix + xp.swapaxes(matrix, -1, -2))
    usable = xp.where(finite[..., None, None], symmetric, xp.eye(n, dtype=matrix.dtype))
    return xp.where(finite[..., None], xp.linalg.eigvalsh(usable), np.nan)


def _constants(system: System, derivation: Derivation) -> tuple[bool, tuple[int, ...] | None]:
    """A flag that anything does work, and the coordinates on which no force of any kind acts (None: not known)."""
    try:
        return derivation.works, derivation.conserved
    except Unlowerable:
        motion, functions = derivation.motion, (system.lagrangian, system.constraints, system.velocity_constraints)
        could_work = any("t" in function.extras for function in functions if function is not None) or any(
            part is not None for part in (motion.forces, motion.dissipation, motion.constraints.on_velocities)
        )
        return could_work, None


# ---- one state, in JAX -----------------------------------------------------------------------------------------------


def measurements_at(law: Law, momenta: tuple[int, ...], tolerances, q, qdot, t, params) -> Measurements:
    """The `Measurements` at one state, with the momenta of the coordinates in `momenta`."""
    motion, state = law.motion, (q, qdot, t, params)
    conserved = motion.energy_and_momenta(momenta, *state)
    by_q, by_qdot = map(jnp.abs, jax.jacrev(motion.energy_and_momenta, argnums=(1, 2))(momenta, *state))
    (rtol, atol), far, fast = tolerances, jnp.abs(q), jnp.abs(qdot)
    terms = jnp.abs(motion.momentum(*state)) @ fast + jnp.abs(motion.lagrangian(*state))
    off_q, off_qdot = motion.constraints.distances(*state)
    return Measurements(
        conserved=conserved,
        slopes=by_q @ (rtol * far + atol) + by_qdot @ (rtol * fast + atol),
        sizes=(by_q @ far + by_qdot @ fast).at[0].add(terms),
        power=power_at(law, *state),
        acceleration=motion.acceleration(*state) if law.works else jnp.zeros_like(q),
        distances=off_q,
        rates=off_qdot,
        mass=_conditions(motion.mass_matrix(*state)),
        finite=jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in _slopes_of_all(motion, *state)])),
    )


def power_at(law: Law, q, qdot, t, params) -> jax.Array:
    """dh/dt = −∂L/∂t + Q·q̇ + λ·(G q̇), where G q̇ = −∂f/∂t, and −a(q, 0, t) for velocities."""
    motion, state = law.motion, (q, qdot, t, params)
    if not law.works:
        return jnp.zeros((), q.dtype)
    power = motion.nonconservative_force(*state) @ qdot - jax.grad(motion.lagrangian, argnums=2)(*state)
    return power - motion.multipliers(*state) @ motion.constraints.driving(*state) if motion.constrained else power


def _slopes_of_all(motion: Motion, q, qdot, t, params) -> list[jax.Array]:
    """The derivatives of the sum of M, F, G and γ by q, q̇, t and every parameter."""
    floats, others = eqx.partition(params, _is_inexact)

    def total(q, qdot, t, floats):
        state = q, qdot, t, eqx.combine(floats, others)
        parts = motion.mass_matrix_and_force(*state)
        parts += motion.constraints.jacobian_and_gamma(*state)
        return sum(jnp.sum(part) for part in parts)

    return jax.tree.leaves(jax.grad(total, argnums=(0, 1, 2, 3))(q, qdot, t, floats))


def _is_inexact(leaf) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)
