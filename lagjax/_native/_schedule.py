"""The order in which a large program runs, and where its numbers lie: alike operations side by side.

    operations   what the outputs need; a product that only one sum reads becomes one operation with that sum, as the
                 processor has it; sine and cosine of one angle are one operation with two results
    groups       the operations in an order that puts alike ones, none of which waits for another, next to each other
    slots        where every result lies, from when it is made until nobody reads it any more

Nothing here knows LLVM.
"""

from collections import defaultdict
from typing import NamedTuple

from lagjax._program._series import StraightLine

# Alike operations that run as one step of the loop, written out. Measured on chains of 8 to 24 pendulums and 6 to 20
# bodies in space: TODO
TIMES = 8
# Alike operations taken together at most, so that results are read while they are in the first caches.
MOST = 64


class Kind(NamedTuple):
    """What an operation does: its name and attribute, and the kinds ("float", "bool", …) of operands and result."""

    op: str
    attribute: object
    operands: tuple[str, ...]
    result: str
    results: int = 1


class Operation(NamedTuple):
    """An operation of a program: the nodes that it reads, and those that it makes (-1: nobody reads that one)."""

    kind: Kind
    operands: tuple[int, ...]
    results: tuple[int, ...]


class Schedule(NamedTuple):
    """A program in the order in which it runs.

    Node i lies in slot `slots[i]`, of which there are `size`; the outputs lie in the first slots, in their order.
    `inputs` gives the position of every node that is an input, and `constants` the number of one that is a number.
    """

    groups: list[list[Operation]]
    slots: dict[int, int]
    size: int
    inputs: dict[int, int]
    constants: dict[int, float]


def schedule(line: StraightLine) -> Schedule:
    """The order of the operations that the outputs of a program need, and the slots of their results."""
    nodes, uses = line.nodes, _uses(line)
    operations = _operations(line, uses)
    outputs, copies = _outputs(line, operations)
    groups = _grouped(operations + copies)
    slots, size = _slots(groups, outputs, len(line.outputs))
    live = [i for i, count in enumerate(uses) if count]
    inputs = {i: nodes[i][2] for i in live if nodes[i][0] == "input"}
    constants = {i: float(nodes[i][2]) for i in live if nodes[i][0] == "constant"}
    return Schedule(groups, slots, size, inputs, constants)


# ---- operations ------------------------------------------------------------------------------------------------------


def _operations(line: StraightLine, uses: list[int]) -> list[Operation]:
    """The operations that the outputs need, each after those that it reads."""
    nodes, kinds = line.nodes, line.kinds
    merged, pairs, operations = _merged(line, uses), _angles(line, uses), []
    gone = {product for product, _, _ in merged.values()}
    for i, (op, operands, attribute) in enumerate(nodes):
        if not uses[i] or i in gone or op in ("input", "constant"):
            continue
        if i in merged:
            _, name, operands = merged[i]
            operations.append(Operation(Kind(name, None, ("float",) * 3, "float"), operands, (i,)))
        elif op in ("sin", "cos"):
            pair = pairs[operands[0]]
            if i == min(x for x in pair if x >= 0):
                operations.append(Operation(Kind("sincos", None, ("float",), "float", 2), operands, tuple(pair)))
        else:
            kind = Kind(op, attribute, tuple(kinds[x] for x in operands), kinds[i])
            operations.append(Operation(kind, operands, (i,)))
    return operations


def _outputs(line: StraightLine, operations: list[Operation]) -> tuple[dict[int, int], list[Operation]]:
    """Which output every node is, and the copies for outputs that no operation makes, or that are an earlier one too.

    Of a program of N nodes, a copy for output k is node N + k.
    """
    made = {x for operation in operations for x in operation.results}
    outputs: dict[int, int] = {}
    copies = []
    for k, i in enumerate(line.outputs):
        if i in made and i not in outputs:
            outputs[i] = k
        else:
            outputs[len(line.nodes) + k] = k
            copies.append(Operation(Kind("copy", None, ("float",), "float"), (i,), (len(line.nodes) + k,)))
    return outputs, copies


