"""Flows as functions of JAX: four primitives with their derivatives, batching and lowering.

With F the map (ts, y0, params) → (path, y_end) of a flow and D its derivative by (y0, params) between fixed times,

    run         F
    jvp        D v            linear in v = (δy0, δparams)              transposed: vjp
    vjp        Dᵀ w           linear in w = (w_path, w_end)             transposed: jvp
    curvature   (∂/∂x wᵀ D) d  linear in w and in d, symmetric in d      transposed in d: itself

and their derivatives close the circle, so that there are derivatives of every order in every mode:

    d run  = jvp(v − f₀ δt₀) + f δt                  f the rate (q̇, q̈) of the state, f₀ at the start
    d jvp = jvp(dv) + D² F [v, dx]                  by the run of the tangent flow
    d vjp = vjp(dw) + curvature(w, dx) + …          by the vjp of the tangent flow, and what moves with the times

To move an output time by δt moves the output by f δt; to start later from the same state is to start from another one.
Source: Griewank & Walther, *Evaluating Derivatives* (2008), §§3–5, for forward, reverse, and forward over
reverse.

Every primitive takes arrays with any batch axes in front, as many of them in each, of length one where an argument is
shared; under `jax.vmap` it is still one call of machine code. Outside of `jit` nothing is compiled but that.
"""

import functools
import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from lagjax._engine._problem import Solution
from lagjax._engine.taylor import _derivatives
from lagjax._engine.taylor._call import call_host, has_handler, has_sweep, run_by_handler, sweep_by_handler
from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._engine.taylor._gpu_launch import adapt_tolerances, run_on_gpu, transpose_on_gpu
from lagjax._engine.taylor._kept_steps import KEPT
from lagjax._engine.taylor._line_functions import outputs
from lagjax._engine.taylor._state_rates import rate
from lagjax._engine.taylor._variational import from_rows, to_rows
from lagjax._interface import SUCCESSFUL, default_platform
from lagjax._native import Begun, Projection
from lagjax._primitives import VaryingPrimitive, cond_alike
from lagjax._program import Program


def run(flow: Flow, tolerances: Tolerances, ts, y0, params) -> Solution:
    """The motion of one member, under every transformation of JAX; `ts` (T,), `y0` (2n,), `params` (P,).

    A flow with guards has no derivatives: they would have to say how its end moves.
    """
    if default_platform() == "cpu":  # outside of `jit` the host computes, and nothing is compiled for a new scene
        return _run(ts, y0, params, flow=flow, tolerances=tolerances, keep=False)
    return compile_once(_run, flow=flow, tolerances=tolerances, keep=False)(ts, y0, params)


@functools.lru_cache(maxsize=64)
def compile_once(function, *first, **settings):
    """A function of arrays, behind a flow or with one, as one program of XLA: what the host does not compute alone."""
    return jax.jit(functools.partial(function, *first, **settings))


# ---- on the host: NumPy arrays with any batch axes in front ----------------------------------------------------------


def _rows(arrays, inner, shared=(), library: Any = np):
    """Each array with one row a member, or one row where that is all there is to a `shared` one; and the batch axes."""
    leading = [x.shape[: x.ndim - k] for x, k in zip(arrays, inner, strict=True)]
    batch = np.broadcast_shapes(*leading)

    def rows(place, x, k):
        own = x.shape[x.ndim - k :]
        if place in shared and x.size == math.prod(own):
            return x.reshape(1, *own)
        return library.broadcast_to(x, batch + own).reshape(math.prod(batch), *own)

    return [rows(place, x, k) for place, (x, k) in enumerate(zip(arrays, inner, strict=True))], batch


def _restore_batch(results, batch):
    return [x.reshape(batch + x.shape[1:]) for x in results]


def _run_on_host(ts, y0, params, *, flow, tolerances, keep):
    rows, batch = _rows((ts, y0, params), (1, 1, 1), shared=(0, 2))
    return _restore_batch(flow.run(*rows, tolerances, KEPT if keep else None)[:_OUTPUTS], batch)


def _continue_run(ts, y0, params, *begun, flow, tolerances, **_):
    """The results of a run of rows of members, of which a handler has done what it could."""
    return flow.run(ts, y0, params, tolerances, begun=Begun(*begun))[:_OUTPUTS]


