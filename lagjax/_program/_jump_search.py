"""A search, at random states on borders, for the pieces with which a program jumps; a corner is continuous."""

from collections.abc import Callable, Sequence

import numpy as np

from lagjax._program._beginnings import decide_pieces
from lagjax._program._decisions import DecidedProgram
from lagjax._program._differentiation import copy_nodes, gradient_in
from lagjax._program._graph import Graph
from lagjax._program._look_ups import BESIDE, shift_look_up, table_of
from lagjax._program._operations import LOOK_UPS
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._rounding import rounding
from lagjax._program._series import StraightLine

_LARGEST_SEARCH = 60  # operations that one may become: a bound for errors
_STATES = 48  # at which a border is looked for: what jumps does so at nearly all of them
_ROUNDS, _STEPS = 4, 6  # of Newton's method, with the pieces of the state decided anew in between
# A difference of both sides counts as a jump where it is this many times as large as its rounding. The bound of the
# rounding is to first order, and the border is hit to some roundings: a corner was seen at 4 at most.
_NOISE, _HIT, _EPS = 1e3, 100.0, float(np.finfo(float).eps)


class BothSides:
    """Two copies of a line in one graph, `before` and `behind` a border: the same `size` inputs, m pieces each."""

    def __init__(self, graph: Graph, line: StraightLine, size: int, m: int):
        self.graph, self.line = graph, line
        self.before = copy_nodes(graph, line)
        self.behind = copy_nodes(graph, line, lambda i, _: None if i < size else graph.input(i + m, "float"))
        self._node_differences: dict[int, int] = {}

    def difference(self, i: int) -> int:
        """The node of the difference of node i, behind minus before the border; equal terms cancel exactly."""
        stack = [i]
        while stack:
            k = stack[-1]
            if k in self._node_differences:
                stack.pop()
                continue
            missing = [x for x in self._differing_operands(k) if x not in self._node_differences]
            if missing:
                stack += missing
            else:
                self._node_differences[k] = self._subtract_sides(k)
                stack.pop()
        return self._node_differences[i]

    def _differing_operands(self, k: int) -> list[int]:
        """The operands of node k whose differences determine that of k; empty if it has to be subtracted as a whole."""
        (op, operands, _), same = self.line.nodes[k], self._is_unchanged
        if same(k):
            return []
        if op in ("add", "sub", "neg", "mul"):
            return list(operands)
        if op == "div" and same(operands[1]):
            return [operands[0]]
        return list(operands[1:]) if op == "select" and same(operands[0]) else []

    def _is_unchanged(self, k: int) -> bool:
        return self.before[k] == self.behind[k]

    def _subtract_sides(self, k: int) -> int:
        """The node of the difference of node k between both sides, from the differences of its operands if possible."""
        f, (op, operands, _), parts = self.graph.apply, self.line.nodes[k], self._differing_operands(k)
        if self._is_unchanged(k):
            return self.graph.constant(0.0, "float")
        if not parts:
            return f("sub", self.behind[k], self.before[k])
        changes = [self._node_differences[x] for x in parts]
        if op == "mul":
            a, b = operands
            return f("add", f("mul", changes[0], self.behind[b]), f("mul", self.before[a], changes[1]))
        if op == "div":
            return f("div", changes[0], self.behind[operands[1]])
        return f("select", self.behind[operands[0]], *changes) if op == "select" else f(op, *changes)


