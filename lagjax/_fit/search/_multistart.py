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

from typing import NamedTuple

import numpy as np

from lagjax._fit.model._noise import Gaussian, NoiseScale
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._residuals import LostTrial, Residuals
from lagjax._fit.search._descent import Descent, column_norms, eliminate

_SHORT_STEPS = 8  # of the short search

_SHORT_SAMPLES = 200  # of each record, in it

_ROOM = 2**24  # numbers of tangents at once

_FIRST_DAMPING = 1e-2  # damping, relative to the squared norms of columns

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
    """K starts of the search: u (K, F), the starts of their records (K, N, 2n), and their misfits (K,)."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray


def random_starts(parameters: Parameters, u: np.ndarray, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([u, *(parameters.draw(u, rng) for _ in range(count - 1))])


def short_search(residuals: Residuals, u: np.ndarray, starts: np.ndarray) -> Trials:
    """The results of the starts u (K, F) after a few steps, from the records' starts (N, 2n); in order."""
    part = _subsample(residuals)
    at = _evaluate_starts(part, u, np.repeat(starts[None], len(u), axis=0))
    damping = np.full(len(u), _FIRST_DAMPING)
    for _ in range(_SHORT_STEPS):
        going = np.flatnonzero(np.isfinite(at.misfits))
        if not len(going):
            break
        moved = [_step(part, at, int(k), damping[k]) for k in going]
        trial = _evaluate_starts(part, *(np.stack(parts) for parts in zip(*moved, strict=True)))
        better = trial.misfits < at.misfits[going]
        damping[going] = np.where(better, 0.2 * damping[going], 10.0 * damping[going])
        for mine, new in zip(at, trial, strict=True):
            mine[going[better]] = new[better]
    order = np.argsort(at.misfits, kind="stable")
    return Trials(at.u[order], at.starts[order], at.misfits[order])


def misfit(noise: NoiseScale, residuals: Residuals) -> float:
    return float(np.exp(np.mean(np.log(noise.sigma / residuals.size))))


def distinct_minima(trials: Trials, count: int) -> list[int]:
    """The places of the best starts that came to different misfits, at most `count`."""
    chosen: list[int] = []
    for k in np.flatnonzero(np.isfinite(trials.misfits)).tolist():
        if all(abs(np.log(trials.misfits[k] / trials.misfits[j])) > 1e-3 for j in chosen):
            chosen.append(k)
    return chosen[:count]


class _EvaluatedStarts(NamedTuple):
    """Like `Trials`, with the weighted triangles (K, N, D + 1, D + 1) of all pieces."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray
    triangles: np.ndarray


def _subsample(residuals: Residuals) -> Residuals:
    chosen = lambda count: np.unique(np.linspace(0, count - 1, _SHORT_SAMPLES).astype(int))  # noqa: E731
    pieces = [Piece(piece.record, piece.places[chosen(len(piece.places))]) for piece in residuals.pieces]
    return residuals.with_pieces(pieces, residuals.fitted)


def _evaluate_starts(residuals: Residuals, u: np.ndarray, starts: np.ndarray) -> _EvaluatedStarts:
    """The misfits and triangles of trials u (K, F) and starts (K, N, 2n), a portion of them at once."""
    columns = residuals.states + u.shape[1] + 1
    found = _EvaluatedStarts(
        u.copy(), starts.copy(), np.full(len(u), np.inf), np.zeros((*starts.shape[:2], columns, columns))
    )  # fmt: skip
    largest = max(batch.ts.size for batch in residuals.batches) * residuals.states * columns
    portion = max(1, _ROOM // largest)
    for begin in range(0, len(u), portion):
        some = slice(begin, begin + portion)
        for k, trial in enumerate(residuals.evaluate_trials(u[some], starts[some]), begin):
            if not isinstance(trial, LostTrial):
                noise = residuals.noise_scale(trial, Gaussian())
                found.starts[k], found.misfits[k] = trial.starts, misfit(noise, residuals)
                found.triangles[k] = residuals.linearise(trial, noise)
    return found


def _step(residuals: Residuals, at: _EvaluatedStarts, k: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    triangles, states, none = at.triangles[k], residuals.states, np.zeros(at.u.shape[1])
    limits = residuals.parameters.limits(at.u[k])
    step = eliminate(triangles, states, column_norms(triangles, states), damping, (none, none), limits)
    return residuals.parameters.take_step(at.u[k], step.u), at.starts[k] + step.starts


_BEST = 4  # of many starts go through the whole search


def run_multistart(residuals: Residuals, search, u, y0, starts: int, seed: int) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from u and from `starts` − 1 random values, and what all of them came to."""
    if starts == 1:
        return search(u, y0), None
    trials = short_search(residuals, random_starts(residuals.parameters, u, starts, seed), y0)
    misfits, done = trials.misfits.copy(), []
    chosen = distinct_minima(trials, _BEST)
    for place, at in [*((k, (trials.u[k], trials.starts[k])) for k in chosen), (None, (u, y0))]:
        try:
            done.append(search(*at))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].noise, residuals)
    best = max(done, key=lambda one: (one.residuals is residuals, one.residuals.log_likelihood(one.point, one.noise)))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.noise, residuals))
    return best, Waterfall(misfits)
