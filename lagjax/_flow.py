"""The motion of a scalar program in machine code, for rows of members: it runs, and goes back over its own steps.

A `Flow` maps (output times, initial state, parameters) to the states at those times. Everything here works on NumPy
arrays with one row a member; `_transforms` makes functions of it that JAX can transform. Derivatives are of two kinds.

`push` follows tangents along with the motion: to q belong δq₁ … δq_D, derivatives along D directions (δy0, δparams),
which move by the variational equations

    d²/dt² δq = ∂q̈/∂q δq + ∂q̈/∂q̇ δq̇ + ∂q̈/∂p δp.

They are a program like any other, the *tangent flow*: a derivative is as accurate as the motion. Source: Hairer,
Nørsett & Wanner, *Solving Ordinary Differential Equations I*, §I.14.

`pull` goes back over the steps of the motion itself, each transposed (`_native._adjoint`): its cost does not grow with
the number of parameters. The two agree within the tolerance.
"""

import functools
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax import _native
from lagjax._problem import Solution
from lagjax._program import Program, Unlowerable, evaluate, lower, pullback
from lagjax._results import RESULTS, SUCCESSFUL, code_of
from lagjax._stopped import End, what_stopped

LARGEST_PROGRAM = 6_000  # operations of an acceleration, beyond which LLVM takes too long
_BUDGET = 100_000  # operations of a program with tangents
# Directions that are followed side by side, and coordinates (those of the motion included) that may come of it: more
# share the work on the motion among more tangents, and take LLVM longer.
MOST_DIRECTIONS, MOST_TANGENT_COORDINATES = 8, 40
# Columns of the Jacobian ∂q̈/∂(q, q̇, p) for each direction, up to which the tangents are its products with the
# directions; where there are more, each is derived along its own.
_DENSE = 4
LARGEST_PORTION = 2**23  # numbers of the steps that are written down at once: 64 MiB
LARGEST_KEPT = 2**26  # and of those that are kept for a derivative that is asked for next: half a GiB
# The codes of the kernel, in their order, as results. Beyond `EVENT` they say which guards changed sign.
_RESULT_OF_CODE = np.array([code_of(result) for result in (
    RESULTS.successful, RESULTS.max_steps_reached, RESULTS.dt_min_reached, RESULTS.nonfinite_state,
    RESULTS.mass_matrix_singular, RESULTS.projection_failed, RESULTS.acceleration_discontinuous, RESULTS.event_occurred,
)])  # fmt: skip
_SPENT, _SHRANK, _NOT_FINITE, _SINGULAR, _NOT_PROJECTED, _JUMPS = _RESULT_OF_CODE[1:7].tolist()
_GIVEN_UP = (_SINGULAR, _NOT_FINITE, _SHRANK, _NOT_PROJECTED)  # what another variant of the program may still follow


class Tolerances(NamedTuple):
    """The local error of a step, and what a run may cost."""

    rtol: float
    atol: float
    max_steps: int
    tries: int = 4

    @property
    def perturbed(self) -> "Tolerances":
        """For another try, whose steps end at other places."""
        return self._replace(rtol=0.7 * self.rtol, atol=0.7 * self.atol, tries=self.tries - 1)

    @property
    def with_larger_budget(self) -> "Tolerances":
        """For a motion with its tangents, which takes more steps."""
        return self._replace(max_steps=4 * self.max_steps)


def unfit(program: Program, size: int, dtype) -> str | None:
    """Why there is no machine code for a scene, as the end of a sentence; None where there is."""
    if jax.default_backend() != "cpu":
        return f"the default device is a {jax.default_backend()}"
    if dtype != np.float64:
        return f"the coordinates are {np.dtype(dtype).name}, not float64"
    if program.operations > LARGEST_PROGRAM:
        return f"its acceleration takes {program.operations} operations, more than {LARGEST_PROGRAM}"
    try:
        _native.recurrences(program, size)
    except Unlowerable as reason:
        return str(reason)
    return None


# ---- the steps of runs, kept for their transposes --------------------------------------------------------------------


