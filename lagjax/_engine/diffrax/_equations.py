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
from lagjax._interface import compiled_once
from lagjax._program import Program, Unlowerable

PyTree = Any
Vector = Float[Array, " n"]
State = tuple[Vector, Vector]  # q and q̇
Time = Float[Array, ""]
Acceleration = tuple[Vector, Bool[Array, ""]]  # q̈, and whether the matrix that it was solved with is singular: then NaN

# Operations of a program beyond which XLA takes longer to compile it than it saves, and batched elimination on arrays
# overtakes written-out elimination: measured on chains of pendulums, where it lies at 12 links.
LARGEST_XLA_PROGRAM = 2_000


class ArrayEquations(eqx.Module):
    """The equations with M, F, G and γ as JAX arrays; `reason` says why the scene has no scalar program in use."""

    motion: Motion = eqx.field(static=True)
    accelerate: Any = eqx.field(static=True)
    project: Any = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    def __init__(self, motion: Motion, reason: str):
        self.motion, self.reason = motion, reason
        # Traced once, however often they are called.
        self.accelerate, self.project = compiled_once(motion.solved_acceleration), compiled_once(motion.projected)

    @property
    def constrained(self) -> bool:
        return self.motion.constrained

    def projected(self, t: Time, y: State, params: PyTree) -> State:
        return self.project(*y, t, params)

    def acceleration(self, t: Time, y: State, params: PyTree) -> Acceleration:
        return self.accelerate(*y, t, params)


class ScalarEquations(eqx.Module):
    """The equations as scalar programs, whose inputs are q, q̇, t and every number in params."""

    motion: Motion = eqx.field(static=True)
    program: Program = eqx.field(static=True)  # q̈, and whether its matrix is singular
    projection: Program | None = eqx.field(static=True)  # (q, q̇) after a step back to the constraints
    accelerate: Any = eqx.field(static=True)
    project: Any = eqx.field(static=True)

    def __init__(self, motion: Motion, program: Program, projection: Program | None = None):
        self.motion, self.program, self.projection = motion, program, projection
        self.accelerate = compiled_once(program)
        self.project = None if projection is None else compiled_once(projection)

    @property
    def constrained(self) -> bool:
        return self.projection is not None

    def projected(self, t: Time, y: State, params: PyTree) -> State:
        state = self.project(*y[0], *y[1], t, *_scalars(params))
        return jnp.stack(state[: len(state) // 2]), jnp.stack(state[len(state) // 2 :])

    def acceleration(self, t: Time, y: State, params: PyTree) -> Acceleration:
        *acceleration, singular = self.accelerate(*y[0], *y[1], t, *_scalars(params))
        return jnp.stack(acceleration), singular


MotionEquations = ScalarEquations | ArrayEquations


def form_of(derivation: Derivation, path: str = "auto") -> MotionEquations:
    """The form of its equations that suits a scene, or that `path` names; `ValueError` where "scalar" is impossible."""
    motion = derivation.motion
    if path == "array":
        return ArrayEquations(motion, "asked for")
    try:
        program = derivation.acceleration.complete
    except Unlowerable as reason:
        if path == "scalar":
            raise ValueError(f"This scene has no scalar program: {reason}. Leave `path` at 'auto'.") from None
        return ArrayEquations(motion, str(reason))
    if path == "auto" and program.looks_up:  # whose inputs would be the entries of tables, one by one
        return ArrayEquations(motion, "it looks up entries of tables")
    if path == "auto" and derivation.has_rules:  # of which a program keeps the first two derivatives alone
        return ArrayEquations(motion, "a function has rules of its own for its derivatives")
    if path == "auto" and program.operations > LARGEST_XLA_PROGRAM:
        reason = f"{program.operations} operations are more than the {LARGEST_XLA_PROGRAM} that XLA compiles quickly"
        return ArrayEquations(motion, reason)
    return ScalarEquations(motion, program, derivation.projected)


def _scalars(params: PyTree) -> list[jax.Array]:
    return [x for leaf in jax.tree.leaves(params) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]
