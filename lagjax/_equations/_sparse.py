"""Symmetric matrices with a known sparsity pattern: recovered from a few products, and solved by the pattern's form.

    diagonal            divide
    blocks              the connected components of the pattern, each at most `LARGEST_BLOCK` large, in groups of a size
    band                after reverse Cuthill–McKee: L D Lᵀ row by row, b² operations each
    sparse              conjugate gradients with the entries
    products            conjugate gradients with products alone, where no pattern is known, or one that is dense

Columns that share no row are recovered together: a form has a colour for each column, and the product of the matrix
with the indicator of each colour gives all entries (Curtis, Powell & Reid, *On the estimation of sparse Jacobian
matrices*, 1974). No form stores n × n numbers. All are written in array operations, for the reason given in `_linear`.
"""

import abc
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from lagjax._equations._linear import factorize, least_norm, rank, rank_tolerance, singular_threshold
from lagjax._equations._patterns import color_columns

Vector = Float[Array, " n"]
Product = Callable[[Vector], Vector]

LARGEST_BLOCK = 16
# Conjugate gradients take less than a band that is wider, for matrices of the condition that masses and links have: on
# two cores a row of b entries takes b² / 2 ns, and so does it in every step of b²/10 steps.
WIDEST_BAND = 8
# Products that read off a sparse matrix; beyond that its own products are taken.
MOST_COLORS = 64
_MOST_ITERATIONS = 2000  # enough for a condition of 1e4: some 18 √κ of them reach round-off


class Solver(NamedTuple):
    """A solver of A x = b at one state; that of an `iterative` form gives half of the digits."""

    solve: Product
    singular: Bool[Array, ""]  # to working precision
    rank: Int[Array, ""]  # the number of independent rows


class MatrixForm(abc.ABC):
    """The pattern of a symmetric matrix (n, n), arranged for one way to solve with it."""

    name: str
    size: int
    iterative = False  # its solver has half of the digits, see `refine`

    @abc.abstractmethod
    def prepare(self, multiply: Product, dtype, dependent: bool = False) -> Solver:
        """The solver of the matrix with these products x ↦ A x.

        A matrix with `dependent` rows is positive semi-definite, and b in its range: rows that are combinations of
        others count as zero (`rank_tolerance`), and their unknowns are zero or small. Otherwise a singular matrix gives
        NaN.
        """

    @abc.abstractmethod
    def diagonal(self, multiply: Product, dtype) -> Vector:
        """The diagonal of the matrix with these products."""


class Entries(MatrixForm):
    """A form that recovers the entries at `rows`, `columns` from products with the indicators of `colors`."""

    def __init__(self, pattern: "scipy.sparse.csr_array", colors: np.ndarray):
        entries = pattern.tocoo()
        self.size, self.rows, self.columns, self.colors = len(colors), entries.row, entries.col, colors
        self.count = int(colors.max()) + 1
        self.on_diagonal = np.flatnonzero(self.rows == self.columns)  # one for each row, as rows ascend

    def read(self, multiply: Product, dtype) -> Float[Array, " entries"]:
        seeds = jnp.asarray(self.colors == np.arange(self.count)[:, None], dtype)
        return jax.vmap(multiply)(seeds)[self.colors[self.columns], self.rows]

    def diagonal(self, multiply: Product, dtype) -> Vector:
        return self.read(multiply, dtype)[self.on_diagonal]

    def read_scaled(self, multiply: Product, dtype) -> tuple[Array, Vector]:
        """The entries with both sides scaled to a unit diagonal, and the scale (n,); a zero on it stays zero."""
        entries = self.read(multiply, dtype)
        size = jnp.abs(entries[self.on_diagonal])
        scale = 1 / jnp.sqrt(jnp.where(size > 0, size, 1))
        return entries * scale[self.rows] * scale[self.columns], scale


class Diagonal(Entries):
    """The form of a diagonal matrix."""

    name = "diagonal"

    def __init__(self, pattern: "scipy.sparse.csr_array"):
        super().__init__(pattern, np.zeros(pattern.nnz, int))

    def prepare(self, multiply, dtype, dependent=False):
        entries = self.read(multiply, dtype)
        zero = entries == 0
        inverse = jnp.where(zero, 0, 1) / jnp.where(zero, 1, entries)
        return Solver(lambda b: inverse * b, jnp.any(zero) & (not dependent), jnp.sum(~zero))


