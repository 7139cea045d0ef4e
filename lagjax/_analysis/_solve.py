"""Linear systems that need not be symmetric, nor regular: for Newton's method and its derivative. No LAPACK in XLA."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lagjax._linear import inverted, least_norm, singular_threshold

Matrix = Float[Array, "n n"]
Vector = Float[Array, " n"]


def shortest_solution(matrix: Matrix, b: Vector) -> Vector:
    """x with A x = b, the shortest one where A is singular and b in its range.

    Linear in b, with derivatives by both. A singular A is one whose pivots, of rows and columns of unit size, say so.
    """
    rows, columns = (jax.lax.stop_gradient(scale) for scale in _scales(matrix))
    inverse, singular = _inverse(jax.lax.stop_gradient(rows[:, None] * matrix * columns))

    def regular(matrix, b):
        return columns * _regular(rows[:, None] * matrix * columns, rows * b, inverse)

    return jax.lax.cond(singular, _shortest, regular, matrix, b)


def shortest_preimage(linear: Callable[[Vector], Vector], right: Vector) -> Vector:
    """x with linear(x) = right, the shortest one: what the implicit derivative of a root asks for."""
    return shortest_solution(jax.vmap(linear, out_axes=1)(jnp.eye(right.size, dtype=right.dtype)), right)


def newton(f: Callable[[Vector], Vector], start: Vector) -> Vector:
    """x with f(x) = 0 that Newton's method reaches from `start` (n,), for `jax.lax.custom_root`; look at f(x).

    A step is halved until f is finite and smaller, or no larger but for rounding.
    """

    def moves(carry):
        _, moved, count = carry
        return (moved > _AT_REST) & (count < _STEPS)

    def once(carry):
        x, _, count = carry
        value, jacobian = f(x), jax.jacfwd(f)(x)
        new = x - _shortened(f, x, value, shortest_solution(jacobian, value))
        # Each number of x in units of its own, in which all make as much of f.
        unit = 1 / _scales(jacobian)[1]
        size = jnp.max(unit * jnp.maximum(jnp.abs(new), jnp.abs(x)), initial=jnp.finfo(x.dtype).tiny)
        return new, jnp.max(unit * jnp.abs(new - x), initial=0.0) / size, count + 1

    return jax.lax.while_loop(moves, once, (start, jnp.ones((), start.dtype), 0))[0]


def is_root(f: Callable[[Vector], Vector], x: Vector, given: Vector) -> Bool[Array, ""]:
    """Whether f(x) = 0: each number of it within eps^0.6 of what x makes of it, or of a term that is `given` (n,).

    Newton's method comes to some eps; where it has gone astray it is off by more than half of the digits.
    """
    size = jnp.abs(jax.jacfwd(f)(x)) @ jnp.abs(x) + jnp.abs(given)
    return jnp.all(jnp.abs(f(x)) <= jnp.finfo(x.dtype).eps ** 0.6 * size)


def _shortened(f: Callable, x: Vector, value: Vector, step: Vector) -> Vector:
    size = jnp.sum(value**2) * (1 + 1e-6)

    def fails(carry):
        step, count = carry
        return ~(jnp.sum(f(x - step) ** 2) <= size) & (count < _HALVINGS)

    return jax.lax.while_loop(fails, lambda carry: (0.5 * carry[0], carry[1] + 1), (step, 0))[0]


_AT_REST = 1e-14  # of the size of x: some tens of roundings, the square of which is left
# Newton steps: one where f is linear, five to new coordinates of a state, ten to a velocity in relativity. Halvings of
# one that leads out of where f is defined, as beyond the velocity of light.
_STEPS, _HALVINGS = 50, 30


def _scales(matrix: Matrix) -> tuple[Vector, Vector]:
    """Factors of the rows and of the columns that give each a largest entry of 1; 1 for those of zeros."""
    rows = _reciprocal(jnp.max(jnp.abs(matrix), axis=1))
    return rows, _reciprocal(jnp.max(jnp.abs(rows[:, None] * matrix), axis=0))


def _reciprocal(size: Vector) -> Vector:
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)


def _inverse(matrix: Matrix) -> tuple[Matrix, Bool[Array, ""]]:
    """The inverse, and whether there is none to working precision."""
    inverse, order, pivots = inverted(matrix)
    sizes, n = jnp.abs(pivots), len(matrix)
    singular = jnp.min(sizes) <= singular_threshold(n, matrix.dtype) * jnp.max(sizes)
    return jnp.zeros_like(matrix).at[:, order].set(inverse), singular


def _regular(matrix: Matrix, b: Vector, inverse: Matrix) -> Vector:
    def refined(a, inverse, b):
        x = inverse @ b
        return x + inverse @ (b - a @ x)

    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        b,
        lambda _, b: refined(matrix, inverse, b),
        transpose_solve=lambda _, b: refined(matrix.T, inverse.T, b),
    )


def _shortest(matrix: Matrix, b: Vector) -> Vector:
    return matrix.T @ least_norm(matrix @ matrix.T, b)
