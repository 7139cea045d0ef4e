"""Scalar programs: straight lines of operations on numbers, their derivatives, series and pieces; it knows no JAX.

    graph of scalars ──_graph──►  folded, shared  ──_passes──►  StraightLine  ──_series, _borders──►  machine code

`_operations` has a row for each operation: its value, its derivatives, its series. `_graph` shares and, by `_simplify`,
folds; `_passes` finish it; `_differentiation` differentiates it. Series: `_series`, with `_recurrences` for operations
that have one of their own. Pieces: `_borders` (where they meet), `_sliding` (along them), `_jump` and `_kick` (over
them), `_powers` (where no series helps), `_look_ups` (tables). A program consists of a `_line`, with its values in
NumPy; `_rounding` is for their error. `_memory` bounds what a graph may take. What JAX traces becomes a graph in
`_tracing`.
"""

from lagjax._program._borders import (
    CLOCK,
    FLOOR,
    SIGN,
    TABLE,
    TRUNC,
    Borders,
    borders,
    distances,
    find_corners,
    is_smooth,
    with_outputs,
)
from lagjax._program._differentiation import Derivatives, copy_nodes, pullback, pushforward, tangents_in, with_tangents
from lagjax._program._graph import INPUTS, NUMBERS, PAIRS, Graph, Tape, Unlowerable, find_ancestors
from lagjax._program._jump import row_places
from lagjax._program._line import StraightLine
from lagjax._program._look_ups import BESIDE, Located, Table, table_of
from lagjax._program._memory import lack_of_memory, machine_memory, operations_that_fit
from lagjax._program._operations import LOOK_UPS, OPERATIONS
from lagjax._program._passes import eliminate_dead_code, factor, sink_negations
from lagjax._program._rounding import rounding
from lagjax._program._series import LinearSystem, series
from lagjax._program._simplify import arctangent, inverse, is_nonnegative
from lagjax._program._sliding import MOST_COUPLED, eliminate, sparse_row, substitute
