"""A program in NumPy, for many states at once and without a compiler; and its transposed derivative.

Every node becomes one NumPy operation on a vector of states. That costs a microsecond a node and about a nanosecond a
node and state: less than XLA or LLVM take to compile a program, as long as it is not evaluated millions of times.
"""

from collections.abc import Callable, Sequence

import numpy as np

from lagjax._program._groups import MOST_HELD, MOST_STATES, Groups
from lagjax._program._look_ups import cotangents as of_entries
from lagjax._program._look_ups import look_up, table_of
from lagjax._program._operations import LOOK_UPS, OPERATIONS, apply_in_numpy

# States looked at together. A value of 2048 states has 16 KB, so that some tens of live values stay in a core's second
# cache, and the microsecond that NumPy takes to begin an operation is no more than what the operation takes itself.
CHUNK = 2048


def evaluate(line, columns: Sequence, steps: Callable | None = None, groups: Groups | None = None) -> np.ndarray:
    """The outputs of a straight line at many states, shape (outputs, S); nothing raises or warns.

    `steps` gives those of `steps_of` for a precision, where they are kept; of large lines `groups` are evaluated.

    `columns` holds one entry for each input: a number, () or (1,), or one number for each of S states, shape (S,).
    Floats have the precision of the float columns. Values are dropped as soon as nothing needs them.
    """
    columns, precision, count = _prepare_columns(line, columns, groups)
    results = np.empty((len(line.outputs), count), precision)
    if groups is not None and count <= MOST_STATES:
        for part in _parts(groups, count):
            with np.errstate(all="ignore"):
                values = groups.values([_cut(x, part) for x in columns], precision, part.stop - part.start)
            for kind, (rows, positions) in groups.outputs.items():
                results[positions, part] = values[kind][rows]
        return results
    sequence = steps_of(line, precision) if steps is None else steps(precision)
    with np.errstate(all="ignore"):
        for start in range(0, count, CHUNK):
            part = columns if count <= CHUNK else [_cut(x, slice(start, start + CHUNK)) for x in columns]
            values = _values(sequence, part)
            for row, i in enumerate(line.outputs):
                results[row, start : start + CHUNK] = values[i]
    return results


