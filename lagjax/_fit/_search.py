"""Search: where a fit begins, multiple shooting over segments that grow, the weak form, and multistart.

It holds `Reader`, `fit_weak_form`, `Waterfall`, `run_multistart` and `search_records`.

**Multiple shooting.** Over a long record the sum of squares has many minima: a wrong frequency is out of phase, a
chaotic motion forgets its start. Over a segment shorter than the motion's own time scale there is one. So the records
are first cut into short segments, each with a start of its own (multiple shooting), from states that local polynomials
read off the data. When the parameters fit those, neighbours are joined and the joined segment keeps the start of
its first part: its end then misses the data by as much as the states of two neighbours disagreed, which the next search
closes. So the weight of continuity goes from none to all, in as many doublings as it takes to reach whole records. A
level needs a rough answer only: the parameters must be good enough to predict a segment twice as long.

Others impose continuity by penalties or constraints on all levels at once (Bock's multiple shooting, coupling to the
data); the growing of segments needs no weights, and every level is the same least squares with starts eliminated.
Source: Bock, *Recent advances in parameter identification for ODE* (1983); Pisarenko & Sornette, Phys. Rev. E 69
(2004) 036122, for segments of chaotic signals.

**Weak form** of Lagrange's equations, for states that were read off the data. With a bump φ that vanishes at both ends
of a window, integration by parts takes the time derivative off the momentum:

    ∫ (φ̇ p + φ F) dt = 0,      p = ∂L/∂q̇,   F = ∂L/∂q + Q

which asks for q and q̇ of the data and for no second derivative of them. It is linear where the parameters are, and has
one minimum where long motions have many. It is not scaled like the noise, and biased by that of q̇: a start, from which
the search then continues. Each coordinate is divided by the size of its own ∫ φ̇ p, or else all masses would shrink to
nothing together.
Source: Messenger & Bortz, *Weak SINDy*, J. Comput. Phys. 443 (2021) 110525; Bortz, Messenger & Dukic, Bull. Math.
Biol. 85 (2023) 110, for parameters.

**Multistart.** The first start is the user's `params0`, the others are drawn from what the transforms say: a decade
about a positive number, all of an interval, of a circle or of a simplex, and about any other number as far as it is
large. All of them take a few damped steps of Gauss and Newton at once: the members of one batch are starts × records,
over a sample of the times of each record. A start whose motion fails costs the others nothing. The best few then go
through the whole search.

The waterfall is what all of them came to, in order: many that are equally good, then a cliff, are a minimum that can be
trusted; a slope without a step is not.
Source: Raue et al., PLoS ONE 8 (2013) e74335, for many starts and waterfalls.

**The search of whole records.** `search_records` goes from segments to whole records; `run_multistart` does that from
many starts, `search_by_gradient` with gradients in reverse mode. `start_by_weak_form` is the first value of the
parameters by the weak form, where the user's is too far off.
"""

import functools
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from lagjax._equations import has_constraints
from lagjax._fit._descent import Anchor, Descent, build_descent, column_norms, descend_gradient, eliminate, minimise
from lagjax._fit._motions import AbstractMotions
from lagjax._fit._noise import Gaussian, NoiseScale
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import (
    Driven,
    Piece,
    Record,
    constant_tables,
    input_functions,
    inputs_between,
    restore_structure,
)
from lagjax._fit._residuals import LostTrial, Residuals, SystemResiduals
from lagjax._fit._sensors import unwrap_record
from lagjax._fit._verdict import measure_unexplained
from lagjax._interface import halves
from lagjax._run.hybrid import Hybrid
from lagjax._scene import System

_DEGREE = 3  # of local polynomials: velocities without the bias that curvature gives to lines
_WINDOWS = (7, 13, 25, 49, 97, 193)  # samples in one of them
_PROBES = 32  # places of a record where its time scale is looked at
_WORSE_WINDOW = 1.3  # what a window may leave, in units of what the shortest leaves
_PER_SCALE = 24  # samples per time scale that early levels look at: more cost time and find the same
_WINDOWS_IN_ALL = 256  # places of all records where curvature is looked at
_FEWEST_IN_SEGMENT = 8  # samples
_QUARTER = (
    0.25  # of a period, by which the motion over a segment may be wrong: beyond a half residuals have false minima
)


