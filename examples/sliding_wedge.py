# %% [markdown]
r"""
# A mass on a sliding wedge

A wedge (mass M, angle α) slides on a table, and a block (mass m) slides on the wedge, both without friction. X is where
the wedge is, x how far the block has moved along it horizontally, so that it stands at (X + x, x tan α):

$$ L = \tfrac12(M+m)\dot X^2 + m\dot X\dot x + \tfrac12 m(1+\tan^2\alpha)\,\dot x^2 - m g\,x\tan\alpha $$

X is cyclic: momentum along the table is conserved, and the centre of mass falls straight down. The accelerations are
constant,

$$ \ddot x = -\frac{(M+m)\,g\sin\alpha\cos\alpha}{M+m\sin^2\alpha},\qquad
   \ddot X = \frac{m\,g\sin\alpha\cos\alpha}{M+m\sin^2\alpha} $$

(Landau & Lifshitz, *Mechanics*, §7: a cyclic coordinate and its momentum.)
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

G = 9.81
PARAMS = {"M": 2.0, "m": 1.0, "alpha": jnp.radians(35.0)}


def lagrangian(q, v, params):
    M, m, slope = params["M"], params["m"], jnp.tan(params["alpha"])
    kinetic = 0.5 * (M + m) * v["X"] ** 2 + m * v["X"] * v["x"] + 0.5 * m * (1 + slope**2) * v["x"] ** 2
    return kinetic - m * G * q["x"] * slope


wedge = lagjax.System(lagrangian)
start, rest = {"X": 0.0, "x": 1.0}, {"X": 0.0, "x": 0.0}
print(wedge.explain(start, rest, params=PARAMS))
print("conserved:", lagjax.conserved_quantities(wedge, start, rest, PARAMS), sep="\n")

# %%
M, m, alpha = PARAMS["M"], PARAMS["m"], PARAMS["alpha"]
unit = G * jnp.sin(alpha) * jnp.cos(alpha) / (M + m * jnp.sin(alpha) ** 2)
book = {"x": -(M + m) * unit, "X": m * unit}
ours = wedge.acceleration(start, rest, params=PARAMS)
for name in book:
    print(f"acceleration of {name}   closed form {book[name]:+.12f} m/s²   lagjax {ours[name]:+.12f}")

# %% [markdown]
"""
The motion until the block reaches the table. The time it takes follows from `crossings`, with its derivative by the
mass of the wedge: a lighter wedge runs away faster.
"""


# %%
def landing(mass):
    section = lagjax.crossings(wedge, lambda q, v: q["x"], start, rest, jnp.array([0.0, 5.0]), PARAMS | {"M": mass})
    return section.t[0]


end, by_mass = jax.jit(jax.value_and_grad(landing))(M)
exact = jnp.sqrt(2 / -book["x"])
print(f"time to the table      closed form {exact:.12f} s      lagjax {end:.12f}   (∂/∂M {by_mass:.4f} s/kg)")
ts = jnp.linspace(0.0, end, 6)
motion = lagjax.simulate(wedge, start, rest, ts, PARAMS)

# %%
figure, ax = plt.subplots(figsize=(7.6, 3.5))
height = jnp.tan(alpha)
for i, (X, x) in enumerate(zip(motion.q["X"], motion.q["x"], strict=True)):
    last = i == len(ts) - 1
    color = plt.colormaps["viridis"](0.85 * i / (len(ts) - 1))
    label = f"t = {ts[i]:.2f} s"
    ax.fill([X, X + 1.25, X + 1.25], [0, 0, 1.25 * height], facecolor=color, alpha=0.10, linewidth=0)
    ax.plot([X, X + 1.25, X + 1.25, X], [0, 0, 1.25 * height, 0], color=color, linewidth=1)
    block = jnp.array([[0, 0], [0.16, 0], [0.16, 0.12], [0, 0.12], [0, 0]])
    turn = jnp.array([[jnp.cos(alpha), jnp.sin(alpha)], [-jnp.sin(alpha), jnp.cos(alpha)]])
    ax.fill(*(block @ turn + jnp.array([X + x, x * height])).T, color=color, label=label, zorder=3)
centre = jnp.stack([motion.q["X"] + m * motion.q["x"] / (M + m), m * motion.q["x"] * height / (M + m)])
ax.plot(*centre, "o", color="#D55E00", markersize=5, zorder=4, label="centre of mass")
ax.axhline(0, color="0.3", linewidth=1.2)
ax.set(aspect="equal", xlabel="along the table [m]", ylabel="height [m]", title="The wedge gives way")
ax.grid(False)
ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
Path("out").mkdir(exist_ok=True)
figure.savefig("out/sliding_wedge.png")
