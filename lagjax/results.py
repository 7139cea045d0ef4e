"""The classes of what lagjax returns, for annotations and `isinstance`; users need not construct them.

Each of them is also found as `lagjax.Trajectory`, `lagjax.Orbit`, ….

**Motion**

- `Trajectory`, with its `State` at the end, the `Transitions` of a hybrid motion, the `Impacts` and `ContactChanges` of
  one with contacts: from `simulate`, `simulate_batch`, `simulate_hybrid`
- `Crossings`: from `crossings`
- `Animation`: from `Trajectory.animate`

**Trust**

- `Findings`, each a `Finding`: from `check`
- `Explanation`: from `System.explain`
- `Health`: from `Trajectory.health`
- `WorkPrecision`, of `WorkPrecisionRow`s: from `work_precision`

**Analysis**

- `Equilibrium`, `Linearization`, `Modes`: from `equilibrium`, `linearize`, `normal_modes`
- `ConservedQuantities`, each a `Conserved`: from `conserved_quantities`
- `SameMotion`: from `same_motion`
- `ChangedCoordinates`, `Hamiltonian` with its `CanonicalTrajectory`, `Routhian`: from `change_coordinates`,
  `hamiltonian`, `routhian`
- `Orbit`, `Family`: from `periodic_orbit`, `family`, `branch_off`
- `LyapunovExponent`: from `lyapunov_exponent`
- `Path`: from `find_path`

**Parameters and sweeps**

- `Fit`: from `fit`; `Profile`, `Prediction`, `Experiments`, `Comparison`: from its methods `profile`, `predict`,
  `next_experiment`, `compare`
- `Status`, `Summary`: from `Sweep.status`, `Sweep.statistics`

```python
import jax.numpy as jnp, lagjax
from lagjax.results import Trajectory


def last(trajectory: Trajectory):
    return trajectory.q[-1]


scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2)
last(lagjax.simulate(scene, 1.0, 0.0, jnp.linspace(0.0, 1.0, 11)))
```
"""

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
)
from lagjax._analysis.orbits import Family, LyapunovExponent, Orbit, Path
from lagjax._fit import Comparison, Experiments, Fit, Prediction, Profile
from lagjax._run import ContactChanges, Crossings, Impacts, State, Trajectory, Transitions
from lagjax._scene import Explanation
from lagjax._show import Animation
from lagjax._sweep import Status, Summary
from lagjax._trust import WorkPrecision, WorkPrecisionRow
from lagjax._trust.checks import Finding, Findings
from lagjax._trust.health import Health

__all__ = [
    "Animation", "CanonicalTrajectory", "ChangedCoordinates", "Comparison", "Conserved", "ConservedQuantities",
    "ContactChanges", "Crossings", "Equilibrium", "Experiments", "Explanation", "Family", "Finding", "Findings", "Fit",
    "Hamiltonian", "Health", "Impacts", "Linearization", "LyapunovExponent", "Modes", "Orbit", "Path", "Prediction",
    "Profile", "Routhian",
    "SameMotion", "State", "Status", "Summary", "Trajectory", "Transitions", "WorkPrecision", "WorkPrecisionRow",
]  # fmt: skip
