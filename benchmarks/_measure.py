"""How a run is measured.

Every solve is warmed up first, and what it took beyond an ordinary run counts as compile time. Then all contenders take
turns, round after round, so that a disturbance of the machine falls on all of them. A solve hands over NumPy arrays, so
nothing is left running when the clock stops. Of the rounds the median and the minimum are kept.

The error of a member is its largest component error at the end, against a reference by an independent method. How good
that reference is, is measured too: errors below `reference_error` mean "as good as the reference".

Two programs are compared round by round, and the median of those ratios is kept.
"""

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks._cases import Case
from benchmarks._contenders import Contender, reference

REFERENCE_MEMBERS = 1024  # errors are taken over the first so many members: a median needs no more


@dataclass
class Row:
    """One contender at one tolerance. Seconds are per trajectory; `steps` and `most_steps` are those of a member."""

    contender: str
    tol: float
    members: int
    compile_seconds: float
    median_error: float = float("nan")
    worst_error: float = float("nan")
    times: list[float] = field(default_factory=list)
    steps: float = float("nan")
    most_steps: int = 0

    @property
    def seconds(self) -> float:
        return statistics.median(self.times) / self.members

    @property
    def least_seconds(self) -> float:
        return min(self.times) / self.members

    def in_round(self, k: int) -> float:
        """Seconds per trajectory in one round; rows that took too long have fewer rounds, which are used again."""
        return self.times[k % len(self.times)] / self.members

    def as_dict(self) -> dict[str, Any]:
        """The columns that are stored."""
        names = ("contender", "tol", "median_error", "worst_error", "seconds")
        return {name: getattr(self, name) for name in names}


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
    truth: tuple[np.ndarray, np.ndarray] | None = None,
) -> Comparison:
    """Every contender at every tolerance, loose ones first.

    None is run again once it has used `budget` seconds at one tolerance, and one that took more for a single run is not
    asked for tighter ones. `truth` stands for `reference(case)`.
    """
    truth, check = truth or reference(case.first(REFERENCE_MEMBERS))
    rows, runs, absent = [], [], {}
    for contender in contenders:
        reason = contender.available(case)
        if reason is not None:
            absent[contender.name] = reason
            continue
        for row, run in _warmed_up(contender, case, sorted(tolerances, reverse=True), truth, budget, absent):
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


def _warmed_up(contender: Contender, case: Case, tolerances: list[float], truth, budget: float, absent: dict):
    """For each tolerance a row with errors, and the run to be timed; a reason in `absent` if it ends early."""
    if contender.members is not None:
        case = case.first(contender.members)
    spent, solve = seconds(lambda: contender.prepare(case))
    for tol in tolerances:
        first, (final, steps) = seconds(lambda tol=tol: solve(tol))
        members = min(len(final), len(truth))
        errors = _errors(final[:members], truth[:members])
        row = Row(contender.name, tol, len(final), spent + first, float(np.median(errors)), float(np.max(errors)))
        row.steps, row.most_steps = float(np.mean(steps)), int(np.max(steps))
        if first > budget:  # is it the compiler or the run?
            row.times.append(seconds(lambda tol=tol: solve(tol))[0])
        yield row, lambda tol=tol: solve(tol)
        if row.times and row.times[0] > budget and tol != tolerances[-1]:
            absent[contender.name] = f"no tolerance below {tol:.0e}, where one run takes {row.times[0]:.0f} s"
            return
        spent = 0.0  # preparing is charged to the first tolerance


def _errors(final: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Largest component error of each member; infinite for one that did not arrive."""
    return np.nan_to_num(np.abs(final - truth), nan=np.inf).max(axis=1)


# ---- equal error -----------------------------------------------------------------------------------------------------


def at_equal_error(rows: Iterable[Row], error: float, cost: Callable[[Row], float] | None = None):
    """Seconds per trajectory for this median error, by straight lines between the measured points on log-log axes.

    The second value is True where even the loosest run was more accurate than asked for: its time is then an upper
    bound. None where the error was not reached; nothing is extrapolated.
    """
    cost = cost or (lambda row: row.seconds)
    points = sorted((max(row.median_error, 1e-17), cost(row)) for row in rows if np.isfinite(row.median_error))
    front = [p for i, p in enumerate(points) if all(p[1] < better[1] for better in points[:i])]
    if not front or error < front[0][0]:
        return None
    if error >= front[-1][0]:
        return front[-1][1], True
    errors, times = np.log(np.array(front)).T
    return float(np.exp(np.interp(np.log(error), errors, times))), False


def ratio_at_equal_error(ours: list[Row], theirs: list[Row], error: float) -> float | None:
    """How many times ours takes theirs for this error: the median over the rounds."""
    rounds = max((len(row.times) for row in [*ours, *theirs]), default=0)
    pairs = [
        [at_equal_error(rows, error, lambda row, k=k: row.in_round(k)) for rows in (ours, theirs)]
        for k in range(rounds)
    ]
    ratios = [other[0] / own[0] for own, other in pairs if own and other]
    return statistics.median(ratios) if ratios else None
