"""Periodic orbits and their families, Lyapunov exponents, and paths between two configurations.

`_arc_motions` integrates motions with their derivatives, many at once, `_jumping_motions` those with contacts or modes;
`_shooting` closes or joins chains of arcs by way of `_condensation`, `_floquet` computes their multipliers, `_orbit` is
`periodic_orbit`. `_continuation` follows a family, `_family` is `family` and `branch_off`. `_lyapunov` is about motions
that never return, `_path` about those from one place to another. `decide` of `lagjax._equations` decides about singular
values.
"""

from lagjax._analysis.orbits._family import Family, branch_off, family
from lagjax._analysis.orbits._lyapunov import LyapunovExponent, lyapunov_exponent, lyapunov_spectrum
from lagjax._analysis.orbits._orbit import Orbit, periodic_orbit
from lagjax._analysis.orbits._path import Path, action, find_path
