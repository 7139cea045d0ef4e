"""Verdict: the result of a search in words, and the mistakes in records that explain a poor one.

It holds `verdict`, `measure_unexplained`, `shifts_without` (influence of a record) and `find_mistake`.

**Mistakes.** Degrees for radians, milliseconds for seconds, two signals in each other's place, a sign, an angle from
the upright: each leaves data that a scene cannot follow, and each can be undone. If the fit then follows them, that is
the mistake, with evidence: how much was left before and after. How the numbers look says only what is tried first. All
tries together take no more time than the fit itself, or some seconds, and what is not found in that time is not
reported. A signal that never changes cannot be undone, and is named as it is.

**Verdict.** A search may converge where it explains nothing. So the residuals of every signal are compared with the
signal itself, about its mean: what they hold beyond white noise must be a small share of that. Noise alone may be as
large as it is.

At the end of a search every number is moved along a straight line: x + δx, the full step of Gauss and
Newton without bounds. A positive number that is smaller than its standard error is one that the data do not need; one
whose step leads beyond a bound by more than two standard errors is held there by the bound alone.

The agreement of records needs no other search. With Hₖ and gₖ what record k adds to the matrix H and the gradient
of the parameters, starts eliminated, the fit without record k is near u + (H − Hₖ)⁻¹ gₖ, since all gradients together
are zero. If the records agree, that shift has the covariance (H − Hₖ)⁻¹ − H⁻¹. Source: Cook & Weisberg, *Residuals and
Influence in Regression* (1982), §3.4, for one observation.

With enough samples every model is wrong beyond chance, and records show it in different ways. So a record contradicts
the others only if parameters of its own would explain a fair share of the motion that the fit leaves in it: for another
machine that is nearly all, for what the scene lacks a few per cent.
"""

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit._descent import Descent, column_norms, eliminate
from lagjax._fit._noise import AbstractNoise, NoiseScale, Sensor, StudentT, find_sensor
from lagjax._fit._parameters import Between, Parameters, Positive
from lagjax._fit._records import Record, restore_structure
from lagjax._fit._residuals import Residuals, Trial, compress_rows
from lagjax._fit._sensors import wrap_residuals
from lagjax._fit._uncertainty import Information, correlated_power, eliminate_starts

_WIDE = 3.0  # rad: a signal of a smaller range is not tried as degrees, which would leave it 0.05
_WIDEST = 20.0  # rad, three turns: of a larger range degrees are tried first
_MOST = 4  # signals of which signs, places and origins are tried, and records that are left out: pairs grow as a square
_BETTER = 0.2  # of what was left before, that the fit without the mistake may leave: chance halves it at best
_FEWEST = 8  # samples that do not change
_SLOW = 30.0  # times slower than the scene moves, from which milliseconds are tried first: 1000, and a guess is off
SECONDS = 10.0  # of processor time that tries may take where a fit explains nothing: some ten fits that fail


class PossibleMistake(NamedTuple):
    """A mistake in words, and the records without it."""

    text: str
    records: list[Any]


def possible_mistakes(
    records: list[Any], names: tuple[str, ...], worst: list[int], slower: float
) -> Iterator[PossibleMistake]:
    """The mistakes that may be in the records, the likeliest first, where the data move `slower` times slower than the
    scene does, and `worst` has the places of the records in the order of what is left of them."""
    count, some = len(names), range(min(len(names), _MOST))
    by_time = [
        replace(r, ts=r.ts / 1e3, input_ts=None if r.input_ts is None else r.input_ts / 1e3)
        if isinstance(r, Record) else r
        for r in records
    ]  # fmt: skip
    milliseconds = [PossibleMistake("with the times in milliseconds", by_time)]
    ranges = [max(np.ptp(_present_samples(r, k)) for r in records if isinstance(r, Record)) for k in range(count)]
    wide = [k for k in range(count) if ranges[k] > _WIDE]
    degrees = [
        PossibleMistake(f"with {_list_names(names, turned)} in degrees", _change_signals(records, turned, np.radians))
        for turned in ([wide] if wide else []) + [[k] for k in wide[:_MOST] if len(wide) > 1]
    ]
    yield from milliseconds if slower > _SLOW else []
    yield from degrees if max(ranges) > _WIDEST else []
    swaps = []
    for i, j in itertools.combinations(some, 2):
        order = np.arange(count)
        order[[i, j]] = j, i
        swaps.append(PossibleMistake(f"with {names[i]} and {names[j]} swapped", _reorder_signals(records, order)))
    yield from swaps if len(swaps) == 1 else []  # one try tells
    for place in worst[:_MOST] if len(records) > 2 else []:
        yield PossibleMistake(f"without records[{place}]", [*records[:place], *records[place + 1 :]])
    yield from swaps if len(swaps) > 1 else []
    for k in some:
        yield PossibleMistake(f"with the other sign of {names[k]}", _change_signals(records, [k], np.negative))
    for turned in [list(some)] + [[k] for k in some if count > 1]:
        text = f"with {_list_names(names, turned)} counted from the opposite direction, π further"
        yield PossibleMistake(text, _change_signals(records, turned, lambda x: x + np.pi))
    yield from degrees if max(ranges) <= _WIDEST else []
    yield from milliseconds if slower <= _SLOW else []


