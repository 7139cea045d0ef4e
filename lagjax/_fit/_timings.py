"""`Timings`: instants at which a motion crossed sections, as data; and the times that a scene gives, with derivatives.

A residual is the time of a crossing less the measured one. With s the section, ṡ its rate along the motion and δy how
the state at the fixed time t* of the crossing moves, the crossing moves by

    δt* = −(∂s/∂y · δy + ∂s/∂p · δp) / ṡ

The crossings are noted along one run (`lagjax.crossings`), a second one gives the states there and their derivatives.
"""

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
from lagjax._fit._records import Guess, Measured, require_start
from lagjax._layout import Layout, halves
from lagjax._machine_code import MachineCode, Noted, _derivatives, _tolerances, flow_of, surfaces_of
from lagjax._machine_code._steps import KEPT
from lagjax._problem import Problem
from lagjax._results import ENDED_WELL
from lagjax._system import System

PyTree = Any
_BUDGET = 10_000_000  # steps: observations last for thousands of periods
# Mean times between crossings that are waited for behind the last measured one: a trial may come later.
_PATIENCE = 2.0
# Of the tolerance of a fit, for the motion itself: its error grows with the square of the time, and after a thousand
# periods of seven planets is a thirtieth of what they are measured to. Derivatives then need no shorter steps either.
_SHARPER = 0.1


@dataclass(frozen=True, eq=False)
class Timings(Measured):
    """Crossing times of one motion: transits of planets, a pendulum through a light gate.

    - `section`: a function of (q, qdot), and of `t` and `params` by name, that returns one real number; a crossing is
      where that changes sign. A dict of functions for several sections of the same motion.
    - `times`: when it was crossed, (K,), or a dict of such arrays by the names of the sections. NaN where missing.
    - `t0`: where the motion begins, before all times, and from where crossings are counted.
    - `start`: the state at `t0`: (q0, qdot0) if it is known, `lagjax.Guess(q0, qdot0)` to fit it, or a function of the
      parameters that returns (q0, qdot0).
    - `numbers`: which crossing after `t0` each time is, from 0 on, in the form of `times`; by default 0, 1, 2, ….
      Choose a `t0` that is not near a crossing: one that begins before `t0` shifts the numbers of all.
    - `direction`: −1 only where the section falls, +1 only where it rises, 0 both; or a dict.
    - `weights`: how much each time counts, in the form of `times`: 1/σ² with the errors σ that were given. The fit
      finds one common factor of all σ, which is 1 where the errors are right.

    **Raises** `TypeError` or `ValueError` where these cannot be right.

    ```python
    import jax.numpy as jnp, lagjax

    through = lagjax.Timings(lambda q, qdot: q, jnp.array([0.6, 1.6, 2.6]), t0=0.0, start=lagjax.Guess(1.0, 0.0))
    ```
    """

    section: Callable | dict[str, Callable]
    times: Any
    t0: float
    start: tuple[PyTree, PyTree] | Guess | Callable
    numbers: Any = None
    direction: int | dict[str, int] = 0
    weights: Any = None

    flat: "Flat" = dataclasses.field(init=False, repr=False)

    def __post_init__(self):
        keys, _ = sections_of(self.section)
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
        keys, functions = sections_of(self.section)
        last, missing = np.nanmax(self.flat.times), int(np.isnan(self.flat.times).sum())
        of = f" of {len(functions)} sections" if keys else ""
        gaps = f", {missing} missing" if missing else ""
        return f"Timings(from {self.t0:g} to {last:g}, {len(self)} times{of}{gaps})"

    @property
    def ts(self) -> np.ndarray:
        """Where the motion begins, and the last measured time."""
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
        keys, functions = sections_of(self.section)
        return _in_form([matrix[self.flat.which == k, 0] for k in range(len(functions))], keys)

    def columns(self, values: PyTree) -> np.ndarray:
        """Numbers in the form of `times` as (M, 1)."""
        keys, _ = sections_of(self.section)
        return np.concatenate(_by_section(values, keys, "values"))[:, None]


class Flat(NamedTuple):
    """M times end to end: of which section, when, the number of the crossing, and the weight."""

    which: np.ndarray
    times: np.ndarray
    numbers: np.ndarray
    weights: np.ndarray


def _by_section(values, keys: tuple[str, ...] | None, name: str) -> list[np.ndarray]:
    """Arrays (K,) for each section, of floats. Raises where there is not one for each."""
    if keys is not None and (not isinstance(values, dict) or set(values) != set(keys)):
        raise ValueError(f"{name} must be a dict with the names of the sections, {', '.join(map(repr, keys))}.")
    parts = [values] if keys is None else [values[key] for key in keys]
    try:
        arrays = [np.asarray(part, np.float64) for part in parts]
    except (TypeError, ValueError):
        raise TypeError(f"{name} must hold real numbers.") from None
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
    """M crossings: times `t` (M,) and `order`, in which these increase; and with the steps of the run that noted them.

    `by_y` (M, 2n) and `by_numbers` (M, P) say how each time moves with the state there and with the parameters.
    """

    t: np.ndarray
    order: np.ndarray
    by_y: np.ndarray
    by_numbers: np.ndarray
    ts: np.ndarray
    y0: np.ndarray
    params: np.ndarray
    steps: tuple


