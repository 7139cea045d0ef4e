"""`LinearMap`: the base class of lagjax's JAX primitives, which defines all of their transformation rules.

With y = f(x, v), linear in v, and D the derivative of f by x,

    dy = f(x, dv) + D(x, v) dx            batches: one call, with the members as the first axis
    transposed: (x, w) ↦ the cotangents of v

`attach_derivative` gives values the derivatives of another expression. `jax.custom_jvp` does the same, but inside
`jax.lax.scan` its rule is lost where forward mode is applied to reverse mode (jax 0.10: the value is then
differentiated instead, without a warning; tests/equations/test_custom.py keeps the case). A primitive has no body to
differentiate.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import PartitionSpec


class VaryingPrimitive(Primitive):
    """A primitive whose results, under `jax.shard_map`, vary along every mesh axis along which an argument varies.

    JAX keeps these axes in the types of arrays, and derives from them which cotangents are summed over the devices.
    """

    on_host: Callable  # (*arrays, **settings) by NumPy, with members in front
    composed: Callable  # or the same of other primitives

    def bind(self, *args, **settings):
        return super().bind(*vary_alike(args), **settings)

    def def_abstract_eval(self, rule):
        def add_axes(*args, **settings):
            results = rule(*args, **settings)
            given = next((x for x in args if x.mat.varying), None)
            return results if given is None else jax.tree.map(functools.partial(_with_type_variation, given), results)

        super().def_abstract_eval(add_axes)
        return rule


def _with_type_variation(given: ShapedArray, result: ShapedArray) -> ShapedArray:
    """The type `result`, varying along the mesh axes of the type `given`."""
    everywhere = given.sharding.update(spec=PartitionSpec(*[None] * result.ndim))
    return result.update(sharding=everywhere, manual_axis_type=given.mat)


def vary_alike(arrays: Sequence, like: Sequence = ()) -> list:
    """The arrays, each varying along every mesh axis along which one of them, or of `like`, varies."""
    own = [jax.typeof(x).mat.varying for x in (*arrays, *like)]
    axes = frozenset().union(*own)
    return [
        jax.lax.pcast(x, tuple(axes - here), to="varying") if axes - here else x
        for x, here in zip(arrays, own[: len(arrays)], strict=True)
    ]


def vary_carry_alike(first, *operands):
    """The initial carry of a loop, whose numbers all vary along the mesh axes of its numbers and the `operands`.

    Otherwise the cotangent of a number that is equal on all devices is summed over them in each round, and devices that
    have finished their rounds would block the others.
    """
    numbers, others = eqx.partition(first, eqx.is_array_like)
    arrays, structure = jax.tree.flatten(numbers)
    return eqx.combine(structure.unflatten(vary_alike(arrays, like=jax.tree.leaves(operands))), others)


def cond_alike(predicate, when_true: Callable, when_false: Callable, *operands):
    """`jax.lax.cond` in which the results of both branches vary along the mesh axes of the operands."""

    def alike(branch):
        return lambda *operands: vary_carry_alike(branch(*operands), operands)

    return jax.lax.cond(predicate, alike(when_true), alike(when_false), *operands)


class LinearMap(VaryingPrimitive):
    """A primitive (*x, *v; settings) ↦ a list of arrays, linear in its last `linear` arguments v.

    `shapes` gives the types of its results. `vary(primals, tangents of x, results, **settings)` gives the tangents of
    the results due to x, None for a zero one; a tangent that is zero may be an `ad.Zero`. `transpose(x, w, v,
    **settings)` gives the cotangents of v, whose shapes alone are known, from those of the results, w. `linear` may be
    a function of the settings.
    """

    multiple_results = True

    def __init__(
        self, name: str, shapes: Callable, vary: Callable, linear: int | Callable = 0, transpose: Callable | None = None
    ):
        super().__init__(name)
        self.def_abstract_eval(shapes)
        self._vary, self._linear, self._transpose = vary, linear, transpose
        ad.primitive_jvps[self] = self._derive
        if transpose is not None:
            ad.primitive_transposes[self] = self._pull_back
        batching.primitive_batchers[self] = self._batch

    def _first(self, arguments, settings: dict) -> int:
        """The number of arguments x: the position of the first argument v."""
        return len(arguments) - (self._linear(**settings) if callable(self._linear) else self._linear)

    def _derive(self, primals, tangents, **settings):
        outs, first = self.bind(*primals, **settings), self._first(primals, settings)
        parts = []
        if not all(map(is_zero, tangents[first:])):
            parts.append(self.bind(*primals[:first], *map(ad.instantiate_zeros, tangents[first:]), **settings))
        if not all(map(is_zero, tangents[:first])):
            parts.append(self._vary(primals, tangents[:first], outs, **settings))
        terms = [[term for term in of if term is not None] for of in zip(*parts, strict=True)] or [[]] * len(outs)
        return outs, [sum(of[1:], of[0]) if of else zero_like(x) for x, of in zip(outs, terms, strict=True)]

    def _pull_back(self, cotangents, *arguments, **settings):
        first = self._first(arguments, settings)
        known, moving = arguments[:first], arguments[first:]
        assert self._transpose is not None
        found = self._transpose(known, list(map(ad.instantiate_zeros, cotangents)), moving, **settings)
        return [None] * first + [cotangent_of(x, ct) for x, ct in zip(moving, found, strict=True)]

    def _batch(self, arrays, axes, **settings):
        outs = self.bind(*batch_in_front(arrays, axes), **settings)
        return outs, [0] * len(outs)


def compute_on_host(primitive: Primitive, function: Callable) -> None:
    """Register `function`, on NumPy arrays and with float64 on, as the evaluation of a primitive outside `jit`."""

    def evaluate(*arrays, **settings):
        with jax.enable_x64(True):
            return jax.device_put([np.asarray(x) for x in function(*map(np.asarray, arrays), **settings)])

    primitive.on_host = function  # pyright: ignore[reportAttributeAccessIssue]
    primitive.def_impl(evaluate)


def is_zero(tangent) -> bool:
    return isinstance(tangent, ad.Zero)


def zero_like(x) -> ad.Zero:
    """The symbolic zero tangent of a result that does not vary."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def cotangent_of(argument, cotangent):
    """The cotangent of an argument of a transpose, summed over broadcast axes; None if the argument is known."""
    if not ad.is_undefined_primal(argument):
        return None
    shape = argument.aval.shape
    axes = tuple(i for i, (a, b) in enumerate(zip(cotangent.shape, shape, strict=True)) if a != b)
    return jnp.sum(cotangent, axis=axes, keepdims=True) if axes else cotangent


