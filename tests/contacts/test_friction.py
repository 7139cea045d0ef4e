"""Slips that turn, stop and begin: a slider-crank through its dead centres, against the motion of its crank alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

pytest.importorskip("scipy", reason="the references are computed with it")
from scipy.integrate import solve_ivp

G = 9.81

# ---- a slider-crank: the foot of a light rod slides on the floor; at its dead centres the gap holds the slip ---------

CRANK, ROD, HEIGHT, INERTIA = 0.3, 1.0, 0.4, 0.5
START, SPEED = 1.2, -4.0


def foot(q):
    return jnp.stack(
        [CRANK * jnp.cos(q[0]) + ROD * jnp.cos(q[1]), HEIGHT + CRANK * jnp.sin(q[0]) + ROD * jnp.sin(q[1])]
    )


def foot_velocity(q, v):
    return jax.jvp(foot, (q,), (v,))[1]


CRANKED = lagjax.System(
    lambda q, v: 0.5 * INERTIA * v[0] ** 2 + 0.5 * foot_velocity(q, v) @ foot_velocity(q, v) - G * foot(q)[1],
    contacts=lambda q: foot(q)[1], slip=lambda q, v: foot_velocity(q, v)[0], friction=lambda params: params,
)  # fmt: skip


def rod_of(angle, rate):
    """The angle of the rod, its rate, and ∂x/∂(crank), of a foot on the floor."""
    rod = -np.arcsin((HEIGHT + CRANK * np.sin(angle)) / ROD)
    slope = -CRANK * np.cos(angle) / (ROD * np.cos(rod))
    return rod, slope * rate, -CRANK * np.sin(angle) - ROD * np.sin(rod) * slope


def crank_alone(mu, end):
    """The angle and the rate of the crank at the end, and the times of its dead centres, where friction turns."""

    def flow(t, z, side):
        angle, rate = z
        rod, turns, slope = rod_of(angle, rate)
        turns_more = (CRANK * np.sin(angle) * rate**2 + ROD * np.sin(rod) * turns**2) / (ROD * np.cos(rod))
        rest = -CRANK * np.cos(angle) * rate**2 - ROD * np.cos(rod) * turns**2 - ROD * np.sin(rod) * turns_more
        # N (1 + μ side tan) = g − tan ẍ, I α + ẍ slope = −μ side slope N, ẍ = slope α + rest
        tangent = np.tan(rod)
        brakes = mu * side * slope / (1.0 + mu * side * tangent)
        alpha = -(slope * rest + brakes * (G - tangent * rest)) / (INERTIA + slope**2 - brakes * tangent * slope)
        return np.array([rate, alpha])

    def slip(t, z, side):
        return side * rod_of(*z)[2] * z[1]

    slip.terminal, slip.direction = True, -1
    t, z, times = 0.0, np.array([START, SPEED]), []
    side = np.sign(slip(t, z, 1.0))
    while t < end:
        run = solve_ivp(flow, (t, end), z, "DOP853", rtol=1e-13, atol=1e-15, events=slip, args=(side,))
        t, z, side = run.t[-1], run.y[:, -1], -side
        times.append(t)
    return z, times[:-1]


def test_a_slip_that_gaps_hold_turns():
    rod, turns, _ = rod_of(START, SPEED)
    start, ts = (jnp.array([START, rod]), jnp.array([SPEED, turns])), jnp.array([0.0, 3.0])

    def run(mu):
        return lagjax.simulate(CRANKED, *start, ts, mu, rtol=1e-12)

    end, times = crank_alone(0.2, 3.0)
    found = run(0.2)
    np.testing.assert_allclose([found.q[-1, 0], found.qdot[-1, 0]], end, rtol=1e-12)
    assert len(times) == 3
    np.testing.assert_allclose(found.contact_changes.t[1:4], times, rtol=1e-9)
    slope = (crank_alone(0.2 + 1e-4, 3.0)[0] - crank_alone(0.2 - 1e-4, 3.0)[0])[0] / 2e-4
    assert float(jax.grad(lambda mu: run(mu).q[-1, 0])(0.2)) == pytest.approx(slope, rel=1e-6)
