"""Scalar programs: straight lines of operations on numbers, their derivatives, series and pieces; it knows no JAX.

    graph of scalars ──_graph──►  folded, shared  ──_passes──►  StraightLine  ──_series, _borders──►  machine code

`_operations` has a row for each operation: its value, its derivatives, its series. `_graph` shares and, by `_simplify`,
folds; `_passes` finish it; `_differentiation` differentiates it. Series: `_series`, with `_recurrences` for operations
that have one of their own. Pieces: `_deciding` (what decides), `_decisions` (by which numbers), `_cones` (of lengths),
`_levels` (their borders), `_beginnings` (where a motion begins), `_borders` (all of that), `_sliding` (along them, by
`_border_forces`, `_held` and `_small_equations`), `_jump` and `_kick` (over them, by `_jump_search`), `_features` and
`_powers` (where no series helps), `_look_ups` (tables). A program consists of a `_line`, with its values in
NumPy; `_rounding` is for their error, `_formulas` for readers. `_memory` bounds what a graph may take. What JAX traces
becomes a graph in `_tracing`.
"""

from lagjax._program._borders import (
    Borders,
    Pieced,
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
