"""Prediction: the fitted scene over other records, those that were measured and those that are planned.

It holds `Prediction`, `predict_record` (the motion of a record with bands) and `planned_rows` (the rows of a planned
record, for experiment design). Both follow a record once with derivatives by its start and by the parameters. The
uncertainty of a start that is fitted to the record itself is that for fixed parameters and the way in which it follows
these.
"""

from dataclasses import replace
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from scipy.special import ndtri, stdtrit

from lagjax._fit.model._noise import KnownNoise, NoiseScale
from lagjax._fit.model._records import (
    Guess,
    Record,
    known_start,
    require_interpolation,
    require_records,
    restore_structure,
)
from lagjax._fit.model._residuals import LostTrial, Residuals, SystemPart, SystemResiduals, Trial
from lagjax._fit.model._sensors import UNCLEAR, wrap_residuals
from lagjax._fit.result._comparison import effective_share
from lagjax._fit.result._information import LEVEL, covariance_of_one_start, require_level, signal_deviations
from lagjax._fit.search._descent import minimise
from lagjax._fit.search._reader import build_reader
from lagjax._run import Trajectory, simulate

PyTree = Any


class Prediction(NamedTuple):
    """A record as the fitted scene follows it.

    - `trajectory`: the motion from `start`, (q0, qdot0), at the record's times.
    - `values`: the signals that the sensors would show; `residuals`: those less the measured ones, NaN where missing.
    - `deviation`: the standard deviation of `values`, because the parameters, and a start that was fitted, are known
      only so well. It is infinite where the values depend on what is not seen. `widths`: the noise of a new sample.
    """

    trajectory: Trajectory
    values: PyTree
    residuals: PyTree
    start: tuple[PyTree, PyTree]
    deviation: PyTree
    widths: NoiseScale

    def bands(self, level: float = LEVEL) -> tuple[PyTree, PyTree]:
        """(low, high) between which a new sample of weight one falls with probability `level`, noise included.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        require_level(level)
        columns = iter(range(len(self.widths.sigma)))
        half = jax.tree.map(lambda leaf: _half_widths(leaf, self.widths, level, columns), self.deviation)
        return jax.tree.map(np.subtract, self.values, half), jax.tree.map(np.add, self.values, half)


def _half_widths(deviation: np.ndarray, noise: NoiseScale, level: float, columns) -> np.ndarray:
    """Half of the band of one leaf of signals, whose places among all signals are the next of `columns`."""
    flat = deviation.reshape(len(deviation), -1)
    own = [next(columns) for _ in range(flat.shape[1])]
    scatter = noise.sigma[own] * stdtrit(np.minimum(noise.dof[own], 1e9), 0.5 + 0.5 * level)
    return np.sqrt((ndtri(0.5 + 0.5 * level) * flat) ** 2 + scatter**2).reshape(deviation.shape)


def predict_record(fit, record: Record, system: str | None) -> Prediction:
    """The motion of the scene of a `Fit` over a record of the system of this name; see `Fit.predict`."""
    [record], part = require_records([record]), fit.residual_function.find_part(system)
    about = part.system
    first = next((one for one in about.records if isinstance(one, Record)), None)
    if not isinstance(record, Record) or first is None:
        raise TypeError("Only a lagjax.Record is predicted, after a fit of some: for times ask lagjax.crossings.")
    if record.structure != first.structure:
        raise ValueError("The record has other signals than those of the fit.")
    if record.input_structure != first.input_structure:
        raise ValueError("The record has other inputs than those of the fit.")
    if about.signals.form is not None:
        require_interpolation(record, about.signals.form.hold, "the record")
    layout, fixed = about.layout, fit.parameters.fix(fit.u)
    state = known_start(record, layout, 0, fit.params)
    is_known = state is not None and not isinstance(record.start, Guess)
    if state is None:
        state = _read_start(record, about, fit.parameters.numbers(fit.u))
    residuals = Residuals([about.with_records([record], np.array([not is_known]), fixed, about.manifold)])
    if is_known:
        point = residuals.evaluate(np.zeros(0), state[None])
    else:
        done = minimise(
            residuals, np.zeros(0), state[None], KnownNoise(part.sensor_noise(fit.noise_scale)), enough=1e-3
        )
        point = done if isinstance(done, LostTrial) else done.point
    if isinstance(point, LostTrial):
        raise ValueError(residuals.describe_failure(point))
    n = layout.size
    start = layout.restore(point.starts[0, :n]), layout.restore(point.starts[0, n:])
    ts = np.asarray(record.ts, layout.dtype)
    q0, qdot0 = (jax.tree.map(lambda x: np.asarray(x, layout.dtype), half) for half in start)
    form, driven = about.signals.form, (record.sampled_at, record.input_samples)
    scene, params = about.scene, fit.params
    scene, params = (scene, params) if form is None else form.bind_samples(scene, params, *driven)
    trajectory = simulate(scene, q0, qdot0, cast(jax.Array, ts), params)  # NumPy's is as good
    values, deviation = _predict_signals(fit, part, record, residuals, point)
    left = wrap_residuals(values - record.matrix, about.signals.periods)
    left = np.where(record.weight_matrix > 0, left, np.nan)
    noise = part.sensor_noise(fit.noise_scale)
    noise = noise._replace(sigma=noise.sigma * np.sqrt(fit.information.lost))
    shown, missed, uncertain = (restore_structure(matrix, record) for matrix in (values, left, deviation))
    return Prediction(trajectory, shown, missed, start, uncertain, noise)


def _predict_signals(fit, part: SystemPart, record: Record, residuals: Residuals, point: Trial):
    """The signals (T, S) of a record that was followed, at all its times, and their standard deviations."""
    planned, slopes = _follow_record(fit, part.system, record, point.starts[0])
    known, states = fit.information, residuals.states
    own, follows = np.zeros((states, states)), np.zeros((states, len(fit.u)))
    if residuals.fitted[0]:
        rows = np.sqrt(record.weight_matrix)[..., None] / part.sensor_noise(fit.noise_scale).sigma[:, None] * slopes
        own, follows = covariance_of_one_start(rows, states, known, effective_share(fit))
    return planned.matrix, signal_deviations(slopes, states, own, follows, known)


def _follow_record(fit, system: SystemResiduals, record: Record, state: np.ndarray) -> tuple[Record, np.ndarray]:
    """A record with what sensors would show for its values, from a state (2n,), and their derivatives (T, S, D)."""
    everywhere = replace(record, values=restore_structure(np.zeros_like(record.matrix), record), weights=None)
    about = Residuals([system.with_records([everywhere], np.array([True]), fit.parameters)])
    full = about.evaluate(fit.u, state[None])
    if isinstance(full, LostTrial):
        raise ValueError(about.describe_failure(full))
    shown = np.where(about.batches[0].weights[0] > 0, full.residuals[0][0], np.nan)  # NaN before a delay is over
    return replace(record, values=restore_structure(shown, record)), full.slopes[0][0]


def _read_start(record: Record, about: SystemResiduals, numbers: np.ndarray) -> np.ndarray:
    """The first state of a record from local polynomials. Raises where its signals are no positions."""
    reader = build_reader(record, about, numbers)
    if reader is not None:
        return reader.states(np.array([0]))[0]
    if about.signals.look_like_positions(record):
        raise ValueError(UNCLEAR.format("This record"))
    raise ValueError("This record needs a start: give start=(q0, qdot0), or lagjax.Guess(q0, qdot0) to fit it.")


def planned_rows(fit, part: SystemPart, name: str, record: Record) -> np.ndarray:
    """The rows (M, F) of a planned record in units of the noise, its start eliminated where it is not known."""
    if not isinstance(record, Record) or record.start is None:
        raise ValueError(
            f"The planned record {name} needs a start: (q0, qdot0), or lagjax.Guess(q0, qdot0) if that is to be fitted."
        )
    state = known_start(record, part.system.layout, 0, fit.params)
    assert state is not None
    planned, slopes = _follow_record(fit, part.system, record, state)
    sigma = part.sensor_noise(fit.noise_scale).sigma[:, None]
    weights = planned.weight_matrix[..., None] * (effective_share(fit) / sigma**2)
    rows, states = np.sqrt(weights) * slopes, part.system.states
    own = rows[..., states:]
    if isinstance(record.start, Guess):
        own = own - rows[..., :states] @ covariance_of_one_start(rows, states, fit.information, 1.0)[1]
    return own.reshape(-1, own.shape[-1])
