"""`Timings`: instants at which a motion crossed sections, as data; and the times that a scene gives, with derivatives.

A residual is the time of a crossing less the measured one. With s the section, ṡ its rate along the motion and δy how
the state at the fixed time t* of the crossing moves, the crossing moves by

    δt* = −(∂s/∂y · δy + ∂s/∂p · δp) / ṡ

The crossings are noted along one run (`lagjax.crossings`), a second one gives the states there and their derivatives.
Of hybrid motion (`lagjax.Hybrid`) the instants are those of its transitions, which have derivatives of their own.
"""

import abc
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._crossings import directions_of, sections_of
from lagjax._failures import sentence
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Guess, MeasuredSignal, real_numbers, require_start
from lagjax._hybrid import Hybrid, Scene, Transition, follow
from lagjax._layout import Layout, halves
from lagjax._machine_code import KEPT, MachineCode, Noted, Surfaces, flow_of, jvp, surfaces_of, tolerances_of, vjp
from lagjax._problem import Problem
from lagjax._program import Program, lower
from lagjax._results import ENDED_WELL
from lagjax._system import System
from lagjax._trajectory import Trajectory, Transitions

PyTree = Any
_BUDGET = 10_000_000  # steps: observations last for thousands of periods
# Mean times between crossings that are waited for behind the last measured one: a trial may come later.
_PATIENCE = 2.0
# Of the tolerance of a fit, for the motion itself: its error grows with the square of the time, and after a thousand
# periods of seven planets is a thirtieth of what they are measured to. Derivatives then need no shorter steps either.
_SHARPER = 0.1


@dataclass(frozen=True, eq=False)
class Timings(MeasuredSignal):
    """Crossing times of one motion: transits of planets, a pendulum through a light gate, the bounces of a ball.

    - `section`: a function of (q, qdot), and of `t` and `params` by name, that returns one real number; a crossing is
      where that changes sign. A dict of functions for several sections of the same motion. Of a `lagjax.Hybrid` one of
      its transitions, or a dict of them: the times are those at which it happened.
    - `times`: when it was crossed, (K,), or a dict of such arrays by the names of the sections. NaN where missing.
    - `t0`: the time at which the motion begins, before all `times`. Crossings are counted from there.
    - `start`: the state at `t0`: (q0, qdot0) if it is known, `lagjax.Guess(q0, qdot0)` to fit it, or a function of the
      parameters that returns (q0, qdot0).
    - `numbers`: which crossing after `t0` each time is, from 0 on, in the form of `times`; by default 0, 1, 2, ….
      Choose a `t0` that is not near a crossing: one that begins before `t0` shifts the numbers of all.
    - `direction`: −1 only where the section falls, +1 only where it rises, 0 both; or a dict.
    - `weights`: the weight of each time, in the form of `times`: 1/σ² with the stated errors σ. The fit finds one
      common factor of all σ, which is 1 where the stated errors are right.

    **Raises** `TypeError` or `ValueError` where these cannot be right.

    ```python
    import jax.numpy as jnp, lagjax

    through = lagjax.Timings(lambda q, qdot: q, jnp.array([0.6, 1.6, 2.6]), t0=0.0, start=lagjax.Guess(1.0, 0.0))
    ```
    """

    section: Callable | Transition | dict[str, Callable] | dict[str, Transition]
    times: Any
    t0: float
    start: tuple[PyTree, PyTree] | Guess | Callable
    numbers: Any = None
    direction: int | dict[str, int] = 0
    weights: Any = None

    flat: "Flat" = dataclasses.field(init=False, repr=False)

    def __post_init__(self):
        keys, functions = _sections(self.section)
        if isinstance(functions[0], Transition) and self.direction != 0:
            raise ValueError("direction is for functions: a transition has its own. Leave it at 0.")
        if self.start is None:
            raise TypeError("A lagjax.Timings needs a start: (q0, qdot0), lagjax.Guess(q0, qdot0), or a function.")
        require_start(self.start)
        if not (np.ndim(self.t0) == 0 and np.isfinite(self.t0)):
            raise ValueError(f"t0 must be a finite number; got {self.t0!r}.")
        times = _by_section(self.times, keys, "times")
        counted = [np.arange(len(x)) for x in times] if self.numbers is None else None
        numbers = _by_section(self.numbers, keys, "numbers") if counted is None else counted
        weights = [np.ones(len(x)) for x in times]
        if self.weights is not None:
            given = self.weights
            weights = [w * given for w in weights] if np.ndim(given) == 0 and not isinstance(given, dict) else (
                _by_section(given, keys, "weights"))  # fmt: skip
        for name, few in (("numbers", numbers), ("weights", weights)):
            if [len(x) for x in few] != [len(x) for x in times]:
                raise ValueError(f"{name} must have the shape of times, {[len(x) for x in times]} by section.")
        object.__setattr__(self, "times", _in_form(times, keys))
        which = np.repeat(np.arange(len(times)), [len(x) for x in times])
        flat = Flat(which, np.concatenate(times), np.concatenate(numbers), np.concatenate(weights))
        _require_possible(flat, float(self.t0))
        object.__setattr__(self, "flat", flat._replace(numbers=flat.numbers.astype(int)))

    def __len__(self) -> int:
        return len(self.flat.times)

    def __repr__(self) -> str:
        keys, functions = _sections(self.section)
        last, missing = np.nanmax(self.flat.times), int(np.isnan(self.flat.times).sum())
        of = f" of {len(functions)} sections" if keys else ""
        gaps = f", {missing} missing" if missing else ""
        return f"Timings(from {self.t0:g} to {last:g}, {len(self)} times{of}{gaps})"

    @property
    def ts(self) -> np.ndarray:
        """The time at which the motion begins, and the last measured time."""
        return np.array([float(self.t0), np.nanmax(self.flat.times)])

    @property
    def matrix(self) -> np.ndarray:
        """All times, (M, 1); NaN where missing."""
        return self.flat.times[:, None]

    @property
    def weight_matrix(self) -> np.ndarray:
        """The weight of every time (M, 1), zero where it is missing."""
        return np.where(np.isnan(self.flat.times), 0.0, self.flat.weights)[:, None]

    def restore(self, matrix: np.ndarray) -> PyTree:
        """Numbers for all times, (M, 1), in the form of `times`."""
        keys, functions = _sections(self.section)
        return _in_form([matrix[self.flat.which == k, 0] for k in range(len(functions))], keys)

    def columns(self, values: PyTree) -> np.ndarray:
        """Numbers in the form of `times` as (M, 1)."""
        keys, _ = _sections(self.section)
        return np.concatenate(_by_section(values, keys, "values"))[:, None]


