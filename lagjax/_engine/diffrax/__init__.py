"""`Diffrax`: the engine of everything that machine code is not for, any solver of diffrax, on any device.

What diffrax reports of a motion that stopped ("the step became too small") is completed with what it ran into: a mass
matrix that is singular, a force that is not finite or jumps, constraints that became dependent.

`_equations` is the first-order system that a solver sees, `_integrate` one integration and its reverse-mode derivative,
`_jumps` finds jumps of the acceleration on the way, `_solvers` wraps solvers for dense output and for constraints.
"""

import functools
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from lagjax._engine._problem import (
    AbstractEngine,
    Batch,
    Problem,
    PyTree,
    Solution,
    evaluate_condition,
    explain_tight_rtol,
    flat_condition,
    signs_of_event,
    solve_in_doubles,
)
from lagjax._engine._stop_reason import End, find_stop_flags
from lagjax._engine.diffrax._equations import MotionEquations, equations_of
from lagjax._engine.diffrax._integrate import JumpTimes, LiftedFunction, Stepping, WithJumps, integrate
from lagjax._engine.diffrax._jumps import stop_derivatives
from lagjax._engine.diffrax._solvers import FineOutput
from lagjax._equations import forms
from lagjax._interface import (
    ENDED_WELL,
    EVENT_OCCURRED,
    RESULTS,
    SUCCESSFUL,
    code_of,
    halves,
    is_concrete,
    require_number,
    result_from,
)
from lagjax._primitives import DOUBLE, SINGLE, differentiable_where, mark_steps, undefined_unless
from lagjax._program import Unlowerable, lack_of_memory, table_of

# Solvers reject steps for the round-off of their error estimate where rtol is below some ten units of it.
LEAST_RTOL_OF_DIFFRAX = 10


def _explain_forward_mode(solve):
    """A decorator: errors say what forward mode over recorded steps needs, instead of `custom_vjp`."""

    @functools.wraps(solve)
    def solve_or_explain(self, problem):
        try:
            return solve(self, problem)
        except TypeError as error:
            if self.adjoint is not None or "custom_vjp" not in str(error):
                raise
            raise TypeError(
                "The steps of diffrax are recorded for reverse mode, jax.grad and jax.vjp. For jax.jvp and jax.jacfwd "
                "give simulate(..., adjoint=diffrax.ForwardMode()). (A function of the scene with a jax.custom_vjp "
                "has no forward mode at all: give it a jax.custom_jvp.)"
            ) from None

    return solve_or_explain


