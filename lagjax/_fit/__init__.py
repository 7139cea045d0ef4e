"""`fit`: the parameters of a scene, and of its forces, from recordings of its motion.

    Record ─► Residuals ─► segments ─► Descent ─► Information ─► Fit
    measured  flat, one    where the   the least  covariance,    in the user's
    checked   batch        search      squares    null           pytree, in words
                           begins                 directions

Three rooms, each of which imports only from those before it:

    model/     records, parameters, sensors, noise, and the residuals of a trial
    search/    descents, multiple shooting over segments that grow, weak form, multistart
    result/    Fit: intervals, what is not seen, verdict, profile, draws, predictions, report
"""

import functools
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._engine import DEFAULT_RTOL
from lagjax._equations import has_constraints
from lagjax._fit.model._inputs import Form, input_functions
from lagjax._fit.model._motions import Manifold, choose_motions
from lagjax._fit.model._noise import AbstractNoise, Clipped, Gaussian, Quantised, Sensor, StudentT, read_sensor
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._pieces import whole_pieces
from lagjax._fit.model._records import (
    Guess,
    Record,
    errors_of_system,
    known_start,
    require_interpolation,
    require_records,
    require_untraced,
    restore_structure,
    start_pair,
    systems_by_name,
)
from lagjax._fit.model._residuals import LostTrial, Residuals, SystemResiduals
from lagjax._fit.model._sensor_faults import constant_signals, require_measurements
from lagjax._fit.model._sensors import UNCLEAR, Delayed, require_no_jumps, sensors, wrapped
from lagjax._fit.model._signals import Signals
from lagjax._fit.model._timings import Timings, build_clock
from lagjax._fit.model._transforms import angle, between, inertia, positive, simplex
from lagjax._fit.result._comparison import Comparison
from lagjax._fit.result._experiments import Experiments
from lagjax._fit.result._identifiability import unseen_sentences
from lagjax._fit.result._information import Information, information
from lagjax._fit.result._mistakes import SECONDS, find_mistake, possible_mistakes
from lagjax._fit.result._prediction import Prediction
from lagjax._fit.result._profile import Profile
from lagjax._fit.result._report import draw_record, record_matrix
from lagjax._fit.result._result import Covariance, Fit, SignalNoise
from lagjax._fit.result._verdict import Verdict, verdict
from lagjax._fit.search._descent import Descent
from lagjax._fit.search._multistart import Waterfall, run_multistart
from lagjax._fit.search._reader import Reader, TimeScales, build_reader, pad_states, time_scales
from lagjax._fit.search._search import Unfollowed, search_again, search_by_gradient, search_records, start_by_weak_form
from lagjax._fit.search._unexplained import Unexplained
from lagjax._interface import Layout, find_params_expression
from lagjax._primitives import DOUBLE, with_doubles
from lagjax._run.hybrid import Hybrid, Scene, first_law, require_scene
from lagjax._scene import HOLDS

PyTree = Any

METHODS = ("auto", "segments", "whole", "gradient")
# Free numbers from which on a sentence says that another method may be meant. Of a network of 337 a trial takes half a
# minute, and the gradient's whole descent as long; scenes of 50 need no such advice.
_MANY = 100


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
    starts: int = 1,
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
      parameters on these records?
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
    - `starts`: the number of parameter values from which to search, as one batch: `params0`, and random ones drawn with
      `seed`: about a positive number with a decade as standard deviation, uniform between bounds, on a circle or a
      simplex, and about any other number with its size as standard deviation. The best few go through the whole search,
      and `params0` always does; `Fit.waterfall` tells where each of them ended.
    - `progress`: print a line for every trial to stderr.
    - `method`: "whole" begins with whole records. "segments" begins with short segments of them, each with a start of
      its own read off the data, and joins these step by step; for that the signals must have the structure of q. "auto"
      does so where the signals allow it and the records are longer than the motion's time scale: then the search
      converges for long and chaotic records, and from parameters that are far off. "gradient" descends by reverse-mode
      gradients with optax's Adam: for scenes with neural terms, an `equinox.nn.MLP` in `params0` for instance. With
      more than a hundred free numbers the other methods say in a warning that this one is meant for them.

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
    if not (isinstance(starts, int | np.integer) and starts > 0):
        raise ValueError(f"starts must be a positive whole number; got {starts!r}.")
    if not (isinstance(seed, int | np.integer) and seed >= 0):
        raise ValueError(f"seed must be a whole number, 0 or larger; got {seed!r}.")
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(map(repr, METHODS))}; got {method!r}.")
    if hold not in HOLDS:
        raise ValueError(f"hold must be one of {', '.join(map(repr, HOLDS))}; got {hold!r}.")
    require_untraced(params0, "params0")
    noise = Gaussian() if noise is None else noise
    if not isinstance(noise, AbstractNoise):
        raise TypeError(
            f"noise must be lagjax.Gaussian(), StudentT(), Quantised(step) or Clipped(low, high); got {noise!r}."
        )
    scenes = _scenes(system, records, params0, observe, hold)
    parameters = Parameters.from_pytree(params0, free, transforms)
    settings = _Settings(system, observe, noise, int(starts), method, int(seed), progress)
    if len(parameters) > _MANY and method != "gradient":
        warnings.warn(
            f"{len(parameters)} numbers are free, and with method={method!r} every trial follows that many derivatives "
            "of every motion, which may take minutes each. method='gradient' takes all of them at once, in reverse: it "
            "is for networks and other functions of many numbers.",
            stacklevel=2,
        )
    begun = time.process_time()
    try:
        done, judged = _fit_checked(settings, scenes, params0, parameters)
    except Unfollowed as reason:
        nothing = Unexplained([str(reason)], [], np.inf, True, list(range(len(scenes[0].records))))
        more = _mistakes(settings, scenes, params0, parameters, nothing, time.process_time() - begun)
        raise Unfollowed(" ".join([str(reason), *more])) from reason.__cause__
    if not judged.left.doubted:
        return done
    more = _mistakes(settings, scenes, params0, parameters, judged.left, time.process_time() - begun)
    return replace(done, ok=done.ok and not more, message=" ".join([done.message, *more]))


