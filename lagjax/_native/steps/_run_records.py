"""The records of a run: states at the output times, the steps for the adjoint, and how each member ended."""

from lagjax._native.code._constants import DONE, EPS
from lagjax._native.code._frame import Fields, Frame, Index, Lane
from lagjax._native.code._ir import Value
from lagjax._native.series._taylor import AT_BORDER, TaylorSeries
from lagjax._native.steps._projection import Projector

_INSTANT = 4.0 * EPS  # the largest difference of two times that count as the same, relative to them
RECORDED = 4  # numbers of a step that are written down before its state: time, size, member, number of the step
NUMBER = 3  # the place of that; when steps are in order a tangent writes there how large its last terms are


def instant_tolerance(t: Value) -> Value:
    """The largest difference from time `t` that counts as zero."""
    return _INSTANT * abs(t)


class OutputWriter:
    """The kernel functions that write into the arrays of the job."""

    def __init__(self, motion: TaylorSeries, projector: Projector | None):
        self.motion, self.projector = motion, projector

    @staticmethod
    def fields(n: int) -> Fields:
        """The fields of a thread's memory for outputs; times are measured in the direction of the motion."""
        return {
            "between": 2 * n,  # the state at an output time
            "due": 1,  # the next output time
            "reached": 1,  # the end of the step, or the instant of a note
            "is_due": 1,  # 1 in a lane that has an output, or a note, to write down
        }

    # ---- states at output times ----

    def place(self, frame: Frame, member: Value, time_index: Index, i: Index) -> Value:
        """The index in `path` of component i of the state at an output time of a member."""
        return (member * frame.job("times") + time_index) * self.motion.states + i

    def set_due_time(self, frame: Frame, lane: Lane, index: Value) -> None:
        """Set `due` to the next output time before the end, in the direction of the motion; infinite after the last."""
        code = frame.code
        lane["output"] = index
        inside = index < frame.job("times") - 1
        time = frame.time(lane["member"], code.select(inside, index, 0)) * lane["forward"]
        lane["due"] = code.select(inside, time, float("inf"))

    def write_due(self, frame: Frame, order: Value, after: Value, kicks: Value | None) -> None:
        """Write the states at all output times before `after`, the end of the step.

        An output at the end itself is left to the next step where a kick (`kicks`) changes the velocities.
        """
        code, moving = frame.code, frame.code.compare("!=", frame["h"], 0.0)
        forward, t, low = frame["forward"], frame["t"], frame["t_low"]
        frame["reached"] = after * forward
        if kicks is not None:
            with frame.where(kicks & (frame["h"] > 0.0)):
                frame["reached"] = after - instant_tolerance(after)

        def due():
            return moving & (frame["due"] <= frame["reached"])

        with code.repeat_while(lambda: code.any_lane(due())):
            there = due()
            s = code.select(there, (frame["due"] * forward - t) - low, 0.0)
            self.interpolate(frame, order, s)
            frame["is_due"] = there
            with code.loop(self.motion.width) as j:
                lane = frame.lane(j)
                with code.only_if(lane["is_due"] > 0.0):
                    member, index = lane["member"], lane["output"]
                    for i in self.motion.form.each(code, self.motion.states):
                        frame.write("path", self.place(frame, member, index, i), lane["between", i])
                    self.set_due_time(frame, lane, index + 1)

    def interpolate(self, frame: Frame, order: Value, s: Value) -> None:
        """Store in `between` the state at time s after the current one, projected if that is near."""
        states, form = self.motion.states, self.motion.form
        increments, _ = self.motion.increments(frame, order, s)
        values = form.room(frame, states)
        for i in form.each(frame.code, states):
            values[i] = frame["y", i] + (increments[i] + frame["low", i])
        if self.projector is None:
            for i in form.each(frame.code, states):
                frame["between", i] = values[i]
            return
        projected, off = self.projector.project_state(frame, values, increments, s)
        for i in form.each(frame.code, states):
            frame["between", i] = frame.code.select(off <= 1.0, projected[i], values[i])

    # ---- steps, for their transposes ----

    def record(self, frame: Frame, lane: Lane, kicks: bool, state: str = "y") -> None:
        """Append a step to the record: time, size, start `state`, member and number, while there is room.

        All threads append to one table, in order of arrival. Where anything `kicks` the motion, steps of zero length
        may count.
        """
        code, member = frame.code, lane["member"]
        with code.only_if((member >= 0) & (lane["counts"] > 0.0 if kicks else code.compare("!=", lane["h"], 0.0))):
            number, motion = frame.next("next_row"), self.motion
            with code.only_if(number < frame.job("room")):
                row = number * (motion.states + RECORDED + motion.recorded_pieces)
                parts = lane["t"], lane["h"], code.as_double(member), lane["steps"]
                for k, x in enumerate(parts):
                    frame.write("record", row + k, x)
                for i in motion.form.each(code, motion.states):
                    frame.write("record", row + len(parts) + i, lane[state, i])
                if motion.pieces:
                    self._record_pieces(frame, lane, row + (RECORDED + motion.states))

    def _record_pieces(self, frame: Frame, lane: Lane, row: Value) -> None:
        """Write the pieces of the step, and the border at which it ends (`AT_BORDER`)."""
        pieces = self.motion.pieces
        with frame.code.loop(pieces) as j:
            frame.write("record", row + j, lane["params", j + self.motion.parameters])
        for k, name in enumerate(AT_BORDER):
            frame.write("record", row + (pieces + k), lane[name])

    # ---- the end of a member ----

    def write_end(self, frame: Frame, lane: Lane, states: bool) -> None:
        """Write the end time of a member, its code and step counts; with `states` its last state and output."""
        code, member = frame.code, lane["member"]
        frame.write("t_end", member, lane["t"])
        for name in ("code", "steps", "rejected"):
            frame.write(name, member, lane[name])
        done = code.compare("==", lane["code"], float(DONE))
        for i in self.motion.form.each(code, self.motion.states):
            x = lane["y", i]
            frame.write("y_end", member * self.motion.states + i, x)
            if states:
                with code.only_if(done):
                    frame.write("path", self.place(frame, member, frame.job("times") - 1, i), x)
