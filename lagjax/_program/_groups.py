"""The operations of a large straight line in groups of alike ones, each of which is one NumPy operation.

A node by itself costs a microsecond, whatever it is. The forces of 200 bodies on one another are 440 000 nodes of some
ten kinds: nodes of one operation whose operands come from earlier groups do not depend on each other, so that arrays of
a thousand of them cost little more than one.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lagjax._program._operations import LOOK_UPS, OPERATIONS, apply_in_numpy

# Nodes from which groups are tried, and how many times fewer groups there must be: one costs as much as ten nodes.
_LEAST, _FEWER = 2000, 20
# States beyond which the values of single nodes are arrays that are long enough.
MOST_STATES = 256
_NONE = np.empty(0, np.intp), np.empty(0, np.intp)
# Numbers that are held at a time, 16 MB: more states are taken in parts.
MOST_HELD = 2**21


class NodeGroup(NamedTuple):
    """Nodes of one operation and one kind: their rows among the values of that kind, and those of each operand."""

    op: str
    attribute: object
    kind: str
    rows: np.ndarray
    operands: tuple[tuple[str, np.ndarray], ...]


class Groups(NamedTuple):
    """A straight line in groups, in an order in which they can be evaluated.

    - `counts`: how many nodes each kind has.
    - `constants`: the rows of constants of each kind, and their values; `inputs`: the same with positions of inputs.
    - `outputs`: the rows of outputs of each kind, and their positions.
    """

    counts: dict[str, int]
    constants: dict[str, tuple[np.ndarray, np.ndarray]]
    inputs: dict[str, tuple[np.ndarray, np.ndarray]]
    groups: tuple[NodeGroup, ...]
    outputs: dict[str, tuple[np.ndarray, np.ndarray]]

    def kinds_of_inputs(self) -> dict[int, str]:
        """The kinds of the inputs that are read, by their positions."""
        return {i: kind for kind, (_, positions) in self.inputs.items() for i in positions.tolist()}

    def values(self, columns: Sequence, precision: np.dtype, states: int) -> dict[str, np.ndarray]:
        """The values of all nodes, (count, S) for each kind."""
        values = {
            kind: np.empty((count, states), precision if kind == "float" else kind)
            for kind, count in self.counts.items()
        }
        for kind, (rows, numbers) in self.constants.items():
            values[kind][rows] = numbers[:, None]
        for kind, (rows, positions) in self.inputs.items():
            for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
                values[kind][row] = columns[position]
        for group in self.groups:
            operands = [values[kind][rows] for kind, rows in group.operands]
            if group.op == "convert":
                found = operands[0].astype(values[group.kind].dtype)
            elif group.attribute is None:
                found = OPERATIONS[group.op].value(*operands)
            else:
                found = OPERATIONS[group.op].value(*operands, group.attribute)
            values[group.kind][group.rows] = found
        return values

    def transpose(
        self, values: dict[str, np.ndarray], cotangents: Sequence, states: int
    ) -> Iterator[tuple[int, np.ndarray]]:
        """The positions of the inputs to which something flows from the outputs, each with what does, (states,).

        The values are those of all the states, or of one that has as many cotangents.
        """
        flows, still = np.zeros((2, self.counts.get("float", 0)), bool)
        found = np.zeros((len(flows), states), values["float"].dtype)
        if "float" in self.constants:  # nothing flows on from these
            still[self.constants["float"][0]] = True
        rows, positions = self.outputs.get("float", _NONE)
        moving = ~still[rows]
        for row, position in zip(rows[moving].tolist(), positions[moving].tolist(), strict=True):
            if cotangents[position] is not None:
                found[row] += cotangents[position]
                flows[row] = True
        for group in reversed(self.groups):
            if group.kind != "float" or not flows[group.rows].any():
                continue
            # Where nothing flows there is no derivative: zero times an infinite one would be NaN.
            some = slice(None) if flows[group.rows].all() else flows[group.rows]
            rows = group.rows[some]
            operands = [values[kind][of[some]] for kind, of in group.operands]
            here, value = found[rows], values["float"][rows]
            for (kind, of), partial in zip(group.operands, OPERATIONS[group.op].transpose(), strict=False):
                if partial is None or kind != "float" or still[of[some]].all():
                    continue
                part = partial(apply_in_numpy, float, here, value, *operands)
                if part is not None:
                    _add(found, of[some], np.broadcast_to(part, here.shape))
                    flows[of[some]] = True
            flows[still] = False
        rows, positions = self.inputs.get("float", _NONE)
        for row, position in zip(rows.tolist(), positions.tolist(), strict=True):
            if flows[row]:
                yield position, found[row]


def _add(found: np.ndarray, rows: np.ndarray, parts: np.ndarray) -> None:
    """Add to rows, some of which may be there more than once."""
    order = np.argsort(rows, kind="stable")
    ordered = rows[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    if len(first) == len(rows):
        found[rows] += parts
    else:
        found[ordered[first]] += np.add.reduceat(parts[order], first, axis=0)


def groups_of(line) -> Groups | None:
    """The groups of a straight line; None where there would be too many of them, or where it has look-ups."""
    nodes, kinds, outputs = line
    if len(nodes) < _LEAST or any(op in LOOK_UPS for op, _, _ in nodes):
        return None
    rows, counts = [], {}
    for kind in kinds:
        rows.append(counts.get(kind, 0))
        counts[kind] = rows[-1] + 1
    levels: list[int] = []
    alike: dict[tuple, list[int]] = {}
    for k, (op, operands, attribute) in enumerate(nodes):
        level = 1 + max([levels[i] for i in operands], default=-1)
        levels.append(level)
        if op in ("constant", "input"):
            key = -1, op, None, kinds[k]
        else:
            key = level, op, attribute, kinds[k], *[kinds[i] for i in operands]
        alike.setdefault(key, []).append(k)
    if _FEWER * len(alike) > len(nodes):
        return None
    at = np.array(rows, dtype=np.intp)
    leaves: dict[str, dict] = {"constant": {}, "input": {}}
    of_outputs: dict[str, list[int]] = {}
    for position, i in enumerate(outputs):
        of_outputs.setdefault(kinds[i], []).append(position)
    ends = {kind: (at[[outputs[k] for k in places]], np.array(places)) for kind, places in of_outputs.items()}
    groups = []
    for key in sorted(alike, key=lambda key: key[0]):
        (_, op, attribute, kind), of_operands, members = key[:4], key[4:], alike[key]
        if op in leaves:
            leaves[op][kind] = at[members], np.array([nodes[k][2] for k in members])
            continue
        operands = np.array([nodes[k][1] for k in members], dtype=np.intp)
        each = tuple((of, at[operands[:, j]]) for j, of in enumerate(of_operands))
        groups.append(NodeGroup(op, attribute, kind, at[members], each))
    return Groups(counts, leaves["constant"], leaves["input"], tuple(groups), ends)
