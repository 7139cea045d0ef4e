"""The motion of a kernel as a program for NVIDIA GPUs: one thread a member.

The module of one lane that runs on a CPU goes, unchanged, through LLVM's target for PTX, the assembly language that the
driver turns into machine code. Its entry `integrate` builds the job on the stack of its thread and calls `begin` and
`run`; a thread whose member has ended takes the next one from the counter that all share. Functions that are no
instruction come from libdevice, NVIDIA's library in LLVM's own form, which lies where pip has put `nvidia-cuda-nvcc`:
`jax[cuda12]` depends on it.

A program has one of two forms. Where the coefficients of a motion are few, the loops over orders are unrolled, at an
order that is lower than a CPU's if that keeps them few: no array is left, and the coefficients are registers, some of
which the assembler spills. Otherwise they stand in the memory of the thread.

What is here needs no GPU: it is assembled and checked on CPUs, and has not run on a GPU yet.
"""

import ctypes
import functools
import os
import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding as llvm

from lagjax._native._constants import LEAST_ORDER
from lagjax._native._frame import LANE
from lagjax._native._integrator import JOB, Integrator
from lagjax._native._ir import COUNTED
from lagjax._program._graph import Unlowerable

# The entry takes the addresses of these arrays, of doubles but for the words of `NUMBERS` and the counter.
ARGUMENTS = ("ts", "y0", "params", "numbers", "next_member", "path")
# A kernel's operands come first, then its results, of which the first two are the last two operands.
RESULTS = ("next_member", "path", "y_end", "t_end", "code", "steps", "rejected")
NUMBERS = ("members", "times", "ts_stride", "params_stride", "max_steps", "room_of_notes", "rtol", "atol")
# Threads of a block; and as many blocks as 132 multiprocessors hold with all registers of a thread: others would wait.
THREADS, MOST_BLOCKS = 64, 528
# Bytes that a thread may remember. The driver takes them for every thread that could be resident: of 2048 threads on
# 132 multiprocessors 8 GiB.
LARGEST_THREAD = 2**15
# Drivers of CUDA 12.0 read PTX 8.0, and make code from PTX for sm_70 for every processor since.
_PROCESSOR, _VERSION = "sm_70", "+ptx80"
# Coefficients of a motion, of its state and of the rows of its products, up to which it is unrolled. By the counts of
# `benchmarks.gpu_estimate`, with registers and spills as ptxas reports them, that is the best order to a tenth for a
# double pendulum (12), one with constraints (10) and a slider-crank (7); by a third more the spills of the latter two
# no longer stay in the caches. A chain of three has twice as many, and gains nothing.
MOST_COEFFICIENTS = 250
_ROUNDS = 2**63 - 1  # `max_steps` ends every member, and so the kernel
_TO_COUNTED = re.compile(rf'  br label %"({COUNTED}[.\d]*)"')
_FAR_ANGLES = ("sin", "cos")  # the C library's part in a sine is that of angles beyond 2**20
_lock = threading.Lock()


class GpuForm(NamedTuple):
    """The order of the series, and whether the loops over orders are `unrolled`."""

    order: int
    unrolled: bool


class OneLane(NamedTuple):
    """The text of an integrator of one lane, the doubles that a thread remembers, and how many series it has.

    Of a motion in tables (`large`) no loop can be unrolled.
    """

    text: str
    size: int
    series: int
    large: bool


def form_for(lane: OneLane, order: int) -> GpuForm:
    """The form that should take the least time, where a CPU takes series of this `order`."""
    fitting = MOST_COEFFICIENTS // lane.series
    return GpuForm(order, False) if lane.large or fitting < LEAST_ORDER else GpuForm(min(order, fitting), True)


