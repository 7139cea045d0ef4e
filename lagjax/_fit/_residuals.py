"""`Question` and `Point`: what is to be fitted to what, and the residuals of one trial with their derivatives.

The unknowns are u (F,), the free parameters as their transforms move them, and the starts (N, 2n) of the N pieces of
records. A residual of piece k depends on u and on start k alone: the rows of a piece, D = 2n + F columns and the
residual, are compressed to a triangle of D + 1 rows (QR), in which all sums of squares are the same.

`Several`: one question about records of several systems that share their parameters.

Each system has a `Question` of its own, with its coordinates, sensors and inputs. A piece of a record depends on its
start and on u alone, whatever its system: once its start is eliminated, only the columns of the parameters are left,
and these are the same for all. So the search stays as it is. Rows of all systems are made alike: a start has room for
the most coordinates, of which a smaller system leaves the last ones without any influence, like those of a start that
is known; and the signals of all systems stand side by side, with no weight where a record does not have them.
"""

import abc
import contextlib
import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit._motions import AbstractMotions, Manifold, Motion, Origins, Placed
from lagjax._fit._noise import AbstractNoise, Widths, counts
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Piece, Record, Samples, at_instants, batches, inputs_at
from lagjax._fit._sensors import Signals, on_circle
from lagjax._fit._timings import AbstractClock
from lagjax._layout import Layout


class Point(NamedTuple):
    """One trial: the unknowns, and for each batch the residuals (N, T, S) and their derivatives (N, T, S, D).

    Where starts lie on constraints `across` (N, 2n, 2n) takes a change of each to its part across these, which changes
    nothing that is measured.
    """

    u: np.ndarray
    starts: np.ndarray
    residuals: list[np.ndarray]
    slopes: list[np.ndarray]
    across: np.ndarray | None = None

    def flat(self) -> np.ndarray:
        """All residuals, (M, S)."""
        return np.concatenate([r.reshape(-1, r.shape[-1]) for r in self.residuals])


class Failure(NamedTuple):
    """A trial whose motion could not be followed: the piece, and what became of it."""

    piece: int
    text: str


class Part(NamedTuple):
    """One system of a question: its name, None where there is only one; the question about its own records; and which
    of all records and signals these are."""

    name: str | None
    question: "Question"
    records: slice
    signals: slice


