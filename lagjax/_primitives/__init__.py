"""JAX primitives of lagjax, with their derivatives, transposes and batching rules.

`_linear_map` has the base class of all of these, and gives values the derivatives of another expression. `_failures`
raises where a motion failed, or sets values and derivatives to NaN. `_doubles` computes in float64 for callers whose
numbers are float32. `_on_host` evaluates JAX functions in NumPy, without XLA; `_repetition` uses it to repeat a step
and its derivatives.
"""

from lagjax._primitives._doubles import DOUBLE, SINGLE, accepts_singles, compute_in_doubles, widen, with_doubles
from lagjax._primitives._failures import (
    NOT_EXPORTED,
    allows_nan,
    differentiable_where,
    mark_steps,
    nan_unless,
    raise_where_failed,
    sentence,
    undefined_unless,
)
from lagjax._primitives._linear_map import (
    LinearMap,
    VaryingPrimitive,
    attach_derivative,
    compute_on_host,
    cond_alike,
    cotangent_of,
    is_zero,
    limit_directions,
    solve,
    solve_composed,
    vary_alike,
    vary_carry_alike,
)
from lagjax._primitives._on_host import HostFunction, broadcast_members, call_host
from lagjax._primitives._repetition import Repetition