def _run_again(ts, y0, params, *_, flow, tolerances, **__):
    """The results of a run of rows of members whose steps are kept: from the beginning."""
    return flow.run(ts, y0, params, tolerances, KEPT)[:_OUTPUTS]


def _jvp_on_host(ts, y0, params, path, result, accepted, ticket, dy0, dparams, *, flow, tolerances, **_):
    arrays = ts, y0, params, path, result, accepted, ticket, dy0, dparams
    (ts, y0, params, *rest), batch = _rows(arrays, (1, 1, 1, 2, 0, 0, 0, 2, 2), shared=(0, 2))
    return _restore_batch(_derivatives.jvp(flow, ts, y0, params, rest[:4], *rest[4:], tolerances=tolerances), batch)


def _vjp_on_host(ts, y0, params, path, result, accepted, ticket, path_ct, end_ct, *, flow, tolerances, **_):
    arrays = ts, y0, params, path, result, accepted, ticket, path_ct, end_ct
    (ts, y0, params, *rest), batch = _rows(arrays, (1, 1, 1, 2, 0, 0, 0, 3, 2), shared=(0, 2))
    return _restore_batch(_derivatives.vjp(flow, ts, y0, params, rest[:4], *rest[4:], tolerances=tolerances), batch)


# ---- primitives ------------------------------------------------------------------------------------------------------

run_p, jvp_p, vjp_p, curvature_p = (VaryingPrimitive(f"lagjax_{name}") for name in ("run", "jvp", "vjp", "curvature"))
# Of run: a `Solution` but for the last field, which is that of a batch. jvp and vjp take of a run its ts, y0,
# params, path, result, accepted, ticket.
_OUTPUTS, _GIVEN = len(Solution._fields) - 1, 7


def _run(ts, y0, params, **settings) -> Solution:
    return Solution(*run_p.bind(ts, y0, params, **settings))


def _batch_of(args, inner):
    return np.broadcast_shapes(*(x.shape[: x.ndim - k] for x, k in zip(args, inner, strict=True)))


def _floats(*shapes):
    return [ShapedArray(shape, np.dtype(float)) for shape in shapes]


def _run_shapes(ts, y0, params, *, flow, tolerances, **_):
    batch = _batch_of((ts, y0, params), (1, 1, 1))
    counts = [ShapedArray(batch, np.dtype(int))] * (_OUTPUTS - 3)
    floats = _floats((*batch, *flow.path_shape(ts.shape[-1], tolerances.notes)), (*batch, flow.states), batch)
    return [*floats, *counts]


def _jvp_shapes(*args, flow, **_):
    batch, m = _batch_of((*args[:3], *args[_GIVEN:]), (1, 1, 1, 2, 2)), args[_GIVEN].shape[-2]
    return _floats((*batch, m, args[0].shape[-1], flow.states), (*batch, m, flow.states))


def _vjp_shapes(*args, flow, **_):
    batch = _batch_of(args, (1, 1, 1, 2, 0, 0, 0, 3, 2))
    m = args[-1].shape[-2]
    return _floats((*batch, m, flow.states), (*batch, m, flow.numbers))


def _curvature_shapes(*args, flow, **_):
    batch = _batch_of(args, (1, 1, 1, 2, 1, 1, 1))
    return _floats((*batch, flow.states), (*batch, flow.numbers))


def _curvature_composed(ts, y0, params, path_ct, end_ct, dy0, dparams, *, flow, tolerances):
    """`curvature` by going back over the steps of the tangent flow, with cotangents of the tangent alone."""
    larger, tolerances = flow.tangent(1), tolerances.with_larger_budget
    given, length = _tangent_inputs(flow, ts, y0, params, dy0, dparams)
    solution = _run(*given, flow=larger, tolerances=tolerances, keep=True)
    path_ct, end_ct = (from_rows(jnp.stack([jnp.zeros_like(ct), ct], axis=-2)) for ct in (path_ct, end_ct))
    cts = path_ct[..., None, :, :], end_ct[..., None, :]
    state_ct, numbers_ct = vjp_p.bind(*given, *_residuals(solution), *cts, flow=larger, tolerances=tolerances)
    state_ct, numbers_ct = to_rows(state_ct[..., 0, :], flow.size)[..., 0, :], numbers_ct[..., 0, : flow.numbers]
    return [state_ct * length, numbers_ct * length]


