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
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Problem
from lagjax._engine.taylor import Guarded, MachineCode, Surfaces, crossing_variation, line_of, vector_of
from lagjax._interface import RESULTS, SUCCESSFUL, Layout, code_of, halves
from lagjax._native import SINGLE_NOISE
from lagjax._primitives import attach_derivative, differentiable_where, lost_unless
from lagjax._run._trajectory import vary_with
from lagjax._run.contacts._impact_law import Pattern, Rows, change_velocities, find_pattern, responses, sliding_coupling
from lagjax._scene import Contacts, ContactScene, Flat, InContact

PyTree = Any

TOO_MANY, UNDECIDED, NOT_FINITE, INCONSISTENT = map(
    code_of,
    (RESULTS.max_transitions_reached, RESULTS.contact_undecided, RESULTS.nonfinite_state, RESULTS.inconsistent_start),
)
BLOCK = 8  # rounds that run before it is asked whether any motion goes on
# The time that bounces still take, in parts of a step of the motion between them, below which they end in closed form,
# and what that leaves out: twice as long, heights of 4e-9 of those of a step are left out.
SHORT, LEFT_OUT = 1e-4, 1e-14
# The slip in space that has no direction of its own, in parts of the largest one.
NO_SLIP = 1e-11
_LEAST = 1e-300  # a side that is exactly zero still has a sign


class ContactPlan(eqx.Module):
    """The constants of a run: the scene, its budgets, and whether the start came in float32."""

    scene: ContactScene
    rtol: float = eqx.field(static=True)
    atol: float | None = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    max_transitions: int = eqx.field(static=True)
    is_single: bool = eqx.field(static=True)


class Carry(NamedTuple):
    """A motion between rounds."""

    t: jax.Array
    y: jax.Array  # (2n,)
    contacts: Contacts
    fresh: jax.Array  # (G,), whether what a watch follows has begun at this instant
    going: jax.Array
    result: jax.Array
    steps: jax.Array  # accepted, rejected
    longest: jax.Array  # the longest step of the motion
    turns: jax.Array  # how many decisions there were at this instant
    rounding: jax.Array  # (2, G), the largest of a watch of an open or sliding contact, and of a closed or sticking one
    rate_rounding: jax.Array
    slip: jax.Array  # (r,), the largest so far
    path: jax.Array  # (T, 2n), NaN where not reached
    of_path: Contacts  # what the contacts did at the outputs


class ImpactRecord(NamedTuple):
    """One round's impact: its time, the normal impulses (k,), the energy that was lost; NaN without any."""

    t: jax.Array
    impulse: jax.Array
    energy_lost: jax.Array
    happened: jax.Array


@eqx.filter_jit
def contact_motion(plan: ContactPlan, layout: Layout, ts, y0, params: PyTree) -> tuple[Carry, ImpactRecord]:
    """The motion from y0 (2n,) at ts[0], and its impacts, of which there may be `max_transitions`."""
    ts, y0 = jnp.asarray(ts), jnp.asarray(y0)
    rounds = ContactRounds.from_plan(plan, layout, ts, y0, params)
    first = vary_with(rounds.begin(y0), ts, y0, rounds.vector, varying=("t", "y", "path"))
    blocks = -(-plan.max_transitions // BLOCK)

    def run_block(carry, counts):
        return jax.lax.scan(rounds.run_round, carry, counts)

    def idle(carry, counts):
        empty = jax.eval_shape(rounds.run_round, carry, counts[0])[1]
        return carry, jax.tree.map(lambda x: _absent((BLOCK, *x.shape), x.dtype), empty)

    def step(carry, counts):
        return jax.lax.cond(any_member(carry.going), run_block, idle, carry, counts)

    counts = jnp.arange(blocks * BLOCK).reshape(blocks, BLOCK)
    ending, record = jax.lax.scan(step, first, counts)
    record = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: plan.max_transitions], record)
    order = jnp.argsort(~record.happened, stable=True)
    record = jax.tree.map(lambda x: x[order], record)
    inputs = ts, y0, rounds.vector
    t, impulse, lost = (
        lost_unless(record.happened[:, *[None] * (x.ndim - 1)], x, inputs) for x in record[:3]
    )
    path = lost_unless((ending.of_path.closed >= 0).all(axis=1)[:, None], ending.path, inputs)
    return ending._replace(path=path), ImpactRecord(t, impulse, lost, record.happened)