class AbstractQuestion(abc.ABC):
    """The problem of a search: N pieces of records with S signals, the free numbers, and the residuals of a trial.

    - `records`, `pieces` (N,), `fitted` (N,): whether the start of a piece is free; `states`: the numbers of a start.
    - `names`, `size`, `least` (S,): signals, their root mean square, and the smallest noise that can be told of them.
    - `batches`: the samples, with a column for every signal; `weights` (M, S): all of theirs; `measured`: how many.
    - `watch` is told of every trial.
    """

    records: list[Any]
    pieces: list[Piece]
    fitted: np.ndarray
    states: int
    names: tuple[str, ...]
    size: np.ndarray
    least: np.ndarray
    batches: list[Samples]
    weights: np.ndarray
    measured: int
    parameters: Parameters
    watch: Callable[[Point | Failure], None] | None

    @abc.abstractmethod
    def of(self, pieces: list[Piece], fitted: np.ndarray) -> "AbstractQuestion":
        """The same question about other pieces of the records."""

    @abc.abstractmethod
    def with_parameters(self, parameters: Parameters) -> "AbstractQuestion":
        """The same question where other parameters are free."""

    @abc.abstractmethod
    def columns(self, record: int) -> slice:
        """Which of the signals a record has."""

    @abc.abstractmethod
    def called(self, record: int) -> str:
        """The name by which the user reaches a record: `records[0]`."""

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[Part, ...]:
        """The systems, each with its question about all of its records."""

    @property
    @abc.abstractmethod
    def apart(self) -> list[tuple[Part, np.ndarray]]:
        """The systems that have pieces, each with its question about these alone, and which of all they are."""

    @property
    @abc.abstractmethod
    def unknowns(self) -> int:
        """The number of free numbers of all starts."""

    @abc.abstractmethod
    def follow(self, u: np.ndarray, starts: np.ndarray) -> Point | Failure:
        """The residuals of one trial, or the first piece whose motion failed, untold."""

    def at(self, u: np.ndarray, starts: np.ndarray) -> Point | Failure:
        """The residuals of one trial, or the first piece whose motion failed."""
        trial = self.follow(u, starts)
        if self.watch is not None:
            self.watch(trial)
        return trial

    def widths(self, point: Point, noise: AbstractNoise) -> Widths:
        """The noise of the signals that makes the residuals of a trial likeliest."""
        return noise.widths(point.flat(), self.weights, self.least)

    def factors(self, point: Point, widths: Widths) -> list[np.ndarray]:
        """√count/σ of every sample, by which its residual enters the sum of squares."""
        return [
            np.sqrt(counts(widths, r, batch.weights)) / widths.sigma
            for r, batch in zip(point.residuals, self.batches, strict=True)
        ]

    def cost(self, point: Point, factors: list[np.ndarray]) -> float:
        """Half the weighted sum of squares."""
        return 0.5 * sum(float(np.sum((f * r) ** 2)) for f, r in zip(factors, point.residuals, strict=True))

    def triangles(self, point: Point, factors: list[np.ndarray]) -> np.ndarray:
        """The weighted rows of each piece, compressed: (N, D + 1, D + 1), the residual as last column."""
        columns = point.slopes[0].shape[-1] + 1
        found = np.zeros((len(self.pieces), columns, columns))
        for batch, factor, r, slopes in zip(self.batches, factors, point.residuals, point.slopes, strict=True):
            rows = np.concatenate([slopes, r[..., None]], axis=-1)
            rows *= factor[..., None]
            rows = rows.reshape(len(r), -1, columns)
            if point.across is not None:  # of a size that keeps the condition
                size = np.abs(rows[..., : self.states]).max() or 1.0
                more = np.pad(size * point.across[batch.rows], ((0, 0), (0, 0), (0, columns - self.states)))
                rows = np.concatenate([rows, more], axis=1)
            found[batch.rows] = compressed(rows)
        return found

    def where(self, failure: Failure) -> str:
        """A sentence for a failure, with the record's number."""
        piece = self.pieces[failure.piece]
        begin = self.records[piece.record].ts[piece.places[0]]
        return f"The motion of {self.called(piece.record)} from t = {begin:g} failed. {failure.text}"

    @property
    def firsts(self) -> list[int]:
        """Of every record the place of its first piece."""
        places = {piece.record: k for k, piece in reversed(list(enumerate(self.pieces)))}
        return [places[k] for k in range(len(self.records))]

    def restored(self, record: int, state: np.ndarray) -> tuple:
        """The pair (q, q̇) of a state of a record, of which other systems may leave the last numbers unused."""
        layout = next(part.question.layout for part in self.parts if record < part.records.stop)
        return layout.restore(state[: layout.size]), layout.restore(state[layout.size : 2 * layout.size])

    def by_system(self, of_records: Sequence) -> Any:
        """The values of every record as a tuple, or in a dict of tuples by the names of systems."""
        if self.parts[0].name is None:
            return tuple(of_records)
        return {part.name: tuple(of_records[part.records]) for part in self.parts}

    def end_to_end(self, of_systems: Any) -> list:
        """The values that `by_system` returned, for all records in order."""
        return list(of_systems) if self.parts[0].name is None else [x for own in of_systems.values() for x in own]


