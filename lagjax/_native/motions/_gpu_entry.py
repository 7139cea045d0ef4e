"""The entry functions of GPU programs: the loop of a thread over the members that it takes.

    MOTION       integrate members, one after another, until the shared counter is at the end
    TRANSPOSE    for each: integrate it and record its steps, then transpose these from the last to the first

The steps of a transpose are kept in a record of the thread, reused for each member, so that memory does not grow with
the number of members. A member with more steps than the record has `room` for is not `done`.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from llvmlite import ir

from lagjax._native.code._frame import CACHE_LINE, LANE
from lagjax._native.code._ir import BIT, DOUBLE, INTEGER, POINTER, Code, Value, unroll_loops
from lagjax._native.motions import _adjoint, _integrator
from lagjax._native.motions._handler import job_of
from lagjax._native.series._taylor import TaylorSeries, integer
from lagjax._native.steps._run_records import RECORDED

_ROUNDS = 2**63 - 1  # `max_steps` ends every member, and so the kernel
_WORD = ir.IntType(32)
_KINDS = {name: DOUBLE if kind is ctypes.c_double else INTEGER for name, kind in _integrator.JOB._fields_}


class Entry(NamedTuple):
    """A GPU kernel: the names of its arguments and results, in order, and of its `numbers`, passed as one argument.

    Arguments and results are addresses of arrays of doubles, except the words of `numbers` and the counter
    `next_member`. A result that is also an argument is written in place.
    """

    arguments: tuple[str, ...]
    results: tuple[str, ...]
    numbers: tuple[str, ...]

    @property
    def aliases(self) -> dict[int, int]:
        """The positions {argument: result} of arrays that are both."""
        return {self.arguments.index(name): k for k, name in enumerate(self.results) if name in self.arguments}

    def words(self, **numbers: float) -> list[int]:
        """The entry's numbers as 64-bit integers: doubles by their bits."""
        kinds: dict[str, Callable] = dict(_integrator.JOB._fields_)
        return [ctypes.c_int64.from_buffer_copy(kinds[name](numbers[name])).value for name in self.numbers]


_SIZES = ("members", "times", "ts_stride", "params_stride", "max_steps")
MOTION = Entry(
    ("ts", "y0", "params", "numbers", "next_member", "path"),
    ("next_member", "path", "y_end", "t_end", "code", "steps", "rejected", "changes"),
    (*_SIZES, "room_of_notes", "rtol", "atol"),
)
TRANSPOSE = Entry(
    ("ts", "y0", "params", "path_ct", "end_ct", "numbers", "next_member"),
    ("next_member", "y_ct", "params_ct", "excess", "done", "record"),
    (*_SIZES, "room", "rtol", "atol"),
)


class GpuForm(NamedTuple):
    """The form of a GPU program: the order of the series, and whether loops over orders are `unrolled`."""

    order: int
    unrolled: bool


class OneLane(NamedTuple):
    """The one-lane module of a motion: its text, and the sizes that an entry and the choice of a form need."""

    text: str
    size: int  # doubles that a thread remembers
    states: int  # 2n
    numbers: int  # of a member
    row: int  # doubles that are written down of a step
    series: int  # rows of the series, those of the state among them
    large: bool  # in tables, where no loop can be unrolled
    unrolled: str = ""  # the text that asks for loops to be unrolled

    @classmethod
    def from_motion(cls, motion: TaylorSeries) -> "OneLane":
        """The one-lane module of a finished integrator or adjoint."""
        states, text = motion.states, str(motion.module)
        row, series = states + RECORDED + motion.recorded_pieces, states + motion.series.rows
        if not motion.large:
            unroll_loops(motion.module)
        form = text, motion.layout.size, states, motion.member_stride, row, series, motion.large
        return cls(*form, "" if motion.large else str(motion.module))


def motion_entry(motion: OneLane, order: int) -> str:
    """The module of `MOTION`, `integrate(*arguments, *results)`: it calls `begin` and `run` of an `_integrator`."""
    thread = _IntegrateEntry(MOTION)
    job = job_of(thread.code, _integrator.JOB, thread.at | thread.numbers | {"order": integer(thread.code, order)})
    thread.run("", motion, job, thread.memory(motion.size), thread.code.stack(1))
    return thread.finish()


def transpose_entry(motion: OneLane, adjoint: OneLane, form: GpuForm) -> str:
    """The module of `TRANSPOSE`: it calls an integrator, and an `_adjoint` as `begin_back` and `run_back`."""
    return _TransposeEntry(motion, adjoint, form).finish()


