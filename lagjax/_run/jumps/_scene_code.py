"""A scene in the form that a search takes: addresses of machine code, sizes, field offsets; and its runs.

SceneCode.search(ts, y0, numbers, …) ─► search_p ─► rows of NumPy ─► `_driver.follow` by a law ─► Found
                                          └─ a stretch that the kernel gives up: `Flow.run`
"""

import collections
import ctypes
import functools
import math
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import mlir

from lagjax._engine import Problem
from lagjax._engine.taylor import Line, MachineCode, Surfaces, Tolerances, line_of, rate_errors
from lagjax._interface import EVENT_OCCURRED, SUCCESSFUL, is_concrete
from lagjax._native import LARGEST_LINE, SINGLE_NOISE, LineCode, Loop, compile_loops, cores, handler, line_function
from lagjax._primitives import LinearMap, call_host, compute_on_host
from lagjax._run.jumps._driver import ASKS, GOING, NEW
from lagjax._run.jumps._field_places import Places

_TOGETHER = 256  # members that one call follows side by side: what it remembers of them fits into a processor's cache
_ROOM = 32  # rows of a record, at first
_ROUNDS = 10**6  # of a kernel, for a stretch: beyond that it continues on the host, where it can be interrupted


def tolerances_of(problem: Problem, scene: str, what: str) -> Tolerances:
    """rtol and atol of a motion that jumps. Raises `ValueError` if they are traced, or the motion runs backward.

    The error names the `scene`, and `what`, which cannot be reversed.
    """
    if not all(map(is_concrete, problem.tolerances)):
        raise ValueError(f"rtol and atol of {scene} must be numbers: they decide the order of the method.")
    if is_concrete(problem.ts) and (np.asarray(problem.ts)[..., -1] < np.asarray(problem.ts)[..., 0]).any():
        raise ValueError(f"The motion of {scene} goes forward in time: {what} cannot be undone; ts must increase.")
    wide = problem.double_precision if problem.is_single else problem
    return Tolerances(float(MachineCode().rtol(wide)), float(problem.tolerances[1] or 0.0), problem.max_steps)


class JumpLaw(NamedTuple):
    """A law of events at the end of stretches: compiled `loops`, and the fields `places` that they use.

    `given` are the fields of a member's memory that a search takes in addition to the state, `ending` those it returns.
    """

    places: Places
    loops: tuple[Loop, ...]  # those of `bind_law`
    given: tuple[str, ...]
    ending: tuple[str, ...]


class Mode(NamedTuple):
    """A mode: its flow, its `count` watches, and further lines by their names in a scene; each made on first use."""

    make: Callable
    count: int
    find_surfaces: Callable[[], Surfaces | None]
    make_lines: Callable[[], dict] = dict


class Found(NamedTuple):
    """The findings of a search, for one member or with a member axis first.

    The outputs `path` (T, 2n), the contact states or modes `did` there (T, …), −1 at times not reached, the `record`
    (N, …), whose rows `Places` declares, and the `ending`: t and y, result, rounds, accepted and rejected steps, fields
    of the law, and y and t of the start.
    """

    path: Any
    did: Any
    record: Any
    ending: Any


ENDING = "RESULT", "ROUNDS", "ACCEPTED", "REJECTED"


