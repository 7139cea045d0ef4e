"""`Job`: a store with the functions that belong to it, in a process that is to compute; `compute`: one of its units.

The batches of a unit follow from its size alone, all of one size; the last is filled up with copies of its last
member, which are thrown away. So a member stands at the same place of the same batch whoever computes it.
"""

import hashlib
import json
import math
import os
import platform
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
from llvmlite import binding as llvm

from lagjax._interface import ENDED_WELL, SUCCESSFUL
from lagjax._sweep._batch import CRASHED, KEEP_FAILED, Batches, KeptResults, batches_of, label
from lagjax._sweep._description import Description, FinalStates, difference, texts, unpack_description
from lagjax._sweep._members import Grid, points_of
from lagjax._sweep._statistics import partial_of, to_bytes
from lagjax._sweep._store import RESULT, Store


@dataclass(frozen=True)
class Job:
    """A store, its description, and what computes its members."""

    store: Store
    spec: dict
    grid: Grid
    description: Description
    batches: Batches

    @classmethod
    def from_store(cls, store: Store, spec: dict, description: Description) -> "Job":
        """The job of a store whose functions are at hand."""
        if spec.get("cpu", cpu()) != cpu():
            warnings.warn(
                f"{store.path} was begun on a CPU of the kind {spec['cpu']}, and continues here on {cpu()}: members "
                "that are computed here may differ from those of that one, as by a change of rounding.",
                stacklevel=4,
            )
        batches = batches_of(description, spec["conserves"])
        batches.quantities = [q for q in store.quantities({**spec, "reduce": {}}) if q != RESULT]
        return cls(store, spec, store.grid(spec), description, batches)

    def require_engine(self, kept: KeptResults) -> None:
        """Raise `ValueError` where another engine integrates here than where the store was begun."""
        if kept.engine != self.spec["engine"]:
            raise ValueError(
                f"{self.store.path} was begun with the engine {self.spec['engine']}, here {kept.engine} integrates: "
                "the bits would differ. Choose the same device, by JAX_PLATFORMS=cpu for machine code."
            )


def uses_doubles() -> bool:
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


@contextmanager
def precision(doubles: bool) -> Iterator[None]:
    """Compute in the precision of the store, in this thread and in those of XLA.

    XLA calls callbacks of `keep` from threads of its own, which see the setting of the process alone: that is changed
    within this context, where it is another one. Of several stores in one process the first to come decides on it.
    """
    with _precision_lock:
        if not _active_precisions:
            _process_precision.append(_doubles_in_process())
            _set_doubles_in_process(doubles)
        _active_precisions.append(doubles)
    try:
        with jax.enable_x64(doubles):
            yield
    finally:
        with _precision_lock:
            _active_precisions.remove(doubles)
            if not _active_precisions:
                _set_doubles_in_process(_process_precision.pop())


_precision_lock = threading.Lock()
_active_precisions: list[bool] = []  # the precisions of all who are inside
_process_precision: list[bool] = []  # that of the process before the first one came, as long as a thread is inside


def _doubles_in_process() -> bool:
    """True if this process computes in doubles, whatever this thread has chosen: as a thread sees it that has not."""
    seen: list[bool] = []
    thread = threading.Thread(target=lambda: seen.append(uses_doubles()))
    thread.start()
    thread.join()
    return seen[0]


def _set_doubles_in_process(doubles: bool) -> None:
    if _doubles_in_process() != doubles:
        jax.config.update("jax_enable_x64", doubles)


def source_path(description: Description, store: Store) -> str | None:
    """The store of the ends of motions, as a path from this one's folder: both may be moved, or seen, elsewhere."""
    return None if description.left is None else os.path.relpath(description.left.path, store.path.parent)


def _relocate_source(description: Description, store: Store, path: str | None) -> Description:
    """The motions of a store, left where `path` leads from its folder. Raises `FileNotFoundError` if that is gone."""
    if description.left is None or path is None:
        return description
    other = Store((store.path.parent / path).resolve())
    other.spec()
    return replace(description, left=description.left._replace(path=str(other.path)))


