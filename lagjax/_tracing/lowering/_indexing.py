"""Arrays indexed by numbers that vary along the motion: look-ups in tables (`_look_ups`).

If the entries of the array are consecutive inputs of the program, or constants, an entry is read from memory, for any
length. Elementwise functions of such arrays are applied to their entries: (a x + b)[i] is a x[i] + b. In any other
array, a cumulative sum say, the entry is selected among all of them, if they are few. Constant indices are handled by
`_rules`.
"""

import math
from typing import Any

import numpy as np

from lagjax._program import INPUTS, NUMBERS, OPERATIONS, Graph, Located, Table, Unlowerable

# Entries among which one is chosen by comparisons. With 256 knots and values that are computed a first motion takes
# 0.9 s of a core, half a second more than with those of `params`, and a step takes 90 µs; both grow with their number.
LARGEST_CHOICE = 256
_MOST_COMPARED = 32  # knots, each a border of its own: with more of them, halving takes fewer
_MOST_BASES = 4  # numbers that entries may be combinations of, as a and b in a x + b: more is no table times a number
Ids = np.ndarray
_WHOLE = ("locate", "floor", "ceil", "round")  # operations whose result is a whole number


def are_numbers(expansion: Any, ids: Ids) -> bool:
    return all(expansion.graph.value(i) is not None for i in ids.ravel().tolist())


def locate_knots(expansion: Any, knots: Ids, x: Ids, closed: bool) -> Ids | None:
    """The number of increasing `knots` at most x, less one (`_look_ups.Located`); None if they are not a table."""
    table = _table_of_array(expansion, knots) if knots.size else None
    if table is None or table.stride < 0:
        return None
    attribute = Located(table, closed)
    found = [expansion.graph.apply("locate", i, attribute=attribute) for i in expansion.real(x).ravel().tolist()]
    return expansion.map("convert", np.array(found, dtype=np.int64).reshape(x.shape), attribute="int32")


def count_knots(expansion: Any, knots: Ids, x: Ids, side: str) -> Ids | None:
    """The number of increasing knots below x (`side` "left") or at most x; None for many knots without a table."""
    f, one = expansion.map, expansion.constants(np.int32(1))
    if side == "right":
        found = locate_knots(expansion, knots, x, closed=False)
        return None if found is None else f("add", found, one)
    if (found := locate_knots(expansion, f("neg", knots[::-1]), f("neg", x), closed=False)) is not None:
        return f("sub", expansion.constants(np.int32(len(knots) - 1)), found)
    if len(knots) > _MOST_COMPARED:
        return None
    below = f("lt", knots.reshape(-1, *[1] * x.ndim), np.broadcast_to(x, (len(knots), *x.shape)))
    return expansion.fold("add", f("convert", below, attribute="int32"))


def look_up_windows(expansion: Any, x: Ids, indices: Ids, axes: Any, sizes: Any, missing: Any) -> Ids:
    """The windows (*sizes) of an array that start at `indices` (…, axes) along some axes, shape (…, *sizes).

    A window that exceeds the array is moved inside; or is filled with `missing`, if that is a number.
    """
    if not x.size:
        raise Unlowerable("an index into an array without elements depends on the values of the inputs")
    axes, flat = list(axes), x.ravel()
    room = [x.shape[axis] - sizes[axis] for axis in axes]
    strides = [math.prod(x.shape[axis + 1 :]) for axis in axes]
    place, inside = _window_place(expansion, indices, room, strides)
    window = np.arange(x.size).reshape(x.shape)[tuple(slice(0, size) for size in sizes)]
    last = room[0] if len(axes) == 1 else sum(top * stride for top, stride in zip(room, strides, strict=True))
    stride = strides[0] if len(axes) == 1 else 1
    result = np.empty((*place.shape, *window.shape), np.int64)
    for of in np.ndindex(*window.shape):
        entries = flat[int(window[of]) + stride * np.arange(last + 1)]
        for at in np.ndindex(*place.shape):
            result[(*at, *of)] = _array_entry(expansion, entries, int(place[at]))
    if missing is None:
        return result
    inside = inside.reshape(*place.shape, *[1] * window.ndim)
    missing = expansion.graph.constant(missing, kind_of_ids(expansion.graph, x))
    return expansion.map("select", inside, np.array(missing), result)


def kind_of_ids(graph: Graph, x: Ids) -> str:
    """The kind of an array of ids; ids without nodes are floats."""
    return graph.kinds[x.flat[0]] if x.size and x.flat[0] < INPUTS else "float"


def _array_entry(expansion: Any, ids: Ids, place: int) -> int:
    """The node of the entry at `place`, a whole float, clipped to the array."""
    graph = expansion.graph
    if (table := _table_of_array(expansion, ids)) is not None:
        entry, kind = graph.apply("take", place, attribute=table), kind_of_ids(graph, ids)
        if kind == "bool":
            return graph.apply("ne", entry, graph.number(0.0))
        return entry if kind == "float" else graph.apply("convert", entry, attribute=kind)
    if (parts := _common_combination(graph, ids)) is not None:
        total = graph.number(0.0)
        for base, numbers in parts.items():
            factor = graph.apply("take", place, attribute=Table(0, 1, ids.size, numbers.tobytes()))
            total = graph.apply("add", total, graph.apply("mul", factor, base))
        return total
    if (columns := _common_operands(graph, ids)) is not None:
        op, _, attribute = graph.nodes[ids[0]]
        operands = [int(of[0]) if (of == of[0]).all() else _array_entry(expansion, of, place) for of in columns]
        return graph.apply(op, *operands, attribute=attribute)
    if ids.size > LARGEST_CHOICE:
        raise Unlowerable(
            f"an index depends on the values of the inputs, and the {ids.size} entries of the array that it looks into "
            f"are computed from them, not one by one: pass the array in params as it is to be looked into, or one of "
            f"at most {LARGEST_CHOICE} entries"
        )
    expansion.work(ids.size)
    found = graph.real(int(ids[0]))
    for k in range(1, ids.size):
        beyond = graph.apply("ge", place, graph.number(float(k)))
        found = graph.apply("select", beyond, found, graph.real(int(ids[k])))
    return found