class Reader(NamedTuple):
    """Positions and velocities of one record from local cubics: each signal is a coordinate.

    `windows` (S,) are the samples in one cubic, `scatter` (S,) what the shortest leave, `periods` (S,) those of signals
    that are known less whole periods, else infinite.
    """

    record: Record
    windows: tuple[int, ...]
    scatter: tuple[float, ...]
    periods: tuple[float, ...]

    @classmethod
    def from_record(cls, record: Record, probes: int = 256, periods: np.ndarray | None = None) -> "Reader":
        """A reader with the longest windows whose cubics leave at most `_WORSE_WINDOW` times what the shortest leave.

        Beyond these they no longer follow the motion. They are tried at `probes` places.
        """
        places = choose_places(record, probes)
        windows, scatter = zip(*(_window(record.ts[places], *signal) for signal in _signals(record)), strict=True)
        each = np.full(len(windows), np.inf) if periods is None else periods
        return cls(record, windows, scatter, tuple(each.tolist()))

    def states(self, places) -> np.ndarray:
        read = self.read(places)
        return np.stack([one[k] for k in (0, 1) for one in read], axis=-1)

    def read(self, places) -> list[tuple]:
        """The result of `_read_states` for every signal at the samples `places`."""
        ts = self.record.ts[places]
        return [
            _read_states(ts, *signal, window)
            for signal, window in zip(_signals(self.record), self.windows, strict=True)
        ]


def choose_places(record: Record, count: int) -> np.ndarray:
    """Places of samples from the first to the last, evenly chosen, `count` of them at most."""
    return np.unique(np.linspace(0, len(record) - 1, count).astype(int))


