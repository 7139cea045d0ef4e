# %% [markdown]
r"""
# The recurrence of Fermi, Pasta, Ulam and Tsingou

A chain of N springs that stiffen, between two walls (Los Alamos report 1940, 1955):

$$ L = \tfrac12\sum\dot q_j^2 - \sum\Big(\tfrac12 r_j^2 + \tfrac{\alpha}{3} r_j^3\Big),\qquad r_j = q_j - q_{j-1} $$

All energy begins in one mode, spreads over others, and comes back. `python examples/fput.py` draws the energies of the
modes, and the waves that run to the right, once a period: a sine breaks into solitons, which overtake each other until
they are a sine again (Zabusky & Kruskal, *Phys. Rev. Lett.* 15, 240, 1965). Mode k of N springs has nodes like walls,
and returns as mode 1 of n = N/k springs does, after $0.44\,n^{3/2}/\sqrt{\alpha a}$ periods (Zabusky 1969, a fit).
"""

# %%
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

SPRINGS = 1024
MODE = 16  # 8 takes eight times as long
ALPHA = 0.25
n = SPRINGS // MODE
amplitude = 55 / n / ALPHA  # n α a = 55 as Zabusky and Kruskal had it: some nine solitons


def lagrangian(q, qdot):
    r = jnp.diff(q, prepend=0.0, append=0.0)
    return 0.5 * jnp.sum(qdot**2) - jnp.sum(r**2 / 2 + ALPHA * r**3 / 3)


chain = lagjax.System(lagrangian)
start = amplitude * jnp.sin(jnp.pi * MODE * jnp.arange(1, SPRINGS) / SPRINGS)
book = 0.44 * n**1.5 / (ALPHA * amplitude) ** 0.5
ts = 2.0 * n * jnp.arange(1.15 * book)  # once a period
began = time.perf_counter()
motion = lagjax.simulate(chain, start, 0 * start, ts, rtol=1e-7, max_steps=1_000_000)
wall = time.perf_counter() - began

# %%
modes = jnp.arange(1, SPRINGS)
shapes = jnp.sqrt(2 / SPRINGS) * jnp.sin(jnp.pi / SPRINGS * jnp.outer(modes, modes))
squares = 4 * jnp.sin(jnp.pi * modes / (2 * SPRINGS)) ** 2
energies = 0.5 * ((motion.qdot @ shapes) ** 2 + squares * (motion.q @ shapes) ** 2)
shares = energies / energies[0].sum()
back = int(ts.size // 2 + jnp.argmax(shares[ts.size // 2 :, MODE - 1]))
others = float(jnp.delete(shares, modes[MODE - 1 :: MODE] - 1, axis=1).max())
drift = float(jnp.abs(motion.energy() / motion.energy()[0] - 1).max())
print(f"{100 * shares[back, MODE - 1]:.1f} % are back after {back} periods (Zabusky {book:.0f}), {wall:.0f} s")
print(f"energy kept to {drift:.0e}; in modes that the symmetry forbids {others:.0e}")
print(f"mode 1 of {SPRINGS} would return at t = {ts[back] * MODE**3:.1e}, in {wall * MODE**3 / 3600:.0f} hours")

# %%
r = jnp.diff(motion.q, prepend=0.0, append=0.0)
right = 0.5 * (motion.qdot - 0.5 * (r[:, 1:] + r[:, :-1]))
figure, (ax, map_) = plt.subplots(1, 2, figsize=(7.6, 3.7))
for k in range(1, 5):
    share = shares[:, k * MODE - 1]
    (line,) = ax.plot(share, zorder=5 - k)
    top = back if k == 1 else int(jnp.argmax(share))
    ax.text(top, share[top] + 0.02, f"{k * MODE}", color=line.get_color(), ha="center")
ax.set(xlabel="t [periods]", ylabel="share of the energy", title=f"{SPRINGS} springs: modes {MODE}, {2 * MODE}, …")
image = map_.imshow(right[:, : 4 * n], aspect="auto", origin="lower", cmap="magma", interpolation="none")
map_.set(xlabel="mass", ylabel="t [periods]", title="Waves to the right, once a period")
map_.grid(False)
figure.colorbar(image, ax=map_, label="½ (q̇ − r)")
Path("out").mkdir(exist_ok=True)
figure.savefig("out/fput.png")
