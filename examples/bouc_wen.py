"""A state without inertia: hysteresis by Bouc and Wen, the six parameters of a published benchmark from one record.

    m q̈ + c q̇ + k q + z = u(t)        ż = α q̇ − β (γ |q̇| z + δ q̇ |z|)

The hysteretic force z has an equation of first order, which no Lagrangian has. But the velocity of a coordinate s of
unit mass does: with L = … + ½ ṡ² the force ż on s gives s̈ = ż, so that ṡ is z. A coil's current, the bristle of LuGre's
friction and a filter in a sensor enter in the same way. Only ṡ means something; s is what z has added up to.

Of β, γ and δ only the products β γ and β δ matter. The record is made here by SciPy, as the benchmark's is: 4 s at
750 Hz under a random multisine, with 8 µm of noise.

Source: Noël & Schoukens, *Hysteretic benchmark with a dynamic nonlinearity*, Workshop on Nonlinear System
Identification Benchmarks (2016) 7–14, with its parameters; Wen, J. Eng. Mech. Div. 102 (1976) 249.

python examples/bouc_wen.py
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax

TRUTH = {"m": 2.0, "c": 10.0, "k": 5e4, "alpha": 5e4, "beta_gamma": 800.0, "beta_delta": -1100.0}  # kg, N, m, s
FIRST = {"m": 2.6, "c": 7.0, "k": 4e4, "alpha": 6.5e4, "beta_gamma": 500.0, "beta_delta": -700.0}
RATE, DURATION, SIGMA = 750.0, 4.0, 8e-6  # Hz, s, m
LINES, STRENGTH = np.arange(5.0, 65.0, 3.0), 50.0  # Hz of the multisine, and its RMS in N
PHASES = np.random.default_rng(0).uniform(0.0, 2 * np.pi, len(LINES))


def force(t):
    """The multisine u(t)."""
    return STRENGTH * (2 / len(LINES)) ** 0.5 * jnp.sum(jnp.cos(2 * jnp.pi * LINES * t + PHASES))


def lagrangian(q, qdot, params):
    """Mass and spring; the auxiliary coordinate s has unit mass."""
    return 0.5 * params["m"] * qdot["x"] ** 2 - 0.5 * params["k"] * q["x"] ** 2 + 0.5 * qdot["s"] ** 2


def forces(q, qdot, t, params):
    """Damping, hysteresis z = ṡ and the input on x; ż on s."""
    v, z = qdot["x"], qdot["s"]
    rate = params["alpha"] * v - params["beta_gamma"] * jnp.abs(v) * z - params["beta_delta"] * v * jnp.abs(z)
    return {"x": force(t) - params["c"] * v - z, "s": rate}


SCENE = lagjax.System(lagrangian, forces=forces)
TS = np.arange(int(RATE * DURATION)) / RATE
REST = {"x": 0.0, "s": 0.0}, {"x": 0.0, "s": 0.0}


def recorded(seed=1):
    """Displacements (T,) in m, by SciPy on the equations of first order, with noise."""

    def rates(t, y):
        (x, v, z), p = y, TRUTH
        u = STRENGTH * (2 / len(LINES)) ** 0.5 * np.sum(np.cos(2 * np.pi * LINES * t + PHASES))
        rate = p["alpha"] * v - p["beta_gamma"] * abs(v) * z - p["beta_delta"] * v * abs(z)
        return [v, (u - p["c"] * v - p["k"] * x - z) / p["m"], rate]

    exact = solve_ivp(rates, (0.0, TS[-1]), [0.0, 0.0, 0.0], "DOP853", TS, rtol=1e-9, atol=1e-12).y[0]
    return exact + SIGMA * np.random.default_rng(seed).normal(size=len(TS))


def main():
    jax.config.update("jax_enable_x64", True)
    record = lagjax.Record(TS, recorded(), start=REST)
    fit = lagjax.fit(SCENE, record, FIRST, observe=lambda q, qdot: q["x"])
    print(fit)
    return fit


if __name__ == "__main__":
    main()
