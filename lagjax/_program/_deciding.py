"""The decisive operations of a program, and the borders next to which steps must end instead."""

from collections.abc import Sequence
from typing import NamedTuple

from lagjax._program._cones import find_cones
from lagjax._program._graph import find_ancestors
from lagjax._program._operations import COMPARISONS
from lagjax._program._series import Recurrent, StraightLine

PIECEWISE = {
    *COMPARISONS, "abs", "max", "min", "sign", "floor", "ceil", "trunc", "round", "rem", "convert", "locate", "atan2"
}  # fmt: skip
_SIGNS = (*COMPARISONS, "abs", "max", "min", "sign")
# Functions without a series where their first operand is zero, or ±1.
_SINGULAR_AT_ZERO, _SINGULAR_AT_ONE = ("sqrt", "rsqrt", "cbrt", "log", "pow"), ("log1p", "asin", "acos", "acosh")


class Deciding(NamedTuple):
    """The nodes of a program that decide, or depend on decisions.

    `decisive`: nodes on which q̈ or guards depend, without the `abrupt` ones, whose border is where a root has no
    series. `of_guards`: nodes on which guards alone depend. `cones`: nodes of lengths of velocities (`find_cones`).
    """

    line: StraightLine
    decisive: set[int]
    abrupt: set[int]
    of_guards: set[int]
    cones: dict[int, int]

    @classmethod
    def from_program(cls, program: Recurrent, size: int, slides: bool, watched: int, beside: bool) -> "Deciding":
        """The decisive nodes of a program whose first `size` outputs are q̈ and last `watched` outputs are guards.

        With `beside`, steps end next to the border of a choice under a root, even if the root is not zero there.
        """
        linear, line = program.linear, program.line
        roots = line.outputs[:size] if linear is None else [*linear.right, *linear.entries.values()]
        needed, every = set(find_ancestors(line.nodes, roots)), cls(line, set(), set(), set(), {})
        if linear is not None and linear.others:
            # Of what contacts bring into A pieces decide; friction stops, and turns, by watches of its own.
            needed |= {i for i in find_ancestors(line.nodes, linear.others.values()) if every.decides(i)}
        of_guards = set(find_ancestors(line.nodes, line.outputs[len(line.outputs) - watched :]))
        if watched:  # which may read the solution of a linear system, but not decide on its elimination
            needed |= of_guards - (set(find_ancestors(line.nodes, line.outputs[:size])) - needed)
        cones = find_cones(line, size, linear) if slides else {}
        abrupt = cls(line, needed, set(), of_guards, cones)._find_abrupt_decisions(beside)
        return cls(line, needed - abrupt, abrupt, of_guards, cones)

    def _find_abrupt_decisions(self, beside: bool) -> set[int]:
        """The decisions at whose border a root, or another singular function, has no series."""
        nodes, needed = self.line.nodes, self.decisive

        def bases_of(operations):
            return {self.base(nodes[i][1][0]) for i in needed if nodes[i][0] in operations}

        at_zero, at_one = bases_of(_SINGULAR_AT_ZERO), bases_of(_SINGULAR_AT_ONE)
        if not at_zero | at_one:
            return set()
        selects = [i for i in at_zero if nodes[i][0] == "select"]
        below = at_one | at_zero if beside else at_one
        out = set(find_ancestors(nodes, [nodes[i][1][0] for i in below if nodes[i][0] == "select"]))
        for i in selects:
            condition, *branches = nodes[i][1]
            deciding = {j: self.compared(j) for j in find_ancestors(nodes, [condition])}
            out |= {j for j, equal in deciding.items() if equal and any(self._may_vanish(x, equal) for x in branches)}
            bases = {self.base(x) for x in branches} - at_zero
            at_zero |= bases
            selects += [x for x in bases if nodes[x][0] == "select"]
        for i in needed:
            op, operands, _ = nodes[i]
            if op in _SIGNS:
                level = [nodes[x][2] for x in operands if nodes[x][0] == "constant"] or [0.0] * (len(operands) == 1)
                singular = (at_one if level[0] else at_zero) if level else set()
                if not singular.isdisjoint({i, *(self.base(x) for x in operands)}):
                    out.add(i)
        # What else is decided at the same border is decided beside it: no step may end where the root has no series.
        abrupt = {self.compared(i) for i in out} - {None}
        return {i for i in needed if i in out or self.compared(i) in abrupt} - self.cones.keys()

    def _may_vanish(self, i: int, equal: frozenset[int]) -> bool:
        """True if node i may be zero where the numbers `equal` are equal, or where the only one of them is zero."""
        op, operands, attribute = self.line.nodes[i]
        if op in ("input", "constant"):
            return equal == {i} or (attribute == 0.0 and op == "constant")
        if equal in ({self.base(i)}, {self.base(x) for x in operands}):
            return True
        return (all if op in ("add", "sub") else any)(self._may_vanish(x, equal) for x in operands)

    def compared(self, i: int) -> frozenset[int] | None:
        """The nodes that are equal at the border of comparison i, or the one that is zero; None if i is none."""
        nodes = self.line.nodes
        op, operands, _ = nodes[i]
        if op not in (*_SIGNS, "eq", "ne"):
            return None
        return frozenset(self.base(x) for x in operands if nodes[x][0] != "constant" or nodes[x][2] != 0)

    def base(self, i: int) -> int:
        """The node of which node i is a constant multiple, perhaps itself."""
        op, operands, _ = self.line.nodes[i]
        others = [x for x in operands if op == "neg" or self.line.nodes[x][0] != "constant"]
        return self.base(others[0]) if op in ("neg", "mul") and len(others) == 1 else i

    def decides(self, i: int) -> bool:
        (op, operands, attribute), kinds = self.line.nodes[i], self.line.kinds
        if op == "convert":
            return kinds[operands[0]] == "float" and attribute not in ("float", "bool")
        return op in PIECEWISE and all(kinds[x] == "float" for x in operands)


def inputs_below(line, roots: Sequence[int]) -> frozenset[int]:
    """The positions of the inputs on which the nodes `roots` of a line or graph depend."""
    return frozenset(line.nodes[i][2] for i in find_ancestors(line.nodes, roots) if line.nodes[i][0] == "input")
