"""The transposed derivative of a straight line, as a straight line: reverse mode on the nodes of a graph.

Every operation passes the cotangent of its result on to its operands, from the last to the first, by the formulas of
its row in `_operations`. What comes of it is simplified and shared like any other graph.
"""

from collections.abc import Sequence

import numpy as np

from lagjax._program._graph import Graph
from lagjax._program._operations import OPERATIONS
from lagjax._program._passes import eliminate_dead_code, factor, replace_by_inputs, sink_negations
from lagjax._program._series import StraightLine

_LARGEST = 100  # operations that one may become: a bound for errors, three are usual


def pullback(line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=()) -> StraightLine:
    """The transposed derivative: from the inputs and the cotangents of the outputs `of` to those of the inputs `by`.

    `dtypes` has the type of every input of `line`. Its inputs come first, the cotangents after them, and after those
    the values of the outputs `known`, which are not computed once more.
    """
    graph = Graph(_LARGEST * len(line.nodes) + 1000)
    inputs = [graph.input(i, _kind(dtype)) for i, dtype in enumerate(dtypes)]
    with np.errstate(all="ignore"):
        nodes = copied(graph, line, inputs)
        cotangents: list[int | None] = [None] * len(line.nodes)
        for k, output in enumerate(of):
            _add(graph, cotangents, line.outputs[output], graph.input(len(dtypes) + k, "float"))
        results = _back(graph, line, nodes, cotangents, by)
        results += [nodes[line.outputs[i]] for i in known]
        done = StraightLine(*eliminate_dead_code(*sink_negations(*factor(graph, results))))
    results, values = done.outputs[: len(by)], done.outputs[len(by) :]
    first = len(dtypes) + len(of)
    positions = {node: first + k for k, node in enumerate(values) if done.nodes[node][1]}
    return StraightLine(*replace_by_inputs(done.nodes, done.kinds, results, positions))


def gradient_in(graph: Graph, line: StraightLine, nodes: list[int], node: int, by: Sequence[int]) -> list[int]:
    """The derivatives of one node of a line by the inputs `by`, as nodes of the graph in which the line is `nodes`."""
    cotangents: list[int | None] = [None] * len(line.nodes)
    cotangents[node] = graph.constant(1.0, "float")
    return _back(graph, line, nodes, cotangents, by)


def _kind(dtype) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


def copied(graph: Graph, line: StraightLine, inputs: list[int]) -> list[int]:
    """The nodes of the line in the graph."""
    nodes: list[int] = []
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        if op == "input":
            nodes.append(inputs[attribute])
        elif op == "constant":
            nodes.append(graph.constant(attribute, kind))
        else:
            nodes.append(graph.apply(op, *(nodes[i] for i in operands), attribute=attribute))
    return nodes


def _back(graph: Graph, line: StraightLine, nodes: list[int], cotangents: list, by: Sequence[int]) -> list[int]:
    """The cotangents of the inputs `by`, from those of the outputs."""
    varied: list[bool] = []
    wanted = frozenset(by)
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        varied.append(kind == "float" and (attribute in wanted if op == "input" else any(varied[i] for i in operands)))
    results = {}

    def number(x: float) -> int:
        return graph.constant(x, "float")

    for k in range(len(line.nodes) - 1, -1, -1):
        (op, operands, attribute), g = line.nodes[k], cotangents[k]
        if g is None or not varied[k]:
            continue
        if op == "input":
            results[attribute] = g
            continue
        for i, rule in zip(operands, OPERATIONS[op].transpose(), strict=False):  # a step has no derivative at all
            if rule is not None and varied[i]:
                part = rule(graph.apply, number, g, nodes[k], *(nodes[j] for j in operands))
                _add(graph, cotangents, i, zero_where_zero(graph, line, k, g, part))
    return [results[i] if i in results else graph.constant(0.0, "float") for i in by]


def zero_where_zero(graph: Graph, line: StraightLine, k: int, g: int, part: int) -> int:
    """What node k passes on of `g`: 0 of 0, also where its slope is infinite, as that of u**0.5 at 0.

    There a program has a number in the place of the slope (`_recurrences.finite`), so that g is 0.
    """
    op, operands, _ = line.nodes[k]
    by_root = op == "div" and (of := line.nodes[operands[1]][0]) not in ("input", "constant") and OPERATIONS[of].steep
    if not (OPERATIONS[op].steep or by_root):
        return part
    zero = graph.constant(0.0, "float")
    return graph.apply("select", graph.apply("eq", g, zero), part, zero)


def _add(graph: Graph, cotangents: list, i: int, part: int) -> None:
    cotangents[i] = part if cotangents[i] is None else graph.apply("add", cotangents[i], part)
