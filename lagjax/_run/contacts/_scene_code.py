"""A scene with contacts as the search takes it: machine code by address, sizes, and the places of numbers; its runs.

SceneCode.search(ts, y0, numbers, e, μ) ─► search_p ─► rows of NumPy ─► `_contact_search.follow` ─► Found
                                                          └─ a stretch that the kernel gives up: `Flow.run`
"""

import ctypes
import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import mlir

from lagjax._engine.taylor import Line, call_host, line_of, rate_errors
from lagjax._interface import EVENT_OCCURRED, SUCCESSFUL
from lagjax._native import LARGEST_LINE, SINGLE_NOISE, Walk, compile_loops, cores, handler, make_once
from lagjax._primitives import LinearMap, compute_on_host
from lagjax._run.contacts import _contact_search
from lagjax._run.contacts._contact_search import ASKS, GOING, NEW
from lagjax._run.contacts._places import ARRAYS, MEMORY, NAMES, RECORD, SAID, WORK, at

_TOGETHER = 256  # members that one call follows side by side: what it remembers of them fits into a processor's cache
_ROOM = 32  # rows of a record, at first
_ROUNDS = 10**6  # of a kernel, for a stretch: beyond that it continues on the host, where it can be interrupted


class Found(NamedTuple):
    """The findings of a search, of one member or with members in front.

    The outputs `path` (T, 2n), what contacts `did` there (T, …), −1 where the motion did not come, the `record` (N, …),
    whose rows `_places` declares, and the `ending`: t and y, result, rounds, accepted and rejected steps, doubts (3,)
    and the times of the first ones, (3,); then y and t where it began, which corners move.
    """

    path: Any
    did: Any
    record: Any
    ending: Any


