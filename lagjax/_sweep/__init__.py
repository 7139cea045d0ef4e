"""`sweep`: simulate one scene for many starts and parameters, and store a few numbers of each motion on disk.

The members are divided into units of work. A store (a folder) contains the whole job: the description, the functions,
and the units that are done; any number of workers compute the others, and readers open it as xarray.

over, q0, keep, … ──► Description, Grid ──► Files ──► units, computed by any number of workers ──► xarray

_members       the points of a sweep: axes, the grid of members, its units (`lagjax.designs` has the rules for axes)
_statistics    statistics of all members, unit by unit, without a list of their values
_description   the scene and the user's functions; their text, by which stores are compared; how a worker gets them
_files         the files of a store
_batch         a batch of members: their motions, the crossings on the way, what is kept of each
_job           a store with its functions in a process; the computation of a unit
_begin         creates a store, or checks that the description of an existing one is the same
_extend        copies members, or the starts of motions that continue, from another store
_workers       finds the units that are still to be computed, and computes them here or by executors
_status        the progress of a store
"""

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax._interface import output_times, require_flag
from lagjax._run.hybrid import Hybrid, Scene, may_jump, require_scene
from lagjax._show import import_package
from lagjax._sweep._begin import check_store, create_store
from lagjax._sweep._description import Description, Sections, uses_doubles
from lagjax._sweep._files import NOT_DONE, RESULT, Files
from lagjax._sweep._job import Job, set_precision
from lagjax._sweep._members import axes_of
from lagjax._sweep._statistics import Statistics, Summary, merge_statistics, statistics_from_bytes, summarize
from lagjax._sweep._status import Progress, Status, read_status
from lagjax._sweep._workers import compute_units, require_executor, require_part, run_store, submit, units_to_compute


@dataclass(frozen=True)
class Store:
    """A folder for `lagjax.sweep`, and what is settled with it: its units, and how accurately motions are followed.

    `sweep(…, store="map.zarr")` is `sweep(…, store=lagjax.Store("map.zarr"))`.

    - `path`: the folder.
    - `unit`: the number of members in a unit of work. A unit is a chunk of the store, and all that is lost with a
      worker that dies. By default as many as take 20 s here, with at most 64 MiB of kept quantities.
    - `part`: (k, n) computes every n-th unit from the k-th on, as task k of an array of n batch jobs, counted from 0.
      The tasks share the disk; whichever is first begins the store. What a task that died has left, a later run of
      any part, or of the whole, computes.
    - `extend`: a store of the same scene, from which the members that are also in `over` are copied, for more members
      of a design or a finer grid. It is not changed. For a later end let `keep` return {"end": trajectory.end, …}, and
      give `ts` that begin at the last time of that store: its motions continue from there, and `keep` sees the rest of
      them. Members that ended before that time keep their `result`. Once begun, a store does not need the other one.
    - `rtol`, `atol`, `max_steps`, `event`, `solver`: as in `simulate_batch`.
    - `crossings`: arguments of `lagjax.crossings`, {"section": …, "direction": …, "count": …}. Then `keep(trajectory,
      crossings)` also gets the `Crossings` of that motion, which does not end at them: the time of the first event and
      the final state come from one run, if `ts` are two times.

    `event`, `crossings`, `solver` and a later end are not for a `Hybrid`, whose transitions watch the motion.

    ```python
    import lagjax

    store = lagjax.Store("map.zarr", unit=10_000, rtol=1e-6)
    ```
    """

    path: str | Path
    unit: int | None = None
    part: tuple[int, int] = (0, 1)
    extend: str | Path | None = None
    rtol: float | None = None
    atol: float | None = None
    max_steps: int = 65_536
    event: Any = None
    crossings: dict[str, Any] | None = None
    solver: Any = None


