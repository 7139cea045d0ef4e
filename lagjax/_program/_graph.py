"""The graph of a scalar program: one node per distinct scalar, simplified as it is asked for.

A node is a triple `(op, operands, attribute)`; its id is its position in `Graph.nodes`, so operands always come first.
`op` is the name of a JAX primitive, or "input" (attribute: position), "constant" (attribute: Python number), "convert"
(attribute: kind), "select" (operands: predicate, value if false, value if true). Equal triples share one id.

Every node has a *kind*: "float" (whatever precision the inputs will have), "bool", or the name of an integer type.
Constants are folded in float64.

What may change in the last digits: constants multiply out (`2*(3*x)` is `6*x`); products of the same factors are one
product, and sums of the same terms one sum, in whatever order they were written; like terms are collected where that
shortens a sum (`x + x` is `2*x`, `x - x` is 0); `sin(x)**2 + cos(x)**2` is 1; half-integer powers become roots. Nothing
is multiplied out (but `_passes.regroup` draws out common factors), and a quotient stays one unless its divisor is a
power of two.

A zero found here is *structural*: `0*x` is 0 whatever `x` will be, so an infinity or NaN it would have met is not seen;
whoever runs the program checks what comes out of it.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


class Unlowerable(Exception):
    """A function has no scalar program; the message is a sentence that says why."""


def _round(x, method):
    if method == 1:  # RoundingMethod.TO_NEAREST_EVEN
        return np.round(x)
    whole = np.trunc(x)
    return whole + np.copysign(abs(x - whole) >= 0.5, x)


def _divide(x, y):
    if np.issubdtype(x.dtype, np.floating):
        return np.divide(x, y)
    return np.where(y == 0, -1, np.trunc(np.divide(x, np.where(y == 0, 1, y))))[()].astype(x.dtype)


_erf, _erfc = (np.vectorize(function, otypes=[float]) for function in (math.erf, math.erfc))


# What each operation means on constants. The keys are also the list of elementwise operations a program may contain.
FOLD = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": _divide, "rem": np.fmod, "pow": np.power,
    "max": np.maximum, "min": np.minimum, "atan2": np.arctan2, "neg": np.negative, "abs": np.abs, "sign": np.sign,
    "sqrt": np.sqrt, "rsqrt": lambda x: 1 / np.sqrt(x), "cbrt": np.cbrt, "exp": np.exp, "exp2": np.exp2,
    "expm1": np.expm1, "log": np.log, "log1p": np.log1p, "logistic": lambda x: 1 / (1 + np.exp(-x)), "erf": _erf,
    "erfc": _erfc, "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "asinh": np.arcsinh, "acosh": np.arccosh,
    "atanh": np.arctanh, "floor": np.floor, "ceil": np.ceil, "round": _round, "is_finite": np.isfinite,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert,
    "select": lambda predicate, no, yes: np.where(predicate, yes, no)[()], "convert": lambda x, kind: x,
}  # fmt: skip
COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge"}
COMMUTATIVE = {"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"}
ODD = {"sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "erf", "cbrt", "sign"}
EVEN = {"cos", "cosh", "abs"}

LONGEST = 16  # terms of a sum, or factors of a product, that are compared with others

Node = tuple[str, tuple[int, ...], Any]


class Graph:
    """Scalars under construction. `apply` is the one door: it folds, simplifies and shares before it adds a node."""

    def __init__(self, budget: int):
        self.nodes: list[Node] = []
        self.kinds: list[str] = []
        self.budget = budget
        self._operations = 0
        self._ids: dict = {}
        self._factors: dict[int, tuple[int, ...]] = {}
        self._terms: dict[int, dict[int, float]] = {}
        self._products: dict[tuple[int, ...], int] = {}
        self._sums: dict[frozenset, int] = {}

    def apply(self, op: str, *operands: int, attribute=None) -> int:
        """The scalar `op(*operands)`, as simple as the rules below make it."""
        if all(self.nodes[i][0] == "constant" for i in operands):
            return self._fold(op, operands, attribute)
        if rule := SIMPLIFY.get(op):
            return rule(self, op, *operands) if attribute is None else rule(self, op, *operands, attribute)
        return self.node(op, *operands, attribute=attribute)

    def node(self, op: str, *operands: int, attribute: Any = None) -> int:
        """The node with exactly these operands: an old one if there is one."""
        if op in COMMUTATIVE and operands[0] > operands[1]:
            operands = operands[::-1]
        key = (op, operands, attribute)
        if (found := self._ids.get(key)) is not None:
            return found
        self._operations += 1
        if self._operations > self.budget:
            raise Unlowerable(f"the function takes more than the {self.budget} scalar operations allowed by `budget`")
        if op in COMPARISONS or op == "is_finite":
            kind = "bool"
        else:
            kind = attribute if op == "convert" else self.kinds[operands[-1]]
        return self._append(key, key, kind)

    def input(self, index: int, kind: str) -> int:
        node = ("input", (), index)
        return self._append(node, node, kind)

    def constant(self, value, kind: str) -> int:
        value = np.dtype(kind).type(value).item()
        if value != value:
            value = math.nan  # one object, so that the key below equals itself
        key = (kind, value, math.copysign(1.0, value))  # 0.0 and -0.0 are equal but not the same
        if (found := self._ids.get(key)) is not None:
            return found
        return self._append(key, ("constant", (), value), kind)

    def find(self, op: str, *operands: int) -> int | None:
        """The id of this node if it exists already."""
        return self._ids.get((op, operands, None))

    def value(self, i: int):
        """The number a constant node stands for, or None."""
        op, _, attribute = self.nodes[i]
        return attribute if op == "constant" else None

    def operand_of(self, op: str, i: int) -> int | None:
        """`x` if node `i` is `op(x)`, else None."""
        return self.nodes[i][1][0] if self.nodes[i][0] == op else None

    def _append(self, key, node: Node, kind: str) -> int:
        self.nodes.append(node)
        self.kinds.append(kind)
        self._ids[key] = len(self.nodes) - 1
        return self._ids[key]

    def _fold(self, op: str, operands: tuple[int, ...], attribute: Any) -> int:
        kind = attribute if op == "convert" else self.kinds[operands[-1]]
        if op in COMPARISONS or op == "is_finite":
            kind = "bool"
        values = [np.dtype(self.kinds[i]).type(self.nodes[i][2]) for i in operands]
        extra = () if attribute is None else (attribute,)
        return self.constant(FOLD[op](*values, *extra), kind)

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
        """`coefficient * base`; the sign is kept outside, where a sum or product can absorb it."""
        if coefficient == 0:
            return self.constant(0, self.kinds[base])
        if coefficient < 0:
            return negate(self, "neg", self.scale(-coefficient, base))
        if coefficient == 1:
            return base
        if self.value(base) is not None:
            return self._fold("mul", (self.constant(coefficient, "float"), base), None)
        return self.node("mul", self.constant(coefficient, "float"), base)

    # Products and sums are known by what they consist of, whatever order they were written in.

    def product(self, a: int, b: int) -> int:
        """`a * b`, or an earlier product of the same factors."""
        factors = tuple(sorted(self._factors.get(a, (a,)) + self._factors.get(b, (b,))))
        if len(factors) > LONGEST:
            return self.node("mul", a, b)
        if (found := self._products.get(factors)) is None:
            found = self._products[factors] = self.node("mul", a, b)
            self._factors[found] = factors
        return found

    def terms(self, i: int) -> dict[int, float]:
        """A sum as {base: coefficient}; a number is a multiple of 1."""
        if (value := self.value(i)) is not None:
            return {self.constant(1, "float"): value}
        coefficient, base = self.term(i)
        if abs(coefficient) == 1 and base in self._terms:
            return {x: coefficient * c for x, c in self._terms[base].items()}
        return {base: coefficient}

    def sum(self, a: int, b: int, sign: int) -> int:
        """`a + sign*b` with like terms collected, or an earlier sum of the same terms."""
        left, right = self.terms(a), self.terms(b)
        terms = dict(left)
        for base, coefficient in right.items():
            terms[base] = terms.get(base, 0.0) + sign * coefficient
        self._pythagoras(terms)
        terms = {base: coefficient for base, coefficient in terms.items() if coefficient != 0}
        if not terms:
            return self.constant(0, "float")
        if len(terms) > LONGEST:
            return self._signed_sum(a, b, sign)
        if 2 * len(terms) <= len(left) + len(right):  # worth writing anew, though the old sums may live on elsewhere
            return self._written_out(terms)
        return self._known_sum(terms, a, b, sign)

    def _written_out(self, terms: dict[int, float]) -> int:
        """The terms added one by one, positive ones first."""
        (base, coefficient), *rest = sorted(terms.items(), key=lambda term: term[1] < 0)
        total, done = self.scale(coefficient, base), {base: coefficient}
        for base, coefficient in rest:
            done = {**done, base: coefficient}
            total = self._known_sum(done, total, self.scale(coefficient, base), 1)
        return total

    def _known_sum(self, terms: dict[int, float], a: int, b: int, sign: int) -> int:
        """`a + sign*b`, which is the sum of `terms`: an earlier node, or its negative, if there is one."""
        if (found := self._sums.get(frozenset(terms.items()))) is not None:
            return found
        if (found := self._sums.get(frozenset((x, -c) for x, c in terms.items()))) is not None:
            return negate(self, "neg", found)
        coefficient, base = self.term(self._signed_sum(a, b, sign))
        self._terms[base] = {x: coefficient * c for x, c in terms.items()}
        self._sums[frozenset(self._terms[base].items())] = base
        return self.scale(coefficient, base)

    def _signed_sum(self, a: int, b: int, sign: int) -> int:
        """The node `a + sign*b`, with signs drawn out of the operands."""
        for_a, for_b = self.operand_of("neg", a), self.operand_of("neg", b)
        if for_b is not None:
            b, sign = for_b, -sign
        if for_a is None:
            return self.node("add" if sign > 0 else "sub", a, b)
        if sign > 0:
            return self.node("sub", b, for_a)
        return negate(self, "neg", self.node("add", for_a, b))

    def _pythagoras(self, terms: dict[int, float]) -> None:
        """In place, `c*sin(x)**2*y + c*cos(x)**2*y` becomes `c*y`."""
        for base in list(terms):
            for sine, rest in self._squared_sines(base):
                cosine = self.find("cos", *self.nodes[sine][1])
                partner = None if cosine is None else self._products.get(tuple(sorted([*rest, cosine, cosine])))
                if base in terms and partner in terms and terms[partner] == terms[base]:
                    coefficient = terms.pop(base)
                    del terms[partner]
                    left = functools.reduce(lambda x, y: _mul(self, "mul", x, y), rest, self.constant(1, "float"))
                    terms[left] = terms.get(left, 0.0) + coefficient

    def _squared_sines(self, product: int) -> Iterator[tuple[int, tuple[int, ...]]]:
        """Every sine that a product holds twice, with the other factors."""
        factors = self._factors.get(product, ())
        for k, (i, j) in enumerate(itertools.pairwise(factors)):
            if i == j and self.nodes[i][0] == "sin":
                yield i, factors[:k] + factors[k + 2 :]


# ---- simplification: one function per operation, called when not every operand is constant --------------------------

SIMPLIFY: dict[str, Callable] = {}


def _simplifies(*ops):
    def register(rule):
        SIMPLIFY.update(dict.fromkeys(ops, rule))
        return rule

    return register


@_simplifies("add")
def _add(graph, op, a, b):
    if graph.value(a) == 0:
        return b
    if graph.value(b) == 0:
        return a
    return graph.sum(a, b, 1) if graph.kinds[a] == "float" else graph.node("add", a, b)


@_simplifies("sub")
def _sub(graph, op, a, b):
    if graph.value(b) == 0:
        return a
    if graph.value(a) == 0:
        return negate(graph, "neg", b)
    return graph.sum(a, b, -1) if graph.kinds[a] == "float" else graph.node("sub", a, b)


@_simplifies("neg")
def negate(graph, op, a):
    if (value := graph.value(a)) is not None:
        return graph.constant(np.negative(np.dtype(graph.kinds[a]).type(value)), graph.kinds[a])
    positive = graph.operand_of("neg", a)
    return graph.node("neg", a) if positive is None else positive


@_simplifies("mul")
def _mul(graph, op, a, b):
    if graph.value(a) == 0 or graph.value(b) == 0:
        return graph.constant(0, graph.kinds[a])
    if graph.kinds[a] != "float":
        return b if graph.value(a) == 1 else a if graph.value(b) == 1 else graph.node("mul", a, b)
    for constant, other in ((a, b), (b, a)):
        if (value := graph.value(constant)) is not None and value == value:
            coefficient, base = graph.term(other)
            return graph.scale(value * coefficient, base)
    (m, x), (n, y) = graph.term(a), graph.term(b)
    if abs(m) != 1 and abs(n) != 1:  # two constant factors become one; a single one stays where it can be shared
        return graph.scale(m * n, graph.product(x, y))
    if m < 0 or n < 0:
        return graph.scale(math.copysign(1, m * n), _mul(graph, op, graph.scale(abs(m), x), graph.scale(abs(n), y)))
    return graph.product(a, b)


@_simplifies("div")
def _div(graph, op, a, b):
    if graph.value(a) == 0:
        return a
    divisor = graph.value(b)
    if graph.kinds[a] != "float":
        return a if divisor == 1 else graph.node("div", a, b)
    if divisor and abs(math.frexp(divisor)[0]) == 0.5:  # a power of two: multiplying by its inverse is exact
        return _mul(graph, "mul", a, graph.constant(1 / divisor, "float"))
    if (positive := graph.operand_of("neg", a)) is not None:
        return negate(graph, "neg", _div(graph, op, positive, b))
    if (positive := graph.operand_of("neg", b)) is not None:
        return negate(graph, "neg", _div(graph, op, a, positive))
    return graph.node("div", a, b)


@_simplifies("pow")
def _pow(graph, op, a, b):
    exponent = graph.value(b)
    if exponent is None or abs(exponent) > 16 or (2 * exponent) % 1:
        return graph.node("pow", a, b)
    result = power(graph, a, int(abs(exponent)))
    if exponent % 1:
        result = graph.apply("mul", result, graph.apply("sqrt", a))
    return result if exponent >= 0 else graph.apply("div", graph.constant(1, "float"), result)


def power(graph, a: int, exponent: int) -> int:
    """`a**exponent` for `exponent >= 0`, by repeated squaring: the squares are shared with other powers of `a`."""
    result = graph.constant(1, graph.kinds[a])
    while exponent:
        if exponent & 1:
            result = graph.apply("mul", result, a)
        exponent >>= 1
        if exponent:
            a = graph.apply("mul", a, a)
    return result


@_simplifies(*ODD)
def _odd(graph, op, a):
    positive = graph.operand_of("neg", a)
    return graph.node(op, a) if positive is None else negate(graph, "neg", graph.node(op, positive))


@_simplifies(*EVEN)
def _even(graph, op, a):
    positive = graph.operand_of("neg", a)
    return graph.node(op, a if positive is None else positive)


@_simplifies("max", "min")
def _extremum(graph, op, a, b):
    return a if a == b else graph.node(op, a, b)


@_simplifies("and", "or")
def _logical(graph, op, a, b):
    if a == b:
        return a
    for x, y in ((a, b), (b, a)):
        if graph.kinds[x] == "bool" and (value := graph.value(x)) is not None:
            return x if value == (op == "or") else y
    return graph.node(op, a, b)


@_simplifies("not")
def _not(graph, op, a):
    original = graph.operand_of("not", a)
    return graph.node("not", a) if original is None else original


@_simplifies("select")
def _select(graph, op, predicate, no, yes):
    known = graph.value(predicate)
    if known is not None or no == yes:
        return yes if known else no
    if (original := graph.operand_of("not", predicate)) is not None:
        return _select(graph, op, original, yes, no)
    if graph.kinds[no] == "bool" and (graph.value(no), graph.value(yes)) == (False, True):
        return predicate
    if graph.kinds[no] == "bool" and (graph.value(no), graph.value(yes)) == (True, False):
        return _not(graph, "not", predicate)
    return graph.node("select", predicate, no, yes)


@_simplifies("convert")
def _convert(graph, op, a, kind):
    return a if graph.kinds[a] == kind else graph.node("convert", a, attribute=kind)


@_simplifies(*COMPARISONS)
def _compare(graph, op, a, b):
    """`int(p) > 0` is `p`: the predicates of `lax.cond` and `lax.switch` are written like this."""
    for i, other in ((a, b), (b, a)):
        flag = graph.operand_of("convert", i)
        if flag is not None and graph.kinds[flag] == "bool" and graph.value(other) is not None:
            cases = [graph.constant(value, graph.kinds[i]) for value in (0, 1)]
            return _select(graph, "select", flag, *(graph.apply(op, *((c, b) if i == a else (a, c))) for c in cases))
    return graph.node(op, a, b)
