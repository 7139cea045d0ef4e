"""The order in which a large program runs for one member alone: alike operations side by side, in the lanes of vectors.

    stages      operations of one kind that wait for equally many others, and so not for each other
    order       of the operations of a stage, such that what they read lies side by side too, as far as that goes
    runs        consecutive operations whose operands lie side by side, or are one number for all, or lie anywhere
    places      of all results: those of a stage side by side, in its order

Nothing here knows LLVM.
"""

import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lagjax._native._constants import LEAST_FILLED, LEAST_RUN, LONG_RUN, OFTEN_PACKED
from lagjax._native._schedule import ScheduledOperation, join_operations
from lagjax._program._line import StraightLine, group_by_level

# How an operand of a run lies in memory: consecutive numbers, one number, or anywhere.
SIDE_BY_SIDE, ONE, ANYWHERE = range(3)


class Stage(NamedTuple):
    """Alike operations, none of which waits for another.

    `kind` is their number, `operands` (m, N) the nodes that they read, `results` (r, N) those that they make (-1:
    it is not read). The results are needed until stage `last`.
    """

    kind: int
    operands: np.ndarray
    results: np.ndarray
    last: int


class Run(NamedTuple):
    """`count` operations of one kind: `modes` has for every operand how it lies, and `operands` where.

    That is one place, or (N,) places where it lies anywhere. `results` are the places of the first results.
    """

    kind: int
    modes: tuple[int, ...]
    count: int
    operands: tuple
    results: tuple[int, ...]


def stages(operations: Sequence[ScheduledOperation], nodes: int, kept: Sequence[int]) -> list[Stage]:
    """The stages of a program of this many nodes, in an order in which they can run; nodes that are `kept` live on."""
    groups = group_by_level(operations, nodes)
    ordered = [[operations[k] for k in groups[key]] for key in sorted(groups)]
    last = np.full(nodes + 1, -1)
    arrays = []
    for s, group in enumerate(ordered):
        operands = np.array([operation.operands for operation in group], np.int64).T
        results = np.array([operation.results for operation in group], np.int64).T
        last[operands.ravel()] = s
        arrays.append((group[0].kind, operands, results))
    last[list(kept)] = len(ordered)
    last[-1] = -1  # an unused result
    return [Stage(kind, operands, results, int(last[results].max())) for kind, operands, results in arrays]


