"""Motions of many starts with their derivatives, and the starts that are functions of something else.

**Motions.** What a fit asks of an engine: rows of starts (N, 2n), each with times of its own (N, T), one vector of
parameters (P,), and for each row a table of inputs where the scene has some. It gives the states (N, T, 2n) and how
they move along D directions (N, D, T, 2n) of the starts and the parameters together. Machine code follows all
directions over the steps of the motion, without a program of XLA, so that another number of rows or times compiles
nothing; other engines and hybrid motion go through `jax.jvp` of `simulate`, the plain path that this one is tested
against.

**Starts.** `Origins` are those that are functions of the parameters, `Manifold` those on constraints, and on contacts
that are closed. There a start has fewer directions than numbers. The unknown is any state y near them, and the motion
begins at the consistent state P(y) nearest to it (`System.project`): what a step of the search leaves of the
constraints is taken back, its derivative is that along them, and a direction across them changes nothing.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import Problem, Solution, choose
from lagjax._engine.taylor import (
    Flow,
    MachineCode,
    Motions,
    Tolerances,
    flow_of,
    jvp,
    project_start_tangents,
    tolerances_of,
)
from lagjax._equations import has_constraints
from lagjax._fit.model._inputs import InputForm, SampleTable, constant_tables, input_functions
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._records import start_pair
from lagjax._interface import ENDED_WELL, Layout, halves
from lagjax._native import Projection
from lagjax._primitives import sentence
from lagjax._run import simulate
from lagjax._run.hybrid import Scene, begin_in, first_law, may_jump
from lagjax._scene import ContactParams, Contacts, ContactScene, DrivenParams, FlatContacts, System


class RecordMotion(NamedTuple):
    """N motions: `path` (N, T, 2n), `tangents` (N, D, T, 2n), and how each ended: `result`, `t_end` (N,), `y_end`; and
    the solution of an engine that can add tangents later."""

    path: np.ndarray
    tangents: np.ndarray
    result: np.ndarray
    t_end: np.ndarray
    y_end: np.ndarray
    solution: Solution | None = None

    @property
    def ok(self) -> bool:
        return bool(np.isin(self.result, ENDED_WELL).all() and np.isfinite(self.tangents).all())

    def describe_failure(self, ts: np.ndarray, layout: Layout) -> tuple[int, str]:
        failed = ~np.isin(self.result, ENDED_WELL)
        if not failed.any():
            row = int(np.argmin(np.isfinite(self.tangents).all(axis=(1, 2, 3))))
            return row, "Its derivatives are not finite."
        row = int(np.argmax(failed))
        return row, sentence(self.result[row], self.t_end[row], ts[row, -1], self.y_end[row], layout.names) or ""


class AbstractMotions(abc.ABC):
    """Followers of motions and their tangents; `projection` puts states on the constraints by machine code. `splits`:
    motions without tangents cost less, and need no other program."""

    projection: Projection | None = None
    splits = False

    @abc.abstractmethod
    def follow(
        self, ts: np.ndarray, y0: np.ndarray, numbers: np.ndarray, y0_dot: np.ndarray, numbers_dot: np.ndarray,
        table: SampleTable | None = None, modes: np.ndarray | None = None, known: Solution | None = None,
    ) -> RecordMotion:  # fmt: skip
        """The motions from `y0` (N, 2n) at `ts` (N, T), with parameters `numbers` (N, P) and a table of inputs a row.

        Tangents go along `y0_dot` (N, D, 2n) and `numbers_dot` (N, D, P); their solution may be `known`. Hybrid motions
        begin in the `modes` (N,).
        """

    @abc.abstractmethod
    def rate(self, t: np.ndarray, y: np.ndarray, numbers: np.ndarray, table: SampleTable | None = None) -> np.ndarray:
        """q̈ (M, n) at M states `y` (M, 2n) and times `t` (M,), with parameters (M, P) and a table of inputs each."""


def step_budget(samples: int) -> int:
    """The budget of steps of a motion with this number of samples of inputs, at each of which a step ends."""
    return 65_536 + 8 * samples


def choose_motions(
    system: Scene, layout: Layout, parameters: Parameters, rtol: float, form: InputForm | None
) -> AbstractMotions:
    form = form if input_functions(system) else None  # inputs that only sensors ask for, or nothing
    scene = system if form is None else form.drive_scene(system)
    if not isinstance(scene, System) or may_jump(scene):
        return _JaxMotions(scene, layout, parameters, {"rtol": rtol}, form is not None)

    def problem(room: int) -> Problem:
        params = parameters.restore(parameters.example)
        params = params if form is None else form.params(params, room)
        return Problem.from_system(scene, layout, params, rtol=rtol, max_steps=step_budget(room))

    if isinstance(choose(problem(2)).engine, MachineCode):
        return _MachineCodeMotions(problem, form is not None)
    options = {"rtol": rtol, "adjoint": diffrax.ForwardMode()}
    return _JaxMotions(scene, layout, parameters, options, form is not None)


class _MachineCodeMotions(AbstractMotions):
    splits = True

    def __init__(self, problem: Callable[[int], Problem], is_driven: bool):
        """`problem(room)` is about the scene with tables of inputs of this many instants."""
        self.problem, self.is_driven = problem, is_driven
        self.projection = None if is_driven else flow_of(problem(2)).projection

    def _flow(self, numbers: np.ndarray, table: SampleTable | None) -> tuple[Flow, np.ndarray, Tolerances]:
        """The flow of the scene with inputs of this room, made once for all that are equal, and its parameters."""
        room = 2
        if table is not None and self.is_driven:
            room, numbers = table.room, table.rows(numbers)
        problem = self.problem(room)
        return flow_of(problem), numbers, tolerances_of(problem)

    def follow(self, ts, y0, numbers, y0_dot, numbers_dot, table=None, modes=None, known=None):
        flow, params, tolerances = self._flow(numbers, table)
        run = known or flow.run(ts, y0, params, tolerances)
        if not y0_dot.shape[1] or not np.isin(run.result, ENDED_WELL).all():  # a lost motion needs no tangents
            none = np.zeros((len(y0), 0, *run.path.shape[1:]))
            return RecordMotion(run.path, none, run.result, run.t_end, run.y_end, run)
        params_dot = np.zeros((*y0_dot.shape[:2], params.shape[1]))
        params_dot[..., : numbers.shape[-1]] = numbers_dot
        tangents, _ = jvp(flow, Motions.from_solution(ts, y0, params, run), y0_dot, params_dot, tolerances)
        return RecordMotion(run.path, tangents, run.result, run.t_end, run.y_end, run)

    def rate(self, t, y, numbers, table=None):
        flow, params, _ = self._flow(numbers, table)
        return flow.general_program.evaluate_many([*y.T, t, *params.T])[: flow.size].T


class _JaxMotions(AbstractMotions):
    """The tangents of hybrid motion, and of diffrax, by `jax.jvp`."""

    def __init__(
        self, scene: Scene, layout: Layout, parameters: Parameters, options: dict[str, Any], is_driven: bool = False
    ):
        unfree = [leaf for leaf in parameters.leaves if not hasattr(leaf, "shape")]
        if unfree:
            raise TypeError(f"params0 may only hold numbers where the scene has no machine code; got {unfree[0]!r}.")
        leaves = tuple((np.shape(leaf), np.asarray(leaf).dtype) for leaf in parameters.leaves)
        key = scene, layout, parameters.tree, leaves, tuple(options.items()), is_driven
        try:
            self._follow, self._rate = _programs_once(*key)
        except TypeError:  # its functions hold arrays
            self._follow, self._rate = _programs_once.__wrapped__(*key)
        self.dtype = layout.dtype

    def follow(self, ts, y0, numbers, y0_dot, numbers_dot, table=None, modes=None, known=None):
        arrays = *jax.tree.map(self._array, (ts, y0, numbers, y0_dot, numbers_dot, table)), modes
        (path, result, t_end, y_end), tangents = jax.tree.map(np.asarray, self._follow(*arrays))
        return RecordMotion(path.astype(float), tangents.astype(float), result, t_end, y_end)

    def rate(self, t, y, numbers, table=None):
        return np.asarray(self._rate(*jax.tree.map(self._array, (t, y, numbers, table))), float)

    def _array(self, x) -> np.ndarray:
        return np.asarray(x, self.dtype)


@functools.lru_cache(maxsize=16)
def _programs_once(scene: Scene, layout: Layout, tree, leaves: tuple, options: tuple, is_driven: bool):
    """The motions with their tangents and the accelerations of many rows: compiled once for the fits of a scene."""
    none = np.zeros(0)
    restore = Parameters([np.zeros(*leaf) for leaf in leaves], tree, none, none, none, (), ()).restore

    def scene_params(numbers, table):
        params = restore(numbers)
        return DrivenParams(params, table) if is_driven else params

    def run(state, ts, table, mode):
        y0, numbers = state
        q, qdot = map(layout.restore, halves(y0))
        trajectory = simulate(
            begin_in(scene, mode),
            q,
            qdot,
            ts,
            scene_params(numbers, table),
            throw=False,
            max_steps=step_budget(table.knots.size if is_driven else 0),
            **dict(options),
        )
        rows = jax.vmap(lambda q, v: jnp.concatenate([layout.flatten(q), layout.flatten(v)]))
        end = jnp.concatenate([layout.flatten(trajectory.end.q), layout.flatten(trajectory.end.qdot)])
        path = rows(trajectory.q, trajectory.qdot)
        return path, (path, trajectory.result._value, trajectory.end.t, end)

    def run_with_tangents(ts, y0, numbers, y0_dot, numbers_dot, table, mode):
        def tangent(*dot):
            return jax.jvp(lambda state: run(state, ts, table, mode)[0], ((y0, numbers),), (dot,))[1]

        return run((y0, numbers), ts, table, mode)[1], jax.vmap(tangent)(y0_dot, numbers_dot)

    def rate(t, y, numbers, table):
        q, qdot = map(layout.restore, halves(y))
        return layout.flatten(first_law(scene).acceleration(q, qdot, t, scene_params(numbers, table)))

    return jax.jit(jax.vmap(run_with_tangents)), jax.jit(jax.vmap(rate))


_DEEP = 1e-9  # times the largest number of a state: of gaps that are negative by more than rounding
_STEPS, _STILL = 30, 1e-13  # of Newton's method, which squares the distance; and the change at which it has ended


class Origins:
    """The pieces whose starts are functions of the parameters, and these functions, compiled once."""

    def __init__(self, starts: list, layout: Layout, restore: Callable[[Any], Any]):
        """`starts` is what the record of each piece says of its start; None where the piece begins later. `restore`
        makes parameters of their numbers."""

        def compile_start(function):
            def state(numbers):
                q, qdot = start_pair(function, restore(numbers))
                return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

            return jax.jit(lambda numbers: (state(numbers), jax.jacfwd(state)(numbers)))

        functions = {start: compile_start(start) for start in starts if callable(start)}
        self.functions = {k: functions[start] for k, start in enumerate(starts) if callable(start)}
        self.dtype = layout.dtype

    def move(self, starts: np.ndarray, numbers: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The starts (N, 2n) at parameters `numbers` (N, P), and tangents (N, L, 2n) along `directions` (N, L, P)."""
        starts, moved = starts.copy(), np.zeros((*directions.shape[:2], starts.shape[1]))
        for k, function in self.functions.items():
            starts[k], slopes = (np.asarray(x, float) for x in function(numbers[k].astype(self.dtype)))
            moved[k] = directions[k] @ slopes.T
        return starts, moved


