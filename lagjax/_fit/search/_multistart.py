"""Multistart: many starts at once, and where each of them ended.

The first start is the user's `params0`, the others are drawn from what the transforms say: a decade about a positive
number, all of an interval, of a circle or of a simplex, and about any other number as far as it is large. All of them
take a few damped steps of Gauss and Newton at once: the members of one batch are starts × records, over a sample of the
times of each record. A start whose motion fails costs the others nothing. The best few then go through the whole
search.

The waterfall is what all of them came to, in order: many that are equally good, then a cliff, are a minimum that can be
trusted; a slope without a step is not.
Source: Raue et al., PLoS ONE 8 (2013) e74335, for many starts and waterfalls.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax._fit.model._noise import Gaussian, NoiseScale
from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._residuals import LostTrial, Point, Residuals
from lagjax._fit.search._descent import Descent, column_norms, eliminate

_SHORT_STEPS = 8  # of the short search
_SHORT_SAMPLES = 200  # of each record, in it
_ROOM = 2**24  # numbers of tangents at once
_FIRST_DAMPING = 1e-2  # damping, relative to the squared norms of columns
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


class Trials(NamedTuple):
    """K trials: u (K, F), the starts of their records (K, N, 2n), their misfits (K,), infinite where a motion failed,
    and the weighted triangles (K, N, D + 1, D + 1) of all pieces."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray
    triangles: np.ndarray

    @classmethod
    def from_points(cls, residuals: Residuals, points: Point) -> "Trials":
        """The trials at K points, a portion of them at once."""
        u, starts = points
        columns = residuals.states + u.shape[1] + 1
        triangles = np.zeros((*starts.shape[:2], columns, columns))
        found = cls(u.copy(), starts.copy(), np.full(len(u), np.inf), triangles)
        largest = max(batch.ts.size for batch in residuals.batches) * residuals.states * columns
        portion = max(1, _ROOM // largest)
        for begin in range(0, len(u), portion):
            some = slice(begin, begin + portion)
            for k, trial in enumerate(residuals.evaluate_trials(Point(u[some], starts[some])), begin):
                if not isinstance(trial, LostTrial):
                    noise = residuals.noise_scale(trial, Gaussian())
                    found.starts[k], found.misfits[k] = trial.starts, misfit(noise, residuals)
                    triangles[k] = residuals.linearise(trial, noise)
        return found

    def take_step(self, residuals: Residuals, k: int, damping: float) -> Point:
        """The point one damped step of Gauss and Newton from trial k."""
        triangles, states, none = self.triangles[k], residuals.states, np.zeros(self.u.shape[1])
        limits = residuals.parameters.limits(self.u[k])
        step = eliminate(triangles, states, column_norms(triangles, states), damping, (none, none), limits)
        return Point(residuals.parameters.take_step(self.u[k], step.u), self.starts[k] + step.starts)


def misfit(noise: NoiseScale, residuals: Residuals) -> float:
    """The noise over the size of the signals of records, its geometric mean; of crossing times where there are no
    others."""
    recorded = np.concatenate([np.arange(len(part.names)) < len(part.signals.names) for part in residuals.parts])
    keep = recorded if recorded.any() else ~recorded
    return float(np.exp(np.mean(np.log((noise.sigma / residuals.size)[keep]))))


def _search_shortly(residuals: Residuals, points: Point) -> Trials:
    """The trials that K points come to after a few steps, over a sample of the times of each record; in order."""
    chosen = lambda count: np.unique(np.linspace(0, count - 1, _SHORT_SAMPLES).astype(int))  # noqa: E731
    pieces = [Piece(piece.record, piece.places[chosen(len(piece.places))]) for piece in residuals.pieces]
    part = residuals.with_pieces(pieces, residuals.fitted)
    at, damping = Trials.from_points(part, points), np.full(len(points.u), _FIRST_DAMPING)
    for _ in range(_SHORT_STEPS):
        going = np.flatnonzero(np.isfinite(at.misfits))
        if not len(going):
            break
        steps = [at.take_step(part, k, damping[k]) for k in going.tolist()]
        trial = Trials.from_points(part, Point(*(np.stack(halves) for halves in zip(*steps, strict=True))))
        better = trial.misfits < at.misfits[going]
        damping[going] = np.where(better, 0.2 * damping[going], 10.0 * damping[going])
        for mine, new in zip(at, trial, strict=True):
            mine[going[better]] = new[better]
    order = np.argsort(at.misfits, kind="stable")
    return Trials(*(x[order] for x in at))


def run_multistart(
    residuals: Residuals, search: Callable[[Point], Descent], point: Point, starts: int, seed: int
) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from a point and from `starts` − 1 random values of u, and what all of them came to."""
    if starts == 1:
        return search(point), None
    rng = np.random.default_rng(seed)
    u = np.stack([point.u, *(residuals.parameters.draw(point.u, rng) for _ in range(starts - 1))])
    trials = _search_shortly(residuals, Point(u, np.repeat(point.starts[None], starts, axis=0)))
    chosen: list[int] = []  # the best that came to different misfits
    for k in np.flatnonzero(np.isfinite(trials.misfits)).tolist():
        if all(abs(np.log(trials.misfits[k] / trials.misfits[j])) > 1e-3 for j in chosen):
            chosen.append(k)
    misfits, done = trials.misfits.copy(), []
    begins = [(k, Point(trials.u[k], trials.starts[k])) for k in chosen[:_BEST]]
    for place, begin in [*begins, (None, point)]:
        try:
            done.append(search(begin))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].noise, done[-1].residuals)
    best = max(done, key=lambda one: (one.residuals is residuals, one.residuals.log_likelihood(one.trial, one.noise)))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.noise, best.residuals))
    return best, Waterfall(misfits)
