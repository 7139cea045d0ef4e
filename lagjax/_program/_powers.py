"""The powers in a program, and which of them no series of a motion shows from afar.

Every number is a product Π bᵉ of bases: of sums, inputs and functions, which are no products themselves. However it
was written, (1 + x²)⁻⁶ has the base 1 + x², and its exponent −6. Where |b| falls, or rises, it changes by e log |b|,
as an exponential does by its argument: where that is near nothing before, no coefficient tells.

Left out is what cannot change so much: a base between two bounds. And so is a force that falls like the inverse square
of a distance, x / (x² + y²)^1.5: it is seen from as far away as the tolerance resolves a place as small as where it is
strong. A base of fewer squares comes near zero along a whole surface, which one meets without having aimed at it.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from lagjax._program._operations import OPERATIONS
from lagjax._program._series import StraightLine

# Exponents from here on are those of powers with all coefficients zero at a base of zero, to the least order (7).
LEAST_POWER = 8
# A power that changes by less than e to this, along all of its base, is seen: half of the least degree, 6.
_SEEN = 3.0
# By what power of the distance a force may fall that is seen as long as the tolerance resolves where it acts. Measured
# on flights from 1e2 to 1e9 lengths with impact parameters of 0.01 to 2: none is missed at rtol = 1e-9 and 1e-12, and
# at 1e-5 those from 1e6 on, whose place rtol leaves open by ten lengths. With 3 in its place, half are from 1e4 on.
_SLOWEST = 2.0
_LONGEST, _DEEPEST = 16, 8  # factors of a product; sums of products that one is looked for in
_ROOTS = {"sqrt": 0.5, "rsqrt": -0.5, "cbrt": 1 / 3}
_PRODUCTS = {"mul", "div", "neg", "abs", *_ROOTS}
_BETWEEN = {"sin": 1.0, "cos": 1.0, "tanh": 1.0, "erf": 1.0, "atan": math.pi / 2, "sign": 1.0}
_ALL = -math.inf, math.inf


class Power(NamedTuple):
    """A base, and the exponent that is largest in size among those of its powers of one sign."""

    base: int
    exponent: float


class _Number(NamedTuple):
    """A number of a program: what it is a product of, without what does not move; and its bounds."""

    factors: dict[int, float]
    low: float = -math.inf
    high: float = math.inf


def find_powers(line: StraightLine, nodes: Iterable[int], guards: set[int], size: int) -> list[Power]:
    """The powers to watch among these nodes of a program of q, q̇, t and parameters; guards depend on some of them."""
    numbers: dict[int, _Number] = {}
    products: dict[int, list[int]] = {i: [] for i in line.outputs}  # and the nodes they are terms, or operands, of
    for i in sorted(nodes):
        numbers[i] = _number(line, i, numbers, size)
        if not _is_product(line, i):
            for x in line.nodes[i][1]:
                products.setdefault(x, []).append(i)
    products = {i: users for i, users in products.items() if i in numbers}
    holders: dict[int, list[int]] = {}
    for i in products:
        for base in numbers[i].factors:
            holders.setdefault(base, []).append(i)
    program = _Products(line, numbers, products, holders)
    found: dict[tuple[int, bool], float] = {}
    for i in products:
        for base, e in numbers[i].factors.items():
            if e >= LEAST_POWER or (e < 0 and program.is_hidden(base, i, i in guards)):
                key = base, e > 0
                found[key] = max(found.get(key, 0.0), abs(e))
    return [Power(base, e if grows else -e) for (base, grows), e in sorted(found.items())]


def _is_product(line: StraightLine, i: int) -> bool:
    """True if a node is a product, or a constant power, of others."""
    op, operands, _ = line.nodes[i]
    return op in _PRODUCTS or (op == "pow" and line.nodes[operands[1]][0] == "constant")


class _Products(NamedTuple):
    """The products in a program that are no part of another one, and what uses them."""

    line: StraightLine
    numbers: dict[int, _Number]
    users: dict[int, list[int]]
    holders: dict[int, list[int]]

    def is_hidden(self, base: int, i: int, of_guard: bool) -> bool:
        """True if a negative power in product i may change by much along a step, without a trace at its beginning."""
        exponent, (_, low, high) = self.numbers[i].factors[base], self.numbers[base]
        least, most = (low, high) if low > 0 else (-high, -low)
        if least > 0 and math.log(most / least) * -exponent < _SEEN:
            return False
        squares = self.squares(base)
        if of_guard or len(squares) < 2 or -2 * exponent > _SLOWEST + 1:
            return True
        return -2 * exponent - self.degree(i, squares) > _SLOWEST

    def squares(self, i: int) -> set[int]:
        """The numbers whose squares a sum consists of, but for what does not move; none of another sum."""
        squares, terms = set(), [i]
        while terms:
            op, operands, _ = self.line.nodes[terms.pop()]
            for x in operands:
                factors = self.numbers[x].factors
                if self.line.nodes[x][0] == "add":
                    terms.append(x)
                elif factors and (op != "add" or list(factors.values()) != [2.0]):
                    return set()
                else:
                    squares.update(factors)
        return squares

    def degree(self, i: int, numbers: set[int], left: int = _DEEPEST) -> float:
        """The degree in some numbers of what product i is multiplied with, itself included, where that is least."""
        own = sum(self.numbers[i].factors.get(x, 0.0) for x in numbers)
        sums = [u for u in self.users[i] if self.line.nodes[u][0] in ("add", "sub")]
        if own or not left or len(sums) < len(self.users[i]) or i in self.line.outputs:
            return own
        holders = [x for u in sums for x in self.holders.get(u, ())]
        return min((self.degree(x, numbers, left - 1) for x in holders), default=0.0)


def _number(line: StraightLine, i: int, numbers: dict[int, _Number], size: int) -> _Number:
    """What is known of a node, from what is known of its operands."""
    op, operands, value = line.nodes[i]
    if op == "constant":
        x = float(value)
        return _Number({}, x, x) if x == x else _Number({})
    if op == "input":
        return _Number({i: 1.0} if value <= 2 * size else {})
    if any(x not in numbers for x in operands):
        return _Number({i: 1.0})
    of = [numbers[x] for x in operands]
    bounds = _bounds(op, operands, of)
    if OPERATIONS[op].is_step or not any(x.factors for x in of):
        return _Number({}, *bounds)
    if not _is_product(line, i):
        return _Number({i: 1.0}, *bounds)
    factors = dict(of[0].factors)
    if op in ("mul", "div"):
        for base, e in of[1].factors.items():
            factors[base] = factors.get(base, 0.0) + (e if op == "mul" else -e)
    else:
        power = line.nodes[operands[1]][2] if op == "pow" else _ROOTS.get(op, 1.0)
        factors = {base: e * power for base, e in factors.items()}
    factors = {base: e for base, e in factors.items() if e}
    return _Number(factors if 0 < len(factors) <= _LONGEST else {i: 1.0}, *bounds)


def _bounds(op: str, operands: tuple[int, ...], of: list[_Number]) -> tuple[float, float]:
    """Bounds of the result of an operation, where sums and products of bounded functions have them."""
    if op in _BETWEEN:
        return -_BETWEEN[op], _BETWEEN[op]
    if op not in ("add", "sub", "mul", "neg"):
        return (0.0, math.inf) if op in ("abs", "exp", "sqrt", "cosh") else _ALL
    (_, a, b), (_, c, d) = of[0], of[-1]
    if op == "neg":
        return -b, -a
    if op != "mul":
        return (a + c, b + d) if op == "add" else (a - d, b - c)
    ends = [x * y if x and y else 0.0 for x in (a, b) for y in (c, d)]
    return (0.0 if operands[0] == operands[1] else min(ends)), max(ends)
