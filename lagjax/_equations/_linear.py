"""The symmetric linear solves behind every acceleration, on arrays and on scalars.

    M x = b                                    without constraints
    M x − Gᵀλ = b,  G x = c                    with constraints: a saddle point

M = ∂²L/∂q̇² is symmetric and, for an unusual L, indefinite. A matrix that is singular to working precision gives NaN,
never a number: no pseudo-inverse, no regularisation. The caller reports it.

There are two forms of each here. `factorize` and `saddle` are for arrays in JAX: M is scaled to a unit diagonal (Jacobi
scaling: within a factor n of the best diagonal scaling for positive definite M, van der Sluis 1969), so that masses of
very different size cost no accuracy, and then inverted by Gauss-Jordan elimination with partial pivoting.
`solve_many` and `saddle_many` are for many small systems side by side in NumPy. A third form, written out for scalar
programs, is in `_saddle`.

No array function here calls LAPACK through JAX. Each of jaxlib's LAPACK kernels (LU, triangular solve, Cholesky,
eigenvalues) divides a batch among the threads of XLA and blocks its own thread until they are done; as many kernels as
there are threads, side by side in one program, wait for each other for ever (jaxlib 0.10.1, `ParallelBatchMap`). What
is `vmap`ped is for the caller to decide, so all of it is written in array operations, which never wait. Those are as
fast as LAPACK in a batch of up to about 12 coordinates; a single matrix of 128 takes four times as long, under 1 ms.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lagjax._primitives import vary_carry_alike

# The numbers of one state, as arrays of JAX or NumPy, and those of S states, as arrays of NumPy.
Matrix = Float[Array, "n n"]
Vector = Float[Array, " n"]
Rows = Float[Array, "m n"]
Matrices = Float[np.ndarray, "S n n"]


class Factorization(eqx.Module):
    """An inverted symmetric matrix, and a flag: it is singular to working precision (NaN does not set it)."""

    matrix: Matrix
    scale: Vector
    inverse: Matrix  # B of the scaled matrix A, with A⁻¹ b = B b[order]
    order: Int[Array, " n"]
    singular: Bool[Array, ""]

    def solve(self, b: Vector) -> Vector:
        """The solution x of M x = b; NaN where M is singular. Its derivative is one more solve with the inverse."""

        def times_matrix(y):
            return self.scale * (self.matrix @ (self.scale * y))

        def solve_by_inverse(_, scaled):
            x = self.inverse @ _permute_rows(scaled, self.order)
            # One step of refinement: the residual of an inverse is larger than that of LU by the condition of M.
            return x + self.inverse @ _permute_rows(scaled - times_matrix(x), self.order)

        # `b` scaled, solved, scaled back; M is symmetric, so the transpose solve is the solve.
        x = self.scale * jax.lax.custom_linear_solve(times_matrix, self.scale * b, solve_by_inverse, symmetric=True)
        return jnp.where(self.singular, jnp.nan, x)

    def solve_columns(self, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """The solution X of M X = B, shape (n, k)."""
        return jax.vmap(self.solve, in_axes=1, out_axes=1)(b)


def factorize(matrix: Matrix) -> Factorization:
    matrix = 0.5 * (matrix + matrix.T)
    scaled, scale = jax.lax.stop_gradient(unit_diagonal(matrix))
    inverse, order, pivots = invert(scaled)
    pivots, threshold = jnp.abs(pivots), singular_threshold(matrix.shape[0], matrix.dtype)
    return Factorization(matrix, scale, inverse, order, jnp.min(pivots) <= threshold * jnp.max(pivots))


def diagonal_scale(matrix):
    """1/√|Mᵢᵢ| of symmetric matrices (..., n, n), shape (..., n): scaling both sides by it gives a unit diagonal."""
    # Where the diagonal is zero it is the row's largest entry that counts, and 1 where the whole row is. For arrays of
    # NumPy or JAX.
    xp = matrix.__array_namespace__()
    diagonal = xp.abs(xp.diagonal(matrix, axis1=-2, axis2=-1))
    size = xp.where(diagonal > 0, diagonal, xp.max(xp.abs(matrix), axis=-1))
    return 1 / xp.sqrt(xp.where(size > 0, size, 1))


def unit_diagonal(matrix):
    """Symmetric matrices (..., n, n) with both sides scaled to a unit diagonal, and the `diagonal_scale` (..., n)."""
    scale = diagonal_scale(matrix)
    return scale[..., :, None] * matrix * scale[..., None, :], scale


def singular_threshold(n: int, dtype) -> float:
    """The ratio of the smallest to the largest pivot below which a scaled n × n matrix counts as singular: n eps."""
    # About so much is left of a pivot that is zero after n subtractions, and a solution has no digit left there. Twice
    # as large, it would refuse matrices whose solution has one binary digit.
    return n * float(jnp.finfo(dtype).eps)


def eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ascending eigenvalues (n,) of a symmetric matrix (n, n), and its eigenvectors as columns (n, n)."""
    diagonal = np.diagonal(matrix)
    if not np.array_equal(matrix, np.diag(diagonal)):
        values, vectors = np.linalg.eigh(matrix)
        return values, vectors
    order = np.argsort(diagonal)  # as of large scenes of bodies: LAPACK would take n³ operations
    return diagonal[order], np.eye(len(matrix), dtype=matrix.dtype)[:, order]