def _common_combination(graph: Graph, ids: Ids) -> dict[int, np.ndarray] | None:
    """The coefficients, by base, if all scalars are linear combinations of the same few; else None."""
    if ids.max() >= INPUTS or any(graph.kinds[i] != "float" for i in ids.tolist()):
        return None
    terms: list[dict[int, float]] = []
    bases: dict[int, None] = {}
    for i in ids.tolist():
        terms.append(graph.terms(i))
        bases |= dict.fromkeys(terms[-1])
        if len(bases) > _MOST_BASES:
            return None
    return {base: np.array([of.get(base, 0.0) for of in terms]) for base in bases}


def _common_operands(graph: Graph, ids: Ids) -> list[Ids] | None:
    """The arrays of operands, if all scalars are results of the same operation; else None."""
    if ids.max() >= INPUTS:
        return None
    nodes = [graph.nodes[i] for i in ids.tolist()]
    op, operands, attribute = nodes[0]
    if not operands or any(node[0] != op or node[2] != attribute for node in nodes):
        return None
    if op == "convert" and len({graph.kinds[of] for _, (of,), _ in nodes}) > 1:
        return None
    columns = np.array([node[1] for node in nodes]).T
    if OPERATIONS[op].commutative and not (columns == columns[:, :1]).all(axis=1).any():  # written in either order
        for shared in columns[:, 0]:
            if (columns == shared).any(axis=0).all():
                others = np.where(columns[0] == shared, columns[1], columns[0])
                return [np.full_like(others, shared), others]
    return list(columns)


def _window_place(expansion: Any, indices: Ids, room: list[int], strides: list[int]) -> tuple[Ids, Ids]:
    """The first index of each window (or its offset in the flat array) as a float, and a flag that the window fits."""
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
    """An integer node as a float; the integer operations that computed it become float ones, which are exact too."""
    if i not in graph.floats:
        graph.floats[i] = _compute_as_float(graph, i)
    return graph.floats[i]


def _compute_as_float(graph: Graph, i: int) -> int:
    (op, operands, attribute), kind = graph.nodes[i], graph.kinds[i]
    if kind == "float":
        return i
    if op == "convert" and graph.kinds[operands[0]] == "float" and graph.nodes[operands[0]][0] in _WHOLE:
        return operands[0]
    if kind != "bool" and np.iinfo(kind).bits < 32:  # it wraps
        return graph.apply("convert", i, attribute="float")
    if op == "convert" and graph.kinds[operands[0]] not in ("float", "bool"):
        return _as_float(graph, operands[0])
    if kind != "bool" and op in ("add", "sub", "mul", "neg", "max", "min"):
        return graph.apply(op, *(_as_float(graph, x) for x in operands))
    if kind != "bool" and op == "select":
        return graph.apply(op, _compare_floats(graph, operands[0]), *(_as_float(graph, x) for x in operands[1:]))
    return graph.number(attribute) if op == "constant" else graph.apply("convert", i, attribute="float")


def _compare_floats(graph: Graph, i: int) -> int:
    """A comparison of integers as one of floats."""
    op, operands, _ = graph.nodes[i]
    if op in ("lt", "le", "gt", "ge", "eq", "ne") and graph.kinds[operands[0]] not in ("float", "bool"):
        return graph.apply(op, *(_as_float(graph, x) for x in operands))
    return i


def _table_of_array(expansion: Any, x: Ids) -> Table | None:
    """The table whose entries are those of an array, in C order; None if there is none, or its entries vary."""
    table = _table_of_ids(expansion.graph, x.ravel())
    return (
        None if table is not None and table.numbers is None and min(table.positions) < expansion.graph.moving else table
    )


def _table_of_ids(graph: Graph, ids: Ids) -> Table | None:
    steps = np.diff(ids)
    stride = int(steps[0]) if steps.size else 1
    if ids.min() >= INPUTS and stride and (steps == stride).all():  # without a look at each of them
        if ids.max() < NUMBERS:
            return Table(int(ids[0]) - INPUTS, stride, ids.size)
        numbers, first = graph.array_of(int(ids[0]))
        if stride > 0 and graph.array_of(int(ids[-1]))[1] == first:
            return Table(int(ids[0]) - first, stride, ids.size, numbers)
    positions = np.array([-1 if (p := graph.position(i)) is None else p for i in ids.tolist()])
    steps = np.diff(positions)
    stride = int(steps[0]) if steps.size else 1
    if (positions >= 0).all() and stride and (steps == stride).all():
        return Table(int(positions[0]), stride, ids.size)
    values = [None if INPUTS <= i < NUMBERS else graph.value(graph.real(i)) for i in ids.tolist()]
    if None not in values and all(abs(x) <= 2**53 for x in values if isinstance(x, int)):  # a float holds them
        return Table(0, 1, ids.size, np.array(values, np.float64).tobytes())
    return None
