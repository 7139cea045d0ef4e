"""lagjax: from a Lagrangian, written as a plain JAX function, to trajectories.

System(L)  →  simulate(system, q0, qdot0, ts, params)  →  Trajectory
"""

from lagjax._results import RESULTS, SimulationError
from lagjax._simulate import simulate, simulate_batch
from lagjax._system import System
from lagjax._trajectory import State, Trajectory

__version__ = "0.1.0"
__all__ = ["RESULTS", "SimulationError", "State", "System", "Trajectory", "simulate", "simulate_batch"]