def find_mistake(
    share: Callable[[list[Any]], float | None], possible: Iterable[PossibleMistake], left: float, seconds: float
) -> list[str]:
    """A sentence for the first mistake without which a fit follows the records; none where there is no such.

    `share(records)` is what a fit of other records leaves of the signals, None where it fails as well; `left` is what
    the fit of these left. No try begins after this many seconds of processor time.
    """
    until = time.process_time() + seconds
    for suspect in possible:
        now = share(suspect.records)
        if now is not None and now < _BETTER * left:
            before = "failed" if np.isinf(left) else f"leaves {100 * left:.2g} % of them"
            return [
                f"The data are followed {suspect.text}: that leaves {100 * now:.2g} % of them, and this fit {before}."
            ]
        if time.process_time() > until:
            break
    return []


_JUMP = 3.0  # times the most that other neighbours differ by: neither motion nor noise jumps so far and back
_FAR = 30.0  # times the spread of the others, from which on one sample is no measurement
_KINDS, _REPEATED = 5, 3  # values that are looked at, and how often they must be there


def require_measurements(records: list[Record], names: tuple[str, ...], periods: np.ndarray) -> None:
    """Raise `ValueError` for samples that stand for missing ones: one value, to which a signal jumps and comes back."""
    for place, record in enumerate(records):
        for k, name in enumerate(names):
            column = record.matrix[record.weight_matrix[:, k] > 0, k]
            if (found := _find_placeholder(column, periods[k])) is None:
                continue
            value, count = found
            others = column[column != value]
            repeat = (
                "never repeat" if len(np.unique(others)) == len(others) else "are far from it just before and after"
            )
            away = abs(value - np.median(others)) / max(np.ptp(others), np.finfo(float).tiny)
            how = f"exactly {value:.6g}, among values that {repeat}"
            if away > _FAR:
                how = f"{value:.6g}, {float(f'{away:.2g}'):.0f} times the spread of the others"
            raise ValueError(
                f"{count} of {len(column)} samples of {name} in records[{place}] are {how}: missing? Put NaN there, or "
                "take noise=lagjax.StudentT()."
            )


def _find_placeholder(column: np.ndarray, period: float) -> tuple[float, int] | None:
    """The value that stands for missing samples of a signal (T,), and how many; None where there is no such."""
    kinds, counts = np.unique(column, return_counts=True)
    if len(kinds) < _FEWEST:
        return None
    middle, spread = np.median(column), np.ptp(np.quantile(column, [0.05, 0.95]))
    far = np.abs(kinds - middle) > _FAR * spread if spread > 0 else np.zeros(len(kinds), bool)
    often = np.argsort(-counts, kind="stable")[:_KINDS]
    for k in dict.fromkeys([*often[counts[often] >= _REPEATED].tolist(), *np.flatnonzero(far)[:_KINDS].tolist()]):
        there = column == kinds[k]
        if there.mean() > 0.5:  # where it rests
            continue
        others = column[~there]
        steps = np.abs(wrap_residuals(np.diff(others)[:, None], np.array([period])))
        before = np.maximum(np.cumsum(~there) - 1, 0)[there]
        after = np.minimum(before + 1, len(others) - 1)
        jumps = np.abs(wrap_residuals(kinds[k] - others[np.stack([before, after], axis=1)], np.full(2, period))).min(
            axis=1
        )
        # Or a value comes back and back among values that never do: samples of a real signal stay equal, or differ.
        runs = np.sum(there[1:] & ~there[:-1])
        alone = runs >= _REPEATED and there.sum() < 2 * runs and len(np.unique(others)) == len(others)
        inside = alone and others.min() < kinds[k] < others.max()
        if inside or (jumps > _JUMP * steps.max()).sum() >= (1 if far[k] else _REPEATED):
            return float(kinds[k]), int(there.sum())
    return None


