"""`Surrogate`: the density of a posterior whose residuals are expanded to second order about the fit.

With C = L Lᵀ the covariance of the fit and x = x̂ + L z, every residual is

    r(z) ≈ r(0) + J z + ½ zᵀ H z,        H eᵢ = [J(h eᵢ) − J(−h eᵢ)] / (2 h),   h = 1,

with exact Jacobians J: central differences over one standard deviation take along what bends at the scale of the
posterior. The prior, the volumes of the transforms and the law of the noise are kept as they are. A value and its
gradient then cost products of matrices and no motion. Where the posterior bends mildly, the two densities differ by
tenths; `_sample` corrects for what is left with the exact density.

A residual depends on the parameters and on the start of its own record. The root L of the covariance keeps that: given
the parameters, starts are independent, so that all of them are moved in one trial, and 2 (F + 2n) trials do for any
number of records.

Source: Christen & Fox, J. Comput. Graph. Stat. 14 (2005) 795, for approximations inside of a chain that is exact.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from lagjax._fit._density import Density
from lagjax._fit._residuals import Failure, Point, compressed

_STEP = 1.0  # standard deviations; half of it moves log p of TRAPPIST-1's posterior by less than what is left
# Numbers of all expansions together: 32 MiB that every step of a trajectory reads. Many more, and a motion is cheaper.
_LARGEST = 4_000_000


class Block(NamedTuple):
    """The expansions of one batch, in units of the weights: `rows` (N, T, S, Q), and which `counts` (N, T, S).

    The Q coefficients are of 1, of the d numbers ζ that a piece depends on, and of their products ζᵢζⱼ, i ≤ j. `own`
    (N, d) are the places of these numbers in z.
    """

    rows: np.ndarray
    counts: np.ndarray
    own: np.ndarray


class Surrogate(NamedTuple):
    """log π*(z), called with z (D,); x = `centre` + `root` z."""

    density: Density
    centre: np.ndarray
    root: np.ndarray
    blocks: list[Block]

    def __call__(self, z):
        """The logarithm of the approximate density, up to the constant of `density`."""
        x = self.x(z)
        padded = jnp.append(z, 0.0)  # where the start of a piece is known its numbers are those of the last place
        weighted = [self._residuals(block, padded) for block in self.blocks]
        at = self.density.unknowns(x)
        return self.density.posterior(x, self.density.of_weighted(weighted, [b.counts for b in self.blocks], at))

    def x(self, z):
        """The unknowns x (D,) at z."""
        return jnp.asarray(self.centre, z.dtype) + jnp.asarray(self.root, z.dtype) @ z

    @staticmethod
    def _residuals(block: Block, padded):
        own = padded[block.own]
        first, second = np.triu_indices(own.shape[1])
        powers = jnp.concatenate([jnp.ones((len(own), 1), own.dtype), own, own[:, first] * own[:, second]], axis=1)
        return jnp.einsum("ntsq,nq->nts", jnp.asarray(block.rows, own.dtype), powers)


def expanded(density: Density) -> Surrogate | str:
    """The expansion about the fit; or a sentence that says why there is none."""
    root = np.linalg.cholesky(density.covariance())
    question, free = density.question, len(density.point.u)
    states = question.states if question.fitted.any() else 0
    unknowns = states + free
    size = sum(batch.weights.size for batch in question.batches) * (1 + unknowns + unknowns * (unknowns + 1) // 2)
    plain = not np.isfinite(density.widths.dof).any()
    if size > _LARGEST and not plain:
        return f"The expansion of its residuals to second order would hold {size} numbers, more than {_LARGEST}."
    middle = _jacobians(density, density.point, root, states)
    bends = _bends(density, root, states)
    if isinstance(bends, str):
        return bends
    blocks = []
    for k, batch in enumerate(question.batches):
        first = np.sqrt(batch.weights) * density.point.residuals[k]
        rows, counts = _polynomials(first, middle[k], bends[k]), batch.weights > 0
        if plain and rows.shape[1] > rows.shape[3]:
            rows = np.stack([compressed(rows[:, :, s]) for s in range(rows.shape[2])], axis=2)
            counts = np.ones(rows.shape[:3], bool)
        blocks.append(Block(rows, counts, _places(density, states)[batch.rows]))
    if (size := sum(block.rows.size for block in blocks)) > _LARGEST:
        return f"The expansion of its residuals to second order holds {size} numbers, more than {_LARGEST}."
    return Surrogate(density, density.first, root, blocks)


def _bends(density: Density, root: np.ndarray, states: int) -> list[np.ndarray] | str:
    """H of the weighted residuals of every batch, (N, T, S, d, d); or a sentence where a motion cannot be followed."""
    ways, columns = _ways(density, root, states), []
    for way in _STEP * np.eye(ways.shape[1]):
        ends = []
        for sign in (1, -1):
            trial = _trial(density, ways @ (sign * way))
            if isinstance(trial, Failure):
                return f"One standard deviation from the fit a motion fails. {density.question.where(trial)}"
            ends.append(_jacobians(density, trial, root, states))
        columns.append([(right - left) / (2 * _STEP) for right, left in zip(*ends, strict=True)])
    return [np.stack(of_batch, axis=-1) for of_batch in zip(*columns, strict=True)]


def _places(density: Density, states: int) -> np.ndarray:
    """The places in z (N, d) of the numbers that every piece depends on: those of its start, then the parameters'."""
    of_starts, free = density.of_starts[:, :states], np.arange(len(density.point.u))
    return np.concatenate([of_starts, np.broadcast_to(free, (len(of_starts), len(free)))], axis=1)


def _ways(density: Density, root: np.ndarray, states: int) -> np.ndarray:
    """How x (D,) moves with ζ (d,), (D, d), where the numbers of all starts move together."""
    places = _places(density, states)
    ways = np.zeros((len(density) + 1, places.shape[1]))
    for row in places:
        ways[row, np.arange(len(row))] = 1.0
    return root @ ways[:-1]


def _trial(density: Density, step: np.ndarray) -> Point | Failure:
    """The residuals and their derivatives at x̂ + step (D,)."""
    moved = np.append(step, 0.0)[density.of_starts]
    return density.question.follow(density.point.u + step[: len(density.point.u)], density.point.starts + moved)


def _jacobians(density: Density, trial: Point, root: np.ndarray, states: int) -> list[np.ndarray]:
    """How the weighted residuals of every batch move with ζ, (N, T, S, d)."""
    question, free, places = density.question, len(density.point.u), _places(density, states)
    padded = np.pad(root, (0, 1))
    columns = [padded[np.ix_(row, row)] for row in places]  # of the start and the parameters by ζ
    found = []
    for batch, slopes in zip(question.batches, trial.slopes, strict=True):
        own = slopes[..., slopes.shape[-1] - states - free :]
        by = np.stack([columns[row] for row in batch.rows])
        found.append(np.sqrt(batch.weights)[..., None] * np.einsum("ntsd,nde->ntse", own, by))
    return found


def _polynomials(first: np.ndarray, slopes: np.ndarray, bends: np.ndarray) -> np.ndarray:
    """Coefficients (N, T, S, Q) from residuals (N, T, S), their slopes (N, T, S, d) and H (N, T, S, d, d)."""
    i, j = np.triu_indices(slopes.shape[-1])
    products = 0.5 * (bends + bends.swapaxes(-1, -2))[..., i, j]
    products[..., i == j] *= 0.5
    return np.concatenate([first[..., None], slopes, products], axis=-1)
