"""Linear systems whose rank is decided openly: which singular values count as zero, and how wide the gap is there.

A periodic orbit is never alone: it may begin anywhere along itself, and where momenta are conserved it may be moved and
turned. So the equations that close it are singular, exactly so at the orbit, where the conserved quantities also make
some of the equations follow from the others. What is solved is the part that is regular, by the shortest correction,
which moves neither along the orbit nor along a symmetry. Which part that is, is a decision about singular values σ:
zero are those below a threshold, relative to the largest, that the caller states.
"""

from typing import NamedTuple

import numpy as np


class Decided(NamedTuple):
    """The singular values of B matrices (m, k), largest first, and how many of them count, `rank` (B,).

    `left` (B, m, m) and `right` (B, k, k) are the orthogonal factors, with the singular vectors as columns.
    """

    left: np.ndarray
    values: np.ndarray
    right: np.ndarray
    rank: np.ndarray

    def least_norm(self, b: np.ndarray) -> np.ndarray:
        """The shortest x (B, k) that solves the regular part of A x = b, b (B, m)."""
        kept = np.arange(self.values.shape[1]) < self.rank[:, None]
        inverse = np.where(kept, 1.0 / np.where(kept, self.values, 1.0), 0.0)
        count = self.values.shape[1]
        inner = np.einsum("bmi,bm->bi", self.left[:, :, :count], b) * inverse
        return np.einsum("bki,bi->bk", self.right[:, :, :count], inner)


def decide(matrices: np.ndarray, threshold: np.ndarray) -> Decided:
    """The singular values of B matrices (B, m, k), of which those below `threshold` (B,) times the largest are zero."""
    left, values, right = np.linalg.svd(matrices, full_matrices=True)
    rank = (values > threshold[:, None] * values[:, :1]).sum(axis=1)
    return Decided(left, values, np.swapaxes(right, 1, 2), rank)
