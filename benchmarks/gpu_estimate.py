"""An estimate of what motions take on an H100, from the code that would run there. Nothing is measured on a GPU.

    python -m benchmarks.gpu_estimate

The PTX of every scene is run on the CPU, instruction by instruction, for a few members; its float64 arithmetic and its
reads and writes of local memory are counted. `ptxas` (`pip install nvidia-cuda-nvcc-cu12`), where it is, says how many
registers, bytes of stack and spills a thread has. Each of these takes a member some time, if all threads are at work:

    arithmetic    132 multiprocessors × 64 instructions a cycle × 1.98 GHz
    L1            132 × 16 doubles a cycle × 1.98 GHz, for local memory and spills
    HBM           3.35 TB/s, for the part of local memory that the caches (256 KB a multiprocessor, 50 MB for all) do
                  not hold, as if every access to that part missed them

The longest of them is the estimate. Latencies, divergence and instruction caches come on top. Every scene is counted in
the form that it would have there (`_native._gpu.form_for`) and with its series in local memory. The last column is
measured: the same members in machine code on this machine's cores.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

import lagjax
from benchmarks import _report
from benchmarks._ptx import PtxOnCpu, outputs_of
from lagjax import scenes
from lagjax._machine_code import _gpu_launch, _primitives
from lagjax._native import gpu

STORE = Path(__file__).parent / "results" / "gpu_estimate.json"
CLOCK, MULTIPROCESSORS, ARITHMETIC, L1, HBM = 1.98e9, 132, 64, 16, 3.35e12
REGISTERS, L1_BYTES, L2_BYTES = 65536, 256 * 1024, 50e6  # of a multiprocessor; L2 of all of them
MEMBERS, BATCH, DURATION, RTOL = 4, 4096, 5.0, 1e-9
as_chosen = gpu.form_for
FORMS = {"as chosen": as_chosen, "in memory": lambda _, lane, order: gpu.GpuForm(order, unrolled=False)}
SCENES = {
    "pendulum": scenes.pendulum,
    "Kepler": scenes.kepler,
    "double pendulum": scenes.double_pendulum,
    "double pendulum, constrained": scenes.cartesian_double_pendulum,
    "spherical pendulum": scenes.spherical_pendulum,
    "chain of 4": lambda: scenes.chain(4),
    "chain of 8": lambda: scenes.chain(8),
}


def starts(scene, members: int) -> tuple:
    """The scene's own start, with velocities that differ by up to a tenth."""
    scales = jnp.linspace(0.9, 1.1, members)
    q0 = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), scene.q0)
    return q0, jax.tree.map(lambda x: jnp.multiply.outer(scales, x), scene.qdot0)


def end_of(scene, *given):
    """The end of a motion, from (q0, qdot0, params)."""
    return motions(scene, *given, solver=lagjax.MachineCode()).end


def gradient_of(scene, *given):
    """The gradient of the sum of its coordinates and velocities there, by all of these."""
    return jax.grad(lambda given: sum(x.sum() for x in jax.tree.leaves(end_of(scene, *given))))(given)


def form_of_transpose(_, lane: gpu.OneLane, order: int) -> gpu.GpuForm:
    """The form of a transpose, for its motion too: so that both take the same steps."""
    return as_chosen(gpu.TRANSPOSE, lane, order)


class Counted(NamedTuple):
    """The last launch for a result: its entry, its PTX, its instructions a step, and the steps of a member's motion."""

    entry: gpu.Entry
    program: str
    a_step: dict[str, float]
    steps: float


