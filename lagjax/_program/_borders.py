"""The decisions of a program: its piecewise operations, each by a number whose series tells when the piece changes.

    comparisons, abs, max, min, sign    the sign of a switching number u: −1, 0 or 1
    floor, ceil, round                  the whole number below a switching number x
    rem, trunc, conversion to integers  the whole number between x and zero
    atan2(y, x)                         the sign of x, and where that is negative the sign of y: its cut
    look-ups (`locate`)                 the piece of an increasing table that a number x is on
    u / |u| of velocities               whether the vector u moves, 1, or rests, −1: dry friction in the plane

A *piece* is what was decided: one of these numbers, constant along a step. Here a program becomes one that takes its
pieces as further inputs, so that along every step it is smooth; beside it stand the switching numbers, and the program
that decides where a motion begins. A *guard* is a border of a piece: σ (u − level) > 0 on it, with σ = ±1.

Beside them stand *features*: functions that are flat to rounding until their argument comes near, where they change
within a unit of it, as exp(u) does below u = −80, and powers with a base that falls, or rises, by much (`_powers`). No
series shows one from afar, but its argument has one.

Not followed are `eq` and `ne`, whose border is a point, and what does not change along the motion. Where a root or a
power that is not whole begins right at a border, as in max(q, 0)**1.5, there is no series to begin with beyond it: such
a border is no piece but a feature, and a step that is to pass it begins next to it.
"""

import functools
import math
from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from lagjax._program._border_forces import Slide
from lagjax._program._cones import find_cones, list_squares, velocity_degrees
from lagjax._program._differentiation import copy_nodes, gradient_in, pullback
from lagjax._program._features import (
    BELOW,
    BESIDE,
    FALLS,
    FEATURES,
    GROWS,
    UP_TO,
    Feature,
)
from lagjax._program._graph import Graph
from lagjax._program._kick import Jumping, Kick, Mechanics, kick_line
from lagjax._program._levels import (
    CLOCK,
    CONE,
    FLOOR,
    NOTHING,
    SIGN,
    SLIDE,
    TABLE,
    TRUNC,
    Borders,
    Pieced,
    inputs_below,
    list_guards,
    nodes_below,
    piece_of,
)
from lagjax._program._look_ups import Located
from lagjax._program._operations import COMPARISONS, GROWING, LOOK_UPS, OPERATIONS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._powers import LEAST_POWER, find_powers
from lagjax._program._recurrences import LARGEST_WHOLE
from lagjax._program._rounding import rounding
from lagjax._program._series import LinearSystem, Recurrent, StraightLine
from lagjax._program._simplify import is_nonnegative
from lagjax._program._sliding import FAR, LARGEST_COPIED, MOST_SLIDING, with_sliding
from lagjax._program._small_equations import dot

BENT = "a constraint prescribes a speed that jumps"  # a reason to refuse a kick
LARGEST_WITH_ROUNDING = 500  # operations of numbers that are watched, and whose rounding is: three times as many
_BENT = 1e-9  # of a ratio that is the same at all states: a million roundings
_LARGEST = 10  # operations that one may become: a bound for errors, three are usual
_PIECEWISE = {
    *COMPARISONS, "abs", "max", "min", "sign", "floor", "ceil", "trunc", "round", "rem", "convert", "locate", "atan2"
}  # fmt: skip
_WITHOUT_ANY = {"input", "constant", "add", "sub", "neg", "sin", "cos"}  # no piece, no feature
# Functions without a series where their first operand is zero, or ±1.
_SINGULAR_AT_ZERO, _SINGULAR_AT_ONE = ("sqrt", "rsqrt", "cbrt", "log", "pow"), ("log1p", "asin", "acos", "acosh")


def borders(program: Recurrent, size: int, slides: bool = True, watched: int = 0) -> Borders | None:
    """The borders of a program of q, q̇, t and parameters whose first `size` outputs are q̈; None where it is smooth.

    Along borders that depend on velocities the motion may slide (`slides`; see `_sliding`). As many of the last outputs
    are `watched` along the motion: what they decide on has borders too.
    """
    found = _borders(program, size, slides, watched)
    is_refused = found is not None and found.kick is not None and bool(found.kick.refused)
    return _borders(program, size, slides, watched, beside=True) if is_refused else found


def _borders(program: Recurrent, size: int, slides: bool, watched: int, beside: bool = False) -> Borders | None:
    if (mechanics := getattr(program, "mechanics", None)) is not None:
        whole = with_outputs(program, mechanics)
        with np.errstate(all="ignore"):
            count = len(mechanics.outputs)
            rewriting = _Rewriting(whole, size, slides, watched + count, count, beside)
            if rewriting.switches and (found := rewriting.build()).kicking:
                return found
    if _WITHOUT_ANY.issuperset(op for op, *_ in program.line.nodes):
        return None
    with np.errstate(all="ignore"):
        rewriting = _Rewriting(program, size, slides, watched, beside=beside)
        return rewriting.build() if rewriting.switches or rewriting.features else None


class FoundCorners(NamedTuple):
    """The borders, P of them, at which some outputs of a program of q, q̇, t and parameters jump: `jumps` (P, outputs).

    `sides` takes the inputs of the program: numbers (P,) that change their sign at every such border. There an output
    may `vanish` (P, outputs), on one side.
    """

    sides: StraightLine
    jumps: np.ndarray
    vanish: np.ndarray


def find_corners(program: Recurrent, size: int) -> FoundCorners | None:
    """The borders that depend on positions and time, of `size` coordinates; None where no output jumps."""
    with np.errstate(all="ignore"):
        rewriting = _Rewriting(program, size, False, len(program.line.outputs), beside=True)
        return rewriting.find_corners() if rewriting.switches else None


def is_smooth(line: StraightLine) -> bool:
    return _PIECEWISE.isdisjoint(op for op, *_ in line.nodes)


class _BothSides(NamedTuple):
    """The nodes of a number below and above the border of a piece."""

    below: int
    above: int


