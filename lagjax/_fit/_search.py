"""`search_records`: where a fit begins and how it goes on, from segments that grow together to whole records.

`searches` does that from many starts, `by_gradient` with gradients in reverse mode. `weakly` is the first value of the
parameters by the weak form, where the user's is too far off.
"""

import functools
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lagjax._fit._gradient import descend, ended
from lagjax._fit._many import Waterfall, distinct, drawn, misfit, short_search
from lagjax._fit._noise import Widths, log_likelihood
from lagjax._fit._records import Piece, Record
from lagjax._fit._residuals import AbstractQuestion, Failure, Question
from lagjax._fit._segments import Reader, complete, glimpses, levels, time_scales, whole
from lagjax._fit._signals import looks_like_positions
from lagjax._fit._solve import Anchor, Descent, minimise
from lagjax._fit._systems import asked
from lagjax._fit._verdict import unexplained
from lagjax._fit._weak import balanced
from lagjax._fit._wrapped import continued
from lagjax._hybrid import Hybrid, Scene

# In units of half the sum of squares: the end of a search, where parameters are within 0.05 standard deviations of
# independent noise, and, per sample, that of a level of growing segments, whose answer is only where the next begins.
_ENOUGH, _ENOUGH_OF_LEVEL = 1e-3, 1e-2
_ENOUGH_OF_GLIMPSES = 0.1
_POOR, _COARSE = 2.0, 0.02  # times scatter or size of signals: beyond, the shortest segments were not fitted
_LOOSE = 3.0  # standard deviations of u about its first value on these levels, where u is a logarithm or the like
_TRIALS, _TRIALS_OF_LEVEL = 60, 20
_WORSE = (
    5.0  # times more that a join may leave; measured: 3 where friction was left out, 10 and more beyond the horizon
)
_LOST = 2  # levels that may be lost: after one the next may find the motion again, with better parameters
_LYAPUNOV = 5.0  # times 1/λ that a record is long: shorter ones are followed whole
_STEPS = 3000  # of a descent by gradients
_BEST = 4  # of many starts go through the whole search


class Unfollowed(ValueError):
    """Records whose motion cannot be followed from the first trial."""


