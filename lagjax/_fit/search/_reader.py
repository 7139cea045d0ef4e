"""States and time scales, read off the data by local cubics."""

from typing import Any, NamedTuple

import numpy as np

from lagjax._fit.model._assembly import errors_of_system
from lagjax._fit.model._inputs import constant_tables, split_leaves
from lagjax._fit.model._motions import AbstractMotions
from lagjax._fit.model._records import Record, known_start, restore_structure
from lagjax._fit.model._residuals import Point, Residuals, SystemResiduals
from lagjax._fit.model._sensors import UNCLEAR, unwrap_record
from lagjax._show import even_places

_DEGREE = 3  # of local polynomials: velocities without the bias that curvature gives to lines
_WINDOWS = (7, 13, 25, 49, 97, 193)  # samples in one of them
_PROBES = 32  # places of a record where its time scale is looked at
_WORSE_WINDOW = 1.3  # what a window may leave, in units of what the shortest leaves
_WINDOWS_IN_ALL = 256  # places of all records where curvature is looked at
_ROUNDED = 1e-9  # of the largest number of a start: within it one that is given touches
_SURELY = 5.0  # standard deviations of a state that was read
_QUARTER = 0.25  # of a period: motion over a segment may be wrong by it; beyond a half residuals have false minima


class Reader(NamedTuple):
    """Positions and velocities of one record from local cubics, each signal a coordinate: samples of a cubic `windows`
    (S,), residuals of the shortest `scatter` (S,), and `periods` (S,), infinite without wrapping."""

    record: Record
    windows: tuple[int, ...]
    scatter: tuple[float, ...]
    periods: tuple[float, ...]

    @classmethod
    def from_record(cls, record: Record, probes: int, periods: np.ndarray) -> "Reader":
        """A reader with the longest windows that leave at most `_WORSE_WINDOW` times what the shortest leave, at
        `probes` places."""
        places = even_places(len(record), probes)
        windows, scatter = zip(
            *(_choose_window(record.ts[places], *signal) for signal in _signal_columns(record)), strict=True
        )
        return cls(record, windows, scatter, tuple(periods.tolist()))

    def states(self, places) -> np.ndarray:
        read = self.read(places)
        return np.stack([one[k] for k in (0, 1) for one in read], axis=-1)

    @property
    def noise(self) -> np.ndarray:
        """The noise of states that were read, (2n,), at its widest: that of cubics within their windows."""
        scatter, windows, step = np.array(self.scatter), np.array(self.windows), np.median(np.diff(self.record.ts))
        return _SURELY * np.concatenate([scatter, scatter * np.sqrt(75.0 / windows**3) / step])

    def smoothest(self, first: int, last: int) -> int:
        """The sample from `first` to `last` about which the cubics leave least: away from where the motion jumps."""
        places = np.arange(first, last + 1)
        scatter = np.maximum(self.scatter, np.finfo(float).tiny)
        return first + int(
            np.argmin(np.max([one[2] / s for one, s in zip(self.read(places), scatter, strict=True)], 0))
        )

    def read(self, places) -> list[tuple]:
        """The result of `_read_states` for every signal, at the samples with indices `places`."""
        ts, pairs = self.record.ts[places], zip(_signal_columns(self.record), self.windows, strict=True)
        return [_read_states(ts, *signal, window) for signal, window in pairs]


def _signal_columns(record: Record) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(record.ts[np.isfinite(column)], column[np.isfinite(column)]) for column in record.matrix.T]


def _read_states(ts: np.ndarray, t: np.ndarray, y: np.ndarray, window: int):
    """The values of a signal (t, y) and its rates at the times `ts`, what is left, and the local cubics there."""
    if len(t) <= _DEGREE + 1:  # hardly anything was measured: taken to be at rest
        level = np.full(len(ts), np.mean(y) if len(y) else 0.0)
        return level, np.zeros(len(ts)), np.zeros(len(ts)), level[:, None]
    return _local_cubics(ts, t, y, min(window, len(t)))


def _choose_window(ts: np.ndarray, t: np.ndarray, y: np.ndarray) -> tuple[int, float]:
    """The number of samples in the window for one signal, and the scatter about the shortest."""

    def left(window: int) -> float:
        return float(np.sqrt(np.mean(_read_states(ts, t, y, window)[2] ** 2)))

    scatter = left(_WINDOWS[0])
    best, most = _WINDOWS[0], _WORSE_WINDOW * scatter
    for window in _WINDOWS[1:]:
        if window > len(t) or left(window) > most:
            break
        best = window
    return best, scatter


def _local_cubics(ts, t, y, window: int):
    """Cubics through `window` samples of (t, y) about each of `ts`: values, rates, residuals, coefficients (M, 4)."""
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
    return cubics[:, 0], cubics[:, 1], np.sqrt(np.mean(left**2, axis=1) * window / dof), cubics


