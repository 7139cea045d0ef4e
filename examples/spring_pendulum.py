# %% [markdown]
r"""
# The spring pendulum

A mass on a spring that may swing: r is its length, θ the angle from the vertical.

$$ L = \tfrac12 m(\dot r^2 + r^2\dot\theta^2) + m g r\cos\theta - \tfrac12 k(r-l)^2 $$

If it bounces twice as fast as it swings, ω_r = 2ω_θ, the bouncing drives the swing by parametric resonance (Landau &
Lifshitz, *Mechanics*, §27), and the energy goes to and fro between both. Bounces of amplitude C about the length r₀ are
a modulation h = 3C/r₀ of the frequency, by which small swings grow like e^{st} with

$$ s = \tfrac14 h\,\omega_\theta = \frac{3}{4}\frac{C}{r_0}\,\omega_\theta $$
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
PARAMS = {"m": 1.0, "l": 0.75, "k": 4 * G}  # k = 3mg/l: the resonance 2 : 1, at the length r₀ = 1


def lagrangian(q, v, params):
    m, k = params["m"], params["k"]
    kinetic = 0.5 * m * (v["r"] ** 2 + (q["r"] * v["theta"]) ** 2)
    return kinetic + m * G * q["r"] * jnp.cos(q["theta"]) - 0.5 * k * (q["r"] - params["l"]) ** 2


pendulum = lagjax.System(lagrangian)
hanging = lagjax.equilibrium(pendulum, {"r": 1.2, "theta": 0.1}, PARAMS).q
print(lagjax.normal_modes(pendulum, hanging, PARAMS))
omega = float(jnp.sqrt(G / hanging["r"]))

# %% [markdown]
"""
Pure bouncing is a periodic orbit. Its multipliers, by which small deviations grow in one period, tell how fast the
swing begins. Landau & Lifshitz's s is the limit of small bounces, with a relative error like C².
"""

# %%
rest = {"r": 0.0, "theta": 0.0}
for C in (0.1, 0.01):
    bouncing = {"r": hanging["r"] + C, "theta": 0.0}
    orbit = lagjax.periodic_orbit(pendulum, bouncing, rest, jnp.pi / omega, PARAMS)
    ours = float(jnp.log(jnp.abs(orbit.multipliers).max()) / orbit.period)
    book = 0.75 * C / float(hanging["r"]) * omega
    print(f"C = {C:4} m: growth of the swing  §27 {book:.6f} /s   lagjax {ours:.6f} /s")

# %% [markdown]
"""
Now with a swing of 0.02 rad at the start: after some bounces nearly all of the energy is in the swing, and comes back.
"""

# %%
ts = jnp.linspace(0.0, 60.0, 6001)
start = {"r": hanging["r"] + 0.1, "theta": 0.02}
motion = lagjax.simulate(pendulum, start, rest, ts, PARAMS)
r, theta = motion.q["r"], motion.q["theta"]
bouncing = 0.5 * motion.qdot["r"] ** 2 + 0.5 * PARAMS["k"] * (r - hanging["r"]) ** 2
swinging = 0.5 * (r * motion.qdot["theta"]) ** 2 + G * r * (1 - jnp.cos(theta))
print(f"share of the energy that goes into the swing: {float((swinging / (bouncing + swinging)).max()):.3f}")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.4), width_ratios=[1.25, 1])
early = ts < 26
lagjax.plot.path((r * jnp.sin(theta))[early], (-r * jnp.cos(theta))[early], values=ts[early], label="t [s]", ax=left)
left.set(xlabel="x [m]", ylabel="y [m]", title="The path of the mass")
left.grid(False)
right.plot(ts, bouncing, label="bouncing", linewidth=1.2)
right.plot(ts, swinging, label="swinging", linewidth=1.2)
right.set(xlabel="t [s]", ylabel="energy [J]", title="To and fro between both", ylim=(0, 0.27))
right.legend(loc="upper center", ncols=2)
Path("out").mkdir(exist_ok=True)
figure.savefig("out/spring_pendulum.png")