class Blocks(Entries):
    """The form of a block-diagonal matrix: `groups` of blocks of one size, each an array (count, size) of rows."""

    def __init__(self, pattern: "scipy.sparse.csr_array", label: np.ndarray):
        order, sizes = np.argsort(label, kind="stable"), np.bincount(label)
        ends = np.cumsum(sizes)
        place = np.empty(len(label), int)
        place[order] = np.arange(len(label)) - np.repeat(ends - sizes, sizes)
        super().__init__(pattern, place)
        self.groups, self.entries = [], []
        for size in np.unique(sizes):
            of_size = np.flatnonzero(sizes == size)
            block = np.full(len(sizes), -1)
            block[of_size] = np.arange(len(of_size))
            of_entry = block[label[self.rows]]
            chosen = np.flatnonzero(of_entry >= 0)
            at = np.full((len(of_size), size, size), len(self.rows))  # behind the last entry: a zero
            at[of_entry[chosen], place[self.rows[chosen]], place[self.columns[chosen]]] = chosen
            self.groups.append(order[(ends - sizes)[of_size][:, None] + np.arange(size)])
            self.entries.append(at)
        self.back = np.argsort(np.concatenate([members.ravel() for members in self.groups]))
        shown = ", ".join(f"{len(members)} of {members.shape[1]}" for members in self.groups[:4])
        self.name = f"in blocks ({shown}{', …' if len(self.groups) > 4 else ''})"

    def prepare(self, multiply, dtype, dependent=False):
        entries, scale = self.read_scaled(multiply, dtype)
        solvers, singular, independent = [], jnp.array(False), 0
        for at in self.entries:
            matrices = jnp.append(entries, 0)[at]
            if dependent:
                solvers.append(lambda b, matrices=matrices: jax.vmap(least_norm)(matrices, b))
                independent += jnp.sum(jax.vmap(rank)(matrices))
            else:
                factors = jax.vmap(factorize)(matrices)
                solvers.append(lambda b, factors=factors: jax.vmap(lambda f, b: f.solve(b))(factors, b))
                singular, independent = singular | jnp.any(factors.singular), independent + at.shape[0] * at.shape[1]

        def solve(b):
            b = scale * b
            parts = [solver(b[members]).ravel() for members, solver in zip(self.groups, solvers, strict=True)]
            return scale * jnp.concatenate(parts)[self.back]

        return Solver(solve, singular, jnp.asarray(independent))


class Band(Entries):
    """The form of a matrix with `width` entries on either side of the diagonal, in the `order` of Cuthill–McKee."""

    def __init__(self, pattern: "scipy.sparse.csr_array", order: np.ndarray, width: int):
        place = np.argsort(order)
        super().__init__(pattern, place % (2 * width + 1))
        self.order, self.width, self.name = order, width, f"a band of {width}"
        row, distance = place[self.rows], place[self.columns] - place[self.rows]
        # Column j of the upper half, from row j − b down to j. Rows before the first, and behind the last, are those of
        # the unit matrix: behind the last entry there are a zero and a one.
        upper, zero = np.flatnonzero(distance >= 0), len(self.rows)
        self.place, self.upper = place, np.full((self.size + width + 1, width + 1), zero)
        self.upper[:, width] = zero + 1
        self.upper[(row + distance)[upper], (width - distance)[upper]] = upper

    def prepare(self, multiply, dtype, dependent=False):
        b = self.width
        entries, scale = self.read_scaled(multiply, dtype)
        scale = scale[self.order]
        columns = jnp.append(entries, jnp.array([0, 1], dtype))[self.upper]
        tolerance = rank_tolerance(dtype) if dependent else 0.0

        def eliminate(window, column):  # of rows i … i + b; column i + b + 1 joins where row i leaves
            pivot, row = window[0, 0], window[0, 1:]
            counts = ~(jnp.abs(pivot) <= tolerance)
            factors = jnp.where(counts, row / jnp.where(counts, pivot, 1), 0)
            inner = window[1:, 1:] - factors[:, None] * row
            rows = jnp.concatenate([inner, column[None, :b]])
            return jnp.concatenate([rows, column[:, None]], axis=1), (pivot, factors, counts)

        _, (pivots, factors, counts) = jax.lax.scan(eliminate, jnp.eye(b + 1, dtype=dtype), columns)
        pivots, factors, counts = pivots[b + 1 :], factors[b + 1 :], counts[b + 1 :]
        inverse = jnp.where(counts, 1, 0) / jnp.where(counts, pivots, 1)
        size = jnp.abs(pivots)
        singular = jnp.min(size) <= singular_threshold(2 * b + 1, dtype) * jnp.max(size)

        def solve(right):
            def forward(pending, row):
                factors, right = row
                y = right - pending[0]
                return jnp.append(pending[1:], 0) + factors * y, y

            def back(behind, row):
                factors, inverse, y = row
                x = inverse * y - factors @ behind
                return jnp.append(x, behind[:-1]), x

            zero = jnp.zeros(b, dtype)
            _, y = jax.lax.scan(forward, zero, (factors, scale * right[self.order]))
            _, x = jax.lax.scan(back, zero, (factors, inverse, y), reverse=True)
            return (scale * x)[self.place]

        return Solver(solve, singular & (not dependent), jnp.sum(counts))