def null_directions(matrix: np.ndarray, threshold: float | None = None) -> np.ndarray:
    """Unit vectors (k, n) in the null space, up to `threshold`, of a symmetric matrix scaled to a unit diagonal."""
    threshold = singular_threshold(len(matrix), matrix.dtype) if threshold is None else threshold
    scaled, scale = unit_diagonal(matrix)
    values, vectors = eigen(scaled)
    null = np.abs(values) <= threshold * max(np.abs(values).max(), np.finfo(matrix.dtype).tiny)
    directions = (scale[:, None] * vectors[:, null]).T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


# ---- elimination on whole arrays -------------------------------------------------------------------------------------
#
# In place: where A x = y is solved for x, column k of A gives way, once it has been eliminated with row p as its pivot,
# to the column of the inverse that belongs to y_p. Rows stay where they are; `order` holds p for every k.

# Columns that are eliminated by themselves before a matrix product applies them to the others. 8 to 32 were measured
# to be equally fast.
_PANEL = 16


def invert(matrix: Matrix) -> tuple[Matrix, Int[Array, " n"], Vector]:
    """B, `order` and the pivots of A with A⁻¹ b = B b[order], by Gauss-Jordan elimination with partial pivoting.

    A need not be symmetric. The pivots are those of LU. Where one of them is zero, B is meaningless. Source: Golub &
    Van Loan, *Matrix Computations*, §3.2 and §3.4.
    """
    n = len(matrix)
    width = min(n, _PANEL)
    count = -(-n // width)
    size = count * width  # the matrix is padded with the unit matrix
    a = jnp.pad(matrix, (0, size - n)) + jnp.diag((np.arange(size) >= n).astype(matrix.dtype))

    def one_panel(index, carry):
        a, free, order, pivots = carry
        columns = jax.lax.dynamic_slice_in_dim(a, index * width, width, 1)
        panel, left, panel_order, panel_pivots = _eliminate_panel(columns, free)
        if count > 1:
            a = jnp.where((free & ~left)[:, None], 0, a) + panel @ _permute_rows(a, panel_order)
            panel = jax.lax.dynamic_update_slice_in_dim(a, panel, index * width, 1)
        order = jax.lax.dynamic_update_slice_in_dim(order, panel_order, index * width, 0)
        return panel, left, order, jax.lax.dynamic_update_slice_in_dim(pivots, panel_pivots, index * width, 0)

    start = vary_carry_alike((a, jnp.ones(size, bool), jnp.zeros(size, np.int32), jnp.zeros(size, a.dtype)))
    a, _, order, pivots = jax.lax.fori_loop(0, count, one_panel, start) if count > 1 else one_panel(0, start)
    return _permute_rows(a, order[:n])[:, :n], order[:n], pivots[:n]


def _eliminate_panel(panel: Array, free: Array) -> tuple[Array, Array, Array, Array]:
    """Eliminate a panel of columns (size, width): the panel, free rows, rows of the pivots, and pivots."""

    def one_column(k, carry):
        panel, free, order, pivots = carry
        this_column = np.arange(panel.shape[1]) == k
        column = jnp.sum(jnp.where(this_column, panel, 0), axis=1)
        row = jnp.argmax(jnp.where(free, jnp.abs(column), -1)).astype(np.int32)  # the first NaN, if there is one
        this_row = np.arange(len(panel)) == row
        panel, pivot = _pivot_step(panel, this_row, this_column)
        order, pivots = jnp.where(this_column, row, order), jnp.where(this_column, pivot, pivots)
        return panel, free & ~this_row, order, pivots

    width = panel.shape[1]
    start = vary_carry_alike((panel, free, jnp.zeros(width, np.int32), jnp.zeros(width, panel.dtype)))
    return jax.lax.fori_loop(0, width, one_column, start)


def _pivot_step(a: Array, this_row: Array, this_column: Array) -> tuple[Array, Array]:
    """The array A after one column was eliminated with one row (both given as masks), and the pivot."""
    # Masks and not indices, which become gathers and scatters under `vmap`: masks are faster on the CPU, as measured.
    row = jnp.sum(jnp.where(this_row[:, None], a, 0), axis=0)
    column = jnp.sum(jnp.where(this_column, a, 0), axis=1)
    pivot = jnp.sum(jnp.where(this_column, row, 0))
    row = jnp.where(this_column, 1, row) / jnp.where(pivot == 0, 1, pivot)  # a zero is left to be reported
    return jnp.where(this_row[:, None] | this_column, 0, a) - jnp.where(this_row, -1, column)[:, None] * row, pivot


def _permute_rows(a: Array, order: Int[Array, " n"]) -> Array:
    return a.at[order].get(mode="promise_in_bounds")


# ---- with constraints: the saddle point ------------------------------------------------------------------------------
#
# M may be singular where the constraints hold what it does not: adding GᵀW G x = GᵀW c to M x − Gᵀλ = b, W diagonal,
# changes neither x nor λ and makes the augmented matrix K = M + GᵀW G regular whenever the saddle point is. Then
#
#     S = G K⁻¹ Gᵀ,   S λ = c − G K⁻¹ (b + GᵀW c),   x = K⁻¹ (b + GᵀW c + Gᵀλ)
#
# S is the Schur complement, G M⁻¹ Gᵀ where W = 0 (multibody dynamics: the Delassus matrix). Its rank is the number of
# independent constraints. The alternative, an elimination of the whole saddle point with pivoting, needs no W, but
# mixes rows of M with rows of G, and with them two thresholds for what counts as zero.


def saddle(matrix: Matrix, b: Vector, jacobian: Rows, c: Float[Array, " m"]) -> tuple[Vector, Array, Bool[Array, ""]]:
    """The solution x (n,), λ (m,) of least norm, and a flag: the saddle point is singular; `jacobian` is G (m, n)."""
    augmented, weighted = augment(matrix, jacobian)
    factorization = factorize(augmented)
    free, responses = factorization.solve(b + weighted.T @ c), factorization.solve_columns(jacobian.T)
    multipliers = least_norm(jacobian @ responses, c - jacobian @ free)
    return free + responses @ multipliers, multipliers, factorization.singular


def augment(matrix, jacobian):
    """K = M + GᵀW G (..., n, n) and W G (..., m, n), with weights W that scale every row of G to the size of M."""
    # Wₖ = max|Mᵢᵢ|/|Gₖ|² gives both terms of K the same size, in whatever units a constraint is written: neither drowns
    # the other in rounding. 10ᵈ times larger or smaller, they would cost up to d digits. W has no derivative, as
    # nothing depends on it. For arrays of NumPy or JAX.
    xp = matrix.__array_namespace__()
    size = xp.sum(jacobian**2, axis=-1)
    weights = xp.max(xp.abs(xp.diagonal(matrix, axis1=-2, axis2=-1)), axis=-1)[..., None] / xp.where(size > 0, size, 1)
    weights = weights if xp is np else jax.lax.stop_gradient(weights)
    weighted = weights[..., None] * jacobian
    return matrix + xp.swapaxes(jacobian, -1, -2) @ weighted, weighted


def dependent_rows(matrix: np.ndarray) -> dict[int, np.ndarray]:
    """The rows of G that are linear combinations of rows before them, from the Schur complement S (m, m).

    Maps each such index to the factors (m,) of the combination. A row is dependent if its component outside of those
    before it is below `rank_tolerance` of its own size, squared as S is.
    """
    independent, dependent = [], {}
    for row in range(len(matrix)):
        among = matrix[np.ix_(independent, independent)]
        scale = 1 / np.sqrt(np.diagonal(among))
        factors = scale * np.linalg.solve(scale[:, None] * among * scale, scale * matrix[independent, row])
        outside = matrix[row, row] - factors @ matrix[independent, row]
        if outside <= rank_tolerance(matrix.dtype) * matrix[row, row]:
            # A row that makes up less than a millionth of the combination is not worth a name in a message.
            part = np.abs(factors / scale) > 1e-6 * np.sqrt(matrix[row, row])
            dependent[row] = np.zeros(len(matrix))
            dependent[row][independent] = np.where(part, factors, 0)
        else:
            independent.append(row)
    return dependent


def rank_tolerance(dtype) -> float:
    """The size, relative to a constraint, below which its independent component counts as zero: eps^(2/3)."""
    # It is compared with pivots of S. One of eps^(2/3) = 4e-11 is 2e5 units of round-off, so that redundant
    # constraints, whose pivots are some units, never count as independent, which would give multipliers of any size. A
    # constraint that differs from the others by less than eps^(1/3) = 6e-6 of its length counts as redundant; with
    # twice the tolerance that is 9e-6.
    return float(jnp.finfo(dtype).eps) ** (2 / 3)


def least_norm(matrix: Matrix, b: Vector) -> Vector:
    """The shortest x with S x = b for a symmetric S (m, m), of rank by `rank_tolerance`, and b in its range."""
    return _inverse_on_range(matrix) @ b


@jax.custom_jvp
def _inverse_on_range(matrix: Matrix) -> Matrix:
    """The pseudo-inverse of a symmetric matrix whose rank is decided by `rank_tolerance`."""
    # It is applied to right-hand sides in the range alone: what dependent constraints ask for is tested to be
    # consistent before a motion starts. So it chooses among multipliers that all give the same motion, and hides no
    # contradiction.
    scaled, scale = unit_diagonal(matrix)
    inverse, basis, pairs = _factor_independent(scaled, scale)
    some = scale[:, None] * inverse * scale  # solves S x = b, but its x need not be the shortest
    # The part of x in the range of S is the shortest one: P x with P = B (BᵀB)⁻¹ Bᵀ, where B is the basis of the range
    # scaled back. BᵀB is at least the unit matrix; where B has no column, that of the unit matrix takes its place.
    basis = basis / scale[:, None] * (scale @ pairs)
    gram = basis.T @ basis + jnp.diag(1 - jnp.sum(pairs, axis=0))
    projector = basis @ factorize(gram).solve_columns(basis.T)
    return projector @ some @ projector


@_inverse_on_range.defjvp
def _inverse_on_range_jvp(primals, tangents):
    # Golub & Pereyra, SIAM J. Numer. Anal. 10 (1973) 413, eq. (4.12), for a symmetric matrix of constant rank. Not by
    # way of the eigenvectors, which have no derivative where eigenvalues meet.
    (matrix,), (tangent,) = primals, tangents
    inverse = _inverse_on_range(matrix)
    outside = jnp.eye(len(matrix), dtype=matrix.dtype) - inverse @ matrix
    of_range = outside @ tangent @ inverse @ inverse
    return inverse, of_range + of_range.T - inverse @ tangent @ inverse


def rank(matrix: Matrix) -> Int[Array, ""]:
    """The number of independent rows of a symmetric matrix (m, m), by `rank_tolerance`."""
    return jnp.sum(_factor_independent(matrix, jnp.ones(len(matrix), matrix.dtype))[2]).astype(int)


def _factor_independent(matrix: Matrix, scale: Vector) -> tuple[Matrix, Matrix, Matrix]:
    """X, B and Q of a symmetric A, (m, m) each, by elimination with complete pivoting.

    A X A = A; B is a basis of the range of A; Q is 1 where a row was the pivot of a column. The elimination ends where
    all that remains is below `rank_tolerance`. B has a column for every column that had a pivot, and is Q in the rows
    of the pivots; its other columns are zero. A is positive semi-definite where M is, but need not be. Of pivots within
    a factor of ten of the largest, the one is taken that is largest before `scale` was applied, which keeps B
    well-conditioned; the factor bounds what that costs X, one digit.
    """
    m = len(matrix)

    def one_pivot(_, carry):
        a, pairs = carry
        free = (jnp.sum(pairs, axis=1) == 0)[:, None] & (jnp.sum(pairs, axis=0) == 0)
        size = jnp.where(free, jnp.abs(a), -1)
        largest = jnp.max(size)  # NaN, if there is one: the comparisons are written so that it reaches the result
        good = free & ~(size < 0.1 * largest)
        index = jnp.argmax(jnp.where(good, size / (scale[:, None] * scale), -1))
        row, column = np.arange(m) == index // m, np.arange(m) == index % m
        counts = ~(largest <= rank_tolerance(a.dtype))
        a = jnp.where(counts, _pivot_step(a, row, column)[0], a)
        return a, pairs + (row[:, None] & column & counts)

    a, pairs = jax.lax.fori_loop(0, m, one_pivot, vary_carry_alike((matrix, jnp.zeros_like(matrix)), scale))
    rows, columns = jnp.sum(pairs, axis=1) > 0, jnp.sum(pairs, axis=0) > 0
    inverse = pairs.T @ jnp.where(rows[:, None] & columns, a, 0) @ pairs.T
    return inverse, pairs + jnp.where(~rows[:, None] & columns, -a, 0), pairs


# ---- many small systems side by side, in NumPy -----------------------------------------------------------------------


def solve_many(matrix: Matrices, b: np.ndarray) -> np.ndarray:
    """X (S, n, k) with M X = b for S symmetric matrices M, as `Factorization.solve`: NaN where M is singular."""
    if matrix.shape[1] == 1:
        return b / np.where(matrix == 0, np.nan, matrix)
    scaled, scale = unit_diagonal(0.5 * (matrix + np.swapaxes(matrix, 1, 2)))
    sizes = np.abs(np.linalg.eigvalsh(np.where(_is_free_of_nan(scaled), scaled, 0)))
    regular = sizes.min(axis=1) > singular_threshold(matrix.shape[1], matrix.dtype) * sizes.max(axis=1)
    regular, unit = regular[:, None, None], np.eye(matrix.shape[1], dtype=matrix.dtype)
    x = np.linalg.solve(np.where(regular, scaled, unit), scale[:, :, None] * b)
    return np.where(regular, scale[:, :, None] * x, np.nan)


def saddle_many(matrix: Matrices, b, jacobian, c) -> tuple[np.ndarray, np.ndarray]:
    """X (S, n, k), Λ (S, m, k) of S saddle points, as `saddle`, for b (S, n, k), c (S, m, k) and G (S, m, n), m ≥ 0."""
    if not jacobian.shape[1]:
        return solve_many(matrix, b), c
    augmented, weighted = augment(matrix, jacobian)
    right = b + np.swapaxes(weighted, 1, 2) @ c
    solutions = solve_many(augmented, np.concatenate([right, np.swapaxes(jacobian, 1, 2)], axis=2))
    free, responses = np.split(solutions, [b.shape[2]], axis=2)
    multipliers = _least_norm_batch(jacobian @ responses, c - jacobian @ free)
    return free + responses @ multipliers, multipliers


def schur_complements(matrix: Matrices, jacobian: np.ndarray) -> np.ndarray:
    """The Schur complements G K⁻¹ Gᵀ (S, m, m) at S states, as `Motion.schur_complement` at one."""
    return jacobian @ solve_many(augment(matrix, jacobian)[0], np.swapaxes(jacobian, 1, 2))


def _least_norm_batch(matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The shortest X (S, m, k) with S X = b, as `least_norm`, for S symmetric matrices (S, m, m) of any rank."""
    scaled, scale = unit_diagonal(matrix)
    finite, scale = _is_free_of_nan(scaled), scale[:, :, None]
    values, vectors = np.linalg.eigh(np.where(finite, scaled, np.eye(matrix.shape[1], dtype=matrix.dtype)))
    in_range = np.abs(values) > rank_tolerance(matrix.dtype)
    inverse = np.where(in_range, 1 / np.where(in_range, values, 1), 0)[:, :, None]
    x = scale * (vectors @ (inverse * (np.swapaxes(vectors, 1, 2) @ (scale * b))))
    if not in_range.all():  # the part of x in the kernel of S is removed: the kernel of the scaled matrix, scaled back
        kernel = np.where(in_range[:, None, :], 0, scale * vectors)
        transposed = np.swapaxes(kernel, 1, 2)
        gram = transposed @ kernel + in_range[:, :, None] * np.eye(matrix.shape[1], dtype=matrix.dtype)
        x = x - kernel @ np.linalg.solve(gram, transposed @ x)
    return np.where(finite, x, np.nan)


def _is_free_of_nan(matrix: np.ndarray) -> np.ndarray:
    """For each of S matrices (S, n, n): True if it has no NaN, for which LAPACK raises; shape (S, 1, 1)."""
    return np.asarray(np.isfinite(matrix).all(axis=(1, 2), keepdims=True))
