"""Kinetic energies that are built by recursion: the accelerations of n links in a number of operations that grows as n.

    L(q, q̇) = N(q, w),    wₖ = Σⱼ cₖⱼ(q) wⱼ + Σᵢ cₖᵢ(q) q̇ᵢ       velocities of parts, from those of parts before them

Along a chain every link adds to the velocity of the one that carries it. M = ∂²L/∂q̇² = Jᵀ H J, with w = J q̇ and
H = ∂²N/∂w², then has no zeros, and to eliminate it takes n³/3 operations; but M x = b is what is left of a system whose
matrix has hardly anything but zeros, with the accelerations x, what w becomes for q̇ = x, and multipliers μ of the
definitions of w:

    ( H_xx  H_xw   C_xᵀ   )   ( x )     ( b )
    ( H_wx  H_ww  C_wᵀ−1  ) · ( w )  =  ( 0 )
    ( C_x   C_w−1    0    )   ( μ )     ( 0 )

A velocity wₖ is eliminated with its definition, which puts Σ c w in its place in the energy: an exact step, after those
that are defined by wₖ. A coordinate is eliminated after the velocities that it defines; its pivot is the energy of its
motion where the parts behind it move freely. For a chain of bodies these steps are the articulated-body algorithm
(Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7), and the chain is not declared: it is in the trace of L.

The energy as a function of independent w need not be positive, though M is. A pivot that is lost, or negative, says so
in the singularity flag, and the elimination of M itself (`_saddle`) takes over.
"""

import heapq
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lagjax._equations._linear import singular_threshold
from lagjax._program import Derivatives, Graph, copy_nodes
from lagjax._tracing import Expansion, Scalars

Form = dict[int, int]  # a linear combination of unknowns: the node of the factor of each


class Recursion(NamedTuple):
    """The sparse system for q̈ (`size` coordinates), velocities w that L builds recursively, and multipliers μ."""

    size: int
    definitions: list[Form]  # the terms of every w
    energy: dict[tuple[int, int], int]  # the entries of H on and below its diagonal, nodes of a graph

    @property
    def entries(self) -> dict[tuple[int, int], int | None]:
        """The entries of the matrix on and below its diagonal, None for the −1 of a definition."""
        first = self.size + len(self.definitions)
        entries: dict[tuple[int, int], int | None] = dict(self.energy)
        for k, definition in enumerate(self.definitions):
            entries |= {(first + k, u): c for u, c in definition.items()}
            entries[first + k, self.size + k] = None
        return entries


# ---- what L computes linearly from the velocities --------------------------------------------------------------------


def recursion_of(derivatives: Derivatives, value: int, qdot: Sequence[int]) -> Recursion | None:
    """The recursion in a Lagrangian, whose node is `value`; None if no velocity is used twice."""
    graph = derivatives.graph
    linear, curved, uses = _linear_nodes(derivatives, derivatives.find_ancestors([value]), qdot)
    frontier = sorted({x for i in curved for x in derivatives.node_to_differentiate(i)[1] if x in linear})
    if not any(uses[i] > 1 for i in linear):
        return None
    hessian = _frontier_hessian(derivatives, value, curved, frontier)
    unknowns = _AffineNodes(graph, qdot, {i for i, j in hessian if i == j}, uses)
    for i, terms in linear.items():
        unknowns.add(i, terms)
    if not unknowns.definitions:
        return None
    return Recursion(len(qdot), unknowns.definitions, unknowns.energy(hessian))


