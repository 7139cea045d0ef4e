"""The replay of a motion that jumps: the same stretches and jumps, with all decisions given as numbers.

A row of the record tells which watch ended a stretch, and which event followed. The rest is a function of the start,
the output times and the parameters that has derivatives of every order:

    (t, y) ─► a stretch to the watch ─► the event there ─► (t, y) after it

Its derivatives are those of the motion that the search found; its values are not used.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine.taylor import Line
from lagjax._primitives import Repetition, attach_derivative, differentiable_where, undefined_unless
from lagjax._program import Unlowerable
from lagjax._run.jumps._scene_code import Found, SceneCode
from lagjax._tracing import lower

# Operations of the line of the end of a stretch; instead of a longer one NumPy evaluates its parts.
LONGEST_REPLAYED = 5000


def mask_rows(there, x, inputs: tuple):
    """The rows x, NaN where the flag `there` is false; with traced `inputs`, derivatives by these are NaN too."""
    there = there[(..., *[None] * (x.ndim - there.ndim))]
    return undefined_unless(there, x, inputs) if inputs else np.where(there, x, np.nan)


def concatenate(*arrays):
    return jnp.concatenate([jnp.ravel(x) for x in arrays])


class Replay:
    """The replay of a scene, whose search is `code`; compared by identity.

    A law implements a stretch (`pass_stretch`), and `said`, the number of values that it returns for one in addition to
    the state after it. `played` is the type of its differentiable results: path, fields of rows, and t and y at the
    end.
    """

    said: int  # how many numbers a law tells of a stretch
    played: type  # a NamedTuple

    def __init__(self, code: SceneCode, varying: int):
        states = 2 * code.sizes["N"]
        shapes = ((self.said,), (states,)), ((code.sizes["TIMES"], states),)
        self.code, self.sizes = code, code.sizes
        self._rounds = Repetition(self._play_round, varying, 2, *shapes)

    def __call__(self, *given) -> tuple:
        """The fields of `played`, from the arguments of a search."""
        raise NotImplementedError

    def search_and_replay(self, *given) -> tuple[Found, Any, Any]:
        """The findings of a search, the rows of its record, and the replayed results, which have derivatives."""
        found = self.code.search(*jax.lax.stop_gradient(given))
        row, played = self.read(found)
        return found, row, type(played)(*attach_derivative(self, tuple(played), *given))

    def read(self, found: Found) -> tuple[Any, Any]:
        """The rows of a record, and the results as in a replay, without derivatives."""
        code, states = self.code, 2 * self.sizes["N"]
        said = code.law.places.said
        row = code.read(found.record[..., : code.width(said)], said)
        parts = (getattr(row, name) for name in self.played._fields[1:-2])  # type: ignore[attr-defined]
        return row, self.played(found.path, *parts, found.ending[..., 0], found.ending[..., 1 : states + 1])

    def pass_stretch(self, given: tuple, start: tuple, row, record, ahead, times, event) -> tuple:
        """The outputs (T, 2n), zero where there are none; the values `said`, the state after it, and the time then.

        A stretch begins at `start`, (t, y), and has these `times` (T + 2,), of which outputs lie `ahead`. Its `event`
        are the time and the state at its end, the watch that is zero there, and a flag that it crosses.
        """
        raise NotImplementedError

    def play(self, ts, y0, *given) -> tuple:
        """The path (T, 2n), the values said of each round, (N, …), the states after them, and t and y at the end.

        Arguments `given` last that have no derivatives are for the search only.
        """
        found = self.code.search(*jax.lax.stop_gradient((ts, y0, *given)), is_replayed=True)
        begun = self.code.read_ending(found.ending).begun
        y, t = (x + jax.lax.stop_gradient(at - x) for x, at in ((y0, begun[:-1]), (ts[0], begun[-1])))
        count = jnp.sum(self._read(found.record).ran > 0)
        before = (ts <= begun[-1]) & ((begun[-1] > ts[0]) | (count == 0))  # one at the start is the first round's
        path, varying = jnp.where(before[:, None], y, 0.0), (ts, y0, *given)[: self._rounds.inputs]
        (t, y), (said, behind), (more,) = self._rounds(varying, (t, y), (found.record,), count)
        # No round gives outputs at a start that is an end. The time is that of the search: with it nothing asks for the
        # values of the rounds where only their derivatives are wanted, and these are not played for them.
        known = (ts > ts[0]) | (count == 0) | (found.ending[0] > ts[0])
        return differentiable_where(known[:, None], path + more), said, behind, t, y

    def _read(self, record):
        return self.code.read(record, self.code.law.places.record)

    def _play_round(self, given, carry, _, rows):
        ts, (t, y), (record,), still = given[0], carry, rows, jax.lax.stop_gradient
        row, begun = self._read(record), still(t)
        ahead = (ts > begun) | (ts == jnp.where((begun == ts[0]) & (row.end > begun), begun, jnp.nan))
        end = jnp.where((row.happens == 0) & (row.end == still(ts[-1])), ts[-1], row.end)
        end = jnp.where(row.ran > 0, end, begun)
        times = jnp.concatenate([t[None], jnp.where(ahead, ts, begun), ts[-1:]])
        event = end, row.stop, row.watch.astype(int), row.crosses > 0
        path, said, behind, later = self.pass_stretch(given, (t, y), row, record, ahead, times, event)
        is_last = (begun == ts[0]) & (row.end <= begun) & (still(later) > begun)  # of those at the start
        path = jnp.where((is_last & (ts == begun))[:, None], y, path)
        return [later, behind], [said, behind], [path]

    def line_of_end(self, function: Callable, *shapes: tuple[int, ...]) -> Line | None:
        """The effects of the end of a stretch as one straight line, if that is not long; else None.

        Its `function` takes a record, the time, state and numbers of the end, without derivatives, and these `shapes`.
        """
        record = self.code.width(self.code.law.places.record)
        fixed = [(record,), (), (2 * self.sizes["N"],), (self.sizes["NUMBERS"],)]
        given = [jax.ShapeDtypeStruct(shape, float) for shape in (*fixed, *shapes)]
        try:
            program = lower(function, *given, budget=LONGEST_REPLAYED)
        except Unlowerable:
            return None
        return None if program.looks_up else Line(program.line, program.size, program.size, sum(map(math.prod, fixed)))
