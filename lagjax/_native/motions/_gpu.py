"""The motion of a kernel, and its adjoint, as programs for NVIDIA GPUs: one thread per member.

The one-lane modules that run on a CPU are compiled, unchanged, by LLVM's target for PTX, the assembly language that the
driver translates. An entry (`_gpu_entry`) builds the job on the stack of its thread and calls their `begin` and `run`;
a thread whose member has ended takes the next one from a shared counter. Mathematical functions come from libdevice,
NVIDIA's library as LLVM bitcode, which is installed with the package `nvidia-cuda-nvcc`: `jax[cuda12]` depends on it.

A program has one of two forms. If a motion has few coefficients, the loops over orders are unrolled, at an order lower
than a CPU's if that keeps them few: then the coefficients are registers instead of arrays, though the assembler spills
some. Otherwise they are in the memory of the thread.

This file needs no GPU: its programs are assembled and checked on CPUs. `benchmarks.gpu` runs them on one.
"""

import functools
import math
import os
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import llvmlite.binding as llvm
from llvmlite import ir

from lagjax._native.code._constants import LEAST_ORDER
from lagjax._native.code._ir import DOUBLE, Code
from lagjax._native.motions._gpu_entry import MOTION, TRANSPOSE, Entry, GpuForm, OneLane, motion_entry, transpose_entry
from lagjax._native.series._taylor import TaylorSeries, choose_order
from lagjax._program import Unlowerable

# Threads of a block, and blocks: a motion has as many as 132 multiprocessors hold with all registers of a thread, for
# others would wait. With half as many, what a transpose spills stays in the caches, by `benchmarks.gpu_estimate`.
THREADS = 64
MOST_BLOCKS = {MOTION: 528, TRANSPOSE: 264}
# Bytes that a thread may remember. The driver takes them for every thread that could be resident: of 2048 threads on
# 132 multiprocessors 8 GiB.
LARGEST_THREAD = 2**15
# Drivers of CUDA 12.0 read PTX 8.0, and make code from PTX for sm_70 for every processor since.
_PROCESSOR, _VERSION = "sm_70", "+ptx80"
# Coefficients of a motion, of its state and of the rows of its products, up to which it is unrolled. By the counts of
# `benchmarks.gpu_estimate`, with registers and spills as ptxas reports them, that is the best order to a tenth for a
# double pendulum (12), one with constraints (10) and a slider-crank (7); by a third more the spills of the latter two
# no longer stay in the caches. A chain of three has twice as many, and gains nothing. A transpose has three times the
# values of a motion, and spills most of them; of a double pendulum it takes the least time at orders from 8 to 10.
MOST_COEFFICIENTS = {MOTION: 250, TRANSPOSE: 200}
# Doubles of the steps that all threads of a launch may write down: 2 GiB. Of a double pendulum, with as many threads as
# there are, two thousand steps.
LARGEST_RECORD = 2**28
_FAR_ANGLES = ("sin", "cos")  # the C library's part in a sine is that of angles beyond 2**20
_lock = threading.Lock()


class GpuPrograms:
    """The GPU programs of a kernel, compiled on first use.

    `motion` and `adjoint` make the modules of one lane. The tolerance determines the order of the series. Methods raise
    `Unlowerable`, with the reason, if a GPU cannot run the program.
    """

    def __init__(self, motion: Callable[[], TaylorSeries], adjoint: Callable[[], TaylorSeries]):
        self._lane = functools.cache(lambda: one_lane(motion()))
        self._lane_back = functools.cache(lambda: one_lane(adjoint()))
        self._motion = functools.cache(self._assemble_motion)
        self._transpose = functools.cache(self._assemble_transpose)

    def form(self, entry: Entry, rtol: float) -> GpuForm:
        return form_for(entry, self._lane(), choose_order(rtol))

    def motion(self, rtol: float) -> str:
        return self._motion(self.form(MOTION, rtol))

    def transpose(self, rtol: float) -> tuple[str, int]:
        """The PTX of the motion and adjoint of a member, and the number of doubles recorded per step."""
        return self._transpose(self.form(TRANSPOSE, rtol)), self._lane().row

    def _assemble_motion(self, form: GpuForm) -> str:
        with _lock:
            return _compile_ptx(motion_entry(self._lane(), form.order), [_parse_module(self._lane(), form)])

    def _assemble_transpose(self, form: GpuForm) -> str:
        """The PTX in which one thread runs an integrator, then its adjoint."""
        lane, back = self._lane(), self._lane_back()
        require_room(lane.size + back.size if form.unrolled else max(lane.size, back.size))
        with _lock:
            there_and_back = [_parse_module(lane, form), _parse_module(back, form)]
            for name in ("begin", "run"):
                there_and_back[1].get_function(name).name = f"{name}_back"
            return _compile_ptx(transpose_entry(lane, back, form), there_and_back)


