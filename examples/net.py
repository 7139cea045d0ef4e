# %% [markdown]
r"""
# A net falls

Knots of mass 1 with rigid links of length l between neighbours, in Cartesian coordinates, held at two corners:

$$ L = \sum\tfrac12\dot{\mathbf r}_{ij}^2 - g\sum z_{ij},\qquad
   |\mathbf r_{i+1,j}-\mathbf r_{ij}| = |\mathbf r_{i,j+1}-\mathbf r_{ij}| = l $$

It begins as a sheet that is bent to a trough: every row is the same polygon, every column a straight line. Then it is
let go, swings down and crumples. `python examples/net.py` draws six instants, and prints how well each link keeps its
length, and the net its energy. A net of 24 × 24 takes less than a minute; one of 50 × 50 (7500 coordinates, 4906
constraints) some minutes, as the tensions of all links at each instant are found by conjugate gradients.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
from mpl_toolkits.mplot3d.art3d import Line3DCollection

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

KNOTS = 24
G = 9.81
LINK = 1 / (KNOTS - 1)  # m: the net is a metre wide
DURATION = 0.5  # s

slope = jnp.linspace(-0.9, 0.9, KNOTS - 1)
row = LINK * jnp.cumsum(jnp.stack([jnp.cos(slope), jnp.zeros(KNOTS - 1), jnp.sin(slope)], axis=1), axis=0)
row = jnp.concatenate([jnp.zeros((1, 3)), row])
column = LINK * jnp.arange(KNOTS)[:, None] * jnp.array([0.0, 1.0, 0.0])
start = row[:, None] + column
corners = jnp.array([0, KNOTS - 1]), jnp.array([0, 0])


def links(r):
    across, along = ((jnp.sum(jnp.diff(r, axis=axis) ** 2, axis=-1) - LINK**2) / (2 * LINK) for axis in (0, 1))
    return {"across": across, "along": along, "held": r[corners] - start[corners]}


net = lagjax.System(lambda r, v: 0.5 * jnp.sum(v**2) - G * jnp.sum(r[..., 2]), constraints=links)
ts = jnp.linspace(0.0, DURATION, 6)
motion = lagjax.simulate(net, start, 0 * start, ts, rtol=1e-5)

# %%
stretch = max(float(jnp.abs(gap).max()) for gap in motion.constraint_residual().values()) / LINK
energy, fallen = motion.energy(), 0.5 * jnp.sum(motion.qdot[-1] ** 2)
print(f"{start.size} coordinates, {motion.stats['num_steps']} steps; links keep their length to {stretch:.0e} of it")
print(f"energy off by {jnp.abs(energy - energy[0]).max() / fallen:.0e} of what has become motion")

# %%
figure, axes = plt.subplots(2, 3, figsize=(7.4, 4.4), subplot_kw={"projection": "3d"})
for ax, t, r in zip(axes.flat, ts, motion.q, strict=True):
    pairs = jnp.stack([r[1:], r[:-1]], axis=2), jnp.stack([r[:, 1:], r[:, :-1]], axis=2)
    segments = jnp.concatenate([pair.reshape(-1, 2, 3) for pair in pairs])
    lines = Line3DCollection(segments, cmap="viridis", linewidth=0.8)
    lines.set_array(jnp.concatenate([jnp.tile(jnp.arange(KNOTS), KNOTS - 1), jnp.tile(jnp.arange(KNOTS - 1), KNOTS)]))
    ax.add_collection(lines)
    ax.scatter(*r[corners].T, color="black", s=12, depthshade=False)
    ax.set(xlim=(0, 1), ylim=(-0.5, 1), zlim=(-1.0, 0.2))
    ax.text2D(0.45, 0.95, f"{t:.1f} s", transform=ax.transAxes)
    ax.set_box_aspect((1, 1.5, 1.2), zoom=1.4)
    ax.view_init(12, -55)
    ax.set_axis_off()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/net.png")
