"""The information of the data about the parameters: their covariance, and directions that nothing depends on.

With the starts eliminated, a small change of the measurements by ε moves the free parameters by H⁻¹ Gᵀ ε: G has the
rows of the parameters, made orthogonal to those of the starts, in units of the noise, and H = GᵀG. So

    covariance = H⁻¹ (Gᵀ C G) H⁻¹,      C the correlation of the residuals, from the residuals themselves

For white noise C = 1. At 1 kHz residuals are not white: they hold what the model lacks, and H⁻¹ alone would give
intervals many times too small. Source: Newey & West, Econometrica 55 (1987) 703.

Directions that nothing depends on have no variance: they are found as null directions of G (`null_space`), their
parameters have infinite variance, and nothing is inverted there.

Over a chaotic record sensitivities grow until all columns point along the one direction that grows fastest, and
rounding hides the rest: G seems to have null directions where it has none. Null directions are the same whatever the
rows are multiplied by, so they are looked for a second time where every row has length one (`confirmed`): what is null
there is not seen, and what is not was drowned. Where rows grow by more than there are digits, all are.
"""

import contextlib
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from lagjax._equations import truncated_svd
from lagjax._fit.model._autocorrelation import autocorrelations, close_gaps, correlated_square, lag_products
from lagjax._fit.model._noise import NoiseScale, rounding_harmonics, rounding_square
from lagjax._fit.model._parameters import Unknowns
from lagjax._fit.model._residuals import Residuals, Trial, compress_rows
from lagjax._fit.search._descent import Descent

LEVEL = 0.95  # the probability with which an interval holds its number, where no other one is given

# Singular values below this fraction of the largest, of columns of length one, are null: derivatives are as accurate
# as the motion, to 1e-9, and a direction that is really seen so little would need a million times the data.
NULL = 1e-7

# By how much the rows of a record grow before they can drown each other: a hundredth of what `NULL` tells from nothing,
# so that two columns which grow like this still differ in their early rows where this says nothing.
_GROWTH = 1e-2 / NULL

# By how much they grow before the last digit of a number moves signals by their size: what was computed then is one
# motion of many, and no derivative of it says how well anything is known.
_LOST = 1.0 / np.finfo(float).eps

_FAR = 0.1  # of the least singular value, told by a bound of it: an inverse of F columns is right to so much
# The length of a column below which it is zero: one over it must have a square, and some room, among finite numbers.
_NOTHING = 1e-140
_DETERMINES = 0.5  # numbers: a signal that determines fewer widens no interval
_UNFELT = 1e-10  # of the largest singular value of a start: a direction of it that nothing depends on


class Information(NamedTuple):
    """The information of the data about F free parameters.

    - `covariance` (F, F) of u; infinite variance and NaN beside it where a parameter is not seen.
    - `null` (F, K): the K directions of u that nothing depends on, as far as rounding lets one tell; `confirmed` are
      those among them that nothing depends on.
    - `effective` (S,): the number of samples of each signal that independent ones would need to say as much.
    - `fitted` (S,): how many of all fitted numbers, starts among them, each signal determines.
    - `correlation` (S,): the correlation of neighbouring residuals, less what rounding makes of it.
    - `white` (F, F): the covariance if residuals were white, zero where nothing is seen; `lost`: by how much variances
      are larger because unknowns were fitted.
    """

    covariance: np.ndarray
    null: np.ndarray
    confirmed: np.ndarray
    effective: np.ndarray
    fitted: np.ndarray
    correlation: np.ndarray
    white: np.ndarray
    lost: float

    @property
    def identifiable(self) -> np.ndarray:
        """The covariance (F, F) of u along directions that data determine, zero along others."""
        return self.lost * self.white if self.null.size else self.covariance

    def select(self, places: np.ndarray) -> "Information":
        """The information about the unknowns at `places` (F for none) alone."""
        pair = np.ix_(places, places)
        covariance, white = (np.pad(x, (0, 1))[pair] for x in (self.covariance, self.white))
        null, confirmed = (np.pad(x, ((0, 1), (0, 0)))[places] for x in (self.null, self.confirmed))
        return self._replace(covariance=covariance, white=white, null=null, confirmed=confirmed)

    def quantile(self, level: float) -> float:
        """Student's t quantile of a level; degrees of freedom: effective samples minus fitted numbers, of the signal
        that has the fewest of those that determine any."""
        require_level(level)
        spare = np.where(self.fitted > _DETERMINES, self.effective - self.fitted, np.inf)
        return float(stdtrit(max(float(spare.min()), 1.0), 0.5 + 0.5 * level))