def batch_in_front(arrays, axes) -> list:
    """The arguments of a batching rule, each with the batch as first axis; unbatched ones are broadcast."""
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    return [
        x if axis == 0 else jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]


# ---- values with the derivatives of another expression ---------------------------------------------------------------


def attach_derivative(function: Callable, values: tuple, *arguments) -> tuple:
    """The tuple `values` with the derivatives, of every order, of `function(*arguments)`, a tuple of equal shapes.

    `function` may depend on its arguments only, which are arrays.
    """
    fixed = [jax.lax.stop_gradient(jnp.asarray(x)) for x in values]
    return tuple(attach_p.bind(*fixed, *map(jnp.asarray, arguments), function=function, count=len(fixed)))


def _first_arrays(*arrays, function, count):
    return list(arrays[:count])


def _vary_expression(primals, tangents, _, *, function, count):
    arguments, moving = primals[count:], tangents[count:]
    floats = [i for i, x in enumerate(arguments) if jnp.issubdtype(x.dtype, jnp.floating) and not is_zero(moving[i])]

    def call_with_floats(*some):
        given = dict(zip(floats, some, strict=True))
        return function(*(given.get(i, x) for i, x in enumerate(arguments)))

    return jax.jvp(call_with_floats, tuple(arguments[i] for i in floats), tuple(moving[i] for i in floats))[1]


def _batch_expression(arrays, axes, *, function, count):
    return attach_p.bind(*batch_in_front(arrays, axes), function=jax.vmap(function), count=count), [0] * count


attach_p = LinearMap("lagjax_differentiated_as", lambda *avals, count, **_: list(avals[:count]), vary=_vary_expression)
attach_p.def_impl(_first_arrays)
mlir.register_lowering(attach_p, mlir.lower_fun(_first_arrays, multiple_results=True))
batching.primitive_batchers[attach_p] = _batch_expression


# ---- derivatives along which some numbers stay together --------------------------------------------------------------


def limit_directions(y, offsets, limits):
    """`y` (…, m); its derivatives are NaN along directions in which an offset (…, k) changes by more than its limit.

    Reverse mode has no single direction: where a limit is finite and the cotangent is not zero, derivatives are NaN.
    """
    return limited_p.bind(limits, y, offsets)[0]


def _mask_far(limits, y, offsets, library: Any = jnp):
    near = library.all(library.abs(offsets) <= limits, axis=-1, keepdims=True)
    return [library.where(near, y, jnp.nan)]


def _pull_mask(known, cotangents, moving):
    (limits,), (cotangent,) = known, cotangents
    lost = jnp.isfinite(limits) & jnp.any(cotangent != 0, axis=-1, keepdims=True)
    return [cotangent, jnp.where(lost, jnp.nan, 0.0)]


limited_p = LinearMap("lagjax_together", lambda limits, y, _: [y], lambda *_: [None], 2, _pull_mask)
limited_p.def_impl(_mask_far)
limited_p.on_host = functools.partial(_mask_far, library=np)
mlir.register_lowering(limited_p, mlir.lower_fun(_mask_far, multiple_results=True))


# ---- linear systems --------------------------------------------------------------------------------------------------


def solve(a, b):
    """The solution x of A x = b, for A (…, n, n) and b (…, n); NaN where A is singular."""
    return solve_p.bind(a, b)[0]


def _solve_on_host(a, b):
    a, b = (np.broadcast_to(x, (max(len(a), len(b)), *x.shape[1:])) for x in (a, b))
    try:
        return [np.linalg.solve(a, b[..., None])[..., 0]]
    except np.linalg.LinAlgError:
        regular = np.linalg.slogdet(a)[0] != 0
        unit = np.where(regular[..., None, None], a, np.eye(a.shape[-1]))
        return [np.where(regular[..., None], np.linalg.solve(unit, b[..., None])[..., 0], np.nan)]


def _vary_solution(primals, tangents, outs):
    return [] if is_zero(tangents[0]) else [-solve(primals[0], (tangents[0] @ outs[0][..., None])[..., 0])]


def _transpose_solution(known, cotangents, _):
    return [solve(jnp.swapaxes(known[0], -1, -2), cotangents[0])]


def solve_composed(a, b):
    return [jnp.linalg.solve(a, b[..., None])[..., 0]]


solve_p = LinearMap("lagjax_solve", lambda _, b: [b], _vary_solution, 1, _transpose_solution)
compute_on_host(solve_p, _solve_on_host)
mlir.register_lowering(solve_p, mlir.lower_fun(solve_composed, multiple_results=True))
