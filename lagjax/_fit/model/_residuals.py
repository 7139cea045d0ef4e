"""Residuals: the measured signals less those of the motions of a trial, with their derivatives.

The unknowns are a `Point`: u (F,), the free parameters as their transforms move them, and the starts (N, 2n) of the N
pieces of records. A residual of piece k depends on start k and on L of the u alone, those that all records share and
those of its own record (`Unknowns`): the rows of a piece, D = 2n + L columns and the residual, are compressed to a
triangle of D + 1 rows (QR), in which all sums of squares are the same.

**One system is a list of one.** Each system has its own coordinates, sensors and inputs; all share u. Once the start of
a piece is eliminated only the columns of the parameters are left, so that the search does not know of systems. Rows of
all systems are made alike: a start has room for the most coordinates, of which a smaller system leaves the last ones
without any influence, like those of a start that is known; and the signals of all systems stand side by side, with no
weight where a record does not have them.

`Residuals.evaluate` is the map for searches, and `Residuals.trace` the same for JAX, from which
densities have their gradients: back over the steps of motions, where trials go forward along every unknown.
"""

import contextlib
import copy
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import log_ndtr

from lagjax._engine import Solution
from lagjax._fit.model._blas import one_blas_thread
from lagjax._fit.model._inputs import constant_tables, input_functions, inputs_at
from lagjax._fit.model._motions import AbstractMotions, Manifold, Origins, RecordMotion, step_budget
from lagjax._fit.model._noise import (
    AbstractNoise,
    NoiseScale,
    Sensor,
    likelihood_slopes,
    log_likelihood,
    sample_counts,
    sample_worths,
)
from lagjax._fit.model._parameters import Parameters, Unknowns
from lagjax._fit.model._pieces import Piece, Samples, batch_pieces, whole_pieces
from lagjax._fit.model._records import Guess, start_pair
from lagjax._fit.model._sensors import wrap_residuals
from lagjax._fit.model._signals import Signals
from lagjax._fit.model._timings import Clock
from lagjax._interface import Layout, halves
from lagjax._run import simulate
from lagjax._run.hybrid import Hybrid, Scene, begin_in
from lagjax._scene import DrivenParams


class Point(NamedTuple):
    """The unknowns of a fit: u (F,), which move the parameters, and the starts (N, 2n) of the pieces of records."""

    u: np.ndarray
    starts: np.ndarray


class Trial(NamedTuple):
    """One trial: the unknowns, and for each batch the residuals (N, T, S) and their derivatives (N, T, S, D), which may
    be left out.

    Where starts lie on constraints `across` (N, 2n, 2n) takes a change of each to its part across these, which changes
    nothing that is measured.
    """

    u: np.ndarray
    starts: np.ndarray
    residuals: list[np.ndarray]
    slopes: list[np.ndarray]
    across: np.ndarray | None = None
    solutions: Sequence[Solution | None] = ()

    @property
    def point(self) -> Point:
        return Point(self.u, self.starts)

    def flat(self) -> np.ndarray:
        """The residuals of all batches, (M, S)."""
        return np.concatenate([r.reshape(-1, r.shape[-1]) for r in self.residuals])


# Twice the log-likelihood by which an open contact must be likelier than a closed one where a record begins. At nodes a
# contact that is held closed by mistake costs more: of 4, the pieces of a bouncing ball did not converge.
_PLAINLY = 9.0


class LostMotion(ValueError):
    """Error: a motion of a trial failed; it names the record, the time, and the cause."""


class _SystemTrial(NamedTuple):
    """The unknowns of one system in a trial: the parameters (N, P) of its pieces and their directions (N, L, P), None
    without derivatives; the starts, how these move with the unknown states, (N, 2n, 2n) or None for the identity, and
    with u, (N, L, 2n). `known` are solutions without derivatives, `solutions` those of all motions of the trial."""

    numbers: np.ndarray
    directions: np.ndarray | None
    starts: np.ndarray
    tangents: np.ndarray | None
    starts_dot: np.ndarray
    known: Iterator[Solution | None]
    solutions: list[Solution | None]


class SystemFrame(NamedTuple):
    """The place of one system among all: which of all pieces are its own, `rows`, which records, and its first signal.

    Of all systems together: the `sensor` and the `periods` of the S signals, and the most numbers of a start, `states`.
    """

    rows: np.ndarray
    records: slice
    first: int
    sensor: Sensor
    periods: np.ndarray
    states: int


