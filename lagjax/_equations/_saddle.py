"""The linear system behind every acceleration, on scalars: an elimination that keeps the zeros of its matrix.

    M x = b                     without constraints
    M x − Gᵀλ = b,   G x = c    with constraints: for z = (x, −λ),   A z = (b, c),   A = (M Gᵀ; G 0)

A mechanism couples a part to few others, but M⁻¹ and the Schur complement G M⁻¹ Gᵀ are full: to eliminate all of M and
then all constraints takes operations that grow with the cube of the number of links. Here a constraint is eliminated
after the last of its own coordinates, and all of them in an order with little fill-in (minimum degree: Tinney & Walker,
Proc. IEEE 55 (1967) 1801, scheme 2). A chain of n links then costs n times a link, a diagonal M one division for each
coordinate, and blocks of M stay separate.

A positive definite M needs no pivoting. What is left of M, once coordinates E and constraints C on E only are
eliminated, is the mass matrix of the other coordinates where those of E move freely under C. It lies between that
without C, which is M's own Schur complement, and that with E at rest, a block of M. The pivots of coordinates are
therefore positive, those of constraints negative or, where a constraint depends on those before it, zero; no entry
grows. The rank so found is that of the preceding rows of G, whose coordinates were all eliminated before.

The formulas work for vectors of `Scalars` and for arrays of JAX: each step takes a pivot, its column of L, and the
update of all remaining entries at once.
"""

import functools
import operator
from typing import Any

import numpy as np

from lagjax._equations._linear import rank_tolerance, singular_threshold
from lagjax._program import eliminate, sparse_row, substitute
from lagjax._tracing import Scalars, orthogonalize, row_weights, solve_orthogonalized
from lagjax._tracing import scalar_algebra as xp

# The part of a pivot that elimination has to leave for a matrix to count as regular in the regular-M variant: four
# digits of an acceleration may be lost, and twelve remain. Twice as large, a few more states take the general variant,
# three times as expensive; much smaller, the error of an acceleration would exceed the tolerances.
REGULAR = 1e-4

# Coordinates of the largest M that is solved without being positive definite: 12 000 operations, 2 CPU s of LLVM. With
# twice as many they would be eight times as many, and diffrax begins as soon.
LARGEST_INDEFINITE = 16


