"""Borders in a kernel: a step ends at the first border, and the next one begins on the piece beyond.

    decide    the pieces of a member at its start, and of one that has crossed a border on which others depend
    stop      the first root of all guards along the step, by their series, is its end, unless the next of the `_knots`
              or the approach to one of the `_narrow_features` is sooner
    settle    a border counts only if the step was not shortened further
    cross     the piece beyond (`_border_crossing`), on whose border the motion is; the slope of its guard decides
              whether it stays; where L jumps, the velocities behind the border (`_border_kicks`)

Pieces and guards are defined in `_program._borders`. A crossing is remembered (`_watch`), so that rounding does not
decide on which side the next step begins.
"""

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Fields, Frame, Lane
from lagjax._native.code._ir import INTEGER, Code, Value
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._native.steps._border_crossing import BorderCrossing
from lagjax._native.steps._border_kicks import Kicks
from lagjax._native.steps._knots import Knots
from lagjax._native.steps._narrow_features import NarrowFeatures
from lagjax._native.steps._roots import Roots
from lagjax._native.steps._saltation import Saltation
from lagjax._native.steps._step import absolute_tolerance
from lagjax._native.steps._watch import (
    Border,
    Contact,
    GuardTable,
    StepEnd,
    joint_groups,
    reaches_border,
    step_to_border,
)
from lagjax._program import CONE, TABLE, Borders, Jump, Nesting, gradient

NOWHERE = 1e300  # a level that no switching number reaches
_AT_ONCE = 16.0  # roundings of the time by which two instants may differ that are one


