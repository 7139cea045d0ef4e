"""The members of a sweep: the product of the axes of `over`, its points, and its division into units.

    over ──axes_of──► Axis, … ──► Grid: shape, units ──► the range of a unit ──► points of some of its members

A member is an index into the grid; its number counts in C order, the last axis fastest. A unit is a box of members
without gaps in that order, and one chunk of every array in the store.
"""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagjax.designs import Design

RESERVED = ("result",)


@dataclass(frozen=True)
class Axis:
    """One axis: the names that vary along it together, and their values (size, names), or a `Design` for them."""

    names: tuple[str, ...]
    size: int
    source: Any  # a tuple of arrays (size,), or a Design

    @property
    def dimension(self) -> str:
        return "_".join(self.names)

    def pieces(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (start, values (m, names)) in order."""
        start = 0
        for values in self.source.pieces(self.names) if isinstance(self.source, Design) else [np.stack(self.source, 1)]:
            yield start, values
            start += len(values)

    def described(self) -> dict:
        about = {"names": list(self.names), "size": self.size}
        if isinstance(self.source, Design):
            return about | self.source.described()
        ends = [[float(x[0]), float(x[-1])] for x in self.source]
        return about | {"rule": "values", "ends": ends, "sha256": hash_columns(self.source)}


def hash_columns(columns) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in columns)).hexdigest()


def describe_axes(axes: list[dict]) -> str:
    """Return the axes in a store's description as text: 'length: 6 values from 0.5 to 1.5 (#53dd0e), …'."""
    return "; ".join(f"{', '.join(axis['names'])}: {_describe_values(axis)}" for axis in axes)


def _describe_values(axis: dict) -> str:
    if axis["rule"] == "values":
        ends = ", ".join(f"{a:g} to {b:g}" for a, b in axis["ends"])
        return f"{axis['size']} values from {ends} (#{axis['sha256'][:6]})"
    return f"{axis['rule']}, {axis['size']} values, seed {axis['seed']}, from {axis['low']} to {axis['high']}"


def axes_of(over: Any) -> tuple[Axis, ...]:
    """Return the axes of `over`; raise `TypeError` or `ValueError` if it is invalid."""
    if not isinstance(over, dict) or not over:
        raise TypeError(
            "over must be a dict that is not empty: names with 1-D arrays or designs, as in {'l': np.linspace(1, 2, "
            f"50), ('a', 'b'): lagjax.designs.random(1000, seed=1)}}; got {type(over).__name__}."
        )
    axes = tuple(_member_axis(key, value) for key, value in over.items())
    names = [name for axis in axes for name in axis.names]
    taken = [*names, *(axis.dimension for axis in axes if len(axis.names) > 1), *RESERVED]
    for name in taken:
        if taken.count(name) > 1:
            raise ValueError(f"over uses the name {name!r} twice (`result` is taken, and so are joined names): rename.")
    return axes


def _member_axis(key: Any, value: Any) -> Axis:
    names = key if isinstance(key, tuple) else (key,)
    for name in names:
        if not isinstance(name, str) or not name.isidentifier():
            raise TypeError(f"Keys of over are names, or tuples of names, such as 'theta1'; got {key!r}.")
    if isinstance(value, Design):
        return Axis(names, value.count, value.about(names))
    columns = value if isinstance(key, tuple) else (value,)
    if not isinstance(columns, tuple | list) or len(columns) != len(names):
        raise ValueError(f"over[{key!r}] must be a design, or a tuple of {len(names)} arrays of one length.")
    arrays = tuple(_member_column(name, x) for name, x in zip(names, columns, strict=True))
    if len({x.size for x in arrays}) > 1:
        sizes = ", ".join(f"{name} {x.size}" for name, x in zip(names, arrays, strict=True))
        raise ValueError(f"What over[{key!r}] steps through together must have one length; got {sizes}.")
    return Axis(names, arrays[0].size, arrays)


def _member_column(name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of several lengths
        array = np.asarray(value, object)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"over[{name!r}] must be a 1-D array of real numbers that is not empty, or a design such as "
            f"lagjax.designs.random(1000, seed=1); got an array of shape {array.shape} and type {array.dtype}."
        )
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"over[{name!r}][{int(np.argmin(np.isfinite(array)))}] is not finite.")
    return array


@dataclass(frozen=True)
class Grid:
    """The shape of all members, and that of a unit, which is a chunk of each array."""

    shape: tuple[int, ...]
    chunk: tuple[int, ...]

    @classmethod
    def from_shape(cls, shape: tuple[int, ...], members: int) -> "Grid":
        """Divide the members into units of about this size: whole last axes, part of one, single indices before."""
        chunk, room = [1] * len(shape), max(1, members)
        for place in reversed(range(len(shape))):
            chunk[place] = min(shape[place], room)
            if chunk[place] < shape[place]:
                chunk[place] = math.ceil(shape[place] / math.ceil(shape[place] / chunk[place]))  # evenly
                break
            room = max(1, room // shape[place])
        return cls(tuple(shape), tuple(chunk))

    @property
    def member_count(self) -> int:
        return math.prod(self.shape)

    @property
    def units_per_axis(self) -> tuple[int, ...]:
        return tuple(math.ceil(size / part) for size, part in zip(self.shape, self.chunk, strict=True))

    @property
    def unit_count(self) -> int:
        return math.prod(self.units_per_axis)

    def place(self, unit: int) -> tuple[int, ...]:
        """Return the index of a unit among the units, which names its chunk."""
        return tuple(int(i) for i in np.unravel_index(unit, self.units_per_axis))

    def box(self, unit: int) -> tuple[slice, ...]:
        parts = zip(self.place(unit), self.chunk, self.shape, strict=True)
        return tuple(slice(i * part, min((i + 1) * part, size)) for i, part, size in parts)

    def box_shape(self, unit: int) -> tuple[int, ...]:
        return tuple(s.stop - s.start for s in self.box(unit))

    def unit_size(self, unit: int) -> int:
        return math.prod(self.box_shape(unit))

    def numbers(self, unit: int, which: np.ndarray) -> np.ndarray:
        """Return the numbers, in the whole sweep, of the members with indices `which` in a unit."""
        inside = np.unravel_index(which, self.box_shape(unit))
        places = [i + s.start for i, s in zip(inside, self.box(unit), strict=True)]
        return np.asarray(np.ravel_multi_index(places, self.shape))


def points_of(axes: list[dict[str, np.ndarray]], shape: tuple[int, ...], which: np.ndarray) -> dict[str, np.ndarray]:
    """Return the points of members of a box of this `shape`: `axes` has the values along each axis, by name."""
    places = np.unravel_index(which, shape)
    return {name: values[i] for i, axis in zip(places, axes, strict=True) for name, values in axis.items()}


def point_text(point: dict[str, Any]) -> str:
    """Return a point as text, 'l = 0.5, theta = 1.2', with all digits, so that it can be run again."""
    return ", ".join(f"{name} = {float(value)!r}" for name, value in point.items())