class SaddleElimination:
    """The solution of A z = (b, c) as straight-line arithmetic, for one pattern of zeros: M positive (semi)definite.

    `zeros` marks structural zeros of M (n, n) and G (m, n); m may be zero. M is `augmented` by GᵀW G, W diagonal,
    unless it is known to be regular: GᵀW G x = GᵀW c changes neither x nor λ. Redundant rows get λ = 0: the motion is
    the same, the multipliers are a solution but not the shortest. With `regular_only`, the regular-M variant of
    `Accelerations.program`, the saddle point counts as singular as soon as it loses digits: where M, or its restriction
    by the constraints, is within `REGULAR` of singular.

    If rows may be `released`, a released one has −1 on the diagonal and a zero row of G, so that its λ is zero.

    `entries` lists the row and column of entries that may be nonzero in M, on and below its diagonal, then in G, whose
    rows are numbered from n, and then the diagonal of rows that may be released: `factors` takes a vector in that
    order.
    """

    def __init__(self, zeros: tuple, dtype, augmented: bool, regular_only: bool, released: bool = False):
        mass, touched = (~x for x in zeros)
        self.dtype, self.augmented, self.regular_only, self.released = dtype, augmented, regular_only, released
        self.size = touched.shape[1]
        self.rows = [np.flatnonzero(row) for row in touched]
        parts = [np.argwhere(np.tril(mass | mass.T)), np.argwhere(touched) + [self.size, 0]]
        if released:
            diagonal = np.arange(self.size, self.size + len(touched))
            parts.append(np.stack([diagonal, diagonal], axis=1))
        self.entries = np.concatenate(parts)
        if augmented:
            mass = mass | ((touched.T.astype(float) @ touched.astype(float)) > 0)
        self.order, filled = elimination_order(mass, touched)
        self.massless = ~np.diagonal(mass)
        self._place_entries(filled)

    def _place_entries(self, filled: np.ndarray) -> None:
        """Assign slots of a vector to the entries of A on and below its diagonal: the diagonal, then L by columns."""
        total, place = len(self.order), np.argsort(self.order)
        self.slots = np.full((total, total), -1, np.int32)
        self.slots[range(total), range(total)] = range(total)
        self.below, self.count = {}, total
        for j in self.order:
            rows = np.flatnonzero(filled[j] & (place > place[j]))
            self.below[j] = rows = rows[np.argsort(place[rows])]
            self.slots[rows, j] = self.slots[j, rows] = np.arange(self.count, self.count + len(rows))
            self.count += len(rows)

    @property
    def operations(self) -> int:
        return sum(len(rows) * (len(rows) + 6) + 3 for rows in self.below.values())

    @property
    def solution_operations(self) -> int:
        return sum(4 * len(rows) + 1 for rows in self.below.values())

    # ---- factors ----

    def factors(self, values) -> tuple[Any, Any]:
        """The factors of M and G, from `values` at `entries`, for `solve`, and a flag: the saddle point is singular."""
        a, weighted, singular = xp.scatter(values, self.slots[tuple(self.entries.T)], self.count), None, None
        if self.augmented:
            a, weighted = self._weight_entries(a)
        if self.regular_only:
            # The constraints would have to hold a light coordinate against forces on heavy ones.
            diagonal = a[: self.size]
            singular = xp.fold("min", diagonal) <= REGULAR * xp.fold("max", diagonal)
        lower, inverse, lost = self._factor_lower(a)
        return (weighted, lower, inverse), lost if singular is None else singular | lost

    def _factor_lower(self, a) -> tuple[Any, Any, Any]:
        """L in the order of the pivots, D⁻¹, and a flag: a pivot was lost to round-off."""
        n, total = self.size, len(self.order)
        # What coordinates take off the diagonal, and what constraints do: in a constraint the two must stay separate.
        taken: list[list] = [[[], []] for _ in range(total)]
        inverse: list[Any] = [None] * total
        columns, losses = [], []
        for j in self.order:
            rows, (of_coordinates, of_constraints) = self.below[j], taken[j]
            if j < n:
                lost, inverse[j] = self._mass_pivot(j, a[j], of_coordinates + of_constraints)
            else:
                own = [-a[j], *of_coordinates] if self.released else of_coordinates
                lost, inverse[j] = self._constraint_pivot(own, of_constraints)
            if j < n or self.regular_only:
                losses.append(lost)
            if not len(rows):
                continue
            scaled = a[self.slots[rows, j]]  # L D
            lower = scaled * inverse[j]
            columns.append(lower)
            squares = lower * scaled
            for k, i in enumerate(rows.tolist()):
                taken[i][j >= n].append(squares[k])
            first, second = np.tril_indices(len(rows), -1)  # of every pair of rows below the pivot
            updated = self.slots[rows[first], rows[second]]
            if len(updated):
                a = xp.replace_entries(a, updated, a[updated] - lower[first] * scaled[second])
        lost = xp.fold("or", xp.stack(losses)) if losses else False
        return xp.concatenate(columns) if columns else a[:0], xp.stack(inverse), lost

    def _mass_pivot(self, j: int, diagonal, terms: list) -> tuple[Any, Any]:
        """A flag that the remaining Mⱼⱼ is round-off, and its inverse; NaN where it is."""
        if not terms and not self.massless[j]:
            return diagonal == 0.0, 1.0 / diagonal
        pivot = functools.reduce(operator.sub, terms, diagonal)
        lost = pivot <= (REGULAR if self.regular_only else singular_threshold(self.size, self.dtype)) * diagonal
        return lost, 1.0 / xp.where(lost, np.nan, pivot)

    def _constraint_pivot(self, of_coordinates: list, of_constraints: list) -> tuple[Any, Any]:
        """A flag that a constraint depends on those before it, and D⁻¹: then 0, or NaN if `regular_only`."""
        # The pivot is −G M⁻¹ Gᵀ of this constraint, and what those before it take off that. A row that is left out
        # changes nothing where the constraints are consistent.
        own: Any = sum(of_coordinates, start=0.0)
        left = sum(of_constraints, start=own)
        lost = left <= (REGULAR if self.regular_only else rank_tolerance(self.dtype)) * own
        if self.regular_only:
            return lost, -1.0 / xp.where(lost, np.nan, left)
        return lost, xp.where(lost, 0.0, -1.0 / xp.where(lost, 1.0, left))

    def _weight_entries(self, a) -> tuple[Any, Any]:
        """The entries of M + GᵀW G and of G, and the entries of W G in the order of the rows of G."""
        # The weights are the trace of M over |Gₖ|², within a factor n of those of `augment`. They are differentiated
        # here like everything else, and a trace is smooth where a maximum is not.
        trace, weighted, added = xp.fold("add", a[: self.size]), [], xp.scatter(a[:0], np.zeros(0, int), self.count)
        for k, touching in enumerate(self.rows):
            if not len(touching):
                continue
            row = a[self.slots[self.size + k, touching]]
            size = xp.fold("add", row * row)
            weighted.append(trace / xp.where(size > 0.0, size, 1.0) * row)
            first, second = np.tril_indices(len(touching))
            places = self.slots[touching[first], touching[second]]
            added = xp.replace_entries(added, places, added[places] + weighted[-1][first] * row[second])
        return a + added, xp.concatenate(weighted) if weighted else a[:0]

    # ---- solution ----

    def solve(self, factors: tuple[Any, Any, Any], right):
        """The solution x and then −λ, n + m numbers, linear in `right`: b and then c."""
        weighted, lower, inverse = factors
        z, n = right, self.size
        start = 0
        for k, touching in enumerate(self.rows if self.augmented else ()):
            row = weighted[start : start + len(touching)]
            z = xp.replace_entries(z, touching, z[touching] + row * z[n + k]) if len(touching) else z
            start += len(touching)
        start = 0
        for j in self.order:
            rows = self.below[j]
            if len(rows) and xp.filled(z[j]):
                z = xp.replace_entries(z, rows, z[rows] - lower[start : start + len(rows)] * z[j])
            start += len(rows)
        there = np.flatnonzero(xp.filled(z))
        z = xp.replace_entries(z, there, z[there] * inverse[there])
        for i, (columns, places) in reversed(self._rows_of_lower):
            if len(columns) and xp.filled(z[i]):
                z = xp.replace_entries(z, columns, z[columns] - lower[places] * z[i])
        return z

    @functools.cached_property
    def _rows_of_lower(self) -> list[tuple[int, tuple[np.ndarray, np.ndarray]]]:
        """Each row, in the order of elimination, with the columns in which L has an entry, and the entries' slots."""
        total, columns = len(self.order), {i: [] for i in self.order}
        for j in self.order:
            for i in self.below[j].tolist():
                columns[i].append(j)
        of = {i: np.array(before, int) for i, before in columns.items()}
        return [(i, (before, self.slots[i, before] - total)) for i, before in of.items()]


