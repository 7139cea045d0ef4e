"""The command line: `python -m benchmarks --help`."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import jax

from benchmarks import _comparisons, _report
from benchmarks._cases import CASES, DEFAULT
from benchmarks._contenders import BATCHED
from benchmarks._measure import compare

PARTS = ("errors", *_comparisons.COMPARISONS)


def main(arguments: list[str] | None = None) -> dict:
    """Run what is asked for, print it, write it to `results.json`, and return what was written."""
    options = _options().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    record = {"circumstances": _report.circumstances(), "options": {k: str(v) for k, v in vars(options).items()}}
    for part in options.only:
        print(f"\n==== {part} ".ljust(80, "="), flush=True)
        record[part] = _errors(options) if part == "errors" else _other(part, options)
        _report.write_json(options.output / options.file, record)  # after every part: a long run may be interrupted
    print(f"\n{options.output / options.file}")
    return record


def _errors(options: argparse.Namespace) -> list[dict]:
    contenders = [c for c in BATCHED if not options.contenders or c.name in options.contenders]
    results = []
    for name in options.cases:
        case = CASES[name](options.batch)
        if options.duration is not None:
            case = replace(case, duration=options.duration)
        comparison = compare(case, contenders, options.tolerances, options.repeats, options.budget, _progress)
        _report.print_comparison(comparison)
        sys.stdout.flush()
        _report.draw(comparison, options.output / f"{name}.png")
        results.append(comparison.as_dict() | {"equal_error": _report.equal_error(comparison)})
    return results


def _other(part: str, options: argparse.Namespace) -> list[dict]:
    rows = _comparisons.COMPARISONS[part](options)
    print(_report.table(rows), flush=True)
    return rows


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _options() -> argparse.ArgumentParser:
    names = [contender.name for contender in BATCHED]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Time and error, beside those of others.")
    add = parser.add_argument
    add("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run (default: all)")
    add("--cases", nargs="+", choices=tuple(CASES), default=DEFAULT, help="scenes (default: all but chain_16)")
    add("--contenders", nargs="+", choices=names, help="of the part 'errors' (default: all that are installed)")
    add("--tolerances", nargs="+", type=float, default=[1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13])
    add("--batch", type=int, default=1024, help="members of a batch (default: 1024)")
    add("--duration", type=float, help="instead of each scene's own")
    add("--repeats", type=int, default=5, help="timed runs of each (default: 5)")
    add("--budget", type=float, default=30.0, help="seconds after which one contender is not repeated (default: 30)")
    add("--output", type=Path, default=Path(__file__).parent / "results", help="folder for results and figures")
    add("--file", default="results.json", help="name of the results in that folder (default: results.json)")
    return parser


if __name__ == "__main__":
    main()
