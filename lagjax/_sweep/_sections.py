"""Motions of a batch with their crossings of sections on the way, as `lagjax.crossings` finds them.

Where a motion has two output times, its start and its end, both come from one run, which notes the crossings and goes
on. States at times between come from another run of the same motion.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from lagjax._consistent import has_constraints
from lagjax._crossings import as_crossings, directions_of, sections_of, surfaces_in
from lagjax._hybrid import Hybrid, Scene, follow
from lagjax._machine_code import MachineCode, Noted, flow_of, tolerances_of
from lagjax._problem import Batch, Solution, axes_per_leaf
from lagjax._results import RESULTS, SUCCESSFUL, code_of
from lagjax._simulate import simulate_batch, trajectory_of
from lagjax._trajectory import Trajectory
from lagjax._validate import as_arrays, require_budget

PyTree = Any
_INCONSISTENT = code_of(RESULTS.inconsistent_start)
_ARGUMENTS = ("section", "direction", "count")


class Sections(NamedTuple):
    """The sections to watch: functions of (q, qdot) and, by name, `t` and `params`; how they change; room for each.

    `names` are those of a dict of sections, None for one function.
    """

    names: tuple[str, ...] | None
    functions: tuple[Callable, ...]
    directions: tuple[int, ...]
    count: int

    @classmethod
    def of(cls, crossings: Any, keep: Callable, settings: dict[str, Any]) -> "Sections | None":
        """From the arguments of `sweep`. Raises `TypeError` or `ValueError` where they cannot be right."""
        asked = "crossings" in _parameters(keep)
        if crossings is None:
            if asked:
                raise ValueError("keep asks for `crossings`: say which, by crossings={'section': a function}.")
            return None
        if not isinstance(crossings, dict) or "section" not in crossings or not set(crossings) <= set(_ARGUMENTS):
            raise TypeError(
                "crossings must be a dict with arguments of lagjax.crossings: section, perhaps direction and count; "
                f"got {list(crossings) if isinstance(crossings, dict) else crossings!r}."
            )
        if not asked:
            raise ValueError(
                "crossings are found for keep, which does not ask for them: write keep(trajectory, crossings)."
            )
        if settings["event"] is not None:
            raise ValueError("An event ends the motion, and crossings do not: give one of the two.")
        if not isinstance(settings["solver"], MachineCode | None):
            raise ValueError("crossings are found in machine code: leave solver at None.")
        section = crossings["section"]
        names, _ = sections_of(section)
        require_budget(crossings.get("count", 64), "count")
        directions = directions_of(crossings.get("direction", 0), names)
        functions = (section,) if names is None else tuple(section.values())
        return cls(names, functions, directions, int(crossings.get("count", 64)))

    def described(self) -> dict:
        """The part that is no function of them, for the store."""
        names = None if self.names is None else list(self.names)
        return {"names": names, "directions": list(self.directions), "count": self.count}

    def by_name(self) -> dict[str, Callable]:
        """The functions, by what a store calls them."""
        return dict(zip(self.names or ("section",), self.functions, strict=True))

    def bytes_of(self, states: int) -> int:
        """The notes on a member whose state has this many numbers."""
        return 8 * len(self.functions) * (self.count + 1) * (states + 1)


def _parameters(keep: Callable) -> list[str]:
    try:
        return list(inspect.signature(keep).parameters)
    except (TypeError, ValueError):  # of what is written in C
        return []


@functools.lru_cache(maxsize=8)
def _hybrid_batch(scene: Hybrid, axes: tuple, **tolerances) -> Callable:
    """`follow` for all members at once, compiled."""

    def of_member(q0, qdot0, ts, params):
        return follow(scene, q0, qdot0, ts, params, throw=False, **tolerances)

    of_q0, of_qdot0, of_params = axes
    return jax.jit(jax.vmap(of_member, in_axes=(of_q0, of_qdot0, None, of_params)))


def run_batch(
    system: Scene, values: dict[str, PyTree], ts, axes: tuple, settings: dict[str, Any], sections: Sections | None
) -> tuple[Trajectory, Any]:
    """The motions of B members, and what was noted on the way: `Crossings`, or a dict of them, None without sections.

    `values` are q0, qdot0 and params by name, and `axes` their `batch_axes` of `simulate_batch`. Every leaf of the
    crossings has the members in front.
    """
    q0, qdot0, params = values.values()
    if isinstance(system, Hybrid):
        tolerances = {name: settings[name] for name in ("rtol", "atol", "max_steps")}
        return _hybrid_batch(system, axes, **tolerances)(q0, qdot0, ts, params), None
    if sections is None:
        return simulate_batch(system, q0, qdot0, ts, params, batch_axes=axes, **settings), None
    of_leaves, size = axes_per_leaf(values, axes)
    batch = Batch.of(system, values, of_leaves, size, ts, settings["rtol"], settings["atol"], settings["max_steps"])
    solution, noted = _along(batch, sections)
    if len(ts) == 2 and not has_constraints(system):
        params = as_arrays(params, batch.member.layout.dtype)
        run = trajectory_of(batch.member, MachineCode(), _with_ends(solution, batch), batch.y0, params, axes[2])
    else:
        run = simulate_batch(system, q0, qdot0, ts, params, batch_axes=axes, **settings)
        noted = _of_those_that_start(noted, np.asarray(run.result._value) != _INCONSISTENT)
    ok = (solution.result == SUCCESSFUL) & (noted.count <= sections.count)
    return run, as_crossings(batch.member.layout, sections.names, noted, ok)


def _along(batch: Batch, sections: Sections) -> tuple[Solution, Noted]:
    """The motions from the first to the last time, and the crossings of G sections, each with that axis in front."""
    section = dict(sections.by_name()) if sections.names else sections.functions[0]
    surfaces = surfaces_in(batch.member, sections_of(section)[1], sections.directions, sections.names)
    problem = dataclasses.replace(batch.member, guards=surfaces.guards(notes=True))
    tolerances = tolerances_of(problem)._replace(notes=sections.count)
    ts, y0, params = (np.asarray(x) for x in (problem.ts, batch.y0, batch.vectors))
    solution = flow_of(problem).run(ts[None], y0, params, tolerances)
    path = solution.path.reshape(len(y0), len(sections.functions), sections.count + 1, -1)
    rows = np.moveaxis(path, 1, 0)
    return solution, Noted(rows[:, :, :-1, 0], rows[:, :, :-1, 1:], rows[:, :, -1, 0])


def _with_ends(solution: Solution, batch: Batch) -> Solution:
    """The solution with the states at the first and the last time, NaN where that was not reached, as its path."""
    reached = (solution.result == SUCCESSFUL)[:, None]
    path = np.stack([np.asarray(batch.y0), np.where(reached, solution.y_end, np.nan)], axis=1)
    return solution._replace(path=path)


def _of_those_that_start(noted: Noted, starts: np.ndarray) -> Noted:
    """The same without the crossings of members that are not on their constraints, and were not to be followed."""
    t, y = np.where(starts[:, None], noted.t, np.nan), np.where(starts[:, None, None], noted.y, np.nan)
    return Noted(t, y, np.where(starts, noted.count, 0))
