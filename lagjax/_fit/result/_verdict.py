"""Verdict: the result of a search in words.

At the end of a search every number is moved along a straight line: x + δx, the full step of Gauss and Newton without
bounds. A positive number that is smaller than its standard error is one that the data do not need; one whose step leads
beyond a bound by more than two standard errors is held there by the bound alone.

A sum of squares of motion that sticks, or strikes, has kinks, behind which it may be flat: no mu of a block that stops
at once is too large. Derivatives know one side of a kink, so both are tried.
"""

import contextlib

import numpy as np

from lagjax._fit.model._noise import AbstractNoise
from lagjax._fit.model._records import Record
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial
from lagjax._fit.model._sensor_faults import TOO_COARSE, constant_signals, describe_sensors
from lagjax._fit.model._transforms import Between, Positive
from lagjax._fit.result._influence import disagreements
from lagjax._fit.result._information import Information
from lagjax._fit.search._descent import Descent, column_norms, eliminate
from lagjax._fit.search._unexplained import Unexplained, unexplained_motion
from lagjax._run.hybrid import jumps

_BEYOND = 2.0  # standard errors that a step must lead beyond a bound: of sound fits at a bound one in forty does
_CORRELATED = 0.5
_ASIDE, _KEPT = 4.0, 1e6  # standard errors: how far a kink is one that intervals may not leave out; and one over them


def verdict(
    descent: Descent, unseen: tuple[str, ...], known: Information, left: Unexplained, law: AbstractNoise
) -> tuple[bool, str]:
    """A flag that a fit can be relied upon, and the sentences that say why, where the search leaves `left`."""
    residuals, parts = descent.residuals, [descent.message]
    if known.confirmed.shape[1]:
        parts.append("Not everything that is free is seen: fix it, or measure more.")
    parts += left.motion + left.noise
    triangles = residuals.linearise(descent.trial, descent.noise)
    at_ends, named = _describe_ends(residuals, descent.trial, triangles, known)
    parts += at_ends
    # Half a step of the search is one standard deviation: the interval then spans more than a factor of fifty.
    wide = 2 * _deviations(known) > residuals.parameters.reach
    labels = dict.fromkeys(residuals.parameters.labels[i] for i in np.flatnonzero(wide & ~named))
    if labels:
        parts.append(f"Hardly seen, or at the end of what its transform allows: {', '.join(labels)}.")
    apart, pulls = disagreements(residuals, triangles, known, ~named, unexplained_motion(descent))
    bent = _describe_bends(descent, known)
    parts += apart + pulls + bent
    for part in residuals.parts:
        records, own = [r for r in part.records if isinstance(r, Record)], part.sensor_noise(descent.noise)
        if records:
            parts += describe_sensors(records, law, part.signals.names, part.sensor, own.sigma)
    if np.nanmax(known.correlation) > _CORRELATED:
        parts.append("The residuals are correlated: they hold motion that the scene lacks, and intervals allow for it.")
    ok = descent.converged and not (unseen or left.motion or apart or bent)
    ok &= not any("take noise=" in text or TOO_COARSE in text for text in parts)
    if not ok or at_ends or labels:
        still = [x for part in residuals.parts for x in constant_signals(part.records, part.signals.names)]
        parts, ok = parts + still, ok and not still
    return ok, " ".join(parts)


def _describe_bends(descent: Descent, known: Information) -> list[str]:
    """Sentences for numbers on one side of which the likelihood falls by less than half of what an interval says."""
    residuals, trial, found = descent.residuals, descent.trial, []
    if known.null.shape[1] or not any(jumps(part.scene) for part in residuals.parts):
        return found
    parameters, best = residuals.parameters, residuals.log_likelihood(trial, descent.noise)
    for k, (label, deviation) in enumerate(zip(parameters.labels, _deviations(known), strict=True)):
        kept = _KEPT / deviation * (np.arange(len(trial.u)) == k), np.zeros(len(trial.u))
        for side, word in ((-_ASIDE, "smaller"), (_ASIDE, "larger")):
            with contextlib.suppress(LostMotion):
                there = residuals.evaluate(Point(trial.u + side * known.covariance[k] / deviation, trial.starts))
                triangles = residuals.linearise(there, descent.noise)
                scale = column_norms(triangles, residuals.states)
                # What all others can still win there, to first order: behind the kink they turn back.
                gain = eliminate(triangles, residuals.states, scale, 1e-14, kept).gain
                if best - residuals.log_likelihood(there, descent.noise) - gain < _ASIDE**2 / 4:
                    found.append(
                        f"The data hardly exclude a {word} {label}: the motion sticks, or strikes, otherwise there, "
                        "and its interval may have no end. Fit.profile finds it; measure motion that depends on it."
                    )
    return found


def _deviations(known: Information) -> np.ndarray:
    """The standard deviations of u (F,), zero where something is not identifiable: `unseen_sentences` says that."""
    return np.sqrt(np.nan_to_num(np.diag(known.covariance), posinf=0.0))


def _describe_ends(residuals: Residuals, trial: Trial, triangles: np.ndarray, known: Information):
    """Sentences for the numbers at the end of their sets, and for each unknown whether there is one (F,)."""
    parameters, states = residuals.parameters, residuals.states
    found, named, none = [], np.zeros(len(parameters), bool), np.zeros(len(parameters))
    if known.null.shape[1] or not len(parameters):
        return found, named
    step = eliminate(triangles, states, column_norms(triangles, states), 1e-14, (none, none)).u
    deviations = _deviations(known)
    for k, (label, transform) in enumerate(zip(parameters.labels, parameters.maps, strict=True)):
        if not isinstance(transform, Positive | Between):
            continue
        x, slope = float(transform.value(trial.u[k])), float(transform.slope(trial.u[k]))
        if (text := _describe_end(label, transform.bounds, x, slope * step[k], slope * deviations[k])) is not None:
            found.append(text)
            named[k] = True
    return found, named


def _describe_end(name: str, bounds: tuple[float, float], x: float, step: float, error: float) -> str | None:
    """The sentence for one number x whose step on a straight line, and whose standard error there, are given."""
    for end, side in zip(bounds, (-1, 1), strict=True):
        if side * (x + step - end) > _BEYOND * error:
            return (
                f"{name} stands at {x:.3g}, held by the bound {end:g} of its transform: the data want it near "
                f"{x + step:.3g} ± {error:.2g}. Widen the bound, or doubt the scene."
            )
        if abs(x - end) < error and side * (x - end) <= 0 and side * step >= -error:
            if end == 0.0:
                return f"{name} is {x:.2g} ± {error:.2g}: the data do not tell it from zero."
            return f"{name} goes to its bound {end:g}, which is within its standard error {error:.2g}."
    return None
