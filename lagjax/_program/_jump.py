"""The jump of derivatives of a motion at a border, of any order, as a straight line.

A motion that is varied crosses the border u = 0 a little later, by δ(y). Seen from the time at which the motion itself
crosses it, the state jumps: along the field before the border to where u is zero, and the same time back along that
behind it,

    J(y) = Φ⁺₋δ(K(Φ⁻_δ(y))),    u(Φ⁻_δ(y)) = 0,

where K is the kick of the velocities if L jumps there (`_kick`), and else nothing. Without one J is the identity at the
state of the motion, where δ = 0; its derivatives are not. A first tangent jumps by

    J′ y′ = y′ + (f⁻ − f⁺) δ′,    δ′ = −∇u·y′ / u̇,

and a tangent of tangents by J″ and so on, which are not zero either where f itself is continuous. All of them follow
by the arithmetic of jets: a number is what it is, and all its mixed derivatives along the directions at hand. The flows
Φ need no more than a Runge–Kutta step of as many stages as there are orders, since the rest is of a higher order in δ.
Source of the first order: Aizerman & Gantmakher, Q. J. Mech. Appl. Math. 11 (1958) 225; Hiskens & Pai, IEEE Trans.
Circuits Syst. I 47 (2000) 204, §III.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lagjax._program._borders import Borders, PiecedProgram
from lagjax._program._differentiation import TangentTable, copy_nodes, pullback_and_entries, tangents_in, with_tangents
from lagjax._program._graph import Graph, Unlowerable
from lagjax._program._look_ups import Table, shift_look_up
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import StraightLine

# Explicit Runge–Kutta methods of order s with s stages: what of the stages before goes into each, and into the step.
# Source: Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §II.1.
_STAGES: tuple[tuple[tuple[float, ...], ...], ...] = (
    ((), (1.0,)),
    ((), (0.5,), (0.0, 1.0)),
    ((), (0.5,), (-1.0, 2.0), (1 / 6, 2 / 3, 1 / 6)),
    ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)),
)
_LARGEST_JUMP = 1000  # operations that one may become: a bound for errors


class Nesting(NamedTuple):
    """The layout of a motion of `base` coordinates with tangents, and tangents of all these, and so on.

    `directions[k]` is the number of directions at level k. Rows of coordinates follow each other: the motion, its
    tangents, then the tangents of all rows before.
    """

    base: int
    directions: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        return self.base * math.prod(1 + count for count in self.directions)

    @property
    def levels(self) -> list[tuple[int, int]]:
        """For each level: the number of coordinates before it, and the number of directions of their tangents."""
        return [(Nesting(self.base, self.directions[:k]).size, count) for k, count in enumerate(self.directions)]

    @property
    def disjoint_rows(self) -> list[tuple[int, int, int]]:
        """Triples of rows (a + b, a, b), where a and b are derivatives without a common direction."""
        counts, found = [1 + count for count in self.directions], []
        place = functools.partial(np.ravel_multi_index, dims=counts, order="F")
        for index in itertools.product(*map(range, counts)):
            among = [range(3) if i else (0,) for i in index]  # in none of both, in the first, in the second
            for parts in itertools.product(*among):
                if 1 in parts and 2 in parts and parts.index(1) < parts.index(2):
                    a, b = (tuple(i * (part == k) for i, part in zip(index, parts, strict=True)) for k in (1, 2))
                    found.append((int(place(index)), int(place(a)), int(place(b))))
        return found

    def with_tangents(self, directions: int) -> "Nesting":
        return self._replace(directions=(*self.directions, directions))


Jet = list  # of nodes of a graph, one a row: the number itself, then its derivatives; None where one is zero


class Jump(NamedTuple):
    """The jump of the tangents of a motion with n coordinates at a border, as a straight line over their rows.

    `line` takes the lower rows of q, of q̇, t, the lower rows of the parameters, the m pieces before and behind the
    border, m numbers hⱼ that select the switching number Σ hⱼ uⱼ, then the upper rows of q, of q̇ and of the
    parameters: those along the last directions. If levels are table entries that are parameters, the m indices of the
    entries follow the hⱼ, and uⱼ is meant minus its level. Outputs are the jumps of q and q̇ by rows from row 1 on,
    then the accelerations before and behind the border. `orders` has the order of derivative of each row, `lower` the
    number of lower rows, `fixed` that of inputs without rows.
    """

    line: StraightLine
    orders: tuple[int, ...]
    lower: int
    fixed: int

    def accelerations(self, size: int) -> StraightLine:
        """The line from the same inputs to the accelerations before and behind the border only."""
        return eliminate_dead_code(self.line, self.line.outputs[-2 * size :])

    def transposed(self, size: int, parameters: int) -> tuple[StraightLine, tuple[Table, ...]]:
        """The line from all inputs but the upper rows, and cotangents of their jumps, to cotangents of the upper rows.

        There are as many upper rows as lower ones: the jump is linear in tangents along one direction. Cotangents are
        ordered by rows, each with q and q̇, and in the outputs also the parameters. Cotangents of table entries follow,
        as in `pullback_and_entries`.
        """
        n, rows = size, self.lower
        first = rows * (2 * n + parameters) + 1 + self.fixed
        upper = rows * (2 * n + parameters)
        by = [
            place
            for row in range(rows)
            for place in (
                *(first + row * n + i for i in range(n)),
                *(first + (rows + row) * n + i for i in range(n)),
                *(first + 2 * rows * n + row * parameters + i for i in range(parameters)),
            )
        ]
        of = range((rows - 1) * 2 * n, (2 * rows - 1) * 2 * n)
        dtypes = [np.dtype(float)] * (first + upper)
        line, tables = pullback_and_entries(
            self.line, dtypes, by, of, varies=lambda table: table.tangents, is_linear=True
        )
        nodes, of_upper, places = [], [], []
        for op, operands, attribute in line.nodes:
            operands = tuple(places[i] for i in operands)
            of_upper.append(first <= attribute < first + upper if op == "input" else any(of_upper[i] for i in operands))
            places.append(len(nodes))
            if op == "input" and attribute >= first + upper:
                attribute -= upper
            # All that is read of them is whether a tangent is zero, or a number: taken for neither, it has every mask.
            elif op in ("eq", "is_finite") and of_upper[-1]:
                op, operands, attribute, of_upper[-1] = "constant", (), False, False
            elif op == "select" and (operands[1] == operands[2] or nodes[operands[0]] == ("constant", (), False)):
                places[-1], of_upper[-1] = operands[1], of_upper[operands[1]]
            nodes.append((op, operands, attribute))
        outputs = tuple(places[i] for i in line.outputs)
        line = eliminate_dead_code(line.replace(nodes=tuple(nodes)), outputs)
        return line, tables


def with_borders_of_tangents(borders: Borders, size: int, directions: int, member: int) -> Borders:
    """The borders of a motion with its tangents along D = `directions` directions; tangents have no further borders.

    The inputs q, q̇ and parameters have 1 + D rows, the motion and then one for each direction, and so have the
    accelerations. `member` is the number of parameters of a member, some of which are read by look-ups only.
    """
    program, pieces, n, rows = borders.program, len(borders.switches), size, 1 + directions
    numbers = program.size - 2 * n - 1 - pieces
    first_piece = rows * (2 * n + numbers) + 1
    of_rows = [row_places(n, numbers, rows, row) for row in range(rows)]
    places = [*of_rows[0], *(first_piece + j for j in range(pieces))]
    moving = [{i: place for i, place in enumerate(row) if i != 2 * n} for row in of_rows[1:]]
    followed = list(borders.followed)
    line = program.line.replace(outputs=(*program.line.outputs[: n + 1], *followed))
    every = [None, *range(directions)]
    of = [(i, row) for row in every for i in range(n)] + [(n + k, None) for k in range(1 + len(followed))]
    tables = [_table_of_row(row * member) for row in range(1, rows)]
    holding, retraction = borders.holding, borders.holding.retraction
    if retraction is not None:
        states = [(half * n + i, row) for half in range(2) for row in every for i in range(n)]
        retraction = with_tangents(retraction, program.dtypes, places, moving, states, tables)
    line = with_tangents(line, program.dtypes, places, moving, of, tables)
    switches = line.outputs[rows * n + 1 :]
    dtypes = (np.dtype(float),) * (first_piece + pieces)
    decided = {i: place for i, place in enumerate(places)}
    decided |= {program.size + j: first_piece + pieces + j for j in range(pieces)}
    line = line.replace(outputs=line.outputs[: rows * n + 1])
    moved = zip(borders.decisions, switches[:pieces], strict=True)
    return borders._replace(
        program=PiecedProgram(line, len(dtypes), dtypes, None),
        decisions=tuple(decision._replace(switch=node) for decision, node in moved), arguments=switches[pieces:],
        decide=_renumber_inputs(borders.decide, decided), motion=borders.motion or borders,
        holding=holding._replace(retraction=retraction, release=_renumber_inputs(holding.release, decided)),
    )  # fmt: skip


def row_places(n: int, numbers: int, rows: int, row: int) -> list[int]:
    """The positions of q, q̇, t and the parameters of one row among the inputs of a motion with `rows` rows."""
    first = 2 * rows * n + 1
    return [
        *range(row * n, (row + 1) * n), *range((rows + row) * n, (rows + row + 1) * n), 2 * rows * n,
        *range(first + row * numbers, first + (row + 1) * numbers),
    ]  # fmt: skip


def _table_of_row(shift: int) -> TangentTable:
    """A map from tables of the motion to those of a row of tangents, `shift` positions later."""
    return lambda table: shift_look_up(table, shift)


def _renumber_inputs(line: StraightLine, places: dict[int, int]) -> StraightLine:
    return line.replace(nodes=tuple((op, of, places[x]) if op == "input" else (op, of, x) for op, of, x in line.nodes))


# ---- the jump --------------------------------------------------------------------------------------------------------


def jump_at_border(
    borders: Borders, size: int, directions: tuple[int, ...], member: int, over_steps: bool = False
) -> Jump:
    """The jump of the tangents at a border; `directions[k]` is the number of directions of the tangents of level k.

    `borders` are those of the motion without tangents, `member` is the number of parameters of a member. `over_steps`:
    the last level differentiates steps that were taken. Raises `Unlowerable` for more than four levels.
    """
    if len(directions) > len(_STAGES):
        raise Unlowerable(
            f"derivatives of order {len(directions)} over a border are not known, of {len(_STAGES)} they are"
        )
    with np.errstate(all="ignore"):
        return _JumpBuilder(borders, size, directions, member, over_steps).build()


class _Jets:
    """Arithmetic of jets: a number with all its mixed derivatives, one per row (i₁, i₂, …).

    Row (i₁, i₂, …) is the derivative along direction i₁ of the first level, i₂ of the second, …; 0 means no derivative.
    The first index changes fastest.
    """

    def __init__(self, directions: tuple[int, ...]):
        indices = [index[::-1] for index in itertools.product(*(range(1 + d) for d in directions[::-1]))]
        self.directions, self.rows = directions, len(indices)
        self.orders = tuple(sum(i > 0 for i in index) for index in indices)
        self.graph = Graph(0)
        self._terms: list[list[tuple[int, int]]] = []  # the rows whose products sum up to each row of a product
        place = {index: row for row, index in enumerate(indices)}
        for index in indices:
            parts = itertools.product(*((0, i) if i else (0,) for i in index))
            pairs = [(part, tuple(i - p for i, p in zip(index, part, strict=True))) for part in parts]
            self._terms.append([(place[a], place[b]) for a, b in pairs])

    def multiply(self, a: Jet, b: Jet) -> Jet:
        """The product of two jets, by Leibniz's rule."""
        apply, result = self.graph.apply, []
        for terms in self._terms:
            total = None
            for i, j in terms:
                if a[i] is not None and b[j] is not None:
                    part = apply("mul", a[i], b[j])
                    total = part if total is None else apply("add", total, part)
            result.append(total)
        return result

    def add(self, a: Jet, b: Jet, factor: float = 1.0) -> Jet:
        """The jet a + factor · b."""
        graph, result = self.graph, []
        for x, y in zip(a, b, strict=True):
            scaled = None if y is None else graph.apply("mul", graph.number(factor), y)
            result.append(x if scaled is None else scaled if x is None else graph.apply("add", x, scaled))
        return result


