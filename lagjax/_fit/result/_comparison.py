"""Comparison of fits: AIC, BIC, and cross-validation over records that are left out.

Information criteria count correlated samples for what they are worth, n of effective samples instead of all:

    AIC = 2 k − 2 log L · n/N        BIC = k log n − 2 log L · n/N

with k the free numbers that are seen. They judge by the records that were fitted. Cross-validation asks more: the
records are dealt into groups, each group is left out in turn, the parameters are fitted to the rest, and the records
left out are followed with these parameters, only the starts being fitted. A law that fits noise, or one record's
peculiarities, fails there. Source: Burnham & Anderson, *Model Selection and Multimodel Inference* (2002); Arlot &
Celisse, *A survey of cross-validation procedures*, Stat. Surv. 4 (2010) 40.
"""

from typing import Any, NamedTuple

import numpy as np

from lagjax._fit.model._noise import AbstractNoise, KnownNoise, NoiseScale
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial
from lagjax._fit.search._descent import minimise

_ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT = 1e-2, 40  # a record left out is then known to a hundredth of its noise


class Comparison(NamedTuple):
    """Fits of the same records, in the order of `names`. Print it for a table.

    - `free`: how many free numbers are seen; `log_likelihood`, `aic`, `bic`: of as many samples as are effective.
    - `left_out`: the root mean square residuals of records that were left out, by signal; None without folds.
    - `best`: without folds the fit of the smallest BIC. With folds the fit of the fewest free numbers among those that
      follow records left out as well as any does, within the standard error of the difference over the records.
    """

    names: tuple[str, ...]
    free: tuple[int, ...]
    log_likelihood: tuple[float, ...]
    aic: tuple[float, ...]
    bic: tuple[float, ...]
    left_out: tuple[dict[str, float], ...] | None
    best: str
    text: str

    def __repr__(self) -> str:
        return self.text


def comparison(fits: dict[str, Any], folds: int) -> Comparison:
    """The comparison of fits by name. Raises `ValueError` where they are not about the same measurements."""
    first, *others = fits.values()
    _require_same_records(first, others)
    records = len(first.records)
    if not (isinstance(folds, int | np.integer) and (folds == 0 or 2 <= folds <= records)):
        raise ValueError(f"folds must be 0, or from 2 to the number of records, {records}; got {folds!r}.")
    share = min(effective_share(fit) for fit in fits.values())
    count = share * first.residual_function.measured
    free = tuple(len(fit.u) - fit.information.null.shape[1] for fit in fits.values())
    logs = tuple(share * fit.log_likelihood for fit in fits.values())
    aic = tuple(float(2 * k - 2 * log) for k, log in zip(free, logs, strict=True))
    bic = tuple(float(np.log(count) * k - 2 * log) for k, log in zip(free, logs, strict=True))
    names, best, left = tuple(fits), int(np.argmin(bic)), None
    margin = np.partition(np.array(bic), 1)[1] - min(bic)
    said = [f"The data prefer {_fit_label(names[best])} fit, by {margin:.1f} in BIC ({count:.0f} effective samples)."]
    if folds:
        ends = [(f, f.residual_function.evaluate(Point(f.u, f.states))) for f in fits.values()]
        found = [cross_validate(f.residual_function, end, f.noise_scale, f.law, folds) for f, end in ends]
        left, scores = zip(*found, strict=True)
        simplest = _fit_label(names[best := choose_simplest(free, np.array(scores))])
        said.append(f"Left out in {folds} groups, no record is followed better than by {simplest} fit, but for chance.")
    rows = [*_comparison_table(names, free, logs, aic, bic, left), *said]
    return Comparison(names, free, logs, aic, bic, left, names[best], "\n".join(rows))


def choose_simplest(free: tuple[int, ...], scores: np.ndarray) -> int:
    """The fit with the fewest free numbers whose scores (fits, records) are within one standard error of the best.
    Source: Hastie, Tibshirani & Friedman, *The Elements of Statistical Learning* (2009), §7.10."""
    means = scores.mean(axis=1)
    if not np.isfinite(means).any():
        return 0
    with np.errstate(invalid="ignore"):
        behind = scores - scores[np.argmin(means)]
        error = behind.std(axis=1, ddof=1) / np.sqrt(scores.shape[1])
        as_good = np.flatnonzero(behind.mean(axis=1) <= error)
    return int(min(as_good, key=lambda i: (free[i], means[i])))