def _mistakes(
    settings: "_Settings",
    scenes: list["_GivenSystem"],
    params0: PyTree,
    parameters: Parameters,
    left: Unexplained,
    spent: float,
) -> list[str]:
    """The mistakes in records of which a fit leaves much, as far as fits of other records tell; `spent` is the
    processor time that it took, and the tries may take, or more where it explains nothing."""
    if len(scenes) > 1 or settings.method == "gradient":
        return []
    [scene] = scenes
    once, about = settings._replace(starts=1, progress=False), _build_residuals(scene, parameters, settings.noise)
    reading = [reader for reader in _readers(scenes, Residuals([about])) or [] if reader is not None]
    if not about.signals.names:
        return []

    def share(records: list[Any]) -> float | None:
        try:
            _, judged = _fit_checked(once, [scene._replace(records=records)], params0, parameters)
        except ValueError:
            return None
        return None if judged.left.motion else judged.left.share

    scales = time_scales(reading, about.motions, parameters.first) if reading else TimeScales(1.0, 1.0)
    slower = scales.data / scales.scene if np.isfinite(scales.data) else 1.0
    possible = possible_mistakes(scene.records, about.signals.names, left.worst, slower)
    return find_mistake(share, possible, left.share, max(spent, SECONDS) if left.motion else spent)


class _Settings(NamedTuple):
    """The settings of a search."""

    system: Any
    observe: Any
    noise: AbstractNoise
    starts: int
    method: str
    seed: int
    progress: bool


def _fit_checked(
    settings: _Settings, scenes: list["_GivenSystem"], params0: PyTree, parameters: Parameters
) -> tuple[Fit, Verdict]:
    """The fit of records that were checked. Raises `Unfollowed` where the first trial cannot be followed."""
    residuals = Residuals([_build_residuals(scene, parameters, settings.noise) for scene in scenes])
    _require_one_beginning(residuals, settings.starts, settings.method)
    readers = _readers(scenes, residuals)
    if settings.progress:
        residuals.watch = _Printer(residuals.size)
    y0 = _starts(residuals, readers, params0)
    readers = _cuttable_readers(scenes, readers, settings.method)
    first, noise = parameters.inverse(parameters.first), settings.noise
    if settings.method == "gradient":
        return _build_result(settings, search_by_gradient(residuals, first, y0, noise, readers), None)
    weak = functools.partial(start_by_weak_form, residuals, readers=readers or [])
    search = functools.partial(search_records, residuals, law=noise, method=settings.method, readers=readers, weak=weak)
    descent, waterfall = run_multistart(residuals, search, first, y0, settings.starts, settings.seed)
    return _build_result(settings, search_again(descent, noise), waterfall)


class _GivenSystem(NamedTuple):
    """One system of a fit: its name, None for the only one, its records and sensors, and the structure of its inputs
    and coordinates."""

    name: str | None
    system: Scene
    records: list[Any]
    observe: Callable | Delayed | None
    form: Form | None
    layout: Layout