def describe_sensors(
    records: list[Record], noise, names: tuple[str, ...], sensor: Sensor, sigma: np.ndarray
) -> list[str]:
    """A sentence for every signal of a system whose sensor rounds, or is at a limit, and the law does not say so."""
    is_student = isinstance(noise, StudentT)
    if is_student:  # it knows no limits
        sensor = Sensor(sensor.step, *find_sensor(records)[1:])
    given = noise.sensor(records) or Sensor(*np.full((3, len(names)), np.nan))
    found = []
    for k, name in enumerate(names):
        step, some = sensor.step[k], np.concatenate([_present_samples(record, k) for record in records])
        if np.isnan(given.step[k]) and step**2 / 12 > _ROUNDED * sigma[k] ** 2:
            off = "" if np.abs(some / step - np.round(some / step)).max() < 0.01 else " up to an offset"
            law = f"noise=lagjax.Quantised({step:.4g})"
            how = f"take {law}." if is_student else f"they are fitted as with {law}."
            found.append(f"All values of {name} are multiples of {step:.4g}{off}: {how}")
        if np.ptp(some) < _FEW_STEPS * step:
            found.append(f"{name} moves by less than {_FEW_STEPS:g} steps of its sensor: {_TOO_COARSE}")
        for end, word, limit in (("low", "smallest", sensor.low[k]), ("high", "largest", sensor.high[k])):
            if np.isfinite(limit) and np.isnan(getattr(given, end)[k]):
                law, count = f"noise=lagjax.Clipped({end}={limit:.4g})", (some == limit).sum()
                how = f"take {law}." if is_student else f"they are fitted as with {law}, {limit:.4g} or beyond."
                found.append(
                    f"{count} of {len(some)} samples of {name} are {limit:.4g}, the {word} value, in runs: {how}"
                )
    return found


def constant_signals(records: list[Any], names: tuple[str, ...]) -> list[str]:
    """A sentence for every signal, of these names, that is the same at all samples of a record of one system."""
    return [
        f"{name} is {there[0]:.6g} at all {len(there)} samples of records[{place}]: it does not move, or its "
        "sensor hangs."
        for place, record in enumerate(records)
        if isinstance(record, Record)
        for k, name in enumerate(names)
        if len(there := _present_samples(record, k)) >= _FEWEST and np.ptp(there) == 0.0
    ]


def _present_samples(record: Record, signal: int) -> np.ndarray:
    """The samples of a signal that are not missing; a zero where all are."""
    column = record.matrix[:, signal]
    return column[np.isfinite(column)] if np.isfinite(column).any() else np.zeros(1)


def _list_names(names: tuple[str, ...], which: list[int]) -> str:
    return " and ".join(names[k] for k in which) if len(which) < len(names) or len(names) == 1 else "all signals"


def _reorder_signals(records: list[Any], order: np.ndarray) -> list[Any]:
    found = []
    for record in records:
        if isinstance(record, Record):
            weights = None if record.weights is None else restore_structure(record.weight_matrix[:, order], record)
            record = replace(record, values=restore_structure(record.matrix[:, order], record), weights=weights)
        found.append(record)
    return found


def _change_signals(records: list[Any], columns: list[int], change: Callable[[np.ndarray], np.ndarray]) -> list[Any]:
    found = []
    for record in records:
        if isinstance(record, Record):
            matrix = record.matrix
            matrix[:, columns] = change(matrix[:, columns])
            record = replace(record, values=restore_structure(matrix, record))
        found.append(record)
    return found


_BEYOND = 2.0  # standard errors that a step must lead beyond a bound: of sound fits at a bound one in forty does
_DISAGREE = 5.0  # standard deviations of a shift: twenty records of ten parameters show it in one of 1e4 fits
_OWN = 0.2  # of the motion left in a record, explained by parameters of its own: 0.9 and more for another machine
_MOST_NAMED = 3
_UNEXPLAINED = 0.3  # of a signal's size, left as motion: sound fits leave 1e-3 to 0.1, a false minimum 0.4 to 1
_DOUBTED = 0.05  # of a signal's size, left as motion, from which a fit of other records is tried
_FAINT = 0.1  # of a signal's size over all records: what is left of a record that hardly moves is not looked at
_CORRELATED = 0.5
_FEW_STEPS = 2.5  # of rounding in a signal: below, errors are as large as it, and no small change of a fit
_TOO_COARSE = "there are no intervals from lines that far apart."
_ROUNDED = 0.05  # of the variance of the noise, from which on a sentence tells of rounding


