"""A scene in JAX whose quantities, and all their derivatives, are those of its scalar programs.

JAX would differentiate L twice more for a derivative of the accelerations, and XLA compile the whole. A program is
differentiated on its graph instead (`_line_functions`), and XLA compiles a call.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lagjax._engine.taylor._line_functions import line_of
from lagjax._equations import Constraints, Derivation, Motion
from lagjax._program import Unlowerable
from lagjax._tracing import Program


def lowered_motion(derivation: Derivation) -> Motion:
    """The motion of a scene by its programs; as the scene is written where it has none that may be differentiated."""
    motion = derivation.motion
    if not derivation.differentiates:
        return motion
    constraints = motion.constraints
    if constraints.exist:
        constraints = _LoweredConstraints(constraints.on_positions, constraints.on_velocities, derivation=derivation)
    functions = motion.lagrangian, motion.forces, motion.dissipation
    return _LoweredMotion(*functions, constraints, derivation=derivation)


def _quantity(name: str) -> Callable:
    def evaluate(self, q, qdot, t, params):
        return _evaluate(self.derivation, q, qdot, t, params, name)[0]

    return evaluate


class _LoweredConstraints(Constraints):
    derivation: Derivation = eqx.field(static=True, kw_only=True)
    residual, rates, jacobian, gamma = map(_quantity, ("residual", "rates", "jacobian", "gamma"))

    def f(self, q, t, params):
        return self.residual(q, jnp.zeros_like(q), t, params)[: self.derivation.position_count]


class _LoweredMotion(Motion):
    derivation: Derivation = eqx.field(static=True, kw_only=True)
    momentum, mass_matrix, generalized_force = map(_quantity, ("momentum", "mass_matrix", "generalized_force"))

    def mass_matrix_and_force(self, q, qdot, t, params):
        """M and F of M q̈ = F + Gᵀλ."""
        return tuple(_evaluate(self.derivation, q, qdot, t, params, "mass_matrix", "force"))

    def energy(self, q, qdot, t, params):
        momentum, value = _evaluate(self.derivation, q, qdot, t, params, "momentum", "lagrangian")
        return momentum @ qdot - value

    def solved_acceleration(self, q, qdot, t, params):
        """q̈, NaN where its matrix is singular, and whether that is so."""
        try:
            program = self.derivation.acceleration.complete
        except Unlowerable:
            return super().solved_acceleration(q, qdot, t, params)
        *acceleration, singular = _outputs(program, q, qdot, t, params)
        return jnp.where(singular > 0, jnp.nan, jnp.stack(acceleration)), singular > 0


def _evaluate(derivation: Derivation, q, qdot, t, params, *names: str) -> list[Array]:
    values = _outputs(derivation.program(*names), q, qdot, t, params)
    return list(derivation.split_outputs(names, values).values())


def _outputs(program: Program, q, qdot, t, params) -> Array:
    """The outputs of a program of (q, q̇, t, numbers), (outputs,)."""
    numbers = jnp.concatenate([jnp.zeros(0, q.dtype), *(jnp.ravel(x).astype(q.dtype) for x in jax.tree.leaves(params))])
    return line_of(program)(q, qdot, jnp.reshape(t, 1).astype(q.dtype), numbers)