def _linear_nodes(derivatives: Derivatives, below: Iterable[int], qdot: Sequence[int]):
    """The nodes that are affine in q̇, with their terms; those that are not; and the number of uses of the former."""
    linear: dict[int, list[tuple[int, int]]] = {i: [] for i in qdot}
    curved: dict[int, None] = {}
    uses = dict.fromkeys(qdot, 0)
    for i in below:
        op, operands, _ = derivatives.node_to_differentiate(i)
        moving = [x for x in operands if x in linear or x in curved]
        if not moving or i in linear:
            continue
        terms = None if any(x in curved for x in moving) else _affine_terms(derivatives.graph, op, operands, linear)
        if terms is None:
            curved[i] = None
        else:
            linear[i] = terms
            uses[i] = 0
        for x in moving:
            if x in linear:
                uses[x] += 1
    return linear, curved, uses


def _affine_terms(graph: Graph, op: str, operands: Sequence[int], linear) -> list[tuple[int, int]] | None:
    """A node as a sum of (affine node, factor) pairs; None if it is not affine in q̇."""
    one, minus = (graph.constant(x, "float") for x in (1.0, -1.0))
    if op == "neg":
        return [(operands[0], minus)]
    if op in ("add", "sub"):
        factors = one, minus if op == "sub" else one
        return [(x, c) for x, c in zip(operands, factors, strict=True) if x in linear]
    if op == "mul" and (operands[0] in linear) != (operands[1] in linear):
        x, c = operands if operands[0] in linear else operands[::-1]
        return [(x, c)]
    if op == "div" and operands[1] not in linear:
        return [(operands[0], graph.apply("div", one, operands[1]))]
    return None


def _frontier_hessian(derivatives: Derivatives, value: int, curved: Iterable[int], frontier: list[int]):
    """The second derivatives of L by the nodes of a frontier, on and below the diagonal, as nodes of the graph."""
    # In a graph of its own these nodes are inputs: where L is, a product with one of them may be known as another
    # product, in which it no longer appears.
    graph, apart = derivatives.graph, Graph(derivatives.graph.budget)
    inputs: list[int] = []
    nodes: dict[int, int] = {}

    def known(x):
        if x not in nodes and (number := graph.value(x)) is not None:
            nodes[x] = apart.constant(number, graph.kinds[x])
        elif x not in nodes:
            nodes[x] = apart.input(len(inputs), graph.kinds[x])
            inputs.append(x)
        return nodes[x]

    varied = [known(i) for i in frontier]
    for i in curved:
        op, operands, attribute = derivatives.node_to_differentiate(i)
        xs = [known(x) for x in operands]
        if op == "integer_pow":
            nodes[i] = apart.apply("pow", *xs, apart.constant(attribute, "float"))
        else:
            nodes[i] = apart.apply(op, *xs, attribute=attribute)
    second, one = Derivatives(apart), apart.constant(1.0, "float")
    slopes = second.slopes(nodes[value], second.find_ancestors([nodes[value]]), varied)
    rows = second.directional_derivatives(slopes, [{i: one} for i in varied])
    places = copy_nodes(derivatives.graph, apart, inputs)
    return {(frontier[a], frontier[b]): places[node] for a, row in enumerate(rows) for b, node in row.items() if b <= a}