class _Rewriting:
    """The program anew, with an input for every piece where the program decides.

    As many of its last outputs are the `mechanics` (`_kick.Mechanics`), which the result does not have. What the piece
    `apart` jumps with is there for both of its sides, each with pieces of its own, from where it begins to q̈. Where a
    root is of what is chosen, that border is no piece and steps end `beside` it, even if the root is not zero there.
    """

    def __init__(
        self,
        program: Recurrent,
        size: int,
        slides: bool,
        watched: int = 0,
        mechanics: int = 0,
        beside: bool = False,
        apart: int | None = None,
    ):
        self.mechanics, self._again = mechanics, (program, size, slides, watched, mechanics, beside)
        self.beside = beside
        self.program, self.size, self.moving, self.slides = program, size, 2 * size + 1, slides
        self.watched = program.line.outputs[len(program.line.outputs) - watched :]
        self._jumping: set[int] = set()  # pieces that something may jump with
        self.graph = Graph(_LARGEST * len(program.line.nodes) + 1000)
        self.switches: list[int] = []
        self.kinds: list[int] = []
        self.pieces: list[int] = []
        self.tables: list[Located | None] = []
        self._known: dict[tuple, int] = {}
        self._extremes: dict[int, tuple] = {}  # the operations that have been decided
        self._signs: dict[frozenset[int], dict[int, Any]] = {}  # the switching numbers of signs, by what moves them
        self._one = self.graph.constant(1.0, "float")
        self._moves: list[bool] = []
        self.features: dict[tuple[int, int], Feature] = {}  # by the argument, and the kind
        self.abrupt: set[int] = set()
        self.cones = find_cones(program.line, size, program.linear) if slides else {}
        self.parts: dict[int, tuple[int, ...]] = {}  # of the vector of a cone, by its piece
        self.decisive = self._decisive()
        comparisons = [i for i in self.decisive if program.line.nodes[i][0] not in ("eq", "ne")]
        self.borders_of_decisions = {self._compared(i) for i in comparisons} - {None}
        self.places: list[Any] = []
        self.apart, self._below, self._above = apart, {}, {}
        relevant = self.decisive | self.abrupt
        self.powers = find_powers(program.line, relevant, self._of_guards, size)
        if self.powers or any(
            i in self.cones or self._decides(i) or program.line.nodes[i][0] in (*FEATURES, "pow") for i in relevant
        ):
            linear = program.linear
            roots = {*program.line.outputs, *((*linear.right, *linear.entries.values()) if linear else ())}
            for i in range(len(program.line.nodes)):
                place = self._place(i)
                self.places.append(self._join(place) if i in roots else place)
        for base, exponent in self.powers:
            place = self.places[base]
            for node in place if isinstance(place, _BothSides) else (place,):
                self._note_power(node, exponent)

    # ---- which operations decide ----

    def _decisive(self) -> set[int]:
        """The nodes that q̈ depends on, without those of the elimination of a linear system."""
        linear, line = self.program.linear, self.program.line
        # What friction of contacts adds to A does not decide: it stops, and turns, by watches of its own.
        roots = line.outputs[: self.size] if linear is None else [*linear.right, *linear.entries.values()]
        needed = nodes_below(line, roots)
        self._of_guards = nodes_below(line, self.watched)
        if self.watched:  # which may read the solution of a linear system, but not decide on its elimination
            needed |= self._of_guards - (nodes_below(line, line.outputs[: self.size]) - needed)
        self.abrupt = self._find_abrupt(needed)
        return needed - self.abrupt

    def _find_abrupt(self, needed: set[int]) -> set[int]:
        """The decisions at whose border a root has no series."""
        nodes = self.program.line.nodes

        def bases_of(operations):
            return {self._base(nodes[i][1][0]) for i in needed if nodes[i][0] in operations}

        at_zero, at_one = bases_of(_SINGULAR_AT_ZERO), bases_of(_SINGULAR_AT_ONE)
        if not at_zero | at_one:
            return set()
        selects = [i for i in at_zero if nodes[i][0] == "select"]
        below = at_one | at_zero if self.beside else at_one
        out = nodes_below(self.program.line, [nodes[i][1][0] for i in below if nodes[i][0] == "select"])
        for i in selects:
            condition, *branches = nodes[i][1]
            deciding = {j: self._compared(j) for j in nodes_below(self.program.line, [condition])}
            out |= {j for j, equal in deciding.items() if equal and any(self._vanishes(x, equal) for x in branches)}
            bases = {self._base(x) for x in branches} - at_zero
            at_zero |= bases
            selects += [x for x in bases if nodes[x][0] == "select"]
        for i in needed:
            op, operands, _ = nodes[i]
            if op in (*COMPARISONS, "abs", "max", "min", "sign"):
                level = [nodes[x][2] for x in operands if nodes[x][0] == "constant"] or [0.0] * (len(operands) == 1)
                singular = (at_one if level[0] else at_zero) if level else set()
                if not singular.isdisjoint({i, *(self._base(x) for x in operands)}):
                    out.add(i)
        # What else is decided at the same border is decided beside it: no step may end where the root has no series.
        abrupt = {self._compared(i) for i in out} - {None}
        return {i for i in needed if i in out or self._compared(i) in abrupt} - self.cones.keys()

    def _vanishes(self, i: int, equal: frozenset[int]) -> bool:
        """True if a node may be zero where these numbers are `equal`, or where the only one is zero."""
        op, operands, attribute = self.program.line.nodes[i]
        if op in ("input", "constant"):
            return equal == {i} or (attribute == 0.0 and op == "constant")
        if equal in ({self._base(i)}, {self._base(x) for x in operands}):
            return True
        return (all if op in ("add", "sub") else any)(self._vanishes(x, equal) for x in operands)

    def _compared(self, i: int) -> frozenset[int] | None:
        """The numbers that are equal at the border of a node, but for factors and zero; None of other nodes."""
        op, operands, _ = self.program.line.nodes[i]
        if op not in (*COMPARISONS, "abs", "max", "min", "sign", "eq", "ne"):
            return None
        nodes = self.program.line.nodes
        return frozenset(self._base(x) for x in operands if nodes[x][0] != "constant" or nodes[x][2] != 0)

    def _base(self, i: int) -> int:
        """The node that this one is a multiple of."""
        nodes = self.program.line.nodes
        while True:
            op, operands, _ = nodes[i]
            if op == "neg":
                i = operands[0]
            elif op == "mul" and nodes[operands[0]][0] == "constant":
                i = operands[1]
            elif op == "mul" and nodes[operands[1]][0] == "constant":
                i = operands[0]
            else:
                return i

    def _decides(self, i: int) -> bool:
        (op, operands, attribute), kinds = self.program.line.nodes[i], self.program.line.kinds
        if op == "convert":
            return kinds[operands[0]] == "float" and attribute not in ("float", "bool")
        return op in _PIECEWISE and all(kinds[x] == "float" for x in operands)

    # ---- the new nodes ----

    def _place(self, i: int) -> Any:
        (op, operands, attribute), kind = self.program.line.nodes[i], self.program.line.kinds[i]
        if op == "input":
            return self.graph.input(attribute, kind)
        if op == "constant":
            return self.graph.constant(attribute, kind)
        of = [self.places[x] for x in operands]
        if any(isinstance(x, _BothSides) for x in of):
            return self._place_on_both_sides(i)
        place = self._place_operation(i, op, operands, attribute, of)
        return self._take_apart(place) if i in self.decisive else place

    def _place_operation(self, i: int, op: str, operands: Sequence[int], attribute, of: list[int]) -> int:
        if i in self.cones and i in self.decisive:
            return self._place_on_cone(i, op, of)
        if i in self.decisive and (decided := self._replace_by_piece(i, op, of, attribute)) is not None:
            return decided
        if op in ("eq", "ne") and (sign := self._known_sign(i, *of)) is not None:
            return self.graph.apply(op, sign, self.graph.number(0.0))
        if i in self.abrupt and self._decides(i):
            self._note_border(op, of)
        if op in FEATURES and i in self.decisive:
            self._note_feature(of[0], *FEATURES[op])
        if op == "pow" and i in self.decisive and self.graph.value(of[1]) is None:
            self._note_exponent(*of)
        if op == "div" and (quotient := self._direction(*of)) is not None:
            return quotient
        return self.graph.node(op, *of, attribute=attribute)

    def _place_on_both_sides(self, i: int) -> "int | _BothSides":
        operands = dict.fromkeys(self.program.line.nodes[i][1])
        before, sides = {x: self.places[x] for x in operands}, []
        for side in range(2):
            for x, place in before.items():
                self.places[x] = place[side] if isinstance(place, _BothSides) else place
            sides.append(self._place(i))
        for x, place in before.items():
            self.places[x] = place
        return sides[0] if sides[0] == sides[1] else _BothSides(*sides)

    def _take_apart(self, node: int) -> "int | _BothSides":
        """A node, or both sides of it where it depends on the piece that is `apart`."""
        if self.apart is None or self.apart >= len(self.pieces):
            return node
        below, above = self._put(node, self._below, -1.0), self._put(node, self._above, 1.0)
        return node if below == above else _BothSides(below, above)

    def _put(self, node: int, known: dict[int, int], side: float) -> int:
        """A node where the piece that is `apart` is this number; `known` has what was found before."""
        piece = self.pieces[cast(int, self.apart)]
        if node < piece or node in known:
            return known.get(node, node)
        op, operands, attribute = self.graph.nodes[node]
        of = tuple(self._put(x, known, side) for x in operands)
        found = node if of == operands else self.graph.apply(op, *of, attribute=attribute)
        known[node] = self.graph.number(side) if node == piece else found
        return known[node]

    def _join(self, place: "int | _BothSides") -> int:
        if not isinstance(place, _BothSides):
            return place
        is_above = self.graph.apply("gt", self.pieces[cast(int, self.apart)], self.graph.number(0.0))
        return self.graph.apply("select", is_above, *place)

    def _place_on_cone(self, i: int, op: str, of: list[int]) -> int:
        """A root of a sum of squares, or what is decided about it: 1 at rest, where the sum is zero."""
        f, number, square = self.graph.apply, lambda x: self.graph.constant(x, "float"), self.places[self.cones[i]]
        length = f("sqrt", f("add", square, number(NOTHING**2)))
        piece = self._piece(CONE, length)
        assert piece is not None
        self.parts[piece] = tuple(self.places[x] for x in list_squares(self.program.line, self.cones[i]) or ())
        moves = f("gt", piece, number(0.0))
        if op == "select":
            return of[1] if self.graph.value(of[1]) is None else of[2]
        if op in ("sqrt", "rsqrt"):
            return f(op, f("select", moves, self._one, f("add", of[0], number(NOTHING**2))))
        if op == "max":
            return f("select", moves, self._one, of[0] if self.graph.value(of[0]) is None else of[1])
        is_first = self.graph.value(of[0]) is None
        says_moving = op == "ne" or op in (("gt", "ge") if is_first else ("lt", "le"))
        return moves if says_moving else f("not", moves)

    def _direction(self, x: int, size: int) -> int | None:
        """x / |x| as the piece of x, which has both sides at x = 0, too; None of other quotients.

        The size may be replaced by a number where it is zero, by `where`.
        """
        op, operands, _ = self.graph.nodes[size]
        if op == "select":
            quotients = [self._sign_of_quotient(x, y) for y in operands[1:]]
            if quotients == [None, None]:
                return None
            branches = [q or self.graph.apply("div", x, y) for q, y in zip(quotients, operands[1:], strict=True)]
            return self.graph.apply("select", operands[0], *branches)
        return self._sign_of_quotient(x, size)

    def _sign_of_quotient(self, x: int, size: int) -> int | None:
        """x / size, where the size is a multiple of |x|: a multiple of the piece of x."""
        (a, x), magnitude = self.graph.term(x), self._magnitude(size)
        if magnitude is None or magnitude[1] != x:
            return None
        b, _, piece = magnitude
        self._jumping.add(piece)
        return self.graph.apply("mul", self.graph.constant(a / b, "float"), piece)

    def _magnitude(self, x: int) -> tuple[float, int, int] | None:
        """c, y and the piece of the sign of y, where x is c |y|, the product of y and this piece; None elsewhere."""
        b, size = self.graph.term(x)
        op, operands, _ = self.graph.nodes[size]
        for piece, y in (operands, operands[::-1]) if op == "mul" else ():
            c, base = self.graph.term(y)
            if self._known.get((SIGN, base)) == piece:
                return b * c, base, piece
        return None

    def _replace_by_piece(self, i: int, op: str, of: list[int], attribute) -> int | None:
        """The result of a node by its piece; None where it has none."""
        if not self._decides(i) or (
            op == "atan2" and is_nonnegative(self.program.line, self.program.line.nodes[i][1][1])
        ):
            return None
        decided = self._decided(op, of, attribute)
        if decided is not None:
            self._extremes[decided] = op, *of
        return decided

    def _decided(self, op: str, of: list[int], attribute) -> int | None:
        """The result of a piecewise operation by its piece; None where that does not change along the motion."""
        f, number = self.graph.apply, lambda x: self.graph.constant(x, "float")
        if op in (*COMPARISONS, "max", "min"):
            sign = self._sign(f("sub", *of))
            if sign is None:
                return None
            if op in COMPARISONS:
                self._jumping.add(self._base_of(sign))
                return f(op, sign, number(0.0))
            return f("select", f("gt" if op == "max" else "lt", sign, number(0.0)), of[1], of[0])
        if op in ("abs", "sign"):
            sign = self._sign(of[0])
            if op == "sign" and sign is not None:
                self._jumping.add(self._base_of(sign))
            return None if sign is None else sign if op == "sign" else f("mul", sign, of[0])
        if op == "atan2":
            return self._angle(*of)
        if op == "locate":
            is_time = self.graph.nodes[of[0]][:1] + self.graph.nodes[of[0]][2:] == ("input", self.moving - 1)
            return self._piece(CLOCK if is_time else TABLE, of[0], attribute)
        if op == "floor":
            return self._piece(FLOOR, of[0])
        if op == "ceil":
            below = self._piece(FLOOR, f("neg", of[0]))
            return None if below is None else f("neg", below)
        if op == "round":
            return self._piece(FLOOR, f("add", of[0], number(0.5)))
        if op == "rem":
            whole = self._piece(TRUNC, f("div", *of))
            return None if whole is None else f("sub", of[0], f("mul", whole, of[1]))
        whole = self._piece(TRUNC, of[0])
        return whole if whole is None or op == "trunc" else f("convert", whole, attribute=attribute)

    def _angle(self, y: int, x: int) -> int | None:
        """atan2(y, x) by the side of its cut, y = 0 where x < 0; None where no motion crosses that.

        Only where x < 0 is y the switching number, so that an angle of zero is no border; at x = 0 nothing jumps.
        """
        f, number = self.graph.apply, lambda x: self.graph.constant(x, "float")
        half = self._sign(x)
        beside = f("lt", x if half is None else half, number(0.0))
        side = self._sign(f("select", beside, number(FAR), y))
        jumps = half if side is None else side  # where y stays as it is, it may be zero
        if jumps is None:
            return None
        self._jumping.add(self._base_of(jumps))
        angle = f("atan2", y, x)
        # What rounding has put on the other side is brought back, by a whole turn.
        above = f("select", f("prefers", number(0.0), angle), number(0.0), number(2 * math.pi))
        below = f("select", f("prefers", angle, number(0.0)), number(0.0), number(-2 * math.pi))
        back = f("select", f("ge", y if side is None else side, number(0.0)), below, above)
        return f("add", angle, f("select", beside, number(0.0), back))

    def _base_of(self, piece: int) -> int:
        return self.graph.term(piece)[1]

    def _known_sign(self, i: int, a: int, b: int) -> int | None:
        """The piece that decides whether two numbers are equal, which is node i of the program.

        Of x and max(x, y), say, which are equal where x is larger: 0 there, and else 1.
        """
        f, zero = self.graph.apply, self.graph.constant(0.0, "float")
        for x, z in ((a, b), (b, a)):
            op, *of = self._extremes.get(z, ("",))
            if op in ("max", "min") and x in of:
                sign = self._sign(f("sub", *of))
                assert sign is not None
                larger = sign if x == of[0] else f("neg", sign)
                return f("select", f("ge" if op == "max" else "le", larger, zero), self._one, zero)
        if self.graph.kinds[a] != "float" or self.graph.kinds[b] != "float":
            return None
        if self._compared(i) in self.borders_of_decisions:  # which may come later in the program
            return self._sign(f("sub", a, b))
        return self._known.get((SIGN, self.graph.term(f("sub", a, b))[1]))

    def _sign(self, u: int) -> int | None:
        """The sign of a number, by the piece of what it is a multiple of.

        That of |x| is 1 but at the border of x, where it is 0: the square of the piece of x, and no border of its own.
        """
        if (magnitude := self._magnitude(u)) is not None:
            coefficient, _, piece = magnitude
            piece = self.graph.apply("mul", piece, piece)
        else:
            coefficient, base = self.graph.term(u)
            piece = self._find_multiple(base) or self._piece(SIGN, base)
        return piece if piece is None or coefficient > 0 else self.graph.apply("neg", piece)

    def _find_multiple(self, x: int) -> int | None:
        """The sign of a number that is a multiple of a switching number by what does not move, by the piece of that.

        Two pieces with one border would each push onto it, or not, as if the other one stayed as it is.
        """
        f, nodes, inputs = self.graph.apply, list(range(len(self.graph.nodes))), inputs_below(self.graph, [x])
        steps = {"select", *LOOK_UPS, *_PIECEWISE}.intersection(
            self.graph.nodes[i][0] for i in nodes_below(self.graph, [x])
        )
        # A few states say nothing of numbers that are chosen.
        if not self._is_moving(x) or (SIGN, x) in self._known or steps or max(inputs) >= self.program.size:
            return None
        # Of two draws of params, and four states each.
        columns = {i: np.random.default_rng(i).uniform(0.3, 1.2, (2, 4)) for i in inputs}
        columns |= {i: np.repeat(columns[i][:, :1], 4, 1) for i in inputs if self.moving <= i < self.program.size}
        given = [columns.get(i, columns[min(inputs)]).ravel() for i in range(1 + max(inputs))]
        values = eliminate_dead_code(self.graph, [x]).evaluate(given).reshape(2, 4)
        others = self._signs.setdefault(frozenset(i for i in inputs if i < self.moving), {})
        for y, ratio in ((y, values / of) for y, of in others.items()):
            if not np.ptp(ratio, axis=1).max() <= _BENT * np.abs(ratio).min():
                continue
            product = f("mul", *(gradient_in(self.graph, self.graph, nodes, z, [min(inputs)])[0] for z in (x, y)))
            if self._is_moving(product) and np.ptp(ratio) > _BENT * np.abs(ratio).max():
                continue
            sign = math.copysign(1.0, ratio[0, 0])
            sign = self.graph.number(sign) if self._is_moving(product) else f("sign", product)
            return f("mul", sign, self._known[SIGN, y])
        others[x] = values
        return None

    def _piece(self, kind: int, x: int, table: Located | None = None) -> int | None:
        """The input that says which piece a number is on; None where the number stays as it is along the motion."""
        if not self._is_moving(x):
            return None
        key = (kind, x) if table is None else (kind, x, table)
        if key not in self._known:
            self._known[key] = self.graph.input(self.program.size + len(self.switches), "float")
            self.switches.append(x)
            self.kinds.append(kind)
            self.tables.append(table)
            self.pieces.append(self._known[key])
        return self._known[key]

    def _is_moving(self, x: int) -> bool:
        nodes, moves = self.graph.nodes, self._moves
        for op, operands, attribute in nodes[len(moves) :]:
            if op == "input":
                moves.append(attribute < self.moving)
            else:
                moves.append(any(moves[i] for i in operands) and not (op != "constant" and OPERATIONS[op].is_step))
        return moves[x]

    def _note_border(self, op: str, of: list[int]) -> None:
        if op in (*COMPARISONS, "max", "min", "abs", "sign"):
            u = of[0] if op in ("abs", "sign") else self.graph.apply("sub", *of)
            self._note_feature(self._base_of(u), UP_TO, 1.0)

    def _note_feature(self, u: int, kind: int, scale: float) -> None:
        """A function of u, as a feature if u moves."""
        if self._is_moving(u):
            known = self.features.get((u, kind), Feature(kind, scale))
            self.features[u, kind] = Feature(kind, max(scale, known.scale))

    def _note_power(self, base: int, exponent: float) -> None:
        """A power of a number: one that is to be large by its square, and sums of exponentials by their arguments."""
        op, operands, _ = self.graph.nodes[base]
        if op in ("exp", "exp2"):
            self._note_feature(self.graph.scale(exponent, operands[0]), *FEATURES[op])
        elif exponent > 0:
            self._note_feature(self.graph.apply("mul", base, base), GROWS, exponent / 2)
        elif arguments := self._exponents(base):
            for u in arguments:
                self._note_feature(u, BESIDE, -exponent)
        else:
            self._note_feature(base, FALLS, -exponent)

    def _exponents(self, i: int) -> list[int]:
        """The arguments of the exponentials that a sum consists of, but for what does not move; none of others."""
        op, operands, _ = self.graph.nodes[self._base_of(i)]
        if op in ("add", "sub"):
            parts = [x for x in operands if self._is_moving(x)]
            found = [self._exponents(x) for x in parts]
            return [u for some in found for u in some] if all(found) else []
        return [operands[0]] if op in GROWING else []

    def _note_exponent(self, a: int, b: int) -> None:
        """aᵇ = exp(b log |a|), where b is no constant."""
        f = self.graph.apply
        base = f("mul", a, a) if self._is_moving(a) else a
        if not self._is_moving(b):  # then it is told as a constant would be: there is no log at a = 0
            bounds = (0.0, LEAST_POWER, LARGEST_WHOLE)
            falls, is_seen, grows = (f("lt", b, self.graph.number(bound)) for bound in bounds)
            large = f("and", grows, f("not", is_seen))
            self._note_feature(f("select", large, self._one, base), GROWS, LARGEST_WHOLE / 2)
            base = f("select", f("or", falls, f("not", grows)), self._one, base)
        log = self.graph.scale(0.5, f("log", base)) if self._is_moving(a) else f("log", base)
        self._note_feature(f("mul", log, b), BELOW, 1.0)

    # ---- the end ----

    def build(self) -> Borders:
        program, features = self.program, dict(sorted(self.features.items(), key=lambda item: item[1]))
        line = StraightLine(
            tuple(self.graph.nodes), tuple(self.graph.kinds), tuple(self.places[i] for i in program.line.outputs)
        )
        nested = not nodes_below(line, self.switches).isdisjoint(self.pieces)
        kicking = self._find_kicking(line) if self.mechanics else {}
        sliding, lost = self._sliding(line, kicking)
        if len(lost) == 1 and self.apart is None and len(line.nodes) <= LARGEST_COPIED:
            return _Rewriting(*self._again, apart=lost[0]).build()
        switches, arguments = list(self.switches), [u for u, _ in features]
        linear = program.linear and self._linear(program.linear)
        at_rest = [slide for slide in sliding if slide.order == 1]
        for slides in (sliding, *([at_rest] if len(at_rest) < len(sliding) else ()), []):
            done = with_sliding(line, self.size, program.size, self.switches, slides, linear)
            if done is not None:
                break
        assert done is not None  # without slides there is one
        line, places, shares, linear, retraction, moved, groups, release = done
        unheld = len(sliding) - len(slides)
        sliding, switches, arguments = slides, [places[i] for i in switches] + shares, [places[i] for i in arguments]
        count, kick = len(switches), None
        if self.mechanics:
            kick = self._kick(line, switches, kicking)
            line = line.replace(outputs=line.outputs[: -self.mechanics])
        dtypes = (*program.dtypes, *[np.dtype(float)] * count)
        pieced = Pieced(line, program.size + count, dtypes, linear)
        kinds = (*self.kinds, *[SLIDE] * len(sliding))
        return Borders(
            pieced, tuple(switches), kinds, self._decide(count, sliding), list_guards(kinds, sliding), nested,
            tuple(arguments), tuple(features.values()), (*self.tables, *[None] * len(sliding)), None, kick,
            retraction, moved, groups, release, unheld,
        )  # fmt: skip

    def find_corners(self) -> FoundCorners | None:
        nodes, kinds, n = tuple(self.graph.nodes), tuple(self.graph.kinds), self.size
        line = StraightLine(nodes, kinds, tuple(self.places[i] for i in self.program.line.outputs))
        inputs = [inputs_below(line, [switch]) for switch in self.switches]
        pieces = [j for j, read in enumerate(inputs) if read.isdisjoint(range(n, 2 * n))]
        search = Jumping(line, self._decide(len(self.switches), ()), self.switches, n, self.program.size)
        found = [search.find(pieces, [i], self._levels) for i in line.outputs] if pieces else []
        jumps = np.array([[bool(of[j]) for of in found] for j in pieces], bool).reshape(len(pieces), len(line.outputs))
        pieces, jumps = [j for j, row in zip(pieces, jumps, strict=True) if row.any()], jumps[jumps.any(axis=1)]
        if not pieces:
            return None
        vanish = np.array([search.find_zeros(pieces, i, self._levels) for i in line.outputs], bool).T
        graph = Graph(_LARGEST * len(nodes) + 1000)
        args = line, self.program.size, self.switches, self.kinds, self.tables
        places = _copy_deciding(graph, *args, lambda j, piece, _: piece)
        sides = [self._side(graph, j, places) for j in pieces]
        return FoundCorners(eliminate_dead_code(graph, sides), jumps, vanish)

    def _side(self, graph: Graph, j: int, places: Sequence[int]) -> int:
        """Switching number j, or the distance from the nearest border of its piece, positive on every other one."""
        f, number = graph.apply, lambda x: graph.constant(x, "float")
        x, piece, located = places[self.switches[j]], places[self.pieces[j]], self.tables[j]
        if self.kinds[j] == SIGN:
            return x
        level = self._level_between(j)
        below, above = f("sub", x, level(graph, f("sub", piece, number(1.0)))), f("sub", level(graph, piece), x)
        if located is not None:  # which has no border before its first entry, nor behind the last one
            below = f("select", f("lt", piece, number(0.0)), below, number(FAR))
            above = f("select", f("gt", piece, number(located.table.count - 1.5)), above, number(FAR))
        half = f("mul", number(0.5), piece)
        turn = f("sub", number(1.0), f("mul", number(4.0), f("sub", half, f("floor", half))))
        return f("mul", turn, f("select", f("lt", below, above), above, below))

    # ---- where L jumps ----

    def _find_kicking(self, line: StraightLine) -> dict[int, str | None]:
        """The pieces with which L or p jumps, each with the reason why no closed form holds there, or None."""
        n, of = self.size, Mechanics.from_nodes(line.outputs[-self.mechanics :], self.size)
        first, jumping = self.program.size, {}
        search = Jumping(line, self._decide(len(self.switches), ()), self.switches, n, first)
        for nodes in ([of.lagrangian, *of.momentum], of.rates):
            read = inputs_below(line, nodes)
            candidates = [j for j in range(len(self.switches)) if first + j in read]
            found = search.find(candidates, nodes, self._levels) if candidates else {}
            jumping |= {j: nodes is of.rates for j, jumps in found.items() if jumps}
        for j in sorted(jumping, reverse=True):  # beyond a piece that others are decided by, these may be other ones
            decided_by = {i - first for i in inputs_below(line, [self.switches[j]]) if i >= first}
            jumping |= {k: jumping[j] for k in decided_by if k not in jumping}

        def reads_velocity(nodes):
            return not inputs_below(line, nodes).isdisjoint(range(n, 2 * n))

        is_quadratic = not reads_velocity([*of.mass_matrix, *of.jacobian])
        reasons: dict[int, str | None] = {}
        for j, by_constraint in jumping.items():
            reasons[j] = None
            if by_constraint:
                reasons[j] = BENT
            elif reads_velocity([self.switches[j]]):
                reasons[j] = (
                    "L or the momentum p = dL/dqdot jumps, and no law says with what velocities the motion goes on"
                )
            elif not is_quadratic:
                reasons[j] = (
                    "L or the momentum p = dL/dqdot jumps, and L is not quadratic in qdot, so that the velocities "
                    "behind that are not known in closed form"
                )
        return reasons

    def _levels(self, j: int, u: np.ndarray, entries: Callable, draw) -> tuple:
        """Levels of switching number j near these numbers, and the pieces below and above."""
        kind, located = self.kinds[j], self.tables[j]
        if kind == SIGN:
            return np.zeros_like(u), -np.ones_like(u), np.ones_like(u)
        if located is not None:
            inner = int(located.closed)  # what is closed is not there outside of its table
            index = draw.integers(inner, max(located.table.count - inner, inner + 1), len(u))
            level = np.where(index < located.table.count - inner, entries(located, index), np.nan)
            return level, index - 1.0, index + 0.0
        level = np.round(u)
        if kind == FLOOR:
            return level, level - 1.0, level
        level = np.where(level == 0.0, np.where(u < 0.0, -1.0, 1.0), level)
        return level, np.where(level > 0.0, level - 1.0, level), np.where(level > 0.0, level, level + 1.0)

    def _kick(self, line: StraightLine, switches: Sequence[int], kicking: dict[int, str | None]) -> Kick:
        n, size, m = self.size, self.program.size, len(switches)
        of = Mechanics.from_nodes(line.outputs[-self.mechanics :], n)
        spatial = [j for j in kicking if not inputs_below(line, [switches[j]]).isdisjoint(range(n))]
        corners = [j for j in spatial if kicking[j] == BENT]
        refused = tuple((j, reason) for j, reason in kicking.items() if reason is not None and j not in corners)
        if refused or not kicking:
            return Kick(StraightLine((), (), ()), tuple(kicking), refused)
        moves = any(t is not None and t.table.numbers is None for t in self.tables)
        return Kick(kick_line(line, of, switches, spatial, corners, n, size, m if moves else 0), tuple(kicking))

    def _linear(self, linear) -> LinearSystem:
        z, right, factors = ([self.places[i] for i in some] for some in (linear.z, linear.right, linear.factors))
        entries, others = ({at: self.places[i] for at, i in of.items()} for of in (linear.entries, linear.others))
        return LinearSystem(tuple(z), entries, tuple(right), tuple(factors), linear.solve, others)

    def _sliding(self, line: StraightLine, kicking: Container[int] = ()) -> tuple[list[Slide], list[int]]:
        """The borders that a motion may slide along: those that something jumps with, but not L.

        Those that depend on velocities come first, and are all there or none. And those of them that are lost, because
        what other pieces are on their other side is not known.
        """
        n, acting, orders = self.size, nodes_below(line, line.outputs[: self.size]), {}
        undefined = self._find_undefined(acting)
        for j, kind in enumerate(self.kinds if self.slides else ()):
            if kind == CLOCK or self.pieces[j] not in acting or j in kicking:
                continue
            if self.pieces[j] in undefined or (kind == SIGN and self.pieces[j] not in self._jumping):
                continue
            read = inputs_below(line, [self.switches[j]])
            if state := [i for i in read if i < 2 * n]:
                orders[j] = 2 if max(state) < n else 1
        # The sign of a force is a corner where |force| rubs, but the slopes that it is solved by jump. An interpolation
        # has a corner at its entries, and no jump.
        degrees, lost = velocity_degrees(line, n) if orders else [], []
        others = [
            j
            for j, order in orders.items()
            if self.kinds[j] != CONE and (self.kinds[j] != SIGN or order == 2 or degrees[self.switches[j]] > 1)
        ]
        decides, of_pieces = {j: [] for j in orders}, {self.pieces[j]: j for j in orders}
        for switch in self.switches:
            for i in of_pieces.keys() & nodes_below(line, [switch]):
                decides[of_pieces[i]].append(switch)
        if others or any(decides.values()):
            search = Jumping(line, self._decide(len(self.switches), ()), self.switches, n, self.program.size)
            jumps = search.find(others, line.outputs[:n], self._levels) if others else {}
            orders = {j: order for j, order in orders.items() if jumps.get(j, True) is not False}
            shaken = {j: decides[j] for j in orders if decides[j]}
            lost = [j for j, nodes in shaken.items() if search.find([j], nodes, self._levels)[j]]
            lost = [j for j in lost if orders.pop(j) == 1]
        widths = {SIGN: 2.0, CONE: 2.0}
        both = [
            Slide(j, order, widths.get(self.kinds[j], 1.0), self._level_between(j), self.parts.get(self.pieces[j], ()))
            for j, order in sorted(orders.items(), key=lambda item: item[1])
        ]
        by_velocity = [slide for slide in both if slide.order == 1]
        return both if len(both) <= MOST_SLIDING else by_velocity if len(by_velocity) <= MOST_SLIDING else [], lost

    def _find_undefined(self, acting: set[int]) -> set[int]:
        """The pieces on one of whose sides nothing is known: `where` has NaN there."""
        nodes, found = self.graph.nodes, set()
        for op, operands, _ in (nodes[i] for i in acting):
            if op == "select" and any(self.graph.value(x) != self.graph.value(x) for x in operands[1:]):
                found |= {x for x in (operands[0], *nodes[operands[0]][1]) if x in self.pieces}
        return found

    def _level_between(self, j: int) -> Callable[[Graph, int], int]:
        """The level between a piece and the next one, of its switching number."""
        kind, located = self.kinds[j], self.tables[j]

        def level(graph: Graph, piece: int) -> int:
            zero, above = graph.constant(0.0, "float"), graph.apply("add", piece, graph.constant(1.0, "float"))
            if kind == SIGN:
                return zero
            if located is not None:  # no piece follows the last one
                ends, entry = graph.apply("lt", above, graph.number(float(located.table.count))), located.table
                return graph.apply("select", ends, graph.number(math.inf), graph.apply("take", above, attribute=entry))
            return above if kind == FLOOR else graph.apply("select", graph.apply("lt", piece, zero), above, piece)

        return level

    def _rate(self, graph: Graph, nodes: list[int], j: int) -> int:
        """u̇ of the switching number of piece j, in a graph in which the nodes of the program are `nodes`."""
        n, line = self.size, StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), ())
        slopes = gradient_in(graph, line, nodes, self.switches[j], range(2 * n + 1))
        velocities = [graph.input(n + i, "float") for i in range(n)]
        return graph.apply("add", dot(graph, slopes[:n], velocities), slopes[2 * n])

    def _decide(self, count: int, slides: Sequence[Slide]) -> StraightLine:
        """The pieces, from the inputs, `count` pieces, and a flag for each that is to stay; a slide continues.

        A motion that begins on a border slides along it, and leaves it at once where it may; on one that depends on
        positions it has to be at rest. To begin with all of several borders takes few turns until it is known which
        ones it leaves.
        """
        graph, first = Graph(2 * self.graph.budget), self.program.size

        def stays(j: int) -> int:
            return graph.apply("gt", graph.input(first + count + j, "float"), graph.constant(0.5, "float"))

        def decide_or_keep(j: int, piece: int, _) -> int:
            return graph.apply("select", stays(j), piece, graph.input(first + j, "float"))

        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), ())
        goes_on, zero, one = [], graph.constant(0.0, "float"), graph.constant(1.0, "float")

        def decide_ahead(way: float, j: int, piece: int, nodes: list[int]) -> int:
            """The piece forward or back in time, of what is at its border and has a rate there."""
            if self.kinds[j] == SIGN:
                ahead = graph.apply("sign", graph.apply("mul", graph.number(way), self._rate(graph, nodes, j)))
                piece = graph.apply("select", graph.apply("eq", piece, zero), piece, ahead)
            return decide_or_keep(j, piece, nodes)

        def copy(decide: Callable) -> list[int]:
            return _copy_deciding(graph, line, first, self.switches, self.kinds, self.tables, decide)

        nodes = copy(decide_or_keep)
        signs = {piece for piece, kind in zip(self.pieces, self.kinds, strict=True) if kind == SIGN}
        nested = any(slide.order > 1 and nodes_below(line, [self.switches[slide.piece]]) & signs for slide in slides)
        sides = [copy(functools.partial(decide_ahead, way)) for way in (1.0, -1.0)] if nested else [nodes]
        pieces = [nodes[i] for i in self.pieces]
        for k, slide in enumerate(slides):
            flag = graph.input(first + len(self.pieces) + k, "float")
            piece, below = nodes[self.pieces[slide.piece]], graph.constant(-1.0, "float")
            begins = graph.apply("le" if slide.parts else "eq", piece, zero)
            if self.kinds[slide.piece] not in (SIGN, CONE):
                if slide.order == 1:  # it begins on one side, and meets the other one at once
                    goes_on.append(flag)
                    continue
                x, lower = nodes[self.switches[slide.piece]], graph.apply("sub", piece, one)
                begins, is_lower = (graph.apply("eq", x, slide.level(graph, i)) for i in (lower, piece))
                begins, below = graph.apply("or", begins, is_lower), graph.apply("select", is_lower, lower, piece)
            if not slide.parts:  # a border that the motion has left does not hold it
                begins = graph.apply("and", begins, graph.apply("not", stays(slide.piece)))
            if slide.order > 1:
                for side in sides:
                    rests = graph.apply("eq", self._rate(graph, side, slide.piece), zero)
                    begins = graph.apply("and", begins, rests)
            goes_on.append(graph.apply("select", begins, flag, one))
            pieces[slide.piece] = graph.apply("select", begins, pieces[slide.piece], below)
        for j, kind in enumerate(self.kinds):  # what cannot rest moves
            if kind == CONE and all(slide.piece != j for slide in slides):
                pieces[j] = one
        return eliminate_dead_code(graph, pieces + goes_on)


