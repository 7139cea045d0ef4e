"""A trajectory as labelled arrays (`xarray`) and as a table (`pandas`), named as in the user's pytree.

Units are given as a pytree prefix of q, as axes in `jax.vmap`: one for all coordinates, or one for each. Velocities
have those per unit of time. Units are in the `attrs` of the result, not in the names of columns.
"""

import math

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax._interface import is_known, labelled_leaves
from lagjax._run import CHANGE_WORDS, Members
from lagjax._show._summary import import_package, require_numbers


def make_dataset(trajectory, units: PyTree = None, time_unit: str | None = None):
    """Return an `xarray.Dataset` of a trajectory: see `Trajectory.to_xarray`."""
    xarray = import_package("to_xarray()", "xarray", "xarray")
    require_numbers(trajectory, "to_xarray() copies")
    members = _axis_names(np.ndim(trajectory.ok))
    of_q, of_qdot = _leaf_units(trajectory.q, units, time_unit)
    variables: dict[str, tuple] = {"ok": (members, np.asarray(trajectory.ok))}
    trees = [("q", trajectory.q, of_q), ("qdot", trajectory.qdot, of_qdot)]
    if trajectory.contacts is not None:
        forces = trajectory.contact_forces
        trees.append(("contact_forces", forces, [None] * len(jax.tree.leaves(forces))))
    for name, tree, unit in trees:
        for (path, leaf), one in zip(jax.tree_util.tree_leaves_with_path(tree), unit, strict=True):
            # A key as plain text: 'theta' for a dict's or a NamedTuple's, '0' for a list's.
            label = jax.tree_util.keystr((jax.tree_util.GetAttrKey(name), *path), simple=True, separator=".")
            inner = tuple(f"{label}_{axis}" for axis in range(leaf.ndim - len(members) - 1))
            variables[label] = ((*members, "time", *inner), np.asarray(leaf), {} if one is None else {"units": one})
    if trajectory.mode is not None:
        variables["mode"] = ((*members, "time"), np.asarray(trajectory.mode), {"names": list(trajectory.mode_names)})
    times, of_time = Members(trajectory).shared(trajectory.ts, 1), {} if time_unit is None else {"units": time_unit}
    if (times == times[0]).all():
        return xarray.Dataset(variables, coords={"time": ("time", times[0], of_time)})
    times = times.reshape(*trajectory.ok.shape, -1)
    return xarray.Dataset(variables, coords={"t": ((*members, "time"), times, of_time)})


def make_frame(trajectory, units: PyTree = None, time_unit: str | None = None):
    """Return a `pandas.DataFrame` of a trajectory: see `Trajectory.to_pandas`."""
    pandas = import_package("to_pandas()", "pandas", "pandas")
    require_numbers(trajectory, "to_pandas() copies")
    members = Members(trajectory)
    lead = len(members.batch) + 1
    columns = columns_of({"q": trajectory.q, "qdot": trajectory.qdot}, lead)
    if trajectory.contacts is not None:
        columns |= columns_of({"contact_forces": trajectory.contact_forces}, lead)
    if trajectory.mode is not None:
        codes = np.asarray(trajectory.mode).ravel()
        columns["mode"] = pandas.Categorical.from_codes(codes, categories=list(trajectory.mode_names))
    index = pandas.Index(members.shared(trajectory.ts, 1).ravel(), name="t")
    if members.batch:
        places = [place.ravel() for place in np.indices((*members.batch, trajectory.ts.shape[-1]))[:-1]]
        index = pandas.MultiIndex.from_arrays([*places, index], names=[*_axis_names(len(members.batch)), "t"])
    table = pandas.DataFrame(columns, index=index)
    of_q, of_qdot = _leaf_units(trajectory.q, units, time_unit)
    per_leaf = [math.prod(shape) for shape in members.layout.shapes]
    spread = [unit for of in (of_q, of_qdot) for unit, size in zip(of, per_leaf, strict=True) for _ in range(size)]
    known = dict(zip([*columns][: len(spread)], spread, strict=True)) | {"t": time_unit}
    if known := {name: unit for name, unit in known.items() if unit is not None}:
        table.attrs["units"] = known
    return table


