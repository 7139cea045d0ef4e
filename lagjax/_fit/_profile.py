"""Likelihood of restricted fits: one parameter held (profile), records left out, and other models (AIC, BIC).

It holds `Comparison`, `effective_share` and `Profile`.

**Comparison.** Information criteria count correlated samples for what they are worth, n of effective samples instead of
all:

    AIC = 2 k − 2 log L · n/N        BIC = k log n − 2 log L · n/N

with k the free numbers that are seen. They judge by the records that were fitted. Cross-validation asks more: the
records are dealt into groups, each group is left out in turn, the parameters are fitted to the rest, and the records
left out are followed with these parameters, only the starts being fitted. A law that fits noise, or one record's
peculiarities, fails there. Source: Burnham & Anderson, *Model Selection and Multimodel Inference* (2002); Arlot &
Celisse, *A survey of cross-validation procedures*, Stat. Surv. 4 (2010) 40.

**Profile.** At every value of the parameter all others, and all starts, are fitted anew. The deviance there is

    D = 2 κ (log L(best) − log L(value)),      κ = (variance for white residuals) / (variance that is reported)

so that near the minimum D = ((value − best)/deviation)² with the deviation that the intervals have, correlated
residuals counted for what they are worth, and the interval of a level ends where D is the square of Student's t. Where
the model bends, these ends are better than those of the covariance: they need no linearity, and say when there is no
end at all.
Source: Chandler & Bate, *Inference for clustered data using the independence loglikelihood*, Biometrika 94 (2007) 167,
for κ; Raue et al., Bioinformatics 25 (2009) 1923, for what profiles say about identifiability.
"""

import itertools
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.optimize import brentq

from lagjax._fit._descent import minimise
from lagjax._fit._noise import KnownNoise, NoiseScale
from lagjax._fit._residuals import LostTrial, Residuals
from lagjax._fit._uncertainty import Information

_ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT = 1e-2, 40  # a record left out is then known to a hundredth of its noise


