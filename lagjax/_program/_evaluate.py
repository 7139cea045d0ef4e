"""Straight lines of scalar operations at many points, one NumPy operation after the other: nothing is compiled."""

import math

import numpy as np

from lagjax._program._graph import FOLD

_CHUNK = 4096  # points at a time: the intermediate vectors of a long line then stay in the second cache
_ELEMENTWISE = {
    "erf": np.vectorize(math.erf, [float]),
    "erfc": np.vectorize(math.erfc, [float]),
}


def evaluate(line, columns) -> list[np.ndarray]:
    """The outputs of a straight line, each of shape (S,), from its inputs (inputs, S) at S points.

    Floats are float64. What is not finite at a point is not finite in its outputs; nothing raises or warns.
    """
    columns = np.asarray(columns)
    points = columns.shape[1]
    chunks = [_evaluate(line, columns[:, i : i + _CHUNK]) for i in range(0, max(points, 1), _CHUNK)]
    return [np.concatenate(pieces) for pieces in zip(*chunks, strict=True)]


def _evaluate(line, columns) -> list[np.ndarray]:
    last_use = _last_uses(line)
    values: list = [None] * len(line.nodes)
    with np.errstate(all="ignore"):
        for place, ((op, operands, attribute), kind) in enumerate(zip(line.nodes, line.kinds, strict=True)):
            dtype = np.dtype("float64" if kind == "float" else kind)
            if op == "input":
                value = columns[attribute]
            elif op == "constant":
                value = np.asarray(attribute)
            else:
                value = _apply(op, attribute, dtype, [values[i] for i in operands])
            values[place] = np.asarray(value, dtype)
            for i in operands:
                if last_use[i] == place:
                    values[i] = None
    return [np.broadcast_to(values[i], columns.shape[1:]) for i in line.outputs]


def _apply(op: str, attribute, dtype, operands):
    if op == "select":
        predicate, no, yes = operands
        return np.where(predicate, yes, no)
    if op == "div":
        return np.divide(*operands) if dtype.kind == "f" else _whole_quotient(*operands)
    if op in _ELEMENTWISE:
        return _ELEMENTWISE[op](operands[0])
    return FOLD[op](*operands, *(() if attribute is None else (attribute,)))


def _whole_quotient(a, b):
    """Towards zero, and −1 for a divisor of zero, as XLA has it."""
    safe = np.where(b == 0, 1, b)
    return np.where(b == 0, -1, np.trunc(np.divide(a, safe)))


def _last_uses(line) -> dict[int, int]:
    """For each node the last one that reads it; outputs are read for ever."""
    last = {i: place for place, (_, operands, _) in enumerate(line.nodes) for i in operands}
    return last | dict.fromkeys(line.outputs, len(line.nodes))
