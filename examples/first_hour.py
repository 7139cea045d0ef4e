# %% [markdown]
r"""
# The first hour

Four stations, for somebody who knows mechanics and some Python: a pendulum with a picture (5 minutes), a Lagrangian of
your own with a constraint (20), many motions at once and a map (35), derivatives and a fit to recorded data (60). Run
the cells one after another, change them, run them again. It needs `pip install lagjax[examples]`.

## 1. A pendulum

A scene is its Lagrangian, written as a function of the coordinates and the velocities. Here the coordinate is the angle
θ from the vertical:

$$ L = \tfrac12 m l^2\,\dot\theta^2 + m g l\cos\theta $$
"""

# %%
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax

# 64-bit numbers, before any others are made: float32 has seven digits.
jax.config.update("jax_enable_x64", True)
plt.style.use("lagjax.figures")
SIDE = 160  # pixels along each side of the map in station 3
Path("out").mkdir(exist_ok=True)  # for the pictures


def pendulum(theta, omega, params):
    m, l = params["m"], params["l"]
    return 0.5 * m * l**2 * omega**2 + m * 9.81 * l * jnp.cos(theta)


scene = lagjax.System(pendulum)
params = {"m": 1.0, "l": 0.5}
ts = jnp.linspace(0.0, 5.0, 501)
swing = lagjax.simulate(scene, 2.5, 0.0, ts, params)
print(swing)

# %% [markdown]
"""
No equation of motion was written down: lagjax derived it from L. A `Trajectory` has the times `ts`, the coordinates
`q`, the velocities `qdot`, and methods for what follows from them, as `energy()`. Draw it, and ask how far to trust it:
"""

# %%
ax = lagjax.plot.trajectory(swing)
ax.set(xlabel="t [s]", ylabel="θ [rad]", title="A pendulum, let go at 143°")
ax.figure.savefig("out/first_hour_1.png")
print(swing.health())

# %% [markdown]
"""
Numbers that you may want to change belong into `params`: a new value there costs nothing. What else a function sees, a
name defined outside, may change as well, and the scene is then compiled again.

*Try:* let it go at 3.1; push it with 6.5 rad/s instead of 0, so that it goes over the top; take it to the Moon.

## 2. A Lagrangian of your own, with a constraint

A bead slides on a wire in the shape of a parabola, z = x². Its coordinates stay what they are, x and z, and the wire is
a constraint: a function that must remain zero. `check` looks at a scene before anything is integrated. In the first
attempt there is a mistake of a kind that happens to everybody:
"""


# %%
def first_attempt(q, v):
    return 0.5 * jnp.linalg.norm(v) * jnp.linalg.norm(v) - 9.81 * q[1]


def wire(q):
    return {"wire": q[1] - q[0] ** 2}


start, rest = jnp.array([1.0, 1.0]), jnp.zeros(2)
findings = lagjax.check(lagjax.System(first_attempt, constraints=wire), start, rest)
print(findings)

# %% [markdown]
"""
The slope of a norm does not exist at rest. The finding names the line, and what to write instead:
"""


# %%
def bead(q, v):
    return 0.5 * jnp.sum(v**2) - 9.81 * q[1]


parabola = lagjax.System(bead, constraints=wire)
print(lagjax.check(parabola, start, rest))
slide = lagjax.simulate(parabola, start, rest, ts)
drift = jnp.abs(slide.constraint_residual()["wire"]).max()
force = jnp.sqrt(jnp.sum(slide.constraint_force() ** 2, axis=-1))
print(f"the bead stays on its wire to {drift:.0e}; the wire presses with {force.min():.2f} to {force.max():.2f} N")

ax = lagjax.plot.path(*slide.q.T, values=force, label="force of the wire [N]")
ax.set(xlabel="x [m]", ylabel="z [m]", title="A bead on a parabola")
ax.figure.savefig("out/first_hour_2.png")

# %% [markdown]
r"""
At the lowest point the force must be mg + mv²/R with v² = 2gh and the radius of curvature R = 1/2: from h = 1 that is
5 · 9.81 = 49.05 N, of which the outputs, 10 ms apart, come close.

*Try:* another wire, `jnp.cosh`; a start that is not on the wire; what `parabola.explain(start, rest)` tells.

## 3. Many at once, and a map

A pendulum with an iron bob swings over three magnets and loses energy to the air. Over which magnet does it come to
rest? `dissipation` is half of the power that friction takes. One call of `simulate_batch` follows all starts, the first
axis of what goes in and of what comes out:

$$ L = \tfrac12 v^2 - \tfrac14 r^2 + \sum_i \frac{1}{\sqrt{|\mathbf r-\mathbf r_i|^2+h^2}},\qquad
   D = \tfrac1{10} v^2,\qquad h = 0.3 $$
"""

