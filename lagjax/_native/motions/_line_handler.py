"""Straight lines as calls of XLA: rows of inputs to rows of outputs, without Python and without a compiler of XLA's.

One handler serves all lines: the attribute of a call is where the machine code of its line is.
"""

import ctypes
import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._constants import LARGEST_LINE
from lagjax._native.code._ir import DOUBLE, INTEGER, POINTER, Code, Value, compile_module
from lagjax._native.motions._handler import call, compile_handler, load_at, make_once
from lagjax._native.series._lanes import emit, sincos_function
from lagjax._program import OPERATIONS, Graph, StraightLine, operation_error

_SET_ROWS = "set_rows"


class LineCode:
    """A straight line of `inputs` floats in machine code, for as long as this object lives.

    At its `address` is `evaluate(x, out, rows)`, with x (rows, inputs) and out (rows, outputs). A line of more than
    `largest` operations is a walk along rows of integers, for which LLVM takes no longer. Where its first inputs, so
    many, are `moving`, that gives the running errors of the outputs in their place (`_program._rounding`): a line of
    them would be five times as long. What is written out may take several rows at once, in `lanes`. Every operation
    rounds, so that all of these forms have the same digits on every processor, and in C (`_c_lines`). Raises
    `Unlowerable`.
    """

    def __init__(
        self, line: StraightLine, inputs: int, moving: int | None = None, largest: int = LARGEST_LINE, lanes: int = 1
    ):
        module, outputs = ir.Module("line"), len(line.outputs)
        module.triple = ""
        filled = [k for k in range(outputs) if line.constant(k) != 0]
        long = moving is not None or len(line.nodes) + len(filled) > largest
        lanes = 1 if long else lanes
        turns = any(op in ("sin", "cos") for op, _, _ in line.nodes)
        sincos = sincos_function(module, lanes, rounds=True) if turns else None
        write = _RowWalk(line, inputs, filled, moving) if long else None
        room = 1 if write is None else 2 ** math.ceil(math.log2(2 * write.size))
        code = Code(module, "evaluate", [POINTER, POINTER, INTEGER], lanes, public=True, rounds=True)
        (x, out, rows), room = code.arguments, code.stack(room)
        if lanes > 1:
            _write_tiles(code, sincos, line, inputs, filled)
        else:
            with code.loop(rows) as row:
                here, there = code.element(x, row * inputs), code.element(out, row * outputs)
                code.fill(there, outputs if len(filled) < outputs else 0)
                if write is not None:
                    write(code, sincos, here, there, room)
                else:
                    _write_line(code, sincos, line, filled, here, there)
        code.finish()
        names = ("evaluate",) if write is None else ("evaluate", _SET_ROWS)
        level = 0 if write is None and compilation_work(line, lanes) > WORK_OPTIMISED else None
        self._engine, places = compile_module(module, names, level)
        if write is not None:
            self._numbers = write.numbers
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(places[_SET_ROWS])(self._numbers.ctypes.data)
        self.address, self._outputs = places["evaluate"], outputs
        self._evaluate = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(self.address)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """The outputs (R, outputs) at rows (R, inputs)."""
        rows, found = np.ascontiguousarray(rows, float), np.empty((len(rows), self._outputs))
        self._evaluate(rows.ctypes.data, found.ctypes.data, len(rows))
        return found


_QUICK = frozenset(("add", "sub", "mul", "div", "neg", "constant", "input"))
_WIDE = frozenset(("sin", "cos", "sqrt", "abs"))  # functions that take a vector as a number


# Beyond this work LLVM does not optimise a line that is written out. For 39 000 operations it takes 1.6 s so, else 5 s,
# and a row of many then 6 µs, else 2.
WORK_OPTIMISED = 12_000


