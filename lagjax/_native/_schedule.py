"""The order in which a large program runs, and where its numbers lie: alike operations side by side.

    operations   what the outputs need; a product that only one sum reads becomes one operation with that sum, as the
                 processor has it; sine and cosine of one angle are one operation with two results
    groups       the operations in an order that puts alike ones, none of which waits for another, next to each other
    slots        where every result lies, from when it is made until nobody reads it any more

Nothing here knows LLVM.
"""

from collections import Counter, defaultdict
from typing import NamedTuple

from lagjax._program._series import StraightLine

TIMES = 4, 2, 1
MOST = 16
WINDOW = 4096
ROUNDS, OFTEN, LARGEST = 12, 12, 10
JOINED = frozenset(("add", "sub", "mul", "neg", "div", "sqrt"))


class Kind(NamedTuple):
    """What an operation does: its name and attribute, and the kinds ("float", "bool", …) of operands and result.

    `parts` has an entry for each operand: the operation that it is the result of, if that belongs to this one, or None.
    """

    op: str
    attribute: object
    kinds: tuple[str, ...]
    result: str
    parts: "tuple[Kind | None, ...]" = (None,)

    @property
    def operands(self) -> int:
        """How many numbers it reads."""
        return sum(1 if part is None else part.operands for part in self.parts)

    @property
    def results(self) -> int:
        """How many numbers it makes."""
        return 2 if self.op == "sincos" else 1


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
    operations = _joined(_operations(line, uses), uses)
    outputs, copies = _outputs(line, operations)
    groups = _grouped(operations + copies)
    slots, size = _slots(groups, outputs, len(line.outputs))
    live = [i for i, count in enumerate(uses) if count]
    inputs = {i: nodes[i][2] for i in live if nodes[i][0] == "input"}
    constants = {i: float(nodes[i][2]) for i in live if nodes[i][0] == "constant"}
    return Schedule(groups, slots, size, inputs, constants)


# ---- operations ------------------------------------------------------------------------------------------------------


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


def _operations(line: StraightLine, uses: list[int]) -> list[Operation]:
    """The operations that the outputs need, each after those that it reads."""
    angles, operations = _angles(line, uses), []
    interned: dict[Kind, Kind] = {}
    for i, (op, operands, attribute) in enumerate(line.nodes):
        if not uses[i] or op in ("input", "constant"):
            continue
        results = (i,)
        if op in ("sin", "cos"):
            op, results = "sincos", tuple(angles[operands[0]])
            if i != min(x for x in results if x >= 0):
                continue
        kinds = tuple(line.kinds[x] for x in operands)
        kind = Kind(op, attribute, kinds, line.kinds[i], (None,) * len(operands))
        operations.append(Operation(interned.setdefault(kind, kind), operands, results))
    return operations


def _angles(line: StraightLine, uses: list[int]) -> dict[int, list[int]]:
    """For every angle the nodes of its sine and its cosine; -1 where that is not needed."""
    pairs: dict[int, list[int]] = {}
    for i, (op, operands, _) in enumerate(line.nodes):
        if uses[i] and op in ("sin", "cos"):
            pairs.setdefault(operands[0], [-1, -1])[op == "cos"] = i
    return pairs


def _outputs(line: StraightLine, operations: list[Operation]) -> tuple[dict[int, int], list[Operation]]:
    """Which output every node is, and the copies for outputs that no operation makes, or that are an earlier one too.

    Of a program of N nodes, a copy for output k is node N + k.
    """
    made = {x for operation in operations for x in operation.results}
    outputs: dict[int, int] = {}
    copies, copy = [], Kind("copy", None, ("float",), "float")
    for k, i in enumerate(line.outputs):
        if i in made and i not in outputs:
            outputs[i] = k
        else:
            outputs[len(line.nodes) + k] = k
            copies.append(Operation(copy, (i,), (len(line.nodes) + k,)))
    return outputs, copies


# ---- what comes often together ---------------------------------------------------------------------------------------


def _joined(operations: list[Operation], uses: list[int]) -> list[Operation]:
    """The operations, with a result that only one other reads computed inside that one, where such a pair comes often.

    Pairs of pairs come often too, and so on: as in byte-pair encoding, with trees for strings.
    """
    work = _Work({operation.results[0]: operation for operation in operations}, uses)
    work.join_products()
    for _ in range(ROUNDS):
        if not work.join(work.often()):
            break
    return [*work.operations.values()]


