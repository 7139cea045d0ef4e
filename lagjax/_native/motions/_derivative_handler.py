"""First derivatives of few short motions in one call of XLA, without Python.

    run again with steps recorded ─► sort the steps by member ─► tangents along directions, or cotangents

A motion that takes less time than a call of Python is computed again instead of passing its steps through a JAX
program. The handler does not resume: if the rounds of the plan do not suffice, or a member does not reach its end, it
returns "not done", and the caller uses the general path.
"""

import ctypes
from typing import NamedTuple

from llvmlite import ir

from lagjax._native.code._constants import DONE
from lagjax._native.code._frame import CACHE_LINE
from lagjax._native.code._ir import DOUBLE, INTEGER, Value
from lagjax._native.motions import _adjoint, _integrator, _tangent
from lagjax._native.motions._handler import PlanCode, compile_handler, make_once
from lagjax._native.steps._run_records import RECORDED

_COUNTERS = 4  # next member of the motion and of its derivative, next row, idle lanes
_POINTERS = ("begin", "run", "begin_derivative", "run_derivative")
_SIZES = ("memory", "memory_of_derivative", "lane_integers", "lane_integers_of_derivative")
_NUMBERS = ("states", "numbers", "order", "max_steps", "rounds", "room", "directions", "others")


class DerivativePlan(ctypes.Structure):
    """The plan of a handler: functions of both kernels, sizes of their memories, and the settings of the run.

    Up to `room` steps are recorded; `rounds` are those of the motion, `others` the doubles per member of the second
    result.
    """

    _fields_ = [
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int64) for name in (*_SIZES, *_NUMBERS)),
        *((name, ctypes.c_double) for name in ("rtol", "atol", "floor")),
    ]

    def scratch(self, members: int, times: int) -> int:
        """The size, in doubles, of the scratch memory of a handler."""
        rows = 2 * self.room * (self.states + RECORDED)
        for_members = members * (times * self.states + self.states + 4 + 2)
        return rows + for_members + _COUNTERS + sum(getattr(self, name) for name in _SIZES) + 2 * CACHE_LINE


class Kind(NamedTuple):
    """A kind of derivative: its job structure, and which fields take the third argument and the two results."""

    job: type
    argument: str
    first: str  # begins as the fourth argument
    second: str
    begin: float  # as which the second begins


KINDS = {
    "jvp": Kind(_tangent.JOB, "params_dot", "y_dot", "path_dot", float("nan")),
    "vjp": Kind(_adjoint.JOB, "path_ct", "y_ct", "params_ct", 0.0),
}
ARGUMENTS, RESULTS = ("ts", "y0", "params", "argument", "start"), ("first", "second", "excess", "done", "scratch")


@make_once
def derivative_handler(kind: str) -> int:
    """The address of XLA's handler for the `kind` "jvp" or "vjp", compiled at the first call.

    Its arguments are `ts` (1 or N, T), `y0` (N, 2n), `params` (1 or N, P), then for "jvp" the tangents of the
    parameters (N, m, P) and of the states (N, m, 2n), for "vjp" the cotangents of the outputs (N, T, 2n) and of the end
    (N, 2n). Its results are the tangents of the end and of the outputs (N, m, T, 2n), or the cotangents of the states
    and of the parameters (N, P); `excess` (N,); `done`, 1 or 0; and scratch memory.
    """
    write = lambda module: _DerivativeCode(module, KINDS[kind]).finish()  # noqa: E731
    return compile_handler(kind, len(ARGUMENTS), len(RESULTS), write)["handler"]


