"""One integration by diffrax, and its reverse-mode derivative.

The motion is integrated with adaptive steps in a plain loop that keeps nothing. Its derivative is that of the same
method taken over the *same steps*: for a gradient the times of the accepted steps are recorded, and the backward pass
differentiates a second integration with those times. It makes no decisions, so that recomputing a part of it
(checkpointing) cannot decide otherwise, and it has no rejected steps. As everywhere in diffrax, the sizes of steps are
not differentiated.

Differentiating the adaptive loop itself by recomputation is not safe: recomputed steps are compiled apart from the
first ones, differ from them in the last digit, and then accept or reject otherwise, which gives wrong gradients without
a word. This is the only module that calls diffrax's integrator.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import PyTree

from lagjax._engine._problem import Solution
from lagjax._engine.diffrax._equations import MotionEquations
from lagjax._engine.diffrax._jumps import AdaptiveRecorder, AdaptiveWrapper, JumpRecorder, may_jump, stop_derivatives
from lagjax._engine.diffrax._solvers import Projected
from lagjax._interface import ENDED_WELL, RESULTS, SUCCESSFUL, code_of, halves
from lagjax._primitives import differentiable_where, vary_alike


class Stepping(eqx.Module):
    """The stepping of diffrax: its solver, its controller, the fixed size of steps (None if adaptive), their budget."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    dt0: jax.Array | None
    max_steps: int = eqx.field(static=True)
    progress: diffrax.AbstractProgressMeter
    jumps: "JumpTimes | None" = None  # where adaptive steps end and begin anew


class LiftedFunction(eqx.Module):
    """A function whose closed-over arrays became leaves, `constants`, of this pytree.

    `equinox.filter_closure_convert` insists on arguments that vary along the same axes of a mesh as the examples: under
    `jax.shard_map` a start that all members share does not, and a state on the way does.
    """

    constants: list
    jaxpr: Any = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def from_function(cls, function: Callable, *examples: PyTree) -> "LiftedFunction":
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
        return cls(closed.consts, closed.jaxpr, jax.tree.structure(shapes))

    def __call__(self, *arguments: PyTree) -> PyTree:
        results = core.jaxpr_as_fun(core.ClosedJaxpr(self.jaxpr, self.constants))(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(self.structure, results)


def integrate(form: MotionEquations, method: Stepping, adjoint, event, ts, y0, params: PyTree) -> Solution:
    """ẏ = f(t, y) from y0 = (q, q̇), (2n,), at ts[0] to ts[-1], or to the event. Outputs not reached are infinite.

    The state is one array: two of them take a solver twice as many operations of half the size.

    With `adjoint` None, and without an event, reverse mode goes over the recorded steps; otherwise derivatives are
    those of the diffrax adjoint. What f closes over (a parameter from outside, the weights of a neural Lagrangian)
    becomes an argument.
    """

    def vector_field(t, y, params):
        q, qdot = halves(y)
        return jnp.concatenate([qdot, form.acceleration(t, (q, qdot), params)[0]])

    def projected(t, y, params):
        return jnp.concatenate(form.projected(t, halves(y), params))

    leaves, structure = jax.tree.flatten((ts, y0, params))
    ts, y0, params = structure.unflatten(vary_alike(leaves))
    field = LiftedFunction.from_function(vector_field, ts[0], y0, params)
    project = LiftedFunction.from_function(projected, ts[0], y0, params) if form.constrained else None
    jumps = functools.partial(may_jump, form.motion)
    solution = _integrate_differentiably((field, project, ts, y0, params), method, jumps, adjoint, event)
    if project is not None:
        path = jax.lax.map(lambda at: project(*at, params), (ts, solution.path))
        solution = solution._replace(path=path)
    return solution


def _integrate_differentiably(moving, method: Stepping, jumps: Callable, adjoint, event) -> Solution:
    if adjoint is not None or event is not None:
        adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
        _, _, ts, y0, params = moving
        if isinstance(adjoint, diffrax.BacksolveAdjoint) or not jumps(ts[0], y0, params):
            return _call_diffrax(moving, method, adjoint, event)[0]
        # It is not known here by what this will be differentiated: parameters count as fixed.
        solution, _, crossed = _call_diffrax(moving, _record_jumps(moving, method, None), adjoint, event)
        y_end, path = (differentiable_where(~crossed, x) for x in (solution.y_end, solution.path))
        return solution._replace(path=path, y_end=y_end)
    # Tolerances and the smallest step follow from ts and the dtype; like all that sizes a step, they are data here.
    return _solve_and_record(moving, stop_derivatives(method), jumps)


def _record_jumps(moving, method: Stepping, varied) -> Stepping:
    """The stepping whose controller records if a step crosses a jump; `varied` as for `crosses_jump`."""
    field, _, _, _, params = moving
    varied = jax.tree.map(lambda _: False, (field, params)) if varied is None else varied
    adaptive = isinstance(method.controller, diffrax.AbstractAdaptiveStepSizeController)
    noting: Any = AdaptiveRecorder if adaptive else JumpRecorder
    return eqx.tree_at(lambda m: m.controller, method, noting(method.controller, field, varied))


def _call_diffrax(moving, method: Stepping, adjoint, event=None, *more: diffrax.SubSaveAt) -> tuple[Solution, Any, Any]:
    """diffrax's solution, the outputs of further `SubSaveAt`s, and a flag that a step crossed a jump (if recorded)."""
    field, project, ts, y0, params = moving
    solver = method.solver if project is None else Projected(method.solver, project)
    # Of the ends alone there is nothing to interpolate, and no test of `ts` by a call back to the host.
    outputs = diffrax.SubSaveAt(t0=True, t1=True) if len(ts) == 2 else diffrax.SubSaveAt(ts=ts)
    saved = [outputs, diffrax.SubSaveAt(t1=True), *more]
    notes = isinstance(method.controller, JumpRecorder)
    done: Any = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        _set_stage_loop(solver, adjoint),
        t0=ts[0],
        t1=ts[-1],
        dt0=method.dt0,
        y0=y0,
        args=params,
        saveat=diffrax.SaveAt(subs=saved, controller_state=notes),
        stepsize_controller=method.controller,
        adjoint=adjoint,
        event=event,
        max_steps=method.max_steps,
        throw=False,
        progress_meter=method.progress,
    )
    accepted, rejected = (done.stats[f"num_{kind}_steps"] for kind in ("accepted", "rejected"))
    result = jnp.asarray(_CODES)[done.result._value]
    crossed = done.controller_state[1] if notes else jnp.array(False)
    path, y_end, t_end = done.ys[0], done.ys[1][0], done.ts[1][0]
    if len(ts) == 2:  # infinite where it was not reached, as the others are
        path = jnp.stack([path[0], jnp.where(t_end == ts[-1], path[1], jnp.inf)])
    ended = None if event is None else jnp.stack(jax.tree.leaves(done.event_mask))
    return Solution(path, y_end, t_end, result, accepted, rejected, ended), done.ys[2:], crossed


