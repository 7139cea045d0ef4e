"""The memory of the cotangents of a step: where the pullbacks of its maps read and add."""

from lagjax._native.code._constants import MAX_ORDER
from lagjax._native.code._frame import Frame, Index, Numbers, Vectors
from lagjax._native.code._ir import DOUBLE
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._table_reads import lane_of
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._program import Table


class Cotangents:
    """Kernel functions that add cotangents of a motion; the field `x_ct` has the cotangents of the field `x`."""

    def __init__(self, motion: TaylorSeries, parts: MotionParts):
        self.motion, self.varied = motion, parts.varied

    @staticmethod
    def fields(parts: MotionParts) -> dict:
        """The fields of a thread's memory for the cotangents of the state, its series and their rows."""
        series, states = parts.series, 2 * parts.series.size
        return {
            "state_ct": states,
            "y_ct": (states, MAX_ORDER + 1),
            "rows_ct": series.rows,
            "values_ct": series.values,
            "params_ct": parts.program.size - states - 1 - parts.pieces,
        }

    def store(self, frame: Frame, cotangents: Numbers, more: "Vectors | None" = None) -> None:
        """Set the cotangent of the state, plus `more`, and add the cotangents of the parameters."""
        form, states = self.motion.form, self.motion.states
        for i in form.each(frame.code, states):
            frame["state_ct", i] = cotangents[i] if more is None else more[i] + cotangents[i]
        params = [i - states - 1 for i in self.varied[states:]]
        if params == list(range(self.motion.parameters)):
            for i in form.each(frame.code, len(params)):
                add(frame, cotangents[i + states], "params_ct", i)
        else:  # some are integers
            for k, i in enumerate(params):
                add(frame, cotangents[states + k], "params_ct", i)

    def store_entries(self, frame: Frame, tables: tuple[Table, ...], out: Numbers, first: int) -> None:
        """Add the cotangents of table entries, in `out` from `first` on, to those of the members' parameters."""
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


def add(frame: Frame, x, name: str, *indices: Index) -> None:
    frame[name, *indices] = frame[name, *indices] + x