class Diffrax(AbstractEngine, eqx.Module):
    """A solver of diffrax, with adaptive steps or with fixed ones of size `dt`.

    `solver` None is Dopri8, with better states between its steps where they are wanted; `adjoint` None goes back over
    the recorded steps in reverse mode.
    """

    default_rtol: ClassVar = {DOUBLE: 1e-9, SINGLE: 1e-5}  # in the arithmetic of the state

    solver: diffrax.AbstractSolver | None = None
    dt: jax.Array | np.ndarray | None = None
    adjoint: diffrax.AbstractAdjoint | None = None
    progress: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter()

    @classmethod
    def from_arguments(cls, solver=None, dt=None, adjoint=None, progress: bool | diffrax.AbstractProgressMeter = False):
        """The engine that these arguments of `simulate` ask for. Raises where one of them cannot be right."""
        if solver is not None:
            _require_solver(solver, adaptive=dt is None)
        if isinstance(progress, bool):
            progress = diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter()
        _require_instance(progress, "progress", diffrax.AbstractProgressMeter, "True or False")
        if adjoint is not None:
            _require_instance(adjoint, "adjoint", diffrax.AbstractAdjoint, "None")
        if dt is not None:
            require_number(dt, "dt")
            if is_concrete(dt) and not (np.isfinite(dt) and dt > 0):
                raise ValueError(f"dt must be a positive step size, also backward in time; got {dt}.")
            dt = dt if isinstance(dt, jax.Array) else np.asarray(dt, float)
        return cls(solver, dt, adjoint, progress)

    def refuses(self, problem: Problem) -> str | None:
        """The reason why this solver cannot solve the problem, as the end of a sentence; None if it can."""
        if problem.derivation.kicks:
            return problem.derivation.kick_refusal or (
                "L, or its momentum p = dL/dqdot, jumps at a border: the velocities jump there, and steps of diffrax "
                "go across. Machine code ends a step there and has that: leave solver at None, on a CPU "
                "(`System.explain` says why a scene is not for it). Or round the jump off over a width that steps "
                "resolve, 0.5 * (1 + jnp.tanh(x / w)) for x > 0, hold='cubic' for samples"
            )
        if problem.varies:
            return "diffrax does not know the types of jax.shard_map: give it check_vma=False"
        if self.dt is None:
            return explain_tight_rtol(self.rtol(problem), problem.layout.dtype, LEAST_RTOL_OF_DIFFRAX)
        if not (is_concrete(self.dt) and is_concrete(problem.ts)):
            return None
        ts = np.asarray(problem.ts)
        needed = float(abs(ts[-1] - ts[0])) / float(self.dt)
        if needed <= problem.max_steps + 0.5:
            return None
        return f"dt={self.dt} needs {needed:.0f} steps, more than max_steps={problem.max_steps}: raise one of them"

    @property
    def is_implicit(self) -> bool:
        return isinstance(self.solver, diffrax.AbstractImplicitSolver)

    def tolerances(self, problem: Problem, y0) -> tuple | None:
        """rtol and atol of a step; None where it has a fixed size."""
        return None if self.dt is not None else super().tolerances(problem, y0)

    def lacks_memory(self, problem: Problem, members: int = 1) -> str | None:
        """The end of a sentence if `members` of this large scene need more memory than there is; else None.

        That are the arrays of L and its gradient, those of M where it is a matrix, some states of a step, and outputs.
        """
        derivation, n, count = problem.derivation, problem.layout.size, jnp.size(problem.ts)
        if n < forms.LEAST_COORDINATES:
            return None
        size, in_turn = problem.layout.dtype.itemsize, derivation.form.is_sparse  # one member after the other
        at_once = derivation.memory + size * (2 * n * _STATES + (0 if in_turn else 3 * n * n))
        lack = lack_of_memory((1 if in_turn else members) * at_once + members * size * 2 * n * count)
        batch = f"{members} members of " if members > 1 else ""
        return lack and f"A motion of {batch}{n} coordinates with {count} outputs {lack}"

    @_explain_forward_mode
    def solve(self, problem: Problem) -> Solution:
        """The motion of one member, compiled once for all problems of its structure."""
        motion = problem.derivation.motion
        if problem.is_single and motion.constrained and problem.derivation.form.is_sparse:
            return solve_in_doubles(self.solve, problem)  # many links are as large as the roundings of float32
        return _solve_problem(self, problem)

    @_explain_forward_mode
    @eqx.filter_jit
    def solve_batch(self, batch: Batch) -> Solution:
        """The motions of all members, which step together until the slowest has arrived; of large scenes in turn."""
        if batch.member.derivation.form.is_sparse:  # one by one they are in the caches of a core
            return batch.map_in_turn(self.solve)
        solution = batch.map_members(lambda problem: _solve_problem(self, problem))
        steps = solution.accepted + solution.rejected
        return solution._replace(idle=steps.size * jnp.max(steps) - jnp.sum(steps))

    def stepping(self, problem: Problem) -> Stepping:
        """The solver, step-size controller and budget with which diffrax integrates this problem."""
        dtype, ts, solver = problem.layout.dtype, jnp.asarray(problem.ts), self.solver
        if solver is None:
            # States between steps are wanted for outputs inside and to locate an event.
            between = ts.size > 2 or problem.event is not None
            solver = FineOutput(diffrax.Dopri8()) if between else diffrax.Dopri8()
        if (tolerances := self.tolerances(problem, problem.y0)) is None:
            dt0 = jnp.asarray(self.dt, dtype) * jnp.sign(ts[-1] - ts[0])
            return Stepping(solver, diffrax.ConstantStepSize(), dt0, problem.max_steps, self.progress)
        # Below this a step no longer moves the time reliably.
        smallest = 4 * jnp.finfo(dtype).eps * jnp.maximum(abs(ts[0]), abs(ts[-1]))
        controller = diffrax.PIDController(*tolerances, norm=_norm_or_inf, dtmin=smallest, force_dtmin=False)
        if (jumps := _table_jump_times(problem)) is not None:
            controller = WithJumps(controller, jumps)
        return Stepping(solver, controller, None, problem.max_steps, self.progress, jumps)


_STATES = 20  # that a step of Dopri8 holds: its stages, their sums, and errors

_AT_END = 256  # diffrax lets a step that ends up to 100 roundings before the end of the motion end there


