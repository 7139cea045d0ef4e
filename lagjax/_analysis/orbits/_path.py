"""`action` and `find_path`: the path between two configurations, its action, and whether that is a minimum.

A path of Hamilton's principle joins q_start at one time to q_end at another. It is found by the multiple shooting of
`_shooting`: states at equal parts of the time, joined by motions, with q given at both ends. Its action is a minimum if
there are no conjugate points, where neighbouring paths from the same start meet again: as many as there are on the way,
as many independent variations lower the action (Morse).

The paths from one start with all velocities are a Lagrangian plane, (∂q/∂q̇₀, ∂p/∂q̇₀) = (B, D), and a time is
conjugate where B is singular, as often as its rank falls. To look for zeros of det B would miss double ones, such as
those of an oscillator that is the same in two directions. The eigenvalues of the unitary matrix (D + iB)(D − iB)⁻¹ turn
all in one sense through 1 where that happens, if M is positive definite, so that none is missed and each counts as
often as it is.

Source: Gelfand & Fomin, *Calculus of Variations*, §26–29; Milnor, *Morse Theory*, §15; Stoer & Bulirsch, §7.3.5;
Arnold, *On a characteristic class entering in quantization conditions*, Funct. Anal. Appl. 1 (1967) 1; Duistermaat, *On
the Morse index in variational calculus*, Adv. Math. 21 (1976) 173.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._analysis.orbits._arc_motions import Arcs, Units
from lagjax._analysis.orbits._shooting import Chain, Closing, close_chains, condense_equations
from lagjax._engine import concatenate_leaves
from lagjax._equations import truncated_svd
from lagjax._interface import Layout, SimulationError, as_arrays, halves, require_finite, require_flag, require_number
from lagjax._primitives import accepts_singles
from lagjax._run import Trajectory, simulate
from lagjax._scene import System, require_system

RTOL = 1e-14
_ARCS = 8
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
    - `closure` (): the largest defect, as a fraction of the size of the ends and the velocities that join them; `ok`,
      and `message`, a sentence that says why not.
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
        ts, states = _states_of_motion(system, path, params)
    else:
        ts, states = _states_of_function(path, t_start, t_end)
    halved = np.sort(np.concatenate([ts, (ts[1:] + ts[:-1]) / 2]))[:: 1 if ts[-1] > ts[0] else -1]

    def lagrangians(times):
        q, qdot = states(times := jnp.asarray(times))
        return jax.vmap(lambda q, qdot, t: system.lagrangian(q, qdot, t=t, params=params))(q, qdot, times)

    coarse, fine = (_action_integral(lagrangians, edges) for edges in (ts, halved))
    if not abs(float(coarse[0] - fine[0])) <= _RESOLVED * abs(float(fine[1])):
        raise ValueError(
            f"The action is not resolved: {float(coarse[0]):.9g} and, on parts half as long, {float(fine[0]):.9g}. The "
            "path has features narrower than that, or corners: give a trajectory with more output times, or take the "
            "parts between corners one by one."
        )
    return fine[0]


def _states_of_motion(system: System, path: Trajectory, params) -> tuple[np.ndarray, Callable]:
    """Return the output times of a trajectory, and a function that computes (q, q̇) at times between."""
    q, qdot = jax.tree.map(lambda x: x[0], (path.q, path.qdot))

    def states(times):
        run = simulate(system, q, qdot, jnp.concatenate([path.ts[:1], times]), params, rtol=RTOL)
        return jax.tree.map(lambda x: x[1:], (run.q, run.qdot))

    return np.asarray(path.ts), states


def _states_of_function(path, t_start, t_end) -> tuple[np.ndarray, Callable]:
    """Return the edges of equal parts of the time, and a function that gives (q, q̇) of `path` at times."""
    if not callable(path):
        raise TypeError(f"path must be a Trajectory, or a function of the time; got {type(path).__name__}.")
    for value, name in ((t_start, "t_start"), (t_end, "t_end")):
        require_number(value, name)

    def states(times):
        return jax.vmap(lambda t: jax.jvp(path, (t,), (jnp.ones_like(t),)))(times)

    return np.linspace(float(t_start), float(t_end), _PANELS + 1), states


def _action_integral(lagrangians: Callable, edges: np.ndarray) -> tuple[Any, Any]:
    """Return ∫ L dt and ∫ |L| dt over the intervals between these edges; `lagrangians` gives L at times (T,)."""
    half = np.diff(edges)[:, None] / 2
    times = edges[:-1, None] + half * (1 + _NODES)
    values = lagrangians(times.ravel()).reshape(times.shape) * half
    return (values @ _WEIGHTS).sum(), (abs(values) @ _WEIGHTS).sum()


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
        if name.startswith("t"):
            require_number(value, name)
    if not t_end > t_start:
        raise ValueError(f"t_end must be later than t_start; got {t_end} and {t_start}.")
    layout = Layout.from_state(q_start, q_end)
    arcs = Arcs.from_system(system, layout, params, RTOL, "Paths")
    leaves = [jax.tree.leaves(as_arrays(q, layout.dtype, "state")) for q in (q_start, q_end)]
    ends = [np.asarray(concatenate_leaves(of_one, np.dtype(float))) for of_one in leaves]
    times = np.linspace(float(t_start), float(t_end), _ARCS + 1)
    first = _guess_states(layout, guess, ends, times)
    closing = Closing.from_arcs(arcs)._replace(t_first=times[0], q_end=ends[1])
    parts = np.linspace(0.0, 1.0, _ARCS + 1)[None]
    chain = close_chains(closing, first[None], times[-1:] - times[:1], parts, _path_units(arcs, first, ends, times))
    message = _explain_no_path(closing, chain, times)
    if message:
        if throw:
            raise SimulationError(message, None)
        lost, closure = jnp.asarray(np.nan), jnp.asarray(chain.closure()[0])
        return Path(None, None, None, lost, jnp.zeros(0), -1, False, closure, False, message)
    return _build_path(system, arcs, chain, ends[0], times, params)


def _path_units(arcs: Arcs, y, ends, times) -> Units:
    """Return the units of the first state, (1, 2n), with the farther one of both ends as the size of q."""
    n, duration, farther = arcs.size, times[-1:] - times[:1], np.abs(ends).max(axis=0)
    velocity = np.maximum(np.abs(y[0, n:]), np.abs(ends[1] - ends[0]) / duration)
    here = arcs.units(y[:1], duration)
    root = here.length[:, None] / here.state[:, :n]
    length = np.maximum((farther * root).max(axis=1), (velocity * root).max(axis=1) * duration) or 1.0
    return Units(np.concatenate([length / root, length / root / duration], axis=1), duration, np.ravel(length))


def _guess_states(layout: Layout, guess, ends, times) -> np.ndarray:
    """Return the guessed states (K, 2n) at the first times of the arcs."""
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


def _explain_no_path(closing: Closing, chain: Chain, times) -> str:
    between = f"between t = {times[0]:.6g} and {times[-1]:.6g}"
    if not chain.ok[0]:
        return (
            f"No path was found {between}: from the guess the motion cannot be followed. Give another guess=..., a "
            f"function of the time. {chain.why[0]}"
        )
    missed = float(chain.closure()[0])
    if missed <= _CLOSED:
        return ""
    singular = condense_equations(closing, chain).decided.rank[0] < chain.y.shape[2]
    end = " The ends are conjugate to each other: neighbouring paths all meet there, or none does." if singular else ""
    return (
        f"No path was found {between}: the motions that were tried miss each other by {missed:.2g} of their "
        f"size. There may be none, or it may be far from the guess: give another guess=..., a function of time.{end}"
    )


def _build_path(system: System, arcs: Arcs, chain: Chain, q_start: np.ndarray, times, params) -> Path:
    restore, states = arcs.layout.restore, chain.y[0] * chain.units.state
    states[0, : arcs.size] = q_start  # exactly, not by way of the units
    conjugate, at_end = _conjugate_times(arcs, states, times, chain.units)
    (q, qdot), end = map(restore, halves(states[0])), arcs.integrate(times[-2:][None], states[-1:]).path[0, -1]
    qdot, qdot_end = jax.tree.map(jnp.asarray, (qdot, restore(end[arcs.size :])))
    ts = np.linspace(times[0], times[-1], 16 * _ARCS + 1)
    trajectory = simulate(system, q, qdot, ts, params, rtol=RTOL, throw=False)
    total = sum(_arc_action(arcs, y, t0, t1) for y, t0, t1 in zip(states, times[:-1], times[1:], strict=True))
    index, numbers = len(conjugate), map(jnp.asarray, (total, conjugate, chain.closure()[0]))
    total, conjugate, closure = numbers
    return Path(qdot, qdot_end, trajectory, total, conjugate, index, (index == 0 and not at_end), closure, True, "")


def _arc_action(arcs: Arcs, y, t_first, t_last) -> float:
    """Return ∫ L dt along one arc, on eight intervals."""

    def lagrangians(times):
        path = arcs.integrate(np.append(t_first, times)[None], y[None]).path[0, 1:]
        return arcs.sample(times, path).quantities("lagrangian")["lagrangian"]

    return float(_action_integral(lagrangians, np.linspace(t_first, t_last, 9))[0])


# ---- conjugate times -------------------------------------------------------------------------------------------------

_GLANCES = 64  # of each arc: between two of them no phase may turn by half a turn
_TRIALS = 60  # bisections, which end at the rounding of the time
_AT_END = 1e-9  # of the time: a conjugate time so near to the end counts as the end


def _conjugate_times(arcs: Arcs, y: np.ndarray, times: np.ndarray, units: Units) -> tuple[np.ndarray, bool]:
    """Return the conjugate times (k,) before the last time, ascending, and whether the last time is one.

    The path is arcs from states `y` (K, 2n) at `times` (K + 1,); tangents are in the `units` (1, 2n) of states.
    """
    n, found, duration = arcs.size, [], times[-1] - times[0]
    frame = np.concatenate([np.zeros((n, n)), np.eye(n)])  # (δq, δq̇) of all velocities
    for k, start in enumerate(y):
        ts = np.linspace(times[k], times[k + 1], _GLANCES + 1)
        frames = _tangent_frames(arcs, start, ts, frame, units)
        phases = _plane_phases(arcs, _states_on_arcs(arcs, start, ts), ts, frames, units)
        for j in range(k == 0, _GLANCES):  # without the start itself, where all paths meet
            for nth in range(_count_turns(phases[j], phases[j + 1])):
                found.append(_locate_conjugate_time(arcs, start, ts[0], ts[j], ts[j + 1], frame, frames[j], nth, units))
        frame = frames[-1]
    found = np.sort(np.array(found))
    singular = (
        truncated_svd(frame[:n], absolute=_AT_END).rank < n
    )  # the first rows B of an orthonormal plane, to rounding
    at_end = bool((found > times[-1] - _AT_END * duration).any() or singular)
    return found[found <= times[-1] - _AT_END * duration], at_end


def _tangent_frames(arcs: Arcs, start, ts, frame, units: Units) -> np.ndarray:
    """Return the tangents (T, 2n, n) at times (T,) that begin as `frame` at the first one."""
    times = np.stack([np.full(len(ts) - 1, ts[0]), ts[1:]], axis=1)
    arc = arcs.differentiate(times, np.repeat(start[None], len(times), axis=0))
    # The plane is what counts: its vectors are made orthonormal, so that none outgrows the others.
    return np.linalg.qr(np.concatenate([frame[None], units.scale_growth(arc.by_start) @ frame]))[0]


def _plane_phases(arcs: Arcs, y, t, frames, units: Units) -> np.ndarray:
    """Return the phases (T, n), ascending in [0, 2π), of the unitary matrices of planes (T, 2n, n) at y (T, 2n)."""
    n = arcs.size
    canonical = np.linalg.qr(arcs.canonical_charts(t, y, units) @ frames)[0]
    b, d = canonical[:, :n], canonical[:, n:]
    unitary = (d + 1j * b) @ np.linalg.inv(d - 1j * b)
    return np.sort(np.mod(np.angle(np.linalg.eigvals(unitary)), 2 * np.pi), axis=1)


def _states_on_arcs(arcs: Arcs, start, ts) -> np.ndarray:
    return arcs.integrate(ts[None], start[None]).path[0]


def _count_turns(before: np.ndarray, after: np.ndarray) -> int:
    """Return how many phases passed 2π between two sets of n that lie near each other on the circle."""
    shifts = [np.concatenate([after[k:], after[:k] + 2 * np.pi]) - before for k in range(len(before) + 1)]
    return int(np.argmin([np.abs(shift).max() for shift in shifts]))


def _locate_conjugate_time(arcs: Arcs, start, t_first, low, high, frame, frame_low, nth: int, units: Units) -> float:
    """Return the nth conjugate time, counted from 0, between `low` and `high`, by bisection."""
    state = _states_on_arcs(arcs, start, np.array([t_first, low]))[-1:] if low > t_first else start[None]
    before = _plane_phases(arcs, state, np.array([low]), frame_low[None], units)[0]
    for _ in range(_TRIALS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        ts = np.array([t_first, middle])
        frames = _tangent_frames(arcs, start, ts, frame, units)[1:]
        after = _plane_phases(arcs, _states_on_arcs(arcs, start, ts)[1:], ts[1:], frames, units)[0]
        low, high = (low, middle) if _count_turns(before, after) > nth else (middle, high)
    return float((low + high) / 2)
