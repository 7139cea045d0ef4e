"""The order of operations of a large program, and the memory slots of its results: equal operations are adjacent.

    operations   those that the outputs need; sine and cosine of one angle are one operation with two results
    joined       operations that often occur together become one: a product and its sum, and then larger trees
    groups       equal operations at the same depth, which are independent of each other
    slots        where every result is stored, from its computation to its last use

This file does not depend on LLVM.
"""

from collections import Counter
from typing import NamedTuple

from lagjax._native.code._constants import LARGEST_TREE, OFTEN, ROUNDS
from lagjax._program import StraightLine, count_uses

# What one operation may consist of; operands and results of these are of one kind.
_JOINED = frozenset(("add", "sub", "mul", "neg", "div", "sqrt"))


class OperationKind(NamedTuple):
    """A kind of operation: its name and attribute, and the kinds ("float", "bool", …) of its operands and its result.

    `parts` has one entry per operand: None, or the kind of the operation that computes it, joined into this one.
    """

    op: str
    attribute: object
    kinds: tuple[str, ...]
    result: str
    parts: "tuple[OperationKind | None, ...]"

    @property
    def operands(self) -> int:
        return sum(1 if part is None else part.operands for part in self.parts)

    @property
    def results(self) -> int:
        return 2 if self.op == "sincos" else 1


_Kinds = dict[OperationKind, int]  # the kinds of the operations of a program, numbered as they come


class ScheduledOperation(NamedTuple):
    """One operation: the number of its kind, the nodes that it reads, and those it computes (−1: unused)."""

    kind: int
    operands: tuple[int, ...]
    results: tuple[int, ...]


class Schedule(NamedTuple):
    """A program in the order of its execution.

    Each group has operations of one of the `kinds`. Node i is in slot `slots[i]` of `size` slots. The first `staying`
    outputs occupy the first slots in order; the rest are stored elsewhere: for a program of N nodes, output k is node N
    + k and has no slot. `inputs` maps a node to its input position, `constants` a node to its number.
    """

    kinds: list[OperationKind]
    groups: list[list[ScheduledOperation]]
    slots: dict[int, int]
    staying: int
    size: int
    inputs: dict[int, int]
    constants: dict[int, float]


def schedule(line: StraightLine, stored: int) -> Schedule:
    """The schedule of a line; its last `stored` outputs are stored elsewhere and get no slots."""
    nodes, uses = line.nodes, count_uses(line.nodes, line.outputs)
    kinds: _Kinds = {}
    operations = _join_pairs(_needed_operations(line, uses, kinds), uses, kinds)
    staying = len(line.outputs) - stored
    outputs, copies = _separate_outputs(line, operations, kinds, staying)
    operations += copies
    groups = _group_by_level(operations, len(nodes) + len(line.outputs))
    slots, size = _allocate_slots(groups, outputs, staying, len(nodes))
    live = [i for i, count in enumerate(uses) if count]
    inputs = {i: nodes[i][2] for i in live if nodes[i][0] == "input"}
    constants = {i: float(nodes[i][2]) for i in live if nodes[i][0] == "constant"}
    return Schedule(list(kinds), groups, slots, staying, size, inputs, constants)


# ---- operations ------------------------------------------------------------------------------------------------------


def _number(kinds: _Kinds, kind: OperationKind) -> int:
    return kinds.setdefault(kind, len(kinds))


def _needed_operations(line: StraightLine, uses: list[int], kinds: _Kinds) -> list[ScheduledOperation]:
    """The operations on which the outputs depend, operands first; sine and cosine of an angle are one."""
    angles: dict[int, list[int]] = {}  # the nodes of the sine and the cosine of each; -1 where one is not needed
    for i, (op, operands, _) in enumerate(line.nodes):
        if uses[i] and op in ("sin", "cos"):
            angles.setdefault(operands[0], [-1, -1])[op == "cos"] = i
    operations = []
    for i, (op, operands, attribute) in enumerate(line.nodes):
        if not uses[i] or op in ("input", "constant"):
            continue
        results = (i,)
        if op in ("sin", "cos"):
            op, results = "sincos", tuple(angles[operands[0]])
            if i != min(x for x in results if x >= 0):
                continue
        of = tuple(line.kinds[x] for x in operands)
        kind = _number(kinds, OperationKind(op, attribute, of, line.kinds[i], (None,) * len(of)))
        operations.append(ScheduledOperation(kind, operands, results))
    return operations


