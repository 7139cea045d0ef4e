"""Many starts of one search: where from, a short search of all in one batch of motions, and which ones go on.

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

from lagjax._fit._noise import Widths
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Piece
from lagjax._fit._residuals import AbstractQuestion, Failure, Question, compressed
from lagjax._fit._solve import eliminate
from lagjax._fit._wrapped import on_circle

_STEPS = 8  # of the short search
_SAMPLES = 200  # of each record, in it
_ROOM = 2**24  # numbers of tangents at once
_FIRST = 1e-2  # damping, relative to the squared norms of columns
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


def drawn(parameters: Parameters, u: np.ndarray, count: int, seed: int) -> np.ndarray:
    """u itself and `count` − 1 random ones, (K, F)."""
    rng = np.random.default_rng(seed)
    return np.stack([u, *(parameters.drawn(u, rng) for _ in range(count - 1))])


def short_search(question: AbstractQuestion, u: np.ndarray, starts: np.ndarray) -> Trials:
    """The results of the starts u (K, F) after a few steps, from the records' starts (N, 2n); in order."""
    part = _sampled(question)
    at = _tried(part, u, np.repeat(starts[None], len(u), axis=0))
    damping = np.full(len(u), _FIRST)
    for _ in range(_STEPS):
        going = np.flatnonzero(np.isfinite(at.misfits))
        if not len(going):
            break
        moved = [_step(part, at, int(k), damping[k]) for k in going]
        trial = _tried(part, *(np.stack(parts) for parts in zip(*moved, strict=True)))
        better = trial.misfits < at.misfits[going]
        damping[going] = np.where(better, 0.2 * damping[going], 10.0 * damping[going])
        for mine, new in zip(at, trial, strict=True):
            mine[going[better]] = new[better]
    order = np.argsort(at.misfits, kind="stable")
    return Trials(at.u[order], at.starts[order], at.misfits[order])


def misfit(widths: Widths, question: AbstractQuestion) -> float:
    """The noise that is left, over the size of the signals."""
    return float(np.exp(np.mean(np.log(widths.sigma / question.size))))


def distinct(trials: Trials, count: int) -> list[int]:
    """The places of the best starts that came to different misfits, at most `count`."""
    chosen: list[int] = []
    for k in np.flatnonzero(np.isfinite(trials.misfits)).tolist():
        if all(abs(np.log(trials.misfits[k] / trials.misfits[j])) > 1e-3 for j in chosen):
            chosen.append(k)
    return chosen[:count]


