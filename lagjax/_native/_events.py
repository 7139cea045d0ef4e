"""Where a motion meets a surface: the first change of sign of its guards along a step, to the last digit.

    begin_sides    which side of every surface a motion begins on
    sample         the guards along the step; it is halved until they are smooth there
    first change   between samples of different sign, or about the least of samples of one sign
    root           by bisection

The step then ends at the earliest change of all guards.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

from lagjax._native._constants import (
    BETWEEN,
    BISECTIONS,
    GOLDEN,
    GUARD_NOISE,
    INSTANT,
    INTERVALS,
    JUMP,
    LITTLE,
    NEAR_LEAST,
    NOTICEABLE,
    SAMPLES,
    SECTIONS,
    SMOOTH,
    TOUCHING,
)
from lagjax._native._frame import Frame
from lagjax._native._ir import INTEGER, Code, Value
from lagjax._native._series import Motion, double, integer
from lagjax._native._step import StepControl, note_halved
from lagjax._program._series import StraightLine


class _Change(NamedTuple):
    """Variables of a search: the side before, the bracket about the first change, and 1 (falls), 2 (rises) or 0."""

    side: Value
    low: Value
    high: Value
    kind: Value


class Events:
    """The changes of sign that end a motion: those of the guards `line`, each in its direction (−1, 0, +1).

    The outputs of `line` are what `Guards` says of its program.
    """

    def __init__(self, motion: Motion, step: StepControl, line: StraightLine, directions: tuple[int, ...]):
        self.motion, self.step, self.line, self.directions = motion, step, line, directions
        self.guard = self._guard()
        self.begin_sides = self._begin_sides()

    @staticmethod
    def fields(guards: int) -> dict:
        """What a thread remembers for it.

        For every guard its value, the side before the step, its rounding, where it changes and how; then the guards at
        the samples, the step before it was cut, and the event.
        """
        numbers = dict.fromkeys(("guard", "side", "noise", "root", "change"), guards)
        return numbers | {"samples": (guards, SAMPLES), "planned": 1, "event": 1}

    # ---- the guards ----

    def _guard(self) -> Code:
        """`(order, s)`: the guards at that time after the present one, lane by lane, into `guard`."""
        frame = self.motion.function("guard", INTEGER, self.motion.vector)
        order, s = frame.arguments
        line = self.line._replace(outputs=self.line.outputs[: len(self.directions)])
        moved = self.motion.moved(frame, self.motion.increments(frame, order, s)[0])
        guards = self.motion.evaluate(frame, line, moved, s)
        for i in range(len(self.directions)):
            frame["guard", i] = guards[i]
        return frame.finish()

    def _at(self, frame: Frame, order: Value, i: int, s: Value) -> Value:
        """Guard i a time s after the present one."""
        frame.call(self.guard, order, s)
        return frame["guard", i]

    def _begin_sides(self) -> Code:
        """`(order)`: for lanes at the start of a run, the side of each surface they are on, into `side`;
        and what rounding makes of a guard, into `noise`.

        On the surface, to rounding, it is the side that the motion goes to: by its rate or, where that is zero to
        rounding too, by where it is a little later.
        """
        frame = self.motion.function("begin_sides", INTEGER)
        code, (order,), count = frame.code, frame.arguments, len(self.directions)
        fresh = code.compare("==", frame["steps"], 0.0)
        with code.only_if(code.any_lane(fresh)):
            frame.call(self.guard, order, LITTLE * frame["h"])
            instant = INSTANT * frame["smallest"]
            out = self.motion.evaluate_now(frame, self.line)
            for i in range(count):
                value, rate, size, rate_size = (out[i + k * count] for k in range(4))
                moved = code.intrinsic("fabs", rate)
                on_it = code.intrinsic("fabs", value) <= GUARD_NOISE * size + moved * instant
                going = code.select(moved > GUARD_NOISE * rate_size, rate, frame["guard", i])
                frame["side", i] = code.select(fresh, code.select(on_it, going, value), frame["side", i])
                frame["noise", i] = code.select(fresh, GUARD_NOISE * size, frame["noise", i])
        return frame.finish()

    # ---- the earliest change ends the step ----

    def stop(self, frame: Frame, order: Value) -> None:
        """Where a guard changes sign along the step, the step ends there: at the earliest change of all guards."""
        code = frame.code
        frame.call(self.begin_sides, order)
        self._sample(frame, order)
        for i, direction in enumerate(self.directions):
            self._first_change(frame, order, i, direction)
        nearest = frame["h"]
        changes = [(frame["change", i], frame["root", i]) for i in range(len(self.directions))]
        for change, root in changes:
            sooner = (change > 0.0) & (code.intrinsic("fabs", root) < code.intrinsic("fabs", nearest))
            nearest = code.select(sooner, root, nearest)
        latest = code.intrinsic("fabs", nearest) + frame["smallest"]  # the same instant
        event = frame.constant(0.0)
        for i, (change, root) in enumerate(changes):
            event = event + code.select(code.intrinsic("fabs", root) <= latest, change * float(4**i), 0.0)
        stops = event > 0.0
        frame["event"] = code.select(stops, event, -1.0)
        frame["last"] = code.select(stops, 0.0, frame["last"])
        frame["h"] = nearest
        with code.only_if(code.any_lane(code.compare("!=", nearest, frame["planned"]))):
            frame.call(self.step.defect, order, double(code, 1.0))  # leaves the increment of the new step
            if self.step.projector is not None:
                frame.call(self.step.projector.project)

    # ---- samples ----

    def _sample(self, frame: Frame, order: Value) -> None:
        """The guards at equal distances along the step and one beyond either end, into `samples`.

        Two more between them must be where the others say, or the step is too long to see what its guards do: it is
        halved.
        """
        code = frame.code
        frame["planned"] = frame["h"]
        again = code.variable(integer(code, 1))
        with code.repeat_while(lambda: code.load(again, INTEGER) > 0):
            h = frame["h"]

            def keep(k, place, h=h):
                frame.call(self.guard, order, code.lanes_of(place / INTERVALS) * h)
                for i in range(len(self.directions)):
                    frame["samples", i, k] = frame["guard", i]

            with code.loop(INTERVALS + 3) as k:
                keep(k, code.as_double(k) - 1.0)
            for k, place in enumerate(BETWEEN):
                keep(integer(code, INTERVALS + 3 + k), double(code, place))
            unseen = (code.intrinsic("fabs", h) > JUMP * frame["smallest"]) & self._unseen(frame)
            code.store(integer(code, 0), again)
            with code.only_if(code.any_lane(unseen)):
                code.store(integer(code, 1), again)
                frame["h"] = code.select(unseen, 0.5 * h, h)
                note_halved(frame, unseen)

    def _unseen(self, frame: Frame) -> Value:
        """Where a guard is not what the cubic through four samples says, by more than a part of what it varies."""
        code = frame.code
        unseen = frame.constant(0.0) > 1.0
        for i in range(len(self.directions)):
            for k, place in enumerate(BETWEEN):
                first, x = int(place), place - int(place)
                four = [frame["samples", i, first + j] for j in range(4)]
                weights = (
                    -x * (x - 1) * (x - 2) / 6, (x + 1) * (x - 1) * (x - 2) / 2, -x * (x + 1) * (x - 2) / 2,
                    x * (x + 1) * (x - 1) / 6,
                )  # fmt: skip
                between = frame["samples", i, INTERVALS + 3 + k]
                cubic = functools.reduce(Value.__add__, (w * y for w, y in zip(weights, four, strict=True)))
                highest, lowest = four[0], four[0]
                for y in four[1:]:
                    highest, lowest = code.select(highest > y, highest, y), code.select(lowest < y, lowest, y)
                far = code.intrinsic("fabs", between - cubic)
                matters = (far > NOTICEABLE * code.intrinsic("fabs", between)) & (far > frame["noise", i])
                unseen = unseen | (matters & (far > SMOOTH * (highest - lowest)))
        return unseen

    # ---- the first change of one guard ----

    def _first_change(self, frame: Frame, order: Value, i: int, direction: int) -> None:
        """The first allowed change of sign of guard i: its time into `root`, and 1 (falls) or 2 (rises) into `change`.

        `change` is 0 where there is none. Signs of neighbouring samples differ where it crosses once; between samples
        of one sign it can still cross twice, about the least of them.
        """
        code, h = frame.code, frame["h"]
        moving, spacing = code.compare("!=", h, 0.0), h * (1.0 / INTERVALS)
        begin, zero = frame["side", i], frame.constant(0.0)
        first = _Change(*(code.variable(x) for x in (begin, zero, zero, zero)))
        note = self._noter(frame, first, moving, direction)
        with code.loop(INTERVALS + 1) as k:
            place = code.lanes_of(code.as_double(k))
            before, here, after = (frame["samples", i, k + j] for j in range(3))
            sign = code.load(first.side, frame.vector)
            above = sign > 0.0
            sizes = [code.select(above, x, 0.0 - x) for x in (before, here, after)]
            sided = above | (sign < 0.0)
            least = sided & self._dips(frame, i, sizes) & moving & (code.load(first.kind, frame.vector) <= 0.0)
            self._look_into_dip(frame, order, i, note, place, spacing, above, least, sizes)
            inside = place < float(INTERVALS)
            crosses = inside & ((above & (after < 0.0)) | (sided & ~above & (after > 0.0)))
            note(crosses, above, place * spacing, (place + 1.0) * spacing)
            passed = inside & (code.intrinsic("fabs", after) > 0.0)  # a zero, or a NaN, is on no side
            code.store(code.select(passed, after, sign), first.side)
        frame["side", i] = code.load(first.side, frame.vector)
        kind = code.load(first.kind, frame.vector)
        frame["change", i] = kind
        with code.only_if(code.any_lane(kind > 0.0)):
            low, high = code.load(first.low, frame.vector), code.load(first.high, frame.vector)
            frame["root", i] = self._root(frame, order, i, low, high, kind)

    def _noter(self, frame: Frame, first: _Change, moving: Value, direction: int) -> Callable:
        """`(where, falls, start, end)`: note a change between two times, if it is the first and of that direction.

        `falls` where the sign before is positive.
        """
        code = frame.code

        def note(where: Value, falls: Value, start: Value, end: Value) -> None:
            allowed = falls if direction < 0 else ~falls if direction > 0 else frame.constant(0.0) <= 0.0
            new = where & allowed & (code.load(first.kind, frame.vector) <= 0.0) & moving
            kind = code.select(falls, frame.constant(1), 2.0)
            for variable, value in ((first.low, start), (first.high, end), (first.kind, kind)):
                code.store(code.select(new, value, code.load(variable, frame.vector)), variable)

        return note

    def _dips(self, frame: Frame, i: int, sizes: list[Value]) -> Value:
        """Where the middle one of three neighbouring samples is least, and the guard may cross zero twice about it."""
        before, here, after = sizes
        bend, tilt = before - 2.0 * here + after, after - before
        # The parabola through them comes down to half of the least, or so near that its error matters.
        deep = (4.0 * bend * here < tilt * tilt) | (here < NEAR_LEAST * bend)
        return deep & (here > frame["noise", i]) & (here < before) & (here <= after)

    def _look_into_dip(self, frame: Frame, order, i: int, note, place, spacing, above, least, sizes) -> None:
        """Find the least of guard i about a sample; if that is beyond the surface, note a change on either side."""
        code = frame.code
        with code.only_if(code.any_lane(least)):
            start = code.select(place > 0.0, place - 1.0, 0.0) * spacing
            end = code.select(place < float(INTERVALS), place + 1.0, float(INTERVALS)) * spacing
            bottom = self._bottom(frame, order, i, above, start, end)
            depth = self._at(frame, order, i, bottom)
            depth = code.select(above, 0.0 - depth, depth)
            through = least & (depth > TOUCHING * (sizes[0] + sizes[2])) & (depth > frame["noise", i])
            note(through, above, start, bottom)
            note(through, ~above, bottom, end)

    def _bottom(self, frame: Frame, order: Value, i: int, above: Value, start: Value, end: Value) -> Value:
        """Where the size of guard i is least between two times, by golden sections."""
        code = frame.code
        low, high = code.variable(start), code.variable(end)
        with code.loop(SECTIONS):
            a, b = code.load(low, frame.vector), code.load(high, frame.vector)
            sizes, places = [], [b - (b - a) * GOLDEN, a + (b - a) * GOLDEN]
            for place in places:
                value = self._at(frame, order, i, place)
                sizes.append(code.select(above, value, 0.0 - value))
            left = sizes[0] < sizes[1]
            code.store(code.select(left, a, places[0]), low)
            code.store(code.select(left, places[1], b), high)
        return 0.5 * (code.load(low, frame.vector) + code.load(high, frame.vector))

    def _root(self, frame: Frame, order: Value, i: int, start: Value, end: Value, kind: Value) -> Value:
        """Where guard i changes sign, by bisection: the end of the bracket, where it has changed."""
        code = frame.code
        low, high, falls = code.variable(start), code.variable(end), kind < 1.5
        with code.loop(BISECTIONS):
            a, b = code.load(low, frame.vector), code.load(high, frame.vector)
            middle = 0.5 * (a + b)
            value = self._at(frame, order, i, middle)
            same = code.select(falls, value, 0.0 - value) > 0.0
            code.store(code.select(same, middle, a), low)
            code.store(code.select(same, b, middle), high)
        return code.load(high, frame.vector)
