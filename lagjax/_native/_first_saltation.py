"""The jumps of tangents at a border where a program looks up entries of tables: first derivatives alone.

The border is crossed at another time when the motion is varied, δt = −δu / u̇ with its switching number u. Up to then
the acceleration is a⁻, and from then on a⁺, so that

    δv⁺ = δv⁻ + (a⁻ − a⁺) δt          λ⁻ = λ⁺ − ∇u (λᵥ · (a⁻ − a⁺)) / u̇

while δq stays as it is. Where a is continuous nothing happens. Source: Aizerman & Gantmakher, Q. J. Mech. Appl. Math.
11 (1958) 225; Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204, §III.

A motion with tangents, of which tangents are taken again, is a motion of its own: where its own tangents jump too,
second derivatives are NaN.
"""

import itertools
from collections.abc import Callable, Iterator

from lagjax._native._constants import JUMP_NOISE
from lagjax._native._frame import Frame, Index, Numbers
from lagjax._native._ir import Code, Value
from lagjax._native._saltation import GuardTable
from lagjax._native._taylor import TaylorSeries
from lagjax._program._borders import Borders, gradient
from lagjax._program._jump import Nesting
from lagjax._program._look_ups import Table, shifted


class FirstSaltation:
    """The jumps of a motion with nested tangents."""

    def __init__(self, motion: TaylorSeries, borders: Borders, nesting: Nesting):
        self.motion, self.nesting, self.pieces = motion, nesting, motion.pieces
        self.base, n = nesting.base, nesting.size
        self.parameters = motion.parameters * self.base // n  # of the motion alone
        self.by = [*range(self.base), *range(n, n + self.base), *(2 * n + i for i in range(1 + self.parameters))]
        self.line, self.tables = gradient(borders, self.by)
        self.levels_move = borders.levels_move

    @property
    def slopes(self) -> int:
        """The length of its gradient, with the numbers of tables."""
        return len(self.by) + 2 * len(self.tables)

    @staticmethod
    def fields(pieces: int, size: int) -> dict:
        """The fields of a thread's memory: a⁻, which switching number is crossed, and at which entry of its table."""
        return {"rate_before": size, "hit": pieces, "entry": pieces, "is_hit": 1}

    # ---- what both directions need ----

    def gradient_at(self, frame: Frame, state: Numbers, time: Numbers) -> tuple[Numbers, Value]:
        """∂u/∂(q, q̇, t, params) of the switching number that is `hit`, and its rate u̇ with the accelerations a⁻."""
        motion, code = self.motion, frame.code
        chosen = [frame.vectors(name, self.pieces) for name in (("entry", "hit") if self.levels_move else ("hit",))]
        out = motion.form.run(frame, self.line, state, time, frame.vectors("params", motion.numbers), *chosen)
        moved = (
            out[i] * state[i + motion.n] + out[i + self.base] * frame["rate_before", i]
            for i in motion.form.each(code, self.base)
        )
        return out, code.total(moved, out[2 * self.base])

    def by_entries(self, frame: Frame, slopes: Numbers, of: Callable[[Table], Table]) -> Iterator[Value]:
        """The parts of δu by entries of tables, whose tangents are the entries of the table `of(table)`."""
        for k, table in enumerate(self.tables):
            first = len(self.by) + 2 * k
            yield slopes[first + 1] * self.motion.look_up.take(frame, of(table), slopes[first])

    def note_hit(self, frame: Frame, table: GuardTable) -> None:
        """Set `hit` for the switching number of the guard `crossed`; for none where a motion begins on the border."""
        code = frame.code
        frame["is_hit"] = 0.0
        with code.loop(self.pieces) as j:
            frame["hit", j] = frame["entry", j] = 0.0
        with code.loop(table.guards) as g:
            j = table.place(code, g, "piece")
            piece = frame["params", j + self.motion.parameters]
            side = piece * table.number(code, g, "a") + table.number(code, g, "b")
            hit = code.compare("==", frame["crossed"], code.lanes_of(code.as_double(g + 1)))
            hit = hit & code.compare("!=", side, 0.0)
            with frame.where(hit):
                frame["hit", j] = 1
                frame["entry", j] = piece + table.number(code, g, "e")
                frame["is_hit"] = 1

    def jump(self, frame: Frame, after: Numbers) -> Callable:
        """`(i)`: a⁻ − a⁺ of coordinate i; zero where that is rounding."""
        code = frame.code

        def of(i):
            one, other = frame["rate_before", i], after[i]
            larger = code.maximum(code.intrinsic("fabs", one), code.intrinsic("fabs", other))
            difference = one - other
            return code.select(code.intrinsic("fabs", difference) > JUMP_NOISE * larger, difference, 0.0)

        return of

    def jumps(self, frame: Frame, jump: Callable) -> Value:
        """True if the acceleration of the motion itself jumps."""
        code = frame.code
        sizes = (code.intrinsic("fabs", jump(i)) for i in self.motion.form.each(code, self.base))
        return ~(code.total(sizes) <= 0.0)

    # ---- forward ----

    def note(self, table: GuardTable) -> Code:
        """`()`: the accelerations before the border, into `rate_before`, and which switching number is zero there."""
        frame = self.motion.function("note_before")
        before = self.motion.evaluate_now(frame, self.motion.acceleration)
        for i in self.motion.form.each(frame.code, self.motion.n):
            frame["rate_before", i] = before[i]
        self.note_hit(frame, table)
        return frame.finish()

    def apply(self) -> Code:
        """`()`: the tangents beyond the border that is `hit`, on the pieces there."""
        frame = self.motion.function("jump_of_tangents")
        motion, code, n = self.motion, frame.code, self.motion.n
        state, time, _ = motion.now(frame)
        slopes, rate = self.gradient_at(frame, state, time)
        after = motion.evaluate_now(frame, motion.acceleration)
        jump, is_hit = self.jump(frame, after), frame["is_hit"] > 0.0
        jumps = self.jumps(frame, jump)
        for level, (inner, directions) in enumerate(self.nesting.levels):
            numbers = self.parameters * inner // self.base
            for d in range(1, 1 + directions):
                by_state = (
                    slopes[i] * state[i + d * inner] + slopes[i + self.base] * state[i + (n + d * inner)]
                    for i in motion.form.each(code, self.base)
                )
                by_parameters = (
                    slopes[k + (2 * self.base + 1)] * frame["params", k + d * numbers]
                    for k in motion.form.each(code, self.parameters)
                )
                shift = d * motion.of_member * inner // n
                entries = self.by_entries(frame, slopes, lambda table, shift=shift: shifted(table, shift))
                delay = 0.0 - code.total(itertools.chain(by_state, by_parameters, entries)) / rate
                for i in motion.form.each(code, self.base):
                    self._move(frame, n + d * inner, i, jump, is_hit, delay)
                if level:
                    delay = code.select(jumps, float("nan"), delay)
                    for i in motion.form.each(code, inner - self.base):
                        self._move(frame, n + d * inner, i + self.base, jump, is_hit, delay, jumps)
        return frame.finish()

    def _move(self, frame: Frame, first: int, i: Index, jump: Callable, is_hit: Value, delay, always=None) -> None:
        """The velocity of coordinate i of a direction, whose velocities begin at `first`."""
        code, of_i = frame.code, jump(i)
        moves = code.compare("!=", of_i, 0.0)
        moves = moves if always is None else moves | always
        frame["y", i + first] = frame["y", i + first] + code.select(is_hit & moves, of_i * delay, 0.0)

    # ---- over steps that have been taken ----

    def at_end(self, frame: Frame, table: GuardTable) -> tuple[Numbers, Value]:
        """∂u/∂(q, q̇, t, params) at the end of a step, and u̇, of the switching number that is zero there.

        The accelerations before the border go into `rate_before`.
        """
        motion = self.motion
        self.note_hit(frame, table)
        moved = motion.moved(frame, motion.increments(frame, frame.job("order"), frame["h"])[0])
        before = motion.evaluate(frame, motion.acceleration, moved, frame["h"])
        for i in motion.form.each(frame.code, motion.n):
            frame["rate_before", i] = before[i]
        return self.gradient_at(frame, moved, [frame["t"] + frame["h"]])

    def gain(self, frame: Frame, rate: Value) -> Value:
        """The multiple of ∂u that the cotangents gain: `after` holds a⁺, `state_ct` the cotangent behind the border."""
        motion, code = self.motion, frame.code
        jump = self.jump(frame, frame.vectors("after", motion.n))
        total = code.total(frame["state_ct", i + motion.n] * jump(i) for i in motion.form.each(code, motion.n))
        jumps = self.jumps(frame, jump)
        gain = code.select(code.compare("!=", total, 0.0), 0.0 - total / rate, 0.0)
        if self.nesting.directions:
            gain = code.select(jumps, float("nan"), gain)
        return code.select(frame["is_hit"] > 0.0, gain, 0.0)

    def fields_along(self) -> dict:
        """The fields that a thread keeps from one step to the next, for tangents."""
        return {"slopes": self.slopes, "rate": 1, "jump": self.motion.n, "jumps": 1}

    def note_end(self, table: GuardTable) -> Code:
        """`()`: note the gradient and the rate of the border that a step ends at."""
        frame = self.motion.function("note_end")
        code = frame.code
        frame["is_hit"] = 0.0
        with code.only_if(code.any_lane(frame["crossed"] > 0.0)):
            slopes, frame["rate"] = self.at_end(frame, table)
            for i in self.motion.form.each(code, self.slopes):
                frame["slopes", i] = slopes[i]
        return frame.finish()

    def note_begin(self) -> Code:
        """`()`: the jump of the accelerations, where the next step begins."""
        frame = self.motion.function("note_begin")
        code, n = frame.code, self.motion.n
        with code.only_if(code.any_lane(frame["is_hit"] > 0.0)):
            after = frame.vectors("y", n, lambda i: (i + n, 1))
            jump = self.jump(frame, after)
            for i in self.motion.form.each(code, n):
                frame["jump", i] = code.select(frame["is_hit"] > 0.0, jump(i), 0.0)
            frame["jumps"] = self.jumps(frame, jump)
        return frame.finish()
