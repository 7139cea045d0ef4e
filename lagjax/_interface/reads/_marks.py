"""`Marks`: where a walk found each value, to check within a microsecond whether all are unchanged.

Values must be the same objects; an array is compared by its bytes, as it can be written to.
"""

import collections
import functools
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

# Bytes of an array that are compared at every call: a megabyte takes a tenth of a millisecond. Of a larger one, SAMPLED
# numbers are, evenly spaced; a change between them is not seen. Twice as many: twice the time.
LARGEST_ARRAY, SAMPLED = 2**20, 4096
LARGEST_CONTAINER = 10_000  # entries that are compared one by one, in as long; a larger one by its length

ABSENT = object()  # the value under a key that has no entry
SIZE = "how many attributes there are"


class Marks:
    """Recorded places: values that must still be the same objects, and contents that must still be equal."""

    def __init__(self):
        self._values: list[tuple[Callable, Any, str, Any]] = []  # reader, place, key, value
        self._contents: list[tuple[Callable, Any, str | None, Any, Any]] = []  # reader, place, key, content, parts

    def mark(self, place: Any, key: str | None, value: Any) -> None:
        """Record a value (or `ABSENT`) under a key of a dict, object or cell; with key None, the place's content."""
        if key is SIZE:
            self._contents.append((len, place, SIZE, len(place), None))
        elif key is not None:
            self._values.append((_key_reader(place), place, key, value))
        elif not isinstance(place, tuple | frozenset):
            content, parts = _content_reader(place)
            self._contents.append((content, place, None, content(place), parts))

    @property
    def keys(self) -> dict[tuple[int, str], Any]:
        """The places of recorded values, by (id of the place, key)."""
        return {
            (id(place), key): place
            for _, place, key, value in self._values
            if value is not ABSENT and not isinstance(place, types.CellType)
        }

    def hold(self) -> bool:
        return next(self.changed(), None) is None

    def changed(self) -> Iterator[tuple[Any, str | None]]:
        try:
            for reader, place, key, value in self._values:
                if reader(key, ABSENT) is not value:
                    yield place, key
            for reader, place, key, content, _ in self._contents:
                if reader(place) != content:
                    yield place, key
        except Exception:  # a cell that was emptied, an attribute that is gone, a dict that another thread adds to
            yield None, None


def _key_reader(place: Any) -> Callable[[str, Any], Any]:
    """Return a function (key, default) that reads a key of this place, in C where possible."""
    if isinstance(place, types.CellType):
        return lambda key, default: place.cell_contents
    if isinstance(place, dict | type):
        return place.get if isinstance(place, dict) else place.__dict__.get
    return functools.partial(getattr, place)


def _content_reader(place: Any) -> tuple[Callable[[Any], Any], tuple | None]:
    """Return a function of the place that gives the content to compare, and objects to keep alive, whose ids it has."""
    if not isinstance(place, Mapping | list | set | collections.deque):
        return _read_bytes, None
    if len(place) > LARGEST_CONTAINER:
        return len, None
    if isinstance(place, Mapping):
        return lambda table: (*map(id, table.keys()), *map(id, table.values())), (*place.keys(), *place.values())
    return lambda row: tuple(map(id, row)), tuple(place)


def _read_bytes(place: Any) -> tuple:
    """Return shape, dtype and bytes of an array-like; of a large array only the bytes of `SAMPLED` numbers."""
    array = np.asarray(place)
    whole = array.nbytes <= LARGEST_ARRAY
    numbers = array if whole else array.flat[np.linspace(0, array.size - 1, SAMPLED).astype(int)]
    return array.shape, array.dtype, numbers.tobytes()
