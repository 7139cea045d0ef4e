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

    def quantities(self, q, qdot, t, params) -> dict[str, jax.Array]:
        """Everything that is asked of a single state, by name, from one round of differentiation.

        - `lagrangian` (), `momentum` (n,), `mass_matrix` (n, n), `lagrangian_by_q` (n,), `lagrangian_by_t` (),
          `energy_by_q` (n,).
        - `force` (n,): the right-hand side of M q̈ = F.
        - `given_force` (n,): the user's forces; `dissipation` (1,) or (0,), `dissipation_by_qdot` (n,);
          `nonconservative_force` (n,) = forces − ∂D/∂q̇; `generalized_force` (n,) = ∂L/∂q + forces − ∂D/∂q̇.
        - `jacobian` G (m, n) and `target` γ (m,) of G q̈ = γ; `residual` (m,): f, a; `rates` (m,): J q̇ + ∂f/∂t, a;
          `driving` (m,): ∂f/∂t, a(q, 0, t), by which constraints do work. m is zero without constraints.
        """
        state, n = (q, qdot, t, params), q.size
        value, (by_q, momentum, by_t) = jax.value_and_grad(self.lagrangian, argnums=(0, 1, 2))(*state)
        # One linearisation of (∂L/∂q, p) gives M, column by column, the drift (∂p/∂q) q̇ + ∂p/∂t, and (∂p/∂q)ᵀ q̇.
        _, push = jax.linearize(lambda *y: jax.grad(self.lagrangian, argnums=(0, 1))(*y, params), q, qdot, t)
        still, now = jnp.zeros_like(q), jnp.zeros_like(t)
        matrix = jax.vmap(lambda e: push(still, e, now)[1], out_axes=1)(jnp.eye(n, dtype=q.dtype))
        drift = push(qdot, still, jnp.ones_like(t))[1]
        damped = Motion(self.lagrangian, None, self.dissipation)
        nonconservative = self.nonconservative_force(*state)
        nothing = jnp.zeros(0, q.dtype)
        jacobian, target = self.rows_and_targets(*state) if self.constrained else (jnp.zeros((0, n), q.dtype), nothing)
        return {
            "lagrangian": value,
            "momentum": momentum,
            "mass_matrix": matrix,
            "lagrangian_by_q": by_q,
            "lagrangian_by_t": by_t,
            "energy_by_q": push(still, qdot, now)[0] - by_q,
            "force": by_q + nonconservative - drift,
            "given_force": jnp.zeros_like(q) if self.forces is None else self.forces(*state),
            "dissipation": nothing if self.dissipation is None else self.dissipation(*state)[None],
            "dissipation_by_qdot": -damped.nonconservative_force(*state),
            "nonconservative_force": nonconservative,
            "generalized_force": by_q + nonconservative,
            "jacobian": jacobian,
            "target": target,
            "residual": self.residual(*state) if self.constrained else nothing,
            "rates": self.rates(*state) if self.constrained else nothing,
            "driving": self.driving(*state),
        }

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

    def coupling(self, q, qdot, t, params) -> jax.Array:
        """G M⁻¹ Gᵀ, or another matrix of the same rank where M is singular: which constraints are independent."""
        return _linear.coupling(self.mass_matrix(q, qdot, t, params), self.rows_and_targets(q, qdot, t, params)[0])

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
        rows, _ = self.rows_and_targets(q, qdot, t, params)
        return self.mass_matrix(q, qdot, t, params), rows, -self.rates(q, qdot, t, params)

    def rates(self, q, qdot, t, params) -> jax.Array:
        """J q̇ + ∂f/∂t, then a: what must be zero of the velocities, shape (m,)."""
        forward, left = (qdot, jnp.ones_like(t)), []
        if self.constraints is not None:
            left.append(jax.jvp(lambda q, t: self.constraints(q, t, params), (q, t), forward)[1])
        if self.velocity_constraints is not None:
            left.append(self.velocity_constraints(q, qdot, t, params))
        return jnp.concatenate(left)

    def driving(self, q, qdot, t, params) -> jax.Array:
        """∂f/∂t, then a(q, 0, t), shape (m,): constraints whose driving is zero do no work."""
        parts = [jnp.zeros(0, q.dtype)]
        if self.constraints is not None:
            parts.append(jax.jvp(lambda t: self.constraints(q, t, params), (t,), (jnp.ones_like(t),))[1])
        if self.velocity_constraints is not None:
            parts.append(self.velocity_constraints(q, jnp.zeros_like(qdot), t, params))
        return jnp.concatenate(parts)

    def projected(self, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
        """(q, q̇) after one Newton step of each kind: enough near the constraints, where it squares the distance."""
        if self.constraints is not None:
            matrix, rows, target = self.position_saddle(q, qdot, t, params)
            q = q + _linear.saddle(matrix, jnp.zeros_like(q), rows, target)[0]
        matrix, rows, target = self.velocity_saddle(q, qdot, t, params)
        return q, qdot + _linear.saddle(matrix, jnp.zeros_like(q), rows, target)[0]

    def speeds(self, q, qdot, t, params) -> jax.Array:
        """The `velocity_scales` of a state, shape (n,)."""
        matrix, rows, _ = self.velocity_saddle(q, qdot, t, params)
        return velocity_scales(matrix, rows, qdot)

    def acceleration(self, q, qdot, t, params) -> jax.Array:
        """q̈ from M q̈ = ∂L/∂q − (∂p/∂q) q̇ − ∂p/∂t + Q."""
        return self.solved_acceleration(q, qdot, t, params)[0]

    def energy(self, q, qdot, t, params) -> jax.Array:
        """h = p·q̇ − L, with dh/dt = −∂L/∂t + Q·q̇ along the motion."""
        return self.momentum(q, qdot, t, params) @ qdot - self.lagrangian(q, qdot, t, params)

    def energy_and_momenta(self, momenta: tuple[int, ...], q, qdot, t, params) -> jax.Array:
        """h, then p of the coordinates `momenta`, shape (1 + len(momenta),): what may be conserved."""
        momentum = self.momentum(q, qdot, t, params)
        energy = momentum @ qdot - self.lagrangian(q, qdot, t, params)
        return jnp.concatenate([energy[None], momentum[jnp.asarray(momenta, int)]])


def velocity_scales(matrix, rows, qdot) -> jax.Array:
    """By which to measure an error of q̇ᵢ that the others cause through the constraints, (n,): zero if they cannot.

    A term of a constraint, Gⱼ q̇ⱼ, is as large as the speed |Gⱼ q̇ⱼ / Gᵢ| of coordinate i, and a kinetic energy as
    large as the speed √(Mⱼⱼ/Mᵢᵢ) |q̇ⱼ|. The smallest of the constraints' speeds counts, if it is not above the
    energy's, where Gᵢ happens to pass through zero. A coupler that does not turn, for instance, is as exact as the
    cranks that carry it, and not relative to its own speed, which is rounding.
    """
    by_constraints = jnp.min(_largest_term(rows * qdot, rows), axis=0)
    root = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))[None]
    by_energy = _largest_term(root * qdot, root)[0]
    return jnp.where(by_constraints < jnp.inf, jnp.minimum(by_constraints, by_energy), 0.0)


