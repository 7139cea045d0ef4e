"""Workers: they take units until none is left. All of them do the same, wherever they run.

this process   units one after the other, on all cores; a thread writes the last one while the next is computed
children       with `isolate`: a child computes, so that an abort costs a unit (`_isolate`)
executors      a task is one unit by its number; the process that gets it opens the store by its path
"""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path
from typing import Any

from lagjax._sweep._claims import Worker
from lagjax._sweep._job import Job, opened, precision
from lagjax._sweep._store import Store
from lagjax._sweep._unit import Unit, compute

_WINDOW = 64  # units that an executor is given at a time: a scheduler holds this many tasks, not a million
_POLL = 0.2  # seconds between two looks at what others do

Compute = Callable[[Job, int], Unit]
Tell = Callable[[], None]


def work(job: Job, tell: Tell = lambda: None, compute_unit: Compute = compute, most: int | None = None) -> int:
    """Do units of a job in this process until all are done, by whomever, or `most` by it; how many it did.

    Nothing is written where all are done: a finished store may lie on a disk that is read-only.
    """
    count = 0
    if len(job.store.done()) == job.grid.units:
        return count
    job.store.require_writable()
    with Worker(job.store) as worker, _Writer(job, worker, tell) as writer, precision(bool(job.spec["x64"])):
        for unit in _to_do(job, worker, tell):
            writer.put(unit, compute_unit(job, unit))
            count += 1
            if count == most:
                break
    return count


def _to_do(job: Job, worker: Worker, tell: Tell) -> Iterator[int]:
    """The units that this worker has claimed, one after the other, until all are done."""
    units, own = set(range(job.grid.units)), set()  # of its own the last one may still be in the writer
    while left := sorted(units - job.store.done() - own):
        taken = False
        for unit in left:
            if not worker.claim(unit):
                continue
            if unit in job.store.done():  # it was finished after the look at what is left
                worker.release(unit)
                continue
            own.add(unit)
            taken = True
            yield unit
        if not taken:
            tell()
            time.sleep(_POLL)  # others work on the rest, or have died and are being watched


class _Writer:
    """A thread that writes a unit while the next one is computed; at most one waits."""

    def __init__(self, job: Job, worker: Worker, tell: Tell):
        self.job, self.worker, self.tell = job, worker, tell
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if self._thread is not None:
            self._thread.join()
        if kind is None:
            self._raise()

    def put(self, unit: int, done: Unit) -> None:
        """Have a unit written; waits for the one before. Raises what was raised when that was written."""
        if self._thread is not None:
            self._thread.join()
        self._raise()
        self._thread = threading.Thread(target=self._write, args=(unit, done))
        self._thread.start()

    def _write(self, unit: int, done: Unit) -> None:
        try:
            self.job.store.write_unit(self.job.spec, unit, *done)
            self.worker.release(unit)
            self.tell()
        except BaseException as error:
            self._error = error

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error


# ---- executors -------------------------------------------------------------------------------------------------------


def run_unit(path: str, unit: int) -> bool:
    """Do one unit of a store, in whatever process this is; whether it was free."""
    job = opened(path)
    with Worker(job.store) as worker:
        if unit in job.store.done() or not worker.claim(unit):
            return False
        with precision(bool(job.spec["x64"])):
            job.store.write_unit(job.spec, unit, *compute(job, unit))
        worker.release(unit)
    return True


def submit(job: Job, executor: Any, tell: Tell) -> None:
    """Have all units done by an executor, some at a time; goes on until all are, by whomever."""
    _require_no_fork(executor)
    if len(job.store.done()) == job.grid.units:
        return
    job.store.require_writable()
    running: set[Any] = set()
    try:
        _submit_all(job, executor, tell, running)
    except BaseException:  # of a task, or Ctrl-C: a pool would go on with what waits, before it ends
        for task in running:
            task.cancel()
        raise


def _submit_all(job: Job, executor: Any, tell: Tell, running: set[Any]) -> None:
    """Have all units done, with the tasks that are on their way in `running`."""
    path = str(Path(job.store.path).resolve())
    while True:
        left = sorted(set(range(job.grid.units)) - job.store.done())
        if not left:
            return
        free = 0
        for unit in left:
            running.add(executor.submit(run_unit, path, unit))
            while len(running) >= _WINDOW:
                free += _collect(running)
                tell()
        while running:
            free += _collect(running)
            tell()
        if not free:
            time.sleep(_POLL)


def _collect(running: set[Any]) -> int:
    """Wait for one of these tasks; how many units have been done. Raises what a task has raised."""
    finished = _first_of(running)
    running -= finished
    return sum(bool(task.result()) for task in finished)


def _first_of(running: set[Any]) -> set[Any]:
    """Those of these tasks that are done, one at least; tasks that are no futures, as those of submitit, are asked."""
    if all(isinstance(task, Future) for task in running):
        return wait(running, return_when=FIRST_COMPLETED).done
    while not (finished := {task for task in running if task.done()}):
        time.sleep(_POLL)
    return finished


def _require_no_fork(executor: Any) -> None:
    """Raise `TypeError` or `ValueError` for what is no executor, or forks a process in which JAX has threads."""
    if not isinstance(executor, Executor) and not hasattr(executor, "submit"):
        raise TypeError(
            f"executor must be a concurrent.futures.Executor, such as dask's client.get_executor(); got {executor!r}."
        )
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "This ProcessPoolExecutor forks, and a fork of a process that has used JAX hangs: give it "
            "mp_context=multiprocessing.get_context('spawn')."
        )


def run_store(store: Store, tell: Tell = lambda: None, most: int | None = None) -> int:
    """Do units of a store that is known by its path alone; how many."""
    return work(opened(str(store.path.resolve())), tell, most=most)
