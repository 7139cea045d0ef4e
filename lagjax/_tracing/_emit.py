"""From a graph back to JAX: the operations of a program, one after the other, on scalars or on arrays of lanes."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lagjax._interface import compiled_once
from lagjax._program import BESIDE, LOOK_UPS, OPERATIONS, StraightLine, Table, table_of


def emit(line: StraightLine, scalars: tuple) -> tuple:
    """The outputs for these inputs, broadcast to the common shape of the inputs."""
    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in scalars))

    def entries(table):
        return jnp.stack(jnp.broadcast_arrays(*(scalars[i] for i in table.positions)), axis=-1)

    return _emit_outputs(line, scalars, shape, entries)


def _emit_outputs(line: StraightLine, scalars, shape: tuple[Any, ...], entries: Callable) -> tuple:
    nodes, kinds = line.nodes, line.kinds
    positions = [node[2] for node, kind in zip(nodes, kinds, strict=True) if node[0] == "input" and kind == "float"]
    precision = jnp.result_type(float, *(scalars[i] for i in positions))
    dtypes = [precision if kind == "float" else np.dtype(kind) for kind in kinds]
    values: list = [None] * len(nodes)
    turns: dict[int, tuple] = {}  # sine and cosine of angles

    for i, (op, operands, attribute) in enumerate(nodes):
        if op == "constant":
            values[i] = np.asarray(attribute, dtypes[i])
        elif op == "input":
            values[i] = lax.convert_element_type(jnp.asarray(scalars[attribute]), dtypes[i])
        elif op == "convert":
            values[i] = lax.convert_element_type(values[operands[0]], dtypes[i])
        elif op in LOOK_UPS:
            values[i] = emit_look_up(op, attribute, entries, precision, values[operands[0]])
        elif op in ("sin", "cos"):
            if operands[0] not in turns:
                turns[operands[0]] = _sincos(values[operands[0]])
            values[i] = turns[operands[0]][op == "cos"]
        else:
            values[i] = _apply_operation(op, _align_shapes([values[operand] for operand in operands]), attribute)
    return tuple(jnp.broadcast_to(jnp.asarray(values[i]), shape) for i in line.outputs)


class Rows(NamedTuple):
    """The inputs of a program as arrays: `first` (…, m), then `numbers` (…, P).

    If there are `pieces`, they follow the first inputs, and the numbers are read by look-ups only (`_look_ups.BESIDE`).
    """

    first: Any
    numbers: Any
    pieces: Sequence = ()

    def __getitem__(self, i: int):
        m = self.first.shape[-1]
        return self.first[..., i] if i < m else self.pieces[i - m] if self.pieces else self.numbers[..., i - m]

    def entries(self, table: Table):
        first = table.first - (BESIDE if table.first >= BESIDE else self.first.shape[-1])
        return self.numbers[..., first : first + table.stride * (table.count - 1) + 1 : table.stride]


def emit_rows(line: StraightLine, rows: Rows) -> tuple:
    """The outputs of a line for inputs in arrays, which look-ups read without splitting them into scalars."""
    shape = jnp.broadcast_shapes(rows.first.shape[:-1], rows.numbers.shape[:-1])
    return _emit_outputs(line, rows, shape, rows.entries)


def emit_look_up(op: str, attribute, entries: Callable, precision, x) -> jax.Array:
    """An entry of a table, or the interval that contains x; `entries(table)` has shape (…, count)."""
    table = table_of(attribute)
    values = jnp.asarray(entries(table) if table.numbers is None else table.entries).astype(precision)
    if op == "take":
        x = jnp.clip(jnp.where(jnp.isnan(x), 0, x), 0, table.count - 1).astype(int)
        return jnp.vectorize(lambda of, i: jnp.asarray(of)[i], signature="(k),()->()")(values, x)

    def piece(of, x):
        found = jnp.searchsorted(of, x, side="right") - 1
        if attribute.closed:
            found = jnp.where(x == of[-1], table.count - 2, found)
        return jnp.where(jnp.isnan(x), -1, found).astype(precision)

    return jnp.vectorize(piece, signature="(k),()->()")(values, x)


def _power_of_two(x):
    one = jnp.ones_like(x)
    power = jnp.where(x == 0, one, jnp.ldexp(one, jnp.frexp(lax.stop_gradient(x))[1] - 1))
    return jnp.where(jnp.isfinite(x), power, jnp.abs(x))


WRITTEN: dict[str, Callable] = {  # operations that `lax` does not have
    "binade": _power_of_two, "trunc": jnp.trunc, "logaddexp": jnp.logaddexp,
}  # fmt: skip


def _apply_operation(op: str, xs: list, attribute) -> jax.Array:
    function = WRITTEN.get(op) or getattr(lax, OPERATIONS[op].lax or op)
    return function(*xs) if attribute is None else function(*xs, lax.RoundingMethod(attribute))


def apply_in_jax(op: str, *xs, attribute=None) -> jax.Array:
    """The operation on arrays that broadcast: the function `f` of the formulas of `_operations`, in JAX."""
    dtype = jnp.result_type(*xs)
    return _apply_operation(op, _align_shapes([jnp.asarray(x, dtype) for x in xs]), attribute)


@jax.custom_jvp
@compiled_once
def _sincos(x) -> tuple:
    """Sine and cosine in one compiled function, which XLA on CPUs would otherwise repeat in every fused loop."""
    return lax.sin(x), lax.cos(x)


@_sincos.defjvp
def _derive_sincos(xs, moving):
    sine, cosine = _sincos(*xs)
    return (sine, cosine), (cosine * moving[0], -sine * moving[0])


def _align_shapes(values: list) -> list:
    """Operands broadcast to one shape: `lax` functions do not broadcast, which makes them quick to trace."""
    shapes = {value.shape for value in values}
    if len(shapes) == 1:
        return values
    shape = jnp.broadcast_shapes(*shapes)
    return [value if value.shape == shape else jnp.broadcast_to(value, shape) for value in values]