def _signals(record: Record) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times and values of every signal, where it is not missing."""
    columns = record.matrix.T
    return [(record.ts[np.isfinite(column)], column[np.isfinite(column)]) for column in columns]


def _read_states(ts: np.ndarray, t: np.ndarray, y: np.ndarray, window: int):
    """The values of a signal (t, y) and its rates at the times `ts`, what is left, and the local cubics there.

    Where hardly anything was measured the signal is taken to be at rest.
    """
    if len(t) <= _DEGREE + 1:
        level = np.full(len(ts), np.mean(y) if len(y) else 0.0)
        return level, np.zeros(len(ts)), 0.0, level[:, None]
    return _local_cubics(ts, t, y, min(window, len(t)))


def _window(ts: np.ndarray, t: np.ndarray, y: np.ndarray) -> tuple[int, float]:
    """The number of samples in the window for one signal, and the scatter about the shortest."""
    scatter = _read_states(ts, t, y, _WINDOWS[0])[2]
    best, most = _WINDOWS[0], _WORSE_WINDOW * scatter
    for window in _WINDOWS[1:]:
        if window > len(t) or _read_states(ts, t, y, window)[2] > most:
            break
        best = window
    return best, scatter


def _local_cubics(ts, t, y, window: int):
    """Cubics through the `window` samples of (t, y) about each of the times `ts`: values, rates, what is left, and
    the coefficients (M, 4) of the powers of the time since."""
    after = np.searchsorted(t, ts)
    first = np.clip(after - window // 2, 0, len(t) - window)
    places = first[:, None] + np.arange(window)
    offsets = t[places] - ts[:, None]
    length = np.abs(offsets).max(axis=1, keepdims=True)
    powers = (offsets / length)[..., None] ** np.arange(min(_DEGREE, window - 1) + 1)
    # On [-1, 1] the normal equations of a cubic have a condition below 1e3.
    transposed = powers.swapaxes(1, 2)
    coefficients = np.linalg.solve(transposed @ powers, transposed @ y[places][..., None])
    left = (powers @ coefficients)[..., 0] - y[places]
    coefficients = coefficients[..., 0]
    dof = max(window - powers.shape[-1], 1)
    cubics = coefficients / length ** np.arange(powers.shape[-1])
    return cubics[:, 0], cubics[:, 1], float(np.sqrt(np.mean(left**2) * window / dof)), cubics


def short_windows(readers: list[Reader], length: float) -> tuple[list[Record], np.ndarray]:
    """Short records, each `length` long, of the local cubics at some places of all records, and the states there.

    Motions that are shorter than the time between samples see the curvature of the cubics: what a scene says about
    accelerations, without a second derivative of the data.
    """
    found, states = [], []
    for reader in readers:
        places = choose_places(reader.record, max(4, _WINDOWS_IN_ALL // len(readers)))
        offsets = np.linspace(0.0, length, 4)
        cubics = [
            _read_states(reader.record.ts[places], *s, w)[3]
            for s, w in zip(_signals(reader.record), reader.windows, strict=True)
        ]
        values = np.stack([np.polynomial.polynomial.polyval(offsets, c.T) for c in cubics], axis=-1)
        structured = [restore_structure(v, reader.record) for v in values]
        found += [
            Record(t + offsets, v, inputs_between(reader.record, t + offsets))
            for t, v in zip(reader.record.ts[places], structured, strict=True)
        ]
        states.append(reader.states(places))
    return found, np.concatenate(states)


class TimeScales(NamedTuple):
    """The duration for which a motion looks like a straight line, by the data and by the scene at their states."""

    data: float
    scene: float


def time_scales(readers: list[Reader], motions: AbstractMotions, numbers: np.ndarray) -> TimeScales:
    """The shortest times over which a motion looks like a straight line, with the parameters `numbers` (P,).

    That of the data is the ratio of the spread of a coordinate to its rate, about 1/ω; that of the scene the root of
    the spread of the coordinates, in units of each, over the accelerations there. Where nothing moves, they are
    infinite.
    """
    places = [choose_places(reader.record, _PROBES) for reader in readers]
    states = [reader.states(some) for reader, some in zip(readers, places, strict=True)]
    t = np.concatenate([reader.record.ts[some] for reader, some in zip(readers, places, strict=True)])
    y, n = np.concatenate(states), states[0].shape[1] // 2
    within = np.concatenate([state[:, :n] - state[:, :n].mean(axis=0) for state in states])
    inputs = np.concatenate([reader.record.input_matrix[some] for reader, some in zip(readers, places, strict=True)])
    pulled = motions.rate(t, y, numbers, constant_tables(t, inputs))
    pulled = np.where(np.isfinite(pulled), pulled, 0.0)
    spread, rate, pulled = (np.sqrt(np.mean(x**2, axis=0)) for x in (within, y[:, n:], pulled))
    spread = np.minimum(spread, _QUARTER * np.array(readers[0].periods))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = spread / rate, np.sqrt(spread / pulled)
    return TimeScales(*(float(one[np.isfinite(one) & (one > 0)].min(initial=np.inf)) for one in both))


def levels(records: list[Record | None], scales: list[float]) -> list[list[Piece]]:
    """Cuts of the records, from segments of two time scales to whole records, each twice as long as the one before.

    Each record has its time scale. Without any where records are hardly longer than that; None in the place of a record
    is left out.
    """
    edges = [(k, record, _edges(record, 2.0 * scales[k])) for k, record in enumerate(records) if record is not None]
    most, found, stride = max(len(e) - 1 for *_, e in edges), [], 1
    while stride < most:
        pieces = []
        for k, record, e in edges:
            cut = [*e[:-1:stride].tolist(), len(record)]
            if len(cut) > 2 and 2 * (e[-1] - cut[-2]) < e[min(stride, len(e) - 1)] - e[0]:
                del cut[-2]  # a rest shorter than half a segment joins the one before
            pieces += [_thin_segment(record, k, a, b, scales[k]) for a, b in itertools.pairwise(cut)]
        found.append(pieces)
        stride *= 2
    return found


def _edges(record: Record, length: float) -> np.ndarray:
    """The first samples of the shortest segments of one record, and its length."""
    ts = record.ts
    count = max(1, int((ts[-1] - ts[0]) / length)) if np.isfinite(length) else 1
    count = max(1, min(count, len(ts) // _FEWEST_IN_SEGMENT))
    return np.unique(np.append(np.searchsorted(ts, np.linspace(ts[0], ts[-1], count + 1)[:-1]), len(ts)))


def _thin_segment(record: Record, which: int, begin: int, end: int, scale: float) -> Piece:
    """The samples from `begin` to `end`, thinned to what the time scale of the motion needs."""
    spacing = (record.ts[end - 1] - record.ts[begin]) / max(end - 1 - begin, 1)
    step = int(scale / (_PER_SCALE * spacing)) if np.isfinite(scale) and spacing > 0 else 1
    step = max(1, min(step, (end - begin) // _FEWEST_IN_SEGMENT))
    return Piece(which, np.arange(begin, end, step))


def complete_pieces(pieces: list[Piece], records: list[Record]) -> list[Piece]:
    """The same pieces of records with all of their samples, up to the first of the next piece."""
    firsts = {(piece.record, int(piece.places[0])) for piece in pieces}
    ends = [
        min((place for k, place in firsts if k == piece.record and place > piece.places[0]), default=None)
        for piece in pieces
    ]
    return [
        Piece(piece.record, np.arange(piece.places[0], len(records[piece.record]) if end is None else end))
        for piece, end in zip(pieces, ends, strict=True)
    ]


_SAMPLES_OF_WEAK_FORM = 2000  # of all records, at most
_FEWEST_IN_WINDOW = 9  # samples in a window
_POWER = 4  # of the bump (1 − s²)ᵖ, whose first derivatives vanish at its ends
_TRIALS_OF_WEAK_FORM = 100
_WIDE = 3.0  # time scales in half a window: a bump sees what turns over within it


class _Windows:
    """Bumps on the samples of one record: `inside` and `rate` (W, T), which integrate with φ and φ̇ by trapezia."""

    def __init__(self, ts: np.ndarray, half: float):
        spans = np.gradient(ts)
        spans[0], spans[-1] = 0.5 * (ts[1] - ts[0]), 0.5 * (ts[-1] - ts[-2])
        half = min(max(half, 0.5 * _FEWEST_IN_WINDOW * np.max(np.diff(ts))), 0.5 * (ts[-1] - ts[0]))
        count = max(1, int(np.ceil(2 * (ts[-1] - ts[0]) / half)) - 3)  # each begins a quarter behind the one before
        centres = np.linspace(ts[0] + half, ts[-1] - half, count)
        s = np.clip((ts - centres[:, None]) / half, -1.0, 1.0)
        self.inside = spans * (1 - s**2) ** _POWER
        self.rate = -2 * _POWER / half * spans * s * (1 - s**2) ** (_POWER - 1)


def fit_weak_form(
    systems: Sequence[tuple[SystemResiduals, Sequence[Reader | None], float]], u: np.ndarray
) -> np.ndarray | None:
    """The u (F,) that balances the weak forms of systems best, in a search from `u`; None where nothing is to balance.

    Each system comes with readers of its records and the motion's time scale. One with constraints, or where nothing
    moves, says nothing, and so does hybrid motion, whose velocities jump.
    """
    telling = [
        one
        for one in systems
        if not (isinstance(one[0].scene, Hybrid) or has_constraints(one[0].scene)) and np.isfinite(one[2])
    ]
    if not telling:
        return None
    each, dtype = [weak_form_residuals(*one) for one in telling], telling[0][0].layout.dtype

    def residuals(u):
        return jnp.concatenate([one(u) for one in each])

    value, slope = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    if jax.eval_shape(residuals, u.astype(dtype)).size < 2 * len(u):
        return None  # a network would follow the noise of so few windows
    to_host: Any = lambda f: lambda u: np.asarray(f(u.astype(dtype)), float)  # noqa: E731
    if not (np.isfinite(to_host(value)(u)).all() and np.isfinite(to_host(slope)(u)).all()):
        return None
    try:
        done = least_squares(to_host(value), u, to_host(slope), x_scale="jac", max_nfev=_TRIALS_OF_WEAK_FORM)
    except (ValueError, np.linalg.LinAlgError):  # a trial that is not finite
        return None
    return done.x if np.isfinite(done.x).all() else None


def weak_form_residuals(system: SystemResiduals, readers: Sequence[Reader | None], scale: float):
    """∫ (φ̇ p + φ F) dt of all windows and coordinates, over the size of ∫ φ̇ p: a function of u (F,) for JAX."""
    layout, parameters, form, scene = system.layout, system.parameters, system.signals.form, system.scene
    assert isinstance(scene, System)
    form = form if form is not None and input_functions(scene) else None
    scene = scene if form is None else form.drive_scene(scene)
    pieces = _states_and_inputs([reader for reader in readers if reader is not None], _WIDE * scale)

    def momentum_and_force(y, t, table, numbers):
        params = parameters.restore(numbers)
        params = params if form is None else Driven(params, *table)
        motion = scene._motion(layout, params)
        state = (*halves(y), t, params)
        return jnp.stack([motion.momentum(*state), motion.generalized_force(*state)])

    at_all = jax.vmap(momentum_and_force, in_axes=(0, 0, 0 if form is not None else None, None))

    y, t, inputs = (np.concatenate([piece[k] for piece in pieces]) for k in range(3))
    table = tuple(constant_tables(t, inputs)) if form is not None else None
    rate, inside = (block_diag(*[getattr(piece[3], name) for piece in pieces]) for name in ("rate", "inside"))

    def residuals(u):
        p, force = jnp.moveaxis(at_all(y, t, table, parameters.numbers(u, jnp)), 1, 0)
        moved, forced = rate @ p, inside @ force
        return ((moved + forced) / jnp.sqrt(jnp.sum(moved**2, axis=0))).ravel()

    return residuals


def _states_and_inputs(readers: list[Reader], half: float) -> list[tuple]:
    """States (T, 2n), times, inputs and windows of every record, thinned to this many samples in all."""
    found = []
    for reader in readers:
        count = max(_FEWEST_IN_WINDOW + 1, _SAMPLES_OF_WEAK_FORM // len(readers))
        places = np.unique(np.linspace(0, len(reader.record) - 1, min(count, len(reader.record))).astype(int))
        ts = reader.record.ts[places]
        if len(ts) > 2:
            found.append((reader.states(places), ts, reader.record.input_matrix[places], _Windows(ts, half)))
    return found


_SHORT_STEPS = 8  # of the short search
_SHORT_SAMPLES = 200  # of each record, in it
_ROOM = 2**24  # numbers of tangents at once
_FIRST_DAMPING = 1e-2  # damping, relative to the squared norms of columns
_ALIKE = 0.02  # in the logarithm of the misfit: two starts in one minimum


class Waterfall(NamedTuple):
    """The results of many starts: `misfits` (K,), in order.

    A misfit is the noise that is left, over the size of the signals: its geometric mean over them, of those that went
    through the whole search after that, of the others after the short one. It is infinite where a motion failed.
    """

    misfits: np.ndarray

    def __repr__(self) -> str:
        with np.errstate(divide="ignore", invalid="ignore"):
            above = np.log(self.misfits / self.misfits[0])
        alike = int((above <= _ALIKE).sum())
        failed = int(np.isinf(self.misfits).sum())
        rest = self.misfits[alike : len(self.misfits) - failed]
        text = f"{len(self.misfits)}, of which {alike} came to the least misfit, {self.misfits[0]:.3g} of the signals"
        text += f"; the next to {rest[0]:.3g}, the last to {rest[-1]:.3g}" if len(rest) else ""
        return text + (f"; {failed} could not be followed." if failed else ".")


class Trials(NamedTuple):
    """K starts of the search: u (K, F), the starts of their records (K, N, 2n), and their misfits (K,)."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray


