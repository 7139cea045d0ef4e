"""The force that each sliding border exerts: the change of r in A z = r between the two sides of the border."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lagjax._program._differentiation import replace_nodes, slopes_in
from lagjax._program._graph import Graph, find_descendants, find_readers
from lagjax._program._operations import LOOK_UPS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import LinearSystem, StraightLine
from lagjax._program._small_equations import Sparse, dot

_BENT, _STATES = 1e-9, 32  # of a chord, of which rounding is a thousandth; and random states, for pieces of all kinds
LARGEST_SLIDING = 10_000_000  # operations: a bound for errors
# The length of the vector of a cone that is as good as none: forces hardly change near it, and its square is
# there. What friction does along each of its parts is read off there.
_TINY = 2.0**-300


class Slide(NamedTuple):
    """A border to slide along, of piece number `piece`: the rate of its switching number u of this `order` stays zero.

    The order is 1 for a border that depends on velocities, 2 for one by position. While the motion slides, the piece is
    the lower one; the upper one is larger by `width`. `level(graph, piece)` is the level of u between them.

    For a cone, u is the length of a vector of `parts`, all of which stay zero: dry friction in the plane.
    """

    piece: int
    order: int
    width: float
    level: Callable[[Graph, int], int]
    parts: tuple[int, ...] = ()


class Row(NamedTuple):
    """A number `offset` that stays zero on border number `slide`; `below` is the value of μ on the lower side."""

    slide: int
    offset: int
    below: float


class SlidingRows(NamedTuple):
    """The `rows`, numbers that stay zero while a motion slides; `of_slides` has the range of rows of each slide.

    `pieces` are the nodes of the pieces of the slides, and `flags` are true where the motion slides.
    """

    graph: Graph
    n: int
    slides: Sequence[Slide]
    pieces: list[int]
    flags: list[int]
    rows: list[Row]
    of_slides: list[range]

    @classmethod
    def from_slides(
        cls, line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide]
    ) -> "SlidingRows":
        """The rows of a program whose pieces are inputs from `first` on, with the switching numbers `switches`."""
        graph, rows, of_slides = Graph.from_line(line, LARGEST_SLIDING), [], []
        pieces = [graph.input(first + slide.piece, "float") for slide in slides]
        for k, (slide, piece) in enumerate(zip(slides, pieces, strict=True)):
            count = len(rows)
            if slide.parts:
                rows += [Row(k, u, 0.0) for u in slide.parts]
            else:
                offset = graph.apply("sub", switches[slide.piece], slide.level(graph, piece))
                rows.append(Row(k, offset, -1.0))
            of_slides.append(range(count, len(rows)))
        inputs = [graph.input(first + len(switches) + k, "float") for k in range(len(slides))]
        flags = [graph.apply("gt", flag, graph.number(0.5)) for flag in inputs]
        return cls(graph, n, slides, pieces, flags, rows, of_slides)

    def order(self, k: int) -> int:
        return self.slides[self.rows[k].slide].order

    def group(self, of_rows: Sequence) -> list[list]:
        return [[of_rows[m] for m in rows] for rows in self.of_slides]

    def rate(self, k: int) -> tuple[Sparse, int, int]:
        """For row k, with w = u or u̇ the quantity that stays zero: ∂w/∂q̇ (sparse), −∂w/∂q q̇ − ∂w/∂t, and w."""
        graph, n, node = self.graph, self.n, self.rows[k].offset
        level, slopes = node, {}
        for _ in range(self.order(k)):
            nodes = range(len(graph.nodes))
            level, slopes = node, dict(sorted(slopes_in(graph, graph, nodes, node, range(2 * n + 1)).items()))
            by_place = {i: x for i, x in slopes.items() if i < n}
            velocities = [graph.input(n + i, "float") for i in by_place]
            by_time = slopes.get(2 * n, graph.number(0.0))
            node = graph.apply("add", dot(graph, by_place.values(), velocities), by_time)
        by_velocity = {i - n: x for i, x in slopes.items() if n <= i < 2 * n}
        return by_velocity, graph.apply("neg", node), level

    def _nodes_of_sides(self, row: Row) -> tuple[dict[int, int], dict[int, int], float]:
        """Replacements {node: node} for the lower and upper side of a border, and the factor of μ in their difference.

        For a cone the sides are: its vector zero and at rest, and its vector tiny with one component only.
        """
        slide, piece, number = self.slides[row.slide], self.pieces[row.slide], self.graph.number
        if slide.parts:
            none = dict.fromkeys(slide.parts, number(0.0))
            return none | {piece: number(-1.0)}, none | {row.offset: number(_TINY), piece: number(1.0)}, 1.0
        if slide.width > 1:
            return {piece: number(-1.0)}, {piece: number(1.0)}, 0.5
        return {}, {piece: self.graph.apply("add", piece, number(1.0))}, 0.5

    def find_forces(self, linear: LinearSystem) -> list[Sparse] | None:
        """The sparse vectors ∂r/∂μₖ of all rows; None if pieces act on more than the right side of A z = r."""
        graph, right = self.graph, linear.right
        matrix = *linear.entries.values(), *linear.others.values(), *linear.factors
        if not set(self.pieces).isdisjoint(graph.find_ancestors(matrix)):
            return None
        readers, needed, entries = find_readers(graph.nodes), set(graph.find_ancestors(right)), {}
        for i, x in enumerate(right):
            entries.setdefault(x, []).append(i)
        acts = []
        for row in self.rows:
            below, above, factor = self._nodes_of_sides(row)
            among = sorted(needed.intersection(find_descendants(readers, above)))
            # A part of a vector at rest is not what it is on both sides: there the other parts are zero.
            for sides in ([below], [above]) if self.slides[row.slide].parts else ([below, above],):
                replace_nodes(graph, among, sides)
            act = {}
            for i, x in sorted((i, node) for node in above for i in entries.get(node, ())):
                change = graph.apply("sub", above[x], below.get(x, x))
                if graph.value(change) != 0:
                    act[i] = graph.apply("mul", graph.number(factor), change)
            acts.append(act)
        return acts

    def is_nonlinear(self, right: Sequence[int], acts: Sequence[Sparse], decided: range) -> bool:
        """True if r is not affine in a piece between the two sides of its border, tested at random numbers.

        So it is where two friction forces change each other's normal forces nonlinearly. Then the value that one takes
        at rest, between both sides, does not determine the second.
        """
        graph, draw, line = self.graph, np.random.default_rng(0), eliminate_dead_code(self.graph, right)
        if any(op in LOOK_UPS for op, *_ in line.nodes):
            return False
        pieces = frozenset(self.pieces)
        reading = set()
        for (k, *_), act in zip(self.rows, acts, strict=True):
            if self.slides[k].width > 1 and pieces.intersection(graph.find_ancestors(act.values())) - {self.pieces[k]}:
                reading.add(k)
        for k in reading:
            columns = draw.uniform(0.3, 1.2, (1 + max(node[2] for node in graph.nodes if node[0] == "input"), _STATES))
            columns[decided] = draw.choice([-1.0, 1.0], (len(decided), _STATES))
            at = []
            for side in (-1.0, 0.0, 1.0):
                columns[graph.nodes[self.pieces[k]][2]] = side
                at.append(np.array([np.broadcast_to(x, _STATES) for x in line.evaluate(list(columns))]))
            chord, part = at[2] - at[0], at[1] - at[0]
            off = part - chord * (np.sum(part * chord, axis=0) / np.sum(chord * chord, axis=0))
            if (np.abs(off).max(axis=0) > _BENT * np.abs(chord).max(axis=0)).any():
                return True
        return False