def require_level(level) -> None:
    if not (np.ndim(level) == 0 and 0 < level < 1):
        raise ValueError(f"level must be between 0 and 1, as {LEVEL} is; got {level!r}.")


def information(descent: Descent) -> Information:
    residuals, trial, noise = descent.residuals, descent.trial, descent.noise
    factors = residuals.fisher_factors(trial, noise)
    triangles, unknowns = residuals.triangles(trial, factors), residuals.unknowns
    prior = residuals.parameters.prior_weights
    null, basis = null_space(triangles, residuals.states, unknowns, prior)
    # Growth alone is not enough: a drive that sets in smoothly begins with rows as small as numbers can be.
    free, states = len(trial.u), residuals.states
    if _largest_slope(residuals, trial) > _LOST and growth(row_sizes(residuals, trial)) > _LOST:
        null, basis = np.eye(free), np.zeros((free, 0))
    unit = _lengths(triangles, states, unknowns, prior)  # of columns: their squares may be no numbers
    unit_of = np.append(unit, 1.0)[unknowns.columns][:, None, None]
    basis = basis * unit[:, None]
    rows = parameter_rows(triangles, states, unknowns) / unit
    square = rows.T @ rows + np.diag((prior / unit) ** 2)
    half = basis @ np.linalg.solve(basis.T @ square @ basis, basis.T) if null.size else np.linalg.inv(square)
    weighted = [factor[..., None] * slopes for factor, slopes in zip(factors, trial.slopes, strict=True)]
    rows_of = [eliminate_starts(triangles[residuals.leads[b.rows]], own, states) / unit_of[b.rows]
               for b, own in zip(residuals.batches, weighted, strict=True)]  # fmt: skip
    products = _fitted_products(residuals, triangles, weighted, rows_of, half)
    laws, fitted = autocorrelations(residuals, trial, noise, products), products[:, 0]
    # Each signal lost variance where it was fitted; `lost` is the average of that.
    samples = np.array([law.count / law.time for law in laws])
    left = np.maximum(np.append(samples - fitted, (samples - fitted).sum()), 1.0)
    own_loss = samples / left[:-1] * left[-1] / samples.sum()
    rows_of = [own * np.sqrt(own_loss)[:, None] for own in rows_of]
    middle, effective, correlation = _noisy_square(residuals, trial, noise, rows_of, laws, prior / unit)
    # Student's t tells (ν+1)/(ν+3) of what a Gaussian of the same σ tells; the dof that were used up are counted.
    used = free - null.shape[1] + residuals.free_states
    lost = max(effective.sum() / max(effective.sum() - used, 1.0), 1.0)
    robust = np.mean([1.0 if np.isinf(d) else (d + 3) / (d + 1) for d in noise.dof])
    white = robust * half / unit / unit[:, None]
    covariance = lost * robust * half @ middle @ half.T / unit / unit[:, None]
    unseen = np.linalg.norm(null, axis=1) > 1e-6 if null.size else np.zeros(free, bool)
    covariance[unseen] = np.nan
    covariance[:, unseen] = np.nan
    covariance[unseen, unseen] = np.inf
    confirmed = null if not null.size else confirmed_null(residuals, trial, null)
    return Information(covariance, null, confirmed, effective, fitted, correlation, white, float(lost))


def _noisy_square(residuals: Residuals, trial: Trial, noise: NoiseScale, rows_of: list, laws: list, prior: np.ndarray):
    """GᵀC G (F, F) of the rows G of unknowns with the correlations C, with a `prior` (F,); `effective` samples (S,) and
    the `correlation` (S,) of neighbours."""
    unknowns = residuals.unknowns
    effective, correlation = (np.array(x) for x in zip(*((a.count / a.time, a.neighbour) for a in laws), strict=True))
    share = effective.sum() / max(sum(law.count for law in laws), 1)  # a prior is worth more beside correlated samples
    middle = np.diag(prior**2 / share)
    for batch, own in zip(residuals.batches, rows_of, strict=True):
        columns = unknowns.select(batch.rows)
        for s in np.flatnonzero(np.isnan(residuals.sensor.step)):
            middle += columns.add(correlated_square(close_gaps(own[:, :, s], batch.weights[..., s] > 0), laws[s].lags))
    for s in np.flatnonzero(np.isfinite(residuals.sensor.step)).tolist():
        sigma, step = noise.sigma[s] / residuals.unit[s], residuals.sensor.step[s]
        _, rest, before = rounding_harmonics(step, sigma)
        rows = [np.sqrt(b.weights[..., s, None]) / noise.sigma[s] * own[:, :, s]
                for b, own in zip(residuals.batches, rows_of, strict=True)]  # fmt: skip
        for g, b in zip(rows, residuals.batches, strict=True):
            g, columns = close_gaps(g, b.weights[..., s] > 0), unknowns.select(b.rows)
            middle += columns.add(before * correlated_square(g, laws[s].lags) + rest * correlated_square(g, np.ones(1)))
        rows = [unknowns.select(b.rows).spread(g) for b, g in zip(residuals.batches, rows, strict=True)]
        middle += rounding_square(rows, residuals.exact_values(trial, s), step, sigma)
        share = min(before / sigma**2, 1.0)
        worth = sum(float(w.sum()) for w in residuals.worths(trial, noise, s))
        effective[s], correlation[s] = worth / (1 + (laws[s].time - 1) * share), share * correlation[s]
    return middle, effective, correlation


