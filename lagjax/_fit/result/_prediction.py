"""Prediction: the fitted scene over other records, those that were measured and those that are planned.

Both follow a record once with derivatives by its start and by the parameters. The uncertainty of a start that is fitted
to the record itself is that for fixed parameters and the way in which it follows these.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from scipy.special import ndtri, stdtrit

from lagjax._equations import has_constraints
from lagjax._fit.model._motions import step_budget
from lagjax._fit.model._noise import KnownNoise, NoiseScale
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._records import (
    Guess,
    Record,
    known_start,
    require_interpolation,
    require_records,
    restore_structure,
)
from lagjax._fit.model._residuals import Point, Residuals, SystemResiduals
from lagjax._fit.model._sensors import wrap_residuals
from lagjax._fit.result._comparison import effective_share
from lagjax._fit.result._information import (
    LEVEL,
    Information,
    covariance_of_one_start,
    require_level,
    signal_deviations,
)
from lagjax._fit.search._descent import minimise
from lagjax._fit.search._reader import build_reader, read_start
from lagjax._run import Trajectory, simulate
from lagjax._run.hybrid import first_law


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

    def __repr__(self) -> str:
        missed = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(self.residuals)]
        squares = np.concatenate([np.nansum(x**2, axis=0) / np.isfinite(x).sum(axis=0).clip(1) for x in missed])
        each = [f"{a:.3g} RMS (noise σ {b:.3g})" for a, b in zip(np.sqrt(squares), self.widths.sigma, strict=True)]
        return f"Prediction, which misses {len(missed[0])} samples by {', '.join(each)}; its motion:\n{self.trajectory}"

    def bands(self, level: float = LEVEL) -> tuple[PyTree, PyTree]:
        """(low, high) between which a new sample of weight one falls with probability `level`, noise included.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        require_level(level)
        columns, share = iter(range(len(self.widths.sigma))), 0.5 + 0.5 * level

        def half_width(deviation: np.ndarray) -> np.ndarray:
            flat = deviation.reshape(len(deviation), -1)
            own = [next(columns) for _ in range(flat.shape[1])]
            scatter = self.widths.sigma[own] * stdtrit(np.minimum(self.widths.dof[own], 1e9), share)
            return np.sqrt((ndtri(share) * flat) ** 2 + scatter**2).reshape(deviation.shape)

        half = jax.tree.map(half_width, self.deviation)
        return jax.tree.map(np.subtract, self.values, half), jax.tree.map(np.add, self.values, half)


def predict_record(fit, record: Record, system: str | None) -> Prediction:
    """The motion of the scene of a `Fit` over a record of the system of this name; see `Fit.predict`."""
    part = fit.residual_function.find_part(system)
    first = next((one for one in part.records if isinstance(one, Record)), None)
    if not isinstance(record, Record) or first is None:
        raise TypeError("Only a lagjax.Record is predicted, after a fit of some: for times ask lagjax.crossings.")
    [record] = require_records([record])
    if record.structure != first.structure:
        raise ValueError("The record has different signals from those of the fit.")
    if record.input_structure != first.input_structure:
        raise ValueError("The record has different inputs from those of the fit.")
    form, noise = part.signals.form, part.sensor_noise(fit.noise_scale)
    if form is not None:
        require_interpolation(record, form.hold, "the record")
    layout, n, about = part.layout, part.layout.size, _find_parameters(fit, part, record)
    state = known_start(record, layout, 0, about.params)
    is_fitted = state is None or isinstance(record.start, Guess)
    if state is None:
        state = read_start(build_reader(record, part, about.numbers), record, part, "This record")
    if is_fitted and part.manifold is None and has_constraints(first_law(part.scene)):
        raise ValueError("The start of this record lies on constraints that ask for `inputs`: give start=(q0, qdot0).")
    fixed = part.with_records([record], np.array([is_fitted]), part.manifold)
    moves = np.isin(np.arange(len(about.u)), about.own)
    residuals, point = Residuals([fixed], about.parameters.fix(about.u, ~moves)), Point(about.u[moves], state[None])
    done = is_fitted or moves.any()
    trial = (
        minimise(residuals, point, KnownNoise(noise), 1e-3).trial if done else residuals.evaluate(point, slopes=False)
    )
    state, about.u[moves] = trial.starts[0], trial.u
    start = layout.restore(state[:n]), layout.restore(state[n:])
    q0, qdot0, ts = jax.tree.map(lambda x: np.asarray(x, layout.dtype), (*start, record.ts))
    scene, params, samples = part.scene, about.params, 0
    if form is not None:
        samples = len(record.sampled_at)
        scene, params = form.bind_samples(scene, params, record.sampled_at, record.input_samples)
    trajectory = simulate(scene, q0, qdot0, ts, params, max_steps=step_budget(samples))
    planned, slopes = _follow_record(about, part, record, state)
    weights = record.weight_matrix * effective_share(fit) / noise.sigma**2
    own, follows = about.covariance(np.sqrt(weights)[..., None] * slopes, 2 * n, is_fitted)
    deviation = signal_deviations(slopes, 2 * n + len(about.own), own, follows, about.known)
    missed = wrap_residuals(planned.matrix - record.matrix, part.signals.periods)
    missed = np.where(record.weight_matrix > 0, missed, np.nan)
    values, missed, deviation = (restore_structure(x, record) for x in (planned.matrix, missed, deviation))
    noise = noise._replace(sigma=noise.sigma * np.sqrt(fit.information.lost))
    return Prediction(trajectory, values, missed, start, deviation, noise)


