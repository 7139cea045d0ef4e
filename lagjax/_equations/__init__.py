"""The equations of motion of a Lagrangian: M, F, q̈ and λ, on arrays and on scalars.

`_motion` derives momentum, mass matrix, force, acceleration, energy and multipliers on arrays, `_quantities` the same
on scalars; `_coupled_forces` are forces that depend on multipliers. `_constraints` has constraint Jacobian, right-hand
side, distances and projection; `_consistency` tests a start against them. `_linear` solves symmetric systems and saddle
points as arrays, and `_rank` decides which singular values count as zero; `_patterns` finds the sparsity patterns of a
large scene's matrices, `_sparse` solves with them, `_structure` is the motion of such a scene; `_saddle` is elimination
on scalars, which keeps structural zeros, and `_recursion` the one for chains in O(n). `_form` decides in which form a
scene is evaluated, and has all thresholds for it. `_derivation` keeps everything derived from a scene as scalar
programs, each lowered once, `_accelerations` those of linear systems; `_many_states` evaluates them at many states.
`_scales` measures the sizes of coordinates, velocities and time at a state; `_blame` finds the operations of a user's
function that are not finite or piecewise, with their source line.
"""

from lagjax._equations import _form as forms
from lagjax._equations._accelerations import Accelerations
from lagjax._equations._blame import border_places, borders, describe_pieces, offenders, poles
from lagjax._equations._consistency import has_constraints, inconsistent_members, require_consistent
from lagjax._equations._constraints import ROUNDINGS, Constraints, distances, is_inconsistent
from lagjax._equations._coupled_forces import CoupledForces, couple_forces
from lagjax._equations._derivation import Derivation, columns_of, derivation_of, numbers_of, once_for_structure
from lagjax._equations._linear import (
    augment,
    dependent_rows,
    diagonal_scale,
    eigen,
    factorize,
    invert,
    least_norm,
    null_directions,
    rank,
    rank_tolerance,
    saddle,
    saddle_many,
    schur_complements,
    singular_threshold,
    unit_diagonal,
)
from lagjax._equations._many_states import (
    OF_QUANTITIES,
    SADDLE,
    Sample,
    borders_of,
    map_in_chunks,
    numbers_of_state,
    solve_saddle,
    sparse_spectrum,
)
from lagjax._equations._motion import Motion
from lagjax._equations._patterns import jacobian_pattern, sparse_jacobian
from lagjax._equations._rank import Decided, decide, echelon_form, null_space, span_outside
from lagjax._equations._saddle import SaddleElimination, elimination_order
from lagjax._equations._scales import Scales
from lagjax._equations._sparse import Band, Blocks, Diagonal, MatrixFree, Sparse, form_of, refine
from lagjax._equations._structure import SparseMotion
