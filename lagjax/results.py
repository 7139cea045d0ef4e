"""The classes of what lagjax returns, for annotations and `isinstance`; users need not construct them.

Each of them is also found as `lagjax.Trajectory`, `lagjax.Orbit`, ….

The map of the package, `help(lagjax)`, says which function returns which of them.

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
    ReducedLinearization,
    Routhian,
    SameMotion,
    SteadyMotion,
)
from lagjax._analysis.orbits import Family, LyapunovExponent, Orbit, Path
from lagjax._fit import Comparison, Experiments, Fit, Prediction, Profile, Selection
from lagjax._run import ContactChanges, Crossings, Impacts, State, Trajectory, Transitions
from lagjax._scene import Explanation
from lagjax._show import Animation, Equations
from lagjax._sweep import Status, Summary
from lagjax._trust import WorkPrecision, WorkPrecisionRow
from lagjax._trust.checks import Finding, Findings
from lagjax._trust.health import Health

__all__ = [
    "Animation", "CanonicalTrajectory", "ChangedCoordinates", "Comparison", "Conserved", "ConservedQuantities",
    "ContactChanges", "Crossings", "Equations", "Equilibrium", "Experiments", "Explanation", "Family", "Finding",
    "Findings", "Fit", "Hamiltonian", "Health", "Impacts", "Linearization", "LyapunovExponent", "Modes", "Orbit",
    "Path", "Prediction", "Profile", "ReducedLinearization", "Routhian", "SameMotion", "Selection", "State", "Status",
    "SteadyMotion", "Summary", "Trajectory", "Transitions", "WorkPrecision", "WorkPrecisionRow",
]  # fmt: skip
