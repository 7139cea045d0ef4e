"""The search of whole records, by multiple shooting over segments that grow.

Over a long record the sum of squares has many minima: a wrong frequency is out of phase, a chaotic motion forgets its
start. Over a segment shorter than the motion's own time scale there is one. So the records are first cut into short
segments, each with a start of its own (multiple shooting), from states that local polynomials read off the data. When
the parameters fit those, neighbours are joined and the joined segment keeps the start of its first part: its end then
misses the data by as much as the states of two neighbours disagreed, which the next search closes. So the weight of
continuity goes from none to all, in as many doublings as it takes to reach whole records. A level needs a rough answer
only: the parameters must be good enough to predict a segment twice as long.

Others impose continuity by penalties or constraints on all levels at once (Bock's multiple shooting, coupling to the
data); the growing of segments needs no weights, and every level is the same least squares with starts eliminated.
Source: Bock, *Recent advances in parameter identification for ODE* (1983); Pisarenko & Sornette, Phys. Rev. E 69
(2004) 036122, for segments of chaotic signals.
"""

import functools
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax._fit.model._noise import NoiseScale
from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._residuals import LostTrial, Residuals
from lagjax._fit.search._adam import build_descent, descend_gradient
from lagjax._fit.search._descent import Anchor, Descent, minimise
from lagjax._fit.search._multistart import misfit
from lagjax._fit.search._reader import Reader, pad_states, short_windows, time_scales
from lagjax._fit.search._segments import complete_pieces, levels
from lagjax._fit.search._unexplained import measure_unexplained
from lagjax._fit.search._weak_form import fit_weak_form

# In units of half the sum of squares: the end of a search, where parameters are within 0.05 standard deviations of
# independent noise, and, per sample, that of a level of growing segments, whose answer is only where the next begins.
_ENOUGH, _ENOUGH_OF_LEVEL = 1e-3, 1e-2

_ENOUGH_OF_WINDOWS = 0.1

_POOR, _COARSE = 2.0, 0.02  # times scatter or size of signals: beyond, the shortest segments were not fitted

_LOOSE = 3.0  # standard deviations of u about its first value on these levels, where u is a logarithm or the like

_TRIALS, _TRIALS_OF_LEVEL = 60, 20

_WORSE = (
    5.0  # times more that a join may leave; measured: 3 where friction was left out, 10 and more beyond the horizon
)

_LOST = 2  # levels that may be lost: after one the next may find the motion again, with better parameters

_LYAPUNOV = 5.0  # times 1/λ that a record is long: shorter ones are followed whole

_GRADIENT_STEPS = 3000  # of a descent by gradients


class Unfollowed(ValueError):
    """Records whose motion cannot be followed from the first trial."""


def search_records(residuals: Residuals, u, starts, law, method: str, readers, weak) -> Descent:
    if method == "segments" and readers is None:
        raise ValueError('method="segments" reads starts off the data: for that values must have the structure of q.')
    if method == "whole" or readers is None:
        return _require_success(residuals, minimise(residuals, u, starts, law, _ENOUGH, _TRIALS))
    u, starts, levels_done = _fit_growing_segments(residuals, u, starts, law, readers, weak)
    good = _last_followed_level(levels_done)
    if len(levels_done) - good > _LOST:
        return _search_pieces(residuals, levels_done[good], levels_done[-1].noise, law)
    done = minimise(residuals, u, starts, law, _ENOUGH, _TRIALS)
    if levels_done and (
        isinstance(done, LostTrial)
        or not done.converged
        or measure_unexplained(residuals, done.point, done.noise).motion
    ):
        good = _last_followed_level([*levels_done, *([] if isinstance(done, LostTrial) else [done])])
        if good < len(levels_done) and misfit(levels_done[good].noise, residuals) < _COARSE:
            return _search_pieces(
                residuals, levels_done[good], None if isinstance(done, LostTrial) else done.noise, law
            )
    return _require_success(residuals, done)


def _last_followed_level(levels_done: list[Descent]) -> int:
    """The place of the last level from which on joining did not lose the motion.

    A scene that lacks something leaves up to three times more at each join, and motion that is lost some ten times.
    """
    good, last = 0, np.inf
    for k, done in enumerate(levels_done):
        now = misfit(done.noise, done.residuals)
        if now <= _WORSE ** (k - good) * last:
            good, last = k, now
    return good


def _separation(done: Descent) -> float:
    """The logarithm of how far motions part that begin side by side, over the longest record: λ times its length.

    λ is the median over the pieces, from the mean square of the derivatives by the start over the first and the last
    third of each.
    """
    rates, states = [], done.residuals.states
    for batch, slopes in zip(done.residuals.batches, done.point.slopes, strict=True):
        for ts, weights, by_start in zip(batch.ts, batch.weights, slopes[..., :states], strict=True):
            squares = (by_start[weights.any(axis=-1)] ** 2).sum(axis=1)
            third = len(squares) // 3
            if third and (squares[:third].sum(axis=0) > 0).all():
                growth = np.log(squares[-third:].sum(axis=0) / squares[:third].sum(axis=0)).mean() / 2
                rates.append(growth / (ts[2 * third] - ts[0]))
    longest = max(record.ts[-1] - record.ts[0] for record in done.residuals.records)
    return float(np.median(rates) * longest) if rates else 0.0


