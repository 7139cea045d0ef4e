"""Scalar programs: functions written as straight-line sequences of scalar operations, and transformations of them.

    graph of scalars ──_graph──►  simplified  ──_passes──►  StraightLine  ──_series, _borders──►  machine code

This room does not import JAX; `_tracing` translates what JAX traces into graphs. A *decision* is a piecewise operation
(`sign`, `floor`, …), its *switching number* is the scalar that it depends on, a *piece* is the result of the decision,
constant between two *borders*, and a *kick* is a jump of velocities at a border.

`_operations` has a row for each operation (value, derivatives, series). `_graph` shares equal nodes and simplifies them
by `_simplify`; `_passes` rewrites whole graphs; `_differentiation` differentiates. Series: `_series`, `_recurrences`.
Decisions: `_deciding` (which nodes), `_decisions` (their rewriting), `_cones` (lengths), `_levels` (guards),
`_beginnings` (pieces at the start), `_borders` (all of it), `_sliding` with `_border_forces`, `_held` and
`_small_equations` (motion along a border), `_jump` and `_kick` with `_jump_search` (crossing one), `_features` and
`_powers` (functions that a series misses), `_look_ups` (tables). `_line` evaluates in NumPy, `_rounding` bounds
rounding errors, `_formulas` writes text, `_memory` bounds memory.
"""

from lagjax._program._borders import (
    Borders,
    PiecedProgram,
    borders,
    distances,
    find_corners,
    gradient,
    is_smooth,
    with_outputs,
)
from lagjax._program._deciding import inputs_below
from lagjax._program._differentiation import (
    Derivatives,
    copy_nodes,
    pullback,
    pullback_and_entries,
    pushforward,
    tangents_in,
    with_tangents,
)
from lagjax._program._features import BELOW, FALLS, GROWS, UP_TO, Feature
from lagjax._program._formulas import Formulas, Product, Sum
from lagjax._program._graph import INPUTS, NUMBERS, PAIRS, Graph, Tape, Unlowerable, find_ancestors
from lagjax._program._jump import Jump, Nesting, jump_at_border, row_places, with_borders_of_tangents
from lagjax._program._levels import CLOCK, CONE, FLOOR, SIGN, SLIDE, TABLE, TRUNC, Affine, Level
from lagjax._program._line import StraightLine
from lagjax._program._look_ups import BESIDE, Located, Table, shift_look_up, table_of
from lagjax._program._memory import lack_of_memory, machine_memory, operations_that_fit
from lagjax._program._operations import LOOK_UPS, OPERATIONS, Operation
from lagjax._program._passes import count_uses, eliminate_dead_code, factor, sink_negations
from lagjax._program._rounding import operation_error, rounding
from lagjax._program._series import LinearSystem, Recurrent, Series, series
from lagjax._program._simplify import arctangent, inverse, is_nonnegative
from lagjax._program._sliding import MOST_COUPLED
from lagjax._program._small_equations import eliminate, sparse_row, substitute
