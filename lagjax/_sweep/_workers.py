"""Workers: each claims units and computes them until none is left. All of them do the same, wherever they run.

this process   units one after the other, on all cores; a thread writes the last one while the next is computed
executors      a task is one unit by its number; the process that gets it opens the store by its path
children       with `isolate`: a child computes, so that an abort costs a unit, and then the members that did it

**Claims** are files alone, on disks that several machines share. A claim is a file that is made exclusively, UNIT.0;
who finds that its owner is dead makes UNIT.1 exclusively, and so on: of several who find it one succeeds. The last one
owns the unit. An owner that was only slow may finish too, and writes the same bits. A worker beats: every `BEAT`
seconds it writes a greater number into its file. Another one takes it for dead when that number has not changed for
`STALE` seconds of the observer's own clock, so that clocks need not agree; on the same machine a process that has ended
is known to be dead at once.

filelock 4.2 has this protocol as `SoftFileLease`, which was measured instead: 0.41 ms for a claim and its release, 0.04
here, which no unit notices. But an empty claim, as a worker leaves that is killed between making and writing it, or a
machine whose power fails, counts there as held for ever (a lease of 0.5 s was not taken in 6 s): the sweep would not
end. Its `FileLock` needs a disk with flock, and falls back to locks without heartbeats where there is none: no
worker takes a unit from a machine that has died.

**A child** is started afresh, never forked, and reads from the store what it computes. When it dies, or takes
too long over a batch, the members of that batch are halved in further children until those are known that end them; the
unit is then computed without them, every other member where it stood before.
"""

import json
import os
import pickle
import queue
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lagjax._sweep._batch import KeptResults
from lagjax._sweep._begin import first_look
from lagjax._sweep._description import Description, pack_description, unpack_description, users_path
from lagjax._sweep._job import Job, Unit, compute, open_job, parts, precision, starts, uses_doubles
from lagjax._sweep._store import Store

# ---- claims ----------------------------------------------------------------------------------------------------------

BEAT = 2.0  # seconds; each beat is a small file
STALE = 30.0  # seconds: of fifteen beats one must get through a file system that is slow

# Of other workers: their number, and when it was first seen in this process.
_last_beats: dict[tuple[Path, str], tuple[int, float]] = {}


class Worker:
    """A process that works on a store, while in a `with` statement: it beats, claims units and releases them."""

    def __init__(self, store: Store):
        self.store, self.folder, self.claims = store, store.job / "workers", store.job / "claims"
        self.name = f"{socket.gethostname()}-{os.getpid()}-{os.urandom(4).hex()}"
        self._ended, self._number = threading.Event(), 0
        self._identity = {"place": _namespace(), "pid": os.getpid(), "began": _start_ticks(os.getpid())}

    def __enter__(self):
        with self.store.explain_errors("nothing was computed"):
            self._beat()
        self._thread = threading.Thread(target=self._beat_on, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()
        self._file.unlink(missing_ok=True)

    @property
    def _file(self) -> Path:
        return self.folder / f"{self.name}.json"

    def _beat_on(self) -> None:
        while not self._ended.wait(BEAT):
            try:
                self._beat()
            except OSError:  # the disk is full, or away for a while: the next one may get through
                pass

    def _beat(self) -> None:
        self._number += 1
        text = json.dumps(self._identity | {"number": self._number})
        self.store.write(self._file, text.encode(), f"beat-{self.name}")

    # ---- claims ----

    def claim(self, unit: int) -> bool:
        """Claim a unit that no live worker owns; return True if it is this worker's now."""
        held = self._generations(unit)
        if held and not self._is_dead(unit, held[-1]):
            return False
        file = self.claims / f"{unit}.{held[-1] + 1 if held else 0}"
        try:
            with (
                self.store.explain_errors(f"unit {unit} was not claimed"),
                open(os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY), "w") as opened,
            ):
                opened.write(self.name)
        except FileExistsError:
            return False
        return True

    def release(self, unit: int) -> None:
        """Remove the claims of a unit that is done, or given up."""
        for generation in self._generations(unit):
            (self.claims / f"{unit}.{generation}").unlink(missing_ok=True)

    def _generations(self, unit: int) -> list[int]:
        """The generations of claims to a unit."""
        return sorted(int(name.split(".")[1]) for name in os.listdir(self.claims) if name.split(".")[0] == str(unit))

    def _is_dead(self, unit: int, generation: int) -> bool:
        """True if the owner of a claim works no more."""
        try:
            owner = (self.claims / f"{unit}.{generation}").read_text()
        except FileNotFoundError:
            return False  # released just now: look again later
        key = owner or f"{unit}.{generation}"  # an empty claim: who died between making and writing it
        try:
            other = json.loads((self.folder / f"{owner}.json").read_text()) if owner else {"number": 0}
        except FileNotFoundError:
            return True  # it has ended and taken its file along, or never began
        except ValueError:
            other = {"number": 0}
        place = other.get("place")
        if place is not None and place == _namespace() and _start_ticks(other["pid"]) != other["began"]:
            return True
        number, since = _last_beats.get((self.claims, key), (None, 0.0))
        if number != other["number"]:
            _last_beats[self.claims, key] = (other["number"], time.monotonic())
            return False
        return time.monotonic() - since > STALE


