"""A straight-line program of scalar operations, and its evaluation in NumPy at many states at once.

Every node becomes one NumPy operation on a vector of states. That costs a microsecond per node and about a nanosecond
per node and state: less than XLA or LLVM take to compile, unless the program is evaluated millions of times.
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
    """A scalar program as a tuple of nodes in the order of execution; two lines are equal only if they are one object.

    The NumPy form is derived once and kept with the line. Its methods take one column per input: a number, (), or (1,),
    or one number per state, (S,). Floats have the precision of the float columns, and no floating-point error raises or
    warns.
    """

    nodes: tuple[Node, ...]
    kinds: tuple[str, ...]
    outputs: tuple[int, ...]

    def replace(self, **fields) -> "StraightLine":
        return replace(self, **fields)

    def constant(self, output: int) -> float | None:
        """The value of an output (given by its index) that does not depend on the inputs, else None."""
        op, _, attribute = self.nodes[self.outputs[output]]
        return attribute if op == "constant" else None

    @functools.cached_property
    def operations(self) -> int:
        return sum(op not in ("input", "constant") for op, _, _ in self.nodes)

    @functools.cached_property
    def looks_up(self) -> bool:
        """True if the line contains `take` or `locate` (see `_look_ups`)."""
        return any(op in LOOK_UPS for op, _, _ in self.nodes)

    def evaluate(self, columns: Sequence) -> np.ndarray:
        """The outputs at S states, shape (outputs, S); intermediate values are freed after their last use."""
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
        """The cotangent Σ cotangentₖ ∂outputₖ/∂input of every input, each (S,); None where no output depends on it.

        It transposes the operations as JAX does in reverse mode: NaN where the branch that `select` does not take has
        no derivative. Derivative rules of the user are not applied. A cotangent is a number, an array that broadcasts,
        or None.
        """
        columns, precision, count = self._prepare_columns(columns)
        states = max([count, *[np.size(x) for x in cotangents]])
        inputs: list = [None] * len(columns)
        size = max(1, min(CHUNK, _MOST_KEPT // (1 + len(self.nodes))))
        for part in (slice(start, min(start + size, states)) for start in range(0, states, size)):
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
        """For each float operand of node k that is not constant: its id, and the map g ↦ g ∂node/∂operand."""
        op, operands, _ = self.nodes[k]
        of = [values[i] for i in operands]
        for i, partial in zip(operands, OPERATIONS[op].transpose() if operands else (), strict=False):
            if partial is not None and self.kinds[i] == "float" and self.nodes[i][0] != "constant":
                yield i, lambda x, partial=partial: partial(apply_in_numpy, float, x, values[k], *of)

    # ---- what is derived from it ----

    @functools.cached_property
    def _numpy_steps(self) -> Callable[[np.dtype], list]:
        """A cached function from a precision to the list of NumPy calls that evaluates the line (`_steps_of`)."""
        return functools.cache(functools.partial(_steps_of, self))

    @functools.cached_property
    def _inputs(self) -> dict[int, str]:
        kinds = {node[2]: kind for node, kind in zip(self.nodes, self.kinds, strict=True) if node[0] == "input"}
        for op, _, attribute in self.nodes if self.looks_up else ():
            if op in LOOK_UPS:
                kinds = dict.fromkeys(table_of(attribute).positions, "float") | kinds
        return kinds

    def _prepare_columns(self, columns) -> tuple[list[np.ndarray], np.dtype, int]:
        """The columns as arrays of the kinds of their inputs, the precision of floats, and the number of states."""
        read = {i: np.asarray(columns[i]) for i in self._inputs}  # unused columns are passed on as they are
        floats = [x.dtype for i, x in read.items() if self._inputs[i] == "float"]
        precision = np.result_type(*floats) if floats else np.dtype(float)
        typed, sizes = list(columns), [np.size(x) for x in columns if getattr(x, "ndim", 0)]
        for i, x in read.items():
            typed[i] = x.astype(_dtype(self._inputs[i], precision), copy=False)
        return typed, precision, max(sizes, default=1)


def _cut(x, part: slice) -> Any:
    """The entries `part` of a column (S,); a number shared by all states, or None, is returned unchanged."""
    return x if x is None or np.size(x) == 1 else x[part]


def _dtype(kind: str, precision: np.dtype) -> np.dtype:
    return precision if kind == "float" else np.dtype(kind)


# ---- node by node ----------------------------------------------------------------------------------------------------


def _steps_of(line: StraightLine, precision) -> list[tuple[Callable | None, tuple, tuple[bool, Any], tuple[int, ...]]]:
    """For each node: its NumPy function, operands, attribute or constant, and the nodes whose values are freed then."""
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
