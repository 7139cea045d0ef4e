"""Descent: `minimise`, damped Gauss–Newton for residuals, and `eliminate`, its step.

It is Gauss–Newton with Levenberg's and Marquardt's damping; starts are eliminated one by one. The damped
step (δu, δs₁ … δs_N) minimises Σₖ |Aₖ δsₖ + Bₖ δu + rₖ|² + λ |scale · step|². One QR of the small triangle of piece k
takes out δsₖ: its first 2n rows say what δsₖ follows from δu, the rest says what piece k wants of δu. Of the unknowns
that move numbers of one record alone the same is said by a QR of the rests of its pieces. What is left then, below each
other, is a problem of the columns that all records share. That is the Schur complement of the normal equations, which
are an arrow, without ever forming them, which would square the condition; the cost is linear in the number of pieces,
and in that of records.

Which library: none, for this step. `scipy.optimize.least_squares` (trf) factors one dense Jacobian of F + 2nN columns,
which is cubic in the number of pieces, or takes inexact steps by LSMR on a sparse one: from the same start to the same
end of 160 pieces, 695 and 82 ms where this takes 30. optimistix has neither blocks nor bounds and compiles its loop
anew for every shape. Bounds are transforms, robust losses are weights (`_noise`), and the tests hold the end point to
that of `scipy.optimize.least_squares`.

Source: Moré, *The Levenberg–Marquardt algorithm: implementation and theory* (1978), for scaling by columns; Madsen,
Nielsen & Tingleff, *Methods for non-linear least squares problems* (2004), §3.2, for λ; Bock (1987) for elimination.
"""

import contextlib
import functools
from typing import NamedTuple

import numpy as np

from lagjax._fit.model._autocorrelation import independent_share
from lagjax._fit.model._noise import AbstractNoise, NoiseScale
from lagjax._fit.model._parameters import Unknowns
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial, compress_rows, qr_triangle

# Damping, relative to the squared norms of the columns. The first step is nearly that of Gauss and Newton; below the
# least one, damping is below the round-off of derivatives and only keeps columns that nothing depends on from moving.
_FIRST, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-14, 1e12
_PATIENCE = 12  # trials that lowered the sum of squares by less than ends a search, while derivatives promised more
_NEAR = 1e-3  # per sample: where it pays to look at how much the residuals are correlated
# A second derivative is found at a part of a step, and taken if it adds no more than a part of its length.
_NEARBY, _MOST_ACCELERATION = 0.1, 0.375
_TAKEN_BACK = 8  # trials of a search: of that many in turn the last step is 2⁻³⁶ as long as the first
_FLAT = 1e-13  # relative: half the sum of squares is itself rounded to so much
_STOPPED = (
    "The search was stopped after {}: half the sum of squares may fall by {:.2g}. Continue from there, with fit.params "
    "in place of params0."
)
_KINK = (
    "The search stopped at a kink of the sum of squares after {}: derivatives promise to lower half of it by "
    "{:.2g}, the last {} trials lowered it by {:.2g}. Motion that sticks, or strikes, has such kinks; friction that "
    "changes sign over a small velocity, tanh(v/width), has none."
)


class Descent(NamedTuple):
    """The end of a search: the last trial with its noise, the number of trials, and a sentence."""

    residuals: Residuals
    trial: Trial
    noise: NoiseScale
    converged: bool
    trials: int
    message: str


class DescentStep(NamedTuple):
    """δu (F,), δs (N, 2n), and by how much half the sum of squares falls if all is linear."""

    u: np.ndarray
    starts: np.ndarray
    gain: float


class Anchor(NamedTuple):
    """A penalty Σ (weight · (u − centre))²/2: unknowns on which the data say little stay at the `centre`."""

    centre: np.ndarray
    weight: np.ndarray

    def weighted_residuals(self, u: np.ndarray) -> np.ndarray:
        return self.weight * (u - self.centre)

    def add_prior(self, weight: np.ndarray) -> "Anchor":
        """The anchor that includes a normal prior Σ (weight · u)²/2; the constant is dropped."""
        both = np.hypot(self.weight, weight)
        return Anchor(self.centre * (self.weight / np.where(both > 0, both, 1.0)) ** 2, both)


