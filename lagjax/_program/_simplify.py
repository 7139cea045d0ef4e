"""Algebraic simplification: one rule for every operation that has a simpler form for some operands.

A rule takes the graph, the name of the operation and the ids of its operands, not all of them constant, and returns the
id of the simplest node with the same value. It builds nodes by `Graph.apply` where they may simplify further, and by
`Graph.node` where they are final.
"""

import math

import numpy as np


def add(graph, op, a, b):
    """x + 0 is x; like terms are collected; `select(p, 0, x) + select(p, y, 0)` is one selection."""
    if graph.value(a) == 0:
        return b
    if graph.value(b) == 0:
        return a
    (of_a, x, _), (of_b, y, _) = graph.nodes[a], graph.nodes[b]
    if of_a == of_b == "select" and x[0] == y[0]:
        for (_, no, yes), (_, other, zero) in ((x, y), (y, x)):
            if graph.value(no) == 0 and graph.value(zero) == 0:
                return select(graph, "select", x[0], other, yes)
    return graph.sum(a, b, 1) if graph.kinds[a] == "float" else graph.node(op, a, b)


def subtract(graph, op, a, b):
    """x − 0 is x, 0 − x is −x; like terms are collected."""
    if graph.value(b) == 0:
        return a
    if graph.value(a) == 0:
        return negate(graph, "neg", b)
    return graph.sum(a, b, -1) if graph.kinds[a] == "float" else graph.node(op, a, b)


def negate(graph, op, a):
    """−(−x) is x."""
    if (value := graph.value(a)) is not None:
        return graph.constant(np.negative(np.dtype(graph.kinds[a]).type(value)), graph.kinds[a])
    positive = graph.operand_of("neg", a)
    return graph.node("neg", a) if positive is None else positive


def multiply(graph, op, a, b):
    """0 x is 0, 1 x is x; constants are multiplied, signs become outer negations, equal products are one node."""
    if graph.value(a) == 0 or graph.value(b) == 0:
        return graph.constant(0, graph.kinds[a])
    if graph.kinds[a] != "float":
        return b if graph.value(a) == 1 else a if graph.value(b) == 1 else graph.node("mul", a, b)
    for constant, other in ((a, b), (b, a)):
        if (value := graph.value(constant)) is not None and value == value:
            coefficient, base = graph.term(other)
            return (
                graph.scale(value * coefficient, base) if _is_in_range(value, coefficient) else graph.node("mul", a, b)
            )
    (m, x), (n, y) = graph.term(a), graph.term(b)
    if (
        abs(m) != 1 and abs(n) != 1 and _is_in_range(m, n)
    ):  # two constant factors become one; a single one stays where it can be shared
        return graph.scale(m * n, graph.product(x, y))
    if m < 0 or n < 0:
        return graph.scale(math.copysign(1, m * n), multiply(graph, op, graph.scale(abs(m), x), graph.scale(abs(n), y)))
    for x, quotient in ((a, b), (b, a)):  # x · (c / |x|)
        divided, operands, _ = graph.nodes[quotient]
        if divided == "div" and (sign := direction(graph, x, operands[1])) is not None:
            return graph.apply("mul", operands[0], sign)
    return graph.product(a, b)


def _is_in_range(m: float, n: float) -> bool:
    """True where the product m n of constants is far from overflow and underflow, so that combining them is safe."""
    return not (m and n) or 1e-290 < abs(m * n) < math.inf or abs(n) == 1


def divide(graph, op, a, b):
    """0 / x is 0; division by a power of two is a product; signs become outer negations; (x / √u) / √u is x / u."""
    if graph.value(a) == 0:
        return a
    divisor = graph.value(b)
    if graph.kinds[a] != "float":
        return a if divisor == 1 else graph.node("div", a, b)
    if divisor and abs(math.frexp(divisor)[0]) == 0.5:  # a power of two: multiplying by its inverse is exact
        return multiply(graph, "mul", a, graph.constant(1 / divisor, "float"))
    if (positive := graph.operand_of("neg", a)) is not None:
        return negate(graph, "neg", divide(graph, op, positive, b))
    if (positive := graph.operand_of("neg", b)) is not None:
        return negate(graph, "neg", divide(graph, op, a, positive))
    if (square := graph.operand_of("sqrt", b)) is not None and graph.nodes[a][0] == "div" and graph.nodes[a][1][1] == b:
        return graph.apply("div", graph.nodes[a][1][0], square)
    return graph.node("div", a, b) if (sign := direction(graph, a, b)) is None else sign


