"""`Flow`: the flow map of a scalar program in machine code, (output times, initial state, params) → states.

Everything here works on NumPy arrays with one row per member; `_derivatives` has its derivatives, `_primitives` makes
functions of both that JAX can transform.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax import _native
from lagjax._engine._problem import Solution
from lagjax._engine._stop_reason import End, find_stop_flags
from lagjax._engine.taylor._variational import tangent_programs
from lagjax._equations import forms
from lagjax._interface import RESULTS, SUCCESSFUL, code_of
from lagjax._native import Steps
from lagjax._program import Unlowerable, machine_memory
from lagjax._tracing import Program

# The last terms that the series of a tangent may have, relative to the tangent, in tolerances. What the series leaves
# out is smaller by e² at least. Measured on all scenes: a motion that has its own scale takes steps with at most 300.
EXCESS = 1000.0
# The codes of the kernel, in their order, as results.
RESULT_OF_CODE = np.array([code_of(result) for result in (
    RESULTS.successful, RESULTS.max_steps_reached, RESULTS.dt_min_reached, RESULTS.nonfinite_state,
    RESULTS.mass_matrix_singular, RESULTS.projection_failed, RESULTS.acceleration_discontinuous, RESULTS.event_occurred,
)])  # fmt: skip
_SPENT, _SHRANK, _NOT_FINITE, _SINGULAR, _NOT_PROJECTED, _JUMPS = RESULT_OF_CODE[1:7].tolist()
NOT_FINITE_RESULT = _NOT_FINITE
_GIVEN_UP = (_SINGULAR, _NOT_FINITE, _SHRANK, _NOT_PROJECTED)  # what another variant of the program may still follow


class Tolerances(NamedTuple):
    """The local error tolerances, the budget of a run, and the room for notes of each guard.

    An atol of 0 means none given: it follows the size of the motion. Steps need to be accurate for derivatives only to
    `slack` times rtol. An order of 0 means that which suits rtol.
    """

    rtol: float
    atol: float
    max_steps: int
    tries: int = 4
    notes: int = 0
    slack: float = 1.0
    order: int = 0

    @property
    def largest_excess(self) -> float:
        """The largest allowed last terms of the series of a tangent along a step, relative to the tangent."""
        return EXCESS * self.slack * self.rtol

    @property
    def tighter(self) -> "Tolerances":
        """Slightly tighter tolerances for a retry, whose steps end at other places."""
        return self._replace(rtol=0.7 * self.rtol, atol=0.7 * self.atol, tries=self.tries - 1)

    @property
    def floor(self) -> float:
        return _native.small_size(self.rtol, self.atol)

    @property
    def with_larger_budget(self) -> "Tolerances":
        """The tolerances for a motion with its tangents, which takes more steps."""
        return self._replace(max_steps=4 * self.max_steps)


def require_fit(program: Program, size: int) -> None:
    """Raise `Unlowerable` if there is no machine code for the program of a scene."""
    if program.operations > forms.LARGEST_PROGRAM:
        raise Unlowerable(
            f"its acceleration takes {program.operations} operations, more than the {forms.LARGEST_PROGRAM} whose "
            f"kernel and derivatives fit into half of this machine's {machine_memory() / 1e9:.0f} GB of memory"
        )
    _native.recurrences(program, size)  # raises where an operation has none


# ---- flows -----------------------------------------------------------------------------------------------------------


class Flow:
    """The flow of a program for q̈ with n coordinates.

    `parts` gives the program, which takes q, q̇, t and then the P parameters and gives q̈ and whether the mass matrix
    is singular, and the projection onto the constraints, or None. It is called when machine code is first needed.
    `guards` end a motion early. `groups` (n,) numbers the coordinates whose errors are measured together; these may be
    those of a motion with its tangents (`nesting`). `motion` gives the program of the motion without tangents;
    `general` the flow of the variant for any mass matrix: members that fail with the regular variant are repeated with
    it. If the flow `turns`, as a slip in space does, tangents across it have poles that the motion has not, and
    transposed steps do not detect them: its transpose is that of its tangents.
    """

    def __init__(
        self,
        parts: Callable[[], tuple[Program, _native.Projection | None]],
        size: int,
        numbers: int,
        guards: _native.Guards | None = None,
        groups: tuple[int, ...] | None = None,
        nesting: _native.Nesting | None = None,
        general: "Callable[[], Flow | None]" = lambda: None,
        motion: "Callable[[], Program] | None" = None,
        turns: bool = False,
    ):
        self._motion_program: Callable = (lambda: self.program) if motion is None else motion
        self._parts, self.size, self.numbers, self.guards = functools.cache(parts), size, numbers, guards
        self.groups, self.turns = tuple(range(size)) if groups is None else groups, turns
        self.nesting = nesting or _native.Nesting(size)
        self.general = functools.cache(general)
        self.tangent = functools.lru_cache(maxsize=8)(self._tangent_flow)

    @classmethod
    def from_program(cls, program: Program, size: int, projection=None, guards=None, turns=False) -> "Flow":
        """The flow of a scene's program, with that of its general variant as fallback."""

        def general():
            try:
                other = program.complete
            except Unlowerable:
                return None
            fits = other is not program and other.operations <= forms.LARGEST_PROGRAM
            return cls.from_program(other, size, projection, guards, turns) if fits else None

        numbers = program.size - 2 * size - 1
        return cls(lambda: (program, projection), size, numbers, guards, general=general, turns=turns)

    @property
    def program(self) -> Program:
        """The program of q̈ and the flag that the mass matrix is singular."""
        return self._parts()[0]

    @property
    def projection(self) -> _native.Projection | None:
        """The projection onto the constraints, if there are any."""
        return self._parts()[1]

    @functools.cached_property
    def general_program(self) -> Program:
        """The program that is valid for any mass matrix, if there is one, else the flow's own.

        Without constraints that is the same: all pivots are positive if and only if the mass matrix is.
        """
        if self.projection is None:
            return self.program
        try:
            return self.program.complete
        except Unlowerable:
            return self.program

    @property
    def states(self) -> int:
        return 2 * self.size

    @functools.cached_property
    def reads_time(self) -> bool:
        """True if the motion, or its projection, depends on the time explicitly."""
        programs = [self.general_program, *(self.projection or ())]
        return any(self.states in of.find_inputs(range(len(of.line.outputs))) for of in programs)

    def path_shape(self, times: int, notes: int) -> tuple[int, ...]:
        """The shape of the `path` of a member: states at this many output times, or notes."""
        if self.guards is None or not self.guards.notes:
            return times, self.states
        return len(self.guards.directions) * (notes + 1), self.states + 1

    @functools.cached_property
    def kernel(self) -> _native.Kernel:
        parts = self.program, self.size, self.projection, self.guards, self.groups, self.nesting
        return _native.Kernel(*parts, motion=self._motion_program())

    # ---- forward ----

    def run(self, ts, y0, params, tolerances: Tolerances, begun: _native.RunResults | None = None) -> Solution:
        """Integrate N members: `ts` (N, T) or (1, T), `y0` (N, 2n), `params` (N, P) or (1, P) → a `Solution`.

        Result codes tell what stopped a member, beyond steps that became too small or too many. A run that a handler
        has `begun` is resumed.
        """
        solution, _ = self.run_and_record(ts, y0, params, tolerances, begun=begun)
        if (solution.result != SUCCESSFUL).any():
            solution = self._explain_stops(solution, ts, params)
        finite = np.isfinite(solution.y_end)
        if not finite.all():  # even where it came to the last time
            solution.result[~finite.all(axis=1)] = _NOT_FINITE
        return solution

    def run_and_record(self, ts, y0, params, tolerances, room: int = 0, begun=None) -> tuple[Solution, list[Steps]]:
        """The solution of N members, as by `run` but with raw result codes; and their recorded steps, up to `room`."""
        rtol, atol, max_steps, notes, order = *tolerances[:3], tolerances.notes, tolerances.order
        done = self.kernel.select_width(len(y0))(ts, y0, params, rtol, atol, max_steps, room, begun, notes, order)
        result, found = RESULT_OF_CODE[done.code], []
        solution = Solution(*done[:3], result, done.steps, done.rejected, done.changes, done.idle)
        if done.table is not None and done.complete is not None:
            rows = np.flatnonzero(done.complete)
            counts, order = done.steps[rows], order or _native.choose_order(rtol)
            found.append(Steps(done.table, np.cumsum(counts) - counts, counts, order, self.kernel, rows))
        if not (result == SUCCESSFUL).all():
            again, flow, tolerances = self._members_to_repeat(solution, params, tolerances)
            if again.any():
                some_ts, some_y0, some_params = select_members(again, ts, y0, params)
                better, steps_again = flow.run_and_record(some_ts, some_y0, some_params, tolerances, room)
                for values, new in zip(solution[:-1], better[:-1], strict=True):
                    values[again] = new
                solution, places = solution._replace(idle=done.idle + better.idle), np.flatnonzero(again)
                found = [steps.select_members(~again[steps.rows]) for steps in found]
                found += [steps._replace(rows=places[steps.rows]) for steps in steps_again]
        return solution, [steps for steps in found if len(steps.rows)]

    def _explain_stops(self, solution: Solution, ts, params) -> Solution:
        """The solution with the reasons why members stopped whose steps became too small, or too many."""
        shrank, spent = solution.result == _SHRANK, solution.result == _SPENT
        some = np.flatnonzero(shrank | spent)
        if not some.size:
            return solution
        times, numbers = (x[some] if len(x) > 1 else x for x in (ts, params))
        acceleration = functools.partial(self._accelerations, numbers)
        y_end, t_end, _, accepted, rejected = (x[some] for x in solution[1:6])
        end = End(t_end, y_end, times[:, 0], times[:, -1], accepted, rejected)
        not_finite, jumps = find_stop_flags(acceleration, end, shrank[some], spent[some])
        solution.result[some[jumps]] = _JUMPS
        solution.result[some[not_finite]] = _NOT_FINITE
        return solution

    def _accelerations(self, params, t, y) -> np.ndarray:
        """The accelerations q̈ (N, n) at N states."""
        return self.general_program.evaluate_many([*y.T, t, *params.T])[: self.size].T

    def _members_to_repeat(self, solution, params, tolerances: Tolerances) -> "tuple[np.ndarray, Flow, Tolerances]":
        """The members to run once more, with which flow and which tolerances.

        A program that assumes a regular mass matrix is replaced by the general one, which is long if a recursion in L
        made it short: without constraints, only if that matrix seems singular. And where constraints become dependent,
        as at a dead centre, a step must not end: rounding of q would decide on q̇, or allow no step from there. The
        kernel retries such steps; if that does not help, different step sizes from the start may. If q̈ is finite and
        its series is not, that may be overflow: coefficients of a change at a rate ω grow by ω from order to order, and
        a lower order may help.
        """
        result = solution.result
        overflows = result == _NOT_FINITE
        if overflows.any() and not tolerances.order:
            accelerations = self._accelerations(params, solution.t_end, solution.y_end)
            overflows &= np.isfinite(accelerations).all(axis=1)
            return overflows, self, tolerances._replace(order=_native.LEAST_ORDER)
        given_up = np.isin(result, _GIVEN_UP if self.projection is not None else _SINGULAR)
        if given_up.any() and (general := self.general()) is not None:
            return given_up, general, tolerances
        stuck = result == _NOT_PROJECTED
        if self.projection is not None:
            stuck |= result == _SHRANK
        return stuck & (tolerances.tries > 1), self, tolerances.tighter

    def _tangent_flow(self, directions: int) -> "Flow":
        """The flow of q with its tangents along this many directions, whose δparams are further parameters.

        It has (1 + D) n coordinates and (1 + D) P parameters. A tangent that is zero by symmetry is as exact as the
        other coordinates in its direction, not exact relative to itself: each direction is one group.
        """
        n, rows = self.size, 1 + directions
        groups = self.groups + tuple(n + row for row in range(directions) for _ in range(n))

        def general():
            other = self.general()
            return None if other is None else other.tangent(directions)

        def parts():
            return tangent_programs(self.program, self.projection, n, directions)

        nesting = self.nesting.with_tangents(directions)
        return Flow(parts, rows * n, rows * self.numbers, None, groups, nesting, general, self._motion_program)


def select_members(chosen: np.ndarray, *arrays: np.ndarray) -> list[np.ndarray]:
    """The rows where the mask `chosen` (N,) is true, of each array; an array of one row is shared by all."""
    return [x[chosen] if len(x) == len(chosen) else x for x in arrays]
