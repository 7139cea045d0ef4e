"""`find_states`: a motion between its outputs, each state by a run of the engine from the output before it.

    (trajectory, t) ─► LanePlaces ─► one batch, a lane for each time ─► State

A lane runs from the time of an output, and the state there, to t. A time that is an output gets the numbers of that
output. If times are traced it is unknown which of them are outputs: all have a lane, which at an output runs on to the
next one, so that its derivative is right, and its values are replaced by those of the output.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import Batch
from lagjax._interface import (
    ENDED_WELL,
    SUCCESSFUL,
    SimulationError,
    advice,
    halves,
    is_concrete,
    require_finite,
    require_numbers,
    result_from,
)
from lagjax._run._batch_members import spread_params, spread_rows
from lagjax._run._trajectory import RunSettings, State, Trajectory
from lagjax._run.contacts import simulate_contact_batch
from lagjax._run.hybrid import Hybrid, simulate_modes
from lagjax._scene import lift_batch


def find_states(run: Trajectory, t) -> State:
    """The states at times t, whose axes follow those of the batch (see `Trajectory.at`)."""
    settings, batch = _require_settings(run), jnp.shape(run.result._value)
    run._require_present()
    times, shape = _spread_times(run, t, batch)
    places = LanePlaces.from_trajectory(run, times, batch)
    library: Any = np if all(map(is_concrete, jax.tree.leaves((run, times)))) else jnp
    own = lambda x: library.asarray(x).reshape(-1, *jnp.shape(x)[len(batch) :])  # noqa: E731
    flat = jax.tree.map(own, (run.q, run.qdot, run.mode))
    states = times, *_states_at_places(run, settings, places, flat)
    states = jax.tree.map(lambda x: x.reshape((*shape, *x.shape[2:])), states)
    return State(*(jax.device_put(states) if library is np else states))


def _states_at_places(run: Trajectory, settings: "RunSettings", places: "LanePlaces", flat: tuple) -> PyTree:
    """q and q̇, (N, K, …), of N members at K times each; `flat` are q, q̇ and the mode at their T outputs, (N, T, …)."""
    (count, each), rows = places.times.shape, np.arange(len(places.times))[:, None]
    stored = jax.tree.map(lambda x: x[rows, places.output], flat[:2])
    lanes = np.arange(count * each)
    if places.are_known:
        lanes = np.flatnonzero(~places.is_output & (places.live if is_concrete(places.live) else True))
    if not lanes.size:
        return stored
    member = lanes // each
    begin, ts = places.begin.reshape(-1)[lanes], places.ts.reshape(-1, places.ts.shape[-1])[lanes]
    found = _follow_lanes(run, settings, ts, member, jax.tree.map(lambda x: x[member, begin], flat))

    lane_of = np.zeros(count * each, int)
    lane_of[lanes] = np.arange(len(lanes))

    def put(new, old):
        library: Any = np if isinstance(old, np.ndarray) else jnp
        flags = (x.reshape(*x.shape, *[1] * (old.ndim - 2)) for x in (places.live, places.is_output))
        (live, is_output), new = flags, new[lane_of].reshape(old.shape)
        if not places.are_known:
            old = _exchange_value(new, old)
        return library.where(is_output, old, library.where(live, new, np.nan).astype(old.dtype))

    return jax.tree.map(put, found, stored)


@jax.custom_jvp
def _exchange_value(x, value):
    """The numbers `value`, with the derivatives of x."""
    return value


@_exchange_value.defjvp
def _exchange_value_jvp(primals, tangents):
    return _exchange_value(*primals), tangents[0]


class LanePlaces(NamedTuple):
    """The positions of K times in each of N motions, with T outputs each.

    - `times`: the times, (N, K); `live`: the motion reached that time.
    - `output`: the last output at or before a time, and `is_output`: it is at that time.
    - `begin`: the output from which a run leads to a time, (N, K), and its output times `ts`: (N, K, 2), or (N, K, 3)
      where times are traced, of which the second is that time.
    """

    times: Any
    live: Any
    output: Any
    is_output: Any
    begin: Any
    ts: Any

    @property
    def are_known(self) -> bool:
        return isinstance(self.is_output, np.ndarray)

    @classmethod
    def from_trajectory(cls, run: Trajectory, times, batch: tuple[int, ...]) -> "LanePlaces":
        """The positions of times (N, K); raises `ValueError` if one lies outside of the motion."""
        ts = spread_rows(run.ts, batch, 1)
        xp: Any = np if all(map(is_concrete, (times, ts))) else jnp
        ts, times = (xp.asarray(x) for x in (ts, times))
        way = xp.where(ts[:, -1:] > ts[:, :1], 1, -1).astype(ts.dtype)
        ahead, outputs, last = way * times, way * ts, ts.shape[1] - 1
        inside = (ahead >= outputs[:, :1]) & (ahead <= outputs[:, -1:])
        if xp is np and not inside.all():
            raise ValueError(_explain_outside(ts, times, inside))
        output = xp.clip(_search_rows(xp, outputs, ahead), 0, last)
        rows = np.arange(len(ts))[:, None]
        is_output = inside & (ts[rows, output] == times)
        # As far as the motion came: a run begins at an output that was reached.
        end, code = (spread_rows(x, batch, 0)[:, None] for x in (run.end.t, run.result._value))
        known = xp is np and all(map(is_concrete, (end, code)))
        library: Any = np if known else jnp
        end, code = library.asarray(end), library.asarray(code)
        until = library.where(code == SUCCESSFUL, library.inf, way * end)
        reached = library.maximum((outputs <= until).sum(1, keepdims=True) - 1, 0)
        live, begin = inside & (ahead <= until), library.minimum(output, reached)
        if xp is np:
            first = ts[rows, begin]
            columns = first, library.where(live, times, first)
        else:
            begin = jnp.where(is_output & (begin == reached), jnp.maximum(begin - 1, 0), begin)
            first = ts[rows, begin]
            to = jnp.where(live, times, first)
            columns = first, to, jnp.where(way * to > way * first, to, ts[rows, jnp.minimum(begin + 1, last)])
        return cls(times, live, output, is_output, begin, library.stack(columns, axis=-1))


def _search_rows(xp, rows, values):
    """For values (N, K) the last index in increasing rows (N, T) whose entry is not larger; −1 if there is none."""
    if xp is jnp:
        return jax.vmap(lambda row, x: jnp.searchsorted(row, x, side="right"))(rows, values) - 1
    return np.stack([np.searchsorted(row, x, side="right") for row, x in zip(rows, values, strict=True)]) - 1


def _follow_lanes(run: Trajectory, settings: "RunSettings", ts, member: np.ndarray, state: tuple) -> PyTree:
    """q and q̇, (L, …), at the second of the times `ts` (L, ≥ 2) of runs from a state: q, q̇ and the mode at the first.

    Raises `SimulationError` if one of them is known to have failed.
    """
    (q, qdot, mode), (params, axes) = state, spread_params(run, member)
    tolerances = settings.tolerances or run.tolerances
    if any(x is not None and jnp.ndim(x) for x in tolerances or ()):
        raise ValueError("Its members have tolerances of their own: ask each of them for states between its outputs.")
    rtol, atol = tolerances or (None, None)
    engine: Any = settings.engine
    if isinstance(run.system, dict):
        modes = {name: run.system[name] for name in run.mode_names}

        def follow(q, qdot, ts, start, params):
            scene = Hybrid(modes, list(settings.transitions), start, settings.max_transitions or 0)
            return simulate_modes(scene, q, qdot, ts, params, rtol, atol, settings.max_steps, False)

        done = jax.vmap(follow, (0, 0, 0, 0, axes))(q, qdot, jnp.asarray(ts), mode, params)
        result, q, qdot = done.result._value, done.q, done.qdot
    else:
        values, none = {"q0": q, "qdot0": qdot, "params": params}, jax.tree.map(lambda _: 0, (q, qdot))
        of_leaves = dict(zip(values, (*none, axes), strict=True))
        given = Batch.from_values(run.system, values, of_leaves, len(member), ts, rtol, atol, settings.max_steps)
        batch = lift_batch(given)
        if run.system.touches:
            done = simulate_contact_batch(given, batch, settings.max_transitions, params, axes)
            result, q, qdot = done.result._value, done.q, done.qdot
        else:
            done = engine.solve_batch(batch)
            result, (q, qdot) = done.result, map(batch.member.layout.restore, halves(done.path))
    if is_concrete(result) and not np.isin(result, ENDED_WELL).all():
        lane = int(np.flatnonzero(~np.isin(result, ENDED_WELL))[0])
        why = advice(result_from(np.asarray(result)[lane]))
        text = f"The motion cannot be followed again from its output at t = {ts[lane][0]:.6g}. {why}"
        raise SimulationError(text, run)
    return jax.tree.map(lambda x: x[:, 1], (q, qdot))


# ---- axes of a batch -------------------------------------------------------------------------------------------------


def _spread_times(run: Trajectory, t, batch: tuple[int, ...]) -> tuple[Any, tuple[int, ...]]:
    """The times of each of N members, (N, K), and the leading shape of the states."""
    t = t if isinstance(t, jax.Array) else np.asarray(t)
    require_numbers(t, "t")
    require_finite(t, "t")
    t = t.astype(run.ts.dtype)
    if not batch:
        return t.reshape(1, -1), t.shape
    shape = *batch, *t.shape[-1:]
    t = t if t.ndim else t[None]
    try:
        times = (np if is_concrete(t) else jnp).broadcast_to(t, (*batch, t.shape[-1]))
    except ValueError:
        raise ValueError(
            f"t has shape {t.shape}, and the batch {batch}: give a number or times (K,) for all members, or for each "
            f"its own, which broadcast with ({', '.join(map(str, batch))}, K): K = 1 for one time each."
        ) from None
    return times.reshape(-1, t.shape[-1]), shape


# ---- what can be wrong -----------------------------------------------------------------------------------------------


def _require_settings(run: Trajectory) -> RunSettings:
    """The settings of a trajectory. Raises `ValueError` if it has none, or no scene."""
    if run.system is None or run.settings is None:
        raise ValueError(
            "This trajectory does not say how it was integrated, or of which system it is: states between its outputs "
            "are those of lagjax.simulate(system, q0, qdot0, ts, params), with their times in ts."
        )
    if run.settings.engine is None:
        raise ValueError("The numbers of its solver were being traced: take these times into ts.")
    return run.settings


def _explain_outside(ts: np.ndarray, times: np.ndarray, inside: np.ndarray) -> str:
    member, k = np.argwhere(~inside)[0]
    of = f" of member {member}" if len(ts) > 1 else ""
    return (
        f"t = {times[member, k]:.9g} lies outside of the motion{of}, from ts[0] = {ts[member, 0]:.9g} to ts[-1] = "
        f"{ts[member, -1]:.9g}: simulate to that time."
    )
