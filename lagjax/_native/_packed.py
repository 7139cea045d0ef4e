"""Tables for one member alone: alike operations of one program stand in the lanes of vectors.

The memory of a thread holds one number where that of a batch holds a vector. A program is a row of integers, one piece
for every run of operations (see `_packs`):

    kind, how many vectors, where the results begin, where the operands begin that lie side by side or are one number,
    then for each vector where its other operands lie;  kind, …;  0

and `execute` walks along it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from llvmlite import ir

from lagjax._native._frame import CACHE_LINE, Frame, Numbers, Vectors, integers
from lagjax._native._ir import DOUBLE, INTEGER, Code, Value
from lagjax._native._packs import (
    ANYWHERE,
    ONE,
    SIDE_BY_SIDE,
    Arranged,
    Run,
    Stage,
    arrangement,
    limit_modes,
    stages,
    vector_runs,
)
from lagjax._native._schedule import OperationKind, join_operations
from lagjax._native._tables import WORD, Tables, word
from lagjax._program._series import StraightLine

_COPY, _STORE = (OperationKind(op, None, ("float",), "float", (None,)) for op in ("copy", "store"))


class _StoredProgram(NamedTuple):
    """A program with the kinds of its operations, in stages; its last outputs, this many, are stored somewhere else."""

    kinds: list[OperationKind]
    stages: list[Stage]
    stored: int


class Packed(Tables):
    """The form of large kernels of one member; vectors have this many `lanes`.

    `function(name, *kinds)` makes a function of the kernel, with its frame; `wide` one whose vectors have these lanes.
    """

    def __init__(self, function, wide, sincos: Code, lanes: int):
        self.lanes = lanes
        self._numbers: dict[tuple[OperationKind, tuple[int, ...]], int] = {}
        self._programs: dict[StraightLine, _StoredProgram] = {}
        self._arranged: dict[tuple, tuple[Arranged, str]] = {}
        super().__init__(function, sincos, wide)

    # ---- what a kernel is written with ----

    def run(
        self, frame: Frame, line: StraightLine, *inputs: "Sequence[Value] | Vectors", to: "Vectors | None" = None
    ) -> Numbers:
        """The outputs of a program, of which these are the inputs, one after the other; a bool is 1 or 0.

        They stay until this place of the kernel is passed again. The last outputs go `to` some other place instead;
        where the same program is run without one, nothing becomes of them.
        """
        if to is None and line in self._programs:
            stored = self._programs[line].stored
        else:
            stored = 0 if to is None else len(to)
        plan, name, staying = self._arrangement(line, self._places(frame, inputs), stored)
        kinds = self._programs[line].kinds
        outputs = plan.places[list(line.outputs)]
        runs = [(kinds[run.kind], run) for run in limit_modes(plan.runs, self.lanes)]
        first = self._layout.place(name, 0)
        runs += [(_COPY, run) for run in vector_runs(0, outputs[None, :staying], np.array([first])) if staying]
        if to is not None:
            runs += [(_STORE, run) for run in _stores(outputs[len(outputs) - stored :], to)]
        words = [number for kind, run in runs for number in self._piece(kind, run)]
        table = Value(frame.code, integers(self._module, np.array([*words, 0], np.int32)))
        shift = None if to is None else to.shift
        frame.call(self._execute.code, table, frame.code.as_value(0 if shift is None else shift, INTEGER))
        return frame.vectors(name, staying)

    def ranks(self, line: StraightLine, inputs: list[int], stored: int, keep: bool = True) -> np.ndarray:
        """The order in which the last outputs of a program lie beside each other, where its inputs lie there.

        Those that are other outputs too come first, in the order of these. With `keep` it will be run so.
        """
        if keep:
            plan, _, _ = self._arrangement(line, inputs, stored)
        else:
            places = self._places_of(line, inputs)
            plan = arrangement(self._program(line, stored), places, self._layout.end, self.lanes)
        staying = len(line.outputs) - stored
        first = {node: k - staying for k, node in reversed(list(enumerate(line.outputs[:staying])))}
        keys = [first.get(node, int(plan.places[node])) for node in line.outputs[staying:]]
        ranks = np.empty(stored, int)
        ranks[np.argsort(keys, kind="stable")] = np.arange(stored)
        return ranks

    # ---- where numbers lie ----

    def _field(self, count: int) -> str:
        """A new field of the memory; behind its numbers there is room for a vector, which may be read or written."""
        return super()._field(-(-(count + self.lanes) // CACHE_LINE) * CACHE_LINE)

    def _arrangement(self, line: StraightLine, inputs: list[int], stored: int) -> tuple[Arranged, str, int]:
        """The program as runs, the field in which its numbers lie, and how many outputs stay there."""
        key, program = (line, tuple(inputs)), self._program(line, stored)
        if key not in self._arranged:
            places = self._places_of(line, inputs)
            staying = len(line.outputs) - stored
            begin = -(-(self._layout.end + staying + self.lanes) // CACHE_LINE) * CACHE_LINE
            plan = arrangement(program, places, begin, self.lanes)
            self._arranged[key] = plan, self._field(begin - self._layout.end + plan.size)
        plan, name = self._arranged[key]
        return plan, name, len(line.outputs) - stored

    def _places_of(self, line: StraightLine, inputs: list[int]) -> np.ndarray:
        """The places of the inputs and the numbers of a program."""
        places = np.full(len(line.nodes), -1)
        for i, (op, _, attribute) in enumerate(line.nodes):
            if op == "input":
                places[i] = inputs[attribute]
            elif op == "constant":
                places[i] = self._constant(float(attribute))
        return places

    def _program(self, line: StraightLine, stored: int) -> list[Stage]:
        if line not in self._programs:
            kinds, operations = join_operations(line)
            program = stages(operations, len(line.nodes), line.outputs)
            self._programs[line] = _StoredProgram(kinds.all, program, stored)
        return self._programs[line].stages

    # ---- the table of a program ----

    def _piece(self, kind: OperationKind, run: Run) -> list[int]:
        """The words of a run."""
        number = self._numbers.setdefault((kind, run.modes), len(self._numbers) + 1)
        vectors = -(-run.count // self.lanes)
        words = [number, vectors, *run.results]
        words += [place for place, mode in zip(run.operands, run.modes, strict=True) if mode != ANYWHERE]
        lists = [
            np.pad(places, (0, vectors * self.lanes - run.count), mode="edge").reshape(vectors, self.lanes)
            for places, mode in zip(run.operands, run.modes, strict=True)
            if mode == ANYWHERE
        ]
        return words + (np.concatenate(lists, axis=1).ravel().tolist() if lists else [])

    # ---- the code ----

    def _write_execute(self) -> None:
        """`(table, shift)`: run a program; what is stored lies this many doubles behind where the table says."""
        frame, code = self._execute, self._execute.code
        table, _ = frame.arguments
        at = code.variable(table)
        head, end = (code.function.append_basic_block(name) for name in ("next", "end"))
        code.builder.branch(head)
        code.builder.position_at_end(head)
        switch = code.builder.switch(word(code, at.value, 0).it, end)
        for (kind, modes), number in self._numbers.items():
            block = code.function.append_basic_block(kind.op)
            switch.add_case(ir.Constant(INTEGER, number), block)
            code.builder.position_at_end(block)
            at.value = self._write_run(at.value, kind, modes)
            code.builder.branch(head)
        code.builder.position_at_end(end)
        frame.finish()

    def _write_run(self, words: Value, kind: OperationKind, modes: tuple[int, ...]) -> Value:
        """The code of a run; where the next one begins."""
        frame, code, lanes = self._execute, self._execute.code, self.lanes
        shift = frame.arguments[1]
        results = [frame.memory_at(word(code, words, 2 + k)) for k in range(kind.results)]
        if kind.op == "store":
            results = [code.element(result, shift) for result in results]
        at, lists = 2 + kind.results, modes.count(ANYWHERE)
        fixed: list[Value] = []  # addresses, or numbers
        for mode in modes:
            address = frame.memory_at(word(code, words, at))  # of no use where it lies anywhere
            at += mode != ANYWHERE
            fixed.append(code.lanes_of(code.load(address, DOUBLE)) if mode == ONE else address)
        tail, vectors = code.element(words, at, WORD), word(code, words, 1)

        def operand(k: int, i: Value) -> Value:
            if modes[k] == ONE:
                return fixed[k]
            if modes[k] == SIDE_BY_SIDE:
                return code.load_packed(code.element(fixed[k], i * lanes))
            place = (i * lists + modes[:k].count(ANYWHERE)) * lanes
            return code.gather(
                frame.memory_at(code.as_value(0, INTEGER)), code.offsets(code.element(tail, place, WORD))
            )

        with code.loop(vectors) as i:
            operands = [operand(k, i) for k in range(len(modes))]
            for result, address in zip(self._results(kind, iter(operands)), results, strict=True):
                code.store_packed(result, code.element(address, i * lanes))
        return code.element(tail, vectors * (lists * lanes), WORD)


def _stores(places: np.ndarray, to: Vectors) -> Iterator[Run]:
    """The runs that store numbers of these places; what vectors that are not full write beyond is written over."""
    assert to.place is not None
    targets = np.array([to.place(i) for i in range(len(to))])
    order = np.argsort(targets)
    assert (np.diff(targets[order]) == 1).all()
    yield from vector_runs(0, places[order][None], targets[order][:1])
