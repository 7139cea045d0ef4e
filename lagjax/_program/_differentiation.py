"""Derivatives of scalar programs: in forward and in reverse mode, of the nodes of a graph and of straight lines.

A derivative of scalars is more scalars of the same graph. What it costs is then what it consists of: only operations
that carry a derivative are looked at, where an array derivative goes through every zero of its unit vectors. The rules
are those of `_operations`: a scalar operation is its own transpose, so that one formula, linear in g, takes a cotangent
from the result to an operand and a tangent from an operand to the result.

    Derivatives        of nodes of a graph: gradients of a function that was taped, tangents along directions
    pushforward        of a straight line along one direction, as a straight line
    with_tangents      a straight line and its tangents along several directions, in one
    pullback           the transpose of `pushforward`, as a straight line
    gradient_in        the gradient of a node of a straight line, in the graph in which the line is

These are derivatives of the operations as they stand: `has_own_rules` in `_rules` finds functions with other ones.
"""

import functools
import math
from collections.abc import Callable, Container, Iterable, Sequence
from typing import Any

import numpy as np

from lagjax._program._graph import INPUTS, Graph, Node, Tape, find_ancestors
from lagjax._program._line import StraightLine
from lagjax._program._look_ups import Table, move_look_up
from lagjax._program._operations import FLAT_FAR_OUT, LOOK_UPS, OPERATIONS, SLOW_FAR_OUT, WILD
from lagjax._program._passes import eliminate_dead_code, factor, sink_negations

_Rule = Callable[[int], int]
Tangents = dict[int, int]  # by the number of the direction; a direction that is not there has none
TangentTable = Callable[[Table], Table]  # the table of the tangents of the entries of a table

_LARGEST_DERIVATIVE = 100  # operations of a derivative for one of a line: a bound for errors, three are usual


def copy_nodes(
    graph: Graph,
    line,
    inputs: Sequence[int] | Callable[[int, list[int]], int | None] = lambda i, nodes: None,
    places: Sequence | None = None,
) -> list[int]:
    """The nodes of a line, of a tape or of another graph in a graph, where `inputs` are its inputs.

    These may follow from the nodes before, `inputs(i, nodes)`, or stay as they are, None. Tables move where `places`
    says what input i becomes.
    """
    nodes: list[int] = []
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        if op == "input":
            place = inputs(attribute, nodes) if callable(inputs) else graph.real(inputs[attribute])
            nodes.append(graph.input(attribute, kind) if place is None else place)
        elif op == "constant":
            nodes.append(graph.constant(attribute, kind))
        else:
            here = move_look_up(attribute, places) if op in LOOK_UPS and places is not None else attribute
            nodes.append(copy_operation(graph, op, [nodes[i] for i in operands], here))
    return nodes


def copy_operation(graph: Graph, op: str, operands: Sequence[int], attribute: Any) -> int:
    if op == "integer_pow":
        return graph.power(operands[0], attribute)
    return graph.apply(op, *operands, attribute=attribute)


def replace_nodes(graph: Graph, among: Iterable[int], sides: Sequence[dict[int, int]]) -> None:
    """Add to each of the `sides`, where some nodes become others, what those `among` the nodes behind them become.

    What becomes the same on both of two sides stays as it is.
    """
    for i in among:
        op, operands, attribute = graph.nodes[i]
        if any(x in known for known in sides for x in operands):
            new = [copy_operation(graph, op, [known.get(x, x) for x in operands], attribute) for known in sides]
            if len(sides) == 1 or new[0] != new[1]:
                for known, node in zip(sides, new, strict=True):
                    known[i] = node


# ---- nodes of a graph -----------------------------------------------------------------------------------------------


