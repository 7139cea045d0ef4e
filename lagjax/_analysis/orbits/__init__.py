"""Orbits: where motions return, how they depend on energy and parameters, how fast they part, which path is taken.

`_arc_motions` follows motions with their derivatives, on rows, `_jumping_motions` those with contacts or modes;
`_shooting` closes or joins chains of arcs by way of `_condensation`, `_floquet` says what their multipliers are,
`_orbit` is `periodic_orbit`. `_continuation` goes along a family, `_family` is `family` and `branch_off`. `_lyapunov`
is about motions that never return, `_path` about those from one place to another. `decide` of `lagjax._equations`
decides about singular values.
"""

from lagjax._analysis.orbits._family import Family, branch_off, family
from lagjax._analysis.orbits._lyapunov import LyapunovExponent, lyapunov_exponent, lyapunov_spectrum
from lagjax._analysis.orbits._orbit import Orbit, periodic_orbit
from lagjax._analysis.orbits._path import Path, action, find_path
