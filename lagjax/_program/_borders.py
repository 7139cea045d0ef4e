"""The borders of a program, where its motion passes from one piece to the next, in one object.

decisions   the program with its pieces as inputs, and its narrow features (`_decisions`, `_features`)
kicks       the pieces with which L jumps (`_kick`)
slides      the borders along which the motion may slide, and the program of that motion (`_sliding`)
guards      the borders of all pieces as inequalities (`_levels`)
decide      the pieces of a state where a motion starts (`_beginnings`)
"""

import functools
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._beginnings import decide_pieces, signed_distances
from lagjax._program._border_forces import Slide
from lagjax._program._cones import velocity_degrees
from lagjax._program._deciding import PIECEWISE, inputs_below
from lagjax._program._decisions import LARGEST_REWRITING, DecidedProgram, find_decisions
from lagjax._program._differentiation import copy_nodes, pullback
from lagjax._program._features import UP_TO, Feature
from lagjax._program._graph import Graph, find_ancestors
from lagjax._program._jump_search import JumpSearch
from lagjax._program._kick import VelocityKick, build_kick, find_kicking_pieces
from lagjax._program._levels import CLOCK, CONE, SIGN, SLIDE, Decision, Guard, list_guards
from lagjax._program._look_ups import Table
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._rounding import rounding
from lagjax._program._series import Recurrent, StraightLine
from lagjax._program._sliding import LARGEST_COPIED, MOST_SLIDING, Holding, with_sliding

LARGEST_WITH_ROUNDING = 500  # operations of numbers that are watched, and whose rounding is: three times as many
_WITHOUT_ANY = {"input", "constant", "add", "sub", "neg", "sin", "cos"}  # no piece, no feature


@dataclass(frozen=True, eq=False)
class PiecedProgram:
    """A program whose last inputs are its pieces, or one that takes only some of its parameters (`Recurrent`)."""

    line: StraightLine
    size: int
    dtypes: Sequence[np.dtype]
    linear: Any
    mechanics: StraightLine | None = None


