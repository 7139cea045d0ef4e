"""Integration of batches of motions in machine code compiled for one scene, for vector registers and all cores.

    Program ──_program._series──► recurrences ──motions──► LLVM ──code._ir──► Kernel(arrays) → arrays

XLA executes one operation after another, each for all members of a batch; here one member after another passes through
all operations, four or eight of them side by side in the lanes of vector registers, and the data stay in the first
caches. A step is one Taylor series, whose order follows from the tolerance.

Four storeys, each built on those before it:

    code/       the means to emit machine code: instructions, memory, loops, constants, objects on disk
    series/     the Taylor series of a motion, on vectors or from tables, and the programs that it is made from
    steps/      a step: its size, its projection onto constraints, and the first event, knot or border in it
    motions/    whole motions, their derivatives, and their launchers: on threads, from XLA, on GPUs

This room does not import JAX: arrays are NumPy's, and a program is data (`_program._series.Recurrent`).
"""

from lagjax._native.code._constants import (
    ATOL_OVER_MOTION,
    ATOL_OVER_RTOL,
    DONE,
    EVENT,
    GUARD_NOISE,
    INSTANT,
    LARGEST_LINE,
    LEAST_ORDER,
    NOT_FINITE,
    OUT_OF_STEPS,
    SINGLE_NOISE,
    SINGULAR,
    SMALLEST_STEP,
    STEP_TOO_SMALL,
)
from lagjax._native.code._ir import lanes
from lagjax._native.code._loops import Floats, Loop, Struct, Wholes, compile_loops, evaluate, integrate, loop
from lagjax._native.motions import _gpu as gpu
from lagjax._native.motions._c_lines import CNumbers, write_function
from lagjax._native.motions._derivative_handler import derivative_handler
from lagjax._native.motions._handler import Plan, handler, make_once, unavailable
from lagjax._native.motions._kernel import Kernel, RunResults, Steps, cores, small_size
from lagjax._native.motions._line_handler import LineCode, compilation_work, line_function, line_handler
from lagjax._native.series._guards import Guards, append_guards
from lagjax._native.series._motion_parts import Projection, pieces_of, recurrences
from lagjax._native.series._taylor import choose_order, is_large
from lagjax._native.steps._watch import StepEnd
from lagjax._program import Nesting
