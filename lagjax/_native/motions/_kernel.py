"""The machine code of a motion, and of its derivatives, as functions of NumPy arrays."""

import ctypes
import functools
import itertools
import os
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from lagjax._native.code._constants import ATOL_OVER_RTOL, DONE, MOTIONS_PER_ADJOINT, VECTORS_PER_THREAD
from lagjax._native.code._frame import LANE
from lagjax._native.code._ir import compile_module, lanes
from lagjax._native.motions import _gpu
from lagjax._native.motions._adjoint import Adjoint
from lagjax._native.motions._derivative_handler import DerivativePlan
from lagjax._native.motions._handler import Plan, UnfinishedRun, allocate_aligned, handler
from lagjax._native.motions._integrator import Integrator
from lagjax._native.motions._tangent import Tangent
from lagjax._native.motions._threads import SLICE, run_in_slices, run_on_threads
from lagjax._native.series._guards import Guards
from lagjax._native.series._motion_parts import ChosenParameters, MotionParts, Projection, choose_parameters
from lagjax._native.series._table_reads import SET_NUMBERS
from lagjax._native.series._taylor import TaylorSeries, choose_order, size_of_series
from lagjax._native.steps._run_records import RECORDED
from lagjax._program import Borders, Nesting, Recurrent

# What a round takes for each operation of the acceleration: 0.03 to 0.1 µs, more where members go back over steps.
# It decides the length of the first slice, for which a rough value is enough.
_SECONDS_AN_OPERATION = 1e-7
# A handler takes derivatives of motions that take a thirtieth of a slice, a millisecond at most. Where fewer rounds
# than these are in that, hardly a motion ends in time, and would be run twice for nothing.
_RERUNS_PER_SLICE, _LEAST_ROUNDS = 30, 16


class Outcome(NamedTuple):
    """The results of a run of N members, T output times and 2n states.

    A row of `table` (rows, 2n + 4) is a recorded step, sorted by member: its time, its size, the number of the member,
    that of the step, its first state. For a piecewise program the pieces follow, and the number of the border at its
    end.
    """

    path: np.ndarray  # (N, T, 2n), the states (q, q̇) at the output times, NaN where a member did not come
    y_end: np.ndarray  # (N, 2n), where each member ended
    t_end: np.ndarray  # (N,)
    code: np.ndarray  # (N,), how it ended
    steps: np.ndarray  # (N,)
    rejected: np.ndarray  # (N,), steps that were too long
    changes: np.ndarray  # (N, G), how each guard changes where an event ended a member (`Change`)
    idle: int  # steps for which lanes were idle
    table: np.ndarray | None
    complete: np.ndarray | None  # (N,), whether all steps of a member are there, Σ steps of such members before it on


class Steps(NamedTuple):
    """The recorded steps of N members, with series of this `order`: rows `first[k]` on, `counts[k]` of them.

    The rows are those of `table`, that of an `Outcome`. If it is one of several runs, member k was number `rows[k]` of
    the run of `kernel`.
    """

    table: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    order: int
    kernel: Any = None
    rows: Any = None

    def select_members(self, places) -> "Steps":
        return self._replace(first=self.first[places], counts=self.counts[places], rows=self.rows[places])

    def split_members(self) -> Iterator[tuple[int, np.ndarray]]:
        """Pairs (k, table) of the index of a member and the rows of `table` that are its steps."""
        for row, first, count in zip(self.rows.tolist(), self.first, self.counts, strict=True):
            yield row, self.table[first : first + count]


class RunResults(NamedTuple):
    """The results of a run as a handler left it (`_handler.Handler`), perhaps incomplete; arrays of NumPy or JAX."""

    path: Any
    y_end: Any
    t_end: Any
    code: Any
    steps: Any
    rejected: Any
    changes: Any
    rest: Any