@dataclass(eq=False)
class SystemResiduals:
    """The residuals of pieces of the records of one system, called `name`, None where there is no other.

    `fitted` (N,) says of each piece whether its start is free; `size` (S,) is the root mean square of the signals, and
    that times `rtol`, the tolerance of the motion, the smallest noise that can be estimated; `restore` makes the
    parameters of the scene from the numbers (P,) of a record. Where some pieces are
    `Timings`, with `clocks` by the number of the record, crossing times are one more signal, the last. Rows and columns
    are those of `frame`, once the system is a part of `Residuals`.
    """

    name: str | None
    scene: Scene
    records: list[Any]
    pieces: list[Piece]
    fitted: np.ndarray
    motions: AbstractMotions
    signals: Signals
    restore: Callable[[Any], Any]
    size: np.ndarray
    rtol: float
    clocks: dict[int, Clock]
    manifold: Manifold | None
    sensor: Sensor
    frame: Any = None

    def __post_init__(self):
        timed = any(piece.record in self.clocks for piece in self.pieces)
        self.names = (*self.signals.names, *["times"] * timed)
        self.size, self.sensor = self.size[: len(self.names)], Sensor(*(x[: len(self.names)] for x in self.sensor))
        self.least = self.rtol * self.size
        self.layout: Layout = self.signals.layout
        self.states = 2 * self.layout.size
        starts = [self.records[piece.record].begins if piece.places[0] == 0 else None for piece in self.pieces]
        self.origins = Origins(starts, self.layout, self.restore)
        self.modes = [piece.mode for piece in self.pieces]
        self.fits_on_constraints = self.manifold is not None and bool(self.fitted.any())

    def with_records(self, records: list[Any], fitted: np.ndarray, manifold: Manifold | None = None):
        """The residuals of other records of the system with the same signals, each in one piece."""
        return replace(self, records=records, pieces=whole_pieces(records), fitted=fitted, clocks={}, manifold=manifold)

    def columns(self, record: int) -> slice:
        first, last = self.frame.first, self.frame.first + len(self.signals.names)
        return slice(last, last + 1) if record in self.clocks else slice(first, last)

    def sensor_noise(self, noise: NoiseScale) -> NoiseScale:
        """The noise of the signals of records among that of all signals, without that of crossing times."""
        own = slice(self.frame.first, self.frame.first + len(self.signals.names))
        return NoiseScale(noise.sigma[own], noise.dof[own])

    @functools.cached_property
    def batches(self) -> list[Samples]:
        """The records in batches, then each of the timings as a batch of its own, all with a column for each signal."""
        sensed = [row for row, piece in enumerate(self.pieces) if piece.record not in self.clocks]
        own, eps = [self.pieces[row] for row in sensed], float(np.finfo(self.layout.dtype).eps)
        some = batch_pieces(self.records, own, eps, "zero" if self.signals.form is None else self.signals.form.hold)
        found = [batch._replace(rows=np.array(sensed)[batch.rows]) for batch in some]
        for row, (k, *_) in enumerate(self.pieces):
            if k in self.clocks:
                record = self.records[k]
                weights, values = record.weight_matrix[None], np.nan_to_num(record.matrix)[None]
                inputs = np.zeros((1, len(record), 0 if self.signals.form is None else self.signals.form.size))
                found.append(Samples(np.array([row]), values[..., 0], values, weights, inputs, None))
        for k, batch in enumerate(found):
            columns = self.columns(self.pieces[batch.rows[0]].record)
            values, weights = np.zeros((2, *batch.ts.shape, len(self.frame.periods)))
            values[..., columns], weights[..., columns] = batch.values, batch.weights
            if self.signals.delays is not None and self.pieces[batch.rows[0]].record not in self.clocks:
                weights[batch.ts < batch.ts[:, :1] + self.signals.delays.longest] = 0.0
            if (sides := self.frame.sensor.sides(values)) is not None:
                values = self.frame.sensor.bounds_shown(values, weights, sides)
            found[k] = batch._replace(values=values, weights=weights, sides=sides)
        return found

    # ---- the trials of a search ----

    def append_residuals(
        self, trial: Trial, numbers: np.ndarray, directions: np.ndarray | None, known: Iterator[Solution | None]
    ) -> None:
        """Append the residuals of this system to a trial, whose starts move to where the motions begin, for parameters
        `numbers` (N, P) of the pieces with `directions` (N, L, P), None without derivatives; solutions may be `known`.
        Raises `LostMotion` for the first piece whose motion fails."""
        begun = self._begin_trial(trial, numbers, directions, known)
        for batch in self.batches:
            clock = self.clocks.get(self.pieces[batch.rows[0]].record)
            if clock is not None:
                shown = self._evaluate_times(clock, batch, begun)
            elif self.signals.delays is not None:
                shown = self._evaluate_delayed(batch, begun)
            else:
                motion, numbers_dot = self._follow(batch, batch.ts, begun), self._directions(batch, begun)[1]
                shown = self.signals.evaluate(motion, batch.ts, batch.inputs, begun.numbers[batch.rows], numbers_dot)
            self._require_finite(batch, *shown)
            self._append_residuals(batch, trial, shown[0])
            if directions is not None:
                self._append_slopes(batch, trial, shown[1])

    def label(self, record: int) -> str:
        """The name by which the user reaches a record of this system: `records[0]`, or `records['name'][0]`."""
        return f"records{'' if self.name is None else f'[{self.name!r}]'}[{record}]"

    def lost(self, row: Any, text: str) -> LostMotion:
        record, places, _ = self.pieces[row]
        begin = self.records[record].ts[places[0]]
        return LostMotion(f"The motion of {self.label(record)} from t = {begin:g} failed. {text}")

    def _begin_trial(
        self, trial: Trial, numbers: np.ndarray, directions: np.ndarray | None, known: Iterator[Solution | None]
    ) -> _SystemTrial:
        rows, states = self.frame.rows, self.states
        along = np.zeros((len(numbers), 0, numbers.shape[1])) if directions is None else directions
        starts, starts_dot = self.origins.move(trial.starts[rows, :states], numbers, along)
        tangents = None
        if self.fits_on_constraints:
            assert self.manifold is not None and trial.across is not None
            some, tangents = self.fitted, np.tile(np.eye(states), (len(starts), 1, 1))
            t, inputs = self._first_samples()
            each = (x[some] for x in (starts, t, numbers, along, inputs))
            modes = [mode for mode, fitted in zip(self.modes, some, strict=True) if fitted]
            consistent = self.manifold.project(*each, modes=modes)
            starts[some], tangents[some], starts_dot[some] = consistent
            if (lost := ~np.isfinite(starts).all(axis=1)).any():
                raise self.lost(np.argmax(lost), "No start near the one that was tried satisfies the constraints.")
            trial.across[rows, :states, :states] = np.eye(states) - tangents
        finite = [np.isfinite(x).all(axis=tuple(range(1, x.ndim))) for x in (numbers, along, starts)]
        if not np.all(finite):
            raise self.lost(np.argmin(np.all(finite, axis=0)), "A parameter is not finite.")
        trial.starts[rows, :states] = starts
        solutions = cast(list, trial.solutions)
        return _SystemTrial(numbers, directions, starts, tangents, starts_dot, known, solutions)

    def _follow(self, batch: Samples, ts: np.ndarray, trial: _SystemTrial, must: bool = True) -> RecordMotion:
        """The motions of a trial at the times `ts` (N, T) of the pieces of a batch, which all `must` be followed."""
        y0_dot, numbers_dot = self._directions(batch, trial)
        rows = batch.rows
        given = ts, trial.starts[rows], trial.numbers[rows], y0_dot, numbers_dot, batch.table
        motion = self.motions.follow(*given, self.first_modes(rows), next(trial.known, None))
        trial.solutions.append(motion.solution)
        if must and not motion.ok:
            row, text = motion.describe_failure(ts, self.layout)
            raise self.lost(batch.rows[row], text)
        return motion

    # ---- the modes in which pieces begin ----

    def choose_modes(self, trial: Trial, numbers, noise: np.ndarray) -> list[tuple[int, ...]]:
        """The mode of each piece whose states are known to a `noise` (N, 2n): of those possible that which leaves the
        least. A record says in which it begins where its start is a guess, or known."""
        found = self._possible_modes(trial, numbers, noise)
        most = max(map(len, found))
        if most == 1:
            return [modes[0] for modes in found]
        left = np.full((most, len(found)), np.inf)
        for k in range(most):
            modes = [of[min(k, len(of) - 1)] for of in found]
            pieces = [piece._replace(mode=mode) for piece, mode in zip(self.pieces, modes, strict=True)]
            with contextlib.suppress(LostMotion):
                left[k] = replace(self, pieces=pieces)._measure_left(trial, numbers)
        if not isinstance(self.scene, Hybrid):  # records begin at rest, not with little hops; nodes may be anywhere
            weight = [_PLAINLY / len(piece.places) * (piece.places[0] == 0) for piece in self.pieces]
            left *= np.exp(-np.arange(most)[:, None] * weight)
        return [of[min(k, len(of) - 1)] for of, k in zip(found, np.argmin(left, axis=0).tolist(), strict=True)]

    def _possible_modes(self, trial: Trial, numbers, noise: np.ndarray) -> list[list[tuple[int, ...]]]:
        found, begins = [[piece.mode] for piece in self.pieces], [piece.places[0] == 0 for piece in self.pieces]
        rows = [row for row, piece in enumerate(self.pieces) if not piece.mode]
        if isinstance(self.scene, Hybrid):
            for row in rows:
                found[row] = [()] if begins[row] else [(k,) for k in range(len(self.scene.modes))]
        elif self.manifold is not None and self.manifold.touches:
            t, inputs = self._first_samples()
            given = trial.starts[self.frame.rows, : self.states], t, numbers, inputs, noise[self.frame.rows]
            for row, modes in zip(rows, self.manifold.possible_modes(*(x[rows] for x in given)), strict=True):
                start = self.records[self.pieces[row].record].begins if begins[row] else None
                found[row] = modes if start is None else modes[-1:] if isinstance(start, Guess) else found[row]
        return found

    def _first_samples(self) -> tuple[np.ndarray, np.ndarray]:
        """The times (N,) at which the pieces begin, and the inputs (N, I) then."""
        t = np.array([self.records[piece.record].ts[piece.places[0]] for piece in self.pieces])
        inputs = np.zeros((len(t), self.batches[0].inputs.shape[-1]))
        for batch in self.batches:
            inputs[batch.rows] = batch.inputs[:, 0]
        return t, inputs

    def _measure_left(self, trial: Trial, numbers) -> np.ndarray:
        """The sum of squares (N,) that the motion of each piece leaves, infinite for those that are lost."""
        found: list[np.ndarray] = []
        trial = trial._replace(starts=trial.starts.copy(), residuals=found, solutions=[])
        begun, left = self._begin_trial(trial, numbers, None, iter(())), np.full(len(self.pieces), np.inf)
        for batch in (one for one in self.batches if self.pieces[one.rows[0]].record not in self.clocks):
            motion, numbers_dot = self._follow(batch, batch.ts, begun, must=False), self._directions(batch, begun)[1]
            shown, _ = self.signals.evaluate(motion, batch.ts, batch.inputs, begun.numbers[batch.rows], numbers_dot)
            self._append_residuals(batch, trial, shown)
            columns = self.columns(self.pieces[batch.rows[0]].record)
            r = found[-1][..., columns] / self.size[: len(self.signals.names)]
            squares = np.sum(batch.weights[..., columns] * r**2, axis=(1, 2))
            left[batch.rows] = np.where(np.isfinite(squares), squares, np.inf)
        return left

    def first_modes(self, rows: np.ndarray) -> np.ndarray | None:
        """The places of the modes in which pieces begin; None where the scene has no modes."""
        if not isinstance(self.scene, Hybrid):
            return None
        return np.array([self.modes[row][0] if self.modes[row] else self.scene.first for row in rows])

    def _directions(self, batch: Samples, trial: _SystemTrial) -> tuple[np.ndarray, np.ndarray]:
        """Directions of starts (N, D, 2n) and parameters (N, D, P). D = 2n + L, L where no start is free, 0 without
        derivatives."""
        if trial.directions is None:
            return np.zeros((len(batch.rows), 0, self.states)), trial.numbers[batch.rows, None][:, :0]
        directions, states = trial.directions[batch.rows], self.states if self.fitted[batch.rows].any() else 0
        y0_dot = np.zeros((len(batch.rows), states + directions.shape[1], self.states))
        y0_dot[:, :states] = np.eye(states, self.states)
        if trial.tangents is not None and states:
            y0_dot[:, :states] = trial.tangents[batch.rows].swapaxes(1, 2)
        y0_dot[:, states:] = trial.starts_dot[batch.rows]
        return y0_dot, np.pad(directions, ((0, 0), (states, 0), (0, 0)))

    def _evaluate_delayed(self, batch: Samples, trial: _SystemTrial) -> tuple[np.ndarray, np.ndarray]:
        """The signals of one trial, of each delay those that have it at earlier times, and their tangents."""
        delays, signals, numbers = self.signals.delays, self.signals, trial.numbers[batch.rows]
        assert delays is not None
        numbers_dot = self._directions(batch, trial)[1]
        values = np.zeros((*batch.ts.shape, len(signals.names)))
        slopes = np.zeros((*values.shape, numbers_dot.shape[1]))
        for delay in delays.evaluate(numbers):
            if (bad := ~((delay.values >= 0.0) & (delay.values <= delays.longest))).any():
                text = "A delay is {:.4g}, but must lie between 0 and the longest one, {:g}."
                row = int(np.argmax(bad))
                raise self.lost(batch.rows[row], text.format(delay.values[row], delays.longest))
            ts = np.maximum(batch.ts - delay.values[:, None], batch.ts[:, :1])
            motion = self._follow(batch, ts, trial)
            inputs, rates = batch.inputs, np.zeros_like(batch.inputs)
            if batch.table is not None and signals.form is not None:
                inputs, rates = map(np.asarray, inputs_at(batch.table, ts, signals.form.hold))
            ts_dot = -np.matmul(numbers_dot, delay.slopes[..., None])[..., 0]
            y, n = motion.path.reshape(-1, self.states), self.layout.size
            tables = constant_tables(ts.ravel(), inputs.reshape(len(y), -1))
            pulled = self.motions.rate(ts.ravel(), y, np.repeat(numbers, ts.shape[1], axis=0), tables)
            rate = np.concatenate([y[:, n:], pulled], axis=1).reshape(motion.path.shape)
            motion = motion._replace(tangents=motion.tangents + ts_dot[:, :, None, None] * rate[:, None])
            some = signals.evaluate(motion, ts, inputs, numbers, numbers_dot, ts_dot, rates)
            values[..., delay.signals], slopes[..., delay.signals, :] = (x[:, :, delay.signals] for x in some)
        return values, slopes

    def _require_finite(self, batch: Samples, values: np.ndarray, by_unknowns: np.ndarray) -> None:
        counted = batch.weights[..., self.columns(self.pieces[batch.rows[0]].record)] > 0
        bad = counted & ~(np.isfinite(values) & np.isfinite(by_unknowns).all(axis=-1))
        if bad.any():
            row, place, signal = np.argwhere(bad)[0]
            sample = self.pieces[batch.rows[row]].places[place]
            raise self.lost(
                batch.rows[row],
                f"What `observe` returns for {self.signals.names[signal]}, or its derivative, is not finite at sample "
                f"{sample}, t = {batch.ts[row, place]:g}.",
            )

    def _evaluate_times(self, clock: Clock, batch: Samples, trial: _SystemTrial):
        """The crossing times (1, M, 1) of a batch of one, and how they move (1, M, 1, D)."""
        y0, numbers = trial.starts[batch.rows[0]], trial.numbers[batch.rows[0]]
        y0_dot, numbers_dot = self._directions(batch, trial)
        times, slopes = map(np.asarray, clock.tangents(y0, numbers, y0_dot[0], numbers_dot[0]))
        if not np.isfinite(times).all():
            raise self.lost(batch.rows[0], clock.describe_failure(y0, numbers))
        if not np.isfinite(slopes).all():
            raise self.lost(batch.rows[0], "The derivatives of its crossing times are not finite.")
        return times[None, :, None], slopes[None, :, None]

    def _append_residuals(self, batch: Samples, trial: Trial, values: np.ndarray) -> None:
        counted, shown = batch.weights > 0, np.zeros(batch.weights.shape)
        shown[..., self.columns(self.pieces[batch.rows[0]].record)] = values
        trial.residuals.append(np.where(counted, wrap_residuals(shown - batch.values, self.frame.periods), 0.0))

    def _append_slopes(self, batch: Samples, trial: Trial, by_unknowns: np.ndarray) -> None:
        counted, columns = batch.weights > 0, self.columns(self.pieces[batch.rows[0]].record)
        states = self.states if self.fitted[batch.rows].any() else 0
        slopes = np.zeros((*counted.shape, self.frame.states + by_unknowns.shape[-1] - states))
        slopes[..., columns, self.frame.states :] = by_unknowns[..., states:]
        fitted = self.fitted[batch.rows, None, None, None]
        slopes[..., columns, :states] = np.where(fitted, by_unknowns[..., :states], 0.0)
        slopes[~counted] = 0.0
        trial.slopes.append(slopes)

    # ---- the same for JAX ----

    def trace_residuals(self, batch: Samples, numbers, starts):
        """The residuals of one batch, (N, T, S), with the parameters (N, P) and the starts (N, 2n) of its pieces; NaN
        where lost."""
        layout, signals, kind = self.layout, self.signals, numbers.dtype
        record = self.pieces[batch.rows[0]].record
        form = signals.form if signals.form is not None and input_functions(self.scene) else None
        scene = self.scene if form is None else form.drive_scene(self.scene)

        def sense(ts, y0, numbers, inputs, table, mode):
            q, qdot = map(layout.restore, halves(y0))
            params = self.restore(numbers)
            own = params if form is None else DrivenParams(params, table)
            limits = {"rtol": self.rtol, "max_steps": step_budget(0 if form is None else table.knots.size)}
            motion = simulate(begin_in(scene, mode), q, qdot, ts, own, **limits, throw=False)
            rows = jax.vmap(lambda q, v: jnp.concatenate([layout.flatten(q), layout.flatten(v)]))(motion.q, motion.qdot)
            return jax.vmap(lambda y, t, i: signals.evaluate_state(y, t, numbers, i))(rows, ts, inputs)

        ts, values, inputs = (jnp.asarray(x, kind) for x in (batch.ts, batch.values, batch.inputs))
        table = jax.tree.map(lambda x: jnp.asarray(x, kind), batch.table)
        if record in self.clocks:
            shown = self.clocks[record].times(starts[0], numbers[0])[None, :, None]
        else:
            shown = jax.vmap(sense)(ts, starts, numbers, inputs, table, self.first_modes(batch.rows))
        shown = jnp.zeros(values.shape, values.dtype).at[..., self.columns(record)].set(shown)
        return jnp.where(batch.weights > 0, wrap_residuals(shown - values, self.frame.periods, jnp), 0.0)

    def trace_starts(self, starts, numbers):
        """The starts (M, 2n) of all systems for JAX, of which some of this one are functions of the parameters (N, P)
        of its pieces."""
        for row, piece, own in zip(self.frame.rows, self.pieces, numbers, strict=True):
            start = self.records[piece.record].begins
            if callable(start) and piece.places[0] == 0:
                flat = jnp.concatenate([self.layout.flatten(half) for half in start_pair(start, self.restore(own))])
                starts = starts.at[row, : self.states].set(flat)
        return starts