class _AffineNodes:
    """Nodes that are affine in q̇ as combinations of unknowns: coordinates, and velocities w worth an unknown.

    A combination of several unknowns becomes an unknown if it is used more than once, or squared (`energetic`). One
    used once, as Iω in ½ ω·(Iω), is better written out.
    """

    def __init__(self, graph: Graph, qdot: Sequence[int], energetic: set[int], uses: dict[int, int]):
        self._graph, self._energetic, self._uses, self._size = graph, energetic, uses, len(qdot)
        self._one = graph.constant(1.0, "float")
        self._forms: dict[int, Form] = {i: {j: self._one} for j, i in enumerate(qdot)}
        self.definitions: list[Form] = []

    def add(self, i: int, terms: list[tuple[int, int]]) -> None:
        if i in self._forms:
            return
        form: Form = {}
        for x, factor in terms:
            for u, c in self._forms[x].items():
                _add_to_sum(self._graph, form, u, self._graph.apply("mul", c, factor))
        form = {u: c for u, c in form.items() if self._graph.value(c) != 0}
        if len(form) > 1 and (i in self._energetic or self._uses[i] > 1):
            self.definitions.append(form)
            form = {self._size + len(self.definitions) - 1: self._one}
        self._forms[i] = form

    def energy(self, hessian: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
        """The second derivatives by the unknowns, from those by nodes, each of which is a multiple of one unknown."""
        result: dict[tuple[int, int], int] = {}
        apply = self._graph.apply
        for (a, b), node in hessian.items():
            for u, c in self._forms[a].items():
                for v, d in self._forms[b].items():
                    part = apply("mul", apply("mul", c, d), node)
                    if u == v and a != b:
                        part = apply("mul", self._graph.constant(2.0, "float"), part)
                    _add_to_sum(self._graph, result, _ordered_pair(u, v), part)
        return {pair: node for pair, node in result.items() if self._graph.value(node) != 0}


def _add_to_sum(graph: Graph, sums: dict, key, part: int) -> None:
    sums[key] = graph.apply("add", sums[key], part) if key in sums else part


def _ordered_pair(u: int, v: int) -> tuple[int, int]:
    return (u, v) if u > v else (v, u)


# ---- elimination -----------------------------------------------------------------------------------------------------


_LARGEST_COUNT = 10_000_000  # operations that are counted


class _EliminationStep(NamedTuple):
    """A step of elimination: the unknown, the unknowns that define it (none: a coordinate), and those coupled to it."""

    unknown: int
    terms: tuple[int, ...]
    others: tuple[int, ...]


class RecursiveElimination:
    """The sparse system of a recursion as straight-line arithmetic, for one pattern of zeros.

    `entries` (k, 2) lists the rows and columns of entries that may be nonzero on and below the diagonal: `factors`
    takes a vector of these in that order. Both functions are for `Scalars` only.
    """

    def __init__(self, recursion: Recursion, dtype):
        self.size, self.velocities = recursion.size, len(recursion.definitions)
        self.entries = np.array(list(recursion.entries), int).reshape(-1, 2)
        self.threshold = singular_threshold(self.size, dtype)
        self.steps = list(_steps(self.size, [set(form) for form in recursion.definitions], set(recursion.energy)))

    @property
    def complete(self) -> bool:
        """True if every unknown can be eliminated: no pivot is structurally zero."""
        return len(self.steps) == self.size + self.velocities

    def operations(self, numbers: Sequence[float | None]) -> tuple[int, int]:
        """The numbers of operations of elimination with one solution, and of one order of a Taylor series."""
        # `numbers` has those of the entries that are known.
        graph = Graph(_LARGEST_COUNT)
        expansion = Expansion(graph)

        def inputs(count, start):
            return [graph.input(start + k, "float") for k in range(count)]

        names = inputs(len(numbers), 0)
        values = [i if x is None else graph.constant(x, "float") for i, x in zip(names, numbers, strict=True)]
        factors, _ = self.factors(Scalars(expansion, np.array(values)))
        total = self.size + 2 * self.velocities
        right = inputs(total, len(numbers))
        short = right[: self.size] + [graph.constant(0.0, "float")] * (2 * self.velocities)
        z = self.solve(factors, Scalars(expansion, np.array(short)))[: self.size]
        of_first = Derivatives(graph).size([*z.ids.tolist(), *factors.ids.tolist()])
        before = Derivatives(graph).size(factors.ids.tolist())
        z = self.solve(factors, Scalars(expansion, np.array(right)))
        return of_first, Derivatives(graph).size([*z.ids.tolist(), *factors.ids.tolist()]) - before

    def factors(self, values: Scalars) -> tuple[Any, Any]:
        """The factors that `solve` needs, a tree of vectors, and a flag: a pivot was lost."""
        work = _EnergyElimination(self, values)
        for step in self.steps:
            work.velocity(step) if step.terms else work.coordinate(step)
        return Scalars(values.expansion, np.array(work.factors)), Scalars(values.expansion, np.array(work.lost))

    def solve(self, factors: Scalars, right: Scalars) -> Scalars:
        """q̈, w and μ, linear in `right`, which has the same length."""
        graph, of_steps, end = right.expansion.graph, [], 0
        apply, z, ids = graph.apply, *([graph.real(i) for i in x.ids.tolist()] for x in (right, factors))

        def combine(operation, total, c, x):
            return apply(operation, total, apply("mul", c, x))

        for step in self.steps:
            x, (count, others) = step.unknown, (len(step.terms), len(step.others))
            start, end = end, end + count + others + 1
            of_steps.append((step, ids[start : start + count], ids[start + count : end - 1], ids[end - 1]))
            _, cs, ss, _ = of_steps[-1]
            for u, c in zip(step.terms, cs, strict=True):
                z[u] = combine("add", z[u], c, z[x])
            operation, moved = ("add", z[x + self.velocities]) if step.terms else ("sub", z[x])
            for u, s in zip(step.others, ss, strict=True):
                z[u] = combine(operation, z[u], s, moved)
        for step, cs, ss, last in reversed(of_steps):
            x, y = step.unknown, step.unknown + self.velocities
            if not step.terms:
                z[x] = apply("mul", z[x], last)
                for u, s in zip(step.others, ss, strict=True):
                    z[x] = combine("sub", z[x], s, z[u])
                continue
            velocity, multiplier = apply("neg", z[y]), apply("neg", combine("add", z[x], last, z[y]))
            for u, c in zip(step.terms, cs, strict=True):
                velocity = combine("add", velocity, c, z[u])
            for u, s in zip(step.others, ss, strict=True):
                multiplier = combine("add", multiplier, s, z[u])
            z[x], z[y] = velocity, multiplier
        return Scalars(right.expansion, np.array(z))


class _EnergyElimination:
    """The entries of the energy matrix during elimination, as nodes of a graph."""

    def __init__(self, elimination: RecursiveElimination, values: Scalars):
        self._graph = graph = values.expansion.graph
        self._apply = graph.apply
        self._number = lambda x: graph.constant(x, "float")
        self._threshold = self._number(elimination.threshold)
        self.factors: list[int] = []
        self.lost = graph.constant(False, "bool")
        self._energy: dict[tuple[int, int], int] = {}
        self._definitions: dict[int, Form] = {}
        first = elimination.size + elimination.velocities
        for (row, column), i in zip(elimination.entries.tolist(), values.ids.tolist(), strict=True):
            node = graph.real(i)
            if row < first:
                self._energy[row, column] = node
            elif column != row - elimination.velocities:
                self._definitions.setdefault(row - elimination.velocities, {})[column] = node
        # Lost pivots are recognised by what the diagonal would be if nothing had been taken off.
        self._sizes = {u: node for (u, v), node in self._energy.items() if u == v}

    def _add_to_sum(self, sums: dict, key, a: int, b: int) -> None:
        """Add a product to the sum under a key."""
        _add_to_sum(self._graph, sums, key, self._apply("mul", a, b))

    def velocity(self, step: _EliminationStep) -> None:
        """Substitute the definition Σ c u for a velocity w: r w + ½ h w² becomes Σ c u r + ½ h (Σ c u)²."""
        w, definition = step.unknown, self._definitions[step.unknown]
        own = self._energy.pop((w, w), None)
        coupled = {u: self._energy.pop(_ordered_pair(w, u)) for u in step.others if _ordered_pair(w, u) in self._energy}
        sums = dict(coupled)
        if own is not None:
            for u in step.terms:
                self._add_to_sum(sums, u, own, definition[u])
        for k, u in enumerate(step.others):
            for v in step.others[: k + 1]:
                first, second = (u, v) if u in definition else (v, u)
                if first not in definition:
                    continue
                if second in sums:
                    self._add_to_sum(self._energy, _ordered_pair(u, v), definition[first], sums[second])
                if second in definition and first in coupled:
                    self._add_to_sum(self._energy, _ordered_pair(u, v), definition[second], coupled[first])
        if (size := self._sizes.pop(w, None)) is not None:
            for u in step.terms:
                self._add_to_sum(self._sizes, u, self._apply("mul", definition[u], definition[u]), size)
        zero = self._number(0.0)
        self.factors += [definition[u] for u in step.terms]
        self.factors += [sums[u] if u in sums else zero for u in step.others]
        self.factors.append(zero if own is None else own)

    def coordinate(self, step: _EliminationStep) -> None:
        """Eliminate a coordinate: what remains of the energy is its minimum over the velocity of that coordinate."""
        x, size = step.unknown, self._sizes.pop(step.unknown)
        pivot = self._energy.pop((x, x))
        least = self._number(0.0) if pivot == size else self._apply("mul", self._threshold, size)
        lost = self._apply("le", pivot, least)
        self.lost = self._apply("or", self.lost, lost)
        inverse = self._apply("div", self._number(1.0), self._apply("select", lost, pivot, self._number(np.nan)))
        column = [self._energy.pop(_ordered_pair(x, u)) for u in step.others]
        lower = [self._apply("mul", a, inverse) for a in column]
        for k, (u, a) in enumerate(zip(step.others, column, strict=True)):
            for v, b in zip(step.others[: k + 1], lower, strict=False):
                pair = _ordered_pair(u, v)
                taken, before = self._apply("mul", a, b), self._energy.get(pair)
                self._energy[pair] = self._apply(*(("neg", taken) if before is None else ("sub", before, taken)))
        self.factors += [*lower, inverse]


def _steps(size: int, terms: list[set[int]], energy: set[tuple[int, int]]) -> Iterator[_EliminationStep]:
    """The order of elimination: of the unknowns that may be eliminated, that coupled to the fewest (minimum degree)."""
    # Ends early at a coordinate without energy, whose pivot would be zero, or with none but that of products of
    # different velocities: nothing then tells how large its pivot should be.
    others: list[set[int]] = [set() for _ in range(size + len(terms))]
    moving = {u for u, v in energy if u == v}
    sized = set(moving)
    waiting = [0] * len(others)  # velocities that are still defined by this one
    for u, v in energy:
        others[u].add(v)
        others[v].add(u)
    for of_one in terms:
        for u in of_one:
            waiting[u] += 1

    def met(x):
        return (others[x] | terms[x - size] if x >= size else others[x]) - {x}

    ready = [(len(met(x)), -x) for x in range(len(others)) if not waiting[x]]
    heapq.heapify(ready)
    done: set[int] = set()
    while ready:
        degree, x = heapq.heappop(ready)
        x = -x
        now = met(x)
        if x in done or degree != len(now):
            continue
        own = tuple(sorted(terms[x - size])) if x >= size else ()
        if not own and x not in sized:
            return
        yield _EliminationStep(x, own, tuple(sorted(now)))
        done.add(x)
        if x in sized:
            sized.update(own)
        _fill_in(x, own, now, others, moving)
        for u in own:
            waiting[u] -= 1
        for u in now:
            if not waiting[u]:
                heapq.heappush(ready, (len(met(u)), -u))


def _fill_in(x: int, terms: Sequence[int], now: set[int], others: list[set[int]], moving: set[int]) -> None:
    """Add the entries of the energy that become nonzero when x is eliminated."""
    coupled = others[x] - {x}
    for u in now:
        others[u].discard(x)
    if not terms:
        for u in now:
            others[u] |= now - {u}
        return
    energetic = x in moving
    for u in terms:
        others[u] |= ((now if energetic else coupled) - {u}) & now
        for v in others[u] & now:
            others[v].add(u)
        if energetic or u in coupled:
            moving.add(u)