def _absent(shape, dtype):
    return jnp.zeros(shape, bool) if dtype == bool else jnp.full(shape, jnp.nan, dtype)


@jax.custom_batching.custom_vmap
def any_member(going):
    """Whether a motion, or any of those that `jax.vmap` runs beside it, goes on."""
    return going


@any_member.def_vmap
def _(size, batched, going):
    return any_member(going.any(0) if batched[0] else going), False


class ContactRounds(NamedTuple):
    plan: ContactPlan
    problem: Problem  # without a state and times; its params are those of the user
    flat: Flat
    surfaces: Surfaces
    rows: "RowPlaces"
    quantities: Any  # the line of M, G, γ and the rates
    acceleration: Any
    multipliers: Any
    params: PyTree
    vector: jax.Array
    widths: tuple
    ts: jax.Array

    @classmethod
    def from_plan(cls, plan: ContactPlan, layout: Layout, ts, y0, params) -> "ContactRounds":
        flat = Flat.from_system(plan.scene.system, layout, params)
        limits = {"rtol": plan.rtol, "atol": plan.atol, "max_steps": plan.max_steps}
        inside = InContact(params, _resting(flat, 0.0))
        problem = Problem.from_system(plan.scene, layout, inside, **limits)
        problem = dataclasses.replace(problem, is_rounded=plan.is_single)
        derivation = problem.derivation.lowered
        code, structure = jax.tree.flatten(eqx.filter(inside, eqx.is_array_like, inverse=True))
        surfaces = _watches(derivation, plan.scene, tuple(code), structure)._replace(is_rounded=plan.is_single)
        lines = [
            line_of(derivation.program("mass_matrix", "jacobian", "gamma", "rates")),
            line_of(derivation.acceleration.complete, layout.size),
            line_of(derivation.multipliers),
        ]
        numbers = vector_of(eqx.filter(params, eqx.is_array_like))
        given = jnp.append(y0, ts[0]), numbers
        widths = tuple(SINGLE_NOISE * jnp.abs(jax.lax.stop_gradient(x)) for x in given)
        places = RowPlaces.from_derivation(derivation, flat)
        return cls(plan, problem, flat, surfaces, places, *lines, params, numbers, widths, ts)

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    @property
    def count(self) -> int:
        return self.flat.shapes.count

    def numbers_in(self, contacts: Contacts):
        return jnp.concatenate([self.vector, *map(jnp.ravel, contacts)])

    def problem_in(self, contacts: Contacts, ts, y0) -> Problem:
        return dataclasses.replace(self.problem, params=InContact(self.params, contacts), ts=ts, y0=y0)

    # ---- a round ----

    def begin(self, y0) -> Carry:
        """The start: contacts that touch and do not move are closed, those that move inwards fall at once."""
        t, guards = self.ts[0], self.count + self.flat.rough.size
        opened = _resting(self.flat, 0.0)
        guarded = self.watch(t, y0, opened)
        touches, rates, noise = self.touching(guarded, t, y0, opened)
        inside = (guarded.values[: self.count] < -guarded.rounding[: self.count]) & self.has_gap
        closed = touches & (jnp.abs(rates) <= noise)
        slip, still = self.slip_at(t, y0, jnp.zeros(self.flat.rough.size))
        contacts = self.along_slips(closed, slip, still, jnp.max(jnp.abs(slip), axis=1, initial=0.0))
        none = jax.tree.map(lambda x: jnp.full((self.ts.size, *x.shape), -1.0), contacts)
        inconsistent, zero = inside.any(), jnp.zeros((2, guards))
        return Carry(
            t, self.hold(t, y0, contacts), contacts, jnp.ones(guards, bool), ~inconsistent,
            jnp.where(inconsistent, INCONSISTENT, SUCCESSFUL), jnp.zeros(2, int), jnp.zeros(()), jnp.zeros((), int),
            zero, zero, jnp.max(jnp.abs(slip), axis=1, initial=0.0),
            jnp.full((self.ts.size, y0.size), jnp.nan), none,
        )  # fmt: skip

    def run_round(self, before: Carry, count) -> tuple[Carry, ImpactRecord]:
        """One round: to the next watch that falls, through what happens there; of a motion that is going."""
        here, contacts, t_start = before.going, before.contacts, jax.lax.stop_gradient(before.t)
        guarded, kinds = self.watch(before.t, before.y, contacts), self.kinds(contacts)
        before = self.note_rounding(before, guarded, kinds)
        rounding = jnp.maximum(_of_kind(before.rounding, kinds), guarded.of_time)
        beyond = guarded.values < -rounding
        sides = jnp.where(beyond, jnp.inf, jnp.maximum(rounding, _LEAST))
        horizon = jnp.where(here, self.ts[-1], t_start)
        located = self.locate(contacts, t_start, horizon, before.y, sides, _of_kind(before.rate_rounding, kinds))
        fell = (jnp.where(here, located.event, 0) >> (2 * np.arange(kinds.size))) & 3 > 0
        t_end = jnp.where(here & (located.result == SUCCESSFUL), self.ts[-1], located.t_end)

        # The same stretch once more, with derivatives and outputs; where it ends is known better already.
        covered = here & ((self.ts > t_start) | (self.ts == jnp.where(t_start == self.ts[0], t_start, jnp.nan)))
        covered = covered & (self.ts <= t_end)
        inside = jnp.where(covered, self.ts, jax.lax.stop_gradient(jnp.clip(self.ts, t_start, t_end)))
        times = jnp.concatenate([before.t[None], inside, t_end[None]])
        moved = MachineCode().solve(self.problem_in(contacts, times, before.y))
        y_end = located.y_end + jnp.where(here, moved.y_end - jax.lax.stop_gradient(moved.y_end), 0.0)

        happens, k = fell.any(), jnp.argmax(fell)
        at_once = t_end == t_start
        crosses = happens & ~(at_once & (before.fresh | beyond)[k])
        numbers = self.numbers_in(contacts)
        t, y = self.cross(k, crosses, t_end, y_end, numbers)
        t, y = (jnp.where(crosses, new, old) for new, old in zip((t, y), (t_end, y_end), strict=True))
        turns = jnp.where(at_once, before.turns + 1, 0)
        step = jnp.where(at_once, 0.0, (t_end - t_start) / jnp.maximum(located.accepted, 1))
        before = before._replace(longest=jnp.maximum(before.longest, step))
        before = self.note_rounding(before, self.watch(t, y, contacts), kinds, t_end - t_start)
        before = before._replace(fresh=before.fresh & at_once)
        decided, record = self.decide(before, t, y, k, happens, fell)

        sound = jnp.isfinite(jnp.where(happens, decided.y, y_end)).all()
        result = jnp.where(here & ~happens, located.result, before.result)
        result = jnp.where(here & happens, decided.result, result)
        result = jnp.where(here & happens & (turns > 16 + 8 * kinds.size), UNDECIDED, result)
        result = jnp.where(here & ~sound & (result == SUCCESSFUL), NOT_FINITE, result)
        spent = here & happens & (result == SUCCESSFUL) & (count + 1 >= self.plan.max_transitions)
        result = jnp.where(spent, TOO_MANY, result)
        path = jnp.where(covered[:, None], moved.path[1:-1], before.path)
        of_path = jax.tree.map(
            lambda old, new: jnp.where(covered[:, *[None] * new.ndim], new, old), before.of_path, contacts
        )
        after = decided._replace(
            t=jnp.where(happens, t, t_end), y=jnp.where(happens, decided.y, y_end), going=here & happens & (result == SUCCESSFUL),
            result=result, steps=before.steps + jnp.stack([located.accepted, located.rejected]), turns=turns, path=path,
            of_path=of_path,
        )  # fmt: skip
        after = jax.tree.map(lambda new, old: jnp.where(here, new, old), after, before)
        happened = record.happened & here
        t, impulse, lost = (jnp.where(happened, x, jnp.nan) for x in record[:3])
        return after, ImpactRecord(t, impulse, lost, happened)

    def locate(self, contacts, t_start, horizon, y, sides, rate_rounding):
        problem = self.problem_in(contacts, jnp.stack([t_start, horizon]), y)
        problem = dataclasses.replace(problem, guards=self.surfaces.guards(remembers=True))
        return MachineCode().solve_to_event(problem, jnp.concatenate([sides, rate_rounding]))

    def cross(self, k, taken, t, y, numbers):
        return attach_derivative(crossing_variation(self.surfaces), (t, y), k, taken, t, y, numbers)

    # ---- what is known at a state, without derivatives ----

    def watch(self, t, y, contacts: Contacts) -> Guarded:
        of_state, of_params = self.widths
        numbers = self.numbers_in(contacts)
        exact = jnp.pad(of_params, (0, numbers.size - of_params.size))
        return self.surfaces.evaluate_guards(t, y, numbers, self.ts[-1], (of_state, exact))

    def kinds(self, contacts: Contacts):
        """1 for a watch of a contact that is closed, or sticks, else 0, (G,)."""
        return jnp.concatenate([contacts.closed, contacts.sticks])

    @property
    def has_gap(self) -> np.ndarray:
        return np.arange(self.count) < self.flat.of_gaps

    def note_rounding(self, carry: Carry, guarded: Guarded, kinds, duration=0.0) -> Carry:
        """The carry with the largest rounding of its watches: of one that went away and came back that between them."""
        finite = [jnp.where(jnp.isfinite(x), x, 0.0) for x in (guarded.rounding, guarded.rate_rounding)]
        here = jnp.stack([1.0 - kinds, kinds])
        rounding = jnp.maximum(finite[0], finite[1] * duration) * here
        return carry._replace(
            rounding=jnp.maximum(carry.rounding, rounding),
            rate_rounding=jnp.maximum(carry.rate_rounding, finite[1] * here),
        )

    def touching(self, guarded: Guarded, t, y, contacts: Contacts) -> tuple:
        """Which contacts touch (k,), how fast they move apart, and the rounding of that; watched while `contacts` are open."""
        k = self.count
        values, noise = guarded.values[:k], guarded.rounding[:k] + guarded.of_time[:k]
        rates = jnp.where(self.has_gap, guarded.rates[:k], values)
        of_rates = jnp.where(self.has_gap, guarded.rate_rounding[:k], noise)
        return jnp.where(self.has_gap, jnp.abs(values) <= noise, values <= noise), rates, of_rates

    def slip_at(self, t, y, largest) -> tuple:
        """The slips (r, d), and whether each is rounding, beside the `largest` so far."""
        rows = self.rows_at(t, y)
        slips = jax.lax.stop_gradient(rows.rates[rows.tangential])
        terms = jnp.abs(rows.jacobian[rows.tangential]) @ jnp.abs(halves(y)[1])
        noise = jax.lax.stop_gradient(jnp.maximum(1e-12 * jnp.max(terms, axis=1, initial=0.0), 1e-13 * largest))
        return slips, jnp.sqrt(jnp.sum(slips**2, axis=1)) <= noise

    def along_slips(self, closed, slips, still, largest) -> Contacts:
        """Contacts of which these are `closed`: they stick where they are `still`, and else slide along their slips."""
        size = jnp.sqrt(jnp.sum(slips**2, axis=1, keepdims=True))
        direction = slips / jnp.where(size > 0, size, 1.0)
        return Contacts(closed.astype(float), still.astype(float), self.scale_direction(direction, largest))

    def scale_direction(self, direction, largest):
        if self.flat.shapes.directions == 1:
            return jnp.where(direction < 0, -1.0, 1.0)
        return direction * NO_SLIP * jnp.where(largest > 0, largest, 1.0)[:, None]

    def rows_at(self, t, y) -> Rows:
        """The rows of all constraints and contacts at a state."""
        n, m = self.layout.size, self.rows.count
        closed = self.numbers_in(_resting(self.flat, 1.0))
        values = self.quantities(jnp.concatenate([y, t[None], closed]))
        mass, jacobian, _, rates = jnp.split(values, np.cumsum([n * n, m * n, m]))
        return Rows(mass.reshape(n, n), jacobian.reshape(m, n), rates, *self.rows[1:], self.flat.rough)

    # ---- what happens at a watch that fell ----

    def decide(self, before: Carry, t, y, k, happens, fell) -> tuple[Carry, ImpactRecord]:
        """The state and the contacts behind watch k, which fell."""
        count, rough, contacts = self.count, self.flat.rough, before.contacts
        fell_first = np.arange(count + rough.size) == k
        was_closed, was_stuck = contacts.closed > 0, contacts.sticks > 0
        meets, opens = fell_first[:count] & ~was_closed, fell_first[:count] & was_closed
        stops, breaks = fell_first[count:] & ~was_stuck, fell_first[count:] & was_stuck
        impact = self.meet(before, t, y, meets, fell)
        closed = jnp.where(impact.happened, impact.closed, (was_closed | meets) & ~opens)
        y_after = jnp.where(impact.happened, impact.y, y)
        slips, still = self.slip_at(t, y_after, before.slip)
        largest = jnp.maximum(before.slip, jnp.sqrt(jnp.sum(slips**2, axis=1)))
        new = self.along_slips(closed, slips, still, largest)
        renew = impact.happened | (closed != was_closed)[rough]
        force = self.friction_force(t, y, contacts)
        against = -force / jnp.where(jnp.any(force != 0, axis=1, keepdims=True), jnp.linalg.norm(force, axis=1, keepdims=True), 1.0)
        broken = self.scale_direction(against, largest)
        sticks = jnp.where(renew, new.sticks > 0, (was_stuck | stops) & ~breaks)
        turned = jnp.where(breaks[:, None], broken, jnp.where(renew[:, None] | (np.array(self.flat.shapes.directions > 1) & ~still[:, None]), new.direction, contacts.direction))
        after = Contacts(closed.astype(float), sticks.astype(float), turned)
        changed = jnp.concatenate([(closed != was_closed) | impact.happened, (sticks != was_stuck) | renew | breaks])
        held = self.hold(t, y_after, after)
        friction = jax.lax.stop_gradient(self.flat.friction(eqx.filter(self.params, eqx.is_array_like)))
        coupling = sliding_coupling(self.rows_at(t, held).still, after._replace(direction=_unit(turned)), friction)
        undecided = (happens & ~impact.sound) | (coupling <= 1e-12).any()
        decided = before._replace(
            y=held, contacts=after, fresh=before.fresh | changed, slip=largest,
            result=jnp.where(undecided, UNDECIDED, before.result),
        )  # fmt: skip
        record = ImpactRecord(impact.t, impact.impulse, impact.energy_lost, impact.happened & happens)
        return decided, record

    def meet(self, before: Carry, t, y, meets, fell) -> "Impact":
        """The impact of contacts that meet, (k,), with all that touch."""
        still, count = jax.lax.stop_gradient, self.count
        opened = _resting(self.flat, 0.0)
        guarded = self.watch(t, y, opened)
        touches, rates, noise = self.touching(guarded, t, y, opened)
        was_closed = before.contacts.closed > 0
        touches = touches | meets | was_closed | ~self.has_gap
        noise = jnp.maximum(noise, 0.01 * before.rate_rounding[0, :count])
        rows = self.rows_at(t, y)
        numbers = eqx.filter(self.params, eqx.is_array_like)
        restitution, friction = self.flat.restitution(numbers), self.flat.friction(numbers)
        hits = (meets & (rates < -noise)).any()
        quiet = rows.still
        if self.plan.scene.system.impacts == "sequential":
            involved = meets
        else:
            involved = touches & _reached(quiet, meets, touches)
        pattern, sound = find_pattern(quiet, involved, still(restitution), still(friction))
        pattern = jax.tree.map(still, pattern)

        def blow(restitution):
            held, targets = self.held_in(pattern, rows, restitution)
            return change_velocities(rows, held, targets, pattern, friction)

        bounced = jnp.where(pattern.push > 0, -restitution * rows.rates[rows.normal], 0.0)
        change, _ = blow(restitution)
        bouncing = y + jnp.pad(change, (change.size, 0))
        ends, left = self.end_of_bounces(before, t, bouncing, bounced, restitution)
        ends = ends & hits & (pattern.push > 0)
        change, impulses = blow(jnp.where(ends, 0.0, restitution))
        change = jnp.where(hits, change, 0.0)
        q, v = halves(y)
        after = jnp.concatenate([q, v + change])
        lost = -0.5 * (2 * v + change) @ (rows.mass @ change)
        separating = still(rows.rates + rows.jacobian @ change)[rows.normal]
        quick = jnp.maximum(noise, 1e-12 * jnp.max(jnp.abs(rates), initial=0.0))
        closed = touches & (jnp.abs(separating) <= quick) & (self.has_gap | (separating <= quick))
        time = t + jnp.sum(jnp.where(ends, left, 0.0))
        tied = self.tied(rows, meets, involved, rates < -noise, before)
        after = differentiable_where(~(tied & hits), after)
        return Impact(hits, sound | ~hits, after, closed, time, impulses[rows.normal], lost)

    def tied(self, rows: Rows, meets, involved, inwards, before: Carry):
        """True if other contacts close at this instant, by themselves, that share the impact."""
        was_closed = before.contacts.closed > 0
        others = involved & ~meets & ~was_closed & inwards & self.has_gap & ~before.fresh[: self.count]
        return jax.lax.stop_gradient(others.any())

    def held_in(self, pattern: Pattern, rows: Rows, restitution) -> tuple:
        """The rows that are held in an impact (m,), and the rates they get."""
        held = jnp.ones(self.rows.count).at[rows.normal].set(pattern.push)
        targets = jnp.zeros(self.rows.count).at[rows.normal].set(-restitution * rows.rates[rows.normal])
        if rows.rough.size:
            sticks = jnp.repeat(pattern.push[rows.rough] * pattern.sticks, rows.tangential.shape[1])
            held = held.at[rows.tangential.ravel()].set(sticks)
        return held, targets

    def hold(self, t, y, contacts: Contacts):
        """The state with velocities that closed contacts and sticking ones allow, in the metric of M."""
        rows, (q, v) = self.rows_at(t, y), halves(y)
        still = Pattern(contacts.closed, contacts.sticks, jnp.zeros_like(contacts.direction))
        held, targets = self.held_in(still, rows, jnp.zeros(self.count))
        change, _ = change_velocities(rows, held, targets, still, jnp.zeros(self.flat.rough.size))
        return jnp.concatenate([q, v + change])

    def friction_force(self, t, y, contacts: Contacts):
        """The forces (r, d) that hold what sticks."""
        numbers = jax.lax.stop_gradient(jnp.concatenate([y, t[None], self.numbers_in(contacts)]))
        return self.multipliers(numbers)[self.rows.tangential]

    def end_of_bounces(self, before: Carry, t, y, bounced, restitution) -> tuple:
        """Which contacts that bounce with these velocities (k,) come to rest at once, and after which time.

        With gap″ = −b − b′ s the bounces take 2u/(b (1 − e)) (1 − ⅔ k), k = b′ u / b² (1 − e), up to k².
        """
        opened = _resting(self.flat, 0.0)

        def falls(t, y):
            numbers = self.numbers_in(opened)
            acceleration = self.acceleration(jnp.concatenate([y, t[None], numbers]))
            closed = self.numbers_in(_resting(self.flat, 1.0))
            values = self.quantities(jnp.concatenate([y, t[None], closed]))
            n, m = self.layout.size, self.rows.count
            _, jacobian, gamma, _ = jnp.split(values, np.cumsum([n * n, m * n, m]))
            bend = jacobian.reshape(m, n) @ acceleration - gamma
            return -bend[self.rows.normal], jnp.concatenate([halves(y)[1], acceleration])

        slope = falls(t, y)[1]
        b, later = jax.jvp(lambda t, y: falls(t, y)[0], (t, y), (jnp.ones_like(t), slope))
        falling = b > 0
        safe, rest = jnp.where(falling, b, 1.0), jnp.where(restitution < 1, 1 - restitution, 1.0)
        uneven = later * bounced / (safe**2 * rest)
        left = 2 * bounced / (safe * rest) * (1 - 2 / 3 * uneven)
        ends = falling & (restitution < 1) & (left >= 0) & (left <= SHORT * before.longest)
        ends = ends & (uneven**2 * left <= LEFT_OUT * (1 + jnp.abs(t))) & self.has_gap
        return jax.lax.stop_gradient(ends), left


