"""The replay of a motion with contacts: the same stretches and jumps, with all that was decided given as numbers.

A row of the record says which watch ended a stretch, which rows the impulses hold and which gaps close. What is left is
a function of the start, the output times and the parameters that has derivatives of every order:

    (t, y) ─► a stretch to the watch ─► impulses of the rows held ─► (t, y) behind them

Its derivatives are those of the motion that the search found; its values are not used.
"""

import collections
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine.taylor import Line, move_to_zero, run_stretch
from lagjax._interface import halves
from lagjax._primitives import Repetition, differentiable_where, keep_together
from lagjax._program import Unlowerable, lower
from lagjax._run.contacts._contact_search import POISSON
from lagjax._run.contacts._impact_law import HeldRows, ImpactRows, construct_impulses, find_impulses, rates_behind
from lagjax._run.contacts._places import RECORD
from lagjax._run.contacts._scene_code import SceneCode, sizes_of_fields

# Operations of the line of the end of a stretch: a longer one takes XLA as long as its parts.
LONGEST = 5000

_VECTORS = frozenset((
    "DID", "BEFORE", "BEHIND", "IMPULSE", "HELD", "SLIDES", "DIRECTION", "COMPRESSED", "RETURNED", "ENDS", "MEETS",
    "SHARES", "STARTS", "OFFSET", "STOP",
))  # fmt: skip


def read_rows(record, fields: dict[str, int], names: tuple[str, ...] = RECORD) -> Any:
    """The fields of rows (…, doubles) by their names in small letters, those of one double without an axis."""
    ends = np.cumsum([fields[name] for name in names])
    parts = [record[..., end - fields[name] : end] for name, end in zip(names, ends, strict=True)]
    of = collections.namedtuple("Rows", [name.lower() for name in names])
    return of(*(x if name in _VECTORS else x[..., 0] for name, x in zip(names, parts, strict=True)))


class Played(NamedTuple):
    """The parts that have derivatives: the outputs (T, 2n), of each row its time, velocities and state behind it.

    Of an impact its time, impulses and the energy lost; and the end.
    """

    path: Any
    at: Any
    before: Any
    behind: Any
    t_impact: Any
    impulse: Any
    lost: Any
    t: Any
    y: Any


def join(*arrays):
    return jnp.concatenate([jnp.ravel(x) for x in arrays])


