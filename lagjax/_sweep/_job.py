"""`Job`: a store with its functions loaded, in a process that computes; `compute_unit`: the computation of one unit.

The batches of a unit follow from its size alone, all of one size; the last is filled up with copies of its last member,
which are thrown away. So a member has the same index in the same batch whoever computes it.
"""

import math
import platform
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from llvmlite import binding as llvm

from lagjax._interface import ENDED_WELL, VERSION
from lagjax._sweep._batch import KEEP_FAILED, Batches, KeptResults, result_name
from lagjax._sweep._description import Description, describe_functions, differences, unpack_description, uses_doubles
from lagjax._sweep._files import RESULT, Files
from lagjax._sweep._members import Grid, points_of
from lagjax._sweep._statistics import statistics_to_bytes, unit_statistics


@dataclass(frozen=True)
class Job:
    store: Files
    spec: dict
    grid: Grid
    description: Description
    batches: Batches

    @classmethod
    def from_store(cls, store: Files, spec: dict, description: Description, batches: Batches | None = None) -> "Job":
        """Return the job of a store with its functions; `batches` may have been compiled for them."""
        if spec.get("cpu", cpu_kind()) != cpu_kind():
            warnings.warn(
                f"{store.path} was begun on a CPU of the kind {spec['cpu']}, and continues here on {cpu_kind()}: "
                "members that are computed here may differ from those of that one, as by a change of rounding.",
                stacklevel=4,
            )
        batches = batches or Batches(description, spec["conserves"])
        batches.quantities = [q for q in store.quantities({**spec, "reduce": {}}) if q != RESULT]
        return cls(store, spec, store.grid(spec), description, batches)

    def require_engine(self, kept: KeptResults) -> None:
        if kept.engine != self.spec["engine"]:
            raise ValueError(
                f"{self.store.path} was begun with the engine {self.spec['engine']}, here {kept.engine} integrates: "
                "the bits would differ. Choose the same device, by JAX_PLATFORMS=cpu for machine code."
            )


@contextmanager
def set_precision(doubles: bool) -> Iterator[None]:
    """Context that sets 64- or 32-bit floats as in the store, for this thread and those in which XLA calls back `keep`.

    Those see the setting of the process. Of several stores in one process the first determines it.
    """
    with _precision_lock:
        _doubles_before.append(_doubles_in_process())
        if len(_doubles_before) == 1:
            _set_doubles_in_process(doubles)
    try:
        with jax.enable_x64(doubles):
            yield
    finally:
        with _precision_lock:
            before = _doubles_before.pop()
            if not _doubles_before:
                _set_doubles_in_process(before)


_precision_lock = threading.Lock()
_doubles_before: list[bool] = []  # of all who are inside, whether the process had doubles when they came


