"""The operations of a scalar program on vectors, one lane per member of a batch."""

import functools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from llvmlite import ir

from lagjax._native.code._constants import LARGEST_ANGLE
from lagjax._native.code._frame import Frame, Numbers, Vectors
from lagjax._native.code._ir import BIT, DOUBLE, INTEGER, POINTER, Code, Value
from lagjax._program import LOOK_UPS, OPERATIONS, StraightLine, Unlowerable


class Lines:
    """The form of small kernels: every operation, for every component of the state, is emitted (else see `Tables`)."""

    def __init__(self, sincos: Code, look_up: Callable):
        self._sincos, self._look_up = sincos, look_up

    def run(
        self, frame: Frame, line: StraightLine, *inputs: "Sequence[Value] | Vectors", to: "Vectors | None" = None
    ) -> Numbers:
        """The outputs of a line for the concatenated `inputs`; a bool is 1 or 0. The last ones also go to `to`."""
        parts = [(values, i) for values in inputs for i in range(len(values))]

        def read(position):
            values, i = parts[position]
            return values[i]

        out = emit(frame.code, line, read, self._sincos, functools.partial(self._look_up, frame))
        kinds = (line.kinds[i] for i in line.outputs)
        out = [frame.code.as_number(x) if kind == "bool" else x for x, kind in zip(out, kinds, strict=True)]
        if to is not None:
            for i in range(len(to)):
                to[i] = out[len(out) - len(to) + i]
        return out

    def each(self, code: Code, count: int) -> Iterator[int]:
        """The Python integers below `count`: the body is emitted for each of them."""
        return iter(range(count))

    def component_groups(self, code: Code, n: int) -> Iterator[tuple[list, dict]]:
        """The components of a state (q, q̇) in groups of four; for the velocities in each {index: coordinate}."""
        for first in range(0, 2 * n, 4):
            some = list(range(first, min(first + 4, 2 * n)))
            yield some, {k: i - n for k, i in enumerate(some) if i >= n}

    def room(self, frame: Frame, count: int) -> Numbers:
        return [None] * count

    def largest(self, code: Code, numbers: Callable[[int], Value], count: int) -> Value:
        """The largest of `count` nonnegative numbers; NaN if the last one is NaN."""
        return functools.reduce(code.maximum, map(numbers, range(count)))

    def largest_by_group(self, frame: Frame, numbers: Callable[[int], Value], groups: Sequence[int]) -> Numbers:
        """For each number the largest one in its group, where `groups` has a group number for each."""
        largest: dict[int, Value] = {}
        for i, group in enumerate(groups):
            value = numbers(i)
            largest[group] = frame.code.maximum(largest[group], value) if group in largest else value
        return [largest[group] for group in groups]

    def prepare(self, frame: Frame) -> None:
        """Initialise the memory of a thread: nothing to do in this form."""

    def finish(self) -> None:
        """Complete the kernel after its last program: nothing to do in this form."""


def emit(
    code: Code, line: StraightLine, inputs: Callable[[int], Value], sincos: Code | None, look_up: Callable | None
) -> list[Value]:
    """Emit a line: input i is the vector `inputs(i)`, integers are doubles, `look_up` reads tables. Its outputs."""
    values: list[Value] = []
    turns: dict[int, tuple[Value, Value]] = {}
    for (op, operands, attribute), kind in zip(line.nodes, line.kinds, strict=True):
        xs = [values[i] for i in operands]
        if op == "input":
            value = code.lanes_of(inputs(attribute))
            if kind == "bool":
                value = code.compare("!=", value, 0.0)
        elif op == "constant":
            value = code.as_value(attribute, code.vector if kind != "bool" else ir.VectorType(BIT, code.lanes))
        elif op in LOOK_UPS:
            assert look_up is not None
            value = look_up(op, attribute, xs[0])
        elif op in ("sin", "cos") and sincos is not None:
            if operands[0] not in turns:
                turns[operands[0]] = sines_and_cosines(code, sincos, values[operands[0]])
            value = turns[operands[0]][op == "cos"]
        else:
            value = apply(code, op, xs, attribute, [line.kinds[i] for i in operands], kind)
        values.append(value)
    return [values[i] for i in line.outputs]


def apply(code: Code, op: str, xs: list[Value], attribute, kinds: Sequence[str], kind: str) -> Value:
    """Emit one operation on operands of `kinds`: on vectors, or by the C library in each lane."""
    if op == "convert":
        return _convert_integer(code, xs[0], kinds[0], kind)
    is_whole = kind not in ("float", "bool")
    how = INTEGERS.get(op) if is_whole else OPERATIONS[op].llvm
    if op == "mul" and kind in ("int32", "uint32"):
        how = functools.partial(_multiply_words, kind)
    if how is None:
        raise Unlowerable(f"`{op}`{' of integers' if is_whole else ''} has no machine code here")
    more = () if attribute is None else (attribute,)
    x = code.library(how, *xs) if isinstance(how, str) else how(code, *xs, *more)
    return _wrap_integer(code, x, kind) if is_whole else x


def _combine_bits(op: str) -> Callable:
    """A function that emits a bitwise operation on whole doubles; NaN where an operand is NaN."""

    def combine(code, a, b):
        x, y = (code.builder.fptosi(of.it, ir.VectorType(INTEGER, code.lanes)) for of in (a, b))
        return Value(code, code.builder.sitofp(getattr(code.builder, op)(x, y), code.vector)) + 0.0 * (a + b)

    return combine


