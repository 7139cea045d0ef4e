"""Steps divided for tangents where a motion passes a root without a series.

A step that passes a point where a root has no series, as that of max(q, 0)**1.5, uses the series of the near side: a
force s^1.5 over a short time s is negligible for the motion. Its slope s^0.5 may matter for tangents. So such a step, a
*passage*, is divided into parts that grow geometrically from the border.
"""

import numpy as np

from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._native import Kernel, Steps
from lagjax._program import eliminate_dead_code

# The parts of a passage grow by `GROWTH`; of the first one, `NEAREST` of the passage, the slope is nothing either.
GROWTH, NEAREST = 1.6, 1e-6
_ROUNDING = 64 * np.finfo(float).eps  # of the time, or of coordinates: rounding of a passage


def has_passages(kernel: Kernel) -> bool:
    return kernel.borders is not None and bool(kernel.borders.root_arguments)


def part_passages(flow: Flow, steps: Steps, params, end, tolerances: Tolerances) -> Steps:
    """The steps of one member, with its passages divided; `end` (2n,) is the last state."""
    ((_, rows),) = steps.split_members()
    if not len(rows):  # of one that failed at once
        return steps
    states = np.concatenate([rows[:, 4 : 4 + flow.states], end[None]])
    t, h = np.append(rows[:, 0], rows[-1, 0] + rows[-1, 1]), rows[:, 1]
    pieces = rows[:, 4 + flow.states : -3] if rows.shape[1] > 4 + flow.states else rows[:, :0]
    u = _singular_arguments(steps, states, t, params, pieces[[*range(len(rows)), -1]])
    k, step = np.nonzero(u[:, :-1] * u[:, 1:] < 0)
    if not len(k):
        return steps
    u0, u1 = u[k, step], u[k, step + 1]
    at = u0 / (u0 - u1)  # as a part of the step, and closer by what it is there
    times = t[step] + at * h[step]
    order = np.argsort(times * h[0])
    there = np.empty((len(k), flow.states))
    there[order] = _states_at_times(flow, times[order], t, states[0], params, tolerances)
    now = _singular_arguments(steps, there, times, params, pieces[step])[k, np.arange(len(k))]
    is_before = now * u0 > 0
    at = np.where(is_before, at + (1 - at) * now / (now - u1), at * u0 / (u0 - now))
    parts = GROWTH ** -np.arange(-np.log(NEAREST) / np.log(GROWTH))
    cuts = [np.zeros(1)] * len(rows)
    unknown = _ROUNDING * np.maximum(abs(t[step] / h[step]), abs(states[step, : flow.size]).max(axis=1) / abs(u1 - u0))
    for i, place, least in zip(step, at, unknown, strict=True):
        before, behind = place * parts, (1 - place) * parts[1:]
        cuts[i] = np.concatenate([cuts[i], place - before[before > least], place + behind[behind > least]])
    return cut_steps(flow, steps, [np.unique(cut) for cut in cuts], params, tolerances)


def _singular_arguments(steps: Steps, states, t, params, pieces) -> np.ndarray:
    """The numbers (K, S) that are zero where a root has no series, at S states of a member."""
    borders, chosen = steps.kernel.borders, steps.kernel.chosen
    assert borders is not None
    line = eliminate_dead_code(borders.program.line, borders.root_arguments)
    numbers = params if chosen is None else params[list(chosen.positions)]
    return line.evaluate([*states.T, t, *np.broadcast_to(numbers, (len(t), len(numbers))).T, *pieces.T])


def cut_steps(flow: Flow, steps: Steps, cuts: list[np.ndarray], params, tolerances: Tolerances) -> Steps:
    """The steps of one member, divided at these fractions `cuts` of each, with states of the motion there."""
    ((_, rows),) = steps.split_members()
    of = np.repeat(np.arange(len(rows)), [len(some) for some in cuts])
    table, part = rows[of], np.concatenate(cuts)
    table[:, 0] += rows[of, 1] * part
    end = rows[-1, 0] + rows[-1, 1]
    table[:, 1], inner = np.diff(np.append(table[:, 0], end)), part > 0
    first, t = rows[0, 4 : 4 + flow.states], [rows[0, 0], end]
    table[inner, 4 : 4 + flow.states] = _states_at_times(flow, table[inner, 0], t, first, params, tolerances)
    if rows.shape[1] > 4 + flow.states:  # which border it ends at, and whether that is grazed
        table[np.append(of[1:] == of[:-1], False), -3:] = 0.0
    return steps._replace(table=table, first=np.zeros(1, int), counts=np.array([len(table)]))


def _states_at_times(flow: Flow, times, t, first, params, tolerances: Tolerances) -> np.ndarray:
    """The states of a motion at `times` in between, from its `first` state; `t` has its own times, start and end."""
    ts = np.concatenate([t[:1], times, t[-1:]])
    return flow.run_and_record(ts[None], first[None], params[None], tolerances)[0].path[0, 1:-1]
