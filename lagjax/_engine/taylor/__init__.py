"""`MachineCode`: the engine on CPUs (`_gpu_launch`: on GPUs), Taylor series in machine code made for the scene.

Concrete problems: `Problem` ─► `Flow` (rows of NumPy); traced ones: `Problem` ─► `_primitives`, the flow as primitives
of JAX. All of that is in float64; a problem in float32 is converted by `_doubles` first.

On rows of NumPy: `_flow` (the flow map), `_derivatives` (its jvp and vjp; `_passages`: steps divided for them),
`_variational` (its variational equations), `_state_rates` (the time derivative of an output). In JAX: `_primitives`,
executed by `_call` (CPU) and `_gpu_launch`; `_line_functions` and `_lowered_motion` for the scene's quantities.
Surfaces and events: `_surfaces`, `_crossing`.
"""

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine._problem import AbstractEngine, Batch, Problem, Solution, solve_in_doubles
from lagjax._engine.taylor import _primitives
from lagjax._engine.taylor._crossing import (
    FoundCrossings,
    motion_to_event,
    motion_with_crossings,
    run_stretch,
    surfaces_of,
    surfaces_of_event,
)
from lagjax._engine.taylor._derivatives import Motions, jvp, project_start_tangents, split_portions, vjp
from lagjax._engine.taylor._flow import Flow, Tolerances, require_fit
from lagjax._engine.taylor._line_functions import Line, line_of
from lagjax._engine.taylor._lowered_motion import lowered_motion
from lagjax._engine.taylor._surfaces import Surfaces, move_to_zero, rate_errors, require_one_number, vector_of
from lagjax._equations import Derivation
from lagjax._interface import EVENT_OCCURRED, default_platform, has_nvidia_gpu, is_concrete
from lagjax._native import Guards, Nesting, append_guards, pieces_of
from lagjax._primitives import compute_in_doubles
from lagjax._program import Unlowerable
from lagjax._tracing import Program