def _table_jump_times(problem: Problem) -> JumpTimes | None:
    """The times inside the motion at which its program looks up another entry of a table; None without any.

    One at an end of the motion is moved inside by some roundings, so that only one tiny step sees it.
    """
    try:
        borders = problem.derivation.borders
    except Unlowerable:
        return None
    if borders is None or not borders.clocks:
        return None
    numbers, first = jnp.asarray(problem.vector), 2 * problem.layout.size + 1
    located = (borders.decisions[j].table for j in borders.clocks)
    knots = jnp.concatenate([
        jnp.asarray(table.entries, numbers.dtype) if table.numbers is not None
        else numbers[table.first - first :: table.stride][: table.count]
        for table in dict.fromkeys(table_of(of) for of in located if of is not None)
    ])  # fmt: skip
    ends = jnp.asarray(problem.ts)[jnp.array([0, -1])]
    low, high, shift = ends.min(), ends.max(), _AT_END * jnp.finfo(knots.dtype).eps * jnp.abs(knots)
    inside = (knots >= low) & (knots <= high)
    return JumpTimes.from_times(jnp.where(inside, jnp.clip(knots, low + shift, high - shift), jnp.inf))


def _norm_or_inf(error: PyTree) -> jax.Array:
    """Root mean square, with NaN as infinity: an undefined step is then rejected and shortened like any bad one."""
    norm = optx.rms_norm(error)
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


@eqx.filter_jit
def _solve_problem(engine: Diffrax, problem: Problem) -> Solution:
    derivation, numbers, given = problem.derivation, problem.numbers, jnp.asarray(problem.ts)
    form, y0 = equations_of(derivation), jnp.asarray(problem.y0)

    # A member that cannot start is given no time to integrate over: it costs nothing, and the others do not wait.
    start = _start_result(y0, *form.acceleration(*stop_derivatives((given[0], halves(y0), numbers))))
    ts = jnp.where(start == RESULTS.successful, given, given[0])
    event, is_located = (None, True) if problem.event is None else _flatten_event(problem, ts, y0, numbers)
    method = engine.stepping(problem)
    if form.constrained:  # a start that was typed, or is rounded to float32; the way to it is no error of a step
        y0 = jnp.concatenate(form.projected(given[0], halves(y0), numbers))
    solution = integrate(form, method, engine.adjoint, event, ts, y0, numbers)
    result = _explain_result(solution, form, start, ts, numbers)
    if derivation.motion.constrained:
        end = halves(solution.y_end)
        lost = derivation.motion.rank_lost((*halves(y0), given[0], numbers), (*end, solution.t_end, numbers))
        failed = (result != RESULTS.successful) & (result != RESULTS.event_occurred)
        result = RESULTS.where(failed & lost, RESULTS.constraint_rank_lost, result)
        not_projected = solution.result == code_of(RESULTS.breakdown)
        result = RESULTS.where(not_projected, RESULTS.projection_failed, result)
    # diffrax leaves outputs it did not reach at inf, and those of a member without time at its start. Whatever adjoint
    # there is, their cotangents must not be lost: they go to all that went in.
    reached = mark_steps(jnp.isfinite(solution.path).all(axis=1) & (ts == given))
    well = mark_steps(jnp.isin(result._value, jnp.asarray(ENDED_WELL)))
    y_end, t_end, inputs = solution.y_end, solution.t_end, (given, y0, *jax.tree.leaves(numbers))
    if not is_located:  # where a motion ends behind a step that an event ended does not vary with the step
        well = well & (result._value != EVENT_OCCURRED)
        t_end = differentiable_where(well, t_end, *inputs)
    return solution._replace(
        path=undefined_unless(reached[:, None], solution.path, (given, y0, numbers)),
        y_end=differentiable_where(well, y_end, *inputs) if not is_located else differentiable_where(well, y_end),
        t_end=t_end,
        result=result._value,
    )


# ---- what stopped a motion -------------------------------------------------------------------------------------------


def _start_result(y, acceleration, singular) -> RESULTS:
    """The result code at a state (2n,) with this acceleration (n,), and a flag that M is singular."""
    finite = jnp.isfinite(y).all() & jnp.isfinite(acceleration).all()
    failed = jnp.where(singular, code_of(RESULTS.mass_matrix_singular), code_of(RESULTS.nonfinite_state))
    return result_from(jnp.where(finite, SUCCESSFUL, failed))


def _explain_result(solution: Solution, form: MotionEquations, start: RESULTS, ts, numbers) -> RESULTS:
    """The result code that tells most: of diffrax's, of those at the first and last state, and of a jump just ahead."""
    # A name has no derivative, and the search for it is a loop that reverse mode could not go back through.
    ts, solution, numbers = stop_derivatives((ts, solution, numbers))
    last = halves(solution.y_end)
    end = _start_result(solution.y_end, *form.acceleration(solution.t_end, last, numbers))
    result = result_from(solution.result)
    stopped = (result != RESULTS.successful) & (result != RESULTS.event_occurred)
    unhealthy = (end != RESULTS.successful) & (stopped | (end == RESULTS.nonfinite_state))
    result = RESULTS.where(unhealthy, end, result)
    result = RESULTS.where(start == RESULTS.successful, result, start)

    field = stop_derivatives(LiftedFunction.from_function(form.acceleration, ts[0], last, numbers))

    def acceleration(t, y):
        return field(t, halves(y), numbers)[0]

    at = End(solution.t_end, solution.y_end, ts[0], ts[-1], solution.accepted, solution.rejected)
    stopped = (result == RESULTS.dt_min_reached, result == RESULTS.max_steps_reached)
    not_finite, jumps = find_stop_flags(acceleration, at, *stopped)
    result = RESULTS.where(jumps, RESULTS.acceleration_discontinuous, result)
    return RESULTS.where(not_finite, RESULTS.nonfinite_state, result)


