"""`fit`: the parameters of a scene, and of its forces, from recordings of its motion.

    Record ─► Residuals ─► segments ─► Descent ─► Information ─► Fit
    measured  flat, one    where the   the least  covariance,    in the user's
    checked   batch        search      squares    null           pytree, in words
                           begins                 directions

Three rooms, each of which imports only from those before it:

    model/     records, parameters, sensors, noise, and the residuals of a trial
    search/    descents, multiple shooting over segments that grow, multistart
    result/    Fit: intervals, what is not seen, verdict, profile, draws, predictions, report
"""

import contextlib
import functools
import itertools
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lagjax._fit.model._assembly import GivenSystem, assemble_residuals, read_systems
from lagjax._fit.model._law_parameters import AbstractLaw, LawParameters, find_laws, terms
from lagjax._fit.model._noise import AbstractNoise, Clipped, Gaussian, Quantised, StudentT
from lagjax._fit.model._parameters import Parameters, per_record
from lagjax._fit.model._records import Guess, Record, require_untraced
from lagjax._fit.model._residuals import LostMotion, Point, Residuals
from lagjax._fit.model._sensors import Delayed, wrapped
from lagjax._fit.model._timings import Timings
from lagjax._fit.model._transforms import Smooth, Unbounded, angle, between, inertia, positive, simplex
from lagjax._fit.result._comparison import Comparison
from lagjax._fit.result._evidence import begin_weakly, find_smoothness
from lagjax._fit.result._experiments import Experiments
from lagjax._fit.result._mistakes import SECONDS, find_mistake, possible_mistakes
from lagjax._fit.result._prediction import Prediction
from lagjax._fit.result._profile import Profile
from lagjax._fit.result._report import draw_record
from lagjax._fit.result._result import Fit
from lagjax._fit.result._selection import Selection, keep_selected, select_terms
from lagjax._fit.result._verdict import is_doubtful
from lagjax._fit.search._descent import Descent
from lagjax._fit.search._multistart import Waterfall, run_multistart
from lagjax._fit.search._reader import TimeScales, first_starts, read_records, start_noise, time_scales
from lagjax._fit.search._search import Search, search_again
from lagjax._fit.search._unexplained import Unexplained
from lagjax._primitives import with_doubles
from lagjax._run.hybrid import Scene, jumps
from lagjax._scene import HOLDS

PyTree = Any
_METHODS = ("auto", "segments", "whole", "gradient")
# Free numbers from which on a sentence says that another method may be meant. A trial of 288 numbers and 20 records of
# 241 samples takes 1.8 s; of a network of 337 it took half a minute, and the gradient's whole descent as long.
_MANY_UNKNOWNS = 300
# Of motion that sticks, or strikes, where one start is not enough: 16 at a time, until they are. Of 12 guesses of a
# block that sticks and slips, up to three times off, one start was enough for 1, 16 for 7, 48 for 3, and 64 for 1.
_STARTS_AT_A_TIME, _TIMES = 16, 4


