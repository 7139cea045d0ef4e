"""`Surrogate`: the density of a posterior whose residuals are expanded to second order about the fit.

With the coordinates ζ of `_chart`, in which the covariance of the fit is one, every residual is

    r(ζ) ≈ r(0) + J ζ + ½ ζᵀ H ζ,        H eᵢ = [J(h eᵢ) − J(−h eᵢ)] / (2 h),   h ≤ 1,

with exact Jacobians J: central differences over one standard deviation, or as far as a bound lets them, take along what
bends at the scale of the posterior. The prior, the volumes of the transforms and the law of the noise are kept as they
are. A value and its gradient then cost products of matrices and no motion. Where the posterior bends mildly, the two
densities differ by tenths; `_sample` corrects for what is left with the exact density.

A residual depends on the parameters and on the start of its own record. The root L of the covariance keeps that: given
the parameters, starts are independent, so that all of them are moved in one trial, and 2 (F + 2n) trials do for any
number of records.

Source: Christen & Fox, J. Comput. Graph. Stat. 14 (2005) 795, for approximations inside of a chain that is exact.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from lagjax._fit._chart import Chart
from lagjax._fit._density import Density
from lagjax._fit._residuals import Failure, Point, compressed

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
    """log π*(z), called with coordinates z (D,) of the chart."""

    chart: Chart
    blocks: list[Block]

    def __call__(self, z):
        """The logarithm of the approximate density of z, up to the constant of `Chart.log_density`."""
        x, zeta, volume = self.chart(z)
        padded = jnp.append(zeta, 0.0)  # where the start of a piece is known its numbers are those of the last place
        weighted = [self._residuals(block, padded) for block in self.blocks]
        density = self.chart.density
        of_data = density.of_weighted(weighted, [b.counts for b in self.blocks], density.unknowns(x))
        total = density.posterior(x, of_data) + volume
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    @staticmethod
    def _residuals(block: Block, padded):
        own = padded[block.own]
        first, second = np.triu_indices(own.shape[1])
        powers = jnp.concatenate([jnp.ones((len(own), 1), own.dtype), own, own[:, first] * own[:, second]], axis=1)
        return jnp.einsum("ntsq,nq->nts", jnp.asarray(block.rows, own.dtype), powers)


def expanded(chart: Chart) -> Surrogate | str:
    """The expansion about the centre of a chart; or a sentence that says why there is none."""
    density = chart.density
    question, free = density.question, len(density.point.u)
    states = question.states if question.fitted.any() else 0
    unknowns = states + free
    size = sum(batch.weights.size for batch in question.batches) * (1 + unknowns + unknowns * (unknowns + 1) // 2)
    plain = not np.isfinite(density.widths.dof).any()
    if size > _LARGEST and not plain:
        return f"The expansion of its residuals to second order would hold {size} numbers, more than {_LARGEST}."
    found = _bent(chart, states)
    if isinstance(found, Failure):
        return f"One standard deviation from the fit a motion fails. {question.where(found)}"
    middle, slopes, bends = found
    blocks = []
    for k, batch in enumerate(question.batches):
        first = np.sqrt(batch.weights) * middle.residuals[k]
        rows, counts = _polynomials(first, slopes[k], bends[k]), batch.weights > 0
        if plain and rows.shape[1] > rows.shape[3]:
            rows = np.stack([compressed(rows[:, :, s]) for s in range(rows.shape[2])], axis=2)
            counts = np.ones(rows.shape[:3], bool)
        blocks.append(Block(rows, counts, _places(density, states)[batch.rows]))
    if (size := sum(block.rows.size for block in blocks)) > _LARGEST:
        return f"The expansion of its residuals to second order holds {size} numbers, more than {_LARGEST}."
    return Surrogate(chart, blocks)


def _bent(chart: Chart, states: int) -> tuple[Point, list[np.ndarray], list[np.ndarray]] | Failure:
    """The trial at the centre, and of every batch J (N, T, S, d) and H (N, T, S, d, d); or the motion that failed."""

    def at(zeta: np.ndarray) -> tuple[Point, list[np.ndarray]] | Failure:
        trial = _trial(chart, zeta)
        return trial if isinstance(trial, Failure) else (trial, _jacobians(chart, trial, zeta, states))

    ways, columns = _ways(chart.density, states), []
    centre = at(np.zeros(len(chart.centre)))
    if isinstance(centre, Failure):
        return centre
    for way, step in zip(ways.T, chart.room(ways), strict=True):
        right, left = at(step * way), at(-step * way)
        if isinstance(right, Failure):
            return right
        if isinstance(left, Failure):
            return left
        columns.append([(more - less) / (2 * step) for more, less in zip(right[1], left[1], strict=True)])
    return centre[0], centre[1], [np.stack(of_batch, axis=-1) for of_batch in zip(*columns, strict=True)]


def _places(density: Density, states: int) -> np.ndarray:
    """The places in z (N, d) of the numbers that every piece depends on: those of its start, then the parameters'."""
    of_starts, free = density.of_starts[:, :states], np.arange(len(density.point.u))
    return np.concatenate([of_starts, np.broadcast_to(free, (len(of_starts), len(free)))], axis=1)


def _ways(density: Density, states: int) -> np.ndarray:
    """The directions of ζ (D, d), one for every number of a piece, where the numbers of all starts move together."""
    places = _places(density, states)
    ways = np.zeros((len(density) + 1, places.shape[1]))
    for row in places:
        ways[row, np.arange(len(row))] = 1.0
    return ways[:-1]


def _trial(chart: Chart, zeta: np.ndarray) -> Point | Failure:
    """The residuals and their derivatives at ζ (D,)."""
    density, x = chart.density, chart.at(zeta)
    starts = np.where(density.of_starts < len(x), np.append(x, 0.0)[density.of_starts], density.point.starts)
    return density.question.follow(x[: len(density.point.u)], starts)


def _jacobians(chart: Chart, trial: Point, zeta: np.ndarray, states: int) -> list[np.ndarray]:
    """The slopes of the weighted residuals of every batch by ζ, (N, T, S, d)."""
    density = chart.density
    question, free, places = density.question, len(density.point.u), _places(density, states)
    padded = np.pad(chart.columns(zeta), (0, 1))
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