class _Tried(NamedTuple):
    """Like `Trials`, with the weighted triangles (K, N, D + 1, D + 1) of all pieces."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray
    triangles: np.ndarray


def _sampled(question: AbstractQuestion) -> AbstractQuestion:
    """The question with at most `_SAMPLES` samples of each record."""
    timed = {part.records.start + k for part in question.parts for k in part.question.clocks}
    pieces = [
        piece
        if piece.record in timed
        else Piece(piece.record, piece.places[np.unique(np.linspace(0, len(piece.places) - 1, _SAMPLES).astype(int))])
        for piece in question.pieces
    ]
    return question.of(pieces, question.fitted)


def _tried(question: AbstractQuestion, u: np.ndarray, starts: np.ndarray) -> _Tried:
    columns = question.states + u.shape[1] + 1
    found = _Tried(
        u.copy(), starts.copy(), np.full(len(u), np.inf), np.zeros((*starts.shape[:2], columns, columns))
    )  # fmt: skip
    largest = max(batch.ts.size for batch in question.batches) * question.states * columns
    portion = max(1, _ROOM // largest)
    for begin in range(0, len(u), portion):
        _fill(question, found, slice(begin, min(begin + portion, len(u))))
    return found


def _fill(question: AbstractQuestion, found: _Tried, some: slice) -> None:
    """The misfits and triangles of some starts, whose motions are one run for each batch of records."""
    parameters, count = question.parameters, some.stop - some.start
    numbers = np.stack([parameters.numbers(u) for u in found.u[some]])
    directions = np.stack([parameters.directions(u) for u in found.u[some]])
    squares, samples = np.zeros((count, len(question.size))), np.zeros(len(question.size))
    ok = np.isfinite(numbers).all(axis=1) & np.isfinite(directions).all(axis=(1, 2))
    followed = []
    for part, places in question.apart:
        own, states = part.question, part.question.states
        begun = found.starts[some][:, places, :states]
        moves = [own.origins.move(y, *of) for y, *of in zip(begun, numbers, directions, strict=True)]
        begun = np.stack([y for y, _ in moves])
        found.starts[some, places, :states] = begun
        for batch in own.batches:
            each = _residuals(own, batch, begun, numbers, directions, [m for _, m in moves])
            ok &= np.isfinite(each).all(axis=(1, 2, 3, 4))
            each = np.where(np.isfinite(each), each, 0.0)
            squares[:, part.signals] += (batch.weights * each[..., -1] ** 2).sum(axis=(1, 2))
            samples[part.signals] += (batch.weights > 0).sum(axis=(0, 1))
            followed.append((part, places[batch.rows], batch.weights, each))
    sigma = np.maximum(np.sqrt(squares / samples), question.least)
    found.misfits[some] = np.where(ok, np.exp(np.mean(np.log(sigma / question.size), axis=1)), np.inf)
    for part, places, weights, each in followed:
        each *= (np.sqrt(weights) / sigma[:, None, None, part.signals])[..., None]
        small, states = compressed(each.reshape(count * len(places), -1, each.shape[-1])), part.question.states
        _place(found.triangles[some], places, states, question.states - states, small)


def _place(triangles: np.ndarray, places: np.ndarray, states: int, more: int, of_system: np.ndarray) -> None:
    """Put the triangles of M pieces of one system, (K·M, D, D), at their `places` among those of all, (K, N, …).

    Behind the columns of its `states` these have `more` columns, for a system with more coordinates.
    """
    rows = np.insert(of_system, [states] * more, 0.0, axis=-1)
    triangles[:, places, : rows.shape[-2]] = rows.reshape(len(triangles), len(places), *rows.shape[1:])


def _residuals(question: Question, batch, starts, numbers, directions, moved) -> np.ndarray:
    """The derivatives of signals and, last, residuals of one batch for K starts: (K, N, T, S, D + 1).

    NaN where a motion failed, zero where nothing was measured.
    """
    along = [question._along(batch, m, d) for m, d in zip(moved, directions, strict=True)]
    record = question.pieces[batch.rows[0]].record
    shown = _timed if record in question.clocks else _sensed
    columns, free = question.columns(record), directions.shape[1]
    missing = question.states + free - along[0][1].shape[0]
    found = np.zeros((len(starts), *batch.values.shape, question.states + free + 1))
    for k, both in enumerate(shown(question, batch, starts[:, batch.rows], numbers, along)):
        if both is None:
            found[k] = np.nan
            continue
        values, slopes = both
        slopes = np.pad(slopes, ((0, 0), (0, 0), (0, 0), (missing, 0)))
        slopes[~question.fitted[batch.rows], ..., : question.states] = 0.0
        left = on_circle(values - batch.values[..., columns], question.periods[columns])
        found[k, ..., columns, :-1], found[k, ..., columns, -1] = slopes, left
    return np.where((batch.weights > 0)[..., None] | np.isnan(found), found, 0.0)


def _timed(question: Question, batch, starts, numbers, along):
    """Of each start the crossing times and their derivatives, or None."""
    clock = question.clocks[question.pieces[batch.rows[0]].record]
    for y0, some, directions in zip(starts, numbers, along, strict=True):
        shown = question._time(clock, batch, y0, some, *directions)
        yield None if isinstance(shown, Failure) else shown


def _sensed(question: Question, batch, starts, numbers, along):
    """Of each start the signals and their derivatives, or None where a motion failed; all in one run."""
    count, members = len(starts), len(batch.rows)
    tile = lambda x: np.tile(x, (count, *[1] * (x.ndim - 1)))  # noqa: E731
    table = None if batch.table is None else type(batch.table)(*map(tile, batch.table))
    motion = question.motions.follow(
        tile(batch.ts), starts.reshape(count * members, -1), np.repeat(numbers, members, axis=0),
        np.concatenate([y0_dot for y0_dot, _ in along]), np.repeat([d for _, d in along], members, axis=0), table,
    )  # fmt: skip
    for k in range(count):
        part = type(motion)(*(x[k * members : (k + 1) * members] for x in motion))
        yield question.signals.of(part, batch.ts, batch.inputs, numbers[k], along[k][1]) if part.ok else None


def _step(question: AbstractQuestion, at: _Tried, k: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The end of the damped step of one start."""
    triangles, states, none = at.triangles[k], question.states, np.zeros(at.u.shape[1])
    limits = question.parameters.limits(at.u[k])
    norms = np.linalg.norm(triangles[..., :states], axis=1), np.linalg.norm(triangles[..., states:-1], axis=(0, 1))
    scale = tuple(np.where(norm > 0, norm, 1.0) for norm in norms)
    step = eliminate(triangles, states, scale, damping, (none, none), limits)
    return question.parameters.stepped(at.u[k], step.u), at.starts[k] + step.starts