class Steps(NamedTuple):
    """The steps of a run of N members by one flow.

    A row of `table` holds the time, the size and the first state of a step; those of a member are `counts` (N,) rows
    from `first` (N,) on. `complete` (N,) is false for a member that took more steps than there was room for.
    """

    flow: "Flow"
    order: int
    table: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    complete: np.ndarray


class StepStore:
    """Steps by the number of their run; the oldest are dropped when all together exceed `limit` numbers.

    A ticket is run · 2³² + member: an integer that travels through the residuals of a derivative, so that the transpose
    finds the steps that belong to it, or knows that they are gone and follows the motion once more.
    """

    _runs = itertools.count()  # of all stores: a ticket of one means nothing to another

    def __init__(self, limit: float = float("inf")):
        self.limit = limit
        self._steps: OrderedDict[int, Steps] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, steps: Steps) -> np.ndarray:
        """The tickets of the members, −1 for those that are not complete."""
        with self._lock:
            run = next(self._runs)
            self._steps[run] = steps
            while len(self._steps) > 1 and sum(kept.table.size for kept in self._steps.values()) > self.limit:
                self._steps.popitem(last=False)
        return np.where(steps.complete, run * 2**32 + np.arange(len(steps.first)), -1)

    def runs(self, tickets: np.ndarray) -> Iterator[tuple[Steps, np.ndarray, np.ndarray]]:
        """For every run that is here: its steps, which of the tickets are its members, and which members."""
        for run in np.unique(tickets[tickets >= 0] >> 32).tolist():
            with self._lock:
                steps = self._steps.get(run)
            if steps is not None:
                places = np.flatnonzero(tickets >> 32 == run)
                yield steps, places, tickets[places] & (2**32 - 1)


KEPT = StepStore(LARGEST_KEPT)


# ---- flows -----------------------------------------------------------------------------------------------------------