class DraggedElimination:
    """The solution of A z = r + (Bλ, 0), z = (x, −λ): each multiplier causes a further force, a column of B (n, m).

    With z₀ = A⁻¹ r and Z = A⁻¹ (B, 0), z = z₀ + Z λ, where (1 − P) λ = λ₀ and −P are the last rows of Z. `zeros` (n, m)
    marks structural zeros of B. The residual c − G x is solved for once more: for bodies at rest it is the rounding of
    large forces, by which they would creep, and afterwards only that of their accelerations.
    """

    def __init__(self, elimination: SaddleElimination, zeros: np.ndarray):
        zeros = zeros if zeros.size else np.ones((elimination.size, 0), bool)
        self.saddle, self.zeros, self.operations = elimination, zeros, 3 * elimination.operations
        self.dragged = np.flatnonzero(~zeros.all(axis=0))
        self.own = len(elimination.entries)
        self.entries = np.concatenate([elimination.entries, np.argwhere(~zeros) + [0, elimination.size]])

    def factors(self, values) -> tuple[Any, Any]:
        n, saddle = self.saddle.size, self.saddle
        factors, singular = saddle.factors(values[: self.own])
        rows = (saddle.entries[:, 0] >= n) & (saddle.entries[:, 1] < n)
        of_rows, forces = values[np.flatnonzero(rows)], values[self.own :]
        places, columns = np.argwhere(~self.zeros), []
        for j in self.dragged:
            column = np.flatnonzero(places[:, 1] == j)
            force = xp.scatter(forces[column], places[column, 0], n + len(saddle.rows))
            columns.append(saddle.solve(factors, force))
        # 1 − P, by elimination without pivots: the parts that are left are those of fewer contacts that slide.
        size = len(self.dragged)
        if not size:
            return (factors, of_rows), singular
        matrix = xp.stack([columns[j][n + i] + float(k == j) for k, i in enumerate(self.dragged) for j in range(size)])
        graph = matrix.expansion.graph
        rows = eliminate(graph, [sparse_row(graph, row) for row in matrix.ids.reshape(size, size).tolist()])
        both = [[row.get(j, graph.number(0.0)) for j in range(size)] for row in rows]
        return (factors, of_rows, xp.stack(columns), Scalars(matrix.expansion, np.array(both))), singular

    def solve(self, factors, right):
        """The solution x and then −λ, linear in `right`: b and then c."""
        of_saddle, of_rows, *of_drag = factors
        n, saddle = self.saddle.size, self.saddle
        z = saddle.solve(of_saddle, right)
        if of_drag:
            columns, coupling = of_drag
            graph = z.expansion.graph
            rows = [sparse_row(graph, row) for row in z.expansion.real(coupling.ids).tolist()]
            multipliers = substitute(graph, rows, (-z[n + self.dragged]).ids.tolist())
            for k, multiplier in enumerate(multipliers):
                z = z + columns[k] * Scalars(z.expansion, np.array(multiplier))
        gaps, start = right[n:], 0
        for k, touching in enumerate(saddle.rows):
            if len(touching):
                row = of_rows[start : start + len(touching)]
                gaps = xp.replace_entries(gaps, np.array([k]), gaps[k : k + 1] - xp.fold("add", row * z[touching]))
                start += len(touching)
        return z + saddle.solve(of_saddle, xp.scatter(gaps, np.arange(n, n + len(saddle.rows)), n + len(saddle.rows)))