def _jvp_composed(ts, y0, params, dy0, dparams, *, flow, tolerances):
    """`jvp` along one direction, (…, 2n) and (…, P), by the run of the tangent flow: for its own derivatives."""
    given, length = _tangent_inputs(flow, ts, y0, params, dy0, dparams)
    larger = flow.tangent(1)
    solution = _run(*given, flow=larger, tolerances=tolerances.with_larger_budget, keep=False)
    path, end = (to_rows(y, flow.size)[..., 1, :] for y in (solution.path, solution.y_end))
    return path * length[..., None], end * length


def _tangent_inputs(flow: Flow, ts, y0, params, dy0, dparams):
    """The start of the tangent flow, for a direction of length one; and the length."""
    if flow.projection is not None:
        dy0 = compile_once(_project_direction, flow)(ts[..., 0], y0, params, dy0, dparams)
    length = jnp.max(jnp.abs(dy0), axis=-1, keepdims=True)
    if flow.numbers:
        length = jnp.maximum(*jnp.broadcast_arrays(length, jnp.max(jnp.abs(dparams), axis=-1, keepdims=True)))
    length = jax.lax.stop_gradient(jnp.where(length > 0, length, 1.0))
    start = from_rows(jnp.stack(jnp.broadcast_arrays(y0, dy0 / length), axis=-2))
    numbers = jnp.concatenate(jnp.broadcast_arrays(params, dparams / length), axis=-1)
    return (ts, start, numbers), length


def _project_direction(flow: Flow, t, y0, params, dy0, dparams):
    """The tangent of the projection of a start, at which a motion with constraints begins (see `_derivatives`)."""

    def differentiate_start(t, y, p, dy, dp):
        def start(y, p):
            return outputs(cast(Program, cast(Projection, flow.projection).state), flow.states, jnp.append(y, t), p)

        return jax.jvp(start, (y, p), (dy, dp))[1]

    return jnp.vectorize(differentiate_start, signature="(),(s),(p),(s),(p)->(s)")(t, y0, params, dy0, dparams)


def _rate(flow: Flow, *state):
    """`rate` at a state (t, y, params), compiled as one."""
    return compile_once(rate, flow)(*state)


def _residuals(solution: Solution):
    """The outcome of a run that `jvp` and `vjp` take; their values do not vary with it."""
    given = solution.path, solution.result, solution.accepted, solution.ticket
    return tuple(jax.lax.stop_gradient(x) for x in given)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _zero(tangent) -> bool:
    return isinstance(tangent, ad.Zero)


def _value(tangent):
    """A tangent as an array; zeros where it is known to be none."""
    return ad.instantiate_zeros(tangent)


def _derivative_of_run(primals, tangents, *, flow, tolerances, keep):
    (ts, y0, params), (dts, dy0, dparams) = primals, tangents
    if flow.guards is not None or all(map(_zero, tangents)):
        outs = run_p.bind(*primals, flow=flow, tolerances=tolerances, keep=keep)
        return outs, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs]
    outs = run_p.bind(*primals, flow=flow, tolerances=tolerances, keep=True)
    solution = Solution(*outs)
    dy0, dparams = _value(dy0), _value(dparams)
    if not _zero(dts):
        dy0 = dy0 - _rate(flow, ts[..., 0], y0, params) * dts[..., :1]
    direction = [x[..., None, :] for x in (dy0, dparams)]
    d_path, d_end = jvp_p.bind(*primals, *_residuals(solution), *direction, flow=flow, tolerances=tolerances)
    d_path, d_end, d_t_end = d_path[..., 0, :, :], d_end[..., 0, :], jnp.zeros_like(solution.t_end)
    if not _zero(dts):
        reached, done = jnp.isfinite(solution.path), solution.result == SUCCESSFUL
        places = jnp.where(reached, solution.path, y0[..., None, :])
        rates = _rate(flow, ts, places, params[..., None, :]) * dts[..., None]
        d_path = d_path + jnp.where(reached, rates, 0.0)
        d_end = d_end + jnp.where(done[..., None], rates[..., -1, :], 0.0)
        d_t_end = jnp.where(done, dts[..., -1], 0.0)
    counts = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs[3:]]
    return outs, [d_path, d_end, d_t_end, *counts]


