"""Narrow features: functions that are flat to rounding until their argument comes near.

There they change within a unit of it, as exp(u) does beyond u = −80, and powers with a base that falls, or rises, by
much (`_powers`). No series of the motion shows one from afar, but its argument has one.
"""

import math
from typing import NamedTuple

from lagjax._program._graph import Graph
from lagjax._program._operations import GROWING, OPERATIONS
from lagjax._program._powers import LEAST_POWER
from lagjax._program._recurrences import LARGEST_WHOLE

# What a function is flat like: exp(u) below, exp(−|u|) on both sides, or zero up to a border; and in which units of its
# argument. Of powers these are exponents: |u| to the minus `scale` grows as |u| falls, u to the `scale` as it grows
# from what is nothing.
BELOW, BESIDE, UP_TO, FALLS, GROWS = range(5)
_FUNCTIONS = {
    "exp": (BELOW, 1.0), "exp2": (BELOW, math.log(2.0)), "expm1": (BELOW, 1.0), "logistic": (BESIDE, 1.0),
    "tanh": (BESIDE, 2.0), "sinh": (BESIDE, 2.0), "cosh": (BESIDE, 2.0), "erf": (BELOW, 1.0), "erfc": (BELOW, 1.0),
}  # fmt: skip
WITH_FEATURES = frozenset((*_FUNCTIONS, "pow"))


class Feature(NamedTuple):
    """A narrow feature: what it is flat like, and in which units of its argument, or to which power of it."""

    kind: int
    scale: float


class Moving:
    """A test which nodes of a graph change along a motion, not only in steps; its first inputs, `count` of them, do."""

    def __init__(self, graph: Graph, count: int):
        self.graph, self.count = graph, count
        self._known: list[bool] = []

    def __call__(self, x: int) -> bool:
        known = self._known
        for op, operands, attribute in self.graph.nodes[len(known) :]:
            is_step = op not in ("input", "constant") and OPERATIONS[op].is_step
            known.append(attribute < self.count if op == "input" else not is_step and any(known[i] for i in operands))
        return known[x]


class Features:
    """The features of a program, `found` by their argument, a node of a graph, and their kind."""

    def __init__(self, graph: Graph, moves: Moving):
        self.graph, self.moves = graph, moves
        self.found: dict[tuple[int, int], Feature] = {}

    def note(self, u: int, kind: int, scale: float) -> None:
        """A function of u, as a feature if u moves."""
        if self.moves(u):
            known = self.found.get((u, kind), Feature(kind, scale))
            self.found[u, kind] = Feature(kind, max(scale, known.scale))

    def note_operation(self, op: str, operands: list[int]) -> None:
        """A function that is flat, or a power with an exponent that is no constant."""
        f, u = self.graph.apply, operands[0]
        if op in ("erf", "erfc"):  # whose slope is exp(−u²)
            u = f("neg", f("mul", u, u))
        if op in _FUNCTIONS:
            self.note(u, *_FUNCTIONS[op])
        elif op == "pow" and self.graph.value(operands[1]) is None:
            self._note_exponent(*operands)

    def note_power(self, base: int, exponent: float) -> None:
        """A power of a number: one that is to be large by its square, and sums of exponentials by their arguments."""
        op, operands, _ = self.graph.nodes[base]
        if op in ("exp", "exp2"):
            self.note(self.graph.scale(exponent, operands[0]), *_FUNCTIONS[op])
        elif exponent > 0:
            self.note(self.graph.apply("mul", base, base), GROWS, exponent / 2)
        elif arguments := self._moving_exponents(base):
            for u in arguments:
                self.note(u, BESIDE, -exponent)
        else:
            self.note(base, FALLS, -exponent)

    def _moving_exponents(self, i: int) -> list[int]:
        """The arguments of the exponentials that a sum consists of, but for what does not move; none of others."""
        op, operands, _ = self.graph.nodes[self.graph.term(i)[1]]
        if op in ("add", "sub"):
            found = [self._moving_exponents(x) for x in operands if self.moves(x)]
            return [u for some in found for u in some] if all(found) else []
        return [operands[0]] if op in GROWING else []

    def _note_exponent(self, a: int, b: int) -> None:
        """aᵇ = exp(b log |a|), where b is no constant."""
        f, one = self.graph.apply, self.graph.number(1.0)
        base = f("mul", a, a) if self.moves(a) else a
        if not self.moves(b):  # then it is told as a constant would be: there is no log at a = 0
            bounds = (0.0, LEAST_POWER, LARGEST_WHOLE)
            falls, is_seen, grows = (f("lt", b, self.graph.number(bound)) for bound in bounds)
            large = f("and", grows, f("not", is_seen))
            self.note(f("select", large, one, base), GROWS, LARGEST_WHOLE / 2)
            base = f("select", f("or", falls, f("not", grows)), one, base)
        log = self.graph.scale(0.5, f("log", base)) if self.moves(a) else f("log", base)
        self.note(f("mul", log, b), BELOW, 1.0)
