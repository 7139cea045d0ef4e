"""The first-order system ẏ = f(t, y) that a solver sees, in the form that suits the scene.

A small scene becomes a *scalar program*: the mass matrix is eliminated by formulas written out for exactly its pattern
of zeros, and nothing is left that this scene does not need. Any other scene keeps the derivatives as JAX arrays. Both
forms give the same motion to round-off, and are tested against each other.
"""

import abc
import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata

from lagjax import _linear
from lagjax._layout import Layout
from lagjax._motion import Motion
from lagjax._native import Projection
from lagjax._program import Program, Unlowerable, lower, lower_solution

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

    @property
    @abc.abstractmethod
    def constrained(self) -> bool:
        """Whether there is anything to project to."""

    @abc.abstractmethod
    def projected(self, t: jax.Array, y: State, params: PyTree) -> State:
        """y after one Newton step back to the constraints."""


class ArrayEquations(Equations):
    """Derivatives as JAX arrays; `reason` says why."""

    motion: Motion = eqx.field(static=True)
    derived: Any = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    def __init__(self, motion: Motion, reason: str):
        self.motion, self.reason = motion, reason
        self.derived = jax.jit(motion.solved_acceleration)  # traced once, however often it is called

    @property
    def constrained(self) -> bool:
        """Whether the scene has constraints."""
        return self.motion.constrained

    def projected(self, t, y, params):
        """By `Motion.projected`."""
        return self.motion.projected(*y, t, params)

    def acceleration(self, t, y, params):
        """By `Motion.solved_acceleration`."""
        return _compiled_once(self.derived, *y, t, params)