def claimed_units(store: Store) -> dict[int, str]:
    """The units that are claimed, and by whom; alive or not."""
    found = {}
    for name in sorted(os.listdir(store.job / "claims"), key=lambda name: tuple(map(int, name.split(".")))):
        try:
            found[int(name.split(".")[0])] = (store.job / "claims" / name).read_text()
        except FileNotFoundError:
            pass
    return found


def _namespace() -> str | None:
    """The identity that two processes share if they can see each other's numbers; None where it is not known."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{socket.gethostname()} {boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return None


def _start_ticks(pid: int) -> str | None:
    """When a process of this machine began, in ticks since it was started; None where there is none."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else fields[19]


# ---- units in this process -------------------------------------------------------------------------------------------

_WINDOW = 64  # units that an executor is given at a time: a scheduler holds this many tasks, not a million
_POLL = 0.2  # seconds between two looks at what others do

Compute = Callable[[Job, int], Unit]
Notify = Callable[[], None]


def work(job: Job, notify: Notify = lambda: None, compute_unit: Compute = compute, most: int | None = None) -> int:
    """Compute units of a job in this process until all are done, or `most` by it; return the number it computed.

    Nothing is written where all are done: a finished store may lie on a disk that is read-only.
    """
    count, writing = 0, None
    if len(job.store.finished_units()) == job.grid.units:
        return count
    job.store.require_writable()
    with Worker(job.store) as worker, ThreadPoolExecutor(1) as writer, precision(bool(job.spec["x64"])):
        for unit in _claim_units(job, worker, notify):
            done = compute_unit(job, unit)
            if writing is not None:
                writing.result()  # of two units in memory one is being written; raises what the disk refused
            writing = writer.submit(_write, job, worker, notify, unit, done)
            count += 1
            if count == most:
                break
        if writing is not None:
            writing.result()
    return count


def _write(job: Job, worker: Worker, notify: Notify, unit: int, done: Unit) -> None:
    """Write a unit and release its claim."""
    job.store.write_unit(job.spec, unit, *done)
    worker.release(unit)
    notify()


def _claim_units(job: Job, worker: Worker, notify: Notify) -> Iterator[int]:
    """The units that this worker has claimed, one after the other, until all are done."""
    units, own = set(range(job.grid.units)), set()  # of its own the last one may still be in the writer
    while left := sorted(units - job.store.finished_units() - own):
        taken = False
        for unit in left:
            if not worker.claim(unit):
                continue
            if unit in job.store.finished_units():  # it was finished after the look at what is left
                worker.release(unit)
                continue
            own.add(unit)
            taken = True
            yield unit
        if not taken:
            notify()
            time.sleep(_POLL)  # others work on the rest, or have died and are being watched


# ---- executors -------------------------------------------------------------------------------------------------------


def run_unit(path: str, unit: int) -> bool:
    """Compute one unit of a store, in whatever process this is; return False where another worker has it."""
    job = open_job(path)
    with Worker(job.store) as worker:
        if unit in job.store.finished_units() or not worker.claim(unit):
            return False
        with precision(bool(job.spec["x64"])):
            _write(job, worker, lambda: None, unit, compute(job, unit))
    return True


def submit(job: Job, executor: Any, notify: Notify) -> None:
    """Compute the units by an executor, some at a time, until all are done, by whichever worker."""
    _require_no_fork(executor)
    if len(job.store.finished_units()) == job.grid.units:
        return
    job.store.require_writable()
    running: set[Any] = set()
    try:
        _submit_all(job, executor, notify, running)
    except BaseException:  # of a task, or Ctrl-C: a pool would finish the waiting tasks before it ends
        for task in running:
            task.cancel()
        raise


