"""The command line: `python -m lagjax --help`."""

import argparse
import sys
from pathlib import Path

from lagjax._sweep import Files, Progress, Sweep, run_store


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit status. A mistake is a sentence on stderr."""
    options = _argument_parser().parse_args(arguments)
    try:
        return options.command(options)
    except (OSError, ValueError, TypeError, ImportError) as error:
        print(f"lagjax: {error}", file=sys.stderr)
        return 1


def _run_part(options: argparse.Namespace) -> int:
    store = Files(options.store.absolute())
    spec = store.spec()
    show = Progress(store, spec, not options.quiet)
    count = run_store(store, show, options.units, (options.part, options.of))
    show.end()
    print(f"{count} units done here\n{Sweep(store.path)}")
    return 0


def _print_status(options: argparse.Namespace) -> int:
    print(Sweep(options.store.absolute()))
    return 0


def _check_files(options: argparse.Namespace) -> int:
    swept = Sweep(options.store.absolute())
    damaged = swept.damaged()
    for text in damaged.values():
        print(text)
    print(f"{len(Files(swept.store).finished_units())} units are done, {len(damaged)} of them damaged.")
    return 1 if damaged else 0


def _argument_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m lagjax", description="Work on stores of lagjax.")
    commands = parser.add_subparsers(required=True, title="commands")
    of_sweeps = commands.add_parser("sweep", help="a sweep that lagjax.sweep has begun")
    actions = of_sweeps.add_subparsers(required=True, title="actions")
    for name, command, about in (
        ("run", _run_part, "compute the units that are missing or damaged (unpickles: run only stores of your own)"),
        ("status", _print_status, "tell how far it is"),
        ("check", _check_files, "read all that is done, and tell what is damaged"),
    ):
        action = actions.add_parser(name, help=about, description=about)
        action.add_argument("store", type=Path, metavar="STORE", help="the folder")
        action.set_defaults(command=command)
        if name == "run":
            action.add_argument("--units", type=int, help="end after this many units (default: when all are done)")
            about = "compute part K of N, counted from 0: every N-th unit, as a task of an array of batch jobs"
            action.add_argument("--part", type=int, default=0, metavar="K", help=about)
            action.add_argument("--of", type=int, default=1, metavar="N", help="the number of parts (default: 1)")
            action.add_argument("--quiet", action="store_true", help="print no progress")
    return parser


if __name__ == "__main__":
    sys.exit(main())
