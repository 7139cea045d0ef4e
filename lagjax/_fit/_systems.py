"""`Several`: one question about records of several systems that share their parameters.

Each system has a `Question` of its own, with its coordinates, sensors and inputs. A piece of a record depends on its
start and on u alone, whatever its system: once its start is eliminated, only the columns of the parameters are left,
and these are the same for all. So the search stays as it is. Rows of all systems are made alike: a start has room for
the most coordinates, of which a smaller system leaves the last ones without any influence, like those of a start that
is known; and the signals of all systems stand side by side, with no weight where a record does not have them.
"""

import contextlib
import copy
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Piece, Samples
from lagjax._fit._residuals import AbstractQuestion, Failure, Part, Point, Question


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
