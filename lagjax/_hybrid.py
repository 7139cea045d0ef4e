"""Motion that changes its laws: modes, each a `System` of its own, and transitions between them.

A round runs every member to the end of its time or to the next zero of a guard of its mode, writes down the outputs on
the way, and puts it into the next mode. Where a guard vanishes is found by machine code (`_native`), without
derivatives. They come from two places: along a round from those of the flow, and at its end from the implicit function:
with g the guard and ġ its rate along the motion,

    dt* = −dg / ġ        dy* = dy + ẏ dt*

and the same to second order (`_Rounds._crossing`), after which the reset is differentiated like any function. Together
these are the jump of a sensitivity at an event ("saltation matrix"). Source: Aizerman & Gantmakher, Q. J. Mech. Appl.
Math. 11 (1958) 225; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204, §III.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._arguments import Function, accept
from lagjax._consistent import TOLERANCE, require_consistent
from lagjax._custom import differentiated_as
from lagjax._derivation import Derivation
from lagjax._failures import lost_unless
from lagjax._layout import Layout, as_vector
from lagjax._machine_code import MachineCode, flow_of
from lagjax._motion import Motion
from lagjax._native import Guards
from lagjax._problem import Problem, Solution
from lagjax._program import Program, Unlowerable, lower
from lagjax._results import RESULTS, SUCCESSFUL, SimulationError, code_of, result_from
from lagjax._simulate import raise_unless_ok
from lagjax._system import System
from lagjax._trajectory import State, Trajectory, Transitions
from lagjax._validate import as_arrays, is_concrete, require_budget, require_flag

PyTree = Any


class Transition(eqx.Module):
    """From mode `source` to mode `target` where `guard(q, qdot)` changes sign.

    - `guard`: a real function; it may also ask, by name, for `t`, `params` and `multipliers`, the last as the
      constraints of the mode return them.
    - `direction`: −1 only when it falls, +1 only when it rises, 0 either way. A motion that begins on the surface has
      to leave it first.
    - `reset(q, qdot)` → (q, qdot): the state after the transition; it may also ask for `t` and `params`. None keeps it.

    Raises `TypeError` or `ValueError` for what cannot be a transition.

    ```python
    import lagjax

    floor = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    ```
    """

    source: str = eqx.field(static=True)
    target: str = eqx.field(static=True)
    guard: Function
    direction: int = eqx.field(static=True)
    reset: Function | None

    def __init__(self, source: str, target: str, guard: Callable, direction: int = 0, reset: Callable | None = None):
        for role, name in (("source", source), ("target", target)):
            if not isinstance(name, str):
                raise TypeError(f"{role} must be the name of a mode; got {name!r}.")
        if isinstance(direction, bool) or not isinstance(direction, int | np.integer) or abs(direction) > 1:
            raise ValueError(f"direction must be -1 (falling), +1 (rising) or 0 (both); got {direction!r}.")
        if guard is None:
            raise TypeError(f"The transition from {source!r} to {target!r} has no guard: say where it happens.")
        self.source, self.target, self.direction = source, target, int(direction)
        self.guard = accept(guard, "guard", extras=("t", "params", "multipliers"))
        self.reset = None if reset is None else accept(reset, "reset")


def simulate_hybrid(
    modes: dict[str, System],
    transitions: list[Transition],
    start: str,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    *,
    max_transitions: int = 32,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 65_536,
    throw: bool = True,
) -> Trajectory:
    r"""The motion from (q0, qdot0) in mode `start`, at the times `ts`, through every transition on the way.

    - `modes`: a `System` for each name; all share the structure of `q0` and `params`.
    - `transitions`: which mode gives way to which, and where; the earliest one wins, the first listed of several at one
      instant. The others then follow at once if the mode is the same and the reset has not changed their guards.
    - `max_transitions`: the budget of transitions. A motion that needs more ends there and says so, with the result
      `max_transitions_reached`; or `zeno` where no budget is enough: where their times pile up as the bounces of a ball
      do, seen by intervals that shrink steadily to a sum before `ts[-1]`, or to less than rounding leaves of the time.

    The other arguments are those of `simulate`, `max_steps` counting for each stretch between transitions. The result
    is a `Trajectory` with two more fields: `mode`, for every output time the place of its mode in `modes` (−1 where it
    was not reached; at the instant of a transition, the mode before it), and `transitions`: `t`, `q`, `qdot` just
    before the reset, and `source`, `target` as places in `modes`, all of length `max_transitions` with NaN or −1 beyond
    the last, and their `count`.

    Every member of a batch switches at its own time: use `jax.vmap`, `jax.jit` and `jax.grad` around it. Times and
    states of transitions have first and second derivatives by the initial state and by params; third ones are not
    right.

    A guard is looked at along the whole of every step, and a step is shortened until it is smooth there: one that
    touches zero, or crosses it and comes back between two steps, is seen for what it is. A state that a reset leaves
    off the constraints of its new mode ends the motion with the result `inconsistent_start`.

    **Raises** `TypeError`, `ValueError` for arguments that cannot be right, `SimulationError` as `simulate` does. It
    needs scenes that have machine code (see `System.explain`): float64, on the CPU.

    ```python
    import jax.numpy as jnp, lagjax

    ball = lagjax.System(lambda q, v: 0.5 * v**2 - 9.81 * q)
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.9 * v))
    run = lagjax.simulate_hybrid({"flight": ball}, [bounce], "flight", 1.0, 0.0, jnp.linspace(0.0, 2.0, 9))
    run.transitions.t[: int(run.transitions.count)]
    ```
    """
    require_flag(throw, "throw")
    layout = Layout.of(q0, qdot0)
    _require_modes(modes, transitions, start, max_transitions)
    problem = Problem.of(modes[start], layout, q0, qdot0, ts, params, rtol, atol, max_steps)
    if not all(map(is_concrete, problem.tolerances)):
        raise ValueError("rtol and atol of simulate_hybrid must be numbers: they decide the order of the method.")
    if is_concrete(problem.ts) and np.asarray(problem.ts)[-1] < np.asarray(problem.ts)[0]:
        raise ValueError("simulate_hybrid goes forward in time: a reset cannot be undone; ts must increase.")
    q0, qdot0 = as_arrays((q0, qdot0), layout.dtype)
    require_consistent(modes[start], layout, problem.ts, q0, qdot0, problem.params)
    tolerances = tuple(map(float, problem.tolerances))
    plan = _Plan(tuple(modes), tuple(modes.values()), tuple(transitions), start, max_transitions, tolerances, max_steps)
    *fields, last = _run(plan, layout, problem.ts, problem.y0, problem.params)
    trajectory = Trajectory(
        *fields[:6], dict(modes), problem.params, None, *fields[6:], tuple(modes), problem.tolerances
    )
    return _raise_unless_ok(trajectory, layout, last) if throw else trajectory


def _raise_unless_ok(trajectory: Trajectory, layout: Layout, last) -> Trajectory:
    """The same as for one scene, naming the mode in which it ended."""
    if not is_concrete(trajectory.ok) or trajectory.ok:
        return raise_unless_ok(trajectory, layout)
    name = trajectory.mode_names[int(last)]
    try:
        raise_unless_ok(dataclasses.replace(trajectory, system=trajectory.system[name]), layout)
    except SimulationError as error:
        raise SimulationError(f"{error}\nIt was in the mode {name!r}.", trajectory) from None


def _require_modes(modes, transitions, start, max_transitions) -> None:
    if not isinstance(modes, dict) or not modes or not all(isinstance(m, System) for m in modes.values()):
        raise TypeError("modes must be a dict of lagjax.System by name.")
    if not isinstance(transitions, list | tuple):
        raise TypeError(f"transitions must be a list of lagjax.Transition; got {type(transitions).__name__}.")
    known = ", ".join(map(repr, modes))
    if not isinstance(start, str) or start not in modes:
        raise ValueError(f"The motion is to start in the mode {start!r}, which does not exist; there are {known}.")
    for transition in transitions:
        if not isinstance(transition, Transition):
            raise TypeError(f"transitions must be lagjax.Transition; got {transition!r}.")
        for role in ("source", "target"):
            if getattr(transition, role) not in modes:
                name = getattr(transition, role)
                raise ValueError(f"A transition has the {role} {name!r}, which does not exist; there are {known}.")
    if jax.tree.leaves((modes, transitions)):
        raise ValueError("A function of a mode or a transition holds arrays of its own: give them as params.")
    reached, growing = {start}, True
    while growing:
        more = {t.target for t in transitions if t.source in reached} - reached
        reached, growing = reached | more, bool(more)
    if lost := [name for name in modes if name not in reached]:
        raise ValueError(f"No transition leads from {start!r} to {', '.join(map(repr, lost))}: unreachable.")
    require_budget(max_transitions, "max_transitions")


class _Plan(eqx.Module):
    """What does not change from run to run."""

    names: tuple[str, ...] = eqx.field(static=True)
    systems: tuple[System, ...]
    transitions: tuple[Transition, ...]
    start: str = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    tolerances: tuple[float, float] = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def leaving(self, mode: int) -> list[tuple[int, Transition]]:
        """The transitions from a mode, with their places among all."""
        return [(k, t) for k, t in enumerate(self.transitions) if t.source == self.names[mode]]


class _Mode(NamedTuple):
    """One mode: a problem that lacks a state and times, its guards as programs, and how each has to change sign.

    `surfaces` gives the values of the guards from (q, q̇, t, params), `guards` what `_native.Guards` wants.
    """

    problem: Problem
    surfaces: Program | None
    guards: Program | None
    directions: tuple[int, ...]

    def solve(self, ts, y0) -> Solution:
        """The motion over these times, with its derivatives."""
        return MachineCode().solve(dataclasses.replace(self.problem, ts=ts, y0=y0))

    def solve_to_event(self, ts, y0) -> Solution:
        """The motion to the last of these times, or to the first zero of a guard; it has no derivatives."""
        guards = None if self.guards is None else Guards(self.guards, self.directions)
        return MachineCode().solve(dataclasses.replace(self.problem, ts=ts, y0=y0, guards=guards))


# ---- one run ---------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _run(plan: _Plan, layout: Layout, ts, y0, params):
    ts, y0 = jnp.asarray(ts), jnp.asarray(y0)
    vector = as_vector(eqx.filter(params, eqx.is_array_like), layout.dtype)
    modes = [_mode(plan, i, layout, params) for i in range(len(plan.systems))]
    rounds = _Rounds(plan, layout, modes, ts, params, vector)
    start = plan.names.index(plan.start)
    astray = rounds.astray(start, ts[0], y0)
    first = _Carry(
        t=ts[0], y=y0, mode=jnp.asarray(start), going=~astray, result=jnp.where(astray, INCONSISTENT, SUCCESSFUL),
        path=jnp.full((ts.size, y0.size), jnp.nan), modes=jnp.full(ts.size, -1), steps=jnp.zeros(2, int),
        latest=jnp.asarray(-1), waiting=jnp.asarray(0),
    )  # fmt: skip
    last, seen = jax.lax.scan(rounds.one, first, jnp.arange(plan.max_transitions + 1))
    last, seen = _without_silent_zeros(last, jax.tree.map(lambda x: x[: plan.max_transitions], seen), (ts, y0, vector))
    return _fields(layout, ts, last, seen)


def _mode(plan: _Plan, index: int, layout: Layout, params: PyTree) -> _Mode:
    """A mode, ready to run. Raises `ValueError` where it has no machine code."""
    name, leaving = plan.names[index], tuple(transition for _, transition in plan.leaving(index))
    rtol, atol = plan.tolerances
    problem = Problem.about(plan.systems[index], layout, params, rtol=rtol, atol=atol, max_steps=plan.max_steps)
    if len(leaving) > MOST_GUARDS:
        raise ValueError(f"{len(leaving)} transitions leave the mode {name!r}, more than {MOST_GUARDS}.")
    try:
        if refusal := MachineCode().refuses(problem):
            raise Unlowerable(refusal)
        code = eqx.filter(problem.params, eqx.is_array_like, inverse=True)
        leaves, structure = jax.tree.flatten(code)
        programs = _guard_programs(problem.derivation, problem.system, leaving, tuple(leaves), structure)
    except Unlowerable as why:
        raise ValueError(f"The mode {name!r} has no machine code: {why}.") from None
    return _Mode(problem, *programs, tuple(transition.direction for transition in leaving))


@functools.lru_cache(maxsize=64)
def _guard_programs(
    derivation: Derivation, system: System, leaving: tuple[Transition, ...], leaves: tuple, structure
) -> tuple[Program | None, Program | None]:
    """The guards of a mode as programs of (q, q̇, t, params): their values, and what `_native.Guards` wants.

    `leaves` and `structure` are those of what is in params and is not a number. Raises `Unlowerable`.
    """
    if not leaving:
        return None, None
    n, layout, numbers, code = (
        derivation.layout.size,
        derivation.layout,
        derivation.numbers,
        structure.unflatten(leaves),
    )
    program, multipliers = derivation.acceleration, derivation.multipliers

    def surfaces(y, numbers):
        q, v, t = y[:n], y[n:-1], y[-1]
        extras = {"t": t, "params": eqx.combine(numbers, code)}
        if multipliers is not None:
            flat = jnp.stack(multipliers(*y, *_scalars(numbers)))
            extras["multipliers"] = system.by_constraint(flat, layout, extras["params"])
        return jnp.stack([_scalar(one.guard, layout.restore(q), layout.restore(v), extras) for one in leaving])

    def guards(y, numbers):
        acceleration = jnp.stack(program.complete(*y, *_scalars(numbers))[:n])
        rate = jnp.concatenate([y[n:-1], acceleration, jnp.ones(1)])
        by_y = jax.jacfwd(surfaces)(y, numbers)
        terms, moving = by_y * y, by_y * rate
        return surfaces(y, numbers), moving.sum(1), jnp.abs(terms).sum(1), jnp.abs(moving).sum(1)

    y = jax.ShapeDtypeStruct((2 * n + 1,), layout.dtype)
    return lower(surfaces, y, numbers), lower(guards, y, numbers)


MOST_GUARDS = 24  # two bits each in the code of an event, which is a double


def _scalars(numbers: PyTree) -> list[jax.Array]:
    return [x for leaf in jax.tree.leaves(numbers) for x in jnp.ravel(leaf)]


def _scalar(guard: Function, q, qdot, extras) -> jax.Array:
    if "multipliers" in guard.extras and "multipliers" not in extras:
        raise ValueError("A guard asks for `multipliers`, but its mode has no constraints.")
    value = guard(q, qdot, **extras)
    if len(jax.tree.leaves(value)) != 1 or value is not jax.tree.leaves(value)[0]:
        raise TypeError(f"A guard must return one real number; got {type(value).__name__}.")
    value = jnp.asarray(value)
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"A guard must return one real number; got shape {value.shape} of {value.dtype}.")
    return value


class _Carry(NamedTuple):
    t: jax.Array
    y: jax.Array
    mode: jax.Array
    going: jax.Array
    result: jax.Array  # the integer of a `lagjax.RESULTS`
    path: jax.Array
    modes: jax.Array
    steps: jax.Array
    latest: jax.Array  # the transition before, −1 at the beginning
    waiting: jax.Array  # guards that vanished at the same instant and have not been followed


class _Seen(NamedTuple):
    """One transition, as it is recorded."""

    t: jax.Array
    y: jax.Array
    source: jax.Array
    target: jax.Array


class _Rounds(NamedTuple):
    plan: _Plan
    layout: Layout
    modes: list[_Mode]
    ts: jax.Array
    params: PyTree
    numbers: jax.Array  # all in params, (P,)

    def one(self, carry: _Carry, count) -> tuple[_Carry, _Seen]:
        """Every mode runs the members that are in it; the others are given no time."""
        after, fired = carry, jnp.asarray(False)
        seen = _Seen(jnp.asarray(jnp.nan), jnp.full_like(carry.y, jnp.nan), jnp.asarray(-1), jnp.asarray(-1))
        for index in range(len(self.modes)):
            here = carry.going & (carry.mode == index)
            state, event, event_seen = self._in_mode(index, carry, here)
            after = jax.tree.map(lambda new, old, here=here: jnp.where(here, new, old), state, after)
            seen = jax.tree.map(lambda new, old, hit=here & event: jnp.where(hit, new, old), event_seen, seen)
            fired = fired | (here & event)
        spent = fired & (count == self.plan.max_transitions)
        after = after._replace(going=after.going & ~spent, result=jnp.where(spent, TOO_MANY, after.result))
        return after, seen

    def _in_mode(self, index: int, carry: _Carry, here) -> tuple[_Carry, jax.Array, _Seen]:
        mode = self.modes[index]
        t_start = jax.lax.stop_gradient(carry.t)
        runs = here & (carry.waiting == 0)
        horizon = jnp.where(runs, self.ts[-1], t_start)
        located = mode.solve_to_event(jnp.stack([t_start, horizon]), carry.y)
        located = jax.tree.map(jax.lax.stop_gradient, located)
        changes = jnp.where(runs, located.event, jnp.where(here, carry.waiting, 0))
        t_end = jnp.where(runs & (located.result == SUCCESSFUL), self.ts[-1], located.t_end)

        # The same stretch once more, with derivatives and outputs; where it ends is known better already.
        covered = here & ((self.ts > t_start) | (self.ts == jnp.where(t_start == self.ts[0], t_start, jnp.nan)))
        covered = covered & (self.ts <= t_end)
        inside = jnp.where(covered, self.ts, jax.lax.stop_gradient(jnp.clip(self.ts, t_start, t_end)))
        times = jnp.concatenate([carry.t[None], inside, t_end[None]])
        moved = mode.solve(times, carry.y)
        y_end = located.y_end + jnp.where(here, moved.y_end - jax.lax.stop_gradient(moved.y_end), 0.0)

        exit = self._through(index, changes, carry.latest, t_end, y_end)
        event = (changes > 0) & ~exit.piled
        failed = jnp.where(exit.piled, ZENO, jnp.where(runs & ~event, located.result, carry.result))
        # A reset may give NaN, and a guard that is NaN never fires.
        sound = jnp.isfinite(jnp.where(event, exit.y_next, y_end)).all() & exit.seen
        broken = here & ~sound & (event | (failed == SUCCESSFUL))
        state = carry._replace(
            t=jnp.where(event, exit.t, t_end),
            y=jnp.where(event, exit.y_next, y_end),
            mode=jnp.where(event, exit.target, index),
            going=event & ~exit.astray & ~broken,
            result=jnp.where(broken, NOT_FINITE, jnp.where(event & exit.astray, INCONSISTENT, failed)),
            path=jnp.where(covered[:, None], moved.path[1:-1], carry.path),
            modes=jnp.where(covered, index, carry.modes),
            steps=carry.steps + jnp.stack([located.accepted, located.rejected]),
            latest=exit.number,
            waiting=exit.waiting,
        )
        return state, event, _Seen(exit.t, exit.y, jnp.asarray(index), exit.target)

    def _through(self, index: int, changes, latest, t, y) -> "_Exit":
        """Through the first transition whose bits in `changes` say that its guard falls (1) or rises (2)."""
        leaving = self.plan.leaving(index)
        exit = _Exit(t, y, y, jnp.asarray(index), *[jnp.asarray(-1), jnp.asarray(0)], *[jnp.asarray(False)] * 2,
                     jnp.asarray(True))  # fmt: skip
        if not leaving:
            return exit
        kinds = [(changes >> (2 * k)) & 3 for k in range(len(leaving))]
        y_here, numbers = _held(changes > 0, (y, self.numbers))
        values = self.modes[index].surfaces(*y_here, t, *numbers)
        seen = ~jnp.isnan(jnp.stack(values)).any()
        _, rates, sizes = self._at_guards(index, t, y)
        before = jnp.asarray(False)
        for k, (number, transition) in enumerate(leaving):
            taken = (kinds[k] > 0) & ~before
            before = before | taken
            # It changes sign against its rate: the motion since the last time is lost in rounding.
            against = jnp.where(kinds[k] == 2, rates[k] < 0, rates[k] > 0) & (latest == number)
            moved_t, moved_y = self._crossing(index, k)(taken, t, y_here, numbers)
            given = _held(taken, (moved_t, moved_y, self.params))
            y_next, target = self._reset(transition, *given), self.plan.names.index(transition.target)
            here = _Exit(
                moved_t, moved_y, y_next, jnp.asarray(target), jnp.asarray(number),
                self._waiting(index, kinds, k, t, y_next, values, sizes) if target == index else jnp.asarray(0),
                against, self.astray(target, moved_t, y_next), seen,
            )  # fmt: skip
            exit = jax.tree.map(lambda new, old, taken=taken: jnp.where(taken, new, old), here, exit)
        return exit._replace(seen=seen)

    def _waiting(self, index: int, kinds, taken: int, t, y_next, values, sizes):
        """Which other guards changed sign at that instant and go on to, unmoved by the reset."""
        waiting = jnp.asarray(0)
        if len(kinds) == 1:
            return waiting
        after, rates, _ = self._at_guards(index, t, y_next)
        for k, kind in enumerate(kinds):
            unmoved = jnp.abs(after[k] - jax.lax.stop_gradient(values[k])) <= SAME * sizes[k]
            goes_on = jnp.where(kind == 2, rates[k] > 0, rates[k] < 0)
            waiting = waiting + jnp.where((kind > 0) & unmoved & goes_on & (k != taken), kind << (2 * k), 0)
        return waiting

    def _at_guards(self, index: int, t, y):
        """Guards, their rates and their sizes, as numbers without derivatives."""
        t, y, numbers = jax.lax.stop_gradient((t, y, self.numbers))
        out = self.modes[index].guards(*y, t, *numbers)
        count = len(out) // 4
        return out[:count], out[count : 2 * count], out[2 * count : 3 * count]

    def _crossing(self, index: int, k: int) -> Callable:
        """`(taken, t, y, numbers)` → (t, y): the state at t, where guard k is zero and stays so as what went in varies.

        With g the guard, f the rate of the state and ′ the derivative along the motion, the time moves by

            s = −ε − ½ (g″/g′) ε²,  ε = δg/g′        and the state by   f s + ½ f′ s²,

        up to third order in δg, which is zero itself: first and second derivatives are right.
        """
        mode, n, still = self.modes[index], self.layout.size, jax.lax.stop_gradient
        flow = flow_of(mode.problem)
        count = len(self.plan.leaving(index))

        def rates(t, y, numbers):
            acceleration = jnp.stack(flow.anywhere(*y, t, *numbers)[:n])
            return mode.guards(*y, t, *numbers)[count + k], jnp.concatenate([y[n:], acceleration])

        def moved(taken, t, y, numbers):
            value, (rate, slope) = mode.surfaces(*y, t, *numbers)[k], rates(t, y, numbers)
            along = jnp.ones_like(t), slope
            bend, turn = map(still, jax.jvp(lambda t, y: rates(t, y, numbers), (t, y), along)[1])
            rate = jnp.where(taken & (rate != 0), rate, 1.0)
            part = jnp.where(taken, value - still(value), 0.0) / rate
            later = -part - 0.5 * still(bend / rate) * part**2
            return t + later, y + slope * later + 0.5 * turn * later**2

        def crossing(taken, t, y, numbers):
            return differentiated_as(moved, (t, y), taken, t, y, numbers)

        return crossing

    def astray(self, index: int, t, y):
        """Whether a state is off the constraints of a mode."""
        system = self.plan.systems[index]
        if system.constraints is None and system.velocity_constraints is None:
            return jnp.asarray(False)
        motion = system.motion(self.layout, self.params)
        t, y, numbers = jax.lax.stop_gradient((t, y, eqx.filter(self.params, eqx.is_array_like)))
        return ~(_distance(motion, *jnp.split(y, 2), t, numbers) <= TOLERANCE[self.layout.dtype])

    def _reset(self, transition: Transition, t, y, params):
        if transition.reset is None:
            return y
        n = self.layout.size
        result = transition.reset(self.layout.restore(y[:n]), self.layout.restore(y[n:]), t=t, params=params)
        where = f"The reset from {transition.source!r} to {transition.target!r}"
        if not isinstance(result, tuple) or len(result) != 2:
            raise TypeError(f"{where} must return the pair (q, qdot); got {type(result).__name__}.")
        try:
            same = Layout.of(*result) == self.layout
        except (TypeError, ValueError) as why:
            raise TypeError(f"{where} must return (q, qdot) like the initial state: {why}") from None
        if not same:
            raise TypeError(f"{where} must return q and qdot in the structure and the shapes of the initial state.")
        return jnp.concatenate([self.layout.flatten(part) for part in result])


class _Exit(NamedTuple):
    """A transition: when and where, the state after it and its mode, and what becomes of the motion."""

    t: jax.Array
    y: jax.Array
    y_next: jax.Array
    target: jax.Array
    number: jax.Array
    waiting: jax.Array
    piled: jax.Array
    astray: jax.Array
    seen: jax.Array  # whether all guards were numbers


def _held(varies, tree: PyTree) -> PyTree:
    """The same numbers, without derivatives where they are not to vary."""

    def hold(x):
        return jnp.where(varies, x, jax.lax.stop_gradient(x)) if eqx.is_array_like(x) else x

    return jax.tree.map(hold, tree)


def _distance(motion: Motion, q, v, t, numbers):
    """From the constraints to the state, over its size, the longest of all (see `_consistent`)."""
    rows, _ = motion.rows_and_targets(q, v, t, numbers)
    lengths = jnp.sqrt(jnp.sum(rows**2, axis=1))
    rates = motion.velocity_saddle(q, v, t, numbers)[2] / (1 + jnp.max(jnp.abs(v)))
    off = jnp.max(jnp.abs(rates) / lengths)
    if motion.constraints is not None:
        held = motion.constraints(q, t, numbers) / (1 + jnp.max(jnp.abs(q)))
        off = jnp.maximum(off, jnp.max(jnp.abs(held) / lengths[: len(held)]))
    return off


SAME = 64 * np.finfo(np.float64).eps  # of a guard's size
TOO_MANY, INCONSISTENT, ZENO, NOT_FINITE = (
    code_of(result)
    for result in (
        RESULTS.max_transitions_reached, RESULTS.inconsistent_start, RESULTS.zeno, RESULTS.nonfinite_state,
    )
)  # fmt: skip
_STEADY = 0.05  # how far the logarithms of two ratios of a geometric sequence may differ, as a part of them


def _pile_up(times, end) -> jax.Array:
    """Whether the times of a spent budget of transitions run geometrically to a limit before `end`.

    Aitken's extrapolation of the last times, taken far enough apart that a pattern of two, three or six transitions (a
    flight and a contact, say) repeats in between: three intervals whose two ratios agree, and are below one. Or the
    time does not move any more.
    """
    apart = next((k for k in (6, 2, 1) if 3 * k < times.size), None)
    if apart is None:
        return jnp.asarray(False)  # too few to tell
    first, second, third = jnp.diff(times[-1 - 3 * apart :: apart])
    before, ratio = second / first, third / second
    steady = jnp.abs(jnp.log(ratio) - jnp.log(before)) <= _STEADY * jnp.abs(jnp.log(before))
    rounding = 4 * float(jnp.finfo(times.dtype).eps) * jnp.abs(times[-1])
    lost = (third <= rounding) & (apart > 1)  # one alone may be two transitions at the same instant
    return lost | ((ratio < 1) & steady & (times[-1] + third * ratio / (1 - ratio) < end))


def _without_silent_zeros(last: _Carry, seen: _Seen, inputs) -> tuple[_Carry, _Seen]:
    """Outputs (T, 2n) that were not reached and transitions that did not happen, with derivatives that are NaN."""
    happened = seen.source >= 0
    t, y = (lost_unless(which, x, inputs) for which, x in ((happened, seen.t), (happened[:, None], seen.y)))
    path = lost_unless((last.modes >= 0)[:, None], last.path, inputs)
    return last._replace(path=path), seen._replace(t=t, y=y)


def _fields(layout: Layout, ts, last: _Carry, seen: _Seen):
    n = layout.size
    piled = (last.result == TOO_MANY) & _pile_up(seen.t, ts[-1])
    result = result_from(jnp.where(piled, ZENO, last.result))
    accepted, rejected = last.steps
    stats = {
        "num_steps": accepted + rejected, "num_accepted_steps": accepted, "num_rejected_steps": rejected,
    }  # fmt: skip
    end = State(last.t, layout.restore(last.y[:n]), layout.restore(last.y[n:]))
    transitions = Transitions(
        t=seen.t, q=layout.restore(seen.y[:, :n]), qdot=layout.restore(seen.y[:, n:]), source=seen.source,
        target=seen.target, count=jnp.sum(seen.source >= 0),
    )  # fmt: skip
    path = last.path
    q, qdot = layout.restore(path[:, :n]), layout.restore(path[:, n:])
    return ts, q, qdot, result, end, stats, last.modes, transitions, last.mode
