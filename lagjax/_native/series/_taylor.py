"""`TaylorSeries`: the kernel functions that compute the Taylor coefficients of a motion, and values of the series.

    sums            Σ' aⱼ bₖ₋ⱼ for every Cauchy product, at order k
    coefficients    the series of q and q̇ to an order: the zeroth, then one after the other

The formulas are derived in `_program._series`. All other parts of a kernel use a `TaylorSeries`.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from llvmlite import ir

from lagjax._native.code._constants import LARGEST_LINE, LEAST_ORDER, MAX_ORDER, OPERATIONS_PER_COORDINATE
from lagjax._native.code._frame import Fields, Frame, Index, Lane, Memory, Numbers, Vectors, integer_constant
from lagjax._native.code._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native.series._lanes import Lines, sincos_function
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._table_reads import LookUps
from lagjax._native.series._tables import Tables
from lagjax._program import Recurrent, Series, StraightLine

AT_BORDER = "crossed", "crossed_number", "grazes"  # what is recorded of the border that a step ends at, and its pieces


def size_of_series(series: Series) -> int:
    """The number of doubles in the series of one member: of its state and of the rows of Cauchy products."""
    return 2 * series.size * (MAX_ORDER + 1) + series.rows * MAX_ORDER


class TaylorSeries:
    """An LLVM module with the functions `sums` and `coefficients` of a motion, the base of all kernels.

    The program gives q̈ and whether the mass matrix is singular; n is the number of coordinates, `states` = 2n.
    `fields` are further fields of a thread's memory (see `Memory`), `job` the structure of shared arguments. `large`
    kernels are tables (see `is_large`). Vectors have `width` lanes. The last parameters of the program are its
    `pieces`, the rest the `chosen` ones of a member, or all. `kept` outputs after the first ones are stored. With
    `keep_sums` the sums of every order stay in memory, not only those of the last.
    """

    def __init__(
        self, name: str, parts: MotionParts, job: type, fields: Fields, large: bool, width: int, keep_sums=False, kept=0
    ):
        program, series, pieces, chosen = parts.program, parts.series, parts.pieces, parts.chosen
        self.program, self.series, self.n, self.states = program, series, series.size, 2 * series.size
        self.numbers = program.size - self.states - 1  # parameters, and the pieces of a piecewise program
        self.pieces, self.parameters, self.kept = pieces, self.numbers - pieces, kept
        self.recorded_pieces = pieces and pieces + len(AT_BORDER)  # numbers that are recorded behind a step's state
        self.keep_sums, self.job = keep_sums, job
        self.module = ir.Module(name)
        self.module.triple = ""
        self.look_up = LookUps(self.module)
        self.member_stride = self.parameters if chosen is None else chosen.of
        self._chosen = None if chosen is None else integer_constant(self.module, np.array(chosen.positions, np.int64))
        self.layout = Memory(width, self._fields() | fields)
        self.width, self.vector = self.layout.width, ir.VectorType(DOUBLE, self.layout.width)
        self.large = large
        sincos = sincos_function(self.module, self.width)
        self.form = Tables(self.function, sincos, self.look_up) if large else Lines(sincos, self.look_up)
        # The program whose first outputs are q̈. As a table the zeroth order is there already, and little longer.
        line = program.line
        self.acceleration = series.zeroth_order if large else line.replace(outputs=line.outputs[: self.n])
        self._sums = self._sums_function()
        self.coefficients = self._coefficients_function()

    def _fields(self) -> Fields:
        series, products = self.series, len(self.series.cauchy_products)
        return {
            "y": (self.states, MAX_ORDER + 1),  # the series of the state, component by component
            "rows": (series.rows, MAX_ORDER),  # the series that the Cauchy products are made of
            "sums": (MAX_ORDER if self.keep_sums else 1, products),  # the Cauchy products of an order
            "values": series.values,  # what the order recursion reads of the zeroth order
            "params": self.numbers,  # parameters, and pieces
            "kept": self.kept,  # outputs of the program that others read
            "t": 1,  # the time
            "h": 1,  # the step
            "singular": 1,  # 1 if the mass matrix is
            "first_number": 1,  # where the numbers of a member begin: its parameters, and what tables are of
        }

    def function(self, name: str, *kinds: ir.Type, **options) -> Frame:
        return Frame(self.module, self.layout, self.job, name, *kinds, **options)

    def finish(self) -> None:
        """Complete the module after its last program."""
        self.form.finish()
        self.look_up.finish()

    def place_of_number(self, code: Code, i: Index) -> Index:
        if self._chosen is None:
            return i
        return code.load(code.element(Value(code, self._chosen), i, INTEGER), INTEGER)

    # ---- the sums ----

    def _sums_function(self) -> Code:
        """Emit `(k)`: the sum Σ' aⱼ bₖ₋ⱼ over 0 < j < k for every Cauchy product."""
        frame = self.function("sums", INTEGER)
        code, (k,) = frame.code, frame.arguments
        mixed = [pair for pair in self.series.cauchy_products if pair[0] != pair[1]]
        squares = [(a,) for a, b in self.series.cauchy_products if a == b]
        kinds = [("mixed", mixed, 0, mixed_sum), ("squares", squares, len(mixed), square_sum)]
        tables = {name: self.table(pairs) for name, pairs, _, _ in kinds}

        def read(row: Value, j: int) -> Value:
            return code.load(code.element(row, j * self.width), code.vector)

        for order in code.cases(k, range(2, MAX_ORDER)):
            for name, pairs, first, total in kinds:
                if pairs:
                    with code.loop(len(pairs)) as i:
                        rows = [self._row(frame, tables[name], i * len(pairs[0]) + j) for j in range(len(pairs[0]))]
                        frame["sums", k if self.keep_sums else 0, i + first] = total(order, read, *rows)
        return frame.finish()

    def table(self, pairs, width: int | None = None) -> ir.GlobalVariable:
        """The rows of each product as a constant array of offsets from the first row, for vectors of this width."""
        flat = [row * MAX_ORDER * (width or self.width) for pair in pairs for row in pair]
        return integer_constant(self.module, np.array(flat or [0], np.int64))

    def _row(self, frame: Frame, table, index: Value) -> Value:
        code = frame.code
        offset = code.load(code.element(Value(code, table), index, INTEGER), INTEGER)
        return code.element(frame.address("rows"), offset)

    # ---- the coefficients ----

    def _coefficients_function(self) -> Code:
        """Emit `(order)`: the series of the state up to that order, from its values."""
        frame = self.function("coefficients", INTEGER)
        code, (order,), series, n, form = frame.code, frame.arguments, self.series, self.n, self.form
        values = frame.vectors("values", series.values)
        out = form.run(frame, series.zeroth_order, *self.state_inputs(frame), to=values)
        frame["singular"] = out[n]
        for i in range(self.kept):
            frame["kept", i] = out[n + 1 + i]
        for i in form.each(code, n):
            frame["y", i, 1] = frame["y", i + n]
            frame["y", i + n, 1] = out[i]
        for i in form.each(code, len(series.cauchy_products)):
            frame["sums", integer(code, 1) if self.keep_sums else 0, i] = 0.0

        # Borders are located on the last order too.
        last = code.select(order < MAX_ORDER, order + 1, MAX_ORDER) if self.pieces else order
        with code.loop(last, start=1) as k:
            with code.only_if(k > 1):
                frame.call(self._sums, k)
            inverse = 1.0 / code.as_number(k + 1)
            inputs = self.recursion_inputs(frame, k)
            out = form.run(frame, series.order_recursion, *inputs, to=frame.vectors_at("rows", series.rows, k))
            for i in form.each(code, n):
                frame["y", i, k + 1] = frame["y", i + n, k] * inverse
                frame["y", i + n, k + 1] = out[i] * inverse
        return frame.finish()

    def followed_value(self, frame: Frame, j: Value) -> Value:
        return frame["values", j + (self.series.values - self.series.followed)]

    def followed_coefficient(self, frame: Frame, j: Value, k: Index) -> Value:
        return frame["rows", j + (self.series.rows - self.series.followed), k]

    def followed_degree(self, code: Code, order: Value) -> Value:
        if self.pieces:  # see `coefficients`
            return code.select(order < MAX_ORDER - 1, order, MAX_ORDER - 1)
        return order - 1

    def state_inputs(self, frame: Frame) -> list[Vectors]:
        """The inputs of the program at the current state: q and q̇, t, parameters."""
        state = frame.vectors("y", self.states, lambda i: (i, 0))
        return [state, frame.vectors("t", 1), frame.vectors("params", self.numbers)]

    def recursion_inputs(self, frame: Frame, k: Value) -> list:
        """The inputs of the order recursion: the coefficients of order k, then k, 1/k, the values and the sums."""
        code, number, products = frame.code, frame.code.as_number(k), len(self.series.cauchy_products)
        time = code.select(code.compare("==", k, 1), number, 0.0)
        if self.keep_sums:
            sums = Vectors(products, lambda i: frame["sums", k, i])
        else:
            sums = frame.vectors("sums", products, lambda i: (0, i))
        return [
            Vectors(self.states, lambda i: frame["y", i, k]),
            [code.lanes_of(x) for x in (time, number, 1.0 / number)],
            frame.vectors("values", self.series.values),
            sums,
        ]

    # ---- along the step ----

    def increments(self, frame: Frame, order: Value, s: Value) -> tuple[Numbers, Numbers]:
        """P(s) − y for every component of the state, P′(s) for velocities, by Horner's scheme."""
        code, increments, slopes = frame.code, self.form.room(frame, self.states), self.form.room(frame, self.n)
        s = code.lanes_of(s)
        for some, velocities in self.form.component_groups(code, self.n):
            highest = [frame["y", i, order] for i in some]
            value = [code.variable(c) for c in highest]
            slope = {j: code.variable(code.as_number(order) * highest[j]) for j in velocities}
            with code.loop(order, start=1) as at:
                k = order - at
                weight = code.lanes_of(code.as_number(k))
                for j, i in enumerate(some):
                    c = frame["y", i, k]
                    value[j].value = value[j].value * s + c
                    if j in slope:
                        slope[j].value = slope[j].value * s + c * weight
            for j, i in enumerate(some):
                increments[i] = value[j].value * s
            for j, i in velocities.items():
                slopes[i] = slope[j].value
        return increments, slopes

    def evaluate_now(self, frame: Frame, line: StraightLine) -> Numbers:
        """The outputs of a line of (q, q̇, t, parameters) at the current state."""
        return self.form.run(frame, line, *self.state_inputs(frame))

    def move_state(self, frame: Frame, increments: Numbers) -> Numbers:
        """The state plus these increments."""
        moved = self.form.room(frame, self.states)
        for i in self.form.each(frame.code, self.states):
            moved[i] = frame["y", i] + increments[i]
        return moved

    def evaluate(self, frame: Frame, line: StraightLine, state: Numbers, s: Value) -> Numbers:
        """The outputs of a line of (q, q̇, t, parameters) at a given state, at the time s after the current one."""
        return self.form.run(frame, line, state, [frame["t"] + s], frame.vectors("params", self.numbers))

    # ---- members and rounds ----

    def write_begin(self, start_next: Code, *more: Lines | Tables) -> None:
        """Emit `begin(job, memory, lanes)`: each lane gets a member; `more` forms initialise their memory too."""
        frame = self.function("begin", public=True)
        for form in (*more, self.form):
            form.prepare(frame)
        with frame.code.loop(self.width) as lane:
            frame.call(start_next, lane)
        frame.finish()

    def take_numbers(self, frame: Frame, lane: Lane, member: Value) -> None:
        first = member * frame.job("params_stride")
        lane["first_number"] = frame.code.as_double(first)
        with frame.code.loop(self.parameters) as i:
            lane["params", i] = frame.read("params", first + self.place_of_number(frame.code, i))

    @contextmanager
    def rounds(self, frame: Frame, count: Value) -> Iterator[None]:
        """A context: its body is emitted as a loop of at most `count` rounds, while any lane is active."""
        with frame.code.repeat_while(lambda: self._any_active(frame), at_most=count):
            yield

    def is_unfinished(self, frame: Frame) -> Value:
        return frame.code.select(self._any_active(frame), integer(frame.code, 1), 0)

    def _any_active(self, frame: Frame) -> Value:
        return frame.code.any_lane(frame["active"] > 0.0)


