"""Sparsity patterns of Jacobians: the entries that can differ from zero at some state, found once per scene.

asdex propagates through the operations of a function on which inputs each number depends (Hill, Dalle, Montoison, *An
Illustrated Guide to Automatic Sparse Differentiation*, 2025). It comes with numba and is imported for large scenes
only. A pattern may have entries that are zero, and must never lack one that is not.

The jaxpr given to asdex is unrolled first: it identifies constants by the variables of a jaxpr, and two calls of one
compiled function share theirs; and it computes integers as NumPy does, not as XLA. Its result is accepted if products
with the matrix recovered by it equal the derivatives (`_verify_pattern`).
"""

import functools
import itertools
import math
from collections.abc import Callable

import jax
import numpy as np
import scipy
from jax.extend import core

from lagjax._interface import compile_for_one_call
from lagjax._program import lack_of_memory

# Entries that asdex visits one by one in Python, at some 10 µs each, to follow a product of matrices. Doubled, a
# pattern takes up to 4 s.
_VISITED = 200_000
# Calls of which the operations are written out in the place of the call, by the name of what is called in it.
_CALLS = {name: "jaxpr" for name in ("jit", "pjit", "checkpoint", "remat", "remat2", "closed_call")}
_CALLS |= {name: "call_jaxpr" for name in ("core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")}
# Operations on known numbers that NumPy computes as XLA does, so that asdex may; with any others XLA computes them all.
_ALIKE = {"iota", "broadcast_in_dim", "reshape", "squeeze", "transpose", "slice", "concatenate", "convert_element_type"}
_ALIKE |= {"add", "sub", "mul", "neg", "lt", "le", "gt", "ge", "eq", "ne", "select_n", "copy", "stop_gradient"}
# What products with a matrix that is read off may differ from the derivative, in sizes of their terms times `eps`:
# rounding of the operations of L, some ten. A coupling of so small a part of its row is taken for none.
_ROUNDING = 1e3
# Factors of a direction: products with it differ by the rounding of a row, whose terms may cancel within a derivative;
# and by how many of these differences a row may be off. Beads on a string of n have rows off by n² roundings.
_SCALES, _DIFFERENCES = np.array([1.0, 1.1, 1.3, 1.7]), 100.0
_LOOKS = 4  # states at which a row that differs is looked at again
# Products up to which a pattern is tested. No form is solved by rows and columns that are fuller (`_sparse`).
_MOST_TESTED = 64
# Operations of which each number depends on all others of a row.
_READS_ALL = "cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp", "fft"
# Products that read off a sparse matrix, some 0.2 ms each at 10⁴ coordinates. More is a matrix that is dense in places.
_MOST_PRODUCTS = 1000


def jacobian_pattern(function: Callable, shapes: tuple, by: int) -> "scipy.sparse.csr_array | None":
    """The pattern (m, n) of ∂f/∂x, x being argument number `by` of f, f of shape (m,); None if that takes long."""
    # `shapes` are those of all arguments, pytrees of them; of arrays up to that one.
    import asdex

    leaves, structure = jax.tree.flatten(shapes)
    leaves = [np.broadcast_to(np.zeros((), x.dtype), x.shape) for x in leaves]  # asdex takes arrays, not their shapes

    def flat(*leaves):
        return function(*jax.tree.unflatten(structure, leaves))

    closed = jax.make_jaxpr(flat)(*leaves)
    if _count_matrix_products(closed.jaxpr) > _VISITED:
        return None
    try:
        found = asdex.jacobian_sparsity(core.jaxpr_as_fun(_unroll_calls(closed)), *leaves, argnums=by)
        entries = np.ones(len(found.rows), bool), (np.asarray(found.rows), np.asarray(found.cols))
        pattern = scipy.sparse.csr_array(entries, shape=found.shape)
        with jax.ensure_compile_time_eval():
            return pattern if _verify_pattern(pattern, flat, leaves, by) else None
    except Exception:  # of many kinds, as are the operations that it does not know
        return None