class Sparse(Entries):
    """The form of a general sparse matrix: padded rows for products; conjugate gradients solve with them."""

    iterative = True

    def __init__(self, pattern: "scipy.sparse.csr_array", colors: np.ndarray):
        super().__init__(pattern, colors)
        self.name = f"sparse ({len(self.rows)} entries)"
        length = np.diff(pattern.indptr)
        inside = np.arange(length.max()) < length[:, None]
        entry, column = np.full(inside.shape, len(self.rows)), np.zeros(inside.shape, int)
        entry[inside], column[inside] = np.arange(len(self.rows)), self.columns
        self.places = list(zip(entry.T, column.T, strict=True))  # the k-th entry of each row, and its column

    def prepare(self, multiply, dtype, dependent=False):
        entries, scale = self.read_scaled(multiply, dtype)
        padded = jnp.append(entries, 0)
        by_place = [(padded[entry], column) for entry, column in self.places]

        def product(x):  # term by term XLA takes a third of the time of a sum over an axis
            return functools.reduce(lambda y, of: y + of[0] * x[of[1]], by_place, jnp.zeros_like(x))

        empty = sum(jnp.abs(entry) for entry, _ in by_place) == 0  # rows, which b in the range of A would hide
        singular = jnp.any(empty) & (not dependent)
        return Solver(lambda b: scale * conjugate_gradients(product, scale * b), singular, jnp.sum(~empty))


@dataclass(frozen=True)
class MatrixFree(MatrixForm):
    """The form of a matrix without a known pattern: conjugate gradients with its products."""

    iterative = True
    size: int
    known: bool = False  # to be dense

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return "dense" if self.known else "of a pattern that its operations do not tell"

    def prepare(self, multiply, dtype, dependent=False):
        return Solver(lambda b: conjugate_gradients(multiply, b), jnp.array(False), jnp.array(self.size))

    def diagonal(self, multiply, dtype):
        return jax.lax.map(lambda i: multiply(jnp.zeros(self.size, dtype).at[i].set(1.0))[i], jnp.arange(self.size))


def conjugate_gradients(multiply: Product, b: Vector) -> Vector:
    """The solution x of A x = b for a positive (semi-)definite A, to half of the digits; NaN without convergence."""
    # Source: Hestenes & Stiefel, J. Res. NBS 49 (1952) 409.
    tolerance, limit = float(jnp.finfo(b.dtype).eps) ** 0.5, min(_MOST_ITERATIONS, 4 * b.size)
    x, _ = jax.scipy.sparse.linalg.cg(multiply, b, tol=tolerance, maxiter=limit)
    missing = jnp.max(jnp.abs(b - multiply(x)))
    return jnp.where(missing <= 100 * tolerance * jnp.max(jnp.abs(b)), x, jnp.nan)


def refine(product: Callable, solve: Callable, right):
    """The solution x of A x = `right`, pytrees, refined from an approximate `solve`; `product` is x ↦ A x."""

    def once_more(_, carry):
        x, rest = carry
        x = jax.tree.map(jnp.add, x, solve(rest))
        return x, jax.tree.map(jnp.subtract, right, product(x))

    return jax.lax.fori_loop(0, 2, once_more, (jax.tree.map(jnp.zeros_like, right), right))[0]


def form_of(pattern: Any, size: int) -> MatrixForm:
    """The form for the pattern of a symmetric matrix; None is an unknown pattern."""
    if pattern is None:
        return MatrixFree(size)
    diagonal = scipy.sparse.csr_array((np.ones(size, bool), (np.arange(size), np.arange(size))), shape=(size, size))
    pattern = scipy.sparse.csr_array(pattern + pattern.T + diagonal)
    pattern.sort_indices()
    if pattern.nnz == size:
        return Diagonal(pattern)
    _, label = scipy.sparse.csgraph.connected_components(pattern, directed=False)
    if np.bincount(label).max() <= LARGEST_BLOCK:
        return Blocks(pattern, label)
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(pattern, symmetric_mode=True)
    place, entries = np.argsort(order), pattern.tocoo()
    width = int(np.abs(place[entries.row] - place[entries.col]).max())
    if width <= WIDEST_BAND:
        return Band(pattern, order, width)
    if np.diff(pattern.indptr).max() > MOST_COLORS:
        return MatrixFree(size, known=True)
    return Sparse(pattern, color_columns(pattern))
