"""The outputs of a straight line as formulas to read: sums of products, in which like terms are collected.

A straight line is written for a processor: products are shared, signs and factors ½ are placed where they cost least.
Here every sum is kept as written and also expanded, which shows terms that cancel; the expanded form is factored by the
sums that the user wrote, and by parameters with the same cofactor. The shorter of both forms is taken:

    m2 l1 l2 (θ̇1 θ̇2 s − θ̇1 (θ̇1 − θ̇2) s)    ──►    m2 l1 l2 θ̇2² s
    m1 l1² + m2 l1²                            ──►    (m1 + m2) l1²

A `Sum` maps products to coefficients; a product maps atoms to powers; an *atom* is an input of the line, a function of
sums, or a sum used as a factor. Products of sines and cosines are joined by cos a cos b ± sin a sin b = cos(a ∓ b) and
sin a cos b ± cos a sin b = sin(a ± b).
"""

import functools
import itertools
from collections import Counter
from typing import NamedTuple

from lagjax._program._line import StraightLine
from lagjax._program._look_ups import Table, table_of
from lagjax._program._operations import LOOK_UPS, OPERATIONS
from lagjax._program._simplify import even, odd

Product = tuple[tuple[int, float], ...]  # (atom, power), by atoms
Sum = dict[Product, float]

# Terms up to which sums are multiplied out, and the largest power: a page has no more. Doubled, 500 operations take
# four times as long.
MOST_TERMS, LARGEST_POWER = 80, 4
LONGEST_WRITTEN = 4  # terms of a written sum that is looked for
ONE: Product = ()
_ROUNDING = 4e-16  # of a coefficient: what is left of two that cancel


class Atom(NamedTuple):
    """An atom: `kind` "input" with its position, "sum" with one sum, or the name of an operation with its operands."""

    kind: str
    position: int = -1
    operands: tuple = ()  # sums, each as a tuple of its sorted items


