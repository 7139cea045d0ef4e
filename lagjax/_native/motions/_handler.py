"""The integration of few members in a call of XLA's foreign-function interface: no Python, no lock, no thread.

XLA calls a handler with a frame that has the addresses of arguments, results and one attribute: that of a `Plan`, which
tells which machine code to run, and for how long. One handler serves all kernels. It does not block: it starts a run,
does as many rounds as take one time slice, and returns what is needed to resume (`UnfinishedRun`). The caller checks
whether the run is complete, and how members ended; all rare cases are handled in Python. Outside of XLA a `Kernel`
starts in the same way, with one call.

Layouts of structures are those of `xla/ffi/api/c_api.h`, on 64 bits. `unavailable` compares its version with that of
the header of the installed XLA.
"""

import ctypes
import functools
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir

from lagjax._native.code._frame import CACHE_LINE, KINDS, LANE, Memory
from lagjax._native.code._ir import DOUBLE, INTEGER, POINTER, Code, Value, compile_module, lanes
from lagjax._native.motions._integrator import JOB

MAJOR, MINOR = 0, 3
# Offsets in bytes of the fields that a handler reads, in a call frame, in its extension, in a buffer and in a scalar.
_EXTENSION, _ARGS, _RETS, _ATTRS = 8, 72, 112, 160
_METADATA, _MAJOR, _MINOR, _TRAITS, _STATE_TYPE = 24, 24, 28, 32, 40
_DATA, _DIMS, _SCALAR_VALUE = 24, 40, 8


def unavailable(include: str) -> str | None:
    """The reason why handlers cannot be used with the XLA whose headers are in this folder; None if they can.

    The header guarantees that structures keep the offsets of their fields within a major version.
    """
    header = Path(include) / "xla" / "ffi" / "api" / "c_api.h"
    if ctypes.sizeof(ctypes.c_void_p) != 8:
        return "pointers do not have 64 bits"
    try:
        major = re.search(r"#define XLA_FFI_API_MAJOR (\d+)", header.read_text())
    except OSError:
        return f"there is no {header}"
    if major is None or int(major[1]) != MAJOR:
        return f"the version of the interface is {major and major[1]}, not {MAJOR}"
    return None