class Derivatives:
    """Derivatives of nodes of a graph; `operations` counts what they consist of before anything is simplified.

    What has overflown `hides` its derivatives, but for those of a line of tangents, which are linear in these. A line
    `asks` whether a tangent is zero, but one that JAX is to transpose.
    """

    def __init__(self, graph: Graph):
        self.graph, self._number = graph, graph.number
        self.operations, self.hides, self.asks = 0, True, True

    # ---- reverse mode ----

    def gradient(
        self, tape: Tape, nodes: list[int], output: int, by: Sequence[int], together: bool, again: Sequence[int] = ()
    ) -> list[int]:
        """The nodes of the derivatives of scalar `output` of a tape by its inputs at positions `by`, in that order.

        `nodes[k]` is scalar k of the tape in the graph. With `together` the cotangents of equal scalars are added at
        once, else each is followed on its own as long as it is written apart. `again` are the inputs by which the
        result will be differentiated once more.
        """
        first: dict[tuple, int] = {}
        taken = [tape.branches.get(k) for k in range(len(nodes))]
        same = [first.setdefault((i, taken[k]), k) if together else k for k, i in enumerate(nodes)]
        varied, once_more = (self._find_varying(tape, nodes, inputs) for inputs in (by, again))
        cotangents, results = {same[output]: self._number(1.0)}, {}
        for k in range(output, -1, -1):
            if not varied[k] or (g := cotangents.pop(k, None)) is None:
                continue
            op, operands, attribute = tape.nodes[k]
            if op == "input":
                results[attribute] = g
            rules_of = self._rules if once_more[k] else self._single_use_rules
            rules = rules_of(nodes[k], op, [nodes[x] for x in operands], attribute)
            for x, rule in zip(operands, rules, strict=False):
                if rule is not None and varied[x]:
                    part = rule(g)
                    if (branch := taken[k]) is not None and taken[x] != branch:
                        part = self._apply_operation("select", nodes[branch], self._number(0.0), part)
                    self._add_terms(cotangents, same[x], part)
        return [results.get(i, self._number(0.0)) for i in by]

    def slopes(self, output: int, through: Iterable[int], by: Sequence[int]) -> list[int]:
        """The derivatives of a node by others as if they were independent, `through` the nodes between, in order."""
        cotangents, ends = {output: self._number(1.0)}, set(by)
        for i in reversed(list(through)):
            if i in ends or (g := cotangents.pop(i, None)) is None:
                continue
            op, operands, attribute = self.node_to_differentiate(i)
            for x, rule in zip(operands, self._rules(i, op, operands, attribute), strict=False):
                if rule is not None and self.graph.value(x) is None:
                    self._add_terms(cotangents, x, rule(g))
        return [cotangents.get(i, self._number(0.0)) for i in by]

    def _find_varying(self, tape: Tape, nodes: list[int], by: Sequence[int]) -> list[bool]:
        """True for every scalar of a tape that depends on the inputs `by` and has a derivative."""
        varied, inputs = [], frozenset(by)
        for k, (op, operands, attribute) in enumerate(tape.nodes):
            depends = attribute in inputs if op == "input" else any(varied[x] for x in operands)
            varied.append(depends and tape.kinds[k] == "float" and self.graph.value(nodes[k]) is None)
        return varied

    # ---- forward mode ----

    def directional_derivatives(self, outputs: Sequence[int], directions: Sequence[Tangents]) -> list[Tangents]:
        """The tangents of the nodes `outputs` along each of `directions`, which maps inputs to their tangents."""
        tangents: dict[int, Tangents] = {}
        for k, direction in enumerate(directions):
            for i, tangent in direction.items():
                if self.graph.value(tangent) != 0:
                    tangents.setdefault(i, {})[k] = tangent
        for i in self.find_ancestors(outputs) if tangents else ():
            if self.graph.kinds[i] == "float" and i not in tangents:
                moved = not tangents.keys().isdisjoint(self.node_to_differentiate(i)[1])
                if moved and (of_node := self._node_tangents(i, tangents)):
                    tangents[i] = of_node
        return [tangents.get(i, {}) for i in outputs]

    def _node_tangents(self, i: int, tangents: dict[int, Tangents]) -> Tangents:
        (op, operands, attribute), result = self.node_to_differentiate(i), {}
        if op == "div" and all(x in tangents for x in operands):
            (u, v), found = operands, tangents
            directions = [*found[v], *(k for k in found[u] if k not in found[v])]
            return {k: self.quotient_tangent(i, v, found[u].get(k), found[v].get(k)) for k in directions}
        for operand, rule in zip(operands, self._rules(i, op, operands, attribute), strict=False):
            if rule is not None:
                for k, tangent in tangents.get(operand, {}).items():
                    self._add_terms(result, k, rule(tangent))
        return {k: tangent for k, tangent in result.items() if self.graph.value(tangent) != 0}

    def quotient_tangent(self, w: int, v: int, of_u: int | None, of_v: int | None) -> int:
        """(u′ − w v′)/v, the tangent of w = u / v: one division, where the two rules have two."""
        if of_v is None:
            assert of_u is not None
            return self._apply_operation("div", of_u, v)
        part = self._apply_operation("mul", w, of_v)
        change = self._apply_operation("neg", part) if of_u is None else self._apply_operation("sub", of_u, part)
        return self._mask_quotient(self._apply_operation("div", change, v), w, v)

    # ---- rules ----

    def rules(self, w: int, op: str, operands: Sequence[int]) -> list[_Rule | None]:
        """The rules that take a cotangent, or a tangent, of each operand past w = op(operands); None: there is none."""

        def apply_rule(rule, g):
            result = rule(self._apply_operation, self._number, g, w, *operands)
            grows = self.hides and self.graph.hides_growth and any(map(self.graph.grows, (w, *operands)))
            if not grows:
                return result
            if op == "div":
                return self._mask_quotient(result, w, operands[1])
            slope = rule(self._apply_operation, self._number, self._number(1.0), w, *operands)
            if op in FLAT_FAR_OUT:
                result = self._mask_nan(result, lambda: self.graph.is_flat_far_out(slope, operands[0]))
            elif op in SLOW_FAR_OUT:
                result = self._refuse_overflow(result, g, w)
            return self._mask_product(result, g, slope)

        rules = OPERATIONS[op].transpose() if operands else ()
        if op in ("max", "min") and any(self.graph.nodes[x][0] == op for x in operands):
            u, v = operands
            return [functools.partial(self._extreme_share, op, u, v), functools.partial(self._extreme_share, op, v, u)]
        return [rule and functools.partial(apply_rule, rule) for rule in rules]

    def _extreme_share(self, op: str, u: int, v: int, g: int) -> int:
        """The cotangent of the operand u of an extreme of several numbers: those that are equal have equal shares."""
        f, counts = self._apply_operation, [self._count_equal(op, x) for x in (u, v)]
        shared = f("div", counts[0], f("add", *counts))
        whole = f("select", f("gt" if op == "max" else "lt", u, v), self._number(0.0), self._number(1.0))
        return f("mul", g, f("select", f("eq", u, v), whole, shared))

    def _count_equal(self, op: str, i: int) -> int:
        """The count of the numbers that a node is the extreme of, and that are equal to it."""
        if self.graph.nodes[i][0] != op:
            return self._number(1.0)
        f, (u, v) = self._apply_operation, self.graph.nodes[i][1]
        of_u, of_v = (self._count_equal(op, x) for x in (u, v))
        one = f("select", f("gt" if op == "max" else "lt", u, v), of_v, of_u)
        return f("select", f("eq", u, v), one, f("add", of_u, of_v))

    def _mask_quotient(self, tangent: int, w: int, v: int) -> int:
        """A tangent, or a cotangent, of w = u/v: 0 where w is flat, as what has overflown gives no number."""
        return self._mask_nan(tangent, lambda: self.graph.is_flat_quotient(w, v)) if self.graph.grows(v) else tangent

    def _mask_product(self, product: int, g: int, slope: int) -> int:
        """A product of g and a slope, 0 where g is and the slope is huge."""
        if not (self.asks and self.hides and self.graph.hides_growth and self.graph.grows(slope)):
            return product
        is_zero = self._apply_operation("eq", g, self._number(0.0))
        return self._mask_nan(product, lambda: self._apply_operation("and", is_zero, self.graph.is_huge(slope)))

    def _mask_nan(self, x: int, where: Callable[[], int]) -> int:
        """0 in the place of what is no number; what is finite stays, and has derivatives of its own."""
        f, zero = self._apply_operation, self._number(0.0)
        return f("select", f("is_finite", x), f("select", where(), x, zero), x)

    def _refuse_overflow(self, result: int, g: int, w: int) -> int:
        """NaN where w is infinite and matters: its operand has overflown, whose logarithm or root has a slope."""
        f = self._apply_operation
        known = f("or", f("is_finite", w), f("eq", g, self._number(0.0)))
        return f("select", known, self._number(math.nan), result)

    def _rules(self, w: int, op: str, operands: Sequence[int], attribute: Any = None) -> Sequence[_Rule | None]:
        """`rules`, where a power is one operation."""
        if op == "integer_pow":
            return [lambda g: self._power_derivative(operands[0], attribute, g)]
        return self.rules(w, op, operands)

    def _single_use_rules(self, w: int, op: str, operands: Sequence[int], attribute: Any) -> Sequence[_Rule | None]:
        """`_rules` for the only cotangent of w: factors 2 and ½ are next to others, with which they cancel."""
        if op == "sqrt" and not self.graph.grows(w):
            return [lambda g: self._apply_operation("mul", self._number(0.5), self._apply_operation("div", g, w))]
        if op == "mul" and operands[0] == operands[1]:
            return [lambda g: self._power_derivative(operands[0], 2, g)]
        return self._rules(w, op, operands, attribute)

    def _power_derivative(self, base: int, exponent: float, g: int) -> int:
        """p uᵖ⁻¹ g, which is finite at u = 0 where the products and roots that make up uᵖ have no derivative."""
        lower = base if exponent == 2 else self._apply_operation("pow", base, self._number(exponent - 1))
        slope = self._apply_operation("mul", self._number(exponent), lower)
        return self._mask_product(self._apply_operation("mul", g, slope), g, slope)

    # ---- the graph ----

    def node_to_differentiate(self, i: int) -> Node:
        """A node as it is differentiated: a power is one operation, not the products that it consists of."""
        if i in self.graph.powers:
            base, exponent = self.graph.powers[i]
            return "integer_pow", (base,), exponent
        return self.graph.nodes[i]

    def find_ancestors(self, outputs: Sequence[int]) -> list[int]:
        return self.graph.find_ancestors(outputs, as_derived=True)

    def size(self, outputs: Sequence[int]) -> int:
        return sum(bool(self.graph.nodes[i][1]) for i in self.graph.find_ancestors(outputs))

    def _apply_operation(self, op: str, *operands: int, attribute=None) -> int:
        self.operations += 1
        return self.graph.apply(op, *operands, attribute=attribute)

    def _add_terms(self, parts: dict[int, int], i: int, part: int) -> None:
        parts[i] = self._apply_operation("add", parts[i], part) if i in parts else part


