"""Verdict: the result of a search in words.

At the end of a search every number is moved along a straight line: x + δx, the full step of Gauss and Newton without
bounds. A positive number that is smaller than its standard error is one that the data do not need; one whose step leads
beyond a bound by more than two standard errors is held there by the bound alone.

A sum of squares of motion that sticks, or strikes, has kinks, behind which it may be flat: no mu of a block that stops
at once is too large. Derivatives know one side of a kink, so both are tried.

Whether records agree needs no other search. With Hₖ and gₖ what record k adds to the matrix H and the gradient of the
parameters, starts eliminated, the fit without record k is near u + (H − Hₖ)⁻¹ gₖ, since all gradients together are
zero. If the records agree, that shift has the covariance (H − Hₖ)⁻¹ − H⁻¹. Source: Cook & Weisberg, *Residuals and
Influence in Regression* (1982), §3.4, for one observation. With enough samples every model is wrong beyond chance, and
records show it in different ways. So a record contradicts the others only if parameters of its own would explain a fair
share of the motion that the fit leaves in it: for another machine that is nearly all, for what the scene lacks a few
per cent.
"""

import contextlib
from typing import NamedTuple

import numpy as np

from lagjax._equations import truncated_svd
from lagjax._fit.model._noise import AbstractNoise
from lagjax._fit.model._parameters import stack_rows
from lagjax._fit.model._records import Record
from lagjax._fit.model._residuals import LostMotion, Point, Residuals, Trial, compress_rows
from lagjax._fit.model._sensor_faults import TOO_COARSE, constant_signals, describe_sensors
from lagjax._fit.model._transforms import Between, Positive
from lagjax._fit.result._evidence import describe_sizes
from lagjax._fit.result._information import Information, eliminate_starts, information
from lagjax._fit.search._descent import Descent, column_norms, eliminate
from lagjax._fit.search._unexplained import MOST_NAMED, Unexplained, measure_unexplained, unexplained_motion
from lagjax._run.hybrid import may_jump

_BEYOND = 2.0  # standard errors that a step must lead beyond a bound: of sound fits at a bound one in forty does
_CORRELATED = 0.5
_ASIDE, _KEPT = 4.0, 1e6  # standard errors: how far a kink is one that intervals may not leave out; and one over them
_DISAGREE = 5.0  # standard deviations of a shift: twenty records of ten parameters show it in one of 1e4 fits
_FEW_LINES = 64  # that a coarse sensor shows, from whose values alone limits are not told (`find_limits`)
_FEWEST_BEYOND = 3  # samples, each of which shows the next line with a chance of a half at least, if there is one
_SPARE = (
    4.0  # samples that a fit must leave of a signal beside others: of 4, 5 and 7 times with 3 unknowns intervals of
)
# 95 % hold the truth in 75, 80 and 90 %
_SEEN = 1e-5  # of the largest singular value of columns in units of their standard deviations
_OWN = 0.2  # of the motion left in a record, explained by parameters of its own: 0.9 and more for another machine


