"""Integration of batches in machine code made for one scene: the processor's vectors and all its cores.

    Program ──_program._series──► recurrences ──_integrator──► LLVM ──_ir──► Kernel(arrays) → arrays

XLA compiles one operation after the other for all members of a batch; here one member after the other goes through all
operations, four or eight side by side in the lanes of vector registers, and nothing leaves the first caches. A step is
one Taylor series, of the order that the tolerance asks for.

    _ir                  LLVM's instructions, written like arithmetic;  _objects: machine code kept on disk
    _lanes               the operations of a program on vectors, one by one: the form of small kernels
    _tables              the form of large ones: operations are data that one loop walks along;  _schedule: their order
    _table_reads         entries of tables, read from where the numbers of a member lie
    _constants           every numerical choice, with its reason
    _frame               the memory of a thread, the lanes and the job, as a function of a kernel sees them
    _motion_parts        the programs that a kernel is made from, and their series
    _taylor              the coefficients of a motion, and what is read off them along a step
    _projection          the way back to the constraints;  _rank_drops: where these become dependent
    _step                step control
    _watch               numbers that are followed against a level, and what is remembered of each
    _roots               the search along a step: the zeros of a polynomial
    _border_control      the action of borders: a step ends at the first one, at one of the _knots, or before one of the
                         _narrow_features;  _border_crossing: the piece beyond;  _border_kicks: the velocities there
    _guards              functions of the state that are watched;  _events: their actions, to stop the motion or to note
    _run_records         the outputs, and the record of steps
    _integrator          all of these, round by round
    _maps                what a step is composed of, each map with its pushforward and its pullback
    _saltation           one more such map: the jump of derivatives at a border, and at a knot of samples
    _retraction          one more: onto a border
    _tangent_memory      the memory of tangents;  _cotangents: that of cotangents
    _recorded_steps      recorded steps once more;  _tangent, _adjoint: their maps forward and back
    _kernel              motions and derivatives as functions of arrays;  _threads: on several cores, interruptible
    _handler             the motion as a call of XLA;  _derivative_handler: derivatives of short motions
    _line_handler        any straight line as a call of XLA;  _c_lines: the same as text in C
    _loops               loops and decisions over numbers, written in Python, as machine code
    _gpu                 the modules of one lane as programs for NVIDIA GPUs;  _gpu_entry: what a thread of these does

Nothing here knows JAX: arrays are NumPy's, and a program is data (`_program._series.Recurrent`).
"""

from lagjax._native import _gpu as gpu
from lagjax._native._c_lines import CNumbers, write_function
from lagjax._native._constants import (
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
from lagjax._native._derivative_handler import derivative_handler
from lagjax._native._guards import Guards, append_guards
from lagjax._native._handler import Plan, handler, make_once, unavailable
from lagjax._native._ir import lanes
from lagjax._native._kernel import Begun, Kernel, StepRecord, cores, floor_of
from lagjax._native._line_handler import LineCode, compilation_work, line_handler
from lagjax._native._loops import Floats, Loop, Struct, Wholes, compile_loops, evaluate, integrate, loop
from lagjax._native._motion_parts import Projection, pieces_of, recurrences
from lagjax._native._taylor import is_large, order_for
from lagjax._native._watch import Crossed
from lagjax._program import Nesting