class Replay:
    """The replay of a scene; it is known by identity.

    Of its `code` it takes the search and the lines; `make_flow` gives the flow of all contacts without watches.
    """

    def __init__(self, code: SceneCode, make_flow: Callable):
        self._make_flow = functools.cache(make_flow)
        self._watches, self._tolerances = code.surfaces["HELD"], code.tolerances
        self._code, self._lines, self._sizes, self._rough = code, code.lines, code.sizes, code.arrays["ROUGH"]

    def __call__(self, ts, y0, vector, restitution, friction) -> tuple:
        """The parts of `Played`."""
        given = ts, y0, vector, restitution, friction
        found = self._code.search(*jax.lax.stop_gradient(given), is_replayed=True)
        start = found.ending[-y0.size - 1 :]
        y = y0 + jax.lax.stop_gradient(start[:-1] - y0)
        t = ts[0] + jax.lax.stop_gradient(start[-1] - ts[0])
        count = jnp.sum(self._read(found.record).ran > 0)
        before = (ts <= start[-1]) & ((start[-1] > ts[0]) | (count == 0))  # an output at the start is the first round's
        path = jnp.where(before[:, None], y, 0.0)
        (t, y), (said, behind), (more,) = self._rounds(given, (t, y), (found.record,), count)
        at, before, t_impact, impulse, lost = jnp.split(said, self._ends[1:5] - 1, axis=1)
        return path + more, at[:, 0], before, behind, t_impact[:, 0], impulse, lost[:, 0], t, y

    def _read(self, record):
        return read_rows(record, sizes_of_fields(self._sizes))

    @functools.cached_property
    def _ends(self) -> np.ndarray:
        """The places at which the parts of what `_end` gives end, but the last."""
        n, k = self._sizes["N"], self._sizes["K"]
        return np.cumsum([1, 1, n, 1, k, 1, 2 * n, 1])

    @functools.cached_property
    def _rounds(self) -> Repetition:
        states = 2 * self._sizes["N"]
        return Repetition(self._play, 5, 2, ((int(self._ends[5]) - 1,), (states,)), ((self._sizes["TIMES"], states),))

    def _play(self, given, carry, _, rows):
        ts, y0, vector, restitution, friction = given
        (t, y), (record,), still = carry, rows, jax.lax.stop_gradient
        row, begun = self._read(record), still(t)
        ahead, decides = (ts > begun) | (ts == jnp.where(begun == ts[0], begun, jnp.nan)), row.decides > 0
        end = jnp.where((row.happens == 0) & (row.end == still(ts[-1])), ts[-1], row.end)
        end = jnp.where(row.ran > 0, end, begun)
        times = jnp.concatenate([t[None], jnp.where(ahead, ts, begun), ts[-1:]])
        numbers = jnp.concatenate([vector, row.did])
        event = end, row.stop, row.watch.astype(int), row.crosses > 0
        of_flow = self._make_flow(), self._watches, self._tolerances
        path, *stop = run_stretch(*of_flow, times, y, numbers, *event)
        ended = self._end((*stop, vector, t, y, halves(y0)[1], restitution, friction), record)
        is_behind = np.isin(np.arange(ended.size), np.arange(*self._ends[5:7]))
        smooth = (still(ended[0]) > 0) & (~is_behind | ~decides | (row.leaves_rest == 0))
        ended = differentiable_where(smooth, ended, *stop, vector)
        _, said, behind, later, shared = jnp.split(ended, self._ends[[0, 5, 6, 7]])
        limits = jnp.append(row.shares, jnp.repeat(row.starts, self._sizes["D"]))
        limits = jnp.where(decides & (limits > 0), limits, jnp.inf)
        behind = keep_together(behind, shared - still(shared), limits)  # only how they vary matters
        last = row.end + jnp.where(decides, row.later_on, 0.0)
        later = later[0] + still(last - later[0])
        path = jnp.where((ahead & (ts <= row.end))[:, None], path[1:-1], 0.0)
        path = jnp.where((decides & (ts > row.end) & (ts <= last))[:, None], behind, path)
        return [later, behind], [said, behind], [path]

    def _end(self, given: tuple, record):
        """The end of a stretch, as one straight line if that is not long."""
        given = (record, *jax.lax.stop_gradient(given[:3]), *given)
        return self._end_in_parts(*given) if self._line is None else self._line(join(*given))

    @functools.cached_property
    def _line(self) -> Line | None:
        n, k, r, numbers = (self._sizes[name] for name in ("N", "K", "R", "NUMBERS"))
        at, fields = [(), (2 * n,), (numbers,)], sizes_of_fields(self._sizes)
        fixed = [(sum(fields[name] for name in RECORD),), *at]
        given = [jax.ShapeDtypeStruct(shape, float) for shape in (*fixed, *at, (), (2 * n,), (n,), (k,), (r,))]
        try:
            program = lower(self._end_in_parts, *given, budget=LONGEST)
        except Unlowerable:
            return None
        return None if program.looks_up else Line(program.line, program.size, program.size, sum(map(math.prod, fixed)))

    def _end_in_parts(self, record, *given):
        """The effects of the end of a stretch, all numbers side by side.

        Whether it varies smoothly; time and velocities; of an impact its time, impulses and the energy lost; the state
        and the time behind; and what contacts of one instant share (k + r d,).
        """
        *given, t, y, v0, restitution, friction = given
        row, k = self._read(record), self._sizes["K"]
        crosses, decides, stays = row.crosses > 0, row.decides > 0, (row.happens > 0) & (row.crosses == 0)
        still, moving = ((*some[:2], jnp.append(some[2], row.did)) for some in (given[:3], given[3:]))
        smooth, *moved = move_to_zero(self._watches, row.watch.astype(int), crosses, moving, still)
        ends = zip(moved, moving[:2], strict=True)
        t, y = (jnp.where(stays, start, jnp.where(crosses, *end)) for start, end in zip((t, y), ends, strict=True))
        rows, vector = self.rows_at(t, y, given[5]), given[5]
        *impact, behind = self._jump((t, y), rows, row, vector, restitution, friction)
        behind, later = jnp.where(decides, behind, y), t + jnp.where(decides, row.later_on, 0.0)
        shared = rows.values[:k], rows.gradients[k:] @ v0
        return join(jnp.where(smooth, 1.0, 0.0), t, halves(y)[1], *impact, behind, later, *shared)

    def rows_at(self, t, y, vector) -> ImpactRows:
        """The rows of all contacts at a state, with all open."""
        return ImpactRows.split(self._lines["RESPONSE"](self._opened(t, y, vector)), self._sizes["HEIGHT"], y.size // 2)

    def _opened(self, t, y, vector):
        k, r, d, doing = (self._sizes[name] for name in ("K", "R", "D", "DOING"))
        ones = jnp.ones(r + r * d)
        return jnp.concatenate([y, t[None], vector, jnp.zeros(k), ones, jnp.zeros(doing - k - ones.size)])

    def _jump(self, at, rows: ImpactRows, row, vector, restitution, friction):
        """The time of an impact, impulses (k,), the energy lost, and the state (2n,) behind a change at (t, y)."""
        (t, y), k, hits = at, self._sizes["K"], row.hits > 0
        v = halves(y)[1]
        direction = row.direction.reshape(-1, self._sizes["D"])
        if self._sizes["LAW"] == POISSON and self._rough.size:
            bounced, along = construct_impulses(rows, restitution, friction)
            direction = jnp.where(hits, along, direction)
        elif self._sizes["LAW"] == POISSON:
            bounced = rates_behind(rows, row.compressed, row.returned, restitution)
        else:
            bounced = -restitution * rows.rates[:k]
        bounced, ends = jnp.where(hits, bounced, 0.0), row.ends > 0
        held = HeldRows(row.held, row.slides * friction, direction, self._rough)
        impulses = find_impulses(rows, held, jnp.where(ends, 0.0, bounced))
        change = impulses @ rows.responses
        back = jnp.where(row.meets > 0, -rows.values[:k] / jnp.diagonal(rows.coupling)[:k], 0.0)
        back = jnp.where(np.arange(k) < self._sizes["GAPS"], back, 0.0)
        behind = y + jnp.concatenate([back @ rows.responses[:k], change]) + row.offset
        lost = -impulses @ (rows.gradients @ (v + 0.5 * change))
        left = self._time_left(t, y + jnp.concatenate([jnp.zeros_like(v), change]), bounced, ends, vector, restitution)
        return t + left, impulses[:k], lost, behind

    def _time_left(self, t, y, bounced, ends, vector, restitution):
        """The time that bounces still take which end at once, by `_contact_search.end_bounces`."""
        x = self._opened(t, y, vector)
        along = jnp.concatenate([halves(y)[1], self._lines["ACCELERATION"](x), jnp.ones(1)])
        bends, later = jnp.split(self._lines["BENDS"](jnp.concatenate([x, along, jnp.zeros(x.size - along.size)])), 2)
        b, rest = jnp.where(ends, -bends, 1.0), jnp.where(ends, 1.0 - restitution, 1.0)
        uneven = -later * bounced / (b**2 * rest)
        return jnp.sum(jnp.where(ends, 2.0 * bounced / (b * rest) * (1.0 - 2.0 / 3.0 * uneven), 0.0))
