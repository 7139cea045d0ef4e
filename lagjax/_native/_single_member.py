"""The series of a large motion of one member alone: alike operations, and Cauchy products, in the lanes of vectors.

Coefficients of one order lie side by side, row after row, so that products of neighbouring rows are products of
vectors. Which rows, values and sums are neighbours is decided here, by where the operations that make them stand.

Measured against the same tables without lanes, with equal bits: 10, 20 and 40 bodies take 1.3, 2.0 and 2.5 times less,
rows of 100 and 300 masses 1.2 and 1.7 times. Chains of pendulums do not fill lanes.
"""

import functools

import numpy as np
from llvmlite import ir

from lagjax._native._constants import MAX_ORDER
from lagjax._native._frame import CACHE_LINE, Fields, Frame, Index, Memory, Vectors, integers
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value, lanes
from lagjax._native._lanes import sincos_function
from lagjax._native._packed import Packed
from lagjax._native._packs import ANYWHERE, SIDE_BY_SIDE, Run, fills, limit_modes, product_runs
from lagjax._native._tables import WORD, word
from lagjax._native._taylor import TaylorSeries, mixed_sum, square_sum
from lagjax._program._series import Series


def fills_lanes(series: Series) -> bool:
    """True if a motion has enough alike operations for the lanes of one member."""
    return fills(series.order_recursion, lanes())


