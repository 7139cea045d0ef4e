"""`Origins`: starts that follow from the parameters, and `Manifold`: starts that lie on constraints, with derivatives.

On constraints a start has fewer directions than numbers. The unknown is any state y near them, and the motion begins at
the consistent state P(y) nearest to it (`System.project`): what a step of the search leaves of the constraints is taken
back, its derivative is that along them, and a direction across them changes nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._parameters import Parameters
from lagjax._fit._records import started
from lagjax._layout import Layout, halves
from lagjax._machine_code._derivatives import _projected_start
from lagjax._native import Projection
from lagjax._program import evaluate
from lagjax._system import System

_STEPS, _STILL = 30, 1e-13  # of Newton's method, which squares the distance; and the change at which it has ended


class Origins:
    """Of each piece whose start is a function of the parameters: which one it is, and that function, compiled once."""

    def __init__(self, starts: list, layout: Layout, parameters: Parameters):
        """`starts` is what the record of each piece says of its start; None where the piece begins later."""

        def of(function):
            def state(numbers):
                q, qdot = started(function, parameters.restore(numbers))
                return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

            return jax.jit(lambda numbers: (state(numbers), jax.jacfwd(state)(numbers)))

        functions = {start: of(start) for start in starts if callable(start)}
        self.functions = {k: functions[start] for k, start in enumerate(starts) if callable(start)}
        self.dtype = layout.dtype

    def move(self, starts: np.ndarray, numbers: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The starts (N, 2n) at the parameters `numbers` (P,), and how they move along `directions` (F, P) of these,
        (N, F, 2n): not at all where they are no function of them."""
        starts, moved = starts.copy(), np.zeros((len(starts), len(directions), starts.shape[1]))
        made: dict = {}
        for k, function in self.functions.items():
            if function not in made:
                made[function] = [np.asarray(x, float) for x in function(numbers.astype(self.dtype))]
            starts[k], slopes = made[function]
            moved[k] = directions @ slopes.T
        return starts, moved


class Placed(NamedTuple):
    """N starts (N, 2n) on the constraints; how they move with the unknown states, (N, 2n, 2n), and along F directions
    of the parameters, (N, F, 2n)."""

    starts: np.ndarray
    tangents: np.ndarray
    moved: np.ndarray


class Manifold:
    """The states that satisfy the constraints of a scene: by the projection of its machine code, else by `project`.

    Both have the same derivatives at a consistent state. The first is a step of Newton's method, which is taken until
    nothing changes; it is a program that needs no compilation.
    """

    def __init__(self, system: System, layout: Layout, parameters: Parameters, projection: Projection | None):
        def project(y: jax.Array, t, numbers) -> jax.Array:
            q, qdot = map(layout.restore, halves(y))
            q, qdot = system.project(q, qdot, t, parameters.restore(numbers))
            return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

        def with_derivatives(y, t, numbers):
            return project(y, t, numbers), *jax.jacfwd(project, argnums=(0, 2))(y, t, numbers)

        self._at = jax.jit(with_derivatives)  # one by one: it takes seconds to compile for a number of rows
        self.projection, self.dtype = projection, layout.dtype

    def put(self, y: np.ndarray, t: np.ndarray, numbers: np.ndarray, directions: np.ndarray) -> Placed:
        """Consistent states near `y` (N, 2n) at the times `t` (N,); NaN where there is none."""
        if self.projection is not None:
            return _by_steps(self.projection, y, t, numbers, directions)
        y, t, numbers = (np.asarray(x, self.dtype) for x in (y, t, numbers))
        rows = [self._at(y[k], t[k], numbers) for k in range(len(y))]
        starts, by_y, by_numbers = (np.stack([np.asarray(x, float) for x in part]) for part in zip(*rows, strict=True))
        return Placed(starts, by_y, np.einsum("nip,fp->nfi", by_numbers, directions))


def _by_steps(projection: Projection, y: np.ndarray, t: np.ndarray, numbers: np.ndarray, directions) -> Placed:
    count, states = y.shape
    rows = np.broadcast_to(numbers, (count, len(numbers)))
    before = np.full_like(y, np.inf)
    for _ in range(_STEPS):
        if np.nanmax(np.abs(y - before), initial=0.0) <= _STILL * np.nanmax(np.abs(y), initial=0.0):
            break
        before, y = y, evaluate(projection.state.line, [*y.T, t, *rows.T]).T
    still = np.abs(y - before).max(axis=1) <= _STILL * np.abs(y).max(axis=1)
    y = np.where(still[:, None], y, np.nan)
    along = np.zeros((count, states + len(directions), states)), np.zeros((states + len(directions), len(numbers)))
    along[0][:, :states], along[1][states:] = np.eye(states), directions
    moved = _projected_start(
        projection, t[:, None], y, rows, along[0], np.broadcast_to(along[1], (count, *along[1].shape))
    )
    return Placed(y, moved[:, :states].swapaxes(1, 2), moved[:, states:])