def form_for(entry: Entry, lane: OneLane, order: int) -> GpuForm:
    """The form expected to be fastest for a motion whose series has this `order` on a CPU."""
    fitting = MOST_COEFFICIENTS[entry] // lane.series
    return GpuForm(order, False) if lane.large or fitting < LEAST_ORDER else GpuForm(min(order, fitting), True)


def grid_size(entry: Entry, members: int) -> tuple[int, int]:
    return min(MOST_BLOCKS[entry], max(1, -(-members // THREADS))), THREADS


def require_room(doubles: int) -> None:
    """Raise `Unlowerable` if a thread cannot hold this many doubles, a lower bound of what a motion needs."""
    if 8 * doubles > LARGEST_THREAD:
        raise Unlowerable(
            f"a thread of a GPU would have to remember at least {8 * doubles} bytes of a motion, "
            f"more than {LARGEST_THREAD}; a CPU is the better choice"
        )


def one_lane(motion: TaylorSeries) -> OneLane:
    """The one-lane module of a motion. Raises `Unlowerable` with the reason why a GPU cannot run it."""
    assert motion.width == 1, "a thread follows one member"
    require_room(motion.layout.size)
    if motion.look_up.numbers is not None:
        raise Unlowerable("its tables of numbers (samples, jnp.interp, …) are not brought to a GPU; make them params")
    return OneLane.from_motion(motion)


def _parse_module(lane: OneLane, form: GpuForm) -> llvm.ModuleRef:
    return llvm.parse_assembly(lane.unrolled if form.unrolled else lane.text)


def _compile_ptx(entry: str, parts: Sequence[llvm.ModuleRef]) -> str:
    """The PTX of an entry, linked with the modules that it calls."""
    machine = _gpu_target().create_target_machine(cpu=_PROCESSOR, features=_VERSION, opt=3)
    called = [of for part in parts for of in part.functions if of.is_declaration and not of.name.startswith("llvm.")]
    external = [of for of in called if of.name not in _FAR_ANGLES]
    whole, others = llvm.parse_assembly(entry), [*parts, _refuse_far_angles()]
    if external:
        if (library := libdevice()) is None:
            raise Unlowerable(
                f"its {', '.join(sorted({of.name for of in external}))} come from NVIDIA's libdevice, which is not "
                "here; `pip install nvidia-cuda-nvcc-cu12` has it"
            )
        others.append(llvm.parse_bitcode(library))
        for function in external:
            function.name = f"__nv_{function.name}"
    for module in (whole, *others):
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
    for module in others:
        whole.link_in(module)
    for function in whole.functions:
        if not function.is_declaration and function.name != "integrate":
            function.linkage = "internal"  # else all of the library stays
    whole.verify()
    return machine.emit_assembly(_inline_functions(whole, machine))


def _refuse_far_angles() -> llvm.ModuleRef:
    """A module whose sine and cosine are NaN beyond angles of 2**20.

    A step to such an angle is rejected, so that the motion ends with an error. libdevice's own reduction of large
    angles would take memory in every thread.
    """
    module = ir.Module("far_angles")
    module.triple = ""
    for name in _FAR_ANGLES:
        code = Code(module, name, [DOUBLE], lanes=1, result=DOUBLE, public=True)
        code.finish(code.as_value(math.nan, DOUBLE))
    return llvm.parse_assembly(str(module))


def _inline_functions(module: llvm.ModuleRef, machine: llvm.TargetMachine) -> llvm.ModuleRef:
    """The module with all functions inlined; loops are unrolled only where metadata demand it."""
    for function in module.functions:
        if not function.is_declaration and function.name != "integrate":
            function.add_function_attribute("alwaysinline")
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    first = llvm.create_new_module_pass_manager()
    first.add_sroa_pass()  # before functions are in one another: else their variables save the stack pointer
    first.run(module, llvm.create_pass_builder(machine, options))
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return module


@functools.cache
def _gpu_target() -> llvm.Target:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return llvm.Target.from_triple("nvptx64-nvidia-cuda")


@functools.cache
def libdevice() -> bytes | None:
    """The bitcode of NVIDIA's function library, as installed by pip or CUDA; None if it is not found."""
    toolkits = [os.environ[name] for name in ("CUDA_HOME", "CUDA_PATH") if name in os.environ] + ["/usr/local/cuda"]
    places = [(folder or ".", "nvidia/*/nvvm") for folder in sys.path] + [(folder, "nvvm") for folder in toolkits]
    for folder, inside in places:
        for file in Path(folder).glob(f"{inside}/libdevice/libdevice.10.bc"):
            return file.read_bytes()
    return None
