"""The forward-mode derivative of a batch of motions: the pushforward of every step, from the first to the last.

Along a direction (δy₀, δp) all numbers of a step have tangents. They are computed in the order of the step itself, map
by map (`_maps`): over a border, through the zeroth order, through every order, to the end and to every output within.

The series of the motion is computed once for all directions. Lanes hold members, with one direction after another, or
the directions of a single member, whose own series is then computed without lanes.

A step that is accurate for the motion may be too long for its tangents: about an equilibrium the series of the motion
ends, that of a tangent does not. So the last two terms of their series are measured; `excess` is their largest size,
and that of each step replaces its number in the record.
"""

import functools

from lagjax._native.code._frame import Frame, Lane, job_structure
from lagjax._native.code._ir import INTEGER, Code, Value
from lagjax._native.motions._maps import CauchyProducts, OrderRecursion, ProjectedEnd, SeriesSum, ZerothOrder
from lagjax._native.motions._recorded_steps import StepReplay
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._tangent_memory import Directions
from lagjax._native.steps._run_records import NUMBER, instant_tolerance

# `y_dot` is the tangent of the start, and becomes that of the end.
JOB = job_structure(
    "TangentJob",
    ("next_member", "ts", "params", "record", "first_step", "steps", "path_dot", "y_dot", "params_dot", "excess"),
    ("ts_stride", "params_stride", "members", "times", "order", "directions"),
    ("floor",),
)


