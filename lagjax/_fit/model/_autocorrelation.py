"""Autocorrelation of residuals: how many independent samples correlated ones are worth.

At 1 kHz residuals hold what the scene lacks, and neighbours agree: n samples are worth n/τ independent ones, with τ the
sum of the correlations over all lags. Source: Geyer, *Practical Markov chain Monte Carlo*, Stat. Sci. 7 (1992) 473, for
where correlations end; Newey & West, Econometrica 55 (1987) 703, for tapers whose spectrum has no negative parts; Berk,
Ann. Stat. 2 (1974) 489, and den Haan & Levin, Handbook of Statistics 15 (1997) 299, for autoregressions instead. A
taper shortens correlations that fall slowly, an autoregression does not. The longer of both counts.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_toeplitz

from lagjax._fit.model._noise import NoiseScale, likelihood_slopes
from lagjax._fit.model._residuals import Residuals, Trial


class Correlation(NamedTuple):
    """The autocorrelation of a signal: lags 0, 1, … tapered to zero, their sum over all lags, the number of samples."""

    lags: np.ndarray
    time: float
    count: int
    neighbour: float


def autocorrelations(
    residuals: Residuals, point: Trial, noise: NoiseScale, fitted: np.ndarray | None = None
) -> list[Correlation]:
    """The correlation of each signal's noise. `fitted` (S, T): Σ gᵢ gᵢ₊ₖ over the directions g that were fitted."""
    fitted = np.zeros((len(noise.sigma), 1)) if fitted is None else fitted
    pairs = (_residual_products(residuals, point, noise, signal) for signal in range(len(noise.sigma)))
    return [noise_correlation(*pair, lost) for pair, lost in zip(pairs, fitted, strict=True)]


def noise_correlation(sums: np.ndarray, count: int, fitted: np.ndarray) -> Correlation:
    """The correlation of noise from the lag products (T,) of `count` residuals, and of unit directions `fitted` (T′,).

    Along what was fitted residuals have lost their noise, whose power there is f = Σ cₖ Σ gᵢ gᵢ₊ₖ/Σ gᵢ² for
    correlations c. It is added again: residuals alone forget sooner than the noise does.
    """
    law, lost = _correlation(sums, count), fitted[: len(sums)]
    for _ in range(_ROUNDS if len(law.lags) > 1 and lost[0] > 0 else 0):
        power = (2 * lost[: len(law.lags)] @ law.lags[: len(lost)] - lost[0]) / lost[0]
        if not power * lost[0] < _MOST_FITTED * count:  # residuals hold motion, or little else was there
            break
        whole = sums.copy()
        whole[: len(lost)] += power * sums[0] / (count - power * lost[0]) * lost
        law = _correlation(whole, count)
    return law


def _residual_products(residuals: Residuals, point: Trial, noise: NoiseScale, signal: int) -> tuple[np.ndarray, int]:
    """The lag products (T,) of one signal's residuals in units of their scatter, and the number of its samples."""
    dof = noise.dof[signal]
    sums, count = np.zeros(1), 0
    for batch, r in zip(residuals.batches, point.residuals, strict=True):
        z = np.sqrt(batch.weights[..., signal]) * r[..., signal] / noise.sigma[signal]
        z, curvature = likelihood_slopes(z, None if batch.sides is None else batch.sides[..., signal])
        if not np.isinf(dof):
            z = z * (dof + 1) / (dof + z**2)  # what enters the likelihood's slope
        counted = batch.weights[..., signal] > 0
        own = lag_products(z / np.sqrt(np.maximum(curvature, 1e-99)), counted)
        count += round(curvature.sum(where=counted))
        length = max(len(sums), len(own))
        sums = np.pad(sums, (0, length - len(sums))) + np.pad(own, (0, length - len(own)))
    return sums, count