def verdict(
    descent: Descent, unseen: tuple[str, ...], known: Information, left: Unexplained, law: AbstractNoise, starts: int
) -> tuple[bool, str]:
    """Judge if a fit can be relied upon, and say why; `left` is what the best of `starts` searches left."""
    residuals, parts = descent.residuals, [descent.message]
    strikes = any(may_jump(part.scene) for part in residuals.parts)
    more, astray = max(64, 4 * starts), strikes and _has_motion_left(known, left)
    if known.confirmed.shape[1] and strikes:
        text = f"Take starts={more}; else fix it, or measure more."
        parts.append(
            f"Not everything that is free is seen where the motion sticks, or strikes, as it does here. {text}"
        )
    elif known.confirmed.shape[1]:
        parts.append("Not everything that is free is seen: fix it, or measure more.")
    elif astray:
        text = f"Take starts={more}, or begin nearer; else the scene lacks something."
        parts.append(f"Motion is left, and of motion that sticks, or strikes, another search may end better. {text}")
    parts += [*left.motion, *(describe_sizes(residuals.parameters) if left.motion else []), *left.noise]
    triangles = residuals.linearise(descent.trial, descent.noise)
    at_ends, named = _describe_ends(residuals, descent.trial, triangles, known)
    parts += at_ends
    # Half a step of the search is one standard deviation: the interval then spans more than a factor of fifty.
    wide = 2 * _deviations(known) > residuals.parameters.reach
    labels = dict.fromkeys(residuals.parameters.labels[i] for i in np.flatnonzero(wide & ~named))
    if labels:
        parts.append(f"Hardly seen, or at the end of what its transform allows: {', '.join(labels)}.")
    apart, pulls = _disagreements(residuals, triangles, known, ~named, unexplained_motion(descent))
    bent = _describe_bends(descent, known)
    parts += apart + pulls + bent
    for part in residuals.parts:
        scatter = descent.noise._replace(sigma=descent.noise.sigma / residuals.unit)
        records, own = [r for r in part.records if isinstance(r, Record)], part.sensor_noise(scatter)
        if records:
            parts += describe_sensors(records, law, part.signals.names, part.sensor, own.sigma)
    parts += [] if left.motion else _describe_missed_limits(residuals, descent.trial)
    parts += _describe_few(residuals, known)
    if np.nanmax(known.correlation) > _CORRELATED:
        parts.append("The residuals are correlated: they hold motion that the scene lacks, and intervals allow for it.")
    ok = descent.converged and not (unseen or left.motion or apart or bent or astray)
    ok &= not any("take noise=" in text or TOO_COARSE in text for text in parts)
    if not ok or at_ends or labels:
        still = [x for part in residuals.parts for x in constant_signals(part.records, part.signals.names)]
        parts, ok = parts + still, ok and not still
    return ok, " ".join(parts)


def is_doubtful(descent: Descent) -> bool:
    """True where slowly changing residuals show motion that is left, or nothing depends on a parameter: where motion
    sticks or strikes, another start may then end elsewhere."""
    known = information(descent)
    return bool(known.null.shape[1]) or _has_motion_left(known, measure_unexplained(descent))


def _has_motion_left(known: Information, left: Unexplained) -> bool:
    return left.doubted and bool(np.nanmax(known.correlation) > _CORRELATED)


def _describe_missed_limits(residuals: Residuals, trial: Trial) -> list[str]:
    """Sentences for coarse sensors that seem to be at a limit: the motion continues more than half a step beyond the
    last line shown, where a sensor without limits would show the next one at every other sample."""
    values = np.concatenate([batch.values.reshape(-1, batch.values.shape[-1]) for batch in residuals.batches])
    found, r = [], trial.flat()
    sensor, periods = residuals.sensor, residuals.parts[0].frame.periods
    for s, name in enumerate(residuals.names):
        counted, step, beyond = residuals.weights[:, s] > 0, sensor.step[s], {}
        x, e = values[counted, s], r[counted, s]
        if not len(x) or not np.ptp(x) < _FEW_LINES * step or np.isfinite(periods[s]):
            continue
        for end, side, limit in (("low", -1, sensor.low[s]), ("high", 1, sensor.high[s])):
            last = side * np.max(side * x)
            if np.isnan(limit) and (many := int(np.sum(side * e[np.abs(x - last) < 0.25 * step] > 0.5 * step))):
                beyond[f"{end}={last:.4g}"] = many
        if sum(beyond.values()) >= _FEWEST_BEYOND:
            found.append(
                f"{name} is coarse, and the fit continues beyond its last lines at {sum(beyond.values())} samples, "
                f"where it shows no more: is it at a limit? Then take noise=lagjax.Clipped({', '.join(beyond)})."
            )
    return found


