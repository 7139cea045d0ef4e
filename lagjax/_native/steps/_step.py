"""Step control: the size of a step, the check of its series, and the update of the state.

With the scaled norm ‖c‖ = max |cᵢ| / (a + rtol·sᵢ), sᵢ the size of component i over the step,

    h = 0.9 min(‖yₚ‖^(−1/p), ‖yₚ₋₁‖^(−1/(p−1)))

makes the last terms of the series as small as the tolerance. Source: Jorba & Zou, Exp. Math. 14 (2005) §3.2. The check
is ours: the scaled defect of the polynomial P, d = P″ − q̈(P, P′) at the middle and at the end of the step, must obey h
‖d‖ / (p+1) ≤ 1. It costs two accelerations, and detects what no coefficient shows: a border of a piecewise function, a
narrow feature ahead.

The floor a is atol if that is given. By default (atol = 0) it is rtol·min(1/1000, S/16), where S is the largest
coordinate, or velocity, of the motion so far: so a motion of 1e-10 metres has the same steps as in ångströms. A
velocity moves a coordinate by h times as much, so that S of the velocities is at least S of the coordinates divided by
the longest step so far: velocities of a motion at rest are rounding. At the start S is predicted by the series: the
largest of its terms over a step proportional to it, so that a body at rest at 1e-50 has the size that it will have one
step later. If half the steps of such a motion are rejected, the prediction is rounding, and S becomes infinite, as it
is for a motion at rest at q = 0, which has no size. Alternatives: a floor for every component would resolve rounding
where a component is zero by symmetry, and one for every array of the user would depend on how coordinates are grouped.
"""

from collections.abc import Callable

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Fields, Frame, Index, Numbers
from lagjax._native.code._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native.series._taylor import TaylorSeries, double, integer
from lagjax._native.steps._projection import Projector, end_of_step

PARTS = 2  # the motion, and derivatives of it