def _uses(line: StraightLine) -> list[int]:
    """How often every node is read by what the outputs need, or is an output."""
    uses = [0] * len(line.nodes)
    for i in line.outputs:
        uses[i] += 1
    for i in range(len(line.nodes) - 1, -1, -1):
        if uses[i]:
            for x in line.nodes[i][1]:
                uses[x] += 1
    return uses


_MERGED = {("add", 0): "multiply_add", ("add", 1): "multiply_add",
           ("sub", 0): "multiply_subtract", ("sub", 1): "subtract_product"}  # fmt: skip


def _merged(line: StraightLine, uses: list[int]) -> dict[int, tuple[int, str, tuple[int, ...]]]:
    """The sums with a product that nothing else reads: the product, the operation of both, and what that reads."""
    merged, taken = {}, set()
    for i, (op, operands, _) in enumerate(line.nodes):
        if not uses[i] or op not in ("add", "sub") or line.kinds[i] != "float":
            continue
        for place, x in enumerate(operands):
            if line.nodes[x][0] == "mul" and uses[x] == 1 and x not in taken:
                taken.add(x)
                merged[i] = x, _MERGED[op, place], (*line.nodes[x][1], operands[1 - place])
                break
    return merged


def _angles(line: StraightLine, uses: list[int]) -> dict[int, list[int]]:
    """For every angle the nodes of its sine and its cosine; -1 where that is not needed."""
    pairs: dict[int, list[int]] = {}
    for i, (op, operands, _) in enumerate(line.nodes):
        if uses[i] and op in ("sin", "cos"):
            pairs.setdefault(operands[0], [-1, -1])[op == "cos"] = i
    return pairs


# ---- order -----------------------------------------------------------------------------------------------------------


def _grouped(operations: list[Operation]) -> list[list[Operation]]:
    """Operations of one kind that do not wait for each other, `MOST` at most, in an order that respects all others.

    The kind that became ready last goes first where it fills a step of the loop, for its operands are near; among kinds
    that do not, the one that comes nearest.
    """
    users, waiting = _edges(operations)
    ready: dict[Kind, list[int]] = defaultdict(list)
    for k in range(len(operations) - 1, -1, -1):
        if not waiting[k]:
            ready[operations[k].kind].append(k)
    groups, since, moment, left = [], dict.fromkeys(ready, 0), 0, len(operations)
    while left:
        full = [kind for kind, some in ready.items() if len(some) >= TIMES]
        kind = max(full, key=since.__getitem__) if full else max(ready, key=lambda kind: len(ready[kind]))
        group = ready[kind][-MOST:]
        del ready[kind][-MOST:]
        moment, left = moment + 1, left - len(group)
        groups.append([operations[k] for k in group])
        for k in group:
            for user in users[k]:
                waiting[user] -= 1
                if not waiting[user]:
                    ready[operations[user].kind].append(user)
                    since[operations[user].kind] = moment
    return groups


def _edges(operations: list[Operation]) -> tuple[list[list[int]], list[int]]:
    """For every operation those that read its results, and how many others it waits for."""
    maker = {x: k for k, operation in enumerate(operations) for x in operation.results}
    users: list[list[int]] = [[] for _ in operations]
    waiting = [0] * len(operations)
    for k, operation in enumerate(operations):
        for other in {maker[x] for x in operation.operands if x in maker}:
            users[other].append(k)
            waiting[k] += 1
    return users, waiting


# ---- slots -----------------------------------------------------------------------------------------------------------


def _slots(groups: list[list[Operation]], outputs: dict[int, int], count: int) -> tuple[dict[int, int], int]:
    """A slot for every result, the one that became free last first; inputs and constants have none here.

    The `count` outputs come first and keep theirs. Results of a group get their slots before its operands give theirs
    back: the group may read and write in any order.
    """
    slots, free, size = dict(outputs), [], count
    last = {x: g for g, group in enumerate(groups) for operation in group for x in operation.operands}
    for g, group in enumerate(groups):
        for x in (x for operation in group for x in operation.results if x >= 0 and x not in slots):
            if not free:
                free, size = [size], size + 1
            slots[x] = free.pop()
        done = {x for operation in group for x in operation.operands if last[x] == g and x in slots}
        free.extend(slots[x] for x in sorted(done) if slots[x] >= count)
    return slots, size
