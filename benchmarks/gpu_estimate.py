"""An estimate of what motions take on GPUs, from the code that would run there. Nothing is measured on a GPU.

    python -m benchmarks.gpu_estimate

The PTX of every scene is run on the CPU, instruction by instruction, for a few members; its arithmetic in float64 and
float32 and its reads and writes of local memory are counted. `ptxas` (`pip install nvidia-cuda-nvcc-cu12`), where it
is, says how many registers, bytes of stack and spills a thread has. Each of these takes a member some time, if all
threads are at work; on an H100

    arithmetic    132 multiprocessors × 64 instructions of float64, or 128 of float32, a cycle × 1.98 GHz
    L1            132 × 16 doubles a cycle × 1.98 GHz, for local memory and spills
    memory        3.35 TB/s, for the part of local memory that the caches (256 KB a multiprocessor, 50 MB for all) do
                  not hold, as if every access to that part missed them

The longest of them is the estimate. Latencies, divergence and instruction caches come on top. Every scene is counted in
the form that it would have there (`_native.motions._gpu.form_for`) and with its series in local memory. The last rows
are the batches of published comparisons, and a GPU for desktops, whose float64 is slow. The last column is measured:
the same members in machine code on this machine's cores.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

import lagjax
from benchmarks import _report, basin
from benchmarks._ptx import PtxOnCpu, outputs_of
from lagjax import scenes
from lagjax._engine.taylor import _gpu_launch, _primitives
from lagjax._native import gpu

STORE = Path(__file__).parent / "results" / "gpu_estimate.json"
MEMBERS, BATCH, DURATION, RTOL = 4, 4096, 5.0, 1e-9
REGISTERS = 65536  # of a multiprocessor


class Processor(NamedTuple):
    """A GPU: instructions and doubles are those of a multiprocessor and cycle, the second cache is that of all."""

    name: str
    capability: str
    multiprocessors: int
    clock: float
    float64: float
    float32: float
    l1: float
    memory: float
    l1_bytes: float
    l2_bytes: float


H100 = Processor("H100", "sm_90", 132, 1.98e9, 64, 128, 16, 3.35e12, 256 * 1024, 50e6)
RTX_4090 = Processor("RTX 4090", "sm_89", 128, 2.52e9, 2, 128, 16, 1.01e12, 128 * 1024, 72e6)
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


class Run(NamedTuple):
    """The motions of a batch: of a scene's own start, with velocities that differ by up to a tenth, or of `starts`."""

    scene: Any  # with a system, q0, qdot0 and params
    duration: float = DURATION
    rtol: float = RTOL
    atol: float | None = None
    starts: tuple | None = None

    def given(self, members: int) -> tuple:
        """(q0, qdot0, params) of a few members."""
        scene, starts = self.scene, self.starts
        if starts is None:
            scales = jnp.linspace(0.9, 1.1, members)
            q0 = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), scene.q0)
            starts = q0, jax.tree.map(lambda x: jnp.multiply.outer(scales, x), scene.qdot0)
        return jax.tree.map(jnp.asarray, (*starts, scene.params))

    def motions(self, q0, v0, params, solver=None):
        """The trajectories, to their ends."""
        ts = jnp.array([0.0, self.duration])
        how = dict(rtol=self.rtol, atol=self.atol, solver=solver)
        return lagjax.simulate_batch(self.scene.system, q0, v0, ts, params, **how)


def end_of(run: Run, *given):
    """The end of a motion, from (q0, qdot0, params)."""
    return run.motions(*given, solver=lagjax.MachineCode()).end


def gradient_of(run: Run, *given):
    """The gradient of the sum of its coordinates and velocities there, by all of these."""
    return jax.grad(lambda given: sum(x.sum() for x in jax.tree.leaves(end_of(run, *given))))(given)


def form_of_transpose(_, lane: gpu.OneLane, order: int) -> gpu.GpuForm:
    """The form of a transpose, for its motion too: so that both take the same steps."""
    return as_chosen(gpu.TRANSPOSE, lane, order)


class Counted(NamedTuple):
    """The last launch for a result: its entry, its PTX, its instructions a step, and the steps of a member's motion."""

    entry: gpu.Entry
    program: str
    a_step: dict[str, float]
    steps: float


