"""Values whose derivatives are those of another expression.

`jax.custom_jvp` says the same, but inside `jax.lax.scan` its rule is lost where forward mode goes over reverse mode
(jax 0.10: the value is then differentiated instead, without a word; tests/equations/test_custom.py keeps the case). A
primitive of its own is not seen through.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


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


with_p = Primitive("lagjax_differentiated_as")
with_p.multiple_results = True
with_p.def_impl(_values)
with_p.def_abstract_eval(lambda *avals, function, count: list(avals[:count]))
mlir.register_lowering(with_p, mlir.lower_fun(_values, multiple_results=True))
ad.primitive_jvps[with_p] = _jvp
batching.primitive_batchers[with_p] = _batch
