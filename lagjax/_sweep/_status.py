"""`Status`: the progress of a sweep, read from its store at any time by any process."""

import sys
import time
from collections import Counter
from typing import NamedTuple

import numpy as np

from lagjax._interface import show_str
from lagjax._sweep._files import Files
from lagjax._sweep._members import point_text

WELL = ("successful", "event_occurred")
_RECENT = 32  # units whose times give the rate
_NAMED = 5  # failures that are printed
_LISTED = 100  # failures that are listed; the array `result` has all


class Failure(NamedTuple):
    """A member that did not end well: its number, its point, its result, and what is known of why."""

    member: int
    point: dict[str, float]
    result: str
    why: str


class Status(NamedTuple):
    """The progress of a sweep; print it, or read its fields.

    - `done`, `members`: how many members are done, of how many; `units_done`, `units` alike.
    - `rate`: recent members per second, None before it is known; `left`: seconds until the end at that rate.
    - `results`: the number of members that ended in each way, by the names of `lagjax.RESULTS`, and
      `keep_failed`.
    - `failures`: the first hundred of those that did not end well; the array `result` of the store has all.
    - `drift`: the largest change of the energy of a member that ended well, as (change, member, point); None where
      energy is not conserved, or none is known.
    - `slow`: functions that are called member by member because they are not written in jax.numpy, and why not.
    - `damaged`: finished units whose chunks are not there, or not whole, in words by units. They do not count as done;
      the sweep, run again, computes them again. Contents are not read: `Sweep.damaged` and the next run do that.
    - `cpus`: the kinds of CPU that computed units; members of several differ as by a change of rounding.
    """

    store: str
    done: int
    members: int
    units_done: int
    units: int
    rate: float | None
    left: float | None
    results: dict[str, int]
    failures: tuple[Failure, ...]
    drift: tuple[float, int, dict[str, float]] | None
    slow: dict[str, str]
    cpus: tuple[str, ...] = ()
    damaged: dict[int, str] = {}  # noqa: RUF012  (a field of a NamedTuple, never written to)

    _repr_pretty_ = show_str

    def __str__(self) -> str:
        lines = [f"{self.store}", f"done       {self.done:,} of {self.members:,} members, {self.units_done} of "
                 f"{self.units} units"]  # fmt: skip
        if self.rate is not None and self.left is not None:
            end = f", {duration_text(self.left)} left" if self.done < self.members else ""
            lines.append(f"rate       {self.rate:,.0f} members per second{end}")
        lines += [f"{'results' if not k else '':10} {name} {n:,}" for k, (name, n) in enumerate(self.results.items())]
        for k, f in enumerate(self.failures[:_NAMED]):
            why = f": {f.why}" if f.why else ""
            lines.append(f"{'failed' if not k else '':10} member {f.member}, {f.result}, at {point_text(f.point)}{why}")
        failed = sum(count for name, count in self.results.items() if name not in WELL)
        if failed > _NAMED:
            lines.append(f"{'':10} and {failed - _NAMED} more")
        if self.drift is not None:
            change, member, point = self.drift
            lines.append(f"energy     changes by at most {change:.1e}, of member {member}, at {point_text(point)}")
        lines += [f"slow       {name} is called member by member: {why}" for name, why in self.slow.items()]
        for k, text in enumerate(list(self.damaged.values())[:_NAMED]):
            lines.append(f"{'damaged' if not k else '':10} {text}")
        if len(self.damaged) > _NAMED:
            lines.append(f"{'':10} and {len(self.damaged) - _NAMED} units more")
        if self.damaged:
            lines.append(f"{'':10} Run the sweep again: it computes them again.")
        if len(self.cpus) > 1:
            lines.append(f"CPUs       {', '.join(self.cpus)}: their members may differ as by a change of rounding")
        return "\n".join(lines)


def read_status(store: Files) -> Status:
    spec = store.spec()
    store.require_arrays(spec)
    grid, finished = store.grid(spec), store.finished_units()
    damaged = store.find_damage(spec, finished)
    done = sorted(finished - set(damaged))
    records = [store.record(unit) for unit in done]
    results = sum((Counter(record["results"]) for record in records), Counter())
    failed = [row for record in records for row in record["failed"]][:_LISTED]
    failures = tuple(Failure(number, read_point(store, spec, number), name, why) for number, name, why in failed)
    drifts = [tuple(record["drift"]) for record in records if "drift" in record]
    worst = max(drifts, key=lambda pair: pair[0], default=None)
    members, rate = sum(r["members"] for r in records), _members_per_second(store, done, records)
    slow = {name: why for record in records for name, why in record["slow"].items()}
    return Status(
        store=str(store.path), done=members, members=grid.member_count, units_done=len(done), units=grid.unit_count,
        rate=rate,
        left=None if rate is None else (grid.member_count - members) / rate, results=dict(results), failures=failures,
        drift=None if worst is None else (worst[0], worst[1], read_point(store, spec, worst[1])), slow=slow,
        cpus=tuple(dict.fromkeys(record["cpu"] for record in records if "cpu" in record)), damaged=damaged,
    )  # fmt: skip


def read_point(store: Files, spec: dict, member: int) -> dict[str, float]:
    box = tuple(slice(int(i), int(i) + 1) for i in np.unravel_index(member, tuple(spec["shape"])))
    return {name: float(x[0]) for side in store.coordinates(spec["axes"], box) for name, x in side.items()}


def _members_per_second(store: Files, done: list[int], records: list[dict]) -> float | None:
    """Return members per second, from the times of the last files on the disk, whose clock all workers share."""
    if not records:
        return None
    times = [(store.job / "done" / f"{unit}.json").stat().st_mtime for unit in done]
    recent = sorted(zip(times, records, strict=True), key=lambda pair: pair[0])[-_RECENT:]
    (begun, first), (end, _) = recent[0], recent[-1]
    if end <= begun:  # one alone, too
        return first["members"] / max(first["seconds"], 1e-9)
    return sum(record["members"] for _, record in recent[1:]) / (end - begun)


def duration_text(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


class Progress:
    """Prints the progress on one line of stderr, over and over: done, rate, failures, time left."""

    def __init__(self, store: Files, spec: dict, shown: bool):
        self.store, self.shown, self.members = store, shown, store.grid(spec).member_count
        self._begun, self._counted, self._results, self._last = None, set(), Counter(), 0.0

    def __call__(self) -> None:
        now = time.monotonic()
        if not self.shown or now - self._last < 0.2:
            return
        self._last = now
        for unit in self.store.finished_units() - self._counted:
            self._counted.add(unit)
            self._results.update(self.store.record(unit)["results"])
        done = self._results.total()
        since, before = self._begun = self._begun or (now, done)
        line = f"{done:,} of {self.members:,} members"
        if done > before and now > since:
            rate = (done - before) / (now - since)
            line += f", {rate:,.0f} per second, {duration_text((self.members - done) / rate)} left"
        line += "".join(f", {count} {name}" for name, count in self._results.items() if name not in WELL)
        print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        self._last = 0.0
        self()
        if self.shown:
            print(file=sys.stderr, flush=True)
