"""The graph of a scalar program: one node per distinct scalar, simplified as it is added.

A node is a triple `(op, operands, attribute)`; its id is its index in `Graph.nodes`, and operands precede their users.
`op` is the name of an operation (`_operations.OPERATIONS`; those of `select` are predicate, value if false, value if
true), or "input" (attribute: position) or "constant" (attribute: Python number). Equal triples share one id.

Every node has a *kind*: "float" (whatever precision the inputs will have), "bool", or the name of an integer type.
Constants are folded in float64.

Simplification may change the last digits of a result: constants multiply (`2*(3*x)` is `6*x`), and add where no large
ones cancel; products of the same factors are one node, and sums of the same terms, in whatever order they were written;
like terms are collected where that shortens a sum (`x + x` is `2*x`, `x - x` is 0); `sin(x)**2 + cos(x)**2` is 1;
half-integer powers become roots. Products of sums are not expanded (`_passes.factor` draws out common factors), and a
quotient stays one unless the divisor is a power of two.

A zero found here is *structural*: `0*x` is 0 whatever `x` will be, even an infinity or NaN; the caller that runs the
program checks its results.
"""

import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._look_ups import look_up, table_of
from lagjax._program._operations import BOUNDED, GROWING, LOOK_UPS, OPERATIONS, is_function
from lagjax._program._simplify import whole_power


class Unlowerable(Exception):
    """Error: a function cannot be written as a scalar program; the message is a sentence that says why."""


LONGEST_SUM = 16  # terms of a sum, or factors of a product, that are compared with others

# Ids from here on are inputs by their positions, and those from `NUMBERS` on numbers of long arrays, as long as nothing
# computes with them: of an array that is only looked up in, no entry becomes a node.
INPUTS, NUMBERS = 2**40, 2**50
# Ids from here on are pairs, each a complex number (`_complex`). No node has one as an operand.
PAIRS = 2**60

Node = tuple[str, tuple[int, ...], Any]

_ONE = ("float", 1.0, 1.0)  # the key of the constant 1


def find_ancestors(nodes: Sequence[Node], outputs: Iterable[int], powers: Mapping[int, tuple] = {}) -> list[int]:
    """The ids of `outputs` and all nodes they depend on, ascending; of a node in `powers`, that is the base alone."""
    outputs, order = list(outputs), []
    marks = bytearray(1 + max(outputs, default=0))
    for i in outputs:
        marks[i] = 1
    i = marks.rfind(1)
    while i >= 0:
        order.append(i)
        for x in nodes[i][1] if i not in powers else powers[i][:1]:
            marks[x] = 1
        i = marks.rfind(1, 0, i)
    order.reverse()
    return order


def find_readers(nodes: Sequence[Node]) -> list[list[int]]:
    """For each node, the ids of the nodes that have it as an operand."""
    readers: list[list[int]] = [[] for _ in nodes]
    for i, (_, operands, _) in enumerate(nodes):
        for x in operands:
            readers[x].append(i)
    return readers


def find_descendants(readers: Sequence[Sequence[int]], starts: Iterable[int]) -> list[int]:
    """The ids, ascending, of all nodes that depend on `starts`, without these; `readers` is from `find_readers`."""
    found: set[int] = set()
    left = list(starts)
    while left:
        new = [i for i in readers[left.pop()] if i not in found]
        found.update(new)
        left += new
    return sorted(found)


class _NodeIndex(NamedTuple):
    """Tables to find a product of a graph by its factors and a sum by its terms."""

    factors: dict[int, tuple[int, ...]]  # of each product
    terms: dict[int, dict[int, float]]  # of each sum, with their coefficients
    products: dict[tuple[int, ...], int]
    sums: dict[frozenset, tuple[int, float]]  # and whether it is that sum or its negative
    with_squares: set[int]  # the products that hold a sine twice