class _RecordParameters(NamedTuple):
    """The parameters of a fit for one record at u (F,), and what is `known` of those that its values do not determine:
    all but its `own`, the places in u of the numbers that a record which was not fitted does not share."""

    parameters: Parameters
    u: np.ndarray
    own: np.ndarray
    known: Information

    @property
    def numbers(self) -> np.ndarray:
        return self.parameters.numbers(self.u)[self.parameters.places[0]]

    @property
    def params(self) -> PyTree:
        return self.parameters.restore(self.numbers)

    def covariance(self, rows: np.ndarray, states: int, fits_start: bool) -> tuple[np.ndarray, np.ndarray]:
        """The covariance (K, K) of the start and the numbers of its own that are fitted to a record with weighted
        `rows` (T, S, 2n + L), zero for a start that is not, and how they follow what all records share (K, …)."""
        count = states + len(self.own)
        fitted = np.append(np.full(states, fits_start), np.ones(len(self.own), bool))
        own, follows = np.zeros((count, count)), np.zeros((count, rows.shape[-1] - count))
        if fitted.any():
            some = np.concatenate([rows[..., :count][..., fitted], rows[..., count:]], axis=-1)
            own[np.ix_(fitted, fitted)], follows[fitted] = covariance_of_one_start(some, int(fitted.sum()), self.known)
        return own, follows


def _find_parameters(fit, part: SystemResiduals, record: Record) -> _RecordParameters:
    parameters, places = fit.parameters, [k for k, one in enumerate(fit.records) if one is record]
    u, own = fit.u.copy(), np.zeros(0, int)
    if places or not parameters.unknowns.own:
        parameters = parameters.select(places[:1] or [0])
    else:
        parameters, u = parameters.extend(u, part.frame.records)
        own = parameters.unknowns.columns[0, : parameters.unknowns.own]
    return _RecordParameters(parameters, u, own, fit.information.select(parameters.unknowns.columns[0, len(own) :]))


def _follow_record(about: _RecordParameters, system: SystemResiduals, record: Record, state: np.ndarray):
    """A record with what sensors would show for its values, from a state (2n,), and their derivatives (T, S, D)."""
    everywhere = replace(record, values=restore_structure(np.zeros_like(record.matrix), record), weights=None)
    residuals = Residuals([system.with_records([everywhere], np.array([True]))], about.parameters)
    trial = residuals.evaluate(Point(about.u, state[None]))
    shown = np.where(residuals.weights.reshape(record.matrix.shape) > 0, trial.residuals[0][0], np.nan)  # of a delay
    return replace(record, values=restore_structure(shown, record)), trial.slopes[0][0]


def planned_rows(fit, part: SystemResiduals, name: str, record: Record) -> np.ndarray:
    """The rows (M, F) of a planned record in units of the noise, its start eliminated where it is not known."""
    if not isinstance(record, Record) or record.start is None:
        raise ValueError(
            f"The planned record {name} needs a start: (q0, qdot0), or lagjax.Guess(q0, qdot0) to be fitted."
        )
    about = _find_parameters(fit, part, record)
    state = known_start(record, part.layout, 0, about.params)
    assert state is not None
    planned, slopes = _follow_record(about, part, record, state)
    sigma = part.sensor_noise(fit.noise_scale).sigma[:, None]
    weights = planned.weight_matrix[..., None] * (effective_share(fit) / sigma**2)
    rows, count = np.sqrt(weights) * slopes, part.states + len(about.own)
    follows = about.covariance(rows, part.states, isinstance(record.start, Guess))[1]
    found = np.zeros((*rows.shape[:2], len(fit.u)))
    found[..., about.parameters.unknowns.columns[0, len(about.own) :]] = rows[..., count:] - rows[..., :count] @ follows
    return found.reshape(-1, len(fit.u))
