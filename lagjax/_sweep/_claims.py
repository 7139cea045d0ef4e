"""Claims: which worker has which unit, by files alone, on disks that several machines share.

A claim is a file that is made exclusively, UNIT.0; who finds that its owner is dead makes UNIT.1 exclusively, and so
on: of several who find it one succeeds. The last one owns the unit. An owner that was only slow may finish too, and
writes the same bits.

A worker beats: every `BEAT` seconds it writes a greater number into its file. Another one takes it for dead when that
number has not changed for `STALE` seconds of the observer's own clock, so that clocks need not agree; on the same
machine a process that has ended is known to be dead at once.
"""

import json
import os
import socket
import threading
import time
from pathlib import Path

from lagjax._sweep._store import Store

BEAT = 2.0  # seconds; each beat is a small file
STALE = 30.0  # seconds: of fifteen beats one must get through a file system that is slow

# Of other workers: their number, and when it was first seen in this process.
_seen: dict[tuple[Path, str], tuple[int, float]] = {}


class Worker:
    """A process that works on a store, while in a `with` statement: it beats, claims units and releases them."""

    def __init__(self, store: Store):
        self.store, self.folder, self.claims = store, store.job / "workers", store.job / "claims"
        self.name = f"{socket.gethostname()}-{os.getpid()}-{os.urandom(4).hex()}"
        self._ended, self._number = threading.Event(), 0
        self._identity = {"place": _place(), "pid": os.getpid(), "began": _began(os.getpid())}

    def __enter__(self):
        with self.store.explained("nothing was computed"):
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
        """Take a unit, where nobody who is alive has it."""
        held = self._held(unit)
        if held and not self._is_dead(unit, held[-1]):
            return False
        file = self.claims / f"{unit}.{held[-1] + 1 if held else 0}"
        try:
            with (
                self.store.explained(f"unit {unit} was not claimed"),
                open(os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY), "w") as opened,
            ):
                opened.write(self.name)
        except FileExistsError:
            return False
        return True

    def release(self, unit: int) -> None:
        """Give a unit up, or have it done."""
        for generation in self._held(unit):
            (self.claims / f"{unit}.{generation}").unlink(missing_ok=True)

    def _held(self, unit: int) -> list[int]:
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
        if place is not None and place == _place() and _began(other["pid"]) != other["began"]:
            return True
        number, since = _seen.get((self.claims, key), (None, 0.0))
        if number != other["number"]:
            _seen[self.claims, key] = (other["number"], time.monotonic())
            return False
        return time.monotonic() - since > STALE


def claimed(store: Store) -> dict[int, str]:
    """The units that are claimed, and by whom; alive or not."""
    found = {}
    for name in sorted(os.listdir(store.job / "claims"), key=lambda name: tuple(map(int, name.split(".")))):
        try:
            found[int(name.split(".")[0])] = (store.job / "claims" / name).read_text()
        except FileNotFoundError:
            pass
    return found


def _place() -> str | None:
    """The identity that two processes share if they can see each other's numbers; None where it is not known."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{socket.gethostname()} {boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return None


def _began(pid: int) -> str | None:
    """When a process of this machine began, in ticks since it was started; None where there is none."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else fields[19]
