"""Random scenes through `simulate_batch`, one after the other: does anything fail, and does memory stay where it is?

    python -m benchmarks.soak --minutes 60

Every scene is a new Lagrangian, natural or not, of one to four coordinates, so that it is traced, compiled and, in the
end, forgotten; its batches differ in size, tolerance and horizon. Their potentials confine and their mass matrices are
positive definite: every member must arrive, must keep its energy within what its tolerance allows, and must be, bit for
bit, what `simulate` makes of it alone. Anything else is a failure, and is listed with the seed of its scene.

After a warm-up, in which caches fill, the resident memory must stay flat within 5 %. What is watched is the memory of
lagjax. JAX keeps all that XLA compiles until `jax.clear_caches()`, which is called now and then, and XLA loses some
60 KiB with each compilation even so: therefore sizes of batches come from a short list, and the energy, which is
compiled for its scene, is looked at in one scene of five. The C library keeps what was freed, until it is told to give
it back. The record goes to `benchmarks/results/soak.json`, with commit, versions and machine.
"""

import argparse
import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report

WARM_UP = 100  # scenes: more than the caches of lagjax hold
FLAT = 0.05
BATCHES = 3  # of every scene
SIZES = (1, 3, 10, 30, 100, 300, 1000, 2000)  # of a batch
FORGET = 20  # scenes, after which JAX is told to
MAX_STEPS = 100_000


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run for so many minutes, print and store the record, and return it."""
    options = _options().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")
    record = soak(60 * options.minutes, options.seed, lambda line: print(line, file=sys.stderr, flush=True))
    record = {"circumstances": _report.circumstances(), "minutes": options.minutes, "seed": options.seed} | record
    options.output.mkdir(parents=True, exist_ok=True)
    _report.write_json(options.output / "soak.json", record)
    growth = "not known yet" if record["growth"] is None else f"{record['growth']:+.1%}"
    print(f"{record['scenes']} scenes, {record['members']} members, {record['steps']} steps")
    print(f"memory after the warm-up: {growth} (flat: within {FLAT:.0%})")
    print("\n".join(record["failures"]) or "no failure")
    return record


def soak(seconds: float, seed: int, say: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Random scenes for so long. `memory` holds (seconds, resident MiB) after every scene."""
    began, memory, failures, members, steps = time.monotonic(), [], [], 0, 0
    while not memory or memory[-1][0] < seconds:
        scene = len(memory)
        ran, found = run_scene(np.random.default_rng([seed, scene]), with_energy=scene % 5 == 0)
        failures += [f"scene {scene} of seed {seed}: {failure}" for failure in found]
        members, steps = members + ran[0], steps + ran[1]
        if scene % FORGET == 0:
            jax.clear_caches()
            gc.collect()
            _give_back_what_is_free()
        memory.append((time.monotonic() - began, resident()))
        if scene % 20 == 0:
            say(f"{memory[-1][0]:.0f} s: scene {scene}, {memory[-1][1]:.0f} MiB, {len(failures)} failures")
    growth = growth_of(memory)
    return {
        "scenes": len(memory),
        "members": members,
        "steps": steps,
        "growth": growth,
        "flat": None if growth is None else abs(growth) <= FLAT,
        "failures": failures,
        "memory": memory[:: max(1, len(memory) // 500)],
    }


def growth_of(memory: list[tuple[float, float]]) -> float | None:
    """By what part the memory grows from the first to the last quarter after the warm-up; None before there are any."""
    settled = np.array([size for _, size in memory[WARM_UP:]])
    if len(settled) < 8:
        return None
    first, *_, last = np.array_split(settled, 4)
    return float(np.median(last) / np.median(first) - 1)


def resident() -> float:
    """MiB of this process in memory."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not Linux: the largest so far
        import resource

        size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return size / 2**20 if sys.platform == "darwin" else size / 2**10
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _give_back_what_is_free() -> None:
    """Pages that the C library holds in its free lists are no leak, but would be counted as one."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):  # glibc only
        trim(0)


# ---- one scene -------------------------------------------------------------------------------------------------------


def run_scene(rng: np.random.Generator, with_energy: bool = True) -> tuple[tuple[int, int], list[str]]:
    """Members and steps of a few batches of a random scene, and what was wrong with them."""
    lagrangian, size, conservative = random_lagrangian(rng)
    system, failures, members, steps = lagjax.System(lagrangian), [], 0, 0
    for k in range(BATCHES):
        batch, rtol = int(rng.choice(SIZES)), 10 ** rng.uniform(-13.0, -4.0)
        ts = np.linspace(0.0, 10 ** rng.uniform(-1.0, 1.0), rng.integers(2, 20)) * rng.choice([-1.0, 1.0])
        q0, qdot0 = rng.uniform(-1.5, 1.5, (2, batch, size))
        params = {"k": rng.uniform(0.5, 2.0, batch)}
        try:
            run = lagjax.simulate_batch(
                system, q0, qdot0, ts, params, batch_axes=(0, 0, 0), rtol=rtol, max_steps=MAX_STEPS
            )
            # XLA compiles the energy for every shape, which takes longer than all the rest.
            looked_at = with_energy and conservative and k == 0
            failures += _faults(system, run, rtol, looked_at, int(rng.integers(batch)))
        except Exception as error:  # a record of whatever may come
            failures.append(f"{type(error).__name__}: {error}")
            continue
        members, steps = members + batch, steps + int(np.sum(run.stats["num_steps"]))
    del system, lagrangian
    gc.collect()  # a scene is a knot of cycles, which would lie about for a while
    return (members, steps), failures


def _faults(system, run: lagjax.Trajectory, rtol: float, with_energy: bool, member: int) -> list[str]:
    """What is wrong with a batch, in words."""
    found, ok = [], np.asarray(run.ok)
    if not ok.all():
        bad = int(np.argmin(ok))
        result = jax.tree.map(lambda codes: codes[bad], run.result)
        found.append(f"member {bad} of {len(ok)} did not arrive: {lagjax.RESULTS[result]}")
    q, qdot = np.asarray(run.q), np.asarray(run.qdot)
    if with_energy and ok.all():
        energy = np.asarray(run.energy())
        size = 1 + np.max(q**2, axis=(1, 2)) + np.max(qdot**2, axis=(1, 2))
        lost = np.abs(energy - energy[:, :1]).max(axis=1) / size
        allowed = 100 * max(rtol, 1e-15) * np.asarray(run.stats["num_steps"])
        if (lost > allowed).any():
            worst = int(np.argmax(lost / allowed))
            found.append(f"member {worst} loses {lost[worst]:.2g} of its energy at rtol = {rtol:.2g}")
    params = jax.tree.map(lambda leaf: np.asarray(leaf)[member], run.params)
    alone = lagjax.simulate(
        system, q[member, 0], qdot[member, 0], np.asarray(run.ts), params, rtol=rtol, max_steps=MAX_STEPS, throw=False
    )
    if not np.array_equal(np.asarray(alone.q), q[member], equal_nan=True):
        found.append(f"member {member} is another alone, by {np.abs(np.asarray(alone.q) - q[member]).max():.2g}")
    return found


def random_lagrangian(rng: np.random.Generator) -> tuple[Callable, int, bool]:
    """A Lagrangian of (q, q̇, params), its number of coordinates, and whether its energy is constant.

    L = ½ q̇ᵀM(q)q̇ + ¼ε|q̇|⁴ + a(q)·q̇ − ½k|q|² − Σ cₖ cos(wₖ·q + φₖ) (+ q·f cos t), M positive definite, where any part
    but the first and the quadratic potential may be absent.
    """
    n, waves = int(rng.integers(1, 5)), int(rng.integers(0, 4))
    root = rng.normal(size=(n, n))
    M = root @ root.T + n * np.eye(n)
    shape = rng.uniform(-0.3, 0.3, n) * rng.integers(2)  # of M: below one part in two of its least eigenvalue
    quartic, turning = rng.uniform(0.0, 0.3) * rng.integers(2), rng.uniform(-1.0, 1.0, (n, n)) * rng.integers(2)
    c, phase, w = rng.uniform(-1.0, 1.0, waves), rng.uniform(0.0, 6.0, waves), rng.uniform(-2.0, 2.0, (waves, n))
    drive, driven = rng.uniform(-0.5, 0.5, n), bool(rng.integers(4) == 0)

    def autonomous(q, qdot, params):
        kinetic = (
            0.5 * qdot @ M @ qdot + 0.5 * jnp.sum(shape * jnp.cos(q) * qdot**2) + 0.25 * quartic * (qdot @ qdot) ** 2
        )
        potential = 0.5 * params["k"] * q @ q + jnp.sum(c * jnp.cos(w @ q + phase))
        return kinetic + jnp.sin(q) @ turning @ qdot - potential

    def with_drive(q, qdot, t, params):
        return autonomous(q, qdot, params) + q @ drive * jnp.cos(t)

    return (with_drive if driven else autonomous), n, not driven


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--minutes", type=float, default=60.0, help="how long (default: 60)")
    add("--seed", type=int, default=0)
    add("--output", type=Path, default=Path(__file__).parent / "results", help="folder for soak.json")
    return parser


if __name__ == "__main__":
    main()