class _Model:
    """The least squares about one trial, with the noise and the weights of its samples; `cost` is half their sum."""

    def __init__(self, residuals: Residuals, trial: Trial, law: AbstractNoise, anchor: Anchor):
        self.residuals, self.trial, self.anchor = residuals, trial, anchor
        self.noise = residuals.noise_scale(trial, law)
        self.factors = residuals.factors(trial, self.noise)
        self.triangles, self.unknowns = self._linearise(trial)
        self.cost = self.cost_of(trial)

    def _linearise(self, trial: Trial) -> tuple[np.ndarray, Unknowns]:
        triangles, unknowns = self.residuals.linearise(trial, self.noise), self.residuals.unknowns
        if unknowns.own or triangles[..., : self.residuals.states].any():
            return triangles, unknowns
        return compress_rows(triangles.reshape(1, -1, triangles.shape[-1])), unknowns.select([0])  # no piece's own

    def cost_of(self, trial: Trial) -> float:
        pulled = 0.5 * float(np.sum(self.anchor.weighted_residuals(trial.u) ** 2))
        return self.residuals.cost(trial, self.factors, self.noise) + pulled

    def evaluate(self, point: Point) -> tuple[Trial, float]:
        """The trial at a point, with derivatives if it is better, and by how much it is. Raises `LostMotion`."""
        trial = self.residuals.evaluate(point, slopes=False)
        fall = self.cost - self.cost_of(trial)
        return self.residuals.evaluate(point, begun=trial) if fall > 0.0 else trial, fall

    def solve_step(self, damping: float, limits: tuple[np.ndarray, np.ndarray] | None = None) -> DescentStep:
        u, states, unknowns = self.trial.u, self.residuals.states, self.unknowns
        limits = self.residuals.parameters.limits(u) if limits is None else limits
        pull = self.anchor.weight, self.anchor.weighted_residuals(u)
        scale = column_norms(self.triangles, states, unknowns)
        return eliminate(self.triangles, states, scale, damping, pull, unknowns, limits)

    def accelerate_step(self, step: DescentStep, damping: float) -> DescentStep | None:
        """The step with its geodesic acceleration, which follows a valley that bends: half of the second derivative of
        motions along the step, from one more trial near its beginning. None where that is no small correction.

        Source: Transtrum & Sethna, *Improvements to the Levenberg–Marquardt algorithm* (2012), arXiv:1201.5885.
        """
        at, residuals = self.trial, self.residuals
        try:
            near = residuals.evaluate(self.move(step, _NEARBY), slopes=False)
        except LostMotion:
            return None
        curved, starts = [], np.broadcast_to(step.starts, at.starts.shape)
        pairs = zip(residuals.batches, at.residuals, near.residuals, at.slopes, strict=True)
        for batch, before, after, slopes in pairs:
            local = np.append(step.u, 0.0)[residuals.unknowns.columns[batch.rows]]
            along = np.concatenate([starts[residuals.leads[batch.rows]], local], axis=1)
            curved.append(((after - before) / _NEARBY - np.einsum("ntsd,nd->nts", slopes, along)) / _NEARBY)
        triangles, unknowns = self._linearise(at._replace(residuals=curved))
        of_starts, of_u = scale = column_norms(triangles, residuals.states, unknowns)
        pull, limits = (self.anchor.weight, np.zeros_like(at.u)), residuals.parameters.limits(at.u)
        more = eliminate(triangles, residuals.states, scale, damping, pull, unknowns, limits)
        sizes = [np.hypot(np.linalg.norm(of_u * x.u), np.linalg.norm(of_starts * x.starts)) for x in (step, more)]
        if not sizes[1] < _MOST_ACCELERATION * sizes[0]:
            return None
        return DescentStep(step.u + more.u, step.starts + more.starts, step.gain)

    def move(self, step: DescentStep, part: float = 1.0) -> Point:
        """The point at a part of a step."""
        u = self.residuals.parameters.take_step(self.trial.u, part * step.u)
        return Point(u, self.trial.starts + part * step.starts)

    def try_long_step(self, enough: float) -> tuple[float, Trial | None]:
        """The gain that a step promises which may end anywhere in the sets of numbers, and a better trial on its way.

        Next to a bound, where a positive number is too small by many orders, u has no slope, and no step within reach
        has any gain.
        """
        residuals = self.residuals
        step = self.solve_step(_LEAST_DAMPING, residuals.parameters.leaps(self.trial.u))
        if not self.is_enough(step.gain, enough):
            for part in (1.0, 0.1, 0.01):
                with contextlib.suppress(LostMotion):
                    trial, fall = self.evaluate(self.move(step, part))
                    if not self.is_enough(fall, enough):
                        return step.gain, trial
        return step.gain, None

    def is_enough(self, gain: float, enough: float) -> bool:
        """True if half the sum of squares is at most `enough`, correlated residuals counted for what they are worth."""
        if enough < gain <= _NEAR * self.residuals.measured:
            gain *= independent_share(self.residuals, self.trial, self.noise)
        return gain <= enough


