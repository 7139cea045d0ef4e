"""Functions that compute in float64 although the caller's numbers are float32; only the result is rounded.

While `jax_enable_x64` is off JAX has no float64. `jax.enable_x64(True)` around a part of a program turns it on while
that part is traced; it is differentiated, batched and compiled later, with the switch off, and then JAX's own rules mix
precisions. So such a part becomes one primitive whose parameter is a function g of arrays, and the rules of the
primitive turn the switch on whenever they transform g. Its derivative is a function of the same kind,

    (x, v) ↦ Dg(x) v      linear in v, transposed: (x, w) ↦ Dg(x)ᵀ w

so that derivatives of all orders exist, in both modes. A derivative computes g(x) once more.
"""

import contextlib
import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from lagjax._interface import dtype_of, is_concrete
from lagjax._primitives._linear_map import LinearMap, compute_on_host, is_zero

SINGLE, DOUBLE = np.dtype("float32"), np.dtype("float64")
_NARROW = {DOUBLE: SINGLE, np.dtype("complex128"): np.dtype("complex64")}
_WIDE = {narrow: wide for wide, narrow in _NARROW.items()}


def compute_in_doubles(function: Callable, *arguments: PyTree) -> PyTree:
    """`function(*arguments)` computed in float64; arrays are rounded to float32 before and after.

    Integers of the result have the type that JAX has at present. Leaves that are not arrays are passed on unchanged. It
    works under every transformation of JAX; where nothing is traced, the function is called with NumPy arrays.
    """
    leaves, tree = jax.tree.flatten(arguments)
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array | np.ndarray | np.generic)]
    arrays = [x.astype(_NARROW[x.dtype]) if x.dtype in _NARROW else x for x in map(leaves.__getitem__, places)]
    is_on, made = has_doubles(), {}

    def call_with_arrays(*arrays):
        filled = list(leaves)
        for i, array in zip(places, arrays, strict=True):
            filled[i] = array
        found, made["tree"] = jax.tree.flatten(function(*tree.unflatten(filled)))
        made["others"] = [None if isinstance(x, jax.Array | np.ndarray | np.generic) else x for x in found]
        return [x for x, other in zip(found, made["others"], strict=True) if other is None]

    if all(map(is_concrete, arrays)):
        with jax.enable_x64(True):
            results = call_with_arrays(*map(_widen, arrays))
            results = [_narrow_array(x, is_on) for x in results]
    else:
        results = computed_p.bind(*map(jnp.asarray, arrays), of=_DoublesMap(call_with_arrays), keeps_integers=is_on)
    found = iter(results)
    return made["tree"].unflatten([next(found) if other is None else other for other in made["others"]])


def accepts_singles(state: tuple[str, ...], others: tuple[str, ...] = ()) -> Callable:
    """A decorator: the function is computed in float64 if the arguments named in `state` are float32.

    The arguments named in `others`, which are numbers too, are converted with them.
    """

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def decorated(*args, **kwargs):
            given = signature.bind(*args, **kwargs).arguments
            if not _are_single([given[name] for name in state if name in given]):
                return function(*args, **kwargs)
            numbers = {name: given[name] for name in (*state, *others) if name in given}
            numbers = jax.tree.map(lambda leaf: SINGLE.type(leaf) if type(leaf) is float else leaf, numbers)
            return compute_in_doubles(lambda numbers: function(**{**given, **numbers}), numbers)

        return decorated

    return decorate


def with_doubles(function: Callable) -> Callable:
    """A decorator: the function runs with float64 enabled; arrays that it returns have JAX's current precision."""

    @functools.wraps(function)
    def decorated(*args, **kwargs):
        if has_doubles():
            return function(*args, **kwargs)
        return compute_in_doubles(lambda: function(*args, **kwargs))

    return decorated


def _are_single(numbers: PyTree) -> bool:
    """True if JAX would compute with these numbers in float32; leaves that are no numbers are ignored."""
    kinds = set()
    for leaf in jax.tree.leaves(numbers):
        with contextlib.suppress(TypeError, ValueError):
            kinds.add(dtype_of(leaf))
    return SINGLE in kinds and DOUBLE not in kinds


def has_doubles() -> bool:
    return jax.dtypes.canonicalize_dtype(DOUBLE) == DOUBLE


def widen(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda x: _widen(x) if isinstance(x, jax.Array | np.ndarray | np.generic) else x, tree)


def _widen(array) -> np.ndarray:
    return np.asarray(array, _WIDE.get(array.dtype, array.dtype))


def _narrow_array(array, keeps_integers: bool):
    """The array as float32 (and int32), converted by NumPy without compilation; a NumPy array stays one."""
    narrow = np.asarray(array).astype(_narrow_tree(array.dtype, keeps_integers), copy=False)
    return narrow if not isinstance(array, jax.Array) else jax.device_put(narrow)


def _narrow_tree(dtype, keeps_integers: bool) -> np.dtype:
    dtype = np.dtype(dtype)
    if dtype.kind in "iu" and not keeps_integers:
        return np.dtype(f"{dtype.kind}{min(dtype.itemsize, 4)}")
    return _NARROW.get(dtype, dtype)


