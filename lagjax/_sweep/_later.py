"""A later end: a sweep whose motions begin where those of another store were left.

What is kept of a motion does not tell how it goes on; its last state does, where `keep` returns `trajectory.end` by
some name. The new store has the same members, and output times that begin at the last one of the other.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._results import SUCCESSFUL
from lagjax._sweep._batch import names_of
from lagjax._sweep._job import in_doubles, require_versions
from lagjax._sweep._members import Axis, in_words
from lagjax._sweep._scene import MOTION, Left, Motions, difference, texts
from lagjax._sweep._store import RESULT, Store
from lagjax._trajectory import State


def goes_on(other: Store, motions: Motions) -> bool:
    """True if the output times of these motions begin at the last one of a store."""
    return float(motions.ts[0]) == other.spec()["ts"]["ends"][1]


def left_in(other: Store, axes: tuple[Axis, ...], motions: Motions) -> Left:
    """The ends of the motions. Raises `ValueError` for other ones, and where not all ends are there."""
    spec = other.spec()
    require_versions(other, spec)
    now = json.loads(json.dumps([axis.described() for axis in axes]))
    lines = [f"axes: {in_words(spec['axes'])} in the store, now {in_words(now)}"] if now != spec["axes"] else []
    if spec["x64"] != in_doubles():
        lines.append(f"x64: {spec['x64']} in the store, now {in_doubles()}")
    names = [name for axis in axes for name in axis.names]
    scenes = ({role: x for role, x in of.items() if role in MOTION} for of in (spec["scene"], texts(motions, names)))
    if change := difference(*scenes):
        lines.append(change)
    if lines:
        raise ValueError(
            f"{other.path} has motions of another description, which cannot go on. What differs:\n" + "\n".join(lines)
        )
    if left := other.grid(spec).units - len(other.done()):
        raise ValueError(f"{other.path}: {left} units are not done; motions can go on when they are.")
    q, qdot, _ = motions.shapes(names)
    shapes = {x.name: x.shape for x in other.quantities(spec)}
    for prefix in (name.removesuffix(".t") for name in shapes if name.endswith(".t")):
        end = names_of({prefix: State(jnp.zeros(()), q, qdot)})[prefix]
        wanted = zip(jax.tree.leaves((end.q, end.qdot)), jax.tree.leaves((q, qdot)), strict=True)
        if all(shapes.get(name) == jnp.shape(x) for name, x in wanted):
            return Left(str(other.path), end.q, end.qdot)
    raise ValueError(
        f"{other.path} does not have the states in which its motions ended, from which they could go on: let keep "
        "return them, as in {'end': trajectory.end, …}."
    )


def states(left: Left, box: tuple[slice, ...]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Of the members of a box, (m, …) by name, the states to go on from, and how they ended (m,).

    The states of members that came to no end, or to one of their own by an event, are NaN: they do not go on.
    """
    store = Store(Path(left.path))

    def read(name: str) -> np.ndarray:
        values = np.asarray(store.array(name)[box])
        return values.reshape(-1, *values.shape[len(box) :])

    result = read(RESULT.name)
    found = {name: read(name) for name in jax.tree.leaves((left.q, left.qdot))}
    for values in found.values():
        values[result != SUCCESSFUL] = np.nan
    return found, result
