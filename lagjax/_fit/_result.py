"""`Fit`: what came out of a search, with intervals and in words."""

import functools
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from scipy.special import ndtri, stdtrit

from lagjax._doubles import with_doubles
from lagjax._fit._density import Density
from lagjax._fit._descent import minimise
from lagjax._fit._noise import AbstractNoise, Known, Widths
from lagjax._fit._parameters import Parameters
from lagjax._fit._profile import Comparison, Profile, comparison, effective_share, profile
from lagjax._fit._records import Guess, Record, in_structure, known_start, require_alike, require_held
from lagjax._fit._report import Drawn, draw_record, page, pictures_of
from lagjax._fit._residuals import Failure, Point, Residuals, SystemPart, SystemResiduals
from lagjax._fit._sample import draw, inference_data
from lagjax._fit._search import Waterfall, reader_of
from lagjax._fit._sensors import UNCLEAR, looks_like_positions, on_circle
from lagjax._fit._uncertainty import Experiments, Information, deviations, of_starts, ranked, start_alone
from lagjax._hybrid import follow
from lagjax._notebook import cell
from lagjax._tables import intervals
from lagjax._trajectory import Trajectory

PyTree = Any


class Covariance(NamedTuple):
    """The covariance (F, F) of the free numbers, and what they are called: `covariance["params['m']", "params['l']"]`.

    Infinite on the diagonal, and NaN beside it, for what the data do not see.
    """

    names: tuple[str, ...]
    matrix: np.ndarray

    def __getitem__(self, pair):
        """The covariance of two numbers by their names."""
        if not (isinstance(pair, tuple) and len(pair) == 2 and all(name in self.names for name in pair)):
            raise KeyError(f"Ask for two of {', '.join(self.names)}; got {pair!r}.")
        return float(self.matrix[self.names.index(pair[0]), self.names.index(pair[1])])