class Formulas:
    """The `outputs` of a line as sums, and the `atoms` that they refer to by index.

    The first `moving` inputs of the line are coordinates, velocities and time; the rest are parameters. The position of
    a look-up is twice that of its table in `tables`, and one more where the table is closed.
    """

    def __init__(self, line: StraightLine, moving: int):
        self.moving = moving
        self.tables: list[Table] = []
        self.atoms: list[Atom] = []
        self._ids: dict[Atom, int] = {}
        self._costs: dict[int, int] = {}
        self._written: dict[int, None] = {}  # the sums of the line, as atoms
        values: list[Sum] = []
        for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
            values.append(self._apply_operation(op, [values[i] for i in operands], attribute, kind))
            if op in ("add", "sub") and 1 < len(values[-1]) <= LONGEST_WRITTEN:
                self._record_sum(values[-1])
        self.outputs = [self._shortest_form(values[i]) for i in line.outputs]

    def _atom_id(self, *of) -> int:
        atom = Atom(*of)
        if atom not in self._ids:
            self._ids[atom] = len(self.atoms)
            self.atoms.append(atom)
        return self._ids[atom]

    def _record_sum(self, x: Sum) -> None:
        """Record a sum that the user wrote, for later factoring, if its terms without common factors are atoms."""
        shared = functools.reduce(lambda a, b: a & b, (set(product) for product in x))
        unit = {tuple(of for of in product if of not in shared): c for product, c in x.items()}
        if any(len(product) > 1 or any(self._expands(*of) for of in product) for product in unit):
            return
        ((product, _),) = self._atom_of_sum(unit, 1).items()
        if len(product) == 1 and self.atoms[product[0][0]].kind == "sum":
            self._written[product[0][0]] = None

    # ---- the operations of the line ----

    def _apply_operation(self, op: str, xs: list[Sum], attribute, kind: str) -> Sum:
        if op == "constant":
            return {ONE: attribute} if attribute else {}
        if op == "input":
            return atom_power(self._atom_id("input", attribute))
        if op in ("add", "sub"):
            return add(xs[0], xs[1], 1.0 if op == "add" else -1.0)
        if op == "neg":
            return add({}, xs[0], -1.0)
        if op == "mul":
            return self._multiply_sums(*xs)
        if op == "div" and kind == "float":
            return self._multiply_sums(xs[0], self._take_power(xs[1], -1))
        if op in ("sqrt", "rsqrt"):
            return self._take_power(xs[0], 0.5 if op == "sqrt" else -0.5)
        if op == "pow" and not xs[1].keys() - {ONE}:
            return self._take_power(xs[0], xs[1].get(ONE, 0.0))
        if op == "convert":
            return xs[0] if kind in ("float", "bool") else self._apply_function("trunc", xs)
        if op not in LOOK_UPS:
            return self._apply_function(op, xs, int(attribute) if op == "round" else -1)
        if (table := table_of(attribute)) not in self.tables:
            self.tables.append(table)
        return self._apply_function(op, xs, 2 * self.tables.index(table) + getattr(attribute, "closed", False))

    def _apply_function(self, op: str, xs: list[Sum], number: int = -1) -> Sum:
        xs, sign = [self._shortest_form(x) for x in xs], 1.0
        rule = OPERATIONS[op].simplify
        if rule in (odd, even) and xs[0] and xs[0][min(xs[0], key=self._term_rank)] < 0:
            xs, sign = [add({}, xs[0], -1.0)], -1.0 if rule is odd else 1.0
        return {((self._atom_id(op, number, tuple(map(freeze, xs))), 1),): sign}

    def _multiply_sums(self, a: Sum, b: Sum) -> Sum:
        """The product of two sums; a sum of several terms stays one factor, unless the second factor is a number."""
        if not (a.keys() - {ONE} and b.keys() - {ONE}):
            return multiply(a, b)
        return multiply(*(x if len(x) == 1 else self._atom_of_sum(x, 1) for x in (a, b)))

    def _atom_of_sum(self, x: Sum, power: float) -> Sum:
        """A power of a sum as one atom, without its common coefficient and with a positive first term."""
        if len(x := self._shortest_form(x)) == 1:
            return self._take_power(x, power)
        sizes = {abs(c) for c in x.values()}
        size = sizes.pop() if len(sizes) == 1 else 1.0
        if power == int(power) and x[min(x, key=self._term_rank)] < 0:
            size = -size
        unit = {product: c / size for product, c in x.items()}
        return {((self._atom_id("sum", -1, (freeze(unit),)), power),): size**power}

    def _term_rank(self, product: Product) -> tuple:
        """The sort key of a term in a sum: terms with coordinates first, then numbers, then parameters."""
        moves = any(self.atoms[a].kind == "input" and not self._is_parameter(a) for a, _ in product)
        return not moves, product != ONE, product

    def _take_power(self, x: Sum, power: float) -> Sum:
        if len(x) != 1:
            return self._atom_of_sum(x, power) if x else atom_power(self._atom_id("sum", -1, ((),)), power)
        ((product, c),) = x.items()
        plain = len(product) == 1 and product[0][1] == 1 and c == 1
        if power == int(power) or plain or (not product and c > 0):
            return {tuple((atom, power * p) for atom, p in product): c**power}
        return atom_power(self._atom_id("sum", -1, (freeze(x),)), power)

    # ---- the shortest form ----

    def _shortest_form(self, x: Sum) -> Sum:
        for product in [product for product in x if len(product) == 1 and product[0][1] == 1]:
            if self.atoms[product[0][0]].kind == "sum":
                c = x[product]
                x = {key: value for key, value in x.items() if key != product}
                x = add(x, dict(self.atoms[product[0][0]].operands[0]), c)
        forms = [self._join_angles(x), self._gather_factors(self._join_angles(self._multiply_out(x)))]
        return min(forms, key=self.length)

    def length(self, x: Sum) -> int:
        """The number of operations of a sum as it is printed."""
        factors = sum(max(0, len(product) - 1 + (abs(c) != 1)) for product, c in x.items())
        inner = sum(self.cost(atom) + (power != 1) for product in x for atom, power in product)
        return max(0, len(x) - 1) + factors + inner

    def cost(self, atom: int) -> int:
        """The number of operations of an atom as it is printed."""
        if atom not in self._costs:
            of = self.atoms[atom]
            self._costs[atom] = (of.kind not in ("input", "sum")) + sum(self.length(dict(x)) for x in of.operands)
        return self._costs[atom]

    def _multiply_out(self, x: Sum) -> Sum:
        """The sum with whole powers of sums expanded, as long as it has at most `MOST_TERMS` terms."""
        while True:
            found = next(
                ((product, k) for product in x for k in range(len(product)) if self._expands(*product[k])), None
            )
            if found is None:
                return x
            product, k = found
            opened: Sum = {product[:k] + product[k + 1 :]: x[product]}
            for _ in range(int(product[k][1])):
                opened = multiply(opened, dict(self.atoms[product[k][0]].operands[0]))
            if len(opened) + len(x) > MOST_TERMS:
                return x
            x = add({key: c for key, c in x.items() if key != product}, opened, 1.0)

    def _expands(self, atom: int, power: float) -> bool:
        return self.atoms[atom].kind == "sum" and power in range(1, LARGEST_POWER + 1)

    # ---- sines and cosines ----

    def _join_angles(self, x: Sum) -> Sum:
        while (joined := next(filter(None, (self._join_products(x, product) for product in x)), None)) is not None:
            x = joined
        return x

    def _join_products(self, x: Sum, product: Product) -> Sum | None:
        """Merge `product` with its partner, that of the co-functions, by an addition theorem; None without one."""
        turns = [
            a for a, p in product for _ in range(min(2, int(p)) if p > 0 else 0) if self.atoms[a].kind in ("sin", "cos")
        ]
        for a, b in itertools.combinations(turns, 2):
            rest = multiply({product: 1.0}, multiply(atom_power(a, -1), atom_power(b, -1)))
            others = multiply(*(atom_power(self._co_function(of)) for of in (a, b)))
            (partner,) = multiply(rest, others)
            if partner == product or abs(x[product]) != abs(x.get(partner, 0.0)):
                continue
            if (joined := self._angle_sum(a, b, x[product], x[partner])) is not None:
                left = {key: c for key, c in x.items() if key not in (product, partner)}
                return add(left, multiply(rest, joined), 1.0)
        return None

    def _angle_sum(self, a: int, b: int, c: float, d: float) -> Sum | None:
        """The sum c f(a) g(b) + d f′(a) g′(b) as one sine or cosine, f′ the co-function of f; None if it is none."""
        (f, u), (g, v) = ((self.atoms[k].kind, dict(self.atoms[k].operands[0])) for k in (a, b))
        if u == v and (f != g or c != d):
            return None  # cos² − sin² and sin cos stay
        if f == g:  # cos cos ± sin sin
            op, angle, size = "cos", add(u, v, -1.0 if c == d else 1.0), c if f == "cos" else d
        else:  # sin cos ± cos sin
            u, v = (u, v) if f == "sin" else (v, u)
            op, angle, size = "sin", add(u, v, 1.0 if c == d else -1.0), c
        return multiply(self._apply_function(op, [angle]), {ONE: size}) if angle else {ONE: size}

    def _co_function(self, atom: int) -> int:
        of = self.atoms[atom]
        return self._atom_id("cos" if of.kind == "sin" else "sin", of.position, of.operands)

    # ---- sums that are factors ----

    def _gather_factors(self, x: Sum) -> Sum:
        """The sum factored by sums that the user wrote, and by sums of parameters."""
        for atom in sorted(self._written, key=lambda a: -len(self.atoms[a].operands[0])):
            terms = dict(self.atoms[atom].operands[0])
            while (found := _common_multiple(x, terms)) is not None:
                shorter = self._replace(x, multiply(found, terms), multiply(found, atom_power(atom)))
                if shorter is None or x.keys() == terms.keys():
                    break
                x = shorter
        groups: dict[Product, Sum] = {}
        for product, c in x.items():
            for atom, power in product:
                if power == 1 and self._is_parameter(atom) and len(product) > 1:
                    rest = tuple(of for of in product if of[0] != atom)
                    groups.setdefault(rest, {})[((atom, 1),)] = c
        rest, group = max(groups.items(), key=lambda of: (len(of[1]), len(of[0])), default=(ONE, {}))
        if len(group) > 1:
            new = multiply({rest: 1.0}, self._atom_of_sum(group, 1))
            if (shorter := self._replace(x, multiply({rest: 1.0}, group), new)) is not None:
                return self._gather_factors(shorter)
        return x

    def _replace(self, x: Sum, old: Sum, new: Sum) -> Sum | None:
        """The sum with the terms `old` replaced by `new`; None if that is longer."""
        other = add(add(x, old, -1.0), new, 1.0)
        return other if self.length(other) <= self.length(x) else None

    def _is_parameter(self, atom: int) -> bool:
        return self.atoms[atom].kind == "input" and self.atoms[atom].position >= self.moving


