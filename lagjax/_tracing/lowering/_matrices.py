"""Small matrices on scalars: linear systems, Cholesky factors and determinants, written out.

LAPACK's elimination chooses its pivots by comparing numbers. On scalars a choice is a border: steps would end where
another row becomes the largest, though the solution is as smooth there as anywhere. And between two such choices a
pivot may come close to zero, where the intermediate numbers have poles that the solution has not: their Taylor series
lose their digits. Nothing is therefore chosen here:

    n ≤ 2      Cramer's rule, which is as accurate as elimination is
    n ≥ 3      columns are made orthogonal one after the other, without square roots: A = Q R, R with a unit diagonal

The squares of the columns of Q, by which it is divided, vanish only where A is singular, and right-hand sides are
treated as further columns, which makes it backward stable: the relative error is a small multiple of cond(A) times the
precision (Björck, BIT 7 (1967) 1). Cramer's rule for n ≥ 3 would lose up to cond(A)². Rows are weighted with powers of
two, so that the units they are given in do not count; columns may have any.

A matrix falls into blocks where its zeros let it, and every block is one system.
"""

import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy

from lagjax._primitives import solve_composed
from lagjax._program import Derivatives, Graph, Unlowerable, copy_nodes, eliminate_dead_code
from lagjax._tracing import _scalars as xp
from lagjax._tracing._scalars import Scalars
from lagjax._tracing.lowering._rules import LOWER, Expansion, inputs_of, lowers

# The rows of the largest matrix that is written out.
LARGEST_MATRIX = 8
# Unknowns of all the blocks of a system together: to look for the blocks takes a tenth of a second here.
_MOST_UNKNOWNS = 512


# ---- formulas -------------------------------------------------------------------------------------------------------


