# %% [markdown]
r"""
# The driven and damped pendulum: a strange attractor

A pendulum in a bath, pushed by a periodic torque, in units of its own time √(l/g):

$$ L = \tfrac12\dot\theta^2 + \cos\theta + A\,\theta\cos\omega t,\qquad D = \frac{1}{2q}\dot\theta^2
   \quad\Rightarrow\quad \ddot\theta + \dot\theta/q + \sin\theta = A\cos\omega t $$

Seen once in every period of the drive its states lie on a strange attractor (Baker & Gollub, *Chaotic Dynamics*).
Two numbers, for q = 20, A = 0.6, ω = 0.7: volumes in phase space shrink by friction alone, so that the Lyapunov
exponents add up to −1/q; and the largest one is 0.140 (Sprott, *Chaos and Time-Series Analysis*, appendix A).
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

MEMBERS = 2000
PERIODS = 250
PARAMS = {"q": 20.0, "A": 0.6, "omega": 0.7}


def lagrangian(theta, rate, params, t):
    return 0.5 * rate**2 + jnp.cos(theta) + params["A"] * theta * jnp.cos(params["omega"] * t)


def friction(theta, rate, params):
    return 0.5 * rate**2 / params["q"]


pendulum = lagjax.System(lagrangian, dissipation=friction)

# %%
spectrum = lagjax.lyapunov_spectrum(pendulum, 0.1, 0.0, 500.0, PARAMS, rtol=1e-9)
total = -1 / PARAMS["q"]
print(f"sum of the exponents   −1/q    {total:.12f}   lagjax {spectrum.sum():.12f}")

angles = jnp.linspace(-3.0, 3.0, MEMBERS // 50)
exponents = lagjax.lyapunov_exponent(pendulum, angles, 0 * angles, jnp.full(angles.shape, 5000.0), PARAMS).value
ours, error, book = float(exponents.mean()), float(exponents.std() / len(angles) ** 0.5), 0.140
print(f"largest exponent       Sprott  {book:.3f}   lagjax {ours:.3f} ± {error:.3f} ({len(angles)} motions)")

# %% [markdown]
"""
The section needs no crossings: the outputs themselves are one period apart. All members are one batch; the first
periods, until they are on the attractor, are left out.
"""

# %%
period = 2 * jnp.pi / PARAMS["omega"]
starts = jax.random.uniform(jax.random.key(0), (MEMBERS, 2), minval=-2.0, maxval=2.0)
strobe = jnp.arange(PERIODS + 1) * period
batch = lagjax.simulate_batch(pendulum, starts[:, 0], starts[:, 1], strobe, PARAMS, rtol=1e-6)
print(batch)
settled = slice(PERIODS // 5, None)
theta = np.asarray((batch.q[:, settled] + jnp.pi) % (2 * jnp.pi) - jnp.pi).ravel()
rate = np.asarray(batch.qdot[:, settled]).ravel()

# %%
figure, ax = plt.subplots(figsize=(7.2, 4.4))
density, x, y = np.histogram2d(theta, rate, bins=(520, 330), range=[[-np.pi, np.pi], [-1.95, 2.55]])
image = ax.pcolormesh(x, y, np.where(density > 0, density, np.nan).T, norm=LogNorm(), cmap="inferno_r", rasterized=True)
figure.colorbar(image, label="visits", pad=0.02).outline.set_visible(False)
ax.set(xlabel="θ", ylabel="dθ/dt  [√(g/l)]", title=f"{theta.size:,} states, each one period of the drive after another")
ax.set_xticks([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi], ["−π", "−π/2", "0", "π/2", "π"])
ax.grid(False)
Path("out").mkdir(exist_ok=True)
figure.savefig("out/driven_pendulum.png")
