"""Analysis of a scene from its Lagrangian: equilibria, oscillations, symmetries and conserved quantities.

At rest and near it: `_equilibrium`, `_linearize`, `_modes`, in steady motion `_steady_motion` with the coordinates that
`_steady_symmetries` finds, on `_smoothness` (is there a derivative at all), `_closed_contacts`, `_solve` (Newton),
`_eigen`; of large scenes on `_sparse_balance` and `_lowest_modes`. Forces: `_inverse_dynamics`. Symmetries:
`_symmetries` looks for them among `_transformations`, at `_random_states`; `_gauge`, `_noether` and `_potential` make a
conserved quantity of one. Other forms of a scene: `_coordinates`, `_hamiltonian`, `_routh`, `_same_motion`. All of them
get the scene as a `_scene_state`. `orbits/` holds periodic motions, chaos, and paths between two ends.
"""

from lagjax._analysis._coordinates import ChangedCoordinates, change_coordinates
from lagjax._analysis._eigen import exponents_and_modes
from lagjax._analysis._equilibrium import Equilibrium, equilibrium
from lagjax._analysis._hamiltonian import CanonicalTrajectory, Hamiltonian, hamiltonian
from lagjax._analysis._inverse_dynamics import inverse_dynamics
from lagjax._analysis._linearize import Linearization, ReducedLinearization, linearize
from lagjax._analysis._modes import Modes, normal_modes
from lagjax._analysis._noether import cyclic_coordinates, noether_charge
from lagjax._analysis._routh import Routhian, routhian
from lagjax._analysis._same_motion import SameMotion, same_motion
from lagjax._analysis._steady_motion import SteadyMotion, steady_motion
from lagjax._analysis._symmetries import Conserved, ConservedQuantities, conserved_quantities
