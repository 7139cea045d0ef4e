"""Motions with contacts: gaps and velocities that stay ≥ 0, impacts, rest and friction.

    System(contacts=…) ─► ContactPlan ─► _contact_rounds: round after round ─► Carry, RoundRecord ─► Trajectory
                                          └─ _impact_law: what impulses do to velocities at an instant

Source: Moreau, *Unilateral contact and dry friction* (1988); Brogliato, *Nonsmooth Mechanics* (2016).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Batch, Problem
from lagjax._engine.taylor import MachineCode, line_of
from lagjax._equations import derivation_of, require_consistent
from lagjax._interface import Layout, as_arrays, halves, is_concrete, join_names, require_budget, result_from
from lagjax._primitives import DOUBLE, compute_in_doubles
from lagjax._program import Unlowerable
from lagjax._run._trajectory import ContactChanges, Impacts, State, Trajectory, step_counts
from lagjax._run.contacts._contact_rounds import Carry, ContactPlan, RoundRecord, RowPlaces, contact_motion
from lagjax._scene import ContactScene, Contacts, Flat, InContact, System


def follow_contacts(given: Problem, problem: Problem, max_transitions: int) -> Trajectory:
    """The motion of a problem whose system has contacts; `problem` is `given` with the tracers it closes over lifted."""
    plan = _plan(problem, max_transitions)
    _require_open(problem)
    q0, qdot0 = map(problem.layout.restore, halves(jnp.asarray(problem.y0)))
    q0, qdot0 = as_arrays((q0, qdot0), problem.layout.dtype, "state")
    require_consistent(problem.system, problem.layout, problem.ts, q0, qdot0, problem.params)
    return _trajectory(given, problem, *_motion(plan, problem), given.params)


def follow_contacts_batch(given: Batch, batch: Batch, max_transitions: int, params, params_axes) -> Trajectory:
    """The motions of a batch whose system has contacts."""
    plan = _plan(batch.member, max_transitions)
    ending, record = batch.map_members(lambda problem: _motion(plan, problem))
    return _trajectory(given.member, batch.member, ending, record, params, params_axes)


def _plan(problem: Problem, max_transitions: int) -> ContactPlan:
    """Raises `ValueError` where the scene has no machine code, or the motion goes back in time."""
    require_budget(max_transitions, "max_transitions")
    if not all(map(is_concrete, problem.tolerances)):
        raise ValueError("rtol and atol of a scene with contacts must be numbers: they decide the order of the method.")
    if is_concrete(problem.ts) and np.asarray(problem.ts)[-1] < np.asarray(problem.ts)[0]:
        raise ValueError("A scene with contacts goes forward in time: an impact cannot be undone; ts must increase.")
    rtol, atol = float(MachineCode().rtol(problem.double_precision)), problem.tolerances[1]
    limits = rtol, None if atol is None else float(atol), problem.max_steps, max_transitions, problem.is_single
    plan = ContactPlan(ContactScene(problem.system, problem.system.path), *limits)
    wide = problem.double_precision if problem.is_single else problem
    with jax.enable_x64(True):
        flat = Flat.from_system(problem.system, wide.layout, wide.params)
        r, d = flat.rough.size, flat.shapes.directions
        contacts = Contacts(np.zeros(flat.shapes.count), np.zeros(r), np.zeros((r, d)))
        inside = Problem.from_system(plan.scene, wide.layout, InContact(wide.params, contacts))
        try:
            if refusal := MachineCode().refuses(inside):
                raise Unlowerable(refusal)
        except Unlowerable as why:
            raise ValueError(f"A scene with contacts needs machine code, and has none: {why}.") from None
    return plan


def _require_open(problem: Problem) -> None:
    """Raise `ValueError` where the motion starts with a negative gap, beyond the rounding of its numbers."""
    numbers = eqx.filter(problem.params, eqx.is_array_like)
    if not all(is_concrete(x) for x in jax.tree.leaves((problem.y0, problem.ts, numbers))):
        return
    flat = Flat.from_system(problem.system, problem.layout, problem.params)
    q, t = jnp.asarray(halves(problem.y0)[0]), jnp.asarray(problem.ts)[0]
    gaps = np.asarray(flat.gaps(q, t, numbers))
    slopes, by_t = jax.jacfwd(lambda q, t: flat.gaps(q, t, numbers), (0, 1))(q, t)
    noise = 40 * np.finfo(problem.layout.dtype).eps * (np.abs(slopes) @ np.abs(q) + np.abs(by_t * t) + np.abs(gaps))
    still = (np.abs(slopes).max(axis=1, initial=0.0) == 0) & (np.abs(gaps) <= noise)
    if still.any():
        name = flat.shapes.names[int(np.flatnonzero(still)[0])]
        raise ValueError(
            f"The gap {name} is zero at the start, and so is its gradient there: it has no direction in which it pushes. "
            "Write it as a distance, q, not as its square."
        )
    if (inside := np.flatnonzero(gaps < -np.maximum(noise, 1e-9 * np.abs(slopes) @ np.abs(q)))).size:
        named = [f"{flat.shapes.names[i]} = {gaps[i]:.6g}" for i in inside]
        raise ValueError(
            f"The motion starts inside: {join_names(named, 6)}, and gaps stay >= 0. Start where they are not negative."
        )


def _motion(plan: ContactPlan, problem: Problem) -> tuple[Carry, RoundRecord]:
    """The rounds of a problem, in float64, in its own precision."""
    given = problem.ts, problem.y0, problem.params
    if not problem.is_single:
        return contact_motion(plan, problem.layout, *given)
    layout = dataclasses.replace(problem.layout, dtype=DOUBLE)
    return compute_in_doubles(lambda *given: contact_motion(plan, layout, *given), *given)


def _trajectory(given: Problem, problem: Problem, ending: Carry, record: RoundRecord, params, axes=None) -> Trajectory:
    flat = Flat.from_system(problem.system, problem.layout, problem.params)
    (q, qdot), end = (map(problem.layout.restore, halves(y)) for y in (ending.path, ending.y))
    order = jnp.argsort(~record.hits, axis=-1, stable=True)  # impacts in front
    t, impulse, lost = (
        jnp.take_along_axis(x, order.reshape(*order.shape, *[1] * (x.ndim - order.ndim)), order.ndim - 1)
        for x in record[-3:]
    )
    impacts = Impacts(t, flat.shapes.by_name(impulse), lost, jnp.sum(record.hits, axis=-1))
    (q_before, qdot_before), (q_next, qdot_next) = (
        map(problem.layout.restore, halves(y)) for y in (record.y, record.y_next)
    )
    count = jnp.sum(record.happened, axis=-1)
    changes = ContactChanges(
        record.t, q_before, qdot_before, q_next, qdot_next, record.contact, record.change, count
    )  # fmt: skip
    accepted, rejected = ending.steps[..., 0], ending.steps[..., 1]
    return Trajectory(
        ts=jnp.asarray(given.ts), q=q, qdot=qdot, result=result_from(ending.result), end=State(ending.t, *end),
        stats=step_counts(accepted, rejected), system=given.system, params=params, params_axes=axes,
        tolerances=MachineCode().tolerances(problem, problem.y0), engine="MachineCode", impacts=impacts,
        contacts=ending.of_path, contact_changes=changes, contact_names=flat.shapes.names,
    )  # fmt: skip


def contact_forces(trajectory: Trajectory):
    """The normal forces at every output, by the names of the contacts; NaN where the motion did not come to."""
    system = trajectory.system
    assert isinstance(system, System)

    def of_member(q, qdot, times, params, _, contacts: Contacts):
        scene = ContactScene(system, system.path)
        layout = Layout.from_state(*jax.tree.map(lambda x: x[0], (q, qdot)))
        flat = Flat.from_system(system, layout, params)
        inside = InContact(params, jax.tree.map(lambda x: x[0], contacts))
        derivation = derivation_of(scene, layout, inside).lowered
        program, places = line_of(derivation.multipliers), RowPlaces.from_derivation(derivation, flat)
        numbers = [jnp.ravel(x) for x in jax.tree.leaves(eqx.filter(params, eqx.is_array_like))]

        def at_output(q, qdot, t, contacts):
            parts = layout.flatten(q), layout.flatten(qdot), t[None], *numbers, *map(jnp.ravel, contacts)
            forces = program(jnp.concatenate([jnp.asarray(x, layout.dtype) for x in parts]))[places.normal]
            return jnp.where(contacts.closed >= 0, forces, jnp.nan)

        return flat.shapes.by_name(jax.vmap(at_output)(q, qdot, times[0], contacts))

    return trajectory.map_members(of_member, trajectory.contacts)