class SingleMember(TaylorSeries):
    """A `TaylorSeries` of width one, as tables of vectors."""

    def _fields(self) -> Fields:
        rows = -(-(self.series.rows + lanes()) // CACHE_LINE)
        # An odd number of cache lines from one order to the next: else they would meet in a few sets of the cache.
        self._stride = (rows + 1 - rows % 2) * CACHE_LINE
        # Behind each field there is room for a vector.
        return super()._fields() | {
            "rows": (MAX_ORDER + 1, self._stride),
            "values": self.series.values + lanes(),
            "order": self.states
            + 3
            + lanes(),  # the coefficients of the order at hand; whether it is the first, k, 1/k
            "sums": 0,  # behind all others, when it is known in which runs the products come
        }

    form: Packed

    def _form(self) -> Packed:
        return Packed(self.function, self._wide, sincos_function(self.module, lanes()), lanes())

    def _wide(self, name: str, *kinds: ir.Type) -> Frame:
        return Frame(self.module, Memory(lanes(), {}), self.job, name, *kinds)

    # ---- what lies where ----

    @functools.cached_property
    def _value_ranks(self) -> np.ndarray:
        """The place of every value of the zeroth order among them."""
        inputs = [self.layout.place(*at) for at in self._state_places()]
        return self.form.ranks(self.series.zeroth_order, inputs, self.series.values)

    def _state_places(self) -> list[tuple]:
        return [*(("y", i, 0) for i in range(self.states)), ("t",), *(("params", i) for i in range(self.numbers))]

    @functools.cached_property
    def _row_ranks(self) -> np.ndarray:
        """The place of every row among them: as if the sums lay in the order of their products, somewhere else."""
        sums = self.layout.end + np.arange(len(self.series.cauchy_products))
        return self.form.ranks(self.series.order_recursion, self._order_inputs(sums), self.series.rows, keep=False)

    def _order_inputs(self, sums: np.ndarray) -> list[int]:
        order, values = self.layout.place("order", 0), self.layout.place("values", 0)
        inputs = [order + i for i in range(self.states + 3)] + (values + self._value_ranks).tolist()
        return inputs + sums.tolist()

    @functools.cached_property
    def _products(self) -> tuple[list[Run], np.ndarray]:
        """The products in runs, and where each of their sums lies. Kind 0 is that of two rows, 1 that of squares."""
        pairs = self._row_ranks[np.array(self.series.cauchy_products, int).reshape(-1, 2)]
        squares = pairs[:, 0] == pairs[:, 1]
        runs, sums, first = [], np.zeros(len(pairs), int), -(-self.layout.end // CACHE_LINE) * CACHE_LINE
        end = first
        for kind, which in enumerate((np.flatnonzero(~squares), np.flatnonzero(squares))):
            if which.size:
                at = pairs[which].T[: 2 - kind]
                for run, members in product_runs(at, kind):
                    # Vectors are written as a whole, in any order.
                    sums[which[members]] = end + np.arange(run.count)
                    runs.append(run._replace(results=(end,)))
                    end += -(-run.count // lanes()) * lanes()
        self.layout.extend_by({"sums": end - self.layout.end})
        return runs, sums

    # ---- the sums ----

    @property
    def places_of_sums(self) -> int:
        last = max((run.results[0] + -(-run.count // lanes()) * lanes() for run in self._products[0]), default=0)
        return max(0, last - self.layout.place("sums", 0))

    def sum_indices(self, i: Index, k: Index) -> tuple[Index, ...]:
        """The place in `sums` of the sum with this number, in the order of their places."""
        return (i,)

    def _sums_function(self) -> Code:
        """`(k)`: Σ' aⱼ bₖ₋ⱼ for every product, 0 < j < k."""
        frame = self._wide("sums", INTEGER)
        code, (k,) = frame.code, frame.arguments
        tables = {key: self._table(runs) for key, runs in self._runs_by_modes().items()}
        for order in code.cases(k, range(2, MAX_ORDER)):
            for (kind, modes), (table, vectors, size) in tables.items():
                with code.loop(vectors) as i:
                    self._write_sum(frame, order, kind, modes, code.element(Value(code, table), i * size, WORD))
        return frame.finish()

    def _runs_by_modes(self) -> dict[tuple, list[Run]]:
        by_modes: dict[tuple, list[Run]] = {}
        for run in limit_modes(self._products[0], lanes()):
            by_modes.setdefault((run.kind, run.modes), []).append(run)
        return by_modes

    def _table(self, runs: list[Run]) -> tuple[ir.GlobalVariable, int, int]:
        """The places of the sums, and then of the rows, of each vector; the number of vectors, and of words of one."""
        rows, words = self.layout.place("rows", 0, 0), []
        for run in runs:
            for first in range(0, run.count, lanes()):
                words.append(run.results[0] + first)
                for mode, x in zip(run.modes, run.operands, strict=True):
                    if mode == ANYWHERE:
                        some = x[first : first + lanes()]
                        words += (rows + np.pad(some, (0, lanes() - len(some)), mode="edge")).tolist()
                    else:
                        words.append(rows + x + (first if mode == SIDE_BY_SIDE else 0))
        vectors = sum(-(-run.count // lanes()) for run in runs)
        return integers(self.module, np.array(words, np.int32)), vectors, len(words) // vectors

    def _write_sum(self, frame: Frame, order: int, kind: int, modes: tuple[int, ...], words: Value) -> None:
        code, at, rows = frame.code, 1, []
        start = frame.memory_at(code.as_value(0, INTEGER))
        for mode in modes:
            if mode == ANYWHERE:
                rows.append((mode, code.offsets(code.element(words, at, WORD))))
            else:
                rows.append((mode, frame.memory_at(word(code, words, at))))
            at += lanes() if mode == ANYWHERE else 1

        def read(row: tuple[int, Value], j: int) -> Value:
            mode, place = row
            if mode == ANYWHERE:
                return code.gather(code.element(start, j * self._stride), place)
            address = code.element(place, j * self._stride)
            return code.load_packed(address) if mode == SIDE_BY_SIDE else code.lanes_of(code.load(address, DOUBLE))

        total = square_sum(order, read, *rows) if kind else mixed_sum(order, read, *rows)
        code.store_packed(total, frame.memory_at(word(code, words, 0)))

    # ---- the coefficients ----

    def values(self, frame: Frame) -> Vectors:
        ranks = self._value_ranks.tolist()
        return frame.vectors("values", self.series.values, lambda i: (ranks[i],))

    def sums(self, frame: Frame) -> Vectors:
        places = (self._products[1] - self.layout.place("sums", 0)).tolist()
        return frame.vectors("sums", len(places), lambda i: (places[i],))

    def rows_at(self, frame: Frame, k: Value) -> Vectors:
        ranks, first = self._row_ranks.tolist(), self.layout.place("rows", 0, 0)
        column = frame.vectors_at("rows", self.series.rows, k, by_row=True)
        return Vectors(len(ranks), column.read, column.write, lambda i: first + ranks[i], column.shift)

    def followed_value(self, frame: Frame, j: Value) -> Value:
        first = self.layout.place("values", 0)
        return self._load_followed(frame, first + self._value_ranks, j)

    def followed_coefficient(self, frame: Frame, j: Value, k: Index) -> Value:
        first = self.layout.place("rows", 0, 0)
        return self._load_followed(frame, first + self._row_ranks, j, k * self._stride)

    def _load_followed(self, frame: Frame, places: np.ndarray, j: Value, more: Index = 0) -> Value:
        """A vector `more` doubles behind the j-th of the last of these places, one for each number that is followed."""
        code = frame.code
        table = integers(self.module, places[len(places) - self.series.followed :].astype(np.int64))
        place = code.load(code.element(Value(code, table), j, INTEGER), INTEGER)
        return code.load(frame.memory_at(place + more), frame.vector)

    def recursion_inputs(self, frame: Frame, k: Value) -> list:
        """The inputs of the order recursion: the coefficients of order k, k, 1/k, the values and the sums."""
        coefficients, scalars, values, sums = super().recursion_inputs(frame, k)
        for i in self.form.each(frame.code, self.states):
            frame["order", i] = coefficients[i]
        for i, x in enumerate(scalars):
            frame["order", self.states + i] = x
        return [frame.vectors("order", self.states + 3), values, sums]
