"""`simulate` and `simulate_batch`: from a scene and an initial state to a trajectory.

Both follow the same four stages: state the problem, with everything checked that can be before any work is done; choose
the engine; let it solve the problem; and dress the solution in the user's pytree. Only this module raises when a
trajectory fails.
"""

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import AbstractEngine, Batch, Problem, Solution, axes_per_leaf, choose, requested_engine
from lagjax._engine.taylor import MachineCode
from lagjax._equations import has_constraints, inconsistent_members, require_consistent
from lagjax._interface import (
    ENDED_WELL,
    RESULTS,
    Layout,
    advice,
    as_arrays,
    halves,
    output_times,
    require_flag,
    result_from,
)
from lagjax._primitives import allows_nan
from lagjax._run._trajectory import EACH, RunSettings, State, Trajectory, raise_unless_ok, step_counts
from lagjax._run.contacts import simulate_contact_batch, simulate_contacts
from lagjax._run.hybrid import Hybrid, simulate_modes
from lagjax._scene import System, lift_batch, lift_problem, require_system

if TYPE_CHECKING:
    import diffrax


_TIMES = "the times at which the state is wanted, from the start to the end, are ts"
_ELSEWHERE = {  # words of SciPy and diffrax
    "t_eval": _TIMES,
    "t_span": _TIMES,
    "saveat": _TIMES,
    "dense_output": f"{_TIMES}; trajectory.at(t) gives states between these",
    "args": "what the functions of a scene take besides the state is params",
    "y0": "the state is q0, qdot0",
    "events": "event=f, or a dict of functions, ends the motion; lagjax.crossings finds all instants",
    "method": "solver= takes a solver of diffrax",
    "max_step": "dt= takes fixed steps",
}


def _translate_keywords(function: Callable) -> Callable:
    """A decorator: keywords of other packages raise an error that tells what to write instead."""

    @functools.wraps(function)
    def translated(*args, **keywords):
        for name in _ELSEWHERE.keys() & keywords.keys():
            raise TypeError(f"{function.__name__} takes no {name}=: {_ELSEWHERE[name]}.")
        return function(*args, **keywords)

    return translated