# ---- straight lines -------------------------------------------------------------------------------------------------


def pushforward(
    line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=(), in_jax: bool = False
) -> StraightLine:
    """The line from the inputs and the tangents of the inputs `by` to the tangents of the outputs `of`.

    `dtypes` has the type of every input of `line`. Its inputs come first, the tangents after them, and after those the
    values of the outputs `known`, which are not computed once more. JAX may transpose it where it is one `in_jax`.
    """
    places = {i: len(dtypes) + k for k, i in enumerate(by)}
    placed = _PlacedLine.from_line(line, dtypes, len(by))
    placed.asks = not in_jax
    with np.errstate(all="ignore"):
        tangents = {i: placed.graph.input(place, "float") for i, place in places.items()}
        moved = placed.tangents(tangents, places, lambda table: table._replace(tangents=True))
        zero = placed.graph.number(0.0)
        return placed.finish_line([moved.get(line.outputs[i], zero) for i in of], known, len(dtypes) + len(by))


def pullback(line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=()) -> StraightLine:
    """The transpose of `pushforward`: its last inputs but those `known` are the cotangents of the outputs `of`."""
    return pullback_and_entries(line, dtypes, by, of, known)[0]


def pullback_and_entries(
    line: StraightLine,
    dtypes: Sequence,
    by: Sequence[int],
    of: Sequence[int],
    known=(),
    varies: Callable[[Table], bool] = lambda table: True,
    is_linear: bool = False,
) -> tuple[StraightLine, tuple[Table, ...]]:
    """`pullback`, and the cotangents of the entries of tables that are not among the inputs `by`, where these `varies`.

    For each of the tables two outputs come behind those of the inputs: the index of an entry, and its cotangent.
    `is_linear` says that the line is one of tangents, linear in the inputs `by`.
    """
    placed, tables = _PlacedLine.from_line(line, dtypes), []
    placed.hides = not is_linear
    with np.errstate(all="ignore"):
        cotangents: dict[int, int] = {}
        for k, output in enumerate(of):
            if line.nodes[line.outputs[output]][0] != "constant":  # rows of contacts are zeros but for a few numbers
                placed._add_terms(cotangents, line.outputs[output], placed.graph.input(len(dtypes) + k, "float"))
        pulled, zero = placed.pull(cotangents, frozenset(by), tables, varies, is_linear), placed.graph.number(0.0)
        results = [*(pulled.get(i, zero) for i in by), *(i for _, *entry in tables for i in entry)]
        done = placed.finish_line(results, known, len(dtypes) + len(of))
    return done, tuple(table for table, *_ in tables)


