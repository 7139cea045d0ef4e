# %% [markdown]
r"""
# A cube that tumbles, and lies still

A cube (edge 1, its edges rounded to the radius ρ) is thrown over a floor. It touches where a corner does: four gaps,
each with its sliding velocity, and Newton's and Coulomb's laws for all of them. Nothing else is said: when corners
strike, slip, stick, and that the last bounces pile up until a whole face lies on the floor, follows.

$$ L = \tfrac12 m(\dot x^2 + \dot y^2) + \tfrac1{12}m\,\dot\varphi^2 - m g y, \qquad y_k(\varphi) - \varrho \ge 0 $$
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

G, ROUND = 9.81, 0.1
DURATION = 2.0
LAWS = {"restitution": 0.3, "friction": 0.4}


def corners(q, rounding=ROUND):
    """The centres of the four rounded corners, (4, 2)."""
    c, s = jnp.cos(q["turn"]), jnp.sin(q["turn"])
    square = (0.5 - rounding) * jnp.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return jnp.stack([q["x"], q["y"]]) + square @ jnp.array([[c, s], [-s, c]])


def sliding(q, qdot):
    return jax.jvp(corners, (q,), (qdot,))[1][:, 0] + ROUND * qdot["turn"]


cube = lagjax.System(
    lambda q, v: 0.5 * (v["x"] ** 2 + v["y"] ** 2) + v["turn"] ** 2 / 12 - G * q["y"],
    contacts=lambda q: {"corner": corners(q)[:, 1] - ROUND},
    slip=lambda q, qdot: {"corner": sliding(q, qdot)},
    restitution=lambda params: params["restitution"], friction=lambda params: params["friction"],
)  # fmt: skip

# %%
q0, v0 = {"x": 0.0, "y": 2.0, "turn": 0.3}, {"x": 3.0, "y": 1.0, "turn": -6.0}
ts = jnp.linspace(0.0, DURATION, 201)
run = lagjax.simulate(cube, q0, v0, ts, LAWS)
impacts, end = run.impacts, jax.tree.map(lambda x: float(x[-1]), (run.q, run.qdot))
still = float(impacts.t[impacts.count - 1])
print(f"{int(impacts.count)} impacts; it lies still from {still:.4f} on, at x = {end[0]['x']:.4f}")
print(f"on a face: y = {end[0]['y']:.15f}, turned by {end[0]['turn'] / (np.pi / 2):.15f} quarters")
weight = run.contact_forces["corner"][-1]
print(f"the floor carries {float(weight.sum()):.12f} of {G}: {np.round(np.asarray(weight), 6)}")


def where(laws, v):
    return lagjax.simulate(cube, q0, v, ts[jnp.array([0, -1])], laws).q["x"][-1]


slopes = jax.jit(jax.jacfwd(where))(LAWS, v0)
print("d(where it lies) by", {name: round(float(value), 4) for name, value in slopes.items()})

# %% [markdown]
"""
The film, and all places in one picture: dots are impacts, darker where the blow was stronger.
"""

# %%
outline = np.linspace(0, 2 * np.pi, 80, endpoint=False)
outline = np.stack([np.cos(outline), np.sin(outline)], axis=1)
outline = jnp.array((0.5 - ROUND) * np.sign(outline) + ROUND * outline)


def picture(q):
    c, s = jnp.cos(q["turn"]), jnp.sin(q["turn"])
    edge = jnp.stack([q["x"], q["y"]]) + jnp.concatenate([outline, outline[:1]]) @ jnp.array([[c, s], [-s, c]])
    return {"cube": edge, "floor": jnp.array([[-1.0, 0.0], [4.5, 0.0]])}


Path("out").mkdir(exist_ok=True)
run.animate(picture, speed=0.5).save("out/tumbling_cube.gif")

figure, axes = plt.subplots(figsize=(7.6, 3.6))
for k in range(0, int(still / DURATION * len(ts)) + 8, 7):
    edge = picture(jax.tree.map(lambda x, k=k: x[k], run.q))["cube"]
    axes.plot(edge[:, 0], edge[:, 1], color=plt.colormaps["viridis"](0.9 * k / len(ts)), linewidth=1)
axes.axhline(0.0, color="0.4")
hits = np.nansum(np.asarray(impacts.impulse["corner"]), axis=1)
places = np.interp(np.asarray(impacts.t), np.asarray(ts), np.asarray(run.q["x"]))
axes.scatter(places, 0 * places, 40 * hits / np.nanmax(hits) + 1, color="#D55E00", zorder=5)
axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="Thrown, tumbled, and at rest on a face")
figure.savefig("out/tumbling_cube.png")
