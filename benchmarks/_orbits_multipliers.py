"""Multipliers of planar three-body orbits from motions with 32 digits, where doubles leave their stability unknown.

The start of these orbits is its own image under S: each body goes to the opposite place, the first two change their
parts, and the time runs back. So M⁻¹ = S M S for the monodromy matrix M, and on what S leaves as it is

    M + M⁻¹ = (1 + S) M,     whose eigenvalues are ρ = μ + 1/μ.

That space has four dimensions; one is the turn of the plane, and one changes the energy. Two are left, and central
differences of motions over the whole period in these two directions are all that is needed. M keeps the energy and the
angular momentum; by how much the differences do not is their error, and with it that of ρ.

Source: Meyer & Offin, *Introduction to Hamiltonian Dynamical Systems*, §8.5; Broucke, *Stability of periodic orbits in
the elliptic restricted three-body problem*, AIAA J. 7 (1969) 1003, for ρ.
"""

from typing import Any, NamedTuple

import mpmath
import numpy as np
from mpmath import mpf

from benchmarks import _orbits_extended as extended

# Of differences. Errors that grow a millionfold leave derivatives (1e6 h)² / 6 off in parts of themselves, and rounding
# 1e-22 / h: with 2⁻⁴⁴ or 2⁻³⁶ the error is larger.
NEARBY = 2.0**-40
DIGITS = 40
_SAFE = 10  # times the error of conserved quantities is that of ρ, which no conserved quantity sees entirely

Vector = list[mpf]


class Multipliers(NamedTuple):
    """Of N orbits: `values` (N, 4), those that are not 1 by symmetry, each beside its reciprocal, the largest first.

    `rho` (N, 2) are their sums with the reciprocals, and `error` (N,) is how far these may be off.
    """

    values: np.ndarray
    rho: np.ndarray
    error: np.ndarray

    @property
    def unstable(self) -> np.ndarray:
        """Whether one is outside of the unit circle, beyond the error, (N,)."""
        apart = np.abs(self.rho.imag) > self.error[:, None]
        return (apart | ((np.abs(self.rho.real) > 2 + self.error[:, None]) & (self.rho.imag == 0))).any(axis=1)

    @property
    def known(self) -> np.ndarray:
        """Whether one is, or none is farther out than 1 + 1e-3, (N,): many orbits have a pair at 1, to all digits."""
        return self.unstable | (self.error < _PARTED)


_PARTED = 1e-6  # of ρ: the square of how far a pair at 1 may have parted


def multipliers(y: np.ndarray, period: np.ndarray, work: np.ndarray, centre: np.ndarray) -> Multipliers:
    """Those of orbits from starts `y` (N, 2, 8) of the published form relative to the body `centre` (N,).

    Numbers are double-doubles, `period` (N, 2) too; of as much `work` (N,) are those followed together.
    """
    with mpmath.workdps(DIGITS):
        places = [_place(_exact(start), k) for start, k in zip(y, centre.tolist(), strict=True)]
        directions = np.array([[_doubles(one) for one in place.across] for place in places])  # (N, 2, 2, 8)
        starts = np.stack([_moved(y[:, None], sign * NEARBY * directions) for sign in (1, -1)], axis=2)
        rows = starts.reshape(-1, 2, 8)
        ends = extended.ends(rows, np.repeat(period, 4, axis=0), np.repeat(work, 4)).reshape(starts.shape)
        found = [_of_orbit(place, end) for place, end in zip(places, ends, strict=True)]
    return Multipliers(*(np.array(x) for x in zip(*found, strict=True)))


def _exact(y: np.ndarray) -> Vector:
    """Double-doubles (2, 8) as numbers of many digits."""
    return [mpf(high) + mpf(low) for high, low in y.T.tolist()]


def _doubles(column: Vector) -> np.ndarray:
    """The same as double-doubles (2, 8)."""
    high = [float(x) for x in column]
    return np.array([high, [float(x - h) for x, h in zip(column, high, strict=True)]])


def _moved(y: np.ndarray, by: np.ndarray) -> np.ndarray:
    """The sum of double-doubles (..., 2, 8)."""
    return extended.add(extended.add(np.broadcast_to(y, by.shape), by[..., 0, :]), by[..., 1, :])


class _Place(NamedTuple):
    """About a start: S (8, 8), two orthonormal directions `across`, and the unit slopes of energy and momentum."""

    image: Any  # a matrix of mpmath, (8, 8)
    across: list[Vector]
    slopes: list[Vector]


