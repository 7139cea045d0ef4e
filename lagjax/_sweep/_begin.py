"""`create_store` creates a store; `check_store` checks the description of an existing one."""

import math
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lagjax._interface import RESULTS, Layout, code_of
from lagjax._run.hybrid import Hybrid
from lagjax._sweep import _batch
from lagjax._sweep._batch import Batches, KeptResults, result_name
from lagjax._sweep._description import Description, compared_entries, differences, pack_description, users_path
from lagjax._sweep._extend import LaterEnd, continues_store, copy_members, later_end_of, require_extensible, start_names
from lagjax._sweep._files import FORMAT, NOT_DONE, RESULT, Files, Quantity, is_file_name
from lagjax._sweep._job import cpu_kind, package_versions, require_versions
from lagjax._sweep._members import RESERVED, Axis, Grid, points_of
from lagjax.designs import Design

SECONDS = 20.0  # of a unit, by default: what a worker that dies loses
UNIT_BYTES = 64 * 2**20  # of what is kept of a unit, by default
_PROBED = 4096  # members by which the time of a member is estimated


class _Preview(NamedTuple):
    """The kept values of a few members, the seconds that one takes, and whether the energy is conserved."""

    kept: KeptResults
    seconds: float
    conserves: bool


def _preview_members(description: Description, points: dict[str, np.ndarray], compiled: list[Batches]) -> _Preview:
    """Simulate members at some of these points, as many as fit into memory; append their `Batches` to `compiled`."""
    conserves = False  # resets may do work
    if not isinstance(description.system, Hybrid):
        q, qdot, params = description.evaluate_start({name: x[0] for name, x in points.items()})
        conserves = bool(description.system.explain(q, qdot, params=params).energy_conserved)
    batches = Batches(description, conserves)
    points = _thin_points(points, UNIT_BYTES // max(1, batches.count_member_bytes(points)))
    batches(points)  # which compiles
    began = time.perf_counter()
    kept = batches(points)
    compiled.append(batches)
    return _Preview(kept, (time.perf_counter() - began) / len(kept.result), conserves)


def _thin_points(points: dict[str, np.ndarray], most: int) -> dict[str, np.ndarray]:
    """Return at most `most` evenly spaced ones of these points, at least one."""
    return {name: x[:: -(-len(x) // max(1, most))] for name, x in points.items()}


def create_store(
    store: Files,
    axes: tuple[Axis, ...],
    description: Description,
    unit: int | None,
    compiled: list[Batches],
    other: Files | None,
) -> None:
    """Create the store after a preview of a few members, and copy members from another store.

    The programs that the preview compiled are appended to `compiled`.
    """
    names, shape = [name for axis in axes for name in axis.names], tuple(axis.size for axis in axes)
    later = None if other is None else later_end_of(other, axes, description)
    if later is not None:
        description = replace(description, starts=later.starts)
    scene, points = pack_description(description), _sample_points(axes, later)
    points = _thin_points(points, _members_in_memory(description, points))
    kept, seconds, conserves = _preview_members(description, points, compiled)
    quantities = [Quantity(name, x.shape[1:], x.dtype) for name, x in kept.values.items()]
    _require_names(quantities, axes, description.reduce)
    most = _batch.MOST_MEMBERS if kept.engine == "MachineCode" else _batch.MOST_ON_DEVICES
    spec = {
        "format": FORMAT, "versions": package_versions(), "cpu": cpu_kind(), "engine": kept.engine, "shape": shape,
        "chunk": Grid.from_shape(shape, _choose_unit_size(unit, shape, seconds, quantities)).chunk,
        "batch": max(1, min(most, _members_in_memory(description, points))), "seconds_per_member": seconds,
        "kept": [{"name": q.name, "shape": q.shape, "dtype": q.dtype.str} for q in quantities], "conserves": conserves,
        "continues": later and later.store.identity(), "end": later and later.end, "path": users_path(),
        **compared_entries(axes, description),
    }  # fmt: skip
    if other is not None and later is None:
        require_extensible(other, spec)
    codes = sorted({code_of(item) for item in RESULTS._name_to_item.values()} | set(_batch.NAMES))
    codes = {NOT_DONE: "not_done"} | {code: result_name(code) for code in codes}
    with store.create_aside() as new:
        new.create(spec, scene, axes, f"lagjax sweep over {', '.join(names)}", codes)
        if later is not None:
            later.copy_starts(new)
        elif other is not None:
            copy_members(other, new)


def _sample_points(axes: tuple[Axis, ...], later: LaterEnd | None) -> dict[str, np.ndarray]:
    """Return points of some thousand members: spread over the grid; the first ones of designs and continued motions."""
    sides, shape = [], []
    for axis in axes:
        _, values = next(axis.pieces())
        count = min(axis.size, max(2, round(_PROBED ** (1 / len(axes)))), len(values))
        count = count if math.prod(shape) * count <= _PROBED else 1  # of a dozen axes and more
        first = isinstance(axis.source, Design) or later is not None
        which = np.arange(count) if first else np.linspace(0, len(values) - 1, count).astype(int)
        sides.append({name: values[which, c] for c, name in enumerate(axis.names)})
        shape.append(count)
    points = points_of(sides, tuple(shape), np.arange(math.prod(shape)))
    return points if later is None else points | later.read(tuple(map(slice, shape)))[0]


def _choose_unit_size(unit: int | None, shape: tuple[int, ...], seconds: float, quantities: list[Quantity]) -> int:
    """Return the members per unit: `unit`, or as many as take `SECONDS` and fit into `UNIT_BYTES`."""
    if unit is not None:
        if isinstance(unit, bool) or not isinstance(unit, int | np.integer) or unit < 1:
            raise ValueError(f"unit must be a positive whole number of members; got {unit!r}.")
        return int(unit)
    each = sum(q.dtype.itemsize * math.prod(q.shape) for q in [*quantities, RESULT])
    several = max(_PROBED, math.prod(shape) // 16)  # some units even of a short sweep
    return max(1, min(int(SECONDS / seconds), UNIT_BYTES // each, several))


def _members_in_memory(description: Description, points: dict[str, np.ndarray]) -> int:
    """Return how many members' paths and crossings fit into `PATH_BYTES`; 0 if one takes more."""
    first = {name: x[0] for name, x in points.items()}
    q, qdot, _ = description.evaluate_start(first)
    states, sections = 2 * Layout.from_state(q, qdot).size, description.sections
    noted = len(sections.functions) * (sections.count + 1) * (states + 1) if sections else 0
    return _batch.PATH_BYTES // (8 * (states * description.count_outputs(first) + noted))


def _require_names(quantities: list[Quantity], axes: tuple[Axis, ...], reduce: dict) -> None:
    names = [q.name for q in quantities]
    taken = {*RESERVED, *(a.dimension for a in axes), *(n for a in axes for n in a.names)}
    inner = {dimension: q.name for q in quantities for dimension in q.dimensions}
    for name in names:
        if name in taken:
            raise ValueError(f"keep returns {name!r}, which is a name in over, or `result`: give it another name.")
        if not is_file_name(name) or name == "zarr.json":
            must_not = "be empty, begin with a dot, contain a slash, or be zarr.json"
            raise ValueError(f"keep returns {name!r}: names must not {must_not}.")
    for name in inner:
        if name in names or name in taken:
            raise ValueError(
                f"keep returns {inner[name]!r}, an array, of which the store calls an axis {name!r}; something else "
                "has this name already: rename one of them."
            )
    if missing := [name for name in reduce if name not in names]:
        raise ValueError(f"reduce names {missing}, which keep does not return; it returns {names}.")
    if mixed := [q.name for q in quantities if q.name in reduce and q.dtype.kind == "c"]:
        raise ValueError(f"reduce names {mixed}, which are complex: let keep return real and imaginary parts.")


# ---- a store that is there -------------------------------------------------------------------------------------------


def check_store(
    store: Files, spec: dict, axes: tuple[Axis, ...], description: Description, other: Files | None
) -> Description:
    """Return the description with the names of the store's starts; raise `ValueError` naming what differs."""
    require_versions(store, spec)
    here = compared_entries(axes, description) | {"continues": None}
    if other is not None and not other.exists():  # all that is needed of it was copied
        here["continues"] = spec["continues"]
    elif other is not None and continues_store(other, description):
        here["continues"] = other.identity()
    if lines := differences(spec, here, here):
        raise ValueError(
            f"{store.path} was begun with another description, and is left as it is. Take another store, or the "
            "description of this one. What differs:\n" + "\n".join(lines)
        )
    if spec["end"] is None:
        return description
    names = [name for axis in axes for name in axis.names]
    return replace(description, starts=start_names(description, names, spec["end"]))
