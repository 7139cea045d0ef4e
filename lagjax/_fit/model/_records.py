"""Records: the measurements as the user gives them, checked; and several systems by their names."""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._fit.model._inputs import split_leaves
from lagjax._interface import Layout, labelled_leaves, require_concrete
from lagjax._scene import unevenly_spaced

_NO_PREFIX = "{} must be one number, or a prefix of the structure and shapes of values."


class Guess(NamedTuple):
    """A first guess (q, qdot) of a start that is to be fitted, in the structures of q and qdot.

    ```python
    import jax.numpy as jnp, lagjax

    ts = jnp.linspace(0.0, 1.0, 101)
    record = lagjax.Record(ts, jnp.cos(3.0 * ts), start=lagjax.Guess(0.9, 0.0))
    ```
    """

    q: PyTree
    qdot: PyTree


class MeasuredSignal:
    """The measurements of one motion: a `Record`, or `Timings`."""

    ts: np.ndarray
    start: Any
    matrix: np.ndarray
    weight_matrix: np.ndarray

    @property
    def begins(self) -> Any:
        """The `start` of the motion, that of the record of the same motion where it is one."""
        return self.start.start if isinstance(self.start, MeasuredSignal) else self.start

    def __len__(self) -> int:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Record(MeasuredSignal):
    """One recording: what was measured at which times.

    - `ts` (T,): the times, strictly increasing, T ≥ 2. Records need not be equally long, nor equally spaced.
    - `values`: the measured signals in the structure that `observe` returns, with the times as first axis of every
      leaf; by default that of q. NaN where a sample is missing.
    - `inputs`: what drove the scene, sampled at the same times or at `input_ts`, in any structure with the times as
      first axis of every leaf: a voltage, the motion of a support. Functions of the scene, and `observe`, that take
      `inputs` get its value at their time; `fit(..., hold=)` says how it continues between samples. No sample of it may
      be missing.
    - `start`: the state at `ts[0]`. A pair (q0, qdot0) is known and kept fixed. With `lagjax.Guess(q0, qdot0)` it is
      fitted, and the search begins there. With None it is fitted too, and the search begins at local polynomials
      through the values. A function of the parameters that returns (q0, qdot0) computes the start from them, as orbital
      elements give the positions of planets.
    - `input_ts` (K,): the times of the samples of `inputs`, where these are not `ts`: strictly increasing, from `ts[0]`
      or before up to `ts[-1]` or beyond; with `hold="zero"` the last one stays. Samples beyond both ends help "cubic"
      and "band".
    - `weights`: how much each sample counts, one number or a prefix of the structure of `values`: the variance of a
      sample is that of its signal over its weight. Zero leaves a sample out.

    **Raises** `TypeError` or `ValueError` where these cannot be right.

    ```python
    import jax.numpy as jnp, lagjax

    ts = jnp.linspace(0.0, 1.0, 101)
    record = lagjax.Record(ts, jnp.cos(3.0 * ts))
    ```
    """

    ts: np.ndarray
    values: PyTree
    inputs: PyTree = None
    start: tuple[PyTree, PyTree] | Guess | Callable | None = None
    weights: PyTree = None
    input_ts: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "ts", _times(self.ts))
        labels, leaves, tree = labelled_leaves(one_signal(self.values), "values")
        leaves = [_signal(leaf, label, len(self.ts)) for label, leaf in zip(labels, leaves, strict=True)]
        if not any(leaf.size for leaf in leaves):
            raise ValueError("values holds no signal: give an array with the times as first axis.")
        object.__setattr__(self, "values", tree.unflatten(leaves))
        if self.input_ts is not None:
            object.__setattr__(self, "input_ts", _times(self.input_ts, "input_ts"))
            _require_input_times(self)
        if self.inputs is not None:
            labels, leaves, tree = labelled_leaves(one_signal(self.inputs), "inputs")
            leaves = [_input(leaf, label, len(self.sampled_at)) for label, leaf in zip(labels, leaves, strict=True)]
            object.__setattr__(self, "inputs", tree.unflatten(leaves))
        require_start(self.start)
        assert self.weight_matrix is not None  # which raises for weights that cannot be right

    def __len__(self) -> int:
        return len(self.ts)

    def __repr__(self) -> str:
        signals = self.matrix.shape[1]
        missing = int(np.isnan(self.matrix).sum())
        gaps = f", {missing} values missing" if missing else ""
        return f"Record(t from {self.ts[0]:g} to {self.ts[-1]:g}, {len(self)} samples of {signals} signals{gaps})"

    @functools.cached_property
    def matrix(self) -> np.ndarray:
        """All signals side by side, (T, S); NaN where missing."""
        return np.concatenate([leaf.reshape(len(self), -1) for leaf in jax.tree.leaves(self.values)], axis=1)

    @property
    def sampled_at(self) -> np.ndarray:
        return self.ts if self.input_ts is None else self.input_ts

    @functools.cached_property
    def input_samples(self) -> np.ndarray:
        """All inputs side by side as they were sampled, (K, I)."""
        leaves, count = jax.tree.leaves(self.inputs), len(self.sampled_at)
        return np.concatenate([np.zeros((count, 0)), *(x.reshape(count, -1) for x in leaves)], axis=1)

    def interpolate_inputs(self, ts: np.ndarray) -> np.ndarray:
        """All inputs at the times `ts` (M,), side by side, (M, I), on lines between samples.

        That is for where a search begins. What a trial sees is what `hold` makes of them (`_stack_pieces`).
        """
        samples = self.input_samples.T
        columns = [np.interp(ts, self.sampled_at, column) for column in samples]
        return np.reshape(columns, (len(samples), len(ts))).T

    @functools.cached_property
    def input_structure(self) -> tuple | None:
        """The key that the inputs of all records of a fit share; None without inputs."""
        leaves, tree = jax.tree.flatten(self.inputs)
        return (tree, tuple(leaf.shape[1:] for leaf in leaves)) if leaves else None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the signals, (S,): `['x'][0]` or empty for the only one."""
        labels, leaves, _ = labelled_leaves(self.values, "")
        return tuple(
            label + (f"[{', '.join(map(str, index))}]" if leaf.ndim > 1 else "")
            for label, leaf in zip(labels, leaves, strict=True)
            for index in np.ndindex(leaf.shape[1:])
        )

    @functools.cached_property
    def structure(self) -> tuple:
        """The key that all records of a fit share: the tree of the signals and their shapes."""
        leaves, tree = jax.tree.flatten(self.values)
        return tree, tuple(leaf.shape[1:] for leaf in leaves)

    @functools.cached_property
    def weight_matrix(self) -> np.ndarray:
        """The weight of every sample (T, S), zero where it is missing.

        Raises `ValueError` for weights that fit no structure, or are negative.
        """
        leaves, columns = jax.tree.leaves(self.values), []
        weights = spread_prefix(1.0 if self.weights is None else self.weights, self.values, "weights")
        for weight, leaf in zip(weights, leaves, strict=True):
            weight = real_numbers(weight, "weights", "real numbers")
            weight = weight.reshape(weight.shape + (1,) * (leaf.ndim - weight.ndim)) if weight.ndim else weight
            columns.append(_broadcast(weight, leaf.shape, "weights").reshape(len(leaf), -1))
        matrix = np.concatenate(columns, axis=1)
        if not (np.isfinite(matrix).all() and (matrix >= 0).all()):
            raise ValueError("weights must be finite and not negative.")
        return np.where(np.isnan(self.matrix), 0.0, matrix)


def _times(ts, name: str = "ts") -> np.ndarray:
    times = real_numbers(ts, name, "an array of times")
    if times.ndim != 1 or len(times) < 2:
        raise ValueError(f"{name} must hold at least two times, in one dimension; got shape {times.shape}.")
    if not np.isfinite(times).all():
        raise ValueError(f"{name}[{int(np.argmin(np.isfinite(times)))}] is not finite: every time must be.")
    if not (np.diff(times) > 0).all():
        place = int(np.argmax(np.diff(times) <= 0))
        raise ValueError(
            f"{name} must increase strictly; {name}[{place}] = {times[place]:g} is followed by {times[place + 1]:g}. "
            "Sort the samples, and keep one of each time."
        )
    return times


def real_numbers(array, name: str, what: str) -> np.ndarray:
    """The numbers of an array, NaN where a masked one hides them. Raises `TypeError` where they are not real."""
    require_untraced(array, name)
    if getattr(array, "dtype", None) is not None and np.asarray(array).dtype.kind in "mM":
        raise TypeError(f"{name} holds dates or durations: give numbers, in s (t - t[0]) / np.timedelta64(1, 's').")
    try:
        if np.iscomplexobj(array):
            raise TypeError
        masked = isinstance(array, np.ma.MaskedArray)
        return np.ma.filled(array.astype(np.float64), np.nan) if masked else np.asarray(array, np.float64)
    except (TypeError, ValueError):
        of = f" of {array.dtype}" if hasattr(array, "dtype") else ""
        raise TypeError(f"{name} must be {what}; got {type(array).__name__}{of}.") from None


def require_untraced(tree: PyTree, what: str) -> None:
    require_concrete(
        tree,
        what,
        "A fit is a search with numbers, how long depends on what is met: fit outside of them. What can be "
        "differentiated is the density, `Fit.log_density()`, or a loss of your own around lagjax.simulate.",
    )


def one_signal(values: PyTree) -> PyTree:
    """A list of numbers as an array: it is one signal, not one signal for each."""
    is_list = isinstance(values, list | tuple) and values and all(np.ndim(value) == 0 for value in values)
    return np.asarray(values) if is_list else values


def _signal(leaf, label: str, times: int) -> np.ndarray:
    values = real_numbers(leaf, label, "an array of real numbers")
    if values.ndim == 0 or len(values) != times:
        raise ValueError(f"{label} must have the {times} times as its first axis; got shape {values.shape}.")
    if np.isinf(values).any():
        place = np.argwhere(np.isinf(values))[0].tolist()
        raise ValueError(f"{label}{place} is infinite: write NaN for a sample that is missing.")
    return values


def _require_input_times(record: Record) -> None:
    times, begin = record.sampled_at, record.ts[0]
    if record.inputs is None:
        raise ValueError("input_ts are the times of `inputs`, and there are none: give both.")
    if times[0] > begin:
        raise ValueError(
            f"input_ts begin at {times[0]:g}, after the record, which begins at t = {begin:g}: what the input was "
            "before is not known. Give more of the input, or less of the record."
        )


def require_interpolation(record: MeasuredSignal, hold: str, name: str) -> None:
    if not isinstance(record, Record) or record.inputs is None or hold == "zero":
        return
    times, end = record.sampled_at, record.ts[-1]
    if times[-1] < end:
        raise ValueError(
            f"input_ts of {name} end at {times[-1]:g}, before the record, which ends at t = {end:g}, and with "
            f"hold={hold!r} nothing is extrapolated: give more of the input, or less of the record."
        )
    called = "ts" if record.input_ts is None else "input_ts"
    if hold == "band" and (reason := unevenly_spaced(times, called)):
        raise ValueError(f"The inputs of {name}: {reason}")


def _input(leaf, label: str, times: int) -> np.ndarray:
    values = _signal(leaf, label, times)
    if np.isnan(values).any():
        place = np.argwhere(np.isnan(values))[0].tolist()
        raise ValueError(f"{label}{place} is NaN, but what drives a scene must be known at all times: fill it first.")
    return values


def require_start(start) -> None:
    if start is not None and not callable(start) and not (isinstance(start, tuple) and len(start) == 2):
        raise TypeError(
            "start must be (q0, qdot0), lagjax.Guess(q0, qdot0), a function of the parameters that returns "
            f"(q0, qdot0), or None; got {start!r}."
        )


def restore_structure(matrix: np.ndarray, record) -> PyTree:
    """Signals (T, S) in the structure of a record's values, or times (M, 1) in that of its times."""
    return split_leaves(matrix, *record.structure) if isinstance(record, Record) else record.restore(matrix)