class Impact(NamedTuple):
    """What an impact leads to, if it `happened`: a state, which contacts are closed behind it, and its record.

    `t` is the time at which bounces that it begins have ended, where they end there.
    """

    happened: Any
    sound: Any
    y: Any
    closed: Any
    t: Any
    impulse: Any
    energy_lost: Any


class RowPlaces(NamedTuple):
    """Where the rows of contacts stand among all: their count, those of the normals (k,) and of the slips (r, d)."""

    count: int
    normal: np.ndarray
    tangential: np.ndarray

    @classmethod
    def from_derivation(cls, derivation, flat: Flat) -> "RowPlaces":
        total, (r, d) = derivation.shape("jacobian")[0], (flat.rough.size, flat.shapes.directions)
        gaps_end, slips = derivation.position_count, total - r * d
        one_way = flat.shapes.count - flat.of_gaps
        normal = [*range(gaps_end - flat.of_gaps, gaps_end), *range(slips - one_way, slips)]
        return cls(total, np.array(normal, int), slips + np.arange(r * d).reshape(r, d))


def _resting(flat: Flat, closed: float) -> Contacts:
    """Contacts that are all open (0), or closed and at rest (1)."""
    r, d = flat.rough.size, flat.shapes.directions
    return Contacts(jnp.full(flat.shapes.count, closed), jnp.ones(r), jnp.ones((r, d)))


