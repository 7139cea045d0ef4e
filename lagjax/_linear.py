"""The symmetric linear solve M x = b behind every acceleration, for arrays and for scalars.

M = ∂²L/∂q̇² is symmetric and, for an unusual L, indefinite; it must be regular. A matrix that is singular to working
precision gives NaN, never a number: no pseudo-inverse, no regularisation. The caller reports it.

`factorize` is for arrays: M is scaled to a unit diagonal (Jacobi scaling: within a factor n of the best diagonal
scaling for positive definite M, van der Sluis 1969), so that masses of very different size cost no accuracy, and then
inverted by Gauss-Jordan elimination with partial pivoting. `Elimination` is for scalar programs: the same solution,
written out entry by entry.

No array function here calls LAPACK through JAX. Each of jaxlib's LAPACK kernels (LU, triangular solve, Cholesky,
eigenvalues) divides a batch among the threads of XLA and blocks its own thread until they are done; as many kernels as
there are threads, side by side in one program, wait for each other for ever (jaxlib 0.10.1, `ParallelBatchMap`). What
is `vmap`ped is for the caller to decide, so all of it is written in array operations, which never wait. Those are as
fast as LAPACK in a batch of up to about 12 coordinates; a single matrix of 128 takes four times as long, under 1 ms.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class Factorization(eqx.Module):
    """An inverted symmetric matrix, and whether it is singular to working precision (a NaN in it is not that)."""

    matrix: jax.Array
    scale: jax.Array
    inverse: tuple[jax.Array, jax.Array]  # of the scaled matrix, and the order in which it takes its rows
    singular: jax.Array

    def solve(self, b: jax.Array) -> jax.Array:
        """x with M x = b; NaN where M is singular. Differentiated implicitly: one more solve with the same inverse."""

        def times_matrix(y):
            return _scaled(self.matrix, self.scale) @ y

        def by_inverse(_, scaled):
            inverse, order = self.inverse
            x = inverse @ _rows(scaled, order)
            # One step of refinement: the residual of an inverse is larger than that of LU by the condition of M.
            return x + inverse @ _rows(scaled - times_matrix(x), order)

        # `b` scaled, solved, scaled back; M is symmetric, so the transpose solve is the solve.
        x = self.scale * jax.lax.custom_linear_solve(times_matrix, self.scale * b, by_inverse, symmetric=True)
        return jnp.where(self.singular, jnp.nan, x)


def factorize(matrix: jax.Array) -> Factorization:
    """Scale and invert a symmetric matrix of shape (n, n)."""
    matrix = 0.5 * (matrix + matrix.T)
    scale = jax.lax.stop_gradient(_diagonal_scale(matrix))
    inverse, order, pivots = _inverted(jax.lax.stop_gradient(_scaled(matrix, scale)))
    pivots, threshold = jnp.abs(pivots), singular_threshold(matrix.shape[0], matrix.dtype)
    return Factorization(matrix, scale, (inverse, order), jnp.min(pivots) <= threshold * jnp.max(pivots))


# ---- elimination on whole arrays -------------------------------------------------------------------------------------
#
# In place: where A x = y is solved for x, column k of A gives way, once it has been eliminated with row p as its pivot,
# to the column of the inverse that belongs to y_p. Rows stay where they are; `order` remembers p for every k.

_PANEL = 16  # columns eliminated by themselves before a matrix product takes them to the others; 8 to 32 are as fast


def _inverted(matrix: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(B, order, pivots), each by column, with A⁻¹ b = B b[order]: Gauss-Jordan elimination with partial pivoting.

    Golub & Van Loan, Matrix Computations, §3.2 and §3.4; the pivots are those of LU. Where a pivot is zero, B is
    anything.
    """
    n = len(matrix)
    width = min(n, _PANEL)
    count = -(-n // width)
    size = count * width  # made up with the unit matrix
    a = jnp.pad(matrix, (0, size - n)) + jnp.diag((np.arange(size) >= n).astype(matrix.dtype))

    def one_panel(index, carry):
        a, free, order, pivots = carry
        panel, left, some, these = _eliminated(jax.lax.dynamic_slice_in_dim(a, index * width, width, 1), free)
        if count > 1:
            a = jnp.where((free & ~left)[:, None], 0, a) + panel @ _rows(a, some)
            panel = jax.lax.dynamic_update_slice_in_dim(a, panel, index * width, 1)
        order = jax.lax.dynamic_update_slice_in_dim(order, some, index * width, 0)
        return panel, left, order, jax.lax.dynamic_update_slice_in_dim(pivots, these, index * width, 0)

    start = a, jnp.ones(size, bool), jnp.zeros(size, np.int32), jnp.zeros(size, a.dtype)
    a, _, order, pivots = jax.lax.fori_loop(0, count, one_panel, start) if count > 1 else one_panel(0, start)
    return _rows(a, order[:n])[:, :n], order[:n], pivots[:n]


def _eliminated(panel: jax.Array, free: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """A panel of columns after their elimination, the rows that are free still, the pivots' rows, and the pivots."""

    def one_column(k, carry):
        panel, free, order, pivots = carry
        now = np.arange(panel.shape[1]) == k
        column = jnp.sum(jnp.where(now, panel, 0), axis=1)
        row = jnp.argmax(jnp.where(free, jnp.abs(column), -1)).astype(np.int32)  # the first NaN, if there is one
        panel, pivot = _exchanged(panel, np.arange(len(panel)) == row, now)
        return panel, free & (np.arange(len(panel)) != row), jnp.where(now, row, order), jnp.where(now, pivot, pivots)

    width = panel.shape[1]
    start = panel, free, jnp.zeros(width, np.int32), jnp.zeros(width, panel.dtype)
    return jax.lax.fori_loop(0, width, one_column, start)


def _exchanged(a: jax.Array, here: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A after one column was eliminated by one row, both marked, and its pivot; masks are faster than places here."""
    row, column = jnp.sum(jnp.where(here[:, None], a, 0), axis=0), jnp.sum(jnp.where(now, a, 0), axis=1)
    pivot = jnp.sum(jnp.where(now, row, 0))
    row = jnp.where(now, 1, row) / jnp.where(pivot == 0, 1, pivot)  # a zero is left to be reported
    return jnp.where(here[:, None] | now, 0, a) - jnp.where(here, -1, column)[:, None] * row, pivot


def _rows(a: jax.Array, order: jax.Array) -> jax.Array:
    return a.at[order].get(mode="promise_in_bounds")


def singular_threshold(n: int, dtype) -> float:
    """The ratio of pivots at which a scaled n × n matrix counts as singular: n units of round-off."""
    return n * float(jnp.finfo(dtype).eps)


def null_directions(matrix: np.ndarray) -> np.ndarray:
    """Unit vectors, one a row, that a symmetric matrix sends to zero (to working precision, after scaling)."""
    scale = np.asarray(_diagonal_scale(jnp.asarray(matrix)))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    null = np.abs(values) <= singular_threshold(len(matrix), matrix.dtype) * max(np.abs(values).max(), 1e-300)
    directions = (scale[:, None] * vectors[:, null]).T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


class Elimination:
    """M x = b as straight-line arithmetic on scalars, for one pattern of zeros.

    `zeros` marks the entries of M that are zero whatever the state; whatever they would contribute is left out. Two
    coordinates are solved by Cramer's rule, which needs no pivoting. More are solved by M = L D Lᵀ without pivoting,
    which is stable for positive definite M, and no diagonal scaling would change it. A pivot that cancels to round-off
    is singularity; it is replaced by NaN.
    """

    def __init__(self, zeros: np.ndarray, dtype):
        self.zeros, self.small = zeros, singular_threshold(len(zeros), dtype)

    def factors(self, matrix: list[list], rows: list[list] = ()) -> tuple[Any, jax.Array]:
        """What `solve` needs of M, a tree of scalars, and whether M is singular. There are no rows of constraints."""
        if len(matrix) == 2:
            return _cramer_factors(matrix, self.zeros, self.small)
        return _ldl_factors(matrix, ~self.zeros, self.small)

    def solve(self, factors, b: list) -> list:
        """x, linear in b."""
        return _cramer_solve(factors, b) if len(b) == 2 else _ldl_solve(factors, b)


def _cramer_factors(matrix, zeros, small):
    (a, c), (_, d) = matrix
    if zeros[0, 1]:
        return (a, d), (a == 0) | (d == 0)
    product, square = a * d, c * c
    determinant = product - square
    singular = jnp.abs(determinant) <= small * jnp.maximum(jnp.abs(product), square)
    return (a, c, d, 1 / jnp.where(singular, jnp.nan, determinant)), singular


def _cramer_solve(factors, b):
    if len(factors) == 2:
        return [b[0] / factors[0], b[1] / factors[1]]
    a, c, d, inverse = factors
    return [(d * b[0] - c * b[1]) * inverse, (a * b[1] - c * b[0]) * inverse]


def _ldl_factors(matrix, filled, small, drop: bool = False):
    """L, where it has entries, and D⁻¹, and whether a pivot was lost to round-off.

    A lost pivot becomes NaN; with `drop` its row is left out instead, which for a consistent system changes nothing.
    """
    n, singular, filled = len(matrix), jnp.zeros((), bool), filled.copy()
    lower, scaled, inverse = {}, {}, [None] * n  # L, L D and D⁻¹, column by column
    for j in range(n):
        before = [k for k in range(j) if filled[j, k]]
        pivot = matrix[j][j]
        for k in before:
            pivot = pivot - lower[j, k] * scaled[j, k]
        lost = pivot <= small * matrix[j][j] if before or not filled[j, j] else pivot == 0
        singular = singular | lost
        if drop:
            inverse[j] = jnp.where(lost, 0.0, 1 / jnp.where(lost, 1.0, pivot))
        else:
            guarded = before or not filled[j, j]
            inverse[j] = 1 / (jnp.where(lost, jnp.nan, pivot) if guarded else pivot)
        for i in range(j + 1, n):
            shared = [k for k in before if filled[i, k]]
            if filled[i, j] or shared:
                filled[i, j] = True
                entry = matrix[i][j]
                for k in shared:
                    entry = entry - lower[i, k] * scaled[j, k]
                scaled[i, j] = entry
                lower[i, j] = entry * inverse[j]
    return (lower, inverse), singular


def _ldl_solve(factors, b) -> list:
    lower, inverse = factors
    x, n = list(b), len(b)
    for i in range(n):
        for k in range(i):
            if (i, k) in lower:
                x[i] = x[i] - lower[i, k] * x[k]
    x = [x[i] * inverse[i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            if (k, i) in lower:
                x[i] = x[i] - lower[k, i] * x[k]
    return x


# ---- with constraints: the saddle point ------------------------------------------------------------------------------
#
#     M x − Gᵀλ = b,   G x = c
#
# M may be singular where the constraints hold what it does not: adding GᵀW G x = GᵀW c to the first line, W diagonal,
# changes neither x nor λ and makes the matrix K = M + GᵀW G regular whenever the saddle point is.


def saddle(matrix: jax.Array, b: jax.Array, rows: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """x, λ of least norm, and whether the saddle point is singular, for arrays."""
    weight = jax.lax.stop_gradient(_weights(matrix, rows))
    held = factorize(matrix + rows.T @ (weight[:, None] * rows))
    solve = jax.vmap(held.solve, in_axes=1, out_axes=1)
    free, responses = held.solve(b + rows.T @ (weight * c)), solve(rows.T)
    multipliers = least_norm(rows @ responses, c - rows @ free)
    return free + responses @ multipliers, multipliers, held.singular


def schur_complement(matrix: jax.Array, rows: jax.Array) -> jax.Array:
    """S = G K⁻¹ Gᵀ of `saddle`, whose rank is the number of independent constraints."""
    held = factorize(matrix + rows.T @ (_weights(matrix, rows)[:, None] * rows))
    return rows @ jax.vmap(held.solve, in_axes=1, out_axes=1)(rows.T)


def dependent_rows(matrix: np.ndarray) -> dict[int, np.ndarray]:
    """The rows of G that are combinations of rows before them, with the factors, from S = G K⁻¹ Gᵀ.

    A row is one where its part outside of those before it is below `rank_tolerance` of its own size, squared as S is.
    """
    independent, found = [], {}
    for row in range(len(matrix)):
        among = matrix[np.ix_(independent, independent)]
        scale = 1 / np.sqrt(np.diagonal(among))
        factors = scale * np.linalg.solve(scale[:, None] * among * scale, scale * matrix[independent, row])
        outside = matrix[row, row] - factors @ matrix[independent, row]
        if outside <= rank_tolerance(matrix.dtype) * matrix[row, row]:
            weight = factors / scale  # how much of the row each of them makes up
            factors = np.where(np.abs(weight) > 1e-6 * np.sqrt(matrix[row, row]), factors, 0)
            found[row] = np.zeros(len(matrix))
            found[row][independent] = factors
        else:
            independent.append(row)
    return found


def _weights(matrix, rows):
    """Weights that make every row of G as heavy as M."""
    size = jnp.sum(rows**2, axis=1)
    return jnp.max(jnp.abs(jnp.diagonal(matrix))) / jnp.where(size > 0, size, 1)


def rank_tolerance(dtype) -> float:
    """The part of a constraint, scaled to 1, below which it counts as a combination of the others: eps^(2/3)."""
    return float(jnp.finfo(dtype).eps) ** (2 / 3)


def least_norm(matrix: jax.Array, b: jax.Array) -> jax.Array:
    """The shortest x with S x = b for a symmetric S of any rank and b in its range.

    The rank is that of S scaled to a unit diagonal, where pivots below `rank_tolerance` count as zero.
    """
    return _inverse_on_range(matrix) @ b


@jax.custom_jvp
def _inverse_on_range(matrix: jax.Array) -> jax.Array:
    scale = _diagonal_scale(matrix)
    inverse, basis, pairs = _independent(_scaled(matrix, scale), scale)
    some = scale[:, None] * inverse * scale  # solves S x = b, but its x need not be the shortest
    # The part of x in the range of S is the shortest one: P x with P = W (WᵀW)⁻¹ Wᵀ, where W is the basis of the range
    # scaled back. WᵀW is at least the unit matrix; where W has no column, that of the unit matrix takes its place.
    basis = basis / scale[:, None] * (scale @ pairs)
    gram = basis.T @ basis + jnp.diag(1 - jnp.sum(pairs, axis=0))
    projector = basis @ jax.vmap(factorize(gram).solve, in_axes=1, out_axes=1)(basis.T)
    return projector @ some @ projector


@_inverse_on_range.defjvp
def _inverse_on_range_jvp(primals, tangents):
    # Golub & Pereyra, SIAM J. Numer. Anal. 10 (1973) 413, eq. (4.12), for a symmetric matrix of constant rank. Not by
    # way of the eigenvectors, which have no derivative where eigenvalues meet.
    (matrix,), (moving,) = primals, tangents
    inverse = _inverse_on_range(matrix)
    outside = jnp.eye(len(matrix), dtype=matrix.dtype) - inverse @ matrix
    turned = outside @ moving @ inverse @ inverse
    return inverse, turned + turned.T - inverse @ moving @ inverse


def rank(matrix: jax.Array) -> jax.Array:
    """How many rows of a symmetric matrix are independent, where entries below `rank_tolerance` count as zero."""
    return jnp.sum(_independent(matrix, jnp.ones(len(matrix), matrix.dtype))[2]).astype(int)


def _independent(matrix: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(X, W, Q) of a symmetric A: A X A = A; W, a basis of its range; Q, 1 where a row was the pivot of a column.

    Elimination with complete pivoting, which ends where all that is left is below `rank_tolerance`. W has a column for
    every column that had a pivot, and is Q in the rows of the pivots; other columns are zero. A is positive
    semi-definite where M is, but need not be. Of pivots that are nearly as good as the largest the one is taken that
    is largest before `scale` was applied, which keeps W well-conditioned.
    """
    m = len(matrix)

    def one_pivot(_, carry):
        a, pairs = carry
        free = (jnp.sum(pairs, axis=1) == 0)[:, None] & (jnp.sum(pairs, axis=0) == 0)
        size = jnp.where(free, jnp.abs(a), -1)
        largest = jnp.max(size)  # NaN, if there is one: comparisons are such that it gets into the result
        good = free & ~(size < 0.1 * largest)
        place = jnp.argmax(jnp.where(good, size / (scale[:, None] * scale), -1))
        here, now = np.arange(m) == place // m, np.arange(m) == place % m
        counts = ~(largest <= rank_tolerance(a.dtype))
        a = jnp.where(counts, _exchanged(a, here, now)[0], a)
        return a, pairs + (here[:, None] & now & counts)

    a, pairs = jax.lax.fori_loop(0, m, one_pivot, (matrix, jnp.zeros_like(matrix)))
    rows, columns = jnp.sum(pairs, axis=1) > 0, jnp.sum(pairs, axis=0) > 0
    inverse = pairs.T @ jnp.where(rows[:, None] & columns, a, 0) @ pairs.T
    return inverse, pairs + jnp.where(~rows[:, None] & columns, -a, 0), pairs


# ---- many small systems side by side, in NumPy -----------------------------------------------------------------------


def solve_many(matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x with M x = b for symmetric M (S, n, n) and b (S, n, k); NaN where M is singular, as `Factorization.solve`."""
    if matrix.shape[1] == 1:
        return b / np.where(matrix == 0, np.nan, matrix)
    matrix = 0.5 * (matrix + np.swapaxes(matrix, 1, 2))
    scale = _scales(matrix)
    scaled = scale[:, :, None] * matrix * scale[:, None, :]
    usable = np.isfinite(scaled).all(axis=(1, 2))
    scaled = np.where(usable[:, None, None], scaled, np.eye(matrix.shape[1], dtype=matrix.dtype))
    sizes = np.abs(np.linalg.eigvalsh(scaled))
    usable &= sizes.min(axis=1) > singular_threshold(matrix.shape[1], matrix.dtype) * sizes.max(axis=1)
    scaled = np.where(usable[:, None, None], scaled, np.eye(matrix.shape[1], dtype=matrix.dtype))
    x = scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * b)
    return np.where(usable[:, None, None], x, np.nan)


def saddle_many(matrix, b, rows, c) -> tuple[np.ndarray, np.ndarray]:
    """x (S, n) and λ (S, m), of least norm, of S saddle points, as `saddle`; `rows` (S, m, n) may be empty."""
    if not rows.shape[1]:
        return solve_many(matrix, b[:, :, None])[:, :, 0], np.zeros((len(b), 0), b.dtype)
    augmented, weighted = _augmented(matrix, rows)
    turned = np.swapaxes(rows, 1, 2)
    solved = solve_many(augmented, np.concatenate([(b + np.einsum("skn,sk->sn", weighted, c))[:, :, None], turned], 2))
    free, responses = solved[:, :, 0], solved[:, :, 1:]
    left = c - np.einsum("skn,sn->sk", rows, free)
    multipliers = _solved_on_range(rows @ responses, left[:, :, None])[:, :, 0]
    return free + np.einsum("snk,sk->sn", responses, multipliers), multipliers


def schur_complements(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """S = G K⁻¹ Gᵀ of `schur_complement`, for S matrices at once."""
    return rows @ solve_many(_augmented(matrix, rows)[0], np.swapaxes(rows, 1, 2))


def _augmented(matrix: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K = M + GᵀW G and W G."""
    size, heavy = np.sum(rows**2, axis=2), np.abs(np.diagonal(matrix, axis1=1, axis2=2)).max(axis=1)
    weighted = (heavy[:, None] / np.where(size > 0, size, 1))[:, :, None] * rows
    return matrix + np.swapaxes(rows, 1, 2) @ weighted, weighted


def _solved_on_range(matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The shortest x with S x = b, as `least_norm`, for symmetric S of any rank (S, m, m)."""
    usable = np.isfinite(matrix).all(axis=(1, 2))
    matrix = np.where(usable[:, None, None], matrix, np.eye(matrix.shape[1], dtype=matrix.dtype))
    scale = _scales(matrix)
    values, vectors = np.linalg.eigh(scale[:, :, None] * matrix * scale[:, None, :])
    kept = np.abs(values) > rank_tolerance(matrix.dtype)
    inverse = np.where(kept, 1 / np.where(kept, values, 1), 0)[:, :, None]
    x = scale[:, :, None] * (vectors @ (inverse * (np.swapaxes(vectors, 1, 2) @ (scale[:, :, None] * b))))
    if not kept.all():  # what of x lies in the kernel of S is taken out: the kernel of the scaled matrix, scaled back
        kernel = np.where(kept[:, None, :], 0, scale[:, :, None] * vectors)
        turned = np.swapaxes(kernel, 1, 2)
        gram = turned @ kernel + kept[:, :, None] * np.eye(matrix.shape[1], dtype=matrix.dtype)
        x = x - kernel @ np.linalg.solve(gram, turned @ x)
    return np.where(usable[:, None, None], x, np.nan)


def _scales(matrix: np.ndarray) -> np.ndarray:
    """`_diagonal_scale` of many matrices."""
    diagonal = np.abs(np.diagonal(matrix, axis1=1, axis2=2))
    size = np.where(diagonal > 0, diagonal, np.abs(matrix).max(axis=2))
    return 1 / np.sqrt(np.where(size > 0, size, 1))


class SaddleElimination:
    """The same as `saddle` on scalars, without pivoting: M positive (semi)definite, G a list of rows.

    `zeros` marks what is zero in (M, G) whatever the state. With `helped` M may be singular; without, it must be
    regular. Redundant rows are left out of λ: the motion is the same, the multipliers are a solution but not the
    shortest. A `wary` elimination calls a saddle point singular as soon as it loses digits: where M, or what the
    constraints make of it, is not far from singular (`WARY`).
    """

    def __init__(self, zeros: tuple[np.ndarray, np.ndarray], dtype, helped: bool, wary: bool):
        self.mass_zeros, self.row_zeros = zeros
        self.dtype, self.helped, self.wary = dtype, helped, wary

    def factors(self, matrix: list[list], rows: list[list]) -> tuple[Any, jax.Array]:
        """What `solve` needs of M and G, a tree of scalars, and whether the saddle point is singular."""
        n, m, wary = len(matrix), len(rows), self.wary
        zeros, pulled, singular = self.mass_zeros, None, jnp.zeros((), bool)
        if self.helped:
            matrix, pulled, zeros = _helped(matrix, rows, zeros, self.row_zeros)
        if wary:
            least, most = (functools.reduce(of, (matrix[i][i] for i in range(n))) for of in (jnp.minimum, jnp.maximum))
            singular = (
                least <= WARY * most
            )  # the constraints would have to hold a light coordinate against large forces
        free, lost = _ldl_factors(matrix, ~zeros, WARY if wary else singular_threshold(n, self.dtype))
        responses = [_ldl_solve(free, row) for row in rows]
        schur = [[self._along(i, rows, responses[j]) for j in range(m)] for i in range(m)]
        small = WARY if wary else rank_tolerance(self.dtype)
        held, redundant = _ldl_factors(schur, np.ones((m, m), bool), small, drop=not wary)
        return (rows, pulled, free, responses, held), singular | lost | redundant if wary else lost

    def solve(self, factors, right: list) -> list:
        """x and then −λ, linear in b and then c."""
        rows, pulled, free, responses, held = factors
        m, n = self.row_zeros.shape
        b, c = right[:n], right[n:]
        if pulled is not None:
            b = [b[i] + _dot((pulled[k][i], c[k]) for k in range(m) if not self.row_zeros[k, i]) for i in range(n)]
        x = _ldl_solve(free, b)
        pulls = _ldl_solve(held, [self._along(i, rows, x) - c[i] for i in range(m)])
        return [x[k] - _dot((responses[i][k], pulls[i]) for i in range(m)) for k in range(n)] + pulls

    def _along(self, i: int, rows, x):
        return _dot((rows[i][k], x[k]) for k in range(len(x)) if not self.row_zeros[i, k])


WARY = 1e-4  # the part of a pivot that has to be left: four digits of an acceleration may be lost, and no more


def _helped(matrix, rows, mass_zeros, row_zeros):
    """M + GᵀW G, W G, and where the first is zero whatever the state."""
    n, m = len(matrix), len(rows)
    touched = ~row_zeros
    total = _dot((matrix[i][i], 1.0) for i in range(n))
    sizes = [_dot((rows[k][i], rows[k][i]) for i in range(n) if touched[k, i]) for k in range(m)]
    # Weights that make every row of G as heavy as M.
    heavy = [total / jnp.where(size > 0, size, 1.0) for size in sizes]
    pulled = [[heavy[k] * rows[k][i] for i in range(n)] for k in range(m)]
    matrix = [
        [matrix[i][j] + _dot((pulled[k][i], rows[k][j]) for k in range(m) if touched[k, i] and touched[k, j])
         for j in range(n)] for i in range(n)
    ]  # fmt: skip
    return matrix, pulled, mass_zeros & ~((touched.T.astype(int) @ touched.astype(int)) > 0)


def _dot(pairs):
    total = 0.0
    for a, b in pairs:
        total = total + a * b
    return total


def _diagonal_scale(matrix: jax.Array) -> jax.Array:
    """1/√|Mii|, or the row's largest entry where the diagonal is zero, or 1 where the whole row is."""
    diagonal = jnp.abs(jnp.diagonal(matrix))
    size = jnp.where(diagonal > 0, diagonal, jnp.max(jnp.abs(matrix), axis=1))
    return jax.lax.rsqrt(jnp.where(size > 0, size, 1))


def _scaled(matrix: jax.Array, scale: jax.Array) -> jax.Array:
    return scale[:, None] * matrix * scale
