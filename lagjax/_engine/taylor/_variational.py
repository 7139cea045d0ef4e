"""The program of a motion with its tangents: the variational equations.

The tangents δq₁ … δq_D of q along D directions (δy0, δparams) satisfy

    d²/dt² δq = ∂q̈/∂q δq + ∂q̈/∂q̇ δq̇ + ∂q̈/∂p δp.

Together with the motion they are a program like any other: a derivative is as accurate as the motion. Source: Hairer,
Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §I.14.
"""

from typing import cast

import jax
import numpy as np

from lagjax._native import Projection
from lagjax._program import row_places, with_tangents
from lagjax._tracing import Program


def from_rows(y):
    """States (..., 2 · rows · n), all q and then all q̇, from rows (..., rows, 2n): the motion, then its tangents."""
    rows, n = y.shape[-2], y.shape[-1] // 2
    return y.reshape(*y.shape[:-1], 2, n).swapaxes(-3, -2).reshape(*y.shape[:-2], 2 * rows * n)


def to_rows(y, n: int):
    """Rows (..., rows, 2n) from the states of a tangent flow with n coordinates."""
    rows = y.shape[-1] // (2 * n)
    return y.reshape(*y.shape[:-1], 2, rows, n).swapaxes(-3, -2).reshape(*y.shape[:-1], rows, 2 * n)


def tangent_programs(
    program: Program, projection: Projection | None, size: int, directions: int
) -> tuple[Program, Projection | None]:
    """The program and the projection of a motion with n = `size` coordinates together with its tangents.

    The arguments q, q̇ and params of the new programs have 1 + D rows: those of the motion, then one for each
    direction. They are derived from the operations of the programs, as the steps' own derivatives are.
    """
    rows, numbers = 1 + directions, program.size - 2 * size - 1
    every = [None, *range(directions)]
    outputs = [(i, row) for row in every for i in range(size)] + [(size, None)]
    larger = _build_tangent_program(program, size, rows, numbers, outputs)
    if projection is None:
        return larger, None
    state, scale = cast(Program, projection.state), cast(Program, projection.velocity_scale)
    outputs = [(first + i, row) for first in (0, size) for row in every for i in range(size)]
    scales = [(i, None) for i in range(len(scale.line.outputs))]  # of the motion, also where it has tangents
    return larger, Projection(
        _build_tangent_program(state, size, rows, numbers, outputs),
        _build_tangent_program(scale, size, rows, numbers, scales),
    )


def _build_tangent_program(program: Program, n: int, rows: int, numbers: int, outputs) -> Program:
    """A program of (1 + D) rows of q, q̇ and params; it has no derivatives in JAX."""
    of_rows = [row_places(n, numbers, rows, row) for row in range(rows)]
    directions = [{i: place for i, place in enumerate(row) if i != 2 * n} for row in of_rows[1:]]
    line = with_tangents(program.line, program.dtypes, of_rows[0], directions, outputs)
    shapes = ((rows, n), (rows, n), (), (rows, numbers))
    structs = tuple(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes)
    return Program(line, len(line.nodes), structs)
