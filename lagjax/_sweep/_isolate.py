"""Units in a child process: what ends the child costs a unit, and then the members that did it.

The child is started afresh, never forked, and told by the path of the store what it computes. When it dies, or takes
too long over a batch, the members of that batch are halved in further children until those are known that end them; the
unit is then computed without them, every other member where it stood before.
"""

import json
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lagjax._sweep._batch import Kept
from lagjax._sweep._begin import first_look
from lagjax._sweep._job import Job, in_doubles, opened
from lagjax._sweep._scene import Motions, packed, unpacked, users_path
from lagjax._sweep._unit import Unit, compute, parts, starts

PATIENCE = 600.0  # seconds for a batch, and for the start of a child: a scene of 100 bodies compiles for a minute
_MOST = 100  # members of a unit that may end their process: each takes a dozen children to find


class _Died(Exception):
    """That a child ended, or was ended, over some batch; `.why` in words."""

    def __init__(self, batch: int, why: str):
        super().__init__(why)
        self.batch, self.why = batch, why


def _compute_alone(child: "Child", job: Job, unit: int) -> Unit:
    """A unit by a child, without the members that end it."""
    crashed, again = _known(job, unit), 0
    while True:
        try:
            return child.ask(("unit", unit, crashed))
        except _Died as death:
            which, count = parts(job, unit)[death.batch]
            suspects = [j for j in which[:count].tolist() if j not in crashed]
            found = dict.fromkeys(_search(child, unit, suspects, whole=False), death.why)
            again += not found
            if len(crashed | found) > _MOST or again > 1:
                raise RuntimeError(_hopeless(job, unit, death, len(crashed | found))) from None
            crashed |= found
            text = json.dumps({str(j): why for j, why in crashed.items()})
            job.store.write(job.store.job / "crashed" / f"{unit}.json", text.encode(), f"{unit}-crashed")


def _known(job: Job, unit: int) -> dict[int, str]:
    """The members of a unit that are known to end their process, and how."""
    file = job.store.job / "crashed" / f"{unit}.json"
    return {int(j): why for j, why in json.loads(file.read_text()).items()} if file.exists() else {}


def _search(child: "Child", unit: int, suspects: list[int], whole: bool = True) -> list[int]:
    """The members among the suspects that end their process; `whole`: where it is not known that there are any."""
    if whole:
        try:
            child.ask(("probe", unit, suspects))
            return []
        except _Died:
            pass
    if len(suspects) < 2:
        return suspects
    half = len(suspects) // 2
    return _search(child, unit, suspects[:half]) + _search(child, unit, suspects[half:])


def _hopeless(job: Job, unit: int, death: _Died, count: int) -> str:
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

    def look(self, motions: Motions, points: dict[str, np.ndarray]) -> tuple[Kept, float, bool]:
        """The kept values of a few members (`first_look`), of those at least that do not end the child."""
        request = packed(motions), users_path(), in_doubles()
        waiting = [points]
        while waiting:
            some = waiting.pop(0)
            try:
                return self.ask(("look", request, some))
            except _Died as death:
                half, why = len(next(iter(some.values()))) // 2, death.why
            if half:
                parts = slice(None, half), slice(half, None)
                waiting += [{name: x[part] for name, x in some.items()} for part in parts]
        raise RuntimeError(f"Every member that was tried ends its process ({why}): look at one with `simulate`.")

    def ask(self, request: tuple) -> Any:
        """The answer of the child. Raises `_Died` where it ends first, `RuntimeError` for what it raises."""
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
                raise _Died(int(batch), late)

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
            code = f"from lagjax._sweep._isolate import serve; serve({str(self.path)!r})"
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
    """Compute what is asked for on stdin until that ends; what the user's functions print goes to stderr."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def tell(kind: str, value: Any) -> None:
        pickle.dump((kind, value), answers)
        answers.flush()

    tell("ready", None)
    while True:
        try:
            what, unit, members = pickle.load(requests)
        except EOFError:
            return
        try:
            if what == "look":
                tell("answer", _look(unit, members))
                continue
            job = opened(path)
            _count_in(bool(job.spec["x64"]))
            if what == "unit":
                tell("answer", compute(job, unit, members, lambda k: tell("batch", k)))
            else:
                tell("answer", _probe(job, unit, members))
        except Exception:  # told to the parent, which raises it
            tell("error", traceback.format_exc())


def _look(request: tuple[bytes, list[str], bool], points: dict[str, np.ndarray]) -> tuple[Kept, float, bool]:
    data, path, doubles = request
    _count_in(doubles)
    return first_look(unpacked(data, path), points)


def _count_in(doubles: bool) -> None:
    """Switch this process, which is nobody else's, to a precision: callbacks of `keep` run in threads of their own."""
    jax.config.update("jax_enable_x64", doubles)


def _probe(job: Job, unit: int, members: list[int]) -> None:
    """Compute some members of a unit, in a batch no larger than that takes."""
    which = np.array(members)[np.arange(2 ** (len(members) - 1).bit_length()) % len(members)]
    job.batches(starts(job, unit)[0](which))
