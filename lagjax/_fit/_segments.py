"""The beginning of a search: states read off the data, and records cut into segments that grow together.

Over a long record the sum of squares has many minima: a wrong frequency is out of phase, a chaotic motion forgets its
start. Over a segment shorter than the motion's own time scale there is one. So the records are first cut into short
segments, each with a start of its own (multiple shooting), from states that local polynomials read off the data. When
the parameters fit those, neighbours are joined and the joined segment goes on from the start of its first part: its
end then misses the data by as much as the states of two neighbours disagreed, which the next search closes. So the
weight of continuity goes from none to all, in as many doublings as it takes to reach whole records. A level needs a
rough answer only: the parameters must be good enough to predict a segment twice as long.

Others impose continuity by penalties or constraints on all levels at once (Bock's multiple shooting, coupling to the
data); the growing of segments needs no weights, and every level is the same least squares with starts eliminated.
Source: Bock, *Recent advances in parameter identification for ODE* (1983); Pisarenko & Sornette, Phys. Rev. E 69
(2004) 036122, for segments of chaotic signals.
"""

import itertools
from typing import NamedTuple

import numpy as np

from lagjax._fit._inputs import at_instants
from lagjax._fit._motions import AbstractMotions
from lagjax._fit._records import Piece, Record, in_structure, inputs_between

_DEGREE = 3  # of local polynomials: velocities without the bias that curvature gives to lines
_WINDOWS = (7, 13, 25, 49, 97, 193)  # samples in one of them
_PROBES = 32  # places of a record where its time scale is looked at
_WORSE = 1.3  # what a window may leave, in units of what the shortest leaves
_PER_SCALE = 24  # samples per time scale that early levels look at: more cost time and find the same
_GLIMPSES = 256  # places of all records where curvature is looked at
_FEWEST = 8  # samples in a segment
_QUARTER = (
    0.25  # of a period, by which the motion over a segment may be wrong: beyond a half residuals have false minima
)


class Reader(NamedTuple):
    """Positions and velocities of one record from local cubics: each signal is a coordinate.

    `windows` (S,) are the samples in one cubic, `scatter` (S,) what the shortest leave, `periods` (S,) those of signals
    that are known less whole periods, else infinite.
    """

    record: Record
    windows: tuple[int, ...]
    scatter: tuple[float, ...]
    periods: tuple[float, ...]

    @classmethod
    def of(cls, record: Record, probes: int = 256, periods: np.ndarray | None = None) -> "Reader":
        """A reader with the longest windows whose cubics leave no more than `_WORSE` times what the shortest leave.

        Beyond these they no longer follow the motion. They are tried at `probes` places.
        """
        places = some_of(record, probes)
        windows, scatter = zip(*(_window(record.ts[places], *signal) for signal in _signals(record)), strict=True)
        each = np.full(len(windows), np.inf) if periods is None else periods
        return cls(record, windows, scatter, tuple(each.tolist()))

    def states(self, places) -> np.ndarray:
        """(q, q̇) at the samples `places` (M,) of the record, (M, 2n)."""
        read = self.read(places)
        return np.stack([one[k] for k in (0, 1) for one in read], axis=-1)

    def read(self, places) -> list[tuple]:
        """Of every signal what `_read` gives at the samples `places`."""
        ts = self.record.ts[places]
        return [_read(ts, *signal, window) for signal, window in zip(_signals(self.record), self.windows, strict=True)]


def some_of(record: Record, count: int) -> np.ndarray:
    """At most this many places of samples, from the first to the last."""
    return np.unique(np.linspace(0, len(record) - 1, count).astype(int))


