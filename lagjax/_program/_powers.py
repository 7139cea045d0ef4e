"""The powers in a program, and which of them no series of a motion shows from afar.

Every number is a product Π bᵉ of bases: of sums, inputs and functions, which are no products themselves. However it
was written, (1 + x²)⁻⁶ has the base 1 + x², and its exponent −6. Where |b| falls, or rises, it changes by e log |b|,
as an exponential does by its argument: where that is near nothing before, no coefficient tells.

Left out is what cannot change so much: a base between two bounds. And so is a force that falls like the inverse square
of a distance, x / (x² + y²)^1.5: it is seen from as far away as the tolerance resolves a place as small as where it is
strong. A base of fewer squares comes near zero along a whole surface, which one meets without having aimed at it.
"""

import functools
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
# at 1e-5 those from 1e6 on, whose place rtol leaves open by ten lengths. With 3, those of 1 / r² at 1e-9 as well.
_SLOWEST = 2.0
_LONGEST_PRODUCT, _DEEPEST_SUM = 16, 8  # factors of a product; sums of products that one is looked for in
_ROOTS = {"sqrt": 0.5, "rsqrt": -0.5, "cbrt": 1 / 3}
_PRODUCTS = {"mul", "div", "neg", "abs", *_ROOTS}
_BETWEEN = {"sin": 1.0, "cos": 1.0, "tanh": 1.0, "erf": 1.0, "atan": math.pi / 2, "sign": 1.0}


class Power(NamedTuple):
    """A base, and the largest exponent in magnitude among its powers with that sign of the exponent."""

    base: int
    exponent: float


def find_powers(line: StraightLine, nodes: Iterable[int], guards: set[int], size: int) -> list[Power]:
    """The powers among `nodes` whose change a Taylor series may miss; the program has `size` coordinates."""
    program, found = _ProductFactors(line, sorted(nodes), size), {}
    for i in program.users:
        for base, e in program.factors.get(i, {}).items():
            if e >= LEAST_POWER or (e < 0 and program.is_hidden(base, i, i in guards)):
                found[base, e > 0] = max(found.get((base, e > 0), 0.0), abs(e))
    return [Power(base, e if grows else -e) for (base, grows), e in sorted(found.items())]


class _ProductFactors:
    """The nodes of a program as products of powers of moving bases (`factors`), and the nodes that use each product.

    A moving node without an entry in `factors` is its own base.
    """

    def __init__(self, line: StraightLine, nodes: list[int], size: int):
        self.line, self.factors = line, {}
        self.users: dict[int, list[int]] = {i: [] for i in line.outputs}
        self._bounds: dict[int, tuple[float, float]] = {}
        self.squares = functools.cache(self._find_squares)
        self._moving: set[int] = set()
        steps = {op for op in {node[0] for node in line.nodes} - {"input", "constant"} if OPERATIONS[op].is_step}
        for i in nodes:
            op, operands, value = line.nodes[i]
            if not operands:
                if op == "input" and value <= 2 * size:
                    self._moving.add(i)
                continue
            is_product = op in _PRODUCTS or (op == "pow" and line.nodes[operands[1]][0] == "constant")
            if not is_product:
                for x in operands:
                    self.users.setdefault(x, []).append(i)
            if op not in steps and not self._moving.isdisjoint(operands):
                self._moving.add(i)
                if is_product:
                    self.factors[i] = self._multiply_factors(i, op, operands)
        self.holders: dict[int, list[int]] = {}
        for i in self.users:
            for base in self.factors_of(i):
                self.holders.setdefault(base, []).append(i)

    def factors_of(self, i: int) -> dict[int, float]:
        """The exponents of node i by base; empty for a node that is constant along the motion."""
        return self.factors.get(i) or ({i: 1.0} if i in self._moving else {})

    def _multiply_factors(self, i: int, op: str, operands: tuple[int, ...]) -> dict[int, float]:
        factors = dict(self.factors_of(operands[0]))
        if op in ("mul", "div"):
            for base, e in self.factors_of(operands[1]).items():
                factors[base] = factors.get(base, 0.0) + (e if op == "mul" else -e)
        elif op != "neg":
            power = self.line.nodes[operands[1]][2] if op == "pow" else _ROOTS.get(op, 1.0)
            factors = {base: e * power for base, e in factors.items()}
        if not all(factors.values()):
            factors = {base: e for base, e in factors.items() if e}
        return factors if 0 < len(factors) <= _LONGEST_PRODUCT else {i: 1.0}

    def is_hidden(self, base: int, i: int, of_guard: bool) -> bool:
        """True if a negative power in product i may change much within a step, unseen in the series at its start."""
        exponent, squares = self.factors[i][base], self.squares(base)
        if not of_guard and len(squares) > 1 and -2 * exponent - self.degree(i, squares) <= _SLOWEST:
            return False
        low, high = self.bounds(base)
        least, most = (low, high) if low > 0 else (-high, -low)
        return not (least > 0 and math.log(most / least) * -exponent < _SEEN)

    def _find_squares(self, i: int) -> set[int]:
        """The bases of a sum of squares, up to constant terms; empty for any other sum."""
        squares, terms = set(), [i]
        while terms:
            op, operands, _ = self.line.nodes[terms.pop()]
            for x in operands:
                factors = self.factors_of(x)
                if self.line.nodes[x][0] == "add":
                    terms.append(x)
                elif factors and (op != "add" or list(factors.values()) != [2.0]):
                    return set()
                else:
                    squares.update(factors)
        return squares

    def degree(self, i: int, numbers: set[int], left: int = _DEEPEST_SUM) -> float:
        """The degree in `numbers` of the terms that contain product i as a factor, including i: the least of them."""
        own = sum(self.factors_of(i).get(x, 0.0) for x in numbers)
        sums = [u for u in self.users[i] if self.line.nodes[u][0] in ("add", "sub")]
        if own or not left or len(sums) < len(self.users[i]) or i in self.line.outputs:
            return own
        holders = [x for u in sums for x in self.holders.get(u, ())]
        return min((self.degree(x, numbers, left - 1) for x in holders), default=0.0)

    def bounds(self, i: int) -> tuple[float, float]:
        """Lower and upper bound of node i by interval arithmetic on sums and products of bounded functions."""
        known, stack = self._bounds, [i]
        while stack:
            op, operands, value = self.line.nodes[stack[-1]]
            missing = [y for y in operands if y not in known] if op in ("add", "sub", "mul", "neg") else []
            stack.extend(missing)
            if not missing:
                known[stack.pop()] = (float(value), float(value)) if op == "constant" else self._bound(op, operands)
        return known[i]

    def _bound(self, op: str, operands: tuple[int, ...]) -> tuple[float, float]:
        if op in _BETWEEN:
            return -_BETWEEN[op], _BETWEEN[op]
        if op not in ("add", "sub", "mul", "neg"):
            return (0.0, math.inf) if op in ("abs", "exp", "sqrt", "cosh") else (-math.inf, math.inf)
        (a, b), (c, d) = self._bounds[operands[0]], self._bounds[operands[-1]]
        if op == "neg":
            return -b, -a
        if op != "mul":
            return (a + c, b + d) if op == "add" else (a - d, b - c)
        ends = [x * y if x and y else 0.0 for x in (a, b) for y in (c, d)]
        return (0.0 if operands[0] == operands[1] else min(ends)), max(ends)