def short_windows(readers: dict[int, Reader], length: float) -> tuple[list[Record], np.ndarray, list[int]]:
    """Records of this `length` along local cubics at some places of all records, the states there, and the record that
    each is of. Their motions see the curvature of the cubics, the data's accelerations, without a second derivative of
    the data."""
    found, states, owners, offsets = [], [], [], np.linspace(0.0, length, 4)
    for record, reader in readers.items():
        places = even_places(len(reader.record), max(4, _WINDOWS_IN_ALL // len(readers)))
        cubics = [one[3] for one in reader.read(places)]
        values = np.stack([np.polynomial.polynomial.polyval(offsets, c.T) for c in cubics], axis=-1)
        structure = reader.record.input_structure
        for ts, shown in zip(reader.record.ts[places, None] + offsets, values, strict=True):
            inputs = structure and split_leaves(reader.record.interpolate_inputs(ts), *structure)
            found.append(Record(ts, restore_structure(shown, reader.record), inputs))
        states.append(reader.states(places))
        owners += [record] * len(places)
    return found, np.concatenate(states), owners


class TimeScales(NamedTuple):
    """The duration for which a motion looks like a straight line, by the data and by the scene at their states."""

    data: float
    scene: float


def time_scales(readers: list[Reader], motions: AbstractMotions, numbers: np.ndarray) -> TimeScales:
    """The shortest times over which a motion looks like a straight line, with parameters `numbers` (N, P): spread over
    rate in the data, √(spread over acceleration) in the scene; infinite where nothing moves."""
    places = [even_places(len(reader.record), _PROBES) for reader in readers]
    states = [reader.states(some) for reader, some in zip(readers, places, strict=True)]
    times = [reader.record.ts[some] for reader, some in zip(readers, places, strict=True)]
    y, n = np.concatenate(states), states[0].shape[1] // 2
    within = np.concatenate([state[:, :n] - state[:, :n].mean(axis=0) for state in states])
    inputs = [reader.record.interpolate_inputs(ts) for reader, ts in zip(readers, times, strict=True)]
    t, inputs = np.concatenate(times), np.concatenate(inputs)
    each = np.repeat(numbers, list(map(len, states)), axis=0)
    pulled = motions.rate(t, y, each, constant_tables(t, inputs))
    pulled = np.where(np.isfinite(pulled), pulled, 0.0)
    spread, rate, pulled = (np.sqrt(np.mean(x**2, axis=0)) for x in (within, y[:, n:], pulled))
    spread = np.minimum(spread, _QUARTER * np.array(readers[0].periods))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = spread / rate, np.sqrt(spread / pulled)
    return TimeScales(*(float(one[np.isfinite(one) & (one > 0)].min(initial=np.inf)) for one in both))


def build_reader(record: Any, about: SystemResiduals, numbers: np.ndarray, probes: int = 256) -> Reader | None:
    """A reader of states off a record; None where its signals are no positions, or go round too fast to tell."""
    if not isinstance(record, Record) or not about.signals.look_like_positions(record):
        return None
    periods = about.signals.periods
    if (smooth := unwrap_record(record, periods)) is None:
        return None
    read = about.signals.positions(smooth, numbers)
    if np.isfinite(periods).any():  # in the units of coordinates
        gain = np.nanstd(read.matrix, axis=0) / np.maximum(np.nanstd(smooth.matrix, axis=0), np.finfo(float).tiny)
        periods = np.where(np.isfinite(periods), gain * periods, np.inf)
    return Reader.from_record(read, probes, periods)


def read_records(residuals: Residuals) -> list[Reader | None]:
    """A reader for each record whose signals are positions, None for others; a few hundred probes for each system."""
    parameters, found = residuals.parameters, []
    for part in residuals.parts:
        probes, places = max(8, 256 // len(part.records)), parameters.places[part.frame.records]
        rows = zip(part.records, parameters.first[places], strict=True)
        found += [build_reader(record, part, numbers, probes) for record, numbers in rows]
    return found


def first_starts(residuals: Residuals, readers: list[Reader | None], params0: Any) -> np.ndarray:
    """The first guess of the starts of all records, (N, 2n) of the system with the most coordinates."""
    found = []
    for part in residuals.parts:
        first = part.frame.records.start
        for place, motion in enumerate(residuals.motions[part.frame.records].tolist()):
            record, reader = residuals.records[motion], readers[motion]
            with errors_of_system(part.name):
                state = known_start(record, part.layout, place, params0)
                state = read_start(reader, record, part, f"records[{motion - first}]") if state is None else state
                found.append(pad_states(state, residuals.states))
    return np.stack(found)


def read_start(reader: Reader | None, record: Any, part: SystemResiduals, called: str) -> np.ndarray:
    """The first state (2n,) of a record. Raises `ValueError` where it cannot be read off the data."""
    if reader is not None:
        return reader.states(np.array([0]))[0]
    if isinstance(record, Record) and part.signals.look_like_positions(record):
        raise ValueError(UNCLEAR.format(called))
    raise ValueError(
        f"{called} needs a start, because its values do not have the structure of q: give start=(q0, qdot0) if it is "
        "known, else start=lagjax.Guess(q0, qdot0)."
    )


def start_noise(residuals: Residuals, readers: list[Reader | None], point: Point) -> np.ndarray:
    """The noise of the starts (N, 2n) of the pieces; what a record says of them is exact, to rounding."""
    noise = _ROUNDED * np.max(np.abs(point.starts), axis=1, keepdims=True) + np.zeros_like(point.starts)
    for row, (own, places, _) in enumerate(residuals.pieces):
        record = residuals.motions[own]
        if (reader := readers[record]) is not None and (places[0] > 0 or residuals.records[record].begins is None):
            noise[row] = pad_states(reader.noise, residuals.states)
    return noise


def pad_states(state: np.ndarray, states: int) -> np.ndarray:
    """States (..., 2n) of a system, with zeros up to those of the one with the most coordinates."""
    return np.concatenate([state, np.zeros((*state.shape[:-1], states - state.shape[-1]))], axis=-1)
