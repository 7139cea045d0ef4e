"""Events: the sign changes of guards along a step, by their own Taylor series.

    begin_sides   the side of every surface on which a motion starts
    look          for every guard the roots of its polynomial in order (`_roots`), each refined to the last digit of the
                  guard itself; those in its direction end the motion, or are recorded while the motion continues

A guard also changes its sign where it jumps, at a border of its own: that is found at the start of the next step. A
step ends where the series of a guard is not accurate beyond. Where a guard has no series, like the square root of zero,
the step is short, and the guard is tested at its end.
"""

from enum import IntEnum

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Fields, Frame, Lane
from lagjax._native.code._ir import INTEGER, Code, Value, Variable
from lagjax._native.series._guards import Guards
from lagjax._native.series._taylor import TaylorSeries, double
from lagjax._native.steps._roots import Roots
from lagjax._native.steps._run_records import OutputWriter
from lagjax._native.steps._step import StepControl
from lagjax._native.steps._watch import END_OF_STEP, Columns, Contact, Watch, reaches_border
from lagjax._program import inputs_below


class SignChange(IntEnum):
    """The direction of a sign change of a guard: it falls or rises; 0 means none."""

    FALLS = 1
    RISES = 2


MEMORY = ("side", "contact", "noted")  # of each guard from step to step