@_translate_keywords
@allows_nan
def simulate(
    system: System | Hybrid,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array | np.ndarray,
    params: PyTree = None,
    *,
    solver: "diffrax.AbstractSolver | MachineCode | None" = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt: float | None = None,
    max_steps: int = 65_536,
    max_transitions: int | None = None,
    event: "Callable | diffrax.Event | None" = None,
    adjoint: "diffrax.AbstractAdjoint | None" = None,
    throw: bool = True,
    progress: "bool | diffrax.AbstractProgressMeter" = False,
) -> Trajectory:
    r"""The motion of `system` from (q0, qdot0) at `ts[0]`, at the times `ts`.

    Integrates q̈ = M⁻¹(∂L/∂q − (∂p/∂q)q̇ − ∂p/∂t + Q) as a first-order system in (q, q̇).

    **Everyday arguments**

    - `system`: a `System`, or a `Hybrid`, whose motion runs through its modes.
    - `q0`, `qdot0`: the initial state, pytrees of real floats of one structure. Their dtype (float32, float64) is that
      of times, parameters and results. Machine code computes in float64 in any case and rounds once, at the end.
    - `ts`: output times, shape (T,), T ≥ 2, strictly increasing, or strictly decreasing to go back in time.
    - `params`: a pytree of the parameters that the scene's functions take; every number in it is traced and
      differentiable.
    - `rtol`, `atol`: local error per step, |error| ≤ atol + rtol·|y|, in every component of the state (with diffrax, in
      root mean square over them). By default rtol = 1e-9, and 1e-5 in float32 with diffrax, which computes in the
      precision of the state; and atol = rtol/1000, but at most rtol/16 times the largest coordinate (for velocities the
      largest velocity): a motion of 1e-10 metres has the digits that it has in ångströms, unless it starts from rest at
      q = 0. An `atol` that is given is in the units of the state, and taken as it is. Give one where coordinates have
      different units and some are below 1e-8.

    **Rarer ones**

    - `solver`: any diffrax solver for ODEs, or `lagjax.MachineCode()` to insist on machine code. The default, on a CPU,
      is Taylor series in machine code made for the scene, of an order that suits `rtol`; `System.explain` says where
      that is not possible. Then the default is `lagjax.FineOutput(diffrax.Dopri8())`, of order 8, whose states between
      steps are about as accurate as those at their ends (diffrax's own interpolation for it is less accurate).
    - `dt`: take fixed steps of this size instead of adaptive ones; `rtol` and `atol` then do not apply.
    - `max_steps`: the budget of steps, rejected ones included. A reverse-mode gradient by diffrax records that many
      times for every member: lower it for the gradient of a large batch.
    - `max_transitions`: of a scene with contacts, the budget of changes: impacts, releases, slips that stop and begin;
      256 by default. Of a `Hybrid`, the budget of transitions, in place of its own.
    - `event`: a function of (q, qdot), and of `t`, `params` by name. A real-valued event stops the motion where it
      changes sign. Machine code finds that on its series, without sampling, so that none is missed. A motion that
      starts on the zero, to the rounding of the numbers that came in (eight roundings of each, in float32), has to
      leave it first; with a direction only if it leaves the other way, and else it ends at once. A Boolean event that
      compares two numbers, as `q < 0` does, stops the motion where it becomes true, and at once where it is true at the
      start: their difference is the event. Any other one stops it after the step on which it becomes true, and there
      derivatives of the end are NaN. These, and events with a root finder of their own, are integrated by diffrax;
      there give a direction if the motion starts on the zero. `diffrax.Event` around such functions sets the direction
      and the root finder. Of a list or a dict of functions the first to happen ends the motion: `trajectory.event` says
      which. With contacts and in a `Hybrid`, `crossings` finds such instants.
    - `adjoint`: how derivatives are taken. By default machine code goes back over its own steps in reverse mode
      (`jax.grad`, `jax.vjp`), at the cost of a few motions however many parameters there are, and forward over them in
      forward mode, all directions together (`jax.jvp`, `jax.jacfwd`); derivatives of every order exist. A run of
      diffrax is differentiated over the recorded steps, in reverse mode only. Pass `diffrax.ForwardMode()` for forward
      mode there, or any other diffrax adjoint. With an event the default there is
      `diffrax.RecursiveCheckpointAdjoint()`; in machine code the end of a motion by an event has first and second
      derivatives.
    - `throw`: raise when the motion does not reach its end. With `throw=False` look at `trajectory.ok`.
    - `progress`: print how far the integration has come; or any diffrax progress meter.

    **Borders.** Forces and potentials may have kinks and jumps (`where`, `abs`, `sign`, `clip`, `floor`, …), also in
    time. Angles have their cuts (`arctan2`, `jnp.angle`, `arctan(y / x)`, complex roots, logarithms and powers). Where
    L itself or p = ∂L/∂q̇ jumps, the velocities do: p is continuous at an instant, and along a border in space, across
    which the energy is (where that does not suffice, the motion is reflected); at the very instant they are those
    behind it. What cannot be decided so is refused before the run, and so is all of it with a solver of diffrax; a
    motion ends at a corner of its constraints.
    Machine code ends a step at every border and begins the next one beyond it; where both sides push towards the
    border, as dry friction at rest does, the motion stays on it. First and second derivatives, in every mode, include
    the jumps at borders. Where they do not exist they are NaN: where a border is grazed, and by knots of two inputs
    that coincide (see `samples`). With diffrax, steps shrink at borders and go across, and a derivative over them lacks
    what a jump of the acceleration adds. So the steps are searched for a jump before a derivative is computed: a motion
    that crosses one, at a place that moves with the state or with parameters that are differentiated, raises
    `SimulationError` in `jax.grad`; its derivatives are NaN with `throw=False`. With an event or an `adjoint` they are
    NaN in either case, but by the time of a switch that is a parameter, where they lack its jump; with
    `diffrax.BacksolveAdjoint` nothing is searched. Corners, where the acceleration is continuous, and jumps at known
    times add nothing to first derivatives.

    **Values that functions read.** What the event and the functions inside `system` read besides their arguments
    (globals, closures, attributes, helpers) is compared at every call: after `K = 1.0` the motion is that of the new
    K, and the scene is derived once more; going back to former values goes back to what was derived from them. Of
    arrays over 1 MiB 4096 numbers are compared, of containers over 10 000 entries their number. Not seen are files, the
    environment, and names that a function makes up (`globals()["K"]`). Under a `jax.jit` of your own, JAX keeps the
    values of the first call. Numbers that are being traced, in a scene that is made within `jax.grad`, are parameters.
    Values that change often belong into `params`, which never compiles anew.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, before anything is integrated;
    `SimulationError` when the motion cannot be followed to its end. Inside `jit` the same failures are raised at run
    time.

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
    of_engines = {"solver": solver, "dt": dt, "event": event, "adjoint": adjoint, "progress": progress}
    if isinstance(system, Hybrid):
        _refuse_options("a lagjax.Hybrid", of_engines)
        if max_transitions is not None:
            system = dataclasses.replace(system, max_transitions=max_transitions)
        return simulate_modes(system, q0, qdot0, ts, params, rtol, atol, max_steps, throw)
    system = require_system(system, contacts=True)
    if system.touches:
        _refuse_options("a scene with contacts", of_engines)
    require_flag(throw, "throw")
    layout = Layout.from_state(q0, qdot0)
    requested = requested_engine(solver, dt, adjoint, progress, rtol, atol)
    given = Problem.from_arguments(system, layout, q0, qdot0, ts, params, rtol, atol, max_steps, event)
    problem = lift_problem(given)
    if system.touches:
        trajectory = simulate_contacts(given, problem, max_transitions)
        return raise_unless_ok(trajectory, layout, lambda: advice(trajectory.result)) if throw else trajectory
    if has_constraints(system):
        q0, qdot0 = as_arrays((q0, qdot0), layout.dtype, "state")
        require_consistent(problem.system, layout, problem.ts, q0, qdot0, problem.params)
    engine = choose(problem, requested).engine
    solution = engine.solve(problem)
    trajectory = trajectory_of(given, engine, solution, given.y0, given.params)
    if not throw or (isinstance(solution.result, np.integer) and solution.result in ENDED_WELL):
        return trajectory
    return raise_unless_ok(trajectory, layout, lambda: advice(trajectory.result, engine.is_implicit))


@_translate_keywords
@allows_nan
def simulate_batch(
    system: System | Hybrid,
    q0: PyTree,
    qdot0: PyTree,
    ts: jax.Array,
    params: PyTree = None,
    *,
    batch_axes: tuple[PyTree, PyTree, PyTree] = (0, 0, None),
    solver: "diffrax.AbstractSolver | MachineCode | None" = None,
    rtol: float | None = None,
    atol: float | None = None,
    dt: float | None = None,
    max_steps: int = 65_536,
    max_transitions: int | None = None,
    event: "Callable | diffrax.Event | None" = None,
    adjoint: "diffrax.AbstractAdjoint | None" = None,
    progress: "bool | diffrax.AbstractProgressMeter" = False,
) -> Trajectory:
    """The motion of many members of one scene at once: the same numbers as `jax.vmap` over `simulate`.

    `batch_axes` says for (q0, qdot0, params) which axis runs over the members, as `in_axes` of `jax.vmap` does: an
    integer, None for an argument that all members share, or a pytree of these. The default is a batch of initial
    states; a sweep over parameters from one initial state is `batch_axes=(None, None, 0)`, and over one of them
    `batch_axes=(None, None, {"m": 0, "l": None})`. In the result the members are the first axis.

    `ts` are the output times (T,) of all members, or (members, T): a row for each, which may begin, end and run as it
    likes, forward or backward. The `ts` of the trajectory have that shape, too.

    A `Hybrid` runs under `jax.vmap`: inside of a `jax.jit` of your own it is compiled once.

    A member that fails, or starts from NaN, never raises and does not affect the others: look at `trajectory.ok` and
    `trajectory.result`. The other arguments, their errors, and the source are those of `simulate`.

    ```python
    import jax.numpy as jnp, lagjax

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    trajectory = lagjax.simulate_batch(scene, jnp.linspace(0, 1, 1000), jnp.zeros(1000), ts=jnp.linspace(0, 10, 101))
    assert trajectory.q.shape == (1000, 101) and trajectory.ok.all()
    ```
    """
    of_engines = {"solver": solver, "dt": dt, "event": event, "adjoint": adjoint, "progress": progress}
    values = {"q0": q0, "qdot0": qdot0, "params": params}
    if not isinstance(ts, np.ndarray | jax.Array):
        ts = output_times(ts, float, rows=True)
    axes, size = axes_per_leaf(values, batch_axes, ts)
    if isinstance(system, Hybrid):
        options = of_engines | {"rtol": rtol, "atol": atol, "max_steps": max_steps, "max_transitions": max_transitions}
        follow = functools.partial(simulate, system, throw=False, **options)
        of_ts = 0 if np.ndim(ts) == 2 else None
        run = jax.vmap(follow, (*batch_axes[:2], of_ts, batch_axes[2]))(q0, qdot0, jnp.asarray(ts), params)
        ts = run.ts[0] if of_ts is None else run.ts
        return dataclasses.replace(run, ts=ts, params=params, params_axes=batch_axes[2])
    system = require_system(system, contacts=True)
    if system.touches:
        _refuse_options("a scene with contacts", of_engines)
    requested = requested_engine(solver, dt, adjoint, progress, rtol, atol)
    given = Batch.from_values(system, values, axes, size, ts, rtol, atol, max_steps, event)
    try:
        batch = lift_batch(given)
        engine = None if system.touches else choose(batch.member, requested, size).engine
    except (IndexError, TypeError) as reason:
        reason.add_note(
            f"By batch_axes this is a batch of {size} members: it says for (q0, qdot0, params) which axis runs over "
            "them, and None for what they share. The default is (0, 0, None)."
        )
        raise
    values = {name: as_arrays(value, batch.member.layout.dtype, name) for name, value in values.items()}
    inconsistent = inconsistent_members(system, batch.member.layout, batch.with_all_times.ts, values, axes)
    of_params = values["params"], batch_axes[2]
    if engine is None:
        trajectory = simulate_contact_batch(given, batch, max_transitions, *of_params)
    else:
        trajectory = trajectory_of(given.with_all_times, engine, engine.solve_batch(batch), given.y0, *of_params)
    return trajectory if inconsistent is None else _mask_inconsistent(trajectory, inconsistent)


def trajectory_of(problem: Problem, engine: AbstractEngine, solution: Solution, y0, params: PyTree, params_axes=EACH):
    """The solution of a problem, or a batch, in the user's pytree; `y0` and `params` are those of all members."""
    # Where nothing is traced, the few numbers stay in NumPy: each one sent to JAX costs as much as ten steps.
    fields = problem.layout, solution.path, solution.y_end, solution.accepted, solution.rejected
    if not isinstance(solution.y_end, np.ndarray):
        (q, qdot, q_end, qdot_end), stats = _restore_traced(*fields)
        ts, result = jnp.asarray(problem.ts), jnp.asarray(solution.result)
    else:
        (q, qdot, q_end, qdot_end), stats = _restore_fields(*fields)
        ts, q, qdot, result = _device_arrays((problem.ts, q, qdot, solution.result))
    if solution.idle is not None:
        stats["num_wasted_lane_steps"] = solution.idle
    event = None
    if problem.event is not None:
        of, ended = jax.tree.structure(problem.event.conditions, is_leaf=callable), jnp.asarray(solution.event)
        event = of.unflatten([ended[..., k] for k in range(of.num_leaves)])
    return Trajectory.from_fields(
        ts=ts, q=q, qdot=qdot, result=result_from(result), end=State(solution.t_end, q_end, qdot_end),
        stats=stats, system=problem.system, params=params, params_axes=params_axes,
        settings=RunSettings.from_problem(problem, engine),
        tolerances=engine.tolerances(problem, y0), event=event,
    )  # fmt: skip


