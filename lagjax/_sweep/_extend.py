"""A store that begins with the members of another one: more of them, a finer grid.

A member is known where all of its coordinates, bit for bit, are those of a member of the other store that is done. In a
unit of the new store the known members are those of a product of places along each axis. Units of which all are known
are written at once; of the others the known members stand aside, until their unit is computed.
"""

import json
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np

from lagjax._results import ENDED_WELL
from lagjax._sweep._batch import label
from lagjax._sweep._designs import GROWING
from lagjax._sweep._job import require_versions
from lagjax._sweep._members import Grid
from lagjax._sweep._scene import difference
from lagjax._sweep._store import KNOWN, RESULT, Store, arrays_as_bytes

_SAME = ("x64", "engine", "ts", "rtol", "atol", "max_steps", "solver", "crossings", "kept", "reduce")


def require_extensible(old: Store, spec: dict, now: dict) -> None:
    """Raise `ValueError`, with the difference, where the members of `old` are not those of the new store."""
    require_versions(old, spec)
    now = json.loads(json.dumps(now))
    lines = [f"{name}: {spec.get(name)} in the store, now {now[name]}" for name in _SAME if spec.get(name) != now[name]]
    names = [[axis["names"] for axis in x["axes"]] for x in (spec, now)]
    if names[0] != names[1]:
        lines.append(f"names of over: {names[0]} in the store, now {names[1]}")
    if change := difference(spec["scene"], now["scene"]):
        lines.append(change)
    if spec["reduce"]:
        lines.append("reduce: statistics do not tell of single members, so that none of them is known")
    if lines:
        later = ""
        if spec["ts"] != now["ts"]:
            later = (
                "\nWhat is kept of a motion does not tell how it goes on. For a later end give ts that begin at "
                f"{spec['ts']['ends'][1]:g}, where the motions of that store end; else leave extend= away."
            )
        raise ValueError(f"{old.path} has members of another description. What differs:\n" + "\n".join(lines) + later)


def carry(old: Store, new: Store) -> int:
    """Take what is known from `old` into `new`, of which nothing is done yet; how many members that is."""
    before, spec, total = old.spec(), new.spec(), 0
    (new.job / KNOWN).mkdir(exist_ok=True)
    grid, places = new.grid(spec), list(map(partial(_places, old, new), before["axes"], spec["axes"]))
    if not all(place.common for place in places):
        warnings.warn(
            f"{old.path} has no member that is also in `over`, so that all are computed: compare the values of its "
            "axes, and the seeds and bounds of its designs. A latin hypercube cannot be extended.",
            stacklevel=4,
        )
        return 0
    for unit in range(grid.units):
        box = [place(part) for place, part in zip(places, grid.box(unit), strict=True)]
        inside = [np.flatnonzero(x >= 0) for x in box]
        if not all(len(x) for x in inside):
            continue
        found = _read(old, before, [x[i] for x, i in zip(box, inside, strict=True)])
        which = np.ravel_multi_index(np.ix_(*inside), grid.box_shape(unit)).ravel()
        done = found[RESULT.name] >= 0
        which, found = which[done], {name: x[done] for name, x in found.items()}
        total += len(which)
        if len(which) == grid.size(unit):
            new.coordinates(spec["axes"], grid.box(unit))  # which nobody else would write
            new.write_unit(spec, unit, found, _record(grid, unit, found[RESULT.name], spec), b"")
        elif len(which):
            data = arrays_as_bytes({"which": which, **{f"of {name}": x for name, x in found.items()}})
            new.write(new.job / KNOWN / f"{unit}.npz", data, f"{unit}-known")
    return total


class _Places(NamedTuple):
    """For places along an axis of the new store those in the old one with the same values; −1 where there is none.

    `known` (size,) lists them; None where both have one rule, by which the first `common` ones are the same.
    """

    common: int
    known: np.ndarray | None

    def __call__(self, part: slice) -> np.ndarray:
        if self.known is not None:
            return self.known[part]
        numbers = np.arange(part.start, part.stop)
        return np.where(numbers < self.common, numbers, -1)


def _places(old: Store, new: Store, of_old: dict, of_new: dict) -> _Places:
    rules = [{name: x for name, x in axis.items() if name != "size"} for axis in (of_old, of_new)]
    if rules[0] == rules[1] and of_old["rule"] in GROWING:
        return _Places(min(of_old["size"], of_new["size"]), None)
    sides = [s.coordinates([axis], (slice(0, axis["size"]),))[0] for s, axis in ((old, of_old), (new, of_new))]
    before, now = (np.stack([side[name] for name in of_new["names"]], axis=1) for side in sides)
    known = {row.tobytes(): k for k, row in enumerate(before)}
    found = np.array([known.get(row.tobytes(), -1) for row in now])
    return _Places(int(np.sum(found >= 0)), found)


def _read(old: Store, spec: dict, places: list[np.ndarray]) -> dict[str, np.ndarray]:
    """The stored values of a product of members, (members, …) by name."""
    runs = [slice(int(x[0]), int(x[-1]) + 1) if np.all(np.diff(x) == 1) else x for x in places]  # read as they lie
    found = {}
    for q in old.quantities(spec):
        values = np.asarray(old.array(q.name).oindex[(*runs, *(slice(None) for _ in q.shape))])
        found[q.name] = values.reshape(-1, *q.shape)
    return found


def _record(grid: Grid, unit: int, result: np.ndarray, spec: dict) -> dict:
    codes, counts = np.unique(result, return_counts=True)
    failed = np.flatnonzero(~np.isin(result, ENDED_WELL))[:100]
    numbers = grid.numbers(unit, failed)
    return {
        "unit": unit, "members": len(result), "engine": spec["engine"], "slow": {}, "seconds": 0.0, "cpu_seconds": 0.0,
        "results": {label(int(code)): int(count) for code, count in zip(codes, counts, strict=True)},
        "failed": [[int(k), label(int(result[j])), ""] for j, k in zip(failed, numbers, strict=True)],
    }  # fmt: skip
