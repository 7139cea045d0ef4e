"""A `Motion` in JAX whose quantities, and all their derivatives, are evaluated by the scene's scalar programs.

JAX would differentiate L twice more for a derivative of the accelerations, and XLA compile the whole. A program is
differentiated on its graph instead (`_line_functions`), and XLA compiles a call.
"""

import functools
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
    """The motion of a scene by its programs; the motion as written if these cannot be differentiated.

    The programs are lowered when the first quantity is evaluated.
    """
    motion = derivation.motion
    if derivation.form.is_sparse:
        return motion
    constraints = motion.constraints
    if constraints.exist:
        constraints = _LoweredConstraints(**vars(constraints), derivation=derivation)
    functions = motion.lagrangian, motion.forces, motion.dissipation
    return _LoweredMotion(*functions, constraints, derivation=derivation)


def _use_programs(as_written: Callable) -> Callable:
    """A decorator: the method `as_written` is used instead if the programs cannot be differentiated."""

    def decorate(method: Callable) -> Callable:
        @functools.wraps(method)
        def evaluate(self, *state):
            return (method if self.derivation.differentiates else as_written)(self, *state)

        return evaluate

    return decorate


def _program_quantity(as_written: Callable) -> Callable:
    @_use_programs(as_written)
    def evaluate(self, *state):
        return _evaluate_quantities(self.derivation, *state, as_written.__name__)[0]

    return evaluate


class _LoweredConstraints(Constraints):
    derivation: Derivation = eqx.field(static=True, kw_only=True)
    residual, rates = map(_program_quantity, (Constraints.residual, Constraints.rates))
    jacobian, gamma = map(_program_quantity, (Constraints.jacobian, Constraints.gamma))

    @_use_programs(Constraints.f)
    def f(self, q, t, params):
        return self.residual(q, jnp.zeros_like(q), t, params)[: self.derivation.position_count]


class _LoweredMotion(Motion):
    derivation: Derivation = eqx.field(static=True, kw_only=True)
    momentum, mass_matrix = map(_program_quantity, (Motion.momentum, Motion.mass_matrix))
    generalized_force = _program_quantity(Motion.generalized_force)

    @_use_programs(Motion.mass_matrix_and_force)
    def mass_matrix_and_force(self, q, qdot, t, params):
        """M and F of M q̈ = F + Gᵀλ."""
        return tuple(_evaluate_quantities(self.derivation, q, qdot, t, params, "mass_matrix", "force"))

    @_use_programs(Motion.energy)
    def energy(self, q, qdot, t, params):
        momentum, value = _evaluate_quantities(self.derivation, q, qdot, t, params, "momentum", "lagrangian")
        return momentum @ qdot - value

    def unbalanced_force(self, q, qdot, qddot, t, params):
        """The force M q̈ − F, by its own program."""
        if self.derivation.differentiates_force:
            return _program_outputs(self.derivation.unbalanced_force, q, qdot, t, params, qddot)
        return super().unbalanced_force(q, qdot, qddot, t, params)

    def required_force(self, q, qdot, t, params, qddot, terms=0.0):
        """The force τ for an acceleration, and which constraints that violates beyond rounding."""
        state, of = (q, qdot, t, params), self.derivation
        if self.constrained and of.differentiates:
            terms = jax.lax.stop_gradient(_program_outputs(of.term_program(("gamma",)), *state))
        return super().required_force(*state, qddot, terms)

    @_use_programs(Motion.solved_acceleration)
    def solved_acceleration(self, q, qdot, t, params):
        """The acceleration q̈, NaN where its linear system is singular, and a flag for that."""
        try:
            program = self.derivation.accelerations.program.complete
        except Unlowerable:
            return super().solved_acceleration(q, qdot, t, params)
        *acceleration, singular = _program_outputs(program, q, qdot, t, params)
        return jnp.where(singular > 0, jnp.nan, jnp.stack(acceleration)), singular > 0


def _evaluate_quantities(derivation: Derivation, q, qdot, t, params, *names: str) -> list[Array]:
    values = _program_outputs(derivation.program(*names), q, qdot, t, params)
    return list(derivation.split_outputs(names, values).values())


def _program_outputs(program: Program, q, qdot, t, params, *more) -> Array:
    """The outputs (outputs,) of a program of (q, q̇, t, numbers) and further vectors."""
    numbers = jnp.concatenate([jnp.zeros(0, q.dtype), *(jnp.ravel(x).astype(q.dtype) for x in jax.tree.leaves(params))])
    return line_of(program)(q, qdot, jnp.reshape(t, 1).astype(q.dtype), numbers, *more)
