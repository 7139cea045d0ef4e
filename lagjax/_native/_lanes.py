"""The operations of a scalar program on vectors, one lane for each member of a batch."""

from collections.abc import Callable

from llvmlite import ir

from lagjax._digits import COS, PI_2, PI_2_ROUNDED, SIN
from lagjax._native._constants import LARGEST_ANGLE
from lagjax._native._ir import BIT, Code, Value
from lagjax._program._graph import Unlowerable
from lagjax._program._operations import OPERATIONS
from lagjax._program._series import StraightLine


def emit(code: Code, line: StraightLine, inputs: Callable[[int], Value], sincos: Code | None) -> list[Value]:
    """The outputs of a straight line; `inputs(i)` is its i-th input, as a vector. Integers are doubles here."""
    values: list[Value] = []
    turns: dict[int, tuple[Value, Value]] = {}
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        xs = [values[i] for i in operands]
        if op == "input":
            value = inputs(attribute)
            if kind == "bool":
                value = code.compare("!=", value, 0.0)
        elif op == "constant":
            value = code.as_value(attribute, code.vector if kind != "bool" else ir.VectorType(BIT, code.lanes))
        elif op in ("sin", "cos") and sincos is not None:
            if operands[0] not in turns:
                turns[operands[0]] = _both(code, sincos, xs[0])
            value = turns[operands[0]][op == "cos"]
        elif op == "convert":
            value = _convert(code, xs[0], line.kinds[operands[0]], kind)
        else:
            value = _apply(code, op, xs, attribute)
        values.append(value)
    return [values[i] for i in line.outputs]


def _apply(code: Code, op: str, xs: list[Value], attribute) -> Value:
    """An operation by its row: of the C library, lane by lane, or written with vectors."""
    how = OPERATIONS[op].llvm
    if how is None:
        raise Unlowerable(f"`{op}` has no machine code here")
    if isinstance(how, str):
        return code.library(how, *xs)
    return how(code, *xs) if attribute is None else how(code, *xs, attribute)


def _convert(code, x, before, after):
    if before == "bool":
        return code.as_double(x)
    if after == "bool":
        return code.compare("!=", x, 0.0)
    return code.intrinsic("trunc", x) if before == "float" and after != "float" else x


def sincos_function(module: ir.Module, lanes: int) -> Code:
    """`(x, address)`: sin x and cos x, stored one after the other.

    The method is that of `_elementary`: Cody and Waite's reduction, fdlibm's polynomials; 1 ulp. A vector with an angle
    beyond `LARGEST_ANGLE` asks the C library as well.
    """
    vector = ir.VectorType(ir.DoubleType(), lanes)
    code = Code(module, "sincos", [vector, ir.PointerType()], lanes)
    x, address = code.arguments
    near = code.intrinsic("fabs", x) <= LARGEST_ANGLE
    sine, cosine = _polynomials(code, code.select(near, x, 0.0))
    code.store(sine, address)
    code.store(cosine, code.element(address, lanes))
    # A lane must not depend on its neighbours: only the far ones are replaced.
    with code.only_if(code.any_lane(~near)):
        code.store(code.select(near, sine, code.library("sin", x)), address)
        code.store(code.select(near, cosine, code.library("cos", x)), code.element(address, lanes))
    return code.finish()


def _polynomials(code: Code, x: Value) -> tuple[Value, Value]:
    # k times a part of π/2 is exact, so contraction into a fused multiply-add changes nothing.
    first, second, third, fourth = PI_2
    k = code.intrinsic("rint", x * (1 / PI_2_ROUNDED[0]))
    head = x - k * first
    r = head - k * second
    tail = (head - r) - k * second
    # Once more, for angles next to a multiple of π/2, where r is all cancellation.
    head, r = r, r - k * third
    tail = tail + ((head - r) - k * third) - k * fourth
    z = r * r
    sine = r + (r * z * _horner(z, SIN) + tail)
    half = 0.5 * z
    one_less = 1.0 - half
    cosine = one_less + (((1.0 - one_less) - half) + (z * z * _horner(z, COS) - r * tail))
    quadrant = k - 4.0 * code.intrinsic("floor", 0.25 * k)  # 0, 1, 2, 3
    odd = code.compare("==", quadrant, 1.0) | code.compare("==", quadrant, 3.0)
    s, c = code.select(odd, cosine, sine), code.select(odd, sine, cosine)
    middle = code.compare("==", quadrant, 1.0) | code.compare("==", quadrant, 2.0)
    return code.select(quadrant > 1.5, -s, s), code.select(middle, -c, c)


def _horner(z, coefficients):
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = coefficient + z * total
    return total


def _both(code: Code, sincos: Code, x: Value) -> tuple[Value, Value]:
    with code.builder.goto_entry_block():
        place = code.builder.alloca(ir.ArrayType(code.vector, 2))
    place.align = 8 * code.lanes
    address = Value(code, place)
    code.call(sincos, x, address)
    return code.load(address, code.vector), code.load(code.element(address, code.lanes), code.vector)
