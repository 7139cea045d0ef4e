"""`Scalars`: arrays of graph nodes with the operators of arrays, for writing formulas that become nodes.

An elimination has more operations than JAX should have to trace one by one. Written with the operators of `Scalars` and
the functions below, it creates nodes of a graph directly. Other operands are numbers or arrays of numbers.
"""

from collections.abc import Callable, Sequence
from functools import partialmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class Scalars:
    """An array of graph nodes: arithmetic, comparisons, indexing by numbers."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, expansion: Any, ids: np.ndarray):
        self.expansion, self.ids = expansion, np.asarray(ids, dtype=np.int64)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.ids.shape

    def map(self, op: str, *operands) -> "Scalars":
        """An operation on `Scalars` and numbers, which broadcast."""
        return Scalars(self.expansion, self.expansion.map(op, *map(self._ids, operands)))

    def _ids(self, x) -> np.ndarray:
        if isinstance(x, Scalars):
            return x.ids
        return self.expansion.constants(float(x) if type(x) is int else x)  # an int would make what it meets an int

    def __getitem__(self, index) -> "Scalars":
        return Scalars(self.expansion, self.ids[index])

    def __neg__(self):
        return self.map("neg", self)

    def _forward(self, op: str, other) -> "Scalars":
        return self.map(op, self, other)

    def _reflected(self, op: str, other) -> "Scalars":
        return self.map(op, other, self)

    __add__, __radd__ = partialmethod(_forward, "add"), partialmethod(_reflected, "add")
    __sub__, __rsub__ = partialmethod(_forward, "sub"), partialmethod(_reflected, "sub")
    __mul__, __rmul__ = partialmethod(_forward, "mul"), partialmethod(_reflected, "mul")
    __truediv__, __rtruediv__ = partialmethod(_forward, "div"), partialmethod(_reflected, "div")
    __le__, __gt__ = partialmethod(_forward, "le"), partialmethod(_forward, "gt")
    __eq__, __or__ = partialmethod(_forward, "eq"), partialmethod(_forward, "or")  # type: ignore[assignment]


def _first_scalars(xs: Sequence) -> Scalars:
    return next(x for x in xs if isinstance(x, Scalars))


binade, prefers, logarithm, root, maximum, absolute = (
    lambda *xs, op=op: _first_scalars(xs).map(op, *xs) for op in ("binade", "prefers", "log", "sqrt", "max", "abs")
)


def where(condition, yes, no) -> Scalars:
    """`yes` where the condition is true, else `no`."""
    return _first_scalars((condition, yes, no)).map("select", condition, no, yes)


def fold(op: str, x: Scalars) -> Scalars:
    """The sum ("add"), smallest ("min"), largest ("max") or disjunction ("or") of a nonempty vector."""
    nonzero = x.ids[x.ids != x.expansion.graph.number(0.0)]
    return Scalars(x.expansion, x.expansion.fold(op, nonzero if op == "add" and nonzero.size else x.ids))


def concatenate(parts: Sequence) -> Scalars:
    first = _first_scalars(parts)
    return Scalars(first.expansion, np.concatenate([first._ids(part) for part in parts]))


def replace_entries(x: Scalars, index, values) -> Scalars:
    ids = x.ids.copy()
    ids[index] = x._ids(values)
    return Scalars(x.expansion, ids)


def scatter(x: Scalars, index, size: int) -> Scalars:
    """A vector of `size` numbers, zero except for the entries of x at these indices."""
    zeros = np.full(size, x.expansion.graph.number(0.0))
    return replace_entries(Scalars(x.expansion, zeros), index, x)


def filled(x: Scalars) -> np.ndarray:
    """A mask of the entries that are not structurally zero."""
    return x.ids != x.expansion.graph.number(0.0)


def multiply(a: Sequence[Scalars], b: Sequence[Scalars]) -> Scalars:
    """The inner products of vectors a with vectors b, as rows of one vector; structural zeros are skipped."""
    rows, columns = (np.stack([filled(x) for x in xs]) for xs in (a, b))
    found = scatter(a[0][:0], np.zeros(0, int), len(a) * len(b))
    meet = rows.astype(float) @ columns.T.astype(float) > 0
    for i, j in np.argwhere(meet).tolist():
        at = np.flatnonzero(rows[i] & columns[j])
        found.ids[i * len(b) + j] = fold("add", a[i][at] * b[j][at]).ids
    return found


def stack(parts: Sequence) -> Scalars:
    """Scalars as a vector, or vectors as the rows of a matrix."""
    first = _first_scalars(parts)
    return Scalars(first.expansion, np.stack([first._ids(x) for x in parts]))


def apply_function(function: Callable, *arguments: Scalars) -> Scalars:
    """A JAX function of vectors, applied to `Scalars`."""
    expansion = arguments[0].expansion
    jaxpr = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(x.shape, jnp.result_type(float)) for x in arguments))
    (result,) = expansion.run_closed(jaxpr, [x.ids for x in arguments])
    return Scalars(expansion, result)
