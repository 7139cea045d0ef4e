"""`Law`: evaluates the quantities of `Health` at states, with the equations of motion of one mode.

`Law.measurements` takes a `Sample` of many states, which programs evaluate in NumPy without compiling anything;
`Law.measurements_at` takes one state in JAX, for traced values and for scenes without programs. Both pass the
quantities of the scene to `_measure_path`, which is written for arrays of either library.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._equations import (
    SADDLE,
    Derivation,
    Diagonal,
    Motion,
    Sample,
    derivation_of,
    distances,
    solve_saddle,
    unit_diagonal,
)
from lagjax._interface import Layout
from lagjax._program import Unlowerable
from lagjax._scene import System
from lagjax._tracing import lower

_CHUNK = 2**21  # numbers that programs return together, 16 MB
_STORED = 2**20  # values that a transposed derivative stores between its two passes, 8 MB
_MOMENTA = 16  # conserved ones of a large scene that are looked at: each takes n numbers at every output
_DERIVATIVE_BUDGET = 20_000  # operations of the program that computes a doubtful derivative a second time


class Measurements(NamedTuple):
    """The quantities of `Health` at one state; at S states every field has a first axis (S, …)."""

    conserved: Any  # c: h, then k − 1 momenta, (k,)
    slopes: Any  # Σ |∂c/∂yᵢ| (rtol|yᵢ| + atol), the error that one step may put into c, (k,)
    sizes: Any  # Σ |∂c/∂yᵢ yᵢ| and the terms of c, whose rounding c has, (k,)
    power: Any  # dh/dt, ()
    acceleration: Any  # q̈, (n,); zero where nothing does work
    distances: Any  # of q from the constraints, (m,)
    rates: Any  # the distances of q̇ from consistent ones, (m,)
    mass: Any  # smallest eigenvalue of M, its condition, its condition after scaling, (3,); NaN where not known
    finite: Any  # whether the derivatives of the acceleration are finite, ()


class Law(NamedTuple):
    """The equations of motion of one mode, and which of its quantities are conserved."""

    derivation: Derivation
    works: bool  # whether anything does work, so that h is not constant
    conserved: tuple[int, ...] | None  # the coordinates on which nothing acts; None where that is not known
    names: tuple[str, ...]  # the names of its constraints

    @property
    def motion(self) -> Motion:
        return self.derivation.motion

    @property
    def knows_mass(self) -> bool:
        """True if the eigenvalues of M are computed: not for a large scene, unless M is diagonal."""
        return not self.derivation.form.is_sparse or isinstance(self.derivation.form.mass, Diagonal)

    @classmethod
    def from_system(cls, system: System, layout: Layout, params, mode: str) -> "Law":
        """Return the law of a system; `mode`, if not empty, is a prefix of the names of constraints."""
        derivation = derivation_of(system, layout, params)
        names = system.constraint_names(layout, params) if derivation.motion.constrained else []
        works, conserved = (True, ()) if system.touches else _conservation_flags(system, derivation)
        return cls(derivation, works, conserved, tuple((f"{mode}: " if mode else "") + name for name in names))

    # ---- many states, by programs ----

    def measurements(self, momenta: tuple[int, ...], tolerances, sample: Sample) -> Measurements:
        """Return the `Measurements` at S states; `tolerances` are rtol and atol, () or (S,) each."""

        def measure_part(part: Sample, *tolerances) -> Measurements:
            of, by_q = part.quantities(*_QUANTITIES), part.momenta_by_q(momenta)
            columns = [np.reshape(x, (-1, 1)) for x in tolerances]
            return self._measure_path(momenta, columns, part.q, part.qdot, of, by_q, self._derivatives_finite(part))

        return sample.evaluate_in_parts(measure_part, self._portion(_QUANTITIES), *tolerances)

    def energy_rates(self, sample: Sample) -> np.ndarray:
        """Return dh/dt at S states, (S,)."""
        names = (*_SOURCES, *(SADDLE if self.motion.constrained else ()))
        return sample.evaluate_in_parts(
            lambda part: self._energy_power(part.quantities(*names), part.qdot), self._portion(_QUANTITIES)
        )

    def accelerations(self, sample: Sample) -> np.ndarray:
        """Return q̈ at S states, (S, n)."""
        return sample.evaluate_in_parts(lambda part: solve_saddle(part.quantities(*SADDLE))[0], self._portion(SADDLE))

    def _portion(self, names: tuple[str, ...]) -> int:
        return max(1, _CHUNK // sum(self.derivation.count(name) for name in names))

    def _derivatives_finite(self, sample: Sample) -> np.ndarray:
        """Return (S,): True if M, F, G and γ have finite derivatives with respect to all inputs."""
        # One transposed derivative of the sum of them all is taken, which a single NaN makes NaN. The program's own
        # operations answer first. Where they say no, the program may have written a power as a root, or the user may
        # have given a rule for a derivative: there the derivative of the functions themselves decides.
        program = self.derivation.program(*SADDLE)

        def finite_at(part: Sample):
            bars = program.line.vjp(part.columns, [1.0] * len(program.line.outputs))
            flags = [np.isfinite(np.broadcast_to(bar, len(part.q))) for bar in bars if bar is not None]
            return np.broadcast_to(np.all(flags, axis=0), len(part.q))

        finite = sample.evaluate_in_parts(finite_at, max(1, _STORED // len(program.line.nodes)))
        if finite.all():
            return finite
        doubtful = [x if np.ndim(x) == 0 else x[~finite] for x in sample.columns]
        try:
            slopes_of_all = partial(_slopes_of_all, self.motion)
            program = lower(slopes_of_all, *self.derivation.state_shapes, budget=_DERIVATIVE_BUDGET)
        except Unlowerable:
            return finite
        finite = finite.copy()
        finite[~finite] = np.isfinite(program.evaluate_many(doubtful)).all(axis=0)
        return finite

    # ---- one state, in JAX ----

    def measurements_at(self, momenta: tuple[int, ...], tolerances, q, qdot, t, params) -> Measurements:
        """Return the `Measurements` at one state, with the momenta of the coordinates in `momenta`."""
        motion, state, chosen = self.motion, (q, qdot, t, params), jnp.asarray(momenta, int)
        by_q = jax.jacrev(lambda *state: motion.momentum(*state)[chosen])(*state)
        finite = jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in _slopes_of_all(motion, *state)]))
        of = motion.quantities(*state)
        if self.derivation.form.is_sparse:
            units = jnp.zeros((len(momenta), q.size), q.dtype).at[np.arange(len(momenta)), chosen].set(1.0)
            mass = _conditions_of_diagonal(of["mass_diagonal"]) if self.knows_mass else jnp.full(3, jnp.nan, q.dtype)
            of |= {"momenta_by_qdot": jax.vmap(motion.mass_product(*state))(units), "mass": mass}
        return self._measure_path(momenta, tolerances, q, qdot, of, by_q, finite)

    def power_at(self, q, qdot, t, params) -> jax.Array:
        return self._energy_power(self.motion.quantities(q, qdot, t, params), qdot)

    # ---- the laws ----

    @np.errstate(all="ignore")
    def _measure_path(self, momenta, tolerances, q, qdot, of, momenta_by_q, finite) -> Measurements:
        """Return the `Measurements` of q, q̇ (…, n) from the quantities `of`, ∂pᵢ/∂q (…, k − 1, n) and `finite` (…)."""
        # Arrays of NumPy have an axis of states, those of JAX none.
        xp, (rtol, atol), chosen = qdot.__array_namespace__(), tolerances, np.array(momenta, int)
        of = of if "mass_matrix" not in of else of | _mass_products(xp, of["mass_matrix"], of["jacobian"], qdot, chosen)
        momentum, far, fast = of["momentum"], xp.abs(q), xp.abs(qdot)
        energy = xp.einsum("...i,...i->...", momentum, qdot) - of["lagrangian"]
        by_q = xp.abs(xp.concatenate([of["energy_by_q"][..., None, :], momenta_by_q], axis=-2))
        by_qdot = xp.abs(xp.concatenate([of["energy_by_qdot"][..., None, :], of["momenta_by_qdot"]], axis=-2))

        def add_changes(of_q, of_qdot):
            return xp.einsum("...ki,...i->...k", by_q, of_q) + xp.einsum("...ki,...i->...k", by_qdot, of_qdot)

        terms = xp.einsum("...i,...i->...", xp.abs(momentum), fast) + xp.abs(of["lagrangian"])
        is_energy = np.arange(1 + len(chosen)) == 0
        off_q, off_qdot = distances(of["residual"], of["rates"], of["row_lengths"], self.derivation.position_count)
        return Measurements(
            conserved=xp.concatenate([energy[..., None], momentum[..., chosen]], axis=-1),
            slopes=add_changes(rtol * far + atol, rtol * fast + atol),
            sizes=add_changes(far, fast) + is_energy * terms[..., None],
            power=self._energy_power(of, qdot),
            acceleration=solve_saddle(of)[0] if self.works else xp.zeros_like(q),
            distances=off_q,
            rates=off_qdot,
            mass=of["mass"],
            finite=finite,
        )

    @np.errstate(all="ignore")
    def _energy_power(self, of: dict[str, Any], qdot):
        """Return dh/dt = −∂L/∂t + Q·q̇ + λ·(G q̇), where G q̇ = −∂f/∂t, and −a(q, 0, t) for velocities, (…)."""
        xp = qdot.__array_namespace__()
        if not self.works:
            return xp.zeros_like(of["lagrangian_by_t"])
        power = xp.einsum("...i,...i->...", of["nonconservative_force"], qdot) - of["lagrangian_by_t"]
        if not self.motion.constrained:
            return power
        return power - xp.einsum("...k,...k->...", solve_saddle(of)[1], of["driving"])


_SOURCES = ("lagrangian_by_t", "nonconservative_force", "driving")
_QUANTITIES = ("lagrangian", "momentum", "energy_by_q", "residual", "rates", *SADDLE, *_SOURCES)


def _mass_products(xp, mass, jacobian, qdot, chosen) -> dict[str, Any]:
    """Return M q̇, the rows of M of the `chosen` coordinates, the row norms of G, and `_conditions` of M."""
    return {
        "energy_by_qdot": xp.einsum("...ij,...j->...i", mass, qdot),
        "momenta_by_qdot": mass[..., chosen, :],
        "row_lengths": xp.sqrt(xp.sum(jacobian**2, axis=-1)),
        "mass": _conditions(mass),
    }


def _conditions_of_diagonal(values):
    """Return the same as `_conditions` for a diagonal matrix, given its diagonal (n,)."""
    size = jnp.abs(values)
    return jnp.stack([jnp.min(values), jnp.max(size) / jnp.min(size), jnp.where(jnp.min(size) > 0, 1.0, jnp.inf)])


def _conditions(matrix):
    """Return min λ, max|λ| / min|λ| and that ratio after scaling, (…, 3), of symmetric matrices (…, n, n)."""
    # The matrix and the one scaled to a unit diagonal go into one call: LAPACK's kernels side by side in one program of
    # JAX deadlock (`_linear`).
    xp = matrix.__array_namespace__()
    values, scaled = _eigenvalues(xp, xp.stack([matrix, unit_diagonal(matrix)[0]]))
    spread = (xp.max(xp.abs(x), axis=-1) / xp.min(xp.abs(x), axis=-1) for x in (values, scaled))
    return xp.stack([xp.min(values, axis=-1), *spread], axis=-1)


def _eigenvalues(xp, matrix):
    """Return the eigenvalues (…, n) of symmetric matrices (…, n, n); NaN where a matrix is not finite."""
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


def _conservation_flags(system: System, derivation: Derivation) -> tuple[bool, tuple[int, ...] | None]:
    """Return whether any force does work, and the coordinates on which no force acts (None: not known)."""
    try:
        return derivation.works, derivation.conserved
    except Unlowerable:
        motion, functions = derivation.motion, (system.lagrangian, system.constraints, system.velocity_constraints)
        could_work = any("t" in function.extras for function in functions if function is not None) or any(
            part is not None for part in (motion.forces, motion.dissipation, motion.constraints.on_velocities)
        )
        free = derivation.form.is_sparse and not (could_work or motion.constrained)
        cyclic = derivation.cyclic if free else None
        return could_work, None if cyclic is None else cyclic[:_MOMENTA]


def _slopes_of_all(motion: Motion, q, qdot, t, params) -> list[jax.Array]:
    """Return the derivatives of the sum of M, F, G and γ by q, q̇, t and every parameter."""
    floats, others = eqx.partition(params, lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.inexact))

    def total(q, qdot, t, floats):
        state, ones = (q, qdot, t, eqx.combine(floats, others)), jnp.ones_like(q)
        parts = motion.mass_product(*state)(ones), motion.force(*state)
        parts += motion.constraints.products(*state)[0](ones), motion.constraints.gamma(*state)
        return sum(jnp.sum(part) for part in parts)

    return jax.tree.leaves(jax.grad(total, argnums=(0, 1, 2, 3))(q, qdot, t, floats))