def _verify_pattern(pattern: "scipy.sparse.csr_array", function: Callable, leaves: list, by: int) -> bool:
    """True if ∂f/∂x, recovered with this pattern, gives the derivatives of f along vectors, at two random states."""
    # Rows that are full are read off by products from the left.
    full = bool(np.diff(pattern.indptr).max(initial=0) > _MOST_TESTED)
    pattern = scipy.sparse.csr_array(pattern.T) if full else pattern
    colors = color_columns(pattern)
    if (count := int(colors.max(initial=0)) + 1) > _MOST_TESTED:
        return True
    entries, rng, dtype = pattern.tocoo(), np.random.default_rng(0), leaves[by].dtype
    factors = rng.uniform(0.5, 1.5, colors.size).astype(dtype)
    seeds = np.concatenate([colors == np.arange(count)[:, None], np.outer(_SCALES, factors)]).astype(dtype)

    @compile_for_one_call
    def multiply(leaves, seeds):
        def inside(x):
            return function(*leaves[:by], x, *leaves[by + 1 :])

        product = (lambda y: jax.vjp(inside, leaves[by])[1](y)[0]) if full else jax.linearize(inside, leaves[by])[1]
        return jax.lax.map(product, seeds, batch_size=16)

    def look(low: float, whole: int) -> np.ndarray:
        products = np.asarray(multiply([_draw_numbers(rng, x, low, whole) for x in leaves], seeds), float)
        values = products[colors[entries.col], entries.row]
        return _differing_rows(values, entries.row, factors[entries.col], products[count:], dtype)

    def differs(low: float, whole: int) -> bool:
        # Terms that cancel leave more rounding than a row shows, at one state in thousands: so those are drawn anew.
        rows = look(low, whole)
        return bool(rows.any()) and any((rows & look(low, whole)).any() for _ in range(_LOOKS))

    return not (differs(0.3, colors.size) or differs(-1.2, 2))


def _draw_numbers(rng: np.random.Generator, like: np.ndarray, low: float, whole: int) -> np.ndarray:
    """Random numbers of a shape and dtype: integers below `whole`, floats of order one from `low`."""
    if np.issubdtype(like.dtype, np.inexact):
        return rng.uniform(low, 1.2, like.shape).astype(like.dtype)
    most = 2 if like.dtype == bool else np.iinfo(like.dtype).max
    return rng.integers(0, min(whole, most), like.shape).astype(like.dtype)


def _differing_rows(values, rows, factors, products, dtype) -> np.ndarray:
    """For each row: True if the sum of `values` times `factors` differs from its `products` (scales, m), if finite."""
    exact = products / _SCALES[:, None]
    terms, count = np.asarray(values, float) * factors, exact.shape[1]
    sums, sizes = (np.bincount(rows, x, count) for x in (terms, np.abs(terms)))
    largest = sizes.max(initial=0, where=np.isfinite(sizes))
    rounding = _ROUNDING * np.finfo(dtype).eps * np.where(sizes > 0, sizes, largest)
    return np.abs(exact[0] - sums) > np.maximum(rounding, _DIFFERENCES * np.ptp(exact, axis=0))


def _unroll_calls(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """A jaxpr's equivalent without calls, with loop bodies inlined and known numbers computed."""
    return _compute_known(jax.make_jaxpr(lambda *x: _evaluate_jaxpr(closed.jaxpr, closed.consts, x))(*closed.in_avals))


def _evaluate_jaxpr(jaxpr, constants, arguments) -> list:
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *arguments), strict=True))

    def read(x):
        return x.val if isinstance(x, core.Literal) else values[x]

    for equation in jaxpr.eqns:
        given, name, params = list(map(read, equation.invars)), equation.primitive.name, equation.params
        if name in _CALLS:
            inner = params[_CALLS[name]]
            found = _evaluate_jaxpr(*((inner.jaxpr, inner.consts) if hasattr(inner, "consts") else (inner, ())), given)
        else:
            if name in ("scan", "while", "cond"):
                params = jax.tree.map(_unroll_jaxprs, params, is_leaf=lambda x: isinstance(x, core.ClosedJaxpr))
            found = equation.primitive.bind(*given, **params)
            found = found if equation.primitive.multiple_results else [found]
        values.update(zip(equation.outvars, found, strict=True))
    return list(map(read, jaxpr.outvars))


def _unroll_jaxprs(x):
    return _unroll_calls(x) if isinstance(x, core.ClosedJaxpr) else x