@dataclass(frozen=True)
class Sweep:
    """A sweep that was begun, known by the path of its `store`: its members, progress, statistics and damage.

    `lagjax.Sweep(path)` opens a store without the script that made it. `print` it for its status.

    **Raises** `FileNotFoundError` or `ValueError` where there is no store that can be read.
    """

    store: Path

    def __post_init__(self):
        object.__setattr__(self, "store", Path(self.store))
        Files(self.store).spec()

    def __repr__(self) -> str:
        return str(self.status())

    def open(self):
        """The members as an `xarray.Dataset`, with the names of `over` as coordinates; read when it is looked at.

        Members of units whose chunks are not there have the `result` −1, "not_done", and a warning names them;
        `xarray.open_zarr(store)`, which looks at each array alone, would show their numbers as missing and their
        `result` as it was. A chunk whose bytes have changed raises an error of zarr when it is read: run the sweep
        again, which computes it again.

        Raises `ImportError` when xarray is not installed.
        """
        xarray = import_package("Sweep.open()", "xarray", "xarray")
        store = Files(self.store)
        spec = store.spec()
        store.require_arrays(spec)
        data = xarray.open_zarr(self.store)
        damaged = store.find_damage(spec, store.finished_units())
        if not damaged:
            return data
        for text in damaged.values():
            warnings.warn(f"{self.store}: {text}. Run the sweep again: it computes them again.", stacklevel=2)
        result = data[RESULT.name].load()  # attributes and coordinates stay
        for unit in set(range(store.grid(spec).unit_count)) & set(damaged):
            result.values[store.grid(spec).box(unit)] = NOT_DONE
        return data.assign({RESULT.name: result})

    def status(self) -> Status:
        """The progress: units that are done, the ends of members, those that failed, and the worst change of energy."""
        return read_status(Files(self.store))

    def statistics(self) -> dict[str, Summary]:
        """The statistics named in `reduce` over all finished units, by the names of the quantities."""
        store = Files(self.store)
        spec, totals = store.spec(), {}
        for unit in sorted(store.finished_units()) if spec["reduce"] else ():
            for name, part in statistics_from_bytes(store.statistics(unit)).items():
                totals[name] = merge_statistics(totals.get(name), part)
        shapes = {q["name"]: tuple(q["shape"]) for q in spec["kept"]}
        return {name: summarize(Statistics(**spec["reduce"][name]), x, shapes[name]) for name, x in totals.items()}

    def damaged(self) -> dict[int, str]:
        """The damage of finished units, in words by units. All are read; the next run computes these again."""
        store = Files(self.store)
        return store.find_damage(store.spec(), store.finished_units(), whole=True)