def _search_pieces(residuals: Residuals, level: Descent, joined: NoiseScale | None, law) -> Descent:
    """The search on the pieces of a level, with all samples of these and a start for each."""
    pieces = complete_pieces(level.residuals.pieces, residuals.records)
    part = residuals.with_pieces(pieces, level.residuals.fitted)
    done = minimise(part, level.point.u, level.point.starts, law, _ENOUGH, _TRIALS)
    if isinstance(done, LostTrial):
        return _require_success(part, done)
    worse = (
        "fails" if joined is None else f"leaves {misfit(joined, residuals) / misfit(done.noise, part):.2g} times more"
    )
    text = f"The records are followed in {len(pieces)} pieces, each with a start of its own: to join them {worse}"
    growth = _separation(done)
    if growth > _LYAPUNOV:
        text += f", because motions that begin side by side part e^{growth:.0f}-fold over a record."
        return done._replace(message=f"{done.message} {text}")
    text += ", though the motion does not forget its start: the scene lacks something that lasts longer."
    return done._replace(message=f"{done.message} {text}", converged=False)


def search_again(done: Descent, law) -> Descent:
    """The end of a search where samples that share a rounding error count once; of sensors that do not round the same.

    Which samples do is known where the motion is, and does not change with the last digits of the parameters.
    """
    residuals = done.residuals
    if np.isnan(residuals.sensor.step).all():
        return done
    residuals = residuals.count_runs_once(done.point, done.noise)
    again = _require_success(residuals, minimise(residuals, done.point.u, done.point.starts, law, _ENOUGH, _TRIALS))
    return done if not again.converged else again._replace(converged=done.converged, message=done.message)


def search_by_gradient(residuals: Residuals, u, y0, law, readers: list[Reader | None] | None) -> Descent:
    """The descent by gradients: over segments of the records that grow, where they can be read, then over all."""
    watch, residuals.watch = residuals.watch, None
    tell = None if watch is None else lambda text: print(text, file=sys.stderr, flush=True)
    steps = _GRADIENT_STEPS
    if readers is not None:
        u = start_by_weak_form(residuals, u, readers)
        u = _descend_segments(residuals, u, law, readers, tell)
        steps = _GRADIENT_STEPS // 3
    done = descend_gradient(residuals, u, y0, law, steps, tell)
    if not isinstance(done, LostTrial):
        done = build_descent(residuals, done[0], done[1], law, _GRADIENT_STEPS, done[2])
    return _require_success(residuals, done)


def _require_success(residuals: Residuals, done: Descent | LostTrial) -> Descent:
    """The result of a search. Raises `Unfollowed` where its motions could not be followed."""
    if isinstance(done, LostTrial):
        raise Unfollowed(residuals.describe_failure(done) + " Begin nearer: other params0, or starts that are known.")
    return done


def _fit_growing_segments(
    residuals: Residuals, u, starts, law, readers: list[Reader | None], weak: Callable
) -> tuple[np.ndarray, np.ndarray, list[Descent]]:
    """Better first values of u and of the starts, from segments that grow together to whole records; and the levels.

    Where joining loses the motion twice in a row, no longer segment is tried.
    """
    anchor = Anchor(u, np.where(np.isfinite(residuals.parameters.reach), 1.0 / _LOOSE, 0.0))
    search = functools.partial(_fit_level, residuals, law=law, readers=readers, anchor=anchor)
    begun = _fit_shortest_segments(residuals, u, starts, readers, search)
    for other in (lambda: weak(u), lambda: _fit_short_windows(residuals, u, law, readers, anchor)):
        if begun.misfit > 0.0:  # the shortest segments were not fitted from here
            begun = min(
                begun, _fit_shortest_segments(residuals, other(), starts, readers, search), key=lambda one: one.misfit
            )
    u, best, levels_done = begun.u, begun.best, [] if begun.first is None else [begun.first]
    for pieces in begun.cuts[1:]:
        done = search(pieces, u, best)
        if isinstance(done, LostTrial):
            break  # whole records then begin from the best so far, and say so if they fail as well
        u = done.point.u
        levels_done.append(done)
        if len(levels_done) - _last_followed_level(levels_done) > _LOST:
            break
    return u, np.stack([best[k, 0] for k in range(len(residuals.records))]), levels_done


class _ShortestSegments(NamedTuple):
    """The beginning of growing segments: u, the cuts, the states at the first samples, their error, and the search
    on the shortest segments where it came to an end."""

    u: np.ndarray
    cuts: list[list[Piece]]
    best: dict[tuple[int, int], np.ndarray]
    misfit: float
    first: Descent | None = None


