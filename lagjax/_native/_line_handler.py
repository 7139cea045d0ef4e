"""Straight lines as calls of XLA: rows of inputs to rows of outputs, without Python and without a compiler of XLA's.

One handler serves all lines: the attribute of a call is where the machine code of its line is.
"""

import ctypes
import functools
from collections.abc import Iterator, Sequence

import numpy as np
from llvmlite import ir

from lagjax._native._handler import call, compile_handler, load_at, make_once
from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value, compile_module
from lagjax._native._lanes import emit, sincos_function
from lagjax._program._series import StraightLine

# Operations of a function, for LLVM takes the square of their number. Measured with 800 and 8000 operations: 0.3 s each
# thousand; doubled, a quarter more, and calls take as long.
_PART = 400


class LineCode:
    """A straight line of `inputs` floats in machine code, for as long as this object lives.

    At its `address` is `evaluate(x, out, rows)`, with x (rows, inputs) and out (rows, outputs). Raises `Unlowerable`.
    """

    def __init__(self, line: StraightLine, inputs: int):
        module, outputs = ir.Module("line"), len(line.outputs)
        module.triple = ""
        turns = any(op in ("sin", "cos") for op, _, _ in line.nodes)
        sincos = sincos_function(module, 1) if turns else None
        parts = [_write_part(module, sincos, inputs, *part) for part in _split(line, inputs)]
        code = Code(module, "evaluate", [POINTER, POINTER, INTEGER], 1, public=True)
        x, out, rows = code.arguments
        zeros, room = (
            any(_is_zero(line, k) for k in range(outputs)),
            code.stack(len(line.nodes) if len(parts) > 1 else 1),
        )
        with code.loop(rows) as row:
            here, there = code.element(x, row * inputs), code.element(out, row * outputs)
            with code.loop(outputs if zeros else 0) as k:
                code.store(code.as_value(0.0, DOUBLE), code.element(there, k))
            for part in parts:
                code.call(part, here, there, room)
        code.finish()
        self._engine, places = compile_module(module, ("evaluate",))
        self.address, self._outputs = places["evaluate"], outputs
        self._evaluate = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(self.address)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """The outputs (R, outputs) at rows (R, inputs)."""
        rows, found = np.ascontiguousarray(rows, float), np.empty((len(rows), self._outputs))
        self._evaluate(rows.ctypes.data, found.ctypes.data, len(rows))
        return found


def _is_zero(line: StraightLine, output: int) -> bool:
    return line.constant(output) == 0


def _split(line: StraightLine, inputs: int) -> Iterator[tuple[StraightLine, list[int]]]:
    """The line in parts: what comes from parts before stands behind the `inputs`, at the number of its node.

    Beside each the places of its outputs: of those that later parts need, then below zero those of the line, −1 − k.
    """
    last_use, at_once, size = {}, [], len(line.nodes)
    given = [op in ("input", "constant") for op, _, _ in line.nodes]
    wanted = [[] for _ in line.nodes]
    for k, i in enumerate(line.outputs):
        if not _is_zero(line, k):
            (at_once if given[i] else wanted[i]).append((i, -1 - k) if given[i] else -1 - k)
    for i in reversed(range(size)):
        if wanted[i] or i in last_use:
            for j in line.nodes[i][1]:
                last_use.setdefault(j, i)
    for begin in range(0, len(at_once), _PART):
        yield _select(line, inputs, range(0), at_once[begin : begin + _PART])
    for begin in range(0, size, _PART):
        own = [i for i in range(begin, min(begin + _PART, size)) if not given[i] and (wanted[i] or i in last_use)]
        lasting = ((i, [i] if last_use.get(i, 0) >= begin + _PART else []) for i in own)
        yield _select(line, inputs, own, [(i, to) for i, needed in lasting for to in needed + wanted[i]])


def _select(line: StraightLine, inputs: int, own: Sequence[int], found: list) -> tuple[StraightLine, list[int]]:
    """The nodes that are a part's `own` as a line, with the outputs that are `found` (node, place)."""
    nodes, kinds, at, own_too = [], [], {}, set(own)

    def place(i: int) -> int:
        if i not in at:
            op, operands, attribute = line.nodes[i]
            if operands and i not in own_too:
                op, operands, attribute = "input", (), inputs + i
            here = tuple(map(place, operands))
            at[i] = len(nodes)
            nodes.append((op, here, attribute))
            kinds.append(line.kinds[i])
        return at[i]

    for i in own:
        place(i)
    places = tuple(place(i) for i, _ in found)
    return StraightLine(tuple(nodes), tuple(kinds), places), [to for _, to in found]


def _write_part(module: ir.Module, sincos: Code | None, inputs: int, line: StraightLine, places: list[int]) -> Code:
    code = Code(module, module.get_unique_name("part"), [POINTER, POINTER, POINTER], 1)
    x, out, room = code.arguments

    @functools.cache
    def read(i: int) -> Value:
        return code.load(code.element(x, i) if i < inputs else code.element(room, i - inputs), code.vector)

    for i, value, place in zip(line.outputs, emit(code, line, read, sincos, None), places, strict=True):
        number = code.lanes_of(code.as_number(value) if line.kinds[i] == "bool" else value)
        code.store(number, code.element(room, place) if place >= 0 else code.element(out, -1 - place))
    return code.finish()


@make_once
def line_handler() -> int:
    """The address of the handler of all lines: from x (rows, inputs) to a result (rows, outputs), both of doubles."""

    def evaluate(code: Code, line: Value, data: list[Value], dims: list[Value]) -> None:
        address = Value(code, code.builder.ptrtoint(line.it, INTEGER))
        call(code, address, ir.VoidType(), *data, load_at(dims[0], 0, INTEGER))

    return compile_handler("line_handler", 1, 1, lambda module: evaluate)["handler"]
