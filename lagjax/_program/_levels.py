"""The pieces of a program and their borders: the values that stages of `_borders` hand on, and kernels read.

A *guard* is a border of a piece: σ (u − level) > 0 on it, with σ = ±1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._border_forces import Slide
from lagjax._program._features import UP_TO, Feature
from lagjax._program._graph import Graph, find_ancestors
from lagjax._program._kick import Kick
from lagjax._program._look_ups import Located, Table
from lagjax._program._series import StraightLine

# The kinds of pieces; `CLOCK` is the piece of a table that the time itself is on, whose borders are known.
SIGN, FLOOR, TRUNC, SLIDE, TABLE, CLOCK, CONE = range(7)
NOTHING = 2.0**-500  # the length of a vector at rest, whose square is there


class Affine(NamedTuple):
    """`slope` p + `offset`, of a piece p."""

    slope: float
    offset: float

    def __call__(self, piece):
        return piece * self.slope + self.offset


class Level(NamedTuple):
    """`slope` p + `offset`, of a piece p, and `below` more where p ≤ 0, `above` more where p ≥ 0."""

    slope: float = 0.0
    offset: float = 0.0
    below: float = 0.0
    above: float = 0.0

    def __call__(self, piece, number_where: Callable):
        """The level of a piece; `number_where(condition, x)` is x where the condition holds, else 0."""
        level = piece * self.slope + self.offset + number_where(piece <= 0.0, self.below)
        return level + number_where(piece >= 0.0, self.above)


class Guard(NamedTuple):
    """A border of piece number `piece`: of its switching number u, σ (u − level) > 0, with σ = ±1 the `side`.

    Beyond it the piece is `beyond`, whose border on this side is guard `back`.

    Where both sides push onto the border of `piece`, piece number `slide` becomes 1: the motion slides along it, with
    α of the acceleration on the upper side and 1 − α of that on the lower one; its piece is the one below, and guard
    `rest` the border. α is the switching number of `slide`; beyond its guards the motion continues with the guard `on`
    at a piece that is larger by `gains`. These are −1 where there is none. `order` is that of the rate of u that is
    zero there (`_sliding.Slide`). Where `of_table` is 1 the level is the entry of that number of the piece's table.
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


@dataclass(frozen=True, eq=False)
class Pieced:
    """A program that takes its pieces as its last inputs, or only some of the numbers of a member (`Recurrent`)."""

    line: StraightLine
    size: int
    dtypes: Sequence[np.dtype]
    linear: Any
    mechanics: StraightLine | None = None