class Plan(ctypes.Structure):
    """The plan of a kernel: its functions, the size of a thread's `memory`, the settings, and the first `rounds`."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("begin", "run")),
        *((name, ctypes.c_int64) for name in ("memory", "states", "numbers", "order", "max_steps", "rounds")),
        *((name, ctypes.c_double) for name in ("rtol", "atol")),
    ]


class UnfinishedRun(NamedTuple):
    """The state of a run that stopped after a time slice: the memory of the thread and its integers.

    As an array of `size` doubles it has some unused ones, up to the next cache line, then the memory, and at the end
    64-bit integers: those of the lanes, the number of unused doubles, the idle steps of lanes, the next member, and 1
    if the run is unfinished.
    """

    memory: np.ndarray
    lanes: np.ndarray
    idle: np.ndarray
    next_member: np.ndarray

    @staticmethod
    def size(layout: Memory) -> int:
        return layout.size + CACHE_LINE + _INTEGERS

    @classmethod
    def from_array(cls, array: np.ndarray, layout: Memory) -> "UnfinishedRun":
        """A copy of the rest that a handler wrote as an array."""
        integers = array[-_INTEGERS:].view(np.int64).copy()
        lanes, (skipped, *_) = np.split(integers, [-_OTHERS])
        memory = allocate_aligned(layout.size)
        memory[: layout.size] = array[skipped : skipped + layout.size]
        return cls(memory, lanes, integers[-3:-2], integers[-2:-1])

    @staticmethod
    def counts(array: np.ndarray) -> list[int]:
        """The idle steps of lanes, the next member, and 1 if the run is unfinished, from a rest as an array."""
        return array[-3:].view(np.int64).tolist()


_OTHERS = 4  # integers after those of the lanes
_INTEGERS = len(LANE) * lanes() + _OTHERS  # also where a kernel has fewer lanes


def allocate_aligned(size: int) -> np.ndarray:
    memory = np.zeros(size + CACHE_LINE)
    return memory[(-memory.ctypes.data // 8) % CACHE_LINE :]


ARGUMENTS: tuple[str, ...] = ("ts", "y0", "params")
RESULTS: tuple[str, ...] = ("path", "y_end", "t_end", "code", "steps", "rejected", "changes", "rest")


class Handler:
    """The compiled handler: `address` is that of XLA's handler function.

    Its arguments are `ts` (1 or N, T), `y0` (N, 2n) and `params` (1 or N, P), its results `path` (N, T, 2n), `y_end`
    (N, 2n), then `t_end`, `code`, `steps` and `rejected`, each (N,), the `changes` of guards (N, G), and the `rest` of
    the run (`UnfinishedRun.size`), all of doubles. `path` is NaN at times that a member did not reach.

    `begin` does the same for Python: it takes the addresses of a plan, of the arguments and of the results, then N, T
    and the numbers of rows of `ts` and `params`.
    """

    def __init__(self):
        places = compile_handler("handler", len(ARGUMENTS), len(RESULTS), _write_begin_run, "begin_run")
        self.address, pointers = places["handler"], 1 + len(ARGUMENTS) + len(RESULTS)
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * pointers, *[ctypes.c_int64] * 4)
        self.begin = kind(places["begin_run"])


def make_once(make: Callable) -> Callable:
    """A decorator: the result is cached for the life of the process, and computed by one thread at a time."""
    lock, cached = threading.Lock(), functools.cache(make)

    @functools.wraps(make)
    def decorated(*arguments):
        with lock:
            return cached(*arguments)

    return decorated


@make_once
def handler() -> Handler:
    return Handler()


# ---- XLA's side ------------------------------------------------------------------------------------------------------


def compile_handler(name: str, arguments: int, results: int, write: Callable, *public: str) -> dict[str, int]:
    """Compile a `handler`, `XLA_FFI_Error* (XLA_FFI_CallFrame*)`, and `public` functions; their addresses.

    They are valid for the life of the process. `write(module)` returns `work(code, plan, data, dims)`, which emits the
    body from the addresses of the attribute, of the arguments and results, and of their dimensions.
    """
    module = ir.Module(name)
    module.triple = ""
    work = write(module)
    code, null = Code(module, "handler", [POINTER], lanes(), result=POINTER, public=True), ir.Constant(POINTER, None)
    (frame,) = code.arguments
    extension = load_at(frame, _EXTENSION, POINTER)
    with code.builder.if_then(code.builder.icmp_unsigned("!=", extension.it, null)):
        _write_version_answer(code, extension)
        code.builder.ret(null)
    args, rets, attrs = (load_at(frame, offset, POINTER) for offset in (_ARGS, _RETS, _ATTRS))
    plan = load_at(load_at(take_element(attrs, 0), _SCALAR_VALUE, POINTER), 0, POINTER)
    buffers = [take_element(args, i) for i in range(arguments)] + [take_element(rets, i) for i in range(results)]
    work(code, plan, *([load_at(buffer, offset, POINTER) for buffer in buffers] for offset in (_DATA, _DIMS)))
    code.builder.ret(null)
    engine, places = compile_module(module, ("handler", *public))
    _engines.append(engine)
    return places


_engines = []  # of what XLA has registered


def _write_version_answer(code: Code, extension: Value) -> None:
    """Emit the answer to XLA's query, at registration, for the version of the interface."""
    metadata, short = load_at(extension, _METADATA, POINTER), ir.IntType(32)
    for offset, number in ((_MAJOR, MAJOR), (_MINOR, MINOR), (_TRAITS, 0)):
        code.builder.store(ir.Constant(short, number), _function_address(metadata, offset).it)
    code.store(code.as_value(0, INTEGER), _function_address(metadata, _STATE_TYPE))  # a handler without state


def _function_address(base: Value, offset: int) -> Value:
    return base.code.element(base, offset, ir.IntType(8))


def load_at(base: Value, offset: int, kind: ir.Type) -> Value:
    return base.code.load(_function_address(base, offset), kind)


def take_element(array: Value, index: int) -> Value:
    return array.code.load(array.code.element(array, index, POINTER), POINTER)


# ---- the run ---------------------------------------------------------------------------------------------------------