class Borders(NamedTuple):
    """The borders of a program with m pieces, and its narrow features.

    `program` takes the inputs, then the pieces; `decisions` (m,) define these; `arguments` are the argument nodes of
    `features`, sorted by feature. `decide` takes the inputs, m proposed pieces and m flags: it gives the pieces of a
    state, or the proposed ones where the flag is 1. `nested`: switching numbers depend on pieces. Pieces of a `CLOCK`
    have no guards. `motion` has the borders of the motion alone, if this is a motion with tangents
    (`_jump.with_borders_of_tangents`). `kick` is the kick at borders where L jumps, None without them; `holding` keeps
    the motion on borders along which it slides.
    """

    program: PiecedProgram
    decisions: tuple[Decision, ...]
    decide: StraightLine
    guards: tuple[Guard, ...]
    nested: bool
    arguments: tuple[int, ...]
    features: tuple[Feature, ...]
    holding: Holding
    kick: VelocityKick | None = None
    motion: "Borders | None" = None

    @property
    def switches(self) -> tuple[int, ...]:
        return tuple(decision.switch for decision in self.decisions)

    @property
    def kinds(self) -> tuple[int, ...]:
        return tuple(decision.kind for decision in self.decisions)

    @property
    def groups_of_guards(self) -> list[int]:
        """For each guard of a border by velocity, or of its shares, the group of its slide; −1 for other guards.

        Guards of different groups may be crossed at one instant, in one step.
        """
        shares = [j for j, decision in enumerate(self.decisions) if decision.kind == SLIDE]
        of_shares, found = dict(zip(shares, self.holding.groups, strict=True)), []
        for guard in self.guards:
            border = self.guards[guard.on] if guard.on >= 0 else guard
            known = border.order == 1 and self.decisions[border.piece].kind != CONE
            found.append(of_shares[border.slide] if known else -1)
        return found

    @property
    def kicking(self) -> tuple[int, ...]:
        return () if self.kick is None else self.kick.pieces

    @property
    def releases(self) -> list[int]:
        borders = {g: self.guards[guard.on] for g, guard in enumerate(self.guards) if guard.on >= 0}
        return [g for g, border in borders.items() if self.decisions[border.piece].kind == CONE]

    @property
    def clocks(self) -> tuple[int, ...]:
        return tuple(j for j, decision in enumerate(self.decisions) if decision.kind == CLOCK)

    def moving_table(self, j: int) -> Table | None:
        """The table whose entries are the levels of piece j, if they are parameters; else None."""
        located = self.decisions[j].table
        return None if located is None or located.table.numbers is not None else located.table

    @property
    def levels_move(self) -> bool:
        return any(self.moving_table(j) is not None for j in range(len(self.decisions)))

    @property
    def dependent_pieces(self) -> tuple[int, ...]:
        """The pieces whose switching number reads another piece, and may therefore jump when that piece changes."""
        nodes, first = self.program.line.nodes, self.program.size - len(self.decisions)
        decided = [j for j, decision in enumerate(self.decisions) if decision.kind != SLIDE]
        pieces = {("input", (), first + j) for j in decided}
        return tuple(j for j in decided if any(nodes[i] in pieces for i in self._below(self.decisions[j].switch)))

    @property
    def root_arguments(self) -> tuple[int, ...]:
        """The argument nodes of the features where a root has no series."""
        return tuple(u for u, of in zip(self.arguments, self.features, strict=True) if of.kind == UP_TO)

    @property
    def followed(self) -> tuple[int, ...]:
        return self.switches + self.arguments

    def kicks_in_time(self, states: int) -> list[int]:
        """The pieces with which L jumps whose switching number is a function of time alone, other than clocks."""
        others = (j for j in self.kicking if self.decisions[j].kind != CLOCK)
        return [j for j in others if self.read_by(self.decisions[j].switch).isdisjoint(range(states))]

    def read_by(self, node: int) -> frozenset[int]:
        """The positions of the inputs on which a node of the program depends; pieces are the last inputs."""
        return inputs_below(self.program.line, [node])

    def _below(self, node: int) -> list[int]:
        return find_ancestors(self.program.line.nodes, [node])


def borders(program: Recurrent, size: int, slides: bool = True, watched: int = 0) -> Borders | None:
    """The borders of a program of q, q̇, t and parameters whose first `size` outputs are q̈; None if it is smooth.

    With `slides` the motion may slide along borders that depend on velocities (`_sliding`). The last `watched` outputs
    are evaluated along the motion too: their decisions have borders as well.
    """
    with np.errstate(all="ignore"):
        found = _find_borders(program, size, slides, watched, False)
        is_refused = found is not None and found.kick is not None and bool(found.kick.refused)
        return _find_borders(program, size, slides, watched, True) if is_refused else found


def _find_borders(program: Recurrent, size: int, slides: bool, watched: int, beside: bool) -> Borders | None:
    """The borders; with `beside`, steps end next to borders of a root, and L may turn out not to jump there."""
    if (mechanics := getattr(program, "mechanics", None)) is not None:
        count = len(mechanics.outputs)
        whole = with_outputs(program, mechanics)
        decided = find_decisions(whole, size, slides, watched + count, beside)
        if decided is not None and decided.decisions and (kicking := find_kicking_pieces(decided, count)):
            again = functools.partial(find_decisions, whole, size, slides, watched + count, beside)
            return _build_borders(whole, decided, slides, again, count, kicking)
    if _WITHOUT_ANY.issuperset(op for op, *_ in program.line.nodes):
        return None
    decided = find_decisions(program, size, slides, watched, beside)
    again = functools.partial(find_decisions, program, size, slides, watched, beside)
    return decided and _build_borders(program, decided, slides, again, 0, {})


