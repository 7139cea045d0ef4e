"""`lift_problem`: replace the tracers that a problem's functions close over by parameters of the problem.

`jax.grad(lambda k: simulate(System(lambda q, v: … k …), …))` gives a Lagrangian that reads a tracer, which cannot be
compiled or cached. So each function is traced once, as `jax.closure_convert` does, and the tracers become parameters
beside the user's: the compiled program then serves every value of k, and every function with that code.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend import core
from jaxtyping import PyTree

from lagjax._engine import Batch, Problem
from lagjax._interface import Function
from lagjax._interface.reads import Edition, index_of
from lagjax._scene._system import ARGUMENTS, ROLES, replace_functions


class LiftedParams(NamedTuple):
    """Parameters (params of the user, values): values are numbers that functions close over or modes differ by."""

    params: PyTree
    values: tuple


@dataclass(frozen=True, eq=False)
class _FunctionTrace:
    """A callable made of the jaxpr of a user's function; it takes `LiftedParams` in place of the user's."""

    name: str
    jaxpr: Any  # whose first arguments are the constants
    constants: tuple[Any, ...]  # what it took from outside; None for tracers
    places: tuple[int | None, ...]  # those of tracers among the values
    structure: Any  # of what it returns

    @property
    def __name__(self) -> str:
        return self.name

    def __call__(self, *roles: Any, params: LiftedParams, t: Any = 0.0, **more: Any) -> PyTree:
        pairs = zip(self.constants, self.places, strict=True)
        constants = [c if k is None else params.values[k] for c, k in pairs]
        values = *constants, *jax.tree.leaves((roles, t, eqx.filter(params.params, eqx.is_array_like), more))
        values = [jnp.asarray(x, v.aval.dtype) for x, v in zip(values, self.jaxpr.invars, strict=True)]
        return jax.tree.unflatten(self.structure, core.jaxpr_as_fun(core.ClosedJaxpr(self.jaxpr, []))(*values))


@dataclass(frozen=True, eq=False)
class WithoutTracers:
    """A user's function that closes over no tracer; it takes `LiftedParams` in place of the user's."""

    function: Function

    @property
    def __name__(self) -> str:
        return self.function.name

    def __call__(self, *roles: Any, params: LiftedParams, t: Any = 0.0, **more: Any) -> PyTree:
        return self.function(*roles, t=t, params=params.params, **more)


def lift_problem(problem: Problem) -> Problem:
    """Return the problem with `LiftedParams`, or `problem` itself if its functions close over no tracer."""
    fields = object.__getattribute__(problem.system, "__dict__")  # an attribute of an equinox.Module takes 2 µs
    present = [f for role in ROLES if isinstance(f := fields[role], Function)]
    if problem.event is not None:
        present += [f for f in problem.event.functions if isinstance(f, Function)]
    if not any(object.__getattribute__(f, "code").tracers for f in present):
        return problem
    if jax.tree.leaves((problem.system, present)):  # what holds arrays of its own has no program anyway
        return problem
    values: list[Tracer] = []

    def lift(function: Any, roles: int = 2) -> Any:
        return _lift_function(function, roles, problem, values) if isinstance(function, Function) else function

    functions = {role: lift(fields[role], len(ARGUMENTS[role])) for role in ROLES}
    system = replace_functions(problem.system, functions)
    event = problem.event
    if event is not None:
        event = event._replace(
            conditions=jax.tree.map(lift, event.conditions, is_leaf=lambda x: isinstance(x, Function))
        )
    return dataclasses.replace(problem, system=system, event=event, params=LiftedParams(problem.params, tuple(values)))


def lift_batch(batch: Batch) -> Batch:
    """Do the same for a batch: the values become parameters with the same value in all members."""
    member = lift_problem(batch.member)
    if member is batch.member:
        return batch
    values = member.params.values
    return Batch(member, batch.ts, batch.y0, LiftedParams(batch.params, values), (*batch.axes, *[None] * len(values)))


def _lift_function(function: Function, roles: int, problem: Problem, values: list) -> Function:
    """Trace a function of `roles` vectors and t; append the tracers that it closes over to `values`, in place."""
    extras = tuple(dict.fromkeys((*function.extras, "params")))
    if not function.code.tracers or "inputs" in function.extras:
        return Function(None, Edition.from_function(WithoutTracers(function)), extras)
    numbers, rest = eqx.partition(problem.params, eqx.is_array_like)
    layout = problem.layout
    state, t = layout.restore(jnp.zeros(layout.size, layout.dtype)), jnp.zeros((), layout.dtype)

    def call_with_numbers(states, t, numbers, more):
        return function(*states, t=t, params=eqx.combine(numbers, rest), **more)

    reads = "multipliers" in function.extras
    more = problem.system.multiplier_shapes(layout, problem.params) if reads else {}
    closed, shapes = jax.make_jaxpr(call_with_numbers, return_shape=True)((state,) * roles, t, numbers, more)
    places = tuple(index_of(values, c) if isinstance(c, Tracer) else None for c in closed.consts)
    constants = tuple(None if isinstance(c, Tracer) else c for c in closed.consts)
    # The first arguments of the trace are what it took from outside. An edition also says where the
    # values stand in it, so that equal functions with equal places are one.
    jaxpr = closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
    trace = _FunctionTrace(function.name, jaxpr, constants, places, jax.tree.structure(shapes))
    return Function(None, function.code.trace_edition(trace, f"{places} {closed.in_avals}"), extras)
