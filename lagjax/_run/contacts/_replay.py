"""The replay of a motion with contacts: the same stretches and jumps, with all decisions given as numbers.

A row of the record tells which watch ended a stretch, which rows the impulses hold and which gaps close. The rest is a
function of the start, the output times and the parameters that has derivatives of every order:

    (t, y) ─► a stretch to the watch ─► impulses of the rows held ─► (t, y) after them

Its derivatives are those of the motion that the search found; its values are not used.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine.taylor import Line, Surfaces, move_to_zero, run_stretch
from lagjax._interface import halves
from lagjax._primitives import differentiable_where, limit_directions
from lagjax._run.contacts._contact_changes import POISSON
from lagjax._run.contacts._contact_state import HELD
from lagjax._run.contacts._impact_derivatives import (
    ActiveRows,
    ImpactRows,
    construct_impulses,
    find_impulses,
    rates_behind,
)
from lagjax._run.jumps import Replay, SceneCode, concatenate


class Played(NamedTuple):
    """The differentiable results of a replay: outputs (T, 2n); per row its time, velocities and state after it.

    For an impact its time, impulses and the energy lost; and the end.
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


class ContactReplay(Replay):
    """The replay of a scene with contacts; `flow` makes the flow of all contacts without watches."""

    played = Played

    def __init__(self, code: SceneCode, flow: Callable):
        n, k = code.sizes["N"], code.sizes["K"]
        self._flow, self._lines = flow, code.lines
        self._find_watches = cast(Callable[[], Surfaces], code.modes[HELD].find_surfaces)
        # The places at which the parts of what `_concatenate_effects` gives end, but the last.
        self._ends, self._rough = np.cumsum([1, 1, n, 1, k, 1, 2 * n, 1]), code.arrays["ROUGH"]
        self.said = int(self._ends[5]) - 1
        super().__init__(code, 5)

    def __call__(self, *given) -> tuple:
        """The fields of `Played`, from the output times, the start, the numbers, e and μ."""
        path, said, behind, t, y = self.play(*given)
        at, before, t_impact, impulse, lost = jnp.split(said, self._ends[1:5] - 1, axis=1)
        return path, at[:, 0], before, behind, t_impact[:, 0], impulse, lost[:, 0], t, y

    def pass_stretch(self, given: tuple, start: tuple, row, record, ahead, times, event) -> tuple:
        ts, y0, vector, restitution, friction = given
        (t, y), decides, still = start, row.decides > 0, jax.lax.stop_gradient
        numbers = jnp.concatenate([vector, row.did])
        path, *stop = run_stretch(self._flow(), self._find_watches(), self.code.tolerances, times, y, numbers, *event)
        ended = self._concatenate_effects((*stop, vector, t, y, halves(y0)[1], restitution, friction), record)
        is_behind = np.isin(np.arange(ended.size), np.arange(*self._ends[5:7]))
        smooth = (still(ended[0]) > 0) & (~is_behind | ~decides | (row.leaves_rest == 0))
        ended = differentiable_where(smooth, ended, *stop, vector)
        _, said, behind, later, shared = jnp.split(ended, self._ends[[0, 5, 6, 7]])
        limits = jnp.append(row.shares, jnp.repeat(row.starts, self.sizes["D"]))
        limits = jnp.where(decides & (limits > 0), limits, jnp.inf)
        behind = limit_directions(behind, shared - still(shared), limits)  # only how they vary matters
        last = row.end + jnp.where(decides, row.later_on, 0.0)
        later = later[0] + still(last - later[0])
        path = jnp.where((ahead & (ts <= row.end))[:, None], path[1:-1], 0.0)
        return jnp.where((decides & (ts > row.end) & (ts <= last))[:, None], behind, path), said, behind, later

    def _concatenate_effects(self, given: tuple, record):
        """The vector of `_evaluate_effects`, by a straight line if that is short."""
        given = (record, *jax.lax.stop_gradient(given[:3]), *given)
        return self._evaluate_effects(*given) if self._watch_line is None else self._watch_line(concatenate(*given))

    @functools.cached_property
    def _watch_line(self) -> Line | None:
        n, k, r, numbers = (self.sizes[name] for name in ("N", "K", "R", "NUMBERS"))
        return self.line_of_end(self._evaluate_effects, (), (2 * n,), (numbers,), (), (2 * n,), (n,), (k,), (r,))

    def _evaluate_effects(self, record, *given):
        """The effects of the end of a stretch, concatenated into one vector.

        A flag that it varies smoothly; time and velocities; for an impact its time, impulses and the energy lost; the
        state and the time after it; and the slips that contacts of one instant share (k + r d,).
        """
        *given, t, y, v0, restitution, friction = given
        row, k = self._read(record), self.sizes["K"]
        crosses, decides, stays = row.crosses > 0, row.decides > 0, (row.happens > 0) & (row.crosses == 0)
        still, moving = ((*some[:2], jnp.append(some[2], row.did)) for some in (given[:3], given[3:]))
        smooth, *moved = move_to_zero(self._find_watches(), row.watch.astype(int), crosses, moving, still)
        ends = zip(moved, moving[:2], strict=True)
        t, y = (jnp.where(stays, start, jnp.where(crosses, *end)) for start, end in zip((t, y), ends, strict=True))
        vector = given[5]
        response = self._lines["RESPONSE"](self._opened(t, y, vector))
        rows = ImpactRows.split(response, self.sizes["HEIGHT"], y.size // 2)
        *impact, behind = self._impact_jump((t, y), rows, row, vector, restitution, friction)
        behind, later = jnp.where(decides, behind, y), t + jnp.where(decides, row.later_on, 0.0)
        shared = rows.values[:k], rows.gradients[k:] @ v0
        return concatenate(jnp.where(smooth, 1.0, 0.0), t, halves(y)[1], *impact, behind, later, *shared)

    def _opened(self, t, y, vector):
        """The inputs of lines at a state, with all contacts open."""
        k, r, d, doing = (self.sizes[name] for name in ("K", "R", "D", "DOING"))
        ones = jnp.ones(r + r * d)
        return jnp.concatenate([y, t[None], vector, jnp.zeros(k), ones, jnp.zeros(doing - k - ones.size)])

    def _impact_jump(self, at, rows: ImpactRows, row, vector, restitution, friction):
        """The time of an impact, impulses (k,), the energy lost, and the state (2n,) after a change at (t, y)."""
        (t, y), k, hits = at, self.sizes["K"], row.hits > 0
        v = halves(y)[1]
        direction = row.direction.reshape(-1, self.sizes["D"])
        if self.sizes["LAW"] == POISSON and self._rough.size:
            bounced, along = construct_impulses(rows.coupling, rows.rates, restitution, friction)
            direction = jnp.where(hits, along, direction)
        elif self.sizes["LAW"] == POISSON:
            bounced = rates_behind(rows, row.compressed, row.returned, restitution)
        else:
            bounced = -restitution * rows.rates[:k]
        bounced, ends = jnp.where(hits, bounced, 0.0), row.ends > 0
        held = ActiveRows(row.held, row.slides * friction, direction, self._rough)
        impulses = find_impulses(rows, held, jnp.where(ends, 0.0, bounced))
        change = impulses @ rows.responses
        own = jnp.sum(jnp.where(np.eye(k) > 0, rows.coupling[:k, :k], 0.0), axis=0)
        back = jnp.where(row.meets > 0, -rows.values[:k] / own, 0.0)
        back = jnp.where(np.arange(k) < self.sizes["GAPS"], back, 0.0)
        behind = y + jnp.concatenate([back @ rows.responses[:k], change]) + row.offset
        lost = -impulses @ (rows.gradients @ (v + 0.5 * change))
        left = self._time_left(t, y + jnp.concatenate([jnp.zeros_like(v), change]), bounced, ends, vector, restitution)
        return t + left, impulses[:k], lost, behind

    def _time_left(self, t, y, bounced, ends, vector, restitution):
        """The remaining time of bounces that end at once, by `_contact_changes.end_bounces`."""
        x = self._opened(t, y, vector)
        along = jnp.concatenate([halves(y)[1], self._lines["ACCELERATION"](x), jnp.ones(1)])
        bends, later = jnp.split(self._lines["BENDS"](jnp.concatenate([x, along, jnp.zeros(x.size - along.size)])), 2)
        b, rest = jnp.where(ends, -bends, 1.0), jnp.where(ends, 1.0 - restitution, 1.0)
        uneven = -later * bounced / (b**2 * rest)
        return jnp.sum(jnp.where(ends, 2.0 * bounced / (b * rest) * (1.0 - 2.0 / 3.0 * uneven), 0.0))