def is_large(program: Recurrent, projection=None, guards=None, times: int = 1, more: Sequence = ()) -> bool:
    """True if a kernel with these programs, `times` over, and with the lines `more`, is too long for straight code."""
    lines = [program.line]
    if projection is not None:
        lines += [projection.state.line, projection.velocity_scale.line]
    if guards is not None:
        lines.append(guards.program.line)
    operations = times * sum(len(line.nodes) for line in lines) + sum(len(line.nodes) for line in more)
    return operations + OPERATIONS_PER_COORDINATE * len(program.line.outputs) > LARGEST_LINE


def choose_order(rtol: float) -> int:
    """The order of the cheapest series at this tolerance: its terms fall by a factor e² each (Jorba & Zou, §3.2)."""
    return min(MAX_ORDER, max(LEAST_ORDER, math.ceil(2 - math.log(rtol) / 2)))


def integer(code: Code, x: int) -> Value:
    return code.as_value(x, INTEGER)


def double(code: Code, x: float) -> Value:
    return code.as_value(x, DOUBLE)


def mixed_sum(order: int, at, a, b) -> Value:
    """The sum Σ aⱼ bₖ₋ⱼ at a constant order, in two independent partial sums."""
    strands = [at(a, j) * at(b, order - j) for j in range(1, min(3, order))]
    for j in range(3, order):
        strands[j % 2 == 0] = at(a, j) * at(b, order - j) + strands[j % 2 == 0]
    return strands[0] if len(strands) == 1 else strands[0] + strands[1]


def square_sum(order: int, at, a) -> Value:
    """The sum Σ aⱼ aₖ₋ⱼ at a constant order, with each product computed once."""
    pairs = [at(a, j) * at(a, order - j) for j in range(1, (order + 1) // 2)]
    middle = [] if order % 2 else [at(a, order // 2) * at(a, order // 2)]
    if not pairs:
        return middle[0]
    half = functools.reduce(Value.__add__, pairs)
    return functools.reduce(Value.__add__, middle, half + half)
