"""Counts of the borders that a motion crossed, slid along or grazed (`_program._borders`).

Crossings are recorded only when a run is prepared for derivatives. So the motion is integrated again in this way, over
the time that it took. That costs as much as the motion did; scenes without borders pay nothing.
"""

from typing import Any, NamedTuple

import numpy as np

from lagjax._engine import Problem
from lagjax._engine.taylor import Flow, Tolerances, flow_of, split_portions
from lagjax._equations import derivation_of, list_decisions
from lagjax._interface import Layout
from lagjax._native import StepEnd
from lagjax._program import Unlowerable
from lagjax._run import Members
from lagjax._scene import System
from lagjax._trust.health._measurements import sampled_path

LARGEST_COUNTED = 2**22  # numbers of steps that are written down at once


class BorderCounts(NamedTuple):
    """Counts, (N,) each, of how often a member crossed a border, began to slide along one, and grazed one."""

    crossed: Any
    slid: Any
    grazed: Any
    t: Any  # when it first grazed one, NaN where it did not


def count_borders(members: Members) -> tuple[bool, BorderCounts | None]:
    """Return whether steps ended at the borders of the scene, and the counts `BorderCounts`; None if not known."""
    trajectory = members.trajectory
    if not isinstance(trajectory.system, System):  # modes have transitions for that
        return True, None
    crossed, slid, grazed = (np.zeros(members.count, int) for _ in range(3))
    nothing = BorderCounts(crossed, slid, grazed, np.full(members.count, np.nan))
    if not is_piecewise(trajectory.system, members.layout, members.params):
        return True, nothing
    if trajectory.engine != "MachineCode" or trajectory.tolerances is None:
        return False, None
    path = sampled_path(members)
    start = np.concatenate([path.q[:, 0], path.qdot[:, 0]], axis=1)
    ts = np.stack([path.ts[:, 0], members.shared(trajectory.end.t, 0)], axis=1)
    steps = members.shared(trajectory.stats["num_steps"], 0)
    rtol, atol = (float(np.max(x)) for x in trajectory.tolerances)
    system, layout = trajectory.system, members.layout
    flow = flow_of(Problem.from_system(system, layout, members.params, ts=ts[0], rtol=rtol, atol=atol))
    if flow.kernel.borders is None:  # one without a series
        return False, None
    columns = [np.broadcast_to(x, members.count) for x in members.numbers]
    params = np.stack(columns, axis=1) if columns else np.zeros((members.count, 0))
    moved = np.flatnonzero(np.isfinite(start).all(axis=1) & (ts[:, 1] != ts[:, 0]) & (steps > 0))
    for some in split_portions(moved, steps * (flow.states + 5 + len(flow.kernel.borders.switches)), LARGEST_COUNTED):
        tolerances = Tolerances(rtol, atol, 2 * int(steps[some].max()) + 100)
        _count_contacts(flow, ts[some], start[some], params[some], tolerances, steps[some], some, nothing)
    return True, nothing


def is_piecewise(system: System, layout: Layout, params) -> bool:
    """True if the accelerations of a scene depend on comparisons whose result may change along a motion."""
    derivation = derivation_of(system, layout, params)
    try:
        return derivation.borders is not None and bool(derivation.borders.switches)
    except Unlowerable:  # arrays; as `_explanation` asks
        return bool(list_decisions(derivation.motion.functions, *derivation.state_shapes))


def _count_contacts(flow: Flow, ts, y0, params, tolerances: Tolerances, steps, places, into: BorderCounts) -> None:
    """Integrate some motions, and add their counts to `into` at their `places`, in place."""
    borders = flow.kernel.borders
    assert borders is not None  # without a series there are none, and none are counted
    guards, pieces = borders.guards, len(borders.switches)
    # The time reaches entries of tables, too, which are no borders.
    enters, leaves = (np.array([getattr(guard, name) >= 0 for guard in guards] + [False]) for name in ("slide", "on"))
    slides = sorted({guard.slide for guard in guards if guard.slide >= 0})
    for run in flow.run_and_record(ts, y0, params, tolerances, 2 * int(steps.sum()) + len(places))[1]:
        for row, table in run.split_members():
            place, (crossed, number), grazes = places[row], table[:, -3:-1].astype(int).T, table[:, -1] > 0
            along = table[:, flow.states + 4 : flow.states + 4 + pieces][:, slides] > 0.5
            begins = along & ~np.vstack([np.zeros((1, len(slides)), bool), along[:-1]])
            number = np.where(crossed == StepEnd.GUARD, number, len(guards))
            at_border = (crossed == StepEnd.GUARD) & ~leaves[number]
            # A border that the motion slides along from there on has not been crossed.
            to_slide = np.append(np.any(begins, axis=1)[1:], False) & enters[number]
            into.slid[place] += int(begins.sum())
            into.crossed[place] += int((at_border & ~to_slide).sum())
            into.grazed[place] += int(grazes.sum())
            if grazes.any():
                first = table[np.argmax(grazes)]
                into.t[place] = first[0] + first[1]
