"""Sensors: signals of a motion with their derivatives, sensors with a delay, and sensors that show angles.

It holds `Delayed`, `Wrapped` and `Signals`.

**Delays.** `Delayed` sensors show at a time t what was at t − τ. The motion is followed at the times t − τ themselves,
so that nothing is interpolated, and with ẏ its rate there

    δy(t − τ) = δy − ẏ δτ

Before a record begins nothing is known: the samples of its first `longest` units of time are left out, whatever the
delay of a trial is, so that the sum of squares does not jump where a delay passes a sample.

**Wrapped sensors** show a value less whole periods. An encoder or `atan2` shows an angle less whole turns. A residual e
of such a signal is known up to a period P as well, and the likeliest is the smallest, e − P round(e/P). Where the
samples are close enough to tell which way an angle went, neighbours less than `_CLEAR` of a period apart, the data are
made continuous once, and states are read off that.

A jump that was not announced would count as motion of a huge speed, and no fit follows it. Three things together
identify it: it is larger than the steps beside it; it stays; and less a period it is no larger than these steps.

**Signals.** `observe(q, qdot)` makes signals of a state, by default q itself. It may ask for `t` and `params`, so that
a gain, a bias or a mounting position can be fitted, too, and for the sampled `inputs` of the record.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit._motions import RecordMotion
from lagjax._fit._noise import find_step
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Form, Record, restore_structure, spread_over_signals
from lagjax._interface import Layout, accept, halves

PyTree = Any


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


class Delay(NamedTuple):
    """One of the delays: the `signals` that have it, its value, and its derivatives by all parameters (P,)."""

    signals: np.ndarray
    value: float
    slopes: np.ndarray


class Delays:
    """The delays of the signals of records, as functions of the parameters."""

    def __init__(self, delayed: Delayed, parameters: Parameters, record: Record):
        leaves, tree = jax.tree.flatten(record.values)
        places = np.split(np.arange(record.matrix.shape[1]), np.cumsum([x[0].size for x in leaves])[:-1])
        self.longest = float(delayed.longest)

        def evaluate(numbers):
            given = delayed.delay(parameters.restore(numbers))
            try:
                spread = tree.flatten_up_to(jax.tree.broadcast(given, record.values))
            except ValueError:
                raise ValueError("delay must return one number, or a prefix of the structure of values.") from None
            if any(jnp.shape(one) != () for one in spread):
                raise ValueError("delay must return numbers, one for all signals or one for each leaf of values.")
            return jnp.stack([jnp.asarray(one, numbers.dtype) for one in spread])

        self._value_and_jacobian = jax.jit(lambda numbers: (evaluate(numbers), jax.jacfwd(evaluate)(numbers)))
        self.places = places
        # Leaves that share one number share one motion.
        jax.eval_shape(evaluate, jax.ShapeDtypeStruct(parameters.first.shape, parameters.first.dtype))

    def evaluate(self, numbers: np.ndarray) -> list[Delay]:
        """The different delays at the parameters `numbers` (P,)."""
        values, slopes = (np.asarray(x, float) for x in self._value_and_jacobian(numbers))
        rows, which = np.unique(np.concatenate([values[:, None], slopes], axis=1), axis=0, return_inverse=True)
        which = which.ravel()
        return [
            Delay(np.concatenate([self.places[i] for i in np.flatnonzero(which == k)]), float(row[0]), row[1:])
            for k, row in enumerate(rows)
        ]

    def refuses(self, delays: list[Delay]) -> str | None:
        """Why a trial with these delays is none, as a sentence."""
        for one in delays:
            if not 0.0 <= one.value <= self.longest:
                return f"A delay is {one.value:.4g}, but must lie between 0 and the longest one, {self.longest:g}."
        return None


_CLEAR = 0.35  # of a period between neighbours: at a half the way round is ambiguous; noise takes the rest
_UNCLEAR = 0.05  # share of steps that may be longer, over gaps and glitches: states are read well where most are not
_SHARP = 3.0  # times the steps beside it that a jump is large: a tent of noise is 2, and a period of 6 samples is 5
_NEAR = (
    1.5  # times these steps that it may differ from a period: acceleration changes them by less from one to the next
)
_ENOUGH = 20  # samples of which one jump by a whole turn is no chance; of shorter records, and other periods, two
_TURNS = {2 * np.pi: "2π", 360.0: "360"}  # whole turns: a signal may jump by one wherever it is
_PERIODS = {**_TURNS, np.pi: "π", 180.0: "180", 1.0: "1"}  # of a signal that stays within one of them

UNCLEAR = (
    "{} needs a start, because a wrapped signal moves by more than a third of its period from one sample to the next, "
    "so that no one can tell which way: give start=(q0, qdot0) if it is known, else start=lagjax.Guess(q0, qdot0)."
)


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
        jump = _jump(column[there], positions)
        if jump is not None:
            place, period = jump
            raise ValueError(
                f"{name} of {called} jumps by {period} between samples {there[place]} and {there[place + 1]}, t = "
                f"{record.ts[there[place]]:g}: it shows an angle, or a count, less whole turns, and no motion jumps. "
                f"Make it continuous with np.unwrap(values, period=...), or say observe=lagjax.wrapped(...); "
                "observe=lagjax.wrapped(jnp.inf) lets the signal jump as it does."
            )


def _jump(y: np.ndarray, positions: bool) -> tuple[int, str] | None:
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
    sharp &= ~_isolated_steps(y, steps) & ~(steps < 2.5 * find_step(y))  # lines of a coarse encoder
    for period, text in _PERIODS.items():
        fits = sharp & (np.abs(steps - period) <= _NEAR * beside + 1e-6 * period)
        edge = 2 * np.max(beside[fits], initial=0.0)
        once = period in _TURNS and len(y) >= _ENOUGH
        within = any(a - edge <= low and high <= a + period + edge for a in (0.0, -period / 2))
        if (within and fits.sum() > 1 - once) or (period in _TURNS and fits.sum() > 1):
            return int(np.argmax(fits)), text
    # A count whose number in a turn is unknown: it goes from one end of its range to the other, twice.
    ends = sharp & (np.abs(steps - (high - low)) <= _NEAR * beside)
    if positions and ends.sum() > 1:
        return int(np.argmax(ends)), f"about {high - low:.4g}"
    return None


def _isolated_steps(y: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """True for each step that belongs to a sample that is off by itself: the next step leads back."""
    back = np.zeros(len(steps), bool)
    alone = np.abs(y[2:] - y[:-2]) < 0.5 * np.minimum(steps[1:], steps[:-1])
    back[:-1] |= alone
    back[1:] |= alone
    return back


_AT_ONCE = 2048  # samples in one call of the compiled sensors: one program for records of any length
_NEWTON, _CLOSE = 8, 1e-6  # steps from what sensors show to positions, and the last of them: noise is larger
_SINGULAR = 1e8  # condition from which sensors do not tell positions: that of units which differ by a million is less


class Signals:
    """The sensors of a fit: `names` (S,), and the map from motions to signals and their derivatives.

    `periods` (S,) are infinite where a signal is not wrapped; `evaluate_state` is the map (y, t, numbers, inputs) →
    signals (S,) of one state, for JAX.
    """

    def __init__(
        self,
        observe: Callable | Delayed | None,
        layout: Layout,
        parameters: Parameters,
        record: Record | None,
        form: Form | None = None,
    ):
        self.layout, self.parameters, self.form = layout, parameters, form
        self.observe = observe
        self.delays: Delays | None = None
        if record is None:
            self.names, self._value_and_jacobians, self.periods = (), None, np.zeros(0)
            return
        if isinstance(observe, Delayed):
            self.delays = Delays(observe, parameters, record)
        of_state, wrap = sensors(observe)
        self.periods = np.full(record.matrix.shape[1], np.inf) if wrap is None else wrap.periods(record)
        if of_state is None:
            self.names, self._value_and_jacobians, self.evaluate_state = (
                layout.names,
                None,
                lambda y, *_: y[: layout.size],
            )
            if record.structure != (layout.tree, layout.shapes):
                raise ValueError(
                    f"values must have the structure of q, {layout.tree} of shapes {layout.shapes}, where there is no "
                    f"`observe`; records[0] has {record.structure[0]} of {record.structure[1]}."
                )
            return
        function = accept(of_state, "observe", extras=("t", "params", "inputs"))
        if form is None and "inputs" in function.extras:
            raise ValueError("observe asks for `inputs`, which records[0] has none of: give Record(..., inputs=...).")
        self.names = tuple("values" + name for name in record.names)

        def observe_state(y, t, numbers, inputs):
            q, qdot = map(layout.restore, halves(y))
            extras = {} if form is None else {"inputs": form.restore(inputs)}
            return function(q, qdot, t=t, params=parameters.restore(numbers), **extras)

        _require_signals(observe_state, layout, parameters, record, 0 if form is None else form.size)
        flat = lambda *state: jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(observe_state(*state))])  # noqa: E731

        def value_and_jacobians(y, t, inputs, numbers):
            state = y, t, numbers, inputs
            return flat(*state), *jax.jacfwd(flat, argnums=(0, 2, 1, 3))(*state)

        self.evaluate_state = flat
        self._value_and_jacobians = jax.jit(jax.vmap(value_and_jacobians, in_axes=(0, 0, 0, None)))

    def evaluate(
        self, motion: RecordMotion, ts: np.ndarray, inputs: np.ndarray, numbers: np.ndarray, numbers_dot: np.ndarray,
        ts_dot: np.ndarray | None = None, rates: np.ndarray | None = None,
    ):  # fmt: skip
        """The signals (N, T, S) of motions, and their derivatives (N, T, S, D) along the directions of these.

        `ts` (N, T) and `inputs` (N, T, I) are times and inputs there, `numbers` (P,) the parameters and `numbers_dot`
        (D, P) their directions. Where the times move, too, by `ts_dot` (D,), the inputs have `rates` (N, T, I), and
        `motion` moves with the times already.
        """
        tangents = motion.tangents
        if self._value_and_jacobians is None:
            n = self.layout.size
            return motion.path[..., :n], np.ascontiguousarray(np.moveaxis(tangents[..., :n], 1, -1))
        rows, times, states = motion.path.shape
        samples = motion.path.reshape(-1, states), ts.ravel(), inputs.reshape(rows * times, -1)
        values, by_state, by_numbers, by_t, by_inputs = self._evaluate_portions(samples, numbers)
        shape = rows, times, values.shape[1]
        slopes = np.matmul(by_state.reshape(*shape, states), np.moveaxis(tangents, 1, -1))
        slopes += (by_numbers @ numbers_dot.T).reshape(*shape, len(numbers_dot))
        if ts_dot is not None and rates is not None:
            rate = by_t + np.einsum("msi,mi->ms", by_inputs, rates.reshape(len(by_t), -1))
            slopes += rate.reshape(shape)[..., None] * ts_dot
        return values.reshape(shape), slopes

    def look_like_positions(self, record: Record) -> bool:
        """True if the signals are positions, or something of their structure (with a gain, a bias): a start for q."""
        return sensors(self.observe)[0] is None or record.structure == (self.layout.tree, self.layout.shapes)

    def positions(self, record: Record, numbers: np.ndarray) -> Record:
        """The record with the coordinates that make sensors of the structure of q show its values, by Newton's method.

        They are those of the record itself where there is no `observe`, and where these steps do not end: sensors that
        show a gain, a bias, degrees do with two. Sensors that wrap by themselves, as `atan2` does, never show what was
        made continuous: for these whole periods do not count.
        """
        if self._value_and_jacobians is None:
            return record
        there = np.isfinite(record.matrix).all(axis=1)
        instants = record.ts[there], record.input_matrix[there]
        for periods in (np.full(len(self.periods), np.inf), self.periods):
            q = self._newton(record.matrix[there], instants, numbers, periods)
            if q is not None:
                found = np.full(record.matrix.shape, np.nan)
                found[there] = q
                return replace(record, values=restore_structure(found, record), weights=None)
        return record

    def _newton(self, shown: np.ndarray, instants: tuple, numbers: np.ndarray, periods: np.ndarray):
        """q (M, n) for which sensors show `shown` (M, n), up to whole periods; None where the steps do not end."""
        q, rest, n = shown.copy(), np.zeros_like(shown), self.layout.size
        for _ in range(_NEWTON):
            values, by_state, *_ = self._evaluate_portions((np.concatenate([q, rest], axis=1), *instants), numbers)
            left, slope = wrap_residuals(values - shown, periods), by_state[..., :n]
            if not (np.isfinite(left).all() and (np.linalg.cond(slope) < _SINGULAR).all()):
                return None
            step = np.linalg.solve(slope, left[..., None])[..., 0]
            q -= step
            if np.abs(step).max(initial=0.0) <= _CLOSE * np.abs(q).max(initial=0.0):
                return q
        return None

    def _evaluate_portions(self, samples, numbers):
        assert self._value_and_jacobians is not None
        parts = []
        for begin in range(0, len(samples[0]), _AT_ONCE):
            some = [x[begin : begin + _AT_ONCE] for x in samples]
            filled = [np.resize(x, (_AT_ONCE, *x.shape[1:])) for x in some]
            arrays = (np.asarray(x, self.layout.dtype) for x in (*filled, numbers))
            parts.append([np.asarray(x, float)[: len(some[0])] for x in self._value_and_jacobians(*arrays)])
        return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def _require_signals(observe_state, layout: Layout, parameters: Parameters, record: Record, inputs: int) -> None:
    """Raise `ValueError` where `observe` does not return what the records hold."""
    shapes = (2 * layout.size,), (), parameters.first.shape, (inputs,)
    out = jax.eval_shape(observe_state, *(jax.ShapeDtypeStruct(shape, layout.dtype) for shape in shapes))
    leaves, tree = jax.tree.flatten(out)
    got = tree, tuple(getattr(leaf, "shape", ()) for leaf in leaves)
    if any(np.issubdtype(np.result_type(leaf), np.complexfloating) for leaf in leaves):
        raise ValueError("observe returns complex numbers: return their real and imaginary parts.")
    if got != record.structure:
        raise ValueError(
            f"observe returns {got[0]} of shapes {got[1]} at one time, but the values of a record have "
            f"{record.structure[0]} of shapes {record.structure[1]} after their axis of times."
        )
