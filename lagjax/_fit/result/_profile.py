"""Profile likelihood of one parameter, all others and the starts fitted anew at every value.

The deviance at a value is

    D = 2 κ (log L(best) − log L(value)),      κ = (variance for white residuals) / (variance that is reported)

so that near the minimum D = ((value − best)/deviation)² with the deviation that the intervals have, correlated
residuals counted for what they are worth, and the interval of a level ends where D is the square of Student's t. Where
the model bends, these ends are better than those of the covariance: they need no linearity, and say when there is no
end at all.
Source: Chandler & Bate, *Inference for clustered data using the independence loglikelihood*, Biometrika 94 (2007) 167,
for κ; Raue et al., Bioinformatics 25 (2009) 1923, for what profiles say about identifiability.
"""

import contextlib
import itertools
from typing import NamedTuple, cast

import numpy as np
from scipy.optimize import brentq

from lagjax._fit.model._noise import KnownNoise
from lagjax._fit.model._residuals import LostMotion, Point, Residuals
from lagjax._fit.search._descent import minimise

_STEP, _MOST_VALUES = 0.5, 14  # of the reported half width, doubling where little changes; values on one side
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
    """One value of the unknown, the point of the other unknowns and the starts that suit it best, and the deviance."""

    at: float
    others: Point
    deviance: float


class _ProfileLine:
    """The values of the unknown `which` of a fit, each of which begins from its nearest neighbour."""

    def __init__(self, fit, which: int):
        self.residuals, self.noise, self.which, known = fit.residual_function, fit.noise_scale, which, fit.information
        reported, white = known.covariance[which, which], known.white[which, which]
        self.scale = white / reported if np.isfinite(reported) and reported > 0 else 1.0 / known.lost
        self.wide = min(float(np.sqrt(reported)), float(self.residuals.parameters.reach[which]))
        self.best = 0.0
        point, lost = self._minimise(self.residuals, Point(fit.u, fit.states), _TRIALS)
        self.u, self.best = point.u, -lost / (2.0 * self.scale)
        self.places = [_Place(float(self.u[which]), point._replace(u=np.delete(self.u, which)), 0.0)]

    def _minimise(self, residuals: Residuals, point: Point, trials: int) -> tuple[Point, float]:
        """The point that a search ends in and its deviance. Raises `LostMotion` where that cannot begin."""
        done = minimise(residuals, point, KnownNoise(self.noise), _ENOUGH, trials)
        lost = self.best - residuals.log_likelihood(done.trial, self.noise)
        return done.trial.point, 2.0 * self.scale * lost

    def deviance(self, at: float) -> float:
        """D where the unknown stands at a value; infinite where no motion could be followed."""
        for place in self.places:
            if place.at == at:
                return place.deviance
        u = self.u.copy()
        u[self.which] = at
        kept = np.arange(len(u)) == self.which
        residuals = self.residuals.with_parameters(self.residuals.parameters.fix(u, kept))
        nearest = min(self.places, key=lambda place: abs(place.at - at)).others
        with contextlib.suppress(LostMotion):
            self.places.append(_Place(at, *self._minimise(residuals, nearest, _TRIALS)))
            return self.places[-1].deviance
        return np.inf

    def minimum(self, place: _Place) -> tuple[float, float] | None:
        """The minimum that a search from one place ends in: the unknown and D there."""
        begin = place.others._replace(u=np.insert(place.others.u, self.which, place.at))
        try:
            point, deviance = self._minimise(self.residuals, begin, 2 * _TRIALS)
        except LostMotion:
            return None
        return float(point.u[self.which]), deviance


def profile(fit, name: str, level: float) -> Profile:
    parameters = fit.parameters
    line, row = _ProfileLine(fit, parameters.unknown(name)), parameters.row(name)
    threshold = fit.information.quantile(level) ** 2
    ends = [_find_end(line, side, threshold, parameters.room[line.which]) for side in (-1.0, 1.0)]
    minima = _find_minima(line, threshold)

    def value(at: float) -> float:
        if np.isinf(at):
            return at
        moved = line.u.copy()
        moved[line.which] = at
        return float(parameters.values(moved)[row])

    verdict = {0: "flat", 1: "one-sided", 2: "bounded"}[int(np.isfinite(ends).sum())]
    if any(d < threshold for _, d in minima[1:]):
        verdict = "two minima"
    places = sorted(line.places, key=lambda place: place.at)
    values, deviances = np.array([(value(place.at), place.deviance) for place in places]).T
    found = tuple((value(at), d) for at, d in minima)
    interval = value(ends[0]), value(ends[1])
    return Profile(parameters.names[row], values, deviances, level, threshold, interval, verdict, found)


def _find_end(line: _ProfileLine, side: float, threshold: float, room: float) -> float:
    """The place where the profile first passes the threshold on one side, ±∞ where it does not within `room`; the
    places continue beyond it as far as other minima are sought."""
    best, wide = line.places[0].at, line.wide
    look_out = _FAR * (max(abs(best), 8 * wide) if np.isinf(room) else 1.0 + wide)
    step = _STEP * (wide * np.sqrt(threshold) if np.isfinite(wide) else max(abs(best), 1.0))
    offset, last, end = min(step, room), 0.0, None
    for _ in range(_MOST_VALUES):
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
    """The value where D is the threshold; where no motion follows `above`, the last value below it that one follows."""
    if np.isfinite(line.deviance(above)):  # the root of D is a nearly linear function of the value
        miss = lambda at: np.sqrt(max(line.deviance(at), 0.0)) - np.sqrt(threshold)  # noqa: E731
        return float(cast(float, brentq(miss, below, above, xtol=_EXACT * abs(above - below))))
    for _ in range(12):
        middle = 0.5 * (below + above)
        below, above = (below, middle) if line.deviance(middle) > threshold else (middle, above)
    return below


def _find_minima(line: _ProfileLine, threshold: float) -> list[tuple[float, float]]:
    """Minima of the profile: the fit's own, and those that searches find from where it falls again."""
    own, places = line.places[0], sorted(line.places, key=lambda place: place.at)
    sides = [places[places.index(own) :: -1], places[places.index(own) :]]
    found, apart = [(own.at, 0.0)], max(1e-3 * abs(own.at), min(line.wide, 1.0))
    for before, after in (pair for side in sides for pair in itertools.pairwise(side)):
        if after.deviance < before.deviance - 1e-3 * max(threshold, before.deviance):
            minimum = line.minimum(after)
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
            excludes = f"{profile.threshold:.3g} excludes it"
            text += f" Another minimum at {value:.6g} has the deviance {deviance:.3g}, {excludes}."
        elif value != profile.minima[0][0]:
            text += f" Another minimum at {value:.6g} is as good."
    return text
