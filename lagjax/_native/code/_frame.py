"""`Frame`: a kernel function under construction, with access by name to thread memory, single lanes and the job.

A thread integrates as many members as a vector has lanes. Its memory is an array of vectors, with one element per lane;
a `Memory` gives each of them a name. The *job* is the structure of arguments shared by all threads. A `Frame` reads and
writes these like dictionaries:

    frame["h"] = 0.5 * frame["h"]               the step sizes of all lanes, a vector
    frame["y", i, k]                            coefficient k of component i of the state
    lane["steps"] + 1.0                         the step count of one lane, a double; `lane` = frame.lane(j)
    lane["member"]                              the member in that lane, an integer
    frame.job("order"), frame.read("ts", i)     a field of the job, and an element of an array it points to

Every function takes three pointers, to the job, the memory and the integers of the lanes, and then its own arguments.
"""

import copy
import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir

from lagjax._native.code._ir import BIT, DOUBLE, INTEGER, POINTER, Code, Value, element_of, vector_type

Index = int | Value
Numbers = Any  # vectors by their numbers: a list of values whose indices are known, or `Vectors`
# Integers of a lane: which member it carries (-1: none), which output comes next, and which step.
LANE = ("member", "output", "step")
CACHE_LINE = 8  # doubles
KINDS = {ctypes.c_void_p: POINTER, ctypes.c_int64: INTEGER, ctypes.c_double: DOUBLE}


def job_structure(
    name: str, pointers: tuple[str, ...], integers: tuple[str, ...], doubles: tuple[str, ...] = (), *others: str
) -> type:
    """The ctypes structure of the arguments shared by all threads, eight bytes per field; `others` are pointers too."""
    fields = [
        *((field, ctypes.c_void_p) for field in pointers),
        *((field, ctypes.c_int64) for field in integers),
        *((field, ctypes.c_double) for field in doubles),
        *((field, ctypes.c_void_p) for field in others),
    ]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def integer_constant(module: ir.Module, numbers: np.ndarray) -> ir.GlobalVariable:
    """A constant array of int64 in the module, stored as bytes, whose text is short and fast to parse."""
    data = bytearray(numbers.tobytes())
    kind = ir.ArrayType(ir.IntType(8), len(data))
    table: Any = ir.GlobalVariable(module, kind, module.get_unique_name("integers"))
    table.global_constant, table.linkage, table.align = True, "internal", 8
    table.initializer = ir.Constant(kind, data)
    return table


# The fields of a thread's memory by name: a number of vectors, or rows and columns of them.
Fields = dict[str, Any]