def with_outputs(program: Recurrent, more: StraightLine, moving: int | None = None) -> Pieced:
    """A program with the outputs of another line of the same inputs behind its own; what both compute is shared.

    Where its first inputs, so many, are `moving`, before these stands how far rounding may move each of them
    (`rounding`); zero for a line that is long.
    """
    graph = Graph.from_line(program.line, len(program.line.nodes) + 2 * _LARGEST * len(more.nodes) + 1000)
    kinds = ["float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name for dtype in program.dtypes]
    with np.errstate(all="ignore"):
        places = copy_nodes(graph, more, [graph.input(i, kind) for i, kind in enumerate(kinds)])
        errors = [] if moving is None else [graph.constant(0.0, "float")] * len(more.outputs)
        if moving is not None and len(more.nodes) <= LARGEST_WITH_ROUNDING:
            errors = rounding(graph, more, places, moving)
    outputs = (*program.line.outputs, *errors, *(places[i] for i in more.outputs))
    line = StraightLine(tuple(graph.nodes), tuple(graph.kinds), outputs)
    mechanics = getattr(program, "mechanics", None)
    return Pieced(line, program.size, program.dtypes, program.linear, mechanics)


def distances(found: Borders) -> StraightLine:
    """The differences of all switching numbers from the nearest level of their piece; of the inputs but the pieces."""
    line, first = found.program.line, found.program.size - len(found.switches)
    graph, results = Graph(_LARGEST * len(line.nodes) + 1000), []
    places = _copy_deciding(graph, line, first, found.switches, found.kinds, found.tables, lambda j, piece, _: piece)
    for switch, kind, located in zip(found.switches, found.kinds, found.tables, strict=True):
        x, level = places[switch], graph.constant(0.0, "float")
        if located is not None:
            index, shift = graph.apply("locate", x, attribute=located), graph.constant(1.0, "float")
            below, above = (
                graph.apply("sub", x, graph.apply("take", i, attribute=located.table))
                for i in (index, graph.apply("add", index, shift))
            )
            nearer = graph.apply("prefers", graph.apply("neg", above), below)
            results.append(graph.apply("select", nearer, above, below))
            continue
        if kind != SIGN:
            level = graph.apply("floor", graph.apply("add", x, graph.constant(0.5, "float")))
        results.append(graph.apply("sub", x, level))
    return eliminate_dead_code(graph, results)


def _copy_deciding(
    graph: Graph, line: StraightLine, first: int, switches, kinds, tables, decide: Callable[[int, int, list[int]], int]
) -> list[int]:
    """The nodes of a line with pieces, its inputs from number `first` on, in a graph.

    Piece j is `decide(j, piece, nodes)`, of the piece that it is as it is written.
    """
    of_inputs = {node[2]: kind for node, kind in zip(line.nodes, line.kinds, strict=True) if node[0] == "input"}

    def find_input(i: int, nodes: list[int]) -> int:
        j = i - first
        if j < 0:
            return graph.input(i, of_inputs[i])
        return decide(j, piece_of(graph, kinds[j], nodes[switches[j]], tables[j]), nodes)

    return copy_nodes(graph, line, find_input)


def gradient(borders: Borders, by: Sequence[int]) -> StraightLine:
    """The derivatives by the inputs `by` of Σ hⱼ uⱼ, with m numbers hⱼ after the inputs of the program."""
    program = borders.program
    line = eliminate_dead_code(program.line, borders.switches)
    return pullback(line, program.dtypes, by, range(len(borders.switches)))
