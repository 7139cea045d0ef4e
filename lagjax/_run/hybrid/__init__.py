"""Motion that changes its laws: modes, each a `System` of its own, and transitions between them.

    Hybrid ─► HybridPlan ─► _transition_motion ─► Ending ─► Trajectory
                             ├─ _transition_search: the events, by loops over numbers, laid out by _transition_places
                             ├─ _transition_replay: the same with derivatives
                             └─ _mode: one mode, its flow, its guards, the resets

Source: Aizerman & Gantmakher, Q. J. Mech. Appl. Math. 11 (1958) 225; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47
(2000) 204, §III.
"""

import dataclasses
import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import Problem
from lagjax._engine.taylor import MachineCode
from lagjax._equations import require_consistent
from lagjax._interface import (
    PUSHED,
    RESULTS,
    Layout,
    SimulationError,
    as_arrays,
    is_concrete,
    require_budget,
    require_flag,
    result_from,
)
from lagjax._run._trajectory import RunSettings, Trajectory, raise_unless_ok, run_in_doubles, run_single, step_counts
from lagjax._run.hybrid._mode import Transition
from lagjax._run.hybrid._transition_motion import HybridPlan, hybrid_motion, integrate_concrete
from lagjax._run.hybrid._transition_search import IN_ONE_PLACE
from lagjax._run.jumps import tolerances_of
from lagjax._scene import System, present_system, require_system

# The part of a motion below which a time between transitions is none: bounces that pile up come down to the rounding of
# the time before they are given up, and a reset that leaves a motion on its surface does so behind a longer one.
SUDDEN = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class Hybrid:
    r"""A motion that changes its laws, as one scene: `simulate` and others take it in place of a `System`.

    - `modes`: a `System` for each name; all share the structure of `q0` and `params`.
    - `transitions`: from which mode to which, and where. The earliest transition happens; of several at one instant,
      the first in the list. After it the same law holds as at the start (see `Transition`): guards that are at zero
      to rounding and continue in their direction follow at once, as do blows along a row of balls that touch, and those
      that are beyond it. What a stretch knows the next one remembers: from which side a guard comes that the reset has
      not moved, and that one without a reset has been crossed.
    - `start`: the name of the mode in which every motion begins, or its place in `modes`: an integer, which may be
      traced. So a `jax.lax.scan` over short motions continues each from `Hybrid(modes, transitions, run.mode[-1])`.
    - `max_transitions`: the budget of transitions. A motion that needs more ends there, with the result
      `max_transitions_reached`; or with `zeno` where no budget is enough because the times accumulate, as the bounces
      of a ball do. Intervals that shrink steadily to a sum before `ts[-1]`, or below the rounding of the time, count as
      accumulating. Transitions that go back and forth at one instant end with `transitions_in_turn`.

    `simulate` counts its `max_steps` for each stretch between transitions, and takes none of the options of engines.
    Its `Trajectory` has two more fields: `mode`, for every output time the place of its mode in `modes` (−1 where it
    was not reached; at the instant of a transition, the mode before it), and `transitions`: `t`, `q`, `qdot` just
    before the reset, `q_next`, `qdot_next` just after it, and `source`, `target` as places in `modes`, all of length
    `max_transitions` with NaN or −1 beyond the last, their `count`, whether the order of the list mattered
    (`order_matters`), and which guards were `let_out`.

    `jax.vmap`, `jax.jit` and `jax.grad` work around it, and every member of a batch switches at its own time. Times and
    states of transitions have first and second derivatives with respect to the initial state and params; third
    derivatives are not right. Of several transitions at one instant they are those in the order in which these
    happened: where resets do not commute, or the start touches a guard, derivatives from the other side are different.
    The time at which a guard jumps through zero is not varied, nor is that of a transition whose guard is beyond zero
    where its mode begins, against that beginning.

    A guard is examined along the whole of every step, and a step is shortened until the guard is smooth there: a guard
    that touches zero, or crosses it and comes back between two steps, is resolved. A reset to a state off the
    constraints of the new mode ends the motion with the result `inconsistent_start`.

    **Raises** `TypeError`, `ValueError` for arguments that cannot be right. Its motion needs scenes that have machine
    code (see `System.explain`), on the CPU.

    ```python
    import jax.numpy as jnp, lagjax

    ball = lagjax.System(lambda q, v: 0.5 * v**2 - 9.81 * q)
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.9 * v))
    run = lagjax.simulate(lagjax.Hybrid({"flight": ball}, [bounce], "flight"), 1.0, 0.0, jnp.linspace(0.0, 2.0, 9))
    run.transitions.t[: int(run.transitions.count)]
    ```
    """

    modes: dict[str, System]
    transitions: list[Transition]
    start: str | int | jax.Array
    max_transitions: int = 32

    def with_sections(self, functions: tuple, directions: tuple[int, ...], room: int) -> "Hybrid":
        """The scene with a further transition for each section in each mode, which changes nothing.

        The budget has room for `room` crossings of each section, and one more.
        """
        notes = [
            Transition(mode, mode, function, way, fires="crossing")
            for mode in self.modes
            for function, way in zip(functions, directions, strict=True)
        ]
        more = self.max_transitions + len(functions) * (room + 1)
        return Hybrid(self.modes, [*self.transitions, *notes], self.start, more)

    def _current_edition(self) -> "Hybrid":
        """The scene with the current values that its functions read: this one, if nothing has changed."""
        modes = {name: present_system(mode) for name, mode in self.modes.items()}
        transitions = [transition.now() for transition in self.transitions]
        before, now = [*self.modes.values(), *self.transitions], [*modes.values(), *transitions]
        same = all(map(operator.is_, before, now))
        return self if same else Hybrid(modes, transitions, self.start, self.max_transitions)

    @property
    def first(self) -> Any:
        """The number of the mode in which it begins, which may be traced."""
        return list(self.modes).index(self.start) if isinstance(self.start, str) else self.start

    def __repr__(self) -> str:
        return f"Hybrid of {', '.join(map(repr, self.modes))}, begins in {self.start!r}: {self.transitions}"

    def __post_init__(self):
        _require_modes(self.modes, self.transitions, self.start, self.max_transitions)