class Graph:
    """A scalar program under construction; `apply` simplifies and shares before it adds a node.

    `budget` is the largest number of operations; one more raises `Unlowerable`. The first `moving` inputs vary along a
    motion and derivatives are taken by them, so that `take` never reads them as entries of a table, which has no slope.
    """

    def __init__(self, budget: int, moving: int = 0):
        self.moving = moving
        self.nodes: list[Node] = []
        self.kinds: list[str] = []
        self.budget = budget
        self._operations = 0
        self._ids: dict = {}
        self._collected = _NodeIndex({}, {}, {}, {}, set())
        self.powers: dict[int, tuple[int, float]] = {}  # what is a power of another node, and which
        self._arrays: dict[bytes, int] = {}  # long arrays of numbers, and where their ids begin
        self.floats: dict[int, int] = {}  # integers that are indices, as floats
        self._growing: list[bool] = []
        self._hides_growth = False

    @classmethod
    def from_line(cls, line, budget: int) -> "Graph":
        """The graph with the nodes of a straight line, each with its index in the line as id."""
        graph = cls(budget)
        graph.nodes, graph.kinds = list(line.nodes), list(line.kinds)
        for i, (node, kind) in enumerate(zip(graph.nodes, graph.kinds, strict=True)):
            op, _, value = node
            graph._ids[(kind, value, math.copysign(1.0, value)) if op == "constant" else node] = i
        graph._operations = len(graph.nodes)
        graph._require_room()
        return graph

    def find_ancestors(self, outputs: Iterable[int], as_derived: bool = False) -> list[int]:
        """The ids of `outputs` and all nodes they depend on, ascending; `as_derived`: of a power, the base alone."""
        return find_ancestors(self.nodes, outputs, self.powers if as_derived else {})

    # ---- what overflows where it no longer matters, as cosh u in 1/cosh u ----

    def grows(self, i: int) -> bool:
        """True if node i may overflow although the inputs are moderate: exponentials and what is computed from them."""
        growing = self._growing
        for op, operands, _ in self.nodes[len(growing) : i + 1]:
            by_operand = any(growing[j] for j in operands)
            self._hides_growth |= by_operand and (growing[operands[-1]] if op == "div" else is_function(op))
            growing.append(op in GROWING or (by_operand and op not in BOUNDED and self.kinds[len(growing)] == "float"))
        return growing[i]

    @property
    def hides_growth(self) -> bool:
        """True if the graph divides by a node that `grows`, or applies a function to one: an overflow may not show."""
        self.grows(len(self.nodes) - 1)
        return self._hides_growth

    def is_huge(self, v: int) -> int:
        """The node of a flag: v is so large, (1/v)² = 0, that its Taylor coefficients may be infinite."""
        first = len(self.nodes)
        return self._mark_bounded(first, self._is_zero(self.apply("div", self.constant(1.0, "float"), v)))

    def has_coefficients(self, v: int) -> int:
        """The node of a flag: v is neither huge (`is_huge`) nor NaN, so that its Taylor coefficients are finite."""
        first, zero = len(self.nodes), self.constant(0.0, "float")
        inverse = self.apply("div", self.constant(1.0, "float"), v)
        return self._mark_bounded(first, self.apply("prefers", self.apply("mul", inverse, inverse), zero))

    def finite_part(self, v: int) -> int:
        has_any, first = self.has_coefficients(v), len(self.nodes)
        return self._mark_bounded(first, self.apply("select", has_any, self.constant(0.0, "float"), v))

    def is_flat_quotient(self, w: int, v: int) -> int:
        """The node of a flag: w = u/v is zero because v is huge, so that its derivatives are zero."""
        return self.apply("and", self.is_huge(v), self._is_zero(w))

    def is_flat_far_out(self, slope: int, u: int) -> int:
        """The node of a flag: u is huge and slope · u is zero, so that the function is constant there.

        It is false at u = 0, where the product is zero too, and where the product is 0 · ∞ = NaN.
        """
        change = self.apply("mul", slope, u)
        changes = self.apply("prefers", self.apply("mul", change, change), self.constant(0.0, "float"))
        return self.apply("and", self.is_huge(u), self.apply("not", changes))

    def _is_zero(self, x: int) -> int:
        return self.apply("eq", self.apply("mul", x, x), self.constant(0.0, "float"))

    def _mark_bounded(self, first: int, result: int) -> int:
        """Return `result`, and mark the nodes from id `first` on as not growing."""
        self.grows(first - 1)
        self._growing += [False] * (len(self.nodes) - first)
        return result

    # ---- operations ----

    def branch(self, predicate: int) -> AbstractContextManager:
        """A context for the operations of a branch of `lax.cond` with this predicate, which `Tape` records."""
        return nullcontext()

    def apply(self, op: str, *operands: int, attribute=None) -> int:
        """The node of `op(*operands)` after simplification: a constant, an existing node or a new one."""
        for i in operands:
            if self.nodes[i][0] != "constant":
                break
        else:
            return self._fold_constants(op, operands, attribute)
        if rule := OPERATIONS[op].simplify:
            return rule(self, op, *operands) if attribute is None else rule(self, op, *operands, attribute)
        return self.node(op, *operands, attribute=attribute)

    def _require_room(self) -> None:
        if self._operations > self.budget:
            raise Unlowerable(f"the function takes more than the {self.budget} scalar operations allowed by `budget`")

    def power(self, a: int, exponent: int) -> int:
        """The node of `a**exponent` for a whole exponent of any sign."""
        return whole_power(self, a, exponent)

    def node(self, op: str, *operands: int, attribute: Any = None) -> int:
        """The node with exactly these operands, without simplification: the existing one if there is one."""
        if OPERATIONS[op].commutative and operands[0] > operands[1]:
            operands = operands[::-1]
        key = (op, operands, attribute)
        if (node := self._ids.get(key)) is not None:
            return node
        self._operations += 1
        self._require_room()
        return self._append_node(key, key, self._result_kind(op, operands, attribute))

    def input(self, index: int, kind: str) -> int:
        node = ("input", (), index)
        known = self._ids.get(node)
        return self._append_node(node, node, kind) if known is None else known

    def real(self, i: int) -> int:
        """The node of an id that may be virtual: an input (from `INPUTS` on) or an array entry (from `NUMBERS` on)."""
        if i < INPUTS:
            return i
        if i < NUMBERS:
            return self.input(i - INPUTS, "float")
        if i >= PAIRS:
            raise Unlowerable("a complex number is there where a real one is needed")
        numbers, first = self.array_of(i)
        return self.constant(float(np.frombuffer(numbers)[i - first]), "float")

    def position(self, i: int) -> int | None:
        """The position of the input that an id stands for; None for any other node."""
        if i >= NUMBERS:
            return None
        if i >= INPUTS:
            return i - INPUTS
        op, _, attribute = self.nodes[i]
        return attribute if op == "input" else None

    def array(self, numbers: np.ndarray) -> np.ndarray:
        """Ids, in the shape of `numbers`, of the entries of a long array of float64; no nodes are made for them."""
        data = np.ascontiguousarray(numbers, np.float64).tobytes()
        first = self._arrays.setdefault(data, NUMBERS + sum(map(len, self._arrays)) // 8)
        return np.arange(first, first + numbers.size).reshape(numbers.shape)

    def array_of(self, i: int) -> tuple[bytes, int]:
        """The bytes of the long array to which id i belongs, and the id of its first entry."""
        return next(array for array in reversed(self._arrays.items()) if array[1] <= i)

    def constant(self, value, kind: str) -> int:
        value = float(value) if kind == "float" else np.dtype(kind).type(value).item()
        if value != value:
            value = math.nan  # one object, so that the key below equals itself
        key = (kind, value, math.copysign(1.0, value))  # 0.0 and -0.0 are equal but not the same
        if (node := self._ids.get(key)) is not None:
            return node
        return self._append_node(key, ("constant", (), value), kind)

    def number(self, x: float) -> int:
        return self.constant(x, "float")

    def value(self, i: int):
        op, _, attribute = self.nodes[i]
        return attribute if op == "constant" else None

    def operand_of(self, op: str, i: int) -> int | None:
        """The operand x if node i is `op(x)`, else None."""
        return self.nodes[i][1][0] if self.nodes[i][0] == op else None

    def _append_node(self, key, node: Node, kind: str) -> int:
        self.nodes.append(node)
        self.kinds.append(kind)
        self._ids[key] = len(self.nodes) - 1
        return self._ids[key]

    def _fold_constants(self, op: str, operands: tuple[int, ...], attribute: Any) -> int:
        if op in LOOK_UPS:
            return self._fold_look_up(op, operands[0], attribute)
        values = [np.dtype(self.kinds[i]).type(self.nodes[i][2]) for i in operands]
        extra = () if attribute is None else (attribute,)
        return self.constant(OPERATIONS[op].value(*values, *extra), self._result_kind(op, operands, attribute))

    def _fold_look_up(self, op: str, x: int, attribute: Any) -> int:
        """A look-up with a constant index: the entry as a constant or an input; `locate` by inputs stays a node."""
        value, table = self.nodes[x][2], table_of(attribute)
        if table.numbers is not None:
            return self.constant(float(look_up(op, attribute, (), value)), "float")
        if op == "locate" or table.tangents:
            return self.node(op, x, attribute=attribute)
        return self.input(table.positions[int(min(max(value, 0), table.count - 1))], "float")

    def _result_kind(self, op: str, operands: tuple[int, ...], attribute: Any) -> str:
        if OPERATIONS[op].is_logical:
            return "bool"
        return attribute if op == "convert" else self.kinds[operands[-1]]

    # A float node seen as `coefficient * base`: what signs and constant factors are collected by.

    def term(self, i: int) -> tuple[float, int]:
        op, operands, _ = self.nodes[i]
        if op == "neg":
            coefficient, base = self.term(operands[0])
            return -coefficient, base
        if op == "mul" and (value := self.value(operands[0])) is not None:
            return value, operands[1]
        if op == "mul" and (value := self.value(operands[1])) is not None:
            return value, operands[0]
        return 1.0, i

    def scale(self, coefficient: float, base: int) -> int:
        """The node of `coefficient * base`; a sign becomes an outer negation, which a sum or product can absorb."""
        if coefficient == 0:
            return self.constant(0, self.kinds[base])
        if coefficient < 0:
            return self.apply("neg", self.scale(-coefficient, base))
        if coefficient == 1:
            return base
        if self.value(base) is not None:
            return self._fold_constants("mul", (self.constant(coefficient, "float"), base), None)
        return self.node("mul", self.constant(coefficient, "float"), base)

    # Products and sums are known by what they consist of, whatever order they were written in.

    def product(self, a: int, b: int) -> int:
        """The node of `a * b`: an existing product with the same factors if there is one."""
        factors = tuple(sorted(self._collected.factors.get(a, (a,)) + self._collected.factors.get(b, (b,))))
        if len(factors) > LONGEST_SUM:
            return self.node("mul", a, b)
        if (product := self._collected.products.get(factors)) is None:
            product = self._collected.products[factors] = self.node("mul", a, b)
            self._collected.factors[product] = factors
            if any(i == j and self.nodes[i][0] == "sin" for i, j in itertools.pairwise(factors)):
                self._collected.with_squares.add(product)
        return product

    def terms(self, i: int) -> dict[int, float]:
        """Node i as a linear combination {base: coefficient}; a constant is a multiple of the node 1."""
        if (value := self.value(i)) is not None:
            return {self.constant(1, "float"): value}
        coefficient, base = self.term(i)
        if abs(coefficient) == 1 and base in self._collected.terms:
            return {x: coefficient * c for x, c in self._collected.terms[base].items()}
        return {base: coefficient}

    def sum(self, a: int, b: int, sign: int) -> int:
        """The node of `a + sign*b` with like terms collected: an existing sum of the same terms if there is one."""
        left, right = self.terms(a), self.terms(b)
        one = self._ids.get(_ONE, -1)
        a_one, b_one = left.get(one, 0.0), sign * right.get(one, 0.0)
        if abs(a_one) > 1e8 and abs(a_one + b_one) < 1e-8 * abs(a_one):  # large constants that nearly cancel
            return self._round_by_adding(a, b, sign)
        terms = dict(left)
        for base, coefficient in right.items():
            terms[base] = terms.get(base, 0.0) + sign * coefficient
        if not self._collected.with_squares.isdisjoint(terms):
            self._pythagoras(terms)
        if 0.0 in terms.values():
            terms = {base: coefficient for base, coefficient in terms.items() if coefficient != 0}
        if not terms:
            return self.constant(0, "float")
        if len(terms) > LONGEST_SUM:
            return self._signed_sum(a, b, sign)
        if 2 * len(terms) <= len(left) + len(right):  # worth writing anew, though the old sums may live on elsewhere
            return self._add_terms(terms)
        return self._find_sum(terms, a, b, sign)

    def _round_by_adding(self, a: int, b: int, sign: int) -> int:
        """The node of `a + sign*b` where large constants cancel: u + 1.5·2ᵏ − 1.5·2ᵏ is u in multiples of 2ᵏ⁻⁵²."""
        one, taken = self.constant(1, "float"), a if self.value(b) is None else b
        terms, large = self.terms(a if taken == b else b), self.value(taken)
        if large is None or abs(terms[one]) != abs(large) or abs(math.frexp(large)[0]) != 0.75:
            return self._signed_sum(a, b, sign)
        unit = math.ulp(large)
        others = self._add_terms({base: coefficient for base, coefficient in terms.items() if base != one})
        whole = self.apply("round", self.scale(1 / unit, others), attribute=1)
        return self.scale(unit if taken == b else sign * unit, whole)

    def _add_terms(self, terms: dict[int, float]) -> int:
        (base, coefficient), *rest = sorted(terms.items(), key=lambda term: term[1] < 0)
        total, done = self.scale(coefficient, base), {base: coefficient}
        for base, coefficient in rest:
            done = {**done, base: coefficient}
            total = self._find_sum(done, total, self.scale(coefficient, base), 1)
        return total

    def _find_sum(self, terms: dict[int, float], a: int, b: int, sign: int) -> int:
        """The node of `a + sign*b`, with collected `terms`: an existing sum, its negative, or a new one."""
        first = -1.0 if terms[min(terms)] < 0 else 1.0  # a sum and its negative are known by one key
        key = frozenset(terms.items() if first > 0 else [(x, -c) for x, c in terms.items()])
        if (known := self._collected.sums.get(key)) is not None:
            return known[0] if known[1] == first else self.apply("neg", known[0])
        coefficient, base = self.term(self._signed_sum(a, b, sign))
        self._collected.terms[base] = terms if coefficient > 0 else {x: -c for x, c in terms.items()}
        self._collected.sums[key] = base, first * coefficient
        return self.scale(coefficient, base)

    def _signed_sum(self, a: int, b: int, sign: int) -> int:
        """The node of `a + sign*b`, with negations of a and b absorbed into the sign."""
        for_a, for_b = self.operand_of("neg", a), self.operand_of("neg", b)
        if for_b is not None:
            b, sign = for_b, -sign
        if for_a is None:
            return self.node("add" if sign > 0 else "sub", a, b)
        if sign > 0:
            return self.node("sub", b, for_a)
        return self.apply("neg", self.node("add", for_a, b))

    def _pythagoras(self, terms: dict[int, float]) -> None:
        """Replace `c*sin(x)**2*y + c*cos(x)**2*y` by `c*y` in a dict of terms, in place."""
        for base in list(terms):
            factors = self._collected.factors.get(base, ())
            for k, (sine, other) in enumerate(itertools.pairwise(factors)):
                if sine != other or self.nodes[sine][0] != "sin":
                    continue
                rest = factors[:k] + factors[k + 2 :]
                cosine = self._ids.get(("cos", self.nodes[sine][1], None))
                partner = (
                    None if cosine is None else self._collected.products.get(tuple(sorted([*rest, cosine, cosine])))
                )
                if base in terms and partner in terms and terms[partner] == terms[base]:
                    coefficient = terms.pop(base)
                    del terms[partner]
                    left = functools.reduce(lambda x, y: self.apply("mul", x, y), rest, self.constant(1, "float"))
                    terms[left] = terms.get(left, 0.0) + coefficient


class Tape(Graph):
    """A scalar program recorded operation by operation, without simplification or sharing, for reverse mode.

    In a graph that shares equal scalars, the cotangents of all uses of one scalar are added up. That separates terms
    that cancel: in ∂L/∂q − (∂p/∂q) q̇ the kinetic part of one use of cos q cancels, and its potential part does not.

    `branches` maps a node from a branch of a `cond` to its predicate: where that is false, the cotangent is zero.
    """

    def __init__(self, budget: int, moving: int = 0):
        super().__init__(budget, moving)
        self.branches: dict[int, int] = {}
        self._taken: int | None = None

    @contextmanager
    def branch(self, predicate: int) -> Iterator[None]:
        outer = self._taken
        self._taken = predicate if outer is None else self.apply("and", outer, predicate)
        yield
        self._taken = outer

    def apply(self, op: str, *operands: int, attribute=None) -> int:
        if all(self.nodes[i][0] == "constant" for i in operands):
            return self._fold_constants(op, operands, attribute)
        return self._append_operation(op, operands, attribute, self._result_kind(op, operands, attribute))

    def power(self, a: int, exponent: int) -> int:
        """The node of `a**exponent`, recorded as one operation."""
        if self.value(a) is not None or self.kinds[a] != "float":
            return super().power(a, exponent)
        return self._append_operation("integer_pow", (a,), exponent, "float")

    def _append_operation(self, op: str, operands: tuple[int, ...], attribute: Any, kind: str) -> int:
        if self._taken is not None:
            self.branches[len(self.nodes)] = self._taken
        self.nodes.append((op, operands, attribute))
        self.kinds.append(kind)
        return len(self.nodes) - 1
