"""The scatter of measurements about the motion: `Gaussian`, and `StudentT` with outliers.

A residual e of a signal with width σ and weight w has the standardised size z = √w e/σ. The density is

    Gaussian    ∝ exp(−z²/2)/σ                           every sample counts 1
    StudentT    ∝ (1 + z²/ν)^{−(ν+1)/2}/σ                a sample counts (ν+1)/(ν + z²) ≤ (ν+1)/ν

with σ, and ν, of each signal by maximum likelihood from the residuals themselves. A Student-t fit is a sequence of
weighted least squares: with these counts a smaller weighted sum is a larger likelihood.
Source: Lange, Little & Taylor, *Robust statistical modeling using the t distribution*, JASA 84 (1989) 881.
"""

import abc
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

_WIDEST, _NARROWEST = 200.0, 1.0  # ν: beyond 200 it is a Gaussian to a percent, below 1 there is not even a mean
_ROUNDS = 30  # of the fixed point for σ, which gains a factor of three or more in each


class NoiseScale(NamedTuple):
    """The noise of S signals: `sigma` (S,), and `dof` ν (S,), infinite for a Gaussian."""

    sigma: np.ndarray
    dof: np.ndarray


class AbstractNoise(abc.ABC):
    """A law for the scatter of measurements."""

    @abc.abstractmethod
    def widths(self, residuals: np.ndarray, weights: np.ndarray, least: np.ndarray) -> NoiseScale:
        """The noise of S signals that makes these residuals (M, S) likeliest; no σ is smaller than `least` (S,)."""


@dataclass(frozen=True)
class Gaussian(AbstractNoise):
    """Normal noise; σ of each signal is estimated from the residuals. It is the default of `fit`.

    ```python
    import lagjax

    noise = lagjax.Gaussian()  # lagjax.fit(..., noise=noise)
    ```
    """

    def widths(self, residuals, weights, least):
        """σ² = mean of w e² over the samples that count."""
        count = np.maximum((weights > 0).sum(axis=0), 1)
        sigma = np.sqrt((weights * residuals**2).sum(axis=0) / count)
        return NoiseScale(np.maximum(sigma, least), np.full(len(least), np.inf))


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
        if self.dof is not None and not (np.ndim(self.dof) == 0 and np.isfinite(self.dof) and self.dof >= _NARROWEST):
            raise ValueError(f"StudentT(dof) needs a number of degrees of freedom of at least 1; got {self.dof!r}.")

    def widths(self, residuals, weights, least):
        """σ by its fixed point σ² = mean of c w e² with c = (ν+1)/(ν + z²), ν by search over its logarithm."""
        found = [
            self._fit_signal(np.sqrt(weights[keep, s]) * residuals[keep, s], least[s])
            for s in range(residuals.shape[1])
            for keep in [weights[:, s] > 0]
        ]
        return NoiseScale(np.array([sigma for sigma, _ in found]), np.array([dof for _, dof in found]))

    def _fit_signal(self, scaled: np.ndarray, least: float) -> tuple[float, float]:
        if self.dof is not None:
            return _sigma(scaled, self.dof, least), float(self.dof)
        # Golden section over log ν: the profile likelihood has one maximum there, or its end.
        low, high = np.log(_NARROWEST), np.log(_WIDEST)
        ratio = (np.sqrt(5.0) - 1) / 2
        cost = lambda x: _cost(scaled, _sigma(scaled, np.exp(x), least), np.exp(x))  # noqa: E731
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        at_a, at_b = cost(a), cost(b)
        for _ in range(16):  # log ν to 0.003
            if at_a < at_b:
                high, b, at_b = b, a, at_a
                a = high - ratio * (high - low)
                at_a = cost(a)
            else:
                low, a, at_a = a, b, at_b
                b = low + ratio * (high - low)
                at_b = cost(b)
        dof = float(np.exp((low + high) / 2))
        return _sigma(scaled, dof, least), dof


@dataclass(frozen=True)
class KnownNoise(AbstractNoise):
    """Noise that is known already, for one more record."""

    known: NoiseScale

    def widths(self, residuals, weights, least):
        """The noise that is known."""
        return self.known


def _sigma(scaled: np.ndarray, dof: float, least: float) -> float:
    """σ of the likeliest Student distribution of ν = `dof` for residuals times the root of their weights."""
    squares = scaled**2
    variance = max(float(np.median(squares)), least**2)
    for _ in range(_ROUNDS):
        new = max(float(np.mean((dof + 1) / (dof + squares / variance) * squares)), least**2)
        if abs(new - variance) <= 1e-4 * variance:
            break
        variance = new
    return float(np.sqrt(variance))


def _cost(scaled: np.ndarray, sigma: float, dof: float) -> float:
    """−log of the mean likelihood per sample."""
    constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
    return np.log(sigma) - constant + 0.5 * (dof + 1) * float(np.mean(np.log1p((scaled / sigma) ** 2 / dof)))


def counts(widths: NoiseScale, residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The weight of each sample in the next sum of squares of e/σ, in the shape of the residuals."""
    z = weights * (residuals / widths.sigma) ** 2
    with np.errstate(invalid="ignore"):  # ∞/∞ where the noise is Gaussian
        robust = np.where(np.isinf(widths.dof), 1.0, (widths.dof + 1) / (widths.dof + z))
    return weights * robust


def log_likelihood(widths: NoiseScale, residuals: np.ndarray, weights: np.ndarray) -> float:
    """The logarithm of the likelihood of residuals (M, S) whose samples are independent."""
    total = 0.0
    for s, (sigma, dof) in enumerate(zip(*widths, strict=True)):
        keep = weights[:, s] > 0
        root = np.sqrt(weights[keep, s])
        z = root * residuals[keep, s]
        if np.isinf(dof):
            each = -np.log(sigma) - 0.5 * np.log(2 * np.pi) - 0.5 * np.mean((z / sigma) ** 2)
        else:
            each = -_cost(z, sigma, dof)
        total += len(z) * each + np.log(root).sum()
    return float(total)
