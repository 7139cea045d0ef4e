"""Multistart: many starts at once, and where each of them ended.

The first start is the user's `params0`, the others are drawn by the transforms (`AbstractTransform.draw`). All of them
take a few damped steps of Gauss and Newton over a sample of the times of each record; the best few then go through the
whole search.

The waterfall is what all of them came to, in order: many that are equally good, then a cliff, are a minimum that can be
trusted; a slope without a step is not.
Source: Raue et al., PLoS ONE 8 (2013) e74335, for many starts and waterfalls.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax._fit.model._noise import Gaussian, NoiseScale
from lagjax._fit.model._residuals import LostMotion, Point, Residuals
from lagjax._fit.search._descent import Descent, minimise
from lagjax._fit.search._unexplained import measure_unexplained
from lagjax._show import even_places

_SHORT_TRIALS, _ENOUGH = 9, 1e-2  # of the short search; the fall of half the sum of squares, per sample, that ends it
_SHORT_SAMPLES = 200  # of each record, in it
_BEST = 4  # of many starts go through the whole search
_ALIKE = 0.02  # in the logarithm of the misfit: two starts in one minimum


class Waterfall(NamedTuple):
    """The results of many starts: `misfits` (K,), in order.

    A misfit is the noise that is left, over the size of the signals: its geometric mean over them, of those that went
    through the whole search after that, of the others after the short one. It is infinite where a motion failed.
    """

    misfits: np.ndarray

    def __repr__(self) -> str:
        with np.errstate(divide="ignore", invalid="ignore"):
            above = np.log(self.misfits / self.misfits[0])
        alike = int((above <= _ALIKE).sum())
        failed = int(np.isinf(self.misfits).sum())
        rest = self.misfits[alike : len(self.misfits) - failed]
        text = f"{len(self.misfits)}, of which {alike} came to the least misfit, {self.misfits[0]:.3g} of the signals"
        text += f"; the next to {rest[0]:.3g}, the last to {rest[-1]:.3g}" if len(rest) else ""
        return text + (f"; {failed} could not be followed." if failed else ".")


def misfit(noise: NoiseScale, residuals: Residuals) -> float:
    """The geometric mean of the noise over the size of signals, without crossing times where there are others."""
    recorded = np.concatenate([np.arange(len(part.names)) < len(part.signals.names) for part in residuals.parts])
    keep = recorded if recorded.any() else ~recorded
    return float(np.exp(np.mean(np.log((noise.sigma / residuals.size)[keep]))))


def _search_shortly(residuals: Residuals, u: np.ndarray, starts: np.ndarray) -> tuple[float, Point]:
    """The misfit and the point after a few steps; infinite where a motion cannot be followed."""
    try:
        done = minimise(residuals, Point(u, starts), Gaussian(), _ENOUGH * residuals.measured, _SHORT_TRIALS)
    except LostMotion:
        return np.inf, Point(u, starts)
    return misfit(done.noise, residuals), done.trial.point


def run_multistart(
    residuals: Residuals,
    search: Callable[[Point], Descent],
    point: Point,
    starts: int,
    seed: int | list[int],
    tell: Callable[[str], None] | None = None,
) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from a point and from `starts` − 1 random values of u, and what all of them came to;
    `tell` prints a line for each."""
    if starts == 1:
        return search(point), None
    rng = np.random.default_rng(seed)
    u = np.stack([point.u, *(residuals.parameters.draw(point.u, rng) for _ in range(starts - 1))])
    samples = [piece.places[even_places(len(piece.places), _SHORT_SAMPLES)] for piece in residuals.pieces]
    pieces = [piece._replace(places=some) for piece, some in zip(residuals.pieces, samples, strict=True)]
    short = residuals.with_pieces(pieces, residuals.fitted)
    short.watch = None
    trials = []
    for k, one in enumerate(u):
        trials.append(_search_shortly(short, one, point.starts))
        if tell:
            left = trials[-1][0]
            text = f"{left:.3g} of the signals" if np.isfinite(left) else "its motion could not be followed"
            tell(f"start {k + 1} of {starts}: {text} after a short search")
    trials.sort(key=lambda trial: trial[0])
    misfits, done, chosen = np.array([trial[0] for trial in trials]), [], []
    for k in np.flatnonzero(np.isfinite(misfits)).tolist():  # the best of different misfits
        if all(abs(np.log(misfits[k] / misfits[j])) > 1e-3 for j in chosen):
            chosen.append(k)
    for place, begin in [*((k, trials[k][1]) for k in chosen[:_BEST]), (None, point)]:
        try:
            done.append(search(begin))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].noise, done[-1].residuals)
    followed = [one for one in done if one.residuals is residuals and not measure_unexplained(one).motion]
    best = max(followed or done, key=lambda one: one.residuals.log_likelihood(one.trial, one.noise))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.noise, best.residuals))
    return best, Waterfall(misfits)