class Verdict(NamedTuple):
    """A flag that a fit can be relied upon, the sentences that say why, and what it leaves."""

    ok: bool
    message: str
    left: "Unexplained"


def verdict(
    descent: Descent, unseen: tuple[str, ...], known: Information, question: Residuals, noise: AbstractNoise
) -> Verdict:
    parts = [descent.message]
    if known.confirmed.shape[1]:
        parts.append("Not everything that is free is seen: fix it, or measure more.")
    left = measure_unexplained(question, descent.point, descent.widths)
    parts += left.motion + left.noise
    triangles = question.linearise(descent.point, descent.widths)
    at_ends, named = _describe_ends(question.parameters, descent.point, triangles, question.states, known)
    parts += at_ends
    # Half a step of the search is one standard deviation: the interval then spans more than a factor of fifty.
    wide = 2 * _deviations(known) > question.parameters.reach
    labels = dict.fromkeys(question.parameters.labels[i] for i in np.flatnonzero(wide & ~named))
    if labels:
        parts.append(f"Hardly seen, or at the end of what its transform allows: {', '.join(labels)}.")
    apart, pulls = _disagreements(
        question, triangles, known, ~named, _unexplained_motion(question, descent.point, descent.widths)
    )
    parts += apart + pulls
    for part in question.parts:
        records, own = [r for r in part.system.records if isinstance(r, Record)], part.sensor_noise(descent.widths)
        if records:
            parts += describe_sensors(records, noise, part.system.signals.names, part.system.sensor, own.sigma)
    if np.nanmax(known.correlation) > _CORRELATED:
        parts.append("The residuals are correlated: they hold motion that the scene lacks, and intervals allow for it.")
    ok = descent.converged and not (unseen or left.motion or apart)
    ok &= not any("take noise=" in text or _TOO_COARSE in text for text in parts)
    if not ok or at_ends or labels:
        still = [
            text for part in question.parts for text in constant_signals(part.system.records, part.system.signals.names)
        ]
        parts, ok = parts + still, ok and not still
    return Verdict(ok, " ".join(parts), left)


class Unexplained(NamedTuple):
    """Sentences on the residuals of a trial: for signals of which motion is left, and for those whose noise is as large
    as they are; the largest share of a signal that is left, whether it holds motion at all, and the records, the worst
    first."""

    motion: list[str]
    noise: list[str]
    share: float
    doubted: bool
    worst: list[int]


def measure_unexplained(question: Residuals, point: Trial, widths: NoiseScale) -> Unexplained:
    """The share of the signals that a trial leaves, where that is much."""
    left, noisy, shares, doubted, many = [], [], [0.0], False, len(question.records) > 1
    of_records = np.zeros(len(question.records))
    for signal, name in enumerate(question.names):
        rounding = np.nan_to_num(question.sensor.step[signal]) ** 2 / 12
        parts = {k: _parts(rows, rounding) for k, rows in _rows_of_signal(question, point, widths, signal).items()}
        if not parts:
            continue
        samples = sum(part.samples for part in parts.values())
        rms, own, motion = (
            np.sqrt(sum(part.samples * getattr(part, kind) for part in parts.values()) / samples)
            for kind in ("left", "own", "motion")
        )
        shares.append(rms / own if own > 0 else np.inf if rms > 0 else 0.0)
        doubted |= bool(motion > _DOUBTED * own)
        for k, part in parts.items():
            of_records[k] = max(of_records[k], part.motion / own**2 if own > 0 else 0.0)
        if motion > _UNEXPLAINED * own:
            left.append(f"The fit leaves {_percent(rms, own)} of {name}: its motion is not that of the scene.")
        elif rms > _UNEXPLAINED * own:
            noisy.append(f"The noise is {_percent(rms, own)} of {name}.")
        each = {
            k: np.sqrt(part.motion / part.own) if part.own > 0 else np.inf
            for k, part in parts.items()
            if part.motion > max(_UNEXPLAINED**2 * part.own, (_FAINT * own) ** 2)
        }
        worst = sorted(each, key=lambda k: -each[k])[:_MOST_NAMED] if many and len(each) < len(parts) else []
        left += [
            f"The fit leaves {_percent(np.sqrt(parts[k].left), np.sqrt(parts[k].own))} of {name} in "
            f"{question.label(k)}, and less in others: is it a record of this scene, with the signs of the others?"
            for k in worst
        ]
    return Unexplained(left, noisy, float(max(shares)), doubted, np.argsort(-of_records, kind="stable").tolist())


