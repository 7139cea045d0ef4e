# %% [markdown]
r"""
# A cylinder that rolls off another, and flies

A cylinder (mass M, radius a, moment of inertia αMa²) rolls on a fixed half-cylinder of radius R. Its axis is at the
distance r from that of the other, at the angle θ₁ from the vertical; it has turned by θ₂. Contact and rolling are two
constraints, and their multipliers are the forces:

$$ \bar L = \tfrac12 M(\dot r^2 + r^2\dot\theta_1^2) + \tfrac12\alpha M a^2\,\dot\theta_2^2 - M g r\cos\theta_1
   + \lambda_1\,(r - R - a) + \lambda_2\,\big(R\theta_1 - a(\theta_2-\theta_1)\big) $$

From rest at θ₁⁰ the contact force λ₁ vanishes where $\cos\theta_1 = 2\cos\theta_1^0/(3+\alpha)$. There the cylinder
leaves, later for a larger inertia, and what follows is free flight (Goldstein, *Classical Mechanics*, §2.4).
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

M, R, a, G = 1.0, 1.0, 0.25, 9.81
START = 0.15
INERTIA = {"axle, α = 0.01": 0.01, "full, α = ½": 0.5, "hollow, α = 1": 1.0}


def lagrangian(q, v, params):
    kinetic = 0.5 * M * (v["r"] ** 2 + (q["r"] * v["theta1"]) ** 2) + 0.5 * params * M * a**2 * v["theta2"] ** 2
    return kinetic - M * G * q["r"] * jnp.cos(q["theta1"])


def contact(q):
    return {"normal": q["r"] - R - a, "rolling": R * q["theta1"] - a * (q["theta2"] - q["theta1"])}


modes = {"rolling": lagjax.System(lagrangian, constraints=contact), "flight": lagjax.System(lagrangian)}
leaves = lagjax.Transition("rolling", "flight", lambda q, v, multipliers: multipliers["normal"], direction=-1)

# %% [markdown]
"""
Two modes, with the constraints and without; the transition is where the normal force falls through zero.
"""

# %%
ts = jnp.linspace(0.0, 1.6, 1601)
start = {"r": R + a, "theta1": START, "theta2": (R + a) / a * START}
rest = dict.fromkeys(start, 0.0)


def run(alpha):
    return lagjax.simulate(lagjax.Hybrid(modes, [leaves], "rolling"), start, rest, ts, alpha, max_transitions=4)


runs = jax.jit(jax.vmap(run))(jnp.array(list(INERTIA.values())))
ours = jnp.degrees(runs.transitions.q["theta1"][:, 0])
book = jnp.degrees(jnp.arccos(2 * jnp.cos(START) / (3 + jnp.array(list(INERTIA.values())))))
for name, expected, angle in zip(INERTIA, book, ours, strict=True):
    print(f"{name:22} leaves at   2 cos θ₁⁰/(3+α): {expected:.9f}°   lagjax {angle:.9f}°")

# %% [markdown]
r"""
On the right the normal force along the way, beside

$$ \lambda_1 = Mg\,[(3+\alpha)\cos\theta_1 - 2\cos\theta_1^0]/(1+\alpha) $$
"""

# %%
normal = jax.jit(jax.vmap(jax.vmap(modes["rolling"].multipliers, (0, 0, None, None)), (0, 0, None, 0)))
force = normal(runs.q, runs.qdot, 0.0, jnp.array(list(INERTIA.values())))["normal"] / (M * G)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 3.6), width_ratios=[1.45, 1])
half, turn = np.linspace(-np.pi / 2, np.pi / 2, 181), np.linspace(0, 2 * np.pi, 61)
left.fill(R * np.sin(half), R * np.cos(half), color="0.88")
q, mode, force = jax.tree.map(np.asarray, (runs.q, runs.mode, force))
r, theta1, theta2 = (q[name][1] for name in start)  # of the full cylinder
x, y = r * np.sin(theta1), r * np.cos(theta1)
last, leave = np.argmax(y < a), np.sum(mode[1] == 0)
for i in [*range(0, leave, leave // 5), *range(leave, last, 45)]:
    color = "#0072B2" if i < leave else "#D55E00"
    left.plot(x[i] + a * np.sin(turn), y[i] + a * np.cos(turn), color=color, linewidth=1)
    left.plot([x[i], x[i] + a * np.sin(theta2[i])], [y[i], y[i] + a * np.cos(theta2[i])], color=color, linewidth=1)
left.plot(x[:leave], y[:leave], color="#0072B2", linewidth=2.5, label="rolls")
left.plot(x[leave:last], y[leave:last], color="#D55E00", linewidth=2.5, label="flies")
left.plot(x[leave], y[leave], "ko", markersize=6, zorder=5)
left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-1.05, 1.62), ylim=(-0.02, 1.55))
left.set_title("A full cylinder, from rest")
left.grid(False)
left.legend(loc="upper right")
for k, (name, alpha) in enumerate(INERTIA.items()):
    rolling = mode[k] == 0
    angle = q["theta1"][k][rolling]
    closed = ((3 + alpha) * np.cos(angle) - 2 * np.cos(START)) / (1 + alpha)
    line = right.plot(np.degrees(angle), force[k][rolling], linewidth=4, alpha=0.4, label=name)[0]
    right.plot(np.degrees(angle), closed, color=line.get_color(), linewidth=1)
    right.plot(ours[k], 0, "ko", markersize=6, zorder=5)
    right.annotate(
        f"{ours[k]:.1f}°", (ours[k], 0), (0, -13 - 10 * (k == 1)), textcoords="offset points", ha="center", fontsize=9
    )
right.set(xlabel="θ₁ [°]", ylabel="normal force / Mg", ylim=(-0.16, 1.05), title="It leaves where nothing presses")
right.legend(loc="lower left", bbox_to_anchor=(0, 0.1))
Path("out").mkdir(exist_ok=True)
figure.savefig("out/rolling_cylinder.png")
