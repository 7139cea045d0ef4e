"""Periodic orbits of three equal masses in their published form, refined to 20 digits by Newton's method.

    φ_T(y) = y,   y = (place, shape w)

Unknown are w = 3 (v1, v2) and T: eight equations for three numbers, which are consistent because the energy and the
angular momentum are conserved and the start is symmetric. One motion over the whole period is followed with 32 digits
(`_orbits_extended`), so that an error that grows a millionfold still closes; derivatives by w are differences of such.
"""

from typing import NamedTuple

import numpy as np

from benchmarks import _orbits_extended as extended

TRIALS = 6
ENOUGH = 1e-17  # of φ_T(y) − y, and of the last change of w and T in parts of themselves
NEARBY = 1e-16  # of w, for differences: of 32 digits this leaves ten to the derivative


class Refined(NamedTuple):
    """N orbits: `w` (N, 2, 2) and `period` (N, 2) as double-doubles, and how well they are known.

    `closure` (N,) is the largest number of φ_T(y) − y, `step` (N,) the last change of w and T in parts of themselves.
    `floor` (N,) is what φ_T(y) − y can be for a start rounded to doubles: half a unit in the last place of each number,
    as far as the derivatives by w and T tell.
    """

    w: np.ndarray
    period: np.ndarray
    closure: np.ndarray
    step: np.ndarray
    floor: np.ndarray


def refined(place, shape, v, period, work) -> Refined:
    """The orbits near velocities `v` (N, 2) and periods (N,); of as much `work` (N,) are those followed together.

    A start has the positions `place` (N, 4) and the velocities `shape` (N, 4, 2) @ (3 v) relative to the centre.
    """
    w, period = (np.stack([x, np.zeros_like(x)], axis=1) for x in (3 * v, period))
    closure, step, floor = np.full((3, len(v)), np.inf)
    slopes, waiting = np.zeros((len(v), 8, 3)), np.arange(len(v))
    for trial in range(TRIALS):
        y = start(place[waiting], shape[waiting], w[waiting])
        ends = extended.ends(y, period[waiting], work[waiting])
        off = _difference(ends, y)
        closure[waiting] = np.abs(off).max(axis=1)
        if trial == 0:
            slopes = _slopes(place, shape, w, period, work, ends)
            numbers = np.concatenate([w[:, 0], period[:, :1]], axis=1)[:, None]
            floor = 2.0**-53 * np.abs(slopes * numbers).max(axis=(1, 2))
        going = np.isfinite(off).all(axis=1) & ~((closure[waiting] <= ENOUGH) & (step[waiting] <= ENOUGH))
        waiting, off = waiting[going], off[going]
        if not len(waiting):
            break
        change = np.stack([-np.linalg.lstsq(slopes[k], b, rcond=None)[0] for k, b in zip(waiting, off, strict=True)])
        w[waiting] = extended.add(w[waiting], change[:, :2])
        period[waiting] = extended.add(period[waiting, :, None], change[:, 2:])[..., 0]
        step[waiting] = np.abs(change).max(axis=1) / np.abs(w[waiting, 0]).max(axis=1)
    return Refined(w, period, closure, step, floor)


def start(place, shape, w) -> np.ndarray:
    """The states (N, 2, 8); in each row of `shape` one number at most is not zero, and that is ±1."""
    y = np.zeros((len(w), 2, 8))
    y[:, 0, :4] = place
    y[:, :, 4:] = np.einsum("nij,nhj->nhi", shape, w)
    return y


def _difference(a, b) -> np.ndarray:
    return (a[:, 0] - b[:, 0]) + (a[:, 1] - b[:, 1])


def _slopes(place, shape, w, period, work, ends) -> np.ndarray:
    """∂(φ_T(y) − y)/∂(w, T), (N, 8, 3)."""
    slopes = np.empty((len(w), 8, 3))
    for k in range(2):
        nearby = NEARBY * np.eye(2)[k] * np.ones((len(w), 1))
        moved = extended.ends(start(place, shape, extended.add(w, nearby)), period, work)
        slopes[..., k] = _difference(moved, ends) / NEARBY
        slopes[:, 4:, k] -= shape[..., k]
    slopes[..., 2] = extended.rate(ends[:, 0])
    return slopes
