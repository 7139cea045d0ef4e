"""Events and crossings of one member under every transformation of JAX: their times and states, and derivatives.

    located   by machine code that watches guards along the steps, without derivatives
    varied    by a second run, without guards, with outputs at the located times: the states there have derivatives like
              those at any output time, and with them the times (`_surfaces.crossing_variation`)

The second run is needed for derivatives only. Its outputs are a few roundings before the crossings: if a force jumps on
the surface itself, the state, its rate and its derivatives are all those before the jump, and consistent.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine._problem import Problem, Solution, evaluate_condition, signs_of_event
from lagjax._engine.taylor import _primitives
from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._engine.taylor._surfaces import Surfaces, crossing_variation, jumps_through_zero, require_one_number
from lagjax._equations import Derivation
from lagjax._interface import ENDED_WELL, EVENT_OCCURRED, halves
from lagjax._primitives import attach_derivative, differentiable_where, undefined_unless
from lagjax._program import Unlowerable

_BEFORE = 64 * np.finfo(np.float64).eps  # of the largest time: more than the rounding of a time, and of a border's


class FoundCrossings(NamedTuple):
    """The crossings of each of G surfaces, at most `room`, NaN after the last one."""

    t: Any  # (G, room)
    y: Any  # (G, room, 2n), the state then
    count: Any  # (G,), how many there were

    @classmethod
    def read(cls, path, surfaces: int) -> "FoundCrossings":
        """The crossings in the `path` of a motion that records them, (G (room + 1), 2n + 1)."""
        rows = path.reshape(surfaces, -1, path.shape[-1])
        return cls(rows[:, :-1, 0], rows[:, :-1, 1:], rows[:, -1, 0])


# ---- an event as a surface -------------------------------------------------------------------------------------------


def surfaces_of_event(problem: Problem) -> Surfaces:
    """The functions of an event as surfaces. Raises `Unlowerable` if machine code cannot evaluate them."""
    if "surfaces" not in problem.engine_parts:
        problem.engine_parts["surfaces"] = _surfaces_of_event(problem)
    return problem.engine_parts["surfaces"]


def _surfaces_of_event(problem: Problem) -> Surfaces:
    event = problem.event
    assert event is not None
    if event.root_finder is not None:
        raise Unlowerable("the event has a root finder of its own")
    if any(eqx.is_array(leaf) for leaf in jax.tree.leaves(event.conditions)):
        raise Unlowerable("the event holds arrays of its own")
    signs = signs_of_event(problem)
    if None in signs:
        raise Unlowerable("the event is true or false, and no comparison of two numbers")
    pairs = zip(signs, event.ways, strict=True)
    directions = tuple(sign or (0 if way is None else 1 if way else -1) for sign, way in pairs)
    surfaces = surfaces_of(problem, tuple(event.functions), directions, "An event")
    return surfaces._replace(holds=tuple(map(bool, signs)))


def surfaces_of(problem: Problem, functions: tuple, directions: tuple[int, ...], what: str) -> Surfaces:
    """Functions of (q, qdot), and of t and params, as surfaces. Raises `Unlowerable` if they have no machine code.

    Raises `TypeError` if the value of one is not one real number; `what` names it.
    """
    code, structure = jax.tree.flatten(eqx.filter(problem.params, eqx.is_array_like, inverse=True))
    given = directions, tuple(code), structure, what, problem.is_rounded
    return _lower_surfaces(problem.derivation.lowered, functions, *given)


@functools.lru_cache(maxsize=64)
def _lower_surfaces(derivation: Derivation, functions, directions, code, structure, what, is_rounded) -> Surfaces:
    restore = derivation.layout.restore

    def values_at(y, params):
        def call(function, y, params):
            return function(*map(restore, halves(y[:-1])), t=y[-1], params=params)

        calls = [functools.partial(call, function) for function in functions]
        if what == "An event":
            return jnp.stack([require_one_number(evaluate_condition(of, y, params)[0], what) for of in calls])
        return jnp.stack([require_one_number(of(y, params), what) for of in calls])

    return Surfaces.from_function(derivation, values_at, directions, code, structure, is_rounded)


# ---- to the first event ----------------------------------------------------------------------------------------------


def motion_to_event(guarded: Flow, flow: Flow, surfaces: Surfaces, tolerances: Tolerances, ts, y0, params) -> Solution:
    """The motion to its event, or to the last of `ts` (T,), with first and second derivatives."""
    still = jax.lax.stop_gradient
    solution = jax.tree.map(still, _primitives.run(guarded, tolerances, still(ts), still(y0), still(params)))
    reached = jnp.isfinite(solution.path).all(axis=1)
    values, where = (solution.path, solution.y_end, solution.t_end), (solution.result, solution.event)
    run_again = _event_variation(flow, surfaces, tolerances)
    path, y_end, t_end = attach_derivative(run_again, values, ts, y0, params, solution.t_end, *where)
    well = jnp.isin(solution.result, jnp.asarray(ENDED_WELL))
    return solution._replace(
        path=undefined_unless(reached[:, None], path, (ts, y0, params)),
        y_end=differentiable_where(well, y_end),
        t_end=differentiable_where(well, t_end),
    )


@functools.lru_cache(maxsize=64)
def _event_variation(flow: Flow, surfaces: Surfaces, tolerances: Tolerances):
    """A function `(ts, y0, params, t_end, result, event)` → path, y_end, t_end, which carries their derivatives."""
    move_to_zero = crossing_variation(surfaces)

    @jax.jit
    def run_unguarded(ts, y0, params, t_stop, result, event):
        fired, stop = result == EVENT_OCCURRED, _shortly_before(ts, t_stop)
        end = jnp.where(fired, stop, ts[-1])
        times = jnp.where((end - ts) * (ts[-1] - ts[0]) >= 0, ts, end)
        times = jnp.concatenate([ts[:1], times[1:-1], end[None]])
        solution = _primitives.run(flow, tolerances, times, y0, params)
        first = jnp.argmax(event > 0)
        moves = fired
        if any(surfaces.holds):  # what holds at the start ends the motion there
            at_once = jnp.asarray(surfaces.holds)[first] & (t_stop == ts[0])
            end, moves = jnp.where(fired & at_once, ts[0], end), fired & ~at_once
        t_end, y_end = move_to_zero(first, moves, end, solution.y_end, params)
        return solution.path, y_end, t_end

    return run_unguarded


def run_stretch(
    flow: Flow, surfaces: Surfaces | None, tolerances: Tolerances, ts, y0, params, t_end, y_end, k, crosses
) -> tuple:
    """The path, the end time, and the state there, of a motion from ts[0] to `t_end`; surface k `crosses` there.

    The run ends at the rounded time of the event, and the crossing is varied from its state there: so the rates of
    short motions between late events cancel to the last digit. And if nothing depends on the time, a varied start time
    shifts the motion: durations depend on the motion, not on its start time. For a surface that jumps through zero the
    run ends just before it: the acceleration may jump there.
    """
    still = jax.lax.stop_gradient
    if surfaces is not None and surfaces.borders is not None:
        jumps = crosses & jumps_through_zero(surfaces, k, t_end, y_end, params)
        t_end = jnp.where(jumps, _shortly_before(ts, t_end), t_end)
    reached = jnp.where(ts <= t_end, ts, jnp.clip(still(ts), still(ts[0]), still(t_end)))
    later = 0.0 if flow.reads_time else ts[0] - still(ts[0])
    end = t_end + jnp.where(crosses, later, 0.0)
    times = jnp.concatenate([ts[:1], reached[1:-1], end[None]]) - later
    solution = _primitives.run(flow, tolerances, times, y0, params)
    return solution.path, end, solution.y_end


# ---- all crossings ---------------------------------------------------------------------------------------------------


def motion_with_crossings(
    noting: Flow, flow: Flow, surfaces: Surfaces, tolerances: Tolerances, ts, y0, params
) -> tuple[Solution, FoundCrossings]:
    """The motion to the last of `ts`, and its crossings, with first and second derivatives."""
    still = jax.lax.stop_gradient
    solution = jax.tree.map(still, _primitives.run(noting, tolerances, still(ts), still(y0), still(params)))
    noted = FoundCrossings.read(solution.path, len(surfaces.directions))
    run_again = _crossings_variation(flow, surfaces, tolerances._replace(notes=0))
    t, y = attach_derivative(run_again, (noted.t, noted.y), ts, y0, params, noted.t)
    there, inputs = jnp.isfinite(noted.t), (ts, y0, params)
    return solution, FoundCrossings(
        undefined_unless(there, t, inputs), undefined_unless(there[..., None], y, inputs), noted.count
    )


@functools.lru_cache(maxsize=64)
def _crossings_variation(flow: Flow, surfaces: Surfaces, tolerances: Tolerances):
    """A function `(ts, y0, params, t)` → t (G, room), y (G, room, 2n), which carries their derivatives."""
    move_to_zero, each = crossing_variation(surfaces), np.arange(len(surfaces.directions))

    @jax.jit
    def run_unguarded(ts, y0, params, t):
        there = jnp.isfinite(t)
        times = jnp.where(there, _shortly_before(ts, t), jax.lax.stop_gradient(ts[-1])).ravel()
        order = jnp.argsort(times * jnp.sign(ts[-1] - ts[0]))
        solution = _primitives.run(flow, tolerances, jnp.concatenate([ts[:1], times[order], ts[-1:]]), y0, params)
        path = jnp.zeros_like(solution.path[1:-1]).at[order].set(solution.path[1:-1])
        y, times = path.reshape(*t.shape, -1), times.reshape(t.shape)
        of_section = jax.vmap(move_to_zero, (None, 0, 0, 0, None))
        return jax.vmap(of_section, (0, 0, 0, 0, None))(each, there, times, y, params)

    return run_unguarded


def _shortly_before(ts, t):
    """The time a few roundings before t, but not before the first time."""
    first, last = jax.lax.stop_gradient((ts[0], ts[-1]))
    step = _BEFORE * jnp.maximum(abs(first), abs(last))
    earlier = t - jnp.sign(last - first) * step
    return jnp.where((earlier - first) * (last - first) > 0, earlier, first)
