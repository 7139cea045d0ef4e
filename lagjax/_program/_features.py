"""Narrow features: functions that are constant to rounding until their argument comes near a value.

Near it they change within one unit of the argument: exp(u) beyond u = −80, or a power whose base changes by orders of
magnitude (`_powers`). The series of the motion does not show a feature in advance, but that of its argument does.
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
    """A narrow feature: the kind of function, and the scale of its argument or the exponent of a power."""

    kind: int
    scale: float


class MovingNodes:
    """A callable: True for nodes that vary continuously along a motion; the first `count` inputs of the graph do."""

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
    """The narrow features of a program: `found` maps (argument node, kind) to a feature."""

    def __init__(self, graph: Graph, moves: MovingNodes):
        self.graph, self.moves = graph, moves
        self.found: dict[tuple[int, int], Feature] = {}

    def record(self, u: int, kind: int, scale: float) -> None:
        """Record a feature with argument u, if u varies; of two of one kind the larger scale is kept."""
        if self.moves(u):
            known = self.found.get((u, kind), Feature(kind, scale))
            self.found[u, kind] = Feature(kind, max(scale, known.scale))

    def record_operation(self, op: str, operands: list[int]) -> None:
        """Record the feature of a function that is flat, or of a power with a variable exponent."""
        f, u = self.graph.apply, operands[0]
        if op in ("erf", "erfc"):  # whose slope is exp(−u²)
            u = f("neg", f("mul", u, u))
        if op in _FUNCTIONS:
            self.record(u, *_FUNCTIONS[op])
        elif op == "pow" and self.graph.value(operands[1]) is None:
            self._record_exponent(*operands)

    def record_power(self, base: int, exponent: float) -> None:
        """Record the feature of a power: a positive one by its squared base, one of exponentials by arguments."""
        op, operands, _ = self.graph.nodes[base]
        if op in ("exp", "exp2"):
            self.record(self.graph.scale(exponent, operands[0]), *_FUNCTIONS[op])
        elif exponent > 0:
            self.record(self.graph.apply("mul", base, base), GROWS, exponent / 2)
        elif arguments := self._moving_exponents(base):
            for u in arguments:
                self.record(u, BESIDE, -exponent)
        else:
            self.record(base, FALLS, -exponent)

    def _moving_exponents(self, i: int) -> list[int]:
        """The arguments of the exponentials that sum i consists of, up to constant terms; empty for other nodes."""
        op, operands, _ = self.graph.nodes[self.graph.term(i)[1]]
        if op in ("add", "sub"):
            found = [self._moving_exponents(x) for x in operands if self.moves(x)]
            return [u for some in found for u in some] if all(found) else []
        return [operands[0]] if op in GROWING else []

    def _record_exponent(self, a: int, b: int) -> None:
        """Record the feature of aᵇ = exp(b log |a|), where b is not a constant."""
        f, one = self.graph.apply, self.graph.number(1.0)
        base = f("mul", a, a) if self.moves(a) else a
        if not self.moves(b):  # then it is told as a constant would be: there is no log at a = 0
            bounds = (0.0, LEAST_POWER, LARGEST_WHOLE)
            falls, is_seen, grows = (f("lt", b, self.graph.number(bound)) for bound in bounds)
            large = f("and", grows, f("not", is_seen))
            self.record(f("select", large, one, base), GROWS, LARGEST_WHOLE / 2)
            base = f("select", f("or", falls, f("not", grows)), one, base)
        log = self.graph.scale(0.5, f("log", base)) if self.moves(a) else f("log", base)
        self.record(f("mul", log, b), BELOW, 1.0)
