"""The command line: `python -m benchmarks --help`."""

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from benchmarks import (
    _comparisons,
    _constraints,
    _derivation,
    _figures,
    _gradient,
    _latency,
    _mixed,
    _report,
    _sizes,
)
from benchmarks._cases import CASES
from benchmarks._contenders import BATCHED, SINGLE
from benchmarks._measure import Comparison, compare

SINGLE_MEMBERS = 16


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run what is asked for, print it, write it to `results.json`, and return what is there.

    Parts and cases that were not asked for stay as they are in that file, each with its own commit and machine.
    """
    options = _options().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    if options.device == "cpu":
        jax.config.update("jax_platforms", "cpu")  # also where there is a GPU, which is for the part `gpu`
    path = options.output / options.file
    record = _report.read_json(path)
    for part in options.only:
        print(f"\n==== {part} ".ljust(80, "="), flush=True)
        kept = record.get(part, {}).get("rows", []) if part in COMPARISONS else []
        record[part] = _origin(options) | {"rows": kept}
        for row in _rows_of(part, options):
            others = [
                other for other in record[part]["rows"] if part not in COMPARISONS or other["case"] != row["case"]
            ]
            record[part]["rows"] = [*others, row]
            _report.write_json(path, record)  # a long run may be interrupted
        if part not in COMPARISONS:
            print(_report.table(record[part]["rows"]), flush=True)
        _figures.draw(part, record, options.output)
    print(f"\n{path}")
    return record


def _origin(options: argparse.Namespace) -> dict[str, Any]:
    """Commit, versions and machine, and the options that the rows do not show."""
    shown = {key: vars(options)[key] for key in ("links", "repeats", "budget", "device")}
    return {"circumstances": _report.circumstances(), "options": shown}


def _rows_of(part: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    if part in TABLES:
        yield from TABLES[part](options)
    else:
        for comparison in COMPARISONS[part](options):
            _report.print_comparison(comparison)
            sys.stdout.flush()
            exact = [entry for entry in _report.equal_error(comparison) if not entry["upper_bound"]]
            row = comparison.as_dict() | {"equal_error": exact} | _origin(options)
            if part == "constraints":
                print(_constraints.price_line(row), flush=True)
            yield row


# ---- parts that are errors against times -----------------------------------------------------------------------------


def _errors(options: argparse.Namespace) -> Iterator[Comparison]:
    """Batches of every scene."""
    contenders = [c for c in BATCHED if not options.contenders or c.name in options.contenders]
    for case in _cases(options):
        yield compare(case, contenders, options.tolerances, options.repeats, options.budget, _progress)


def _single(options: argparse.Namespace) -> Iterator[Comparison]:
    """Latency: sixteen members of every scene, one after the other."""
    for case in _cases(options):
        few = case.first(SINGLE_MEMBERS)
        yield compare(few, SINGLE, options.tolerances, options.repeats, options.budget, _progress)


def _mixed_batch(options: argparse.Namespace) -> Iterator[Comparison]:
    for comparison in _mixed.mixed(options):
        print(f"\n{comparison.case}: the busiest member takes {_mixed.waiting(comparison):.2g} times the mean steps")
        yield comparison


def _cases(options: argparse.Namespace):
    for name in options.cases:
        case = CASES[name](options.batch)
        yield case if options.duration is None else replace(case, duration=options.duration)


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


# ---- the GPU ---------------------------------------------------------------------------------------------------------


def _gpu(options: argparse.Namespace) -> list[dict[str, Any]]:
    """The part `batches` again in a process of its own, with JAX on the GPU; the other programs stay on the CPU."""
    child = [sys.executable, "-m", "benchmarks", "--device", "gpu", "--only", "batches", "--file", "gpu.json"]
    child += ["--batch", str(options.batch), "--repeats", str(options.repeats), "--budget", str(options.budget)]
    child += ["--output", str(options.output.absolute())]
    root = Path(__file__).parent.parent
    found = subprocess.run(
        [sys.executable, "-c", "import jax; print(jax.devices('gpu')[0].device_kind)"], capture_output=True, text=True
    )
    if found.returncode:
        print("This machine has no GPU that JAX can use.")
        return []
    subprocess.run(child, cwd=root, check=True)
    record = _report.read_json(options.output / "gpu.json")
    return [{"device": found.stdout.strip()} | row for row in record["batches"]["rows"]]


# ---- all parts -------------------------------------------------------------------------------------------------------

COMPARISONS: dict[str, Callable] = {
    "errors": _errors, "single": _single, "mixed": _mixed_batch, "constraints": _constraints.constraints,
}  # fmt: skip
TABLES: dict[str, Callable] = {
    "right_hand_sides": _comparisons.right_hand_sides,
    "derivation": _derivation.derivation,
    "sizes": _sizes.sizes,
    "first_results": _sizes.first_results,
    "latency": _latency.latency,
    "batches": _comparisons.batches,
    "cores": _comparisons.cores,
    "gradient": _gradient.gradient,
    "gpu": _gpu,
}
PARTS = (*COMPARISONS, *TABLES)


def _options() -> argparse.ArgumentParser:
    names = [contender.name for contender in BATCHED]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Time and error, beside those of others.")
    add = parser.add_argument
    add("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run (default: all)")
    add("--cases", nargs="+", choices=tuple(CASES), default=tuple(CASES), help="scenes (default: all)")
    add("--contenders", nargs="+", choices=names, help="of the part 'errors' (default: all that are installed)")
    add("--tolerances", nargs="+", type=float, default=[1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13])
    add("--batch", type=int, default=4096, help="members of a batch (default: 4096)")
    add("--links", type=int, default=128, help="longest chain of 'sizes' and 'derivation' (default: 128)")
    add("--duration", type=float, help="instead of each scene's own")
    add("--repeats", type=int, default=5, help="timed runs of each (default: 5)")
    add("--budget", type=float, default=30.0, help="seconds after which one contender is not repeated (default: 30)")
    add("--device", choices=("cpu", "gpu"), default="cpu", help="where JAX computes (default: cpu)")
    add("--output", type=Path, default=Path(__file__).parent / "results", help="folder for results and figures")
    add("--file", default="results.json", help="name of the results in that folder (default: results.json)")
    return parser


if __name__ == "__main__":
    main()
