"""Kicks in a kernel: the velocities of a motion behind a border where L jumps (`_program._kick`)."""

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Fields, Frame
from lagjax._native.code._ir import Code, Value
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._native.steps._roots import Roots
from lagjax._native.steps._watch import Border, Contact, GuardTable, StepEnd
from lagjax._program import SIGN, Borders

_AT_END = 16.0  # roundings of the time by which the end of a motion may miss an instant and is still taken to be there


class Kicks:
    """The kernel functions for kicks of a motion with `base` coordinates, and of its tangents."""

    def __init__(self, motion: TaylorSeries, borders: Borders, table: GuardTable, base: int):
        self.motion, self.borders, self.table = motion, borders, table
        self.in_time = borders.kicks_in_time(motion.states)
        self.kick = self._kick_velocities(base)

    @staticmethod
    def fields(pieces: int) -> Fields:
        return {
            "kick_before": pieces,  # the pieces before the border
            "kicks": 1,  # 1 to kick the motion; 2 if it does not pass the border
            "counts": 1,  # 1 if the step is one that is recorded, be it of no length
        }

    def record_pieces(self, frame: Frame) -> None:
        """Store the pieces before the border."""
        with frame.code.loop(self.motion.pieces) as j:
            frame["kick_before", j] = self.table.piece(frame, j)

    def mark_recorded_steps(self, frame: Frame, stepped: Value) -> Value:
        """Set `counts` for steps that are recorded: also those of no length that end with a kick, and the last one."""
        stepped = stepped | (self.table.kicks(frame) & ~self._begins_past_jump(frame))
        frame["counts"] = stepped | (frame["last"] > 0.0)
        return stepped

    def _begins_past_jump(self, frame: Frame) -> Value:
        """The lanes that start at an instant where L jumps, with velocities that are already those after the jump."""
        begins = (frame["steps"] <= 0.0) & (frame["forward"] > 0.0)
        found = frame.constant(0.0) > 0.0
        for g, guard in enumerate(self.borders.guards):
            if self._kicks_by_sign(guard.piece):
                found = found | self.table.crosses(frame, StepEnd.GUARD, g)
        return begins & found & frame.code.compare("==", frame["h"], 0.0)

    def _kicks_by_sign(self, j: int) -> bool:
        return j in self.in_time and self.borders.decisions[j].kind == SIGN

    def kick_at_end(self, frame: Frame, roots: Roots, degree: Value, h: Value) -> None:
        """End the last step with a kick where L jumps, to rounding, at the end time: final velocities are behind it."""
        code, one = frame.code, frame.constant(1.0)
        ends = (frame["last"] > 0.0) & (frame["forward"] > 0.0) & code.compare("!=", h, 0.0)
        for g, guard in enumerate(self.borders.guards):
            if guard.piece not in self.in_time:
                continue
            border = Border(frame, self.table, integer(code, g))
            side = guard.side(border.piece)
            roots.polynomial(frame, border["piece"], degree, h, side, border.level(border.piece))
            end, slope = roots.value_and_slope(frame, degree, one)
            noise = _AT_END * limits.EPS * abs(frame["t_end"] / h * slope)
            there = ends & code.compare("!=", side, 0.0) & (end <= noise) & code.compare("==", frame["nearest"], one)
            beyond = guard.beyond(border.piece)
            frame.assign(there, crossed=StepEnd.GUARD, crossed_number=float(g), beyond=beyond)

    def _kick_velocities(self, base: int) -> Code:
        """Emit `()`: set the velocities behind the border in lanes with `kicks` = 1; 2 marks a reflection."""
        frame, motion, kick = self.motion.function("kick"), self.motion, self.borders.kick
        assert kick is not None
        code, n, kicks = frame.code, motion.n, frame["kicks"] > 0.0
        with code.only_if(code.any_lane(kicks)):
            parameters = motion.parameters * base // n  # of the motion without its tangents
            inputs = [
                frame.vectors("y", base, lambda i: (i, 0)), frame.vectors("y", base, lambda i: (i + n, 0)),
                frame.vectors("t", 1), frame.vectors("params", parameters), frame.vectors("kick_before", motion.pieces),
                frame.vectors("params", motion.pieces, lambda i: (i + motion.parameters,)),
                frame.vectors("hit", motion.pieces),
            ]  # fmt: skip
            out = motion.form.run(frame, kick.line, *inputs)
            passes = out[base] > 0.0
            for i in motion.form.each(code, base):
                frame.assign(kicks & passes, i + n, 0, y=out[i])
                frame.assign(kicks & passes, i + n, low=0.0)
            frame.assign(kicks & ~passes, kicks=2.0)
        return frame.finish()

    def apply(self, frame: Frame, crosses: Value) -> Value:
        """Apply the kick in lanes that cross a border where L jumps; those reflected stay before it.

        Returns the lanes with a kick.
        """
        code, kicks = frame.code, frame.constant(0.0)
        for j in self.borders.kicking:
            piece = self.table.piece(frame, j)
            if self._kicks_by_sign(j):
                begins = code.compare("==", frame["kick_before", j], 0.0) & (frame["steps"] <= 1.0)
                back = crosses & begins & (frame["forward"] < 0.0)  # from behind it
                frame.assign(back, j, kick_before=0.0 - piece)
            jumps = crosses & (frame["counts"] > 0.0) & code.compare("!=", piece, frame["kick_before", j])
            kicks = code.select(jumps, 1.0, kicks)
        frame["kicks"] = kicks
        frame.call(self.kick)
        reflected = frame["kicks"] > 1.0
        with code.only_if(code.any_lane(reflected)):
            with code.loop(self.motion.pieces) as j:
                frame.assign(reflected, j + self.motion.parameters, params=frame["kick_before", j])
            for border in self.table.each(frame):
                border.remember(reflected, touch=code.select(border.is_hit, Contact.VALUE, Contact.NONE))
            frame["kicks"] = code.select(reflected, 1.0, 0.0)
            frame.call(self.kick)
        return kicks > 0.0
