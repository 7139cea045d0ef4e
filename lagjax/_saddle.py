"""The saddle point behind every constrained acceleration, on scalars: one elimination that keeps its zeros.

    M x − Gᵀλ = b,   G x = c,        for z = (x, −λ):   A z = (b, c),   A = (M Gᵀ; G 0)

A mechanism couples a part to few others, but M⁻¹ and the Schur complement G M⁻¹ Gᵀ have hardly a zero left: to
eliminate all of M and then all constraints takes operations that grow with the cube of the number of links. Here a
constraint is eliminated after the last of its own coordinates, and all of them in an order that fills few zeros
(minimum degree: Tinney & Walker, Proc. IEEE 55 (1967) 1801, scheme 2). A chain of n links then costs n times a link.

M positive definite needs no pivoting. What is left of M, once coordinates E and constraints C that touch only E are
eliminated, is the mass matrix of the other coordinates where those of E move freely under C. It lies between that
without C, which is M's own Schur complement, and that with E at rest, a block of M. The pivots of coordinates are
therefore positive, those of constraints negative or, where a constraint depends on those before it, zero; no entry
grows. The rank so found is that of the rows of G that came before: all their coordinates did, too.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._linear import rank_tolerance, singular_threshold

# The part of a pivot that elimination has to leave for a matrix to count as regular in the regular-M variant: four
# digits of an acceleration may be lost, and twelve remain. Twice as large, a few more states take the general variant,
# three times as expensive; much smaller, the error of an acceleration would exceed the tolerances.
REGULAR = 1e-4


class SaddleElimination:
    """A z = (b, c) as straight-line arithmetic, for one pattern of zeros: M positive (semi)definite, G a list of rows.

    `zeros` marks what is zero in M (n, n) and in G (m, n) whatever the state. M is `augmented` by GᵀW G, W diagonal,
    unless it is known to be regular: GᵀW G x = GᵀW c changes neither x nor λ. Redundant rows are left out of λ: the
    motion is the same, the multipliers are a solution but not the shortest. With `regular_only` the saddle point is
    called singular as soon as it loses digits: where M, or what the constraints make of it, is within `REGULAR` of
    singular. That is the regular-M variant, which takes a third of the arithmetic and leaves the rest of the states to
    the general one.
    """

    def __init__(self, zeros: tuple[np.ndarray, np.ndarray], dtype, augmented: bool, regular_only: bool):
        mass_zeros, self.row_zeros = zeros
        self.dtype, self.augmented, self.regular_only = dtype, augmented, regular_only
        self.constraints, self.size = self.row_zeros.shape
        touched = ~self.row_zeros
        mass = ~mass_zeros | ((touched.T.astype(int) @ touched.astype(int)) > 0) if augmented else ~mass_zeros
        self.order, self.filled = elimination_order(mass, touched)
        self.massless = ~np.diagonal(mass)

    def factors(self, matrix: list[list], jacobian: list[list]) -> tuple[Any, jax.Array]:
        """What `solve` needs of M and G, a tree of scalars, and whether the saddle point is singular."""
        weighted, singular = None, jnp.zeros((), bool)
        if self.augmented:
            matrix, weighted = _augmented_entries(matrix, jacobian, self.row_zeros)
        if self.regular_only:
            # The constraints would have to hold a light coordinate against forces on heavy ones.
            diagonal = [matrix[i][i] for i in range(self.size)]
            singular = functools.reduce(jnp.minimum, diagonal) <= REGULAR * functools.reduce(jnp.maximum, diagonal)
        lower, inverse, lost, redundant = self._eliminated(matrix, jacobian)
        return (weighted, lower, inverse), singular | lost | redundant if self.regular_only else lost

    def _eliminated(self, matrix, jacobian) -> tuple[dict, list, Any, Any]:
        """L by (row, column), D⁻¹, and whether a pivot of M, or one of a constraint, was lost to round-off."""
        lost = redundant = jnp.zeros((), bool)
        lower: dict[tuple[int, int], Any] = {}  # L by (row, column)
        scaled: dict[tuple[int, int], Any] = {}  # L D
        inverse: list[Any] = [None] * len(self.order)  # D⁻¹
        for place, j in enumerate(self.order):
            before = [k for k in self.order[:place] if self.filled[j, k]]
            of_coordinates, of_constraints = (
                [lower[j, k] * scaled[j, k] for k in before if (k >= self.size) == later] for later in (False, True)
            )
            if j < self.size:
                gone, inverse[j] = self._mass_pivot(j, matrix[j][j], of_coordinates + of_constraints)
                lost = lost | gone
            else:
                gone, inverse[j] = self._constraint_pivot(of_coordinates, of_constraints)
                redundant = redundant | gone
            for i in self.order[place + 1 :]:
                if self.filled[i, j]:
                    entry = _entry(matrix, jacobian, i, j)
                    for k in before:
                        if self.filled[i, k]:
                            entry = entry - lower[i, k] * scaled[j, k]
                    scaled[i, j], lower[i, j] = entry, entry * inverse[j]
        return lower, inverse, lost, redundant

    def _mass_pivot(self, j: int, diagonal, terms):
        """Whether what is left of Mⱼⱼ is round-off, and its inverse; NaN where it is."""
        if not terms and not self.massless[j]:
            return diagonal == 0, 1 / diagonal
        pivot = functools.reduce(lambda a, b: a - b, terms, diagonal)
        lost = pivot <= (REGULAR if self.regular_only else singular_threshold(self.size, self.dtype)) * diagonal
        return lost, 1 / jnp.where(lost, jnp.nan, pivot)

    def _constraint_pivot(self, of_coordinates, of_constraints):
        """Whether a constraint depends on those before it, and its D⁻¹: it is left out then, or NaN if `regular_only`.

        The pivot is −G M⁻¹ Gᵀ of this constraint, and what those before it take off that. A row that is left out
        changes nothing where the constraints are consistent.
        """
        own = functools.reduce(lambda a, b: a + b, of_coordinates, jnp.zeros((), self.dtype))
        left = functools.reduce(lambda a, b: a + b, of_constraints, own)
        lost = left <= (REGULAR if self.regular_only else rank_tolerance(self.dtype)) * own
        if self.regular_only:
            return lost, -1 / jnp.where(lost, jnp.nan, left)
        return lost, jnp.where(lost, 0.0, -1 / jnp.where(lost, 1.0, left))

    def solve(self, factors, right: list) -> list:
        """x and then −λ, n + m scalars, linear in `right`: b and then c."""
        weighted, lower, inverse = factors
        z, order = list(right), self.order
        if weighted is not None:
            for i in range(self.size):
                touching = [k for k in range(self.constraints) if not self.row_zeros[k, i]]
                z[i] = z[i] + _dot((weighted[k][i], right[self.size + k]) for k in touching)
        for place, i in enumerate(order):
            for k in order[:place]:
                if self.filled[i, k]:
                    z[i] = z[i] - lower[i, k] * z[k]
        z = [x * d for x, d in zip(z, inverse, strict=True)]
        for place, i in reversed(list(enumerate(order))):
            for k in order[place + 1 :]:
                if self.filled[k, i]:
                    z[i] = z[i] - lower[k, i] * z[k]
        return z


def elimination_order(mass: np.ndarray, rows: np.ndarray) -> tuple[list[int], np.ndarray]:
    """The order in which coordinates 0 … n−1 and constraints n … n+m−1 are eliminated, and what is filled by then.

    `mass` (n, n) and `rows` (m, n) mark what need not be zero; `filled` (n + m, n + m) marks that of L and Lᵀ. A
    constraint comes after all of its coordinates, without which its pivot might be zero though it is not redundant.
    """
    m, n = rows.shape
    filled = np.block([[mass | mass.T, rows.T], [rows, np.zeros((m, m), bool)]])
    np.fill_diagonal(filled, False)
    left, order = np.ones(n + m, bool), []
    while left.any():
        waiting = np.concatenate([np.zeros(n, bool), (rows & left[:n]).any(axis=1)])
        degree = np.where(left & ~waiting, (filled & left).sum(axis=1), n + m)
        j = int(np.argmin(degree))
        order.append(j)
        left[j] = False
        others = filled[j] & left
        filled |= np.outer(others, others)
        np.fill_diagonal(filled, False)
    return order, filled


def _entry(matrix, jacobian, i: int, j: int):
    """That of A at (i, j), i ≠ j."""
    i, j, n = max(i, j), min(i, j), len(matrix)
    return matrix[i][j] if i < n else jacobian[i - n][j] if j < n else 0.0


def _augmented_entries(matrix, jacobian, row_zeros):
    """M + GᵀW G and W G, entry by entry.

    The weights are the trace of M over |Gₖ|², within a factor n of those of `augment`. They are differentiated here
    like everything else, and a trace is smooth where a maximum is not.
    """
    n, m = len(matrix), len(jacobian)
    present = ~row_zeros
    trace = _dot((matrix[i][i], 1.0) for i in range(n))
    sizes = [_dot((jacobian[k][i], jacobian[k][i]) for i in range(n) if present[k, i]) for k in range(m)]
    weights = [trace / jnp.where(size > 0, size, 1.0) for size in sizes]
    weighted = [[weights[k] * jacobian[k][i] for i in range(n)] for k in range(m)]

    def added(i, j):
        return _dot((weighted[k][i], jacobian[k][j]) for k in range(m) if present[k, i] and present[k, j])

    matrix = [[matrix[i][j] + added(i, j) for j in range(n)] for i in range(n)]
    return matrix, weighted


def _dot(pairs):
    """Σ a b over pairs of scalars."""
    total = 0.0
    for a, b in pairs:
        total = total + a * b
    return total
