"""Integration of batches in machine code made for one scene: the processor's vectors and all its cores.

    Program ──_program._series──► recurrences ──_integrator──► LLVM ──_ir──► Kernel(arrays) → arrays

XLA compiles one operation after the other for all members of a batch; here one member after the other goes through all
operations, four or eight side by side in the lanes of vector registers, and nothing leaves the first caches. A step is
one Taylor series, of the order that the tolerance asks for.
"""

import ctypes
import functools
import math
import os
from typing import NamedTuple

import numpy as np

from lagjax._native import _adjoint, _integrator
from lagjax._native._constants import (
    DISCONTINUOUS,
    DONE,
    EVENT,
    MAX_ORDER,
    NOT_FINITE,
    NOT_LANDED,
    OUT_OF_STEPS,
    SINGULAR,
    STEP_TOO_SMALL,
)
from lagjax._native._frame import LANE
from lagjax._native._ir import compiled
from lagjax._native._threads import in_slices, together
from lagjax._program import Program, Series, Unlowerable, series

__all__ = [
    "DISCONTINUOUS", "DONE", "EVENT", "NOT_FINITE", "NOT_LANDED", "OUT_OF_STEPS", "SINGULAR", "STEP_TOO_SMALL",
    "Guards", "Kernel", "Projection", "cores", "order_for", "recurrences",
]  # fmt: skip


class Outcome(NamedTuple):
    """For N members, T times and 2n states: what `Kernel` returns. `path` is NaN where a member did not come.

    `idle` counts the steps for which lanes stood empty; `table` holds the steps that were written down, if any.
    """

    path: np.ndarray
    y_end: np.ndarray
    t_end: np.ndarray
    code: np.ndarray
    steps: np.ndarray
    rejected: np.ndarray
    idle: int
    table: np.ndarray | None


class Guards(NamedTuple):
    """Functions of the state that end the motion where they change sign, and for each −1, 0 or +1: when it counts.

    With y the state and the time, the outputs of the program are all g; their rates ġ = Σ ∂g/∂yᵢ ẏᵢ; then Σ |∂g/∂yᵢ yᵢ|
    and Σ |∂g/∂yᵢ ẏᵢ|, of which round-off is a part.
    """

    program: Program
    directions: tuple[int, ...]


class Projection(NamedTuple):
    """What keeps a motion on its constraints, from the inputs of its program: (q, q̇) there, nearby, and speeds.

    An error of q̇ counts relative to its speed where that is larger than q̇ itself.
    """

    state: Program
    speeds: Program