class Memory:
    """The layout of a thread's memory: named vectors of `width` lanes; one `beside` another shares its memory."""

    def __init__(self, width: int, fields: Fields, beside: "Memory | None" = None):
        self.width, self._columns, self._offsets = width, {}, {}
        self._doubles = [0] if beside is None else beside._doubles  # of all that share the memory
        self.extend_by(fields)

    @property
    def size(self) -> int:
        """The memory of a thread in doubles, rounded up to whole cache lines."""
        return -(-self._doubles[0] // CACHE_LINE) * CACHE_LINE

    @property
    def end(self) -> int:
        return -(-self._doubles[0] // self.width) * self.width

    def extend_by(self, fields: Fields) -> None:
        for name, shape in fields.items():
            rows, self._columns[name] = (shape, 1) if isinstance(shape, int) else shape
            self._offsets[name] = self.end
            self._doubles[0] = self.end + rows * self._columns[name] * self.width

    def place(self, name: str, *indices: Index) -> Any:
        """The offset, in doubles, of the vector `name`, `name[i]` or `name[i, k]`."""
        row, column = (*indices, 0, 0)[:2]
        columns = self._columns[name]
        index = row if columns == 1 else column if isinstance(row, int) and row == 0 else column + row * columns
        return index * self.width + self._offsets[name]


@dataclass(frozen=True, eq=False)
class Vectors:
    """A sequence of `count` vectors without a list: `read(i)` gives vector i, and `write(i, x)` sets it.

    `place(i)` is the offset of vector i in the thread's memory, in doubles, if it is known; `shift` is a further offset
    known at run time only.
    """

    count: int
    read: Callable[[Index], Value]
    write: "Callable[[Index, Value], None] | None" = None
    place: "Callable[[int], int] | None" = None
    shift: "Value | None" = None

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: Index) -> Value:
        return self.read(i)

    def __setitem__(self, i: Index, x: Value) -> None:
        assert self.write is not None
        self.write(i, x)


class Frame:
    """A kernel function under construction, with access by name to everything it reads and writes."""

    def __init__(self, module: ir.Module, layout: Memory, job: type, name: str, *kinds: ir.Type, **options):
        self.code = Code(module, name, [POINTER] * 3 + list(kinds), layout.width, **options)
        self.layout, self.width, self.vector = layout, layout.width, self.code.vector
        self._fields = dict(job._fields_)
        self._job, self._memory, self._integers, *self.arguments = self.code.arguments
        self._mask: Value | None = None

    # ---- vectors, one element a lane ----

    def __getitem__(self, key: "str | tuple") -> Value:
        name, *indices = _key_parts(key)
        return self.code.load(self.address(name, *indices), vector_type(DOUBLE, self.width))

    def __setitem__(self, key: "str | tuple", value: "Value | float") -> None:
        if isinstance(value, Value) and element_of(value.it.type) == BIT:
            value = self.code.flag(value)
        value = self.code.as_value(value, vector_type(DOUBLE, self.width))
        if self._mask is not None:
            value = self.code.select(self._mask, value, self[key])
        self.code.store(value, self.address(*_key_parts(key)))

    @contextmanager
    def where(self, mask: Value) -> Iterator[None]:
        """A context in which assignments to vectors change only the lanes of the mask, as `x[mask] = y` in NumPy."""
        before, self._mask = self._mask, mask if self._mask is None else self._mask & mask
        yield
        self._mask = before

    def assign(self, mask: Value, *indices: Index, **values: "Value | float") -> None:
        """Set the given fields, all at the same indices, in the lanes of a mask."""
        with self.where(mask):
            for name, value in values.items():
                self[(name, *indices)] = value

    def address(self, name: str, *indices: Index) -> Value:
        return self.code.element(self._memory, self.layout.place(name, *indices))

    def vectors(self, name: str, count: int, place: Callable[[Index], tuple] = lambda i: (i,)) -> Vectors:
        """The `count` vectors `name[place(i)]` of a field, at offsets known at compile time."""

        def where(i):
            return self.layout.place(name, *place(i))

        def write(i, x):
            self[name, *place(i)] = x

        return Vectors(count, lambda i: self[name, *place(i)], write, where)

    def vectors_at(self, name: str, count: int, k: Value, by_row: bool = False) -> Vectors:
        """Column k of a field, from its first row on; or, with `by_row`, row k from its first column on."""

        def index(i):
            return (k, i) if by_row else (i, k)

        def write(i, x):
            self[name, *index(i)] = x

        stride = self.layout.place(name, *((1, 0) if by_row else (0, 1))) - self.layout.place(name, 0, 0)
        place = self.vectors(name, count, (lambda i: (0, i)) if by_row else (lambda i: (i, 0))).place
        return Vectors(count, lambda i: self[name, *index(i)], write, place, k * stride)

    def constant(self, x: float) -> Value:
        return self.code.lanes_of(x)

    def lane(self, index: Value) -> "Lane":
        return Lane(self, index)

    def view(self, layout: Memory) -> "Frame":
        """The frame of the same function with the fields of a second `layout` of its memory."""
        other = copy.copy(self)
        other.layout, other.width = layout, layout.width
        return other

    # ---- the job ----

    def job(self, name: str) -> Value:
        position, kind = list(self._fields).index(name), KINDS[self._fields[name]]
        return self.code.load(self.code.element(self._job, position, INTEGER), kind)

    def read(self, name: str, index: Index, kind: ir.Type = DOUBLE) -> Value:
        return self.code.load(self.code.element(self.job(name), index, kind), kind)

    def write(self, name: str, index: Index, value: Value) -> None:
        self.code.store(value, self.code.element(self.job(name), index))

    def next(self, name: str) -> Value:
        return self.code.count_up(self.job(name))

    def time(self, member: Value, index: Index) -> Value:
        return self.read("ts", member * self.job("ts_stride") + index)

    # ---- functions ----

    def memory_at(self, offset: Value) -> Value:
        return self.code.element(self._memory, offset)

    def call(self, function: Code, *arguments: Value) -> None:
        """Call another kernel function on the same job, memory and lanes."""
        self.code.call(function, self._job, self._memory, self._integers, *arguments)

    def finish(self, result: Value | None = None) -> Code:
        return self.code.finish(result)


class Lane:
    """One lane of a frame, by name: the doubles of its memory and its integers."""

    def __init__(self, frame: Frame, index: Value):
        self._frame, self._index = frame, index

    def __getitem__(self, key: "str | tuple") -> Value:
        name, *indices = _key_parts(key)
        return self._frame.code.load(self.address(name, *indices), self._type_of(name))

    def __setitem__(self, key: "str | tuple", value: "Value | float") -> None:
        name, *indices = _key_parts(key)
        value = self._frame.code.as_value(value, self._type_of(name))
        self._frame.code.store(value, self.address(name, *indices))

    def _type_of(self, name: str) -> ir.Type:
        return INTEGER if name in LANE else DOUBLE

    def address(self, name: str, *indices: Index) -> Value:
        frame = self._frame
        if name in LANE:
            return frame.code.element(frame._integers, self._index + LANE.index(name) * frame.width, INTEGER)
        return frame.code.element(frame._memory, self._index + frame.layout.place(name, *indices))


def _key_parts(key: "str | tuple") -> tuple:
    return key if isinstance(key, tuple) else (key,)
