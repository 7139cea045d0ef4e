"""An extended Kalman filter: all that two encoders tell of a cart with a pendulum, whose cart is pushed at random.

Every 20 ms the encoders read the cart's place to 1 mm and the pendulum's angle to 5 mrad; a known force and an unknown
one are held between. The filter predicts by the motion itself, z → φ(z, u), and takes Φ = ∂φ/∂z and Γ = ∂φ/∂u from its
derivative: P → Φ P Φᵀ + Γ σ² Γᵀ is exact for what is linear, whatever the step (Bar-Shalom, Li & Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, §5.2, 10.3). It is consistent if its innovations ν are what
it says they are: νᵀ S⁻¹ ν, summed over N steps, has the distribution χ² of 2N degrees of freedom (§5.4).

python examples/kalman_filter.py out/
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

import lagjax

jax.config.update("jax_enable_x64", True)

STEP, STEPS = 0.02, 400
PUSH, READING = 2.0, np.array([1e-3, 5e-3])  # standard deviations: of the unknown force [N], of encoders [m, rad]
GUESS = np.array([0.1, 0.2, 0.3, 0.5])  # how far the start may be off: m, rad, m/s, rad/s
NOISE, SEEN = np.diag(READING**2), np.eye(2, 4)


def lagrangian(q, v):
    (_, angle), (speed, rate) = q, v
    return 0.65 * speed**2 + 0.15 * speed * rate * jnp.cos(angle) + 0.0375 * rate**2 + 1.4715 * jnp.cos(angle)


cart = lagjax.System(lagrangian, forces=lambda q, v, params: jnp.stack([params - 0.3 * v[0], -0.01 * v[1]]))


def advance(z, force):
    """The state (4,) after a step under a held force."""
    end = lagjax.simulate(cart, z[:2], z[2:], jnp.array([0.0, STEP]), force, throw=False).end
    return jnp.concatenate([end.q, end.qdot])


def record(key):
    """The known forces (N,), the readings (N, 2) and the states (N, 4) of a motion that is pushed at random."""
    of_start, of_push, of_reading = jax.random.split(key, 3)
    forces = 3.0 * jnp.sign(jnp.sin(1.3 * STEP * jnp.arange(STEPS)))
    pushes = PUSH * jax.random.normal(of_push, (STEPS,))
    start = GUESS * jax.random.normal(of_start, (4,))

    def step(z, force):
        return (after := advance(z, force)), after

    _, states = jax.lax.scan(step, start, forces + pushes)
    return forces, states[:, :2] + READING * jax.random.normal(of_reading, (STEPS, 2)), states


def estimate(forces, readings):
    """The estimates (N, 4), their covariances (N, 4, 4), and νᵀ S⁻¹ ν of every step (N,)."""

    def step(carry, known):
        (z, P), (force, reading) = carry, known
        Φ, Γ = jax.jacfwd(advance, (0, 1))(z, force)
        z, P = advance(z, force), Φ @ P @ Φ.T + PUSH**2 * jnp.outer(Γ, Γ)
        ν, S = reading - z[:2], P[:2, :2] + NOISE
        gain = jnp.linalg.solve(S, P[:2]).T
        kept = jnp.eye(4) - gain @ SEEN
        z, P = z + gain @ ν, kept @ P @ kept.T + gain @ NOISE @ gain.T  # Joseph's form, which stays positive
        return (z, P), (z, P, ν @ jnp.linalg.solve(S, ν))

    return jax.lax.scan(step, (jnp.zeros(4), jnp.diag(GUESS**2)), (forces, readings))[1]


def filtered(members, seed=0):
    """Records and estimates of this many motions, as one batch."""
    keys = jax.random.split(jax.random.key(seed), members)
    forces, readings, states = jax.jit(jax.vmap(record))(keys)
    return readings, states, *jax.jit(jax.vmap(estimate))(forces, readings)


def picture(readings, states, estimates, covariances, file):
    """The angle's rate, which no sensor reads, and its estimate with ±2σ."""
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    t, rate, sigma = STEP * (1 + np.arange(STEPS)), estimates[:, 3], np.sqrt(covariances[:, 3, 3])
    ax.plot(t[1:], np.diff(readings[:, 1]) / STEP, ".", color="0.75", markersize=3, label="differences of readings")
    ax.fill_between(t, rate - 2 * sigma, rate + 2 * sigma, color="#0072B2", alpha=0.25, linewidth=0)
    ax.plot(t, rate, color="#0072B2", label="estimate ± 2σ")
    ax.plot(t, states[:, 3], "--", color="#D55E00", label="true")
    ax.set(xlabel="t [s]", ylabel="rate of the angle [rad/s]", title="What two encoders tell of a rate")
    ax.legend(frameon=False, ncols=3, fontsize="small")
    figure.savefig(file, dpi=110)


def main(argv=None, members=40):
    readings, states, estimates, covariances, distances = map(np.asarray, filtered(members))
    low, high = chi2.ppf([0.025, 0.975], 2 * STEPS)
    inside = np.mean((low < distances.sum(axis=1)) & (distances.sum(axis=1) < high))
    errors = np.sqrt(np.mean((estimates - states)[:, STEPS // 4 :] ** 2, axis=(0, 1)))
    rates = f"rates to {errors[2]:.3f} m/s and {errors[3]:.3f} rad/s"
    print(f"{inside:.0%} of {members} motions have innovations within the band of 95 % of χ²; {rates}")
    for folder in sys.argv[1:] if argv is None else argv:
        Path(folder).mkdir(parents=True, exist_ok=True)
        picture(*(x[0] for x in (readings, states, estimates, covariances)), Path(folder) / "kalman_filter.png")
    return distances, estimates - states, covariances


if __name__ == "__main__":
    main()