def simulate_modes(
    scene: Hybrid, q0: PyTree, qdot0: PyTree, ts, params: PyTree, rtol, atol, max_steps: int, throw: bool
) -> Trajectory:
    """The motion of a hybrid scene from (q0, qdot0); the arguments are those of `simulate`."""
    require_flag(throw, "throw")
    layout, scene = Layout.from_state(q0, qdot0), scene._current_edition()
    modes, start = scene.modes, scene.first
    first = first_law(scene)
    problem = Problem.from_arguments(first, layout, q0, qdot0, ts, params, rtol, atol, max_steps)
    tolerances = tolerances_of(problem, "a lagjax.Hybrid", "a reset")
    q0, qdot0 = as_arrays((q0, qdot0), layout.dtype, "state")
    if is_concrete(start):
        require_consistent(first, layout, problem.ts, q0, qdot0, problem.params)
    limits = scene.max_transitions, tolerances, problem.is_single
    plan = HybridPlan(tuple(modes), tuple(modes.values()), tuple(scene.transitions), *limits)
    if problem.is_known and is_concrete(start):
        found = jax.device_put(run_single(functools.partial(integrate_concrete, plan), problem, start))
    else:
        found = run_in_doubles(functools.partial(hybrid_motion, plan), problem, start)
    known = dataclasses.replace(problem, ts=jax.lax.stop_gradient(problem.ts))
    more = {"max_transitions": scene.max_transitions, "transitions": tuple(scene.transitions)}
    trajectory = Trajectory(
        ts=jnp.asarray(problem.ts), q=found.path[0], qdot=found.path[1], result=result_from(found.result),
        end=found.end, stats=step_counts(*found.steps), system=dict(modes), params=problem.params, mode=found.modes,
        transitions=found.transitions, mode_names=tuple(modes),
        tolerances=MachineCode().tolerances(known, jax.lax.stop_gradient(problem.y0)),
        settings=RunSettings.from_problem(problem, MachineCode(), **more),
    )  # fmt: skip
    return _raise_unless_ok(modes, trajectory, layout, found.mode) if throw else trajectory


def _raise_unless_ok(modes: dict[str, System], trajectory: Trajectory, layout: Layout, last) -> Trajectory:
    """The trajectory if it ended well; else `SimulationError`, which names the mode `last` in which it ended."""
    if not is_concrete(trajectory.ok) or trajectory.ok:
        return raise_unless_ok(trajectory, layout, lambda: None)
    name = trajectory.mode_names[int(last)]
    of_mode = dataclasses.replace(trajectory, system=modes[name])
    try:
        return raise_unless_ok(of_mode, layout, lambda: _explain_stop(trajectory, layout))
    except SimulationError as error:
        text = f"{error}\nIt was in the mode {name!r}.{_last_transitions(trajectory)}"
        raise SimulationError(text, trajectory) from None


