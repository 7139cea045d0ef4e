"""First derivatives of a flow map, for rows of members: `jvp` along directions, `vjp` from cotangents.

Both replay the steps of the motion, which is run once more to record them: forward along each direction
(`_native.motions._tangent`), backward with each step transposed (`_native.motions._adjoint`). They are transposes of
each other to round-off, and as accurate as the motion if its steps are accurate for its tangents: if not, the steps are
divided (`_divide_steps`). The cost of `vjp` does not grow with the number of parameters. A name that ends in `_ct` is a
cotangent, one that ends in `_dot` a tangent.
"""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from lagjax import _native
from lagjax._engine._problem import Solution
from lagjax._engine.taylor._flow import EXCESS, Flow, Tolerances
from lagjax._engine.taylor._line_functions import Line
from lagjax._engine.taylor._passages import cut_steps, has_passages, part_passages
from lagjax._interface import SUCCESSFUL
from lagjax._native import Projection, Steps
from lagjax._program import pullback, pushforward
from lagjax._tracing import Program

LARGEST_PORTION = 2**23  # numbers of the steps that are written down at once: 64 MiB
_ROOM_AGAIN = 2  # times the steps that were taken: those of a first try are written, too
MOST_PARTS = 64  # of a step that is too long, at once
# How often steps are divided once more, and how many times as many there may be. A function that changes within 1e-3 of
# a step takes 7 turns, within 1e-9 of it 20: the series says that it diverges, but not how soon.
TRIES, MOST_DIVIDED = 24, 30
# After this many turns a function is so narrow that a step elsewhere may have passed over it unseen, as if it came at
# the end of the step. Tangents over steps that are cut near their ends differ then; otherwise by less than `AGREEMENT`
# of the limit, 1 as measured.
SURE_TURNS, AGREEMENT, _NEAR_ENDS = 4, 10.0, np.array([0.0, 0.5, 0.9, 0.99])
MOST_PROBES = 16  # directions along which steps that go past a border without a series are measured


class Motions(NamedTuple):
    """Runs of a flow to be differentiated: their inputs, and the results that tell how far they came."""

    ts: Any  # (1 or N, T)
    y0: Any  # (N, 2n)
    params: Any  # (1 or N, P)
    path: Any  # (N, T, 2n)
    result: Any  # (N,), as the others of the `Solution`
    accepted: Any
    rejected: Any

    @classmethod
    def from_solution(cls, ts, y0, params, solution: Solution) -> "Motions":
        return cls(ts, y0, params, solution.path, solution.result, solution.accepted, solution.rejected)

    def select_members(self, rows: np.ndarray) -> "Motions":
        """The members `rows` (R,); arrays with one row, shared by all, are kept."""
        shared = [len(x) == 1 and name in ("ts", "params") for name, x in self._asdict().items()]
        return Motions(*(x if alike else x[rows] for x, alike in zip(self, shared, strict=True)))


