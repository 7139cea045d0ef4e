"""Borders of a piecewise program: a step ends at the first one, and the next begins on the piece beyond.

    decide    the pieces of a member that begins, and of one that has crossed a border on which others depend
    stop      the first root of all guards along the step, by their series: there the step ends; and so it does
              before a narrow feature comes nearer than a series can tell
    settle    a border counts only where the step was not shortened further
    cross     the piece beyond; its guard is zero there, and its slope tells whether the motion stays

What a piece is, and a guard, `_program._borders` says. That a border has been crossed is remembered, so that rounding
does not decide on which side the next step begins.
"""

import itertools
import math

from lagjax._native import _constants as limits
from lagjax._native._frame import Fields, Frame, Lane
from lagjax._native._ir import INTEGER, Code, Value
from lagjax._native._retraction import Retraction
from lagjax._native._roots import Roots, Touch
from lagjax._native._saltation import Crossed, GuardTable, Saltation
from lagjax._native._step import absolute_tolerance
from lagjax._native._taylor import TaylorSeries, integer
from lagjax._program import _borders
from lagjax._program._borders import BELOW, FALLS, GROWS, SQUARED, UP_TO, Feature
from lagjax._program._jump import Jump, Nesting
from lagjax._program._passes import eliminate_dead_code

NOWHERE = 1e300  # a level that no switching number comes to
_AT_END = 16.0  # roundings of the time by which the end of a motion may miss an instant and is still taken to be there


