"""Straight lines as calls of XLA: rows of inputs to rows of outputs, without Python and without XLA's compiler.

One handler serves all lines: the attribute of a call is the address of the line's machine code. What many rows share,
such as the state in all directions of a Jacobian, is computed once:

    inputs of all rows ─► what depends on these alone, once ─► the rest, several rows side by side
"""

import ctypes
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._constants import LARGEST_LINE
from lagjax._native.code._ir import DOUBLE, INTEGER, LINE_ARGUMENTS, POINTER, Code, Value, compile_module
from lagjax._native.motions._handler import call_address, compile_handler, load_at, make_once
from lagjax._native.series._lanes import emit, sincos_function
from lagjax._program import OPERATIONS, Graph, StraightLine, eliminate_dead_code, operation_error

_SET_ROWS = "set_rows"
_MOST_ROOM = 2**16  # doubles of an interpreted line in lanes, half a megabyte of the stack of a thread


class LineCode:
    """The machine code of a straight line with `inputs` floats; it is freed with this object.

    At its `address` is `evaluate(x, out, rows, given, times)`, `times` times with x (rows, inputs) and out (rows,
    outputs). Inputs in `shared` are equal in all `rows` and passed as given (times, shared); x has the others.

    A line of more than `largest` operations is interpreted from an array of integers, for which LLVM takes no longer,
    and has no shared inputs: row by row, if more lanes took too much memory. With `moving`, a number of first inputs,
    it computes the running errors of the outputs instead of the outputs (`_program._rounding`): a compiled line of them
    would be five times as long. A line may process several rows at once, in `lanes`. Every operation rounds, so that
    all of these forms have the same digits on every processor, and in C (`_c_lines`). Raises `Unlowerable`.
    """

    def __init__(
        self,
        line: StraightLine,
        inputs: int,
        moving: int | None = None,
        largest: int = LARGEST_LINE,
        lanes: int = 1,
        shared: Sequence[int] = (),
    ):
        module, outputs = ir.Module("line"), len(line.outputs)
        module.triple = ""
        filled = [k for k in range(outputs) if line.constant(k) != 0]
        long = moving is not None or len(line.nodes) + len(filled) > largest
        self.shared = () if long else tuple(shared)
        write = _RowWalk(line, inputs, filled, moving, lanes) if long else None
        lanes = lanes if write is None else write.lanes
        common, rest = (None, line) if long else _split_line(line, inputs, filled, self.shared)
        own, begin = inputs - len(self.shared), common and _write_shared_part(module, common, len(self.shared))
        room = len(common.outputs) if common else 1 if write is None else write.room
        code, sincos = (
            Code(module, "evaluate", LINE_ARGUMENTS, lanes, public=True, rounds=True),
            _sincos_of(module, rest, lanes, "rows"),
        )
        (x, out, rows, given, times), room = code.arguments, code.stack(max(1, room), 64)
        if write is None:
            write_outputs = functools.partial(_write_line_outputs, code, sincos, rest, own, filled)
        else:
            write_outputs = functools.partial(write, code, sincos)
        with code.loop(times) as time:
            if begin is not None:
                code.call(begin, code.element(given, time * len(self.shared)), room)
            x, out = code.element(x, time * rows * own), code.element(out, time * rows * outputs)
            if lanes > 1:
                _write_tiles(code, write_outputs, own, outputs, (x, out, rows, room))
            else:
                with code.loop(rows) as row:
                    here, there = code.element(x, row * own), code.element(out, row * outputs)
                    code.fill(there, outputs if len(filled) < outputs else 0)
                    write_outputs(here, there, room)
        code.finish()
        names = ("evaluate",) if write is None else ("evaluate", _SET_ROWS)
        level = 0 if write is None and compilation_work(rest, lanes) > WORK_OPTIMISED else None
        self._engine, places = compile_module(module, names, level)
        if write is not None:
            self._numbers = write.numbers
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(places[_SET_ROWS])(self._numbers.ctypes.data)
        self.address, self._outputs = places["evaluate"], outputs
        self._evaluate = line_function(self.address)

    def __call__(self, rows: np.ndarray, given: np.ndarray | None = None) -> np.ndarray:
        """The outputs (R, outputs) at rows (R, inputs) without the shared inputs, which are `given`."""
        rows, found = np.ascontiguousarray(rows, float), np.empty((len(rows), self._outputs))
        given = np.ascontiguousarray([] if given is None else given, float)
        self._evaluate(rows.ctypes.data, found.ctypes.data, len(rows), given.ctypes.data, 1)
        return found


