"""The equations of motion of a scene, derived from its Lagrangian by automatic differentiation.

    p = ∂L/∂q̇        M = ∂²L/∂q̇²        M q̈ = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q        h = p·q̇ − L

Q are the generalised forces that no potential gives, and minus the velocity gradient of the Rayleigh dissipation
function. L may be any smooth function: nothing here assumes T − U. Everything is flat: q and q̇ are vectors of n
coordinates. This is the only module that differentiates a Lagrangian.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from lagjax import _linear


class Motion(eqx.Module):
    """A scene in flat coordinates; every function takes (q, qdot, t, params), q and qdot of shape (n,)."""

    lagrangian: Callable
    forces: Callable | None
    dissipation: Callable | None

    def momentum(self, q, qdot, t, params) -> jax.Array:
        """p = ∂L/∂q̇."""
        return jax.grad(self.lagrangian, argnums=1)(q, qdot, t, params)

    def mass_matrix(self, q, qdot, t, params) -> jax.Array:
        """M = ∂²L/∂q̇², shape (n, n)."""
        return jax.hessian(self.lagrangian, argnums=1)(q, qdot, t, params)

    def nonconservative_force(self, q, qdot, t, params) -> jax.Array:
        """Q = forces − ∂D/∂q̇."""
        force = jnp.zeros_like(q)
        if self.forces is not None:
            force += self.forces(q, qdot, t, params)
        if self.dissipation is not None:
            force -= jax.grad(self.dissipation, argnums=1)(q, qdot, t, params)
        return force

    def generalized_force(self, q, qdot, t, params) -> jax.Array:
        """∂L/∂q + Q, which is dp/dt along the motion."""
        return jax.grad(self.lagrangian)(q, qdot, t, params) + self.nonconservative_force(q, qdot, t, params)

    def mass_matrix_and_force(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
        """M and the right-hand side of M q̈ = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q."""

        def momentum_along(q, t):
            return self.momentum(q, qdot, t, params)

        # (∂p/∂q) q̇ + ∂p/∂t is how p changes while q moves and q̇ does not: one directional derivative.
        _, drift = jax.jvp(momentum_along, (q, t), (qdot, jnp.ones_like(t)))
        return self.mass_matrix(q, qdot, t, params), self.generalized_force(q, qdot, t, params) - drift

    def solved_acceleration(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
        """q̈, and whether the mass matrix it was solved with is singular (q̈ is NaN where it is)."""
        matrix, force = self.mass_matrix_and_force(q, qdot, t, params)
        mass = _linear.factorize(matrix)
        return mass.solve(force), mass.singular

    def acceleration(self, q, qdot, t, params) -> jax.Array:
        """q̈ from M q̈ = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q."""
        return self.solved_acceleration(q, qdot, t, params)[0]

    def energy(self, q, qdot, t, params) -> jax.Array:
        """h = p·q̇ − L, with dh/dt = −∂L/∂t + Q·q̇ along the motion."""
        return self.momentum(q, qdot, t, params) @ qdot - self.lagrangian(q, qdot, t, params)