class StepControl:
    """The kernel functions that choose steps and check them.

    Coordinates of the same number in `error_groups` are scaled by the largest of them. The first `base_size`
    coordinates are the motion, the others derivatives of it.
    """

    def __init__(
        self, motion: TaylorSeries, error_groups: tuple[int, ...], projector: Projector | None, base_size: int
    ):
        self.motion, self.error_groups, self.projector = motion, error_groups, projector
        # The motion, and the derivatives that follow it, whose units are others.
        self.parts = [(0, base_size)] + [(base_size, motion.n - base_size)] * (motion.n > base_size)
        self.size_start = self._first_step_size()
        self.defect = self._step_defect()

    @staticmethod
    def fields(n: int) -> Fields:
        return {
            "low": 2 * n,  # what rounding took from the state
            "scale": 2 * n,  # 1 / (floor + rtol·size)
            "reach": 2 * PARTS,  # the largest coordinate, and the largest velocity, so far
            "pace": 1,  # the longest step so far
            "promised": PARTS,  # 1 if S is so far what the series promises of a motion that was at rest at zero
            "increment": 2 * n,  # P(h) − y
            "t_low": 1,  # what rounding took from the time
            "t_end": 1,  # the last output time
            "forward": 1,  # the direction of time, ±1
            "smallest": 1,  # the shortest step that may be taken
            "longest": 1,  # the longest step that may be tried next
            "growth": 1,  # by which factor the next step may be longer
            "last": 1,  # 1 if the step ends at `t_end`
            "defect": 1,  # the largest scaled defect of the step, of its series and its projection
            "series_defect": 1,  # that of the series alone
            "code": 1,  # how the member has ended (`_constants`), or `RUNNING`
            "steps": 1,  # the number of steps taken
            "rejected": 1,  # the number of steps refused
        }

    # ---- the size of a step ----

    def choose(self, frame: Frame, order: Value) -> None:
        """Set the step `h` of every lane; 0, with a code, where the motion cannot continue."""
        code = frame.code
        with code.only_if(code.any_lane(code.compare("==", frame["steps"], 0.0))):
            frame.call(self.size_start, order)
        last, before = self._last_term_norms(frame, order)
        p = code.as_number(order)
        a, b = _approximate_power(code, last, -1.0 / p), _approximate_power(code, before, -1.0 / (p - 1.0))
        size, longest = limits.SAFETY * code.select(a < b, a, b), frame["longest"]
        size = code.select(size < longest, size, longest)
        frame["growth"] = limits.GROWTH
        forward, end = frame["forward"], frame["t_end"]
        left = ((end - frame["t"]) - frame["t_low"]) * forward
        is_last = size >= left
        step = code.select(is_last, left, size)
        active, singular = frame["active"] > 0.0, frame["singular"] > 0.0
        sound = (last < float("inf")) & (before < float("inf")) & ~singular
        small = ~is_last & (step < frame["smallest"])
        going = active & sound & ~small
        ending = code.select(small, limits.STEP_TOO_SMALL, float(limits.RUNNING))
        frame["code"] = code.select(sound, ending, code.select(singular, limits.SINGULAR, float(limits.NOT_FINITE)))
        frame["h"] = code.select(going, step * forward, 0.0)
        frame["last"] = going & is_last

    def _last_term_norms(self, frame: Frame, order: Value) -> tuple[Value, Value]:
        """The scaled norms of the last two coefficients; `scale` is set to 1 / (floor + rtol·size)."""
        code, n = frame.code, self.motion.n
        rtol = code.lanes_of(frame.job("rtol"))
        errors = [code.variable(frame.constant(0.0)) for _ in range(2)]
        for half in range(2):
            sizes = self._motion_sizes(frame, half)
            for part, (first, count) in enumerate(self.parts):
                floor = self._absolute_tolerance(frame, half, part, sizes)
                for j in self.motion.form.each(code, count):
                    i = first + j
                    rate = abs(frame["y", i + half * n, 1])
                    scale = 1.0 / (floor + rtol * sizes[i])
                    frame["scale", i + half * n] = scale
                    for k in range(2):
                        error = abs(frame["y", i + half * n, order - k]) * scale
                        errors[k].value = code.largest_or_nan(errors[k].value, error)
                    # An infinite slope may leave no trace in the last coefficients.
                    sound = code.select(rate < float("inf"), errors[0].value, float("nan"))
                    errors[0].value = sound
        return errors[0].value, errors[1].value

    def _absolute_tolerance(self, frame: Frame, half: int, part: int, sizes: Numbers) -> Value:
        """The absolute tolerance of the coordinates (half 0) or velocities (half 1) of a part of the motion."""
        code, form, (first, count), place = frame.code, self.motion.form, self.parts[part], 2 * part + half
        given, rtol = (code.lanes_of(frame.job(name)) for name in ("atol", "rtol"))
        largest = form.largest(code, lambda i: sizes[first + i], count)
        step = code.lanes_of(code.select(frame["pace"] > 0.0, frame["pace"], frame["longest"]))  # before the first step
        frame["reach", place] = largest = code.maximum(frame["reach", place], largest)
        if half:
            by_position = frame["reach", 2 * part] / step
            largest = code.select(by_position < largest, largest, by_position)
        share = limits.ATOL_OVER_MOTION * largest
        is_small = (share > 0.0) & (share < limits.ATOL_OVER_RTOL)
        floor = rtol * code.select(is_small, share, limits.ATOL_OVER_RTOL)
        return code.select(given > 0.0, given, floor)

    def _first_step_size(self) -> Code:
        """Emit `(order)`: predict `reach` (S) in lanes without steps; infinite if nothing, or only rounding, moves."""
        motion = self.motion
        frame = motion.function("size_start", INTEGER)
        code, (order,) = frame.code, frame.arguments
        given, rtol = (code.lanes_of(frame.job(name)) for name in ("atol", "rtol"))
        begins, p = code.compare("==", frame["steps"], 0.0), code.as_number(order)
        for part, (first, count) in enumerate(self.parts):

            def largest(k, first=first, count=count):
                return motion.form.largest(code, lambda i: abs(frame["y", first + i, k]), count)

            step = code.variable(frame["longest"])
            for back in range(2):  # the last terms are to be a part of one that is five orders lower, or more
                last, allowed = largest(order - back), code.variable(frame.constant(0.0))
                with code.loop(order - (back + 4)) as k:
                    term = largest(k)
                    ratio = last / (rtol * limits.ATOL_OVER_MOTION * term)
                    h = _approximate_power(code, ratio, code.lanes_of(-1.0 / (p - float(back) - code.as_number(k))))
                    allowed.value = code.select((term > 0.0) & (h > allowed.value), h, allowed.value)
                step.value = code.select(allowed.value < step.value, allowed.value, step.value)
            reach, power = code.variable(frame.constant(0.0)), code.variable(frame.constant(1.0))
            begun = code.maximum(largest(0), largest(1) * step.value)
            with code.loop(order - 4) as k:
                reach.value = code.maximum(largest(k) * power.value, reach.value)
                power.value = power.value * step.value
            moves = (reach.value > 0.0) & (begun > 0.0)  # from rest at zero what moves first may be rounding
            promised = moves & ((2.0 * begun <= reach.value) | (begun < limits.NOTHING)) & ~(given > 0.0)
            size, speed = (code.select(moves, x, float("inf")) for x in (reach.value, reach.value / step.value))
            with frame.where(begins):
                frame["reach", 2 * part], frame["reach", 2 * part + 1] = size, speed
                frame["promised", part] = code.flag(promised)
        return frame.finish()

    def _forget_size_promise(self, frame: Frame, where: Value) -> None:
        """Set S to infinity where steps of a motion that started at rest at zero are rejected."""
        code, n = frame.code, self.motion.n
        most = code.lanes_of(1.0 / (limits.ATOL_OVER_RTOL * frame.job("rtol")))
        for part, (first, count) in enumerate(self.parts):
            forgets = where & (frame["promised", part] > 0.0)
            for half in range(2):
                with frame.where(forgets):
                    frame["reach", 2 * part + half] = float("inf")
                for j in self.motion.form.each(code, count):
                    i = first + j + half * n
                    scale = frame["scale", i]
                    frame["scale", i] = code.select(forgets & (most < scale), most, scale)

    def _motion_sizes(self, frame: Frame, half: int) -> Numbers:
        """The size over the step of every coordinate, or velocity (half 1): the largest one in its error group."""
        code, first = frame.code, half * self.motion.n
        before = code.lanes_of(abs(frame["h"]))

        def largest(i):
            # A component that passes through zero is as large as it will be a step away.
            y, rate = (abs(frame["y", i + first, k]) for k in range(2))
            if self.projector is not None and self.projector.scales(i):
                scale = frame["velocity_scale", i]
                y, rate = (code.maximum(y, scale), rate) if half else (y, code.maximum(rate, scale))
            return code.maximum(y, rate * before)

        return self.motion.form.largest_by_group(frame, largest, self.error_groups)

    # ---- whether its series holds ----

    def _step_defect(self) -> Code:
        """Emit `(order, place)`: `defect` = max with h ‖P″ − q̈(P, P′)‖ / (p+1) there; `increment` = P − y."""
        motion, n = self.motion, self.motion.n
        frame = motion.function("defect", INTEGER, DOUBLE)
        code, (order, place), h = frame.code, frame.arguments, frame["h"]
        s = code.lanes_of(place) * h
        increments, slopes = motion.increments(frame, order, s)
        for i in motion.form.each(code, motion.states):
            frame["increment", i] = increments[i]
        moved = motion.move_state(frame, increments)
        acceleration = motion.evaluate(frame, motion.acceleration, moved, s)
        noise = self._acceleration_noise(frame, acceleration, increments, moved)
        defect, size = code.variable(frame["defect"]), code.lanes_of(abs(h))
        weight = size / code.as_number(order + 1)
        for i in motion.form.each(code, n):
            # What rounding leaves of an acceleration is not a defect of the series.
            excess = abs(acceleration[i] - slopes[i]) - noise(i)
            error = weight * excess * frame["scale", i + n]
            defect.value = code.largest_or_nan(defect.value, error)
        frame["defect"] = defect.value
        return frame.finish()

    def _acceleration_noise(self, frame: Frame, acceleration, increments, moved) -> Callable[[Index], Value]:
        """A function of i: the rounding error of component i of an acceleration within the step."""
        code, n, form = frame.code, self.motion.n, self.motion.form

        def size_of(numbers):
            return lambda i: abs(numbers[i])

        size = form.largest_by_group(frame, size_of(acceleration), self.error_groups)
        # Half a unit in the last place of q moves an acceleration by what it varies along the step, in proportion.
        place, moves = (form.largest(code, size_of(numbers), n) for numbers in (moved, increments))
        unit = limits.UNIT * place / moves
        unit = code.select(unit < limits.LARGEST_UNIT, unit, 0.0)  # what hardly moves is not what makes it vary

        def noise(i):
            change = abs(acceleration[i] - frame["y", i + n, 1])
            return limits.ROUND_OFF * size[i] + unit * change

        return noise

    def halve_until_sound(self, frame: Frame, order: Value) -> None:
        """Check the steps of all lanes, and halve those that fail, until none does."""
        code = frame.code
        again = code.variable(integer(code, 1))
        with code.repeat_while(lambda: again.value > 0):
            again.value = 0
            frame["defect"] = 0.0
            for place in limits.CHECKS:
                frame.call(self.defect, order, double(code, place))
            if self.projector is not None:
                frame["series_defect"] = frame["defect"]
                frame.call(self.projector.project)
            bad = ~(frame["defect"] <= 1.0) & code.compare("!=", frame["h"], 0.0)
            with code.only_if(code.any_lane(bad)):
                again.value = 1
                half = 0.5 * frame["h"]
                small = bad & (abs(half) < frame["smallest"])
                frame["h"] = code.select(small, 0.0, code.select(bad, half, frame["h"]))
                with frame.where(small):
                    frame["code"] = self._small_step_reason(frame)
                frame["rejected"] = frame["rejected"] + code.flag(bad)
                frame.assign(bad, last=0.0, growth=limits.GROWTH_AFTER_REJECTION)  # nor is it the last one any more
                often = (frame["rejected"] >= limits.MOST_REFUSED) & (2.0 * frame["rejected"] >= frame["steps"])
                self._forget_size_promise(frame, bad & often)

    def _small_step_reason(self, frame: Frame) -> Value:
        """The code of a step that became too small: because of its series, or only because of the projection."""
        reason = frame.constant(limits.STEP_TOO_SMALL)
        if self.projector is None:
            return reason
        return frame.code.select(frame["series_defect"] <= 1.0, limits.PROJECTION_FAILED, reason)

    # ---- the step ----

    def end_time(self, frame: Frame) -> tuple[Value, Value]:
        """The time at the end of the step, and its rounding error."""
        t, low, h = frame["t"], frame["t_low"], frame["h"]
        rough = t + h
        part = rough - t
        rest = low + ((t - (rough - part)) + (h - part))  # Knuth's two-sum
        after = rough + rest
        rest = rest - (after - rough)
        is_last = frame["last"] > 0.0
        return frame.code.select(is_last, frame["t_end"], after), frame.code.select(is_last, 0.0, rest)

    def advance(self, frame: Frame, after: Value, rest: Value, kicks: bool) -> None:
        """Set time and state, with carried rounding errors, to the end of the step, and count it."""
        code, h = frame.code, frame["h"]
        moving = frame["counts"] > 0.0 if kicks else code.compare("!=", h, 0.0)
        frame.assign(moving, t=after, t_low=rest)
        frame["longest"] = abs(h) * frame["growth"]
        frame["pace"] = code.maximum(frame["pace"], abs(h))
        for i in self.motion.form.each(code, self.motion.states):
            total, rest = end_of_step(frame, i)
            if self.projector is not None:
                total = frame["projected", i]
            y, low = frame["y", i], frame["low", i]
            frame["y", i] = code.select(moving, total, y)
            frame["low", i] = code.select(moving, rest, low)
        frame["steps"] = frame["steps"] + code.flag(moving)


def absolute_tolerance(frame: Frame) -> Value:
    """The absolute tolerance of numbers whose units differ from those of the state, such as guards."""
    given = frame.job("atol")
    return frame.code.select(given > 0.0, given, limits.ATOL_OVER_RTOL * frame.job("rtol"))


def _approximate_power(code: Code, x: Value, exponent: Value) -> Value:
    """The power x**exponent to one per cent, for 0 < −exponent < 1/4: enough for the size of a step.

    The bits of a number, read as an integer, are nearly its logarithm; parabolas correct the fractional part.
    """
    unit, bias = 2.0**52, 1023.0
    bits = code.as_number(code.bits(x)) / unit - bias
    whole = code.intrinsic("floor", bits)
    part = bits - whole
    log2 = whole + part * (1.34 - 0.34 * part)
    target = code.lanes_of(exponent) * log2
    whole = code.intrinsic("floor", target)
    part = target - whole
    return code.from_bits((whole + part * (0.66 + 0.34 * part) + bias) * unit)