def _largest_term(terms, weights):
    """The largest term of every row, divided by the weights in it; infinite where a weight is zero."""
    there = weights != 0
    largest = jnp.max(jnp.abs(terms), axis=1, keepdims=True)
    return jnp.where(there, largest / jnp.abs(jnp.where(there, weights, 1.0)), jnp.inf)


_NEWTON_STEPS = 50


def nearest_consistent(motion: Motion, q, qdot, t, params) -> tuple[jax.Array, jax.Array]:
    """The state with f = 0 that is nearest in the metric of M there, and of its velocities those nearest to q̇.

    Nearest to q0 in the metric of M = M(q0, q̇0) is where M (q − q0) = Jᵀμ and f = 0, found by Newton's method for both
    (sequential quadratic programming: Nocedal & Wright, *Numerical Optimization*, §18.1) from where shortest steps to
    f = 0 alone arrive. NaN where either does not, or where it arrives farther away. The loops find the place; one more
    step outside of them has the derivative of the implicit function.
    """
    if motion.constraints is not None:
        held = jax.lax.stop_gradient((q, qdot, t, params))
        place = jax.lax.stop_gradient(_nearest(motion, *held))
        q = _step_to_nearest(motion, place, q, qdot, t, params)[0]
    matrix, rows, target = motion.velocity_saddle(q, qdot, t, params)
    step = _linear.saddle(matrix, jnp.zeros_like(q), rows, target)[0]
    met = _met(target - rows @ step, rows, qdot + step)
    return q, jnp.where(met, qdot + step, jnp.nan)


def _nearest(motion: Motion, q0, *state):
    """q and μ, as numbers."""

    def distance(q):
        return jnp.sqrt((q - q0) @ metric @ (q - q0))

    metric, nothing = motion.mass_matrix(q0, *state), jnp.zeros_like(motion.constraints(q0, *state[1:]))
    on_it, _ = _repeated(lambda place: _step_to_nearest(motion, (place[0], nothing), place[0], *state), (q0, nothing))
    q, multipliers = _repeated(lambda place: _step_to_nearest(motion, place, q0, *state), (on_it, nothing))
    # Another stationary point is no answer. On the constraints both distances are round-off.
    farther = distance(q) > 1.001 * distance(on_it) + distance(q0 + _small(q0))
    met = _met(motion.constraints(q, *state[1:]), jax.jacfwd(motion.constraints)(q, *state[1:]), q)
    return jnp.where(met & ~farther, q, jnp.nan), multipliers


def _repeated(step, place):
    """`step` until q does not move any more; NaN where that does not come about."""

    def going(carry):
        (q, _), moved, count = carry
        return (moved > _small(q)) & (count < _NEWTON_STEPS)

    def once(carry):
        place, _, count = carry
        new = step(place)
        return new, jnp.max(jnp.abs(new[0] - place[0])), count + 1

    start = place, jnp.asarray(jnp.inf, place[0].dtype), 0
    (q, multipliers), moved, _ = jax.lax.while_loop(going, once, start)
    return jnp.where(moved <= _small(q), q, jnp.nan), multipliers


def _met(left, rows, state):
    """Whether constraints hold, and steps did not just become small between some that contradict each other."""
    lengths, eps = jnp.sqrt(jnp.sum(rows**2, axis=1)), jnp.finfo(left.dtype).eps
    allowed = jnp.sqrt(eps) * lengths + 100 * eps * jnp.max(lengths)  # the second where a gradient vanishes
    return jnp.all(jnp.abs(left) <= allowed * (1 + jnp.max(jnp.abs(state))))


def _small(q):
    return 16 * jnp.finfo(q.dtype).eps * (1 + jnp.max(jnp.abs(q)))


def _step_to_nearest(motion: Motion, place, q0, qdot, t, params):
    """(q, μ) after one step of Newton's method for M (q − q0) = Jᵀμ, f = 0."""

    def work(q):
        return motion.constraints(q, t, params) @ place[1]

    q, metric = place[0], motion.mass_matrix(q0, qdot, t, params)
    rows, off = jax.jacfwd(motion.constraints)(q, t, params), motion.constraints(q, t, params)
    step, multipliers, _ = _linear.saddle(metric - jax.hessian(work)(q), metric @ (q0 - q), rows, -off)
    return q + step, multipliers
