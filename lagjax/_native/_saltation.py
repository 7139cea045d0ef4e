"""Derivatives at a border: the jump of tangents, and of cotangents, to every order (`_program._jump`).

The border is crossed at another time when the motion is varied; up to then the acceleration is a⁻, and from then on a⁺.
First tangents of a velocity jump by (a⁻ − a⁺) δt where the acceleration jumps, tangents of tangents also where only its
derivative does. Where the border is grazed, so that a change of the state within the tolerance decides whether it is
crossed, none of this exists: derivatives are NaN there, but for first ones where the acceleration is continuous.
"""

import functools
import math
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from lagjax._native._constants import JUMP_NOISE
from lagjax._native._cotangents import Cotangents, add
from lagjax._native._frame import Fields, Frame, Index, Numbers, Vectors, integers
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native._tangent_memory import Directions
from lagjax._native._taylor import TaylorSeries
from lagjax._program._borders import Affine, Borders, Level
from lagjax._program._jump import Jump
from lagjax._program._look_ups import Table

# The rules of a guard by name, each with the place of its first number among those of the guard.
_RULES, _NUMBERS = {"side": (0, Affine), "level": (2, Level), "beyond": (6, Affine)}, 8
_PLACES = ("piece", "back", "slide", "on", "order", "rest", "gains", "of_table")


class Hit(IntEnum):
    """The borders that a step ends at: none whose instant varies, one, or several at one instant."""

    NONE = 0
    BORDER = 1
    SEVERAL = 2


class Crossed(IntEnum):
    """The border at the end of a step: none, a guard, a knot of a clock, or knots of several at one instant."""

    NOTHING = 0
    GUARD = 1
    KNOT = 2
    KNOTS = 3


