"""Large programs as tables: the operations are data, which one loop of machine code executes.

The time that LLVM needs grows faster than the length of a straight line. Here a program is an array of integers,

    kind, then for each of `times` operations the offsets of its operands and its result;  kind, …;  0

and `execute` goes through it: a switch over the kinds of operations (some twenty) leads to their code, since
`_schedule` puts equal operations next to each other. Every number is in the memory of the thread, so that results are
read from the first or second cache instead of a register. The operations, and the order of each sum, are those of the
straight line.
"""

import struct
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from llvmlite import ir

from lagjax._native.code._constants import TIMES
from lagjax._native.code._frame import Frame, Numbers, Vectors, integer_constant
from lagjax._native.code._ir import DOUBLE, INTEGER, POINTER, Code, Value
from lagjax._native.series._lanes import apply, sines_and_cosines
from lagjax._native.series._schedule import OperationKind, Schedule, ScheduledOperation, schedule
from lagjax._program import LOOK_UPS, StraightLine

WORD = ir.IntType(32)  # an entry of a table: a kind, or a distance in the memory, in doubles


class Tables:
    """The form of large kernels, with the methods of `Lines`; `function(name, *kinds)` makes a frame of the kernel."""

    def __init__(self, function, sincos: Code, look_up: Callable):
        self._sincos, self._look_up = sincos, look_up
        self._kinds: dict[tuple[OperationKind, int], int] = {}
        self._constants: dict[bytes, int] = {}
        self._fields = 0
        self._schedules: dict[StraightLine, Schedule] = {}
        self._execute: Frame = function("execute", POINTER, INTEGER)
        self._prepare: Frame = function("prepare")
        self._module, self._layout = self._prepare.code.module, self._prepare.layout
        self._nowhere = self._layout.place(self._table_field(1), 0)  # for unused results

    # ---- what a kernel is written with ----

    def run(
        self, frame: Frame, line: StraightLine, *inputs: "Sequence[Value] | Vectors", to: "Vectors | None" = None
    ) -> Numbers:
        """The outputs of a line for the concatenated `inputs`; a bool is 1 or 0.

        They keep their values until the kernel runs this call again. The last outputs are stored in `to` instead; in a
        call of the same line without `to` they are lost.
        """
        if line not in self._schedules:
            self._schedules[line] = schedule(line, 0 if to is None else len(to))
        plan = self._schedules[line]
        name, lying = self._table_field(plan.size), self._group_places(frame, inputs)
        places = {node: self._layout.place(name, slot) for node, slot in plan.slots.items()}
        places |= {node: self._table_constant(number) for node, number in plan.constants.items()}
        places |= {node: lying[position] for node, position in plan.inputs.items()}
        if to is not None:
            assert to.place is not None
            end = len(line.nodes) + len(line.outputs)
            places |= {end - len(to) + i: to.place(i) for i in range(len(to))}
        words: list[int] = []
        for group in plan.groups:
            kind = plan.kinds[group[0].kind]
            if kind.op != "store" or to is not None:
                words += self._group_words(kind, group, places)
        table = Value(frame.code, integer_constant(self._module, np.array([*words, 0], np.int32)))
        shift = None if to is None else to.shift
        frame.call(self._execute.code, table, frame.code.as_value(0 if shift is None else shift, INTEGER))
        return frame.vectors(name, plan.staying)

    def each(self, code: Code, count: int) -> Iterator[Value]:
        """The integers below `count`, in an emitted loop: the body is emitted once."""
        if count:
            with code.loop(count) as i:
                yield i

    def component_groups(self, code: Code, n: int) -> Iterator[tuple[list, dict]]:
        """A loop over coordinates: each gives [coordinate, velocity], and {1: coordinate} for the velocity."""
        for i in self.each(code, n):
            yield [i, i + n], {1: i}

    def room(self, frame: Frame, count: int) -> Numbers:
        return frame.vectors(self._table_field(count), count)

    def largest(self, code: Code, numbers: Callable[[Value], Value], count: int) -> Value:
        """The largest of `count` nonnegative numbers; NaN if the last one is NaN."""
        largest = code.variable(code.lanes_of(0.0))
        for i in self.each(code, count):
            largest.value = code.maximum(largest.value, numbers(i))
        return largest.value

    def largest_by_group(self, frame: Frame, numbers: Callable[[Value], Value], groups: Sequence[int]) -> Numbers:
        """For each number the largest one in its group, where `groups` has a group number for each."""
        code, count, names = frame.code, len(groups), sorted(set(groups))
        values = self.room(frame, count)
        if len(names) == count:
            for i in self.each(code, count):
                values[i] = numbers(i)
            return values
        largest = self.room(frame, len(names))
        table = integer_constant(self._module, np.array([names.index(group) for group in groups], np.int64))
        for group in self.each(code, len(names)):
            largest[group] = code.lanes_of(0.0)
        for i in self.each(code, count):
            group = code.load(code.element(Value(code, table), i, INTEGER), INTEGER)
            largest[group] = code.maximum(largest[group], numbers(i))
        for i in self.each(code, count):
            values[i] = largest[code.load(code.element(Value(code, table), i, INTEGER), INTEGER)]
        return values

    def prepare(self, frame: Frame) -> None:
        """Initialise the memory of a thread: store the constants."""
        frame.call(self._prepare.code)

    def finish(self) -> None:
        """Complete the kernel after its last program: emit `execute`, with the kinds of operations that occur."""
        self._write_execute()
        self._write_prepare()

    # ---- where numbers lie ----

    def _table_field(self, count: int) -> str:
        name = f"field{self._fields}"
        self._fields += 1
        self._layout.extend_by({name: count})
        return name

    def _table_constant(self, number: float) -> int:
        key = struct.pack("d", number)  # 0.0 and -0.0 are equal but not the same
        if key not in self._constants:
            self._constants[key] = self._layout.place(self._table_field(1), 0)
        return self._constants[key]

    def _group_places(self, frame: Frame, inputs) -> list[int]:
        places: list[int] = []
        for values in inputs:
            if getattr(values, "place", None) is None or values.shift is not None:
                room = self.room(frame, len(values))
                for i in self.each(frame.code, len(values)) if isinstance(values, Vectors) else range(len(values)):
                    room[i] = values[i]
                values = room
            places += map(values.place, range(len(values)))
        return places

    # ---- the table of a program ----

    def _group_words(self, kind: OperationKind, group: list[ScheduledOperation], places: dict[int, int]) -> list[int]:
        """The integers of the table for a group of operations of one kind.

        Operations are taken in runs of lengths in `TIMES`, each with a kind number of its own, then operands and
        results.
        """
        start, words = 0, []
        while start < len(group):
            times = next(times for times in TIMES if times <= len(group) - start)
            words.append(self._kinds.setdefault((kind, times), len(self._kinds) + 1))
            for operation in group[start : start + times]:
                words += [places[x] for x in operation.operands]
                words += [places.get(x, self._nowhere) for x in operation.results]
            start += times
        return words

    # ---- the code ----

    def _write_execute(self) -> None:
        """Emit `(table, shift)`: execute a table; outputs are stored `shift` doubles behind the table's offsets."""
        frame, code = self._execute, self._execute.code
        table, shift = frame.arguments
        at = code.variable(table)
        head, end = (code.function.append_basic_block(name) for name in ("next", "end"))
        code.builder.branch(head)
        code.builder.position_at_end(head)
        switch = code.builder.switch(word(code, at.value, 0).it, end)
        for (kind, times), number in self._kinds.items():
            block = code.function.append_basic_block(kind.op)
            switch.add_case(ir.Constant(INTEGER, number), block)
            code.builder.position_at_end(block)
            words, size = at.value, kind.operands + kind.results
            for k in range(times):
                where = [frame.memory_at(word(code, words, 1 + k * size + i)) for i in range(size)]
                operands = (code.load(address, frame.vector) for address in where[: kind.operands])
                for result, address in zip(self._results(kind, operands), where[kind.operands :], strict=True):
                    code.store(result, code.element(address, shift) if kind.op == "store" else address)
            at.value = code.element(words, 1 + times * size, WORD)
            code.builder.branch(head)
        code.builder.position_at_end(end)
        frame.finish()

    def _results(self, kind: OperationKind, operands: Iterator[Value]) -> tuple[Value, ...]:
        """The results of an operation, with the values of its operands from an iterator; a bool is 1 or 0."""
        code = self._execute.code
        xs = [next(operands) if part is None else self._results(part, operands)[0] for part in kind.parts]
        if kind.op in ("copy", "store"):
            return (xs[0],)
        if kind.op == "sincos":
            return sines_and_cosines(code, self._sincos, xs[0])
        if kind.op in LOOK_UPS:
            return (self._look_up(self._execute, kind.op, kind.attribute, xs[0]),)
        xs = [code.compare("!=", x, 0.0) if of == "bool" else x for x, of in zip(xs, kind.kinds, strict=True)]
        result = apply(code, kind.op, xs, kind.attribute, kind.kinds, kind.result)
        return (code.as_number(result) if kind.result == "bool" else result,)

    def _write_prepare(self) -> None:
        """Emit `()`: store every constant at its offset, in all lanes."""
        frame, code = self._prepare, self._prepare.code
        if self._constants:
            places = Value(code, integer_constant(self._module, np.array([*self._constants.values()], np.int64)))
            numbers = Value(code, integer_constant(self._module, np.frombuffer(b"".join(self._constants), np.int64)))
            with code.loop(len(self._constants)) as i:
                number = code.load(code.element(numbers, i), DOUBLE)
                code.store(code.lanes_of(number), frame.memory_at(code.load(code.element(places, i, INTEGER), INTEGER)))
        frame.finish()


def word(code: Code, words: Value, index: int) -> Value:
    address = code.builder.gep(words.it, [ir.Constant(INTEGER, index)], source_etype=WORD)
    return Value(code, code.builder.zext(code.builder.load(address, typ=WORD, align=4), INTEGER))
