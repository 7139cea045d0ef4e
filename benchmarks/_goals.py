"""What lagjax is to reach, beside what the stored numbers say. Reads the record; measures nothing.

A ratio at equal error is the median over the rounds of one run. Where a peer was more accurate than asked for even at
its loosest tolerance, its time is an upper bound and so is the ratio: such points are left out.
"""

from collections.abc import Callable, Iterable
from typing import Any

from benchmarks._constraints import price

Record = dict[str, Any]
HEYOKA = ("heyoka, SIMD", "heyoka, threads", "heyoka, single")
DIFFRAX = ("diffrax, by hand", "diffrax, autodiff")


def goals(record: Record) -> list[dict[str, Any]]:
    """One row for each goal: `reached` is None where the part that shows it was not run."""
    rows = []
    for work, bound, of in GOALS:
        sign, goal = bound.split()
        reached = _worst(of(record), sign)
        met = None if reached is None else (reached >= float(goal) if sign == "≥" else reached <= float(goal))
        rows.append(
            {"work": work, "goal": bound, "reached": reached, "met": {None: "–", True: "yes", False: "no"}[met]}
        )
    return rows


def _worst(values: Iterable[float | None], sign: str) -> float | None:
    known = [value for value in values if value is not None]
    return (min if sign == "≥" else max)(known, default=None)


def _rows(record: Record, part: str, **wanted) -> list[dict[str, Any]]:
    rows = record.get(part, {}).get("rows", [])
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def _at_equal_error(part: str, case: str | None, peers: tuple[str, ...], *errors: float) -> Callable:
    """The ratio to the fastest of the peers, at each error and in each case."""

    def ratios(record):
        for comparison in _rows(record, part, **({} if case is None else {"case": case})):
            for error in errors:
                points = [p for p in comparison["equal_error"] if p["contender"] in peers and p["error"] == error]
                known = [p["times_lagjax"] for p in points if p["times_lagjax"] is not None and not p["upper_bound"]]
                yield min(known, default=None)

    return ratios


def _over_plain_vmap(record: Record) -> Iterable[float | None]:
    """How much the lead over plain `vmap` grows from a uniform to a mixed batch."""
    leads = (_at_equal_error("mixed", case, ("lagjax, plain vmap",), 1e-6, 1e-8) for case in ("mixed", "uniform"))
    for mixed, uniform in zip(*(lead(record) for lead in leads), strict=False):
        yield mixed / uniform if mixed and uniform else None


def _price(case: str, *errors: float) -> Callable:
    """Of constraints, in times the minimal form."""

    def prices(record):
        for comparison in _rows(record, "constraints", case=case):
            known = price(comparison)
            yield from (known.get(error) for error in errors)

    return prices


def _column(part: str, column: str, **wanted) -> Callable:
    return lambda record: [row[column] for row in _rows(record, part, **wanted)]


def _all_cores(case: str) -> Callable:
    def speedup(record):
        rows = _rows(record, "cores", case=case, contender="lagjax")
        return [row["times faster than one"] for row in rows[-1:] if row["cores"] > 1]

    return speedup


def _compile(links: int) -> Callable:
    return _column("derivation", "first result s", links=links, contender="lagjax")


def _batch(case: str, peers: tuple[str, ...], *errors: float) -> Callable:
    return _at_equal_error("errors", case, peers, *errors)


LOOSE, ALL, MIDDLE = (1e-6, 1e-8), (1e-6, 1e-8, 1e-10, 1e-12), (1e-6, 1e-8, 1e-10)
GOALS = (
    ("derived right-hand side / best by hand, every scene", "≤ 1.1", _column("right_hand_sides", "lagjax/by hand")),
    ("heyoka's best / lagjax, 2 links, 1e-6…1e-12", "≥ 1.0", _batch("double_pendulum", HEYOKA, *ALL)),
    ("heyoka's best / lagjax, 2 links, 1e-6…1e-8", "≥ 1.5", _batch("double_pendulum", HEYOKA, *LOOSE)),
    ("heyoka's best / lagjax, 4 links, 1e-6…1e-10", "≥ 2.0", _batch("chain_4", HEYOKA, *MIDDLE)),
    ("heyoka's best / lagjax, 8 links, 1e-6…1e-10", "≥ 2.0", _batch("chain_8", HEYOKA, *MIDDLE)),
    ("plain diffrax, autodiff / lagjax, 2 links", "≥ 6", _batch("double_pendulum", DIFFRAX[1:], *MIDDLE)),
    ("plain diffrax, autodiff / lagjax, 8 links", "≥ 12", _batch("chain_8", DIFFRAX[1:], *MIDDLE)),
    ("mixed batch: plain vmap / lagjax, over that of a uniform one", "≥ 4", _over_plain_vmap),
    ("all cores over one, 2 links", "≥ 1.8", _all_cores("double_pendulum")),
    ("all cores over one, 8 links", "≥ 1.8", _all_cores("chain_8")),
    ("one trajectory: best plain diffrax / lagjax", "≥ 4", _at_equal_error("single", None, DIFFRAX, *MIDDLE)),
    ("first result, 2 links, s", "≤ 3", _compile(2)),
    ("first result, 4 links, s", "≤ 6", _compile(4)),
    ("first result, 8 links, s", "≤ 12", _compile(8)),
    ("constraints / minimal coordinates, 2 links, 1e-6…1e-12", "≤ 3", _price("double_pendulum", *ALL)),
    ("reverse gradient / solve, 8 parameters", "≤ 5", _column("gradient", "reverse/solve", contender="lagjax")),
    (
        "reverse against forward mode, tolerance 1e-11",
        "≤ 1e-8",
        _column("gradient", "largest", contender="lagjax", tol=1e-11),
    ),
)