class Question(AbstractQuestion):
    """Pieces of records, the scene and its sensors, and what is free.

    `fitted` (N,) says of each piece whether its start is free; `size` (S,) is the root mean square
    of the signals, and that times `rtol`, the tolerance of the motion, the smallest noise that can be told; `periods`
    (S,) are those of wrapped signals, up to which residuals are known. Where some
    pieces are `Timings`, with `clocks` by the number of the record, crossing times are one more signal, the last.
    """

    def __init__(
        self,
        records: list[Record],
        pieces: list[Piece],
        fitted: np.ndarray,
        motions: AbstractMotions,
        signals: Signals,
        parameters: Parameters,
        size: np.ndarray,
        rtol: float,
        clocks: dict[int, AbstractClock] | None = None,
        manifold: Manifold | None = None,
    ):
        self.records, self.pieces, self.fitted = records, pieces, fitted
        self.watch: Callable[[Point | Failure], None] | None = None  # is told of every trial
        self.clocks, self.manifold = {} if clocks is None else clocks, manifold
        timed = any(piece.record in self.clocks for piece in pieces)
        self.names = (*signals.names, *(("times",) if timed else ()))
        self.periods = np.append(signals.periods, [np.inf] * timed)
        self.size, self.rtol, self.least = size[: len(self.names)], rtol, rtol * size[: len(self.names)]
        self.motions, self.signals, self.parameters = motions, signals, parameters
        self.layout: Layout = signals.layout
        self.states = 2 * self.layout.size
        self.batches: list[Samples] = self._in_batches()
        starts = [records[piece.record].start if piece.places[0] == 0 else None for piece in pieces]
        self.origins = Origins(starts, self.layout, parameters)
        self.weights = np.concatenate([b.weights.reshape(-1, len(self.names)) for b in self.batches])
        self.measured = int((self.weights > 0).sum())

    @property
    def unknowns(self) -> int:
        """The number of free numbers of all starts."""
        return self.states * int(self.fitted.sum())

    @property
    def parts(self) -> tuple[Part, ...]:
        """The one system."""
        return (Part(None, self, slice(0, len(self.records)), slice(0, len(self.names))),)

    @property
    def apart(self) -> list[tuple[Part, np.ndarray]]:
        """The one system, with all pieces."""
        return [(self.parts[0], np.arange(len(self.pieces)))]

    def called(self, record: int) -> str:
        """The name by which the user reaches a record."""
        return f"records[{record}]"

    def with_parameters(self, parameters: Parameters) -> "Question":
        """The same question where other parameters are free."""
        other = copy.copy(self)
        other.parameters = parameters
        return other

    def of(self, pieces: list[Piece], fitted: np.ndarray) -> "Question":
        """The same question about other pieces of the records."""
        part = Question(
            self.records, pieces, fitted, self.motions, self.signals, self.parameters, self.size, self.rtol,
            self.clocks, self.manifold,
        )  # fmt: skip
        part.watch = self.watch
        return part

    def columns(self, record: int) -> slice:
        """Which of the signals a record has."""
        last = len(self.signals.names)
        return slice(last, last + 1) if record in self.clocks else slice(0, last)

    def _in_batches(self) -> list[Samples]:
        """The records in batches, then each of the timings as a batch of its own, all with a column for each signal."""
        sensed = [row for row, piece in enumerate(self.pieces) if piece.record not in self.clocks]
        eps, hold = (
            float(np.finfo(self.layout.dtype).eps),
            "zero" if self.signals.form is None else self.signals.form.hold,
        )
        some = batches(self.records, [self.pieces[row] for row in sensed], eps, hold)
        found = [batch._replace(rows=np.array(sensed)[batch.rows]) for batch in some]
        for row, (k, _) in enumerate(self.pieces):
            if k in self.clocks:
                record = self.records[k]
                weights, values = record.weight_matrix[None], np.nan_to_num(record.matrix)[None]
                found.append(
                    Samples(np.array([row]), values[..., 0], values, weights, np.zeros((1, len(record), 0)), None)
                )
        return [self._widened(batch) for batch in found]

    def _widened(self, batch: Samples) -> Samples:
        columns = self.columns(self.pieces[batch.rows[0]].record)
        values, weights = np.zeros((2, *batch.ts.shape, len(self.names)))
        values[..., columns], weights[..., columns] = batch.values, batch.weights
        if self.signals.delays is not None and columns.start == 0:
            weights[batch.ts < batch.ts[:, :1] + self.signals.delays.longest] = 0.0
        return batch._replace(values=values, weights=weights)

    def follow(self, u: np.ndarray, starts: np.ndarray) -> Point | Failure:
        """The residuals of one trial, or the first piece whose motion failed, untold."""
        numbers, directions = self.parameters.numbers(u), self.parameters.directions(u)
        starts, moved = self.origins.move(starts, numbers, directions)
        tangents = across = None
        if self.manifold is not None and self.fitted.any():
            starts, tangents, moved = self._placed(starts, moved, numbers, directions)
            across = np.where(self.fitted[:, None, None], np.eye(self.states) - tangents, 0.0)
            if (lost := ~np.isfinite(starts).all(axis=1)).any():
                return Failure(int(np.argmax(lost)), "No start near the one that was tried satisfies the constraints.")
        if not (np.isfinite(numbers).all() and np.isfinite(directions).all() and np.isfinite(starts).all()):
            return Failure(0, "A parameter is not finite.")
        residuals, slopes = [], []
        for batch in self.batches:
            along = self._along(batch, moved, directions, tangents)
            clock = self.clocks.get(self.pieces[batch.rows[0]].record)
            follow = self._sense if clock is None else functools.partial(self._time, clock)
            shown = follow(batch, starts[batch.rows], numbers, *along)
            if isinstance(shown, Failure):
                return shown
            self._collect(batch, *shown, residuals, slopes)
        return Point(u, starts, residuals, slopes, across)

    def _placed(self, starts, moved, numbers, directions) -> Placed:
        """The starts that are fitted put on the constraints; the others as they are."""
        assert self.manifold is not None
        t = np.array([self.records[piece.record].ts[piece.places[0]] for piece in self.pieces])
        some, free = self.fitted, Placed(starts, np.tile(np.eye(self.states), (len(starts), 1, 1)), moved)
        for mine, new in zip(free, self.manifold.put(starts[some], t[some], numbers, directions), strict=True):
            mine[some] = new
        return free

    def _along(
        self, batch: Samples, moved: np.ndarray, directions: np.ndarray, tangents: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the starts (N, D, 2n) and of the parameters (D, P): D = 2n + F, or F where no start is free."""
        states = self.states if self.fitted[batch.rows].any() else 0
        y0_dot = np.zeros((len(batch.rows), states + len(directions), self.states))
        y0_dot[:, :states] = np.eye(states, self.states)
        if tangents is not None and states:
            y0_dot[:, :states] = tangents[batch.rows].swapaxes(1, 2)
        y0_dot[:, states:] = moved[batch.rows]
        return y0_dot, np.concatenate([np.zeros((states, directions.shape[1])), directions])

    def _sense(self, batch: Samples, y0, numbers, y0_dot, numbers_dot) -> tuple[np.ndarray, np.ndarray] | Failure:
        """The outputs of the sensors for a batch (N, T, S), and their tangents (N, T, S, D)."""
        shown = self._delayed(batch, y0, numbers, y0_dot, numbers_dot)
        if isinstance(shown, Failure):
            return shown
        values, by_unknowns = shown
        counted = batch.weights[..., : len(self.signals.names)] > 0
        bad = counted & ~(np.isfinite(values) & np.isfinite(by_unknowns).all(axis=-1))
        if bad.any():
            row, place, signal = np.argwhere(bad)[0]
            sample = self.pieces[batch.rows[row]].places[place]
            return Failure(
                int(batch.rows[row]),
                f"What `observe` returns for {self.signals.names[signal]}, or its derivative, is not finite at sample "
                f"{sample}, t = {batch.ts[row, place]:g}.",
            )
        return values, by_unknowns

    def _follow(self, batch: Samples, ts, y0, numbers, y0_dot, numbers_dot) -> Motion | Failure:
        motion = self.motions.follow(ts, y0, numbers, y0_dot, numbers_dot, batch.table)
        if motion.ok:
            return motion
        row, text = motion.why_not(ts, self.layout)
        return Failure(int(batch.rows[row]), text)

    def _delayed(self, batch: Samples, y0, numbers, y0_dot, numbers_dot) -> tuple[np.ndarray, np.ndarray] | Failure:
        """The signals at their times, or for each of the delays the signals that have it at earlier times."""
        delays, signals = self.signals.delays, self.signals
        if delays is None:
            motion = self._follow(batch, batch.ts, y0, numbers, y0_dot, numbers_dot)
            if isinstance(motion, Failure):
                return motion
            return signals.of(motion, batch.ts, batch.inputs, numbers, numbers_dot)
        each = delays.at(numbers)
        if text := delays.refuses(each):
            return Failure(int(batch.rows[0]), text)
        values = np.zeros((*batch.ts.shape, len(signals.names)))
        slopes = np.zeros((*values.shape, len(numbers_dot)))
        for delay in each:
            ts = np.maximum(batch.ts - delay.value, batch.ts[:, :1])
            motion = self._follow(batch, ts, y0, numbers, y0_dot, numbers_dot)
            if isinstance(motion, Failure):
                return motion
            inputs, rates = self._inputs_at(batch, ts)
            ts_dot = -numbers_dot @ delay.slopes
            y, n = motion.path.reshape(-1, self.states), self.layout.size
            pulled = self.motions.rate(ts.ravel(), y, numbers, at_instants(ts.ravel(), inputs.reshape(len(y), -1)))
            rate = np.concatenate([y[:, n:], pulled], axis=1).reshape(motion.path.shape)
            motion = motion._replace(tangents=motion.tangents + ts_dot[:, None, None] * rate[:, None])
            some = signals.of(motion, ts, inputs, numbers, numbers_dot, ts_dot, rates)
            values[..., delay.signals], slopes[..., delay.signals, :] = (x[:, :, delay.signals] for x in some)
        return values, slopes

    def _inputs_at(self, batch: Samples, ts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inputs (N, T, I) at other times `ts` (N, T) of the pieces of a batch, and their rates there."""
        if batch.table is None or self.signals.form is None:
            return batch.inputs, np.zeros_like(batch.inputs)
        values, rates = inputs_at(batch.table, ts, self.signals.form.hold)
        return np.asarray(values), np.asarray(rates)

    def _time(self, clock: AbstractClock, batch: Samples, y0, numbers, y0_dot, numbers_dot):
        """The crossing times (1, M, 1) of a batch of one, and how they move (1, M, 1, D); or a failure."""
        moved = clock.along(y0[0], numbers, y0_dot[0], numbers_dot)
        if moved is None:
            return Failure(int(batch.rows[0]), clock.why_not(y0[0], numbers))
        times, slopes = moved
        if not np.isfinite(slopes).all():
            return Failure(int(batch.rows[0]), "The derivatives of its crossing times are not finite.")
        return times[None, :, None], slopes[None, :, None]

    def _collect(self, batch: Samples, values, by_unknowns, residuals, slopes) -> None:
        """Append the residuals of one batch and their derivatives, with a column for every signal."""
        counted, columns = batch.weights > 0, self.columns(self.pieces[batch.rows[0]].record)
        missing = self.states + len(self.parameters) - by_unknowns.shape[-1]  # of starts, where none is free
        by_unknowns = np.pad(by_unknowns, ((0, 0), (0, 0), (0, 0), (missing, 0)))
        by_unknowns[~self.fitted[batch.rows], ..., : self.states] = 0.0
        left, moved = np.zeros(counted.shape), np.zeros(counted.shape + by_unknowns.shape[3:])
        left[..., columns], moved[..., columns, :] = values, by_unknowns
        residuals.append(np.where(counted, on_circle(left - batch.values, self.periods), 0.0))
        slopes.append(np.where(counted[..., None], moved, 0.0))


def triangle_of(rows: np.ndarray) -> np.ndarray:
    """R of the factorisation QR of matrices (..., M, D)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


_BLOCK = 8  # times as many rows as columns in one factorisation


def compressed(rows: np.ndarray) -> np.ndarray:
    """The triangles (N, D, D) of N tall matrices (N, M, D), block by block.

    Blocks stay in the cache, and are too small for a BLAS to start threads that wait for each other.
    """
    pieces, _, columns = rows.shape
    rows = rows if columns else rows[:, :0]
    while rows.shape[1] > columns:
        height = min(_BLOCK * columns, rows.shape[1])
        missing = -rows.shape[1] % height
        rows = np.concatenate([rows, np.zeros((pieces, missing, columns))], axis=1) if missing else rows
        blocks = triangle_of(rows.reshape(-1, height, columns))
        rows = blocks.reshape(pieces, -1, columns)
    found = np.zeros((pieces, columns, columns))
    found[:, : rows.shape[1]] = rows
    return found


class Several(AbstractQuestion):
    """The problem of several systems at once, by their names; `u` moves the parameters that they share.

    `systems` holds the questions about whole records. A piece has the number of its record among all, those of the
    first system first. Without `pieces` (N,) and `fitted` (N,) it is about whole records itself.
    """

    def __init__(
        self, systems: dict[str, Question], pieces: list[Piece] | None = None, fitted: np.ndarray | None = None
    ):
        self.systems, self.watch = systems, None
        self.parameters = next(iter(systems.values())).parameters
        self.records = [record for question in systems.values() for record in question.records]
        first = np.cumsum([0, *(len(question.records) for question in systems.values())])
        self.first = dict(zip(systems, first.tolist(), strict=False))
        if pieces is None or fitted is None:
            of_all = [(k, question) for name, question in systems.items() for k in [self.first[name]]]
            pieces = [Piece(k + piece.record, piece.places) for k, question in of_all for piece in question.pieces]
            fitted = np.concatenate([question.fitted for question in systems.values()])
        self.pieces, self.fitted = pieces, fitted
        self.states = max(question.states for question in systems.values())
        self._apart = self._taken_apart()
        own = [(part.name, part.question) for part, _ in self.apart]
        self.names = tuple(f"{name}: {signal}" for name, question in own for signal in question.names)
        self.size, self.least = (np.concatenate([getattr(q, kind) for _, q in own]) for kind in ("size", "least"))
        self.batches = [
            self._widened(part, rows, batch) for part, rows in self.apart for batch in part.question.batches
        ]
        self.weights = np.concatenate([b.weights.reshape(-1, len(self.names)) for b in self.batches])
        self.measured = int((self.weights > 0).sum())

    @property
    def apart(self) -> list[tuple[Part, np.ndarray]]:
        """The systems that have pieces, each with its question about these alone, and which of all they are."""
        return self._apart

    def _taken_apart(self) -> list[tuple[Part, np.ndarray]]:
        owner, found, signals = np.array([piece.record for piece in self.pieces]), [], 0
        for name, question in self.systems.items():
            records = slice(self.first[name], self.first[name] + len(question.records))
            rows = np.flatnonzero((owner >= records.start) & (owner < records.stop))
            if not len(rows):
                continue
            own = [Piece(self.pieces[row].record - records.start, self.pieces[row].places) for row in rows]
            part = question.of(own, self.fitted[rows])
            found.append((Part(name, part, records, slice(signals, signals + len(part.names))), rows))
            signals += len(part.names)
        return found

    def _widened(self, part: Part, rows: np.ndarray, batch: Samples) -> Samples:
        values, weights = np.zeros((2, *batch.ts.shape, len(self.names)))
        values[..., part.signals], weights[..., part.signals] = batch.values, batch.weights
        return batch._replace(rows=rows[batch.rows], values=values, weights=weights)

    @property
    def parts(self) -> tuple[Part, ...]:
        """The systems, each with its question about all of its records."""
        return tuple(part._replace(question=self.systems[str(part.name)]) for part, _ in self.apart)

    @property
    def unknowns(self) -> int:
        """The number of free numbers of all starts."""
        return sum(part.question.unknowns for part, _ in self.apart)

    def of(self, pieces: list[Piece], fitted: np.ndarray) -> "Several":
        """The same question about other pieces of the records; the signals are those of systems with a piece."""
        part = Several(self.systems, pieces, fitted)
        part.watch = self.watch
        return part

    def with_parameters(self, parameters: Parameters) -> "Several":
        """The same question where other parameters are free."""
        other = copy.copy(self)
        other.parameters = parameters
        other.systems = {name: question.with_parameters(parameters) for name, question in self.systems.items()}
        other._apart = [
            (part._replace(question=part.question.with_parameters(parameters)), rows) for part, rows in self.apart
        ]
        return other

    def columns(self, record: int) -> slice:
        """Which of the signals a record has."""
        part = next(part for part, _ in self.apart if part.records.start <= record < part.records.stop)
        own = part.question.columns(record - part.records.start)
        return slice(part.signals.start + own.start, part.signals.start + own.stop)

    def called(self, record: int) -> str:
        """The name by which the user reaches a record."""
        name = next(name for name, first in reversed(self.first.items()) if first <= record)
        return f"records[{name!r}][{record - self.first[name]}]"

    def follow(self, u: np.ndarray, starts: np.ndarray) -> Point | Failure:
        """The residuals of one trial, or the first piece whose motion failed, untold."""
        placed, residuals, slopes = starts.copy(), [], []
        across = np.zeros((len(starts), self.states, self.states))
        for part, rows in self.apart:
            states = part.question.states
            point = part.question.follow(u, starts[rows, :states])
            if isinstance(point, Failure):
                return Failure(int(rows[point.piece]), point.text)
            placed[rows, :states] = point.starts
            if point.across is not None:
                across[rows, :states, :states] = point.across
            for left, moved in zip(point.residuals, point.slopes, strict=True):
                wide = np.zeros((*left.shape[:2], len(self.names)))
                wide[..., part.signals] = left
                by_unknowns = np.zeros((*wide.shape, self.states + len(u)))
                by_unknowns[..., part.signals, :states] = moved[..., :states]
                by_unknowns[..., part.signals, self.states :] = moved[..., states:]
                residuals.append(wide)
                slopes.append(by_unknowns)
        return Point(u, placed, residuals, slopes, across if across.any() else None)


def asked(systems: dict[str | None, Question]) -> AbstractQuestion:
    """The question about systems by their names, or about the only one, whose name is None."""
    if None in systems:
        return systems[None]
    return Several({str(name): question for name, question in systems.items()})


class Given(NamedTuple):
    """The arguments for one system, with its name, which is None where it is the only one."""

    name: str | None
    system: Any
    records: Any
    observe: Any


def by_name(system, records, observe) -> list[Given]:
    """The systems one by one. Raises where one argument is a dict by names and another is not, or of other names."""
    if not isinstance(system, dict):
        if isinstance(records, dict):
            raise TypeError("records is a dict, so system must be a dict of systems by the same names.")
        if isinstance(observe, dict):
            raise TypeError("observe is a dict, so system must be a dict of systems by the same names.")
        return [Given(None, system, records, observe)]
    if not system:
        raise ValueError("system is an empty dict: give at least one lagjax.System by its name.")
    for name in system:
        if not isinstance(name, str):
            raise TypeError(f"The systems of a fit have names; {name!r} is no str.")
    _require_names("records", records, system)
    if isinstance(observe, dict):
        _require_names("observe", observe, system)
    return [
        Given(name, one, records[name], observe[name] if isinstance(observe, dict) else observe)
        for name, one in system.items()
    ]


def _require_names(what: str, given, systems: dict) -> None:
    """Raise where an argument is no dict of the names of the systems."""
    names = ", ".join(map(repr, systems))
    if not isinstance(given, dict):
        raise TypeError(
            f"system is a dict, so {what} must be a dict by the same names, {names}; got {type(given).__name__}."
        )
    if lacking := [name for name in systems if name not in given]:
        raise ValueError(f"{what} has nothing for the system {lacking[0]!r}: it needs the names {names}.")
    if beyond := [name for name in given if name not in systems]:
        raise ValueError(f"{what} has {beyond[0]!r}, which is the name of no system: these are {names}.")


@contextlib.contextmanager
def naming(name: str | None) -> Iterator[None]:
    """Begin sentences about what is wrong in this context with the name of the system, where there are several."""
    try:
        yield
    except (TypeError, ValueError) as reason:
        if name is None or type(reason) not in (TypeError, ValueError):
            raise
        raise type(reason)(f"Of the system {name!r}: {reason}") from reason
