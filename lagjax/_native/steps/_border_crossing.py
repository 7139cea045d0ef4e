"""The crossing of borders after a step that ends at one: the motion enters the next piece, slides, or is released."""

import functools
from collections.abc import Container

from lagjax._native.code import _constants as limits
from lagjax._native.code._frame import Frame
from lagjax._native.code._ir import Code, Value
from lagjax._native.series._taylor import TaylorSeries
from lagjax._native.steps._border_kicks import Kicks
from lagjax._native.steps._knots import Knots
from lagjax._native.steps._retraction import Retraction
from lagjax._native.steps._saltation import Saltation
from lagjax._native.steps._step import absolute_tolerance
from lagjax._native.steps._watch import Border, Contact, StepEnd, reaches_border, step_to_border
from lagjax._program import SLIDE, Borders, Jump, Nesting, eliminate_dead_code

_NOT_HOLDING = 1e6  # a share of a border that both sides do not push onto: those of others are near 0 … 1


class BorderCrossing:
    """The kernel functions `cross`, and `decide`, which computes the pieces of undecided lanes.

    With tangents (`nesting`) a `jump` changes them. The fields `forgotten` are reset in lanes that cross.
    """

    def __init__(
        self, motion: TaylorSeries, borders: Borders, knots: Knots, nesting: Nesting, jump: Jump | None, forgotten: dict
    ):
        self.motion, self.borders, self.table, self.knots, self.forgotten = (
            motion,
            borders,
            knots.table,
            knots,
            forgotten,
        )
        self.decide = self._decide_pieces()
        self.retraction = borders.holding.retraction and Retraction(motion, borders, nesting)
        self.retract = self.retraction and self.retraction.apply(is_run=True)
        self.jump: tuple[Code, Code] | None = None  # what notes it, and what applies it
        if jump is not None:
            saltation = Saltation(motion, self.table, nesting.base, jump)
            motion.layout.extend_by(saltation.fields_along())
            self.jump = saltation.store_state(), saltation.apply()
        self.kicks = Kicks(motion, borders, self.table, nesting.base) if borders.kicking else None
        self.cross = self._cross_borders()

    def _decide_pieces(self) -> Code:
        """Emit `()`: compute the pieces of the lanes that are `undecided`."""
        frame = self.motion.function("decide")
        code, undecided = frame.code, frame["undecided"] > 0.0
        with code.only_if(code.any_lane(undecided)):
            inputs = [*self.motion.state_inputs(frame), frame.vectors("stays", self.motion.pieces)]
            pieces = self.motion.form.run(frame, self.borders.decide, *inputs)
            for j in self.motion.form.each(code, self.motion.pieces):
                frame.assign(undecided, j + self.motion.parameters, params=pieces[j])
                frame.assign(undecided, j, stays=0.0)
            for border in self.table.each(frame):
                slide = border["slide"]
                with code.only_if((slide >= 0) & code.compare("==", border.g, border["rest"])):
                    border.remember(undecided & (self.table.piece(frame, slide) > 0.0), touch=Contact.SLIDING)
            frame["undecided"] = 0.0
        return frame.finish()

    def _redecide_piece(self, frame: Frame, where: Value) -> None:
        frame.assign(where, undecided=1)
        frame.call(self.decide)

    def _cross_borders(self) -> Code:
        """Emit `()`: after the step, set the pieces beyond the borders that it reached."""
        frame = self.motion.function("cross")
        code = frame.code
        stepped, crosses, was_cut = (frame["stepped"] > 0.0, frame["crossed"] > StepEnd.NOTHING, frame["nearest"] < 1.0)
        if self.retraction is not None:  # borders that are left before the step begins do not take the state
            has_begun = stepped | (frame["returned"] > 0.0) if self.forgotten else stepped
            self.retraction.undo(frame, ~has_begun)
        for border in self.table.each(frame):
            border.remember(stepped & (border.touch < Contact.SLIDING), touch=Contact.NONE)
        with code.only_if(code.any_lane(crosses | was_cut)):
            # What a cut step was to be says more about the next one than what it became.
            longest = limits.GROWTH * abs(frame["planned"])
            frame.assign(was_cut & reaches_border(frame), longest=longest, h=frame["planned"])
            if self.jump is not None:
                frame.call(self.jump[0])
            if self.borders.holding.release.outputs:
                self._release_cones(frame)
            if self.kicks is not None:
                self.kicks.record_pieces(frame)
            self._pass_borders(frame, crosses)
            if self.table.groups:
                counts = stepped & self.table.crosses(frame, StepEnd.GUARD)
                frame["steps"] = frame["steps"] + code.select(counts, frame["more"], 0.0)
            frame.assign(crosses, **self.forgotten)
            if self.kicks is not None:
                self._redecide_kicked(frame, self.kicks.apply(frame, crosses))
            if self.jump is not None:
                frame.call(self.jump[1])
            # A border at which a step of no length ends, too, whether it is crossed or only met.
            idle = code.select(stepped, 0.0, frame["idle_crossings"] + 1.0)
            frame.assign(stepped | crosses | was_cut, idle_crossings=idle)
            most = float(limits.MOST_CROSSINGS * (len(self.borders.guards) + len(self.borders.clocks)))
            frame.assign(frame["idle_crossings"] > most, code=limits.DISCONTINUOUS)
        return frame.finish()

    def _pass_borders(self, frame: Frame, going: Value) -> None:
        """Cross borders and knots; a switching number that jumps there ends sliding and contact on its borders."""
        shaken, code = self.borders.dependent_pieces, frame.code
        line = eliminate_dead_code(self.borders.program.line, [self.borders.decisions[j].switch for j in shaken])
        before = self.motion.evaluate_now(frame, line) if shaken else []
        before = [code.variable(before[k]) for k in range(len(shaken))]
        for border in self.table.each(frame):
            self._enter_beyond(frame, border)
        self.knots.enter_next_pieces(frame, going)
        self._redecide_dependents(frame, going)
        after = self.motion.evaluate_now(frame, line) if shaken else []
        for k, j in enumerate(shaken):
            jump = abs(after[k] - before[k].value)
            least = abs(after[k]) * limits.ROUND_OFF + code.lanes_of(absolute_tolerance(frame))
            self._stop_sliding(frame, going & (jump > least), [j])
        if shaken:
            self._redecide_dependents(frame, going)

    def _stop_sliding(self, frame: Frame, where: Value, pieces: Container[int]) -> None:
        """Record that the motion neither touches the borders of some pieces nor slides along them."""
        for g, guard in enumerate(self.borders.guards):
            if guard.piece in pieces:
                frame.assign(where, g, touch=Contact.NONE)
                if guard.slide >= 0:
                    frame.assign(where, self.motion.parameters + guard.slide, params=0.0)

    def _redecide_dependents(self, frame: Frame, going: Value) -> None:
        """After a crossing, decide again the pieces that depend on others, unless they touch a border or left one."""
        if not self.borders.nested:
            return
        with frame.code.loop(self.motion.pieces) as j:
            frame["stays", j] = 0.0
        for j in self.borders.clocks:
            frame["stays", j] = 1.0
        for border in self.table.each(frame):
            frame.assign(frame.code.compare("!=", border.touch, float(Contact.NONE)), border["piece"], stays=1)
        self._redecide_piece(frame, going)

    def _enter_beyond(self, frame: Frame, border: Border) -> None:
        """Enter the piece beyond a border, which it touches; a piece that touches one is not decided again.

        If the motion would return across the border at once, both sides push onto it, and it slides. So it does if it
        has returned in no measurable time or by rounding: it bounces off the border in ever shorter time, and comes to
        rest.
        """
        code, hit, again, beyond = frame.code, border.is_hit, frame["stepped"] <= 0.0, frame["beyond"]
        if self.table.groups:
            is_first = self.table.crosses(frame, StepEnd.GUARD, border.g)
            beyond = code.select(is_first, beyond, border.rule("beyond")(border.piece))
        no_time = ~again & (abs(step_to_border(frame)) <= limits.NO_TIME * frame["smallest"])
        no_time = (no_time | (~again & (frame["stops"] > 0.0))) & (frame["at_rest"] > 0.0)
        place, back, slide = border["piece"] + self.motion.parameters, border["back"], border["slide"]
        bounces = no_time & border.has("order", 2)  # by position
        slides = bounces | (again & (border.touch > Contact.NONE))
        if self.borders.releases:
            slides = slides | border.is_cone
        slides = hit & slides & border.has("slide")
        frame.assign(hit & ~slides, place, params=beyond)
        # A share jumps to where it is: it need not touch the border that it had crossed before.
        frame.assign(hit, back, touch=code.select(border.has("on"), Contact.NONE, Contact.VALUE))
        with code.only_if(slide >= 0):
            below = code.select(border.piece < beyond, border.piece, beyond)
            frame.assign(slides, place, params=code.select(border.is_sign, -1.0, below))
            frame.assign(slides, slide + self.motion.parameters, params=1)
            for g, touch in ((border.g, Contact.NONE), (back, Contact.NONE), (border["rest"], Contact.SLIDING)):
                frame.assign(slides, g, touch=touch)
        self._leave_sliding(frame, border, hit, again)

    def _leave_sliding(self, frame: Frame, border: Border, hit: Value, again: Value) -> None:
        """End sliding on the side whose share of the acceleration has reached 1.

        The rate of u that was zero while sliding is zero there, unless the motion did not slide at all. If the sides do
        not push onto the border, the piece at the border itself is taken.
        """
        code, on = frame.code, Border(frame, self.table, border["on"])
        with code.only_if(on.g >= 0):
            order = code.lanes_of(code.as_double(on["order"]))
            gains = code.as_double(border["gains"])
            share, below, level = self.motion.followed_value(frame, border["piece"]), on.piece, on.rule("level")
            unheld = hit & (abs(share) > _NOT_HOLDING) & ~on.is_cone
            toward_zero = (code.lanes_of(abs(level.below) + abs(level.above)) > 0.0) & (below < 0.0)
            as_written = code.select(on.is_sign, 0.0, below + code.select(toward_zero, 0.0, 1.0))
            place = on["piece"] + self.motion.parameters
            frame.assign(hit, place, params=code.select(unheld, as_written, below + gains))
            frame.assign(hit, border["rest"], touch=Contact.NONE)
            on.remember(hit, touch=code.select(again, order, order + Contact.VALUE))
            on.remember(unheld, touch=Contact.CONTINUES)
            if self.borders.releases:  # the vector of a cone has been given a length beyond its level
                on.remember(hit & on.is_cone, touch=Contact.NONE)

    def _release_cones(self, frame: Frame) -> None:
        """Give the vectors of released cones a speed in the direction of the force, twice that which counts as rest."""
        code, motion, n = frame.code, self.motion, len(self.borders.holding.release.outputs)
        shares = self.borders.releases
        hits = [self.table.crosses(frame, StepEnd.GUARD, g) for g in shares]
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

    def _redecide_kicked(self, frame: Frame, kicked: Value) -> None:
        """Decide again the pieces whose switching numbers depend on velocities, after a kick."""
        velocities = range(self.motion.n, self.motion.states)
        by_velocity = [
            j
            for j, node in enumerate(self.borders.switches)
            if self.borders.decisions[j].kind != SLIDE and not self.borders.read_by(node).isdisjoint(velocities)
        ]
        if by_velocity:
            for j in range(self.motion.pieces):
                frame.assign(kicked, j, stays=0.0 if j in by_velocity else 1.0)
            self._stop_sliding(frame, kicked, by_velocity)
            self._redecide_piece(frame, kicked)
