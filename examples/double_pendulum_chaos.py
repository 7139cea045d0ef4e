# %% [markdown]
r"""
# Two pendulums: modes, and chaos

Two equal pendulums (mass m, length l), the second of which hangs from the first:

$$ L = m l^2\Big(\dot\theta_1^2 + \tfrac12\dot\theta_2^2 + \cos(\theta_1-\theta_2)\,\dot\theta_1\dot\theta_2\Big)
   + m g l\,(2\cos\theta_1 + \cos\theta_2) $$

Small oscillations are two modes, $\omega^2 = (2 \mp \sqrt2)\,g/l$ with $\theta_2/\theta_1 = \pm\sqrt2$ (Landau &
Lifshitz, *Mechanics*, §23, problem 2). Large ones are chaotic: what begins side by side parts exponentially.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

G, LENGTH = 9.81, 1.0
NEIGHBOURS = 150
DURATION = 12.0


def lagrangian(theta, omega):
    coupling = jnp.cos(theta[0] - theta[1]) * omega[0] * omega[1]
    kinetic = LENGTH**2 * (omega[0] ** 2 + 0.5 * omega[1] ** 2 + coupling)
    return kinetic + G * LENGTH * (2 * jnp.cos(theta[0]) + jnp.cos(theta[1]))


pendulum = lagjax.System(lagrangian)

# %%
modes = lagjax.normal_modes(pendulum, jnp.zeros(2))
ours, book = modes.frequencies**2 * LENGTH / G, jnp.array([2 - jnp.sqrt(2.0), 2 + jnp.sqrt(2.0)])
ratios = modes.shapes[:, 1] / modes.shapes[:, 0]
for k in range(2):
    print(f"mode {k}: ω² l/g   §23  {book[k]:.12f}   lagjax {ours[k]:.12f}   θ₂/θ₁ = {ratios[k]:+.9f}")

# %% [markdown]
"""
Now the arms are let go at 150° and 30°, a hundred and fifty times, a millionth of a degree apart. `lyapunov_exponent`
follows a tangent of the first motion for long; the distance of two neighbours grows at about that rate, until it is as
large as the pendulum itself.
"""

# %%
start = jnp.radians(jnp.array([150.0, 30.0]))
shift = jnp.radians(1e-6) * jnp.arange(NEIGHBOURS)
thetas = start + jnp.stack([0 * shift, shift], axis=1)
ts = jnp.linspace(0.0, DURATION, 1201)
swarm = lagjax.simulate_batch(pendulum, thetas, jnp.zeros_like(thetas), ts, rtol=1e-12)

apart = jnp.sqrt(jnp.sum((swarm.q[1] - swarm.q[0]) ** 2 + (swarm.qdot[1] - swarm.qdot[0]) ** 2 * LENGTH / G, axis=-1))
exponent = lagjax.lyapunov_exponent(pendulum, start, jnp.zeros(2), 500.0)
rate, error = float(exponent.value), float(exponent.error)
print(f"Lyapunov exponent {rate:.2f} ± {error:.2f} /s: what is 1e-6° grows to 1° in {float(jnp.log(1e6)) / rate:.0f} s")

# %%
x = LENGTH * (jnp.sin(swarm.q[..., 0]) + jnp.sin(swarm.q[..., 1]))
y = -LENGTH * (jnp.cos(swarm.q[..., 0]) + jnp.cos(swarm.q[..., 1]))
shown = (ts > 8) & (ts < 11.5)
figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.5), width_ratios=[1.4, 1])
for k in range(NEIGHBOURS):
    color = plt.colormaps["viridis"](0.9 * k / NEIGHBOURS)
    left.plot(x[k][shown], y[k][shown], color=color, linewidth=0.5, alpha=0.5)
    left.plot(x[k][shown][-1], y[k][shown][-1], "o", color=color, markersize=2.5)
left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"The lower mass of {NEIGHBOURS}, 8 to 11.5 s")
right.semilogy(ts[1:], apart[1:], label="two neighbours")
right.semilogy(ts, apart[0] * jnp.exp(rate * ts), "--", label=f"growth by {rate:.2f} /s")
right.set(xlabel="t [s]", ylabel="distance in phase space", title="Side by side, but not for long")
right.legend(loc="upper left")
Path("out").mkdir(exist_ok=True)
figure.savefig("out/double_pendulum_chaos.png")