class Comparison(NamedTuple):
    """Fits of the same records, in the order of `names`. Print it for a table.

    - `free`: how many free numbers are seen; `log_likelihood`, `aic`, `bic`: of as many samples as are effective.
    - `left_out`: the root mean square residuals of records that were left out, by signal; None without folds.
    - `best`: without folds the fit of the smallest BIC. With folds the fit of the fewest free numbers among those that
      follow records left out as well as any does, within the standard error of the difference over the groups.
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
    count = share * first.question.measured
    free = tuple(len(fit.u) - fit.information.null.shape[1] for fit in fits.values())
    logs = tuple(share * fit.log_likelihood for fit in fits.values())
    aic = tuple(float(2 * k - 2 * log) for k, log in zip(free, logs, strict=True))
    bic = tuple(float(np.log(count) * k - 2 * log) for k, log in zip(free, logs, strict=True))
    names, best, left = tuple(fits), int(np.argmin(bic)), None
    if folds:
        apart = [cross_validate(fit.question, fit.u, fit.states, fit.law, fit.widths, folds) for fit in fits.values()]
        left, best = tuple(rms for rms, _ in apart), _choose_simplest(free, np.array([scores for _, scores in apart]))
    rows = _table(names, free, logs, aic, bic, left)
    margin = np.partition(np.array(bic), 1)[1] - min(bic)
    by_bic = names[int(np.argmin(bic))]
    rows.append(f"The data prefer {_fit_label(by_bic)} fit, by {margin:.1f} in BIC ({count:.0f} effective samples).")
    if left is not None:
        simplest = _fit_label(names[best])
        rows.append(f"Left out in {folds} groups, no record is followed better than by {simplest} fit, but for chance.")
    return Comparison(names, free, logs, aic, bic, left, names[best], "\n".join(rows))


def _choose_simplest(free: tuple[int, ...], scores: np.ndarray) -> int:
    """The fit with the fewest free numbers whose scores (fits, groups) are no worse than those of the best.

    Source: Hastie, Tibshirani & Friedman, *The Elements of Statistical Learning* (2009), §7.10: one standard error.
    """
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


def _table(names, free, logs, aic, bic, left) -> list[str]:
    width = max(len(name) for name in (*names, "fit"))
    heads = f"{'fit':<{width}}{'free':>6}{'log likelihood':>18}{'AIC':>14}{'BIC':>14}"
    rows = [heads if left is None else f"{heads}   RMS left out: {', '.join(left[0])}"]
    for i, name in enumerate(names):
        row = f"{name:<{width}}{free[i]:>6}{logs[i]:>18.2f}{aic[i]:>14.2f}{bic[i]:>14.2f}"
        rows.append(row if left is None else f"{row}   {' / '.join(f'{rms:.4g}' for rms in left[i].values())}")
    return rows


def cross_validate(question: Residuals, u: np.ndarray, states: np.ndarray, law, widths: NoiseScale, folds: int):
    """The root mean square residuals by signal of records that were left out, and for each group their mean logarithm.

    Infinite where one cannot be followed. A signal that only the records left out have is as noisy as `widths` (S,) of
    all of them say.
    """
    failed = dict.fromkeys(question.names, np.inf), np.full(folds, np.inf)
    scores = np.zeros(folds)
    groups = np.array([piece.record for piece in question.pieces]) % folds
    squares, weights = dict.fromkeys(question.names, 0.0), dict.fromkeys(question.names, 0.0)
    for group in range(folds):
        rest = _select_pieces(question, groups != group)
        done = minimise(rest, u, states[groups != group], law, _ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT)
        if isinstance(done, LostTrial):
            return failed
        apart = _select_pieces(question, groups == group).with_parameters(question.parameters.fix(done.point.u))
        known = _collect_noise(apart.names, (question.names, widths), (rest.names, done.widths))
        end = minimise(
            apart, np.zeros(0), states[groups == group], KnownNoise(known), _ENOUGH_LEFT_OUT, _TRIALS_LEFT_OUT
        )
        if isinstance(end, LostTrial):
            return failed
        square, weight = (apart.weights * end.point.flat() ** 2).sum(axis=0), apart.weights.sum(axis=0)
        shown = weight > 0
        scores[group] = 0.5 * np.mean(np.log(np.maximum(square[shown] / weight[shown], apart.least[shown] ** 2)))
        for name, some, count in zip(apart.names, square, weight, strict=True):
            squares[name], weights[name] = squares[name] + some, weights[name] + count
    rms = {name: float(np.sqrt(squares[name] / weights[name])) for name in question.names if weights[name]}
    return rms, scores


def _collect_noise(names: tuple[str, ...], *known: tuple[tuple[str, ...], NoiseScale]) -> NoiseScale:
    """The noise of signals by their names, from the last of several that knows it."""
    found = {name: one for own, widths in known for name, one in zip(own, zip(*widths, strict=True), strict=True)}
    return NoiseScale(*(np.array(numbers) for numbers in zip(*(found[name] for name in names), strict=True)))


def _select_pieces(question: Residuals, keep: np.ndarray) -> Residuals:
    """The residuals of some of the pieces, without a watch."""
    part = question.with_pieces([p for p, k in zip(question.pieces, keep, strict=True) if k], question.fitted[keep])
    part.watch = None
    return part


def _require_same_records(first, others) -> None:
    for other in others:
        same = len(first.records) == len(other.records) and all(
            np.array_equal(a.matrix, b.matrix, equal_nan=True)
            for a, b in zip(first.records, other.records, strict=True)
        )
        if not same:
            raise ValueError("Only fits of the same records can be compared.")


def effective_share(fit) -> float:
    """The number of independent samples that one sample of a fit is worth."""
    samples = sum(noise.samples for noise in fit.noise.values())
    return sum(noise.effective for noise in fit.noise.values()) / samples


_STEP, _MOST = 0.5, 14  # of the reported half width, doubling where little changes; values on one side
_ENOUGH, _TRIALS = 1e-7, 25  # of the deviance, whose roots are wanted; of a search that begins nearby
_FAR = 3.0  # times |value|, or units of u where that is a logarithm or the like: how far other minima are looked for
_EXACT = 1e-4  # of the half width, to which an end is found


class Profile(NamedTuple):
    """The profile of one parameter. Print it for its verdict; `lagjax.plot.profile` draws it.

    - `values`, `deviance` (K,): values of the parameter in order and what likelihood is lost there, which is infinite
      where no motion could be followed; `threshold`: the deviance at the ends of the interval of `level`.
    - `interval`: (low, high), infinite where the profile does not reach the threshold.
    - `verdict`: "bounded", "one-sided", "flat" or "two minima".
    - `minima`: (value, deviance) of every minimum that was found, the best first.
    """

    name: str
    values: np.ndarray
    deviance: np.ndarray
    level: float
    threshold: float
    interval: tuple[float, float]
    verdict: str
    minima: tuple[tuple[float, float], ...]

    def __repr__(self) -> str:
        return f"{self.name}: {self.verdict}. {_sentence(self)}"


class _Place(NamedTuple):
    """One value of the unknown, the other unknowns and the starts that suit it best, and the deviance."""

    at: float
    others: np.ndarray
    starts: np.ndarray
    deviance: float


class _ProfileLine:
    """The values of one unknown, each of which begins from its neighbours."""

    def __init__(self, question: Residuals, u, starts, widths: NoiseScale, known: Information, which: int):
        self.question, self.widths, self.which = question, widths, which
        reported, white = known.covariance[which, which], known.white[which, which]
        self.scale = white / reported if np.isfinite(reported) and reported > 0 else 1.0 / known.lost
        self.wide = min(float(np.sqrt(reported)), float(question.parameters.reach[which]))
        done = minimise(question, u, starts, KnownNoise(widths), _ENOUGH, _TRIALS)
        if isinstance(done, LostTrial):
            raise ValueError(question.describe_failure(done))
        self.u, point = done.point.u, done.point
        self.best = question.log_likelihood(point, widths)
        self.places = [_Place(float(self.u[which]), np.delete(self.u, which), point.starts, 0.0)]

    def deviance(self, at: float) -> float:
        """D where the unknown stands at a value; infinite where no motion could be followed."""
        again = [place.deviance for place in self.places if place.at == at]
        if again:
            return again[0]
        u = self.u.copy()
        u[self.which] = at
        question = self.question.with_parameters(self.question.parameters.fix(u, self.which))
        for others, starts in self._guesses(at):
            done = minimise(question, others, starts, KnownNoise(self.widths), _ENOUGH, _TRIALS)
            if not isinstance(done, LostTrial):
                lost = self.best - question.log_likelihood(done.point, self.widths)
                self.places.append(_Place(at, done.point.u, done.point.starts, 2.0 * self.scale * lost))
                return self.places[-1].deviance
        return np.inf

    def _guesses(self, at: float):
        """The other unknowns and the starts, along the line through the two nearest places, and at the nearest."""
        near = sorted(self.places, key=lambda place: abs(place.at - at))[:2]
        if len(near) == 2 and abs(at - near[0].at) <= 2 * abs(near[0].at - near[1].at):
            share = (at - near[0].at) / (near[0].at - near[1].at)
            yield (
                near[0].others + share * (near[0].others - near[1].others),
                near[0].starts + share * (near[0].starts - near[1].starts),
            )
        yield near[0].others, near[0].starts

    def minimum(self, place: _Place) -> tuple[float, float] | None:
        """The minimum that a search from one place ends in: the unknown and D there."""
        u = np.insert(place.others, self.which, place.at)
        done = minimise(self.question, u, place.starts, KnownNoise(self.widths), _ENOUGH, 2 * _TRIALS)
        if isinstance(done, LostTrial):
            return None
        lost = self.best - self.question.log_likelihood(done.point, self.widths)
        return float(done.point.u[self.which]), 2.0 * self.scale * lost


def profile(question: Residuals, u, starts, widths: NoiseScale, known: Information, name: str, level: float) -> Profile:
    parameters = question.parameters
    line = _ProfileLine(question, u, starts, widths, known, parameters.unknown(name))
    threshold = known.quantile(level) ** 2
    ends = [_find_end(line, side, threshold, parameters.room[line.which]) for side in (-1.0, 1.0)]
    minima = _minima(line, threshold)
    row = parameters.row(name)

    def value(at: float) -> float:
        moved = line.u.copy()
        moved[line.which] = at
        return float(parameters.values(moved)[row])

    verdict = {0: "flat", 1: "one-sided", 2: "bounded"}[int(np.isfinite(ends).sum())]
    if any(d < threshold for _, d in minima[1:]):
        verdict = "two minima"
    places = sorted(line.places, key=lambda place: place.at)
    return Profile(
        parameters.names[row], np.array([value(place.at) for place in places]),
        np.array([place.deviance for place in places]), level, threshold,
        (_end_value(value, ends[0]), _end_value(value, ends[1])), verdict,
        tuple((value(at), d) for at, d in minima),
    )  # fmt: skip


def _end_value(value, end: float) -> float:
    return value(end) if np.isfinite(end) else end


def _find_end(line: _ProfileLine, side: float, threshold: float, room: float) -> float:
    """The place where the profile first passes the threshold on one side, ±∞ where it does not within `room`.

    Its places go on behind the end, as far as other minima are looked for.
    """
    best, wide = line.places[0].at, line.wide
    look_out = _FAR * (max(abs(best), 8 * wide) if np.isinf(room) else 1.0 + wide)
    step = _STEP * (wide * np.sqrt(threshold) if np.isfinite(wide) else max(abs(best), 1.0))
    offset, last, end = min(step, room), 0.0, None
    for _ in range(_MOST):
        deviance = line.deviance(best + side * offset)
        if end is None and deviance > threshold:
            end = _locate_root(line, best + side * last, best + side * offset, threshold)
        if offset >= room or np.isinf(deviance) or (end is not None and offset >= look_out):
            break
        if end is not None or np.isinf(wide) or deviance < 0.3 * (offset / wide) ** 2:
            step *= 2.0  # the profile is flatter than its parabola, or its end is known and what follows is a look-out
        last, offset = offset, min(offset + step, room if end is None else min(look_out, room))
        if offset <= last:
            break
    return side * np.inf if end is None else end


def _locate_root(line: _ProfileLine, below: float, above: float, threshold: float) -> float:
    """The value where the root of D is that of the threshold: a nearly linear function of the value."""
    if np.isinf(line.deviance(above)):
        return _bisect_end(line, below, above, threshold)
    miss = lambda at: np.sqrt(max(line.deviance(at), 0.0)) - np.sqrt(threshold)  # noqa: E731
    return float(cast(float, brentq(miss, below, above, xtol=_EXACT * abs(above - below))))


def _bisect_end(line: _ProfileLine, below: float, above: float, threshold: float) -> float:
    """The end between a value below the threshold and one that no motion follows; the last followed, if there is none.

    Bisection: what cannot be followed is as far off as can be.
    """
    for _ in range(12):
        middle = 0.5 * (below + above)
        if line.deviance(middle) > threshold:
            above = middle
        else:
            below = middle
    return below


def _minima(line: _ProfileLine, threshold: float) -> list[tuple[float, float]]:
    """Minima of the profile: the fit's own, and those that searches find from where it falls again."""
    own, places = line.places[0], sorted(line.places, key=lambda place: place.at)
    middle = places.index(own)
    sides = [places[middle::-1], places[middle:]]
    falls = [
        after
        for side in sides
        for before, after in itertools.pairwise(side)
        if after.deviance < before.deviance - 1e-3 * max(threshold, before.deviance)
    ]
    found, apart = [(own.at, 0.0)], max(1e-3 * abs(own.at), min(line.wide, 1.0))
    for place in falls:
        minimum = line.minimum(place)
        if minimum is not None and all(abs(minimum[0] - at) > apart for at, _ in found):
            found.append(minimum)
    return sorted(found, key=lambda one: one[1])