class Borders(NamedTuple):
    """The borders of a program with m pieces, and its features.

    `program` takes the inputs, then the pieces; `switches` (m,) are the nodes of the switching numbers in it, and
    `arguments` those of the arguments of `features`, of which alike ones stand side by side. `decide`
    takes the same and then m flags: it gives the pieces of a state, or the piece that is given where the flag is 1.
    `nested` says whether switching numbers depend on pieces. `tables` (m,) has that of every piece that is one of a
    table; those of a `CLOCK` have no guards. `motion` has the borders of the motion alone, where this is one with
    tangents (`_jump.with_borders_of_tangents`). `kick` is that at borders at which L jumps, None where there are none.
    `retraction` takes the inputs of the program to the state on the borders that it slides along, None where it may
    slide along none; `moved` are the coordinates that each moves, `groups` the group of each, and `release` is that of
    the cones (`_sliding.Sliding`). Along so many borders, `unheld`, it may slide, and that is not followed.
    """

    program: Pieced
    switches: tuple[int, ...]
    kinds: tuple[int, ...]
    decide: StraightLine
    guards: tuple[Guard, ...]
    nested: bool
    arguments: tuple[int, ...]
    features: tuple[Feature, ...]
    tables: tuple[Located | None, ...] = ()
    motion: "Borders | None" = None
    kick: Kick | None = None
    retraction: StraightLine | None = None
    moved: tuple[frozenset[int], ...] = ()
    groups: tuple[int, ...] = ()
    release: StraightLine = StraightLine((), (), ())
    unheld: int = 0

    @property
    def groups_of_guards(self) -> list[int]:
        """The group of each guard of a border by velocity that the motion slides along, and of its shares.

        −1 for others. Those of different groups may be crossed at one instant, in one step.
        """
        shares = [j for j, kind in enumerate(self.kinds) if kind == SLIDE]
        of_shares, found = dict(zip(shares, self.groups, strict=True)), []
        for guard in self.guards:
            border = self.guards[guard.on] if guard.on >= 0 else guard
            known = border.order == 1 and self.kinds[border.piece] != CONE
            found.append(of_shares[border.slide] if known else -1)
        return found

    @property
    def kicking(self) -> tuple[int, ...]:
        return () if self.kick is None else self.kick.pieces

    @property
    def releases(self) -> list[int]:
        kinds = {g: self.kinds[self.guards[guard.on].piece] for g, guard in enumerate(self.guards) if guard.on >= 0}
        return [g for g, kind in kinds.items() if kind == CONE]

    @property
    def clocks(self) -> tuple[int, ...]:
        return tuple(j for j, kind in enumerate(self.kinds) if kind == CLOCK)

    def moving_table(self, j: int) -> Table | None:
        """The table of parameters whose entries are the levels of piece j; None where it has none."""
        located = self.tables[j] if self.kinds[j] in (TABLE, CLOCK) else None
        return None if located is None or located.table.numbers is not None else located.table

    @property
    def levels_move(self) -> bool:
        return any(self.moving_table(j) is not None for j in range(len(self.switches)))

    @property
    def shaken(self) -> tuple[int, ...]:
        """The pieces whose switching numbers may jump at the next entry of a clock, or where another piece changes."""
        first = self.program.size - len(self.switches)
        pieces = {("input", (), first + j) for j, kind in enumerate(self.kinds) if kind != SLIDE}
        nodes, shaken = self.program.line.nodes, []
        for j, node in enumerate(self.switches):
            if self.kinds[j] != SLIDE and any(nodes[i] in pieces for i in nodes_below(self.program.line, [node])):
                shaken.append(j)
        return tuple(shaken)

    @property
    def abrupt(self) -> tuple[int, ...]:
        """The nodes of what is zero where a root has no series."""
        return tuple(u for u, of in zip(self.arguments, self.features, strict=True) if of.kind == UP_TO)

    @property
    def followed(self) -> tuple[int, ...]:
        return self.switches + self.arguments

    def kicks_in_time(self, states: int) -> list[int]:
        """The pieces with which L jumps whose switching numbers depend on the time alone, but no clocks."""
        others = (j for j in self.kicking if self.kinds[j] != CLOCK)
        return [j for j in others if self.read_by(self.switches[j]).isdisjoint(range(states))]

    def read_by(self, node: int) -> frozenset[int]:
        """The inputs that a node of the program depends on; pieces are the last ones."""
        return inputs_below(self.program.line, [node])


def piece_of(graph: Graph, kind: int, x: int, table: Located | None) -> int:
    if table is not None:
        return graph.apply("locate", x, attribute=table)
    if kind == SIGN:
        return graph.apply("sign", x)
    if kind == CONE:
        moves = graph.apply("gt", x, graph.constant(2 * NOTHING, "float"))
        return graph.apply("select", moves, *(graph.constant(p, "float") for p in (-1.0, 1.0)))
    below = graph.apply("floor", x)
    if kind == FLOOR:
        return below
    return graph.apply("select", graph.apply("lt", x, graph.constant(0.0, "float")), below, graph.apply("ceil", x))


def list_guards(kinds: Sequence[int], slides: Sequence[Slide]) -> tuple[Guard, ...]:
    """The guards of all pieces; piece number `slides[k].piece` slides where the k-th of the last ones is 1.

    Those of one piece stand side by side: of several that are violated where no time passes the first one counts, and
    this many borders that push onto each other come to rest (Murty, Linear Algebra Appl. 9 (1974) 65).
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


def nodes_below(line: StraightLine | Graph, roots: Sequence[int]) -> set[int]:
    """The nodes that some nodes depend on, and these."""
    return set(find_ancestors(line.nodes, roots))


def inputs_below(line: StraightLine | Graph, roots: Sequence[int]) -> frozenset[int]:
    """The inputs that some nodes depend on."""
    return frozenset(line.nodes[i][2] for i in nodes_below(line, roots) if line.nodes[i][0] == "input")