def minimise(
    residuals: Residuals, begin: Point | Trial, law: AbstractNoise, enough: float, limit: int = 60,
    anchor: Anchor | None = None,
) -> Descent:  # fmt: skip
    """The unknowns that make the measurements likeliest, by a search from a point, or from a trial of these residuals.

    It ends when a step without damping, within the reach of the transforms, promises to lower half the sum of squares,
    in units of the noise, by less than `enough`: then no parameter is further than √(2 enough) standard deviations from
    the minimum.
    Raises `LostMotion` where the motion from the first trial cannot be followed.
    """
    trial = begin if isinstance(begin, Trial) else residuals.evaluate(begin)
    anchor = Anchor(trial.u, np.zeros_like(trial.u)) if anchor is None else anchor
    anchor = anchor.add_prior(residuals.parameters.prior_weights)
    done, blind = _descend(residuals, trial, law, enough, limit, anchor, 1, _TAKEN_BACK)
    if blind is None or residuals.log_likelihood(blind, residuals.noise_scale(blind, law)) <= (
        residuals.log_likelihood(done.trial, done.noise)
    ):
        return done
    return _descend(residuals, blind, law, enough, limit, anchor, done.trials, 0)[0]


def _descend(
    residuals: Residuals, trial: Trial, law: AbstractNoise, enough: float, limit: int, anchor: Anchor, trials: int,
    takes_back: int,
) -> tuple[Descent, Trial | None]:  # fmt: skip
    """The end of the search from a trial, which `takes_back` this number of trials at most, and the last one of them.

    Those are better trials at which nothing depends any more on an unknown that mattered before: a contact that sticks
    says nothing of its friction, and no step leads out of there. Shorter steps are tried instead.
    """
    damping, falls, blind, limit = _FIRST, [(trials, np.inf)], None, trials + limit - 1
    while True:
        model = _Model(residuals, trial, law, anchor)
        gain = model.solve_step(_LEAST_DAMPING).gain
        end = functools.partial(Descent, residuals, trial, model.noise)
        if model.is_enough(gain, enough):
            gain, farther = model.try_long_step(enough)
            if farther is not None and trials < limit:
                trial, trials = farther, trials + 1
                continue
            if model.is_enough(gain, enough):
                return end(True, trials, f"The search converged after {_count_trials(trials)}."), blind
            return end(False, trials, _STOPPED.format(_count_trials(trials), gain)), blind
        recent = sum(fall for place, fall in falls if place > trials - _PATIENCE)
        if trials - falls[0][0] >= _PATIENCE and model.is_enough(recent, enough):
            return end(False, trials, _KINK.format(_count_trials(trials), gain, _PATIENCE, recent)), blind
        better, damping, trials, taken_back = _find_better_trial(model, damping, trials, limit, takes_back)
        takes_back -= len(taken_back)
        blind = taken_back[-1] if taken_back else blind
        if better is None and trials < limit:
            text = f"The search stopped where rounding hides what is left, after {_count_trials(trials)}."
            return end(True, trials, text), blind
        if better is None:
            return end(False, trials, _STOPPED.format(_count_trials(trials), gain)), blind
        falls.append((trials, model.cost - model.cost_of(better)))
        trial = better


def _count_trials(trials: int) -> str:
    return f"{trials} trial" + "s" * (trials != 1)


def _find_better_trial(
    model: _Model, damping: float, trials: int, limit: int, takes_back: int
) -> tuple[Trial | None, float, int, list[Trial]]:
    """The first better trial, the next damping, the count of trials, and those that were taken back; None instead of a
    trial after `limit` of them, or where steps promise no more than the rounding of sums of squares."""
    growth, at, residuals, blind = 2.0, model.trial, model.residuals, []
    seen = _find_seen(residuals, at)
    while trials < limit:
        step: DescentStep | None = model.solve_step(damping)
        if step.gain <= _FLAT * model.cost or damping > _MOST_DAMPING:
            break
        for straight in (True, False):
            trials += 1
            with contextlib.suppress(LostMotion):
                trial, fall = model.evaluate(model.move(step))
                if fall > 0.0 and len(blind) < takes_back and (seen & ~_find_seen(residuals, trial)).any():
                    blind.append(trial)
                elif fall > 0.0:
                    damping = max(_LEAST_DAMPING, damping * max(0.1, 1.0 - (2.0 * fall / step.gain - 1.0) ** 3))
                    return trial, damping, trials, blind
            step = model.accelerate_step(step, damping) if straight and trials < limit else None
            if step is None:
                break
        damping, growth = damping * growth, 2.0 * growth
    return None, damping, trials, blind


def _find_seen(residuals: Residuals, trial: Trial) -> np.ndarray:
    """The unknowns (F,), as a mask, on which anything that was measured depends at a trial."""
    each = np.zeros((len(residuals.pieces), residuals.unknowns.columns.shape[1]))
    for batch, slopes in zip(residuals.batches, trial.slopes, strict=True):
        each[batch.rows] = slopes[..., residuals.states :].any(axis=(1, 2))
    return residuals.unknowns.norms(each) > 0