def _scenes(system, records, params0, observe, hold: str) -> list[_GivenSystem]:
    scenes = []
    for name, one, own, shown in systems_by_name(system, records, observe):
        with errors_of_system(name):
            one = require_scene(one)
            own = require_records(own)
            form = _form(one, own, hold)
            scenes.append(_GivenSystem(name, one, own, shown, form, _layout(one, own, params0, form)))
    return scenes


def _require_one_beginning(residuals: Residuals, starts: int, method: str) -> None:
    """Raise `ValueError` where many starts, or a descent by gradients, are chosen and cannot be."""
    if not len(residuals.parameters) and (method == "gradient" or starts > 1):
        raise ValueError(
            "No parameter is free, so there is one place to begin: leave `starts` at 1, and `method` at 'auto', which "
            "fits the starts of records."
        )
    if method == "gradient" and starts > 1:
        raise ValueError('method="gradient" goes down from one start: leave `starts` at 1.')
    for one in [part.system for part in residuals.parts] if starts > 1 else []:
        if one.signals.delays is not None:
            raise ValueError("starts must be 1 where sensors are lagjax.Delayed: their search has one beginning.")
        if one.manifold is not None and one.fitted.any():
            raise ValueError("starts must be 1 where starts on constraints are fitted: their search has one beginning.")
        if one.clocks:
            raise ValueError("starts must be 1 where there are lagjax.Timings: their search has one beginning.")


def _form(system: Scene, records: list[Record], hold: str) -> Form | None:
    """The structure of the inputs. Raises `ValueError` where the scene asks for some, and there are none."""
    asking = input_functions(system)
    if asking and isinstance(system, Hybrid):
        raise ValueError(f"{asking[0]} asks for `inputs`, which hybrid motion has none of: make it a function of `t`.")
    for place, record in enumerate(records):
        if asking and (not isinstance(record, Record) or record.input_structure is None):
            raise ValueError(
                f"{asking[0]} asks for `inputs`, which records[{place}] has none of: give Record(..., inputs=...)."
            )
    structures = [record.input_structure for record in records if isinstance(record, Record)]
    if not structures or structures[0] is None:
        return None
    for place, record in enumerate(records):
        require_interpolation(record, hold, f"records[{place}]")
    tree, shapes = structures[0]
    return Form(tree, shapes, hold)


def _layout(system: Scene, records: list[Record], params0, form: Form | None) -> Layout:
    """The structure of the coordinates: that of a start that a record gives, or else that of its values."""
    place = next((k for k, record in enumerate(records) if record.start is not None), None)
    if place is not None:
        begun = start_pair(records[place].start, params0)
    else:  # no record is of crossing times: those have starts
        begun = 2 * (jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:]), records[0].values),)
    q, qdot = jax.tree.map(jnp.asarray, begun)
    scene, params = first_law(system), params0
    if form is not None:
        scene, params = form.drive_scene(scene), form.params(params0, 2)
    try:
        jax.eval_shape(lambda q, qdot: scene.energy(q, qdot, 0.0, params), q, qdot)
    except Exception as reason:
        if where := find_params_expression(reason):
            raise ValueError(
                f"The scene's functions ask for `{where}`, which params0 does not have ({type(reason).__name__}: "
                f"{str(reason).splitlines()[0]}): params0 is {jax.tree.structure(params0)}."
            ) from reason
        if place is not None:
            raise ValueError(
                f"The scene's functions cannot be called with the start of records[{place}] ({type(reason).__name__}: "
                f"{str(reason).splitlines()[0]}): give it in the structure of q."
            ) from reason
        raise ValueError(
            "The scene's functions cannot be called with coordinates of the structure of `values`, which q is taken to "
            f"have where no record has a start ({type(reason).__name__}: {str(reason).splitlines()[0]}). If the values "
            "are something else, give every record start=(q0, qdot0), or lagjax.Guess(q0, qdot0) to fit it."
        ) from reason
    return replace(Layout.from_state(q, qdot), dtype=DOUBLE)


def _build_residuals(scene: _GivenSystem, parameters: Parameters, noise: AbstractNoise) -> SystemResiduals:
    with errors_of_system(scene.name):
        return _system_residuals(*scene, parameters, noise)


