"""`fit`: the parameters of a scene, and of its forces, from recordings of its motion.

    Record ─► Question ─► segments ─► Descent ─► Information ─► Fit
    measured  flat, one   where the   the least   covariance,    in the user's
    checked   batch       search      squares     null           pytree, in words
                          begins                  directions

Files: `_records`, `_parameters` and `_transforms` take what the user gives; `_motions` and `_signals` follow motions
and sensors with their derivatives; `_residuals` and `_noise` say how far off a trial is, and `_systems` how far one of
several systems; `_segments` says where to begin, and `_weak` where that is far off; `_solve` goes down from there, or
`_gradient`, from many starts by `_many`; `_correlation`, `_uncertainty`, `_joint`, `_unseen`, `_profile`, `_density`,
`_sample`, `_next`, `_report` and `_result` say what that means.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._consistent import has_constraints
from lagjax._fit._blame import reading_params
from lagjax._fit._delays import Delayed
from lagjax._fit._gradient import descend, ended
from lagjax._fit._inputs import HOLDS, Form, asks
from lagjax._fit._many import Waterfall, distinct, drawn, misfit, short_search
from lagjax._fit._motions import motions_of
from lagjax._fit._noise import AbstractNoise, Gaussian, StudentT, log_likelihood
from lagjax._fit._parameters import Parameters
from lagjax._fit._records import Guess, Measured, Piece, Record, in_structure, known_start, require_alike, started
from lagjax._fit._residuals import AbstractQuestion, Failure, Question
from lagjax._fit._result import Covariance, Fit, SignalNoise
from lagjax._fit._segments import Reader, glimpses, levels, time_scale, whole
from lagjax._fit._signals import Signals, looks_like_positions
from lagjax._fit._solve import Anchor, Descent, minimise
from lagjax._fit._starts import Manifold
from lagjax._fit._systems import asked, by_name, naming
from lagjax._fit._timings import Clock, Timings
from lagjax._fit._transforms import angle, between, inertia, positive, simplex
from lagjax._fit._uncertainty import Information, information
from lagjax._fit._unseen import sentences
from lagjax._fit._verdict import verdict
from lagjax._fit._weak import balanced
from lagjax._layout import Layout
from lagjax._problem import DEFAULT_RTOL
from lagjax._system import System, require_system

__all__ = [
    "Delayed",
    "Fit",
    "Gaussian",
    "Guess",
    "Record",
    "StudentT",
    "Timings",
    "angle",
    "between",
    "fit",
    "inertia",
    "positive",
    "simplex",
]  # fmt: skip
PyTree = Any

METHODS = ("auto", "segments", "whole", "gradient")
# In units of half the sum of squares: the end of a search, where parameters are within 0.05 standard deviations of
# independent noise, and, per sample, that of a level of growing segments, whose answer is only where the next begins.
_ENOUGH, _ENOUGH_OF_LEVEL = 1e-3, 1e-2
_ENOUGH_OF_GLIMPSES = 0.1
_POOR, _COARSE = 2.0, 0.02  # times scatter or size of signals: beyond, the shortest segments were not fitted
_LOOSE = 3.0  # standard deviations of u about its first value on these levels, where u is a logarithm or the like
_TRIALS, _TRIALS_OF_LEVEL = 60, 20
_STEPS = 3000  # of a descent by gradients
_BEST = 4  # of many starts go through the whole search


def fit(
    system: System | dict[str, System],
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
    r"""The parameters of a scene that make recordings of its motion likeliest, with what is known about them.

    Minimises Σ w (observe(q(t), q̇(t)) − value)²/σ² over all samples, with one σ per signal, which is estimated too,
    by the free numbers of the parameters and by the start of every record whose start is not known.

    **Arguments**

    - `system`: one scene, or a dict by name of scenes that share parameters: two machines with the same bearings, or
      one that swings freely in some records and is driven in others. `records` is then a dict by the same names, and
      `observe` such a dict or one for all.
    - `records`: one `Record` or several, of any lengths; and `lagjax.Timings`, beside them or alone.
    - `params0`: where the search for the parameters begins, in the structure that the scene's functions ask for.
    - `observe`: a function of (q, qdot), and of `t`, `params`, `inputs` by name, that returns what the sensors show in
      the structure of a record's `values`; by default q. `lagjax.Delayed` where they show it later.
    - `free`: True or False for every parameter, or for whole branches of `params0`; by default all floats are free.
    - `transforms`: `lagjax.positive`, `lagjax.between(a, b)`, `lagjax.angle` or None for every parameter or branch;
      `lagjax.simplex` and `lagjax.inertia` for a whole array. A parameter that is known to be positive should say so:
      its search and its interval are then relative.
    - `noise`: `lagjax.Gaussian()`, the default, or `lagjax.StudentT()` where some samples are far off.
    - `hold`: how the `inputs` of records go on between samples: with "zero" the last one stays, as behind a D/A
      converter; "linear" joins them by lines. Functions of the scene ask for `inputs` by name.
    - `starts`: from how many values of the parameters to search, in one batch: from `params0`, and from random ones by
      `seed`: a decade about a positive number, anywhere between bounds, on a circle or a simplex, and about other
      numbers as far as they are large. The best few go through the whole search, and `params0` always does;
      `Fit.waterfall` has what all of them came to.
    - `progress`: print a line for every trial to stderr.
    - `method`: "whole" begins with whole records. "segments" begins with short segments of them, each with a start of
      its own read off the data, and lets these grow together: for that the signals must have the structure of q. "auto"
      does that where the signals allow it and records are longer than the motion's time scale, so that long and chaotic
      records, and parameters that are far off, find their minimum. "gradient" goes down gradients in reverse mode, by
      Adam of optax: for scenes with neural terms, an `equinox.nn.MLP` in `params0` for instance.

    Intervals count correlated residuals for what they are worth (`Fit.noise`); what cannot be seen in the data is said
    in words (`Fit.unseen`) and has infinite intervals.

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
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(map(repr, METHODS))}; got {method!r}.")
    if hold not in HOLDS:
        raise ValueError(f"hold must be 'zero' or 'linear'; got {hold!r}.")
    noise = Gaussian() if noise is None else noise
    if not isinstance(noise, AbstractNoise):
        raise TypeError(f"noise must be lagjax.Gaussian() or lagjax.StudentT(); got {noise!r}.")
    scenes = _scenes(system, records, params0, observe, hold)
    parameters = Parameters.of(params0, free, transforms, np.result_type(*(scene.layout.dtype for scene in scenes)))
    question = asked({scene.name: _question(scene, parameters) for scene in scenes})
    _require_one_beginning(question, starts, method)
    readers = _readers(scenes)
    if progress:
        question.watch = _Printer(question.size)
    y0 = _starts(scenes, readers, question.states, params0)
    first, told = parameters.moved(parameters.first), (system, observe, question)
    systems = [scene.system for scene in scenes]
    if method == "gradient":
        return _told(*told, _by_gradient(question, systems[0], first, y0, noise, readers), noise, None)
    weak = functools.partial(_weakly, question, systems, readers=readers or [])
    search = functools.partial(_search, question, noise=noise, method=method, readers=readers, weak=weak)
    descent, waterfall = _searches(question, search, first, y0, starts, seed)
    question.watch = None
    return _told(*told, descent, noise, waterfall)