class Tangent:
    """The module of tangents, with public functions `begin(job, memory, lanes)` and `run(…, rounds)`."""

    job = JOB

    def __init__(self, parts: MotionParts, *, width: int, lanes: int):
        fields = {"active": 1, "next_begin": 1}
        fields |= {"moved": 2 * parts.series.size} if parts.projection is not None else {}
        self.replay = StepReplay("tangent", parts, JOB, fields, {}, width, jumps=1)
        self.motion = motion = self.replay.motion
        self.saltation, self.retraction = self.replay.saltation(), self.replay.retraction
        self.note_border = self.saltation and self.saltation.store_end()
        self.directions = directions = Directions(motion, parts, lanes)
        self.form, self.series_sum = directions.form, SeriesSum(motion)
        self.start_next = self.replay.start_next(self._begin_lane, lambda frame, lane, member: None)
        products, recursion = CauchyProducts(motion), OrderRecursion(motion, parts)
        self.products, self.recursion = products.push(directions), recursion.push(directions)
        steps = [
            self._load(), self._series(ZerothOrder(motion, parts)), self._end(), self._last_terms(), self._outputs(),
            self._store_end(),
        ]  # fmt: skip
        self.projected_end = parts.projection and ProjectedEnd(motion, parts)
        if self.projected_end is not None:
            steps.insert(4, self.projected_end.push(directions))
        self._run_function(steps)
        motion.write_begin(self.start_next, self.form)
        self.form.finish()
        motion.finish()

    # ---- rounds ----

    def _run_function(self, steps: list[Code]) -> None:
        """Emit `run(job, memory, lanes, rounds)`: one step per lane and round; 1 if there is more to do."""
        frame = self.motion.function("run", INTEGER, result=INTEGER, public=True)
        code, (rounds,) = frame.code, frame.arguments
        directions, per_group = frame.job("directions"), self.directions.lanes // self.motion.width
        with self.replay.rounds(frame, rounds, self._advance_step):
            self._set_step_end(frame)
            if self.projected_end is not None:
                self.projected_end.record_argument(frame)
            with code.loop((directions + (per_group - 1)) / per_group) as group:
                for step in steps:
                    frame.call(step, group)
            if self.note_border is not None:
                frame.call(self.note_border)
        frame.finish(self.motion.is_unfinished(frame))

    # ---- members and their steps ----

    def _begin_lane(self, frame: Frame, index: Value) -> None:
        lane = frame.lane(index)
        lane["step"], lane["output"] = 0, 1
        if self.saltation is not None:
            lane["is_hit"] = 0.0

    def _set_step_end(self, frame: Frame) -> None:
        """Set the start of the next step of every lane: outputs before it belong to this step."""
        code = frame.code
        with code.loop(self.motion.width) as index:
            lane = frame.lane(index)
            for tangents in self.directions.lanes_of_tangents(frame, index):
                tangents["excess"] = 0.0
            with code.only_if(lane["member"] >= 0):
                lane["next_begin"] = lane["h"] * float("inf")  # of the last step: all outputs that are left
                with code.only_if(lane["step"] + 1 < frame.read("steps", lane["member"], INTEGER)):
                    lane["next_begin"] = frame.read("record", self.replay.row(frame, lane) + self.replay.size)

    def _advance_step(self, frame: Frame, lane: Lane, index: Value) -> None:
        """Store the size of the last terms and begin the next step; after the last step, load the next member."""
        code, member, tangents = frame.code, lane["member"], self.directions.lanes_of_tangents(frame, index)
        largest = functools.reduce(code.maximum, [of_lane["excess"] for of_lane in tangents])
        frame.write("record", self.replay.row(frame, lane) + NUMBER, largest)
        frame.write("excess", member, code.maximum(largest, frame.read("excess", member)))
        lane["step"] = lane["step"] + 1
        lane["output"] = code.as_integer(tangents[0]["next_output"])
        with code.only_if(lane["step"] >= frame.read("steps", member, INTEGER)):
            frame.call(self.start_next, index)

    # ---- one step along one direction in every lane; `group` numbers the directions ----

    def _step_function(self, name: str) -> tuple[Frame, Code, Value]:
        frame = self.directions.function(name, INTEGER)
        return frame, frame.code, frame.arguments[0]

    def _load(self) -> Code:
        """Emit `(group)`: load the tangents of state and parameters; zero for a direction that does not exist."""
        frame, code, group = self._step_function("take")
        for i in self.form.each(code, self.motion.states):
            frame["dy", i, 0] = 0.0
        for i in self.form.each(code, self.motion.parameters):
            frame["dparams", i] = 0.0
        with code.loop(self.directions.lanes) as index:
            lane, (place, there) = frame.lane(index), self.directions.place(frame, group, index)
            lane["next_output"] = code.as_double(self.directions.lane_of_motion(frame, index)["output"])
            lane["first_number"] = self.directions.lane_of_motion(frame, index)["first_number"]
            first = place * self.motion.member_stride
            lane["first_dot"] = code.select(there, code.as_double(first), 0.0)
            with code.only_if(there):
                for i in self.form.each(code, self.motion.states):
                    lane["dy", i, 0] = frame.read("y_dot", place * self.motion.states + i)
                with code.loop(self.motion.parameters) as i:
                    lane["dparams", i] = frame.read("params_dot", first + self.motion.place_of_number(code, i))
        if self.saltation is not None:
            self.saltation.push(self.directions, frame)
        if self.retraction is not None:
            self.retraction.push(self.directions, frame)
        return frame.finish()

    def _series(self, zeroth_order: ZerothOrder) -> Code:
        """Emit `(group)`: compute the series of the tangents of the state."""
        frame, code, _ = self._step_function("series")
        zeroth_order.push(self.directions, frame)
        for i in self.form.each(code, len(self.motion.series.cauchy_products)):
            frame["dsums", i] = 0.0
        with code.loop(frame.job("order"), start=1) as k:
            with code.only_if(k > 1):
                frame.call(self.products, k)
            frame.call(self.recursion, k)
        return frame.finish()

    def _end(self) -> Code:
        """Emit `(group)`: compute the tangents of the state at the end of the series."""
        frame, _, _ = self._step_function("end")
        self.series_sum.push(self.directions, frame, "end", self.directions.number_of(frame, "h"), powers=True)
        return frame.finish()

    def _last_terms(self) -> Code:
        """Emit `(group)`: the largest of the last two terms relative to the tangent, of coordinates and velocities.

        Tangents below the `floor` are replaced by it: a tangent that is zero consists of rounding.
        """
        frame, code, _ = self._step_function("measure")
        order, powers = frame.job("order"), [frame["power_before"], frame["power"]]

        def last_terms(first):
            return lambda i: code.maximum(
                *(abs(frame["dy", i + first, order - (1 - k)] * power) for k, power in enumerate(powers))
            )

        def whole(first):
            return lambda i: code.maximum(abs(frame["dy", i + first, 0]), abs(frame["end", i + first]))

        for first in (0, self.motion.n):
            terms, scale = (self.form.largest(code, of(first), self.motion.n) for of in (last_terms, whole))
            frame["excess"] = code.maximum(terms / code.maximum(scale, frame.job("floor")), frame["excess"])
        return frame.finish()

    def _outputs(self) -> Code:
        """Emit `(group)`: the tangents of the outputs between the starts of this step and the next."""
        frame, code, group = self._step_function("outputs")
        frame["is_due"] = 1.0
        with code.repeat_while(lambda: code.any_lane(frame["is_due"] > 0.0)):
            with code.loop(self.directions.lanes) as index:
                self._find_due_outputs(frame, index)
            with code.only_if(code.any_lane(frame["is_due"] > 0.0)):
                self.series_sum.push(self.directions, frame, "between", frame["s"])
                with code.loop(self.directions.lanes) as index:
                    self._write_output(frame, index, group)
        return frame.finish()

    def _find_due_outputs(self, frame: Frame, index: Value) -> None:
        """Set `is_due` for lanes whose next output is in the step, and its time `s` from the start of the step."""
        code, lane, of_motion = frame.code, frame.lane(index), self.directions.lane_of_motion(frame, index)
        member, output = of_motion["member"], code.as_integer(lane["next_output"])
        inside = (member >= 0) & (output < frame.job("times") - 1)
        at = frame.time(code.select(inside, member, 0), code.select(inside, output, 0))
        due = inside & ((at - of_motion["next_begin"]) * of_motion["h"] <= 0.0)
        if self.replay.parts.kicks:  # outputs at the end belong to the next step, forward in time
            next_begin, h = of_motion["next_begin"], of_motion["h"]
            due = due & code.compare("!=", h, 0.0) & ~((h > 0.0) & (at >= next_begin - instant_tolerance(at)))
        lane["s"] = code.select(due, at - of_motion["t"], 0.0)
        lane["is_due"] = code.flag(due)

    def _write_output(self, frame: Frame, index: Value, group: Value) -> None:
        code, lane = frame.code, frame.lane(index)
        with code.only_if(lane["is_due"] > 0.0):
            output, (place, there) = code.as_integer(lane["next_output"]), self.directions.place(frame, group, index)
            row = (place * frame.job("times") + output) * self.motion.states
            with code.only_if(there):
                for i in self.form.each(code, self.motion.states):
                    frame.write("path_dot", row + i, lane["between", i])
            lane["next_output"] = lane["next_output"] + 1.0

    def _store_end(self) -> Code:
        """Emit `(group)`: store the tangents at the end of the step, with which the next one begins."""
        frame, code, group = self._step_function("leave")
        with code.loop(self.directions.lanes) as index:
            lane, (place, there) = frame.lane(index), self.directions.place(frame, group, index)
            with code.only_if(there):
                for i in self.form.each(code, self.motion.states):
                    frame.write("y_dot", place * self.motion.states + i, lane["end", i])
        return frame.finish()