def _system_residuals(name, system, records, observe, form, layout, parameters, noise) -> SystemResiduals:
    rtol = DEFAULT_RTOL
    motions = choose_motions(system, layout, parameters, rtol, None, form)
    recordings = [record for record in records if isinstance(record, Record)]
    if isinstance(observe, Delayed):
        _require_length(recordings, observe.longest)
    signals = Signals(observe, layout, parameters, recordings[0] if recordings else None, form)
    _require_no_jumps(system, records, observe, signals)
    _require_motion(recordings, signals.names, records)
    if not isinstance(noise, StudentT):
        require_measurements(recordings, signals.names, signals.periods)
    sensor = read_sensor(recordings, noise, signals.names, signals.periods)
    every = np.concatenate([record.matrix for record in recordings]) if recordings else np.zeros((1, 0))
    size = np.sqrt(np.nanmean(every**2, axis=0))  # root mean squares
    timings = {k: record for k, record in enumerate(records) if isinstance(record, Timings)}
    clocks = {k: build_clock(system, layout, parameters, record, rtol) for k, record in timings.items()}
    if timings:
        size = np.append(size, max(np.ptp(record.ts) for record in timings.values()))
        sensor = Sensor(*(np.append(x, np.nan) for x in sensor))
    fitted = np.array([record.start is None or isinstance(record.start, Guess) for record in records])
    manifold = None
    if isinstance(system, Hybrid):
        _require_supported(system, fitted, observe)
    elif has_constraints(system) and not input_functions(system):
        manifold = Manifold(system, layout, parameters, motions.projection)
    elif has_constraints(system) and fitted.any():
        raise ValueError("A start on constraints of a scene with `inputs` cannot be fitted: give start=(q0, qdot0).")
    return SystemResiduals(
        name, system, records, whole_pieces(records), fitted, motions, signals, parameters,
        np.where(size > 0, size, 1.0), rtol, clocks, manifold, sensor,
    )  # fmt: skip


def _require_no_jumps(scene: Scene, records: list[Any], observe, signals: Signals) -> None:
    """Raise `ValueError` where a signal jumps by a period without `lagjax.wrapped`; hybrid motion may jump."""
    if isinstance(scene, Hybrid) or sensors(observe)[1] is not None:
        return
    for place, record in enumerate(records):
        if isinstance(record, Record):
            require_no_jumps(record, f"records[{place}]", signals.names, sensors(observe)[0] is None)


def _require_motion(recordings: list[Record], names: tuple[str, ...], records: list[Any]) -> None:
    """Raise `ValueError` where starts are fitted, and no signal of any record ever changes."""
    still = constant_signals(recordings, names)
    if still and len(still) == len(names) * len(records) and all(record.start is None for record in records):
        raise ValueError(f"{still[0]} So it is with all signals of all records: nothing moves that could be fitted.")


def _require_supported(scene: Hybrid, fitted: np.ndarray, observe) -> None:
    if fitted.any() and has_constraints(first_law(scene)):
        raise ValueError("A start on constraints of hybrid motion cannot be fitted: give start=(q0, qdot0).")
    if isinstance(observe, Delayed):
        raise ValueError("Sensors of hybrid motion cannot be lagjax.Delayed: keep the delay, and shift the times.")


def _require_length(recordings: list[Record], longest: float) -> None:
    """Raise `ValueError` for a record of which the delay of its sensors leaves nothing."""
    for place, record in enumerate(recordings):
        if (length := record.ts[-1] - record.ts[0]) < longest:
            raise ValueError(
                f"Record {place} is {length:g} long, shorter than the longest delay of its sensors, {longest:g}: "
                "nothing is left of it. Leave it out, or bound the delay closer."
            )