class _DerivativeCode(PlanCode):
    """Emits `derivative(plan, *arguments, *results, members, times, rows of ts, rows of params)`."""

    def __init__(self, module: ir.Module, kind: Kind):
        super().__init__(module, "derivative", DerivativePlan, (*ARGUMENTS, *RESULTS))
        self.kind = kind
        self._place_arrays()
        code, done = self.code, self.known["done"]
        code.store(code.as_value(0.0, DOUBLE), done)
        with code.only_if(self._run_motions()):
            self._sort_steps()
            self._begin_results()
            more = self._differentiate_steps()
            code.store(code.select(code.compare("==", more, 0), code.as_value(1.0, DOUBLE), 0.0), done)

    def _place_arrays(self) -> None:
        """Divide the scratch memory among its arrays: first the memories of both kernels, cache-aligned and zeroed."""
        code, known, scratch = self.code, self.known, self.known["scratch"]
        end, rows = code.element(scratch, self.skipped(scratch)), known["room"] * (known["states"] + RECORDED)
        members = known["members"]
        sizes = {
            **{name: known[name] for name in _SIZES},
            "counters": code.as_value(_COUNTERS, INTEGER),
            **dict.fromkeys(("first_step", "counts"), members),
            "path": members * known["times"] * known["states"],
            "y_end": members * known["states"],
            **dict.fromkeys(("t_end", "code", "steps", "rejected"), members),
            **dict.fromkeys(("rows", "record"), rows),
        }
        self.at, total = {}, code.as_value(0, INTEGER)
        for name, size in sizes.items():
            self.at[name] = code.element(end, total)
            total = total + size
            if name == "counters":
                zeros = total
        code.fill(end, zeros)

    def _new_counter(self, i: int) -> Value:
        return self.code.element(self.at["counters"], i, INTEGER)

    def _run_motions(self) -> Value:
        """Run the motions and record their steps; the flag that all reached their end."""
        code, place = self.code, self.at
        fields = place | dict(record=place["rows"], next_member=self._new_counter(0), next_row=self._new_counter(1))
        memory = place["memory"], place["lane_integers"], self._new_counter(2)
        more = self.run("", _integrator.JOB, fields, *memory, rounds=self.known["rounds"])
        well = code.variable(code.select(code.compare("==", more, 0), code.as_value(1, INTEGER), 0))
        with code.only_if(well.value > 0), code.loop(self.known["members"]) as i:
            ended = code.load(code.element(place["code"], i), DOUBLE)
            with code.only_if(code.compare("!=", ended, float(DONE))):
                well.value = 0
        return well.value > 0

    def _sort_steps(self) -> None:
        """Sort the recorded steps by member."""
        code, place, width = self.code, self.at, self.known["states"] + RECORDED
        first = code.variable(code.as_value(0, INTEGER))
        with code.loop(self.known["members"]) as i:
            count = code.as_integer(code.load(code.element(place["steps"], i), DOUBLE))
            begin = first.value
            code.store(count, code.element(place["counts"], i, INTEGER))
            code.store(begin, code.element(place["first_step"], i, INTEGER))
            first.value = begin + count
        with code.loop(code.load(self._new_counter(1), INTEGER)) as i:
            row = code.element(place["rows"], i * width)
            member, step = (code.as_integer(code.load(code.element(row, k), DOUBLE)) for k in (2, 3))
            to = code.load(code.element(place["first_step"], member, INTEGER), INTEGER) + step
            code.copy(row, code.element(place["record"], to * width), width)

    def _begin_results(self) -> None:
        code, known = self.code, self.known
        code.copy(known["start"], known["first"], known["members"] * known["directions"] * known["states"])
        code.fill(known["second"], known["members"] * known["others"], self.kind.begin)
        code.fill(known["excess"], known["members"])

    def _differentiate_steps(self) -> Value:
        """Run the derivative over the recorded steps; 1 if there is more to do."""
        known, place, kind = self.known, self.at, self.kind
        fields = {kind.argument: known["argument"], kind.first: known["first"], kind.second: known["second"]}
        fields |= dict(record=place["record"], first_step=place["first_step"], steps=place["counts"])
        fields |= dict(next_member=self._new_counter(3))
        memory = place["memory_of_derivative"], place["lane_integers_of_derivative"]
        rounds = known["room"] + known["members"]  # a step a round, and more where a lane takes a member
        return self.run("_derivative", kind.job, fields, *memory, rounds=rounds)