class SceneCode:
    """The machine code of a scene of these `sizes` and `arrays` (see `Places`); compared by identity.

    `lines` by their names in a scene do not depend on the mode. Watches of the `first` modes are compiled at once.
    """

    def __init__(
        self, law: JumpLaw, sizes: dict, arrays: dict, modes: Sequence[Mode], lines: dict, tolerances, first: int = 1
    ):
        self.law, self.modes, self.lines, self.tolerances, self._first = law, modes, lines, tolerances, first
        counts = np.array([mode.count for mode in modes])
        self.sizes = sizes | {"MODES": len(modes), "WATCHES": int(counts.max())}
        empty: dict = dict.fromkeys(("WATCH", "ERRORS", "SLOPES"), np.zeros(len(modes)))
        empty["PLANS"] = np.zeros(2 * len(modes))
        self.arrays, self.fields = {"COUNTS": counts, **empty, **arrays}, law.places.count_doubles(self.sizes)
        self._keep = []  # what the addresses point to
        self.flow_of = functools.cache(lambda mode: modes[mode].make())
        self.scene = functools.cache(self._scene_row)

    def _scene_row(self, many: bool) -> np.ndarray:
        """The row of integers that the search takes, without those of modes; for one member, or for many."""
        places = self.law.places
        scene = places.write_scene(self.sizes, self.arrays, self.fields)
        scene[places.at.BEGIN] = ctypes.cast(handler().begin, ctypes.c_void_p).value or 0
        self._add_codes(scene, self.lines)
        for mode, of in enumerate(self.modes):
            if mode < self._first and (surfaces := of.find_surfaces()) is not None:
                self._add_watches(scene, mode, surfaces)
        return scene

    def _add_watches(self, scene: np.ndarray, mode: int, surfaces: Surfaces) -> None:
        count, complete = len(surfaces.directions), surfaces.complete
        lines = {("WATCH", mode): line_of(complete, 4 * count)}
        if len(complete.line.nodes) > LARGEST_LINE and not complete.line.looks_up:
            rates = complete.select_outputs(range(count, 2 * count)).line
            code = LineCode(rates, lines["WATCH", mode].size, moving=2 * self.sizes["N"] + 1)
            self._keep.append(code)
            scene[scene[self.law.places.of["ERRORS"]] + mode] = code.address
        else:
            lines["ERRORS", mode] = line_of(rate_errors(complete, count), count)
        if surfaces.is_rounded:
            lines["SLOPES", mode] = line_of(surfaces.values, count).back
        self._add_codes(scene, lines)

    def add_mode(self, scene: np.ndarray, mode: int, many: bool) -> None:
        """Add to a scene the addresses and sizes of a mode."""
        at = self.law.places.at
        if mode >= self._first and (surfaces := self.modes[mode].find_surfaces()) is not None:
            self._add_watches(scene, mode, surfaces)
        self._add_codes(scene, self.modes[mode].make_lines())
        for wide, members in ((0, 1), (1, 1000 if many else 1)):
            kernel = self.flow_of(mode).kernel.select_width(members)
            plan = kernel.plan(*self.tolerances[:3])
            plan = type(plan)(*(_ROUNDS if field == "rounds" else getattr(plan, field) for field, *_ in plan._fields_))
            self._keep.append((plan, kernel))
            scene[scene[at.PLANS] + 2 * mode + wide] = ctypes.addressof(plan)
            scene[at.REST] = max(scene[at.REST], kernel.rest_size)

    def _add_codes(self, scene: np.ndarray, lines: dict[Any, Line]) -> None:
        for name, of in lines.items():
            keep, address = _call_numpy(of) if of.code is None else (of.code, of.code.address)
            self._keep.append(keep)
            place = self.law.places.of[name] if isinstance(name, str) else scene[self.law.places.of[name[0]]] + name[1]
            scene[place] = address

    def width(self, names: Collection[str]) -> int:
        """The number of doubles in these fields."""
        return sum(self.fields[name] for name in names)

    def read(self, rows, names: Collection[str]) -> Any:
        """The fields of rows (…, doubles) as attributes in small letters, those of one double without an axis."""
        ends = np.cumsum([self.fields[name] for name in names])
        parts = [rows[..., end - self.fields[name] : end] for name, end in zip(names, ends, strict=True)]
        of = collections.namedtuple("Rows", [name.lower() for name in names])
        counts = self.law.places.fields
        return of(*(x if counts[name] else x[..., 0] for name, x in zip(names, parts, strict=True)))

    def read_ending(self, ending) -> Any:
        """The fields of the `ending` of a search after t and y."""
        return self.read(ending[..., 2 * self.sizes["N"] + 1 :], (*ENDING, *self.law.ending, "BEGUN"))

    # ---- runs ----

    def search(self, ts, y0, numbers, *given, is_replayed: bool = False) -> Found:
        """The motion from `y0` (2n,), at `ts` (T,), with `numbers` (P,) and fields `given`; it has no derivatives.

        Rows of the record are complete if it `is_replayed`, else they have the fields `said`.
        """
        given = map(jnp.asarray, (ts, y0, numbers, *given))
        places = self.law.places
        return Found(*search_p.bind(*given, code=self, names=tuple(places.record if is_replayed else places.said)))

    def search_batch(self, ts, y0, numbers, *given, room: int | None) -> Found:
        """As `search`, on NumPy arrays with a member axis first; without `room` records have the longest length."""
        members, scene, states = len(y0), self.scene(len(y0) > 1).copy(), 2 * self.sizes["N"]
        memory, at = np.zeros((members, scene[self.law.places.at.MEMORY])), self.law.places.of
        first = np.broadcast_to(ts[:, :1], (members, 1))
        x = np.concatenate([y0, first, numbers], axis=1)
        parts = {
            "X": x, "RTOL": np.full((members, 1), self.tolerances.rtol), "FIRST": ts[:, :1], "LAST": ts[:, -1:],
            "RESULT": np.full((members, 1), float(NEW)), **dict(zip(self.law.given, given, strict=True)),
        }  # fmt: skip
        if self.sizes["SINGLE"]:
            parts["WIDTHS"] = SINGLE_NOISE * np.abs(x[:, : states + 1 + self.sizes["NUMBERS"]])
        for name, of in parts.items():
            memory[:, scene[at[name]] : scene[at[name]] + of.shape[1]] = of
        path = np.full((members, self.sizes["TIMES"], states), np.nan)
        did = np.full((members, self.sizes["TIMES"], self.sizes["DOING"]), -1.0)
        run = _BatchRun(self, scene, np.ascontiguousarray(ts), memory, path, did, room)
        run.integrate_members()
        x = memory[:, scene[at["X"]] :]
        ending = [x[:, states : states + 1], x[:, :states]]
        names = *ENDING, *self.law.ending, "BEGUN"
        ending += [memory[:, scene[at[name]] : scene[at[name]] + self.fields[name]] for name in names]
        return Found(path, did, run.record, np.concatenate(ending, axis=1))


