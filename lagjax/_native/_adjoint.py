"""The reverse-mode derivative of a batch of motions: the transpose of every step, from the last to the first.

A step y(t + h) = Σ yₖ hᵏ is a straight line of arithmetic from the state y₀ and the parameters: the series of `start`,
the sums of `products` and the `sweep` of each order. Its transpose takes a cotangent λ of the state at the end of the
step to one at its beginning, and adds to the cotangents of the parameters:

    seed           ȳₖ = hᵏ λ, and sᵏ times the cotangent of every output within the step, at t + s
    orders         from the last to the first: the transposes of the sums, then of the sweep
    start          the transpose of the acceleration and of what the sweep reads off it
    λ              is ȳ₀ then

Every number it takes is one of the step itself, so the series is made once more from the recorded state. The cost is
that of two or three motions, however many parameters there are. Steps are those that were taken: as everywhere in
diffrax, their sizes are not differentiated. Source: Griewank & Walther, *Evaluating Derivatives* (2008), §§3.2, 13.
"""

import ctypes

from llvmlite import ir

from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value
from lagjax._native._lanes import emit
from lagjax._native._series_code import MAX_ORDER, SeriesCode, double, integer
from lagjax._program import Program, Series, StraightLine, pullback


class Job(ctypes.Structure):
    """What all threads work on. `y_bar` is the cotangent of the end, and becomes that of the start."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in (
            "next_member", "ts", "params", "record", "first_step", "steps", "path_bar", "y_bar", "params_bar",
        )),
        *((name, ctypes.c_int64) for name in ("ts_stride", "params_stride", "members", "times", "order")),
    ]  # fmt: skip


class Adjoint(SeriesCode):
    """Builds the module; its public functions are `begin(job, memory, lanes)` and `run(job, memory, lanes, rounds)`."""

    def __init__(self, program: Program, series: Series, projection=None):
        n, states = series.size, 2 * series.size
        dtypes = [shape.dtype for shape in program.shapes for _ in range(shape.size)]
        self.moved = [i for i, dtype in enumerate(dtypes) if dtype.kind == "f" and i != states]  # all but the time
        values, products = series.values, len(series.products)
        sizes = {
            "bar": states,
            "y_bar": states * (MAX_ORDER + 1),
            "rows_bar": series.rows,
            "values_bar": values,
            "params_bar": program.size - states - 1,
            "active": 1,
        }
        super().__init__("adjoint", program, series, Job, sizes, keep_sums=True)
        outputs = [*range(n), *range(n + 1, n + 1 + values)]
        self.start_line = pullback(series.start, dtypes, self.moved, outputs)
        given = states + 3
        by, inputs = [*range(states), *range(given, given + values + products)], given + values + products
        rows = range(n, n + series.rows)  # whose coefficients are kept
        self.sweep_line = pullback(series.sweep, [dtypes[0]] * inputs, by, range(n + series.rows), rows)
        self.start_next = self._start_next()
        steps = [self._seed(), self._back_orders(self._back_sums(), self._back_sweep()), self._back_start()]
        if projection is not None:
            line = projection.state
            line = StraightLine(line.nodes, line.kinds, line.outputs)
            self.projection_line = pullback(line, dtypes, self.moved, range(states))
            steps.insert(0, self._back_projection())
        self._begin()
        self._run(steps)

    def _begin(self) -> None:
        """`begin(job, memory, lanes)`: every lane takes a member."""
        code = Code(self.module, "begin", [POINTER, POINTER, POINTER], self.width, public=True)
        job, memory, lane_data = code.arguments
        with code.loop(self.width) as lane:
            code.call(self.start_next, job, memory, lane_data, lane)
        code.finish()

    def _run(self, steps: list[Code]) -> None:
        """`run(job, memory, lanes, rounds)`: so many rounds, or until the batch is done; one step back in every lane.

        Returns 1 if there is more to do.
        """
        code = Code(self.module, "run", [POINTER] * 3 + [INTEGER], self.width, INTEGER, public=True)
        job, memory, lane_data, rounds = code.arguments
        with self.rounds(code, memory, rounds):
            with code.loop(self.width) as lane:
                self._recall(code, job, memory, lane_data, lane)
            code.call(self.coefficients, memory, self._job(code, job, "order"))
            for step in steps:
                code.call(step, job, memory, lane_data)
            with code.loop(self.width) as lane:
                self._end_or_go_on(code, job, memory, lane_data, lane)
        code.finish(self.more(code, memory))

    # ---- members and their steps ----

    def _start_next(self) -> Code:
        """`(job, memory, lanes, lane)`: the lane takes the next member with steps, or none is left."""
        code = Code(self.module, "start_next", [POINTER, POINTER, POINTER, INTEGER], self.width)
        job, memory, lane_data, lane = code.arguments
        counter, member_of = self._job(code, job, "next_member"), self._lane(code, lane_data, "member", lane)
        step_of = self._lane(code, lane_data, "step", lane)
        code.store(integer(code, 0), step_of)
        code.store(integer(code, 0), member_of)

        def without_steps():
            there = code.load(member_of, INTEGER) >= 0
            return there & (code.load(step_of, INTEGER) <= 0)

        with code.repeat_while(without_steps):
            taken = code.builder.atomic_rmw("add", counter.it, ir.Constant(INTEGER, 1), "monotonic")
            member = Value(code, taken)
            there = member < self._job(code, job, "members")
            code.store(code.select(there, member, -1), member_of)
            row = code.element(self._job(code, job, "steps"), code.select(there, member, 0), INTEGER)
            code.store(code.load(row, INTEGER), step_of)
        member = code.load(member_of, INTEGER)
        there = member >= 0
        self._set(code, memory, "active", lane, code.select(there, double(code, 1.0), 0.0))
        self._set(code, memory, "h", lane, 0.0)
        code.store(code.load(step_of, INTEGER) - 1, step_of)
        code.store(self._job(code, job, "times") - 2, self._lane(code, lane_data, "output", lane))
        with code.only_if(there):
            for i in range(self.states):
                x = self._read(code, job, "y_bar", member * self.states + i)
                code.store(x, self.place(code, memory, "bar", i, lane))
            with code.loop(self.numbers) as i:
                x = self._read(code, job, "params", member * self._job(code, job, "params_stride") + i)
                code.store(x, self.place(code, memory, "params", i, lane))
                code.store(double(code, 0.0), self.place(code, memory, "params_bar", i, lane))
        return code.finish()

    def _recall(self, code, job, memory, lane_data, lane) -> None:
        """The time, size and first state of the step that the lane is to go back."""
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
        with code.only_if(member >= 0):
            first = code.load(code.element(self._job(code, job, "first_step"), member, INTEGER), INTEGER)
            row = (first + code.load(self._lane(code, lane_data, "step", lane), INTEGER)) * (self.states + 2)
            self._set(code, memory, "t", lane, self._read(code, job, "record", row))
            self._set(code, memory, "h", lane, self._read(code, job, "record", row + 1))
            for i in range(self.states):
                code.store(self._read(code, job, "record", row + (i + 2)), self.state(code, memory, i, 0, lane))

    def _end_or_go_on(self, code, job, memory, lane_data, lane) -> None:
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
        with code.only_if(member >= 0):
            step_of = self._lane(code, lane_data, "step", lane)
            left = code.load(step_of, INTEGER) - 1
            code.store(left, step_of)
            with code.only_if(left < 0):
                for i in range(self.states):
                    x = code.load(self.place(code, memory, "bar", i, lane), DOUBLE)
                    code.store(x, code.element(self._job(code, job, "y_bar"), member * self.states + i))
                with code.loop(self.numbers) as i:
                    x = code.load(self.place(code, memory, "params_bar", i, lane), DOUBLE)
                    code.store(x, code.element(self._job(code, job, "params_bar"), member * self.numbers + i))
                code.call(self.start_next, job, memory, lane_data, lane)

    # ---- the transpose of a step ----

    def _function(self, name: str) -> tuple[Code, Value, Value, Value]:
        code = Code(self.module, name, [POINTER, POINTER, POINTER], self.width)
        return code, *code.arguments

    def _bar(self, code, memory, i: int, order) -> Value:
        """The address of the cotangent of the coefficient of a component of the state."""
        return self.place(code, memory, "y_bar", order + i * (MAX_ORDER + 1))

    def _add(self, code, x: Value, address: Value) -> None:
        code.store(code.load(address, x.it.type) + x, address)

    def _seed(self) -> Code:
        """The cotangents of all coefficients, by the polynomials that they are used in."""
        code, job, memory, lane_data = self._function("seed")
        h, power = self._vector(code, memory, "h"), code.variable(code.lanes_of(1.0))
        for i in range(self.series.values):
            self._keep(code, memory, "values_bar", code.lanes_of(0.0), i)
        with code.loop(self._job(code, job, "order") + 1) as k:
            now = code.load(power, self.vector)
            for i in range(self.states):
                code.store(self._vector(code, memory, "bar", i) * now, self._bar(code, memory, i, k))
            code.store(now * h, power)
        with code.loop(self.width) as lane:
            self._seed_outputs(code, job, memory, lane_data, lane)
        return code.finish()

    def _seed_outputs(self, code, job, memory, lane_data, lane) -> None:
        """The outputs of one lane that lie after the beginning of its step."""
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
        output_of = self._lane(code, lane_data, "output", lane)
        t, h = (self._get(code, memory, name, lane) for name in ("t", "h"))

        def after_begin():
            index = code.load(output_of, INTEGER)
            there = (member >= 0) & (index > 0)
            at = self._time(code, job, code.select(there, member, 0), code.select(there, index, 0))
            return there & ((at - t) * h > 0.0)

        with code.repeat_while(after_begin):
            index = code.load(output_of, INTEGER)
            s, power = self._time(code, job, member, index) - t, code.variable(double(code, 1.0))
            row = (member * self._job(code, job, "times") + index) * self.states
            bars = [self._read(code, job, "path_bar", row + i) for i in range(self.states)]
            with code.loop(self._job(code, job, "order") + 1) as k:
                now = code.load(power, DOUBLE)
                for i, bar in enumerate(bars):
                    offset = lane + (k + i * (MAX_ORDER + 1) + self.offsets["y_bar"]) * self.width
                    self._add(code, bar * now, code.element(memory, offset))
                code.store(now * s, power)
            code.store(index - 1, output_of)

    def _back_orders(self, back_sums: Code, back_sweep: Code) -> Code:
        code, job, memory, _ = self._function("back_orders")
        order = self._job(code, job, "order")
        with code.loop(order, start=1) as i:
            code.call(back_sums, memory, order - i, order)
            code.call(back_sweep, memory, order - i)
        return code.finish()

    def _back_sums(self) -> Code:
        """`(memory, k, order)`: the cotangents of the rows at order k, from those of the sums of higher orders."""
        code = Code(self.module, "back_sums", [POINTER, INTEGER, INTEGER], self.width)
        memory, k, order = code.arguments
        for i in range(self.series.rows):
            self._keep(code, memory, "rows_bar", code.lanes_of(0.0), i)
        kinds = [[p for p in self.series.products if (p[0] == p[1]) == square] for square in (False, True)]
        tables = [self._table(f"back{len(pairs)}_{square}", pairs) for square, pairs in enumerate(kinds)]
        end = code.function.append_basic_block("end")
        switch = code.builder.switch((order - 1 - k).it, end)
        for terms in range(1, MAX_ORDER - 1):
            block = code.function.append_basic_block(f"terms{terms}")
            switch.add_case(ir.Constant(INTEGER, terms), block)
            code.builder.position_at_end(block)
            for table, pairs, first in zip(tables, kinds, (0, len(kinds[0])), strict=True):
                if pairs:
                    with code.loop(len(pairs)) as i:
                        self._back_sum(code, memory, table, i, first, k, terms)
            code.builder.branch(end)
        code.builder.position_at_end(end)
        return code.finish()

    def _back_sum(self, code, memory, table, i, first: int, k, terms: int) -> None:
        """s = Σ' aⱼ bₖ₋ⱼ at orders k + 1, …: its cotangent times b is one of a, and times a one of b."""
        products = len(self.series.products)
        bars = self.sum_place(code, memory, i + first, k)  # of higher orders, where the sums themselves were
        offsets = [code.load(code.element(Value(code, table), i * 2 + which, INTEGER), INTEGER) for which in range(2)]
        rows = [code.element(self.place(code, memory, "rows"), offset) for offset in offsets]
        totals: list = [None, None]
        for j in range(1, terms + 1):
            bar = code.load(code.element(bars, j * products * self.width), self.vector)
            for which in range(2):
                term = bar * code.load(code.element(rows[1 - which], j * self.width), self.vector)
                totals[which] = term if totals[which] is None else term + totals[which]
        for offset, total in zip(offsets, totals, strict=True):  # a square gets the same twice
            self._add(code, total, code.element(self.place(code, memory, "rows_bar"), offset / MAX_ORDER))

    def _back_sweep(self) -> Code:
        """`(memory, k)`: from the cotangents of order k + 1, and of the rows, to those of order k and of the sums.

        Those of the sums take the place of the sums, which nobody reads again: all of it fits into the first cache.
        """
        code = Code(self.module, "back_sweep", [POINTER, INTEGER], self.width)
        memory, k = code.arguments
        n, inverse = self.n, 1.0 / code.as_double(k + 1)
        for i in range(n):  # q̇ₖ = (k+1) qₖ₊₁
            self._add(code, code.load(self._bar(code, memory, i, k + 1), self.vector) * inverse,
                      self._bar(code, memory, n + i, k))  # fmt: skip
        known, read = self.states + 3 + self.series.values + len(self.series.products), self.at_order(code, memory, k)

        def inputs(i):
            if i < known:
                return read(i)
            if i < known + n:
                return code.load(self._bar(code, memory, n + (i - known), k + 1), self.vector) * inverse
            i -= known + n
            if i < self.series.rows:
                return self._vector(code, memory, "rows_bar", i)
            return self._vector(code, memory, "rows", k + (i - self.series.rows) * MAX_ORDER)

        out = emit(code, self.sweep_line, inputs, None)
        for i, x in enumerate(out[: self.states]):
            self._add(code, x, self._bar(code, memory, i, k))
        values, sums = out[self.states :][: self.series.values], out[self.states + self.series.values :]
        for i, x in enumerate(values):
            self._add(code, x, self.place(code, memory, "values_bar", i))
        for i, x in enumerate(sums):
            code.store(x, self.sum_place(code, memory, i, k))
        return code.finish()

    def _back_start(self) -> Code:
        """From the cotangents of the first orders, and of what the sweep read, to that of the state."""
        code, _, memory, _ = self._function("back_start")
        n, now = self.n, self.now(code, memory)
        for i in range(n):
            self._add(code, code.load(self._bar(code, memory, i, 1), self.vector), self._bar(code, memory, n + i, 0))

        def inputs(i):
            i -= self.program.size
            if i < 0:
                return now(i + self.program.size)
            if i < n:
                return code.load(self._bar(code, memory, n + i, 1), self.vector)
            return self._vector(code, memory, "values_bar", i - n)

        for i, x in zip(self.moved, emit(code, self.start_line, inputs, self.sincos), strict=True):
            if i < self.states:
                self._keep(code, memory, "bar", code.load(self._bar(code, memory, i, 0), self.vector) + x, i)
            else:
                self._add(code, x, self.place(code, memory, "params_bar", i - self.states - 1))
        return code.finish()

    def _back_projection(self) -> Code:
        """From the state on the constraints to the end of the series before it was put there."""
        code, job, memory, _ = self._function("back_projection")
        h, now = self._vector(code, memory, "h"), self.now(code, memory)
        increments, _ = self.increments(code, memory, self._job(code, job, "order"), h)
        moved = [code.load(self.state(code, memory, i), self.vector) + dy for i, dy in enumerate(increments)]

        def inputs(i):
            if i < self.states:
                return moved[i]
            if i < self.program.size:
                return now(i) + h if i == self.states else now(i)
            return self._vector(code, memory, "bar", i - self.program.size)

        for i, x in zip(self.moved, emit(code, self.projection_line, inputs, self.sincos), strict=True):
            if i < self.states:
                self._keep(code, memory, "bar", x, i)
            else:
                self._add(code, x, self.place(code, memory, "params_bar", i - self.states - 1))
        return code.finish()