def _compute_known(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """A jaxpr with operations on constants computed, by XLA instead of NumPy."""
    jaxpr, known, equations, others = closed.jaxpr, set(closed.jaxpr.constvars), [], []
    for equation in jaxpr.eqns:
        is_known = not equation.effects and all(isinstance(x, core.Literal) or x in known for x in equation.invars)
        (equations if is_known else others).append(equation)
        known.update(equation.outvars if is_known else ())
    if all(equation.primitive.name in _ALIKE for equation in equations):
        return closed
    made = [x for equation in equations for x in equation.outvars]
    names = jaxpr.debug_info.with_unknown_names()
    part = jaxpr.replace(constvars=(), invars=jaxpr.constvars, outvars=made, eqns=equations, debug_info=names)
    compute = core.jaxpr_as_fun(core.ClosedJaxpr(part, ()))
    constants = [*closed.consts, *jax.jit(compute)(*closed.consts)]
    return core.ClosedJaxpr(jaxpr.replace(constvars=[*jaxpr.constvars, *made], eqns=others), constants)


def gradient_memory(function: Callable, shapes: tuple) -> int:
    """The bytes that the gradient of f by its first two arguments needs in addition to its result."""
    # It is about twice the largest array among its operations: 1.7 times for the distances of all pairs. Where that
    # does not fit into memory XLA is asked, which compiles it in less than a second and may never form that array.
    gradient = jax.grad(function, argnums=(0, 1))
    needed = 2 * _largest_array(jax.make_jaxpr(gradient)(*shapes).jaxpr)
    if lack_of_memory(needed) is None:
        return needed
    known = jax.jit(gradient).lower(*shapes).compile().memory_analysis()
    return needed if known is None else known.temp_size_in_bytes


def _largest_array(jaxpr) -> int:
    """The bytes of the largest result of an operation in a jaxpr."""
    arrays = [v.aval for equation in jaxpr.eqns for v in equation.outvars]
    sizes = (math.prod(x.shape) * x.dtype.itemsize for x in arrays if hasattr(x, "shape"))
    return max([0, *sizes, *map(_largest_array, core.subjaxprs(jaxpr))])


def sparse_jacobian(function: Callable, shapes: tuple) -> "Callable[..., scipy.sparse.csr_array] | None":
    """A function of the arguments x, … of f that gives ∂f/∂x (m, n), by one product per colour of its columns.

    None if its pattern is unknown or needs many colours.
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
    factors = np.random.default_rng(0).uniform(0.5, 1.5, len(colors))

    @jax.jit
    def read(x, *others):
        _, multiply = jax.linearize(lambda x: function(x, *others), x)
        products = jax.lax.map(lambda k: multiply((colors == k).astype(x.dtype)), np.arange(count), batch_size=16)
        return products[colors[columns], rows], jax.vmap(multiply)(np.outer(_SCALES, factors).astype(x.dtype))

    def jacobian(x, *others) -> "scipy.sparse.csr_array":
        values, products = map(np.asarray, read(x, *others))
        if _differing_rows(values, rows, factors[columns], products, x.dtype).any():
            raise ValueError(
                "The derivatives of the forces or constraints at this state hold entries that were not found among "
                'the operations of the scene: give System(..., path="scalar"), which derives them one by one.'
            )
        return scipy.sparse.csr_array((values, (rows, columns)), shape=shape)

    return jacobian


def count_operations(jaxpr) -> int:
    """The number of scalar operations of a jaxpr: results of its equations, in loops for every round."""
    count = 0
    for equation in jaxpr.eqns:
        inner = list(core.jaxprs_in_params(equation.params))
        rounds = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        count += rounds * sum(map(count_operations, inner))
        count += 0 if inner else sum(int(np.prod(v.aval.shape, dtype=int)) for v in equation.outvars)
    return count


def count_equations(jaxpr) -> int:
    """The equations of a jaxpr, and of those that it calls; those of a loop count once."""
    inner = [list(core.jaxprs_in_params(equation.params)) for equation in jaxpr.eqns]
    return sum(sum(map(count_equations, of)) if of else 1 for of in inner)


def _count_matrix_products(jaxpr) -> int:
    """The number of scalar products in matrix products, and of entries read by cumulative sums and transforms."""
    count = sum(map(_count_matrix_products, core.subjaxprs(jaxpr)))
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            count += int(np.prod([shape[i] for i in contracted]) * np.prod(equation.outvars[0].aval.shape))
        elif equation.primitive.name in _READS_ALL:
            x = equation.invars[0].aval
            count += x.size * x.shape[equation.params.get("axis", -1)]
    return count


def color_columns(pattern: "scipy.sparse.csr_array") -> np.ndarray:
    """A colour for each column of a pattern: columns of one colour share no row (Curtis, Powell & Reid 1974)."""
    # The first that is free in all rows of the column; those taken in a row are the bits of a whole number.
    columns, taken, colors = pattern.tocsc(), [0] * (len(pattern.indptr) - 1), []
    rows, ends = np.asarray(columns.indices).tolist(), np.asarray(columns.indptr).tolist()
    for start, end in itertools.pairwise(ends):
        here = functools.reduce(int.__or__, [taken[i] for i in rows[start:end]], 0)
        free = ~here & (here + 1)
        for i in rows[start:end]:
            taken[i] |= free
        colors.append(free.bit_length() - 1)
    return np.array(colors, int)
