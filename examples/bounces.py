"""Restitution from the sound of a ball: what a bounce leaves of the velocity, from the times of bounces alone.

The file holds the times of bounces in seconds, one a line, as a microphone on the table hears them. Without a file the
example makes its own from a known ball. Between bounces the ball falls with drag; a bounce leaves the share

    e(v) = e₀ − e₁ v         of the velocity v that the ball comes with

The motion is hybrid: `simulate_hybrid` gives the times of bounces with exact derivatives by every parameter, here in
one batch forward, and `scipy.optimize.least_squares` does the rest: a fit of few numbers without segments.

python examples/bounces.py [bounces.txt]
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

import lagjax

G = 9.81
NAMES = (
    "velocity after the first bounce [m/s]",
    "restitution e0",
    "its fall e1 [s/m]",
    "drag [1/m]",
    "first bounce [s]",
)
START = np.array([3.0, 0.8, 0.01, 0.005, 0.0])
TRUTH = np.array([3.4, 0.92, 0.02, 0.01, 0.5])
SIGMA, BOUNCES = 1e-4, 14  # s: a microphone at 10 kHz; how many bounces are made

FLIGHT = lagjax.System(
    lambda q, qdot: 0.5 * qdot**2 - G * q, forces=lambda q, qdot, params: -params[3] * qdot * jnp.abs(qdot)
)
BOUNCE = lagjax.Transition(
    "flight", "flight", guard=lambda q, v: q, direction=-1,
    reset=lambda q, v, params: (q, -v * (params[1] + params[2] * v)),
)  # fmt: skip


def bounce_times(params, count):
    """The times of `count` bounces, the first of which begins the motion."""
    longest = 4.0 * count * params[0] / G
    run = lagjax.simulate_hybrid(
        {"flight": FLIGHT}, [BOUNCE], "flight", 0.0, params[0], jnp.array([0.0, 1.0]) * longest, params,
        max_transitions=count - 1, throw=False,
    )  # fmt: skip
    return params[4] + jnp.append(0.0, run.transitions.t)


def fit_bounces(times):
    """The parameters, their covariance, and the residuals in seconds."""
    shown = jax.jit(lambda params: bounce_times(params, len(times)) - times)
    slopes = jax.jit(jax.jacfwd(shown))
    start = START + np.array([0.0, 0.0, 0.0, 0.0, times[0]])
    found = least_squares(shown, start, jac=slopes, x_scale="jac", xtol=1e-12, ftol=1e-12)
    variance = 2 * found.cost / (len(times) - len(START))
    return found.x, variance * np.linalg.inv(found.jac.T @ found.jac), found.fun


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="times of bounces in seconds, one a line")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    if options.file is None:
        exact = np.asarray(bounce_times(jnp.array(TRUTH), BOUNCES))
        times = exact + SIGMA * np.random.default_rng(0).normal(size=BOUNCES)
    else:
        times = np.loadtxt(options.file)
    params, covariance, residuals = fit_bounces(times)
    half = stdtrit(len(residuals) - len(params), 0.975) * np.sqrt(np.diag(covariance))
    for name, x, wide in zip(NAMES, params, half, strict=True):
        print(f"{name:<26}{x:>10.5f} ± {wide:.5f}")
    print(f"{len(residuals)} bounces, {1e3 * np.sqrt(np.mean(residuals**2)):.3f} ms RMS")
    return params, half, residuals


if __name__ == "__main__":
    main()