def jvp(flow: Flow, motions: Motions, dy0, dparams, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The derivative of `Flow.run` along m directions for each of N members, at fixed times.

    `dy0` (N, m, 2n), `dparams` (N, m, P) → δpath (N, m, T, 2n), NaN at times that the motion did not reach, and δy_end
    (N, m, 2n), NaN if it failed.
    """
    ts, y0, params, path, result, *_ = motions
    members, m = dy0.shape[:2]
    if flow.projection is not None:
        dy0 = project_start_tangents(flow.projection, ts[:, :1], y0, params, dy0, dparams)
    lanes = _native.lanes()  # of few members, one row of directions per thread or more
    groups = max(1, min(_native.cores() // members, math.ceil(m / lanes))) if members < lanes else 1
    directions = math.ceil(m / groups)
    padding = ((0, 0), (0, groups * directions - m), (0, 0))
    padded = (np.pad(x, padding).reshape(members * groups, directions, -1) for x in (dy0, dparams))
    *dots, unit = scale_directions(*padded)
    rows = np.repeat(np.arange(members), groups)
    path_dot, y_dot = _jvp_over_steps(flow, motions.select_members(rows), dots, tolerances)
    of_groups = path_dot * unit[..., None], y_dot * unit
    path_dot, y_dot = (x.reshape(members, groups * directions, *x.shape[2:])[:, :m] for x in of_groups)
    if flow.projection is not None and path.shape[1] > 2:
        inner = path_dot[:, :, 1:-1]
        given = *_inner_states(motions), inner, dparams[:, :, None]
        inner[:] = _differentiate_projection(pushforward, flow.projection, *given)
    path_dot[:, :, -1] = y_dot
    path_dot[~np.broadcast_to(np.isfinite(path)[:, None], path_dot.shape)] = np.nan
    y_dot[result != SUCCESSFUL] = np.nan
    return path_dot, y_dot


def scale_directions(dy0, dparams, library: Any = np) -> tuple:
    """Directions scaled to a largest entry of 1, as tolerances require, and the scales (…, 1)."""
    length = library.abs(library.concatenate([dy0, dparams], axis=-1)).max(axis=-1, initial=0.0, keepdims=True)
    unit = library.where(length > 0, length, 1.0)
    return dy0 / unit, dparams / unit, unit


def start_outputs(ts, dy0, path_dot, library: Any = np):
    """The tangents of outputs (N, m, T, 2n), with those of the start at outputs that are the start."""
    return library.where((ts == ts[:, :1])[:, None, :, None], dy0[:, :, None], path_dot)


def _jvp_over_steps(flow: Flow, motions: Motions, dots, tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The tangents of `jvp` over recorded steps, for a group of directions per row."""
    dy0, dparams = dots
    y_dot = np.array(dy0, np.float64)
    path_dot = np.full((*dy0.shape[:2], *motions.path.shape[1:]), np.nan)

    def advance_tangents(steps: Steps):
        rows, of = steps.rows, motions.select_members(steps.rows)
        given = of.ts, of.params, steps, dy0[rows], dparams[rows]
        path_dot[rows], y_dot[rows], excess = steps.kernel.jvp(*given, tolerances.floor)
        return excess / tolerances.largest_excess, (path_dot[rows], y_dot[rows])

    for row in _differentiate_steps(flow, motions, tolerances, advance_tangents, advance_tangents):
        path_dot[row], y_dot[row] = np.nan, np.nan
        if (m := dy0.shape[1]) > 1:  # steps may suit some of these directions
            alone = [x[row, :, None] for x in dots]
            of_each = _jvp_over_steps(flow, motions.select_members(np.full(m, row)), alone, tolerances)
            path_dot[row], y_dot[row] = (x[:, 0] for x in of_each)
    return start_outputs(motions.ts, dy0, path_dot), y_dot


# ---- vector–Jacobian products ---------------------------------------------------------------------------------------


def vjp(flow: Flow, motions: Motions, path_ct, end_ct, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The transpose of `jvp`: from m cotangents of the outputs of each of N motions to those of the inputs.

    `path_ct` (N, m, T, 2n) and `end_ct` (N, m, 2n) → cotangents of `y0` (N, m, 2n) and of `params` (N, m, P). A nonzero
    cotangent of an output that was not reached, or of the end of a motion that failed, makes all of them NaN: there is
    no derivative.
    """
    ts, y0, params, path, *_ = motions
    members, m = end_ct.shape[:2]
    if flow.turns or m > flow.states + flow.numbers:
        return _vjp_by_jacobian(flow, motions, path_ct, end_ct, tolerances)
    path_ct, lost = mask_cotangents(motions, path_ct, end_ct)
    params_ct = np.zeros((members, m, flow.numbers))
    if flow.projection is not None and path.shape[1] > 2:
        inner = path_ct[:, :, 1:-1]
        back = _differentiate_projection(pullback, flow.projection, *_inner_states(motions), inner)
        inner[:], params_ct = back[..., : flow.states], back[..., flow.states :].sum(axis=2)

    of_rows = motions.select_members(np.repeat(np.arange(members), m))
    go_back = functools.partial(_vjp_over_steps, flow, of_rows, tolerances=tolerances)
    path_ct, end_ct = (x.reshape(members * m, *x.shape[2:]) for x in (path_ct, end_ct))
    y_ct, more = (x.reshape(members, m, -1) for x in transpose_outputs(go_back, of_rows.ts, path_ct, end_ct))
    params_ct = params_ct + more
    if flow.projection is not None:
        start = y0[:, None], ts[:, None, :1], params[:, None]
        back = _differentiate_projection(pullback, flow.projection, *start, y_ct)
        y_ct, params_ct = back[..., : flow.states], params_ct + back[..., flow.states :]
    y_ct[lost], params_ct[lost] = np.nan, np.nan
    return y_ct, params_ct


def mask_cotangents(motions: Motions, path_ct, end_ct, library: Any = np) -> tuple:
    """Cotangents (N, m, T, 2n), zero at outputs that were not reached; and flags (N, m): a nonzero one was dropped."""
    reached, failed = library.isfinite(motions.path)[:, None], (motions.result != SUCCESSFUL)[:, None]
    lost = ((path_ct != 0) & ~reached).any(axis=(2, 3)) | ((end_ct != 0).any(axis=2) & failed)
    is_last = np.arange(path_ct.shape[2])[:, None] == path_ct.shape[2] - 1
    return library.where(reached & ~(failed[..., None, None] & is_last), path_ct, 0.0), lost


def transpose_outputs(go_back: Callable, ts, path_ct, end_ct, library: Any = np) -> tuple:
    """The cotangents of starts from those of outputs and ends, and further results of `go_back(path_ct, end_ct)`.

    `go_back` takes the outputs in between: the last one is the end of the motion, and some may be its start.
    """
    y_ct, *more = go_back(path_ct, end_ct + path_ct[:, -1])
    at_start = (ts == ts[:, :1])[:, :-1, None]
    return y_ct + library.sum(path_ct[:, :-1] * at_start, axis=1), *more


def _vjp_over_steps(flow: Flow, motions: Motions, path_ct, end_ct, tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The cotangents of `vjp` over recorded steps, for one cotangent per row."""
    y_ct, params_ct = np.full(end_ct.shape, np.nan), np.full((len(end_ct), flow.numbers), np.nan)
    inputs = flow.states + flow.numbers
    directions = np.random.default_rng(0).normal(size=(1, inputs))
    if has_passages(flow.kernel):
        directions = np.eye(some := min(inputs, MOST_PROBES))[:, np.arange(inputs) % some]

    def transpose_steps(steps: Steps):
        rows, of = steps.rows, motions.select_members(steps.rows)
        given = of.ts, of.params, steps, path_ct[rows], end_ct[rows]
        y_ct[rows], params_ct[rows], excess = steps.kernel.vjp(*given)
        return excess / tolerances.largest_excess, None

    def probe(steps: Steps):
        """The size of the last terms of a tangent's series along a random direction, in units of the limit.

        Inputs without a derivative are left out, since a NaN tangent gives no information. After a passage tangents
        fall strongly along one direction and not along others: there several are followed.
        """
        of = motions.select_members(steps.rows)
        found = np.isfinite(np.concatenate([y_ct[steps.rows], params_ct[steps.rows]], axis=1))
        y_dot, params_dot = np.split(np.where(found[:, None], directions, 0.0), [flow.states], axis=2)
        *tangents, excess = steps.kernel.jvp(of.ts, of.params, steps, y_dot, params_dot, tolerances.floor)
        is_finite = np.isfinite(tangents[1]).all(axis=-1).any(axis=-1)
        return np.where(is_finite, excess / tolerances.largest_excess, np.nan), tangents

    if lost := list(_differentiate_steps(flow, motions, tolerances, transpose_steps, probe)):
        of = motions.select_members(np.array(lost))
        inner = path_ct[lost] * (of.ts != of.ts[:, :1])[..., None]
        inner[:, -1] = 0.0
        again = _vjp_by_jacobian(flow, of, inner[:, None], end_ct[lost, None], tolerances)
        y_ct[lost], params_ct[lost] = (x[:, 0] for x in again)
    return y_ct, params_ct


def _vjp_by_jacobian(flow: Flow, motions: Motions, path_ct, end_ct, tolerances) -> tuple[np.ndarray, np.ndarray]:
    """The cotangents of `vjp` by the whole Jacobian. For more cotangents than inputs, and for a flow that `turns`."""
    inputs = flow.states + flow.numbers
    unit = np.broadcast_to(np.eye(inputs), (len(end_ct), inputs, inputs))
    path, end = jvp(flow, motions, unit[..., : flow.states], unit[..., flow.states :], tolerances)
    used = 0.0
    for letters, ct, moved in (("ts", path_ct, path), ("s", end_ct, end)):
        subscripts, found = f"nm{letters},nr{letters}->nmr", np.isfinite(moved)
        used = used + np.einsum(subscripts, ct, np.where(found, moved, 0.0))
        used[np.einsum(subscripts, 1.0 * (ct != 0), 1.0 * ~found) > 0] = np.nan
    return used[..., : flow.states], used[..., flow.states :]


# ---- projections -----------------------------------------------------------------------------------------------------
# Off the constraints a motion depends on where its steps end, for there it is projected; and a motion with tangents
# takes other steps. In its second derivative a start that moves on the constraints leaves them. So the motion is
# differentiated as if it began at the projection of its start, which is that start. Outputs between are projected too;
# that squares the distance to the constraints: its derivative at the projected state is that at the state before.


def project_start_tangents(projection: Projection, t, y0, params, dy0, dparams) -> np.ndarray:
    """The tangents (N, m, 2n) of the projected starts."""
    start = y0[:, None], t[:, None], params[:, None]
    return _differentiate_projection(pushforward, projection, *start, dy0, dparams)


def _inner_states(motions: Motions) -> tuple:
    """The states at the inner output times (the start if one was not reached), these times, and the parameters."""
    path = np.where(np.isfinite(motions.path), motions.path, motions.path[:, :1])
    return path[:, None, 1:-1], motions.ts[:, None, 1:-1, None], motions.params[:, None, None]


def _differentiate_projection(differentiate: Callable, projection: Projection, *parts) -> np.ndarray:
    """The pushforward or the pullback of a projection, at many states.

    `parts` (…, numbers) are the states, times and parameters, then tangents or cotangents.
    """
    line = _projection_line(differentiate, projection.state, parts[0].shape[-1])
    return line.evaluate(*parts)


@functools.lru_cache(maxsize=64)
def _projection_line(differentiate: Callable, program: Program, t: int) -> Line:
    """The derivative of a projection by all inputs except the time, input `t`, as a line."""
    by = [i for i in range(program.size) if i != t]
    line = differentiate(program.line, [np.dtype(float)] * program.size, by, range(t))
    size = program.size + (len(by) if differentiate is pushforward else t)
    return Line(line, size, size)


# ---- the steps that a derivative goes over ---------------------------------------------------------------------------


def _differentiate_steps(
    flow: Flow, motions: Motions, tolerances: Tolerances, go: Callable, probe: Callable
) -> Iterator[int]:
    """Call `go(steps)`, which differentiates over steps, for all rows; yield the rows without accurate steps.

    `go` and `probe` return the size of the last terms of the series, (R,), in units of the limit, and `probe` the
    tangents as well. That of `go` may be an upper bound; if `probe` exceeds 1, the steps are divided until they are
    accurate.
    """
    for steps in _record_steps(flow, motions, tolerances):
        limit = _last_term_limit(steps)
        excess, _ = go(steps)
        long = np.flatnonzero(excess > limit)
        if not long.size:
            continue
        steps = steps.select_members(long)
        excess = excess[long] if probe is go else probe(steps)[0]

        for k in np.flatnonzero(~(excess <= limit)).tolist():
            row = int(steps.rows[k])
            numbers = motions.params[row if len(motions.params) > 1 else 0]
            better = _suitable_steps(flow, steps.select_members([k]), numbers, tolerances, excess[k : k + 1], probe)
            if better is None:
                yield row
            elif probe is not go:
                go(better)


def _last_term_limit(steps: Steps) -> float:
    """The limit of last terms, in its own units: next to a root without a series, later terms are larger."""
    return 1 / EXCESS if has_passages(steps.kernel) else 1.0


def _record_steps(flow: Flow, motions: Motions, tolerances: Tolerances) -> Iterator[Steps]:
    """The recorded steps of all rows, which are run once more, in portions.

    To keep those of the first run would save a twentieth of the time in most cases, and a fifth at most.
    """
    for places in split_portions(np.arange(len(motions.y0)), motions.accepted * (flow.states + 4), LARGEST_PORTION):
        again = motions.select_members(places)
        room = _ROOM_AGAIN * int(again.accepted.sum()) + int(again.rejected.sum()) + len(places)
        for steps in flow.run_and_record(*again[:3], tolerances, room)[1]:
            if not has_passages(steps.kernel):
                yield steps._replace(rows=places[steps.rows])
                continue
            for k, row in enumerate(steps.rows):
                of = again.select_members(np.array([row]))
                parted = part_passages(flow, steps.select_members([k]), of.params[0], again.path[row, -1], tolerances)
                yield parted._replace(rows=places[[row]])


def _suitable_steps(flow: Flow, steps: Steps, params, tolerances, excess, measure: Callable) -> Steps | None:
    """The steps of one member, divided until they are accurate for its tangents; None if that fails.

    `excess` (1,), and the first result of `measure(steps)`, is the size of the last terms of the series, in units of
    the limit; the record has it for each step. If it does not fall as the steps of a constrained motion do, it is
    rounding, as near a dead centre: then its own steps are right.
    """
    divided, found = steps, []
    for turn in range(TRIES):
        before = float(excess[0])
        if math.isnan(before) or len(divided.table) > MOST_DIVIDED * (len(steps.table) + MOST_PARTS):
            break
        divided = _divide_steps(flow, divided, params, tolerances)
        excess, tangents = measure(divided)
        found.append((float(excess[0]), turn, divided))
        if excess <= _last_term_limit(steps):
            if turn < SURE_TURNS:
                return divided
            cut = cut_steps(flow, divided, [_NEAR_ENDS] * len(divided.table), params, tolerances)
            return cut if _tangents_agree(tangents, measure(cut)[1], tolerances) else None
        if flow.projection is not None and float(excess[0]) > 0.5 * before:
            measure(steps)
            return steps
    least, _, best = min(found, default=(math.inf, 0, None))
    return best if least <= 1.0 else None


def _tangents_agree(first, second, tolerances: Tolerances) -> bool:
    """True if tangents of outputs and ends over two sequences of steps are the same to the accuracy of these."""
    for a, b in zip(first, second, strict=True):
        size, difference = (np.nanmax(np.abs(x), initial=0.0) for x in (a, a - b))
        if not difference <= AGREEMENT * tolerances.largest_excess * size:
            return False
    return True


def _divide_steps(flow: Flow, steps: Steps, params, tolerances: Tolerances) -> Steps:
    """The steps of one member, with those that are too long divided."""
    ((_, rows),) = steps.split_members()
    excess = rows[:, 3] / (_last_term_limit(steps) * tolerances.largest_excess)
    long = np.where(excess > 1.0, excess, 0.0) ** (1 / (steps.order - 1))
    cuts = [np.arange(n) / n for n in np.ceil(np.clip(1.1 * long, 1, MOST_PARTS)).astype(int)]
    return cut_steps(flow, steps, cuts, params, tolerances)


def split_portions(places: np.ndarray, numbers: np.ndarray, largest: int) -> list[np.ndarray]:
    """The indices `places` in portions that need at most `largest` numbers together, or a single index."""
    if not len(places):
        return []
    portion = np.cumsum(numbers[places]) // largest
    return np.split(places, np.flatnonzero(np.diff(portion)) + 1)
