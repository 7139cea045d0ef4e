"""Hard cases with references that were not made here: error, drift and time of lagjax, and the error of the best peer.

    python -m benchmarks.hard_cases
    python -m benchmarks.hard_cases --only Kepler Arenstorf --no-peers

Prints one table and keeps it, with commit, versions and machine, in `benchmarks/results/hard_cases.json`, and draws
`hard_cases.png` beside it. The cases are in `benchmarks/_hard/`; `tests/trust/test_hard_cases.py` holds every one of
them to its bound. Errors are absolute and in the units of the case, unless its name says otherwise.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax

from benchmarks import _report
from benchmarks._hard import CASES, Case, Experiment, Found, _figure

COLUMNS = ("case", "reference", "good to", "error", "bound", "drift", "steps", "seconds", "best peer", "its error")


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the cases that are asked for, print and store what they came to, and return that."""
    options = _options().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")
    path = options.output / "hard_cases.json"
    rows = {row["case"]: row for row in _report.read_json(path).get("hard_cases", {}).get("rows", [])}
    for case in CASES:
        if options.only and not any(word.lower() in case.name.lower() for word in options.only):
            continue
        print(f"{case.name} ...", file=sys.stderr, flush=True)
        rows[case.name] = measured(case, options.peers) | {"circumstances": _report.circumstances()}
        order = [case.name for case in CASES]
        kept = sorted((row for name, row in rows.items() if name in order), key=lambda row: order.index(row["case"]))
        record = {"hard_cases": {"circumstances": _report.circumstances(), "rows": kept}}
        _report.write_json(path, record)  # a long run may be interrupted
    record = _report.read_json(path)
    rows = record["hard_cases"]["rows"]
    print(_report.table([{column: row.get(column) for column in COLUMNS} for row in rows]))
    for row in rows:
        for remark in filter(None, (row["remark"], *row["without"])):
            print(f"{row['case']}: {remark}")
    _figure.draw(rows, options.output)
    print(f"\n{path}")
    return record


def measured(case: Case | Experiment, peers: bool = True) -> dict[str, Any]:
    """One row: all of `COLUMNS`, every peer, and why any is missing."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS) | {"case": case.name, "reference": case.reference}
    row |= {"good to": case.accuracy, "bound": case.bound}
    if missing := isinstance(case, Experiment) and case.missing():
        return row | {"remark": f"skipped: {missing}", "peers": {}, "without": []}
    found, others = case.measure(), case.against() if peers else {}
    row |= {"error": found.error, "drift": found.drift, "steps": found.steps, "seconds": found.seconds}
    there = {name: other for name, other in others.items() if isinstance(other, Found)}
    if there:
        best = min(there, key=lambda name: there[name].error)
        row |= {"best peer": best, "its error": there[best].error}
    return row | {
        "remark": found.remark,
        "peers": {name: other._asdict() for name, other in there.items()},
        "without": [f"without {name}: {why}" for name, why in others.items() if isinstance(why, str)],
    }


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hard_cases", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--only", nargs="+", help="cases whose names contain one of these words (default: all)")
    add("--no-peers", dest="peers", action="store_false", help="lagjax alone")
    add("--output", type=Path, default=Path(__file__).parent / "results", help="folder for results and the figure")
    return parser


if __name__ == "__main__":
    main()
