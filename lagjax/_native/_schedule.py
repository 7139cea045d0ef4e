"""The order in which a large program runs, and where its numbers lie: alike operations side by side.

    operations   what the outputs need; sine and cosine of one angle are one operation with two results
    joined       operations that often come together are one: a product and the sum that reads it, and then larger trees
    groups       an order that puts alike operations, none of which waits for another, next to each other
    slots        where every result lies, from its making to its last use

Nothing here knows LLVM.
"""

from collections import Counter, defaultdict
from typing import NamedTuple

from lagjax._native._constants import LARGEST_TREE, MOST, OFTEN, ROUNDS, TIMES, WINDOW
from lagjax._program._passes import count_uses
from lagjax._program._series import StraightLine

# What one operation may consist of; operands and results of these are of one kind.
_JOINED = frozenset(("add", "sub", "mul", "neg", "div", "sqrt"))


class OperationKind(NamedTuple):
    """The kind of an operation: its name and attribute, and the kinds ("float", "bool", …) of operands and result.

    `parts` has an entry for each operand: the operation that it is the result of, if that belongs to this one, or None.
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


class ScheduledOperation(NamedTuple):
    """An operation: its kind, as a number, the nodes that it reads, and those that it makes (-1: unused)."""

    kind: int
    operands: tuple[int, ...]
    results: tuple[int, ...]


class Schedule(NamedTuple):
    """A program in the order in which it runs.

    Every group holds operations of one of the `kinds`. Node i lies in slot `slots[i]`, of which there are `size`; the
    outputs that are `staying` lie in the first slots, in their order, and the others are stored: of a program of N
    nodes, output k is node N + k then, and has no slot. `inputs` gives the position of every node that is an input, and
    `constants` the number of one that is a number.
    """

    kinds: list[OperationKind]
    groups: list[list[ScheduledOperation]]
    slots: dict[int, int]
    staying: int
    size: int
    inputs: dict[int, int]
    constants: dict[int, float]


def schedule(line: StraightLine, stored: int) -> Schedule:
    """The order of the operations that the outputs of a program need, and the slots of their results.

    The last outputs, this many, are `stored` somewhere else as soon as they are there.
    """
    nodes, uses = line.nodes, count_uses(line.nodes, line.outputs)
    kinds, operations = join_operations(line)
    staying = len(line.outputs) - stored
    outputs, copies = _outputs(line, operations, kinds, staying)
    groups = _group_operations(_insert_copies(operations, copies))
    slots, size = _slots(groups, outputs, staying, len(nodes))
    live = [i for i, count in enumerate(uses) if count]
    inputs = {i: nodes[i][2] for i in live if nodes[i][0] == "input"}
    constants = {i: float(nodes[i][2]) for i in live if nodes[i][0] == "constant"}
    return Schedule(kinds.all, groups, slots, staying, size, inputs, constants)


def join_operations(line: StraightLine) -> "tuple[_Kinds, list[ScheduledOperation]]":
    """The operations that the outputs of a program need, each after those that it reads, and their kinds."""
    uses, kinds = count_uses(line.nodes, line.outputs), _Kinds()
    return kinds, _join_pairs(_operations(line, uses, kinds), uses, kinds)


# ---- operations ------------------------------------------------------------------------------------------------------


class _Kinds:
    """The kinds of the operations of a program, numbered as they come."""

    def __init__(self):
        self.all: list[OperationKind] = []
        self.operands: list[int] = []
        self._numbers: dict[OperationKind, int] = {}
        self._joined: dict[tuple[int, int, int], int] = {}

    def number(self, op: str, attribute: object, kinds: tuple[str, ...], result: str) -> int:
        """The number of a kind that consists of one operation."""
        return self._number(OperationKind(op, attribute, kinds, result, (None,) * len(kinds)))

    def join(self, kind: int, place: int, part: int) -> int:
        """The kind whose operand at this place, counted over all that it reads, is made by another."""
        key = kind, place, part
        if key not in self._joined:
            self._joined[key] = self._number(_insert_part(self.all[kind], place, self.all[part]))
        return self._joined[key]

    def _number(self, kind: OperationKind) -> int:
        number = self._numbers.setdefault(kind, len(self.all))
        if number == len(self.all):
            self.all.append(kind)
            self.operands.append(kind.operands)
        return number


def _insert_part(kind: OperationKind, place: int, part: OperationKind) -> OperationKind:
    parts = list(kind.parts)
    for k, inner in enumerate(parts):
        width = 1 if inner is None else inner.operands
        if place < width:
            parts[k] = part if inner is None else _insert_part(inner, place, part)
            break
        place -= width
    return kind._replace(parts=tuple(parts))


def _operations(line: StraightLine, uses: list[int], kinds: _Kinds) -> list[ScheduledOperation]:
    """The operations that the outputs need, each after those that it reads."""
    angles: dict[int, list[int]] = {}  # the nodes of the sine and the cosine of each; -1 where one is not needed
    for i, (op, operands, _) in enumerate(line.nodes):
        if uses[i] and op in ("sin", "cos"):
            angles.setdefault(operands[0], [-1, -1])[op == "cos"] = i
    operations, numbers = [], {}
    for i, (op, operands, attribute) in enumerate(line.nodes):
        if not uses[i] or op in ("input", "constant"):
            continue
        results = (i,)
        if op in ("sin", "cos"):
            op, results = "sincos", tuple(angles[operands[0]])
            if i != min(x for x in results if x >= 0):
                continue
        key = (
            (op, line.kinds[i]) if op in _JOINED else (op, attribute, *[line.kinds[x] for x in operands], line.kinds[i])
        )
        if key not in numbers:
            numbers[key] = kinds.number(op, attribute, tuple(line.kinds[x] for x in operands), line.kinds[i])
        operations.append(ScheduledOperation(numbers[key], operands, results))
    return operations


def _outputs(
    line: StraightLine, operations: list[ScheduledOperation], kinds: _Kinds, staying: int
) -> tuple[dict[int, int], list[ScheduledOperation]]:
    """The first outputs that every node is; and the copies for those that no operation makes, or that are an
    earlier output too, and for all other outputs.

    Of a program of N nodes, a copy for output k is node N + k.
    """
    made = {x for operation in operations for x in operation.results}
    outputs: dict[int, int] = {}
    copies, copy, store = [], *(kinds.number(op, None, ("float",), "float") for op in ("copy", "store"))
    for k, i in enumerate(line.outputs):
        if k >= staying:
            copies.append(ScheduledOperation(store, (i,), (len(line.nodes) + k,)))
        elif i in made and i not in outputs:
            outputs[i] = k
        else:
            outputs[len(line.nodes) + k] = k
            copies.append(ScheduledOperation(copy, (i,), (len(line.nodes) + k,)))
    return outputs, copies


def _insert_copies(operations: list[ScheduledOperation], copies: list[ScheduledOperation]) -> list[ScheduledOperation]:
    of: dict[int, list[ScheduledOperation]] = {}
    for copy in copies:
        of.setdefault(copy.operands[0], []).append(copy)
    ordered = []
    for operation in operations:
        ordered.append(operation)
        for x in operation.results:
            ordered += of.pop(x, [])
    return [copy for some in of.values() for copy in some] + ordered  # those of inputs and numbers first


# ---- what often comes together ---------------------------------------------------------------------------------------


def _join_pairs(operations: list[ScheduledOperation], uses: list[int], kinds: _Kinds) -> list[ScheduledOperation]:
    """The operations, with a result that only one other reads computed inside that one, where such a pair comes often.

    Pairs of pairs come often too, and so on: byte-pair encoding, with trees for strings. A product that only one sum
    reads always belongs to that sum, as the processor has it: in a straight line LLVM does the same.
    """
    work = _Work(operations, uses, kinds)
    work.join_products()
    for _ in range(ROUNDS):
        chosen = work.find_frequent_pairs()
        if not chosen:
            break
        work.join(chosen)
    return [operation for operation in work.by_node if operation is not None]


class _Work:
    """Operations by the node that they make, in order; those that have become a part of another are None."""

    def __init__(self, operations: list[ScheduledOperation], uses: list[int], kinds: _Kinds):
        self.by_node: list[ScheduledOperation | None] = [None] * len(uses)
        self._single, self._kinds = bytearray(len(uses)), kinds
        for operation in operations:
            first = max(operation.results) if min(operation.results) < 0 else min(operation.results)
            self.by_node[first] = operation
            # Whether only one other reads it, and it can be a part of that.
            self._single[first] = uses[first] == 1 and kinds.all[operation.kind].op in _JOINED
        # The nodes whose operation can have parts.
        self._open = [i for i, x in enumerate(self.by_node) if x and kinds.all[x.kind].op in _JOINED]

    def join_products(self) -> None:
        """Every product that only one sum reads is computed with that sum; the first one, of two."""
        for i in self._open:
            operation = self.by_node[i]
            assert operation is not None
            kind = self._kinds.all[operation.kind]
            if kind.op in ("add", "sub") and kind.result == "float":
                for place, x in enumerate(operation.operands):
                    if self._single[x] and self._kinds.all[self.by_node[x].kind].op == "mul":  # type: ignore[union-attr]
                        if kind.op == "add" and place == 1:  # one kind less
                            self.by_node[i], place = operation._replace(operands=operation.operands[::-1]), 0
                        self._put(i, place)
                        break

    def find_frequent_pairs(self) -> dict[int, tuple[int, int]]:
        """The pairs that come most often: for kinds of operations the operand that is joined, and its kind."""
        pairs: Counter = Counter()
        still = []
        for i in self._open:
            if (operation := self.by_node[i]) is not None:
                single = [(place, x) for place, x in enumerate(operation.operands) if self._single[x]]
                for place, x in single:
                    pairs[operation.kind, place, self.by_node[x].kind] += 1  # type: ignore[union-attr]
                if single:
                    still.append(i)
        self._open = still
        chosen: dict[int, tuple[int, int]] = {}
        inside: set[int] = set()
        size = self._kinds.operands
        for (kind, place, part), count in pairs.most_common():
            if count < OFTEN:
                break
            free = kind not in chosen and kind not in inside and (part not in chosen or part == kind)
            if free and size[kind] + size[part] <= LARGEST_TREE:
                chosen[kind] = place, part
                inside.add(part)
        return chosen

    def join(self, chosen: dict[int, tuple[int, int]]) -> None:
        """Join the operations that are such pairs."""
        for i in self._open:
            operation = self.by_node[i]
            if operation is not None and operation.kind in chosen:
                place, part = chosen[operation.kind]
                x = operation.operands[place]
                if self._single[x] and self.by_node[x].kind == part:  # type: ignore[union-attr]
                    self._put(i, place)

    def _put(self, i: int, place: int) -> None:
        """Compute the operand of the operation of node i at this place inside it."""
        operation = self.by_node[i]
        assert operation is not None
        kind, operands, results = operation
        x = operands[place]
        inner = self.by_node[x]
        assert inner is not None
        self.by_node[x] = None
        operands = operands[:place] + inner.operands + operands[place + 1 :]
        self.by_node[i] = ScheduledOperation(self._kinds.join(kind, place, inner.kind), operands, results)


# ---- order -----------------------------------------------------------------------------------------------------------


def _group_operations(operations: list[ScheduledOperation]) -> list[list[ScheduledOperation]]:
    """Operations of one kind that do not wait for each other, in an order that respects all others.

    Of the next `WINDOW` operations, in the order in which the program has them, the kind goes first that fills a step
    of the loop and became ready last, for its operands are near; among kinds that do not, the one that comes nearest.
    """
    users, waiting = _edges(operations)
    ready: dict[int, list[int]] = defaultdict(list)
    since: dict[int, int] = defaultdict(int)
    groups, done, first, seen = [], bytearray(len(operations)), 0, 0
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


def _edges(operations: list[ScheduledOperation]) -> tuple[list[list[int]], list[int]]:
    """The readers of every operation's results, as often as they read, and the number of operands it waits for."""
    maker = {x: k for k, operation in enumerate(operations) for x in operation.results}
    users: list[list[int]] = [[] for _ in operations]
    waiting = [0] * len(operations)
    for k, operation in enumerate(operations):
        for x in operation.operands:
            if x in maker:
                users[maker[x]].append(k)
                waiting[k] += 1
    return users, waiting


# ---- slots -----------------------------------------------------------------------------------------------------------


def _slots(
    groups: list[list[ScheduledOperation]], outputs: dict[int, int], count: int, nodes: int
) -> tuple[dict[int, int], int]:
    """A slot for every result, the one that became free last first; inputs and constants have none here.

    The first `count` outputs come first and keep theirs, and what is stored, from node `nodes` on, has none. Results of
    a group get their slots before its operands give theirs back: the group may read and write in any order.
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
