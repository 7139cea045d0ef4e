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
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._differentiation import copy_nodes, copy_operation, slopes_in
from lagjax._program._graph import Graph, find_descendants, find_readers
from lagjax._program._operations import LOOK_UPS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import LinearSystem, StraightLine
from lagjax._program._small_equations import (
    SOFT,
    Equations,
    Sparse,
    constants,
    dot,
    drop_entry,
    eliminate,
    find_groups,
    transpose,
)

# Borders that act on each other, whose elimination takes a third of the cube; and borders in all. The first result of
# 2500 blocks that know nothing of each other takes 6 CPU s, of 10 000 blocks 29, and 2 GB.
MOST_COUPLED, MOST_SLIDING = 64, 20_000
MOST_COPIES, LARGEST_COPIED = 4, 4000  # pieces for which all of a program is done once more, and its operations
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
    coordinates that the force of each of these moves; those of different `groups` know nothing of each other as long as
    no time passes. `release` gives for each cone changes of q̇ (n,): one by which
    its vector becomes a unit along what it does not hold, and what takes the vector away.
    """

    line: StraightLine
    places: Sequence[int]
    shares: list[int]
    linear: LinearSystem | None
    retraction: StraightLine | None
    moved: tuple[frozenset[int], ...]
    groups: tuple[int, ...] = ()
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
        self.rows_of: list[range] = []  # of each slide
        for k, (slide, piece) in enumerate(zip(slides, self.pieces, strict=True)):
            count = len(self.rows)
            if slide.parts:
                self.rows += [_Row(k, u, 0.0) for u in slide.parts]
            else:
                self.rows.append(_Row(k, self.f("sub", switches[slide.piece], slide.level(self.graph, piece)), -1.0))
            self.rows_of.append(range(count, len(self.rows)))
        flags = [self.graph.input(first + len(switches) + k, "float") for k in range(len(slides))]
        self.flags = [self.f("gt", flag, self.number(0.5)) for flag in flags]

    def where(self, condition: int, x: int) -> int:
        """x where the condition holds, else zero."""
        return self.zero if self.graph.value(x) == 0 else self.f("select", condition, self.zero, x)

    def build(self) -> Sliding | None:
        """The program; None where pieces act on more than the right side, or not each for itself."""
        acts = self._acts()
        if acts is None or self._bends(acts):
            return None
        slopes, rates, levels = zip(*map(self._rate, range(len(self.rows))), strict=True)
        groups = self._find_groups(acts, slopes)
        if np.bincount(groups).max() > MOST_COUPLED:
            return None
        responses, effects = self._effects(acts, slopes)
        pushed = [self.f("lt", row.get(k, self.zero), self.zero) for k, row in enumerate(effects)]
        of_slides = zip(self.flags, self._group_rows(pushed), strict=True)
        all_pushed = [functools.reduce(lambda a, b: self.f("and", a, b), of, flag) for flag, of in of_slides]
        pushed = [all_pushed[row.slide] for row in self.rows]
        # Borders that are not pushed onto are left, and act on nothing until then.
        acts = [{i: self.where(p, c) for i, c in act.items()} for p, act in zip(pushed, acts, strict=True)]
        normals = [{i: self.where(p, d) for i, d in of.items()} for p, of in zip(pushed, slopes, strict=True)]
        equations = self._equations(effects, pushed, slopes)
        ends = list(map(self.where, pushed, rates))
        missing = [self.f("sub", end, self._dot(d, self.linear.z)) for end, d in zip(ends, normals, strict=True)]
        unknown = self._unknown(equations, missing)
        pivots = _choose_pivots([constants(self.graph, d) for d in slopes])
        held = _Held(self.graph, self.n, pushed, slopes, responses, pivots)
        z = self._solve(self._push_right_side(self.linear.right, acts, unknown))
        missed = self._miss_constraints(z)
        if len(pivots) < len(acts) or missed:
            # What has no pivot, and what constraints tie to one, is held by the rounding of rounding.
            z = self._add(z, self._solve([missed.get(i, self.zero) for i in range(len(z))])) if missed else z
            left = [self.f("sub", end, self._dot(d, z)) for end, d in zip(ends, normals, strict=True)]
            more = equations.solve(self.graph, left)
            unknown = self._add(unknown, more)
            z = self._add(z, [self._dot(of, more) for of in transpose(responses, len(z))])
        z = held.hold(z, rates)
        shares = [self._share(k, unknown, slopes, rates, all_pushed[k], z, effects) for k in range(len(self.slides))]
        directions = [
            self.f("select", p, self.f("neg", x), y) for p, x, y in zip(pushed, missing, unknown, strict=True)
        ]
        release = self._release(directions, slopes)
        linear = self._system(z, unknown, acts, normals, ends, equations, held.pivots())
        outputs = (*z[: self.n], *self.line.outputs[self.n :])
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), outputs)
        by_position = [k for k, row in enumerate(self.rows) if self.slides[row.slide].order > 1]
        if by_position:
            at = {m: i for i, m in enumerate(by_position)}
            some = [{at[m]: x for m, x in effects[k].items() if m in at} for k in by_position]
            pushes = [self._pushes_back(k, effects, pushed, slopes, missing) for k in by_position]
            of_positions = self._equations(some, pushes, [slopes[k] for k in by_position])
            at = [self.rows[k].offset for k in by_position]
            held.put_back(0, by_position, at, lambda left: of_positions.solve(self.graph, left), pushes)
        held.put_back(self.n, range(len(levels)), levels, lambda left: equations.solve(self.graph, left), pushed)
        retraction, moved = held.finish()
        of_slides = tuple(frozenset().union(*some) for some in self._group_rows(moved))
        groups = tuple(groups[rows[0]] for rows in self.rows_of)
        release = eliminate_dead_code(self.graph, release)
        return Sliding(line, range(len(self.line.nodes)), shares, linear, retraction, of_slides, groups, release)

    def _find_groups(self, acts: Sequence[Sparse], slopes: Sequence[Sparse]) -> list[int]:
        """The group of each row: what those of different ones move, and read, A does not couple."""
        matrix, size = self.linear.entries | self.linear.others, len(self.linear.right)
        rows: list[Sparse] = [{i: self.one} for i in range(size)]
        for (i, j), x in matrix.items():
            if x != self.zero:
                rows[i][j] = x
        parts = find_groups(rows, size)
        of_cones = [rows[0] for rows in self.rows_of for _ in rows]
        touched = [{parts[i]: self.one for i in both} for both in map(dict.__or__, acts, slopes)]
        for row, first in zip(touched, of_cones, strict=True):
            row[size + first] = self.one
        return find_groups(touched, size + len(touched))

    def _group_rows(self, of_rows: Sequence) -> list[list]:
        return [[of_rows[m] for m in rows] for rows in self.rows_of]

    def _dot(self, row: Sparse, xs: Sequence[int]) -> int:
        return dot(self.graph, row.values(), [xs[i] for i in row])

    def _release(self, directions: Sequence[int], slopes: Sequence[Sparse]) -> list[int]:
        f, results = self.f, []
        for k, slide in enumerate(self.slides):
            if not slide.parts:
                continue
            rows = self.rows_of[k]
            along = [directions[m] for m in rows]
            length = f("sqrt", dot(self.graph, along, along))
            length = f("select", f("gt", length, self.zero), self.one, length)
            sizes = [dot(self.graph, slopes[m].values(), slopes[m].values()) for m in rows]
            for numbers in ([f("div", x, length) for x in along], [self.rows[m].offset for m in rows]):
                parts = [f("div", x, size) for x, size in zip(numbers, sizes, strict=True)]
                results += [self._dot(of, parts) for of in transpose([slopes[m] for m in rows], self.n)]
        return results

    @functools.cached_property
    def _solution(self) -> StraightLine:
        return self.linear.solve()

    def _solve(self, right: Sequence[int]) -> list[int]:
        """z of A z = r."""
        nodes = copy_nodes(self.graph, self._solution, [*self.linear.factors, *right])
        return [nodes[i] for i in self._solution.outputs]

    def _respond(self, acts: Sequence[Sparse]) -> list[Sparse]:
        """z of A z = r for some r of few entries each: only what depends on these is computed."""
        line, first, results = self._solution, len(self.linear.factors), []
        still = copy_nodes(self.graph, line, [*self.linear.factors, *[self.zero] * len(self.linear.right)])
        inputs = {node[2]: i for i, node in enumerate(line.nodes) if node[0] == "input"}
        readers, places = find_readers(line.nodes), {}
        for i, node in enumerate(line.outputs):
            places.setdefault(node, []).append(i)
        for act in acts:
            moved = {inputs[first + i]: x for i, x in act.items() if first + i in inputs}
            for i in find_descendants(readers, moved):
                op, operands, attribute = line.nodes[i]
                moved[i] = copy_operation(self.graph, op, [moved.get(x, still[x]) for x in operands], attribute)
            z = sorted((i, x) for node, x in moved.items() for i in places.get(node, ()))
            results.append({i: x for i, x in z if x != self.zero})
        return results

    def _add(self, xs: Sequence[int], ys: Sequence[int]) -> list[int]:
        return [self.f("add", *pair) for pair in zip(xs, ys, strict=True)]

    def _miss_constraints(self, z: Sequence[int]) -> dict[int, int]:
        """r − A z in the rows of constraints, whose entries are those of coordinates alone."""
        entries = self.linear.entries
        rows = set(range(self.n, len(z))) - {i for place in entries if min(place) >= self.n for i in place}
        found = {}
        for i in sorted(rows):
            known = {j: c for (k, j), c in entries.items() if k == i}
            found[i] = self.f("sub", self.linear.right[i], self._dot(known, z))
        return found

    def _effects(self, acts: Sequence[Sparse], slopes: Sequence[Sparse]) -> tuple[list[Sparse], list[Sparse]]:
        """The slopes of z by each piece, and ∂u̇/∂p of each border by each piece."""
        responses, effects = self._respond(acts), []
        of_coordinates = transpose(responses, len(self.linear.right))
        for d in slopes:
            row = {}
            for m in sorted({m for i in d for m in of_coordinates[i]}):
                both = [i for i in d if i in responses[m]]
                row[m] = dot(self.graph, [d[i] for i in both], [responses[m][i] for i in both])
            effects.append({m: x for m, x in row.items() if x != self.zero})
        return responses, effects

    def _equations(self, effects: list[Sparse], pushed: Sequence[int], slopes: Sequence[Sparse]) -> "Equations":
        """The linear equations of μ; μ = 0 where there is nothing to do."""
        f, rows = self.f, []
        for k, row in enumerate(effects):
            both = {m: self.where(pushed[k], self.where(pushed[m], x)) for m, x in row.items()}
            both[k] = f("select", pushed[k], self.one, row.get(k, self.zero))
            rows.append(both)
        whole = []
        if self._are_dependent(slopes):
            whole = [dict(row) for row in rows]
            for k, row in enumerate(rows):
                row[k] = f("mul", self.number(1 + SOFT), row[k])
        return Equations(eliminate(self.graph, rows), whole)

    def _pushes_back(self, j: int, effects, pushed: Sequence[int], slopes, missing: Sequence[int]) -> int:
        """True where border j of positions pushes back what lies beside it; other borders may hold that there, too."""
        f, others = self.f, [k for k in range(len(self.rows)) if k != j]
        if all(self.slides[self.rows[k].slide].order > 1 for k in others):
            return pushed[j]
        without = [p if k != j else f("and", p, f("not", p)) for k, p in enumerate(pushed)]
        equations = self._equations(effects, without, slopes)
        stays = pushed[j]
        for change in (self.number(2.0), self.zero):
            beside = [
                f("sub", x, f("mul", effects[k][j], change)) if j in effects[k] else x for k, x in enumerate(missing)
            ]
            mu = self._unknown(equations, list(map(self.where, without, beside)))
            for k in others:
                held = f("lt", f("abs", f("add", mu[k], self.number(self.rows[k].below))), self.one)
                stays = f("and", stays, f("or", f("not", pushed[k]), held))
            moves = f("abs", f("sub", beside[j], self._dot(drop_entry(effects[j], j), mu)))
            own = effects[j].get(j, self.zero)
            stays = f("and", stays, f("le", moves, f("mul", self.number(STILL), f("abs", own))))
        return f("and", pushed[j], f("not", stays))

    def _unknown(self, equations: "Equations", missing: list[int]) -> list[int]:
        """μ; where borders share what they hold, μ − 1 is to be small: the distance from the middle of both sides."""
        if not equations.whole:
            return equations.solve(self.graph, missing)
        f, rows = self.f, equations.whole
        below = [self.number(row.below) for row in self.rows]
        there = [f("add", x, self._dot(row, below)) for x, row in zip(missing, rows, strict=True)]
        return [f("sub", x, p) for x, p in zip(equations.solve(self.graph, there), below, strict=True)]

    def _are_dependent(self, slopes: Sequence[Sparse]) -> bool:
        """True if the rates of some borders are combinations of others, so that these can share what they hold."""
        some, groups = np.random.default_rng(0), {}
        known = [constants(self.graph, of_one) for of_one in slopes]
        for k, group in enumerate(find_groups(slopes, self.n)):
            groups.setdefault(group, []).append(known[k])
        for rows in groups.values():
            place = {i: at for at, i in enumerate(sorted({i for row in rows for i in row}))}
            numbers = np.zeros((len(rows), len(place)))
            for k, row in enumerate(rows):
                for i, value in row.items():
                    numbers[k, place[i]] = some.uniform(0.5, 1.5) if value is None else value
            if not place or np.linalg.matrix_rank(numbers) < len(rows):
                return True
        return False

    def _share(self, k: int, unknown: Sequence[int], slopes, rates, pushed: int, z, effects) -> int:
        """The share of the upper side: μ/2, and far beyond 0 or 1 where both sides do not push.

        Of a cone, which holds up to a length of 1, it is what is left of the square of that, of 1/4: never 1.
        """
        f, half = self.f, self.number(0.5)
        rows = self.rows_of[k]
        mu = [unknown[m] for m in rows]
        if self.slides[k].parts:
            left = f("sub", self.one, dot(self.graph, mu, mu))
            return f("select", pushed, self.number(-FAR), f("mul", self.number(0.25), left))
        moves, own = f("sub", self._dot(slopes[rows[0]], z), rates[rows[0]]), effects[rows[0]].get(rows[0], self.zero)
        moves = f("select", f("eq", moves, self.zero), moves, own)  # at rest below, the side above alone moves
        beyond = f("select", self.flags[k], half, f("add", half, f("mul", self.number(FAR), moves)))
        return f("select", pushed, beyond, f("mul", half, mu[0]))

    def _push_right_side(
        self, right: Sequence[int], acts: Sequence[dict[int, int]], unknown: Sequence[int]
    ) -> list[int]:
        """r + Σ μₖ ∂r/∂pₖ."""
        pushed = list(right)
        for act, mu in zip(acts, unknown, strict=True):
            for i, c in act.items():
                pushed[i] = self.f("add", pushed[i], self.f("mul", c, mu))
        return pushed

    def _acts(self) -> list[Sparse] | None:
        """∂r/∂pₖ, entry by entry: half of the difference of both sides; of a cone, what a unit of its vector does."""
        of_sides = self._values_on_both_sides()
        if of_sides is None:
            return None
        acts, entries = [], {}
        for i, x in enumerate(self.linear.right):
            entries.setdefault(x, []).append(i)
        for m, (k, *_) in enumerate(self.rows):
            if self.slides[k].parts:
                below, above = self._evaluate_cone(k, None), self._evaluate_cone(k, self.rows[m].offset)
                factor = self.one
            else:
                below, above = ({x: pair[side] for x, pair in of_sides[k].items()} for side in range(2))
                factor = self.number(0.5)
            act = {}
            for i, node in sorted((i, x) for x in below.keys() & above.keys() & entries.keys() for i in entries[x]):
                change = self.f("sub", above[node], below[node])
                if self.graph.value(change) != 0:
                    act[i] = self.f("mul", factor, change)
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

    def _reads_others(self, k: int, act: Sparse) -> bool:
        others = self._all_pieces.intersection(self.graph.find_ancestors(act.values())) - {self.pieces[k]}
        return self.slides[k].width > 1 and bool(others)

    @functools.cached_property
    def _all_pieces(self) -> frozenset[int]:
        return frozenset(self.pieces)

    def _values_on_both_sides(self) -> list[dict[int, tuple[int, int]]] | None:
        """For each piece the nodes that depend on it, with their values below and above, other pieces as they are."""
        graph, system = self.graph, self.linear
        pieces = {node: k for k, node in enumerate(self.pieces)}
        matrix = *system.entries.values(), *system.others.values(), *system.factors
        if not pieces.keys().isdisjoint(graph.find_ancestors(matrix)):
            return None
        sides: dict[int, dict[int, tuple[int, int]]] = {}
        of_pieces: list[dict[int, tuple[int, int]]] = [{} for _ in self.slides]
        minus_one = self.number(-1.0)
        for i in graph.find_ancestors(system.right):
            if i in pieces and self.slides[pieces[i]].parts:
                continue
            if i in pieces:
                is_sign = self.slides[pieces[i]].width > 1
                of_pieces[pieces[i]][i] = (minus_one, self.one) if is_sign else (i, self.f("add", i, self.one))
                sides[i] = {pieces[i]: of_pieces[pieces[i]][i]}
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
            for k, pair in values.items():
                of_pieces[k][i] = pair
        return of_pieces

    def _rate(self, k: int) -> tuple[Sparse, int, int]:
        """∂w/∂q̇ and −∂w/∂q q̇ − ∂w/∂t of what is to stay zero, u or u̇. And w."""
        n, node = self.n, self.rows[k].offset
        level, slopes = node, {}
        for _ in range(self.slides[self.rows[k].slide].order):
            nodes = range(len(self.graph.nodes))
            level, slopes = node, dict(sorted(slopes_in(self.graph, self.graph, nodes, node, range(2 * n + 1)).items()))
            by_place = {i: x for i, x in slopes.items() if i < n}
            velocities = [self.graph.input(n + i, "float") for i in by_place]
            node = self.f("add", dot(self.graph, by_place.values(), velocities), slopes.get(2 * n, self.zero))
        by_velocity = {i - n: x for i, x in slopes.items() if n <= i < 2 * n}
        return by_velocity, self.f("neg", node), level

    def _system(self, z, unknown, acts, slopes, rates, of_unknowns, pivots) -> LinearSystem:
        system, count = self.linear, len(self.linear.right)
        others = {(i, count + k): self.f("neg", c) for k, act in enumerate(acts) for i, c in act.items()}
        entries = ((k, i, d) for k, of_one in enumerate(slopes) for i, d in of_one.items())
        others |= {(count + k, i): d for k, i, d in entries if self.graph.value(d) != 0}
        # What `solve` needs besides: the entries, and the elimination of the unknowns.
        own = [*others.values(), *(x for table in of_unknowns for row in table for x in row.values())]
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
            equations = Equations(*([{j: at[x] for j, x in row.items()} for row in table] for table in of_unknowns))
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
            of_rows: dict[int, Sparse] = {}
            for (row, j), d in others.items():
                of_rows.setdefault(row - count, {})[j] = d
            for k, i, free, inverse in pivots:
                end = ends[k]
                for j, d in drop_entry(of_rows.get(k, {}), i).items():
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
        self.of_coordinates = transpose(responses, n)
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
            row = drop_entry(self.slopes[k], i)
            others = dot(self.graph, row.values(), [z[j] for j in row])
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
        changes = solve([f("select", pushed_of[k], self.zero, level) for k, level in left])
        multiples = dict(zip(which, changes, strict=True))
        for i, of in enumerate(self.of_coordinates):
            some = [k for k in of if k in multiples]
            # A force that pushes onto no border may have no value beyond it, as sign(u) √(|u| + c) away from u = 0.
            along = [f("select", pushed_of[k], self.zero, of[k]) for k in some]
            moves = dot(self.graph, along, [multiples[k] for k in some])
            state[first + i] = f("sub", state[first + i], moves)
        left, moved = dict(zip(which, self._evaluate(levels), strict=True)), [self.zero] * n
        for k, i, divisor in self.divisors:
            if k in left:
                row = self.slopes[k]
                change = f("div", f("add", left[k], dot(self.graph, row.values(), [moved[j] for j in row])), divisor)
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
        moved = ({i: x for i, x in response.items() if i < self.n} for response in self.responses)
        return line, tuple(frozenset(constants(graph, of)) for of in moved)


def _choose_pivots(rows: Sequence[dict[int, float | None]]) -> list[tuple[int, int]]:
    """Borders, each with a coordinate that can follow from the others, in an order in which none changes one before.

    `rows` has the slopes ∂u̇/∂q̈ᵢ of each border that are not zero, None for those that are no constants. A pivot is
    alone in its row, or has the largest constant of it, so that it gathers no rounding. A border may have none.
    """
    left, behind, times = dict(enumerate(rows)), [], Counter(i for row in rows for i in row)

    def is_free(k: int, i: int) -> bool:
        constants = {j: abs(x) for j, x in rows[k].items() if x is not None}
        leads = len(rows[k]) == 1 or (i in constants and constants[i] == max(constants.values()))
        return leads and times[i] == 1

    while (found := next(((k, i) for k, row in left.items() for i in row if is_free(k, i)), None)) is not None:
        behind.append(found)
        times.subtract(left.pop(found[0]).keys())
    return [(k, i) for k, row in left.items() for i in row if len(row) == 1] + behind[::-1]