# ---- the primitive ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _DoublesMap:
    """A function of arrays (*x, *v) that returns a list of arrays and is linear in v, its last `linear` arguments.

    `transposed(*x, *w)` gives the cotangents of v from cotangents w of the results. `results` are the shapes and types
    of the results, if they are known without tracing the function.
    """

    function: Callable
    linear: int = 0
    transposed: Callable | None = None
    results: tuple[ShapedArray, ...] | None = None

    def derivative(self, size: int, moving: tuple[int, ...], results: dict[int, ShapedArray]) -> "_DoublesMap":
        """The map from the `size` arguments, then tangents of those at positions `moving`, to tangents of `results`."""

        def restrict_to_moving(arguments, others):
            def function(*moved):
                given = dict(zip(moving, moved, strict=True))
                values = self.function(*(given.get(i, x) for i, x in enumerate(arguments)))
                return [values[i] for i in results]

            return function, tuple(jnp.asarray(arguments[i]) for i in moving), tuple(map(jnp.asarray, others))

        def forward(*given):
            return jax.jvp(*restrict_to_moving(given[:size], given[size:]))[1]

        def back(*given):
            function, at, cotangents = restrict_to_moving(given[:size], given[size:])
            return list(jax.vjp(function, *at)[1](list(cotangents)))

        return _DoublesMap(forward, len(moving), back, tuple(results.values()))

    def batched(self, axes: tuple, size: int) -> "_DoublesMap":
        """The map for a batch of `size` members along `axes` of its arguments; results have the batch as first axis."""
        first, back = len(axes) - self.linear, self.transposed

        def transposed(*given):
            assert back is not None
            return jax.vmap(back, in_axes=(*axes[:first], *[0] * (len(given) - first)))(*given)

        results = self.results and tuple(ShapedArray((size, *x.shape), x.dtype) for x in self.results)
        return _DoublesMap(jax.vmap(self.function, in_axes=axes), self.linear, transposed, results)


def _result_shapes(*arrays, of: _DoublesMap, keeps_integers: bool):
    if of.results is not None:
        return list(of.results)
    with jax.enable_x64(True):
        wide = [jax.ShapeDtypeStruct(x.shape, _WIDE.get(x.dtype, x.dtype)) for x in arrays]
        results = jax.eval_shape(of.function, *wide)
    return [ShapedArray(x.shape, _narrow_tree(x.dtype, keeps_integers)) for x in results]


def _lower_to_doubles(ctx, *arrays, of: _DoublesMap, keeps_integers: bool):
    def rounded(*arrays):
        results = of.function(*(x.astype(_WIDE.get(x.dtype, x.dtype)) for x in arrays))
        return [jnp.asarray(x).astype(_narrow_tree(x.dtype, keeps_integers)) for x in results]

    with jax.enable_x64(True):
        return mlir.lower_fun(rounded, multiple_results=True)(ctx, *arrays)


def _map_jvp(primals, tangents, results, *, of: _DoublesMap, **settings):
    floats = {i: _shape_of(x) for i, x in enumerate(results) if jnp.issubdtype(x.dtype, jnp.inexact)}
    moving = tuple(i for i, x in enumerate(tangents) if not is_zero(x))
    derivative = of.derivative(len(primals), moving, floats)
    changes = computed_p.bind(*primals, *(tangents[i] for i in moving), of=derivative, **settings)
    changes = dict(zip(floats, changes, strict=True))
    return [changes.get(i) for i in range(len(results))]


def _shape_of(x) -> ShapedArray:
    aval = x.aval if ad.is_undefined_primal(x) else jax.typeof(x)
    return ShapedArray(aval.shape, aval.dtype)


def _transpose_map(known, cotangents, moving, *, of: _DoublesMap, **settings):
    assert of.transposed is not None
    transposed = _DoublesMap(of.transposed, len(cotangents), of.function, tuple(map(_shape_of, moving)))
    return computed_p.bind(*known, *cotangents, of=transposed, **settings)


def _batch_map(arrays, axes, *, of: _DoublesMap, **settings):
    first = len(arrays) - of.linear
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    # What it is linear in has one row a member, so that a cotangent of it has, too.
    arrays = [
        jnp.broadcast_to(x, (size, *x.shape)) if i >= first and axis is None else x
        for i, (x, axis) in enumerate(zip(arrays, axes, strict=True))
    ]
    axes = tuple(0 if i >= first and axis is None else axis for i, axis in enumerate(axes))
    results = computed_p.bind(*arrays, of=of.batched(axes, size), **settings)
    return results, [0] * len(results)


computed_p = LinearMap("lagjax_in_doubles", _result_shapes, _map_jvp, lambda *, of, **_: of.linear, _transpose_map)
compute_on_host(
    computed_p,
    lambda *arrays, of, keeps_integers: [_narrow_array(x, keeps_integers) for x in of.function(*map(_widen, arrays))],
)
mlir.register_lowering(computed_p, _lower_to_doubles)
batching.primitive_batchers[computed_p] = _batch_map