def _describe_bends(descent: Descent, known: Information) -> list[str]:
    """Sentences for numbers that all records share, where the likelihood falls on one side by less than half of what an
    interval says."""
    residuals, trial, found = descent.residuals, descent.trial, []
    if known.null.shape[1] or not any(may_jump(part.scene) for part in residuals.parts):
        return found
    parameters, best = residuals.parameters, residuals.log_likelihood(trial, descent.noise)
    labels, deviations = parameters.labels, _deviations(known)
    for k in residuals.unknowns.shared.tolist():
        label, deviation = labels[k], deviations[k]
        kept = _KEPT / deviation * (np.arange(len(trial.u)) == k), np.zeros(len(trial.u))
        for side, word in ((-_ASIDE, "smaller"), (_ASIDE, "larger")):
            with contextlib.suppress(LostMotion):
                there = residuals.evaluate(Point(trial.u + side * known.covariance[k] / deviation, trial.starts))
                triangles = residuals.linearise(there, descent.noise)
                scale = column_norms(triangles, residuals.states, residuals.unknowns)
                # What all others can still win there, to first order: behind the kink they turn back.
                gain = eliminate(triangles, residuals.states, scale, 1e-14, kept, residuals.unknowns).gain
                if best - residuals.log_likelihood(there, descent.noise) - gain < _ASIDE**2 / 4:
                    found.append(
                        f"The data hardly exclude a {word} {label}: the motion sticks, or strikes, otherwise there, "
                        "and its interval may have no end. Fit.profile finds it; measure motion that depends on it."
                    )
    return found


def _describe_few(residuals: Residuals, known: Information) -> list[str]:
    """Sentences for signals whose scatter few samples tell, beside others: likelihood weighs them too much."""
    counts = (residuals.weights > 0).sum(axis=0)
    few = counts - known.spent < _SPARE
    return [
        f"The scatter of {residuals.names[s]} is told by {counts[s]} samples, of which the fit can follow "
        f"{known.spent[s]:.1f}: σ, and intervals, may be far too small. Measure more of it."
        for s in np.flatnonzero(few & ~few.all()).tolist()
    ]


def _deviations(known: Information) -> np.ndarray:
    """The standard deviations of u (F,), zero where something is not identifiable: `unseen_sentences` says that."""
    return np.sqrt(np.nan_to_num(np.diag(known.covariance), posinf=0.0))


def _describe_ends(residuals: Residuals, trial: Trial, triangles: np.ndarray, known: Information):
    """Sentences for the numbers at the end of their sets, and for each unknown whether there is one (F,)."""
    parameters, states, unknowns = residuals.parameters, residuals.states, residuals.unknowns
    found, named, none = [], np.zeros(len(parameters), bool), np.zeros(len(parameters))
    if known.null.shape[1] or not len(parameters):
        return found, named
    scale = column_norms(triangles, states, unknowns)
    step = eliminate(triangles, states, scale, 1e-14, (none, none), unknowns).u
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


# ---- records that pull -----------------------------------------------------------------------------------------------


def _disagreements(
    residuals: Residuals, triangles: np.ndarray, known: Information, inside: np.ndarray, motion: np.ndarray
) -> tuple[list[str], list[str]]:
    """Sentences for records of another motion, and for those that show what the scene lacks, each differently. Only of
    parameters that all share, `inside` (F,) of their sets; `motion` (R,) is the sum of squares left in each record
    beyond white noise."""
    records, unknowns = np.array([piece.record for piece in residuals.pieces]), residuals.unknowns
    count, shared = len(np.unique(records)), unknowns.shared[inside[unknowns.shared]]
    if known.null.shape[1] or count < 2 or not len(shared):
        return [], []
    own = residuals.states + unknowns.own  # numbers of a record are taken out as its start is
    columns = np.concatenate([np.ones(own, bool), inside[unknowns.shared], [True]])
    variances = np.diag(known.covariance)[shared], np.diag(known.white)[shared]
    prior = residuals.parameters.prior_weights[shared]
    shifts = shifts_without(own, triangles[..., columns], records, *variances, prior)
    labels = [residuals.parameters.labels[k] for k in shared]
    if not len(shifts.records):
        return [], []
    most, explained = np.abs(shifts.sizes).max(axis=1), shifts.explained
    worst = [k for k in np.argsort(-most, kind="stable").tolist() if most[k] > _DISAGREE]
    apart = [k for k in worst if explained[k] > _OWN * motion[shifts.records[k]]]
    pulls = [k for k in worst if explained[k] <= _OWN * motion[shifts.records[k]]]
    if count == 2:  # each moves as far without the other
        apart, pulls, how = apart[:1], [] if apart else pulls[:1], "contradicts the other record"
    else:
        apart, pulls, how = apart[:MOST_NAMED], pulls[:1], "disagrees with the others"

    def clause(k: int) -> tuple[str, str]:
        sizes = shifts.sizes[k]
        place = int(np.argmax(np.abs(sizes)))
        way = "up" if sizes[place] > 0 else "down"  # parameters move up with their unknowns
        by = f"{abs(sizes[place]):.1f} of the standard deviations that chance gives it"
        return residuals.label(shifts.records[k]), f"{labels[place]} would move {way} by {by}"

    return (
        [f"{name} {how}: without it {moves}." for name, moves in map(clause, apart)],
        [
            f"Without {name} {moves}, more than its interval allows for. Parameters of its own would explain "
            f"{100 * explained[k] / motion[shifts.records[k]]:.2g} % of the motion that is left in it: the scene lacks "
            "something that differs from record to record."
            for k, (name, moves) in zip(pulls, map(clause, pulls), strict=True)
        ],
    )


