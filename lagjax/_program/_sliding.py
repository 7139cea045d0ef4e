"""Motion along borders that both sides push onto: the program with the shares of both sides as further unknowns.

On a border u = 0 the acceleration is a share α of that on the upper side, and 1 − α of that on the lower one, with α
such that u stays zero (Filippov, *Differential Equations with Discontinuous Righthand Sides*, 1988, ch. 2, §4). Where u
depends on velocities, u̇ is to be zero; where it depends on positions alone, ü. Several borders at once have their
shares together, from one linear system.

Where pieces act on the right side alone of A z = r, each for itself, they are unknowns of that system: the piece p + μ
instead of p, with A z − Σ μₖ ∂r/∂pₖ = r, and one row more for each, that of u̇ = 0, or μ = 0 where nothing slides. Its
series needs no series of an elimination. Else, for a few pieces at most, that system is that of q̈ itself, z = q̈.

What such equations leave is rounding, which a body at rest would gather to ½ ε t². So the acceleration of one
coordinate of each border, its *pivot*, follows from u̇ = 0 itself: it is zero where u is a velocity alone. And a step
begins on its borders: the *retraction* puts the velocity back on u = 0, along what the border's force moves, and the
position where u depends on that alone. Its derivative is that of a motion whose start is varied: off the border by δu,
on either side, the force brings it back at once.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from lagjax._program._differentiation import copy_nodes, gradient_in
from lagjax._program._graph import Graph
from lagjax._program._operations import LOOK_UPS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import LinearSystem, StraightLine

# Borders that act on each other, whose elimination takes a third of the cube; and borders in all, of which each solves
# the linear system once more.
MOST_COUPLED, MOST_SLIDING = 64, 512
MOST_COPIES, LARGEST_COPIED = 4, 4000  # pieces for which all of a program is done once more, and its operations
# Borders that are not independent share what they hold as if they yielded by so much, relative; what that leaves is
# mended this many times. The share of what no border holds alone is as exact as rounding, divided by it.
SOFT, MENDED = 1e-9, 2
# What moves less off a border, relative to what pushes it there, is held by others: rounding of forces that cancel. It
# decides on derivatives alone; doubled, nothing that was looked at changes.
STILL = 1e-9
_BENT, _STATES = 1e-9, 32  # of a chord, of which rounding is a thousandth; and random states, for pieces of all kinds
FAR = 1e100  # of a rate: a share that is beyond 0 and 1; the search for its roots squares it
_LARGEST = 10_000_000  # operations: a bound for errors
# The length of the vector of a cone that is as good as none: forces change by so little beside it, and its square is
# there. What friction does along each of its parts is read off there.
_TINY = 2.0**-300


class Slide(NamedTuple):
    """Borders to slide along: those of piece number `piece`. Of its switching number u the rate of this order is zero.

    Order 1 is that of a border that depends on velocities, 2 that of one that does not. While the motion slides the
    piece is the one below, and the one above is larger by `width`. `level(graph, piece)` is that of u between them.

    Of a cone u is the length of a vector of `parts`, all of which stay zero: dry friction in the plane.
    """

    piece: int
    order: int
    width: float
    level: Callable[[Graph, int], int]
    parts: tuple[int, ...] = ()


class _Row(NamedTuple):
    """A number that stays zero: of border number `slide`, from the middle of both sides by `below` on the lower one."""

    slide: int
    offset: int
    below: float


class Sliding(NamedTuple):
    """A program with shares; `places` says where the nodes of the one without them are.

    `retraction` takes the same inputs to the state (q, q̇) on the borders that the motion slides along; `moved` are the
    coordinates that the force of each of these moves. `release` gives for each cone changes of q̇ (n,): one by which
    its vector becomes a unit along what it does not hold, and what takes the vector away.
    """

    line: StraightLine
    places: Sequence[int]
    shares: list[int]
    linear: LinearSystem | None
    retraction: StraightLine | None
    moved: tuple[frozenset[int], ...]
    release: StraightLine = StraightLine((), (), ())


def with_sliding(
    line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide], linear: Any
) -> Sliding | None:
    """The program whose motion slides along the borders `slides` where flags, its last inputs, are 1.

    `first` is the input of the first piece, `switches` are the nodes of the switching numbers. None if it is too long.
    """
    if not slides:
        return Sliding(line, range(len(line.nodes)), [], linear, None, ())
    if linear is not None:
        done = _SlidingForces(line, n, first, switches, slides, linear).build()
        if done is not None:
            return done
    is_large = len(slides) > MOST_COPIES or len(line.nodes) > LARGEST_COPIED
    if is_large or any(slide.order > 1 or slide.parts for slide in slides):
        return None
    done = _SlidingForces(line, n, first, switches, slides, _solved_system(line.outputs[:n])).build()
    return done and done._replace(linear=None)


def _solved_system(z: Sequence[int]) -> LinearSystem:
    """The system z = z, on whose right side pieces act that act on more than the right side of another one."""
    inputs = tuple(("input", (), i) for i in range(len(z)))
    same = StraightLine(inputs, ("float",) * len(z), tuple(range(len(z))))
    return LinearSystem(tuple(z), {}, tuple(z), (), lambda: same)


# ---- as unknowns of the linear system --------------------------------------------------------------------------------


class _SlidingForces:
    """The program with μ, one number for each of the pieces, as unknowns."""

    def __init__(self, line, n, first, switches, slides, linear):
        self.line, self.n, self.slides, self.linear = line, n, slides, linear
        self.graph = Graph.from_line(line, _LARGEST)
        self.f, self.number = self.graph.apply, self.graph.number
        self.zero, self.one = self.number(0.0), self.number(1.0)
        self.pieces = [self.graph.input(first + slide.piece, "float") for slide in slides]
        self.rows, self.decided = [], range(first, first + len(switches))
        for k, (slide, piece) in enumerate(zip(slides, self.pieces, strict=True)):
            if slide.parts:
                self.rows += [_Row(k, u, 0.0) for u in slide.parts]
            else:
                self.rows.append(_Row(k, self.f("sub", switches[slide.piece], slide.level(self.graph, piece)), -1.0))
        flags = [self.graph.input(first + len(switches) + k, "float") for k in range(len(slides))]
        self.flags = [self.f("gt", flag, self.number(0.5)) for flag in flags]

    def where(self, condition: int, x: int) -> int:
        """x where the condition holds, else zero."""
        return self.f("select", condition, self.zero, x)

    def masked(self, k: int, x: int) -> int:
        """Zero where nothing slides along the border of row k."""
        return self.where(self.flags[self.rows[k].slide], x)

    def build(self) -> Sliding | None:
        """The program; None where pieces act on more than the right side, or not each for itself."""
        acts = self._acts()
        if acts is None or self._bends(acts):
            return None
        slopes, rates, levels = zip(*map(self._rate, range(len(self.rows))), strict=True)
        responses, effects = self._effects(acts, slopes)
        _, groups = connected_components(np.array(effects) != self.zero, directed=False)
        if np.bincount(groups).max() > MOST_COUPLED:
            return None
        pushed = [self.f("lt", row[k], self.zero) for k, row in enumerate(effects)]
        all_pushed = [functools.reduce(lambda a, b: self.f("and", a, b), of) for of in self._group_rows(pushed)]
        pushed = [all_pushed[row.slide] for row in self.rows]
        # Borders that are not pushed onto are left, and act on nothing until then.
        acts = [{i: self.where(p, c) for i, c in act.items()} for p, act in zip(pushed, acts, strict=True)]
        normals = [[self.where(p, d) for d in of] for p, of in zip(pushed, slopes, strict=True)]
        equations = self._equations(effects, pushed, slopes)
        ends = list(map(self.where, pushed, rates))
        missing = [
            self.f("sub", end, dot(self.graph, d, self.linear.z[: self.n]))
            for end, d in zip(ends, normals, strict=True)
        ]
        unknown = self._unknown(equations, missing)
        pivots = _choose_pivots([_constants(self.graph, self._unmask(d)) for d in slopes])
        held = _Held(self.graph, self.n, pushed, [self._unmask(d) for d in slopes], responses, pivots)
        z = self._solve(self._push_right_side(self.linear.right, acts, unknown))
        missed = self._miss_constraints(z)
        if len(pivots) < len(acts) or missed:
            # What has no pivot, and what constraints tie to one, is held by the rounding of rounding.
            z = self._add(z, self._solve([missed.get(i, self.zero) for i in range(len(z))])) if missed else z
            left = [self.f("sub", end, dot(self.graph, d, z[: self.n])) for end, d in zip(ends, normals, strict=True)]
            more = equations.solve(self.graph, left)
            unknown = self._add(unknown, more)
            z = self._add(z, [dot(self.graph, of, more) for of in zip(*responses, strict=True)])
        z = held.hold(z, rates)
        shares = [self._share(k, unknown, slopes, rates, all_pushed[k], z) for k in range(len(self.slides))]
        directions = [
            self.f("select", p, self.f("neg", x), y) for p, x, y in zip(pushed, missing, unknown, strict=True)
        ]
        release = self._release(directions, [self._unmask(d) for d in slopes])
        linear = self._system(z, unknown, acts, normals, ends, equations, held.pivots())
        outputs = (*z[: self.n], *self.line.outputs[self.n :])
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), outputs)
        by_position = [k for k, row in enumerate(self.rows) if self.slides[row.slide].order > 1]
        if by_position:
            some = [[effects[k][m] for m in by_position] for k in by_position]
            pushes = [self._pushes_back(k, effects, pushed, slopes, missing) for k in by_position]
            of_positions = self._equations(some, pushes, [slopes[k] for k in by_position])
            at = [self.rows[k].offset for k in by_position]
            held.put_back(0, by_position, at, lambda left: of_positions.solve(self.graph, left), pushes)
        held.put_back(self.n, range(len(levels)), levels, lambda left: equations.solve(self.graph, left), pushed)
        retraction, moved = held.finish()
        of_slides = tuple(frozenset().union(*some) for some in self._group_rows(moved))
        release = eliminate_dead_code(self.graph, release)
        return Sliding(line, range(len(self.line.nodes)), shares, linear, retraction, of_slides, release)

    def _group_rows(self, of_rows: Sequence) -> list[list]:
        return [
            [x for row, x in zip(self.rows, of_rows, strict=True) if row.slide == k] for k in range(len(self.slides))
        ]

    def _release(self, directions: Sequence[int], slopes: Sequence[list[int]]) -> list[int]:
        f, results = self.f, []
        for k, slide in enumerate(self.slides):
            if not slide.parts:
                continue
            rows = [m for m, row in enumerate(self.rows) if row.slide == k]
            along = [directions[m] for m in rows]
            length = f("sqrt", dot(self.graph, along, along))
            length = f("select", f("gt", length, self.zero), self.one, length)
            sizes = [dot(self.graph, slopes[m], slopes[m]) for m in rows]
            for numbers in ([f("div", x, length) for x in along], [self.rows[m].offset for m in rows]):
                parts = [f("div", x, size) for x, size in zip(numbers, sizes, strict=True)]
                results += [dot(self.graph, [slopes[m][i] for m in rows], parts) for i in range(self.n)]
        return results

    def _solve(self, right: Sequence[int]) -> list[int]:
        """z of A z = r."""
        line = self.linear.solve()
        nodes = copy_nodes(self.graph, line, [*self.linear.factors, *right])
        return [nodes[i] for i in line.outputs]

    def _add(self, xs: Sequence[int], ys: Sequence[int]) -> list[int]:
        return [self.f("add", *pair) for pair in zip(xs, ys, strict=True)]

    def _miss_constraints(self, z: Sequence[int]) -> dict[int, int]:
        """r − A z in the rows of constraints, whose entries are those of coordinates alone."""
        entries = self.linear.entries
        rows = set(range(self.n, len(z))) - {i for place in entries if min(place) >= self.n for i in place}
        found = {}
        for i in sorted(rows):
            known = {j: c for (k, j), c in entries.items() if k == i}
            found[i] = self.f("sub", self.linear.right[i], dot(self.graph, known.values(), [z[j] for j in known]))
        return found

    def _effects(self, acts: Sequence[dict[int, int]], slopes: Sequence[list[int]]) -> tuple[list[list[int]], ...]:
        """The slopes of z by each piece, and ∂u̇/∂p of each border by each piece; zeros where nothing slides."""
        size = len(self.linear.right)
        responses = [self._solve([act.get(i, self.zero) for i in range(size)]) for act in acts]
        effects = []
        for d in slopes:
            some = [i for i, x in enumerate(d) if x != self.zero]
            effects.append([dot(self.graph, [d[i] for i in some], [of[i] for i in some]) for of in responses])
        return responses, effects

    def _unmask(self, numbers: Sequence[int]) -> list[int]:
        """Numbers that are zero where nothing slides, as they are where something does."""
        nodes = self.graph.nodes
        return [nodes[d][1][2] if nodes[d][0] == "select" else d for d in numbers]

    def _equations(self, effects: list[list[int]], pushed: Sequence[int], slopes: Sequence[list[int]]) -> "_Equations":
        """The linear equations of μ; μ = 0 where there is nothing to do."""
        f, rows = self.f, []
        for k, row in enumerate(effects):
            both = [self.where(pushed[k], self.where(p, x)) for p, x in zip(pushed, row, strict=True)]
            both[k] = f("select", pushed[k], self.one, row[k])
            rows.append(both)
        whole = []
        if self._are_dependent(slopes):
            whole = [list(row) for row in rows]
            for k, row in enumerate(rows):
                row[k] = f("mul", self.number(1 + SOFT), row[k])
        return _Equations(rows, eliminate(self.graph, rows), whole)

    def _pushes_back(self, j: int, effects, pushed: Sequence[int], slopes, missing: Sequence[int]) -> int:
        """True where border j of positions pushes back what lies beside it; other borders may hold that there, too."""
        f, others = self.f, [k for k in range(len(self.rows)) if k != j]
        if all(self.slides[self.rows[k].slide].order > 1 for k in others):
            return pushed[j]
        without = [p if k != j else f("and", p, f("not", p)) for k, p in enumerate(pushed)]
        equations = self._equations(effects, without, slopes)
        stays = pushed[j]
        for change in (self.number(2.0), self.zero):
            beside = [f("sub", x, f("mul", effects[k][j], change)) for k, x in enumerate(missing)]
            mu = self._unknown(equations, list(map(self.where, without, beside)))
            for k in others:
                held = f("lt", f("abs", f("add", mu[k], self.number(self.rows[k].below))), self.one)
                stays = f("and", stays, f("or", f("not", pushed[k]), held))
            row = [self.zero if k == j else x for k, x in enumerate(effects[j])]
            moves = f("abs", f("sub", beside[j], dot(self.graph, row, mu)))
            stays = f("and", stays, f("le", moves, f("mul", self.number(STILL), f("abs", effects[j][j]))))
        return f("and", pushed[j], f("not", stays))

    def _unknown(self, equations: "_Equations", missing: list[int]) -> list[int]:
        """μ; where borders share what they hold, μ − 1 is to be small: the distance from the middle of both sides."""
        if not equations.whole:
            return equations.solve(self.graph, missing)
        f, rows = self.f, equations.whole
        below = [self.number(row.below) for row in self.rows]
        there = [f("add", x, dot(self.graph, row, below)) for x, row in zip(missing, rows, strict=True)]
        return [f("sub", x, p) for x, p in zip(equations.solve(self.graph, there), below, strict=True)]

    def _are_dependent(self, slopes: Sequence[list[int]]) -> bool:
        """True if the rates of some borders are combinations of others, so that these can share what they hold."""
        some, numbers = np.random.default_rng(0), np.zeros((len(slopes), self.n))
        for k, of_one in enumerate(slopes):
            for i, value in _constants(self.graph, self._unmask(of_one)).items():
                numbers[k, i] = some.uniform(0.5, 1.5) if value is None else value
        return bool(np.linalg.matrix_rank(numbers) < len(slopes))

    def _share(self, k: int, unknown: Sequence[int], slopes: Sequence, rates: Sequence, pushed: int, z) -> int:
        """The share of the upper side: μ/2, and far beyond 0 or 1 where both sides do not push.

        Of a cone, which holds up to a length of 1, it is what is left of the square of that, of 1/4: never 1.
        """
        f, half = self.f, self.number(0.5)
        rows = [m for m, row in enumerate(self.rows) if row.slide == k]
        mu = [unknown[m] for m in rows]
        if self.slides[k].parts:
            left = f("sub", self.one, dot(self.graph, mu, mu))
            return f("select", pushed, self.number(-FAR), f("mul", self.number(0.25), left))
        moves = f("sub", dot(self.graph, slopes[rows[0]], z[: self.n]), rates[rows[0]])
        return f("select", pushed, f("add", half, f("mul", self.number(FAR), moves)), f("mul", half, mu[0]))

    def _push_right_side(
        self, right: Sequence[int], acts: Sequence[dict[int, int]], unknown: Sequence[int]
    ) -> list[int]:
        """r + Σ μₖ ∂r/∂pₖ."""
        pushed = list(right)
        for act, mu in zip(acts, unknown, strict=True):
            for i, c in act.items():
                pushed[i] = self.f("add", pushed[i], self.f("mul", c, mu))
        return pushed

    def _acts(self) -> list[dict[int, int]] | None:
        """∂r/∂pₖ, entry by entry: half of the difference of both sides; of a cone, what a unit of its vector does."""
        of_sides = self._values_on_both_sides()
        if of_sides is None:
            return None
        acts = []
        for m, (k, *_) in enumerate(self.rows):
            if self.slides[k].parts:
                below, above = self._evaluate_cone(k, None), self._evaluate_cone(k, self.rows[m].offset)
                factor = self.one
            else:
                below, above = ({x: of[k][side] for x, of in of_sides.items() if k in of} for side in range(2))
                factor = self.number(0.5)
            act = {}
            for i, x in enumerate(self.linear.right):
                change = self.f("sub", above[x], below[x]) if x in below and x in above else self.zero
                if self.graph.value(change) != 0:
                    act[i] = self.masked(m, self.f("mul", factor, change))
            acts.append(act)
        return acts

    def _evaluate_cone(self, k: int, along: int | None) -> dict[int, int]:
        """The nodes where the vector of cone k is tiny and has one part alone, or where it is zero and at rest."""
        graph, parts = self.graph, self.slides[k].parts
        known = {u: self.number(_TINY if u == along else 0.0) for u in parts}
        known[self.pieces[k]] = self.number(-1.0 if along is None else 1.0)
        for i in graph.find_ancestors(self.linear.right):
            op, operands, attribute = graph.nodes[i]
            if i not in known and any(x in known for x in operands):
                known[i] = graph.apply(op, *(known.get(x, x) for x in operands), attribute=attribute)
        return known

    def _bends(self, acts: Sequence[dict[int, int]]) -> bool:
        """True if between both sides of a border r is not on their chord, at random numbers.

        So it is where two frictions change each other's normal forces, and not in proportion. What one holds at rest,
        between both sides, then says nothing about the other.
        """
        graph, draw, line = self.graph, np.random.default_rng(0), eliminate_dead_code(self.graph, self.linear.right)
        if any(op in LOOK_UPS for op, *_ in line.nodes):
            return False
        for k in {row.slide for row, act in zip(self.rows, acts, strict=True) if self._reads_others(row.slide, act)}:
            columns = draw.uniform(0.3, 1.2, (1 + max(node[2] for node in graph.nodes if node[0] == "input"), _STATES))
            columns[self.decided] = draw.choice([-1.0, 1.0], (len(self.decided), _STATES))
            at = []
            for side in (-1.0, 0.0, 1.0):
                columns[graph.nodes[self.pieces[k]][2]] = side
                at.append(np.array([np.broadcast_to(x, _STATES) for x in line.evaluate(list(columns))]))
            chord, part = at[2] - at[0], at[1] - at[0]
            off = part - chord * (np.sum(part * chord, axis=0) / np.sum(chord * chord, axis=0))
            if (np.abs(off).max(axis=0) > _BENT * np.abs(chord).max(axis=0)).any():
                return True
        return False

    def _reads_others(self, k: int, act: dict[int, int]) -> bool:
        others = {piece for m, piece in enumerate(self.pieces) if m != k}
        return self.slides[k].width > 1 and not others.isdisjoint(self.graph.find_ancestors(act.values()))

    def _values_on_both_sides(self) -> dict[int, dict[int, tuple[int, int]]] | None:
        """The nodes that depend on pieces, and for each piece their values below and above, the others as they are."""
        graph, system = self.graph, self.linear
        pieces = {node: k for k, node in enumerate(self.pieces)}
        matrix = *system.entries.values(), *system.others.values(), *system.factors
        if not pieces.keys().isdisjoint(graph.find_ancestors(matrix)):
            return None
        sides: dict[int, dict[int, tuple[int, int]]] = {}
        minus_one = self.number(-1.0)
        for i in graph.find_ancestors(system.right):
            if i in pieces and self.slides[pieces[i]].parts:
                continue
            if i in pieces:
                is_sign = self.slides[pieces[i]].width > 1
                sides[i] = {pieces[i]: (minus_one, self.one) if is_sign else (i, self.f("add", i, self.one))}
                continue
            op, operands, attribute = graph.nodes[i]
            among = sorted({k for x in operands for k in sides.get(x, ())})
            values = {}
            for k in among:
                given = ([sides.get(x, {}).get(k, (x, x))[side] for x in operands] for side in (0, 1))
                values[k] = tuple(graph.apply(op, *of, attribute=attribute) for of in given)
            values = {k: pair for k, pair in values.items() if pair[0] != pair[1]}
            if values:
                sides[i] = values
        return sides

    def _rate(self, k: int) -> tuple[list[int], int, int]:
        """∂w/∂q̇ and −∂w/∂q q̇ − ∂w/∂t of what is to stay zero, u or u̇; zeros where nothing slides. And w."""
        n, node = self.n, self.rows[k].offset
        level = node
        for _ in range(self.slides[self.rows[k].slide].order):
            level, slopes = node, self._slopes(node)
            velocities = [self.graph.input(n + i, "float") for i in range(n)]
            node = self.f("add", dot(self.graph, slopes[:n], velocities), slopes[2 * n])
        return [self.masked(k, x) for x in slopes[n : 2 * n]], self.masked(k, self.f("neg", node)), level

    def _slopes(self, node: int) -> list[int]:
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), ())
        return gradient_in(self.graph, line, list(range(len(line.nodes))), node, range(2 * self.n + 1))

    def _system(self, z, unknown, acts, slopes, rates, of_unknowns, pivots) -> LinearSystem:
        system, count = self.linear, len(self.linear.right)
        others = {(i, count + k): self.f("neg", c) for k, act in enumerate(acts) for i, c in act.items()}
        entries = ((k, i, d) for k, of_one in enumerate(slopes) for i, d in enumerate(of_one))
        others |= {(count + k, i): d for k, i, d in entries if self.graph.value(d) != 0}
        # What `solve` needs besides: the entries, and the elimination of the unknowns.
        own = [*others.values(), *(x for table in of_unknowns for row in table for x in row)]
        own += [x for _, _, *numbers in pivots for x in numbers]
        known = {x: self.graph.value(x) for x in own}
        read = list(dict.fromkeys(x for x in own if known[x] is None))
        factors = (*system.factors, *read)

        def solve():
            graph = Graph(_LARGEST)
            inputs = [graph.input(i, "float") for i in range(len(factors) + count + len(acts))]
            at = {x: inputs[len(system.factors) + i] for i, x in enumerate(read)}
            at |= {x: graph.number(value) for x, value in known.items() if value is not None}
            right, ends = inputs[len(factors) : len(factors) + count], inputs[len(factors) + count :]
            equations = _Equations(*([[at[x] for x in row] for row in table] for table in of_unknowns))
            inner = system.solve()

            def apply_inverse(right):
                nodes = copy_nodes(graph, inner, [*inputs[: len(system.factors)], *right])
                return [nodes[i] for i in inner.outputs]

            def subtract(b, x, of_rates: bool):
                """The rows b of A z = r, or those `of_rates`, less the other entries there times x."""
                b = list(b)
                for (row, column), d in others.items():
                    if (row >= count) == of_rates:
                        row, column = (row - count, column) if of_rates else (row, column - count)
                        b[row] = graph.apply("sub", b[row], graph.apply("mul", at[d], x[column]))
                return b

            mu = equations.solve(graph, subtract(ends, apply_inverse(right), True))
            z = apply_inverse(subtract(right, mu, False))
            if len(pivots) < len(acts):
                more = equations.solve(graph, subtract(ends, z, True))
                rest = apply_inverse(subtract([graph.number(0.0)] * count, more, False))
                z = [graph.apply("add", *pair) for pair in zip(z, rest, strict=True)]
                mu = [graph.apply("add", *pair) for pair in zip(mu, more, strict=True)]
            for k, i, free, inverse in pivots:
                end = ends[k]
                for (row, j), d in others.items():
                    if row == count + k and j != i:
                        end = graph.apply("sub", end, graph.apply("mul", at[d], z[j]))
                z[i] = graph.apply("add", graph.apply("mul", at[free], z[i]), graph.apply("mul", at[inverse], end))
            return StraightLine(tuple(graph.nodes), tuple(graph.kinds), (*z, *mu))

        others_too = system.others | others
        return LinearSystem((*z, *unknown), system.entries, (*system.right, *rates), factors, solve, others_too)


# ---- what stays on borders ----


class _Held:
    """Accelerations, and a state, on the borders that hold: those that are `pushed` onto.

    `slopes` are ∂u̇/∂q̈ of each border, `responses` the accelerations by each piece, `pivots` as `_choose_pivots` gives
    them. The state begins as the inputs of the program.
    """

    def __init__(self, graph: Graph, n: int, pushed: Sequence[int], slopes, responses, pivots):
        self.graph, self.n, self.pushed, self.slopes, self.responses = graph, n, pushed, slopes, responses
        self.zero, self.one = (graph.number(x) for x in (0.0, 1.0))
        self.divisors = [(k, i, graph.apply("select", pushed[k], self.one, slopes[k][i])) for k, i in pivots]
        self.state = {i: graph.input(i, "float") for i in range(2 * n)}

    def pivots(self) -> list[tuple[int, int, int, int]]:
        """Each border, its pivot, 1 where the pivot is free, and the inverse of its slope where the border holds."""
        f, zero, one = self.graph.apply, self.zero, self.one
        return [
            (k, i, f("select", self.pushed[k], one, zero), f("select", self.pushed[k], zero, f("div", one, divisor)))
            for k, i, divisor in self.divisors
        ]

    def hold(self, z: Sequence[int], rates: Sequence[int]) -> list[int]:
        """Accelerations with those of pivots from Σ ∂u̇/∂q̈ᵢ q̈ᵢ = `rates`."""
        f, z = self.graph.apply, list(z)
        for k, i, divisor in self.divisors:
            others = dot(self.graph, [self.zero if j == i else d for j, d in enumerate(self.slopes[k])], z[: self.n])
            z[i] = f("select", self.pushed[k], z[i], f("div", f("sub", rates[k], others), divisor))
        return z

    def put_back(
        self, first: int, which: Sequence[int], levels: Sequence[int], solve: Callable, pushed: Sequence[int]
    ) -> None:
        """Move the state from `first` on to zero `levels` of the borders `which`, all along what their forces move.

        `solve` gives the multiples of `responses` that change the levels by given numbers, where borders are `pushed`
        onto. Then pivots move alone, by what rounding and one step of Newton's have left.
        """
        f, state, n, pushed_of = self.graph.apply, self.state, self.n, dict(zip(which, pushed, strict=True))
        left = zip(which, self._evaluate(levels), strict=True)
        multiples = solve([f("select", pushed_of[k], self.zero, level) for k, level in left])
        for i in range(n):
            moves = dot(self.graph, [self.responses[k][i] for k in which], multiples)
            state[first + i] = f("sub", state[first + i], moves)
        left, moved = dict(zip(which, self._evaluate(levels), strict=True)), [self.zero] * n
        for k, i, divisor in self.divisors:
            if k in left:
                change = f("div", f("add", left[k], dot(self.graph, self.slopes[k], moved)), divisor)
                before, change = state[first + i], f("neg", change)
                state[first + i] = f("select", pushed_of[k], before, f("add", before, change))
                moved[i] = f("add", moved[i], f("select", pushed_of[k], self.zero, change))

    def _evaluate(self, nodes: Sequence[int]) -> list[int]:
        graph = self.graph
        line = eliminate_dead_code(graph, nodes)
        given = {node[2]: i for i, node in enumerate(graph.nodes) if node[0] == "input"} | self.state
        places = copy_nodes(graph, line, [given.get(i, self.zero) for i in range(1 + max(given))])
        return [places[i] for i in line.outputs]

    def finish(self) -> tuple[StraightLine, tuple[frozenset[int], ...]]:
        """The line from the inputs of the program to the state, and which coordinates each border moves."""
        graph = self.graph
        line = eliminate_dead_code(graph, [self.state[i] for i in range(2 * self.n)])
        return line, tuple(frozenset(_constants(graph, response[: self.n])) for response in self.responses)


def _choose_pivots(rows: Sequence[dict[int, float | None]]) -> list[tuple[int, int]]:
    """Borders, each with a coordinate that can follow from the others, in an order in which none changes one before.

    `rows` has the slopes ∂u̇/∂q̈ᵢ of each border that are not zero, None for those that are no constants. A pivot is
    alone in its row, or has the largest constant of it, so that it gathers no rounding. A border may have none.
    """
    left, behind = dict(enumerate(rows)), []

    def is_free(k: int, i: int) -> bool:
        constants = {j: abs(x) for j, x in rows[k].items() if x is not None}
        leads = len(rows[k]) == 1 or (i in constants and constants[i] == max(constants.values()))
        return leads and not any(i in row for m, row in left.items() if m != k)

    while (found := next(((k, i) for k, row in left.items() for i in row if is_free(k, i)), None)) is not None:
        behind.append(found)
        del left[found[0]]
    return [(k, i) for k, row in left.items() for i in row if len(row) == 1] + behind[::-1]


# ---- a few linear equations ------------------------------------------------------------------------------------------


class _Equations(NamedTuple):
    """Linear equations after `eliminate`, and as they are where they are solved softly (`SOFT`)."""

    upper: list[list[int]]
    lower: list[list[int]]
    whole: list[list[int]]

    def solve(self, graph: Graph, right: Sequence[int]) -> list[int]:
        x = substitute(graph, self.upper, self.lower, right)
        for _ in range(MENDED if self.whole else 0):
            left = [graph.apply("sub", b, dot(graph, row, x)) for b, row in zip(right, self.whole, strict=True)]
            more = substitute(graph, self.upper, self.lower, left)
            x = [graph.apply("add", a, b) for a, b in zip(x, more, strict=True)]
        return x


def _constants(graph: Graph, numbers: Sequence[int]) -> dict[int, float | None]:
    """The numbers that are not zero throughout; None for those that are no constants."""
    values = {i: graph.value(d) for i, d in enumerate(numbers)}
    return {i: value for i, value in values.items() if value != 0}


def dot(graph: Graph, xs: Iterable[int], ys: Iterable[int]) -> int:
    total = zero = graph.number(0.0)
    for x, y in zip(xs, ys, strict=True):
        if zero not in (x, y):  # as nearly all are where many borders know nothing of each other
            total = graph.apply("add", total, graph.apply("mul", x, y))
    return total


def eliminate(graph: Graph, rows: list[list[int]]) -> list[list[int]]:
    """Eliminate in place, so that `rows` become upper triangular; returns the factors, those of row i to 0 … i − 1."""
    f, n, lower, zero = graph.apply, len(rows), [[] for _ in rows], graph.number(0.0)
    for k in range(n):
        for i in range(k + 1, n):
            factor = zero if rows[i][k] == zero else f("div", rows[i][k], rows[k][k])
            lower[i].append(factor)
            rows[i][k] = zero
            for j in range(k + 1, n) if factor != zero else ():
                if rows[k][j] != zero:
                    rows[i][j] = f("sub", rows[i][j], f("mul", factor, rows[k][j]))
    return lower


def substitute(graph: Graph, rows: Sequence, lower: Sequence, right: Sequence[int]) -> list[int]:
    f, x, n, zero = graph.apply, list(right), len(rows), graph.number(0.0)
    for i in range(n):
        for k in range(i):
            if lower[i][k] != zero:
                x[i] = f("sub", x[i], f("mul", lower[i][k], x[k]))
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            if rows[k][j] != zero:
                x[k] = f("sub", x[k], f("mul", rows[k][j], x[j]))
        x[k] = f("div", x[k], rows[k][k])
    return x
