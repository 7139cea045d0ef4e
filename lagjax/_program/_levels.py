"""The levels that separate the pieces of a switching number u, as formulas and as the guards of a kernel.

    kind     piece
    SIGN     the sign of u: −1, 0 or 1
    FLOOR    the whole number below u
    TRUNC    the whole number between u and zero
    TABLE    the interval of an increasing table that contains u; CLOCK where u is the time, whose borders are known
    CONE     1 where a vector of velocities of length u moves, −1 where it rests
    SLIDE    1 where the motion slides along the border of another piece

A *guard* is one border of a piece as an inequality, σ (u − level) > 0 with σ = ±1, that holds on the piece.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from lagjax._program._border_forces import Slide
from lagjax._program._graph import Graph
from lagjax._program._look_ups import Located

SIGN, FLOOR, TRUNC, SLIDE, TABLE, CLOCK, CONE = range(7)
NOTHING = 2.0**-500  # the length of a vector at rest, whose square is there
FAR = 1e100  # from a border that is not there; a share that is beyond 0 and 1: the search for its roots squares it


class Decision(NamedTuple):
    """A decision: its kind, the node of its switching number, and for `TABLE` and `CLOCK` its table."""

    kind: int
    switch: int
    table: Located | None = None

    def piece(self, graph: Graph, x: int) -> int:
        """The node of the piece that contains switching number x."""
        f, number = graph.apply, graph.number
        if self.table is not None:
            return f("locate", x, attribute=self.table)
        if self.kind == SIGN:
            return f("sign", x)
        if self.kind == CONE:
            return f("select", f("gt", x, number(2 * NOTHING)), number(-1.0), number(1.0))
        below = f("floor", x)
        return below if self.kind == FLOOR else f("select", f("lt", x, number(0.0)), below, f("ceil", x))

    def level(self, graph: Graph, piece: int) -> int:
        """The node of the level of the switching number between `piece` and the next one."""
        f, zero, above = graph.apply, graph.number(0.0), graph.apply("add", piece, graph.number(1.0))
        if self.kind in (SIGN, CONE):
            return zero
        if self.table is not None:  # no piece follows the last one
            follows = f("lt", above, graph.number(float(self.table.table.count)))
            return f("select", follows, graph.number(math.inf), f("take", above, attribute=self.table.table))
        return above if self.kind == FLOOR else f("select", f("lt", piece, zero), above, piece)

    def distances(self, graph: Graph, x: int, piece: int) -> tuple[int, int]:
        """The nodes of the distances of switching number x from the borders below and above; not for `SIGN`."""
        f, number = graph.apply, graph.number
        below = f("sub", x, self.level(graph, f("sub", piece, number(1.0))))
        if self.table is not None:
            below = f("select", f("lt", piece, number(0.0)), below, number(FAR))
        return below, f("sub", self.level(graph, piece), x)

    def levels_near(self, u: np.ndarray, entries: Callable, draw: np.random.Generator) -> tuple:
        """Levels near switching numbers u (S,), and the pieces on both sides; `entries(located, i)` reads a table."""
        if self.kind == SIGN:
            return np.zeros_like(u), -np.ones_like(u), np.ones_like(u)
        if self.table is not None:
            inner, count = int(self.table.closed), self.table.table.count  # what is closed is not there outside of it
            index = draw.integers(inner, max(count - inner, inner + 1), len(u))
            return np.where(index < count - inner, entries(self.table, index), np.nan), index - 1.0, index + 0.0
        level = np.round(u)
        if self.kind == FLOOR:
            return level, level - 1.0, level
        level = np.where(level == 0.0, np.where(u < 0.0, -1.0, 1.0), level)
        return level, np.where(level > 0.0, level - 1.0, level), np.where(level > 0.0, level, level + 1.0)


class Affine(NamedTuple):
    """The map p ↦ `slope` p + `offset` of a piece p."""

    slope: float
    offset: float

    def __call__(self, piece):
        return piece * self.slope + self.offset


class Level(NamedTuple):
    """The level of a piece p: `slope` p + `offset`, plus `below` where p ≤ 0, plus `above` where p ≥ 0."""

    slope: float = 0.0
    offset: float = 0.0
    below: float = 0.0
    above: float = 0.0

    def __call__(self, piece, number_where: Callable):
        """The level of a piece; `number_where(condition, x)` gives x where the condition holds, else 0."""
        level = piece * self.slope + self.offset + number_where(piece <= 0.0, self.below)
        return level + number_where(piece >= 0.0, self.above)


class Guard(NamedTuple):
    """A border of piece number `piece` as an inequality of its switching number u: σ (u − level) > 0, σ = ±1 = `side`.

    Beyond it the piece is `beyond`, whose border on this side is guard `back`.

    Where both sides push onto the border, piece number `slide` becomes 1: the motion slides along it, with fraction α
    of the acceleration on the upper side and 1 − α of that on the lower one; `piece` is the lower one, and guard `rest`
    the border. α is the switching number of `slide`; beyond its guards the motion continues at guard `on`, with a piece
    larger by `gains`. −1 means none. `order` is the order of the rate of u that is zero there (`_border_forces.Slide`).
    With `of_table` 1, `level` is an index into the table of the piece.
    """

    piece: int
    side: Affine
    level: Level
    beyond: Affine
    back: int
    slide: int = -1
    on: int = -1
    order: int = 0
    rest: int = -1
    gains: int = 0
    of_table: int = 0


def list_guards(kinds: Sequence[int], slides: Sequence[Slide]) -> tuple[Guard, ...]:
    """The guards of all pieces; the last pieces are flags, the k-th of which is 1 while piece `slides[k].piece` slides.

    Guards of one piece are adjacent: of several violated at one instant the first one is handled first, with which all
    borders that push onto each other come to rest (Murty, Linear Algebra Appl. 9 (1974) 65).
    """
    guards: list[Guard] = []
    as_it_is, zero = Affine(1.0, 0.0), Level()
    sliding = {slide.piece: k for k, slide in enumerate(slides)}
    first = len(kinds) - len(sliding)
    for j, kind in enumerate(kinds[:first]):
        k = len(guards)
        if kind == CLOCK or (kind == CONE and j not in sliding):
            continue
        if kind == CONE:  # whose level is a speed that counts as none
            of_piece = [Guard(j, as_it_is, zero, Affine(0.0, -1.0), k, of_table=1)]
        elif kind == SIGN:
            of_piece = [Guard(j, as_it_is, zero, Affine(-1.0, 0.0), k)]
        else:  # between the numbers p and p + 1, or the entries with these indices, or of a `TRUNC` around 0
            lower, upper = Level(1.0, 0.0), Level(1.0, 1.0)
            if kind == TRUNC:
                lower, upper = Level(1.0, below=-1.0), Level(1.0, above=1.0)
            of_table = int(kind == TABLE)
            of_piece = [
                Guard(j, Affine(0.0, 1.0), lower, Affine(1.0, -1.0), k + 1, of_table=of_table),
                Guard(j, Affine(0.0, -1.0), upper, Affine(1.0, 1.0), k, of_table=of_table),
            ]
        if j in sliding:
            last = k + len(of_piece) - 1  # the upper border of a piece, which that below it slides on
            slide, (_, order, width, *_) = first + sliding[j], slides[sliding[j]]
            of_piece = [guard._replace(slide=slide, order=order, rest=last) for guard in of_piece]
            none = Affine(0.0, 0.0)
            of_piece += [
                Guard(slide, as_it_is, zero, none, last + 1, on=last, rest=last),
                Guard(slide, Affine(-1.0, 0.0), Level(0.0, 1.0), none, last + 2, on=k, rest=last, gains=int(width)),
            ]
            if kind == CONE:  # which is left on one side alone
                of_piece[-2:] = [of_piece[-2]._replace(gains=int(width))]
        guards += of_piece
    return tuple(guards)
