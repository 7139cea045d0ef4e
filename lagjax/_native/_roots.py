"""The first root of a polynomial on [0, 1], lane by lane: no sampling, so that none is stepped over.

With M ≥ −P″ on the whole interval, P(x + d) ≥ P(x) + P′(x) d − M d²/2: as long as the right side is positive there is
no root. From x = 0 on, x moves to where it vanishes. That converges to the first root, at a simple one quadratically;
past a touch, where P is zero to rounding and does not fall, it hops, by less than what P could do unseen.
"""

from lagjax._native._constants import EPS, MOST_MOVES, ROOT_NOISE
from lagjax._native._frame import Frame
from lagjax._native._ir import INTEGER, Code, Value
from lagjax._native._series import Motion, integer


class Roots:
    """The function `first_root(degree)`: from the coefficients in `poly` the first root, into `root`; 2 without any.

    Where P(0) is negative beyond rounding the root is 0. `is_root` is 0 where only a part of the way was looked at: up
    to `root`, where there is none.
    """

    def __init__(self, motion: Motion):
        self.motion = motion
        self.first_root = self._first_root()

    @staticmethod
    def fields(columns: int) -> dict:
        """What a thread remembers for it."""
        return {"poly": columns, "root": 1, "is_root": 1}

    def _first_root(self) -> Code:
        frame = self.motion.function("first_root", INTEGER)
        code, (degree,), zero = frame.code, frame.arguments, frame.constant(0.0)
        falls, size, bend = (code.variable(x) for x in (zero, code.intrinsic("fabs", frame["poly", 0]), zero))
        with code.loop(degree + 1, start=1) as k:
            c, number = frame["poly", k], code.as_double(k)
            down = code.select(c < 0.0, -c, zero)
            for sum, term in ((falls, down), (size, code.intrinsic("fabs", c)), (bend, down * (number * (number - 1)))):
                code.store(code.load(sum, frame.vector) + term, sum)
        start, falls, size, bend = frame["poly", 0], *(code.load(x, frame.vector) for x in (falls, size, bend))
        frame["root"], frame["is_root"] = 2.0, 1.0
        searching = ~(start > falls) & ((falls > 0.0) | (start < 0.0))
        with code.only_if(code.any_lane(searching)):
            self._march(frame, degree, searching, bend, (ROOT_NOISE * EPS) * size)
        return frame.finish()

    def _march(self, frame: Frame, degree: Value, searching: Value, bend: Value, noise: Value) -> None:
        code = frame.code
        x, going, left = (code.variable(y) for y in (
            frame.constant(0.0), code.select(searching, frame.constant(1), 0.0), integer(code, MOST_MOVES),
        ))  # fmt: skip
        steep = code.intrinsic("sqrt", 2.0 * (bend * noise))  # a slope that noise and bend cannot undo
        hop = code.intrinsic("sqrt", 2.0 * noise / bend)

        def active():
            return code.load(going, frame.vector) > 0.0

        with code.repeat_while(lambda: code.any_lane(active()) & (code.load(left, INTEGER) > 0)):
            code.store(code.load(left, INTEGER) - 1, left)
            here = code.load(x, frame.vector)
            value, slope = self._at(frame, degree, here)
            falling = slope < 0.0 - steep
            near = value <= noise
            is_root = active() & ((value < 0.0 - noise) | (near & falling))
            mended = here - code.select(near & falling & (here > 0.0), value / slope, 0.0)
            frame["root"] = code.select(is_root, code.select(mended > 0.0, mended, 0.0), frame["root"])
            root = code.intrinsic("sqrt", slope * slope + 2.0 * (bend * value))
            ahead = code.select(slope > 0.0, (slope + root) / bend, 2.0 * value / (root - slope))
            after = here + code.select(near, hop, ahead)
            code.store(code.select(active(), after, here), x)
            goes_on = active() & ~is_root & (after < 1.0)
            code.store(code.select(goes_on, frame.constant(1), 0.0), going)
        frame["is_root"] = code.select(active(), 0.0, frame["is_root"])
        frame["root"] = code.select(active(), code.load(x, frame.vector), frame["root"])

    def _at(self, frame: Frame, degree: Value, x: Value) -> tuple[Value, Value]:
        """The polynomial and its slope, by Horner's scheme."""
        code = frame.code
        value, slope = code.variable(frame["poly", degree]), code.variable(frame.constant(0.0))
        with code.loop(degree + 1, start=1) as k:
            before = code.load(value, frame.vector)
            code.store(code.load(slope, frame.vector) * x + before, slope)
            code.store(before * x + frame["poly", degree - k], value)
        return code.load(value, frame.vector), code.load(slope, frame.vector)