@with_doubles
def fit(
    system: Scene | dict[str, Scene],
    records: Record | Timings | list | dict[str, Any],
    params0: PyTree,
    *,
    observe: Callable | dict[str, Callable | None] | None = None,
    free: PyTree = None,
    transforms: PyTree = None,
    noise: AbstractNoise | None = None,
    hold: str = "zero",
    starts: int | None = None,
    method: str = "auto",
    seed: int = 0,
    progress: bool = False,
) -> Fit:
    r"""The maximum-likelihood parameters of a scene from recordings of its motion, with their intervals.

    `fit` minimises Σ w (observe(q(t), q̇(t)) − value)²/σ² over all samples. Its unknowns are the free parameters, the
    start of every record whose start is not known, and one σ per signal.

    **Arguments**

    - `system`: one scene, a `System` or a `lagjax.Hybrid`, or a dict by name of scenes that share parameters: two
      machines with the same bearings, or one that swings freely in some records and is driven in others. `records` is
      then a dict by the same names, and `observe` such a dict or one for all.
    - `records`: one `Record` or several, of any lengths; and `lagjax.Timings`, beside them or alone.
    - `params0`: where the search for the parameters begins, in the structure that the scene's functions ask for.
    - `observe`: a function of (q, qdot), and of `t`, `params`, `inputs` by name, that returns what the sensors show in
      the structure of a record's `values`; by default q. `lagjax.Delayed` is for sensors with a delay, `lagjax.wrapped`
      for those that show angles less whole turns.
    - `free`: True or False for every parameter, or for whole branches of `params0`, or a Boolean array for the numbers
      of an array; by default all floats are free. With False starts and noise alone are fitted: how good are published
      parameters on these records? `lagjax.per_record` for a number, or a whole array, that every record has of its own:
      an offset, a gain, a delay, or what a start is computed from. Functions of the scene and `observe` see the number
      of the record that they are called for; `Fit.params` has them all, with the records as first axis.
    - `transforms`: `lagjax.positive`, `lagjax.between(a, b)`, `lagjax.angle` or None for every parameter or branch;
      an array of these for the numbers of an array, `np.array([lagjax.positive, None])`; `lagjax.simplex` and
      `lagjax.inertia` for a whole array. A parameter that is known to be positive should say so:
      its search and its interval are then relative.
    - `noise`: `lagjax.Gaussian()`, the default; `lagjax.StudentT()` where the data have outliers;
      `lagjax.Quantised(step)` and `lagjax.Clipped(low, high)` where sensors round or are at their limits, which the
      default reads off the data, and says.
    - `hold`: how the `inputs` of records continue between samples: "zero" keeps the last sample, as a D/A converter
      does; "linear", "cubic" and "band" interpolate as `lagjax.samples` does.
      "band" is for inputs below the Nyquist frequency, evenly sampled. Functions of the scene ask for `inputs` by name.
    - `starts`: the number of parameter values from which to search: `params0`, and random ones drawn with `seed`, about
      a positive number with a decade as standard deviation, uniform between bounds, on a circle or a simplex, and about
      any other number with its size as standard deviation. The best few go through the whole search, and `params0`
      always does; `Fit.waterfall` tells where each of them ended. None is one start; where motions jump, by contacts or
      in a `Hybrid`, up to 64 are added if the search from `params0` leaves motion, does not see all that is
      free, or cannot follow the motion at all.
    - `progress`: print a line for every trial to stderr.
    - `method`: "whole" begins with whole records. "segments" begins with short segments of them, each with a start of
      its own read off the data, and joins these step by step; for that the signals must have the structure of q. "auto"
      does so where the signals allow it and the records are longer than the motion's time scale: then the search
      converges for long and chaotic records, and from parameters that are far off. Of motion that jumps it follows
      whole records first, and where these leave motion, long ones by segments, each from its likeliest mode. Where
      signals are no positions and all starts are known, a search that leaves more than a twentieth of the signals is
      tried again from the first samples of the records, and the likelier of both is taken. Of hundreds of records an
      even sample is searched before all of them. "gradient" descends by reverse-mode gradients with optax's Adam: for
      scenes with neural terms, an `equinox.nn.MLP` in `params0` for instance. With more than a hundred free numbers the
      other methods say in a warning that this one is meant for them.

    Of a law of candidate terms (`lagjax.terms`) in `params0` those are 0 that the motion does not ask for.
    Intervals take the correlation of residuals into account (`Fit.noise`). `Fit.unseen` says in words which parameters
    the data do not determine; their intervals are infinite.

    **Raises** `TypeError` or `ValueError` for arguments that cannot be right, and where the motion from the first
    trial cannot be followed, with the record and the time.

    Source: Schittkowski, *Numerical Data Fitting in Dynamical Systems* (2002); Seber & Wild, *Nonlinear Regression*
    (1989), for intervals.

    ```python
    import jax, jax.numpy as jnp, lagjax
    jax.config.update("jax_enable_x64", True)

    scene = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 - 0.5 * params["k"] * q**2)
    ts = jnp.linspace(0.0, 5.0, 101)
    record = lagjax.Record(ts, jnp.cos(1.5 * ts) + 1e-3 * jax.random.normal(jax.random.key(0), ts.shape))
    print(lagjax.fit(scene, record, {"k": 1.0}, transforms=lagjax.positive))
    ```
    """
    if not (starts is None or (isinstance(starts, int | np.integer) and starts > 0)):
        raise ValueError(f"starts must be a positive whole number, or None to let the fit choose; got {starts!r}.")
    if not (isinstance(seed, int | np.integer) and seed >= 0):
        raise ValueError(f"seed must be a whole number, 0 or larger; got {seed!r}.")
    if method not in _METHODS:
        raise ValueError(f"method must be one of {', '.join(map(repr, _METHODS))}; got {method!r}.")
    if hold not in HOLDS:
        raise ValueError(f"hold must be one of {', '.join(map(repr, HOLDS))}; got {hold!r}.")
    require_untraced(params0, "params0")
    if method == "gradient" and find_laws(params0):
        raise ValueError(
            'method="gradient" chooses no terms, and no smoothness of learned functions: leave it, or fit all of their '
            "numbers, dict(law.params0)."
        )
    noise = Gaussian() if noise is None else noise
    if not isinstance(noise, AbstractNoise):
        raise TypeError(f"noise must be lagjax.Gaussian(), StudentT(), Quantised(…) or Clipped(…); got {noise!r}.")
    given = read_systems(system, records, params0, observe, hold)
    build = functools.partial(Parameters.from_pytree, params0, free, transforms)
    search = _FitSearch(params0, build, noise, starts and int(starts), method, int(seed), progress)
    parameters = build(sum(len(one.records) for one in given))
    followed = parameters.unknowns.columns.shape[1]
    if followed > _MANY_UNKNOWNS and method != "gradient" and not parameters.prior_weights.any():
        warnings.warn(
            f"{followed} numbers are free, and with method={method!r} every trial follows that many derivatives "
            "of every motion, which may take minutes each. method='gradient' takes all of them at once, in reverse: it "
            "is for networks and other functions of many numbers.",
            stacklevel=2,
        )
    begun = time.process_time()
    try:
        done, left = search.fit(given, looks_further=True)
    except LostMotion as reason:
        text = f"{reason} Begin nearer: other params0, or starts that are known."
        nothing = Unexplained([text], [], np.inf, True, list(range(len(given[0].records))))
        more = search.find_mistake(given, nothing, time.process_time() - begun)
        raise ValueError(" ".join([text, *more])) from None
    if not left.doubted:
        return done
    if (selection := done.selection) is not None:
        laws = find_laws(params0)
        search = search._replace(build=lambda records: keep_selected(build(records), selection, laws))
    more = search.find_mistake(given, left, time.process_time() - begun)
    return replace(done, ok=done.ok and not more, message=" ".join([done.message, *more]))