def _fit_shortest_segments(residuals: Residuals, u, starts, readers: list[Reader | None], search) -> _ShortestSegments:
    """The search on the shortest segments, from u, whose misfit is positive where they were not fitted.

    It is the mean logarithm of the noise σ of the signals, over `_POOR` times the scatter of the data or a share
    `_COARSE` of the signals' size, whichever is larger.
    """
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(residuals, readers, u))
    best = {(k, 0): start for k, start in enumerate(starts)}
    if not cuts:
        return _ShortestSegments(u, cuts, best, -np.inf)
    done = search(cuts[0], u, best)
    if isinstance(done, LostTrial):
        return _ShortestSegments(u, cuts, best, np.inf)
    near = []
    for part in residuals.parts:
        if reading := [reader for reader in readers[part.records] if reader is not None]:
            scatter = np.sqrt(np.mean([np.square(reader.scatter) for reader in reading], axis=0))
            near.append(np.maximum(_POOR * scatter, _COARSE * part.system.size[: len(scatter)]))
    ratio = done.noise.sigma / np.concatenate(near)
    return _ShortestSegments(done.point.u, cuts, best, float(np.mean(np.log(ratio))), done)


def _fit_level(residuals: Residuals, pieces: list[Piece], u, best, law, readers, anchor) -> Descent | LostTrial:
    """The search on one cut of the records. The states in `best`, by record and sample, begin it and take its end."""
    firsts = [(piece.record, int(piece.places[0])) for piece in pieces]
    for k, reader in enumerate(readers):
        new = [place for record, place in firsts if record == k and (k, place) not in best]
        if new and reader is not None:
            read = pad_states(reader.states(np.array(new)), residuals.states)
            best |= {(k, place): y for place, y in zip(new, read, strict=True)}
    part = residuals.with_pieces(pieces, np.array([residuals.fitted[k] or place > 0 for k, place in firsts]))
    y0 = np.stack([best[first] for first in firsts])
    done = minimise(part, u, y0, law, _ENOUGH_OF_LEVEL * part.measured, _TRIALS_OF_LEVEL, anchor)
    if not isinstance(done, LostTrial):
        best |= dict(zip(firsts, done.point.starts, strict=True))
    return done


def _fit_short_windows(residuals: Residuals, u, law, readers: list[Reader | None], anchor: Anchor) -> np.ndarray:
    """The u that suits the accelerations of local cubics: these have one minimum where segments are too long for u."""
    scales, short, states = _time_scales(residuals, readers, u), [], []
    for part in residuals.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = scales[part.records.start]
        if not (reading and np.isfinite(scale)):
            continue
        records, begun = short_windows(reading, 0.25 * scale)
        states.append(pad_states(begun, residuals.states))
        short.append(part.system.with_records(records, np.ones(len(records), bool)))
    if not short:
        return u
    part = Residuals(short)
    y0 = np.concatenate(states)[:, : part.states]
    done = minimise(part, u, y0, law, _ENOUGH_OF_WINDOWS, _TRIALS_OF_LEVEL, anchor)
    return u if isinstance(done, LostTrial) else done.point.u


def start_by_weak_form(residuals: Residuals, u: np.ndarray, readers: list[Reader | None]) -> np.ndarray:
    """The u that balances the weak form of Lagrange's equations, u itself where there is none."""
    scales = _time_scales(residuals, readers, u)
    parts = residuals.parts
    found = fit_weak_form([(part.system, readers[part.records], scales[part.records.start]) for part in parts], u)
    return u if found is None else found


def _descend_segments(residuals: Residuals, u, law, readers: list[Reader | None], tell) -> np.ndarray:
    """The u that two thirds of the steps come to over segments that grow, each with a start of its own."""
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(residuals, readers, u))
    for pieces in [] if any(part.system.clocks for part in residuals.parts) else cuts:
        reading = ((recorder, piece.places[:1]) for piece in pieces if (recorder := readers[piece.record]))
        states = np.stack([pad_states(one.states(place)[0], residuals.states) for one, place in reading])
        part = residuals.with_pieces(pieces, np.ones(len(pieces), bool))
        done = descend_gradient(part, u, states, law, 2 * _GRADIENT_STEPS // (3 * len(cuts)), tell)
        if not isinstance(done, LostTrial):
            u = done[0]
    return u


def _time_scales(residuals: Residuals, readers: list[Reader | None], u) -> list[float]:
    """The duration for which the motion of each record looks like a straight line: of all records of a system the same.

    It is infinite for a system of which no state can be read off.
    """
    scales, numbers = [], residuals.parameters.numbers(u)
    for part in residuals.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = min(time_scales(reading, part.system.motions, numbers)) if reading else np.inf
        scales += [scale] * len(part.system.records)
    return scales
