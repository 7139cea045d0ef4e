"""What a scene does, from its Lagrangian alone: where it stays, how it oscillates, what it conserves."""

from lagjax._analysis._equilibrium import Equilibrium, equilibrium
from lagjax._analysis._linearize import Linearization, linearize
from lagjax._analysis._modes import Modes, normal_modes
from lagjax._analysis._noether import cyclic_coordinates, noether_charge
from lagjax._analysis._same import SameMotion, same_motion
from lagjax._analysis._symmetries import Conserved, ConservedQuantities, conserved_quantities

__all__ = [
    "Conserved",
    "ConservedQuantities",
    "Equilibrium",
    "Linearization",
    "Modes",
    "SameMotion",
    "conserved_quantities",
    "cyclic_coordinates",
    "equilibrium",
    "linearize",
    "noether_charge",
    "normal_modes",
    "same_motion",
]