def searches(question: AbstractQuestion, search, u, y0, starts: int, seed: int) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from u and from `starts` − 1 random values, and what all of them came to."""
    if starts == 1:
        return search(u, y0), None
    trials = short_search(question, drawn(question.parameters, u, starts, seed), y0)
    misfits, done = trials.misfits.copy(), []
    chosen = distinct(trials, _BEST)
    for place, at in [*((k, (trials.u[k], trials.starts[k])) for k in chosen), (None, (u, y0))]:
        try:
            done.append(search(*at))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].widths, question)
    best = max(done, key=lambda one: (one.question is question, _likelihood(one)))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.widths, question))
    return best, Waterfall(misfits)


def _likelihood(done: Descent) -> float:
    return log_likelihood(done.widths, done.point.flat(), done.question.weights)


def reader_of(record: Record, observe, about: Question, numbers: np.ndarray, probes: int = 256) -> Reader | None:
    """A reader of states off a record; None where its signals are no positions, or go round too fast to tell."""
    if not looks_like_positions(observe, record, about.layout):
        return None
    periods = about.signals.periods
    smooth = continued(record, periods)
    if smooth is None:
        return None
    read = about.signals.positions(smooth, numbers)
    if np.isfinite(periods).any():  # in the units of coordinates
        gain = np.nanstd(read.matrix, axis=0) / np.maximum(np.nanstd(smooth.matrix, axis=0), np.finfo(float).tiny)
        periods = np.where(np.isfinite(periods), gain * periods, np.inf)
    return Reader.of(read, probes, periods)


def search_records(question: AbstractQuestion, u, starts, noise, method: str, readers, weak) -> Descent:
    """The search of whole records, after that of growing segments where the method asks for it."""
    if method == "segments" and readers is None:
        raise ValueError('method="segments" reads starts off the data: for that values must have the structure of q.')
    if method == "whole" or readers is None:
        return _followed(question, minimise(question, u, starts, noise, _ENOUGH, _TRIALS))
    u, starts, levels_done = _grown(question, u, starts, noise, readers, weak)
    good = _last_good(levels_done)
    if len(levels_done) - good > _LOST:
        return _in_pieces(question, levels_done[good], levels_done[-1].widths, noise)
    done = minimise(question, u, starts, noise, _ENOUGH, _TRIALS)
    if levels_done and (
        isinstance(done, Failure) or not done.converged or unexplained(question, done.point, done.widths).motion
    ):
        good = _last_good([*levels_done, *([] if isinstance(done, Failure) else [done])])
        if good < len(levels_done) and misfit(levels_done[good].widths, question) < _COARSE:
            return _in_pieces(question, levels_done[good], None if isinstance(done, Failure) else done.widths, noise)
    return _followed(question, done)


def _last_good(levels_done: list[Descent]) -> int:
    """The place of the last level from which on joining did not lose the motion.

    A scene that lacks something leaves up to three times more at each join, and motion that is lost some ten times.
    """
    good, last = 0, np.inf
    for k, done in enumerate(levels_done):
        now = misfit(done.widths, done.question)
        if now <= _WORSE ** (k - good) * last:
            good, last = k, now
    return good


def _parting(done: Descent) -> float:
    """The logarithm of how far motions part that begin side by side, over the longest record: λ times its length.

    λ is the median over the pieces, from the mean square of the derivatives by the start over the first and the last
    third of each.
    """
    rates, states = [], done.question.states
    for batch, slopes in zip(done.question.batches, done.point.slopes, strict=True):
        for ts, weights, by_start in zip(batch.ts, batch.weights, slopes[..., :states], strict=True):
            squares = (by_start[weights.any(axis=-1)] ** 2).sum(axis=1)
            third = len(squares) // 3
            if third and (squares[:third].sum(axis=0) > 0).all():
                growth = np.log(squares[-third:].sum(axis=0) / squares[:third].sum(axis=0)).mean() / 2
                rates.append(growth / (ts[2 * third] - ts[0]))
    longest = max(record.ts[-1] - record.ts[0] for record in done.question.records)
    return float(np.median(rates) * longest) if rates else 0.0


def _in_pieces(question: AbstractQuestion, level: Descent, joined: Widths | None, noise) -> Descent:
    """The search on the pieces of a level, with all samples of these and a start for each."""
    pieces = complete(level.question.pieces, question.records)
    part = question.of(pieces, level.question.fitted)
    done = minimise(part, level.point.u, level.point.starts, noise, _ENOUGH, _TRIALS)
    if isinstance(done, Failure):
        return _followed(part, done)
    worse = (
        "fails" if joined is None else f"leaves {misfit(joined, question) / misfit(done.widths, part):.2g} times more"
    )
    text = f"The records are followed in {len(pieces)} pieces, each with a start of its own: to join them {worse}"
    growth = _parting(done)
    if growth > _LYAPUNOV:
        text += f", because motions that begin side by side part e^{growth:.0f}-fold over a record."
        return done._replace(message=f"{done.message} {text}")
    text += ", though the motion does not forget its start: the scene lacks something that lasts longer."
    return done._replace(message=f"{done.message} {text}", converged=False)


def by_gradient(
    question: AbstractQuestion, systems: dict[str | None, Scene], u, y0, noise, readers: list[Reader | None] | None
) -> Descent:
    """The descent by gradients: over segments of the records that grow, where they can be read, then over all."""
    told, question.watch = question.watch, None
    tell = None if told is None else lambda text: print(text, file=sys.stderr, flush=True)
    steps = _STEPS
    if readers is not None:
        u = weakly(question, list(systems.values()), u, readers)
        u = _over_segments(question, systems, u, noise, readers, tell)
        steps = _STEPS // 3
    done = descend(question, systems, u, y0, noise, steps, tell)
    if not isinstance(done, Failure):
        done = ended(question, done[0], done[1], noise, _STEPS, done[2])
    return _followed(question, done)


def _followed(question: AbstractQuestion, done: Descent | Failure) -> Descent:
    """The result of a search. Raises `Unfollowed` where its motions could not be followed."""
    if isinstance(done, Failure):
        raise Unfollowed(question.where(done) + " Begin nearer: other params0, or starts that are known.")
    return done


def _grown(
    question: AbstractQuestion, u, starts, noise, readers: list[Reader | None], weak: Callable
) -> tuple[np.ndarray, np.ndarray, list[Descent]]:
    """Better first values of u and of the starts, from segments that grow together to whole records; and the levels.

    Where joining loses the motion twice in a row, no longer segment is tried.
    """
    anchor = Anchor(u, np.where(np.isfinite(question.parameters.reach), 1.0 / _LOOSE, 0.0))
    search = functools.partial(_level, question, noise=noise, readers=readers, anchor=anchor)
    begun = _begun(question, u, starts, readers, search)
    for other in (lambda: weak(u), lambda: _glimpsed(question, u, noise, readers, anchor)):
        if begun.misfit > 0.0:  # the shortest segments were not fitted from here
            begun = min(begun, _begun(question, other(), starts, readers, search), key=lambda one: one.misfit)
    u, best, levels_done = begun.u, begun.best, [] if begun.first is None else [begun.first]
    for pieces in begun.cuts[1:]:
        done = search(pieces, u, best)
        if isinstance(done, Failure):
            break  # whole records then begin from the best so far, and say so if they fail as well
        u = done.point.u
        levels_done.append(done)
        if len(levels_done) - _last_good(levels_done) > _LOST:
            break
    return u, np.stack([best[k, 0] for k in range(len(question.records))]), levels_done


class _Begun(NamedTuple):
    """The beginning of growing segments: u, the cuts, the states at the first samples, their error, and the search
    on the shortest segments where it came to an end."""

    u: np.ndarray
    cuts: list[list[Piece]]
    best: dict[tuple[int, int], np.ndarray]
    misfit: float
    first: Descent | None = None


def _begun(question: AbstractQuestion, u, starts, readers: list[Reader | None], search) -> _Begun:
    """The search on the shortest segments, from u, whose misfit is positive where they were not fitted.

    It is the mean logarithm of the noise σ of the signals, over `_POOR` times the scatter of the data or a share
    `_COARSE` of the signals' size, whichever is larger.
    """
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    best = {(k, 0): start for k, start in enumerate(starts)}
    if not cuts:
        return _Begun(u, cuts, best, -np.inf)
    done = search(cuts[0], u, best)
    if isinstance(done, Failure):
        return _Begun(u, cuts, best, np.inf)
    near = []
    for part in question.parts:
        if reading := [reader for reader in readers[part.records] if reader is not None]:
            scatter = np.sqrt(np.mean([np.square(reader.scatter) for reader in reading], axis=0))
            near.append(np.maximum(_POOR * scatter, _COARSE * part.question.size[: len(scatter)]))
    ratio = done.widths.sigma / np.concatenate(near)
    return _Begun(done.point.u, cuts, best, float(np.mean(np.log(ratio))), done)


def _level(question: AbstractQuestion, pieces: list[Piece], u, best, noise, readers, anchor) -> Descent | Failure:
    """The search on one cut of the records. The states in `best`, by record and sample, begin it and take its end."""
    firsts = [(piece.record, int(piece.places[0])) for piece in pieces]
    for k, reader in enumerate(readers):
        new = [place for record, place in firsts if record == k and (k, place) not in best]
        if new and reader is not None:
            read = roomy(reader.states(np.array(new)), question.states)
            best |= {(k, place): y for place, y in zip(new, read, strict=True)}
    part = question.of(pieces, np.array([question.fitted[k] or place > 0 for k, place in firsts]))
    y0 = np.stack([best[first] for first in firsts])
    done = minimise(part, u, y0, noise, _ENOUGH_OF_LEVEL * part.measured, _TRIALS_OF_LEVEL, anchor)
    if not isinstance(done, Failure):
        best |= dict(zip(firsts, done.point.starts, strict=True))
    return done


def _glimpsed(question: AbstractQuestion, u, noise, readers: list[Reader | None], anchor: Anchor) -> np.ndarray:
    """The u that suits the accelerations of local cubics: these have one minimum where segments are too long for u."""
    scales, short, states = _time_scales(question, readers, u), {}, []
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale, about = scales[part.records.start], part.question
        if not (reading and np.isfinite(scale)):
            continue
        records, begun = glimpses(reading, 0.25 * scale)
        states.append(roomy(begun, question.states))
        short[part.name] = Question(
            records, whole(records), np.ones(len(records), bool), about.motions, about.signals, about.parameters,
            about.size, about.rtol,
        )  # fmt: skip
    if not short:
        return u
    part = asked(short)
    y0 = np.concatenate(states)[:, : part.states]
    done = minimise(part, u, y0, noise, _ENOUGH_OF_GLIMPSES, _TRIALS_OF_LEVEL, anchor)
    return u if isinstance(done, Failure) else done.point.u


def weakly(question: AbstractQuestion, systems: Sequence[Scene], u, readers: list[Reader | None]) -> np.ndarray:
    """The u that balances the weak form of Lagrange's equations, u itself where there is none.

    Hybrid motion, whose velocities jump, has none.
    """
    scales = _time_scales(question, readers, u)
    found = balanced(
        [
            (part.question, system, readers[part.records], scales[part.records.start])
            for part, system in zip(question.parts, systems, strict=True)
            if not isinstance(system, Hybrid)
        ],
        u,
    )
    return u if found is None else found


def _over_segments(question: AbstractQuestion, systems, u, noise, readers: list[Reader | None], tell) -> np.ndarray:
    """The u that two thirds of the steps come to over segments that grow, each with a start of its own."""
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    for pieces in [] if any(part.question.clocks for part in question.parts) else cuts:
        reading = ((recorder, piece.places[:1]) for piece in pieces if (recorder := readers[piece.record]))
        states = np.stack([roomy(one.states(place)[0], question.states) for one, place in reading])
        part = question.of(pieces, np.ones(len(pieces), bool))
        done = descend(part, systems, u, states, noise, 2 * _STEPS // (3 * len(cuts)), tell)
        if not isinstance(done, Failure):
            u = done[0]
    return u


def _time_scales(question: AbstractQuestion, readers: list[Reader | None], u) -> list[float]:
    """The duration for which the motion of each record looks like a straight line: of all records of a system the same.

    It is infinite for a system of which no state can be read off.
    """
    scales, numbers = [], question.parameters.numbers(u)
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = min(time_scales(reading, part.question.motions, numbers)) if reading else np.inf
        scales += [scale] * len(part.question.records)
    return scales


def roomy(state: np.ndarray, states: int) -> np.ndarray:
    """States (..., 2n) of a system, with zeros up to those of the one with the most coordinates."""
    return np.concatenate([state, np.zeros((*state.shape[:-1], states - state.shape[-1]))], axis=-1)
