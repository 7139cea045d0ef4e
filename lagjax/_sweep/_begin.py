"""Stores that are begun, and stores that are there: what both have to be."""

import json
import math
import time
import warnings
from collections.abc import Callable

import numpy as np

from lagjax._hybrid import Hybrid
from lagjax._layout import Layout
from lagjax._results import RESULTS, code_of
from lagjax._sweep import _batch
from lagjax._sweep._batch import Kept, batches_of, label, quantities_of
from lagjax._sweep._designs import Design
from lagjax._sweep._extend import carry, require_extensible
from lagjax._sweep._job import Job, cpu, goes_on_from, in_doubles, require_versions, versions
from lagjax._sweep._later import states
from lagjax._sweep._members import RESERVED, Axis, Grid, in_words, points_of
from lagjax._sweep._scene import Motions, difference, packed, texts, users_path
from lagjax._sweep._store import FORMAT, NOT_DONE, RESULT, Quantity, Store

SECONDS = 20.0  # of a unit, by default: what a worker that dies loses
UNIT_BYTES = 64 * 2**20  # of what is kept of a unit, by default; two of them are in memory, one being written
_PROBED = 4096  # members by which the time of a member is estimated


def first_look(motions: Motions, points: dict[str, np.ndarray]) -> tuple[Kept, float, bool]:
    """The kept values of a few members, the seconds that one of them takes, and whether the energy is constant."""
    conserves = _conserves(motions, points)
    batches = batches_of(motions, conserves)
    points = _some(points, UNIT_BYTES // max(1, batches.bytes_of_one(points)))
    batches(points)  # which compiles
    began = time.perf_counter()
    kept = batches(points)
    return kept, (time.perf_counter() - began) / len(kept.result), conserves


def _some(points: dict[str, np.ndarray], most: int) -> dict[str, np.ndarray]:
    """At most this many of these points, one at least."""
    count = len(next(iter(points.values())))
    return {name: x[:: -(-count // max(1, most))] for name, x in points.items()}


Look = Callable[[Motions, dict[str, np.ndarray]], tuple[Kept, float, bool]]


def begin(
    store: Store,
    axes: tuple[Axis, ...],
    motions: Motions,
    unit: int | None,
    look: Look = first_look,
    extend: Store | None = None,
) -> None:
    """Make the store, after a look at what a few members take and keep, with the members that `extend` knows."""
    scene = packed(motions)
    points, shape = _few(axes, motions), tuple(axis.size for axis in axes)
    points = _some(points, _room(motions, points))
    kept, seconds, conserves = look(motions, points)
    quantities = quantities_of(kept)
    _require_names(quantities, axes, motions.reduce)
    members = _unit_size(unit, shape, seconds, quantities)
    names = [name for axis in axes for name in axis.names]
    spec = {
        "format": FORMAT, "versions": versions(), "cpu": cpu(), "x64": in_doubles(), "engine": kept.engine,
        "axes": [axis.described() for axis in axes], "shape": shape, "chunk": Grid.of(shape, members).chunk,
        "batch": _batch_size(motions, points, kept), "seconds_per_member": seconds, "conserves": conserves,
        "kept": [{"name": q.name, "shape": q.shape, "dtype": q.dtype.str} for q in quantities], **motions.described(),
        "goes_on_from": goes_on_from(motions, store), "scene": texts(motions, names), "path": users_path(),
    }  # fmt: skip
    codes = sorted({code_of(item) for item in RESULTS._name_to_item.values()} | set(_batch.NAMES))
    title = f"lagjax sweep over {', '.join(names)}"
    extend = None if motions.left else extend  # of which no member is taken as it is
    if extend is not None:
        require_extensible(extend, extend.spec(), spec)
    with store.made_aside() as new:
        new.create(spec, scene, axes, title, {NOT_DONE: "not_done"} | {code: label(code) for code in codes})
        if extend is not None:
            carry(extend, new)


def _few(axes: tuple[Axis, ...], motions: Motions) -> dict[str, np.ndarray]:
    """Points of some thousand members, evenly spread over the grid; of designs, and of what goes on, the first ones."""
    sides, shape = [], []
    for axis in axes:
        _, values = next(axis.pieces())
        count = min(axis.size, max(2, round(_PROBED ** (1 / len(axes)))), len(values))
        count = count if math.prod(shape) * count <= _PROBED else 1  # of a dozen axes and more
        first = isinstance(axis.source, Design) or motions.left is not None
        which = np.arange(count) if first else np.linspace(0, len(values) - 1, count).astype(int)
        sides.append({name: values[which, c] for c, name in enumerate(axis.names)})
        shape.append(count)
    points = points_of(sides, tuple(shape), np.arange(int(np.prod(shape))))
    return points | (states(motions.left, tuple(map(slice, shape)))[0] if motions.left else {})


def _conserves(motions: Motions, points: dict[str, np.ndarray]) -> bool:
    """True if the energy of this scene is known to be constant."""
    if isinstance(motions.system, Hybrid):
        return False  # resets may do work
    q, qdot, params = motions.start({name: x[0] for name, x in points.items()})
    return bool(motions.system.explain(q, qdot, params=params).energy_conserved)


def _unit_size(unit: int | None, shape: tuple[int, ...], seconds: float, quantities: list[Quantity]) -> int:
    """The members of a unit: what is asked for, or as many as take `SECONDS`, few enough to be held in memory."""
    if unit is not None:
        if isinstance(unit, bool) or not isinstance(unit, int | np.integer) or unit < 1:
            raise ValueError(f"unit must be a positive whole number of members; got {unit!r}.")
        return int(unit)
    total = int(np.prod(shape, dtype=np.int64))
    each = sum(q.dtype.itemsize * int(np.prod(q.shape)) for q in [*quantities, RESULT])
    several = max(_PROBED, total // 16)  # some units even of a short sweep
    return max(1, min(int(SECONDS / seconds), UNIT_BYTES // each, several))


def _batch_size(motions: Motions, points: dict[str, np.ndarray], kept: Kept) -> int:
    """The most members of a batch: their paths take at most `PATH_BYTES`."""
    most = _batch.MOST if kept.engine == "MachineCode" else _batch.MOST_ON_DEVICES
    return max(1, min(most, _room(motions, points)))


def _room(motions: Motions, points: dict[str, np.ndarray]) -> int:
    """The members whose paths, and what is noted on the way, take `PATH_BYTES`; none where one takes more."""
    q, qdot, _ = motions.start({name: x[0] for name, x in points.items()})
    states = 2 * Layout.of(q, qdot).size
    noted = motions.sections.bytes_of(states) if motions.sections else 0
    return _batch.PATH_BYTES // (8 * states * len(motions.ts) + noted)


def _require_names(quantities: list[Quantity], axes: tuple[Axis, ...], reduce: dict) -> None:
    """Raise `ValueError` where what `keep` returns cannot stand in a store under its name, or not be reduced."""
    names = [q.name for q in quantities]
    taken = {*RESERVED, *(a.dimension for a in axes), *(n for a in axes for n in a.names)}
    inner = {dimension: q.name for q in quantities for dimension in q.dimensions}
    for q in quantities:
        if q.name in taken:
            raise ValueError(f"keep returns {q.name!r}, which is a name in over, or `result`: give it another name.")
        if "/" in q.name or not q.name or q.name.startswith(".") or q.name == "zarr.json":
            raise ValueError(
                f"keep returns {q.name!r}: names must not be empty, begin with a dot, contain a slash, or be zarr.json."
            )
    for name in [*names, *taken]:
        if name in inner:
            raise ValueError(
                f"keep returns {inner[name]!r}, an array, of which the store calls an axis {name!r}; something else "
                "has this name already: rename one of them."
            )
    if missing := [name for name in reduce if name not in names]:
        raise ValueError(f"reduce names {missing}, which keep does not return; it returns {names}.")
    if mixed := [q.name for q in quantities if q.name in reduce and q.dtype.kind == "c"]:
        raise ValueError(f"reduce names {mixed}, which are complex: let keep return real and imaginary parts.")


# ---- a store that is there -------------------------------------------------------------------------------------------


def require_same(store: Store, spec: dict, axes: tuple[Axis, ...], motions: Motions) -> None:
    """Raise `ValueError`, with the difference, where the store was begun with another description."""
    require_versions(store, spec)
    names = [name for axis in axes for name in axis.names]
    now = {"axes": [axis.described() for axis in axes], "x64": in_doubles(), **motions.described()}
    now["goes_on_from"] = goes_on_from(motions, store)
    now = json.loads(json.dumps(now))
    words = {"axes": in_words}
    lines = [
        f"{name}: {words.get(name, str)(spec[name])} in the store, now {words.get(name, str)(x)}"
        for name, x in now.items()
        if spec[name] != x
    ]
    if change := difference(spec["scene"], texts(motions, names)):
        lines.append(change)
    if lines:
        raise ValueError(
            f"{store.path} was begun with another description, and is left as it is. Take another store, or the "
            "description of this one. What differs:\n" + "\n".join(lines)
        )


def repair(job: Job) -> None:
    """Have units computed again whose chunks are not whole, as after a crash of the disk."""
    for unit, text in job.store.damaged(job.spec, job.store.done()).items():
        warnings.warn(f"{job.store.path}: {text}. It is computed again.", stacklevel=3)
        job.store.undo(job.spec, unit)
