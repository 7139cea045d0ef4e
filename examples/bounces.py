"""Restitution from the sound of a ball: what a bounce leaves of the velocity, from the times of bounces alone.

The file holds the times of bounces in seconds, one a line, as a microphone on the table hears them. Without a file the
example makes its own from a known ball. Between bounces the ball falls with drag; a bounce leaves the share

    e(v) = e₀ − e₁ v         of the velocity v that the ball comes with

The motion is hybrid: its mode and its transition are one `lagjax.Hybrid`, the times of that are `lagjax.Timings`. It
begins a little before the first bounce that was heard; where the ball is there, and how fast, is fitted.

python examples/bounces.py [bounces.txt]
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

G = 9.81
FIRST = {"e0": 0.8, "e1": 0.01, "drag": 0.005}  # 1, s/m, 1/m
TRUTH, V0 = {"e0": 0.92, "e1": 0.02, "drag": 0.01}, 3.4  # m/s: the velocity after the first bounce
BEFORE = 0.1  # s from the start of the motion to the first bounce
SIGMA, BOUNCES = 1e-4, 14  # s: a microphone at 10 kHz; how many bounces are made

FLIGHT = lagjax.System(
    lambda q, qdot: 0.5 * qdot**2 - G * q, forces=lambda q, qdot, params: -params["drag"] * qdot * jnp.abs(qdot)
)
BOUNCE = lagjax.Transition(
    "flight", "flight", guard=lambda q, v: q, direction=-1,
    reset=lambda q, v, params: (q, -v * (params["e0"] + params["e1"] * v)),
)  # fmt: skip


def recorded(seed=0):
    """The times of bounces of a known ball, the first of which is at half a second."""
    longest = 4.0 * BOUNCES * V0 / G
    run = lagjax.simulate(
        lagjax.Hybrid({"flight": FLIGHT}, [BOUNCE], "flight"), 0.0, V0, jnp.array([0.0, longest]), TRUTH,
        max_transitions=BOUNCES - 1, throw=False,
    )  # fmt: skip
    exact = 0.5 + np.append(0.0, run.transitions.t)
    return exact + SIGMA * np.random.default_rng(seed).normal(size=BOUNCES)


def fit_bounces(times):
    """The fit of restitution and drag to the times of bounces."""
    ball = lagjax.Hybrid({"flight": FLIGHT}, [BOUNCE], "flight", max_transitions=len(times) + 1)
    v = 0.5 * G * (times[1] - times[0])  # after the first bounce, and hardly less than before it
    falling = lagjax.Guess(v * BEFORE - 0.5 * G * BEFORE**2, G * BEFORE - v)
    heard = lagjax.Timings(BOUNCE, times, times[0] - BEFORE, falling)
    return lagjax.fit(ball, heard, FIRST)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="times of bounces in seconds, one a line")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    fit = fit_bounces(recorded() if options.file is None else np.loadtxt(options.file))
    print(fit)
    return fit


if __name__ == "__main__":
    main()
