"""A unit of work: a box of members, computed in batches, and what is noted of it.

The batches of a unit follow from its size alone, all of one size; the last is filled up with copies of its last
member, which are thrown away. So a member stands at the same place of the same batch whoever computes it.
"""

import math
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lagjax._results import ENDED_WELL, SUCCESSFUL
from lagjax._sweep._batch import CRASHED, KEEP_FAILED, label
from lagjax._sweep._job import Job, cpu
from lagjax._sweep._later import states
from lagjax._sweep._members import points_of
from lagjax._sweep._statistics import partial_of, to_bytes
from lagjax._sweep._store import RESULT

_NAMED = 100  # failures of a unit that are named in its record; the array `result` has them all


class Unit(NamedTuple):
    """A unit that was computed: values (m, …) by name, what is noted of it, and its statistics as bytes."""

    values: dict[str, np.ndarray]
    record: dict
    statistics: bytes


def parts(job: Job, unit: int) -> list[tuple[np.ndarray, int]]:
    """The batches of a unit: its members in each, all of one length, and how many of them are not copies."""
    known, _ = job.store.known(unit)
    left = np.arange(job.grid.size(unit))
    left = np.setdiff1d(left, known) if known.size else left
    if not left.size:
        return []
    batch = math.ceil(len(left) / math.ceil(len(left) / job.spec["batch"]))
    starts = range(0, len(left), batch)
    return [(left[np.minimum(np.arange(k, k + batch), len(left) - 1)], min(batch, len(left) - k)) for k in starts]


def starts(job: Job, unit: int) -> tuple[Callable[[np.ndarray], dict[str, np.ndarray]], np.ndarray]:
    """The points of some members of a unit, as a function; and the ends of all of them before, where they go on."""
    box, shape = job.grid.box(unit), job.grid.box_shape(unit)
    axes, more, before = job.store.coordinates(job.spec["axes"], box), {}, np.full(job.grid.size(unit), SUCCESSFUL)
    if job.motions.left is not None:
        more, before = states(job.motions.left, box)
    return lambda which: points_of(axes, shape, which) | {name: x[which] for name, x in more.items()}, before


def _nobody(batch: int) -> None:
    pass


def compute(
    job: Job, unit: int, crashed: Mapping[int, str] = MappingProxyType({}), tell: Callable[[int], None] = _nobody
) -> Unit:
    """Compute a unit without members that are known to end their process, and how; `tell(k)` before the k-th batch."""
    began, spent = time.monotonic(), time.process_time()
    size, (points, before) = job.grid.size(unit), starts(job, unit)
    drifts, complaints = np.full(size, np.nan), {}
    known, of_known = job.store.known(unit)
    values = {q.name: np.empty((size, *q.shape), q.dtype) for q in (*job.batches.quantities, RESULT)}
    for name, x in of_known.items():
        values[name][known] = x
    for k, (which, count) in enumerate(parts(job, unit)):
        tell(k)
        kept, own = job.batches(points(_without(which, crashed))), which[:count]
        job.require_engine(kept)
        for name, x in {**kept.values, RESULT.name: kept.result}.items():
            values[name][own] = x[:count]
        if kept.drift is not None:
            drifts[own] = kept.drift[:count]
        complaints |= {int(own[j]): text for j, text in kept.complaints.items() if j < count}
    ended = np.flatnonzero(before != SUCCESSFUL)  # before these motions began
    _blank(job, values, drifts, ended, before[ended])
    _blank(job, values, drifts, list(crashed), CRASHED)
    complaints |= crashed
    record = _record(job, unit, values[RESULT.name], drifts, complaints)
    record |= {"seconds": time.monotonic() - began, "cpu_seconds": time.process_time() - spent}
    return Unit(values, record, _statistics(job, unit, values))


def _without(which: np.ndarray, crashed: Mapping[int, str]) -> np.ndarray:
    """Members of a batch with another one of them in the place of those that `crashed`."""
    bad = np.isin(which, list(crashed))
    if bad.all():
        raise ValueError("All members of a batch end their process: look at one of them alone, with `simulate`.")
    return np.where(bad, which[~bad][0], which)


def _blank(job: Job, values: dict[str, np.ndarray], drifts: np.ndarray, which, result) -> None:
    """Members of which nothing is known but their results."""
    for q in job.batches.quantities:
        values[q.name][which] = q.nothing
    values[RESULT.name][which], drifts[which] = result, np.nan


def _record(job: Job, unit: int, result: np.ndarray, drifts: np.ndarray, complaints: dict[int, str]) -> dict:
    """The notes on a unit: how members ended, the largest change of energy, and what failed."""
    counts = np.bincount(result)
    record = {
        "unit": unit,
        "members": len(result),
        "engine": job.spec["engine"],
        "cpu": cpu(),
        "slow": job.batches.slow,
    }
    record["results"] = {label(int(code)): int(counts[code]) for code in np.flatnonzero(counts)}
    failed = np.flatnonzero(~np.isin(result, ENDED_WELL))[:_NAMED]
    record["failed"] = [
        [int(number), label(int(result[j])), complaints.get(int(j), "")]
        for j, number in zip(failed, job.grid.numbers(unit, failed), strict=True)
    ]
    drifts = np.where(np.isin(result, (*ENDED_WELL, KEEP_FAILED)), drifts, np.nan)
    if np.isfinite(drifts).any():
        worst = int(np.nanargmax(drifts))
        record["drift"] = [float(drifts[worst]), int(job.grid.numbers(unit, np.array([worst]))[0])]
    return record


def _statistics(job: Job, unit: int, values: dict[str, np.ndarray]) -> bytes:
    if not job.motions.reduce:
        return b""
    ok = np.isin(values[RESULT.name], ENDED_WELL)
    numbers = job.grid.numbers(unit, np.arange(len(ok)))
    return to_bytes({name: partial_of(how, values[name], ok, numbers) for name, how in job.motions.reduce.items()})
