"""The equations of motion of a scene, derived from its Lagrangian by automatic differentiation.

    p = ∂L/∂q̇        M = ∂²L/∂q̇²        M q̈ = F + Gᵀλ,  F = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q        h = p·q̇ − L

Q are the generalised forces that no potential gives, and minus the velocity gradient of the Rayleigh dissipation
function; Gᵀλ are the forces of the constraints. L may be any smooth function: nothing here assumes T − U. Everything is
flat: q and q̇ are vectors of n coordinates. Only this module, on arrays, and `_quantities`, on scalars, differentiate a
Lagrangian.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax._equations import _constraints, _linear
from lagjax._equations._constraints import Constraints, Row, Time, Vector

Matrix = Float[Array, "n n"]
Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


class Motion(eqx.Module):
    """A scene in flat coordinates; every function takes (q, qdot, t, params), q and qdot of shape (n,)."""

    lagrangian: Callable
    forces: Callable | None
    dissipation: Callable | None
    constraints: Constraints = Constraints()

    @property
    def functions(self) -> list[Callable]:
        """L, the forces and the dissipation, if the scene has them."""
        return [f for f in (self.lagrangian, self.forces, self.dissipation) if f is not None]

    # ---- without constraints ----

    def momentum(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The momentum p = ∂L/∂q̇."""
        return jax.grad(self.lagrangian, argnums=1)(q, qdot, t, params)

    def mass_matrix(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Matrix:
        """The mass matrix M = ∂²L/∂q̇²."""
        return jax.hessian(self.lagrangian, argnums=1)(q, qdot, t, params)

    def nonconservative_force(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The force Q = forces − ∂D/∂q̇."""
        force = jnp.zeros_like(q)
        if self.forces is not None:
            force += self.forces(q, qdot, t, params)
        if self.dissipation is not None:
            force -= jax.grad(self.dissipation, argnums=1)(q, qdot, t, params)
        return force

    def generalized_force(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The force ∂L/∂q + Q, which is dp/dt along the motion of a scene without constraints."""
        return jax.grad(self.lagrangian)(q, qdot, t, params) + self.nonconservative_force(q, qdot, t, params)

    def force(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The force F = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q in M q̈ = F + Gᵀλ."""
        # (∂p/∂q) q̇ + ∂p/∂t is how p changes while q moves and q̇ does not: one directional derivative.
        _, drift = jax.jvp(lambda q, t: self.momentum(q, qdot, t, params), (q, t), (qdot, jnp.ones_like(t)))
        return self.generalized_force(q, qdot, t, params) - drift

    def mass_matrix_and_force(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> tuple[Matrix, Vector]:
        """M and F of M q̈ = F + Gᵀλ."""
        return self.mass_matrix(q, qdot, t, params), self.force(q, qdot, t, params)

    def mass_product(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Callable[[Vector], Vector]:
        """The function x ↦ M x."""
        matrix = self.mass_matrix(q, qdot, t, params)
        return lambda x: matrix @ x

    def unbalanced_force(self, q: Vector, qdot: Vector, qddot: Vector, t: Time, params: PyTree) -> Vector:
        """M q̈ − F, as dp/dt − ∂L/∂q − Q: the additional force that an acceleration requires."""
        along = qdot, qddot, jnp.ones_like(t)
        _, rate = jax.jvp(lambda q, qdot, t: self.momentum(q, qdot, t, params), (q, qdot, t), along)
        return rate - self.generalized_force(q, qdot, t, params)

    def energy(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Scalar:
        """The energy h = p·q̇ − L, with dh/dt = −∂L/∂t + Q·q̇ along the motion."""
        return self.momentum(q, qdot, t, params) @ qdot - self.lagrangian(q, qdot, t, params)

    # ---- with constraints ----

    @property
    def constrained(self) -> bool:
        return self.constraints.exist

    def acceleration(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The acceleration q̈ of M q̈ = F + Gᵀλ, G q̈ = γ; NaN where the system is singular."""
        return self.solved_acceleration(q, qdot, t, params)[0]

    def solved_acceleration(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> tuple[Vector, Flag]:
        """The acceleration q̈, and a flag: its linear system is singular, in which case q̈ is NaN."""
        state = q, qdot, t, params
        if self.constrained:
            acceleration, _, singular = self.saddle(self.force(*state), self.constraints.gamma(*state), *state)
            return acceleration, singular
        matrix, force = self.mass_matrix_and_force(*state)
        mass = _linear.factorize(matrix)
        return mass.solve(force), mass.singular

    def multipliers(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The multipliers λ, those of constraints on positions first; of least norm if G is redundant."""
        state = q, qdot, t, params
        return self.saddle(self.force(*state), self.constraints.gamma(*state), *state)[1]

    def constraint_force(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The generalised force Gᵀλ that the constraints exert."""
        _, pull = self.constraints.products(q, qdot, t, params)
        return pull(self.multipliers(q, qdot, t, params))

    def required_force(
        self, q: Vector, qdot: Vector, t: Time, params: PyTree, qddot: Vector, terms: Any = 0.0
    ) -> tuple[Vector, Bool[Array, " m"]]:
        """The force τ of M q̈ = F + τ + Gᵀλ, shortest in the metric of M⁻¹, and a flag per constraint that q̈ violates.

        `terms` (m,) are the sizes of the terms of γ, of which rounding is left.
        """
        state = q, qdot, t, params
        if not self.constrained:
            return self.unbalanced_force(q, qdot, qddot, t, params), jnp.zeros(0, bool)
        # λ of the shortest τ is that of the motion by itself: G M⁻¹τ = 0 leaves both equations as they are.
        acceleration, unit = self.acceleration(*state), self.unit(*state)
        left = jnp.abs(self.constraints.products(*state)[0](qddot) - self.constraints.gamma(*state))
        violates = _constraints.exceeds(left, self.row_lengths(unit, *state), terms, unit, qddot, acceleration)
        return self.mass_product(*state)(qddot - acceleration), violates

    def schur_complement(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Float[Array, "m m"]:
        """G M⁻¹ Gᵀ, or G K⁻¹ Gᵀ of the same rank (see `_linear`): its rank is the number of independent constraints."""
        jacobian = self.constraints.jacobian(q, qdot, t, params)
        augmented, _ = _linear.augment(self.mass_matrix(q, qdot, t, params), jacobian)
        return jacobian @ _linear.factorize(augmented).solve_columns(jacobian.T)

    def rank_lost(self, start: tuple, end: tuple) -> Flag:
        """True if fewer constraints are independent at `end` than at `start`, both (q, q̇, t, params)."""
        # Counted are the independent rows of S = G M⁻¹ Gᵀ, with every row of G in units of its length at the start: a
        # gradient that fades away on the way is lost as well.
        first, last = (self.schur_complement(*jax.lax.stop_gradient(state)) for state in (start, end))
        diagonal = jnp.diagonal(first)
        scale = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
        before, after = (_linear.rank(scale[:, None] * schur * scale) for schur in (first, last))
        return jnp.isfinite(last).all() & (after < before)

    # ---- what the constraints ask of a state, in the metric of M ----

    def unit(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The unit 1/√Mᵢᵢ of each coordinate."""
        return _linear.diagonal_scale(self.mass_matrix(q, qdot, t, params))

    def row_lengths(self, unit: Vector, q: Vector, qdot: Vector, t: Time, params: PyTree, positions=False) -> Row:
        """The lengths of the rows of G, or of ∂f/∂q for constraints on `positions`, in the `unit` of coordinates."""
        jacobian = self._jacobian(positions, q, qdot, t, params)
        return jnp.sqrt(jnp.sum((jacobian * unit) ** 2, axis=1))

    def _jacobian(self, positions: bool, q, qdot, t, params) -> Float[Array, "m n"]:
        of = self.constraints
        return jax.jacfwd(of.f)(q, t, params) if positions else of.jacobian(q, qdot, t, params)

    def saddle(self, b: Vector, c: Row, q, qdot, t, params, positions=False) -> tuple[Vector, Row, Flag]:
        """x, λ of M x − Gᵀλ = b, G x = c, and a flag: singular. With `positions`, for the constraints f only."""
        return _linear.saddle(self.mass_matrix(q, qdot, t, params), b, self._jacobian(positions, q, qdot, t, params), c)

    def position_step(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The Newton step δq to f = 0, the shortest in the metric of M: M δq = Jᵀμ, J δq = −f."""
        residual = self.constraints.f(q, t, params)
        return self.saddle(jnp.zeros_like(q), -residual, q, qdot, t, params, positions=True)[0]

    def velocity_step(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Vector:
        """The step δq̇ to consistent velocities, the shortest in the metric of M: M δq̇ = Gᵀμ, G δq̇ = −rates."""
        # One step arrives, as the rates are affine in q̇: for every f, and every a that d'Alembert's principle is for.
        rates = self.constraints.rates(q, qdot, t, params)
        return self.saddle(jnp.zeros_like(q), -rates, q, qdot, t, params)[0]

    def residual(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> Row:
        """The values of the constraints: f, then a."""
        return self.constraints.residual(q, qdot, t, params)

    def projected(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> tuple[Vector, Vector]:
        """(q, q̇) after one Newton step each back to the constraints, the shortest in the metric of M."""
        # Enough after a step of an integration: close to the constraints Newton's method squares the distance.
        if self.constraints.on_positions is not None:
            q = q + self.position_step(q, qdot, t, params)
        return q, qdot + self.velocity_step(q, qdot, t, params)

    def nearest_consistent(self, q: Vector, qdot: Vector, t: Time, params: PyTree, terms=0.0) -> tuple[Vector, Vector]:
        """The consistent state nearest to (q, q̇) in the metric of M; NaN where it is not found."""
        return _constraints.nearest_consistent(self, q, qdot, t, params, terms)

    def solve_newton(self, linear: Callable, right: tuple[Vector, Row], *_) -> tuple[Vector, Row]:
        """The solution (x, ν) of H x + Jᵀν = b, J x = c; `linear` maps (x, ν) to the left sides, `right` = (b, c)."""
        b, c = right
        columns = jax.vmap(lambda x: linear((x, jnp.zeros_like(c))), out_axes=1)
        matrix, jacobian = columns(jnp.eye(b.size, dtype=b.dtype))
        x, multipliers, _ = _linear.saddle(matrix, b, jacobian, c)
        return x, -multipliers

    # ---- all of it ----

    def quantities(self, q: Vector, qdot: Vector, t: Time, params: PyTree) -> dict[str, Array]:
        """All quantities of a single state, by name, from one round of differentiation.

        - `lagrangian` (), `momentum` (n,), `mass_matrix` (n, n), `lagrangian_by_q` (n,), `lagrangian_by_t` (),
          `energy_by_q` (n,).
        - `force` (n,): F of M q̈ = F + Gᵀλ.
        - `given_force` (n,): the user's forces; `dissipation` (1,) or (0,), `dissipation_by_qdot` (n,);
          `nonconservative_force` (n,) = forces − ∂D/∂q̇; `generalized_force` (n,) = ∂L/∂q + forces − ∂D/∂q̇.
        - `jacobian` G (m, n) and `gamma` γ (m,) of G q̈ = γ; `residual` (m,): f, a; `rates` (m,): J q̇ + ∂f/∂t, a;
          `driving` (m,): ∂f/∂t, a(q, 0, t), by which constraints do work. m is zero without constraints.
        - `release` (m,): −1 for a row that is released, else 0; `drag` (n, m). Both are empty where no row ever is.
        """
        state, n = (q, qdot, t, params), q.size
        value, (by_q, momentum, by_t) = jax.value_and_grad(self.lagrangian, argnums=(0, 1, 2))(*state)
        # One linearisation of (∂L/∂q, p) gives M, column by column, the drift (∂p/∂q) q̇ + ∂p/∂t, and (∂p/∂q)ᵀ q̇.
        _, jvp = jax.linearize(lambda *y: jax.grad(self.lagrangian, argnums=(0, 1))(*y, params), q, qdot, t)
        no_change, no_time = jnp.zeros_like(q), jnp.zeros_like(t)
        matrix = jax.vmap(lambda e: jvp(no_change, e, no_time)[1], out_axes=1)(jnp.eye(n, dtype=q.dtype))
        drift = jvp(qdot, no_change, jnp.ones_like(t))[1]
        damping = Motion(self.lagrangian, None, self.dissipation)
        nonconservative = self.nonconservative_force(*state)
        return {
            "lagrangian": value,
            "momentum": momentum,
            "mass_matrix": matrix,
            "lagrangian_by_q": by_q,
            "lagrangian_by_t": by_t,
            "energy_by_q": jvp(no_change, qdot, no_time)[0] - by_q,
            "force": by_q + nonconservative - drift,
            "given_force": jnp.zeros_like(q) if self.forces is None else self.forces(*state),
            "dissipation": jnp.zeros(0, q.dtype) if self.dissipation is None else self.dissipation(*state)[None],
            "dissipation_by_qdot": -damping.nonconservative_force(*state),
            "nonconservative_force": nonconservative,
            "generalized_force": by_q + nonconservative,
            "jacobian": self.constraints.jacobian(*state),
            "gamma": self.constraints.gamma(*state),
            "residual": self.constraints.residual(*state),
            "rates": self.constraints.rates(*state),
            "driving": self.constraints.driving(*state),
            "release": jnp.zeros(0, q.dtype) if self.constraints.held is None else self.constraints.held(params) - 1.0,
            "drag": jnp.zeros((0, 0), q.dtype) if self.constraints.drag is None else self.constraints.drag(*state),
        }
