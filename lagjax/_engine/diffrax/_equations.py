"""The first-order system ẏ = f(t, y) that a solver sees, in the form that suits the scene.

A small scene becomes a *scalar program*: the mass matrix is eliminated by formulas written out for exactly its pattern
of zeros, and nothing is left that this scene does not need. Any other scene keeps the derivatives as JAX arrays. Both
forms give the same motion to round-off, and are tested against each other. Each has `acceleration` and, for constrained
scenes, `projected`: y after one Newton step of positions and of velocities back to the constraints. `params` are
numbers.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax._equations import Derivation, Motion
from lagjax._interface import compiled_once, halves
from lagjax._tracing import Program

Vector = Float[Array, " n"]
State = tuple[Vector, Vector]  # q and q̇
Time = Float[Array, ""]
Acceleration = tuple[Vector, Bool[Array, ""]]  # q̈, and whether the matrix that it was solved with is singular: then NaN


class MotionEquations(eqx.Module):
    """The acceleration and the projection of a scene, functions of (q, q̇, t, params), each traced once."""

    motion: Motion = eqx.field(static=True)
    accelerate: Any = eqx.field(static=True)
    project: Any = eqx.field(static=True)

    @classmethod
    def from_arrays(cls, motion: Motion) -> "MotionEquations":
        return cls(motion, compiled_once(motion.solved_acceleration), compiled_once(motion.projected))

    @classmethod
    def from_programs(cls, motion: Motion, program: Program, projection: Program | None) -> "MotionEquations":
        """The equations by programs of q, q̇, t and every number in params: `Accelerations.program`, `projected`."""

        def accelerate(q, qdot, t, params):
            *acceleration, singular = program(*q, *qdot, t, *_scalar_equations(params))
            return jnp.stack(acceleration), singular

        def project(q, qdot, t, params):
            assert projection is not None
            return halves(jnp.stack(projection(*q, *qdot, t, *_scalar_equations(params))))

        return cls(motion, compiled_once(accelerate), compiled_once(project))

    @property
    def constrained(self) -> bool:
        return self.motion.constrained

    def projected(self, t: Time, y: State, params: PyTree) -> State:
        return self.project(*y, t, params)

    def acceleration(self, t: Time, y: State, params: PyTree) -> Acceleration:
        return self.accelerate(*y, t, params)


def equations_of(derivation: Derivation) -> MotionEquations:
    """The equations of a scene in the form that XLA compiles; `ValueError` where its path is an impossible "scalar"."""
    if derivation.form_in_xla.kind != "scalar":
        return MotionEquations.from_arrays(derivation.motion)
    of = derivation.accelerations
    return MotionEquations.from_programs(derivation.motion, of.program.complete, of.projected)


def _scalar_equations(params: PyTree) -> list[jax.Array]:
    return [x for leaf in jax.tree.leaves(params) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]