def _of_kind(values, kinds):
    return jnp.where(kinds > 0, values[1], values[0])


def _unit(direction):
    length = jnp.sqrt(jnp.sum(direction**2, axis=1, keepdims=True))
    return direction / jnp.where(length > 0, length, 1.0)


def _reached(rows: Rows, meets, touches):
    """The contacts that touch (k,) and that an impulse at those that meet reaches, one through the other."""
    schur = rows.jacobian @ responses(rows)
    of_contacts, k, r = rows.contact_rows, len(rows.normal), len(rows.rough)
    linked = jnp.abs(schur) > 1e-14 * jnp.sqrt(jnp.abs(jnp.outer(jnp.diagonal(schur), jnp.diagonal(schur))))
    contact = np.zeros((len(rows.rates), k))
    contact[rows.normal, np.arange(k)] = 1
    for j in range(r):
        contact[rows.tangential[j], rows.rough[j]] = 1
    own = np.setdiff1d(np.arange(len(rows.rates)), of_contacts)
    reach = linked.astype(float)
    if own.size:  # a constraint hands an impulse on
        for _ in range(max(1, int(np.ceil(np.log2(own.size + 1))))):
            reach = jnp.minimum(reach + reach[:, own] @ reach[own], 1.0)
    pairs = ((contact.T @ reach @ contact) > 0) & touches[:, None] & touches
    found = meets
    for _ in range(k):
        found = found | (pairs & found).any(axis=1)
    return found


