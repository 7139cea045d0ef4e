"""`Fit`: the result of a search, with intervals, profiles, predictions, comparison and a report.

It holds the nouns `Covariance` and `SignalNoise`; every method hands over to the file of its subject.
"""

import functools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._fit.model._density import Density
from lagjax._fit.model._noise import AbstractNoise, NoiseScale
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._records import Record, restore_structure
from lagjax._fit.model._residuals import Point, Residuals, Trial
from lagjax._fit.result._comparison import Comparison, comparison
from lagjax._fit.result._experiments import Experiments, rank_experiments
from lagjax._fit.result._identifiability import sentence_on_rest, unseen_sentences
from lagjax._fit.result._information import LEVEL, Information, deviations, information
from lagjax._fit.result._prediction import Prediction, planned_rows, predict_record
from lagjax._fit.result._profile import Profile, profile
from lagjax._fit.result._report import draw_record, lab_book, recordings, render_page
from lagjax._fit.result._selection import Selection
from lagjax._fit.result._verdict import verdict
from lagjax._fit.search._descent import Descent
from lagjax._fit.search._multistart import Waterfall
from lagjax._fit.search._unexplained import Unexplained, measure_unexplained
from lagjax._primitives import with_doubles
from lagjax._show import html_cell, import_package


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


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """The result of `fit`. Print it for a table with intervals and a verdict.

    - `params`: the parameters in the user's pytree; the free ones are those of maximum likelihood. One that is
      `lagjax.per_record` is an array with the records as first axis.
    - `starts`: one (q0, qdot0) per record. For several systems `starts` and `residuals` are dicts by their names.
    - `covariance`: of the free numbers, by name (`Covariance`).
    - `noise`: the scatter of each signal, by name (`SignalNoise`).
    - `residuals`: fitted minus measured values per record, in the structure of `values`; NaN where a sample is missing.
      `rms`: their root mean square, by signal, in its own unit.
    - `unseen`: a sentence for each free parameter or combination of them that the data do not determine, and one for
      those of which rounding hides what a chaotic record says.
    - `ok`: whether the search converged, the data determine everything that is free, the fit leaves less than some 30 %
      of every signal beyond white noise, the motion is more than noise gives, and the records agree; with contacts or
      modes, also whether it leaves no motion of more than some 5 %. `message`: what happened.
    - `log_likelihood`: as if all samples were independent; `trials`: how often the motions were computed.
    - `waterfall`: where the search from each of several starts ended (`Waterfall`); None for a single start.
    - `selection`: the fits by which candidate terms were chosen (`Selection`); None without `lagjax.terms`.
    """

    params: PyTree
    starts: Any
    covariance: Covariance
    noise: dict[str, SignalNoise]
    residuals: Any
    rms: dict[str, float]
    unseen: tuple[str, ...]
    ok: bool
    message: str
    log_likelihood: float
    trials: int
    waterfall: Waterfall | None
    selection: Selection | None
    records: tuple[Any, ...]
    parameters: Parameters = field(repr=False)
    u: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    law: AbstractNoise = field(repr=False)
    information: Information = field(repr=False)
    noise_scale: NoiseScale = field(repr=False)
    residual_function: Residuals = field(repr=False)
    residual_matrices: list[np.ndarray] = field(repr=False)  # of every record, (T, S)

    @classmethod
    def from_descent(
        cls, descent: Descent, law: AbstractNoise, waterfall: Waterfall | None, selection: Selection | None = None
    ) -> tuple["Fit", Unexplained]:
        residuals, trial, noise = descent.residuals, descent.trial, descent.noise
        parameters, known = residuals.parameters, information(descent)
        left = measure_unexplained(descent)
        rest = () if left.motion else sentence_on_rest(descent, known, law)
        unseen, left = (*unseen_sentences(descent, known), *rest), left._replace(noise=[*left.noise, *rest])
        starts = 1 if waterfall is None else len(waterfall.misfits)
        ok, message = verdict(descent, unseen, known, left, law, starts)
        ok = ok and not (selection and selection.alike)
        starts = [residuals.restore_state(k, trial.starts[row]) for k, row in enumerate(residuals.first_pieces)]
        matrices, measured = _record_residuals(residuals, trial), residuals.weights > 0
        samples, squares = measured.sum(axis=0), (trial.flat() ** 2).sum(axis=0, where=measured)
        columns = noise.sigma, noise.dof, samples, known.effective, 2 * (1 - known.correlation)
        signals = [SignalNoise(*(x.item() for x in one)) for one in zip(*columns, strict=True)]
        fit = cls(
            params=parameters.restore_records(parameters.numbers(trial.u)), starts=residuals.group_by_system(starts),
            covariance=Covariance(parameters.names, parameters.covariance(trial.u, known.covariance)),
            noise=dict(zip(residuals.names, signals, strict=True)),
            residuals=residuals.group_by_system(list(map(restore_structure, matrices, residuals.records))),
            rms=dict(zip(residuals.names, np.sqrt(squares / samples).tolist(), strict=True)),
            unseen=unseen, ok=ok, message=message, log_likelihood=residuals.log_likelihood(trial, noise),
            trials=descent.trials, waterfall=waterfall, selection=selection, records=tuple(residuals.records),
            parameters=parameters, u=trial.u, states=trial.starts, law=law, information=known, noise_scale=noise,
            residual_function=residuals, residual_matrices=matrices,
        )  # fmt: skip
        return fit, left

    def __repr__(self) -> str:
        return lab_book(self)

    @with_doubles
    def _repr_html_(self) -> str | None:
        """The lab book, and data over fit of the first record, for notebooks; None where nothing can be drawn."""
        return html_cell(repr(self), self._draw_first, (5.2, 2.8))

    def _draw_first(self, figure) -> None:
        parts = self.residual_function.parts
        part, pairs = next((part, pairs) for part in parts if (pairs := recordings(self, part)))
        draw_record(figure, *pairs[0], part.signals.names[:2], part.sensor_noise(self.noise_scale).sigma)

    def to_pandas(self, level: float = LEVEL):
        """A `pandas.DataFrame` with a row per free number, by its name: value, and low and high of its interval.

        The interval contains the number with probability `level`; where the data do not determine the number, the
        interval is all of its set.

        Raises `ImportError` when pandas is not installed, `ValueError` for a level that is not between 0 and 1.
        """
        pandas, (low, high) = import_package("to_pandas()", "pandas", "pandas"), self._ends(level)
        columns = {"value": self.parameters.values(self.u), "low": low, "high": high}
        return pandas.DataFrame(columns, index=pandas.Index(self.parameters.names, name="parameter"))

    def intervals(self, level: float = LEVEL) -> tuple[PyTree, PyTree]:
        """The ends (low, high) of the intervals that hold each free number with probability `level`, as two pytrees.

        They are made in the transformed numbers, so that they stay inside the sets of the transforms. Where such an
        interval would not exclude a bound of its set, it is made in the number itself, and ends at the bound. The
        interval of a parameter that the data do not determine is the whole set. A parameter that is not free is both
        ends of its own interval.

        Raises `ValueError` for a level that is not between 0 and 1.
        """
        low, high = self._ends(level)
        ends = []
        for values in (low, high):
            numbers = self.parameters.numbers(self.u)
            numbers[self.parameters.free_places] = values
            ends.append(self.parameters.restore_records(numbers))
        return ends[0], ends[1]

    @with_doubles
    def deviation(self, function: Callable) -> PyTree:
        """The standard deviation of what `function(params)` returns, by its derivatives: of a learned potential at a
        point, `fit.deviation(lambda params: V(0.5, params=params["V"]))`, or of a ratio of two parameters.

        It is infinite where the function depends on what the data do not see.
        """

        def numbers(u) -> PyTree:
            return function(self.parameters.restore_records(self.parameters.numbers(u, jnp)))

        return jax.tree.map(
            lambda slopes: deviations(np.asarray(slopes), self.information), jax.jacobian(numbers)(self.u)
        )

    @with_doubles
    def profile(self, name: str, level: float = LEVEL) -> Profile:
        """The profile likelihood of the parameter called `name`: "params['dry']", or "dry" where that is the only one.

        It says how much likelihood is lost where the parameter is kept at another value and all other free parameters
        and starts are fitted anew. The interval is read off the profile itself, with the effective number of samples
        that `intervals` uses. Printed, the result gives its verdict: bounded, one-sided, flat, or two minima.

        Raises `ValueError` for a name that no free parameter has, or that moves only together with others.

        Source: Venzon & Moolgavkar, Applied Statistics 37 (1988) 87; Raue et al., Bioinformatics 25 (2009) 1923.
        """
        return profile(self, name, level)

    def log_density(self, prior: Callable | None = None) -> Density:
        """The logarithm of the posterior density of all unknowns: a function of one vector for `jax.jit`, `jax.grad`.

        The prior is flat in the free parameters within their sets, in the starts and in log σ, unless `prior(params)`
        returns the logarithm of another prior density of the parameters. Correlated samples count by their effective
        number. On the function, `first` is the vector of the fit, `names` names its numbers, `covariance()` is that of
        least squares: a metric for samplers. `params(x)` is the user's pytree of parameters, and `unknowns(x)` has the
        starts and σ. The guide on recordings draws from it with blackjax.

        Raises `ValueError` for fitted starts on constraints and for `lagjax.Delayed` sensors.
        """
        shares = np.array([noise.effective / noise.samples for noise in self.noise.values()])
        return Density(self.residual_function, self.law, self._point, self.noise_scale, shares, prior)

    @functools.cached_property
    def _point(self) -> Trial:
        return self.residual_function.evaluate(Point(self.u, self.states))

    def _ends(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        wide = self.information.quantile(level) * np.sqrt(np.diag(self.covariance.matrix))
        return self.parameters.ends(self.u, wide)

    @with_doubles
    def predict(self, record: Record, *, system: str | None = None) -> Prediction:
        """The motion of the fitted scene over a record, which need not be one of those that were fitted.

        It begins at the record's start if that is known, else at the start that fits the record's values best with the
        parameters kept. Numbers that are `lagjax.per_record` are those of the fit for one of `records`, and for another
        record those that fit its values best. To predict from the first samples alone, let `predict` find the start of
        a short record, and give that start to a `Record` of the whole. `system` is the name of the record's system, for
        a fit of several systems.

        Raises `ValueError` where the record has different signals from those of the fit, or its motion fails.
        """
        return predict_record(self, record, system)

    @with_doubles
    def next_experiment(
        self, candidates: Sequence[Record] | dict[str, Record], *, system: str | None = None
    ) -> Experiments:
        """Rank planned records by what they would tell about the free parameters: D-optimal design.

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
        part = self.residual_function.find_part(system)
        rows = [planned_rows(self, part, name, record) for name, record in named.items()]
        return rank_experiments(list(named), rows, self.parameters.labels, self.information)

    @with_doubles
    def report(self, path: str | os.PathLike, experiments: Sequence[Record] | dict[str, Record] = ()) -> None:
        """Write one file of HTML: parameters, noise, what is not seen, data over fit, residuals, correlations, starts.

        With `experiments`, a set of planned records, it also says what to measure next (`next_experiment`). It needs
        matplotlib.
        """
        texts = {"What to measure next": str(self.next_experiment(experiments))} if experiments else {}
        Path(path).write_text(render_page(self, texts), encoding="utf-8")

    @with_doubles
    def compare(self, other: "Fit | dict[str, Fit]", *, folds: int = 0) -> Comparison:
        """Compare fits of the same records: this one with another, or with a dict of others.

        The fits are compared by AIC and BIC with effective numbers of samples, and with `folds` also by
        cross-validation: the records are divided into that many groups, each group is left out in turn, and is
        predicted with the parameters that the other groups give; only its starts are fitted to it. Printed, the result
        is a table; in that of a dict this fit is called "this".

        Raises `ValueError` where the fits are not about the same measurements, or folds are not 0 or 2 to the number of
        records.
        """
        others = other if isinstance(other, dict) else {"the other": other}
        return comparison({"this": self, **others}, folds)


def _record_residuals(residuals: Residuals, trial: Trial) -> list[np.ndarray]:
    """The residuals of every record, (T, S), NaN where nothing was measured."""
    columns = [residuals.columns(k) for k in range(len(residuals.records))]
    pairs = zip(residuals.records, columns, strict=True)
    found = [np.full((len(record), own.stop - own.start), np.nan) for record, own in pairs]
    for batch, own in zip(residuals.batches, trial.residuals, strict=True):
        for row, left, weights, values in zip(batch.rows.tolist(), own, batch.weights, batch.values, strict=True):
            record, places, _ = residuals.pieces[row]
            inside = np.where(weights > 0, left + values, np.nan)[: len(places), columns[record]]
            found[record][places] = inside - residuals.records[record].matrix[places]
    return found
