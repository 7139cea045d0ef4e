"""Eigenvalues and eigenvectors of symmetric matrices up to 3 × 3, on scalars.

The trigonometric formula for the roots of a cubic has an arc cosine, whose derivative is infinite where two
eigenvalues are equal: beside that it has lost half of its digits. Jacobi's rotations choose their angles by comparing
numbers. Here:

    2 × 2    λ = m ± r with m = (a + c) / 2 and r = √(d² + b²), d = (a − c) / 2
    3 × 3    the eigenvalue farther from the middle one is m ± 2 p x, where x, the root of 4 x³ − 3 x = |ρ| in
             [√3/2, 1], is smooth in |ρ| ≤ 1; a reflection takes its eigenvector to an axis and leaves 2 × 2 numbers

with m a third of the trace, 6 p² the sum of the squares of the entries of A − m, and 2 ρ the determinant of
(A − m) / p. All is as exact as LAPACK's, to a few roundings of |A|, where eigenvalues are equal too. Their derivatives
are NaN just where they have none: where r or p is zero. Which eigenvalue is farther, and which axis is taken, changes
how the same numbers are computed, and is therefore no border (`prefers`).

Of the two signs of an eigenvector that is taken which gives it a positive component along a direction that is none of
symmetry; what does not depend on the sign does not see it. A matrix falls into blocks where its zeros let it: where
eigenvalues of two of them cross, their order is a border.

The formulas are for `Scalars` as well as for arrays of JAX.
"""

import functools
import operator
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from lagjax._program import _scalars as xp
from lagjax._program._graph import Unlowerable
from lagjax._program._scalars import Scalars
from lagjax._program.lowering._rules import Expansion, lowers

# The rows of the largest matrix whose eigenvalues are written out.
LARGEST = 3
# The start of x, a polynomial in |ρ| that is off by 5e-4 at most, and Newton's steps from it: the second leaves 4e-13.
_START, _STEPS = (0.86656117, 0.15959017, -0.02656878), 3
# No small whole numbers are orthogonal to it.
_DIRECTION = (1.0, 0.7548776662466927, 0.5698402909980532)

Pair = tuple[Any, list[Any]]  # an eigenvalue and the components of its vector


# ---- formulas -------------------------------------------------------------------------------------------------------


def eigen_2(a, b, c) -> list[Pair]:
    """The eigenpairs of [[a, b], [b, c]], in order; where the eigenvalues are equal the vectors are NaN."""
    middle, half = 0.5 * (a + c), 0.5 * (a - c)
    radius = xp.root(half * half + b * b)
    is_steep = xp.prefers(0.0, half)  # the vector of the larger one is nearer to the second axis
    tangent = b / (xp.where(is_steep, -half, half) + radius)
    cosine = 1.0 / xp.root(1.0 + tangent * tangent)
    sine = tangent * cosine
    x, y = xp.where(is_steep, sine, cosine), xp.where(is_steep, cosine, sine)
    return [(middle - radius, [-y, x]), (middle + radius, [x, y])]


