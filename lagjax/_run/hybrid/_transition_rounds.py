"""The rounds of a hybrid motion: each ends with a transition, or ends the motion.

A round runs every member to the end of its time or to the next zero of a guard of its mode, writes down the outputs on
the way, and puts it into the next mode.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Problem
from lagjax._engine.taylor import Guarded, vector_of
from lagjax._interface import RESULTS, SUCCESSFUL, Layout, code_of, compile_for_one_call
from lagjax._native import SINGLE_NOISE
from lagjax._primitives import lost_unless, start_alike
from lagjax._run._rounds import Stretch, run_rounds
from lagjax._run._trajectory import constant_unless, vary_with
from lagjax._run.hybrid._mode import Mode, Transition, state_after
from lagjax._scene import System

PyTree = Any

TOO_MANY, INCONSISTENT, ZENO, IN_TURN, NOT_FINITE = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.inconsistent_start, RESULTS.zeno, RESULTS.transitions_in_turn,
     RESULTS.nonfinite_state),
)  # fmt: skip
# How far the logarithms of two ratios of a geometric sequence may differ, as a part of them. Times of a Zeno motion
# approach a geometric sequence; twice this would take a slowly changing rhythm for one.
STEADY = 0.05
_LEAST = 1e-300  # a side of a guard that is exactly zero still has a sign
# Transitions at one instant that are said to go back and forth: a chain of as many is longer than any that passes on a
# blow among a few balls. And how long before it the last other one was, in parts of the time: bounces that pile up come
# as near to their end as rounding lets them.
IN_ONE_PLACE, APART = 8, 1e-9
# Blows at one instant that are followed in both orders of the list, and by how much of its largest value a number of
# the state may differ behind them: far more than rounding of some thirty blows. Twice as many blows settle more of
# those of restitution below one, whose last ones are small.
MOST_BLOWS, SAME = 32, 1e-9


class RoundPlan(eqx.Module):
    """The constants of all rounds: the modes by name, their transitions, and what a run may cost."""

    names: tuple[str, ...] = eqx.field(static=True)
    systems: tuple[System, ...]
    transitions: tuple[Transition, ...]
    max_transitions: int = eqx.field(static=True)
    rtol: float = eqx.field(static=True)
    atol: float | None = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)  # whether the start came in float32

    def modes(self, layout: Layout, params: PyTree, widths: tuple) -> list[Mode]:
        """The modes, each with the transitions that leave it."""
        target_of = np.array([self.names.index(t.target) for t in self.transitions], int)
        limits = {"rtol": self.rtol, "atol": self.atol, "max_steps": self.max_steps}
        modes = []
        for name, system in zip(self.names, self.systems, strict=True):
            numbers = np.array([k for k, t in enumerate(self.transitions) if t.source == name], int)
            leaving = tuple(self.transitions[k] for k in numbers)
            problem = Problem.from_system(system, layout, params, **limits)
            problem = dataclasses.replace(problem, is_rounded=self.is_single)
            modes.append(Mode.from_problem(name, problem, leaving, numbers, target_of[numbers])._replace(widths=widths))
        return modes


class Ending(NamedTuple):
    """The state of a motion between rounds: after the last round, how it ended."""

    t: jax.Array
    y: jax.Array  # (2n,)
    mode: jax.Array  # its place in `RoundPlan.names`
    going: jax.Array  # true while it continues
    result: jax.Array  # the integer of a `lagjax.RESULTS`
    path: jax.Array  # (T, 2n), NaN where not reached
    modes: jax.Array  # (T,), −1 where not reached
    steps: jax.Array  # accepted, rejected
    latest: jax.Array  # the number of the transition before, −1 at the beginning
    memory: "GuardMemory"
    let_out: jax.Array  # (K,), see `Transitions`


class GuardMemory(NamedTuple):
    """The sides of every guard just before the last reset, (K,): its value, and the side of its surface."""

    values: jax.Array  # NaN for a guard of another mode
    sides: jax.Array  # −1, +1, or 0 where it is unknown
    rounding: jax.Array  # of the largest terms that a guard has had
    rate_rounding: jax.Array  # of those of its rate


class Outset(NamedTuple):
    """The guards of a mode where a motion begins in it, each (K,)."""

    sides: jax.Array  # from which they come, as large as what rounding does; infinite where one happens at once
    lasting: jax.Array  # until when those on their surface stay there
    beyond: jax.Array  # beyond zero in their direction, which is no crossing
    blows: jax.Array  # those of these that are blows, which are let out where they come back


class TransitionRecord(NamedTuple):
    """One transition: its time, the states around the reset, both modes, its place in the list; else NaN and −1."""

    t: jax.Array
    y: jax.Array
    y_next: jax.Array
    source: jax.Array
    target: jax.Array
    number: jax.Array
    order_matters: jax.Array  # whether another order of the list leads to another state, where blows meet

    @classmethod
    def absent(cls, states: int) -> "TransitionRecord":
        none, nowhere = jnp.asarray(-1), jnp.full(states, jnp.nan)
        return cls(jnp.asarray(jnp.nan), nowhere, nowhere, none, none, none, jnp.asarray(False))


class Exit(NamedTuple):
    """The end of a round: the state after the reset, and what becomes of the motion."""

    y_next: jax.Array
    target: jax.Array
    number: jax.Array  # of the transition
    piled_up: jax.Array  # whether time does not move any more
    inconsistent: jax.Array  # whether the state after the reset is off the constraints of its mode
    guards_defined: jax.Array
    order_matters: jax.Array


@compile_for_one_call
def hybrid_motion(plan: RoundPlan, layout: Layout, ts, y0, params: PyTree, start) -> tuple[Ending, TransitionRecord]:
    """The motion from y0 (2n,) at ts[0] in the mode of place `start`, and its `max_transitions` transitions."""
    # A place that is none, as −1 is, comes with a state that was not reached.
    ts, y0, params = start_alike((jnp.asarray(ts), jnp.asarray(y0), params))
    given = jnp.append(y0, ts[0]), vector_of(eqx.filter(params, eqx.is_array_like))
    widths = tuple(SINGLE_NOISE * jnp.abs(jax.lax.stop_gradient(x)) for x in given)
    rounds, start = _Rounds(plan, plan.modes(layout, params, widths), ts), jnp.asarray(start, int)
    result = jnp.where(rounds.is_inconsistent(start, ts[0], y0, range(len(plan.names))), INCONSISTENT, SUCCESSFUL)
    result = jnp.where((start >= 0) & (start < len(plan.names)), result, NOT_FINITE)
    first = Ending(
        t=ts[0], y=y0, mode=start, going=result == SUCCESSFUL, result=result,
        path=jnp.full((ts.size, y0.size), jnp.nan),
        modes=jnp.full(ts.size, -1), steps=jnp.zeros(2, int), latest=jnp.asarray(-1), memory=rounds.no_memory(0.0, 0.0),
        let_out=jnp.full(len(plan.transitions), jnp.nan),
    )  # fmt: skip
    first = vary_with(first, ts, y0, rounds.modes[0].vector)
    absent, numbers = TransitionRecord.absent(y0.size), jnp.arange(plan.max_transitions + 1)
    ending, record = run_rounds(rounds.run_round, first, absent, numbers, lambda carry, _: carry.going)
    record = jax.tree.map(lambda x: x[: plan.max_transitions], record)
    still = jax.lax.stop_gradient(record)
    named = jnp.where(_go_in_turn(still), IN_TURN, jnp.where(_pile_up(still.t, ts[-1]), ZENO, TOO_MANY))
    ending = ending._replace(result=jnp.where(ending.result == TOO_MANY, named, ending.result))
    # Derivatives of outputs that were not reached, and of absent transitions, are NaN.
    inputs = ts, y0, rounds.modes[0].vector
    happened = record.source >= 0
    t, y, y_next = (lost_unless(happened[:, *[None] * (x.ndim - 1)], x, inputs) for x in record[:3])
    path = lost_unless((ending.modes >= 0)[:, None], ending.path, inputs)
    return ending._replace(path=path), record._replace(t=t, y=y, y_next=y_next)


class _Rounds(NamedTuple):
    plan: RoundPlan
    modes: list[Mode]
    ts: jax.Array

    def run_round(self, before: Ending, count) -> tuple[Ending, TransitionRecord]:
        """One round: every mode runs the members that are in it; the others are given no time."""
        after, fired, record = before, jnp.asarray(False), TransitionRecord.absent(before.y.size)
        guards = [mode.guards_at(before.t, before.y, self.ts[-1]) if mode.leaving else None for mode in self.modes]
        before = before._replace(memory=self._note_rounding(before, guards))
        for place in range(len(self.modes)):
            here = before.going & (before.mode == place)
            ending, event, recorded = self._run_mode(place, guards[place], before, here)
            after, record = _select(here, ending, after), _select(here & event, recorded, record)
            fired = fired | (here & event)
        spent = fired & (count == self.plan.max_transitions)
        after = after._replace(going=after.going & ~spent, result=jnp.where(spent, TOO_MANY, after.result))
        return after, record

    def is_inconsistent(self, mode, t, y, among: Sequence[int]) -> jax.Array:
        """True if a state is off the constraints of a mode, which is one `among` these."""
        off = jnp.asarray(False)
        for place in among:
            off = off | ((mode == place) & self.modes[place].is_inconsistent(t, y))
        return off

    def _run_mode(self, place: int, guarded, before: Ending, here) -> tuple[Ending, jax.Array, TransitionRecord]:
        """One round in the mode of this `place` for members that are `here`, and whether a transition ended it."""
        mode, outset = self.modes[place], self._outset(place, guarded, before)
        noted = jnp.concatenate([outset.sides, _pick(before.memory.rate_rounding, self._places_of(mode))])
        stretch = Stretch.locate(mode.problem, mode.surfaces, (before.t, before.y), self.ts, here, noted)
        located, covered, at_once, kinds = stretch.located, stretch.covers, stretch.at_once, stretch.kinds
        # One that the motion was put beyond is no crossing: it happens when the mode begins, however that varies.
        put, k = outset.beyond & at_once, jnp.argmax(jnp.append(kinds, 0) > 0)
        path, t_end, y_end = stretch.vary(k, (kinds > 0).any() & ~_pick(put, np.arange(kinds.size) == k))
        known = before.memory, outset.sides, located.t_end <= outset.lasting
        exit, memory = self._pass_transition(place, before, kinds, at_once & ~put, t_end, y_end, known)
        places = self._places_of(mode)
        are_let_out, first_time = here & outset.blows & ~((kinds > 0) & at_once), _pick(before.let_out, places)
        event = (kinds > 0).any() & ~exit.piled_up
        result = jnp.where(exit.piled_up, ZENO, jnp.where(here & ~event, located.result, before.result))
        # A reset may give NaN, and a guard that is NaN never fires.
        sound = jnp.isfinite(jnp.where(event, exit.y_next, y_end)).all() & exit.guards_defined
        broken = here & ~sound & (event | (result == SUCCESSFUL))
        result = jnp.where(broken, NOT_FINITE, jnp.where(event & exit.inconsistent, INCONSISTENT, result))
        first_let_out = jnp.where(are_let_out & jnp.isnan(first_time), jax.lax.stop_gradient(before.t), first_time)
        after = Ending(
            t_end, *_select(event, (exit.y_next, exit.target), (y_end, before.mode)),
            going=event & ~exit.inconsistent & ~broken, result=result,
            path=jnp.where(covered[:, None], path, before.path),
            modes=jnp.where(covered, before.mode, before.modes),
            steps=before.steps + jnp.stack([located.accepted, located.rejected]),
            latest=exit.number, memory=memory, let_out=_put(before.let_out, places, first_let_out),
        )  # fmt: skip
        return after, event, TransitionRecord(t_end, y_end, exit.y_next, before.mode, *exit[1:3], exit.order_matters)

    def _pass_transition(self, place: int, before: Ending, kinds, turns, t, y, known) -> tuple[Exit, GuardMemory]:
        """The state behind the first transition whose guard falls (1) or rises (2), as `kinds` (K,) say."""
        # Where that `turns` (K,) a guard at once, against its rate, the motion that does so is lost in rounding.
        no, mode = jnp.asarray(False), self.modes[place]
        if not mode.leaving:
            none = Exit(y, before.mode, jnp.asarray(-1), no, no, jnp.asarray(True), no)
            return none, self.no_memory(known[0].rounding, known[0].rate_rounding)
        happens, k = (kinds > 0).any(), jnp.argmax(kinds > 0)
        first, places = np.arange(len(mode.leaving)) == k, self._places_of(mode)
        guarded = mode.guards_at(t, y, self.ts[-1])
        rates = guarded.clear_rates(_pick(known[0].rate_rounding, places))
        against = happens & _pick(jnp.where(kinds == 2, rates < 0, rates > 0) & turns, first)
        y_next = y
        for j, transition in enumerate(mode.leaving):
            if transition.reset is not None:
                taken = happens & (k == j)
                state = constant_unless(taken, (t, y, mode.problem.params))
                moved = state_after(transition, mode.layout, *state)
                y_next = jnp.where(taken, moved, y_next)
        target, number = (
            jnp.where(happens, _pick(jnp.asarray(x), first), other)
            for x, other in ((mode.targets, before.mode), (mode.numbers, -1))
        )
        inconsistent = happens & self.is_inconsistent(target, t, y_next, np.unique(mode.targets).tolist())
        memory = self._memory(mode, guarded, rates, kinds, *known)
        there = (kinds > 0) | (jnp.abs(guarded.values) <= _pick(memory.rounding, places) + guarded.of_time)
        order_matters = self._order_matters(place, t, y, rates, there & (kinds > 0).any())
        defined = ~jnp.isnan(guarded.values).any()
        return Exit(y_next, target, number, against, inconsistent, defined, order_matters), memory

    def _order_matters(self, place: int, t, y, rates, there) -> jax.Array:
        """True if blows of guards that are `there`, (K,), lead elsewhere when the list is read from its end."""
        # Blows lead back into their own mode. They are followed in both orders, each as long as its guard goes on in
        # its direction, once before it has been turned.
        mode = self.modes[place]
        some, ways = mode.blows(place)
        if some.size < 2:
            return jnp.asarray(False)
        # A loop that closes over numbers that vary cannot be transposed.
        t, y, params, vector, latest = constant_unless(False, (t, y, mode.problem.params, mode.vector, self.ts[-1]))
        mode = mode._replace(vector=vector)
        there = there[some]
        resets = [functools.partial(state_after, mode.leaving[k], mode.layout, t, params=params) for k in some]
        orders = jnp.stack([jnp.arange(some.size, 0, -1), jnp.arange(1, some.size + 1)])

        def going(y):
            return there & (mode.guards_at(t, y, latest).clear_rates()[some] * ways > 0)

        def blow(y, hits, order):
            k = jnp.argmax(jnp.where(hits, order, 0))
            return jnp.where(hits.any(), jnp.stack([reset(y) for reset in resets])[k], y), k

        def follow(carry):
            states, armed, goes, largest, count = carry
            hits = armed & goes
            states, k = jax.vmap(blow)(states, hits, orders)
            goes = jax.vmap(going)(states)
            armed = (armed & ~(hits & (jnp.arange(some.size) == k[:, None]))) | ~goes
            return states, armed, goes, jnp.maximum(largest, jnp.abs(states).max(0)), count + 1

        def is_moving(carry):
            _, armed, goes, _, count = carry
            return (armed & goes).any() & (count < MOST_BLOWS) & (jnp.sum(there) > 1)

        goes = there & (rates[some] * ways > 0)
        states, goes = jnp.stack([y, y]), jnp.stack([goes, goes])
        first = states, goes | ~goes, goes, jnp.abs(y), jnp.asarray(0)
        (one, other), _, _, largest, _ = jax.lax.while_loop(is_moving, follow, first)
        return (jnp.abs(one - other) > SAME * largest).any()

    # ---- on which side of its surface every guard is ----

    def no_memory(self, rounding, rate_rounding) -> GuardMemory:
        """Nothing is known of any guard but its rounding."""
        count = len(self.plan.transitions)
        of_all = (jnp.broadcast_to(x, (count,)) for x in (rounding, rate_rounding))
        return GuardMemory(jnp.full(count, jnp.nan), jnp.zeros(count), *of_all)

    def _memory(self, mode: Mode, guarded: Guarded, rates, kinds, before: GuardMemory, sides, stays) -> GuardMemory:
        """The sides before a reset of the guards of this mode, which began on these `sides`."""
        # A guard that changes comes from the side that it leaves. Another one that is on its surface comes from where
        # it began, if it `stays` there since or has no rate, and else from where its rate does.
        places = self._places_of(mode)
        rounding = jnp.maximum(_pick(before.rounding, places), guarded.rounding)
        since = jnp.where(stays | (rates == 0), jnp.sign(sides), -jnp.sign(rates))
        here = jnp.where(jnp.abs(guarded.values) > rounding + guarded.of_time, jnp.sign(guarded.values), since)
        here = jnp.where(kinds > 0, jnp.where(kinds == 1, 1.0, -1.0), here)
        nothing = self.no_memory(before.rounding, before.rate_rounding)
        new = guarded.values, here, rounding, jnp.maximum(_pick(before.rate_rounding, places), guarded.rate_rounding)
        return GuardMemory(*(_put(x, places, of_mode) for x, of_mode in zip(nothing, new, strict=True)))

    def _note_rounding(self, before: Ending, guards: list[Guarded | None]) -> GuardMemory:
        """The memory with the rounding of the guards where a round begins: of its mode, and of other modes."""
        # A guard of another mode may be the same function. What is computed with that mode's equations says nothing
        # here.
        memory = before.memory
        for place, (mode, guarded) in enumerate(zip(self.modes, guards, strict=True)):
            if guarded is None:
                continue
            here, back = before.mode == place, self._places_of(mode).T
            alike = np.array(["multipliers" not in transition.guard.extras for transition in mode.leaving])
            values = jnp.where((here | alike) & jnp.isfinite(guarded.rounding), guarded.rounding, 0.0)
            rates = jnp.where(here & jnp.isfinite(guarded.rate_rounding), guarded.rate_rounding, 0.0)
            memory = memory._replace(
                rounding=jnp.maximum(memory.rounding, _pick(values, back)),
                rate_rounding=jnp.maximum(memory.rate_rounding, _pick(rates, back)),
            )
        return memory

    def _outset(self, place: int, guarded: Guarded | None, before: Ending) -> Outset:
        """The guards of a mode where a motion begins in it; for those beyond zero see `Transition`."""
        mode = self.modes[place]
        if guarded is None or mode.surfaces is None:
            return Outset(*jnp.zeros((2, 0)), *jnp.zeros((2, 0), bool))
        last_values, last_sides, rounding, largest = (_pick(x, self._places_of(mode)) for x in before.memory)
        rates, noise = guarded.clear_rates(largest), rounding + guarded.of_time
        directions = np.array([float(transition.direction) for transition in mode.leaving])

        # A guard comes from the side where it is; on its surface it can change in its direction, if it has one.
        sides = jnp.where(jnp.abs(guarded.values) > noise, jnp.sign(guarded.values), -directions)
        # The one that fired last goes to the side of its rate. Without a rate it stays where it was, unless it was
        # crossed: without a reset, and by a jump.
        crossed = np.array([transition.reset is None for transition in mode.leaving]) | mode.surfaces.have_no_rate
        fired_to = jnp.where(rates != 0, jnp.sign(rates), jnp.where(crossed, -last_sides, last_sides))
        fired_last = mode.numbers == before.latest
        # What the reset has not moved comes from where it was.
        unmoved = (jnp.abs(guarded.values - last_values) <= rounding) & (last_sides != 0)
        sides = jnp.where(unmoved, jnp.where(fired_last, fired_to, last_sides), sides)

        back, beyond_zero = mode.targets == place, guarded.values * directions > noise
        always = np.array([transition.fires == "beyond" for transition in mode.leaving])
        by_target = np.array([transition.fires is None for transition in mode.leaving])
        at_once = beyond_zero & (always | (by_target & ~back))
        blows = beyond_zero & by_target & back & self._are_blows(place, guarded, rates, before)
        from_behind = jnp.where(blows, -directions, sides) * jnp.maximum(noise, _LEAST)
        sides = jnp.where(at_once, np.copysign(np.inf, -directions), from_behind)
        lasting = jnp.where(rates == 0, before.t, before.t + 2.0 * noise / jnp.abs(rates))
        return Outset(sides, jax.lax.stop_gradient(lasting), at_once | blows, blows)

    def _are_blows(self, place: int, guarded: Guarded, rates, before: Ending) -> jax.Array:
        """True for every guard, (K,), whose reset keeps it off its surface: turns it round, or puts it back."""
        # A kick that leaves it to go on does not, nor does a section without a reset.
        mode = self.modes[place]
        some, ways = mode.blows(place)
        are_blows = jnp.zeros(len(mode.leaving), bool)
        if not some.size:
            return are_blows
        t, y, params = constant_unless(False, (before.t, before.y, mode.problem.params))
        states = jnp.stack([state_after(mode.leaving[k], mode.layout, t, y, params) for k in some])
        after = jax.vmap(mode.guards_at, (None, 0, None))(t, states, self.ts[-1])
        after = jax.tree.map(lambda x: x[np.arange(some.size), some], after)
        later, moved = after.clear_rates() * ways, (guarded.values[some] - after.values) * ways
        turned = jnp.where(rates[some] * ways < 0, later >= 0, later <= 0)
        return are_blows.at[some].set(turned | (moved > after.rounding))

    def _places_of(self, mode: Mode):
        """The places of a mode's transitions among all, (K of the mode, K) of bool."""
        return mode.numbers[:, None] == np.arange(len(self.plan.transitions))