# %%
corners = 2 * jnp.pi * jnp.arange(3) / 3
magnets = jnp.stack([jnp.cos(corners), jnp.sin(corners)], axis=1)


def iron(r, v):
    distances = jnp.sqrt(jnp.sum((r - magnets) ** 2, axis=1) + 0.3**2)
    return 0.5 * jnp.sum(v**2) - 0.25 * jnp.sum(r**2) + jnp.sum(1 / distances)


over_magnets = lagjax.System(iron, dissipation=lambda r, v: 0.1 * jnp.sum(v**2))
side = jnp.linspace(-2.0, 2.0, SIDE)
x, y = jnp.meshgrid(side, side)
starts = jnp.stack([x.ravel(), y.ravel()], axis=1)
batch = lagjax.simulate_batch(over_magnets, starts, jnp.zeros_like(starts), jnp.array([0.0, 60.0]), rtol=1e-6)
print(batch)
nearest = jnp.argmin(jnp.sum((batch.q[:, -1, None] - magnets) ** 2, axis=-1), axis=1).reshape(SIDE, SIDE)

# %%
figure, ax = plt.subplots(figsize=(5.4, 5.0))
ax.imshow(nearest, extent=(-2, 2, -2, 2), origin="lower", cmap="cividis", interpolation="nearest")
ax.plot(*magnets.T, "o", markersize=11, markerfacecolor="white", markeredgecolor="black")
ax.set(xlabel="x at the start", ylabel="y at the start", title="Which of three magnets catches the pendulum")
ax.grid(False)
figure.savefig("out/first_hour_3.png")

# %% [markdown]
"""
*Try:* less friction, a finer map (`SIDE = 400`), a fourth magnet. Maps of a hundred million members, which may be
stopped and gone on with, are for `lagjax.sweep`.

## 4. Derivatives, and a fit

A motion is a function of JAX like any other: it can be differentiated by whatever goes in. How does the time of the
first passage through the vertical depend on the length? Small swings take T/4 = (π/2) √(l/g), with the slope T/8l.
"""


# %%
def first_passage(length, angle):
    crossing = lagjax.crossings(scene, lambda q, v: q, angle, 0.0, jnp.array([0.0, 5.0]), {"m": 1.0, "l": length})
    return crossing.t[0]


time, slope = jax.value_and_grad(first_passage)(0.5, 0.01)
quarter = float(jnp.pi / 2 * jnp.sqrt(0.5 / 9.81))
print(f"small swings: {time:.6f} s, slope {slope:.6f} s/m   (formula {quarter:.6f}, {quarter / (2 * 0.5):.6f})")
print(f"from 143°:    {first_passage(0.5, 2.5):.6f} s, slope {jax.grad(first_passage)(0.5, 2.5):.6f} s/m")

# %% [markdown]
"""
Now somebody has filmed a pendulum. The file has a time in seconds and an angle in radians on every line; here it is
made, with friction and noise, so that we know what must come out. Replace it by a file of your own.
"""


# %%
def friction(theta, omega, params):
    return 0.5 * params["c"] * omega**2


real = lagjax.System(pendulum, dissipation=friction)
truth = {"m": 1.0, "l": 0.62, "c": 0.02}
frames = jnp.linspace(0.0, 12.0, 361)
filmed = lagjax.simulate(real, 1.9, 0.0, frames, truth).q + 0.01 * jax.random.normal(jax.random.key(1), frames.shape)
np.savetxt("out/swing.csv", np.stack([frames, filmed], axis=1), delimiter=",", header="t [s], angle [rad]", fmt="%.5f")

# %% [markdown]
"""
`fit` finds the parameters and the start that make the recording likeliest. The mass cannot be seen in the angle (with
c/m all stays as it is), so it is kept, by `free`; the others are positive.
"""

# %%
seconds, angle = np.loadtxt("out/swing.csv", delimiter=",", unpack=True)
record = lagjax.Record(seconds, angle)
guess = {"m": 1.0, "l": 1.0, "c": 0.1}
fit = lagjax.fit(real, record, guess, free={"m": False, "l": True, "c": True}, transforms=lagjax.positive)
print(fit)

# %%
axes = lagjax.plot.fit(fit)
axes[0, 0].set(title="A filmed pendulum: data, fit, and what is left", ylabel="angle [rad]")
axes[1, 0].set(xlabel="t [s]", ylabel="residual [rad]")
axes[0, 0].figure.savefig("out/first_hour_4.png")

# %% [markdown]
"""
That was the hour. What else there is: motions that change their laws (`Hybrid`), equilibria and modes
(`equilibrium`, `normal_modes`), symmetries (`conserved_quantities`), closed orbits and chaos (`periodic_orbit`,
`lyapunov_exponent`). Each is met in one of the worked problems beside this file.
"""