# Not an equinox.Module: its methods are pytrees of their own, and to make one takes as long as ten steps.
@jax.tree_util.register_static
@dataclass(frozen=True)
class MachineCode(AbstractEngine):
    r"""Taylor series in machine code made for the scene: `simulate(..., solver=lagjax.MachineCode())`.

    With the default `solver=None` a run goes to machine code where it can and to diffrax where it cannot.
    `MachineCode()` insists: a run that machine code cannot integrate is a `ValueError` that says why, instead of a
    slower run. `simulate`, `simulate_batch` and `work_precision` take it, the last one to compare it with solvers of
    diffrax.

    Each coordinate becomes a power series about the present time, of an order p that suits the tolerance,

        q(t + h) = Σ qₖ hᵏ, 0 ≤ k ≤ p,    (k+1)(k+2) qₖ₊₂ = (q̈)ₖ

    with the coefficients (q̈)ₖ by recurrences through the scalar operations of the acceleration. Four or eight members
    of a batch stand side by side in the vector registers of every core.

    It computes in float64, also for a state in float32, whose results it rounds once.

    On an NVIDIA GPU one thread follows a member; `MachineCode()` is lowered for CUDA as for CPUs, by `jax.export` too.
    On an H100 it is 30 times as fast as diffrax for a double pendulum, whose series stay in registers, 1.2 times for a
    chain of four links and 4 times for one of eight, with smaller errors (`python -m benchmarks.gpu`); the 16 cores
    beside it are as fast for that chain. GPUs that are not for data centres have 1/64 of that float64; none of these
    has been tried. On a GPU members that fail are not tried once more by another variant of the equations, and an angle
    beyond 2²⁰ ends a motion. A first derivative in forward mode takes a motion with its tangents for every direction;
    one in reverse mode goes back over the steps, as on a CPU, and takes such tangents for every number with constraints
    alone, or where a member's steps are too many or do not suit its derivatives. Higher ones are composed of these.
    Crossings and hybrid motion require a CPU.

    Machine code requires a CPU or such a GPU, a scene whose acceleration is a scalar program of smooth or piecewise
    smooth operations and whose kernel fits into half of the machine's memory, adaptive steps, and real-valued events;
    on a CPU derivatives are by its own adjoint. `System.explain` says whether a scene has machine code.

    **Raises** nothing itself; a run without machine code raises `ValueError` before anything is integrated.

    Source: Jorba & Zou, *A software package for the numerical integration of ODEs by means of high-order Taylor
    methods*, Exp. Math. 14 (2005) 99–117, §2.1, §3.2.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
    trajectory = lagjax.simulate(scene, 1.0, 0.0, jnp.linspace(0, 10, 101), solver=lagjax.MachineCode())
    ```
    """

    def refuses(self, problem: Problem) -> str | None:
        """The reason why it cannot solve the problem on a CPU, as the end of a sentence; None if it can."""
        lacks = self.lacks(problem)
        if lacks is None and (platform := default_platform()) != "cpu":
            return f"the default device is a {platform}, and `jax.default_device(jax.devices('cpu')[0])` chooses a CPU"
        return lacks

    def lacks(self, problem: Problem) -> str | None:
        """The reason why there is no machine code for the problem, as the end of a sentence; None if there is.

        Whether a GPU can run it is known when it is lowered for one.
        """
        if problem.is_single:
            with jax.enable_x64(True):
                return self.lacks(problem.double_precision)
        if not all(map(is_concrete, problem.tolerances)):
            return "the tolerances are being traced"
        try:
            _find_flow(problem)
        except Unlowerable as reason:
            return str(reason)
        return None

    def declines(self, problem: Problem) -> str | None:
        """The reason why it is not the default for the problem, as the end of a sentence; None if it is.

        An NVIDIA GPU is no reason if its threads have memory for a motion.
        """
        if problem.derivation.form.is_sparse and problem.guards is None and not problem.varies:
            return problem.derivation.form.reason
        refusal = self.refuses(problem)
        if refusal is None or not has_nvidia_gpu() or self.lacks(problem) is not None:
            return refusal
        with jax.enable_x64(True):
            flow = flow_of(problem.double_precision if problem.is_single else problem)
            try:
                flow.kernel.gpu_programs.motion(tolerances_of(problem).rtol)
            except Unlowerable as reason:
                return str(reason)
        return None

    def solve(self, problem: Problem) -> Solution:
        """The motion of one member, under every transformation of JAX. The problem must not be refused."""
        if problem.is_single:
            return solve_in_doubles(self.solve, problem)
        flow, tolerances = flow_of(problem), tolerances_of(problem)
        if problem.is_known and default_platform() == "cpu":
            _require_increasing(flow.program, problem.vector)
            return _name_events(problem, _run_one(flow, problem, tolerances))
        ts, y0, params = map(jnp.asarray, (problem.ts, problem.y0, problem.vector))
        if problem.event is None:
            return _primitives.run(flow, tolerances, ts, y0, params)
        given = flow, _unguarded_flow(problem), surfaces_of_event(problem), tolerances
        return _name_events(problem, _primitives.compile_once(motion_to_event, *given)(ts, y0, params))

    def refuses_crossings(self, problem: Problem, surfaces: Surfaces) -> str | None:
        """The reason why it cannot find crossings of these surfaces, as the end of a sentence; None if it can."""
        return self.refuses(_record_crossings(problem, surfaces))

    def crossings(
        self, problem: Problem, surfaces: Surfaces, room: int, slack: float = 1.0
    ) -> tuple[Solution, FoundCrossings]:
        """The motion of one member, and the crossings of its surfaces, at most `room` for each.

        Derivatives have the accuracy of a tolerance that is `slack` times as large.
        """
        if problem.is_single:
            return solve_in_doubles(lambda problem: self.crossings(problem, surfaces, room, slack), problem)
        noting, flow = flow_of(_record_crossings(problem, surfaces)), _unguarded_flow(problem)
        tolerances = tolerances_of(problem)._replace(notes=room, slack=slack)
        if problem.is_known:
            solution = _run_one(noting, problem, tolerances)
            return solution, FoundCrossings.read(solution.path, len(surfaces.directions))
        ts, y0, params = map(jnp.asarray, (problem.ts, problem.y0, problem.vector))
        given = noting, flow, surfaces, tolerances
        return _primitives.compile_once(motion_with_crossings, *given)(ts, y0, params)

    def solve_batch(self, batch: Batch) -> Solution:
        """The motions of all members, in the lanes of vectors and on all cores."""
        if not batch.is_known or default_platform() != "cpu":
            return batch.map_members(self.solve)
        member = batch.member

        def run(ts, y0, params):
            problem = member.double_precision if member.is_single else member
            return _name_events(problem, flow_of(problem).run(ts, y0, params, tolerances_of(problem)))

        given = tuple(map(np.asarray, (batch.ts, batch.y0, batch.vectors)))
        return compute_in_doubles(run, *given) if member.is_single else run(*given)


