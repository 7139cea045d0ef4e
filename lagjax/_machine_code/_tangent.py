"""The program of a motion with its tangents: the variational equations.

To q belong δq₁ … δq_D, derivatives along D directions (δy0, δparams), which move by

    d²/dt² δq = ∂q̈/∂q δq + ∂q̈/∂q̇ δq̇ + ∂q̈/∂p δp.

Together with the motion they are a program like any other: a derivative is as accurate as the motion. Source: Hairer,
Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §I.14.
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._native import Projection
from lagjax._program import Program, lower

_BUDGET = 100_000  # operations of a program with tangents
# Columns of the Jacobian ∂q̈/∂(q, q̇, p) for each direction, up to which the tangents are its products with the
# directions; where there are more, each is derived along its own.
_DENSE = 4


def from_rows(y):
    """States (..., 2 · rows · n), all q and then all q̇, from rows (..., rows, 2n): the motion, then its tangents."""
    rows, n = y.shape[-2], y.shape[-1] // 2
    return y.reshape(*y.shape[:-1], 2, n).swapaxes(-3, -2).reshape(*y.shape[:-2], 2 * rows * n)


def to_rows(y, n: int):
    """Rows (..., rows, 2n) from the states of a tangent flow over n coordinates."""
    rows = y.shape[-1] // (2 * n)
    return y.reshape(*y.shape[:-1], 2, rows, n).swapaxes(-3, -2).reshape(*y.shape[:-1], rows, 2 * n)


def tangent_programs(
    program: Program, projection: Projection | None, size: int, directions: int
) -> tuple[Program, Projection | None]:
    """The program and the projection of a motion over n = `size` coordinates, and of its tangents.

    The arguments q, q̇ and params of the new programs have 1 + D rows: those of the motion, then one for each direction.
    """
    n, rows, numbers = size, 1 + directions, program.size - 2 * size - 1

    def with_tangents(function, q, v, t, p):
        """`function(q, v, t, p)` at the first rows, and its derivative along each of the others."""

        def derivative(*direction):
            return jax.jvp(lambda q, v, p: function(q, v, t, p), (q[0], v[0], p[0]), direction)[1]

        if 2 * n + numbers > _DENSE * directions:
            tangents = jax.vmap(derivative)(q[1:], v[1:], p[1:])
        else:
            by_q, by_v, by_p = jax.jacfwd(function, argnums=(0, 1, 3))(q[0], v[0], t, p[0])
            tangents = q[1:] @ by_q.T + v[1:] @ by_v.T + p[1:] @ by_p.T
        return jnp.concatenate([function(q[0], v[0], t, p[0])[None], tangents])

    def accelerations(q, v, t, p):
        return jnp.stack(program(*q, *v, t, *p)[:n])

    def all_accelerations(q, v, t, p):
        return with_tangents(accelerations, q, v, t, p), program(*q[0], *v[0], t, *p[0])[n]

    shapes = [jax.ShapeDtypeStruct(shape, np.float64) for shape in ((rows, n), (rows, n), (), (rows, numbers))]
    larger = lower(all_accelerations, *shapes, budget=_BUDGET)
    if projection is None:
        return larger, None

    state, scale = cast(Program, projection.state), cast(Program, projection.velocity_scale)

    def projected(q, v, t, p):
        both = with_tangents(lambda q, v, t, p: jnp.stack(state(*q, *v, t, *p)), q, v, t, p)
        return both[:, :n], both[:, n:]

    def velocity_scale(q, v, t, p):
        return scale(*q[0], *v[0], t, *p[0])

    return larger, Projection(*(lower(of, *shapes, budget=_BUDGET) for of in (projected, velocity_scale)))
