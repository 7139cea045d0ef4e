# %% [markdown]
r"""
# Foucault's pendulum

A weight on a wire of length l, seen from the turning Earth: x points east, y north, z up. In that frame its velocity is
**v** + **Ω** × **r**, and to first order in Ω

$$ L = \tfrac12 v^2 + \mathbf v\cdot(\mathbf\Omega\times\mathbf r) - g z,\qquad |\mathbf r| = l,\qquad
\mathbf\Omega = \Omega\,(0, \cos\lambda, \sin\lambda) $$

with the wire as a constraint. Landau & Lifshitz, *Mechanics*, §39, problem 3: the plane of small swings turns with
$-\Omega\sin\lambda$.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

DAY = 86164.1  # s, a turn of the Earth
HOURS = 24.0
PARIS = {"g": 9.809, "l": 67.0, "Omega": 2 * jnp.pi / DAY, "latitude": jnp.radians(48.846)}  # the Panthéon
SWING = 0.5  # m


def lagrangian(r, v, params):
    latitude = params["latitude"]
    Omega = params["Omega"] * jnp.array([0.0, jnp.cos(latitude), jnp.sin(latitude)])
    return 0.5 * v @ v + v @ jnp.cross(Omega, r) - params["g"] * r[2]


def wire(r, params):
    return {"wire": (r @ r - params["l"] ** 2) / (2 * params["l"])}


pendulum = lagjax.System(lagrangian, constraints=wire)


def aside(distance, params):  # let go at rest, to the east of where it hangs
    return jnp.array([distance, 0.0, -jnp.sqrt(params["l"] ** 2 - distance**2)]), jnp.zeros(3)


print(lagjax.check(pendulum, *aside(SWING, PARIS), params=PARIS))

# %% [markdown]
"""
For a day, `crossings` finds each instant when the weight is farthest out: there x ẋ + y ẏ falls through zero.
"""

# %%
span = jnp.array([0.0, HOURS * 3600])
farthest = lagjax.crossings(
    pendulum, lambda r, v: r[0] * v[0] + r[1] * v[1], *aside(SWING, PARIS), span, PARIS,
    direction=-1, count=12_000, max_steps=200_000,
)  # fmt: skip
swings = int(farthest.count)
t, x, y = farthest.t[:swings], *farthest.q[:swings, :2].T
plane = jnp.degrees(jnp.unwrap(2 * jnp.arctan2(y, x)) / 2)  # both sides are in one plane
plane = plane - plane[0]
ours = float(plane[-1] / (t[-1] - t[0]) * 3600)
book = float(-jnp.degrees(PARIS["Omega"] * jnp.sin(PARIS["latitude"])) * 3600)
print(f"degrees an hour   §39, −Ω sin λ  {book:.5f}   lagjax {ours:.5f}   ({swings} half swings)")
finite = -3 / 8 * (SWING / PARIS["l"]) ** 2
print(f"relative difference {ours / book - 1:.1e}; a swing of finite size makes −3a²/8l² = {finite:.1e}")

# %% [markdown]
"""
Were the day as short as four minutes, one would see it at a glance. A weight that is let go at rest *here* is moving
sideways already, so that it misses the middle.
"""

# %%
fast = PARIS | {"Omega": 2 * jnp.pi / 240.0}
rosette = lagjax.simulate(pendulum, *aside(SWING, fast), jnp.linspace(0.0, 319.0, 6001), fast)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.7), width_ratios=[1.15, 1])
lagjax.plot.path(*rosette.q[:, :2].T, values=rosette.ts, label="t [s]", ax=left)
left.set(xlabel="east [m]", ylabel="north [m]", title="If a day had four minutes")
right.plot(t / 3600, plane, linewidth=4, alpha=0.4, label="lagjax")
right.plot(span / 3600, span / 3600 * book, "--", color="#D55E00", label="§39: −Ω t sin λ")
right.set(xlabel="t [h]", ylabel="plane of the swing [°]", title="The Panthéon, through a day", xticks=range(0, 25, 6))
right.legend(loc="lower left")
Path("out").mkdir(exist_ok=True)
figure.savefig("out/foucault.png")
