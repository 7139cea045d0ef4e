"""Computes units by workers: any of them may compute a unit, with the same bits.

this process   units one after the other, on all cores
executors      a task is one unit by its number; the process that gets it opens the store by its path

An executor assigns units to processes, and each task of an array has its `part` of them. A unit that two compute by
mistake is written twice with the same bits; one whose process has died is not done, and the next run computes it. So no
worker has to know of another, and the disk needs no locks.
"""

import operator
import time
import warnings
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from itertools import islice
from typing import Any

import numpy as np

from lagjax._sweep._files import Files
from lagjax._sweep._job import Job, compute_unit, open_job, set_precision

# ---- units in this process -------------------------------------------------------------------------------------------

Notify = Callable[[], None]


def require_part(part: Any) -> slice:
    """Return part k of n, every n-th unit from the k-th on, as a slice; raise `ValueError` if invalid."""
    try:
        k, count = map(operator.index, part)
    except (TypeError, ValueError):
        k, count = 0, 0
    if not 0 <= k < count:
        raise ValueError(f"part must be two whole numbers (k, n), of which 0 ≤ k < n, as in (3, 20); got {part!r}.")
    return slice(k, None, count)


def units_to_compute(job: Job, part: slice) -> list[int]:
    """Return the units of a part that are not done, or damaged; raise `OSError` if the store cannot be written.

    A finished store may be on a read-only disk.
    """
    store, chosen = job.store, set(range(job.grid.unit_count)[part])
    store.require_arrays(job.spec)
    finished = {unit for unit in store.finished_units() if unit in chosen or unit >= job.grid.unit_count}
    damaged = store.find_damage(job.spec, finished, whole=True)
    for unit in damaged:
        store.mark_undone(job.spec, unit)
    if damaged:
        first = "; ".join(list(damaged.values())[:_NAMED])
        more = f"; and {len(damaged) - _NAMED} units more" if len(damaged) > _NAMED else ""
        warnings.warn(f"{store.path}: {first}{more}. What is damaged is computed again.", stacklevel=3)
    missing = sorted(chosen - (finished - set(damaged)))
    if missing:
        job.store.require_writable()
    return missing


def compute_units(job: Job, units: list[int], notify: Notify = lambda: None) -> int:
    """Compute and write these units in this process; return the number that no other worker had written."""
    count = 0
    with set_precision(bool(job.spec["x64"])):
        for unit in units:
            if not job.store.has_finished(unit):
                job.store.write_unit(job.spec, unit, *compute_unit(job, unit))
                notify()
                count += 1
    return count


def run_store(store: Files, notify: Notify = lambda: None, most: int | None = None, part: Any = (0, 1)) -> int:
    """Compute at most `most` units of the store at a path; return their number."""
    chosen = require_part(part)
    job = open_job(str(store.path.resolve()))
    return compute_units(job, units_to_compute(job, chosen)[:most], notify)


# ---- executors -------------------------------------------------------------------------------------------------------

_NAMED = 5  # damaged units that a warning names
_WINDOW = 64  # units that an executor is given at a time: a scheduler holds this many tasks, not a million
_POLL = 0.2  # seconds between two looks at tasks that are no futures


def submit(job: Job, units: list[int], executor: Any, notify: Notify) -> None:
    """Compute these units by an executor; raise what a task raises, `RuntimeError` if a worker has died."""
    path, remaining, running = str(job.store.path.resolve()), iter(units), set()
    try:
        while True:
            for unit in islice(remaining, _WINDOW - len(running)):
                running.add(executor.submit(run_unit, path, unit))
            if not running:
                return
            finished = _wait_for_first(running)
            running -= finished
            for task in finished:
                task.result()  # raises what it has raised
            notify()
    except BrokenExecutor as death:  # of one of the first units that are not done: workers take them in order
        left = [unit for unit in units if not job.store.has_finished(unit)][: getattr(executor, "_max_workers", 1)]
        ends = [job.grid.numbers(unit, np.array([0, job.grid.unit_size(unit) - 1])) for unit in left]
        which = ", or ".join(f"{unit} (members {a} to {b})" for unit, (a, b) in zip(left, ends, strict=True))
        raise RuntimeError(
            f"{path}: a worker process ended over unit {which}. What is done is kept. Look at these members with "
            "`simulate`. To learn which of them ends its process, begin a new store with Store(unit=1), and give "
            "`sweep` an executor of one worker."
        ) from death
    except BaseException:  # of a task, or Ctrl-C: a pool would finish the waiting tasks before it ends
        for task in running:
            task.cancel()
        raise


def run_unit(path: str, unit: int) -> None:
    compute_units(open_job(path), [unit])


def _wait_for_first(running: set[Any]) -> set[Any]:
    """Wait until a task is done; return all that are. Tasks that are no futures, as submitit's, are polled."""
    if all(isinstance(task, Future) for task in running):
        return wait(running, return_when=FIRST_COMPLETED).done
    while not (finished := {task for task in running if task.done()}):
        time.sleep(_POLL)
    return finished


def require_executor(executor: Any) -> None:
    if not isinstance(executor, Executor) and not hasattr(executor, "submit"):
        raise TypeError(
            f"executor must be a concurrent.futures.Executor, as dask's get_executor() is; got {executor!r}."
        )
    if (context := getattr(executor, "_mp_context", None)) is not None and context.get_start_method() == "fork":
        raise ValueError(
            "This ProcessPoolExecutor forks, and a fork of a process that has used JAX hangs: give it "
            "mp_context=multiprocessing.get_context('spawn')."
        )