@functools.lru_cache(maxsize=64)
def _watches(derivation, scene: ContactScene, code: tuple, structure) -> Surfaces:
    """The watches of all contacts as programs: the k normal ones, and then those of friction, r.

    `code` and `structure` are what the parameters hold that is not a number.
    """
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), derivation.numbers)
    params = eqx.combine(zeros, structure.unflatten(code)).params
    flat = Flat.from_system(scene.system, derivation.layout, params)
    shapes, places = flat.shapes, RowPlaces.from_derivation(derivation, flat)
    multipliers, rough = derivation.multipliers, flat.rough

    def values_at(y, inside: InContact):
        numbers = eqx.filter(inside, eqx.is_array_like)
        user, (closed, sticks, direction) = numbers.params, inside.contacts
        state = (*halves(y[:-1]), y[-1])
        forces = jnp.stack(multipliers.compute_outputs(y, vector_of(numbers)))
        open_values = jnp.concatenate([flat.gaps(state[0], state[2], user), flat.one_way(*state, user)])
        normal = forces[places.normal]
        watches = normal + (1.0 - closed) * open_values
        if not rough.size:
            return watches
        held, slips = forces[places.tangential], flat.slips(*state, user)
        along = direction if shapes.directions == 1 else _unit(direction)
        most = flat.friction(user) * normal[rough]
        of_friction = sticks * (most**2 - jnp.sum(held**2, axis=1)) + (1.0 - sticks) * jnp.sum(slips * along, axis=1)
        of_friction = closed[rough] * of_friction + (1.0 - closed[rough])
        return jnp.concatenate([watches, of_friction])

    directions = (-1,) * (shapes.count + rough.size)
    return Surfaces.from_function(derivation, values_at, directions, code, structure)
