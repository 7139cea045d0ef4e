"""lagjax: from a Lagrangian, written as a plain JAX function, to trajectories.

System(L)  →  simulate(system, q0, qdot0, ts, params)  →  Trajectory

What there is, by what it is for; `python -m pydoc lagjax.simulate` prints one of them alone.

**Motion**

- `System`: L, constraints, forces, dissipation, contacts; `System.explain` tells what is in it,
  `System.equations` prints its `Equations`, `System.to_c` writes them in C
- `simulate`, `simulate_batch`: one motion, or many at once, as a `Trajectory` of `State`s; with contacts its `Impacts`
  and `ContactChanges`
- `samples`: an input that was measured, as a function of time
- `crossings`: where a motion crosses a section, as `Crossings`
- `Hybrid`: a motion through modes, by `Transition`s; those that happened are `Transitions`
- `MachineCode`, `FineOutput`: what integrates
- `SimulationError`, `RESULTS`: how a motion ends

**Trust**

- `check`: what is wrong with a scene at a state, as `Findings`, each a `Finding`
- `Explanation`, `Health`: what `System.explain` and `Trajectory.health` return
- `work_precision`: what a digit costs; a `WorkPrecision` of `WorkPrecisionRow`s

**What a scene does**

- `equilibrium`, `steady_motion`, `linearize`, `normal_modes`: at rest or rolling on, and near it: `Equilibrium`,
  `SteadyMotion`, `Linearization` (`ReducedLinearization`), `Modes`
- `inverse_dynamics`: the forces that an acceleration takes
- `conserved_quantities`, `noether_charge`, `cyclic_coordinates`: symmetries: `ConservedQuantities`, each `Conserved`
- `same_motion`: whether two Lagrangians have one motion, as `SameMotion`
- `change_coordinates`, `hamiltonian`, `routhian`: the scene written otherwise: `ChangedCoordinates`, `Hamiltonian` with
  its `CanonicalTrajectory`, `Routhian`
- `periodic_orbit`, `family`, `branch_off`: motions that close: `Orbit`, `Family`
- `lyapunov_spectrum`, `lyapunov_exponent`: chaos; `LyapunovExponent`
- `action`, `find_path`: between two ends; `Path`

**Parameters from recordings**

- `fit`: the likeliest parameters with intervals, as a `Fit`; its methods return a `Profile`, a `Prediction`,
  `Experiments`, a `Comparison`, and it holds the `Selection` of candidate terms
- `Record`, `Timings`, `Guess`, `Delayed`, `wrapped`: what was measured, and how
- `Gaussian`, `StudentT`, `Quantised`, `Clipped`: the noise
- `positive`, `between`, `angle`, `simplex`, `inertia`: what parameters may be; `per_record`: one value a record
- `terms`: a law of candidate terms, of which `fit` keeps those that the motion asks for

**Many members, few numbers of each**

- `sweep`: up to 10⁸ members in a `Store`, as a `Sweep`, with its `Statistics` (a `Summary` each) and `Status`
- `designs`: points to sweep over: random, Sobol's, Latin hypercubes
- `learned`: functions that nobody wrote down, learned from recordings: potentials, friction, inertia

**More**

- `scenes`: ready Lagrangians with exact solutions
- `plot`: figures
- `results`: the classes of what functions return
- `Animation`: a motion as a film, made by `Trajectory.animate`
"""

import ast
import functools
import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from lagjax._interface import VERSION, Registered, register
from lagjax._scene import System

