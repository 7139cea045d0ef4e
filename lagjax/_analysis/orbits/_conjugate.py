"""Conjugate times of a path: when neighbouring paths from the same start meet it again.

The paths from one start with all velocities are a Lagrangian plane, (∂q/∂q̇₀, ∂p/∂q̇₀) = (B, D), and a time is conjugate
where B is singular, as often as its rank falls. To look for zeros of det B would miss double ones, such as those of an
oscillator that is the same in two directions. The eigenvalues of the unitary matrix (D + iB)(D − iB)⁻¹ turn all in one
sense through 1 where that happens, if M is positive definite, so that none is missed and each counts as often as it is.

Source: Arnold, *On a characteristic class entering in quantization conditions*, Funct. Anal. Appl. 1 (1967) 1;
Duistermaat, *On the Morse index in variational calculus*, Adv. Math. 21 (1976) 173.
"""

import numpy as np

from lagjax._analysis.orbits._arc_motions import Arcs, Units
from lagjax._equations import decide

_GLANCES = 64  # of each arc: between two of them no phase may turn by half a turn
_TRIALS = 60  # bisections, which end at the rounding of the time
_AT_END = 1e-9  # of the time: a conjugate time so near to the end counts as the end


def conjugate_times(arcs: Arcs, y: np.ndarray, times: np.ndarray, units: Units) -> tuple[np.ndarray, bool]:
    """The conjugate times (k,) before the last time, ascending, and whether the last time is one. The path is arcs from
    states `y` (K, 2n) at `times` (K + 1,); tangents are in the `units` (1, 2n) of states."""
    n, found, duration = arcs.size, [], times[-1] - times[0]
    frame = np.concatenate([np.zeros((n, n)), np.eye(n)])  # (δq, δq̇) of all velocities
    for k, start in enumerate(y):
        ts = np.linspace(times[k], times[k + 1], _GLANCES + 1)
        frames = _frames(arcs, start, ts, frame, units)
        phases = _phases(arcs, _states(arcs, start, ts), ts, frames, units)
        for j in range(k == 0, _GLANCES):  # without the start itself, where all paths meet
            for nth in range(_count_turns(phases[j], phases[j + 1])):
                found.append(_locate_conjugate_time(arcs, start, ts[0], ts[j], ts[j + 1], frame, frames[j], nth, units))
        frame = frames[-1]
    found = np.sort(np.array(found))
    singular = decide(frame[:n], absolute=_AT_END).rank < n  # the first rows B of an orthonormal plane, to rounding
    at_end = bool((found > times[-1] - _AT_END * duration).any() or singular)
    return found[found <= times[-1] - _AT_END * duration], at_end


def _frames(arcs: Arcs, start, ts, frame, units: Units) -> np.ndarray:
    """The tangents (T, 2n, n) at times (T,) that begin as `frame` at the first one."""
    times = np.stack([np.full(len(ts) - 1, ts[0]), ts[1:]], axis=1)
    arc = arcs.follow(times, np.repeat(start[None], len(times), axis=0))
    # The plane is what counts: its vectors are made orthonormal, so that none outgrows the others.
    return np.linalg.qr(np.concatenate([frame[None], units.growth(arc.by_start) @ frame]))[0]


def _phases(arcs: Arcs, y, t, frames, units: Units) -> np.ndarray:
    """The phases (T, n), ascending in [0, 2π), of the unitary matrices of planes (T, 2n, n) at states y (T, 2n)."""
    n = arcs.size
    canonical = np.linalg.qr(arcs.canonical(t, y, units) @ frames)[0]
    b, d = canonical[:, :n], canonical[:, n:]
    unitary = (d + 1j * b) @ np.linalg.inv(d - 1j * b)
    return np.sort(np.mod(np.angle(np.linalg.eigvals(unitary)), 2 * np.pi), axis=1)


def _states(arcs: Arcs, start, ts) -> np.ndarray:
    return arcs.ends(ts[None], start[None]).path[0]


def _count_turns(before: np.ndarray, after: np.ndarray) -> int:
    """The number of phases that passed 2π between two sets of n that lie near each other on the circle."""
    shifts = [np.concatenate([after[k:], after[:k] + 2 * np.pi]) - before for k in range(len(before) + 1)]
    return int(np.argmin([np.abs(shift).max() for shift in shifts]))


def _locate_conjugate_time(arcs: Arcs, start, t_first, low, high, frame, frame_low, nth: int, units: Units) -> float:
    """The time of the nth conjugate time between `low` and `high`, counted from 0, by bisection."""
    state = _states(arcs, start, np.array([t_first, low]))[-1:] if low > t_first else start[None]
    before = _phases(arcs, state, np.array([low]), frame_low[None], units)[0]
    for _ in range(_TRIALS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        ts = np.array([t_first, middle])
        frames = _frames(arcs, start, ts, frame, units)[1:]
        after = _phases(arcs, _states(arcs, start, ts)[1:], ts[1:], frames, units)[0]
        low, high = (low, middle) if _count_turns(before, after) > nth else (middle, high)
    return float((low + high) / 2)
