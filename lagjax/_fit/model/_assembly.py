"""Assembly: the residuals of scenes and records as the user gives them, all of it checked."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax._engine import DEFAULT_RTOL
from lagjax._equations import has_constraints
from lagjax._fit.model._inputs import InputForm, input_functions
from lagjax._fit.model._law_parameters import plain_dicts
from lagjax._fit.model._motions import Manifold, choose_motions
from lagjax._fit.model._noise import AbstractNoise, Sensor, StudentT, read_sensor
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.model._pieces import whole_pieces
from lagjax._fit.model._records import Guess, Record, require_interpolation, require_records, start_pair
from lagjax._fit.model._residuals import Residuals, SystemResiduals
from lagjax._fit.model._sensor_faults import constant_signals, require_measurements
from lagjax._fit.model._sensors import Delayed, require_no_jumps, sensors
from lagjax._fit.model._signals import Signals
from lagjax._fit.model._timings import Clock, Timings, build_clock
from lagjax._interface import Layout, find_expression
from lagjax._primitives import DOUBLE
from lagjax._run.hybrid import Scene, first_law, may_jump, require_scene

_HOLDING = "constraints", "contacts", "one_way", "slip"  # the ends of roles of functions that hold a start


class GivenSystem(NamedTuple):
    """One system of a fit, its arguments checked; `name` is None for the only one."""

    name: str | None
    system: Scene
    records: list[Any]
    observe: Callable | Delayed | None
    form: InputForm | None
    layout: Layout


def read_systems(system, records, params0: PyTree, observe, hold: str) -> list[GivenSystem]:
    found = []
    for name, one, own, shown in _systems_by_name(system, records, observe):
        with errors_of_system(name):
            one, own = require_scene(one), require_records(own)
            form = _read_form(one, own, hold)
            found.append(GivenSystem(name, one, own, shown, form, _read_layout(one, own, params0, form)))
    return found


def assemble_residuals(given: list[GivenSystem], parameters: Parameters, law: AbstractNoise) -> Residuals:
    """The residuals of all systems. Raises `ValueError` for records that no motion of a scene can have."""
    systems, motions = [], []
    for one in given:
        with errors_of_system(one.name):
            systems.append(_assemble_system(one, parameters, law))
        first = len(motions)
        places = {id(record): first + k for k, record in enumerate(one.records)}
        motions += [places.get(id(record.start), first + k) for k, record in enumerate(one.records)]
    return Residuals(systems, parameters.select(motions), motions=np.array(motions))


def _assemble_system(given: GivenSystem, parameters: Parameters, law: AbstractNoise) -> SystemResiduals:
    name, system, records, observe, form, layout = given
    motions = choose_motions(system, layout, parameters, DEFAULT_RTOL, form)
    recordings = [record for record in records if isinstance(record, Record)]
    if isinstance(observe, Delayed):
        for place, record in enumerate(recordings):
            if (length := record.ts[-1] - record.ts[0]) < observe.longest:
                raise ValueError(
                    f"Record {place} is {length:g} long, shorter than the longest delay of its sensors, "
                    f"{observe.longest:g}: nothing is left of it. Leave it out, or bound the delay closer."
                )
    signals = Signals(observe, layout, parameters, recordings[0] if recordings else None, form)
    _require_motion(given, recordings, signals)
    if not isinstance(law, StudentT):
        require_measurements(recordings, signals.names, signals.periods)
    sensor = read_sensor(recordings, law, signals.names, signals.periods)
    every = np.concatenate([record.matrix for record in recordings]) if recordings else np.zeros((1, 0))
    size = np.sqrt(np.nanmean(every**2, axis=0))  # root mean squares
    timings = {k: record for k, record in enumerate(records) if isinstance(record, Timings)}
    clocks = {k: _build_clock(given, parameters, record) for k, record in timings.items()}
    if timings:
        size = np.append(size, max(np.ptp(record.ts) for record in timings.values()))
        sensor = Sensor(*(np.append(x, np.nan) for x in sensor))
    fitted = np.array([record.begins is None or isinstance(record.begins, Guess) for record in records])
    manifold, scene = None, first_law(system)
    if may_jump(system) and isinstance(observe, Delayed):
        raise ValueError("Sensors of contacts and hybrid motion cannot be lagjax.Delayed: shift the times instead.")
    asking = input_functions(scene)
    if (has_constraints(scene) or scene.touches) and not any(role.endswith(_HOLDING) for role in asking):
        manifold = Manifold(scene, layout, parameters, motions.projection, form if asking else None)
    elif has_constraints(scene) and fitted.any():
        raise ValueError("A start on constraints that ask for `inputs` cannot be fitted: give start=(q0, qdot0).")
    return SystemResiduals(
        name, system, records, whole_pieces(records), fitted, motions, signals, parameters.restore,
        np.where(size > 0, size, 1.0), DEFAULT_RTOL, clocks, manifold, sensor,
    )  # fmt: skip


def _build_clock(given: GivenSystem, parameters: Parameters, timings: Timings) -> Clock:
    """The clock of timings, with the inputs of the record of the same motion."""
    scene, restore, record = given.system, parameters.restore, timings.start
    if given.form is not None and isinstance(record, Record):
        bind = functools.partial(given.form.bind_samples, ts=record.sampled_at, inputs=record.input_samples)
        scene, restore = (
            bind(scene, restore(parameters.example))[0],
            lambda x: bind(given.system, parameters.restore(x))[1],
        )
    return build_clock(scene, given.layout, restore, restore(parameters.example), timings, DEFAULT_RTOL)


def _require_motion(given: GivenSystem, recordings: list[Record], signals: Signals) -> None:
    """Raise `ValueError` where signals, but of hybrid motion, jump by a period, or where starts are fitted to rest."""
    of_state, wrap = sensors(given.observe)
    for place, record in enumerate(given.records):
        if isinstance(record, Record) and not may_jump(given.system) and wrap is None:
            require_no_jumps(record, f"records[{place}]", signals.names, of_state is None)
    still = constant_signals(recordings, signals.names)
    if len(still) == len(signals.names) * len(given.records) > 0 and all(one.begins is None for one in given.records):
        raise ValueError(f"{still[0]} So it is with all signals of all records: nothing moves that could be fitted.")


def _read_form(system: Scene, records: list[Record], hold: str) -> InputForm | None:
    asking = input_functions(system)
    for place, record in enumerate(records):
        motion = record.start if isinstance(record.start, Record) else record
        if asking and (not isinstance(motion, Record) or motion.input_structure is None):
            none = f"which records[{place}] has none of: give Record(..., inputs=...)."
            raise ValueError(f"{asking[0]} asks for `inputs`, {none}")
    structures = [record.input_structure for record in records if isinstance(record, Record)]
    if not structures or structures[0] is None:
        return None
    for place, record in enumerate(records):
        require_interpolation(record, hold, f"records[{place}]")
    tree, shapes = structures[0]
    return InputForm(tree, shapes, hold)


def _read_layout(system: Scene, records: list[Record], params0, form: InputForm | None) -> Layout:
    """The structure of the coordinates: that of a start that a record gives, or else that of its values."""
    place = next((k for k, record in enumerate(records) if record.begins is not None), None)
    if place is not None:
        begun = start_pair(records[place].begins, params0)
    else:  # crossing times have starts, or are those of a record
        values = next(record.values for record in records if isinstance(record, Record))
        begun = 2 * (jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:]), values),)
    q, qdot = jax.tree.map(jnp.asarray, begun)
    scene, params = first_law(system), params0
    if form is not None:
        scene, params = form.drive_system(scene), form.params(params0, 2)
    try:
        jax.eval_shape(lambda q, qdot: scene.energy(q, qdot, 0.0, params), q, qdot)
    except Exception as reason:
        said = f"({type(reason).__name__}: {str(reason).splitlines()[0]})"
        if where := find_expression(reason, "params"):
            given = jax.tree.structure(plain_dicts(params0))
            text = f"ask for `{where}`, which params0 does not have {said}: params0 is {given}."
        elif place is not None:
            text = f"cannot be called with the start of records[{place}] {said}: give it in the structure of q."
        else:
            text = (
                "cannot be called with coordinates of the structure of `values`, which q is taken to have where no "
                f"record has a start {said}. If the values are something else, give every record start=(q0, qdot0), or "
                "lagjax.Guess(q0, qdot0) to fit it."
            )
        raise ValueError(f"The scene's functions {text}") from reason
    return replace(Layout.from_state(q, qdot), dtype=DOUBLE)


def _systems_by_name(system, records, observe) -> list[tuple[str | None, Any, Any, Any]]:
    """Name, system, records and `observe` of every system. Raises where not all are dicts by the same names."""
    if not isinstance(system, dict):
        for what, given in (("records", records), ("observe", observe)):
            if isinstance(given, dict):
                raise TypeError(f"{what} is a dict, so system must be a dict of systems by the same names.")
        return [(None, system, records, observe)]
    if not system:
        raise ValueError("system is an empty dict: give at least one lagjax.System by its name.")
    for name in system:
        if not isinstance(name, str):
            raise TypeError(f"The systems of a fit have names; {name!r} is no str.")
    shown = observe if isinstance(observe, dict) else dict.fromkeys(system, observe)
    _require_names("records", records, system)
    _require_names("observe", shown, system)
    return [(name, one, records[name], shown[name]) for name, one in system.items()]


def _require_names(what: str, given, systems: dict) -> None:
    names = ", ".join(map(repr, systems))
    if not isinstance(given, dict):
        raise TypeError(
            f"system is a dict, so {what} must be a dict by the same names, {names}; got {type(given).__name__}."
        )
    if lacking := [name for name in systems if name not in given]:
        raise ValueError(f"{what} has nothing for the system {lacking[0]!r}: it needs the names {names}.")
    if beyond := [name for name in given if name not in systems]:
        raise ValueError(f"{what} has {beyond[0]!r}, which is the name of no system: these are {names}.")


@contextlib.contextmanager
def errors_of_system(name: str | None) -> Iterator[None]:
    """Errors that are raised in this context begin with the name of the system, where there are several."""
    try:
        yield
    except (TypeError, ValueError) as reason:
        if name is None or type(reason) not in (TypeError, ValueError):
            raise
        raise type(reason)(f"Of the system {name!r}: {reason}") from reason