def sweep(
    system: Scene,
    over: dict,
    ts: jax.Array | Callable,
    *,
    q0: PyTree,
    qdot0: PyTree,
    params: PyTree = None,
    keep: Callable,
    reduce: dict[str, Statistics] | None = None,
    store: Store | str | Path,
    executor: Any = None,
    progress: bool = True,
) -> Sweep:
    r"""Run `system` for every point of `over`, keep a few numbers of each motion, and store them in a folder.

    The store is the job. Called again with the same description, `sweep` computes what is missing, also after a
    failure of the machine at any moment; so does `python -m lagjax sweep run STORE`. First each reads what is done of
    its units, and computes again what is not as it was written; for a million units that takes six minutes, and a
    second more for each gigabyte. Several machines work by an `executor`, or each on its part of the units.

    **Run only stores of your own**: `python -m lagjax sweep run`, and an `executor` unpickle the functions in
    the store, which can be any code.

    **What runs**

    - `system`: a `System`, or a `Hybrid`, of which `keep` gets the trajectory that `simulate` returns.
    - `over`: a dict of axes, of which the product is swept. A 1-D array is an axis by its name; a design of
      `lagjax.designs` (`random`, `sobol`, `latin_hypercube`) draws its values by a rule; a tuple of names with a tuple
      of arrays, or with a design, varies several together. There may be 10⁸ members: they are never listed.
    - `ts`: output times, shape (T,), of all members, or a function of one member's point that returns those of this
      member, as many for each: `ts=lambda point: point["period"] * np.linspace(0.0, 10.0, 101)`.
    - `q0`, `qdot0`, `params`: values for all, or functions of one member's point, which is a dict of numbers by the
      names in `over`.

    **What is kept**

    - `keep(trajectory)`: a dict of what remains of a member, numbers or arrays by names, from its `Trajectory`.
    - `reduce`: for quantities that are too many to keep, a dict of `lagjax.Statistics` by their names: count, mean,
      variance, extremes with their members, histogram, quantiles. These are merged in the order of the units and stored
      instead of the members' values; `Sweep.statistics()` reads them.
    - `store`: a folder, or a `lagjax.Store` with tolerances, events, crossings, the size of units, a part of them, or
      another store to extend. `xarray.open_zarr(path)` reads it, with the names of `over` as dimensions and
      coordinates, the kept quantities as variables, and `result`: how each member ended, −1 for those still to do.
      Missing values are NaN, or the least integer of an integer type.

    **Where it runs**

    - `executor`: any `concurrent.futures.Executor`, such as dask's `client.get_executor()`; a task is a unit. By
      default this process works, with the machine code's threads on all cores. A member that kills its process, by
      memory or by a library of its own, costs a worker of an executor, and the error names its unit:
      `ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))`.
    - `progress`: a line on stderr.

    A store knows the scene and `keep` by their code and by all that this reads: helpers, globals, closures, classes
    with all their attributes, modules imported inside. What it cannot know is what a function reads from files, from
    the environment, or by names that it makes up (`globals()["c"]`): after such a change take another store.

    Members that fail cost the others nothing: `result` says how each ended, `print(sweep)` names them. Functions
    written in jax.numpy are compiled for all members at once. Others are called member by member, and the status says
    so; a member for which `keep` then raises, or returns another shape, is `keep_failed`. On machines of one kind of
    CPU the numbers are the same, bit for bit, whichever worker computes which unit.

    Memory, beside Python and JAX: a unit of kept quantities (64 MiB), and a few times the path of a batch (64 MiB).

    **Raises** `TypeError` or `ValueError` for what cannot be right, before anything is computed, and for a store that
    was begun with another description, saying what differs; `OSError` for a disk that is full or read-only,
    `ImportError` without the packages zarr and cloudpickle, `RuntimeError` for a worker that died.

    Source: Salmon et al., SC 2011, for the counter-based draws.

    ```python
    import jax, jax.numpy as jnp, numpy as np, tempfile, lagjax
    jax.config.update("jax_enable_x64", True)

    pendulum = lagjax.System(lambda q, qdot, params: 0.5 * params**2 * qdot**2 + 9.81 * params * jnp.cos(q))
    swept = lagjax.sweep(
        pendulum,
        {"length": np.linspace(0.5, 1.5, 11), "angle": np.linspace(0.0, 3.0, 16)},
        jnp.linspace(0.0, 5.0, 51),
        q0=lambda point: point["angle"],
        qdot0=0.0,
        params=lambda point: point["length"],
        keep=lambda trajectory: {"fastest": jnp.abs(trajectory.qdot).max()},
        store=tempfile.mkdtemp() + "/pendulums.zarr",
        progress=False,
    )
    assert swept.open().fastest.dims == ("length", "angle")
    ```
    """
    system = require_scene(system)
    require_flag(progress, "progress")
    settled = store if isinstance(store, Store) else Store(store)
    settings = {name: getattr(settled, name) for name in ("rtol", "atol", "max_steps", "event", "solver")}
    given = [name for name in ("event", "crossings", "solver") if getattr(settled, name) is not None]
    if given and may_jump(system):
        raise ValueError(
            f"{' and '.join(given)} of sweep: for the motion of one System without contacts. Transitions watch a "
            "hybrid motion, in machine code; one without a reset notes where it is crossed, and "
            "`trajectory.transitions` tells when."
        )
    if not callable(keep):
        raise TypeError(f"keep must be a function of a trajectory that returns a dict; got {keep!r}.")
    reduce = {} if reduce is None else reduce
    if not isinstance(reduce, dict) or not all(isinstance(how, Statistics) for how in reduce.values()):
        raise TypeError("reduce must be a dict of lagjax.Statistics by the names that keep returns.")
    sections = Sections.from_arguments(settled.crossings, keep, settings)
    if callable(ts) and (sections is not None or settled.extend is not None):
        raise ValueError(
            f"{'extend' if sections is None else 'crossings'} of sweep: for members that share their times. Give ts as "
            "an array."
        )
    times = ts if callable(ts) else np.asarray(output_times(ts, float))
    description = Description(system, times, q0, qdot0, params, keep, reduce, settings, sections)
    if executor is not None:
        require_executor(executor)
    axes, part = axes_of(over), require_part(settled.part)
    place, compiled = _store_folder(settled.path, "store"), []
    other = None if settled.extend is None else _store_folder(settled.extend, "extend")
    with set_precision(uses_doubles()):
        if not place.exists():
            create_store(place, axes, description, settled.unit, compiled, other)
        spec = place.spec()
        description = check_store(place, spec, axes, description, other)
        job = Job.from_store(place, spec, description, *compiled)
        show, units = Progress(place, spec, progress), units_to_compute(job, part)
        if executor is not None:
            submit(job, units, executor, show)
        else:
            compute_units(job, units, show)
    show.end()
    return Sweep(place.path)


def _store_folder(path: Any, name: str) -> Files:
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise TypeError(f"{name} must be the name of a folder, such as 'map.zarr'; got {path!r}.")
    return Files(Path(path).expanduser().absolute())