line_function = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64
)


_QUICK = frozenset(("add", "sub", "mul", "div", "neg", "constant", "input"))
_WIDE = frozenset(("sin", "cos", "sqrt", "abs"))  # functions that take a vector as a number


# Beyond this work LLVM does not optimise a line that is written out, nor what its rows share. For 39 000 operations it
# takes 1.6 s so, else 5 s, and a row of many then 6 µs, else 2; for 16 000 0.4 s, else 1.1, and a row 10 µs, else 7.
WORK_OPTIMISED = 12_000


def compilation_work(line: StraightLine, lanes: int) -> int:
    """The length of a chain of additions that takes LLVM as long to compile as this line.

    Measured: decisions and functions take as long as 4, and functions that the C library evaluates, lane by lane, as 40
    in eight lanes.
    """
    slow = 5 * lanes if lanes > 1 else 4
    weights = (
        1 if op in _QUICK else slow if OPERATIONS[op].slopes and op not in _WIDE else 4 for op, _, _ in line.nodes
    )
    return sum(weights)


def _split_line(
    line: StraightLine, inputs: int, filled: list[int], shared: tuple[int, ...]
) -> tuple[StraightLine | None, StraightLine]:
    """The line of all that depends on shared inputs alone, and the line from its outputs and the other inputs.

    Inputs of each are renumbered from 0, in order. None for the first if nothing is computed from shared inputs alone.
    """
    own = {i: k for k, i in enumerate(i for i in range(inputs) if i not in set(shared))}
    if not shared:
        return None, line
    varies: list[bool] = []
    for op, operands, attribute in line.nodes:
        varies.append(attribute in own if op == "input" else any(varies[i] for i in operands))
    read = {
        i for k, (_, operands, _) in enumerate(line.nodes) if varies[k] or line.kinds[k] != "float" for i in operands
    }
    read |= {line.outputs[k] for k in filled}
    kept = [i for i in sorted(read) if not varies[i] and line.kinds[i] == "float" and line.nodes[i][0] != "constant"]
    places = {i: len(own) + k for k, i in enumerate(kept)}

    def renumber(places: dict[int, int], of: dict[int, int]) -> StraightLine:
        nodes = enumerate(line.nodes)
        moved = (
            ("input", (), places[i]) if i in places else (op, operands, of.get(at) if op == "input" else at)
            for i, (op, operands, at) in nodes
        )
        return line.replace(nodes=tuple(moved))

    rest = eliminate_dead_code(renumber(places, own), line.outputs)
    return eliminate_dead_code(renumber({}, {i: k for k, i in enumerate(shared)}), kept), rest


def _sincos_of(module: ir.Module, line: StraightLine, lanes: int, name: str) -> Code | None:
    turns = any(op in ("sin", "cos") for op, _, _ in line.nodes)
    return sincos_function(module, lanes, f"sincos_{name}", rounds=True) if turns else None


def _write_shared_part(module: ir.Module, line: StraightLine, inputs: int) -> Code:
    """Emit a function (inputs, outputs) for a line."""
    code, sincos = Code(module, "common", [POINTER, POINTER], 1, rounds=True), _sincos_of(module, line, 1, "common")
    given, out = code.arguments
    if compilation_work(line, 1) > WORK_OPTIMISED:
        for attribute in ("noinline", "optnone"):
            code.function.attributes.add(attribute)
    _write_line_outputs(code, sincos, line, inputs, list(range(len(line.outputs))), given, out, given)
    return code.finish()


