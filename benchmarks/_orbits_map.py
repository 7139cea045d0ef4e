"""The largest Lyapunov exponent of a double pendulum, let go at rest, over the plane of its two angles.

    python -m benchmarks._orbits_map --side 1000

T = 100, equal lengths and masses, g/l = 9.81. Prints the time, the memory, and how sure the exponents are.
"""

import argparse
import resource
import time
from pathlib import Path

import jax
import numpy as np

import lagjax
from benchmarks._figures import save
from lagjax import scenes

DURATION = 100.0


def main() -> None:
    """Follow the motions of all pixels, print what that took, draw the map."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks._orbits_map", description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=1000, help="pixels on each side")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    angles = np.pi * (2 * np.arange(options.side) + 1) / options.side - np.pi
    th1, th2 = (x.ravel() for x in np.meshgrid(angles, angles))
    wall, cpu = time.perf_counter(), time.process_time()
    found = exponents(np.stack([th1, th2], axis=1))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    value, error = np.asarray(found.value), np.asarray(found.error)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{len(th1)} pixels in {wall:.1f} s, {cpu:.1f} CPU seconds, {1e3 * cpu / len(th1):.3f} ms each", end="; ")
    print(f"{memory:.2f} GiB; {int(found.ok.sum())} followed")
    print(f"λ from {np.nanmin(value):.3f} to {np.nanmax(value):.3f}, standard errors {np.nanmedian(error):.3f}")
    figure(angles, value.reshape(options.side, -1), options.output / "lyapunov_map.png")


def exponents(q0: np.ndarray) -> lagjax.LyapunovExponent:
    """Those of pendulums let go at these angles (N, 2)."""
    scene = scenes.double_pendulum()
    return lagjax.lyapunov_exponent(scene.system, q0, np.zeros_like(q0), np.full(len(q0), DURATION), scene.params)


def figure(angles, value, path: Path) -> None:
    """Draw the map."""
    import matplotlib

    matplotlib.use("Agg")
    ax = lagjax.plot.state_map(angles, angles, value, label="λ₁, T = 100", cmap="inferno")
    ax.set(xlabel="θ1", ylabel="θ2", aspect="equal")
    path.parent.mkdir(exist_ok=True)
    save(ax.figure, path, dpi=110)


if __name__ == "__main__":
    main()
