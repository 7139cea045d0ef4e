"""lagjax: from a Lagrangian, written as a plain JAX function, to trajectories.

System(L)  →  simulate(system, q0, qdot0, ts, params)  →  Trajectory
"""

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
from lagjax._check import Finding, Findings, check
from lagjax._crossings import Crossings, crossings
from lagjax._diffrax._solvers import FineOutput
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
)
from lagjax._health import Health
from lagjax._hybrid import Transition, simulate_hybrid
from lagjax._machine_code import MachineCode
from lagjax._orbits import (
    Family,
    LyapunovExponent,
    Orbit,
    Path,
    action,
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
from lagjax._sweep import Statistics, Status, Sweep, latin_hypercube, random, sobol, sweep
from lagjax._system import System
from lagjax._trajectory import State, Trajectory, Transitions

__version__ = "0.1.0"
__all__ = [
    "RESULTS",
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
]