class Events:
    """The kernel functions that find sign changes of guards, which are the last followed outputs."""

    def __init__(self, motion: TaylorSeries, step: StepControl, output: OutputWriter, roots: Roots, guards: Guards):
        self.motion, self.step, self.roots, self.guards = motion, step, roots, guards
        self.count = len(guards.directions)
        self.first = motion.series.followed - self.count
        program = motion.program
        outputs = program.line.outputs[len(program.line.outputs) - self.count :]
        first_piece = program.size - motion.pieces
        piecewise = [max(inputs_below(program.line, [i]), default=-1) >= first_piece for i in outputs]
        holds = [*guards.holds, *[False] * self.count]
        self.can_jump = any(piecewise)
        rows = list(zip(guards.directions, piecewise, holds, strict=False))
        self.table = Columns(motion.module, ("direction", "piecewise", "holds"), rows)
        self.guard = self._evaluate_guards()
        self.begin_sides = self._initial_sides()
        self.note = self._write_change(output) if guards.notes else None
        self.look = self._find_changes()

    @staticmethod
    def fields(guards: int) -> Fields:
        return {
            "guard": guards,  # its value
            "measured": (guards, 5),  # where a motion begins, the outputs of the program of `Guards`
            "zero": guards,  # the value that counts as zero
            "side": guards,  # its sign where the step begins
            "contact": guards,  # a `Contact` there
            "noted": guards,  # how often it has been noted before
            **{f"{name}_end": guards for name in MEMORY},  # these three where the step ends
            "met": guards,  # the `SignChange` at the start; 0 without any
            "root_at": guards,  # how far from the beginning of the step it changes
            "change": guards,  # the `SignChange` there; where the step ends there, 0 of those that come later
            **END_OF_STEP,
        }

    def begin(self, frame: Frame, lane: Lane) -> None:
        with frame.code.loop(self.count) as g:
            for name in ("noted", "contact", "met", "zero"):
                lane[name, g] = 0.0

    # ---- the guards ----

    def _evaluate_guards(self) -> Code:
        """Emit `(order, s)`: store the guards, at the time s after the current one in each lane, in `guard`."""
        frame = self.motion.function("guard", INTEGER, self.motion.vector)
        order, s = frame.arguments
        moved = self.motion.move_state(frame, self.motion.increments(frame, order, s)[0])
        guards = self.motion.evaluate(frame, self.guards.values.line, moved, s)
        for i in range(self.count):
            frame["guard", i] = guards[i] - frame["zero", i]
        return frame.finish()

    def _guard_value(self, watch: Watch, order: Value, s: Value) -> Value:
        watch.frame.call(self.guard, order, s)
        return watch.recall("guard")

    def _initial_sides(self) -> Code:
        """Emit `(order)`: for lanes at the start of a run, the side of each surface they are on, into `side`.

        A guard that is zero to rounding takes its previous side: the remembered one, at least as large as the rounding
        of the guard before it came near zero, or else the one from which it can change in the direction of the guard.
        If the motion leaves that side, in the direction of the guard, that is a change at the start, noted in `met`. If
        the previous side is unknown, use the side that the motion moves to: the sign of the first derivative that
        exceeds rounding. Starts have the rounding of the numbers that were given.

        A motion with a memory may begin beyond the surface, opposite to its previous side. If it moves on, that is a
        change at the start as well; if the remembered side is infinite, it is one wherever the motion moves.
        """
        frame = self.motion.function("begin_sides", INTEGER)
        code, (order,), count = frame.code, frame.arguments, self.count
        fresh = code.compare("==", frame["steps"], 0.0)
        with code.loop(count) as g:
            frame["met", g] = 0.0
        with code.only_if(code.any_lane(fresh)):
            frame.call(self.guard, order, limits.LITTLE * frame["h"])
            out = self.motion.evaluate_now(frame, self.guards.program.line)
            for k in range(len(self.guards.program.line.outputs) // count):
                for i in self.motion.form.each(code, count):
                    frame["measured", i, k] = out[i + k * count]
            for watch in self.table.each(frame):
                self._initial_side(watch, order, fresh)
        return frame.finish()

    def _initial_side(self, watch: Watch, order: Value, fresh: Value) -> None:
        """Set, for lanes at their start (`fresh`), the side of a guard, whether it changes there, and its contact."""
        frame, code, g = watch.frame, watch.code, watch.g
        direction, is_rounded = watch.number("direction"), self.guards.is_rounded
        value, rate, size, rate_size = (frame["measured", g, k] for k in range(4))
        later, noise, rate_noise = watch.recall("guard"), limits.GUARD_NOISE * size, limits.GUARD_NOISE * rate_size
        before = (
            frame.constant(0.0) if self.guards.notes else 0.0 - direction
        )  # from where it can change in its direction
        if self.guards.remembers:
            before, rate_noise = self._recorded_numbers(watch)
        of_rate = abs(frame["h"]) * rate_noise
        lead, order_of_zero = self._leading_term(watch, order, limits.GUARD_NOISE * size + of_rate)
        away, from_there, moved = (abs(x) for x in (value, before, rate))
        on_it = away <= noise + moved * (limits.INSTANT * frame["smallest"])
        if self.guards.remembers:
            on_it = on_it | (away <= from_there)
        elif is_rounded:
            on_it = on_it | (away <= frame["measured", g, 4])
        leaves, sound = moved > rate_noise, order_of_zero > 0.0
        turn = code.select(sound, lead, later - value)
        bends = abs(turn) > code.select(sound, 0.0, noise)
        before = self._sign_of(frame, before)
        unclear = code.select(code.compare("!=", before, 0.0), 0.0, turn if is_rounded else later)
        going = code.select(leaves, rate * frame["forward"], code.select(bends, turn, unclear))
        there = on_it | (value * before < 0.0) if self.guards.remembers else on_it
        goes_on = (going * before < 0.0) | ~(from_there < float("inf"))
        met = fresh & there & goes_on & (before * direction <= 0.0)
        if any(self.guards.holds):
            met = met | (fresh & ~on_it & (value * direction * watch.number("holds") > 0.0))
        frame["met", g] = code.select(met, code.select(before > 0.0, SignChange.FALLS, SignChange.RISES), 0.0)
        side = code.select(on_it, code.select(met | code.compare("==", going, 0.0), before, going), value)
        zeros = code.select(leaves, Contact.VALUE, code.select(sound, order_of_zero, Contact.RATE))
        watch.remember(fresh, side=self._sign_of(frame, side), contact=code.select(on_it, zeros, Contact.NONE))
        if is_rounded:
            watch.remember(fresh, zero=code.select(on_it, value, 0.0))

    def _recorded_numbers(self, watch: Watch) -> tuple[Value, Value]:
        """The two parameters of a guard that a motion `remembers` (see `Guards`)."""
        first = self.motion.parameters + watch.g - 2 * self.count
        return watch.frame["params", first], watch.frame["params", first + self.count]

    def _guard_noise(self, watch: Watch) -> Value:
        """The rounding error of a guard: the current one or, with `remembers`, the largest one so far."""
        noise = limits.GUARD_NOISE * watch.recall("kept")
        if not self.guards.remembers:
            return noise
        noted = abs(self._recorded_numbers(watch)[0])
        return watch.code.select((noted > noise) & (noted < float("inf")), noted, noise)

    def _leading_term(self, watch: Watch, order: Value, noise: Value) -> tuple[Value, Value]:
        """The first Taylor term of a guard after its rate that exceeds `noise` over the step, and the order of it.

        The order is one more than the last one if all terms are noise, and 0 if there is no series.
        """
        frame, code, degree = watch.frame, watch.code, self.motion.followed_degree(watch.code, order)
        self.roots.polynomial(frame, watch.g + self.first, degree, frame["h"], frame.constant(1.0), 0.0)
        size, lead = (code.variable(frame.constant(0.0)) for _ in range(2))
        with code.loop(degree + 1, start=1) as k:
            size.value += abs(frame["poly", k])
        noise = noise + limits.GUARD_NOISE * size.value
        at = code.variable(code.select(noise < float("inf"), code.lanes_of(code.as_number(degree + 1)), 0.0))
        with code.loop(degree + 1, start=2) as k:
            term = frame["poly", k]
            is_first = code.compare("==", lead.value, 0.0) & (abs(term) > noise)
            lead.value = code.select(is_first, term, lead.value)
            at.value = code.select(is_first, code.lanes_of(code.as_number(k)), at.value)
        return lead.value, at.value

    def _sign_of(self, frame: Frame, x: Value) -> Value:
        code = frame.code
        return code.select(x > 0.0, 1, code.select(x < 0.0, -1, 0.0))

    # ---- a step ----

    def end_step_at_event(self, frame: Frame, order: Value) -> None:
        """Search the step for changes of all guards; it ends at the earliest, or where a series is not accurate."""
        code, planned = frame.code, frame["h"]
        frame.call(self.begin_sides, order)
        frame.call(self.look, order)
        size = abs(frame["h"])  # 0 where a guard has no value
        cut = (frame["seen"] < 1.0) & (frame["seen"] * size < frame["first_at"])
        with code.only_if(code.any_lane(cut)):
            least = limits.INSTANT * frame["smallest"]
            after = code.maximum(frame["seen"] * size, code.select(least < size, least, size))
            frame.assign(cut, h=after * frame["forward"], last=0.0)
            frame.call(self.look, order)
        if not self.guards.notes:
            self._end_at_first(frame)
        with code.loop(self.count) as g:
            for name in MEMORY:
                frame[name, g] = frame[f"{name}_end", g]
        with code.only_if(code.any_lane(code.compare("!=", frame["h"], planned))):
            frame.call(self.step.defect, order, double(code, 1.0))  # leaves the increment of the new step
            if self.step.projector is not None:
                frame.call(self.step.projector.project)

    def _end_at_first(self, frame: Frame) -> None:
        """End the step and the motion at the earliest change; `change` keeps all changes at that instant."""
        happens = frame["first_at"] < float("inf")
        for watch in self.table.each(frame):
            later = watch.recall("root_at") > frame["first_at"] + frame["smallest"]
            watch.remember(later | ~happens, change=0.0)
        frame["event"] = frame.code.select(happens, frame.constant(0.0), -1.0)
        frame.assign(happens, last=0.0, h=frame["first_at"] * frame["forward"])

    def _find_changes(self) -> Code:
        """Emit `(order)`: search the step for the changes of all guards."""
        frame = self.motion.function("look_at_guards", INTEGER)
        frame["seen"], frame["first_at"] = 1.0, float("inf")
        for watch in self.table.each(frame):
            self._find_guard_change(watch, *frame.arguments)
        return frame.finish()

    def _find_guard_change(self, watch: Watch, order: Value) -> None:
        frame, code, g, h = watch.frame, watch.code, watch.g, watch.frame["h"]
        met, side = watch.recall("met"), watch.recall("side")
        moving, happened = code.compare("!=", h, 0.0), met > 0.0
        frame["change", g], frame["root_at", g] = met, code.select(happened, 0.0, float("inf"))
        frame.assign(happened, first_at=0.0)
        frame["side_end", g], frame["noted_end", g] = side, frame["noted", g]
        frame["contact_end", g] = code.select(moving, Contact.NONE, frame["contact", g])
        degree, j, zero = self.motion.followed_degree(code, order), g + self.first, frame["zero", g]
        here = self._sign_of(frame, self.motion.followed_value(frame, j) - zero)
        side = code.select(code.compare("==", side, 0.0), here, side)
        self.roots.polynomial(frame, j, degree, h, side, zero)
        moving = moving & ~happened
        with code.only_if(code.any_lane(moving & ~self._has_no_root(watch, degree))):
            self._search_roots(watch, order, degree, side, moving)

    def _has_no_root(self, watch: Watch, degree: Value) -> Value:
        """The lanes whose polynomial has no root by a bound on its coefficients; this settles most cases."""
        frame, code, zero = watch.frame, watch.code, watch.frame.constant(0.0)
        falls, rises = code.variable(zero), code.variable(zero)
        with code.loop(degree + 1, start=1) as k:
            c = frame["poly", k]
            negative = code.select(c < 0.0, c, zero)
            falls.value -= negative
            rises.value = rises.value + (c - negative)
        start, falls, rises = frame["poly", 0], falls.value, rises.value
        last, before = (self.roots.last_terms(frame, degree, first) for first in (0, 3))
        size = start + falls + rises
        return (start > falls + last) & ~self._is_truncated(watch, last, before, size)

    def _search_roots(self, watch: Watch, order: Value, degree: Value, side: Value, moving: Value) -> None:
        frame, code, roots, h = watch.frame, watch.code, self.roots, watch.frame["h"]
        size, contact, start = roots.coefficient_sum(frame, degree), watch.recall("contact"), frame["poly", 0]
        unknown = moving & ~(abs(start) < float("inf"))
        frame.assign(unknown, code=float(limits.NOT_FINITE), last=0.0, h=0.0)
        sound, moving = size < float("inf"), moving & ~unknown
        if self.guards.remembers:  # what stays zero to rounding, as between bodies at rest, does not fall
            moving = moving & ~(size <= self._guard_noise(watch))

        def is_long():
            last, before = (roots.last_terms(frame, degree, first) for first in (0, 3))
            return self._is_truncated(watch, last, before, roots.coefficient_sum(frame, degree))

        roots.shorten(frame, degree, is_long)
        frame["doubt"], frame["begin"], frame["closer"] = roots.last_terms(frame, degree), 0.0, 1.0
        # A motion that begins on the surface, or has just gone through it, is not to do so by rounding.
        continues = (contact < Contact.NONE) & (abs(start) <= limits.CONTINUOUS * size)
        powers = code.select(continues, float(Contact.VALUE), contact)
        roots.divide(frame, degree, powers)
        roots.store_bounds(frame, degree)
        frame["instant"] = 0.25 * frame["smallest"] / (abs(h) * frame["part"])  # no time is known better than this
        rounding = (limits.ROOT_NOISE * limits.EPS) * watch.recall("kept")
        matters = (rounding < float("inf")) & ~(powers > Contact.NONE)
        frame["unsure"] = abs(frame["poly", 1]) * frame["instant"] + code.select(matters, rounding, 0.0)
        ahead = code.variable(side)
        self._follow_roots(watch, order, degree, ahead, moving & sound)
        self._bisect_change(watch, order, ahead, moving & ~sound)
        watch.remember(moving, side_end=ahead.value)

    def _is_truncated(self, watch: Watch, last: Value, before: Value, size: Value) -> Value:
        """The lanes where the last terms are large, or do not fall, so that the truncation error may be as large.

        Terms below the rounding error of the guard are accepted, as of a guard that leaves zero with a high power.
        """
        is_long = (last > limits.GUARD_TERMS * size) | ((last > limits.FALL * before) & (last > limits.SEEN * size))
        return is_long & ~(last <= self._guard_noise(watch))

    def _follow_roots(self, watch: Watch, order: Value, degree: Value, ahead: Variable, where: Value) -> None:
        """Process the roots of the polynomial in order, until one ends the motion."""
        frame, code = watch.frame, watch.code
        looking = code.variable(code.flag(where))

        def searching():
            return looking.value > 0.0

        with code.repeat_while(lambda: code.any_lane(searching()), at_most=limits.MOST_CHANGES):
            frame.call(self.roots.next_root, degree)
            root = frame["root"]
            is_root = searching() & self.roots.is_found(frame)
            self._limit_accurate_part(frame, searching() & ~is_root, self.roots.step_fraction(frame, 1.0))
            waits = is_root & self._ends_at_border(watch)
            watch.remember(waits, contact_end=Contact.CONTINUES)
            changes = is_root & ~waits
            with code.only_if(code.any_lane(changes)):
                s = self._refine_root(watch, order, changes, ahead.value)
                inside = abs(s) <= abs(frame["h"])  # else of the next step
                goes_on = self._take_changes(watch, order, changes & inside, s, ahead)
                self.roots.negate(frame, degree, goes_on)
                frame.assign(goes_on, begin=root)
                looking.value = code.flag(goes_on)
            looking.value = code.select(changes, looking.value, 0.0)
        self._limit_accurate_part(frame, searching(), frame["begin"] * frame["part"])

    def _limit_accurate_part(self, frame: Frame, where: Value, seen: Value) -> None:
        """Lower, in some lanes, the fraction `seen` of the step up to which guards' polynomials are accurate."""
        frame.assign(where & (seen < frame["seen"]), seen=seen)

    def _ends_at_border(self, watch: Watch) -> Value:
        """The lanes whose step ends at a border of the guard itself, so that the next step finds the change."""
        frame = watch.frame
        if not self.can_jump:
            return frame.constant(0.0) > 1.0
        at_border = (frame["crossed"] > 0.0) & reaches_border(frame)
        left = (1.0 - frame["root"] * frame["part"]) * abs(frame["slope"])
        at_border = at_border & (frame["root"] > 0.0)  # else it has jumped already
        return (left <= 8.0 * frame["error"]) & at_border & (watch.number("piecewise") > 0.0)

    def _refine_root(self, watch: Watch, order: Value, where: Value, side: Value) -> Value:
        """The time of a root, by Newton steps on the guard itself; 0 for a jump of the guard."""
        frame, code, root = watch.frame, watch.code, watch.frame["root"]
        scale = frame["part"] * frame["h"]
        start, rate = root * scale, self.roots.undivided_slope(frame) / scale
        moving = code.flag(where & (root > 0.0))
        # Behind a zero the series knows a root that is near, which the value loses in its rounding.
        most, share = 0.1 * abs(scale), 0.5 * abs(start)
        most = code.select((watch.recall("contact") > 0.0) & (share < most), share, most)
        at, going = code.variable(start), code.variable(moving)

        def moves():  # each lane as long as it needs, so that its neighbours do not change its last digit
            return going.value > 0.0

        with code.repeat_while(lambda: code.any_lane(moves()), at_most=limits.MOST_CORRECTIONS):
            here = at.value
            after = here - side * self._guard_value(watch, order, here) / rate
            near = abs(after - start) <= most
            after = code.select(moves() & near, after, here)
            after = code.select(after * frame["forward"] > 0.0, after, 0.0)
            at.value = after
            far = abs(after - here) > limits.INSTANT * frame["smallest"]
            going.value = code.flag(far & moves())
        at = at.value
        lost = (watch.recall("contact") > 0.0) & (abs(at) <= 0.25 * limits.INSTANT * frame["smallest"])
        return code.select(lost, 0.0, at)  # time does not move

    def _take_changes(self, watch: Watch, order: Value, changes: Value, s: Value, ahead: Variable) -> Value:
        """Handle changes at times s: end the motion or record them if the direction counts. The lanes that continue."""
        frame, code, side, size = watch.frame, watch.code, ahead.value, abs(s)
        counts = changes & ~(side * watch.number("direction") > 0.0)
        if self.guards.notes:
            assert self.note is not None
            frame["is_due"] = counts
            with code.only_if(code.any_lane(counts)):
                frame.call(self.note, order, watch.g, s)
            goes_on = changes
        else:
            watch.remember(counts, root_at=size, change=code.select(side > 0.0, SignChange.FALLS, SignChange.RISES))
            frame.assign(counts & (size < frame["first_at"]), first_at=size)
            goes_on = changes & ~counts
        ahead.value = code.select(goes_on, 0.0 - side, side)
        left = abs(frame["h"]) - size
        watch.remember(goes_on & (left <= limits.INSTANT * frame["smallest"]), contact_end=Contact.CONTINUES)
        return goes_on

    def _bisect_change(self, watch: Watch, order: Value, ahead: Variable, where: Value) -> None:
        """Test a guard without series at the end of a part of the step; find a change before it by bisection."""
        frame, code, side, h = watch.frame, watch.code, ahead.value, watch.frame["h"]
        with code.only_if(code.any_lane(where)):
            self._limit_accurate_part(frame, where, frame.constant(limits.WITHOUT_SERIES))
            changes = where & (side * self._guard_value(watch, order, h) < 0.0)
            low, high = code.variable(frame.constant(0.0)), code.variable(h)
            with code.loop(limits.BISECTIONS):
                middle = 0.5 * (low.value + high.value)
                same = side * self._guard_value(watch, order, middle) > 0.0
                for end, here in ((low, same), (high, ~same)):
                    end.value = code.select(here, middle, end.value)
            self._take_changes(watch, order, changes, high.value, ahead)

    # ---- what is noted ----

    def _write_change(self, output: OutputWriter) -> Code:
        """Emit `(order, g, s)`: record a change of guard g and the state there, in the lanes that are due."""
        frame = self.motion.function("note_change", INTEGER, INTEGER, self.motion.vector)
        code, (order, g, s) = frame.code, frame.arguments
        output.interpolate(frame, order, s)
        frame["reached"] = frame["t"] + (frame["t_low"] + s)
        with code.loop(self.motion.width) as k:
            lane = frame.lane(k)
            with code.only_if(lane["is_due"] > 0.0):
                number = lane["noted_end", g]
                lane["noted_end", g] = number + 1.0
                with code.only_if(number < code.as_double(frame.job("room_of_notes"))):
                    row = self._record_row(frame, lane["member"], g, code.as_integer(number))
                    frame.write("path", row, lane["reached"])
                    for i in self.motion.form.each(code, self.motion.states):
                        frame.write("path", row + 1 + i, lane["between", i])
        return frame.finish()

    def write_end(self, frame: Frame, lane: Lane) -> None:
        """Write the change of each guard at the end of a member or, with `notes`, the number of its records."""
        with frame.code.loop(self.count) as g:
            if self.guards.notes:
                row = self._record_row(frame, lane["member"], g, frame.job("room_of_notes"))
                frame.write("path", row, lane["noted", g])
            else:
                frame.write("changes", lane["member"] * self.count + g, lane["change", g])

    def _record_row(self, frame: Frame, member: Value, g: Value, number: Value) -> Value:
        rows = frame.job("room_of_notes") + 1
        return ((member * self.count + g) * rows + number) * (self.motion.states + 1)
