"""Last passes over a finished graph, when it is known how often every node is used."""

from collections import Counter

from lagjax._program._graph import Graph, Node


def finish(graph: Graph, outputs: list[int]) -> tuple[tuple[Node, ...], tuple[str, ...], tuple[int, ...]]:
    """Nodes, kinds and outputs of what the outputs depend on, in its final form and order."""
    return _compact(*_turn_signs(graph, outputs))


def _turn_signs(graph, outputs):
    """A sign that nothing absorbed moves into the difference or the constant below it, if nothing else uses that."""
    uses, moved = _uses(graph, outputs), {}
    new = Graph(2 * graph.budget)
    for i in sorted(uses):
        op, operands, attribute = graph.nodes[i]
        if op == "input":
            moved[i] = new.input(attribute, graph.kinds[i])
        elif op == "constant":
            moved[i] = new.constant(attribute, graph.kinds[i])
        else:
            turned = _negative(new, moved[operands[0]]) if op == "neg" and uses[operands[0]] == 1 else None
            given = (moved[operand] for operand in operands)
            moved[i] = new.node(op, *given, attribute=attribute) if turned is None else turned
    return new, [moved[i] for i in outputs]


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


def _compact(graph, outputs):
    """Only what is used, renumbered."""
    position = {i: k for k, i in enumerate(sorted(_uses(graph, outputs)))}
    nodes = (graph.nodes[i] for i in position)
    renumbered = tuple((op, tuple(position[i] for i in operands), attribute) for op, operands, attribute in nodes)
    return renumbered, tuple(graph.kinds[i] for i in position), tuple(position[i] for i in outputs)


def with_given(nodes, kinds, outputs, given: dict[int, int]):
    """The same where some nodes, whose values are known, are inputs at the positions given."""
    graph = Graph(len(nodes) + 1)
    graph.nodes = [("input", (), given[i]) if i in given else node for i, node in enumerate(nodes)]
    graph.kinds = list(kinds)
    return _compact(graph, list(outputs))


def _uses(graph, outputs) -> Counter:
    """How often each live node is used, by a live node or as an output."""
    uses = Counter(outputs)
    for i in range(len(graph.nodes) - 1, -1, -1):
        if i in uses:
            uses.update(graph.nodes[i][1])
    return uses
