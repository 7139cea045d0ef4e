# %% [markdown]
r"""
# The restricted problem of three bodies

A probe moves with Earth and Moon, seen from axes that turn along: units are their distance, their mass, and 1/2π of a
month. With masses 1 − μ at (−μ, 0) and μ at (1 − μ, 0),

$$ L = \tfrac12(\dot x - y)^2 + \tfrac12(\dot y + x)^2 + \frac{1-\mu}{r_1} + \frac{\mu}{r_2} $$

Its energy gives Jacobi's constant, C = −2h. There are five equilibria, Lagrange's points. L₄ and L₅ are stable as long
as $\mu < \tfrac12(1-\sqrt{23/27}) = 0.0385209$ (Routh 1875; Szebehely, *Theory of Orbits*, §5.4), and about the others
there are families of periodic orbits, those of Lyapunov.
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

MU = 0.012150585  # Earth and Moon
ORBITS = 60


def lagrangian(r, v, params):
    (x, y), mu = r, params
    potential = (1 - mu) / jnp.hypot(x + mu, y) + mu / jnp.hypot(x - 1 + mu, y)
    return 0.5 * (v[0] - y) ** 2 + 0.5 * (v[1] + x) ** 2 + potential


probe = lagjax.System(lagrangian)

# %%
guesses = jnp.array([[0.8, 0.0], [1.2, 0.0], [-1.0, 0.0], [0.5, 0.8], [0.5, -0.8]])
points = jnp.stack([lagjax.equilibrium(probe, guess, MU).q for guess in guesses])
# Euler's quintic for the distance of L1 from the Moon
quintic = np.roots([1, MU - 3, 3 - 2 * MU, -MU, 2 * MU, -MU])
book = 1 - MU - float(quintic[np.abs(quintic.imag) < 1e-12].real[0])
ours = float(points[0, 0])
print(f"L1 is at x = {book:.12f} (Euler's quintic)   lagjax {ours:.12f}")

# %% [markdown]
"""
When does L₄ lose its stability? Bisection on what `normal_modes` says of the equilibrium.
"""

# %%
triangle = jax.jit(lambda mu: lagjax.normal_modes(probe, jnp.array([0.5 - mu, jnp.sqrt(0.75)]), mu).stable)
low, high = 0.01, 0.1
for _ in range(45):
    middle = (low + high) / 2
    low, high = (middle, high) if triangle(middle) else (low, middle)
routh, book_routh = low, 0.5 * (1 - float(np.sqrt(23 / 27)))
print(f"L4 is stable up to μ = {book_routh:.12f} (Routh)   lagjax {routh:.12f}")

# %% [markdown]
"""
Lyapunov's orbits about L₁ and L₂: `normal_modes` gives the first, small one, `family` goes on to larger ones.
"""


# %%
def lyapunov_orbits(point):
    modes = lagjax.normal_modes(probe, point, MU)
    k = int(jnp.argmax(modes.frequencies))  # the other one grows
    omega, shape = modes.frequencies[k], modes.shapes[k] / modes.shapes[k, 0]
    q0, qdot0 = point + 0.01 * shape.real, 0.01 * (1j * omega * shape).real
    small = lagjax.periodic_orbit(probe, q0, qdot0, 2 * jnp.pi / omega, MU)
    return lagjax.family(probe, small, MU, until=-1.51, count=ORBITS)


families = [lyapunov_orbits(point) for point in points[:2]]
for name, orbits in zip(("L1", "L2"), families, strict=True):
    C = -2 * orbits.energy
    months = orbits.period[jnp.array([0, -1])] / (2 * jnp.pi)
    print(f"{name}: {C.size} orbits, C = {C[0]:.3f} … {C[-1]:.3f}, periods {months[0]:.3f} … {months[1]:.3f} months")

# %%
jacobi = jax.jit(jax.vmap(jax.vmap(lambda x, y: 2 * lagrangian(jnp.array([x, y]), jnp.zeros(2), MU))))
levels = [2.98, 3.0, 3.012, 3.04, 3.08, 3.12, 3.172, 3.188, 3.25, 3.4, 3.7, 99]
shades = plt.colormaps["Blues"](np.linspace(0.02, 0.6, len(levels) - 1))

figure, axes = plt.subplots(1, 2, figsize=(7.6, 3.9), width_ratios=[1.12, 1])
for ax, (width, height, middle) in zip(axes, ((1.4, 1.3, 0.0), (0.25, 0.26, 1.0)), strict=True):
    x, y = np.meshgrid(np.linspace(middle - width, middle + width, 400), np.linspace(-height, height, 400))
    ax.contourf(x, y, np.minimum(jacobi(x, y), 98), levels, colors=shades)
    ax.contour(x, y, jacobi(x, y), levels[:-1], colors="white", linewidths=0.6)
    for orbits in families:
        for k in range(0, orbits.period.size, 2):
            ring = lagjax.simulate(probe, orbits.q0[k], orbits.qdot0[k], jnp.linspace(0, orbits.period[k], 301), MU)
            ax.plot(*ring.q.T, color=plt.colormaps["plasma"](0.85 * k / orbits.period.size), linewidth=1.1)
    ax.plot([-MU], [0], "o", color="#0072B2", markersize=12)
    ax.plot([1 - MU], [0], "o", color="0.35", markersize=4 if width > 1 else 9)
    ax.plot(*points.T, "k+", markersize=8)
    ax.set(aspect="equal", xlabel="x [distance of the Moon]", ylabel="y")
    ax.set(xlim=(middle - width, middle + width), ylim=(-height, height))
    ax.grid(False)
    for k, point in enumerate(points):
        if abs(point[0] - middle) < width and abs(point[1]) < height and (width < 1 or k > 1):
            ax.annotate(f"L{k + 1}", point, (6, 6), textcoords="offset points")
axes[0].set_title("Zero-velocity curves")
axes[1].set_title("Lyapunov's orbits beside the Moon")
Path("out").mkdir(exist_ok=True)
figure.savefig("out/restricted_three_body.png")