def _readers(scenes: list[_GivenSystem], residuals: Residuals) -> list[Reader | None] | None:
    """Readers of states off the data, for each record whose signals are positions; None where there is no such record.

    All records of a system together try windows at a few hundred places.
    """
    readers, numbers = [], residuals.parameters.first
    for scene, part in zip(scenes, residuals.parts, strict=True):
        probes = max(8, 256 // len(scene.records))
        readers += [
            build_reader(record, part.system, numbers, probes) if isinstance(record, Record) else None
            for record in scene.records
        ]
    return readers if any(reader is not None for reader in readers) else None


def _cuttable_readers(
    scenes: list[_GivenSystem], readers: list[Reader | None] | None, method: str
) -> list[Reader | None] | None:
    """The readers of records that may be cut into segments: not of hybrid motion, whose mode is known at first only.

    Raises `ValueError` where the method needs some, and there are none for that reason.
    """
    hybrid = [isinstance(scene.system, Hybrid) for scene in scenes for _ in scene.records]
    if method == "segments" and all(hybrid):
        raise ValueError(
            'method="segments" cannot cut hybrid motion, whose mode is known at its start alone: leave it.'
        )
    left = [None if is_hybrid else reader for is_hybrid, reader in zip(hybrid, readers or [], strict=False)]
    return left if any(reader is not None for reader in left) else None


def _starts(residuals: Residuals, readers: list[Reader | None] | None, params0: PyTree) -> np.ndarray:
    """The first guess of the starts of all records, (N, 2n) of the system with the most coordinates."""
    found = []
    for part in residuals.parts:
        own = None if readers is None else readers[part.records]
        with errors_of_system(part.name):
            found += [_start(part.system, own, k, params0) for k in range(len(part.system.records))]
    return np.stack([pad_states(state, residuals.states) for state in found])


def _start(system: SystemResiduals, readers: list[Reader | None] | None, place: int, params0: PyTree) -> np.ndarray:
    record = system.records[place]
    state = known_start(record, system.layout, place, params0)
    if state is not None:
        return state
    reader = None if readers is None else readers[place]
    if reader is None and isinstance(record, Record) and system.signals.look_like_positions(record):
        raise ValueError(UNCLEAR.format(f"records[{place}]"))
    if reader is None:
        raise ValueError(
            f"records[{place}] needs a start, because its values do not have the structure of q: give "
            "start=(q0, qdot0) if it is known, else start=lagjax.Guess(q0, qdot0)."
        )
    return reader.states(np.array([0]))[0]


class _Printer:
    """Prints a line for every trial."""

    def __init__(self, size: np.ndarray):
        self.size, self.trials = size, 0

    def __call__(self, trial) -> None:
        self.trials += 1
        if isinstance(trial, LostTrial):
            text = f"the motion failed. {trial.text.splitlines()[0]}"
        else:
            rms = np.sqrt(np.mean(trial.flat() ** 2, axis=0)) / self.size
            text = f"{len(trial.starts)} motions, residuals {np.exp(np.mean(np.log(rms))):.4g} of the signals"
        print(f"trial {self.trials}: {text}", file=sys.stderr, flush=True)


# ---- what came out ---------------------------------------------------------------------------------------------------


def _build_result(settings: _Settings, descent: Descent, waterfall: Waterfall | None) -> tuple[Fit, Verdict]:
    point, noise, residuals = descent.point, descent.noise, descent.residuals
    parameters, residuals.watch = residuals.parameters, None
    known = information(residuals, point, noise)
    unseen = unseen_sentences(residuals, point, noise, known)
    found = verdict(descent, unseen, known, residuals, settings.noise)
    done = Fit(
        params=parameters.restore(parameters.numbers(point.u)),
        starts=residuals.group_by_system(
            [residuals.restore_state(k, point.starts[row]) for k, row in enumerate(residuals.firsts)]
        ),
        covariance=Covariance(parameters.names, parameters.covariance(point.u, known.covariance)),
        noise=_noise_by_name(residuals, noise, known),
        residuals=residuals.group_by_system(_record_residuals(residuals, point)),
        unseen=unseen,
        ok=found.ok,
        message=found.message,
        log_likelihood=residuals.log_likelihood(point, noise),
        trials=descent.trials,
        waterfall=waterfall,
        records=tuple(residuals.records),
        parameters=parameters,
        u=point.u,
        states=point.starts,
        law=settings.noise,
        information=known,
        noise_scale=noise,
        residual_function=residuals,
        system=settings.system,
        observe=settings.observe,
    )
    return done, found


def _noise_by_name(residuals: Residuals, noise, known: Information) -> dict[str, SignalNoise]:
    samples = (residuals.weights > 0).sum(axis=0)
    columns = zip(noise.sigma, noise.dof, samples, known.effective, 2 * (1 - known.correlation), strict=True)
    return {
        name: SignalNoise(float(sigma), float(dof), int(count), float(effective), float(watson))
        for name, (sigma, dof, count, effective, watson) in zip(residuals.names, columns, strict=True)
    }


def _record_residuals(residuals: Residuals, point) -> list[PyTree]:
    """The residuals of every record in its structure, NaN where nothing was measured."""
    columns = [residuals.columns(k) for k in range(len(residuals.records))]
    found = [
        np.full((len(record), c.stop - c.start), np.nan) for record, c in zip(residuals.records, columns, strict=True)
    ]
    for batch, own in zip(residuals.batches, point.residuals, strict=True):
        for row, left, weights in zip(batch.rows.tolist(), own, batch.weights, strict=True):
            record, places = residuals.pieces[row]
            matrix = np.where(weights > 0, left, np.nan)[: len(places), columns[record]]
            found[record][places] = matrix
    return [restore_structure(matrix, record) for matrix, record in zip(found, residuals.records, strict=True)]