class Manifold:
    """The states that satisfy the constraints of a scene: by the projection of its machine code, else by `project`. The
    first, a step of Newton's method that is taken until nothing changes, needs no compilation.

    Of a scene with contacts those where the gaps that are closed stay zero, what sticks is at rest, and the other gaps
    are not negative.
    """

    def __init__(
        self, system: System, layout: Layout, parameters: Parameters, projection: Projection | None,
        form: InputForm | None = None,
    ):  # fmt: skip
        """`form` is that of the inputs of a scene that asks for them, but not in its constraints."""
        scene = system if form is None else form.drive_system(system)

        def scene_params(numbers, table):
            params = parameters.restore(numbers)
            return params if form is None else DrivenParams(params, table)

        def project(y: jax.Array, t, numbers, table, held) -> jax.Array:
            params = scene_params(numbers, table)
            if scene.touches:
                return _project_onto_contacts(scene, layout, y, t, params, held)
            q, qdot = map(layout.restore, halves(y))
            q, qdot = scene.project(q, qdot, t, params)
            return jnp.concatenate([layout.flatten(q), layout.flatten(qdot)])

        def measure(y, t, numbers, table, noise):
            params = scene_params(numbers, table)

            def values(y):
                return _contact_values(FlatContacts.from_system(scene, layout, params), y, t, params)

            reach = jax.tree.map(
                lambda slopes: jnp.sqrt((slopes * noise) ** 2 @ jnp.ones(y.size)), jax.jacfwd(values)(y)
            )
            return values(y), reach

        def project_with_derivatives(*arguments):
            return project(*arguments), *jax.jacfwd(project, argnums=(0, 2))(*arguments)

        self._project = jax.jit(project_with_derivatives)  # one by one: compilation for many rows takes seconds
        self._measure, self.touches, self.constrained = jax.jit(measure), scene.touches, has_constraints(scene)
        self.projection, self.dtype = None if scene.touches else projection, layout.dtype

    def project(
        self, y: np.ndarray, t: np.ndarray, numbers: np.ndarray, directions: np.ndarray, inputs: np.ndarray, modes: list
    ) -> tuple:
        """Consistent states near `y` (N, 2n) at the times `t` (N,), NaN without one, with their derivatives by y (N,
        2n, 2n) and along directions (N, L, P) of the parameters (N, P), which are (N, L, 2n); `inputs` (N, I) are those
        at these times, `modes` those of the pieces."""
        if self.projection is not None:
            return _project_by_newton(self.projection, y, t, numbers, directions)
        rows = []
        for row, mode in zip(self._rows(y, t, numbers, inputs), modes, strict=True):
            held = np.zeros(0)
            if self.touches:
                (gaps, _, rough), _ = self._measure(*row, np.zeros_like(row[0]))
                held = np.array(mode or (0,) * (len(gaps) + len(rough)), float)
                if not (self.constrained or held.any() or (np.asarray(gaps) < 0).any()):
                    rows.append((row[0], np.eye(y.shape[1]), np.zeros((y.shape[1], numbers.shape[1]))))
                    continue
            rows.append(self._project(*row, held))
        starts, by_y, by_numbers = (np.stack([np.asarray(x, float) for x in part]) for part in zip(*rows, strict=True))
        return starts, by_y, np.einsum("nip,nlp->nli", by_numbers, directions)

    def possible_modes(self, y, t, numbers, inputs, noise: np.ndarray) -> list[list[tuple[int, ...]]]:
        """The modes (see `Piece`) that states `y` (N, 2n) may have within their `noise` (N, 2n): all contacts open,
        those that may be closed closed, and all of these that may stick sticking."""
        found = []
        for row, near in zip(self._rows(y, t, numbers, inputs), noise, strict=True):
            close = [np.abs(x) <= r for x, r in zip(*jax.tree.map(np.asarray, self._measure(*row, near)), strict=True)]
            closed, sticks = (close[0] & close[1]).astype(int), close[2].all(axis=1).astype(int)
            modes = [
                np.append(c, s).tolist() for c, s in ((0, 0), (1, 0), (1, 1)) for c, s in [(c * closed, s * sticks)]
            ]
            found.append(list(dict.fromkeys(map(tuple, modes if closed.any() else modes[:1]))))
        return found

    def _rows(self, y, t, numbers, inputs):
        table = constant_tables(t, inputs)
        y, t, numbers, *table = (np.asarray(x, self.dtype) for x in (y, t, numbers, *table))
        return [(*row, SampleTable(k, v)) for *row, k, v in zip(y, t, numbers, *table, strict=True)]