def direction(graph, a, b):
    """The node of x / |x|, or of a multiple, as the sign of x, which is defined at zero; None for other quotients."""
    (m, x), (n, size) = graph.term(a), graph.term(b)
    if (of := graph.operand_of("abs", size)) is None:
        return None
    k, base = graph.term(of)
    return graph.scale(m / (n * abs(k)), graph.apply("sign", x)) if x == base else None


def root(graph, op, a):
    """√(x²) is |x|, which is smooth on either side of zero; and 1/√(x²) is 1/|x|."""
    of, operands, _ = graph.nodes[a]
    if of != "mul" or operands[0] != operands[1]:
        return graph.node(op, a)
    size = graph.apply("abs", operands[0])
    return size if op == "sqrt" else graph.apply("div", graph.constant(1.0, "float"), size)


def raise_to_power(graph, op, a, b):
    """Whole and half exponents up to 16 become products and a root: more exact than `pow`, and many times faster."""
    exponent = graph.value(b)
    if exponent is None or abs(exponent) > 16 or (2 * exponent) % 1:
        return graph.node("pow", a, b)
    result = _positive_power(graph, a, int(abs(exponent)))
    if exponent % 1:
        result = graph.apply("mul", result, graph.apply("sqrt", a))
    if exponent < 0:
        result = graph.apply("div", graph.constant(1, "float"), result)
    return _record_power(graph, a, exponent, result)


def whole_power(graph, a: int, exponent: int) -> int:
    """The node of `a**exponent` for a whole exponent of any sign."""
    result = _positive_power(graph, a, abs(exponent))
    if exponent < 0:
        result = graph.apply("div", graph.constant(1.0, graph.kinds[a]), result)
    return _record_power(graph, a, exponent, result)


def _record_power(graph, a: int, exponent: float, result: int) -> int:
    """Record that node `result` is `a**exponent`, to be differentiated as a power, not as a product; return it.

    Nothing is recorded if the node is older than `a`: differentiation goes through the nodes in their order.
    """
    if a < result and exponent not in (0, 0.5, 1) and graph.kinds[a] == "float" and graph.value(result) is None:
        graph.powers.setdefault(result, (a, exponent))
    return result


def _positive_power(graph, a: int, exponent: int) -> int:
    """The node of `a**exponent` for a whole exponent ≥ 0, by repeated squaring, so that powers of `a` share squares."""
    result = graph.constant(1, graph.kinds[a])
    while exponent:
        if exponent & 1:
            result = graph.apply("mul", result, a)
        exponent >>= 1
        if exponent:
            a = graph.apply("mul", a, a)
    return result


def odd(graph, op, a):
    """Simplify an odd function: f(−x) is −f(x)."""
    positive = graph.operand_of("neg", a)
    return graph.node(op, a) if positive is None else negate(graph, "neg", graph.node(op, positive))


def even(graph, op, a):
    """Simplify an even function: f(−x) is f(x)."""
    positive = graph.operand_of("neg", a)
    return graph.node(op, a if positive is None else positive)


def extremum(graph, op, a, b):
    """max(x, x) is x; of bools, max is `or` and min is `and`."""
    if graph.kinds[a] == "bool":
        return graph.apply("or" if op == "max" else "and", a, b)
    return a if a == b else graph.node(op, a, b)


def logical(graph, op, a, b):
    """`p and p` is p, `p and True` is p, `p and False` is False; `or` likewise."""
    if a == b:
        return a
    for x, y in ((a, b), (b, a)):
        if graph.kinds[x] == "bool" and (value := graph.value(x)) is not None:
            return x if value == (op == "or") else y
    return graph.node(op, a, b)


def invert(graph, op, a):
    """`not not p` is p."""
    original = graph.operand_of("not", a)
    return graph.node("not", a) if original is None else original


