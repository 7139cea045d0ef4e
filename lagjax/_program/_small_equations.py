"""Small or sparse linear equations whose entries are nodes of a graph."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from lagjax._program._graph import Graph

# Borders that are not independent share what they hold as if they yielded by `SOFT`, relative; the remaining error is
# corrected `REFINEMENTS` times. The share of what no border holds alone is as exact as rounding, divided by it.
SOFT, REFINEMENTS = 1e-9, 2

Sparse = dict[int, int]  # the nodes of a vector by their place in it; what is not there is zero


class Eliminated(NamedTuple):
    """The factors of a linear system, and its rows `whole` where it is regularised (`SOFT`) and needs refinement."""

    factors: list[Sparse]
    whole: list[Sparse]

    def solve(self, graph: Graph, right: Sequence[int]) -> list[int]:
        x = substitute(graph, self.factors, right)
        for _ in range(REFINEMENTS if self.whole else 0):
            products = (dot(graph, row.values(), [x[j] for j in row]) for row in self.whole)
            left = [graph.apply("sub", b, product) for b, product in zip(right, products, strict=True)]
            more = substitute(graph, self.factors, left)
            x = [graph.apply("add", a, b) for a, b in zip(x, more, strict=True)]
        return x


def constants(graph: Graph, row: Sparse) -> dict[int, float | None]:
    """The entries of a sparse row that are not identically zero: their constant values, or None where they vary."""
    values = {i: graph.value(d) for i, d in row.items()}
    return {i: value for i, value in values.items() if value != 0}


def drop_entry(row: Sparse, place: int) -> Sparse:
    return {i: x for i, x in row.items() if i != place}


def transpose(rows: Sequence[Sparse], count: int) -> list[Sparse]:
    """The first `count` columns of a sparse matrix given by rows, as sparse rows."""
    columns: list[Sparse] = [{} for _ in range(count)]
    for k, row in enumerate(rows):
        for i, x in row.items():
            if i < count:
                columns[i][k] = x
    return columns


def find_groups(rows: Sequence[Sparse], count: int) -> list[int]:
    """A group number for each row: the connected components of rows that share one of the `count` columns."""
    places = np.array([(k, len(rows) + i) for k, row in enumerate(rows) for i in row], int).reshape(-1, 2).T
    size = len(rows) + count
    graph = scipy.sparse.coo_array((np.ones(places.shape[1]), tuple(places)), (size, size))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1][: len(rows)].tolist()


def sparse_row(graph: Graph, xs: Iterable[int]) -> Sparse:
    zero = graph.number(0.0)
    return {i: x for i, x in enumerate(xs) if x != zero}


def dot(graph: Graph, xs: Iterable[int], ys: Iterable[int]) -> int:
    total = zero = graph.number(0.0)
    for x, y in zip(xs, ys, strict=True):
        if zero not in (x, y):  # as nearly all are where many borders know nothing of each other
            total = graph.apply("add", total, graph.apply("mul", x, y))
    return total


def eliminate(graph: Graph, rows: list[Sparse]) -> list[Sparse]:
    """LU factors of a sparse matrix by rows, in place and without pivoting; the unit diagonal of L is not stored."""
    f, zero = graph.apply, graph.number(0.0)
    readers = [set(column) for column in transpose(rows, len(rows))]
    for k, pivot in enumerate(rows):
        ahead = sorted(j for j in pivot if j > k)
        for i in sorted(i for i in readers[k] if i > k):
            row = rows[i]
            row[k] = factor = f("div", row[k], pivot.get(k, zero))
            for j in ahead:
                row[j] = f("sub", row.get(j, zero), f("mul", factor, pivot[j]))
                readers[j].add(i)
    return rows


def substitute(graph: Graph, rows: Sequence[Sparse], right: Sequence[int]) -> list[int]:
    """The solution x of A x = b by substitution; `rows` are the factors from `eliminate`, `right` is b."""
    f, x, zero = graph.apply, list(right), graph.number(0.0)
    for i, row in enumerate(rows):
        for k in sorted(k for k in row if k < i):
            x[i] = f("sub", x[i], f("mul", row[k], x[k]))
    for i in range(len(rows) - 1, -1, -1):
        for j in sorted(j for j in rows[i] if j > i):
            x[i] = f("sub", x[i], f("mul", rows[i][j], x[j]))
        x[i] = f("div", x[i], rows[i].get(i, zero))
    return x
