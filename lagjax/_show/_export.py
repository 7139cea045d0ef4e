"""A trajectory as labelled arrays (`xarray`) and as a table (`pandas`), both by the names of the user's pytree.

Units are given as a pytree prefix of q, as in `jax.vmap`: one for all coordinates, or one for each. Velocities have
those per unit of time. They stand in the `attrs` of what comes out, and not in the names, by which columns are found.
"""

import math
from typing import Any

import jax
import numpy as np

from lagjax._run import Members
from lagjax._show._summary import import_package, require_numbers

PyTree = Any


def dataset(trajectory, units: PyTree = None, time_unit: str | None = None):
    """An `xarray.Dataset` of a trajectory: see `Trajectory.to_xarray`."""
    xarray = import_package("to_xarray()", "xarray", "xarray")
    require_numbers(trajectory, "to_xarray() copies")
    members = _member_axes(trajectory)
    of_q, of_qdot = _units(trajectory.q, units, time_unit)
    variables: dict[str, tuple] = {"ok": (members, np.asarray(trajectory.ok))}
    for name, tree, unit in (("q", trajectory.q, of_q), ("qdot", trajectory.qdot, of_qdot)):
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


def frame(trajectory, units: PyTree = None, time_unit: str | None = None):
    """A `pandas.DataFrame` of a trajectory: see `Trajectory.to_pandas`."""
    pandas = import_package("to_pandas()", "pandas", "pandas")
    require_numbers(trajectory, "to_pandas() copies")
    members = Members(trajectory)
    names = [name.removeprefix("q") for name in members.layout.names]
    columns = {
        which + name: column
        for which, tree in (("q", trajectory.q), ("qdot", trajectory.qdot))
        for name, column in zip(names, members.flat(tree).reshape(-1, len(names)).T, strict=True)
    }
    if trajectory.mode is not None:
        codes = np.asarray(trajectory.mode).ravel()
        columns["mode"] = pandas.Categorical.from_codes(codes, categories=list(trajectory.mode_names))
    index = pandas.Index(members.shared(trajectory.ts, 1).ravel(), name="t")
    if members.batch:
        places = [place.ravel() for place in np.indices((*members.batch, trajectory.ts.shape[-1]))[:-1]]
        index = pandas.MultiIndex.from_arrays([*places, index], names=[*_member_axes(trajectory), "t"])
    table = pandas.DataFrame(columns, index=index)
    of_q, of_qdot = _units(trajectory.q, units, time_unit)
    per_leaf = [math.prod(shape) for shape in members.layout.shapes]
    spread = [unit for of in (of_q, of_qdot) for unit, size in zip(of, per_leaf, strict=True) for _ in range(size)]
    known = dict(zip([*columns][: len(spread)], spread, strict=True)) | {"t": time_unit}
    if known := {name: unit for name, unit in known.items() if unit is not None}:
        table.attrs["units"] = known
    return table


def _member_axes(trajectory) -> tuple[str, ...]:
    """Names of the axes of the batch: "member", or "member_0", "member_1", … of batches of batches."""
    rank = np.ndim(trajectory.result._value)
    return ("member",) if rank == 1 else tuple(f"member_{axis}" for axis in range(rank))


def _units(tree: PyTree, units: PyTree, time_unit: str | None) -> tuple[list, list]:
    """The unit of every leaf of q, and of its velocity; None where there is none."""
    if time_unit is not None and not isinstance(time_unit, str):
        raise TypeError(f"time_unit must be text, as 's' is; got {time_unit!r}.")
    try:
        whole = jax.tree.broadcast(units, tree, is_leaf=lambda unit: unit is None or isinstance(unit, str))
    except ValueError:
        paths = ["q" + jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)][:8]
        raise ValueError(
            f"units is {units!r}, which does not fit the structure of q: give text for all coordinates, or a pytree "
            f"like q with text or None for each ({', '.join(paths)})."
        ) from None
    of_q = jax.tree.leaves(whole, is_leaf=lambda unit: unit is None)
    if wrong := [unit for unit in of_q if not (unit is None or isinstance(unit, str))]:
        raise TypeError(f"A unit must be text, as 'rad' is, or None; got {wrong[0]!r}.")
    per_time = "" if time_unit is None else time_unit
    of_qdot = [f"{unit or 1}/{per_time}" if unit is not None and per_time else None for unit in of_q]
    return of_q, of_qdot
