"""Derivatives by the entries of a table that the time is on, where the acceleration jumps as it comes to one.

Up to the entry x the acceleration is a⁻, and from then on a⁺. To move x by δx moves the instant of the change by δx:

    δv⁺ = δv⁻ + (a⁻ − a⁺) δx          x̄ = λᵥ · (a⁻ − a⁺)

A table of numbers has no such derivatives, and nothing is done for it. Second ones by entries are NaN where the
acceleration jumps, and so are first ones by those of two tables that coincide: a⁻ − a⁺ is that of both.
"""

from collections.abc import Callable

from lagjax._native._constants import JUMP_NOISE
from lagjax._native._frame import Frame, Numbers
from lagjax._native._ir import Code, Value
from lagjax._native._taylor import TaylorSeries
from lagjax._program._borders import Borders
from lagjax._program._jump import Nesting
from lagjax._program._look_ups import Table, shifted


class TimeKnots:
    """The tables of a motion that the time is on, and whose entries are numbers of a member."""

    def __init__(self, motion: TaylorSeries, borders: Borders):
        self.motion, self.first = motion, len(borders.guards) + 1
        of_pieces = []
        for c, j in enumerate(borders.clocks):
            located = borders.tables[j]
            assert located is not None
            of_pieces.append((c, j, located.table))
        self.tables = [(c, j, table) for c, j, table in of_pieces if table.numbers is None]
        self.coincide = float(self.first + len(of_pieces))  # what is `crossed` where entries of two tables do

    @property
    def exist(self) -> bool:
        """True if there are any."""
        return bool(self.tables)

    def fields(self) -> dict:
        """The fields that a thread keeps from one step to the next: a⁻, the table, and its entry."""
        return {"before_knot": self.motion.n, "knot_of": 1, "knot": 1} if self.exist else {}

    def is_crossed(self, frame: Frame) -> Value:
        """True if a step ends at an entry of one of them, or of two tables."""
        crossed = frame["crossed"]
        found = frame.code.compare("==", crossed, self.coincide)
        for c, _, _ in self.tables:
            found = found | frame.code.compare("==", crossed, float(self.first + c))
        return found

    def index(self, frame: Frame, j: int) -> Value:
        """The number of the entry that the step ends at, of the table of piece j."""
        piece = frame["params", self.motion.parameters + j]
        return piece + frame.code.flag(frame["h"] > 0.0)

    def note(self, frame: Frame, accelerations: Numbers) -> None:
        """The accelerations before an entry, which table it is of, and its number."""
        code, crossed = frame.code, self.is_crossed(frame)
        frame["knot_of"] = code.select(crossed, frame["crossed"], 0.0)
        for i in self.motion.form.each(code, self.motion.n):
            frame["before_knot", i] = accelerations[i]
        for c, j, _ in self.tables:
            of = code.compare("==", frame["knot_of"], float(self.first + c))
            with frame.where(of):
                frame["knot"] = self.index(frame, j)

    def jump(self, code: Code, before: Numbers, after: Numbers) -> Callable:
        """`(i)`: a⁻ − a⁺ of coordinate i; zero where that is rounding."""

        def of(i):
            one, other = before[i], after[i]
            larger = code.maximum(code.intrinsic("fabs", one), code.intrinsic("fabs", other))
            return code.select(code.intrinsic("fabs", one - other) > JUMP_NOISE * larger, one - other, 0.0)

        return of

    # ---- forward ----

    def moved(self, frame: Frame, knot_of: Value, knot: Value, of: Callable[[Table], Table]) -> Value:
        """δx of the entry that was crossed, by the table `of(table)` of its tangents; NaN where two coincide."""
        code = frame.code
        total = code.select(code.compare("==", knot_of, self.coincide), frame.constant(float("nan")), 0.0)
        for c, _, table in self.tables:
            change = self.motion.look_up.take(frame, of(table), knot)
            total = code.select(code.compare("==", knot_of, float(self.first + c)), change, total)
        return total

    def jump_of_tangents(self, nesting: Nesting) -> Code:
        """`()`: the tangents of a motion with its tangents beyond the entry that was noted; see `Saltation`."""
        motion, n = self.motion, self.motion.n
        frame = motion.function("jump_at_knot")
        code, base = frame.code, nesting.base
        after = motion.evaluate_now(frame, motion.acceleration)
        jump, hit = self.jump(code, frame.vectors("before_knot", n), after), frame["knot_of"] > 0.0
        own = motion.of_member * base // n
        for level, (inner, directions) in enumerate(nesting.levels):
            for d in range(1, 1 + directions):
                shift = own * (inner // base) * d
                change = self.moved(frame, frame["knot_of"], frame["knot"], lambda t, s=shift: shifted(t, s))
                moves = hit & code.compare("!=", change, 0.0)
                for i in motion.form.each(code, inner):
                    change_of = change if level == 0 else frame.constant(float("nan"))
                    moved = code.select(moves & code.compare("!=", jump(i), 0.0), jump(i) * change_of, 0.0)
                    place = i + (n + d * inner)
                    frame["y", place] = frame["y", place] + moved
        return frame.finish()

    # ---- over steps that have been taken ----

    def note_end(self) -> Code:
        """`()`: note the entry that a step ends at, and the accelerations before it."""
        motion = self.motion
        frame = motion.function("note_knot")
        code = frame.code
        with code.only_if(code.any_lane(self.is_crossed(frame))):
            moved = motion.moved(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
            self.note(frame, motion.evaluate(frame, motion.acceleration, moved, frame["h"]))
        frame["knot_of"] = code.select(self.is_crossed(frame), frame["knot_of"], 0.0)
        return frame.finish()

    def moves(self, frame: Frame, base: int) -> Value | None:
        """True if the tangents of a motion with tangents jump at the end of a step: it has no derivatives there."""
        code, found = frame.code, None
        own = self.motion.of_member * base // self.motion.n
        for row in range(1, self.motion.n // base):
            for c, j, table in self.tables:
                change = self.motion.look_up.take(frame, shifted(table, own * row), self.index(frame, j))
                hit = code.compare("==", frame["crossed"], float(self.first + c))
                hit = (hit | code.compare("==", frame["crossed"], self.coincide)) & code.compare("!=", change, 0.0)
                found = hit if found is None else found | hit
        return found

    def cotangent(self, frame: Frame) -> tuple[Value, Value]:
        """x̄ of the entry at the end of a step, and where there is one: `after` holds a⁺, `state_ct` λ."""
        motion, code = self.motion, frame.code
        moved = motion.moved(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        before = motion.evaluate(frame, motion.acceleration, moved, frame["h"])
        jump = self.jump(code, before, frame.vectors("after", motion.n))
        total = code.total(frame["state_ct", i + motion.n] * jump(i) for i in motion.form.each(code, motion.n))
        return total, frame["has_after"] > 0.0
