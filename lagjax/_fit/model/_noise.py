"""The scatter of measurements about the motion: `Gaussian`, `StudentT` with outliers, and what sensors do to numbers:
`Quantised` rounds them, `Clipped` cuts them off.

A residual e of a signal with width σ and weight w has the standardised size z = √w e/σ. The density is

    Gaussian    ∝ exp(−z²/2)/σ                           every sample counts 1
    StudentT    ∝ (1 + z²/ν)^{−(ν+1)/2}/σ                a sample counts (ν+1)/(ν + z²) ≤ (ν+1)/ν

with σ, and ν, of each signal by maximum likelihood from the residuals themselves. A Student-t fit is a sequence of
weighted least squares: with these counts a smaller weighted sum is a larger likelihood.
Source: Lange, Little & Taylor, *Robust statistical modeling using the t distribution*, JASA 84 (1989) 881.

**A sample at a limit** of its sensor says that the value lies there or beyond: it contributes −log Φ(u), u = ±z. Its
score is ∓λ, λ = φ(u)/Φ(u), and its curvature λ(λ + u) is between 0 and 1, where a sample of a Gaussian has the score z
and the curvature 1. So it enters the least squares with the residual score/curvature and the weight curvature, as in
Fisher scoring, and σ² is the sum of the squares of scores over that of curvatures, times the σ² that these are for.
Source: Tobin, Econometrica 26 (1958) 24; Amemiya, J. Econometrics 24 (1984) 3.

**Rounding to multiples of h** leaves errors ε(x), functions of the exact value x with the period h. Where within a step
the motion lies is not known better than that, so over an offset that is equally likely anywhere in a step

    E ε(x) = 0,    E ε(x) ε(y) = Σₖ aₖ cos(2πk (x − y)/h),    aₖ = h²/(2π²k²) exp(−(2πk s/h)²),    Σₖ aₖ ≤ h²/12

with s the noise before rounding. At rest all errors are one and the same; where the motion advances by a step or more
from sample to sample, or the noise is as large as half of one, they are independent. `sample_worths` counts independent
samples, `rounding_square` gives what least squares with any weights make of such errors: its intervals need no more.
Source: Widrow & Kollár, *Quantization Noise* (2008), ch. 4 and 11.
"""

import abc
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr
from scipy.stats import t

from lagjax._fit.model._records import Record, real_numbers, spread_over_signals

MOST_DOF, LEAST_DOF = 200.0, 1.0  # ν: beyond 200 it is a Gaussian to a percent, below 1 there is not even a mean
_ROUNDS = 30  # of the fixed point for σ, which gains a factor of three or more in each


class NoiseScale(NamedTuple):
    """The noise of S signals: `sigma` (S,), and `dof` ν (S,), infinite for a Gaussian."""

    sigma: np.ndarray
    dof: np.ndarray


