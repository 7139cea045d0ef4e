"""Signals of a motion with their derivatives, also of sensors with a delay.

**Signals.** `observe(q, qdot)` makes signals of a state, by default q itself. It may ask for `t` and `params`, so that
a gain, a bias or a mounting position can be fitted, too, and for the sampled `inputs` of the record.

**Delays.** `Delayed` sensors show at a time t what was at t − τ. The motion is followed at the times t − τ themselves,
so that nothing is interpolated, and with ẏ its rate there

    δy(t − τ) = δy − ẏ δτ

The samples of the first `longest` are left out whatever the delay of a trial is, so that the sum of squares does not
jump where a delay passes a sample.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._fit.model._inputs import InputForm
from lagjax._fit.model._motions import RecordMotion
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._records import Record, restore_structure
from lagjax._fit.model._sensors import Delayed, sensors, wrap_residuals
from lagjax._interface import Layout, accept, halves


class Delay(NamedTuple):
    """One of the delays: the `signals` that have it, its `values` (N,), and their derivatives by the parameters (N, P)
    of N pieces."""

    signals: np.ndarray
    values: np.ndarray
    slopes: np.ndarray


class Delays:
    """The delays of the signals of records, as functions of the parameters."""

    def __init__(self, delayed: Delayed, parameters: Parameters, record: Record):
        leaves, tree = jax.tree.flatten(record.values)
        self.places = np.split(np.arange(record.matrix.shape[1]), np.cumsum([x[0].size for x in leaves])[:-1])
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

        both = lambda numbers: (evaluate(numbers), jax.jacfwd(evaluate)(numbers))  # noqa: E731
        self._value_and_jacobian = jax.jit(jax.vmap(both, out_axes=1))
        jax.eval_shape(evaluate, parameters.example)

    def evaluate(self, numbers: np.ndarray) -> list[Delay]:
        """The delays for the parameters (N, P) of pieces. Leaves that share one in all pieces share one motion."""
        values, slopes = (np.asarray(x, float) for x in self._value_and_jacobian(numbers))
        rows = np.concatenate([values[..., None], slopes], axis=2)
        _, first, which = np.unique(rows.reshape(len(rows), -1), axis=0, return_index=True, return_inverse=True)
        groups = [np.flatnonzero(which.ravel() == k) for k in range(len(first))]
        signals = [np.concatenate([self.places[i] for i in group]) for group in groups]
        return [Delay(own, values[k], slopes[k]) for own, k in zip(signals, first, strict=True)]


_AT_ONCE = 2048  # samples in one call of the compiled sensors: one program for records of any length
_NEWTON, _CLOSE = 8, 1e-6  # steps from what sensors show to positions, and the last of them: noise is larger
_SINGULAR = 1e8  # condition from which sensors do not tell positions: that of units which differ by a million is less


class Signals:
    """The sensors of a fit: `names` (S,), and the map from motions to signals and their derivatives.

    `periods` (S,) are infinite where a signal is not wrapped; `evaluate_state` is the map (y, t, numbers, inputs) →
    signals (S,) of one state, for JAX.
    """

    def __init__(
        self, observe: Callable | Delayed | None, layout: Layout, parameters: Parameters, record: Record | None,
        form: InputForm | None = None,
    ):  # fmt: skip
        self.layout, self.form, self.observe = layout, form, observe
        self.delays: Delays | None = None
        if record is None:
            self.names, self._value_and_jacobians, self.periods = (), None, np.zeros(0)
            return
        if isinstance(observe, Delayed):
            self.delays = Delays(observe, parameters, record)
        of_state, wrap = sensors(observe)
        self.periods = np.full(record.matrix.shape[1], np.inf) if wrap is None else wrap.periods(record)
        if of_state is None:
            self.names, self._value_and_jacobians = layout.names, None
            self.evaluate_state = lambda y, *_: y[: layout.size]
            if record.structure != (layout.tree, layout.shapes):
                raise ValueError(
                    f"values must have the structure of q, {layout.tree} of shapes {layout.shapes}, where there is no "
                    f"`observe`; records[0] has {record.structure[0]} of {record.structure[1]}."
                )
            return
        function = accept(of_state, "observe", extras=("t", "params", "inputs"))
        if form is None and "inputs" in function.extras:
            raise ValueError("observe asks for `inputs`, which records[0] has none of: give Record(..., inputs=...).")
        said = getattr(of_state, "__name__", "<lambda>")  # a dict has names of its own
        whole = "values" if said == "<lambda>" or isinstance(record.values, dict) else said
        self.names = tuple(whole + name for name in record.names)

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
        self._value_and_jacobians = jax.jit(jax.vmap(value_and_jacobians))

    def evaluate(
        self, motion: RecordMotion, ts: np.ndarray, inputs: np.ndarray, numbers: np.ndarray, numbers_dot: np.ndarray,
        ts_dot: np.ndarray | None = None, rates: np.ndarray | None = None,
    ):  # fmt: skip
        """The signals (N, T, S) of motions, and their derivatives (N, T, S, D) along the directions of these.

        `ts` (N, T) and `inputs` (N, T, I) are times and inputs there, `numbers` (N, P) the parameters and `numbers_dot`
        (N, D, P) their directions. Where the times move, too, by `ts_dot` (N, D), the inputs have `rates` (N, T, I),
        and `motion` moves with the times already.
        """
        tangents = motion.tangents
        if self._value_and_jacobians is None:
            n = self.layout.size
            return motion.path[..., :n], np.ascontiguousarray(np.moveaxis(tangents[..., :n], 1, -1))
        rows, times, states = motion.path.shape
        samples = motion.path.reshape(-1, states), ts.ravel(), inputs.reshape(rows * times, -1)
        each = np.repeat(numbers, times, axis=0)
        values, by_state, by_numbers, by_t, by_inputs = self._evaluate_portions(*samples, each)
        shape = rows, times, values.shape[1]
        slopes = np.matmul(by_state.reshape(*shape, states), np.moveaxis(tangents, 1, -1))
        moved = np.matmul(by_numbers.reshape(rows, times * shape[2], -1), numbers_dot.swapaxes(1, 2))
        slopes += moved.reshape(slopes.shape)
        if ts_dot is not None and rates is not None:
            rate = by_t + np.einsum("msi,mi->ms", by_inputs, rates.reshape(len(by_t), -1))
            slopes += rate.reshape(shape)[..., None] * ts_dot[:, None, None]
        return values.reshape(shape), slopes

    def look_like_positions(self, record: Record) -> bool:
        """True if the signals are positions, or something of their structure (with a gain, a bias): a start for q."""
        return sensors(self.observe)[0] is None or record.structure == (self.layout.tree, self.layout.shapes)

    def positions(self, record: Record, numbers: np.ndarray) -> Record:
        """The record with coordinates for which sensors of the structure of q show its values, by Newton's method; the
        record itself where the steps do not end. Sensors that wrap never show continuous values: up to periods, then.
        """
        if self._value_and_jacobians is None:
            return record
        there = np.isfinite(record.matrix).all(axis=1)
        instants = record.ts[there], record.interpolate_inputs(record.ts[there])
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
        each = np.broadcast_to(numbers, (len(q), len(numbers)))
        for _ in range(_NEWTON):
            values, by_state, *_ = self._evaluate_portions(np.concatenate([q, rest], axis=1), *instants, each)
            left, slope = wrap_residuals(values - shown, periods), by_state[..., :n]
            if not (np.isfinite(left).all() and (np.linalg.cond(slope) < _SINGULAR).all()):
                return None
            step = np.linalg.solve(slope, left[..., None])[..., 0]
            q -= step
            if np.abs(step).max(initial=0.0) <= _CLOSE * np.abs(q).max(initial=0.0):
                return q
        return None

    def _evaluate_portions(self, *samples):
        assert self._value_and_jacobians is not None
        parts = []
        for begin in range(0, len(samples[0]), _AT_ONCE):
            some = [x[begin : begin + _AT_ONCE] for x in samples]
            arrays = (np.resize(x, (_AT_ONCE, *x.shape[1:])).astype(self.layout.dtype) for x in some)
            parts.append([np.asarray(x, float)[: len(some[0])] for x in self._value_and_jacobians(*arrays)])
        return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def _require_signals(observe_state, layout: Layout, parameters: Parameters, record: Record, inputs: int) -> None:
    """Raise `ValueError` where `observe` does not return what the records hold."""
    shapes = (2 * layout.size,), (), parameters.example.shape, (inputs,)
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