class JumpSearch:
    """A search, at random states on their borders, for the pieces with which nodes of a program jump."""

    def __init__(self, decided: DecidedProgram):
        line, decide, self.decisions = decided.line, decide_pieces(decided, ()), decided.decisions
        self.moving, self.size, self.m = 2 * decided.n + 1, decided.first, len(decided.decisions)
        located = [a for op, _, a in (*line.nodes, *decide.nodes) if op in LOOK_UPS]
        tables = [table for table in map(table_of, located) if table.numbers is None]
        self.beside = self.size + 3 * self.m  # where numbers that are only looked up stand, behind all other inputs
        self.line, self.decide = self._shift_look_ups(line), self._shift_look_ups(decide)
        self.draw, self.tables = np.random.default_rng(0), [self._shift_table(table) for table in dict.fromkeys(tables)]

    def _shift_table(self, attribute):
        """The look-up attribute with its table moved to the columns of this search."""
        table = table_of(attribute)
        beside = table.numbers is None and table.first >= BESIDE
        return shift_look_up(attribute, self.beside - BESIDE) if beside else attribute

    def _shift_look_ups(self, line: StraightLine) -> StraightLine:
        nodes = ((op, of, self._shift_table(a) if op in LOOK_UPS else a) for op, of, a in line.nodes)
        return line.replace(nodes=tuple(nodes))

    def _draw_states(self, count: int) -> np.ndarray:
        """Random inputs (inputs, count); entries of tables that are parameters are increasing."""
        ends = [1 + max(table.positions) for table in self.tables]
        columns = self.draw.uniform(0.3, 1.2, (max([self.beside, *ends]), count))
        columns[: self.moving] *= self.draw.choice([-1.0, 1.0], (self.moving, count))
        for table in self.tables:
            columns[table.positions] = np.sort(self.draw.uniform(-1.5, 1.5, (table.count, count)), axis=0)
        return columns

    def _decide_pieces(self, columns: np.ndarray, given: np.ndarray, pieces: np.ndarray) -> np.ndarray:
        """The pieces (m, S) at S states; piece `given[s]` of state s is set to `pieces[s]` unless that is NaN."""
        m, first, states = self.m, self.size, np.arange(columns.shape[1])
        columns = columns.copy()
        columns[first : first + 2 * m] = 0.0
        columns[first + given, states] = np.nan_to_num(pieces)
        columns[first + m + given, states] = ~np.isnan(pieces)
        found = np.array(self.decide.evaluate(list(columns)))[:m]
        found[given, states] = np.where(np.isnan(pieces), found[given, states], pieces)
        return found

    def find(self, candidates: Sequence[int], nodes: Sequence[int]) -> dict[int, bool | None]:
        """For each candidate piece: does any of the nodes jump with it? None if no state on its border was found."""
        with np.errstate(all="ignore"):
            columns, near, blocks = self._locate_borders(candidates)
            values = np.array(self._node_differences(nodes).evaluate(list(columns)))
        change, noise = np.abs(values[: len(nodes)]), values[len(nodes) :]
        known = near & np.isfinite(change).all(axis=0) & np.isfinite(noise).all(axis=0)
        jumps = known & (change > _NOISE * _EPS * noise).any(axis=0)
        return {
            j: bool(jumps[block].any()) if known[block].any() else None
            for j, block in zip(candidates, blocks, strict=True)
        }

    def find_zeros(self, candidates: Sequence[int], node: int) -> list[bool]:
        """For each candidate piece: is the node zero on one side of its border, at all states found there?"""
        line = self._add_rounding(eliminate_dead_code(self.line, [node]), 1)
        with np.errstate(all="ignore"):
            columns, near, blocks = self._locate_borders(candidates)
            m, size = self.m, self.size
            behind = np.concatenate([columns[:size], columns[size + m : size + 2 * m], columns[size + 2 * m :]])
            zero = []
            for inputs in (columns, behind):
                value, error = line.evaluate(list(inputs))
                zero.append(
                    ~near | (np.abs(value) <= _HIT * _EPS * (error + np.abs(inputs[: self.moving]).max(axis=0)))
                )
        return [bool(near[block].any() and any(side[block].all() for side in zero)) for block in blocks]

    def _locate_borders(self, candidates) -> tuple[np.ndarray, np.ndarray, list[slice]]:
        """States on borders with the pieces of both sides (inputs, S), a mask (S,), the slice of each candidate."""
        m, size = self.m, self.size
        columns, given = self._draw_states(_STATES * len(candidates)), np.repeat(candidates, _STATES)
        lines, target = [], np.full((3, len(given)), np.nan)
        for j in candidates:  # switching number j, its rounding error, and its derivatives by q, q̇ and t
            line = eliminate_dead_code(self.line, [self.decisions[j].switch])
            lines.append(self._add_rounding(line, 1, range(self.moving)))
        blocks = [slice(k * _STATES, (k + 1) * _STATES) for k in range(len(candidates))]
        for turn in range(_ROUNDS):
            columns[size : size + m] = self._decide_pieces(columns, given, np.full(len(given), np.nan))
            for j, line, block in zip(candidates, lines, blocks, strict=True):
                here = columns[:, block]
                if not turn:
                    u = line.evaluate(list(here))[0]
                    target[:, block] = self.decisions[j].levels_near(u, self._table_entries(here), self.draw)
                for _ in range(_STEPS):
                    u, _, *slopes = line.evaluate(list(here))
                    step = (u - target[0, block]) / sum(s * s for s in slopes)
                    here[: self.moving] -= np.where(np.isfinite(step), step, 0.0) * np.array(slopes)
        near = np.zeros(len(given), bool)
        for line, block in zip(lines, blocks, strict=True):
            u, error, *_ = line.evaluate(list(columns[:, block]))
            near[block] = np.abs(u - target[0, block]) <= _HIT * _EPS * (error + np.abs(target[0, block]))
        for side in range(2):
            columns[size + side * m : size + (side + 1) * m] = self._decide_pieces(columns, given, target[1 + side])
        return columns, near, blocks

    def _table_entries(self, columns: np.ndarray) -> Callable:
        def entries(located, index: np.ndarray) -> np.ndarray:
            table = self._shift_table(table_of(located))
            if table.numbers is not None:
                return table.entries[index]
            return columns[table.first + table.stride * index, np.arange(len(index))]

        return entries

    def _node_differences(self, nodes: Sequence[int]) -> StraightLine:
        """The line of the differences of nodes between both sides of a border, followed by their rounding errors."""
        graph = Graph(_LARGEST_SEARCH * len(self.line.nodes) + 10_000)
        sides = BothSides(graph, self.line, self.size, self.m)
        changes = [sides.difference(i) for i in nodes]
        return self._add_rounding(eliminate_dead_code(graph, changes), len(changes))

    def _add_rounding(self, line: StraightLine, count: int, by: Sequence[int] = ()) -> StraightLine:
        graph = Graph(_LARGEST_SEARCH * len(line.nodes) + 10_000)
        places = copy_nodes(graph, line)
        errors = rounding(graph, line, places, self.moving)
        slopes = gradient_in(graph, line, places, line.outputs[0], by) if by else []
        outputs = [*(places[i] for i in line.outputs), *errors, *slopes]
        assert len(line.outputs) == count
        return eliminate_dead_code(graph, outputs)
