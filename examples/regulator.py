"""A linear quadratic regulator balances three links on a cart: gains by SciPy, the closed loop by the exact motion.

Three rods of 0.5 m and 0.2 kg stand on each other, and the lowest one on a cart of 1 kg, which a single force pushes;
angles are from above. `linearize` gives d/dt x = A x + B u, and with a sample time x⁺ = Φ x + Γ u for a force that is
held. The regulator u = −K x has the least ∫ (xᵀQx + R u²) dt, with K = R⁻¹BᵀP from Riccati's equation; the sampled one
has the least sum (Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, §2.3, 2.4).

python examples/regulator.py out/
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_continuous_are, solve_discrete_are

import lagjax

jax.config.update("jax_enable_x64", True)

CART, ROD, LENGTH, GRAVITY = 1.0, 0.2, 0.5, 9.81
STEP, DURATION = 0.02, 6.0
START = {"angles": np.radians([3.0, -2.0, 2.0]), "place": 0.0}
WEIGHTS, EFFORT = np.diag([10.0, 10.0, 10.0, 10.0, 0.1, 0.1, 0.1, 0.1]), 0.1  # of angles, place and their rates


def lagrangian(q, v):
    across, up = LENGTH * jnp.sin(q["angles"]), LENGTH * jnp.cos(q["angles"])  # from each joint to the next
    speed, rise = up * v["angles"], -across * v["angles"]
    height, speed_below, rise_below = (jnp.cumsum(x) - x for x in (up, speed, rise))  # of the lower joint of each rod
    speeds = (v["place"] + speed_below + speed / 2) ** 2 + (rise_below + rise / 2) ** 2
    kinetic = CART / 2 * v["place"] ** 2 + ROD / 2 * jnp.sum(speeds + (LENGTH * v["angles"]) ** 2 / 12)
    return kinetic - ROD * GRAVITY * jnp.sum(height + up / 2)


def push(q, v, inputs):
    return {"place": inputs, "angles": jnp.zeros(3)}


plant = lagjax.System(lagrangian, forces=lambda q, v, params: push(q, v, params))
upright = {"angles": np.zeros(3), "place": 0.0}
model = lagjax.linearize(lagjax.System(lagrangian, forces=push), upright, inputs=0.0, dt=STEP)


def gain(sampled=True):
    """K (1, 8), of a force that is held for every sample, or of one that changes all the time."""
    if not sampled:
        return model.B.T @ solve_continuous_are(model.A, model.B, WEIGHTS, [[EFFORT]]) / EFFORT
    Φ, Γ, effort = np.asarray(model.Phi), np.asarray(model.Gamma), STEP * EFFORT * np.eye(1)
    P = solve_discrete_are(Φ, Γ, STEP * WEIGHTS, effort)
    return np.linalg.solve(effort + Γ.T @ P @ Γ, Γ.T @ P @ Φ)


def flat(q, v):
    """The deviation (8,) in the order of `model.names.states`."""
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves((q, v))])


@jax.jit
def balance(q, K):
    """The states (q, q̇) at every sample, from rest at q, and the forces (N,)."""

    def step(state, _):
        force = -(K @ flat(*state))[0]
        end = lagjax.simulate(plant, *state, jnp.array([0.0, STEP]), force, throw=False).end
        return (end.q, end.qdot), (state, force)

    start = jax.tree.map(jnp.asarray, q)
    return jax.lax.scan(step, (start, jax.tree.map(jnp.zeros_like, start)), length=round(DURATION / STEP))[1]


def picture(angles, place, forces, file):
    """The angles, the cart and the force against time."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(7.0, 5.6), layout="constrained")
    t = STEP * np.arange(len(forces))
    axes[0].plot(t, np.degrees(angles), label=["lower", "middle", "upper"])
    axes[0].legend(frameon=False, ncols=3, title="rods")
    axes[1].plot(t, place)
    axes[2].step(t, forces, where="post")
    for ax, label in zip(axes, ("angle [°]", "cart [m]", "force [N]"), strict=True):
        ax.set_ylabel(label)
    axes[2].set_xlabel("t [s]")
    axes[0].set_title("Three links on a cart come back")
    figure.savefig(file, dpi=110)


def main(argv=None):
    K = gain()
    (q, _), forces = balance(START, K)
    slowest, left = (
        np.abs(np.linalg.eigvals(model.Phi - model.Gamma @ K)).max(),
        np.degrees(np.abs(q["angles"][-1]).max()),
    )
    lasting = f"largest |z| of the closed loop {slowest:.4f}"
    print(f"3°, −2°, 2° become {left:.0e}° in {DURATION:g} s with |u| ≤ {np.abs(forces).max():.1f} N; {lasting}")
    for folder in sys.argv[1:] if argv is None else argv:
        Path(folder).mkdir(parents=True, exist_ok=True)
        picture(q["angles"], q["place"], forces, Path(folder) / "regulator.png")
    return q, forces, K


if __name__ == "__main__":
    main()