def select(graph, op, predicate, no, yes):
    """The taken branch of a known predicate; the only branch of two equal ones; the predicate if it is the result.

    A branch that is itself a selection by the same predicate is replaced by its branch. `where(x == 0, 0, x)` is x: the
    series of the constant branch would be that of zero.
    """
    known = graph.value(predicate)
    if known is not None or no == yes:
        return yes if known else no
    if (original := graph.operand_of("not", predicate)) is not None:
        return select(graph, op, original, yes, no)
    for side, x in enumerate((no, yes)):
        if graph.nodes[x][0] == "select" and graph.nodes[x][1][0] == predicate:
            return select(graph, op, predicate, *(graph.nodes[x][1][1 + side] if y == x else y for y in (no, yes)))
    compared, operands, _ = graph.nodes[predicate]
    if compared in ("eq", "ne") and {no, yes} == {*operands}:  # both are the same number where they are equal
        return no if compared == "eq" else yes
    if compared == "ne" and operands == (no, no) and math.isnan(graph.value(yes) or 0.0):
        return no
    if graph.kinds[no] == "bool" and (graph.value(no), graph.value(yes)) == (False, True):
        return predicate
    if graph.kinds[no] == "bool" and (graph.value(no), graph.value(yes)) == (True, False):
        return invert(graph, "not", predicate)
    return graph.node("select", predicate, no, yes)


def convert(graph, op, a, kind):
    return a if graph.kinds[a] == kind else graph.node("convert", a, attribute=kind)


def compare(graph, op, a, b):
    """`int(p) > 0` is `p`: the predicates of `lax.cond` and `lax.switch` are written like this."""
    for i, other in ((a, b), (b, a)):
        flag = graph.operand_of("convert", i)
        if flag is not None and graph.kinds[flag] == "bool" and graph.value(other) is not None:
            cases = [graph.constant(value, graph.kinds[i]) for value in (0, 1)]
            return select(graph, "select", flag, *(graph.apply(op, *((c, b) if i == a else (a, c))) for c in cases))
    return graph.node(op, a, b)


# ---- angles ----------------------------------------------------------------------------------------------------------

_MOST_WHOLE_TURNS = 2.0**48  # of 2π: a quarter of a radian is rounding; doubled, a half
_DEEPEST = 40  # operations one in the other, beyond which no sign and no quotient is looked for: a bound of the work
_NEVER_NEGATIVE = frozenset(("exp", "exp2", "cosh", "logistic", "erfc", "sqrt", "rsqrt", "abs", "acos"))


def is_nonnegative(graph, i: int, depth: int = _DEEPEST) -> bool:
    """True if node i is nonnegative by its form: a square, exp, |x|, sums and products of these, …"""
    op, operands, attribute = graph.nodes[i]
    if op == "constant" or not depth:
        return op == "constant" and attribute >= 0
    if op == "integer_pow" and attribute % 2 == 0:
        return True
    if op == "mul" and operands[0] == operands[1]:
        return True
    each = [is_nonnegative(graph, x, depth - 1) for x in operands] if op in _BY_OPERANDS else []
    return op in _NEVER_NEGATIVE or (any(each) if op == "max" else bool(each) and all(each[op == "select" :]))


_BY_OPERANDS = frozenset(("add", "mul", "div", "max", "min", "select", "integer_pow", "pow"))


def angle(graph, op, y, x):
    """atan2(c sin u, c cos u) is u reduced to (−π, π]."""
    (m, sine), (n, cosine) = graph.term(y), graph.term(x)
    u, v = graph.operand_of("sin", sine), graph.operand_of("cos", cosine)
    if u is None or u != v or abs(m) != n:
        return graph.node(op, y, x)
    return graph.scale(math.copysign(1.0, m), _period_remainder(graph, u, 2 * math.pi))


