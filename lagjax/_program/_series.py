"""The Taylor series of a motion, from its scalar program.

Along a motion every number of the program is a power series in time, w(t₀ + s) = Σ wₖ sᵏ. The coefficient wₖ of a
result follows from the coefficients of its operands by a recurrence, one for each operation:

    w = u ± v    wₖ = uₖ ± vₖ
    w = u v      wₖ = u₀ vₖ + uₖ v₀ + Σ' uⱼ vₖ₋ⱼ
    w = u / v    wₖ = (uₖ − w₀ vₖ − Σ' wⱼ vₖ₋ⱼ) / v₀
    w = √u       wₖ = (uₖ − Σ' wⱼ wₖ₋ⱼ) / 2 w₀
    w = f(u)     wₖ = uₖ g₀ + 1/k Σ' j uⱼ gₖ₋ⱼ       with g = f′(u), itself a program: cos u for sin u
    A z = r      A₀ zₖ = rₖ − Aₖ z₀ − Σ' Aⱼ zₖ₋ⱼ     with the factors of A₀: no series of an elimination

where Σ' runs over 0 < j < k. Two kinds of work come out of this. The sums Σ', Cauchy products without their outer
terms, need lower orders only, so that all of them can be taken at once, one after the other; nearly all the arithmetic
is there, and its code is the same for every scene. What is left is *linear* in the coefficients of order k: a straight
line of about as many operations as the program itself, the same for every k. So the coefficients of a motion to any
order take one run of `zeroth_order`, and for each order the `cauchy_products` and one run of `order_recursion`.

The circle is closed by whoever knows what the outputs are the rates of: by yₖ₊₁ = fₖ / (k+1) for ẏ = f(t, y), by
qₖ₊₁ = q̇ₖ / (k+1) and q̇ₖ₊₁ = q̈ₖ / (k+1) for q̈(q, q̇, t).

A piecewise operation (`abs`, `select`, `floor` …) has the series of the piece that the state is on: whoever takes steps
must notice when one crosses the border.

Source: Moore, *Interval Analysis* (1966) §11.2; Jorba & Zou, Exp. Math. 14 (2005) 99–117, §2.1; Griewank & Walther,
*Evaluating Derivatives* (2008), ch. 13.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from lagjax._program._graph import Graph, Unlowerable
from lagjax._program._line import StraightLine
from lagjax._program._operations import OPERATIONS
from lagjax._program._passes import eliminate_dead_code, sink_negations
from lagjax._program._recurrences import choose, finite

_LARGEST_SERIES = 100  # operations that the series of one may take: a bound for errors, ten are usual


class LinearSystem(NamedTuple):
    """The linear system A z = r whose solution z are the outputs of a program; all ids are nodes of that program.

    `entries` are those of the symmetric A on and below the diagonal, by (row, column); `others` are entries without a
    symmetric partner. `solve()` makes the straight line from the factors of A, followed by r, to z.
    """

    z: tuple[int, ...]
    entries: dict[tuple[int, int], int]
    right: tuple[int, ...]
    factors: tuple[int, ...]
    solve: Callable[[], StraightLine]
    others: dict[tuple[int, int], int] = {}  # noqa: RUF012  (never written to)

    @property
    def read(self) -> list[int]:
        """The nodes of all entries of r and A."""
        return [*self.right, *self.entries.values(), *self.others.values()]


class Recurrent(Protocol):
    """The part of a `Program` that Taylor series and machine code read, without its JAX part."""

    @property
    def line(self) -> StraightLine: ...
    @property
    def size(self) -> int: ...
    @property
    def dtypes(self) -> Sequence[np.dtype]: ...
    @property
    def linear(self) -> Any: ...


class Series(NamedTuple):
    """The Taylor recurrences of the first `size` outputs of a program, along a motion of its first inputs.

    `zeroth_order` maps the inputs to all outputs and to `values` further numbers. `order_recursion` takes the
    coefficients of order k of the moving inputs, then k and 1/k, these values, and one sum Σ' aⱼ bₖ₋ⱼ for each pair of
    rows (a, b) in `cauchy_products`; it gives the coefficients of order k of the outputs, and of each of the `rows`
    that occur in Cauchy products. The last `followed` of the values and of the rows belong to the nodes whose series
    the caller asked for.
    """

    size: int
    zeroth_order: StraightLine
    order_recursion: StraightLine
    values: int
    cauchy_products: tuple[tuple[int, int], ...]
    rows: int
    followed: int


def series(program: Recurrent, size: int, moving: int, followed: Sequence[int] = ()) -> Series:
    """Derive the recurrences of the first `size` outputs; all inputs after the first `moving` are constant in time.

    For ẏ = f(t, y) with m components, size is m and moving is m + 1 (y and t, in any order); for q̈(q, q̇, t) with n
    coordinates, n and 2n + 1. The nodes `followed` of the program get series too. Raises `Unlowerable` for an operation
    without a known series.
    """
    with np.errstate(all="ignore"):  # a constant may be 1/0, where the mass matrix is singular: that is found later
        outputs = list(program.line.outputs)
        return _Recurrences(program, size, moving, followed).build_lines(outputs, size, list(followed))


class _Recurrences:
    """Two graphs under construction: the program with the derivatives it needs, and the recursion linear in order k."""

    def __init__(self, program: Recurrent, size: int, moving: int, followed: Sequence[int]):
        self.moving = moving
        budget = _LARGEST_SERIES * len(program.line.nodes) + 1000
        self.zeroth_order, self.order_recursion = Graph.from_line(program.line, budget), Graph(budget)
        self.number = self.zeroth_order.number
        # What overflows where it no longer matters has no coefficients there: infinite ones would be no numbers.
        self.hides_growth = self.zeroth_order.hides_growth
        *_, self.k, self.inverse_k = (self.order_recursion.input(i, "float") for i in range(moving + 2))
        self._given: dict[tuple, int] = {}  # what else is read: ("value", node) or ("product", row, row)
        self._rows: dict[tuple[int | _SolutionComponent, bool], int] = {}
        self._coefficients: dict[int, int | _UnknownSeries | None] = {}  # None: constant along the motion
        self.steep: set[int] = set()  # slopes that may be infinite where the function itself is not
        # Of an elimination no coefficient is needed: it is most of a large program.
        linear = program.linear
        self._find_coefficients((linear and linear.read) or list(program.line.outputs[:size]))
        self._find_added_coefficients(len(program.line.nodes))
        self.solution = [] if program.linear is None else self._solution_coefficients(program.linear)
        if program.linear is not None:  # what is followed may depend on it
            self._coefficients = dict(zip(program.linear.z, self.solution, strict=True)) | self._coefficients
        added = len(self.zeroth_order.nodes)
        self._find_coefficients(list(followed))
        self._find_added_coefficients(added)
        done = 0
        while done < len(self._rows):  # a derivative may be a number that nothing else needed
            new, done = list(self._rows)[done:], len(self._rows)
            for of, _ in new:
                if not isinstance(of, _SolutionComponent):
                    self.coefficient(of)

    def _find_added_coefficients(self, first: int) -> None:
        """Find the coefficients of all nodes from id `first` on: derivatives are appended while rules run."""
        while first < len(self.zeroth_order.nodes):
            self.coefficient(first)
            first += 1

    # ---- what the order recursion reads ----

    def value(self, node: int) -> int:
        number = self.zeroth_order.value(node)
        if number is not None:
            return self.order_recursion.number(number)
        if self.hides_growth and self.zeroth_order.grows(node):
            node = self.zeroth_order.finite_part(node)
        return self._input_node("value", node)

    def cauchy_product(self, a: int, b: "int | _SolutionComponent", by_order: bool = False) -> int:
        """The input node of the sum Σ' aⱼ bₖ₋ⱼ, or with `by_order` of Σ' j aⱼ bₖ₋ⱼ."""
        first, second = self._coefficient_row(a, by_order), self._coefficient_row(b, False)
        return self._input_node("product", min(first, second), max(first, second))

    def _coefficient_row(self, node: "int | _SolutionComponent", by_order: bool) -> int:
        return self._rows.setdefault((node, by_order), len(self._rows))

    def _input_node(self, *key) -> int:
        if key not in self._given:
            self._given[key] = self.order_recursion.input(self.moving + 2 + len(self._given), "float")
        return self._given[key]

    # ---- the recurrences ----

    def coefficient(self, i: int) -> "int | _UnknownSeries | None":
        if i not in self._coefficients:
            self._find_coefficients([i])
        return self._coefficients[i]

    def _find_coefficients(self, roots: list[int]) -> None:
        """Find the coefficients of order k of the nodes `roots` and of all nodes they depend on, operands first."""
        missing, stack = set(), list(roots)
        while stack:
            i = stack.pop()
            if i not in missing and i not in self._coefficients:
                missing.add(i)
                stack.extend(self.zeroth_order.nodes[i][1])
        for i in sorted(missing):
            c = self._coefficient(i)
            if self.hides_growth and isinstance(c, int) and self.zeroth_order.grows(i):
                c = choose(self, self.zeroth_order.has_coefficients(i), self.order_recursion.number(0.0), c)
            self._coefficients[i] = c

    def _coefficient(self, i: int) -> "int | _UnknownSeries | None":
        op, operands, attribute = self.zeroth_order.nodes[i]
        if op == "input":
            return self.order_recursion.input(attribute, "float") if attribute < self.moving else None
        if op == "constant" or self.zeroth_order.kinds[i] != "float" or OPERATIONS[op].is_step:
            return None
        of = [self.coefficient(operand) for operand in operands]
        used = of[1:] if op == "select" else of
        if all(c is None for c in used):
            return None
        unknown = [c for c in used if isinstance(c, _UnknownSeries)]
        if unknown:
            return unknown[0]
        if rule := OPERATIONS[op].recurrence:
            return rule(self, i, operands, of)
        return self.apply_slopes(i, operands, of) if OPERATIONS[op].slopes else _UnknownSeries(op)

    def apply_slopes(self, i, operands, of):
        """The coefficient of w = f(u, …) from its partial derivatives: Σ over operands of uₖ g₀ + 1/k Σ' j uⱼ gₖ₋ⱼ."""
        row = OPERATIONS[self.zeroth_order.nodes[i][0]]
        total, apply = None, self.order_recursion.apply
        for u, c, slope in zip(operands, of, row.slopes, strict=True):
            if c is None:
                continue
            g = slope(self.zeroth_order.apply, self.number, i, *operands)
            inner = self.zeroth_order.operand_of("neg", g)
            sign, g = ("sub", inner) if inner is not None else ("add", g)
            if row.steep:
                self.steep.add(g)
                g = finite(self.zeroth_order.apply, self.number, g)
            term = apply("mul", c, self.value(g))
            if self.zeroth_order.value(g) is None:
                term = apply("add", term, apply("mul", self.inverse_k, self.cauchy_product(u, g, by_order=True)))
            if total is not None:
                total = apply(sign, total, term)
            else:
                total = term if sign == "add" else apply("neg", term)
        return total

    # ---- a linear system: the coefficients of its solution, without those of its elimination ----

    def _solution_coefficients(self, system) -> list[int]:
        """The coefficients zₖ of the solution of A z = r: A₀ zₖ = rₖ − Aₖ z₀ − Σ' Aⱼ zₖ₋ⱼ, with the factors of A₀."""
        apply = self.order_recursion.apply
        residual = [self._output_coefficient(node) for node in system.right]
        entries = [(dict.fromkeys([(i, j), (j, i)]), node) for (i, j), node in system.entries.items()]
        for places, node in [*entries, *(([place], node) for place, node in system.others.items())]:
            if self.coefficient(node) is not None:
                c = self._output_coefficient(node)
                for row, column in places:
                    taken = apply("mul", c, self.value(system.z[column]))
                    taken = apply("add", taken, self.cauchy_product(node, _SolutionComponent(column)))
                    residual[row] = apply("sub", residual[row], taken)
        return self._inline_line(system.solve(), system.factors, residual)

    def _inline_line(self, line: StraightLine, factors, right: list[int]) -> list[int]:
        """The outputs of a line copied into the recursion; inputs: `factors` (order zero), `right` (order k)."""
        places: list[tuple[bool, int]] = []  # whether of the zeroth order, and which node

        def recursion_node(place):
            return self.value(place[1]) if place[0] else place[1]

        for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
            of = [places[i] for i in operands]
            if op == "input":
                i = attribute - len(factors)
                places.append((True, factors[attribute]) if i < 0 else (False, right[i]))
            elif op == "constant":
                places.append((True, self.zeroth_order.constant(attribute, kind)))
            elif all(at_start for at_start, _ in of):
                places.append((True, self.zeroth_order.apply(op, *(node for _, node in of), attribute=attribute)))
            elif op == "div":
                inverse = self.zeroth_order.apply("div", self.number(1.0), of[1][1])
                places.append((False, self.order_recursion.apply("mul", recursion_node(of[0]), self.value(inverse))))
            else:
                places.append((False, self.order_recursion.apply(op, *map(recursion_node, of), attribute=attribute)))
        return [recursion_node(places[i]) for i in line.outputs]

    # ---- the end: only what the outputs need ----

    def build_lines(self, outputs: list[int], size: int, followed_nodes: list[int]) -> Series:
        """The two straight lines, with only those Cauchy products, rows and values that the outputs depend on."""
        rates = self.solution[:size] or [self._output_coefficient(i) for i in outputs[:size]]
        followed = [self._output_coefficient(i) for i in followed_nodes]
        rows = list(self._rows)
        needed: set[int] = set()
        while True:
            roots = [*rates, *followed, *(self._row_coefficient(*rows[r]) for r in needed)]
            reached = set(self.order_recursion.find_ancestors(roots))
            wanted = [key for key, node in self._given.items() if node in reached]
            read = {row for kind, *which in wanted if kind == "product" for row in which}
            if read == needed:
                break
            needed = read
        values = [key[1] for key in wanted if key[0] == "value"]
        # Distinct factors first, squares last: a square needs half the work.
        products = sorted((key for key in wanted if key[0] == "product"), key=lambda key: (key[1] == key[2], key[1:]))
        place = {row: k for k, row in enumerate(sorted(needed))}
        # The recursion does not read the values of the nodes that are followed.
        order = [("value", node) for node in values] + [None] * len(followed) + products
        for k, key in enumerate(order):
            if key is not None:
                self.order_recursion.nodes[self._given[key]] = "input", (), self.moving + 2 + k
        kept = [self._row_coefficient(*rows[r]) for r in sorted(needed)] + followed
        values += followed_nodes
        return Series(
            size,
            eliminate_dead_code(*sink_negations(self.zeroth_order, outputs + values)),
            eliminate_dead_code(*sink_negations(self.order_recursion, rates + kept)),
            len(values),
            tuple((place[a], place[b]) for _, a, b in products),
            len(kept),
            len(followed),
        )

    def _output_coefficient(self, node: int) -> int:
        c = self.coefficient(node)
        if isinstance(c, _UnknownSeries):
            raise Unlowerable(f"`{c.op}` has no Taylor series here")
        return self.order_recursion.number(0.0) if c is None else c

    def _row_coefficient(self, node: "int | _SolutionComponent", by_order: bool) -> int:
        c = self.solution[node.i] if isinstance(node, _SolutionComponent) else self._output_coefficient(node)
        return self.order_recursion.apply("mul", self.k, c) if by_order else c


class _SolutionComponent(NamedTuple):
    """Component i of the solution z of the linear system: the key of a coefficient row."""

    i: int


class _UnknownSeries(NamedTuple):
    """Mark of a node without a Taylor series: the operation `op` has none."""

    op: str