def _select(condition, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _pick(x: jax.Array, places) -> jax.Array:
    """The entry of x (K,) in each row of `places` (…, K), which hold one at most: 0 without any."""
    # In a batch XLA makes several programs of a look-up, and one of this.
    found = jnp.where(places, x, jnp.zeros_like(x))
    return found.any(-1) if x.dtype == bool else found.sum(-1)


def _put(x: jax.Array, places, values: jax.Array) -> jax.Array:
    """x (K,) with these values (k,) at their places (k, K)."""
    return jnp.where(places.any(0), _pick(values, places.T), x)


def _pile_up(times, end) -> jax.Array:
    """True if the times of a spent budget of transitions run geometrically to a limit before `end`."""
    # Aitken's extrapolation of the last times, taken far enough apart that a pattern of two, three or six transitions
    # (a flight and a contact, say) repeats in between: three intervals whose two ratios agree, and are below one. Or
    # the time does not move any more.
    pattern = next((k for k in (6, 2, 1) if 3 * k < times.size), None)
    if pattern is None:
        return jnp.asarray(False)  # too few to tell
    first, second, third = jnp.diff(times[-1 - 3 * pattern :: pattern])
    last_ratio, ratio = second / first, third / second
    agree = jnp.abs(jnp.log(ratio) - jnp.log(last_ratio)) <= STEADY * jnp.abs(jnp.log(last_ratio))
    limit = times[-1] + third * ratio / (1 - ratio)
    # One interval alone may be that of two transitions at the same instant.
    stands_still = (third <= 4 * float(jnp.finfo(times.dtype).eps) * jnp.abs(times[-1])) & (pattern > 1)
    return stands_still | ((ratio < 1) & agree & (limit < end))


def _go_in_turn(record: TransitionRecord) -> jax.Array:
    """True if the last transitions of a spent budget, of several kinds, are at one instant to which none pile up."""
    if record.t.size < IN_ONE_PLACE:
        return jnp.asarray(False)
    last, kinds = record.t[-1], record.source * record.t.size + record.target
    same = jnp.abs(record.t - last) <= 4 * float(jnp.finfo(record.t.dtype).eps) * jnp.abs(last)
    before = jnp.max(jnp.where(same, -jnp.inf, record.t))
    both = (kinds[-IN_ONE_PLACE:] != kinds[-1]).any()
    return same[-IN_ONE_PLACE:].all() & both & (last - before > APART * jnp.abs(last))
