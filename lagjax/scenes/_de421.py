"""Numbers of the ephemeris JPL DE421 (public domain), as distributed in the PyPI package de421 2008.1.

W. M. Folkner, J. G. Williams, D. H. Boggs, "The Planetary and Lunar Ephemeris DE 421", JPL memorandum IOM 343R-08-003
(2008). Constants from its header; states from its Chebyshev coefficients: barycentric, axes of the ICRF, time TDB,
lengths in AU, times in days of 86400 s. The table `_de421.csv` has a row for each body.
"""

from pathlib import Path

import numpy as np

AU = 149597870.6996262  # km
C = 299792.458 * 86400 / AU  # speed of light, AU/day
EPOCH = 2440400.5  # Julian date, TDB, of the initial state

_TABLE = np.loadtxt(Path(__file__).with_suffix(".csv"), dtype=str, delimiter=",", skiprows=1)
BODIES = tuple(map(str, _TABLE[:, 0]))
# The gravitational constant times the mass, AU³/day²; at the epoch positions, AU, and velocities, AU/day.
GM, POSITIONS, VELOCITIES, *_LATER = np.split(_TABLE[:, 1:].astype(float), [1, 4, 7, 10, 13], axis=1)
GM = GM.ravel()
# Positions to compare with, AU: days after the epoch -> one row a body.
LATER_POSITIONS = dict(zip((30.0, 90.0, 365.25), _LATER, strict=True))