def _convert_integer(code, x, before, after):
    if before == "bool":
        return code.as_number(x)
    if after == "bool":
        return code.compare("!=", x, 0.0)
    if after == "float":
        return x
    return _check_range(code, code.intrinsic("trunc", x), after) if before == "float" else _wrap_integer(code, x, after)


# What is done with integers, which are whole doubles.
INTEGERS = {
    "add": lambda code, a, b: a + b,
    "sub": lambda code, a, b: a - b,
    "mul": lambda code, a, b: a * b,
    "neg": lambda code, a: -a,
    "div": lambda code, a, b: code.select(code.compare("==", b, 0.0), -1.0, code.intrinsic("trunc", a / b)),  # as JAX
    "rem": lambda code, a, b: code.select(code.compare("==", b, 0.0), a, code.library("fmod", a, b)),
    "not": lambda code, a: -1.0 - a,
    **{op: _combine_bits(f"{op}_" if op != "xor" else op) for op in ("and", "or", "xor")},
    **{op: OPERATIONS[op].llvm for op in ("abs", "max", "min", "sign", "select")},
}


def _multiply_words(kind: str, code: Code, a: Value, b: Value) -> Value:
    """The product of two 32-bit integers in doubles, wrapped as the type does; each partial product is exact."""
    high = code.intrinsic("floor", a * 2.0**-16)
    return _wrap_integer(code, high * b, kind) * 2.0**16 + (a - high * 2.0**16) * b


def _wrap_integer(code: Code, x: Value, kind: str) -> Value:
    """An integer wrapped into the range of its type, if that has up to 32 bits; else `_check_range`."""
    low, period = float(np.iinfo(kind).min), 2.0 ** np.iinfo(kind).bits
    if period > 2.0**32:
        return _check_range(code, x, kind)
    return x - code.intrinsic("floor", (x - low) * (1 / period)) * period


def _check_range(code: Code, x: Value, kind: str) -> Value:
    """An integer, or NaN where it is outside of its type's range or not exact in a double."""
    limits = np.iinfo(kind)
    low, high = max(int(limits.min), -(2**53)), min(int(limits.max), 2**53)
    return code.select((x >= float(low)) & (x <= float(high)), x, float("nan"))


# π/2 in parts that sum to it, of which all but the last are so short that k times a part is exact.
PI_2 = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487111665e-21, 8.4784276603689e-32)  # 32 bits each
PI_2_ROUNDED = (1.5707963267948966, 6.123233995736766e-17)
# fmt: off
# fdlibm k_sin.c, k_cos.c: sin r = r + r^3 S(r^2), cos r = 1 - r^2/2 + r^4 C(r^2), |r| <= pi/4.
SIN = (-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
       2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10)
COS = (4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
       -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11)
# fmt: on


def sincos_function(module: ir.Module, lanes: int, name: str = "sincos", rounds: bool = False) -> Code:
    """Emit `(x, address)`: store sin x, then cos x, at the address.

    Cody and Waite's reduction (*Software Manual for the Elementary Functions*, 1980), fdlibm's polynomials; error 1
    ulp. If a lane has an angle beyond `LARGEST_ANGLE`, the C library is called as well.
    """
    code = Code(module, name, [ir.VectorType(DOUBLE, lanes), POINTER], lanes, rounds=rounds)
    x, address = code.arguments
    near = abs(x) <= LARGEST_ANGLE
    sine, cosine = _sincos_polynomials(code, code.select(near, x, 0.0))
    code.store(sine, address)
    code.store(cosine, code.element(address, lanes))
    # A lane must not depend on its neighbours: only the far ones are replaced.
    with code.only_if(code.any_lane(~near)):
        code.store(code.select(near, sine, code.library("sin", x)), address)
        code.store(code.select(near, cosine, code.library("cos", x)), code.element(address, lanes))
    return code.finish()


def _sincos_polynomials(code: Code, x: Value) -> tuple[Value, Value]:
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
    sine = r + (r * z * _evaluate_horner(z, SIN) + tail)
    half = 0.5 * z
    one_less = 1.0 - half
    cosine = one_less + (((1.0 - one_less) - half) + (z * z * _evaluate_horner(z, COS) - r * tail))
    return _rotate_quarters(code, k, sine, cosine)


def _rotate_quarters(code: Code, k: Value, sine: Value, cosine: Value) -> tuple[Value, Value]:
    """Sine and cosine of an angle increased by k quarter turns, from those of the angle."""
    quadrant = k - 4.0 * code.intrinsic("floor", 0.25 * k)  # 0, 1, 2, 3
    odd = code.compare("==", quadrant, 1.0) | code.compare("==", quadrant, 3.0)
    s, c = code.select(odd, cosine, sine), code.select(odd, sine, cosine)
    middle = code.compare("==", quadrant, 1.0) | code.compare("==", quadrant, 2.0)
    return code.select(quadrant > 1.5, -s, s), code.select(middle, -c, c)


def _evaluate_horner(z, coefficients):
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = coefficient + z * total
    return total


def sines_and_cosines(code: Code, sincos: Code, x: Value) -> tuple[Value, Value]:
    with code.builder.goto_entry_block():
        place = code.builder.alloca(ir.ArrayType(code.vector, 2))
    place.align = 8 * code.lanes
    address = Value(code, place)
    code.call(sincos, x, address)
    return code.load(address, code.vector), code.load(code.element(address, code.lanes), code.vector)