def eliminate(
    triangles: np.ndarray, states: int, scale, damping: float, pull, unknowns: Unknowns, limits=(-np.inf, np.inf)
) -> DescentStep:
    """The damped step for triangles (N, D + 1, D + 1) whose first `states` columns are starts, and the others but the
    last those of `unknowns`. `scale` holds column norms, `pull` the (weight, residuals) of an anchor; steps beyond
    `limits` (low, high) are damped more."""
    of_starts, of_u = scale
    pieces, columns, _ = triangles.shape
    damped = np.zeros((pieces, states, columns))
    damped[:, np.arange(states), np.arange(states)] = np.sqrt(damping) * of_starts
    r = qr_triangle(np.concatenate([triangles, damped], axis=1))
    du = _limited_step(r[:, states:, states:], of_u, damping, pull, unknowns, limits)
    local = np.append(du, 0.0)[unknowns.columns]
    right = r[:, :states, -1] + np.matmul(r[:, :states, states:-1], local[..., None])[..., 0]
    ds = np.linalg.solve(r[:, :states, :states], -right[..., None])[..., 0]
    whole = np.concatenate([ds, local, np.ones((pieces, 1))], axis=1)
    after = np.sum((triangles @ whole[..., None]) ** 2)
    gain = np.sum(triangles[..., -1] ** 2) - after + np.sum(pull[1] ** 2) - np.sum((pull[1] + pull[0] * du) ** 2)
    return DescentStep(du, ds, float(0.5 * gain))


def _limited_step(rows: np.ndarray, of_u: np.ndarray, damping: float, pull, unknowns: Unknowns, limits) -> np.ndarray:
    """δu (F,) that minimises |rows (δu, 1)|² + |pull|² + Σ damping (scale δu)², over rows (N, M, L + 1) of pieces, with
    more damping of what is beyond limits. Where no damping is enough, as for the logarithm of a number that is too
    small by many orders, the step is shortened to them."""
    rows, each = unknowns.stack_by_owner(rows), np.full(len(of_u), damping)
    rows = rows if unknowns.own else compress_rows(rows.reshape(1, -1, rows.shape[-1]))
    while True:
        du = _damped_step(rows, np.sqrt(each) * of_u, pull, unknowns)
        beyond = (du < limits[0]) | (du > limits[1])
        if not beyond.any():
            return du
        if each[beyond].min() > _MOST_DAMPING:
            return du * np.min(np.where(du > 0, limits[1], limits[0])[beyond] / du[beyond])
        each[beyond] *= 10.0


def _damped_step(rows: np.ndarray, damping: np.ndarray, pull, unknowns: Unknowns) -> np.ndarray:
    """δu (F,) that minimises |rows (δu, 1)|² + |pull|² + |damping δu|²: the numbers of records, each behind its rows
    (O, M, L + 1), are eliminated from those that all share."""
    own, shared, alone = unknowns.own, unknowns.shared, unknowns.owner_rows.columns[:, : unknowns.own]

    def regular_rows(places: np.ndarray) -> np.ndarray:
        """The rows of damping and pull of the unknowns at `places` (..., K), and their residuals: (..., 2 K, K + 1)."""
        weights, count = [np.append(x, 1.0)[places] for x in (damping, pull[0])], places.shape[-1]
        found = np.zeros((*places.shape[:-1], 2 * count, count + 1))
        for k, weight in enumerate(weights):
            found[..., k * count + np.arange(count), np.arange(count)] = weight
        found[..., count:, -1] = np.append(pull[1], 0.0)[places]
        return found

    r = rows
    if own:
        more = np.zeros((len(rows), 2 * own, rows.shape[-1]))
        more[..., [*range(own), -1]] = regular_rows(alone)
        r = qr_triangle(np.concatenate([rows, more], axis=1))
    rest = compress_rows(r[:, own:, own:].reshape(1, -1, len(shared) + 1))[0]
    triangle = qr_triangle(np.concatenate([rest, regular_rows(shared)]))
    du = np.zeros(unknowns.count + 1)
    du[shared] = np.linalg.solve(triangle[: len(shared), : len(shared)], -triangle[: len(shared), -1])
    if own:
        right = r[:, :own, -1] + r[:, :own, own:-1] @ du[shared]
        du[alone] = np.linalg.solve(r[:, :own, :own], -right[..., None])[..., 0]
    return du[:-1]


def column_norms(triangles: np.ndarray, states: int, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """The norms of the columns of starts (N, 2n) and of unknowns (F,); one where nothing depends on a column."""
    of_starts = np.linalg.norm(triangles[..., :states], axis=1)
    of_u = unknowns.norms(np.linalg.norm(triangles[..., states:-1], axis=1))
    return np.where(of_starts > 0, of_starts, 1.0), np.where(of_u > 0, of_u, 1.0)
