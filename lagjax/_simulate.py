"""`simulate` and `simulate_batch`: from a scene and an initial state to a trajectory.

Both follow the same four stages: check what can be checked before any work is done, turn numbers into arrays (so that
a new value never recompiles), integrate in machine code (`_engine`) or by diffrax (`_integrate`), and dress the result
in the user's pytree. Only this module raises when a trajectory fails.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _engine, _linear
from lagjax._consistent import inconsistent_members, rank_lost, require_consistent
from lagjax._equations import equations
from lagjax._failures import differentiable_where, lost_unless, raise_where_failed, sentence
from lagjax._integrate import integrate
from lagjax._layout import Layout
from lagjax._machine_code import MachineCode
from lagjax._results import ENDED_WELL, RESULTS, SimulationError, result_from
from lagjax._settings import (
    Settings,
    as_arrays,
    is_concrete,
    require_finite,
    require_flag,
    require_numbers,
    require_solver_reaches,
)
from lagjax._solvers import Projected
from lagjax._stopped import AHEAD, End, what_stopped
from lagjax._system import System, require_system
from lagjax._trajectory import State, Trajectory

PyTree = Any


def simulate(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    *,
    solver: diffrax.AbstractSolver | MachineCode | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt: float | None = None,
    max_steps: int = 65_536,
    event: Callable | diffrax.Event | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    throw: bool = True,
    progress: bool | diffrax.AbstractProgressMeter = False,
) -> Trajectory:
    r"""The motion of `system` from (q0, qdot0) at `ts[0]`, at the times `ts`.

    Integrates q̈ = M⁻¹(∂L/∂q − (∂p/∂q)q̇ − ∂p/∂t + Q) as a first-order system in (q, q̇).

    **Everyday arguments**

    - `q0`, `qdot0`: the initial state, pytrees of real floats of one structure. Their dtype (float32, float64) is that
      of the whole integration.
    - `ts`: output times, shape (T,), T ≥ 2, strictly increasing, or strictly decreasing to go back in time.
    - `params`: whatever the scene's functions ask for; every number in it is traced and differentiable.
    - `rtol`, `atol`: local error per step, |error| ≤ atol + rtol·|y|, in every component of the state (with diffrax, in
      root mean square over them). By default rtol = 1e-9 in float64 and 1e-5 in float32, and atol = rtol/1000. `atol`
      is in the units of the state. In float32 times, parameters and all arithmetic are float32 too; the ready scenes
      then come out to 3e-4 of the size of their motion, which is a few periods long. `Trajectory.health` tells more.

    **Rarer ones**

    - `solver`: any diffrax solver for ODEs, or `lagjax.MachineCode()` to insist on the default. That is, in float64 on
      a CPU, Taylor series in machine code made for the scene, of an order that suits `rtol`; `System.explain` says
      where that cannot be. Then it is `lagjax.FineOutput(diffrax.Dopri8())`, order 8, with states between its steps
      about as good as those at their ends (which diffrax's own interpolation for it is not).
    - `dt`: take fixed steps of this size instead of adaptive ones; `rtol` and `atol` then do not apply.
    - `max_steps`: the budget of steps, rejected ones included. A reverse-mode gradient by diffrax records that many
      times for every member: lower it for the gradient of a large batch.
    - `event`: a function of (q, qdot), and of `t`, `params` by name. A real-valued one stops the motion where it
      changes sign, a Boolean one after the step on which it becomes true. `diffrax.Event` around such functions sets
      the direction and the root finder. Where the motion starts on the zero itself, give a direction.
    - `adjoint`: how derivatives are taken. By default machine code goes back over its own steps in reverse mode
      (`jax.grad`, `jax.vjp`), at the cost of four or five motions however many parameters there are, and integrates
      sensitivities along with the motion in forward mode (`jax.jvp`, `jax.jacfwd`); derivatives of every order exist.
      All that diffrax integrates, and the derivatives of scenes of more than 2000 operations, go back over the recorded
      steps, in reverse mode only. Pass `diffrax.ForwardMode()` for forward mode there, or any other diffrax adjoint.
      With an event the default is `diffrax.RecursiveCheckpointAdjoint()`.
    - `throw`: raise when the motion does not reach its end. With `throw=False` look at `trajectory.ok`.
    - `progress`: print how far the integration has come; or any diffrax progress meter.

    Functions given here (the event, those inside `system`) are compiled once per function *object*: define them once,
    not in a loop.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, before anything is integrated;
    `SimulationError` when the motion cannot be followed to its end. Inside `jit` the same failures raise at run time.

    Source: Jorba & Zou, *A software package for the numerical integration of ODEs by means of high-order Taylor
    methods*, Exp. Math. 14 (2005) 99; Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §II.4-5.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    trajectory = lagjax.simulate(scene, q0=1.0, qdot0=0.0, ts=jnp.linspace(0, 10, 101))
    trajectory.q - jnp.cos(trajectory.ts)
    ```
    """
    require_system(system)
    require_flag(throw, "throw")
    layout = Layout.of(q0, qdot0)
    settings = Settings.of(layout, ts, solver, rtol, atol, dt, max_steps, event, adjoint, progress)
    params = as_arrays(params, layout.dtype)
    for name, value in (("q0", q0), ("qdot0", qdot0), ("params", params)):
        require_finite(value, name)

    q0, qdot0 = as_arrays((q0, qdot0), layout.dtype)
    require_consistent(system, layout, settings.ts, q0, qdot0, params)
    flow = _engine.flow_for(system, settings, layout, q0, qdot0, params)
    if isinstance(flow, str):
        require_solver_reaches(settings, layout.dtype)
        fields = _integrate(system, settings, q0, qdot0, params)
    elif not _engine.has_derivatives(flow, settings.ts, q0, qdot0, params):
        fields = _integrate(system, settings, q0, qdot0, params, _engine.primal(flow, settings))
    else:
        fields = _engine.run(flow, settings, layout, q0, qdot0, params)
    trajectory = Trajectory(*fields, system, params, tolerances=settings.tolerances)
    return raise_unless_ok(trajectory, layout) if throw else trajectory


def simulate_batch(
    system: System,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    *,
    batch_axes: tuple[PyTree, PyTree, PyTree] = (0, 0, None),
    solver: diffrax.AbstractSolver | MachineCode | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt: float | None = None,
    max_steps: int = 65_536,
    event: Callable | diffrax.Event | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    progress: bool | diffrax.AbstractProgressMeter = False,
) -> Trajectory:
    """The motion of many members of one scene at once: the same numbers as `jax.vmap` over `simulate`.

    `batch_axes` says for (q0, qdot0, params) which axis runs over the members, as `in_axes` of `jax.vmap` does: an
    integer, None for what all share, or a pytree of these. The default is a batch of initial states; a sweep over
    parameters from one initial state is `batch_axes=(None, None, 0)`. In the result the members are the first axis.

    A member that fails, or starts from NaN, never raises and costs the others nothing: look at `trajectory.ok` and
    `trajectory.result`. The other arguments, the errors raised for them, and the source are those of `simulate`.

    ```python
    import jax.numpy as jnp, lagjax

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    trajectory = lagjax.simulate_batch(scene, jnp.linspace(0, 1, 1000), jnp.zeros(1000), ts=jnp.linspace(0, 10, 101))
    assert trajectory.q.shape == (1000, 101) and trajectory.ok.all()
    ```
    """
    require_system(system)
    values = {"q0": q0, "qdot0": qdot0, "params": params}
    axes, size = _axes_per_leaf(values, batch_axes)
    member = {name: _first_member(value, axes[name]) for name, value in values.items()}
    layout = Layout.of(member["q0"], member["qdot0"])
    settings = Settings.of(layout, ts, solver, rtol, atol, dt, max_steps, event, adjoint, progress)
    values = {name: as_arrays(value, layout.dtype) for name, value in values.items()}
    for name, value in values.items():
        require_finite(jax.tree.map(lambda leaf, axis: leaf if axis is None else None, value, axes[name]), name)

    astray = inconsistent_members(system, layout, settings.ts, values, axes)
    flow = _engine.flow_for(system, settings, layout, *member.values())
    if isinstance(flow, str):
        require_solver_reaches(settings, layout.dtype)
        fields = _integrate_batch(system, settings, *values.values(), _Static(tuple(batch_axes)))
        steps = fields[5]["num_steps"]  # every lane waits for the slowest
        fields[5]["num_wasted_lane_steps"] = steps.size * jnp.max(steps) - jnp.sum(steps)
    elif all(is_concrete(leaf) for leaf in jax.tree.leaves((settings.ts, values))):
        fields = _engine.run_batch(flow, settings, layout, values, axes, size)
    elif _engine.has_derivatives(flow, settings.ts, *values.values()):
        run = jax.vmap(lambda *one: _engine.run(flow, settings, layout, *one), in_axes=tuple(batch_axes))
        fields = run(*values.values())
    else:
        primal = _engine.primal(flow, settings)
        fields = _integrate_batch(system, settings, *values.values(), _Static(tuple(batch_axes)), primal)
    shared = {"params_axes": batch_axes[2], "tolerances": settings.tolerances}
    trajectory = Trajectory(jnp.asarray(settings.ts), *fields[1:], system, values["params"], **shared)
    return trajectory if astray is None else _refused(trajectory, astray)


class _Static(eqx.Module):
    """Hands a hashable value to a compiled function as part of its structure."""

    value: Any = eqx.field(static=True)


@eqx.filter_jit
def _integrate_batch(system, settings, q0, qdot0, params, batch_axes: _Static, primal=None):
    def member(q0, qdot0, params):
        return _integrate(system, settings, q0, qdot0, params, primal)

    return jax.vmap(member, in_axes=batch_axes.value)(q0, qdot0, params)


@eqx.filter_jit
def _integrate(system: System, settings: Settings, q0, qdot0, params, primal=None):
    """One trajectory by diffrax, the first six fields of `Trajectory`; with `primal` diffrax only differentiates."""
    layout = Layout.of(q0, qdot0)
    numbers, motion = eqx.filter(params, eqx.is_array), system.motion(layout, params)
    form = equations(motion, layout, numbers, system.path)
    y0 = layout.flatten(q0), layout.flatten(qdot0)

    # A member that cannot start is given no time to integrate over: it costs nothing, and the others do not wait.
    start = _health(y0, *form.acceleration(settings.ts[0], y0, numbers))
    ts = jnp.where(start == RESULTS.successful, settings.ts, settings.ts[0])
    event = None if settings.event is None else _in_coordinates(settings.event, layout, params)
    solved = integrate(form, settings, event, ts, y0, numbers, primal)
    path, end, t_end = solved.path, solved.end, solved.t_end

    result = _explained(RESULTS.promote(solved.result), start, _health(end, *form.acceleration(t_end, end, numbers)))
    result = _of_surroundings(result, form, ts, solved, numbers)
    if motion.constrained:
        lost = rank_lost(motion, (*y0, settings.ts[0], numbers), (*end, t_end, numbers))
        result = _of_constraints(result, RESULTS.promote(solved.result), lost)
    # diffrax leaves outputs it did not reach at inf, and those of a member without time at its start. Whatever adjoint
    # there is, their cotangents must not be lost: they go to all that went in.
    reached = jnp.isfinite(path[0]).all(axis=1) & jnp.isfinite(path[1]).all(axis=1) & (ts == settings.ts)
    well = jnp.isin(result._value, jnp.asarray(ENDED_WELL))
    inputs = settings.ts, y0, numbers
    q, qdot = (jax.vmap(layout.restore)(lost_unless(reached[:, None], leaf, inputs)) for leaf in path)
    end = tuple(differentiable_where(well, leaf) for leaf in end)
    return (
        settings.ts,
        q,
        qdot,
        result,
        State(t_end, *map(layout.restore, end)),
        solved.stats,
    )


def _health(y, acceleration, singular) -> RESULTS:
    """Whether a motion can go on from a state with this acceleration, and if not, why."""
    finite = jax.tree.reduce(lambda all_, leaf: all_ & jnp.isfinite(leaf).all(), (y, acceleration), jnp.array(True))
    failed = RESULTS.where(singular, RESULTS.mass_matrix_singular, RESULTS.nonfinite_state)
    return RESULTS.where(finite, RESULTS.successful, failed)


def _explained(result: RESULTS, start: RESULTS, end: RESULTS) -> RESULTS:
    """The most telling of what diffrax reports and of what the first and the last state show."""
    stopped = (result != RESULTS.successful) & (result != RESULTS.event_occurred)
    unhealthy = (end != RESULTS.successful) & (stopped | (end == RESULTS.nonfinite_state))
    result = RESULTS.where(unhealthy, end, result)
    return RESULTS.where(start == RESULTS.successful, result, start)


def _of_surroundings(result: RESULTS, form, ts, solved, numbers) -> RESULTS:
    """What the motion ran into, where steps became too small or too many: see `_stopped`."""
    field = eqx.filter_closure_convert(form.acceleration, ts[0], solved.end, numbers)
    # A name has no derivative, and the search for it is a loop that reverse mode could not go back through.
    frozen = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, (field, ts, solved, numbers))
    field, ts, solved, numbers = frozen
    n, counts = len(solved.end[0]), [solved.stats[f"num_{kind}_steps"] for kind in ("accepted", "rejected")]

    def acceleration(t, y):
        return field(t, (y[:n], y[n:]), numbers)[0]

    end = End(solved.t_end, jnp.concatenate(solved.end), ts[0], ts[-1], *counts)
    stopped = (result == RESULTS.dt_min_reached, result == RESULTS.max_steps_reached)
    not_finite, jumps = what_stopped(acceleration, end, *stopped)
    result = RESULTS.where(jumps, RESULTS.acceleration_discontinuous, result)
    return RESULTS.where(not_finite, RESULTS.nonfinite_state, result)


def _of_constraints(result: RESULTS, reported: RESULTS, lost) -> RESULTS:
    """What failed, where the constraints are the reason: Newton's method, or fewer of them independent than before."""
    failed = (result != RESULTS.successful) & (result != RESULTS.event_occurred)
    result = RESULTS.where(failed & lost, RESULTS.constraint_rank_lost, result)
    return RESULTS.where(reported == RESULTS.promote(Projected.FAILED), RESULTS.projection_failed, result)


def _in_coordinates(event: diffrax.Event, layout: Layout, params: PyTree) -> diffrax.Event:
    """The user's event functions, made to read the solver's state."""

    def flat(function):
        def condition(t, y, args, **_):
            return function(*map(layout.restore, y), t=t, params=eqx.combine(args, params))

        return condition

    conditions = jax.tree.map(flat, event.cond_fn, is_leaf=callable)
    return diffrax.Event(conditions, event.root_finder, event.direction)


def _axes_per_leaf(values: dict[str, PyTree], batch_axes) -> tuple[dict[str, PyTree], int]:
    """`batch_axes` spread over every leaf, and the size of the batch, which must be the same everywhere."""
    if not isinstance(batch_axes, tuple) or len(batch_axes) != 3:
        raise ValueError(f"batch_axes must be a tuple of three, for (q0, qdot0, params); got {batch_axes!r}.")
    axes, sizes = {}, {}
    for (name, value), prefix in zip(values.items(), batch_axes, strict=True):
        try:
            axes[name] = jax.tree.broadcast(prefix, value, is_leaf=lambda axis: axis is None)
        except ValueError:
            raise ValueError(f"batch_axes for {name} is {prefix!r}, which does not fit its structure.") from None
        leaves, tree = jax.tree_util.tree_flatten_with_path(value)
        for (path, leaf), axis in zip(leaves, tree.flatten_up_to(axes[name]), strict=True):
            label = name + jax.tree_util.keystr(path)
            if axis is not None:
                require_numbers(leaf, label)
                if not -jnp.ndim(leaf) <= axis < jnp.ndim(leaf):
                    raise ValueError(f"{label} has shape {jnp.shape(leaf)}: it has no axis {axis} for the batch.")
                sizes[label] = jnp.shape(leaf)[axis]
    if not sizes:
        raise ValueError("batch_axes maps over nothing: name the axis of the members in q0, qdot0 or params.")
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{label} has {size}" for label, size in sizes.items())
        raise ValueError(f"The batch must have one size everywhere; {listed}.")
    if 0 in sizes.values():
        raise ValueError("The batch is empty.")
    return axes, next(iter(sizes.values()))


def _refused(trajectory: Trajectory, astray: jax.Array) -> Trajectory:
    """The same without the members that did not start on their constraints: they are NaN, and say so."""

    def without(leaf):
        return jnp.where(astray.reshape(-1, *[1] * (leaf.ndim - 1)), jnp.nan, leaf)

    result = result_from(jnp.where(astray, RESULTS.inconsistent_start._value, trajectory.result._value))
    q, qdot = jax.tree.map(without, (trajectory.q, trajectory.qdot))
    return eqx.tree_at(lambda t: (t.q, t.qdot, t.result), trajectory, (q, qdot, result))


def _first_member(tree: PyTree, axes: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf, axis: leaf if axis is None else jnp.take(leaf, 0, axis), tree, axes)


def raise_unless_ok(trajectory: Trajectory, layout: Layout) -> Trajectory:
    """Raise `SimulationError` for a trajectory that did not reach its end; at run time when it is being traced."""
    end, code = trajectory.end, trajectory.result._value
    if is_concrete(code) and int(code) in ENDED_WELL:
        return trajectory
    t_last = trajectory.ts[-1]
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves((end, code, t_last))):
        y_end = jnp.concatenate([layout.flatten(end.q), layout.flatten(end.qdot)])
        states = trajectory.q, trajectory.qdot, end
        states = raise_where_failed(states, code, (end.t, y_end), t_last, layout.names)
        return eqx.tree_at(lambda t: (t.q, t.qdot, t.end), trajectory, states)
    y_end = np.concatenate([layout.flatten(end.q), layout.flatten(end.qdot)])
    message = sentence(code, end.t, t_last, y_end, layout.names)
    if trajectory.result == RESULTS.mass_matrix_singular:
        mass = np.asarray(trajectory.system.mass_matrix(end.q, end.qdot, end.t, trajectory.params))
        message += f"\n{_describe_null(mass, layout.names)}"
    if trajectory.result == RESULTS.nonfinite_state and isinstance(trajectory.system, System):
        message += _describe_undefined(trajectory, layout)
    raise SimulationError(message, trajectory)


def _describe_undefined(trajectory: Trajectory, layout: Layout) -> str:
    """A sentence about the forces, or else the accelerations, that are not finite at the end or just ahead of it."""
    system, end, params = trajectory.system, trajectory.end, trajectory.params
    rate = end.qdot, system.acceleration(end.q, end.qdot, end.t, params)
    first, last = (float(trajectory.ts[place]) for place in (0, -1))
    smallest = float(np.copysign(4 * jnp.finfo(layout.dtype).eps * max(abs(first), abs(last)), last - first))
    for steps in (0.0, *AHEAD):
        moved = jax.tree.map(lambda x, dx, s=steps * smallest: x + s * dx if s else x, (end.q, end.qdot), rate)
        for what, function in (("force on", system.generalized_force), ("acceleration of", system.acceleration)):
            values = np.asarray(layout.flatten(function(*moved, end.t + steps * smallest, params)))
            bad = [f"{name} ({x})" for name, x in zip(layout.names, values, strict=True) if not np.isfinite(x)]
            if bad:
                return f"\nNot finite {'just ahead' if steps else 'there'}: the {what} {', '.join(bad[:8])}."
    return ""


def _describe_null(mass: np.ndarray, names: tuple[str, ...]) -> str:
    """The coordinates, or their combinations, that carry no kinetic energy."""
    unused = [name for name, row in zip(names, mass, strict=True) if not row.any()]
    if unused:
        return (
            f"Singular there: L has no kinetic energy in the velocity of {', '.join(unused)} (absent from L, or linear "
            "in it)."
        )
    combinations = []
    for direction in _linear.null_directions(mass):
        direction = direction / direction[np.argmax(np.abs(direction))]
        terms = [f"{c:+.3g} d{name}" for c, name in zip(direction, names, strict=True) if abs(c) > 1e-6]
        combinations.append(" ".join(terms))
    if not combinations:
        return (
            "It is regular there, but not positive definite, and more than two coordinates are solved for without "
            "pivoting: turn the sign of L, or give path='array' to System."
        )
    return f"Singular there: no kinetic energy along {'; '.join(combinations)}."