class _FitSearch(NamedTuple):
    """The settings of a fit, for these records and for others without a mistake."""

    params0: PyTree
    build: Callable[[int], Parameters]
    law: AbstractNoise
    starts: int | None  # None: one, and more where that is not enough
    method: str
    seed: int
    progress: bool

    def fit(self, given: list[GivenSystem], looks_further: bool = False) -> tuple[Fit, Unexplained]:
        """The fit of records that were checked, and what it leaves. Raises `LostMotion` where none can be followed.

        Motion that sticks, or strikes, has many minima: with `looks_further` more starts are tried where one leaves
        motion, and candidate terms are chosen.
        """
        parameters = self.build(sum(len(one.records) for one in given))
        residuals = assemble_residuals(given, parameters, self.law)
        self._require_one_beginning(residuals)
        readers = read_records(residuals)
        u = parameters.inverse(parameters.first)
        point, waterfall = Point(u, first_starts(residuals, readers, self.params0)), None
        if any(jumps(part.scene) for part in residuals.parts):
            residuals = residuals.choose_modes(point, start_noise(residuals, readers, point))
        residuals, point = _keep_unused(residuals, point)
        residuals = begin_weakly(residuals, point, self.law)
        if self.progress:
            residuals.watch = _print_trials(residuals.size)
        search = Search(residuals, self.law, self.method, readers)
        if self.method == "gradient":
            descent = search.descend_gradient(point)
        else:
            descent, waterfall = self._descend(residuals, search, point, looks_further)
            descent = search_again(descent, self.law)
        residuals.watch = descent.residuals.watch = None
        descent = find_smoothness(descent, self.law, _print_line if self.progress else None)
        laws, selection = [law for law in find_laws(self.params0) if law.law.selects], None
        if laws and looks_further:
            tell = _print_line if self.progress else None
            descent, selection = select_terms(descent, self.law, laws, tell)
        return Fit.from_descent(descent, self.law, waterfall, selection)

    def _descend(
        self, residuals: Residuals, search: Search, point: Point, looks_further: bool
    ) -> tuple[Descent, Waterfall | None]:
        """The end of the search from the starts that were asked for; where that is left to it, from one, and from more
        if that one is not enough: of learned functions, which have one least for a smoothness, evidence says so later.
        Raises `LostMotion` where none can be followed."""
        whole = Search(residuals, self.law, "whole", search.readers) if self.method == "auto" else search
        tell, lost, chooses = _print_line if self.progress else None, None, looks_further and self.starts is None
        chooses &= len(residuals.parameters) > 0 and any(jumps(part.scene) for part in residuals.parts)
        chooses &= not residuals.parameters.prior_weights.any()
        done, misfits = None, np.zeros(0)
        try:
            done, waterfall = run_multistart(residuals, search, point, self.starts or 1, self.seed, tell)
            if not chooses:
                return done, waterfall
        except LostMotion as reason:
            if not chooses:
                raise
            lost = reason
        while len(misfits) < _TIMES * _STARTS_AT_A_TIME and (done is None or is_doubtful(done)):
            if tell:
                tell(f"One start is not enough, others are tried: {lost or 'the motion may be another one.'}")
            begin, seed = point if done is None else done.trial.point, [self.seed, len(misfits)]
            try:
                other, some = run_multistart(residuals, whole, begin, _STARTS_AT_A_TIME, seed, tell)
            except LostMotion:
                text = f"{lost} Nor could the motions from {_STARTS_AT_A_TIME - 1} other starts be followed."
                raise LostMotion(text) from None
            assert some is not None
            misfits = np.sort(np.append(misfits, some.misfits))
            both = [one for one in (done, other) if one is not None]
            done = max(both, key=lambda one: one.residuals.log_likelihood(one.trial, one.noise))
        assert done is not None
        if lost:
            text = "The motion with params0 could not be followed: this is the best search from other starts."
            done = done._replace(message=f"{done.message} {text}")
        return done, Waterfall(misfits) if len(misfits) else None

    def _require_one_beginning(self, residuals: Residuals) -> None:
        several = self.starts is not None and self.starts > 1
        if not len(residuals.parameters) and (self.method == "gradient" or several):
            raise ValueError(
                "No parameter is free, so there is one place to begin: leave `starts` at 1, and `method` at 'auto', "
                "which fits the starts of records."
            )
        if self.method == "gradient" and several:
            raise ValueError('method="gradient" goes down from one start: leave `starts` at 1.')

    def find_mistake(self, given: list[GivenSystem], left: Unexplained, spent: float) -> list[str]:
        """The first mistake in records that explains a poor fit, as a sentence; `spent` is the fit's processor time."""
        if len(given) > 1 or self.method == "gradient":
            return []
        [system], once = given, self._replace(starts=1, progress=False)
        residuals = assemble_residuals(given, self.build(len(system.records)), self.law)
        [part] = residuals.parts
        if not part.signals.names:
            return []

        def share(records: list[Any]) -> float | None:
            try:
                _, left = once.fit([system._replace(records=records)])
            except ValueError:
                return None
            return None if left.motion else left.share

        reading = {k: reader for k, reader in enumerate(read_records(residuals)) if reader is not None}
        numbers = residuals.parameters.first[residuals.parameters.places[list(reading)]]
        scales = TimeScales(1.0, 1.0)
        if reading:
            scales = time_scales(list(reading.values()), part.motions, numbers)
        slower = scales.data / scales.scene if np.isfinite(scales.data) else 1.0
        possible = possible_mistakes(system.records, part.signals.names, left.worst, slower)
        return find_mistake(share, possible, left.share, max(spent, SECONDS) if left.motion else spent)


