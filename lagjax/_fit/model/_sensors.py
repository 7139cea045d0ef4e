"""Sensors as a user describes them: with a delay, or showing a value less whole periods; and unannounced jumps.

An encoder or `atan2` shows an angle less whole turns. A residual e of such a signal is known up to a period P as well,
and the likeliest is the smallest, e − P round(e/P). Where the samples are close enough to tell which way an angle went,
neighbours less than `_CLEAR` of a period apart, the data are made continuous once, and states are read off that.

A jump that was not announced would count as motion of a huge speed, and no fit follows it. Three things together
identify it: it is larger than the steps beside it; it stays; and less a period it is no larger than these steps.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from lagjax._fit.model._noise import find_step
from lagjax._fit.model._records import Record, restore_structure, spread_over_signals

_CLEAR = 0.35  # of a period between neighbours: at a half the way round is ambiguous; noise takes the rest
_UNCLEAR = 0.05  # share of steps that may be longer, over gaps and glitches: states are read well where most are not
_SHARP = 3.0  # times the steps beside it that a jump is large: a tent of noise is 2, and a period of 6 samples is 5
_NEAR = 1.5  # times these steps that it may differ from a period: acceleration changes them by less in one sample
_BETWEEN = 0.4, 0.75  # of a period: many steps of noise are so long, of a signal less whole periods few are
_ENOUGH = 20  # samples of which one jump by a whole turn is no chance; of shorter records, and other periods, two
_TURNS = {2 * np.pi: "2π", 360.0: "360"}  # whole turns: a signal may jump by one wherever it is
_PERIODS = {**_TURNS, np.pi: "π", 180.0: "180", 1.0: "1"}  # of a signal that stays within one of them
UNCLEAR = (
    "{} needs a start, because a wrapped signal moves by more than a third of its period from one sample to the next, "
    "so that no one can tell which way: give start=(q0, qdot0) if it is known, else start=lagjax.Guess(q0, qdot0)."
)


@dataclass(frozen=True)
class Delayed:
    """Sensors with a delay: `fit(..., observe=lagjax.Delayed(lambda params: params["tau"], longest=0.1))`.

    - `delay`: a function of the parameters that returns the delay of all signals, or a prefix of the structure of a
      record's `values` with one for each. It is fitted like any parameter, with exact derivatives.
    - `longest`: the largest possible delay. The samples in the first `longest` of every record are left out, because
      they may show the motion before its start. A trial whose delay is negative or larger than `longest` counts as
      failed; the transform `lagjax.between(0.0, longest)` keeps the delay inside.
    - `observe`: what the sensors show, as for `fit`; by default q. It gets the state, the time and the inputs at the
      delayed time.

    **Raises** `TypeError` or `ValueError` for a `longest` that is no positive number.

    ```python
    import lagjax

    sensors = lagjax.Delayed(lambda params: params["delay"], longest=0.1, observe=lambda q, qdot: q)
    transforms = {"delay": lagjax.between(0.0, 0.1), "mass": lagjax.positive}
    # lagjax.fit(..., observe=sensors, transforms=transforms)
    ```
    """

    delay: Callable
    longest: float
    observe: Callable | None = None

    def __post_init__(self):
        if not callable(self.delay):
            raise TypeError(f"delay must be a function of the parameters; got {self.delay!r}.")
        if not (eqx.is_array_like(self.longest) and np.ndim(self.longest) == 0 and 0 < self.longest < np.inf):
            raise ValueError(f"longest must be a positive number, the largest possible delay; got {self.longest!r}.")


def wrapped(period: PyTree, observe: Any = None) -> "Wrapped":
    """Sensors that show a value less whole periods: `fit(..., observe=lagjax.wrapped(2 * jnp.pi))`.

    A residual e then is the smallest of e + k·period, for whole k. Sensors like this are encoders, `atan2`, a phase.

    - `period`: one positive number for all signals, or a prefix of the structure of a record's `values` with one for
      each leaf, where None, or infinity, stands for a signal that is not wrapped; of a leaf with several signals an
      array with a period for each.
    - `observe`: what the sensors show, as for `fit`, whether or not it is less whole periods; by default q. A delay
      goes outside: `lagjax.Delayed(..., observe=lagjax.wrapped(period))`.

    Starts are read off the data as long as the signal moves by less than a third of a period from one sample to the
    next; beyond, no one can tell which way it went, and every record needs a start.

    **Raises** `TypeError` or `ValueError` for what is no period.

    ```python
    import jax.numpy as jnp, lagjax

    sensors = lagjax.wrapped(2 * jnp.pi)
    of_two = lagjax.wrapped({"x": None, "theta": 360.0}, lambda q, qdot: {"x": q[0], "theta": jnp.degrees(q[1])})
    # lagjax.fit(..., observe=sensors)
    ```
    """
    return Wrapped(period, observe)


@dataclass(frozen=True)
class Wrapped:
    """The result of `wrapped`: `observe`, as the user gave it, with the `period` of its signals."""

    period: PyTree
    observe: Any = None

    def __post_init__(self):
        if isinstance(self.observe, Wrapped | Delayed):
            raise TypeError(
                "observe within lagjax.wrapped must be a function or None. A delay goes outside: "
                "lagjax.Delayed(delay, longest, observe=lagjax.wrapped(period))."
            )
        if self.observe is not None and not callable(self.observe):
            raise TypeError(f"observe must be a function of the state, or None; got {self.observe!r}.")
        for leaf in jax.tree.leaves(self.period, is_leaf=lambda leaf: leaf is None):
            try:
                size = np.asarray(np.inf if leaf is None else leaf, float)
            except (TypeError, ValueError):
                raise TypeError(f"A period must be a number, an array of numbers, or None; got {leaf!r}.") from None
            if not (size > 0).all():
                raise ValueError(f"A period must be positive; got {leaf!r}.")

    def periods(self, record: Record) -> np.ndarray:
        """The period of each signal (S,), infinite where it is not wrapped. Raises where there is not one for each."""
        each = spread_over_signals(self.period, record, "period")
        return np.where(np.isnan(each), np.inf, each)


def sensors(observe) -> tuple[Any, Wrapped | None]:
    """The function of the state within what a user gave as `observe`, None for q itself; and how it is wrapped."""
    inner = observe.observe if isinstance(observe, Delayed) else observe
    return (inner.observe, inner) if isinstance(inner, Wrapped) else (inner, None)


def wrap_residuals(residuals, periods: np.ndarray, xp: Any = np):
    """Residuals (..., S) less whole periods (S,), of which some may be infinite."""
    if not np.isfinite(periods).any():
        return residuals
    turn = np.where(np.isfinite(periods), periods, 1.0)
    return xp.where(np.isfinite(periods), residuals - turn * xp.round(residuals / turn), residuals)


def unwrap_record(record: Record, periods: np.ndarray) -> Record | None:
    """The record with its wrapped signals made continuous; None where samples are too far apart to tell how."""
    if not np.isfinite(periods).any():
        return record
    matrix = record.matrix.copy()
    for column, period in enumerate(periods):
        there = np.isfinite(matrix[:, column])
        if not (np.isfinite(period) and there.any()):
            continue
        smooth = np.unwrap(matrix[there, column], period=period)
        if np.mean(np.abs(np.diff(smooth)) > _CLEAR * period) > _UNCLEAR:
            return None
        matrix[there, column] = smooth
    weights = None if record.weights is None else restore_structure(record.weight_matrix, record)
    return replace(record, values=restore_structure(matrix, record), weights=weights)


def require_no_jumps(record: Record, called: str, names: tuple[str, ...], positions: bool) -> None:
    """Raise `ValueError` where a signal of a record jumps by a period; `positions` of a scene cannot jump at all."""
    for name, column in zip(names, record.matrix.T, strict=True):
        there = np.flatnonzero(np.isfinite(column))
        jump = _find_period_jump(column[there], positions)
        if jump is not None:
            place, period = jump
            raise ValueError(
                f"{name} of {called} jumps by {period} between samples {there[place]} and {there[place + 1]}, t = "
                f"{record.ts[there[place]]:g}: it shows an angle, or a count, less whole turns, and no motion jumps. "
                f"Make it continuous with np.unwrap(values, period=...), or say observe=lagjax.wrapped(...); "
                "observe=lagjax.wrapped(jnp.inf) lets the signal jump as it does."
            )


def _find_period_jump(y: np.ndarray, positions: bool) -> tuple[int, str] | None:
    """The sample before a jump by a period, and that period in words; None where there is none."""
    steps = np.abs(np.diff(y))
    if len(steps) < 8:
        return None
    padded = np.pad(steps, 3, constant_values=0.0)
    # The steps beside each, of which one may be a jump itself: the second largest of the three on either side.
    beside = np.stack([padded[k : k + len(steps)] for k in (0, 1, 2, 4, 5, 6)], axis=-1)
    beside = np.sort(beside, axis=-1)[:, -2]
    low, high = y.min(), y.max()
    sharp = steps > _SHARP * np.maximum(beside, 1e-9 * (high - low))
    alone = _isolated_steps(y, steps)
    sharp &= ~alone & ~(steps < 2.5 * find_step(y))  # lines of a coarse encoder
    for period, text in _PERIODS.items():
        fits = sharp & (np.abs(steps - period) <= _NEAR * beside + 1e-6 * period)
        if _count_between(steps[~alone], period) > fits.sum():
            continue
        edge = 2 * np.max(beside[fits], initial=0.0)
        once = period in _TURNS and len(y) >= _ENOUGH
        within = any(a - edge <= low and high <= a + period + edge for a in (0.0, -period / 2))
        if (within and fits.sum() > 1 - once) or (period in _TURNS and fits.sum() > 1):
            return int(np.argmax(fits)), text
    # A count whose number in a turn is unknown: it goes from one end of its range to the other, twice.
    ends = sharp & (np.abs(steps - (high - low)) <= _NEAR * beside)
    if positions and ends.sum() > 1 and _count_between(steps[~alone], high - low) <= ends.sum():
        return int(np.argmax(ends)), f"about {high - low:.4g}"
    return None


def _count_between(steps: np.ndarray, period: float) -> int:
    return int(((steps > _BETWEEN[0] * period) & (steps < _BETWEEN[1] * period)).sum())


def _isolated_steps(y: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """True for each step that belongs to a sample that is off by itself: the next step leads back."""
    back = np.zeros(len(steps), bool)
    alone = np.abs(y[2:] - y[:-2]) < 0.5 * np.minimum(steps[1:], steps[:-1])
    back[:-1] |= alone
    back[1:] |= alone
    return back