class _Work:
    """Operations by the node that they make, in order, some of which are joined to others."""

    def __init__(self, operations: dict[int, Operation], uses: list[int]):
        self.operations, self._uses = operations, uses
        self._joined: dict[tuple[Kind, int, Kind], Kind] = {}

    def _inner(self, x: int) -> Operation | None:
        """The operation that makes node x, if only one other reads it and it can be a part of that."""
        operation = self.operations.get(x) if self._uses[x] == 1 else None
        return operation if operation is not None and operation.kind.op in JOINED else None

    def join_products(self) -> None:
        """A product that only one sum reads is computed with that sum, as the processor has it, and rounded with it."""
        for i, operation in list(self.operations.items()):
            kind, operands, _ = operation
            if kind.op not in ("add", "sub") or kind.result != "float":
                continue
            place = next((k for k, x in enumerate(operands) if (inner := self._inner(x)) and inner.kind.op == "mul"), None)
            if place is not None:
                if kind.op == "add" and place == 1:
                    self.operations[i], place = operation._replace(operands=operands[::-1]), 0
                self._put(i, place)

    def often(self) -> dict[Kind, tuple[int, Kind]]:
        """The pairs that come most often: for kinds of operations the operand that is joined, and its kind."""
        pairs: Counter = Counter()
        for operation in self.operations.values():
            if operation.kind.op in JOINED:
                for place, x in enumerate(operation.operands):
                    if inner := self._inner(x):
                        pairs[operation.kind, place, inner.kind] += 1
        chosen: dict[Kind, tuple[int, Kind]] = {}
        inside: set[Kind] = set()
        for (kind, place, part), count in pairs.most_common():
            free = kind not in chosen and kind not in inside and (part not in chosen or part == kind)
            if count >= OFTEN and kind.operands + part.operands <= LARGEST and free:
                chosen[kind] = place, part
                inside.add(part)
        return chosen

    def join(self, chosen: dict[Kind, tuple[int, Kind]]) -> bool:
        """Join the operations that are such pairs; whether there are any."""
        for i, operation in list(self.operations.items()):
            if i in self.operations and operation.kind in chosen:
                place, part = chosen[operation.kind]
                inner = self._inner(operation.operands[place])
                if inner is not None and inner.kind == part:
                    self._put(i, place)
        return bool(chosen)

    def _put(self, i: int, place: int) -> None:
        """Compute the operand of operation i at this place inside it."""
        kind, operands, results = self.operations[i]
        inner = self.operations.pop(operands[place])
        key = kind, place, inner.kind
        if key not in self._joined:
            self._joined[key] = _with_part(*key)
        operands = operands[:place] + inner.operands + operands[place + 1 :]
        self.operations[i] = Operation(self._joined[key], operands, results)


def _with_part(kind: Kind, place: int, part: Kind) -> Kind:
    """The kind whose operand at this place, counted over all that it reads, is made by another."""
    parts = list(kind.parts)
    for k, inner in enumerate(parts):
        width = 1 if inner is None else inner.operands
        if place < width:
            parts[k] = part if inner is None else _with_part(inner, place, part)
            break
        place -= width
    return kind._replace(parts=tuple(parts))


# ---- order -----------------------------------------------------------------------------------------------------------


def _grouped(operations: list[Operation]) -> list[list[Operation]]:
    """Operations of one kind that do not wait for each other, in an order that respects all others.

    Of the next `WINDOW` operations, in the order in which the program has them, the kind goes first that fills a step
    of the loop and became ready last, for its operands are near; among kinds that do not, the one that comes nearest.
    """
    users, waiting = _edges(operations)
    ready: dict[Kind, list[int]] = defaultdict(list)
    since: dict[Kind, int] = defaultdict(int)
    groups, done, first, seen = [], [False] * len(operations), 0, 0
    while first < len(operations):
        while seen < min(len(operations), first + WINDOW):
            if not waiting[seen]:
                ready[operations[seen].kind].append(seen)
            seen += 1
        full = [kind for kind, some in ready.items() if len(some) >= TIMES[0]]
        kind = max(full, key=since.__getitem__) if full else max(ready, key=lambda kind: len(ready[kind]))
        count = min(MOST, len(ready[kind]) // TIMES[0] * TIMES[0]) or len(ready[kind])
        group = ready[kind][-count:]
        del ready[kind][-count:]
        groups.append([operations[k] for k in group])
        for k in group:
            done[k] = True
            for user in users[k]:
                waiting[user] -= 1
                if not waiting[user] and user < seen:
                    ready[operations[user].kind].append(user)
                    since[operations[user].kind] = len(groups)
        while first < len(operations) and done[first]:
            first += 1
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
