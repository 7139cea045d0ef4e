"""Chains of linear equations between neighbours, condensed to one between the ends by orthogonal elimination.

    A_k x_k + B_k x_(k+1) + C_k z = 0,  k = 0 … K−1

Two neighbours share an unknown; a QR decomposition of its columns gives one equation that determines it and one without
it. K a power of two, log₂ K rounds leave A x_0 + B x_K + C z = 0. No product of many arcs is formed, in whose rounding
the directions that do not grow would be lost, and orthogonal steps preserve norms, so that singular values of A + B are
meaningful. A singular value decomposition of the whole chain would take K² times as long.

Source: Wright, *Stable parallel algorithms for two-point boundary value problems*, SIAM J. Sci. Stat. Comput. 13 (1992)
742.
"""

from typing import NamedTuple

import numpy as np


class EliminationRound(NamedTuple):
    """Eliminated unknowns by the others: `of_left`, `of_right` (B, K/2, s, s), `of_z` (B, K/2, s, c)."""

    of_left: np.ndarray
    of_right: np.ndarray
    of_z: np.ndarray


class Condensed(NamedTuple):
    """The equation A x_0 + B x_K + C z = 0 of the ends, (B, s, s), (B, s, s), (B, s, c), and the elimination rounds."""

    first: np.ndarray
    last: np.ndarray
    more: np.ndarray
    rounds: tuple[EliminationRound, ...]

    def expand_solution(self, x: np.ndarray, end: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return all unknowns (B, K, s, m) from those at the ends, x_0 and x_K (B, s, m), and z (B, c, m)."""
        known = np.stack([x, end], axis=1)
        for of in reversed(self.rounds):
            left, right = known[:, :-1], known[:, 1:]
            middle = of.of_left @ left + of.of_right @ right + of.of_z @ z[:, None]
            woven = np.empty((known.shape[0], 2 * known.shape[1] - 1, *known.shape[2:]))
            woven[:, ::2], woven[:, 1::2] = known, middle
            known = woven
        return known[:, :-1]


def condense_chain(growth: np.ndarray, more: np.ndarray) -> Condensed:
    """Condense a chain with A_k = `growth` (B, K, s, s), B_k = −1, C_k = `more` (B, K, s, c), K a power of two."""
    s, left, right, rounds = growth.shape[2], growth, np.broadcast_to(-np.eye(growth.shape[2]), growth.shape), []
    while left.shape[1] > 1:
        q, r = np.linalg.qr(np.concatenate([right[:, ::2], left[:, 1::2]], axis=2), mode="complete")
        qt = np.swapaxes(q, 2, 3)
        of_left, of_right = qt[..., :s] @ left[:, ::2], qt[..., s:] @ right[:, 1::2]
        of_z = qt @ np.concatenate([more[:, ::2], more[:, 1::2]], axis=2)
        parts = np.concatenate([of_left[:, :, :s], of_right[:, :, :s], of_z[:, :, :s]], axis=3)
        solved = -np.linalg.solve(r[:, :, :s], parts)
        rounds.append(EliminationRound(solved[..., :s], solved[..., s : 2 * s], solved[..., 2 * s :]))
        left, right, more = of_left[:, :, s:], of_right[:, :, s:], of_z[:, :, s:]
    return Condensed(left[:, 0], right[:, 0], more[:, 0], tuple(rounds))