class TwoCoordinates:
    """The solution of M x = b for two coordinates, by Cramer's rule: no pivoting, and the fewest operations.

    `zeros` (2, 2) marks structural zeros of M; the rest is as in `SaddleElimination`. A determinant that cancels to
    round-off means singular; it is replaced by NaN.
    """

    def __init__(self, zeros: np.ndarray, dtype):
        self.threshold, self.diagonal, self.operations = singular_threshold(2, dtype), bool(zeros[1, 0]), 16
        self.entries = np.array([[0, 0], [1, 1]] if self.diagonal else [[0, 0], [1, 0], [1, 1]])

    def factors(self, values) -> tuple[Any, Any]:
        """The entries and the inverse determinant, or the diagonal, and a flag: M is singular."""
        if self.diagonal:
            return values, (values[0] == 0.0) | (values[1] == 0.0)
        a, c, d = (values[k] for k in range(3))
        product, square = a * d, c * c
        determinant = product - square
        singular = xp.absolute(determinant) <= self.threshold * xp.maximum(xp.absolute(product), square)
        return xp.stack([a, c, d, 1.0 / xp.where(singular, np.nan, determinant)]), singular

    def solve(self, factors, right):
        """The solution x, two numbers, linear in `right`."""
        if self.diagonal:
            return right / factors
        a, c, d, inverse = (factors[k] for k in range(4))
        return xp.stack([(d * right[0] - c * right[1]) * inverse, (a * right[1] - c * right[0]) * inverse])


class IndefiniteElimination:
    """The solution of M x = b for an M that may be indefinite, with at most `LARGEST_INDEFINITE` coordinates.

    Its columns are made orthogonal (`_tracing/lowering`), because pivoting would be a border. `zeros` (n, n) marks
    structural zeros of M; the rest is as in `SaddleElimination`.
    """

    def __init__(self, zeros: np.ndarray, dtype):
        self.size, self.entries = len(zeros), np.argwhere(np.tril(~zeros | ~zeros.T))
        self.threshold = singular_threshold(self.size, dtype) ** 2
        self.operations = 3 * self.size**3

    def factors(self, values) -> tuple[Any, Any]:
        """Q and R, and a flag: M is singular, as the squared remainder of a column is round-off."""
        n, (row, column) = self.size, self.entries.T
        places = np.full((n, n), len(self.entries))
        places[row, column] = places[column, row] = np.arange(len(self.entries))
        matrix = xp.concatenate([values, np.zeros(1)])[places]
        factors, weights = orthogonalize(matrix), row_weights(matrix)
        sizes = [xp.fold("add", weights * matrix[:, j] * matrix[:, j]) for j in range(n)]
        lost = factors.squares <= self.threshold * xp.stack(sizes)
        duals = xp.where(lost[:, None], np.nan, factors.duals)
        return factors._replace(duals=duals), xp.fold("or", lost)

    def solve(self, factors, right):
        """The solution x, linear in `right`."""
        return solve_orthogonalized(factors, right)


def elimination_order(mass: np.ndarray, rows: np.ndarray) -> tuple[list[int], np.ndarray]:
    """The order in which coordinates 0 … n−1 and constraints n … n+m−1 are eliminated, and the resulting pattern.

    `mass` (n, n) and `rows` (m, n) mark entries that may be nonzero; the result (n + m, n + m) marks those of L and Lᵀ.
    A constraint comes after all of its coordinates: before them its pivot might be zero though it is not redundant.
    """
    m, n = rows.shape
    filled = np.block([[mass | mass.T, rows.T], [rows, np.zeros((m, m), bool)]])
    np.fill_diagonal(filled, False)
    left, order = np.ones(n + m, bool), []
    degree, waiting = filled.sum(axis=1), rows.sum(axis=1)
    while left.any():
        free = left.copy()
        free[n:] &= waiting == 0
        j = int(np.argmin(np.where(free, degree, n + m)))
        order.append(j)
        left[j] = False
        others = np.flatnonzero(filled[j] & left)
        filled[np.ix_(others, others)] = True
        filled[others, others] = False
        degree[others] = (filled[others] & left).sum(axis=1)
        if j < n:
            waiting -= rows[:, j]
    return order, filled
