"""The symmetric linear solve M x = b behind every acceleration.

M = ∂²L/∂q̇² is symmetric and, for an unusual L, indefinite; it must be regular. It is scaled to a unit diagonal first
(Jacobi scaling: within a factor n of the best diagonal scaling for positive definite M, van der Sluis 1969), so that
masses of very different size cost no accuracy, and then factorised by LU with pivoting. A matrix that is singular to
working precision gives NaN, never a number: no pseudo-inverse, no regularisation. The caller reports it.
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


def _diagonal_scale(matrix: jax.Array) -> jax.Array:
    """1/√|Mii|, or the row's largest entry where the diagonal is zero, or 1 where the whole row is."""
    diagonal = jnp.abs(jnp.diagonal(matrix))
    size = jnp.where(diagonal > 0, diagonal, jnp.max(jnp.abs(matrix), axis=1))
    return jax.lax.rsqrt(jnp.where(size > 0, size, 1))


def _scaled(matrix: jax.Array, scale: jax.Array) -> jax.Array:
    return scale[:, None] * matrix * scale
