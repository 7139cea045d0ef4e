"""The uncertainty of starts, beside the parameters: the covariance of what was eliminated.

A piece with rows A of its start and B of the parameters, in units of the noise ε, has the start

    δs = A⁺ (ε − B δu),        δu = H⁻¹ Gᵀ ε,        G = B − A A⁺B over all pieces

so its covariance is that of its own rows, that of the parameters through A⁺B, and what both share where residuals are
correlated. Where A does not see a component of the start its variance is infinite.
"""

from typing import NamedTuple

import numpy as np

from lagjax._fit._correlation import correlated_square, correlation
from lagjax._fit._noise import Widths
from lagjax._fit._residuals import AbstractQuestion, Point
from lagjax._fit._uncertainty import Information


class OfStarts(NamedTuple):
    """The uncertainty of N starts: `covariance` (N, 2n, 2n), and A⁺B (N, 2n, F), how they follow the parameters."""

    covariance: np.ndarray
    follows: np.ndarray


def of_starts(question: AbstractQuestion, point: Point, widths: Widths, known: Information) -> OfStarts:
    """The uncertainty of the starts of all pieces at the end of a search; zero for those that are not fitted."""
    states, free, pieces = question.states, len(point.u), len(question.pieces)
    lags = [correlation(question, point, widths, s).lags for s in range(len(widths.sigma))]
    found = OfStarts(np.zeros((pieces, states, states)), np.zeros((pieces, states, free)))
    for batch, slopes in zip(question.batches, point.slopes, strict=True):
        rows = np.sqrt(batch.weights)[..., None] / widths.sigma[:, None] * slopes
        for row, piece in zip(batch.rows.tolist(), rows, strict=True):
            if question.fitted[row]:
                across = np.zeros((states, states)) if point.across is None else point.across[row]
                found.covariance[row], found.follows[row] = _of_start(piece, states, lags, known, across)
    return found


def _of_start(rows: np.ndarray, states: int, lags: list[np.ndarray], known: Information, across: np.ndarray):
    """The covariance (2n, 2n) of one start, and A⁺B, from its weighted rows (T, S, 2n + F).

    What is `across` (2n, 2n) the constraints is not free, and no less known for not being seen.
    """
    a, b = rows[..., :states], rows[..., states:]
    u, values, v = np.linalg.svd(a.reshape(-1, states), full_matrices=False)
    sees = values > 1e-10 * values.max()
    into = (u[:, sees] / values[sees]) @ v[sees]  # (A⁺)ᵀ, (T S, 2n)
    follows = into.T @ b.reshape(-1, b.shape[-1])
    own = np.concatenate([into.reshape(a.shape), b - a @ follows], axis=-1)
    square = np.sum([correlated_square(own[None, :, s], lags[s]) for s in range(len(lags))], axis=0)
    covariance = _of_seen(known)
    shared = square[:states, states:] @ known.white @ follows.T
    found = known.lost * (square[:states, :states] - shared - shared.T) + follows @ covariance @ follows.T
    not_seen = v[~sees] - v[~sees] @ across.T
    lost = (np.abs(not_seen) > 1e-6).any(axis=0) | _moves(follows, known)
    found[lost], found[:, lost] = np.nan, np.nan
    found[lost, lost] = np.inf
    return found, follows


def start_alone(rows: np.ndarray, states: int, known: Information, share: float) -> tuple[np.ndarray, np.ndarray]:
    """The uncertainty of a start by weighted rows (T, S, 2n + F): covariance (2n, 2n) for fixed parameters, and A⁺B.

    Every sample is worth the `share` of an independent one.
    """
    flat = rows.reshape(-1, rows.shape[-1])
    u, values, v = np.linalg.svd(flat[:, :states], full_matrices=False)
    sees = values > 1e-10 * values.max()
    into = (u[:, sees] / values[sees]) @ v[sees]
    return known.lost / share * into.T @ into, into.T @ flat[:, states:]


def deviations(slopes: np.ndarray, states: int, start: np.ndarray, follows: np.ndarray, known: Information):
    """The standard deviations (T, S) of signals whose derivatives are `slopes` (T, S, 2n + F).

    They come from the parameters as far as these are seen, and from a start of covariance `start` (2n, 2n) of its own
    that `follows` (2n, F) the parameters.
    """
    a = slopes[..., :states]
    along = slopes[..., states:] - a @ follows
    covariance = _of_seen(known)
    variance = np.einsum("tsf,fg,tsg->ts", along, covariance, along) + np.einsum("tsi,ij,tsj->ts", a, start, a)
    return np.where(_moves(along, known), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _of_seen(known: Information) -> np.ndarray:
    """The covariance (F, F) of what is seen, zero along what is not; with white residuals where some is not."""
    return known.covariance if not known.null.size else known.lost * known.white


def _moves(rows: np.ndarray, known: Information) -> np.ndarray:
    """True if rows (..., F) of derivatives depend on a direction that is not seen."""
    if not known.null.size:
        return np.zeros(rows.shape[:-1], bool)
    return (np.abs(rows @ known.null) > 1e-6 * np.abs(rows).max(initial=0.0)).any(axis=-1)
