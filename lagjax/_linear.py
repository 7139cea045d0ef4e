"""The symmetric linear solve M x = b behind every acceleration, for arrays and for scalars.

M = ∂²L/∂q̇² is symmetric and, for an unusual L, indefinite; it must be regular. A matrix that is singular to working
precision gives NaN, never a number: no pseudo-inverse, no regularisation. The caller reports it.

`factorize` is for arrays: M is scaled to a unit diagonal (Jacobi scaling: within a factor n of the best diagonal
scaling for positive definite M, van der Sluis 1969), so that masses of very different size cost no accuracy, and then
factorised by LU with pivoting. `eliminate` is for scalar programs: the same solution, written out entry by entry.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class Factorization(eqx.Module):
    """A factorised symmetric matrix, and whether it is singular to working precision (a NaN in it is not that)."""

    matrix: jax.Array
    scale: jax.Array
    factors: tuple[jax.Array, jax.Array]
    singular: jax.Array

    def solve(self, b: jax.Array) -> jax.Array:
        """x with M x = b; NaN where M is singular. Differentiated implicitly: one more solve with the same factors."""

        def by_factors(_, scaled):
            return jax.scipy.linalg.lu_solve(self.factors, scaled)

        # `b` scaled, solved, scaled back; M is symmetric, so the transpose solve is the solve.
        x = self.scale * jax.lax.custom_linear_solve(
            lambda y: _scaled(self.matrix, self.scale) @ y, self.scale * b, by_factors, symmetric=True
        )
        return jnp.where(self.singular, jnp.nan, x)


def factorize(matrix: jax.Array) -> Factorization:
    """Scale and factorise a symmetric matrix of shape (n, n)."""
    matrix = 0.5 * (matrix + matrix.T)
    scale = jax.lax.stop_gradient(_diagonal_scale(matrix))
    factors = jax.scipy.linalg.lu_factor(jax.lax.stop_gradient(_scaled(matrix, scale)))
    pivots = jnp.abs(jnp.diagonal(factors[0]))
    threshold = singular_threshold(matrix.shape[0], matrix.dtype)
    return Factorization(matrix, scale, factors, jnp.min(pivots) <= threshold * jnp.max(pivots))


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


def eliminate(matrix: list[list], b: list, zeros: np.ndarray, dtype) -> tuple[list, jax.Array]:
    """x with M x = b, and whether M is singular, as straight-line arithmetic on scalars.

    `zeros` marks the entries of M that are zero whatever the state; whatever they would contribute is left out. Two
    coordinates are solved by Cramer's rule, which needs no pivoting. More are solved by M = L D Lᵀ without pivoting,
    which is stable for positive definite M, and no diagonal scaling would change it. A pivot that cancels to round-off
    is singularity; it is replaced by NaN.
    """
    small = singular_threshold(len(b), dtype)
    return _cramer(matrix, b, zeros, small) if len(b) == 2 else _ldl(matrix, b, zeros, small)


def _cramer(matrix, b, zeros, small):
    (a, c), (_, d) = matrix
    if zeros[0, 1]:
        return [b[0] / a, b[1] / d], (a == 0) | (d == 0)
    product, square = a * d, c * c
    determinant = product - square
    singular = jnp.abs(determinant) <= small * jnp.maximum(jnp.abs(product), square)
    inverse = 1 / jnp.where(singular, jnp.nan, determinant)
    return [(d * b[0] - c * b[1]) * inverse, (a * b[1] - c * b[0]) * inverse], singular


def _ldl(matrix, b, zeros, small):
    n, singular = len(b), jnp.zeros((), bool)
    filled = ~zeros  # where L has entries: those of M and what elimination fills in
    lower, scaled, inverse = {}, {}, [None] * n  # L, L D and D⁻¹, column by column
    for j in range(n):
        before = [k for k in range(j) if filled[j, k]]
        pivot = matrix[j][j]
        for k in before:
            pivot = pivot - lower[j, k] * scaled[j, k]
        if before or zeros[j, j]:
            lost = pivot <= small * matrix[j][j]
            singular, pivot = singular | lost, jnp.where(lost, jnp.nan, pivot)
        else:
            singular = singular | (pivot == 0)
        inverse[j] = 1 / pivot
        for i in range(j + 1, n):
            shared = [k for k in before if filled[i, k]]
            if filled[i, j] or shared:
                filled[i, j] = True
                entry = matrix[i][j]
                for k in shared:
                    entry = entry - lower[i, k] * scaled[j, k]
                scaled[i, j] = entry
                lower[i, j] = entry * inverse[j]
    x = list(b)
    for i in range(n):
        for k in range(i):
            if filled[i, k]:
                x[i] = x[i] - lower[i, k] * x[k]
    x = [x[i] * inverse[i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            if filled[k, i]:
                x[i] = x[i] - lower[k, i] * x[k]
    return x, singular


def _diagonal_scale(matrix: jax.Array) -> jax.Array:
    """1/√|Mii|, or the row's largest entry where the diagonal is zero, or 1 where the whole row is."""
    diagonal = jnp.abs(jnp.diagonal(matrix))
    size = jnp.where(diagonal > 0, diagonal, jnp.max(jnp.abs(matrix), axis=1))
    return jax.lax.rsqrt(jnp.where(size > 0, size, 1))


def _scaled(matrix: jax.Array, scale: jax.Array) -> jax.Array:
    return scale[:, None] * matrix * scale
