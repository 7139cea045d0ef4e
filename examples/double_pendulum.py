"""Thousands of double pendulums at once: their paths, the cost of a digit, their energy, and when they first flip over.

python examples/double_pendulum.py --members 5000 --out out
"""

import argparse
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

import lagjax
import lagjax.plot
from lagjax import scenes

SCENE = scenes.double_pendulum()
START = np.array([2.0, 2.6])  # released from rest, high enough to be chaotic
NEIGHBOURS = 200


def second_bob(q, qdot):
    """Where the second bob is, for rods of length one; the pivot is the origin."""
    return jnp.sin(q[..., 0]) + jnp.sin(q[..., 1]), -jnp.cos(q[..., 0]) - jnp.cos(q[..., 1])


def before_flip(q, qdot):
    """Positive as long as neither arm has gone over the top."""
    return jnp.pi**2 - jnp.max(q**2)


def neighbours(duration):
    """Pendulums that start within a millionth of a radian of each other."""
    q0 = START + np.linspace(-0.5e-6, 0.5e-6, NEIGHBOURS)[:, None] * np.array([0.0, 1.0])
    ts = jnp.linspace(0.0, duration, round(200 * duration) + 1)
    return lagjax.simulate_batch(SCENE.system, q0, np.zeros_like(q0), ts, SCENE.params)


def crowd(members, duration):
    """Pendulums released from rest at any two angles."""
    q0 = np.random.default_rng(0).uniform(-np.pi, np.pi, (members, 2))
    ts = jnp.linspace(0.0, duration, 61)
    return lagjax.simulate_batch(SCENE.system, q0, np.zeros_like(q0), ts, SCENE.params)


def flip_times(resolution, duration):
    """Angles, and the time of the first flip over all pairs of them, from rest; NaN where there is none.

    Mirrored starts flip at the same time, so half of the map is enough.
    """
    half_cell = np.pi / resolution
    th = np.linspace(-np.pi + half_cell, np.pi - half_cell, resolution)
    upper = th[resolution // 2 :]
    q0 = np.stack(np.meshgrid(th, upper), axis=-1).reshape(-1, 2)
    trajectory = lagjax.simulate_batch(
        SCENE.system,
        q0,
        np.zeros_like(q0),
        jnp.array([0.0, duration]),
        SCENE.params,
        rtol=1e-6,
        event=diffrax.Event(before_flip, direction=False),
    )
    flipped = np.asarray(trajectory.result == lagjax.RESULTS.event_occurred)
    half = np.where(flipped, trajectory.end.t, np.nan).reshape(len(upper), resolution)
    return th, np.concatenate([half[::-1, ::-1][: resolution // 2], half])


def cost_of_a_digit(members, duration):
    """Error and time per trajectory, on a batch of moderate swings: what runs by default, then two solvers."""
    q0 = np.random.default_rng(0).uniform(-1.5, 1.5, (members, 2))
    ts = jnp.linspace(0.0, duration, 11)
    return lagjax.work_precision(
        SCENE.system,
        q0,
        np.zeros_like(q0),
        ts,
        SCENE.params,
        tolerances=[1e-4, 1e-6, 1e-8, 1e-10],
        batch_axes=(0, 0, None),
    )


def draw_paths(trajectory):
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", width_ratios=(1, 1.35))
    middle = np.asarray(trajectory.q)[len(trajectory.q) // 2]
    lagjax.plot.path(*second_bob(middle, None), values=trajectory.ts, label="t [s]", ax=left)
    left.set(title="The path of the second bob", xlabel="x [m]", ylabel="y [m]")

    colors = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(trajectory.q)))
    for turns, color in zip(np.asarray(trajectory.q)[:, :, 1] / (2 * np.pi), colors, strict=True):
        right.plot(trajectory.ts, turns, color=color, linewidth=0.6, alpha=0.6)
    right.set_title(f"{NEIGHBOURS} of them, started within a millionth of a radian")
    right.set(xlabel="t [s]", ylabel="turns of the second arm")
    right.spines[["top", "right"]].set_visible(False)
    right.grid(color="0.92")
    return figure


def draw_flips(th, times):
    _, ax = plt.subplots(figsize=(7.2, 6.2), layout="constrained")
    lagjax.plot.state_map(th, th, times, norm=LogNorm(0.3), label="first flip [s]", ax=ax)
    fine = np.linspace(-np.pi, np.pi, 601)
    ax.contour(fine, fine, 2 * np.cos(fine) + np.cos(fine)[:, None], levels=[1.0], colors="#0072B2", linewidths=1.2)
    ax.text(0, 0, "too little energy\nto flip", ha="center", va="center", color="#0072B2")
    ticks, names = np.pi * np.array([-1, -0.5, 0, 0.5, 1]), ["−π", "−π/2", "0", "π/2", "π"]
    ax.set(xticks=ticks, xticklabels=names, yticks=ticks, yticklabels=names, aspect="equal")
    ax.set(xlabel="θ₁ at the start", ylabel="θ₂ at the start", title="When a double pendulum first flips over")
    return ax.figure


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=2000, help="how many pendulums (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=15.0, help="in seconds (default: %(default)s)")
    parser.add_argument("--resolution", type=int, default=500, help="cells along the flip map (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default: %(default)s)")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    print(f"{options.members} double pendulums for {options.duration:g} s")
    trajectory = crowd(options.members, options.duration)
    print(
        f"{int(trajectory.ok.sum())} reached the end, in {float(trajectory.stats['num_steps'].mean()):.0f} steps each"
    )
    g, l = SCENE.params["g"], SCENE.params["l1"]
    energy = lagjax.plot.energy_error(trajectory, scale=3 * g * l)  # of unit masses that hang straight down
    energy.set(title=f"Energy of {options.members} double pendulums, rtol = 1e-9", xlabel="t [s]")

    print("\nWhat a digit costs on this scene, over 5 s from moderate angles")
    precision = cost_of_a_digit(min(options.members, 256), min(options.duration, 5.0))
    print(precision)
    cost = lagjax.plot.work_precision(precision)
    cost.set(title=f"{precision.members} double pendulums in one batch", xlabel="error of the angles [rad]")

    print(f"\nFirst flips of {options.resolution}² double pendulums")
    th, times = flip_times(options.resolution, options.duration)
    forbidden = 2 * np.cos(th) + np.cos(th)[:, None] > 1
    print(
        f"{np.isfinite(times).sum()} of {times.size} flip; {np.isfinite(times[forbidden]).sum()} of the "
        f"{forbidden.sum()} whose energy forbids it."
    )

    figures = {
        "double_pendulum_paths.png": draw_paths(neighbours(options.duration)),
        "double_pendulum_energy.png": energy.figure,
        "double_pendulum_cost.png": cost.figure,
        "double_pendulum_flips.png": draw_flips(th, times),
    }
    for name, figure in figures.items():
        figure.savefig(options.out / name, dpi=200)
        plt.close(figure)
    return [options.out / name for name in figures]


if __name__ == "__main__":
    for picture in main():
        print(picture)
