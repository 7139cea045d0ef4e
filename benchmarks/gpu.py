"""Machine code on an NVIDIA GPU, measured: nanoseconds a member beside its error, and the time to the first result.

    python -m benchmarks.gpu --seconds 400

Every scene runs as one batch by `solver=lagjax.MachineCode()` under `jax.jit`, to its end at rtol 1e-9, and once more
in machine code on this machine's cores. Errors are those of the first members, beside machine code on a CPU at 1e-13.
`first` is a new process's way to the first result: the series, PTX, the driver's assembly and the run itself. Parts
begin in the order of `PARTS` while there is time left; what a part says is kept as it comes.

`--forms` measures the choices of `lagjax._native.motions._gpu` on a double pendulum: threads of a block, blocks, and
how many coefficients are registers.
"""

import argparse
import functools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report, basin
from lagjax import scenes
from lagjax._native import gpu

STORE = Path(__file__).parent / "results" / "gpu.json"
DURATION, RTOL, FINE, CHECKED, ROUNDS = 5.0, 1e-9, 1e-13, 256, 3
# Members of a batch: enough to fill the processor for a tenth of a second or so.
SCENES = {
    "pendulum": (scenes.pendulum, 2**20),
    "Kepler": (scenes.kepler, 2**20),
    "double pendulum": (scenes.double_pendulum, 2**20),
    "double pendulum, constrained": (scenes.cartesian_double_pendulum, 2**18),
    "spherical pendulum": (scenes.spherical_pendulum, 2**19),
    "chain of 4": (lambda: scenes.chain(4), 2**16),
    "chain of 8": (lambda: scenes.chain(8), 2**14),
}
MACHINE_CODE = lagjax.MachineCode()
ON_CPU = 2**14  # members of the same batch on the cores, at most


def starts(scene, members: int) -> tuple:
    """(q0, qdot0, params): the scene's own start, with velocities and displacements that differ by up to a tenth."""
    rng = np.random.default_rng(1)

    def spread(x):
        x = np.asarray(x, float)
        return x * rng.uniform(0.9, 1.1, (members, *x.shape)) + 0.0

    return jax.tree.map(spread, scene.q0), jax.tree.map(spread, scene.qdot0), scene.params


def constrained_starts(scene, members: int) -> tuple:
    """Starts on the constraints: the scene's own position, with velocities that differ by up to a tenth."""
    scales = np.random.default_rng(1).uniform(0.9, 1.1, members)
    q0 = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x, float), (members, *np.shape(x))), scene.q0)
    return q0, jax.tree.map(lambda x: np.multiply.outer(scales, np.asarray(x, float)), scene.qdot0), scene.params


def motions(system, ts, rtol, atol=None, solver=None) -> Callable:
    """The ends of a batch, from (q0, qdot0, params)."""

    def ends(q0, v0, params):
        run = lagjax.simulate_batch(system, q0, v0, ts, params, rtol=rtol, atol=atol, solver=solver)
        return run.end.q, run.end.qdot, run.ok, run.stats["num_accepted_steps"]

    return ends


def timed(function: Callable, *given) -> tuple[Any, float, list[float]]:
    """A result, the seconds to the first one, and those of every later run."""
    begun = time.perf_counter()
    result = jax.block_until_ready(function(*given))
    first, later = time.perf_counter() - begun, []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        jax.block_until_ready(function(*given))
        later.append(time.perf_counter() - begun)
    return result, first, later


def on_cpu(function: Callable, *given):
    with jax.default_device(jax.devices("cpu")[0]):
        return jax.block_until_ready(function(*given))


