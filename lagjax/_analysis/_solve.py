"""Newton's method in JAX, damped far from a root; its linear systems need be neither symmetric nor regular.

`newton` starts near a root and converges to rounding, `levenberg_marquardt` starts far from one. Undamped steps are
those of `shortest_solution`. No kernel of LAPACK runs in XLA, where batched ones may deadlock: so these are not the
solvers of optimistix, whose steps are QR and LU decompositions. The iteration of orbits and paths,
`lagjax._analysis.orbits._shooting`, is in NumPy: a trial there is a run of machine code, of as many members as have not
converged.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lagjax._equations import factorize, invert, least_norm, singular_threshold

Matrix = Float[Array, "n n"]
Vector = Float[Array, " n"]


def shortest_solution(matrix: Matrix, b: Vector, unit: Vector | float = 1.0) -> Vector:
    """Solve A x = b; if A is singular, by pivots of the scaled A, return the x of least norm in units `unit` (n,).

    Linear in b, with derivatives by A and b.
    """
    matrix = matrix * unit
    rows, columns = (jax.lax.stop_gradient(scale) for scale in _equilibration_factors(matrix))
    inverse, order, pivots = invert(jax.lax.stop_gradient(rows[:, None] * matrix * columns))
    inverse, sizes = jnp.zeros_like(inverse).at[:, order].set(inverse), jnp.abs(pivots)
    singular = jnp.min(sizes) <= singular_threshold(len(matrix), matrix.dtype) * jnp.max(sizes)

    def refined(a, inverse):
        return lambda _, b: inverse @ b + inverse @ (b - a @ (inverse @ b))

    def regular(matrix, b):
        a = rows[:, None] * matrix * columns
        solve, transposed = refined(a, inverse), refined(a.T, inverse.T)
        return columns * jax.lax.custom_linear_solve(lambda x: a @ x, rows * b, solve, transpose_solve=transposed)

    def shortest(matrix, b):
        return matrix.T @ least_norm(matrix @ matrix.T, b)

    return unit * jax.lax.cond(singular, shortest, regular, matrix, b)


def shortest_preimage(linear: Callable[[Vector], Vector], right: Vector, unit: Vector | float = 1.0) -> Vector:
    """Return the x of least norm, in units (n,), with linear(x) = right: for the implicit derivative of a root."""
    return shortest_solution(jax.vmap(linear, out_axes=1)(jnp.eye(right.size, dtype=right.dtype)), right, unit)


def newton(f: Callable[[Vector], Vector], start: Vector, unit: Vector | float = 1.0) -> Vector:
    """Return x with f(x) = 0 by Newton's method from `start` (n,), for `jax.lax.custom_root`; the caller checks f(x).

    A step is halved until f is finite and no larger but for rounding; singular steps are of least norm in `unit` (n,).
    """

    def moves(carry):
        _, moved, count = carry
        return (moved > _AT_REST) & (count < STEPS)

    def once(carry):
        x, _, count = carry
        value, jacobian = f(x), jax.jacfwd(f)(x)
        new = x - _shorten_step(f, x, value, shortest_solution(jacobian, value, unit))
        # Each number of x by what it makes of f.
        weight = 1 / _equilibration_factors(jacobian)[1]
        size = jnp.max(weight * jnp.maximum(jnp.abs(new), jnp.abs(x)), initial=jnp.finfo(x.dtype).tiny)
        return new, jnp.max(weight * jnp.abs(new - x), initial=0.0) / size, count + 1

    return jax.lax.while_loop(moves, once, (start, jnp.ones((), start.dtype), 0))[0]


def is_root(
    f: Callable, x: Vector, given: Vector | float = 0.0, *, least: Vector | float = 0.0, power: float = 0.6
) -> Bool[Array, ""]:
    """True if f(x) = 0: each number within eps^`power` of the size of its terms, |∂f/∂x| |x| + |given|.

    `least` (n,) bounds |x| from below. Newton's method converges to some eps; if it goes astray, half of the digits
    differ.
    """
    size = jnp.abs(jax.jacfwd(f)(x)) @ jnp.maximum(least, jnp.abs(x)) + jnp.abs(given)
    return jnp.all(jnp.abs(f(x)) <= jnp.finfo(x.dtype).eps ** power * size)


def levenberg_marquardt(f: Callable, start: Vector, least: Vector, unit: Vector) -> Vector:
    """Minimise |f(z)|², f (m,), from `start` by damped steps; return z (n,) when they are small or no longer help.

    `least` (n,) are the sizes below which numbers of z do not count, `unit` (n,) units in which they compare.

    Rows are weighted by the size of their gradient at the start, columns by the largest they had so far (Moré): the
    user's units do not matter. The damping goes down with |r|, which keeps the convergence quadratic where solutions
    are not isolated (Fan & Yuan, Computing 74 (2005) 23).
    """
    weights = reciprocal(jnp.sqrt(jnp.sum((jax.jacfwd(f)(start) * unit) ** 2, axis=1)))

    def weighted(z):
        return weights * f(z)

    def moves(carry):
        _, value, moved, _, _, count = carry
        return (moved > NO_STEP) & (count < DAMPED_STEPS) & (jnp.max(jnp.abs(value)) > 0)

    def once(carry):
        z, value, moved, damping, scale, count = carry
        jacobian = jax.jacfwd(weighted)(z)
        scale = jnp.maximum(scale, jnp.sqrt(jnp.sum(jacobian**2, axis=0)))
        d = jnp.where(scale > 0, scale, unit)
        scaled = jacobian / d
        size = jnp.sqrt(jnp.sum(value**2))
        part = size / (size + jnp.max(jnp.abs(jacobian) @ jnp.maximum(least, jnp.abs(z))))
        normal = scaled.T @ scaled + (damping * part + 1e-15) * jnp.eye(z.size, dtype=z.dtype)
        step = -factorize(normal).solve(scaled.T @ value) / d
        new = weighted(z + step)
        gain = jnp.sum(value**2) - jnp.sum(new**2)
        expected = jnp.sum(value**2) - jnp.sum((value + jacobian @ step) ** 2)
        ratio = jnp.where(expected > 0, gain / jnp.where(expected > 0, expected, 1), 0.0)
        better = (gain > 0) & jnp.all(jnp.isfinite(new))
        damping = jnp.where(ratio > 0.75, damping / 4, jnp.where((ratio < 0.25) | ~better, damping * 4, damping))
        # The most that a step makes of a number of f(z), as a fraction of what the numbers of z make of it.
        of_f, sizes = jnp.abs(jacobian), jnp.maximum(jnp.maximum(least, jnp.abs(z)), jnp.abs(step))
        length = jnp.max(of_f @ jnp.abs(step) * reciprocal(of_f @ sizes))
        stuck = ~better & ((length < NO_STEP) | ~jnp.isfinite(length))
        moved = jnp.where(better, length, jnp.where(stuck, 0.0, moved))
        return jnp.where(better, z + step, z), jnp.where(better, new, value), moved, damping, scale, count + 1

    one = jnp.ones((), start.dtype)
    carry = start, weighted(start), one, 0.1 * one, jnp.zeros_like(start), jnp.zeros((), int)
    return jax.lax.while_loop(moves, once, carry)[0]


# A step that is nothing, as a fraction of the numbers of z. Damped steps: 10 to 30 are usual, and twice as many change
# nothing where there is a solution.
NO_STEP, DAMPED_STEPS = 1e-10, 200


def _shorten_step(f: Callable, x: Vector, value: Vector, step: Vector) -> Vector:
    size = jnp.sum(value**2) * (1 + 1e-6)

    def fails(carry):
        step, count = carry
        return ~(jnp.sum(f(x - step) ** 2) <= size) & (count < HALVINGS)

    return jax.lax.while_loop(fails, lambda carry: (0.5 * carry[0], carry[1] + 1), (step, 0))[0]


_AT_REST = 1e-14  # of the size of x: some tens of roundings, the square of which is left
# Newton steps: one where f is linear, five to new coordinates of a state, ten to a velocity in relativity. Halvings of
# one that leads out of where f is defined, as beyond the velocity of light.
STEPS, HALVINGS = 50, 30


def _equilibration_factors(matrix: Matrix) -> tuple[Vector, Vector]:
    """Return factors of the rows and of the columns that scale the largest entry of each to 1; 1 for zero rows."""
    rows = reciprocal(jnp.max(jnp.abs(matrix), axis=1))
    return rows, reciprocal(jnp.max(jnp.abs(rows[:, None] * matrix), axis=0))


def reciprocal(size: Any) -> Any:
    """Return 1/x of sizes (n,), of NumPy or JAX; 1 where x is zero."""
    xp = size.__array_namespace__()
    return xp.where(size > 0, 1 / xp.where(size > 0, size, 1), 1)
