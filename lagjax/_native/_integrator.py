"""The integration of a batch by Taylor series, as one function of LLVM.

Every lane of a vector carries one member. A round takes one step in each lane:

    coefficients   q and q̇ as power series about the present time (see `_program._series`)
    choose         the step that the last two coefficients allow, per lane
    check          the series must satisfy the equations of motion along the step, or the step is halved
    advance        outputs inside the step, then the state at its end, summed with its rounding errors carried along
    finish         a lane whose member has ended takes the next one of the batch

so that no lane waits for another. Several threads may run the function at once: they share the counter that hands out
the members.

Step size: with the scaled norm ‖c‖ = max |cᵢ| / (atol + rtol·sᵢ), sᵢ the size of component i over the step,

    h = 0.9 min(‖yₚ‖^(−1/p), ‖yₚ₋₁‖^(−1/(p−1)))

makes the last terms of the series as small as the tolerance. Source: Jorba & Zou, Exp. Math. 14 (2005) §3.2. The check
is ours: the defect d = P″ − q̈(P, P′) of the polynomial P, at the middle and at the end of the step, must obey
h ‖d‖ / (p+1) ≤ 1. It costs two accelerations, and sees what no coefficient shows: a border of a piecewise function, a
narrow feature ahead.
"""

import ctypes
import functools

from llvmlite import ir

from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value, lanes
from lagjax._native._lanes import emit, sincos_function
from lagjax._program import Program, Series, StraightLine

MAX_ORDER = 20
SAFETY = 0.9
ROUND_OFF = 256 * 2.0**-52  # of an acceleration
BISECTIONS = 60  # of a step, to find an event: beyond the digits of a double
# A series that ends (free flight) allows any step, and a step that is too long sees nothing of what lies inside it.
FIRST_STEP, GROWTH, GROWTH_AFTER_REJECTION = 1 / 16, 5.0, 2.0  # of the whole time; of the step before
SMALLEST_STEP = 4 * 2.0**-52  # of the largest time: below this a step no longer moves the time reliably
CHECKS = (0.5, 1.0)  # where in the step its series is held against the equations

# How a member ended.
DONE, OUT_OF_STEPS, STEP_TOO_SMALL, NOT_FINITE, SINGULAR, EVENT = range(6)  # EVENT + k: the k-th guard
_RUNNING = -1