class _Scene(NamedTuple):
    """One system of a fit: its name, None for the only one, its records and sensors, and the structure of its inputs
    and coordinates."""

    name: str | None
    system: System
    records: list[Any]
    observe: Callable | Delayed | None
    form: Form | None
    layout: Layout


def _scenes(system, records, params0, observe, hold: str) -> list[_Scene]:
    """The systems with their records, checked."""
    scenes = []
    for name, one, own, sensors in by_name(system, records, observe):
        with naming(name):
            require_system(one)
            own = require_alike(own)
            form = _form(one, own, hold)
            scenes.append(_Scene(name, one, own, sensors, form, _layout(one, own, params0, form)))
    return scenes


def _require_one_beginning(question: AbstractQuestion, starts: int, method: str) -> None:
    """Raise `ValueError` where many starts, or a descent by gradients, are asked for and cannot be."""
    if method == "gradient" and starts > 1:
        raise ValueError('method="gradient" goes down from one start: leave `starts` at 1.')
    if method == "gradient" and not isinstance(question, Question):
        raise ValueError('method="gradient" is for one system: leave `method` at "auto" for several.')
    for one in [part.question for part in question.parts] if starts > 1 else []:
        if one.signals.delays is not None:
            raise ValueError("starts must be 1 where sensors are lagjax.Delayed: their search has one beginning.")
        if one.manifold is not None and one.fitted.any():
            raise ValueError("starts must be 1 where starts on constraints are fitted: their search has one beginning.")
        if one.clocks:
            raise ValueError("starts must be 1 where there are lagjax.Timings: their search has one beginning.")


