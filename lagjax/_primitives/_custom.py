"""Primitives of our own, and values whose derivatives are those of another expression.

`jax.custom_jvp` says the same, but inside `jax.lax.scan` its rule is lost where forward mode goes over reverse mode
(jax 0.10: the value is then differentiated instead, without a word; tests/equations/test_custom.py keeps the case). A
primitive of its own is not seen through.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import PartitionSpec


class VaryingPrimitive(Primitive):
    """A primitive whose results vary, under `jax.shard_map`, along every mesh axis that an argument varies along.

    JAX writes that into the types of arrays, and reads off them which cotangents are summed over the devices.
    """

    def bind(self, *args, **settings):
        return super().bind(*vary_alike(args), **settings)

    def def_abstract_eval(self, rule):
        def add_axes(*args, **settings):
            results = rule(*args, **settings)
            given = next((x for x in args if x.mat.varying), None)
            return results if given is None else jax.tree.map(functools.partial(_like, given), results)

        super().def_abstract_eval(add_axes)
        return rule


def _like(given: ShapedArray, result: ShapedArray) -> ShapedArray:
    """The type of a result that varies as the type that is given does."""
    everywhere = given.sharding.update(spec=PartitionSpec(*[None] * result.ndim))
    return result.update(sharding=everywhere, manual_axis_type=given.mat)


def vary_alike(arrays: Sequence, like: Sequence = ()) -> list:
    """These arrays, each varying along every mesh axis that one of them, or one of `like`, varies along."""
    own = [jax.typeof(x).mat.varying for x in (*arrays, *like)]
    axes = frozenset().union(*own)
    return [
        jax.lax.pcast(x, tuple(axes - here), to="varying") if axes - here else x
        for x, here in zip(arrays, own[: len(arrays)], strict=True)
    ]


def cond_alike(predicate, when_true: Callable, when_false: Callable, *operands):
    """`jax.lax.cond`, of which both branches' results vary as the operands do."""

    def alike(branch):
        def vary_results(*operands):
            results, structure = jax.tree.flatten(branch(*operands))
            return jax.tree.unflatten(structure, vary_alike(results, like=operands))

        return vary_results

    return jax.lax.cond(predicate, alike(when_true), alike(when_false), *operands)


def attach_derivative(function: Callable, values: tuple, *arguments) -> tuple:
    """`values`, a tuple of arrays, with the derivatives of `function(*arguments)`, a tuple like it; of every order.

    `function` may only vary with its arguments, which are arrays.
    """
    fixed = [jax.lax.stop_gradient(jnp.asarray(x)) for x in values]
    return tuple(with_p.bind(*fixed, *map(jnp.asarray, arguments), function=function, count=len(fixed)))


def _values(*arrays, function, count):
    return list(arrays[:count])


def _jvp(primals, tangents, *, function, count):
    arguments, moving = primals[count:], tangents[count:]
    floats = [i for i, x in enumerate(arguments) if jnp.issubdtype(x.dtype, jnp.floating)]

    def call_with_floats(*some):
        given = dict(zip(floats, some, strict=True))
        return function(*(given.get(i, x) for i, x in enumerate(arguments)))

    along = [ad.instantiate_zeros(moving[i]) for i in floats]
    changes = jax.jvp(call_with_floats, tuple(arguments[i] for i in floats), tuple(along))[1]
    return with_p.bind(*primals, function=function, count=count), list(changes)


def batch_in_front(arrays, axes) -> list:
    """The arguments of a batching rule, each with the batch as its first axis, those that are shared as well."""
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    return [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]


def _batch(arrays, axes, *, function, count):
    arrays = batch_in_front(arrays, axes)
    return with_p.bind(*arrays, function=jax.vmap(function), count=count), [0] * count


with_p = VaryingPrimitive("lagjax_differentiated_as")
with_p.multiple_results = True
with_p.def_impl(_values)
with_p.def_abstract_eval(lambda *avals, function, count: list(avals[:count]))
mlir.register_lowering(with_p, mlir.lower_fun(_values, multiple_results=True))
ad.primitive_jvps[with_p] = _jvp
batching.primitive_batchers[with_p] = _batch
