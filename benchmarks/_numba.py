"""What a careful person writes for one scene: its formulas and DOP853 in loops, compiled by numba, members in threads.

Only where the formulas are short enough to be written out by hand: pendulums, Kepler's problem, bodies. The step
control is SciPy's, with its coefficients, and a member allocates its work space once.
"""

import functools
import math

import numpy as np

from benchmarks._cases import GRAVITY, Case
from benchmarks._large import SOFTENING
from lagjax._native import cores


def _double_pendulum(y, slope):
    s, c = math.sin(y[0] - y[1]), math.cos(y[0] - y[1])
    r1 = -s * y[3] * y[3] - 2 * GRAVITY * math.sin(y[0])
    r2 = s * y[2] * y[2] - GRAVITY * math.sin(y[1])
    inverse = 1 / (2 - c * c)
    slope[0], slope[1], slope[2], slope[3] = y[2], y[3], (r1 - c * r2) * inverse, (2 * r2 - c * r1) * inverse


def _kepler(y, slope):
    square = y[0] * y[0] + y[1] * y[1]
    factor = -1 / (square * math.sqrt(square))
    slope[0], slope[1], slope[2], slope[3] = y[2], y[3], factor * y[0], factor * y[1]


def _chain(y, slope):
    n = len(y) // 2
    mass, force = np.empty((n, n)), np.zeros(n)
    for i in range(n):
        for j in range(n):
            below, difference = n - max(i, j), y[i] - y[j]
            mass[i, j] = below * math.cos(difference)
            force[i] -= below * math.sin(difference) * y[n + j] ** 2
        force[i] -= GRAVITY * (n - i) * math.sin(y[i])
    slope[:n], slope[n:] = y[n:], np.linalg.solve(mass, force)


def _bodies(y, slope):
    n = len(y) // 2
    slope[:n], slope[n:] = y[n:], 0.0
    for a in range(0, n, 3):
        for b in range(0, a, 3):
            x, y_, z = y[b] - y[a], y[b + 1] - y[a + 1], y[b + 2] - y[a + 2]
            squared = x * x + y_ * y_ + z * z + SOFTENING**2
            pull = 3.0 / n / (squared * math.sqrt(squared))  # equal masses, together 1
            slope[n + a] += pull * x
            slope[n + a + 1] += pull * y_
            slope[n + a + 2] += pull * z
            slope[n + b] -= pull * x
            slope[n + b + 1] -= pull * y_
            slope[n + b + 2] -= pull * z


FIELDS = {"double_pendulum": _double_pendulum, "kepler": _kepler, "chain": _chain, "bodies": _bodies}


def _field_of(case: Case) -> str:
    return case.name if case.name in FIELDS else case.name.partition("_")[0]


def why_not(case: Case) -> str | None:
    return None if _field_of(case) in FIELDS else "nobody writes this scene out for numba"


def prepare(case: Case):
    import numba

    run, states = _compiled(_field_of(case)), np.ascontiguousarray(case.states)

    def solve(tol):
        numba.set_num_threads(cores())
        return run(states, case.duration, tol)

    return solve


@functools.cache
def _compiled(name: str):
    """`(states, duration, tol) -> states, steps` of all members."""
    import numba
    from scipy.integrate._ivp import dop853_coefficients as dop853

    field = numba.njit(FIELDS[name])
    A, B, E3, E5 = dop853.A[:12, :12].copy(), dop853.B, dop853.E3, dop853.E5

    @numba.njit
    def member(y, duration, tol, K, trial):
        n, t, steps, rejected = len(y), 0.0, 0, False
        field(y, K[0])
        size, slope = 0.0, 0.0
        for i in range(n):
            size, slope = size + (y[i] / (tol + tol * abs(y[i]))) ** 2, slope + (K[0, i] / (tol + tol * abs(y[i]))) ** 2
        h = min(duration, 0.01 * math.sqrt(size / max(slope, 1e-300)))
        while t < duration:
            h, steps = min(h, duration - t), steps + 1
            for stage in range(1, 13):
                for i in range(n):
                    total = 0.0
                    for j in range(stage):
                        total += (A[stage, j] if stage < 12 else B[j]) * K[j, i]
                    trial[i] = y[i] + h * total
                field(trial, K[stage])
            third = fifth = 0.0
            for i in range(n):
                scale, e3, e5 = tol + tol * max(abs(y[i]), abs(trial[i])), 0.0, 0.0
                for j in range(13):
                    e3, e5 = e3 + E3[j] * K[j, i], e5 + E5[j] * K[j, i]
                third, fifth = third + (e3 / scale) ** 2, fifth + (e5 / scale) ** 2
            error = 0.0 if fifth == 0.0 else h * fifth / math.sqrt((fifth + 0.01 * third) * n)
            factor = min(10.0, max(0.2, 0.9 * max(error, 1e-30) ** -0.125))
            if error < 1.0:
                t = duration if h == duration - t else t + h
                y[:], K[0] = trial, K[12]
                h, rejected = h * (min(1.0, factor) if rejected else factor), False
            else:
                h, rejected = h * min(1.0, factor), True
            if not h > 1e-14 * duration:  # also where h is NaN
                y[:] = np.nan
                break
        return steps

    @numba.njit(parallel=True)
    def members(states, duration, tol):
        final, steps = states.copy(), np.empty(len(states), np.int64)
        for i in numba.prange(len(states)):
            K, trial = np.empty((13, states.shape[1])), np.empty(states.shape[1])
            steps[i] = member(final[i], duration, tol, K, trial)
        return final, steps

    return members