def _fit_label(name: str) -> str:
    return name if name in ("this", "the other") else f"the {name!r}"


def _comparison_table(names, free, logs, aic, bic, left) -> list[str]:
    width = max(len(name) for name in (*names, "fit"))
    heads = f"{'fit':<{width}}{'free':>6}{'log likelihood':>18}{'AIC':>14}{'BIC':>14}"
    rows = [heads if left is None else f"{heads}   RMS left out: {', '.join(left[0])}"]
    for i, name in enumerate(names):
        row = f"{name:<{width}}{free[i]:>6}{logs[i]:>18.2f}{aic[i]:>14.2f}{bic[i]:>14.2f}"
        rows.append(row if left is None else f"{row}   {' / '.join(f'{rms:.4g}' for rms in left[i].values())}")
    return rows


def cross_validate(
    residuals: Residuals, fitted: Trial, noise: NoiseScale, law: AbstractNoise, folds: int
) -> tuple[dict[str, float], np.ndarray]:
    """RMS residuals by signal of records left out, and for each record their mean logarithm; all infinite where one
    cannot be followed. A signal that only these have is as noisy as in the fit of all."""
    owners, scores = np.array([piece.record for piece in residuals.pieces]), np.zeros(len(residuals.records))
    squares, weights = dict.fromkeys(residuals.names, 0.0), dict.fromkeys(residuals.names, 0.0)
    groups = owners % folds
    for group in range(folds):
        (rest, begin), (apart, _) = (residuals.select(keep, fitted) for keep in (groups != group, groups == group))
        known = dict(zip(residuals.names, zip(*noise, strict=True), strict=True))
        try:
            done = minimise(rest, begin, law, _ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT)
            known |= zip(rest.names, zip(*done.noise, strict=True), strict=True)
            sensed = KnownNoise(NoiseScale(*np.array([known[name] for name in apart.names]).T))
            kept = np.isin(np.arange(len(fitted.u)), residuals.unknowns.shared)
            apart = apart.with_parameters(residuals.parameters.fix(done.trial.u, kept))
            point = Point(done.trial.u[~kept], fitted.starts[groups == group])
            end = minimise(apart, point, sensed, _ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT)
        except LostMotion:
            return dict.fromkeys(residuals.names, np.inf), np.full(len(scores), np.inf)
        by_record = _sum_squares(apart, end.trial)
        for record, (square, weight) in by_record.items():
            shown = weight > 0
            scores[record] = 0.5 * np.mean(np.log(np.maximum(square[shown] / weight[shown], apart.least[shown] ** 2)))
            for name, some, count in zip(apart.names, square, weight, strict=True):
                squares[name], weights[name] = squares[name] + some, weights[name] + count
    rms = {name: float(np.sqrt(squares[name] / weights[name])) for name in residuals.names if weights[name]}
    return rms, scores


def _sum_squares(residuals: Residuals, trial: Trial) -> dict[int, np.ndarray]:
    """The weighted sums of squares of residuals, and the sums of weights, (2, S) of each record."""
    found: dict[int, np.ndarray] = {}
    for batch, r in zip(residuals.batches, trial.residuals, strict=True):
        both = np.stack([(batch.weights * r**2).sum(axis=1), batch.weights.sum(axis=1)], axis=1)
        for row, sums in zip(batch.rows, both, strict=True):
            record = residuals.pieces[row].record
            found[record] = found.get(record, 0.0) + sums
    return found


def _require_same_records(first, others) -> None:
    for other in others:
        pairs = zip(first.records, other.records, strict=False)
        same = all(np.array_equal(a.matrix, b.matrix, equal_nan=True) for a, b in pairs)
        if not same or len(first.records) != len(other.records):
            raise ValueError("Only fits of the same records can be compared.")


def effective_share(fit) -> float:
    """The number of independent samples that one sample of a fit is worth."""
    return sum(noise.effective for noise in fit.noise.values()) / sum(noise.samples for noise in fit.noise.values())