class Job(ctypes.Structure):
    """What all threads work on: eight bytes for each entry."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in (
            "next_member", "ts", "y0", "params", "path", "y_end", "t_end", "code", "steps", "rejected",
        )),
        # From one member to the next: 0 where all share the output times, or the parameters.
        *((name, ctypes.c_int64) for name in ("ts_stride", "params_stride")),
        *((name, ctypes.c_int64) for name in ("members", "times", "order", "max_steps")),
        *((name, ctypes.c_double) for name in ("rtol", "atol")),
    ]  # fmt: skip


# Doubles of a lane. `due` and `reached` are times in the direction of time; `active`, `last`, `singular` are 1 or 0.
_OF_A_LANE = (
    "t", "t_low", "t_end", "forward", "smallest", "h", "due", "reached", "worst", "active", "last", "singular", "code",
    "steps", "rejected", "longest", "growth", "event",
)  # fmt: skip
_KINDS = {ctypes.c_void_p: POINTER, ctypes.c_int64: INTEGER, ctypes.c_double: DOUBLE}
# Integers of a lane: which member it carries (-1: none), and which output comes next.
LANE = ("member", "output")


class Integrator:
    """Builds the module. `memory` is what a thread needs, in doubles; `lanes` the width."""

    def __init__(
        self, program: Program, series: Series, projection: Program | None = None, guards=None, groups=None
    ):
        self.program, self.series, self.n = program, series, series.size
        # Coordinates of one group are measured by the largest of them.
        self.groups = tuple(range(series.size)) if groups is None else groups
        self.projection, self.guards = projection, guards
        self.directions = () if guards is None else guards.directions
        self.states, self.width = 2 * series.size, lanes()
        self.module = ir.Module("motion")
        self.module.triple = ""
        self.vector = ir.VectorType(DOUBLE, self.width)
        self.numbers = program.size - self.states - 1  # parameters
        self._lay_out()
        self.sincos = sincos_function(self.module, self.width)
        self.sums = self._sums()
        self.coefficients = self._coefficients()
        self.defect = self._defect()
        self.start_next = self._start_next()
        self.project = None if projection is None else self._project()
        self.guard = None if guards is None else self._guard()
        self._run()
        if projection is not None:
            self._project_rows()

    # ---- the memory of a thread: vectors, one element for each lane ----

    def _lay_out(self) -> None:
        series, self.offsets, total = self.series, {}, 0
        sizes = {
            "y": self.states * (MAX_ORDER + 1),  # the series of the state, component by component
            "low": self.states,  # what rounding took from the state
            "scale": self.states,
            "increment": self.states,
            "rows": series.rows * MAX_ORDER,
            "sums": len(series.products),
            "values": series.values,
            "params": self.numbers,
            **dict.fromkeys(("guard", "guard_before", "guard_middle"), len(self.directions)),
            **dict.fromkeys(_OF_A_LANE, 1),
        }
        for name, size in sizes.items():
            self.offsets[name], total = total, total + size
        self.memory = total * self.width

    def place(self, code: Code, memory: Value, name: str, index=0, lane=None) -> Value:
        """The address of a vector, or of one lane of it."""
        offset = (index + self.offsets[name]) * self.width
        return code.element(memory, offset if lane is None else lane + offset)

    def state(self, code: Code, memory: Value, i: int, order=0, lane=None) -> Value:
        """The address of the coefficient of a component of the state."""
        return self.place(code, memory, "y", order + i * (MAX_ORDER + 1), lane)

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
                        code.store(total(order, at, *rows), self.place(code, memory, "sums", i + first))
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
        *acceleration, singular = (out := emit(code, series.start, self._now(code, memory), self.sincos))[: n + 1]
        code.store(code.as_double(singular), self.place(code, memory, "singular"))
        for i in range(n):
            code.store(code.load(self.state(code, memory, n + i), self.vector), self.state(code, memory, i, 1))
            code.store(acceleration[i], self.state(code, memory, n + i, 1))
        for i, value in enumerate(out[n + 1 :]):
            code.store(value, self.place(code, memory, "values", i))
        for i in range(len(series.products)):
            code.store(code.lanes_of(0.0), self.place(code, memory, "sums", i))

        with code.loop(order, start=1) as k:
            with code.only_if(k > 1):
                code.call(self.sums, memory, k)
            inverse = 1.0 / code.as_double(k + 1)
            out = emit(code, series.sweep, self._at_order(code, memory, k), None)
            for row, value in enumerate(out[n:]):
                code.store(value, self.place(code, memory, "rows", k + row * MAX_ORDER))
            for i in range(n):
                velocity = code.load(self.state(code, memory, n + i, k), self.vector)
                code.store(velocity * inverse, self.state(code, memory, i, k + 1))
                code.store(out[i] * inverse, self.state(code, memory, n + i, k + 1))
        return code.finish()

    def _now(self, code, memory):
        """The inputs of the program: q, q̇, t, parameters."""

        def read(i):
            if i < self.states:
                return code.load(self.state(code, memory, i), self.vector)
            name, i = ("t", 0) if i == self.states else ("params", i - self.states - 1)
            return code.load(self.place(code, memory, name, i), self.vector)

        return read

    def _at_order(self, code, memory, k):
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
            return code.load(self.place(code, memory, "sums", i - self.series.values), self.vector)

        return read

    # ---- along the step ----

    def _defect(self) -> Code:
        """`(memory, order, place)`: h ‖P″ − q̈(P, P′)‖ / (p+1) at that place of the step, into `worst` if larger.

        The increment P − y stays in memory.
        """
        code = Code(self.module, "defect", [POINTER, INTEGER, DOUBLE], self.width)
        memory, order, place = code.arguments
        h, n = self._vector(code, memory, "h"), self.n
        s = code.lanes_of(place) * h
        increments, slopes = self._increments(code, memory, order, s)
        moved = []
        for i, increment in enumerate(increments):
            code.store(increment, self.place(code, memory, "increment", i))
            moved.append(code.load(self.state(code, memory, i), self.vector) + increment)
        now = self._now(code, memory)

        def then(i):
            return moved[i] if i < self.states else now(i) + s if i == self.states else now(i)

        line = StraightLine(self.program.nodes, self.program.kinds, self.program.outputs[:n])
        acceleration = emit(code, line, then, self.sincos)
        worst = self._vector(code, memory, "worst")
        weight = code.intrinsic("fabs", h) / code.as_double(order + 1)
        size = self._by_group(code, [code.intrinsic("fabs", a) for a in acceleration])
        for i in range(n):
            # What rounding leaves of an acceleration is not a defect of the series.
            excess = code.intrinsic("fabs", acceleration[i] - slopes[i]) - ROUND_OFF * size[i]
            error = weight * excess * self._vector(code, memory, "scale", n + i)
            worst = code.select(error <= worst, worst, error)  # NaN goes through
        self._keep(code, memory, "worst", worst)
        return code.finish()

    def _increments(self, code, memory, order, s) -> tuple[list[Value], list[Value]]:
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

    # ---- the rounds ----

    def _start_next(self) -> Code:
        """`(memory, lanes, job, lane)`: the lane takes the next member, or none is left."""
        code = Code(self.module, "start_next", [POINTER, POINTER, POINTER, INTEGER], self.width)
        memory, lane_data, job, lane = code.arguments
        counter = self._job(code, job, "next_member")
        member = Value(code, code.builder.atomic_rmw("add", counter.it, ir.Constant(INTEGER, 1), "monotonic"))
        there = member < self._job(code, job, "members")
        code.store(code.select(there, member, -1), self._lane(code, lane_data, "member", lane))
        for name in ("h", "t_low", "steps", "rejected"):
            self._set(code, memory, name, lane, 0.0)
        self._set(code, memory, "active", lane, code.select(there, _double(code, 1.0), 0.0))
        self._set(code, memory, "code", lane, float(_RUNNING))
        self._set(code, memory, "due", lane, float("inf"))
        self._set(code, memory, "event", lane, -1.0)
        with code.only_if(there):
            begin, end = (self._time(code, job, member, i) for i in (0, self._job(code, job, "times") - 1))
            self._set(code, memory, "t", lane, begin)
            self._set(code, memory, "t_end", lane, end)
            self._set(code, memory, "forward", lane, code.select(end > begin, _double(code, 1.0), -1.0))
            largest = code.maximum(code.intrinsic("fabs", begin), code.intrinsic("fabs", end))
            self._set(code, memory, "smallest", lane, SMALLEST_STEP * largest)
            self._set(code, memory, "longest", lane, code.intrinsic("fabs", end - begin) * FIRST_STEP)
            self._await_output(code, memory, lane_data, job, lane, _integer(code, 1))
            for i in range(self.states):
                x = self._read(code, job, "y0", member * self.states + i)
                code.store(x, self.state(code, memory, i, 0, lane))
                code.store(x, self._output(code, job, member, 0, i))
                code.store(_double(code, 0.0), self.place(code, memory, "low", i, lane))
            with code.loop(self.numbers) as i:
                x = self._read(code, job, "params", member * self._job(code, job, "params_stride") + i)
                code.store(x, self.place(code, memory, "params", i, lane))
        return code.finish()

    def _await_output(self, code, memory, lane_data, job, lane, index: Value) -> None:
        """`due` is the next output time before the end, in the direction of time; infinite after the last one."""
        code.store(index, self._lane(code, lane_data, "output", lane))
        inside = index < self._job(code, job, "times") - 1
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
        time = self._time(code, job, member, code.select(inside, index, 0)) * self._get(code, memory, "forward", lane)
        self._set(code, memory, "due", lane, code.select(inside, time, float("inf")))

    def _run(self) -> None:
        """`(job, memory, lanes, idle)`: until the batch is done; `idle` counts the lanes without a member."""
        code = Code(self.module, "run", [POINTER, POINTER, POINTER, POINTER], self.width, public=True)
        job, memory, lane_data, idle = code.arguments
        order = self._job(code, job, "order")
        with code.loop(self.width) as lane:
            code.call(self.start_next, memory, lane_data, job, lane)
        with code.repeat_while(lambda: code.any_lane(self._vector(code, memory, "active") > 0.0)):
            code.call(self.coefficients, memory, order)
            self._choose(code, memory, job, order)
            self._halve_until_sound(code, memory, job, order)
            if self.guard is not None:
                self._stop_at_events(code, memory, order)
            self._move_time(code, memory, lane_data, job, order)
            self._advance(code, memory)
            if self.project is not None:
                code.call(self.project, memory)
            self._end_or_go_on(code, memory, lane_data, job, idle)
        code.finish()

    def _choose(self, code, memory, job, order) -> None:
        """The step of every lane, into `h`: 0, and a code, where it cannot go on."""
        last, before = self._errors(code, memory, job, order)
        p = code.as_double(order)
        a, b = _power(code, last, -1.0 / p), _power(code, before, -1.0 / (p - 1.0))
        size, longest = SAFETY * code.select(a < b, a, b), self._vector(code, memory, "longest")
        size = code.select(size < longest, size, longest)
        self._keep(code, memory, "growth", code.lanes_of(GROWTH))
        forward, end = self._vector(code, memory, "forward"), self._vector(code, memory, "t_end")
        left = ((end - self._vector(code, memory, "t")) - self._vector(code, memory, "t_low")) * forward
        is_last = size >= left
        step = code.select(is_last, left, size)
        active = self._vector(code, memory, "active") > 0.0
        singular = self._vector(code, memory, "singular") > 0.0
        sound = (last < float("inf")) & (before < float("inf")) & ~singular
        small = ~is_last & (step < self._vector(code, memory, "smallest"))
        going = active & sound & ~small
        ending = code.select(small, _lanes(code, STEP_TOO_SMALL), float(_RUNNING))
        ending = code.select(sound, ending, code.select(singular, _lanes(code, SINGULAR), float(NOT_FINITE)))
        self._keep(code, memory, "code", ending)
        self._keep(code, memory, "h", code.select(going, step * forward, 0.0))
        self._keep(code, memory, "last", code.select(going & is_last, _lanes(code, 1), 0.0))

    def _errors(self, code, memory, job, order) -> tuple[Value, Value]:
        """The scaled norms of the last two coefficients; `scale` keeps 1 / (atol + rtol·size)."""
        rtol, atol = (code.lanes_of(self._job(code, job, name)) for name in ("rtol", "atol"))
        before = code.intrinsic("fabs", self._vector(code, memory, "h"))
        errors = [code.lanes_of(0.0), code.lanes_of(0.0)]

        def largest(i):
            # A component that passes through zero is as large as it will be a step away.
            y, rate = (
                code.intrinsic("fabs", code.load(self.state(code, memory, i, k), self.vector)) for k in range(2)
            )
            return code.maximum(y, rate * before)

        n = self.n
        sizes = [x for half in (range(n), range(n, 2 * n)) for x in self._by_group(code, [largest(i) for i in half])]
        for i, size in enumerate(sizes):
            rate = code.intrinsic("fabs", code.load(self.state(code, memory, i, 1), self.vector))
            scale = 1.0 / (atol + rtol * size)
            self._keep(code, memory, "scale", scale, i)
            for k in range(2):
                c = code.load(self.state(code, memory, i, order - k), self.vector)
                error = code.intrinsic("fabs", c) * scale
                errors[k] = code.select(error <= errors[k], errors[k], error)  # NaN goes through
            # An infinite slope may leave no trace in the last coefficients.
            errors[0] = code.select(rate < float("inf"), errors[0], float("nan"))
        return errors[0], errors[1]

    def _by_group(self, code, values: list[Value]) -> list[Value]:
        """For every coordinate the largest value in its group."""
        largest: dict[int, Value] = {}
        for group, value in zip(self.groups, values, strict=True):
            largest[group] = code.maximum(largest[group], value) if group in largest else value
        return [largest[group] for group in self.groups]

    def _halve_until_sound(self, code, memory, job, order) -> None:
        """Check the steps of all lanes, and halve those that fail, until none does."""
        again = code.variable(_integer(code, 1))
        with code.repeat_while(lambda: code.load(again, INTEGER) > 0):
            code.store(_integer(code, 0), again)
            self._keep(code, memory, "worst", code.lanes_of(0.0))
            for place in CHECKS:
                code.call(self.defect, memory, order, _double(code, place))
            h = self._vector(code, memory, "h")
            bad = ~(self._vector(code, memory, "worst") <= 1.0) & code.compare("!=", h, 0.0)
            with code.only_if(code.any_lane(bad)):
                code.store(_integer(code, 1), again)
                half = 0.5 * h
                small = bad & (code.intrinsic("fabs", half) < self._vector(code, memory, "smallest"))
                rejected = self._vector(code, memory, "rejected")
                ending = self._vector(code, memory, "code")
                self._keep(code, memory, "h", code.select(small, 0.0, code.select(bad, half, h)))
                self._keep(code, memory, "code", code.select(small, _lanes(code, STEP_TOO_SMALL), ending))
                self._keep(code, memory, "rejected", rejected + code.select(bad, _lanes(code, 1), 0.0))
                last = self._vector(code, memory, "last")
                self._keep(code, memory, "last", code.select(bad, 0.0, last))
                growth = self._vector(code, memory, "growth")
                self._keep(code, memory, "growth", code.select(bad, GROWTH_AFTER_REJECTION, growth))

    def _move_time(self, code, memory, lane_data, job, order) -> None:
        """The time at the end of the step, and the states at the output times before it."""
        t, low, h = (self._vector(code, memory, name) for name in ("t", "t_low", "h"))
        rough = t + h
        part = rough - t
        rest = low + ((t - (rough - part)) + (h - part))  # Knuth's two-sum
        after = rough + rest
        rest = rest - (after - rough)
        is_last = self._vector(code, memory, "last") > 0.0
        end, forward = self._vector(code, memory, "t_end"), self._vector(code, memory, "forward")
        after, rest = code.select(is_last, end, after), code.select(is_last, 0.0, rest)
        moving = code.compare("!=", h, 0.0)
        self._keep(code, memory, "reached", after * forward)
        with code.only_if(code.any_lane(moving & (self._vector(code, memory, "due") <= after * forward))):
            with code.loop(self.width) as lane:
                moves = code.compare("!=", self._get(code, memory, "h", lane), 0.0)
                self._outputs(code, memory, lane_data, job, order, lane, moves)
        self._keep(code, memory, "t", code.select(moving, after, t))
        self._keep(code, memory, "t_low", code.select(moving, rest, low))

    def _outputs(self, code, memory, lane_data, job, order, lane, moves) -> None:
        t, low = (self._get(code, memory, name, lane) for name in ("t", "t_low"))
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)

        def due():
            return moves & (self._get(code, memory, "due", lane) <= self._get(code, memory, "reached", lane))

        with code.repeat_while(due):
            index = code.load(self._lane(code, lane_data, "output", lane), INTEGER)
            s = (self._time(code, job, member, index) - t) - low
            values = [code.variable(code.load(self.state(code, memory, i, order, lane), DOUBLE)) for i in
                      range(self.states)]  # fmt: skip
            with code.loop(order + 1, start=1) as j:
                for i, value in enumerate(values):
                    c = code.load(self.state(code, memory, i, order - j, lane), DOUBLE)
                    code.store(code.load(value, DOUBLE) * s + c, value)
            for i, value in enumerate(values):
                code.store(code.load(value, DOUBLE), self._output(code, job, member, index, i))
            self._await_output(code, memory, lane_data, job, lane, index + 1)

    def _advance(self, code, memory) -> None:
        """y + h y₁ + …, with what rounding takes carried to the next step; and one step more on the count."""
        h = self._vector(code, memory, "h")
        moving = code.compare("!=", h, 0.0)
        self._keep(code, memory, "longest", code.intrinsic("fabs", h) * self._vector(code, memory, "growth"))
        for i in range(self.states):
            y = code.load(self.state(code, memory, i), self.vector)
            low = self._vector(code, memory, "low", i)
            increment = self._vector(code, memory, "increment", i) + low
            total = y + increment
            part = total - y
            rest = (y - (total - part)) + (increment - part)
            code.store(code.select(moving, total, y), self.state(code, memory, i))
            self._keep(code, memory, "low", code.select(moving, rest, low), i)
        steps = self._vector(code, memory, "steps")
        self._keep(code, memory, "steps", steps + code.select(moving, _lanes(code, 1), 0.0))

    def _end_or_go_on(self, code, memory, lane_data, job, idle) -> None:
        """Write down the members that have ended, and take the next ones."""
        ending, steps, rejected = (self._vector(code, memory, name) for name in ("code", "steps", "rejected"))
        limit = code.as_double(self._job(code, job, "max_steps"))
        running = ending < 0.0
        is_last = self._vector(code, memory, "last") > 0.0
        ending = code.select(running & (steps + rejected >= limit), _lanes(code, OUT_OF_STEPS), ending)
        ending = code.select(is_last, _lanes(code, DONE), ending)
        event = self._vector(code, memory, "event")
        ending = code.select(event >= 0.0, event + float(EVENT), ending)
        self._keep(code, memory, "code", ending)
        active = self._vector(code, memory, "active") > 0.0
        with code.only_if(code.any_lane(~(active & (ending < 0.0)))), code.loop(self.width) as lane:
            member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
            with code.only_if(member < 0):
                code.store(code.load(idle, INTEGER) + 1, idle)
            with code.only_if((member >= 0) & (self._get(code, memory, "code", lane) >= 0.0)):
                self._write_down(code, memory, job, member, lane)
                code.call(self.start_next, memory, lane_data, job, lane)

    def _write_down(self, code, memory, job, member, lane) -> None:
        code.store(self._get(code, memory, "t", lane), code.element(self._job(code, job, "t_end"), member))
        for name in ("code", "steps", "rejected"):
            code.store(self._get(code, memory, name, lane), code.element(self._job(code, job, name), member))
        done = code.compare("==", self._get(code, memory, "code", lane), float(DONE))
        last_time = self._job(code, job, "times") - 1
        for i in range(self.states):
            x = code.load(self.state(code, memory, i, 0, lane), DOUBLE)
            code.store(x, code.element(self._job(code, job, "y_end"), member * self.states + i))
            with code.only_if(done):
                code.store(x, self._output(code, job, member, last_time, i))

    # ---- events ----

    def _guard(self) -> Code:
        """`(memory, order, s)`: the guards at that time after the present one, lane by lane, into `guard`."""
        code = Code(self.module, "guard", [POINTER, INTEGER, self.vector], self.width)
        memory, order, s = code.arguments
        increments, _ = self._increments(code, memory, order, s)
        moved = [code.load(self.state(code, memory, i), self.vector) + dy for i, dy in enumerate(increments)]
        now = self._now(code, memory)

        def then(i):
            return moved[i] if i < self.states else now(i) + s if i == self.states else now(i)

        program = self.guards.program
        values = emit(code, StraightLine(program.nodes, program.kinds, program.outputs), then, self.sincos)
        for i, value in enumerate(values):
            self._keep(code, memory, "guard", value, i)
        return code.finish()

    def _stop_at_events(self, code, memory, order) -> None:
        """Where a guard changes sign along the step, the step ends there: at the earliest change of all guards.

        Signs are compared at the beginning, in the middle and at the end. A motion that begins on the surface of a
        guard has left it, or not, a millionth of the first step later: that is the sign it begins with.
        """
        h, count = self._vector(code, memory, "h"), len(self.directions)
        fresh = code.compare("==", self._vector(code, memory, "steps"), 0.0)
        with code.only_if(code.any_lane(fresh)):
            code.call(self.guard, memory, order, 1e-6 * h)
            for i in range(count):
                before, first = (self._vector(code, memory, name, i) for name in ("guard_before", "guard"))
                self._keep(code, memory, "guard_before", code.select(fresh, first, before), i)
        code.call(self.guard, memory, order, 0.5 * h)
        for i in range(count):
            self._keep(code, memory, "guard_middle", self._vector(code, memory, "guard", i), i)
        code.call(self.guard, memory, order, h)
        moving = code.compare("!=", h, 0.0)
        crossed = []
        for i, direction in enumerate(self.directions):
            before, middle, after = (
                self._vector(code, memory, name, i) for name in ("guard_before", "guard_middle", "guard")
            )
            early, late = _crosses(before, middle, direction), _crosses(middle, after, direction)
            crossed.append(((early | late) & moving, early))
        any_crossed = functools.reduce(Value.__or__, (hit for hit, _ in crossed))
        nearest = code.variable(h)
        after = [self._vector(code, memory, "guard", i) for i in range(count)]
        with code.only_if(code.any_lane(any_crossed)):
            for i, (hit, early) in enumerate(crossed):
                root = self._root(code, memory, order, i, h, hit, early)
                best = code.load(nearest, self.vector)
                sooner = hit & (code.intrinsic("fabs", root) <= code.intrinsic("fabs", best))
                code.store(code.select(sooner, root, best), nearest)
                event = self._vector(code, memory, "event")
                self._keep(code, memory, "event", code.select(sooner, _lanes(code, i), event))
            last = self._vector(code, memory, "last")
            self._keep(code, memory, "last", code.select(any_crossed, 0.0, last))
            self._keep(code, memory, "h", code.load(nearest, self.vector))
            code.call(self.defect, memory, order, _double(code, 1.0))  # leaves the increment of the new step
        for i in range(count):
            self._keep(code, memory, "guard_before", after[i], i)

    def _root(self, code, memory, order, i: int, h, hit, early) -> Value:
        """Where guard i changes sign, by bisection: the end of the bracket, where it has changed."""
        low = code.variable(code.select(early, 0.0, 0.5 * h))
        high = code.variable(code.select(early, 0.5 * h, h))
        first, second = (self._vector(code, memory, name, i) for name in ("guard_before", "guard_middle"))
        sign = code.select(early, first, second)
        with code.loop(BISECTIONS):
            a, b = code.load(low, self.vector), code.load(high, self.vector)
            middle = 0.5 * (a + b)
            code.call(self.guard, memory, order, middle)
            same = self._vector(code, memory, "guard", i) * sign > 0.0
            code.store(code.select(same, middle, a), low)
            code.store(code.select(same, b, middle), high)
        return code.select(hit, code.load(high, self.vector), h)

    # ---- constraints ----

    def _project(self) -> Code:
        """`(memory)`: the state of every lane back to the constraints."""
        code = Code(self.module, "project", [POINTER], self.width)
        (memory,) = code.arguments
        line = StraightLine(self.projection.nodes, self.projection.kinds, self.projection.outputs)
        for i, y in enumerate(emit(code, line, self._now(code, memory), self.sincos)):
            code.store(y, self.state(code, memory, i))
        return code.finish()

    def _project_rows(self) -> None:
        """`(job, memory, rows, times)`: states, `times` of them for each member, back to the constraints."""
        code = Code(self.module, "project_rows", [POINTER, POINTER, POINTER, INTEGER], self.width, public=True)
        job, memory, rows, times = code.arguments
        total = self._job(code, job, "members") * times
        counter = self._job(code, job, "next_member")

        def take() -> Value:
            width = ir.Constant(INTEGER, self.width)
            return Value(code, code.builder.atomic_rmw("add", counter.it, width, "monotonic"))

        first = code.variable(take())
        with code.repeat_while(lambda: code.load(first, INTEGER) < total):
            for load in (True, False):
                with code.loop(self.width) as lane:
                    row = code.load(first, INTEGER) + lane
                    row = code.select(row < total, row, total - 1)
                    member = row / times
                    for i in range(self.states):
                        inside = self.state(code, memory, i, 0, lane)
                        outside = code.element(rows, row * self.states + i)
                        source, target = (outside, inside) if load else (inside, outside)
                        code.store(code.load(source, DOUBLE), target)
                    if load:
                        self._set(code, memory, "t", lane, self._time(code, job, member, row - member * times))
                        with code.loop(self.numbers) as i:
                            x = self._read(code, job, "params", member * self._job(code, job, "params_stride") + i)
                            code.store(x, self.place(code, memory, "params", i, lane))
                if load:
                    code.call(self.project, memory)
            code.store(take(), first)
        code.finish()

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
        position = [field for field, _ in Job._fields_].index(name)
        kind = _KINDS[dict(Job._fields_)[name]]
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


def _crosses(before: Value, after: Value, direction: int) -> Value:
    falls, rises = (before > 0.0) & (after <= 0.0), (before < 0.0) & (after >= 0.0)
    return falls if direction < 0 else rises if direction > 0 else falls | rises


def _power(code, x: Value, exponent: Value) -> Value:
    """x**exponent to one per cent, for 0 < −exponent < 1/4, which is all that the size of a step needs.

    The bits of a double, read as an integer, are nearly its logarithm; the parabolas mend the fractional part.
    """
    unit = float(2**52)
    bits = code.as_double(code.bits(x)) / unit - 1023.0
    whole = code.intrinsic("floor", bits)
    part = bits - whole
    log2 = whole + part * (1.34 - 0.34 * part)
    target = code.lanes_of(exponent) * log2
    whole = code.intrinsic("floor", target)
    part = target - whole
    return code.from_bits((whole + part * (0.66 + 0.34 * part) + 1023.0) * unit)


def _integer(code, x: int) -> Value:
    return code.as_value(x, INTEGER)


def _double(code, x: float) -> Value:
    return code.as_value(x, DOUBLE)


def _lanes(code, x: float) -> Value:
    return code.lanes_of(float(x))


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