def atom_power(atom: int, power: float = 1) -> Sum:
    """The sum that is one power of an atom."""
    return {((atom, power),): 1.0}


def freeze(x: Sum) -> tuple:
    return tuple(sorted(x.items()))


def add(a: Sum, b: Sum, factor: float) -> Sum:
    """The sum a + factor · b; terms that cancel to rounding are dropped."""
    result = dict(a)
    for product, c in b.items():
        before = result.get(product, 0.0)
        total = before + factor * c
        if abs(total) <= _ROUNDING * abs(before):
            del result[product]
        else:
            result[product] = total
    return result


def multiply(a: Sum, b: Sum) -> Sum:
    """The product of two sums, expanded term by term."""
    result: Sum = {}
    for (x, c), (y, d) in itertools.product(a.items(), b.items()):
        powers = Counter(dict(x))
        powers.update(dict(y))
        product = tuple(sorted((atom, power) for atom, power in powers.items() if power))
        result = add(result, {product: c * d}, 1.0)
    return result


def _common_multiple(x: Sum, terms: Sum) -> Sum | None:
    """A product and its coefficient, {product: c}, such that `terms` times it are all terms of x; None without one."""
    (lead, first), *others = terms.items()
    for product, c in x.items():
        (factor,) = multiply({product: 1.0}, {tuple((atom, -power) for atom, power in lead): 1.0})
        if any(p < 0 and (atom, p) not in product for atom, p in factor):
            continue
        found = {factor: c / first}
        wanted = multiply(found, dict(others))
        if all(abs(x.get(other, 0.0) - d) <= _ROUNDING * abs(d) for other, d in wanted.items()):
            return found
    return None
