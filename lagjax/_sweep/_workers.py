"""Workers: whoever computes a unit writes it, and the bits are the same.

this process   units one after the other, on all cores; a thread writes the last one while the next is computed
executors      a task is one unit by its number; the process that gets it opens the store by its path
children       with `isolate`: a child computes units until one ends it; others find the members that did

Who computes a unit is settled before: an executor hands units out, and each task of an array has its `part` of them. A
unit that two compute by mistake is written twice with the same bits; one whose process has died is not done, and the
next run computes it. So no worker has to know of another, and the disk needs no locks.

**A child** is started afresh, never forked, and without the user's script: it reads from the store what it computes.
Where it dies, or takes too long over a batch, the members of its unit are halved in further children until those are
known that end them; the unit is then computed without them, every other member where it stood before. A
`ProcessPoolExecutor` of one, or pebble, would not do: their children import the user's script, which then needs a
guard, and the first does not tell how its child ended.
"""

import faulthandler
import operator
import os
import pickle
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from itertools import islice
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lagjax._sweep._batch import find_failing
from lagjax._sweep._begin import Look, first_look
from lagjax._sweep._description import Description, pack_description, unpack_description, users_path, uses_doubles
from lagjax._sweep._files import Files
from lagjax._sweep._job import Job, Unit, compute, open_job, parts, precision, unit_points
from lagjax._sweep._status import Progress

# ---- units in this process -------------------------------------------------------------------------------------------

Notify = Callable[[], None]


def require_part(part: Any) -> slice:
    """Part k of n, every n-th unit from the k-th on. Raises `ValueError` where this is none."""
    try:
        k, count = map(operator.index, part)
    except (TypeError, ValueError):
        k, count = 0, 0
    if not 0 <= k < count:
        raise ValueError(f"part must be two whole numbers (k, n), of which 0 ≤ k < n, as in (3, 20); got {part!r}.")
    return slice(k, None, count)


def units_to_compute(job: Job, part: slice) -> list[int]:
    """The units of a part that are not done, or are damaged. Raises `OSError` where they could not be written. Nothing
    is written where all are done: a finished store may lie on a disk that is read-only."""
    store, chosen = job.store, set(range(job.grid.units)[part])
    store.require_arrays(job.spec)
    finished = {unit for unit in store.finished_units() if unit in chosen or unit >= job.grid.units}
    damaged = store.find_damage(job.spec, finished, whole=True)
    for unit in damaged:
        store.undo(job.spec, unit)
    if damaged:
        first = "; ".join(list(damaged.values())[:_NAMED])
        more = f"; and {len(damaged) - _NAMED} units more" if len(damaged) > _NAMED else ""
        warnings.warn(f"{store.path}: {first}{more}. What is damaged is computed again.", stacklevel=3)
    missing = sorted(chosen - (finished - set(damaged)))
    if missing:
        job.store.require_writable()
    return missing


def work(job: Job, units: list[int], notify: Notify = lambda: None) -> int:
    """Compute these units in this process; return the number of those that no other had done by then."""
    count, writing = 0, None
    with ThreadPoolExecutor(1) as writer, precision(bool(job.spec["x64"])):
        for unit in units:
            if job.store.has_finished(unit):
                continue
            done = compute(job, unit, {})
            if writing is not None:
                writing.result()  # of two units in memory one is being written; raises what the disk refused
            writing = writer.submit(_write, job, unit, done, notify)
            count += 1
        if writing is not None:
            writing.result()
    return count


def _write(job: Job, unit: int, done: Unit, notify: Notify) -> None:
    job.store.write_unit(job.spec, unit, *done)
    notify()


def run_store(store: Files, notify: Notify = lambda: None, most: int | None = None, part: Any = (0, 1)) -> int:
    """Compute units of a store that is known by its path alone, `most` at most; return their number."""
    chosen = require_part(part)
    job = open_job(str(store.path.resolve()))
    return work(job, units_to_compute(job, chosen)[:most], notify)


# ---- executors -------------------------------------------------------------------------------------------------------

_NAMED = 5  # damaged units that a warning names
_WINDOW = 64  # units that an executor is given at a time: a scheduler holds this many tasks, not a million
_POLL = 0.2  # seconds between two looks at tasks that are no futures


def submit(job: Job, units: list[int], executor: Any, notify: Notify) -> None:
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
    except BaseException:  # of a task, or Ctrl-C: a pool would finish the waiting tasks before it ends
        for task in running:
            task.cancel()
        raise


def run_unit(path: str, unit: int) -> None:
    work(open_job(path), [unit])


def _wait_for_first(running: set[Any]) -> set[Any]:
    """The tasks that are done, one at least; tasks that are no futures, as those of submitit, are polled."""
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


# ---- child processes -------------------------------------------------------------------------------------------------

PATIENCE = 600.0  # seconds for a batch, its compilation included: a scene of 100 bodies compiles for a minute
_MOST = 100  # members of a unit that may end their process: each takes two dozen children to find
_LATE = 1  # the exit status of `faulthandler` when the time is over; exceptions are sent, and end no child


class _ChildDeath(Exception):
    """The end of a child before it has answered, in words."""


def require_limit(isolate: Any) -> float | None:
    """The seconds that a child may take over a batch; None without children. Raises `ValueError`."""
    if not isinstance(isolate, bool | int | float) or isolate < 0:
        raise ValueError(f"isolate must be True, False, or the seconds that a batch may take; got {isolate!r}.")
    return None if not isolate else PATIENCE if isolate is True else float(isolate)