def flat(ends) -> np.ndarray:
    """Coordinates and velocities of the members, (members, 2n)."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(ends[:2])]
    return np.concatenate([x.reshape(x.shape[0], -1) for x in leaves], axis=1)


def measure(name: str, system, given: tuple, ts=None, rtol=RTOL, atol=None, solver=MACHINE_CODE) -> dict[str, Any]:
    """A batch on the GPU, its error, and the same batch on the cores."""
    members = len(jax.tree.leaves(given[0])[0])
    ts = jnp.array([0.0, DURATION]) if ts is None else ts
    ends = jax.jit(motions(system, ts, rtol, atol, solver))
    moved = jax.device_put(given[:2]), given[2]
    result, first, later = timed(ends, *moved[0], moved[1])
    few = jax.tree.map(lambda x: x[:CHECKED], given[:2])
    fine = on_cpu(motions(system, ts, FINE, FINE), *few, given[2])
    error = np.abs(flat(result)[:CHECKED] - flat(fine)).max(axis=1)
    less = jax.tree.map(lambda x: x[:ON_CPU], given[:2])
    _, _, cpu = on_cpu(functools.partial(timed, motions(system, ts, rtol, atol)), *less, given[2])
    return {
        "scene": name,
        "members": members,
        "first_s": first,
        "ns": 1e9 * min(later) / members,
        "cpu_ns": 1e9 * min(cpu) / min(members, ON_CPU),
        "steps": float(np.mean(np.asarray(result[3]))),
        "ok": float(np.mean(np.asarray(result[2]))),
        "median_error": float(np.median(error)),
        "largest_error": float(error.max()),
    }


def all_scenes() -> Iterator[dict]:
    for name, (make, members) in SCENES.items():
        scene = make()
        given = (starts if scene.system.constraints is None else constrained_starts)(scene, members)
        yield measure(name, scene.system, given)


def one_alone() -> Iterator[dict]:
    scene = scenes.double_pendulum()
    yield measure("double pendulum, one alone", scene.system, starts(scene, 1))


def gradients() -> Iterator[dict]:
    """Of the sum of coordinates and velocities at the end, by starts and parameters; beside the motion alone."""
    for name, members in (("pendulum", 2**18), ("double pendulum", 2**18), ("chain of 4", 2**13)):
        scene = SCENES[name][0]()
        given = starts(scene, members)

        def total(q0, v0, params, solver=None, system=scene.system):
            run = lagjax.simulate_batch(system, q0, v0, jnp.array([0.0, DURATION]), params, rtol=RTOL, solver=solver)
            return sum(x.sum() for x in jax.tree.leaves((run.end.q, run.end.qdot)))

        gradient = jax.jit(jax.grad(functools.partial(total, solver=MACHINE_CODE), (0, 1)))
        result, first, later = timed(gradient, *given)
        _, _, motion = timed(jax.jit(functools.partial(total, solver=MACHINE_CODE)), *given)
        few = jax.tree.map(lambda x: x[:CHECKED], given[:2])
        other = on_cpu(jax.jit(jax.grad(total, (0, 1))), *few, given[2])
        pairs = zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True)
        error = max(np.abs(np.asarray(x)[:CHECKED] / np.asarray(y) - 1.0).max() for x, y in pairs)
        yield {
            "scene": f"{name}, gradient", "members": members, "first_s": first, "ns": 1e9 * min(later) / members,
            "in_motions": min(later) / min(motion), "relative_error": float(error),
        }  # fmt: skip


def driven() -> Iterator[dict]:
    """pyBasin's batch (`benchmarks.basin`), to its end alone."""
    q0, v0 = basin.starts(100_000)
    ts = jnp.array([0.0, basin.DURATION])
    yield measure("driven pendulum, T = 1000", basin.pendulum(), (q0, v0, None), ts, basin.RTOL, basin.ATOL)


def many() -> Iterator[dict]:
    """10⁸ double pendulums from any angle over 15 units of time, in launches of 2²³ that the GPU draws itself."""
    scene, chunk, count = scenes.double_pendulum(), 2**23, 12
    ends = motions(scene.system, jnp.array([0.0, 15.0]), RTOL, solver=MACHINE_CODE)

    @jax.jit
    def batch(key):
        q0 = jax.random.uniform(key, (chunk, 2), float, -jnp.pi, jnp.pi)
        q, _, ok, steps = ends(q0, jnp.zeros_like(q0), scene.params)
        return q.sum(), ok.mean(), steps.mean()

    begun = time.perf_counter()
    jax.block_until_ready(batch(jax.random.key(0)))
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    rows = [batch(jax.random.key(1 + k)) for k in range(count)]
    jax.block_until_ready(rows)
    wall = time.perf_counter() - begun
    yield {
        "scene": "double pendulum from any angle, T = 15", "members": chunk * count, "first_s": first, "wall_s": wall,
        "ns": 1e9 * wall / (chunk * count), "ok": float(np.mean([r[1] for r in rows])),
        "steps": float(np.mean([r[2] for r in rows])),
    }  # fmt: skip


def jumps() -> Iterator[dict]:
    """A block with dry friction on a spring: borders, and rest."""
    system = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params: -params * jnp.sign(v))
    rng = np.random.default_rng(2)
    yield measure("dry friction", system, (rng.uniform(0.5, 2.0, 2**20), rng.uniform(-1, 1, 2**20), 0.1))