def _add(one, other):
    return [a + b for a, b in zip(one, other, strict=True)]


def _linear_part(primitive, primals, tangents, count, settings):
    """The derivative of a primitive by its last `count` arguments, in which it is linear; None without any."""
    if all(map(_zero, tangents[-count:])):
        return None
    return primitive.bind(*primals[:-count], *map(_value, tangents[-count:]), **settings)


def _derivative_of_jvp(primals, tangents, **settings):
    outs = jvp_p.bind(*primals, **settings)
    total = _linear_part(jvp_p, primals, tangents, 2, settings)
    if not all(map(_zero, tangents[:3])):
        dy0, dparams = primals[_GIVEN:]

        def compose_jvp(*moving):
            ts, y0, params = (x[..., None, :] for x in moving)
            return _jvp_composed(ts, y0, params, dy0, dparams, **settings)

        more = list(jax.jvp(compose_jvp, primals[:3], tuple(map(_value, tangents[:3])))[1])
        total = more if total is None else _add(total, more)
    return outs, _fill_zeros(total, outs)


def _fill_zeros(total, outs):
    return [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs] if total is None else total


def _derivative_of_vjp(primals, tangents, **settings):
    outs = vjp_p.bind(*primals, **settings)
    total = _linear_part(vjp_p, primals, tangents, 2, settings)
    if not all(map(_zero, tangents[:3])):
        more = _vjp_variation(primals, tangents[:3], outs, settings)
        total = more if total is None else _add(total, more)
    return outs, _fill_zeros(total, outs)


def _vjp_variation(primals, tangents, outs, settings):
    """The change of `vjp` with ts, y0 and params, for each of its m cotangents."""
    dts, dy0, dparams = tangents
    (ts, y0, params), cts, total = primals[:3], primals[_GIVEN:], None
    dy0, dparams = _value(dy0), _value(dparams)
    if not _zero(dts):
        total = _vjp_variation_in_time(primals, dts, outs, settings)
        dy0 = dy0 - _rate(settings["flow"], ts[..., 0], y0, params) * dts[..., :1]
    given = [x[..., None, :] for x in (ts, y0, params)]
    direction = [x[..., None, :] for x in (dy0, dparams)]
    more = curvature_p.bind(*given, *cts, *direction, **settings)
    return list(more) if total is None else _add(total, more)


def _vjp_variation_in_time(primals, dts, outs, settings):
    """The change of `vjp` with the output times, but for the curvature along the start's −f₀ δt₀.

    Output i moves by f δtᵢ, so that its derivative by (y0, params) gains the part (∂f/∂y Dᵢ + ∂f/∂p) δtᵢ; and the start
    from which the others follow has the derivative −∂f₀ δt₀.
    """
    flow, (ts, y0, params), (path_ct, end_ct) = settings["flow"], primals[:3], primals[_GIVEN:]
    path, done = primals[3], primals[4] == SUCCESSFUL
    reached = jnp.isfinite(path)
    weights = jnp.where(reached[..., None, :, :], path_ct, 0.0)
    weights = weights.at[..., -1, :].add(jnp.where(done[..., None, None], end_ct, 0.0))

    def rates(places, numbers):
        return _rate(flow, ts[..., None, :], places, numbers[..., None, :]) * dts[..., None, :, None]

    def first_rate(y, numbers):
        return -_rate(flow, ts[..., None, 0], y, numbers) * dts[..., None, :1]

    def transpose_rate(function, place, cotangent, numbers_shape):
        place = jnp.broadcast_to(place, cotangent.shape)
        return jax.vjp(function, place, jnp.broadcast_to(params[..., None, :], numbers_shape))[1](cotangent)

    places = jnp.where(reached, path, y0[..., None, :])[..., None, :, :]
    moved_ct, params_ct = transpose_rate(rates, places, weights, (*weights.shape[:-2], flow.numbers))
    still = jnp.zeros_like(end_ct)
    y0_ct, more = vjp_p.bind(*primals[:_GIVEN], moved_ct, still, **settings)
    start = transpose_rate(first_rate, y0[..., None, :], outs[0], outs[1].shape)
    return _add([y0_ct, more + params_ct], start)