class GuardTable:
    """The guards of all pieces (`_program._borders.Guard`) as constants of a kernel, for loops over them; and `knots`.

    A knot is an entry of a table of parameters that the time is on, or one at which L jumps; another one of a table of
    numbers neither varies nor matters to tangents. There are no derivatives by knots of several tables that coincide:
    the acceleration between them is not known.
    """

    def __init__(self, motion: TaylorSeries, borders: Borders):
        self.motion, self.borders = motion, borders
        rules = [[x for name in _RULES for x in getattr(guard, name)] for guard in borders.guards] or [[0.0]]
        self._rules = integers(motion.module, np.array(rules, float).view(np.int64))
        self._places = integers(
            motion.module,
            np.array([[getattr(g, name) for name in _PLACES] for g in borders.guards] or [[0]], np.int64),
        )
        self.guards = len(borders.guards)
        moves = {j: borders.moving_table(j) is not None for j in borders.clocks}
        # The number and the piece of each clock that has knots.
        self.knots = [(c, j) for c, j in enumerate(borders.clocks) if moves[j] or j in borders.kicking]
        self.movable = [j for _, j in self.knots if moves[j]]

    def rule(self, code: Code, g: Value, name: str) -> Any:
        """The `side`, the `level` or the piece `beyond` of guard g, as functions of its piece."""
        (first, kind), row = _RULES[name], Value(code, self._rules)
        places = range(first, first + len(kind._fields))
        return kind(*(code.load(code.element(row, g * _NUMBERS + k), DOUBLE) for k in places))

    def place(self, code: Code, g: Value, name: str) -> Value:
        """A number of another guard, or of a piece; −1 where there is none."""
        place = g * len(_PLACES) + _PLACES.index(name)
        return code.load(code.element(Value(code, self._places), place, INTEGER), INTEGER)

    def crosses(self, frame: Frame, kind: Crossed, number: Index | None = None) -> Value:
        """True if a step ends at a guard, or at knots: at any of them, or at that with this number."""
        code, crosses = frame.code, frame.code.compare("==", frame["crossed"], float(kind))
        if number is None:
            return crosses
        at = code.as_double(number) if isinstance(number, Value) else float(number)
        return crosses & code.compare("==", frame["crossed_number"], code.lanes_of(at))

    def crosses_knot(self, frame: Frame) -> Value:
        """True if a step ends at knots that are parameters."""
        at_knots = [self.crosses(frame, Crossed.KNOT, c) for c, _ in self.knots]
        return functools.reduce(Value.__or__, at_knots, self.crosses(frame, Crossed.KNOTS))

    def kicks(self, frame: Frame) -> Value:
        """True if a step ends at a border at which L jumps."""
        kicking, crosses = self.borders.kicking, functools.partial(self.crosses, frame)
        ends = [crosses(Crossed.GUARD, g) for g, guard in enumerate(self.borders.guards) if guard.piece in kicking]
        ends += [crosses(Crossed.KNOT, c) for c, j in enumerate(self.borders.clocks) if j in kicking]
        return functools.reduce(Value.__or__, [*ends, *([crosses(Crossed.KNOTS)] if self.movable else [])])

    def note_hit(self, frame: Frame, where: Value | None = None) -> None:
        """The pieces, and which switching number the guard `crossed` has; none where a motion begins on the border.

        In the lanes `where` a step ends at one, which are all of them by default.
        """
        motion, code = self.motion, frame.code
        where = frame.constant(0.0) <= 0.0 if where is None else where
        self._note_pieces(frame, where)
        with code.loop(self.guards) as g:
            j = self.place(code, g, "piece")
            side = self.rule(code, g, "side")(frame["pieces_before", j])
            hit = where & self.crosses(frame, Crossed.GUARD, g)
            decided = code.compare("!=", side, 0.0)
            if self.borders.kicking:  # where L jumps, a motion that begins on the border comes from what L is there
                decided = decided | self.kicks(frame)
            hit = hit & decided
            with frame.where(hit):
                frame["hit", j] = 1
                frame["is_hit"] = Hit.BORDER
                if self.borders.levels_move:
                    frame["entry", j] = frame["params", j + motion.parameters] + self.rule(code, g, "level").offset

    def note_knot(self, frame: Frame, where: Value) -> None:
        """The same of knots that are parameters."""
        if not self.knots:
            return
        code = frame.code
        where = where & self.crosses_knot(frame)
        with code.only_if(code.any_lane(where)):
            self._note_pieces(frame, where)
            both = where & self.crosses(frame, Crossed.KNOTS)
            for k, (c, j) in enumerate(self.knots):
                with frame.where(both | (where & self.crosses(frame, Crossed.KNOT, c))):
                    # Where several coincide no rational directions of theirs cancel, to a jump of nothing.
                    frame["hit", j] = math.exp(k)
                    if self.borders.levels_move:
                        entry = frame["params", j + self.motion.parameters] + code.flag(frame["h"] > 0.0)
                        frame["entry", j] = entry
                    frame["is_hit"] = Hit.BORDER
            with frame.where(both):
                frame["is_hit"] = Hit.SEVERAL

    def _note_pieces(self, frame: Frame, where: Value) -> None:
        with frame.where(where):
            frame["is_hit"] = Hit.NONE
            with frame.code.loop(self.motion.pieces) as j:
                frame["hit", j] = 0.0
                frame["pieces_before", j] = frame["params", j + self.motion.parameters]
                if self.borders.levels_move:
                    frame["entry", j] = 0.0


