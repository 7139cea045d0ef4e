"""Stores that are begun: new ones, those with members of another store, those that continue its motions.

Of a store that is there already, `require_same` checks the description.

**Members of another store** (`extend`): a member is known where all of its coordinates, bit for bit, are those of a
member of the other store that is done. In a unit of the new store the known members are those of a product of places
along each axis. Units of which all are known are written at once; of the others the known members stand aside, until
their unit is computed.

**A later end**: the kept values do not determine how a motion continues; its last state does, where `keep` returns
`trajectory.end` by some name. The new store has the same members, and output times that begin at the last one of the
other.
"""

import json
import math
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._interface import RESULTS, Layout, code_of
from lagjax._run import State
from lagjax._run.hybrid import Hybrid
from lagjax._sweep import _batch
from lagjax._sweep._batch import KeptResults, batches_of, label, names_of, quantities_of
from lagjax._sweep._description import MOTION, Description, FinalStates, difference, pack_description, texts, users_path
from lagjax._sweep._job import cpu, record_of, require_versions, source_path, states, uses_doubles, versions
from lagjax._sweep._members import RESERVED, Axis, Grid, describe_axes, points_of
from lagjax._sweep._store import FORMAT, KNOWN, NOT_DONE, RESULT, Quantity, Store, arrays_as_bytes, is_file_name
from lagjax.designs import GROWING, Design

SECONDS = 20.0  # of a unit, by default: what a worker that dies loses
UNIT_BYTES = 64 * 2**20  # of what is kept of a unit, by default; two of them are in memory, one being written
_PROBED = 4096  # members by which the time of a member is estimated


