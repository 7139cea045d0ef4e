"""Passes over a finished graph: they use how often every node is used."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence

from lagjax._program._graph import LONGEST_SUM, Graph, Node, find_ancestors
from lagjax._program._line import StraightLine


def factor(graph: Graph, outputs: list[int]) -> tuple[Graph, list[int]]:
    """Rewrite products with squares first, x(x y) as x² y, and draw common factors out of sums, x y + x z as x (y + z).

    Both are done only where the products replaced have no further use, so that no operation is added. Nodes that become
    equal are shared, and sin² + cos² is simplified. Returns the new graph and the ids of the outputs in it.
    """
    uses = count_uses(graph.nodes, outputs)

    def node_of(new, i, moved):
        op, operands, _ = graph.nodes[i]
        if graph.kinds[i] != "float":
            return None
        if op == "mul" and any([uses[x] == 1 and graph.nodes[x][0] == "mul" for x in operands]):
            return _multiply_squares_first(new, [moved(x) for x in _product_factors(graph, uses, i)])
        if op in ("add", "sub") and (uses[operands[0]] == 1 or uses[operands[1]] == 1):
            return _common_factor(new, op, *(moved(x) for x in operands))
        return None

    return _rewrite_graph(graph, outputs, uses, node_of, Graph.apply)


def _rewrite_graph(graph, outputs, uses, node_of: Callable, make: Callable) -> tuple[Graph, list[int]]:
    """Copy the used nodes to a new graph, node i as `node_of(new, i, moved)` or, where that is None, by `make`.

    `moved(x)` is the id in the new graph of an earlier node x. Returns the new graph and the ids of the outputs.
    """
    new, places = Graph(graph.budget), {}
    new.budget += LONGEST_SUM * len(uses)  # what a pass writes anew and drops again is not what the budget is for
    for i in range(len(uses)):
        if not uses[i]:
            continue
        op, operands, attribute = graph.nodes[i]
        if op in ("input", "constant"):
            places[i] = getattr(new, op)(attribute, graph.kinds[i])
            continue
        at = node_of(new, i, places.__getitem__)
        places[i] = make(new, op, *[places[x] for x in operands], attribute=attribute) if at is None else at
    return new, [places[i] for i in outputs]


def _product_factors(graph, uses, i) -> list[int]:
    """The factors of product i; those that are products without further use are split, up to `LONGEST_SUM`."""
    factors, k = list(graph.nodes[i][1]), 0
    while k < len(factors):
        op, operands, _ = graph.nodes[factors[k]]
        if op == "mul" and uses[factors[k]] == 1 and len(factors) < LONGEST_SUM:
            factors[k : k + 1] = operands
        else:
            k += 1
    return factors


def _multiply_squares_first(graph, factors) -> int | None:
    """The node of the product of `factors` with squares formed first; None if no factor repeats."""
    counts = Counter(factors)
    if any(graph.value(x) is not None and n > 1 for x, n in counts.items()):  # constants that overflow, or underflow
        return None
    if len(factors) < 3 or max(counts.values()) < 2:
        return None

    def product(nodes):
        return functools.reduce(lambda a, b: graph.apply("mul", a, b), nodes)

    squares = [graph.apply("mul", x, x) for x, n in counts.items() for _ in range(n // 2)]
    single = [x for x, n in counts.items() if n % 2]
    return product([product(nodes) for nodes in (squares, single) if nodes])


def _common_factor(graph, op, a, b) -> int | None:
    if graph.nodes[a][0] not in ("mul", "neg") or graph.nodes[b][0] not in ("mul", "neg"):
        return None
    (m, first), (n, second) = graph.term(a), graph.term(b)
    if graph.nodes[first][0] != "mul" or graph.nodes[second][0] != "mul" or first == second:
        return None
    left, right = graph.nodes[first][1], graph.nodes[second][1]
    common = next((x for x in left if x in right and graph.value(x) is None), None)
    if common is None:
        return None
    y, z = (xs[1] if xs[0] == common else xs[0] for xs in (left, right))
    return graph.apply("mul", common, graph.apply(op, graph.scale(m, y), graph.scale(n, z)))


def sink_negations(graph: Graph, outputs: list[int]) -> tuple[Graph, list[int]]:
    """Move every negation into its operand where nothing else uses that: −(a − b) is b − a, −(2 x) is (−2) x."""
    uses = count_uses(graph.nodes, outputs)

    def node_of(new, i, moved):
        op, operands, _ = graph.nodes[i]
        return _cheap_negative(new, moved(*operands)) if op == "neg" and uses[operands[0]] == 1 else None

    return _rewrite_graph(graph, outputs, uses, node_of, Graph.node)


def _cheap_negative(graph, i) -> int | None:
    """The node of −i if it needs no further operation: a difference swapped, or a constant negated; else None."""
    op, operands, _ = graph.nodes[i]
    if op == "sub":
        return graph.node("sub", *operands[::-1])
    if op in ("mul", "div"):
        for k, operand in enumerate(operands):
            if (value := graph.value(operand)) is not None and graph.kinds[i] == "float":
                opposite = graph.number(-value)
                return graph.node(op, *(opposite if k == j else x for j, x in enumerate(operands)))
    return None


def eliminate_dead_code(of: Graph | StraightLine, outputs: Sequence[int]) -> StraightLine:
    """The straight line with the given outputs: only the nodes that they depend on, renumbered."""
    nodes, kept = of.nodes, find_ancestors(of.nodes, outputs)
    if len(kept) == len(nodes):
        return StraightLine(tuple(nodes), tuple(of.kinds), tuple(outputs))
    position = dict(zip(kept, range(len(kept)), strict=True))
    renumbered = []
    for i in kept:
        node = op, operands, attribute = nodes[i]
        if len(operands) == 2:
            a, b = operands
            node = op, (position[a], position[b]), attribute
        elif operands:
            node = op, tuple([position[x] for x in operands]), attribute
        renumbered.append(node)
    return StraightLine(tuple(renumbered), tuple([of.kinds[i] for i in kept]), tuple([position[i] for i in outputs]))


def count_uses(nodes: Sequence[Node], outputs: Sequence[int]) -> list[int]:
    """The number of uses of each node, as an operand of a used node or as an output."""
    uses = [0] * len(nodes)
    for i in outputs:
        uses[i] += 1
    for i in range(len(nodes) - 1, -1, -1):
        if uses[i]:
            for x in nodes[i][1]:
                uses[x] += 1
    return uses
