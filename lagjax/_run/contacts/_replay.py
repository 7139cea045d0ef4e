"""The replay of a motion with contacts: the same stretches and jumps, with all that was decided given as numbers.

A row of the record says which watch ended a stretch, which rows the impulses hold and which gaps close. What is left is
a function of the start, the output times and the parameters that has derivatives of every order:

    (t, y) ─► a stretch to the watch ─► impulses of the rows held ─► (t, y) behind them

Its derivatives are those of the motion that the search found; its values are not used.
"""

import collections
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine.taylor import stretch_variation
from lagjax._interface import halves
from lagjax._primitives import differentiable_where, keep_together, start_alike
from lagjax._run._rounds import run_rounds
from lagjax._run.contacts._contact_search import POISSON
from lagjax._run.contacts._impact_law import Held, ImpactRows, construct_impulses, find_impulses, rates_behind
from lagjax._run.contacts._places import RECORD
from lagjax._run.contacts._scene_code import SceneCode, sizes_of_fields

# By how much the instants of contacts that share an impact may vary apart, for a tangent of length one: rounding.
TOGETHER = 1e-8


_VECTORS = frozenset((
    "DID", "BEFORE", "BEHIND", "IMPULSE", "HELD", "SLIDES", "DIRECTION", "COMPRESSED", "RETURNED", "ENDS", "MEETS",
    "SHARES", "STARTS", "OFFSET",
))  # fmt: skip


def read_rows(record, fields: dict[str, int], names: tuple[str, ...] = RECORD) -> Any:
    """The fields of rows (…, doubles) by their names in small letters, those of one double without an axis."""
    ends = np.cumsum([fields[name] for name in names])
    parts = [record[..., end - fields[name] : end] for name, end in zip(names, ends, strict=True)]
    of = collections.namedtuple("Rows", [name.lower() for name in names])  # noqa: PYI024
    return of(*(x if name in _VECTORS else x[..., 0] for name, x in zip(names, parts, strict=True)))


class Played(NamedTuple):
    """What has derivatives: the outputs (T, 2n), of each row its time, velocities and state behind it; of an impact its
    time, impulses and the energy lost; and the end."""

    path: Any
    at: Any
    before: Any
    behind: Any
    t_impact: Any
    impulse: Any
    lost: Any
    t: Any
    y: Any


