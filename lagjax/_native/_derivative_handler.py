"""First derivatives of a few short motions as calls of XLA: no Python, no steps that are kept from before.

    run again, with the steps written down ─► in the order of the members ─► forward along directions, or back

A motion that takes less time than Python does is run once more rather than have its steps travel through a program of
JAX. Nothing is continued here: where the rounds of the plan are not enough, or a member does not reach its end, the
handler says that it is not done, and its caller takes another way.
"""

import ctypes
import functools
import threading
from typing import NamedTuple

from llvmlite import ir

from lagjax._native import _adjoint, _integrator, _tangent
from lagjax._native._constants import DONE
from lagjax._native._frame import CACHE_LINE
from lagjax._native._handler import call, handler_function, job_of, load_at, run_call
from lagjax._native._ir import DOUBLE, INTEGER, POINTER, Code, Value, compile_module, lanes
from lagjax._native._run_records import RECORDED

_COUNTERS = 4  # next member of both sweeps, next row, idle lanes
_POINTERS = ("begin", "run", "begin_sweep", "run_sweep")
_SIZES = ("memory", "lane_integers", "memory_of_sweep", "lane_integers_of_sweep")
_NUMBERS = ("states", "numbers", "order", "max_steps", "rounds", "room", "directions", "others")


class DerivativePlan(ctypes.Structure):
    """The plan of a handler: the functions of both kernels, doubles and integers of a thread of each, and how to run.

    Steps of `room` are written down; `rounds` are those of the motion. `others` counts the doubles of a member in the
    second result.
    """

    _fields_ = [
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int64) for name in (*_SIZES, *_NUMBERS)),
        *((name, ctypes.c_double) for name in ("rtol", "atol", "floor")),
    ]

    def scratch(self, members: int, times: int) -> int:
        """The doubles that a handler needs for itself."""
        rows = 2 * self.room * (self.states + RECORDED)
        for_members = members * (times * self.states + self.states + 4 + 2)
        return rows + for_members + _COUNTERS + sum(getattr(self, name) for name in _SIZES) + 2 * CACHE_LINE


class Kind(NamedTuple):
    """A sweep: the structure of its job; its fields for the third argument, the first result and the second.

    The first result begins as the fourth argument, the second as this number.
    """

    job: type
    argument: str
    first: str
    second: str
    begin: float


KINDS = {
    "jvp": Kind(_tangent.JOB, "params_dot", "y_dot", "path_dot", float("nan")),
    "vjp": Kind(_adjoint.JOB, "path_ct", "y_ct", "params_ct", 0.0),
}
ARGUMENTS, RESULTS = ("ts", "y0", "params", "argument", "start"), ("first", "second", "excess", "done", "scratch")


class SweepHandler:
    """XLA's handler for one kind of sweep, at `address`, for as long as this object lives.

    Its arguments are `ts` (1 or N, T), `y0` (N, 2n), `params` (1 or N, P), then for "jvp" the tangents of the
    parameters (N, m, P) and of the states (N, m, 2n), for "vjp" the cotangents of the outputs (N, T, 2n) and of the end
    (N, 2n). Its results are the tangents of the end and of the outputs (N, m, T, 2n), or the cotangents of the states
    and of the parameters (N, P); `excess` (N,); `done`, 1 or 0; and what it needs for itself.
    """

    def __init__(self, kind: str):
        module = ir.Module(kind)
        module.triple = ""
        handler_function(module, len(ARGUMENTS), len(RESULTS), run_call(_SweepCode(module, KINDS[kind]).code))
        self._engine, places = compile_module(module, ("handler",))
        self.address = places["handler"]


_lock = threading.Lock()


def derivative_handler(kind: str) -> SweepHandler:
    """The handler of this process for the `kind` "jvp" or "vjp", made at the first call."""
    with _lock:
        return _make_handler(kind)


@functools.cache
def _make_handler(kind: str) -> SweepHandler:
    return SweepHandler(kind)


