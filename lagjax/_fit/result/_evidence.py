"""Evidence: how smooth a learned function is, from the recordings.

The numbers of a learned function have the prior density exp(−λ Σ u²/2) over the m of its unknowns u that are rough. The
evidence of λ is the integral of the likelihood times this density. About the fit the motion is linear in u, with H the
square of its weighted derivatives, so that the integral is known, and is largest where

    λ = γ / Σ u²      γ = Σ (1 − λ C_kk)      C = (H + λ)⁻¹

γ is the number of unknowns that the recordings determine. Where residuals are correlated the data tell a share of H,
and a search, which counts every sample, has the strength λ over that share. The fixed point is found in the linear
model, then the motion is fitted anew, and so forth, until λ stays.

Source: MacKay, Neural Computation 4 (1992) 415, eqs. 4.6 to 4.9.
"""

import contextlib
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lagjax._fit.model._autocorrelation import independent_share
from lagjax._fit.model._noise import AbstractNoise, NoiseScale
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial
from lagjax._fit.model._transforms import Smooth
from lagjax._fit.result._information import parameter_rows
from lagjax._fit.search._descent import Descent, minimise

_ENOUGH, _TRIALS = 1e-3, 60  # of the last search
_ENOUGH_OF_ROUND = 1e-3  # of those before for each sample: a strength that will change needs a rough fit
_ROUNDS = 20  # of fits, most of which take two trials
_SAME = 0.1  # |log λ| between two fits: intervals differ by a hundredth
_STRAIGHT_LINE = 0.01  # numbers of the shape that data determine: with fewer λ is any that is large enough
_KNOTS_FULL = 0.96  # of the numbers that knots allow: with more, finer knots show more, and intervals are wrong without
_INNER, _INNER_SAME = 200, 1e-3  # rounds in the linear model
# λ over what data say of an unknown: a function that data determine at every knot, and one that is a straight line.
_WEAKEST, _STRONGEST = 1e-15, 1e12
_FIRST = 1e-9  # of what data say: less than they do but where they say nothing
_FELT = 1e-4  # of the most that data say about a number at a knot: below, motion does not come near it
_SEEN = 0.5  # of the prior variance of a second difference: where the posterior variance is less, data were seen


class SmoothPart(NamedTuple):
    """The leaf of a learned function: its label, its transform, and its rough unknowns among the F."""

    label: str
    transform: Smooth
    rough: np.ndarray
    own: slice


def begin_weakly(residuals: Residuals, point: Point, law: AbstractNoise) -> Residuals:
    """The residuals with priors that are weak beside the data at a point.

    Unchanged without priors, and where no motion can be integrated.
    """
    if not smooth_parts(residuals.parameters):
        return residuals
    with contextlib.suppress(LostMotion):
        trial = residuals.evaluate(point)
        square = _data_square(residuals, trial, residuals.noise_scale(trial, law))
        parts = smooth_parts(residuals.parameters)
        strengths = {part.label: _FIRST * _mean_information(square, part) for part in parts}
        return residuals.with_parameters(residuals.parameters.replace_strengths(strengths))
    return residuals


def find_smoothness(done: Descent, law: AbstractNoise, tell: Callable[[str], None] | None) -> Descent:
    """The fit with the prior strengths of learned functions that maximise the evidence; unchanged without priors."""
    if not smooth_parts(done.residuals.parameters):
        return done
    trials, text, last, pace = done.trials, "The smoothness did not settle.", {}, 1.0
    for _ in range(_ROUNDS):
        parts = smooth_parts(done.residuals.parameters)
        before, moves = {part.label: part.transform.strength for part in parts}, _find_moves(done, parts)
        # Correlation of residuals depends on what a prior leaves, and strengths may go back and forth.
        pace *= 0.5 if any(moves[name] * last.get(name, 0.0) < 0.0 for name in moves) else 1.0
        strengths, last = {name: before[name] * math.exp(pace * moves[name]) for name in before}, moves
        residuals = done.residuals.with_parameters(done.residuals.parameters.replace_strengths(strengths))
        done = minimise(residuals, done.trial, law, _ENOUGH_OF_ROUND * residuals.measured, _TRIALS)
        trials += done.trials
        if tell is not None:
            tell(", ".join(f"{name}: strength {value:.3g}" for name, value in strengths.items()))
        if max(map(abs, moves.values())) < _SAME:
            text = ""
            break
    done = minimise(done.residuals, done.trial, law, _ENOUGH, _TRIALS)
    square = _data_square(done.residuals, done.trial, done.noise)
    covariance = _covariance(square, done.residuals.parameters.prior_weights**2)
    parts = smooth_parts(done.residuals.parameters)
    said = [text, *describe_sizes(done.residuals.parameters)] if text else []
    full = [_describe_full(part) for part in parts if _is_full(covariance, part)]
    message = " ".join([done.message, *said, *(_sentence(square, covariance, part) for part in parts), *full])
    converged = done.converged and not (text or full or any(_is_passed(square, part) for part in parts))
    return done._replace(converged=converged, trials=trials + done.trials, message=message)


def _is_full(covariance: np.ndarray, part: SmoothPart) -> bool:
    return _count_numbers(covariance, part, part.transform.strength) > _KNOTS_FULL * len(part.rough)


def _describe_full(part: SmoothPart) -> str:
    return (
        f"That is all that the knots of {part.label} allow: the function may be finer, and its intervals leave that "
        "out. Take a larger count, half as many again."
    )


