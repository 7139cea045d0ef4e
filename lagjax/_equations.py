"""The first-order system ẏ = f(t, y) that a solver sees, in the form that suits the scene.

A small scene becomes a *scalar program*: the mass matrix is eliminated by formulas written out for exactly its pattern
of zeros, and nothing is left that this scene does not need. Any other scene keeps the derivatives as JAX arrays. Both
forms give the same motion to round-off, and are tested against each other.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata

from lagjax import _linear
from lagjax._layout import Layout
from lagjax._motion import Motion
from lagjax._program import Program, Unlowerable, lower

PyTree = Any
State = tuple[jax.Array, jax.Array]

# A larger scene is not even looked at: most of the work of reducing it would be thrown away.
LARGEST_SCALAR_SCENE = 64
OPERATION_BUDGET = 20_000
# Beyond this XLA takes longer to compile a program than it saves, and batched Cholesky or LU overtakes written-out
# elimination (measured on chains of pendulums, where it lies at 12 links).
LARGEST_XLA_PROGRAM = 2_000


class Equations(eqx.Module):
    """ẏ = f(t, y, params) with y = (q, qdot), two vectors."""

    @abc.abstractmethod
    def acceleration(self, t: jax.Array, y: State, params: PyTree) -> tuple[jax.Array, jax.Array]:
        """q̈, and whether the mass matrix is singular there (q̈ is then not finite)."""

    def vector_field(self, t: jax.Array, y: State, params: PyTree) -> State:
        """(q̇, q̈)."""
        return y[1], self.acceleration(t, y, params)[0]


class ArrayEquations(Equations):
    """Derivatives as JAX arrays; `reason` says why."""

    derived: Any = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    def __init__(self, motion: Motion, reason: str):
        self.derived = jax.jit(motion.solved_acceleration)  # traced once, however often it is called
        self.reason = reason

    def acceleration(self, t, y, params):
        """By `Motion.solved_acceleration`."""
        return _compiled_once(self.derived, *y, t, params)


class ScalarEquations(Equations):
    """A scalar program for q̈: inputs q, q̇, t and every number in params; outputs q̈ and whether M is singular."""

    program: Program = eqx.field(static=True)
    called: Any = eqx.field(static=True)

    def __init__(self, program: Program):
        self.program, self.called = program, jax.jit(program.__call__)

    def acceleration(self, t, y, params):
        """By the program."""
        *acceleration, singular = _compiled_once(self.called, *y[0], *y[1], t, *_scalars(params))
        return jnp.stack(acceleration), singular


def equations(motion: Motion, layout: Layout, params: PyTree, path: str = "auto") -> Equations:
    """The form that suits the scene; `path` "scalar" or "array" insists on one.

    Raises `ValueError` when "scalar" is asked for and impossible, with the reason.
    """
    if path == "array":
        return ArrayEquations(motion, "asked for")
    try:
        program = scalar_program(motion, layout, params)
    except Unlowerable as reason:
        if path == "scalar":
            raise ValueError(f"This scene has no scalar program: {reason}.") from None
        return ArrayEquations(motion, str(reason))
    if path == "auto" and program.operations > LARGEST_XLA_PROGRAM:
        reason = f"{program.operations} operations are more than the {LARGEST_XLA_PROGRAM} that XLA compiles quickly"
        return ArrayEquations(motion, reason)
    return ScalarEquations(program)


def scalar_program(motion: Motion, layout: Layout, params: PyTree) -> Program:
    """q̈ and the singularity of M as one program: first M and the forces, then the elimination their zeros allow.

    Its inputs are q, q̇, t and every number in params. Raises `Unlowerable` with the reason.
    """
    n = layout.size
    if n > LARGEST_SCALAR_SCENE:
        raise Unlowerable(f"it has {n} coordinates, more than {LARGEST_SCALAR_SCENE}")
    q, t = jax.ShapeDtypeStruct((n,), layout.dtype), jax.ShapeDtypeStruct((), layout.dtype)
    parts = lower(motion.mass_matrix_and_force, q, q, t, params, budget=OPERATION_BUDGET)

    def accelerations(*scalars):
        values = parts(*scalars)
        matrix = [[values[n * i + j] for j in range(n)] for i in range(n)]
        x, singular = _linear.eliminate(matrix, list(values[n * n :]), _zeros(parts, n), layout.dtype)
        return *x, singular

    _require_definite(parts, n)
    scalars = [jax.ShapeDtypeStruct((), layout.dtype)] * (2 * n + 1) + [
        jax.ShapeDtypeStruct((), leaf.dtype) for leaf in jax.tree.leaves(params) for _ in range(leaf.size)
    ]
    return lower(accelerations, *scalars, budget=OPERATION_BUDGET)


def _zeros(parts: Program, n: int) -> np.ndarray:
    """Which entries of M are zero whatever the state."""
    return np.array([[parts.constant(n * i + j) == 0 for j in range(n)] for i in range(n)])


def _require_definite(parts: Program, n: int) -> None:
    """Elimination without pivoting is for positive definite M; look at a few states whether this M can be.

    The choice is between two right answers: a wrong guess here is caught by the test on the pivots.
    """
    rng = np.random.default_rng(0)
    for _ in range(3):
        values = parts.evaluate(*rng.uniform(0.3, 1.2, parts.size))
        matrix = np.array(values[: n * n], float).reshape(n, n)
        if n > 2 and np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] < -1e-12 * np.abs(matrix).max():
            raise Unlowerable("its mass matrix is not positive definite and needs pivoting")


def _scalars(params: PyTree) -> list[jax.Array]:
    """Every number in the parameters, one by one."""
    return [x for leaf in jax.tree.leaves(params) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]


def _compiled_once(function, *arguments):
    """Call a jitted function without XLA inlining it: one compiled body, however many places call it."""
    with set_xla_metadata(inlineable="false"):
        return function(*arguments)
