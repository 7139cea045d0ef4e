"""Formulas on the scalars of a graph, written like those on arrays: `Scalars` is to an id array what `jax.Array` is.

An elimination has more operations than JAX should have to trace one by one. Written with the operators of `Scalars` and
the functions below, the same formula makes nodes of a graph, where a program is wanted, and is a function of JAX
arrays, where JAX is to differentiate or batch it.
"""

from collections.abc import Callable, Sequence
from functools import partialmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._program._emit import apply_in_jax


class Scalars:
    """Nodes of a graph as an array: arithmetic, comparisons of numbers, indexing by numbers."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, expansion: Any, ids: np.ndarray):
        self.expansion, self.ids = expansion, np.asarray(ids, dtype=np.int64)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.ids.shape

    def map(self, op: str, *operands) -> "Scalars":
        """An operation on arrays or numbers that broadcast."""
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


def _scalars(*xs) -> Scalars | None:
    return next((x for x in xs if isinstance(x, Scalars)), None)


def _function(op: str, in_jax: Callable) -> Callable:
    def function(*xs):
        scalars = _scalars(*xs)
        return in_jax(*xs) if scalars is None else scalars.map(op, *xs)

    return function


binade = _function("binade", lambda x: apply_in_jax("binade", x))
prefers, logarithm, root = _function("prefers", jnp.greater), _function("log", jnp.log), _function("sqrt", jnp.sqrt)
maximum, absolute = _function("max", jnp.maximum), _function("abs", jnp.abs)


def where(condition, yes, no):
    """`yes` where the condition holds, else `no`."""
    scalars = _scalars(condition, yes, no)
    return jnp.where(condition, yes, no) if scalars is None else scalars.map("select", condition, no, yes)


def fold(op: str, x):
    """The sum ("add"), smallest ("min"), largest ("max") or disjunction ("or") of a vector that is not empty."""
    if isinstance(x, Scalars):
        return Scalars(x.expansion, x.expansion.fold(op, x.ids))
    return {"add": jnp.sum, "min": jnp.min, "max": jnp.max, "or": jnp.any}[op](x)


def concatenate(parts: Sequence):
    scalars = _scalars(*parts)
    if scalars is None:
        return jnp.concatenate([jnp.asarray(part) for part in parts])
    return Scalars(scalars.expansion, np.concatenate([scalars._ids(part) for part in parts]))


def replace_entries(x, index, values):
    if not isinstance(x, Scalars):
        return jnp.asarray(x).at[index].set(values)
    ids = x.ids.copy()
    ids[index] = values.ids if isinstance(values, Scalars) else x.expansion.constants(values)
    return Scalars(x.expansion, ids)


def scatter(x, index, size: int):
    """A vector of `size` numbers, zero but for those of x at these places."""
    zeros = (
        Scalars(x.expansion, np.full(size, x.expansion.graph.constant(0.0, "float")))
        if isinstance(x, Scalars)
        else jnp.zeros(size, x.dtype)
    )
    return replace_entries(zeros, index, x)


def stack(parts: Sequence) -> Any:
    """Scalars as a vector, or vectors as the rows of a matrix."""
    first = _scalars(*parts)
    if first is None:
        return jnp.stack([jnp.asarray(x) for x in parts])
    return Scalars(first.expansion, np.stack([first._ids(x) for x in parts]))


def apply_function(function: Callable, *arguments):
    scalars = _scalars(*arguments)
    if scalars is None:
        return function(*arguments)
    expansion = scalars.expansion
    jaxpr = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(x.shape, jnp.result_type(float)) for x in arguments))
    (result,) = expansion.run_closed(jaxpr, [x.ids for x in arguments])
    return Scalars(expansion, result)