def _build_borders(
    program: Recurrent, decided: DecidedProgram, slides: bool, again: Callable, mechanics: int, kicking: dict
) -> Borders:
    """The borders of a program with decisions; `again(apart=j)` finds them with both sides of piece j written.

    The last `mechanics` outputs are the quantities of a kick, which the result leaves out; `kicking` has its pieces.
    """
    sliding, lost = _find_slides(decided, kicking) if slides else ([], [])
    if len(lost) == 1 and len(decided.line.nodes) <= LARGEST_COPIED:
        decided = again(apart=lost[0])
        kicking = find_kicking_pieces(decided, mechanics) if mechanics else {}
        sliding, _ = _find_slides(decided, kicking)
    line, n, switches = decided.line, decided.n, decided.switches
    at_rest = [slide for slide in sliding if slide.order == 1]
    for some in (sliding, *([at_rest] if len(at_rest) < len(sliding) else ()), []):
        done = with_sliding(line, n, decided.first, switches, some, decided.linear)
        if done is not None:
            break
    assert done is not None  # without slides there is one
    line, places, shares, linear, holding = done
    holding = holding._replace(unheld=len(sliding) - len(some))
    placed = [of_piece._replace(switch=places[of_piece.switch]) for of_piece in decided.decisions]
    decisions = (*placed, *(Decision(SLIDE, share) for share in shares))
    kick = None
    if mechanics:
        kick = build_kick(line, n, decided.first, decisions, mechanics, kicking)
        line = line.replace(outputs=line.outputs[:-mechanics])
    pieces = [np.dtype(float)] * len(decisions)
    nested = not set(decided.pieces).isdisjoint(find_ancestors(decided.line.nodes, switches))
    return Borders(
        PiecedProgram(line, decided.first + len(decisions), (*program.dtypes, *pieces), linear), decisions,
        decide_pieces(decided, some), list_guards([of_piece.kind for of_piece in decisions], some), nested,
        tuple(places[u] for u, _ in decided.features), tuple(feature for _, feature in decided.features), holding, kick,
    )  # fmt: skip


def _find_slides(decided: DecidedProgram, kicking: Container[int]) -> tuple[list[Slide], list[int]]:
    """The borders along which the motion may slide, and the pieces whose border is lost.

    A motion may slide where q̈ jumps but L does not. Borders by velocity come first, and all or none of them are
    returned. A border is lost if further pieces on its far side are unknown.
    """
    line, n, decisions, pieces = decided.line, decided.n, decided.decisions, decided.pieces
    acting, orders = set(find_ancestors(line.nodes, line.outputs[:n])), {}
    acting -= _find_undefined_sides(decided, acting)
    for j, decision in enumerate(decisions):
        jumps = decision.kind != SIGN or pieces[j] in decided.jumping
        if decision.kind != CLOCK and pieces[j] in acting and j not in kicking and jumps:
            read = [i for i in inputs_below(line, [decision.switch]) if i < 2 * n]
            orders |= {j: 2 if max(read) < n else 1} if read else {}
    # The sign of a force is a corner where |force| rubs, but the slopes that it is solved by jump. An interpolation has
    # a corner at its entries, and no jump.
    degrees, lost = velocity_degrees(line, n) if orders else [], []
    others = [
        j for j, order in orders.items()
        if decisions[j].kind != CONE and (decisions[j].kind != SIGN or order == 2 or degrees[decisions[j].switch] > 1)
    ]  # fmt: skip
    decides, of_pieces = {j: [] for j in orders}, {pieces[j]: j for j in orders}
    for decision in decisions:
        for i in of_pieces.keys() & set(find_ancestors(line.nodes, [decision.switch])):
            decides[of_pieces[i]].append(decision.switch)
    if others or any(decides.values()):
        search = JumpSearch(decided)
        jumps = search.find(others, line.outputs[:n]) if others else {}
        orders = {j: order for j, order in orders.items() if jumps.get(j, True) is not False}
        lost = [j for j in orders if decides[j] and search.find([j], decides[j])[j]]
        lost = [j for j in lost if orders.pop(j) == 1]
    both = [
        Slide(j, order, 2.0 if decisions[j].kind in (SIGN, CONE) else 1.0, decisions[j].level,
              decided.parts.get(pieces[j], ()))
        for j, order in sorted(orders.items(), key=lambda item: item[1])
    ]  # fmt: skip
    by_velocity = [slide for slide in both if slide.order == 1]
    return both if len(both) <= MOST_SLIDING else by_velocity if len(by_velocity) <= MOST_SLIDING else [], lost