def _signals(record: Record) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times and values of every signal, where it is not missing."""
    columns = record.matrix.T
    return [(record.ts[np.isfinite(column)], column[np.isfinite(column)]) for column in columns]


def _read(ts: np.ndarray, t: np.ndarray, y: np.ndarray, window: int):
    """The values of a signal (t, y) and its rates at the times `ts`, what is left, and the local cubics there.

    Where hardly anything was measured the signal is taken to be at rest.
    """
    if len(t) <= _DEGREE + 1:
        level = np.full(len(ts), np.mean(y) if len(y) else 0.0)
        return level, np.zeros(len(ts)), 0.0, level[:, None]
    return _local_cubics(ts, t, y, min(window, len(t)))


def _window(ts: np.ndarray, t: np.ndarray, y: np.ndarray) -> tuple[int, float]:
    """The number of samples in the window for one signal, and the scatter about the shortest."""
    scatter = _read(ts, t, y, _WINDOWS[0])[2]
    best, most = _WINDOWS[0], _WORSE * scatter
    for window in _WINDOWS[1:]:
        if window > len(t) or _read(ts, t, y, window)[2] > most:
            break
        best = window
    return best, scatter


def _local_cubics(ts, t, y, window: int):
    """Cubics through the `window` samples of (t, y) about each of the times `ts`: values, rates, what is left, and
    the coefficients (M, 4) of the powers of the time since."""
    after = np.searchsorted(t, ts)
    first = np.clip(after - window // 2, 0, len(t) - window)
    places = first[:, None] + np.arange(window)
    offsets = t[places] - ts[:, None]
    length = np.abs(offsets).max(axis=1, keepdims=True)
    powers = (offsets / length)[..., None] ** np.arange(min(_DEGREE, window - 1) + 1)
    # On [-1, 1] the normal equations of a cubic have a condition below 1e3.
    transposed = powers.swapaxes(1, 2)
    coefficients = np.linalg.solve(transposed @ powers, transposed @ y[places][..., None])
    left = (powers @ coefficients)[..., 0] - y[places]
    coefficients = coefficients[..., 0]
    dof = max(window - powers.shape[-1], 1)
    cubics = coefficients / length ** np.arange(powers.shape[-1])
    return cubics[:, 0], cubics[:, 1], float(np.sqrt(np.mean(left**2) * window / dof)), cubics


def glimpses(readers: list[Reader], length: float) -> tuple[list[Record], np.ndarray]:
    """Short records, each `length` long, of the local cubics at some places of all records, and the states there.

    Motions that are shorter than the time between samples see the curvature of the cubics: what a scene says about
    accelerations, without a second derivative of the data.
    """
    found, states = [], []
    for reader in readers:
        places = some_of(reader.record, max(4, _GLIMPSES // len(readers)))
        offsets = np.linspace(0.0, length, 4)
        cubics = [
            _read(reader.record.ts[places], *s, w)[3]
            for s, w in zip(_signals(reader.record), reader.windows, strict=True)
        ]
        values = np.stack([np.polynomial.polynomial.polyval(offsets, c.T) for c in cubics], axis=-1)
        structured = [in_structure(v, reader.record) for v in values]
        found += [
            Record(t + offsets, v, inputs_between(reader.record, t + offsets))
            for t, v in zip(reader.record.ts[places], structured, strict=True)
        ]
        states.append(reader.states(places))
    return found, np.concatenate(states)


class TimeScales(NamedTuple):
    """The duration for which a motion looks like a straight line, by the data and by the scene at their states."""

    data: float
    scene: float


def time_scales(readers: list[Reader], motions: AbstractMotions, numbers: np.ndarray) -> TimeScales:
    """The shortest times over which a motion looks like a straight line, with the parameters `numbers` (P,).

    That of the data is the ratio of the spread of a coordinate to its rate, about 1/ω; that of the scene the root of
    the spread of the coordinates, in units of each, over the accelerations there. Where nothing moves, they are
    infinite.
    """
    places = [some_of(reader.record, _PROBES) for reader in readers]
    states = [reader.states(some) for reader, some in zip(readers, places, strict=True)]
    t = np.concatenate([reader.record.ts[some] for reader, some in zip(readers, places, strict=True)])
    y, n = np.concatenate(states), states[0].shape[1] // 2
    within = np.concatenate([state[:, :n] - state[:, :n].mean(axis=0) for state in states])
    inputs = np.concatenate([reader.record.input_matrix[some] for reader, some in zip(readers, places, strict=True)])
    pulled = motions.rate(t, y, numbers, at_instants(t, inputs))
    pulled = np.where(np.isfinite(pulled), pulled, 0.0)
    spread, rate, pulled = (np.sqrt(np.mean(x**2, axis=0)) for x in (within, y[:, n:], pulled))
    spread = np.minimum(spread, _QUARTER * np.array(readers[0].periods))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = spread / rate, np.sqrt(spread / pulled)
    return TimeScales(*(float(one[np.isfinite(one) & (one > 0)].min(initial=np.inf)) for one in both))


def levels(records: list[Record | None], scales: list[float]) -> list[list[Piece]]:
    """Cuts of the records, from segments of two time scales to whole records, each twice as long as the one before.

    Each record has its time scale. Without any where records are hardly longer than that; None in the place of a record
    is left out.
    """
    edges = [(k, record, _edges(record, 2.0 * scales[k])) for k, record in enumerate(records) if record is not None]
    most, found, stride = max(len(e) - 1 for *_, e in edges), [], 1
    while stride < most:
        pieces = []
        for k, record, e in edges:
            cut = [*e[:-1:stride].tolist(), len(record)]
            if len(cut) > 2 and 2 * (e[-1] - cut[-2]) < e[min(stride, len(e) - 1)] - e[0]:
                del cut[-2]  # a rest shorter than half a segment joins the one before
            pieces += [_thinned(record, k, a, b, scales[k]) for a, b in itertools.pairwise(cut)]
        found.append(pieces)
        stride *= 2
    return found


def _edges(record: Record, length: float) -> np.ndarray:
    """The first samples of the shortest segments of one record, and its length."""
    ts = record.ts
    count = max(1, int((ts[-1] - ts[0]) / length)) if np.isfinite(length) else 1
    count = max(1, min(count, len(ts) // _FEWEST))
    return np.unique(np.append(np.searchsorted(ts, np.linspace(ts[0], ts[-1], count + 1)[:-1]), len(ts)))


def _thinned(record: Record, which: int, begin: int, end: int, scale: float) -> Piece:
    """The samples from `begin` to `end`, of which only so many as the motion needs to be seen."""
    spacing = (record.ts[end - 1] - record.ts[begin]) / max(end - 1 - begin, 1)
    step = int(scale / (_PER_SCALE * spacing)) if np.isfinite(scale) and spacing > 0 else 1
    step = max(1, min(step, (end - begin) // _FEWEST))
    return Piece(which, np.arange(begin, end, step))


def complete(pieces: list[Piece], records: list[Record]) -> list[Piece]:
    """The same pieces of records with all of their samples, up to the first of the next piece."""
    firsts = {(piece.record, int(piece.places[0])) for piece in pieces}
    ends = [
        min((place for k, place in firsts if k == piece.record and place > piece.places[0]), default=None)
        for piece in pieces
    ]
    return [
        Piece(piece.record, np.arange(piece.places[0], len(records[piece.record]) if end is None else end))
        for piece, end in zip(pieces, ends, strict=True)
    ]


def whole(records: list[Record]) -> list[Piece]:
    """Every record in one piece."""
    return [Piece(k, np.arange(len(record))) for k, record in enumerate(records)]
