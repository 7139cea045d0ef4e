"""The decisions of a program: each piecewise operation becomes an input, its piece, that a switching number determines.

    operation                           piece
    comparisons, abs, max, min, sign    the sign of a switching number u: −1, 0 or 1
    floor, ceil, round                  the whole number below a switching number x
    rem, trunc, conversion to integers  the whole number between x and zero
    atan2(y, x)                         the sign of x, and where that is negative the sign of y: its branch cut
    look-ups (`locate`)                 the interval of an increasing table that contains x
    u / |u| of velocities               1 if the vector u moves, −1 if it rests: dry friction in the plane

With its pieces as inputs a program is smooth along every step; the series of the switching numbers, which are outputs
as well, tell when a piece changes.

`eq` and `ne`, whose border is a point, and what is constant along the motion are not decisions. Where a root or a
non-whole power is zero at a border, as in max(q, 0)**1.5, no series starts from there: such a border is not a piece but
a *feature*, and a step that is to pass it begins next to it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lagjax._program._cones import list_squares
from lagjax._program._deciding import PIECEWISE, Deciding, inputs_below
from lagjax._program._differentiation import gradient_in
from lagjax._program._features import UP_TO, WITH_FEATURES, Feature, Features, MovingNodes
from lagjax._program._graph import Graph
from lagjax._program._levels import CLOCK, CONE, FAR, FLOOR, NOTHING, SIGN, TABLE, TRUNC, Decision
from lagjax._program._operations import COMPARISONS, LOOK_UPS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._powers import find_powers
from lagjax._program._series import LinearSystem, Recurrent, StraightLine
from lagjax._program._simplify import is_nonnegative

LARGEST_REWRITING = 10  # operations that one may become: a bound for errors, three are usual
_RATIO_TOLERANCE = 1e-9  # of a ratio that is the same at all states: a million roundings


class DecidedProgram(NamedTuple):
    """A program of q (n,), q̇, t and parameters with its pieces as further inputs, from position `first` on.

    `pieces` are the nodes of these inputs; an output jumps with those in `jumping`. `parts` maps the piece of a cone to
    the nodes of its vector. `features` are pairs (argument, feature), sorted by feature.
    """

    line: StraightLine
    n: int
    first: int
    linear: LinearSystem | None
    decisions: tuple[Decision, ...]
    pieces: tuple[int, ...]
    jumping: frozenset[int]
    parts: dict[int, tuple[int, ...]]
    features: tuple[tuple[int, Feature], ...]

    @property
    def switches(self) -> list[int]:
        return [decision.switch for decision in self.decisions]


class _SwitchingNumbers:
    """The decisions of a graph, and their switching numbers; `moves(x)` is true for nodes that vary along a motion.

    If piece `apart` is set, the program is written twice, once for each value `side` of that piece.
    """

    def __init__(self, graph: Graph, moves: MovingNodes, first: int, apart: int | None):
        self.graph, self.moves, self.first, self.apart = graph, moves, first, apart
        self.decisions: list[Decision] = []
        self.pieces: list[int] = []
        self.jumping: set[int] = set()
        self.side: float | None = None
        self._known: dict[tuple, int] = {}
        self._signs: dict[frozenset[int], dict[int, np.ndarray]] = {}  # the values of switching numbers of signs

    def piece(self, kind: int, x: int, table=None) -> int | None:
        """The node of the piece of number x, for a decision of this kind; None if x is constant along the motion."""
        if not self.moves(x):
            return None
        decision = Decision(kind, x, table)
        if decision not in self._known:
            self._known[decision] = len(self.decisions)
            self.pieces.append(self.graph.input(self.first + len(self.decisions), "float"))
            self.decisions.append(decision)
        j = self._known[decision]
        return self.pieces[j] if j != self.apart or self.side is None else self.graph.number(self.side)

    def find_sign(self, x: int) -> int | None:
        """The piece of the sign of x if that decision exists already, else None."""
        return self.piece(SIGN, x) if Decision(SIGN, x) in self._known else None

    def record_jump(self, sign: int) -> None:
        """Record that the program jumps where this sign changes."""
        self.jumping.add(self.graph.term(sign)[1])

    def sign(self, u: int) -> int | None:
        """The sign of u as ± the piece of the number of which u is a multiple; None if u is constant in time.

        The sign of |x| is the square of the piece of x, 0 at its border and else 1, and no decision of its own.
        """
        if (magnitude := self.magnitude(u)) is not None:
            coefficient, _, piece = magnitude
            piece = self.graph.apply("mul", piece, piece)
        else:
            coefficient, base = self.graph.term(u)
            piece = self._find_multiple(base) or self.piece(SIGN, base)
        return piece if piece is None or coefficient > 0 else self.graph.apply("neg", piece)

    def magnitude(self, x: int) -> tuple[float, int, int] | None:
        """If x is c |y|, written as y times its sign: c, y and the piece of y; else None."""
        b, size = self.graph.term(x)
        op, operands, _ = self.graph.nodes[size]
        for piece, y in (operands, operands[::-1]) if op == "mul" else ():
            c, base = self.graph.term(y)
            if self.find_sign(base) == piece:
                return b * c, base, piece
        return None

    def _find_multiple(self, x: int) -> int | None:
        """The sign of x by an existing piece, if x is a constant multiple of that switching number; else None.

        Two pieces with the same border would each slide along it, or not, as if the second one did not change.
        """
        graph, f, below = self.graph, self.graph.apply, self.graph.find_ancestors([x])
        inputs, first = inputs_below(graph, [x]), self.moves.count
        # A few states say nothing of numbers that are chosen.
        chosen = not {"select", *LOOK_UPS, *PIECEWISE}.isdisjoint(graph.nodes[i][0] for i in below)
        if not self.moves(x) or Decision(SIGN, x) in self._known or chosen or max(inputs) >= self.first:
            return None
        # Of two draws of params, and four states each.
        columns = {i: np.random.default_rng(i).uniform(0.3, 1.2, (2, 4)) for i in inputs}
        columns |= {i: np.repeat(columns[i][:, :1], 4, 1) for i in inputs if first <= i < self.first}
        given = [columns.get(i, columns[min(inputs)]).ravel() for i in range(1 + max(inputs))]
        values = eliminate_dead_code(graph, [x]).evaluate(given).reshape(2, 4)
        others = self._signs.setdefault(frozenset(i for i in inputs if i < first), {})
        for y, ratio in ((y, values / of) for y, of in others.items()):
            if not np.ptp(ratio, axis=1).max() <= _RATIO_TOLERANCE * np.abs(ratio).min():
                continue
            nodes = list(range(len(graph.nodes)))
            product = f("mul", *(gradient_in(graph, graph, nodes, z, [min(inputs)])[0] for z in (x, y)))
            if self.moves(product) and np.ptp(ratio) > _RATIO_TOLERANCE * np.abs(ratio).max():
                continue
            sign = graph.number(math.copysign(1.0, ratio[0, 0])) if self.moves(product) else f("sign", product)
            known = self.find_sign(y)
            assert known is not None
            return f("mul", sign, known)
        others[x] = values
        return None


class _PieceRewriter:
    """The rewriting of a program, node by node: `places` has the id of each node in the graph with pieces."""

    def __init__(self, program: Recurrent, size: int, deciding: Deciding, apart: int | None):
        self.program, self.line, self.deciding = program, program.line, deciding
        self.graph = Graph(LARGEST_REWRITING * len(program.line.nodes) + 1000)
        moves = MovingNodes(self.graph, 2 * size + 1)
        self.switches = _SwitchingNumbers(self.graph, moves, program.size, apart)
        self.features = Features(self.graph, moves)
        self.parts: dict[int, tuple[int, ...]] = {}
        self.places: list[int] = []
        self._extremes: dict[int, tuple] = {}  # what max and min became
        compared = {deciding.compared(i) for i in deciding.decisive if self.line.nodes[i][0] not in ("eq", "ne")}
        self.borders_of_decisions = compared - {None}

    def rewrite_nodes(self) -> None:
        every = range(len(self.line.nodes))
        if self.switches.apart is None:
            self._rewrite_each(every)
            return
        relevant, sides = self.deciding.decisive | self.deciding.abrupt, []
        for side in (-1.0, 1.0):
            self.places, self.switches.side = [], side
            self._rewrite_each(every)
            sides.append(self.places)
        self.places, self.switches.side = [], None
        piece = self.switches.pieces[self.switches.apart]
        self.switches.jumping.add(piece)
        is_above = self.graph.apply("gt", piece, self.graph.number(0.0))
        for i, (below, above) in enumerate(zip(*sides, strict=True)):
            if i not in relevant:
                self._rewrite_each([i])
            else:
                self.places.append(below if below == above else self.graph.apply("select", is_above, below, above))

    def _rewrite_each(self, nodes: Sequence[int]) -> None:
        graph, deciding = self.graph, self.deciding
        for i in nodes:
            (op, operands, attribute), kind = self.line.nodes[i], self.line.kinds[i]
            of = [self.places[x] for x in operands]
            if op in ("input", "constant"):
                self.places.append(getattr(graph, op)(attribute, kind))
                continue
            decided = self._result_by_piece(i, op, of, attribute) if i in deciding.decisive else None
            if decided is None and op in ("eq", "ne") and (sign := self._known_sign(i, *of)) is not None:
                decided = graph.apply(op, sign, graph.number(0.0))
            if decided is None and op == "div":
                decided = self._decide_direction(*of)
            if decided is None and i in deciding.abrupt and deciding.decides(i):
                self._record_border(op, of)
            self.places.append(graph.node(op, *of, attribute=attribute) if decided is None else decided)

    def _record_border(self, op: str, of: list[int]) -> None:
        if op in (*COMPARISONS, "max", "min", "abs", "sign"):
            u = of[0] if op in ("abs", "sign") else self.graph.apply("sub", *of)
            self.features.record(self.graph.term(u)[1], UP_TO, 1.0)

    def _result_by_piece(self, i: int, op: str, of: list[int], attribute) -> int | None:
        """The node of a decisive operation by its piece; None if it has none."""
        if i in self.deciding.cones:
            return self._decide_cone(i, op, of)
        self.features.record_operation(op, of)
        if not self.deciding.decides(i) or (op == "atan2" and is_nonnegative(self.line, self.line.nodes[i][1][1])):
            return None
        if op in (*COMPARISONS, "max", "min", "abs", "sign"):
            return self._decide_by_sign(op, of)
        return self._decide_angle(*of) if op == "atan2" else self._decide_by_whole(op, of, attribute)

    def _decide_by_sign(self, op: str, of: list[int]) -> int | None:
        f, zero = self.graph.apply, self.graph.number(0.0)
        sign = self.switches.sign(of[0] if op in ("abs", "sign") else f("sub", *of))
        if sign is None:
            return None
        if op in (*COMPARISONS, "sign"):
            self.switches.record_jump(sign)
            return sign if op == "sign" else f(op, sign, zero)
        if op == "abs":
            return f("mul", sign, of[0])
        extreme = f("select", f("gt" if op == "max" else "lt", sign, zero), of[1], of[0])
        self._extremes[extreme] = op, *of
        return extreme

    def _decide_by_whole(self, op: str, of: list[int], attribute) -> int | None:
        f, piece, x = self.graph.apply, self.switches.piece, of[0]
        if op == "locate":
            is_time = self.graph.nodes[x][:1] + self.graph.nodes[x][2:] == ("input", self.switches.moves.count - 1)
            return piece(CLOCK if is_time else TABLE, x, attribute)
        if op in ("floor", "round"):
            return piece(FLOOR, x if op == "floor" else f("add", x, self.graph.number(0.5)))
        whole = piece(FLOOR, f("neg", x)) if op == "ceil" else piece(TRUNC, f("div", *of) if op == "rem" else x)
        if whole is None or op == "trunc":
            return whole
        if op == "rem":
            return f("sub", x, f("mul", whole, of[1]))
        return f("neg", whole) if op == "ceil" else f("convert", whole, attribute=attribute)

    def _decide_angle(self, y: int, x: int) -> int | None:
        """The node of atan2(y, x) by the side of its branch cut (y = 0, x < 0); None if no motion crosses that.

        y is the switching number only where x < 0, so that an angle of zero is no border; nothing jumps at x = 0.
        """
        f, number, sign = self.graph.apply, self.graph.number, self.switches.sign
        half = sign(x)
        beside = f("lt", x if half is None else half, number(0.0))
        side = sign(f("select", beside, number(FAR), y))
        jumps = half if side is None else side  # where y stays as it is, it may be zero
        if jumps is None:
            return None
        self.switches.record_jump(jumps)
        angle = f("atan2", y, x)
        # What rounding has put on the other side is brought back, by a whole turn.
        above = f("select", f("prefers", number(0.0), angle), number(0.0), number(2 * math.pi))
        below = f("select", f("prefers", angle, number(0.0)), number(0.0), number(-2 * math.pi))
        back = f("select", f("ge", y if side is None else side, number(0.0)), below, above)
        return f("add", angle, f("select", beside, number(0.0), back))

    def _known_sign(self, i: int, a: int, b: int) -> int | None:
        """The node whose being zero means a == b, where existing pieces decide that; i is the comparison. Else None.

        For x == max(x, y), which is true where x is larger: 0 there, and else 1.
        """
        f, zero = self.graph.apply, self.graph.number(0.0)
        for x, z in ((a, b), (b, a)):
            op, *of = self._extremes.get(z, ("",))
            if x in of:
                sign = self.switches.sign(f("sub", *of))
                assert sign is not None
                larger = sign if x == of[0] else f("neg", sign)
                return f("select", f("ge" if op == "max" else "le", larger, zero), self.graph.number(1.0), zero)
        if self.graph.kinds[a] != "float" or self.graph.kinds[b] != "float":
            return None
        if self.deciding.compared(i) in self.borders_of_decisions:  # which may come later in the program
            return self.switches.sign(f("sub", a, b))
        return self.switches.find_sign(self.graph.term(f("sub", a, b))[1])

    # ---- quotients ----

    def _decide_cone(self, i: int, op: str, of: list[int]) -> int:
        """The node of a root of a sum of squares (1 at rest), or of a comparison of it, by the piece of the cone."""
        graph, f, square = self.graph, self.graph.apply, self.places[self.deciding.cones[i]]
        one, tiny = graph.number(1.0), graph.number(NOTHING**2)
        piece = self.switches.piece(CONE, f("sqrt", f("add", square, tiny)))
        assert piece is not None
        self.parts[piece] = tuple(self.places[x] for x in list_squares(self.line, self.deciding.cones[i]) or ())
        moves = f("gt", piece, graph.number(0.0))
        if op in ("sqrt", "rsqrt"):
            return f(op, f("select", moves, one, f("add", of[0], tiny)))
        is_first = graph.value(of[0]) is None
        if op == "select":
            return of[1] if graph.value(of[1]) is None else of[2]
        if op == "max":
            return f("select", moves, one, of[0] if is_first else of[1])
        says_moving = op == "ne" or op in (("gt", "ge") if is_first else ("lt", "le"))
        return moves if says_moving else f("not", moves)

    def _decide_direction(self, x: int, size: int) -> int | None:
        """The node of x / |x| as the piece of x, which is defined at x = 0; None for other quotients.

        A `where` may replace the size by a number where it is zero.
        """
        op, operands, _ = self.graph.nodes[size]
        if op != "select":
            return self._sign_of_quotient(x, size)
        quotients = [self._sign_of_quotient(x, y) for y in operands[1:]]
        if quotients == [None, None]:
            return None
        branches = [q or self.graph.apply("div", x, y) for q, y in zip(quotients, operands[1:], strict=True)]
        return self.graph.apply("select", operands[0], *branches)

    def _sign_of_quotient(self, x: int, size: int) -> int | None:
        """The node of x / size as a multiple of the piece of x, if the size is a multiple of |x|; else None."""
        (a, x), magnitude = self.graph.term(x), self.switches.magnitude(size)
        if magnitude is None or magnitude[1] != x:
            return None
        b, _, piece = magnitude
        self.switches.record_jump(piece)
        return self.graph.apply("mul", self.graph.number(a / b), piece)

    # ---- the end ----

    def pieced_program(self, size: int) -> DecidedProgram:
        of, graph, switches = self.places, self.graph, self.switches
        line = StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(of[i] for i in self.line.outputs))
        linear = self.program.linear
        if linear is not None:
            z, right, factors = (tuple(of[i] for i in some) for some in (linear.z, linear.right, linear.factors))
            entries, others = ({at: of[i] for at, i in some.items()} for some in (linear.entries, linear.others))
            linear = LinearSystem(z, entries, right, factors, linear.solve, others)
        features = sorted(self.features.found.items(), key=lambda item: item[1])
        return DecidedProgram(
            line, size, self.program.size, linear, tuple(switches.decisions), tuple(switches.pieces),
            frozenset(switches.jumping), self.parts, tuple((u, feature) for (u, _), feature in features),
        )  # fmt: skip


def find_decisions(
    program: Recurrent, size: int, slides: bool, watched: int, beside: bool, apart: int | None = None
) -> DecidedProgram | None:
    """The program with its pieces as inputs; None if it has neither decisions nor features. Arguments as in `Deciding`.

    If `apart` is set, nodes that jump with this piece are written for both of its sides, each with pieces of its own.
    """
    deciding = Deciding.from_program(program, size, slides, watched, beside)
    relevant, nodes = deciding.decisive | deciding.abrupt, program.line.nodes
    powers = find_powers(program.line, relevant, deciding.of_guards, size)
    if not powers and not any(
        i in deciding.cones or deciding.decides(i) or nodes[i][0] in WITH_FEATURES for i in relevant
    ):
        return None
    rewriting = _PieceRewriter(program, size, deciding, apart)
    rewriting.rewrite_nodes()
    for base, exponent in powers:
        rewriting.features.record_power(rewriting.places[base], exponent)
    found = rewriting.pieced_program(size)
    return found if found.decisions or found.features else None
