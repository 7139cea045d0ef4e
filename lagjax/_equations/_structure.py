"""`SparseMotion`: the motion of a large scene, whose matrices are solved by their patterns and never stored.

    S = G M⁻¹ Gᵀ        λ = S⁻¹ (c − G M⁻¹ b)        x = M⁻¹ (b + Gᵀλ)

M is regular here: if only the constraints make the system regular, machine code and dense arrays use `_linear`'s form.
Products with M, G and Gᵀ are derivatives along one direction.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from lagjax._equations._motion import Flag, Motion, PyTree, Row, Time, Vector
from lagjax._equations._patterns import jacobian_pattern
from lagjax._equations._sparse import Blocks, Diagonal, MatrixForm, Solver, form_of, refine
from lagjax._interface import compiled_once


class SparseStructure(NamedTuple):
    """The forms of M, of S = G M⁻¹ Gᵀ, and of S for the constraints on positions only (None without any)."""

    mass: MatrixForm
    schur: MatrixForm | None
    positions: MatrixForm | None

    def __str__(self) -> str:
        linked = "" if self.schur is None else f", G M⁻¹ Gᵀ is {self.schur.name}"
        return f"its mass matrix is {self.mass.name}{linked}"


def mass_form(motion: Motion, shapes: tuple) -> MatrixForm:
    """The form of M, for a scene with these shapes of (q, q̇, t, params)."""
    return form_of(jacobian_pattern(jax.grad(motion.lagrangian, argnums=1), shapes, by=1), shapes[0].size)


def structure_of(motion: Motion, shapes: tuple, mass: MatrixForm) -> SparseStructure | None:
    """The structure of a large scene; None if the pattern of its constraints is unknown."""
    q, _, t, numbers = shapes
    if not motion.constrained:
        return SparseStructure(mass, None, None)
    constraints = motion.constraints
    count = jax.eval_shape(constraints.f, q, t, numbers).size
    rows = jacobian_pattern(lambda q, t, p: constraints.f(q, t, p), (q, t, numbers), by=0)
    on_velocities = jacobian_pattern(lambda *state: constraints.a(*state), shapes, by=1)
    if rows is None or on_velocities is None:
        return None
    inverse = _pattern_of_inverse(mass)

    def schur(jacobian: "scipy.sparse.csr_array") -> MatrixForm:
        pattern = None if inverse is None else scipy.sparse.csr_array((jacobian @ inverse @ jacobian.T) != 0)
        return form_of(pattern, len(jacobian.indptr) - 1)

    both = scipy.sparse.csr_array(scipy.sparse.vstack([pattern.astype(np.int32) for pattern in (rows, on_velocities)]))
    return SparseStructure(mass, schur(both), schur(rows) if count else None)


def _pattern_of_inverse(form: MatrixForm) -> "scipy.sparse.csr_array | None":
    """The pattern of M⁻¹ if it is sparse: diagonal, or full blocks; else None."""
    n = form.size
    if isinstance(form, Diagonal):
        return scipy.sparse.csr_array((np.ones(n, np.int32), (np.arange(n), np.arange(n))), shape=(n, n))
    if not isinstance(form, Blocks):
        return None
    rows = np.concatenate([np.repeat(members, members.shape[1], axis=1).ravel() for members in form.groups])
    columns = np.concatenate([np.tile(members, (1, members.shape[1])).ravel() for members in form.groups])
    return scipy.sparse.csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(n, n))


class SparseMotion(Motion):
    """A `Motion` that solves with the `SparseStructure` of its scene."""

    structure: SparseStructure = eqx.field(static=True, kw_only=True)

    def mass_product(self, q, qdot, t, params):
        return jax.linearize(lambda qdot: self.momentum(q, qdot, t, params), qdot)[1]

    def solved_acceleration(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> tuple[Vector, Flag]:
        state = q, qdot, t, params
        if self.constrained:
            return super().solved_acceleration(*state)
        mass = self.structure.mass.prepare(self.mass_product(*jax.lax.stop_gradient(state)), q.dtype)
        product = self.mass_product(*state)

        def solve(_, b):
            return refine(product, mass.solve, b) if self.structure.mass.iterative else mass.solve(b)

        x = jax.lax.custom_linear_solve(product, self.force(*state), solve, symmetric=True)
        return jnp.where(mass.singular, jnp.nan, x), mass.singular

    def saddle(self, b: Vector, c: Row, q, qdot, t, params, positions=False) -> tuple[Vector, Row, Flag]:
        """x, λ of M x − Gᵀλ = b, G x = c, and a flag: M is singular. With `positions`, for the constraints f only."""
        positions = positions and self.constraints.on_velocities is not None
        return _compile_saddle(self, positions)(b, c, q, qdot, t, params)

    def _prepare_solvers(self, positions: bool, *state, products=None) -> tuple[Solver, Solver, Callable]:
        """The solvers of M and of S, and (b, c) ↦ (x, −λ); `products` are x ↦ G x and λ ↦ Gᵀλ."""
        dtype = state[0].dtype
        push, pull = self.constraints.products(*state, positions=positions) if products is None else products
        mass = self.structure.mass.prepare(self.mass_product(*state), dtype)
        form = self._schur_form(positions)
        schur = form.prepare(lambda y: push(mass.solve(pull(y))), dtype, dependent=True)

        def eliminate(b, c):
            free = mass.solve(b)
            nu = schur.solve(push(free) - c)
            return free - mass.solve(pull(nu)), nu

        return mass, schur, eliminate

    def _schur_form(self, positions: bool) -> MatrixForm:
        """The form of S, or of S for the constraints on `positions` only."""
        form = self.structure.positions if positions else self.structure.schur
        assert form is not None
        return form

    def rank_lost(self, start: tuple, end: tuple) -> Flag:
        """True if fewer constraints are independent at `end` than at `start`; needs S banded or in blocks."""
        (t0, t1), numbers = (jnp.asarray(state[2]) for state in (start, end)), start[3]
        states = jax.lax.stop_gradient(jax.tree.map(lambda *x: jnp.stack(x), (*start[:2], t0), (*end[:2], t1)))
        before, after = jax.lax.map(lambda y: self._prepare_solvers(False, *y, numbers)[1].rank, states)
        return after < before

    def unit(self, q, qdot, t, params):
        size = jnp.abs(self.structure.mass.diagonal(self.mass_product(q, qdot, t, params), q.dtype))
        return 1 / jnp.sqrt(jnp.where(size > 0, size, 1))

    def row_lengths(self, unit, q, qdot, t, params, positions=False):
        push, pull = self.constraints.products(q, qdot, t, params, positions=positions)
        form = self._schur_form(positions)
        return jnp.sqrt(form.diagonal(lambda y: push(unit**2 * pull(y)), q.dtype))

    def quantities(self, q, qdot, t, params):
        """The quantities of `Motion.quantities` without M and G, and with products of these instead.

        - `mass_diagonal` (n,) of M, `energy_by_qdot` (n,), M q̇, and `mass_by_some` (n,), M x for some x.
        - `acceleration` (n,), `multipliers` (m,).
        - `row_lengths` (m,) of G, and `unit_lengths` (m,) in the `unit` (n,) of coordinates; `jacobian_by_some` (m,),
          G x, and `jacobian_columns` (n,), Gᵀλ for λ = 1.
        """
        state = q, qdot, t, params
        values, multiply = super().quantities(*state), self.mass_product(*state)
        unit, some = self.unit(*state), jnp.cos(jnp.arange(1.0, q.size + 1, dtype=q.dtype))  # no symmetry moves so
        values |= {
            "mass_diagonal": self.structure.mass.diagonal(multiply, q.dtype),
            "energy_by_qdot": multiply(qdot),
            "mass_by_some": multiply(some),
            "unit": unit,
            "acceleration": self.acceleration(*state),
        }
        if self.constrained:
            push, pull = self.constraints.products(*state)
            values |= {
                "multipliers": self.multipliers(*state),
                "row_lengths": self.row_lengths(jnp.ones_like(q), *state),
                "unit_lengths": self.row_lengths(unit, *state),
                "jacobian_by_some": push(some),
                "jacobian_columns": pull(jnp.ones_like(values["gamma"])),
            }
        else:
            none = ("multipliers", "row_lengths", "unit_lengths", "jacobian_by_some")
            values |= dict.fromkeys(none, values["gamma"]) | {"jacobian_columns": jnp.zeros_like(q)}
        return {name: value for name, value in values.items() if name not in ("mass_matrix", "jacobian")}

    def solve_newton(self, linear: Callable, right: tuple[Vector, Row], *state) -> tuple[Vector, Row]:
        """The solution (x, ν) of H x + Jᵀν = b, J x = c, by GMRES, preconditioned by solves with M in place of H."""
        zero = jax.tree.map(jnp.zeros_like, right)
        products = lambda x: linear((x, zero[1]))[1], lambda nu: linear((zero[0], nu))[0]
        eliminate = self._prepare_solvers(True, *jax.lax.stop_gradient(state), products=products)[2]

        def solve(_, right):
            tolerance, prepare = 10 * float(jnp.finfo(state[0].dtype).eps), lambda rest: eliminate(*rest)
            options = {"tol": tolerance, "restart": 30, "maxiter": 10, "solve_method": "incremental"}
            return jax.scipy.sparse.linalg.gmres(linear, right, M=prepare, **options)[0]

        return jax.lax.custom_linear_solve(linear, right, solve, symmetric=True)


@functools.lru_cache(maxsize=64)
def _compile_saddle(motion: SparseMotion, positions: bool) -> Callable:
    """`SparseMotion.saddle` as a compiled function of b, c and the state, with one refinement."""

    def saddle(b: Vector, c: Row, *state):
        mass, _, eliminate = motion._prepare_solvers(positions, *jax.lax.stop_gradient(state))
        multiply, (push, pull) = motion.mass_product(*state), motion.constraints.products(*state, positions=positions)

        def product(place):
            x, nu = place
            return multiply(x) + pull(nu), push(x)

        def solve(_, right):
            return refine(product, lambda rest: eliminate(*rest), right)

        x, nu = jax.lax.custom_linear_solve(product, (b, c), solve, symmetric=True)
        return jnp.where(mass.singular, jnp.nan, x), -nu, mass.singular

    return compiled_once(saddle)
