"""A straight line of scalar operations, and its values in NumPy: for many states at once, and without a compiler.

Every node becomes one NumPy operation on a vector of states. That costs a microsecond a node and about a nanosecond a
node and state: less than XLA or LLVM take to compile a program, as long as it is not evaluated millions of times.

The forces of 200 bodies on one another are 440 000 nodes of some ten kinds. Nodes of one operation whose operands come
from earlier groups do not depend on each other: such a group is one NumPy operation on arrays of its rows.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lagjax._program._graph import Node
from lagjax._program._look_ups import cotangents as cotangents_of_entries
from lagjax._program._look_ups import look_up, table_of
from lagjax._program._operations import LOOK_UPS, OPERATIONS, apply_in_numpy

# States looked at together. A value of 2048 states has 16 KB, so that some tens of live values stay in a core's second
# cache, and the microsecond that NumPy takes to begin an operation is no more than what the operation takes itself.
CHUNK = 2048
# Nodes from which groups are tried, and how many times fewer groups there must be: one costs as much as ten nodes.
_LEAST, _FEWER = 2000, 20
# States beyond which the values of single nodes are arrays that are long enough.
MOST_STATES = 256
# Numbers that groups hold at a time, 16 MB: more states are taken in parts.
MOST_HELD = 2**21
_NONE = np.empty(0, np.intp), np.empty(0, np.intp)


@dataclass(frozen=True, eq=False)
class StraightLine:
    """Operations in order, as in `Program`; as a key it is equal to nothing but itself.

    What NumPy needs of it is derived once and lives as long as the line. Its functions take one column for each input:
    a number, () or (1,), or one number for each of S states, (S,). Floats have the precision of the float columns, and
    nothing raises or warns.
    """

    nodes: tuple[Node, ...]
    kinds: tuple[str, ...]
    outputs: tuple[int, ...]

    def replace(self, **fields) -> "StraightLine":
        return replace(self, **fields)

    def constant(self, output: int) -> float | None:
        """The value of an output that does not depend on the inputs, else None."""
        op, _, attribute = self.nodes[self.outputs[output]]
        return attribute if op == "constant" else None

    @functools.cached_property
    def operations(self) -> int:
        return sum(op not in ("input", "constant") for op, _, _ in self.nodes)

    @functools.cached_property
    def looks_up(self) -> bool:
        """True if it reads tables (see `_look_ups`)."""
        return any(op in LOOK_UPS for op, _, _ in self.nodes)

    def evaluate(self, columns: Sequence) -> np.ndarray:
        """The outputs at many states, shape (outputs, S). Values are dropped as soon as nothing needs them."""
        columns, precision, count = self._prepare_columns(columns)
        results = np.empty((len(self.outputs), count), precision)
        if len(self.nodes) >= _LEAST and count <= MOST_STATES and _FEWER * len(self.groups.each) <= len(self.nodes):
            for part in self.groups.parts(count):
                values = self.groups.values([_cut(x, part) for x in columns], precision, part.stop - part.start)
                for kind, (rows, positions) in self.groups.outputs.items():
                    results[positions, part] = values[kind][rows]
            return results
        if precision not in self._steps:
            self._steps[precision] = _steps_of(self, precision)
        with np.errstate(all="ignore"):
            for start in range(0, count, CHUNK):
                part = columns if count <= CHUNK else [_cut(x, slice(start, start + CHUNK)) for x in columns]
                values = _values(self._steps[precision], part)
                for row, i in enumerate(self.outputs):
                    results[row, start : start + CHUNK] = values[i]
        return results

    def round_off(self, columns: Sequence) -> np.ndarray:
        """The rounding error of every output, to first order, shape (outputs, S); the inputs count as exact.

        Every operation adds one unit in the last place of its result to what its operands bring along: terms that
        cancel leave theirs behind. Source: Higham, *Accuracy and Stability of Numerical Algorithms*, §3.3.
        """
        columns, precision, count = self._prepare_columns(columns)
        results = np.zeros((len(self.outputs), count), precision)
        rows, positions = self.groups.outputs.get("float", _NONE)
        for part in self.groups.parts(count):
            values = self.groups.values([_cut(x, part) for x in columns], precision, part.stop - part.start)
            results[positions, part] = self.groups.round_off(values, float(np.finfo(precision).eps))[rows]
        return results

    def vjp(self, columns: Sequence, cotangents: Sequence) -> list:
        """Σ cotangentₖ ∂outputₖ/∂input for every input, each of shape (S,); None where nothing flows there.

        It is the derivative of this straight line of operations, in reverse as JAX would take it: NaN where a branch
        that `select` does not take has no derivative. A cotangent is a number, an array that broadcasts with the
        columns, or None.
        """
        columns, precision, count = self._prepare_columns(columns)
        states = max([count, *[np.size(x) for x in cotangents]])
        inputs: list = [None] * len(columns)
        for part in self.groups.parts(states):
            size, here = part.stop - part.start, [_cut(x, part) for x in columns]
            values = self.groups.values(here, precision, size if count > 1 else 1)
            flows = self.groups.transpose(values, [_cut(x, part) for x in cotangents], size)
            for i, flow in flows.items():
                if inputs[i] is None:
                    inputs[i] = np.zeros(states, precision)
                inputs[i][part] = flow
        return inputs

    # ---- what is derived from it ----

    @functools.cached_property
    def groups(self) -> "Groups":
        return Groups.from_line(self)

    @functools.cached_property
    def _steps(self) -> dict[np.dtype, list]:
        """Its calls of NumPy one after the other, by precision: they take longer to write down than to do."""
        return {}

    @functools.cached_property
    def _inputs(self) -> dict[int, str]:
        kinds = {node[2]: kind for node, kind in zip(self.nodes, self.kinds, strict=True) if node[0] == "input"}
        for op, _, attribute in self.nodes if self.looks_up else ():
            if op in LOOK_UPS:
                kinds |= dict.fromkeys(table_of(attribute).positions, "float")
        return kinds

    def _prepare_columns(self, columns) -> tuple[list[np.ndarray], np.dtype, int]:
        """The columns as arrays of their kinds, the precision of floats, and the number of states."""
        read = {i: np.asarray(columns[i]) for i in self._inputs}  # unused columns are passed on as they are
        floats = [x.dtype for i, x in read.items() if self._inputs[i] == "float"]
        precision = np.result_type(*floats) if floats else np.dtype(float)
        typed, sizes = list(columns), [np.size(x) for x in columns if getattr(x, "ndim", 0)]
        for i, x in read.items():
            typed[i] = x.astype(_dtype(self._inputs[i], precision), copy=False)
        return typed, precision, max(sizes, default=1)


def _cut(x, part: slice):
    """The numbers of some states; one that is shared by all states stays."""
    return x if x is None or np.size(x) == 1 else x[part]


def _dtype(kind: str, precision: np.dtype) -> np.dtype:
    return precision if kind == "float" else np.dtype(kind)


# ---- node by node ----------------------------------------------------------------------------------------------------


def _steps_of(line: StraightLine, precision) -> list[tuple[Callable | None, tuple, tuple[bool, Any], tuple[int, ...]]]:
    """The function of every node, its operands, attribute or constant, and the values that it is the last to use."""
    last = {i: k for k, (_, operands, _) in enumerate(line.nodes) for i in operands}
    kept, dropped = set(line.outputs), {}
    for i, k in last.items():
        if i not in kept:
            dropped.setdefault(k, []).append(i)
    steps = []
    for k, ((op, operands, attribute), kind) in enumerate(zip(line.nodes, line.kinds, strict=True)):
        if op == "constant":
            function, attribute = None, _dtype(kind, precision).type(attribute)
        elif op == "input":
            function = None
        elif op == "convert":
            function, attribute = _convert, _dtype(kind, precision)
        elif op in LOOK_UPS:
            function, attribute = look_up, (op, attribute)
        else:  # a division of floats without a look at the kind for every state
            function = np.divide if op == "div" and kind == "float" else OPERATIONS[op].value
        steps.append((function, operands, (op == "input", attribute), tuple(dropped.get(k, ()))))
    return steps


def _convert(x, dtype):
    return np.asarray(x).astype(dtype)


def _values(steps: list, columns: Sequence) -> list:
    values: list = [None] * len(steps)
    for k, (function, operands, (is_input, attribute), dropped) in enumerate(steps):
        if function is None:
            values[k] = columns[attribute] if is_input else attribute
        elif function is look_up:
            values[k] = function(*attribute, columns, values[operands[0]])
        elif attribute is None:
            values[k] = function(*[values[i] for i in operands])
        else:
            values[k] = function(*[values[i] for i in operands], attribute)
        for i in dropped:
            values[i] = None
    return values


# ---- group by group --------------------------------------------------------------------------------------------------


def group_by_level(operations: Iterable[tuple[Any, Sequence, Sequence]], nodes: int) -> dict[tuple, list[int]]:
    """Operations by (level, kind): those of one kind that wait for equally many others, and so not for each other.

    They are given by their kinds, the nodes that they read and those that they make (-1: none), of this many `nodes`.
    """
    levels, alike = [-1] * (nodes + 1), {}
    for k, (kind, operands, results) in enumerate(operations):
        level = 1 + max([levels[i] for i in operands], default=-1)
        for i in results:
            levels[i] = level
        alike.setdefault((level, kind), []).append(k)
    return alike


class NodeGroup(NamedTuple):
    """Nodes of one operation and one kind: their rows among the values of that kind, and those of each operand."""

    op: str
    attribute: Any
    kind: str
    rows: np.ndarray
    operands: tuple[tuple[str, np.ndarray], ...]


class Groups(NamedTuple):
    """A straight line in groups, `each` in an order in which they can be evaluated.

    - `counts`: how many nodes each kind has.
    - `constants`: the rows of constants of each kind, and their values; `inputs`: the same with positions of inputs.
    - `outputs`: the rows of outputs of each kind, and their positions.
    """

    counts: dict[str, int]
    constants: dict[str, tuple[np.ndarray, np.ndarray]]
    inputs: dict[str, tuple[np.ndarray, np.ndarray]]
    each: tuple[NodeGroup, ...]
    outputs: dict[str, tuple[np.ndarray, np.ndarray]]

    @classmethod
    def from_line(cls, line: StraightLine) -> "Groups":
        nodes, kinds, counts, each_row = line.nodes, line.kinds, {"float": 0}, []
        for kind in kinds:
            each_row.append(counts.get(kind, 0))
            counts[kind] = each_row[-1] + 1
        rows, leaves, groups = np.array(each_row, np.intp), {"constant": {}, "input": {}}, []
        alike = group_by_level(
            (
                ((op, attribute if operands else None, kinds[k], *[kinds[i] for i in operands]), operands, (k,))
                for k, (op, operands, attribute) in enumerate(nodes)
            ),
            len(nodes),
        )
        for level, key in sorted(alike, key=lambda key: key[0]):
            (op, attribute, kind, *of_operands), members = key, alike[level, key]
            if op in leaves:
                leaves[op][kind] = rows[members], np.array([nodes[k][2] for k in members])
                continue
            operands = np.array([nodes[k][1] for k in members], dtype=np.intp)
            each = tuple((of, rows[operands[:, j]]) for j, of in enumerate(of_operands))
            groups.append(NodeGroup(op, attribute, kind, rows[members], each))
        positions: dict[str, list[int]] = {}
        for position, i in enumerate(line.outputs):
            positions.setdefault(kinds[i], []).append(position)
        ends = {kind: (rows[[line.outputs[k] for k in of]], np.array(of)) for kind, of in positions.items()}
        return cls(counts, leaves["constant"], leaves["input"], tuple(groups), ends)

    def parts(self, count: int) -> list[slice]:
        """The states that are looked at together."""
        size = max(1, MOST_HELD // (1 + sum(self.counts.values())))
        return [slice(start, min(start + size, count)) for start in range(0, count, size)]

    @np.errstate(all="ignore")
    def values(self, columns: Sequence, precision: np.dtype, states: int) -> dict[str, np.ndarray]:
        """The values of all nodes, (count, S) for each kind."""
        values = {kind: np.empty((count, states), _dtype(kind, precision)) for kind, count in self.counts.items()}
        for kind, (rows, numbers) in self.constants.items():
            values[kind][rows] = numbers[:, None]
        for kind, (rows, positions) in self.inputs.items():
            for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
                values[kind][row] = columns[position]
        for op, attribute, kind, rows, of in self.each:
            operands = [values[of_operand][x] for of_operand, x in of]
            if op in LOOK_UPS:
                found = np.stack([look_up(op, attribute, columns, x) for x in operands[0]])
            elif op == "convert":
                found = operands[0]
            elif attribute is None:
                found = OPERATIONS[op].value(*operands)
            else:
                found = OPERATIONS[op].value(*operands, attribute)
            values[kind][rows] = found
        return values

    @np.errstate(all="ignore")
    def round_off(self, values: dict[str, np.ndarray], eps: float) -> np.ndarray:
        """The rounding errors of all floats with these values, (count, S)."""
        errors = np.zeros_like(values["float"])
        for op, _, kind, rows, of in self.each:
            if kind == "float":
                value, operands = values["float"][rows], [values[of_operand][x] for of_operand, x in of]
                error = np.zeros_like(value) if OPERATIONS[op].exact else eps * np.abs(value)
                for (of_operand, x), partial in zip(of, OPERATIONS[op].transpose(), strict=False):
                    if partial is not None and of_operand == "float" and (given := errors[x]).any():
                        moved = np.abs(partial(apply_in_numpy, float, given, value, *operands))
                        error += np.where(given == 0, 0.0, moved)
                errors[rows] = error
        return errors

    @np.errstate(all="ignore")
    def transpose(self, values: dict[str, np.ndarray], cotangents: Sequence, states: int) -> dict[int, np.ndarray]:
        """The cotangents of the inputs to which anything flows from those of the outputs, (states,), by position.

        The values are those of all the states, or of one that has as many cotangents.
        """
        flows, still = np.zeros((2, self.counts["float"]), bool)
        found, results = np.zeros((len(flows), states), values["float"].dtype), {}
        still[self.constants.get("float", _NONE)[0]] = True  # nothing flows on from constants
        for row, position in zip(*(x.tolist() for x in self.outputs.get("float", _NONE)), strict=True):
            if not still[row] and cotangents[position] is not None:
                found[row] += cotangents[position]
                flows[row] = True
        for op, attribute, kind, rows, of in reversed(self.each):
            if kind != "float" or not flows[rows].any():
                continue
            # Where nothing flows there is no derivative: zero times an infinite one would be NaN.
            some = slice(None) if flows[rows].all() else flows[rows]
            rows = rows[some]
            operands = [values[of_operand][x[some]] for of_operand, x in of]
            here, value = found[rows], values["float"][rows]
            if op == "take":
                for index, g in zip(operands[0], here, strict=True):
                    for i, flow in cotangents_of_entries(attribute, index, g).items():
                        results[i] = results.get(i, 0.0) + flow
            for (of_operand, x), partial in zip(of, OPERATIONS[op].transpose(), strict=False):
                if partial is not None and of_operand == "float" and not still[x[some]].all():
                    part = partial(apply_in_numpy, float, here, value, *operands)
                    _add_rows(found, x[some], np.broadcast_to(part, here.shape))
                    flows[x[some]] = True
            flows[still] = False
        for row, position in zip(*(x.tolist() for x in self.inputs.get("float", _NONE)), strict=True):
            if flows[row]:
                results[position] = results.get(position, 0.0) + found[row]
        return results


def _add_rows(found: np.ndarray, rows: np.ndarray, parts: np.ndarray) -> None:
    """Add to rows, some of which may be there more than once."""
    order = np.argsort(rows, kind="stable")
    first = np.flatnonzero(np.diff(rows[order], prepend=-1))
    if len(first) == len(rows):
        found[rows] += parts
    else:
        found[rows[order][first]] += np.add.reduceat(parts[order], first, axis=0)
