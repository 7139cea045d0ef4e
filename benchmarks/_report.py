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
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
        "machine": {
            "cpu": _cpu_model(),
            "cores": os.cpu_count(),
            "cores_used": cores(),
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
    """For each contender and error it reaches: seconds per trajectory, and how many times those of lagjax that is."""
    rows = {name: [r for r in comparison.rows if r.contender == name] for name in _contenders(comparison)}
    entries = []
    for name, theirs in rows.items():
        for error in EQUAL_ERRORS:
            if time := at_equal_error(theirs, error):
                ratio = ratio_at_equal_error(rows.get(OURS, []), theirs, error)
                entry = {"contender": name, "error": error, "seconds": time[0], "upper_bound": time[1]}
                entries.append(entry | {"times_lagjax": ratio})
    return entries


def _contenders(comparison: Comparison) -> list[str]:
    return list(dict.fromkeys(row.contender for row in comparison.rows))


def equal_error_table(comparison: Comparison) -> list[dict[str, Any]]:
    """The same for the eye: µs per trajectory, in brackets the multiple of lagjax; "≤" for an upper bound."""
    empty = {f"{error:.0e}": None for error in EQUAL_ERRORS}
    lines: dict[str, dict[str, Any]] = {name: {"µs at equal error": name} | empty for name in _contenders(comparison)}
    for entry in equal_error(comparison):
        lines[entry["contender"]][f"{entry['error']:.0e}"] = _time_and_ratio(entry)
    return list(lines.values())


def _time_and_ratio(entry: dict[str, Any]) -> str:
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

DIGITS = 3  # of a stored number: times repeat to two, and errors are compared by their powers of ten
MACHINE = ("versions", "machine")


def read_json(path: Path) -> dict[str, Any]:
    """The record that `write_json` wrote; an empty one without a file."""
    record = json.loads(path.read_text()) if path.exists() else {}
    return _unpacked(record, record.pop("machines", []))


def write_json(path: Path, record: dict[str, Any]) -> None:
    """Write the record as a small file: every machine once, rows with the same columns as tables, and three digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    machines: list[dict] = []
    packed = _packed(_finite(record), machines)
    path.write_text(_lines(({"machines": machines} if machines else {}) | packed) + "\n")


def _packed(value: Any, machines: list[dict]) -> Any:
    """Replace versions and machine by their place `on` in `machines`, alike rows by their `columns` and `values`."""
    if isinstance(value, list):
        value = [_packed(item, machines) for item in value]
        return {"columns": list(value[0]), "values": [list(row.values()) for row in value]} if _alike(value) else value
    if not isinstance(value, dict):
        return value
    value = {key: _packed(item, machines) for key, item in value.items()}
    if circumstances := value.get("circumstances"):
        machine = {key: circumstances.pop(key) for key in MACHINE}
        if machine not in machines:
            machines.append(machine)
        circumstances["on"] = machines.index(machine)
    return value


def _alike(rows: list) -> bool:
    """True of two rows or more of numbers and words, with the same columns in the same order."""
    if len(rows) < 2 or not all(isinstance(row, dict) and list(row) == list(rows[0]) for row in rows):
        return False
    return not any(isinstance(item, dict | list) for row in rows for item in row.values())


def _unpacked(value: Any, machines: list[dict]) -> Any:
    """Put versions and machine back where `on` names them, and make rows of `columns` and `values`."""
    if isinstance(value, list):
        return [_unpacked(item, machines) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"columns", "values"}:
        return [dict(zip(value["columns"], row, strict=True)) for row in value["values"]]
    if "on" in value:
        return {key: item for key, item in value.items() if key != "on"} | machines[value["on"]]
    return {key: _unpacked(item, machines) for key, item in value.items()}


def _lines(value: Any) -> str:
    """JSON in which a list or an object of numbers and words stands on one line."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not any(isinstance(part, dict | list) for part in parts):
        return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    if isinstance(value, list):
        return "[\n" + ",\n".join(map(_lines, value)) + "\n]"
    items = (f"{json.dumps(key, ensure_ascii=False)}:{_lines(item)}" for key, item in value.items())
    return "{\n" + ",\n".join(items) + "\n}"


def _finite(value: Any) -> Any:
    """JSON knows neither NaN nor infinity, nor NumPy's numbers: None, and Python's, to three digits."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
