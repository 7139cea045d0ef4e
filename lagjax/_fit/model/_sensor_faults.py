"""Faults of sensors that records show by themselves: placeholders for missing samples, rounding, limits, hanging."""

from typing import Any

import numpy as np

from lagjax._fit.model._noise import Sensor, StudentT, find_sensor
from lagjax._fit.model._records import Record
from lagjax._fit.model._sensors import wrap_residuals

_FEWEST = 8  # samples that do not change
_JUMP = 3.0  # times the most that other neighbours differ by: neither motion nor noise jumps so far and back
_FAR = 30.0  # times the spread of the others, from which on one sample is no measurement
_KINDS, _REPEATED = 5, 3  # values that are looked at, and how often they must be there


def require_measurements(records: list[Record], names: tuple[str, ...], periods: np.ndarray) -> None:
    """Raise `ValueError` for samples that stand for missing ones: one value, to which a signal jumps and comes back."""
    for place, record in enumerate(records):
        for k, name in enumerate(names if len(record) >= _FEWEST else ()):
            column = record.matrix[record.weight_matrix[:, k] > 0, k]
            if (found := _find_placeholder(column, periods[k])) is None:
                continue
            value, count = found
            others = column[column != value]
            repeats = len(np.unique(others)) < len(others)
            among = "are far from it just before and after" if repeats else "never repeat"
            away = abs(value - np.median(others)) / max(np.ptp(others), np.finfo(float).tiny)
            how = f"exactly {value:.6g}, among values that {among}"
            if away > _FAR:
                how = f"{value:.6g}, {float(f'{away:.2g}'):.0f} times the spread of the others"
            raise ValueError(
                f"{count} of {len(column)} samples of {name} in records[{place}] are {how}: missing? Put NaN there, or "
                "take noise=lagjax.StudentT()."
            )


def _find_placeholder(column: np.ndarray, period: float) -> tuple[float, int] | None:
    """The value that stands for missing samples of a signal (T,), and their number; None if there is none."""
    kinds, counts = np.unique(column, return_counts=True)
    if len(kinds) < _FEWEST:
        return None
    middle, spread = np.median(column), np.ptp(np.quantile(column, [0.05, 0.95]))
    far = np.abs(kinds - middle) > _FAR * spread if spread > 0 else np.zeros(len(kinds), bool)
    often = np.argsort(-counts, kind="stable")[:_KINDS]
    for k in dict.fromkeys([*often[counts[often] >= _REPEATED].tolist(), *np.flatnonzero(far)[:_KINDS].tolist()]):
        there = column == kinds[k]
        if there.mean() > 0.5:  # where it rests
            continue
        others = column[~there]
        steps = np.abs(wrap_residuals(np.diff(others)[:, None], np.array([period])))
        before = np.maximum(np.cumsum(~there) - 1, 0)[there]
        after = np.minimum(before + 1, len(others) - 1)
        beside = others[np.stack([before, after], axis=1)]
        jumps = np.abs(wrap_residuals(kinds[k] - beside, np.full(2, period))).min(axis=1)
        # Or a value comes back and back among values that never do: samples of a real signal stay equal, or differ.
        runs = np.sum(there[1:] & ~there[:-1])
        alone = runs >= _REPEATED and there.sum() < 2 * runs and len(np.unique(others)) == len(others)
        inside = alone and others.min() < kinds[k] < others.max()
        if inside or (jumps > _JUMP * steps.max()).sum() >= (1 if far[k] else _REPEATED):
            return float(kinds[k]), int(there.sum())
    return None


def describe_sensors(
    records: list[Record], law, names: tuple[str, ...], sensor: Sensor, sigma: np.ndarray
) -> list[str]:
    """A sentence for every signal of a system whose sensor rounds, or is at a limit, and the law does not say so."""
    is_student = isinstance(law, StudentT)
    if is_student:  # it knows no limits
        sensor = Sensor(sensor.step, *find_sensor(records)[1:])
    given = law.sensor(records) or Sensor(*np.full((3, len(names)), np.nan))
    found = []
    for k, name in enumerate(names):
        step, some = sensor.step[k], np.concatenate([present_samples(record, k) for record in records])
        if np.isnan(given.step[k]) and step**2 / 12 > _ROUNDED * sigma[k] ** 2:
            off = "" if np.abs(some / step - np.round(some / step)).max() < 0.01 else " up to an offset"
            law = f"noise=lagjax.Quantised({step:.4g})"
            how = f"take {law}." if is_student else f"they are fitted as with {law}."
            found.append(f"All values of {name} are multiples of {step:.4g}{off}: {how}")
        if np.ptp(some) < _FEW_STEPS * step:
            found.append(f"{name} moves by less than {_FEW_STEPS:g} steps of its sensor: {TOO_COARSE}")
        for end, word, limit in (("low", "smallest", sensor.low[k]), ("high", "largest", sensor.high[k])):
            if np.isfinite(limit) and np.isnan(getattr(given, end)[k]):
                law, count = f"noise=lagjax.Clipped({end}={limit:.4g})", (some == limit).sum()
                how = f"take {law}." if is_student else f"they are fitted as with {law}, {limit:.4g} or beyond."
                there = f"{count} of {len(some)} samples of {name}"
                found.append(f"{there} are {limit:.4g}, the {word} value, in runs: {how}")
    return found


def constant_signals(records: list[Any], names: tuple[str, ...]) -> list[str]:
    """A sentence for every signal, of these names, that is the same at all samples of a record of one system."""
    return [
        f"{name} is {there[0]:.6g} at all {len(there)} samples of records[{place}]: it does not move, or its "
        "sensor hangs."
        for place, record in enumerate(records)
        if isinstance(record, Record) and len(record) >= _FEWEST
        for k, name in enumerate(names)
        if len(there := present_samples(record, k)) >= _FEWEST and np.ptp(there) == 0.0
    ]


def present_samples(record: Record, signal: int) -> np.ndarray:
    """The samples of a signal that are not missing; a zero where all are."""
    column = record.matrix[:, signal]
    return column[np.isfinite(column)] if np.isfinite(column).any() else np.zeros(1)


_FEW_STEPS = 2.5  # of rounding in a signal: below, errors are as large as it, and no small change of a fit
TOO_COARSE = "there are no intervals from lines that far apart."
_ROUNDED = 0.05  # of the variance of the noise, from which on a sentence tells of rounding
