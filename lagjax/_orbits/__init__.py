"""Orbits: where motions return, how they depend on energy and parameters, how fast they part, which path is taken.

`_arcs` follows motions with their derivatives, on rows; `_rank` decides about singular values; `_shooting` closes
chains of arcs, `_floquet` says what their multipliers are, and `_orbit` is `periodic_orbit`.
"""

from lagjax._orbits._orbit import Orbit, periodic_orbit

__all__ = ["Orbit", "periodic_orbit"]