def _explain_stop(trajectory: Trajectory, layout: Layout) -> str | None:
    """A sentence on why its transitions ended it; None if the result code tells that."""
    changes, names, modes = trajectory.transitions, trajectory.mode_names, trajectory.system
    assert changes is not None and isinstance(modes, dict)
    end, count = trajectory.end, int(changes.count)
    if trajectory.result == RESULTS.zeno:
        times = np.append(np.asarray(trajectory.ts)[0], np.asarray(changes.t)[:count])
        gaps, span = np.diff(times)[np.diff(times) > 0], float(end.t) - times[0]
        at_once = float(end.t) - times[-1] <= SUDDEN * span
        return PUSHED if at_once and (not gaps.size or gaps[-1] > SUDDEN * span) else None
    if trajectory.result != RESULTS.inconsistent_start or not count:
        return None
    last = jax.tree.map(lambda x: x[count - 1], (changes.source, changes.target, changes.q_next, changes.qdot_next))
    source, target, (q, qdot) = names[int(last[0])], names[int(last[1])], last[2:]
    try:
        require_consistent(modes[target], layout, jnp.stack([end.t, trajectory.ts[-1]]), q, qdot, trajectory.params)
    except ValueError as error:
        off = str(error).partition(" Put the state")[0].replace("q0 does", "q does").replace("qdot0 does", "qdot does")
        return (
            f"Behind the transition {source!r} → {target!r} the state is off the constraints of {target!r}: {off} Give "
            "the transition a reset that puts q and qdot there, as the pull of a string does that becomes taut: "
            "reset=lambda q, v: (q, v - (q @ v) / (q @ q) * q)."
        )
    return None


def _last_transitions(trajectory: Trajectory) -> str:
    """A sentence that names transitions that repeat without end; empty without any."""
    changes, names = trajectory.transitions, trajectory.mode_names
    assert changes is not None
    if trajectory.result not in (RESULTS.zeno, RESULTS.transitions_in_turn) or not int(changes.count):
        return ""
    last = [np.asarray(x)[int(changes.count) - 1 :: -1][:IN_ONE_PLACE] for x in (changes.source, changes.target)]
    pairs = dict.fromkeys(f"{names[i]!r} → {names[j]!r}" for i, j in zip(*last, strict=True))
    return f" The last transitions were {' and '.join(pairs)}."


def _is_mode(modes: dict[str, System], start: Any) -> bool:
    """True for the name of a mode or its number, which may be traced."""
    if isinstance(start, str):
        return start in modes
    if isinstance(start, bool) or not isinstance(start, int | np.integer | np.ndarray | jax.Array):
        return False
    if np.ndim(start) or not jnp.issubdtype(getattr(start, "dtype", int), jnp.integer):
        return False
    return not is_concrete(start) or 0 <= int(start) < len(modes)


def _require_modes(modes, transitions, start, max_transitions) -> None:
    if not isinstance(modes, dict) or not modes or not all(isinstance(m, System) for m in modes.values()):
        raise TypeError("modes must be a dict of lagjax.System by name.")
    if not isinstance(transitions, list | tuple):
        raise TypeError(f"transitions must be a list of lagjax.Transition; got {type(transitions).__name__}.")
    known = ", ".join(map(repr, modes))
    if not _is_mode(modes, start):
        raise ValueError(f"start is {start!r}, which is no mode: the modes are {known}.")
    for transition in transitions:
        if not isinstance(transition, Transition):
            raise TypeError(f"transitions must be lagjax.Transition; got {transition!r}.")
        for role in ("source", "target"):
            if (name := getattr(transition, role)) not in modes:
                raise ValueError(f"A transition has the {role} {name!r}, which is no mode: the modes are {known}.")
    if jax.tree.leaves((modes, transitions)):
        raise ValueError("A function of a mode or a transition holds arrays of its own: pass these in `params`.")
    reached, growing = {start} if isinstance(start, str) else {*modes}, True
    while growing:
        more = {t.target for t in transitions if t.source in reached} - reached
        reached, growing = reached | more, bool(more)
    if lost := [name for name in modes if name not in reached]:
        raise ValueError(
            f"No transition leads from {start!r} to {', '.join(map(repr, lost))}: unreachable. Add a transition to "
            "each of these modes, or leave them out."
        )
    require_budget(max_transitions, "max_transitions")


# ---- a scene of one law or of several --------------------------------------------------------------------------------

Scene = System | Hybrid


def require_scene(scene: Any) -> Scene:
    """The scene with current values of its functions. Raises `TypeError` for other than `System` or `Hybrid`."""
    return scene._current_edition() if isinstance(scene, Hybrid) else require_system(scene, contacts=True)


def may_jump(scene: Any) -> bool:
    """True if the motion of a scene may jump: a hybrid one, or one with contacts."""
    return isinstance(scene, Hybrid) or scene.touches


def begin_in(scene: Scene, mode: Any) -> Scene:
    """The scene, a hybrid one so that it begins in the mode of this number, which may be traced."""
    return dataclasses.replace(scene, start=mode) if isinstance(scene, Hybrid) else scene


def first_law(scene: Scene) -> System:
    """The `System`, or that of the mode in which a `Hybrid` begins: of any mode, if that is traced."""
    if not isinstance(scene, Hybrid):
        return scene
    return list_laws(scene)[int(scene.first) if is_concrete(scene.first) else 0]


def list_laws(scene: Scene) -> tuple[System, ...]:
    return tuple(scene.modes.values()) if isinstance(scene, Hybrid) else (scene,)
