"""Look-ups in tables (`_program._look_ups`), read from the parameters of a member in memory.

    take      an entry by a whole number, clipped to the table so that no lane reads outside of it
    locate    the interval of an increasing table, by bisection; needed at the start of a motion only

Constant tables are in one array, whose address is passed to the module after compilation, so that they are not part of
the text that LLVM parses.
"""

import functools
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._frame import Frame
from lagjax._native.code._ir import DOUBLE, INTEGER, POINTER, Code, Value
from lagjax._program import BESIDE, Located, Table

SET_NUMBERS = "set_numbers"


class LookUps:
    """The look-ups of a module; if its parameters are `ChosenParameters`, tables are counted from `BESIDE`."""

    def __init__(self, module: ir.Module):
        self.module = module
        self._begins: dict[bytes, int] = {}
        self._size = 0

    @property
    def numbers(self) -> np.ndarray | None:
        """All constant tables in one array; None if there are none."""
        return np.concatenate([np.frombuffer(data) for data in self._begins]) if self._begins else None

    def finish(self) -> None:
        """Emit the function that takes the address of the constant tables."""
        if self._begins:
            code = Code(self.module, SET_NUMBERS, [POINTER], 1, public=True)
            code.builder.store(code.arguments[0].it, self._address_of_numbers, align=8)
            code.finish()

    def __call__(self, frame: Frame, op: str, attribute: Table | Located, x: Value) -> Value:
        if op == "take":
            assert isinstance(attribute, Table)
            return self.take(frame, attribute, x)
        assert isinstance(attribute, Located)
        table, code = attribute.table, frame.code
        base, first = self._table_base(frame, table)
        found = code.lanes_of(0.0)
        for lane, (begin, number) in enumerate(zip(self._to_integers(code, first), _lane_values(code, x), strict=True)):
            constants = (code.as_value(n, INTEGER) for n in (table.stride, table.count, attribute.closed))
            piece = code.call(self._locate_function, code.element(base, begin), *constants, number)
            found = _insert_lane(code, found, lane, piece)
        return found

    def take(self, frame: Frame, table: Table, x: Value) -> Value:
        code, (base, first), found = frame.code, self._table_base(frame, table), frame.constant(0.0)
        for lane, place in enumerate(
            self._to_integers(code, self._clip_index(code, table, x) * float(table.stride) + first)
        ):
            found = _insert_lane(code, found, lane, code.load(code.element(base, place), DOUBLE))
        return found

    def increases(self, frame: Frame, table: Table, first: Value) -> Value:
        """True if the entries of a table increase; `first` is the offset of the member's parameters."""
        code = frame.code
        begin = code.element(frame.job("params"), first + (table.first - BESIDE))
        constants = (code.as_value(n, INTEGER) for n in (table.stride, table.count))
        return code.call(self._increases_function, begin, *constants) > 0

    def places(self, frame: Frame, table: Table, x: Value) -> list[Value]:
        """The offsets, lane by lane, of the entries with indices x among the parameters of all members."""
        x = self._clip_index(frame.code, table, x) * float(table.stride) + float(table.first - BESIDE)
        return self._to_integers(frame.code, x)

    @staticmethod
    def _clip_index(code: Code, table: Table, x: Value) -> Value:
        """Indices clipped to the table; NaN becomes 0."""
        x, last = code.select(x > 0.0, x, 0.0), float(table.count - 1)
        return code.select(x < last, x, last)

    def _table_base(self, frame: Frame, table: Table) -> tuple[Value, Value]:
        """The address of an array, and in each lane the index of the table's first entry in it."""
        code = frame.code
        if table.numbers is not None:
            if table.numbers not in self._begins:
                self._begins[table.numbers] = self._size
                self._size += len(table.numbers) // 8
            base = Value(code, code.builder.load(self._address_of_numbers, typ=POINTER, align=8))
            return base, code.lanes_of(float(self._begins[table.numbers] + table.first))
        name, begin = ("params_dot", "first_dot") if table.tangents else ("params", "first_number")
        return frame.job(name), frame[begin] + float(table.first - BESIDE)

    @functools.cached_property
    def _address_of_numbers(self) -> ir.GlobalVariable:
        place: Any = ir.GlobalVariable(self.module, POINTER, "address_of_numbers")
        place.linkage, place.align, place.initializer = "internal", 8, ir.Constant(POINTER, None)
        return place

    @functools.cached_property
    def _increases_function(self) -> Code:
        """Emit `(base, stride, count)`: 1 if every entry is larger than the one before it, else 0."""
        code = Code(self.module, "increases", [POINTER, INTEGER, INTEGER], 1, result=INTEGER)
        base, stride, count = code.arguments
        found = code.variable(code.as_value(1, INTEGER))
        with code.loop(count - 1) as i:
            before, after = (code.load(code.element(base, k * stride), DOUBLE) for k in (i, i + 1))
            found.value = code.select(before < after, found.value, 0)
        return code.finish(found.value)

    @functools.cached_property
    def _locate_function(self) -> Code:
        """Emit `(base, stride, count, closed, x)`: the number of entries that are at most x, less one."""
        code = Code(self.module, "locate", [POINTER, INTEGER, INTEGER, INTEGER, DOUBLE], 1, result=DOUBLE)
        base, stride, count, closed, x = code.arguments
        low, high = code.variable(code.as_value(0, INTEGER)), code.variable(count)
        with code.repeat_while(lambda: low.value < high.value):
            middle = (low.value + high.value) / 2
            below = code.load(code.element(base, middle * stride), DOUBLE) <= x
            low.value = code.select(below, middle + 1, low.value)
            high.value = code.select(below, high.value, middle)
        found = low.value - 1
        last = code.load(code.element(base, (count - 1) * stride), DOUBLE)
        ends = code.compare("==", x, last) & (closed > 0)
        return code.finish(code.as_double(code.select(ends, count - 2, found)))

    @staticmethod
    def _to_integers(code: Code, x: Value) -> list[Value]:
        """The whole numbers in the lanes of a vector, as a list of integers."""
        return _lane_values(code, Value(code, code.builder.fptosi(x.it, ir.VectorType(INTEGER, code.lanes))))


def _lane_values(code: Code, x: Value) -> list[Value]:
    return [lane_of(code, x, k) for k in range(code.lanes)]


def lane_of(code: Code, x: Value, lane: int) -> Value:
    return Value(code, code.builder.extract_element(x.it, ir.Constant(INTEGER, lane)))


def _insert_lane(code: Code, x: Value, lane: int, number: Value) -> Value:
    return Value(code, code.builder.insert_element(x.it, number.it, ir.Constant(INTEGER, lane)))
