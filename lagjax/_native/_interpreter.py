"""A walk along a long straight line with its running errors: one loop of machine code for all lines.

A line of the errors would have five times as many operations, and take as long to derive as all else of a scene.
"""

from math import cos, isfinite, sin, sqrt

import numpy as np

from lagjax._native._loops import Floats, Wholes, compile_loops, loop
from lagjax._program._operations import OPERATIONS
from lagjax._program._series import StraightLine

_NAMES = ("input", "constant", "add", "sub", "mul", "div", "neg", "select", "convert", "sqrt", "sin", "cos", "abs",
          "eq", "lt", "le", "gt", "ge", "is_finite")  # fmt: skip
(INPUT, CONSTANT, ADD, SUB, MUL, DIV, NEG, SELECT, CONVERT, SQRT, SIN, COS, ABS, EQ, LT, LE, GT, GE,
 IS_FINITE) = range(len(_NAMES))  # fmt: skip


@loop
def walk(codes: Wholes, constants: Floats, x: Floats, size: int, moving: int, values: Floats, errors: Floats):
    """Put the values of all operations, and their running errors in units of round-off (see `_program._rounding`).

    Of each the `codes` say which it is, its operands, and whether it is exact; the first `moving` inputs are not.
    """
    for i in range(size):
        op, exact = codes[5 * i], codes[5 * i + 4]
        a, b, c = codes[5 * i + 1], codes[5 * i + 2], codes[5 * i + 3]
        w, by_a, by_b, by_c = 0.0, 0.0, 0.0, 0.0
        if op == INPUT:
            w, exact = x[a], int(a >= moving)
        elif op == CONSTANT:
            w = constants[i]
        else:
            u, v = values[a], values[b]
            if op == ADD:
                w, by_a, by_b = u + v, 1.0, 1.0
            elif op == SUB:
                w, by_a, by_b = u - v, 1.0, 1.0
            elif op == MUL:
                w, by_a, by_b = u * v, v, u
            elif op == DIV:
                w = u / v
                by_a, by_b = 1.0 / v, w / v
            elif op == NEG:
                w, by_a = -u, 1.0
            elif op == CONVERT:
                w, by_a = u, 1.0
            elif op == SELECT:
                w = values[c] if u != 0 else v
                by_b, by_c = float(u == 0), float(u != 0)
            elif op == SQRT:
                w = sqrt(u)
                by_a = 0.5 / w
            elif op == SIN:
                w, by_a = sin(u), cos(u)
            elif op == COS:
                w, by_a = cos(u), sin(u)
            elif op == ABS:
                w, by_a = abs(u), 1.0
            elif op == EQ:
                w = float(u == v)
            elif op == LT:
                w = float(u < v)
            elif op == LE:
                w = float(u <= v)
            elif op == GT:
                w = float(u > v)
            elif op == GE:
                w = float(u >= v)
            elif op == IS_FINITE:
                w = float(isfinite(u))
        values[i], errors[i] = w, 0.0 if exact > 0 else abs(w)
        if errors[a] != 0 and by_a != 0:
            errors[i] += errors[a] * abs(by_a)
        if errors[b] != 0 and by_b != 0:
            errors[i] += errors[b] * abs(by_b)
        if errors[c] != 0 and by_c != 0:
            errors[i] += errors[c] * abs(by_c)


class LineWalk:
    """A straight line of `inputs` doubles as a walk; `is_known` is false where it has other operations than these."""

    def __init__(self, line: StraightLine, inputs: int):
        self.is_known = set(line.kinds) <= {"float", "bool"} and {op for op, _, _ in line.nodes} <= set(_NAMES)
        self._size, self.inputs, self._outputs = len(line.nodes), inputs, np.array(line.outputs)
        if self.is_known:
            rows = [_row(*node, kind) for node, kind in zip(line.nodes, line.kinds, strict=True)]
            self._codes = np.array([row for row, _ in rows], np.int64)
            self._constants = np.array([constant for _, constant in rows], float)

    def __len__(self) -> int:
        return self._size

    def __call__(self, x: np.ndarray, moving: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """The outputs at inputs x, and their running errors."""
        assert x.size == self.inputs and x.flags.c_contiguous
        values, errors = np.zeros((2, self._size))
        arrays = self._codes, self._constants, x
        (call,) = compile_loops(walk)
        call(*(of.ctypes.data for of in arrays), self._size, moving, values.ctypes.data, errors.ctypes.data)
        return values[self._outputs], errors[self._outputs]


def _row(op: str, operands: tuple, attribute, kind: str) -> tuple[tuple[int, ...], float]:
    if op == "input":
        return (INPUT, attribute, 0, 0, 0), 0.0
    if op == "constant":
        return (CONSTANT, 0, 0, 0, 1), float(attribute)
    exact = kind != "float" or OPERATIONS[op].exact
    return (_NAMES.index(op), *operands, *[0] * (3 - len(operands)), int(exact)), 0.0
