"""The integration of a batch by Taylor series, as two functions of LLVM: one begins, one runs so many rounds.

Every lane of a vector carries one member. A round takes one step in each lane:

    coefficients   q and q̇ as power series about the present time (see `_program._series`)
    choose         the step that the last two coefficients allow, per lane
    check          the series must satisfy the equations of motion along the step, or the step is halved
    advance        outputs inside the step, then the state at its end, summed with its rounding errors carried along
    finish         a lane whose member has ended takes the next one of the batch

so that no lane waits for another. Several threads may do so at once: they share the counter that hands out the members.

Step size: with the scaled norm ‖c‖ = max |cᵢ| / (atol + rtol·sᵢ), sᵢ the size of component i over the step,

    h = 0.9 min(‖yₚ‖^(−1/p), ‖yₚ₋₁‖^(−1/(p−1)))

makes the last terms of the series as small as the tolerance. Source: Jorba & Zou, Exp. Math. 14 (2005) §3.2. The check
is ours: the defect d = P″ − q̈(P, P′) of the polynomial P, at the middle and at the end of the step, must obey
h ‖d‖ / (p+1) ≤ 1. It costs two accelerations, and sees what no coefficient shows: a border of a piecewise function, a
narrow feature ahead.
"""

import ctypes
import functools
from collections.abc import Iterator

from llvmlite import ir

from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value
from lagjax._native._lanes import emit
from lagjax._native._series_code import SeriesCode, double, integer
from lagjax._program import Program, Series, StraightLine

SAFETY = 0.9
ROUND_OFF = 256 * 2.0**-52  # of an acceleration
PLACES, LARGEST_UNIT = 16, 1e-6  # units in the last place of a coordinate; of what an acceleration varies

# Guards, and where they change sign.
INTERVALS = 8  # of a step, at whose ends they are looked at
BETWEEN = (1.382, 5.236)  # two places more, in intervals
_SAMPLES = INTERVALS + 3 + len(BETWEEN)
JUMP = 2.0**20  # smallest steps: where a guard varies too fast for so short a step, it jumps
BISECTIONS = 60  # of an interval, to find the zero: beyond the digits of a double
SECTIONS, GOLDEN = 32, 0.6180339887498949  # to find where it is least: to half of the digits
TOUCHING = 1e-13  # of its size nearby: what goes no further through the surface has touched it
GUARD_NOISE, LITTLE = 64 * 2.0**-52, 1e-4  # rounding; of the step
# A series that ends (free flight) allows any step, and a step that is too long sees nothing of what lies inside it.
FIRST_STEP, GROWTH, GROWTH_AFTER_REJECTION = 1 / 16, 5.0, 2.0  # of the whole time; of the step before
SMALLEST_STEP = 4 * 2.0**-52  # of the largest time: below this a step no longer moves the time reliably
LANDING = 16.0  # tolerances from the end of a series to the constraints, at most
# Next to where constraints become dependent, rounding allows no step longer than the way there: steps become ever
# shorter, and none gets through. When they have become `SHORTER` by so much the last long one is taken once more, by a
# tenth shorter each time, so that it ends farther away and the next one gets through; so often at most.
SHORTER, RETAKEN, MOST_RETURNS = 1 / 64, 0.9, 16
START = 1e-5  # of the size of the state, the same for the first step
CHECKS = (0.5, 1.0)  # where in the step its series is held against the equations

# How a member ended.
DONE, OUT_OF_STEPS, STEP_TOO_SMALL, NOT_FINITE, SINGULAR, NOT_LANDED, DISCONTINUOUS, EVENT = range(8)
# The kernel itself does not give `DISCONTINUOUS`: `_stopped` finds it about the state where it stopped.
# EVENT + Σ 4ᵏ (1 where guard k falls, 2 where it rises), over those that do so at that instant.
_RUNNING = -1