def compilation_work(line: StraightLine, lanes: int) -> int:
    """The additions for which LLVM takes as long as for this line, if it is written out.

    Measured: decisions and functions take as long as 4, and functions that the C library evaluates, lane by lane, as
    40 in eight lanes.
    """
    slow = 5 * lanes if lanes > 1 else 4
    weights = (
        1 if op in _QUICK else slow if OPERATIONS[op].slopes and op not in _WIDE else 4 for op, _, _ in line.nodes
    )
    return sum(weights)


def _write_line(code: Code, sincos: Code | None, line: StraightLine, filled: list[int], x: Value, out: Value) -> None:
    """Write the outputs that are `filled` of a line, operation by operation; a number of x and `out` has all lanes."""
    lanes = code.lanes
    read = functools.cache(lambda i: code.load(code.element(x, i * lanes), code.vector))
    line = line.replace(outputs=tuple(line.outputs[k] for k in filled))
    for k, i, value in zip(filled, line.outputs, emit(code, line, read, sincos, None), strict=True):
        number = code.as_number(value) if line.kinds[i] == "bool" else value
        code.store(code.lanes_of(number), code.element(out, k * lanes))


def _write_tiles(code: Code, sincos: Code | None, line: StraightLine, inputs: int, filled: list[int]) -> None:
    """Write a line for tiles of rows, one in a lane; those beyond the last are that once more."""
    (x, out, rows), lanes, outputs = code.arguments, code.lanes, len(line.outputs)
    given, found = code.stack(inputs * lanes, 64), code.stack(outputs * lanes, 64)
    with code.loop(outputs * lanes) as k:
        code.store(code.as_value(0.0, DOUBLE), code.element(found, k))
    first = code.variable(code.as_value(0, INTEGER))
    with code.repeat_while(lambda: first.value < rows):
        last = rows - first.value
        here = code.select(last < lanes, last, code.as_value(lanes, INTEGER))
        with code.loop(lanes) as j:
            own = code.select(j < here, j, here - 1)
            row = code.element(x, (first.value + own) * inputs)
            with code.loop(inputs) as k:
                code.store(code.load(code.element(row, k), DOUBLE), code.element(given, k * lanes + j))
        _write_line(code, sincos, line, filled, given, found)
        with code.loop(here) as j:
            row = code.element(out, (first.value + j) * outputs)
            with code.loop(outputs) as k:
                code.store(code.load(code.element(found, k * lanes + j), DOUBLE), code.element(row, k))
        first.value = first.value + lanes