class SceneCode:
    """The machine code of a scene of these `sizes` and `arrays` (see `_places`); it is known by identity.

    Where contacts are closed ("HELD") and where all are "OPEN", `flows` make the flow, and `surfaces` are the watches.
    `lines` do not depend on that; `multipliers` makes the line of those.
    """

    def __init__(self, sizes: dict, arrays: dict, flows: dict, surfaces: dict, lines: dict, multipliers, tolerances):
        self.sizes, self.arrays, self.surfaces, self.tolerances = sizes, arrays, surfaces, tolerances
        self.flows = {kind: functools.cache(make) for kind, make in flows.items()}
        self.lines, self._multipliers, self._keep = lines, multipliers, []  # what the addresses point to
        self.scene = functools.cache(self._scene)

    def _scene(self, many: bool) -> np.ndarray:
        """The row of integers that the search takes, without what closed contacts need; for one member, or for many."""
        scene = np.zeros(len(NAMES) + sum(x.size for x in self.arrays.values()), np.int64)
        fields = sizes_of_fields(self.sizes)
        for name, size in self.sizes.items():
            scene[getattr(at, name)] = size
        place = len(NAMES)
        for name in ARRAYS:
            scene[getattr(at, name)], numbers = place, self.arrays[name].ravel()
            scene[place : place + numbers.size], place = numbers, place + numbers.size
        for names, whole, prefix in ((MEMORY, "MEMORY", ""), (WORK, "WORK", ""), (RECORD, "ROW", "TO_")):
            ends = np.cumsum([0, *(fields[name] for name in names)])
            for name, begin in zip(names, ends, strict=False):
                scene[getattr(at, prefix + name)] = begin
            scene[getattr(at, whole)] = ends[-1]
        scene[at.BEGIN] = ctypes.cast(handler().begin, ctypes.c_void_p).value or 0
        self._add_codes(scene, self.lines)
        self.add_kind(scene, "OPEN", many)
        return scene

    def add_kind(self, scene: np.ndarray, kind: str, many: bool) -> None:
        """Add to a scene the kernel and the watches of closed contacts, or of open ones."""
        surfaces, flow = self.surfaces[kind], self.flows[kind]()
        count = len(surfaces.directions)
        lines = {f"{kind}_WATCH": line_of(surfaces.complete, 4 * count)}
        walk, moving = Walk(lines[f"{kind}_WATCH"].line, lines[f"{kind}_WATCH"].size), 2 * self.sizes["N"] + 1
        if len(walk) > LARGEST_LINE and walk.is_known:  # whose errors would be five times as many operations
            function, address = _call_back(lambda x: walk(x, moving)[1][count : 2 * count], walk.inputs, count)
            self._keep.append(function)
            scene[getattr(at, f"{kind}_ERRORS")] = address
        else:
            lines[f"{kind}_ERRORS"] = line_of(rate_errors(surfaces.complete, count), count)
        if surfaces.is_rounded:
            lines[f"{kind}_SLOPES"] = line_of(surfaces.values, count).back
        if kind == "HELD":
            lines["MULTIPLIERS"] = self._multipliers()
        self._add_codes(scene, lines)
        for name, members in (("ONE", 1), ("MANY", 1000 if many else 1)):
            kernel = flow.kernel.select_width(members)
            plan = kernel.plan(*self.tolerances[:3])
            plan = type(plan)(*(_ROUNDS if field == "rounds" else getattr(plan, field) for field, *_ in plan._fields_))
            self._keep.append((plan, kernel))
            scene[getattr(at, f"{kind}_{name}")] = ctypes.addressof(plan)
            scene[getattr(at, f"{kind}_{name}_REST")] = kernel.rest_size
            scene[at.REST] = max(scene[at.REST], kernel.rest_size)

    def _add_codes(self, scene: np.ndarray, lines: dict[str, Line]) -> None:
        for name, of in lines.items():
            code = of.code if len(of.line.nodes) <= LARGEST_LINE else None
            keep, address = _evaluate_long(of) if code is None else (code, code.address)
            self._keep.append(keep)
            scene[getattr(at, name)] = address

    # ---- runs ----

    def search(self, ts, y0, numbers, restitution, friction, is_replayed: bool = False) -> Found:
        """The motion from `y0` (2n,) on, at `ts` (T,) with `numbers` (P,), e (k,) and μ (r,), without derivatives.

        Rows of the record are whole where it `is_replayed`, else they have what is `SAID`.
        """
        given = map(jnp.asarray, (ts, y0, numbers, restitution, friction))
        return Found(*search_p.bind(*given, code=self, names=RECORD if is_replayed else SAID))

    def run(self, ts, y0, numbers, restitution, friction, room: int | None) -> Found:
        """`search` on arrays of NumPy with members in front; with no `room` its records are as long as the longest."""
        members, scene, begin = len(y0), self.scene(len(y0) > 1).copy(), 2 * self.sizes["N"]
        memory = np.zeros((members, scene[at.MEMORY]))
        is_open = np.zeros(self.sizes["DOING"])
        is_open[self.sizes["K"] :][: self.sizes["R"] * (1 + self.sizes["D"])] = 1.0
        first = np.broadcast_to(ts[:, :1], (members, 1))
        parts = {
            "X": np.concatenate([y0, first, numbers, np.tile(is_open, (members, 1))], axis=1),
            "RESTITUTION": restitution, "MU": friction, "RTOL": np.full((members, 1), self.tolerances.rtol),
            "FIRST": ts[:, :1], "LAST": ts[:, -1:], "RESULT": np.full((members, 1), float(NEW)),
            "DOUBTED": np.full((members, 3), np.nan),
        }  # fmt: skip
        if self.sizes["SINGLE"]:
            parts["WIDTHS"] = SINGLE_NOISE * np.abs(parts["X"][:, : begin + 1 + self.sizes["NUMBERS"]])
        for name, x in parts.items():
            place = scene[getattr(at, name)]
            memory[:, place : place + x.shape[1]] = x
        path = np.full((members, self.sizes["TIMES"], begin), np.nan)
        did = np.full((members, self.sizes["TIMES"], self.sizes["DOING"]), -1.0)
        run = _Run(self, scene, np.ascontiguousarray(ts), memory, path, did, room)
        run.follow()
        ending = [memory[:, scene[at.X] + begin], *memory[:, scene[at.X] : scene[at.X] + begin].T]
        ending += [memory[:, scene[getattr(at, name)]] for name in ("RESULT", "ROUNDS", "ACCEPTED", "REJECTED")]
        ending += [*memory[:, scene[at.DOUBTS] : scene[at.DOUBTS] + 3].T, *memory[:, scene[at.DOUBTED] :][:, :3].T]
        ending += [*memory[:, scene[at.BEGUN] : scene[at.BEGUN] + begin + 1].T]
        return Found(path, did, run.record, np.stack(ending, axis=-1))


def _evaluate_long(line: Line) -> tuple[Any, int]:
    """A function for a long line, or one of tables, which NumPy evaluates, and its address."""
    walk = Walk(line.line, line.size)
    if walk.is_known:
        return _call_back(lambda x: walk(x)[0], line.size, line.outputs)
    return _call_back(lambda x: line.line.evaluate(list(x[:, None]))[:, 0], line.size, line.outputs)


