"""The time after which a double pendulum first flips over, for every pair of angles: a map, from twelve lines.

python examples/flip_map.py --side 300 --out out

The sweep is stored in out/flips.zarr. Stopped at any moment and called again it computes what is missing, and so does
`python -m lagjax sweep run out/flips.zarr`; `python -m lagjax sweep status out/flips.zarr` tells how far it is.
"""

import argparse
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

import lagjax

SCENE = lagjax.scenes.double_pendulum()
FLIP = diffrax.Event(lambda q, qdot: jnp.pi**2 - jnp.max(q**2), direction=False)  # an arm goes over the top


def keep(trajectory):
    flipped = trajectory.result == lagjax.RESULTS.event_occurred
    return {"flip": jnp.where(flipped, trajectory.end.t, jnp.nan)}


def swept(side, duration, store):
    angles = np.pi * (2 * np.arange(side) + 1 - side) / side
    return lagjax.sweep(
        SCENE.system,
        {"theta1": angles, "theta2": angles},
        jnp.array([0.0, duration]),
        q0=lambda point: jnp.stack([point["theta1"], point["theta2"]]),
        qdot0=jnp.zeros(2),
        params=SCENE.params,
        keep=keep,
        store=lagjax.Store(store, event=FLIP, rtol=1e-6),
    )


def draw(data):
    figure, ax = plt.subplots(figsize=(7.4, 6.2), layout="constrained")
    data.flip.plot(x="theta1", y="theta2", ax=ax, norm=LogNorm(0.3), cbar_kwargs={"label": "first flip [s]"})
    ax.set(aspect="equal", xlabel="θ₁ at the start", ylabel="θ₂ at the start")
    ax.set_title("When a double pendulum first flips over")
    return figure


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=300, help="pendulums along each side (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=15.0, help="in seconds (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the picture (default: %(default)s)")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    sweep = swept(options.side, options.duration, options.out / "flips.zarr")
    print(sweep)
    picture = options.out / "flip_map.png"
    draw(sweep.open()).savefig(picture, dpi=150, bbox_inches="tight")
    return [picture]


if __name__ == "__main__":
    for picture in main():
        print(picture)
