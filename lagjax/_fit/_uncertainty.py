"""Uncertainty: autocorrelation of residuals, covariance of parameters, identifiability, experiment design.

It holds `Correlation`, `Information`, `unseen_sentences` (parameters that are not identifiable) and `Experiments`.

**Autocorrelation of residuals.** At 1 kHz residuals hold what the scene lacks, and neighbours agree: n samples are
worth n/τ independent ones, with τ the sum of the correlations over all lags. Source: Geyer, *Practical Markov chain
Monte Carlo*, Stat. Sci. 7 (1992) 473, for where correlations end; Newey & West, Econometrica 55 (1987) 703, for tapers
whose spectrum has no negative parts.

**Covariance of the parameters.** With the starts eliminated, a small change of the measurements by ε moves the free
parameters by H⁻¹ Gᵀ ε: G has the rows of the parameters, made orthogonal to those of the starts, in units of the noise,
and H = GᵀG. So

    covariance = H⁻¹ (Gᵀ C G) H⁻¹,      C the correlation of the residuals, from the residuals themselves

For white noise C = 1. At 1 kHz residuals are not white: they hold what the model lacks, and H⁻¹ alone would give
intervals many times too small. Source: Newey & West, Econometrica 55 (1987) 703.

Directions that nothing depends on have no variance: they are found as null directions of G (`null_space`), their
parameters have infinite variance, and nothing is inverted there.

Over a chaotic record sensitivities grow until all columns point along the one direction that grows fastest, and
rounding hides the rest: G seems to have null directions where it has none. Null directions are the same whatever the
rows are multiplied by, so they are looked for a second time where every row has length one (`confirmed`): what is null
there is not seen, and what is not was drowned. Where rows grow by more than there are digits, all are.

**Identifiability.** A null direction v of the parameters says that measurements do not change along v, at one point. In
logarithms, with the relative changes dxᵢ/xᵢ as coordinates, what is seen is orthogonal to it: if that has small whole
exponents, here and at another point, then only a product of powers enters, such as m·l. The same with the changes dxᵢ
themselves finds sums. Every other direction is given in numbers.

**Experiment design.** With M the information that the fit has, and G the rows of a planned record in units of the
noise, made orthogonal to those of its start where that has to be fitted too,

    gain = log det(M + GᵀG) − log det M

is twice the logarithm by which the volume of the confidence ellipsoid shrinks (D-optimality), expected at the fitted
parameters. A record that sees a combination which was not seen so far comes first, whatever its gain in the others.
Source: Atkinson, Donev & Tobias, *Optimum Experimental Designs* (2007), ch. 11.
"""

import math
import re
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from lagjax._fit._noise import NoiseScale, harmonics, rounding_square, scores
from lagjax._fit._parameters import Parameters
from lagjax._fit._residuals import LostTrial, Residuals, Trial, compress_rows

LEVEL = 0.95  # the probability with which an interval holds its number, where no other one is given


class Correlation(NamedTuple):
    """The autocorrelation of a signal at lags 0, 1, …, tapered to zero; its sum over all lags; the samples' number."""

    lags: np.ndarray
    time: float
    count: int
    neighbour: float


def autocorrelations(question: Residuals, point: Trial, widths: NoiseScale) -> list[Correlation]:
    return [_autocorrelation(question, point, widths, signal) for signal in range(len(widths.sigma))]


