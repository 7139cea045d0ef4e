"""Reports of motions that failed: an error is raised, or values and their derivatives become NaN.

A failure is known when the numbers are: at once in plain Python and under `jax.vmap` or `jax.grad` alone, at run time
inside `jax.jit`. `raise_where_failed` is one primitive for all cases. The values it returns depend on the check, and so
do their derivatives, so that the check is not removed as dead code.

An output that was not reached has no derivative. `where` alone would make it zero in reverse mode, since its second
branch is a constant; `nan_unless` makes it NaN wherever its cotangent is not zero.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from equinox._config import EQX_ON_ERROR
from jax.core import ShapedArray
from jax.experimental.buffer_callback import buffer_callback
from jax.interpreters import ad, batching, mlir

from lagjax._interface import ENDED_WELL, RESULTS, SimulationError, advice, code_of, result_from
from lagjax._primitives._linear_map import (
    LinearMap,
    VaryingPrimitive,
    batch_in_front,
    compute_on_host,
    cond_alike,
    is_zero,
)


def raise_where_failed(tree, result, end, t_last, names: tuple[str, ...]):
    """`tree` unchanged if its motion succeeded; else `SimulationError`, naming what failed, when, in which member.

    `result` is a result code, `end` = (t, y) the time and the state (2n,) at which the motion ended, `t_last` the time
    it was to reach, and `names` (n,) those of the coordinates. Inside `jax.jit` the error is JAX's own, and its text
    ends with this one.
    """
    (passed,) = check_p.bind(*map(jnp.asarray, (result, end[0], t_last, end[1])), names=names)
    return _nan_unless_passed(passed, tree)


@functools.partial(jax.jit, inline=True)  # outside of `jit` one program
def _nan_unless_passed(passed, tree):
    def checked(leaf):
        return jnp.where(passed == 0, leaf, jnp.nan) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(checked, tree)


def sentence(result, t_end, t_last, y_end, names: tuple[str, ...], why: str | None = None) -> str | None:
    """The error sentence of the first failed member: its time and state; None if no member failed.

    All arrays may have batch axes. `why`, if given, replaces the general advice on the result code.
    """
    result, t_end, t_last, y_end = map(np.asarray, (result, t_end, t_last, y_end))
    failed = np.argwhere(~np.isin(result, ENDED_WELL)).tolist()
    if not failed:
        return None
    who, member = "", tuple(failed[0])
    if member:
        label = member[0] if len(member) == 1 else member
        others = f", the first of {len(failed)} that failed" if len(failed) > 1 else ""
        who = f" of member {label}{others} among {result.size},"
    if result[member] == code_of(RESULTS.derivatives_lost):
        return f"The motion{who} has no derivatives here. {advice(result_from(result[member]))}"
    t_last, y = np.broadcast_to(t_last, result.shape)[member], y_end[member]
    q, qdot = y[: len(names)], y[len(names) :]
    state = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names[:8], q[:8], strict=True))
    velocity = ", ".join(f"{value:.6g}" for value in qdot[:8])
    return (
        f"The motion{who} could not be followed beyond t = {float(t_end[member]):.9g} of {float(t_last):.9g}. "
        f"{why or advice(result_from(result[member]))}\nThe last state was {state}; velocities {velocity}."
    )


def _raise_failure(result, t_end, t_last, y_end, *, names):
    if text := sentence(result, t_end, t_last, y_end, names):
        raise SimulationError(text, None)
    return [np.zeros(result.shape, t_end.dtype)]


_CHECK_SHAPES = lambda result, t_end, *_, **__: [ShapedArray(result.shape, t_end.dtype)]  # noqa: E731
check_p = LinearMap("lagjax_check", _CHECK_SHAPES, vary=lambda *_, **__: [None])
compute_on_host(check_p, _raise_failure)


def _lower_check(call: Callable):
    """The lowering of the check: one comparison on the device; `call(host, shape, *arrays)` after a failure."""

    def check(result, t_end, *others, names):
        def host(*arrays):
            _raise_failure(*map(np.asarray, arrays), names=names)

        shape = jax.ShapeDtypeStruct(result.shape, t_end.dtype)
        well = jnp.isin(result, jnp.asarray(ENDED_WELL, result.dtype)).all()
        given = functools.partial(call, host, shape), result, t_end, *others
        return [cond_alike(well, lambda *_: jnp.zeros(shape.shape, shape.dtype), *given)]

    return mlir.lower_fun(check, multiple_results=True)


NOT_EXPORTED = (
    "jax.export cannot take {} along: give a solver of diffrax and leave the error out, as "
    "simulate(…, solver=diffrax.Dopri8(), throw=False), and set EQX_ON_ERROR=nan in the environment before Python "
    "starts: all three. To serialize what is exported, pip install flatbuffers."
)


def _lower_callback(rule: Callable, what: str, in_exports: bool = False):
    """The lowering `rule` of a primitive that calls back to this process; it refuses `jax.export`, naming `what`."""

    def lower_checked(context, *args, **settings):
        if context.module_context.lowering_parameters.for_export and not in_exports:
            raise ValueError(NOT_EXPORTED.format(what))
        return rule(context, *args, **settings)

    return lower_checked


_RAISES = "an error that is raised at run time, as with throw=True,"
mlir.register_lowering(check_p, _lower_callback(_lower_check(jax.pure_callback), _RAISES))
mlir.register_lowering(
    check_p,
    _lower_callback(
        _lower_check(lambda host, shape, *xs: buffer_callback(lambda _, __, *ys: host(*ys), shape)(*xs)), _RAISES
    ),
    platform="cpu",
)

# The steps of diffrax have checks of equinox, which call back to the host as well, but for EQX_ON_ERROR=nan.
steps_p = LinearMap("lagjax_steps", lambda ended: [ended], vary=lambda *_, **__: [None])
compute_on_host(steps_p, lambda ended: [ended])
_silent = EQX_ON_ERROR in ("nan", "off")
_same = mlir.lower_fun(lambda ended: [ended], multiple_results=True)
mlir.register_lowering(steps_p, _lower_callback(_same, "the checks of diffrax's steps", _silent))


def mark_steps(ended):
    """The flags of the outputs that diffrax reached, unchanged; `ValueError` if they are exported with its checks."""
    return steps_p.bind(ended)[0]


# ---- outputs that were not reached -----------------------------------------------------------------------------------


def allows_nan(function: Callable) -> Callable:
    """A decorator for functions whose results contain NaN as "none": after an event, or beyond the last crossing.

    `jax_debug_nans`, which would report these as errors, is off inside. A failed motion has a result code of its own.
    """

    @functools.wraps(function)
    def decorated(*args, **kwargs):
        with jax.debug_nans(False):
            return function(*args, **kwargs)

    return decorated


def nan_unless(reached, x):
    """`x` where `reached` is true, else NaN, derivatives too; the cotangent of an unused value stays zero."""
    return undefined_unless(reached, x, ())


def undefined_unless(reached, x, inputs):
    """`x` where `reached` is true, else NaN, and so are its derivatives of all orders by x and floats of `inputs`.

    A zero cotangent stays zero.
    """
    return nan_unless_p.bind(jnp.broadcast_to(reached, jnp.shape(x)), x, *_float_arrays(inputs), marks=True, batch=0)


def differentiable_where(well, x, *inputs):
    """`x` unchanged; its derivatives by x and by `inputs` are NaN unless `well` is true."""
    return nan_unless_p.bind(jnp.broadcast_to(well, jnp.shape(x)), x, *_float_arrays(inputs), marks=False, batch=0)


def _float_arrays(tree) -> list:
    return [x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]


def _nan_unless(reached, x, *_, marks, batch, library: Any = jnp):
    return library.where(reached, x, jnp.nan) if marks else x


def _nan_unless_transpose(cotangent, reached, x, *inputs, marks, batch):
    """The transpose in x and in those inputs that it is linear in; the first `batch` axes of arrays are batches."""
    cotangent = ad.instantiate_zeros(cotangent)
    kept = reached | (cotangent == 0)
    all_kept = kept.all(tuple(range(batch, kept.ndim)))
    known = [y for y in inputs if not ad.is_undefined_primal(y)]

    def lose(where, value):
        return nan_unless_p.bind(where, value, *known, marks=True, batch=batch)

    def lose_zero(linear):
        shape = linear.aval.shape
        where = all_kept.reshape(all_kept.shape + (1,) * (len(shape) - batch))
        return lose(jnp.broadcast_to(where, shape), jnp.zeros(shape, linear.aval.dtype))

    of_x = lose(kept, cotangent) if ad.is_undefined_primal(x) else None
    return [None, of_x, *(lose_zero(y) if ad.is_undefined_primal(y) else None for y in inputs)]


def _nan_unless_jvp(primals, tangents, **settings):
    """The tangent, NaN like the value; it keeps all inputs as arguments, so that its own derivatives are NaN too."""
    reached, x, *inputs = primals
    moving = [t for t in tangents[2:] if not is_zero(t)]
    along = ad.instantiate_zeros(tangents[1])
    values = nan_unless_p.bind(*primals, **settings)
    return values, nan_unless_p.bind(reached, along, *moving, x, *inputs, **settings | {"marks": True})


def _nan_unless_batch(args, axes, *, marks, batch):
    return nan_unless_p.bind(*batch_in_front(args, axes), marks=marks, batch=batch + 1), 0


nan_unless_p = VaryingPrimitive("lagjax_nan_unless")
nan_unless_p.def_abstract_eval(lambda reached, x, *_, **__: ShapedArray(x.shape, x.dtype))
nan_unless_p.def_impl(_nan_unless)
nan_unless_p.on_host = functools.partial(_nan_unless, library=np)
mlir.register_lowering(nan_unless_p, mlir.lower_fun(_nan_unless, multiple_results=False))
ad.primitive_jvps[nan_unless_p] = _nan_unless_jvp
ad.primitive_transposes[nan_unless_p] = _nan_unless_transpose
batching.primitive_batchers[nan_unless_p] = _nan_unless_batch
