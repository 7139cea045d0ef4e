"""Two attractors of a driven pendulum: 100 000 starts over 1000 units of time, with 1000 outputs each.

    python -m benchmarks.basin --members 100000

The published batch of pyBasin: θ̈ = −0.1 θ̇ + ½ − sin θ at rtol 1e-8, atol 1e-6, starts uniform in
(−π + asin ½, π + asin ½) × (−10, 10). The share of starts that come to rest is compared with what was published, 15 %;
errors at the end, which nobody publishes, with DOP853 at 1e-13 on the first members. A pendulum that rotates for ever
advances by its error of speed: its angle is known worse than its speed.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from scipy.integrate import solve_ivp

import lagjax
from benchmarks import _report

STORE = Path(__file__).parent / "results" / "basin.json"
DAMPING, DRIVE, DURATION, OUTPUTS = 0.1, 0.5, 1000.0, 1000
RTOL, ATOL, ROUNDS, CHECKED = 1e-8, 1e-6, 3, 64


def pendulum() -> lagjax.System:
    return lagjax.System(
        lambda q, v: 0.5 * v**2 + jax.numpy.cos(q) + DRIVE * q, dissipation=lambda q, v: 0.5 * DAMPING * v**2
    )


def starts(members: int) -> np.ndarray:
    """(q, q̇), shape (2, members)."""
    rng, middle = np.random.default_rng(0), np.arcsin(DRIVE)
    return np.stack([rng.uniform(middle - np.pi, middle + np.pi, members), rng.uniform(-10, 10, members)])


def references(y0: np.ndarray) -> np.ndarray:
    """The ends by DOP853, (2, members)."""

    def rates(t, y):
        return [y[1], DRIVE - DAMPING * y[1] - np.sin(y[0])]

    ends = [solve_ivp(rates, (0.0, DURATION), y, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1] for y in y0.T]
    return np.transpose(ends)


def measured(members: int) -> dict:
    system, (q0, v0), ts = pendulum(), starts(members), np.linspace(0.0, DURATION, OUTPUTS)

    def run():
        trajectory = lagjax.simulate_batch(system, q0, v0, ts, rtol=RTOL, atol=ATOL)
        return jax.block_until_ready(trajectory)

    begun = time.perf_counter()
    trajectory = run()
    first, walls, cpus = time.perf_counter() - begun, [], []
    for _ in range(ROUNDS):
        del trajectory  # one of a hundred thousand takes 1.6 GB
        begun, used = time.perf_counter(), time.process_time()
        trajectory = run()
        walls.append(time.perf_counter() - begun)
        cpus.append(time.process_time() - used)
    end = np.stack([trajectory.end.q, trajectory.end.qdot])
    errors = np.abs(end[:, :CHECKED] - references(np.stack([q0, v0])[:, :CHECKED]))
    return {
        "members": members,
        "first s": first,
        "wall s": float(np.median(walls)),
        "CPU s": float(np.median(cpus)),
        "steps of a member": float(np.mean(trajectory.stats["num_accepted_steps"])),
        "share at rest": float(np.mean(np.abs(end[1]) < 1.0)),
        "failed": int(np.sum(~np.asarray(trajectory.ok))),
        "error of the angle, median and largest": [float(np.median(errors[0])), float(errors[0].max())],
        "error of the speed, median and largest": [float(np.median(errors[1])), float(errors[1].max())],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=100_000)
    parser.add_argument("--store", action="store_true", help=f"keep the result in {STORE}")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found = measured(options.members)
    for name, value in found.items():
        print(f"{name:42}", *(f"{x:.4g}" for x in np.atleast_1d(value)))
    if options.store:
        STORE.write_text(json.dumps({"circumstances": _report.circumstances()} | found, indent=1) + "\n")


if __name__ == "__main__":
    main()