def _derivative_of_curvature(primals, tangents, **settings):
    outs = curvature_p.bind(*primals, **settings)
    given, cts, direction = primals[:3], primals[3:5], primals[5:]
    total = None
    parts = (
        (tangents[3:5], lambda moving: curvature_p.bind(*given, *moving, *direction, **settings)),
        (tangents[5:], lambda moving: curvature_p.bind(*given, *cts, *moving, **settings)),
        (tangents[:3], lambda moving: jax.jvp(
            lambda *given: _curvature_composed(*given, *cts, *direction, **settings), given, tuple(moving))[1]),
    )  # fmt: skip
    for moving, part in parts:
        if not all(map(_zero, moving)):
            more = part([_value(x) for x in moving])
            total = list(more) if total is None else _add(total, more)
    return outs, _fill_zeros(total, outs)


# ---- transposes: of what is linear -----------------------------------------------------------------------------------


def _sum_shared(cotangent, aval):
    """A cotangent with the batch axes of an argument that was shared: the sum over those that shared it."""
    axes = tuple(i for i, (a, b) in enumerate(zip(cotangent.shape, aval.shape, strict=True)) if a != b)
    return jnp.sum(cotangent, axis=axes, keepdims=True) if axes else cotangent


def _linear_cotangents(args, cotangents):
    """The cotangents of the arguments that are linear here, None for the others."""
    return [
        _sum_shared(c, x.aval) if ad.is_undefined_primal(x) else None for x, c in zip(args, cotangents, strict=True)
    ]


def _transpose_rule(primitive):
    def rule(cotangents, *args, **settings):
        found = primitive.bind(*args[:_GIVEN], *map(_value, cotangents), **settings)
        return [None] * _GIVEN + _linear_cotangents(args[_GIVEN:], found)

    return rule


def _curvature_transpose(cotangents, *args, **settings):
    moving, given, cts, direction = [_value(c) for c in cotangents], args[:3], args[3:5], args[5:]
    if any(map(ad.is_undefined_primal, direction)):
        found = curvature_p.bind(*given, *cts, *moving, **settings)
        return [None] * 5 + _linear_cotangents(direction, found)
    ts, *state = given
    state = tuple(
        jnp.broadcast_to(x, jnp.broadcast_shapes(x.shape, m.shape)) for x, m in zip(state, moving, strict=True)
    )
    moving = tuple(jnp.broadcast_to(m, x.shape) for m, x in zip(moving, state, strict=True))
    second = jax.jvp(lambda *state: _jvp_composed(ts, *state, *direction, **settings), state, moving)[1]
    return [None] * 3 + _linear_cotangents(cts, second) + [None] * 2


# ---- batches ---------------------------------------------------------------------------------------------------------


def _batch_rule(primitive):
    def rule(args, axes, **settings):
        given = [
            jnp.expand_dims(x, 0) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(args, axes, strict=True)
        ]
        outs = primitive.bind(*given, **settings)
        return outs, [0] * len(outs)

    return rule


def _batch_of_batches(primitive, outputs_after):
    """Directions, or cotangents, of one motion are followed together: `outputs_after` axes come after theirs."""

    def rule(args, axes, **settings):
        if any(axis is not None for axis in axes[:_GIVEN]):
            return _batch_rule(primitive)(args, axes, **settings)
        size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
        place, linear = args[1].ndim - 1, []  # the axis after those of the batch
        for x, axis in zip(args[_GIVEN:], axes[_GIVEN:], strict=True):
            if axis is None:
                x, axis = jnp.broadcast_to(x, (size, *x.shape)), 0
            x = jnp.moveaxis(x, axis, place)
            m = x.shape[place + 1]
            linear.append(x.reshape(*x.shape[:place], size * m, *x.shape[place + 2 :]))
        outs = primitive.bind(*args[:_GIVEN], *linear, **settings)
        places = [x.ndim - after - 1 for x, after in zip(outs, outputs_after, strict=True)]
        outs = [x.reshape(*x.shape[:k], size, m, *x.shape[k + 1 :]) for x, k in zip(outs, places, strict=True)]
        return outs, places

    return rule


