"""The reverse-mode derivative of a batch of motions: the transpose of every step, from the last to the first.

A step y(t + h) = Σ yₖ hᵏ is a straight line of arithmetic from the state y₀ and the parameters: the zeroth order, and
the Cauchy products and the recursion of each order. Its transpose takes a cotangent λ of the state at the end of the
step to one at its beginning, and adds to the cotangents of the parameters:

    seed           ȳₖ = hᵏ λ, and sᵏ times the cotangent of every output within the step, at t + s
    orders         from the last to the first: the transposes of the Cauchy products, then of the recursion
    zeroth order   the transpose of the acceleration and of what the recursion reads off it
    λ              is ȳ₀ then

Every number it takes is one of the step itself, so the series is made once more from the recorded state. The cost is
that of two or three motions, however many parameters there are. Steps are those that were taken: as everywhere in
diffrax, their sizes are not differentiated. `excess` estimates whether they suit derivatives (see `_tangent`), from
what the transpose has at hand: the rates of the tangents, and the series that are multiplied.

Source: Griewank & Walther, *Evaluating Derivatives* (2008), §§3.2, 13.
"""

from llvmlite import ir

from lagjax._native._constants import MAX_ORDER, NEAR_ZERO
from lagjax._native._frame import Frame, Index, Lane, Numbers, Vectors, job
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native._parts import MotionParts
from lagjax._native._replay import Replay
from lagjax._native._saltation import GuardTable, Saltation
from lagjax._native._table_reads import lane_of
from lagjax._native._taylor import TaylorSeries, double, integer, is_large
from lagjax._program._differentiation import pullback, pullback_and_entries
from lagjax._program._look_ups import Table

# `y_ct` is the cotangent of the end, and becomes that of the start.
JOB = job(
    "AdjointJob",
    ("next_member", "ts", "params", "record", "first_step", "steps", "path_ct", "y_ct", "params_ct", "excess"),
    ("ts_stride", "params_stride", "members", "times", "order"),
)


