"""First derivatives of a flow map, for rows of members: `jvp` along directions, `vjp` from cotangents.

`jvp` runs the tangent flow, whose coordinates are those of the motion and of its tangents (`_tangent`). `vjp` goes back
over the steps of the motion itself, each transposed (`_native._adjoint`): its cost does not grow with the number of
parameters. The two agree within the tolerance. A name that ends in `_ct` is a cotangent, as in JAX.
"""

import functools
import math

import numpy as np

from lagjax._machine_code._flow import Flow, Tolerances
from lagjax._machine_code._steps import KEPT, StepStore
from lagjax._machine_code._tangent import from_rows, to_rows
from lagjax._native import Projection
from lagjax._program import Program, StraightLine, evaluate, pullback
from lagjax._results import SUCCESSFUL

# Directions that are followed side by side, and coordinates (those of the motion included) that may come of it: more
# share the work on the motion among more tangents, and take LLVM longer.
MOST_DIRECTIONS, MOST_TANGENT_COORDINATES = 8, 40
LARGEST_PORTION = 2**23  # numbers of the steps that are written down at once: 64 MiB


def jvp(flow: Flow, ts, y0, params, dy0, dparams, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The derivative of `Flow.run` along m directions for each of N members, between fixed times.

    `dy0` (N, m, 2n), `dparams` (N, m, P) → δpath (N, m, T, 2n), NaN where the motion did not come, and δy_end
    (N, m, 2n), NaN where it failed. Each direction is followed in units of its largest number, so that the tolerances
    mean the same for tangents of any length.
    """
    members, m = dy0.shape[:2]
    widest = max(1, min(MOST_DIRECTIONS, MOST_TANGENT_COORDINATES // flow.size - 1))
    groups = math.ceil(m / widest)
    directions = math.ceil(m / groups)
    padding = ((0, 0), (0, groups * directions - m), (0, 0))
    dy0, dparams = (np.pad(x, padding).reshape(members * groups, directions, -1) for x in (dy0, dparams))
    length = np.abs(np.concatenate([dy0, dparams], axis=2)).max(axis=2, initial=0.0, keepdims=True)
    unit = np.where(length > 0, length, 1.0)
    y0, params = (np.repeat(x, groups, axis=0) for x in (y0, _for_all(params, members)))
    ts = ts if len(ts) == 1 else np.repeat(ts, groups, axis=0)
    start = np.concatenate([y0[:, None], dy0 / unit], axis=1)  # (rows, 1 + D, 2n)
    numbers = np.concatenate([params[:, None], dparams / unit], axis=1).reshape(len(start), -1)
    tangent = flow.tangent(directions)
    solution = tangent.follow(ts, from_rows(start), numbers, tolerances.with_larger_budget)
    lengths = unit.reshape(len(start), directions, 1)
    path, end = (to_rows(x, flow.size)[..., 1:, :] for x in (solution.path, solution.y_end))
    path, end = path * lengths[:, None], end * lengths
    end[solution.result != SUCCESSFUL] = np.nan
    path = np.moveaxis(path, -2, 1).reshape(members, groups * directions, *path.shape[1:-2], flow.states)
    return path[:, :m], end.reshape(members, groups * directions, flow.states)[:, :m]


# ---- vector–Jacobian products ---------------------------------------------------------------------------------------


def vjp(flow: Flow, ts, y0, params, solution, path_ct, end_ct, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The transpose of `jvp`: from m cotangents of the outputs of each of N motions to those of what went in.

    `solution` is (path, result, accepted, ticket) of the run; `path_ct` (N, m, T, 2n) and `end_ct` (N, m, 2n) →
    cotangents of `y0` (N, m, 2n) and of `params` (N, m, P). A cotangent that is not zero, of an output that was
    not reached or of the end of a motion that failed, makes all of them NaN: there is no derivative.
    """
    path, result, accepted, ticket = solution
    members, m = end_ct.shape[:2]
    if m > flow.states + flow.numbers and flow.size * (1 + flow.states + flow.numbers) <= MOST_TANGENT_COORDINATES:
        return _vjp_by_jacobian(flow, ts, y0, params, path_ct, end_ct, tolerances)
    reached = np.isfinite(path)[:, None]
    lost = ((path_ct != 0) & ~reached).any(axis=(2, 3))
    lost |= (end_ct != 0).any(axis=2) & (result != SUCCESSFUL)[:, None]
    path_ct = np.where(reached, path_ct, 0.0)
    params = _for_all(params, members)
    params_ct = np.zeros((members, m, flow.numbers))
    if flow.projection is not None and path.shape[1] > 2:
        _through_projection(flow, flow.projection, ts, path, params, path_ct, params_ct)
    done = (result == SUCCESSFUL)[:, None, None]
    end_ct = end_ct + np.where(done, path_ct[:, :, -1], 0.0)
    path_ct[:, :, -1] = 0.0

    rows = np.repeat(np.arange(members), m)
    ts = ts if len(ts) == 1 else ts[rows]
    y_ct, more = _vjp_over_steps(
        flow, ts, y0[rows], params[rows], accepted[rows], ticket[rows], path_ct.reshape(members * m, *path.shape[1:]),
        end_ct.reshape(members * m, -1), tolerances,
    )  # fmt: skip
    y_ct, more = y_ct.reshape(members, m, -1), more.reshape(members, m, -1) + params_ct
    y_ct[lost], more[lost] = np.nan, np.nan
    return y_ct, more


def _vjp_over_steps(
    flow: Flow, ts, y0, params, accepted, ticket, path_ct, end_ct, tolerances
) -> tuple[np.ndarray, np.ndarray]:
    """`vjp` of one cotangent a row, over the steps that are kept; motions whose steps are gone are run once more."""
    y_ct, params_ct = np.full(end_ct.shape, np.nan), np.full((len(y0), flow.numbers), np.nan)
    waiting = np.ones(len(y0), bool)

    def back(store: StepStore, tickets, places):
        for steps, some, members in store.runs(tickets):
            rows = places[some]
            y_ct[rows], params_ct[rows] = steps.kernel.vjp(
                ts if len(ts) == 1 else ts[rows], params[rows], steps.table, steps.first[members],
                steps.counts[members], path_ct[rows], end_ct[rows], steps.order,
            )  # fmt: skip
            waiting[rows] = False

    back(KEPT, ticket, np.arange(len(y0)))
    for places in _portions(np.flatnonzero(waiting), accepted * (flow.states + 2)):
        store = StepStore()
        some_ts = ts if len(ts) == 1 else ts[places]
        again = flow.follow(some_ts, y0[places], params[places], tolerances, store, accepted[places])
        back(store, again.ticket, places)
    at_start = (ts == ts[:, :1])[:, :, None]  # outputs that are the initial state; steps begin after them
    return y_ct + np.sum(path_ct * at_start, axis=1), params_ct


def _vjp_by_jacobian(flow: Flow, ts, y0, params, path_ct, end_ct, tolerances) -> tuple[np.ndarray, np.ndarray]:
    """`vjp` from the whole Jacobian: for more cotangents than there are numbers that vary."""
    inputs = flow.states + flow.numbers
    unit = np.broadcast_to(np.eye(inputs), (len(y0), inputs, inputs))
    path, end = jvp(flow, ts, y0, params, unit[..., : flow.states], unit[..., flow.states :], tolerances)
    used = np.einsum("nmts,nrts->nmr", path_ct, np.where(np.isfinite(path), path, 0.0))
    used += np.einsum("nms,nrs->nmr", end_ct, np.where(np.isfinite(end), end, 0.0))
    path_lost, end_lost = (~np.all(np.isfinite(x), axis=1, keepdims=True) for x in (path, end))
    lost = ((path_ct != 0) & path_lost).any(axis=(2, 3)) | ((end_ct != 0) & end_lost).any(axis=2)
    used[lost] = np.nan
    return used[..., : flow.states], used[..., flow.states :]


def _through_projection(flow: Flow, projection: Projection, ts, path, params, path_ct, params_ct) -> None:
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
    back = evaluate(_transposed(projection.state, flow.states), list(np.concatenate(columns))).T
    back = back.reshape(*place.shape[:-1], -1)
    path_ct[:, :, 1:-1] = back[..., : flow.states]
    params_ct += back[..., flow.states :].sum(axis=2)


@functools.lru_cache(maxsize=64)
def _transposed(program: Program, t: int) -> StraightLine:
    """From the inputs and output cotangents of a projection to the cotangents of its inputs but the time, input `t`."""
    by = [i for i in range(program.size) if i != t]
    return pullback(program.line, [np.dtype(float)] * program.size, by, range(t))


# ---- rows ------------------------------------------------------------------------------------------------------------


def _for_all(x: np.ndarray, rows: int) -> np.ndarray:
    """An array (1, …) that all members share as one with a row for each; any other array as it is."""
    return np.broadcast_to(x, (rows, *x.shape[1:])) if len(x) == 1 else x


def _portions(places: np.ndarray, numbers: np.ndarray) -> list[np.ndarray]:
    """The places in portions that need no more than `LARGEST_PORTION` numbers together, or just one place."""
    if not len(places):
        return []
    portion = np.cumsum(numbers[places]) // LARGEST_PORTION
    return np.split(places, np.flatnonzero(np.diff(portion)) + 1)
