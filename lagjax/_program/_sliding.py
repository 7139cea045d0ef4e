"""Motion along borders onto which both sides push (Filippov's sliding mode): their shares are further unknowns.

On a border u = 0 the acceleration is a share α of that on the upper side plus 1 − α of that on the lower one, with α
such that u stays zero (Filippov, *Differential Equations with Discontinuous Righthand Sides*, 1988, ch. 2, §4). Where u
depends on velocities, u̇ = 0 is required; where it depends on positions alone, ü = 0. The shares of several borders
solve one linear system.

If pieces act only on the right side of A z = r, independently (`_border_forces`), they become unknowns of that system:
the piece p + μ in place of p, with A z − Σ μₖ ∂r/∂pₖ = r, and one more row for each, u̇ = 0, or μ = 0 where nothing
slides. Then no series of an elimination is needed. Otherwise, for few pieces, the system is z = q̈ itself. `_held`
removes the rounding error that these equations leave.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._border_forces import LARGEST_SLIDING, Slide, SlidingRows
from lagjax._program._differentiation import copy_nodes, copy_operation
from lagjax._program._graph import Graph, find_descendants, find_readers
from lagjax._program._held import BorderEquations, HeldMotion, choose_pivots
from lagjax._program._levels import FAR
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import LinearSystem, StraightLine
from lagjax._program._small_equations import (
    SOFT,
    Eliminated,
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


class Holding(NamedTuple):
    """The means to keep a motion on the borders along which it slides.

    `retraction` maps the inputs of the program to the state (q, q̇) on the borders; None if the motion cannot slide.
    `moved` are the coordinates that the force of each border moves; borders of different `groups` do not interact at an
    instant. `release` gives for each cone two changes of q̇ (n,): the first makes its vector a unit vector in the
    direction of the remaining force, the second makes it zero. `unheld` counts the borders along which sliding is
    possible but not computed.
    """

    retraction: StraightLine | None = None
    moved: tuple[frozenset[int], ...] = ()
    groups: tuple[int, ...] = ()
    release: StraightLine = StraightLine((), (), ())
    unheld: int = 0


class Sliding(NamedTuple):
    """A program with shares as further switching numbers; `places` maps the nodes of the program without them."""

    line: StraightLine
    places: Sequence[int]
    shares: list[int]
    linear: LinearSystem | None
    holding: Holding


def with_sliding(
    line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide], linear: Any
) -> Sliding | None:
    """The program whose motion slides along the borders `slides` where its last inputs, flags, are 1; None if too long.

    `first` is the position of the first piece among the inputs, `switches` are the nodes of the switching numbers.
    """
    if not slides:
        return Sliding(line, range(len(line.nodes)), [], linear, Holding())
    if linear is not None and (done := _build_sliding(line, n, first, switches, slides, linear)) is not None:
        return done
    is_large = len(slides) > MOST_COPIES or len(line.nodes) > LARGEST_COPIED
    if is_large or any(slide.order > 1 or slide.parts for slide in slides):
        return None
    done = _build_sliding(line, n, first, switches, slides, _identity_system(line.outputs[:n]))
    return done and done._replace(linear=None)


def _identity_system(z: Sequence[int]) -> LinearSystem:
    """The linear system 1 z = z, for pieces that act on more than the right side of the scene's system."""
    inputs = tuple(("input", (), i) for i in range(len(z)))
    same = StraightLine(inputs, ("float",) * len(z), tuple(range(len(z))))
    return LinearSystem(tuple(z), {}, tuple(z), (), lambda: same)


def _build_sliding(
    line: StraightLine, n: int, first: int, switches: Sequence[int], slides: Sequence[Slide], linear: LinearSystem
) -> Sliding | None:
    """The sliding program; None if pieces act on more than the right side of A z = r, or not independently."""
    rows = SlidingRows.from_slides(line, n, first, switches, slides)
    acts = rows.find_forces(linear)
    if acts is None or rows.is_nonlinear(linear.right, acts, range(first, first + len(switches))):
        return None
    forces = _SlidingForces(line, rows, linear, acts)
    return None if np.bincount(forces.groups).max() > MOST_COUPLED else forces.build()


