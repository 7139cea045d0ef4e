"""Motion along borders that both sides push onto: the program with the shares of both sides as further unknowns.

On a border u = 0 the acceleration is a share α of that on the upper side, and 1 − α of that on the lower one, with α
such that u stays zero (Filippov, *Differential Equations with Discontinuous Righthand Sides*, 1988, ch. 2, §4). Where u
depends on velocities, u̇ is to be zero; where it depends on positions alone, ü. Several borders at once have their
shares together, from one linear system.

Where pieces act on the right side alone of A z = r, each for itself, they are unknowns of that system: the piece
p + μ instead of p, with A z − Σ μₖ ∂r/∂pₖ = r, and one row more for each, that of u̇ = 0, or μ = 0 where nothing slides.
Its series needs no series of an elimination. Else the program is copied for each of them, a few at most.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from lagjax._program._graph import Graph
from lagjax._program._series import LinearSystem, StraightLine
from lagjax._program._transpose import copied, gradient_in

MOST_SLIDING = 64  # pieces that are unknowns of the linear system: their own elimination takes a third of the cube
MOST_COPIES, LARGEST_COPIED = 4, 4000  # pieces for each of which a program is copied, and its operations
# Of ∂u̇/∂p: what is left of it where other borders hold the motion is nothing, but for rounding.
DEPENDENT = 1e-9
NEARLY_NOTHING = 1e-200  # an effect on u̇ whose share is beyond 0 and 1, and finite
_LARGEST = 10_000_000  # operations: a bound for errors


class Slide(NamedTuple):
    """A border to slide along: that of piece number `piece`. Of its switching number u the rate of this order is zero.

    Order 1 is that of a border that depends on velocities, 2 that of one that does not.
    """

    piece: int
    order: int


class Sliding(NamedTuple):
    """A program with shares; `places` says where the nodes of the one without them are."""

    line: StraightLine
    places: Sequence[int]
    shares: list[int]
    linear: LinearSystem | None


def with_sliding(
    line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide], linear: Any
) -> Sliding | None:
    """The program whose motion slides along the borders `slides` where flags, its last inputs, are 1.

    `first` is the input of the first piece, `switches` are the nodes of the switching numbers. None where that takes
    too many operations.
    """
    if not slides:
        return None
    if linear is not None and len(slides) <= MOST_SLIDING:
        done = _Unknowns(line, n, first, switches, slides, linear).finished()
        if done is not None:
            return done
    if len(slides) > MOST_COPIES or len(line.nodes) > LARGEST_COPIED or any(slide.order > 1 for slide in slides):
        return None
    return _with_copies(line, n, first, switches, slides)


# ---- as unknowns of the linear system --------------------------------------------------------------------------------


class _Unknowns:
    """The program with μ, one number for each of the pieces, as unknowns."""

    def __init__(self, line, n, first, switches, slides, linear):
        self.line, self.n, self.slides, self.linear = line, n, slides, linear
        self.graph = Graph.of(line, _LARGEST)
        self.f, self.zero, self.one = self.graph.apply, self.number(0.0), self.number(1.0)
        self.pieces = [self.graph.input(first + slide.piece, "float") for slide in slides]
        flags = [self.graph.input(first + len(switches) + k, "float") for k in range(len(slides))]
        self.flags = [self.f("gt", flag, self.number(0.5)) for flag in flags]
        self.switches = switches

    def number(self, x: float) -> int:
        return self.graph.constant(x, "float")

    def masked(self, k: int, x: int) -> int:
        """Zero where nothing slides along border k."""
        return self.f("select", self.flags[k], self.zero, x)

    def finished(self) -> Sliding | None:
        """The program; None where pieces act on more than the right side, or not each for itself."""
        acts = self._acts()
        if acts is None:
            return None
        f, n, system, count = self.f, self.n, self.linear, len(self.slides)
        slopes, rates = zip(*map(self._rate, range(count)), strict=True)
        solve = system.solve()

        def solved(right):
            nodes = copied(self.graph, solve.line, [*system.factors, *right])
            return [nodes[i] for i in solve.line.outputs]

        rows = []
        responses = [solved([act.get(i, self.zero) for i in range(len(system.right))])[:n] for act in acts]
        for k in range(count):
            row = [dot(self.graph, slopes[k], response) for response in responses]
            row[k] = f("select", self.flags[k], self.one, row[k])
            rows.append(row)
        lower = eliminate(self.graph, rows, self._safe)
        missing = [f("sub", rate, dot(self.graph, d, system.z[:n])) for d, rate in zip(slopes, rates, strict=True)]
        unknown = substitute(self.graph, rows, lower, missing)
        z = solved(self._pushed(system.right, acts, unknown))
        half = self.number(0.5)
        shares = [
            f("mul", half, f("add", self.one, f("add", p, mu))) for p, mu in zip(self.pieces, unknown, strict=True)
        ]
        linear = self._system(z, unknown, acts, slopes, rates, rows, lower)
        outputs = (*z[:n], *self.line.outputs[n:])
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), outputs)
        return Sliding(line, range(len(self.line.nodes)), shares, linear)

    def _safe(self, k: int, own: int, pivot: int) -> int:
        """∂u̇/∂p, `own`, of a border that both sides push onto is negative; of any other one the share is far away.

        Where others do what it would do, it does nothing.
        """
        f = self.f
        alone = f("lt", pivot, f("mul", self.number(DEPENDENT), own))
        pushes = f("select", alone, self.number(-1 / NEARLY_NOTHING), pivot)
        pushes = f("select", f("lt", own, self.zero), self.number(-NEARLY_NOTHING), pushes)
        return f("select", self.flags[k], self.one, pushes)

    def _pushed(self, right: Sequence[int], acts: Sequence[dict[int, int]], unknown: Sequence[int]) -> list[int]:
        """r + Σ μₖ ∂r/∂pₖ."""
        pushed = list(right)
        for act, mu in zip(acts, unknown, strict=True):
            for i, c in act.items():
                pushed[i] = self.f("add", pushed[i], self.f("mul", c, mu))
        return pushed

    def _acts(self) -> list[dict[int, int]] | None:
        """∂r/∂pₖ, entry by entry: half of the difference of both sides."""
        of_sides = self._of_sides()
        if of_sides is None:
            return None
        half, acts = self.number(0.5), []
        for k in range(len(self.slides)):
            act = {}
            for i, node in enumerate(self.linear.right):
                if k in of_sides.get(node, {}):
                    below, above = of_sides[node][k]
                    act[i] = self.masked(k, self.f("mul", half, self.f("sub", above, below)))
            acts.append(act)
        return acts

    def _of_sides(self) -> dict[int, dict[int, tuple[int, int]]] | None:
        """What depends on pieces, and for each of them its values below and above, the others as they are."""
        graph, system = self.graph, self.linear
        pieces = {node: k for k, node in enumerate(self.pieces)}
        if not pieces.keys().isdisjoint(graph.below([*system.entries.values(), *system.factors])):
            return None
        sides: dict[int, dict[int, tuple[int, int]]] = {}
        both = self.number(-1.0), self.one
        for i in graph.below(system.right):
            if i in pieces:
                sides[i] = {pieces[i]: both}
                continue
            op, operands, attribute = graph.nodes[i]
            moving = [x for x in operands if x in sides]
            among = sorted({k for x in moving for k in sides[x]})
            if len(among) > 1 and not _adds_up(op, operands, sides):
                return None
            values = {}
            for k in among:
                given = ([sides.get(x, {}).get(k, (x, x))[side] for x in operands] for side in (0, 1))
                values[k] = tuple(graph.apply(op, *of, attribute=attribute) for of in given)
            values = {k: pair for k, pair in values.items() if pair[0] != pair[1]}
            if values:
                sides[i] = values
        return sides

    def _rate(self, k: int) -> tuple[list[int], int]:
        """∂w/∂q̇ and −∂w/∂q q̇ − ∂w/∂t of what is to stay zero, u or u̇; zeros where nothing slides."""
        n, node = self.n, self.switches[self.slides[k].piece]
        for _ in range(self.slides[k].order):
            slopes = self._slopes(node)
            velocities = [self.graph.input(n + i, "float") for i in range(n)]
            node = self.f("add", dot(self.graph, slopes[:n], velocities), slopes[2 * n])
        return [self.masked(k, x) for x in slopes[n : 2 * n]], self.masked(k, self.f("neg", node))

    def _slopes(self, node: int) -> list[int]:
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), ())
        return gradient_in(self.graph, line, list(range(len(line.nodes))), node, range(2 * self.n + 1))

    def _system(self, z, unknown, acts, slopes, rates, rows, lower) -> LinearSystem:
        system, count = self.linear, len(self.linear.right)
        others = {(i, count + k): self.f("neg", c) for k, act in enumerate(acts) for i, c in act.items()}
        others |= {
            (count + k, i): d
            for k, of_one in enumerate(slopes)
            for i, d in enumerate(of_one)
            if self.graph.value(d) != 0
        }
        # What `solve` needs besides: the entries, and the elimination of the unknowns.
        own = [*others.values(), *(x for row in rows for x in row), *(x for row in lower for x in row)]
        known = {x: self.graph.value(x) for x in own}
        read = list(dict.fromkeys(x for x in own if known[x] is None))
        factors = (*system.factors, *read)

        def solve():
            graph = Graph(_LARGEST)
            inputs = [graph.input(i, "float") for i in range(len(factors) + count + len(acts))]
            at = {x: inputs[len(system.factors) + i] for i, x in enumerate(read)}
            at |= {x: graph.constant(value, "float") for x, value in known.items() if value is not None}
            right, ends = inputs[len(factors) : len(factors) + count], inputs[len(factors) + count :]
            inner = system.solve().line

            def solved(right):
                nodes = copied(graph, inner, [*inputs[: len(system.factors)], *right])
                return [nodes[i] for i in inner.outputs]

            y = solved(right)
            for (row, column), d in others.items():
                if row >= count:
                    ends[row - count] = graph.apply("sub", ends[row - count], graph.apply("mul", at[d], y[column]))
            upper, factors_below = ([[at[x] for x in row] for row in table] for table in (rows, lower))
            mu = substitute(graph, upper, factors_below, ends)
            for (row, column), c in others.items():
                if column >= count:
                    right[row] = graph.apply("sub", right[row], graph.apply("mul", at[c], mu[column - count]))
            outputs = (*solved(right), *mu)
            return StraightLine(tuple(graph.nodes), tuple(graph.kinds), outputs)

        return LinearSystem(
            (*z, *unknown), system.entries, (*system.right, *rates), factors, solve, others
        )  # fmt: skip


def _adds_up(op: str, operands: Sequence[int], sides: dict) -> bool:
    """Whether what several pieces do to a result of this operation is the sum of what each of them does."""
    moving = [x in sides for x in operands]
    if op in ("add", "sub", "neg", "convert"):
        return True
    if op == "mul":
        return sum(moving) == 1
    return op in ("div", "select") and not moving[1 if op == "div" else 0]


# ---- with a copy for each of them ------------------------------------------------------------------------------------


def _with_copies(
    line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide]
) -> Sliding | None:
    """a = a⁻ + Σ αₖ (aₖ⁺ − a⁻); what one piece does to a is not to depend on the others."""
    graph, kinds = Graph(200 * len(line.nodes) + 10_000), line.kinds
    f, number, pieces, count = graph.apply, lambda x: graph.constant(x, "float"), len(switches), len(slides)
    given = [(node[2], kind) for node, kind in zip(line.nodes, kinds, strict=True) if node[0] == "input"]
    inputs = {attribute: graph.input(attribute, kind) for attribute, kind in given}
    flags = [f("gt", graph.input(first + pieces + k, "float"), number(0.5)) for k in range(count)]
    zero, one = number(0.0), number(1.0)

    def copy(upper: int | None) -> list[int]:
        given = dict(inputs)
        for k, (j, _) in enumerate(slides):
            side = one if k == upper else number(-1.0)
            given[first + j] = f("select", flags[k], graph.input(first + j, "float"), side)
        size = max(given) + 1
        return copied(graph, line, [given.get(i, zero) for i in range(size)])

    base = copy(None)
    a = [base[i] for i in line.outputs]
    more = [
        [f("sub", places[i], x) for i, x in zip(line.outputs[:n], a, strict=False)]
        for places in map(copy, range(count))
    ]
    rows, right = [], []
    for k, (j, _) in enumerate(slides):
        slopes = gradient_in(graph, line, base, switches[j], range(2 * n + 1))
        velocity = [graph.input(n + i, "float") for i in range(n)]
        rate = dot(graph, [*slopes[:n], *slopes[n : 2 * n]], [*velocity, *a[:n]])
        rate = f("add", rate, slopes[2 * n])
        right.append(f("select", flags[k], zero, f("neg", rate)))
        row = []
        for m in range(count):
            both = f("and", flags[k], flags[m])
            row.append(f("select", both, one if k == m else zero, dot(graph, slopes[n : 2 * n], more[m])))
        rows.append(row)
    lower = eliminate(graph, rows)
    shares = substitute(graph, rows, lower, right)
    for i in range(n):
        for k in range(count):
            a[i] = f("add", a[i], f("select", flags[k], zero, f("mul", shares[k], more[k][i])))
    return Sliding(StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(a)), base, shares, None)


# ---- a few linear equations ------------------------------------------------------------------------------------------


def dot(graph: Graph, xs: Sequence[int], ys: Sequence[int]) -> int:
    """Σ xᵢ yᵢ."""
    total = graph.constant(0.0, "float")
    for x, y in zip(xs, ys, strict=True):
        total = graph.apply("add", total, graph.apply("mul", x, y))
    return total


def eliminate(graph: Graph, rows: list[list[int]], safe: Callable = lambda k, own, pivot: pivot) -> list[list[int]]:
    """Eliminate in place, so that `rows` become upper triangular; returns the factors, those of row i to 0 … i − 1.

    `safe(k, own, pivot)` takes the place of pivot k, which is `own` before the elimination.
    """
    f, n, lower = graph.apply, len(rows), [[] for _ in rows]
    own = [row[k] for k, row in enumerate(rows)]
    for k in range(n):
        rows[k][k] = safe(k, own[k], rows[k][k])
        for i in range(k + 1, n):
            factor = f("div", rows[i][k], rows[k][k])
            lower[i].append(factor)
            rows[i][k] = graph.constant(0.0, "float")
            for j in range(k + 1, n):
                rows[i][j] = f("sub", rows[i][j], f("mul", factor, rows[k][j]))
    return lower


def substitute(graph: Graph, rows: Sequence, lower: Sequence, right: Sequence[int]) -> list[int]:
    """The solution of linear equations that have been eliminated."""
    f, x, n = graph.apply, list(right), len(rows)
    for i in range(n):
        for k in range(i):
            x[i] = f("sub", x[i], f("mul", lower[i][k], x[k]))
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            x[k] = f("sub", x[k], f("mul", rows[k][j], x[j]))
        x[k] = f("div", x[k], rows[k][k])
    return x