def open_job(path: str) -> Job:
    """The job of a store in a process that knows nothing but its path. Raises where it is not what was begun.

    A store that was removed and made anew is another one; each is opened once.
    """
    store = Store(Path(path))
    return _open_job(path, hashlib.sha256(json.dumps(store.spec()).encode() + store.scene()).hexdigest())


@lru_cache(maxsize=4)
def _open_job(path: str, content: str) -> Job:
    store = Store(Path(path))
    spec = store.spec()
    require_versions(store, spec)
    with precision(bool(spec["x64"])):
        description = _relocate_source(unpack_description(store.scene(), spec["path"]), store, spec["continues"])
        names = [name for axis in spec["axes"] for name in axis["names"]]
        if change := difference(spec["scene"], texts(description, names)):
            raise ValueError(f"{store.path}: the scene is not here what it was when the store was begun.\n{change}")
        return Job.from_store(store, spec, description)


@lru_cache(maxsize=1)
def cpu() -> str:
    """The kind of the CPU, on which the last bits depend as well: by the width of its vectors, and what it fuses."""
    return f"{llvm.get_host_cpu_name()} ({platform.machine()})"


def versions() -> dict[str, str]:
    """The versions that the bits of a store depend on, and that of Python, whose code travels."""
    of_packages = {name: metadata.version(name) for name in ("jax", "jaxlib", "diffrax", "numpy")}
    return {"lagjax": _own_version(), "python": ".".join(platform.python_version_tuple()[:2]), **of_packages}


def _own_version() -> str:
    try:
        return metadata.version("lagjax")
    except metadata.PackageNotFoundError:
        return "unknown"


def require_versions(store: Store, spec: dict) -> None:
    """Raise `ValueError` where this process would compute other bits, or cannot read the functions."""
    here = versions()
    other = [f"{name} {was}, here {here[name]}" for name, was in spec["versions"].items() if here.get(name) != was]
    if other:
        raise ValueError(
            f"{store.path} was begun with {'; '.join(other)}: its numbers would not be of one program. Install that "
            "version to continue, or begin another store. The finished members can be read."
        )


# ---- a unit ----------------------------------------------------------------------------------------------------------

NONE: Mapping[int, str] = MappingProxyType({})
_NAMED = 100  # failures of a unit that are named in its record; the array `result` has them all


class Unit(NamedTuple):
    """A unit that was computed: values (m, …) by name, what is noted of it, and its statistics as bytes."""

    values: dict[str, np.ndarray]
    record: dict
    statistics: bytes


def parts(job: Job, unit: int) -> list[tuple[np.ndarray, int]]:
    """The batches of a unit: its members in each, all of one length, and how many of them are not copies."""
    known, _ = job.store.copied_members(unit)
    left = np.arange(job.grid.size(unit))
    left = np.setdiff1d(left, known) if known.size else left
    if not left.size:
        return []
    batch = math.ceil(len(left) / math.ceil(len(left) / job.spec["batch"]))
    starts = range(0, len(left), batch)
    return [(left[np.minimum(np.arange(k, k + batch), len(left) - 1)], min(batch, len(left) - k)) for k in starts]


def starts(job: Job, unit: int) -> tuple[Callable[[np.ndarray], dict[str, np.ndarray]], np.ndarray]:
    """The points of some members of a unit, as a function; and the earlier results of all, of motions that continue."""
    box, shape = job.grid.box(unit), job.grid.box_shape(unit)
    axes, more, before = job.store.coordinates(job.spec["axes"], box), {}, np.full(job.grid.size(unit), SUCCESSFUL)
    if job.description.left is not None:
        more, before = states(job.description.left, box)
    return lambda which: points_of(axes, shape, which) | {name: x[which] for name, x in more.items()}, before


