"""A straight line of scalar operations, and its values in NumPy: for many states at once, and without a compiler.

Every node becomes one NumPy operation on a vector of states. That costs a microsecond a node and about a nanosecond a
node and state: less than XLA or LLVM take to compile a program, as long as it is not evaluated millions of times.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lagjax._program._graph import Node
from lagjax._program._look_ups import cotangents as cotangents_of_entries
from lagjax._program._look_ups import look_up, table_of
from lagjax._program._operations import LOOK_UPS, OPERATIONS, apply_in_numpy

# States looked at together. A value of 2048 states has 16 KB, so that some tens of live values stay in a core's second
# cache, and the microsecond that NumPy takes to begin an operation is no more than what the operation takes itself.
CHUNK = 2048
# Values of all nodes that are kept for a derivative at a time, 128 MB: more states are taken in parts. Doubled, nothing
# is faster: a part of a line of 10 000 nodes has 1700 states.
_MOST_KEPT = 2**24


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
        steps = self._numpy_steps(precision)
        with np.errstate(all="ignore"):
            for start in range(0, count, CHUNK):
                part = columns if count <= CHUNK else [_cut(x, slice(start, start + CHUNK)) for x in columns]
                values = _node_values(steps, part)
                for row, i in enumerate(self.outputs):
                    results[row, start : start + CHUNK] = values[i]
        return results

    @np.errstate(all="ignore")
    def vjp(self, columns: Sequence, cotangents: Sequence) -> list:
        """Σ cotangentₖ ∂outputₖ/∂input for every input, each of shape (S,); None where nothing flows there.

        It is the derivative of this straight line of operations, in reverse as JAX would take it: NaN where a branch
        that `select` does not take has no derivative. The user's own rules do not count. A cotangent is a number, an
        array that broadcasts with the columns, or None.
        """
        columns, precision, count = self._prepare_columns(columns)
        states = max([count, *[np.size(x) for x in cotangents]])
        inputs: list = [None] * len(columns)
        for part in self._line_parts(states):
            values = _node_values(self._numpy_steps(precision), [_cut(x, part) for x in columns], keep=True)
            flows: dict[int, Any] = {}
            for i, cotangent in zip(self.outputs, cotangents, strict=True):
                if cotangent is not None and self.kinds[i] == "float":
                    flows[i] = flows.get(i, 0.0) + np.broadcast_to(_cut(cotangent, part), part.stop - part.start)
            for k in range(len(self.nodes) - 1, -1, -1):
                (op, operands, attribute), flow = self.nodes[k], flows.pop(k, None)
                if flow is None:
                    continue
                here = {attribute: flow} if op == "input" else {}
                if op == "take":
                    here = cotangents_of_entries(attribute, values[operands[0]], flow)
                for i, x in here.items():
                    if inputs[i] is None:
                        inputs[i] = np.zeros(states, precision)
                    inputs[i][part] += x
                for i, partial in self._scaled_partials(k, values):
                    flows[i] = flows.get(i, 0.0) + partial(flow)
        return inputs

    def _scaled_partials(self, k: int, values: Sequence) -> Iterator[tuple[int, Callable]]:
        """The float operands of node k that are no constants, each with x ↦ x ∂node/∂operand at these values."""
        op, operands, _ = self.nodes[k]
        of = [values[i] for i in operands]
        for i, partial in zip(operands, OPERATIONS[op].transpose() if operands else (), strict=False):
            if partial is not None and self.kinds[i] == "float" and self.nodes[i][0] != "constant":
                yield i, lambda x, partial=partial: partial(apply_in_numpy, float, x, values[k], *of)

    def _line_parts(self, states: int) -> list[slice]:
        size = max(1, min(CHUNK, _MOST_KEPT // (1 + len(self.nodes))))
        return [slice(start, min(start + size, states)) for start in range(0, states, size)]

    # ---- what is derived from it ----

    @functools.cached_property
    def _numpy_steps(self) -> Callable[[np.dtype], list]:
        """Its calls of NumPy one after the other, by precision: they take longer to write down than to do."""
        return functools.cache(functools.partial(_steps_of, self))

    @functools.cached_property
    def _inputs(self) -> dict[int, str]:
        kinds = {node[2]: kind for node, kind in zip(self.nodes, self.kinds, strict=True) if node[0] == "input"}
        for op, _, attribute in self.nodes if self.looks_up else ():
            if op in LOOK_UPS:
                kinds = dict.fromkeys(table_of(attribute).positions, "float") | kinds
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


def _cut(x, part: slice) -> Any:
    """The entries of some states; a number that all states share is returned as it is."""
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
            function, attribute = (lambda x, dtype: np.asarray(x).astype(dtype)), _dtype(kind, precision)
        elif op in LOOK_UPS:
            function, attribute = look_up, (op, attribute)
        else:  # a division of floats without a look at the kind for every state
            function = np.divide if op == "div" and kind == "float" else OPERATIONS[op].value
        steps.append((function, operands, (op == "input", attribute), tuple(dropped.get(k, ()))))
    return steps


def _node_values(steps: list, columns: Sequence, keep: bool = False) -> list:
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
        for i in () if keep else dropped:
            values[i] = None
    return values
