"""The rounds of a motion with contacts: each runs to the next watch that falls through zero, and decides what follows.

A contact has watches that stay positive: its gap, or one-way velocity, while it is open, its normal force λ while it is
closed; with friction the slip in its direction while it slides, μ²λ² − f² while it sticks. One program serves all
contacts, whatever they do (`InContact`). Where a watch falls,

    a gap             impulses, where the contact moves inwards (`_impact_law`); else the contact closes
    λ                 it opens
    the slip          it sticks
    what friction has left    it slides, against the force that held it

A guess that is wrong is a watch that begins beyond zero, or whose first coefficient that is not rounding is negative:
it falls at once, and the next round takes it back (`_native._events`). That is Murty's principal pivoting, over series
in place of numbers (Murty, Linear Algebra Appl. 5 (1972) 65; Heemels, Schumacher & Weiland, ibid. 294 (1999) 93).
Bounces that accumulate end at a closed form of their limit (`_end_of_bounces`).
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Problem
from lagjax._engine.taylor import MOST_GUARDS, Guarded, Surfaces, flow_of, line_of, require_one_number, vector_of
from lagjax._interface import RESULTS, SUCCESSFUL, Function, Layout, code_of, compile_for_one_call, halves
from lagjax._native import GUARD_NOISE, SINGLE_NOISE, Released
from lagjax._primitives import cond_alike, differentiable_where, keep_together, lost_unless, start_alike
from lagjax._run._rounds import Stretch, any_member, run_rounds
from lagjax._run._trajectory import vary_with
from lagjax._run.contacts._corners import Corners, append_sides, corners_of
from lagjax._run.contacts._impact_law import (
    Friction,
    ImpactRows,
    Pattern,
    construct_impulses,
    find_pattern,
    find_phases,
    held_slips,
    impulse_solver,
    independent_rows,
    rates_behind,
    reached,
    sliding_margin,
    violations,
)
from lagjax._scene import Contacts, ContactScene, Flat, InContact

PyTree = Any

(TOO_MANY, UNDECIDED, IN_TURN, MISSED, AT_CORNER, NOT_FINITE, INCONSISTENT, BACKWARDS, NO_RESTITUTION,
 NO_FRICTION) = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.contact_undecided, RESULTS.contacts_in_turn, RESULTS.contact_missed,
     RESULTS.contact_at_corner, RESULTS.nonfinite_state, RESULTS.inconsistent_start, RESULTS.contact_backwards,
     RESULTS.restitution_out_of_range, RESULTS.friction_out_of_range),
)  # fmt: skip
CLOSES, OPENS, BOUNCES, STICKS, SLIDES = range(5)  # the kinds of `ContactChanges`
# The time that bounces still take, in parts of a step of the motion between them, below which they end in closed form,
# and what that leaves out: twice as long, heights of 4e-9 of those of a step are left out.
SHORT, LEFT_OUT = 1e-4, 1e-14
# Forces that are none, in parts of those that stop the bodies within a step: some fifty roundings.
FORCELESS = 1e-14
# By how much the instants of contacts that share an impact may vary apart, for a tangent of length one: rounding.
TOGETHER = 1e-8
# How far below zero a gap counts as gone through: a hundred local errors, of its largest terms.
THROUGH = 100.0
# What sliding leaves of a contact's response at which it is lost: a paradox, to rounding.
PARADOX = 1e-12
# How many of its roundings a gap may move in a step by a force that counts as none, where no other choice is left.
TIED = 1e3
# The slip in space that has no direction of its own, in parts of the largest one; and in parts of what a force that
# breaks away brings about in a step. Half of that takes √2 times the steps, of some ten thousand: at rest friction
# turns a slip at once, and steps are as short as that takes.
NO_SLIP, AT_REST = 1e-11, 1e-8
HARDLY = 1e-6  # of the largest velocities so far: a contact that moves apart slower may close
GAINED = 1e-12  # of the work of an impact: a gain of energy beyond rounding
# Of the largest slip so far: what is more, where the slip along its first direction ends, has turned.
TURNED = 1e-6
EPS = float(np.finfo(float).eps)
# Operations that have a series everywhere, which hides nothing.
_SEEN = frozenset(("input", "constant", "convert", "add", "sub", "mul", "neg", "sin", "cos", "exp", "tanh"))
_LEAST = 1e-300  # a side that is exactly zero still has a sign


class ContactPlan(eqx.Module):
    """The constants of a run: the scene, its budgets, and whether the start came in float32.

    The `sections` are watched, too, each for changes of its sign in its direction, of which a round makes a note.
    """

    scene: ContactScene
    rtol: float = eqx.field(static=True)
    atol: float | None = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)
    sections: tuple[Function, ...] = ()
    directions: tuple[int, ...] = eqx.field(static=True, default=())


class Carry(NamedTuple):
    """A motion between rounds."""

    t: jax.Array
    y: jax.Array  # (2n,)
    contacts: Contacts
    fresh: jax.Array  # (G,), whether what a watch follows has begun at this instant
    going: jax.Array
    result: jax.Array
    steps: tuple[jax.Array, jax.Array]  # accepted, rejected
    rounds: jax.Array  # how many there were
    longest: jax.Array  # the longest step of the motion
    turns: jax.Array  # how many decisions there were at this instant
    tied: jax.Array  # (k + r,), whether it turns there by rounding between open and closed, sticking and sliding
    refuted: jax.Array  # (k,), whether a contact has opened there
    forceless: jax.Array  # (k,), the force that rounding of a gap and of its rate could make in a step
    rounding: jax.Array  # (2, G), the largest of a watch of an open or sliding contact, and of a closed or sticking one
    rate_rounding: jax.Array
    came: jax.Array  # (S,), the sides of the sections from which the motion comes
    slip: jax.Array  # (r,), the largest so far
    largest: jax.Array  # (2n,), the largest numbers of the state so far
    doubts: jax.Array  # (3,), as in `ContactChanges`
    doubted: jax.Array
    path: jax.Array  # (T, 2n), NaN where not reached
    of_path: Contacts  # what the contacts did at the outputs


class RoundRecord(NamedTuple):
    """The end of a round, if it `happened`: the time, the velocities before it, the state behind it, what changed.

    That is the contact, and the kind of its change; behind the contacts, a section that was crossed. And its impact, if
    there is one: `t_impact`, the normal impulses (k,), the energy that was lost. Else NaN and −1.
    """

    happened: jax.Array
    t: jax.Array
    qdot: jax.Array
    y_next: jax.Array
    contact: jax.Array
    change: jax.Array
    hits: jax.Array
    t_impact: jax.Array
    impulse: jax.Array
    energy_lost: jax.Array

    @classmethod
    def absent(cls, states: int, contacts: int) -> "RoundRecord":
        no, none, nan, y = jnp.asarray(False), jnp.asarray(-1), jnp.asarray(jnp.nan), jnp.full(states, jnp.nan)
        return cls(no, nan, halves(y)[1], y, none, none, no, nan, jnp.full(contacts, jnp.nan), nan)


@compile_for_one_call
def contact_motion(
    plan: ContactPlan, layout: Layout, ts, y0, params: PyTree, room: int | None = None, begun: Carry | None = None
) -> tuple[Carry, RoundRecord, tuple]:
    """The motion from y0 (2n,) at ts[0], its rounds, of which there may be `max_transitions`, and its impacts.

    Those are their times, the normal impulses, the energy that was lost, and their count. With less `room` for rounds
    the motion may have to go on: it has then `begun`.
    """
    ts, y0, params = start_alike((jnp.asarray(ts), jnp.asarray(y0), params))
    rounds = ContactRounds.from_plan(plan, layout, ts, y0, params)
    begun = rounds.begin(y0) if begun is None else begun
    first = vary_with(begun, ts, y0, rounds.vector, varying=("t", "y", "path"))
    absent = RoundRecord.absent(y0.size, rounds.count)
    ending, record = run_rounds(rounds.run_round, first, absent, room or plan.max_transitions)
    unseen = (ending.of_path.closed < 0).any() | ~jnp.isfinite(ending.path).all()
    unseen = unseen & (ending.result == SUCCESSFUL) & ~ending.going
    ending = ending._replace(result=jnp.where(unseen, NOT_FINITE, ending.result))
    inputs, outputs = (ts, y0, rounds.vector), jax.lax.stop_gradient((ts, ending.path, ending.of_path))
    if rounds.may_miss:
        missed = jax.vmap(lambda *output: rounds.missed(ending, rounds.watch(*output), output[-1]).any())(*outputs)
        ending = ending._replace(result=jnp.where(missed.any(), MISSED, ending.result))

    def lost(there, *numbers):
        return (lost_unless(there[:, *[None] * (x.ndim - 1)], x, inputs) for x in numbers)

    t, qdot, y_next = lost(record.happened, record.t, record.qdot, record.y_next)
    t_impact, impulse, energy_lost = lost(record.hits, *record[-3:])
    path = lost_unless((ending.of_path.closed >= 0).all(axis=1)[:, None], ending.path, inputs)
    each = np.arange(record.hits.size)  # impacts in front
    place = jnp.where(record.hits, jnp.cumsum(record.hits) - 1, each.size)
    source = jnp.full(each.size, each.size).at[place].set(each, mode="drop")
    t_impact, impulse, energy_lost = (
        x.at[source].get(mode="fill", fill_value=jnp.nan) for x in (t_impact, impulse, energy_lost)
    )
    impacts = t_impact, rounds.flat.shapes.name_numbers(impulse), energy_lost, jnp.sum(record.hits)
    return ending._replace(path=path), record._replace(t=t, qdot=qdot, y_next=y_next), impacts


class ContactRounds(NamedTuple):
    """All that the rounds of a run share: the lines of its scene, the user's parameters, and the output times."""

    plan: ContactPlan
    problem: Problem  # without a state and times
    flat: Flat
    surfaces: Surfaces
    of_open: Surfaces  # the same where no contact is closed
    places: "RowPlaces"
    corners: Corners | None
    response: Any  # the line of `ImpactRows`
    multipliers: Any
    params: PyTree
    vector: jax.Array
    widths: tuple
    ts: jax.Array
    y0: jax.Array

    @classmethod
    def from_plan(cls, plan: ContactPlan, layout: Layout, ts, y0, params) -> "ContactRounds":
        flat = Flat.from_system(plan.scene.system, layout, params)
        limits = {"rtol": plan.rtol, "atol": plan.atol, "max_steps": plan.max_steps}
        inside = InContact(params, opened(flat))
        problem = Problem.from_system(plan.scene, layout, inside, **limits)
        problem = dataclasses.replace(problem, is_rounded=plan.is_single)
        derivation = problem.derivation.lowered
        code, structure = jax.tree.flatten(eqx.filter(inside, eqx.is_array_like, inverse=True))
        places = RowPlaces.from_derivation(derivation, flat)
        corners = corners_of(derivation, places.all, flat.shapes)
        turns = 0 if corners is None else len(corners.touch)
        if (watches := flat.shapes.count + flat.rough.size + 2 * turns + len(plan.sections)) > MOST_GUARDS:
            raise ValueError(
                f"The contacts, with {turns} corners of their gaps, make {watches} watches, and {MOST_GUARDS} are "
                "possible: one a contact, one more with friction, two a corner. A table (jnp.interp) is one corner."
            )
        watched = turns, plan.sections, plan.directions, tuple(code), structure, plan.is_single
        surfaces = _watches(derivation, plan.scene, *watched)
        _, of_open = _open_watches(derivation, plan.scene, *watched)
        states = sum(x.size for x in opened(flat))
        lines = line_of(derivation.impact_response(places.all, states)), line_of(derivation.multipliers)
        numbers = vector_of(eqx.filter(params, eqx.is_array_like))
        widths = tuple(SINGLE_NOISE * jnp.abs(jax.lax.stop_gradient(x)) for x in (jnp.append(y0, ts[0]), numbers))
        return cls(plan, problem, flat, surfaces, of_open, places, corners, *lines, params, numbers, widths, ts, y0)

    @property
    def count(self) -> int:
        return self.flat.shapes.count

    @property
    def rubs(self) -> bool:
        return self.flat.rough.size > 0

    @property
    def contact_watches(self) -> int:
        """The watches of contacts alone: the normal ones, and behind them those of friction."""
        return self.count + self.flat.rough.size

    @property
    def deciding(self) -> int:
        """The watches that decide: those of contacts, two a corner. Behind them are the sections."""
        return self.contact_watches + 2 * (0 if self.corners is None else len(self.corners.touch))

    @property
    def impacts(self) -> str:
        return self.plan.scene.system.impacts

    @property
    def has_gap(self) -> np.ndarray:
        return np.arange(self.count) < self.flat.gap_count

    @property
    def friction(self) -> Friction:
        coefficients = self.flat.friction(eqx.filter(self.params, eqx.is_array_like))
        return Friction(self.flat.rough, self.flat.shapes.directions, coefficients)

    def numbers_in(self, contacts: Contacts):
        return jnp.concatenate([self.vector, *map(jnp.ravel, contacts)])

    # ---- a round ----

    def begin(self, y0) -> Carry:
        """The start, with all contacts open: those that touch and do not move apart fall at once."""
        contacts, sections = opened(self.flat), len(self.plan.sections)
        guards = self.deciding + sections
        guarded = self.watch(self.ts[0], y0)
        rows, rises = self.rows_at(self.ts[0], y0), self.acceleration_at(self.ts[0], y0, self.numbers_in(contacts))
        rows, rises = jax.lax.stop_gradient((rows, rises))
        width = start_width(rows.gradients[: self.count], jax.lax.stop_gradient(y0), rises, self.ts)
        inside = ((guarded.values + guarded.rounding)[: self.count] < -width) & self.has_gap
        e, mu = self.flat.restitution(eqx.filter(self.params, eqx.is_array_like)), self.friction.coefficients
        wrong = {
            BACKWARDS: self.ts[-1] < self.ts[0], NO_RESTITUTION: ~((e >= 0) & (e <= 1)).all(),
            NO_FRICTION: ~((mu >= 0) & jnp.isfinite(mu)).all(), INCONSISTENT: inside.any(),
        }  # fmt: skip
        result = jnp.select(list(wrong.values()), list(wrong), SUCCESSFUL)
        if self.rubs:  # one that slides and touches may stay or leave
            touches, rates, noise, _ = self.touching(self.ts[0], y0)
            slips, still = self.slips(rows, halves(y0)[1], 0.0)
            along = Pattern((touches & (jnp.abs(rates) <= noise)).astype(float), still.astype(float), _unit(slips))
            undecided = (sliding_margin(rows, along, self.friction.still) <= PARADOX).any()
            result = jnp.where(undecided & (result == SUCCESSFUL), UNDECIDED, result)
        t, path = self.ts[0], jnp.full((self.ts.size, y0.size), jnp.nan)
        of_path = jax.tree.map(lambda x: jnp.full((self.ts.size, *x.shape), -1.0), contacts)
        if self.corners is not None:  # a contact that starts on its corner goes where the motion does
            at = self.locate_corners(t, y0, contacts, 0.0)
            passed = (jnp.abs(at.values) <= at.far) & (self.corners.touch & self.touching(t, y0)[0]).any(axis=1)
            acceleration = self.acceleration_at(t, y0, self.numbers_in(contacts))
            t, y0, rests = at.go_beyond(passed, t, y0, acceleration, self.ts)
            result = jnp.where(rests & (result == SUCCESSFUL), AT_CORNER, result)
            late = (self.ts <= t) & (t > self.ts[0])
            path = jnp.where(late[:, None], y0, path)
            of_path = jax.tree.map(lambda old, new: jnp.where(late[:, *[None] * new.ndim], new, old), of_path, contacts)
        return Carry(
            t=t, y=y0, contacts=contacts, fresh=jnp.ones(guards, bool), going=result == SUCCESSFUL,
            result=result, steps=(jnp.zeros((), int), jnp.zeros((), int)), rounds=jnp.zeros((), int),
            longest=jnp.zeros(()), turns=jnp.zeros((), int), tied=jnp.zeros(self.contact_watches, bool),
            refuted=jnp.zeros(self.count, bool), forceless=jnp.zeros(self.count),
            rounding=jnp.zeros((2, guards)), rate_rounding=jnp.zeros((2, guards)),
            came=jnp.sign(guarded.rates)[guards - sections :],
            slip=jnp.zeros(self.flat.rough.size), largest=jnp.abs(jax.lax.stop_gradient(y0)),
            doubts=jnp.zeros(3, int), doubted=jnp.full(3, jnp.nan), path=path, of_path=of_path,
        )  # fmt: skip

    def run_round(self, before: Carry, _) -> tuple[Carry, RoundRecord]:
        """One round: to the next watch that falls, through what happens there; of a motion that is going."""
        here, contacts = before.going, before.contacts
        if self.corners is not None:
            at = self.locate_corners(before.t, before.y, contacts, before.largest)
            contacts = contacts._replace(near=at.near)
            before = before._replace(contacts=contacts)
        watches, sections = self.deciding, len(self.plan.sections)
        guarded = self.watch(before.t, before.y, contacts)
        missed = (self.missed(before, guarded, contacts) & ~before.fresh[: self.count]).any()
        others = watches + sections - self.contact_watches
        kinds = jnp.pad(jnp.concatenate([contacts.closed, contacts.sticks]), (0, others))
        before = _note_rounding(before, guarded, kinds, 0.0)
        rounding, rates = (_choose_kind(x, kinds) for x in (before.rounding, before.rate_rounding))
        rounding, rates = self.hold_ties(before, guarded, rounding, rates)
        rounding = jnp.maximum(rounding, guarded.of_time)
        beyond = (guarded.values < -rounding) & (np.arange(kinds.size) < self.contact_watches)
        sides = jnp.where(beyond, jnp.inf, jnp.maximum(rounding, _LEAST))
        sides = sides.at[self.contact_watches : watches].set(0.0)  # where a corner is met first tells the motion
        clear = (jnp.abs(guarded.values) > rounding)[watches:]
        came = jnp.where(clear, jnp.sign(guarded.values[watches:]), before.came)
        sides = sides.at[watches:].multiply(came)
        noted = jnp.concatenate([sides, rates])
        problem = dataclasses.replace(self.problem, params=InContact(self.params, contacts))
        stretch = Stretch.locate(problem, self.surfaces, (before.t, before.y), self.ts, here, noted, kinds.size)
        located, covered, at_once, fell = stretch.located, stretch.covers, stretch.at_once, stretch.kinds > 0
        happens, decides, k = fell.any(), fell[:watches].any(), self.first_of(fell[:watches], at_once, contacts)
        if sections:
            k = jnp.where(decides, k, watches + jnp.argmax(fell[watches:]))
        # What starts on a gap and moves inwards comes from in front of it: that instant varies as any impact's does.
        falls = (guarded.rates < -rates) & (np.arange(kinds.size) < self.count) & (before.t == self.ts[0])
        stays = (before.fresh | beyond) & ~(falls & (kinds == 0))
        path, t, y = stretch.vary(k, happens & ~(at_once & _pick(stays, k)))
        duration = located.t_end - jax.lax.stop_gradient(before.t)
        turns = jnp.where(at_once, before.turns + 1, 0)
        step = jnp.where(at_once, 0.0, duration / jnp.maximum(located.accepted, 1))
        is_first, in_plane = np.arange(self.contact_watches) == k, self.flat.shapes.directions == 1
        opens, sticks = contacts.closed > 0, (contacts.sticks == 0) & in_plane & (turns > kinds.size)
        loops = jnp.concatenate([~opens & before.refuted, sticks])
        tied, refuted = before.tied | (is_first & loops), before.refuted | (is_first[: self.count] & opens)
        tied, refuted = at_once & tied, at_once & refuted
        before = _note_rounding(before, guarded, kinds, duration)._replace(
            fresh=before.fresh & at_once, longest=jnp.maximum(before.longest, step)
        )
        decided, record = self.decide(before, t, y, k)
        if sections:  # a note changes nothing but the side of its section
            decided, record = self.note(decides, decided, record, before._replace(came=came), t, y, k, stretch.kinds)

        result = jnp.where(happens, decided.result, located.result)
        result = jnp.where(happens & (turns > 16 + 8 * kinds.size), IN_TURN, jnp.where(missed, MISSED, result))
        if self.corners is not None:  # time itself may go beyond its corner
            late = happens & (self.ts <= decided.t) & ~covered & (before.of_path.closed[:, 0] < 0)
            path, covered = jnp.where(late[:, None], decided.y, path), covered | late
        sound = jnp.isfinite(jnp.where(happens, decided.y, y)).all()
        result = jnp.where(~sound & (result == SUCCESSFUL), NOT_FINITE, result)
        going = happens & (result == SUCCESSFUL)
        spent = going & (before.rounds + 1 >= self.plan.max_transitions)
        cover = lambda old, new: jnp.where(covered[:, *[None] * new.ndim], new, old)  # noqa: E731
        after = decided._replace(
            t=jnp.where(happens, decided.t, t), y=jnp.where(happens, decided.y, y), going=going & ~spent,
            contacts=jax.tree.map(lambda new, old: jnp.where(happens, new, old), decided.contacts, contacts),
            result=jnp.where(spent, TOO_MANY, result), turns=turns, tied=tied, refuted=refuted,
            steps=(before.steps[0] + located.accepted, before.steps[1] + located.rejected),
            rounds=before.rounds + happens, doubts=jnp.where(happens, decided.doubts, before.doubts),
            doubted=jnp.where(happens, decided.doubted, before.doubted),
            path=jnp.where(covered[:, None], path, before.path),
            of_path=jax.tree.map(cover, before.of_path, contacts),
        )  # fmt: skip
        after = jax.tree.map(lambda new, old: jnp.where(here, new, old), after, before)
        absent, happened = RoundRecord.absent(before.y.size, self.count), happens & here
        hits = record.hits & happened
        kept = (happened,) * 6 + (hits,) * 4
        return after, RoundRecord(
            *(jnp.where(is_kept, new, old) for is_kept, new, old in zip(kept, record, absent, strict=True))
        )

    def hold_ties(self, before: Carry, guarded: Guarded, rounding, rates) -> tuple:
        """The roundings (G,) of watches and their rates; a tie is a contact that turns at an instant without end.

        Closed, its force is none if rounding of the gap could make it. It sticks until its value falls: a rate is no
        reason.
        """
        count, lasts = self.count, jnp.where(before.longest > 0, before.longest, 1.0)
        none = jnp.where(before.tied[:count] & (before.contacts.closed > 0), before.forceless, 0.0)
        rounding, rates = rounding.at[:count].max(none), rates.at[:count].max(3.0 * none / lasts)
        if not self.rubs:
            return rounding, rates
        around = self.count, guarded.values.size - self.contact_watches
        tied = jnp.pad(before.tied[count:] & (before.contacts.sticks > 0), around)
        most = self.friction.still.coefficients * guarded.values[: self.count][self.flat.rough]
        return (
            jnp.where(tied, jnp.pad(GUARD_NOISE * most**2, around), rounding),
            jnp.where(tied, jnp.maximum(guarded.rate_rounding, -2.0 * guarded.rates), rates),
        )

    def note(self, decides, decided: Carry, record: RoundRecord, before: Carry, t, y, k, kinds) -> tuple:
        """The decision as it is, where a round `decides`; else the motion as it was, with a note of section k."""
        place = k - kinds.size + len(self.plan.sections)
        came = jnp.where(np.arange(before.came.size) == place, 2.0 * kinds[-before.came.size :] - 3.0, before.came)
        noted = RoundRecord.absent(y.size, self.count)
        noted = noted._replace(happened=jnp.asarray(True), t=t, y_next=y, contact=self.count + place)
        decided, record = jax.tree.map(
            lambda new, old: jnp.where(decides, new, old),
            (decided._replace(came=before.came), record),
            (before._replace(came=came, t=t, y=y), noted),
        )
        return decided, record

    def first_of(self, fell, at_once, contacts: Contacts):
        """The watch that is taken of those that `fell` (G,): of corners, then of friction, as one that jams is."""
        count, rough, last = self.count, self.flat.rough, self.contact_watches
        if self.rubs:
            jams = at_once & fell[:count][rough] & (contacts.closed[rough] * contacts.sticks > 0)
            of_friction = fell[count:last] | jams
            k = jnp.where(of_friction.any(), count + jnp.argmax(of_friction), jnp.argmax(fell[:count]))
        else:
            k = jnp.argmax(fell[:count])
        return jnp.where(fell[last:].any(), last + jnp.argmax(fell[last:]), k) if fell.size > last else k

    # ---- what is known at a state ----

    def watch(self, t, y, contacts: Contacts | None = None) -> Guarded:
        """The watches at a state, without derivatives; by default those of open contacts."""
        of_state, of_params = self.widths
        numbers = self.numbers_in(contacts or opened(self.flat))
        exact = jnp.pad(of_params, (0, numbers.size - of_params.size))
        given = jax.lax.stop_gradient((t, y, numbers, self.ts[-1], (of_state, exact)))
        if contacts is None:
            return self.of_open.evaluate_guards(*given)
        is_held = any_member((contacts.closed > 0).any())
        return cond_alike(is_held, self.surfaces.evaluate_guards, self.of_open.evaluate_guards, *given)

    @property
    def may_miss(self) -> bool:
        """True if an operation of the watches of open contacts may hide a corner from a series."""
        return not {op for op, _, _ in self.of_open.values.line.nodes} <= _SEEN

    def missed(self, before: Carry, guarded: Guarded, contacts: Contacts):
        """True for each gap (k,) that is negative though it was followed, and open: its series did not show that."""
        if not self.may_miss:
            return np.zeros(self.count, bool)
        rounding = jnp.maximum(guarded.rounding, jnp.maximum(guarded.of_time, before.rounding[0]))
        slack = rounding * max(1.0, THROUGH * self.plan.rtol / GUARD_NOISE)
        return (guarded.values < -slack)[: self.count] & self.has_gap & (contacts.closed == 0)

    def rows_at(self, t, y) -> ImpactRows:
        size, n = len(self.places.all), y.size // 2
        values = self.response(jnp.concatenate([y, t[None], self.numbers_in(opened(self.flat))]))
        shapes = (size, n), (size, n), (size, size), (size,), (size,), (size,)
        parts = jnp.split(values, np.cumsum([math.prod(shape) for shape in shapes])[:-1])
        return ImpactRows(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))

    def slips(self, rows: ImpactRows, v, largest) -> tuple:
        """The slips (r, d), and whether each is rounding, beside the `largest` so far."""
        slips = rows.rates[self.count :].reshape(-1, self.flat.shapes.directions)
        terms = (jnp.abs(rows.gradients[self.count :]) @ jnp.abs(v)).reshape(slips.shape).max(axis=1)
        return slips, _length(slips) <= jnp.maximum(1e-12 * terms, 1e-13 * largest)

    def touching(self, t, y) -> tuple:
        """True for contacts that touch (k,), how fast they move apart, the rounding of these rates; and the watches."""
        guarded, k = self.watch(t, y), self.count
        values, noise = guarded.values[:k], guarded.rounding[:k] + guarded.of_time[:k]
        rates = jnp.where(self.has_gap, guarded.rates[:k], values)
        of_rates = jnp.where(self.has_gap, guarded.rate_rounding[:k], noise)
        touches = jnp.where(self.has_gap, jnp.abs(values) <= noise, values <= noise)
        return touches, rates, of_rates, guarded

    # ---- what happens at a watch that fell ----

    def decide(self, before: Carry, t, y, k) -> tuple[Carry, RoundRecord]:
        """The state and the contacts behind watch k, which fell at (t, y)."""
        still, numbers, count = jax.lax.stop_gradient, eqx.filter(self.params, eqx.is_array_like), self.count
        first, contacts = np.arange(self.contact_watches) == k, before.contacts
        was_closed, meets = contacts.closed > 0, first[:count] & ~(contacts.closed > 0)
        opens_at, struck, may_jump, t_next, y_beyond = self.pass_corners(before, t, y, k, meets)
        rows, (_, v), friction = self.rows_at(t, y), halves(y), self.friction
        restitution, quiet = self.flat.restitution(numbers), still(rows)
        meeting = self.meet(before, quiet, t, y, meets, still(restitution), friction.still)
        hits = meeting.happened
        slips = self.slips(quiet, still(v), before.slip)
        # A gap that falls while it moves apart is zero to more than the rounding of its terms: it goes on beyond that.
        # Where it hardly moves, as at the end of many bounces, it closes.
        rates = jnp.abs(quiet.gradients[:count]) @ halves(before.largest)[1]
        parts = meets & ~hits & self.has_gap & (quiet.rates[:count] > jnp.maximum(meeting.noise, HARDLY * rates))
        closed = (was_closed & ~first[:count] & ~opens_at) | (meets & ~parts)
        sticks = self.sticks(before, slips, first[count:], (closed != was_closed)[self.flat.rough])
        # Where parts align, a slip that gaps hold passes through zero, and turns.
        turns = held_slips(quiet, closed, first[count:] & sticks, friction)
        sticks = sticks & ~turns

        held = Pattern(closed.astype(float), sticks.astype(float), jnp.zeros_like(contacts.direction))
        impulses, ends, left, sound = self.impulses(before, rows, t, y, meeting, held, restitution)
        change = impulses @ rows.responses

        apart = quiet.rates + quiet.coupling @ still(impulses)
        stays = meeting.touches & (jnp.abs(apart[:count]) <= meeting.noise)
        closed = jnp.where(hits, self.press(rows, t, y, still(change), stays, friction.still), closed)
        changed = (closed != was_closed) | (hits & meeting.involved)
        undecided, slip = hits & ~sound, before.slip
        direction, turned, starts, leaves_rest = contacts.direction, changed[:0], changed[:0], jnp.asarray(False)
        if self.rubs:
            behind = self.slips(quiet._replace(rates=apart), still(v + change), slip)
            renewed = changed[self.flat.rough]
            sticks = jnp.where(hits & renewed, behind[1], sticks)
            breaks, slip = first[count:] & (contacts.sticks > 0), jnp.maximum(slip, _length(slips[0]))
            # In space what varies across a slip that begins from rest decays so fast that steps do not follow it.
            leaves_rest = (breaks & (self.flat.shapes.directions > 1)).any()
            starts = breaks & (t == self.ts[0])
            direction = self.directions(before, quiet, t, y, behind, breaks, renewed)
            direction = jnp.where(turns[:, None], -direction, direction)
            turned = renewed | first[count:] | (sticks != (contacts.sticks > 0))
            along = Pattern(closed.astype(float), sticks.astype(float), _unit(direction))
            undecided |= (sliding_margin(quiet, along, friction.still) <= PARADOX).any()
        before, y_next = self.move(before, rows, y_beyond, change, meets, first[:count] & was_closed)
        beyond = jnp.where(parts, 4.0 * before.rounding[0, :count] / jnp.diagonal(quiet.coupling)[:count], 0.0)
        y_next = y_next + jnp.concatenate([beyond @ quiet.responses[:count], jnp.zeros_like(v)])
        y_next = self.limit_variations(y_next, rows, meeting, starts)
        # Of the work of impulses only what moves q is kinetic energy: gaps may move by themselves.
        lost = -impulses @ (rows.gradients @ (v + 0.5 * change))
        work = still(impulses) * (quiet.rates + apart)
        doubts = jnp.stack([work.sum() > GAINED * jnp.abs(work).sum(), meeting.tied.any()]) & hits
        doubts = jnp.append(doubts, starts.any() | leaves_rest)
        others = before.fresh.size - changed.size - turned.size
        decided = before._replace(
            t=t_next, doubts=before.doubts + doubts,
            doubted=jnp.where(doubts & (before.doubts == 0), still(t), before.doubted),
            y=differentiable_where(~leaves_rest, y_next, t, y, self.vector), slip=slip,
            contacts=Contacts(closed.astype(float), sticks.astype(float), direction, contacts.near),
            fresh=before.fresh | jnp.concatenate([changed, turned, jnp.broadcast_to(opens_at.any(), others)]),
            result=jnp.select(
                [struck | (meeting.missed & may_jump), meeting.missed, undecided], [AT_CORNER, MISSED, UNDECIDED],
                before.result,
            ),
        )  # fmt: skip
        rest = t + jnp.sum(jnp.where(ends, left, 0.0))
        contact, change = self.name_change(k, closed, sticks, hits)
        if self.corners is not None:
            leaves = k >= self.contact_watches
            contact = jnp.where(leaves, jnp.where(opens_at.any(), jnp.argmax(opens_at), -1), contact)
            change = jnp.where(leaves, jnp.where(opens_at.any(), OPENS, -1), change)
        return decided, RoundRecord(
            jnp.asarray(True), t, v, decided.y, contact, change, hits, rest, impulses[:count], lost
        )  # fmt: skip

    def move(self, before: Carry, rows: ImpactRows, y, change, meets, opens) -> tuple[Carry, Any]:
        """The state behind a `change` of the velocities, where contacts `meets` close; and what rounding leaves there.

        The gap that closes is zero, also as what went in varies: what rounding leaves of it grows with each bounce.
        """
        still, count, (_, v) = jax.lax.stop_gradient, self.count, halves(y)
        responses = jnp.diagonal(rows.coupling)[:count]
        back = jnp.where(meets & self.has_gap, -rows.values[:count] / responses, 0.0)
        y_next = y + jnp.concatenate([back @ rows.responses[:count], change])
        fast = jnp.abs(rows.gradients[:count]) @ jnp.maximum(jnp.abs(v), jnp.abs(v + change))
        before = _note_forces(before, still(fast / responses))
        before = before._replace(forceless=self.forceless(before, still(responses)))
        # A contact that opens does so with an acceleration that rounding of its force may make: it is no rate.
        of_rates = jnp.where(opens, before.longest * still(responses), 0.0) * before.rounding[1, :count]
        # What is less than its own rounding is zero: steps would be as short as to follow it.
        largest = jnp.maximum(before.largest, jnp.abs(y))
        y_next = y_next - still(jnp.where(jnp.abs(y_next) <= 2 * EPS * largest, y_next, 0.0))
        rate_rounding = before.rate_rounding.at[0, :count].max(of_rates)
        return before._replace(rate_rounding=rate_rounding, largest=largest), y_next

    def forceless(self, before: Carry, responses):
        """The forces (k,) that move gaps within a step by no more than some thousand of their roundings."""
        lasts = jnp.where(before.longest > 0, before.longest, self.ts[-1] - self.ts[0])
        noise = before.rounding[0, : self.count] + lasts * before.rate_rounding[0, : self.count]
        return 2.0 * TIED * noise / (responses * lasts**2)

    def limit_variations(self, y_next, rows: ImpactRows, meeting: "Meeting", starts):
        """The state, which has no derivatives in directions that take apart what happens at one instant.

        Contacts that share an impact and close by themselves do so along directions in which their gaps stay closed.
        By the least slip of a start at rest friction turns.
        """
        quiet, count = jax.lax.stop_gradient(rows), self.count
        limits = jnp.where(meeting.happened & meeting.tied, TOGETHER * jnp.abs(quiet.rates[:count]), jnp.inf)
        begun, gradients = jnp.repeat(starts, self.flat.shapes.directions), quiet.gradients[count:]
        limits = jnp.append(limits, jnp.where(begun, TOGETHER * jnp.abs(gradients).sum(axis=1), jnp.inf))
        start = halves(self.y0)[1]
        offsets = jnp.append(rows.values[:count], gradients @ start)
        return keep_together(y_next, offsets - jax.lax.stop_gradient(offsets), limits)  # only how they vary matters

    def pass_corners(self, before: Carry, t, y, k, meets) -> tuple:
        """At (t, y), where watch k fell: the contacts (k,) that come to a corner and open there; time and state beyond.

        And whether a contact is struck at its corner, or stays there; and whether one meets behind its corner.
        """
        if self.corners is None:
            return np.zeros(self.count, bool), np.array(False), np.array(False), t, y
        touch, contacts, first = self.corners.touch, before.contacts, self.contact_watches
        at, closed = self.locate_corners(t, y, contacts, before.largest), contacts.closed > 0
        away, new = jnp.abs(at.values), ~before.fresh[first : first + len(touch)]
        meets = (touch & meets & (away <= 4.0 * at.far)[:, None]).any(axis=1)
        passed = (away <= 2.0 * contacts.near) & new & (touch & closed).any(axis=1)
        acceleration = self.acceleration_at(t, y, self.numbers_in(contacts))
        t, y, rests = at.go_beyond(passed, t, y, acceleration, self.ts)
        opens = (touch & passed[:, None]).any(axis=0) & closed
        return opens, (meets & new).any() | rests, meets.any(), t, y

    def locate_corners(self, t, y, contacts: Contacts, largest):
        assert self.corners is not None
        return self.corners.evaluate(t, y, self.numbers_in(contacts), largest, self.ts[-1])

    def name_change(self, k, closed, sticks, hits) -> tuple:
        """The contact of watch k, and the kind of its change."""
        contact = jnp.asarray(np.concatenate([np.arange(self.count), self.flat.rough]))[k]
        normal = jnp.where(closed[contact], CLOSES, jnp.where(hits, BOUNCES, OPENS))
        if not self.rubs:
            return contact, normal
        stuck = jnp.asarray(np.concatenate([np.zeros(self.count, int), np.arange(self.flat.rough.size)]))[k]
        return contact, jnp.where(k < self.count, normal, jnp.where(sticks[stuck], STICKS, SLIDES))

    def impulses(self, before: Carry, rows: ImpactRows, t, y, meeting: "Meeting", held: Pattern, restitution) -> tuple:
        """The impulses (K,), which bounces end, (k,), how long these would take, and whether the law is obeyed.

        Behind an impact they follow its law; else velocities become those that what is `held` allows.
        """
        hits, friction = meeting.happened, self.friction
        pattern = jax.tree.map(lambda a, b: jnp.where(hits, a, b), meeting.pattern, held)
        acting = friction._replace(coefficients=jnp.where(hits, friction.coefficients, 0.0))
        constructs = self.rubs and self.impacts == "poisson"
        if constructs:
            bounced, along = construct_impulses(rows, restitution, friction.coefficients)
            pattern = pattern._replace(direction=jnp.where(hits, along, pattern.direction))
        else:
            bounced = rates_behind(rows, meeting.phases, restitution, acting)
        solve, bounced = impulse_solver(rows, pattern, acting), jnp.where(hits, bounced, 0.0)
        first = solve(bounced)
        given = rows, pattern, meeting.involved, first, 0.0 * bounced if meeting.phases else bounced
        normal, rubs = violations(*jax.lax.stop_gradient(given), friction.still)
        ends, left = self.end_of_bounces(before, rows, t, y, first, bounced, restitution)
        ends = ends & hits & (pattern.push > 0)
        return solve(jnp.where(ends, 0.0, bounced)), ends, left, constructs | ~(normal.any() | rubs.any())

    def press(self, rows: ImpactRows, t, y, change, stays, friction: Friction):
        """The contacts (k,) of those that stay in touch behind an impact which press upon each other there.

        Their accelerations decide, without friction; with it, or where these are zero, the rounds that follow do. Of
        contacts that are redundant all stay.
        """
        if self.rubs or self.count == 1:
            return stays
        behind = jax.lax.stop_gradient(y + jnp.concatenate([jnp.zeros_like(change), change]))
        bends = self.rows_at(t, behind).bends
        rows = jax.lax.stop_gradient(rows)._replace(rates=jax.lax.stop_gradient(bends))
        held = stays.astype(float)
        redundant = (independent_rows(rows.coupling, held) < held).any()
        return stays & (redundant | (find_pattern(rows, stays, jnp.zeros(self.count), friction).push > 0))

    def sticks(self, before: Carry, slips: tuple, fell, renewed):
        """True for contacts that stick (r,) behind watches of friction that `fell`, where there is no impact.

        A slip in space that has turned goes on. Where one stops others of the same body may, which
        then stick as well.
        """
        was_stuck = before.contacts.sticks > 0
        if self.flat.shapes.directions > 1:
            fell = fell & (was_stuck | (_length(slips[0]) <= TURNED * before.slip))
        stop = (fell & ~was_stuck).any() & slips[1]
        return jnp.where(renewed, slips[1], (was_stuck | fell | stop) & ~(fell & was_stuck))

    def directions(self, before: Carry, rows: ImpactRows, t, y, slips: tuple, breaks, renewed):
        """The directions in which contacts slide (r, d): against what held those that break away, or along the slip."""
        numbers = jax.lax.stop_gradient(jnp.concatenate([y, t[None], self.numbers_in(before.contacts)]))
        held = lambda numbers: self.multipliers(numbers)[self.places.tangential]  # noqa: E731
        none = lambda _: jnp.zeros(self.places.tangential.shape)  # noqa: E731
        force, (slip, still) = cond_alike(any_member(breaks.any()), held, none, numbers), slips
        moving = jnp.where(breaks[:, None], -force, slip)
        if self.flat.shapes.directions == 1:
            moving = jnp.where(moving < 0, -1.0, 1.0)
        else:
            places = self.count + np.arange(force.size).reshape(force.shape)
            lasts = jnp.where(before.longest > 0, before.longest, self.ts[-1] - self.ts[0])
            soon = _length(force) * jnp.diagonal(rows.coupling)[places].max(axis=1) * lasts
            length = jnp.where(breaks, AT_REST * jnp.maximum(before.slip, soon), NO_SLIP * _length(slip))
            moving = _unit(moving) * jnp.where(length > 0, length, _LEAST)[:, None]
        takes = breaks | ((renewed | (self.flat.shapes.directions > 1)) & ~still)
        return jnp.where(takes[:, None], moving, before.contacts.direction)

    def meet(self, before: Carry, rows: ImpactRows, t, y, meets, restitution, friction: Friction) -> "Meeting":
        """The contacts that take part where some meet, (k,), and what they do."""
        was_closed = before.contacts.closed > 0
        touches, rates, noise, guarded = self.touching(t, y)
        touches = touches | meets | was_closed | ~self.has_gap
        noise = jnp.maximum(noise, 0.01 * before.rate_rounding[0, : self.count])
        phases = ()
        linked = reached(rows, meets, touches, friction)
        involved = meets if self.impacts == "sequential" else linked
        if self.impacts != "poisson":
            pattern = find_pattern(rows, involved, restitution, friction)
        elif self.rubs:  # one contact in a plane
            pattern = Pattern(jnp.ones(1), jnp.zeros(1), jnp.zeros((1, 1)))
        else:
            pattern, phases = find_phases(rows, involved, restitution, friction)
        # One that has just bounced is pushed, too, where the time since then is rounding.
        closes = (rates < -noise) | ((rates > noise) & (pattern.push > 0) & self.has_gap)
        others = linked & ~meets & ~was_closed & closes & ~before.fresh[: self.count]
        noise_behind = jnp.maximum(noise, 1e-12 * jnp.max(jnp.abs(rates)))
        hits = (meets & (rates < -noise)).any()
        missed = (meets & self.missed(before, guarded, before.contacts)).any()
        return Meeting(hits, missed, pattern, phases, involved, touches, noise_behind, others)

    def end_of_bounces(self, before: Carry, rows: ImpactRows, t, y, impulses, bounced, restitution) -> tuple:
        """True for contacts that bounce with these velocities (k,) and come to rest at once, and the time it takes.

        With gap″ = −b − b′ s the bounces take 2u/(b (1 − e)) (1 − ⅔ k), k = b′ u / b² (1 − e), up to k².
        """
        n, k = y.size // 2, self.count
        y = y + jnp.concatenate([jnp.zeros(n), impulses @ rows.responses])
        numbers = self.numbers_in(opened(self.flat))
        acceleration = self.acceleration_at(t, y, numbers)

        def falls(t, y):
            return -self.rows_at(t, y).bends[:k]

        b, later = jax.jvp(falls, (t, y), (jnp.ones_like(t), jnp.concatenate([halves(y)[1], acceleration])))
        safe, rest = jnp.where(b > 0, b, 1.0), jnp.where(restitution < 1, 1 - restitution, 1.0)
        uneven = later * bounced / (safe**2 * rest)
        left = 2 * bounced / (safe * rest) * (1 - 2 / 3 * uneven)
        ends = (b > 0) & (restitution < 1) & (left >= 0) & (left <= SHORT * before.longest) & self.has_gap
        return jax.lax.stop_gradient(ends & (uneven**2 * left <= LEFT_OUT * (1 + jnp.abs(t)))), left

    def acceleration_at(self, t, y, numbers):
        program = self.problem.derivation.lowered.acceleration
        return line_of(program, y.size // 2)(jnp.concatenate([y, t[None], numbers]))


class Meeting(NamedTuple):
    """Contacts that meet: whether an impact `happened`, was `missed` before, and its `pattern`, or those of `phases`.

    And which are `involved`, which touch (k,), below which rate they stay closed, and which others are `tied`: that
    the impact reaches, in turn if it is sequential, and that close at this instant by themselves.
    """

    happened: Any
    missed: Any
    pattern: Pattern
    phases: tuple
    involved: Any
    touches: Any
    noise: Any
    tied: Any


class RowPlaces(NamedTuple):
    """The places of the rows of contacts among all: those of the normals (k,) and of the slips (r, d)."""

    normal: np.ndarray
    tangential: np.ndarray

    @property
    def all(self) -> tuple[int, ...]:
        return (*self.normal.tolist(), *self.tangential.ravel().tolist())

    @classmethod
    def from_derivation(cls, derivation, flat: Flat) -> "RowPlaces":
        total, (r, d) = derivation.shape("jacobian")[0], (flat.rough.size, flat.shapes.directions)
        gaps_end, slips = derivation.position_count, total - r * d
        one_way = flat.shapes.count - flat.gap_count
        normal = [*range(gaps_end - flat.gap_count, gaps_end), *range(slips - one_way, slips)]
        return cls(np.array(normal, int), slips + np.arange(r * d).reshape(r, d))


def _note_rounding(carry: Carry, guarded: Guarded, kinds, duration) -> Carry:
    """The carry with the largest rounding of its watches: of one that went away and came back that between them."""
    finite = [jnp.where(jnp.isfinite(x), x, 0.0) for x in (guarded.rounding, guarded.rate_rounding)]
    here = jnp.stack([1.0 - kinds, kinds])
    return carry._replace(
        rounding=jnp.maximum(carry.rounding, jnp.maximum(finite[0], finite[1] * duration) * here),
        rate_rounding=jnp.maximum(carry.rate_rounding, finite[1] * here),
    )


def _note_forces(carry: Carry, impulses) -> Carry:
    """The carry with the rounding of forces that brought about such `impulses` (k,) within a step.

    Forces between bodies at rest have no other scale: what is left of them at zero is rounding.
    """
    moves, k = carry.longest > 0, impulses.size
    least = jnp.where(moves, FORCELESS * impulses / jnp.where(moves, carry.longest, 1.0), 0.0)
    of_rates = jnp.where(moves, least / jnp.where(moves, carry.longest, 1.0), 0.0)
    return carry._replace(
        rounding=carry.rounding.at[1, :k].max(least), rate_rounding=carry.rate_rounding.at[1, :k].max(of_rates)
    )


def start_width(slopes, y0, acceleration, ts):
    """The depths at which gaps (k,) with these `slopes` (k, n) may begin: the rounding of what leads a motion there.

    A gap that is a coordinate is 1e-16 where it closes, and its rounding that of the height from which it fell.
    """
    (q, v), span, latest = halves(abs(y0)), ts[-1] - ts[0], jnp.maximum(abs(ts[0]), abs(ts[-1]))
    return GUARD_NOISE * (abs(slopes) @ (q.max() + v * latest + abs(acceleration) * span**2 / 8))


def opened(flat: Flat) -> Contacts:
    r, d = flat.rough.size, flat.shapes.directions
    return Contacts(jnp.zeros(flat.shapes.count), jnp.ones(r), jnp.ones((r, d)), jnp.zeros(()))


def _choose_kind(values, kinds):
    return jnp.where(kinds > 0, values[1], values[0])


def _pick(x, k):
    return jnp.where(np.arange(x.size) == k, x, False).any()


def _length(vectors):
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))


