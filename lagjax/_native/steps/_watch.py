"""Watches: numbers that are compared with a level along a step, and what is remembered of each.

A watch finds the instant at which its number reaches the level from its side. If a motion starts on the level, or moves
along it, a `Contact` records that: rounding must not decide on which side the next step begins. At the instant the
motion enters the next piece (`Border`, `_border_control`), or it stops, or it is recorded and continues (`_events`).
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._frame import Fields, Frame, Index, integer_constant
from lagjax._native.code._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native.series._taylor import TaylorSeries
from lagjax._program import Affine, Borders, Level

# The fields of a thread's memory that say where watches end a step.
END_OF_STEP: Fields = {
    "planned": 1,  # the step without borders
    "nearest": 1,  # the first border, as a fraction of it
    "seen": 1,  # the fraction of the step up to which all guards can be seen
    "first_at": 1,  # how far from the beginning of the step the first change of a guard is
    "event": 1,  # 0 where changes of guards end the motion, −1 without any
}


def step_to_border(frame: Frame) -> Value:
    """The length of the step up to the first border."""
    return frame["nearest"] * frame["planned"]


def reaches_border(frame: Frame) -> Value:
    """True if the step reaches the first border."""
    return frame.code.compare("==", frame["h"], step_to_border(frame))


class Contact(IntEnum):
    """The contact of a number with its level at the start of a step: none, of its value, of rates too, permanent.

    Values between count the rates that are zero, and one for the value. A root at the start is not searched for, and
    rounding must not produce one. A guard that `CONTINUES` was zero at the end of the last step, and still is unless it
    jumped; for a border it means that the program is evaluated on the border, since the sides do not push onto it.
    """

    CONTINUES = -1
    NONE = 0
    VALUE = 1
    RATE = 2
    SECOND_RATE = 3
    SLIDING = 4


class StepEnd(IntEnum):
    """The border at the end of a step: none, a guard, a knot of a clock, or knots of several at one instant."""

    NOTHING = 0
    GUARD = 1
    KNOT = 2
    KNOTS = 3


class HitKind(IntEnum):
    """The number of borders at the end of a step whose instants can vary: none, one, or several at one instant."""

    NONE = 0
    BORDER = 1
    SEVERAL = 2


_RULES = {"side": Affine, "level": Level, "beyond": Affine}
_PLACES = ("piece", "back", "slide", "on", "order", "rest", "gains", "of_table")


@dataclass(frozen=True, eq=False)
class Watch:
    """A followed number: row `g` of a `table` of constants; its memory has one row in fields of the frame."""

    frame: Frame
    table: Any
    g: Value

    @property
    def code(self) -> Code:
        return self.frame.code

    def __getitem__(self, name: str) -> Value:
        """The constant `name` of this watch, an integer."""
        return self.table.read(self.code, self.g, name)

    def number(self, name: str) -> Value:
        """The constant `name` of this watch as a double, in all lanes."""
        return self.code.lanes_of(self.code.as_double(self[name]))

    def recall(self, name: str) -> Value:
        return self.frame[name, self.g]

    def remember(self, where: Value, **values: "Value | float") -> None:
        self.frame.assign(where, self.g, **values)


class Columns:
    """A table of integer or double constants in a kernel, with named columns, for loops over its rows."""

    watch: type = Watch

    def __init__(self, module: ir.Module, names: Sequence[str], rows: Sequence, kind: ir.Type = INTEGER):
        self.count = len(rows)
        numbers = np.array(rows or [[0]], np.int64 if kind == INTEGER else float)
        self._names, self._kind, self._data = names, kind, integer_constant(module, numbers.view(np.int64))

    def read(self, code: Code, row: Value, name: str) -> Value:
        place = row * len(self._names) + self._names.index(name)
        return code.load(code.element(Value(code, self._data), place, self._kind), self._kind)

    def each(self, frame: Frame) -> Iterator[Any]:
        """The watches of all rows, in an emitted loop: its body is emitted once."""
        with frame.code.loop(self.count) as g:
            yield self.watch(frame, self, g)


class Border(Watch):
    """The watch of a guard of a piece (`_program._levels.Guard`); a number −1 means none."""

    @property
    def touch(self) -> Value:
        return self.recall("touch")

    def has(self, name: str, least: int = 0) -> Value:
        """True, in all lanes, if the constant `name` is at least `least`: by default, if it is not −1."""
        return self.number(name) >= float(least)

    @property
    def piece(self) -> Value:
        return self.table.piece(self.frame, self["piece"])

    @property
    def is_hit(self) -> Value:
        """True in the lanes whose step ends at this border."""
        is_first = self.table.crosses(self.frame, StepEnd.GUARD, self.g)
        if not self.table.groups:
            return is_first
        return is_first | (self.table.crosses(self.frame, StepEnd.GUARD) & (self.recall("joins") > 0.0))

    @property
    def is_sign(self) -> Value:
        """True, in all lanes, if this is the guard of a sign, or of a cone."""
        return self.code.lanes_of(self.rule("beyond").slope) <= 0.0

    @property
    def is_cone(self) -> Value:
        """True, in all lanes, if this is the guard of a cone, or a share."""
        code = self.code
        return code.lanes_of(code.flag(code.compare("==", self.rule("beyond").slope, 0.0))) > 0.0

    def rule(self, name: str) -> Any:
        """The function of the piece `name`: the `side`, the `level` or the piece `beyond`."""
        rules, kind = self.table.rules, _RULES[name]
        return kind(*(rules.read(self.code, self.g, f"{name}.{of}") for of in kind._fields))

    def level(self, piece: Value) -> Value:
        code = self.code
        level = self.rule("level")(piece, lambda where, x: code.select(where, code.lanes_of(x), 0.0))
        if any(guard.of_table for guard in self.table.borders.guards):
            level = code.select(self.has("of_table", 1), self.recall("level"), level)
        return level


def joint_groups(borders: Borders) -> list[int]:
    """The group of each guard if borders of different groups may be crossed in one step; else an empty list."""
    apart = not (borders.nested or borders.kicking) and len(set(borders.holding.groups)) > 1
    groups = borders.groups_of_guards if apart else []
    return groups if len({*groups} - {-1}) > 1 else []


class GuardTable(Columns):
    """The guards of all pieces as constants of a kernel, and the `knots`.

    A knot is an entry of a table over time whose entries are parameters, or at which L jumps; knots of constant tables
    do not vary and do not change tangents. There are no derivatives by knots of several tables that coincide: the
    acceleration between them is unknown.
    """

    watch = Border

    def __init__(self, motion: TaylorSeries, borders: Borders):
        self.motion, self.borders = motion, borders
        names = [f"{name}.{of}" for name, kind in _RULES.items() for of in kind._fields]
        rules = [[x for name in _RULES for x in getattr(guard, name)] for guard in borders.guards]
        self.rules = Columns(motion.module, names, rules, DOUBLE)
        super().__init__(motion.module, _PLACES, [[getattr(g, name) for name in _PLACES] for g in borders.guards])
        groups = joint_groups(borders)
        self.groups = Columns(motion.module, ["group"], [[group] for group in groups]) if groups else None
        moves = {j: borders.moving_table(j) is not None for j in borders.clocks}
        # The number and the piece of each clock that has knots.
        self.knots = [(c, j) for c, j in enumerate(borders.clocks) if moves[j] or j in borders.kicking]
        self.movable = [j for _, j in self.knots if moves[j]]

    def piece(self, frame: Frame, j: Index) -> Value:
        return frame["params", j + self.motion.parameters]

    def crosses(self, frame: Frame, kind: StepEnd, number: Index | None = None) -> Value:
        """True if a step ends at a border of this kind: any one, or the one with this number."""
        code, crosses = frame.code, frame.code.compare("==", frame["crossed"], float(kind))
        if number is None:
            return crosses
        at = code.as_double(number) if isinstance(number, Value) else float(number)
        return crosses & code.compare("==", frame["crossed_number"], code.lanes_of(at))

    def crosses_any(self, frame: Frame) -> Value:
        """True if a step ends at a guard, or at knots that are parameters."""
        kinds = (StepEnd.GUARD, *((StepEnd.KNOTS,) if self.knots else ()))
        at_knots = [self.crosses(frame, StepEnd.KNOT, c) for c, _ in self.knots]
        return functools.reduce(Value.__or__, at_knots + [self.crosses(frame, kind) for kind in kinds])

    def counts(self, frame: Frame) -> Value:
        """True if a step is recorded: it has a length, or velocities that jump at its end."""
        return frame["counts" if self.borders.kicking else "stepped"] > 0.0

    def kicks(self, frame: Frame) -> Value:
        """True if a step ends at a border at which L jumps."""
        kicking, crosses = self.borders.kicking, functools.partial(self.crosses, frame)
        ends = [crosses(StepEnd.GUARD, g) for g, guard in enumerate(self.borders.guards) if guard.piece in kicking]
        ends += [crosses(StepEnd.KNOT, c) for c, j in enumerate(self.borders.clocks) if j in kicking]
        return functools.reduce(Value.__or__, [*ends, *([crosses(StepEnd.KNOTS)] if self.movable else [])])

    # ---- what a step ends at ----

    def record_hit(self, frame: Frame, where: Value) -> None:
        """Store, in some lanes, the pieces, and which switching numbers are zero at the border where the step ends.

        A guard on whose border a motion starts does not count, and a knot only if it is a parameter.
        """
        code, moves = frame.code, self.borders.levels_move
        with frame.where(where):
            frame["is_hit"] = HitKind.NONE
            with code.loop(self.motion.pieces) as j:
                frame["hit", j], frame["pieces_before", j] = 0.0, self.piece(frame, j)
                if moves:
                    frame["entry", j] = 0.0
        for border in self.each(frame):
            j = border["piece"]
            decided = code.compare("!=", border.rule("side")(frame["pieces_before", j]), 0.0)
            if self.borders.kicking:  # where L jumps, a motion that begins on the border comes from what L is there
                decided = decided | self.kicks(frame)
            with frame.where(where & self.crosses(frame, StepEnd.GUARD, border.g) & decided):
                frame["hit", j], frame["is_hit"] = 1, HitKind.BORDER
                if moves:
                    frame["entry", j] = border.piece + border.rule("level").offset
        for k, (c, j) in enumerate(self.knots):
            several = where & self.crosses(frame, StepEnd.KNOTS)
            with frame.where(several | (where & self.crosses(frame, StepEnd.KNOT, c))):
                # Where several coincide no rational directions of theirs cancel, to a jump of nothing.
                frame["hit", j], frame["is_hit"] = math.exp(k), code.select(several, HitKind.SEVERAL, HitKind.BORDER)
                if moves:
                    frame["entry", j] = self.piece(frame, j) + code.flag(frame["h"] > 0.0)