def _name_events(problem: Problem, solution: Solution) -> Solution:
    """The solution with a flag per event function that ended the motion, in place of its sign change."""
    if problem.event is None:
        return solution
    return solution._replace(event=(solution.event > 0) & (solution.result == EVENT_OCCURRED)[..., None])


def _run_one(flow: Flow, problem: Problem, tolerances: Tolerances) -> Solution:
    """The motion of one member on the host, with concrete numbers."""
    ts, y0, params = (np.asarray(x)[None] for x in (problem.ts, problem.y0, problem.vector))
    return Solution._make([*(x[0] for x in flow.run(ts, y0, params, tolerances)[:-1]), None])


def flow_of(problem: Problem) -> Flow:
    """The flow of a problem's scene. Raises `ValueError`, with the reason, if it has none."""
    if problem.is_single:
        with jax.enable_x64(True):
            return flow_of(problem.double_precision)
    try:
        return _find_flow(problem)
    except Unlowerable as reason:
        raise ValueError(f"There is no machine code for this scene: {reason}.") from None


def make_flow(derivation: Derivation, path: str, guards: Guards | None) -> Flow:
    """The flow of a scene with these guards. Raises `ValueError`, with the reason, if it has none."""
    flow = _make_flow(derivation, path, guards)
    if isinstance(flow, Unlowerable):
        raise ValueError(f"There is no machine code for this scene: {flow}.")
    return flow


def _record_crossings(problem: Problem, surfaces: Surfaces) -> Problem:
    return dataclasses.replace(problem, event=None, guards=surfaces.guards(notes=True))


def _unguarded_flow(problem: Problem) -> Flow:
    return flow_of(dataclasses.replace(problem, event=None, guards=None))


def _find_flow(problem: Problem) -> Flow:
    """The flow of a problem's scene in float64. Raises `Unlowerable` if it has none."""
    guards = problem.guards if problem.event is None else surfaces_of_event(problem).guards()
    flow = _make_flow(problem.derivation.lowered, problem.system.path, guards)
    if isinstance(flow, Unlowerable):
        raise Unlowerable(str(flow))
    return flow


@functools.lru_cache(maxsize=64)
def _make_flow(derivation: Derivation, path: str, guards: Guards | None) -> Flow | Unlowerable:
    """The flow of a scene, or an `Unlowerable` with the reason why it has none; cached."""
    if path == "array":
        return Unlowerable("the array path was asked for")
    if derivation.unhashable is not None:
        return Unlowerable(f"the scene cannot be remembered: {derivation.unhashable}")
    n = derivation.layout.size
    try:
        program, projection = derivation.accelerations.program, derivation.accelerations.projection
        if guards is not None and guards.remembers:
            program = program.append_inputs(guards.inputs)
        require_fit(program, n)
        if reason := derivation.kick_refusal:
            return Unlowerable(reason)
        pieces = pieces_of(program, Nesting(n)) if derivation.kicks else None
    except Unlowerable as reason:
        return Unlowerable(str(reason))  # without the frames that it was raised in
    try:
        if guards is not None:
            pieces = append_guards(program, n, guards.values, True).borders
    except Unlowerable as reason:
        return Unlowerable(f"of a guard, {reason}")
    if derivation.kicks and pieces is None:
        return Unlowerable("L, or its momentum p = dL/dqdot, jumps at a border that no series leads to")
    return Flow.from_program(program, n, projection, guards, derivation.motion.constraints.turns)


def _require_increasing(program: Program, vector) -> None:
    """Raise `ValueError` if the knots of a look-up, among the parameters, do not increase."""
    for op, _, attribute in program.line.nodes if program.looks_up else ():
        if op == "locate" and attribute.table.numbers is None:
            knots = np.asarray(vector)[np.array(attribute.table.positions) - (program.size - len(vector))]
            wrong = np.flatnonzero(~(np.diff(knots) > 0))
            if wrong.size:
                i = int(wrong[0])
                raise ValueError(
                    f"The knots of a look-up (samples, jnp.interp, searchsorted) must increase, but in params one that "
                    f"is {knots[i + 1]:g} comes after one that is {knots[i]:g}. Sort them, and keep one of those that "
                    "are equal."
                )


def tolerances_of(problem: Problem) -> Tolerances:
    rtol, atol = MachineCode().rtol(problem), problem.tolerances[1]
    return Tolerances(float(rtol), 0.0 if atol is None else float(atol), problem.max_steps)