def random_starts(parameters: Parameters, u: np.ndarray, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([u, *(parameters.draw(u, rng) for _ in range(count - 1))])


def short_search(question: Residuals, u: np.ndarray, starts: np.ndarray) -> Trials:
    """The results of the starts u (K, F) after a few steps, from the records' starts (N, 2n); in order."""
    part = _subsample(question)
    at = _evaluate_starts(part, u, np.repeat(starts[None], len(u), axis=0))
    damping = np.full(len(u), _FIRST_DAMPING)
    for _ in range(_SHORT_STEPS):
        going = np.flatnonzero(np.isfinite(at.misfits))
        if not len(going):
            break
        moved = [_step(part, at, int(k), damping[k]) for k in going]
        trial = _evaluate_starts(part, *(np.stack(parts) for parts in zip(*moved, strict=True)))
        better = trial.misfits < at.misfits[going]
        damping[going] = np.where(better, 0.2 * damping[going], 10.0 * damping[going])
        for mine, new in zip(at, trial, strict=True):
            mine[going[better]] = new[better]
    order = np.argsort(at.misfits, kind="stable")
    return Trials(at.u[order], at.starts[order], at.misfits[order])


def misfit(widths: NoiseScale, question: Residuals) -> float:
    return float(np.exp(np.mean(np.log(widths.sigma / question.size))))


def distinct_minima(trials: Trials, count: int) -> list[int]:
    """The places of the best starts that came to different misfits, at most `count`."""
    chosen: list[int] = []
    for k in np.flatnonzero(np.isfinite(trials.misfits)).tolist():
        if all(abs(np.log(trials.misfits[k] / trials.misfits[j])) > 1e-3 for j in chosen):
            chosen.append(k)
    return chosen[:count]


class _EvaluatedStarts(NamedTuple):
    """Like `Trials`, with the weighted triangles (K, N, D + 1, D + 1) of all pieces."""

    u: np.ndarray
    starts: np.ndarray
    misfits: np.ndarray
    triangles: np.ndarray


def _subsample(question: Residuals) -> Residuals:
    chosen = lambda count: np.unique(np.linspace(0, count - 1, _SHORT_SAMPLES).astype(int))  # noqa: E731
    pieces = [Piece(piece.record, piece.places[chosen(len(piece.places))]) for piece in question.pieces]
    return question.with_pieces(pieces, question.fitted)


def _evaluate_starts(question: Residuals, u: np.ndarray, starts: np.ndarray) -> _EvaluatedStarts:
    """The misfits and triangles of trials u (K, F) and starts (K, N, 2n), a portion of them at once."""
    columns = question.states + u.shape[1] + 1
    found = _EvaluatedStarts(
        u.copy(), starts.copy(), np.full(len(u), np.inf), np.zeros((*starts.shape[:2], columns, columns))
    )  # fmt: skip
    largest = max(batch.ts.size for batch in question.batches) * question.states * columns
    portion = max(1, _ROOM // largest)
    for begin in range(0, len(u), portion):
        some = slice(begin, begin + portion)
        for k, trial in enumerate(question.evaluate_trials(u[some], starts[some]), begin):
            if not isinstance(trial, LostTrial):
                noise = question.noise_scale(trial, Gaussian())
                found.starts[k], found.misfits[k] = trial.starts, misfit(noise, question)
                found.triangles[k] = question.linearise(trial, noise)
    return found


def _step(question: Residuals, at: _EvaluatedStarts, k: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    triangles, states, none = at.triangles[k], question.states, np.zeros(at.u.shape[1])
    limits = question.parameters.limits(at.u[k])
    step = eliminate(triangles, states, column_norms(triangles, states), damping, (none, none), limits)
    return question.parameters.take_step(at.u[k], step.u), at.starts[k] + step.starts


# In units of half the sum of squares: the end of a search, where parameters are within 0.05 standard deviations of
# independent noise, and, per sample, that of a level of growing segments, whose answer is only where the next begins.
_ENOUGH, _ENOUGH_OF_LEVEL = 1e-3, 1e-2
_ENOUGH_OF_WINDOWS = 0.1
_POOR, _COARSE = 2.0, 0.02  # times scatter or size of signals: beyond, the shortest segments were not fitted
_LOOSE = 3.0  # standard deviations of u about its first value on these levels, where u is a logarithm or the like
_TRIALS, _TRIALS_OF_LEVEL = 60, 20
_WORSE = (
    5.0  # times more that a join may leave; measured: 3 where friction was left out, 10 and more beyond the horizon
)
_LOST = 2  # levels that may be lost: after one the next may find the motion again, with better parameters
_LYAPUNOV = 5.0  # times 1/λ that a record is long: shorter ones are followed whole
_GRADIENT_STEPS = 3000  # of a descent by gradients
_BEST = 4  # of many starts go through the whole search


class Unfollowed(ValueError):
    """Records whose motion cannot be followed from the first trial."""


def run_multistart(question: Residuals, search, u, y0, starts: int, seed: int) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from u and from `starts` − 1 random values, and what all of them came to."""
    if starts == 1:
        return search(u, y0), None
    trials = short_search(question, random_starts(question.parameters, u, starts, seed), y0)
    misfits, done = trials.misfits.copy(), []
    chosen = distinct_minima(trials, _BEST)
    for place, at in [*((k, (trials.u[k], trials.starts[k])) for k in chosen), (None, (u, y0))]:
        try:
            done.append(search(*at))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].widths, question)
    best = max(done, key=lambda one: (one.question is question, one.question.log_likelihood(one.point, one.widths)))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.widths, question))
    return best, Waterfall(misfits)


def build_reader(record: Record, about: SystemResiduals, numbers: np.ndarray, probes: int = 256) -> Reader | None:
    """A reader of states off a record; None where its signals are no positions, or go round too fast to tell."""
    if not about.signals.look_like_positions(record):
        return None
    periods = about.signals.periods
    smooth = unwrap_record(record, periods)
    if smooth is None:
        return None
    read = about.signals.positions(smooth, numbers)
    if np.isfinite(periods).any():  # in the units of coordinates
        gain = np.nanstd(read.matrix, axis=0) / np.maximum(np.nanstd(smooth.matrix, axis=0), np.finfo(float).tiny)
        periods = np.where(np.isfinite(periods), gain * periods, np.inf)
    return Reader.from_record(read, probes, periods)


def search_records(question: Residuals, u, starts, noise, method: str, readers, weak) -> Descent:
    if method == "segments" and readers is None:
        raise ValueError('method="segments" reads starts off the data: for that values must have the structure of q.')
    if method == "whole" or readers is None:
        return _require_success(question, minimise(question, u, starts, noise, _ENOUGH, _TRIALS))
    u, starts, levels_done = _fit_growing_segments(question, u, starts, noise, readers, weak)
    good = _last_followed_level(levels_done)
    if len(levels_done) - good > _LOST:
        return _search_pieces(question, levels_done[good], levels_done[-1].widths, noise)
    done = minimise(question, u, starts, noise, _ENOUGH, _TRIALS)
    if levels_done and (
        isinstance(done, LostTrial)
        or not done.converged
        or measure_unexplained(question, done.point, done.widths).motion
    ):
        good = _last_followed_level([*levels_done, *([] if isinstance(done, LostTrial) else [done])])
        if good < len(levels_done) and misfit(levels_done[good].widths, question) < _COARSE:
            return _search_pieces(
                question, levels_done[good], None if isinstance(done, LostTrial) else done.widths, noise
            )
    return _require_success(question, done)


def _last_followed_level(levels_done: list[Descent]) -> int:
    """The place of the last level from which on joining did not lose the motion.

    A scene that lacks something leaves up to three times more at each join, and motion that is lost some ten times.
    """
    good, last = 0, np.inf
    for k, done in enumerate(levels_done):
        now = misfit(done.widths, done.question)
        if now <= _WORSE ** (k - good) * last:
            good, last = k, now
    return good


def _separation(done: Descent) -> float:
    """The logarithm of how far motions part that begin side by side, over the longest record: λ times its length.

    λ is the median over the pieces, from the mean square of the derivatives by the start over the first and the last
    third of each.
    """
    rates, states = [], done.question.states
    for batch, slopes in zip(done.question.batches, done.point.slopes, strict=True):
        for ts, weights, by_start in zip(batch.ts, batch.weights, slopes[..., :states], strict=True):
            squares = (by_start[weights.any(axis=-1)] ** 2).sum(axis=1)
            third = len(squares) // 3
            if third and (squares[:third].sum(axis=0) > 0).all():
                growth = np.log(squares[-third:].sum(axis=0) / squares[:third].sum(axis=0)).mean() / 2
                rates.append(growth / (ts[2 * third] - ts[0]))
    longest = max(record.ts[-1] - record.ts[0] for record in done.question.records)
    return float(np.median(rates) * longest) if rates else 0.0


def _search_pieces(question: Residuals, level: Descent, joined: NoiseScale | None, noise) -> Descent:
    """The search on the pieces of a level, with all samples of these and a start for each."""
    pieces = complete_pieces(level.question.pieces, question.records)
    part = question.with_pieces(pieces, level.question.fitted)
    done = minimise(part, level.point.u, level.point.starts, noise, _ENOUGH, _TRIALS)
    if isinstance(done, LostTrial):
        return _require_success(part, done)
    worse = (
        "fails" if joined is None else f"leaves {misfit(joined, question) / misfit(done.widths, part):.2g} times more"
    )
    text = f"The records are followed in {len(pieces)} pieces, each with a start of its own: to join them {worse}"
    growth = _separation(done)
    if growth > _LYAPUNOV:
        text += f", because motions that begin side by side part e^{growth:.0f}-fold over a record."
        return done._replace(message=f"{done.message} {text}")
    text += ", though the motion does not forget its start: the scene lacks something that lasts longer."
    return done._replace(message=f"{done.message} {text}", converged=False)


def search_again(done: Descent, noise) -> Descent:
    """The end of a search where samples that share a rounding error count once; of sensors that do not round the same.

    Which samples do is known where the motion is, and does not change with the last digits of the parameters.
    """
    question = done.question
    if np.isnan(question.sensor.step).all():
        return done
    question = question.count_runs_once(done.point, done.widths)
    again = _require_success(question, minimise(question, done.point.u, done.point.starts, noise, _ENOUGH, _TRIALS))
    return done if not again.converged else again._replace(converged=done.converged, message=done.message)


def search_by_gradient(question: Residuals, u, y0, noise, readers: list[Reader | None] | None) -> Descent:
    """The descent by gradients: over segments of the records that grow, where they can be read, then over all."""
    watch, question.watch = question.watch, None
    tell = None if watch is None else lambda text: print(text, file=sys.stderr, flush=True)
    steps = _GRADIENT_STEPS
    if readers is not None:
        u = start_by_weak_form(question, u, readers)
        u = _descend_segments(question, u, noise, readers, tell)
        steps = _GRADIENT_STEPS // 3
    done = descend_gradient(question, u, y0, noise, steps, tell)
    if not isinstance(done, LostTrial):
        done = build_descent(question, done[0], done[1], noise, _GRADIENT_STEPS, done[2])
    return _require_success(question, done)


def _require_success(question: Residuals, done: Descent | LostTrial) -> Descent:
    """The result of a search. Raises `Unfollowed` where its motions could not be followed."""
    if isinstance(done, LostTrial):
        raise Unfollowed(question.describe_failure(done) + " Begin nearer: other params0, or starts that are known.")
    return done


def _fit_growing_segments(
    question: Residuals, u, starts, noise, readers: list[Reader | None], weak: Callable
) -> tuple[np.ndarray, np.ndarray, list[Descent]]:
    """Better first values of u and of the starts, from segments that grow together to whole records; and the levels.

    Where joining loses the motion twice in a row, no longer segment is tried.
    """
    anchor = Anchor(u, np.where(np.isfinite(question.parameters.reach), 1.0 / _LOOSE, 0.0))
    search = functools.partial(_fit_level, question, noise=noise, readers=readers, anchor=anchor)
    begun = _fit_shortest_segments(question, u, starts, readers, search)
    for other in (lambda: weak(u), lambda: _fit_short_windows(question, u, noise, readers, anchor)):
        if begun.misfit > 0.0:  # the shortest segments were not fitted from here
            begun = min(
                begun, _fit_shortest_segments(question, other(), starts, readers, search), key=lambda one: one.misfit
            )
    u, best, levels_done = begun.u, begun.best, [] if begun.first is None else [begun.first]
    for pieces in begun.cuts[1:]:
        done = search(pieces, u, best)
        if isinstance(done, LostTrial):
            break  # whole records then begin from the best so far, and say so if they fail as well
        u = done.point.u
        levels_done.append(done)
        if len(levels_done) - _last_followed_level(levels_done) > _LOST:
            break
    return u, np.stack([best[k, 0] for k in range(len(question.records))]), levels_done


class _ShortestSegments(NamedTuple):
    """The beginning of growing segments: u, the cuts, the states at the first samples, their error, and the search
    on the shortest segments where it came to an end."""

    u: np.ndarray
    cuts: list[list[Piece]]
    best: dict[tuple[int, int], np.ndarray]
    misfit: float
    first: Descent | None = None


def _fit_shortest_segments(question: Residuals, u, starts, readers: list[Reader | None], search) -> _ShortestSegments:
    """The search on the shortest segments, from u, whose misfit is positive where they were not fitted.

    It is the mean logarithm of the noise σ of the signals, over `_POOR` times the scatter of the data or a share
    `_COARSE` of the signals' size, whichever is larger.
    """
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    best = {(k, 0): start for k, start in enumerate(starts)}
    if not cuts:
        return _ShortestSegments(u, cuts, best, -np.inf)
    done = search(cuts[0], u, best)
    if isinstance(done, LostTrial):
        return _ShortestSegments(u, cuts, best, np.inf)
    near = []
    for part in question.parts:
        if reading := [reader for reader in readers[part.records] if reader is not None]:
            scatter = np.sqrt(np.mean([np.square(reader.scatter) for reader in reading], axis=0))
            near.append(np.maximum(_POOR * scatter, _COARSE * part.system.size[: len(scatter)]))
    ratio = done.widths.sigma / np.concatenate(near)
    return _ShortestSegments(done.point.u, cuts, best, float(np.mean(np.log(ratio))), done)


def _fit_level(question: Residuals, pieces: list[Piece], u, best, noise, readers, anchor) -> Descent | LostTrial:
    """The search on one cut of the records. The states in `best`, by record and sample, begin it and take its end."""
    firsts = [(piece.record, int(piece.places[0])) for piece in pieces]
    for k, reader in enumerate(readers):
        new = [place for record, place in firsts if record == k and (k, place) not in best]
        if new and reader is not None:
            read = pad_states(reader.states(np.array(new)), question.states)
            best |= {(k, place): y for place, y in zip(new, read, strict=True)}
    part = question.with_pieces(pieces, np.array([question.fitted[k] or place > 0 for k, place in firsts]))
    y0 = np.stack([best[first] for first in firsts])
    done = minimise(part, u, y0, noise, _ENOUGH_OF_LEVEL * part.measured, _TRIALS_OF_LEVEL, anchor)
    if not isinstance(done, LostTrial):
        best |= dict(zip(firsts, done.point.starts, strict=True))
    return done


def _fit_short_windows(question: Residuals, u, noise, readers: list[Reader | None], anchor: Anchor) -> np.ndarray:
    """The u that suits the accelerations of local cubics: these have one minimum where segments are too long for u."""
    scales, short, states = _time_scales(question, readers, u), [], []
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = scales[part.records.start]
        if not (reading and np.isfinite(scale)):
            continue
        records, begun = short_windows(reading, 0.25 * scale)
        states.append(pad_states(begun, question.states))
        short.append(part.system.with_records(records, np.ones(len(records), bool)))
    if not short:
        return u
    part = Residuals(short)
    y0 = np.concatenate(states)[:, : part.states]
    done = minimise(part, u, y0, noise, _ENOUGH_OF_WINDOWS, _TRIALS_OF_LEVEL, anchor)
    return u if isinstance(done, LostTrial) else done.point.u


def start_by_weak_form(question: Residuals, u: np.ndarray, readers: list[Reader | None]) -> np.ndarray:
    """The u that balances the weak form of Lagrange's equations, u itself where there is none."""
    scales = _time_scales(question, readers, u)
    parts = question.parts
    found = fit_weak_form([(part.system, readers[part.records], scales[part.records.start]) for part in parts], u)
    return u if found is None else found


def _descend_segments(question: Residuals, u, noise, readers: list[Reader | None], tell) -> np.ndarray:
    """The u that two thirds of the steps come to over segments that grow, each with a start of its own."""
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    for pieces in [] if any(part.system.clocks for part in question.parts) else cuts:
        reading = ((recorder, piece.places[:1]) for piece in pieces if (recorder := readers[piece.record]))
        states = np.stack([pad_states(one.states(place)[0], question.states) for one, place in reading])
        part = question.with_pieces(pieces, np.ones(len(pieces), bool))
        done = descend_gradient(part, u, states, noise, 2 * _GRADIENT_STEPS // (3 * len(cuts)), tell)
        if not isinstance(done, LostTrial):
            u = done[0]
    return u


def _time_scales(question: Residuals, readers: list[Reader | None], u) -> list[float]:
    """The duration for which the motion of each record looks like a straight line: of all records of a system the same.

    It is infinite for a system of which no state can be read off.
    """
    scales, numbers = [], question.parameters.numbers(u)
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = min(time_scales(reading, part.system.motions, numbers)) if reading else np.inf
        scales += [scale] * len(part.system.records)
    return scales


def pad_states(state: np.ndarray, states: int) -> np.ndarray:
    """States (..., 2n) of a system, with zeros up to those of the one with the most coordinates."""
    return np.concatenate([state, np.zeros((*state.shape[:-1], states - state.shape[-1]))], axis=-1)