def _place(y: Vector, centre: int) -> _Place:
    """The directions that S leaves as they are, across the turn and the slope of the energy."""
    (x, other), (dx, dother) = (y[:2], y[2:4]), (y[4:6], y[6:])
    between = _sum(x, other, -1)
    px, po = _momenta(dx, dother)
    by_place = [*_sum(_pull(x), _pull(between)), *_sum(_pull(other), _pull(between), -1)]
    energy = [*by_place, *px, *po]
    # L = x × p_x + y × p_y
    by_speed = [a for part in _momenta(x, other) for a in _turned(part)]
    momentum = [*(-a for a in (*_turned(px), *_turned(po))), *by_speed]
    turn = [a for part in (x, other, dx, dother) for a in _turned(part)]
    image = _image(centre)
    same = [_halved(_sum(one, _apply(image, one))) for one in (list(row) for row in mpmath.eye(8).tolist())]
    # ∇h need not lie in that space: what is across it there is across its part in the space.
    space = _orthonormal([turn], same)
    slope = [mpmath.fdot(energy, one) for one in space]
    part = [mpmath.fdot(slope, column) for column in zip(*space, strict=True)]
    across = _orthonormal([turn, part], space)[2:]
    return _Place(image, across, _orthonormal([energy], [])[:1] + _orthonormal([momentum], [])[:1])


def _image(centre: int) -> Any:
    """S on (x, y, ẋ, ẏ), which are positions of the others relative to the body `centre`: r_i → −r_σ(i), v_i → v_σ(i).

    σ exchanges the first two. Relative to the third, x → −y; relative to the first, with x that of the second, x → x
    and y → x − y; relative to the second, with x that of the first, the same.
    """
    block = [[0, -1], [-1, 0]] if centre == 2 else [[1, 0], [1, -1]]
    image = mpmath.zeros(8, 8)
    for i in range(2):
        for j in range(2):
            for c in range(2):
                image[2 * i + c, 2 * j + c] = block[i][j]
                image[4 + 2 * i + c, 4 + 2 * j + c] = -block[i][j]
    return image


def _orthonormal(first: list[Vector], others: list[Vector]) -> list[Vector]:
    """An orthonormal basis of the space of vectors, those of `first` leading."""
    basis = []
    for vector in (*first, *others):
        left = vector
        for _ in range(2):  # once more, as rounding of the first time asks for
            for one in basis:
                left = _sum(left, one, -mpmath.fdot(one, left))
        size = mpmath.norm(left)
        if size > mpf("1e-3") * mpmath.norm(vector):
            basis.append([a / size for a in left])
    return basis


def _of_orbit(place: _Place, ends: np.ndarray) -> tuple[list[complex], list[complex], float]:
    """Multipliers, ρ and the error of ρ from the ends (2, 2, 2, 8) of motions from both sides along each direction."""
    if not np.isfinite(ends).all():
        return [complex("nan")] * 4, [complex("nan")] * 2, float("inf")
    changes = [[a / (2 * mpf(NEARBY)) for a in _sum(_exact(ahead), _exact(behind), -1)] for ahead, behind in ends]
    sums = [_sum(change, _apply(place.image, change)) for change in changes]
    (a, b), (c, d) = [[mpmath.fdot(one, both) for both in sums] for one in place.across]
    half, product = (a + d) / 2, a * d - b * c
    apart = mpmath.sqrt(half**2 - product)
    off = _SAFE * max(abs(mpmath.fdot(slope, change)) for slope in place.slopes for change in changes)
    of_square = off * (abs(half) + max(abs(x) for x in (a, b, c, d)))  # of half² − product
    error = off + min(mpmath.sqrt(of_square), of_square / max(abs(apart), mpf("1e-30")))
    rho = sorted((half + apart, half - apart), key=lambda x: -abs(x))
    pairs = [[(x + sign * mpmath.sqrt(x**2 - 4)) / 2 for sign in (1, -1)] for x in rho]
    values = [complex(x) for pair in pairs for x in sorted(pair, key=lambda x: -abs(x))]
    return values, [complex(x) for x in rho], float(error)


def _momenta(x: Vector, y: Vector) -> tuple[Vector, Vector]:
    """(2 x − y)/3 and (2 y − x)/3."""
    return [(2 * a - b) / 3 for a, b in zip(x, y, strict=True)], [(2 * b - a) / 3 for a, b in zip(x, y, strict=True)]


def _sum(x: Vector, y: Vector, by=1) -> Vector:
    return [a + by * b for a, b in zip(x, y, strict=True)]


def _halved(x: Vector) -> Vector:
    return [a / 2 for a in x]


def _apply(matrix: Any, x: Vector) -> Vector:
    return list(matrix * mpmath.matrix(x))


def _pull(r: Vector) -> Vector:
    cube = mpmath.norm(r) ** 3
    return [a / cube for a in r]


def _turned(r: Vector) -> Vector:
    return [-r[1], r[0]]