class Adjoint:
    """Builds the module; its public functions are `begin(job, memory, lanes)` and `run(job, memory, lanes, rounds)`."""

    job = JOB

    def __init__(
        self,
        parts: MotionParts,
        *,
        width: int,
        number: ir.Type = DOUBLE,
    ):
        program, series, nesting, projection, borders, _ = parts
        n, states, pieces = series.size, 2 * series.size, parts.pieces
        fields = {
            "state_ct": states,  # the cotangent of the state
            "y_ct": (states, MAX_ORDER + 1),  # those of its coefficients
            "rows_ct": series.rows,
            "values_ct": series.values,
            "params_ct": program.size - states - 1 - pieces,
            "before": states,
            **dict.fromkeys(("active", "excess"), 1),
        }
        jump = parts.jump_over_steps
        if borders is not None:
            fields |= Saltation.fields(borders) | {"pieces_after": pieces, "has_after": 1, "crossed": 1, "grazes": 1}
        large = is_large(program, projection, times=2, more=() if jump is None else [jump.line] * 2)
        number = DOUBLE if large else number  # tables do not tell the time from the state
        self.motion = TaylorSeries(
            "adjoint", parts, JOB, fields, large, width, keep_sums=True, number=number
        )  # fmt: skip
        self.n, self.states, self.series = n, states, series
        dtypes = program.dtypes
        # All but the time and the pieces.
        moving = dtypes[: len(dtypes) - self.motion.pieces]
        self.varied = [i for i, dtype in enumerate(moving) if dtype.kind == "f" and i != states]
        self.zeroth_order, self.tables, self.order_recursion = self._transpose_programs(dtypes)
        self.replay = Replay(self.motion)
        self.start_next = self.replay.start_next(self._begin_lane, self._take_member)
        steps = [
            self._seed(),
            self._transpose_orders(self._transpose_sums(), self._transpose_recursion()),
            self._transpose_start(),
        ]
        if projection is not None:
            self.projection_line, self.tables_of_projection = pullback_and_entries(
                projection.state.line, dtypes, self.varied, range(states)
            )
            steps.insert(0, self._transpose_projection())
        if borders is not None and jump is not None:
            saltation = Saltation(self.motion, GuardTable(self.motion, borders), nesting.base, jump)
            steps = [self._transpose_border(saltation), *steps, self._note_after()]
        self._run(steps)
        self._begin()
        self.motion.finish()

    def _transpose_programs(self, dtypes):
        """The transposes of the zeroth order and of the order recursion."""
        series, n = self.series, self.n
        outputs = [*range(n), *range(n + 1, n + 1 + series.values)]
        zeroth, tables = pullback_and_entries(series.zeroth_order, dtypes, self.varied, outputs)
        first, read = self.states + 3, series.values + len(series.cauchy_products)
        by, rows = [*range(self.states), *range(first, first + read)], range(n, n + series.rows)
        recursion = pullback(series.order_recursion, [dtypes[0]] * (first + read), by, range(n + series.rows), rows)
        return zeroth, tables, recursion

    # ---- rounds ----

    def _begin(self) -> None:
        """`begin(job, memory, lanes)`: every lane takes a member."""
        frame = self.motion.function("begin", public=True)
        self.replay.begin(frame, self.start_next)
        frame.finish()

    def _run(self, steps: list[Code]) -> None:
        """`run(job, memory, lanes, rounds)`: this many rounds, or until the batch is done; one step back in every lane.

        Returns 1 if there is more to do.
        """
        frame = self.motion.function("run", INTEGER, result=INTEGER, public=True)
        with self.replay.rounds(frame, frame.arguments[0], self._leave_step):
            for step in steps:
                frame.call(step)
        frame.finish(self.motion.is_unfinished(frame))

    # ---- members and their steps ----

    def _begin_lane(self, frame: Frame, index: Value) -> None:
        lane = frame.lane(index)
        lane["excess"] = 0.0
        if self.motion.pieces:
            lane["has_after"] = 0.0
        lane["step"] = lane["step"] - 1
        lane["output"] = frame.job("times") - 2

    def _take_member(self, frame: Frame, lane: Lane, member: Value) -> None:
        """The cotangent of the end of a member's motion."""
        for i in self.motion.form.each(frame.code, self.states):
            lane["state_ct", i] = frame.read("y_ct", member * self.states + i)
        with frame.code.loop(self.motion.parameters) as i:
            lane["params_ct", i] = 0.0

    def _leave_step(self, frame: Frame, lane: Lane, index: Value) -> None:
        """One step less to go back; after the first one, write down the cotangents and take the next member."""
        code, member = frame.code, lane["member"]
        left = lane["step"] - 1
        lane["step"] = left
        with code.only_if(left < 0):
            for i in self.motion.form.each(code, self.states):
                frame.write("y_ct", member * self.states + i, lane["state_ct", i])
            with code.loop(self.motion.parameters) as i:
                place = member * self.motion.member_stride + self.motion.place_of_number(code, i)
                before = frame.read("params_ct", place)  # it may be an entry of a table, too
                frame.write("params_ct", place, lane["params_ct", i] + before)
            frame.write("excess", member, lane["excess"])
            frame.call(self.start_next, index)

    # ---- the transpose of a step ----

    def _seed(self) -> Code:
        """The cotangents of all coefficients, by the polynomials that they are used in."""
        frame = self.motion.function("seed")
        code, h, power = frame.code, frame.code.lanes_of(frame["h"]), frame.code.variable(frame.constant(1.0))
        form = self.motion.form
        for i in form.each(code, self.series.values):
            frame["values_ct", i] = 0.0
        with code.loop(frame.job("order") + 1) as k:
            now = power.value
            for i in form.each(code, self.states):
                frame["y_ct", i, k] = frame["state_ct", i] * now
            power.value = now * h
        with code.loop(self.motion.width) as j:
            self._seed_outputs(frame, frame.lane(j))
        return frame.finish()

    def _seed_outputs(self, frame: Frame, lane: Lane) -> None:
        """The outputs of one lane that lie after the beginning of its step."""
        code, member, t, h = frame.code, lane["member"], lane["t"], lane["h"]

        def follows_begin():
            index = lane["output"]
            there = (member >= 0) & (index > 0)
            at = frame.time(code.select(there, member, 0), code.select(there, index, 0))
            return there & ((at - t) * h > 0.0)

        with code.repeat_while(follows_begin):
            index = lane["output"]
            s, power = frame.time(member, index) - t, code.variable(double(code, 1.0))
            row = (member * frame.job("times") + index) * self.states
            cotangents = code.element(frame.job("path_ct"), row)
            with code.loop(frame.job("order") + 1) as k:
                now = power.value
                for i in self.motion.form.each(code, self.states):
                    cotangent = code.load(code.element(cotangents, i), DOUBLE)
                    lane["y_ct", i, k] = lane["y_ct", i, k] + cotangent * now
                power.value = now * s
            lane["output"] = index - 1

    def _transpose_orders(self, back_sums: Code, back_recursion: Code) -> Code:
        """The transposes of the Cauchy products, then of the recursion, from the last order to the first."""
        frame = self.motion.function("back_orders")
        code, order = frame.code, frame.job("order")
        measured = self._last_terms()
        for i in self.motion.form.each(code, self.states):
            frame["before", i] = frame["y_ct", i, order - 1]
        with code.loop(order, start=1) as i:
            frame.call(back_sums, order - i, order)
            frame.call(back_recursion, order - i)
            with code.only_if(i <= 1):
                frame.call(measured)
        return frame.finish()

    def _last_terms(self) -> Code:
        """The bound of the last terms of the series of a tangent, from the transpose of the last order."""
        frame = self.motion.function("measured")
        code, form, n, order = frame.code, self.motion.form, self.n, frame.job("order")
        h, p = code.lanes_of(code.intrinsic("fabs", frame["h"])), code.as_number(frame.job("order"))

        def size(x):
            return code.intrinsic("fabs", x)

        def change(i):
            return frame["y_ct", i, order - 1] - frame["before", i]

        # The Jacobian of the acceleration, times the cotangents: a frequency squared, and a rate of decay.
        velocities = form.largest(code, lambda i: size(frame["y_ct", i + n, order]), n)
        squared = form.largest(code, lambda i: size(change(i)), n)
        decay = form.largest(code, lambda i: size(change(i + n) - frame["y_ct", i, order] / p), n)
        rate = p * decay / velocities + code.intrinsic("sqrt", p * squared / velocities)
        rate = code.select(velocities > 0.0, rate, 0.0)
        term, power = code.variable(frame.constant(1.0)), code.variable(frame.constant(1.0))
        with code.loop(order - 1, start=0) as k:
            term.value = term.value * (rate * h) / code.as_number(k + 1)
            with code.only_if(k > 0):
                power.value = power.value * h
        # The last coefficient of the rows, beside the first two, which may both be near a zero.
        last, first = code.lanes_of(0.0), code.lanes_of(0.0)
        if self.series.rows:
            last = form.largest(code, lambda i: size(frame["rows", i, order - 1]), self.series.rows)
            first = form.largest(
                code, lambda i: code.maximum(size(frame["rows", i, 1]), size(frame["rows", i, 2]) * h), self.series.rows
            )
        tail = code.select(first > 0.0, NEAR_ZERO * last * power.value / first, 0.0)
        frame["excess"] = code.maximum(code.maximum(term.value, tail), frame["excess"])
        return frame.finish()

    def _transpose_sums(self) -> Code:
        """`(k, order)`: the cotangents of the rows at order k, from those of the sums of higher orders."""
        frame = self.motion.function("back_sums", INTEGER, INTEGER)
        code, (k, order) = frame.code, frame.arguments
        for i in self.motion.form.each(code, self.series.rows):
            frame["rows_ct", i] = 0.0
        kinds = [[p for p in self.series.cauchy_products if (p[0] == p[1]) == square] for square in (False, True)]
        tables = [self.motion.table(pairs) for pairs in kinds]
        end = code.function.append_basic_block("end")
        switch = code.builder.switch((order - 1 - k).it, end)
        for terms in range(1, MAX_ORDER - 1):
            block = code.function.append_basic_block(f"terms{terms}")
            switch.add_case(ir.Constant(INTEGER, terms), block)
            code.builder.position_at_end(block)
            for table, pairs, first in zip(tables, kinds, (0, len(kinds[0])), strict=True):
                if pairs:
                    with code.loop(len(pairs)) as i:
                        self._transpose_sum(frame, table, i, first, k, terms)
            code.builder.branch(end)
        code.builder.position_at_end(end)
        return frame.finish()

    def _transpose_sum(self, frame: Frame, table, i: Value, first: int, k: Value, terms: int) -> None:
        """s = Σ' aⱼ bₖ₋ⱼ at orders k + 1, …: its cotangent times b is one of a, and times a one of b."""
        code, width, products = frame.code, self.motion.width, len(self.series.cauchy_products)
        # The cotangents of higher orders lie where the sums themselves were.
        cotangents = frame.address("sums", *self.motion.sum_indices(i + first, k))
        offsets = [code.load(code.element(Value(code, table), i * 2 + which, INTEGER), INTEGER) for which in range(2)]
        rows = [code.element(frame.address("rows"), offset) for offset in offsets]
        totals: list = [None, None]
        for j in range(1, terms + 1):
            cotangent = code.load(code.element(cotangents, j * products * width), frame.vector)
            for which in range(2):
                term = cotangent * code.load(code.element(rows[1 - which], j * width), frame.vector)
                totals[which] = term if totals[which] is None else term + totals[which]
        for offset, total in zip(offsets, totals, strict=True):  # a square gets the same twice
            address = code.element(frame.address("rows_ct"), offset / MAX_ORDER)
            code.store(code.load(address, frame.vector) + total, address)

    def _transpose_recursion(self) -> Code:
        """`(k)`: from the cotangents of order k + 1, and of the rows, to those of order k and of the sums.

        Those of the sums take the place of the sums, which are not read again: all of it fits into the first cache.
        """
        frame = self.motion.function("back_recursion", INTEGER)
        code, (k,), n, series, form = frame.code, frame.arguments, self.n, self.series, self.motion.form
        inverse = 1.0 / code.as_number(k + 1)
        for i in form.each(code, n):  # q̇ₖ = (k+1) qₖ₊₁
            _add(frame, frame["y_ct", i, k + 1] * inverse, "y_ct", i + n, k)
        accelerations_ct = Vectors(n, lambda i: frame["y_ct", i + n, k + 1] * inverse)
        rows_ct, rows = frame.vectors("rows_ct", series.rows), Vectors(series.rows, lambda i: frame["rows", i, k])
        inputs = self.motion.recursion_inputs(frame, k)
        sums_ct = frame.vectors_at("sums", len(series.cauchy_products), k, by_row=True)
        out = form.run(frame, self.order_recursion, *inputs, accelerations_ct, rows_ct, rows, to=sums_ct)
        for i in form.each(code, self.states):
            _add(frame, out[i], "y_ct", i, k)
        for i in form.each(code, series.values):
            _add(frame, out[i + self.states], "values_ct", i)
        return frame.finish()

    def _transpose_start(self) -> Code:
        """The transpose of the zeroth order: from the cotangents of what follows from it to that of the state."""
        frame, form = self.motion.function("back_start"), self.motion.form
        for i in form.each(frame.code, self.n):
            _add(frame, frame["y_ct", i, 1], "y_ct", i + self.n, 0)
        accelerations_ct = Vectors(self.n, lambda i: frame["y_ct", i + self.n, 1])
        values_ct = frame.vectors("values_ct", self.series.values)
        out = form.run(frame, self.zeroth_order, *self.motion.state_inputs(frame), accelerations_ct, values_ct)
        self._store(frame, out, frame.vectors("y_ct", self.states, lambda i: (i, 0)))
        self._store_entries(frame, self.tables, out, len(self.varied))
        return frame.finish()

    def _transpose_projection(self) -> Code:
        """The transpose of the projection: to the end of the series, from the state on the constraints."""
        frame = self.motion.function("back_projection")
        h, motion = frame["h"], self.motion
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), h)[0])
        _, _, params = motion.state_inputs(frame)
        state_ct = frame.vectors("state_ct", self.states)
        out = motion.form.run(frame, self.projection_line, moved, [frame["t"] + h], params, state_ct)
        self._store(frame, out)
        self._store_entries(frame, self.tables_of_projection, out, len(self.varied))
        return frame.finish()

    def _transpose_border(self, saltation: Saltation) -> Code:
        """The transpose of the jump at the border that a step ends at (`_saltation`)."""
        motion = self.motion
        motion.layout.extend_by(saltation.fields_along())
        frame = motion.function("back_border")
        code, base, numbers = frame.code, saltation.base, saltation.parameters
        frame["crossed"] = code.select(frame["has_after"] > 0.0, frame["crossed"], 0.0)
        with code.only_if(code.any_lane(saltation.crosses(frame))):
            saltation.note_edge(frame)
            gain, tables, entries = saltation.cotangent_jumps(frame, frame.vectors("pieces_after", motion.pieces))
            for row in range(saltation.jump.lower):
                for part in range(2):
                    for i in motion.form.each(code, base):
                        _add(frame, gain(row, i + part * base), "state_ct", i + (part * self.n + row * base))
                for k in motion.form.each(code, numbers):
                    _add(frame, gain(row, k + 2 * base), "params_ct", k + row * numbers)
            self._store_entries(frame, tables, entries, 0)
        return frame.finish()

    def _note_after(self) -> Code:
        """The pieces of a step, for the one before it."""
        frame = self.motion.function("note_after")
        with frame.code.loop(self.motion.pieces) as j:
            frame["pieces_after", j] = frame["params", j + self.motion.parameters]
        frame["has_after"] = 1.0
        return frame.finish()

    def _store(self, frame: Frame, cotangents: Numbers, more: "Vectors | None" = None) -> None:
        """The cotangent of the state takes the place of the one before, with `more`; those of the parameters add up."""
        form, states = self.motion.form, self.states
        for i in form.each(frame.code, states):
            frame["state_ct", i] = cotangents[i] if more is None else more[i] + cotangents[i]
        params = [i - states - 1 for i in self.varied[states:]]
        if params == list(range(self.motion.parameters)):
            for i in form.each(frame.code, len(params)):
                _add(frame, cotangents[i + states], "params_ct", i)
        else:  # some are integers
            for k, i in enumerate(params):
                _add(frame, cotangents[states + k], "params_ct", i)

    def _store_entries(self, frame: Frame, tables: tuple[Table, ...], out: Numbers, first: int) -> None:
        """Add the cotangents of entries of tables, outputs from the `first` on, to those of the numbers of members."""
        code, motion = frame.code, self.motion
        for k, table in enumerate(tables):
            cotangent = out[first + 2 * k + 1]
            places = motion.look_up.places(frame, table, out[first + 2 * k])
            for j, place in enumerate(places):
                lane = frame.lane(integer(code, j))
                member = lane["member"]
                with code.only_if(member >= 0):
                    address = code.element(frame.job("params_ct"), member * motion.member_stride + place)
                    code.store(code.load(address, DOUBLE) + lane_of(code, cotangent, j), address)


def _add(frame: Frame, x: Value, name: str, *indices: Index) -> None:
    """Add to a vector of the memory."""
    frame[name, *indices] = frame[name, *indices] + x
