"""`Fit`: what came out of a search, with intervals and in words."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from scipy.special import stdtrit

from lagjax._fit._noise import Known, Widths
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Guess, Piece, Record, in_structure, known_start, require_alike
from lagjax._fit._residuals import Failure, Question
from lagjax._fit._segments import Reader
from lagjax._fit._signals import looks_like_positions
from lagjax._fit._solve import minimise
from lagjax._fit._uncertainty import Information
from lagjax._layout import Layout
from lagjax._simulate import simulate
from lagjax._system import System
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
    """

    trajectory: Trajectory
    values: PyTree
    residuals: PyTree
    start: tuple[PyTree, PyTree]


class Comparison(NamedTuple):
    """Two fits of the same records: for each the log likelihood per effective sample count, AIC and BIC; and a text."""

    log_likelihood: tuple[float, float]
    aic: tuple[float, float]
    bic: tuple[float, float]
    text: str

    def __repr__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """What came out of `fit`. Print it for a table with intervals and a verdict.

    - `params`: the parameters in the user's pytree, the free ones where the measurements are likeliest.
    - `starts`: one (q0, qdot0) per record.
    - `covariance`: of the free numbers, by name (`Covariance`); intervals are made in the transformed numbers.
    - `noise`: the scatter of each signal, by name (`SignalNoise`).
    - `residuals`: per record, what the fit shows less what was measured, in the structure of `values`; NaN if missing.
    - `unseen`: a sentence for everything that the data do not tell about the free parameters.
    - `ok`, `message`: whether the search converged and everything free is seen; what happened, in words.
    - `log_likelihood`, `trials`: of independent samples; how often the motions were computed.
    """

    params: PyTree
    starts: tuple[tuple[PyTree, PyTree], ...]
    covariance: Covariance
    noise: dict[str, SignalNoise]
    residuals: tuple[PyTree, ...]
    unseen: tuple[str, ...]
    ok: bool
    message: str
    log_likelihood: float
    trials: int
    records: tuple[Record, ...]
    parameters: Parameters = field(repr=False)
    u: np.ndarray = field(repr=False)
    information: Information = field(repr=False)
    widths: Widths = field(repr=False)
    question: Question = field(repr=False)
    system: System = field(repr=False)
    observe: Any = field(repr=False)

    def __repr__(self) -> str:
        return _lab_book(self)

    @property
    def rms(self) -> dict[str, float]:
        """The root mean square of the residuals of each signal, in its own unit."""
        matrices = [record_matrix(r, record) for r, record in zip(self.residuals, self.records, strict=True)]
        squares = np.nanmean(np.concatenate(matrices) ** 2, axis=0)
        return dict(zip(self.question.signals.names, np.sqrt(squares).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The ends (low, high) of the intervals that hold each free number with probability `level`, as two pytrees.

        They stay inside of the sets of the transforms; what is not seen reaches to their ends. A parameter that is not
        free stands in both.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        low, high = self._ends(level)
        ends = []
        for values in (low, high):
            numbers = self.parameters.numbers(self.u)
            numbers[self.parameters.places] = values
            ends.append(self.parameters.restore(numbers))
        return ends[0], ends[1]

    def _ends(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        if not (np.ndim(level) == 0 and 0 < level < 1):
            raise ValueError(f"level must be between 0 and 1, as 0.95 is; got {level!r}.")
        dof = max(float(np.sum(self.information.effective)) - len(self.u), 1.0)
        wide = stdtrit(dof, 0.5 + 0.5 * level) * np.sqrt(np.diag(self.information.covariance))
        with np.errstate(over="ignore"):
            return self.parameters.values(self.u - wide), self.parameters.values(self.u + wide)

    def predict(self, record: Record) -> Prediction:
        """The motion of the fitted scene along a record, which may be another one than those of the fit.

        From the record's start if that is known. Else from the start that suits the record's values best, parameters
        kept: to predict from the first samples alone, let `predict` find the start of a short record, and give that to
        a `Record` of the whole.

        Raises `ValueError` where the record has other signals than those of the fit, or its motion fails.
        """
        [record] = require_alike([record])
        if record.structure != self.records[0].structure:
            raise ValueError("The record has other signals than those of the fit.")
        if record.input_structure != self.records[0].input_structure:
            raise ValueError("The record has other inputs than those of the fit.")
        layout, fixed = self.question.layout, _all_fixed(self.parameters, self.u)
        state = known_start(record, layout, 0, self.params)
        is_known = state is not None and not isinstance(record.start, Guess)
        if state is None:
            state = _start_read_off(record, self.observe, layout)
        piece = [Piece(0, np.arange(len(record)))]
        question = Question(
            [record], piece, np.array([not is_known]), self.question.motions, self.question.signals, fixed,
            self.question.size, self.question.rtol,
        )  # fmt: skip
        if is_known:
            point = question.at(np.zeros(0), state[None])
        else:
            done = minimise(question, np.zeros(0), state[None], Known(self.widths), enough=1e-3)
            point = done if isinstance(done, Failure) else done.point
        if isinstance(point, Failure):
            raise ValueError(question.where(point))
        n = layout.size
        start = layout.restore(point.starts[0, :n]), layout.restore(point.starts[0, n:])
        ts = np.asarray(record.ts, layout.dtype)
        q0, qdot0 = (jax.tree.map(lambda x: np.asarray(x, layout.dtype), half) for half in start)
        form, driven = self.question.signals.form, (record.ts, record.input_matrix)
        scene, params = (self.system, self.params) if form is None else form.along(self.system, self.params, *driven)
        trajectory = simulate(scene, q0, qdot0, cast(jax.Array, ts), params)  # NumPy's is as good
        left = np.where(record.weight_matrix > 0, point.residuals[0][0], np.nan)
        values = in_structure(left + record.matrix, record)
        return Prediction(trajectory, values, in_structure(left, record), start)

    def compare(self, other: "Fit") -> Comparison:
        """Which of two fits of the same records the data prefer: by AIC and BIC, with effective counts of samples.

        Raises `ValueError` where the two are not about the same measurements.
        """
        if len(self.records) != len(other.records) or not all(
            np.array_equal(a.matrix, b.matrix, equal_nan=True) for a, b in zip(self.records, other.records, strict=True)
        ):
            raise ValueError("Only fits of the same records can be compared.")
        share = min(_effective_share(self), _effective_share(other))
        logs = share * self.log_likelihood, share * other.log_likelihood
        free = len(self.u) - self.information.null.shape[1], len(other.u) - other.information.null.shape[1]
        count = share * self.question.measured
        aic = tuple(2 * k - 2 * log for k, log in zip(free, logs, strict=True))
        bic = tuple(np.log(count) * k - 2 * log for k, log in zip(free, logs, strict=True))
        better = "this" if bic[0] < bic[1] else "the other"
        rows = [f"{'fit':<8}{'free':>6}{'log likelihood':>18}{'AIC':>14}{'BIC':>14}"]
        for name, *numbers in zip(("this", "other"), free, logs, aic, bic, strict=True):
            rows.append(f"{name:<8}{numbers[0]:>6}{numbers[1]:>18.2f}{numbers[2]:>14.2f}{numbers[3]:>14.2f}")
        margin = abs(bic[0] - bic[1])
        rows.append(f"The data prefer {better} fit, by {margin:.1f} in BIC ({count:.0f} effective samples).")
        return Comparison(logs, aic, bic, "\n".join(rows))


def _effective_share(fit: Fit) -> float:
    samples = sum(noise.samples for noise in fit.noise.values())
    return sum(noise.effective for noise in fit.noise.values()) / samples


def _all_fixed(parameters: Parameters, u: np.ndarray) -> Parameters:
    """The parameters at u, with none free."""
    none = np.zeros(0, int)
    return replace(parameters, first=parameters.numbers(u), places=none, names=(), transforms=())


def _start_read_off(record: Record, observe, layout: Layout) -> np.ndarray:
    """The first state of a record from local polynomials. Raises where its signals are no positions."""
    if not looks_like_positions(observe, record, layout):
        raise ValueError("This record needs a start: give start=(q0, qdot0), or lagjax.Guess(q0, qdot0) to fit it.")
    return Reader.of(record).states(np.array([0]))[0]


def record_matrix(values: PyTree, record: Record) -> np.ndarray:
    """Signals in the structure of a record's values, side by side (T, S)."""
    return np.concatenate([np.reshape(leaf, (len(record), -1)) for leaf in jax.tree.leaves(values)], axis=1)


# ---- in words --------------------------------------------------------------------------------------------------------


def _lab_book(fit: Fit) -> str:
    """The table of parameters, the noise of the signals, what is not seen, and the verdict."""
    samples = sum(noise.samples for noise in fit.noise.values())
    spans = [record.ts[-1] - record.ts[0] for record in fit.records]
    plural = "s" if len(fit.records) > 1 else ""
    of_records = f"{len(fit.records)} record{plural}, {sum(spans):g} long, {samples} values"
    lines = [
        f"Fit of {len(fit.u)} parameter{'s' * (len(fit.u) != 1)} to {of_records}",
        "",
        *_table_of_parameters(fit),
        "",
        *_table_of_noise(fit),
        "",
    ]
    lines += [f"not seen    {sentence}" for sentence in fit.unseen]
    lines.append(f"verdict     {fit.message}")
    return "\n".join(lines)


def _table_of_parameters(fit: Fit) -> list[str]:
    low, high = fit._ends(0.95)
    values = fit.parameters.values(fit.u)
    width = max(len(name) for name in (*fit.parameters.names, "parameter"))
    rows = [f"{'parameter':<{width}}  {'value':>12}  {'95 % interval':>27}  relative"]
    for name, x, a, b in zip(fit.parameters.names, values, low, high, strict=True):
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