def _call_numpy(line: Line) -> tuple[Any, int]:
    """A C-callable function that evaluates a line by NumPy, and its address: for lines with tables."""

    def evaluate(x: int, out: int, *_: int) -> None:
        given, found = (
            np.ctypeslib.as_array((ctypes.c_double * size).from_address(place))
            for place, size in ((x, line.size), (out, line.outputs))
        )
        found[:] = line.line.evaluate(list(given[:, None]))[:, 0]

    function = line_function(evaluate)
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return function, address


class _BatchRun:
    """A run of members, integrated until all have ended."""

    def __init__(self, code: SceneCode, scene, ts, memory, path, did, room: int | None):
        self.code, self.scene, self.ts, self.memory, self.path, self.did = code, scene, ts, memory, path, did
        self.at = at = code.law.places.at
        self._loops = compile_loops(*code.law.loops)  # once, before there are threads
        self.record, self._fixed = np.zeros((len(memory), room or _ROOM, scene[at.ROW])), room is not None
        scene[at.STRIDE] = ts.shape[1] if len(ts) > 1 else 0
        self.results = memory[:, scene[at.RESULT]]

    def integrate_members(self) -> None:
        """Integrate all members to their ends."""
        members = len(self.memory)
        together = min(_TOGETHER, max(1, -(-members // cores())))
        places = [slice(begin, begin + together) for begin in range(0, members, together)]
        while True:
            self.scene[self.at.ROOM] = self.record.shape[1]
            if len(places) == 1:
                self._integrate_block(places[0])
            else:
                pool = ThreadPoolExecutor(cores())
                try:
                    list(pool.map(self._integrate_block, places))
                finally:  # who is interrupted waits for those that run, and for no others
                    pool.shutdown(cancel_futures=True)
            self._answer_requests(np.flatnonzero(self.results == ASKS).tolist())
            if not (self.results == GOING).any():
                break
            if (self.memory[self.results == GOING, self.scene[self.at.ROWS]] >= self.record.shape[1]).any():
                if self._fixed:
                    break
                self.record = np.concatenate([self.record, np.zeros_like(self.record)], axis=1)
        if not self._fixed:
            used = int(self.memory[:, self.scene[self.at.ROWS]].max(initial=1))
            self.record = np.ascontiguousarray(self.record[:, : max(used, 1)])

    def _integrate_block(self, members: slice) -> None:
        scene, memory = self.scene.copy(), self.memory[members]
        outputs, states = scene[self.at.TIMES] + 2, 2 * scene[self.at.N]
        numbers = scene[self.at.INPUTS] - states - 1 + 2 * scene[self.at.WATCHES]
        scene[self.at.JOBS] = scene[self.at.ORDER] + len(memory)
        each = outputs + states + numbers + outputs * states + states + 4 + scene[self.at.WATCHES]
        work = np.zeros(scene[self.at.JOBS] + len(memory) * each + scene[self.at.REST])
        ts = self.ts[members] if scene[self.at.STRIDE] else self.ts
        arrays = ts, self.path[members], self.did[members], self.record[members], memory, work
        self._loops[0](scene.ctypes.data, len(memory), *(x.ctypes.data for x in arrays))

    def _answer_requests(self, asking: list[int]) -> None:
        """Compile the modes that members request, or finish stretches that the kernel did not finish."""
        code, at, many = self.code, self.at, len(self.memory) > 1
        known = self.scene.copy()
        for member in asking:
            mode = self._loops[3](known.ctypes.data, self.memory[member].ctypes.data)
            if known[known[at.PLANS] + 2 * mode]:
                self._continue_stretch(member, mode)
                continue
            whole = code.scene(many)
            if whole[whole[at.PLANS] + 2 * mode] == 0:
                code.add_mode(whole, mode, many)
            self.scene = whole.copy()
            self.scene[at.STRIDE], self.scene[at.ROOM] = known[at.STRIDE], known[at.ROOM]
            self.results[member] = GOING

    def _continue_stretch(self, member: int, mode: int) -> None:
        """Finish a stretch that the kernel did not finish."""
        code, scene, memory, at, loops = self.code, self.scene, self.memory[member], self.at, self._loops
        states, ts = 2 * scene[at.N], self.ts[member if scene[at.STRIDE] else 0]
        times, y, work = np.zeros(ts.size + 2), np.zeros(states), np.zeros(scene[at.ORDER])
        numbers = np.zeros(scene[at.INPUTS] - states - 1 + 2 * scene[scene[at.COUNTS] + mode])
        loops[1](*(x.ctypes.data for x in (scene, memory, ts, times, y, numbers, work)))
        done = code.flow_of(mode).run(times[None], y[None], numbers[None], code.tolerances)
        happened = bool(done.result[0] == EVENT_OCCURRED)
        of_member = self.path[member], self.did[member], self.record[member]
        given = scene, memory, ts, *of_member, np.ascontiguousarray(done.path[0]), np.ascontiguousarray(done.y_end[0])
        result, fell = SUCCESSFUL if happened else int(done.result[0]), done.event[0].astype(float)
        steps = float(done.accepted[0]), float(done.rejected[0])
        addresses = [x.ctypes.data for x in given]
        loops[2](*addresses, float(done.t_end[0]), fell.ctypes.data, int(happened), result, *steps, work.ctypes.data)


# ---- as a primitive --------------------------------------------------------------------------------------------------


def _shapes(ts, y0, *_, code: SceneCode, names: tuple[str, ...]):
    batch, states = y0.shape[:-1], y0.shape[-1]
    row, ending = code.width(names), states + 1 + code.width((*ENDING, *code.law.ending, "BEGUN"))
    shapes = (ts.shape[-1], states), (ts.shape[-1], code.sizes["DOING"]), (code.sizes["MOST"], row), (ending,)
    return [ShapedArray((*batch, *shape), np.dtype(float)) for shape in shapes]


def _search_rows(*arrays, code: SceneCode, names: tuple[str, ...]):
    batch = arrays[1].shape[:-1]
    rows = [np.asarray(x, float).reshape(math.prod(batch), x.shape[-1]) for x in arrays]
    found = code.search_batch(*rows, room=code.sizes["MOST"])
    found = found._replace(record=found.record[..., : code.width(names)])
    return [x.reshape(*batch, *x.shape[1:]) for x in found]


def _never_varies(*_, **__):
    raise AssertionError("A search has no derivatives.")


search_p = LinearMap("lagjax_search", _shapes, _never_varies)
compute_on_host(search_p, _search_rows)


def _call_host(*arrays, **settings):
    return call_host(functools.partial(_search_rows, **settings), _shapes(*arrays, **settings), *arrays)


mlir.register_lowering(search_p, mlir.lower_fun(_call_host, multiple_results=True), platform="cpu")
