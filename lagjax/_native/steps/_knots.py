"""Time knots: entries of tables over the time, at which a step ends; the next one is known without a search."""

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Frame
from lagjax._native.code._ir import Value
from lagjax._native.series._taylor import TaylorSeries
from lagjax._native.steps._watch import GuardTable, StepEnd
from lagjax._program import Borders


class Knots:
    """The kernel functions for the time knots of a motion, and for entries of its other tables."""

    def __init__(self, motion: TaylorSeries, borders: Borders, table: GuardTable):
        self.motion, self.borders, self.table = motion, borders, table

    def end_step_at_knot(self, frame: Frame, h: Value) -> None:
        """End the step at the first knot of all tables."""
        clocks = sorted(enumerate(self.borders.clocks), key=lambda clock: clock[1] not in self.borders.kicking)
        for c, j in clocks:
            self._end_at_knot(frame, c, j, h)
        if self.table.movable and len(clocks) > 1:
            self._record_coincidence(frame, h)

    def enter_next_pieces(self, frame: Frame, going: Value) -> None:
        """Enter the next piece of every table that has a knot at this instant."""
        for j in self.borders.clocks:
            left, inside = self._time_to_knot(frame, j)
            passes = going & inside & (left <= self._instant_tolerance(frame))
            frame.assign(passes, self.motion.parameters + j, params=self.table.piece(frame, j) + frame["forward"])

    def entry(self, frame: Frame, j: int, index: Value) -> tuple[Value, Value]:
        """Entry `index` of the table of piece j, and a flag: it exists."""
        located = self.borders.decisions[j].table
        assert located is not None
        inside = (index >= 0.0) & (index <= float(located.table.count - 1))
        return self.motion.look_up.take(frame, located.table, index), inside

    def _time_to_knot(self, frame: Frame, j: int) -> tuple[Value, Value]:
        """The time to the next knot of the table of piece j, and the lanes where there is one."""
        code, forward = frame.code, frame["forward"]
        knot, inside = self.entry(frame, j, self.table.piece(frame, j) + code.flag(forward > 0.0))
        return ((knot - frame["t"]) - frame["t_low"]) * forward, inside

    def _end_at_knot(self, frame: Frame, c: int, j: int, h: Value) -> None:
        """End the step at the next knot of the table of piece j, which is clock number c."""
        code = frame.code
        left, inside = self._time_to_knot(frame, j)
        left, size = code.maximum(left, frame.constant(0.0)), abs(h)
        nearest = frame["nearest"] * size
        if self.borders.kicking and j not in self.borders.kicking:  # of several at one instant a kick counts
            nearest = nearest - self._instant_tolerance(frame)
        sooner = inside & (left < nearest)
        if j in self.borders.kicking:  # also at the end of the motion, where the velocities are those behind it
            located = self.borders.decisions[j].table
            assert located is not None
            is_inner = self.table.piece(frame, j) < float(located.table.count - 1 - located.closed)
            at_end = (frame["forward"] > 0.0) & is_inner & code.compare("==", left, nearest) & (size > 0.0)
            sooner = sooner | (inside & at_end & code.compare("==", frame["crossed"], 0.0))
        frame.assign(sooner, nearest=left / size, crossed=StepEnd.KNOT, crossed_number=float(c))

    def _record_coincidence(self, frame: Frame, h: Value) -> None:
        """Mark knots of several tables at one instant, if one of them can depend on parameters."""
        code, end = frame.code, frame["nearest"] * abs(h)
        count, moves = frame.constant(0.0), frame.constant(0.0)
        for j in self.borders.clocks:
            left, inside = self._time_to_knot(frame, j)
            at_once = inside & (frame["crossed"] > 0.0) & (abs(left - end) <= self._instant_tolerance(frame))
            count = count + code.flag(at_once)
            if j in self.table.movable:
                moves = moves + code.flag(at_once)
        frame.assign((count > 1.0) & (moves > 0.0), crossed=StepEnd.KNOTS)

    def _instant_tolerance(self, frame: Frame) -> Value:
        """The largest difference of two times that count as equal."""
        return frame.code.maximum(abs(frame["t"]), frame["smallest"]) * (4.0 * limits.EPS)