# ---- registration ----------------------------------------------------------------------------------------------------


def _register_on_host(primitive, host, shapes) -> None:
    """A primitive that `host` computes from NumPy arrays, outside of `jit`."""
    primitive.multiple_results = True
    primitive.def_abstract_eval(shapes)

    def evaluate(*args, **settings):
        with jax.enable_x64(True):
            return jax.device_put([np.asarray(x) for x in host(*map(np.asarray, args), **settings)])

    primitive.def_impl(evaluate)


def _lowering_rule(form):
    """The rule by which a primitive is lowered for CPUs: as `form`, which calls code that lies in this process."""
    rule = mlir.lower_fun(form, multiple_results=True)

    def lower_form(context, *args, **settings):
        if context.module_context.lowering_parameters.for_export:
            raise ValueError(
                "jax.export cannot take a motion along that runs in a CPU's machine code, which lies in this process: "
                "give a solver of diffrax, as simulate(…, solver=diffrax.Dopri8(), throw=False), and set "
                "EQX_ON_ERROR=nan before Python starts; or export for CUDA alone."
            )
        return rule(context, *args, **settings)

    return lower_form


def _run_compiled(ts, y0, params, *, flow, tolerances, keep):
    """`run` of what XLA compiles: by the handler where that may be, else on the host."""
    settings = dict(flow=flow, tolerances=tolerances, keep=keep)
    shapes = _run_shapes(ts, y0, params, **settings)
    rows, batch = _rows((ts, y0, params), (1, 1, 1), shared=(0, 2), library=jnp)
    with jax.enable_x64(True):  # where the kernel is made, and whatever was set where this is lowered
        short = keep and has_sweep(flow, math.prod(batch))  # whose derivatives need no steps that are kept
        if not (short or (not keep and has_handler(flow, math.prod(batch)))):
            return call_host(functools.partial(_run_on_host, **settings), shapes, ts, y0, params)
        of_rows = [jax.ShapeDtypeStruct((len(rows[1]), *x.shape[len(batch) :]), x.dtype) for x in shapes]
        host = functools.partial(_run_again if keep else _continue_run, **settings)
        rounds = flow.kernel.rounds_of_sweep if keep else None
        return _restore_batch(run_by_handler(flow, tolerances, host, of_rows, *rows, rounds=rounds), batch)


def _compile_sweep(sweep_rows, run_on_host, shapes_of, inner, args, settings):
    """A derivative in what XLA compiles: by a handler where the motion was a short one, else on the host.

    `sweep_rows(*rows)` gives the results for rows of members, whether these are done, and what they need to live.
    """
    shapes, function = shapes_of(*args, **settings), functools.partial(run_on_host, **settings)
    (ts, y0, params, *_, a, b), batch = _rows(args, (1, 1, 1, 2, 0, 0, 0, *inner), shared=(0, 2), library=jnp)

    def call_handler(*args):
        *results, done, needed = sweep_rows(ts, y0, params, a, b)
        host = functools.partial(call_host, functools.partial(function, needed=needed), shapes)
        return cond_alike(done, lambda *_: tuple(_restore_batch(results, batch)), host, *args)

    with jax.enable_x64(True):  # where kernels are made, and whatever was set where this is lowered
        host = functools.partial(call_host, function, shapes)
        if not has_sweep(settings["flow"], math.prod(batch)):
            return host(*args)
        return cond_alike(jnp.all(args[6] < 0), call_handler, host, *args)  # there are no steps that were kept


def _jvp_compiled(*args, **settings):
    flow, tolerances = settings["flow"], settings["tolerances"]

    def sweep_rows(ts, y0, params, dy0, dparams):
        length = jnp.max(jnp.abs(jnp.concatenate([dy0, dparams], axis=2)), axis=2, keepdims=True)
        unit = jnp.where(length > 0, length, 1.0)
        end, path, excess, done, needed = sweep_by_handler(
            "jvp", flow, tolerances, ts, y0, params, dparams / unit, dy0 / unit
        )
        path = jnp.where((ts == ts[:, :1])[:, None, :, None], dy0[:, :, None] / unit[..., None], path)
        path = path.at[:, :, -1].set(end)
        done &= jnp.all(excess <= tolerances.largest_excess)
        return path * unit[..., None], end * unit, done, needed

    return _compile_sweep(sweep_rows, _jvp_on_host, _jvp_shapes, (2, 2), args, settings)