def _contact_values(flat: FlatContacts, y: jax.Array, t, params) -> tuple:
    """Gaps and one-way velocities (k,), the rates of gaps, zero for the others, and slips (r, d)."""
    (q, v), kind = halves(y), y.dtype
    gaps, rates = jax.jvp(lambda q, t: flat.gaps(q, t, params), (q, t), (v, jnp.ones((), kind)))
    one_way = flat.one_way(q, v, t, params)
    return jnp.append(gaps, one_way), jnp.append(rates, jnp.zeros_like(one_way)), flat.slips(q, v, t, params)


def _project_onto_contacts(scene: System, layout: Layout, y: jax.Array, t, params, held: jax.Array) -> jax.Array:
    """The state nearest to y where what is `held` (k + r,) stays, and no other gap is negative: these are opened
    without a change of velocities. Of a gap that only rounding makes negative the derivatives are those of y."""
    flat, (q, v) = FlatContacts.from_system(scene, layout, params), halves(y)
    closed, sticks = jnp.split(held, [flat.shapes.count])
    gaps = flat.gaps(q, t, params)

    def nearest(q, v, closed):
        inside = ContactParams(
            params,
            Contacts(closed, sticks, jnp.ones((sticks.size, flat.shapes.directions)), jnp.zeros(0), jnp.ones(())),
        )
        return ContactScene(scene)._motion(layout, inside).nearest_consistent(q, v, t, inside)

    within, _ = nearest(q, v, closed.at[: gaps.size].max(gaps < 0))
    found = jnp.concatenate(nearest(within, v, closed))
    deep = held.any() | (gaps < -_DEEP * jnp.abs(y).max()).any() | has_constraints(scene)
    return jnp.where(deep, found, y + jax.lax.stop_gradient(found - y))


def _project_by_newton(projection: Projection, y: np.ndarray, t: np.ndarray, numbers: np.ndarray, directions) -> tuple:
    (count, states), more = y.shape, directions.shape[1]
    before = np.full_like(y, np.inf)
    for _ in range(_STEPS):
        if np.nanmax(np.abs(y - before), initial=0.0) <= _STILL * np.nanmax(np.abs(y), initial=0.0):
            break
        before, y = y, projection.state.line.evaluate([*y.T, t, *numbers.T]).T
    still = np.abs(y - before).max(axis=1) <= _STILL * np.abs(y).max(axis=1)
    y = np.where(still[:, None], y, np.nan)
    y_dot, rows_dot = np.zeros((count, states + more, states)), np.zeros((count, states + more, numbers.shape[1]))
    y_dot[:, :states], rows_dot[:, states:] = np.eye(states), directions
    moved = project_start_tangents(projection, t[:, None], y, numbers, y_dot, rows_dot)
    return y, moved[:, :states].swapaxes(1, 2), moved[:, states:]