class _IntegrateEntry:
    """Emits the GPU kernel `integrate`. `at`: addresses of its array arguments and results, by name."""

    def __init__(self, entry: Entry):
        self.module = ir.Module("entry")
        self.module.triple = ""
        kinds = [POINTER] * (len(entry.arguments) + len(entry.results))
        self.code = Code(self.module, "integrate", kinds, lanes=1, public=True)
        self.lanes = self.code.stack(len(LANE))
        self.at = dict(zip((*entry.arguments, *entry.results), self.code.arguments, strict=True))
        self.numbers = {
            name: self.code.load(self.code.element(self.at["numbers"], i), _KINDS[name])
            for i, name in enumerate(entry.numbers)
        }

    def finish(self) -> str:
        self.code.function.calling_convention = "ptx_kernel"
        self.code.finish()
        return str(self.module)

    def memory(self, doubles: int) -> Value:
        return self.code.stack(doubles, align=8 * CACHE_LINE)

    def run(self, name: str, motion: OneLane, job: Value, memory: Value, *more: Value) -> None:
        """Emit a call that integrates all members of a job, in a memory that is zeroed before."""
        bits = ir.Constant(ir.IntType(8), 0), integer(self.code, 8 * motion.size), ir.Constant(BIT, 0)
        self._call_function("llvm.memset.p0.i64", memory, *bits)
        self._call_function(f"begin{name}", job, memory, self.lanes)
        self._call_function(f"run{name}", job, memory, self.lanes, *more, integer(self.code, _ROUNDS), result=INTEGER)

    def _call_function(self, name: str, *arguments, result: ir.Type | None = None) -> Value:
        values = [getattr(x, "it", x) for x in arguments]
        function = self.module.globals.get(name)
        if function is None:
            kind = ir.FunctionType(result or ir.VoidType(), [x.type for x in values])
            function = ir.Function(self.module, kind, name)
        return Value(self.code, self.code.builder.call(function, values))

    def index(self) -> Value:
        def register(name):
            read = self._call_function(f"llvm.nvvm.read.ptx.sreg.{name}.x", result=_WORD)
            return Value(self.code, self.code.builder.zext(read.it, INTEGER))

        return register("ctaid") * register("ntid") + register("tid")

    @contextmanager
    def members(self) -> Iterator[Value]:
        """A context: its body is emitted as a loop over the members that the thread takes."""
        code, counter = self.code, self.at["next_member"]
        member = code.variable(code.count_up(counter))
        with code.repeat_while(lambda: member.value < self.numbers["members"]):
            yield member.value
            member.value = code.count_up(counter)


class _TransposeEntry(_IntegrateEntry):
    """Emits the kernel of `transpose_entry`."""

    def __init__(self, motion: OneLane, adjoint: OneLane, form: GpuForm):
        super().__init__(TRANSPOSE)
        code, states = self.code, motion.states
        self.states = states
        self.common = self.numbers | {"members": integer(self.code, 1), "order": integer(self.code, form.order)}
        self.ends, self.path, self.y_end = self.code.stack(2), self.code.stack(2 * states), self.code.stack(states)
        names = ("t_end", "code", "steps", "rejected", "next_member", "next_row", "first_step", "steps_back", "idle")
        self.own = {name: self.code.stack(1) for name in names}
        self.record = code.element(self.at["record"], self.index() * self.numbers["room"] * motion.row)
        self.motion, self.adjoint = motion, adjoint
        # One memory after the other, or one for both: loops that are unrolled leave none of the first two.
        shared = None if form.unrolled else self.memory(max(motion.size, adjoint.size))
        self.memories = [shared or self.memory(lane.size) for lane in (motion, adjoint)]
        with self.members() as member:
            self._transpose_motion(member)

    def _transpose_motion(self, member: Value) -> None:
        code, numbers = self.code, self.numbers

        def member_address(name: str, stride: Value | int) -> Value:
            return code.element(self.at[name], member * stride)

        ts, params = member_address("ts", numbers["ts_stride"]), member_address("params", numbers["params_stride"])
        y_ct, params_ct = member_address("y_ct", self.states), member_address("params_ct", self.motion.numbers)
        self._follow_motion(ts, member_address("y0", self.states), params)
        code.copy(member_address("end_ct", self.states), y_ct, self.states)
        code.fill(params_ct, self.motion.numbers)
        code.store(code.as_value(0.0, DOUBLE), member_address("excess", 1))
        fits = code.load(self.own["next_row"], INTEGER) <= numbers["room"]
        code.store(code.flag(fits), member_address("done", 1))
        with code.only_if(fits):
            path_ct = member_address("path_ct", numbers["times"] * self.states)
            self._transpose_steps(ts=ts, params=params, path_ct=path_ct, y_ct=y_ct, params_ct=params_ct,
                          excess=member_address("excess", 1))  # fmt: skip

    def _follow_motion(self, ts: Value, y0: Value, params: Value) -> None:
        """Emit the integration of a member from the first to the last output time, with its steps recorded."""
        code, own = self.code, self.own
        for i, time in enumerate((integer(self.code, 0), self.numbers["times"] - 1)):
            code.store(code.load(code.element(ts, time), DOUBLE), code.element(self.ends, i))
        for name in ("next_member", "next_row"):
            code.store(integer(self.code, 0), own[name])
        fields = self.common | own | dict(record=self.record, times=integer(self.code, 2))
        fields |= dict(ts=self.ends, y0=y0, params=params, path=self.path, y_end=self.y_end)
        self.run("", self.motion, job_of(code, _integrator.JOB, fields), self.memories[0], own["idle"])

    def _transpose_steps(self, **arrays: Value) -> None:
        """Emit the transposes of the recorded steps, from the last one."""
        code, own = self.code, self.own
        taken = code.as_integer(code.load(own["steps"], DOUBLE))
        for name, start in (("next_member", 0), ("first_step", 0), ("steps_back", taken)):
            code.store(code.as_value(start, INTEGER), own[name])
        fields = self.common | own | arrays | dict(record=self.record, steps=own["steps_back"])
        self.run("_back", self.adjoint, job_of(code, _adjoint.JOB, fields), self.memories[1])
