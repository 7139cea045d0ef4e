"""Eigenvalues and eigenvectors with derivatives, also where eigenvalues meet.

LAPACK is called on the host by NumPy and not by XLA, whose batched kernels may wait for each other for ever (see
`_linear`). One call takes a whole batch.

Where eigenvalues meet, their eigenvectors are any basis of a space, and neither the single eigenvalues nor the vectors
have derivatives; what does not depend on the choice of basis has. The rules here leave out the part of a derivative
that turns the basis within such a space, which is 0/0. First derivatives of all that does not depend on the choice are
then right: symmetric functions of the eigenvalues that meet, projectors on their space. Of second derivatives that
holds for the sum of the eigenvalues alone.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Array, Float

from lagjax._equations import factorize, least_norm, truncated_svd

Matrix = Float[Array, "n n"]

# Eigenvalues that differ by less than this many units of round-off of the largest count as equal. LAPACK's errors are a
# few units times √n or so; with a closer bound a pair that rounding has split would have derivatives of 1/eps.
_UNITS = 32


# ---- the host --------------------------------------------------------------------------------------------------------


def _call_numpy(function: Callable, shapes: tuple, *arrays) -> tuple:
    """Call a NumPy function on the host inside a traced program; return arrays of these `shapes`, with batch axes."""

    def fill_buffers(_, places, *buffers):
        for place, value in zip(places, function(*map(np.asarray, buffers)), strict=True):
            np.asarray(place)[...] = value

    def others(*x):
        return jax.pure_callback(
            lambda *x: tuple(function(*map(np.asarray, x))), shapes, *x, vmap_method="broadcast_all"
        )

    cpu = buffer_callback(fill_buffers, shapes, vmap_method="broadcast_all")
    return tuple(jax.lax.platform_dependent(*arrays, cpu=cpu, default=others))


def _map_finite(function: Callable, *arrays: np.ndarray) -> list[np.ndarray]:
    """Apply `function` to every matrix of a batch (…, n, n); NaN if not finite or LAPACK fails."""
    batch, results = arrays[0].shape[:-2], []
    for members in zip(*(x.reshape(-1, *x.shape[-2:]) for x in arrays), strict=True):
        try:
            finite = all(np.isfinite(x).all() for x in members)
            results.append(function(*members) if finite else None)
        except np.linalg.LinAlgError:
            results.append(None)
    shapes = next((r for r in results if r is not None), None)
    if shapes is None:
        shapes = function(*(np.eye(x.shape[-1], dtype=x.dtype) for x in arrays))
    columns = zip(*(r or [x * np.nan for x in shapes] for r in results), strict=True)
    return [np.reshape(column, (*batch, *column[0].shape)) for column in columns]


# ---- K x = λ M x -----------------------------------------------------------------------------------------------------


@jax.custom_jvp
def symmetric_modes(stiffness: Matrix, mass: Matrix) -> tuple[Float[Array, " n"], Matrix]:
    """Return λ (n,), ascending, and X (n, n) with K X = M X Λ, XᵀM X = 1; NaN if M is not positive definite."""
    n = len(mass)
    shapes = jax.ShapeDtypeStruct((n,), mass.dtype), jax.ShapeDtypeStruct((n, n), mass.dtype)
    return _call_numpy(lambda *x: _map_finite(_symmetric_modes, *x), shapes, stiffness, mass)  # pyright: ignore[reportReturnType]


def _symmetric_modes(stiffness: np.ndarray, mass: np.ndarray) -> list[np.ndarray]:
    """Return λ and X of one pair; a final Rayleigh quotient makes small eigenvalues as exact as K allows."""
    stiffness, mass = 0.5 * (stiffness + stiffness.T), 0.5 * (mass + mass.T)
    lower = np.linalg.inv(np.linalg.cholesky(mass))
    vectors = lower.T @ np.linalg.eigh(lower @ stiffness @ lower.T)[1]
    vectors /= np.sqrt(np.einsum("ij,ij->j", vectors, mass @ vectors))
    values = np.einsum("ij,ij->j", vectors, stiffness @ vectors)
    order = np.argsort(values, kind="stable")
    return [values[order], vectors[:, order]]


@symmetric_modes.defjvp
def _symmetric_modes_jvp(primals, tangents):
    values, vectors = symmetric_modes(*primals)
    by_stiffness, by_mass = (vectors.T @ (0.5 * (x + x.T)) @ vectors for x in tangents)
    change = by_stiffness - by_mass * values  # xᵢᵀ (dK − λⱼ dM) xⱼ
    turns = change * _inverse_gaps(values) * (1 - jnp.eye(len(values), dtype=values.dtype))
    return (values, vectors), (jnp.diagonal(change), vectors @ jnp.where(_equal_pairs(values), -0.5 * by_mass, turns))


def _equal_pairs(values) -> Array:
    """Return (n, n): True where two eigenvalues are equal up to rounding, and on the diagonal."""
    values = jax.lax.stop_gradient(values)
    size = jnp.max(jnp.abs(values))
    allowed = _UNITS * len(values) ** 0.5 * jnp.finfo(size.dtype).eps * size
    return jnp.abs(values[:, None] - values) <= allowed


def _inverse_gaps(values) -> Array:
    """Return 1/(λⱼ − λᵢ), (n, n), and 0 where the two are equal."""
    same = _equal_pairs(values)
    return jnp.where(same, 0, 1 / jnp.where(same, 1, values - values[:, None]))


# ---- A x = s x -------------------------------------------------------------------------------------------------------


def exponents_and_modes(matrix: Float[Array, "2n 2n"]) -> tuple[Array, Array]:
    """Return eigenvalues s (2n,) and eigenvectors (2n, 2n), in columns, of a real matrix; complex.

    The first n are the modes: of a complex pair the one with Im s > 0; real ones are paired, the largest with the
    smallest and so on, and the larger is among the first. Those are sorted by Im s, growing ones first; the last n are
    their partners. Derivatives are NaN where there is no basis of eigenvectors.
    """
    return _decompose(matrix)[:2]


@jax.custom_jvp
def _decompose(matrix: Array) -> tuple[Array, Array, Array]:
    """Return s, X and X⁻¹."""
    n, dtype = len(matrix), jnp.result_type(matrix, jnp.complex64)
    shapes = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in ((n,), (n, n), (n, n)))
    return _call_numpy(lambda a: _map_finite(_eigendecompose, a), shapes, matrix)  # pyright: ignore[reportReturnType]


# A basis of eigenvectors that has lost half of the digits is none: rounding splits a Jordan block of two by √eps.
_WORST_BASIS = 1e7


def _eigendecompose(matrix: np.ndarray) -> list[np.ndarray]:
    """Return s (n,), X (n, n) and X⁻¹ of one matrix, as `_decompose`."""
    values, vectors = np.linalg.eig(matrix)
    order = _eigenvalue_order(values)
    values, vectors = values[order].astype(complex), vectors[:, order].astype(complex)
    broken = np.linalg.cond(vectors) > _WORST_BASIS
    inverse = np.full_like(vectors, np.nan) if broken else np.linalg.inv(vectors)
    return [x.astype(np.result_type(matrix, np.complex64)) for x in (values, vectors, inverse)]


def _eigenvalue_order(values: np.ndarray) -> np.ndarray:
    """Return the indices (n,) that sort eigenvalues (n,) into the order of `exponents_and_modes`."""
    reals, imaginary = np.real(values), np.imag(values)
    real = np.flatnonzero(imaginary == 0)
    real = real[np.argsort(-reals[real], kind="stable")]
    half = len(real) // 2
    upper = np.flatnonzero(imaginary > 0)
    upper = upper[np.lexsort((-reals[upper], imaginary[upper]))]
    # LAPACK lists the two of a pair side by side, Im s > 0 first.
    return np.concatenate([real[:half], upper, real[::-1][:half], upper + 1])


@_decompose.defjvp
def _decompose_jvp(primals, tangents):
    values, vectors, inverse = _decompose(*primals)
    change = inverse @ tangents[0].astype(values.dtype) @ vectors
    turns = change * _inverse_gaps(values)
    return (values, vectors, inverse), (jnp.diagonal(change), vectors @ turns, -turns @ inverse)


# ---- spaces ----------------------------------------------------------------------------------------------------------


def _null_space(rows: Float[Array, "m n"], rank: int) -> Float[Array, "n n-rank"]:
    """Return an orthonormal basis, in columns, of the null space of m rows of this rank; without derivatives."""
    n = rows.shape[1]
    lengths = jnp.linalg.norm(rows, axis=1, keepdims=True)
    unit = jax.lax.stop_gradient(rows / jnp.where(lengths > 0, lengths, 1))
    shape = (jax.ShapeDtypeStruct((n, n - rank), rows.dtype),)
    return _call_numpy(lambda g: _map_finite(lambda a: [truncated_svd(a).right[:, rank:]], g), shape, unit)[0]


def tangent_basis(jacobian: Float[Array, "m n"], rank: int) -> Float[Array, "n n-rank"]:
    """Return a basis of the deviations that constraints allow, in columns, with a minimal derivative by q."""
    if not len(jacobian):
        return jnp.eye(jacobian.shape[1], dtype=jacobian.dtype)
    basis = _null_space(jacobian, rank)
    # Zero in value, as `jacobian @ basis` is; its derivative keeps the basis on the tangent space.
    gram, off = jacobian @ jacobian.T, jacobian @ basis
    if rank == len(jacobian):
        return basis - jacobian.T @ factorize(gram).solve_columns(off)
    return basis - jacobian.T @ jax.vmap(lambda b: least_norm(gram, b), in_axes=1, out_axes=1)(off)
