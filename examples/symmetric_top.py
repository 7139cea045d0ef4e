# %% [markdown]
r"""
# The symmetric top: nodding and sleeping

A top (moments A, A, C) stands on its tip; its axis leans by θ and turns by φ. Euler's angles have a pole where the top
stands upright. Coordinates without one: X + iY = tan(θ/2) e^{iφ}, a map of the sphere on the plane, and χ = φ + ψ.

$$ L = \frac{2A(\dot X^2+\dot Y^2)}{(1+\rho^2)^2} + \tfrac12 C\,\omega_3^2 - Mgl\,\frac{1-\rho^2}{1+\rho^2},\qquad
   \omega_3 = \dot\chi - \frac{2(X\dot Y-Y\dot X)}{1+\rho^2},\quad \rho^2 = X^2+Y^2 $$

Landau & Lifshitz, *Mechanics*, §35, problems 1 and 2. With $u=\cos\theta$ the top nods between two roots of the cubic

$$ \dot u^2 = (1-u^2)(\epsilon-\beta u) - (b-a u)^2,\qquad \beta=\frac{2Mgl}{A},\ a=\frac{C\omega_3}{A} $$

and it sleeps upright if $C^2\omega_3^2 > 4AMgl$.
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax

jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")

A, C, MGL = 1.0, 0.5, 2.0
SPIN = 9.0  # ω₃ of the tops that nod


def lagrangian(q, v):
    s = 1 + q["X"] ** 2 + q["Y"] ** 2
    omega3 = v["chi"] - 2 * (q["X"] * v["Y"] - q["Y"] * v["X"]) / s
    return 2 * A * (v["X"] ** 2 + v["Y"] ** 2) / s**2 + 0.5 * C * omega3**2 - MGL * (2 - s) / s


top = lagjax.System(lagrangian)


def axis(q):
    s = 1 + q["X"] ** 2 + q["Y"] ** 2
    return jnp.stack([2 * q["X"] / s, 2 * q["Y"] / s, (2 - s) / s])


# %% [markdown]
"""
Nodding: the axis begins at θ = 40° with three rates of precession. Its lowest and highest places are where d(ρ²)/dt
changes sign.
"""


# %%
def leaning(theta, phi_rate):
    X = jnp.tan(theta / 2)
    chi_rate = SPIN + 2 * X**2 * phi_rate / (1 + X**2)
    return {"X": X, "Y": 0.0, "chi": 0.0}, {"X": 0.0, "Y": X * phi_rate, "chi": chi_rate}


theta0, ts = float(np.radians(40.0)), jnp.linspace(0.0, 14.0, 2801)
paths = {}
for name, phi_rate in (("pushed on", 0.25), ("let go", 0.0), ("pushed back", -0.6)):
    start = leaning(theta0, phi_rate)
    section = lagjax.crossings(top, lambda q, v: q["X"] * v["X"] + q["Y"] * v["Y"], *start, ts)
    heights = np.append(np.cos(theta0), jax.vmap(axis)(section.q)[:, 2])
    u0, a, beta = np.cos(theta0), C * SPIN / A, 2 * MGL / A
    b = (1 - u0**2) * phi_rate + a * u0
    epsilon = (1 - u0**2) * phi_rate**2 + beta * u0
    book = np.sort(np.roots([beta, -(epsilon + a**2), 2 * a * b - beta, epsilon - b**2]).real)[:2]
    ours = np.array([np.nanmin(heights), np.nanmax(heights)])
    paths[name] = jax.vmap(axis)(lagjax.simulate(top, *start, ts).q)
    print(f"{name:11}  cos θ between  roots {book[0]:.9f}, {book[1]:.9f}   lagjax {ours[0]:.9f}, {ours[1]:.9f}")

# %% [markdown]
"""
Sleeping: upright and spinning is a steady motion, and `normal_modes` tells whether it is stable. Bisection finds the
least spin. A top that spins slower falls from upright to the other root of the cubic, cos θ = C²ω₃²/(2AMgl) − 1.
"""

# %%
upright, still = {"X": 0.0, "Y": 0.0, "chi": 0.0}, {"X": 0.0, "Y": 0.0}
sleeps = jax.jit(lambda spin: lagjax.normal_modes(top, upright, qdot=still | {"chi": spin}).stable)
low, high = 1.0, 12.0
for _ in range(40):
    middle = (low + high) / 2
    low, high = (low, middle) if sleeps(middle) else (middle, high)
least, book_least = high, float(np.sqrt(4 * A * MGL) / C)
print(f"least spin of a sleeping top  √(4AMgl)/C = {book_least:.9f} /s   lagjax {least:.9f} /s")

spins = jnp.linspace(2.0, 8.0, 61)
disturbed = {"X": 1e-4 * jnp.ones(61), "Y": jnp.zeros(61), "chi": jnp.zeros(61)}
turning = {"X": jnp.zeros(61), "Y": jnp.zeros(61), "chi": spins}
falls = lagjax.simulate_batch(top, disturbed, turning, jnp.linspace(0.0, 60.0, 3001))
lowest = jnp.degrees(jnp.arccos(jax.vmap(axis)({k: falls.q[k] for k in upright})[:, 2].min(axis=1)))

# %%
figure = plt.figure(figsize=(7.6, 5.8))
grid = figure.add_gridspec(2, 3, hspace=0.06)
turn = np.linspace(0, 2 * np.pi, 181)
for k, (name, path) in enumerate(paths.items()):
    ax = figure.add_subplot(grid[0, k])
    ax.fill(np.sin(turn), np.cos(turn), color="0.96")
    for latitude in (30, 60, 90):
        ax.plot(*(np.sin(np.radians(latitude)) * np.array([np.cos(turn), np.sin(turn)])), color="0.75", linewidth=0.7)
        if latitude == 90:
            ax.annotate("90°", (-0.72, -0.75), color="0.4", fontsize=8, ha="right", va="top")
        else:
            ax.annotate(f"{latitude}°", (0, 0.03 - np.sin(np.radians(latitude))), color="0.4", fontsize=8, ha="center")
    ax.plot(path[:, 0], path[:, 1], linewidth=1.7, color=f"C{k}")
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(name, loc="center", color=f"C{k}")
ax = figure.add_subplot(grid[1, :])
closed = np.degrees(np.arccos(np.clip(C**2 * np.asarray(spins) ** 2 / (2 * A * MGL) - 1, -1, 1)))
ax.plot(spins, closed, color="#D55E00", linewidth=1, label="root of the cubic")
ax.plot(spins, lowest, "o", markersize=3.5, label="begun 0.01° from upright")
ax.axvline(book_least, color="0.3", linewidth=0.8, linestyle=":")
ax.annotate("C²ω₃² = 4AMgl", (book_least, 60), (6, 0), textcoords="offset points", color="0.3")
ax.set(xlabel="spin ω₃ [1/s]", ylabel="farthest from upright, θ [°]", title="Awake, and asleep")
ax.legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/symmetric_top.png")
