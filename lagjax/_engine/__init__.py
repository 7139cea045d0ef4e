"""Engines, which integrate: a flat `Problem` becomes a flat `Solution`.

`_problem` has `Problem`, `Batch`, `Solution` and the base class of engines; `_choice` decides which engine integrates a
problem, and why. `taylor/` is Taylor series in machine code, `diffrax/` any solver of diffrax on any device.
`_stop_reason` finds why a motion stopped, from the accelerations around its last state.
"""

from lagjax._engine._choice import choose, requested_engine
from lagjax._engine._problem import (
    DEFAULT_RTOL,
    LEAST_RTOL,
    AbstractEngine,
    Batch,
    Problem,
    Solution,
    axes_per_leaf,
    concatenate_leaves,
)
from lagjax._engine._stop_reason import AHEAD, End, find_stop_flags