def _write_line_outputs(
    code: Code, sincos: Code | None, line: StraightLine, own: int, filled: list[int], x: Value, out: Value, room: Value
) -> None:
    """Emit the computation of the outputs `filled` of a line; each number of x and `out` has one value per lane.

    Inputs after the first `own` ones are read from `room`, one number for all lanes.
    """
    lanes = code.lanes

    @functools.cache
    def read(i: int) -> Value:
        if i < own:
            return code.load(code.element(x, i * lanes), code.vector)
        return code.load(code.element(room, i - own), DOUBLE)

    line = line.replace(outputs=tuple(line.outputs[k] for k in filled))
    for k, i, value in zip(filled, line.outputs, emit(code, line, read, sincos, None), strict=True):
        number = code.as_number(value) if line.kinds[i] == "bool" else value
        code.store(code.lanes_of(number), code.element(out, k * lanes))


def _write_tiles(code: Code, write_outputs: Callable, inputs: int, outputs: int, arrays: tuple[Value, ...]) -> None:
    """Emit a loop over tiles of rows, one row per lane; the last tile repeats the last row."""
    (x, out, rows, room), lanes = arrays, code.lanes
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
        write_outputs(given, found, room)
        with code.loop(here) as j:
            row = code.element(out, (first.value + j) * outputs)
            with code.loop(outputs) as k:
                code.store(code.load(code.element(found, k * lanes + j), DOUBLE), code.element(row, k))
        first.value = first.value + lanes


class _RowWalk:
    """A straight line as an array `numbers` of integers that a loop interprets: three counts, then the rows.

    A row is the case of an operation, and the places of its operands and its result among `size` vectors of memory,
    where constants and inputs come first. A place is taken again after its last use; the places of outputs follow the
    rows. Errors, if the first inputs are `moving`, are in a second memory of the same layout. `room`: doubles of all.
    """

    def __init__(self, line: StraightLine, inputs: int, filled: list[int], moving: int | None, lanes: int):
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
        memories = 1 if moving is None else 2
        self.lanes = lanes if (memories * self.size + inputs + len(line.outputs)) * lanes <= _MOST_ROOM else 1
        self.room = 2 ** math.ceil(math.log2(memories * self.size * self.lanes))
        rows = np.array(rows, np.int64).reshape(-1, 5) * [1, *[self.lanes] * 4]
        counts, found = (len(rows), len(constants), len(found)), np.array(found, np.int64) * self.lanes
        self.numbers = np.concatenate([np.array(x, np.int64).ravel() for x in (counts, rows, values, found)])

    def __call__(self, code: Code, sincos: Code | None, x: Value, out: Value, room: Value) -> None:
        """Emit the interpreter loop."""
        module = code.module
        place: Any = ir.GlobalVariable(module, POINTER, "rows")
        place.linkage, place.initializer = "internal", ir.Constant(POINTER, None)
        begin = Code(module, _SET_ROWS, [POINTER], 1, public=True)
        begin.builder.store(begin.arguments[0].it, place, align=8)
        begin.finish()
        table = code.load(Value(code, place), POINTER)
        rows, constants, outputs = (code.load(code.element(table, i, INTEGER), INTEGER) for i in range(3))
        first, lanes = rows * 5 + 3, self.lanes
        rooms = [room] if self.moving is None else [room, code.element(room, self.size)]
        with code.loop(constants) as i:
            constant = code.load(code.element(table, first + i), DOUBLE)
            code.store(code.lanes_of(constant), code.element(room, i * lanes))
        code.copy(x, code.element(room, constants * lanes), self.inputs * lanes)
        for errors in rooms[1:]:  # in one lane
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
            code.store(code.load(code.element(rooms[-1], at), code.vector), code.element(out, k))

    def _write_case(self, op: str, attribute, kinds: tuple[str, ...]) -> StraightLine:
        """The line of one operation of operands of `kinds` (the last one is its own), or of it and its error."""
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
    """The address of the XLA handler of all lines.

    It maps x (times, rows, inputs) and shared inputs (times, shared) to (times, rows, outputs), all doubles.
    """

    def evaluate(code: Code, line: Value, data: list[Value], dims: list[Value]) -> None:
        address = Value(code, code.builder.ptrtoint(line.it, INTEGER))
        (x, given, out), (times, rows) = data, (load_at(dims[0], offset, INTEGER) for offset in (0, 8))
        call_address(code, address, ir.VoidType(), x, out, rows, given, times)

    return compile_handler("line_handler", 2, 1, lambda module: evaluate)["handler"]
