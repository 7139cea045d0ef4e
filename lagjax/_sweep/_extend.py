"""Copies from another store: members, or last states as the starts of motions that continue.

**Members**: a member is copied if all of its coordinates, bit for bit, are those of a member of the other store that is
done. In a unit of the new store these members are those of a product of places along each axis.

**A later end**: the kept values do not determine how a motion continues; its last state does, where `keep` returns
`trajectory.end` by some name. The new store has the same members, and output times that begin at the last one of the
other. Their last states are copied as starts; members that ended before are copied with their `result`.

After that the other store is not read any more.
"""

import json
import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._interface import SUCCESSFUL
from lagjax._run import State
from lagjax._run.hybrid import Hybrid
from lagjax._sweep._batch import leaf_names
from lagjax._sweep._description import MOTION, Description, FinalStates, compared_entries, differences
from lagjax._sweep._files import RESULT, Copied, Files
from lagjax._sweep._job import require_versions
from lagjax._sweep._members import Axis
from lagjax.designs import GROWING

_EXTENSIBLE = ("x64", "engine", "ts", "rtol", "atol", "max_steps", "solver", "crossings", "kept", "reduce", "scene")


def require_extensible(old: Files, now: dict) -> None:
    spec, now = old.spec(), json.loads(json.dumps(now))
    _require_whole(old, spec)
    lines = differences(spec, now, _EXTENSIBLE)
    names = [[axis["names"] for axis in x["axes"]] for x in (spec, now)]
    if names[0] != names[1]:
        lines.append(f"names of over: {names[0]} in the store, now {names[1]}")
    if spec["reduce"]:
        lines.append("reduce: statistics do not tell of single members, so that none of them is known")
    if lines and spec["ts"] and spec["ts"] != now["ts"]:
        lines.append(
            "The kept values do not determine how a motion continues. For a later end give ts that begin at "
            f"{spec['ts']['ends'][1]:g}, where the motions of that store end; else leave extend= away."
        )
    if lines:
        raise ValueError("\n".join([f"{old.path} has members of another description. What differs:", *lines]))


def _require_whole(other: Files, spec: dict) -> None:
    require_versions(other, spec)
    if damaged := other.find_damage(spec, other.finished_units()):
        raise ValueError(f"{other.path}: {next(iter(damaged.values()))}. Run that sweep again: it computes it again.")


def copy_members(old: Files, new: Files) -> None:
    before, spec = old.spec(), new.spec()
    matches = map(partial(_match_places, old, new), before["axes"], spec["axes"])
    grid, places = new.grid(spec), [places_in for places_in in matches if places_in is not None]
    if len(places) < len(spec["axes"]):
        warnings.warn(
            f"{old.path} has no member that is also in `over`, so that all are computed: compare the values of its "
            "axes, and the seeds and bounds of its designs. A latin hypercube cannot be extended.",
            stacklevel=4,
        )
        return
    for unit in range(grid.unit_count):
        box = [places_in(part) for places_in, part in zip(places, grid.box(unit), strict=True)]
        inside = [np.flatnonzero(x >= 0) for x in box]
        if not all(len(x) for x in inside):
            continue
        values = _read_members(old, before, [x[i] for x, i in zip(box, inside, strict=True)])
        finished = values[RESULT.name] >= 0
        members = np.ravel_multi_index(np.ix_(*inside), grid.box_shape(unit)).ravel()[finished]
        values = {name: x[finished] for name, x in values.items()}
        if len(members):
            new.write_copied(unit, Copied(members, values, {}))


def _match_places(old: Files, new: Files, old_axis: dict, new_axis: dict) -> Callable[[slice], np.ndarray] | None:
    """Return a function from part of a new axis to the indices in the old store with equal values; −1 for none.

    It is None if no value is in common. Values are read unless both axes have the same rule.
    """
    if old_axis | {"size": 0} == new_axis | {"size": 0} and old_axis["rule"] in GROWING:
        size = old_axis["size"]
        return lambda part: np.where((places := np.arange(part.start, part.stop)) < size, places, -1)
    sides = [store.coordinates([x], (slice(None),))[0] for store, x in ((old, old_axis), (new, new_axis))]
    before, now = (np.stack([side[name] for name in new_axis["names"]], axis=1) for side in sides)
    place_of = {row.tobytes(): k for k, row in enumerate(before)}
    places = np.array([place_of.get(row.tobytes(), -1) for row in now])
    return places.__getitem__ if np.any(places >= 0) else None


