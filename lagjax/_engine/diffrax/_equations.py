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
from jaxtyping import Array, Bool, Float

from lagjax._equations import Derivation, Motion
from lagjax._interface import compiled_once, halves
from lagjax._program import Unlowerable
from lagjax._tracing import Program

PyTree = Any
Vector = Float[Array, " n"]
State = tuple[Vector, Vector]  # q and q̇
Time = Float[Array, ""]
Acceleration = tuple[Vector, Bool[Array, ""]]  # q̈, and whether the matrix that it was solved with is singular: then NaN

# Operations of a program beyond which XLA takes longer to compile it than it saves, and batched elimination on arrays
# overtakes written-out elimination: measured on chains of pendulums, where it lies at 12 links.
LARGEST_XLA_PROGRAM = 2_000


class MotionEquations(eqx.Module):
    """The equations of a scene by two functions of (q, q̇, t, params), each traced once, however often it is called.

    `reason` says why they are M, F, G and γ as JAX arrays; it is None for scalar programs.
    """

    motion: Motion = eqx.field(static=True)
    accelerate: Any = eqx.field(static=True)
    project: Any = eqx.field(static=True)
    reason: str | None = eqx.field(static=True)

    @classmethod
    def from_arrays(cls, motion: Motion, reason: str) -> "MotionEquations":
        return cls(motion, compiled_once(motion.solved_acceleration), compiled_once(motion.projected), reason)

    @classmethod
    def from_programs(cls, motion: Motion, program: Program, projection: Program | None) -> "MotionEquations":
        """The equations by programs of q, q̇, t and every number in params: `Derivation.acceleration`, `projected`."""

        def accelerate(q, qdot, t, params):
            *acceleration, singular = program(*q, *qdot, t, *_scalars(params))
            return jnp.stack(acceleration), singular

        def project(q, qdot, t, params):
            assert projection is not None
            return halves(jnp.stack(projection(*q, *qdot, t, *_scalars(params))))

        return cls(motion, compiled_once(accelerate), compiled_once(project), None)

    @property
    def constrained(self) -> bool:
        return self.motion.constrained

    def projected(self, t: Time, y: State, params: PyTree) -> State:
        return self.project(*y, t, params)

    def acceleration(self, t: Time, y: State, params: PyTree) -> Acceleration:
        return self.accelerate(*y, t, params)


def form_of(derivation: Derivation, path: str = "auto") -> MotionEquations:
    """The form of its equations that suits a scene, or that `path` names; `ValueError` where "scalar" is impossible."""
    motion = derivation.motion
    if path == "array":
        return MotionEquations.from_arrays(motion, "asked for")
    try:
        program = derivation.acceleration.complete
    except Unlowerable as reason:
        if path == "scalar":
            raise ValueError(f"This scene has no scalar program: {reason}. Leave `path` at 'auto'.") from None
        return MotionEquations.from_arrays(motion, str(reason))
    if path == "auto" and program.looks_up:  # whose inputs would be the entries of tables, one by one
        return MotionEquations.from_arrays(motion, "it looks up entries of tables")
    if path == "auto" and derivation.counts_on_params:  # which may be traced here
        return MotionEquations.from_arrays(motion, "its mass matrix may need pivoting")
    if path == "auto" and derivation.has_rules:  # of which a program keeps the first two derivatives alone
        return MotionEquations.from_arrays(motion, "a function has rules of its own for its derivatives")
    if path == "auto" and program.operations > LARGEST_XLA_PROGRAM:
        reason = f"{program.operations} operations are more than the {LARGEST_XLA_PROGRAM} that XLA compiles quickly"
        return MotionEquations.from_arrays(motion, reason)
    return MotionEquations.from_programs(motion, program, derivation.projected)


def _scalars(params: PyTree) -> list[jax.Array]:
    return [x for leaf in jax.tree.leaves(params) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]