class SignalNoise(NamedTuple):
    """The scatter of one signal: σ, ν of Student's t, samples, how many independent ones, Durbin and Watson's number.

    `durbin_watson` is 2 for white residuals and near 0 where neighbours agree.
    """

    sigma: float
    dof: float
    samples: int
    effective: float
    durbin_watson: float


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
    widths: Widths

    def bands(self, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """(low, high) between which a new sample of weight one falls with probability `level`, noise included.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        _require_level(level)
        columns = iter(range(len(self.widths.sigma)))
        half = jax.tree.map(lambda leaf: _half_widths(leaf, self.widths, level, columns), self.deviation)
        return jax.tree.map(np.subtract, self.values, half), jax.tree.map(np.add, self.values, half)


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """The result of `fit`. Print it for a table with intervals and a verdict.

    - `params`: the parameters in the user's pytree; the free ones are those of maximum likelihood.
    - `starts`: one (q0, qdot0) per record. For several systems `starts` and `residuals` are dicts by their names.
    - `covariance`: of the free numbers, by name (`Covariance`). Intervals are computed in the transformed numbers.
    - `noise`: the scatter of each signal, by name (`SignalNoise`).
    - `residuals`: fitted minus measured values per record, in the structure of `values`; NaN where a sample is missing.
    - `unseen`: a sentence for each free parameter or combination of them that the data do not determine, and one for
      those of which rounding hides what a chaotic record says.
    - `ok`: whether the search converged, the data determine everything that is free, the fit leaves less than some 30 %
      of every signal beyond white noise, and the records agree; `message`: what happened.
    - `log_likelihood`: as if all samples were independent; `trials`: how often the motions were computed.
    - `waterfall`: where the search from each of several starts ended (`Waterfall`); None for a single start.
    """

    params: PyTree
    starts: Any
    covariance: Covariance
    noise: dict[str, SignalNoise]
    residuals: Any
    unseen: tuple[str, ...]
    ok: bool
    message: str
    log_likelihood: float
    trials: int
    waterfall: Waterfall | None
    records: tuple[Any, ...]
    parameters: Parameters = field(repr=False)
    u: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    law: AbstractNoise = field(repr=False)
    information: Information = field(repr=False)
    widths: Widths = field(repr=False)
    question: Residuals = field(repr=False)
    system: Any = field(repr=False)
    observe: Any = field(repr=False)

    def __repr__(self) -> str:
        return _lab_book(self)

    @with_doubles
    def _repr_html_(self) -> str | None:
        """The lab book, and data over fit of the first record, for notebooks; None where nothing can be drawn."""
        return cell(repr(self), self._draw_first, (5.2, 2.8))

    def _draw_first(self, figure) -> None:
        drawn = next(one for one in map(self._drawn, self.question.parts) if one.records)
        axes = figure.subplots(2, min(2, len(drawn.names)), squeeze=False, gridspec_kw={"height_ratios": [2, 1]})
        draw_record(axes, drawn.records[0], drawn.residuals[0], drawn.names[:2], drawn.sigma)

    def to_pandas(self, level: float = 0.95):
        """A `pandas.DataFrame` with a row per free number, by its name: value, and low and high of its interval.

        The interval contains the number with probability `level`; where the data do not determine the number, the
        interval is all of its set.

        Raises `ImportError` when pandas is not installed, `ValueError` for a level that is not between 0 and 1.
        """
        return intervals(self.parameters.names, self.parameters.values(self.u), *self._ends(level))

    @property
    def rms(self) -> dict[str, float]:
        """The root mean square of the residuals of each signal, in its own unit."""
        squares, count = np.zeros((2, len(self.question.names)))
        each = self.question.end_to_end(self.residuals)
        for k, (residuals, record) in enumerate(zip(each, self.records, strict=True)):
            matrix, columns = record_matrix(residuals, record), self.question.columns(k)
            squares[columns] += np.nansum(matrix**2, axis=0)
            count[columns] += np.isfinite(matrix).sum(axis=0)
        return dict(zip(self.question.names, np.sqrt(squares / count).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The ends (low, high) of the intervals that hold each free number with probability `level`, as two pytrees.

        They stay inside the sets of the transforms, relative to the bounds; one that does not exclude a bound is that
        of the number itself, and ends at the bound. The interval of a parameter that the data do not determine is the
        whole set. A parameter that is not free is both ends of its own interval.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        low, high = self._ends(level)
        ends = []
        for values in (low, high):
            numbers = self.parameters.numbers(self.u)
            numbers[self.parameters.places] = values
            ends.append(self.parameters.restore(numbers))
        return ends[0], ends[1]

    @with_doubles
    def start_intervals(self, level: float = 0.95) -> tuple[Any, Any]:
        """The ends (low, high) of the intervals of the starts, each in the structure of `starts`.

        Each contains its number with probability `level`; the uncertainty of the parameters is included. A start that
        is known is both ends of its own interval.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        wide = self._quantile(level) * np.sqrt(
            np.diagonal(
                of_starts(self.question, self._point, self.widths, self.information).covariance, axis1=1, axis2=2
            )
        )
        ends = (enumerate((self.states + s * wide)[self.question.firsts]) for s in (-1, 1))
        low, high = (self.question.by_system([self.question.restored(k, y) for k, y in end]) for end in ends)
        return low, high

    @with_doubles
    def profile(self, name: str, level: float = 0.95) -> Profile:
        """The profile likelihood of the parameter called `name`: "params['dry']", or "dry" where that is the only one.

        It says how much likelihood is lost where the parameter is kept at another value and all other free parameters
        and starts are fitted anew. The interval is read off the profile itself, with the effective number of samples
        that `intervals` uses. Printed, the result gives its verdict: bounded, one-sided, flat, or two minima.

        Raises `ValueError` for a name that no free parameter has, or that moves only together with others.

        Source: Venzon & Moolgavkar, Applied Statistics 37 (1988) 87; Raue et al., Bioinformatics 25 (2009) 1923.
        """
        _require_level(level)
        return profile(self.question, self.u, self.states, self.widths, self.information, name, level)

    def log_density(self, prior: Callable | None = None) -> Density:
        """The logarithm of the posterior density of all unknowns: a function of one vector for `jax.jit`, `jax.grad`.

        The prior is flat in the free parameters within their sets, in the starts and in log σ, unless `prior(params)`
        returns the logarithm of another prior density of the parameters. Correlated samples count by their effective
        number. On the function, `first` is the vector of the fit, `names` names its numbers, `covariance()` is that of
        least squares, and `params(u)` turns the first numbers into the user's pytree.
        """
        shares = np.array([noise.effective / noise.samples for noise in self.noise.values()])
        return Density(self.question, self.law, self._point, self.widths, shares, prior)

    @with_doubles
    def sample(self, draws: int = 1000, seed: int = 0, *, chains: int = 4, prior: Callable | None = None) -> Any:
        """Draws of the posterior by the No-U-Turn sampler, `draws` of each chain, as `arviz.InferenceData`.

        The density is that of `log_density(prior)`, π. The sampler walks in the fit's own metric along π*, the density
        whose residuals are expanded to second order about the fit, r(0) + J z + ½ zᵀ H z; then one motion of each chain
        accepts or refuses the draw, with min(1, π(y) π*(x) / [π(x) π*(y)]), so that draws are those of π. Where the
        expansion is too far from π, the sampler follows π itself, with gradients through the motions. Beside a bound of
        `positive` or `between` both are functions of the number itself, not of its logarithm; the density is the same.

        `attrs` of the result says which of the two it was ("sampler"), how many independent draws those of the worst
        number are worth ("effective_draws"), and the largest r-hat of chains ("r_hat"). A warning tells of fewer than
        100, which intervals cannot be read off, and of an r-hat above 1.05.

        All chains are integrated as one batch of motions: many chains with few draws are cheaper than few with many.
        The variables are the free parameters by their names, `q0` and `qdot0` of the records whose starts are fitted
        (`a: q0` where the fit is of several systems), and `sigma`, `dof` of the signals.

        Source: Hoffman & Gelman, JMLR 15 (2014) 1593; Christen & Fox, J. Comput. Graph. Stat. 14 (2005) 795.

        Raises `ImportError` without blackjax and arviz, and `ValueError` where something free is not seen.
        """
        for name, count in (("draws", draws), ("chains", chains)):
            if not (isinstance(count, int | np.integer) and count > 0):
                raise ValueError(f"{name} must be a positive whole number; got {count!r}.")
        if self.unseen:
            raise ValueError(f"There is no density of what is not seen. {self.unseen[0]}")
        density = self.log_density(prior)
        return inference_data(density, draw(density, draws, chains, seed))

    @functools.cached_property
    def _point(self) -> Point:
        """The trial that the search ended at, computed anew."""
        point = self.question.evaluate(self.u, self.states)
        assert isinstance(point, Point)  # it was computed before
        return point

    def _part(self, system: str | None) -> SystemPart:
        """One of the systems by its name, or the only one. Raises `ValueError` for a name that there is not."""
        parts = {part.name: part for part in self.question.parts}
        if system not in parts:
            if None in parts:
                raise ValueError(f"This is a fit of one system without a name: leave system={system!r} out.")
            raise ValueError(f"This is a fit of several systems: give system=, one of {', '.join(map(repr, parts))}.")
        return parts[system]

    def _of_sensors(self, part: SystemPart) -> Widths:
        """The noise of the signals of a system's records, without that of crossing times."""
        sensors = slice(part.signals.start, part.signals.start + len(part.system.signals.names))
        return Widths(self.widths.sigma[sensors], self.widths.dof[sensors])

    def _quantile(self, level: float) -> float:
        """Student's t of a level, for the effective number of samples less that of parameters."""
        _require_level(level)
        dof = max(float(np.sum(self.information.effective)) - len(self.u), 1.0)
        return float(stdtrit(dof, 0.5 + 0.5 * level))

    def _ends(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        wide = self._quantile(level) * np.sqrt(np.diag(self.covariance.matrix))
        return self.parameters.ends(self.u, wide)

    @with_doubles
    def predict(self, record: Record, *, system: str | None = None) -> Prediction:
        """The motion of the fitted scene over a record, which need not be one of those that were fitted.

        It begins at the record's start if that is known, else at the start that fits the record's values best with the
        parameters kept. To predict from the first samples alone, let `predict` find the start of a short record, and
        give that start to a `Record` of the whole. `system` is the name of the record's system, for a fit of several
        systems.

        Raises `ValueError` where the record has other signals than those of the fit, or its motion fails.
        """
        [record], part = require_alike([record]), self._part(system)
        about = part.system
        first = next((one for one in about.records if isinstance(one, Record)), None)
        if not isinstance(record, Record) or first is None:
            raise TypeError("Only a lagjax.Record is predicted, after a fit of some: for times ask lagjax.crossings.")
        if record.structure != first.structure:
            raise ValueError("The record has other signals than those of the fit.")
        if record.input_structure != first.input_structure:
            raise ValueError("The record has other inputs than those of the fit.")
        if about.signals.form is not None:
            require_held(record, about.signals.form.hold, "the record")
        layout, fixed = about.layout, self.parameters.kept(self.u)
        state = known_start(record, layout, 0, self.params)
        is_known = state is not None and not isinstance(record.start, Guess)
        if state is None:
            state = _start_read_off(record, self._by_name(self.observe, part), about, self.parameters.numbers(self.u))
        question = Residuals([about.of_records([record], np.array([not is_known]), fixed, about.manifold)])
        if is_known:
            point = question.evaluate(np.zeros(0), state[None])
        else:
            done = minimise(question, np.zeros(0), state[None], Known(self._of_sensors(part)), enough=1e-3)
            point = done if isinstance(done, Failure) else done.point
        if isinstance(point, Failure):
            raise ValueError(question.where(point))
        n = layout.size
        start = layout.restore(point.starts[0, :n]), layout.restore(point.starts[0, n:])
        ts = np.asarray(record.ts, layout.dtype)
        q0, qdot0 = (jax.tree.map(lambda x: np.asarray(x, layout.dtype), half) for half in start)
        form, driven = about.signals.form, (record.sampled_at, record.input_samples)
        scene, params = about.scene, self.params
        scene, params = (scene, params) if form is None else form.along(scene, params, *driven)
        trajectory = follow(scene, q0, qdot0, cast(jax.Array, ts), params)  # NumPy's is as good
        values, deviation = self._shown(part, record, question, point)
        left = on_circle(values - record.matrix, about.signals.periods)
        left = np.where(record.weight_matrix > 0, left, np.nan)
        noise = self._of_sensors(part)
        noise = noise._replace(sigma=noise.sigma * np.sqrt(self.information.lost))
        shown, missed, uncertain = (in_structure(matrix, record) for matrix in (values, left, deviation))
        return Prediction(trajectory, shown, missed, start, uncertain, noise)

    def _shown(self, part: SystemPart, record: Record, question: Residuals, point: Point):
        """The signals (T, S) of a record that was followed, at all its times, and their standard deviations."""
        planned, slopes = self._followed(part.system, record, point.starts[0])
        known, states = self.information, question.states
        own, follows = np.zeros((states, states)), np.zeros((states, len(self.u)))
        if question.fitted[0]:
            rows = np.sqrt(record.weight_matrix)[..., None] / self._of_sensors(part).sigma[:, None] * slopes
            own, follows = start_alone(rows, states, known, effective_share(self))
        return planned.matrix, deviations(slopes, states, own, follows, known)

    def _followed(self, of: SystemResiduals, record: Record, state: np.ndarray) -> tuple[Record, np.ndarray]:
        """A record with what sensors would show for its values, from a state (2n,), and their derivatives (T, S, D)."""
        everywhere = replace(record, values=in_structure(np.zeros_like(record.matrix), record), weights=None)
        about = Residuals([of.of_records([everywhere], np.array([True]), self.parameters)])
        full = about.evaluate(self.u, state[None])
        if isinstance(full, Failure):
            raise ValueError(about.where(full))
        shown = np.where(about.batches[0].weights[0] > 0, full.residuals[0][0], np.nan)  # NaN before a delay is over
        return replace(record, values=in_structure(shown, record)), full.slopes[0][0]

    @with_doubles
    def next_experiment(
        self, candidates: Sequence[Record] | dict[str, Record], *, system: str | None = None
    ) -> Experiments:
        """Which of several planned records would tell most about the free parameters: D-optimal design.

        Each is rated by the gain in log det of the information. `candidates`: records, or a dict of them by name, with
        times, weights, inputs and a start as they are planned. Their values are not read and may be NaN. A start
        `lagjax.Guess(q0, qdot0)` counts as one that has to be fitted. For a fit of several systems, `system` is the
        name of the system of all candidates. Printed, the result is a table.

        Raises `ValueError` where a planned record has no start, or its motion fails.

        Source: Atkinson, Donev & Tobias, *Optimum Experimental Designs* (2007).
        """
        named = candidates if isinstance(candidates, dict) else {f"[{k}]": one for k, one in enumerate(candidates)}
        if not named:
            raise ValueError("candidates is empty: give at least one lagjax.Record.")
        rows = [self._rows_of(self._part(system), name, record) for name, record in named.items()]
        return ranked(list(named), rows, self.parameters.labels, self.information)

    def _rows_of(self, part: SystemPart, name: str, record: Record) -> np.ndarray:
        """The rows (M, F) of a planned record in units of the noise, its start eliminated where it is not known."""
        if not isinstance(record, Record) or record.start is None:
            raise ValueError(
                f"The planned record {name} needs a start: (q0, qdot0), or lagjax.Guess(q0, qdot0) if that is to be "
                "fitted."
            )
        state = known_start(record, part.system.layout, 0, self.params)
        assert state is not None
        planned, slopes = self._followed(part.system, record, state)
        sigma = self._of_sensors(part).sigma[:, None]
        weights = planned.weight_matrix[..., None] * (effective_share(self) / sigma**2)
        rows, states = np.sqrt(weights) * slopes, part.system.states
        own = rows[..., states:]
        if isinstance(record.start, Guess):
            own = own - rows[..., :states] @ start_alone(rows, states, self.information, 1.0)[1]
        return own.reshape(-1, own.shape[-1])

    @with_doubles
    def report(self, path: str | os.PathLike, experiments: Sequence[Record] | dict[str, Record] = ()) -> None:
        """Write one file of HTML: parameters, noise, what is not seen, data over fit, residuals, correlations, starts.

        With `experiments`, a set of planned records, it also says what to measure next (`next_experiment`). It needs
        matplotlib.
        """
        tables = {"Parameters": _cells_of_parameters(self), "Noise": _cells_of_noise(self)}
        texts = {"What to measure next": str(self.next_experiment(experiments))} if experiments else {}
        pictures = pictures_of([self._drawn(part) for part in self.question.parts], self.covariance, self.waterfall)
        text = page(_title(self), self.message, self.ok, self.unseen, tables, pictures, texts)
        with open(path, "w", encoding="utf-8") as file:
            file.write(text)

    def _drawn(self, part: SystemPart) -> Drawn:
        """The records of one system with their residuals."""
        residuals = self.question.end_to_end(self.residuals)[part.records]
        pairs = [pair for pair in zip(residuals, part.system.records, strict=True) if isinstance(pair[1], Record)]
        records, matrices = [record for _, record in pairs], [record_matrix(r, record) for r, record in pairs]
        return Drawn(part.name, records, matrices, part.system.signals.names, self._of_sensors(part).sigma)

    @staticmethod
    def _by_name(of_all, part: SystemPart) -> Any:
        """The part for one system: by its name, or for all."""
        return of_all[part.name] if isinstance(of_all, dict) else of_all

    @with_doubles
    def compare(self, other: "Fit | dict[str, Fit]", *, folds: int = 0) -> Comparison:
        """Which of several fits of the same records the data prefer: this one against another, or a dict of others.

        The fits are compared by AIC and BIC with effective numbers of samples, and with `folds` also by
        cross-validation: the records are divided into that many groups, each group is left out in turn, and is
        predicted with the parameters that the other groups give; only its starts are fitted to it. Printed, the result
        is a table; in that of a dict this fit is called "this".

        Raises `ValueError` where the fits are not about the same measurements, or folds are not 0 or 2 to the number of
        records.
        """
        others = other if isinstance(other, dict) else {"the other": other}
        return comparison({"this": self, **others}, folds)


def _require_level(level) -> None:
    if not (np.ndim(level) == 0 and 0 < level < 1):
        raise ValueError(f"level must be between 0 and 1, as 0.95 is; got {level!r}.")


def _half_widths(deviation: np.ndarray, widths: Widths, level: float, columns) -> np.ndarray:
    """Half of the band of one leaf of signals, whose places among all signals are the next of `columns`."""
    flat = deviation.reshape(len(deviation), -1)
    own = [next(columns) for _ in range(flat.shape[1])]
    noise = widths.sigma[own] * stdtrit(np.minimum(widths.dof[own], 1e9), 0.5 + 0.5 * level)
    return np.sqrt((ndtri(0.5 + 0.5 * level) * flat) ** 2 + noise**2).reshape(deviation.shape)


def _start_read_off(record: Record, observe, about: SystemResiduals, numbers: np.ndarray) -> np.ndarray:
    """The first state of a record from local polynomials. Raises where its signals are no positions."""
    reader = reader_of(record, observe, about, numbers)
    if reader is not None:
        return reader.states(np.array([0]))[0]
    if looks_like_positions(observe, record, about.layout):
        raise ValueError(UNCLEAR.format("This record"))
    raise ValueError("This record needs a start: give start=(q0, qdot0), or lagjax.Guess(q0, qdot0) to fit it.")


def record_matrix(values: PyTree, record) -> np.ndarray:
    """Signals in the structure of a record's values, side by side (T, S); times end to end (M, 1)."""
    if not isinstance(record, Record):
        return record.columns(values)
    return np.concatenate([np.reshape(leaf, (len(record), -1)) for leaf in jax.tree.leaves(values)], axis=1)


_LISTED = 8  # numbers of one array that a table lists; of more it says how many there are

# ---- in words --------------------------------------------------------------------------------------------------------


def _lab_book(fit: Fit) -> str:
    """The table of parameters, the noise of the signals, what is not seen, and the verdict."""
    lines = [
        _title(fit),
        "",
        *_table_of_parameters(fit),
        "",
        *_table_of_noise(fit),
        "",
    ]
    lines += [f"not seen    {sentence}" for sentence in fit.unseen]
    if fit.waterfall is not None:
        lines.append(f"starts      {fit.waterfall}")
    lines.append(f"verdict     {fit.message}")
    return "\n".join(lines)


def _title(fit: Fit) -> str:
    samples = sum(noise.samples for noise in fit.noise.values())
    spans = [record.ts[-1] - record.ts[0] for record in fit.records]
    plural = "s" if len(fit.records) > 1 else ""
    of_records = f"{len(fit.records)} record{plural}, {sum(spans):g} long, {samples} values"
    return f"Fit of {len(fit.u)} parameter{'s' * (len(fit.u) != 1)} to {of_records}"


def _cells_of_parameters(fit: Fit) -> list[list[str]]:
    low, high = fit._ends(0.95)
    rows = [["parameter", "value", "from", "to (95 %)", "± relative"]]
    for name, x, a, b in zip(fit.parameters.names, fit.parameters.values(fit.u), low, high, strict=True):
        half = 50 * (b - a) / abs(x) if x else np.inf
        rows.append([name, f"{x:.6g}", f"{a:.6g}", f"{b:.6g}", f"{half:.2g} %" if np.isfinite(half) else "not seen"])
    return rows


def _cells_of_noise(fit: Fit) -> list[list[str]]:
    rows = [["signal", "RMS", "σ", "ν", "samples", "effective", "Durbin–Watson"]]
    for (name, noise), rms in zip(fit.noise.items(), fit.rms.values(), strict=True):
        numbers = f"{rms:.3g}", f"{noise.sigma:.3g}", f"{noise.dof:.3g}", f"{noise.samples}", f"{noise.effective:.0f}"
        rows.append([name, *numbers, f"{noise.durbin_watson:.2f}"])
    return rows


def _table_of_parameters(fit: Fit) -> list[str]:
    if not fit.parameters.names:
        return ["All parameters are kept: starts and noise were fitted."]
    low, high = fit._ends(0.95)
    values = fit.parameters.values(fit.u)
    width = max(len(name) for name in (*fit.parameters.names, "parameter"))
    rows = [f"{'parameter':<{width}}  {'value':>12}  {'95 % interval':>27}  relative"]
    owners = [part.label for part in fit.parameters.parts for _ in part.places]
    many = {label: count for label, count in Counter(owners).items() if count > _LISTED}
    for label, count in many.items():
        rows.append(f"{label:<{width}}  {f'{count} numbers':>12}")
    for owner, name, x, a, b in zip(owners, fit.parameters.names, values, low, high, strict=True):
        if owner in many:
            continue
        relative = 100 * (b - a) / 2 / abs(x) if x else np.inf
        shown = f"± {relative:.2g} %" if np.isfinite(relative) else "not seen"
        rows.append(f"{name:<{width}}  {x:>12.6g}  {a:>12.6g} … {b:>12.6g}  {shown}")
    return rows


def _table_of_noise(fit: Fit) -> list[str]:
    width = max(len(name) for name in (*fit.noise, "signal"))
    has_tails = any(np.isfinite(noise.dof) for noise in fit.noise.values())
    tails = "         ν" if has_tails else ""
    head = f"{'signal':<{width}}  {'RMS':>10}  {'noise σ':>10}{tails}"
    rows = [f"{head}  {'samples':>8}  {'effective':>9}  Durbin–Watson"]
    for (name, noise), rms in zip(fit.noise.items(), fit.rms.values(), strict=True):
        tail = f"{noise.dof:>10.3g}" if has_tails else ""
        rows.append(
            f"{name:<{width}}  {rms:>10.3g}  {noise.sigma:>10.3g}{tail}  {noise.samples:>8}  {noise.effective:>9.0f}  "
            f"{noise.durbin_watson:.2f}"
        )
    return rows