def _correlation(sums: np.ndarray, count: int) -> Correlation:
    """The correlation cut at two standard errors and tapered by Parzen's window, or that of an autoregression, if its
    sum is larger, from lag products (T,) of `count` samples."""
    law = sums / sums[0] if sums[0] > 0 else np.eye(1, len(sums))[0]
    insignificant = np.flatnonzero(law <= 2.0 / np.sqrt(count))
    cut = int(insignificant[0]) if len(insignificant) else len(law)
    if cut <= 1:
        return Correlation(np.ones(1), 1.0, count, float(law[1]) if len(law) > 1 else 0.0)
    x = np.arange(min(3 * cut, len(law))) / (3 * cut)
    lags = law[: 3 * cut] * np.where(x < 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)
    noise_like = autoregressive_lags(law, count)
    if np.abs(noise_like[len(law) // _FORGETS :]).max(initial=0.0) < 2.0 / np.sqrt(count):
        lags = max(lags, noise_like, key=np.sum)
    return Correlation(lags, float(max(1.0, lags[0] + 2 * lags[1:].sum())), count, float(law[1]))


_ROUNDS = (
    3  # in which the power of fitted noise is found: each leaves a part (unknowns/independent samples) of an error
)
_MOST_FITTED = 0.5  # of the power of the noise, along what was fitted
_MOST_ORDER = 20  # of autoregressions
_FORGETS = 10  # part of a record after which noise is forgotten: residuals that remember longer hold motion, not noise


def autoregressive_lags(law: np.ndarray, count: int) -> np.ndarray:
    """The correlations at the lags of `law`, from 1 on, of the autoregression that has the first of them, of the order
    that Schwarz's criterion takes for `count` samples."""
    best, chosen = np.inf, np.zeros(0)
    for order in range(1, min(_MOST_ORDER, len(law) // 4) + 1):
        weights = solve_toeplitz(law[:order], law[1 : order + 1])
        left = 1.0 - weights @ law[1 : order + 1]  # of the variance, once the past is known
        if not left > np.finfo(float).eps:
            break
        if (criterion := count * np.log(left) + order * np.log(count)) < best:
            best, chosen = criterion, weights
    lags = law.copy()
    for k in range(len(chosen) + 1, len(lags)):
        lags[k] = chosen @ lags[k - len(chosen) : k][::-1]
    return lags if len(chosen) else np.ones(1)


def lag_products(rows: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Σ zᵢ zᵢ₊ₖ over rows (N, T) for the lags k = 0 … T − 1, of samples that count."""
    rows = close_gaps(rows, counted)
    spectrum = np.abs(np.fft.rfft(rows, 2 * rows.shape[1])) ** 2
    return np.fft.irfft(spectrum.sum(axis=0), 2 * rows.shape[1])[: rows.shape[1]]


_LAGS = 20  # of residuals that hold motion some are correlated over the first lags, unless a period has two samples
_CHANCE = 4.0  # standard errors of a correlation: white residuals show it at one of this many lags in 1 of 800 fits


def first_lag_products(rows: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Σ zᵢ zᵢ₊ₖ of each row (N, T) for the first lags k, (N, K), of samples that count."""
    rows = close_gaps(np.where(counted, rows, 0.0), counted)
    found = np.zeros((len(rows), _LAGS + 1))
    for k in range(min(_LAGS + 1, rows.shape[1])):
        found[:, k] = np.sum(rows[:, k:] * rows[:, : rows.shape[1] - k], axis=1)
    return found


def correlated_power(sums: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The mean square (R,) of the correlated part of residuals: the largest product of neighbours, to which white noise
    adds nothing, of sums of products (R, K) over `count` (R,) samples; zero where no correlation exceeds chance."""
    highest = np.abs(sums[:, 1:]).max(axis=1)
    seen = (count > 1) & (sums[:, 0] > 0) & (highest * np.sqrt(count) > _CHANCE * sums[:, 0])
    return np.where(seen, highest / np.maximum(count, 1), 0.0)


def close_gaps(rows: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """The rows (N, T, ...) with what `counted` (N, T) in front: the neighbour of a sample is the next measured one."""
    if counted.all():
        return rows
    order = np.argsort(~counted, axis=1, kind="stable")
    return np.take_along_axis(rows, order.reshape(*order.shape, *[1] * (rows.ndim - 2)), axis=1)


def correlated_square(rows: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """GᵀC G of each of N pieces `rows` (N, T, L), (N, L, L), where C has the correlations `lags`."""
    if len(lags) == 1:
        return rows.swapaxes(1, 2) @ rows
    lags = lags[: rows.shape[1]]
    size = rows.shape[1] + len(lags)
    kernel = np.zeros(size)
    kernel[: len(lags)] += lags
    kernel[-np.arange(1, len(lags))] += lags[1:]
    spectrum = np.fft.rfft(kernel).real
    smooth = np.fft.irfft(np.fft.rfft(rows, size, axis=1) * spectrum[:, None], size, axis=1)[:, : rows.shape[1]]
    return rows.swapaxes(1, 2) @ smooth


def independent_share(residuals: Residuals, point: Trial, noise: NoiseScale) -> float:
    """The number of independent samples that one sample is worth, over all signals: at most 1."""
    laws = autocorrelations(residuals, point, noise)
    return sum(law.count / law.time for law in laws) / max(sum(law.count for law in laws), 1)