def smooth_parts(parameters: Parameters) -> list[SmoothPart]:
    """The leaves of learned functions among the free parameters."""
    return [
        SmoothPart(part.label, part.transform, own.start + np.flatnonzero(part.transform.rough), own)
        for own, _, part in parameters.cuts
        if isinstance(part.transform, Smooth)
    ]


def describe_sizes(parameters: Parameters) -> list[str]:
    """A sentence about the learned functions whose size the search may not have found, if there are any."""
    labels = [part.label for part in smooth_parts(parameters) if np.isfinite(part.transform.largest)]
    if not labels:
        return []
    return [
        f"Is the size of {', '.join(labels)} far from where the search began? Begin nearer: "
        "law.interpolate(lambda v: 0.01) in params0 begins at 0.01 in the units of the scene."
    ]


def _find_moves(done: Descent, parts: list[SmoothPart]) -> dict[str, float]:
    """The changes of log λ of each learned function, by label, to the fixed point in the model that is linear about a
    fit; zero of a function that is a straight line before and there."""
    square, prior = _data_square(done.residuals, done.trial, done.noise), done.residuals.parameters.prior_weights
    target = square @ done.trial.u + prior**2 * done.trial.u
    share = independent_share(done.residuals, done.trial, done.noise)
    precision, found = prior**2, {part.label: part.transform.strength for part in parts}
    numbers, first = {}, {}
    for _ in range(_INNER):
        covariance = _covariance(square, precision)
        u, moved = covariance @ target, 0.0
        for part in parts:
            before, own = found[part.label], u[part.rough]
            numbers[part.label] = _count_numbers(covariance, part, before)
            determined = max(numbers[part.label], 1e-6)
            ends = np.array([_WEAKEST, _STRONGEST]) * _mean_information(square, part)
            value = float(np.clip(determined / max(share * float(own @ own), np.finfo(float).tiny), *ends))
            moved = max(moved, abs(np.log(value / before)))
            found[part.label] = value
            precision[part.rough] = value
        first = first or dict(numbers)
        if moved < _INNER_SAME:
            break
    return {
        part.label: 0.0
        if max(first[part.label], numbers[part.label]) < _STRAIGHT_LINE
        else math.log(found[part.label] / part.transform.strength)
        for part in parts
    }


def _count_numbers(covariance: np.ndarray, part: SmoothPart, strength: float) -> float:
    """The numbers of the shape of a learned function that data determine beside a prior of some strength."""
    return max(len(part.rough) - strength * float(np.diag(covariance)[part.rough].sum()), 0.0)


def _covariance(square: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """C (F, F) of the unknowns, from what the data and what the priors (F,) say; with a trace of one where neither
    says anything, of which there would be no inverse."""
    said = np.diag(square)
    trace = 1e-14 * np.where(said > 0.0, said, 1.0)
    return np.linalg.inv(square + np.diag(precision + trace))


def _mean_information(square: np.ndarray, part: SmoothPart) -> float:
    """The mean information about a rough unknown of a learned function; one where there is none."""
    mean = float(np.diag(square)[part.rough].mean())
    return mean if mean > 0.0 else 1.0


def _data_square(residuals: Residuals, trial: Trial, noise: NoiseScale) -> np.ndarray:
    """H (F, F), what the data say about the unknowns, the starts being free."""
    triangles = residuals.triangles(trial, residuals.fisher_factors(trial, noise))
    rows = parameter_rows(triangles, residuals.states, residuals.unknowns)
    return rows.T @ rows


def _sentence(square: np.ndarray, covariance: np.ndarray, part: SmoothPart) -> str:
    """A sentence: how many numbers of a learned function the data determine, and between which places they show it."""
    determined = _count_numbers(covariance, part, part.transform.strength)
    text = f"Data determine {determined:.1f} numbers of the shape of {part.label}"
    bends = np.diff(part.transform.basis, n=2, axis=0)
    before = np.sum((bends * part.transform.rough) ** 2, axis=1) / part.transform.strength
    after = np.einsum("kf,fg,kg->k", bends, covariance[part.own, part.own], bends)
    seen = 1 + np.flatnonzero(after < _SEEN * before)
    if (knots := part.transform.knots) is None:
        return f"{text}."
    felt, is_dense = _find_felt(square, part), determined >= max(1.0, 2.0 * seen.size)
    if is_dense and felt.size:  # together, where knots are too dense for each of them to be seen alone
        seen = felt
    if seen.size:
        where = f"seen from {knots[seen[0]]:.3g} to {knots[seen[-1]]:.3g}"
        return f"{text}, which was {where}; beyond, its interval is its prior's."
    if _is_passed(square, part):
        return (
            f"{text}: no motion was measured between the ends of its range, only its slope beyond one of them is seen."
        )
    if not felt.size:
        return f"{text}."
    where = f"from {knots[felt[0]]:.3g} to {knots[felt[-1]]:.3g}"
    return f"{text}: a straight line, where motion saw it, {where}; beyond, its interval takes it for one as well."


def _find_felt(square: np.ndarray, part: SmoothPart) -> np.ndarray:
    """The knots whose numbers the motion depends on by more than a trace."""
    back = part.transform.back
    each = np.einsum("fk,fg,gk->k", back, square[part.own, part.own], back)
    return np.flatnonzero(each > _FELT * each.max(initial=0.0))


def _is_passed(square: np.ndarray, part: SmoothPart) -> bool:
    """True if motion passes a learned function by: of its straight line beyond an end two numbers tell all."""
    felt = _find_felt(square, part)
    return part.transform.knots is not None and len(felt) == 2 and (felt.max() <= 1 or felt.min() >= len(part.rough))