def _percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.3g} %" if part < 10.0 * whole else "far more than all"


class _Parts(NamedTuple):
    """Of one signal in one record: the samples that count, and mean squares of the residuals, of what these hold beyond
    white noise and rounding, and of the signal about its mean."""

    samples: float
    left: float
    motion: float
    own: float


def _parts(row: tuple[np.ndarray, np.ndarray, np.ndarray], rounding: float) -> _Parts:
    rows, values, counts = row
    samples, root = counts.sum(), np.sqrt(counts)
    mean = np.sum(counts * values) / samples
    motion = correlated_power(root * rows, counts > 0) * (counts > 0).sum() / samples
    motion = max(motion - rounding, 0.0)
    return _Parts(samples, np.sum(counts * rows**2) / samples, motion, np.sum(counts * (values - mean) ** 2) / samples)


def _rows_of_signal(question: Residuals, point: Trial, widths: NoiseScale, signal: int) -> dict[int, tuple]:
    """The residuals, values and weights of every record that has a signal, (M, T) for its M pieces."""
    found: dict[int, list] = {}
    columns = zip(question.batches, point.residuals, question.factors(point, widths), strict=True)
    for batch, residuals, factors in columns:
        counts = (factors[..., signal] * widths.sigma[signal]) ** 2
        for row, place in enumerate(batch.rows):
            if counts[row].any():
                each = residuals[row, :, signal], batch.values[row, :, signal], counts[row]
                found.setdefault(question.pieces[place].record, []).append(each)
    return {k: tuple(_pad_rows([one[i] for one in pieces]) for i in range(3)) for k, pieces in found.items()}


def _pad_rows(rows: list[np.ndarray]) -> np.ndarray:
    """Rows of different lengths as one array, with zeros behind the shorter ones."""
    longest = max(map(len, rows))
    return np.stack([np.pad(row, (0, longest - len(row))) for row in rows])


def _deviations(known: Information) -> np.ndarray:
    """The standard deviations of u (F,), zero where something is not identifiable: `unseen_sentences` says that."""
    return np.sqrt(np.nan_to_num(np.diag(known.covariance), posinf=0.0))


def _describe_ends(parameters: Parameters, point: Trial, triangles, states: int, known: Information):
    """Sentences for the numbers at the end of their sets, and for each unknown whether there is one (F,)."""
    found, named = [], np.zeros(len(parameters), bool)
    if known.null.shape[1] or not len(parameters):
        return found, named
    none = np.zeros(len(parameters))
    step = eliminate(triangles, states, column_norms(triangles, states), 1e-14, (none, none)).u
    deviations = _deviations(known)
    for unknown, (label, transform) in enumerate(zip(parameters.labels, parameters.maps, strict=True)):
        if not isinstance(transform, Positive | Between):
            continue
        u = point.u[unknown : unknown + 1]
        slope = float(transform.slope(u)[0])
        text = _describe_end(
            label, transform, float(transform.value(u)[0]), slope * step[unknown], slope * deviations[unknown]
        )
        if text is not None:
            found.append(text)
            named[unknown] = True
    return found, named


def _describe_end(name: str, transform: Positive | Between, x: float, step: float, error: float) -> str | None:
    """The sentence for one number x whose step on a straight line, and whose standard error there, are given."""
    ends = [(0.0, -1)] if isinstance(transform, Positive) else [(transform.lower, -1), (transform.upper, 1)]
    for end, side in ends:
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