class Residuals:
    """The residuals of pieces of the records of one system or several; `u` moves the parameters that they share.

    - `systems`: the residuals of whole records of each. A piece has the number of its record among all, those of the
      first system first. Without `pieces` (N,) and `fitted` (N,), whether the start of a piece is free, the pieces are
      whole records.
    - `parts`: the systems that have pieces. `records`; `states`: the numbers of a start. `unknowns`: those of the N
      pieces.
    - `motions` (R,): of every record the one of the same motion that has the start. `leads` (N,): of every piece that
      which has it, `own_starts` (N,) whether it is its own, and free.
    - `names`, `size`, `least` (S,): signals, their root mean square, and the smallest noise that can be estimated;
      `unit` (S,): the root of their mean weight, by which noise is larger than scatter.
    - `batches`: the samples, with a column for every signal; `weights` (M, S): all of theirs; `measured`: how many.
    - `watch` is called with every trial of `evaluate`.
    """

    def __init__(
        self,
        systems: Sequence[SystemResiduals],
        parameters: Parameters,
        pieces: list[Piece] | None = None,
        fitted: np.ndarray | None = None,
        watch: Callable[[Trial | LostMotion], None] | None = None,
        motions: np.ndarray | None = None,
    ):
        self.systems, self.watch, self.parameters = list(systems), watch, parameters
        self.records = [record for system in systems for record in system.records]
        firsts = np.cumsum([0, *(len(system.records) for system in systems)]).tolist()
        self._records = [slice(*ends) for ends in itertools.pairwise(firsts)]
        if pieces is None or fitted is None:
            pairs = list(zip(firsts, self.systems, strict=False))
            pieces = [piece._replace(record=k + piece.record) for k, system in pairs for piece in system.pieces]
            fitted = np.concatenate([system.fitted for system in systems])
        self.pieces, self.fitted = pieces, fitted
        self.motions = np.arange(len(self.records)) if motions is None else motions
        firsts = {piece.record: row for row, piece in enumerate(pieces) if piece.places[0] == 0}
        owners = [self.motions[piece.record] if piece.places[0] == 0 else -1 for piece in pieces]
        self.leads = np.array([firsts.get(owner, row) for row, owner in enumerate(owners)])
        self.own_starts = fitted & (self.leads == np.arange(len(pieces)))
        self.states = max(system.states for system in systems)
        self.parts = self._split_by_system()
        heads = ["" if part.name is None else f"{part.name}: " for part in self.parts]
        self.names = tuple(head + x for head, part in zip(heads, self.parts, strict=True) for x in part.names)
        self.size = np.concatenate([part.size for part in self.parts])
        self.batches = [b._replace(rows=part.frame.rows[b.rows]) for part in self.parts for b in part.batches]
        self.weights = np.concatenate([b.weights.reshape(-1, len(self.names)) for b in self.batches])
        count = np.maximum((self.weights > 0).sum(axis=0), 1)
        self.unit = np.sqrt(np.where(self.weights.any(axis=0), self.weights.sum(axis=0) / count, 1.0))
        self.least = self.unit * np.concatenate([part.least for part in self.parts])
        self.sensor: Sensor = self.parts[0].frame.sensor
        sides = [b.sides.reshape(-1, len(self.names)) for b in self.batches if b.sides is not None]
        self.sides = np.concatenate(sides) if sides else None
        self.measured = int((self.weights > 0).sum())

    def _split_by_system(self) -> list[SystemResiduals]:
        owner, parts, places = np.array([piece.record for piece in self.pieces]), [], []
        for system, records in zip(self.systems, self._records, strict=True):
            rows = np.flatnonzero((owner >= records.start) & (owner < records.stop))
            if len(rows):
                pieces = [self.pieces[row] for row in rows]
                own = [piece._replace(record=piece.record - records.start) for piece in pieces]
                parts.append(replace(system, pieces=own, fitted=self.fitted[rows]))
                places.append((rows, records))
        firsts = np.cumsum([0, *(len(part.names) for part in parts)]).tolist()
        sensor = Sensor(*(np.concatenate(x) for x in zip(*(part.sensor for part in parts), strict=True)))
        endless = np.full(max(len(part.names) for part in parts), np.inf)  # of crossing times
        periods = [np.append(part.signals.periods, endless)[: len(part.names)] for part in parts]
        return [
            replace(part, frame=SystemFrame(rows, records, first, sensor, np.concatenate(periods), self.states))
            for part, (rows, records), first in zip(parts, places, firsts, strict=False)
        ]

    def with_pieces(self, pieces: list[Piece], fitted: np.ndarray) -> "Residuals":
        """The residuals of other pieces of the records; the signals are those of systems with a piece."""
        return Residuals(self.systems, self.parameters, pieces, fitted, self.watch, self.motions)

    def choose_modes(self, point: Point, noise: np.ndarray) -> "Residuals":
        """The same residuals, whose pieces begin in the likeliest modes; `noise` (N, 2n) is that of the starts."""
        pieces, trial, owners = list(self.pieces), self._trial_at(point), [piece.record for piece in self.pieces]
        numbers = self.parameters.numbers(point.u)
        for part in self.parts:
            rows = part.frame.rows
            own = np.array(owners)[rows]
            modes = part.choose_modes(trial, numbers[self.parameters.places[own]], noise)
            for row, mode in zip(rows, modes, strict=True):
                pieces[row] = pieces[row]._replace(mode=mode)
        pieces = [piece._replace(mode=pieces[lead].mode) for piece, lead in zip(pieces, self.leads, strict=True)]
        return self.with_pieces(pieces, self.fitted)

    def _trial_at(self, point: Point) -> Trial:
        constrained, square = any(part.fits_on_constraints for part in self.parts), (self.states, self.states)
        across = np.zeros((len(point.starts), *square)) if constrained else None
        return Trial(point.u, point.starts[self.leads], [], [], across, [])

    def with_parameters(self, parameters: Parameters) -> "Residuals":
        other = copy.copy(self)
        other.parameters = parameters
        other.__dict__.pop("unknowns", None)
        return other

    @functools.cached_property
    def unknowns(self) -> Unknowns:
        return self.parameters.unknowns.select([piece.record for piece in self.pieces])

    # ---- trials ----

    def evaluate(self, point: Point, slopes: bool = True, begun: Trial | None = None) -> Trial:
        """The residuals at one point. Raises `LostMotion` for the first piece whose motion fails.

        Without `slopes` derivatives are left out where motions cost less so; `begun` is such a trial at this point.
        """
        if begun is not None and begun.slopes:
            return begun
        slopes |= not all(part.motions.splits and not part.clocks for part in self.parts)
        trial = self._trial_at(point)
        numbers, directions = self.parameters.numbers(point.u), self.parameters.directions(point.u) if slopes else None
        watch, owners = self.watch or (lambda _: None), np.array([piece.record for piece in self.pieces])
        known = iter(() if begun is None else begun.solutions)
        try:
            for part in self.parts:
                own = owners[part.frame.rows]
                along = None if directions is None else directions[own]
                part.append_residuals(trial, numbers[self.parameters.places[own]], along, known)
        except LostMotion as reason:
            watch(reason)
            raise
        if begun is None:
            watch(trial)
        return trial

    def select(self, keep: np.ndarray, trial: Trial) -> "tuple[Residuals, Point | Trial]":
        """The residuals of some of the pieces, a mask (N,), and what a trial says of them."""
        kept = [piece for piece, stays in zip(self.pieces, keep, strict=True) if stays]
        part, rows = self.with_pieces(kept, self.fitted[keep]), np.flatnonzero(keep)
        part.watch = None
        if part.names != self.names:
            return part, Point(trial.u, trial.starts[keep])
        places = {row: (b, k) for b, batch in enumerate(self.batches) for k, row in enumerate(batch.rows)}
        found = Trial(trial.u, trial.starts[keep], [], [], None if trial.across is None else trial.across[keep])
        for batch in part.batches:
            for each, some in ((trial.residuals, found.residuals), (trial.slopes, found.slopes)):
                some.append(np.zeros((*batch.ts.shape, *each[0].shape[2:])))
                for own, (b, k) in zip(some[-1], (places[row] for row in rows[batch.rows]), strict=True):
                    count = min(len(own), len(each[b][k]))
                    own[:count] = each[b][k][:count]
        return part, found

    def trace_starts(self, starts, u):
        """The starts (N, 2n) for JAX, where those that are functions of the parameters follow u (F,)."""
        numbers = self._trace_numbers(u)
        for part in self.parts:
            starts = part.trace_starts(starts, numbers[part.frame.rows])
        return starts

    def trace(self, u, starts) -> list:
        """The residuals (N, T, S) of every batch for JAX, at u (F,) and the starts (N, 2n) of all pieces."""
        numbers, found = self._trace_numbers(u), []
        for part in self.parts:
            for batch in part.batches:
                rows = part.frame.rows[batch.rows]
                found.append(part.trace_residuals(batch, numbers[rows], starts[rows, : part.states]))
        return found

    def _trace_numbers(self, u):
        """The parameters (N, P) of the pieces at u (F,) for JAX."""
        places = self.parameters.places[[piece.record for piece in self.pieces]]
        return self.parameters.numbers(u, jnp)[places]

    def noise_scale(self, point: Trial, noise: AbstractNoise) -> NoiseScale:
        return noise.estimate(point.flat(), self.weights, self.least, self.sides)

    def factors(self, point: Trial, noise: NoiseScale) -> list[np.ndarray]:
        """√count/σ of every sample: the factor of its residual in the sum of squares."""
        pairs = zip(point.residuals, self.batches, strict=True)
        return [np.sqrt(sample_counts(noise, r, batch.weights, batch.sides)) / noise.sigma for r, batch in pairs]

    def log_likelihood(self, point: Trial, noise: NoiseScale) -> float:
        return log_likelihood(noise, point.flat(), self.weights, self.sides)

    def fisher_factors(self, point: Trial, noise: NoiseScale) -> list[np.ndarray]:
        """√weight/σ of every sample, times the root of the curvature of what is at the limit of a sensor."""
        return self.factors(point, noise._replace(dof=np.full(len(noise.dof), np.inf)))

    def working_trial(self, point: Trial, noise: NoiseScale) -> Trial:
        """The trial with residuals of which those at the limit of a sensor have the slope of their likelihood."""
        if self.sides is None:
            return point
        found, tiny = [], np.finfo(float).tiny
        for batch, r in zip(self.batches, point.residuals, strict=True):
            unit = noise.sigma / np.sqrt(np.where(batch.weights > 0, batch.weights, 1.0))
            score, curvature = likelihood_slopes(r / unit, batch.sides)
            found.append(np.where(curvature > tiny, unit * score / np.maximum(curvature, tiny), 0.0))
        return point._replace(residuals=found)

    def cost(self, point: Trial, factors: list[np.ndarray], noise: NoiseScale) -> float:
        """Half the weighted sum of squares, and −log of the probability of samples at the limit of a sensor."""
        total = 0.0
        for f, r, batch in zip(factors, point.residuals, self.batches, strict=True):
            each = 0.5 * (f * r) ** 2
            if batch.sides is not None:
                u = batch.sides * np.sqrt(batch.weights) * r / noise.sigma
                each = np.where((batch.sides != 0) & (batch.weights > 0), -log_ndtr(u), each)
            total += float(np.sum(each))
        return total

    def linearise(self, point: Trial, noise: NoiseScale) -> np.ndarray:
        return self.triangles(self.working_trial(point, noise), self.factors(point, noise))

    def triangles(self, point: Trial, factors: list[np.ndarray]) -> np.ndarray:
        """The weighted rows of each piece, compressed: (N, D + 1, D + 1), the residual as last column. Rows of the same
        motion stand with the first of its pieces."""
        columns = point.slopes[0].shape[-1] + 1
        found = np.zeros((len(self.pieces), columns, columns))
        for batch, factor, r, slopes in zip(self.batches, factors, point.residuals, point.slopes, strict=True):
            rows = np.concatenate([slopes, r[..., None]], axis=-1)
            rows *= factor[..., None]
            rows = rows.reshape(len(r), -1, columns)
            if point.across is not None:  # of a size that keeps the condition
                size = np.abs(rows[..., : self.states]).max() or 1.0
                more = np.pad(size * point.across[batch.rows], ((0, 0), (0, 0), (0, columns - self.states)))
                rows = np.concatenate([rows, more], axis=1)
            found[batch.rows] = compress_rows(rows)
        for row in np.flatnonzero(self.leads != np.arange(len(self.pieces))):
            both = found[[self.leads[row], row]].reshape(1, -1, columns)
            found[self.leads[row]], found[row] = compress_rows(both)[0], 0.0
        return found

    # ---- what rounding makes of samples ----

    def exact_values(self, point: Trial, signal: int) -> list[np.ndarray]:
        """The values that a sensor would show without rounding, (N, T) of every batch."""
        pairs = zip(self.batches, point.residuals, strict=True)
        return [batch.values[..., signal] + r[..., signal] for batch, r in pairs]

    def worths(self, point: Trial, noise: NoiseScale, signal: int) -> list[np.ndarray]:
        """The number of independent samples that each sample is worth, (N, T) of every batch; 1 without rounding."""
        found = []
        for batch, exact in zip(self.batches, self.exact_values(point, signal), strict=True):
            found.append(np.zeros(exact.shape))
            for own, x, there in zip(found[-1], exact, batch.weights[..., signal] > 0, strict=True):
                own[there] = sample_worths(x[there], self.sensor.step[signal], float((noise.sigma / self.unit)[signal]))
        return found

    def count_runs_once(self, point: Trial, noise: NoiseScale) -> "Residuals":
        """A copy of the residuals in which samples that share a rounding error together have the weight of one."""
        other, weights = copy.copy(self), [batch.weights.copy() for batch in self.batches]
        for s in np.flatnonzero(np.isfinite(self.sensor.step)).tolist():
            each = self.worths(point, noise, s)
            mean = sum(float(w.sum()) for w in each) / max((self.weights[:, s] > 0).sum(), 1)
            for w, worth in zip(weights, each, strict=True):
                w[..., s] *= worth / mean
        other.batches = [batch._replace(weights=w) for batch, w in zip(self.batches, weights, strict=True)]
        other.weights = np.concatenate([w.reshape(-1, len(self.names)) for w in weights])
        return other

    # ---- pieces, records and systems ----

    @property
    def free_states(self) -> int:
        """The numbers of all starts that are fitted."""
        return sum(part.states * int(self.own_starts[part.frame.rows].sum()) for part in self.parts)

    def columns(self, record: int) -> slice:
        part = self._owner(record)
        return part.columns(record - part.frame.records.start)

    def label(self, record: int) -> str:
        place = next(k for k, own in enumerate(self._records) if record < own.stop)
        return self.systems[place].label(record - self._records[place].start)

    def find_part(self, name: str | None) -> SystemResiduals:
        """One of the systems by its name, or the only one. Raises `ValueError` for a name that there is not."""
        parts = {part.name: part for part in self.parts}
        if name not in parts:
            if None in parts:
                raise ValueError(f"This is a fit of one system without a name: leave system={name!r} out.")
            raise ValueError(f"This is a fit of several systems: give system=, one of {', '.join(map(repr, parts))}.")
        return parts[name]

    def _owner(self, record: int) -> SystemResiduals:
        return next(part for part in self.parts if record < part.frame.records.stop)

    @property
    def first_pieces(self) -> list[int]:
        """The index of the first piece of every record."""
        places = {piece.record: k for k, piece in reversed(list(enumerate(self.pieces)))}
        return [places[k] for k in range(len(self.records))]

    def restore_state(self, record: int, state: np.ndarray) -> tuple:
        """The pair (q, q̇) of a state of a record, of which other systems may leave the last numbers unused."""
        layout = self._owner(record).layout
        return layout.restore(state[: layout.size]), layout.restore(state[layout.size : 2 * layout.size])

    def group_by_system(self, values: Sequence) -> Any:
        """The values of every record as a tuple, or in a dict of tuples by the names of systems."""
        if self.parts[0].name is None:
            return tuple(values)
        return {part.name: tuple(values[part.frame.records]) for part in self.parts}


@one_blas_thread()
def qr_triangle(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(rows, mode="r"))


_BLOCK = 8  # times as many rows as columns in one factorisation


def compress_rows(rows: np.ndarray) -> np.ndarray:
    """The triangles (N, D, D) of N tall matrices (N, M, D), block by block: blocks stay in the cache."""
    pieces, _, columns = rows.shape
    rows = rows if columns else rows[:, :0]
    while rows.shape[1] > columns:
        height = min(_BLOCK * columns, rows.shape[1])
        if missing := -rows.shape[1] % height:
            rows = np.concatenate([rows, np.zeros((pieces, missing, columns))], axis=1)
        rows = qr_triangle(rows.reshape(-1, height, columns)).reshape(pieces, -1, columns)
    found = np.zeros((pieces, columns, columns))
    found[:, : rows.shape[1]] = rows
    return found