def _call_back(of: Callable, inputs: int, outputs: int) -> tuple[Any, int]:
    """A function of an array, called as machine code is, and its address."""

    def evaluate(x: int, out: int, _rows: int) -> None:
        given, found = (
            np.ctypeslib.as_array((ctypes.c_double * size).from_address(place))
            for place, size in ((x, inputs), (out, outputs))
        )
        found[:] = of(given)

    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(evaluate)
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return function, address


class _Run:
    """A run of members, which is followed until none goes on."""

    def __init__(self, code: SceneCode, scene, ts, memory, path, did, room: int | None):
        self.code, self.scene, self.ts, self.memory, self.path, self.did = code, scene, ts, memory, path, did
        self.record, self._fixed = np.zeros((len(memory), room or _ROOM, scene[at.ROW])), room is not None
        scene[at.STRIDE] = ts.shape[1] if len(ts) > 1 else 0
        self.results = memory[:, scene[at.RESULT]]

    def follow(self) -> None:
        """Follow all to their ends."""
        members = len(self.memory)
        together = min(_TOGETHER, max(1, -(-members // cores())))
        places = [slice(begin, begin + together) for begin in range(0, members, together)]
        while True:
            self.scene[at.ROOM] = self.record.shape[1]
            if len(places) == 1:
                self._follow_some(places[0])
            else:
                pool = ThreadPoolExecutor(cores())
                try:
                    list(pool.map(self._follow_some, places))
                finally:  # who is interrupted waits for those that run, and for no others
                    pool.shutdown(cancel_futures=True)
            if (self.results == ASKS).any() and self.scene[at.HELD_ONE] == 0:
                self._add_held()
            for member in np.flatnonzero(self.results == ASKS).tolist():
                self._continue(member)
            if not (self.results == GOING).any():
                break
            if (self.memory[self.results == GOING, self.scene[at.ROWS]] >= self.record.shape[1]).any():
                if self._fixed:
                    break
                self.record = np.concatenate([self.record, np.zeros_like(self.record)], axis=1)
        if not self._fixed:
            used = int(self.memory[:, self.scene[at.ROWS]].max(initial=1))
            self.record = np.ascontiguousarray(self.record[:, : max(used, 1)])

    def _follow_some(self, members: slice) -> None:
        scene, memory = self.scene.copy(), self.memory[members]
        outputs, states = scene[at.TIMES] + 2, 2 * scene[at.N]
        numbers = scene[at.INPUTS] - states - 1 + 2 * scene[at.WATCHES]
        scene[at.JOBS] = scene[at.ORDER] + len(memory)
        each = outputs + states + numbers + outputs * states + states + 4
        work = np.zeros(scene[at.JOBS] + len(memory) * each + scene[at.REST])
        ts = self.ts[members] if scene[at.STRIDE] else self.ts
        arrays = ts, self.path[members], self.did[members], self.record[members], memory, work
        _loops().follow(scene.ctypes.data, len(memory), *(x.ctypes.data for x in arrays))

    def _add_held(self) -> None:
        """Add what closed contacts need to the scene, and let all that ask go on."""
        whole, stride = self.code.scene(len(self.memory) > 1), self.scene[at.STRIDE]
        if whole[at.HELD_ONE] == 0:
            self.code.add_kind(whole, "HELD", len(self.memory) > 1)
        self.scene = whole.copy()
        self.scene[at.STRIDE], self.results[self.results == ASKS] = stride, GOING

    def _continue(self, member: int) -> None:
        """Follow a stretch that the kernel did not finish."""
        code, scene, memory = self.code, self.scene, self.memory[member]
        states, ts = 2 * scene[at.N], self.ts[member if scene[at.STRIDE] else 0]
        closed = memory[scene[at.X] + states + 1 + scene[at.NUMBERS] :][: scene[at.K]]
        flow = code.flows["HELD" if (closed > 0).any() else "OPEN"]()
        times, y, work = np.zeros(ts.size + 2), np.zeros(states), np.zeros(scene[at.ORDER])
        numbers = np.zeros(scene[at.INPUTS] - states - 1 + 2 * scene[at.WATCHES])
        _loops().prepare(*(x.ctypes.data for x in (scene, memory, ts, times, y, numbers, work)))
        done = flow.run(times[None], y[None], numbers[None], code.tolerances)
        happened = bool(done.result[0] == EVENT_OCCURRED)
        of_member = self.path[member], self.did[member], self.record[member]
        given = scene, memory, ts, *of_member, np.ascontiguousarray(done.path[0]), np.ascontiguousarray(done.y_end[0])
        event, result = (int(done.event[0]), SUCCESSFUL) if happened else (0, int(done.result[0]))
        steps = float(done.accepted[0]), float(done.rejected[0])
        _loops().finish(*(x.ctypes.data for x in given), float(done.t_end[0]), event, result, *steps, work.ctypes.data)


class _Loops(NamedTuple):
    follow: Any
    prepare: Any
    finish: Any


@make_once
def _loops() -> _Loops:
    search = _contact_search
    return _Loops(*compile_loops(search.follow, search.prepare, search.finish))


# ---- as a primitive --------------------------------------------------------------------------------------------------


def _shapes(ts, y0, numbers, restitution, friction, *, code: SceneCode, names: tuple[str, ...]):
    batch, states = y0.shape[:-1], y0.shape[-1]
    row = _width(code, names)
    shapes = (ts.shape[-1], states), (ts.shape[-1], code.sizes["DOING"]), (code.sizes["MOST"], row), (2 * states + 12,)
    return [ShapedArray((*batch, *shape), np.dtype(float)) for shape in shapes]


def _width(code: SceneCode, names: tuple[str, ...]) -> int:
    fields = sizes_of_fields(code.sizes)
    return sum(fields[name] for name in names)


def _search_rows(*arrays, code: SceneCode, names: tuple[str, ...]):
    batch = arrays[1].shape[:-1]
    rows = [np.asarray(x, float).reshape(math.prod(batch), x.shape[-1]) for x in arrays]
    found = code.run(*rows, room=code.sizes["MOST"])
    found = found._replace(record=found.record[..., : _width(code, names)])
    return [x.reshape(*batch, *x.shape[1:]) for x in found]


def _never_varies(*_, **__):
    raise AssertionError("A search has no derivatives.")


search_p = LinearMap("lagjax_search", _shapes, _never_varies)
compute_on_host(search_p, _search_rows)


def _call_host(*arrays, **settings):
    return call_host(functools.partial(_search_rows, **settings), _shapes(*arrays, **settings), *arrays)


mlir.register_lowering(search_p, mlir.lower_fun(_call_host, multiple_results=True), platform="cpu")


# ---- sizes -----------------------------------------------------------------------------------------------------------


def sizes_of_fields(sizes: dict[str, int]) -> dict[str, int]:
    """The count of doubles in each field of a memory, of the room of a thread and of a row."""
    n, k, r, d, corners, watches, inputs, doing = (
        sizes[name] for name in ("N", "K", "R", "D", "CORNERS", "WATCHES", "INPUTS", "DOING")
    )
    size = k + r * d
    law = 12 * size**2 + 40 * size + 40
    lines = 4 * inputs + 2 * size * n + size**2 + 3 * size + 20 * watches + 4 * corners + sizes["MULTIPLIERS_COUNT"]
    fields: dict[str, int] = dict.fromkeys((*MEMORY, *WORK, *RECORD), 1)
    per_contact = (
        "RESTITUTION", "REFUTED", "FORCE_NOISE", "TOUCHES", "PARTING", "NOISE", "INVOLVED", "CLOSED", "PUSH", "STAY",
        "PARTS", "CHANGED", "TARGETS", "OPENING", "IMPULSE", "COMPRESSED", "RETURNED", "ENDS", "MEETS", "SHARES",
    )  # fmt: skip
    fields |= dict.fromkeys(per_contact, k) | dict.fromkeys(
        ("MU", "SLIP", "STUCK", "TURNS_BACK", "SLIDES", "STARTS"), r
    )
    fields |= dict.fromkeys(("VALUES", "RATES", "BEND", "IMPULSES", "APART", "HELD"), size)
    fields |= dict.fromkeys(("LARGEST", "SHIFT", "BEHIND", "OFFSET", "STOP"), 2 * n)
    fields |= dict.fromkeys(("X", "OPENED"), inputs) | dict.fromkeys(("DOUBTS", "DOUBTED"), 3)
    fields |= dict.fromkeys(("FRESH", "KINDS", "STAYS", "FELL"), watches)
    fields |= dict.fromkeys(("ROUNDING", "RATE_ROUNDING"), 2 * watches) | dict.fromkeys(
        ("GUARDS", "WATCHED"), 5 * watches
    )
    fields |= dict.fromkeys(("GRADIENTS", "RESPONSES"), size * n) | dict.fromkeys(("SLIPS", "SLIPS_BEHIND"), 2 * r)
    fields |= {
        "WIDTHS": inputs, "TIED": k + r, "CAME": sizes["SECTIONS"], "COUPLING": size**2, "FORCES": d, "CHANGE": n,
        "CORNER": 3 * corners, "PASSED": corners, "FREE": law + lines, "ORDER": 0, "JOBS": 0, "DID": doing,
        "BEFORE": n, "DIRECTION": r * d, "BEGUN": 2 * n + 1,
    }  # fmt: skip
    return fields
