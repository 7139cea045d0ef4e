"""Roots of a polynomial P on [0, 1], in each lane; by bounds instead of samples, so that no root is missed.

With M ≥ |P″| on the whole interval, P(x + d) ≥ P(x) + P′(x) d − M d²/2: while the right side is positive there is no
root. From x the search moves to where it vanishes. That converges to the first root, quadratically to a simple one;
past a point where P touches zero to rounding, it moves by less than what P could do within rounding.

The truncation error of the series is estimated by its last terms, times the power after them. If P comes so near to
zero without changing its sign, the search ends there, because a step that ends there has a series that decides.
"""

import math
from collections.abc import Callable

from lagjax._native.code._constants import EPS, MAX_ORDER, MEETS, MOST_HALVINGS, MOST_MOVES, ROOT_NOISE, SMALL
from lagjax._native.code._frame import Fields, Frame
from lagjax._native.code._ir import INTEGER, Code, Value
from lagjax._native.series._taylor import TaylorSeries, integer


class Roots:
    """Kernel functions for the polynomial `poly`, with `degree + 1` coefficients.

    `first_root(degree)` finds the first root. P is known to the rounding of its largest value; if P(0) is more negative
    than that, the root is 0. `next_root(degree)` begins at `begin`, where P may be zero; it needs `store_bounds`.
    """

    def __init__(self, motion: TaylorSeries):
        self.motion = motion
        self.next_root = self._next_root()
        self.first_root = self._first_root()

    @staticmethod
    def fields(columns: int) -> Fields:
        return {
            "poly": columns,  # the coefficients of P on [0, 1]
            "root": 1,  # the root, or up to where there is none; 2 without any
            "is_root": 1,  # 0 where only a part of the way was looked at, up to `root`
            "slope": 1,  # P′ at the root
            "error": 1,  # how well P is known there
            "divided": 1,  # by how many powers P was divided
            "begin": 1,  # where the search begins
            "unsure": 1,  # the rounding of P
            "doubt": 1,  # what P leaves out, as the factor of the power after its last one
            "instant": 1,  # what is closer is one place
            "closer": 1,  # 1 to end the search where P is zero to its rounding, and may cross it undetected
            "part": 1,  # of the step that [0, 1] is
            "falls": 1,  # Σ of the negative coefficients but P(0), as a size
            "rises": 1,  # Σ of the positive ones
            "down": 1,  # the bound of −P″
            "up": 1,  # the bound of P″
        }

    # ---- a number along the step as a polynomial ----

    def polynomial(self, frame: Frame, j: Value, degree: Value, h: Value, side: Value, level: "Value | float") -> None:
        """Store σ (u − level) over the step, u being followed number j, as a polynomial on [0, 1] in `poly`."""
        code, motion = frame.code, self.motion
        frame["poly", 0] = side * (motion.followed_value(frame, j) - level)
        power = code.variable(side * h)
        with code.loop(degree + 1, start=1) as k:
            frame["poly", k] = motion.followed_coefficient(frame, j, k) * power.value
            power.value = power.value * h
        frame["poly", degree + 1] = 0.0

    def coefficient_sum(self, frame: Frame, degree: Value) -> Value:
        """The sum Σ |cₖ| of the coefficients, a bound of |P|."""
        code, size = frame.code, frame.code.variable(frame.constant(0.0))
        with code.loop(degree + 1) as k:
            size.value += abs(frame["poly", k])
        return size.value

    def last_terms(self, frame: Frame, degree: Value, first: int = 0) -> Value:
        """The sum of three |cₖ|, the last ones or those `first` before: single ones may be zero by symmetry."""
        last = [abs(frame["poly", degree - (first + k)]) for k in range(3)]
        return last[0] + last[1] + last[2]

    def shorten(self, frame: Frame, degree: Value, is_long: Callable[[], Value]) -> None:
        """Halve the interval while `is_long()`; `part` is the fraction that is left."""
        code = frame.code
        frame["part"] = 1.0
        again = code.variable(integer(code, 1))
        with code.repeat_while(lambda: again.value > 0, at_most=MOST_HALVINGS):
            again.value = 0
            long = is_long()
            with code.only_if(code.any_lane(long)):
                again.value = 1
                self.stretch(frame, degree, code.select(long, 0.5, 1.0))

    def shorten_to(self, frame: Frame, degree: Value, rtol: Value, atol: Value, share: float = math.inf) -> None:
        """Halve the interval until the last terms are below rtol Σ |cₖ| + atol, or + `share` Σ |cₖ| if less."""

        def is_long():
            size, least = self.coefficient_sum(frame, degree), frame.code.lanes_of(atol)
            if share < math.inf:
                least = frame.code.select(share * size < least, share * size, least)
            return self.last_terms(frame, degree) > size * rtol + least

        self.shorten(frame, degree, is_long)

    def stretch(self, frame: Frame, degree: Value, part: "Value | float", times: "Value | float" = 1.0) -> None:
        """Rescale the polynomial to a fraction `part` of its interval, and multiply it by `times`."""
        code = frame.code
        frame["part"] = frame["part"] * part
        power = code.variable(code.lanes_of(times))
        with code.loop(degree + 1) as k:
            frame["poly", k] = frame["poly", k] * power.value
            power.value = power.value * part

    def divide(self, frame: Frame, degree: Value, powers: Value) -> None:
        """Divide P by s once per root at 0 that is not searched, and by further powers while P(0) vanishes."""
        code, left = frame.code, frame.code.variable(powers)
        frame["divided"] = 0.0
        with code.repeat_while(lambda: code.any_lane(left.value > 0.0), at_most=MAX_ORDER):
            divided = left.value > 0.0
            frame["divided"] = frame["divided"] + code.flag(divided)
            with code.loop(degree + 1) as k:
                frame.assign(divided, k, poly=frame["poly", k + 1])
            vanishes = divided & code.compare("==", frame["poly", 0], 0.0)
            left.value = code.select(vanishes, code.maximum(left.value - 1.0, 1.0), left.value - 1.0)

    def leading_sign(self, frame: Frame, degree: Value) -> Value:
        """The sign of the first nonzero coefficient after c₀; 0 without any."""
        code, sign = frame.code, frame.code.variable(frame.constant(0.0))
        with code.loop(degree) as i:
            c = frame["poly", degree - i]
            sign.value = code.select(code.compare("!=", c, 0.0), code.select(c > 0.0, 1, -1.0), sign.value)
        return sign.value

    def undivided_slope(self, frame: Frame) -> Value:
        """The slope, at the root, of P before the division by powers of s."""
        code, slope, left = frame.code, *(frame.code.variable(frame[name]) for name in ("slope", "divided"))
        with code.repeat_while(lambda: code.any_lane(left.value > 0.0), at_most=MAX_ORDER):
            slope.value = code.select(left.value > 0.0, slope.value * frame["root"], slope.value)
            left.value = left.value - 1.0
        return slope.value

    # ---- its roots ----

    def is_found(self, frame: Frame) -> Value:
        return (frame["is_root"] > 0.0) & (frame["root"] < 1.0)

    def step_fraction(self, frame: Frame, otherwise: float) -> Value:
        """The root, or the end of the search, as a fraction of the step; `otherwise` if the whole step was searched."""
        code, root, part = frame.code, frame["root"], frame["part"]
        return code.select(root < 1.0, root * part, code.select(part < 1.0, part, otherwise))

    def _first_root(self) -> Code:
        frame = self.motion.function("first_root", INTEGER)
        frame["begin"], frame["doubt"], frame["instant"], frame["closer"] = 0.0, 0.0, EPS, 0.0
        code = frame.code
        self.store_bounds(frame, *frame.arguments)

        def size():
            return abs(frame["poly", 0]) + frame["falls"] + frame["rises"]

        least, largest = size() < SMALL, size() > 1 / SMALL
        with code.only_if(code.any_lane(least | largest)):
            times = code.select(least, 1 / SMALL**2, code.select(largest, SMALL**2, 1.0))
            self.stretch(frame, frame.arguments[0], 1.0, times)
            self.store_bounds(frame, *frame.arguments)
        frame["unsure"] = (ROOT_NOISE * EPS) * size()
        frame.call(self.next_root, *frame.arguments)
        return frame.finish()

    def store_bounds(self, frame: Frame, degree: Value) -> None:
        """Store bounds of the fall and the rise of P, and of −P″ and P″, for `next_root`."""
        code, zero = frame.code, frame.constant(0.0)
        falls, rises, down, up = (code.variable(zero) for _ in range(4))
        with code.loop(degree + 1, start=1) as k:
            c, number = frame["poly", k], code.as_double(k)
            negative, bend = code.select(c < 0.0, c, zero), number * (number - 1.0)
            positive = c - negative
            falls.value += 0.0 - negative
            rises.value += positive
            down.value += negative * (0.0 - bend)
            up.value += positive * bend
        frame["falls"], frame["rises"], frame["down"], frame["up"] = falls.value, rises.value, down.value, up.value

    def negate(self, frame: Frame, degree: Value, where: Value) -> None:
        code = frame.code
        with code.loop(degree + 1) as k:
            c = frame["poly", k]
            frame["poly", k] = code.select(where, 0.0 - c, c)
        for one, other in (("falls", "rises"), ("down", "up")):
            a, b = frame[one], frame[other]
            frame[one], frame[other] = code.select(where, b, a), code.select(where, a, b)

    def _next_root(self) -> Code:
        frame = self.motion.function("next_root", INTEGER)
        code, (degree,), start, falls = frame.code, frame.arguments, frame["poly", 0], frame["falls"]
        frame["root"], frame["is_root"] = 2.0, 1.0
        searching = ~(start > falls + frame["doubt"]) & ((falls > 0.0) | (start < 0.0)) & (frame["begin"] < 1.0)
        with code.only_if(code.any_lane(searching)):
            self._march_to_root(frame, degree, searching)
        return frame.finish()

    def _march_to_root(self, frame: Frame, degree: Value, searching: Value) -> None:
        """Search for the first root from `begin` on, with bounds `down` of −P″ and `up` of P″."""
        code, down = frame.code, frame["down"]
        bend = code.maximum(down, frame["up"])
        at_start = (ROOT_NOISE * EPS) * abs(frame["poly", 0]) + frame["unsure"]
        along = (ROOT_NOISE * EPS) * (frame["falls"] + frame["rises"])
        x, going = (code.variable(y) for y in (frame["begin"], code.flag(searching)))

        def active():
            return going.value > 0.0

        with code.repeat_while(lambda: code.any_lane(active()), at_most=MOST_MOVES):
            here, now = x.value, active()
            value, slope = self.value_and_slope(frame, degree, here)
            square = here * here
            noise, left_out = at_start + along * here, frame["doubt"] * ((square * square) * (square * square))
            error = noise + left_out
            # A slope that what is not known, and the bend, cannot undo.
            near, steep = value <= error, slope * slope > 4.0 * (bend * error)
            is_root = now & ((value < 0.0 - error) | (near & steep & (slope < 0.0)))
            open = now & near & ~is_root & ~(steep & (slope > 0.0))
            touches = (frame["closer"] > 0.0) & (frame["poly", 0] > MEETS * error) & (here > frame["begin"])
            ends = is_root | (open & ((left_out > noise) | touches))
            with code.only_if(code.any_lane(ends)):
                self._record_root(frame, here, (value, slope, error, bend), is_root, ends)
            root = code.intrinsic("sqrt", code.maximum(slope * slope + 2.0 * (down * value), 0.0))
            rising = slope > 0.0
            numerator = code.select(rising, slope + root, 2.0 * value)
            denominator = code.select(rising, down, root - slope)
            after = code.variable(here + numerator / denominator)
            with code.only_if(code.any_lane(open)):
                after.value = code.select(open, here + self._rounding_distance(frame, error, bend), after.value)
            x.value = code.select(now, after.value, here)
            going.value = code.flag(now & ~ends & (after.value < 1.0))
        frame.assign(active(), is_root=0.0, root=x.value)

    def _record_root(self, frame: Frame, here: Value, known: tuple[Value, ...], is_root: Value, ends: Value) -> None:
        """Store a root, or the end of the search; a root is improved by one bounded Newton step."""
        code, (value, slope, error, bend) = frame.code, known
        hop, back = self._rounding_distance(frame, error, bend), value / slope
        back = code.select((slope < 0.0) & (here > frame["begin"]), code.select(back < hop, back, hop), 0.0)
        place = code.select(is_root, code.maximum(here - back, frame["begin"]), here)
        frame.assign(ends, root=place, is_root=is_root, slope=slope, error=error)

    def _rounding_distance(self, frame: Frame, error: Value, bend: Value) -> Value:
        """The distance from a zero within which P cannot exceed its error, given a bound of P″."""
        code = frame.code
        return code.maximum(code.intrinsic("sqrt", 2.0 * error / bend), frame["instant"])

    def value_and_slope(self, frame: Frame, degree: Value, x: Value) -> tuple[Value, Value]:
        code = frame.code
        value, slope = code.variable(frame["poly", degree]), code.variable(frame.constant(0.0))
        with code.loop(degree + 1, start=1) as k:
            before = value.value
            slope.value = slope.value * x + before
            value.value = before * x + frame["poly", degree - k]
        return value.value, slope.value
