"""Motion that changes its laws: modes, each a `System` of its own, and transitions between them.

A round runs every member to the end of its time or to the next zero of a guard of its mode, writes down the outputs on
the way, and puts it into the next mode. Where a guard vanishes is found by machine code (`_native`), without
derivatives. They come from two places: along a round from the sensitivities of the flow, and at its end from the
implicit function: with g the guard and ġ its rate along the motion,

    dt* = −dg / ġ        dy* = dy + ẏ dt*

after which the reset is differentiated like any function. Together these are the jump of a sensitivity at an event
("saltation matrix"). Source: Aizerman & Gantmakher, Q. J. Mech. Appl. Math. 11 (1958) 225; Hiskens & Pai, IEEE Trans.
Circuits Syst. I 47 (2000) 204, §III.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._arguments import Function, accept
from lagjax._consistent import require_consistent
from lagjax._engine import RESULT_OF_CODE
from lagjax._equations import multiplier_program, projection_program, scalar_program
from lagjax._flow import Flow, Tolerances, unfit
from lagjax._layout import Layout
from lagjax._program import Unlowerable, lower
from lagjax._results import RESULTS
from lagjax._settings import Settings, as_arrays, is_concrete, require_finite
from lagjax._simulate import raise_unless_ok
from lagjax._system import System
from lagjax._trajectory import State, Trajectory, Transitions

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

    def __init__(
        self, source: str, target: str, guard: Callable, direction: int = 0, reset: Callable | None = None
    ):
        if direction not in (-1, 0, 1):
            raise ValueError(f"direction must be -1 (falling), +1 (rising) or 0 (both); got {direction!r}.")
        if guard is None:
            raise TypeError(f"The transition from {source!r} to {target!r} has no guard: say where it happens.")
        self.source, self.target, self.direction = source, target, direction
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
      instant.
    - `max_transitions`: the budget of transitions. A motion that needs more (infinitely many, where they pile up as the
      bounces of a ball do) ends there and says so.

    The other arguments are those of `simulate`, `max_steps` counting for each stretch between transitions. The result
    is a `Trajectory` with two more fields: `mode`, for every output time the place of its mode in `modes` (−1 where it
    was not reached; at the instant of a transition, the mode before it), and `transitions`: `t`, `q`, `qdot` just
    before the reset, and `source`, `target` as places in `modes`, all of length `max_transitions` with NaN or −1 beyond
    the last, and their `count`.

    Every member of a batch switches at its own time: use `jax.vmap`, `jax.jit` and `jax.grad` around it. Times and
    states of transitions have their derivatives by the initial state and by params.

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
    layout = Layout.of(q0, qdot0)
    settings = Settings.of(layout, ts, None, rtol, atol, None, max_steps, None, None, False)
    _require_modes(modes, transitions, start, max_transitions)
    if not all(is_concrete(x) for x in (settings.controller.rtol, settings.controller.atol)):
        raise ValueError("rtol and atol of simulate_hybrid must be numbers: they decide the order of the method.")
    if is_concrete(settings.ts) and np.asarray(settings.ts)[-1] < np.asarray(settings.ts)[0]:
        raise ValueError("simulate_hybrid goes forward in time: a reset cannot be undone; ts must increase.")
    params = as_arrays(params, layout.dtype)
    for name, value in (("q0", q0), ("qdot0", qdot0), ("params", params)):
        require_finite(value, name)
    q0, qdot0 = as_arrays((q0, qdot0), layout.dtype)
    require_consistent(modes[start], layout, settings.ts, q0, qdot0, params)
    controller = settings.controller
    tolerances = Tolerances(float(controller.rtol), float(controller.atol), max_steps)
    plan = _Plan(tuple(modes), tuple(modes.values()), tuple(transitions), start, max_transitions, tolerances)
    fields = _run(plan, settings.ts, q0, qdot0, params)
    trajectory = Trajectory(*fields[:6], dict(modes), params, None, *fields[6:])
    return raise_unless_ok(trajectory, layout) if throw else trajectory


def _require_modes(modes, transitions, start, max_transitions) -> None:
    if not isinstance(modes, dict) or not modes or not all(isinstance(m, System) for m in modes.values()):
        raise TypeError("modes must be a dict of lagjax.System by name.")
    known = ", ".join(map(repr, modes))
    if start not in modes:
        raise ValueError(f"The motion is to start in the mode {start!r}, which does not exist; there are {known}.")
    for transition in transitions:
        if not isinstance(transition, Transition):
            raise TypeError(f"transitions must be lagjax.Transition; got {transition!r}.")
        for role in ("source", "target"):
            if getattr(transition, role) not in modes:
                name = getattr(transition, role)
                raise ValueError(f"A transition has the {role} {name!r}, which does not exist; there are {known}.")
    reached, growing = {start}, True
    while growing:
        more = {t.target for t in transitions if t.source in reached} - reached
        reached, growing = reached | more, bool(more)
    if lost := [name for name in modes if name not in reached]:
        raise ValueError(f"No transition leads from {start!r} to {', '.join(map(repr, lost))}: unreachable.")
    if isinstance(max_transitions, bool) or not isinstance(max_transitions, int) or max_transitions < 1:
        raise ValueError(f"max_transitions must be a positive integer; got {max_transitions!r}.")


class _Plan(eqx.Module):
    """What does not change from run to run."""

    names: tuple[str, ...] = eqx.field(static=True)
    systems: tuple[System, ...]
    transitions: tuple[Transition, ...]
    start: str = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    tolerances: Tolerances = eqx.field(static=True)

    def leaving(self, mode: int) -> list[Transition]:
        return [t for t in self.transitions if t.source == self.names[mode]]


class _Mode(NamedTuple):
    """One mode, ready to run: with derivatives, and with its guards."""

    flow: Flow
    watched: Flow


# ---- one run ---------------------------------------------------------------------------------------------------------


@eqx.filter_jit
def _run(plan: _Plan, ts, q0, qdot0, params):
    layout = Layout.of(q0, qdot0)
    ts = jnp.asarray(ts)
    numbers, code = eqx.partition(params, eqx.is_array_like)
    scalars = [x.astype(layout.dtype) for leaf in jax.tree.leaves(numbers) for x in jnp.ravel(jnp.asarray(leaf))]
    shapes = jax.tree.map(lambda x: np.zeros(jnp.shape(x), jnp.result_type(x)), numbers)
    modes = [_mode(plan, i, layout, eqx.combine(shapes, code)) for i in range(len(plan.systems))]
    rounds = _Rounds(plan, layout, modes, ts, params, scalars)
    y0 = jnp.concatenate([layout.flatten(q0), layout.flatten(qdot0)])
    start = _Carry(
        t=ts[0], y=y0, mode=jnp.asarray(plan.names.index(plan.start)), going=jnp.asarray(True),
        code=jnp.asarray(_native.DONE), path=jnp.full((ts.size, y0.size), jnp.nan), modes=jnp.full(ts.size, -1),
        steps=jnp.zeros(2, int),
    )  # fmt: skip
    last, seen = jax.lax.scan(rounds.one, start, jnp.arange(plan.max_transitions + 1))
    return _fields(layout, ts, last, jax.tree.map(lambda x: x[: plan.max_transitions], seen))


def _mode(plan: _Plan, index: int, layout: Layout, params: PyTree) -> _Mode:
    """Machine code for a mode. Raises `ValueError` where there is none."""
    system, n = plan.systems[index], layout.size
    numbers = eqx.filter(params, eqx.is_array_like)
    motion = system.motion(layout, params)
    try:
        program = scalar_program(motion, layout, numbers)
        projection = projection_program(motion, layout, numbers)
        multipliers = multiplier_program(motion, layout, numbers) if motion.constrained else None

        def values(q, v, t, numbers):
            given = {"t": t, "params": eqx.combine(numbers, eqx.filter(params, eqx.is_array_like, inverse=True))}
            if multipliers is not None:
                scalars = [x for leaf in jax.tree.leaves(numbers) for x in jnp.ravel(leaf)]
                flat = jnp.stack(multipliers(*q, *v, t, *scalars))
                given["multipliers"] = system.by_constraint(flat, layout, params)
            return [_scalar(s.guard, layout.restore(q), layout.restore(v), given) for s in plan.leaving(index)]

        vector, scalar = jax.ShapeDtypeStruct((n,), layout.dtype), jax.ShapeDtypeStruct((), layout.dtype)
        guards = lower(values, vector, vector, scalar, numbers)
    except Unlowerable as why:
        raise ValueError(f"The mode {plan.names[index]!r} has no machine code: {why}.") from None
    if reason := unfit(program, n, layout.dtype):
        raise ValueError(f"The mode {plan.names[index]!r} has no machine code: {reason}.")
    flow = Flow(program, n, projection)
    directions = tuple(transition.direction for transition in plan.leaving(index))
    watched = Flow(program, n, projection, _native.Guards(guards, directions)) if directions else flow
    return _Mode(flow, watched)


def _scalar(guard: Function, q, qdot, given) -> jax.Array:
    if "multipliers" in guard.extras and "multipliers" not in given:
        raise ValueError("A guard asks for `multipliers`, but its mode has no constraints.")
    value = jnp.asarray(guard(q, qdot, **given))
    if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"A guard must return one real number; got shape {value.shape} of {value.dtype}.")
    return value


class _Carry(NamedTuple):
    t: jax.Array
    y: jax.Array
    mode: jax.Array
    going: jax.Array
    code: jax.Array
    path: jax.Array
    modes: jax.Array
    steps: jax.Array


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
    scalars: list[jax.Array]

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
        after = after._replace(
            going=after.going & ~spent, code=jnp.where(spent, TOO_MANY_TRANSITIONS, after.code)
        )
        return after, seen

    def _in_mode(self, index: int, carry: _Carry, here) -> tuple[_Carry, jax.Array, _Seen]:
        mode, tolerances, end = self.modes[index], self.plan.tolerances, self.ts[-1]
        held_t = jax.lax.stop_gradient(carry.t)
        horizon = jnp.where(here, end, held_t)
        found = mode.watched.traceable(tolerances)(jnp.stack([held_t, horizon]), carry.y, *self.scalars)
        found = jax.tree.map(jax.lax.stop_gradient, found)
        event = found.code >= _native.EVENT
        t_end = found.t_end

        # The same stretch once more, with derivatives and outputs.
        inside = jnp.clip(self.ts, held_t, t_end)
        times = jnp.concatenate([carry.t[None], inside, t_end[None]])
        run = mode.flow.traceable(tolerances)(times, carry.y, *self.scalars)
        first = carry.t == self.ts[0]
        covered = here & ((self.ts > held_t) | (first & (self.ts == held_t))) & (self.ts <= t_end)
        y_end = jnp.where(here, run.y_end, jax.lax.stop_gradient(carry.y))
        which = jnp.where(event, found.code - _native.EVENT, -1)
        t_star, y_star, y_next, target = self._through(index, which, here & event, t_end, y_end)
        state = carry._replace(
            t=jnp.where(event, t_star, t_end),
            y=jnp.where(event, y_next, y_end),
            mode=jnp.where(event, target, index),
            going=event,
            code=jnp.where(event, carry.code, found.code),
            path=jnp.where(covered[:, None], run.path[1:-1], carry.path),
            modes=jnp.where(covered, index, carry.modes),
            steps=carry.steps + jnp.stack([found.accepted, found.rejected]),
        )
        return state, event, _Seen(t_star, y_star, jnp.asarray(index), target)

    def _through(self, index: int, which, happens, t, y):
        """Time and state of the transition with their derivatives, the state after it, and its mode."""
        t_star, y_star, y_next, target = t, y, y, jnp.asarray(index)
        slope = self._slope(index, t, y)
        for k, transition in enumerate(self.plan.leaving(index)):
            taken = happens & (which == k)
            g = self._guard(index, transition, t, jnp.where(taken, y, jax.lax.stop_gradient(y)))
            rate = jax.lax.stop_gradient(self._guard_rate(index, transition, t, y, slope))
            rate = jnp.where(taken & (rate != 0), rate, 1.0)
            later = jnp.where(taken, -(g - jax.lax.stop_gradient(g)) / rate, 0.0)
            moved_t, moved_y = t + later, y + slope * later
            new = self._reset(transition, moved_t, jnp.where(taken, moved_y, jax.lax.stop_gradient(y)))
            t_star, y_star = jnp.where(taken, moved_t, t_star), jnp.where(taken, moved_y, y_star)
            y_next = jnp.where(taken, new, y_next)
            target = jnp.where(taken, self.plan.names.index(transition.target), target)
        return t_star, y_star, y_next, target

    def _slope(self, index: int, t, y):
        n = self.layout.size
        return jnp.concatenate([y[n:], jnp.stack(self.modes[index].flow.program(*y, t, *self.scalars)[:n])])

    def _guard(self, index: int, transition: Transition, t, y):
        q, v = self._restored(y)
        given = {"t": t, "params": self.params}
        if "multipliers" in transition.guard.extras:
            given["multipliers"] = self.plan.systems[index].multipliers(q, v, t, self.params)
        return _scalar(transition.guard, q, v, given)

    def _guard_rate(self, index: int, transition: Transition, t, y, slope):
        along = (jnp.ones_like(t), slope)
        return jax.jvp(lambda t, y: self._guard(index, transition, t, y), (t, y), along)[1]

    def _reset(self, transition: Transition, t, y):
        if transition.reset is None:
            return y
        result = transition.reset(*self._restored(y), t=t, params=self.params)
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

    def _restored(self, y):
        n = self.layout.size
        return self.layout.restore(y[:n]), self.layout.restore(y[n:])


TOO_MANY_TRANSITIONS = len(RESULT_OF_CODE)


def _fields(layout: Layout, ts, last: _Carry, seen: _Seen):
    n = layout.size
    codes = jnp.concatenate([jnp.asarray(RESULT_OF_CODE), jnp.asarray([RESULTS.max_transitions_reached._value])])
    result = eqx.tree_at(lambda r: r._value, RESULTS.successful, codes[last.code].astype(np.int32))
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
    return ts, layout.restore(path[:, :n]), layout.restore(path[:, n:]), result, end, stats, last.modes, transitions