class Sensor(NamedTuple):
    """The sensors of S signals: their `step` (S,) of rounding and their limits `low`, `high` (S,); NaN for none."""

    step: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def sides(self, values: np.ndarray) -> np.ndarray | None:
        """1 for samples (..., S) at an upper limit, −1 at a lower one, and 0; None where there are no limits."""
        if np.isnan(self.low).all() and np.isnan(self.high).all():
            return None
        return (values >= self.high).astype(float) - (values <= self.low)

    def bounds_shown(self, values: np.ndarray, weights: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """Samples (..., S) where those at a limit are the exact values from which a rounding sensor shows it."""
        shown = values.copy()
        for k in np.flatnonzero(np.isfinite(self.step)):
            inside = values[..., k][(sides[..., k] == 0) & (weights[..., k] > 0)]
            side, step, offset = sides[..., k], self.step[k], inside[0] if len(inside) else 0.0
            lines = np.ceil(side * (values[..., k] - offset) / step - _LATTICE)
            shown[..., k] = np.where(side != 0, offset + side * (lines - 0.5) * step, values[..., k])
        return shown


class AbstractNoise(abc.ABC):  # noqa: B024
    """A law for the scatter of measurements; unless it says otherwise, the scatter is normal."""

    def estimate(self, residuals: np.ndarray, weights: np.ndarray, least: np.ndarray, sides=None) -> NoiseScale:
        """The noise of S signals that makes these residuals (M, S) likeliest; no σ is smaller than `least` (S,).

        `sides` (M, S), None for zeros, are 1 where a sample is at the upper limit of its sensor, −1 at the lower one.
        """
        counted = (weights > 0) & (True if sides is None else sides == 0)
        sigma = np.sqrt((weights * residuals**2).sum(axis=0, where=counted) / np.maximum(counted.sum(axis=0), 1))
        noise = NoiseScale(np.maximum(sigma, least), np.full(len(least), np.inf))
        for _ in range(_ROUNDS if sides is not None else 0):
            score, curvature = likelihood_slopes(np.sqrt(weights) * residuals / noise.sigma, sides)
            squares, counts = (x.sum(axis=0, where=weights > 0) for x in (score**2, curvature))
            share = squares / np.maximum(counts, 1e-9)
            noise = noise._replace(sigma=np.maximum(noise.sigma * np.sqrt(share), least))
        return noise

    def sensor(self, records: list[Record]) -> "Sensor | None":
        """The sensors that this law states for the records; None: they are to be found in the values."""
        return None


@dataclass(frozen=True)
class Gaussian(AbstractNoise):
    """Normal noise; σ of each signal is estimated from the residuals. It is the default of `fit`.

    Where the records show that a sensor rounds, or is at its limits, the fit takes that into account and says so, as
    with `lagjax.Quantised` and `lagjax.Clipped`.

    ```python
    import lagjax

    noise = lagjax.Gaussian()  # lagjax.fit(..., noise=noise)
    ```
    """


@dataclass(frozen=True)
class Quantised(AbstractNoise):
    r"""Values that a sensor rounds to multiples of `step`, an encoder or a converter of few bits.

    The rounding error is uniform within a step, with the variance step²/12, and noise is estimated beside it. Errors of
    samples between which the motion hardly moves are the same: a run of equal values counts once, and intervals hold
    for a step of any size. A sensor that cuts off instead of rounding (`floor`) shows half a step too little: say so
    in `observe`, `lambda q, qdot: q - step / 2`, or add it to the values.

    `step` is a positive number for all signals, or a prefix of the structure of `values` with one for each, where None
    stands for a signal that is not rounded.

    **Raises** `TypeError` or `ValueError` for what is no step, and in `fit` where values are no multiples of it.

    Source: Widrow & Kollár, *Quantization Noise* (2008).

    ```python
    import math, lagjax

    noise = lagjax.Quantised(2 * math.pi / 4096)  # lagjax.fit(..., noise=noise)
    ```
    """

    step: Any

    def __post_init__(self):
        for leaf in jax.tree.leaves(self.step):
            if not (np.isfinite(step := real_numbers(leaf, "step", "a number")).all() and (step > 0).all()):
                raise ValueError(f"Quantised(step) needs a positive step; got {leaf!r}.")

    def sensor(self, records):
        return Sensor(*(spread_over_signals(x, records[0], "step") for x in (self.step, None, None)))


@dataclass(frozen=True)
class Clipped(AbstractNoise):
    r"""Values that a sensor cuts off at its limits `low` and `high`, with normal noise before that.

    A sample at a limit says that the value lies there or beyond, and contributes the probability of that, Φ(±e/σ).

    Of a sensor that rounds as well this begins half a step before the first line at the limit. Both are numbers for all
    signals, or prefixes of the structure of `values` with one for each; None for no limit.

    **Raises** `TypeError` or `ValueError` for what are no limits, and in `fit` where values are beyond.

    Source: Tobin, Econometrica 26 (1958) 24.

    ```python
    import lagjax

    noise = lagjax.Clipped(-0.8, 0.8)  # lagjax.fit(..., noise=noise)
    ```
    """

    low: Any = None
    high: Any = None

    def __post_init__(self):
        leaves = jax.tree.leaves((self.low, self.high))
        if not leaves or any(np.isnan(real_numbers(leaf, "A limit", "a number")).any() for leaf in leaves):
            raise ValueError(f"Clipped(low, high) needs a limit or two; got {self.low!r} and {self.high!r}.")

    def sensor(self, records):
        return Sensor(*(spread_over_signals(x, records[0], "a limit") for x in (None, self.low, self.high)))


@dataclass(frozen=True)
class StudentT(AbstractNoise):
    """Student's t noise, for outliers; σ and ν of each signal are estimated unless `dof` fixes ν.

    Raises `ValueError` for a `dof` that is not at least 1.

    ```python
    import lagjax

    noise = lagjax.StudentT()  # lagjax.fit(..., noise=noise)
    ```
    """

    dof: float | None = None

    def __post_init__(self):
        if self.dof is not None and not (np.ndim(self.dof) == 0 and np.isfinite(self.dof) and self.dof >= LEAST_DOF):
            raise ValueError(f"StudentT(dof) needs a number of degrees of freedom of at least 1; got {self.dof!r}.")

    def estimate(self, residuals, weights, least, sides=None):
        """σ by its fixed point σ² = mean of c w e² with c = (ν+1)/(ν + z²), ν by search over its logarithm."""
        columns = zip(residuals.T, weights.T, least, strict=True)
        found = [self._fit_signal(np.sqrt(w[w > 0]) * r[w > 0], floor) for r, w, floor in columns]
        return NoiseScale(*np.array(found).T)

    def _fit_signal(self, scaled: np.ndarray, least: float) -> tuple[float, float]:
        if self.dof is not None:
            return _likeliest_sigma(scaled, self.dof, least), float(self.dof)
        # The profile likelihood of log ν has one maximum, or its end.
        cost = lambda x: -t.logpdf(scaled, np.exp(x), scale=_likeliest_sigma(scaled, np.exp(x), least)).mean()  # noqa: E731
        ends = np.log(LEAST_DOF), np.log(MOST_DOF)
        best: Any = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 3e-3})
        dof = float(np.exp(best.x))
        return _likeliest_sigma(scaled, dof, least), dof


