"""The share of the signals that a trial leaves, beyond white noise.

A search may converge where it explains nothing. So the residuals of every signal are compared with the signal itself,
about its mean: what they hold beyond white noise must be a small share of that. Noise alone may be as large as it is.
"""

from typing import NamedTuple

import numpy as np

from lagjax._fit.model._autocorrelation import correlated_power
from lagjax._fit.model._noise import NoiseScale
from lagjax._fit.model._residuals import Residuals, Trial

MOST_NAMED = 3

_UNEXPLAINED = 0.3  # of a signal's size, left as motion: sound fits leave 1e-3 to 0.1, a false minimum 0.4 to 1

_DOUBTED = 0.05  # of a signal's size, left as motion, from which a fit of other records is tried

_FAINT = 0.1  # of a signal's size over all records: what is left of a record that hardly moves is not looked at


class Unexplained(NamedTuple):
    """Sentences on the residuals of a trial: for signals of which motion is left, and for those whose noise is as large
    as they are; the largest share of a signal that is left, whether it holds motion at all, and the records, the worst
    first."""

    motion: list[str]
    noise: list[str]
    share: float
    doubted: bool
    worst: list[int]


def measure_unexplained(residuals: Residuals, point: Trial, noise: NoiseScale) -> Unexplained:
    """The share of the signals that a trial leaves, where that is much."""
    left, noisy, shares, doubted, many = [], [], [0.0], False, len(residuals.records) > 1
    of_records = np.zeros(len(residuals.records))
    for signal, name in enumerate(residuals.names):
        rounding = np.nan_to_num(residuals.sensor.step[signal]) ** 2 / 12
        parts = {k: _parts(rows, rounding) for k, rows in _rows_of_signal(residuals, point, noise, signal).items()}
        if not parts:
            continue
        samples = sum(part.samples for part in parts.values())
        rms, own, motion = (
            np.sqrt(sum(part.samples * getattr(part, kind) for part in parts.values()) / samples)
            for kind in ("left", "own", "motion")
        )
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
        worst = sorted(each, key=lambda k: -each[k])[:MOST_NAMED] if many and len(each) < len(parts) else []
        left += [
            f"The fit leaves {_percent(np.sqrt(parts[k].left), np.sqrt(parts[k].own))} of {name} in "
            f"{residuals.label(k)}, and less in others: is it a record of this scene, with the signs of the others?"
            for k in worst
        ]
    return Unexplained(left, noisy, float(max(shares)), doubted, np.argsort(-of_records, kind="stable").tolist())


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.3g} %" if part < 10.0 * whole else "far more than all"


class _Parts(NamedTuple):
    """Of one signal in one record: the samples that count, and mean squares of the residuals, of what these hold beyond
    white noise and rounding, and of the signal about its mean."""

    samples: float
    left: float
    motion: float
    own: float


def _parts(row: tuple[np.ndarray, np.ndarray, np.ndarray], rounding: float) -> _Parts:
    rows, values, counts = row
    samples, root = counts.sum(), np.sqrt(counts)
    mean = np.sum(counts * values) / samples
    motion = correlated_power(root * rows, counts > 0) * (counts > 0).sum() / samples
    motion = max(motion - rounding, 0.0)
    return _Parts(samples, np.sum(counts * rows**2) / samples, motion, np.sum(counts * (values - mean) ** 2) / samples)


def _rows_of_signal(residuals: Residuals, point: Trial, noise: NoiseScale, signal: int) -> dict[int, tuple]:
    """The residuals, values and weights of every record that has a signal, (M, T) for its M pieces."""
    found: dict[int, list] = {}
    columns = zip(residuals.batches, point.residuals, residuals.factors(point, noise), strict=True)
    for batch, r, factors in columns:
        counts = (factors[..., signal] * noise.sigma[signal]) ** 2
        for row, place in enumerate(batch.rows):
            if counts[row].any():
                each = r[row, :, signal], batch.values[row, :, signal], counts[row]
                found.setdefault(residuals.pieces[place].record, []).append(each)
    return {k: tuple(_pad_rows([one[i] for one in pieces]) for i in range(3)) for k, pieces in found.items()}


def _pad_rows(rows: list[np.ndarray]) -> np.ndarray:
    """Rows of different lengths as one array, with zeros behind the shorter ones."""
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row))) for row in rows])


def unexplained_motion(residuals: Residuals, point: Trial, noise: NoiseScale) -> dict[int, float]:
    """The sum of squares that a trial leaves beyond white noise in every record, in units of the noise."""
    found: dict[int, float] = {}
    for signal in range(len(residuals.names)):
        for k, rows in _rows_of_signal(residuals, point, noise, signal).items():
            part = _parts(rows, np.nan_to_num(residuals.sensor.step[signal]) ** 2 / 12)
            found[k] = found.get(k, 0.0) + part.samples * part.motion / noise.sigma[signal] ** 2
    return found