# The code of each of diffrax's results. One that another version of diffrax adds has no name of ours.
_CODES = np.array([
    code_of(getattr(RESULTS, name, RESULTS.internal_error)) for name in diffrax.RESULTS._name_to_item
], np.int32)  # fmt: skip


def _set_stage_loop(solver, adjoint):
    """The solver with a loop over stages that the adjoint can differentiate; for wrapped solvers."""
    if isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    kinds = {diffrax.ForwardMode: "lax", diffrax.RecursiveCheckpointAdjoint: "checkpointed"}
    kind = kinds.get(type(adjoint), "bounded")

    def set_scan_kind(part):
        if not isinstance(part, diffrax.AbstractRungeKutta) or part.scan_kind is not None:
            return part
        return eqx.tree_at(lambda s: s.scan_kind, part, kind, is_leaf=lambda leaf: leaf is None)

    return jax.tree.map(set_scan_kind, solver, is_leaf=lambda part: isinstance(part, diffrax.AbstractRungeKutta))


@eqx.filter_custom_vjp
def _solve_and_record(moving, method, jumps):
    """The solution by the plain loop, `diffrax.ForwardMode`, which keeps nothing; reverse mode replays its steps."""
    return _call_diffrax(moving, method, diffrax.ForwardMode())[0]


@_solve_and_record.def_fwd
def _integrate_and_record(perturbed, moving, method, jumps):
    record = diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: t)
    of_field, _, _, of_start, of_params = perturbed
    varied = of_field, of_params
    _, _, ts, y0, params = moving
    if any(jax.tree.leaves((varied, of_start))) and jumps(ts[0], y0, params):
        method = _record_jumps(moving, method, varied)
    solution, (times,), crossed = _call_diffrax(moving, method, diffrax.ForwardMode(), None, record)
    residuals = times, solution.t_end, solution.result, crossed
    well = jnp.isin(solution.result, jnp.asarray(ENDED_WELL, solution.result.dtype))
    lost = jnp.asarray(code_of(RESULTS.derivatives_lost), solution.result.dtype)
    return solution._replace(result=jnp.where(crossed & well, lost, solution.result)), residuals


@_solve_and_record.def_bwd
def _replay_backward(residuals, cotangents, perturbed, moving, method, jumps):
    times, t_end, result, crossed = residuals

    def replay(moving):
        field, project, ts, y0, params = moving
        # A member that stopped early is replayed as far as it came; nothing flows back from beyond.
        ahead = ts[-1] > ts[0]
        reached = jnp.where(ahead, jnp.minimum(ts, t_end), jnp.maximum(ts, t_end))
        ts = jnp.where(result == SUCCESSFUL, ts, reached)
        # The last step ends at ts[-1] itself, which may be differentiated, not at its recorded value.
        controller = _RecordedSteps(jnp.where(times == t_end, jnp.inf, times), method.jumps)
        again = Stepping(method.solver, controller, None, method.max_steps, diffrax.NoProgressMeter())
        solution, *_ = _call_diffrax((field, project, ts, y0, params), again, _checkpoint_count(y0, method.max_steps))
        return solution[:3]

    replayed, pull_back = eqx.filter_vjp(replay, moving)
    filled = jax.tree.map(lambda x, c: jnp.zeros_like(x) if c is None else c, replayed, tuple(cotangents[:3]))
    filled = jax.tree.map(lambda c: jnp.where(crossed & (c != 0), jnp.nan, c), filled)
    return pull_back(filled)[0]


