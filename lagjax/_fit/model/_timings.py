"""`Timings`: instants at which a motion crossed sections, as data; and the times that a scene gives, with derivatives.

A residual is the time of a crossing less the measured one. The crossings, and their derivatives, are those of
`lagjax.crossings`; of hybrid motion (`lagjax.Hybrid`) the instants are those of its transitions, of a contact those of
its impacts, with the derivatives of `lagjax.simulate`.
"""

import dataclasses
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._fit.model._records import Guess, MeasuredSignal, Record, real_numbers, require_start
from lagjax._interface import Layout, halves
from lagjax._primitives import sentence
from lagjax._run import crossings, sections_of, simulate
from lagjax._run.hybrid import Hybrid, Scene, Transition
from lagjax._scene import System

_BUDGET = 10_000_000  # steps: observations last for thousands of periods
_PATIENCE = 2.0  # mean times between crossings that are waited for behind the last one: a trial may come later

# Of the tolerance of a fit, for the motion itself: its error grows with the square of the time, and after a thousand
# periods of seven planets is a thirtieth of what they are measured to. Derivatives then need no shorter steps either.
_SHARPER = 0.1
_CHANGES = 256  # the least budget of changes of a motion with contacts, four for each measured impact


@dataclass(frozen=True, eq=False)
class Timings(MeasuredSignal):
    """Crossing times of one motion: transits of planets, a pendulum through a light gate, the bounces of a ball.

    - `section`: a function of (q, qdot), and of `t` and `params` by name, that returns one real number; a crossing is
      where that changes sign. A dict of functions for several sections of the same motion. Of a `lagjax.Hybrid` one of
      its transitions, or a dict of them: the times are those at which it happened. In a scene with contacts also the
      name of one, "floor", "wheels[1]" in an array, or a dict of names: the times are those at which it was struck.
    - `times`: when it was crossed, (K,), or a dict of such arrays by the names of the sections. NaN where missing.
    - `t0`: the time at which the motion begins, before all `times`. Crossings are counted from there.
    - `start`: the state at `t0`: (q0, qdot0) if it is known, `lagjax.Guess(q0, qdot0)` to fit it, or a function of the
      parameters that returns (q0, qdot0). Or a `Record` of the same motion, which begins at `t0`, and is given to `fit`
      as well: both then have one start, and what belongs to each record.
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

    section: Callable | Transition | str | dict[str, Callable] | dict[str, Transition] | dict[str, str]
    times: Any
    t0: float
    start: tuple[PyTree, PyTree] | Guess | Callable | Record
    numbers: Any = None
    direction: int | dict[str, int] = 0
    weights: Any = None

    flat: "FlatTimings" = dataclasses.field(init=False, repr=False)

    def __post_init__(self):
        keys, functions = _sections(self.section)
        if isinstance(functions[0], Transition | str) and self.direction != 0:
            raise ValueError("direction is for functions: a transition, or a contact, has its own. Leave it at 0.")
        if self.start is None:
            raise TypeError(
                "A lagjax.Timings needs a start: (q0, qdot0), lagjax.Guess(q0, qdot0), a function, or the Record of "
                "the same motion."
            )
        if isinstance(self.start, Record):
            if self.start.ts[0] != self.t0:
                raise ValueError(
                    f"The record of the same motion begins at {self.start.ts[0]:g}, and not at t0 = {self.t0:g}: "
                    "give that as t0."
                )
        else:
            require_start(self.start)
        if not (np.ndim(self.t0) == 0 and np.isfinite(self.t0)):
            raise ValueError(f"t0 must be a finite number; got {self.t0!r}.")
        times = _section_arrays(self.times, keys, "times")
        numbers, given = [np.arange(len(x)) for x in times], 1.0 if self.weights is None else self.weights
        if self.numbers is not None:
            numbers = _section_arrays(self.numbers, keys, "numbers")
        if np.ndim(given) == 0 and not isinstance(given, dict):
            weights = [np.full(len(x), given, float) for x in times]
        else:
            weights = _section_arrays(given, keys, "weights")
        for name, few in (("numbers", numbers), ("weights", weights)):
            if [len(x) for x in few] != [len(x) for x in times]:
                raise ValueError(f"{name} must have the shape of times, {[len(x) for x in times]} by section.")
        object.__setattr__(self, "times", _restore_keys(times, keys))
        which = np.repeat(np.arange(len(times)), [len(x) for x in times])
        flat = FlatTimings(which, np.concatenate(times), np.concatenate(numbers), np.concatenate(weights))
        _require_valid_times(flat, float(self.t0))
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
        return np.where(np.isnan(self.flat.times), 0.0, self.flat.weights)[:, None]

    def restore(self, matrix: np.ndarray) -> PyTree:
        keys, functions = _sections(self.section)
        return _restore_keys([matrix[self.flat.which == k, 0] for k in range(len(functions))], keys)


class FlatTimings(NamedTuple):
    """M times end to end: of which section, when, the number of the crossing, and the weight."""

    which: np.ndarray
    times: np.ndarray
    numbers: np.ndarray
    weights: np.ndarray


def _sections(section) -> tuple[tuple[str, ...] | None, tuple]:
    """The names of a dict of sections, or None, and the functions, the transitions or the names of contacts."""
    parts = tuple(section.values()) if isinstance(section, dict) else (section,)
    kinds = {next((kind for kind in (Transition, str) if isinstance(part, kind)), None) for part in parts}
    if kinds <= {None}:
        return sections_of(section)
    if len(kinds) > 1:
        raise TypeError(
            "section must hold functions, transitions of a lagjax.Hybrid or names of contacts, and all of one kind."
        )
    return tuple(section) if isinstance(section, dict) else None, parts


def _section_arrays(values, keys: tuple[str, ...] | None, name: str) -> list[np.ndarray]:
    """Arrays (K,) for each section, of floats. Raises where there is not one for each."""
    if keys is not None and (not isinstance(values, dict) or set(values) != set(keys)):
        raise ValueError(f"{name} must be a dict with the names of the sections, {', '.join(map(repr, keys))}.")
    parts = [values] if keys is None else [values[key] for key in keys]
    arrays = [real_numbers(part, name, "real numbers") for part in parts]
    for array in arrays:
        if array.ndim != 1:
            raise ValueError(f"{name} must be of one dimension for each section; got shape {array.shape}.")
    return arrays


def _restore_keys(parts: list, keys: tuple[str, ...] | None) -> PyTree:
    return parts[0] if keys is None else dict(zip(keys, parts, strict=True))


def _require_valid_times(flat: FlatTimings, t0: float) -> None:
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


@dataclass(frozen=True, eq=False)
class Clock:
    """The instants of one `Timings` in a scene, with their derivatives.

    - `times(y0, numbers)`: the times (M,) of the motion from y0 (2n,) with the parameters `numbers` (P,), a function
      for `jax.jit`, `jax.vmap` and `jax.grad`; NaN where it has not all of them.
    - `tangents(y0, numbers, y0_dot, numbers_dot)`: the times, and how they move (M, D) along the directions `y0_dot`
      (D, 2n), `numbers_dot` (D, P).
    - `describe_failure(y0, numbers)`: why they are not all there, as a sentence.
    """

    times: Callable[..., jax.Array]
    describe_failure: Callable[[np.ndarray, np.ndarray], str]

    @functools.cached_property
    def tangents(self) -> Callable[..., tuple]:
        def follow(y0, numbers, *directions):
            return jax.vmap(lambda *way: jax.jvp(self.times, (y0, numbers), way), out_axes=(None, -1))(*directions)

        return jax.jit(follow)


def build_clock(
    scene: Scene, layout: Layout, restore: Callable, params: PyTree, timings: Timings, rtol: float
) -> Clock:
    """The clock of a scene; `restore` makes its parameters of their numbers, `params` are an example. Raises
    `ValueError` for functions of a hybrid one, and for what is of another scene."""
    find = _choose_finder(scene, _sections(timings.section)[1][0])
    flat, span = timings.flat, np.array([float(timings.t0), _last_time(timings)])
    instants, happens, advice = find(scene, layout, params, timings, rtol)

    def given(y0, numbers):
        return *map(layout.restore, halves(y0)), span, restore(numbers)

    def times(y0, numbers):
        mine, t = instants(*given(y0, numbers))
        mine = mine & (jnp.cumsum(mine, axis=1) == flat.numbers[:, None] + 1)
        return jnp.where(mine.any(axis=1), jnp.where(mine, t, 0.0).sum(axis=1), jnp.nan)

    def describe_failure(y0, numbers) -> str:
        try:
            return count_instants(y0, numbers)
        except ValueError as reason:  # of a number that the scene refuses, such as a restitution beyond 1
            return str(reason)

    def count_instants(y0, numbers) -> str:
        first = int(np.argmax(~np.isfinite(np.asarray(times(y0, numbers)))))
        motion = simulate(scene, *given(y0, numbers), rtol=rtol, throw=False)
        t_end, happened = float(motion.end.t), int(instants(*given(y0, numbers))[0][first].sum())
        y_end = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves((motion.end.q, motion.end.qdot))])
        text = sentence(int(motion.result._value), t_end, span[1], y_end, layout.names)
        return (
            f"There are {happened} {happens(first)} up to t = {t_end:g}, but number "
            f"{flat.numbers[first]}, counted from 0, was measured.{advice}" + (f" {text}" if text else "")
        )

    return Clock(times, describe_failure)


def _choose_finder(scene: Scene, first: Callable | Transition | str) -> Callable:
    """The function that finds the instants of sections like the first one.

    It gives a function of a motion's arguments that returns which of its instants are those of each time (M, K), and
    when these are; and what was timed as text, before and behind its count.
    """
    if isinstance(scene, Hybrid):
        if not isinstance(first, Transition):
            raise ValueError("Of a lagjax.Hybrid only the times of its transitions are data: Timings(transition, …).")
        return _transitions_in
    if isinstance(first, Transition):
        raise ValueError("Times of transitions are of a lagjax.Hybrid: give that to `fit` in the place of the System.")
    if isinstance(first, str) and not scene.touches:
        raise ValueError(f"Timings names the contact {first!r}, and this System has none: give it contacts=....")
    return _impacts_in if isinstance(first, str) else _crossings_in


def _transitions_in(scene: Hybrid, layout: Layout, params: PyTree, timings: Timings, rtol: float) -> tuple:
    flat, (_, transitions) = timings.flat, _sections(timings.section)
    ways = np.array([_mode_places(scene, one) for one in transitions])[flat.which]
    if scene.max_transitions < len(flat.times):
        raise ValueError(
            f"{len(flat.times)} transitions were timed, but Hybrid(max_transitions={scene.max_transitions}) "
            "follows no more than that: give a larger budget."
        )

    def instants(*given):
        happened = simulate(scene, *given, rtol=rtol, throw=False).transitions
        assert happened is not None
        return (happened.source == ways[:, :1]) & (happened.target == ways[:, 1:]), happened.t

    return instants, lambda m: f"transitions from {' to '.join(repr([*scene.modes][k]) for k in ways[m])}", ""


def _impacts_in(system: System, layout: Layout, params: PyTree, timings: Timings, rtol: float) -> tuple:
    """A contact is struck where it gives an impulse. Raises `ValueError` for a name that no contact has."""
    flat, (_, struck) = timings.flat, _sections(timings.section)
    names = system.contact_names(layout, params)
    short = list(map(_short_contact_name, names))
    for name in struck:
        if name not in (*short, *names):
            raise ValueError(f"Timings names the contact {name!r}, and the contacts are {', '.join(map(repr, short))}.")
    places = np.array([(short if name in short else names).index(name) for name in struck])[flat.which]
    budget = max(_CHANGES, 4 * int(flat.numbers.max() + 1))

    def instants(*given):
        impacts = simulate(system, *given, rtol=rtol, throw=False, max_transitions=budget).impacts
        assert impacts is not None
        leaves = jax.tree.leaves(impacts.impulse)
        impulses = jnp.concatenate([leaf.reshape(len(impacts.t), -1) for leaf in leaves], axis=1)
        return impulses.T[places] > 0, impacts.t

    return instants, lambda m: f"impacts of {struck[flat.which[m]]!r}", ""


def _crossings_in(system: System, layout: Layout, params: PyTree, timings: Timings, rtol: float) -> tuple:
    flat, (keys, _) = timings.flat, _sections(timings.section)
    limits = {"direction": timings.direction, "count": int(flat.numbers.max()) + 1, "rtol": rtol, "throw": False}
    if not system.touches:
        limits |= {"rtol": _SHARPER * rtol, "max_steps": _BUDGET}

    def instants(*given):
        found = crossings(system, timings.section, *given, **limits)
        t = jnp.stack([of.t for of in ([found] if keys is None else [found[key] for key in keys])])[flat.which]
        return jnp.isfinite(t), t

    advice = ""
    if system.touches:
        name = _short_contact_name(system.contact_names(layout, params)[0])
        advice = f" An impact that closes a gap is no crossing: Timings({name!r}, times, …) are those of a contact."
    return instants, lambda m: "crossings" + ("" if keys is None else f" of section[{keys[flat.which[m]]!r}]"), advice


def _short_contact_name(name: str) -> str:
    """A contact's name without its role: floor of contacts['floor']."""
    return re.sub(r"^\w+\['(.*?)'\]", r"\1", name)


def _mode_places(scene: Hybrid, transition: Transition) -> tuple[int, int]:
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


def _last_time(timings: Timings) -> float:
    ends = [timings.ts[1]]
    for k in np.unique(timings.flat.which):
        there = (timings.flat.which == k) & np.isfinite(timings.flat.times)
        if there.any():
            t, number = timings.flat.times[there], timings.flat.numbers[there]
            ends.append(t.max() + _PATIENCE * (t.max() - timings.t0) / (number.max() + 1))
    return float(max(ends))