def compute(
    job: Job, unit: int, crashed: Mapping[int, str] = NONE, notify: Callable[[int], None] = lambda _: None
) -> Unit:
    """Compute a unit without members that are known to end their process; `notify(k)` precedes the k-th batch."""
    began, spent = time.monotonic(), time.process_time()
    size, (points, before) = job.grid.size(unit), starts(job, unit)
    drifts, complaints = np.full(size, np.nan), {}
    known, of_known = job.store.copied_members(unit)
    values = {q.name: np.empty((size, *q.shape), q.dtype) for q in (*job.batches.quantities, RESULT)}
    for name, x in of_known.items():
        values[name][known] = x
    for k, (which, count) in enumerate(parts(job, unit)):
        notify(k)
        kept, own = job.batches(points(_replace_crashed(which, crashed))), which[:count]
        job.require_engine(kept)
        for name, x in {**kept.values, RESULT.name: kept.result}.items():
            values[name][own] = x[:count]
        if kept.drift is not None:
            drifts[own] = kept.drift[:count]
        complaints |= {int(own[j]): text for j, text in kept.complaints.items() if j < count}
    ended = np.flatnonzero(before != SUCCESSFUL)  # before these motions began
    _clear_members(job, values, drifts, ended, before[ended])
    _clear_members(job, values, drifts, list(crashed), CRASHED)
    complaints |= crashed
    result = values[RESULT.name]
    record = record_of(job.grid, unit, result, job.spec["engine"], complaints) | _largest_drift(
        job, unit, result, drifts
    )
    record |= {"cpu": cpu(), "slow": job.batches.slow}
    record |= {"seconds": time.monotonic() - began, "cpu_seconds": time.process_time() - spent}
    return Unit(values, record, _statistics(job, unit, values))


def _replace_crashed(which: np.ndarray, crashed: Mapping[int, str]) -> np.ndarray:
    """The members of a batch; a healthy one replaces each of those that `crashed`."""
    bad = np.isin(which, list(crashed))
    if bad.all():
        raise ValueError("All members of a batch end their process: look at one of them alone, with `simulate`.")
    return np.where(bad, which[~bad][0], which)


def _clear_members(job: Job, values: dict[str, np.ndarray], drifts: np.ndarray, which, result) -> None:
    """Set members, of which only the results are known, to the filling."""
    for q in job.batches.quantities:
        values[q.name][which] = q.filling
    values[RESULT.name][which], drifts[which] = result, np.nan


def record_of(grid: Grid, unit: int, result: np.ndarray, engine: str, complaints: Mapping[int, str] = NONE) -> dict:
    """The record of a unit: its `result`s (m,) counted by name, and the first members that failed, with complaints."""
    counts, failed = np.bincount(result), np.flatnonzero(~np.isin(result, ENDED_WELL))[:_NAMED]
    return {
        "unit": unit,
        "members": len(result),
        "engine": engine,
        "slow": {},
        "results": {label(int(code)): int(counts[code]) for code in np.flatnonzero(counts)},
        "failed": [
            [int(number), label(int(result[j])), complaints.get(int(j), "")]
            for j, number in zip(failed, grid.numbers(unit, failed), strict=True)
        ],
    }


def _largest_drift(job: Job, unit: int, result: np.ndarray, drifts: np.ndarray) -> dict:
    """The entry "drift" of a record: the largest change of energy and its member; none where no energy is known."""
    drifts = np.where(np.isin(result, (*ENDED_WELL, KEEP_FAILED)), drifts, np.nan)
    if not np.isfinite(drifts).any():
        return {}
    worst = int(np.nanargmax(drifts))
    return {"drift": [float(drifts[worst]), int(job.grid.numbers(unit, np.array([worst]))[0])]}


def _statistics(job: Job, unit: int, values: dict[str, np.ndarray]) -> bytes:
    if not job.description.reduce:
        return b""
    ok = np.isin(values[RESULT.name], ENDED_WELL)
    numbers = job.grid.numbers(unit, np.arange(len(ok)))
    return to_bytes({name: partial_of(how, values[name], ok, numbers) for name, how in job.description.reduce.items()})


def states(left: FinalStates, box: tuple[slice, ...]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The states (m, …) by name from which the members of a box continue, and their results (m,) before.

    States of members that failed or were ended by an event are NaN: they do not continue.
    """
    store = Store(Path(left.path))

    def read(name: str) -> np.ndarray:
        values = np.asarray(store.array(name)[box])
        return values.reshape(-1, *values.shape[len(box) :])

    result = read(RESULT.name)
    found = {name: read(name) for name in jax.tree.leaves((left.q, left.qdot))}
    for values in found.values():
        values[result != SUCCESSFUL] = np.nan
    return found, result