class Flat(NamedTuple):
    """M times end to end: of which section, when, the number of the crossing, and the weight."""

    which: np.ndarray
    times: np.ndarray
    numbers: np.ndarray
    weights: np.ndarray


def _sections(section) -> tuple[tuple[str, ...] | None, tuple]:
    """The names of a dict of sections, or None, and the functions or the transitions."""
    parts = tuple(section.values()) if isinstance(section, dict) else (section,)
    which = [isinstance(part, Transition) for part in parts]
    if not any(which):
        return sections_of(section)
    if not all(which):
        raise TypeError("section must hold functions, or transitions of a lagjax.Hybrid, and not both.")
    return tuple(section) if isinstance(section, dict) else None, parts


def _by_section(values, keys: tuple[str, ...] | None, name: str) -> list[np.ndarray]:
    """Arrays (K,) for each section, of floats. Raises where there is not one for each."""
    if keys is not None and (not isinstance(values, dict) or set(values) != set(keys)):
        raise ValueError(f"{name} must be a dict with the names of the sections, {', '.join(map(repr, keys))}.")
    parts = [values] if keys is None else [values[key] for key in keys]
    arrays = [real_numbers(part, name, "real numbers") for part in parts]
    for array in arrays:
        if array.ndim != 1:
            raise ValueError(f"{name} must be of one dimension for each section; got shape {array.shape}.")
    return arrays


def _in_form(parts: list, keys: tuple[str, ...] | None) -> PyTree:
    return parts[0] if keys is None else dict(zip(keys, parts, strict=True))