class Job(ctypes.Structure):
    """What all threads work on: eight bytes for each entry."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in (
            "next_member", "ts", "y0", "params", "path", "y_end", "t_end", "code", "steps", "rejected", "record",
            "first_step",
        )),
        # From one member to the next: 0 where all share the output times, or the parameters.
        *((name, ctypes.c_int64) for name in ("ts_stride", "params_stride")),
        *((name, ctypes.c_int64) for name in ("members", "times", "order", "max_steps", "recording")),
        *((name, ctypes.c_double) for name in ("rtol", "atol")),
    ]  # fmt: skip


# Doubles of a lane. `due` and `reached` are times in the direction of time; `active`, `last`, `singular` are 1 or 0.
_OF_A_LANE = (
    "t_low", "t_end", "forward", "smallest", "due", "reached", "worst", "active", "last", "code", "steps", "rejected",
    "longest", "growth", "planned", "event", "by_series", "is_due",
)  # fmt: skip


class Integrator(SeriesCode):
    """Builds the module. `memory` is what a thread needs, in doubles; `width` the lanes.

    Coordinates of one of the `groups` are measured by the largest of them. The first `own` coordinates are the motion,
    the others derivatives of it, which follow where it lands.
    """

    def __init__(self, program: Program, series: Series, projection=None, guards=None, groups=None, own=None):
        self.groups = tuple(range(series.size)) if groups is None else groups
        self.own = series.size if own is None else own
        self.projection, self.guards = projection, guards
        self.directions = () if guards is None else guards.directions
        sizes = {
            "low": 2 * series.size,  # what rounding took from the state
            "scale": 2 * series.size,
            "increment": 2 * series.size,
            "between": 2 * series.size,  # the state at an output time
            **({} if projection is None else self._sizes_of_constraints(series.size)),
            **dict.fromkeys(("guard", "side", "noise", "root", "change"), len(self.directions)),
            "samples": _SAMPLES * len(self.directions),
            **dict.fromkeys(_OF_A_LANE, 1),
        }
        super().__init__("motion", program, series, Job, sizes)
        self.defect = self._defect()
        self.start_next = self._start_next()
        self.land = None if projection is None else self._land()
        if guards is not None:
            self.guard = self._guard()
            self.begin_sides = self._begin_sides()
        self._begin()
        self._run()

    def _sizes_of_constraints(self, n: int) -> dict[str, int]:
        before = {"y_before": 2 * n, "low_before": 2 * n, "side_before": len(self.directions)}
        lanes = dict.fromkeys(("t_before", "t_low_before", "steps_before", "h_before", "returns", "returned"), 1)
        return {"landed": 2 * n, "speeds": self.own, **before, **lanes}

    # ---- along the step ----

    def _defect(self) -> Code:
        """`(memory, order, place)`: h ‖P″ − q̈(P, P′)‖ / (p+1) at that place of the step, into `worst` if larger.

        The increment P − y stays in memory.
        """
        code = Code(self.module, "defect", [POINTER, INTEGER, DOUBLE], self.width)
        memory, order, place = code.arguments
        h, n = self._vector(code, memory, "h"), self.n
        s = code.lanes_of(place) * h
        increments, slopes = self.increments(code, memory, order, s)
        moved = []
        for i, increment in enumerate(increments):
            code.store(increment, self.place(code, memory, "increment", i))
            moved.append(code.load(self.state(code, memory, i), self.vector) + increment)
        now = self.now(code, memory)

        def then(i):
            return moved[i] if i < self.states else now(i) + s if i == self.states else now(i)

        line = StraightLine(self.program.nodes, self.program.kinds, self.program.outputs[:n])
        acceleration = emit(code, line, then, self.sincos)
        worst = self._vector(code, memory, "worst")
        weight = code.intrinsic("fabs", h) / code.as_double(order + 1)
        size = self._by_group(code, [code.intrinsic("fabs", a) for a in acceleration])
        # Half a unit in the last place of q moves an acceleration by what it varies along the step, in proportion.
        place = functools.reduce(code.maximum, (code.intrinsic("fabs", q) for q in moved[:n]))
        moves = functools.reduce(code.maximum, (code.intrinsic("fabs", dq) for dq in increments[:n]))
        unit = (PLACES * 2.0**-52) * place / moves
        unit = code.select(unit < LARGEST_UNIT, unit, 0.0)  # what hardly moves is not what makes it vary
        for i in range(n):
            # What rounding leaves of an acceleration is not a defect of the series.
            before = code.load(self.state(code, memory, n + i, 1), self.vector)
            change = code.intrinsic("fabs", acceleration[i] - before)
            noise = ROUND_OFF * size[i] + unit * change
            excess = code.intrinsic("fabs", acceleration[i] - slopes[i]) - noise
            error = weight * excess * self._vector(code, memory, "scale", n + i)
            worst = code.select(error <= worst, worst, error)  # NaN goes through
        self._keep(code, memory, "worst", worst)
        return code.finish()

    # ---- the rounds ----

    def _start_next(self) -> Code:
        """`(memory, lanes, job, lane)`: the lane takes the next member, or none is left."""
        code = Code(self.module, "start_next", [POINTER, POINTER, POINTER, INTEGER], self.width)
        memory, lane_data, job, lane = code.arguments
        counter = self._job(code, job, "next_member")
        member = Value(code, code.builder.atomic_rmw("add", counter.it, ir.Constant(INTEGER, 1), "monotonic"))
        there = member < self._job(code, job, "members")
        code.store(code.select(there, member, -1), self._lane(code, lane_data, "member", lane))
        constrained = () if self.projection is None else ("h_before", "returns", "returned")
        for name in ("h", "t_low", "steps", "rejected", *constrained):
            self._set(code, memory, name, lane, 0.0)
        self._set(code, memory, "active", lane, code.select(there, double(code, 1.0), 0.0))
        self._set(code, memory, "code", lane, float(_RUNNING))
        self._set(code, memory, "due", lane, float("inf"))
        self._set(code, memory, "event", lane, -1.0)
        with code.only_if(there):
            begin, end = (self._time(code, job, member, i) for i in (0, self._job(code, job, "times") - 1))
            self._set(code, memory, "t", lane, begin)
            self._set(code, memory, "t_end", lane, end)
            self._set(code, memory, "forward", lane, code.select(end > begin, double(code, 1.0), -1.0))
            largest = code.maximum(code.intrinsic("fabs", begin), code.intrinsic("fabs", end))
            self._set(code, memory, "smallest", lane, SMALLEST_STEP * largest)
            self._set(code, memory, "longest", lane, code.intrinsic("fabs", end - begin) * FIRST_STEP)
            self._await_output(code, memory, lane_data, job, lane, integer(code, 1))
            for i in range(0 if self.projection is None else self.own):
                code.store(double(code, 0.0), self.place(code, memory, "speeds", i, lane))
            for i in range(self.states):
                x = self._read(code, job, "y0", member * self.states + i)
                code.store(x, self.state(code, memory, i, 0, lane))
                code.store(x, self._output(code, job, member, 0, i))
                code.store(double(code, 0.0), self.place(code, memory, "low", i, lane))
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

    def _begin(self) -> None:
        """`begin(job, memory, lanes)`: every lane takes a member."""
        code = Code(self.module, "begin", [POINTER, POINTER, POINTER], self.width, public=True)
        job, memory, lane_data = code.arguments
        with code.loop(self.width) as lane:
            code.call(self.start_next, memory, lane_data, job, lane)
        code.finish()

    def _run(self) -> None:
        """`run(job, memory, lanes, idle, rounds)`: so many rounds, or until the batch is done.

        Returns 1 if there is more to do. `idle` counts the lanes without a member.
        """
        code = Code(self.module, "run", [POINTER] * 4 + [INTEGER], self.width, INTEGER, public=True)
        job, memory, lane_data, idle, rounds = code.arguments
        order = self._job(code, job, "order")
        with self.rounds(code, memory, rounds):
            code.call(self.coefficients, memory, order)
            self._choose(code, memory, job, order)
            self._halve_until_sound(code, memory, job, order)
            if self.land is not None:
                self._return_or_remember(code, memory)
            if self.guards is not None:
                self._stop_at_events(code, memory, order)
            with code.only_if(self._job(code, job, "recording") > 0), code.loop(self.width) as lane:
                self._record(code, memory, lane_data, job, lane)
            self._move_time(code, memory, lane_data, job, order)
            self._advance(code, memory)
            if self.land is not None:
                self._shorten(code, memory)
            self._end_or_go_on(code, memory, lane_data, job, idle)
        code.finish(self.more(code, memory))

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
        ending = code.select(small, code.lanes_of(STEP_TOO_SMALL), float(_RUNNING))
        ending = code.select(sound, ending, code.select(singular, code.lanes_of(SINGULAR), float(NOT_FINITE)))
        self._keep(code, memory, "code", ending)
        self._keep(code, memory, "h", code.select(going, step * forward, 0.0))
        self._keep(code, memory, "last", code.select(going & is_last, code.lanes_of(1), 0.0))

    def _errors(self, code, memory, job, order) -> tuple[Value, Value]:
        """The scaled norms of the last two coefficients; `scale` keeps 1 / (atol + rtol·size)."""
        rtol, atol = (code.lanes_of(self._job(code, job, name)) for name in ("rtol", "atol"))
        before = code.intrinsic("fabs", self._vector(code, memory, "h"))
        errors = [code.lanes_of(0.0), code.lanes_of(0.0)]

        n = self.n

        def largest(i):
            # A component that passes through zero is as large as it will be a step away.
            y, rate = (code.intrinsic("fabs", code.load(self.state(code, memory, i, k), self.vector)) for k in range(2))
            if self.projection is not None and i % n < self.own:
                speed = self._vector(code, memory, "speeds", i % n)
                y, rate = (y, code.maximum(rate, speed)) if i < n else (code.maximum(y, speed), rate)
            return code.maximum(y, rate * before)

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
        again = code.variable(integer(code, 1))
        with code.repeat_while(lambda: code.load(again, INTEGER) > 0):
            code.store(integer(code, 0), again)
            self._keep(code, memory, "worst", code.lanes_of(0.0))
            for place in CHECKS:
                code.call(self.defect, memory, order, double(code, place))
            if self.land is not None:
                self._keep(code, memory, "by_series", self._vector(code, memory, "worst"))
                code.call(self.land, memory)
            h = self._vector(code, memory, "h")
            bad = ~(self._vector(code, memory, "worst") <= 1.0) & code.compare("!=", h, 0.0)
            with code.only_if(code.any_lane(bad)):
                code.store(integer(code, 1), again)
                half = 0.5 * h
                small = bad & (code.intrinsic("fabs", half) < self._vector(code, memory, "smallest"))
                rejected = self._vector(code, memory, "rejected")
                ending = self._vector(code, memory, "code")
                self._keep(code, memory, "h", code.select(small, 0.0, code.select(bad, half, h)))
                self._keep(code, memory, "code", code.select(small, self._reason(code, memory), ending))
                self._keep(code, memory, "rejected", rejected + code.select(bad, code.lanes_of(1), 0.0))
                last = self._vector(code, memory, "last")
                self._keep(code, memory, "last", code.select(bad, 0.0, last))
                growth = self._vector(code, memory, "growth")
                self._keep(code, memory, "growth", code.select(bad, GROWTH_AFTER_REJECTION, growth))

    def _reason(self, code, memory) -> Value:
        """Why no step is small enough: the series, or only the way from its end to the constraints."""
        reason = code.lanes_of(STEP_TOO_SMALL)
        if self.land is None:
            return reason
        return code.select(self._vector(code, memory, "by_series") <= 1.0, code.lanes_of(NOT_LANDED), reason)

    def _record(self, code, memory, lane_data, job, lane) -> None:
        """Time, size and first state of the step, where a member has room for it."""
        member = code.load(self._lane(code, lane_data, "member", lane), INTEGER)
        with code.only_if((member >= 0) & code.compare("!=", self._get(code, memory, "h", lane), 0.0)):
            steps = code.as_integer(self._get(code, memory, "steps", lane))
            first, after = (
                code.load(code.element(self._job(code, job, "first_step"), member + k, INTEGER), INTEGER)
                for k in range(2)
            )
            with code.only_if(first + steps < after):
                places = [self.place(code, memory, name, 0, lane) for name in ("t", "h")]
                places += [self.state(code, memory, i, 0, lane) for i in range(self.states)]
                for k, place in enumerate(places):
                    row = (first + steps) * len(places) + k
                    code.store(code.load(place, DOUBLE), code.element(self._job(code, job, "record"), row))

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
        self._outputs(code, memory, lane_data, job, order, moving)
        self._keep(code, memory, "t", code.select(moving, after, t))
        self._keep(code, memory, "t_low", code.select(moving, rest, low))

    def _outputs(self, code, memory, lane_data, job, order, moving) -> None:
        """The states at the output times before the end of the step, one of every lane at a time."""
        t, low = self._vector(code, memory, "t"), self._vector(code, memory, "t_low")
        forward, reached = self._vector(code, memory, "forward"), self._vector(code, memory, "reached")

        def due():
            return moving & (self._vector(code, memory, "due") <= reached)

        with code.repeat_while(lambda: code.any_lane(due())):
            there = due()
            s = code.select(there, (self._vector(code, memory, "due") * forward - t) - low, 0.0)
            increments, _ = self.increments(code, memory, order, s)
            values = [
                code.load(self.state(code, memory, i), self.vector) + (dy + self._vector(code, memory, "low", i))
                for i, dy in enumerate(increments)
            ]
            if self.land is not None:
                landed, off = self._landed(code, memory, values, increments, s)
                values = [code.select(off <= 1.0, on, value) for on, value in zip(landed, values, strict=True)]
            for i, value in enumerate(values):
                self._keep(code, memory, "between", value, i)
            self._keep(code, memory, "is_due", code.select(there, code.lanes_of(1.0), 0.0))
            with code.loop(self.width) as lane, code.only_if(self._get(code, memory, "is_due", lane) > 0.0):
                member, index = (
                    code.load(self._lane(code, lane_data, name, lane), INTEGER) for name in ("member", "output")
                )
                for i in range(self.states):
                    value = code.load(self.place(code, memory, "between", i, lane), DOUBLE)
                    code.store(value, self._output(code, job, member, index, i))
                self._await_output(code, memory, lane_data, job, lane, index + 1)

    def _advance(self, code, memory) -> None:
        """y + h y₁ + …, with what rounding takes carried to the next step; and one step more on the count."""
        h = self._vector(code, memory, "h")
        moving = code.compare("!=", h, 0.0)
        self._keep(code, memory, "longest", code.intrinsic("fabs", h) * self._vector(code, memory, "growth"))
        for i in range(self.states):
            y, low = code.load(self.state(code, memory, i), self.vector), self._vector(code, memory, "low", i)
            total, rest = self._sum(code, memory, i)
            if self.land is not None:
                total = self._vector(code, memory, "landed", i)
            code.store(code.select(moving, total, y), self.state(code, memory, i))
            self._keep(code, memory, "low", code.select(moving, rest, low), i)
        steps = self._vector(code, memory, "steps")
        self._keep(code, memory, "steps", steps + code.select(moving, code.lanes_of(1), 0.0))

    def _sum(self, code, memory, i: int) -> tuple[Value, Value]:
        """A component at the end of the step, and what rounding takes from it."""
        y = code.load(self.state(code, memory, i), self.vector)
        increment = self._vector(code, memory, "increment", i) + self._vector(code, memory, "low", i)
        total = y + increment
        part = total - y
        return total, (y - (total - part)) + (increment - part)

    def _end_or_go_on(self, code, memory, lane_data, job, idle) -> None:
        """Write down the members that have ended, and take the next ones."""
        ending, steps, rejected = (self._vector(code, memory, name) for name in ("code", "steps", "rejected"))
        limit = code.as_double(self._job(code, job, "max_steps"))
        running = ending < 0.0
        is_last = self._vector(code, memory, "last") > 0.0
        ending = code.select(running & (steps + rejected >= limit), code.lanes_of(OUT_OF_STEPS), ending)
        ending = code.select(is_last, code.lanes_of(DONE), ending)
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
        increments, _ = self.increments(code, memory, order, s)
        moved = [code.load(self.state(code, memory, i), self.vector) + dy for i, dy in enumerate(increments)]
        now = self.now(code, memory)

        def then(i):
            return moved[i] if i < self.states else now(i) + s if i == self.states else now(i)

        program = self.guards.program
        line = StraightLine(program.nodes, program.kinds, program.outputs[: len(self.directions)])
        for i, value in enumerate(emit(code, line, then, self.sincos)):
            self._keep(code, memory, "guard", value, i)
        return code.finish()

    def _begin_sides(self) -> Code:
        """`(memory, order)`: for lanes at the start of a run, the side of each surface they are on, into `side`;
        and what rounding makes of a guard, into `noise`.

        On the surface, to rounding, it is the side that the motion goes to: by its rate or, where that is zero to
        rounding too, by where it is a little later.
        """
        code = Code(self.module, "begin_sides", [POINTER, INTEGER], self.width)
        memory, order = code.arguments
        count, program = len(self.directions), self.guards.program
        fresh = code.compare("==", self._vector(code, memory, "steps"), 0.0)
        with code.only_if(code.any_lane(fresh)):
            code.call(self.guard, memory, order, LITTLE * self._vector(code, memory, "h"))
            instant = 16.0 * self._vector(code, memory, "smallest")
            line = StraightLine(program.nodes, program.kinds, program.outputs)
            out = emit(code, line, self.now(code, memory), self.sincos)
            for i in range(count):
                value, rate, size, rate_size = out[i::count]
                moved = code.intrinsic("fabs", rate)
                on_it = code.intrinsic("fabs", value) <= GUARD_NOISE * size + moved * instant
                going = code.select(moved > GUARD_NOISE * rate_size, rate, self._vector(code, memory, "guard", i))
                for name, first in (("side", code.select(on_it, going, value)), ("noise", GUARD_NOISE * size)):
                    kept = self._vector(code, memory, name, i)
                    self._keep(code, memory, name, code.select(fresh, first, kept), i)
        return code.finish()

    def _stop_at_events(self, code, memory, order) -> None:
        """Where a guard changes sign along the step, the step ends there: at the earliest change of all guards."""
        code.call(self.begin_sides, memory, order)
        self._sample(code, memory, order)
        for i, direction in enumerate(self.directions):
            self._first_change(code, memory, order, i, direction)
        nearest = self._vector(code, memory, "h")
        changes = [self._vector(code, memory, "change", i) for i in range(len(self.directions))]
        roots = [self._vector(code, memory, "root", i) for i in range(len(self.directions))]
        for change, root in zip(changes, roots, strict=True):
            sooner = (change > 0.0) & (code.intrinsic("fabs", root) < code.intrinsic("fabs", nearest))
            nearest = code.select(sooner, root, nearest)
        latest = code.intrinsic("fabs", nearest) + self._vector(code, memory, "smallest")  # the same instant
        event = code.lanes_of(0.0)
        for i, (change, root) in enumerate(zip(changes, roots, strict=True)):
            event = event + code.select(code.intrinsic("fabs", root) <= latest, change * float(4**i), 0.0)
        stops = event > 0.0
        self._keep(code, memory, "event", code.select(stops, event, -1.0))
        self._keep(code, memory, "last", code.select(stops, 0.0, self._vector(code, memory, "last")))
        self._keep(code, memory, "h", nearest)
        with code.only_if(code.any_lane(code.compare("!=", nearest, self._vector(code, memory, "planned")))):
            code.call(self.defect, memory, order, double(code, 1.0))  # leaves the increment of the new step
            if self.land is not None:
                code.call(self.land, memory)

    def _sample(self, code, memory, order) -> None:
        """The guards at equal distances along the step and one beyond either end, into `samples`.

        Two more between them must be where the others say, or the step is too long to see what its guards do: it is
        halved.
        """
        self._keep(code, memory, "planned", self._vector(code, memory, "h"))
        again = code.variable(integer(code, 1))
        with code.repeat_while(lambda: code.load(again, INTEGER) > 0):
            h = self._vector(code, memory, "h")

            def keep(k, place, h=h):
                code.call(self.guard, memory, order, code.lanes_of(place / INTERVALS) * h)
                for i in range(len(self.directions)):
                    self._keep(code, memory, "samples", self._vector(code, memory, "guard", i), k + i * _SAMPLES)

            with code.loop(INTERVALS + 3) as k:
                keep(k, code.as_double(k) - 1.0)
            for k, place in enumerate(BETWEEN):
                keep(integer(code, INTERVALS + 3 + k), double(code, place))
            shortest = JUMP * self._vector(code, memory, "smallest")
            unseen = (code.intrinsic("fabs", h) > shortest) & self._unseen(code, memory)
            code.store(integer(code, 0), again)
            with code.only_if(code.any_lane(unseen)):
                code.store(integer(code, 1), again)
                self._keep(code, memory, "h", code.select(unseen, 0.5 * h, h))
                self._keep(code, memory, "last", code.select(unseen, 0.0, self._vector(code, memory, "last")))
                growth = self._vector(code, memory, "growth")
                self._keep(code, memory, "growth", code.select(unseen, GROWTH_AFTER_REJECTION, growth))

    def _unseen(self, code, memory) -> Value:
        """Where a guard is not what the cubic through four samples says, by more than a part of what it varies."""
        unseen = code.lanes_of(0.0) > 1.0
        for i in range(len(self.directions)):
            for k, place in enumerate(BETWEEN):
                first, x = int(place), place - int(place)
                four = [self._vector(code, memory, "samples", first + j + i * _SAMPLES) for j in range(4)]
                weights = (
                    -x * (x - 1) * (x - 2) / 6, (x + 1) * (x - 1) * (x - 2) / 2, -x * (x + 1) * (x - 2) / 2,
                    x * (x + 1) * (x - 1) / 6,
                )  # fmt: skip
                between = self._vector(code, memory, "samples", INTERVALS + 3 + k + i * _SAMPLES)
                said = functools.reduce(Value.__add__, (w * y for w, y in zip(weights, four, strict=True)))
                highest, lowest = four[0], four[0]
                for y in four[1:]:
                    highest, lowest = code.select(highest > y, highest, y), code.select(lowest < y, lowest, y)
                far, noise = code.intrinsic("fabs", between - said), self._vector(code, memory, "noise", i)
                matters = (far > 0.01 * code.intrinsic("fabs", between)) & (far > noise)
                unseen = unseen | (matters & (far > 0.05 * (highest - lowest)))
        return unseen

    def _first_change(self, code, memory, order, i: int, direction: int) -> None:
        """The first allowed change of sign of guard i: its time into `root`, and 1 (falls) or 2 (rises) into `change`.

        `change` is 0 where there is none. Signs of neighbouring samples differ where it crosses once; between samples
        of one sign it can still cross twice, about the least of them.
        """
        h = self._vector(code, memory, "h")
        moving, spacing = code.compare("!=", h, 0.0), h * (1.0 / INTERVALS)
        begin = self._vector(code, memory, "side", i)
        side, change, low, high = (
            code.variable(x) for x in (begin, code.lanes_of(0.0), code.lanes_of(0.0), code.lanes_of(0.0))
        )

        def found(where: Value, falls: Value, start: Value, end: Value) -> None:
            """Note the first one; `falls` where the sign before is positive."""
            allowed = falls if direction < 0 else ~falls if direction > 0 else code.lanes_of(0.0) <= 0.0
            new = where & allowed & (code.load(change, self.vector) <= 0.0) & moving
            code.store(code.select(new, start, code.load(low, self.vector)), low)
            code.store(code.select(new, end, code.load(high, self.vector)), high)
            kind = code.select(falls, code.lanes_of(1), 2.0)
            code.store(code.select(new, kind, code.load(change, self.vector)), change)

        with code.loop(INTERVALS + 1) as k:
            place = code.lanes_of(code.as_double(k))
            before, here, after = (self._vector(code, memory, "samples", k + (j + i * _SAMPLES)) for j in range(3))
            sign = code.load(side, self.vector)
            above = sign > 0.0
            values = [code.select(above, x, 0.0 - x) for x in (before, here, after)]
            noise, sided = self._vector(code, memory, "noise", i), above | (sign < 0.0)
            bend, tilt = values[0] - 2.0 * values[1] + values[2], values[2] - values[0]
            # The parabola through them comes down to half of the least, or so near that its error matters.
            deep = (4.0 * bend * values[1] < tilt * tilt) | (values[1] < 0.02 * bend)
            least = sided & deep & (values[1] > noise) & (values[1] < values[0]) & (values[1] <= values[2])
            least = least & moving & (code.load(change, self.vector) <= 0.0)
            with code.only_if(code.any_lane(least)):
                start = code.select(place > 0.0, place - 1.0, 0.0) * spacing
                end = code.select(place < float(INTERVALS), place + 1.0, float(INTERVALS)) * spacing
                bottom = self._bottom(code, memory, order, i, above, start, end)
                code.call(self.guard, memory, order, bottom)
                depth = self._vector(code, memory, "guard", i)
                depth = code.select(above, 0.0 - depth, depth)
                through = least & (depth > TOUCHING * (values[0] + values[2])) & (depth > noise)
                found(through, above, start, bottom)
                found(through, ~above, bottom, end)
            inside = place < float(INTERVALS)
            crosses = inside & ((above & (after < 0.0)) | (sided & ~above & (after > 0.0)))
            found(crosses, above, place * spacing, (place + 1.0) * spacing)
            passed = inside & (code.intrinsic("fabs", after) > 0.0)  # a zero, or a NaN, is on no side
            code.store(code.select(passed, after, sign), side)
        self._keep(code, memory, "side", code.load(side, self.vector), i)
        kind = code.load(change, self.vector)
        self._keep(code, memory, "change", kind, i)
        with code.only_if(code.any_lane(kind > 0.0)):
            root = self._root(code, memory, order, i, code.load(low, self.vector), code.load(high, self.vector), kind)
            self._keep(code, memory, "root", root, i)

    def _bottom(self, code, memory, order, i: int, above: Value, start: Value, end: Value) -> Value:
        """Where the size of guard i is least between two times, by golden sections."""
        low, high = code.variable(start), code.variable(end)
        with code.loop(SECTIONS):
            a, b = code.load(low, self.vector), code.load(high, self.vector)
            sizes, places = [], [b - (b - a) * GOLDEN, a + (b - a) * GOLDEN]
            for place in places:
                code.call(self.guard, memory, order, place)
                value = self._vector(code, memory, "guard", i)
                sizes.append(code.select(above, value, 0.0 - value))
            left = sizes[0] < sizes[1]
            code.store(code.select(left, a, places[0]), low)
            code.store(code.select(left, places[1], b), high)
        return 0.5 * (code.load(low, self.vector) + code.load(high, self.vector))

    def _root(self, code, memory, order, i: int, start: Value, end: Value, kind: Value) -> Value:
        """Where guard i changes sign, by bisection: the end of the bracket, where it has changed."""
        low, high, falls = code.variable(start), code.variable(end), kind < 1.5
        with code.loop(BISECTIONS):
            a, b = code.load(low, self.vector), code.load(high, self.vector)
            middle = 0.5 * (a + b)
            code.call(self.guard, memory, order, middle)
            value = self._vector(code, memory, "guard", i)
            same = code.select(falls, value, 0.0 - value) > 0.0
            code.store(code.select(same, middle, a), low)
            code.store(code.select(same, b, middle), high)
        return code.load(high, self.vector)

    # ---- constraints ----

    def _of_state(self, code, memory, program: Program, values, s) -> list[Value]:
        """A program at such a state, at t + s."""
        now = self.now(code, memory)

        def then(i):
            return values[i] if i < self.states else now(i) + s if i == self.states else now(i)

        return emit(code, StraightLine(program.nodes, program.kinds, program.outputs), then, self.sincos)

    def _landed(self, code, memory, values, increments, s) -> tuple[list[Value], Value]:
        """What the projection gives for a state of the series, at t + s; and how far that is, in `LANDING` tolerances.

        The series ends within the tolerance of the constraints. If it is much farther to the state that the projection
        finds, that is not the state of this motion: near a configuration where constraints become dependent there are
        several branches close together, and rounding of q decides on q̇.
        """
        landed, off = self._of_state(code, memory, self.projection.state, values, s), code.lanes_of(0.0)
        first = code.compare("==", self._vector(code, memory, "steps"), 0.0)
        for i in (*range(self.own), *range(self.n, self.n + self.own)):
            far = code.intrinsic("fabs", landed[i] - values[i])
            size = code.intrinsic("fabs", landed[i]) + code.intrinsic("fabs", increments[i])
            error = (far - ROUND_OFF * size) * self._vector(code, memory, "scale", i) * (1 / LANDING)
            # A start may be off by more, as much as is taken for consistent.
            error = code.select(first, far / (START * (1.0 + size)), error)
            off = code.select(error <= off, off, error)  # NaN goes through
        return landed, off

    def _return_or_remember(self, code, memory) -> None:
        """Back to where the last long step began, if steps have become too short since; or remember this beginning."""
        size, long = (code.intrinsic("fabs", self._vector(code, memory, name)) for name in ("h", "h_before"))
        returns, steps = self._vector(code, memory, "returns"), self._vector(code, memory, "steps")
        active, last, returned = (self._vector(code, memory, name) > 0.0 for name in ("active", "last", "returned"))
        back = (size < SHORTER * long) & active & ~last & (returns < float(MOST_RETURNS))
        forth = (size > 0.0) & ~back
        away = code.intrinsic("fabs", self._vector(code, memory, "t") - self._vector(code, memory, "t_before"))
        new = forth & ~returned & ((size >= 0.5 * long) | (away > 2.0 * long))
        undone = steps - self._vector(code, memory, "steps_before")
        for name, value in (
            ("h_before", code.select(new, size, long)),
            ("returns", code.select(back, returns + 1.0, code.select(new, 0.0, returns))),
            ("returned", code.select(back, code.lanes_of(1.0), 0.0)),
            ("rejected", self._vector(code, memory, "rejected") + code.select(back, undone + 1.0, 0.0)),
            ("code", code.select(back, float(_RUNNING), self._vector(code, memory, "code"))),
            ("h", code.select(back, 0.0, self._vector(code, memory, "h"))),
        ):
            self._keep(code, memory, name, value)
        for now, then in self._beginnings(code, memory):
            here, there = code.load(now, self.vector), code.load(then, self.vector)
            code.store(code.select(back, there, here), now)
            code.store(code.select(new, here, there), then)

    def _beginnings(self, code, memory) -> Iterator[tuple[Value, Value]]:
        """The addresses of what a step begins with, and of what the last long one began with."""
        for i in range(self.states):
            yield self.state(code, memory, i), self.place(code, memory, "y_before", i)
        one = dict.fromkeys(("t", "t_low", "steps"), 1)
        for name, count in {"low": self.states, "side": len(self.directions), **one}.items():
            for i in range(count):
                yield self.place(code, memory, name, i), self.place(code, memory, name + "_before", i)

    def _shorten(self, code, memory) -> None:
        """In the lanes that have just returned: the size of the next step, at most."""
        returned = self._vector(code, memory, "returned") > 0.0
        size, returns = self._vector(code, memory, "h_before"), self._vector(code, memory, "returns")
        for k in range(1, MOST_RETURNS + 1):
            size = code.select(returns >= float(k), RETAKEN * size, size)
        for name in ("h", "longest"):
            self._keep(code, memory, name, code.select(returned, size, self._vector(code, memory, name)))

    def _land(self) -> Code:
        """`(memory)`: the end of the step back on the constraints, into `landed`; how far it was, into `worst`."""
        code = Code(self.module, "land", [POINTER], self.width)
        (memory,) = code.arguments
        sums = [self._sum(code, memory, i)[0] for i in range(self.states)]
        increments = [self._vector(code, memory, "increment", i) for i in range(self.states)]
        h = self._vector(code, memory, "h")
        landed, off = self._landed(code, memory, sums, increments, h)
        for i, value in enumerate(landed):
            self._keep(code, memory, "landed", value, i)
        for i, value in enumerate(self._of_state(code, memory, self.projection.speeds, landed, h)):
            self._keep(code, memory, "speeds", value, i)
        worst = self._vector(code, memory, "worst")
        self._keep(code, memory, "worst", code.select(off <= worst, worst, off))
        return code.finish()


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
