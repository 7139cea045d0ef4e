"""A motion as a power series: the functions that make its coefficients, and what is read off them along a step.

    sums            Σ' aⱼ bₖ₋ⱼ for every Cauchy product, at order k
    coefficients    the series of q and q̇ to the order asked for: zeroth order, then one order after the other

`_program._series` derives what they compute. All other parts of a kernel are built on a `Motion`.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir

from lagjax._native._constants import MAX_ORDER
from lagjax._native._frame import Frame, Index, Layout
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value, lanes
from lagjax._native._lanes import emit, sincos_function
from lagjax._program._series import Recurrent, Series, StraightLine


class Motion:
    """A module with the functions `sums` and `coefficients` of a motion, for others to be built on.

    The program gives q̈ and whether the mass matrix is singular; n is the number of coordinates, `states` = 2n. `fields`
    names what else a thread remembers (see `Layout`), `job` the structure that all threads share. With `keep_sums` the
    sums of every order stay in memory, not only those of the last.
    """

    def __init__(self, name: str, program: Recurrent, series: Series, job: type, fields: dict, keep_sums: bool = False):
        self.program, self.series, self.n, self.states = program, series, series.size, 2 * series.size
        self.numbers = program.size - self.states - 1  # parameters
        self.keep_sums, self.job = keep_sums, job
        self.module = ir.Module(name)
        self.module.triple = ""
        self.layout = Layout(lanes(), self._fields() | fields)
        self.width, self.vector = self.layout.width, ir.VectorType(DOUBLE, self.layout.width)
        self.sincos = sincos_function(self.module, self.width)
        self._sums = self._sums_function()
        self.coefficients = self._coefficients_function()

    def _fields(self) -> dict:
        series, products = self.series, len(self.series.cauchy_products)
        return {
            "y": (self.states, MAX_ORDER + 1),  # the series of the state, component by component
            "rows": (series.rows, MAX_ORDER),  # the series that the Cauchy products are made of
            "sums": (MAX_ORDER if self.keep_sums else 1, products),
            "values": series.values,  # what the order recursion reads of the zeroth order
            "params": self.numbers,
            **dict.fromkeys(("t", "h", "singular"), 1),
        }

    def function(self, name: str, *kinds: ir.Type, **options) -> Frame:
        """A new function of the module."""
        return Frame(self.module, self.layout, self.job, name, *kinds, **options)

    # ---- the sums ----

    def sum_indices(self, i: Index, k: Index) -> tuple[Index, Index]:
        """Where in `sums` product i is at order k."""
        return (k if self.keep_sums else 0), i

    def _sums_function(self) -> Code:
        """`(k)`: Σ' aⱼ bₖ₋ⱼ for every product, 0 < j < k."""
        frame = self.function("sums", INTEGER)
        code, (k,) = frame.code, frame.arguments
        mixed = [pair for pair in self.series.cauchy_products if pair[0] != pair[1]]
        squares = [(a,) for a, b in self.series.cauchy_products if a == b]
        kinds = [("mixed", mixed, 0, _mixed_sum), ("squares", squares, len(mixed), _square_sum)]
        tables = {name: self.table(name, pairs) for name, pairs, _, _ in kinds}
        end = code.function.append_basic_block("end")
        switch = code.builder.switch(k.it, end)
        for order in range(2, MAX_ORDER):
            block = code.function.append_basic_block(f"order{order}")
            switch.add_case(ir.Constant(INTEGER, order), block)
            code.builder.position_at_end(block)
            for name, pairs, first, total in kinds:
                if pairs:
                    with code.loop(len(pairs)) as i:
                        rows = [self._row(frame, tables[name], i * len(pairs[0]) + j) for j in range(len(pairs[0]))]
                        frame["sums", *self.sum_indices(i + first, k)] = total(order, self._reader(code), *rows)
            code.builder.branch(end)
        code.builder.position_at_end(end)
        return frame.finish()

    def table(self, name: str, pairs) -> ir.GlobalVariable:
        """The rows of each product, as distances in memory from the first row."""
        flat = [row * MAX_ORDER * self.width for pair in pairs for row in pair]
        kind = ir.ArrayType(INTEGER, max(1, len(flat)))
        table: Any = ir.GlobalVariable(self.module, kind, name)
        table.global_constant, table.linkage = True, "internal"
        table.initializer = ir.Constant(kind, [ir.Constant(INTEGER, x) for x in flat or [0]])
        return table

    def _row(self, frame: Frame, table, index: Value) -> Value:
        code = frame.code
        offset = code.load(code.element(Value(code, table), index, INTEGER), INTEGER)
        return code.element(frame.address("rows"), offset)

    def _reader(self, code: Code) -> Callable[[Value, int], Value]:
        return lambda row, j: code.load(code.element(row, j * self.width), code.vector)

    # ---- the coefficients ----

    def _coefficients_function(self) -> Code:
        """`(order)`: the series of the state, to that order, from its values."""
        frame = self.function("coefficients", INTEGER)
        code, (order,), series, n = frame.code, frame.arguments, self.series, self.n
        *acceleration, singular = (out := emit(code, series.zeroth_order, self.now(frame), self.sincos))[: n + 1]
        frame["singular"] = code.as_double(singular)
        for i in range(n):
            frame["y", i, 1] = frame["y", n + i]
            frame["y", n + i, 1] = acceleration[i]
        for i, value in enumerate(out[n + 1 :]):
            frame["values", i] = value
        for i in range(len(series.cauchy_products)):
            frame["sums", *self.sum_indices(i, integer(code, 1))] = 0.0

        with code.loop(order, start=1) as k:
            with code.only_if(k > 1):
                frame.call(self._sums, k)
            inverse = 1.0 / code.as_double(k + 1)
            out = emit(code, series.order_recursion, self.at_order(frame, k), None)
            for row, value in enumerate(out[n:]):
                frame["rows", row, k] = value
            for i in range(n):
                frame["y", i, k + 1] = frame["y", n + i, k] * inverse
                frame["y", n + i, k + 1] = out[i] * inverse
        return frame.finish()

    def now(self, frame: Frame) -> Callable[[int], Value]:
        """The inputs of the program at the present time: q, q̇, t, parameters."""

        def read(i):
            if i < self.states:
                return frame["y", i]
            return frame["t"] if i == self.states else frame["params", i - self.states - 1]

        return read

    def at_order(self, frame: Frame, k: Value) -> Callable[[int], Value]:
        """The inputs of the order recursion: the coefficients of order k, k, 1/k, the values and the sums."""
        code = frame.code
        time, order, inverse, first = range(self.states, self.states + 4)

        def read(i):
            if i < time:
                return frame["y", i, k]
            if i == time:
                return code.lanes_of(code.select(code.compare("==", k, 1), code.as_double(k), 0.0))
            if i in (order, inverse):
                number = code.as_double(k)
                return code.lanes_of(number if i == order else 1.0 / number)
            i -= first
            if i < self.series.values:
                return frame["values", i]
            return frame["sums", *self.sum_indices(i - self.series.values, k)]

        return read

    # ---- along the step ----

    def increments(self, frame: Frame, order: Value, s: Value) -> tuple[list[Value], list[Value]]:
        """P(s) − y for every component, and P′(s) for the velocities, by Horner's scheme.

        A few components at a time, so that none waits for the other.
        """
        code, increments, slopes = frame.code, [], []
        for first in range(0, self.states, 4):
            some = range(first, min(first + 4, self.states))
            fast = [i for i in some if i >= self.n]
            highest = {i: frame["y", i, order] for i in some}
            value = {i: code.variable(highest[i]) for i in some}
            slope = {i: code.variable(code.as_double(order) * highest[i]) for i in fast}
            with code.loop(order, start=1) as j:
                k = order - j
                weight = code.lanes_of(code.as_double(k))
                for i in some:
                    c = frame["y", i, k]
                    code.store(code.load(value[i], frame.vector) * s + c, value[i])
                    if i in slope:
                        code.store(code.load(slope[i], frame.vector) * s + c * weight, slope[i])
            increments += [code.load(value[i], frame.vector) * s for i in some]
            slopes += [code.load(slope[i], frame.vector) for i in fast]
        return increments, slopes

    def evaluate_now(self, frame: Frame, line: StraightLine) -> list[Value]:
        """The outputs of a program of (q, q̇, t, parameters) at the present state."""
        return emit(frame.code, line, self.now(frame), self.sincos)

    def moved(self, frame: Frame, order: Value, s: Value) -> list[Value]:
        """The state P(s), a time s after the present one."""
        return [frame["y", i] + increment for i, increment in enumerate(self.increments(frame, order, s)[0])]

    def evaluate(self, frame: Frame, line: StraightLine, state: list[Value], s: Value) -> list[Value]:
        """The outputs of a program of (q, q̇, t, parameters) at a state, a time s after the present one."""
        now = self.now(frame)

        def then(i):
            return state[i] if i < self.states else now(i) + s if i == self.states else now(i)

        return emit(frame.code, line, then, self.sincos)

    # ---- rounds ----

    @contextmanager
    def rounds(self, frame: Frame, count: Value) -> Iterator[None]:
        """A context: its body is one round, of `count` at most, as long as a lane is active."""
        code, left = frame.code, frame.code.variable(count)
        with code.repeat_while(lambda: self._any_active(frame) & (code.load(left, INTEGER) > 0)):
            code.store(code.load(left, INTEGER) - 1, left)
            yield

    def more(self, frame: Frame) -> Value:
        """1 if a lane is active, else 0."""
        return frame.code.select(self._any_active(frame), integer(frame.code, 1), 0)

    def _any_active(self, frame: Frame) -> Value:
        return frame.code.any_lane(frame["active"] > 0.0)


def integer(code: Code, x: int) -> Value:
    """An integer as a value."""
    return code.as_value(x, INTEGER)


def double(code: Code, x: float) -> Value:
    """A double as a value."""
    return code.as_value(x, DOUBLE)


def _mixed_sum(order: int, at, a, b) -> Value:
    """Σ aⱼ bₖ₋ⱼ, in two strands that do not wait for each other."""
    strands = [at(a, j) * at(b, order - j) for j in range(1, min(3, order))]
    for j in range(3, order):
        strands[j % 2 == 0] = at(a, j) * at(b, order - j) + strands[j % 2 == 0]
    return strands[0] if len(strands) == 1 else strands[0] + strands[1]


def _square_sum(order: int, at, a) -> Value:
    """Σ aⱼ aₖ₋ⱼ: every product but the middle one comes twice."""
    pairs = [at(a, j) * at(a, order - j) for j in range(1, (order + 1) // 2)]
    middle = [] if order % 2 else [at(a, order // 2) * at(a, order // 2)]
    if not pairs:
        return middle[0]
    half = functools.reduce(Value.__add__, pairs)
    return functools.reduce(Value.__add__, middle, half + half)
