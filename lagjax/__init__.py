"""lagjax: from a Lagrangian, written as a plain JAX function, to trajectories.

System(L)  →  simulate(system, q0, qdot0, ts, params)  →  Trajectory

What there is, by what it is for; `python -m pydoc lagjax.simulate` prints one of them alone.

**Motion**

- `System`: L, constraints, forces, dissipation; `System.explain` tells what is in it
- `simulate`, `simulate_batch`: one motion, or many at once, as a `Trajectory` of `State`s
- `samples`: an input that was measured, as a function of time
- `crossings`: where a motion crosses a section, as `Crossings`
- `simulate_hybrid`: a motion through modes, by `Transition`s; those that happened are `Transitions`; `Hybrid`: all of
  it as one object, for `fit` and `sweep`
- `MachineCode`, `FineOutput`: what integrates
- `SimulationError`, `RESULTS`: how a motion ends

**Trust**

- `check`: what is wrong with a scene at a state, as `Findings`, each a `Finding`
- `Explanation`, `Health`: what `System.explain` and `Trajectory.health` return
- `work_precision`: what a digit costs; a `WorkPrecision` of `WorkPrecisionRow`s

**What a scene does**

- `equilibrium`, `linearize`, `normal_modes`: at rest and near it: `Equilibrium`, `Linearization`, `Modes`
- `conserved_quantities`, `noether_charge`, `cyclic_coordinates`: symmetries: `ConservedQuantities`, each `Conserved`
- `same_motion`: whether two Lagrangians have one motion, as `SameMotion`
- `change_coordinates`, `hamiltonian`, `routhian`: the scene written otherwise: `ChangedCoordinates`, `Hamiltonian` with
  its `CanonicalTrajectory`, `Routhian`
- `periodic_orbit`, `family`, `branch_off`: motions that close: `Orbit`, `Family`
- `lyapunov_spectrum`, `lyapunov_exponent`: chaos; `LyapunovExponent`
- `action`, `find_path`: between two ends; `Path`

**Parameters from recordings**

- `fit`: the likeliest parameters with intervals, as a `Fit`
- `Record`, `Timings`, `Guess`, `Delayed`, `wrapped`: what was measured, and how
- `Gaussian`, `StudentT`: the noise
- `positive`, `between`, `angle`, `simplex`, `inertia`: what parameters may be

**Many members, few numbers of each**

- `sweep`: up to 10⁸ members in a store, as a `Sweep`, with its `Statistics` and `Status`
- `sobol`, `latin_hypercube`, `random`: points to sweep over

**More**

- `scenes`: ready Lagrangians with exact solutions
- `plot`: figures
- `Animation`: a motion as a film, made by `Trajectory.animate`
"""

import ast
import importlib
from typing import TYPE_CHECKING, Any

from lagjax._system import System

if TYPE_CHECKING:  # each is imported where it is first asked for: all of them take as long as JAX itself
    from lagjax import plot, scenes
    from lagjax._analysis import (
        CanonicalTrajectory,
        ChangedCoordinates,
        Conserved,
        ConservedQuantities,
        Equilibrium,
        Hamiltonian,
        Linearization,
        Modes,
        Routhian,
        SameMotion,
        change_coordinates,
        conserved_quantities,
        cyclic_coordinates,
        equilibrium,
        hamiltonian,
        linearize,
        noether_charge,
        normal_modes,
        routhian,
        same_motion,
    )
    from lagjax._animation import Animation
    from lagjax._check import Finding, Findings, check
    from lagjax._crossings import Crossings, crossings
    from lagjax._diffrax import FineOutput
    from lagjax._explain import Explanation
    from lagjax._fit import (
        Delayed,
        Fit,
        Gaussian,
        Guess,
        Record,
        StudentT,
        Timings,
        angle,
        between,
        fit,
        inertia,
        positive,
        simplex,
        wrapped,
    )
    from lagjax._health import Health
    from lagjax._hybrid import Hybrid, Transition, simulate_hybrid
    from lagjax._machine_code import MachineCode
    from lagjax._orbits import (
        Family,
        LyapunovExponent,
        Orbit,
        Path,
        action,
        branch_off,
        family,
        find_path,
        lyapunov_exponent,
        lyapunov_spectrum,
        periodic_orbit,
    )
    from lagjax._precision import WorkPrecision, WorkPrecisionRow, work_precision
    from lagjax._results import RESULTS, SimulationError
    from lagjax._samples import samples
    from lagjax._simulate import simulate, simulate_batch
    from lagjax._sweep import Statistics, Status, Sweep, sweep
    from lagjax._trajectory import State, Trajectory, Transitions
    from lagjax.designs import latin_hypercube, random, sobol

__version__ = "0.1.0"
__all__ = [
    "RESULTS",
    "Animation",
    "CanonicalTrajectory",
    "ChangedCoordinates",
    "Conserved",
    "ConservedQuantities",
    "Crossings",
    "Delayed",
    "Equilibrium",
    "Explanation",
    "Family",
    "Finding",
    "Findings",
    "FineOutput",
    "Fit",
    "Gaussian",
    "Guess",
    "Hamiltonian",
    "Health",
    "Hybrid",
    "Linearization",
    "LyapunovExponent",
    "MachineCode",
    "Modes",
    "Orbit",
    "Path",
    "Record",
    "Routhian",
    "SameMotion",
    "SimulationError",
    "State",
    "Statistics",
    "Status",
    "StudentT",
    "Sweep",
    "System",
    "Timings",
    "Trajectory",
    "Transition",
    "Transitions",
    "WorkPrecision",
    "WorkPrecisionRow",
    "action",
    "angle",
    "between",
    "branch_off",
    "change_coordinates",
    "check",
    "conserved_quantities",
    "crossings",
    "cyclic_coordinates",
    "equilibrium",
    "family",
    "find_path",
    "fit",
    "hamiltonian",
    "inertia",
    "latin_hypercube",
    "linearize",
    "lyapunov_exponent",
    "lyapunov_spectrum",
    "noether_charge",
    "normal_modes",
    "periodic_orbit",
    "plot",
    "positive",
    "random",
    "routhian",
    "same_motion",
    "samples",
    "scenes",
    "simplex",
    "simulate",
    "simulate_batch",
    "simulate_hybrid",
    "sobol",
    "sweep",
    "work_precision",
    "wrapped",
]


def __getattr__(name: str) -> Any:
    """A public name, imported from where the block above says."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    path = _places()[name]
    value = (
        importlib.import_module(f"{path}.{name}") if path == __name__ else getattr(importlib.import_module(path), name)
    )
    return globals().setdefault(name, value)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _places() -> dict[str, str]:
    """The module of every public name: what a type checker reads, so that it is said once."""
    assert __spec__ is not None and __spec__.loader is not None
    tree = ast.parse(__spec__.loader.get_source(__name__))  # type: ignore[attr-defined]
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = (node for node in block.body if isinstance(node, ast.ImportFrom))
    return {alias.name: str(node.module) for node in imports for alias in node.names}