class Flow:
    """The flow of a program for q̈ with n coordinates.

    `parts` gives the program, which takes q, q̇, t and then the P parameters and gives q̈ and whether the mass matrix is
    singular, and the projection that keeps the motion on its constraints, or None. It is called when machine code is
    first needed. `guards` end a motion early. `groups` (n,) numbers the coordinates whose errors are measured together,
    and the first `base_size` coordinates are the motion, the others tangents of it. `general` gives the flow of the
    variant for any mass matrix: members that the regular variant cannot follow start again with it.
    """

    def __init__(
        self,
        parts: Callable[[], tuple[Program, _native.Projection | None]],
        size: int,
        numbers: int,
        guards: _native.Guards | None = None,
        groups: tuple[int, ...] | None = None,
        base_size: int | None = None,
        general: "Callable[[], Flow | None]" = lambda: None,
    ):
        self._parts, self.size, self.numbers, self.guards = functools.cache(parts), size, numbers, guards
        self.groups = tuple(range(size)) if groups is None else groups
        self.base_size = size if base_size is None else base_size
        self.general = functools.cache(general)
        self.tangent = functools.lru_cache(maxsize=8)(self._tangent)

    @classmethod
    def of(cls, program: Program, size: int, projection=None, guards=None) -> "Flow":
        """The flow of a scene's program, with that of its general variant behind it."""

        def general():
            try:
                other = program.complete
            except Unlowerable:
                return None
            fits = other is not program and other.operations <= LARGEST_PROGRAM
            return cls.of(other, size, projection, guards) if fits else None

        return cls(lambda: (program, projection), size, program.size - 2 * size - 1, guards, general=general)

    @property
    def program(self) -> Program:
        """q̈ and whether the mass matrix is singular."""
        return self._parts()[0]

    @property
    def projection(self) -> _native.Projection | None:
        """The way back to the constraints, where there are some."""
        return self._parts()[1]

    @functools.cached_property
    def anywhere(self) -> Program:
        """The program that holds for any mass matrix, if there is one, else the flow's own."""
        try:
            return self.program.complete
        except Unlowerable:
            return self.program

    @property
    def states(self) -> int:
        """Numbers in a state: q, then q̇."""
        return 2 * self.size

    @functools.cached_property
    def kernel(self) -> _native.Kernel:
        """The machine code."""
        return _native.Kernel(self.program, self.size, self.projection, self.guards, self.groups, self.base_size)

    # ---- forward ----

    def run(
        self, ts, y0, params, tolerances: Tolerances, store: StepStore | None = None, room: np.ndarray | None = None
    ) -> Solution:
        """`ts` (N, T) or (1, T), `y0` (N, 2n), `params` (N, P) or (1, P) → the motions of N members.

        With a `store` the steps are kept there, up to `room` (N,) of each member: by default to equal parts of what may
        be kept. Results tell what stopped a member, and not only that its steps became too small, or too many.
        """
        solution = self._explained(self._followed(ts, y0, params, tolerances, store, room), ts, params)
        overflowed = ~np.isfinite(solution.y_end).all(axis=1)  # even where it came to the last time
        solution.result[overflowed] = _NOT_FINITE
        return solution

    def _followed(self, ts, y0, params, tolerances, store=None, room=None) -> Solution:
        """`run` without a look at what stopped a member: for another try, and for derivatives."""
        rtol, atol, max_steps, _ = tolerances
        if store is not None and room is None:
            room = np.full(len(y0), min(max_steps, LARGEST_KEPT // ((self.states + 2) * max(1, len(y0)))))
        done = self.kernel(ts, y0, params, rtol, atol, max_steps, room)
        result, event = _RESULT_OF_CODE[np.minimum(done.code, _native.EVENT)], np.maximum(done.code - _native.EVENT, 0)
        ticket = np.full(len(y0), -1)
        if store is not None:
            ticket = store.keep(self._compact(done.table, room, done.steps, rtol))
        solution = Solution(*done[:3], result, done.steps, done.rejected, event, ticket, done.idle)
        again, flow, tolerances = self._second_chance(result, tolerances)
        if not again.any():
            return solution
        some = _members(again, ts, y0, params)
        better = flow._followed(*some, tolerances, store, None if room is None else room[again])
        for values, new in zip(solution[:-1], better[:-1], strict=True):
            values[again] = new
        return solution._replace(idle=done.idle + better.idle)

    def _explained(self, solution: Solution, ts, params) -> Solution:
        """The solution with what stopped the members whose steps became too small, or too many."""
        shrank, spent = solution.result == _SHRANK, solution.result == _SPENT
        some = np.flatnonzero(shrank | spent)
        if not some.size:
            return solution
        times, numbers = (x[some] if len(x) > 1 else x for x in (ts, params))

        def acceleration(t, y):
            values = self.anywhere.evaluate(*y.T, t, *numbers.T)[: self.size]
            return np.stack([np.broadcast_to(value, t.shape) for value in values], axis=-1)

        counts = solution.accepted[some], solution.rejected[some]
        end = End(solution.t_end[some], solution.y_end[some], times[:, 0], times[:, -1], *counts)
        not_finite, jumps = what_stopped(acceleration, end, shrank[some], spent[some])
        solution.result[some[jumps]] = _JUMPS
        solution.result[some[not_finite]] = _NOT_FINITE
        return solution

    def _compact(self, table, room, counts, rtol: float) -> Steps:
        """The steps of a run, without the room that was not used."""
        taken, starts = np.minimum(counts, room), np.cumsum(room) - room
        if not np.array_equal(taken, room):
            table = np.concatenate([table[:0], *(table[s : s + k] for s, k in zip(starts, taken, strict=True))])
        return Steps(self, _native.order_for(rtol), table, np.cumsum(taken) - taken, counts, counts <= room)

    def _second_chance(self, result, tolerances: Tolerances) -> "tuple[np.ndarray, Flow, Tolerances]":
        """The members to run once more, by which flow and with which tolerances.

        A program that assumes a regular mass matrix gives way to one that does not. And where constraints become
        dependent, as at a dead centre, a step must not end: rounding of q would decide on q̇, or allow no step from
        there. The kernel takes such steps again; where that does not help, steps of other sizes all along may.
        """
        if (result == SUCCESSFUL).all():
            return np.zeros(len(result), bool), self, tolerances
        given_up = np.isin(result, _GIVEN_UP)
        if given_up.any() and (general := self.general()) is not None:
            return given_up, general, tolerances
        stuck = result == _NOT_PROJECTED
        if self.projection is not None:
            stuck |= result == _SHRANK
        return stuck & (tolerances.tries > 1), self, tolerances.perturbed

    def push(self, ts, y0, params, dy0, dparams, tolerances: Tolerances) -> tuple[np.ndarray, np.ndarray]:
        """The derivative of `run` along m directions for each of N members, between fixed times.

        `dy0` (N, m, 2n), `dparams` (N, m, P) → δpath (N, m, T, 2n), NaN where the motion did not come, and δy_end
        (N, m, 2n), NaN where it failed.
        """
        members, m = dy0.shape[:2]
        widest = max(1, min(MOST_DIRECTIONS, MOST_TANGENT_COORDINATES // self.size - 1))
        groups = -(-m // widest)
        directions = -(-m // groups)
        padding = ((0, 0), (0, groups * directions - m), (0, 0))
        dy0, dparams = (np.pad(x, padding).reshape(members * groups, directions, -1) for x in (dy0, dparams))
        length = np.abs(np.concatenate([dy0, dparams], axis=2)).max(axis=2, initial=0.0, keepdims=True)
        unit = np.where(length > 0, length, 1.0)
        y0, params = (np.repeat(x, groups, axis=0) for x in (y0, _for_all(params, members)))
        ts = ts if len(ts) == 1 else np.repeat(ts, groups, axis=0)
        start = np.concatenate([y0[:, None], dy0 / unit], axis=1)  # (rows, 1 + D, 2n)
        numbers = np.concatenate([params[:, None], dparams / unit], axis=1).reshape(len(start), -1)
        flow = self.tangent(directions)
        solution = flow._followed(ts, from_rows(start), numbers, tolerances.with_larger_budget)
        lengths = unit.reshape(len(start), directions, 1)
        path, end = (to_rows(x, self.size)[..., 1:, :] for x in (solution.path, solution.y_end))
        path, end = path * lengths[:, None], end * lengths
        end[solution.result != SUCCESSFUL] = np.nan
        path = np.moveaxis(path, -2, 1).reshape(members, groups * directions, *path.shape[1:-2], self.states)
        return path[:, :m], end.reshape(members, groups * directions, self.states)[:, :m]

    # ---- back ----

    def pull(self, ts, y0, params, solution, path_bar, end_bar, tolerances: Tolerances) -> tuple[np.ndarray, ...]:
        """The transpose of `push`: from m cotangents of the outputs of each of N motions to those of what went in.

        `solution` is (path, result, accepted, ticket) of the run; `path_bar` (N, m, T, 2n) and `end_bar` (N, m, 2n) →
        cotangents of `y0` (N, m, 2n) and of `params` (N, m, P). A cotangent that is not zero, of an output that was
        not reached or of the end of a motion that failed, makes all of them NaN: there is no derivative.
        """
        path, result, accepted, ticket = solution
        members, m = end_bar.shape[:2]
        if m > self.states + self.numbers and self.size * (1 + self.states + self.numbers) <= MOST_TANGENT_COORDINATES:
            return self._pull_by_tangents(ts, y0, params, path_bar, end_bar, tolerances)
        reached = np.isfinite(path)[:, None]
        lost = ((path_bar != 0) & ~reached).any(axis=(2, 3))
        lost |= (end_bar != 0).any(axis=2) & (result != SUCCESSFUL)[:, None]
        path_bar = np.where(reached, path_bar, 0.0)
        params = _for_all(params, members)
        params_bar = np.zeros((members, m, self.numbers))
        if self.projection is not None and path.shape[1] > 2:
            self._off_the_constraints(ts, path, params, path_bar, params_bar)
        done = (result == SUCCESSFUL)[:, None, None]
        end_bar = end_bar + np.where(done, path_bar[:, :, -1], 0.0)
        path_bar[:, :, -1] = 0.0

        rows = np.repeat(np.arange(members), m)
        ts = ts if len(ts) == 1 else ts[rows]
        y_bar, more = self._pull_rows(
            ts, y0[rows], params[rows], accepted[rows], ticket[rows], path_bar.reshape(members * m, *path.shape[1:]),
            end_bar.reshape(members * m, -1), tolerances,
        )  # fmt: skip
        y_bar, more = y_bar.reshape(members, m, -1), more.reshape(members, m, -1) + params_bar
        y_bar[lost], more[lost] = np.nan, np.nan
        return y_bar, more

    def _pull_rows(self, ts, y0, params, accepted, ticket, path_bar, end_bar, tolerances) -> tuple[np.ndarray, ...]:
        """One cotangent a row, over the steps that are kept; members whose steps are gone are followed once more."""
        y_bar, params_bar = np.full(end_bar.shape, np.nan), np.full((len(y0), self.numbers), np.nan)
        waiting = np.ones(len(y0), bool)

        def back(store: StepStore, tickets, places):
            for steps, some, members in store.runs(tickets):
                rows = places[some]
                y_bar[rows], params_bar[rows] = steps.flow.kernel.pull(
                    ts if len(ts) == 1 else ts[rows], params[rows], steps.table, steps.first[members],
                    steps.counts[members], path_bar[rows], end_bar[rows], steps.order,
                )  # fmt: skip
                waiting[rows] = False

        back(KEPT, ticket, np.arange(len(y0)))
        for places in _portions(np.flatnonzero(waiting), accepted * (self.states + 2)):
            store = StepStore()
            some_ts = ts if len(ts) == 1 else ts[places]
            again = self._followed(some_ts, y0[places], params[places], tolerances, store, accepted[places])
            back(store, again.ticket, places)
        at_start = (ts == ts[:, :1])[:, :, None]  # outputs that are the initial state; steps begin after them
        return y_bar + np.sum(path_bar * at_start, axis=1), params_bar

    def _pull_by_tangents(self, ts, y0, params, path_bar, end_bar, tolerances) -> tuple[np.ndarray, ...]:
        """The same where there are more cotangents than numbers that vary: from the whole Jacobian."""
        inputs = self.states + self.numbers
        unit = np.broadcast_to(np.eye(inputs), (len(y0), inputs, inputs))
        path, end = self.push(ts, y0, params, unit[..., : self.states], unit[..., self.states :], tolerances)
        used = np.einsum("nmts,nrts->nmr", path_bar, np.where(np.isfinite(path), path, 0.0))
        used += np.einsum("nms,nrs->nmr", end_bar, np.where(np.isfinite(end), end, 0.0))
        lost = ((path_bar != 0) & ~np.isfinite(path).all(axis=1)[:, None]).any(axis=(2, 3))
        lost |= ((end_bar != 0) & ~np.isfinite(end).all(axis=1)[:, None]).any(axis=2)
        used[lost] = np.nan
        return used[..., : self.states], used[..., self.states :]

    def _off_the_constraints(self, ts, path, params, path_bar, params_bar) -> None:
        """Through the projection that put the outputs between the first and the last on the constraints; in place.

        It squares the distance to them: its derivative at the projected state is that at the state before.
        """
        members, m, times, _ = path_bar.shape
        place = np.broadcast_to(np.where(np.isfinite(path), path, path[:, :1])[:, None, 1:-1],
                                (members, m, times - 2, self.states))  # fmt: skip
        t = np.broadcast_to(ts[:, None, 1:-1], place.shape[:-1])
        numbers = np.broadcast_to(params[:, None, None], (*place.shape[:-1], self.numbers))
        columns = [x.reshape(-1, x.shape[-1]).T for x in (place, t[..., None], numbers, path_bar[:, :, 1:-1])]
        back = np.stack(evaluate(self._projection_pullback, np.concatenate(columns)), axis=-1)
        back = back.reshape(*place.shape[:-1], -1)
        path_bar[:, :, 1:-1] = back[..., : self.states]
        params_bar += back[..., self.states :].sum(axis=2)

    @functools.cached_property
    def _projection_pullback(self):
        """From (q, q̇, t, params) and the cotangent of the projected state to those of the state and of params."""
        program = self.projection.state
        by = [i for i in range(program.size) if i != self.states]
        return pullback(program.line, [np.dtype(float)] * program.size, by, range(self.states))

    # ---- tangents ----

    def _tangent(self, directions: int) -> "Flow":
        """The flow of q and of its derivatives along so many directions, whose δparams are numbers of it.

        It has (1 + D) n coordinates and (1 + D) P parameters. A tangent that is zero by symmetry is as exact as the
        other coordinates in its direction, not exact relative to itself: each direction is one group.
        """
        n, rows = self.size, 1 + directions
        groups = self.groups + tuple(n + row for row in range(directions) for _ in range(n))

        def general():
            other = self.general()
            return None if other is None else other.tangent(directions)

        parts = functools.partial(_tangent_parts, self, rows)
        return Flow(parts, rows * n, rows * self.numbers, None, groups, self.base_size, general)


def from_rows(y):
    """States (..., 2 · rows · n), all q and then all q̇, from rows (..., rows, 2n): the motion, then its tangents."""
    rows, n = y.shape[-2], y.shape[-1] // 2
    return y.reshape(*y.shape[:-1], 2, n).swapaxes(-3, -2).reshape(*y.shape[:-2], 2 * rows * n)


def to_rows(y, n: int):
    """Rows (..., rows, 2n) from the states of a tangent flow over n coordinates."""
    rows = y.shape[-1] // (2 * n)
    return y.reshape(*y.shape[:-1], 2, rows, n).swapaxes(-3, -2).reshape(*y.shape[:-1], rows, 2 * n)


def _tangent_parts(base: Flow, rows: int) -> tuple[Program, _native.Projection | None]:
    """The program and the projection of the motion and of its tangents, whose arguments have one row for each."""
    n = base.size

    def with_tangents(function, q, v, t, p):
        """`function(q, v, t, p)` at the first rows, and its derivative along each of the others."""

        def along(*direction):
            return jax.jvp(lambda q, v, p: function(q, v, t, p), (q[0], v[0], p[0]), direction)[1]

        if 2 * n + base.numbers > _DENSE * (rows - 1):
            tangents = jax.vmap(along)(q[1:], v[1:], p[1:])
        else:
            by_q, by_v, by_p = jax.jacfwd(function, argnums=(0, 1, 3))(q[0], v[0], t, p[0])
            tangents = q[1:] @ by_q.T + v[1:] @ by_v.T + p[1:] @ by_p.T
        return jnp.concatenate([function(q[0], v[0], t, p[0])[None], tangents])

    def accelerations(q, v, t, p):
        return jnp.stack(base.program(*q, *v, t, *p)[:n])

    def moving(q, v, t, p):
        return with_tangents(accelerations, q, v, t, p), base.program(*q[0], *v[0], t, *p[0])[n]

    shapes = [jax.ShapeDtypeStruct(shape, np.float64) for shape in ((rows, n), (rows, n), (), (rows, base.numbers))]
    program = lower(moving, *shapes, budget=_BUDGET)
    if base.projection is None:
        return program, None
    state, speeds = base.projection

    def projected(q, v, t, p):
        both = with_tangents(lambda q, v, t, p: jnp.stack(state(*q, *v, t, *p)), q, v, t, p)
        return both[:, :n], both[:, n:]

    def velocity_scales(q, v, t, p):
        return speeds(*q[0], *v[0], t, *p[0])

    return program, _native.Projection(*(lower(of, *shapes, budget=_BUDGET) for of in (projected, velocity_scales)))


# ---- rows ------------------------------------------------------------------------------------------------------------


def _members(chosen, *arrays) -> list[np.ndarray]:
    """The chosen rows of each array; an array of one row is shared by all."""
    return [x[chosen] if len(x) == len(chosen) else x for x in arrays]


def _for_all(x: np.ndarray, rows: int) -> np.ndarray:
    """One row shared by all as a row for each."""
    return np.broadcast_to(x, (rows, *x.shape[1:])) if len(x) == 1 else x


def _portions(places: np.ndarray, numbers: np.ndarray) -> list[np.ndarray]:
    """The places in portions that need no more than `LARGEST_PORTION` numbers together, or just one place."""
    if not len(places):
        return []
    portion = np.cumsum(numbers[places]) // LARGEST_PORTION
    return np.split(places, np.flatnonzero(np.diff(portion)) + 1)