def eigen_3(a) -> list[Pair]:
    """The eigenpairs of a symmetric matrix (3, 3), whose lower half is read; vectors of equal eigenvalues are NaN."""
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    entries = [a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean, a[1, 0], a[2, 0], a[2, 1]]
    squares = [x * x for x in entries]
    scale = xp.root((squares[0] + squares[1] + squares[2] + 2.0 * (squares[3] + squares[4] + squares[5])) / 6.0)
    xx, yy, zz, xy, xz, yz = (_divide_or_zero(x, scale) for x in entries)
    ratio = 0.5 * (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    is_low = xp.prefers(0.0, ratio)
    size = xp.where(is_low, -ratio, ratio)
    root = _START[0] + size * (_START[1] + _START[2] * size)
    for _ in range(_STEPS):
        square = root * root
        root = (8.0 * root * square + size) / (12.0 * square - 3.0)
    far = xp.where(is_low, -2.0 * root, 2.0 * root)
    # The adjugate of what is left is the projection on the vector times its trace, 3 (far² − 1) > 0. The axis with the
    # largest component becomes the first one.
    x, y, z = xx - far, yy - far, zz - far
    axis = _AxisExchange(y * z - yz * yz, x * z - xz * xz, x * y - xy * xy)
    xx, yy, zz = axis.pick(xx, yy, zz), axis.pick(yy, xx, yy), axis.pick(zz, zz, xx)
    xy, xz, yz = axis.pick(xy, xy, yz), axis.pick(xz, yz, xz), axis.pick(yz, xz, xy)
    y, z = yy - far, zz - far
    column = [y * z - yz * yz, xz * yz - xy * z, xy * yz - xz * y]
    length = xp.root(_dot(column, column))
    u, v, w = (_divide_or_zero(x, length) for x in column)
    # The reflection that takes the first axis to −(u, v, w) takes the others to two vectors beside it.
    share = 1.0 / (1.0 + u)
    beside = [[-v, 1.0 - share * v * v, -share * v * w], [-w, -share * v * w, 1.0 - share * w * w]]
    images = [[xx * p + xy * q + xz * r, xy * p + yy * q + yz * r, xz * p + yz * q + zz * r] for p, q, r in beside]
    low, high = eigen_2(_dot(beside[0], images[0]), _dot(beside[0], images[1]), _dot(beside[1], images[1]))
    others = [
        (value, axis.restore([s * p + t * q for p, q in zip(*beside, strict=True)])) for value, (s, t) in (low, high)
    ]
    alone = far, axis.restore([x / length for x in column])
    return [
        (mean + scale * xp.where(is_low, a, b), [xp.where(is_low, s, t) for s, t in zip(of_a, of_b, strict=True)])
        for (a, of_a), (b, of_b) in zip([alone, *others], [*others, alone], strict=True)
    ]


class _AxisExchange:
    """The exchange of the first axis with that of the largest of three numbers."""

    def __init__(self, first, second, third):
        self._is_second = xp.prefers(second, first)
        self._is_third = xp.prefers(third, xp.where(self._is_second, second, first))

    def pick(self, kept, with_second, with_third):
        """The number that belongs to the axis, of three."""
        return xp.where(self._is_third, with_third, xp.where(self._is_second, with_second, kept))

    def restore(self, vector: list) -> list:
        x, y, z = vector
        return [self.pick(x, y, z), self.pick(y, x, y), self.pick(z, z, x)]


def _divide_or_zero(x, by):
    """The quotient, and 0 for 0 / 0, whose derivative is then not to be trusted: that of `by` is NaN there."""
    return x / xp.where(xp.equal(by, 0.0), 1.0, by)


def _dot(xs: list, ys: list):
    return functools.reduce(operator.add, [x * y for x, y in zip(xs, ys, strict=True)])


def eigen(a) -> list[Pair]:
    """The eigenpairs of a symmetric matrix (n, n) with n ≤ 3, in order; vectors have no sign of their own."""
    n = a.shape[0]
    if n == 1:
        return [(a[0, 0], [1.0])]
    return eigen_2(a[0, 0], a[1, 0], a[1, 1]) if n == 2 else eigen_3(a)


# ---- primitives -----------------------------------------------------------------------------------------------------


@lowers("eigh")
def _eigh(expansion: Expansion, params, a: np.ndarray) -> list[np.ndarray]:
    n, chosen = a.shape[-1], params["subset_by_index"]
    if n > LARGEST:
        raise Unlowerable(
            f"eigenvalues of a symmetric matrix of {n} rows have no formula; those of up to {LARGEST} are written out "
            "as scalars"
        )
    if chosen is not None and tuple(chosen) != (0, n):
        raise Unlowerable("eigenvalues by `subset_by_index` are not written out; take the entries of all of them")
    if not params["lower"]:
        a = np.swapaxes(a, -1, -2)
    batch = a.shape[:-2]
    done = [_order_eigenpairs(expansion, a[at]) for at in np.ndindex(*batch)]
    values = np.array([[value for value, _ in pairs] for pairs in done], dtype=np.int64).reshape(*batch, n)
    vectors = np.array([[vector for _, vector in pairs] for pairs in done], dtype=np.int64).reshape(*batch, n, n)
    return [np.swapaxes(vectors, -1, -2), values]


def _order_eigenpairs(expansion: Expansion, a: np.ndarray) -> list[tuple[int, list[int]]]:
    """The eigenpairs of a matrix of ids, block by block, in order."""
    n, zero = len(a), expansion.graph.constant(0.0, "float")
    filled = np.reshape([expansion.graph.value(i) != 0 for i in a.ravel().tolist()], a.shape)
    count, labels = connected_components(np.tril(filled), directed=False)  # its zeros keep these parts apart
    values, vectors, blocks = [], [], [np.flatnonzero(labels == k) for k in range(count)]
    for block in blocks:
        for value, parts in eigen(Scalars(expansion, a[np.ix_(block, block)])):
            vector = np.full(n, zero)
            vector[block] = _fix_sign(expansion, parts)
            values.append(value.ids)
            vectors.append(vector)
    if len(blocks) > 1:
        given = np.array(values), *np.transpose(vectors)
        values, *parts = expansion.lower_primitive("sort", {"num_keys": 1, "dimension": 0}, given)
        vectors = np.transpose(parts)
    return [(int(value), list(vector)) for value, vector in zip(values, vectors, strict=True)]


def _fix_sign(expansion: Expansion, vector: list) -> np.ndarray:
    if len(vector) == 1:
        return expansion.constants(np.array(vector))
    wrong = _dot(list(_DIRECTION[: len(vector)]), vector)
    is_wrong = wrong.map("lt", wrong, 0.0)
    signed: list[Any] = [xp.where(is_wrong, -x, x) for x in vector]
    return np.array([int(x.ids) for x in signed])
