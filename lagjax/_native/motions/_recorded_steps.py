"""The replay of recorded steps: the loop of the derivatives of a batch, forward or backward.

Every lane has one member. A round replays one step of the record (`_run_records`) in each lane: it computes the series
of the motion again, and a derivative maps tangents or cotangents over the step. A lane whose member has no step left
takes the next member that has any.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from lagjax._native.code._frame import Frame, Lane
from lagjax._native.code._ir import INTEGER, Code, Value
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._taylor import AT_BORDER, TaylorSeries, is_large
from lagjax._native.steps._retraction import Retraction
from lagjax._native.steps._run_records import RECORDED
from lagjax._native.steps._saltation import Saltation
from lagjax._native.steps._watch import GuardTable


class StepReplay:
    """The replay of the recorded steps of a motion; `step` is the number of the current one in a lane.

    `fields` are those of the derivative in a thread's memory, `at_borders` further ones if the motion has borders.
    `jumps` is the number of copies of the border jump in the kernel, for the choice of its form.
    """

    def __init__(
        self, name: str, parts: MotionParts, job: type, fields: dict, at_borders: dict, width: int, jumps: int
    ):
        self.parts, self._jump = parts, parts.jump(over_steps=True)
        more = [] if self._jump is None else [self._jump.line] * jumps
        more += [line for line in (parts.borders and parts.borders.holding.retraction,) if line]
        large = is_large(parts.program, parts.projection, times=2, more=more)
        if parts.borders is not None:
            fields = fields | Saltation.fields(parts.borders) | at_borders
        self.motion = motion = TaylorSeries(name, parts, job, fields, large, width, keep_sums=True)
        borders = parts.borders
        self.retraction = borders and borders.holding.retraction and Retraction(motion, borders, parts.nesting)
        self._retract = self.retraction and self.retraction.apply(is_run=False)
        self.size = motion.states + RECORDED + motion.recorded_pieces  # of what is recorded of a step

    def saltation(self) -> Saltation | None:
        """The map of derivatives at the borders where steps end; None without any."""
        parts = self.parts
        if parts.borders is None or self._jump is None:
            return None
        saltation = Saltation(self.motion, GuardTable(self.motion, parts.borders), parts.nesting.base, self._jump)
        self.motion.layout.extend_by(saltation.fields_along())
        return saltation

    def start_next(self, begin: Callable[[Frame, Value], None], take: Callable[[Frame, Lane, Value], None]) -> Code:
        """Emit `(lane)`: load the next member with steps into the lane, which becomes idle if none is left.

        `begin(frame, index)` sets the fields of a lane, `take(frame, lane, member)` those of a member that was found.
        """
        frame = self.motion.function("start_next", INTEGER)
        code, index = frame.code, frame.arguments[0]
        lane = frame.lane(index)
        lane["step"], lane["member"] = 0, 0
        with code.repeat_while(lambda: (lane["member"] >= 0) & (lane["step"] <= 0)):
            member = frame.next("next_member")
            there = member < frame.job("members")
            lane["member"] = code.select(there, member, -1)
            lane["step"] = frame.read("steps", code.select(there, member, 0), INTEGER)
        member = lane["member"]
        there = member >= 0
        lane["active"] = code.flag(there)
        lane["h"] = 0.0
        begin(frame, index)
        with code.only_if(there):
            take(frame, lane, member)
            self.motion.take_numbers(frame, lane, member)
        return frame.finish()

    @contextmanager
    def rounds(self, frame: Frame, rounds: Value, leave: Callable[[Frame, Lane, Value], None]) -> Iterator[None]:
        """A context: its body sees one step per lane with its series; then `leave(frame, lane, index)` is called."""
        code = frame.code
        with self.motion.rounds(frame, rounds):
            with code.loop(self.motion.width) as index:
                self._recall_step(frame, frame.lane(index))
            if self._retract is not None:
                frame.call(self._retract)
            frame.call(self.motion.coefficients, frame.job("order"))
            if self.retraction is not None:
                self.retraction.record_start(frame)
            yield
            with code.loop(self.motion.width) as index, code.only_if(frame.lane(index)["member"] >= 0):
                leave(frame, frame.lane(index), index)

    def row(self, frame: Frame, lane: Lane) -> Value:
        """The index in the record of the current step of a lane."""
        return (frame.read("first_step", lane["member"], INTEGER) + lane["step"]) * self.size

    def _recall_step(self, frame: Frame, lane: Lane) -> None:
        """Load the time, size, start state and pieces of the current step of a lane, and the border at its end."""
        motion, code = self.motion, frame.code
        with code.only_if(lane["member"] >= 0):
            row = self.row(frame, lane)
            lane["t"] = frame.read("record", row)
            lane["h"] = frame.read("record", row + 1)
            for i in motion.form.each(code, motion.states):
                lane["y", i] = frame.read("record", row + (i + RECORDED))
            if motion.pieces:
                first = row + (RECORDED + motion.states)
                with code.loop(motion.pieces) as j:
                    lane["params", j + motion.parameters] = frame.read("record", first + j)
                for k, name in enumerate(AT_BORDER):
                    lane[name] = frame.read("record", first + (motion.pieces + k))