def _vjp_compiled(*args, **settings):
    """`vjp` of what XLA compiles, of one cotangent."""
    flow, tolerances = settings["flow"], settings["tolerances"]

    def sweep_rows(ts, y0, params, path_ct, end_ct):
        path_ct, end_ct = path_ct[:, 0], end_ct[:, 0]
        y_ct, params_ct, excess, done, needed = sweep_by_handler(
            "vjp", flow, tolerances, ts, y0, params, path_ct, end_ct + path_ct[:, -1]
        )
        at_start = (ts == ts[:, :1])[:, :-1, None]  # outputs that are the initial state; steps begin after them
        y_ct = y_ct + jnp.sum(path_ct[:, :-1] * at_start, axis=1)
        done &= jnp.all(excess <= tolerances.largest_excess)
        return y_ct[:, None], params_ct[:, None], done, needed

    if args[-1].shape[-2] != 1:
        return call_host(functools.partial(_vjp_on_host, **settings), _vjp_shapes(*args, **settings), *args)
    return _compile_sweep(sweep_rows, _vjp_on_host, _vjp_shapes, (3, 2), args, settings)


# ---- on a GPU --------------------------------------------------------------------------------------------------------


def _run_for_gpus(ts, y0, params, *, flow, tolerances, **_):
    rows, batch = _rows((ts, y0, params), (1, 1, 1), shared=(0, 2), library=jnp)
    with jax.enable_x64(True):  # whatever was set where this is lowered
        return _restore_batch(run_on_gpu(flow, adapt_tolerances(flow, tolerances), *rows), batch)


def _jvp_for_gpus(ts, y0, params, *given, flow, tolerances):
    """`jvp`: a member of the tangent flow for each direction, NaN where that was not followed to its end."""
    with jax.enable_x64(True):
        ts, y0, params = (x[..., None, :] for x in (ts, y0, params))
        inputs, length = _tangent_inputs(flow, ts, y0, params, *given[-2:])
        larger = flow.tangent(1)
        solution = _run(*inputs, flow=larger, tolerances=tolerances.with_larger_budget, keep=False)
        path, end = (to_rows(y, flow.size)[..., 1, :] for y in (solution.path, solution.y_end))
        done = (solution.result == SUCCESSFUL)[..., None]
        return [path * length[..., None], jnp.where(done, end * length, jnp.nan)]


def _vjp_for_gpus(*args, flow, tolerances):
    """`vjp`: back over the steps of the motion; of constraints, and where the steps do not do, by tangents."""
    settings = dict(flow=flow, tolerances=adapt_tolerances(flow, tolerances))
    with jax.enable_x64(True):
        rows, batch = _rows(args, (1, 1, 1, 2, 0, 0, 0, 3, 2), shared=(0, 2), library=jnp)
        ts, y0, params, path, result, *_, path_ct, end_ct = rows
        members, m = end_ct.shape[:2]
        few = m <= flow.states + flow.numbers and flow.projection is None
        reached_ct, lost = _derivatives.mask_cotangents(path, result, path_ct, end_ct, library=jnp)
        swept = few and _sweep_on_gpu(ts, y0, params, reached_ct, result, end_ct, **settings)
        if not swept:
            return _vjp_by_tangents(*args, **settings)
        *found, done = (x.reshape(members, m, *x.shape[1:]) for x in swept)
        done = (done | lost).all(axis=1)

        def replace_unfinished(*found):
            times = jnp.where(done[:, None], ts[:, :1], ts)  # members that are done stay where they are
            others = _vjp_by_tangents(times, y0, params, *rows[3:], **settings)
            return tuple(jnp.where(done[:, None, None], a, b) for a, b in zip(found, others, strict=True))

        found = cond_alike(jnp.all(done), lambda *found: found, replace_unfinished, *found)
        return _restore_batch([jnp.where(lost[..., None], jnp.nan, x) for x in found], batch)


