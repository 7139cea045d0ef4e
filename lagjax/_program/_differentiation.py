"""Derivatives of scalar programs, in forward and in reverse mode: of nodes of a graph, and of straight lines.

The derivative of a scalar program is built from scalars of the same graph, and only operations that carry a derivative
are visited; an array derivative would visit every zero of its unit vectors. The rules are those of `_operations`: a
scalar operation is its own transpose, so that one formula, linear in g, maps a cotangent of the result to one of an
operand and a tangent of an operand to one of the result.

    Derivatives        of nodes of a graph: gradients of a recorded function, tangents along directions
    pushforward        of a straight line along one direction, as a straight line
    with_tangents      a straight line and its tangents along several directions, in one
    pullback           the transpose of `pushforward`, as a straight line
    gradient_in        the gradient of a node of a straight line, in the graph into which the line was copied

Custom derivative rules of the user are not applied: `has_own_rules` in `_rules` finds functions that have some.
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
    """Copy the nodes of a line, tape or graph into `graph`; return their ids there. `inputs[i]` replaces input i.

    As a function, `inputs(i, nodes)` may use the nodes copied so far, or keep the input (None). Tables are shifted
    where `places[i]` gives the new position of input i.
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
    """Propagate replacements: each dict in `sides` maps nodes to new ones; add what the later nodes in `among` become.

    With two dicts, a node that becomes the same in both is left as it is.
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
    """Differentiation of nodes of a graph; `operations` counts the operations before simplification.

    `hides`: derivatives are set to zero where the value has overflown and is constant (not for lines that are linear in
    tangents). `asks`: the result may test whether a tangent is zero (not for a line that JAX will transpose).
    """

    def __init__(self, graph: Graph):
        self.graph, self._number = graph, graph.number
        self.operations, self.hides, self.asks = 0, True, True

    # ---- reverse mode ----

    def gradient(
        self, tape: Tape, nodes: list[int], output: int, by: Sequence[int], together: bool, again: Sequence[int] = ()
    ) -> list[int]:
        """The derivative nodes of scalar `output` of a tape by its inputs at positions `by`, in that order.

        `nodes[k]` is scalar k of the tape in the graph. With `together`, cotangents of equal scalars are added at once;
        else each is propagated separately. `again` are the inputs by which the result will be differentiated once more.
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
        """The derivatives of node `output` by the nodes `by`, taken as independent; `through` are the nodes between."""
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
        """For every scalar of a tape: True if it depends on the inputs `by` and has a derivative."""
        varied, inputs = [], frozenset(by)
        for k, (op, operands, attribute) in enumerate(tape.nodes):
            depends = attribute in inputs if op == "input" else any(varied[x] for x in operands)
            varied.append(depends and tape.kinds[k] == "float" and self.graph.value(nodes[k]) is None)
        return varied

    # ---- forward mode ----

    def directional_derivatives(self, outputs: Sequence[int], directions: Sequence[Tangents]) -> list[Tangents]:
        """The tangents of the nodes `outputs`, each {direction: tangent}; a direction maps nodes to their tangents."""
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
        """The tangent (u′ − w v′)/v of w = u / v, with one division instead of two."""
        if of_v is None:
            assert of_u is not None
            return self._apply_operation("div", of_u, v)
        part = self._apply_operation("mul", w, of_v)
        change = self._apply_operation("neg", part) if of_u is None else self._apply_operation("sub", of_u, part)
        return self._mask_quotient(self._apply_operation("div", change, v), w, v)

    # ---- rules ----

    def rules(self, w: int, op: str, operands: Sequence[int]) -> list[_Rule | None]:
        """For each operand the map from a cotangent of w = op(operands) to its own; it also maps its tangent to w's."""

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
        """The cotangent of operand u of a nested max or min: operands equal to the extreme get equal shares of g."""
        f, counts = self._apply_operation, [self._count_equal(op, x) for x in (u, v)]
        shared = f("div", counts[0], f("add", *counts))
        whole = f("select", f("gt" if op == "max" else "lt", u, v), self._number(0.0), self._number(1.0))
        return f("mul", g, f("select", f("eq", u, v), whole, shared))

    def _count_equal(self, op: str, i: int) -> int:
        """The node of the count of operands of nested max or min i that equal the extreme."""
        if self.graph.nodes[i][0] != op:
            return self._number(1.0)
        f, (u, v) = self._apply_operation, self.graph.nodes[i][1]
        of_u, of_v = (self._count_equal(op, x) for x in (u, v))
        one = f("select", f("gt" if op == "max" else "lt", u, v), of_v, of_u)
        return f("select", f("eq", u, v), one, f("add", of_u, of_v))

    def _mask_quotient(self, tangent: int, w: int, v: int) -> int:
        """A tangent or cotangent of w = u/v, set to 0 where v has overflown and w is constant, instead of NaN."""
        return self._mask_nan(tangent, lambda: self.graph.is_flat_quotient(w, v)) if self.graph.grows(v) else tangent

    def _mask_product(self, product: int, g: int, slope: int) -> int:
        """The product of g and a slope, set to 0 where g is 0 and the slope is huge, instead of NaN."""
        if not (self.asks and self.hides and self.graph.hides_growth and self.graph.grows(slope)):
            return product
        is_zero = self._apply_operation("eq", g, self._number(0.0))
        return self._mask_nan(product, lambda: self._apply_operation("and", is_zero, self.graph.is_huge(slope)))

    def _mask_nan(self, x: int, where: Callable[[], int]) -> int:
        """x, with 0 in place of infinity or NaN where the flag `where()` holds; derivatives of finite x are kept."""
        f, zero = self._apply_operation, self._number(0.0)
        return f("select", f("is_finite", x), f("select", where(), x, zero), x)

    def _refuse_overflow(self, result: int, g: int, w: int) -> int:
        """NaN where w is infinite and g is not zero: the operand has overflown, but w has a slope in truth."""
        f = self._apply_operation
        known = f("or", f("is_finite", w), f("eq", g, self._number(0.0)))
        return f("select", known, self._number(math.nan), result)

    def _rules(self, w: int, op: str, operands: Sequence[int], attribute: Any = None) -> Sequence[_Rule | None]:
        """As `rules`, and for `integer_pow` the power rule."""
        if op == "integer_pow":
            return [lambda g: self._power_derivative(operands[0], attribute, g)]
        return self.rules(w, op, operands)

    def _single_use_rules(self, w: int, op: str, operands: Sequence[int], attribute: Any) -> Sequence[_Rule | None]:
        """As `_rules`, for the only cotangent of w: factors 2 and ½ are placed where they cancel with others."""
        if op == "sqrt" and not self.graph.grows(w):
            return [lambda g: self._apply_operation("mul", self._number(0.5), self._apply_operation("div", g, w))]
        if op == "mul" and operands[0] == operands[1]:
            return [lambda g: self._power_derivative(operands[0], 2, g)]
        return self._rules(w, op, operands, attribute)

    def _power_derivative(self, base: int, exponent: float, g: int) -> int:
        """The cotangent p uᵖ⁻¹ g of the base of uᵖ: finite at u = 0, unlike that of the products and roots in uᵖ."""
        lower = base if exponent == 2 else self._apply_operation("pow", base, self._number(exponent - 1))
        slope = self._apply_operation("mul", self._number(exponent), lower)
        return self._mask_product(self._apply_operation("mul", g, slope), g, slope)

    # ---- the graph ----

    def node_to_differentiate(self, i: int) -> Node:
        """Node i, or `integer_pow` of its base if it is recorded as a power, whose derivative is one operation."""
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
    """The straight line from the inputs, then tangents of the inputs `by`, to the tangents of the outputs `of`.

    `dtypes` has the type of every input of `line`. After the tangents, the result takes the values of the outputs
    `known`, which it does not compute again. `in_jax`: JAX may transpose the result, so that it must stay linear.
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
    """The transpose of `pushforward`: it takes cotangents of the outputs `of` and gives those of the inputs `by`."""
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
    """As `pullback`, and also the cotangents of entries of tables that are not inputs in `by` and for which `varies`.

    For each such table two outputs follow those of the inputs: the index of an entry, and its cotangent. `is_linear`:
    the line computes tangents, linear in the inputs `by`.
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
    """One straight line for a line and its tangents along several directions.

    Input i of `line` is input `places[i]` of the result, its tangent along direction d is input `directions[d][i]`; a
    missing input has tangent zero. `tables[d]` maps a table that is only looked up to the table of its tangents. Each
    output in `of` is a pair (output, direction), with direction None for the output itself.
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
    """The derivative nodes of one `node` of a line by the inputs `by`; `nodes` are the ids of the line in the graph."""
    slopes = slopes_in(graph, line, nodes, node, by)
    return [slopes[i] if i in slopes else graph.number(0.0) for i in by]


def slopes_in(graph: Graph, line: Any, nodes: Sequence[int], node: int, by: Container[int]) -> dict[int, int]:
    """The derivatives {input: node} of one `node` by those of the inputs `by` on which it depends."""
    return _PlacedLine(graph, line, nodes).pull({node: graph.number(1.0)}, by)


def tangents_in(
    graph: Graph, line: StraightLine, nodes: list[int], of_inputs: dict[int, int], places: dict[int, int]
) -> dict[int, int]:
    """The tangents {node of the line: tangent} from those of its inputs, `of_inputs`, as nodes of the graph.

    `nodes` are the ids of the line in the graph; the tangent of input i is input `places[i]`.
    """
    return _PlacedLine(graph, line, nodes).tangents(of_inputs, places)


def _kind(dtype) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


class _PlacedLine(Derivatives):
    """Derivatives of a straight line whose nodes are copied into a graph as `nodes`; they are added to that graph."""

    def __init__(self, graph: Graph, line: Any, nodes: Sequence[int]):
        super().__init__(graph)
        self.line, self.nodes = line, nodes

    @classmethod
    def from_line(cls, line: StraightLine, dtypes: Sequence, more: int = 0) -> "_PlacedLine":
        """The line in a new graph, with inputs of types `dtypes` and `more` floats after them."""
        graph = Graph(_LARGEST_DERIVATIVE * len(line.nodes) + 1000)
        inputs = [graph.input(i, kind) for i, kind in enumerate([*map(_kind, dtypes), *["float"] * more])]
        with np.errstate(all="ignore"):
            return cls(graph, line, copy_nodes(graph, line, inputs))

    def finish_line(self, results: list[int], known: Sequence[int], first: int) -> StraightLine:
        """The straight line of the nodes `results`; it reads the outputs `known` as inputs from position `first` on."""
        results, count = results + [self.nodes[self.line.outputs[i]] for i in known], len(results)
        done = eliminate_dead_code(*sink_negations(*factor(self.graph, results)))
        values = done.outputs[count:]
        positions = {node: first + k for k, node in enumerate(values) if done.nodes[node][1]}
        nodes = tuple(("input", (), positions[i]) if i in positions else node for i, node in enumerate(done.nodes))
        return eliminate_dead_code(done.replace(nodes=nodes), done.outputs[:count])

    def tangents(
        self, of_inputs: dict[int, int], places: dict[int, int], beside: "TangentTable | None" = None
    ) -> dict[int, int]:
        """The tangents {node of the line: tangent} of all nodes that have one, from those of the inputs.

        The tangent of input i is input `places[i]`. `beside` maps any other table to that of the tangents of its
        entries; None: they have none.
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
        """The cotangents {input: cotangent} of those of `inputs` that matter, from the cotangents of nodes of the line.

        At an infinite slope the cotangent is infinite; behind a zero slope, as on the flat side of max(q, 0), it is
        zero, and so it is in a branch that is not taken. Cotangents of entries of tables for which `varies` are
        appended to `tables` as (table, index, cotangent), or added to the inputs if the table consists of `inputs`.
        """
        line, nodes, results, above = self.line, self.nodes, {}, find_ancestors(self.line.nodes, cotangents)
        varied, flat = self._find_varying_nodes(above, inputs, varies), ("mul",) if is_linear else ("max", "min")
        beneath = self._find_root_operands(above, varied, is_linear)
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
        """The float nodes in `among` that depend on `inputs`, or on entries of a table for which `varies`."""
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
        """For each node, the (predicate, branch) pairs of `select` under which alone it is read; inputs have none.

        A pair is kept only if the branch contains nodes that may be infinite or NaN, and none of these is read
        elsewhere.
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
        """The cotangent `part` that node k passes on, set to 0 where g is 0, even at an infinite slope (u**0.5 at 0).

        A program has a finite number in place of such a slope (`_recurrences.finite`), so that g is 0 there. The root
        of a power passes on 0 at a base of zero.
        """
        nodes, (op, operands, _) = self.line.nodes, self.line.nodes[k]
        by_root = op == "div" and (of := nodes[operands[1]][0]) not in ("input", "constant") and OPERATIONS[of].steep
        if not (self.asks and (OPERATIONS[op].steep or by_root or (op == "div" and k in self._find_guarded_nodes))):
            return part
        if k in self._roots_of_powers:
            part = self._select_unless_zero(self.nodes[operands[0]], part)
        return self._select_unless_zero(g, part)

    @functools.cached_property
    def _roots_of_powers(self) -> set[int]:
        """The nodes √u that occur only in products with u, as in u √u = u^1.5, which has a slope at u = 0."""
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
                    elif op != "mul" and k not in self._find_guarded_nodes:
                        roots.discard(root)
        return roots

    @functools.cached_property
    def _find_guarded_nodes(self) -> set[int]:
        """The products and quotients whose value, or a multiple of it, is tested by `is_finite` in the line."""
        guarded: set[int] = set()
        for k in range(len(self.nodes) - 1, -1, -1):
            op, operands, _ = self.line.nodes[k]
            if op == "is_finite" or (k in guarded and op in ("mul", "div", "neg")):
                guarded.update(operands)
        return guarded

    def _select_unless_zero(self, number: int, part: int) -> int:
        """The node of `part`, with 0 in place of NaN where `number` is zero; derivatives of finite parts are kept."""
        f, zero = self.graph.apply, self._number(0.0)
        return f("select", f("eq", number, zero), part, f("select", f("is_finite", part), zero, part))

    def _find_root_operands(self, among: Sequence[int], varied: set[int], is_linear: bool) -> set[int]:
        """The varying nodes on which an operation with an infinite slope depends.

        In a line of tangents, which is linear, they are found by the tests for zero that `_zero_where_zero` wrote.
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
    """The table with the tangents of the entries of `table`; None if they have none."""
    if table.numbers is not None:
        return None
    if table.first not in places:
        return None if beside is None else beside(table)
    return table.moved(places)
