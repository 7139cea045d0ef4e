"""Last passes over a finished graph, when it is known how often every node is used."""

import functools
from collections import Counter
from collections.abc import Callable

from lagjax._program._graph import LONGEST, Graph, Node

Line = tuple[tuple[Node, ...], tuple[str, ...], tuple[int, ...]]  # nodes, kinds and outputs


def factor(graph: Graph, outputs: list[int]) -> tuple[Graph, list[int]]:
    """The graph with squares formed first in every product, and with the common factor of a sum drawn out of it.

    Both happen only where the products that they replace have no other use, so that no operation is added: x(x y)
    becomes x² y, and x y + x z becomes x (y + z). What has become equal by that is shared, sin² + cos² too.
    """
    uses = _uses(graph, outputs)

    def node_of(new, i, moved):
        op, operands, attribute = graph.nodes[i]
        xs, simpler = [moved[x] for x in operands], None
        if graph.kinds[i] == "float" and op == "mul":
            simpler = _square_first(new, [moved[x] for x in _factors(graph, uses, i)])
        elif graph.kinds[i] == "float" and op in ("add", "sub") and 1 in (uses[x] for x in operands):
            simpler = _common_factor(new, op, *xs)
        return new.apply(op, *xs, attribute=attribute) if simpler is None else simpler

    return _rebuilt(graph, outputs, uses, node_of)


def _rebuilt(graph, outputs, used, node_of: Callable) -> tuple[Graph, list[int]]:
    """A new graph, node by node; `node_of(new, i, moved)` makes node i, with `moved` to say where the old ones are."""
    new, moved = Graph(2 * graph.budget), {}
    for i in sorted(used):
        op, _, attribute = graph.nodes[i]
        if op in ("input", "constant"):
            moved[i] = getattr(new, op)(attribute, graph.kinds[i])
        else:
            moved[i] = node_of(new, i, moved)
    return new, [moved[i] for i in outputs]


def _factors(graph, uses, i) -> list[int]:
    """What a product consists of, looking into products that have no other use, a few at most."""
    factors, k = list(graph.nodes[i][1]), 0
    while k < len(factors):
        op, operands, _ = graph.nodes[factors[k]]
        if op == "mul" and uses[factors[k]] == 1 and len(factors) < LONGEST:
            factors[k : k + 1] = operands
        else:
            k += 1
    return factors


def _square_first(graph, factors) -> int | None:
    """Their product, if one of them comes twice."""
    counts = Counter(factors)
    if len(factors) < 3 or max(counts.values()) < 2:
        return None

    def product(nodes):
        return functools.reduce(lambda a, b: graph.apply("mul", a, b), nodes)

    squares = [graph.apply("mul", x, x) for x, n in counts.items() for _ in range(n // 2)]
    single = [x for x, n in counts.items() if n % 2]
    return product([product(nodes) for nodes in (squares, single) if nodes])


def _common_factor(graph, op, a, b) -> int | None:
    """x (y ± z) for x y ± x z."""
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
    """The graph with every negation moved into the difference or the constant below it, if nothing else uses that."""
    uses = _uses(graph, outputs)

    def node_of(new, i, moved):
        op, operands, attribute = graph.nodes[i]
        turned = _negative(new, moved[operands[0]]) if op == "neg" and uses[operands[0]] == 1 else None
        return new.node(op, *(moved[x] for x in operands), attribute=attribute) if turned is None else turned

    return _rebuilt(graph, outputs, uses, node_of)


def _negative(graph, i) -> int | None:
    """`-i` without an operation more than `i` itself, if there is such a thing."""
    op, operands, _ = graph.nodes[i]
    if op == "sub":
        return graph.node("sub", *operands[::-1])
    if op in ("mul", "div"):
        for k, operand in enumerate(operands):
            if (value := graph.value(operand)) is not None and graph.kinds[i] == "float":
                opposite = graph.constant(-value, "float")
                return graph.node(op, *(opposite if k == j else x for j, x in enumerate(operands)))
    return None


def eliminate_dead_code(graph: Graph, outputs: list[int]) -> Line:
    """The nodes that the outputs depend on, renumbered."""
    position = {i: k for k, i in enumerate(sorted(_uses(graph, outputs)))}
    nodes = (graph.nodes[i] for i in position)
    renumbered = tuple((op, tuple(position[i] for i in operands), attribute) for op, operands, attribute in nodes)
    return renumbered, tuple(graph.kinds[i] for i in position), tuple(position[i] for i in outputs)


def live(nodes, kinds, outputs) -> Line:
    """The nodes that some outputs of a straight line depend on, renumbered."""
    graph = Graph(len(nodes) + 1)
    graph.nodes, graph.kinds = list(nodes), list(kinds)
    return eliminate_dead_code(graph, list(outputs))


def replace_by_inputs(nodes, kinds, outputs, positions: dict[int, int]) -> Line:
    """A straight line in which some nodes, whose values are known, are inputs at these positions instead."""
    graph = Graph(len(nodes) + 1)
    graph.nodes = [("input", (), positions[i]) if i in positions else node for i, node in enumerate(nodes)]
    graph.kinds = list(kinds)
    return eliminate_dead_code(graph, list(outputs))


def _uses(graph, outputs) -> Counter:
    """How often each live node is used, by a live node or as an output."""
    uses = Counter(outputs)
    for i in range(len(graph.nodes) - 1, -1, -1):
        if i in uses:
            uses.update(graph.nodes[i][1])
    return uses
