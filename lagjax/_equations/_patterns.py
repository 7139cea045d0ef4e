"""Patterns of matrices of derivatives: the entries that can differ from zero at some state, found once per scene.

asdex walks through the operations of a function and follows of which inputs each number is made (Hill, Dalle,
Montoison, *An Illustrated Guide to Automatic Sparse Differentiation*, 2025). It comes with numba and is imported for
large scenes alone. A pattern may hold entries that are zero, never lack one that is not.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core
from scipy.sparse import csr_array

from lagjax._program import lack_of_memory

PyTree = Any

# Entries that asdex visits one by one in Python, at some 10 µs each, to follow a product of matrices. Doubled, a
# pattern takes up to 4 s.
_VISITED = 200_000
# Operations of which each number depends on all others of a row.
_READS_ALL = "cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp", "fft"
# Products that read off a sparse matrix, some 0.2 ms each at 10⁴ coordinates. More is a matrix that is dense in places.
_MOST_PRODUCTS = 1000


def jacobian_pattern(function: Callable, shapes: tuple, by: int) -> csr_array | None:
    """The pattern (m, n) of ∂f/∂x, x being argument number `by` of f, f of shape (m,); None where that takes long."""
    # `shapes` are those of all arguments, pytrees of them; of arrays up to that one.
    import asdex

    leaves, structure = jax.tree.flatten(shapes)
    leaves = [np.broadcast_to(np.zeros((), x.dtype), x.shape) for x in leaves]  # asdex takes arrays, not their shapes

    def flat(*leaves):
        return function(*jax.tree.unflatten(structure, leaves))

    try:
        if _visited(jax.make_jaxpr(flat)(*leaves).jaxpr) > _VISITED:
            return None
        pattern = asdex.jacobian_sparsity(flat, *leaves, argnums=by)
    except (NotImplementedError, jax.errors.TracerArrayConversionError):  # constants that are being traced
        return None
    entries = np.ones(len(pattern.rows), bool), (np.asarray(pattern.rows), np.asarray(pattern.cols))
    return csr_array(entries, shape=pattern.shape)


def gradient_memory(function: Callable, shapes: tuple) -> int:
    """The bytes that the gradient of f by its first two arguments takes besides its result."""
    # It is about twice the largest array among its operations: 1.7 times for the distances of all pairs. Where that
    # does not fit into memory XLA is asked, which compiles it in less than a second and may never form that array.
    gradient = jax.grad(function, argnums=(0, 1))
    needed = 2 * _largest_array(jax.make_jaxpr(gradient)(*shapes).jaxpr)
    if lack_of_memory(needed) is None:
        return needed
    known = jax.jit(gradient).lower(*shapes).compile().memory_analysis()
    return needed if known is None else known.temp_size_in_bytes


def _largest_array(jaxpr) -> int:
    """The bytes of the largest array that an operation of a jaxpr gives."""
    arrays = [v.aval for equation in jaxpr.eqns for v in equation.outvars]
    sizes = (math.prod(x.shape) * x.dtype.itemsize for x in arrays if hasattr(x, "shape"))
    return max([0, *sizes, *map(_largest_array, core.subjaxprs(jaxpr))])


def sparse_jacobian(function: Callable, shapes: tuple) -> Callable[..., csr_array] | None:
    """∂f/∂x (m, n) as a function of the arguments x, … of f, by a product for each colour of its columns.

    None where its pattern is not known or has many colours.
    """
    pattern = jacobian_pattern(function, shapes, 0)
    if pattern is None:
        return None
    colors = color_columns(pattern)
    count = int(colors.max(initial=0)) + 1
    if count > _MOST_PRODUCTS:
        return None
    shape, entries = pattern.shape, pattern.tocoo()
    rows, columns = entries.row, entries.col

    @jax.jit
    def read(x, *others):
        _, multiply = jax.linearize(lambda x: function(x, *others), x)
        products = jax.lax.map(lambda k: multiply((colors == k).astype(x.dtype)), np.arange(count), batch_size=16)
        return products[colors[columns], rows]

    return lambda *arguments: csr_array((np.asarray(read(*arguments)), (rows, columns)), shape=shape)


def count_operations(jaxpr) -> int:
    """The scalar operations of a jaxpr: numbers that its equations compute, those of loops in every round."""
    count = 0
    for equation in jaxpr.eqns:
        inner = list(core.jaxprs_in_params(equation.params))
        rounds = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        count += rounds * sum(map(count_operations, inner))
        count += 0 if inner else sum(int(np.prod(v.aval.shape, dtype=int)) for v in equation.outvars)
    return count


def _visited(jaxpr) -> int:
    """The products of two numbers in products of matrices, and the numbers that running sums and transforms read."""
    count = sum(map(_visited, core.subjaxprs(jaxpr)))
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            count += int(np.prod([shape[i] for i in contracted]) * np.prod(equation.outvars[0].aval.shape))
        elif equation.primitive.name in _READS_ALL:
            x = equation.invars[0].aval
            count += x.size * x.shape[equation.params.get("axis", -1)]
    return count


def color_columns(pattern: csr_array) -> np.ndarray:
    """A colour for each column of a pattern: columns of one colour share no row (Curtis, Powell & Reid 1974)."""
    import asdex

    entries, m, n = pattern.tocoo(), len(pattern.indptr) - 1, int(pattern.indices.max(initial=-1)) + 1
    return np.asarray(asdex.color_cols(asdex.SparsityPattern.from_coo(entries.row, entries.col, (m, n)))[0])