def _fitted_products(residuals: Residuals, triangles, weighted: list, rows_of: list, half: np.ndarray) -> np.ndarray:
    """The lag products (S, T) of the directions in which fitted unknowns, and starts, took noise out of residuals."""
    states, signals = residuals.states, len(residuals.size)
    total = np.zeros((signals, max(own.shape[1] for own in rows_of)))
    for batch, raw, own in zip(residuals.batches, weighted, rows_of, strict=True):
        columns = np.minimum(residuals.unknowns.columns[batch.rows], len(half))
        values, vectors = np.linalg.eigh(np.pad(half, (0, 1))[columns[:, :, None], columns[:, None]])
        found = [own @ (vectors * np.sqrt(np.maximum(values, 0.0))[:, None])[:, None]]
        if states:
            of_starts = truncated_svd(triangles[residuals.leads[batch.rows], :states, :states], _UNFELT)
            found.append(raw[..., :states] @ of_starts.whitened[:, None])
        for s in range(signals):
            counted = batch.weights[..., s] > 0
            for direction in np.moveaxis(np.concatenate(found, axis=-1)[:, :, s], -1, 0):
                total[s, : own.shape[1]] += lag_products(direction, counted)
    return total


def _largest_slope(residuals: Residuals, trial: Trial) -> float:
    """The largest derivative of a signal, as a fraction of its size, by an unknown, as a fraction of its own."""
    sizes = np.append(residuals.parameters.sizes(trial.u), 0.0)[residuals.unknowns.columns][:, None, None]
    pairs = zip(residuals.batches, trial.slopes, strict=True)
    units = residuals.size[:, None]
    return max(np.abs(x[..., residuals.states :] * sizes[b.rows] / units).max(initial=0.0) for b, x in pairs)


