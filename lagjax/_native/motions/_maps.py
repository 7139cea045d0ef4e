"""The maps that a step is composed of, each with its pushforward and its pullback.

A step y(t + h) = Σ yₖ hᵏ is a composition of maps of the state y₀ and the parameters p:

    Retraction        y₀, p ↦ y₀ on the borders that the motion slides along (`_retraction`)
    ZerothOrder       y₀, p ↦ the acceleration, and what the recursion reads of the zeroth order
    CauchyProducts    rows of the orders before ↦ Σ' aⱼ bₖ₋ⱼ
    OrderRecursion    yₖ, values and sums ↦ the rows of order k, and yₖ₊₁
    SeriesSum         all yₖ ↦ Σ yₖ hᵏ, at the end of the step and at outputs within it
    ProjectedEnd      the end of the series ↦ that on the constraints
    Saltation         a state at a border ↦ that on the piece beyond it (`_saltation`)

The maps themselves are computed by `TaylorSeries.coefficients`. Here `push` emits the pushforward of a map, from
tangents of its arguments to those of its results, and `pull` its pullback, which takes cotangents of results and adds
to those of arguments. `_tangent` and `_adjoint` are loops over the maps; a new kind of map needs these two rules only.

Source: Griewank & Walther, *Evaluating Derivatives* (2008), §§3.2, 13.
"""

from lagjax._native.code._constants import MAX_ORDER
from lagjax._native.code._frame import Frame, Lane, Vectors
from lagjax._native.code._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native.series._cotangents import Cotangents, add
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._tangent_memory import Directions
from lagjax._native.series._taylor import TaylorSeries, double
from lagjax._native.steps._run_records import instant_tolerance
from lagjax._program import pullback, pullback_and_entries, pushforward


class ZerothOrder:
    """The map from state and parameters to the acceleration and the values that the order recursion reads."""

    def __init__(self, motion: TaylorSeries, parts: MotionParts):
        n, values = motion.n, motion.series.values
        self.motion, self.dtypes = motion, parts.program.dtypes
        self.outputs = [*range(n), *range(n + 1, n + 1 + values)]

    def push(self, directions: Directions, frame: Frame) -> None:
        """Emit the tangents of the coefficients of order 1, and of the values."""
        motion, n, states = self.motion, self.motion.n, self.motion.states
        line = pushforward(motion.series.zeroth_order, self.dtypes, directions.varied, self.outputs, self.outputs)
        state = directions.numbers_of(frame, "y", states, lambda i: (i, 0), in_place=True)
        accelerations = directions.numbers_of(frame, "y", n, lambda i: (i + n, 1))
        values = directions.numbers_of(frame, "values", motion.series.values, in_place=True)
        tangents = frame.vectors("dy", states, lambda i: (i, 0))
        inputs = directions.inputs(frame, state, directions.number_of(frame, "t"), tangents)
        to = frame.vectors("dvalues", motion.series.values)
        out = directions.form.run(frame, line, *inputs, accelerations, values, to=to)
        for i in directions.form.each(frame.code, n):
            frame["dy", i, 1] = frame["dy", i + n, 0]
            frame["dy", i + n, 1] = out[i]

    def pull(self, cotangents: Cotangents) -> Code:
        """Emit `()`: from cotangents of order 1 and of the values to those of the state and the parameters."""
        motion, n = self.motion, self.motion.n
        line, tables = pullback_and_entries(motion.series.zeroth_order, self.dtypes, cotangents.varied, self.outputs)
        frame, form = motion.function("back_start"), motion.form
        for i in form.each(frame.code, n):
            add(frame, frame["y_ct", i, 1], "y_ct", i + n, 0)
        accelerations_ct = Vectors(n, lambda i: frame["y_ct", i + n, 1])
        values_ct = frame.vectors("values_ct", motion.series.values)
        out = form.run(frame, line, *motion.state_inputs(frame), accelerations_ct, values_ct)
        cotangents.store(frame, out, frame.vectors("y_ct", motion.states, lambda i: (i, 0)))
        cotangents.store_entries(frame, tables, out, len(cotangents.varied))
        return frame.finish()