class _RowWalk:
    """A line as `numbers`: how many rows, constants and outputs, then these.

    A row is the case of an operation, its operands and its result, places in a room of `size` doubles, where constants
    and inputs stand first. Where nobody needs a number any more another one stands; an output is its place and there.
    Errors, where the first inputs are `moving`, stand behind the room, in the same order.
    """

    def __init__(self, line: StraightLine, inputs: int, filled: list[int], moving: int | None):
        self.inputs, self.moving, self.cases = inputs, moving, {}
        last_use = dict.fromkeys((line.outputs[k] for k in filled), len(line.nodes))
        for i in reversed(range(len(line.nodes))):
            for j in line.nodes[i][1] if i in last_use else ():
                last_use.setdefault(j, i)
        constants = [i for i, (op, _, _) in enumerate(line.nodes) if op == "constant" and i in last_use]
        at, free, rows = {i: k for k, i in enumerate(constants)}, [], []
        self.size = len(constants) + inputs
        for i in sorted(last_use):
            op, operands, attribute = line.nodes[i]
            if op == "input" and line.kinds[i] == "float":
                at[i] = len(constants) + attribute
            if i in at:
                continue
            own = (len(constants) + attribute,) if op == "input" else tuple(at[j] for j in operands)
            kinds = *(line.kinds[j] for j in operands), line.kinds[i]
            case = self.cases.setdefault((op, 0 if op == "input" else attribute, kinds), len(self.cases))
            for j in set(operands):
                if last_use[j] == i and at[j] >= len(constants) + inputs:
                    free.append(at[j])
            if not free:
                free.append(self.size)
                self.size += 1
            at[i] = free.pop()
            rows.append((case, at[i], *own, *[0] * (3 - len(own))))
        found = [(k, at[line.outputs[k]]) for k in filled]
        values = np.array([line.nodes[i][2] for i in constants], float).view(np.int64)
        counts = len(rows), len(constants), len(found)
        self.numbers = np.concatenate([np.array(x, np.int64).ravel() for x in (counts, rows, values, found)])

    def __call__(self, code: Code, sincos: Code | None, x: Value, out: Value, room: Value) -> None:
        """Write the walk."""
        module = code.module
        place: Any = ir.GlobalVariable(module, POINTER, "rows")
        place.linkage, place.initializer = "internal", ir.Constant(POINTER, None)
        begin = Code(module, _SET_ROWS, [POINTER], 1, public=True)
        begin.builder.store(begin.arguments[0].it, place, align=8)
        begin.finish()
        table = code.load(Value(code, place), POINTER)
        rows, constants, outputs = (code.load(code.element(table, i, INTEGER), INTEGER) for i in range(3))
        first = rows * 5 + 3
        rooms = [room] if self.moving is None else [room, code.element(room, self.size)]
        code.copy(code.element(table, first), room, constants)
        code.copy(x, code.element(room, constants), self.inputs)
        for errors in rooms[1:]:
            code.fill(errors, constants + self.inputs)
            with code.loop(self.moving) as i:
                code.store(abs(code.load(code.element(x, i), DOUBLE)), code.element(errors, constants + i))
        with code.loop(rows) as i:
            case, to, *places = (code.load(code.element(table, i * 5 + (3 + k), INTEGER), INTEGER) for k in range(5))
            keys = list(self.cases)
            for k in code.cases(case, range(len(keys))):
                line, count = self._write_case(*keys[k]), max(1, len(keys[k][2]) - 1)
                read = functools.cache(
                    lambda j, at=places, count=count: code.load(
                        code.element(rooms[j // count], at[j % count]), code.vector
                    )
                )
                for of, node, value in zip(rooms, line.outputs, emit(code, line, read, sincos, None), strict=True):
                    number = code.as_number(value) if line.kinds[node] == "bool" else value
                    code.store(code.lanes_of(number), code.element(of, to))
        with code.loop(outputs) as i:
            pair = first + constants + i * 2
            k, at = (code.load(code.element(table, pair + j, INTEGER), INTEGER) for j in range(2))
            code.store(code.load(code.element(rooms[-1], at), DOUBLE), code.element(out, k))

    def _write_case(self, op: str, attribute, kinds: tuple[str, ...]) -> StraightLine:
        """An operation of operands of some kinds, the last of which is its own; behind these are their errors."""
        *of_operands, kind = kinds
        graph = Graph(1000)
        operands = [graph.input(i, of) for i, of in enumerate(of_operands)]
        node = graph.node(op, *operands, attribute=attribute) if operands else graph.input(0, kind)
        outputs = [node]
        if self.moving is not None:
            errors = [graph.input(len(operands) + i, "float") for i in range(len(operands))]
            is_exact = kind != "float" or not operands
            outputs.append(
                graph.number(0.0) if is_exact else operation_error(graph, op, node, operands, errors, to_zero=True)
            )
        return StraightLine(tuple(graph.nodes), tuple(graph.kinds), tuple(outputs))


@make_once
def line_handler() -> int:
    """The address of the handler of all lines: from x (rows, inputs) to a result (rows, outputs), both of doubles."""

    def evaluate(code: Code, line: Value, data: list[Value], dims: list[Value]) -> None:
        address = Value(code, code.builder.ptrtoint(line.it, INTEGER))
        call(code, address, ir.VoidType(), *data, load_at(dims[0], 0, INTEGER))

    return compile_handler("line_handler", 1, 1, lambda module: evaluate)["handler"]
