# %% [markdown]
r"""
# A charge in crossed fields

A charge moves in a magnetic field B along z and an electric field E along y. The Lagrangian contains the velocity
linearly, in the potential **A**, so that L is not T − U:

$$ L = \tfrac12 m\,v^2 + e\,\mathbf v\cdot\mathbf A - e\varphi,\qquad \mathbf A = \tfrac12\mathbf B\times\mathbf r,
\qquad \varphi = -E\,y $$

Landau & Lifshitz, *The Classical Theory of Fields*, §22: the charge gyrates with eB/m about a point that drifts with
E/B at right angles to both fields, whatever its mass, charge and velocity. From rest the path is a cycloid.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

CHARGES = 40
FIELDS = {"m": 1.0, "e": 1.0, "E": 0.3, "B": 1.5}


def lagrangian(r, v, params):
    x, y = r
    A = 0.5 * params["B"] * jnp.array([-y, x])
    return 0.5 * params["m"] * v @ v + params["e"] * (v @ A + params["E"] * y)


charge = lagjax.System(lagrangian)
print(charge.explain(jnp.zeros(2), jnp.ones(2), params=FIELDS))

# %% [markdown]
"""
No coordinate is cyclic in this gauge, and yet two momenta are conserved: moving the charge changes L only by a total
derivative. They say where the centre of the circle is.
"""

# %%
print(lagjax.conserved_quantities(charge, jnp.zeros(2), jnp.ones(2), FIELDS))

# %% [markdown]
"""
Many charges leave one point with the same speed in all directions, as one batch. After every turn all of them meet
again, in a point that has moved by E/B · 2πm/eB.
"""

# %%
turn = 2 * jnp.pi * FIELDS["m"] / (FIELDS["e"] * FIELDS["B"])
ts = jnp.linspace(0.0, 3 * turn, 601)
directions = 2 * jnp.pi * jnp.arange(CHARGES) / CHARGES
drift = FIELDS["E"] / FIELDS["B"]
speed = 2.5 * drift
v0 = speed * jnp.stack([jnp.cos(directions), jnp.sin(directions)], axis=1)
fan = lagjax.simulate_batch(charge, jnp.zeros((CHARGES, 2)), v0, ts, FIELDS)
rest = lagjax.simulate(charge, jnp.zeros(2), jnp.zeros(2), ts, FIELDS)

ours, book = float(fan.q[:, -1, 0].mean() / ts[-1]), drift
height, book_height = float(rest.q[:, 1].max()), 2 * FIELDS["m"] * FIELDS["E"] / (FIELDS["e"] * FIELDS["B"] ** 2)
print(f"drift                  §22, E/B      {book:.12f}   lagjax {ours:.12f}")
print(f"height of the cycloid  §22, 2mE/eB²  {book_height:.12f}   lagjax {height:.12f}")
print(f"after three turns all {CHARGES} are within {jnp.ptp(fan.q[:, -1], axis=0).max():.0e} of one point")

# %%
figure, ax = plt.subplots(figsize=(7.2, 3.6))
for path, direction in zip(fan.q, directions, strict=True):
    ax.plot(*path.T, color=plt.colormaps["viridis"](0.45 - 0.45 * float(jnp.cos(direction))), linewidth=0.8)
ax.plot(*rest.q.T, color="black", linewidth=2.4, label="from rest: a cycloid")
meetings = drift * turn * jnp.arange(4)
ax.plot(meetings, 0 * meetings, "o", color="#D55E00", markersize=8, zorder=5, label="where all meet, after every turn")
ax.annotate(
    "E", (-0.62, 0.75), (-0.62, 0.35), arrowprops={"arrowstyle": "->", "lw": 1.6}, ha="center", annotation_clip=False
)
ax.text(-0.62, 0.1, "B ⊙", ha="center")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-0.78, 3.05))
ax.set_title(f"{CHARGES} charges leave one point, and drift with E/B")
ax.grid(False)
ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
Path("out").mkdir(exist_ok=True)
figure.savefig("out/crossed_fields.png")