def _keep_unused(residuals: Residuals, point: Point) -> tuple[Residuals, Point]:
    """The residuals and the point where numbers of records on which the signals of their system do not depend at all,
    but those of others do, stay as they are: the offset of a sensor that one of two machines has; so do those of a
    record whose motion is that of another."""
    states, unknowns, kept = residuals.states, residuals.unknowns, np.zeros(len(residuals.parameters), bool)
    kept[np.setdiff1d(np.arange(len(kept)), unknowns.columns)] = True
    if unknowns.own and len(residuals.parts) > 1:
        with contextlib.suppress(LostMotion):
            own = (x[..., states : states + unknowns.own].any(axis=(0, 1, 2)) for x in residuals.evaluate(point).slopes)
            uses = np.array([np.any([next(own) for _ in part.batches], axis=0) for part in residuals.parts])
            for part, used in zip(residuals.parts, uses, strict=True):
                kept[unknowns.columns[part.frame.rows, : unknowns.own][:, ~used & uses.any(axis=0)]] = True
    if not kept.any():
        return residuals, point
    parameters = residuals.parameters.fix(point.u, kept)
    return residuals.with_parameters(parameters), point._replace(u=point.u[~kept])


def _print_trials(size: np.ndarray) -> Callable[[Any], None]:
    count = itertools.count(1)

    def tell(trial) -> None:
        if isinstance(trial, LostMotion):
            text = str(trial).splitlines()[0]
        else:
            rms = np.sqrt(np.mean(trial.flat() ** 2, axis=0)) / size
            text = f"{len(trial.starts)} motions, residuals {np.exp(np.mean(np.log(rms))):.4g} of the signals"
        _print_line(f"trial {next(count)}: {text}")

    return tell


def _print_line(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
