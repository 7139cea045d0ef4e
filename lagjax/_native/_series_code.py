"""What all functions of a kernel share: the memory of a thread, and the power series of the state in it."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

from llvmlite import ir

from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value, lanes
from lagjax._native._lanes import emit, sincos_function
from lagjax._program import Program, Series

MAX_ORDER = 20
# Integers of a lane: which member it carries (-1: none), which output comes next, and which step.
LANE = ("member", "output", "step")
KINDS = {ctypes.c_void_p: POINTER, ctypes.c_int64: INTEGER, ctypes.c_double: DOUBLE}


class SeriesCode:
    """A module with the functions `sums` and `coefficients` of a motion, for others to be built on.

    `sizes` names what else a thread remembers, in vectors; `job` is the structure that all threads share. With
    `keep_sums` the sums of every order stay in memory, not only those of the last.
    """

    def __init__(self, name: str, program: Program, series: Series, job, sizes: dict[str, int], keep_sums=False):
        self.program, self.series, self.n, self.job = program, series, series.size, job
        self.states, self.width, self.keep_sums = 2 * series.size, lanes(), keep_sums
        self.module = ir.Module(name)
        self.module.triple = ""
        self.vector = ir.VectorType(DOUBLE, self.width)
        self.numbers = program.size - self.states - 1  # parameters
        self._lay_out(sizes)
        self.sincos = sincos_function(self.module, self.width)
        self.sums = self._sums()
        self.coefficients = self._coefficients()

    # ---- the memory of a thread: vectors, one element for each lane ----

    def _lay_out(self, sizes: dict[str, int]) -> None:
        series, self.offsets, total = self.series, {}, 0
        shared = {
            "y": self.states * (MAX_ORDER + 1),  # the series of the state, component by component
            "rows": series.rows * MAX_ORDER,
            "sums": len(series.products) * (MAX_ORDER if self.keep_sums else 1),
            "values": series.values,
            "params": self.numbers,
            **dict.fromkeys(("t", "h", "singular"), 1),
        }
        for name, size in (shared | sizes).items():
            self.offsets[name], total = total, total + size
        self.memory = total * self.width  # in doubles

    def place(self, code: Code, memory: Value, name: str, index=0, lane=None) -> Value:
        """The address of a vector, or of one lane of it."""
        offset = (index + self.offsets[name]) * self.width
        return code.element(memory, offset if lane is None else lane + offset)

    def state(self, code: Code, memory: Value, i: int, order=0, lane=None) -> Value:
        """The address of the coefficient of a component of the state."""
        return self.place(code, memory, "y", order + i * (MAX_ORDER + 1), lane)

    def sum_place(self, code: Code, memory: Value, i, k: Value) -> Value:
        """The address of the sum of product i at order k."""
        return self.place(code, memory, "sums", k * len(self.series.products) + i if self.keep_sums else i)

    # ---- the coefficients ----

    def _sums(self) -> Code:
        """`(memory, k)`: Σ' aⱼ bₖ₋ⱼ for every product, 0 < j < k."""
        code = Code(self.module, "sums", [POINTER, INTEGER], self.width)
        memory, k = code.arguments
        mixed = [pair for pair in self.series.products if pair[0] != pair[1]]
        squares = [(a,) for a, b in self.series.products if a == b]
        tables = [self._table(name, pairs) for name, pairs in (("mixed", mixed), ("squares", squares))]
        end = code.function.append_basic_block("end")
        switch = code.builder.switch(k.it, end)
        for order in range(2, MAX_ORDER):
            block = code.function.append_basic_block(f"order{order}")
            switch.add_case(ir.Constant(INTEGER, order), block)
            code.builder.position_at_end(block)
            for table, pairs, first, total in zip(
                tables, (mixed, squares), (0, len(mixed)), (_mixed_sum, _square_sum), strict=True
            ):
                if pairs:
                    with code.loop(len(pairs)) as i:
                        rows = [self._row(code, memory, table, i * len(pairs[0]) + k) for k in range(len(pairs[0]))]
                        at = self._reader(code)
                        code.store(total(order, at, *rows), self.sum_place(code, memory, i + first, k))
            code.builder.branch(end)
        code.builder.position_at_end(end)
        return code.finish()

    def _table(self, name: str, pairs) -> ir.GlobalVariable:
        flat = [row * MAX_ORDER * self.width for pair in pairs for row in pair]
        kind = ir.ArrayType(INTEGER, max(1, len(flat)))
        table = ir.GlobalVariable(self.module, kind, name)
        table.global_constant, table.linkage = True, "internal"
        table.initializer = ir.Constant(kind, [ir.Constant(INTEGER, x) for x in flat or [0]])
        return table

    def _row(self, code, memory, table, index) -> Value:
        offset = code.load(code.element(Value(code, table), index, INTEGER), INTEGER)
        return code.element(self.place(code, memory, "rows"), offset)

    def _reader(self, code):
        return lambda row, j: code.load(code.element(row, j * self.width), self.vector)

    def _coefficients(self) -> Code:
        """`(memory, order)`: the series of the state, to that order, from its values."""
        code = Code(self.module, "coefficients", [POINTER, INTEGER], self.width)
        memory, order = code.arguments
        series, n = self.series, self.n
        *acceleration, singular = (out := emit(code, series.start, self.now(code, memory), self.sincos))[: n + 1]
        code.store(code.as_double(singular), self.place(code, memory, "singular"))
        for i in range(n):
            code.store(code.load(self.state(code, memory, n + i), self.vector), self.state(code, memory, i, 1))
            code.store(acceleration[i], self.state(code, memory, n + i, 1))
        for i, value in enumerate(out[n + 1 :]):
            code.store(value, self.place(code, memory, "values", i))
        for i in range(len(series.products)):
            code.store(code.lanes_of(0.0), self.sum_place(code, memory, i, integer(code, 1)))

        with code.loop(order, start=1) as k:
            with code.only_if(k > 1):
                code.call(self.sums, memory, k)
            inverse = 1.0 / code.as_double(k + 1)
            out = emit(code, series.sweep, self.at_order(code, memory, k), None)
            for row, value in enumerate(out[n:]):
                code.store(value, self.place(code, memory, "rows", k + row * MAX_ORDER))
            for i in range(n):
                velocity = code.load(self.state(code, memory, n + i, k), self.vector)
                code.store(velocity * inverse, self.state(code, memory, i, k + 1))
                code.store(out[i] * inverse, self.state(code, memory, n + i, k + 1))
        return code.finish()

    def now(self, code, memory):
        """The inputs of the program: q, q̇, t, parameters."""

        def read(i):
            if i < self.states:
                return code.load(self.state(code, memory, i), self.vector)
            name, i = ("t", 0) if i == self.states else ("params", i - self.states - 1)
            return code.load(self.place(code, memory, name, i), self.vector)

        return read

    def at_order(self, code, memory, k):
        """The inputs of the sweep."""
        time, order, inverse, given = range(self.states, self.states + 4)

        def read(i):
            if i < time:
                return code.load(self.state(code, memory, i, k), self.vector)
            if i == time:
                return code.lanes_of(code.select(code.compare("==", k, 1), code.as_double(k), 0.0))
            if i in (order, inverse):
                number = code.as_double(k)
                return code.lanes_of(number if i == order else 1.0 / number)
            i -= given
            if i < self.series.values:
                return code.load(self.place(code, memory, "values", i), self.vector)
            return code.load(self.sum_place(code, memory, i - self.series.values, k), self.vector)

        return read

    # ---- along the step ----

    def increments(self, code, memory, order, s) -> tuple[list[Value], list[Value]]:
        """P(s) − y for every component, and P′(s) for the velocities, by Horner's scheme.

        A few components at a time, so that none waits for the other.
        """
        increments, slopes = [], []
        for first in range(0, self.states, 4):
            some = range(first, min(first + 4, self.states))
            fast = [i for i in some if i >= self.n]
            highest = {i: code.load(self.state(code, memory, i, order), self.vector) for i in some}
            value = {i: code.variable(highest[i]) for i in some}
            slope = {i: code.variable(code.as_double(order) * highest[i]) for i in fast}
            with code.loop(order, start=1) as j:
                k = order - j
                weight = code.lanes_of(code.as_double(k))
                for i in some:
                    c = code.load(self.state(code, memory, i, k), self.vector)
                    code.store(code.load(value[i], self.vector) * s + c, value[i])
                    if i in slope:
                        code.store(code.load(slope[i], self.vector) * s + c * weight, slope[i])
            increments += [code.load(value[i], self.vector) * s for i in some]
            slopes += [code.load(slope[i], self.vector) for i in fast]
        return increments, slopes

    # ---- rounds ----

    @contextmanager
    def rounds(self, code, memory, count: Value) -> Iterator[None]:
        """A context: its body is one round, of `count` at most, as long as a lane is active."""
        left = code.variable(count)
        with code.repeat_while(lambda: self._any_active(code, memory) & (code.load(left, INTEGER) > 0)):
            code.store(code.load(left, INTEGER) - 1, left)
            yield

    def more(self, code, memory) -> Value:
        """1 if a lane is active, else 0."""
        return code.select(self._any_active(code, memory), integer(code, 1), 0)

    def _any_active(self, code, memory) -> Value:
        return code.any_lane(self._vector(code, memory, "active") > 0.0)

    # ---- access to the memory, the job and the lanes ----

    def _vector(self, code, memory, name: str, index=0) -> Value:
        return code.load(self.place(code, memory, name, index), self.vector)

    def _keep(self, code, memory, name: str, value: Value, index=0) -> None:
        code.store(value, self.place(code, memory, name, index))

    def _get(self, code, memory, name: str, lane) -> Value:
        return code.load(self.place(code, memory, name, 0, lane), DOUBLE)

    def _set(self, code, memory, name: str, lane, value) -> None:
        code.store(code.as_value(value, DOUBLE), self.place(code, memory, name, 0, lane))

    def _job(self, code, job, name: str) -> Value:
        fields = dict(self.job._fields_)
        position, kind = list(fields).index(name), KINDS[fields[name]]
        return code.load(code.element(job, position, INTEGER), kind)

    def _read(self, code, job, name: str, index) -> Value:
        return code.load(code.element(self._job(code, job, name), index), DOUBLE)

    def _time(self, code, job, member, index) -> Value:
        return self._read(code, job, "ts", member * self._job(code, job, "ts_stride") + index)

    def _output(self, code, job, member, time_index, i: int) -> Value:
        row = member * self._job(code, job, "times") + time_index
        return code.element(self._job(code, job, "path"), row * self.states + i)

    def _lane(self, code, lane_data, name: str, lane) -> Value:
        return code.element(lane_data, lane + LANE.index(name) * self.width, INTEGER)


def integer(code, x: int) -> Value:
    return code.as_value(x, INTEGER)


def double(code, x: float) -> Value:
    return code.as_value(x, DOUBLE)


def _mixed_sum(order: int, at, a, b) -> Value:
    """Σ aⱼ bₖ₋ⱼ, in two strands that do not wait for each other."""
    strands = [at(a, j) * at(b, order - j) for j in range(1, min(3, order))]
    for j in range(3, order):
        strands[j % 2 == 0] = at(a, j) * at(b, order - j) + strands[j % 2 == 0]
    return strands[0] if len(strands) == 1 else strands[0] + strands[1]


def _square_sum(order: int, at, a) -> Value:
    """Σ aⱼ aₖ₋ⱼ: every product but the middle one comes twice."""
    half = None
    for j in range(1, (order + 1) // 2):
        term = at(a, j) * at(a, order - j)
        half = term if half is None else half + term
    if order % 2:
        return half + half
    middle = at(a, order // 2) * at(a, order // 2)
    return middle if half is None else half + half + middle