_CHECKPOINT_BYTES = 2**28  # of states that a gradient keeps; half of it lets each step be taken once more, at most


def _checkpoint_count(y0, max_steps: int) -> diffrax.RecursiveCheckpointAdjoint:
    """Checkpoints as diffrax has them, some √(2 max_steps), but of a large state as many as fit."""
    usual, fit = int(np.ceil(np.sqrt(2 * max_steps))), _CHECKPOINT_BYTES // (y0.size * y0.dtype.itemsize)
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=None if usual <= fit else max(fit, 2))


class _RecordedSteps(diffrax.AbstractStepSizeController):
    """A controller that repeats recorded steps: it takes their end times (K,), padded with infinity."""

    times: jax.Array
    jumps: "JumpTimes | None"

    def wrap(self, direction):
        times = jnp.where(jnp.isinf(self.times), jnp.inf, self.times * direction)
        jumps = self.jumps and self.jumps.reversed(direction)
        if jumps is not None:  # what is recorded of a step is where the next one begins
            times = _exchange_times(times, jumps.behind, jumps.before)
        return _RecordedSteps(times, jumps)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return jnp.minimum(self.times[0], t1), jnp.array(1)  # the number of steps

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        next_ = self.times.at[controller_state].get(mode="fill", fill_value=jnp.inf)
        begin, jumps = (t1, False) if self.jumps is None else self.jumps.skip_jump(t1)
        return True, begin, next_, jumps, controller_state + 1, diffrax.RESULTS.successful


# ---- where the field jumps at known times ----------------------------------------------------------------------------


class JumpTimes(eqx.Module):
    """Times at which the field jumps, (K,) in increasing order: a step ends at `before`, the next begins at `behind`.

    That is a few roundings off, because a stage at the end of a step, t₀ + h, may be rounded onto the jump; to leave
    out so little of the time changes less than rounding does. Infinite times are none.
    """

    before: jax.Array
    behind: jax.Array

    @classmethod
    def from_times(cls, times: jax.Array) -> "JumpTimes":
        """The jumps at times (K,), in any order."""
        times = jnp.sort(times)
        gap = 4 * jnp.finfo(times.dtype).eps * jnp.where(jnp.isfinite(times), jnp.abs(times), 0.0)
        return cls(times - gap, times + gap)

    def reversed(self, direction) -> "JumpTimes":
        """The jumps in a time that is multiplied by `direction`, 1 or −1; those at infinity stay at +∞."""
        one, other = self.before * direction, self.behind * direction
        low, high = jnp.minimum(one, other), jnp.maximum(one, other)
        return JumpTimes(*(jnp.sort(jnp.where(jnp.isfinite(x), x, jnp.inf)) for x in (low, high)))

    def skip_jump(self, t):
        """The start time of the step after one that ended at t, and a flag: a jump lies between them."""
        begin = _exchange_times(t, self.before, self.behind)
        return begin, begin != t

    def limit_end(self, begin, end):
        """The step end: `end`, or the first jump between `begin` and it."""
        ahead = jnp.searchsorted(self.before, begin, side="right")
        return jnp.minimum(end, self.before.at[ahead].get(mode="fill", fill_value=jnp.inf))


def _exchange_times(t, old, new):
    """The times t, where those that occur in `old`, in increasing order, are replaced by their partners in `new`."""
    place = jnp.minimum(jnp.searchsorted(old, t), len(old) - 1)
    return jnp.where(jnp.isfinite(t) & (old[place] == t), new[place], t)


class WithJumps(AdaptiveWrapper):
    """The steps of a controller, which end before every jump and go on behind it."""

    controller: Any  # an adaptive one: `wrap` of diffrax does not say so of what it returns
    jumps: JumpTimes

    def __init__(self, controller: Any, jumps: JumpTimes):
        self.controller, self.jumps = controller, jumps

    def wrap(self, direction):
        return WithJumps(self.controller.wrap(direction), self.jumps.reversed(direction))

    def init(self, terms, t0, *arguments):
        end, state = self.controller.init(terms, t0, *arguments)
        return self.jumps.limit_end(t0, end), state

    def adapt_step_size(self, *arguments):
        keep, begin, end, made_jump, state, result = self.controller.adapt_step_size(*arguments)
        behind, jumps = self.jumps.skip_jump(begin)
        return keep, behind, self.jumps.limit_end(behind, end + (behind - begin)), made_jump | jumps, state, result
