"""On which pieces a motion begins, and how far a state is from their borders."""

from collections.abc import Callable, Sequence

from lagjax._program._border_forces import Slide
from lagjax._program._decisions import LARGEST_REWRITING, DecidedProgram, Decision
from lagjax._program._differentiation import copy_nodes, gradient_in
from lagjax._program._graph import Graph, find_ancestors
from lagjax._program._levels import CONE, SIGN
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import StraightLine
from lagjax._program._small_equations import dot


def copy_deciding(
    graph: Graph, line: StraightLine, first: int, decisions: Sequence[Decision], decide: Callable | None = None
) -> list[int]:
    """The nodes of a line with pieces, its inputs from number `first` on, in a graph.

    Piece j is that of its switching number, or `decide(j, piece, nodes)` of the piece that it is as it is written.
    """

    def find_input(i: int, nodes: list[int]) -> int | None:
        if i < first:
            return None
        piece = decisions[i - first].piece(graph, nodes[decisions[i - first].switch])
        return piece if decide is None else decide(i - first, piece, nodes)

    return copy_nodes(graph, line, find_input)


def signed_distances(line: StraightLine, first: int, decisions: Sequence[Decision], turning: bool) -> StraightLine:
    """The differences of all switching numbers from the nearest border of their piece; of the inputs but the pieces.

    They are positive on one side of each border or, `turning`, of every other one.
    """
    graph, results = Graph(LARGEST_REWRITING * len(line.nodes) + 1000), []
    f, number = graph.apply, graph.number
    places = copy_deciding(graph, line, first, decisions)
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
    """The pieces, from the inputs, the pieces before, and a flag for each that is to stay; those of `slides` are last.

    A motion that begins on a border slides along it, and leaves it at once where it may; on one that depends on
    positions it has to be at rest. To begin with all of several borders takes few turns until it is known which ones it
    leaves. A slide continues.
    """
    graph, count = Graph(2 * LARGEST_REWRITING * len(decided.line.nodes) + 2000), len(decided.decisions)
    f, zero, one = graph.apply, graph.number(0.0), graph.number(1.0)
    given = [graph.input(decided.first + k, "float") for k in range(2 * (count + len(slides)))]
    stays = [f("gt", flag, graph.number(0.5)) for flag in given[count + len(slides) :]]

    def decide_or_keep(j: int, piece: int, _) -> int:
        return f("select", stays[j], piece, given[j])

    nodes = copy_deciding(graph, decided.line, decided.first, decided.decisions, decide_or_keep)
    pieces, flags = [nodes[i] for i in decided.pieces], []
    for slide, flag in zip(slides, given[count : count + len(slides)], strict=True):
        j, piece = slide.piece, pieces[slide.piece]
        begins, below = _begin_on_border(decided, graph, nodes, slide, piece)
        if begins is None:  # it begins on one side, and meets the other one at once
            flags.append(flag)
            continue
        if not slide.parts:  # a border that the motion has left does not hold it
            begins = f("and", begins, f("not", stays[j]))
        if slide.order > 1:
            begins = f("and", begins, f("eq", _switching_rate(decided, graph, nodes, j), zero))
        for k in _find_bends(decided, slide):  # which are passed where what bends u has a rate
            rests = f("eq", _switching_rate(decided, graph, nodes, k), zero)
            begins = f("and", begins, f("or", rests, f("ne", nodes[decided.pieces[k]], zero)))
        flags.append(f("select", begins, flag, one))
        pieces[j] = f("select", begins, piece, below)
    sliding = {slide.piece for slide in slides}
    for j, decision in enumerate(decided.decisions):  # what cannot rest moves
        if decision.kind == CONE and j not in sliding:
            pieces[j] = one
    return eliminate_dead_code(graph, pieces + flags)


def _begin_on_border(decided: DecidedProgram, graph: Graph, nodes: list[int], slide: Slide, piece: int):
    """True where a switching number is on a border of its piece, None if that is not asked; and the piece below it."""
    f, decision, below = graph.apply, decided.decisions[slide.piece], graph.number(-1.0)
    if decision.kind in (SIGN, CONE):
        return f("le" if slide.parts else "eq", piece, graph.number(0.0)), below
    if slide.order == 1:
        return None, below
    x, lower = nodes[decision.switch], f("sub", piece, graph.number(1.0))
    at_lower, at_upper = (f("eq", x, decision.level(graph, i)) for i in (lower, piece))
    return f("or", at_lower, at_upper), f("select", at_upper, lower, piece)


def _find_bends(decided: DecidedProgram, slide: Slide) -> list[int]:
    """The pieces of signs that the switching number of a border by position depends on."""
    below = find_ancestors(decided.line.nodes, [decided.decisions[slide.piece].switch]) if slide.order > 1 else []
    signs = (k for k, decision in enumerate(decided.decisions) if decision.kind == SIGN)
    return [k for k in signs if decided.pieces[k] in below]


def _switching_rate(decided: DecidedProgram, graph: Graph, nodes: list[int], j: int) -> int:
    """u̇ of the switching number of piece j, in a graph in which the nodes of the program are `nodes`."""
    n = decided.n
    slopes = gradient_in(graph, decided.line, nodes, decided.decisions[j].switch, range(2 * n + 1))
    return graph.apply("add", dot(graph, slopes[:n], [graph.input(n + i, "float") for i in range(n)]), slopes[2 * n])