class _SweepCode:
    """Writes down `sweep(plan, *arguments, *results, members, times, rows of ts, rows of params)`."""

    def __init__(self, module: ir.Module, kind: Kind):
        kinds = [POINTER] * (1 + len(ARGUMENTS) + len(RESULTS)) + [INTEGER] * 4
        self.code, self.kind = Code(module, "sweep", kinds, lanes()), kind
        self.plan, *pointers, self.members, self.times, rows_of_ts, rows_of_params = self.code.arguments
        self.data = dict(zip((*ARGUMENTS, *RESULTS), pointers, strict=True))
        self.strides = dict(
            ts_stride=self.code.select(rows_of_ts > 1, self.times, 0),
            params_stride=self.code.select(rows_of_params > 1, self.read_plan("numbers"), 0),
        )
        self._carve()
        self._write()
        self.code.finish()

    def read_plan(self, name: str, kind: ir.Type = INTEGER) -> Value:
        return load_at(self.plan, getattr(DerivativePlan, name).offset, kind)

    def _carve(self) -> None:
        """Give every array of the scratch its place: the memories of both kernels first, on cache lines, of zeros."""
        code, members, states = self.code, self.members, self.read_plan("states")
        address = Value(code, code.builder.ptrtoint(self.data["scratch"].it, INTEGER))
        mask = ir.Constant(INTEGER, 8 * CACHE_LINE - 1)
        end = code.element(self.data["scratch"], Value(code, code.builder.and_((0 - address).it, mask)) / 8)
        rows = self.read_plan("room") * (states + RECORDED)
        sizes = {
            **{name: self.read_plan(name) for name in ("memory", "memory_of_sweep")},
            **{name: self.read_plan(name) for name in ("lane_integers", "lane_integers_of_sweep")},
            "counters": code.as_value(_COUNTERS, INTEGER),
            **dict.fromkeys(("first_step", "counts"), members),
            "path": members * self.times * states,
            "y_end": members * states,
            **dict.fromkeys(("t_end", "code", "steps", "rejected"), members),
            **dict.fromkeys(("rows", "record"), rows),
        }
        self.at, total = {}, code.as_value(0, INTEGER)
        for name, size in sizes.items():
            self.at[name] = code.element(end, total)
            total = total + size
            if name == "counters":
                zeros = total
        with code.loop(zeros) as i:
            code.store(code.as_value(0.0, DOUBLE), code.element(end, i))

    def _write(self) -> None:
        code, done = self.code, self.data["done"]
        code.store(code.as_value(0.0, DOUBLE), done)
        with code.only_if(self._run()):
            self._order()
            self._begin_results()
            more = self._sweep()
            code.store(code.select(code.compare("==", more, 0), code.as_value(1.0, DOUBLE), 0.0), done)

    def _counter(self, i: int) -> Value:
        return self.code.element(self.at["counters"], i, INTEGER)

    def _run(self) -> Value:
        """Run the motions, with their steps written down; whether all reached their end."""
        code, data, place = self.code, self.data, self.at
        fields = {name: data[name] for name in ("ts", "y0", "params")} | self.strides
        fields |= {name: place[name] for name in ("path", "y_end", "t_end", "code", "steps", "rejected")}
        fields |= {name: self.read_plan(name) for name in ("order", "max_steps", "room")}
        fields |= {name: self.read_plan(name, DOUBLE) for name in ("rtol", "atol")}
        fields |= dict(members=self.members, times=self.times, record=place["rows"])
        fields |= dict(next_member=self._counter(0), next_row=self._counter(1))
        job = job_of(code, _integrator.JOB, fields)
        given = job, place["memory"], place["lane_integers"]
        call(code, self.read_plan("begin"), ir.VoidType(), *given)
        more = call(code, self.read_plan("run"), INTEGER, *given, self._counter(2), self.read_plan("rounds"))
        well = code.variable(code.select(code.compare("==", more, 0), code.as_value(1, INTEGER), 0))
        with code.only_if(well.value > 0), code.loop(self.members) as i:
            ended = code.load(code.element(place["code"], i), DOUBLE)
            with code.only_if(code.compare("!=", ended, float(DONE))):
                well.value = 0
        return well.value > 0

    def _order(self) -> None:
        """The rows of the steps, member by member."""
        code, place, width = self.code, self.at, self.read_plan("states") + RECORDED
        first = code.variable(code.as_value(0, INTEGER))
        with code.loop(self.members) as i:
            count = code.as_integer(code.load(code.element(place["steps"], i), DOUBLE))
            begin = first.value
            code.store(count, code.element(place["counts"], i, INTEGER))
            code.store(begin, code.element(place["first_step"], i, INTEGER))
            first.value = begin + count
        with code.loop(code.load(self._counter(1), INTEGER)) as i:
            row = code.element(place["rows"], i * width)
            member, step = (code.as_integer(code.load(code.element(row, k), DOUBLE)) for k in (2, 3))
            to = code.load(code.element(place["first_step"], member, INTEGER), INTEGER) + step
            with code.loop(width) as k:
                number = code.load(code.element(row, k), DOUBLE)
                code.store(number, code.element(place["record"], to * width + k))

    def _begin_results(self) -> None:
        code, data, members = self.code, self.data, self.members
        with code.loop(members * self.read_plan("directions") * self.read_plan("states")) as i:
            code.store(code.load(code.element(data["start"], i), DOUBLE), code.element(data["first"], i))
        with code.loop(members * self.read_plan("others")) as i:
            code.store(code.as_value(self.kind.begin, DOUBLE), code.element(data["second"], i))
        with code.loop(members) as i:
            code.store(code.as_value(0.0, DOUBLE), code.element(data["excess"], i))

    def _sweep(self) -> Value:
        """The sweep over the steps; 1 if there is more to do."""
        code, data, place, kind = self.code, self.data, self.at, self.kind
        fields = {name: data[name] for name in ("ts", "params", "excess")} | self.strides
        fields |= {kind.argument: data["argument"], kind.first: data["first"], kind.second: data["second"]}
        fields |= dict(record=place["record"], first_step=place["first_step"], steps=place["counts"])
        fields |= dict(members=self.members, times=self.times, order=self.read_plan("order"))
        fields |= dict(directions=self.read_plan("directions"), floor=self.read_plan("floor", DOUBLE))
        fields |= dict(next_member=self._counter(3))
        job = job_of(code, kind.job, fields)
        given = job, place["memory_of_sweep"], place["lane_integers_of_sweep"]
        call(code, self.read_plan("begin_sweep"), ir.VoidType(), *given)
        rounds = self.read_plan("room") + self.members  # a step a round, and more where a lane takes a member
        return call(code, self.read_plan("run_sweep"), INTEGER, *given, rounds)