def _find_undefined_sides(decided: DecidedProgram, acting: set[int]) -> set[int]:
    """The pieces for which q̈ is NaN on one side, by a `where` with a NaN branch."""
    nodes, found = decided.line.nodes, set()
    for op, operands, _ in (nodes[i] for i in acting):
        if op == "select" and any(nodes[x][0] == "constant" and nodes[x][2] != nodes[x][2] for x in operands[1:]):
            found |= {x for x in (operands[0], *nodes[operands[0]][1]) if x in decided.pieces}
    return found


class FoundCorners(NamedTuple):
    """The P borders at which outputs of a program of q, q̇, t and parameters jump: `jumps` is (P, outputs), bool.

    `sides` maps the inputs of the program to P numbers, each of which changes sign at its border. `vanish` (P,
    outputs): the output is zero on one side.
    """

    sides: StraightLine
    jumps: np.ndarray
    vanish: np.ndarray


def find_corners(program: Recurrent, size: int) -> FoundCorners | None:
    """The borders by position and time at which outputs jump, for `size` coordinates; None if no output jumps."""
    with np.errstate(all="ignore"):
        decided = find_decisions(program, size, False, len(program.line.outputs), True)
        if decided is None:
            return None
        line, switches, outputs = decided.line, decided.switches, decided.line.outputs
        by_velocity = range(size, 2 * size)
        pieces = [j for j, u in enumerate(switches) if inputs_below(line, [u]).isdisjoint(by_velocity)]
        search = JumpSearch(decided)
        found = [search.find(pieces, [i]) for i in outputs] if pieces else []
        jumps = np.array([[bool(of[j]) for of in found] for j in pieces], bool).reshape(len(pieces), len(outputs))
        pieces, jumps = [j for j, row in zip(pieces, jumps, strict=True) if row.any()], jumps[jumps.any(axis=1)]
        if not pieces:
            return None
        vanish = np.array([search.find_zeros(pieces, i) for i in outputs], bool).T
        sides = signed_distances(line, decided.first, decided.decisions, turning=True)
        return FoundCorners(eliminate_dead_code(sides, [sides.outputs[j] for j in pieces]), jumps, vanish)


def is_smooth(line: StraightLine) -> bool:
    return PIECEWISE.isdisjoint(op for op, *_ in line.nodes)


def distances(found: Borders) -> StraightLine:
    """The line from the inputs without pieces to the distance of each switching number from its nearest level."""
    first = found.program.size - len(found.decisions)
    return signed_distances(found.program.line, first, found.decisions, turning=False)


def with_outputs(program: Recurrent, more: StraightLine, moving: int | None = None) -> PiecedProgram:
    """A program with the outputs of a second line of the same inputs appended; common operations are shared.

    If `moving`, the number of inputs that vary, is given, the rounding errors of the added outputs (`rounding`) precede
    them; for a long line they are zero.
    """
    graph = Graph.from_line(program.line, len(program.line.nodes) + 2 * LARGEST_REWRITING * len(more.nodes) + 1000)
    with np.errstate(all="ignore"):
        places = copy_nodes(graph, more)
        errors = [] if moving is None else [graph.constant(0.0, "float")] * len(more.outputs)
        if moving is not None and len(more.nodes) <= LARGEST_WITH_ROUNDING:
            errors = rounding(graph, more, places, moving)
    outputs = (*program.line.outputs, *errors, *(places[i] for i in more.outputs))
    line = StraightLine(tuple(graph.nodes), tuple(graph.kinds), outputs)
    mechanics = getattr(program, "mechanics", None)
    return PiecedProgram(line, program.size, program.dtypes, program.linear, mechanics)


def gradient(borders: Borders, by: Sequence[int]) -> StraightLine:
    """The line of the derivatives by the inputs `by` of Σ hⱼ uⱼ, with m weights hⱼ after the inputs of the program."""
    program = borders.program
    line = eliminate_dead_code(program.line, borders.switches)
    return pullback(line, program.dtypes, by, range(len(borders.switches)))
