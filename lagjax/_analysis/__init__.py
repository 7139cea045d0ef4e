"""What a scene does, from its Lagrangian alone: where it stays, how it oscillates, what it conserves."""

from lagjax._analysis._equilibrium import Equilibrium, equilibrium
from lagjax._analysis._linearize import Linearization, linearize
from lagjax._analysis._modes import Modes, normal_modes

__all__ = ["Equilibrium", "Linearization", "Modes", "equilibrium", "linearize", "normal_modes"]
