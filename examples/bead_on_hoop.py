# %% [markdown]
r"""
# A bead on a rotating hoop

A bead slides on a hoop of radius R that turns about its vertical diameter with Ω. With θ from the lowest point,

$$ L = \tfrac12 m R^2(\dot\theta^2 + \Omega^2\sin^2\theta) + m g R\cos\theta $$

Slow hoops leave the bead at the bottom. Beyond $\Omega_c^2 = g/R$ the bottom is unstable, and two new equilibria branch
off at $\cos\theta = g/(R\Omega^2)$: a pitchfork bifurcation (Strogatz, *Nonlinear Dynamics and Chaos*, §3.5). The bead
oscillates with

$$ \omega^2 = \frac gR - \Omega^2\ \text{ at the bottom},\qquad
   \omega^2 = \Omega^2 - \frac{g^2}{R^2\Omega^2}\ \text{ beside it} $$
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

G, R = 9.81, 1.0


def lagrangian(theta, omega, params):
    Omega = params
    return 0.5 * R**2 * (omega**2 + (Omega * jnp.sin(theta)) ** 2) + G * R * jnp.cos(theta)


hoop = lagjax.System(lagrangian)
state = (1.0, 0.3, 0.0, 4.0)  # θ, dθ/dt, t, Ω
print(f"the energy h = p q̇ − L = {hoop.energy(*state):.3f} is conserved; it is not T + U")

# %% [markdown]
"""
The bottom loses its stability where the stiffness there vanishes: four steps of Newton's method, on what `linearize`
says of the scene.
"""

# %%
stiffness = jax.jit(jax.value_and_grad(lambda Omega: -lagjax.linearize(hoop, 0.0, params=Omega).A[1, 0]))
critical = 2.0
for _ in range(6):
    value, slope = stiffness(critical)
    critical = critical - value / slope
ours, book = float(critical), float(jnp.sqrt(G / R))
print(f"critical Ω   √(g/R)  {book:.10f} rad/s   lagjax {ours:.10f}")

# %% [markdown]
"""
`equilibrium` and `normal_modes` work under `vmap`: a whole diagram at once. The guess decides which branch it finds.
"""

# %%
Omegas = jnp.linspace(0.2, 7.0, 69)


def rest(guess, Omega):
    theta = lagjax.equilibrium(hoop, guess, Omega).q
    modes = lagjax.normal_modes(hoop, theta, Omega)
    return theta, modes.frequencies[0], modes.stable


theta, frequency, stable = jax.jit(jax.vmap(rest))(Omegas / 5, Omegas)
bottom = jnp.where(Omegas < critical, 0.0, jnp.arccos(jnp.minimum(1.0, G / (R * Omegas**2))))
expected = jnp.sqrt(jnp.where(Omegas < critical, G / R - Omegas**2, Omegas**2 - (G / (R * Omegas)) ** 2))
error, frequency_error = float(abs(theta - bottom).max()), float(abs(frequency - expected).max())
print(
    f"angles are off by {error:.0e}, frequencies by {frequency_error:.0e}, at {Omegas.size} Ω; stable: {stable.all()}"
)

# %% [markdown]
"""
The picture: the effective potential −L(θ, 0) as a landscape. The bead rests in its valleys.
"""

# %%
angles = jnp.linspace(-jnp.pi, jnp.pi, 241)
fine = jnp.linspace(0.0, 7.0, 240)
landscape = jax.vmap(lambda a: jax.vmap(lambda o: -lagrangian(a, 0.0, o))(fine))(angles) / (G * R)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.7), width_ratios=[1.3, 1])
left.grid(False)
levels = left.contourf(fine, jnp.degrees(angles), landscape, 24, cmap="Blues_r")
left.plot(Omegas, jnp.degrees(theta), color="#D55E00", linewidth=2.5)
left.plot(Omegas, -jnp.degrees(theta), color="#D55E00", linewidth=2.5, label="stable")
left.plot([critical, 7], [0, 0], "--", color="#D55E00", linewidth=1.5, label="unstable")
left.axvline(critical, color="0.3", linewidth=0.8, linestyle=":")
left.set(xlabel="Ω [rad/s]", ylabel="θ [°]", title="Where the bead stays", xlim=(0, 7), yticks=range(-180, 181, 60))
left.legend(loc="upper left", labelcolor="0.1")
figure.colorbar(levels, ax=left, label="effective potential / mgR", pad=0.02, ticks=[-2, -1, 0, 1]).outline.set_visible(
    False
)
right.plot(Omegas, expected, color="#D55E00", linewidth=1, label="closed form")
right.plot(Omegas, frequency, "o", markersize=3.5, label="normal_modes")
right.axvline(critical, color="0.3", linewidth=0.8, linestyle=":")
right.annotate("Ω² = g/R", (critical, 0), (6, 2), textcoords="offset points", color="0.3", fontsize=9)
right.set(xlabel="Ω [rad/s]", ylabel="frequency of small oscillations [rad/s]", title="and how fast it trembles")
right.legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/bead_on_hoop.png")
