"""The retraction: the state is projected onto the borders along which the motion slides (`_program._sliding`).

    apply    the state; its distance from the borders is rounding, and does not accumulate over steps
    push     tangents of the unprojected state; a varied start of a member may also lie off its borders
    pull     cotangents, the transpose of `push`

From a displacement δu off a border, to either side, the motion returns at once: first derivatives from both sides agree
with those of the retraction, and so do second ones along two directions of which one stays on the border. Along two
that leave it they differ, by the path on which the motion returns; and so do first derivatives where the motion starts
at the limit of the holding force. There derivatives are NaN.
"""

import functools
from collections.abc import Callable, Sequence

from lagjax._native.code._constants import JUMP_NOISE
from lagjax._native.code._frame import Frame, Index, Vectors
from lagjax._native.code._ir import Code, Value
from lagjax._native.series._cotangents import Cotangents
from lagjax._native.series._tangent_memory import Directions
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._program import SLIDE, Borders, Nesting, pullback_and_entries, pushforward

Numbers = Callable[[Index], Value]


class Retraction:
    """The projection onto the `borders` of a motion whose coordinates are laid out by a `nesting`."""

    def __init__(self, motion: TaylorSeries, borders: Borders, nesting: Nesting):
        assert borders.holding.retraction is not None
        self.motion, self.line, self.dtypes = motion, borders.holding.retraction, borders.program.dtypes
        self.base, self.rows, self.nesting = nesting.base, nesting.size // nesting.base, nesting
        self.shares = [j for j, decision in enumerate(borders.decisions) if decision.kind == SLIDE]
        groups: dict[int, list[int]] = {}
        for k, group in enumerate(borders.holding.groups):
            groups.setdefault(group, []).append(k)
        self.groups = [(some, frozenset().union(*(borders.holding.moved[k] for k in some))) for some in groups.values()]
        motion.layout.extend_by({
            "unretracted": motion.states,  # the argument of the map
            "begins": 1,  # 1 if the step is the first one of its member; of steps that are taken again
            "at_limit": self.base,  # 1 for a coordinate that a border moves which holds no more than it does; of these
        })  # fmt: skip

    def _is_sliding(self, code: Code, numbers: Numbers) -> Value:
        most, first = code.variable(code.lanes_of(0.0)), self.motion.parameters + self.shares[0]
        for k in self.motion.form.each(code, len(self.shares)):
            most.value = code.maximum(most.value, numbers(k + first))
        return most.value > 0.0

    # ---- the state ----

    def apply(self, is_run: bool) -> Code:
        """Emit `()`: project the state. In a run, carried rounding errors are cleared, and tangents projected too."""
        motion, form = self.motion, self.motion.form
        frame = motion.function("retract")
        code = frame.code
        for i in form.each(code, motion.states):
            frame["unretracted", i] = frame["y", i]
        slides = self._is_sliding(code, lambda i: frame["params", i])
        with code.only_if(code.any_lane(slides)):
            out = motion.evaluate_now(frame, self.line)
            for i in form.each(code, motion.states):
                moves = slides & code.compare("!=", out[i], frame["unretracted", i])
                with frame.where(moves):
                    frame["y", i] = out[i]
                    if is_run:
                        frame["low", i] = 0.0
            if is_run and len(self.nesting.directions) > 1:
                begins = slides & code.compare("==", frame["steps"], 0.0)
                moves_of = self._row_moves(code, form, [(lambda i: frame["unretracted", i], lambda i: frame["y", i])])
                for row, a, b in self.nesting.disjoint_rows:
                    self._set_nan(frame, form, "y", row, begins & moves_of(a)[0] & moves_of(b)[0])
        return frame.finish()

    def undo(self, frame: Frame, where: Value) -> None:
        with frame.where(where):
            for i in self.motion.form.each(frame.code, self.motion.states):
                frame["y", i] = frame["unretracted", i]

    def record_start(self, frame: Frame) -> None:
        """Record whether a step, whose series is known, is the first one of its member.

        Record also which coordinates are moved by a border at the limit of its force: its share of a side is 0 or 1.
        """
        code, motion = frame.code, self.motion
        with code.loop(motion.width) as index:
            lane = frame.lane(index)
            lane["begins"] = code.flag(code.compare("==", lane["step"], 0))
        for i in motion.form.each(code, self.base):
            frame["at_limit", i] = 0.0
        for borders, coordinates in self.groups:
            limit = frame.constant(0.0) > 0.0
            for j in (self.shares[k] for k in borders):
                share = motion.followed_value(frame, integer(code, j))
                near = abs(share * (1.0 - share)) <= JUMP_NOISE
                limit = limit | ((frame["params", j + motion.parameters] > 0.0) & near)
            for i in coordinates:
                frame["at_limit", i] = limit & (frame["begins"] > 0.0)

    # ---- derivatives over steps ----

    def push(self, directions: Directions, frame: Frame) -> None:
        """Compute the tangents of the projected state."""
        states, form, code = directions.states, directions.form, frame.code
        line = pushforward(self.line, self.dtypes, directions.varied, range(states))
        params = directions.numbers_of(frame, "params", self.motion.numbers)
        slides = self._is_sliding(code, lambda i: params[i])
        with code.only_if(code.any_lane(slides)):
            state = directions.numbers_of(frame, "unretracted", states, in_place=True)
            tangents = frame.vectors("dy", states, lambda i: (i, 0))
            out = form.run(frame, line, *directions.inputs(frame, state, directions.number_of(frame, "t"), tangents))
            for i in form.each(code, states):
                frame["end", i] = out[i]
            begins = slides & (directions.number_of(frame, "begins") > 0.0)
            limits = directions.numbers_of(frame, "at_limit", self.base)
            with code.only_if(code.any_lane(begins)):
                retracted = directions.numbers_of(frame, "y", states, lambda i: (i, 0), in_place=True)
                both = (state.read, retracted.read), (tangents.read, lambda i: frame["end", i])
                moves_of, first = self._row_moves(code, form, both), self.rows
                for row in range(self.rows):
                    leaves, moved = moves_of(first + row)
                    self._set_nan(
                        frame, form, "end", row, begins & leaves, lambda i, moved=moved: moved(i) & (limits[i] > 0.0)
                    )
                for row, a, b in self.nesting.with_tangents(1).disjoint_rows:
                    if row >= first:
                        self._set_nan(frame, form, "end", row - first, begins & moves_of(a)[0] & moves_of(b)[0])
            with frame.where(slides):
                for i in form.each(code, states):
                    frame["dy", i, 0] = frame["end", i]

    def pull(self, cotangents: Cotangents) -> Code:
        """Emit `()`: the cotangents of the unprojected state, and of the parameters."""
        motion, form = self.motion, self.motion.form
        line, tables = pullback_and_entries(self.line, self.dtypes, cotangents.varied, range(motion.states))
        motion.layout.extend_by({"lost": motion.states})  # 1 for a number whose derivative does not exist
        frame = motion.function("back_retraction")
        code = frame.code
        slides = self._is_sliding(code, lambda i: frame["params", i])
        begins = slides & (frame["begins"] > 0.0)
        _, t, params = motion.state_inputs(frame)
        state, state_ct, lost = (frame.vectors(x, motion.states) for x in ("unretracted", "state_ct", "lost"))
        with code.only_if(code.any_lane(begins)):
            self._find_lost(frame, begins)
        with code.only_if(code.any_lane(slides)):
            out = form.run(frame, line, state, t, params, state_ct)
            gains = Vectors(len(out), lambda i: code.select(slides, out[i], 0.0))
            with frame.where(slides):
                cotangents.store(frame, gains)
            cotangents.store_entries(frame, tables, gains, len(cotangents.varied))
        with code.only_if(code.any_lane(begins)):
            # The derivative by what the retraction adds to these is not there.
            added = form.run(frame, line, state, t, params, lost)
            gains = form.room(frame, len(added))
            for i in form.each(code, len(added)):
                gains[i] = added[i]
            for i in form.each(code, motion.states):
                gains[i] = gains[i] - lost[i]
            for i in form.each(code, len(added)):
                is_lost = abs(gains[i]) > JUMP_NOISE
                gains[i] = code.select(is_lost, float("nan"), 0.0)
            with frame.where(begins):
                cotangents.store(frame, gains, state_ct)
        return frame.finish()

    def _find_lost(self, frame: Frame, begins: Value) -> None:
        """Set `lost` to 1 for velocities whose cotangent would need a derivative along a direction off a border."""
        code, form = frame.code, self.motion.form
        moves_of = self._row_moves(code, form, [(lambda i: frame["unretracted", i], lambda i: frame["y", i])])

        def is_wanted(row: int, i: Index) -> Value:
            parts = [frame["state_ct", self._state_place(row, i, part)] for part in range(2)]
            return ~(abs(parts[0]) + abs(parts[1]) <= 0.0)

        for i in form.each(code, self.motion.states):
            frame["lost", i] = 0.0
        for row in range(self.rows):
            for i in form.each(code, self.base):
                frame["lost", self._state_place(row, i, 1)] = begins & (frame["at_limit", i] > 0.0) & is_wanted(row, i)
        for row, a, b in self.nesting.with_tangents(1).disjoint_rows:
            if a < self.rows <= b:
                wanted = code.variable(frame.constant(0.0))
                for i in form.each(code, self.base):
                    wanted.value = code.maximum(wanted.value, code.flag(is_wanted(row - self.rows, i)))
                for i in form.each(code, self.base):
                    with frame.where(begins & moves_of(a)[0] & (wanted.value > 0.0)):
                        frame["lost", self._state_place(b - self.rows, i, 1)] = 1

    # ---- where there is no derivative ----

    def _state_place(self, row: int, i: Index, part: int) -> Index:
        """The index in a state of coordinate i of a row, or (part 1) of its velocity."""
        return i + (part * self.motion.n + row * self.base)

    def _row_moves(self, code: Code, form, states: Sequence[tuple[Numbers, Numbers]]) -> Callable:
        """A function of a row: a flag that its direction leaves a border by more than rounding, and `(i)`: its moves.

        The first rows are those of the first pair of states (before, after), and so on.
        """

        @functools.cache
        def moves_of(row: int) -> tuple[Value, Callable[[Index], Value]]:
            (before, after), row = states[row // self.rows], row % self.rows
            sums = [code.variable(code.lanes_of(0.0)) for _ in range(2)]
            for part in range(2):
                for i in form.each(code, self.base):
                    place = self._state_place(row, i, part)
                    sums[0].value += abs(before(place))
                    sums[1].value += abs(after(place) - before(place))

            def moved(i: Index) -> Value:
                places = [self._state_place(row, i, part) for part in range(2)]
                differs = [code.compare("!=", after(place), before(place)) for place in places]
                return differs[0] | differs[1]

            return sums[1].value > JUMP_NOISE * sums[0].value, moved

        return moves_of

    def _set_nan(self, frame: Frame, form, name: str, row: int, where: Value, which: Callable | None = None) -> None:
        """Set a row of a field to NaN in some lanes, for the coordinates `which` or all."""
        for i in form.each(frame.code, self.base):
            with frame.where(where if which is None else where & which(i)):
                for part in range(2):
                    frame[name, self._state_place(row, i, part)] = float("nan")
