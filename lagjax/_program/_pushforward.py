"""The derivative of a straight line along one direction, as a straight line: forward mode on the nodes of a graph.

It is linear in the tangents of the inputs. `_transpose` has its transpose, with the same rules.
"""

from collections.abc import Sequence

import numpy as np

from lagjax._program._graph import INPUTS, Graph
from lagjax._program._look_ups import Table
from lagjax._program._operations import OPERATIONS
from lagjax._program._passes import eliminate_dead_code, factor, replace_by_inputs, sink_negations
from lagjax._program._series import StraightLine
from lagjax._program._transpose import copied, zero_where_zero

_LARGEST = 100  # operations that one may become: a bound for errors, three are usual


def pushforward(line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=()) -> StraightLine:
    """From the inputs and the tangents of the inputs `by` to the tangents of the outputs `of`.

    `dtypes` has the type of every input of `line`. Its inputs come first, the tangents after them, and after those the
    values of the outputs `known`, which are not computed once more.
    """
    graph = Graph(_LARGEST * len(line.nodes) + 1000)
    kinds = ["float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name for dtype in dtypes]
    inputs = [graph.input(i, kind) for i, kind in enumerate(kinds)]
    tangents = {i: graph.input(len(inputs) + k, "float") for k, i in enumerate(by)}
    with np.errstate(all="ignore"):
        nodes = copied(graph, line, inputs)
        places = {i: len(inputs) + k for k, i in enumerate(by)}
        moved = along(graph, line, nodes, tangents, places, beside=True)
        zero = graph.constant(0.0, "float")
        results = [moved.get(line.outputs[i], zero) for i in of] + [nodes[line.outputs[i]] for i in known]
        done = StraightLine(*eliminate_dead_code(*sink_negations(*factor(graph, results))))
    results, values = done.outputs[: len(of)], done.outputs[len(of) :]
    first = len(dtypes) + len(by)
    positions = {node: first + k for k, node in enumerate(values) if done.nodes[node][1]}
    return StraightLine(*replace_by_inputs(done.nodes, done.kinds, results, positions))


def with_tangents(
    line: StraightLine, dtypes: Sequence, places: Sequence[int], directions: Sequence[dict[int, int]], of: Sequence
) -> StraightLine:
    """A straight line and its tangents along some directions, in one.

    Input i of `line` is input `places[i]` of the result, its tangent along a direction d input `directions[d][i]`; an
    input that is not there does not move. The outputs are `of`, pairs of an output and a direction, or None for the
    output itself.
    """
    graph = Graph(_LARGEST * len(line.nodes) * (1 + len(directions)) + 1000)
    kinds = ["float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name for dtype in dtypes]
    with np.errstate(all="ignore"):
        ids = [
            place + INPUTS if kind == "float" else graph.input(place, kind)
            for place, kind in zip(places, kinds, strict=True)
        ]
        nodes = copied(graph, line, ids, places)
        moved = []
        for direction in directions:
            tangents = {i: place + INPUTS for i, place in direction.items() if kinds[i] == "float"}
            moved.append(along(graph, line, nodes, tangents, direction))
        zero = graph.constant(0.0, "float")
        results = []
        for output, direction in of:
            node = line.outputs[output]
            results.append(nodes[node] if direction is None else moved[direction].get(node, zero))
        return StraightLine(*eliminate_dead_code(*sink_negations(*factor(graph, results))))


def along(
    graph: Graph, line: StraightLine, nodes: list[int], of_inputs: dict[int, int], places: dict[int, int], beside=False
) -> dict[int, int]:
    """The tangents of the nodes of a line that have some, from those of its inputs.

    The line is `nodes` in the graph, of which the tangents become part. The tangent of input i is input `places[i]`.
    Tables that are not among these have theirs `beside` the inputs.
    """
    tangents: dict[int, int] = {}

    def number(x: float) -> int:
        return graph.constant(x, "float")

    for k, (op, operands, attribute) in enumerate(line.nodes):
        if op == "input" and attribute in of_inputs:
            tangents[k] = graph.real(of_inputs[attribute])
        if op == "take" and (table := _tangents_of(attribute, places, beside)) is not None:
            tangents[k] = graph.apply("take", nodes[operands[0]], attribute=table)
            continue
        moving = [i for i in operands if i in tangents]
        if not moving or line.kinds[k] != "float":
            continue
        if op == "div" and operands[1] in tangents:
            tangent = _of_quotient(
                graph, nodes[k], nodes[operands[1]], tangents.get(operands[0]), tangents[operands[1]]
            )
        else:
            tangent = None
            for i, rule in zip(operands, OPERATIONS[op].transpose(), strict=False):  # a step has no derivative at all
                if rule is not None and i in tangents:
                    part = rule(graph.apply, number, tangents[i], nodes[k], *(nodes[j] for j in operands))
                    part = zero_where_zero(graph, line, k, tangents[i], part)
                    tangent = part if tangent is None else graph.apply("add", tangent, part)
        if tangent is not None and graph.value(tangent) != 0:
            tangents[k] = tangent
    return tangents


def _tangents_of(table: Table, places: dict[int, int], beside: bool) -> Table | None:
    """The table of the tangents of the entries of another one; None where they have none."""
    if table.numbers is not None:
        return None
    if table.first not in places:
        return table._replace(tangents=True) if beside else None
    first = places[table.first]
    stride = places[table.first + table.stride] - first if table.count > 1 else 1
    return table._replace(first=first, stride=stride)


def _of_quotient(graph: Graph, w: int, v: int, of_u: int | None, of_v: int) -> int:
    """(u′ − w v′)/v: one division, where the two rules have two."""
    part = graph.apply("mul", w, of_v)
    return graph.apply("div", graph.apply("neg", part) if of_u is None else graph.apply("sub", of_u, part), v)