class Replay:
    """The replay of a scene; it is known by identity.

    Of its `code` it takes the search and the lines; `make_flow` gives the flow of all contacts without watches.
    """

    def __init__(self, code: SceneCode, make_flow: Callable):
        surfaces, tolerances = code.surfaces["HELD"], code.tolerances
        self._vary = functools.cache(lambda: stretch_variation(make_flow(), surfaces, tolerances))
        self._code, self._lines, self._sizes, self._rough = code, code.lines, code.sizes, code.arrays["ROUGH"]

    def __call__(self, ts, y0, vector, restitution, friction) -> tuple:
        """The parts of `Played`."""
        given = ts, y0, vector, restitution, friction
        found = self._code.search(*jax.lax.stop_gradient(given), is_replayed=True)
        start = found.ending[-y0.size - 1 :]
        y = y0 + jax.lax.stop_gradient(start[:-1] - y0)
        t = ts[0] + jax.lax.stop_gradient(start[-1] - ts[0])
        path = jnp.where((ts <= start[-1])[:, None], y, 0.0)
        first = start_alike((t, y, path), given, found.record)

        def run_round(carry, row):
            return self._play(given, carry, row)

        def ran(_, row):
            return row.ran > 0

        k, n = self._sizes["K"], y0.size // 2
        absent = 0.0, jnp.zeros(n), jnp.zeros(2 * n), 0.0, jnp.zeros(k), 0.0
        fields = sizes_of_fields(self._sizes)
        played = run_rounds(run_round, first, start_alike(absent, given), read_rows(found.record, fields), ran)
        (t, y, path), rows = played
        return path, *rows, t, y

    def _play(self, given, carry, row):
        ts, y0, vector, restitution, friction = given
        (t, y, path), still = carry, jax.lax.stop_gradient
        begun, ran = still(t), row.ran > 0  # in a batch a member that is done has no row, and stays where it is
        ahead = ran & ((ts > begun) | (ts == jnp.where(begun == ts[0], begun, jnp.nan)))
        happens, crosses, decides = row.happens > 0, row.crosses > 0, row.decides > 0
        end = jnp.where(ran, jnp.where(~happens & (row.end == still(ts[-1])), ts[-1], row.end), begun)
        times = jnp.concatenate([t[None], jnp.where(ahead, ts, begun), jnp.where(ran, ts[-1], begun)[None]])
        numbers = jnp.concatenate([vector, row.did])
        found, t_end, y_end = self._vary()(times, y, numbers, end, row.watch.astype(int), crosses)
        path = jnp.where((ahead & (ts <= row.end))[:, None], found[1:-1], path)
        stays = ~ran | (happens & ~crosses)
        t, y = jnp.where(stays, t, t_end), jnp.where(stays, y, y_end)
        t_impact, impulse, lost, behind = self._jump((t, y), row, vector, restitution, friction, halves(y0)[1])
        behind = jnp.where(decides, behind, y)
        later = t + jnp.where(decides, row.later_on, 0.0)
        late = decides & (ts > row.end) & (ts <= still(later))
        path = jnp.where(late[:, None], behind, path)
        return (later, behind, path), (t, halves(y)[1], behind, t_impact, impulse, lost)

    def rows_at(self, t, y, vector) -> ImpactRows:
        """The rows of all contacts at a state, with all open."""
        return ImpactRows.split(self._lines["RESPONSE"](self._opened(t, y, vector)), self._sizes["HEIGHT"], y.size // 2)

    def _opened(self, t, y, vector):
        k, doing = self._sizes["K"], self._sizes["DOING"]
        return jnp.concatenate([y, t[None], vector, jnp.zeros(k), jnp.ones(doing - k - 1), jnp.zeros(1)])

    def _jump(self, at, row, vector, restitution, friction, first_velocity):
        """The time of an impact, impulses (k,), the energy lost, and the state (2n,) behind a change at (t, y)."""
        (t, y), k, hits = at, self._sizes["K"], row.hits > 0
        rows, v = self.rows_at(t, y, vector), halves(y)[1]
        direction = row.direction.reshape(-1, self._sizes["D"])
        if self._sizes["LAW"] == POISSON and self._rough.size:
            bounced, along = construct_impulses(rows, restitution, friction)
            direction = jnp.where(hits, along, direction)
        elif self._sizes["LAW"] == POISSON:
            bounced = rates_behind(rows, row.compressed, row.returned, restitution)
        else:
            bounced = -restitution * rows.rates[:k]
        bounced, ends = jnp.where(hits, bounced, 0.0), row.ends > 0
        held = Held(row.held, row.slides * friction, direction, self._rough)
        impulses = find_impulses(rows, held, jnp.where(ends, 0.0, bounced))
        change = impulses @ rows.responses
        back = jnp.where(row.meets > 0, -rows.values[:k] / jnp.diagonal(rows.coupling)[:k], 0.0)
        back = jnp.where(np.arange(k) < self._sizes["GAPS"], back, 0.0)
        behind = y + jnp.concatenate([back @ rows.responses[:k], change]) + row.offset
        behind = self._limit_variations(behind, rows, row, first_velocity)
        behind = differentiable_where(row.leaves_rest == 0, behind, t, y, vector)
        lost = -impulses @ (rows.gradients @ (v + 0.5 * change))
        left = self._time_left(t, y + jnp.concatenate([jnp.zeros_like(v), change]), bounced, ends, vector, restitution)
        return t + left, impulses[:k], lost, behind

    def _time_left(self, t, y, bounced, ends, vector, restitution):
        """The time that bounces still take which end at once, by `_search.end_bounces`."""
        x, k = self._opened(t, y, vector), self._sizes["K"]
        along = jnp.concatenate([halves(y)[1], self._lines["ACCELERATION"](x), jnp.ones(1)])
        bends, later = jnp.split(self._lines["BENDS"](jnp.concatenate([x, along, jnp.zeros(x.size - along.size)])), 2)
        b, rest = jnp.where(ends, -bends, 1.0), jnp.where(ends, 1.0 - restitution, 1.0)
        uneven = -later * bounced / (b**2 * rest)
        return jnp.sum(jnp.where(ends, 2.0 * bounced / (b * rest) * (1.0 - 2.0 / 3.0 * uneven), 0.0))

    def _limit_variations(self, y, rows: ImpactRows, row, first_velocity):
        """The state, which has no derivatives in directions that take apart what happens at one instant.

        Contacts that share an impact and close by themselves do so along directions in which their gaps stay closed.
        By the least slip of a start at rest friction turns.
        """
        still, k = jax.lax.stop_gradient(rows), self._sizes["K"]
        limits = jnp.where(row.shares > 0, TOGETHER * jnp.abs(still.rates[:k]), jnp.inf)
        begun, gradients = jnp.repeat(row.starts > 0, self._sizes["D"]), still.gradients[k:]
        limits = jnp.append(limits, jnp.where(begun, TOGETHER * jnp.abs(gradients).sum(axis=1), jnp.inf))
        offsets = jnp.append(rows.values[:k], gradients @ first_velocity)
        return keep_together(y, offsets - jax.lax.stop_gradient(offsets), limits)  # only how they vary matters
