# %% [markdown]
r"""
# Kinks and breathers of the sine–Gordon equation

$$ L = h\sum\tfrac12\dot u_j^2 - \tfrac{1}{2h}\sum(u_{j+1}-u_j)^2 - h\sum(1-\cos u_j) $$

pendulums on a band that twists, a distance h apart: for h → 0 the equation $u_{tt} - u_{xx} + \sin u = 0$, of which a
kink that meets its opposite, and a breather that moves, are closed forms (Rajaraman, *Solitons and Instantons*, §2.5).
`python examples/sine_gordon.py` draws both in space and time, and by how much the lattice differs from them: h².
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

SITES = (256, 1024, 4096)
HALF = 24.0  # the band reaches from −24 to 24


def collision(x, t, v=0.6):
    """Kink and antikink pass each other at t = 0, and come out ahead of themselves."""
    gamma = (1 - v**2) ** -0.5
    return 4 * jnp.arctan(jnp.sinh(gamma * v * t) / (v * jnp.cosh(gamma * x)))


def breather(x, t, v=0.5, omega=0.4):
    """Kink and antikink that never part, seen from a train."""
    x, t = (1 - v**2) ** -0.5 * (x - v * t), (1 - v**2) ** -0.5 * (t - v * x)
    eta = (1 - omega**2) ** 0.5
    return 4 * jnp.arctan(eta / omega * jnp.sin(omega * t) / jnp.cosh(eta * x))


def lagrangian(u, udot, params):
    twist = jnp.diff(u, prepend=0.0, append=0.0) / params["h"]  # the ends are far away
    return 0.5 * jnp.sum(udot**2) - 0.5 * jnp.sum(twist**2) - jnp.sum(1 - jnp.cos(u))


band = lagjax.System(lagrangian)


def run(exact, sites):
    """The motion of `sites` pendulums that begins as `exact` does, and by how much it leaves it."""
    h = 2 * HALF / sites
    x, ts = h * jnp.arange(1, sites) - HALF, jnp.linspace(-20.0, 20.0, 401)
    u0, udot0 = jax.jvp(lambda t: exact(x, t), (ts[0],), (1.0,))
    motion = lagjax.simulate(band, u0, udot0, ts, {"h": h})
    return x, motion, float(jnp.abs(motion.q - exact(x, ts[:, None])).max())


# %%
figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.6), width_ratios=[1, 1, 0.9])
for exact, ax, color in zip((collision, breather), axes, ("#0072B2", "#D55E00"), strict=False):
    runs = [run(exact, sites) for sites in SITES]
    errors = jnp.array([error for *_, error in runs])
    orders = jnp.log(errors[:-1] / errors[1:]) / jnp.log(SITES[1] / SITES[0])
    for sites, error, order in zip(SITES[1:], errors[1:], orders, strict=True):
        print(f"{exact.__name__:9}  {sites:4} sites   off by {error:.2e}   order {order:.3f}   theory 2")
    x, motion, _ = runs[-1]
    wrapped = jnp.remainder(motion.q + jnp.pi, 2 * jnp.pi) - jnp.pi
    image = ax.imshow(wrapped, cmap="twilight", origin="lower", extent=(x[0], x[-1], *motion.ts[jnp.array([0, -1])]))
    ax.set(xlabel="x", ylabel="t", aspect="auto", title=f"{exact.__name__.capitalize()}, {SITES[-1]} sites")
    ax.grid(False)
    axes[2].loglog(SITES, errors, "o-", color=color, label=exact.__name__)
figure.colorbar(image, ax=axes[1], label="u modulo 2π")
axes[2].loglog(SITES, errors[-1] / 2 * (SITES[-1] / jnp.array(SITES)) ** 2, "--", color="0.5", label="h²")
axes[2].set(xlabel="sites", ylabel="largest error of u", title="Error of the lattice")
axes[2].set_xticks(SITES, SITES)
axes[2].minorticks_off()
axes[2].legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/sine_gordon.png")