class Shifts(NamedTuple):
    """The fits without one of the `records` (R,): how far each u moves, `sizes` (R, F), in standard deviations for
    records that agree; by how much parameters of its own would lower the sum of squares of a record, `explained` (R,).
    """

    records: np.ndarray
    sizes: np.ndarray
    explained: np.ndarray


def shifts_without(states: int, triangles, records: np.ndarray, variances, white, prior) -> Shifts:
    """The fit without one record, for each of them.

    `triangles` (N, …, 2n + F + 1) are those of the pieces, `records` (N,) says whose they are; `variances` (F,) are
    those of u, `white` (F,) what they were if residuals were white, and `prior` (F,) the weights of a prior of u, which
    holds with and without the record. A record without which something is not seen is left out, since there is nothing
    that it could disagree with.

    With the rows m and residuals r of a record, and H = RᵀR of all and the prior, W = m R⁻¹ = U S Vᵀ has its singular
    values below 1. H − mᵀm = Rᵀ (1 − Wᵀ W) R, so that u moves by R⁻¹ V S (1 − S²)⁻¹ Uᵀ r (Woodbury), and the variance
    that is missed is the diagonal of R⁻¹ V S² (1 − S²)⁻¹ Vᵀ R⁻ᵀ.
    """
    # The residual is one more column of the parameters, so that the starts are taken out of it as well.
    own = eliminate_starts(np.concatenate([triangles, triangles[..., -1:]], axis=-1), triangles, states)
    own = own.reshape(len(own), -1, own.shape[-1])
    size, growth = 1.0 / np.sqrt(white), np.sqrt(np.maximum(variances / white, 1.0))
    held = np.pad(np.diag(prior), ((0, 0), (0, 1)))
    whole = compress_rows(np.concatenate([own.reshape(-1, own.shape[-1]), held])[None])[0][:-1, :-1] / size
    if truncated_svd(whole, _SEEN).rank < whole.shape[1]:
        return Shifts(np.zeros(0, int), np.zeros((0, len(white))), np.zeros(0))
    names, which = np.unique(records, return_inverse=True)
    mine = compress_rows(stack_rows(own, which))
    half = np.linalg.inv(whole)
    left, values, right = np.linalg.svd(mine[..., :-1] / size @ half, full_matrices=False)
    along = np.sum(left * mine[..., -1:], axis=1)
    seen = values[:, 0] ** 2 < 1.0 - _SEEN**2
    left_over = np.where(seen[:, None], 1.0 - values**2, 1.0)
    moved = half @ right.swapaxes(1, 2)
    shift = np.matmul(moved, (along * values / left_over)[..., None])[..., 0]
    chance = np.sqrt(np.sum(moved**2 * (values**2 / left_over)[:, None], axis=2))
    least = 1e-6 * np.sqrt(np.sum(half**2, axis=1))  # of a record that says nothing
    explained = np.sum(np.where(values > _SEEN * values[:, :1], along, 0.0) ** 2, axis=1)
    return Shifts(names[seen], (shift / np.maximum(chance, least) / growth)[seen], explained[seen])
