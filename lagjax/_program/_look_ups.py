"""Look-ups in tables: how a scalar program reads arrays that are too long to have a node for every entry.

An array of 25 000 samples is one `Table`, not 25 000 inputs. Two operations read it, both constant along a step:

    take     an entry, by an index that is a whole number already; it is clipped to the table
    locate   the number of entries of an increasing table that are at most x, less one: the interval that contains x

An entry is an input or a constant of the program. Derivatives by the entries are sparse: the tangent of `take` is taken
from the same index of a table of tangents, and its cotangent belongs to one entry (`_differentiation`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

# The first of the numbers of a member, in a program whose inputs are only those of them that it computes with.
BESIDE = 2**40


class Table(NamedTuple):
    """A table in a program: entry i is input `first` + i `stride`, for 0 ≤ i < `count`.

    With `numbers`, the bytes of a float64 array, entry i is that element of it instead. With `tangents`, it is the
    tangent of that input, in a program whose inputs do not include the input itself.
    """

    first: int
    stride: int
    count: int
    numbers: bytes | None = None
    tangents: bool = False

    @property
    def entries(self) -> np.ndarray:
        """The entries of a table of numbers, (count,)."""
        assert self.numbers is not None
        numbers = np.frombuffer(self.numbers)
        return numbers[self.first : self.first + self.stride * (self.count - 1) + 1 : self.stride]

    def moved(self, places: "Sequence[int] | dict[int, int]") -> "Table":
        """The table in a program where input i has become input `places[i]`."""
        first = places[self.first]
        stride = places[self.first + self.stride] - first if self.count > 1 else 1
        return self._replace(first=first, stride=stride)

    @property
    def positions(self) -> range:
        if self.numbers is not None or self.tangents:
            return range(0)
        return range(self.first, self.first + self.stride * self.count, self.stride)


class Located(NamedTuple):
    """The attribute of `locate`: an increasing table; `closed`: x equal to its last entry is in the last interval."""

    table: Table
    closed: bool


def table_of(attribute: "Table | Located") -> Table:
    return attribute.table if isinstance(attribute, Located) else attribute


_LookUp = TypeVar("_LookUp", Table, Located)


def _with_table(attribute: _LookUp, move: Callable[[Table], Table]) -> _LookUp:
    """The look-up attribute with its table replaced by `move(table)`; a table of constants is kept."""
    if isinstance(attribute, Located):
        return attribute._replace(table=_with_table(attribute.table, move))
    return attribute if attribute.numbers is not None else move(attribute)


def shift_look_up(attribute: _LookUp, by: int) -> _LookUp:
    """The look-up attribute in a program whose inputs have moved up by `by` positions."""
    return _with_table(attribute, lambda table: table._replace(first=table.first + by))


def move_look_up(attribute: _LookUp, places: Sequence[int]) -> _LookUp:
    """The look-up attribute in a program where input i is now `places[i]`; tables from `BESIDE` on keep their place."""
    return _with_table(attribute, lambda table: table if table.first >= BESIDE else table.moved(places))


def look_up(op: str, attribute: Any, columns: Sequence, x) -> np.ndarray:
    """The values of `take` or `locate` at S states, (S,); `columns` has a number or an array (S,) for every input."""
    table, x = table_of(attribute), np.asarray(x)
    if table.numbers is not None:
        entries = table.entries
    else:
        given = [columns[i] for i in table.positions]
        try:
            entries = np.array(given)
        except ValueError:  # numbers and arrays
            entries = np.stack(np.broadcast_arrays(*given))
    if op == "take":
        index = np.clip(np.where(np.isnan(x), 0, x), 0, table.count - 1).astype(int)
        return entries[index] if entries.ndim == 1 else entries[(index, np.arange(entries.shape[1]))]
    if entries.ndim == 1:
        found = np.searchsorted(entries, x, side="right") - 1
    else:
        found = (entries <= x).sum(axis=0) - 1
    if isinstance(attribute, Located) and attribute.closed:
        found = np.where(x == entries[-1], table.count - 2, found)
    return np.where(np.isnan(x), -1, found).astype(float)[()]


def cotangents(table: Table, index, g) -> dict[int, np.ndarray]:
    """The cotangents {input: (S,)} of table entries, from the cotangent g (S,) of the entries at `index` (S,)."""
    if not len(table.positions):
        return {}
    index = np.clip(np.where(np.isnan(index), 0, index), 0, table.count - 1).astype(int)
    return {table.positions[i]: np.where(index == i, g, 0.0) for i in np.unique(index).tolist()}