def counted(run: Run, form=as_chosen, result=end_of, members=MEMBERS) -> Counted:
    """The instructions of a `result`, in a form."""
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

    kept = _gpu_launch.launch, gpu.form_for
    _gpu_launch.launch, gpu.form_for = launch, form
    try:  # the rule of GPUs on the CPU
        of_gpus = _primitives._run_for_gpus, _primitives._vjp_for_gpus
        lower_by(mlir.lower_fun(rule, multiple_results=True) for rule in of_gpus)
        jax.block_until_ready(jax.jit(lambda given: result(run, *given))(run.given(members)))
    finally:
        lower_by(map(_primitives._lowering_rule, (_primitives._run_compiled, _primitives._vjp_compiled)))
        _gpu_launch.launch, gpu.form_for = kept
        jax.clear_caches()
    assert len(launched) <= 2, "a gradient that needs tangents, too, is not counted"
    of_entry = {entry: (program, counts, results) for entry, program, counts, results in launched}
    entry = gpu.TRANSPOSE if gpu.TRANSPOSE in of_entry else gpu.MOTION
    (program, counts, _), (*_, motion) = of_entry[entry], of_entry[gpu.MOTION]
    # A transpose does not write down how many steps it goes: in the same form as many as the motion.
    steps = motion["steps"].sum() + motion["rejected"].sum()
    return Counted(entry, program, {name: count / steps for name, count in counts.items()}, float(steps) / members)


def assembled(program: str, processor: Processor = H100) -> dict | None:
    """What a thread takes of a GPU, by `ptxas`; None where that is missing."""
    places = (file for folder in sys.path for file in Path(folder or ".").glob("nvidia/*/bin/ptxas"))
    if (ptxas := next(places, None)) is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "k.ptx"
        source.write_text(program)
        command = [ptxas, "-v", "-arch", processor.capability, source, "-o", Path(folder) / "k.cubin"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    report = done.stdout + done.stderr
    stack, *spills = (int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", report))
    (registers,) = map(int, re.findall(r"Used (\d+) registers", report))
    return {"registers": registers, "stack": stack, "spills": sum(spills)}


def bounds(counted: Counted, thread: dict, on: Processor = H100) -> dict:
    """The least times of a member in nanoseconds."""
    entry, _, a_step, steps = counted
    moved = steps * (a_step["local loads"] + a_step["local stores"] + thread["spills"] / 8)
    resident = min(gpu.MOST_BLOCKS[entry] * gpu.THREADS // on.multiprocessors, REGISTERS // thread["registers"])
    held = max(on.l1_bytes, on.l2_bytes / on.multiprocessors)
    beyond = max(0.0, 1.0 - held / max(held, resident * thread["stack"]))
    peak = on.multiprocessors * on.clock
    return {
        "arithmetic_ns": 1e9 * steps * max(a_step[kind] / getattr(on, kind) for kind in ("float64", "float32")) / peak,
        "L1_ns": 1e9 * moved / (peak * on.l1),
        "memory_ns": 1e9 * 8 * moved * beyond / on.memory,
    }


def on_this_machine(run: Run) -> float:
    """Nanoseconds of a member in machine code on these cores, the median of five batches."""
    times, given = [], run.given(BATCH)
    for _ in range(6):
        begun = time.perf_counter()
        jax.block_until_ready(run.motions(*given))
        times.append(time.perf_counter() - begun)
    return 1e9 * float(np.median(times[1:])) / BATCH


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    rows = []

    def estimate(name, *code, on=H100, form="as chosen", members=MEMBERS, **more):
        found = counted(*code, members=members)
        thread = assembled(found.program, on)
        row = {"scene": name, "GPU": on.name, "form": form, "steps": found.steps}
        row |= {f"{kind} a step": count for kind, count in found.a_step.items()}
        row |= {**thread, **bounds(found, thread, on)} if thread is not None else {}
        rows.append(row | more)

    for name, make in SCENES.items():
        run = Run(make())
        cpu = on_this_machine(run)
        for form, choose in FORMS.items():
            estimate(name, run, choose, form=form, cpu_ns=cpu)
    for name in ("pendulum", "double pendulum", "chain of 4"):
        estimate(f"{name}, transposed", Run(SCENES[name]()), form_of_transpose, gradient_of)
    double, rng = scenes.double_pendulum(), np.random.default_rng(0)
    anywhere = rng.uniform(-np.pi, np.pi, (64, 2)), np.zeros((64, 2))
    estimate("double pendulum from any angle, T = 15", Run(double, 15.0, starts=anywhere), members=64)
    driven = SimpleNamespace(system=basin.pendulum(), params=None)
    published = Run(driven, basin.DURATION, basin.RTOL, basin.ATOL, tuple(basin.starts(16)))
    estimate("driven pendulum, T = 1000", published, members=16)
    estimate("double pendulum", Run(double), on=RTX_4090)
    estimate("double pendulum, transposed", Run(double), form_of_transpose, gradient_of, on=RTX_4090)
    print(_report.table(rows))
    note = "an estimate from counted instructions; not run on a GPU"
    _report.write_json(STORE, {**_report.circumstances(), "note": note, "duration": DURATION, "scenes": rows})


if __name__ == "__main__":
    main()
