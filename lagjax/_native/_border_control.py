"""Borders of a piecewise program: a step ends at the first one, and the next begins on the piece beyond.

    decide    the pieces of a member that begins, and of one that has crossed a border on which others depend
    stop      the first root of all guards along the step, by their series: there the step ends; and so it does
              before a narrow feature comes nearer than a series can tell
    settle    a border counts only where the step was not shortened further
    cross     the piece beyond; its guard is zero there, and its slope tells whether the motion stays

What a piece is, and a guard, `_program._borders` says. That a border has been crossed is remembered (`_watch`), so that
rounding does not decide on which side the next step begins.
"""

import functools
import itertools
import math
from collections.abc import Container

from lagjax._native import _constants as limits
from lagjax._native._frame import Fields, Frame, Lane
from lagjax._native._ir import INTEGER, Code, Value
from lagjax._native._retraction import Retraction
from lagjax._native._roots import Roots
from lagjax._native._saltation import Saltation
from lagjax._native._step import absolute_tolerance
from lagjax._native._taylor import TaylorSeries, integer
from lagjax._native._watch import Border, Crossed, GuardTable, Touch, end_at_border, joint_groups, reaches_border
from lagjax._program._borders import Borders, gradient
from lagjax._program._features import BELOW, BESIDE, FALLS, GROWS, UP_TO, Feature
from lagjax._program._jump import Jump, Nesting
from lagjax._program._levels import CONE, SIGN, SLIDE, TABLE
from lagjax._program._passes import eliminate_dead_code

NOWHERE = 1e300  # a level that no switching number comes to
_UNHELD = 1e6  # a share of a border that both sides do not push onto: those of others are near 0 … 1
_AT_END = 16.0  # roundings of the time by which the end of a motion may miss an instant and is still taken to be there