class CauchyProducts:
    """The map from rows to the sums Σ' aⱼ bₖ₋ⱼ, 0 < j < k, of every product."""

    def __init__(self, motion: TaylorSeries):
        self.motion, pairs = motion, motion.series.cauchy_products
        self.mixed, self.squares = ([p for p in pairs if (p[0] == p[1]) == square] for square in (False, True))

    def push(self, directions: Directions) -> Code:
        """Emit `(k)`: the tangents Σ' (δaⱼ bₖ₋ⱼ + aⱼ δbₖ₋ⱼ) of every product."""
        frame = directions.function("cauchy_products", INTEGER)
        code, (k,) = frame.code, frame.arguments
        kinds = [(some, self.motion.table(some, 1)) for some in (self.mixed, self.squares)]
        for order in code.cases(k, range(2, MAX_ORDER)):
            for (some, table), first in zip(kinds, (0, len(self.mixed)), strict=True):
                if some:
                    with code.loop(len(some)) as i:
                        square = first > 0 or not self.mixed
                        total = self._push_product(directions, frame, Value(code, table), i, order, square)
                        frame["dsums", i + first] = total
        return frame.finish()

    def _push_product(
        self, directions: Directions, frame: Frame, table: Value, i: Value, order: int, square: bool
    ) -> Value:
        """The tangent of product i at a constant order; of a square, twice the first half of its sum."""
        code, width, lanes = frame.code, self.motion.width, directions.lanes
        motion, shared = frame.view(self.motion.layout), width < lanes

        def row(which):
            offset = code.load(code.element(table, i * 2 + which, INTEGER), INTEGER)
            of_motion = code.element(motion.address("rows"), offset * width)
            tangents = code.element(frame.address("drows"), offset * lanes)
            return (
                lambda j: code.lanes_of(
                    code.load(code.element(of_motion, j * width), DOUBLE if shared else frame.vector)
                ),
                lambda j: code.load(code.element(tangents, j * lanes), frame.vector),
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

    def pull(self) -> Code:
        """Emit `(k, order)`: from cotangents of the sums of higher orders to those of the rows of order k."""
        motion = self.motion
        frame = motion.function("back_sums", INTEGER, INTEGER)
        code, (k, order) = frame.code, frame.arguments
        for i in motion.form.each(code, motion.series.rows):
            frame["rows_ct", i] = 0.0
        kinds = (self.mixed, self.squares)
        tables = [motion.table(pairs) for pairs in kinds]
        for terms in code.cases(order - 1 - k, range(1, MAX_ORDER - 1)):
            for table, pairs, first in zip(tables, kinds, (0, len(self.mixed)), strict=True):
                if pairs:
                    with code.loop(len(pairs)) as i:
                        self._pull_product(frame, table, i, first, k, terms)
        return frame.finish()

    def _pull_product(self, frame: Frame, table, i: Value, first: int, k: Value, terms: int) -> None:
        """Emit, for s = Σ' aⱼ bₖ₋ⱼ at orders k + 1, …: the cotangent of s times b is added to a's, times a to b's."""
        code, width, products = frame.code, self.motion.width, len(self.motion.series.cauchy_products)
        # The cotangents of higher orders lie where the sums themselves were.
        cotangents = frame.address("sums", k, i + first)
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


class OrderRecursion:
    """The map from the state of order k and the sums to the rows of order k and the state of order k + 1."""

    def __init__(self, motion: TaylorSeries, parts: MotionParts):
        series, n = motion.series, motion.n
        first, read = motion.states + 3, series.values + len(series.cauchy_products)
        self.motion, self.dtypes = motion, [parts.program.dtypes[0]] * (first + read)
        self.varied, self.rows = [*range(motion.states), *range(first, first + read)], range(n, n + series.rows)
        self.outputs = range(n + series.rows)

    def push(self, directions: Directions) -> Code:
        """Emit `(k)`: the tangents of the rows of order k, and of the state of order k + 1."""
        motion, series, form = self.motion, self.motion.series, directions.form
        line = pushforward(series.order_recursion, self.dtypes, self.varied, self.outputs, self.rows)
        frame = directions.function("recursion", INTEGER)
        code, (k,), n, products = frame.code, frame.arguments, motion.n, len(series.cauchy_products)
        number = code.as_double(k)
        time = code.select(code.compare("==", k, 1), number, 0.0)
        inverse = 1.0 / code.as_double(k + 1)
        out = form.run(
            frame, line,
            directions.numbers_of(frame, "y", motion.states, lambda i: (i, k)),
            [code.lanes_of(x) for x in (time, number, 1.0 / number)],
            directions.numbers_of(frame, "values", series.values, in_place=True),
            directions.numbers_of(frame, "sums", products, lambda i: (k, i)),
            Vectors(motion.states, lambda i: frame["dy", i, k]),
            frame.vectors("dvalues", series.values),
            frame.vectors("dsums", products),
            directions.numbers_of(frame, "rows", series.rows, lambda i: (i, k)),
            to=frame.vectors_at("drows", series.rows, k),
        )  # fmt: skip
        for i in form.each(code, n):
            frame["dy", i, k + 1] = frame["dy", i + n, k] * inverse
            frame["dy", i + n, k + 1] = out[i] * inverse
        return frame.finish()

    def pull(self) -> Code:
        """Emit `(k)`: from cotangents of state k + 1 and rows k to those of state k, values and sums.

        Those of the sums overwrite the sums, which are not read again: then all of it fits into the first cache.
        """
        motion = self.motion
        series, n, form = motion.series, motion.n, motion.form
        line = pullback(series.order_recursion, self.dtypes, self.varied, self.outputs, self.rows)
        frame = motion.function("back_recursion", INTEGER)
        code, (k,) = frame.code, frame.arguments
        inverse = 1.0 / code.as_number(k + 1)
        for i in form.each(code, n):  # q̇ₖ = (k+1) qₖ₊₁
            add(frame, frame["y_ct", i, k + 1] * inverse, "y_ct", i + n, k)
        accelerations_ct = Vectors(n, lambda i: frame["y_ct", i + n, k + 1] * inverse)
        rows_ct, rows = frame.vectors("rows_ct", series.rows), Vectors(series.rows, lambda i: frame["rows", i, k])
        inputs = motion.recursion_inputs(frame, k)
        sums_ct = frame.vectors_at("sums", len(series.cauchy_products), k, by_row=True)
        out = form.run(frame, line, *inputs, accelerations_ct, rows_ct, rows, to=sums_ct)
        for i in form.each(code, motion.states):
            add(frame, out[i], "y_ct", i, k)
        for i in form.each(code, series.values):
            add(frame, out[i + motion.states], "values_ct", i)
        return frame.finish()


class SeriesSum:
    """The state at a time s within a step, Σ yₖ sᵏ. If anything `kicks` the motion, an output may be at its start."""

    def __init__(self, motion: TaylorSeries, kicks: bool = False):
        self.motion, self.kicks = motion, kicks

    def push(self, directions: Directions, frame: Frame, name: str, s: Value, powers: bool = False) -> None:
        """Emit the tangents of the sum into the field `name`; with `powers` the last two powers of s are stored."""
        code, power, order = frame.code, frame.code.variable(frame.constant(1.0)), frame.job("order")
        form, states = directions.form, directions.states
        for i in form.each(code, states):
            frame[name, i] = frame["dy", i, 0]
        with code.loop(order) as k:
            before = power.value
            now = before * s
            for i in form.each(code, states):
                frame[name, i] = frame[name, i] + frame["dy", i, k + 1] * now
            power.value = now
            if powers:
                frame["power_before"], frame["power"] = before, now

    def pull(self) -> Code:
        """Emit `()`: from cotangents of the end of the step and of outputs within it to those of all coefficients."""
        motion = self.motion
        frame = motion.function("seed")
        code, h, power = frame.code, frame.code.lanes_of(frame["h"]), frame.code.variable(frame.constant(1.0))
        form = motion.form
        for i in form.each(code, motion.series.values):
            frame["values_ct", i] = 0.0
        with code.loop(frame.job("order") + 1) as k:
            now = power.value
            for i in form.each(code, motion.states):
                frame["y_ct", i, k] = frame["state_ct", i] * now
            power.value = now * h
        with code.loop(motion.width) as j:
            self._pull_outputs(frame, frame.lane(j))
        return frame.finish()

    def _pull_outputs(self, frame: Frame, lane: Lane) -> None:
        """Emit the pullback of the outputs of one lane that lie after the start of its step."""
        motion = self.motion
        code, member, t, h = frame.code, lane["member"], lane["t"], lane["h"]

        def follows_begin():
            index = lane["output"]
            there = (member >= 0) & (index > 0)
            at = frame.time(code.select(there, member, 0), code.select(there, index, 0))
            follows = (at - t) * h > 0.0
            if self.kicks:
                follows = follows | ((h > 0.0) & (at >= t - instant_tolerance(at)))
            return there & follows

        with code.repeat_while(follows_begin):
            index = lane["output"]
            s, power = frame.time(member, index) - t, code.variable(double(code, 1.0))
            row = (member * frame.job("times") + index) * motion.states
            cotangents = code.element(frame.job("path_ct"), row)
            with code.loop(frame.job("order") + 1) as k:
                now = power.value
                for i in motion.form.each(code, motion.states):
                    cotangent = code.load(code.element(cotangents, i), DOUBLE)
                    lane["y_ct", i, k] = lane["y_ct", i, k] + cotangent * now
                power.value = now * s
            lane["output"] = index - 1


class ProjectedEnd:
    """The map from the end of the series to the state on the constraints.

    At a border that the motion crosses, derivatives are those of the series: the curvature of a constraint may jump
    there, and rounding would decide to which side the projection belongs.
    """

    def __init__(self, motion: TaylorSeries, parts: MotionParts):
        assert parts.projection is not None
        self.motion, self.dtypes, self.line = motion, parts.program.dtypes, parts.projection.state.line

    def record_argument(self, frame: Frame) -> None:
        """Store the end of the series, for its tangents, as `moved`."""
        motion = self.motion
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        for i in motion.form.each(frame.code, motion.states):
            frame["moved", i] = moved[i]

    def push(self, directions: Directions) -> Code:
        """Emit `(group)`: from the tangents of the end of the series, in `end`, to those of the projected end."""
        states, form = directions.states, directions.form
        line = pushforward(self.line, self.dtypes, directions.varied, range(states))
        frame = directions.function("projected", INTEGER)
        moved = directions.numbers_of(frame, "moved", states, in_place=True)
        t = directions.number_of(frame, "t") + directions.number_of(frame, "h")
        out = form.run(frame, line, *directions.inputs(frame, moved, t, frame.vectors("end", states)))
        for i in form.each(frame.code, states):
            frame["between", i] = out[i]
        code, goes_on = frame.code, frame.constant(0.0) > 0.0
        if self.motion.pieces:
            is_last = ~(abs(directions.number_of(frame, "next_begin")) < float("inf"))
            goes_on = (directions.number_of(frame, "crossed") > 0.0) & ~is_last
        for i in form.each(code, states):
            frame["end", i] = code.select(goes_on, frame["end", i], frame["between", i])
        return frame.finish()

    def pull(self, cotangents: Cotangents) -> Code:
        """Emit `()`: from cotangents of the projected end to those of the end of the series and the parameters."""
        motion = self.motion
        line, tables = pullback_and_entries(self.line, self.dtypes, cotangents.varied, range(motion.states))
        frame = motion.function("back_projection")
        h = frame["h"]
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), h)[0])
        _, _, params = motion.state_inputs(frame)
        through, past = (motion.form.room(frame, motion.states) for _ in range(2))
        goes_on = frame["crossed"] > 0.0 if motion.pieces else frame.constant(0.0) > 0.0  # where a step follows
        for i in motion.form.each(frame.code, motion.states):
            cotangent = frame["state_ct", i]
            through[i] = frame.code.select(goes_on, 0.0, cotangent)
            past[i] = frame.code.select(goes_on, cotangent, 0.0)
        out = motion.form.run(frame, line, moved, [frame["t"] + h], params, through)
        cotangents.store(frame, out, past)
        cotangents.store_entries(frame, tables, out, len(cotangents.varied))
        return frame.finish()
