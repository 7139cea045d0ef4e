"""Linear systems with an explicit decision of rank: which singular values count as zero, and how wide the gap is there.

Symmetries, redundant conditions and closed orbits all make singular equations. A periodic orbit is never isolated: its
start may be anywhere along it, and where momenta are conserved it may be translated and turned. So the equations that
close it are singular, exactly so at the orbit, where the conserved quantities also make some of the equations follow
from the rest. The regular part is solved, by the shortest correction, which moves neither along the orbit nor along a
symmetry. The regular part is defined by singular values: those below a threshold given by the caller are zero.

This is NumPy, for any number of matrices at once. Code that JAX compiles and differentiates decides by pivots instead,
in `_linear` and `lagjax._analysis._solve`: a singular value decomposition would be a kernel of LAPACK inside of XLA,
without a derivative where singular values meet.
"""

from typing import NamedTuple

import numpy as np


class TruncatedSVD(NamedTuple):
    """Singular vectors and values of matrices (…, m, k), largest first, and the number `rank` (…) of nonzero ones."""

    left: np.ndarray  # singular vectors, one a column, (…, m, min(m, k))
    values: np.ndarray
    right: np.ndarray  # likewise, (…, k, k)
    rank: np.ndarray

    @property
    def null(self) -> np.ndarray:
        """An orthonormal basis (k, k − rank), as columns, of the null space of one matrix."""
        return self.right[:, int(self.rank) :]

    @property
    def whitened(self) -> np.ndarray:
        """The right singular vectors over their values, zero beyond the rank (…, k, min(m, k)): A times these is
        orthonormal."""
        count = self.values.shape[-1]
        kept = np.arange(count) < self.rank[..., None]
        inverse = np.where(kept, 1.0 / np.where(kept, self.values, 1.0), 0.0)
        return self.right[..., :count] * inverse[..., None, :]

    def least_norm(self, b: np.ndarray) -> np.ndarray:
        """The shortest x (…, k) that solves the regular part of A x = b, b (…, m)."""
        return np.einsum("...ki,...i->...k", self.whitened, np.einsum("...mi,...m->...i", self.left, b))


def truncated_svd(matrices: np.ndarray, relative: np.ndarray | float = 0.0, absolute: float = 0.0) -> TruncatedSVD:
    """The SVD of matrices (…, m, k); singular values below `absolute`, or `relative` (…) of the largest, count as 0."""
    m, k = matrices.shape[-2:]
    left, values, right = np.linalg.svd(matrices, full_matrices=m < k)
    bound = np.maximum(absolute, np.asarray(relative)[..., None] * values[..., :1])
    return TruncatedSVD(left, values, np.swapaxes(right, -1, -2), np.asarray((values > bound).sum(axis=-1)))


def null_space(rows: np.ndarray, threshold: float | None = None) -> np.ndarray:
    """An orthonormal basis (k, K), as columns, of the null space of m rows (m, k).

    Rows are scaled to unit length, which does not change it. Then a singular value counts as zero up to `threshold` of
    the largest, by default √eps = 1.5e-8: rounding leaves a zero at n eps, at most √eps if half of the digits cancelled
    before, and what is smaller than √eps has no digit in the Gram matrix of the rows. Twice as large it would give the
    same in scenes, whose rows meet at angles. Rows that are less accurate than rounding, derivatives of a motion, need
    a threshold of their accuracy.
    """
    threshold = float(np.sqrt(np.finfo(rows.dtype).eps)) if threshold is None else threshold
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return truncated_svd(rows / np.where(lengths > 0, lengths, 1), threshold).null


def span_outside(basis: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An orthonormal basis (n, k) of the part of the span of `basis` (n, m) that is not in the span of `known` (n, l).

    Both are orthonormal. Singular values are the sines of angles to `known`, zero or one up to rounding if its span
    lies in the other; the largest comes first.
    """
    left, sines, _ = np.linalg.svd(basis - known @ (known.T @ basis), full_matrices=False)
    return left[:, sines > 0.5]


def echelon_form(rows: np.ndarray) -> np.ndarray:
    """The reduced row echelon form of independent rows, with the largest pivots."""
    rows = np.array(rows, float)
    for i in range(len(rows)):
        rest = np.abs(rows[i:])
        k, column = np.unravel_index(np.argmax(rest), rest.shape)
        if not rest[k, column] > 0:  # a direction along which numbers at the end of their sets no longer change
            rows = rows[:i]
            break
        rows[[i, i + k]] = rows[[i + k, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return np.where(np.abs(rows) > 1e-9, rows, 0.0)