if TYPE_CHECKING:  # each is imported on first use: all of them take as long as JAX itself
    from lagjax import designs, learned, plot, results, scenes
    from lagjax._analysis import (
        change_coordinates,
        conserved_quantities,
        cyclic_coordinates,
        equilibrium,
        hamiltonian,
        inverse_dynamics,
        linearize,
        noether_charge,
        normal_modes,
        routhian,
        same_motion,
        steady_motion,
    )
    from lagjax._analysis.orbits import (
        action,
        branch_off,
        family,
        find_path,
        lyapunov_exponent,
        lyapunov_spectrum,
        periodic_orbit,
    )
    from lagjax._engine.diffrax import FineOutput
    from lagjax._engine.taylor import MachineCode
    from lagjax._fit import (
        Clipped,
        Delayed,
        Gaussian,
        Guess,
        Quantised,
        Record,
        StudentT,
        Timings,
        angle,
        between,
        fit,
        inertia,
        per_record,
        positive,
        simplex,
        terms,
        wrapped,
    )
    from lagjax._interface import RESULTS, SimulationError
    from lagjax._run import crossings, simulate, simulate_batch
    from lagjax._run.hybrid import Hybrid, Transition
    from lagjax._scene import samples
    from lagjax._sweep import Statistics, Store, Sweep, sweep
    from lagjax._trust import work_precision
    from lagjax._trust.checks import check
    from lagjax.results import *  # noqa: F403

__version__ = VERSION
__all__ = [
    "RESULTS", "Clipped", "Delayed", "FineOutput", "Gaussian", "Guess", "Hybrid", "MachineCode", "Quantised", "Record",
    "SimulationError", "Statistics", "Store", "StudentT", "Sweep", "System", "Timings", "Transition", "action", "angle",
    "between", "branch_off", "change_coordinates", "check", "conserved_quantities", "crossings", "cyclic_coordinates",
    "designs", "equilibrium", "family", "find_path", "fit", "hamiltonian", "inertia", "inverse_dynamics", "learned",
    "linearize", "lyapunov_exponent", "lyapunov_spectrum", "noether_charge", "normal_modes", "per_record",
    "periodic_orbit", "plot", "positive", "results", "routhian", "same_motion", "samples",
    "scenes", "simplex", "simulate", "simulate_batch",
    "steady_motion", "sweep", "terms", "work_precision", "wrapped",
]  # fmt: skip


# What judges and shows a motion stands above it, and is imported when a method of `Trajectory` calls it.
def _load_show():
    from lagjax import _show

    return _show


def _load_trust():
    from lagjax import _trust

    return _trust


def _load_health():
    from lagjax._trust import health

    return health


def _load_contacts():
    from lagjax._run import contacts

    return contacts


def _load_run():
    from lagjax import _run

    return _run


register(
    Registered(
        summary=lambda run: _load_show().summary(run),
        trajectory_html=lambda run: _load_show().trajectory_html(run),
        dataset=lambda run, units, time_unit: _load_show().make_dataset(run, units, time_unit),
        frame=lambda run, units, time_unit: _load_show().make_frame(run, units, time_unit),
        impact_frame=lambda impacts: _load_show().impact_frame(impacts),
        change_frame=lambda changes: _load_show().change_frame(changes),
        write_equations=lambda *scene: _load_show().write_equations(*scene),
        write_c=lambda *scene: _load_show().write_c(*scene),
        make_animation=lambda run, points, *look: _load_show().make_animation(run, points, *look),
        examine=lambda run, reference: _load_health().examine(run, reference),
        contact_forces=lambda run, name: _load_contacts().contact_forces(run, name),
        find_states=lambda run, t: _load_run().find_states(run, t),
        describe_failure=lambda run, layout, why: _load_trust().describe_failure(run, layout, why),
    )
)


def __getattr__(name: str) -> Any:
    """A public name or a class of `lagjax.results`, imported from its module."""
    if (path := _places().get(name)) is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{path}.{name}" if path == __name__ else path)
    return globals().setdefault(name, module if path == __name__ else getattr(module, name))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


@functools.cache
def _places() -> dict[str, str]:
    """The module of every public name and result: what a type checker reads, so that it is said once."""
    (block,) = (node for node in _parse_module(__name__).body if isinstance(node, ast.If))
    imports = [*block.body, *_parse_module(f"{__name__}.results").body]
    imports = [node for node in imports if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names if alias.name != "*"}


def _parse_module(module: str) -> ast.Module:
    """The syntax of a module of this package, which is not imported for it."""
    loader = __spec__.loader if module == __name__ else importlib.util.find_spec(module).loader  # type: ignore
    return ast.parse(loader.get_source(module))  # type: ignore[attr-defined]