@functools.lru_cache(maxsize=16)  # used where the form of a motion is chosen, and where it is compiled
def fills(line: StraightLine, width: int) -> bool:
    """True if most lanes of this many have something to do where alike operations of a program stand in them."""
    groups = group_by_level(join_operations(line)[1], len(line.nodes))
    counts = np.array([len(group) for group in groups.values()])
    return bool(counts.sum() >= LEAST_FILLED * width * (-(-counts // width)).sum())


class Arranged(NamedTuple):
    """The runs of a program, where every node lies, and how many places it needs from the first one on."""

    runs: list[Run]
    places: np.ndarray
    size: int


def arrangement(program: list[Stage], places: np.ndarray, first: int, width: int) -> Arranged:
    """The program in runs of vectors of this many lanes.

    `places` has where the inputs and the numbers lie; results get places from `first` on. Behind the results of a stage
    `width` numbers are free, for a vector that is not full is written as a whole.
    """
    places, runs, room = places.copy(), [], _Room(first)
    ends: dict[int, list[tuple[int, int]]] = {}
    for s, stage in enumerate(program):
        at = places[stage.operands]
        order = order_by_adjacency(at)
        at, results = at[:, order], stage.results[:, order]
        count = results.shape[1]
        size = -(-(count + width - 1) // width) * width
        begins = []
        for row in results:
            begin = room.take(size)
            begins.append(begin)
            if row.min() >= 0:
                places[row] = begin + np.arange(count)
            else:
                there = np.flatnonzero(row >= 0)
                places[row[there]] = begin + there
            ends.setdefault(max(stage.last, s), []).append((begin, size))
        runs += vector_runs(stage.kind, at, np.array(begins))
        for begin, size in ends.pop(s, ()):
            room.give_back(begin, size)
    return Arranged(runs, places, room.end - first)


class _Room:
    """Free stretches of memory, each with its size."""

    def __init__(self, first: int):
        self.end, self._free = first, []

    def take(self, size: int) -> int:
        """The first of this many places: the smallest stretch that is long enough."""
        fitting = [k for k, (length, _) in enumerate(self._free) if length >= size]
        if not fitting:
            begin, self.end = self.end, self.end + size
            return begin
        best = min(fitting, key=self._free.__getitem__)
        length, begin = self._free[best]
        if length == size:
            del self._free[best]
        else:
            self._free[best] = length - size, begin + size
        return begin

    def give_back(self, begin: int, size: int) -> None:
        """A stretch that is free again, joined to its neighbours."""
        for k, (length, start) in enumerate(self._free):
            if start + length == begin:
                del self._free[k]
                return self.give_back(start, size + length)
            if begin + size == start:
                del self._free[k]
                return self.give_back(begin, size + length)
        self._free.append((size, begin))
        return None


def order_by_adjacency(at: np.ndarray) -> np.ndarray:
    """An order of N operations whose operands lie at `at` (m, N): most of these lie next to those before."""
    operands, count = at.shape
    if count <= 2 or not operands:
        return np.arange(count)
    best, most = np.arange(count), -1
    for first in range(operands):
        keys = [at[(first + k) % operands] for k in range(operands)]
        order = np.lexsort(keys[::-1])
        steps = np.diff(at[:, order])
        alike = int(((steps == 0) | (steps == 1)).all(axis=0).sum()) * 16 + int(((steps == 0) | (steps == 1)).sum())
        if alike > most:
            best, most = order, alike
    return best


def product_runs(at: np.ndarray, kind: int) -> Iterator[tuple[Run, np.ndarray]]:
    """N products of rows `at` (2, N), or squares (1, N), in runs as long as they come, and the products of each."""
    left, searching = np.arange(at.shape[1]), True
    while left.size:
        orders = _order_runs(at[:, left], kind)
        some = min(orders, key=lambda some: sum(run.count for run, _ in some if not _is_long(run)))
        later = [left[members] for run, members in some if searching and not _is_long(run)]
        yield from ((run, left[members]) for run, members in some if not searching or _is_long(run))
        after = np.concatenate(later) if later else left[:0]
        left, searching = after, after.size <= 0.9 * left.size


def _is_long(run: Run) -> bool:
    return ANYWHERE not in run.modes and run.count >= LONG_RUN


def _order_runs(at: np.ndarray, kind: int) -> Iterator[list[tuple[Run, np.ndarray]]]:
    """The runs of products in several orders: by one row and then the other, and by their distance."""
    for keys in [at[::-1], at, np.array([at[0], at[1] - at[0]])] if len(at) == 2 else [at]:
        order = np.lexsort(keys)
        some = vector_runs(kind, at[:, order], np.zeros(1, int))
        ends = np.cumsum([run.count for run in some])
        yield [(run, order[end - run.count : end]) for run, end in zip(some, ends, strict=True)]


def vector_runs(kind: int, at: np.ndarray, results: np.ndarray) -> list[Run]:
    """The runs of operations in this order, whose operands lie at `at` (m, N), with the places of the first results."""
    count = at.shape[1]
    if not count:
        return []
    if count == 1:
        return [Run(kind, (ONE,) * len(at), 1, tuple(at[:, 0].tolist()), tuple(results.tolist()))]
    runs = []
    for begin, end in _stretches(at):
        part = at[:, begin:end]
        steps = np.diff(part)
        modes = tuple(
            ONE if not row.any() else SIDE_BY_SIDE if (row == 1).all() else ANYWHERE for row in steps
        )  # fmt: skip
        operands = tuple(
            row if mode == ANYWHERE else int(row[0]) for row, mode in zip(part, modes, strict=True)
        )  # fmt: skip
        runs.append(Run(kind, modes, end - begin, operands, tuple((results + begin).tolist())))
    return runs


def _stretches(at: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last place of each run.

    Long ones in which every operand lies side by side or is one number; of the rest those that end where more operands
    than usual jump, as at the end of a row of a matrix; and what is left between.
    """
    steps = np.diff(at)
    sound = (steps == 0) | (steps == 1)
    all_sound = sound.all(axis=0)
    changes = np.flatnonzero((steps[:, 1:] != steps[:, :-1]).any(axis=0) | ~all_sound[1:] | ~all_sound[:-1]) + 1
    edges = [0, *changes.tolist(), at.shape[1] - 1]  # of the steps
    stretches, done = [], 0
    for a, b in itertools.pairwise(edges):
        begin, end = max(a, done), b + 1
        if all_sound[a] and end - begin >= LEAST_RUN:
            stretches += _pieces(sound, done, begin)
            stretches.append((begin, end))
            done = end
    return stretches + _pieces(sound, done, at.shape[1])


def _pieces(sound: np.ndarray, begin: int, end: int) -> list[tuple[int, int]]:
    """Runs of the operations from `begin` to `end`; `sound` (m, N − 1): an operand lies next to the one before it."""
    if end - begin < 2 * LEAST_RUN:
        return [(begin, end)] if end > begin else []
    jumps = (~sound[:, begin : end - 1]).sum(axis=0)
    breaks = begin + 1 + np.flatnonzero(jumps > np.partition(jumps, len(jumps) // 4)[len(jumps) // 4])
    pieces, done = [], begin
    for a, b in itertools.pairwise([begin, *breaks.tolist(), end]):
        if b - a >= LEAST_RUN:
            if a > done:
                pieces.append((done, a))
            pieces.append((a, b))
            done = b
    return [*pieces, (done, end)] if done < end else pieces


def limit_modes(runs: list[Run], width: int) -> list[Run]:
    """The runs, rare combinations of modes given up: what lies side by side, or is one number, also lies anywhere."""
    counts: dict[tuple, int] = {}
    for run in runs:
        key = run.kind, run.modes
        counts[key] = counts.get(key, 0) - (-run.count // width)
    return [run if counts[run.kind, run.modes] >= OFTEN_PACKED else _scatter_run(run) for run in runs]


def _scatter_run(run: Run) -> Run:
    lanes = np.arange(run.count)
    operands = tuple(
        x if mode == ANYWHERE else x + lanes if mode == SIDE_BY_SIDE else np.full(run.count, x)
        for x, mode in zip(run.operands, run.modes, strict=True)
    )
    return run._replace(modes=(ANYWHERE,) * len(run.modes), operands=operands)
