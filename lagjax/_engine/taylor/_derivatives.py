"""First derivatives of a flow map, for rows of members: `jvp` along directions, `vjp` from cotangents.

Both go over the steps of the motion itself: forward along each direction (`_native._tangent`), back with each step
transposed (`_native._adjoint`). They are transposes of each other to round-off, and as accurate as the motion as long
as its steps suit its tangents: where they do not, they are divided (`_divide_steps`). The cost of `vjp` does not grow
with the number of parameters. A name that ends in `_ct` is a cotangent, one that ends in `_dot` a tangent.
"""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lagjax import _native
from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._engine.taylor._kept_steps import KEPT, Steps, StepStore
from lagjax._interface import SUCCESSFUL
from lagjax._native import Projection
from lagjax._program import Program, StraightLine, pullback, pushforward

LARGEST_PORTION = 2**23  # numbers of the steps that are written down at once: 64 MiB
_ROOM_AGAIN = 2  # times the steps that were taken: those that are undone and those of a first try are written, too
MOST_PARTS, TRIES = 64, 4  # of a step that is too long, at once; and how often they are divided once more


def jvp(flow: Flow, ts, y0, params, solution, dy0, dparams, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The derivative of `Flow.run` along m directions for each of N members, between fixed times.

    `solution` is (path, result, accepted, ticket) of the run; `dy0` (N, m, 2n), `dparams` (N, m, P) → δpath
    (N, m, T, 2n), NaN where the motion did not come, and δy_end (N, m, 2n), NaN where it failed.
    """
    path, result, accepted, ticket = solution
    members, m = dy0.shape[:2]
    if flow.projection is not None:
        dy0 = project_start_tangents(flow.projection, ts[:, :1], y0, params, dy0, dparams)
    groups = _groups_of_directions(members, m)
    directions = math.ceil(m / groups)
    padding = ((0, 0), (0, groups * directions - m), (0, 0))
    dy0, dparams = (np.pad(x, padding).reshape(members * groups, directions, -1) for x in (dy0, dparams))
    # In units of its largest number, so that the tolerances mean the same for tangents of any length.
    length = np.abs(np.concatenate([dy0, dparams], axis=2)).max(axis=2, initial=0.0, keepdims=True)
    unit = np.where(length > 0, length, 1.0)
    dy0, dparams = dy0 / unit, dparams / unit
    rows = np.repeat(np.arange(members), groups)
    params = _repeat_rows(params, members)
    some = ts if len(ts) == 1 else ts[rows], y0[rows], params[rows], accepted[rows], ticket[rows]
    path_dot, y_dot = _jvp_over_steps(flow, *some, dy0, dparams, tolerances)
    path_dot, y_dot = path_dot * unit[..., None], y_dot * unit
    path_dot = path_dot.reshape(members, groups * directions, *path.shape[1:])[:, :m]
    y_dot = y_dot.reshape(members, groups * directions, -1)[:, :m]
    if flow.projection is not None and path.shape[1] > 2:
        dparams = (dparams * unit).reshape(members, groups * directions, -1)[:, :m]
        _project_tangents(flow, flow.projection, ts, path, params, path_dot, dparams)
    path_dot[:, :, -1] = y_dot
    path_dot[~np.broadcast_to(np.isfinite(path)[:, None], path_dot.shape)] = np.nan
    y_dot[result != SUCCESSFUL] = np.nan
    return path_dot, y_dot


def _groups_of_directions(members: int, m: int) -> int:
    """Into how many rows the m directions of each member go.

    Of one member alone, one row a thread. Of more members than lanes, two where fewer lanes are then idle: twenty
    members fill three vectors of eight badly, forty rows fill five. A row costs its directions and the motion itself.
    """
    lanes = _native.lanes()
    if members < lanes:
        return max(1, min(_native.cores() // members, math.ceil(m / lanes)))

    def work(groups: int) -> int:
        return math.ceil(groups * members / lanes) * (1 + math.ceil(m / groups))

    return 2 if work(2) < work(1) else 1


def _jvp_over_steps(
    flow: Flow, ts, y0, params, accepted, ticket, dy0, dparams, tolerances
) -> tuple[np.ndarray, np.ndarray]:
    """`jvp` of some directions a row, over the steps that were taken."""
    y_dot = np.array(dy0, np.float64)
    path_dot = np.full((*dy0.shape[:2], ts.shape[1], flow.states), np.nan)

    def advance_tangents(steps: Steps, rows, members):
        times = ts if len(ts) == 1 else ts[rows]
        path_dot[rows], y_dot[rows], excess = steps.kernel.jvp(
            times, params[rows], steps.table, steps.first[members], steps.counts[members], dy0[rows], dparams[rows],
            steps.order, tolerances.floor,
        )  # fmt: skip
        return excess / tolerances.largest_excess

    for steps, rows, members in _steps_of(flow, ts, y0, params, accepted, ticket, tolerances):
        excess = advance_tangents(steps, rows, members)

        def divide(k: int, steps=steps, rows=rows, members=members, excess=excess):
            row = rows[k : k + 1]
            again = functools.partial(advance_tangents, rows=row, members=np.zeros(1, int))
            if (
                _sweep_divided_steps(flow, steps, members[k], params[row[0]], tolerances, excess[k : k + 1], again)
                is None
            ):
                path_dot[row], y_dot[row] = np.nan, np.nan

        _native.map_in_threads(np.flatnonzero(excess > 1.0).tolist(), divide, _native.cores())
    at_start = np.broadcast_to((ts == ts[:, :1])[:, None], path_dot.shape[:3])  # also where there was no step
    return np.where(at_start[..., None], dy0[:, :, None], path_dot), y_dot


# ---- vector–Jacobian products ---------------------------------------------------------------------------------------


def vjp(flow: Flow, ts, y0, params, solution, path_ct, end_ct, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The transpose of `jvp`: from m cotangents of the outputs of each of N motions to those of what went in.

    `solution` is (path, result, accepted, ticket) of the run; `path_ct` (N, m, T, 2n) and `end_ct` (N, m, 2n) →
    cotangents of `y0` (N, m, 2n) and of `params` (N, m, P). A cotangent that is not zero, of an output that was
    not reached or of the end of a motion that failed, makes all of them NaN: there is no derivative.
    """
    path, result, accepted, ticket = solution
    members, m = end_ct.shape[:2]
    if m > flow.states + flow.numbers:
        return _vjp_by_jacobian(flow, ts, y0, params, solution, path_ct, end_ct, tolerances)
    path_ct, lost = mask_cotangents(path, result, path_ct, end_ct)
    params = _repeat_rows(params, members)
    params_ct = np.zeros((members, m, flow.numbers))
    if flow.projection is not None and path.shape[1] > 2:
        _transpose_projection(flow, flow.projection, ts, path, params, path_ct, params_ct)
    done = (result == SUCCESSFUL)[:, None, None]
    end_ct = end_ct + np.where(done, path_ct[:, :, -1], 0.0)
    path_ct[:, :, -1] = 0.0

    first, rows = ts[:, :1], np.repeat(np.arange(members), m)
    ts = ts if len(ts) == 1 else ts[rows]
    y_ct, more = _vjp_over_steps(
        flow, ts, y0[rows], params[rows], accepted[rows], ticket[rows], path_ct.reshape(members * m, *path.shape[1:]),
        end_ct.reshape(members * m, -1), tolerances,
    )  # fmt: skip
    y_ct, more = y_ct.reshape(members, m, -1), more.reshape(members, m, -1) + params_ct
    if flow.projection is not None:
        y_ct, of_projection = _transpose_start_projection(flow.projection, first, y0, params, y_ct)
        more = more + of_projection
    y_ct[lost], more[lost] = np.nan, np.nan
    return y_ct, more


def mask_cotangents(path, result, path_ct, end_ct, library: Any = np) -> tuple:
    """Cotangents (N, m, T, 2n), zero where an output was not reached; and whether one is lost there, (N, m)."""
    reached = library.isfinite(path)[:, None]
    lost = ((path_ct != 0) & ~reached).any(axis=(2, 3))
    lost |= (end_ct != 0).any(axis=2) & (result != SUCCESSFUL)[:, None]
    return library.where(reached, path_ct, 0.0), lost


def _vjp_over_steps(
    flow: Flow, ts, y0, params, accepted, ticket, path_ct, end_ct, tolerances
) -> tuple[np.ndarray, np.ndarray]:
    """`vjp` of one cotangent a row, over the steps that were taken."""
    y_ct, params_ct = np.full(end_ct.shape, np.nan), np.full((len(y0), flow.numbers), np.nan)

    def transpose_steps(steps: Steps, rows, members):
        times = ts if len(ts) == 1 else ts[rows]
        y_ct[rows], params_ct[rows], excess = steps.kernel.vjp(
            times, params[rows], steps.table, steps.first[members], steps.counts[members], path_ct[rows],
            end_ct[rows], steps.order,
        )  # fmt: skip
        return excess > tolerances.largest_excess

    for steps, rows, members in _steps_of(flow, ts, y0, params, accepted, ticket, tolerances):
        long = np.flatnonzero(transpose_steps(steps, rows, members))
        if not long.size:
            continue
        probe = functools.partial(_probe_series, flow, ts, params, tolerances)
        excess = probe(steps, rows[long], members[long])

        def divide(k: int, steps=steps, rows=rows, members=members, long=long, excess=excess, probe=probe):
            row = rows[long[k : k + 1]]
            again = functools.partial(probe, rows=row, members=np.zeros(1, int))
            number = params[row[0]]
            better = _sweep_divided_steps(
                flow, steps, int(members[long[k]]), number, tolerances, excess[k : k + 1], again
            )
            if better is None:
                y_ct[row], params_ct[row] = np.nan, np.nan
            else:
                transpose_steps(better, row, np.zeros(1, int))  # here, so that no more than one table a thread is kept

        _native.map_in_threads(np.flatnonzero(excess > 1.0).tolist(), divide, _native.cores())
    at_start = (ts == ts[:, :1])[:, :, None]  # outputs that are the initial state; steps begin after them
    return y_ct + np.sum(path_ct * at_start, axis=1), params_ct


def _probe_series(flow: Flow, ts, params, tolerances, steps: Steps, rows, members) -> np.ndarray:
    """The size of the last terms of the series of a tangent, in units of the limit, along any direction at all."""
    direction = np.random.default_rng(0).normal(size=flow.states + flow.numbers)
    y_dot, params_dot = (np.tile(x, (len(rows), 1, 1)) for x in np.split(direction, [flow.states]))
    excess = steps.kernel.jvp(
        ts if len(ts) == 1 else ts[rows], params[rows], steps.table, steps.first[members], steps.counts[members], y_dot,
        params_dot, steps.order, tolerances.floor,
    )[2]  # fmt: skip
    return excess / tolerances.largest_excess


def _vjp_by_jacobian(
    flow: Flow, ts, y0, params, solution, path_ct, end_ct, tolerances
) -> tuple[np.ndarray, np.ndarray]:
    """`vjp` from the whole Jacobian: for more cotangents than there are numbers that vary."""
    inputs = flow.states + flow.numbers
    unit = np.broadcast_to(np.eye(inputs), (len(y0), inputs, inputs))
    path, end = jvp(flow, ts, y0, params, solution, unit[..., : flow.states], unit[..., flow.states :], tolerances)
    used = np.einsum("nmts,nrts->nmr", path_ct, np.where(np.isfinite(path), path, 0.0))
    used += np.einsum("nms,nrs->nmr", end_ct, np.where(np.isfinite(end), end, 0.0))
    path_lost, end_lost = (~np.all(np.isfinite(x), axis=1, keepdims=True) for x in (path, end))
    lost = ((path_ct != 0) & path_lost).any(axis=(2, 3)) | ((end_ct != 0) & end_lost).any(axis=2)
    used[lost] = np.nan
    return used[..., : flow.states], used[..., flow.states :]


# Off the constraints a motion depends on where its steps end, for there it is projected; and a motion with tangents
# takes other steps. In its second derivative a start that moves on the constraints leaves them. So the motion is
# differentiated as if it began at the projection of its start, which is that start.


def project_start_tangents(projection: Projection, t, y0, params, dy0, dparams) -> np.ndarray:
    """The tangents (N, m, 2n) of the projection of the starts."""
    inputs = _start_columns(t, y0, params, dy0, dparams)
    return _projection_pushforward(projection.state, y0.shape[1]).evaluate(inputs).T.reshape(dy0.shape)


def _transpose_start_projection(projection: Projection, t, y0, params, y_ct) -> tuple[np.ndarray, np.ndarray]:
    """The transpose of `project_start_tangents`: cotangents (N, m, 2n) of starts, and (N, m, P) of parameters."""
    back = _projection_pullback(projection.state, y0.shape[1]).evaluate(_start_columns(t, y0, params, y_ct)).T
    back = back.reshape(*y_ct.shape[:2], -1)
    return back[..., : y0.shape[1]], back[..., y0.shape[1] :]


def _start_columns(t, y0, params, *moving) -> list:
    """The inputs of a projection's derivatives at N starts, in m directions each: columns of N m numbers."""
    members, m = moving[0].shape[:2]
    parts = y0, t, params, *moving
    parts = [np.broadcast_to(x if x.ndim == 3 else x[:, None], (members, m, x.shape[-1])) for x in parts]
    return list(np.concatenate([x.reshape(members * m, x.shape[-1]).T for x in parts]))


def _transpose_projection(flow: Flow, projection: Projection, ts, path, params, path_ct, params_ct) -> None:
    """Take cotangents back through the projection that put the outputs on the constraints, all but the first and last.

    Changes `path_ct` and `params_ct` in place. The projection squares the distance to the constraints: its derivative
    at the projected state is that at the state before.
    """
    members, m, times, _ = path_ct.shape
    place = np.broadcast_to(np.where(np.isfinite(path), path, path[:, :1])[:, None, 1:-1],
                            (members, m, times - 2, flow.states))  # fmt: skip
    t = np.broadcast_to(ts[:, None, 1:-1], place.shape[:-1])
    numbers = np.broadcast_to(params[:, None, None], (*place.shape[:-1], flow.numbers))
    parts = place, t[..., None], numbers, path_ct[:, :, 1:-1]
    columns = [x.reshape(place[..., 0].size, x.shape[-1]).T for x in parts]  # a scene may have no numbers
    back = _projection_pullback(projection.state, flow.states).evaluate(list(np.concatenate(columns))).T
    back = back.reshape(*place.shape[:-1], -1)
    path_ct[:, :, 1:-1] = back[..., : flow.states]
    params_ct += back[..., flow.states :].sum(axis=2)


def _project_tangents(flow: Flow, projection: Projection, ts, path, params, path_dot, dparams) -> None:
    """Take tangents through the projection that put the outputs on the constraints, all but the first and last.

    Changes `path_dot` in place; `_transpose_projection` is its transpose.
    """
    members, m, times, _ = path_dot.shape
    shape = members, m, times - 2, flow.states
    place = np.broadcast_to(np.where(np.isfinite(path), path, path[:, :1])[:, None, 1:-1], shape)
    t = np.broadcast_to(ts[:, None, 1:-1], shape[:-1])[..., None]
    numbers, moving = (
        np.broadcast_to(x, (*shape[:-1], flow.numbers)) for x in (params[:, None, None], dparams[:, :, None])
    )
    parts = place, t, numbers, path_dot[:, :, 1:-1], moving
    columns = [x.reshape(place[..., 0].size, x.shape[-1]).T for x in parts]  # a scene may have no numbers
    forward = _projection_pushforward(projection.state, flow.states)
    path_dot[:, :, 1:-1] = forward.evaluate(list(np.concatenate(columns))).T.reshape(shape)


@functools.lru_cache(maxsize=64)
def _projection_pushforward(program: Program, t: int) -> StraightLine:
    """The tangents of the outputs of a projection, from its inputs and tangents of all but the time, input `t`."""
    by = [i for i in range(program.size) if i != t]
    return pushforward(program.line, [np.dtype(float)] * program.size, by, range(t))


@functools.lru_cache(maxsize=64)
def _projection_pullback(program: Program, t: int) -> StraightLine:
    """The cotangents of a projection's inputs but the time, input `t`, from its inputs and those of its outputs."""
    by = [i for i in range(program.size) if i != t]
    return pullback(program.line, [np.dtype(float)] * program.size, by, range(t))


# ---- the steps that a derivative goes over ---------------------------------------------------------------------------


def _steps_of(
    flow: Flow, ts, y0, params, accepted, ticket, tolerances
) -> Iterator[tuple[Steps, np.ndarray, np.ndarray]]:
    """The steps of all rows: those of a run, whose rows they are, and which members of the run.

    First those that are kept; motions whose steps are gone are run once more.
    """
    waiting = np.ones(len(y0), bool)
    for steps, rows, members in KEPT.runs(ticket):
        waiting[rows] = False
        yield steps, rows, members
    for places in portions(np.flatnonzero(waiting), accepted * (flow.states + 4), LARGEST_PORTION):
        store, some_ts = StepStore(), ts if len(ts) == 1 else ts[places]
        room = _ROOM_AGAIN * int(accepted[places].sum()) + len(places)
        again = flow.follow(some_ts, y0[places], params[places], tolerances, store, room)
        for steps, rows, members in store.runs(again.ticket):
            yield steps, places[rows], members


def _sweep_divided_steps(
    flow: Flow, steps: Steps, member: int, params, tolerances, excess, sweep: Callable
) -> Steps | None:
    """`sweep(steps)` over the steps of a member in ever smaller parts: the steps that suit its tangents, or None.

    `excess` (1,), and what `sweep` returns, is how large the last terms of the series are, in units of the limit. Those
    of a motion with constraints that do not fall as its steps do are rounding, as beside a dead centre: its own steps
    are right.
    """
    parts = 1
    for _ in range(TRIES):
        before = float(excess[0])
        parts *= math.ceil(min(MOST_PARTS, 1.1 * float(excess[0]) ** (1 / (steps.order - 1))))
        divided = _divide_steps(flow, steps, member, params, tolerances, parts)
        excess = sweep(divided)
        if not excess > 1.0:
            return divided
        if flow.projection is not None and float(excess[0]) > 0.5 * before:
            one = slice(member, member + 1)
            own = steps._replace(first=steps.first[one], counts=steps.counts[one], complete=steps.complete[one])
            sweep(own)
            return own
    return None


def _divide_steps(flow: Flow, steps: Steps, member: int, params, tolerances: Tolerances, parts: int) -> Steps:
    """The steps of one member, each in this many parts: the states between are outputs of the motion."""
    first = steps.first[member]
    rows = steps.table[first : first + steps.counts[member]]
    t, h, first_state = rows[:, 0], rows[:, 1], rows[:1, 4:]
    times = np.append((t[:, None] + h[:, None] * np.arange(parts) / parts).ravel(), t[-1] + h[-1])
    path = flow.follow(times[None], first_state[:, : flow.states], params[None], tolerances).path[0]
    more = np.repeat(rows[:, 4 + flow.states :], parts, axis=0)  # of a piecewise program
    last = np.arange(1, len(more) + 1)[:, None] % parts == 0
    more[:, -2:] = np.where(last, more[:, -2:], 0.0)  # which border it ends at, and whether that is grazed
    begins = np.stack([times[:-1], np.diff(times), *np.zeros((2, len(path) - 1))]).T
    table = np.concatenate([begins, path[:-1], more], axis=1)
    count = np.array([len(table)])
    return Steps(steps.kernel, steps.order, table, np.zeros(1, int), count, np.ones(1, bool))


# ---- rows ------------------------------------------------------------------------------------------------------------


def _repeat_rows(x: np.ndarray, rows: int) -> np.ndarray:
    """An array (1, …) that all members share as one with a row for each; any other array as it is."""
    return np.broadcast_to(x, (rows, *x.shape[1:])) if len(x) == 1 else x


def portions(places: np.ndarray, numbers: np.ndarray, largest: int) -> list[np.ndarray]:
    """The places in portions that need no more than `largest` numbers together, or just one place."""
    if not len(places):
        return []
    portion = np.cumsum(numbers[places]) // largest
    return np.split(places, np.flatnonzero(np.diff(portion)) + 1)
