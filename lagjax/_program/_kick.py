"""The kick at a border where L jumps: the velocities behind it from those before it.

Across the border u(q, t) = 0 the motion still makes ∫ L dt stationary. With p = ∂L/∂q̇, h = p·q̇ − L and constraints G
q̇ = −d this implies the corner conditions of Weierstrass and Erdmann,

    p⁺ = p⁻ + μ ∇u + Gᵀλ,    h⁺ = h⁻ − μ ∂u/∂t − λ·d,    G q̇⁺ = −d.

Where u depends on time alone, μ is not needed: p is continuous but for the constraints' impulses. Where it depends on
q, p is continuous along the border. For L = ½ q̇·M q̇ + a·q̇ − V both conditions have a closed form: with w the
velocities for μ = 0, and M n = ∇u + Gᵀν, G n = 0,

    q̇⁺ = w + μ n,    u̇⁺² = b² + 2 c (h⁻ − h⁺(w) − λ·d),    b = ∇u·w + ∂u/∂t,  c = ∇u·n,  μ = (u̇⁺ − b) / c,

and u̇⁺ has the sign of u̇⁻. Where the right side is negative the energy does not suffice and the motion is reflected:
the same formula with equal sides and u̇⁺ = −u̇⁻. Source: Gelfand & Fomin, *Calculus of Variations*, §15.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

from lagjax._program._deciding import inputs_below
from lagjax._program._decisions import DecidedProgram
from lagjax._program._differentiation import gradient_in
from lagjax._program._graph import Graph
from lagjax._program._jump_search import BothSides, JumpSearch
from lagjax._program._levels import Decision
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import StraightLine
from lagjax._program._small_equations import dot, eliminate, sparse_row, substitute

JUMPING_CONSTRAINT = "a constraint prescribes a speed that jumps"  # a reason to refuse a kick
_BY_VELOCITY = "L or the momentum p = dL/dqdot jumps, and no law gives the velocities after it"
_NOT_QUADRATIC = (
    "L or the momentum p = dL/dqdot jumps, and L is not quadratic in qdot, so that the velocities behind that are not "
    "known in closed form"
)
# The part of its terms by which the rate of a constraint has to jump: less is rounding of where the border is, and
# the impulse that it asks for changes velocities by no more.
RATE_JUMP_TOLERANCE = 1e-9
_LARGEST_KICK = 60  # operations that one may become: a bound for errors


class Mechanics(NamedTuple):
    """The nodes in the corner conditions: L, p (n,), M (n, n), G (m, n), the constraint rates G q̇ + d and d (m,)."""

    lagrangian: int
    momentum: tuple[int, ...]
    mass_matrix: tuple[int, ...]
    jacobian: tuple[int, ...]
    rates: tuple[int, ...]
    driving: tuple[int, ...]

    @classmethod
    def from_nodes(cls, nodes: Sequence[int], n: int) -> "Mechanics":
        m = (len(nodes) - 1 - n - n * n) // (n + 2)
        ends = itertools.accumulate([1, n, n * n, m * n, m, m])
        first, *parts = (tuple(nodes[a:b]) for a, b in itertools.pairwise([0, *ends]))
        return cls(first[0], *parts)


class VelocityKick(NamedTuple):
    """The kick at borders where L jumps.

    `line` takes q, q̇, t, the parameters, the m pieces before and behind the border, then the weights of the switching
    numbers (`_jump.Jump`). It gives q̇ behind the border, and 1 if the motion passes, 0 if it is reflected, in which
    case it is called with equal pieces on both sides. `pieces` are those with which L jumps; `refused` ones have no
    law.
    """

    line: StraightLine
    pieces: tuple[int, ...]
    refused: tuple[tuple[int, str], ...] = ()


# ---- with which pieces L jumps ---------------------------------------------------------------------------------------


def find_kicking_pieces(decided: DecidedProgram, count: int) -> dict[int, str | None]:
    """The pieces with which L or p jumps, each with the reason why no closed form exists, or None if one does.

    The last `count` outputs of the program are the nodes of `Mechanics`.
    """
    line, n, first = decided.line, decided.n, decided.first
    of, search, jumping = Mechanics.from_nodes(line.outputs[-count:], n), JumpSearch(decided), {}
    for nodes in ([of.lagrangian, *of.momentum], of.rates):
        read = inputs_below(line, nodes)
        candidates = [j for j in range(len(decided.decisions)) if first + j in read]
        found = search.find(candidates, nodes) if candidates else {}
        jumping |= {j: nodes is of.rates for j, jumps in found.items() if jumps}
    for j in sorted(jumping, reverse=True):  # beyond a piece that others are decided by, these may be other ones
        decided_by = {i - first for i in inputs_below(line, [decided.decisions[j].switch]) if i >= first}
        jumping |= {k: jumping[j] for k in decided_by if k not in jumping}

    def reads_velocity(nodes):
        return not inputs_below(line, nodes).isdisjoint(range(n, 2 * n))

    is_quadratic = not reads_velocity([*of.mass_matrix, *of.jacobian])
    reasons: dict[int, str | None] = {}
    for j, by_constraint in jumping.items():
        reasons[j] = None if is_quadratic else _NOT_QUADRATIC
        if by_constraint:
            reasons[j] = JUMPING_CONSTRAINT
        elif reads_velocity([decided.decisions[j].switch]):
            reasons[j] = _BY_VELOCITY
    return reasons


# ---- the closed form -------------------------------------------------------------------------------------------------


def build_kick(
    line: StraightLine, n: int, size: int, decisions: Sequence[Decision], count: int, kicking: dict[int, str | None]
) -> VelocityKick:
    """The kick of a program with `size` inputs before its pieces; its last `count` outputs are those of `Mechanics`."""
    spatial = [j for j in kicking if not inputs_below(line, [decisions[j].switch]).isdisjoint(range(n))]
    # At corners where the rate of a constraint jumps, velocities are NaN: no law gives those after it.
    corners = [j for j in spatial if kicking[j] == JUMPING_CONSTRAINT]
    refused = tuple((j, reason) for j, reason in kicking.items() if reason is not None and j not in corners)
    if refused:
        return VelocityKick(StraightLine((), (), ()), tuple(kicking), refused)
    mechanics, m = Mechanics.from_nodes(line.outputs[-count:], n), len(decisions)
    graph = Graph(_LARGEST_KICK * (len(line.nodes) + (n + len(mechanics.rates)) ** 3) + 10_000)
    sides = BothSides(graph, line, size, m)
    f, zero = graph.apply, graph.number(0.0)
    slopes = [zero] * (n + 1)
    for j in spatial:
        of_one = gradient_in(graph, line, sides.before, decisions[j].switch, [*range(n), 2 * n])
        hit = graph.input(size + 2 * m + j, "float")
        slopes = [f("add", x, f("mul", hit, g)) for x, g in zip(slopes, of_one, strict=True)]
    passes = bent = graph.constant(False, "bool")
    for j in spatial:
        change = f("ne", graph.input(size + j, "float"), graph.input(size + m + j, "float"))
        passes, bent = f("or", passes, change), f("or", bent, change) if j in corners else bent
    kicked, is_enough = _kick_velocities(graph, sides, mechanics, slopes, passes)
    bent = f("and", bent, _rate_jumps(graph, sides, mechanics, n)) if corners else bent
    kicked = [f("select", bent, x, graph.number(math.nan)) for x in kicked]
    return VelocityKick(eliminate_dead_code(graph, [*kicked, is_enough]), tuple(kicking))


def _rate_jumps(graph: Graph, sides: BothSides, of: Mechanics, n: int) -> int:
    """The flag that the rate of a constraint jumps at this state; a piece may bend it at other states only."""
    f, turns = graph.apply, graph.constant(False, "bool")
    for k, rate in enumerate(of.rates):
        row, v = of.jacobian[k * n : (k + 1) * n], [graph.input(n + i, "float") for i in range(n)]
        row = [sides.behind[i] for i in row]
        slope, speed = (
            functools.reduce(lambda a, x: f("add", a, f("abs", x)), xs, graph.number(0.0)) for xs in (row, v)
        )
        bound = f("mul", graph.number(RATE_JUMP_TOLERANCE), f("mul", slope, speed))
        turns = f("or", turns, f("lt", bound, f("abs", sides.difference(rate))))
    return turns


def _kick_velocities(
    graph: Graph, sides: BothSides, mechanics: Mechanics, slopes: Sequence[int], passes: int
) -> tuple[list[int], int]:
    """The velocities behind u = 0, and 1 if the energy suffices, else 0; `slopes` are those of u by (q, t)."""
    n, f, zero, one, behind = len(slopes) - 1, graph.apply, graph.number(0.0), graph.number(1.0), sides.behind
    v, normal, by_time = [graph.input(n + i, "float") for i in range(n)], slopes[:n], slopes[n]
    change_p, change_l = [sides.difference(i) for i in mechanics.momentum], sides.difference(mechanics.lagrangian)
    rates, mass = [behind[i] for i in mechanics.rates], [behind[i] for i in mechanics.mass_matrix]
    solve = _solve_saddle(graph, mass, [behind[i] for i in mechanics.jacobian], n)
    d, minus_lambda = solve([f("neg", x) for x in change_p], [f("neg", x) for x in rates])
    w = [f("add", x, y) for x, y in zip(v, d, strict=True)]
    across, _ = solve(normal, [zero] * len(rates))
    # h⁺(w) − h⁻ + λ·d from differences of both sides alone.
    middle = [f("add", x, f("mul", graph.number(0.5), y)) for x, y in zip(v, d, strict=True)]
    moved = [dot(graph, mass[i * n : (i + 1) * n], d) for i in range(n)]
    gained = f("add", f("sub", dot(graph, change_p, v), change_l), dot(graph, middle, moved))
    gained = f("sub", gained, dot(graph, minus_lambda, [behind[i] for i in mechanics.driving]))
    b, c = f("add", dot(graph, normal, w), by_time), dot(graph, normal, across)
    rate = f("add", dot(graph, normal, v), by_time)
    in_space = f("gt", c, zero)
    c = f("select", in_space, one, c)
    squared = f("sub", f("mul", b, b), f("mul", graph.number(2.0), f("mul", c, gained)))
    squared = f("select", in_space, one, squared)
    speed = f("sqrt", squared)
    speed = f("select", f("eq", f("gt", rate, zero), passes), f("neg", speed), speed)
    mu = f("select", in_space, zero, f("div", f("sub", speed, b), c))
    kicked = [f("add", x, f("mul", mu, y)) for x, y in zip(w, across, strict=True)]
    return kicked, f("select", f("lt", squared, zero), one, zero)


def _solve_saddle(graph: Graph, mass: Sequence[int], jacobian: Sequence[int], n: int):
    """A function `(r, c)` → d, −λ that solves M d − Gᵀλ = r, G d = c."""
    m, zero = len(jacobian) // n if n else 0, graph.constant(0.0, "float")
    rows = [[*mass[i * n : (i + 1) * n], *(jacobian[k * n + i] for k in range(m))] for i in range(n)]
    rows += [[*jacobian[k * n : (k + 1) * n], *[zero] * m] for k in range(m)]
    factors = eliminate(graph, [sparse_row(graph, row) for row in rows])

    def solve(r: Sequence[int], c: Sequence[int]) -> tuple[list[int], list[int]]:
        x = substitute(graph, factors, [*r, *c])
        return x[:n], x[n:]

    return solve