class BorderControl:
    """The kernel functions for the borders of a motion, whose pieces are its last parameters.

    If the motion `returns` to long steps (`_rank_drops`), it does not return across a border. With tangents (`nesting`)
    a `jump` changes them.
    """

    def __init__(self, motion: TaylorSeries, borders: Borders, nesting: Nesting, returns: bool, jump: Jump | None):
        self.motion, self.borders, self.roots = motion, borders, Roots(motion)
        self.forgotten = {"h_before": 0.0} if returns else {}
        self.narrow = NarrowFeatures(motion, self.roots, borders.features)
        if not self.pieces:
            self.stop = self._end_step_at_border()
            return
        self.table = GuardTable(motion, borders)
        self.knots = Knots(motion, borders, self.table)
        self.crossing = BorderCrossing(motion, borders, self.knots, nesting, jump, self.forgotten)
        self.kicks = self.crossing.kicks
        self.stop, self.graze = self._end_step_at_border(), self._find_grazing(nesting.base)

    @property
    def pieces(self) -> int:
        return self.motion.pieces

    @staticmethod
    def fields(borders: Borders) -> Fields:
        guards, pieces = len(borders.guards), len(borders.decisions)
        fields: Fields = {
            "touch": guards,  # the `Contact` of a guard where the step begins
            "stays": pieces,  # 1 for a piece that is not decided anew
            "at_knots": 1,  # the number of steps that ended at entries of tables
            "beyond": 1,  # the piece beyond the guard that the step ends at
            "at_rest": 1,  # 1 if the motion would be at the guard in no time
            "undecided": 1,  # 1 in a lane whose pieces are to be decided
            "idle_crossings": 1,  # the number of borders since the last step that had a length
            "stepped": 1,  # 1 if the step has one
            "approach": 1,  # the step from which on others ended before a border without a series; 0 if that is over
            "next_approach": 1,  # the same behind this step
            "slides": 1,  # 1 if the motion slides along any border
            "stops": 1,  # 1 if the step ends at a border that it reaches with no speed, to rounding
            "level": guards if any(guard.of_table for guard in borders.guards) else 0,  # a level that changes
        }
        if groups := joint_groups(borders):
            fields |= {
                "joins": guards,  # where a guard is crossed, as a fraction of the step; then 1 if it is, at its end
                "taken": 1 + max(groups),  # 1 for a group of which a guard is crossed
                "more": 1,  # guards that are crossed in addition to the first one: each counts as a step, as elsewhere
            }
        if borders.kicking:
            fields |= Kicks.fields(pieces)
        return fields | Roots.fields(limits.MAX_ORDER + 2) | Saltation.fields(borders)

    def begin(self, frame: Frame, lane: Lane) -> None:
        lane["approach"] = 0.0
        if not self.pieces:
            return
        located = [self.borders.moving_table(j) for j in range(self.pieces)]
        for table in dict.fromkeys(filter(None, located)):  # of entries that do not increase nothing can be made
            first = frame.code.as_integer(lane["first_number"])
            with frame.code.only_if(~self.motion.look_up.increases(frame, table, first)):
                lane["y", 0] = float("nan")
        for name in ("crossed", "idle_crossings", "stepped", "at_knots", "is_hit", "grazes"):
            lane[name] = 0.0
        lane["undecided"] = 1.0
        with frame.code.loop(len(self.borders.guards)) as g:
            lane["touch", g] = Contact.NONE
        with frame.code.loop(self.pieces) as j:
            lane["stays", j], lane["params", j + self.motion.parameters] = 0.0, 0.0

    def _end_step_at_border(self) -> Code:
        """Emit `(order)`: shorten the step so that it ends at the first border."""
        frame = self.motion.function("stop_at_border", INTEGER)
        code, (order,), h = frame.code, frame.arguments, frame["h"]
        degree = self.motion.followed_degree(code, order)
        frame["planned"], frame["nearest"] = h, 1.0
        frame["crossed"], frame["crossed_number"], frame["beyond"] = StepEnd.NOTHING, 0.0, 0.0
        if self.pieces:
            self.knots.end_step_at_knot(frame, h)
            self._record_levels(frame)
            if self.slides:
                frame["slides"] = 0.0
                for border in self.table.each(frame):
                    frame.assign(border.touch >= Contact.SLIDING, slides=1)
            for border in self.table.each(frame):
                self._record_crossing(frame, border, degree, h)
            if self.table.groups:
                self._join_crossings(frame, h)
        self.narrow.end_step_at_feature(frame, degree, h)
        cut = frame["nearest"] < 1.0
        if self.pieces and self.kicks is not None:
            self.kicks.kick_at_end(frame, self.roots, degree, h)
            cut = cut | self.table.kicks(frame)
        frame["h"] = step_to_border(frame)
        frame.assign(cut, last=0.0, **self.forgotten)
        return frame.finish()

    def _record_crossing(self, frame: Frame, border: Border, degree: Value, h: Value) -> None:
        """Record where a guard is crossed, if that is sooner than the crossing recorded before."""
        code, piece = frame.code, border.piece
        side, level, beyond = border.rule("side")(piece), border.level(piece), border.rule("beyond")(piece)
        is_share, undecided = border.has("on"), code.compare("==", side, 0.0)
        # Nothing is looked for along the border that the motion slides on, or in the share of one that does not.
        idle = (border.touch >= Contact.SLIDING) | (undecided & is_share)
        if self.table.groups:
            frame["joins", border.g] = 2.0
        with code.only_if(code.any_lane(~idle)):
            self.roots.polynomial(frame, border["piece"], degree, h, code.select(undecided, 1.0, side), level)
            at_limit = (abs(frame["poly", 0]) <= limits.JUMP_NOISE) & (frame["steps"] > 0.0)
            if self.borders.releases:
                self._limit_growth(frame, border, level)
            comes = ~undecided & (~is_share | at_limit) & (border.touch <= Contact.NONE)
            leads = self.roots.leading_sign(frame, degree)
            self.roots.divide(frame, degree, border.touch)
            idle = idle | (self._is_rounding(frame, border, degree) & ~undecided)
            tolerances = limits.SWITCH_TOLERANCES * frame.job("rtol"), absolute_tolerance(frame)
            self.roots.shorten_to(frame, degree, *tolerances, limits.RESOLVED)
            frame.call(self.roots.first_root, degree)
            self._refine_early_root(frame, degree)
            self._record_first_root(frame, border, h, (undecided, beyond, leads), comes, idle)

    def _limit_growth(self, frame: Frame, border: Border, level: Value) -> None:
        """End the step where a cone's vector, of length `poly`, has grown by a fraction of its length.

        Tangents across the vector change at a rate that is unbounded at rest and falls as the length grows.
        """
        length, rate = frame["poly", 0] + level, frame["poly", 1]
        part = limits.GROWTH_OF_LENGTH * length / rate
        sooner = border.is_cone & ~border.has("on") & (rate > 0.0) & (length > level) & (part < frame["nearest"])
        frame.assign(sooner, nearest=part, crossed=StepEnd.NOTHING)

    def _is_rounding(self, frame: Frame, border: Border, degree: Value) -> Value:
        """True if a guard, with polynomial `poly`, leaves a border that the motion touches by rounding alone.

        Less than a fraction of atol does not count. Several active borders can be left and reached alternately because
        of rounding. Each repetition therefore raises the threshold.
        """
        code = frame.code
        turns = 1.0 + code.maximum(frame["idle_crossings"] - float(len(self.borders.guards)), frame.constant(0.0))
        turns = code.select(turns < limits.MOST_TURNS, turns, limits.MOST_TURNS)
        patience = (turns * turns) * (turns * turns) * turns
        atol = code.lanes_of(absolute_tolerance(frame))
        nothing = self.roots.coefficient_sum(frame, degree) <= limits.NEGLIGIBLE * atol * patience
        touches = border.touch > Contact.NONE
        if self.slides:  # along u = 0 another border of |u| is there by rounding
            touches = touches | (frame["slides"] > 0.0)
        first = [abs(frame["poly", k]) for k in range(3)]  # the last ones may have become zero
        return (nothing & touches) | (first[0] + first[1] + first[2] < limits.TINY)

    def _record_first_root(
        self, frame: Frame, border: Border, h: Value, piece: tuple, comes: Value, idle: Value
    ) -> None:
        """Record the root of a guard if it is the first one, with the piece `beyond`, perhaps `undecided`.

        If `comes` holds, a border reached together with another one gets a step of its own, since each shifts tangents.
        """
        code, (undecided, beyond, leads) = frame.code, piece
        # At rest but for what it gains in so little time: u̇ is of the size of ü t.
        gain = 4.0 * (abs(frame["poly", 2]) * frame["root"])
        at_rest = (border.touch > Contact.NONE) | (abs(frame["poly", 1]) <= gain)
        # A number that is zero leaves zero as its first coefficient says, or stays.
        leaves = undecided & code.compare("!=", leads, 0.0)
        root = code.select(undecided, code.select(leaves, 0.0, 2.0), self.roots.step_fraction(frame, 2.0))
        instant = limits.NO_TIME * frame["smallest"] / abs(h)
        root = code.select(comes & (root < instant) & (instant < 1.0), instant, root)
        is_root = leaves | (~undecided & self.roots.is_found(frame))
        # Of two at one instant that of the piece on which the other one depends, which comes first, is crossed.
        apart = code.select(frame["crossed"] > 0.0, 1.0 - limits.AT_ONCE, 1.0) if self.borders.nested else 1.0
        sooner = (root < frame["nearest"] * apart) & code.compare("!=", h, 0.0) & ~idle
        if self.table.groups:
            frame.assign(is_root & ~undecided & ~idle, border.g, joins=root)
        crossed = code.select(is_root, StepEnd.GUARD, StepEnd.NOTHING)
        frame.assign(sooner, nearest=root, at_rest=at_rest, crossed=crossed, crossed_number=code.as_double(border.g))
        frame.assign(sooner, beyond=code.select(undecided, leads, beyond))

    def _join_crossings(self, frame: Frame, h: Value) -> None:
        """In each group, cross the first border that is reached at the same instant as the first border of all.

        With derivatives a border gets a step of its own, which shifts tangents, and may have length zero.
        """
        code, groups = frame.code, self.table.groups
        assert groups is not None
        none, joins = code.compare("==", frame["nearest"], 0.0), frame.constant(0.0)
        may_join = (
            none if self.crossing.jump is not None else none | (code.lanes_of(code.as_double(frame.job("room"))) <= 0.0)
        )
        instant = _AT_ONCE * limits.EPS * (abs(frame["t"] / h) + 1.0)
        end = frame["nearest"] + code.select(none, 0.0, instant)
        with code.loop(1 + max(joint_groups(self.borders))) as k:
            frame["taken", k] = 0.0
        joins, frame["more"] = code.variable(joins), 0.0
        for border in self.table.each(frame):
            group = groups.read(code, border.g, "group")
            with code.only_if(group >= 0):
                is_first = may_join & self.table.crosses(frame, StepEnd.GUARD, border.g)
                frame.assign(is_first, group, taken=1)
                joins.value = code.select(is_first, 1.0, joins.value)
        for border in self.table.each(frame):
            group, at_once = groups.read(code, border.g, "group"), (joins.value > 0.0) & (border.recall("joins") <= end)
            frame["joins", border.g] = 0.0
            with code.only_if(group >= 0):
                at_once = at_once & (frame["taken", group] <= 0.0)
                frame.assign(at_once, group, taken=1)
                frame.assign(at_once, border.g, joins=1)
                frame["more"] = frame["more"] + code.flag(at_once)

    def _refine_early_root(self, frame: Frame, degree: Value) -> None:
        """Compute a root early in the step anew, on the part of the step before it, where the error is smaller."""
        code = frame.code

        def early():
            return (frame["is_root"] > 0.0) & (frame["poly", 0] > 0.0) & (frame["root"] < limits.EARLY)

        with code.repeat_while(lambda: code.any_lane(early()), at_most=limits.MOST_LOOKS):
            straight = 0.0 - 4.0 * frame["poly", 0] / frame["poly", 1]  # for a root that is zero to rounding
            reach = code.select(frame["root"] > 0.0, 2.0 * frame["root"], straight)
            self.roots.stretch(frame, degree, code.select(early() & (reach > 0.0) & (reach < 1.0), reach, 1.0))
            frame.call(self.roots.first_root, degree)

    def _record_levels(self, frame: Frame) -> None:
        """Store the levels of guards that change: table entries on both sides of a piece, and speeds of cones."""
        code = frame.code
        for g, guard in enumerate(self.borders.guards):
            if self.borders.decisions[guard.piece].kind == CONE:
                j = integer(code, guard.piece)
                fall = (0.0 - self.motion.followed_coefficient(frame, j, integer(code, 1))) * frame["forward"]
                last = fall * (limits.LAST_STEPS * frame["smallest"])  # what is gone in the shortest steps
                unit = code.lanes_of(absolute_tolerance(frame))
                far = self.motion.followed_value(frame, j) > limits.AT_REST * unit
                least = unit * code.select(far, limits.AT_REST, limits.SETS_OUT)
                frame["level", g] = code.select(last > least, last, least)
            if self.borders.decisions[guard.piece].kind == TABLE:
                index = self.table.piece(frame, guard.piece) + guard.level.offset
                knot, inside = self.knots.entry(frame, guard.piece, index)
                frame["level", g] = code.select(inside, knot, NOWHERE if guard.level.offset else -NOWHERE)

    @property
    def slides(self) -> bool:
        """True if the motion can slide along a border on which other switching numbers depend."""
        return bool(self.borders.holding.groups)

    def drop_missed_border(self, frame: Frame) -> None:
        """Drop the border of a step that was shortened and does not reach it."""
        code = frame.code
        frame["crossed"] = code.select(reaches_border(frame), frame["crossed"], StepEnd.NOTHING)
        frame["stepped"] = stepped = code.compare("!=", frame["h"], 0.0)
        if self.kicks is not None:
            stepped = self.kicks.mark_recorded_steps(frame, stepped)
        at_knot = (frame["stepped"] > 0.0) & (frame["crossed"] > StepEnd.GUARD)
        frame["at_knots"] = frame["at_knots"] + code.flag(at_knot)
        frame.assign(stepped, is_hit=0.0, grazes=0.0, stops=0.0)
        frame.call(self.graze)

    def _find_grazing(self, base: int) -> Code:
        """Emit `()`: set `grazes` where the step ends at a border that it only grazes, `stops` where u̇ is rounding.

        A perturbation of the motion by the tolerance, ε in the switching number u, decides whether it crosses the
        border where u̇² ≤ 2 |ü| ε.
        """
        frame, motion, n = self.motion.function("graze"), self.motion, self.motion.n
        code, order, by = frame.code, frame.job("order"), [*range(base), *range(n, n + base)]
        line = gradient(self.borders, by)
        counts = self.table.counts(frame)
        noted, ends = self.table.crosses_any(frame) & counts, self.table.crosses(frame, StepEnd.GUARD) & counts
        with code.only_if(code.any_lane(noted)):
            self.table.record_hit(frame, noted)
        with code.only_if(code.any_lane(ends)):
            state = motion.move_state(frame, motion.increments(frame, order, frame["h"])[0])
            inputs = state, [frame["t"] + frame["h"]], frame.vectors("params", motion.numbers)
            slopes = motion.form.run(frame, line, *inputs, frame.vectors("hit", self.pieces))
            rtol, atol = frame.job("rtol"), absolute_tolerance(frame)
            error, rounding = (code.variable(frame.constant(0.0)) for _ in range(2))
            for part in range(2):
                for i in motion.form.each(code, base):
                    slope = abs(slopes[i + part * base])
                    size = slope * abs(state[i + part * n])
                    rounding.value += size * limits.EPS
                    error.value += rtol * size + slope * code.lanes_of(atol)
            rate, bend = self._switching_rates(frame, order)
            is_hit = ends & (frame["is_hit"] > 0.0)
            for name, by in (("grazes", error.value), ("stops", rounding.value)):
                frame.assign(is_hit & (rate * rate <= 2.0 * (abs(bend) * by)), **{name: 1})
        return frame.finish()

    def _switching_rates(self, frame: Frame, order: Value) -> tuple[Value, Value]:
        """The rates u̇ and ü, at the end of the step, of the switching number selected by `hit`."""
        code, degree = frame.code, self.motion.followed_degree(frame.code, order)
        with code.loop(degree) as i:
            c = code.variable(frame.constant(0.0))
            with code.loop(self.pieces) as j:
                c.value = c.value + frame["hit", j] * self.motion.followed_coefficient(frame, j, i + 1)
            frame["poly", i] = c.value * code.lanes_of(code.as_double(i + 1))
        return self.roots.value_and_slope(frame, degree - 1, frame["h"])
