"""The forward-mode derivative of a batch of motions: every step moved along directions, from the first to the last.

A step y(t + h) = Σ yₖ hᵏ is a straight line of arithmetic from the state y₀ and the parameters (`_adjoint`). Along a
direction (δy₀, δp) all its numbers have tangents, which follow in the order of the step itself:

    zeroth order   δ of the acceleration and of what the recursion reads off it
    orders         δ of the Cauchy products, Σ' (δaⱼ bₖ₋ⱼ + aⱼ δbₖ₋ⱼ), then of the recursion
    end            δy(h) = Σ δyₖ hᵏ, and as much at every output within the step

The series of the motion is made once for all directions. Members stand in the lanes of a vector, and one direction
after the other is followed; or the directions of a single member do, whose own series is then computed without lanes.

A step that suits the motion may be too long for its tangents: about an equilibrium the series of the motion ends, that
of a tangent does not. So the last two terms of their series are measured, and `excess` says how large they became.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native._constants import MAX_ORDER
from lagjax._native._frame import Frame, Lane, Memory, Vectors, integers, job
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native._lanes import Lines, sincos_function
from lagjax._native._parts import MotionParts
from lagjax._native._replay import Replay
from lagjax._native._saltation import GuardTable, Saltation
from lagjax._native._tables import Tables
from lagjax._native._taylor import TaylorSeries, double, integer, is_large
from lagjax._program._differentiation import pushforward

# `y_dot` is the tangent of the start, and becomes that of the end.
JOB = job(
    "TangentJob",
    ("next_member", "ts", "params", "record", "first_step", "steps", "path_dot", "y_dot", "params_dot", "excess"),
    ("ts_stride", "params_stride", "members", "times", "order", "directions"),
    ("floor",),
)


class Tangent:
    """Builds the module; its public functions are `begin(job, memory, lanes)` and `run(job, memory, lanes, rounds)`.

    Vectors of the motion have `width` lanes, those of its tangents `lanes`: as many, for as many members, or more, for
    the directions of one.
    """

    job = JOB

    def __init__(
        self,
        parts: MotionParts,
        *,
        width: int,
        lanes: int,
    ):
        program, series, nesting, projection, borders, _ = parts
        n, states, pieces = series.size, 2 * series.size, parts.pieces
        jump = parts.jump_over_steps
        large = is_large(program, projection, times=2, more=() if jump is None else [jump.line])
        fields = {"active": 1, "next_begin": 1} | ({"moved": states} if projection is not None else {})
        if borders is not None:
            fields |= Saltation.fields(borders) | {"crossed": 1, "grazes": 1}
        self.motion = TaylorSeries(
            "tangent", parts, JOB, fields, large, width, keep_sums=True
        )  # fmt: skip
        self.n, self.states, self.series, self.lanes, self.numbers = n, states, series, lanes, self.motion.parameters
        self.saltation: Saltation | None = None
        if borders is not None and jump is not None:
            self.saltation = Saltation(self.motion, GuardTable(self.motion, borders), nesting.base, jump)
            self.motion.layout.extend_by(self.saltation.fields_along())
            self.note_border = self.saltation.note_end()
        self.layout = Memory(lanes, self._fields(), beside=self.motion.layout)
        sincos = sincos_function(self.motion.module, lanes, "sincos_of_tangents")
        look_up = self.motion.look_up
        self.form = Tables(self.function, sincos, look_up=look_up) if large else Lines(sincos, look_up)
        dtypes = program.dtypes
        # All but the time and the pieces.
        moving = dtypes[: len(dtypes) - pieces]
        self.varied = [i for i, dtype in enumerate(moving) if dtype.kind == "f" and i != states]
        self._derive(dtypes, projection)
        self.replay = Replay(self.motion)
        self.start_next = self.replay.start_next(self._begin_lane, lambda frame, lane, member: None)
        self.cauchy_products, self.recursion = self._cauchy_products(), self._recursion()
        steps = [self._take(), self._series(), self._end(), self._measure(), self._outputs(), self._leave()]
        if projection is not None:
            steps.insert(4, self._project())
        self._run(steps)
        self._begin()
        if self.form is not self.motion.form:
            self.form.finish()
        self.motion.finish()

    def _fields(self) -> dict:
        """The fields of the direction at hand, in every lane: the tangents of the motion's fields."""
        series, states = self.series, self.states
        fields = {
            "dy": (states, MAX_ORDER + 1),
            "drows": (series.rows, MAX_ORDER),
            "dsums": len(series.cauchy_products),
            "dvalues": series.values,
            "dparams": self.numbers,
            "end": states,  # of the step
            "between": states,  # at an output
        }
        numbers = "power", "power_before", "next_output", "s", "is_due", "excess", "first_number", "first_dot"
        return fields | dict.fromkeys(numbers, 1)

    def function(self, name: str, *kinds: ir.Type, **options) -> Frame:
        """A new function of the module, whose vectors are tangents."""
        return Frame(self.motion.module, self.layout, JOB, f"tangent_{name}", *kinds, **options)

    def _derive(self, dtypes: Sequence, projection) -> None:
        """The zeroth order, the order recursion and the projection, each moved along a direction."""
        series, n = self.series, self.n
        outputs = [*range(n), *range(n + 1, n + 1 + series.values)]
        self.zeroth_order = pushforward(series.zeroth_order, dtypes, self.varied, outputs, outputs)
        first, read = self.states + 3, series.values + len(series.cauchy_products)
        by, rows = [*range(self.states), *range(first, first + read)], range(n, n + series.rows)
        floats = [dtypes[0]] * (first + read)
        self.order_recursion = pushforward(series.order_recursion, floats, by, range(n + series.rows), rows)
        line = None if projection is None else projection.state.line
        self.projection = line and pushforward(line, dtypes, self.varied, range(self.states))

    # ---- numbers of the motion, in a function of its tangents ----

    def numbers_of(self, frame: Frame, name: str, count: int, place=lambda i: (i,), in_place: bool = False) -> Vectors:
        """Vectors of the motion; where it has no lanes, the same number in every lane.

        Those that are `in_place` lie where `place` says, which does not change.
        """
        motion, alike = frame.view(self.motion.layout), self.motion.width == self.lanes

        def read(i):
            address = motion.address(name, *place(i))
            return frame.code.lanes_of(frame.code.load(address, frame.vector if alike else DOUBLE))

        where = (lambda i: self.motion.layout.place(name, *place(i))) if alike and in_place else None
        return Vectors(count, read, None, where)

    def number_of(self, frame: Frame, name: str) -> Value:
        """One vector of the motion."""
        return self.numbers_of(frame, name, 1)[0]

    def lane_of_motion(self, frame: Frame, lane: Value) -> Lane:
        """The lane of the motion that a lane of tangents belongs to."""
        return frame.view(self.motion.layout).lane(lane if self.motion.width == self.lanes else lane * 0)

    def lanes_of_tangents(self, frame: Frame, lane: Value) -> list[Lane]:
        """The lanes of tangents that belong to a lane of the motion."""
        tangents, alike = frame.view(self.layout), self.motion.width == self.lanes
        return [tangents.lane(i) for i in ([lane] if alike else [integer(frame.code, j) for j in range(self.lanes)])]

    # ---- rounds ----

    def _begin(self) -> None:
        """`begin(job, memory, lanes)`: every lane takes a member."""
        frame = self.motion.function("begin", public=True)
        if self.form is not self.motion.form:
            self.form.prepare(frame)
        self.replay.begin(frame, self.start_next)
        frame.finish()

    def _run(self, steps: list[Code]) -> None:
        """`run(job, memory, lanes, rounds)`: this many rounds, or until the batch is done; one step in every lane.

        Returns 1 if there is more to do.
        """
        frame = self.motion.function("run", INTEGER, result=INTEGER, public=True)
        code, (rounds,) = frame.code, frame.arguments
        directions, per_group = frame.job("directions"), self.lanes // self.motion.width
        with self.replay.rounds(frame, rounds, self._leave_step):
            self._await_end(frame)
            if self.projection is not None:
                self._move(frame)
            with code.loop((directions + (per_group - 1)) / per_group) as group:
                for step in steps:
                    frame.call(step, group)
            if self.saltation is not None:
                frame.call(self.note_border)
        frame.finish(self.motion.is_unfinished(frame))

    def _move(self, frame: Frame) -> None:
        """The end of the series before it is put on the constraints."""
        motion = self.motion
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        for i in motion.form.each(frame.code, self.states):
            frame["moved", i] = moved[i]

    # ---- members and their steps ----

    def _begin_lane(self, frame: Frame, index: Value) -> None:
        lane = frame.lane(index)
        lane["step"], lane["output"] = 0, 1
        for tangents in self.lanes_of_tangents(frame, index):
            tangents["excess"] = 0.0
        if self.saltation is not None:
            lane["is_hit"] = 0.0

    def _await_end(self, frame: Frame) -> None:
        """Set the beginning of the next step of every lane, up to which outputs belong to this one."""
        code = frame.code
        with code.loop(self.motion.width) as index:
            lane = frame.lane(index)
            with code.only_if(lane["member"] >= 0):
                lane["next_begin"] = lane["h"] * float("inf")  # of the last step: all outputs that are left
                with code.only_if(lane["step"] + 1 < frame.read("steps", lane["member"], INTEGER)):
                    lane["next_begin"] = self.replay.begin_of_next(frame, lane)

    def _leave_step(self, frame: Frame, lane: Lane, index: Value) -> None:
        """One step more; after the last one, write down how large the last terms were and take the next member."""
        code, member, tangents = frame.code, lane["member"], self.lanes_of_tangents(frame, index)
        lane["step"] = lane["step"] + 1
        lane["output"] = code.as_integer(tangents[0]["next_output"])
        with code.only_if(lane["step"] >= frame.read("steps", member, INTEGER)):
            largest = double(code, 0.0)
            for of_lane in tangents:
                largest = code.maximum(of_lane["excess"], largest)
            frame.write("excess", member, largest)
            frame.call(self.start_next, index)

    # ---- one step along one direction in every lane; `group` numbers the directions ----

    def _step(self, name: str) -> tuple[Frame, Code, Value]:
        frame = self.function(name, INTEGER)
        return frame, frame.code, frame.arguments[0]

    def _place(self, frame: Frame, group: Value, index: Value) -> tuple[Value, Value]:
        """The number of a lane's direction, counted over all members; and whether there is such a direction."""
        member, directions = self.lane_of_motion(frame, index)["member"], frame.job("directions")
        direction = group if self.motion.width == self.lanes else group * self.lanes + index
        return member * directions + direction, (member >= 0) & (direction < directions)

    def _take(self) -> Code:
        """`(group)`: the tangents of the state and of the parameters; zero where there is no such direction."""
        frame, code, group = self._step("take")
        for i in self.form.each(code, self.states):
            frame["dy", i, 0] = 0.0
        for i in self.form.each(code, self.numbers):
            frame["dparams", i] = 0.0
        with code.loop(self.lanes) as index:
            lane, (place, there) = frame.lane(index), self._place(frame, group, index)
            lane["next_output"] = code.as_double(self.lane_of_motion(frame, index)["output"])
            lane["first_number"] = self.lane_of_motion(frame, index)["first_number"]
            first = place * self.motion.member_stride
            lane["first_dot"] = code.select(there, code.as_double(first), 0.0)
            with code.only_if(there):
                for i in self.form.each(code, self.states):
                    lane["dy", i, 0] = frame.read("y_dot", place * self.states + i)
                with code.loop(self.numbers) as i:
                    lane["dparams", i] = frame.read("params_dot", first + self.motion.place_of_number(code, i))
        if self.saltation is not None:
            is_hit = self.number_of(frame, "is_hit") > 0.0
            with code.only_if(code.any_lane(is_hit)):
                self._jump(frame, self.saltation, is_hit)
        return frame.finish()

    def _jump(self, frame: Frame, saltation: Saltation, is_hit: Value) -> None:
        """The tangents behind a border, at the beginning of the step from there."""
        form, n, behind = self.form, self.n, self.motion.parameters
        base, jump = saltation.base, saltation.jump

        def numbers(name, count, first=0):
            return self.numbers_of(frame, name, count, lambda i: (i + first,), in_place=True)

        tangents = [frame.vectors("dy", n, lambda i: (i, 0)), frame.vectors("dy", n, lambda i: (i + n, 0))]
        inputs = saltation.edge_inputs(numbers, numbers("params", self.motion.pieces, behind))
        out = form.run(frame, jump.line, *inputs, *tangents, frame.vectors("dparams", self.numbers))
        added = saltation.tangent_jumps(frame, out, self.number_of(frame, "is_hit"), self.number_of(frame, "grazes"))
        for row in range(jump.lower):
            for part in range(2):
                for i in form.each(frame.code, base):
                    place = i + (part * n + row * base)
                    frame["dy", place, 0] = frame["dy", place, 0] + added(jump.lower + row, i, part)

    def _tangent_inputs(self, frame: Frame, state: Vectors, t: Value, tangents: Vectors) -> list:
        """The inputs of a program at a state, and their tangents: those of the state, and of the parameters."""
        params = self.numbers_of(frame, "params", self.motion.numbers, in_place=True)
        of_params = [i - self.states - 1 for i in self.varied[self.states :]]
        moving: Any = [frame["dparams", i] for i in of_params]
        if of_params == list(range(self.numbers)):  # none are integers
            moving = frame.vectors("dparams", self.numbers)
        return [state, [t], params, tangents, moving]

    def _series(self) -> Code:
        """`(group)`: the series of the tangents of the state."""
        frame, code, _ = self._step("series")
        n, form, products = self.n, self.form, len(self.series.cauchy_products)
        state = self.numbers_of(frame, "y", self.states, lambda i: (i, 0), in_place=True)
        accelerations = self.numbers_of(frame, "y", n, lambda i: (i + n, 1))
        values = self.numbers_of(frame, "values", self.series.values, in_place=True)
        tangents = frame.vectors("dy", self.states, lambda i: (i, 0))
        inputs = self._tangent_inputs(frame, state, self.number_of(frame, "t"), tangents)
        to = frame.vectors("dvalues", self.series.values)
        out = form.run(frame, self.zeroth_order, *inputs, accelerations, values, to=to)
        for i in form.each(code, n):
            frame["dy", i, 1] = frame["dy", i + n, 0]
            frame["dy", i + n, 1] = out[i]
        for i in form.each(code, products):
            frame["dsums", i] = 0.0
        with code.loop(frame.job("order"), start=1) as k:
            with code.only_if(k > 1):
                frame.call(self.cauchy_products, k)
            frame.call(self.recursion, k)
        return frame.finish()

    def _cauchy_products(self) -> Code:
        """`(k)`: Σ' (δaⱼ bₖ₋ⱼ + aⱼ δbₖ₋ⱼ) for every product, 0 < j < k."""
        frame, code, k = self._step("cauchy_products")
        pairs = self.series.cauchy_products
        mixed, squares = ([p for p in pairs if (p[0] == p[1]) == square] for square in (False, True))
        tables = [self._table(some) for some in (mixed, squares)]
        for order in code.cases(k, range(2, MAX_ORDER)):
            for table, some, first in zip(tables, (mixed, squares), (0, len(mixed)), strict=True):
                if some:
                    with code.loop(len(some)) as i:
                        total = self._product(frame, Value(code, table), i, order, first > 0 or not mixed)
                        frame["dsums", i + first] = total
        return frame.finish()

    def _table(self, pairs) -> ir.GlobalVariable:
        """The rows of each product, in numbers of a row."""
        flat = [row * MAX_ORDER for pair in pairs for row in pair]
        return integers(self.motion.module, np.array(flat or [0], np.int64))

    def _product(self, frame: Frame, table: Value, i: Value, order: int, square: bool) -> Value:
        """Σ' (δaⱼ bₖ₋ⱼ + aⱼ δbₖ₋ⱼ) at order k, of one product; twice the first half of it, of a square."""
        code, motion = frame.code, frame.view(self.motion.layout)
        shared = self.motion.width < self.lanes

        def row(which):
            offset = code.load(code.element(table, i * 2 + which, INTEGER), INTEGER)
            of_motion = code.element(motion.address("rows"), offset * self.motion.width)
            tangents = code.element(frame.address("drows"), offset * self.lanes)
            return (
                lambda j: code.lanes_of(
                    code.load(code.element(of_motion, j * self.motion.width), DOUBLE if shared else frame.vector)
                ),
                lambda j: code.load(code.element(tangents, j * self.lanes), frame.vector),
            )

        (a, da), (b, db) = row(0), row(1)
        strands: list = [None, None]  # that do not wait for each other
        for j in range(1, order):
            terms = [da(j) * b(order - j)] if square else [da(j) * b(order - j), db(j) * a(order - j)]
            for k, term in enumerate(terms):
                strand = (j + k) % 2
                strands[strand] = term if strands[strand] is None else term + strands[strand]
        total = strands[0] if strands[1] is None else strands[1] if strands[0] is None else strands[0] + strands[1]
        return total + total if square else total

    def _recursion(self) -> Code:
        """`(k)`: the tangents of the rows at order k, and of the state at order k + 1."""
        frame, code, k = self._step("recursion")
        n, series, form, products = self.n, self.series, self.form, len(self.series.cauchy_products)
        number = code.as_double(k)
        time = code.select(code.compare("==", k, 1), number, 0.0)
        inverse = 1.0 / code.as_double(k + 1)
        out = form.run(
            frame, self.order_recursion,
            self.numbers_of(frame, "y", self.states, lambda i: (i, k)),
            [code.lanes_of(x) for x in (time, number, 1.0 / number)],
            self.numbers_of(frame, "values", series.values, in_place=True),
            self.numbers_of(frame, "sums", products, lambda i: (k, i)),
            Vectors(self.states, lambda i: frame["dy", i, k]),
            frame.vectors("dvalues", series.values),
            frame.vectors("dsums", products),
            self.numbers_of(frame, "rows", series.rows, lambda i: (i, k)),
            to=frame.vectors_at("drows", series.rows, k),
        )  # fmt: skip
        for i in form.each(code, n):
            frame["dy", i, k + 1] = frame["dy", i + n, k] * inverse
            frame["dy", i + n, k + 1] = out[i] * inverse
        return frame.finish()

    def _sum(self, frame: Frame, name: str, s: Value, powers: bool = False) -> None:
        """Σ δyₖ sᵏ into a field; the last two powers stay in memory."""
        code, power, order = frame.code, frame.code.variable(frame.constant(1.0)), frame.job("order")
        for i in self.form.each(code, self.states):
            frame[name, i] = frame["dy", i, 0]
        with code.loop(order, start=0) as k:
            before = power.value
            now = before * s
            for i in self.form.each(code, self.states):
                frame[name, i] = frame[name, i] + frame["dy", i, k + 1] * now
            power.value = now
            if powers:
                frame["power_before"], frame["power"] = before, now

    def _end(self) -> Code:
        """`(group)`: the tangents of the state at the end of the series."""
        frame, _, _ = self._step("end")
        self._sum(frame, "end", self.number_of(frame, "h"), powers=True)
        return frame.finish()

    def _measure(self) -> Code:
        """`(group)`: the largest of the last two terms, relative to the tangent itself; of coordinates, of velocities.

        What is smaller than the `floor` counts as that: a tangent that is zero consists of rounding.
        """
        frame, code, _ = self._step("measure")
        order, powers = frame.job("order"), [frame["power_before"], frame["power"]]

        def size(x):
            return code.intrinsic("fabs", x)

        def last_terms(first):
            return lambda i: code.maximum(
                *(size(frame["dy", i + first, order - (1 - k)] * power) for k, power in enumerate(powers))
            )

        def whole(first):
            return lambda i: code.maximum(size(frame["dy", i + first, 0]), size(frame["end", i + first]))

        for first in (0, self.n):
            terms, scale = (self.form.largest(code, of(first), self.n) for of in (last_terms, whole))
            frame["excess"] = code.maximum(terms / code.maximum(scale, frame.job("floor")), frame["excess"])
        return frame.finish()

    def _outputs(self) -> Code:
        """`(group)`: the tangents of the outputs from the beginning of the step to that of the next one."""
        frame, code, group = self._step("outputs")
        frame["is_due"] = 1.0
        with code.repeat_while(lambda: code.any_lane(frame["is_due"] > 0.0)):
            with code.loop(self.lanes) as index:
                self._await_output(frame, index)
            with code.only_if(code.any_lane(frame["is_due"] > 0.0)):
                self._sum(frame, "between", frame["s"])
                with code.loop(self.lanes) as index:
                    self._write_output(frame, index, group)
        return frame.finish()

    def _await_output(self, frame: Frame, index: Value) -> None:
        """The lanes whose next output lies in the step, and its distance from the beginning."""
        code, lane, of_motion = frame.code, frame.lane(index), self.lane_of_motion(frame, index)
        member, output = of_motion["member"], code.as_integer(lane["next_output"])
        inside = (member >= 0) & (output < frame.job("times") - 1)
        at = frame.time(code.select(inside, member, 0), code.select(inside, output, 0))
        due = inside & ((at - of_motion["next_begin"]) * of_motion["h"] <= 0.0)
        lane["s"] = code.select(due, at - of_motion["t"], 0.0)
        lane["is_due"] = code.flag(due)

    def _write_output(self, frame: Frame, index: Value, group: Value) -> None:
        code, lane = frame.code, frame.lane(index)
        with code.only_if(lane["is_due"] > 0.0):
            output, (place, there) = code.as_integer(lane["next_output"]), self._place(frame, group, index)
            row = (place * frame.job("times") + output) * self.states
            with code.only_if(there):
                for i in self.form.each(code, self.states):
                    frame.write("path_dot", row + i, lane["between", i])
            lane["next_output"] = lane["next_output"] + 1.0

    def _project(self) -> Code:
        """`(group)`: the tangents of the state on the constraints, from those of the end of the series."""
        assert self.projection is not None
        frame, code, _ = self._step("projected")
        moved = self.numbers_of(frame, "moved", self.states, in_place=True)
        t = self.number_of(frame, "t") + self.number_of(frame, "h")
        inputs = self._tangent_inputs(frame, moved, t, frame.vectors("end", self.states))
        out = self.form.run(frame, self.projection, *inputs)
        for i in self.form.each(code, self.states):
            frame["between", i] = out[i]
        for i in self.form.each(code, self.states):
            frame["end", i] = frame["between", i]
        return frame.finish()

    def _leave(self) -> Code:
        """`(group)`: write down the tangents of the end of the step, with which the next one begins."""
        frame, code, group = self._step("leave")
        with code.loop(self.lanes) as index:
            lane, (place, there) = frame.lane(index), self._place(frame, group, index)
            with code.only_if(there):
                for i in self.form.each(code, self.states):
                    frame.write("y_dot", place * self.states + i, lane["end", i])
        return frame.finish()
