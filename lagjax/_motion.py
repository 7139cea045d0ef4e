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
    constraints: Callable | None = None  # (q, t, params) to a vector
    velocity_constraints: Callable | None = None  # (q, qdot, t, params) to a vector

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
        """q̈, and whether the matrix it was solved with is singular (q̈ is NaN where it is)."""
        matrix, force = self.mass_matrix_and_force(q, qdot, t, params)
        if self.constrained:
            acceleration, _, singular = _linear.saddle(matrix, force, *self.rows_and_targets(q, qdot, t, params))
            return acceleration, singular
        mass = _linear.factorize(matrix)
        return mass.solve(force), mass.singular

    # ---- constraints: f(q, t) = 0 and a(q, q̇, t) = 0, differentiated until q̈ appears in G q̈ = c ----

    @property
    def constrained(self) -> bool:
        """Whether there are any."""
        return self.constraints is not None or self.velocity_constraints is not None

    def rows_and_targets(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
        """G and c: J = ∂f/∂q with −(d²f/dt² without q̈), then A = ∂a/∂q̇ with −(da/dt without q̈)."""
        rows, targets, forward = [], [], (qdot, jnp.ones_like(t))
        if self.constraints is not None:

            def rate(q, t):
                return jax.jvp(lambda q, t: self.constraints(q, t, params), (q, t), forward)[1]

            rows.append(jax.jacfwd(self.constraints)(q, t, params))
            targets.append(-jax.jvp(rate, (q, t), forward)[1])
        if self.velocity_constraints is not None:
            rows.append(jax.jacfwd(self.velocity_constraints, argnums=1)(q, qdot, t, params))
            drift = jax.jvp(lambda q, t: self.velocity_constraints(q, qdot, t, params), (q, t), forward)[1]
            targets.append(-drift)
        return jnp.concatenate(rows), jnp.concatenate(targets)

    def multipliers(self, q, qdot, t, params) -> jax.Array:
        """λ, those of `constraints` first; Gᵀλ is the force of the constraints. Of least norm where G is redundant."""
        matrix, force = self.mass_matrix_and_force(q, qdot, t, params)
        return _linear.saddle(matrix, force, *self.rows_and_targets(q, qdot, t, params))[1]

    def constraint_force(self, q, qdot, t, params) -> jax.Array:
        """Gᵀλ."""
        return self.rows_and_targets(q, qdot, t, params)[0].T @ self.multipliers(q, qdot, t, params)

    def residual(self, q, qdot, t, params) -> jax.Array:
        """f, then a."""
        held = [] if self.constraints is None else [self.constraints(q, t, params)]
        if self.velocity_constraints is not None:
            held.append(self.velocity_constraints(q, qdot, t, params))
        return jnp.concatenate(held)

    def position_saddle(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array, jax.Array]:
        """M, J and −f: one Newton step δq back to f = 0, shortest in the metric of M, solves M δq = Jᵀμ, J δq = −f."""
        rows = jax.jacfwd(self.constraints)(q, t, params)
        return self.mass_matrix(q, qdot, t, params), rows, -self.constraints(q, t, params)

    def velocity_saddle(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array, jax.Array]:
        """M, G and minus what is left of J q̇ + ∂f/∂t and a: the same for the velocities."""
        forward, left = (qdot, jnp.ones_like(t)), []
        if self.constraints is not None:
            left.append(jax.jvp(lambda q, t: self.constraints(q, t, params), (q, t), forward)[1])
        if self.velocity_constraints is not None:
            left.append(self.velocity_constraints(q, qdot, t, params))
        rows, _ = self.rows_and_targets(q, qdot, t, params)
        return self.mass_matrix(q, qdot, t, params), rows, -jnp.concatenate(left)

    def projected(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
        """(q, q̇) after one Newton step of each kind: enough near the constraints, where it squares the distance."""
        if self.constraints is not None:
            matrix, rows, target = self.position_saddle(q, qdot, t, params)
            q = q + _linear.saddle(matrix, jnp.zeros_like(q), rows, target)[0]
        matrix, rows, target = self.velocity_saddle(q, qdot, t, params)
        return q, qdot + _linear.saddle(matrix, jnp.zeros_like(q), rows, target)[0]

    def acceleration(self, q, qdot, t, params) -> jax.Array:
        """q̈ from M q̈ = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q."""
        return self.solved_acceleration(q, qdot, t, params)[0]

    def energy(self, q, qdot, t, params) -> jax.Array:
        """h = p·q̇ − L, with dh/dt = −∂L/∂t + Q·q̇ along the motion."""
        return self.momentum(q, qdot, t, params) @ qdot - self.lagrangian(q, qdot, t, params)


_NEWTON_STEPS = 50


def projected_until_consistent(motion: Motion, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
    """`Motion.projected` from anywhere near; NaN where Newton's method does not arrive.

    The loop finds the place; its last step is taken once more outside of it, which is where derivatives come from: one
    Newton step from a root has the derivative of the implicit function.
    """
    held = jax.lax.stop_gradient((q, qdot))

    def small(q, qdot):
        eps = jnp.finfo(q.dtype).eps
        return 16 * eps * (1 + jnp.sqrt(jnp.sum(q**2) + jnp.sum(qdot**2)))

    def going(carry):
        state, step, count = carry
        return (step > small(*state)) & (count < _NEWTON_STEPS)

    def once(carry):
        state, _, count = carry
        new = motion.projected(*state, t, jax.lax.stop_gradient(params))
        step = jnp.sqrt(sum(jnp.sum((a - b) ** 2) for a, b in zip(new, state, strict=True)))
        return new, step, count + 1

    found, step, _ = jax.lax.while_loop(going, once, (held, jnp.asarray(jnp.inf, q.dtype), 0))
    arrived = step <= small(*found)
    # Where the loop went is a constant; how it depends on the start is kept by adding what stop_gradient took.
    start = (found[0] + (q - held[0]), found[1] + (qdot - held[1]))
    return tuple(jnp.where(arrived, x, jnp.nan) for x in motion.projected(*start, t, params))
