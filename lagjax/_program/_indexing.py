"""Arrays that are indexed by numbers of the motion, as look-ups in tables (`_look_ups`).

The array must lie in a row as inputs of the program, or consist of numbers: then an entry of it is read from memory,
however long it is. Indices that fold to numbers are none of this (`_rules`).
"""

import math
from typing import Any

import numpy as np

from lagjax._program._graph import INPUTS, NUMBERS, Graph, Unlowerable
from lagjax._program._look_ups import Located, Table

Ids = np.ndarray
_WHOLE = ("locate", "floor", "ceil", "round")  # operations whose result is a whole number


def known(expansion: Any, ids: Ids) -> bool:
    """Whether all of these scalars are numbers."""
    return all(expansion.graph.value(i) is not None for i in ids.ravel().tolist())


def located(expansion: Any, knots: Ids, x: Ids, closed: bool) -> Ids:
    """How many of the increasing `knots` are at most x, less one, as integers; see `_look_ups.Located`."""
    attribute = Located(_table(expansion, knots), closed)
    found = [expansion.graph.apply("locate", i, attribute=attribute) for i in expansion.real(x).ravel().tolist()]
    return expansion.map("convert", np.array(found, dtype=np.int64).reshape(x.shape), attribute="int32")


def looked_up(expansion: Any, x: Ids, indices: Ids, axes: Any, sizes: Any, missing: float | None) -> Ids:
    """The windows (*sizes) of an array that begin at `indices` (…, axes) along some axes, shape (…, *sizes).

    A window that sticks out begins where it fits; or is `missing`, where that is a number.
    """
    table, axes = _table(expansion, x), list(axes)
    room = [x.shape[axis] - sizes[axis] for axis in axes]
    strides = [math.prod(x.shape[axis + 1 :]) for axis in axes]
    place, inside = _place(expansion, indices, room, strides)
    window = np.arange(x.size).reshape(x.shape)[tuple(slice(0, size) for size in sizes)]
    last = room[0] if len(axes) == 1 else sum(top * stride for top, stride in zip(room, strides, strict=True))
    stride = strides[0] if len(axes) == 1 else 1
    result = np.empty((*place.shape, *window.shape), np.int64)
    for at in np.ndindex(*place.shape):
        for of in np.ndindex(*window.shape):
            entry = Table(table.first + int(window[of]) * table.stride, stride * table.stride, last + 1, table.numbers)
            result[(*at, *of)] = expansion.graph.apply("take", int(place[at]), attribute=entry)
    if missing is None:
        return result
    inside = inside.reshape(*place.shape, *[1] * window.ndim)
    return expansion.map("select", inside, expansion.constants(float(missing)), result)


def _place(expansion: Any, indices: Ids, room: list[int], strides: list[int]) -> tuple[Ids, Ids]:
    """Where windows begin, as floats: one index as it is, of several their place in the array; and which ones fit."""
    f, number, place, inside = expansion.map, expansion.constants, None, None
    for k, (top, stride) in enumerate(zip(room, strides, strict=True)):
        index = [_as_float(expansion.graph, i) for i in indices[..., k].ravel().tolist()]
        index = np.array(index, np.int64).reshape(indices.shape[:-1])
        fits = f("and", f("ge", index, number(0.0)), f("le", index, number(float(top))))
        inside = fits if inside is None else f("and", inside, fits)
        if len(room) > 1:  # of one alone the look-up takes care
            index = f("min", f("max", index, number(0.0)), number(float(top)))
            index = f("mul", index, number(float(stride)))
        place = index if place is None else f("add", place, index)
    assert place is not None and inside is not None  # there is an index to begin with
    return place, inside


def _as_float(graph: Graph, i: int) -> int:
    """An integer as a float. What it was computed by with integers is computed with floats: these are exact, too."""
    (op, operands, attribute), kind = graph.nodes[i], graph.kinds[i]
    if kind == "float":
        return i
    if op == "convert" and graph.kinds[operands[0]] == "float" and graph.nodes[operands[0]][0] in _WHOLE:
        return operands[0]
    if op == "convert" and graph.kinds[operands[0]] not in ("float", "bool"):
        return _as_float(graph, operands[0])
    if kind != "bool" and op in ("add", "sub", "mul", "neg", "max", "min"):
        return graph.apply(op, *(_as_float(graph, x) for x in operands))
    if kind != "bool" and op == "select":
        return graph.apply(op, _of_floats(graph, operands[0]), *(_as_float(graph, x) for x in operands[1:]))
    return graph.constant(attribute, "float") if op == "constant" else graph.apply("convert", i, attribute="float")


def _of_floats(graph: Graph, i: int) -> int:
    """A comparison of integers as one of floats."""
    op, operands, _ = graph.nodes[i]
    if op in ("lt", "le", "gt", "ge", "eq", "ne") and graph.kinds[operands[0]] not in ("float", "bool"):
        return graph.apply(op, *(_as_float(graph, x) for x in operands))
    return i


def _table(expansion: Any, x: Ids) -> Table:
    """The table whose entries are those of an array, in C order. Raises `Unlowerable` where there is none."""
    graph, ids = expansion.graph, x.ravel()
    if not ids.size:
        raise Unlowerable("an index into an array without elements depends on the values of the inputs")
    steps = np.diff(ids)
    stride = int(steps[0]) if steps.size else 1
    if ids.min() >= INPUTS and stride > 0 and (steps == stride).all():  # without a look at each of them
        if ids.max() < NUMBERS:
            return Table(int(ids[0]) - INPUTS, stride, ids.size)
        numbers, first = graph.array_of(int(ids[0]))
        if graph.array_of(int(ids[-1]))[1] == first:
            return Table(int(ids[0]) - first, stride, ids.size, numbers)
    positions = np.array([-1 if (p := graph.position(i)) is None else p for i in ids.tolist()])
    steps = np.diff(positions)
    stride = int(steps[0]) if steps.size else 1
    if (positions >= 0).all() and stride > 0 and (steps == stride).all():
        return Table(int(positions[0]), stride, ids.size)
    values = [graph.value(graph.real(i)) for i in ids.tolist()]
    if None not in values:
        return Table(0, 1, ids.size, np.array(values, np.float64).tobytes())
    raise Unlowerable(
        "an index depends on the values of the inputs, and the array that it looks into is computed from them: pass "
        "the array in params as it is to be looked into, or compute with the entry"
    )