def _submit_all(job: Job, executor: Any, notify: Notify, running: set[Any]) -> None:
    """Have all units done, with the tasks that are on their way in `running`."""
    path = str(Path(job.store.path).resolve())
    while True:
        left = sorted(set(range(job.grid.units)) - job.store.finished_units())
        if not left:
            return
        free = 0
        for unit in left:
            running.add(executor.submit(run_unit, path, unit))
            while len(running) >= _WINDOW:
                free += _collect(running)
                notify()
        while running:
            free += _collect(running)
            notify()
        if not free:
            time.sleep(_POLL)


def _collect(running: set[Any]) -> int:
    """Wait for one of these tasks; return the number of units done. Raises what a task has raised."""
    finished = _wait_for_some(running)
    running -= finished
    return sum(bool(task.result()) for task in finished)


def _wait_for_some(running: set[Any]) -> set[Any]:
    """The tasks that are done, one at least; tasks that are no futures, as those of submitit, are polled."""
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


def run_store(store: Store, notify: Notify = lambda: None, most: int | None = None) -> int:
    """Compute units of a store that is known by its path alone; return their number."""
    return work(open_job(str(store.path.resolve())), notify, most=most)


# ---- units in a child process ----------------------------------------------------------------------------------------

PATIENCE = 600.0  # seconds for a batch, and for the start of a child: a scene of 100 bodies compiles for a minute
_MOST = 100  # members of a unit that may end their process: each takes a dozen children to find


class _ChildDeath(Exception):
    """The end of a child over some batch; `.why` in words."""

    def __init__(self, batch: int, why: str):
        super().__init__(why)
        self.batch, self.why = batch, why


def _compute_alone(child: "Child", job: Job, unit: int) -> Unit:
    """A unit by a child, without the members that end it."""
    crashed, again = _crashed_members(job, unit), 0
    while True:
        try:
            return child.ask(("unit", unit, crashed))
        except _ChildDeath as death:
            which, count = parts(job, unit)[death.batch]
            suspects = [j for j in which[:count].tolist() if j not in crashed]
            found = dict.fromkeys(_find_crashing(child, unit, suspects, whole=False), death.why)
            again += not found
            if len(crashed | found) > _MOST or again > 1:
                raise RuntimeError(_crash_message(job, unit, death, len(crashed | found))) from None
            crashed |= found
            text = json.dumps({str(j): why for j, why in crashed.items()})
            job.store.write(job.store.job / "crashed" / f"{unit}.json", text.encode(), f"{unit}-crashed")


def _crashed_members(job: Job, unit: int) -> dict[int, str]:
    """The members of a unit that are known to end their process, and how."""
    file = job.store.job / "crashed" / f"{unit}.json"
    return {int(j): why for j, why in json.loads(file.read_text()).items()} if file.exists() else {}


def _find_crashing(child: "Child", unit: int, suspects: list[int], whole: bool = True) -> list[int]:
    """The members among the suspects that end their process; `whole`: where it is not known that there are any."""
    if whole:
        try:
            child.ask(("probe", unit, suspects))
            return []
        except _ChildDeath:
            pass
    if len(suspects) < 2:
        return suspects
    half = len(suspects) // 2
    return _find_crashing(child, unit, suspects[:half]) + _find_crashing(child, unit, suspects[half:])


def _crash_message(job: Job, unit: int, death: _ChildDeath, count: int) -> str:
    more = (
        f"{count} of its members do so: look at one of them with `simulate`"
        if count > _MOST
        else "its halves do not: the memory may be too small for a batch; choose fewer output times"
    )
    return f"{job.store.path}: unit {unit} ends its process ({death.why}), and {more}. Units that are done are kept."