def _sweep_on_gpu(ts, y0, params, path_ct, result, end_ct, *, flow, tolerances):
    """The cotangents of starts and parameters, a row for each of m cotangents of a member, and whether a row is right.

    None where the GPU cannot compute them.
    """
    members, m = end_ct.shape[:2]
    ts, params = (x if len(x) == 1 else jnp.repeat(x, m, axis=0) for x in (ts, params))
    end_ct = end_ct + jnp.where((result == SUCCESSFUL)[:, None, None], path_ct[:, :, -1], 0.0)
    path_ct = path_ct.reshape(members * m, *path_ct.shape[2:])
    given = ts, jnp.repeat(y0, m, axis=0), params, path_ct, end_ct.reshape(members * m, -1)
    if (swept := transpose_on_gpu(flow, tolerances, *given)) is None:
        return None
    y_ct, params_ct, excess, done = swept
    at_start = (ts == ts[:, :1])[:, :-1, None]  # outputs that are the initial state; steps begin after them
    y_ct = y_ct + jnp.sum(path_ct[:, :-1] * at_start, axis=1)
    return y_ct, params_ct, done & (excess <= tolerances.largest_excess)


def _vjp_by_tangents(ts, y0, params, *given, flow, tolerances):
    """`vjp`: the derivative along every number of the start and the parameters, times the cotangents."""
    *run, path_ct, end_ct = given
    batch = _batch_of((ts, y0, params), (1, 1, 1))
    basis = jnp.broadcast_to(jnp.eye(count := flow.states + flow.numbers), (*batch, count, count))
    along = basis[..., : flow.states], basis[..., flow.states :]
    path, end = _jvp_for_gpus(ts, y0, params, *run, *along, flow=flow, tolerances=tolerances)

    def weigh(cotangent, values):  # values without a cotangent do not matter, even where they are not finite
        return jnp.where(cotangent != 0, cotangent * values, 0.0)

    total = jnp.sum(weigh(path_ct[..., :, None, :, :], path[..., None, :, :, :]), axis=(-1, -2))
    total += jnp.sum(weigh(end_ct[..., :, None, :], end[..., None, :, :]), axis=-1)
    return [total[..., : flow.states], total[..., flow.states :]]


_register_on_host(run_p, _run_on_host, _run_shapes)
_register_on_host(jvp_p, _jvp_on_host, _jvp_shapes)
_register_on_host(vjp_p, _vjp_on_host, _vjp_shapes)
for _primitive, _compiled_form in ((run_p, _run_compiled), (jvp_p, _jvp_compiled), (vjp_p, _vjp_compiled)):
    mlir.register_lowering(_primitive, _lowering_rule(_compiled_form), platform="cpu")
curvature_p.multiple_results = True
curvature_p.def_abstract_eval(_curvature_shapes)
curvature_p.def_impl(lambda *args, **settings: compile_once(_curvature_composed, **settings)(*args))
for _platform in ("cpu", "cuda"):
    _rule = mlir.lower_fun(_curvature_composed, multiple_results=True)
    mlir.register_lowering(curvature_p, _rule, platform=_platform)
for _primitive, _form in ((run_p, _run_for_gpus), (jvp_p, _jvp_for_gpus), (vjp_p, _vjp_for_gpus)):
    mlir.register_lowering(_primitive, mlir.lower_fun(_form, multiple_results=True), platform="cuda")

for _primitive, _jvp, _transpose, _batching in (
    (run_p, _derivative_of_run, None, _batch_rule(run_p)),
    (jvp_p, _derivative_of_jvp, _transpose_rule(vjp_p), _batch_of_batches(jvp_p, (2, 1))),
    (vjp_p, _derivative_of_vjp, _transpose_rule(jvp_p), _batch_of_batches(vjp_p, (1, 1))),
    (curvature_p, _derivative_of_curvature, _curvature_transpose, _batch_rule(curvature_p)),
):
    ad.primitive_jvps[_primitive] = _jvp
    if _transpose is not None:
        ad.primitive_transposes[_primitive] = _transpose
    batching.primitive_batchers[_primitive] = _batching
