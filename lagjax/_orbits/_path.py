"""`action` and `find_path`: the path between two configurations, what its action is, and whether that is least.

A path of Hamilton's principle joins q_start at one time to q_end at another. It is found by multiple shooting: states
at equal parts of the time, joined by motions, of which the first and the last have their q given. Whether its action is
a minimum is told by conjugate points, where neighbouring paths from the same start meet again: as many as there are on
the way, as many independent variations lower the action (Morse).

Source: Gelfand & Fomin, *Calculus of Variations*, §26–29; Milnor, *Morse Theory*, §15; Stoer & Bulirsch, §7.3.5.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._doubles import accepts_singles
from lagjax._layout import Layout, halves
from lagjax._orbits._arcs import Arc, Arcs, Units
from lagjax._orbits._conjugate import conjugate_times
from lagjax._problem import end_to_end
from lagjax._results import SimulationError
from lagjax._simulate import simulate
from lagjax._system import System, require_system
from lagjax._trajectory import Trajectory
from lagjax._validate import as_arrays, require_finite, require_flag, require_number

PyTree = Any

RTOL = 1e-14
_ARCS, _TRIALS, _HALVINGS = 8, 60, 10
_CLOSED = 1e-10  # the largest defect of a path, of the size of its states
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)  # of each of as many panels as there are outputs, or `_PANELS`
_PANELS, _RESOLVED = 64, 1e-9


class Path(NamedTuple):
    """A motion from `q_start` to `q_end`.

    - `qdot_start`, `qdot_end`: the velocities there, in the user's structure; `trajectory`: the motion, at 129 times.
    - `action` (): ∫ L dt.
    - `conjugate_times` (k,): when neighbouring paths from the start meet this one again, repeated by multiplicity.
    - `index`: how many independent variations with fixed ends lower the action: the conjugate times before the end.
    - `minimum`: whether the action is least among nearby paths (`index` 0, and the end not conjugate); otherwise it is
      a saddle.
    - `closure` (): the largest defect, in parts of the size of the ends and of the velocities that join them; `ok`, and
      `message`, a sentence that says why not.
    """

    qdot_start: PyTree
    qdot_end: PyTree
    trajectory: Trajectory | None
    action: jax.Array
    conjugate_times: jax.Array
    index: int
    minimum: bool
    closure: jax.Array
    ok: bool
    message: str

    def __repr__(self) -> str:
        """Two lines: its action and what kind of extremum that is, and how well it joins; or why there is none."""
        if not self.ok:
            return f"Path: none was found. {self.message}"
        kind = "a minimum" if self.minimum else f"a saddle of index {self.index}"
        met = len(self.conjugate_times)
        return (
            f"Path: action {float(self.action):.9g}, {kind} among nearby paths, {met} conjugate times\n"
            f"joined to {float(self.closure):.2g} of its size"
        )


def action(system: System, path: Trajectory | Callable, t_start=None, t_end=None, params: PyTree = None) -> jax.Array:
    """∫ L(q, q̇, t) dt along a `path`, a scalar.

    - `path`: a `Trajectory` of this system, whose motion is followed once more between its first and last time; or a
      function of the time that returns q, between `t_start` and `t_end`, whether it is a motion or not. Its velocity
      is its derivative by JAX.

    The integral is a ten-point Gauss rule between neighbouring outputs of the trajectory, or on 64 equal parts.

    **Raises** `ValueError` where twice as many parts give a different value: the path is not resolved, or not smooth.

    ```python
    import jax.numpy as jnp, lagjax

    oscillator = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    lagjax.action(oscillator, jnp.cos, 0.0, 1.0)  # −sin(2)/4
    ```
    """
    system = require_system(system)
    if isinstance(path, Trajectory):
        params = path.params if params is None else params
        ts, states = _along_motion(system, path, params)
    else:
        ts, states = _along_function(path, t_start, t_end)
    coarse, fine = (_integral(system, states, edges, params) for edges in (ts, _halved(ts)))
    if not abs(float(coarse[0] - fine[0])) <= _RESOLVED * abs(float(fine[1])):
        raise ValueError(
            f"The action is not resolved: {float(coarse[0]):.9g} and, on parts half as long, {float(fine[0]):.9g}. The "
            "path has features narrower than that, or corners: give a trajectory with more output times, or take the "
            "parts between corners one by one."
        )
    return fine[0]


def _along_motion(system: System, path: Trajectory, params) -> tuple[np.ndarray, Callable]:
    """The times of outputs, and what gives (q, q̇) of a motion at times between."""
    q, qdot = jax.tree.map(lambda x: x[0], (path.q, path.qdot))

    def states(times):
        run = simulate(system, q, qdot, jnp.concatenate([path.ts[:1], times]), params, rtol=RTOL)
        return jax.tree.map(lambda x: x[1:], (run.q, run.qdot))

    return np.asarray(path.ts), states


def _along_function(path, t_start, t_end) -> tuple[np.ndarray, Callable]:
    """The edges of equal parts of the time, and what gives (q, q̇) of a function of the time."""
    if not callable(path):
        raise TypeError(f"path must be a Trajectory, or a function of the time; got {type(path).__name__}.")
    for value, name in ((t_start, "t_start"), (t_end, "t_end")):
        require_number(value, name)

    def states(times):
        return jax.vmap(lambda t: jax.jvp(path, (t,), (jnp.ones_like(t),)))(times)

    return np.linspace(float(t_start), float(t_end), _PANELS + 1), states


def _halved(ts: np.ndarray) -> np.ndarray:
    return np.sort(np.concatenate([ts, (ts[1:] + ts[:-1]) / 2]))[:: 1 if ts[-1] > ts[0] else -1]


def _integral(system: System, states: Callable, edges: np.ndarray, params) -> tuple[jax.Array, jax.Array]:
    """∫ L dt and ∫ |L| dt over panels between these edges."""
    half = np.diff(edges) / 2
    times = (edges[:-1] + half)[:, None] + half[:, None] * _NODES
    q, qdot = states(jnp.asarray(times.ravel()))

    def lagrangian(q, qdot, t):
        return system.lagrangian(q, qdot, t=t, params=params)

    values = jax.vmap(lagrangian)(q, qdot, jnp.asarray(times.ravel())).reshape(times.shape) * half[:, None]
    return jnp.sum(values @ _WEIGHTS), jnp.sum(jnp.abs(values) @ _WEIGHTS)


@accepts_singles(("q_start", "q_end"), ("params",))
def find_path(
    system: System,
    q_start: PyTree,
    q_end: PyTree,
    t_start: float,
    t_end: float,
    params: PyTree = None,
    *,
    guess: Callable | None = None,
    throw: bool = True,
) -> Path:
    """The motion of `system` that is at `q_start` at `t_start` and at `q_end` at `t_end`.

    There may be several such motions, or none. Which one is found depends on `guess`, a function of the time that
    returns q; by default a straight line. The search is multiple shooting: Newton's method on the states at the ends of
    eight equal parts of the time.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, for a scene with constraints or without
    machine code; `SimulationError` where no path is found, unless `throw` is False.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    ball = lagjax.System(lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1])
    path = lagjax.find_path(ball, jnp.zeros(2), jnp.array([10.0, 0.0]), 0.0, 2.0)  # thrown with 9.81 upwards
    ```
    """
    require_flag(throw, "throw")
    for name, value in (("q_start", q_start), ("q_end", q_end), ("t_start", t_start), ("t_end", t_end)):
        require_finite(value, name)
    for name, value in (("t_start", t_start), ("t_end", t_end)):
        require_number(value, name)
    if not t_end > t_start:
        raise ValueError(f"t_end must be later than t_start; got {t_end} and {t_start}.")
    layout = Layout.of(q_start, q_end)
    arcs = Arcs.of(system, q_start, q_end, params, RTOL, "Paths")
    ends = [
        np.asarray(end_to_end(jax.tree.leaves(as_arrays(q, layout.dtype)), np.dtype(float))) for q in (q_start, q_end)
    ]
    times = np.linspace(float(t_start), float(t_end), _ARCS + 1)
    first = _guessed(layout, guess, ends, times)
    joined = _joined(arcs, times, first, ends, _units(arcs, first, ends, times))
    message = _why_not(arcs, joined, times)
    if message:
        if throw:
            raise SimulationError(message, None)
        return _nothing(joined, message)
    return _told(system, arcs, joined, times, params)


def _units(arcs: Arcs, y, ends, times) -> Units:
    """The units of the first state, (1, 2n), with the farther one of both ends as the size of q."""
    n, duration = arcs.size, times[-1:] - times[:1]
    farther = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    velocity = np.maximum(np.abs(y[0, n:]), np.abs(ends[1] - ends[0]) / duration)
    here = arcs.units(y[:1], duration)
    root = here.length[:, None] / here.state[:, :n]
    length = np.maximum((farther * root).max(axis=1), (velocity * root).max(axis=1) * duration) or 1.0
    return Units(np.concatenate([length / root, length / root / duration], axis=1), duration, np.ravel(length))


class _Joined(NamedTuple):
    """States `y` (K, 2n) at the first times of K arcs, the arcs, and the defects (K, 2n), in the end of q alone.

    The defects are in `units` (1, 2n), the others in those of the user.
    """

    y: np.ndarray
    arc: Arc
    defect: np.ndarray
    units: Units

    def size(self) -> float:
        return float(np.abs(self.defect).max()) if self.arc.ok.all() else np.inf


def _guessed(layout: Layout, guess, ends, times) -> np.ndarray:
    """States (K, 2n) at the first times of the arcs."""
    q_start, q_end = ends
    if guess is None:
        slope = (q_end - q_start) / (times[-1] - times[0])
        return np.stack([np.concatenate([q_start + slope * (t - times[0]), slope]) for t in times[:-1]])

    def state(t):
        q, qdot = jax.jvp(guess, (t,), (jnp.ones_like(t),))
        return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

    y = np.stack([np.asarray(state(jnp.asarray(t))) for t in times[:-1]])
    y[0, : len(q_start)] = q_start
    return y


def _followed(arcs: Arcs, times, y, ends, units: Units) -> _Joined:
    arc = arcs.follow(np.stack([times[:-1], times[1:]], axis=1), y)
    n = arcs.size
    target = np.concatenate([y[1:], np.concatenate([ends[1], arc.end[-1, n:]])[None]])
    return _Joined(y, arc, (arc.end - target) / units.state, units)


def _joined(arcs: Arcs, times, y, ends, units: Units) -> _Joined:
    """The arcs that join, as far as they do, by Newton's method with steps that are shortened until defects fall."""
    joined = _followed(arcs, times, y, ends, units)
    for _ in range(_TRIALS):
        size = joined.size()
        if not np.isfinite(size) or size <= 1e-15:
            break
        step = _step(joined, arcs.size)
        if step is None:
            break
        for halving in range(_HALVINGS):
            trial = _followed(arcs, times, joined.y + 0.5**halving * step, ends, units)
            if trial.size() < (1 - 0.25 * 0.5**halving) * size:
                break
        if not trial.size() < 0.9 * size:
            return min(joined, trial, key=_Joined.size)
        joined = trial
    return joined


def _step(joined: _Joined, n: int) -> np.ndarray | None:
    """The step (K, 2n) of Newton's method, whose first q is zero; None where the equations are singular."""
    count, states = joined.y.shape
    matrix = np.zeros((count * states, count * states))
    for k in range(count):
        rows = slice(k * states, (k + 1) * states)
        matrix[rows, rows] = joined.units.growth(joined.arc.by_start[k : k + 1])[0]
        if k + 1 < count:
            matrix[rows, (k + 1) * states : (k + 2) * states] = -np.eye(states)
    # Without the columns of the first q, which is given, and the rows of the last q̇, which is not.
    matrix, right = matrix[:-n, n:], -joined.defect.ravel()[:-n]
    values = np.linalg.svd(matrix, compute_uv=False)
    if not values[-1] > len(values) * np.finfo(float).eps * values[0]:
        return None
    step = np.concatenate([np.zeros(n), np.linalg.solve(matrix, right)]).reshape(count, states)
    return step * joined.units.state


def _why_not(arcs: Arcs, joined: _Joined, times) -> str:
    """Why no path was found; "" where one was."""
    between = f"between t = {times[0]:.6g} and {times[-1]:.6g}"
    if not joined.arc.ok.all():
        row = int(np.argmin(joined.arc.ok))
        return (
            f"No path was found {between}: from the guess the motion cannot be followed. Give another guess=..., a "
            f"function of the time. {arcs.why_not(row, joined.arc, joined.y, times[row + 1])}"
        )
    if joined.size() <= _CLOSED:
        return ""
    singular = _step(joined, arcs.size) is None
    end = " The ends are conjugate to each other: neighbouring paths all meet there, or none does." if singular else ""
    return (
        f"No path was found {between}: the motions that were tried miss each other by {joined.size():.2g} of their "
        f"size. There may be none, or it may be far from the guess: give another guess=..., a function of time.{end}"
    )


def _nothing(joined: _Joined, message: str) -> Path:
    lost = jnp.asarray(np.nan)
    return Path(None, None, None, lost, jnp.zeros(0), -1, False, jnp.asarray(joined.size()), False, message)


def _told(system: System, arcs: Arcs, joined: _Joined, times, params) -> Path:
    """The path in the user's structure, with its action and its second variation."""
    restore = arcs.layout.restore
    conjugate, at_end = conjugate_times(arcs, joined.y, times, joined.units)
    (q, qdot), qdot_end = map(restore, halves(joined.y[0])), restore(joined.arc.end[-1, arcs.size :])
    ts = np.linspace(times[0], times[-1], 16 * _ARCS + 1)
    trajectory = simulate(system, q, qdot, ts, params, rtol=RTOL, throw=False)
    total = sum(_arc_action(arcs, y, t0, t1) for y, t0, t1 in zip(joined.y, times[:-1], times[1:], strict=True))
    index = len(conjugate)
    return Path(
        jax.tree.map(jnp.asarray, qdot), jax.tree.map(jnp.asarray, qdot_end), trajectory, jnp.asarray(total),
        jnp.asarray(conjugate), index, index == 0 and not at_end, jnp.asarray(joined.size()), True, "",
    )  # fmt: skip


def _arc_action(arcs: Arcs, y, t_first, t_last) -> float:
    """∫ L dt along one arc, on eight panels."""
    edges = np.linspace(t_first, t_last, 9)
    half = np.diff(edges) / 2
    times = ((edges[:-1] + half)[:, None] + half[:, None] * _NODES).ravel()
    path = arcs.ends(np.append(t_first, times)[None], y[None]).path[0, 1:]
    values = arcs.quantities(("lagrangian",), times, path)["lagrangian"].reshape(len(half), -1)
    return float(half @ values @ _WEIGHTS)
