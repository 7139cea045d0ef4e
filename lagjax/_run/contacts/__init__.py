"""Motions with contacts: gaps and velocities that stay ≥ 0, impacts, rest and friction.

    System(contacts=…) ─► ContactPlan ─► _contact_motion ─► ContactEnding, RoundRecord ─► Trajectory
                                          ├─ _contact_search: the events, by loops over numbers, laid out by _places
                                          │    ├─ _contact_changes: what happens at one;  _contact_state: of a member
                                          │    ├─ _law: which contacts push, stick and slide in an impact
                                          │    └─ _scene_code: a scene as the search takes it, and its runs
                                          ├─ _replay: the same with derivatives;  _impact_derivatives: those of impulses
                                          └─ _corners: where gaps change their direction

A *watch* is a number that stays positive until the state of a contact changes; a *stretch* is the motion between two
changes; a *round* is one stretch with the change at its end. Source: Moreau, *Unilateral contact and dry friction*
(1988); Brogliato, *Nonsmooth Mechanics* (2016).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Batch, Problem
from lagjax._engine.taylor import MachineCode, line_of
from lagjax._equations import ROUNDINGS, derivation_of, has_constraints, require_consistent
from lagjax._interface import Layout, compile_for_one_call, halves, require_budget, result_from
from lagjax._run._trajectory import (
    EACH,
    ContactChanges,
    Impacts,
    Names,
    RunSettings,
    State,
    Trajectory,
    run_in_doubles,
    run_rows,
    run_single,
    step_counts,
)
from lagjax._run.contacts._contact_motion import (
    ContactEnding,
    ContactPlan,
    RoundRecord,
    RowPlaces,
    contact_motion,
    count_independent_rows,
    count_row_flags,
    integrate_concrete,
)
from lagjax._run.contacts._contact_search import find_start_width
from lagjax._run.jumps import tolerances_of
from lagjax._scene import (
    ContactParams,
    Contacts,
    ContactScene,
    ContactShapes,
    FlatContacts,
    System,
    require_coefficients,
)

CHANGES = 1024  # the budget of changes of a motion whose crossings are asked for; what they record takes memory


def simulate_contacts(given: Problem, problem: Problem, max_transitions: int | None) -> Trajectory:
    """The motion of a problem with contacts; `problem` is `given` with closed-over arrays as parameters."""
    plan, *scenes = _plan_contacts(problem, max_transitions)
    _require_valid_contacts(problem, *scenes)
    if has_constraints(problem.system):
        q0, qdot0 = map(problem.layout.restore, halves(jnp.asarray(problem.y0)))
        require_consistent(problem.system, problem.layout, problem.ts, q0, qdot0, problem.params)
    found = _put_on_device(_simulate_contacts(plan, problem)) if problem.is_known else _follow_compiled(plan, problem)
    return dataclasses.replace(found, ts=jnp.asarray(given.ts), system=given.system, params=given.params)


def _simulate_contacts(plan: ContactPlan, problem: Problem) -> Trajectory:
    return _trajectory(problem, problem, *_contact_outcome(plan, problem), None, plan.max_transitions)


_follow_compiled = compile_for_one_call(_simulate_contacts)  # outside of `jit` one program, and not one an operation


def _put_on_device(trajectory: Trajectory) -> Trajectory:
    """The trajectory with NumPy arrays converted to JAX arrays, in one transfer."""
    numbers, rest = eqx.partition(trajectory, lambda x: isinstance(x, np.ndarray | np.generic))
    return eqx.combine(jax.device_put(numbers), rest)


def simulate_contact_batch(given: Batch, batch: Batch, max_transitions: int | None, params, params_axes) -> Trajectory:
    """The motions of a batch whose system has contacts."""
    plan, *_ = _plan_contacts(batch.with_all_times, max_transitions)
    if batch.is_known:
        found = run_rows(functools.partial(integrate_concrete, plan), batch.member, batch.ts, batch.y0, batch.vectors)
    else:
        found = batch.map_members(lambda problem: run_in_doubles(functools.partial(contact_motion, plan), problem))
    ending, record, impacts = found
    trajectory = _trajectory(
        given.with_all_times, batch.with_all_times, ending, record, impacts, None, plan.max_transitions, params_axes
    )
    return dataclasses.replace(_put_on_device(trajectory), params=params)


def _contact_outcome(plan: ContactPlan, problem: Problem) -> tuple[ContactEnding, RoundRecord, tuple]:
    if not problem.is_known:
        return run_in_doubles(functools.partial(contact_motion, plan), problem)
    return run_single(functools.partial(integrate_concrete, plan), problem)


def find_section_changes(problem: Problem, functions: tuple, directions: tuple[int, ...], room: int) -> tuple:
    """The changes of a motion with contacts: the section of each, or −1; its time and state; result and end.

    Raises `ValueError` as `simulate_contacts` does.
    """
    plan, *scenes = _plan_contacts(problem, CHANGES + len(functions) * (room + 1))
    _require_valid_contacts(problem, *scenes)
    plan = dataclasses.replace(plan, sections=functions, directions=directions)
    ending, record, _ = jax.tree.map(jnp.asarray, _contact_outcome(plan, problem))
    count = ContactShapes.from_system(problem.system, problem.layout, problem.params).count
    which = jnp.maximum(record.contact - count, -1)
    return (which, record.t, record.y_next), ending.result, (ending.t, ending.y)


def _plan_contacts(problem: Problem, max_transitions: int | None) -> tuple[ContactPlan, Problem, Problem]:
    """The plan, and the problems of machine code with all contacts closed, and without contacts, in float64.

    Raises `ValueError` if the scene has no machine code, or the motion runs backward in time.
    """
    max_transitions = 256 if max_transitions is None else max_transitions
    require_budget(max_transitions, "max_transitions")
    tolerances, scene = tolerances_of(problem, "a scene with contacts", "an impact"), ContactScene(problem.system)
    wide = problem.double_precision if problem.is_single else problem
    with jax.enable_x64(True):
        shapes = ContactShapes.from_system(problem.system, wide.layout, wide.params)
        r, d = shapes.rough.size, shapes.directions
        if problem.system.impacts == "poisson" and r and (shapes.count, d) != (1, 1):
            raise ValueError(
                "With friction impacts='poisson' is for one contact in a plane: leave out slip, or take Newton's law, "
                "impacts='simultaneous'."
            )
        held = np.ones(count_row_flags(shapes, wide.layout.size))
        inside = ContactParams(
            wide.params, Contacts(np.ones(shapes.count), np.ones(r), np.ones((r, d)), held, np.ones(()))
        )
        closed, free = (
            Problem.from_system(of, wide.layout, inside) for of in (scene, ContactScene(problem.system, is_open=True))
        )
        flat, holds = FlatContacts.from_system(problem.system, wide.layout, wide.params), closed
        if held.size and (slots := count_independent_rows(closed.derivation.lowered, flat)):
            scene = dataclasses.replace(scene, slots=slots)
            holds = Problem.from_system(scene, wide.layout, inside)
        if refusal := MachineCode().refuses(free) or holds.derivation.lowered.accelerations.lacks:
            raise ValueError(f"A scene with contacts needs machine code, and has none: {refusal}.")
        plan, lowered = ContactPlan(scene, tolerances, max_transitions, problem.is_single), closed.derivation.lowered
        rows = RowPlaces.from_derivation(lowered, flat).normal[shapes.of_gaps :]
        stays = [not moves.any() for moves in ~lowered.absent("jacobian")[rows]]
        for name, still in zip(shapes.names[shapes.of_gaps :], stays, strict=True):
            if still:
                raise ValueError(f"{name} does not depend on qdot: one_way returns velocities, contacts returns gaps.")
    return plan, dataclasses.replace(closed, ts=wide.ts, y0=wide.y0), free


def _require_valid_contacts(problem: Problem, closed: Problem, free: Problem) -> None:
    """Raise `ValueError` for negative gaps at the start and invalid coefficients, if they are concrete."""
    if problem.is_known:
        with jax.enable_x64(True):
            _require_positive_gaps(problem, closed, free)
        require_coefficients(problem.system, problem.params)


def _require_positive_gaps(problem: Problem, closed: Problem, free: Problem) -> None:
    """Raise `ValueError` if the motion starts with a negative gap, beyond the rounding of its numbers."""
    derivation, n = closed.derivation.lowered, problem.layout.size
    shapes = ContactShapes.from_system(problem.system, problem.layout, problem.params)
    y0, numbers = np.asarray(closed.y0, float), np.asarray(closed.vector, float)
    columns = np.concatenate([y0, np.asarray(closed.ts, float)[:1], numbers])
    of = derivation.evaluate(["residual", "jacobian"], list(columns))
    rows = range(derivation.position_count - shapes.of_gaps, derivation.position_count)
    gaps, slopes = of["residual"][0, rows], of["jacobian"][0, rows]
    terms = derivation.term_sizes(y0[:n], y0[n:], columns[2 * n], closed.numbers, names=("residual",))
    noise = ROUNDINGS * np.finfo(problem.layout.dtype).eps * (np.asarray(terms)[rows] + np.abs(slopes) @ np.abs(y0[:n]))
    acceleration = free.derivation.lowered.accelerations.program.evaluate_many(list(columns))[:n, 0]
    ts = np.asarray(closed.ts, float)
    noise = noise + [find_start_width(n, y0, slope, acceleration, ts[0], ts[-1]) for slope in slopes]
    for name, gap, slope, near in zip(shapes.names, gaps, slopes, noise, strict=False):
        if gap < -near:
            raise ValueError(
                f"The motion starts inside: {name} = {gap:.6g}, and gaps stay >= 0. Start where it is not negative."
            )
        if not slope.any() and gap <= near:
            raise ValueError(
                f"The gap {name} is zero at the start, and so is its gradient there: it has no direction in which it "
                "pushes. Write it as a distance, q, not as its square."
            )


def _trajectory(
    given: Problem,
    problem: Problem,
    ending: ContactEnding,
    record: RoundRecord,
    impacts,
    params,
    budget: int,
    axes=EACH,
) -> Trajectory:
    restore = problem.layout.restore
    (q, qdot), end, (at, behind) = (tuple(map(restore, halves(y))) for y in (ending.path, ending.y, record.y_next))
    before = restore(record.qdot)
    known = record.contact, record.change, ending.rounds, ending.doubts, ending.doubted, record.impulse
    names = ContactShapes.from_system(problem.system, problem.layout, problem.params).names
    settings = RunSettings.from_problem(given, MachineCode(), max_transitions=budget)
    changes = ContactChanges(record.t, at, before, at, behind, *known, Names(names))
    return Trajectory(
        ts=jnp.asarray(given.ts), q=q, qdot=qdot, result=result_from(ending.result), end=State(ending.t, *end),
        stats=step_counts(*ending.steps), system=given.system, params=params, params_axes=axes,
        tolerances=MachineCode().tolerances(problem, problem.y0), settings=settings, impacts=Impacts(*impacts),
        contacts=ending.of_path, contact_changes=changes, contact_names=names,
    )  # fmt: skip


def contact_forces(trajectory: Trajectory, name: str):
    """The named quantity at every output: `multipliers`, `constraint_force`, or the normal `contact_forces`.

    NaN at times that the motion did not reach.
    """
    system = trajectory.system
    assert isinstance(system, System)
    if name != "contact_forces":
        system._require_constraints()

    def forces_of_member(q, qdot, times, params, _, contacts: Contacts):
        layout = Layout.from_state(*jax.tree.map(lambda x: x[0], (q, qdot)))
        flat = FlatContacts.from_system(system, layout, params)
        inside = ContactParams(params, jax.tree.map(lambda x: x[0], contacts))
        scene = ContactScene(system)
        if contacts.held.shape[-1]:
            whole = derivation_of(scene, layout, inside).lowered
            scene = dataclasses.replace(scene, slots=count_independent_rows(whole, flat))
        derivation = derivation_of(scene, layout, inside).with_numbers().lowered
        program = line_of(derivation.accelerations.multipliers)
        numbers = eqx.filter(params, eqx.is_array_like)
        given = [jnp.ravel(x) for x in jax.tree.leaves(numbers)]

        def evaluate_output(q, qdot, t, contacts):
            state, inside = (layout.flatten(q), layout.flatten(qdot), t), ContactParams(params, contacts)
            parts = [*state[:2], t[None], *given, *map(jnp.ravel, contacts)]
            forces = program(jnp.concatenate([jnp.asarray(x, layout.dtype) for x in parts]))
            own, normal, _ = scene.split_forces(flat, forces, derivation.position_count, inside)
            if name == "contact_forces":
                return jnp.where(contacts.closed > 0, normal, jnp.where(contacts.closed == 0, 0.0, jnp.nan))
            own = jnp.where((contacts.closed >= 0).all(), own, jnp.nan)
            if name == "multipliers":
                return system._split_by_constraint(own, layout, params)
            _, pull = system._motion(layout, params).constraints.products(*state, numbers)
            return layout.restore(pull(own))

        found = jax.vmap(evaluate_output)(q, qdot, times[0], contacts)
        return flat.shapes.name_numbers(found) if name == "contact_forces" else found

    return trajectory.map_members(forces_of_member, trajectory.contacts)