class _SlidingForces:
    """Builder of the sliding program: μ, one per sliding row, are unknowns; `acts` are the sparse vectors ∂r/∂μₖ."""

    def __init__(self, line: StraightLine, rows: SlidingRows, linear: LinearSystem, acts: list[Sparse]):
        self.line, self.rows, self.linear, self.acts = line, rows, linear, acts
        self.graph, self.f = rows.graph, rows.graph.apply
        self.zero, self.one = rows.graph.number(0.0), rows.graph.number(1.0)
        self.slopes, self.rates, self.levels = zip(*map(rows.rate, range(len(acts))), strict=True)
        self.groups = self._find_groups()

    def zero_unless(self, condition: int, x: int) -> int:
        """The node x where the condition holds, else zero."""
        return self.zero if self.graph.value(x) == 0 else self.f("select", condition, self.zero, x)

    def build(self) -> Sliding:
        rows, slopes = self.rows, self.slopes
        responses, effects = self._piece_effects()
        pushed = self._find_pushed_rows(effects)
        pivots = choose_pivots([constants(self.graph, d) for d in slopes])
        held = HeldMotion(self.graph, rows.n, pushed, slopes, responses, pivots)
        coupled = BorderEquations(
            # Borders that are not pushed onto are left, and act on nothing until then.
            [{i: self.zero_unless(p, c) for i, c in act.items()} for p, act in zip(pushed, self.acts, strict=True)],
            [{i: self.zero_unless(p, d) for i, d in of.items()} for p, of in zip(pushed, slopes, strict=True)],
            self._share_equations(effects, pushed, slopes),
            held.pivots(),
        )
        ends = list(map(self.zero_unless, pushed, self.rates))
        missing = coupled.border_residuals(self.graph, self.linear.z, ends)
        mu = self._solve_shares(coupled.equations, missing, range(len(missing)))
        directions = [self.f("select", p, self.f("neg", x), y) for p, x, y in zip(pushed, missing, mu, strict=True)]
        z = self._solve_system(coupled.add_forces(self.graph, self.linear.right, mu))
        missed = self._constraint_residuals(z)
        if len(pivots) < len(self.acts) or missed:
            # What has no pivot, and what constraints tie to one, is held by the rounding of rounding.
            rest = self._solve_system([missed.get(i, self.zero) for i in range(len(z))]) if missed else []
            z = [self.f("add", *pair) for pair in zip(z, rest, strict=True)] if missed else z
            z, mu = coupled.refine(self.graph, self._solve_system, z, mu, ends)
        z = held.solve_pivots(z, self.rates)
        shares = [self._upper_share(k, mu, pushed, z, effects) for k in range(len(rows.slides))]
        linear = self._share_system(z, mu, coupled, ends)
        outputs = (*z[: rows.n], *self.line.outputs[rows.n :])
        line = StraightLine(tuple(self.graph.nodes), tuple(self.graph.kinds), outputs)
        release = eliminate_dead_code(self.graph, self._release_shares(directions))
        retraction, moved = self._build_retraction(held, coupled.equations, effects, pushed, missing)
        of_slides = tuple(frozenset().union(*some) for some in rows.group(moved))
        groups = tuple(self.groups[rows[0]] for rows in rows.of_slides)
        holding = Holding(retraction, of_slides, groups, release)
        return Sliding(line, range(len(self.line.nodes)), shares, linear, holding)

    def _find_pushed_rows(self, effects: Sequence[Sparse]) -> list[int]:
        """For each row a flag: both sides push onto its border, and onto all rows of its slide."""
        pushed = [self.f("lt", row.get(k, self.zero), self.zero) for k, row in enumerate(effects)]
        of_slides = zip(self.rows.flags, self.rows.group(pushed), strict=True)
        every = [functools.reduce(lambda a, b: self.f("and", a, b), of, flag) for flag, of in of_slides]
        return [every[row.slide] for row in self.rows.rows]

    def _build_retraction(self, held: HeldMotion, equations: Eliminated, effects, pushed, missing):
        """The line that projects the state onto the borders, and the coordinates that each row moves."""
        by_position = [k for k in range(len(pushed)) if self.rows.order(k) > 1]
        if by_position:
            at = {m: i for i, m in enumerate(by_position)}
            some = [{at[m]: x for m, x in effects[k].items() if m in at} for k in by_position]
            pushes = [self._pushes_back(k, effects, pushed, missing) for k in by_position]
            of_positions = self._share_equations(some, pushes, [self.slopes[k] for k in by_position])
            levels = [self.rows.rows[k].offset for k in by_position]
            held.set_back(0, by_position, levels, lambda left: of_positions.solve(self.graph, left), pushes)
        solve = functools.partial(equations.solve, self.graph)
        held.set_back(self.rows.n, range(len(pushed)), self.levels, solve, pushed)
        return held.retraction_line()

    def _find_groups(self) -> list[int]:
        """A group number for each row: rows of different groups move and read coordinates that A does not couple."""
        matrix, size = self.linear.entries | self.linear.others, len(self.linear.right)
        rows: list[Sparse] = [{i: self.one} for i in range(size)]
        for (i, j), x in matrix.items():
            if x != self.zero:
                rows[i][j] = x
        parts = find_groups(rows, size)
        of_cones = [rows[0] for rows in self.rows.of_slides for _ in rows]
        touched = [{parts[i]: self.one for i in both} for both in map(dict.__or__, self.acts, self.slopes)]
        for row, first in zip(touched, of_cones, strict=True):
            row[size + first] = self.one
        return find_groups(touched, size + len(touched))

    def _dot_product(self, row: Sparse, xs: Sequence[int]) -> int:
        return dot(self.graph, row.values(), [xs[i] for i in row])

    def _release_shares(self, directions: Sequence[int]) -> list[int]:
        f, slopes, results = self.f, self.slopes, []
        for k, slide in enumerate(self.rows.slides):
            if not slide.parts:
                continue
            rows = self.rows.of_slides[k]
            along = [directions[m] for m in rows]
            length = f("sqrt", dot(self.graph, along, along))
            length = f("select", f("gt", length, self.zero), self.one, length)
            sizes = [dot(self.graph, slopes[m].values(), slopes[m].values()) for m in rows]
            for numbers in ([f("div", x, length) for x in along], [self.rows.rows[m].offset for m in rows]):
                parts = [f("div", x, size) for x, size in zip(numbers, sizes, strict=True)]
                results += [self._dot_product(of, parts) for of in transpose([slopes[m] for m in rows], self.rows.n)]
        return results

    @functools.cached_property
    def _solution_line(self) -> StraightLine:
        return self.linear.solve()

    def _solve_system(self, right: Sequence[int]) -> list[int]:
        """The solution z of A z = r, as nodes."""
        nodes = copy_nodes(self.graph, self._solution_line, [*self.linear.factors, *right])
        return [nodes[i] for i in self._solution_line.outputs]

    def _solve_sparse_sides(self, acts: Sequence[Sparse]) -> list[Sparse]:
        """The solutions z of A z = r for sparse right-hand sides `acts`; only what depends on these is computed."""
        line, first, results = self._solution_line, len(self.linear.factors), []
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

    def _constraint_residuals(self, z: Sequence[int]) -> dict[int, int]:
        """The residuals r − A z in the rows of constraints, {row: node}; such a row has entries of coordinates only."""
        entries = self.linear.entries
        rows = set(range(self.rows.n, len(z))) - {i for place in entries if min(place) >= self.rows.n for i in place}
        found = {}
        for i in sorted(rows):
            known = {j: c for (k, j), c in entries.items() if k == i}
            found[i] = self.f("sub", self.linear.right[i], self._dot_product(known, z))
        return found

    def _piece_effects(self) -> tuple[list[Sparse], list[Sparse]]:
        """The derivatives of z by each piece, and for each border the derivatives of u̇ by each piece, sparse."""
        responses, effects = self._solve_sparse_sides(self.acts), []
        of_coordinates = transpose(responses, len(self.linear.right))
        for d in self.slopes:
            row = {}
            for m in sorted({m for i in d for m in of_coordinates[i]}):
                both = [i for i in d if i in responses[m]]
                row[m] = dot(self.graph, [d[i] for i in both], [responses[m][i] for i in both])
            effects.append({m: x for m, x in row.items() if x != self.zero})
        return responses, effects

    def _share_equations(self, effects: list[Sparse], pushed: Sequence[int], slopes: Sequence[Sparse]) -> Eliminated:
        """The eliminated linear equations of μ; μ = 0 for rows onto which no two sides push."""
        f, rows = self.f, []
        for k, row in enumerate(effects):
            both = {m: self.zero_unless(pushed[k], self.zero_unless(pushed[m], x)) for m, x in row.items()}
            both[k] = f("select", pushed[k], self.one, row.get(k, self.zero))
            rows.append(both)
        whole = []
        if self._are_dependent(slopes):
            whole = [dict(row) for row in rows]
            for k, row in enumerate(rows):
                row[k] = f("mul", self.graph.number(1 + SOFT), row[k])
        return Eliminated(eliminate(self.graph, rows), whole)

    def _pushes_back(self, j: int, effects, pushed: Sequence[int], missing: Sequence[int]) -> int:
        """The flag that border j by position pushes a state next to it back, where no border by velocity holds it."""
        members = [k for k, group in enumerate(self.groups) if group == self.groups[j]]
        if all(self.rows.order(k) > 1 for k in members if k != j):
            return pushed[j]
        f, at = self.f, {k: i for i, k in enumerate(members)}
        of_group = [{at[m]: x for m, x in effects[k].items()} for k in members]
        without = [pushed[k] if k != j else f("and", pushed[k], f("not", pushed[k])) for k in members]
        equations = self._share_equations(of_group, without, [self.slopes[k] for k in members])
        stays, acts = pushed[j], [effects[k].get(j) for k in members]
        for change in (self.graph.number(2.0), self.zero):
            beside = [
                missing[k] if x is None else f("sub", missing[k], f("mul", x, change))
                for k, x in zip(members, acts, strict=True)
            ]
            mu = self._solve_shares(equations, list(map(self.zero_unless, without, beside)), members)
            for k in members:
                if k != j:
                    held = f("lt", f("abs", f("add", mu[at[k]], self.graph.number(self.rows.rows[k].below))), self.one)
                    stays = f("and", stays, f("or", f("not", pushed[k]), held))
            others = drop_entry(of_group[at[j]], at[j])
            moves = f("abs", f("sub", beside[at[j]], self._dot_product(others, mu)))
            own = effects[j].get(j, self.zero)
            stays = f("and", stays, f("le", moves, f("mul", self.graph.number(STILL), f("abs", own))))
        return f("and", pushed[j], f("not", stays))

    def _solve_shares(self, equations: Eliminated, missing: list[int], members: Sequence[int]) -> list[int]:
        """The solution μ of rows; for dependent borders the one with the smallest distance from the middle, |μ − 1|."""
        if not equations.whole:
            return equations.solve(self.graph, missing)
        f, rows = self.f, equations.whole
        below = [self.graph.number(self.rows.rows[k].below) for k in members]
        there = [f("add", x, self._dot_product(row, below)) for x, row in zip(missing, rows, strict=True)]
        return [f("sub", x, p) for x, p in zip(equations.solve(self.graph, there), below, strict=True)]

    def _are_dependent(self, slopes: Sequence[Sparse]) -> bool:
        """True if the rates of some borders are linear combinations of others, so that their forces are not unique."""
        some, groups = np.random.default_rng(0), {}
        known = [constants(self.graph, of_one) for of_one in slopes]
        for k, group in enumerate(find_groups(slopes, self.rows.n)):
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

    def _upper_share(self, k: int, unknown: Sequence[int], pushed: Sequence[int], z, effects) -> int:
        """The share of the upper side of slide k: μ/2; far beyond 0 or 1 where the two sides do not push onto it.

        For a cone, which holds while |μ| < 1, it is (1 − |μ|²) / 4, never 1.
        """
        f, half = self.f, self.graph.number(0.5)
        rows = self.rows.of_slides[k]
        row, mu = rows[0], [unknown[m] for m in rows]
        if self.rows.slides[k].parts:
            left = f("sub", self.one, dot(self.graph, mu, mu))
            return f("select", pushed[row], self.graph.number(-FAR), f("mul", self.graph.number(0.25), left))
        moves, own = f("sub", self._dot_product(self.slopes[row], z), self.rates[row]), effects[row].get(row, self.zero)
        moves = f("select", f("eq", moves, self.zero), moves, own)  # at rest below, the side above alone moves
        beyond = f("select", self.rows.flags[k], half, f("add", half, f("mul", self.graph.number(FAR), moves)))
        return f("select", pushed[row], beyond, f("mul", half, mu[0]))

    def _share_system(self, z: list[int], mu: list[int], coupled: BorderEquations, ends: list[int]) -> LinearSystem:
        system, count, graph = self.linear, len(self.linear.right), self.graph
        others = {(i, count + k): self.f("neg", c) for k, act in enumerate(coupled.acts) for i, c in act.items()}
        entries = ((k, i, d) for k, of_one in enumerate(coupled.normals) for i, d in of_one.items())
        others |= {(count + k, i): d for k, i, d in entries if graph.value(d) != 0}
        read: dict[int, None] = {}  # what `solve` needs besides
        coupled.rename(lambda x: x if graph.value(x) is not None else read.setdefault(x) or x)
        factors = (*system.factors, *read)

        def solve():
            graph = Graph(LARGEST_SLIDING)
            inputs = [graph.input(i, "float") for i in range(len(factors) + count + len(ends))]
            of_system, rest = inputs[: len(system.factors)], inputs[len(factors) :]
            at = dict(zip(read, inputs[len(system.factors) :], strict=False))
            inner = system.solve()

            def apply_inverse(right):
                nodes = copy_nodes(graph, inner, [*of_system, *right])
                return [nodes[i] for i in inner.outputs]

            here = coupled.rename(lambda x: at[x] if x in at else graph.constant(self.graph.value(x), "float"))
            results = here.solve(graph, apply_inverse, rest[:count], rest[count:])
            return StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(results))

        return LinearSystem((*z, *mu), system.entries, (*system.right, *ends), factors, solve, system.others | others)