def with_tangents(
    line: StraightLine,
    dtypes: Sequence,
    places: Sequence[int],
    directions: Sequence[dict[int, int]],
    of: Sequence,
    tables: "Sequence[TangentTable | None] | None" = None,
) -> StraightLine:
    """A straight line and its tangents along some directions, in one.

    Input i of `line` is input `places[i]` of the result, its tangent along a direction d input `directions[d][i]`; an
    input that is not there does not move. Of numbers of a member that are only looked up, `tables[d]` gives the table
    of tangents. The outputs are `of`, pairs of an output and a direction, or None for the output itself.
    """
    graph, kinds = Graph(_LARGEST_DERIVATIVE * len(line.nodes) * (1 + len(directions)) + 1000), [*map(_kind, dtypes)]
    with np.errstate(all="ignore"):
        ids = [
            place + INPUTS if kind == "float" else graph.input(place, kind)
            for place, kind in zip(places, kinds, strict=True)
        ]
        placed = _PlacedLine(graph, line, copy_nodes(graph, line, ids, places))
        moved = []
        for direction, table in zip(directions, tables or [None] * len(directions), strict=True):
            tangents = {i: place + INPUTS for i, place in direction.items() if kinds[i] == "float"}
            moved.append(placed.tangents(tangents, direction, table))
        zero = graph.number(0.0)
        nodes = ((line.outputs[output], direction) for output, direction in of)
        results = [placed.nodes[i] if d is None else moved[d].get(i, zero) for i, d in nodes]
        return eliminate_dead_code(*sink_negations(*factor(graph, results)))