class PlanCode:
    """A function `(plan, *arrays, members, times, rows of ts, rows of params)` under construction.

    `known` has all of these, the fields of the plan, and the strides between members, under the names of the fields of
    a job. The first three arrays are `ts`, `y0` and `params`.
    """

    def __init__(self, module: ir.Module, name: str, plan: type, arrays: tuple[str, ...]):
        kinds = [POINTER] * (1 + len(arrays)) + [INTEGER] * 4
        self.code = code = Code(module, name, kinds, lanes(), public=True)
        address, *data, members, times, rows_of_ts, rows_of_params = code.arguments
        self.known = dict(zip(arrays, data, strict=True)) | dict(members=members, times=times)
        declared: Any = plan
        for field, kind in declared._fields_:
            offset = getattr(plan, field).offset
            self.known[field] = load_at(address, offset, DOUBLE if kind is ctypes.c_double else INTEGER)
        self.known["ts_stride"] = code.select(rows_of_ts > 1, times, 0)
        self.known["params_stride"] = code.select(rows_of_params > 1, self.known["numbers"], 0)

    def run(self, kernel: str, job: type, fields: dict[str, Any], *memory: Value, rounds: Value) -> Value:
        """Emit calls of `begin` and `run` of a kernel of the plan, on the memory and the integers of a thread.

        Job fields come from `fields`, else from `known`. Returns 1 if there is more to do.
        """
        code = self.code
        given = job_of(code, job, self.known | fields)
        call_address(code, self.known[f"begin{kernel}"], ir.VoidType(), given, *memory[:2])
        return call_address(code, self.known[f"run{kernel}"], INTEGER, given, *memory, rounds)

    def skipped(self, address: Value) -> Value:
        """The number of doubles from an address to the next cache line."""
        place = Value(self.code, self.code.builder.ptrtoint(address.it, INTEGER))
        mask = ir.Constant(INTEGER, 8 * CACHE_LINE - 1)
        return Value(self.code, self.code.builder.and_((0 - place).it, mask)) / 8

    def finish(self) -> Callable:
        """Complete the function; return a `work` function of `compile_handler` that calls it."""
        function = self.code.finish()

        def work(code: Code, plan: Value, data: list[Value], dims: list[Value]) -> None:
            ts, y0, params = dims[:3]
            places = (y0, 0), (ts, 8), (ts, 0), (params, 0)
            code.call(function, plan, *data, *(load_at(size, offset, INTEGER) for size, offset in places))

        return work


def _write_begin_run(module: ir.Module) -> Callable:
    """Emit `begin_run(plan, *arguments, *results, members, times, rows of ts, rows of params)`."""
    run = PlanCode(module, "begin_run", Plan, (*ARGUMENTS, *RESULTS))
    code, known = run.code, run.known
    code.fill(known["path"], known["members"] * known["times"] * known["states"], float("nan"))
    rest, size = known["rest"], known["memory"]
    skipped = run.skipped(rest)
    memory, integers = code.element(rest, skipped), code.element(rest, size + CACHE_LINE)
    code.fill(memory, size)
    code.fill(integers, _INTEGERS, 0)
    of_skipped, idle, next_member, more = (code.element(integers, _INTEGERS - i, INTEGER) for i in (4, 3, 2, 1))
    code.store(skipped, of_skipped)
    there_is = run.run("", JOB, {"next_member": next_member}, memory, integers, idle, rounds=known["rounds"])
    code.store(there_is, more)
    return run.finish()


def job_of(code: Code, kind: type, fields: dict[str, Any]) -> Value:
    """A job structure of this kind on the stack, with the given `fields`; other fields are zero."""
    declared: Any = kind
    job = code.stack(len(declared._fields_))
    for i, (name, of_field) in enumerate(declared._fields_):
        zero = ir.Constant(KINDS[of_field], None if of_field is ctypes.c_void_p else 0)
        code.store(fields.get(name, Value(code, zero)), code.element(job, i, INTEGER))
    return job


def call_address(code: Code, function: Value, result: ir.Type, *arguments: Value) -> Value:
    kind = ir.FunctionType(result, [argument.it.type for argument in arguments])
    pointer = code.builder.inttoptr(function.it, kind.as_pointer())
    return Value(code, code.builder.call(pointer, [argument.it for argument in arguments]))
