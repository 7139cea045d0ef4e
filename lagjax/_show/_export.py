"""A trajectory as labelled arrays (`xarray`) and as a table (`pandas`), both by the names of the user's pytree.

Units are given as a pytree prefix of q, as in `jax.vmap`: one for all coordinates, or one for each. Velocities have
those per unit of time. They stand in the `attrs` of what comes out, and not in the names, by which columns are found.
"""

from typing import Any

import jax
import numpy as np

from lagjax._interface import Layout, is_known
from lagjax._show._summary import times_of_members

PyTree = Any


def dataset(trajectory, units: PyTree = None, time_unit: str | None = None):
    """An `xarray.Dataset` of a trajectory: see `Trajectory.to_xarray`."""
    xarray = _package("xarray", "to_xarray()")
    _require_numbers(trajectory, "to_xarray()")
    members = _member_axes(trajectory)
    of_q, of_qdot = _units(trajectory.q, units, time_unit)
    variables: dict[str, tuple] = {"ok": (members, np.asarray(trajectory.ok))}
    for name, tree, unit in (("q", trajectory.q, of_q), ("qdot", trajectory.qdot, of_qdot)):
        for (path, leaf), one in zip(jax.tree_util.tree_leaves_with_path(tree), unit, strict=True):
            label = ".".join([name, *map(_key_text, path)])
            inner = tuple(f"{label}_{axis}" for axis in range(leaf.ndim - len(members) - 1))
            attributes = {} if one is None else {"units": one}
            variables[label] = ((*members, "time", *inner), np.asarray(leaf), attributes)
    if trajectory.mode is not None:
        names = {"names": list(trajectory.mode_names)}
        variables["mode"] = ((*members, "time"), np.asarray(trajectory.mode), names)
    times, shared = _times(trajectory)
    of_time = {} if time_unit is None else {"units": time_unit}
    own = {} if shared else {"t": ((*members, "time"), times, of_time)}
    coordinates = {"time": ("time", times, of_time)} if shared else own
    return xarray.Dataset(variables, coords=coordinates)


def frame(trajectory, units: PyTree = None, time_unit: str | None = None):
    """A `pandas.DataFrame` of a trajectory: see `Trajectory.to_pandas`."""
    pandas = _package("pandas", "to_pandas()")
    _require_numbers(trajectory, "to_pandas()")
    members, names = _member_axes(trajectory), _names(trajectory)
    batch, count = np.shape(trajectory.result._value), trajectory.ts.shape[-1]
    each = times_of_members(trajectory)
    columns = {
        name: column
        for which, tree in (("q", trajectory.q), ("qdot", trajectory.qdot))
        for name, column in zip(_column_names(which, names), _columns(tree, len(batch) + 1), strict=True)
    }
    if trajectory.mode is not None:
        codes = np.asarray(trajectory.mode).ravel()
        columns["mode"] = pandas.Categorical.from_codes(codes, categories=list(trajectory.mode_names))
    if batch:
        places = [place.ravel() for place in np.indices((*batch, count))[:-1]]
        index = pandas.MultiIndex.from_arrays([*places, each.ravel()], names=[*members, "t"])
    else:
        index = pandas.Index(each.ravel(), name="t")
    table = pandas.DataFrame(columns, index=index)
    of_q, of_qdot = _units(trajectory.q, units, time_unit)
    per_leaf = [leaf[0].size for leaf in _first_member(trajectory.q, len(batch))]
    spread = [unit for of in (of_q, of_qdot) for unit, size in zip(of, per_leaf, strict=True) for _ in range(size)]
    known = {name: unit for name, unit in zip(columns, spread, strict=False) if unit is not None}
    if time_unit is not None:
        known["t"] = time_unit
    if known:
        table.attrs["units"] = known
    return table


def intervals(names, values, low, high):
    """A `pandas.DataFrame` of numbers by name, with the ends of their intervals: see `Fit.to_pandas`."""
    pandas = _package("pandas", "to_pandas()")
    return pandas.DataFrame({"value": values, "low": low, "high": high}, index=pandas.Index(names, name="parameter"))


def _package(name: str, what: str):
    try:
        return __import__(name)
    except ImportError:
        raise ImportError(f"{what} needs the package {name}: pip install {name}.") from None


def _require_numbers(trajectory, what: str) -> None:
    if not all(map(is_known, jax.tree.leaves((trajectory.ts, trajectory.q, trajectory.qdot)))):
        raise ValueError(f"{what} copies numbers: call it outside of jit, vmap and grad.")


def _member_axes(trajectory) -> tuple[str, ...]:
    """Names of the axes of the batch: "member", or "member_0", "member_1", … of batches of batches."""
    rank = np.ndim(trajectory.result._value)
    return ("member",) if rank == 1 else tuple(f"member_{axis}" for axis in range(rank))


def _times(trajectory) -> tuple[np.ndarray, bool]:
    """The times, (T,) where all members share them, else (…, T), and whether they do."""
    rows = np.asarray(trajectory.ts).reshape(-1, trajectory.ts.shape[-1])
    shared = bool((rows == rows[0]).all())
    return (rows[0] if shared else times_of_members(trajectory)), shared


def _first_member(tree: PyTree, axes: int) -> list[np.ndarray]:
    """The leaves of the first member, with the time axis in front."""
    return [np.asarray(leaf)[(0,) * axes] for leaf in jax.tree.leaves(tree)]


def _names(trajectory) -> tuple[str, ...]:
    """The names of the coordinates, as messages have them."""
    axes = np.ndim(trajectory.result._value) + 1
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[(0,) * axes], (trajectory.q, trajectory.qdot))
    return Layout.from_state(*one).names


def _column_names(which: str, names: tuple[str, ...]) -> list[str]:
    """The names of coordinates, which begin with q, with `which` in its place."""
    return [which + name.removeprefix("q") for name in names]


def _columns(tree: PyTree, axes: int) -> list[np.ndarray]:
    """Every scalar coordinate with the leading axes end to end."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return [column for leaf in leaves for column in leaf.reshape(int(np.prod(leaf.shape[:axes])), -1).T]


def _units(tree: PyTree, units: PyTree, time_unit: str | None) -> tuple[list, list]:
    """The unit of every leaf of q, and of its velocity; None where there is none."""
    if time_unit is not None and not isinstance(time_unit, str):
        raise TypeError(f"time_unit must be text, as 's' is; got {time_unit!r}.")
    try:
        whole = jax.tree.broadcast(units, tree, is_leaf=lambda unit: unit is None or isinstance(unit, str))
    except ValueError:
        raise ValueError(
            f"units is {units!r}, which does not fit the structure of q: give text for all coordinates, or a pytree "
            f"like q with text or None for each ({', '.join(_paths(tree))})."
        ) from None
    of_q = jax.tree.leaves(whole, is_leaf=lambda unit: unit is None)
    if wrong := [unit for unit in of_q if not (unit is None or isinstance(unit, str))]:
        raise TypeError(f"A unit must be text, as 'rad' is, or None; got {wrong[0]!r}.")
    per_time = "" if time_unit is None else time_unit
    of_qdot = [f"{unit or 1}/{per_time}" if unit is not None and per_time else None for unit in of_q]
    return of_q, of_qdot


def _paths(tree: PyTree) -> list[str]:
    return ["q" + jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)][:8]


def _key_text(key: Any) -> str:
    """A key of a pytree path as plain text: 'theta' for a dict's or a NamedTuple's, '0' for a list's."""
    return str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key))))