def grid(members: int) -> tuple[int, int]:
    """The blocks, and the threads of each, for this many members."""
    return min(MOST_BLOCKS, max(1, -(-members // THREADS))), THREADS


def require_room(doubles: int) -> None:
    """Raise `Unlowerable` where a thread cannot remember this many numbers, which may be part of a motion's."""
    if 8 * doubles > LARGEST_THREAD:
        raise Unlowerable(
            f"a thread of a GPU would have to remember at least {8 * doubles} bytes of a motion, "
            f"more than {LARGEST_THREAD}; a CPU is the better choice"
        )  # fmt: skip


def one_lane(integrator: Integrator) -> OneLane:
    """The text of an integrator. Raises `Unlowerable`, whose text says why a GPU cannot run it."""
    motion = integrator.motion
    assert motion.width == 1, "a thread follows one member"
    size = motion.layout.size
    require_room(size)
    if motion.look_up.numbers is not None:
        raise Unlowerable("its tables of numbers (samples, jnp.interp, …) are not brought to a GPU; make them params")
    return OneLane(str(motion.module), size, motion.series.rows + motion.states, motion.large)


def program_for_gpus(lane: OneLane, form: GpuForm) -> str:
    """The PTX of an integrator in a form, with the entry `integrate(*ARGUMENTS, *RESULTS)`.

    Raises `Unlowerable` where its functions need libdevice, and that is missing.
    """
    with _lock:
        return _assembly(lane.text, lane.size, form)


def _assembly(text: str, size: int, form: GpuForm) -> str:
    machine = _target().create_target_machine(cpu=_PROCESSOR, features=_VERSION, opt=3)
    text = text.replace('target triple = ""', f'target triple = "{machine.triple}"')
    text = text.replace('target datalayout = ""', f'target datalayout = "{machine.target_data}"')
    external, library = re.findall(r'^declare double @"?(\w+)"?\(', text, re.MULTILINE), None
    text = _without_far_angles(text)
    if external := sorted({*external} - {*_FAR_ANGLES} - {"llvm"}):
        library = libdevice()
        if library is None:
            raise Unlowerable(
                f"its {', '.join(external)} come from NVIDIA's libdevice, which is not here; "
                "`pip install nvidia-cuda-nvcc-cu12` has it"
            )
        text = re.sub(rf'@"?({"|".join(external)})"?\(', r"@__nv_\1(", text)
    public = r'define (?:internal )?(void|i64) (@"\w+"\([^)]*\))(?=\s*\{)'
    text = re.sub(public, r"define internal \1 \2", text) + _entry(size, form.order)
    module = llvm.parse_assembly(_with_unrolled_loops(text) if form.unrolled else text)
    if library is not None:
        other = llvm.parse_bitcode(library)
        other.triple, other.data_layout = machine.triple, str(machine.target_data)
        module.link_in(other)
        for function in module.functions:
            if not function.is_declaration and function.name != "integrate":
                function.linkage = "internal"  # else all of the library stays
    module.verify()
    return machine.emit_assembly(_optimised(module, machine))


def _without_far_angles(text: str) -> str:
    """The text of a module in which the sine of an angle beyond 2**20 is NaN.

    A step to there is refused, so that the motion ends and says so. libdevice has such sines, with a reduction that
    every thread would keep room for.
    """
    for name in _FAR_ANGLES:
        nan = f'define internal double @"{name}"(double %x) {{\n  ret double 0x7FF8000000000000\n}}'
        text = re.sub(rf'declare double @"{name}"\([^)]*\)', nan, text)
    return text


def _with_unrolled_loops(text: str) -> str:
    """The text of a module in which the branches that close its counted loops ask for these to be unrolled."""
    entered, lines = set(), []
    for line in text.splitlines():
        if line.startswith("define"):
            entered = set()
        elif branch := _TO_COUNTED.fullmatch(line):
            line += ", !llvm.loop !0" if branch[1] in entered else ""  # the first branch to it enters the loop
            entered.add(branch[1])
        lines.append(line)
    return "\n".join([*lines, "!0 = distinct !{!0, !1}", '!1 = !{!"llvm.loop.unroll.full"}', ""])


def _entry(size: int, order: int) -> str:
    """The kernel's entry, in LLVM's language: a job on the stack, whose arrays are the arguments."""
    places = [*(f"ptr %{name}" for name in ARGUMENTS)]
    places += [f"ptr %{name}{'_out' if name in ARGUMENTS else ''}" for name in RESULTS]
    lines = [f"define ptx_kernel void @integrate({', '.join(places)}) {{"]
    lines += [f"  %memory = alloca [{size} x double], align 64", f"  %lanes = alloca [{len(LANE)} x i64]"]
    lines += ["  %idle = alloca i64", f"  %job = alloca [{len(JOB._fields_)} x i64]", "  store i64 0, ptr %idle"]
    known = {name: f"%{name}_out" if name in ARGUMENTS else f"%{name}" for name in RESULTS}
    known |= {name: f"%{name}" for name in ("ts", "y0", "params")}
    for i, (name, kind) in enumerate(JOB._fields_):
        lines.append(f"  %field{i} = getelementptr i64, ptr %job, i64 {i}")
        if name in NUMBERS:
            lines.append(f"  %place{i} = getelementptr i64, ptr %numbers, i64 {NUMBERS.index(name)}")
            lines += [f"  %value{i} = load i64, ptr %place{i}", f"  store i64 %value{i}, ptr %field{i}"]
        elif kind is ctypes.c_void_p:
            lines.append(f"  store ptr {known.get(name, 'null')}, ptr %field{i}")
        else:
            lines.append(f"  store i64 {order if name == 'order' else 0}, ptr %field{i}")
    lines += [
        f"  call void @llvm.memset.p0.i64(ptr align 64 %memory, i8 0, i64 {8 * size}, i1 false)",
        '  call void @"begin"(ptr %job, ptr %memory, ptr %lanes)',
        f'  %more = call i64 @"run"(ptr %job, ptr %memory, ptr %lanes, ptr %idle, i64 {_ROUNDS})',
        "  ret void", "}", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _optimised(module: llvm.ModuleRef, machine: llvm.TargetMachine) -> llvm.ModuleRef:
    """The module with its functions in one another, and its loops as they are but for those that ask to be unrolled."""
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
def _target() -> llvm.Target:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return llvm.Target.from_triple("nvptx64-nvidia-cuda")


@functools.cache
def libdevice() -> bytes | None:
    """NVIDIA's library of functions, as pip or CUDA's own installer has put it; None where it is not."""
    toolkits = [os.environ[name] for name in ("CUDA_HOME", "CUDA_PATH") if name in os.environ] + ["/usr/local/cuda"]
    places = [(folder or ".", "nvidia/*/nvvm") for folder in sys.path] + [(folder, "nvvm") for folder in toolkits]
    for folder, inside in places:
        for file in Path(folder).glob(f"{inside}/libdevice/libdevice.10.bc"):
            return file.read_bytes()
    return None


# ---- what the entry is given -----------------------------------------------------------------------------------------


def words(**numbers: float) -> list[int]:
    """The `NUMBERS` of a launch as whole numbers of 64 bits: doubles by their bits."""
    kinds: dict[str, Callable] = dict(JOB._fields_)
    return [ctypes.c_int64.from_buffer_copy(kinds[name](numbers[name])).value for name in NUMBERS]
