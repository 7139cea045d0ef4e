"""One integration by diffrax, and its reverse-mode derivative.

The motion is integrated with adaptive steps in a plain loop that keeps nothing. Its derivative is that of the same
method taken over the *same steps*: when a gradient is asked for, the times of the accepted steps are recorded, and the
backward pass differentiates a second integration that is told those times. It makes no decisions, so that recomputing
a part of it (checkpointing) cannot decide otherwise, and it has no rejected steps. The sizes of the steps are not
differentiated, as everywhere in diffrax.

Differentiating the adaptive loop itself by recomputation is not safe: recomputed steps are compiled apart from the
first ones, differ from them in the last digit, and then accept or reject otherwise, which gives wrong gradients without
a word. This is the only module that calls diffrax's integrator.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from lagjax._equations import Equations
from lagjax._settings import Settings
from lagjax._solvers import Projected

PyTree = Any


class Solved(NamedTuple):
    """The states at the output times (inf where not reached), the last state and its time, how it ended, and counts."""

    path: PyTree
    end: PyTree
    t_end: jax.Array
    result: diffrax.RESULTS
    stats: dict[str, jax.Array]


def integrate(form: Equations, settings: Settings, event: diffrax.Event | None, ts, y0, params, primal=None) -> Solved:
    """ẏ = f(t, y) from y0 at ts[0] to ts[-1], or to the event.

    `primal(ts, y0, params)` → `Solved` takes the place of diffrax where nothing is differentiated.

    With the default adjoint, and without an event, reverse mode goes over the recorded steps; otherwise derivatives are
    those of the diffrax adjoint.
    """
    # What f closes over (a parameter from outside, the weights of a neural Lagrangian) becomes an argument.
    field = eqx.filter_closure_convert(form.vector_field, ts[0], y0, params)
    project = eqx.filter_closure_convert(form.projected, ts[0], y0, params) if form.constrained else None
    solved = _differentiable((field, project, ts, y0, params), settings, event, primal)
    if project is not None:
        solved = solved._replace(path=jax.vmap(project, in_axes=(0, 0, None))(ts, solved.path, params))
    return solved


def _differentiable(moving, settings: Settings, event, primal) -> Solved:
    if settings.adjoint is not None or event is not None:
        adjoint = diffrax.RecursiveCheckpointAdjoint() if settings.adjoint is None else settings.adjoint
        return _solve(moving, settings, settings.controller, adjoint, event)
    # Tolerances and the smallest step follow from ts and the dtype; like all that sizes a step, they are data here.
    frozen = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, settings)
    return _over_recorded_steps(moving, frozen, primal)


def _solve(moving, settings: Settings, controller, adjoint, event=None, record: bool = False):
    """Call diffrax; `moving` is all that can be differentiated. With `record`, the accepted times come along."""
    field, project, ts, y0, params = moving
    solver = settings.solver if project is None else Projected(settings.solver, project)
    fixed_dt = settings.dt0 if controller is settings.controller else None
    saved = [diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]
    if record:
        saved.append(diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: t))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        _looping(solver, adjoint),
        t0=ts[0],
        t1=ts[-1],
        dt0=fixed_dt,
        y0=y0,
        args=params,
        saveat=diffrax.SaveAt(subs=saved),
        stepsize_controller=controller,
        adjoint=adjoint,
        event=event,
        max_steps=settings.max_steps,
        throw=False,
        progress_meter=settings.progress if controller is settings.controller else diffrax.NoProgressMeter(),
    )
    end = jax.tree.map(lambda leaf: leaf[0], solution.ys[1])
    counts = ("num_steps", "num_accepted_steps", "num_rejected_steps")
    stats = {name: solution.stats[name] for name in counts}
    solved = Solved(solution.ys[0], end, solution.ts[1][0], solution.result, stats)
    return (solved, solution.ys[2]) if record else solved


def _looping(solver, adjoint):
    """The solver with a stage loop that the adjoint can differentiate, which diffrax sees to unless it is wrapped."""
    if isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    kinds = {diffrax.ForwardMode: "lax", diffrax.RecursiveCheckpointAdjoint: "checkpointed"}
    kind = kinds.get(type(adjoint), "bounded")

    def within(part):
        if not isinstance(part, diffrax.AbstractRungeKutta) or part.scan_kind is not None:
            return part
        return eqx.tree_at(lambda s: s.scan_kind, part, kind, is_leaf=lambda leaf: leaf is None)

    return jax.tree.map(within, solver, is_leaf=lambda part: isinstance(part, diffrax.AbstractRungeKutta))


@eqx.filter_custom_vjp
def _over_recorded_steps(moving, settings, primal):
    """The plain loop: `diffrax.ForwardMode` is the one that keeps nothing for a backward pass."""
    if primal is not None:
        return primal(*moving[2:])
    return _solve(moving, settings, settings.controller, diffrax.ForwardMode())


@_over_recorded_steps.def_fwd
def _forward(perturbed, moving, settings, primal):
    del perturbed, primal
    solved, times = _solve(moving, settings, settings.controller, diffrax.ForwardMode(), record=True)
    return solved, (times, solved.t_end, solved.result)


@_over_recorded_steps.def_bwd
def _backward(residuals, cotangents, perturbed, moving, settings, primal):
    del perturbed, primal
    times, t_end, result = residuals

    def replay(moving):
        field, project, ts, y0, params = moving
        # A member that stopped early is replayed as far as it came; nothing flows back from beyond.
        whole = result == diffrax.RESULTS.successful
        forward = ts[-1] > ts[0]
        reached = jnp.where(forward, jnp.minimum(ts, t_end), jnp.maximum(ts, t_end))
        ts = jnp.where(whole, ts, reached)
        # The last step ends at ts[-1] itself, which may be differentiated, not at its recorded value.
        controller = _Replay(jnp.where(times == t_end, jnp.inf, times))
        solved = _solve((field, project, ts, y0, params), settings, controller, diffrax.RecursiveCheckpointAdjoint())
        return solved.path, solved.end, solved.t_end

    replayed, pull_back = eqx.filter_vjp(replay, moving)
    given = (cotangents.path, cotangents.end, cotangents.t_end)
    filled = jax.tree.map(lambda x, c: jnp.zeros_like(x) if c is None else c, replayed, given)
    return pull_back(filled)[0]


class _Replay(diffrax.AbstractStepSizeController):
    """Steps that end at given times, padded with inf (after which the end of the integration is the next)."""

    times: jax.Array

    def wrap(self, direction):
        """diffrax integrates backward motion with its time reversed."""
        return _Replay(jnp.where(jnp.isinf(self.times), jnp.inf, self.times * direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first time; the state counts the steps."""
        return jnp.minimum(self.times[0], t1), jnp.array(1)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Accept, and go on to the next time."""
        next_ = self.times.at[controller_state].get(mode="fill", fill_value=jnp.inf)
        return True, t1, next_, False, controller_state + 1, diffrax.RESULTS.successful
