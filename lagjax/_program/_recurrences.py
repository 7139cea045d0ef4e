"""The order recursion of the operations that have one of their own: arithmetic, roots and what is made of pieces.

A rule takes the recurrences under construction (`_series._Recurrences`), the id of the result in the program, the ids
of the operands, and their Taylor coefficients of order k (nodes of the sweep; None for an operand that is constant
along the motion, though never for all of them). It returns the coefficient of order k of the result. Every other
operation is w = f(u) and follows from its slopes.
"""

import math
from collections.abc import Callable


def add(r, i, operands, of):
    """wₖ = uₖ ± vₖ."""
    op, (a, b) = r.start.nodes[i][0], of
    if b is None:
        return a
    if a is None:
        return b if op == "add" else r.sweep.apply("neg", b)
    return r.sweep.apply(op, a, b)


def negate(r, i, operands, of):
    """wₖ = −uₖ."""
    return r.sweep.apply("neg", of[0])


def multiply(r, i, operands, of):
    """wₖ = u₀ vₖ + uₖ v₀ + Σ' uⱼ vₖ₋ⱼ."""
    (u, v), (a, b), apply = operands, of, r.sweep.apply
    if a is None:
        return apply("mul", r.value(u), b)
    if b is None:
        return apply("mul", r.value(v), a)
    if u == v:
        outer = apply("mul", r.value(r.start.apply("mul", r.number(2.0), u)), a)
    else:
        outer = apply("add", apply("mul", r.value(u), b), apply("mul", r.value(v), a))
    return apply("add", outer, r.product(u, v))


def divide(r, i, operands, of):
    """wₖ = (uₖ − w₀ vₖ − Σ' wⱼ vₖ₋ⱼ) / v₀."""
    (_, v), (a, b), apply = operands, of, r.sweep.apply
    inverse = r.value(r.start.apply("div", r.number(1.0), v))
    if b is None:
        return apply("mul", a, inverse)
    taken = apply("add", apply("mul", r.value(i), b), r.product(i, v))
    return apply("mul", apply("neg", taken) if a is None else apply("sub", a, taken), inverse)


def square_root(r, i, operands, of):
    """wₖ = (uₖ − Σ' wⱼ wₖ₋ⱼ) / 2 w₀."""
    half_inverse = r.value(finite(r.start.apply, r.number, r.start.apply("div", r.number(0.5), i)))
    return r.sweep.apply("mul", r.sweep.apply("sub", of[0], r.product(i, i)), half_inverse)


def finite(f, c, slope):
    """0 for a slope that is infinite, or 0/0, where the function itself is not: there is no series there.

    It may not be needed, as on the flat side of max(q, 0)**1.5; where it is, the step fails its check.
    """
    return f("select", f("is_finite", slope), c(0.0), slope)


def remainder(r, i, operands, of):
    """wₖ = uₖ − n vₖ, with the whole number n that is right at order zero."""
    (u, v), (a, b), f = operands, of, r.start.apply
    if b is None:
        return a
    taken = r.sweep.apply("mul", r.value(f("round", f("div", f("sub", u, i), v), attribute=1)), b)
    return r.sweep.apply("neg", taken) if a is None else r.sweep.apply("sub", a, taken)


def select(r, i, operands, of):
    """The coefficient of the branch that is taken at order zero."""
    predicate, no, yes = operands
    for branch, other in ((no, yes), (yes, no)):
        number = r.start.value(other)
        if number is not None and math.isnan(number):  # a guard: NaN shows at order zero
            return of[1:][branch == yes]
    zero = r.sweep.constant(0.0, "float")
    return _choose(r, predicate, *(zero if c is None else c for c in of[1:]))


def _choose(r, predicate: int, no: int, yes: int) -> int:
    """`yes` where the predicate, a node of the program, holds at order zero, else `no`."""
    flag = r.start.apply("select", predicate, r.number(0.0), r.number(1.0))
    holds = r.sweep.apply("gt", r.value(flag), r.sweep.constant(0.5, "float"))
    return r.sweep.apply("select", holds, no, yes)


def absolute(r, i, operands, of):
    """wₖ = ±uₖ, with the sign of u₀."""
    below = r.start.apply("lt", operands[0], r.number(0.0))
    return _choose(r, below, of[0], r.sweep.apply("neg", of[0]))


def extremum(comparison: str) -> Callable:
    """The coefficient of the operand that is larger (`gt`) or smaller (`lt`) at order zero."""

    def rule(r, i, operands, of):
        zero = r.sweep.constant(0.0, "float")
        a, b = (zero if c is None else c for c in of)
        return _choose(r, r.start.apply(comparison, *operands), b, a)

    return rule
