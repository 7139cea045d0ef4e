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

import contextlib
import itertools
import sys
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from lagjax._equations import has_constraints
from lagjax._fit.model._noise import AbstractNoise
from lagjax._fit.model._pieces import Piece
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, SystemResiduals
from lagjax._fit.search._adam import descend_gradient
from lagjax._fit.search._descent import Anchor, Descent, minimise
from lagjax._fit.search._multistart import misfit
from lagjax._fit.search._reader import Reader, pad_states, short_windows, start_noise, time_scales
from lagjax._fit.search._unexplained import measure_unexplained
from lagjax._run.hybrid import Hybrid, list_laws, may_jump
from lagjax._show import even_places

# In units of half the sum of squares: the end of a search, where parameters are within 0.05 standard deviations of
# independent noise, and, per sample, that of a level of growing segments, whose answer is only where the next begins.
_ENOUGH, _ENOUGH_OF_LEVEL = 1e-3, 1e-2
_ENOUGH_OF_WINDOWS = 0.1
_POOR, _COARSE = 2.0, 0.02  # times scatter or size of signals: beyond, the shortest segments were not fitted
_SHORTEST = 1e-12  # of the time of a record: in a shorter window times are rounded to one
_LOOSE = 3.0  # standard deviations of u about its first value on these levels, where u is a logarithm or the like
_TRIALS, _TRIALS_OF_LEVEL = 300, 20
_WORSE = 5.0  # times more that a join may leave: without friction it was 3, beyond the horizon 10 and more
_LOST = 2  # levels that may be lost: after one the next may find the motion again, with better parameters
_FALSELY = 1e-4  # of a sound fit in long pieces, that it is taken for a false minimum
_LYAPUNOV = 5.0  # times 1/λ that a record is long: shorter ones are followed whole
# Records of a sample that is searched before all of them, the samples that it has for each unknown, and times as many
# records from which on it pays.
_SAMPLED, _SAMPLES_EACH, _PAYS = 64, 30, 4
_SUSPECT, _SAMPLES_OF_LEVEL = 0.05, 4  # of the signals, left by a search; samples for each unknown in first samples
# Shortest segments of a record, whose motion jumps, from which on they come before other starts. Of up to 17 other
# starts cost less; of 51 to 115 these did not find the motion in a minute and more, and segments did in 13 to 27 CPU s.
_LONG = 32
_GRADIENT_STEPS = 3000  # of a descent by gradients


