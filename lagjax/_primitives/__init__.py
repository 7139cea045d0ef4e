"""Primitives of our own, with their transposes and batch rules: what JAX has to be taught.

`_linear_map` defines all of these by their mathematics, and gives values the derivatives of another expression.
`_failures` raises where a motion failed, or gives NaN in values and derivatives. `_doubles` computes in float64 for
callers whose numbers are float32. `_on_host` evaluates functions of JAX by NumPy, without XLA; so `_repetition` repeats
a step and its derivatives.
"""

from lagjax._primitives._doubles import DOUBLE, SINGLE, accepts_singles, compute_in_doubles, widen, with_doubles
from lagjax._primitives._failures import (
    NOT_EXPORTED,
    differentiable_where,
    lost_unless,
    mark_steps,
    marks_absent,
    nan_unless,
    raise_where_failed,
    sentence,
)
from lagjax._primitives._linear_map import (
    LinearMap,
    VaryingPrimitive,
    attach_derivative,
    compute_on_host,
    cond_alike,
    cotangent_of,
    is_zero,
    keep_together,
    solve,
    solve_composed,
    start_alike,
    vary_alike,
)
from lagjax._primitives._on_host import HostFunction, call_host, share_rows
from lagjax._primitives._repetition import Repetition
