"""Narrow features: functions that are flat to rounding until their argument comes near."""

import math
from typing import NamedTuple

# What a function is flat like: exp(u) below, exp(−|u|) on both sides, exp(−u²), or zero up to a border; and in which
# units of its argument. Of powers these are exponents: |u| to the minus `scale` grows as |u| falls, u to the `scale` as
# it grows from what is nothing.
BELOW, BESIDE, SQUARED, UP_TO, FALLS, GROWS = range(6)
FEATURES = {
    "exp": (BELOW, 1.0), "exp2": (BELOW, math.log(2.0)), "expm1": (BELOW, 1.0), "logistic": (BESIDE, 1.0),
    "tanh": (BESIDE, 2.0), "sinh": (BESIDE, 2.0), "cosh": (BESIDE, 2.0), "erf": (SQUARED, 1.0), "erfc": (SQUARED, 1.0),
}  # fmt: skip


class Feature(NamedTuple):
    """A narrow feature: what it is flat like, and in which units of its argument, or to which power of it."""

    kind: int
    scale: float