def _autocorrelation(question: Residuals, point: Trial, widths: NoiseScale, signal: int) -> Correlation:
    """The correlation of the residuals of one signal, over all pieces.

    It is cut where it first is no larger than two standard errors, and tapered by Parzen's window of three times that
    length: then its spectrum is nowhere negative.
    """
    dof = widths.dof[signal]
    sums, count = np.zeros(1), 0
    for batch, residuals in zip(question.batches, point.residuals, strict=True):
        z = np.sqrt(batch.weights[..., signal]) * residuals[..., signal] / widths.sigma[signal]
        z, curvature = scores(z, None if batch.sides is None else batch.sides[..., signal])
        if not np.isinf(dof):
            z = z * (dof + 1) / (dof + z**2)  # what enters the likelihood's slope
        counted = batch.weights[..., signal] > 0
        own, count = (
            lag_products(z / np.sqrt(np.maximum(curvature, 1e-99)), counted),
            count + round(curvature.sum(where=counted)),
        )
        longer = np.zeros(max(len(sums), len(own)))
        longer[: len(sums)] += sums
        longer[: len(own)] += own
        sums = longer
    law = sums / sums[0] if sums[0] > 0 else np.eye(1, len(sums))[0]
    insignificant = np.flatnonzero(law <= 2.0 / np.sqrt(count))
    cut = int(insignificant[0]) if len(insignificant) else len(law)
    if cut <= 1:
        return Correlation(np.ones(1), 1.0, count, float(law[1]) if len(law) > 1 else 0.0)
    x = np.arange(min(3 * cut, len(law))) / (3 * cut)
    lags = law[: 3 * cut] * np.where(x < 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)
    return Correlation(lags, float(max(1.0, lags[0] + 2 * lags[1:].sum())), count, float(law[1]))