@dataclass(frozen=True)
class KnownNoise(AbstractNoise):
    """Noise that is known already, for one more record."""

    known: NoiseScale

    def estimate(self, residuals, weights, least, sides=None):
        return self.known


def _likeliest_sigma(scaled: np.ndarray, dof: float, least: float) -> float:
    """σ of the likeliest Student distribution of ν = `dof` for residuals times the root of their weights."""
    squares = scaled**2
    variance = max(float(np.median(squares)), least**2)
    for _ in range(_ROUNDS):
        new = max(float(np.mean((dof + 1) / (dof + squares / variance) * squares)), least**2)
        if abs(new - variance) <= 1e-4 * variance:
            break
        variance = new
    return float(np.sqrt(variance))


def likelihood_slopes(z: np.ndarray, sides: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of −log L by x/σ at standardised residuals z (M, S); `sides` as for `estimate`."""
    if sides is None:
        return z, np.ones_like(z)
    u = sides * z
    mills = np.exp(-0.5 * u**2 - log_ndtr(u)) / np.sqrt(2 * np.pi)
    # λ + u > 1/(4 + 2|u|), which is above what the difference of large numbers is rounded to.
    curvature = mills * np.maximum(mills + u, 1.0 / (4.0 + 2.0 * np.abs(u)))
    return np.where(sides == 0, z, -sides * mills), np.where(sides == 0, 1.0, curvature)


def sample_counts(noise: NoiseScale, residuals: np.ndarray, weights: np.ndarray, sides=None) -> np.ndarray:
    """The weight of each sample (M, S) in the next iteration of reweighted least squares."""
    z = np.sqrt(weights) * residuals / noise.sigma
    with np.errstate(invalid="ignore"):  # ∞/∞ where the noise is Gaussian
        robust = np.where(np.isinf(noise.dof), 1.0, (noise.dof + 1) / (noise.dof + z**2))
    return weights * robust * likelihood_slopes(z, sides)[1]


def log_likelihood(noise: NoiseScale, residuals: np.ndarray, weights: np.ndarray, sides=None) -> float:
    """The logarithm of the likelihood of residuals (M, S) whose samples are independent."""
    root = np.sqrt(weights)
    with np.errstate(divide="ignore"):  # of what does not count
        each = t.logpdf(root * residuals, noise.dof, scale=noise.sigma) + np.log(root)
    if sides is not None:
        each = np.where(sides == 0, each, log_ndtr(sides * root * residuals / noise.sigma))
    return float(each.sum(where=weights > 0))


_LAG = 1.2  # ratio of the lags at which neighbours are compared: how many there are is known to as much
_HARMONICS = 20  # of the errors' covariance: what they leave, 3 % of step²/12, counts as independent


def rounding_harmonics(step: float, sigma: float) -> tuple[np.ndarray, float, float]:
    """aₖ (K,) for errors of standard deviation `sigma`; the independent variance of rounding; that before rounding."""
    k, before = np.arange(1, _HARMONICS + 1), max(sigma**2 - step**2 / 12, 0.0)
    a = step**2 / (2 * (np.pi * k) ** 2) * np.exp(-((2 * np.pi * k) ** 2) * before / step**2)
    return a, step**2 / 12 - float(a.sum()), before


def sample_worths(x: np.ndarray, step: float, sigma: float) -> np.ndarray:
    """The number of independent samples that each sample of a signal is worth, whose exact values are near x (T,).

    A sample shares its rounding error with its m neighbours up to half a step away, on both sides as far as none is
    further, and is worth 1/(1 + (m − 1) ρ) with ρ the share of the variance that they have in common.
    """
    rho, many = min(float(rounding_harmonics(step, sigma)[0].sum()) / sigma**2, 1.0), np.ones(len(x))
    lags = np.unique(np.round(_LAG ** np.arange(np.log(len(x) + 1) / np.log(_LAG))).astype(int))
    for way in (1, -1):
        left = np.arange(len(x))
        for lag, more in zip(lags, np.diff(lags, prepend=0), strict=True):
            to = left + way * lag
            left = left[(to >= 0) & (to < len(x)) & (np.abs(x[np.clip(to, 0, len(x) - 1)] - x[left]) < step / 2)]
            many[left] += more
    return 1.0 / (1.0 + (many - 1.0) * rho)


def rounding_square(rows: list[np.ndarray], x: list[np.ndarray], step: float, sigma: float) -> np.ndarray:
    """E (Σ Gᵢ εᵢ)(Σ Gᵢ εᵢ)ᵀ of common rounding errors, over rows (N, T, F) of batches with values near x (N, T)."""
    total = np.zeros((rows[0].shape[-1],) * 2)
    for k, a in enumerate(rounding_harmonics(step, sigma)[0], start=1):
        each = [np.einsum("ntf,nt->f", g, np.exp(2j * np.pi * k / step * at)) for g, at in zip(rows, x, strict=True)]
        sums = np.sum(each, axis=0)
        total += a * np.real(sums[:, None] * sums.conj())
    return total


_LATTICE = 0.02  # of a step that a multiple may be off, in text of few digits or float32; chance is off by 0.25
_EQUAL = 0.02  # of neighbours that are equal: with fewer, rounding errors are independent anyhow
# Samples beside a limit at most, over which a motion that is cut off changes by this factor more than one that turns;
# and the noise in steps from which on a run of _CUT equal samples at the end of all is none of chance.
_BESIDE, _SHARP, _NOISY, _CUT = 10, 1.5, 0.4, 6
_RUN, _AT_LIMIT = 3, 0.01  # equal values in a row at a limit of a sensor, and the share of all samples in such rows


def find_step(column: np.ndarray) -> float:
    """The step of which all values of a signal (T,) are multiples, up to an offset; NaN where they do not show one."""
    gaps = np.diff(np.unique(column))
    if not len(gaps) or np.mean(np.diff(column) == 0) < _EQUAL:
        return np.nan
    whole = np.cumsum(np.round(gaps / np.min(gaps[gaps > 1e-12 * gaps.sum()])))  # of neighbours, few steps apart
    step, rounding = gaps.sum() / whole[-1], 4 * np.finfo(np.float32).eps * np.abs(column).max()
    off = np.abs(np.cumsum(gaps) - whole * step).max()
    return float(step) if off < _LATTICE * step + min(rounding, 0.1 * step) else np.nan


def find_limits(column: np.ndarray, step: float) -> list[float]:
    """The lowest and the highest value of a signal (T,) where its sensor is at a limit there; NaN where it is not.

    A sensor at its limit shows one value for some time. Those of noise never repeat, and a motion that turns within a
    step h for r samples changes by at most ((1 + 2w/r)² − 1) h, and a step of rounding, over the w before or after: one
    that is cut off, by more.
    """
    found, others = [], column[(column > column.min()) & (column < column.max())]
    repeats = len(others) < 2 or np.mean(np.diff(others) == 0) >= _EQUAL
    noise = np.median(np.abs(np.diff(others, 2))) / (0.6745 * np.sqrt(6)) if len(others) > 2 else 0.0
    for end in (column.min(), column.max()):
        there = column == end
        begins = (np.flatnonzero(there[1:] & ~there[:-1]) + 1).tolist()
        runs = [int(np.argmin(np.append(there[i:], False))) for i in begins]
        long = [(i, run) for i, run in zip(begins, runs, strict=True) if run >= _RUN]
        rises = [_steepness(column, i, run, step) for i, run in long]
        enough = rises and sum(runs) >= max(_AT_LIMIT * len(column), 4)
        sharp = np.median(rises) > _SHARP * step if rises and np.isfinite(step) else not repeats
        sharp |= noise > _NOISY * step and sum(run >= _CUT for _, run in long) > 1
        found.append(float(end) if enough and sharp else np.nan)
    return found


def _steepness(column: np.ndarray, first: int, run: int, step: float) -> float:
    """The least step of a signal (T,) that turns in a run of equal samples: by what it changes before, and after."""
    window, end = min(max(run // 3, 3), run, _BESIDE), first + run
    before = abs(column[first] - column[max(first - window, 0)]) - step
    if end + window > len(column):  # it may rest there: then it came as from a turn of as many samples
        return before / 8
    after = abs(column[first] - column[end + window - 1]) - step
    return min(before, after) / ((1 + 2 * window / run) ** 2 - 1)


def find_sensor(records: list[Record]) -> Sensor:
    """The sensors that the values show: a rounding step common to all records, and limits that some reach."""
    columns = [np.concatenate([r.matrix[:, s] for r in records]) for s in range(records[0].matrix.shape[1])]
    columns = [column[np.isfinite(column)] for column in columns]
    steps = np.array([find_step(column) for column in columns])
    ends = np.array([find_limits(column, step) for column, step in zip(columns, steps, strict=True)])
    for k, (column, limits) in enumerate(zip(columns, ends, strict=True)):  # which may lie between two lines
        if np.isfinite(limits).any() and np.isfinite(step := find_step(column[~np.isin(column, limits)])):
            steps[k] = step
    return Sensor(steps, *ends.T)


def read_sensor(records: list[Record], noise: AbstractNoise, names: tuple[str, ...], periods: np.ndarray) -> Sensor:
    """The sensors by the law and, if it states none, by the records.

    Wrapped signals have no limits, Student's t knows none. Raises `ValueError` where values contradict the law.
    """
    if not records:
        return Sensor(*np.zeros((3, 0)))
    found, given = find_sensor(records), noise.sensor(records)
    if isinstance(noise, StudentT):
        return Sensor(found.step, *np.full((2, len(names)), np.nan))
    found = Sensor(found.step, *(np.where(np.isfinite(periods), np.nan, end) for end in found[1:]))
    if given is None:
        return found
    for place, record in enumerate(records):
        for column, name, step, low, high in zip(record.matrix.T, names, *given, strict=True):
            column, where = column[np.isfinite(column)], f"{name} in records[{place}]"
            if len(column) and np.isfinite(step):
                off = (column - column[0]) / step
                slack = _LATTICE + 8 * np.finfo(np.float32).eps * np.abs(column).max() / step
                if np.abs(off - np.round(off)).max() > slack:
                    raise ValueError(f"The values of {where} do not differ by multiples of {step:g}.")
            if (column < low).any() or (column > high).any():
                raise ValueError(f"Some values of {where} are beyond the limits {low:g} and {high:g}.")
    return Sensor(*(np.where(np.isnan(own), shown, own) for own, shown in zip(given, found, strict=True)))