def gradient_in(graph: Graph, line: Any, nodes: list[int], node: int, by: Sequence[int]) -> list[int]:
    """The derivatives of one node of a line by the inputs `by`, as nodes of the graph in which the line is `nodes`."""
    slopes = slopes_in(graph, line, nodes, node, by)
    return [slopes[i] if i in slopes else graph.number(0.0) for i in by]


def slopes_in(graph: Graph, line: Any, nodes: Sequence[int], node: int, by: Container[int]) -> dict[int, int]:
    """`gradient_in`, of a line or of a graph, by the inputs among `by` that the node depends on."""
    return _PlacedLine(graph, line, nodes).pull({node: graph.number(1.0)}, by)


def tangents_in(
    graph: Graph, line: StraightLine, nodes: list[int], of_inputs: dict[int, int], places: dict[int, int]
) -> dict[int, int]:
    """The tangents of the nodes of a line that have some, from those of its inputs, in the graph in which it is
    `nodes`; the tangent of input i is input `places[i]`."""
    return _PlacedLine(graph, line, nodes).tangents(of_inputs, places)


def _kind(dtype) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


class _PlacedLine(Derivatives):
    """A straight line that is `nodes` in a graph, of which its derivatives become part."""

    def __init__(self, graph: Graph, line: Any, nodes: Sequence[int]):
        super().__init__(graph)
        self.line, self.nodes = line, nodes

    @classmethod
    def from_line(cls, line: StraightLine, dtypes: Sequence, more: int = 0) -> "_PlacedLine":
        """The line in a new graph, whose inputs have the types `dtypes`; `more` floats follow them."""
        graph = Graph(_LARGEST_DERIVATIVE * len(line.nodes) + 1000)
        inputs = [graph.input(i, kind) for i, kind in enumerate([*map(_kind, dtypes), *["float"] * more])]
        with np.errstate(all="ignore"):
            return cls(graph, line, copy_nodes(graph, line, inputs))

    def finish_line(self, results: list[int], known: Sequence[int], first: int) -> StraightLine:
        """The line of some results, which reads the outputs `known` of the line as inputs from `first` on."""
        results, count = results + [self.nodes[self.line.outputs[i]] for i in known], len(results)
        done = eliminate_dead_code(*sink_negations(*factor(self.graph, results)))
        values = done.outputs[count:]
        positions = {node: first + k for k, node in enumerate(values) if done.nodes[node][1]}
        nodes = tuple(("input", (), positions[i]) if i in positions else node for i, node in enumerate(done.nodes))
        return eliminate_dead_code(done.replace(nodes=nodes), done.outputs[:count])

    def tangents(
        self, of_inputs: dict[int, int], places: dict[int, int], beside: "TangentTable | None" = None
    ) -> dict[int, int]:
        """The tangents of the nodes that have some, from those of the inputs.

        The tangent of input i is input `places[i]`. Of a table that is not among these, `beside` gives that of the
        tangents of its entries; None: they have none.
        """
        graph, line, nodes, tangents = self.graph, self.line, self.nodes, {}
        for k, (op, operands, attribute) in enumerate(line.nodes):
            if op == "input" and attribute in of_inputs:
                tangents[k] = graph.real(of_inputs[attribute])
            if op == "take" and (table := _tangents_of(attribute, places, beside)) is not None:
                tangents[k] = graph.apply("take", nodes[operands[0]], attribute=table)
                continue
            if line.kinds[k] != "float" or not any(i in tangents for i in operands):
                continue
            here, parts = [nodes[i] for i in operands], {}
            if op == "div" and operands[1] in tangents:
                u, v = operands
                parts[k] = self.quotient_tangent(nodes[k], nodes[v], tangents.get(u), tangents[v])
            else:
                for i, rule in zip(operands, self.rules(nodes[k], op, here), strict=False):
                    if rule is not None and i in tangents:
                        self._add_terms(parts, k, self._zero_where_zero(k, tangents[i], rule(tangents[i])))
            if k in parts and graph.value(parts[k]) != 0:
                tangents[k] = parts[k]
        return tangents

    def pull(
        self,
        cotangents: dict[int, int],
        inputs: Container[int],
        tables: list | None = None,
        varies: Callable[[Table], bool] = lambda table: False,
        is_linear: bool = False,
    ) -> dict[int, int]:
        """The cotangents of some inputs, by their numbers, from those of some nodes.

        A root whose slope is infinite has a cotangent that is infinite, too; past a slope of zero, as that of
        max(q, 0) on its flat side, it is zero. So is all that leaves a branch that is not taken.

        Those of entries of a table that `varies` are added to `tables`: the table, the index, and the cotangent; or,
        where the table consists of inputs `by`, to each of these.
        """
        line, nodes, results, above = self.line, self.nodes, {}, find_ancestors(self.line.nodes, cotangents)
        varied, flat = self._find_varying_nodes(above, inputs, varies), ("mul",) if is_linear else ("max", "min")
        beneath = self._find_beneath_roots(above, varied, is_linear)
        conditions = self._find_conditions(above, cotangents)
        for k in reversed(above):
            (op, operands, attribute), g = line.nodes[k], cotangents.get(k)
            if g is None or k not in varied:
                continue
            if op == "input":
                self._add_terms(results, attribute, g)
            elif op == "take" and attribute.first not in inputs:
                assert tables is not None  # else the entry does not vary
                tables.append((attribute, nodes[operands[0]], g))
            elif op == "take":
                for i, position in enumerate(attribute.positions):
                    at = self.graph.apply("eq", nodes[operands[0]], self._number(float(i)))
                    self._add_terms(results, position, self.graph.apply("select", at, self._number(0.0), g))
            else:
                rules = self.rules(nodes[k], op, [nodes[j] for j in operands])
                for i, rule in zip(operands, rules, strict=False):  # a step has no derivative at all
                    if rule is not None and i in varied:
                        part = self._zero_where_zero(k, g, rule(g))
                        if op in flat and k in beneath:
                            slope = rule(self._number(1.0))
                            part = self._select_unless_zero(slope, self._select_unless_zero(g, part))
                        for p, branch in sorted(conditions[k] - conditions[i]):
                            cases = (part, self._number(0.0))[:: 1 if branch == 1 else -1]
                            part = self.graph.apply("select", nodes[p], *cases)
                        self._add_terms(cotangents, i, part)
        return results

    def _find_varying_nodes(
        self, among: Sequence[int], inputs: Container[int], varies: Callable[[Table], bool]
    ) -> set[int]:
        """Those nodes that depend on some inputs, or on entries of a table that `varies`."""
        varied: set[int] = set()
        for k in among:
            op, operands, attribute = self.line.nodes[k]
            if op == "take":
                depends = attribute.numbers is None and (attribute.first in inputs or varies(attribute))
            else:
                depends = attribute in inputs if op == "input" else not varied.isdisjoint(operands)
                depends = depends and self.line.kinds[k] == "float"
            if depends:
                varied.add(k)
        return varied

    def _find_conditions(self, among: Sequence[int], outputs: Iterable[int]) -> dict[int, frozenset]:
        """The predicates and branches of selections that each node but inputs is read in, and nowhere else.

        Only those with nodes that may be no number, or infinite, where nothing that is read outside of branches is.
        """
        nodes, nothing = self.line.nodes, frozenset()
        conditions, read, wild, doubtful = dict.fromkeys(outputs, nothing), set(outputs), set(), set()
        for k in reversed(among):
            op, operands, _ = nodes[k]
            for branch, x in enumerate(operands):
                chosen = op == "select" and branch > 0
                here = conditions[k] | {(operands[0], branch)} if chosen else conditions[k]
                conditions[x] = conditions.get(x, here) & here if nodes[x][1] and nodes[x][0] != "take" else nothing
                if k in read and not chosen:
                    read.add(x)
        for k in among:
            op, operands, _ = nodes[k]
            if operands and k not in read and (op in WILD or OPERATIONS[op].steep or not wild.isdisjoint(operands)):
                wild.add(k)
                doubtful |= conditions[k]
        return {k: of & doubtful for k, of in conditions.items()}

    def _zero_where_zero(self, k: int, g: int, part: int) -> int:
        """The part of `g` that node k passes on: 0 of 0, also where its slope is infinite, as that of u**0.5 at 0.

        There a program has a number in the place of the slope (`_recurrences.finite`), so that g is 0. And 0 past the
        root of a power at a base of zero.
        """
        nodes, (op, operands, _) = self.line.nodes, self.line.nodes[k]
        by_root = op == "div" and (of := nodes[operands[1]][0]) not in ("input", "constant") and OPERATIONS[of].steep
        if not (self.asks and (OPERATIONS[op].steep or by_root or (op == "div" and k in self._find_guarded))):
            return part
        if k in self._roots_of_powers:
            part = self._select_unless_zero(self.nodes[operands[0]], part)
        return self._select_unless_zero(g, part)

    @functools.cached_property
    def _roots_of_powers(self) -> set[int]:
        """The nodes √u of which only products with u are made, which have a slope at u = 0: u √u, that of u^1.5."""
        nodes, roots = self.line.nodes, {k for k, (op, *_) in enumerate(self.line.nodes) if op == "sqrt"}
        parts = {k: {(k, nodes[k][1][0])} for k in roots}  # the roots that a node is a multiple of, each with its u
        factors: list[set[int]] = []
        for k, (op, operands, _) in enumerate(nodes):
            of = [factors[i] for i in operands] if op in ("mul", "neg") else []
            factors.append({k}.union(*of))
            for i in operands:
                for root, u in parts.get(i, ()):
                    if op == "neg" or (op == "mul" and u not in factors[k]):
                        parts.setdefault(k, set()).add((root, u))
                    elif op != "mul" and k not in self._find_guarded:
                        roots.discard(root)
        return roots

    @functools.cached_property
    def _find_guarded(self) -> set[int]:
        """The nodes of products and quotients that the line asks whether they are finite."""
        guarded: set[int] = set()
        for k in range(len(self.nodes) - 1, -1, -1):
            op, operands, _ = self.line.nodes[k]
            if op == "is_finite" or (k in guarded and op in ("mul", "div", "neg")):
                guarded.update(operands)
        return guarded

    def _select_unless_zero(self, number: int, part: int) -> int:
        """The part, but 0 in the place of NaN where the number is zero; where the part is finite it has derivatives."""
        f, zero = self.graph.apply, self._number(0.0)
        return f("select", f("eq", number, zero), part, f("select", f("is_finite", part), zero, part))

    def _find_beneath_roots(self, among: Sequence[int], varied: set[int], is_linear: bool) -> set[int]:
        """The nodes that vary and that operations of steep slopes depend on; in a line of tangents, their tangents.

        There a tangent beneath a root is one that is asked whether it is zero (`_zero_where_zero`).
        """
        nodes, beneath = self.line.nodes, set()
        for k in reversed(among):
            op, operands, _ = nodes[k]
            if is_linear and op == "select" and nodes[operands[0]][0] == "eq":
                beneath.update(varied.intersection((*nodes[operands[0]][1], *operands[1:])))
            elif k in beneath or (not is_linear and operands and k in varied and OPERATIONS[op].steep):
                beneath.update(varied.intersection(operands))
        return beneath


def _tangents_of(table: Table, places: dict[int, int], beside: "TangentTable | None") -> Table | None:
    """The table of the tangents of the entries of another one; None where they have none."""
    if table.numbers is not None:
        return None
    if table.first not in places:
        return None if beside is None else beside(table)
    return table.moved(places)