def arctangent(graph, u: int) -> int:
    """The node of atan(u). For u = y/x with x of varying sign: atan2(±y, ±x), which jumps at x = 0 without a pole."""
    f, zero, one = graph.apply, graph.constant(0.0, "float"), graph.constant(1.0, "float")
    if (angle := graph.operand_of("tan", u)) is not None:
        return _period_remainder(graph, angle, math.pi)
    y, x = _split_quotient(graph, u, _DEEPEST)
    if x is None or graph.value(x) is not None:
        return f("atan", u)
    sign = f("select", f("lt", x, zero), one, graph.constant(-1.0, "float"))
    undefined = f("and", f("eq", x, zero), f("eq", y, zero))
    angle = f("atan2", f("mul", sign, y), f("abs", x))
    return f("select", undefined, angle, graph.constant(math.nan, "float"))


def inverse(graph, x: int, op: str) -> int:
    """arccos or arcsin (`op`) of x: for cos u and sin u, |u| or ±u reduced by whole turns; else by arctangents."""
    of, operands, _ = graph.nodes[x]
    if of == "neg" and graph.nodes[operands[0]][0] in ("sin", "cos"):
        found = inverse(graph, operands[0], op)
        return (
            graph.apply("neg", found) if op == "asin" else graph.apply("sub", graph.constant(math.pi, "float"), found)
        )
    if of == "cos":
        found = graph.apply("abs", _period_remainder(graph, operands[0], 2 * math.pi))
    elif of == "sin":
        whole, one = _count_periods(graph, operands[0], math.pi), graph.constant(1.0, "float")
        halves = graph.apply("floor", graph.scale(0.5, whole))
        parity = graph.apply("sub", whole, graph.scale(2.0, halves))
        side = graph.apply("sub", one, graph.scale(2.0, parity))
        found = graph.apply("mul", side, _period_remainder(graph, operands[0], math.pi))
    else:
        return graph.apply(op, x)
    if (of, op) in (("cos", "acos"), ("sin", "asin")):
        return found
    return graph.apply("sub", graph.constant(math.pi / 2, "float"), found)


def _period_remainder(graph, u: int, period: float) -> int:
    """The node of u minus the nearest multiple of `period`: from −½ period to ½ period."""
    return graph.apply("sub", u, graph.scale(period, _count_periods(graph, u, period)))


def _count_periods(graph, u: int, period: float) -> int:
    """The whole number nearest to u / period; u is scaled by 1 − 2⁻⁵¹ so that ±½ period, as rounded, counts as 0.

    NaN beyond `_MOST_WHOLE_TURNS`, where the digits of u do not determine the remainder.
    """
    f, number = graph.apply, lambda x: graph.constant(x, "float")
    wholes = f("floor", f("add", f("mul", number((1 - 2.0**-51) / period), u), number(0.5)))
    return f("select", f("lt", f("abs", wholes), number(_MOST_WHOLE_TURNS)), number(math.nan), wholes)


def _split_quotient(graph, i: int, depth: int) -> tuple[int, int | None]:
    """Numerator and denominator of node i if it has poles where the denominator changes its sign; else i, None."""
    op, operands, exponent = graph.nodes[i]
    f, one = graph.apply, graph.constant(1.0, "float")
    if op == "tan":
        return f("sin", *operands), f("cos", *operands)
    if op == "pow" and (graph.value(operands[1]) or 0.0) % 2 == 1:
        op, operands, exponent = "integer_pow", operands[:1], int(graph.value(operands[1]))
    if not depth or op not in ("neg", "add", "sub", "mul", "div", "select", "integer_pow"):
        return i, None
    parts = [_split_quotient(graph, x, depth - 1) for x in operands[op == "select" :]]
    divides = op == "div" or (op == "integer_pow" and exponent < 0)
    if all(d is None for _, d in parts) and not (divides and not is_nonnegative(graph, operands[-1])):
        return i, None
    (n, d), (m, e) = ((n, one if d is None else d) for n, d in (parts[0], parts[-1]))
    if op == "neg":
        return f("neg", n), d
    if op == "integer_pow":
        n, d = (graph.power(x, abs(exponent)) for x in ((d, n) if divides else (n, d)))
        return n, d
    if op == "div":
        return f("mul", n, e), f("mul", d, m)
    if op == "mul":
        return f("mul", n, m), f("mul", d, e)
    if op == "select":
        return f("select", operands[0], n, m), f("select", operands[0], d, e)
    if d == e:
        return f(op, n, m), d
    return f(op, f("mul", n, e), f("mul", m, d)), f("mul", d, e)