def _form(system: System, records: list[Record], hold: str) -> Form | None:
    """The structure of the inputs. Raises `ValueError` where the scene asks for some, and there are none."""
    asking = asks(system)
    for place, record in enumerate(records):
        if asking and (not isinstance(record, Record) or record.input_structure is None):
            raise ValueError(
                f"{asking[0]} asks for `inputs`, which records[{place}] has none of: give Record(..., inputs=...)."
            )
    structures = [record.input_structure for record in records if isinstance(record, Record)]
    if not structures or structures[0] is None:
        return None
    tree, shapes = structures[0]
    return Form(tree, shapes, hold)


def _layout(system: System, records: list[Record], params0, form: Form | None) -> Layout:
    """The structure of the coordinates: that of a start that a record gives, or else that of its values."""
    begun = next((started(record.start, params0) for record in records if record.start is not None), None)
    read_off = begun is None
    if read_off:  # no record is of crossing times: those have starts
        begun = 2 * (jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:]), records[0].values),)
    q, qdot = jax.tree.map(jnp.asarray, begun)
    scene, params = (system, params0) if form is None else (form.driven(system), form.params(params0, 2))
    try:
        jax.eval_shape(lambda q, qdot: scene.energy(q, qdot, 0.0, params), q, qdot)
    except Exception as reason:
        if where := reading_params(reason):
            raise ValueError(
                f"The scene's functions ask for `{where}`, which params0 does not have ({type(reason).__name__}: "
                f"{str(reason).splitlines()[0]}): params0 is {jax.tree.structure(params0)}."
            ) from reason
        if not read_off:
            raise
        raise ValueError(
            "The scene's functions cannot be called with coordinates of the structure of `values`, which q is taken to "
            f"have where no record has a start ({type(reason).__name__}: {str(reason).splitlines()[0]}). If the values "
            "are something else, give every record start=(q0, qdot0), or lagjax.Guess(q0, qdot0) to fit it."
        ) from reason
    return Layout.of(q, qdot)


def _question(scene: _Scene, parameters: Parameters) -> Question:
    """The question about whole records of one system."""
    with naming(scene.name):
        return _about(*scene[1:], parameters)


def _about(system, records, observe, form, layout, parameters) -> Question:
    rtol = DEFAULT_RTOL[layout.dtype]
    motions = motions_of(system, layout, parameters, rtol, None, form)
    recordings = [record for record in records if isinstance(record, Record)]
    if isinstance(observe, Delayed):
        _require_longer(recordings, observe.longest)
    signals = Signals(observe, layout, parameters, recordings[0] if recordings else None, form)
    size = _sizes(recordings)
    timings = {k: record for k, record in enumerate(records) if isinstance(record, Timings)}
    clocks = {k: Clock(system, layout, parameters, record, rtol) for k, record in timings.items()}
    if timings:
        size = np.append(size, max(np.ptp(record.ts) for record in timings.values()))
    fitted = np.array([record.start is None or isinstance(record.start, Guess) for record in records])
    manifold = None
    if has_constraints(system) and not asks(system):
        manifold = Manifold(system, layout, parameters, motions.projection)
    elif has_constraints(system) and fitted.any():
        raise ValueError("A start on constraints of a scene with `inputs` cannot be fitted: give start=(q0, qdot0).")
    return Question(
        records, whole(records), fitted, motions, signals, parameters, np.where(size > 0, size, 1.0), rtol, clocks,
        manifold,
    )  # fmt: skip


def _require_longer(recordings: list[Record], longest: float) -> None:
    """Raise `ValueError` for a record of which the delay of its sensors leaves nothing."""
    for place, record in enumerate(recordings):
        if (length := record.ts[-1] - record.ts[0]) < longest:
            raise ValueError(
                f"Record {place} is {length:g} long, shorter than the longest delay of its sensors, {longest:g}: "
                "nothing is left of it. Leave it out, or bound the delay closer."
            )


def _sizes(recordings: list[Record]) -> np.ndarray:
    """The root mean square of each signal; of none without recordings."""
    if not recordings:
        return np.zeros(0)
    return np.sqrt(np.nanmean(np.concatenate([record.matrix for record in recordings]) ** 2, axis=0))


