"""The order recursion of operations that are not w = f(u) by its slopes: arithmetic, roots, piecewise operations.

A rule takes the recurrences under construction (`_series._Recurrences`), the id of the result in the program, the ids
of the operands, and their Taylor coefficients of order k: nodes of the order recursion, None for an operand that is
constant along the motion (not all operands are). It returns the coefficient of order k of the result.
"""

import math
from collections.abc import Callable

_BITS = 4  # of whole exponents that are not known before a motion begins
# Of a base: below it terms of log u overflow in a long step, and the derivative by the exponent is infinite or NaN.
# Parts of a step past zero begin at some 1e-12.
_NEAR_ZERO = 1e-14
LARGEST_WHOLE = 2**_BITS  # beyond which a power is watched by its logarithm, which has no series where the base is zero


def add(r, i, operands, of):
    """Sum or difference: wₖ = uₖ ± vₖ."""
    op, (a, b) = r.zeroth_order.nodes[i][0], of
    if b is None:
        return a
    if a is None:
        return b if op == "add" else r.order_recursion.apply("neg", b)
    return r.order_recursion.apply(op, a, b)


def multiply(r, i, operands, of):
    """Product: wₖ = u₀ vₖ + uₖ v₀ + Σ' uⱼ vₖ₋ⱼ."""
    (u, v), (a, b), apply = operands, of, r.order_recursion.apply
    if a is None:
        return apply("mul", r.value(u), b)
    if b is None:
        return apply("mul", r.value(v), a)
    if u == v:
        outer = apply("mul", r.value(r.zeroth_order.apply("mul", r.number(2.0), u)), a)
    else:
        outer = apply("add", apply("mul", r.value(u), b), apply("mul", r.value(v), a))
    return apply("add", outer, r.cauchy_product(u, v))


def divide(r, i, operands, of):
    """Quotient: wₖ = (uₖ − w₀ vₖ − Σ' wⱼ vₖ₋ⱼ) / v₀."""
    (_, v), (a, b), apply = operands, of, r.order_recursion.apply
    inverse, w = r.zeroth_order.apply("div", r.number(1.0), v), i
    if i in r.steep:  # of which a number that is read but not taken has derivatives, too
        inverse, w = (finite(r.zeroth_order.apply, r.number, x) for x in (inverse, w))
    inverse = r.value(inverse)
    if b is None:
        return apply("mul", a, inverse)
    taken = apply("add", apply("mul", r.value(w), b), r.cauchy_product(i, v))
    return apply("mul", apply("neg", taken) if a is None else apply("sub", a, taken), inverse)


def square_root(r, i, operands, of):
    """Square root: wₖ = (uₖ − Σ' wⱼ wₖ₋ⱼ) / 2 w₀."""
    half_inverse = r.value(finite(r.zeroth_order.apply, r.number, r.zeroth_order.apply("div", r.number(0.5), i)))
    return r.order_recursion.apply("mul", r.order_recursion.apply("sub", of[0], r.cauchy_product(i, i)), half_inverse)


def raise_to_power(r, i, operands, of):
    """Power w = uᵛ: wₖ by its slopes, or, for whole v = n < 16, as that of the product uⁿ, which is finite at u = 0.

    An exponent that is an input is tested at order zero. The product is multiplied by exp((v − n) log u) = 1, which
    gives it a derivative by v, except where a step starts so near u = 0 that uⁿ log u has no usable series.
    """
    (u, v), (_, moves) = operands, of
    slow = r.apply_slopes(i, operands, of)
    if moves is not None or r.zeroth_order.value(v) is not None:
        return slow
    f, number = r.zeroth_order.apply, r.number
    zero, one, n = number(0.0), number(1.0), f("floor", v)
    product, power, rest = one, u, n
    for k in range(_BITS):
        half = f("floor", f("mul", number(0.5), rest))
        is_odd = f("gt", f("sub", rest, f("mul", number(2.0), half)), number(0.5))
        product = f("mul", product, f("select", is_odd, one, power))
        power, rest = f("mul", power, power) if k < _BITS - 1 else power, half
    size, rest_of_v = f("abs", u), f("sub", v, n)
    is_near = f("lt", size, number(_NEAR_ZERO))
    by_v = f("exp", f("mul", rest_of_v, f("log", f("select", is_near, size, one))))
    lost = f("select", is_near, zero, f("sqrt", rest_of_v))  # zero, and its slope is infinite
    product = f("mul", product, f("add", by_v, lost))
    is_whole = f("and", f("eq", v, n), f("eq", rest, zero))
    return choose(r, is_whole, slow, r.coefficient(product))


def finite(f, c, slope):
    """The slope, but 0 where it is infinite or 0/0 while the function is finite, because no series exists there.

    The zero is harmless on the flat side of max(q, 0)**1.5; where the slope is needed, the step fails its error check.
    """
    return f("select", f("is_finite", slope), c(0.0), slope)


def remainder(r, i, operands, of):
    """Remainder w = u − n v: wₖ = uₖ − n vₖ, with the whole number n of order zero."""
    (u, v), (a, b), f = operands, of, r.zeroth_order.apply
    if b is None:
        return a
    taken = r.order_recursion.apply("mul", r.value(f("round", f("div", f("sub", u, i), v), attribute=1)), b)
    return r.order_recursion.apply("neg", taken) if a is None else r.order_recursion.apply("sub", a, taken)


def select(r, i, operands, of):
    """Selection: the coefficient of the branch taken at order zero."""
    predicate, no, yes = operands
    for branch, other in ((no, yes), (yes, no)):
        number = r.zeroth_order.value(other)
        if number is not None and math.isnan(number):  # a guard: NaN shows at order zero
            return of[1:][branch == yes]
    zero = r.order_recursion.number(0.0)
    return choose(r, predicate, *(zero if c is None else c for c in of[1:]))


def choose(r, predicate: int, no: int, yes: int) -> int:
    """The node of `yes` where the predicate, a node of the program, is true at order zero, else of `no`."""
    flag = r.zeroth_order.apply("select", predicate, r.number(0.0), r.number(1.0))
    holds = r.order_recursion.apply("gt", r.value(flag), r.order_recursion.number(0.5))
    return r.order_recursion.apply("select", holds, no, yes)


def absolute(r, i, operands, of):
    """Absolute value: wₖ = ±uₖ, with the sign of u₀."""
    below = r.zeroth_order.apply("lt", operands[0], r.number(0.0))
    return choose(r, below, of[0], r.order_recursion.apply("neg", of[0]))


def extremum(comparison: str) -> Callable:
    """Rule of max (`comparison` "gt") or min ("lt"): the coefficient of the extreme operand at order zero."""

    def rule(r, i, operands, of):
        zero = r.order_recursion.number(0.0)
        a, b = (zero if c is None else c for c in of)
        return choose(r, r.zeroth_order.apply(comparison, *operands), b, a)

    return rule