class Kernel:
    """The integration of (q, q̇), with q̈ from a program of q, q̇, t and constant parameters, for batches.

    The outputs of the program are the n accelerations, then whether the mass matrix is singular. `projection` is
    applied to the state after every step, and to the outputs after the first. `guards`, of the same inputs, end the
    motion of a member with the code `EVENT`; or their changes are noted while the motion continues: then notes replace
    states at output times. Errors are relative to each coordinate, or to the largest one of those with the same number
    in `error_groups` (n,). The coordinates may be those of a motion with its tangents (`nesting`); then `motion` is the
    program of the motion alone. Vectors have `width` lanes, by default those of the processor. Raises `Unlowerable`
    where an operation has no Taylor series or is not one of doubles.
    """

    def __init__(
        self,
        program: Recurrent,
        size: int,
        projection: Projection | None = None,
        guards: Guards | None = None,
        error_groups: tuple[int, ...] | None = None,
        nesting: Nesting | None = None,
        width: int | None = None,
        motion: Recurrent | None = None,
    ):
        self.states, self.numbers = 2 * size, program.size - 2 * size - 1
        nesting = nesting or Nesting(size)
        self._given: dict[str, Any] = dict(
            program=program, size=size, projection=projection, guards=guards, error_groups=error_groups,
            nesting=nesting, motion=motion,
        )  # fmt: skip
        program, projection, self._guards, motion, chosen = choose_parameters(
            program, projection, guards, motion, nesting
        )
        self._smooth = MotionParts.from_program(program, size, projection, chosen)
        self._parts = self._smooth.append_guards(nesting, self._guards, motion)
        self._error_groups = error_groups
        self.width = lanes() if width is None else width
        self._tangents = functools.cache(self._compile_tangents)
        self._rounds = max(1, int(SLICE / (_SECONDS_AN_OPERATION * len(program.line.nodes))))

    def select_width(self, members: int) -> "Kernel":
        """The kernel for this many members: for a single one that with one lane, since further lanes would be idle."""
        return self._single_member_kernel if members == 1 < self.width else self

    @functools.cached_property
    def _single_member_kernel(self) -> "Kernel":
        return Kernel(**self._given, width=1)

    @property
    def borders(self) -> Borders | None:
        return self._parts.borders

    @property
    def chosen(self) -> ChosenParameters | None:
        """The parameters of a member that the programs compute with; None for all."""
        return self._parts.chosen

    def _integrator(self) -> Integrator:
        return Integrator(self._parts, self._guards, self._error_groups, width=self.width)

    @functools.cached_property
    def gpu_programs(self) -> "_gpu.GpuPrograms":
        def motion() -> TaylorSeries:
            _gpu.require_room(size_of_series(self._parts.series))  # before what is larger than that is written down
            return self.select_width(1)._integrator().motion

        return _gpu.GpuPrograms(motion, lambda: Adjoint(self._derivative_parts, width=1).motion)

    @functools.cached_property
    def _forward(self) -> "_CompiledRun":
        return _CompiledRun(self._integrator(), self._rounds)

    @property
    def _records_crossings(self) -> bool:
        return self._guards is not None and self._guards.notes

    @property
    def ending_guards(self) -> int:
        """The number of guards that end a motion."""
        return 0 if self._guards is None or self._records_crossings else len(self._guards.directions)

    @property
    def rest_size(self) -> int:
        """The size, in doubles, of the `rest` of an unfinished run."""
        return UnfinishedRun.size(self._forward.layout)

    def __call__(
        self, ts, y0, params, rtol, atol, max_steps, room=0, begun: RunResults | None = None, room_of_notes=0, order=0
    ) -> Outcome:
        """Integrate from the states `y0` (N, 2n); all arrays are float64.

        `ts` (N, T) are the output times and `params` (N, P) the parameters; or one row for all. Up to `room` steps are
        recorded, for derivatives. `begun` is a run to be resumed. The series have this `order`; by default the one for
        rtol.

        If guards are noted, with `room_of_notes` each, `path` holds the notes, one guard after the other: a time, and
        the state then, (N, guards (room + 1), 1 + 2n); in the last row of a guard the number of all its changes.
        """
        ts, y0, params = _contiguous_doubles(ts, y0, params)
        members, times = len(y0), ts.shape[1]
        if begun is not None:
            begun = RunResults(*(np.array(x, np.float64) for x in begun))
        elif room == 0 and self.threads(members) == 1 and not self._records_crossings and not order:
            begun = self._begin_run(ts, y0, params, self.plan(rtol, atol, max_steps))
        if begun is None:
            shape = (times, self.states)
            if self._records_crossings and (guards := self._guards) is not None:
                shape = len(guards.directions) * (room_of_notes + 1), self.states + 1
            path, y_end = np.full((members, *shape), np.nan), np.empty((members, self.states))
            t_end, code, steps, rejected = np.empty((4, members))
            changes = np.zeros((members, self.ending_guards))
        else:
            path, y_end, t_end, code, steps, rejected, changes, rest = begun
            idle, _, more = UnfinishedRun.counts(rest)
            if not more:
                return _collect_results(path, y_end, t_end, code, steps, rejected, changes, idle)
        rest = None if begun is None else UnfinishedRun.from_array(begun.rest, self._forward.layout)
        table, rows = None, np.zeros(1, np.int64)
        if room:  # the system provides pages when they are written to
            table = np.empty((room, self.states + RECORDED + self._forward.more))
        arrays = dict(
            next_member=np.zeros(1, np.int64) if rest is None else rest.next_member, ts=ts, y0=y0, params=params,
            path=path, y_end=y_end, t_end=t_end, code=code, steps=steps, rejected=rejected, changes=changes,
            record=table, next_row=rows,
        )  # fmt: skip
        numbers = dict(
            **self._strides(ts, params), members=members, times=times, order=order or choose_order(rtol),
            max_steps=max_steps, room=room, room_of_notes=room_of_notes, rtol=rtol, atol=atol,
        )  # fmt: skip
        idle = self._forward(arrays, numbers, self.threads(members) if rest is None else 1, rest)
        table = None if table is None else table[: rows[0]]
        return _collect_results(path, y_end, t_end, code, steps, rejected, changes, idle, table)

    def _begin_run(self, ts, y0, params, plan: Plan) -> RunResults:
        """Run few members for one time slice, in one call of machine code."""
        members, times, states = len(y0), ts.shape[1], self.states
        guards = self.ending_guards
        block, ends = np.empty(members * (times * states + states + 4 + guards) + self.rest_size), [0]
        for size in (members * times * states, members * states, *[members] * 4, members * guards, self.rest_size):
            ends.append(ends[-1] + size)
        first, arguments = block.ctypes.data, (x.ctypes.data for x in (ts, y0, params))
        results = (first + 8 * end for end in ends[:-1])
        handler().begin(ctypes.addressof(plan), *arguments, *results, members, times, len(ts), len(params))
        path, y_end, *others, changes, rest = (block[begin:end] for begin, end in itertools.pairwise(ends))
        shaped = path.reshape(members, times, states), y_end.reshape(members, states)
        return RunResults._make([*shaped, *others, changes.reshape(members, guards), rest])

    def vjp(self, ts, params, record: Steps, path_ct, y_ct) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The vector–Jacobian product of a run, over its recorded steps.

        It maps cotangents of the outputs, `path_ct` (N, T, 2n), the first and last of which are not read, and of the
        final states, `y_ct` (N, 2n), to those of the initial states (N, 2n) and of the parameters (N, P). The last
        array (N,) estimates the last terms of the series of a tangent relative to it, an upper bound.
        """
        y_ct = np.array(y_ct, np.float64, order="C")
        results = y_ct, np.zeros((len(y_ct), self.numbers)), np.zeros(len(y_ct))
        arrays = dict(zip(("y_ct", "params_ct", "excess"), results, strict=True)) | dict(path_ct=path_ct)
        self._run_derivative(self._transpose_kernel(len(y_ct)), ts, params, record, arrays)
        return results

    def _transpose_kernel(self, members: int) -> "tuple[_CompiledRun, int]":
        """The adjoint for this many members, and its number of threads."""
        kernel = self.select_width(1 if members < self.width / 2 else members)  # few are as fast one after the other
        # A vector of members is as much work as the motions of several, and worth a thread the sooner.
        return kernel._backward, min(kernel.threads(members * MOTIONS_PER_ADJOINT), -(-members // kernel.width))

    def jvp(
        self, ts, params, record: Steps, y_dot, params_dot, floor: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The Jacobian–vector products of a run along m directions, over its recorded steps.

        It maps tangents of the initial states, `y_dot` (N, m, 2n), and of the parameters, `params_dot` (N, m, P), to
        those of the outputs, (N, m, T, 2n), the last of which is not written, and of the final states (N, m, 2n). The
        last array (N,) is the largest value of the last two terms of the series of a tangent, relative to the tangent
        or to the `floor`.
        """
        y_dot = np.array(y_dot, np.float64, order="C")
        members, directions = y_dot.shape[:2]
        path_dot = np.full((members, directions, np.shape(ts)[1], self.states), np.nan)
        results = path_dot, y_dot, np.zeros(members)
        arrays = dict(zip(("path_dot", "y_dot", "excess"), results, strict=True)) | dict(params_dot=params_dot)
        kernel = self._tangent_kernel(members, directions)
        self._run_derivative(kernel, ts, params, record, arrays, directions=directions, floor=floor)
        return results

    def _run_derivative(
        self, kernel: "tuple[_CompiledRun, int]", ts, params, record: Steps, arrays: dict, **numbers: float
    ) -> None:
        """Run a derivative kernel, given with its number of threads, over recorded steps; `arrays` are its own."""
        names = ("ts", "params", "record", *arrays)
        arrays = dict(zip(names, _contiguous_doubles(ts, params, record.table, *arrays.values()), strict=True))
        ts, params = arrays["ts"], arrays["params"]
        first, counts = (np.ascontiguousarray(x, np.int64) for x in (record.first, record.counts))
        arrays |= dict(next_member=np.zeros(1, np.int64), first_step=first, steps=counts)
        numbers |= dict(members=len(first), times=ts.shape[1], order=record.order, **self._strides(ts, params))
        compiled, threads = kernel
        compiled(arrays, numbers, threads)

    def _tangent_kernel(self, members: int, directions: int) -> "tuple[_CompiledRun, int]":
        """The tangent kernel for these numbers of members and directions, and its number of threads."""
        if directions > 1 and members < self.width / 2:
            return self._tangents(True), min(cores(), members)
        kernel = self.select_width(members)
        # A vector of members is as much work as there are directions, and worth a thread the sooner.
        return kernel._tangents(False), min(kernel.threads(members * directions), -(-members // kernel.width))

    def _compile_tangents(self, side_by_side: bool) -> "_CompiledRun":
        """The tangent kernel: lanes hold directions of one member (`side_by_side`) or members."""
        width = 1 if side_by_side else self.width
        return _CompiledRun(Tangent(self._derivative_parts, width=width, lanes=self.width), self._rounds)

    def plan(self, rtol: float, atol: float, max_steps: int) -> Plan:
        """The plan with which a handler starts a run; valid as long as this kernel."""
        begin, run = self._forward.places
        size, rounds = self._forward.layout.size, self._forward.rounds
        return Plan(begin, run, size, self.states, self.numbers, choose_order(rtol), max_steps, rounds, rtol, atol)

    @property
    def rounds_of_rerun(self) -> int:
        """The rounds of a motion that a handler recomputes for a derivative; 0 for a long or a piecewise one."""
        if self.borders is not None and (self.borders.switches or self.borders.root_arguments):
            return 0
        rounds = self._rounds // _RERUNS_PER_SLICE
        return rounds if rounds >= _LEAST_ROUNDS else 0

    def derivative_plan(
        self, kind: str, members: int, times: int, directions: int, rtol: float, atol: float, max_steps: int
    ) -> DerivativePlan:
        """The plan of derivatives of this many members; valid as long as this kernel."""
        motion = self.select_width(members)._forward
        derivative, _ = self._tangent_kernel(members, directions) if kind == "jvp" else self._transpose_kernel(members)
        rounds, others = self.rounds_of_rerun, self.numbers if kind == "vjp" else directions * times * self.states
        memory, both = [of.layout.size for of in (motion, derivative)], (motion, derivative)
        return DerivativePlan(
            *motion.places, *derivative.places, *memory, *(len(LANE) * of.layout.width for of in both), self.states,
            self.numbers, choose_order(rtol), max_steps, rounds, rounds * motion.layout.width, directions, others, rtol,
            atol, small_size(rtol, atol),
        )  # fmt: skip

    @property
    def _derivative_parts(self) -> MotionParts:
        """The parts for derivatives over recorded steps, which need no features and no guards."""
        if not self._parts.pieces:
            return self._smooth
        return self._parts if self._guards is None else self._parts.drop_guards

    @functools.cached_property
    def _backward(self) -> "_CompiledRun":
        return _CompiledRun(Adjoint(self._derivative_parts, width=self.width), self._rounds)

    def _strides(self, ts, params) -> dict[str, int]:
        return dict(ts_stride=ts.shape[1] if len(ts) > 1 else 0, params_stride=self.numbers if len(params) > 1 else 0)

    def threads(self, members: int) -> int:
        return min(cores(), max(1, members // (VECTORS_PER_THREAD * self.width)))


class _CompiledRun:
    """The compiled functions `begin` and `run` of a module, called for all members of a job on several threads.

    `rounds` is the number of rounds in the first time slice, `more` that of numbers recorded after the state of a step.
    """

    def __init__(self, built: Integrator | Tangent | Adjoint, rounds: int):
        motion = built.motion
        self.layout, self._job, self._counts_idle = motion.layout, built.job, isinstance(built, Integrator)
        self.rounds, self.more = rounds, motion.recorded_pieces
        self._numbers = motion.look_up.numbers
        names = ("begin", "run") if self._numbers is None else ("begin", "run", SET_NUMBERS)
        # The engine holds the code that the others point to.
        self._engine, at = compile_module(motion.module, names)
        if self._numbers is not None:
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(at[SET_NUMBERS])(self._numbers.ctypes.data)
        self.places = at["begin"], at["run"]
        pointers = [ctypes.c_void_p] * 3
        self._begin = ctypes.CFUNCTYPE(None, *pointers)(at["begin"])
        pointers += [ctypes.c_void_p] * self._counts_idle
        self._run = ctypes.CFUNCTYPE(ctypes.c_int64, *pointers, ctypes.c_int64)(at["run"])

    def __call__(
        self, arrays: Mapping[str, np.ndarray | None], numbers: Mapping[str, float], threads: int, rest=None
    ) -> int:
        """Run a job on these arrays, from the start or from the `rest` of a run; returns the number of idle steps."""
        addresses = {name: None if array is None else array.ctypes.data for name, array in arrays.items()}
        job = self._job(**addresses, **numbers)

        def work(stopped, _arrays=arrays) -> int:  # whose memory must live as long as somebody works on it
            if rest is None:
                memory = allocate_aligned(self.layout.size)
                integers, idle = np.zeros(len(LANE) * self.layout.width, np.int64), np.zeros(1, np.int64)
            else:
                memory, integers, idle, _ = rest
            mine = [ctypes.addressof(job), memory.ctypes.data, integers.ctypes.data]
            if rest is None:
                self._begin(*mine)
            if self._counts_idle:
                mine.append(idle.ctypes.data)
            run_in_slices(functools.partial(self._run, *mine), stopped, self.rounds)
            return int(idle[0])

        return run_on_threads(work, threads)


def _collect_results(path, y_end, t_end, code, steps, rejected, changes, idle: int, table=None) -> Outcome:
    """The outcome of a finished run; NaN in the path at times that a member did not reach."""
    ended_badly = code != DONE
    if ended_badly.any() and path.shape[2] == y_end.shape[1]:  # a start that is infinite was not reached either
        reached = np.isfinite(path[ended_badly]).all(axis=2, keepdims=True)
        path[ended_badly] = np.where(reached, path[ended_badly], np.nan)
    code, steps, rejected = (numbers.astype(int) for numbers in (code, steps, rejected))
    recorded = (None, None) if table is None else _sort_by_member(table, steps)
    return Outcome(path, y_end, t_end, code, steps, rejected, changes.astype(int), idle, *recorded)


def _sort_by_member(table: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of members with all their `steps` (N,) recorded, sorted by member, and a flag (N,) for these.

    A step that was undone was recorded more than once: the last record counts.
    """
    member, step = table[:, 2].astype(np.int64), table[:, 3].astype(np.int64)
    lasting = np.flatnonzero(step < steps[member])
    complete = np.bincount(member[lasting], minlength=len(steps)) >= steps
    lasting = lasting[complete[member[lasting]]]
    counts = np.where(complete, steps, 0)
    places = np.full(counts.sum(), -1)
    places[(np.cumsum(counts) - counts)[member[lasting]] + step[lasting]] = lasting
    if (places < 0).any():  # one was undone and is not there again
        missing = np.repeat(np.arange(len(steps)), counts)[places < 0]
        return _sort_by_member(table[~np.isin(member, missing)], steps)
    return np.take(table, places, axis=0, mode="clip"), complete  # a third of the time of `table[places]`


def _contiguous_doubles(*arrays) -> list[np.ndarray]:
    return [np.ascontiguousarray(x, dtype=np.float64) for x in arrays]


def small_size(rtol: float, atol: float) -> float:
    """The size below which a number counts as small: atol / rtol, or the default ratio if atol is 0."""
    return atol / rtol if atol > 0 else ATOL_OVER_RTOL


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