def _restore_fields(layout: Layout, path, y_end, accepted, rejected):
    """The pytrees of coordinates and velocities, at the outputs and at the end, and the counts of steps."""
    return [layout.restore(half) for y in (path, y_end) for half in halves(y)], step_counts(accepted, rejected)


_restore_traced = jax.jit(_restore_fields, static_argnums=0, inline=True)  # one program outside of `jit`


def _refuse_options(scene: str, options: dict[str, Any]) -> None:
    unset = {"progress": False}
    if given := [name for name, value in options.items() if value is not None and value is not unset.get(name)]:
        found = (
            " lagjax.crossings(system, section, q0, qdot0, ts) finds where a function of the state changes sign there: "
            "simulate to that time, crossings(...).t[0], to end at it."
        )
        more = found if "event" in given else ""
        raise TypeError(f"simulate takes no {', '.join(given)} for {scene}, which runs in machine code.{more}")


def _device_arrays(arrays: tuple) -> tuple:
    """NumPy arrays converted to JAX arrays."""
    # `jax.device_put` takes as long as a short motion, a compiled function of arrays of these shapes a tenth of that:
    # it is compiled for one motion. In a process that was forked nothing can be compiled: XLA's threads did not come
    # along.
    if os.getpid() != _PROCESS or np.ndim(arrays[-1]) > 0:
        return jax.device_put(arrays)
    return _as_they_are(*arrays)


_PROCESS = os.getpid()
_as_they_are = jax.jit(lambda *arrays: arrays)


def _mask_inconsistent(trajectory: Trajectory, inconsistent: jax.Array) -> Trajectory:
    """The trajectory with members that did not start on their constraints set to NaN, and their result code."""

    def masked(leaf):
        return jnp.where(inconsistent.reshape(-1, *[1] * (leaf.ndim - 1)), jnp.nan, leaf)

    result = result_from(jnp.where(inconsistent, RESULTS.inconsistent_start._value, trajectory.result._value))
    q, qdot = jax.tree.map(masked, (trajectory.q, trajectory.qdot))
    return eqx.tree_at(lambda t: (t.q, t.qdot, t.result), trajectory, (q, qdot, result))
