"""The operations of scalar programs, one row each: all that lagjax knows about `sin` is in the row of `sin`.

    reader                            fields of a row
    graph of a program                `value` on constants, `simplify`, `commutative`, `is_logical`
    evaluation in NumPy               `value`; `exact` and `transpose`, for round-off and the transposed derivative
    transposed program                `transpose`: `cotangents`, or else `slopes`
    conversion back to JAX            `lax`
    Taylor series                     `recurrence`, or else `slopes`; `is_step`
    machine code                      `llvm`
    text: C, formulas to read         `c`, `text`, `latex`
    check of a scene                  `side`

An operation has the name of the JAX primitive that it implements, if there is one: an elementwise primitive with a row
needs no further lowering rule. `_rules` lowers the primitives that need several operations.

Formulas of an operation are written once for all readers: `f(op, *xs)` applies an operation, `c(x)` makes a constant,
`w` is the result and `u`, `v` (or `y`, `x`) are the operands. The slope of `tan` is `f("add", c(1.0), f("mul", w, w))`:
nodes of a graph in a Taylor series and in a transpose, arrays in NumPy.

Two operations carry an attribute: `round` (1: ties to even, 0: away from zero) and `convert` (the kind of the result).
`convert` has no code here because it depends on both kinds. Sine and cosine of one angle are computed together by
`_native.series._lanes` and by `_emit`. A look-up in a table is not elementwise: see `_look_ups`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagjax._program import _recurrences, _simplify


@dataclass(frozen=True, eq=False, slots=True)
class Operation:
    """One operation of a scalar program.

    - `name`, `arity`: the name in a node, and how many operands it takes.
    - `value(*xs)`: the result in NumPy, for numbers and for arrays of one shape; with the attribute as the last
      argument where a node has one.
    - `llvm`: the name of a function of the C library, called lane by lane; or `(code, *xs)` → value, with a
      `_native.code._ir.Code`, whose values are vectors with the operators of Python. None: this is done elsewhere.
    - `c`, `text`, `latex`: the expression in C, in Python and in LaTeX, with {0}, {1}, … for its operands; None: a
      function, by the name that it has in the C library, or here.
    - `lax`: the name of the function in `jax.lax`, if it is not `name`; `_emit` writes what is not there.
    - `simplify(graph, name, *operands)`: a node that is simpler for some operands (see `_simplify`).
    - `commutative`: the order of two operands does not matter.
    - `is_logical`: the result is a bool, whatever the operands are.
    - `is_step`: the result is constant between its jumps, with all derivatives zero.
    - `exact`: the result is not rounded.
    - `slopes`: ∂w/∂u for every operand, each as `slope(f, c, w, *operands)`.
    - `steep`: a slope may be infinite, or 0/0, where the result is finite.
    - `recurrence`: the order recursion (see `_recurrences`), where it is not to follow from `slopes`.
    - `cotangents`: for every operand `(f, c, g, w, *operands)` → its cotangent, from the cotangent g of the result,
      where that is not to be g times the slope; None for an operand without one.
    - `side(f, c, w, *operands)`: on which side of a border between two pieces the operands are, for an operation that
      has kinks or jumps.
    """

    name: str
    arity: int
    value: Callable
    llvm: "str | Callable[..., Any] | None"
    lax: str | None = None
    simplify: Callable | None = None
    commutative: bool = False
    is_logical: bool = False
    is_step: bool = False
    exact: bool = False
    slopes: tuple[Callable, ...] = ()
    steep: bool = False
    recurrence: Callable | None = None
    cotangents: "tuple[Callable | None, ...]" = ()
    side: Callable | None = None
    c: str | None = None
    text: str | None = None
    latex: str | None = None

    def write_c(self, *operands: str, attribute=None) -> str:
        """The expression in C; the operands are names, numbers or bracketed expressions."""
        name = self.llvm if isinstance(self.llvm, str) else self.name
        form = self.c or self.text
        if form is None:
            return f"{name}({', '.join(operands)})"
        return form.format(*operands, rounds="rint" if attribute == 1 else "round")

    def transpose(self) -> "tuple[Callable | None, ...]":
        """For every operand `(f, c, g, w, *operands)` → its cotangent from g, that of w; empty for zero slopes."""
        if self.cotangents:
            return self.cotangents
        return tuple(lambda f, c, g, w, *xs, slope=slope: f("mul", g, slope(f, c, w, *xs)) for slope in self.slopes)


def apply_in_numpy(op: str, *xs, attribute=None):
    """The operation on numbers or arrays: the function `f` of the formulas here, in NumPy."""
    return OPERATIONS[op].value(*xs) if attribute is None else OPERATIONS[op].value(*xs, attribute)


# ---- values in NumPy -------------------------------------------------------------------------------------------------


def _round(x, method):
    if method == 1:  # RoundingMethod.TO_NEAREST_EVEN
        return np.round(x)
    whole = np.trunc(x)
    return whole + np.copysign(abs(x - whole) >= 0.5, x)


def _divide(x, y):
    if np.result_type(x).kind == "f":
        return np.divide(x, y)
    return np.where(y == 0, -1, np.trunc(np.divide(x, np.where(y == 0, 1, y))))[()].astype(np.result_type(x))


def _remainder(x, y):
    return (
        np.fmod(x, y) if np.result_type(x).kind == "f" else np.where(y == 0, x, np.fmod(x, np.where(y == 0, 1, y)))[()]
    )


def _refuse_look_up(x, attribute):
    raise TypeError("a look-up has no value without its table")


def _power_of_two(x):
    power = np.where(x == 0, 1, np.ldexp(np.ones_like(x), np.frexp(x)[1] - 1))
    return np.where(np.isfinite(x), power, np.abs(x))[()]


def _select(predicate, no, yes):
    return np.where(predicate, yes, no)[()]


def _log_of_sum(code, a, b):
    """log(eᵃ + eᵇ), in machine code."""
    difference = a - b
    result = code.maximum(a, b) + code.library("log1p", code.library("exp", -abs(difference)))
    return code.select(code.compare("==", difference, difference), result, a + b)


# ---- pieces of formulas ----------------------------------------------------------------------------------------------


def _square(f, x):
    return f("mul", x, x)


def _one_plus(f, c, x):
    return f("add", c(1.0), x)


def _one_minus_square(f, c, x):
    return f("sub", c(1.0), f("mul", x, x))


def _square_minus_one(f, c, x):
    return f("mul", f("sub", x, c(1.0)), f("add", c(1.0), x))  # next to 1 the difference of squares has lost its digits


def _inverse(f, c, x):
    return f("div", c(1.0), x)


def _inverse_root(f, c, x):
    return _inverse(f, c, f("sqrt", x))


def _gauss(f, c, u):
    return f("mul", c(2 / math.sqrt(math.pi)), f("exp", f("neg", _square(f, u))))


def _radius_squared(f, y, x):
    return f("add", _square(f, x), _square(f, y))


def _whole_part(f, w, u, v):
    """The whole number n in u = n v + w, as a node or array."""
    return f("round", f("div", f("sub", u, w), v), attribute=1)


def _is_larger(f, c, w, u, v):
    return f("ge", u, v)


def _whole(f, c, w, *operands):
    return w


def _choose_value(f, condition, yes, no):
    return f("select", condition, no, yes)


def _share(f, c, g, larger, smaller):
    """The cotangent of operand `larger` of a maximum: g if it is the larger one, ½ g if both are equal, else 0."""
    whole = _choose_value(f, f("gt", larger, smaller), c(1.0), c(0.0))
    return f("mul", g, _choose_value(f, f("eq", larger, smaller), c(0.5), whole))


def _power_by_base(f, c, g, w, u, v):
    """The cotangent of the base u of w = uᵛ: v uᵛ⁻¹ g, and 0 at u = v = 0.

    At u = v = 0 the derivative is 0 · ∞, and the power still has a slope in v.
    """
    undefined = f("and", f("eq", u, c(0.0)), f("eq", v, c(0.0)))
    return f("mul", g, _choose_value(f, undefined, c(0.0), f("mul", v, f("pow", u, f("sub", v, c(1.0))))))


def _power_by_exponent(f, c, g, w, u, v):
    """The cotangent of the exponent v of w = uᵛ: w log(u) g, and 0 at u = 0."""
    return f("mul", g, f("mul", w, f("log", _choose_value(f, f("eq", u, c(0.0)), c(1.0), u))))


# ---- rows that are alike ---------------------------------------------------------------------------------------------


def _comparison(name: str, value: Callable, symbol: str, sign: str, commutative: bool = False) -> Operation:
    latex = f"{{0}} {sign} {{1}}"
    return Operation(
        name, 2, value, lambda code, a, b: code.compare(symbol, a, b), simplify=_simplify.compare,
        commutative=commutative, is_logical=True, is_step=True, side=_whole, text=f"{{0}} {symbol} {{1}}", latex=latex,
    )  # fmt: skip


def _bitwise(
    name: str, value: Callable, llvm: Callable, sign: str, latex: str, simplify: Callable | None = _simplify.logical
) -> Operation:
    return Operation(
        name, 2, value, llvm, lax=f"bitwise_{name}", simplify=simplify, commutative=True, is_step=True,
        text=f"({{0}}) {sign} ({{1}})", latex=f"{{0}} {latex} {{1}}",
    )  # fmt: skip


def _constant_row(
    name: str, value: Callable, llvm: Callable, simplify: Callable | None = None, **texts: Any
) -> Operation:
    return Operation(name, 1, value, llvm, simplify=simplify, is_step=True, exact=True, side=_whole, **texts)


def _intrinsic(name: str) -> Callable:
    return lambda code, *xs: code.intrinsic(name, *xs)


def _smooth_map(name: str, value: Callable, slope: Callable, llvm: str | Callable | None = None, **rest) -> Operation:
    """The row of a smooth function of one number; its machine code calls the C library unless `llvm` is given."""
    return Operation(name, 1, value, name if llvm is None else llvm, slopes=(slope,), **rest)


_odd, _even = _simplify.odd, _simplify.even

_ROWS = (
    # Arithmetic
    Operation(
        "add", 2, np.add, lambda code, a, b: a + b, simplify=_simplify.add, commutative=True,
        recurrence=_recurrences.add, cotangents=(lambda f, c, g, w, u, v: g, lambda f, c, g, w, u, v: g),
        c="{0} + {1}",
    ),
    Operation(
        "sub", 2, np.subtract, lambda code, a, b: a - b, simplify=_simplify.subtract,
        recurrence=_recurrences.add, cotangents=(lambda f, c, g, w, u, v: g, lambda f, c, g, w, u, v: f("neg", g)),
        c="{0} - {1}",
    ),
    Operation(
        "mul", 2, np.multiply, lambda code, a, b: a * b, simplify=_simplify.multiply, commutative=True,
        recurrence=_recurrences.multiply, slopes=(lambda f, c, w, u, v: v, lambda f, c, w, u, v: u),
        c="{0} * {1}",
    ),
    Operation(
        "div", 2, _divide, lambda code, a, b: a / b, simplify=_simplify.divide,
        recurrence=_recurrences.divide,
        cotangents=(
            lambda f, c, g, w, u, v: f("div", g, v),
            lambda f, c, g, w, u, v: f("neg", f("div", f("mul", g, w), v)),
        ),
        c="{0} / {1}",
    ),
    Operation(
        "neg", 1, np.negative, lambda code, a: -a, simplify=_simplify.negate, exact=True,
        recurrence=lambda r, i, operands, of: r.order_recursion.apply("neg", of[0]),
        cotangents=(lambda f, c, g, w, u: f("neg", g),), c="-{0}",
    ),
    Operation(
        "rem", 2, _remainder, "fmod", exact=True, recurrence=_recurrences.remainder,
        slopes=(lambda f, c, w, u, v: c(1.0), lambda f, c, w, u, v: f("neg", _whole_part(f, w, u, v))),
        side=lambda f, c, w, u, v: _whole_part(f, w, u, v),
    ),
    Operation(
        "pow", 2, np.power, "pow", simplify=_simplify.raise_to_power, steep=True,
        recurrence=_recurrences.raise_to_power,
        slopes=(
            lambda f, c, w, u, v: f("div", f("mul", v, w), u),
            lambda f, c, w, u, v: f("mul", w, f("log", u)),
        ),
        cotangents=(_power_by_base, _power_by_exponent),
    ),
    # Roots
    _smooth_map("sqrt", np.sqrt, lambda f, c, w, u: f("div", c(0.5), w), _intrinsic("sqrt"), steep=True,
              simplify=_simplify.root, recurrence=_recurrences.square_root),
    _smooth_map("rsqrt", lambda x: 1 / np.sqrt(x), lambda f, c, w, u: f("div", f("mul", c(-0.5), w), u),
              lambda code, a: 1.0 / code.intrinsic("sqrt", a), simplify=_simplify.root, c="1.0 / sqrt({0})"),
    _smooth_map("cbrt", np.cbrt, lambda f, c, w, u: f("div", w, f("mul", c(3.0), u)), simplify=_odd, steep=True),
    # Exponentials
    _smooth_map("exp", np.exp, lambda f, c, w, u: w),
    _smooth_map("exp2", np.exp2, lambda f, c, w, u: f("mul", c(math.log(2.0)), w)),
    _smooth_map("expm1", np.expm1, lambda f, c, w, u: _one_plus(f, c, w)),
    _smooth_map("log", np.log, lambda f, c, w, u: _inverse(f, c, u)),
    _smooth_map("log1p", np.log1p, lambda f, c, w, u: _inverse(f, c, _one_plus(f, c, u))),
    _smooth_map("logistic", lambda x: 1 / (1 + np.exp(-x)), lambda f, c, w, u: f("sub", w, _square(f, w)),
              lambda code, a: 1.0 / (1.0 + code.library("exp", -a)), c="1.0 / (1.0 + exp(-{0}))"),
    Operation(
        "logaddexp", 2, np.logaddexp, _log_of_sum, commutative=True,
        slopes=(
            lambda f, c, w, u, v: f("logistic", f("sub", u, v)),
            lambda f, c, w, u, v: f("logistic", f("sub", v, u)),
        ),
        latex=r"\log\left(e^{{{0}}} + e^{{{1}}}\right)",
    ),
    _smooth_map("erf", np.vectorize(math.erf, otypes=[float]), lambda f, c, w, u: _gauss(f, c, u), simplify=_odd),
    _smooth_map("erfc", np.vectorize(math.erfc, otypes=[float]), lambda f, c, w, u: f("neg", _gauss(f, c, u))),
    # Circular functions
    _smooth_map("sin", np.sin, lambda f, c, w, u: f("cos", u), simplify=_odd),
    _smooth_map("cos", np.cos, lambda f, c, w, u: f("neg", f("sin", u)), simplify=_even),
    _smooth_map("tan", np.tan, lambda f, c, w, u: _one_plus(f, c, _square(f, w)), simplify=_odd),
    _smooth_map("asin", np.arcsin, lambda f, c, w, u: _inverse_root(f, c, _one_minus_square(f, c, u)),
              simplify=_odd, steep=True),
    _smooth_map("acos", np.arccos, lambda f, c, w, u: f("neg", _inverse_root(f, c, _one_minus_square(f, c, u))),
              steep=True),
    _smooth_map("atan", np.arctan, lambda f, c, w, u: _inverse(f, c, _one_plus(f, c, _square(f, u))), simplify=_odd),
    Operation(
        "atan2", 2, np.arctan2, "atan2", simplify=_simplify.angle, steep=True,
        slopes=(
            lambda f, c, w, y, x: f("div", x, _radius_squared(f, y, x)),
            lambda f, c, w, y, x: f("neg", f("div", y, _radius_squared(f, y, x))),
        ),
        side=lambda f, c, w, y, x: f("and", f("lt", x, c(0.0)), f("lt", y, c(0.0))),
    ),
    # Hyperbolic functions
    _smooth_map("sinh", np.sinh, lambda f, c, w, u: f("cosh", u), simplify=_odd),
    _smooth_map("cosh", np.cosh, lambda f, c, w, u: f("sinh", u), simplify=_even),
    _smooth_map("tanh", np.tanh, lambda f, c, w, u: _one_minus_square(f, c, w), simplify=_odd),
    _smooth_map("asinh", np.arcsinh, lambda f, c, w, u: _inverse_root(f, c, _one_plus(f, c, _square(f, u))),
              simplify=_odd),
    _smooth_map("acosh", np.arccosh, lambda f, c, w, u: _inverse_root(f, c, _square_minus_one(f, c, u)), steep=True),
    _smooth_map("atanh", np.arctanh, lambda f, c, w, u: _inverse(f, c, _one_minus_square(f, c, u)), simplify=_odd),
    # Pieces
    Operation(
        "abs", 1, np.abs, _intrinsic("fabs"), simplify=_even, exact=True, recurrence=_recurrences.absolute,
        c="fabs({0})", latex=r"\left|{0}\right|",
        slopes=(lambda f, c, w, u: f("select", f("ge", u, c(0.0)), c(-1.0), c(1.0)),),  # at zero too, as in JAX
        side=lambda f, c, w, u: f("ge", u, c(0.0)),
    ),
    Operation(
        "max", 2, np.maximum, _intrinsic("maximum"), simplify=_simplify.extremum, commutative=True, exact=True,
        recurrence=_recurrences.extremum("gt"),
        cotangents=(lambda f, c, g, w, u, v: _share(f, c, g, u, v), lambda f, c, g, w, u, v: _share(f, c, g, v, u)),
        side=_is_larger, c="maximum({0}, {1})", latex=r"\max\left({0}, {1}\right)",
    ),
    Operation(
        "min", 2, np.minimum, _intrinsic("minimum"), simplify=_simplify.extremum, commutative=True, exact=True,
        recurrence=_recurrences.extremum("lt"),
        cotangents=(lambda f, c, g, w, u, v: _share(f, c, g, v, u), lambda f, c, g, w, u, v: _share(f, c, g, u, v)),
        side=_is_larger, c="minimum({0}, {1})", latex=r"\min\left({0}, {1}\right)",
    ),
    _constant_row("sign", np.sign, lambda code, x: code.select(x > 0.0, 1.0, code.select(x < 0.0, -1.0, x)), _odd,
          c="({0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0})"),
    _constant_row("floor", np.floor, _intrinsic("floor"), latex=r"\left\lfloor{0}\right\rfloor"),
    _constant_row("ceil", np.ceil, _intrinsic("ceil"), latex=r"\left\lceil{0}\right\rceil"),
    _constant_row("trunc", np.trunc, _intrinsic("trunc")),
    # The largest power of two that is at most |x|, and 1 for 0: for weights that do not change what is computed with
    # them. It has therefore no side: no step has to end where it jumps.
    Operation(
        "binade", 1, _power_of_two,
        lambda code, x: code.library("exp2", code.library("logb", code.select(code.compare("==", x, 0.0), 1.0, x))),
        is_step=True, exact=True, c="exp2(logb({0} == 0.0 ? 1.0 : {0}))",
    ),
    _constant_row("round", _round, lambda code, x, method: code.intrinsic("rint" if method == 1 else "round", x),
          c="{rounds}({0})"),
    Operation(
        "select", 3, _select, lambda code, predicate, no, yes: code.select(predicate, yes, no), lax="select_n",
        simplify=_simplify.select, exact=True, recurrence=_recurrences.select,
        cotangents=(
            None,
            lambda f, c, g, w, p, no, yes: _choose_value(f, p, c(0.0), g),
            lambda f, c, g, w, p, no, yes: _choose_value(f, p, g, c(0.0)),
        ),
        c="({0} ? {2} : {1})", text="where({0}, {2}, {1})",
        latex=r"\begin{{cases}} {2} & {0} \\ {1} & \text{{otherwise}} \end{{cases}}",
    ),
    Operation(
        "convert", 1, lambda x, kind: x, None, lax="convert_element_type", simplify=_simplify.convert, exact=True,
        cotangents=(lambda f, c, g, w, u: g,),
    ),
    # Logic
    Operation(
        "is_finite", 1, np.isfinite, lambda code, x: code.intrinsic("fabs", x) < float("inf"), is_logical=True,
        is_step=True, c="fabs({0}) < INFINITY",
    ),
    _comparison("eq", np.equal, "==", "=", commutative=True),
    _comparison("ne", np.not_equal, "!=", "\\ne", commutative=True),
    _comparison("lt", np.less, "<", "<"),
    _comparison("le", np.less_equal, "<=", "\\le"),
    _comparison("gt", np.greater, ">", ">"),
    _comparison("ge", np.greater_equal, ">=", "\\ge"),
    # u > v, where it chooses between two ways to the same number: it has no side, and no step ends where it jumps.
    Operation(
        "prefers", 2, np.greater, lambda code, a, b: code.compare(">", a, b), lax="gt", is_logical=True, is_step=True,
        text="{0} > {1}", latex="{0} > {1}",
    ),
    _bitwise("and", np.bitwise_and, lambda code, a, b: a & b, "&", r"\land"),
    _bitwise("or", np.bitwise_or, lambda code, a, b: a | b, "|", r"\lor"),
    _bitwise("xor", np.bitwise_xor, lambda code, a, b: (a | b) & ~(a & b), "^", r"\oplus", simplify=None),
    Operation(
        "not", 1, np.invert, lambda code, a: ~a, lax="bitwise_not", simplify=_simplify.invert, is_step=True,
        c="!{0}", text="~({0})", latex=r"\lnot {0}",
    ),
)  # fmt: skip

# What may come near the largest double where nothing else does, and what does not whatever its operand is.
COMPARISONS = ("lt", "le", "gt", "ge")
GROWING = frozenset(("exp", "exp2", "expm1", "sinh", "cosh"))
BOUNDED = frozenset(("sin", "cos", "tanh", "logistic", "erf", "erfc", "atan", "atan2", "log", "log1p", "asinh"))
# What may be infinite, or no number, besides what is `steep`.
WILD = GROWING | {"div", "rem", "log", "log1p", "rsqrt", "atanh"}

# What has a slope of zero where its operand is infinite, on one side at least; and what is infinite itself there, and
# has a slope that is rounded to zero.
FLAT_FAR_OUT = frozenset(("exp", "exp2", "expm1", "tanh", "logistic", "erf", "erfc", "atan", "rsqrt"))
SLOW_FAR_OUT = frozenset(("log", "log1p", "asinh", "acosh", "sqrt", "cbrt"))


def is_function(op: str) -> bool:
    """True for an operation w = f(u) whose Taylor series follows from its slopes, not from a recurrence of its own."""
    return bool(OPERATIONS[op].slopes) and OPERATIONS[op].recurrence is None


# Look-ups in tables (`_look_ups`): their operand is a number, and a whole array stands in their attribute.
LOOK_UPS = {name: Operation(name, 1, _refuse_look_up, None, is_step=True, exact=True) for name in ("take", "locate")}


class _OperationTable(dict):
    """The rows of the elementwise operations by name; indexing also finds look-ups, iteration leaves them out."""

    def __missing__(self, name: str) -> Operation:
        return LOOK_UPS[name]


OPERATIONS: dict[str, Operation] = _OperationTable({row.name: row for row in _ROWS})
