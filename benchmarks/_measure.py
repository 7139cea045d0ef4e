"""How a run is measured.

Every solve is warmed up first, and what it took beyond an ordinary run counts as compile time. Then all contenders take
turns, round after round, so that a disturbance of the machine falls on all of them. A solve hands over NumPy arrays, so
nothing is left running when the clock stops. Of the rounds the median and the minimum are kept.

The error of a member is its largest component error at the end, against a reference by an independent method. How good
that reference is, is measured too: errors below `reference_error` mean "as good as the reference".
"""

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from benchmarks._cases import Case
from benchmarks._contenders import Contender, reference

REFERENCE_MEMBERS = 1024  # errors are taken over the first so many members: a median needs no more


@dataclass
class Row:
    """One contender at one tolerance. Seconds are per trajectory."""

    contender: str
    tol: float
    members: int
    compile_seconds: float
    median_error: float = float("nan")
    worst_error: float = float("nan")
    times: list[float] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        return statistics.median(self.times) / self.members

    @property
    def least_seconds(self) -> float:
        return min(self.times) / self.members

    def as_dict(self) -> dict[str, Any]:
        return asdict(self) | {"seconds": self.seconds, "least_seconds": self.least_seconds}


@dataclass
class Comparison:
    """One case: rows of all contenders, and the reasons for those that are missing."""

    case: str
    batch: int
    coordinates: int
    duration: float
    reference_error: float
    rows: list[Row]
    absent: dict[str, str]

    def as_dict(self) -> dict[str, Any]:
        return vars(self) | {"rows": [row.as_dict() for row in self.rows]}


def seconds(run: Callable[[], Any]) -> tuple[float, Any]:
    """The duration of one call, and its value. The call must not return before its value is there."""
    start = time.perf_counter()
    value = run()
    return time.perf_counter() - start, value


def compare(
    case: Case,
    contenders: Iterable[Contender],
    tolerances: Iterable[float],
    repeats: int = 3,
    budget: float = 30.0,
    say: Callable[[str], None] = lambda line: None,
) -> Comparison:
    """Every contender at every tolerance. None is run again once it has used `budget` seconds at one tolerance."""
    truth, check = reference(case.first(REFERENCE_MEMBERS))
    rows, runs, absent = [], [], {}
    for contender in contenders:
        reason = contender.available(case)
        if reason is not None:
            absent[contender.name] = reason
            continue
        for row, run in _warmed_up(contender, case, tolerances, truth):
            rows.append(row)
            runs.append(run)
            say(f"{case.name}: {row.contender} at {row.tol:.0e}, warm-up {row.compile_seconds:.1f} s")
    for _ in range(repeats):
        for row, run in zip(rows, runs, strict=True):
            if sum(row.times) < budget:
                row.times.append(seconds(run)[0])
    for row in rows:
        row.compile_seconds = max(0.0, row.compile_seconds - min(row.times))
    reference_error = float(np.median(_errors(check, truth)))
    return Comparison(case.name, case.batch, case.coordinates, case.duration, reference_error, rows, absent)


def _warmed_up(contender: Contender, case: Case, tolerances: Iterable[float], truth: np.ndarray):
    """For each tolerance a row with errors but no times yet, and the run to be timed."""
    if contender.members is not None:
        case = case.first(contender.members)
    spent, solve = seconds(lambda: contender.prepare(case))
    for tol in tolerances:
        first, final = seconds(lambda tol=tol: solve(tol))
        members = min(len(final), len(truth))
        errors = _errors(final[:members], truth[:members])
        row = Row(contender.name, tol, len(final), spent + first, float(np.median(errors)), float(np.max(errors)))
        yield row, lambda tol=tol: solve(tol)
        spent = 0.0  # preparing is charged to the first tolerance


def _errors(final: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Largest component error of each member; infinite for one that did not arrive."""
    return np.nan_to_num(np.abs(final - truth), nan=np.inf).max(axis=1)


def at_equal_error(rows: Iterable[Row], error: float) -> tuple[float, bool] | None:
    """Seconds per trajectory for this median error, by straight lines between the measured points on log-log axes.

    The second value is True where even the loosest run was more accurate than asked for: its time is then an upper
    bound. None where the error was not reached; nothing is extrapolated.
    """
    points = sorted((max(row.median_error, 1e-17), row.seconds) for row in rows if np.isfinite(row.median_error))
    front = [p for i, p in enumerate(points) if all(p[1] < better[1] for better in points[:i])]
    if not front or error < front[0][0]:
        return None
    if error >= front[-1][0]:
        return front[-1][1], True
    errors, times = np.log(np.array(front)).T
    return float(np.exp(np.interp(np.log(error), errors, times))), False
