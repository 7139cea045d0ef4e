"""The interface to the user: how functions are called and read, how numbers are checked, and how results are reported.

`_arguments` calls functions of the user: state by position, `t` and `params` by name; `reads/` finds the values that
such a function reads, and detects that one has changed. `_layout` turns a pytree into a flat vector and back, and names
coordinates. `_validate` checks numbers, with a message for each mistake; `_results` has the result codes, advice, and
the exception; `_platform` the kind of device that JAX computes on, and the numbers of arrays on it. `_registered` is
how a room calls a function of a room above it, `_version` the version of the package.
"""

from lagjax._interface._arguments import (
    Function,
    ValueNotKnown,
    accept,
    find_expression,
    present,
    restrict_signature,
)
from lagjax._interface._layout import (
    Layout,
    describe_numbers,
    dtype_of,
    flatten_numbers,
    halves,
    labelled_leaves,
    number_names,
)
from lagjax._interface._platform import (
    compile_for_one_call,
    compiled_once,
    default_platform,
    has_nvidia_gpu,
    is_known,
    numbers_at,
)
from lagjax._interface._registered import Registered, register, registered
from lagjax._interface._results import (
    ENDED_WELL,
    EVENT_OCCURRED,
    PUSHED,
    RESULTS,
    SUCCESSFUL,
    SimulationError,
    advice,
    code_of,
    join_names,
    name_of,
    result_from,
    show_str,
)
from lagjax._interface._validate import (
    all_finite,
    as_arrays,
    is_concrete,
    not_finite,
    output_times,
    require_budget,
    require_concrete,
    require_finite,
    require_flag,
    require_number,
    require_numbers,
    require_tolerance,
)
from lagjax._interface._version import VERSION