def impact_frame(impacts):
    """Return a `pandas.DataFrame` of `Impacts`: see `Impacts.to_pandas`."""
    return _event_frame(impacts, {"impulse": impacts.impulse, "energy_lost": impacts.energy_lost})


def change_frame(changes):
    """Return a `pandas.DataFrame` of `ContactChanges`: see `ContactChanges.to_pandas`."""
    states = {name: getattr(changes, name) for name in ("q", "qdot", "q_next", "qdot_next")}
    words = {"contact": (changes.contact, changes.names), "change": (changes.change, CHANGE_WORDS)}
    return _event_frame(changes, states, **words)


def _event_frame(record, trees: dict[str, PyTree], **words: tuple):
    """Return a table with a row per event at `record.t`, without padding; `words`: (codes, names) of text columns."""
    pandas = import_package("to_pandas()", "pandas", "pandas")
    if not is_known(record.t):
        raise ValueError("to_pandas() copies numbers: call it outside of jit, vmap and grad.")
    t = np.asarray(record.t)
    there = np.flatnonzero(np.isfinite(t.ravel()))
    index = pandas.Index(t.ravel()[there], name="t")
    if t.ndim > 1:
        places = [place.ravel()[there] for place in np.indices(t.shape)[:-1]]
        index = pandas.MultiIndex.from_arrays([*places, index], names=[*_axis_names(t.ndim - 1), "t"])
    columns = {
        name: pandas.Categorical.from_codes(np.asarray(codes).ravel()[there], categories=list(of))
        for name, (codes, of) in words.items()
    }
    columns |= {name: column[there] for name, column in columns_of(trees, t.ndim).items()}
    return pandas.DataFrame(columns, index=index)


def columns_of(trees: dict[str, PyTree], lead: int) -> dict[str, np.ndarray]:
    """Return {label: array} for every number in the pytrees, along all of the first `lead` axes."""
    columns = {}
    for name, tree in trees.items():
        for label, leaf in zip(*labelled_leaves(tree, name)[:2], strict=True):
            shape = leaf.shape[lead:]
            numbers = np.asarray(leaf).reshape(-1, math.prod(shape)).T
            for place, column in zip(np.ndindex(shape), numbers, strict=True):
                columns[label + (str(list(place)) if shape else "")] = column
    return columns


def _axis_names(rank: int) -> tuple[str, ...]:
    """Return names for the batch axes: "member", or "member_0", "member_1", … for nested batches."""
    return ("member",) if rank == 1 else tuple(f"member_{axis}" for axis in range(rank))


def _leaf_units(tree: PyTree, units: PyTree, time_unit: str | None) -> tuple[list, list]:
    """Return the unit of every leaf of q, and of its velocity; None where there is none."""
    if time_unit is not None and not isinstance(time_unit, str):
        raise TypeError(f"time_unit must be text, as 's' is; got {time_unit!r}.")
    of_q = spread_prefix(units, tree, "units", "text")
    if wrong := [unit for unit in of_q if not (unit is None or isinstance(unit, str))]:
        raise TypeError(f"A unit must be text, as 'rad' is, or None; got {wrong[0]!r}.")
    per_time = "" if time_unit is None else time_unit
    of_qdot = [f"{unit or 1}/{per_time}" if unit is not None and per_time else None for unit in of_q]
    return of_q, of_qdot


def spread_prefix(prefix: PyTree, tree: PyTree, name: str, what: str) -> list:
    """Return the value of a pytree prefix for each leaf of q, or None; raise `ValueError` if it does not fit."""

    def is_value(x) -> bool:
        return x is None or isinstance(x, str)

    try:
        return jax.tree.leaves(jax.tree.broadcast(prefix, tree, is_leaf=is_value), is_leaf=is_value)
    except ValueError:
        paths = ["q" + jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)][:8]
        raise ValueError(
            f"{name} is {prefix!r}, which does not fit the structure of q: give {what} for all coordinates, or a "
            f"pytree like q with {what} or None for each ({', '.join(paths)})."
        ) from None
