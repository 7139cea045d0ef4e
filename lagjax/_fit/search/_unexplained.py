"""The share of the signals that a trial leaves, beyond white noise.

A search may converge where it explains nothing. So the residuals of every signal are compared with the signal itself,
about its mean: what they hold beyond white noise must be a small share of that. Noise alone may be as large as it is.
"""

from typing import NamedTuple

import numpy as np

from lagjax._fit.model._autocorrelation import correlated_power
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
        if not parts:
            continue
        samples, *squares = np.array(list(parts.values())).T
        rms, motion, own = (np.sqrt(samples @ x / samples.sum()) for x in squares)
        shares.append(rms / own if own > 0 else np.inf if rms > 0 else 0.0)
        doubted |= bool(motion > _DOUBTED * own)
        for k, part in parts.items():
            of_records[k] = max(of_records[k], part.motion / own**2 if own > 0 else 0.0)
        if motion > _UNEXPLAINED * own:
            left.append(f"The fit leaves {_percent(rms, own)} of {name}: its motion is not that of the scene.")
        elif rms > _UNEXPLAINED * own:
            noisy.append(f"The noise is {_percent(rms, own)} of {name}.")
        each = {
            k: np.sqrt(part.motion / part.own) if part.own > 0 else np.inf
            for k, part in parts.items()
            if part.motion > max(_UNEXPLAINED**2 * part.own, (_FAINT * own) ** 2)
        }
        worst = sorted(each, key=lambda k: -each[k])[:MOST_NAMED] if len(each) < len(parts) else []
        left += [
            f"The fit leaves {_percent(np.sqrt(parts[k].left), np.sqrt(parts[k].own))} of {name} in "
            f"{residuals.label(k)}, and less in others: is it a record of this scene, with the signs of the others?"
            for k in worst
        ]
    return Unexplained(left, noisy, float(max(shares)), doubted, np.argsort(-of_records, kind="stable").tolist())


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.3g} %" if part < 10.0 * whole else "far more than all"


class _Part(NamedTuple):
    """Of one signal in one record: the samples that count, and mean squares of residuals, of their part beyond white
    noise and rounding, and of the signal about its mean."""

    samples: float
    left: float
    motion: float
    own: float


def _measure_records(done: Descent, signal: int) -> dict[int, _Part]:
    residuals, trial, noise = done.residuals, done.trial, done.noise
    rounding, pieces = np.nan_to_num(residuals.sensor.step[signal]) ** 2 / 12, {}
    for batch, r, factors in zip(residuals.batches, trial.residuals, residuals.factors(trial, noise), strict=True):
        counts = (factors[..., signal] * noise.sigma[signal]) ** 2
        for row, place in enumerate(batch.rows):
            if counts[row].any():
                own = np.stack([r[row, :, signal], batch.values[row, :, signal], counts[row]])
                pieces.setdefault(residuals.pieces[place].record, []).append(own)
    found = {}
    for k, rows in pieces.items():
        longest = max(row.shape[1] for row in rows)
        r, values, counts = np.stack([np.pad(row, ((0, 0), (0, longest - row.shape[1]))) for row in rows], axis=1)
        samples = counts.sum()
        mean = np.sum(counts * values) / samples
        motion = correlated_power(np.sqrt(counts) * r, counts > 0) * (counts > 0).sum() / samples
        squares = (np.sum(counts * x**2) / samples for x in (r, values - mean))
        found[k] = _Part(samples, next(squares), max(motion - rounding, 0.0), next(squares))
    return found


def unexplained_motion(done: Descent) -> dict[int, float]:
    """The sum of squares that a search leaves beyond white noise in every record, in units of the noise."""
    found: dict[int, float] = {}
    for signal, sigma in enumerate(done.noise.sigma):
        for k, part in _measure_records(done, signal).items():
            found[k] = found.get(k, 0.0) + part.samples * part.motion / sigma**2
    return found
