"""Nonlinear normal modes of a double pendulum: frequency against energy from both linear modes up, with stability.

    python -m benchmarks._orbits_modes

Equal lengths and masses, g/l = 9.81; the energy is counted from rest, in units of m g l. The first mode is followed as
far as it goes, to where the period grows without end or the steps become too short; it says so.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import lagjax
from benchmarks._figures import save
from lagjax import scenes


def main() -> None:
    """Follow both families, print what happens along them, draw the plot."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks._orbits_modes", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=300, help="orbits of each family, at most")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    families = modes(options.count)
    for name, mode in families.items():
        _say(name, mode)
    _figure(families, options.output / "nonlinear_modes.png")


def modes(count: int) -> dict[str, lagjax.Family]:
    """The families that begin at the linear modes."""
    scene, found = scenes.double_pendulum(), {}
    linear = lagjax.normal_modes(scene.system, np.zeros(2), scene.params)
    for name, frequency, shape in zip(("in phase", "against"), linear.frequencies, linear.shapes, strict=True):
        start = 0.03 * np.asarray(shape) / np.abs(shape).max()
        period = float(2 * np.pi / frequency)
        begin = lagjax.periodic_orbit(scene.system, start, np.zeros(2), period, scene.params)
        found[name] = lagjax.family(scene.system, begin, scene.params, step=0.05, count=count)
    return found


def _energy(mode: lagjax.Family) -> np.ndarray:
    return np.asarray(mode.energy) / 9.81 + 3.0


def _say(name: str, mode: lagjax.Family) -> None:
    energy, frequency = _energy(mode), 2 * np.pi / np.asarray(mode.period)
    print(f"{name}: {len(energy)} orbits, E from {energy[0]:.4f} to {energy.max():.4f} m g l, frequency", end=" ")
    print(f"{frequency[0]:.4f} to {frequency[-1]:.4f}; closure {np.asarray(mode.closure).max():.1e}")
    for what in ("fold", "branch", "doubling"):
        places = np.flatnonzero(np.asarray(getattr(mode, what)))
        print(f"  {what}: E = {', '.join(f'{x:.4f}' for x in energy[places]) or 'none'}")
    changes = np.flatnonzero(np.diff(np.asarray(mode.stable).astype(int)))
    print(f"  stability changes at E = {', '.join(f'{x:.4f}' for x in energy[changes]) or 'none'}")
    print(f"  {mode.message}")


def _figure(families: dict[str, lagjax.Family], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, ax = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for (name, mode), color in zip(families.items(), lagjax.plot.COLORS, strict=False):
        energy, frequency, stable = _energy(mode), 2 * np.pi / np.asarray(mode.period), np.asarray(mode.stable)
        ax.plot(energy, frequency, color=color, linewidth=0.8)
        ax.scatter(energy[stable], frequency[stable], color=color, s=9, label=f"{name}, stable")
        ax.scatter(
            energy[~stable], frequency[~stable], edgecolors=color, facecolors="white", s=12, label=f"{name}, unstable"
        )
        for what, marker in (("fold", "s"), ("branch", "^"), ("doubling", "D")):
            some = np.asarray(getattr(mode, what))
            ax.scatter(energy[some], frequency[some], marker=marker, color="black", s=26, zorder=3)
    ax.set(xlabel="energy above rest [m g l]", ylabel="frequency [rad/s]")
    ax.legend(frameon=False)
    ax.grid(color="0.9", linewidth=0.8)
    path.parent.mkdir(exist_ok=True)
    save(ax.figure, path)


if __name__ == "__main__":
    main()