class Kernel:
    """The integration of (q, q̇) with q̈ from a program, whose inputs are q, q̇, t and numbers that stay constant.

    The outputs of the program are q̈, then whether the mass matrix is singular. `projection` is applied to the state
    after every step, and to the outputs after the first. `guards`, again from the same inputs, end the motion of a
    member with the code `EVENT` + Σ 4ᵏ (1 where guard k falls, 2 where it rises). Errors are relative to each
    coordinate, or to the largest one of its group. Of the coordinates the first `own` are the motion, the others its
    derivatives. Raises `Unlowerable` where an operation has no Taylor series or is not one of doubles.
    """

    def __init__(
        self,
        program: Program,
        size: int,
        projection: Projection | None = None,
        guards: Guards | None = None,
        groups: tuple[int, ...] | None = None,
        own: int | None = None,
    ):
        self._parts = program, recurrences(program, size), projection
        integrator = _integrator.Integrator(*self._parts, guards, groups, own)
        motion = integrator.motion
        self.states, self.numbers, self.width = motion.states, motion.numbers, motion.width
        self._memory = motion.layout.size
        # The engine holds the code that the other points to.
        self._engine, at = compiled(motion.module, ("begin", "run"))
        self._begin = _function(at["begin"], None, *[ctypes.c_void_p] * 3)
        self._run = _function(at["run"], ctypes.c_int64, *[ctypes.c_void_p] * 4, ctypes.c_int64)

    def __call__(self, ts, y0, params, rtol: float, atol: float, max_steps: int, room=None) -> Outcome:
        """`y0` (N, 2n); `ts` (N, T) and `params` (N, P), or one row for all; all float64.

        With `room` (N,) up to so many steps of each member are written down, for `pull`.
        """
        ts, y0, params = _contiguous(ts, y0, params)
        if room is None:
            return self._integrate(ts, y0, params, rtol, atol, max_steps)
        first_step = np.concatenate([[0], np.cumsum(room)]).astype(np.int64)
        table = np.empty((first_step[-1], self.states + 2))  # the system provides pages when they are written to
        return self._integrate(ts, y0, params, rtol, atol, max_steps, table, first_step)

    def _integrate(self, ts, y0, params, rtol, atol, max_steps, record=None, first_step=None) -> Outcome:
        members, times = len(y0), ts.shape[1]
        path = np.full((members, times, self.states), np.nan)
        y_end, t_end = np.empty((members, self.states)), np.empty(members)
        code, steps, rejected = (np.empty(members) for _ in range(3))
        counter, recording = np.zeros(1, np.int64), record is not None
        arrays = counter, ts, y0, params, path, y_end, t_end, code, steps, rejected, record, first_step
        job = _integrator.Job(
            *_addresses(*arrays),
            times if len(ts) > 1 else 0, self.numbers if len(params) > 1 else 0,
            members, times, order_for(rtol), max_steps, recording, rtol, atol,
        )  # fmt: skip

        def integrate(stopped, _arrays=arrays) -> int:  # whose memory must live as long as somebody works on it
            memory = _aligned(self._memory)
            lanes, idle = np.zeros(len(LANE) * self.width, np.int64), np.zeros(1, np.int64)
            mine = ctypes.addressof(job), memory.ctypes.data, lanes.ctypes.data
            self._begin(*mine)
            in_slices(functools.partial(self._run, *mine, idle.ctypes.data), stopped)
            return int(idle[0])

        idle = together(integrate, self._threads(members))
        ended_badly = code != DONE
        if ended_badly.any():  # a start that is infinite was not reached either
            reached = np.isfinite(path[ended_badly]).all(axis=2, keepdims=True)
            path[ended_badly] = np.where(reached, path[ended_badly], np.nan)
        return Outcome(path, y_end, t_end, *(counts.astype(int) for counts in (code, steps, rejected)), idle, record)

    def pull(self, ts, params, table, first, counts, path_bar, y_bar, order: int) -> tuple[np.ndarray, np.ndarray]:
        """The transposed derivative of a run, over the steps it wrote down.

        The steps of member k are `counts[k]` rows of `table` from `first[k]` on. From the cotangents of the outputs,
        `path_bar` (N, T, 2n), of which the first and the last are not looked at, and of the states at the end, `y_bar`
        (N, 2n), to those of the initial states (N, 2n) and of the parameters (N, P).
        """
        ts, params, path_bar = _contiguous(ts, params, path_bar)
        first, counts = (np.ascontiguousarray(x, np.int64) for x in (first, counts))
        y_bar, params_bar = np.array(y_bar, np.float64, order="C"), np.zeros((len(y_bar), self.numbers))
        counter, (members, times) = np.zeros(1, np.int64), path_bar.shape[:2]
        arrays = counter, ts, params, table, first, counts, path_bar, y_bar, params_bar
        job = _adjoint.Job(
            *_addresses(*arrays),
            times if len(ts) > 1 else 0, self.numbers if len(params) > 1 else 0, members, times, order,
        )  # fmt: skip
        _, begin, run, size = self._adjoint

        def back(stopped, _arrays=arrays) -> int:
            memory, lanes = _aligned(size), np.zeros(len(LANE) * self.width, np.int64)
            mine = ctypes.addressof(job), memory.ctypes.data, lanes.ctypes.data
            begin(*mine)
            in_slices(functools.partial(run, *mine), stopped)
            return 0

        together(back, self._threads(members))
        return y_bar, params_bar

    @functools.cached_property
    def _adjoint(self):
        """The engine that holds the code, `begin`, `run`, and what a thread needs; compiled when first asked for."""
        adjoint = _adjoint.Adjoint(*self._parts)
        engine, at = compiled(adjoint.motion.module, ("begin", "run"))
        begin = _function(at["begin"], None, *[ctypes.c_void_p] * 3)
        run = _function(at["run"], ctypes.c_int64, *[ctypes.c_void_p] * 3, ctypes.c_int64)
        return engine, begin, run, adjoint.motion.layout.size

    def _threads(self, members: int) -> int:
        return min(cores(), max(1, members // (4 * self.width)))


def _function(address: int, result, *types):
    return ctypes.CFUNCTYPE(result, *types)(address)


def _contiguous(*arrays) -> list[np.ndarray]:
    return [np.ascontiguousarray(x, dtype=np.float64) for x in arrays]


def _addresses(*arrays) -> list[int | None]:
    return [None if array is None else array.ctypes.data for array in arrays]


@functools.lru_cache(maxsize=16)  # asked for when it is decided what runs, and when that is compiled
def recurrences(program: Program, size: int) -> Series:
    """The Taylor series of the motion. Raises `Unlowerable` where the lanes of a kernel cannot run it."""
    for (op, _, _), kind in zip(program.nodes, program.kinds, strict=True):
        if kind not in ("float", "bool") and op not in ("input", "constant", "convert"):
            raise Unlowerable(f"`{op}` of integers is not for vectors of doubles")
    return series(program, size, moving=2 * size + 1)


def order_for(rtol: float) -> int:
    """The order whose series costs least: at the step that it allows, terms fall by e² each (Jorba & Zou, §3.2)."""
    return min(MAX_ORDER, max(7, math.ceil(2 - math.log(rtol) / 2)))


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _aligned(size: int) -> np.ndarray:
    """Zeros on the boundary of a cache line, which vectors need."""
    memory = np.zeros(size + 8)
    return memory[(-memory.ctypes.data // 8) % 8 :]
