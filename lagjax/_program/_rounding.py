"""Running error bounds of a straight line, to first order, as nodes of a graph.

The error of a result is one rounding of the result, plus the errors of the operands times the slopes, so that terms
that cancel leave their errors. Source: Higham, *Accuracy and Stability of Numerical Algorithms*, §3.3.
"""

from collections.abc import Sequence

from lagjax._program._graph import Graph
from lagjax._program._line import StraightLine
from lagjax._program._operations import OPERATIONS


def rounding(graph: Graph, line: StraightLine, nodes: Sequence[int], moving: int, to_zero: bool = False) -> list[int]:
    """Error bounds of the outputs of a line, in units of round-off; its first `moving` inputs are rounded too.

    `nodes` are the nodes of the line in the graph, to which the error nodes are added. With `to_zero`, an operand
    without error contributes none even where the slope is infinite.
    """
    zero, errors = graph.number(0.0), []
    for (op, operands, attribute), kind, node in zip(line.nodes, line.kinds, nodes, strict=True):
        if kind != "float" or op == "constant" or (op == "input" and attribute >= moving):
            errors.append(zero)
        elif op == "input":
            errors.append(graph.apply("abs", node))
        else:
            given = [nodes[j] for j in operands], [errors[j] for j in operands]
            errors.append(operation_error(graph, op, node, *given, to_zero))
    return [errors[i] for i in line.outputs]


def operation_error(
    graph: Graph, op: str, node: int, operands: Sequence[int], errors: Sequence[int], to_zero: bool = False
) -> int:
    """The error node of one operation `node` from the error nodes of its operands (see `rounding`)."""
    zero = graph.number(0.0)
    error = zero if OPERATIONS[op].exact else graph.apply("abs", node)
    for brought, rule in zip(errors, OPERATIONS[op].transpose(), strict=False):
        if rule is not None and brought != zero:
            slope = rule(graph.apply, graph.number, graph.number(1.0), node, *operands)
            part = graph.apply("mul", brought, graph.apply("abs", slope))
            if to_zero and (OPERATIONS[op].steep or op == "div"):
                part = graph.apply("select", graph.apply("eq", brought, zero), part, zero)
            error = graph.apply("add", error, part)
    return error