def counted(scene, form=as_chosen, result=end_of) -> Counted:
    """The instructions of a scene's `result`, in a form."""
    launched = []

    def launch(entry, program, members, arrays, shapes):
        def host(*arrays):
            translated = PtxOnCpu(program, counting=True)
            arrays, outputs = outputs_of(entry, arrays, shapes)
            translated.thread(0, 1, 0, 1, *(x.ctypes.data for x in (*arrays, *outputs)))
            launched.append((entry, program, translated.counts, dict(zip(entry.results, outputs, strict=True))))
            return tuple(outputs[1:])

        results = tuple(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes)
        return list(jax.pure_callback(host, results, *(arrays[name] for name in entry.arguments)))

    def lower_by(rules):
        for primitive, rule in zip((_primitives.run_p, _primitives.vjp_p), rules, strict=True):
            mlir.register_lowering(primitive, rule, platform="cpu")

    kept, _gpu_launch.launch, gpu.form_for = (_gpu_launch.launch, gpu.form_for), launch, form
    try:  # the rule of GPUs on the CPU
        of_gpus = _primitives._run_for_gpus, _primitives._vjp_for_gpus
        lower_by(mlir.lower_fun(rule, multiple_results=True) for rule in of_gpus)
        given = *starts(scene, MEMBERS), jax.tree.map(jnp.asarray, scene.params)
        jax.block_until_ready(jax.jit(lambda given: result(scene, *given))(given))
    finally:
        lower_by(map(_primitives._for_cpus, (_primitives._run_compiled, _primitives._vjp_compiled)))
        _gpu_launch.launch, gpu.form_for = kept
        jax.clear_caches()
    assert len(launched) <= 2, "a gradient that needs tangents, too, is not counted"
    of_entry = {entry: (program, counts, results) for entry, program, counts, results in launched}
    entry = gpu.TRANSPOSE if gpu.TRANSPOSE in of_entry else gpu.MOTION
    (program, counts, _), (*_, motion) = of_entry[entry], of_entry[gpu.MOTION]
    # A transpose does not write down how many steps it goes: in the same form as many as the motion.
    steps = motion["steps"].sum() + motion["rejected"].sum()
    return Counted(entry, program, {name: count / steps for name, count in counts.items()}, float(steps) / MEMBERS)


def motions(scene, q0, v0, params, solver=None):
    ts = jnp.array([0.0, DURATION])
    return lagjax.simulate_batch(scene.system, q0, v0, ts, params, rtol=RTOL, solver=solver)


def assembled(program: str) -> dict | None:
    """What a thread takes of an H100, by `ptxas`; None where that is missing."""
    places = (file for folder in sys.path for file in Path(folder or ".").glob("nvidia/*/bin/ptxas"))
    if (ptxas := next(places, None)) is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "k.ptx"
        source.write_text(program)
        command = [ptxas, "-v", "-arch", "sm_90", source, "-o", Path(folder) / "k.cubin"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    report = done.stdout + done.stderr
    stack, *spills = (int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", report))
    (registers,) = map(int, re.findall(r"Used (\d+) registers", report))
    return {"registers": registers, "stack": stack, "spills": sum(spills)}


def bounds(counted: Counted, thread: dict) -> dict:
    """The least times of a member in nanoseconds."""
    entry, _, a_step, steps = counted
    moved = steps * (a_step["local loads"] + a_step["local stores"] + thread["spills"] / 8)
    resident = min(gpu.MOST_BLOCKS[entry] * gpu.THREADS // MULTIPROCESSORS, REGISTERS // thread["registers"])
    held = max(L1_BYTES, L2_BYTES / MULTIPROCESSORS)
    beyond = max(0.0, 1.0 - held / max(held, resident * thread["stack"]))
    peak = MULTIPROCESSORS * CLOCK
    return {
        "arithmetic_ns": 1e9 * steps * a_step["float64"] / (peak * ARITHMETIC),
        "L1_ns": 1e9 * moved / (peak * L1),
        "HBM_ns": 1e9 * 8 * moved * beyond / HBM,
    }


def on_this_machine(scene) -> float:
    """Nanoseconds of a member in machine code on these cores, the median of five batches."""
    q0, v0 = starts(scene, BATCH)
    times = []
    for _ in range(6):
        begun = time.perf_counter()
        jax.block_until_ready(motions(scene, q0, v0, scene.params))
        times.append(time.perf_counter() - begun)
    return 1e9 * float(np.median(times[1:])) / BATCH


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    rows = []

    def estimate(name, form, *code, **more):
        found = counted(*code)
        thread = assembled(found.program)
        row = {"scene": name, "form": form, "steps": found.steps}
        row |= {f"{kind} a step": count for kind, count in found.a_step.items()}
        row |= {**thread, **bounds(found, thread)} if thread is not None else {}
        rows.append(row | more)

    for name, make in SCENES.items():
        scene = make()
        cpu = on_this_machine(scene)
        for form, choose in FORMS.items():
            estimate(name, form, scene, choose, cpu_ns=cpu)
    for name in ("pendulum", "double pendulum", "chain of 4"):
        estimate(f"{name}, transposed", "as chosen", SCENES[name](), form_of_transpose, gradient_of)
    print(_report.table(rows))
    note = "an estimate from counted instructions; not run on a GPU"
    _report.write_json(STORE, {**_report.circumstances(), "note": note, "duration": DURATION, "scenes": rows})


if __name__ == "__main__":
    main()