def _unit(vectors):
    length = _length(vectors)
    return vectors / jnp.where(length > 0, length, 1.0)[:, None]


@functools.lru_cache(maxsize=64)
def _watches(
    derivation, scene: ContactScene, turns: int, sections: tuple, ways: tuple, code: tuple, structure, single
) -> Surfaces:
    """The watches of all contacts as programs: the k normal ones, those of friction, r, of corners, and the sections.

    `code` and `structure` are what the parameters hold that is not a number.
    """
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), derivation.numbers)
    inside = eqx.combine(zeros, structure.unflatten(code))
    flat = Flat.from_system(scene.system, derivation.layout, inside.params)
    shapes, rough = flat.shapes, flat.rough
    places = None if scene.is_open else RowPlaces.from_derivation(derivation, flat)
    corners = corners_of(derivation, places.all, shapes) if turns and places is not None else None

    def values_at(y, inside: InContact, *forces):
        user, (closed, sticks, direction, near) = eqx.filter(inside.params, eqx.is_array_like), inside.contacts
        state = (*halves(y[:-1]), y[-1])
        open_values = jnp.concatenate([flat.gaps(state[0], state[2], user), flat.one_way(*state, user)])
        user_state = (*map(derivation.layout.restore, state[:2]),)
        more = [require_one_number(of(*user_state, t=y[-1], params=inside.params), "A section") for of in sections]
        if places is None:
            return jnp.concatenate([open_values, jnp.ones(rough.size + 2 * turns), jnp.array(more)])
        normal = forces[0][places.normal]
        if corners is not None:
            matters = [1.0 - jnp.prod(1.0 - closed[np.flatnonzero(row)]) for row in corners.touch]
            sides = forces[0][-turns:] * jnp.stack(matters)  # 0 where all that is closed is elsewhere
            more = [*(sides - near), *(sides + near), *more]
        watches = jnp.concatenate([normal + (1.0 - closed) * open_values, jnp.array(more)])
        if not rough.size:
            return watches
        held, most = forces[0][places.tangential], flat.friction(user) * normal[rough]
        if shapes.directions == 1:
            slides = jnp.sum(flat.slips(*state, user) * direction, axis=1)
        else:  # zero where it stops, and where it has turned by 60°: at 90° its direction has a pole
            unit, along, across = flat.turning_slips(*state, inside._replace(params=user))
            slides = jnp.sum(flat.slips(*state, user) * unit, axis=1) - across**2 / (3.0 * along)
        of_friction = sticks * (most**2 - jnp.sum(held**2, axis=1)) + (1.0 - sticks) * slides
        of_friction = closed[rough] * of_friction + (1.0 - closed[rough])
        return jnp.concatenate([watches[: shapes.count], of_friction, watches[shapes.count :]])

    directions = (-1,) * (shapes.count + rough.size + turns) + (1,) * turns + ways
    forces = None if scene.is_open else derivation.multipliers
    forces = forces if corners is None or forces is None else append_sides(forces, corners)
    surfaces = Surfaces.from_function(derivation, values_at, directions, code, structure, given=forces)
    surfaces = surfaces._replace(is_rounded=single)
    if scene.is_open:
        return surfaces

    @functools.cache
    def make_flow():
        problem, of_open = _open_watches(derivation, scene, turns, sections, ways, code, structure, single)
        return flow_of(dataclasses.replace(problem, guards=of_open.guards(remembers=True)))

    start = sum(x.size for x in jax.tree.leaves(zeros.params))
    return surfaces._replace(released=Released(tuple(range(start, start + shapes.count)), make_flow))


def _open_watches(derivation, scene: ContactScene, *given) -> tuple[Problem, Surfaces]:
    """The problem of a scene in which no contact is closed, and its watches."""
    *_, code, structure, _ = given
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), derivation.numbers)
    inside = eqx.combine(zeros, structure.unflatten(code))
    problem = Problem.from_system(dataclasses.replace(scene, is_open=True), derivation.layout, inside)
    return problem, _watches(problem.derivation.lowered, problem.system, *given)