def _parts(groups: Groups, count: int) -> list[slice]:
    """The states that are looked at together."""
    size = max(1, MOST_HELD // sum(groups.counts.values()))
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


def _cut(x, part: slice):
    """The numbers of some states; one that is shared by all states stays."""
    return x if x is None or np.size(x) == 1 else x[part]


def _prepare_columns(line, columns, groups: Groups | None = None) -> tuple[list[np.ndarray], np.dtype, int]:
    """The columns as arrays of their kinds, the precision of floats, and the number of states."""
    of_input = _kinds_of_inputs(line) if groups is None else groups.kinds_of_inputs()
    read = {i: np.asarray(columns[i]) for i in of_input}  # unused columns are passed on as they are
    floats = [read[i].dtype for i, kind in of_input.items() if kind == "float"]
    precision = np.result_type(*floats) if floats else np.dtype(float)
    typed, sizes = list(columns), [np.size(x) for x in columns if getattr(x, "ndim", 0)]
    for i, x in read.items():
        typed[i] = x.astype(_dtype(of_input[i], precision), copy=False)
    return typed, precision, max(sizes, default=1)


def _kinds_of_inputs(line) -> dict[int, str]:
    of_input = {
        attribute: kind for (op, _, attribute), kind in zip(line.nodes, line.kinds, strict=True) if op == "input"
    }
    for op, _, attribute in line.nodes:
        if op in LOOK_UPS:
            of_input |= dict.fromkeys(table_of(attribute).positions, "float")
    return of_input


def _dtype(kind: str, precision: np.dtype) -> np.dtype:
    return precision if kind == "float" else np.dtype(kind)


def steps_of(line, precision) -> list[tuple[Callable | None, tuple, object, tuple[int, ...]]]:
    """The function of every node, its operands, attribute or constant, and the values that it is the last to use.

    `outputs` are never dropped.
    """
    nodes, kinds, outputs = line
    last = {i: k for k, (_, operands, _) in enumerate(nodes) for i in operands}
    kept, dropped = set(outputs), {}
    for i, k in last.items():
        if i not in kept:
            dropped.setdefault(k, []).append(i)
    steps = []
    for k, ((op, operands, attribute), kind) in enumerate(zip(nodes, kinds, strict=True)):
        if op == "constant":
            attribute = _dtype(kind, precision).type(attribute)
        elif op == "convert":
            attribute = _dtype(kind, precision)
        function = _BESIDE[op] if op in _BESIDE else OPERATIONS[op].value
        if op in LOOK_UPS:
            function, attribute = _LOOK_UP, (op, attribute)
        if op == "div" and kind == "float":  # without a look at the kind for every state
            function = np.divide
        steps.append((function, operands, (op == "input", attribute), tuple(dropped.get(k, ()))))
    return steps


def _convert(x, dtype):
    return np.asarray(x).astype(dtype)


def _LOOK_UP(x, attribute):
    raise AssertionError


_BESIDE: dict[str, Callable | None] = {"input": None, "constant": None, "convert": _convert}


def _values(steps, columns) -> list:
    """The value of every node; None for those that were dropped."""
    values: list = [None] * len(steps)
    for k, (function, operands, (is_input, attribute), dropped) in enumerate(steps):
        if function is None:
            values[k] = columns[attribute] if is_input else attribute
        elif function is _LOOK_UP:
            op, table = attribute
            values[k] = look_up(op, table, columns, values[operands[0]])
        elif attribute is None:
            values[k] = function(*[values[i] for i in operands])
        else:
            values[k] = function(*[values[i] for i in operands], attribute)
        for i in dropped:
            values[i] = None
    return values


# ---- round-off -------------------------------------------------------------------------------------------------------


def round_off(line, columns: Sequence) -> np.ndarray:
    """The rounding error of every output, to first order, shape (outputs, S); the inputs count as exact.

    Every operation adds one unit in the last place of its result to what its operands bring along: terms that cancel
    leave theirs behind. Source: Higham, *Accuracy and Stability of Numerical Algorithms*, §3.3 (running errors).
    """
    (nodes, kinds, outputs), (columns, precision, count) = line, _prepare_columns(line, columns)
    eps, errors = float(np.finfo(precision).eps), []
    with np.errstate(all="ignore"):
        values = _values(steps_of((nodes, kinds, range(len(nodes))), precision), columns)
        for (op, operands, _), kind, value in zip(nodes, kinds, values, strict=True):
            exact = not operands or OPERATIONS[op].exact
            error = 0.0 if kind != "float" or exact else eps * np.abs(value)
            for i, partial in zip(operands, _transpose(op), strict=False):
                if partial is not None and kind == "float" and np.any(errors[i]):
                    moved = np.abs(partial(apply_in_numpy, float, errors[i], value, *(values[j] for j in operands)))
                    error = error + np.where(errors[i] == 0, 0.0, moved)
            errors.append(error)
    return np.stack([np.broadcast_to(errors[i], count) for i in outputs])


# ---- the transposed derivative ---------------------------------------------------------------------------------------


def vjp(line, columns: Sequence, cotangents: Sequence, groups: Groups | None = None) -> list:
    """Σ cotangentₖ ∂outputₖ/∂input for every input, each a number or of shape (S,); None where nothing flows there.

    It is the derivative of this straight line of operations, in reverse as JAX would take it: NaN where a branch that
    `select` does not take has no derivative. Rules of the user's for the derivatives of a function are not in the
    straight line. A cotangent is a number, an array that broadcasts with the columns, or None. Of large lines the
    `groups` are evaluated.
    """
    (nodes, kinds, outputs), (columns, precision, count) = line, _prepare_columns(line, columns, groups)
    if groups is not None:
        return _vjp_of_groups(groups, columns, precision, count, cotangents)
    with np.errstate(all="ignore"):
        values = _values(steps_of((nodes, kinds, range(len(nodes))), precision), columns)
        of_nodes: list = [None] * len(nodes)
        for i, part in zip(outputs, cotangents, strict=True):
            _add(of_nodes, kinds, i, part)
        inputs: list = [None] * len(columns)
        for k in range(len(nodes) - 1, -1, -1):
            op, operands, attribute = nodes[k]
            if of_nodes[k] is None:
                continue
            if op == "input":
                inputs[attribute] = of_nodes[k] if inputs[attribute] is None else inputs[attribute] + of_nodes[k]
            if op == "take":
                for i, part in of_entries(attribute, values[operands[0]], of_nodes[k]).items():
                    inputs[i] = part if inputs[i] is None else inputs[i] + part
            for i, partial in zip(operands, _transpose(op), strict=False):
                if partial is not None and kinds[i] == "float" and nodes[i][0] != "constant":
                    _add(
                        of_nodes,
                        kinds,
                        i,
                        partial(apply_in_numpy, float, of_nodes[k], values[k], *(values[j] for j in operands)),
                    )
            of_nodes[k] = None
    return inputs


def _vjp_of_groups(groups: Groups, columns, precision, count: int, cotangents) -> list:
    inputs: list = [None] * len(columns)
    states = max([count, *[np.size(x) for x in cotangents]])
    for part in _parts(groups, states):
        size, here = part.stop - part.start, [_cut(x, part) for x in cotangents]
        with np.errstate(all="ignore"):
            values = groups.values([_cut(x, part) for x in columns], precision, size if count > 1 else 1)
            for i, flow in groups.transpose(values, here, size):
                if inputs[i] is None:
                    inputs[i] = np.zeros(states, precision)
                inputs[i][part] += flow
    return inputs


def _transpose(op: str) -> tuple:
    return () if op in ("input", "constant") else OPERATIONS[op].transpose()


def _add(cotangents: list, kinds, i: int, part) -> None:
    """Add to the cotangent of node i, which is None as long as nothing flows there."""
    if part is not None and kinds[i] == "float":
        cotangents[i] = part if cotangents[i] is None else cotangents[i] + part