class Search:
    """The search of a fit: `search(point)` is the end of one from a point; `readers` read states off the records.

    A `rough` search tells how much of the signals is left. Learned functions need no more, since their prior is still
    weak, and a search to the end would creep along what data do not tell; evidence ends it (`find_smoothness`).
    """

    def __init__(
        self, residuals: Residuals, law: AbstractNoise, method: str, readers: list[Reader | None], rough: bool = False
    ):
        self.residuals, self.law, self.method = residuals, law, method
        rough |= bool(residuals.parameters.prior_weights.any())
        self.enough = _ENOUGH_OF_LEVEL * residuals.measured if rough else _ENOUGH
        whole = [
            isinstance(part.scene, Hybrid) and any(map(has_constraints, list_laws(part.scene)))
            for part in residuals.parts
        ]
        self.readers = list(readers)
        self.jumping = np.array([may_jump(part.scene) for part in residuals.parts for _ in part.records])
        for part, is_whole in zip(residuals.parts, whole, strict=True):
            if is_whole:  # the constraints of a mode that is not the first
                self.readers[part.frame.records] = [None] * len(part.records)

    def __call__(self, point: Point) -> Descent:
        """The end of a search from a point. Where the motion jumps whole records come first, which cost less where they
        can be followed from there; and segments, of records long enough, where that leaves motion."""
        if self.method != "auto" or not self.jumping.all():
            return self._search(point)
        first, lost = None, LostMotion()
        try:
            first = self._minimise_whole(point)
        except LostMotion as reason:
            lost = reason
        if first is None or measure_unexplained(first).doubted:
            cuts = self._cut_records(point.u) if any(self.readers) else []
            if cuts and len(cuts[0]) >= _LONG * len(self.residuals.records):
                with contextlib.suppress(LostMotion):
                    done = self._search(point)
                    both = [one for one in (first, done) if one is not None and one.residuals is done.residuals]
                    return max(both, key=lambda one: one.residuals.log_likelihood(one.trial, one.noise))
        if first is None:
            raise lost
        return first

    def _search(self, point: Point) -> Descent:
        if self.method == "segments" and not any(self.readers):
            raise ValueError(
                'method="segments" reads starts off data: for that values must have the structure of q, and no mode of '
                "a Hybrid may have constraints."
            )
        levels_done: list[Descent] = []
        if self.method != "whole" and any(self.readers):
            point, levels_done = self._fit_growing_segments(point)
        good, all_cut = _last_followed_level(levels_done), all(self.readers)
        if len(levels_done) - good > _LOST and all_cut:
            return self._search_pieces(levels_done[: good + 1], levels_done[-1])
        done, lost = None, LostMotion()
        try:
            done = self._minimise_whole(point)
        except LostMotion as reason:
            lost = reason
        if levels_done and all_cut and (done is None or not done.converged or measure_unexplained(done).motion):
            good = _last_followed_level([*levels_done, *([] if done is None else [done])])
            if good < len(levels_done) and misfit(levels_done[good].noise, levels_done[good].residuals) < _COARSE:
                return self._search_pieces(levels_done[: good + 1], done)
        if self._knows_starts() and (done is None or measure_unexplained(done).share > _SUSPECT):
            done = self._search_beginnings(point, done)
        if done is None:
            raise lost
        return done

    # ---- whole records ----

    def _minimise_whole(self, point: Point) -> Descent:
        """The search of whole records from a point; that of many begins where the search of a sample of them ends."""
        places = self._sample_records()
        if len(places) < len(self.residuals.pieces):
            with contextlib.suppress(LostMotion):
                begin = self._minimise_sample(point, places, None)
                return minimise(self.residuals, begin, self.law, self.enough, _TRIALS)
        return minimise(self.residuals, point, self.law, self.enough, _TRIALS)

    def _sample_records(self) -> np.ndarray:
        """The places of all pieces, or of an even sample of them where a part says enough about the parameters."""
        residuals = self.residuals
        followed = residuals.unknowns.columns.shape[1] + residuals.states * residuals.fitted.any()
        count = max(_SAMPLED, round(_SAMPLES_EACH * followed * len(residuals.pieces) / residuals.measured))
        every = len(residuals.pieces)
        return even_places(every, count if _PAYS * count <= every else every)

    def _minimise_sample(self, point: Point, places: np.ndarray, length: int | None) -> Point:
        """The point with what the search of the pieces at `places`, up to a number of samples of each, comes to."""
        residuals = self.residuals
        pieces = [piece._replace(places=piece.places[:length]) for piece in map(residuals.pieces.__getitem__, places)]
        part = residuals.with_pieces(pieces, residuals.fitted[places])
        begin, enough = Point(point.u, point.starts[places]), _ENOUGH_OF_LEVEL * part.measured
        end = minimise(part, begin, self.law, enough, _TRIALS_OF_LEVEL if length else _TRIALS).trial
        starts = point.starts.copy()
        starts[places] = end.starts
        return Point(end.u, starts)

    def _knows_starts(self) -> bool:
        """True where "auto" may begin with the first samples of records: all starts are known, and no motion jumps."""
        residuals = self.residuals
        plain = not any(
            may_jump(part.scene) or part.clocks or part.signals.delays is not None for part in residuals.parts
        )
        return self.method == "auto" and plain and not any(self.readers) and not residuals.fitted.any()

    def _search_beginnings(self, point: Point, done: Descent | None) -> Descent | None:
        """The likelier one of `done` and the search that begins with the first samples of the records, ever more."""
        residuals, places, length = self.residuals, self._sample_records(), 2
        longest = max(len(piece.places) for piece in residuals.pieces)
        signals = residuals.measured / sum(len(piece.places) for piece in residuals.pieces)
        with contextlib.suppress(LostMotion):
            while length < longest:
                if (length - 1) * len(places) * signals > _SAMPLES_OF_LEVEL * len(point.u):
                    point = self._minimise_sample(point, places, length)
                length = 2 * length - 1
            both = [self._minimise_whole(point), *([] if done is None else [done])]
            return max(both, key=lambda one: residuals.log_likelihood(one.trial, one.noise))
        return done

    def _search_pieces(self, levels_done: list[Descent], joined: Descent | None) -> Descent:
        """The search of the last level; where the motion jumps, of the last that leaves no more than those before it:
        longer pieces may end in another minimum."""
        *shorter, level = levels_done
        done = minimise(level.residuals, level.trial, self.law, _ENOUGH, _TRIALS)
        if self.jumping.any() and any(_leaves_more(done, other) for other in shorter):
            return self._search_pieces(shorter, done)
        worse = "fails"
        if joined is not None:
            more = misfit(joined.noise, joined.residuals) / misfit(done.noise, done.residuals)
            worse = f"leaves {more:.2g} times more"
        count = len(done.residuals.pieces)
        text = f"The records are followed in {count} pieces, each with a start of its own: to join them {worse}"
        if is_chaotic := (growth := _trajectory_separation(done)) > _LYAPUNOV:
            text += f", because motions that begin side by side part e^{growth:.0f}-fold over a record."
        else:
            text += ", though the motion does not forget its start: the scene lacks something that lasts longer."
        return done._replace(message=f"{done.message} {text}", converged=done.converged and is_chaotic)

    # ---- segments that grow ----

    def _fit_growing_segments(self, point: Point) -> tuple[Point, list[Descent]]:
        """Better first values, from segments that grow together to whole records; and the levels."""
        reach = self.residuals.parameters.reach
        anchor = Anchor(point.u, np.where(np.isfinite(reach), 1.0 / _LOOSE, 0.0))
        begun = self._fit_shortest_segments(point, anchor)
        for held in (anchor, anchor._replace(weight=np.zeros(len(point.u)))):
            if begun.misfit > 0.0:  # the shortest segments were not fitted from here
                if self.jumping.all():  # with fewer jumps in each
                    again = self._fit_shortest_segments(point, held, 0.5)
                else:
                    windowed = point._replace(u=self._fit_short_windows(point.u, held))
                    again = self._fit_shortest_segments(windowed, held)
                begun, anchor = min((begun, anchor), (again, held), key=lambda one: one[0].misfit)
        u, best, levels_done = begun.u, begun.best, [] if begun.first is None else [begun.first]
        for pieces in begun.cuts[1:]:
            try:
                done = self._fit_level(pieces, u, best, anchor)
            except LostMotion:
                break  # whole records then begin from the best so far, and say so if they fail as well
            u = done.trial.u
            levels_done.append(done)
            if len(levels_done) - _last_followed_level(levels_done) > _LOST:
                break
        return Point(u, np.stack([best[k, 0] for k in range(len(self.residuals.records))])), levels_done

    def _fit_shortest_segments(self, point: Point, anchor: Anchor, length: float = 1.0) -> "_ShortestSegments":
        """The search on the shortest segments. Misfit: the mean log of noise over the larger of `_POOR` times the
        data's scatter and `_COARSE` of the signals; positive where they were not fitted."""
        u, cuts = point.u, self._cut_records(point.u, length)
        best = {(k, 0): start for k, start in enumerate(point.starts)}
        if not cuts:
            return _ShortestSegments(u, cuts, best, -np.inf)
        try:
            done = self._fit_level(cuts[0], u, best, anchor)
        except LostMotion:
            return _ShortestSegments(u, cuts, best, np.inf)
        near = []
        for part in self.residuals.parts:
            if reading := self._readers_of(part):
                scatter = np.sqrt(np.mean([np.square(reader.scatter) for reader in reading.values()], axis=0))
                near.append(np.maximum(_POOR * scatter, _COARSE * part.size[: len(scatter)]))
        ratio = done.noise.sigma / (done.residuals.unit * np.concatenate(near))
        return _ShortestSegments(done.trial.u, cuts, best, float(np.mean(np.log(ratio))), done)

    def _fit_level(self, pieces: list[Piece], u, best: dict, anchor: Anchor) -> Descent:
        """The search on one cut of the records, from the states in `best`, by record and sample, which take its end."""
        firsts = [(piece.record, int(piece.places[0])) for piece in pieces]
        for k, reader in enumerate(self.readers):
            new = [place for record, place in firsts if record == k and (k, place) not in best]
            if new and reader is not None:
                read = pad_states(reader.states(np.array(new)), self.residuals.states)
                best |= {(k, place): y for place, y in zip(new, read, strict=True)}
        fitted = np.array([self.residuals.fitted[k] or place > 0 for k, place in firsts])
        part, point = self.residuals.with_pieces(pieces, fitted), Point(u, np.stack([best[first] for first in firsts]))
        if self.jumping.any():
            part = part.choose_modes(point, start_noise(part, self.readers, point))
        done = minimise(part, point, self.law, _ENOUGH_OF_LEVEL * part.measured, _TRIALS_OF_LEVEL, anchor)
        best |= dict(zip(firsts, done.trial.starts, strict=True))
        return done

    def _fit_short_windows(self, u, anchor: Anchor) -> np.ndarray:
        """The u that suits the accelerations of local cubics: these have one minimum where segments are too long."""
        short, states, owners = [], [], []
        for part, scale in zip(self.residuals.parts, self._time_scales(u), strict=True):
            last = max((record.ts[-1] for record in part.records), default=0.0)
            if np.isfinite(scale) and scale > _SHORTEST * abs(last) and not may_jump(part.scene):
                records, begun, of = short_windows(self._readers_of(part), 0.25 * scale)
                states.append(pad_states(begun, self.residuals.states))
                short.append(part.with_records(records, np.ones(len(records), bool)))
                owners += of
        if not short:
            return u
        part = Residuals(short, self.residuals.parameters.select(owners))
        point = Point(u, np.concatenate(states)[:, : part.states])
        with contextlib.suppress(LostMotion):
            return minimise(part, point, self.law, _ENOUGH_OF_WINDOWS, _TRIALS_OF_LEVEL, anchor).trial.u
        return u

    def _readers_of(self, part: SystemResiduals) -> dict[int, Reader]:
        """The readers of the records of a system, by the number of each."""
        places = range(part.frame.records.start, part.frame.records.stop)
        return {k: reader for k in places if (reader := self.readers[k]) is not None}

    def _time_scales(self, u) -> list[float]:
        """The duration for which the motion of each system looks like a straight line; infinite without readers."""
        parameters, found = self.residuals.parameters, []
        for part in self.residuals.parts:
            reading = self._readers_of(part)
            numbers = parameters.numbers(u)[parameters.places[list(reading)]]
            found.append(min(time_scales(list(reading.values()), part.motions, numbers)) if reading else np.inf)
        return found

    def _cut_records(self, u, length: float = 1.0) -> list[list[Piece]]:
        pairs = zip(self.residuals.parts, self._time_scales(u), strict=True)
        scales = [length * scale for part, scale in pairs for _ in part.records]
        modes = [piece.mode for piece in self.residuals.pieces]
        return _growing_cuts(self.readers, scales, self.jumping, modes)

    # ---- gradients ----

    def descend_gradient(self, point: Point) -> Descent:
        """The descent by gradients: over segments of the records that grow, where they can be read, then over all."""
        residuals, steps = self.residuals, _GRADIENT_STEPS
        watch, residuals.watch = residuals.watch, None
        tell = None if watch is None else lambda text: print(text, file=sys.stderr, flush=True)
        if any(self.readers):
            u, steps = point.u, _GRADIENT_STEPS // 3
            cuts = [] if any(part.clocks for part in residuals.parts) else self._cut_records(u)
            for pieces in cuts:
                reading = ((reader, piece.places[:1]) for piece in pieces if (reader := self.readers[piece.record]))
                starts = np.stack([pad_states(one.states(place)[0], residuals.states) for one, place in reading])
                part = residuals.with_pieces(pieces, np.ones(len(pieces), bool))
                of_cut = 2 * _GRADIENT_STEPS // (3 * len(cuts))
                with contextlib.suppress(LostMotion):
                    u = descend_gradient(part, Point(u, starts), self.law, of_cut, tell)[0].u
            point = point._replace(u=u)
        end, at_rest = descend_gradient(residuals, point, self.law, steps, tell)
        trial = residuals.evaluate(end)
        text = f"The descent by gradients came to rest within {_GRADIENT_STEPS} steps."
        if not at_rest:
            text = (
                f"The descent by gradients was stopped after {_GRADIENT_STEPS} steps, and the likelihood still grew: "
                "continue from there, with fit.params in place of params0."
            )
        return Descent(residuals, trial, residuals.noise_scale(trial, self.law), at_rest, _GRADIENT_STEPS, text)


