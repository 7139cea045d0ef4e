"""Straight lines of scalar operations at many points, one NumPy operation after the other: nothing is compiled."""

import numpy as np

from lagjax._program._graph import FOLD

_CHUNK = 4096  # points at a time: the intermediate vectors of a long line then stay in the second cache


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
                extra = () if attribute is None else (attribute,)
                value = FOLD[op](*(values[i] for i in operands), *extra)
            values[place] = np.asarray(value, dtype)
            for i in operands:
                if last_use[i] == place:
                    values[i] = None
    return [np.broadcast_to(values[i], columns.shape[1:]) for i in line.outputs]


def _last_uses(line) -> dict[int, int]:
    """For each node the last one that reads it; outputs are read for ever."""
    last = {i: place for place, (_, operands, _) in enumerate(line.nodes) for i in operands}
    return last | dict.fromkeys(line.outputs, len(line.nodes))