def single() -> Iterator[dict]:
    """A caller without the x64 switch."""
    with jax.enable_x64(False):
        scene = scenes.double_pendulum()
        given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), starts(scene, 2**20))
        ends = jax.jit(motions(scene.system, jnp.array([0.0, DURATION]), RTOL, solver=MACHINE_CODE))
        result, first, later = timed(ends, *given)
        few = jax.tree.map(lambda x: x[:CHECKED], given[:2])
        other = on_cpu(motions(scene.system, jnp.array([0.0, DURATION]), RTOL), *few, given[2])
        yield {
            "scene": "double pendulum, float32", "members": 2**20, "first_s": first, "ns": 1e9 * min(later) / 2**20,
            "largest_error": float(np.abs(flat(result)[:CHECKED] - flat(other)).max()),
        }  # fmt: skip


def peer() -> Iterator[dict]:
    """The same batches by diffrax's Dopri8 on the GPU."""
    for name, members in (("double pendulum", 2**18), ("chain of 4", 2**15), ("chain of 8", 2**12)):
        scene = SCENES[name][0]()
        row = measure(f"{name}, diffrax Dopri8", scene.system, starts(scene, members), solver=diffrax.Dopri8())
        del row["cpu_ns"], row["steps"]
        yield row


def forms() -> Iterator[dict]:
    """Threads of a block, blocks, and coefficients in registers, on a double pendulum of 2²⁰ members."""
    kept = gpu.THREADS, dict(gpu.MOST_BLOCKS), dict(gpu.MOST_COEFFICIENTS)
    choices = [(64, 528, 250), (32, 1056, 250), (128, 264, 250), (64, 1056, 250), (64, 264, 250), (64, 528, 200),
               (64, 528, 300), (64, 528, 220), (64, 528, 0), (64, 1056, 0), (64, 2112, 0)]  # fmt: skip
    for threads, blocks, coefficients in choices:
        try:
            gpu.THREADS, gpu.MOST_BLOCKS[gpu.MOTION], gpu.MOST_COEFFICIENTS[gpu.MOTION] = threads, blocks, coefficients
            jax.clear_caches()
            scene = scenes.double_pendulum()
            ends = jax.jit(motions(scene.system, jnp.array([0.0, DURATION]), RTOL, solver=MACHINE_CODE))
            result, first, later = timed(ends, *starts(scene, 2**20))
            steps = float(np.mean(np.asarray(result[3])))
            yield {
                "scene": f"{threads} threads, {blocks} blocks, {coefficients} coefficients", "first_s": first,
                "ns": 1e9 * min(later) / 2**20, "steps": steps,
            }  # fmt: skip
        finally:
            gpu.THREADS = kept[0]
            gpu.MOST_BLOCKS.update(kept[1])
            gpu.MOST_COEFFICIENTS.update(kept[2])


PARTS = {
    part.__name__: part
    for part in (all_scenes, one_alone, gradients, driven, jumps, many, single, peer)
}  # fmt: skip


def processor() -> dict[str, str]:
    device = jax.devices("gpu")[0]
    return {"kind": device.device_kind, "compute_capability": str(getattr(device, "compute_capability", ""))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="no part begins after this time (default: 600)")
    parser.add_argument("--parts", nargs="+", choices=[*PARTS, "forms"], default=list(PARTS))
    parser.add_argument("--output", type=Path, default=STORE)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record: dict[str, Any] = {**_report.circumstances(), "gpu": processor(), "cores": os.cpu_count(), "rows": []}
    begun = time.perf_counter()
    for name in options.parts:
        if time.perf_counter() - begun > options.seconds:
            print(f"no time left for {name}")
            continue
        part = forms if name == "forms" else PARTS[name]
        rows = part()
        while True:
            try:
                row = next(rows)
            except StopIteration:
                break
            except Exception as error:  # one part that fails leaves the others
                row = {"scene": name, "error": f"{type(error).__name__}: {str(error)[:2000]}"}
                record["rows"].append(row)
                print(row, flush=True)
                break
            record["rows"].append(row)
            print({key: f"{x:.4g}" if isinstance(x, float) else x for key, x in row.items()}, flush=True)
            _report.write_json(options.output, record)
    _report.write_json(options.output, record)


if __name__ == "__main__":
    main()
