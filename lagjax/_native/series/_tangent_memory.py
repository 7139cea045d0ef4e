"""The tangents of a motion along directions: their memory, and access to it in kernel functions."""

from typing import Any

from llvmlite import ir

from lagjax._native.code._constants import MAX_ORDER
from lagjax._native.code._frame import Frame, Lane, Memory, Vectors
from lagjax._native.code._ir import DOUBLE, Value
from lagjax._native.series._lanes import Lines, sincos_function
from lagjax._native.series._motion_parts import MotionParts
from lagjax._native.series._tables import Tables
from lagjax._native.series._taylor import TaylorSeries, integer


class Directions:
    """The memory of the current direction of each lane, and the kernel functions that use it.

    Vectors of the motion have its own width, those of its tangents `lanes`: equal, with one member per lane, or wider,
    with the directions of one member side by side. The field `dx` has the tangents of the motion's field `x`.
    """

    def __init__(self, motion: TaylorSeries, parts: MotionParts, lanes: int):
        series, states = motion.series, motion.states
        self.motion, self.lanes, self.varied = motion, lanes, parts.varied
        self.n, self.states, self.numbers = motion.n, states, motion.parameters
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
        self.layout = Memory(lanes, fields | dict.fromkeys(numbers, 1), beside=motion.layout)
        sincos = sincos_function(motion.module, lanes, "sincos_of_tangents")
        look_up = motion.look_up
        self.form = Tables(self.function, sincos, look_up) if motion.large else Lines(sincos, look_up)

    def function(self, name: str, *kinds: ir.Type, **options) -> Frame:
        return Frame(self.motion.module, self.layout, self.motion.job, f"tangent_{name}", *kinds, **options)

    # ---- numbers of the motion, in a function of its tangents ----

    def numbers_of(self, frame: Frame, name: str, count: int, place=lambda i: (i,), in_place: bool = False) -> Vectors:
        """Vectors of the motion, copied to all lanes if it has one lane; `in_place`: at offsets known in advance."""
        motion, alike = frame.view(self.motion.layout), self.motion.width == self.lanes

        def read(i):
            address = motion.address(name, *place(i))
            return frame.code.lanes_of(frame.code.load(address, frame.vector if alike else DOUBLE))

        where = (lambda i: self.motion.layout.place(name, *place(i))) if alike and in_place else None
        return Vectors(count, read, None, where)

    def number_of(self, frame: Frame, name: str) -> Value:
        return self.numbers_of(frame, name, 1)[0]

    def inputs(self, frame: Frame, state: Vectors, t: Value, tangents: Vectors) -> list:
        """The inputs of a program at a state, followed by the tangents of the state and of the parameters."""
        params = self.numbers_of(frame, "params", self.motion.numbers, in_place=True)
        of_params = [i - self.states - 1 for i in self.varied[self.states :]]
        moving: Any = [frame["dparams", i] for i in of_params]
        if of_params == list(range(self.numbers)):  # none are integers
            moving = frame.vectors("dparams", self.numbers)
        return [state, [t], params, tangents, moving]

    # ---- lanes ----

    def lane_of_motion(self, frame: Frame, lane: Value) -> Lane:
        """The lane of the motion to which a lane of tangents belongs."""
        return frame.view(self.motion.layout).lane(lane if self.motion.width == self.lanes else lane * 0)

    def lanes_of_tangents(self, frame: Frame, lane: Value) -> list[Lane]:
        """The lanes of tangents that belong to a lane of the motion."""
        tangents, alike = frame.view(self.layout), self.motion.width == self.lanes
        return [tangents.lane(i) for i in ([lane] if alike else [integer(frame.code, j) for j in range(self.lanes)])]

    def place(self, frame: Frame, group: Value, index: Value) -> tuple[Value, Value]:
        """The number of the direction of a lane, counted over all members, and a flag: this direction exists."""
        member, directions = self.lane_of_motion(frame, index)["member"], frame.job("directions")
        direction = group if self.motion.width == self.lanes else group * self.lanes + index
        return member * directions + direction, (member >= 0) & (direction < directions)