def _require_possible(flat: Flat, t0: float) -> None:
    """Raise `ValueError` for times, numbers or weights that no motion from t0 can have."""
    if not np.isfinite(flat.times).any():
        raise ValueError("times holds no time: all are NaN, or there are none.")
    if np.isinf(flat.times).any():
        raise ValueError("A time is infinite: write NaN for one that is missing.")
    if (flat.times <= t0).any():
        raise ValueError(f"The time {np.nanmin(flat.times):g} is not after t0 = {t0:g}, where the motion begins.")
    if not (np.isfinite(flat.weights).all() and (flat.weights >= 0).all()):
        raise ValueError("weights must be finite and not negative.")
    if not (flat.numbers >= 0).all() or (flat.numbers != np.floor(flat.numbers)).any():
        raise ValueError("numbers must be whole numbers from 0 on: 0 is the first crossing after t0.")
    for k in np.unique(flat.which):
        there = (flat.which == k) & np.isfinite(flat.times)
        order = np.argsort(flat.numbers[there], kind="stable")
        if (np.diff(flat.numbers[there][order]) == 0).any() or (np.diff(flat.times[there][order]) <= 0).any():
            raise ValueError("Of one section, a later time must have a larger number, and each number one time.")


# ---- the times that a scene gives ------------------------------------------------------------------------------------


class Crossed(NamedTuple):
    """M crossings of each of N motions: when, `t` (N, M), and `order` (N, M), in which these times increase.

    `by_y` (N, M, 2n) and `by_numbers` (N, M, P) say how each moves with the state there, at a fixed time, and with the
    parameters. `ok` (N,) is false where a motion failed, or has not all of the crossings: its times are NaN. The rest
    is the run that came by, with its steps.
    """

    t: np.ndarray
    order: np.ndarray
    by_y: np.ndarray
    by_numbers: np.ndarray
    ok: np.ndarray
    ts: np.ndarray
    y0: np.ndarray
    numbers: np.ndarray
    steps: tuple