def first_look(description: Description, points: dict[str, np.ndarray]) -> tuple[KeptResults, float, bool]:
    """The kept values of a few members, the seconds that one of them takes, and whether the energy is constant."""
    conserves = _conserves(description, points)
    batches = batches_of(description, conserves)
    points = _thin_points(points, UNIT_BYTES // max(1, batches.count_member_bytes(points)))
    batches(points)  # which compiles
    began = time.perf_counter()
    kept = batches(points)
    return kept, (time.perf_counter() - began) / len(kept.result), conserves


def _thin_points(points: dict[str, np.ndarray], most: int) -> dict[str, np.ndarray]:
    """Evenly chosen ones of these points: `most` at most, one at least."""
    count = len(next(iter(points.values())))
    return {name: x[:: -(-count // max(1, most))] for name, x in points.items()}


Look = Callable[[Description, dict[str, np.ndarray]], tuple[KeptResults, float, bool]]


def begin(
    store: Store,
    axes: tuple[Axis, ...],
    description: Description,
    unit: int | None,
    look: Look = first_look,
    extend: Store | None = None,
) -> None:
    """Make the store, after a look at what a few members take and keep, with the members that `extend` knows."""
    scene = pack_description(description)
    points, shape = _sample_points(axes, description), tuple(axis.size for axis in axes)
    points = _thin_points(points, _members_in_memory(description, points))
    kept, seconds, conserves = look(description, points)
    quantities = quantities_of(kept)
    _require_names(quantities, axes, description.reduce)
    members = _unit_size(unit, shape, seconds, quantities)
    names = [name for axis in axes for name in axis.names]
    spec = {
        "format": FORMAT, "versions": versions(), "cpu": cpu(), "x64": uses_doubles(), "engine": kept.engine,
        "axes": [axis.described() for axis in axes], "shape": shape, "chunk": Grid.from_shape(shape, members).chunk,
        "batch": _batch_size(description, points, kept), "seconds_per_member": seconds, "conserves": conserves,
        "kept": [{"name": q.name, "shape": q.shape, "dtype": q.dtype.str} for q in quantities],
        **description.described(),
        "continues": source_path(description, store), "scene": texts(description, names), "path": users_path(),
    }  # fmt: skip
    codes = sorted({code_of(item) for item in RESULTS._name_to_item.values()} | set(_batch.NAMES))
    title = f"lagjax sweep over {', '.join(names)}"
    extend = None if description.left else extend  # of which no member is taken as it is
    if extend is not None:
        require_extensible(extend, extend.spec(), spec)
    with store.create_aside() as new:
        new.create(spec, scene, axes, title, {NOT_DONE: "not_done"} | {code: label(code) for code in codes})
        if extend is not None:
            copy_members(extend, new)


def _sample_points(axes: tuple[Axis, ...], description: Description) -> dict[str, np.ndarray]:
    """Points of some thousand members: evenly spread over the grid; the first ones of designs and continued motions."""
    sides, shape = [], []
    for axis in axes:
        _, values = next(axis.pieces())
        count = min(axis.size, max(2, round(_PROBED ** (1 / len(axes)))), len(values))
        count = count if math.prod(shape) * count <= _PROBED else 1  # of a dozen axes and more
        first = isinstance(axis.source, Design) or description.left is not None
        which = np.arange(count) if first else np.linspace(0, len(values) - 1, count).astype(int)
        sides.append({name: values[which, c] for c, name in enumerate(axis.names)})
        shape.append(count)
    points = points_of(sides, tuple(shape), np.arange(int(np.prod(shape))))
    return points | (states(description.left, tuple(map(slice, shape)))[0] if description.left else {})


def _conserves(description: Description, points: dict[str, np.ndarray]) -> bool:
    """True if the energy of this scene is known to be constant."""
    if isinstance(description.system, Hybrid):
        return False  # resets may do work
    q, qdot, params = description.start({name: x[0] for name, x in points.items()})
    return bool(description.system.explain(q, qdot, params=params).energy_conserved)


def _unit_size(unit: int | None, shape: tuple[int, ...], seconds: float, quantities: list[Quantity]) -> int:
    """The members of a unit: the number given, or as many as take `SECONDS` and fit into `UNIT_BYTES`."""
    if unit is not None:
        if isinstance(unit, bool) or not isinstance(unit, int | np.integer) or unit < 1:
            raise ValueError(f"unit must be a positive whole number of members; got {unit!r}.")
        return int(unit)
    total = int(np.prod(shape, dtype=np.int64))
    each = sum(q.dtype.itemsize * int(np.prod(q.shape)) for q in [*quantities, RESULT])
    several = max(_PROBED, total // 16)  # some units even of a short sweep
    return max(1, min(int(SECONDS / seconds), UNIT_BYTES // each, several))


def _batch_size(description: Description, points: dict[str, np.ndarray], kept: KeptResults) -> int:
    """The most members of a batch: their paths take at most `PATH_BYTES`."""
    most = _batch.MOST if kept.engine == "MachineCode" else _batch.MOST_ON_DEVICES
    return max(1, min(most, _members_in_memory(description, points)))


def _members_in_memory(description: Description, points: dict[str, np.ndarray]) -> int:
    """The members whose paths, and what is noted on the way, take `PATH_BYTES`; none where one takes more."""
    q, qdot, _ = description.start({name: x[0] for name, x in points.items()})
    states = 2 * Layout.from_state(q, qdot).size
    noted = description.sections.count_bytes(states) if description.sections else 0
    return _batch.PATH_BYTES // (8 * states * len(description.ts) + noted)


def _require_names(quantities: list[Quantity], axes: tuple[Axis, ...], reduce: dict) -> None:
    """Raise `ValueError` where what `keep` returns cannot stand in a store under its name, or not be reduced."""
    names = [q.name for q in quantities]
    taken = {*RESERVED, *(a.dimension for a in axes), *(n for a in axes for n in a.names)}
    inner = {dimension: q.name for q in quantities for dimension in q.dimensions}
    for q in quantities:
        if q.name in taken:
            raise ValueError(f"keep returns {q.name!r}, which is a name in over, or `result`: give it another name.")
        if not is_file_name(q.name) or q.name == "zarr.json":
            raise ValueError(
                f"keep returns {q.name!r}: names must not be empty, begin with a dot, contain a slash, or be zarr.json."
            )
    for name in [*names, *taken]:
        if name in inner:
            raise ValueError(
                f"keep returns {inner[name]!r}, an array, of which the store calls an axis {name!r}; something else "
                "has this name already: rename one of them."
            )
    if missing := [name for name in reduce if name not in names]:
        raise ValueError(f"reduce names {missing}, which keep does not return; it returns {names}.")
    if mixed := [q.name for q in quantities if q.name in reduce and q.dtype.kind == "c"]:
        raise ValueError(f"reduce names {mixed}, which are complex: let keep return real and imaginary parts.")


# ---- a store that is there -------------------------------------------------------------------------------------------


def require_same(store: Store, spec: dict, axes: tuple[Axis, ...], description: Description) -> None:
    """Raise `ValueError`, with the difference, where the store was begun with another description."""
    require_versions(store, spec)
    names = [name for axis in axes for name in axis.names]
    now = {"axes": [axis.described() for axis in axes], "x64": uses_doubles(), **description.described()}
    now["continues"] = source_path(description, store)
    now = json.loads(json.dumps(now))
    words = {"axes": describe_axes}
    lines = [
        f"{name}: {words.get(name, str)(spec[name])} in the store, now {words.get(name, str)(x)}"
        for name, x in now.items()
        if spec[name] != x
    ]
    if change := difference(spec["scene"], texts(description, names)):
        lines.append(change)
    if lines:
        raise ValueError(
            f"{store.path} was begun with another description, and is left as it is. Take another store, or the "
            "description of this one. What differs:\n" + "\n".join(lines)
        )


# ---- a store that begins with members of another one -----------------------------------------------------------------

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
                "\nThe kept values do not determine how a motion continues. For a later end give ts that begin at "
                f"{spec['ts']['ends'][1]:g}, where the motions of that store end; else leave extend= away."
            )
        raise ValueError(f"{old.path} has members of another description. What differs:\n" + "\n".join(lines) + later)


def copy_members(old: Store, new: Store) -> int:
    """Copy the members that `old` has into `new`, of which nothing is done yet; return their number."""
    before, spec, total = old.spec(), new.spec(), 0
    (new.job / KNOWN).mkdir(exist_ok=True)
    grid, places = new.grid(spec), list(map(partial(_matching_places, old, new), before["axes"], spec["axes"]))
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
        found = _read_members(old, before, [x[i] for x, i in zip(box, inside, strict=True)])
        which = np.ravel_multi_index(np.ix_(*inside), grid.box_shape(unit)).ravel()
        done = found[RESULT.name] >= 0
        which, found = which[done], {name: x[done] for name, x in found.items()}
        total += len(which)
        if len(which) == grid.size(unit):
            new.coordinates(spec["axes"], grid.box(unit))  # which no worker of this unit would write
            record = record_of(grid, unit, found[RESULT.name], spec["engine"]) | {"seconds": 0.0, "cpu_seconds": 0.0}
            new.write_unit(spec, unit, found, record, b"")
        elif len(which):
            data = arrays_as_bytes({"which": which, **{f"of {name}": x for name, x in found.items()}})
            new.write(new.job / KNOWN / f"{unit}.npz", data, f"{unit}-known")
    return total


class _MatchingPlaces(NamedTuple):
    """The places in the old store with the values of those along an axis of the new one; −1 where there is none.

    `known` (size,) lists them; None where both have one rule, by which the first `common` ones are the same.
    """

    common: int
    known: np.ndarray | None

    def __call__(self, part: slice) -> np.ndarray:
        if self.known is not None:
            return self.known[part]
        numbers = np.arange(part.start, part.stop)
        return np.where(numbers < self.common, numbers, -1)


def _matching_places(old: Store, new: Store, of_old: dict, of_new: dict) -> _MatchingPlaces:
    rules = [{name: x for name, x in axis.items() if name != "size"} for axis in (of_old, of_new)]
    if rules[0] == rules[1] and of_old["rule"] in GROWING:
        return _MatchingPlaces(min(of_old["size"], of_new["size"]), None)
    sides = [s.coordinates([axis], (slice(0, axis["size"]),))[0] for s, axis in ((old, of_old), (new, of_new))]
    before, now = (np.stack([side[name] for name in of_new["names"]], axis=1) for side in sides)
    known = {row.tobytes(): k for k, row in enumerate(before)}
    found = np.array([known.get(row.tobytes(), -1) for row in now])
    return _MatchingPlaces(int(np.sum(found >= 0)), found)


def _read_members(old: Store, spec: dict, places: list[np.ndarray]) -> dict[str, np.ndarray]:
    """The stored values of a product of members, (members, …) by name."""
    runs = [slice(int(x[0]), int(x[-1]) + 1) if np.all(np.diff(x) == 1) else x for x in places]  # read as they lie
    found = {}
    for q in old.quantities(spec):
        values = np.asarray(old.array(q.name).oindex[(*runs, *(slice(None) for _ in q.shape))])
        found[q.name] = values.reshape(-1, *q.shape)
    return found


# ---- a later end -----------------------------------------------------------------------------------------------------


def continues(other: Store, description: Description) -> bool:
    """True if the output times of these motions begin at the last one of a store."""
    return float(description.ts[0]) == other.spec()["ts"]["ends"][1]


def final_states_of(other: Store, axes: tuple[Axis, ...], description: Description) -> FinalStates:
    """The ends of the motions. Raises `ValueError` for other ones, and where not all ends are there."""
    spec = other.spec()
    require_versions(other, spec)
    now = json.loads(json.dumps([axis.described() for axis in axes]))
    lines = (
        [f"axes: {describe_axes(spec['axes'])} in the store, now {describe_axes(now)}"] if now != spec["axes"] else []
    )
    if spec["x64"] != uses_doubles():
        lines.append(f"x64: {spec['x64']} in the store, now {uses_doubles()}")
    names = [name for axis in axes for name in axis.names]
    scenes = (
        {role: x for role, x in of.items() if role in MOTION} for of in (spec["scene"], texts(description, names))
    )
    if change := difference(*scenes):
        lines.append(change)
    if lines:
        raise ValueError(
            f"{other.path} has motions of another description, which cannot continue. What differs:\n"
            + "\n".join(lines)
        )
    if left := other.grid(spec).units - len(other.finished_units()):
        raise ValueError(f"{other.path}: {left} units are not done; motions can continue when they are.")
    q, qdot, _ = description.shapes(names)
    shapes = {x.name: x.shape for x in other.quantities(spec)}
    for prefix in (name.removesuffix(".t") for name in shapes if name.endswith(".t")):
        end = names_of({prefix: State(jnp.zeros(()), q, qdot)})[prefix]
        wanted = zip(jax.tree.leaves((end.q, end.qdot)), jax.tree.leaves((q, qdot)), strict=True)
        if all(shapes.get(name) == jnp.shape(x) for name, x in wanted):
            return FinalStates(str(other.path), end.q, end.qdot)
    raise ValueError(
        f"{other.path} does not have the states in which its motions ended, from which they could continue: let keep "
        "return them, as in {'end': trajectory.end, …}."
    )