def null_space(
    triangles: np.ndarray, states: int, unknowns: Unknowns, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of u (F, K) that nothing depends on, the starts being free, and on which no prior of weights (F,) has
    an opinion; and a basis (F, F − K) of the others."""
    rows, unit = parameter_rows(triangles, states, unknowns), _lengths(triangles, states, unknowns, prior)
    if prior.any():
        rows = np.concatenate([rows, np.diag(prior)])
    if not len(unit) or _is_regular(rows / unit):
        return np.zeros((len(unit), 0)), np.diag(1.0 / unit)
    # From above zero by its own round-off, so that a column which is noise alone counts as nothing.
    decided = truncated_svd(rows / unit, NULL, NULL)
    null = decided.null / unit[:, None]
    return null / _norm(null, 0), decided.right[:, : int(decided.rank)] / unit[:, None]


def _is_regular(rows: np.ndarray) -> bool:
    """True if a square matrix (F, F) has no singular value near those that count as null, told by its inverse."""
    if rows.shape[0] == rows.shape[1]:
        with contextlib.suppress(np.linalg.LinAlgError), np.errstate(over="ignore", invalid="ignore"):
            return bool(_FAR / np.linalg.norm(np.linalg.inv(rows)) > NULL * max(1.0, np.linalg.norm(rows)))
    return False


def confirmed_null(residuals: Residuals, point: Trial, null: np.ndarray) -> np.ndarray:
    """The null directions, of (F, K), that are not the work of rounding, (F, K′)."""
    sizes = row_sizes(residuals, point)
    if growth(sizes) < _GROWTH:
        return null
    with np.errstate(divide="ignore"):
        level = [np.where(size > 0, 1.0 / size, 0.0) for size in sizes]
    prior = residuals.parameters.prior_weights
    return null_space(residuals.triangles(point, level), residuals.states, residuals.unknowns, prior)[0]


def row_sizes(residuals: Residuals, point: Trial) -> list[np.ndarray]:
    """The length of the row of each sample (N, T, S) of every batch, its columns as fractions of their largest."""
    largest = np.max([np.abs(slopes).max(axis=(0, 1, 2)) for slopes in point.slopes], axis=0)
    columns, pairs = np.where(largest > 0, largest, 1.0), zip(residuals.batches, point.slopes, strict=True)
    return [np.where(batch.weights > 0, _norm(slopes / columns, -1), 0.0) for batch, slopes in pairs]


def growth(sizes: list[np.ndarray]) -> float:
    """The growth of rows (N, T, S) along the record in which they grow most, from the first that is not zero."""
    found = 1.0
    for rows in (batch.max(axis=2) for batch in sizes):
        first = np.take_along_axis(rows, np.argmax(rows > 0, axis=1)[:, None], axis=1)[:, 0]
        found = max(found, float((rows.max(axis=1) / np.where(first > 0, first, 1.0)).max(initial=1.0)))
    return found


def parameter_rows(triangles: np.ndarray, states: int, unknowns: Unknowns) -> np.ndarray:
    """The rows of the unknowns, orthogonal to those of the starts: F of F columns where all records have as many
    numbers of their own, which are eliminated one record after the other."""
    rows, own = unknowns.stack_by_owner(eliminate_starts(triangles, triangles[..., :-1], states)), unknowns.own
    r = compress_rows(rows) if own else rows
    rest, first = r[:, own:, own:], unknowns.owner_rows
    rest = compress_rows(rest.reshape(1, rest.shape[0] * rest.shape[1], rest.shape[2]))
    last = first.select([0]).spread(np.pad(rest, ((0, 0), (0, 0), (own, 0))))[0]
    alone = first.spread(r[:, :own])
    return np.concatenate([alone.reshape(len(alone) * own, unknowns.count), last])


def _lengths(triangles: np.ndarray, states: int, unknowns: Unknowns, prior: np.ndarray) -> np.ndarray:
    """The length of the column of each unknown (F,), with the row of its prior; one for a column of nothing."""
    length = np.hypot(unknowns.norms(_norm(triangles[..., states:-1], 1)), prior)
    return np.where(length > _NOTHING, length, 1.0)


def _norm(x: np.ndarray, axis) -> np.ndarray:
    """The Euclidean norm along axes, also where squares are no numbers."""
    largest = np.abs(x).max(axis=axis, keepdims=True)
    unit = np.where(largest > 0, largest, 1.0)
    return np.sqrt(np.sum((x / unit) ** 2, axis=axis)) * unit.squeeze(axis)


def eliminate_starts(triangles: np.ndarray, slopes: np.ndarray, states: int) -> np.ndarray:
    """Columns of parameters less what starts replace, (N, ..., D) → (N, ..., F); unseen directions replace nothing."""
    of_starts, of_u = triangles[..., :states], triangles[..., states:-1]
    if not of_starts.any():
        return slopes[..., states:]
    instead = truncated_svd(of_starts[:, None], _UNFELT).least_norm(of_u.swapaxes(1, 2)).swapaxes(1, 2)
    shape = (len(slopes), *[1] * (slopes.ndim - 3), *instead.shape[1:])
    return slopes[..., states:] - np.matmul(slopes[..., :states], instead.reshape(shape))


def covariance_of_one_start(rows: np.ndarray, states: int, known: Information) -> tuple[np.ndarray, np.ndarray]:
    """The covariance (K, K) of the first `states` columns for fixed others, and how they follow these, from weighted
    rows (T, S, K + L) of samples that count for what they are worth."""
    flat = rows.reshape(-1, rows.shape[-1])
    decided = truncated_svd(flat[:, :states], _UNFELT)
    half = decided.whitened
    return known.lost * half @ half.T, decided.least_norm(flat[:, states:].T).T


def signal_deviations(slopes: np.ndarray, states: int, start: np.ndarray, follows: np.ndarray, known: Information):
    """The standard deviations (T, S) of signals whose derivatives are `slopes` (T, S, 2n + F). The start has the
    covariance `start` (2n, 2n) of its own, and `follows` (2n, F) the parameters."""
    a = slopes[..., :states]
    along = slopes[..., states:] - a @ follows
    return np.hypot(deviations(along, known), np.sqrt(np.einsum("tsi,ij,tsj->ts", a, start, a).clip(0.0)))


def deviations(slopes: np.ndarray, known: Information) -> np.ndarray:
    """The standard deviations (…) of numbers with derivatives (…, F) by u; infinite where one is not seen."""
    variance = np.einsum("...f,fg,...g->...", slopes, known.identifiable, slopes).clip(0.0)
    unseen = (np.abs(slopes @ known.null) > 1e-6 * np.abs(slopes).max(initial=0.0)).any(axis=-1)
    return np.where(unseen, np.inf, np.sqrt(variance))
