"""Coordinates in which a posterior density is nearly round, and its expansion to second order in them.

**`Chart`** has coordinates z of the unknowns in which their posterior is nearly round, beside a bound too.

Residuals are more nearly linear in a number y than in its logarithm, and beside a bound a posterior is a normal density
of y that the bound cuts off. The search's own unknown u = log y has a variance (σ/y)² there, which means nothing where
y is smaller than its standard error σ. So the numbers y of `positive` and `between` take the place of their u:

    y = ŷ + L ζ,      L Lᵀ the covariance of y,      y_b = φ(t),      t = t̂ + L_bb z

for the bounded numbers y_b, which come first, and ζ = z for all others. With s(τ) = log(1 + e^τ), the map

    φ(t) = a + σ [s((t − a)/σ) − s((t − b)/σ)]

from all real t onto (a, b) is t itself a few σ inside of both bounds, and falls off exponentially where t lies beyond.
A density of y that is flat at its bound has there the logarithm t/σ: no wall, and one length for all directions. The
density stays that of the unknowns x: `log_volume` is the logarithm of |∂x/∂z|.

Stan takes log y for a number above a bound (Stan Reference Manual, *Constraint transforms*): the two agree where y is
known to a few per cent, and y alone stays round where it is known worse.

**`Surrogate`** is the density of a posterior whose residuals are expanded to second order about the fit.

With the coordinates ζ of `Chart`, in which the covariance of the fit is one, every residual is

    r(ζ) ≈ r(0) + J ζ + ½ ζᵀ H ζ,        H eᵢ = [J(h eᵢ) − J(−h eᵢ)] / (2 h),   h ≤ 1,

with exact Jacobians J: central differences over one standard deviation, or as far as a bound lets them, take along what
bends at the scale of the posterior. Prior, volumes and the law of the noise are kept as they are. A value and its
gradient cost products of matrices and no motion; `_sample` corrects for what is left with the exact density. Given the
parameters, starts are independent, so that all of them move in one trial, and 2 (F + 2n) trials do for any number of
records.

Source: Christen & Fox, J. Comput. Graph. Stat. 14 (2005) 795, for approximations inside of a chain that is exact.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit.model._density import Density
from lagjax._fit.model._residuals import LostMotion, Point, Trial, compress_rows
from lagjax._fit.model._transforms import AbstractSeparable

# In σ: a centre nearer to a bound is moved to here, where φ′ = ½ (log 2), so that both sides of it are inside the set.
_NEAREST = float(np.log(2.0))


class Chart(NamedTuple):
    """The coordinates z (D,), where z = 0 is y = `centre` (D,), and ζ moves y by `root` (D, D). `bounded` (B,) are the
    places of numbers between `low` and `high` (B,); `scale` (B,) is σ, `middle` (B,) is t̂."""

    density: Density
    centre: np.ndarray
    root: np.ndarray
    bounded: np.ndarray
    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray
    middle: np.ndarray

    @staticmethod
    def from_density(density: Density) -> "Chart":
        """The chart about a fit. Raises `ValueError` where something is not seen."""
        parameters, u = density.residuals.parameters, density.point.u
        ends = np.array([transform.bounds for transform in parameters.maps]).reshape(-1, 2)
        bounded = np.flatnonzero(np.isfinite(ends).any(axis=1))
        low, high = ends[bounded].T
        y, by_u = density.first.copy(), np.ones(len(density))
        for k in bounded.tolist():
            own = cast(AbstractSeparable, parameters.maps[k])
            y[k], by_u[k] = own.value(u[k]), own.slope(u[k])
        covariance = density.covariance() * np.outer(by_u, by_u)
        narrowed = np.ones(len(density))  # where data say less than the bounds, these say how wide the density is
        deviation = np.sqrt(np.diag(covariance)[bounded])
        narrowed[bounded] = scale = np.minimum(deviation, 0.5 * (high - low)) / deviation
        scale = scale * deviation
        order = np.concatenate([bounded, np.setdiff1d(np.arange(len(density)), bounded)])
        root, count = np.zeros_like(covariance), len(bounded)
        root[order] = np.linalg.cholesky((covariance * np.outer(narrowed, narrowed))[np.ix_(order, order)])
        inside = np.clip(y[bounded], low + _NEAREST * scale, high - _NEAREST * scale)
        centre = y + root[:, :count] @ np.linalg.solve(root[bounded, :count], inside - y[bounded])
        centre[bounded] = inside
        offset = (inside - low) / scale
        middle = offset + np.log(-np.expm1(-offset)) - np.log(-np.expm1((inside - high) / scale))
        return Chart(density, centre, root, bounded, low, high, scale, low + scale * middle)

    def __call__(self, z):
        """x (D,), ζ (D,) and the logarithm of |∂x/∂z|, up to a constant, at z (D,)."""
        array = lambda of: jnp.asarray(of, z.dtype)  # noqa: E731
        b, count = self.bounded, len(self.bounded)
        own, finite = array(self.root[b, :count]), np.isfinite(self.high)
        t = array(self.middle) + own @ z[:count]
        above, below = (t - array(self.low)) / array(self.scale), (t - array(self.high)) / array(self.scale)
        to_low = jax.nn.softplus(above) - jax.nn.softplus(below)  # the distances of y from its bounds, over σ
        to_high = jnp.where(finite, jax.nn.softplus(-below) - jax.nn.softplus(-above), 1.0)
        moved = array(self.low - self.centre[b]) + array(self.scale) * to_low
        zeta = z.at[:count].set(jax.scipy.linalg.solve_triangular(own, moved, lower=True))
        x = array(self.centre) + array(self.root) @ zeta
        one = array(np.where(finite, 1.0, self.scale))  # u = log[(y − a)/(b − y)], or log(y − a)
        x = x.at[b].set(jnp.log(one * to_low) - jnp.log(to_high))
        steep = jax.nn.log_sigmoid(above) + jax.nn.log_sigmoid(-below)
        return x, zeta, jnp.sum(steep - jnp.log(to_low) - jnp.log(to_high))

    def log_density(self, z):
        """The logarithm of the posterior density of z (D,), up to a constant; −∞ where that is no number."""
        x, _, volume = self(z)
        total = self.density(x) + volume
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def evaluate_unknowns(self, zeta: np.ndarray) -> np.ndarray:
        """The unknowns x (D,) where y = centre + root ζ is inside of its bounds."""
        x = self.centre + self.root @ zeta
        y = x[self.bounded]
        with np.errstate(divide="ignore"):
            x[self.bounded] = np.log(y - self.low) - np.where(np.isfinite(self.high), np.log(self.high - y), 0.0)
        return x

    def jacobian(self, zeta: np.ndarray) -> np.ndarray:
        """∂x/∂ζ (D, D)."""
        by_y = np.ones(len(self.centre))
        y = (self.centre + self.root @ zeta)[self.bounded]  # of log[(y − a)/(b − y)], or log(y − a) where b is infinite
        by_y[self.bounded] = 1.0 / (y - self.low) + 1.0 / (self.high - y)
        return by_y[:, None] * self.root

    def room(self, ways: np.ndarray) -> np.ndarray:
        """The reach of ζ from zero, both ways, along each of `ways` (D, K), (K,): nine tenths of the way to a bound. A
        number that is not bounded has room for one standard deviation."""
        y = self.centre[self.bounded, None]
        most = 0.9 * np.minimum(y - self.low[:, None], self.high[:, None] - y)
        moved = np.abs(self.root @ ways)[self.bounded]
        with np.errstate(divide="ignore"):
            return np.min(most / moved, axis=0, initial=1.0)


# Numbers of all expansions together: 32 MiB that every step of a trajectory reads. Many more, and a motion is cheaper.
_LARGEST = 4_000_000


class Block(NamedTuple):
    """The expansions of one batch, in units of the weights: `rows` (N, T, S, Q), and which `counts` (N, T, S).

    The Q coefficients are of 1, of the d numbers ζ that a piece depends on, and of their products ζᵢζⱼ, i ≤ j. `own`
    (N, d) are the places of these numbers in z; `sides` are those of the samples.
    """

    rows: np.ndarray
    counts: np.ndarray
    own: np.ndarray
    sides: np.ndarray | None


class Surrogate(NamedTuple):
    """log π*(z), called with coordinates z (D,) of the chart."""

    chart: Chart
    blocks: list[Block]

    def __call__(self, z):
        """The logarithm of the approximate density of z, up to the constant of `Chart.log_density`."""
        x, zeta, volume = self.chart(z)
        padded = jnp.append(zeta, 0.0)  # where the start of a piece is known its numbers are those of the last place
        weighted, density = [self._residuals(block, padded) for block in self.blocks], self.chart.density
        flags = [block.counts for block in self.blocks], [block.sides for block in self.blocks]
        log_likelihood = density.weighted_log_likelihood(weighted, *flags, density.unknowns(x))
        total = density.posterior(x, log_likelihood) + volume
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    @staticmethod
    def _residuals(block: Block, padded):
        own = padded[block.own]
        first, second = np.triu_indices(own.shape[1])
        powers = jnp.concatenate([jnp.ones((len(own), 1), own.dtype), own, own[:, first] * own[:, second]], axis=1)
        return jnp.einsum("ntsq,nq->nts", jnp.asarray(block.rows, own.dtype), powers)


class Unexpanded(Exception):
    """There is no expansion, or it is not good enough to draw from: its argument says why."""


def expand_residuals(chart: Chart) -> Surrogate:
    """The expansion about the centre of a chart. Raises `Unexpanded` where there is none."""
    density = chart.density
    residuals, free = density.residuals, len(density.point.u)
    states = residuals.states if residuals.fitted.any() else 0
    columns = (states + free + 1) * (states + free + 2) // 2
    plain = not np.isfinite(density.noise.dof).any() and residuals.sides is None  # rows are then compressed
    shapes = [batch.weights.shape for batch in residuals.batches]
    size = columns * sum(n * s * (min(t, columns) if plain else t) for n, t, s in shapes)
    if size > _LARGEST:
        raise Unexpanded(f"The expansion of its residuals to second order takes {size} numbers, more than {_LARGEST}.")
    middle, slopes, bends = _differentiate_twice(chart, states)
    blocks = []
    for k, batch in enumerate(residuals.batches):
        first = np.sqrt(batch.weights) * middle.residuals[k]
        rows, counts = _polynomials(first, slopes[k], bends[k]), batch.weights > 0
        if plain and rows.shape[1] > rows.shape[3]:
            rows = np.stack([compress_rows(rows[:, :, s]) for s in range(rows.shape[2])], axis=2)
            counts = np.ones(rows.shape[:3], bool)
        blocks.append(Block(rows, counts, _places(density, states)[batch.rows], batch.sides))
    return Surrogate(chart, blocks)


def _differentiate_twice(chart: Chart, states: int) -> tuple[Trial, list[np.ndarray], list[np.ndarray]]:
    """The trial at the centre, and of every batch J (N, T, S, d) and H (N, T, S, d, d)."""

    def evaluate(zeta: np.ndarray) -> tuple[Trial, list[np.ndarray]]:
        density, x = chart.density, chart.evaluate_unknowns(zeta)
        starts = np.where(density.start_places < len(x), np.append(x, 0.0)[density.start_places], density.point.starts)
        try:
            trial = density.residuals.evaluate(Point(x[: len(density.point.u)], starts))
        except LostMotion as reason:
            raise Unexpanded(f"One standard deviation from the fit a motion fails. {reason}") from None
        return trial, _jacobians(chart, trial, zeta, states)

    ways, columns = _directions(chart.density, states), []
    middle, slopes = evaluate(np.zeros(len(chart.centre)))
    for way, step in zip(ways.T, chart.room(ways), strict=True):
        right, left = evaluate(step * way)[1], evaluate(-step * way)[1]
        columns.append([(more - less) / (2 * step) for more, less in zip(right, left, strict=True)])
    return middle, slopes, [np.stack(bends, axis=-1) for bends in zip(*columns, strict=True)]


def _places(density: Density, states: int) -> np.ndarray:
    """The places in z (N, d) of the numbers that every piece depends on: those of its start, then the parameters'."""
    starts, free = density.start_places[:, :states], np.arange(len(density.point.u))
    return np.concatenate([starts, np.broadcast_to(free, (len(starts), len(free)))], axis=1)


def _directions(density: Density, states: int) -> np.ndarray:
    """The directions of ζ (D, d), one for every number of a piece, where the numbers of all starts move together."""
    places = _places(density, states)
    ways = np.zeros((len(density) + 1, places.shape[1]))
    for row in places:
        ways[row, np.arange(len(row))] = 1.0
    return ways[:-1]


def _jacobians(chart: Chart, trial: Trial, zeta: np.ndarray, states: int) -> list[np.ndarray]:
    """The slopes of the weighted residuals of every batch by ζ, (N, T, S, d)."""
    density = chart.density
    residuals, free, places = density.residuals, len(density.point.u), _places(density, states)
    padded = np.pad(chart.jacobian(zeta), (0, 1))
    columns = [padded[np.ix_(row, row)] for row in places]  # of the start and the parameters by ζ
    found = []
    for batch, slopes in zip(residuals.batches, trial.slopes, strict=True):
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