class _JumpBuilder:
    """Builds the jump of state and tangents at a border, in the arithmetic of jets, as one graph."""

    def __init__(self, borders: Borders, size: int, directions: tuple[int, ...], member: int, over_steps: bool):
        program = borders.program
        self.jets, self.n, self.pieces = _Jets(directions), size, len(borders.decisions)
        self.member, self.over_steps = member, over_steps
        self.selectors = self.pieces * (
            2 if borders.levels_move else 1
        )  # numbers that choose what is zero at the border
        self.numbers = program.size - 2 * size - 1 - self.pieces
        fixed, dtypes = self.pieces + self.selectors, program.dtypes[: self.moving]
        line = eliminate_dead_code(program.line, program.line.outputs[:size])
        self.switch, self.kick = _switching_number(borders, program.size), None
        self.field, self.switches = (self._add_rows(line, dtypes, fixed) for line in (line, self.switch))
        largest = len(self.field.nodes) + len(self.switches.nodes) + len(line.nodes)
        if borders.kicking and borders.kick is not None:
            line = borders.kick.line.replace(outputs=borders.kick.line.outputs[:size])
            self.kick = self._add_rows(line, dtypes, self.pieces + fixed)
            largest += len(self.kick.nodes)
        self.jets.graph = Graph(_LARGEST_JUMP * largest + 10_000)

    @property
    def graph(self) -> Graph:
        return self.jets.graph

    @property
    def moving(self) -> int:
        """The number of inputs in a row: q, q̇, t and parameters."""
        return 2 * self.n + 1 + self.numbers

    def _add_rows(self, line: StraightLine, dtypes: Sequence, fixed: int) -> StraightLine:
        """The line with all rows of its inputs and outputs; `fixed` inputs at its end have no rows."""
        outputs, rows, moving = len(line.outputs), 1, self.moving
        first, directions = self.jets.rows * moving, self.jets.directions
        kinds = [*dtypes, *[np.dtype(float)] * (first - moving + fixed)]
        line = _renumber_inputs(line, {i: i if i < moving else i - moving + first for i in range(moving + fixed)})
        for level, count in enumerate(directions):
            tables = [_table_of_row(row * rows * self.member) for row in range(1, 1 + count)]
            if self.over_steps and level == len(directions) - 1:
                tables = [lambda table: table._replace(tangents=True)]
            places = [
                {row * moving + i: (row + d * rows) * moving + i for row in range(rows) for i in range(moving)}
                for d in range(1, 1 + count)
            ]
            of = [(i, d) for d in (None, *range(count)) for i in range(rows * outputs)]
            line = with_tangents(line, kinds, range(len(kinds)), places, of, tables)
            rows *= 1 + count
        return line

    def _jet_values(self, line: StraightLine, place: list[Jet], fixed: Sequence[int]) -> list[Jet]:
        """The outputs, as jets, of a line with rows at jets `place` of its moving inputs and nodes `fixed`."""
        zero = self.graph.number(0.0)
        inputs = [zero if jet[row] is None else jet[row] for row in range(self.jets.rows) for jet in place]
        nodes = copy_nodes(self.graph, line, [*inputs, *fixed])
        count = len(line.outputs) // self.jets.rows
        return [[nodes[line.outputs[row * count + i]] for row in range(self.jets.rows)] for i in range(count)]

    # ---- flows ----

    def _moving_rates(self, place: list[Jet], pieces: Sequence[int]) -> list[Jet]:
        """The time derivatives, as jets, of all moving inputs: q̇, q̈, 1 for the time, 0 for parameters."""
        unused = [self.graph.number(0.0)] * self.selectors
        none: Jet = [None] * self.jets.rows
        one: Jet = [self.graph.number(1.0), *none[1:]]
        acceleration = self._jet_values(self.field, place, [*pieces, *unused])
        return [*place[self.n : 2 * self.n], *acceleration, one, *[none] * self.numbers]

    def _flow_jets(self, place: list[Jet], pieces: Sequence[int], delay: Jet) -> list[Jet]:
        """The moving inputs after the flow over the time `delay`, by one Runge–Kutta step, as jets."""
        jets, rates, stages = self.jets, [], _STAGES[len(self.jets.directions) - 1]
        for weights in stages:
            here = place
            for weight, rate in zip(weights, rates, strict=True):
                if weight:
                    here = [jets.add(x, jets.multiply(delay, r), weight) for x, r in zip(here, rate, strict=True)]
            if len(weights) == len(stages) - 1:
                return here
            rates.append(self._moving_rates(here, pieces))
        raise AssertionError

    def _delay_jets(self, place: list[Jet], before: Sequence[int], hit: Sequence[int], rate: int) -> Jet:
        """The jet of the delay δ, order by order: the residual of u, divided by −u̇ (`rate`), gives the next order."""
        delay: Jet = [None] * self.jets.rows
        for order in range(1, 1 + max(self.jets.orders)):
            there = place if order == 1 else self._flow_jets(place, before, delay)
            (left,) = self._jet_values(self.switches, there, [*before, *hit])
            for row in range(self.jets.rows):
                if self.jets.orders[row] == order:
                    delay[row] = self.graph.apply("neg", self.graph.apply("div", left[row], rate))
        return delay

    @property
    def _lower_jets(self) -> int:
        """The number of lower rows: those without a derivative along the last level's directions."""
        return self.jets.rows // (1 + self.jets.directions[-1])

    def build(self) -> Jump:
        graph, n, zero = self.graph, self.n, self.graph.number(0.0)
        place, before, behind, hit = self._jump_inputs()
        base = [jet[0] for jet in place]
        first = self._moving_rates(place, before)
        a_before = [first[n + i][0] for i in range(n)]
        a_behind = [jet[0] for jet in self._moving_rates(place, behind)[n : 2 * n]]
        nodes = copy_nodes(graph, self.switch, [*base, *before, *hit])
        rates = [*base[n : 2 * n], *a_before, graph.number(1.0)]
        rate = tangents_in(graph, self.switch, nodes, dict(enumerate(rates)), {}).get(self.switch.outputs[0], zero)
        delay = self._delay_jets(place, before, hit, rate)
        there = self._flow_jets(place, before, delay)
        if self.kick is not None:
            there[n : 2 * n] = self._jet_values(self.kick, there, [*before, *behind, *hit])
        back = self._flow_jets(there, behind, [None if x is None else graph.apply("neg", x) for x in delay])
        results = []
        for row in range(1, self.jets.rows):
            for x, y in zip(place[: 2 * n], back[: 2 * n], strict=True):
                results.append(zero if y[row] is None else graph.apply("sub", y[row], x[row]))
        line = eliminate_dead_code(graph, [*results, *a_before, *a_behind])
        return Jump(line, self.jets.orders, self._lower_jets, 2 * self.pieces + self.selectors)

    def _jump_inputs(self) -> tuple[list[Jet], list[int], list[int], list[int]]:
        """The inputs in the order of `Jump`: jets of moving inputs, pieces before and behind, selecting numbers."""
        n, numbers, lower, m = self.n, self.numbers, self._lower_jets, self.pieces
        rows, count = self.jets.rows, itertools.count()
        upper = rows - lower

        def some(size):
            return [self.graph.input(next(count), "float") for _ in range(size)]

        q, v, (t,), p = some(lower * n), some(lower * n), some(1), some(lower * numbers)
        before, behind, hit = some(m), some(m), some(self.selectors)
        q, v, p = q + some(upper * n), v + some(upper * n), p + some(upper * numbers)
        time: Jet = [t, *[None] * (rows - 1)]
        jets: list[Jet] = [[q[row * n + i] for row in range(self.jets.rows)] for i in range(n)]
        jets += [[v[row * n + i] for row in range(self.jets.rows)] for i in range(n)]
        jets += [time]
        jets += [[p[row * numbers + i] for row in range(self.jets.rows)] for i in range(numbers)]
        return jets, before, behind, hit


def _switching_number(borders: Borders, size: int) -> StraightLine:
    """The line of Σ hⱼ (uⱼ − levelⱼ), with the weights hⱼ after the inputs of the program.

    Levels that are parameters are entries of tables, whose indices are inputs after the weights; constant levels, which
    have no derivative, are left out.
    """
    program, m = borders.program, len(borders.switches)
    line = eliminate_dead_code(program.line, borders.switches)
    graph = Graph(10 * len(line.nodes) + 1000)
    nodes = copy_nodes(graph, line)
    total = graph.constant(0.0, "float")
    for j, node in enumerate(line.outputs):
        weight, number = graph.input(size + j, "float"), nodes[node]
        if (table := borders.moving_table(j)) is not None:
            entry = graph.apply("take", graph.input(size + m + j, "float"), attribute=table)
            number = graph.apply("sub", number, entry)
        total = graph.apply("add", total, graph.apply("mul", weight, number))
    return eliminate_dead_code(graph, [total])
