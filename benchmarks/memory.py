"""What a loop over models keeps in memory: scenes that are made anew, each with another number in its code.

    python -m benchmarks.memory                          # 1000 gradients, 100 hybrid motions, 50 runs of diffrax
    python -m benchmarks.memory --only gradient --scenes 250
    python -m benchmarks.memory --clear 10               # `jax.clear_caches()` after every ten scenes
    python -m benchmarks.memory --params                 # the number in `params`: one scene for all

Each kind runs in a process of its own. It prints the memory (resident, after a collection) and the CPU time that a
scene of the second half takes more than one of the first: caches of a bounded size are full by then.
"""

import argparse
import gc
import json
import subprocess
import sys
import time
from pathlib import Path

import diffrax
import jax
import numpy as np

import lagjax
from benchmarks import _report

STORE = Path(__file__).parent / "results" / "memory.json"
SCENES = {"gradient": 1000, "hybrid": 100, "diffrax": 50}
TS, START = np.array([0.0, 0.5, 1.0]), 1.0
BOUNCE = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))


def spring(k: float, in_params: bool) -> tuple[lagjax.System, float | None]:
    """An oscillator with the stiffness k, and its parameter."""
    if in_params:
        return SPRING, k
    return lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * k * q**2), None


SPRING = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params * q**2)


def gradient(scene, params) -> None:
    """The derivative of the end by the start."""
    jax.grad(lambda q: lagjax.simulate(scene, q, 0.0, TS, params).q[-1])(START)


def hybrid(scene, params) -> None:
    """A motion with a wall."""
    lagjax.simulate(lagjax.Hybrid({"flight": scene}, [BOUNCE], "flight"), START, 0.0, 3 * TS, params, max_transitions=4)


def by_diffrax(scene, params) -> None:
    """A motion by diffrax."""
    lagjax.simulate(scene, START, 0.0, TS, params, solver=diffrax.Tsit5())


KINDS = {"gradient": gradient, "hybrid": hybrid, "diffrax": by_diffrax}


def resident() -> float:
    """The memory of this process, MiB."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def soak(kind: str, scenes: int, clear: int, in_params: bool) -> dict:
    """MiB and CPU seconds of a scene, over the second half of so many."""
    jax.config.update("jax_enable_x64", True)
    seen = []
    for k in range(scenes + 1):
        if k in (scenes // 2, scenes):
            seen.append((k, resident(), time.process_time()))
        KINDS[kind](*spring(2.5 + k / scenes, in_params))
        if clear and k % clear == 0:
            jax.clear_caches()
            gc.collect()
    (first, before, begun), (last, after, ended) = seen
    count = last - first
    return {"kind": kind, "scenes": scenes, "clear": clear, "in params": in_params, "MiB in the end": after,
            "MiB a scene": (after - before) / count, "CPU s a scene": (ended - begun) / count}  # fmt: skip


def main(arguments: list[str] | None = None) -> list[dict]:
    """Each kind in a process of its own; the rows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.memory", description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=KINDS, nargs="+", default=list(KINDS))
    parser.add_argument("--scenes", type=int, nargs="+", help="of each kind (default: 1000, 100, 50)")
    parser.add_argument("--clear", type=int, default=0, help="clear the caches of JAX after so many scenes")
    parser.add_argument("--params", action="store_true", help="the number in params, in place of the code")
    parser.add_argument("--here", action="store_true", help="in this process")
    parser.add_argument("--store", action="store_true", help=f"keep the result in {STORE}")
    options, rows = parser.parse_args(arguments), []
    for kind, scenes in zip(options.only, options.scenes or map(SCENES.get, options.only), strict=True):
        if options.here:
            row = soak(kind, scenes, options.clear, options.params)
            print(json.dumps(row))
        else:
            more = ["--clear", str(options.clear), *(["--params"] if options.params else [])]
            command = [sys.executable, "-m", "benchmarks.memory", "--here", "--only", kind, "--scenes", str(scenes)]
            row = json.loads(subprocess.run([*command, *more], stdout=subprocess.PIPE, check=True).stdout)
            print(f"{kind:10}{scenes:6} scenes{row['MiB a scene']:8.2f} MiB{row['CPU s a scene']:8.3f} CPU s a scene, "
                  f"{row['MiB in the end']:.0f} MiB in the end", flush=True)  # fmt: skip
        rows.append(row)
    if options.store:
        STORE.write_text(json.dumps({"circumstances": _report.circumstances(), "rows": rows}, indent=1) + "\n")
    return rows


if __name__ == "__main__":
    main()