def _read_members(old: Files, spec: dict, places: list[np.ndarray]) -> dict[str, np.ndarray]:
    runs = [slice(int(x[0]), int(x[-1]) + 1) if np.all(np.diff(x) == 1) else x for x in places]  # read as they lie
    read = {q: np.asarray(old.array(q.name).oindex[(*runs, *map(slice, q.shape))]) for q in old.quantities(spec)}
    return {q.name: values.reshape(-1, *q.shape) for q, values in read.items()}


# ---- a later end -----------------------------------------------------------------------------------------------------


class LaterEnd(NamedTuple):
    """The last states in another store, where motions continue: their name there, and the names of their leaves."""

    store: Files
    end: str
    starts: FinalStates

    def read(self, box: tuple[slice, ...]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the states (m, …) of a box's members by name, NaN if they do not continue; and their results (m,)."""
        names = [*jax.tree.leaves(tuple(self.starts)), RESULT.name]
        *states, result = (np.asarray(self.store.array(name)[box]) for name in names)
        states, result = [x.reshape(-1, *x.shape[len(box) :]) for x in states], result.ravel()
        for x in states:
            x[result != SUCCESSFUL] = np.nan
        return dict(zip(names[:-1], states, strict=True)), result

    def copy_starts(self, new: Files) -> None:
        """Write the states as starts of the members of a new store; members that ended keep their result."""
        grid = new.grid(new.spec())
        for unit in range(grid.unit_count):
            states, result = self.read(grid.box(unit))
            ended = np.flatnonzero(result != SUCCESSFUL)
            new.write_copied(unit, Copied(ended, {RESULT.name: result[ended]}, states))


def continues_store(other: Files, description: Description) -> bool:
    shared = other.spec()["ts"]
    return shared is not None and float(description.ts[0]) == shared["ends"][1]


def later_end_of(other: Files, axes: tuple[Axis, ...], description: Description) -> LaterEnd | None:
    """Return the last states that these motions continue, None if they do not; raise if they cannot."""
    if not continues_store(other, description):
        return None
    if isinstance(description.system, Hybrid):
        raise ValueError(
            "A hybrid motion cannot continue from a store, which does not keep its last mode: begin again at ts[0], "
            f"with another store than {str(other.path)!r}."
        )
    spec = other.spec()
    _require_whole(other, spec)
    if lines := differences(spec, compared_entries(axes, description), ("axes", "x64", "scene"), MOTION):
        said = f"{other.path} has motions of another description, which cannot continue. What differs:"
        raise ValueError("\n".join([said, *lines]))
    if missing := other.grid(spec).unit_count - len(other.finished_units()):
        raise ValueError(f"{other.path}: {missing} units are not done; motions can continue when they are.")
    names = [name for axis in spec["axes"] for name in axis["names"]]
    shapes, state = {x.name: x.shape for x in other.quantities(spec)}, description.shapes(names)[:2]
    for end in (name.removesuffix(".t") for name in shapes if name.endswith(".t")):
        starts = start_names(description, names, end)
        leaves = zip(*map(jax.tree.leaves, (tuple(starts), state)), strict=True)
        if all(shapes.get(name) == jnp.shape(x) for name, x in leaves):
            return LaterEnd(other, end, starts)
    raise ValueError(
        f"{other.path} does not have the states in which its motions ended, from which they could continue: let keep "
        "return them, as in {'end': trajectory.end, …}."
    )


def start_names(description: Description, names: list[str], end: str) -> FinalStates:
    """Return the names of the starts of continued motions, whose ends another store has by the name `end`."""
    q, qdot, _ = description.shapes(names)
    state = leaf_names({end: State(jnp.zeros(()), q, qdot)})[end]
    return FinalStates(state.q, state.qdot)