def work_in_children(job: Job, units: list[int], limit: float, shown: bool) -> None:
    """Compute these units in child processes. Raises `RuntimeError` at the end for units that cannot be computed."""
    path, lost, missing = str(job.store.path.resolve()), {}, units
    while missing:
        try:
            _call_child(_compute_units, path, missing, {}, limit, shown, limit=limit)
        except _ChildDeath as death:  # over the first unit that is not done
            unit = next((unit for unit in missing if not job.store.has_finished(unit)), None)
            if unit is not None and not _compute_rest(job, path, unit, limit):
                lost[unit] = str(death)
        missing = [unit for unit in missing if unit not in lost and not job.store.has_finished(unit)]
    if lost:
        names = "; ".join(f"unit {unit} ({why})" for unit, why in lost.items())
        raise RuntimeError(
            f"{path}: these units end their process, and no few members of them are the reason: {names}. Their members "
            "are not done, all others are. Look at one of them with `simulate`; or the memory may be too small for a "
            "batch: choose fewer output times."
        )


def _compute_rest(job: Job, path: str, unit: int, limit: float) -> bool:
    """Compute a unit without the members that end their process; return False where a child dies nevertheless."""

    def why_crashed(members: np.ndarray) -> str | None:
        try:
            _call_child(_probe, path, unit, members, limit, limit=limit)
        except _ChildDeath as death:
            return str(death)

    members = np.concatenate([which[:count] for which, count in parts(job, unit)])
    crashed = find_failing(members, why_crashed, _MOST)
    try:
        _call_child(_compute_units, path, [unit], crashed, limit, False, limit=limit)
    except _ChildDeath:
        return False
    return True


def look_in_children(description: Description, points: dict[str, np.ndarray], limit: float) -> Look:
    """A first look at members at these points, or at those of them that do not end the child."""
    request = pack_description(description), users_path(), uses_doubles()
    why, groups = "", [points]
    while groups:
        group = groups.pop(0)
        try:
            return _call_child(_look, *request, group, limit=limit)
        except _ChildDeath as death:
            half, why = len(next(iter(group.values()))) // 2, str(death)
        if half:
            groups += [{name: x[part] for name, x in group.items()} for part in (slice(half), slice(half, None))]
    raise RuntimeError(f"Every member that was tried ends its process ({why}): look at one with `simulate`.")


def _call_child(function: Callable, *arguments: Any, limit: float) -> Any:
    """The result of a function of this module in a process of its own, which has `limit` seconds. Raises `_ChildDeath`
    where the process ends first, `RuntimeError` for what the function raises."""
    root = str(Path(__file__).parents[2])
    more = {"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
    if platforms := jax.config.values.get("jax_platforms"):
        more["JAX_PLATFORMS"] = platforms
    code = f"from {__name__} import serve; serve()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | more
    ) as child:
        try:
            answer, _ = child.communicate(pickle.dumps((function, arguments, limit)))
        finally:
            child.kill()
    if not answer:
        raise RuntimeError("A child process could not start; its error stands on stderr.")
    if child.returncode:
        late = f"it took longer than {limit:g} s over a batch, where its stack on stderr shows"
        raise _ChildDeath(late if child.returncode == _LATE else f"it ended with status {child.returncode}")
    result, error = pickle.loads(answer[1:])
    if error:
        raise RuntimeError(f"In a child process:\n{error}")
    return result


# ---- in the child ----------------------------------------------------------------------------------------------------


def serve() -> None:
    """Call the function that stands on stdin, and answer on stdout; prints of the user's functions go to stderr."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    answers.write(b"!")  # started
    answers.flush()
    function, arguments, limit = pickle.load(sys.stdin.buffer)
    try:
        _set_alarm(limit)
        answer = function(*arguments), None
    except BaseException:  # sent to the parent, which raises it
        answer = None, traceback.format_exc()
    pickle.dump(answer, answers)
    answers.close()


def _set_alarm(limit: float) -> None:
    """End this process when so many seconds are over, whatever holds it; an alarm that was set before is none."""
    faulthandler.dump_traceback_later(limit, exit=True)


def _compute_units(path: str, units: list[int], crashed: dict[int, str], limit: float, shown: bool) -> None:
    job = _open_here(path)
    show = Progress(job.store, job.spec, shown)
    for unit in units:
        done = compute(job, unit, crashed, lambda: _set_alarm(limit))
        faulthandler.cancel_dump_traceback_later()  # a slow disk is no reason to end
        job.store.write_unit(job.spec, unit, *done)
        show()


def _probe(path: str, unit: int, members: np.ndarray, limit: float) -> None:
    """Compute some members of a unit, in batches no larger than that takes."""
    job = _open_here(path)
    points, size = unit_points(job, unit), min(job.spec["batch"], 2 ** (len(members) - 1).bit_length())
    for k in range(0, len(members), size):
        _set_alarm(limit)
        job.batches(points(np.resize(members[k : k + size], size)))


def _look(data: bytes, path: list[str], doubles: bool, points: dict[str, np.ndarray]) -> Look:
    jax.config.update("jax_enable_x64", doubles)
    return first_look(unpack_description(data, path), points, [])


def _open_here(path: str) -> Job:
    """The job of a store, whose precision becomes that of this process: callbacks of `keep` run in further threads."""
    job = open_job(path)
    jax.config.update("jax_enable_x64", bool(job.spec["x64"]))
    return job