def search_again(done: Descent, law: AbstractNoise) -> Descent:
    """The end of a search where samples that share a rounding error count once, at the motion found; unchanged for
    sensors that do not round."""
    if np.isnan(done.residuals.sensor.step).all():
        return done
    residuals = done.residuals.count_runs_once(done.trial, done.noise)
    again = minimise(residuals, done.trial.point, law, _ENOUGH, _TRIALS)
    return done if not again.converged else again._replace(converged=done.converged, message=done.message)


class _ShortestSegments(NamedTuple):
    """The beginning of growing segments: u, the cuts, the states by record and sample, and the first search."""

    u: np.ndarray
    cuts: list[list[Piece]]
    best: dict[tuple[int, int], np.ndarray]
    misfit: float
    first: Descent | None = None


def _last_followed_level(levels_done: list[Descent]) -> int:
    """The index of the last level whose misfit grew by at most `_WORSE` at each join.

    What a scene lacks triples the misfit at a join, a lost motion makes it ten times as large.
    """
    good, last = 0, np.inf
    for k, done in enumerate(levels_done):
        now = misfit(done.noise, done.residuals)
        if now <= _WORSE ** (k - good) * last:
            good, last = k, now
    return good


def _leaves_more(done: Descent, other: Descent) -> bool:
    """True where a search leaves more, beyond chance, than another one of more pieces does: an F test."""
    least, more = (one.residuals.log_likelihood(one.trial, one.noise) for one in (done, other))
    count, few, many = done.residuals.measured, *(len(one.trial.u) + one.residuals.free_states for one in (done, other))
    ratio, freedom, left = np.exp(2 * (more - least) / count), many - few, count - many  # of the squares left
    return min(freedom, left) > 0 and fdtrc(freedom, left, (ratio - 1) * left / freedom) < _FALSELY