def _disagreements(
    question: Residuals, triangles: np.ndarray, known: Information, inside: np.ndarray, motion: dict[int, float]
) -> tuple[list[str], list[str]]:
    """Sentences for the records without which a parameter would move by more than they can have by chance: for those of
    another motion, and for those that show, each in its way, what the scene lacks.

    Only of parameters `inside` (F,) of their sets: at a bound the sum of squares has a slope. `motion` is the sum of
    squares of what the fit leaves in a record beyond white noise.
    """
    records = np.array([piece.record for piece in question.pieces])
    count = len(np.unique(records))
    if known.null.shape[1] or count < 2 or not inside.any():
        return [], []
    columns = np.concatenate([np.ones(question.states, bool), inside, [True]])
    variances = np.diag(known.covariance)[inside], np.diag(known.white)[inside]
    shifts = shifts_without(question.states, triangles[..., columns], records, *variances)
    labels = [label for label, keep in zip(question.parameters.labels, inside, strict=True) if keep]
    worst = [(k, int(np.argmax(np.abs(shift.sizes)))) for k, shift in shifts.items()]
    worst = sorted((-abs(shifts[k].sizes[i]), k, i) for k, i in worst if abs(shifts[k].sizes[i]) > _DISAGREE)
    apart = [(k, i) for _, k, i in worst if shifts[k].explained > _OWN * motion.get(k, 0.0)]
    pulls = [(k, i) for _, k, i in worst if (k, i) not in apart]
    if count == 2:  # each moves as far without the other
        apart, pulls, how = apart[:1], [] if apart else pulls[:1], "contradicts the other record"
    else:
        apart, pulls, how = apart[:_MOST_NAMED], pulls[:1], "disagrees with the others"
    return (
        [f"{question.label(k)} {how}: without it {_shift_clause(labels[i], shifts[k].sizes[i])}." for k, i in apart],
        [
            f"Without {question.label(k)} {_shift_clause(labels[i], shifts[k].sizes[i])}, more than its interval "
            f"allows for. Parameters of its own would explain {100 * shifts[k].explained / motion[k]:.2g} % of the "
            "motion that is left in it: the scene lacks something that differs from record to record."
            for k, i in pulls
        ],
    )


def _unexplained_motion(question: Residuals, point: Trial, widths: NoiseScale) -> dict[int, float]:
    """The sum of squares that a trial leaves beyond white noise in every record, in units of the noise."""
    found: dict[int, float] = {}
    for signal in range(len(question.names)):
        for k, rows in _rows_of_signal(question, point, widths, signal).items():
            part = _parts(rows, np.nan_to_num(question.sensor.step[signal]) ** 2 / 12)
            found[k] = found.get(k, 0.0) + part.samples * part.motion / widths.sigma[signal] ** 2
    return found


def _shift_clause(label: str, shift: float) -> str:
    """The clause on a shift in standard deviations; parameters move up with their unknowns."""
    way = "up" if shift > 0 else "down"
    return f"{label} would move {way} by {abs(shift):.1f} of the standard deviations that chance gives it"


class Shift(NamedTuple):
    """A fit without a record: how far each u moves (F,), in standard deviations of that for records that agree, and by
    how much parameters of its own would lower the record's sum of squares."""

    sizes: np.ndarray
    explained: float


def shifts_without(states: int, triangles, records: np.ndarray, variances, white) -> dict[int, Shift]:
    """The fit without one record, for each of them.

    `triangles` (N, …, 2n + F + 1) are those of the pieces, `records` (N,) says whose they are; `variances` (F,) are
    those of u, and `white` (F,) what they were if residuals were white. A record without which something is not
    seen is left out, since there is nothing that it could disagree with.
    """
    # The residual is one more column of the parameters, so that the starts are taken out of it as well.
    own = eliminate_starts(np.concatenate([triangles, triangles[..., -1:]], axis=-1), triangles, states)
    size, growth = 1.0 / np.sqrt(white), np.sqrt(np.maximum(variances / white, 1.0))
    whole, found = compress_rows(own.reshape(1, -1, own.shape[-1]))[0][:, :-1] / size, {}
    for k in np.unique(records):
        rows = own[records != k].reshape(-1, own.shape[-1])
        rest = compress_rows(rows[None])[0][:, :-1] / size
        values = np.linalg.svd(rest, compute_uv=False)
        if values[-1] < 1e-5 * values[0]:
            continue
        mine = own[records == k].reshape(-1, own.shape[-1])
        slopes, residuals = mine[:, :-1] / size, mine[:, -1]
        without, beside = np.linalg.inv(rest.T @ rest), np.linalg.inv(whole.T @ whole)
        shift = without @ slopes.T @ residuals
        chance = np.sqrt(np.maximum(np.diag(without) - np.diag(beside), 1e-12 * np.diag(without)))
        axes, values, _ = np.linalg.svd(slopes, full_matrices=False)
        along = axes[:, values > 1e-5 * values[0]].T @ residuals
        found[int(k)] = Shift(shift / (chance * growth), float(along @ along))
    return found
