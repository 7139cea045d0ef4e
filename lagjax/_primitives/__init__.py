"""Primitives of our own, with their transposes and batch rules: what JAX has to be taught.

`_custom` makes primitives known under shard_map, and values whose derivatives are those of another expression.
`_failures` raises where a motion failed, or gives NaN in values and derivatives. `_doubles` computes in float64 for
callers whose numbers are float32.
"""

from lagjax._primitives._custom import VaryingPrimitive, attach_derivative, batch_in_front, cond_alike, vary_alike
from lagjax._primitives._doubles import DOUBLE, SINGLE, accepts_singles, compute_in_doubles, widen, with_doubles
from lagjax._primitives._failures import (
    differentiable_where,
    lost_unless,
    marks_absent,
    nan_unless,
    raise_where_failed,
    sentence,
)
