# %% [markdown]
r"""
# A membrane is struck

100 × 100 masses on a square net of springs under tension, its edge held:

$$ L = \tfrac12\sum\dot u_{ij}^2 - \tfrac12\sum(u_{i+1,j}-u_{ij})^2 - \tfrac12\sum(u_{i,j+1}-u_{ij})^2,\qquad
   \omega_{kl}^2 = 4\sin^2\frac{k\pi}{2(N+1)} + 4\sin^2\frac{l\pi}{2(N+1)} $$

A hammer gives its middle a velocity. `python examples/membrane.py` draws the ring of waves that runs out, what the edge
makes of it, and the tones that a point hears: they stand at the frequencies of the closed form, and the whole motion is
that of N² independent modes (Rayleigh, *Theory of Sound*, §195).
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.fft import dstn, idstn

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

SIDE = 100
HAMMER = 3.0  # its radius, in distances of masses
DURATION = 60 * SIDE


def lagrangian(u, udot):
    across, along = (jnp.diff(jnp.pad(u, 1), axis=axis) for axis in (0, 1))
    return 0.5 * (jnp.sum(udot**2) - jnp.sum(across**2) - jnp.sum(along**2))


membrane = lagjax.System(lagrangian)
place = jnp.arange(1, SIDE + 1) - (SIDE + 1) / 2
blow = jnp.exp(-(place[:, None] ** 2 + place**2) / (2 * HAMMER**2))
ts = jnp.arange(0.0, DURATION, 1.0)
motion = lagjax.simulate(membrane, 0 * blow, blow, ts, max_steps=1_000_000)

# %%
angle = jnp.pi * jnp.arange(1, SIDE + 1) / (2 * (SIDE + 1))
book = 2 * jnp.sqrt(jnp.sin(angle[:, None]) ** 2 + jnp.sin(angle) ** 2)
exact = idstn(dstn(blow, 1) * np.sin(book * ts[-1]) / book, 1)
print(f"at t = {ts[-1]:.0f} off by {jnp.abs(motion.q[-1] - exact).max():.0e} of {jnp.abs(motion.q).max():.2f}")
lowest, ours = jnp.sort(book.ravel())[:4], lagjax.normal_modes(membrane, 0 * blow, count=4).frequencies
for k in range(4):
    print(f"mode {k}: closed form {lowest[k]:.12f}   lagjax {ours[k]:.12f}")

# %%
figure, axes = plt.subplot_mosaic("0123;4444", figsize=(7.6, 4.2), height_ratios=[1.25, 1])
for k, t in enumerate((24, 52, 80, 108)):
    largest = jnp.percentile(jnp.abs(motion.qdot[t]), 99)
    axes[f"{k}"].imshow(motion.qdot[t], cmap="RdBu_r", vmin=-largest, vmax=largest, interpolation="bicubic")
    axes[f"{k}"].set(title=f"t = {t}", xticks=[], yticks=[])
tone = jnp.abs(jnp.fft.rfft(motion.q[:, SIDE // 4, 2 * SIDE // 5] * jnp.hanning(ts.size)))
omega = 2 * jnp.pi * jnp.fft.rfftfreq(ts.size, ts[1] - ts[0])
struck = book[::2, ::2]  # the other modes are at rest in the middle
axes["4"].vlines(struck[struck < 0.4], 1e-4, 2, color="#D55E00", alpha=0.5, linewidth=1)
axes["4"].semilogy(omega, tone / tone.max())
axes["4"].set(xlim=(0, 0.4), ylim=(1e-4, 2), xlabel="ω", ylabel="loudness")
axes["4"].set_title("Heard at one place; lines: closed form")
Path("out").mkdir(exist_ok=True)
figure.savefig("out/membrane.png")
