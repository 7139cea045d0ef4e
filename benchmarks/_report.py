"""What remains of a run: tables on the screen, and a JSON file with everything needed to judge it."""

import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import Comparison, at_equal_error, ratio_at_equal_error
from lagjax._native import cores

PACKAGES = (
    *("lagjax", "jax", "jaxlib", "diffrax", "equinox", "llvmlite", "numpy"),
    *("heyoka", "numba", "mujoco", "scipy", "sympy"),
)
EQUAL_ERRORS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
OURS = "lagjax"


def circumstances() -> dict[str, Any]:
    """Commit, versions and machine: a time means nothing without them."""
    root = Path(__file__).parent.parent
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": _git(root, "rev-parse", "HEAD"),
        "dirty": bool(_git(root, "status", "--porcelain")),
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
        "machine": {
            "cpu": _cpu_model(),
            "cores": os.cpu_count(),
            "cores_used": cores(),
            "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            "system": platform.system(),
            "python": platform.python_version(),
        },
    }


def _git(root: Path, *arguments: str) -> str | None:
    try:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


# ---- tables ----------------------------------------------------------------------------------------------------------


def table(rows: Iterable[dict[str, Any]]) -> str:
    """Aligned columns, one for each key of the first row."""
    rows = list(rows)
    if not rows:
        return "(nothing)"
    cells = [list(rows[0]), *([_cell(row.get(key)) for key in rows[0]] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    )


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}"
    return str(value)


def error_against_time(comparison: Comparison) -> list[dict[str, Any]]:
    """The measured points."""
    return [
        {
            "contender": row.contender,
            "tol": row.tol,
            "µs/trajectory": 1e6 * row.seconds,
            "median error": row.median_error,
            "worst": row.worst_error,
            "steps": row.steps,
            "compile s": row.compile_seconds,
        }
        for row in comparison.rows
    ]


def equal_error(comparison: Comparison) -> list[dict[str, Any]]:
    """For each contender and error: seconds per trajectory, and how many times those of lagjax that is."""
    rows = {name: [r for r in comparison.rows if r.contender == name] for name in _contenders(comparison)}
    entries = []
    for name, theirs in rows.items():
        for error in EQUAL_ERRORS:
            time = at_equal_error(theirs, error)
            entries.append(
                {
                    "contender": name,
                    "error": error,
                    "seconds": time and time[0],
                    "upper_bound": bool(time and time[1]),
                    "times_lagjax": ratio_at_equal_error(rows.get(OURS, []), theirs, error),
                }
            )
    return entries


def _contenders(comparison: Comparison) -> list[str]:
    return list(dict.fromkeys(row.contender for row in comparison.rows))


def equal_error_table(comparison: Comparison) -> list[dict[str, Any]]:
    """The same for the eye: µs per trajectory, in brackets the multiple of lagjax; "≤" for an upper bound."""
    lines: dict[str, dict[str, Any]] = {}
    for entry in equal_error(comparison):
        line = lines.setdefault(entry["contender"], {"µs at equal error": entry["contender"]})
        line[f"{entry['error']:.0e}"] = _time_and_ratio(entry)
    return list(lines.values())


def _time_and_ratio(entry: dict[str, Any]) -> str | None:
    if entry["seconds"] is None:
        return None
    ratio = "" if entry["times_lagjax"] is None else f" ({entry['times_lagjax']:.2g}×)"
    return ("≤ " if entry["upper_bound"] else "") + f"{1e6 * entry['seconds']:.3g}" + ratio


def print_comparison(comparison: Comparison) -> None:
    print(f"\n{comparison.case}: {comparison.batch} members, {comparison.coordinates} coordinates, ", end="")
    print(f"T = {comparison.duration:.4g}; the reference is good to {comparison.reference_error:.0e}\n")
    print(table(error_against_time(comparison)), end="\n\n")
    print(table(equal_error_table(comparison)))
    for name, reason in comparison.absent.items():
        print(f"without {name}: {reason}")


# ---- files -----------------------------------------------------------------------------------------------------------


def read_json(path: Path) -> dict[str, Any]:
    """The parts that were written before."""
    record = json.loads(path.read_text()) if path.exists() else {}
    return {part: value for part, value in record.items() if "rows" in value}


def write_json(path: Path, record: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_finite(record), indent=0, ensure_ascii=False, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    """JSON knows neither NaN nor infinity, nor NumPy's numbers: None, and Python's, to six digits."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if np.isfinite(value) else None