def spread_prefix(prefix: PyTree, values: PyTree, what: str) -> list:
    """The leaves of a prefix of the structure of values, one for each of theirs. Raises `ValueError` for others."""
    try:
        return jax.tree.structure(values).flatten_up_to(jax.tree.broadcast(prefix, values))
    except ValueError:
        raise ValueError(_NO_PREFIX.format(what)) from None


def _broadcast(number: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        return np.broadcast_to(number, shape)
    except ValueError:
        raise ValueError(_NO_PREFIX.format(what)) from None


def spread_over_signals(given: PyTree, record: Record, what: str) -> np.ndarray:
    """The number of each signal (S,) of a record from a prefix of the structure of its values; NaN for None."""
    given = jax.tree.map(lambda x: np.nan if x is None else x, given, is_leaf=lambda x: x is None)
    pairs = zip(spread_prefix(given, record.values, what), jax.tree.leaves(record.values), strict=True)
    return np.concatenate([_broadcast(one, leaf.shape[1:], what).ravel() for one, leaf in pairs]).astype(float)


def require_records(records) -> list[Any]:
    """The records and timings as a list. Raises where there is none, or where records differ in their signals."""
    if not isinstance(records, MeasuredSignal | Iterable):
        raise TypeError(f"records must be a lagjax.Record, or a list of them; got {type(records).__name__}.")
    listed = [records] if isinstance(records, MeasuredSignal) else list(records)
    if not listed:
        raise ValueError("records is empty: a fit needs at least one lagjax.Record.")
    for place, record in enumerate(listed):
        if not isinstance(record, MeasuredSignal):
            raise TypeError(f"records[{place}] must be a lagjax.Record or Timings; got {type(record).__name__}.")
    _require_same_signals([(place, record) for place, record in enumerate(listed) if isinstance(record, Record)])
    for place, record in enumerate(listed):
        if not (record.weight_matrix > 0).any():
            raise ValueError(f"records[{place}] holds no sample: all its values are NaN or have no weight.")
        if isinstance(record.start, MeasuredSignal) and record.start not in listed:
            raise ValueError(
                f"records[{place}] begins with a record that is not among `records`: give that one, the same object."
            )
    return listed


def _require_same_signals(placed: list[tuple[int, Record]]) -> None:
    """Raise `ValueError` where records, with their places, differ in structure, or a signal is in none of them."""
    if not placed:
        return
    begin, first = placed[0]
    for place, record in placed:
        if record.structure != first.structure:
            raise ValueError(
                f"records[{place}] has different signals from records[{begin}]: {record.structure} and "
                f"{first.structure}."
            )
        if record.input_structure != first.input_structure:
            raise ValueError(
                f"records[{place}] has different inputs from records[{begin}]: {record.input_structure} and "
                f"{first.input_structure}."
            )
    measured = np.any([(record.weight_matrix > 0).any(axis=0) for _, record in placed], axis=0)
    if not measured.all():
        which = int(np.argmin(measured))
        raise ValueError(
            f"The signal values{first.names[which]} is NaN, or has no weight, at all times of all records: leave "
            "it out of `values` and of what `observe` returns."
        )


def known_start(record: MeasuredSignal, layout: Layout, place: int, params: PyTree) -> np.ndarray | None:
    """The start state (2n,) that a record gives: known, guessed or a function of `params`; None if it gives none."""
    if record.begins is None:
        return None
    q, qdot = start_pair(record.begins, params)
    halves = [jax.tree.flatten(half) for half in (q, qdot)]
    if any(tree != layout.tree or tuple(map(np.shape, leaves)) != layout.shapes for leaves, tree in halves):
        own = Layout.from_state(q, qdot)
        raise ValueError(
            f"The start of records[{place}] has coordinates {list(own.names)}, not {list(layout.names)} as the others."
        )
    state = np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves((q, qdot))])
    if not np.isfinite(state).all():
        raise ValueError(f"The start of records[{place}] is not finite.")
    return state


def start_pair(start, params: PyTree) -> tuple[PyTree, PyTree]:
    """The pair (q0, qdot0) of a start that is there. Raises `TypeError` where a function returns something else."""
    pair = start(params) if callable(start) else start
    if not (isinstance(pair, tuple) and len(pair) == 2):
        raise TypeError(f"start, as a function of the parameters, must return (q0, qdot0); got {pair!r}.")
    return jax.tree.map(_convert_to_float, pair[0]), jax.tree.map(_convert_to_float, pair[1])


def _convert_to_float(number):
    if isinstance(number, float | np.ndarray) and np.asarray(number).dtype.kind == "f":
        return number  # without a hundred microseconds in JAX for each of many records
    if not eqx.is_array_like(number) or jnp.issubdtype(kind := jnp.result_type(number), jnp.complexfloating):
        raise TypeError(f"A start must hold real numbers; got {number!r}.")
    return number if jnp.issubdtype(kind, jnp.floating) else jnp.asarray(number, float)