class ScalarEquations(Equations):
    """A scalar program for q̈: inputs q, q̇, t and every number in params; outputs q̈ and whether M is singular."""

    program: Program = eqx.field(static=True)
    projection: Program | None = eqx.field(static=True)
    called: Any = eqx.field(static=True)
    projected_by: Any = eqx.field(static=True)

    def __init__(self, program: Program, projection: Program | None = None):
        self.program, self.projection, self.called = program, projection, jax.jit(program.__call__)
        self.projected_by = None if projection is None else jax.jit(projection.__call__)

    @property
    def constrained(self) -> bool:
        """Whether the scene has constraints."""
        return self.projection is not None

    def projected(self, t, y, params):
        """By the second program."""
        state = _compiled_once(self.projected_by, *y[0], *y[1], t, *_scalars(params))
        return jnp.stack(state[: len(state) // 2]), jnp.stack(state[len(state) // 2 :])

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
        program = scalar_program(motion, layout, params).complete
    except Unlowerable as reason:
        if path == "scalar":
            raise ValueError(f"This scene has no scalar program: {reason}.") from None
        return ArrayEquations(motion, str(reason))
    if path == "auto" and program.operations > LARGEST_XLA_PROGRAM:
        reason = f"{program.operations} operations are more than the {LARGEST_XLA_PROGRAM} that XLA compiles quickly"
        return ArrayEquations(motion, reason)
    return ScalarEquations(program, projection_program(motion, layout, params))


def scalar_program(motion: Motion, layout: Layout, params: PyTree) -> Program:
    """q̈ and the singularity of M as one program: first M and the forces, then the elimination their zeros allow.

    Its inputs are q, q̇, t and every number in params. Raises `Unlowerable` with the reason.

    With constraints M may be singular (a parameter may make it so) as long as the saddle point is not. To allow for
    that costs three times the arithmetic. Where M is regular in general the program therefore takes it for regular, and
    its last output tells where that would cost digits; there `otherwise` is the program for any M. Machine code changes
    over where that comes about (`_flow`), with the numbers of the run at hand; XLA, which has to write the program down
    before it knows them, takes the one that always holds (`complete`).
    """
    _require_small(layout)
    if not motion.constrained:
        return _eliminated(motion.mass_matrix_and_force, motion, layout, params)

    saddle = _saddle(motion)

    def for_any_mass_matrix():
        return _eliminated(saddle, motion, layout, params)

    lean = _eliminated(saddle, motion, layout, params, wary=True)
    return for_any_mass_matrix() if lean is None else replace(lean, otherwise=functools.cache(for_any_mass_matrix))


def projection_program(motion: Motion, layout: Layout, params: PyTree) -> Program | None:
    """`Motion.projected` as a program, from q, q̇, t and the numbers in params to q and q̇; None without constraints."""
    if not motion.constrained:
        return None
    n = layout.size

    def step(parts):
        def with_no_force(*state):
            matrix, rows, target = parts(*state)
            return matrix, jnp.zeros(n, layout.dtype), rows, target

        return _eliminated(with_no_force, motion, layout, params)

    velocity = step(motion.velocity_saddle)
    position = None if motion.constraints is None else step(motion.position_saddle)

    def projected(*scalars):
        q, rest = list(scalars[:n]), scalars[n:]
        if position is not None:
            q = [x + dx for x, dx in zip(q, position(*scalars), strict=False)]
        v = [x + dx for x, dx in zip(rest[:n], velocity(*q, *rest), strict=False)]
        return *q, *v

    return lower(projected, *_scalar_shapes(layout, params), budget=OPERATION_BUDGET)


def projection(motion: Motion, layout: Layout, params: PyTree) -> Projection | None:
    """What machine code needs to keep a motion on its constraints; None without any."""
    if not motion.constrained:
        return None
    q, t = jax.ShapeDtypeStruct((layout.size,), layout.dtype), jax.ShapeDtypeStruct((), layout.dtype)
    speeds = lower(motion.speeds, q, q, t, params, budget=OPERATION_BUDGET)
    return Projection(projection_program(motion, layout, params), speeds)


def multiplier_program(motion: Motion, layout: Layout, params: PyTree) -> Program:
    """λ as a program, those of `constraints` first; redundant ones are zero."""
    _require_small(layout)

    system, solve = _system(_saddle(motion), motion, layout, params)

    def multipliers(*scalars):
        _, right, factors, _ = system(*scalars)
        return [-pull for pull in solve(factors, right)[layout.size :]]

    return lower(multipliers, *_scalar_shapes(layout, params), budget=OPERATION_BUDGET)


def _saddle(motion: Motion) -> Callable:
    """(M, b, G, c) of a state."""

    def parts(*state):
        return *motion.mass_matrix_and_force(*state), *motion.rows_and_targets(*state)

    return parts


def _require_small(layout: Layout) -> None:
    if layout.size > LARGEST_SCALAR_SCENE:
        raise Unlowerable(f"it has {layout.size} coordinates, more than {LARGEST_SCALAR_SCENE}")


def _eliminated(parts_of: Callable, motion: Motion, layout: Layout, params, wary: bool = False) -> Program | None:
    """x as a program, and whether there is none, from the parts of a linear system: see `_system`."""
    found = _system(parts_of, motion, layout, params, wary)
    if found is None:
        return None
    return lower_solution(*found, layout.size, *_scalar_shapes(layout, params), budget=OPERATION_BUDGET)


def _system(parts_of: Callable, motion: Motion, layout: Layout, params, wary: bool = False):
    """A z = r with z = (x, −λ) for M x = b, or M x − Gᵀλ = b and G x = c; `parts_of` gives (M, b) or (M, b, G, c).

    Two functions: the entries of A, r, factors of A and whether it is singular, from the scalars; and z, from the
    factors and r. With constraints M is helped by GᵀG unless it is constant and regular. A `wary` elimination does not
    help it, and says where it should; None where that is everywhere, or nowhere.
    """
    n = layout.size
    q, t = jax.ShapeDtypeStruct((n,), layout.dtype), jax.ShapeDtypeStruct((), layout.dtype)
    parts = lower(parts_of, q, q, t, params, budget=OPERATION_BUDGET)
    m = (len(parts.outputs) - n * n - n) // (n + 1)  # rows of G
    regular = _require_definite(parts, n, m)
    constant = not any(parts.depends(i) for i in range(n * n))
    if wary and (constant or not regular):
        return None
    zeros = np.array([parts.constant(i) == 0 for i in range(len(parts.outputs))])
    mass_zeros, row_zeros = zeros[: n * n].reshape(n, n), zeros[n * n + n : n * n + n + m * n].reshape(m, n)
    helped = not (wary or (constant and regular))
    if motion.constrained:
        elimination = _linear.SaddleElimination((mass_zeros, row_zeros), layout.dtype, helped, wary)
    else:
        elimination = _linear.Elimination(mass_zeros, layout.dtype)

    def system(*scalars):
        values = list(parts(*scalars))
        table = [values[n * i : n * i + n] for i in range(n + 1 + m)]  # the rows of M, b, the rows of G
        matrix, b, rows, c = table[:n], table[n], table[n + 1 :], values[n * len(table) :]
        factors, singular = elimination.factors(matrix, rows)
        entries = {(i, j): x for i, row in enumerate(matrix + rows) for j, x in enumerate(row[: i + 1])}
        return entries, b + c, factors, singular

    return system, elimination.solve


def _scalar_shapes(layout: Layout, params: PyTree) -> list[jax.ShapeDtypeStruct]:
    """q, q̇, t and every number in params, one by one."""
    numbers = [jnp.result_type(leaf) for leaf in jax.tree.leaves(params) for _ in range(np.size(leaf))]
    return [jax.ShapeDtypeStruct((), dtype) for dtype in [layout.dtype] * (2 * layout.size + 1) + numbers]


def _require_definite(parts: Program, n: int, m: int) -> bool:
    """Elimination without pivoting is for positive definite M; look at a few states whether this M can be.

    With constraints it may be singular, and is then helped by GᵀG. Returns whether it is regular without, in general:
    at all of these states. The choice is between right answers: a wrong guess here is caught by the test on the pivots.
    """
    rng, regular = np.random.default_rng(0), True
    for _ in range(3):
        values = np.array(parts.evaluate(*rng.uniform(0.3, 1.2, parts.size)), float)
        matrix = values[: n * n].reshape(n, n)
        if np.isfinite(values).all():
            lowest, size = np.linalg.eigvalsh(matrix)[0], np.abs(matrix).max()
            regular = regular and lowest > 1e-10 * size
            rows = values[n * n + n : n * n + n + m * n].reshape(m, n)
            helped = np.linalg.eigvalsh(matrix + rows.T @ rows)[0] if m else lowest
            if (n > 2 or m) and helped < -1e-12 * size:
                raise Unlowerable("its mass matrix is not positive definite and needs pivoting")
    return regular


def _scalars(params: PyTree) -> list[jax.Array]:
    """Every number in the parameters, one by one."""
    return [x for leaf in jax.tree.leaves(params) for x in ([leaf] if jnp.ndim(leaf) == 0 else jnp.ravel(leaf))]


def _compiled_once(function, *arguments):
    """Call a jitted function without XLA inlining it: one compiled body, however many places call it."""
    with set_xla_metadata(inlineable="false"):
        return function(*arguments)