def lag_products(rows: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Σ zᵢ zᵢ₊ₖ over rows (N, T) for the lags k = 0 … T − 1, of samples that count."""
    rows = close_gaps(rows, counted)
    spectrum = np.abs(np.fft.rfft(rows, 2 * rows.shape[1])) ** 2
    return np.fft.irfft(spectrum.sum(axis=0), 2 * rows.shape[1])[: rows.shape[1]]


_LAGS = 20  # of residuals that hold motion some are correlated over the first lags, unless a period has two samples
_CHANCE = 4.0  # standard errors of a correlation: white residuals show it at one of this many lags in 1 of 800 fits


def correlated_power(rows: np.ndarray, counted: np.ndarray) -> float:
    """The mean square of the correlated part of residuals (N, T); zero where no correlation is beyond chance.

    Motion that changes little from one sample to the next has its whole mean square in the product of neighbours, to
    which white noise adds nothing.
    """
    count = int(counted.sum())
    sums = lag_products(np.where(counted, rows, 0.0), counted)[: _LAGS + 1]
    if count < 2 or not sums[0] > 0:
        return 0.0
    highest = np.abs(sums[1:]).max(initial=0.0)
    return float(highest / count) if highest > _CHANCE / np.sqrt(count) * sums[0] else 0.0


def close_gaps(rows: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """The rows (N, T, ...) with what `counted` (N, T) in front, so that lags count samples that are there.

    Where every tenth sample is measured, or some are missing, the neighbour of one is the next that was measured.
    """
    if counted.all():
        return rows
    order = np.argsort(~counted, axis=1, kind="stable")
    return np.take_along_axis(rows, order.reshape(*order.shape, *[1] * (rows.ndim - 2)), axis=1)


def correlated_square(rows: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Σ Gᵀ C G over N pieces `rows` (N, T, F), where C has the correlations `lags`."""
    if len(lags) == 1:
        flat = rows.reshape(math.prod(rows.shape[:-1]), rows.shape[-1])
        return flat.T @ flat
    lags = lags[: rows.shape[1]]
    size = rows.shape[1] + len(lags)
    kernel = np.zeros(size)
    kernel[: len(lags)] += lags
    kernel[-np.arange(1, len(lags))] += lags[1:]
    spectrum = np.fft.rfft(kernel).real
    smooth = np.fft.irfft(np.fft.rfft(rows, size, axis=1) * spectrum[:, None], size, axis=1)[:, : rows.shape[1]]
    return np.einsum("ntf,ntg->fg", rows, smooth)


def independent_share(question: Residuals, point: Trial, widths: NoiseScale) -> float:
    """The number of independent samples that one sample is worth, over all signals: at most 1."""
    laws = autocorrelations(question, point, widths)
    return sum(law.count / law.time for law in laws) / max(sum(law.count for law in laws), 1)


# Singular values below this fraction of the largest, of columns of length one, are null: derivatives are as accurate
# as the motion, to 1e-9, and a direction that is really seen so little would need a million times the data.
NULL = 1e-7
# By how much the rows of a record grow before they can drown each other: a hundredth of what `NULL` tells from nothing,
# so that two columns which grow like this still differ in their early rows where this says nothing.
_GROWTH = 1e-2 / NULL
# By how much they grow before the last digit of a number moves signals by their size: what was computed then is one
# motion of many, and no derivative of it says how well anything is known.
_LOST = 1.0 / np.finfo(float).eps
# The length of a column below which it is zero: one over it must have a square, and some room, among finite numbers.
_NOTHING = 1e-140


class Information(NamedTuple):
    """The information of the data about F free parameters.

    - `covariance` (F, F) of u; infinite variance and NaN beside it where a parameter is not seen.
    - `null` (F, K): the K directions of u that nothing depends on, as far as rounding lets one tell; `confirmed` are
      those among them that nothing depends on.
    - `effective` (S,): the number of samples of each signal that independent ones would need to say as much.
    - `correlation` (S,): the correlation of neighbouring residuals, less what rounding makes of it.
    - `white` (F, F): the covariance if residuals were white, zero where nothing is seen; `lost`: by how much variances
      are larger because unknowns were fitted.
    """

    covariance: np.ndarray
    null: np.ndarray
    confirmed: np.ndarray
    effective: np.ndarray
    correlation: np.ndarray
    white: np.ndarray
    lost: float

    def quantile(self, level: float) -> float:
        """Student's t of a level, for the effective number of samples less that of parameters."""
        require_level(level)
        dof = max(float(self.effective.sum()) - len(self.covariance), 1.0)
        return float(stdtrit(dof, 0.5 + 0.5 * level))


def require_level(level) -> None:
    if not (np.ndim(level) == 0 and 0 < level < 1):
        raise ValueError(f"level must be between 0 and 1, as {LEVEL} is; got {level!r}.")


def information(question: Residuals, point: Trial, widths: NoiseScale) -> Information:
    factors = question.fisher_factors(point, widths)
    triangles = question.triangles(point, factors)
    null, basis = null_space(triangles, question.states)
    if _is_lost(question, point):
        null, basis = np.eye(len(point.u)), np.zeros((len(point.u), 0))
    laws = autocorrelations(question, point, widths)
    effective, correlation = (np.array(x) for x in zip(*((a.count / a.time, a.neighbour) for a in laws), strict=True))
    free, unit = len(point.u), _lengths(triangles, question.states)  # of columns: their squares may be no numbers
    middle, rows_of = np.zeros((free, free)), []
    for batch, factor, slopes in zip(question.batches, factors, point.slopes, strict=True):
        own = eliminate_starts(triangles[batch.rows], factor[..., None] * slopes, question.states) / unit
        rows_of.append(own)
        for s in np.flatnonzero(np.isnan(question.sensor.step)):
            middle += correlated_square(close_gaps(own[:, :, s], batch.weights[..., s] > 0), laws[s].lags)
    for s in np.flatnonzero(np.isfinite(question.sensor.step)).tolist():
        sigma, step = widths.sigma[s], question.sensor.step[s]
        _, rest, before = harmonics(step, sigma)
        rows = [np.sqrt(b.weights[..., s, None]) / sigma * own[:, :, s]
                for b, own in zip(question.batches, rows_of, strict=True)]  # fmt: skip
        for g, b in zip(rows, question.batches, strict=True):
            g = close_gaps(g, b.weights[..., s] > 0)
            middle += before * correlated_square(g, laws[s].lags) + rest * correlated_square(g, np.ones(1))
        middle += rounding_square(rows, question.exact_values(point, s), step, sigma)
        share = min(before / sigma**2, 1.0)
        worth = sum(float(w.sum()) for w in question.worths(point, widths, s))
        effective[s], correlation[s] = worth / (1 + (laws[s].time - 1) * share), share * correlation[s]
    # Student's t tells (ν+1)/(ν+3) of what a Gaussian of the same σ tells; the dof that were used up are counted.
    used = free - null.shape[1] + question.unknowns
    lost = max(effective.sum() / max(effective.sum() - used, 1.0), 1.0)
    robust = np.mean([1.0 if np.isinf(d) else (d + 3) / (d + 1) for d in widths.dof])
    rows, basis = _parameter_rows(triangles, question.states) / unit, basis * unit[:, None]
    half = basis @ np.linalg.solve(basis.T @ (rows.T @ rows) @ basis, basis.T)
    white = robust * half / unit / unit[:, None]
    covariance = lost * robust * half @ middle @ half.T / unit / unit[:, None]
    unseen = np.linalg.norm(null, axis=1) > 1e-6 if null.size else np.zeros(free, bool)
    covariance[unseen] = np.nan
    covariance[:, unseen] = np.nan
    covariance[unseen, unseen] = np.inf
    confirmed = null if not null.size else confirmed_null(question, point, null)
    return Information(covariance, null, confirmed, effective, correlation, white, float(lost))


def null_space(triangles: np.ndarray, states: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of u (F, K) that nothing depends on, the starts being free; and a basis (F, F − K) of the others."""
    rows = _parameter_rows(triangles, states)
    unit = _lengths(triangles, states)
    if not len(unit):
        return np.zeros((0, 0)), np.zeros((0, 0))
    # From above zero by its own round-off, so that a column which is noise alone counts as nothing.
    _, values, directions = np.linalg.svd(rows / unit)
    values = np.append(values, np.zeros(len(unit) - len(values)))
    small = values <= NULL * max(values.max(initial=0.0), 1.0)
    null = directions[small].T / unit[:, None]
    null = null / np.abs(null).max(axis=0, initial=0.0)  # before squares of it are no numbers
    null = null / np.linalg.norm(null, axis=0)
    return null, directions[~small].T / unit[:, None]


def _is_lost(question: Residuals, point: Trial) -> bool:
    """True if the last digit of a parameter moves a signal by its size, because motions grow apart.

    Growth alone is not enough: a drive that sets in smoothly begins with rows as small as numbers can be.
    """
    sizes, states = question.parameters.sizes(point.u), question.states
    moved = max(
        np.abs(slopes[..., states:] * sizes / question.size[:, None]).max(initial=0.0) for slopes in point.slopes
    )
    return moved > _LOST and growth(row_sizes(question, point)) > _LOST


def confirmed_null(question: Residuals, point: Trial, null: np.ndarray) -> np.ndarray:
    """The null directions, of (F, K), that are not the work of rounding, (F, K′)."""
    sizes = row_sizes(question, point)
    if growth(sizes) < _GROWTH:
        return null
    with np.errstate(divide="ignore"):
        level = [np.where(size > 0, 1.0 / size, 0.0) for size in sizes]
    return null_space(question.triangles(point, level), question.states)[0]


def row_sizes(question: Residuals, point: Trial) -> list[np.ndarray]:
    """The length of the row of each sample (N, T, S) of every batch, its columns as fractions of their largest."""
    largest = np.max([np.abs(slopes).max(axis=(0, 1, 2)) for slopes in point.slopes], axis=0)
    columns = np.where(largest > 0, largest, 1.0)
    return [
        np.where(batch.weights > 0, _norm(slopes / columns, -1), 0.0)
        for batch, slopes in zip(question.batches, point.slopes, strict=True)
    ]


def growth(sizes: list[np.ndarray]) -> float:
    """The growth of rows (N, T, S) along the record in which they grow most, from the first that is not zero."""
    found = 1.0
    for row in (row for batch in sizes for row in batch.max(axis=2)):
        (places,) = np.nonzero(row)
        if len(places):
            found = max(found, float(row.max() / row[places[0]]))
    return found


def _parameter_rows(triangles: np.ndarray, states: int) -> np.ndarray:
    """The rows of the parameters, orthogonal to those of the starts: a triangle with F columns."""
    own = eliminate_starts(triangles, triangles[..., :-1], states)
    return compress_rows(own.reshape(1, own.shape[0] * own.shape[1], own.shape[-1]))[0]


def _lengths(triangles: np.ndarray, states: int) -> np.ndarray:
    """The length of the column of each parameter (F,), one for a column of nothing."""
    length = _norm(triangles[..., states:-1], (0, 1))
    return np.where(length > _NOTHING, length, 1.0)


def _norm(x: np.ndarray, axis) -> np.ndarray:
    """The Euclidean norm along axes, also where squares are no numbers."""
    largest = np.abs(x).max(axis=axis, keepdims=True)
    unit = np.where(largest > 0, largest, 1.0)
    return np.sqrt(np.sum((x / unit) ** 2, axis=axis)) * unit.squeeze(axis)


def eliminate_starts(triangles: np.ndarray, slopes: np.ndarray, states: int) -> np.ndarray:
    """Columns of parameters less what the starts can do instead: `slopes` (N, ..., D) → (N, ..., F).

    Directions of a start that nothing depends on can do nothing: they are left out.
    """
    of_starts, of_u = triangles[..., :states], triangles[..., states:-1]
    u, values, v = np.linalg.svd(of_starts, full_matrices=False)
    keep = values > 1e-10 * np.maximum(values.max(axis=1, keepdims=True), np.finfo(float).tiny)
    inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)
    instead = np.matmul(v.swapaxes(1, 2) * inverse[:, None], np.matmul(u.swapaxes(1, 2), of_u))
    shape = (len(slopes), *[1] * (slopes.ndim - 3), *instead.shape[1:])
    return slopes[..., states:] - np.matmul(slopes[..., :states], instead.reshape(shape))


def covariance_of_one_start(
    rows: np.ndarray, states: int, known: Information, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """The uncertainty of a start by weighted rows (T, S, 2n + F): covariance (2n, 2n) for fixed parameters, and A⁺B.

    Every sample is worth the `share` of an independent one.
    """
    flat = rows.reshape(-1, rows.shape[-1])
    u, values, v = np.linalg.svd(flat[:, :states], full_matrices=False)
    sees = values > 1e-10 * values.max()
    into = (u[:, sees] / values[sees]) @ v[sees]
    return known.lost / share * into.T @ into, into.T @ flat[:, states:]


def signal_deviations(slopes: np.ndarray, states: int, start: np.ndarray, follows: np.ndarray, known: Information):
    """The standard deviations (T, S) of signals whose derivatives are `slopes` (T, S, 2n + F).

    They come from the parameters as far as these are seen, and from a start of covariance `start` (2n, 2n) of its own
    that `follows` (2n, F) the parameters.
    """
    a = slopes[..., :states]
    along = slopes[..., states:] - a @ follows
    covariance = _identifiable_covariance(known)
    variance = np.einsum("tsf,fg,tsg->ts", along, covariance, along) + np.einsum("tsi,ij,tsj->ts", a, start, a)
    return np.where(_depends_on_unseen(along, known), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _identifiable_covariance(known: Information) -> np.ndarray:
    """The covariance (F, F) of what is seen, zero along what is not; with white residuals where some is not."""
    return known.covariance if not known.null.size else known.lost * known.white


def _depends_on_unseen(rows: np.ndarray, known: Information) -> np.ndarray:
    """True if rows (..., F) of derivatives depend on a direction that is not seen."""
    if not known.null.size:
        return np.zeros(rows.shape[:-1], bool)
    return (np.abs(rows @ known.null) > 1e-6 * np.abs(rows).max(initial=0.0)).any(axis=-1)


_MOST_NAMES = 12  # in one sentence
_LARGEST_EXPONENT, _EXACT = 6, 1e-3  # of recognised products; how near to a whole number an exponent must be


def unseen_sentences(question: Residuals, point: Trial, widths: NoiseScale, known: Information) -> tuple[str, ...]:
    """A sentence for every set of parameters of which something is not seen, and one for those that rounding hides."""
    hidden = _sentence_on_rounding(question, point, known)
    null, parameters = known.confirmed, question.parameters
    if not null.shape[1]:
        return hidden
    elsewhere = _null_elsewhere(question, point, widths)
    spaces = [(parameters.jacobian(point.u) @ null, parameters.values(point.u))]
    if elsewhere is not None:
        u, other = elsewhere
        spaces.append((parameters.jacobian(u) @ other, parameters.values(u)))
    found = [_sentence(parameters, block, spaces) for block in _blocks(spaces[0][0])]
    if not found:
        ended = dict.fromkeys(parameters.labels[i] for i in np.flatnonzero(np.abs(null).max(axis=1) > 1e-6))
        found = [f"At the end of its set, where nothing that was measured depends on it: {', '.join(ended)}."]
    return (*found, *hidden)


def _sentence_on_rounding(question: Residuals, point: Trial, known: Information) -> tuple[str, ...]:
    """The sentence for parameters whose columns are drowned where sensitivities grow."""
    if known.confirmed.shape[1] == known.null.shape[1]:
        return ()
    basis = np.linalg.qr(known.confirmed)[0]
    left = known.null / np.linalg.norm(known.null, axis=0)
    left = left - basis @ (basis.T @ left)
    labels = question.parameters.labels
    names = list(dict.fromkeys(labels[k] for k in np.flatnonzero(np.linalg.norm(left, axis=1) > 1e-5)))
    sizes = row_sizes(question, point)
    grown, record = max(
        (growth([row[None]]), question.pieces[batch.rows[k]].record)
        for batch, size in zip(question.batches, sizes, strict=True)
        for k, row in enumerate(size)
    )
    return (
        f"{question.label(record)} is chaotic: motions grow apart within it by a factor of {grown:.0e}, and rounding "
        f"hides what it says about {_join_names(names)}. There are no intervals from records that long: cut it into "
        "several shorter ones.",
    )


def _null_elsewhere(question: Residuals, point: Trial, widths: NoiseScale):
    """Other values u of the free parameters, a few per cent away, and the null directions there."""
    u = point.u
    near = u + question.parameters.sizes(u) * np.random.default_rng(0).uniform(0.02, 0.06, len(u))
    other = question.evaluate(near, point.starts)
    if isinstance(other, LostTrial):
        return None
    factors = [np.sqrt(batch.weights) / widths.sigma for batch in question.batches]
    null = null_space(question.triangles(other, factors), question.states)[0]
    return near, confirmed_null(question, other, null)


def _blocks(null: np.ndarray) -> list[np.ndarray]:
    """The parameters of the null directions in sets, of which each is free by itself: rows that are not zero."""
    reduced = _reduce_rows(null.T)
    sets: list[set[int]] = []
    for row in reduced:
        own = set(np.flatnonzero(np.abs(row) > 1e-5 * np.abs(row).max()).tolist())
        for other in [s for s in sets if s & own]:
            sets.remove(other)
            own |= other
        sets.append(own)
    return [np.array(sorted(s)) for s in sets]


def _reduce_rows(rows: np.ndarray) -> np.ndarray:
    """The reduced row echelon form of independent rows, with the largest pivots."""
    rows = np.array(rows, float)
    for i in range(len(rows)):
        rest = np.abs(rows[i:])
        k, column = np.unravel_index(np.argmax(rest), rest.shape)
        if not rest[k, column] > 0:  # a direction along which numbers at the end of their sets no longer change
            rows = rows[:i]
            break
        rows[[i, i + k]] = rows[[i + k, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return np.where(np.abs(rows) > 1e-9, rows, 0.0)


def _sentence(parameters: Parameters, block: np.ndarray, spaces) -> str:
    """The sentence for one set of parameters, from the null directions of x and the values x at one or two points."""
    names = [parameters.names[i] for i in block]
    if len(block) == 1:
        return f"Nothing that was measured depends on {names[0]}."
    relative = [_directions_within(direction / np.where(x != 0, x, 1.0)[:, None], block) for direction, x in spaces]
    absolute = [_directions_within(direction, block) for direction, _ in spaces]
    if all(np.all(x[block] != 0) for _, x in spaces) and (rows := _whole_numbers(relative)) is not None:
        if relative[0].shape[1] == 1 and np.ptp(relative[0]) < _EXACT * np.abs(relative[0]).max():
            return f"A common factor of {_join_names(names)} is not seen, only their ratios: keep one of them fixed."
        return f"Of {_join_names(names)} only {_join_names([_product(row, names) for row in rows])} {_verb(rows)} seen."
    if (rows := _whole_numbers(absolute)) is not None:
        return f"Of {_join_names(names)} only {_join_names([_sum(row, names) for row in rows])} {_verb(rows)} seen."
    if (count := absolute[0].shape[1]) > 1:
        return f"{count} combinations of {_join_names(names)} are not seen: keep {count} of them fixed."
    changes = absolute[0][:, 0] / np.abs(absolute[0][:, 0]).max()
    together = ", ".join(f"{name} by {change:+.3g}" for name, change in zip(names, changes, strict=True))
    return (
        f"A combination of {_join_names(names)} is not seen: to change {together}, in proportion, changes nothing "
        "measured."
    )


def _directions_within(directions: np.ndarray, block: np.ndarray) -> np.ndarray:
    """The directions that move only the parameters of one set, (len(block), K)."""
    outside = np.delete(directions, block, axis=0)
    if not outside.size:
        return directions[block]
    size = np.linalg.norm(directions, axis=0)
    _, values, right = np.linalg.svd(outside / size)
    values = np.append(values, np.zeros(directions.shape[1] - len(values)))
    inside = right[values < 1e-5].T
    return (directions / size @ inside)[block]


def _whole_numbers(spaces: list[np.ndarray]) -> list[list[int]] | None:
    """The rows orthogonal to a space of directions as small whole numbers, the same at all points; None if not so."""
    first = spaces[0]
    if len(spaces) < 2 or any(space.shape != first.shape or not space.size for space in spaces):
        return None
    _, values, right = np.linalg.svd(first.T)
    rank = int((values > 1e-6 * values.max()).sum())
    if rank == len(first):
        return None
    rows = []
    for row in _reduce_rows(right[rank:]):
        fractions = [Fraction(float(x)).limit_denominator(_LARGEST_EXPONENT) for x in row]
        common = np.lcm.reduce([f.denominator for f in fractions])
        whole = [int(f * int(common)) for f in fractions]
        if max(map(abs, whole)) > _LARGEST_EXPONENT or np.abs(np.array(whole) / common - row).max() > _EXACT:
            return None
        rows.append(whole)
    rows = _simplify_rows(rows)
    for space in spaces[1:]:
        left = np.array(rows, float) @ space
        if np.abs(left).max() > _EXACT * np.abs(space).max():
            return None
    return rows


def _simplify_rows(rows: list[list[int]]) -> list[list[int]]:
    """Whole rows of the same span with fewer minus signs, and then smaller numbers: a·m and b·m, not a/b and a·m."""

    def weight(row):
        return sum(x < 0 for x in row), sum(map(abs, row)), [-x for x in row]  # the last so that a/b is not b/a

    def positive_sign(row):
        return min(row, [-x for x in row], key=weight)

    rows = [positive_sign(row) for row in rows]
    while True:  # the weights fall at every turn, and are whole
        better = []
        for i, row in enumerate(rows):
            for other in rows[:i] + rows[i + 1 :]:
                sums = [positive_sign([a + sign * b for a, b in zip(row, other, strict=True)]) for sign in (1, -1)]
                better += [(weight(new), i, new) for new in sums if weight(new)[:2] < weight(row)[:2]]
        if not better:
            return sorted(rows, reverse=True)
        _, i, new = min(better)
        rows[i] = new


def _product(row: list[int], names: list[str]) -> str:
    above = [_power(name, x) for name, x in zip(names, row, strict=True) if x > 0]
    below = [_power(name, -x) for name, x in zip(names, row, strict=True) if x < 0]
    return "·".join(above) + (f"/({'·'.join(below)})" if len(below) > 1 else f"/{below[0]}" if below else "")


def _power(name: str, exponent: int) -> str:
    return name if exponent == 1 else f"{name}^{exponent}"


def _sum(row: list[int], names: list[str]) -> str:
    parts = [(x, name if abs(x) == 1 else f"{abs(x)} {name}") for x, name in zip(row, names, strict=True) if x]
    text = "".join(f" {'+' if x > 0 else '−'} {part}" for x, part in parts)
    return text.removeprefix(" + ")


def _join_names(names: list[str]) -> str:
    if len(names) > _MOST_NAMES:  # weights of a network: whole arrays instead of their numbers
        names = list(dict.fromkeys(re.sub(r"\[[\d, ]+\]$", "", name) for name in names))
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _verb(rows: list) -> str:
    return "is" if len(rows) == 1 else "are"


class Experiments(NamedTuple):
    """Planned records in the order of what they would tell. Print it for a table.

    - `names` (E,); `gain` (E,): log det(M + GᵀG) − log det M of what is seen already.
    - `newly_seen` (E,): how many combinations a record would see that were not seen.
    - `parameters` (F,), `deviations` (E, F): the standard deviation of each unknown afterwards, over that of now.
    """

    names: tuple[str, ...]
    gain: np.ndarray
    newly_seen: np.ndarray
    parameters: tuple[str, ...]
    deviations: np.ndarray

    def __repr__(self) -> str:
        width = max(len(name) for name in (*self.names, "experiment"))
        rows = [f"{'experiment':<{width}}  {'gain':>8}  {'volume':>8}  {'newly seen':>10}  most for"]
        for name, gain, new, after in zip(self.names, self.gain, self.newly_seen, self.deviations, strict=True):
            rows.append(
                f"{name:<{width}}  {gain:>8.3g}  {np.exp(-gain / 2):>8.3g}  {new:>10}  {self._describe_change(after)}"
            )
        return "\n".join(rows)

    def _describe_change(self, after: np.ndarray) -> str:
        known = np.where(np.isfinite(after), after, 1.0)
        place = int(np.argmin(known))
        return f"{self.parameters[place]}, whose interval becomes {known[place]:.2g} of now" if known[place] < 1 else ""


def rank_experiments(
    names: list[str], rows: list[np.ndarray], labels: tuple[str, ...], known: Information
) -> Experiments:
    """The information of planned records; their rows (M, F) have starts eliminated and are in units of the noise."""
    unseen = known.null
    basis = np.linalg.svd(unseen, full_matrices=True)[0][:, unseen.shape[1] :] if unseen.size else np.eye(len(labels))
    have = _information(known, basis)
    gains = [_gain(g, basis, unseen, have) for g in rows]
    order = sorted(range(len(rows)), key=lambda k: (-gains[k][1], -gains[k][0]))
    gain, new, deviations = (np.array([gains[k][i] for k in order]) for i in range(3))
    return Experiments(tuple(names[k] for k in order), gain, new, labels, deviations)


def _information(known: Information, basis: np.ndarray) -> np.ndarray:
    """M in the coordinates of what is seen: the inverse of the reported covariance where that is finite."""
    finite = np.isfinite(np.diag(known.covariance))
    if finite.all():
        return np.linalg.inv(basis.T @ known.covariance @ basis)
    # Beside unseen combinations the covariance of white residuals is there in the seen directions.
    return np.linalg.inv(basis.T @ (known.lost * known.white) @ basis)


def _gain(g: np.ndarray, basis: np.ndarray, unseen: np.ndarray, have: np.ndarray) -> tuple[float, int, np.ndarray]:
    """The gain of one record, how many unseen combinations it sees, and deviations afterwards over those of now."""
    seen = g @ basis
    gain = np.linalg.slogdet(have + seen.T @ seen)[1] - np.linalg.slogdet(have)[1]
    new = 0
    if unseen.size:
        size = np.linalg.norm(g) or 1.0
        values = np.linalg.svd(g @ unseen, compute_uv=False)
        new = int((values > 1e-6 * size * np.linalg.norm(unseen, 2)).sum())
    before, after = (np.diag(basis @ np.linalg.inv(m) @ basis.T) for m in (have, have + seen.T @ seen))
    lost = np.linalg.norm(unseen, axis=1) > 1e-6 if unseen.size else np.zeros(len(before), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(gain), new, np.where(lost, np.nan, np.sqrt(after / before))
