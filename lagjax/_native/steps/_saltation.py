"""Derivatives at a border in a kernel: the jump of tangents and cotangents, to every order (`_program._jump`).

A varied motion crosses the border at another time; until then its acceleration is a⁻, from then on a⁺. First tangents
of a velocity jump by (a⁻ − a⁺) δt, and tangents of tangents also where only the derivative of the acceleration jumps.
Where the border is grazed, so that a change of the state within the tolerance decides whether it is crossed,
derivatives do not exist and are NaN, except first ones where the acceleration is continuous.
"""

from collections.abc import Callable, Iterator

from lagjax._native.code._constants import JUMP_NOISE
from lagjax._native.code._frame import Fields, Frame, Index, Numbers, Vectors
from lagjax._native.code._ir import Code, Value
from lagjax._native.series._cotangents import Cotangents, add
from lagjax._native.series._tangent_memory import Directions
from lagjax._native.series._taylor import TaylorSeries
from lagjax._native.steps._watch import GuardTable, HitKind, StepEnd
from lagjax._program import Borders, Jump, Table


class Saltation:
    """The kernel functions for the jumps of a motion with tangents; its first `base` coordinates are the motion."""

    def __init__(self, motion: TaylorSeries, table: GuardTable, base: int, jump: Jump):
        self.motion, self.base, self.pieces, self.jump = motion, base, motion.pieces, jump
        self.table = table
        self.chosen = jump.fixed - 2 * self.pieces
        self.parameters = motion.parameters * self.base // motion.n  # of the motion alone

    @staticmethod
    def fields(borders: Borders) -> Fields:
        pieces = len(borders.switches)
        return {
            "crossed": 1,  # the `StepEnd` that the step ends at
            "crossed_number": 1,  # the number of that guard, or clock
            "pieces_before": pieces,  # the pieces before the border
            "hit": pieces,  # not 0 for the piece whose switching number is zero at the border
            # The number of the entry that is the level there; follows `hit`.
            **({"entry": pieces} if borders.levels_move else {}),
            "is_hit": 1,  # a `HitKind`
            "grazes": 1,  # 1 where the rate of the switching number is zero to the tolerance
        }

    # ---- what jumps ----

    def _find_jumping_tangents(
        self, frame: Frame, form, hit: Vectors, pieces: Numbers, before: Numbers, behind: Numbers, grazes: Value
    ) -> tuple[Callable, Value]:
        """A function `(i, part)`: first tangents of coordinate i (part 0) or its velocity jump at `hit`; and `lost`.

        Both jump where L jumps, those of a velocity where its acceleration jumps by more than rounding. `lost`: a cone
        is left, and tangents across its vector follow its direction at an unbounded rate. At a grazed border the jump
        of one coordinate may be the rounding of others.
        """
        code, guards = frame.code, self.table.borders.guards
        kicks = lost = frame.constant(0.0) > 0.0
        for j in self.table.borders.kicking:
            kicks = kicks | code.compare("!=", hit[j], 0.0)
        for share in self.table.borders.releases:
            cone = guards[guards[share].on].piece
            here = [code.compare("!=", hit[j], 0.0) for j in (guards[share].piece, cone)]
            lost = lost | ((here[0] | here[1]) & (pieces[cone] > 0.0))

        def size(i: Index) -> Value:
            return code.maximum(abs(before[i]), abs(behind[i]))

        largest = form.largest(code, size, self.base)

        def jumps(i: Index, part: int) -> Value:
            if not part:
                return kicks
            larger = code.select(grazes > 0.0, largest, size(i))
            return kicks | lost | (abs(before[i] - behind[i]) > JUMP_NOISE * larger)

        return jumps, lost

    def _row_places(self, frame: Frame, form, rows: range) -> Iterator[tuple[int, Index, int, Index]]:
        """Row, coordinate, part (1 for its velocity) and index in the state of all numbers of some rows."""
        for row in rows:
            for part in range(2):
                for i in form.each(frame.code, self.base):
                    yield row, i, part, i + (part * self.motion.n + row * self.base)

    def _tangent_jumps(
        self, frame: Frame, form, out: Numbers, hit: Vectors, pieces: Numbers, is_hit: Value, grazes: Value
    ) -> Callable:
        """A function `(row, i, part)`: the jump of the tangent of coordinate i (part 0) or its velocity (part 1)."""
        code, n, first = frame.code, self.base, (len(self.jump.orders) - 1) * 2 * self.base
        before, behind = (_select_numbers(out, first + k * n, n) for k in range(2))
        jumps, lost = self._find_jumping_tangents(frame, form, hit, pieces, before, behind, grazes)
        jump_or_nan = self._jump_or_nan(code, is_hit, (grazes > 0.0) | lost)

        def added(row: int, i: Index, part: int) -> Value:
            step, moves = jump_or_nan(out[i + ((row - 1) * 2 + part) * n]), is_hit > 0.0
            if self.jump.orders[row] == 1:
                moves = moves & jumps(i, part)
            return code.select(moves, step, 0.0)

        return added

    def _jump_or_nan(self, code: Code, hit: Value, grazes: Value) -> Callable[[Value], Value]:
        """A function of a jump: the jump, or NaN where it does not exist (grazed border, coincident knots)."""
        several = hit > float(HitKind.BORDER)

        def jump_or_nan(jump: Value) -> Value:
            return code.select(grazes | (several & code.compare("!=", jump, 0.0)), float("nan"), jump)

        return jump_or_nan

    # ---- in a run: the motion with its tangents ----

    def store_state(self) -> Code:
        """Emit `()`: store the state at the border where a step ends; several may be crossed there in turn."""
        frame = self.motion.function("note_before")
        stepped = self.table.counts(frame)
        for i in self.motion.form.each(frame.code, self.motion.states):
            frame.assign(stepped, i, edge=frame["y", i])
        return frame.finish()

    def apply(self) -> Code:
        """Emit `()`: compute the tangents beyond the border that is `hit`, with the pieces after all crossings."""
        frame = self.motion.function("jump_of_tangents")
        motion, code, n, base = self.motion, frame.code, self.motion.n, self.base
        is_hit = frame["is_hit"] > 0.0
        with code.only_if(code.any_lane(is_hit)):
            lower, numbers = self.jump.lower * base, self.jump.lower * self.parameters
            parts = [
                _frame_vectors(frame, "edge", lower), _frame_vectors(frame, "edge", lower, n), frame.vectors("t", 1),
                _frame_vectors(frame, "params", numbers), frame.vectors("pieces_before", self.pieces),
                _frame_vectors(frame, "params", self.pieces, motion.parameters), *self._switching_choice(frame.vectors),
                _frame_vectors(frame, "edge", n - lower, lower), _frame_vectors(frame, "edge", n - lower, n + lower),
                _frame_vectors(frame, "params", motion.parameters - numbers, numbers),
            ]  # fmt: skip
            out = motion.form.run(frame, self.jump.line, *parts)
            hit = frame.vectors("hit", self.pieces)
            added = self._tangent_jumps(frame, motion.form, out, hit, parts[5], frame["is_hit"], frame["grazes"])
            for row, i, part, place in self._row_places(frame, motion.form, range(1, len(self.jump.orders))):
                frame.assign(is_hit, place, y=frame["edge", place] + added(row, i, part))
        return frame.finish()

    # ---- over steps that have been taken ----

    def fields_along(self) -> Fields:
        # The state at the border, the time there, and whether it is grazed, when the next step is at hand.
        return {"edge": self.motion.states, "edge_t": 1, "edge_grazes": 1}

    def _record_edge(self, frame: Frame) -> None:
        """Store the state at the end of a step, and the data of the border that it lies on."""
        motion, code = self.motion, frame.code
        self.table.record_hit(frame, frame.constant(0.0) <= 0.0)
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        for i in motion.form.each(code, motion.states):
            frame["edge", i] = moved[i]
        frame["edge_t"], frame["edge_grazes"] = frame["t"] + frame["h"], frame["grazes"]

    def store_end(self) -> Code:
        """Emit `()`: store the state at the border where a step ends, for tangents at the start of the next one."""
        frame = self.motion.function("note_end")
        frame["is_hit"] = HitKind.NONE
        with frame.code.only_if(frame.code.any_lane(self.table.crosses_any(frame))):
            self._record_edge(frame)
        return frame.finish()

    def _switching_choice(self, numbers: Callable) -> list:
        """The inputs of the jump that select the switching number: weights, and entries of levels that vary."""
        return [numbers("hit", self.pieces), *([numbers("entry", self.pieces)] if self.chosen > self.pieces else [])]

    def _edge_inputs(self, numbers: Callable, behind: Vectors) -> list:
        """The inputs of the jump except its upper rows; `numbers(name, count)` reads vectors of the motion."""
        return [
            numbers("edge", self.motion.states), numbers("edge_t", 1), numbers("params", self.motion.parameters),
            numbers("pieces_before", self.pieces), behind, *self._switching_choice(numbers),
        ]  # fmt: skip

    def push(self, directions: Directions, frame: Frame) -> None:
        """Compute the tangents behind a border, at the start of the next step."""
        form, n, jump, code = directions.form, directions.n, self.jump, frame.code

        def numbers(name, count, first=0):
            return directions.numbers_of(frame, name, count, lambda i: (i + first,), in_place=True)

        with code.only_if(code.any_lane(directions.number_of(frame, "is_hit") > 0.0)):
            tangents = [frame.vectors("dy", n, lambda i: (i, 0)), frame.vectors("dy", n, lambda i: (i + n, 0))]
            pieces = numbers("params", self.pieces, self.motion.parameters)
            inputs = *self._edge_inputs(numbers, pieces), *tangents, frame.vectors("dparams", directions.numbers)
            out = form.run(frame, jump.line, *inputs)
            is_hit, grazes = (directions.number_of(frame, name) for name in ("is_hit", "edge_grazes"))
            added = self._tangent_jumps(frame, form, out, numbers("hit", self.pieces), pieces, is_hit, grazes)
            for row, i, part, place in self._row_places(frame, form, range(jump.lower)):
                frame["dy", place, 0] = frame["dy", place, 0] + added(jump.lower + row, i, part)

    def pull(self, cotangents: Cotangents) -> Code:
        """Emit `()`: cotangents of the state before a border, and of parameters, from those of the state beyond."""
        motion, frame = self.motion, self.motion.function("back_border")
        code = frame.code
        frame["crossed"] = code.select(frame["has_after"] > 0.0, frame["crossed"], StepEnd.NOTHING)
        with code.only_if(code.any_lane(self.table.crosses_any(frame))):
            self._record_edge(frame)
            gain, tables, entries = self._cotangent_jumps(frame, frame.vectors("pieces_after", motion.pieces))
            for row, i, part, place in self._row_places(frame, motion.form, range(self.jump.lower)):
                add(frame, gain(row, i + part * self.base), "state_ct", place)
            for row in range(self.jump.lower):
                for k in motion.form.each(code, self.parameters):
                    add(frame, gain(row, k + 2 * self.base), "params_ct", k + row * self.parameters)
            cotangents.store_entries(frame, tables, entries, 0)
        return frame.finish()

    def store_next_pieces(self) -> Code:
        """Emit `()`: store the pieces of a step, for cotangents at the end of the step before it."""
        frame = self.motion.function("note_after")
        with frame.code.loop(self.motion.pieces) as j:
            frame["pieces_after", j] = frame["params", j + self.motion.parameters]
        frame["has_after"] = 1.0
        return frame.finish()

    def _cotangent_jumps(self, frame: Frame, behind: Vectors) -> tuple[Callable, tuple[Table, ...], list[Value]]:
        """A function `(row, i)`: the jump of the cotangent of number i of a row (q, q̇, parameters) at the `edge`.

        It is for `state_ct`, with the pieces `behind` the border. Also the tables, with entry indices and their
        cotangents.
        """
        n, rows, motion, code = self.base, self.jump.lower, self.motion, frame.code
        inputs = self._edge_inputs(lambda name, count: frame.vectors(name, count), behind)
        out = motion.form.run(frame, self.jump.accelerations(n), *inputs)
        hit = frame.vectors("hit", self.pieces)
        both = _select_numbers(out, 0, n), _select_numbers(out, n, n)
        jumps, lost = self._find_jumping_tangents(frame, motion.form, hit, behind, *both, frame["grazes"])
        cotangents, sum = motion.form.room(frame, rows * 2 * n), code.variable(frame.constant(0.0))
        for row, i, part, place in self._row_places(frame, motion.form, range(rows)):
            ct = frame["state_ct", place]
            if row == 0:
                ct = code.select(jumps(i, part), ct, 0.0)
            cotangents[i + (2 * row + part) * n] = ct
            sum.value += abs(ct)
        line, tables = self.jump.transposed(n, self.parameters)
        gains = motion.form.run(frame, line, *inputs, cotangents)
        moves = (frame["is_hit"] > 0.0) & ~(sum.value <= 0.0)
        jump_or_nan = self._jump_or_nan(code, frame["is_hit"], (frame["grazes"] > 0.0) | lost)

        def gain_at(place: Index) -> Value:
            return code.select(moves, jump_or_nan(gains[place]), 0.0)

        def gain(row: int, i: Index) -> Value:
            return gain_at(i + row * (2 * n + self.parameters))

        first, entries = rows * (2 * n + self.parameters), []
        for k in range(len(tables)):
            entries += [gains[first + 2 * k], gain_at(first + 2 * k + 1)]
        return gain, tables, entries


def _select_numbers(numbers: Numbers, first: int, count: int) -> Numbers:
    if isinstance(numbers, Vectors):
        return Vectors(count, lambda i: numbers[i + first])
    return numbers[first : first + count]


def _frame_vectors(frame: Frame, name: str, count: int, first: int = 0) -> Vectors:
    return frame.vectors(name, count, lambda i: (i + first,))