class BorderControl:
    """The borders of a motion, whose pieces are its last parameters.

    Where it `returns` to long steps (`_rank_drops`), it does not go back over a border, nor because of one. With
    tangents (`nesting`) it has a `jump` of these.
    """

    def __init__(self, motion: TaylorSeries, borders: Borders, nesting: Nesting, returns: bool, jump: Jump | None):
        self.forgotten, base = {"h_before": 0.0} if returns else {}, nesting.base
        self.motion, self.borders, self.guards = motion, borders, borders.guards
        self.pieces, self.roots = motion.pieces, Roots(motion)
        if not self.pieces:
            self.stop = self._stop()
            return
        self.table, self.varies = GuardTable(motion, borders), jump is not None
        self.kicks_in_time = borders.kicks_in_time(motion.states)
        self.decide, self.stop = self._decide(), self._stop()
        self.retraction = borders.holding.retraction and Retraction(motion, borders, nesting)
        self.retract = self.retraction and self.retraction.apply(is_run=True)
        self.note, self.jump = None, None
        if jump is not None:
            saltation = Saltation(motion, self.table, base, jump)
            motion.layout.extend_by(saltation.fields_along())
            self.note, self.jump = saltation.note(), saltation.apply()
        self.graze = self._graze(base)
        self.kick = self._kick(base) if borders.kicking else None
        self.cross = self._cross()

    @staticmethod
    def fields(borders: Borders) -> Fields:
        guards, pieces = len(borders.guards), len(borders.switches)
        fields: Fields = {
            "touch": guards,  # the `Touch` of a guard where the step begins
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
            "stops": 1,  # 1 if the step ends at a border that it comes to with no speed, to rounding
            "level": guards if any(guard.of_table for guard in borders.guards) else 0,  # a level that changes
        }
        if groups := joint_groups(borders):
            fields |= {
                "joins": guards,  # where a guard is crossed, as a part of the step; then 1 if it is, at its end
                "taken": 1 + max(groups),  # 1 for a group of which a guard is crossed
                "more": 1,  # guards that are crossed beside the first one: each counts as a step, which it is elsewhere
            }
        if borders.kicking:
            fields |= {
                "kick_before": pieces,  # the pieces before the border
                "kicks": 1,  # 1 to kick the motion; 2 if it does not pass the border
                "counts": 1,  # 1 if the step is one that is recorded, be it of no length
            }
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
        with frame.code.loop(len(self.guards)) as g:
            lane["touch", g] = Touch.NONE
        with frame.code.loop(self.pieces) as j:
            lane["stays", j], lane["params", j + self.motion.parameters] = 0.0, 0.0

    # ---- where a member begins ----

    def _decide(self) -> Code:
        """`()`: the pieces of the lanes that are undecided."""
        frame = self.motion.function("decide")
        code, undecided = frame.code, frame["undecided"] > 0.0
        with code.only_if(code.any_lane(undecided)):
            inputs = [*self.motion.state_inputs(frame), frame.vectors("stays", self.pieces)]
            pieces = self.motion.form.run(frame, self.borders.decide, *inputs)
            for j in self.motion.form.each(code, self.pieces):
                frame.assign(undecided, j + self.motion.parameters, params=pieces[j])
                frame.assign(undecided, j, stays=0.0)
            for border in self.table.each(frame):
                slide = border["slide"]
                with code.only_if((slide >= 0) & code.compare("==", border.g, border["rest"])):
                    border.remember(undecided & (self.table.piece(frame, slide) > 0.0), touch=Touch.SLIDING)
            frame["undecided"] = 0.0
        return frame.finish()

    def _decide_again(self, frame: Frame, where: Value) -> None:
        frame.assign(where, undecided=1)
        frame.call(self.decide)

    # ---- the first border along the step ----

    def _stop(self) -> Code:
        """`(order)`: the step ends at the first border."""
        frame = self.motion.function("stop_at_border", INTEGER)
        code, (order,), h = frame.code, frame.arguments, frame["h"]
        degree = self.motion.followed_degree(code, order)
        frame["planned"], frame["nearest"] = h, 1.0
        frame["crossed"], frame["crossed_number"], frame["beyond"] = Crossed.NOTHING, 0.0, 0.0
        if self.pieces:
            for c, j in sorted(enumerate(self.borders.clocks), key=lambda clock: clock[1] not in self.borders.kicking):
                self._look_at_clock(frame, c, j, h)
            if self.table.movable and len(self.borders.clocks) > 1:
                self._note_coincidence(frame, h)
            self._note_levels(frame)
            if self.slides:
                frame["slides"] = 0.0
                for border in self.table.each(frame):
                    frame.assign(border.touch >= Touch.SLIDING, slides=1)
            for border in self.table.each(frame):
                self._look(frame, border, degree, h)
            if self.table.groups:
                self._join(frame, h)
        frame["next_approach"] = 0.0
        first = 0
        for feature, row in itertools.groupby(self.borders.features):  # which shares its code: as of a chain's bonds
            end = first + len(list(row))
            with code.loop(integer(code, end), start=first) as i:
                self._look_ahead(frame, i, feature, degree, h)
            first = end
        frame["approach"] = frame["next_approach"]
        cut = frame["nearest"] < 1.0
        if self.borders.kicking:
            self._look_at_end(frame, degree, h)
            cut = cut | self.table.kicks(frame)
        frame["h"] = end_at_border(frame)
        frame.assign(cut, last=0.0, **self.forgotten)
        return frame.finish()

    def _look(self, frame: Frame, border: Border, degree: Value, h: Value) -> None:
        """Note where a guard is crossed, if that is sooner than what was noted before."""
        code, piece = frame.code, border.piece
        side, level, beyond = border.rule("side")(piece), border.level(piece), border.rule("beyond")(piece)
        is_share, undecided = border.has("on"), code.compare("==", side, 0.0)
        # Nothing is looked for along the border that the motion slides on, or in the share of one that does not.
        idle = (border.touch >= Touch.SLIDING) | (undecided & is_share)
        if self.table.groups:
            frame["joins", border.g] = 2.0
        with code.only_if(code.any_lane(~idle)):
            self.roots.polynomial(frame, border["piece"], degree, h, code.select(undecided, 1.0, side), level)
            at_limit = (abs(frame["poly", 0]) <= limits.JUMP_NOISE) & (frame["steps"] > 0.0)
            if self.borders.releases:
                self._limit_growth(frame, border, level)
            comes = ~undecided & (~is_share | at_limit) & (border.touch <= Touch.NONE)
            leads = self.roots.leading_sign(frame, degree)
            self.roots.divide(frame, degree, border.touch)
            idle = idle | (self._is_rounding(frame, border, degree) & ~undecided)
            tolerances = limits.SWITCH_TOLERANCES * frame.job("rtol"), absolute_tolerance(frame)
            self.roots.shorten_to(frame, degree, *tolerances, limits.RESOLVED)
            frame.call(self.roots.first_root, degree)
            self._look_closer(frame, degree)
            self._note_first(frame, border, h, (undecided, beyond, leads), comes, idle)

    def _limit_growth(self, frame: Frame, border: Border, level: Value) -> None:
        """The step ends where the length of a cone's vector, whose polynomial is in `poly`, has grown by a part of it.

        Tangents across it change at a rate that falls as it grows: from rest on without a bound.
        """
        length, rate = frame["poly", 0] + level, frame["poly", 1]
        part = limits.GROWTH_OF_LENGTH * length / rate
        sooner = border.is_cone & ~border.has("on") & (rate > 0.0) & (length > level) & (part < frame["nearest"])
        frame.assign(sooner, nearest=part, crossed=Crossed.NOTHING)

    def _is_rounding(self, frame: Frame, border: Border, degree: Value) -> Value:
        """True if a guard whose polynomial is in `poly` leaves a border that the motion touches by rounding alone.

        A move of less than a part of atol does not count. Where borders hold together what moves by rounding, they are
        left and met in turn at one instant: then more is rounding.
        """
        code = frame.code
        turns = 1.0 + code.maximum(frame["idle_crossings"] - float(len(self.guards)), frame.constant(0.0))
        turns = code.select(turns < limits.MOST_TURNS, turns, limits.MOST_TURNS)
        patience = (turns * turns) * (turns * turns) * turns
        atol = code.lanes_of(absolute_tolerance(frame))
        nothing = self.roots.size(frame, degree) <= limits.NEGLIGIBLE * atol * patience
        touches = border.touch > Touch.NONE
        if self.slides:  # along u = 0 another border of |u| is there by rounding
            touches = touches | (frame["slides"] > 0.0)
        first = [abs(frame["poly", k]) for k in range(3)]  # the last ones may have become zero
        return (nothing & touches) | (first[0] + first[1] + first[2] < frame.digits.tiny)

    def _note_first(self, frame: Frame, border: Border, h: Value, piece: tuple, comes: Value, idle: Value) -> None:
        """Note the root of a guard if it is the first: `beyond` it is that `piece`, or one that is `undecided`.

        A border that it `comes` to where another one has been met is met in a step of its own: each shifts tangents.
        """
        code, (undecided, beyond, leads) = frame.code, piece
        # At rest but for what it gains in so little time: u̇ is of the size of ü t.
        gain = 4.0 * (abs(frame["poly", 2]) * frame["root"])
        at_rest = (border.touch > Touch.NONE) | (abs(frame["poly", 1]) <= gain)
        # A number that is zero leaves zero as its first coefficient says, or stays.
        leaves = undecided & code.compare("!=", leads, 0.0)
        root = code.select(undecided, code.select(leaves, 0.0, 2.0), self.roots.place(frame, 2.0))
        instant = limits.NO_TIME * frame["smallest"] / abs(h)
        root = code.select(comes & (root < instant) & (instant < 1.0), instant, root)
        is_root = leaves | (~undecided & self.roots.is_found(frame))
        # Of two at one instant that of the piece on which the other one depends, which comes first, is crossed.
        apart = code.select(frame["crossed"] > 0.0, 1.0 - limits.AT_ONCE, 1.0) if self.borders.nested else 1.0
        sooner = (root < frame["nearest"] * apart) & code.compare("!=", h, 0.0) & ~idle
        if self.table.groups:
            frame.assign(is_root & ~undecided & ~idle, border.g, joins=root)
        crossed = code.select(is_root, Crossed.GUARD, Crossed.NOTHING)
        frame.assign(sooner, nearest=root, at_rest=at_rest, crossed=crossed, crossed_number=code.as_double(border.g))
        frame.assign(sooner, beyond=code.select(undecided, leads, beyond))

    def _join(self, frame: Frame, h: Value) -> None:
        """Cross the first border of every group that is there at one instant with the first of all.

        With derivatives a border is met in a step of its own, which shifts tangents; it is crossed in no time.
        """
        code, groups = frame.code, self.table.groups
        assert groups is not None
        none, joins = code.compare("==", frame["nearest"], 0.0), frame.constant(0.0)
        may_join = none if self.varies else none | (code.lanes_of(code.as_double(frame.job("room"))) <= 0.0)
        instant = _AT_END * limits.EPS * (abs(frame["t"] / h) + 1.0)
        end = frame["nearest"] + code.select(none, 0.0, instant)
        with code.loop(1 + max(joint_groups(self.borders))) as k:
            frame["taken", k] = 0.0
        joins, frame["more"] = code.variable(joins), 0.0
        for border in self.table.each(frame):
            group = groups.read(code, border.g, "group")
            with code.only_if(group >= 0):
                is_first = may_join & self.table.crosses(frame, Crossed.GUARD, border.g)
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

    def _look_closer(self, frame: Frame, degree: Value) -> None:
        """A root that comes early is as exact as what lies before it allows, and not the whole step."""
        code = frame.code

        def early():
            return (frame["is_root"] > 0.0) & (frame["poly", 0] > 0.0) & (frame["root"] < limits.EARLY)

        with code.repeat_while(lambda: code.any_lane(early()), at_most=limits.MOST_LOOKS):
            straight = 0.0 - 4.0 * frame["poly", 0] / frame["poly", 1]  # for a root that is zero to rounding
            reach = code.select(frame["root"] > 0.0, 2.0 * frame["root"], straight)
            self.roots.stretch(frame, degree, code.select(early() & (reach > 0.0) & (reach < 1.0), reach, 1.0))
            frame.call(self.roots.first_root, degree)

    # ---- tables: borders at their entries ----

    def _knot(self, frame: Frame, j: int, index: Value) -> tuple[Value, Value]:
        """An entry of the table of piece j, and whether there is one of this number."""
        located = self.borders.decisions[j].table
        assert located is not None
        inside = (index >= 0.0) & (index <= float(located.table.count - 1))
        return self.motion.look_up.take(frame, located.table, index), inside

    def _time_to_next_knot(self, frame: Frame, j: int) -> tuple[Value, Value]:
        """The time to the next entry of the table that the time is on, and the lanes where there is one."""
        code, forward = frame.code, frame["forward"]
        knot, inside = self._knot(frame, j, self.table.piece(frame, j) + code.flag(forward > 0.0))
        return ((knot - frame["t"]) - frame["t_low"]) * forward, inside

    def _look_at_clock(self, frame: Frame, c: int, j: int, h: Value) -> None:
        """The step ends at the next entry of a table that the time is on, which is known."""
        code = frame.code
        left, inside = self._time_to_next_knot(frame, j)
        left, size = code.maximum(left, frame.constant(0.0)), abs(h)
        nearest = frame["nearest"] * size
        if self.borders.kicking and j not in self.borders.kicking:  # of several at one instant a kick counts
            nearest = nearest - self._instant(frame)
        sooner = inside & (left < nearest)
        if j in self.borders.kicking:  # also at the end of the motion, where the velocities are those behind it
            located = self.borders.decisions[j].table
            assert located is not None
            is_inner = self.table.piece(frame, j) < float(located.table.count - 1 - located.closed)
            at_end = (frame["forward"] > 0.0) & is_inner & code.compare("==", left, nearest) & (size > 0.0)
            sooner = sooner | (inside & at_end & code.compare("==", frame["crossed"], 0.0))
        frame.assign(sooner, nearest=left / size, crossed=Crossed.KNOT, crossed_number=float(c))

    def _note_coincidence(self, frame: Frame, h: Value) -> None:
        """Entries of several tables at one instant, one of which may be moved."""
        code, end = frame.code, frame["nearest"] * abs(h)
        count, moves = frame.constant(0.0), frame.constant(0.0)
        for j in self.borders.clocks:
            left, inside = self._time_to_next_knot(frame, j)
            at_once = inside & (frame["crossed"] > 0.0) & (abs(left - end) <= self._instant(frame))
            count = count + code.flag(at_once)
            if j in self.table.movable:
                moves = moves + code.flag(at_once)
        frame.assign((count > 1.0) & (moves > 0.0), crossed=Crossed.KNOTS)

    def _instant(self, frame: Frame) -> Value:
        """The largest difference of two times that count as the same."""
        return frame.code.maximum(abs(frame["t"]), frame["smallest"]) * (4.0 * limits.EPS)

    def _note_levels(self, frame: Frame) -> None:
        """The levels of guards that change: entries on both sides of the pieces of tables, and the speeds of cones."""
        code = frame.code
        for g, guard in enumerate(self.guards):
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
                knot, inside = self._knot(frame, guard.piece, index)
                frame["level", g] = code.select(inside, knot, NOWHERE if guard.level.offset else -NOWHERE)

    @property
    def slides(self) -> bool:
        """True if the motion may slide along a border that other switching numbers depend on."""
        return bool(self.borders.holding.groups)

    # ---- narrow features ----

    def _look_ahead(self, frame: Frame, i: Value, feature: Feature, degree: Value, h: Value) -> None:
        """The step ends where the argument of feature number i has come as near as one step may bring it."""
        code, j = frame.code, i + self.pieces
        moves, last = self._moves(frame, j, degree, h)
        rise = code.lanes_of(code.as_double(degree)) * (limits.RISE / feature.scale)
        near = ~((moves < rise) & (last < limits.ARGUMENT))
        if feature.kind == FALLS:
            size = abs(self.motion.followed_value(frame, j))
            # The base of the power may fall by this in a step of the least order.
            fall = max(math.exp(-limits.RISE * (limits.LEAST_ORDER - 1) / feature.scale), limits.LARGEST_FALL)
            near = ~(moves < (1.0 - fall) * size)
        if feature.kind in (UP_TO, GROWS):  # which change by more than their argument does
            near = frame.constant(0.0) <= 0.0
        with code.only_if(code.any_lane(near)):
            self._find_feature(frame, j, feature, degree, h)

    def _moves(self, frame: Frame, j: Value, degree: Value, h: Value) -> tuple[Value, Value]:
        """The largest change of a number along the step, Σ |cₖ| for k > 0, and the last of these terms."""
        code, size, sum = frame.code, abs(h), frame.constant(0.0)

        def coefficient(k: Value) -> Value:
            return abs(self.motion.followed_coefficient(frame, j, k))

        for i in range(3):
            sum = (sum + coefficient(degree - i)) * size
        sum, last = code.variable(sum), code.variable(sum)
        with code.loop(degree, start=3) as i:
            sum.value = (sum.value + coefficient(degree - i)) * size
            last.value = last.value * size
        return sum.value, last.value

    def _find_feature(self, frame: Frame, j: Value, feature: Feature, degree: Value, h: Value) -> None:
        """With its argument u: where α + β u is zero, the step ends."""
        code, kind, scale = frame.code, feature.kind, feature.scale
        u = self.motion.followed_value(frame, j)
        rise = code.lanes_of(code.as_double(degree)) * limits.RISE
        side = code.select(u < 0.0, -1.0, 1.0)
        matters, slope = code.compare("!=", u, 0.0), side
        of_size, absolute = frame.constant(0.0), frame.constant(limits.ARGUMENT)
        if kind == UP_TO:
            start, of_size, absolute = side * u, frame.constant(limits.ABRUPT), frame.constant(0.0)
        elif kind == FALLS:
            fall = code.maximum(code.library("exp", rise * (-1.0 / scale)), frame.constant(limits.LARGEST_FALL))
            start, absolute = side * (u - fall * u), limits.ARGUMENT * (fall * (side * u))
        elif kind == GROWS:
            faint = frame.constant(math.exp(-limits.FAINT / scale))
            level = code.maximum(code.library("exp", rise * (1.0 / scale)) * u, faint)
            matters, slope, start = level > 0.0, frame.constant(-1.0), level - u
            absolute = limits.ARGUMENT * level
        else:
            slope = frame.constant(-scale) if kind == BELOW else scale * side
            level = code.maximum(rise - slope * u, -limits.FAINT)
            matters = level < (float("inf") if kind == BELOW else 0.0)
            start = level + slope * u
            if kind == BELOW:  # from above it comes to where there is a series again, and then is told in parts
                above, falls = u * scale - limits.BEYOND, self.motion.followed_coefficient(frame, j, 1) * h < 0.0
                high = (above > 0.0) | ((u * scale > limits.STEEP) & falls)
                slope = code.select(high, scale, slope)
                start = code.select(high, code.maximum(above, rise), start)
        if kind in (BELOW, BESIDE):
            far = start > limits.FAR
            start = code.select(far, (1.0 - limits.LARGEST_FALL) * start, start)
            of_size = code.select(far, limits.ARGUMENT * limits.LARGEST_FALL, of_size)
        self.roots.polynomial(frame, j, degree, h, slope, u - start / slope)
        if kind == FALLS:  # one that rises is told by fewer terms
            self.roots.sum_up(frame, degree)
            rises = frame["falls"] < start
            size = start + frame["rises"]
            matters = matters & ~(rises & (self.roots.last_terms(frame, degree) < limits.ARGUMENT * size))
        self.roots.shorten_to(frame, degree, of_size, absolute)
        frame.call(self.roots.first_root, degree)
        root = self.roots.place(frame, 2.0)
        if kind in (UP_TO, FALLS):
            matters, root = self._approach(frame, kind, h, matters, root)
        sooner = matters & (root > 0.0) & (root < frame["nearest"]) & code.compare("!=", h, 0.0)
        frame.assign(sooner, nearest=root, crossed=Crossed.NOTHING)

    def _approach(self, frame: Frame, kind: int, h: Value, matters: Value, root: Value) -> tuple[Value, Value]:
        """Steps end ever nearer to where no series begins, until that is near; and then beyond it, where one does."""
        code, found = frame.code, self.roots.is_found(frame)
        way, whole = frame["root"] * frame["part"], abs(h)
        nearby = (limits.NEARBY if kind == UP_TO else limits.NARROWEST) * code.maximum(whole, frame["approach"])
        instant = code.lanes_of(limits.INSTANT * frame["smallest"])  # what is as near, time does not tell from here
        nearby = code.maximum(nearby, instant) if kind == UP_TO else nearby
        far = way * whole > nearby
        frame.assign(matters & far & found, next_approach=code.maximum(whole, frame["approach"]))
        if kind == FALLS:
            return matters & (far | ~found), root
        beyond = code.maximum(frame.constant(limits.NEARBY), 2.0 * instant / whole)
        past = code.select(far, way * limits.SHORT_OF, way * limits.PAST + beyond)
        return matters, code.select(found, past, root)

    # ---- beyond it ----

    def settle(self, frame: Frame) -> None:
        """A step that has become shorter than planned does not reach its border."""
        code = frame.code
        frame["crossed"] = code.select(reaches_border(frame), frame["crossed"], Crossed.NOTHING)
        frame["stepped"] = stepped = code.compare("!=", frame["h"], 0.0)
        if self.borders.kicking:  # steps that are recorded: those of no length, too, where a kick begins or ends them
            stepped = stepped | (self.table.kicks(frame) & ~self._begins_behind(frame))
            frame["counts"] = stepped | (frame["last"] > 0.0)
        at_knot = (frame["stepped"] > 0.0) & (frame["crossed"] > Crossed.GUARD)
        frame["at_knots"] = frame["at_knots"] + code.flag(at_knot)
        frame.assign(stepped, is_hit=0.0, grazes=0.0, stops=0.0)
        frame.call(self.graze)

    def _graze(self, base: int) -> Code:
        """`()`: set `grazes` where the step ends at a border that it only grazes, and `stops` where to rounding.

        With the rate u̇ of its switching number a motion that is moved by the tolerance, u by ε, does not cross it, or
        has before, where u̇² ≤ 2 |ü| ε.
        """
        frame, motion, n = self.motion.function("graze"), self.motion, self.motion.n
        code, order, by = frame.code, frame.job("order"), [*range(base), *range(n, n + base)]
        line = gradient(self.borders, by)
        counts = self.table.counts(frame)
        noted, ends = self.table.crosses_any(frame) & counts, self.table.crosses(frame, Crossed.GUARD) & counts
        with code.only_if(code.any_lane(noted)):
            self.table.note_hit(frame, noted)
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
            rate, bend = self._rates(frame, order)
            is_hit = ends & (frame["is_hit"] > 0.0)
            for name, by in (("grazes", error.value), ("stops", rounding.value)):
                frame.assign(is_hit & (rate * rate <= 2.0 * (abs(bend) * by)), **{name: 1})
        return frame.finish()

    def _rates(self, frame: Frame, order: Value) -> tuple[Value, Value]:
        """u̇ and ü at the end of the step, of the switching number that is `hit`."""
        code, degree = frame.code, self.motion.followed_degree(frame.code, order)
        with code.loop(degree) as i:
            c = code.variable(frame.constant(0.0))
            with code.loop(self.pieces) as j:
                c.value = c.value + frame["hit", j] * self.motion.followed_coefficient(frame, j, i + 1)
            frame["poly", i] = c.value * code.lanes_of(code.as_double(i + 1))
        return self.roots.value_and_slope(frame, degree - 1, frame["h"])

    def _cross(self) -> Code:
        """`()`: after the step, the pieces beyond the borders that were reached."""
        frame = self.motion.function("cross")
        code = frame.code
        stepped, crosses, was_cut = frame["stepped"] > 0.0, frame["crossed"] > Crossed.NOTHING, frame["nearest"] < 1.0
        if self.retraction is not None:  # borders that are left before the step begins do not take the state
            has_begun = stepped | (frame["returned"] > 0.0) if self.forgotten else stepped
            self.retraction.undo(frame, ~has_begun)
        for border in self.table.each(frame):
            border.remember(stepped & (border.touch < Touch.SLIDING), touch=Touch.NONE)
        with code.only_if(code.any_lane(crosses | was_cut)):
            # What a cut step was to be says more about the next one than what it became.
            longest = limits.GROWTH * abs(frame["planned"])
            frame.assign(was_cut & reaches_border(frame), longest=longest, h=frame["planned"])
            if self.note is not None:
                frame.call(self.note)
            if self.borders.holding.release.outputs:
                self._release(frame)
            if self.kick is not None:
                with code.loop(self.pieces) as j:
                    frame["kick_before", j] = self.table.piece(frame, j)
            self._go_on(frame, crosses)
            if self.table.groups:
                counts = stepped & self.table.crosses(frame, Crossed.GUARD)
                frame["steps"] = frame["steps"] + code.select(counts, frame["more"], 0.0)
            frame.assign(crosses, **self.forgotten)
            if self.kick is not None:
                self._kick_or_reflect(frame, self.kick, crosses)
            if self.jump is not None:
                frame.call(self.jump)
            # A border at which a step of no length ends, too, whether it is crossed or only met.
            idle = code.select(stepped, 0.0, frame["idle_crossings"] + 1.0)
            frame.assign(stepped | crosses | was_cut, idle_crossings=idle)
            most = float(limits.MOST_CROSSINGS * (len(self.guards) + len(self.borders.clocks)))
            frame.assign(frame["idle_crossings"] > most, code=limits.DISCONTINUOUS)
        return frame.finish()

    def _go_on(self, frame: Frame, going: Value) -> None:
        """Go past borders and knots; the motion slides along no border that jumps there, and touches none such."""
        shaken, code = self.borders.shaken, frame.code
        line = eliminate_dead_code(self.borders.program.line, [self.borders.decisions[j].switch for j in shaken])
        before = self.motion.evaluate_now(frame, line) if shaken else []
        before = [code.variable(before[k]) for k in range(len(shaken))]
        for border in self.table.each(frame):
            self._take_beyond(frame, border)
        for j in self.borders.clocks:  # all whose next entry the time has come to, at one instant
            left, inside = self._time_to_next_knot(frame, j)
            passes = going & inside & (left <= self._instant(frame))
            frame.assign(passes, self.motion.parameters + j, params=self.table.piece(frame, j) + frame["forward"])
        self._decide_others(frame, going)
        after = self.motion.evaluate_now(frame, line) if shaken else []
        for k, j in enumerate(shaken):
            jump = abs(after[k] - before[k].value)
            least = abs(after[k]) * frame.digits.round_off + code.lanes_of(absolute_tolerance(frame))
            self._let_go(frame, going & (jump > least), [j])
        if shaken:
            self._decide_others(frame, going)

    def _let_go(self, frame: Frame, where: Value, pieces: Container[int]) -> None:
        """The motion touches the borders of some pieces no more, and slides along none of them."""
        for g, guard in enumerate(self.guards):
            if guard.piece in pieces:
                frame.assign(where, g, touch=Touch.NONE)
                if guard.slide >= 0:
                    frame.assign(where, self.motion.parameters + guard.slide, params=0.0)

    def _decide_others(self, frame: Frame, going: Value) -> None:
        """Decide the pieces anew that touch no border and have left none, where one is crossed that others read."""
        if not self.borders.nested:
            return
        with frame.code.loop(self.pieces) as j:
            frame["stays", j] = 0.0
        for j in self.borders.clocks:
            frame["stays", j] = 1.0
        for border in self.table.each(frame):
            frame.assign(frame.code.compare("!=", border.touch, float(Touch.NONE)), border["piece"], stays=1)
        self._decide_again(frame, going)

    def _take_beyond(self, frame: Frame, border: Border) -> None:
        """Take the piece beyond a border, which touches it; a piece that touches one is not decided anew.

        A motion that would go back over the border at once is pushed onto it from both sides: it slides. So does one
        that has come back in no measurable time, or not to rounding: it bounces off the border, ever less, and rests.
        """
        code, hit, again, beyond = frame.code, border.is_hit, frame["stepped"] <= 0.0, frame["beyond"]
        if self.table.groups:
            is_first = self.table.crosses(frame, Crossed.GUARD, border.g)
            beyond = code.select(is_first, beyond, border.rule("beyond")(border.piece))
        no_time = ~again & (abs(end_at_border(frame)) <= limits.NO_TIME * frame["smallest"])
        no_time = (no_time | (~again & (frame["stops"] > 0.0))) & (frame["at_rest"] > 0.0)
        place, back, slide = border["piece"] + self.motion.parameters, border["back"], border["slide"]
        bounces = no_time & border.has("order", 2)  # by position
        slides = bounces | (again & (border.touch > Touch.NONE))
        if self.borders.releases:
            slides = slides | border.is_cone
        slides = hit & slides & border.has("slide")
        frame.assign(hit & ~slides, place, params=beyond)
        # A share jumps to where it is: it need not touch the border that it had crossed before.
        frame.assign(hit, back, touch=code.select(border.has("on"), Touch.NONE, Touch.VALUE))
        with code.only_if(slide >= 0):
            below = code.select(border.piece < beyond, border.piece, beyond)
            frame.assign(slides, place, params=code.select(border.is_sign, -1.0, below))
            frame.assign(slides, slide + self.motion.parameters, params=1)
            for g, touch in ((border.g, Touch.NONE), (back, Touch.NONE), (border["rest"], Touch.SLIDING)):
                frame.assign(slides, g, touch=touch)
        self._leave(frame, border, hit, again)

    def _leave(self, frame: Frame, border: Border, hit: Value, again: Value) -> None:
        """Let a sliding motion go on along one side, where its share of that side comes to 0 or 1.

        The rate of u that was kept at zero is zero there after a slide, and not where it did not slide at all. Where
        both sides do not push onto the border, it goes on as the function is written at the border itself.
        """
        code, on = frame.code, Border(frame, self.table, border["on"])
        with code.only_if(on.g >= 0):
            order = code.lanes_of(code.as_double(on["order"]))
            gains = code.as_double(border["gains"])
            share, below, level = self.motion.followed_value(frame, border["piece"]), on.piece, on.rule("level")
            unheld = hit & (abs(share) > _UNHELD) & ~on.is_cone
            toward_zero = (code.lanes_of(abs(level.below) + abs(level.above)) > 0.0) & (below < 0.0)
            as_written = code.select(on.is_sign, 0.0, below + code.select(toward_zero, 0.0, 1.0))
            place = on["piece"] + self.motion.parameters
            frame.assign(hit, place, params=code.select(unheld, as_written, below + gains))
            frame.assign(hit, border["rest"], touch=Touch.NONE)
            on.remember(hit, touch=code.select(again, order, order + Touch.VALUE))
            on.remember(unheld, touch=Touch.CONTINUES)
            if self.borders.releases:  # the vector of a cone has been given a length beyond its level
                on.remember(hit & on.is_cone, touch=Touch.NONE)

    def _release(self, frame: Frame) -> None:
        """Let the vectors of cones that hold no longer set out, with a speed that is twice what counts as none."""
        code, motion, n = frame.code, self.motion, len(self.borders.holding.release.outputs)
        shares = self.borders.releases
        hits = [self.table.crosses(frame, Crossed.GUARD, g) for g in shares]
        base = n // (2 * len(shares))
        with code.only_if(code.any_lane(functools.reduce(Value.__or__, hits))):
            out = motion.evaluate_now(frame, self.borders.holding.release)
            speed = code.lanes_of(2.0 * limits.SETS_OUT * absolute_tolerance(frame))
            for k, hit in enumerate(hits):
                for i in range(base):
                    places = 2 * k * base + i, (2 * k + 1) * base + i
                    if any(self.borders.holding.release.constant(place) != 0.0 for place in places):
                        y = frame["y", i + motion.n, 0] + (speed * out[places[0]] - out[places[1]])
                        frame.assign(hit, i + motion.n, 0, y=y)
                        frame.assign(hit, i + motion.n, low=0.0)

    # ---- where L jumps ----

    def _begins_behind(self, frame: Frame) -> Value:
        """True where a motion begins at an instant at which L jumps: with the velocities behind it, in time's order."""
        begins = (frame["steps"] <= 0.0) & (frame["forward"] > 0.0)
        found = frame.constant(0.0) > 0.0
        for g, guard in enumerate(self.guards):
            if self._kicks_by_sign(guard.piece):
                found = found | self.table.crosses(frame, Crossed.GUARD, g)
        return begins & found & frame.code.compare("==", frame["h"], 0.0)

    def _kicks_by_sign(self, j: int) -> bool:
        return j in self.kicks_in_time and self.borders.decisions[j].kind == SIGN

    def _look_at_end(self, frame: Frame, degree: Value, h: Value) -> None:
        """A step ends, to rounding, where L jumps at the end of the motion: with the velocities behind, in time."""
        code, one = frame.code, frame.constant(1.0)
        ends = (frame["last"] > 0.0) & (frame["forward"] > 0.0) & code.compare("!=", h, 0.0)
        for g, guard in enumerate(self.guards):
            if guard.piece not in self.kicks_in_time:
                continue
            border = Border(frame, self.table, integer(code, g))
            side = guard.side(border.piece)
            self.roots.polynomial(frame, border["piece"], degree, h, side, border.level(border.piece))
            end, slope = self.roots.value_and_slope(frame, degree, one)
            noise = _AT_END * limits.EPS * abs(frame["t_end"] / h * slope)
            there = ends & code.compare("!=", side, 0.0) & (end <= noise) & code.compare("==", frame["nearest"], one)
            beyond = guard.beyond(border.piece)
            frame.assign(there, crossed=Crossed.GUARD, crossed_number=float(g), beyond=beyond)

    def _kick(self, base: int) -> Code:
        """`()`: the velocities behind the border, in the lanes that are to `kicks`; 2 there if they do not pass it."""
        frame, motion, kick = self.motion.function("kick"), self.motion, self.borders.kick
        assert kick is not None
        code, n, kicks = frame.code, motion.n, frame["kicks"] > 0.0
        with code.only_if(code.any_lane(kicks)):
            parameters = motion.parameters * base // n  # of the motion without its tangents
            inputs = [
                frame.vectors("y", base, lambda i: (i, 0)), frame.vectors("y", base, lambda i: (i + n, 0)),
                frame.vectors("t", 1), frame.vectors("params", parameters), frame.vectors("kick_before", self.pieces),
                frame.vectors("params", self.pieces, lambda i: (i + motion.parameters,)),
                frame.vectors("hit", self.pieces),
            ]  # fmt: skip
            if self.borders.levels_move:  # which do not matter to slopes
                inputs.append(frame.vectors("hit", self.pieces))
            out = motion.form.run(frame, kick.line, *inputs)
            passes = out[base] > 0.0
            for i in motion.form.each(code, base):
                frame.assign(kicks & passes, i + n, 0, y=out[i])
                frame.assign(kicks & passes, i + n, low=0.0)
            frame.assign(kicks & ~passes, kicks=2.0)
        return frame.finish()

    def _kick_or_reflect(self, frame: Frame, kick: Code, crosses: Value) -> None:
        """Give the motion the velocities that it has where L jumps: behind the border, or before it once more."""
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
        frame.call(kick)
        reflected = frame["kicks"] > 1.0
        with code.only_if(code.any_lane(reflected)):
            with code.loop(self.pieces) as j:
                frame.assign(reflected, j + self.motion.parameters, params=frame["kick_before", j])
            for border in self.table.each(frame):
                border.remember(reflected, touch=code.select(border.is_hit, Touch.VALUE, Touch.NONE))
            frame["kicks"] = code.select(reflected, 1.0, 0.0)
            frame.call(kick)
        self._decide_by_velocity(frame, kicks > 0.0)

    def _decide_by_velocity(self, frame: Frame, kicked: Value) -> None:
        """Decide the pieces anew whose switching numbers depend on velocities, which have been kicked."""
        velocities = range(self.motion.n, self.motion.states)
        by_velocity = [
            j
            for j, node in enumerate(self.borders.switches)
            if self.borders.decisions[j].kind != SLIDE and not self.borders.read_by(node).isdisjoint(velocities)
        ]
        if by_velocity:
            for j in range(self.pieces):
                frame.assign(kicked, j, stays=0.0 if j in by_velocity else 1.0)
            self._let_go(frame, kicked, by_velocity)
            self._decide_again(frame, kicked)