def _flatten_event(problem: Problem, ts, y0, numbers) -> tuple[diffrax.Event, bool]:
    """The event for diffrax, whose conditions take flat states (2n,); and a flag that all instants are located.

    That of a comparison is where its difference is zero. If it holds at the start, it is the start.
    """
    event, signs = problem.event, signs_of_event(problem)
    assert event is not None
    forward = jnp.sign(ts[-1] - ts[0])
    instant = 4 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))

    def flat(function, sign):
        function = flat_condition(function, problem)
        at_once = sign and (evaluate_condition(function, y0, ts[0], numbers)[0] * sign > 0)

        def condition(t, y, args, **_):
            value = evaluate_condition(function, y, t, args)[0]
            return jnp.where(at_once, sign * ((t - ts[0]) * forward - instant), value) if sign else value

        return condition

    conditions = [flat(function, sign) for function, sign in zip(event.functions, signs, strict=True)]
    ways = [sign > 0 if sign else way for sign, way in zip(signs, event.ways, strict=True)]
    if len(conditions) == 1:
        tolerance = 4 * float(jnp.finfo(ts.dtype).eps)
        finder = event.root_finder or _EventBisection(rtol=tolerance, atol=tolerance)
        return diffrax.Event(conditions[0], finder, ways[0]), None not in signs
    if event.root_finder is None:
        raise ValueError(
            f"An event of {len(conditions)} functions is for machine code: of several that a step of diffrax passes, "
            "the first of the list would end the motion, and not the first in time. Leave the solver out, or make one "
            "function of them that changes sign where any of them does, as lambda q, qdot: jnp.minimum(f, g) of two "
            "that are positive before."
        )
    return diffrax.Event(conditions, event.root_finder, ways), None not in signs


class _EventBisection(optx.Bisection):
    """Bisection that stops when the interval is as small as the dtype resolves, whatever the size of the function.

    The sign change that fired an event brackets its root, so that this always arrives. It also does where there is
    nothing to find, as in members of a batch that had no event, or in a Boolean one: diffrax asks for the step's end.
    """

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        lower, upper = (jnp.asarray(options[end], f_struct.dtype) for end in ("lower", "upper"))
        state = optx.Bisection(self.rtol, self.atol, flip=True).init(fn, y, args, options, f_struct, aux_struct, tags)
        return eqx.tree_at(lambda s: s.flip, state, fn(lower, args)[0] > fn(upper, args)[0])

    def terminate(self, fn, y, args, options, state, tags):
        scale = jnp.maximum(jnp.abs(state.lower), jnp.abs(state.upper))
        small = jnp.abs(state.upper - state.lower) <= self.rtol * scale
        return small & jnp.isfinite(state.error), optx.RESULTS.successful


# ---- what can be wrong with a solver ---------------------------------------------------------------------------------


def _require_instance(value, name: str, kind: type, example: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be an instance of diffrax.{kind.__name__}, or {example}; got {value!r}.")


def _require_solver(solver, adaptive: bool) -> None:
    name = type(solver).__name__
    if not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"solver must be an instance of a diffrax solver, such as diffrax.Tsit5(); got {solver!r}.")
    structure = solver.term_structure
    if not (isinstance(structure, type) and issubclass(diffrax.ODETerm, structure)):
        raise ValueError(
            f"{name} splits the equations into several terms, which those of a general Lagrangian do not allow; "
            "use a solver of ordinary differential equations, such as diffrax.Dopri8() or diffrax.Kvaerno5()."
        )
    if adaptive and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(f"{name} has no error estimate to adapt its steps to: give a fixed step with dt=...")
    # Left to their default, they are those of adaptive steps.
    if not adaptive and isinstance(solver, diffrax.AbstractImplicitSolver):
        finder = solver.root_finder
        if not all(eqx.is_array_like(getattr(finder, tolerance, 0.0)) for tolerance in ("rtol", "atol")):
            raise ValueError(
                f"{name} solves an equation in every step, and with a fixed step nothing says how well: give it "
                f"tolerances, as in diffrax.{name}(root_finder=diffrax.VeryChord(rtol=1e-10, atol=1e-10)), or leave "
                "dt out."
            )