def _trajectory_separation(done: Descent) -> float:
    """λ times the length of the longest record; λ is the median over pieces of the growth of derivatives by the start
    between the first and the last third."""
    rates, states = [], done.residuals.states
    for batch, slopes in zip(done.residuals.batches, done.trial.slopes, strict=True):
        for ts, weights, by_start in zip(batch.ts, batch.weights, slopes[..., :states], strict=True):
            squares = (by_start[weights.any(axis=-1)] ** 2).sum(axis=1)
            third = len(squares) // 3
            if third and (squares[:third].sum(axis=0) > 0).all():
                growth = np.log(squares[-third:].sum(axis=0) / squares[:third].sum(axis=0)).mean() / 2
                rates.append(growth / (ts[2 * third] - ts[0]))
    longest = max(record.ts[-1] - record.ts[0] for record in done.residuals.records)
    return float(np.median(rates) * longest) if rates else 0.0


# ---- cuts of records into segments -----------------------------------------------------------------------------------

_FEWEST_IN_SEGMENT, _ASIDE = 8, 3  # samples; the part of a segment by which an edge may move


def _growing_cuts(
    readers: list[Reader | None], scales: list[float], jumping: np.ndarray, modes: list
) -> list[list[Piece]]:
    """Cuts of records from segments of two of their time `scales` to whole records, each twice as long as the one
    before; none where records are hardly longer, and None instead of a reader leaves its record out."""
    reading = [(k, reader) for k, reader in enumerate(readers) if reader is not None]
    edges = [(k, reader.record, _segment_edges(reader, 2.0 * scales[k], jumping[k])) for k, reader in reading]
    most, found, stride = max(len(e) - 1 for *_, e in edges), [], 1
    while stride < most:
        pieces = []
        for k, record, e in edges:
            cut = [*e[:-1:stride].tolist(), len(record)]
            if len(cut) > 2 and 2 * (e[-1] - cut[-2]) < e[min(stride, len(e) - 1)] - e[0]:
                del cut[-2]  # a rest shorter than half a segment joins the one before
            pieces += [Piece(k, np.arange(a, b), () if a else modes[k]) for a, b in itertools.pairwise(cut)]
        found.append(pieces)
        stride *= 2
    return found


def _segment_edges(reader: Reader, length: float, jumping: bool) -> np.ndarray:
    """The first samples of the shortest segments of one record, and its length; where the motion jumps, those near by
    that look smooth."""
    ts = reader.record.ts
    count = max(1, int((ts[-1] - ts[0]) / length)) if np.isfinite(length) else 1
    count = max(1, min(count, len(ts) // _FEWEST_IN_SEGMENT))
    found = np.searchsorted(ts, np.linspace(ts[0], ts[-1], count + 1)[:-1])
    if jumping and count > 1:
        aside = int(np.diff(found).min()) // _ASIDE
        found[1:] = [reader.smoothest(place - aside, min(place + aside, len(ts) - 1)) for place in found[1:]]
    return np.unique(np.append(found, len(ts)))