class Clock:
    """The crossings of one `Timings` in a scene: their times, and their derivatives forward and in reverse."""

    def __init__(self, system: System, layout: Layout, parameters: Parameters, timings: Timings, rtol: float):
        keys, functions = sections_of(timings.section)
        self.flat, self.layout, self.keys, self.functions = timings.flat, layout, keys, functions
        self.span = np.array([float(timings.t0), self._end(timings)])
        params = parameters.restore(parameters.first)
        problem = Problem.about(system, layout, params, ts=tuple(self.span), rtol=_SHARPER * rtol, max_steps=_BUDGET)
        surfaces = MachineCode().refuses(problem) or surfaces_of(
            problem, functions, directions_of(timings.direction, keys), "A section"
        )
        if isinstance(surfaces, str):
            raise ValueError(f"Crossing times are found in machine code, which there is none of: {surfaces}.")
        self.noting = flow_of(dataclasses.replace(problem, guards=surfaces.guards(notes=True)))
        self.flow, self.room = flow_of(problem), int(self.flat.numbers.max()) + 1
        self.tolerances = _tolerances(problem)
        self.of_tangents = self.tolerances._replace(rtol=rtol, atol=self.tolerances.atol / _SHARPER)

        def values(y, t, numbers):
            q, qdot = map(layout.restore, halves(y))
            return jnp.stack([f(q, qdot, t=t, params=parameters.restore(numbers)) for f in functions])

        self._slopes = jax.jit(jax.vmap(jax.jacfwd(values, argnums=(0, 1, 2)), in_axes=(0, 0, None)))

    @staticmethod
    def _end(timings: Timings) -> float:
        """Until when crossings are looked for."""
        ends = [timings.ts[1]]
        for k in np.unique(timings.flat.which):
            there = (timings.flat.which == k) & np.isfinite(timings.flat.times)
            if there.any():
                t, number = timings.flat.times[there], timings.flat.numbers[there]
                ends.append(t.max() + _PATIENCE * (t.max() - timings.t0) / (number.max() + 1))
        return float(max(ends))

    def crossed(self, y0: np.ndarray, numbers: np.ndarray) -> Crossed | str:
        """The crossings of the motion from y0 (2n,) with the parameters `numbers` (P,); or why they are not there."""
        flat, params = self.flat, numbers[None]
        ts, y0 = self.span[None], y0[None]
        noted = self.noting.run(ts, y0, params, self.tolerances._replace(notes=self.room))
        t, _, count = Noted.read(noted.path[0], len(self.functions))
        t = t[flat.which, flat.numbers]
        if not np.isfinite(t).all():
            return self._why_not(noted, t, count)
        order = np.argsort(t, kind="stable")
        ts = np.concatenate([ts[:, 0], t[order]])[None]
        run = self.flow.run(ts, y0, params, self.tolerances, KEPT)
        if not np.isin(run.result, ENDED_WELL).all():
            return sentence(run.result[0], run.t_end[0], ts[0, -1], run.y_end[0], self.layout.names) or ""
        y = np.empty((len(t), y0.shape[1]))
        y[order] = run.path[0, 1:]
        by_y, by_t, by_numbers = (np.asarray(x)[np.arange(len(t)), flat.which] for x in self._slopes(y, t, numbers))
        pulled = self.flow.anywhere.evaluate(*y.T, t, *numbers)[: self.layout.size]
        rate = np.concatenate([y[:, self.layout.size :], np.stack(np.broadcast_arrays(*pulled, t)[:-1], axis=-1)], 1)
        rate = (np.einsum("ms,ms->m", by_y, rate) + by_t)[:, None]
        steps = run.path, run.result, run.accepted, run.ticket
        return Crossed(t, order, -by_y / rate, -by_numbers / rate, ts, y0, params, steps)

    def _why_not(self, noted, t: np.ndarray, count: np.ndarray) -> str:
        if not np.isin(noted.result[0], ENDED_WELL):
            text = sentence(noted.result[0], noted.t_end[0], self.span[1], noted.y_end[0], self.layout.names)
            return text or ""
        first = int(np.argmin(np.isfinite(t)))
        which = self.flat.which[first]
        name = "" if self.keys is None else f" of section[{self.keys[which]!r}]"
        return (
            f"There are {int(count[which])} crossings{name} up to t = {self.span[1]:g}, but number "
            f"{self.flat.numbers[first]}, counted from 0, was measured."
        )

    def forward(self, crossed: Crossed, y0_dot: np.ndarray, numbers_dot: np.ndarray) -> np.ndarray:
        """How the times move along D directions (M, D): of the start (D, 2n), of the parameters (D, P)."""
        tangents, _ = _derivatives.jvp(
            self.flow, crossed.ts, crossed.y0, crossed.params, crossed.steps, y0_dot[None], numbers_dot[None],
            self.of_tangents,
        )  # fmt: skip
        y_dot = np.empty((len(crossed.t), len(y0_dot), crossed.y0.shape[1]))
        y_dot[crossed.order] = np.moveaxis(tangents[0, :, 1:], 1, 0)
        return np.einsum("ms,mds->md", crossed.by_y, y_dot) + crossed.by_numbers @ numbers_dot.T

    def reverse(self, crossed: Crossed, t_ct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The transpose of `forward`, from cotangents (M,) of the times: of the start (2n,), of the parameters (P,)."""
        path_ct = np.zeros((1, 1, *crossed.steps[0].shape[1:]))
        path_ct[0, 0, 1:] = (t_ct[:, None] * crossed.by_y)[crossed.order]
        end_ct = np.zeros((1, 1, crossed.y0.shape[1]))
        of_y0, of_numbers = _derivatives.vjp(
            self.flow, crossed.ts, crossed.y0, crossed.params, crossed.steps, path_ct, end_ct, self.of_tangents
        )  # fmt: skip
        return of_y0[0, 0], of_numbers[0, 0] + t_ct @ crossed.by_numbers
