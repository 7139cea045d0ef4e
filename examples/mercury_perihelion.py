# %% [markdown]
r"""
# Mercury's perihelion

A planet in the field of the Sun by general relativity: its Lagrangian is the rate of its proper time in
Schwarzschild's metric, with $r_s = 2GM/c^2$. Nothing in it is a kinetic minus a potential energy.

$$ L = -c^2\sqrt{\Big(1-\frac{r_s}{r}\Big) - \frac{\dot r^2}{c^2\,(1-r_s/r)} - \frac{r^2\dot\varphi^2}{c^2}} $$

Landau & Lifshitz, *The Classical Theory of Fields*, §101: the perihelion advances by

$$ \delta\varphi = \frac{6\pi GM}{c^2 a(1-e^2)} $$

in a revolution, for Mercury by 43″ in a century.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

GM = 4 * jnp.pi**2  # in astronomical units and years
C = 63241.077  # the velocity of light, AU/yr
A, E = 0.38709893, 0.20563069  # Mercury's orbit at J2000
YEARS = 100.0
ARCSECONDS = 180 * 3600 / jnp.pi


def lagrangian(q, v, params):
    c = params["c"]
    f = 1 - 2 * GM / (c**2 * q["r"])
    return -(c**2) * jnp.sqrt(f - v["r"] ** 2 / (c**2 * f) - (q["r"] * v["phi"] / c) ** 2)


planet = lagjax.System(lagrangian)
perihelion = {"r": A * (1 - E), "phi": 0.0}
velocity = {"r": 0.0, "phi": jnp.sqrt(GM * (1 + E) / (A * (1 - E))) / perihelion["r"]}

# %% [markdown]
"""
`crossings` follows the planet for a century and finds every perihelion: there r has a minimum, ṙ rises through zero.
The advance is what the angle φ has beyond whole turns.
"""

# %%
span = jnp.array([0.0, YEARS])
passages = lagjax.crossings(
    planet, lambda q, v: v["r"], perihelion, velocity, span, {"c": C}, direction=1, count=500, rtol=1e-13
)
turns = int(passages.count)
advance = (passages.q["phi"][:turns] - 2 * jnp.pi * jnp.arange(1, turns + 1)) * ARCSECONDS
per_century = 100 / passages.t[turns - 1]
ours = float(advance[-1] * per_century)
book = float(6 * jnp.pi * GM / (C**2 * A * (1 - E**2)) * ARCSECONDS * turns * per_century)
print(f'advance in a century   §101  {book:.4f}"   lagjax {ours:.4f}"   ({turns} revolutions)')

# %% [markdown]
"""
What it looks like if light were seven hundred times slower: the effect grows with 1/c².
"""

# %%
slow = lagjax.simulate(planet, perihelion, velocity, jnp.linspace(0.0, 6.0, 6001), {"c": C / 700})
x, y = slow.q["r"] * jnp.cos(slow.q["phi"]), slow.q["r"] * jnp.sin(slow.q["phi"])

figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.7), width_ratios=[1.15, 1])
lagjax.plot.path(x, y, values=slow.ts, label="t [yr]", ax=left)
left.plot(0, 0, "o", color="#E69F00", markersize=9)
left.set(xlabel="x [AU]", ylabel="y [AU]", title="Mercury, if light were 700 times slower")
left.grid(False)
right.plot(passages.t[:turns], advance, ".", markersize=3, label="lagjax, every perihelion")
right.plot(span, span * book / 100, color="#D55E00", linewidth=1, label="Landau & Lifshitz §101")
right.annotate(f"{ours:.2f}″", (YEARS, ours), (-6, -1), textcoords="offset points", ha="right", weight="bold")
right.set(xlabel="t [yr]", ylabel="advance of the perihelion [″]", title="and as it is")
right.legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/mercury_perihelion.png")
