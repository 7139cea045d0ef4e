"""The accelerations along borders that a motion slides on, and the projection of its state onto them.

The equations for the shares leave rounding errors, which a body at rest would integrate to ½ ε t². So the acceleration
of one coordinate per border, its *pivot*, is computed from u̇ = 0: exactly zero where u is a velocity. And a step
begins on its borders: the *retraction* moves the velocity to u = 0, in the direction of the border's force, and the
position if u depends on it alone. Its derivative is that of a motion with a varied start: a displacement δu off the
border, to either side, is removed at once.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

from lagjax._program._differentiation import copy_nodes
from lagjax._program._graph import Graph
from lagjax._program._passes import eliminate_dead_code
from lagjax._program._series import StraightLine
from lagjax._program._small_equations import Eliminated, Sparse, constants, dot, drop_entry, transpose


class BorderEquations(NamedTuple):
    """Equations of borders that hold the motion: A z − Σ μₖ actsₖ = r, normalsₖ · z = endₖ; `equations` are those of μ.

    A pivot has: its border, its coordinate, 1 where it is free, and 1 / slope where the border holds.
    """

    acts: list[Sparse]
    normals: list[Sparse]
    equations: Eliminated
    pivots: list[tuple[int, int, int, int]]

    def rename(self, place: Callable[[int], int]) -> "BorderEquations":
        """The equations with node ids replaced by `place(id)`, for use in another graph."""

        def place_rows(rows: list[Sparse]) -> list[Sparse]:
            return [{i: place(x) for i, x in row.items()} for row in rows]

        acts, normals, *equations = map(place_rows, (self.acts, self.normals, *self.equations))
        pivots = [(k, i, place(free), place(inverse)) for k, i, free, inverse in self.pivots]
        return BorderEquations(acts, normals, Eliminated(*equations), pivots)

    def add_forces(self, graph: Graph, right: Sequence[int], mu: Sequence[int]) -> list[int]:
        """The right-hand side r with the border forces: r + Σ μₖ actsₖ."""
        pushed = list(right)
        for act, x in zip(self.acts, mu, strict=True):
            for i, c in act.items():
                pushed[i] = graph.apply("add", pushed[i], graph.apply("mul", c, x))
        return pushed

    def border_residuals(self, graph: Graph, z: Sequence[int], ends: Sequence[int]) -> list[int]:
        """The residuals endₖ − normalsₖ · z of the border equations."""
        rates = (dot(graph, d.values(), [z[i] for i in d]) for d in self.normals)
        return [graph.apply("sub", end, rate) for end, rate in zip(ends, rates, strict=True)]

    def refine(self, graph: Graph, solve: Callable, z: list[int], mu: list[int], ends) -> tuple[list[int], list[int]]:
        """One step of iterative refinement of z and μ for the border residuals; `solve(r)` gives z of A z = r."""
        more = self.equations.solve(graph, self.border_residuals(graph, z, ends))
        rest = solve(self.add_forces(graph, [graph.number(0.0)] * len(z), more))
        return (
            [graph.apply("add", *pair) for pair in zip(z, rest, strict=True)],
            [graph.apply("add", *pair) for pair in zip(mu, more, strict=True)],
        )

    def solve(self, graph: Graph, solve: Callable, right: Sequence[int], ends: Sequence[int]) -> list[int]:
        """The list z + μ that solves both equations; `solve(r)` gives z of A z = r, `ends` are the endₖ."""
        mu = self.equations.solve(graph, self.border_residuals(graph, solve(right), ends))
        z = solve(self.add_forces(graph, right, mu))
        if len(self.pivots) < len(self.acts):
            z, mu = self.refine(graph, solve, z, mu, ends)
        for k, i, free, inverse in self.pivots:
            others = drop_entry(self.normals[k], i)
            end = graph.apply("sub", ends[k], dot(graph, others.values(), [z[j] for j in others]))
            z[i] = graph.apply("add", graph.apply("mul", free, z[i]), graph.apply("mul", inverse, end))
        return z + mu


class HeldMotion:
    """The accelerations and the state (q, q̇) on the borders that hold: those whose flag in `pushed` is true.

    `slopes` are ∂u̇/∂q̈ of each border, `responses` the accelerations caused by each piece, `pivots` are from
    `choose_pivots`. The state starts as the inputs of the program; `set_back` changes it.
    """

    def __init__(self, graph: Graph, n: int, pushed: Sequence[int], slopes, responses, pivots):
        self.graph, self.n, self.pushed, self.slopes, self.responses = graph, n, pushed, slopes, responses
        self.zero, self.one = (graph.number(x) for x in (0.0, 1.0))
        self.divisors = [(k, i, graph.apply("select", pushed[k], self.one, slopes[k][i])) for k, i in pivots]
        self.of_coordinates = transpose(responses, n)
        self.state = {i: graph.input(i, "float") for i in range(2 * n)}

    def pivots(self) -> list[tuple[int, int, int, int]]:
        """For each pivot: border, coordinate, 1 where the pivot is free, and 1 / slope where the border holds."""
        f, zero, one = self.graph.apply, self.zero, self.one
        return [
            (k, i, f("select", self.pushed[k], one, zero), f("select", self.pushed[k], zero, f("div", one, divisor)))
            for k, i, divisor in self.divisors
        ]

    def solve_pivots(self, z: Sequence[int], rates: Sequence[int]) -> list[int]:
        """Accelerations z with those of the pivots replaced by the solution of Σ ∂u̇/∂q̈ᵢ q̈ᵢ = rateₖ."""
        f, z = self.graph.apply, list(z)
        for k, i, divisor in self.divisors:
            row = drop_entry(self.slopes[k], i)
            others = dot(self.graph, row.values(), [z[j] for j in row])
            z[i] = f("select", self.pushed[k], z[i], f("div", f("sub", rates[k], others), divisor))
        return z

    def set_back(
        self, first: int, which: Sequence[int], levels: Sequence[int], solve: Callable, pushed: Sequence[int]
    ) -> None:
        """Move the state, from index `first` on, so that the `levels` of the borders `which` become zero.

        `solve(levels)` gives multiples of `responses` that change the levels by these numbers where both sides push
        (`pushed`). Then the pivots alone remove what rounding and one Newton step leave.
        """
        f, state, n, pushed_of = self.graph.apply, self.state, self.n, dict(zip(which, pushed, strict=True))
        left = zip(which, self._evaluate_held(levels), strict=True)
        changes = solve([f("select", pushed_of[k], self.zero, level) for k, level in left])
        multiples = dict(zip(which, changes, strict=True))
        for i, of in enumerate(self.of_coordinates):
            some = [k for k in of if k in multiples]
            # A force that pushes onto no border may have no value beyond it, as sign(u) √(|u| + c) away from u = 0.
            along = [f("select", pushed_of[k], self.zero, of[k]) for k in some]
            moves = dot(self.graph, along, [multiples[k] for k in some])
            state[first + i] = f("sub", state[first + i], moves)
        left, moved = dict(zip(which, self._evaluate_held(levels), strict=True)), [self.zero] * n
        for k, i, divisor in self.divisors:
            if k in left:
                row = self.slopes[k]
                change = f("div", f("add", left[k], dot(self.graph, row.values(), [moved[j] for j in row])), divisor)
                before, change = state[first + i], f("neg", change)
                state[first + i] = f("select", pushed_of[k], before, f("add", before, change))
                moved[i] = f("add", moved[i], f("select", pushed_of[k], self.zero, change))

    def _evaluate_held(self, nodes: Sequence[int]) -> list[int]:
        graph = self.graph
        line = eliminate_dead_code(graph, nodes)
        places = copy_nodes(graph, line, lambda i, _: self.state.get(i))
        return [places[i] for i in line.outputs]

    def retraction_line(self) -> tuple[StraightLine, tuple[frozenset[int], ...]]:
        """The line from the inputs of the program to the state, and the set of coordinates that each border moves."""
        graph = self.graph
        line = eliminate_dead_code(graph, [self.state[i] for i in range(2 * self.n)])
        moved = ({i: x for i, x in response.items() if i < self.n} for response in self.responses)
        return line, tuple(frozenset(constants(graph, of)) for of in moved)


def choose_pivots(rows: Sequence[dict[int, float | None]]) -> list[tuple[int, int]]:
    """Choose pivots (border, coordinate), ordered so that setting one coordinate leaves earlier borders unchanged.

    `rows` has the nonzero slopes ∂u̇/∂q̈ᵢ of each border, None for those that vary. A pivot is alone in its row or has
    the largest constant there, so that rounding does not grow. A border may have none.
    """
    left, behind, times = dict(enumerate(rows)), [], Counter(i for row in rows for i in row)

    def is_free(k: int, i: int) -> bool:
        constants = {j: abs(x) for j, x in rows[k].items() if x is not None}
        leads = len(rows[k]) == 1 or (i in constants and constants[i] == max(constants.values()))
        return leads and times[i] == 1

    while (found := next(((k, i) for k, row in left.items() for i in row if is_free(k, i)), None)) is not None:
        behind.append(found)
        times.subtract(left.pop(found[0]).keys())
    return [(k, i) for k, row in left.items() for i in row if len(row) == 1] + behind[::-1]
