"""The transposed derivative of a straight line, as a straight line: reverse mode on the nodes of a graph.

Every operation passes the cotangent of its result on to its operands, from the last to the first, by the formulas of
its row in `_operations`. What comes of it is simplified and shared like any other graph.
"""

from collections.abc import Sequence

import numpy as np

from lagjax._program._graph import Graph
from lagjax._program._look_ups import Table, moved
from lagjax._program._operations import LOOK_UPS, OPERATIONS
from lagjax._program._passes import eliminate_dead_code, factor, replace_by_inputs, sink_negations
from lagjax._program._series import StraightLine

_LARGEST = 100  # operations that one may become: a bound for errors, three are usual


def pullback(line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=()) -> StraightLine:
    """The transposed derivative: from the inputs and the cotangents of the outputs `of` to those of the inputs `by`.

    `dtypes` has the type of every input of `line`. Its inputs come first, the cotangents after them, and after those
    the values of the outputs `known`, which are not computed once more.
    """
    return pullback_and_entries(line, dtypes, by, of, known)[0]


def pullback_and_entries(
    line: StraightLine, dtypes: Sequence, by: Sequence[int], of: Sequence[int], known=()
) -> tuple[StraightLine, tuple[Table, ...]]:
    """`pullback`, and the cotangents of the entries of tables that are not among the inputs `by`.

    For each of the tables two outputs come behind those of the inputs: the index of an entry, and its cotangent.
    """
    graph = Graph(_LARGEST * len(line.nodes) + 1000)
    inputs = [graph.input(i, _kind(dtype)) for i, dtype in enumerate(dtypes)]
    tables: list[tuple[Table, int, int]] = []
    with np.errstate(all="ignore"):
        nodes = copied(graph, line, inputs)
        cotangents: list[int | None] = [None] * len(line.nodes)
        for k, output in enumerate(of):
            _add(graph, cotangents, line.outputs[output], graph.input(len(dtypes) + k, "float"))
        results = _back(graph, line, nodes, cotangents, by, tables)
        results += [i for _, *entry in tables for i in entry]
        count = len(results)
        results += [nodes[line.outputs[i]] for i in known]
        done = StraightLine(*eliminate_dead_code(*sink_negations(*factor(graph, results))))
    results, values = done.outputs[:count], done.outputs[count:]
    first = len(dtypes) + len(of)
    positions = {node: first + k for k, node in enumerate(values) if done.nodes[node][1]}
    line = StraightLine(*replace_by_inputs(done.nodes, done.kinds, results, positions))
    return line, tuple(table for table, *_ in tables)


def gradient_in(graph: Graph, line: StraightLine, nodes: list[int], node: int, by: Sequence[int]) -> list[int]:
    """The derivatives of one node of a line by the inputs `by`, as nodes of the graph in which the line is `nodes`."""
    cotangents: list[int | None] = [None] * len(line.nodes)
    cotangents[node] = graph.constant(1.0, "float")
    return _back(graph, line, nodes, cotangents, by)


def _kind(dtype) -> str:
    return "float" if np.issubdtype(dtype, np.floating) else np.dtype(dtype).name


def copied(graph: Graph, line: StraightLine, inputs: Sequence[int], places: Sequence[int] | None = None) -> list[int]:
    """The nodes of the line in the graph; tables begin at other inputs where `places` says what input i has become."""
    nodes: list[int] = []
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        if op == "input":
            nodes.append(graph.real(inputs[attribute]))
        elif op == "constant":
            nodes.append(graph.constant(attribute, kind))
        else:
            here = moved(attribute, places) if op in LOOK_UPS and places is not None else attribute
            nodes.append(graph.apply(op, *(nodes[i] for i in operands), attribute=here))
    return nodes


def _back(
    graph: Graph, line: StraightLine, nodes: list[int], cotangents: list, by: Sequence[int], tables: list | None = None
) -> list[int]:
    """The cotangents of the inputs `by`, from those of the outputs.

    Those of entries of a table are added to `tables`: the table, the index, and the cotangent; or, where the table
    consists of inputs `by`, to each of these.
    """
    varied: list[bool] = []
    inputs = frozenset(by)
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        if op == "take":
            varied.append(attribute.numbers is None and (tables is not None or attribute.first in inputs))
            continue
        varied.append(kind == "float" and (attribute in inputs if op == "input" else any(varied[i] for i in operands)))
    results = {}

    def number(x: float) -> int:
        return graph.constant(x, "float")

    for k in range(len(line.nodes) - 1, -1, -1):
        (op, operands, attribute), g = line.nodes[k], cotangents[k]
        if g is None or not varied[k]:
            continue
        if op == "input":
            _add(graph, results, attribute, g)
            continue
        if op == "take":
            index = nodes[operands[0]]
            if attribute.first not in inputs:
                assert tables is not None  # else the entry does not vary
                tables.append((attribute, index, g))
            for i, position in enumerate(attribute.positions if attribute.first in inputs else ()):
                at = graph.apply("eq", index, number(float(i)))
                _add(graph, results, position, graph.apply("select", at, number(0.0), g))
            continue
        for i, rule in zip(operands, OPERATIONS[op].transpose(), strict=False):  # a step has no derivative at all
            if rule is not None and varied[i]:
                part = rule(graph.apply, number, g, nodes[k], *(nodes[j] for j in operands))
                _add(graph, cotangents, i, zero_where_zero(graph, line, k, g, part))
    return [results[i] if i in results else graph.constant(0.0, "float") for i in by]


def zero_where_zero(graph: Graph, line: StraightLine, k: int, g: int, part: int) -> int:
    """The part of `g` that node k passes on: 0 of 0, also where its slope is infinite, as that of u**0.5 at 0.

    There a program has a number in the place of the slope (`_recurrences.finite`), so that g is 0.
    """
    op, operands, _ = line.nodes[k]
    by_root = op == "div" and (of := line.nodes[operands[1]][0]) not in ("input", "constant") and OPERATIONS[of].steep
    if not (OPERATIONS[op].steep or by_root):
        return part
    zero = graph.constant(0.0, "float")
    return graph.apply("select", graph.apply("eq", g, zero), part, zero)


def _add(graph: Graph, cotangents: "list | dict", i: int, part: int) -> None:
    before = cotangents.get(i) if isinstance(cotangents, dict) else cotangents[i]
    cotangents[i] = part if before is None else graph.apply("add", before, part)