def _readers(scenes: list[_Scene]) -> list[Reader | None] | None:
    """What reads states off the data, for each record whose signals are positions; None where there is no such record.

    All records of a system together try windows at a few hundred places.
    """
    readers = []
    for scene in scenes:
        first = next((record for record in scene.records if isinstance(record, Record)), None)
        reads, probes = first is not None and looks_like_positions(scene.observe, first, scene.layout), 256
        probes = max(8, probes // len(scene.records))
        readers += [
            Reader.of(record, probes) if reads and isinstance(record, Record) else None for record in scene.records
        ]
    return readers if any(reader is not None for reader in readers) else None


def _starts(scenes: list[_Scene], readers: list[Reader | None] | None, states: int, params0) -> np.ndarray:
    """Where the search for the starts of all records begins, (N, 2n) of the system with the most coordinates."""
    found, first = [], 0
    for scene in scenes:
        own = None if readers is None else readers[first : first + len(scene.records)]
        with naming(scene.name):
            found += [_start(record, own, scene.layout, k, params0) for k, record in enumerate(scene.records)]
        first += len(scene.records)
    return np.stack([_roomy(state, states) for state in found])


def _roomy(state: np.ndarray, states: int) -> np.ndarray:
    """States (..., 2n) of a system, with zeros up to those of the one with the most coordinates."""
    return np.concatenate([state, np.zeros((*state.shape[:-1], states - state.shape[-1]))], axis=-1)


def _start(record: Measured, readers: list[Reader | None] | None, layout: Layout, place: int, params0) -> np.ndarray:
    """Where the search for the start of one record begins, (2n,)."""
    state = known_start(record, layout, place, params0)
    if state is not None:
        return state
    reader = None if readers is None else readers[place]
    if reader is None:
        raise ValueError(
            f"records[{place}] needs a start, because its values do not have the structure of q: give "
            "start=(q0, qdot0) if it is known, else start=lagjax.Guess(q0, qdot0)."
        )
    return reader.states(np.array([0]))[0]


def _by_gradient(question, system: System, u, y0, noise, readers) -> Descent:
    """The descent by gradients: over segments of the records that grow, where they can be read, then over all."""
    told, question.watch = question.watch, None
    tell = None if told is None else lambda text: print(text, file=sys.stderr, flush=True)
    steps = _STEPS
    if readers is not None:
        u = _over_segments(question, system, _weakly(question, [system], u, readers), noise, readers, tell)
        steps = _STEPS // 3
    done = descend(question, system, u, y0, noise, steps, tell)
    if not isinstance(done, Failure):
        done = ended(question, done[0], done[1], noise, _STEPS, done[2])
    if isinstance(done, Failure):
        raise ValueError(question.where(done) + " Begin nearer: other params0, or starts that are known.")
    return done


def _time_scales(question: AbstractQuestion, readers: list[Reader | None], u) -> list[float]:
    """How long the motion of each record looks like a straight line: of all records of a system the same.

    It is infinite for a system of which no state can be read off.
    """
    scales, numbers = [], question.parameters.numbers(u)
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale = time_scale(reading, part.question.motions, numbers) if reading else np.inf
        scales += [scale] * len(part.question.records)
    return scales


def _weakly(question: AbstractQuestion, systems: list[System], u, readers: list[Reader | None]) -> np.ndarray:
    """The u that balances the weak form of Lagrange's equations, u itself where there is none."""
    scales = _time_scales(question, readers, u)
    found = balanced(
        [
            (part.question, system, readers[part.records], scales[part.records.start])
            for part, system in zip(question.parts, systems, strict=True)
        ],
        u,
    )
    return u if found is None else found


def _over_segments(question: Question, system: System, u, noise, readers, tell) -> np.ndarray:
    """The u that two thirds of the steps come to over segments that grow, each with a start of its own."""
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    for pieces in [] if question.clocks else cuts:
        states = np.stack([readers[piece.record].states(piece.places[:1])[0] for piece in pieces])
        part = question.of(pieces, np.ones(len(pieces), bool))
        done = descend(part, system, u, states, noise, 2 * _STEPS // (3 * len(cuts)), tell)
        if not isinstance(done, Failure):
            u = done[0]
    return u


def _searches(question: AbstractQuestion, search, u, y0, starts: int, seed: int) -> tuple[Descent, Waterfall | None]:
    """The best of the searches from u and from `starts` − 1 random values, and what all of them came to."""
    if starts == 1:
        return search(u, y0), None
    trials = short_search(question, drawn(question.parameters, u, starts, seed), y0)
    misfits, done = trials.misfits.copy(), []
    chosen = distinct(trials, _BEST)
    for place, at in [*((k, (trials.u[k], trials.starts[k])) for k in chosen), (None, (u, y0))]:
        try:
            done.append(search(*at))
        except ValueError:
            if not done and place is None:
                raise  # not one start could be followed
            continue
        if place is not None:
            misfits[place] = misfit(done[-1].widths, question)
    best = max(done, key=lambda one: log_likelihood(one.widths, one.point.flat(), question.weights))
    misfits = np.sort(misfits)
    misfits[0] = min(misfits[0], misfit(best.widths, question))
    return best, Waterfall(misfits)


class _Printer:
    """Prints a line for every trial."""

    def __init__(self, size: np.ndarray):
        self.size, self.trials = size, 0

    def __call__(self, trial) -> None:
        self.trials += 1
        if isinstance(trial, Failure):
            text = f"the motion failed. {trial.text.splitlines()[0]}"
        else:
            rms = np.sqrt(np.mean(trial.flat() ** 2, axis=0)) / self.size
            text = f"{len(trial.starts)} motions, residuals {np.exp(np.mean(np.log(rms))):.4g} of the signals"
        print(f"trial {self.trials}: {text}", file=sys.stderr, flush=True)


def _search(question: AbstractQuestion, u, starts, noise, method: str, readers, weak) -> Descent:
    """The search of whole records, after that of growing segments where the method asks for it."""
    if method == "segments" and readers is None:
        raise ValueError('method="segments" reads starts off the data: for that values must have the structure of q.')
    if method != "whole" and readers is not None:
        u, starts = _grown(question, u, starts, noise, readers, weak)
    done = minimise(question, u, starts, noise, _ENOUGH, _TRIALS)
    if isinstance(done, Failure):
        raise ValueError(question.where(done) + " Begin nearer: other params0, or starts that are known.")
    return done


class _Begun(NamedTuple):
    """Where growing segments begin: u, the cuts, the states at the first samples, and how far off that is."""

    u: np.ndarray
    cuts: list[list[Piece]]
    best: dict[tuple[int, int], np.ndarray]
    misfit: float


def _grown(
    question: AbstractQuestion, u, starts, noise, readers: list[Reader | None], weak: Callable
) -> tuple[np.ndarray, np.ndarray]:
    """Better first values of u and of the starts, from segments that grow together to whole records."""
    anchor = Anchor(u, np.where(np.isfinite(question.parameters.reach), 1.0 / _LOOSE, 0.0))
    search = functools.partial(_level, question, noise=noise, readers=readers, anchor=anchor)
    begun = _begun(question, u, starts, readers, search)
    for other in (lambda: weak(u), lambda: _glimpsed(question, u, noise, readers, anchor)):
        if begun.misfit > 0.0:  # the shortest segments were not fitted from here
            begun = min(begun, _begun(question, other(), starts, readers, search), key=lambda one: one.misfit)
    u, best = begun.u, begun.best
    for pieces in begun.cuts[1:]:
        done = search(pieces, u, best)
        if isinstance(done, Failure):
            break  # whole records then begin from the best so far, and say so if they fail as well
        u = done.point.u
    return u, np.stack([best[k, 0] for k in range(len(question.records))])


def _begun(question: AbstractQuestion, u, starts, readers: list[Reader | None], search) -> _Begun:
    """The search on the shortest segments, from u, whose misfit is positive where they were not fitted.

    It is the mean logarithm of the noise σ of the signals, over `_POOR` times the scatter of the data or a share
    `_COARSE` of the signals' size, whichever is larger.
    """
    recordings = [None if reader is None else reader.record for reader in readers]
    cuts = levels(recordings, _time_scales(question, readers, u))
    best = {(k, 0): start for k, start in enumerate(starts)}
    if not cuts:
        return _Begun(u, cuts, best, -np.inf)
    done = search(cuts[0], u, best)
    if isinstance(done, Failure):
        return _Begun(u, cuts, best, np.inf)
    near = []
    for part in question.parts:
        if reading := [reader for reader in readers[part.records] if reader is not None]:
            scatter = np.sqrt(np.mean([np.square(reader.scatter) for reader in reading], axis=0))
            near.append(np.maximum(_POOR * scatter, _COARSE * part.question.size[: len(scatter)]))
    ratio = done.widths.sigma / np.concatenate(near)
    return _Begun(done.point.u, cuts, best, float(np.mean(np.log(ratio))))


def _level(question: AbstractQuestion, pieces: list[Piece], u, best, noise, readers, anchor) -> Descent | Failure:
    """The search on one cut of the records. The states in `best`, by record and sample, begin it and take its end."""
    firsts = [(piece.record, int(piece.places[0])) for piece in pieces]
    for k, reader in enumerate(readers):
        new = [place for record, place in firsts if record == k and (k, place) not in best]
        if new and reader is not None:
            read = _roomy(reader.states(np.array(new)), question.states)
            best |= {(k, place): y for place, y in zip(new, read, strict=True)}
    part = question.of(pieces, np.array([question.fitted[k] or place > 0 for k, place in firsts]))
    y0 = np.stack([best[first] for first in firsts])
    done = minimise(part, u, y0, noise, _ENOUGH_OF_LEVEL * part.measured, _TRIALS_OF_LEVEL, anchor)
    if not isinstance(done, Failure):
        best |= dict(zip(firsts, done.point.starts, strict=True))
    return done


def _glimpsed(question: AbstractQuestion, u, noise, readers: list[Reader | None], anchor: Anchor) -> np.ndarray:
    """The u that suits the accelerations of local cubics: these have one minimum where segments are too long for u."""
    scales, short, states = _time_scales(question, readers, u), {}, []
    for part in question.parts:
        reading = [reader for reader in readers[part.records] if reader is not None]
        scale, about = scales[part.records.start], part.question
        if not (reading and np.isfinite(scale)):
            continue
        records, begun = glimpses(reading, 0.25 * scale)
        states.append(_roomy(begun, question.states))
        short[part.name] = Question(
            records, whole(records), np.ones(len(records), bool), about.motions, about.signals, about.parameters,
            about.size, about.rtol,
        )  # fmt: skip
    if not short:
        return u
    part = asked(short)
    y0 = np.concatenate(states)[:, : part.states]
    done = minimise(part, u, y0, noise, _ENOUGH_OF_GLIMPSES, _TRIALS_OF_LEVEL, anchor)
    return u if isinstance(done, Failure) else done.point.u


# ---- what came out ---------------------------------------------------------------------------------------------------


def _told(
    system, observe, question: AbstractQuestion, descent: Descent, law: AbstractNoise, waterfall: Waterfall | None
) -> Fit:
    """The result in the user's structures and in words."""
    point, widths, parameters = descent.point, descent.widths, question.parameters
    known = information(question, point, widths)
    unseen = sentences(question, point, widths, known.null)
    return Fit(
        params=parameters.restore(parameters.numbers(point.u)),
        starts=question.by_system([question.restored(k, y) for k, y in enumerate(point.starts)]),
        covariance=Covariance(parameters.names, parameters.covariance(point.u, known.covariance)),
        noise=_noise_by_name(question, widths, known),
        residuals=question.by_system(_by_record(question, point)),
        unseen=unseen,
        ok=descent.converged and not unseen,
        message=verdict(descent, unseen, known, question),
        log_likelihood=log_likelihood(widths, point.flat(), question.weights),
        trials=descent.trials,
        waterfall=waterfall,
        records=tuple(question.records),
        parameters=parameters,
        u=point.u,
        states=point.starts,
        law=law,
        information=known,
        widths=widths,
        question=question,
        system=system,
        observe=observe,
    )


def _noise_by_name(question: AbstractQuestion, widths, known: Information) -> dict[str, SignalNoise]:
    samples = (question.weights > 0).sum(axis=0)
    columns = zip(widths.sigma, widths.dof, samples, known.effective, 2 * (1 - known.correlation), strict=True)
    return {
        name: SignalNoise(float(sigma), float(dof), int(count), float(effective), float(watson))
        for name, (sigma, dof, count, effective, watson) in zip(question.names, columns, strict=True)
    }


def _by_record(question: AbstractQuestion, point) -> list[PyTree]:
    found: dict[int, PyTree] = {}
    for batch, residuals in zip(question.batches, point.residuals, strict=True):
        for row, left, weights in zip(batch.rows.tolist(), residuals, batch.weights, strict=True):
            record = question.records[row]
            matrix = np.where(weights > 0, left, np.nan)[: len(record), question.columns(row)]
            found[row] = in_structure(matrix, record)
    return [found[row] for row in range(len(question.records))]