class AbstractClock(abc.ABC):
    """The instants of one `Timings` in a scene, with their derivatives.

    `times(y0, numbers)` gives the times (M,) as a function for `jax.jit`, `jax.vmap` and `jax.grad`; NaN where it
    failed.
    """

    times: Callable

    @abc.abstractmethod
    def along(
        self, y0: np.ndarray, numbers: np.ndarray, y0_dot: np.ndarray, numbers_dot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The times (M,) of the motion from y0 (2n,) with the parameters `numbers` (P,), and how they move (M, D).

        Directions are `y0_dot` (D, 2n) and `numbers_dot` (D, P). None where the motion has not all of the instants.
        """

    @abc.abstractmethod
    def why_not(self, y0: np.ndarray, numbers: np.ndarray) -> str:
        """Why the instants of a motion from y0 (2n,) with `numbers` (P,) are not all there."""


def clock_of(scene: Scene, layout: Layout, parameters: Parameters, timings: Timings, rtol: float) -> AbstractClock:
    """The clock of a scene. Raises `ValueError` where functions are asked of a hybrid one, or transitions of others."""
    is_of_transitions = isinstance(_sections(timings.section)[1][0], Transition)
    if isinstance(scene, Hybrid):
        if not is_of_transitions:
            raise ValueError("Of a lagjax.Hybrid only the times of its transitions are data: Timings(transition, …).")
        return HybridClock(scene, layout, parameters, timings, rtol)
    if is_of_transitions:
        raise ValueError("Times of transitions are of a lagjax.Hybrid: give that to `fit` in the place of the System.")
    return Clock(scene, layout, parameters, timings, rtol)


class HybridClock(AbstractClock):
    """The times of transitions of hybrid motion, whose derivatives are those of `simulate_hybrid`."""

    def __init__(self, scene: Hybrid, layout: Layout, parameters: Parameters, timings: Timings, rtol: float):
        self.flat, self.scene = timings.flat, scene
        self.keys, transitions = _sections(timings.section)
        self.ways = np.array([_way(scene, one) for one in transitions])[self.flat.which]
        if scene.max_transitions < len(self.flat.times):
            raise ValueError(
                f"{len(self.flat.times)} transitions were timed, but Hybrid(max_transitions={scene.max_transitions}) "
                "follows no more than that: give a larger budget."
            )
        self.span = np.array([float(timings.t0), _end(timings)])
        source, target = (jnp.asarray(self.ways[:, k, None]) for k in (0, 1))
        number = jnp.asarray(self.flat.numbers[:, None])

        def run(y0, numbers):
            q, qdot = map(layout.restore, halves(y0))
            return follow(scene, q, qdot, self.span, parameters.restore(numbers), rtol=rtol, throw=False)

        def times(y0, numbers):
            happened = _transitions(run(y0, numbers))
            mine = (happened.source == source) & (happened.target == target)  # (M, K)
            mine = mine & (jnp.cumsum(mine, axis=1) == number + 1)
            place = jnp.argmax(mine, axis=1)
            return jnp.where(mine.any(axis=1), happened.t[place], jnp.nan)

        def along(y0, numbers, *dot):
            t, moved = jax.linearize(times, y0, numbers)
            return t, jax.vmap(moved)(*dot).T

        self.times, self._along = times, jax.jit(along)
        self._ended = jax.jit(lambda y0, numbers: _ended(run(y0, numbers)))
        self.layout = layout

    def along(self, y0, numbers, y0_dot, numbers_dot):
        """The times (M,) and how they move (M, D); see `AbstractClock`."""
        t, slopes = (np.asarray(x, float) for x in self._along(y0, numbers, y0_dot, numbers_dot))
        return (t, slopes) if np.isfinite(t).all() else None

    def why_not(self, y0, numbers):
        """Why the transitions of a motion are not all there."""
        missing = ~np.isfinite(np.asarray(jax.jit(self.times)(y0, numbers)))
        result, t_end, y_end, of_transitions = (np.asarray(x) for x in self._ended(y0, numbers))
        first = int(np.argmax(missing))
        happened = int((of_transitions == self.ways[first]).all(axis=1).sum())
        between = " to ".join(repr(tuple(self.scene.modes)[k]) for k in self.ways[first])
        text = sentence(int(result), float(t_end), self.span[1], y_end, self.layout.names)
        return (
            f"There are {happened} transitions from {between} up to t = {float(t_end):g}, but number "
            f"{self.flat.numbers[first]}, counted from 0, was measured." + (f" {text}" if text else "")
        )


def _ended(run: Trajectory) -> tuple:
    """The result, the last time and state of a hybrid motion, and which modes its transitions (K, 2) were between."""
    flat = [jnp.ravel(leaf) for leaf in jax.tree.leaves((run.end.q, run.end.qdot))]
    happened = _transitions(run)
    between = jnp.stack([happened.source, happened.target], axis=1)
    return run.result._value, run.end.t, jnp.concatenate(flat), between


def _transitions(run: Trajectory) -> Transitions:
    """Those of a hybrid motion, which has them."""
    assert run.transitions is not None
    return run.transitions


def _way(scene: Hybrid, transition: Transition) -> tuple[int, int]:
    """The places of both modes of a transition. Raises `ValueError` where it is not alone between them."""
    names, ways = list(scene.modes), [(one.source, one.target) for one in scene.transitions]
    way = transition.source, transition.target
    if all(one is not transition for one in scene.transitions):
        raise ValueError(f"The timed transition from {way[0]!r} to {way[1]!r} is none of Hybrid(transitions=...).")
    if ways.count(way) > 1:
        raise ValueError(
            f"{ways.count(way)} transitions lead from {way[0]!r} to {way[1]!r}, and times do not tell which happened: "
            "give the one that was timed a mode of its own as target."
        )
    return names.index(way[0]), names.index(way[1])


class Clock(AbstractClock):
    """The crossings of one `Timings` in a scene: their times, and their derivatives forward and in reverse."""

    def __init__(self, system: System, layout: Layout, parameters: Parameters, timings: Timings, rtol: float):
        self.flat, self.layout = timings.flat, layout
        self.keys, functions = sections_of(timings.section)
        self.span = np.array([float(timings.t0), _end(timings)])
        params = parameters.restore(parameters.first)
        problem = Problem.about(system, layout, params, ts=tuple(self.span), rtol=_SHARPER * rtol, max_steps=_BUDGET)
        directions = directions_of(timings.direction, self.keys)
        surfaces = MachineCode().refuses(problem) or surfaces_of(problem, functions, directions, "A section")
        if isinstance(surfaces, str):
            raise ValueError(
                f"Crossing times are found with machine code, and there is none for this scene: {surfaces}."
            )
        self.noting = flow_of(dataclasses.replace(problem, guards=surfaces.guards(notes=True)))
        self.flow, self.room = flow_of(problem), int(self.flat.numbers.max()) + 1
        self.tolerances = tolerances_of(problem)
        self.of_tangents = self.tolerances._replace(rtol=rtol, atol=self.tolerances.atol / _SHARPER)
        self.sections, self._slopes = len(functions), _slopes_of(surfaces, layout.size, len(parameters.first))
        self.times = self._as_function()

    # ---- the crossings of N motions ----

    def noted(self, y0: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """The times (N, M) at which motions from y0 (N, 2n) with the parameters `numbers` (N, P) cross, in one run.

        NaN for a motion that has not all of the crossings.
        """
        noted = self.noting.run(self.span[None], y0, numbers, self.tolerances._replace(notes=self.room))
        rows = noted.path.reshape(len(y0), self.sections, self.room + 1, -1)
        t = rows[:, self.flat.which, self.flat.numbers, 0]
        return np.where(np.isfinite(t).all(axis=1, keepdims=True), t, np.nan)

    def crossed(self, y0: np.ndarray, numbers: np.ndarray, t: np.ndarray) -> Crossed:
        """The crossings at the times t (N, M) that `noted` found for y0 (N, 2n) and `numbers` (N, P), by a second run.

        A motion that has not all of them is followed at times spread over the span, so that the others have one run.
        """
        has_all = np.isfinite(t).all(axis=1, keepdims=True)
        t = np.where(has_all, t, np.linspace(self.span[0], self.span[1], t.shape[1] + 1)[1:])
        count, begin = len(y0), self.span[:1]
        order = np.argsort(t, axis=1, kind="stable")
        ts = np.concatenate([np.broadcast_to(begin, (count, 1)), np.take_along_axis(t, order, axis=1)], axis=1)
        run = self.flow.run(ts, y0, numbers, self.tolerances, KEPT)
        ok = np.ravel(has_all) & np.isin(run.result, ENDED_WELL)
        y = np.empty((*t.shape, y0.shape[1]))
        np.put_along_axis(y, order[..., None], run.path[:, 1:], axis=1)
        by_y, by_numbers = self._moved(t, y, numbers)
        steps = run.path, run.result, run.accepted, run.ticket
        return Crossed(np.where(ok[:, None], t, np.nan), order, by_y, by_numbers, ok, ts, y0, numbers, steps)

    def _moved(self, t: np.ndarray, y: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The slopes of the times t (N, M) of crossings by the states y (N, M, 2n) there, and by the parameters."""
        (count, crossings, states), n = y.shape, self.layout.size
        each = np.repeat(numbers, crossings, axis=0)
        columns = *y.reshape(-1, states).T, t.ravel(), *each.T
        which = np.tile(self.flat.which, count)
        slopes = np.empty((len(which), states + 1 + each.shape[1]))
        values = self._slopes.evaluate(*columns)
        for k in range(self.sections):
            own = which == k
            for j, value in enumerate(values[k * slopes.shape[1] : (k + 1) * slopes.shape[1]]):
                slopes[own, j] = value if np.ndim(value) == 0 else value[own]
        pulled = [np.broadcast_to(x, len(which)) for x in self.flow.anywhere.evaluate(*columns)[:n]]
        rate = np.concatenate([columns[n:states], pulled, np.ones((1, len(which)))]).T
        slopes /= -np.einsum("ms,ms->m", slopes[:, : states + 1], rate)[:, None]
        shape = count, crossings, -1
        return slopes[:, :states].reshape(shape), slopes[:, states + 1 :].reshape(shape)

    def why_not(self, y0: np.ndarray, numbers: np.ndarray) -> str:
        """Why the crossings of a motion from y0 (2n,) with `numbers` (P,) are not all there."""
        tolerances = self.tolerances._replace(notes=self.room)
        noted = self.noting.run(self.span[None], y0[None], numbers[None], tolerances)
        text = sentence(noted.result[0], noted.t_end[0], self.span[1], noted.y_end[0], self.layout.names)
        if text:
            return text
        t, _, count = Noted.read(noted.path[0], self.sections)
        missing = ~np.isfinite(t[self.flat.which, self.flat.numbers])
        if not missing.any():
            return "Its crossings could not be followed."
        first = int(np.argmax(missing))
        which = self.flat.which[first]
        name = "" if self.keys is None else f" of section[{self.keys[which]!r}]"
        return (
            f"There are {int(count[which])} crossings{name} up to t = {self.span[1]:g}, but number "
            f"{self.flat.numbers[first]}, counted from 0, was measured."
        )

    # ---- derivatives ----

    def along(self, y0, numbers, y0_dot, numbers_dot):
        """The times (M,) and how they move (M, D); see `AbstractClock`."""
        y0, numbers = y0[None], numbers[None]
        crossed = self.crossed(y0, numbers, self.noted(y0, numbers))
        if not crossed.ok.all():
            return None
        return crossed.t[0], self.forward(crossed, y0_dot[None], numbers_dot[None])[0]

    def forward(self, crossed: Crossed, y0_dot: np.ndarray, numbers_dot: np.ndarray) -> np.ndarray:
        """Tangents of the times along D directions (N, M, D): of the starts (N, D, 2n), of the parameters (N, D, P)."""
        tangents, _ = jvp(
            self.flow, crossed.ts, crossed.y0, crossed.numbers, crossed.steps, y0_dot, numbers_dot, self.of_tangents
        )  # fmt: skip
        y_dot = np.empty((*crossed.t.shape, *y0_dot.shape[1:]))
        np.put_along_axis(y_dot, crossed.order[..., None, None], np.moveaxis(tangents[:, :, 1:], 1, 2), axis=1)
        moved = np.einsum("nms,nmds->nmd", crossed.by_y, y_dot)
        return moved + np.einsum("nmp,ndp->nmd", crossed.by_numbers, numbers_dot)

    def reverse(self, crossed: Crossed, t_ct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The transpose of `forward`, from cotangents (N, M) of the times: of the starts (N, 2n), and (N, P)."""
        path_ct = np.zeros((len(t_ct), 1, *crossed.steps[0].shape[1:]))
        path_ct[:, 0, 1:] = np.take_along_axis(t_ct[..., None] * crossed.by_y, crossed.order[..., None], axis=1)
        of_y0, of_numbers = vjp(
            self.flow, crossed.ts, crossed.y0, crossed.numbers, crossed.steps, path_ct,
            np.zeros((len(t_ct), 1, crossed.y0.shape[1])), self.of_tangents,
        )  # fmt: skip
        of_y0, of_numbers = of_y0[:, 0], of_numbers[:, 0] + np.einsum("nm,nmp->np", t_ct, crossed.by_numbers)
        ok = crossed.ok[:, None]
        return np.where(ok, of_y0, np.nan), np.where(ok, of_numbers, np.nan)

    def _as_function(self):
        """`(y0, numbers)` → the times (M,), a function for `jax.jit`, `jax.vmap` and `jax.grad`; NaN where it failed.

        Members of a batch are one run. Its derivatives are those of first order, in reverse: the times that were noted
        on the way forward are an argument of the way back, which runs to the states there.
        """

        def call(host, sizes, *arguments):
            of = jax.tree.map(lambda size: jax.ShapeDtypeStruct((size,), np.float64), sizes)
            return jax.pure_callback(host, of, *arguments, vmap_method="broadcast_all")

        @jax.custom_vjp
        def times(y0, numbers):
            return call(self._times, len(self.flat.which), y0, numbers)

        def forward(y0, numbers):
            t = times(y0, numbers)
            return t, (y0, numbers, t)

        def backward(kept, t_ct):
            return call(self._cotangents, tuple(x.shape[-1] for x in kept[:2]), *kept, t_ct)

        times.defvjp(forward, backward)
        return times

    def _times(self, y0, numbers):
        y0, numbers = (np.asarray(x, np.float64) for x in (y0, numbers))
        t = self.noted(*(x.reshape(-1, x.shape[-1]) for x in (y0, numbers)))
        return t.reshape(*y0.shape[:-1], -1)

    def _cotangents(self, *arrays):
        arrays = [np.asarray(x, np.float64) for x in arrays]
        y0, numbers, t, t_ct = (x.reshape(-1, x.shape[-1]) for x in arrays)
        found = self.reverse(self.crossed(y0, numbers, t), t_ct)
        return tuple(x.reshape(like.shape) for x, like in zip(found, arrays[:2], strict=True))


def _slopes_of(surfaces: Surfaces, size: int, numbers: int) -> Program:
    """The derivatives of all sections by (q, q̇, t, params), one section after the other."""

    def slopes(y, params):
        by = jax.jacfwd(lambda y, params: jnp.stack(surfaces.values.at(y, params)), argnums=(0, 1))(y, params)
        return jnp.concatenate(by, axis=1)

    return lower(slopes, *(jax.ShapeDtypeStruct((count,), np.float64) for count in (2 * size + 1, numbers)))


def _end(timings: Timings) -> float:
    """Until when crossings are looked for."""
    ends = [timings.ts[1]]
    for k in np.unique(timings.flat.which):
        there = (timings.flat.which == k) & np.isfinite(timings.flat.times)
        if there.any():
            t, number = timings.flat.times[there], timings.flat.numbers[there]
            ends.append(t.max() + _PATIENCE * (t.max() - timings.t0) / (number.max() + 1))
    return float(max(ends))
