"""The rounds of a hybrid motion: a `jax.lax.scan` in which every round ends with a transition, or ends the motion.

A round runs every member to the end of its time or to the next zero of a guard of its mode, writes down the outputs on
the way, and puts it into the next mode. Along a round derivatives are those of machine code; at its end see `_mode`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._failures import lost_unless
from lagjax._hybrid._mode import Mode, Transition, state_after
from lagjax._layout import Layout
from lagjax._problem import Problem
from lagjax._results import RESULTS, SUCCESSFUL, code_of
from lagjax._system import System

PyTree = Any

TOO_MANY, INCONSISTENT, ZENO, NOT_FINITE = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.inconsistent_start, RESULTS.zeno, RESULTS.nonfinite_state),
)
# A reset has left a guard alone when it changes by less than this part of its size: the round-off of evaluating it at
# two states that are equal but for the last digits. A larger one would follow guards that the reset has moved.
SAME = 64 * np.finfo(np.float64).eps
# How far the logarithms of two ratios of a geometric sequence may differ, as a part of them. Times of a Zeno motion
# approach a geometric sequence; twice this would take a slowly changing rhythm for one.
STEADY = 0.05


class Plan(eqx.Module):
    """What does not change from round to round: the modes by name, their transitions, and what a run may cost."""

    names: tuple[str, ...] = eqx.field(static=True)
    systems: tuple[System, ...]
    transitions: tuple[Transition, ...]
    start: str = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def __init__(self, modes: dict[str, System], transitions, start, max_transitions, rtol, atol, max_steps):
        self.names, self.systems, self.transitions = tuple(modes), tuple(modes.values()), transitions
        self.start, self.max_transitions = start, max_transitions
        self.rtol, self.atol, self.max_steps = rtol, atol, max_steps

    def mode(self, index: int, layout: Layout, params: PyTree) -> Mode:
        """A mode with the transitions that leave it."""
        name, limits = self.names[index], {"rtol": self.rtol, "atol": self.atol, "max_steps": self.max_steps}
        problem = Problem.about(self.systems[index], layout, params, **limits)
        return Mode.of(name, problem, tuple((k, t) for k, t in enumerate(self.transitions) if t.source == name))


class Ending(NamedTuple):
    """How far a motion has come: after the last round, how it ended."""

    t: jax.Array
    y: jax.Array  # (2n,)
    mode: jax.Array  # its place in `Plan.names`
    going: jax.Array  # whether it goes on
    result: jax.Array  # the integer of a `lagjax.RESULTS`
    path: jax.Array  # (T, 2n), NaN where not reached
    modes: jax.Array  # (T,), −1 where not reached
    steps: jax.Array  # accepted, rejected
    latest: jax.Array  # the number of the transition before, −1 at the beginning
    waiting: jax.Array  # the bits of guards that vanished at the same instant and have not been followed


class Record(NamedTuple):
    """One transition: its time, the state before the reset, and the modes on both sides; NaN and −1 without any."""

    t: jax.Array
    y: jax.Array
    source: jax.Array
    target: jax.Array


class Exit(NamedTuple):
    """The end of a round: when and where it was, the state after the reset, and what becomes of the motion."""

    t: jax.Array
    y: jax.Array
    y_next: jax.Array
    target: jax.Array
    number: jax.Array  # of the transition
    waiting: jax.Array
    piled_up: jax.Array  # whether time does not move any more
    inconsistent: jax.Array  # whether the state after the reset is off the constraints of its mode
    guards_defined: jax.Array


@eqx.filter_jit
def hybrid_motion(plan: Plan, layout: Layout, ts, y0, params: PyTree) -> tuple[Ending, Record]:
    """The motion from y0 (2n,) at ts[0]: how it ended, and its transitions, with an axis of `max_transitions`."""
    ts, y0 = jnp.asarray(ts), jnp.asarray(y0)
    modes = [plan.mode(index, layout, params) for index in range(len(plan.names))]
    rounds, start = _Rounds(plan, modes, ts), plan.names.index(plan.start)
    inconsistent = modes[start].is_inconsistent(ts[0], y0)
    first = Ending(
        t=ts[0], y=y0, mode=jnp.asarray(start), going=~inconsistent,
        result=jnp.where(inconsistent, INCONSISTENT, SUCCESSFUL), path=jnp.full((ts.size, y0.size), jnp.nan),
        modes=jnp.full(ts.size, -1), steps=jnp.zeros(2, int), latest=jnp.asarray(-1), waiting=jnp.asarray(0),
    )  # fmt: skip
    ending, record = jax.lax.scan(rounds.one, first, jnp.arange(plan.max_transitions + 1))
    record = jax.tree.map(lambda x: x[: plan.max_transitions], record)
    piled_up = (ending.result == TOO_MANY) & _pile_up(record.t, ts[-1])
    ending = ending._replace(result=jnp.where(piled_up, ZENO, ending.result))
    return _without_silent_zeros(ending, record, (ts, y0, modes[0].vector))


class _Rounds(NamedTuple):
    plan: Plan
    modes: list[Mode]
    ts: jax.Array

    def one(self, before: Ending, count) -> tuple[Ending, Record]:
        """One round: every mode runs the members that are in it; the others are given no time."""
        after, fired = before, jnp.asarray(False)
        record = Record(jnp.asarray(jnp.nan), jnp.full_like(before.y, jnp.nan), jnp.asarray(-1), jnp.asarray(-1))
        for index in range(len(self.modes)):
            here = before.going & (before.mode == index)
            ending, event, recorded = self._in_mode(index, before, here)
            after, record = _where(here, ending, after), _where(here & event, recorded, record)
            fired = fired | (here & event)
        spent = fired & (count == self.plan.max_transitions)
        after = after._replace(going=after.going & ~spent, result=jnp.where(spent, TOO_MANY, after.result))
        return after, record

    def _in_mode(self, index: int, before: Ending, here) -> tuple[Ending, jax.Array, Record]:
        """The round of the members that are in this mode (`here`), and whether it ended with a transition."""
        mode, t_start = self.modes[index], jax.lax.stop_gradient(before.t)
        runs = here & (before.waiting == 0)
        horizon = jnp.where(runs, self.ts[-1], t_start)
        located = mode.solve_to_event(jnp.stack([t_start, horizon]), before.y)
        changes = jnp.where(runs, located.event, jnp.where(here, before.waiting, 0))
        t_end = jnp.where(runs & (located.result == SUCCESSFUL), self.ts[-1], located.t_end)

        # The same stretch once more, with derivatives and outputs; where it ends is known better already.
        covered = here & ((self.ts > t_start) | (self.ts == jnp.where(t_start == self.ts[0], t_start, jnp.nan)))
        covered = covered & (self.ts <= t_end)
        inside = jnp.where(covered, self.ts, jax.lax.stop_gradient(jnp.clip(self.ts, t_start, t_end)))
        moved = mode.solve(jnp.concatenate([before.t[None], inside, t_end[None]]), before.y)
        y_end = located.y_end + jnp.where(here, moved.y_end - jax.lax.stop_gradient(moved.y_end), 0.0)

        exit = self._through(index, changes, before.latest, t_end, y_end)
        event = (changes > 0) & ~exit.piled_up
        result = jnp.where(exit.piled_up, ZENO, jnp.where(runs & ~event, located.result, before.result))
        # A reset may give NaN, and a guard that is NaN never fires.
        sound = jnp.isfinite(jnp.where(event, exit.y_next, y_end)).all() & exit.guards_defined
        broken = here & ~sound & (event | (result == SUCCESSFUL))
        result = jnp.where(broken, NOT_FINITE, jnp.where(event & exit.inconsistent, INCONSISTENT, result))
        after = Ending(
            t=jnp.where(event, exit.t, t_end),
            y=jnp.where(event, exit.y_next, y_end),
            mode=jnp.where(event, exit.target, index),
            going=event & ~exit.inconsistent & ~broken,
            result=result,
            path=jnp.where(covered[:, None], moved.path[1:-1], before.path),
            modes=jnp.where(covered, index, before.modes),
            steps=before.steps + jnp.stack([located.accepted, located.rejected]),
            latest=exit.number,
            waiting=exit.waiting,
        )
        return after, event, Record(exit.t, exit.y, jnp.asarray(index), exit.target)

    def _through(self, index: int, changes, latest, t, y) -> Exit:
        """Through the first transition whose bits in `changes` say that its guard falls (1) or rises (2)."""
        mode, no, none = self.modes[index], jnp.asarray(False), jnp.asarray(-1)
        exit = Exit(t, y, y, jnp.asarray(index), none, jnp.asarray(0), no, no, jnp.asarray(True))
        if mode.surfaces is None:
            return exit
        kinds = [(changes >> (2 * k)) & 3 for k in range(len(mode.leaving))]
        y_here, numbers = _constant_unless(changes > 0, (y, mode.vector))
        values = mode.surfaces.values.at(jnp.append(y_here, t), numbers)
        _, rates, sizes = mode.guards_at(t, y)
        earlier = jnp.asarray(False)
        for k, (number, transition) in enumerate(mode.leaving):
            taken = (kinds[k] > 0) & ~earlier
            earlier = earlier | taken
            # It changes sign against its rate: the motion since the last time is lost in rounding.
            against = jnp.where(kinds[k] == 2, rates[k] < 0, rates[k] > 0) & (latest == number)
            t_zero, y_zero = mode.crossing(k)(taken, t, y_here, numbers)
            y_next = state_after(transition, mode.layout, *_constant_unless(taken, (t_zero, y_zero, mode.params)))
            target = self.plan.names.index(transition.target)
            waiting = self._waiting(mode, kinds, k, t, y_next, values, sizes) if target == index else jnp.asarray(0)
            inconsistent = self.modes[target].is_inconsistent(t_zero, y_next)
            this = Exit(
                t_zero, y_zero, y_next, jnp.asarray(target), jnp.asarray(number), waiting, against, inconsistent, no
            )
            exit = _where(taken, this, exit)
        return exit._replace(guards_defined=~jnp.isnan(jnp.stack(values)).any())

    def _waiting(self, mode: Mode, kinds, taken: int, t, y_next, values, sizes):
        """The bits of the other guards that changed sign at that instant and go on to, unmoved by the reset."""
        waiting = jnp.asarray(0)
        if len(kinds) == 1:
            return waiting
        after, rates, _ = mode.guards_at(t, y_next)
        for k, kind in enumerate(kinds):
            unmoved = jnp.abs(after[k] - jax.lax.stop_gradient(values[k])) <= SAME * sizes[k]
            goes_on = jnp.where(kind == 2, rates[k] > 0, rates[k] < 0)
            waiting = waiting + jnp.where((kind > 0) & unmoved & goes_on & (k != taken), kind << (2 * k), 0)
        return waiting


def _where(condition, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _constant_unless(varies, tree: PyTree) -> PyTree:
    """The same numbers, without derivatives unless `varies` holds."""

    def constant(x):
        return jnp.where(varies, x, jax.lax.stop_gradient(x)) if eqx.is_array_like(x) else x

    return jax.tree.map(constant, tree)


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
    steady = jnp.abs(jnp.log(ratio) - jnp.log(before)) <= STEADY * jnp.abs(jnp.log(before))
    rounding = 4 * float(jnp.finfo(times.dtype).eps) * jnp.abs(times[-1])
    lost = (third <= rounding) & (apart > 1)  # one alone may be two transitions at the same instant
    return lost | ((ratio < 1) & steady & (times[-1] + third * ratio / (1 - ratio) < end))


def _without_silent_zeros(ending: Ending, record: Record, inputs) -> tuple[Ending, Record]:
    """Outputs (T, 2n) that were not reached and transitions that did not happen get derivatives that are NaN."""
    happened = record.source >= 0
    t, y = (lost_unless(which, x, inputs) for which, x in ((happened, record.t), (happened[:, None], record.y)))
    path = lost_unless((ending.modes >= 0)[:, None], ending.path, inputs)
    return ending._replace(path=path), record._replace(t=t, y=y)
