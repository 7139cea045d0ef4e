"""Straight lines as calls of XLA: rows of inputs to rows of outputs, without Python and without a compiler of XLA's.

One handler serves all lines: the attribute of a call is where the machine code of its line is.
"""

import contextlib
import ctypes
import functools
import itertools

import numpy as np
from llvmlite import ir

from lagjax._native._handler import call, compile_handler, load_at, make_once
from lagjax._native._ir import INTEGER, POINTER, Code, Value, compile_module
from lagjax._native._lanes import emit, sincos_function
from lagjax._program._series import StraightLine

# Equal outputs, side by side, that are written out: LLVM takes 16 s for the 4000 zeros of a row of 2000 springs.
_LONGEST = 32


class LineCode:
    """A straight line of `inputs` floats in machine code, for as long as this object lives.

    At its `address` is `evaluate(x, out, rows)`, with x (rows, inputs) and out (rows, outputs). Raises `Unlowerable`.
    """

    def __init__(self, line: StraightLine, inputs: int):
        module, outputs = ir.Module("line"), len(line.outputs)
        module.triple = ""
        turns = any(op in ("sin", "cos") for op, _, _ in line.nodes)
        sincos = sincos_function(module, 1) if turns else None
        code = Code(module, "evaluate", [POINTER, POINTER, INTEGER], 1, public=True)
        x, out, rows = code.arguments
        with code.loop(rows) as row:
            read = functools.cache(lambda i: code.load(code.element(x, row * inputs + i), code.vector))
            values, begin = emit(code, line, read, sincos, None), 0
            for node, alike in itertools.groupby(line.outputs):
                number = code.as_number(values[begin]) if line.kinds[node] == "bool" else values[begin]
                end = begin + len(list(alike))
                long = end - begin > _LONGEST
                for k in [code.loop(end, begin)] if long else map(contextlib.nullcontext, range(begin, end)):
                    with k as place:
                        code.store(code.lanes_of(number), code.element(out, row * outputs + place))
                begin = end
        code.finish()
        self._engine, places = compile_module(module, ("evaluate",))
        self.address, self._outputs = places["evaluate"], outputs
        self._evaluate = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(self.address)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """The outputs (R, outputs) at rows (R, inputs)."""
        rows, found = np.ascontiguousarray(rows, float), np.empty((len(rows), self._outputs))
        self._evaluate(rows.ctypes.data, found.ctypes.data, len(rows))
        return found


@make_once
def line_handler() -> int:
    """The address of the handler of all lines: from x (rows, inputs) to a result (rows, outputs), both of doubles."""

    def evaluate(code: Code, line: Value, data: list[Value], dims: list[Value]) -> None:
        address = Value(code, code.builder.ptrtoint(line.it, INTEGER))
        call(code, address, ir.VoidType(), *data, load_at(dims[0], 0, INTEGER))

    return compile_handler("line_handler", 1, 1, lambda module: evaluate)["handler"]
