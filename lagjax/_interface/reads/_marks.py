"""`Marks`: where a walk found each value, so that the next call sees in a microsecond whether all are still there.

A place holds the same object as before, or what is derived from the function may not serve any more: then the walk is
gone again, and only another text is another function. An array is compared by its bytes, as it can be written to.
"""

import collections
import types
from collections.abc import Iterator
from operator import is_
from typing import Any

import numpy as np

# Bytes of an array that are compared at every call: a megabyte takes a tenth of a millisecond. Of a larger one, SAMPLED
# numbers are, evenly spaced; a change between them is not seen. Twice as many: twice the time.
LARGEST_ARRAY, SAMPLED = 2**20, 4096
LARGEST_CONTAINER = 10_000  # entries that are compared one by one, in as long; a larger one by its length

_ABSENT = object()
SIZE = "how many attributes there are"


def fingerprint(array: np.ndarray) -> bytes:
    """The bytes of an array, or of some of its numbers."""
    if array.nbytes <= LARGEST_ARRAY:
        return array.tobytes()
    return array.flat[np.linspace(0, array.size - 1, SAMPLED).astype(int)].tobytes()


class Marks:
    """Places and what was found there, sorted by how they are looked at."""

    def __init__(self):
        self._by_key: list[tuple[Any, str, Any]] = []  # (dict, key, value)
        self._classes: list[tuple[type, str, Any]] = []
        self._absent: list[tuple[dict, str]] = []
        self._attributes: list[tuple[Any, str, Any]] = []
        self._cells: list[tuple[types.CellType, Any, Any]] = []
        self._sizes: list[tuple[Any, Any, int]] = []
        self._tables: list[tuple[Any, tuple, tuple]] = []
        self._rows: list[tuple[Any, tuple]] = []
        self._arrays: list[tuple[np.ndarray, tuple, bytes]] = []
        self._shown: list[tuple[Any, bytes]] = []  # objects that show an array

    def mark(self, place: Any, key: str | None, value: Any) -> None:
        """Note a value under its key in a dict or an object, the content of a cell, or (key None) a mutable value."""
        if isinstance(place, types.CellType):
            self._cells.append((place, key, value))
        elif key is not None:
            found: Any = self._by_key if isinstance(place, dict) else self._attributes
            found = self._classes if isinstance(place, type) else found
            found.append((place, key, value))
        elif isinstance(place, np.ndarray):
            self._arrays.append((place, (place.shape, place.dtype), fingerprint(place)))
        elif isinstance(value, np.ndarray):
            self._shown.append((place, fingerprint(value)))
        elif isinstance(place, tuple | frozenset):
            pass
        elif len(place) > LARGEST_CONTAINER:
            self._sizes.append((place, None, len(place)))
        elif isinstance(place, list | set | collections.deque):
            self._rows.append((place, tuple(place)))
        else:
            self._tables.append((place, tuple(place.keys()), tuple(place.values())))

    def miss(self, place: dict, key: str) -> None:
        """Note that nothing is under this key."""
        self._absent.append((place, key))

    def count(self, attributes: dict) -> None:
        """Note how many attributes an object has."""
        self._sizes.append((attributes, SIZE, len(attributes)))

    @property
    def keys(self) -> dict[tuple[int, str], Any]:
        """The places with what they are read by, and each of them."""
        return {(id(place), key): place for place, key, _ in (*self._by_key, *self._classes, *self._attributes)}

    def hold(self) -> bool:
        """True if all is as it was."""
        return next(self.changed(), None) is None

    def changed(self) -> Iterator[tuple[Any, str | None]]:
        """The places, with their keys, where something else is now."""
        try:
            for place, key, value in self._by_key:
                if place.get(key, _ABSENT) is not value:
                    yield place, key
            for place, key, value in self._classes:
                if place.__dict__.get(key, _ABSENT) is not value:
                    yield place, key
            for place, key in self._absent:
                if key in place:
                    yield place, key
            for cell, key, value in self._cells:
                if cell.cell_contents is not value:
                    yield cell, key
            for place, key, value in self._attributes:
                if getattr(place, key) is not value:
                    yield place, key
            for place, key, count in self._sizes:
                if len(place) != count:
                    yield place, key
            for place, values in self._rows:
                if len(place) != len(values) or not all(map(is_, place, values)):
                    yield place, None
            for place, keys, values in self._tables:
                if len(place) != len(keys) or not (
                    all(map(is_, place.keys(), keys)) and all(map(is_, place.values(), values))
                ):
                    yield place, None
            for place, kind, content in self._arrays:
                if (place.shape, place.dtype) != kind or fingerprint(place) != content:
                    yield place, None
            for place, content in self._shown:
                if fingerprint(np.asarray(place)) != content:
                    yield place, None
        except Exception:  # a cell that was emptied, an attribute that is gone, a dict that another thread adds to
            yield None, None
