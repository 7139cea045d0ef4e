"""The reverse-mode derivative of a batch of motions: the transpose of every step, from the last to the first.

The transpose of a step maps a cotangent λ of the state at its end to one at its start, and adds to the cotangents of
the parameters. It is the pullbacks of the maps of the step (`_maps`), from the last to the first:

    saltation      to the near side of the border that the step ends at;  the projection, to the end of the series
    sum            ȳₖ = hᵏ λ, and sᵏ times the cotangent of every output within the step, at t + s
    orders         from the last to the first: the Cauchy products, then the recursion
    zeroth order   to λ = ȳ₀

The pullbacks need the numbers of the step, so the series is computed again from the recorded state. The cost is that of
two or three motions, for any number of parameters. Steps are those that were taken: as everywhere in diffrax, their
sizes are not differentiated. `excess` estimates whether they are accurate for derivatives (see `_tangent`), from the
rates of the tangents and the series that are multiplied.
"""

from lagjax._native.code._constants import NEAR_ZERO
from lagjax._native.code._frame import Frame, Lane, job_structure
from lagjax._native.code._ir import INTEGER, Code, Value
from lagjax._native.motions._maps import CauchyProducts, OrderRecursion, ProjectedEnd, SeriesSum, ZerothOrder
from lagjax._native.motions._recorded_steps import StepReplay
from lagjax._native.series._cotangents import Cotangents
from lagjax._native.series._motion_parts import MotionParts

# `y_ct` is the cotangent of the end, and becomes that of the start.
JOB = job_structure(
    "AdjointJob",
    ("next_member", "ts", "params", "record", "first_step", "steps", "path_ct", "y_ct", "params_ct", "excess"),
    ("ts_stride", "params_stride", "members", "times", "order"),
)


class Adjoint:
    """The module of an adjoint, with public functions `begin(job, memory, lanes)` and `run(…, rounds)`."""

    job = JOB

    def __init__(self, parts: MotionParts, *, width: int):
        fields = Cotangents.fields(parts) | {"before": 2 * parts.series.size, "active": 1, "excess": 1}
        at_borders = {"pieces_after": parts.pieces, "has_after": 1}
        self.replay = StepReplay("adjoint", parts, JOB, fields, at_borders, width, jumps=2)
        self.motion = motion = self.replay.motion
        self.start_next = self.replay.start_next(self._begin_lane, self._take_member)
        cotangents = Cotangents(motion, parts)
        orders = CauchyProducts(motion), OrderRecursion(motion, parts)
        steps = [
            SeriesSum(motion, parts.kicks).pull(),
            self._transpose_orders(*(of.pull() for of in orders)),
            ZerothOrder(motion, parts).pull(cotangents),
        ]
        if (retraction := self.replay.retraction) is not None:
            steps.append(retraction.pull(cotangents))
        if parts.projection is not None:
            steps.insert(0, ProjectedEnd(motion, parts).pull(cotangents))
        if (saltation := self.replay.saltation()) is not None:
            steps = [saltation.pull(cotangents), *steps, saltation.store_next_pieces()]
        self._run_function(steps)
        motion.write_begin(self.start_next)
        motion.finish()

    # ---- rounds ----

    def _run_function(self, steps: list[Code]) -> None:
        """Emit `run(job, memory, lanes, rounds)`: one step back per lane and round; 1 if there is more to do."""
        frame = self.motion.function("run", INTEGER, result=INTEGER, public=True)
        with self.replay.rounds(frame, frame.arguments[0], self._advance_step):
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
        for i in self.motion.form.each(frame.code, self.motion.states):
            lane["state_ct", i] = frame.read("y_ct", member * self.motion.states + i)
        with frame.code.loop(self.motion.parameters) as i:
            lane["params_ct", i] = 0.0

    def _advance_step(self, frame: Frame, lane: Lane, index: Value) -> None:
        """Move the lane to the step before; after the first step, store the cotangents and load the next member."""
        code, member = frame.code, lane["member"]
        left = lane["step"] - 1
        lane["step"] = left
        with code.only_if(left < 0):
            for i in self.motion.form.each(code, self.motion.states):
                frame.write("y_ct", member * self.motion.states + i, lane["state_ct", i])
            with code.loop(self.motion.parameters) as i:
                place = member * self.motion.member_stride + self.motion.place_of_number(code, i)
                before = frame.read("params_ct", place)  # it may be an entry of a table, too
                frame.write("params_ct", place, lane["params_ct", i] + before)
            frame.write("excess", member, lane["excess"])
            frame.call(self.start_next, index)

    # ---- the transpose of a step ----

    def _transpose_orders(self, back_products: Code, back_recursion: Code) -> Code:
        """Emit the transposes of the Cauchy products and the recursion, from the last order to the first."""
        frame = self.motion.function("back_orders")
        code, order = frame.code, frame.job("order")
        measured = self._last_terms()
        for i in self.motion.form.each(code, self.motion.states):
            frame["before", i] = frame["y_ct", i, order - 1]
        with code.loop(order, start=1) as i:
            frame.call(back_products, order - i, order)
            frame.call(back_recursion, order - i)
            with code.only_if(i <= 1):
                frame.call(measured)
        return frame.finish()

    def _last_terms(self) -> Code:
        """Emit the bound of the last terms of a tangent's series, from the transpose of the last order."""
        frame = self.motion.function("measured")
        code, form, n, order = frame.code, self.motion.form, self.motion.n, frame.job("order")
        h, p = code.lanes_of(abs(frame["h"])), code.as_number(frame.job("order"))

        def change(i):
            return frame["y_ct", i, order - 1] - frame["before", i]

        def first_terms(i):
            return code.maximum(abs(frame["rows", i, 1]), abs(frame["rows", i, 2]) * h)

        # The Jacobian of the acceleration, times the cotangents: a frequency squared, and a rate of decay.
        velocities = form.largest(code, lambda i: abs(frame["y_ct", i + n, order]), n)
        squared = form.largest(code, lambda i: abs(change(i)), n)
        decay = form.largest(code, lambda i: abs(change(i + n) - frame["y_ct", i, order] / p), n)
        rate = p * decay / velocities + code.intrinsic("sqrt", p * squared / velocities)
        rate = code.select(velocities > 0.0, rate, 0.0)
        term, power = code.variable(frame.constant(1.0)), code.variable(frame.constant(1.0))
        with code.loop(order - 1) as k:
            term.value = term.value * (rate * h) / code.as_number(k + 1)
            with code.only_if(k > 0):
                power.value = power.value * h
        # The last coefficient of the rows, beside the first two, which may both be near a zero.
        last, first, rows = code.lanes_of(0.0), code.lanes_of(0.0), self.motion.series.rows
        if rows:
            last = form.largest(code, lambda i: abs(frame["rows", i, order - 1]), rows)
            first = form.largest(code, first_terms, rows)
        tail = code.select(first > 0.0, NEAR_ZERO * last * power.value / first, 0.0)
        frame["excess"] = code.maximum(code.maximum(term.value, tail), frame["excess"])
        return frame.finish()