def _sentence(profile: Profile) -> str:
    low, high = profile.interval
    percent = f"{100 * profile.level:g} %"
    if profile.verdict == "flat":
        text = f"No value from {profile.values.min():.6g} to {profile.values.max():.6g} is excluded at {percent}."
    elif profile.verdict == "one-sided" and np.isfinite(low):
        text = f"At {percent} it is above {low:.6g}; no value up to {profile.values.max():.6g} is excluded."
    elif profile.verdict == "one-sided":
        text = f"At {percent} it is below {high:.6g}; no value down to {profile.values.min():.6g} is excluded."
    else:
        text = f"The {percent} interval about the best value is {low:.6g} … {high:.6g}."
    for value, deviance in profile.minima:
        if deviance < -1e-3:
            text += f" The likelihood is larger at {value:.6g}, by {-0.5 * deviance:.3g} in its logarithm: fit again."
        elif deviance > 1e-3 and deviance <= profile.threshold:
            text += f" Another minimum at {value:.6g} is not excluded: its deviance is {deviance:.3g}."
        elif deviance > profile.threshold:
            text += (
                f" Another minimum at {value:.6g} has the deviance {deviance:.3g}, {profile.threshold:.3g} excludes it."
            )
        elif value != profile.minima[0][0]:
            text += f" Another minimum at {value:.6g} is as good."
    return text
