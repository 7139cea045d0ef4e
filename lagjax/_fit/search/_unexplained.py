"""The share of the signals that a trial leaves, beyond white noise.

A search may converge where it explains nothing. So the residuals of every signal are compared with the signal itself,
about its mean: what they hold beyond white noise must be a small share of that. Noise alone may be as large as it is.
"""

from typing import NamedTuple

import numpy as np

from lagjax._fit.model._autocorrelation import correlated_power, first_lag_products
from lagjax._fit.search._descent import Descent

MOST_NAMED = 3
_UNEXPLAINED = 0.3  # of a signal's size, left as motion: sound fits leave 1e-3 to 0.1, a false minimum 0.4 to 1
_DOUBTED = 0.05  # of a signal's size, left as motion, from which a fit of other records is tried
_FAINT = 0.1  # of a signal's size over all records: what is left of a record that hardly moves is not looked at


class Unexplained(NamedTuple):
    """Sentences for signals of which a search leaves motion, and for those no larger than their noise; the largest
    share of a signal that is left, whether it holds motion at all, and the records, the worst first."""

    motion: list[str]
    noise: list[str]
    share: float
    doubted: bool
    worst: list[int]


def measure_unexplained(done: Descent) -> Unexplained:
    residuals = done.residuals
    left, noisy, shares, doubted = [], [], [0.0], False
    of_records = np.zeros(len(residuals.records))
    for signal, name in enumerate(residuals.names):
        parts = _measure_records(done, signal)
        if not len(parts.records):
            continue
        total = parts.samples.sum()
        rms, motion, own = (float(np.sqrt(parts.samples @ x / total)) for x in (parts.left, parts.motion, parts.own))
        shares.append(rms / own if own > 0 else np.inf if rms > 0 else 0.0)
        doubted |= motion > _DOUBTED * own
        if own > 0:
            of_records[parts.records] = np.maximum(of_records[parts.records], parts.motion / own**2)
        if motion > _UNEXPLAINED * own:
            left.append(f"The fit leaves {_percent(rms, own)} of {name}: its motion is not that of the scene.")
        elif rms > _UNEXPLAINED * own:
            noisy.append(f"The noise is {_percent(rms, own)} of {name}.")
        large = np.flatnonzero(parts.motion > np.maximum(_UNEXPLAINED**2 * parts.own, (_FAINT * own) ** 2))
        with np.errstate(divide="ignore"):
            order = np.argsort(-parts.motion[large] / parts.own[large], kind="stable")
        left += [
            f"The fit leaves {_percent(parts.left[k].item() ** 0.5, parts.own[k].item() ** 0.5)} of {name} in "
            f"{residuals.label(int(parts.records[k]))}, and less in others: is it a record of this scene, with the "
            "signs of the others?"
            for k in (large[order][:MOST_NAMED] if len(large) < len(parts.records) else ())
        ]
    return Unexplained(left, noisy, float(max(shares)), doubted, np.argsort(-of_records, kind="stable").tolist())


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.3g} %" if part < 10.0 * whole else "far more than all"


class _Parts(NamedTuple):
    """Of one signal in the `records` (R,) that show it: the samples that count, and mean squares of residuals, of their
    part beyond white noise and rounding, and of the signal about its mean."""

    records: np.ndarray
    samples: np.ndarray
    left: np.ndarray
    motion: np.ndarray
    own: np.ndarray


def _measure_records(done: Descent, signal: int) -> _Parts:
    residuals, trial, noise = done.residuals, done.trial, done.noise
    owners, records = np.array([piece.record for piece in residuals.pieces]), len(residuals.records)
    batches = []
    for batch, r, factors in zip(residuals.batches, trial.residuals, residuals.factors(trial, noise), strict=True):
        counts = (factors[..., signal] * noise.sigma[signal]) ** 2
        batches.append((owners[batch.rows], counts, r[..., signal], batch.values[..., signal]))

    def add(each: list[np.ndarray]) -> np.ndarray:
        """The sums (R,) or (R, K) of what the pieces (N,) or (N, K) of batches hold."""
        total = np.zeros((records, *each[0].shape[1:]))
        for (places, *_), part in zip(batches, each, strict=True):
            np.add.at(total, places, part)
        return total

    samples, many = (add([x.sum(axis=1) for x in y]) for y in zip(*((c, c > 0) for _, c, *_ in batches), strict=True))
    unit = np.where(samples > 0, samples, 1.0)
    mean = add([np.sum(counts * values, axis=1) for _, counts, _, values in batches]) / unit
    left = add([np.sum(counts * r**2, axis=1) for _, counts, r, _ in batches]) / unit
    own = add([np.sum(c * (values - mean[k, None]) ** 2, axis=1) for k, c, _, values in batches]) / unit
    sums = add([first_lag_products(np.sqrt(counts) * r, counts > 0) for _, counts, r, _ in batches])
    rounding = np.nan_to_num(residuals.sensor.step[signal]) ** 2 / 12
    motion = np.maximum(correlated_power(sums, many) * many / unit - rounding, 0.0)
    shown = np.flatnonzero(samples > 0)
    return _Parts(shown, *(x[shown] for x in (samples, left, motion, own)))


def unexplained_motion(done: Descent) -> np.ndarray:
    """The sum of squares (R,) that a search leaves beyond white noise in every record, in units of the noise."""
    found = np.zeros(len(done.residuals.records))
    for signal, sigma in enumerate(done.noise.sigma):
        parts = _measure_records(done, signal)
        found[parts.records] += parts.samples * parts.motion / sigma**2
    return found
