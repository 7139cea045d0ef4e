"""Complex numbers on scalars: each is a pair of real ones, its real and its imaginary part.

A pair has an id of its own (`Expansion.pair`), so that primitives that only move numbers move pairs too. Arithmetic
splits them: a function of z = x + iy becomes two of x and y. Logarithms, roots and powers have their branch cut on the
negative real axis, as in JAX: it is that of atan2, and a border.

Fourier transforms and inverse circular and hyperbolic functions are left to XLA.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax._tracing._scalars import Scalars
from lagjax._tracing.lowering._rules import COMPLEX, Expansion, lowers, reduction, take_length


class Pair(NamedTuple):
    """Complex numbers as two arrays of scalars: real and imaginary parts."""

    re: Scalars
    im: Scalars

    def __add__(self, other):  # type: ignore[override]
        return Pair(self.re + other.re, self.im + other.im)

    def __sub__(self, other):
        return Pair(self.re - other.re, self.im - other.im)

    def __neg__(self):
        return Pair(-self.re, -self.im)

    def __mul__(self, other):  # type: ignore[override]
        return Pair(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)

    @property
    def is_real(self) -> bool:
        graph = self.im.expansion.graph
        return all(graph.value(i) == 0 for i in self.im.ids.ravel().tolist())

    @property
    def square(self) -> Scalars:
        """The squared modulus |z|²."""
        return self.re * self.re if self.is_real else self.re * self.re + self.im * self.im

    @property
    def angle(self) -> Scalars:
        return self.im.map("atan2", self.im, self.re)

    @property
    def conjugate(self) -> "Pair":
        return Pair(self.re, -self.im)

    @property
    def multiply_by_i(self) -> "Pair":
        return Pair(-self.im, self.re)

    @property
    def divide_by_i(self) -> "Pair":
        """The quotient z / i = −i z."""
        return Pair(self.im, -self.re)


def _real(op: str, x: Scalars, *others) -> Scalars:
    return x.map(op, x, *others)


def _polar(size: Scalars, angle: Scalars) -> Pair:
    return Pair(size * _real("cos", angle), size * _real("sin", angle))


# ---- functions ------------------------------------------------------------------------------------------------------


def _quotient(a: Pair, b: Pair) -> Pair:
    if b.is_real:
        return Pair(a.re / b.re, a.im / b.re)
    product, size = a * b.conjugate, b.square
    return Pair(product.re / size, product.im / size)


def _inverse(z: Pair) -> Pair:
    size = z.square
    return Pair(z.re / size, -z.im / size)


def _absolute(z: Pair) -> Scalars:
    expansion = z.re.expansion
    return Scalars(expansion, expansion.map_ids(functools.partial(take_length, expansion), z.re.ids, z.im.ids))


def _sign(z: Pair) -> Pair:
    """The complex sign z/|z|, and 0 at z = 0."""
    square = z.square
    is_zero = _real("eq", square, 0.0)
    size = _real("sqrt", is_zero.map("select", is_zero, square, 1.0))
    return Pair(z.re / size, z.im / size)


def _square_root(z: Pair) -> Pair:
    return _polar(_real("sqrt", _real("sqrt", z.square)), 0.5 * z.angle)


def _whole_power(z: Pair, exponent: int) -> Pair:
    """z**exponent for a whole exponent, by repeated squaring; the inverse for a negative one."""
    result, base, left = None, z, abs(exponent)
    while left:
        if left & 1:
            result = base if result is None else result * base
        left >>= 1
        base = base * base if left else base
    if result is None:
        return Pair(1.0 + 0.0 * z.re, 0.0 * z.im)
    return result if exponent > 0 else _inverse(result)


def _power(z: Pair, exponent: Pair) -> Pair:
    """The power with modulus |z|ᶜ e^(−d θ) and angle c θ + d log |z|, for the exponent c + id, θ the angle of z."""
    graph = z.re.expansion.graph
    values = {graph.value(i) for i in exponent.re.ids.ravel().tolist()} if exponent.is_real else {None}
    value = values.pop() if len(values) == 1 else None
    if value is not None and value == round(value) and abs(value) <= 16:
        return _whole_power(z, int(value))
    if value is not None and value > 1:  # has a derivative at zero, which its parts have not
        is_zero = _real("eq", z.square, 0.0)
        beside = Pair(is_zero.map("select", is_zero, z.re, 1.0), z.im)
        parts = _polar(_real("pow", beside.square, 0.5 * value), value * beside.angle)
        return Pair(*(is_zero.map("select", is_zero, x, 0.0) for x in parts))
    size = _real("pow", z.square, 0.5 * exponent.re)
    if exponent.is_real:
        return _polar(size, z.angle * exponent.re)
    size = size * _real("exp", -(exponent.im * z.angle))
    return _polar(size, exponent.re * z.angle + exponent.im * (0.5 * _real("log", z.square)))


def _sine(z: Pair) -> Pair:
    return Pair(_real("sin", z.re) * _real("cosh", z.im), _real("cos", z.re) * _real("sinh", z.im))


def _cosine(z: Pair) -> Pair:
    return Pair(_real("cos", z.re) * _real("cosh", z.im), -(_real("sin", z.re) * _real("sinh", z.im)))


def _tangent(z: Pair) -> Pair:
    """tan z = tan x sech² y/(1 + tan² x tanh² y) + i tanh y sec² x/(1 + …), written so that nothing overflows."""
    sine, cosine, ratio = _real("sin", z.re), _real("cos", z.re), _real("tanh", z.im)
    size = cosine * cosine + sine * sine * ratio * ratio
    return Pair(sine * cosine * (1.0 - ratio * ratio) / size, ratio / size)


def _derive_circular(function: Callable) -> Callable:
    """The circular function f of a hyperbolic function F, or the converse: f(z) = −i F(i z)."""
    return lambda z: function(z.multiply_by_i).divide_by_i


_FUNCTIONS: dict[str, Callable] = {
    "real": lambda z: z.re,
    "imag": lambda z: z.im,
    "conj": lambda z: z.conjugate,
    "neg": lambda z: -z,
    "abs": _absolute,
    "sign": _sign,
    "mul": lambda a, b: a * b,
    "div": _quotient,
    "square": lambda z: z * z,
    "pow": _power,
    "sqrt": _square_root,
    "rsqrt": lambda z: _inverse(_square_root(z)),
    "exp": lambda z: _polar(_real("exp", z.re), z.im),
    "log": lambda z: Pair(0.5 * _real("log", z.square), z.angle),
    "sin": _sine,
    "cos": _cosine,
    "tan": _tangent,
    "sinh": _derive_circular(_sine),
    "cosh": lambda z: _cosine(z.multiply_by_i),
    "tanh": _derive_circular(_tangent),
    "eq": lambda a, b: _real("and", _real("eq", a.re, b.re), _real("eq", a.im, b.im)),
    "ne": lambda a, b: _real("or", _real("ne", a.re, b.re), _real("ne", a.im, b.im)),
}
# What is linear, or moves numbers by others: done with each part.
_PARTWISE = (
    "add", "sub", "add_any", "select_n", "reduce_sum", "cumsum", "gather", "dynamic_slice", "dynamic_update_slice",
    "scatter", "scatter-add", "scatter-sub",
)  # fmt: skip


# ---- primitives -----------------------------------------------------------------------------------------------------


def _pair_of(expansion: Expansion, ids: np.ndarray) -> Pair:
    return Pair(*(Scalars(expansion, part) for part in expansion.parts(ids)))


def _ids_of(expansion: Expansion, value: "Pair | Scalars") -> np.ndarray:
    return value.ids if isinstance(value, Scalars) else expansion.pair(value.re.ids, value.im.ids)


def _elementwise(function: Callable) -> Callable:
    def rule(expansion, params, *arguments):
        return _ids_of(expansion, function(*(_pair_of(expansion, x) for x in arguments)))

    return rule


def _partwise(name: str) -> Callable:
    def rule(expansion, params, *arguments):
        parts = [expansion.parts(x) if expansion.has_pairs(x) else (x, x) for x in arguments]
        return expansion.pair(*(expansion.lower_primitive(name, params, xs) for xs in zip(*parts, strict=True)))

    return rule


COMPLEX.update({name: _elementwise(function) for name, function in _FUNCTIONS.items()})
COMPLEX.update({name: _partwise(name) for name in _PARTWISE})


COMPLEX["integer_pow"] = lambda of, params, x: _ids_of(of, _whole_power(_pair_of(of, x), params["y"]))
COMPLEX["reduce_prod"] = reduction(
    COMPLEX["mul"], 1.0 + 0.0j, lambda of, multiply, rows: functools.reduce(functools.partial(multiply, of, {}), rows)
)
COMPLEX["complex"] = lambda expansion, params, re, im: expansion.pair(*np.broadcast_arrays(re, im))


@lowers("convert_element_type", table=COMPLEX)
def _convert_element_type(expansion, params, x):
    if np.issubdtype(params["new_dtype"], np.complexfloating):
        if expansion.has_pairs(x):
            return x
        return expansion.pair(*expansion.parts(expansion.map("convert", x, attribute="float")))
    return expansion.lower_primitive("convert_element_type", params, [expansion.parts(x)[0]])


@lowers("dot_general", table=COMPLEX)
def _dot_general(expansion, params, x, y):
    params = {**params, "preferred_element_type": None}
    a, b = expansion.parts(x), expansion.parts(y)
    products = {(i, j): expansion.lower_primitive("dot_general", params, [a[i], b[j]]) for i in (0, 1) for j in (0, 1)}
    real = expansion.map("sub", products[0, 0], products[1, 1])
    return expansion.pair(real, expansion.map("add", products[0, 1], products[1, 0]))