def _separate_outputs(
    line: StraightLine, operations: list[ScheduledOperation], kinds: _Kinds, staying: int
) -> tuple[dict[int, int], list[ScheduledOperation]]:
    """The node of each output, and copies: an output that repeats, or is no result, is copied to node N + k."""
    made = {x for operation in operations for x in operation.results}
    outputs: dict[int, int] = {}
    copies = []
    copy, store = (_number(kinds, OperationKind(op, None, ("float",), "float", (None,))) for op in ("copy", "store"))
    for k, i in enumerate(line.outputs):
        if k < staying and i in made and i not in outputs:
            outputs[i] = k
            continue
        if k < staying:
            outputs[len(line.nodes) + k] = k
        copies.append(ScheduledOperation(copy if k < staying else store, (i,), (len(line.nodes) + k,)))
    return outputs, copies


# ---- pairs that are fused --------------------------------------------------------------------------------------------


def _join_pairs(operations: list[ScheduledOperation], uses: list[int], kinds: _Kinds) -> list[ScheduledOperation]:
    """The operations with frequent pairs joined: a result with one reader is computed inside of it.

    Pairs of pairs are joined as well, and so on, as in byte-pair encoding, with trees in place of strings.
    """
    made = {max(operation.results): operation for operation in operations}
    ops = [kind.op for kind in kinds]
    joined = [i for i, operation in made.items() if ops[operation.kind] in _JOINED]
    once = {i for i in joined if uses[i] == 1}
    for _ in range(ROUNDS):
        pairs = Counter(
            (made[i].kind, place, made[x].kind)
            for i in joined if i in made for place, x in enumerate(made[i].operands) if x in once
        )  # fmt: skip
        if not (chosen := _frequent_pairs(pairs, kinds)):
            break
        for i in joined:
            if i in made and made[i].kind in chosen:
                kind, operands, results = made[i]
                place, part, tree = chosen[kind]
                x = operands[place]
                if x in once and made[x].kind == part:
                    operands = operands[:place] + made.pop(x).operands + operands[place + 1 :]
                    made[i] = ScheduledOperation(tree, operands, results)
    return list(made.values())


def _frequent_pairs(pairs: Counter, kinds: _Kinds) -> dict[int, tuple[int, int, int]]:
    """The most frequent pairs: {kind: (operand to join, its kind, the kind of both)}.

    In one round a kind either absorbs an operand or is absorbed, except in chains of one kind.
    """
    chosen: dict[int, tuple[int, int, int]] = {}
    parts, numbered = set(), list(kinds)
    for (kind, place, part), count in pairs.most_common():
        if count < OFTEN:
            break
        if kind not in chosen and kind not in parts and (part not in chosen or part == kind):
            tree = _insert_part(numbered[kind], place, numbered[part])
            if tree.operands <= LARGEST_TREE:
                chosen[kind] = place, part, _number(kinds, tree)
                parts.add(part)
    return chosen


def _insert_part(kind: OperationKind, place: int, part: OperationKind) -> OperationKind:
    """The kind in which the operand at this place is replaced by the operation `part` that computes it."""
    parts = list(kind.parts)
    for k, inner in enumerate(parts):
        width = 1 if inner is None else inner.operands
        if place < width:
            parts[k] = part if inner is None else _insert_part(inner, place, part)
            break
        place -= width
    return kind._replace(parts=tuple(parts))


# ---- groups ----------------------------------------------------------------------------------------------------------


def _group_by_level(operations: list[ScheduledOperation], nodes: int) -> list[list[ScheduledOperation]]:
    """Operations grouped by depth and kind, in order: operations of a group are independent of each other."""
    levels, alike = [-1] * (nodes + 1), {}  # the last one is that of results that are unused
    for operation in operations:
        level = 1 + max([levels[i] for i in operation.operands], default=-1)
        for i in operation.results:
            levels[i] = level
        alike.setdefault((level, operation.kind), []).append(operation)
    return [alike[level_and_kind] for level_and_kind in sorted(alike)]


# ---- slots -----------------------------------------------------------------------------------------------------------


def _allocate_slots(
    groups: list[list[ScheduledOperation]], outputs: dict[int, int], count: int, nodes: int
) -> tuple[dict[int, int], int]:
    """A slot for each result, most recently freed first, and the number of slots; inputs and constants get none.

    The first `count` outputs keep the first slots; nodes from number `nodes` on are stored elsewhere. Results of a
    group get slots before its operands free theirs, so that a group may read and write in any order.
    """
    slots, free, size = dict(outputs), [], count
    last = {x: g for g, group in enumerate(groups) for operation in group for x in operation.operands}
    for g, group in enumerate(groups):
        for x in (x for operation in group for x in operation.results if 0 <= x < nodes and x not in slots):
            if not free:
                free, size = [size], size + 1
            slots[x] = free.pop()
        done = {x for operation in group for x in operation.operands if last[x] == g and x in slots}
        free.extend(slots[x] for x in sorted(done) if slots[x] >= count)
    return slots, size