class BorderControl:
    """The borders of a motion, whose pieces are its last parameters.

    Where it `returns` to long steps (`_rank_drops`), it does not go back over a border, nor because of one. With
    tangents (`nesting`) it has a `jump` of these.
    """

    def __init__(
        self, motion: TaylorSeries, borders: _borders.Borders, nesting: Nesting, returns: bool, jump: Jump | None
    ):
        self.returns, base = returns, nesting.base
        self.motion, self.borders, self.guards = motion, borders, borders.guards
        self.pieces, self.roots = motion.pieces, Roots(motion)
        if not self.pieces:
            self.stop = self._stop()
            return
        self.table = GuardTable(motion, borders)
        self.kicks_in_time = borders.kicks_in_time(motion.states)
        self.decide, self.stop = self._decide(), self._stop()
        self.retraction = borders.retraction and Retraction(motion, borders, nesting)
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
    def fields(borders: _borders.Borders) -> Fields:
        guards, pieces = len(borders.guards), len(borders.switches)
        fields: Fields = {
            "touch": guards,  # the `Touch` of a guard where the step begins
            "stays": pieces,  # 1 for a piece that is not decided anew
            "at_knots": 1,  # the number of steps that ended at entries of tables
            "beyond": 1,  # the piece beyond the guard that the step ends at
            "at_rest": 1,  # 1 if the motion would be at the guard in no time
            "planned_h": 1,  # the step without borders
            "cut": 1,  # the step with them
            "nearest": 1,  # the end of the step, as a part of it
            "undecided": 1,  # 1 in a lane whose pieces are to be decided
            "idle_crossings": 1,  # the number of borders since the last step that had a length
            "stepped": 1,  # 1 if the step has one
            "part": 1,  # see `Roots.fields`
            "approach": 1,  # the step from which on others ended before a border without a series; 0 if that is over
            "next_approach": 1,  # the same behind this step
            "slides": 1,  # 1 if the motion slides along any border
            "stops": 1,  # 1 if the step ends at a border that it comes to with no speed, to rounding
            "level": guards if any(guard.of_table for guard in borders.guards) else 0,  # a level that changes
        }
        if borders.kicking:
            fields |= {
                "kick_before": pieces,  # the pieces before the border
                "kick_hit": pieces,  # 1 for the piece whose switching number is zero there
                "kicks": 1,  # 1 to kick the motion; 2 if it does not pass the border
                "counts": 1,  # 1 if the step is one that is recorded, be it of no length
            }
        return fields | Roots.fields(limits.MAX_ORDER + 2) | Saltation.fields(borders)

    def begin(self, frame: Frame, lane: Lane) -> None:
        lane["approach"] = 0.0
        if not self.pieces:
            return
        located = [of.table for of in self.borders.tables if of is not None and of.table.numbers is None]
        for table in dict.fromkeys(located):  # of entries that do not increase nothing can be made
            first = frame.code.as_integer(lane["first_number"])
            with frame.code.only_if(~self.motion.look_up.increases(frame, table, first)):
                lane["y", 0] = float("nan")
        for name in ("crossed", "idle_crossings", "stepped", "at_knots", "is_hit", "grazes"):
            lane[name] = 0.0
        lane["undecided"] = 1.0
        with frame.code.loop(len(self.guards)) as g:
            lane["touch", g] = Touch.NONE
        with frame.code.loop(self.pieces) as j:
            lane["stays", j] = 0.0
            lane["params", j + self.motion.parameters] = 0.0

    def _piece(self, frame: Frame, j: Value) -> Value:
        return frame["params", j + self.motion.parameters]

    # ---- where a member begins ----

    def _decide(self) -> Code:
        """`()`: the pieces of the lanes that are undecided."""
        frame = self.motion.function("decide")
        code, undecided = frame.code, frame["undecided"] > 0.0
        with code.only_if(code.any_lane(undecided)):
            inputs = [*self.motion.state_inputs(frame), frame.vectors("stays", self.pieces)]
            pieces = self.motion.form.run(frame, self.borders.decide, *inputs)
            for j in self.motion.form.each(code, self.pieces):
                place = j + self.motion.parameters
                with frame.where(undecided):
                    frame["params", place] = pieces[j]
                    frame["stays", j] = 0.0
            with code.loop(len(self.guards)) as g:
                slide = self.table.place(code, g, "slide")
                with code.only_if((slide >= 0) & code.compare("==", g, self.table.place(code, g, "rest"))):
                    slides = undecided & (self._piece(frame, slide) > 0.0)
                    with frame.where(slides):
                        frame["touch", g] = Touch.SLIDING
            frame["undecided"] = 0.0
        return frame.finish()

    # ---- the first border along the step ----

    def _stop(self) -> Code:
        """`(order)`: the step ends at the first border."""
        frame = self.motion.function("stop_at_border", INTEGER)
        code, (order,), h = frame.code, frame.arguments, frame["h"]
        degree = self.motion.followed_degree(code, order)
        frame["planned_h"], frame["nearest"] = h, 1.0
        frame["crossed"], frame["crossed_number"], frame["beyond"] = Crossed.NOTHING, 0.0, 0.0
        if self.pieces:
            clocks = sorted(enumerate(self.borders.clocks), key=lambda clock: clock[1] not in self.borders.kicking)
            for c, j in clocks:
                self._look_at_clock(frame, c, j, h)
            if self.table.movable and len(self.borders.clocks) > 1:
                self._note_coincidence(frame, h)
            self._note_levels(frame)
            if self.slides:
                frame["slides"] = 0.0
                with code.loop(len(self.guards)) as g, frame.where(frame["touch", g] >= Touch.SLIDING):
                    frame["slides"] = 1
            with code.loop(len(self.guards)) as g:
                self._look(frame, g, degree, h)
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
        frame["h"] = code.select(cut, frame["nearest"] * h, h)
        frame["cut"] = frame["h"]
        with frame.where(cut):
            frame["last"] = 0.0
            if self.returns:
                frame["h_before"] = 0.0
        return frame.finish()

    def _look(self, frame: Frame, g: Value, degree: Value, h: Value) -> None:
        """Note where guard g is crossed, if that is sooner than what was noted before."""
        code = frame.code
        j = self.table.place(code, g, "piece")
        piece = self._piece(frame, j)
        side, level, beyond = (self.table.rule(code, g, name) for name in ("side", "level", "beyond"))
        level = level(piece, lambda where, x: code.select(where, code.lanes_of(x), 0.0))
        if any(guard.of_table for guard in self.guards):
            is_table = code.lanes_of(code.as_double(self.table.place(code, g, "of_table"))) > 0.0
            level = code.select(is_table, frame["level", g], level)
        side, beyond = side(piece), beyond(piece)
        is_share = code.lanes_of(code.flag(self.table.place(code, g, "on") >= 0)) > 0.0
        undecided = code.compare("==", side, 0.0)
        # Nothing is looked for along the border that the motion slides on, or in the share of one that does not.
        idle = (frame["touch", g] >= Touch.SLIDING) | (undecided & is_share)
        with code.only_if(code.any_lane(~idle)):
            self.roots.polynomial(frame, j, degree, h, code.select(undecided, 1.0, side), level)
            at_limit = (code.intrinsic("fabs", frame["poly", 0]) <= limits.JUMP_NOISE) & (frame["steps"] > 0.0)
            if self.borders.releases:
                self._limit_growth(frame, g, level)
            comes = ~undecided & (~is_share | at_limit) & (frame["touch", g] <= Touch.NONE)
            self._look_along(frame, g, degree, h, undecided, beyond, idle, comes)

    def _limit_growth(self, frame: Frame, g: Value, level: Value) -> None:
        """The step ends where the length of a cone's vector, whose polynomial is in `poly`, has grown by a part of it.

        Tangents across it change at a rate that falls as it grows: from rest on without a bound.
        """
        code = frame.code
        is_cone = self._is_cone(frame, g) & (code.lanes_of(code.as_double(self.table.place(code, g, "on"))) < 0.0)
        length, rate = frame["poly", 0] + level, frame["poly", 1]
        part = limits.GROWTH_OF_LENGTH * length / rate
        sooner = is_cone & (rate > 0.0) & (length > level) & (part < frame["nearest"])
        with frame.where(sooner):
            frame["nearest"] = part
            frame["crossed"] = Crossed.NOTHING

    def _look_along(self, frame: Frame, g: Value, degree: Value, h: Value, undecided, beyond, idle, comes) -> None:
        """The first root of guard g, whose polynomial is in `poly`; `beyond` it is that piece.

        A border that it `comes` to where another one has been met is met in a step of its own: each shifts tangents.
        """
        code, leads = frame.code, frame.code.variable(frame.constant(0.0))
        with code.loop(degree) as i:  # the sign of the first coefficient behind c₀ that is not zero
            c = frame["poly", degree - i]
            leads.value = code.select(code.compare("!=", c, 0.0), code.select(c > 0.0, 1, -1.0), leads.value)
        leads = leads.value
        self._divide(frame, g, degree)
        # A move of less than a part of atol does not count as leaving a border that the motion touches. Where borders
        # hold together what moves by rounding, they are left and met in turn at one instant: then more is rounding.
        turns = 1.0 + code.maximum(frame["idle_crossings"] - float(len(self.guards)), frame.constant(0.0))
        turns = code.select(turns < limits.MOST_TURNS, turns, limits.MOST_TURNS)
        patience = (turns * turns) * (turns * turns) * turns
        atol = absolute_tolerance(frame)
        nothing = self.roots.size(frame, degree) <= limits.NEGLIGIBLE * code.lanes_of(atol) * patience
        touches = frame["touch", g] > Touch.NONE
        if self.slides:  # along u = 0 another border of |u| is there by rounding
            touches = touches | (frame["slides"] > 0.0)
        first = [code.intrinsic("fabs", frame["poly", k]) for k in range(3)]  # the last ones may have become zero
        idle = idle | (((nothing & touches) | (first[0] + first[1] + first[2] < frame.digits.tiny)) & ~undecided)
        self._shorten(frame, degree, limits.SWITCH_TOLERANCES * frame.job("rtol"), atol, limits.RESOLVED)
        frame.call(self.roots.first_root, degree)
        self._look_closer(frame, degree)
        # At rest but for what it gains in so little time: u̇ is of the size of ü t.
        gain = 4.0 * (code.intrinsic("fabs", frame["poly", 2]) * frame["root"])
        at_rest = (frame["touch", g] > Touch.NONE) | (code.intrinsic("fabs", frame["poly", 1]) <= gain)
        # A number that is zero leaves zero as its first coefficient says, or stays.
        leaves = undecided & code.compare("!=", leads, 0.0)
        root = code.select(undecided, code.select(leaves, 0.0, 2.0), self._place(frame))
        instant = limits.NO_TIME * frame["smallest"] / code.intrinsic("fabs", h)
        root = code.select(comes & (root < instant) & (instant < 1.0), instant, root)
        is_root = leaves | (~undecided & (frame["is_root"] > 0.0) & (frame["root"] < 1.0))
        # Of two at one instant that of the piece on which the other one depends, which comes first, is crossed.
        apart = code.select(frame["crossed"] > 0.0, 1.0 - limits.AT_ONCE, 1.0) if self.borders.nested else 1.0
        sooner = (root < frame["nearest"] * apart) & code.compare("!=", h, 0.0) & ~idle
        with frame.where(sooner):
            frame["nearest"] = root
            frame["at_rest"] = at_rest
            frame["crossed"] = code.select(is_root, Crossed.GUARD, Crossed.NOTHING)
            frame["crossed_number"] = code.as_double(g)
            frame["beyond"] = code.select(undecided, leads, beyond)

    # ---- tables: borders at their entries ----

    def _knot(self, frame: Frame, j: int, index: Value) -> tuple[Value, Value]:
        """An entry of the table of piece j, and whether there is one of this number."""
        located = self.borders.tables[j]
        assert located is not None
        inside = (index >= 0.0) & (index <= float(located.table.count - 1))
        return self.motion.look_up.take(frame, located.table, index), inside

    def _time_to_next_knot(self, frame: Frame, j: int) -> tuple[Value, Value]:
        """The time to the next entry of the table that the time is on, and the lanes where there is one."""
        code, forward = frame.code, frame["forward"]
        index = self._piece(frame, integer(code, j)) + code.flag(forward > 0.0)
        knot, inside = self._knot(frame, j, index)
        return ((knot - frame["t"]) - frame["t_low"]) * forward, inside

    def _look_at_clock(self, frame: Frame, c: int, j: int, h: Value) -> None:
        """The step ends at the next entry of a table that the time is on, which is known."""
        code = frame.code
        left, inside = self._time_to_next_knot(frame, j)
        left = code.maximum(left, frame.constant(0.0))
        size = code.intrinsic("fabs", h)
        nearest = frame["nearest"] * size
        if self.borders.kicking and j not in self.borders.kicking:  # of several at one instant a kick counts
            nearest = nearest - self._instant(frame)
        sooner = inside & (left < nearest)
        if j in self.borders.kicking:  # also at the end of the motion, where the velocities are those behind it
            located = self.borders.tables[j]
            assert located is not None
            is_inner = self._piece(frame, integer(code, j)) < float(located.table.count - 1 - located.closed)
            at_end = (frame["forward"] > 0.0) & is_inner & code.compare("==", left, nearest) & (size > 0.0)
            sooner = sooner | (inside & at_end & code.compare("==", frame["crossed"], 0.0))
        with frame.where(sooner):
            frame["nearest"] = left / size
            frame["crossed"], frame["crossed_number"] = Crossed.KNOT, float(c)

    def _note_coincidence(self, frame: Frame, h: Value) -> None:
        """Entries of several tables at one instant, one of which may be moved."""
        code, size = frame.code, frame.code.intrinsic("fabs", h)
        count, moves = frame.constant(0.0), frame.constant(0.0)
        for j in self.borders.clocks:
            left, inside = self._time_to_next_knot(frame, j)
            distance = code.intrinsic("fabs", left - frame["nearest"] * size)
            at_once = inside & (frame["crossed"] > 0.0) & (distance <= self._instant(frame))
            count = count + code.flag(at_once)
            if j in self.table.movable:
                moves = moves + code.flag(at_once)
        with frame.where((count > 1.0) & (moves > 0.0)):
            frame["crossed"] = Crossed.KNOTS

    def _instant(self, frame: Frame) -> Value:
        """The largest difference of two times that count as the same."""
        return frame.code.maximum(frame.code.intrinsic("fabs", frame["t"]), frame["smallest"]) * (4.0 * limits.EPS)

    def _note_levels(self, frame: Frame) -> None:
        """The levels of guards that change: entries on both sides of the pieces of tables, and the speeds of cones."""
        code = frame.code
        for g, guard in enumerate(self.guards):
            if self.borders.kinds[guard.piece] == _borders.CONE:
                rate = self.motion.followed_coefficient(frame, integer(code, guard.piece), integer(code, 1))
                fall = (0.0 - rate) * frame["forward"]
                last = fall * (limits.LAST_STEPS * frame["smallest"])  # what is gone in the shortest steps
                unit = code.lanes_of(absolute_tolerance(frame))
                far = self.motion.followed_value(frame, integer(code, guard.piece)) > limits.AT_REST * unit
                least = unit * code.select(far, limits.AT_REST, limits.SETS_OUT)
                frame["level", g] = code.select(last > least, last, least)
            if self.borders.kinds[guard.piece] == _borders.TABLE:
                index = self._piece(frame, integer(code, guard.piece)) + guard.level.offset
                knot, inside = self._knot(frame, guard.piece, index)
                frame["level", g] = code.select(inside, knot, NOWHERE if guard.level.offset else -NOWHERE)

    @property
    def slides(self) -> bool:
        """True if the motion may slide along a border that other switching numbers depend on."""
        return _borders.SLIDE in self.borders.kinds

    def _go_on(self, frame: Frame, going: Value) -> None:
        """Past borders, and entries of tables.

        A motion that slides along another border, or touches it, does so no more where that jumps.
        """
        shaken, code = self.borders.shaken, frame.code
        line = eliminate_dead_code(self.borders.program.line, [self.borders.switches[j] for j in shaken])
        before = self.motion.evaluate_now(frame, line) if shaken else []
        before = [code.variable(before[k]) for k in range(len(shaken))]
        self._go_beyond(frame)
        if self.borders.clocks:
            self._pass_knots(frame, going)
        self._decide_others(frame, going)
        after = self.motion.evaluate_now(frame, line) if shaken else []
        for k, j in enumerate(shaken):
            jump = code.intrinsic("fabs", after[k] - before[k].value)
            least = code.intrinsic("fabs", after[k]) * frame.digits.round_off + code.lanes_of(absolute_tolerance(frame))
            jumps = going & (jump > least)
            with frame.where(jumps):
                for g, guard in enumerate(self.guards):
                    if guard.piece == j:
                        frame["touch", g] = Touch.NONE
                        if guard.slide >= 0:
                            frame["params", self.motion.parameters + guard.slide] = 0.0
        if shaken:
            self._decide_others(frame, going)

    def _decide_others(self, frame: Frame, going: Value) -> None:
        """Decide the pieces anew that touch no border, where one is crossed on which others depend."""
        code = frame.code
        if not self.borders.nested:
            return
        with code.loop(self.pieces) as j:
            frame["stays", j] = 0.0
        for j in self.borders.clocks:
            frame["stays", j] = 1.0
        with code.loop(len(self.guards)) as g:
            with frame.where(frame["touch", g] > Touch.NONE):
                frame["stays", self.table.place(code, g, "piece")] = 1
        with frame.where(going):
            frame["undecided"] = 1
        frame.call(self.decide)

    def _pass_knots(self, frame: Frame, going: Value) -> None:
        """The pieces of tables whose next entry the time has come to: all that are there at one instant."""
        for j in self.borders.clocks:
            left, inside = self._time_to_next_knot(frame, j)
            passes = going & inside & (left <= self._instant(frame))
            with frame.where(passes):
                place = self.motion.parameters + j
                frame["params", place] = frame["params", place] + frame["forward"]

    def _look_ahead(self, frame: Frame, i: Value, feature: Feature, degree: Value, h: Value) -> None:
        """The step ends where the argument of feature number i has come as near as one step may bring it."""
        code, j = frame.code, i + self.pieces
        moves, last = self._moves(frame, j, degree, h)
        rise = code.lanes_of(code.as_double(degree)) * (limits.RISE / feature.scale)
        near = ~((moves < rise) & (last < limits.ARGUMENT))
        if feature.kind == FALLS:
            size = code.intrinsic("fabs", self.motion.followed_value(frame, j))
            # The base of the power may fall by this in a step of the least order.
            fall = max(math.exp(-limits.RISE * (limits.LEAST_ORDER - 1) / feature.scale), limits.LARGEST_FALL)
            near = ~(moves < (1.0 - fall) * size)
        if feature.kind in (SQUARED, UP_TO, GROWS):  # which change by more than their argument does
            near = frame.constant(0.0) <= 0.0
        with code.only_if(code.any_lane(near)):
            self._find_feature(frame, j, feature, degree, h)

    def _moves(self, frame: Frame, j: Value, degree: Value, h: Value) -> tuple[Value, Value]:
        """The largest change of a number along the step, Σ |cₖ| for k > 0, and the last of these terms."""
        code, size, sum = frame.code, frame.code.intrinsic("fabs", h), frame.constant(0.0)

        def coefficient(k: Value) -> Value:
            return code.intrinsic("fabs", self.motion.followed_coefficient(frame, j, k))

        for i in range(3):
            sum = (sum + coefficient(degree - i)) * size
        sum, last = code.variable(sum), code.variable(sum)
        with code.loop(degree, start=3) as i:
            sum.value = (sum.value + coefficient(degree - i)) * size
            last.value = last.value * size
        return sum.value, last.value

    def _find_feature(self, frame: Frame, j: Value, feature: Feature, degree: Value, h: Value) -> None:
        """With its argument u: where α + β u is zero, the step ends."""
        code, scale = frame.code, feature.scale
        u = self.motion.followed_value(frame, j)
        rise = code.lanes_of(code.as_double(degree)) * limits.RISE
        side = code.select(u < 0.0, -1.0, 1.0)
        of_size, absolute = frame.constant(0.0), frame.constant(limits.ARGUMENT)
        if feature.kind == UP_TO:
            matters, slope, start = code.compare("!=", u, 0.0), side, side * u
            of_size, absolute = frame.constant(limits.ABRUPT), frame.constant(0.0)
        elif feature.kind == FALLS:
            fall = code.maximum(code.library("exp", rise * (-1.0 / scale)), frame.constant(limits.LARGEST_FALL))
            matters, slope, start = code.compare("!=", u, 0.0), side, side * (u - fall * u)
            absolute = limits.ARGUMENT * (fall * (side * u))
        elif feature.kind == GROWS:
            level = code.maximum(
                code.library("exp", rise * (1.0 / scale)) * u, frame.constant(math.exp(-limits.FAINT / scale))
            )
            matters, slope, start = level > 0.0, frame.constant(-1.0), level - u
            absolute = limits.ARGUMENT * level
        elif feature.kind == SQUARED:
            near = code.maximum(u * u - rise, 0.0)
            level = code.intrinsic("sqrt", code.select(near > limits.FAINT, limits.FAINT, near))
            matters, slope, start = near > 0.0, side, side * u - level
        else:
            slope = frame.constant(-scale) if feature.kind == BELOW else scale * side
            level = code.maximum(rise - slope * u, -limits.FAINT)
            matters = level < (float("inf") if feature.kind == BELOW else 0.0)
            start = level + slope * u
            if feature.kind == BELOW:  # from above it comes to where there is a series again, and then is told in parts
                above, falls = u * scale - limits.BEYOND, self.motion.followed_coefficient(frame, j, 1) * h < 0.0
                high = (above > 0.0) | ((u * scale > limits.STEEP) & falls)
                slope = code.select(high, scale, slope)
                start = code.select(high, code.maximum(above, rise), start)
        if feature.kind <= SQUARED:
            far = start > limits.FAR
            start = code.select(far, (1.0 - limits.LARGEST_FALL) * start, start)
            of_size = code.select(far, limits.ARGUMENT * limits.LARGEST_FALL, of_size)
        self.roots.polynomial(frame, j, degree, h, slope, u - start / slope)
        if feature.kind == FALLS:  # one that rises is told by fewer terms
            self.roots.sum_up(frame, degree)
            rises = frame["falls"] < start
            size = start + frame["rises"]
            matters = matters & ~(rises & (self.roots.last_terms(frame, degree) < limits.ARGUMENT * size))
        self._shorten(frame, degree, of_size, absolute)
        frame.call(self.roots.first_root, degree)
        root = self._place(frame)
        if feature.kind in (UP_TO, FALLS):
            nearby = limits.NEARBY if feature.kind == UP_TO else limits.NARROWEST
            way, whole = frame["root"] * frame["part"], code.intrinsic("fabs", h)
            whole = code.maximum(whole, frame["approach"])
            far = way * code.intrinsic("fabs", h) > nearby * whole
            found = (frame["root"] < 1.0) & (frame["is_root"] > 0.0)
            comes = matters & far & found
            with frame.where(comes):
                frame["next_approach"] = whole
            if feature.kind == UP_TO:
                past = code.select(far, way * limits.SHORT_OF, way * limits.PAST + limits.NEARBY)
                root = code.select(found, past, root)
            else:
                matters = matters & (far | ~found)
        sooner = matters & (root > 0.0) & (root < frame["nearest"]) & code.compare("!=", h, 0.0)
        with frame.where(sooner):
            frame["nearest"] = root
            frame["crossed"] = Crossed.NOTHING

    def _shorten(self, frame: Frame, degree: Value, rtol: Value, atol: Value, share: float = math.inf) -> None:
        """Halve the interval until the last terms are below atol, or a `share` of Σ |cₖ|, + rtol Σ |cₖ|."""

        def is_long():
            size, least = self.roots.size(frame, degree), frame.code.lanes_of(atol)
            if share < math.inf:
                least = frame.code.select(share * size < least, share * size, least)
            return self.roots.last_terms(frame, degree) > size * rtol + least

        self.roots.shorten(frame, degree, is_long)

    def _look_closer(self, frame: Frame, degree: Value) -> None:
        """A root that comes early is as exact as what lies before it allows, and not the whole step."""
        code = frame.code

        def early():
            is_root = (frame["is_root"] > 0.0) & (frame["poly", 0] > 0.0)
            return is_root & (frame["root"] < limits.EARLY)

        with code.repeat_while(lambda: code.any_lane(early()), at_most=limits.MOST_LOOKS):
            straight = 0.0 - 4.0 * frame["poly", 0] / frame["poly", 1]  # for a root that is zero to rounding
            reach = code.select(frame["root"] > 0.0, 2.0 * frame["root"], straight)
            self.roots.stretch(frame, degree, code.select(early() & (reach > 0.0) & (reach < 1.0), reach, 1.0))
            frame.call(self.roots.first_root, degree)

    def _place(self, frame: Frame) -> Value:
        """The first root in parts of the step; or how far was looked, or 2 where there is none in all of it."""
        code, root, part = frame.code, frame["root"], frame["part"]
        return code.select(root < 1.0, root * part, code.select(part < 1.0, part, 2.0))

    def _divide(self, frame: Frame, g: Value, degree: Value) -> None:
        """Divide the polynomial of guard g, where it begins at zero, by as many powers as vanish."""
        code = frame.code
        touch = frame["touch", g]
        divided = touch > Touch.NONE
        for power in range(3):
            with code.only_if(code.any_lane(divided)), code.loop(degree + 1) as k:
                with frame.where(divided):
                    frame["poly", k] = frame["poly", k + 1]
            vanishes = code.compare("==", frame["poly", 0], 0.0)
            divided = divided & (vanishes | (touch > float(power + Touch.VALUE)))

    # ---- beyond it ----

    def settle(self, frame: Frame) -> None:
        """A step that has become shorter than planned does not reach its border."""
        code = frame.code
        reached = code.compare("==", frame["h"], frame["cut"])
        frame["crossed"] = code.select(reached, frame["crossed"], Crossed.NOTHING)
        frame["stepped"] = stepped = code.compare("!=", frame["h"], 0.0)
        if self.borders.kicking:  # steps that are recorded: those of no length, too, where a kick begins or ends them
            stepped = stepped | (self.table.kicks(frame) & ~self._begins_behind(frame))
            frame["counts"] = stepped | (frame["last"] > 0.0)
        at_knot = (frame["stepped"] > 0.0) & (frame["crossed"] > Crossed.GUARD)
        frame["at_knots"] = frame["at_knots"] + code.flag(at_knot)
        for name in ("is_hit", "grazes", "stops"):
            with frame.where(stepped):
                frame[name] = 0.0
        frame.call(self.graze)

    def _graze(self, base: int) -> Code:
        """`()`: set `grazes` where the step ends at a border that it only grazes, and `stops` where to rounding.

        With the rate u̇ of its switching number a motion that is moved by the tolerance, u by ε, does not cross it, or
        has before, where u̇² ≤ 2 |ü| ε.
        """
        frame, motion, n = self.motion.function("graze"), self.motion, self.motion.n
        code, order, by = frame.code, frame.job("order"), [*range(base), *range(n, n + base)]
        line = _borders.gradient(self.borders, by)
        ends = self.table.crosses(frame, Crossed.GUARD) & (frame["counts" if self.borders.kicking else "stepped"] > 0.0)
        with code.only_if(code.any_lane(ends)):
            self.table.note_hit(frame, ends)
            state = motion.move_state(frame, motion.increments(frame, order, frame["h"])[0])
            inputs = state, [frame["t"] + frame["h"]], frame.vectors("params", motion.numbers)
            slopes = motion.form.run(frame, line, *inputs, frame.vectors("hit", self.pieces))
            rtol, atol = frame.job("rtol"), absolute_tolerance(frame)
            error, rounding = (code.variable(frame.constant(0.0)) for _ in range(2))
            for part in range(2):
                for i in motion.form.each(code, base):
                    slope = code.intrinsic("fabs", slopes[i + part * base])
                    size = slope * code.intrinsic("fabs", state[i + part * n])
                    rounding.value += size * limits.EPS
                    error.value += rtol * size + slope * code.lanes_of(atol)
            rate, bend = self._rates(frame, order)
            is_hit = ends & (frame["is_hit"] > 0.0)
            for name, by in (("grazes", error.value), ("stops", rounding.value)):
                near = is_hit & (rate * rate <= 2.0 * (code.intrinsic("fabs", bend) * by))
                with frame.where(near):
                    frame[name] = 1
        return frame.finish()

    def _rates(self, frame: Frame, order: Value) -> tuple[Value, Value]:
        """u̇ and ü at the end of the step, of the switching number that is `hit`."""
        code, h = frame.code, frame["h"]
        degree = code.select(order < limits.MAX_ORDER, order, limits.MAX_ORDER - 1)
        first = self.motion.series.rows - self.motion.series.followed
        rate, bend = (code.variable(frame.constant(0.0)) for _ in range(2))
        with code.loop(degree, start=0) as i:
            k = code.lanes_of(code.as_double(degree - i))
            c = code.variable(frame.constant(0.0))
            with code.loop(self.pieces) as j:
                c.value = c.value + frame["hit", j] * frame["rows", j + first, degree - i]
            term = c.value * k
            bend.value = bend.value * h + rate.value
            rate.value = rate.value * h + term
        return rate.value, bend.value

    def _cross(self) -> Code:
        """`()`: after the step, the pieces beyond the borders that were reached."""
        frame = self.motion.function("cross")
        code = frame.code
        stepped, crosses = frame["stepped"] > 0.0, frame["crossed"] > Crossed.NOTHING
        was_cut = code.compare("!=", frame["cut"], frame["planned_h"])
        if self.retraction is not None:  # borders that are left before the step begins do not take the state
            self.retraction.undo(frame, ~stepped)
        with code.loop(len(self.guards)) as g:
            ends = stepped & (frame["touch", g] < Touch.SLIDING)
            with frame.where(ends):
                frame["touch", g] = Touch.NONE
        with code.only_if(code.any_lane(crosses | was_cut)):
            # What a cut step was to be says more about the next one than what it became.
            planned = code.intrinsic("fabs", frame["planned_h"])
            reached = was_cut & code.compare("==", frame["h"], frame["cut"])
            with frame.where(reached):
                frame["longest"] = limits.GROWTH * planned
                frame["h"] = frame["planned_h"]
            if self.note is not None:
                frame.call(self.note)
            if self.borders.release.outputs:
                self._release(frame)
            if self.kick is not None:
                self._note_kick(frame)
            self._go_on(frame, crosses)
            with frame.where(crosses):
                if self.returns:
                    frame["h_before"] = 0.0
            if self.kick is not None:
                self._kick_or_reflect(frame, self.kick, crosses)
            if self.jump is not None:
                frame.call(self.jump)
            # A border at which a step of no length ends, too, whether it is crossed or only met.
            idle = code.select(stepped, 0.0, frame["idle_crossings"] + 1.0)
            with frame.where(stepped | crosses | was_cut):
                frame["idle_crossings"] = idle
            most = float(limits.MOST_CROSSINGS * (len(self.guards) + len(self.borders.clocks)))
            with frame.where(frame["idle_crossings"] > most):
                frame["code"] = limits.DISCONTINUOUS
        return frame.finish()

    def _go_beyond(self, frame: Frame) -> None:
        """The pieces beyond the borders, which touch them; a piece that touches one is not decided anew.

        A motion that would go back over the border at once is pushed onto it from both sides: it slides. So does one
        that has come back in no measurable time, or not to rounding: it bounces off the border, less and less, and
        comes to rest.
        """
        code, again = frame.code, frame["stepped"] <= 0.0
        no_time = ~again & (code.intrinsic("fabs", frame["cut"]) <= limits.NO_TIME * frame["smallest"])
        no_time = (no_time | (~again & (frame["stops"] > 0.0))) & (frame["at_rest"] > 0.0)
        with code.loop(len(self.guards)) as g:
            hit = self.table.crosses(frame, Crossed.GUARD, g)
            j, back, slide = (self.table.place(code, g, name) for name in ("piece", "back", "slide"))
            place = j + self.motion.parameters
            by_position = code.lanes_of(code.flag(self.table.place(code, g, "order") > 1)) > 0.0
            bounces = no_time & by_position
            slides = hit & (bounces | (again & (frame["touch", g] > Touch.NONE)))
            if self.borders.releases:
                slides = slides | (hit & self._is_cone(frame, g))
            slides = slides & (code.lanes_of(code.as_double(slide)) >= 0.0)
            with frame.where(hit & ~slides):
                frame["params", place] = frame["beyond"]
            # A share jumps to where it is: it need not touch the border that it had crossed before.
            is_share = code.lanes_of(code.flag(self.table.place(code, g, "on") >= 0)) > 0.0
            with frame.where(hit):
                frame["touch", back] = code.select(is_share, Touch.NONE, Touch.VALUE)
            with code.only_if(slide >= 0):
                below = code.select(self._piece(frame, j) < frame["beyond"], self._piece(frame, j), frame["beyond"])
                is_sign = code.lanes_of(self.table.rule(code, g, "beyond").slope) <= 0.0
                with frame.where(slides):
                    frame["params", place] = code.select(is_sign, -1.0, below)
                    frame["params", slide + self.motion.parameters] = 1
                    frame["touch", g] = frame["touch", back] = Touch.NONE
                    frame["touch", self.table.place(code, g, "rest")] = Touch.SLIDING
            self._leave(frame, g, hit, again)

    # ---- where L jumps ----

    def _note_kick(self, frame: Frame) -> None:
        """Note the pieces before the border, and which switching number is zero there."""
        code = frame.code
        with code.loop(self.pieces) as j:
            frame["kick_before", j] = self._piece(frame, j)
            frame["kick_hit", j] = 0.0
        with code.loop(len(self.guards)) as g:
            with frame.where(self.table.crosses(frame, Crossed.GUARD, g)):
                frame["kick_hit", self.table.place(code, g, "piece")] = 1.0

    def _begins_behind(self, frame: Frame) -> Value:
        """True where a motion begins at an instant at which L jumps: with the velocities behind it, in time's order."""
        code = frame.code
        begins = (frame["steps"] <= 0.0) & (frame["forward"] > 0.0)
        found = frame.constant(0.0) > 0.0
        for g, guard in enumerate(self.guards):
            if guard.piece in self.kicks_in_time and self.borders.kinds[guard.piece] == _borders.SIGN:
                found = found | self.table.crosses(frame, Crossed.GUARD, g)
        return begins & found & code.compare("==", frame["h"], 0.0)

    def _look_at_end(self, frame: Frame, degree: Value, h: Value) -> None:
        """The step ends at an instant at which L jumps also where that is the end of the motion, to rounding.

        The velocities are those behind it there, in the order of time.
        """
        code, one = frame.code, frame.constant(1.0)
        for g, guard in enumerate(self.guards):
            if guard.piece not in self.kicks_in_time:
                continue
            piece = self._piece(frame, integer(code, guard.piece))
            side, level = guard.side(piece), guard.level(piece, lambda where, x: code.select(where, x, 0.0))
            level = frame["level", g] if guard.of_table else level
            self.roots.polynomial(frame, integer(code, guard.piece), degree, h, side, level)
            end, slope = code.variable(frame.constant(0.0)), code.variable(frame.constant(0.0))
            with code.loop(degree + 1) as k:
                c = frame["poly", k]
                end.value = end.value + c
                slope.value = slope.value + c * code.lanes_of(code.as_double(k))
            noise = _AT_END * limits.EPS * code.intrinsic("fabs", frame["t_end"] / h * slope.value)
            there = (
                (frame["last"] > 0.0) & (frame["forward"] > 0.0) & code.compare("!=", side, 0.0) & (end.value <= noise)
            )
            with frame.where(there & code.compare("==", frame["nearest"], one) & code.compare("!=", h, 0.0)):
                frame["crossed"], frame["crossed_number"] = Crossed.GUARD, float(g)
                frame["beyond"] = guard.beyond(piece)

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
                frame.vectors("kick_hit", self.pieces),
            ]  # fmt: skip
            if self.borders.levels_move:  # which do not matter to slopes
                inputs.append(frame.vectors("kick_hit", self.pieces))
            out = motion.form.run(frame, kick.line, *inputs)
            passes = out[base] > 0.0
            for i in motion.form.each(code, base):
                with frame.where(kicks & passes):
                    frame["y", i + n, 0] = out[i]
                    frame["low", i + n] = 0.0
            with frame.where(kicks & ~passes):
                frame["kicks"] = 2.0
        return frame.finish()

    def _kick_or_reflect(self, frame: Frame, kick: Code, crosses: Value) -> None:
        """Give the motion the velocities that it has where L jumps: behind the border, or before it once more."""
        code, kicks = frame.code, frame.constant(0.0)
        for j in self.borders.kicking:
            piece = self._piece(frame, integer(code, j))
            if j in self.kicks_in_time and self.borders.kinds[j] == _borders.SIGN:
                begins = code.compare("==", frame["kick_before", j], 0.0) & (frame["steps"] <= 1.0)
                with frame.where(crosses & begins & (frame["forward"] < 0.0)):  # back from behind it
                    frame["kick_before", j] = 0.0 - piece
            jumps = crosses & (frame["counts"] > 0.0) & code.compare("!=", piece, frame["kick_before", j])
            kicks = code.select(jumps, 1.0, kicks)
        frame["kicks"] = kicks
        frame.call(kick)
        reflected = frame["kicks"] > 1.0
        with code.only_if(code.any_lane(reflected)):
            with code.loop(self.pieces) as j:
                with frame.where(reflected):
                    frame["params", j + self.motion.parameters] = frame["kick_before", j]
            with code.loop(len(self.guards)) as g:
                at_border = self.table.crosses(frame, Crossed.GUARD, g)
                with frame.where(reflected):
                    frame["touch", g] = code.select(at_border, Touch.VALUE, Touch.NONE)
            frame["kicks"] = code.select(reflected, 1.0, 0.0)
            frame.call(kick)
        self._decide_by_velocity(frame, kicks > 0.0)

    def _decide_by_velocity(self, frame: Frame, kicked: Value) -> None:
        """Decide the pieces anew whose switching numbers depend on velocities, which have been kicked."""
        velocities = range(self.motion.n, self.motion.states)
        by_velocity = [
            j
            for j, node in enumerate(self.borders.switches)
            if self.borders.kinds[j] != _borders.SLIDE and not self.borders.read_by(node).isdisjoint(velocities)
        ]
        if not by_velocity:
            return
        for j in range(self.pieces):
            with frame.where(kicked):
                frame["stays", j] = 0.0 if j in by_velocity else 1.0
        for g, guard in enumerate(self.guards):
            if guard.piece in by_velocity:
                with frame.where(kicked):
                    frame["touch", g] = Touch.NONE
                    if guard.slide >= 0:
                        frame["params", self.motion.parameters + guard.slide] = 0.0
        with frame.where(kicked):
            frame["undecided"] = 1.0
        frame.call(self.decide)

    def _leave(self, frame: Frame, g: Value, hit: Value, again: Value) -> None:
        """Let a sliding motion go on along one side, where its share of that side comes to 0 or 1.

        The rate of u that was kept at zero is zero there after a slide, and not where it did not slide at all.
        """
        code = frame.code
        on = self.table.place(code, g, "on")
        with code.only_if(on >= 0):
            place = self.table.place(code, on, "piece") + self.motion.parameters
            order = code.lanes_of(code.as_double(self.table.place(code, on, "order")))
            with frame.where(hit):
                frame["params", place] = frame["params", place] + code.as_double(self.table.place(code, g, "gains"))
                frame["touch", self.table.place(code, g, "rest")] = Touch.NONE
                frame["touch", on] = code.select(again, order, order + Touch.VALUE)
            if self.borders.releases:  # the vector of a cone has been given a length beyond its level
                of_cone = hit & self._is_cone(frame, on)
                with frame.where(of_cone):
                    frame["touch", on] = Touch.NONE

    def _is_cone(self, frame: Frame, g: Value) -> Value:
        """True in all lanes if guard g is that of a cone, or a share."""
        code = frame.code
        return code.lanes_of(code.flag(code.compare("==", self.table.rule(code, g, "beyond").slope, 0.0))) > 0.0

    def _release(self, frame: Frame) -> None:
        """Let the vectors of cones that hold no longer set out, with a speed that is twice what counts as none."""
        code, motion, n = frame.code, self.motion, len(self.borders.release.outputs)
        shares = self.borders.releases
        base, leaves = n // (2 * len(shares)), frame.constant(0.0) > 0.0
        for g in shares:
            leaves = leaves | self.table.crosses(frame, Crossed.GUARD, g)
        with code.only_if(code.any_lane(leaves)):
            out = motion.evaluate_now(frame, self.borders.release)
            speed = 2.0 * limits.SETS_OUT * absolute_tolerance(frame)
            for k, g in enumerate(shares):
                hit = self.table.crosses(frame, Crossed.GUARD, g)
                for i in range(base):
                    places = 2 * k * base + i, (2 * k + 1) * base + i
                    if all(self.borders.release.constant(place) == 0.0 for place in places):
                        continue
                    change = code.lanes_of(speed) * out[places[0]] - out[places[1]]
                    with frame.where(hit):
                        frame["y", i + motion.n, 0] = frame["y", i + motion.n, 0] + change
                        frame["low", i + motion.n] = 0.0