def _doubles_in_process() -> bool:
    """True if JAX's default precision of this process is 64 bits, as seen by a thread without own setting."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(uses_doubles).result()


def _set_doubles_in_process(doubles: bool) -> None:
    if _doubles_in_process() != doubles:
        jax.config.update("jax_enable_x64", doubles)


def open_job(path: str) -> Job:
    """Return the job of the store at a path, cached by content; raise if it is not what was begun."""
    return _open_job(path, Files(Path(path)).identity())


@lru_cache(maxsize=4)
def _open_job(path: str, content: str) -> Job:
    store = Files(Path(path))
    spec = store.spec()
    require_versions(store, spec)
    with set_precision(bool(spec["x64"])):
        description = unpack_description(store.scene(), spec["path"])
        names = [name for axis in spec["axes"] for name in axis["names"]]
        if change := differences(spec, {"scene": describe_functions(description, names)}, ["scene"]):
            raise ValueError(f"{store.path}: the scene is not here what it was when the store was begun.\n{change[0]}")
        return Job.from_store(store, spec, description)


@lru_cache(maxsize=1)
def cpu_kind() -> str:
    """Return the kind of the CPU, on which the last bits depend: by its vector width and fused operations."""
    return f"{llvm.get_host_cpu_name()} ({platform.machine()})"


def package_versions() -> dict[str, str]:
    """Return the versions of packages on which the bits of a store depend, and of Python, for pickled code."""
    of_packages = {name: metadata.version(name) for name in ("jax", "jaxlib", "diffrax", "numpy")}
    return {"lagjax": VERSION, "python": ".".join(platform.python_version_tuple()[:2]), **of_packages}


def require_versions(store: Files, spec: dict) -> None:
    """Raise `ValueError` if this process would compute other bits, or cannot load the functions."""
    here = package_versions()
    other = [f"{name} {was}, here {here[name]}" for name, was in spec["versions"].items() if here.get(name) != was]
    if other:
        raise ValueError(
            f"{store.path} was begun with {'; '.join(other)}: its numbers would not be of one program. Install that "
            "version to continue, or begin another store. The finished members can be read."
        )


# ---- a unit ----------------------------------------------------------------------------------------------------------

_NAMED = 100  # failures of a unit that are named in its record; the array `result` has them all


class Unit(NamedTuple):
    """A computed unit: values (m, …) by name, its record, and its statistics as bytes."""

    values: dict[str, np.ndarray]
    record: dict
    statistics: bytes


def split_unit(job: Job, unit: int) -> list[tuple[np.ndarray, int]]:
    """Return the batches of a unit: the members in each, all of one length, and how many are not copies."""
    members = np.setdiff1d(np.arange(job.grid.unit_size(unit)), job.store.read_copied(unit).members)
    if not members.size:
        return []
    batch = math.ceil(len(members) / math.ceil(len(members) / job.spec["batch"]))
    firsts = range(0, len(members), batch)
    last = len(members) - 1
    return [(members[np.minimum(np.arange(k, k + batch), last)], min(batch, len(members) - k)) for k in firsts]


def find_unit_points(job: Job, unit: int) -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    axes, shape = job.store.coordinates(job.spec["axes"], job.grid.box(unit)), job.grid.box_shape(unit)
    starts = job.store.read_copied(unit).starts
    return lambda which: points_of(axes, shape, which) | {name: x[which] for name, x in starts.items()}


def compute_unit(job: Job, unit: int) -> Unit:
    began, spent = time.monotonic(), time.process_time()
    size, points, copied = job.grid.unit_size(unit), find_unit_points(job, unit), job.store.read_copied(unit)
    drifts, complaints = np.full(size, np.nan), {}
    values = {q.name: np.full((size, *q.shape), q.filling, q.dtype) for q in (*job.batches.quantities, RESULT)}
    result = values[RESULT.name]
    for name, x in copied.values.items():
        values[name][copied.members] = x
    for which, count in split_unit(job, unit):
        kept = job.batches(points(which))
        job.require_engine(kept)
        own = which[:count]
        for name, x in {**kept.values, RESULT.name: kept.result}.items():
            values[name][own] = x[:count]
        if kept.drift is not None:
            drifts[own] = kept.drift[:count]
        complaints |= {int(which[j]): text for j, text in kept.complaints.items() if j < count}
    record = unit_record(job.grid, unit, result, job.spec["engine"], complaints)
    drifts = np.where(np.isin(result, (*ENDED_WELL, KEEP_FAILED)), drifts, np.nan)
    if np.isfinite(drifts).any():  # the largest change of energy, and its member
        worst = int(np.nanargmax(drifts))
        record["drift"] = [float(drifts[worst]), int(job.grid.numbers(unit, np.array(worst)))]
    record |= {"cpu": cpu_kind(), "slow": job.batches.slow}
    record |= {"seconds": time.monotonic() - began, "cpu_seconds": time.process_time() - spent}
    ok, numbers = np.isin(result, ENDED_WELL), job.grid.numbers(unit, np.arange(size))
    reduced = {name: unit_statistics(how, values[name], ok, numbers) for name, how in job.description.reduce.items()}
    return Unit(values, record, statistics_to_bytes(reduced) if reduced else b"")


def unit_record(grid: Grid, unit: int, result: np.ndarray, engine: str, complaints: dict[int, str]) -> dict:
    """Return the record of a unit: counts of its `result`s (m,) by name, and the first failed members."""
    codes, failed = np.unique(result, return_counts=True), np.flatnonzero(~np.isin(result, ENDED_WELL))[:_NAMED]
    results = {result_name(int(code)): int(count) for code, count in zip(*codes, strict=True)}
    rows = zip(grid.numbers(unit, failed), result[failed], failed, strict=True)
    listed = [[int(number), result_name(int(code)), complaints.get(int(j), "")] for number, code, j in rows]
    return dict(unit=unit, members=len(result), engine=engine, slow={}, results=results, failed=listed)