class Saltation:
    """The jumps of a motion with tangents, whose first `base` coordinates are the motion alone."""

    def __init__(self, motion: TaylorSeries, table: GuardTable, base: int, jump: Jump):
        self.motion, self.base, self.pieces, self.jump = motion, base, motion.pieces, jump
        self.table, self.several = table, len(table.movable) > 0 and len(table.borders.clocks) > 1
        self.chosen = jump.fixed - 2 * self.pieces
        self.parameters = motion.parameters * self.base // motion.n  # of the motion alone

    @staticmethod
    def fields(borders: Borders) -> Fields:
        pieces = len(borders.switches)
        return {
            "crossed": 1,  # the `Crossed` that the step ends at
            "crossed_number": 1,  # the number of that guard, or clock
            "pieces_before": pieces,  # the pieces before the border
            "hit": pieces,  # not 0 for the piece whose switching number is zero at the border
            # The number of the entry that is the level there; follows `hit`.
            **({"entry": pieces} if borders.levels_move else {}),
            "is_hit": 1,  # a `Hit`
            "grazes": 1,  # 1 where the rate of the switching number is zero to the tolerance
        }

    # ---- what jumps ----

    def _sets_out(self, frame: Frame, hit: Vectors, behind: Numbers) -> Value | None:
        """True if a cone is left at the border that is `hit`; None where there are none.

        From there tangents across it follow its direction at a rate without a bound: they are not known.
        """
        leaves = None
        for share in self.table.borders.releases:
            guard = self.table.borders.guards[share]
            cone = self.table.borders.guards[guard.on].piece
            here = [frame.code.compare("!=", hit[j], 0.0) for j in (guard.piece, cone)]
            here = (here[0] | here[1]) & (behind[cone] > 0.0)
            leaves = here if leaves is None else leaves | here
        return leaves

    def _jumps(self, code: Code, before: Numbers, behind: Numbers, lost: Value | None) -> Callable[[Index], Value]:
        """`(i)`: true if acceleration i jumps by more than rounding, or its tangents are `lost`."""

        def jumps(i):
            larger = code.maximum(code.intrinsic("fabs", before[i]), code.intrinsic("fabs", behind[i]))
            differs = code.intrinsic("fabs", before[i] - behind[i]) > JUMP_NOISE * larger
            return differs if lost is None else differs | lost

        return jumps

    def _kicks(self, frame: Frame, hit: Vectors) -> Value | None:
        """True if L jumps at the border that is `hit`; None where it does nowhere."""
        kicks = None
        for j in self.table.borders.kicking:
            here = frame.code.compare("!=", hit[j], 0.0)
            kicks = here if kicks is None else kicks | here
        return kicks

    def _tangent_jumps(
        self, frame: Frame, out: Numbers, hit: Value, grazes: Value, kicks: Value | None, lost: Value | None
    ) -> Callable:
        """`(row, i, part)`: the number that is added to coordinate i of a row (part 0), or to its velocity (part 1)."""
        code, n = frame.code, self.base
        first = (len(self.jump.orders) - 1) * 2 * n
        before, behind = (_some(out, first + k * n, n) for k in range(2))
        jumps = self._jumps(code, before, behind, lost)
        is_hit, nowhere = hit > 0.0, grazes > 0.0 if lost is None else (grazes > 0.0) | lost
        jump_or_nan = self._jump_or_nan(code, hit, nowhere)

        def added(row: int, i: Index, part: int) -> Value:
            step, moves = jump_or_nan(out[i + ((row - 1) * 2 + part) * n]), is_hit
            if self.jump.orders[row] == 1:
                if kicks is not None:
                    moves = is_hit & (kicks | jumps(i)) if part else is_hit & kicks
                elif part:
                    moves = is_hit & jumps(i)
                else:
                    return frame.constant(0.0)
            return code.select(moves, step, 0.0)

        return added

    def _jump_or_nan(self, code: Code, hit: Value, grazes: Value) -> Callable[[Value], Value]:
        """`(jump)`: the jump, or NaN where there is none: at a border that is grazed, and where knots coincide."""
        several = hit > float(Hit.BORDER) if self.several else None

        def jump_or_nan(jump: Value) -> Value:
            if several is not None:
                jump = code.select(several & code.compare("!=", jump, 0.0), float("nan"), jump)
            return code.select(grazes, float("nan"), jump)

        return jump_or_nan

    # ---- in a run: the motion with its tangents ----

    def note(self) -> Code:
        """`()`: the state at the border that a step ends at. Several may be crossed there, one after the other."""
        frame = self.motion.function("note_before")
        stepped = frame["counts" if self.table.borders.kicking else "stepped"] > 0.0
        self.table.note_knot(frame, stepped)
        for i in self.motion.form.each(frame.code, self.motion.states):
            with frame.where(stepped):
                frame["edge", i] = frame["y", i]
        return frame.finish()

    def apply(self) -> Code:
        """`()`: the tangents beyond the border that is `hit`, on the pieces behind all that are crossed there."""
        frame = self.motion.function("jump_of_tangents")
        motion, code, n, base = self.motion, frame.code, self.motion.n, self.base
        is_hit = frame["is_hit"] > 0.0
        with code.only_if(code.any_lane(is_hit)):
            lower, numbers = self.jump.lower * base, self.jump.lower * self.parameters
            parts = [
                _field(frame, "edge", lower), _field(frame, "edge", lower, n), frame.vectors("t", 1),
                _field(frame, "params", numbers), frame.vectors("pieces_before", self.pieces),
                _field(frame, "params", self.pieces, motion.parameters), *self._choice(frame.vectors),
                _field(frame, "edge", n - lower, lower), _field(frame, "edge", n - lower, n + lower),
                _field(frame, "params", motion.parameters - numbers, numbers),
            ]  # fmt: skip
            out = motion.form.run(frame, self.jump.line, *parts)
            hit = frame.vectors("hit", self.pieces)
            lost = self._sets_out(frame, hit, parts[5])
            added = self._tangent_jumps(frame, out, frame["is_hit"], frame["grazes"], self._kicks(frame, hit), lost)
            for row in range(1, len(self.jump.orders)):
                for part in range(2):
                    for i in motion.form.each(code, base):
                        place = i + (part * n + row * base)
                        beyond = frame["edge", place] + added(row, i, part)
                        with frame.where(is_hit):
                            frame["y", place] = beyond
        return frame.finish()

    # ---- over steps that have been taken ----

    def fields_along(self) -> Fields:
        return {"edge": self.motion.states, "edge_t": 1}  # the state at the border, and the time there

    def _note_edge(self, frame: Frame) -> None:
        """The state at the end of a step, and what is to be known of the border there."""
        motion, code = self.motion, frame.code
        self.table.note_hit(frame)
        self.table.note_knot(frame, frame["crossed"] > 0.0)
        moved = motion.move_state(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        for i in motion.form.each(code, motion.states):
            frame["edge", i] = moved[i]
        frame["edge_t"] = frame["t"] + frame["h"]

    def note_end(self) -> Code:
        """`()`: note the state at the border that a step ends at, for tangents at the beginning of the next one."""
        frame = self.motion.function("note_end")
        frame["is_hit"] = Hit.NONE
        with frame.code.only_if(frame.code.any_lane(self._crosses(frame))):
            self._note_edge(frame)
        return frame.finish()

    def _crosses(self, frame: Frame) -> Value:
        crosses = self.table.crosses(frame, Crossed.GUARD)
        return crosses | self.table.crosses_knot(frame) if self.table.knots else crosses

    def _choice(self, numbers: Callable) -> list:
        """The numbers that choose the switching number, as inputs of the jump."""
        return [numbers("hit", self.pieces), *([numbers("entry", self.pieces)] if self.chosen > self.pieces else [])]

    def _edge_inputs(self, numbers: Callable, behind: Vectors) -> list:
        """The inputs of the jump but for its upper rows; `numbers(name, count)` gives vectors of the motion."""
        return [
            numbers("edge", self.motion.states), numbers("edge_t", 1), numbers("params", self.motion.parameters),
            numbers("pieces_before", self.pieces), behind, *self._choice(numbers),
        ]  # fmt: skip

    def push(self, directions: Directions, frame: Frame) -> None:
        """The tangents behind a border, at the beginning of the step from there."""
        is_hit = directions.number_of(frame, "is_hit") > 0.0
        with frame.code.only_if(frame.code.any_lane(is_hit)):
            self._add_jumps(directions, frame)

    def _add_jumps(self, directions: Directions, frame: Frame) -> None:
        form, n, behind, jump = directions.form, directions.n, self.motion.parameters, self.jump

        def numbers(name, count, first=0):
            return directions.numbers_of(frame, name, count, lambda i: (i + first,), in_place=True)

        tangents = [frame.vectors("dy", n, lambda i: (i, 0)), frame.vectors("dy", n, lambda i: (i + n, 0))]
        pieces = numbers("params", self.motion.pieces, behind)
        inputs = self._edge_inputs(numbers, pieces)
        out = form.run(frame, jump.line, *inputs, *tangents, frame.vectors("dparams", directions.numbers))
        is_hit, grazes = (directions.number_of(frame, name) for name in ("is_hit", "grazes"))
        hit = numbers("hit", self.pieces)
        lost = self._sets_out(frame, hit, pieces)
        added = self._tangent_jumps(frame, out, is_hit, grazes, self._kicks(frame, hit), lost)
        for row in range(jump.lower):
            for part in range(2):
                for i in form.each(frame.code, self.base):
                    place = i + (part * n + row * self.base)
                    frame["dy", place, 0] = frame["dy", place, 0] + added(jump.lower + row, i, part)

    def pull(self, cotangents: Cotangents) -> Code:
        """`()`: from the state beyond the border that a step ends at to that before it, and to the parameters."""
        motion, base = self.motion, self.base
        frame = motion.function("back_border")
        code = frame.code
        frame["crossed"] = code.select(frame["has_after"] > 0.0, frame["crossed"], Crossed.NOTHING)
        with code.only_if(code.any_lane(self._crosses(frame))):
            self._note_edge(frame)
            gain, tables, entries = self._cotangent_jumps(frame, frame.vectors("pieces_after", motion.pieces))
            for row in range(self.jump.lower):
                for part in range(2):
                    for i in motion.form.each(code, base):
                        add(frame, gain(row, i + part * base), "state_ct", i + (part * motion.n + row * base))
                for k in motion.form.each(code, self.parameters):
                    add(frame, gain(row, k + 2 * base), "params_ct", k + row * self.parameters)
            cotangents.store_entries(frame, tables, entries, 0)
        return frame.finish()

    def note_after(self) -> Code:
        """`()`: note the pieces of a step, for cotangents at the end of the one before."""
        frame = self.motion.function("note_after")
        with frame.code.loop(self.motion.pieces) as j:
            frame["pieces_after", j] = frame["params", j + self.motion.parameters]
        frame["has_after"] = 1.0
        return frame.finish()

    def _cotangent_jumps(self, frame: Frame, behind: Vectors) -> tuple[Callable, tuple[Table, ...], list[Value]]:
        """`(row, i)`: the gain of the cotangent of number i of a row, q, q̇ and then the parameters, at the `edge`.

        Of `state_ct`, with the pieces `behind` the border. And tables, with the numbers of entries and their gains.
        """
        n, rows, motion, code = self.base, self.jump.lower, self.motion, frame.code
        inputs = self._edge_inputs(lambda name, count: frame.vectors(name, count), behind)
        out = motion.form.run(frame, self.jump.accelerations(n), *inputs)
        hit = frame.vectors("hit", self.pieces)
        lost, kicks = self._sets_out(frame, hit, behind), self._kicks(frame, hit)
        jumps = self._jumps(code, _some(out, 0, n), _some(out, n, n), lost)
        cotangents, sum = motion.form.room(frame, rows * 2 * n), code.variable(frame.constant(0.0))
        for row in range(rows):
            for part in range(2):
                for i in motion.form.each(code, n):
                    ct = frame["state_ct", i + (part * motion.n + row * n)]
                    if row == 0 and kicks is not None:
                        ct = code.select(kicks | jumps(i) if part else kicks, ct, 0.0)
                    elif row == 0:
                        ct = code.select(jumps(i), ct, 0.0) if part else frame.constant(0.0)
                    cotangents[i + (2 * row + part) * n] = ct
                    sum.value += code.intrinsic("fabs", ct)
        line, tables = self.jump.transposed(n, self.parameters)
        gains = motion.form.run(frame, line, *inputs, cotangents)
        moves = (frame["is_hit"] > 0.0) & ~(sum.value <= 0.0)
        nowhere = frame["grazes"] > 0.0 if lost is None else (frame["grazes"] > 0.0) | lost
        jump_or_nan = self._jump_or_nan(code, frame["is_hit"], nowhere)

        def gain_at(place: Index) -> Value:
            return code.select(moves, jump_or_nan(gains[place]), 0.0)

        def gain(row: int, i: Index) -> Value:
            return gain_at(i + row * (2 * n + self.parameters))

        first, entries = rows * (2 * n + self.parameters), []
        for k in range(len(tables)):
            entries += [gains[first + 2 * k], gain_at(first + 2 * k + 1)]
        return gain, tables, entries


def _some(numbers: Numbers, first: int, count: int) -> Numbers:
    if isinstance(numbers, Vectors):
        return Vectors(count, lambda i: numbers[i + first])
    return numbers[first : first + count]


def _field(frame: Frame, name: str, count: int, first: int = 0) -> Vectors:
    return frame.vectors(name, count, lambda i: (i + first,))