class Child:
    """A process that computes on demand; started when it is needed, again when it has died, ended with a `with`.

    It has `limit` seconds for a batch (True: `PATIENCE`).
    """

    def __init__(self, path: Path, limit: bool | float):
        if not isinstance(limit, bool | int | float) or not limit > 0:
            raise ValueError(f"isolate must be True, False, or the seconds that a batch may take; got {limit!r}.")
        self.path, self.limit = path, PATIENCE if limit is True else float(limit)
        self._process: subprocess.Popen | None = None
        self._ready = False  # whether it has started: the limit is for batches

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end()

    def compute(self, job: Job, unit: int) -> Unit:
        """Compute a unit, without the members that end the child."""
        return _compute_alone(self, job, unit)

    def look(self, description: Description, points: dict[str, np.ndarray]) -> tuple[KeptResults, float, bool]:
        """The kept values of a few members (`first_look`), of those at least that do not end the child."""
        request = pack_description(description), users_path(), uses_doubles()
        waiting = [points]
        while waiting:
            some = waiting.pop(0)
            try:
                return self.ask(("look", request, some))
            except _ChildDeath as death:
                half, why = len(next(iter(some.values()))) // 2, death.why
            if half:
                parts = slice(None, half), slice(half, None)
                waiting += [{name: x[part] for name, x in some.items()} for part in parts]
        raise RuntimeError(f"Every member that was tried ends its process ({why}): look at one with `simulate`.")

    def ask(self, request: tuple) -> Any:
        """The answer of the child. Raises `_ChildDeath` where it ends first, `RuntimeError` for what it raises."""
        process, replies = self._running()
        batch: Any = 0
        try:
            assert process.stdin is not None
            pickle.dump(request, process.stdin)
            process.stdin.flush()
        except OSError:
            pass  # it has died, which the next lines find
        while True:
            try:
                kind, value = replies.get(timeout=self.limit if self._ready else PATIENCE)
            except queue.Empty:
                kind, value = "late", None
            if kind == "ready":
                self._ready = True
            elif kind == "batch":
                batch = value
            elif kind == "answer":
                return value
            elif kind == "error":
                raise RuntimeError(f"In a child process:\n{value}")
            else:
                self.end()
                code = process.returncode
                late = f"it took longer than {self.limit:g} s" if kind == "late" else f"it ended with status {code}"
                raise _ChildDeath(int(batch), late)

    def end(self) -> None:
        """End the child."""
        process, self._process = self._process, None
        if process is not None:
            process.kill() if process.poll() is None else None
            process.wait()
            for pipe in (process.stdin, process.stdout):
                try:
                    pipe.close() if pipe else None
                except OSError:
                    pass

    def _running(self) -> tuple[subprocess.Popen, queue.SimpleQueue]:
        if self._process is None:
            root = str(Path(__file__).parents[2])
            more = {"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
            if platforms := jax.config.values.get("jax_platforms"):
                more["JAX_PLATFORMS"] = platforms
            code = f"from lagjax._sweep._workers import serve; serve({str(self.path)!r})"
            self._process = subprocess.Popen(
                [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | more
            )
            self._ready, self._replies = False, queue.SimpleQueue()
            threading.Thread(target=_listen, args=(self._process.stdout, self._replies), daemon=True).start()
        return self._process, self._replies


def _listen(pipe, replies: queue.SimpleQueue) -> None:
    """Hand on what a child says, until it has ended."""
    while True:
        try:
            replies.put(pickle.load(pipe))
        except Exception:  # the end, or half of an answer
            replies.put(("ended", None))
            return


# ---- in the child ----------------------------------------------------------------------------------------------------


def serve(path: str) -> None:
    """Answer the requests on stdin until it ends; prints of the user's functions go to stderr."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def send(kind: str, value: Any) -> None:
        pickle.dump((kind, value), answers)
        answers.flush()

    send("ready", None)
    while True:
        try:
            what, unit, members = pickle.load(requests)
        except EOFError:
            return
        try:
            if what == "look":
                send("answer", _look(unit, members))
                continue
            job = open_job(path)
            _set_precision(bool(job.spec["x64"]))
            if what == "unit":
                send("answer", compute(job, unit, members, lambda k: send("batch", k)))
            else:
                send("answer", _probe(job, unit, members))
        except Exception:  # sent to the parent, which raises it
            send("error", traceback.format_exc())


def _look(request: tuple[bytes, list[str], bool], points: dict[str, np.ndarray]) -> tuple[KeptResults, float, bool]:
    data, path, doubles = request
    _set_precision(doubles)
    return first_look(unpack_description(data, path), points)


def _set_precision(doubles: bool) -> None:
    """Switch this child process to a precision: callbacks of `keep` run in threads of their own."""
    jax.config.update("jax_enable_x64", doubles)


def _probe(job: Job, unit: int, members: list[int]) -> None:
    """Compute some members of a unit, in a batch no larger than that takes."""
    which = np.array(members)[np.arange(2 ** (len(members) - 1).bit_length()) % len(members)]
    job.batches(starts(job, unit)[0](which))
