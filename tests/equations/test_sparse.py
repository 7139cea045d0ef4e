"""The forms of a symmetric matrix whose pattern is known, against LAPACK."""

import jax
import numpy as np
import pytest
from scipy.sparse import csr_array

from lagjax._equations import Band, Blocks, Diagonal, MatrixFree, Sparse, form_of, refine

SIZE = 60


def random_pattern(kind: str) -> np.ndarray:
    rng, n = np.random.default_rng(3), SIZE
    pattern = np.eye(n, dtype=bool)
    order = rng.permutation(n)
    if kind == "blocks":  # of 1, 2 and 7
        for members in np.split(order, [1, 2, 4, 6, 13, 20]):
            members = members[:7]
            pattern[np.ix_(members, members)] = True
    elif kind == "band":
        for distance in (1, 2, 3):
            pattern[order[:-distance], order[distance:]] = True
    elif kind == "sparse":
        pattern |= rng.random((n, n)) < 0.1
    elif kind == "dense":
        pattern[:] = True
    return pattern | pattern.T


def positive_matrix(pattern: np.ndarray, spread: float) -> np.ndarray:
    rng = np.random.default_rng(4)
    matrix = np.where(pattern, rng.normal(size=pattern.shape), 0.0)
    matrix = matrix + matrix.T
    matrix += np.diag(np.abs(matrix).sum(axis=1) + 0.1)
    units = 10.0 ** rng.uniform(-spread, spread, len(matrix))  # coordinates in units of their own
    return matrix * units[:, None] * units


KINDS = {"diagonal": Diagonal, "blocks": Blocks, "band": Band, "sparse": Sparse, "dense": MatrixFree}


@pytest.mark.parametrize("kind", KINDS)
def test_each_form_solves_with_its_matrix(kind):
    pattern = random_pattern(kind)
    form = form_of(csr_array(pattern) if kind != "dense" else None, SIZE)
    if kind == "dense":
        form = MatrixFree(SIZE)
    assert isinstance(form, KINDS[kind])
    matrix, b = positive_matrix(pattern, 0 if kind == "dense" else 3), np.random.default_rng(5).normal(size=SIZE)

    @jax.jit
    def solve(matrix, b):
        solver = form.prepare(lambda x: matrix @ x, b.dtype)
        x = refine(lambda x: matrix @ x, solver.solve, b) if form.iterative else solver.solve(b)
        return x, solver.singular, form.diagonal(lambda x: matrix @ x, b.dtype)

    x, singular, diagonal = solve(matrix, b)
    scale = 1 / np.sqrt(np.diagonal(matrix))
    exact = scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * b)
    np.testing.assert_allclose(x / scale, exact / scale, rtol=0, atol=1e-13 * np.abs(exact / scale).max())
    np.testing.assert_array_equal(diagonal, np.diagonal(matrix))
    assert not singular


@pytest.mark.parametrize("kind", ["diagonal", "blocks", "band"])
def test_a_singular_matrix_is_named_so(kind):
    pattern = random_pattern(kind)
    form, matrix = form_of(csr_array(pattern), SIZE), positive_matrix(pattern, 0)
    matrix[:, 7] = matrix[7] = 0.0
    assert jax.jit(lambda matrix: form.prepare(lambda x: matrix @ x, matrix.dtype).singular)(matrix)


@pytest.mark.parametrize("kind", ["blocks", "band", "sparse"])
def test_dependent_rows_leave_a_solution_and_a_rank(kind):
    """The Laplacian of a graph takes no notice of a constant on each component: what is in its range is met."""
    pattern = random_pattern(kind)
    joined = np.where(pattern & ~np.eye(SIZE, dtype=bool), 1.0, 0.0)
    matrix, form = np.diag(joined.sum(axis=1)) - joined, form_of(csr_array(pattern), SIZE)
    b = matrix @ np.random.default_rng(5).normal(size=SIZE)

    @jax.jit
    def solve(matrix, b):
        solver = form.prepare(lambda x: matrix @ x, b.dtype, dependent=True)
        return solver.solve(b), solver.singular, solver.rank

    x, singular, rank = solve(matrix, b)
    tolerance = 1e-5 if form.iterative else 1e-12
    np.testing.assert_allclose(matrix @ x, b, rtol=0, atol=tolerance * np.abs(b).max())
    assert not singular
    assert kind == "sparse" or rank == np.linalg.matrix_rank(matrix)
