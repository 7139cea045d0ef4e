"""The pieces on which a motion begins, and the distances of a state from the borders of its pieces."""

from collections.abc import Callable, Sequence

from lagjax._program._border_forces import Slide
from lagjax._program._decisions import LARGEST_REWRITING, DecidedProgram, Decision
from lagjax._program._differentiation import copy_nodes, gradient_in
from lagjax._program._graph import Graph, find_ancestors
from lagjax._program._levels import CONE, SIGN
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import StraightLine
from lagjax._program._small_equations import dot


def copy_with_pieces(
    graph: Graph, line: StraightLine, first: int, decisions: Sequence[Decision], decide: Callable | None = None
) -> list[int]:
    """Copy a line with pieces into a graph; its inputs from `first` on, the pieces, are computed from the state.

    Piece j is that of its switching number, or `decide(j, piece, nodes)` with that piece. Returns the ids.
    """

    def find_input(i: int, nodes: list[int]) -> int | None:
        if i < first:
            return None
        piece = decisions[i - first].piece(graph, nodes[decisions[i - first].switch])
        return piece if decide is None else decide(i - first, piece, nodes)

    return copy_nodes(graph, line, find_input)


def signed_distances(line: StraightLine, first: int, decisions: Sequence[Decision], turning: bool) -> StraightLine:
    """The line from the inputs without pieces to the signed distances of switching numbers from their nearest borders.

    A distance is positive on the upper side of each border or, with `turning`, of every second one.
    """
    graph, results = Graph(LARGEST_REWRITING * len(line.nodes) + 1000), []
    f, number = graph.apply, graph.number
    places = copy_with_pieces(graph, line, first, decisions)
    for decision in decisions:
        x = places[decision.switch]
        if decision.kind != SIGN:
            piece = decision.piece(graph, x)
            below, above = decision.distances(graph, x, piece)
            is_nearer = f("prefers", above, below)
            half = f("mul", number(0.5), piece)
            turn = f("sub", number(1.0), f("mul", number(4.0), f("sub", half, f("floor", half))))
            x = f("mul", turn, f("select", is_nearer, above, below))
            x = x if turning else f("select", is_nearer, f("neg", above), below)
        results.append(x)
    return eliminate_dead_code(graph, results)


def decide_pieces(decided: DecidedProgram, slides: Sequence[Slide]) -> StraightLine:
    """The line that decides the pieces at the start of a motion; outputs are the pieces, then the flags of `slides`.

    Inputs are those of the program, a proposed value for each piece and flag, and a 1 for each that must keep it. A
    motion that begins on a border slides along it, or leaves it at once if a side allows it; on a border by position it
    must be at rest. With several borders, some repetitions find which of them it leaves. A slide in progress continues.
    """
    graph, count = Graph(2 * LARGEST_REWRITING * len(decided.line.nodes) + 2000), len(decided.decisions)
    f, zero, one = graph.apply, graph.number(0.0), graph.number(1.0)
    given = [graph.input(decided.first + k, "float") for k in range(2 * (count + len(slides)))]
    stays = [f("gt", flag, graph.number(0.5)) for flag in given[count + len(slides) :]]

    def decide_or_keep(j: int, piece: int, _) -> int:
        return f("select", stays[j], piece, given[j])

    nodes = copy_with_pieces(graph, decided.line, decided.first, decided.decisions, decide_or_keep)
    pieces, flags = [nodes[i] for i in decided.pieces], []
    for slide, flag in zip(slides, given[count : count + len(slides)], strict=True):
        j, piece = slide.piece, pieces[slide.piece]
        begins, below = _test_border_start(decided, graph, nodes, slide, piece)
        if begins is None:  # it begins on one side, and meets the other one at once
            flags.append(flag)
            continue
        if not slide.parts:  # a border that the motion has left does not hold it
            begins = f("and", begins, f("not", stays[j]))
        if slide.order > 1:
            begins = f("and", begins, f("eq", _switching_rate(decided, graph, nodes, j), zero))
        for k in _find_sign_decisions(decided, slide):  # which are passed where what bends u has a rate
            rests = f("eq", _switching_rate(decided, graph, nodes, k), zero)
            begins = f("and", begins, f("or", rests, f("ne", nodes[decided.pieces[k]], zero)))
        flags.append(f("select", begins, flag, one))
        pieces[j] = f("select", begins, piece, below)
    sliding = {slide.piece for slide in slides}
    for j, decision in enumerate(decided.decisions):  # what cannot rest moves
        if decision.kind == CONE and j not in sliding:
            pieces[j] = one
    return eliminate_dead_code(graph, pieces + flags)


def _test_border_start(decided: DecidedProgram, graph: Graph, nodes: list[int], slide: Slide, piece: int):
    """The flag that a motion starts on a border of `piece` (None if not tested), and the piece below that border."""
    f, decision, below = graph.apply, decided.decisions[slide.piece], graph.number(-1.0)
    if decision.kind in (SIGN, CONE):
        return f("le" if slide.parts else "eq", piece, graph.number(0.0)), below
    if slide.order == 1:
        return None, below
    x, lower = nodes[decision.switch], f("sub", piece, graph.number(1.0))
    at_lower, at_upper = (f("eq", x, decision.level(graph, i)) for i in (lower, piece))
    return f("or", at_lower, at_upper), f("select", at_upper, lower, piece)


def _find_sign_decisions(decided: DecidedProgram, slide: Slide) -> list[int]:
    """The sign decisions on which the switching number of a border by position depends."""
    below = find_ancestors(decided.line.nodes, [decided.decisions[slide.piece].switch]) if slide.order > 1 else []
    signs = (k for k, decision in enumerate(decided.decisions) if decision.kind == SIGN)
    return [k for k in signs if decided.pieces[k] in below]


def _switching_rate(decided: DecidedProgram, graph: Graph, nodes: list[int], j: int) -> int:
    """The node of the rate u̇ of switching number j; the nodes of the program have the ids `nodes` in the graph."""
    n = decided.n
    slopes = gradient_in(graph, decided.line, nodes, decided.decisions[j].switch, range(2 * n + 1))
    return graph.apply("add", dot(graph, slopes[:n], [graph.input(n + i, "float") for i in range(n)]), slopes[2 * n])
