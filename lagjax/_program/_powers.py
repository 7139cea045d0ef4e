"""The powers in a program, and which of them no series of a motion shows from afar.

Every number is a product Π bᵉ of bases: of sums, inputs and functions, which are no products themselves. However it
was written, (1 + x²)⁻⁶ has the base 1 + x², and its exponent −6. Where |b| falls, or rises, it changes by e log |b|,
as an exponential does by its argument: where that is near nothing before, no coefficient tells.

Left out is what cannot change so much (a base between two bounds), and what is seen from any distance: along a straight
flight a number decays like the distance to its degree, x / (x² + y² + z²)^1.5 to that of −2. What decays as slowly as
that is missed only where its whole effect is a tolerance; unless its base comes near zero all along a surface, which
is met without having been aimed at, and not at a point alone, where several squares are.
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
# What decays as slowly as this is seen where its base is zero at points alone.
_SLOW = -2.0
_LONGEST = 16  # factors of a product
_ROOTS = {"sqrt": 0.5, "rsqrt": -0.5, "cbrt": 1 / 3}
_PRODUCTS = {"mul", "div", "neg", "abs", *_ROOTS}
_BETWEEN = {"sin": 1.0, "cos": 1.0, "tanh": 1.0, "erf": 1.0, "atan": math.pi / 2, "sign": 1.0}


class Power(NamedTuple):
    """A base, and the exponent that is largest in size among those of its powers of one sign."""

    base: int
    exponent: float


class _Number(NamedTuple):
    """A number of a program: what it is a product of, its degree along a straight flight, its bounds."""

    factors: dict[int, float]
    degree: float
    low: float
    high: float


def find_powers(line: StraightLine, nodes: Iterable[int], size: int) -> list[Power]:
    """The powers that are to be watched among these nodes of a program of q, q̇, t and parameters."""
    numbers: dict[int, _Number] = {}
    products: set[int] = set(line.outputs)
    for i in sorted(nodes):
        _, operands, _ = line.nodes[i]
        of = [numbers[x] for x in operands if x in numbers]
        numbers[i] = _number(line, i, of, numbers, size) if len(of) == len(operands) else _Number({i: 1.0}, 0.0, *_ALL)
        if not _is_product(line, i):
            products.update(operands)
    found: dict[tuple[int, bool], float] = {}
    for i in products & numbers.keys():
        factors = numbers[i].factors
        degree = sum(e * numbers[b].degree for b, e in factors.items())
        for base, e in factors.items():
            if e >= LEAST_POWER or (e < 0 and _is_hidden(line, base, e, degree, numbers)):
                key = base, e > 0
                found[key] = max(found.get(key, 0.0), abs(e))
    return [Power(base, e if grows else -e) for (base, grows), e in sorted(found.items())]


_ALL = -math.inf, math.inf


def _is_product(line: StraightLine, i: int) -> bool:
    """True if a node is a product, or a constant power, of others."""
    op, operands, _ = line.nodes[i]
    return op in _PRODUCTS or (op == "pow" and line.nodes[operands[1]][0] == "constant")


def _is_hidden(line: StraightLine, base: int, exponent: float, degree: float, numbers: dict[int, _Number]) -> bool:
    """True if a negative power can change by much along a step without a trace at its beginning."""
    _, _, low, high = numbers[base]
    least, most = (low, high) if low > 0 else (-high, -low)
    if least > 0 and math.log(most / least) * -exponent < _SEEN:
        return False
    return degree < _SLOW or _squares(line, base, numbers) < 2


def _squares(line: StraightLine, i: int, numbers: dict[int, _Number]) -> int:
    """The count of the squares of different numbers that a sum consists of, but for a constant; 0 of others."""
    squares, terms = set(), [i]
    while terms:
        op, operands, _ = line.nodes[terms.pop()]
        if op != "add":
            return 0
        for x in operands:
            factors = numbers[x].factors
            if line.nodes[x][0] == "add":
                terms.append(x)
            elif factors and any(e <= 0 or e % 2 for e in factors.values()):
                return 0
            elif factors:
                squares.add(tuple(sorted(factors)))
    return len(squares)


def _number(line: StraightLine, i: int, of: list[_Number], numbers: dict[int, _Number], size: int) -> _Number:
    """What is known of a node, from what is known of its operands."""
    op, operands, value = line.nodes[i]
    if op == "constant":
        x = float(value)
        return _Number({}, 0.0, x, x) if x == x else _Number({}, 0.0, *_ALL)
    if op == "input":
        moves = value <= 2 * size
        return _Number({i: 1.0} if moves else {}, float(moves and not size <= value < 2 * size), *_ALL)
    moves = any(x.factors for x in of) and not OPERATIONS[op].is_step
    low, high = _bounds(op, operands, of)
    if not moves:
        return _Number({}, 0.0, low, high)
    if not _is_product(line, i):
        spreads = op in ("add", "sub", "max", "min", "select")
        return _Number({i: 1.0}, max(x.degree for x in of) if spreads else 0.0, low, high)
    factors, degree = dict(of[0].factors), of[0].degree
    if op in ("mul", "div"):
        sign = 1.0 if op == "mul" else -1.0
        degree += sign * of[1].degree
        for base, e in of[1].factors.items():
            factors[base] = factors.get(base, 0.0) + sign * e
    else:
        e = line.nodes[operands[1]][2] if op == "pow" else _ROOTS.get(op, 1.0)
        factors, degree = {base: e * n for base, n in factors.items()}, e * degree
    factors = {base: e for base, e in factors.items() if e}
    return _Number(factors if 0 < len(factors) <= _LONGEST else {i: 1.0}, degree, low, high)


def _bounds(op: str, operands: tuple[int, ...], of: list[_Number]) -> tuple[float, float]:
    """Bounds of the result of an operation, where sums and products of bounded functions have them."""
    if op in _BETWEEN:
        return -_BETWEEN[op], _BETWEEN[op]
    if op in ("add", "sub", "mul", "neg"):
        (a, b), *other = [(x.low, x.high) for x in of]
        if op == "neg":
            return -b, -a
        c, d = other[0]
        if op == "add":
            return a + c, b + d
        if op == "sub":
            return a - d, b - c
        ends = [x * y if x and y else 0.0 for x in (a, b) for y in (c, d)]
        return (0.0 if operands[0] == operands[1] else min(ends)), max(ends)
    return (0.0, math.inf) if op in ("abs", "exp", "sqrt", "cosh") else _ALL