def solution(a, b):
    """The solution X of A X = B, for A (n, n) and B (n, m)."""
    n = a.shape[0]
    if n == 1:
        return b / a
    if n == 2:
        inverse = 1.0 / (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
        rows = a[1, 1] * b[0] - a[0, 1] * b[1], a[0, 0] * b[1] - a[1, 0] * b[0]
        return xp.stack([row * inverse for row in rows])
    return solve_orthogonalized(orthogonalize(a), b)


class Orthogonalized(NamedTuple):
    """A = Q R for A (n, n): the columns of Q are orthogonal with the `weights` of rows; R has a unit diagonal.

    - `columns` (n, n): qₖ, as rows; `duals` (n, n): W qₖ / qₖᵀ W qₖ, as rows.
    - `ratios` (n (n − 1) / 2,): R above its diagonal, row by row.
    - `squares` (n,): qₖᵀ W qₖ; zero where A is singular.
    """

    columns: Any
    duals: Any
    ratios: Any
    squares: Any


def orthogonalize(a) -> Orthogonalized:
    """Q and R, by the modified Gram–Schmidt process without square roots."""
    weights, columns, duals, ratios, squares = row_weights(a), [], [], [], []
    for _ in range(a.shape[0]):
        column, a = a[:, 0], a[:, 1:]
        weighted = weights * column
        squares.append(_sum(weighted * column))
        columns.append(column)
        duals.append(weighted / squares[-1])
        ratios.append(_sum(duals[-1][:, None] * a))
        a = a - column[:, None] * ratios[-1]
    return Orthogonalized(xp.stack(columns), xp.stack(duals), xp.concatenate(ratios), xp.stack(squares))


def solve_orthogonalized(factors: Orthogonalized, b):
    """The solution X of A X = B, for B (n, …): coefficients of B by the columns of Q, then back substitution in R."""
    n, parts = factors.columns.shape[0], []
    b = [b[i] for i in range(n)]
    for k in range(n):
        parts.append(_sum([factors.duals[k, i] * b[i] for i in range(n)]))
        if k < n - 1:
            b = [b[i] - factors.columns[k, i] * parts[-1] for i in range(n)]
    end = factors.ratios.shape[0]
    for k in reversed(range(n - 1)):
        start = end - (n - 1 - k)
        for j in range(k + 1, n):
            parts[k] = parts[k] - factors.ratios[start + j - k - 1] * parts[j]
        end = start
    return xp.stack(parts)


def row_weights(a):
    """A power of two for each row of A that normalises its scale without rounding."""
    return 1.0 / xp.binade(_sum([a[:, j] * a[:, j] for j in range(a.shape[1])]))


def _sum(rows):
    rows = rows if isinstance(rows, list) else [rows[i] for i in range(rows.shape[0])]
    return functools.reduce(operator.add, rows)


def determinant(a):
    """The determinant of A (n, n), as accurate as by elimination, but without its divisions by zero.

    That of Q is expanded by minors, n 2ⁿ⁻¹ products: its columns are orthogonal, so that little cancels. Q does not
    exist only where one of the first columns depends on those before it.
    """
    n = a.shape[0]
    if n > 3:
        a = orthogonalize(a).columns  # as rows: the determinant is the same
    minors: dict[tuple[int, ...], Any] = {(j,): a[0, j] for j in range(n)}
    for k in range(1, n):
        longer: dict[tuple[int, ...], Any] = {}
        for columns in itertools.combinations(range(n), k + 1):
            terms = [a[k, j] * minors[(*columns[:i], *columns[i + 1 :])] for i, j in enumerate(columns)]
            total = terms[-1]
            for i, term in enumerate(reversed(terms[:-1])):
                total = total + term if i % 2 else total - term
            longer[columns] = total
        minors = longer
    return minors[tuple(range(n))]


def cholesky(a):
    """The lower L with L Lᵀ = A (n, n), whose lower half is read; NaN where A is not positive definite."""
    n, zero = a.shape[0], 0.0 * a[0, 0]
    rows: list[list[Any]] = [[zero] * n for _ in range(n)]
    left = {(i, j): a[i, j] for i in range(n) for j in range(i + 1)}
    for k in range(n):
        rows[k][k] = xp.root(left[k, k])
        for i in range(k + 1, n):
            rows[i][k] = left[i, k] / rows[k][k]
        for i in range(k + 1, n):
            for j in range(k + 1, i + 1):
                left[i, j] = left[i, j] - rows[i][k] * rows[j][k]
    return xp.stack([xp.stack(row) for row in rows])


def substitute(a, b, lower: bool, unit_diagonal: bool):
    """The solution X of A X = B, for a triangular A (n, n) and B (n, m)."""
    n = a.shape[0]
    unknowns: dict[int, Any] = {}
    for k in range(n) if lower else reversed(range(n)):
        row = b[k]
        for j, known in unknowns.items():
            row = row - a[k, j] * known
        unknowns[k] = row if unit_diagonal else row / a[k, k]
    return xp.stack([unknowns[k] for k in range(n)])


# ---- primitives -----------------------------------------------------------------------------------------------------


@lowers("custom_linear_solve")
def _linear_solve(expansion, params, *arguments):
    """Lower `custom_linear_solve` by its matrix: `linalg.solve`, `inv`, and functions that use them."""
    count = params["const_lengths"].matvec
    right = arguments[count:]
    matrix = _matrix_of(expansion, params["jaxprs"].matvec, arguments[:count])
    b = np.concatenate([x.ravel() for x in right])
    x, alike = np.empty_like(b), {}
    for rows, columns in _diagonal_blocks(expansion, matrix):
        _require_small("a linear system", len(rows))
        alike.setdefault((matrix[np.ix_(rows, columns)].tobytes(), len(rows)), []).append((rows, columns))
    for blocks in alike.values():
        a = Scalars(expansion, matrix[np.ix_(*blocks[0])])
        found = solution(a, Scalars(expansion, np.stack([b[rows] for rows, _ in blocks], axis=1))).ids
        for k, (_, columns) in enumerate(blocks):
            x[columns] = found[:, k]
    parts = np.split(x, np.cumsum([part.size for part in right])[:-1])
    return [part.reshape(like.shape) for part, like in zip(parts, right, strict=True)]


def _matrix_of(expansion: Expansion, matvec, constants) -> np.ndarray:
    """The matrix, as ids, of a linear function of its last arguments: its derivative, from a separate graph."""
    shapes = [variable.aval for variable in matvec.jaxpr.invars]
    if sum(shape.size for shape in shapes[len(constants) :]) > _MOST_UNKNOWNS:
        raise Unlowerable("a linear system is too large to be written out as scalars")
    apart = Expansion(Graph(expansion.graph.budget))
    inputs = inputs_of(apart.graph, shapes)
    vector = np.concatenate([apart.real(x).ravel() for x in inputs[len(constants) :]]).tolist()
    outputs = np.concatenate([apart.real(x).ravel() for x in apart.run_closed(matvec, inputs)]).tolist()
    one, zero = (apart.graph.number(x) for x in (1.0, 0.0))
    entries = np.full((len(outputs), len(vector)), zero)
    found = Derivatives(apart.graph).directional_derivatives(outputs, [{i: one} for i in vector])
    for row, tangents in zip(entries, found, strict=True):
        row[list(tangents)] = list(tangents.values())
    line = eliminate_dead_code(apart.graph, entries.ravel().tolist())
    given = [i for x in constants for i in x.ravel().tolist()]
    nodes = copy_nodes(expansion.graph, line, given)
    return np.array([nodes[i] for i in line.outputs], dtype=np.int64).reshape(entries.shape)


def _diagonal_blocks(expansion: Expansion, matrix: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rows and columns of the diagonal blocks of a matrix by its zeros; one block if any is not square."""
    n, values = len(matrix), [expansion.graph.value(i) for i in matrix.ravel().tolist()]
    links = np.zeros((2 * n, 2 * n), bool)  # of rows with columns
    links[:n, n:] = np.reshape([value != 0 for value in values], matrix.shape)
    _, labels = scipy.sparse.csgraph.connected_components(links, directed=False)
    parts = [labels == k for k in dict.fromkeys(labels[:n].tolist())]
    if any(part[:n].sum() != part[n:].sum() for part in parts):  # singular, whatever the numbers
        parts = [np.ones(2 * n, bool)]
    return [(np.flatnonzero(part[:n]), np.flatnonzero(part[n:])) for part in parts]


def _require_small(what: str, size: int) -> None:
    if size > LARGEST_MATRIX:
        raise Unlowerable(f"{what} of {size} rows is larger than the {LARGEST_MATRIX} that are written out as scalars")


def _map_matrices(what: str, function: Callable, expansion: Expansion, *arrays: np.ndarray) -> list[np.ndarray]:
    """The results (…, *) of a formula applied to each matrix of the arrays (…, n, m)."""
    _require_small(what, arrays[0].shape[-1])
    batch = arrays[0].shape[:-2]
    done = [function(*(Scalars(expansion, x[at]) for x in arrays)) for at in np.ndindex(*batch)]
    return [np.stack([x.ids for x in of]).reshape((*batch, *of[0].shape)) for of in zip(*done, strict=True)]


LOWER["cholesky"] = lambda of, params, a: _map_matrices("a Cholesky factor", lambda a: [cholesky(a)], of, a)[0]
LOWER["det"] = lambda of, params, a: _map_matrices("a determinant", lambda a: [determinant(a)], of, a)


@lowers("lu")
def _lower_lu(expansion, params, a):
    raise Unlowerable(
        "`lu` chooses rows by comparing numbers; `jnp.linalg.solve`, `inv`, `det` and `slogdet` are written out as "
        "scalars without a choice"
    )


@lowers("lagjax_solve")
def _solve_matrix(expansion, params, a, b):
    shapes = (jax.ShapeDtypeStruct(x.shape, float) for x in (a, b))
    return expansion.run_closed(jax.make_jaxpr(solve_composed)(*shapes), (a, b))


@lowers("triangular_solve")
def _triangular_solve(expansion, params, a, b):
    lower, unit = params["lower"], params["unit_diagonal"]
    if params["transpose_a"] == params["left_side"]:  # X A = B is Aᵀ Xᵀ = Bᵀ
        a, lower = np.swapaxes(a, -1, -2), not lower
    turned = b if params["left_side"] else np.swapaxes(b, -1, -2)
    (x,) = _map_matrices("a triangular system", lambda a, b: [substitute(a, b, lower, unit)], expansion, a, turned)
    return x if params["left_side"] else np.swapaxes(x, -1, -2)


@lowers("slogdet")
def _log_determinant(expansion, params, a):
    def sign_and_logarithm(a):
        value = determinant(a)
        squares, weights = orthogonalize(a).squares, row_weights(a)
        return [value.map("sign", value), 0.5 * (_sum(xp.logarithm(squares)) - _sum(xp.logarithm(weights)))]

    return _map_matrices("a determinant", sign_and_logarithm, expansion, a)
