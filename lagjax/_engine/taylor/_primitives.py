"""Flows as functions of JAX: four primitives with their derivatives, batching and lowering.

With F the map (ts, y0, params) → (path, y_end) of a flow and D its derivative by (y0, params) at fixed times,

    run         F
    jvp        D v            linear in v = (δy0, δparams)              transposed: vjp
    vjp        Dᵀ w           linear in w = (w_path, w_end)             transposed: jvp
    curvature   (∂/∂x wᵀ D) d  linear in w and in d, symmetric in d      transposed in d: itself

and their derivatives are expressed by these, so that there are derivatives of every order in every mode:

    d run  = jvp(v − f₀ δt₀) + f δt                  f the rate (q̇, q̈) of the state, f₀ at the start
    d jvp = jvp(dv) + D² F [v, dx]                  by the run of the tangent flow
    d vjp = vjp(dw) + curvature(w, dx) + …          by the vjp of the tangent flow, and terms of varied times

To move an output time by δt moves the output by f δt; to start later from the same state is to start from another one.
Source: Griewank & Walther, *Evaluating Derivatives* (2008), §§3–5, for forward, reverse, and forward over reverse.

Every primitive takes arrays with any number of batch axes first, equally many in each, of length one if an argument is
shared; under `jax.vmap` it is still one call of machine code. Outside of `jit` nothing else is compiled.
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
from lagjax._engine.taylor._call import (
    begins_in_handler,
    derivative_by_handler,
    derivatives_begin_in_handler,
    run_by_handler,
)
from lagjax._engine.taylor._derivatives import Motions
from lagjax._engine.taylor._flow import Flow, Tolerances
from lagjax._engine.taylor._gpu_launch import run_on_gpu, transpose_on_gpu
from lagjax._engine.taylor._line_functions import program_outputs
from lagjax._engine.taylor._passages import has_passages
from lagjax._engine.taylor._state_rates import rate
from lagjax._engine.taylor._variational import from_rows, to_rows
from lagjax._interface import SUCCESSFUL, default_platform
from lagjax._native import Projection, RunResults
from lagjax._primitives import NOT_EXPORTED, LinearMap, call_host, compute_on_host, cond_alike, cotangent_of, is_zero
from lagjax._program import Unlowerable
from lagjax._tracing import Program


def run(flow: Flow, tolerances: Tolerances, ts, y0, params) -> Solution:
    """The motion of one member, under every transformation of JAX; `ts` (T,), `y0` (2n,), `params` (P,).

    A flow with guards has no derivatives, since these would include those of its end time.
    """
    if default_platform() == "cpu":  # outside of `jit` the host computes, and nothing is compiled for a new scene
        return _bind_run(ts, y0, params, flow=flow, tolerances=tolerances)
    return compile_once(_bind_run, flow=flow, tolerances=tolerances)(ts, y0, params)


@functools.lru_cache(maxsize=64)
def compile_once(function, *first, **settings):
    """A JIT-compiled function of arrays, with the arguments `first` fixed, for what the host does not compute alone.

    A derivative outside of `jit` is then compiled as one program, and not operation by operation.
    """
    return jax.jit(functools.partial(function, *first, **settings))


# ---- on the host: NumPy arrays with any batch axes in front ----------------------------------------------------------


# Axes of the arguments of a run, those of a batch left out; `_derivatives.Motions` are these, then its results.
_RUN, _MOTIONS = (1, 1, 1), (1, 1, 1, 2, 0, 0, 0)
_GIVEN = len(_MOTIONS)


def _member_rows(arrays, inner, library: Any = np):
    """Each array with one row per member (or one shared row, of `ts` and `params`), and the batch axes."""
    batch = _split_batch(arrays, inner)

    def rows(place, x, k):
        own = x.shape[x.ndim - k :]
        if place in (0, 2) and x.size == math.prod(own):
            return x.reshape(1, *own)
        return library.broadcast_to(x, batch + own).reshape(math.prod(batch), *own)

    return [rows(place, x, k) for place, (x, k) in enumerate(zip(arrays, inner, strict=True))], batch


def _split_batch(arrays, inner):
    return np.broadcast_shapes(*(x.shape[: x.ndim - k] for x, k in zip(arrays, inner, strict=True)))


def _restore_batch(results, batch):
    return [x.reshape(batch + x.shape[1:]) for x in results]


def _run_on_host(ts, y0, params, *, flow, tolerances):
    rows, batch = _member_rows((ts, y0, params), _RUN)
    return _restore_batch(flow.run(*rows, tolerances)[:_OUTPUTS], batch)


def _derive_on_host(name, inner, *args, flow, tolerances, **_):
    """Call `_derivatives.jvp` or `vjp`; its last arguments have these `inner` axes."""
    rows, batch = _member_rows(args, (*_MOTIONS, *inner))
    derive = getattr(_derivatives, name)
    return _restore_batch(derive(flow, Motions(*rows[:_GIVEN]), *rows[_GIVEN:], tolerances), batch)


_jvp_on_host = functools.partial(_derive_on_host, "jvp", (2, 2))
_vjp_on_host = functools.partial(_derive_on_host, "vjp", (3, 2))


# ---- primitives ------------------------------------------------------------------------------------------------------

_OUTPUTS = len(Solution._fields) - 1  # of run: a `Solution` but for the last field, which is that of a batch


def _bind_run(ts, y0, params, **settings) -> Solution:
    return Solution(*run_p.bind(ts, y0, params, **settings))


def _float_shapes(*shapes):
    return [ShapedArray(shape, np.dtype(float)) for shape in shapes]


def _run_shapes(ts, y0, params, *, flow, tolerances, **_):
    batch = _split_batch((ts, y0, params), _RUN)
    shapes = *[batch] * 3, (*batch, flow.kernel.ending_guards)
    counts = [ShapedArray(shape, np.dtype(int)) for shape in shapes]
    floats = _float_shapes((*batch, *flow.path_shape(ts.shape[-1], tolerances.notes)), (*batch, flow.states), batch)
    return [*floats, *counts]


def _jvp_shapes(*args, flow, **_):
    batch, m = _split_batch((*args[:3], *args[_GIVEN:]), (*_RUN, 2, 2)), args[_GIVEN].shape[-2]
    return _float_shapes((*batch, m, args[0].shape[-1], flow.states), (*batch, m, flow.states))


def _vjp_shapes(*args, flow, **_):
    batch, m = _split_batch(args, (*_MOTIONS, 3, 2)), args[-1].shape[-2]
    return _float_shapes((*batch, m, flow.states), (*batch, m, flow.numbers))


def _curvature_shapes(*args, flow, **_):
    batch = _split_batch(args, (*_RUN, 2, 1, 1, 1))
    return _float_shapes((*batch, flow.states), (*batch, flow.numbers))


def _curvature_composed(ts, y0, params, path_ct, end_ct, dy0, dparams, *, flow, tolerances):
    """`curvature` by the vjp of the tangent flow, with cotangents of the tangents only."""
    larger, tolerances = flow.tangent(1), tolerances.with_larger_budget
    given, length = _tangent_inputs(flow, ts, y0, params, dy0, dparams)
    solution = _bind_run(*given, flow=larger, tolerances=tolerances)
    path_ct, end_ct = (from_rows(jnp.stack([jnp.zeros_like(ct), ct], axis=-2)) for ct in (path_ct, end_ct))
    cts = path_ct[..., None, :, :], end_ct[..., None, :]
    state_ct, numbers_ct = vjp_p.bind(*_constant_motions(*given, solution), *cts, flow=larger, tolerances=tolerances)
    state_ct, numbers_ct = to_rows(state_ct[..., 0, :], flow.size)[..., 0, :], numbers_ct[..., 0, : flow.numbers]
    return [state_ct * length, numbers_ct * length]


def _jvp_composed(ts, y0, params, dy0, dparams, *, flow, tolerances):
    """`jvp` along one direction, (…, 2n) and (…, P), by a run of the tangent flow; and the result code of that."""
    given, length = _tangent_inputs(flow, ts, y0, params, dy0, dparams)
    solution = _bind_run(*given, flow=flow.tangent(1), tolerances=tolerances.with_larger_budget)
    path, end = (to_rows(y, flow.size)[..., 1, :] for y in (solution.path, solution.y_end))
    return path * length[..., None], end * length, solution.result


def _tangent_inputs(flow: Flow, ts, y0, params, dy0, dparams):
    """The inputs of the tangent flow for a direction scaled to length one, and the length."""
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
    """The tangent of the projected start, at which a constrained motion begins (see `_derivatives`)."""

    def differentiate_start(t, y, p, dy, dp):
        def start(y, p):
            return program_outputs(
                cast(Program, cast(Projection, flow.projection).state), flow.states, jnp.append(y, t), p
            )

        return jax.jvp(start, (y, p), (dy, dp))[1]

    return jnp.vectorize(differentiate_start, signature="(),(s),(p),(s),(p)->(s)")(t, y0, params, dy0, dparams)


def _state_rate(flow: Flow, *state):
    """`rate` at a state (t, y, params), compiled as one program."""
    return compile_once(rate, flow)(*state)


def _constant_motions(ts, y0, params, solution: Solution) -> Motions:
    """The motion arguments of `jvp` and `vjp` from a run and its outcome, without derivatives of the outcome."""
    return Motions.from_solution(ts, y0, params, jax.tree.map(jax.lax.stop_gradient, solution))


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _vary_run(primals, tangents, outs, *, flow, tolerances):
    (ts, y0, params), (dts, dy0, dparams), solution = primals, tangents, Solution(*outs)
    if flow.guards is not None:
        return [None] * len(outs)
    dy0, dparams = map(ad.instantiate_zeros, (dy0, dparams))
    if not is_zero(dts):
        dy0 = dy0 - _state_rate(flow, ts[..., 0], y0, params) * dts[..., :1]
    direction = [x[..., None, :] for x in (dy0, dparams)]
    motions = _constant_motions(ts, y0, params, solution)
    d_path, d_end = jvp_p.bind(*motions, *direction, flow=flow, tolerances=tolerances)
    d_path, d_end, d_t_end = d_path[..., 0, :, :], d_end[..., 0, :], jnp.zeros_like(solution.t_end)
    if not is_zero(dts):
        reached, done = jnp.isfinite(solution.path), solution.result == SUCCESSFUL
        places = jnp.where(reached, solution.path, y0[..., None, :])
        rates = _state_rate(flow, ts, places, params[..., None, :]) * dts[..., None]
        d_path = d_path + jnp.where(reached, rates, 0.0)
        d_end = d_end + jnp.where(done[..., None], rates[..., -1, :], 0.0)
        d_t_end = jnp.where(done, dts[..., -1], 0.0)
    return [d_path, d_end, d_t_end, *[None] * (len(outs) - 3)]


def _vary_jvp(primals, tangents, _, **settings):
    """The tangent of `jvp` due to ts, y0 and params."""
    dy0, dparams = primals[_GIVEN:]

    def compose_jvp(*moving):
        ts, y0, params = (x[..., None, :] for x in moving)
        return _jvp_composed(ts, y0, params, dy0, dparams, **settings)[:2]

    return jax.jvp(compose_jvp, primals[:3], tuple(map(ad.instantiate_zeros, tangents[:3])))[1]


def _vary_vjp(primals, tangents, outs, **settings):
    """The tangent of `vjp` due to ts, y0 and params, for each of its m cotangents."""
    (ts, y0, params), cts, dts = primals[:3], primals[_GIVEN:], tangents[0]
    dy0, dparams = map(ad.instantiate_zeros, tangents[1:3])
    total = None
    if not is_zero(dts):
        total = _vjp_variation_in_time(primals, dts, outs, settings)
        dy0 = dy0 - _state_rate(settings["flow"], ts[..., 0], y0, params) * dts[..., :1]
    given = [x[..., None, :] for x in (ts, y0, params)]
    direction = [x[..., None, :] for x in (dy0, dparams)]
    more = curvature_p.bind(*given, *cts, *direction, **settings)
    return more if total is None else [a + b for a, b in zip(total, more, strict=True)]


def _vjp_variation_in_time(primals, dts, outs, settings):
    """The tangent of `vjp` due to the output times, except the curvature along the start's −f₀ δt₀.

    Output i moves by f δtᵢ, so that its derivative by (y0, params) gains the part (∂f/∂y Dᵢ + ∂f/∂p) δtᵢ; and the start
    of the motion has the derivative −∂f₀ δt₀.
    """
    flow, (ts, y0, params), (path_ct, end_ct) = settings["flow"], primals[:3], primals[_GIVEN:]
    path, done = primals[3], primals[4] == SUCCESSFUL
    reached = jnp.isfinite(path)
    weights = jnp.where(reached[..., None, :, :], path_ct, 0.0)
    weights = weights.at[..., -1, :].add(jnp.where(done[..., None, None], end_ct, 0.0))

    def rates(places, numbers):
        return _state_rate(flow, ts[..., None, :], places, numbers[..., None, :]) * dts[..., None, :, None]

    def first_rate(y, numbers):
        return -_state_rate(flow, ts[..., None, 0], y, numbers) * dts[..., None, :1]

    def transpose_rate(function, place, cotangent, numbers_shape):
        place = jnp.broadcast_to(place, cotangent.shape)
        return jax.vjp(function, place, jnp.broadcast_to(params[..., None, :], numbers_shape))[1](cotangent)

    places = jnp.where(reached, path, y0[..., None, :])[..., None, :, :]
    moved_ct, params_ct = transpose_rate(rates, places, weights, (*weights.shape[:-2], flow.numbers))
    still = jnp.zeros_like(end_ct)
    y0_ct, more = vjp_p.bind(*primals[:_GIVEN], moved_ct, still, **settings)
    start = transpose_rate(first_rate, y0[..., None, :], outs[0], outs[1].shape)
    return y0_ct + start[0], more + params_ct + start[1]


def _vary_curvature(primals, tangents, _, **settings):
    given, cts, direction = primals[:3], primals[3:5], primals[5:]
    parts = []
    if not all(map(is_zero, tangents[3:])):
        parts.append(curvature_p.bind(*given, *map(ad.instantiate_zeros, tangents[3:]), *direction, **settings))
    if not all(map(is_zero, tangents[:3])):
        composed = lambda *given: _curvature_composed(*given, *cts, *direction, **settings)  # noqa: E731
        parts.append(jax.jvp(composed, given, tuple(map(ad.instantiate_zeros, tangents[:3])))[1])
    return [sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True)]


def _curvature_transpose(cotangents, *args, **settings):
    """The transpose of `curvature`, which is linear in its cotangents: the second derivative along two directions."""
    moving, given, cts, direction = map(ad.instantiate_zeros, cotangents), args[:3], args[3:5], args[5:]
    if any(map(ad.is_undefined_primal, direction)):
        second = curvature_p.bind(*given, *cts, *moving, **settings)
        return [None] * 5 + list(map(cotangent_of, direction, second))
    ts, *state = given
    state, moving = zip(*(jnp.broadcast_arrays(x, m) for x, m in zip(state, moving, strict=True)), strict=True)
    second = jax.jvp(lambda *state: _jvp_composed(ts, *state, *direction, **settings)[:2], state, moving)[1]
    return [None] * 3 + list(map(cotangent_of, cts, second)) + [None] * 2


# ---- batches ---------------------------------------------------------------------------------------------------------


def _batch_rule(primitive):
    def rule(args, axes, **settings):
        given = zip(args, axes, strict=True)
        given = [x if axis == 0 else x[None] if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in given]
        outs = primitive.bind(*given, **settings)
        return outs, [0] * len(outs)

    return rule


def _batch_of_batches(primitive, outputs_after):
    """The batching rule of directions or cotangents: those of one motion stay one call; results have the axis later."""

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


# ---- primitives ------------------------------------------------------------------------------------------------------

run_p = LinearMap("lagjax_run", _run_shapes, _vary_run)
jvp_p = LinearMap("lagjax_jvp", _jvp_shapes, _vary_jvp, 2, lambda given, w, _, **of: vjp_p.bind(*given, *w, **of))
vjp_p = LinearMap("lagjax_vjp", _vjp_shapes, _vary_vjp, 2, lambda given, w, _, **of: jvp_p.bind(*given, *w, **of))
curvature_p = LinearMap("lagjax_curvature", _curvature_shapes, _vary_curvature, 2)
ad.primitive_transposes[curvature_p] = _curvature_transpose
for _primitive, _batching in (
    (run_p, _batch_rule(run_p)),
    (jvp_p, _batch_of_batches(jvp_p, (2, 1))),
    (vjp_p, _batch_of_batches(vjp_p, (1, 1))),
    (curvature_p, _batch_rule(curvature_p)),
):
    batching.primitive_batchers[_primitive] = _batching


# ---- outside of `jit`, and on CPUs -----------------------------------------------------------------------------------


def _lowering_rule(form):
    """The lowering of a primitive for CPUs as `form`, which calls code at an address in this process."""
    rule = mlir.lower_fun(form, multiple_results=True)

    def lower_form(context, *args, **settings):
        if context.module_context.lowering_parameters.for_export:
            here = "a motion in a CPU's machine code, which lies in this process,"
            raise ValueError(f"{NOT_EXPORTED.format(here)} Or export for CUDA alone.")
        return rule(context, *args, **settings)

    return lower_form


def _run_compiled(ts, y0, params, *, flow, tolerances):
    """`run` in XLA programs: by the handler if possible, else on the host."""
    settings = dict(flow=flow, tolerances=tolerances)
    shapes = _run_shapes(ts, y0, params, **settings)
    rows, batch = _member_rows((ts, y0, params), _RUN, library=jnp)
    with jax.enable_x64(True):  # where the kernel is made, and whatever was set where this is lowered
        if not begins_in_handler(flow, math.prod(batch)):
            return call_host(functools.partial(_run_on_host, **settings), shapes, ts, y0, params)
        of_rows = [jax.ShapeDtypeStruct((len(rows[1]), *x.shape[len(batch) :]), x.dtype) for x in shapes]

        def finish_run(ts, y0, params, *begun):
            """The outputs of a run that Python completes from `begun`."""
            return flow.run(ts, y0, params, tolerances, RunResults(*begun))[:_OUTPUTS]

        return _restore_batch(run_by_handler(flow, tolerances, finish_run, of_rows, *rows), batch)


def _compile_derivative(run_handler, run_on_host, shapes_of, inner, args, settings, copies: int = 1):
    """A derivative in XLA programs: by a handler if the motion is short, else on the host.

    `run_handler(*rows)` gives the results for rows of members, each repeated in `copies`, the sizes of their last terms
    (`Kernel.jvp`), a flag that they are done, and objects that must stay alive.
    """
    shapes, function = shapes_of(*args, **settings), functools.partial(run_on_host, **settings)
    (ts, y0, params, _, _, *counts, a, b), batch = _member_rows(args, (*_MOTIONS, *inner), library=jnp)
    flow, members = settings["flow"], copies * math.prod(batch)

    def call_handler(*args):
        *results, excess, done, needed = run_handler(ts, y0, params, a, b)
        host = functools.partial(call_host, functools.partial(function, needed=needed), shapes)
        well = done & jnp.all(excess <= settings["tolerances"].largest_excess)
        return cond_alike(well, lambda *_: tuple(_restore_batch(results, batch)), host, *args)

    with jax.enable_x64(True):  # where kernels are made, and whatever was set where this is lowered
        host = functools.partial(call_host, function, shapes)
        if not derivatives_begin_in_handler(flow, members):
            return host(*args)
        kernel = flow.kernel.select_width(members)
        is_short = copies * jnp.sum(sum(counts)) <= kernel.rounds_of_rerun * kernel.width
        return cond_alike(is_short, call_handler, host, *args)


def _jvp_compiled(*args, **settings):
    def run_handler(ts, y0, params, dy0, dparams):
        dy0, dparams, unit = _derivatives.scale_directions(dy0, dparams, library=jnp)
        end, path, *more = derivative_by_handler("jvp", **settings, rows=(ts, y0, params, dparams, dy0))
        path = _derivatives.start_outputs(ts, dy0, path, library=jnp).at[:, :, -1].set(end)
        return path * unit[..., None], end * unit, *more

    return _compile_derivative(run_handler, _jvp_on_host, _jvp_shapes, (2, 2), args, settings)


def _vjp_compiled(*args, **settings):
    """`vjp` in XLA programs: a member with several cotangents is copied, one for each."""
    copies = args[-1].shape[-2]

    def run_handler(ts, y0, params, path_ct, end_ct):
        ts, params = (jnp.repeat(x, copies, axis=0) if len(x) > 1 else x for x in (ts, params))
        y0 = jnp.repeat(y0, copies, axis=0)
        path_ct, end_ct = (x.reshape(len(y0), *x.shape[2:]) for x in (path_ct, end_ct))

        def go_back(path_ct, end_ct):
            return derivative_by_handler("vjp", **settings, rows=(ts, y0, params, path_ct, end_ct))

        *found, excess, done, needed = _derivatives.transpose_outputs(go_back, ts, path_ct, end_ct, library=jnp)
        return *(x.reshape(x.shape[0] // copies, copies, x.shape[-1]) for x in found), excess, done, needed

    if settings["flow"].turns:
        return call_host(functools.partial(_vjp_on_host, **settings), _vjp_shapes(*args, **settings), *args)
    return _compile_derivative(run_handler, _vjp_on_host, _vjp_shapes, (3, 2), args, settings, copies)


# ---- on a GPU --------------------------------------------------------------------------------------------------------


def _run_for_gpus(ts, y0, params, *, flow, tolerances, **_):
    rows, batch = _member_rows((ts, y0, params), _RUN, library=jnp)
    with jax.enable_x64(True):  # whatever was set where this is lowered
        return _restore_batch(run_on_gpu(flow, tolerances, *rows), batch)


def _jvp_for_gpus(ts, y0, params, *given, flow, tolerances):
    """`jvp` on GPUs: a member of the tangent flow for each direction, NaN if that failed."""
    with jax.enable_x64(True):
        ts, y0, params = (x[..., None, :] for x in (ts, y0, params))
        path, end, result = _jvp_composed(ts, y0, params, *given[-2:], flow=flow, tolerances=tolerances)
        return [path, jnp.where((result == SUCCESSFUL)[..., None], end, jnp.nan)]


def _vjp_for_gpus(*args, flow, tolerances):
    """`vjp` on GPUs over recorded steps; by tangents with constraints, or if there is no record."""
    settings = dict(flow=flow, tolerances=tolerances)
    with jax.enable_x64(True):
        rows, batch = _member_rows(args, (*_MOTIONS, 3, 2), library=jnp)
        motions, (path_ct, end_ct) = Motions(*rows[:_GIVEN]), rows[_GIVEN:]
        ts, (members, m) = motions.ts, end_ct.shape[:2]
        few = m <= flow.states + flow.numbers and flow.projection is None
        reached_ct, lost = _derivatives.mask_cotangents(motions, path_ct, end_ct, library=jnp)
        results = few and _go_back_on_gpu(motions, reached_ct, end_ct, **settings)
        if not results:
            return _vjp_by_tangents(*args, **settings)
        *results, done = (x.reshape(members, m, *x.shape[1:]) for x in results)
        done = (done | lost).all(axis=1)

        def replace_unfinished(*results):
            times = jnp.where(done[:, None], ts[:, :1], ts)  # members that are done stay where they are
            others = _vjp_by_tangents(times, *rows[1:], **settings)
            return tuple(jnp.where(done[:, None, None], a, b) for a, b in zip(results, others, strict=True))

        results = cond_alike(jnp.all(done), lambda *results: results, replace_unfinished, *results)
        return _restore_batch([jnp.where(lost[..., None], jnp.nan, x) for x in results], batch)


def _go_back_on_gpu(motions: Motions, path_ct, end_ct, *, flow, tolerances):
    """The cotangents of starts and parameters, one row per cotangent of a member, and a flag that a row is right.

    None if the GPU cannot compute them.
    """
    if has_passages(flow.kernel):
        return None
    members, m = end_ct.shape[:2]
    ts, y0, params, *_ = motions.select_members(np.repeat(np.arange(members), m))
    path_ct, end_ct = (x.reshape(members * m, *x.shape[2:]) for x in (path_ct, end_ct))
    go_back = functools.partial(transpose_on_gpu, flow, tolerances, ts, y0, params)
    try:
        y_ct, params_ct, excess, done = _derivatives.transpose_outputs(go_back, ts, path_ct, end_ct, library=jnp)
    except Unlowerable:
        return None
    return y_ct, params_ct, done & (excess <= tolerances.largest_excess)


def _vjp_by_tangents(ts, y0, params, *given, flow, tolerances):
    """`vjp` by the derivative along every number of the start and the parameters, times the cotangents."""
    *run, path_ct, end_ct = given
    batch = _split_batch((ts, y0, params), _RUN)
    basis = jnp.broadcast_to(jnp.eye(count := flow.states + flow.numbers), (*batch, count, count))
    along = basis[..., : flow.states], basis[..., flow.states :]
    path, end = _jvp_for_gpus(ts, y0, params, *run, *along, flow=flow, tolerances=tolerances)

    def weigh(cotangent, values):  # values without a cotangent do not matter, even where they are not finite
        return jnp.where(cotangent != 0, cotangent * values, 0.0)

    total = jnp.sum(weigh(path_ct[..., :, None, :, :], path[..., None, :, :, :]), axis=(-1, -2))
    total += jnp.sum(weigh(end_ct[..., :, None, :], end[..., None, :, :]), axis=-1)
    return [total[..., : flow.states], total[..., flow.states :]]


for _primitive, _host, _on_cpus, _on_gpus in (
    (run_p, _run_on_host, _run_compiled, _run_for_gpus),
    (jvp_p, _jvp_on_host, _jvp_compiled, _jvp_for_gpus),
    (vjp_p, _vjp_on_host, _vjp_compiled, _vjp_for_gpus),
):
    compute_on_host(_primitive, _host)
    mlir.register_lowering(_primitive, _lowering_rule(_on_cpus), platform="cpu")
    mlir.register_lowering(_primitive, mlir.lower_fun(_on_gpus, multiple_results=True), platform="cuda")
curvature_p.composed = _curvature_composed
curvature_p.def_impl(lambda *args, **settings: compile_once(_curvature_composed, **settings)(*args))
for _platform in ("cpu", "cuda"):
    _rule = mlir.lower_fun(_curvature_composed, multiple_results=True)
    mlir.register_lowering(curvature_p, _rule, platform=_platform)
