"""Slips that turn, stop and begin.

A slider-crank through its dead centres, against the motion of its crank alone; in space what a force sets in motion; a
block that friction barely holds, against the law of its rocking.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import weight_on

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


@pytest.mark.slow
def test_a_slip_that_gaps_hold_turns():
    rod, turns, _ = rod_of(START, SPEED)
    start, ts = (np.array([START, rod]), np.array([SPEED, turns])), np.array([0.0, 3.0])

    def run(mu):
        return lagjax.simulate(CRANKED, *start, ts, mu, rtol=1e-12)

    end, times = crank_alone(0.2, 3.0)
    found = run(0.2)
    np.testing.assert_allclose([found.q[-1, 0], found.qdot[-1, 0]], end, rtol=1e-12)
    assert len(times) == 3
    np.testing.assert_allclose(found.contact_changes.t[1:4], times, rtol=1e-9)
    slope = (crank_alone(0.2 + 1e-4, 3.0)[0] - crank_alone(0.2 - 1e-4, 3.0)[0])[0] / 2e-4
    assert float(jax.grad(lambda mu: run(mu).q[-1, 0])(0.2)) == pytest.approx(slope, rel=1e-6)


# ---- in space, from rest ---------------------------------------------------------------------------------------------

PUSHED = lagjax.System(
    lambda q, v: 0.5 * v @ v - G * q[2], contacts=lambda q: q[2], slip=lambda q, v: v[:2],
    friction=lambda params: params[0],
    forces=lambda q, v, params: params[1] * jnp.array([jnp.cos(params[2]), jnp.sin(params[2]), 0.0]),
)  # fmt: skip
BLOCK_ON_A_SLOPE = lagjax.System(
    lambda q, v, params: 0.5 * v @ v - G * (jnp.cos(params) * q[1] + jnp.sin(params) * q[0]),
    contacts=lambda q: q[1], slip=lambda q, v: v[0], friction=0.3,
)  # fmt: skip
PUSH = jnp.array([0.3, 5.0, 0.7])


def pushed(x):
    return lagjax.simulate(PUSHED, jnp.zeros(3), jnp.zeros(3), jnp.array([0.0, 2.0]), x, max_transitions=8).q[-1]


def pushed_exactly(x):
    mu, force, angle = x
    return 2.0 * (force - mu * G) * jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])


def test_friction_is_against_the_slip_behind_an_impact():
    """In space, where masses couple the slip with the gap: what an impact gives is M (q̇⁺ − q̇⁻)."""
    rng, mu = np.random.default_rng(0), 0.3
    coupled = lagjax.System(
        lambda q, v, params: 0.5 * jnp.sum((params @ v) ** 2) + 0.05 * v @ v - q[2],
        contacts=lambda q: q[2], slip=lambda q, v: v[:2], friction=mu, restitution=0.5,
    )  # fmt: skip
    q0, v0, factors, ts = np.array([0.0, 0.0, 0.05]), rng.normal(size=(60, 3)), rng.normal(size=(60, 3, 3)), [0.0, 0.05]
    v0[:, 2] = -abs(v0[:, 2])
    starts = np.broadcast_to(q0, v0.shape), v0, np.array(ts), factors
    runs = lagjax.simulate_batch(coupled, *starts, batch_axes=(0, 0, 0), max_transitions=4)
    masses = factors.transpose(0, 2, 1) @ factors + 0.1 * np.eye(3)
    before, behind = runs.contact_changes.qdot[:, 0], runs.contact_changes.qdot_next[:, 0]
    given = np.einsum("nij,nj->ni", masses, behind - before)
    force, most, slip = given[:, :2], mu * given[:, 2], behind[:, :2]
    slides = np.flatnonzero((runs.impacts.count > 0) & (np.linalg.norm(slip, axis=1) > 1e-6))
    against = -most[:, None] * slip / np.linalg.norm(slip, axis=1, keepdims=True)
    assert len(slides) > 10
    np.testing.assert_allclose(force[slides], against[slides], atol=1e-11)

    def end(v):
        return lagjax.simulate(coupled, q0, v, jnp.array(ts), factors[slides[0]], max_transitions=4).qdot[-1]

    v, h = v0[slides[0]], 1e-5
    slopes = np.stack([(end(v + h * e) - end(v - h * e)) / (2 * h) for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(jax.jacfwd(end)(v), slopes, atol=1e-8)


@pytest.mark.slow
def test_a_slip_in_space_that_a_force_begins_has_no_derivatives_yet():
    np.testing.assert_allclose(pushed(PUSH), pushed_exactly(PUSH), atol=1e-9)
    assert np.isnan(jax.jacfwd(pushed)(PUSH)[:2]).all() and np.isnan(jax.jacrev(pushed)(PUSH)[:2]).all()


@pytest.mark.slow
def test_a_straight_slip_in_space_has_its_derivatives_across_in_both_modes():
    """Pushed along its slip a puck has v = v0 + a t, and what varies across it decays as v^(−μg/a)."""
    mu, v0, end, a = 0.3, 1.0, 2.0, 5.0 - 0.3 * G

    def across(angle):
        start = jnp.array([v0 * jnp.cos(angle), v0 * jnp.sin(angle), 0.0])
        return lagjax.simulate(PUSHED, jnp.zeros(3), start, jnp.array([0.0, end]), PUSH.at[2].set(0.0)).q[-1, 1]

    power = 1.0 - mu * G / a
    right = v0 * ((1.0 + a * end / v0) ** power - 1.0) * v0 / (a * power)
    assert float(jax.grad(across)(0.0)) == pytest.approx(right, rel=1e-6)
    assert float(jax.jacfwd(across)(0.0)) == pytest.approx(right, rel=1e-6)


@pytest.mark.slow
def test_a_start_at_rest_that_slides_at_once_has_no_derivative_by_its_slip():
    """Friction turns with the least slip: the ends of starts uphill and downhill differ in their slopes."""
    rest = np.zeros(2)

    def run(v, tilt):
        return lagjax.simulate(BLOCK_ON_A_SLOPE, rest, v, jnp.array([0.0, 2.0]), tilt)

    by_start, by_tilt = jax.jacfwd(lambda *x: run(*x).q[-1, 0], argnums=(0, 1))(rest, 0.5)
    assert np.isnan(by_start[0]) and by_start[1] == 0.0
    assert float(by_tilt) == pytest.approx(-2 * G * (np.cos(0.5) + 0.3 * np.sin(0.5)), rel=1e-8)
    assert "1 slips begin from rest" in str(run(rest, 0.5).health())
    by_start, by_tilt = jax.jacfwd(lambda *x: run(*x).q[-1], argnums=(0, 1))(rest, 0.2)  # it sticks
    assert not by_start.any() and not by_tilt.any()


BLOCK = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])


def block_gaps(q, params):
    c, s, (a, b) = jnp.cos(q[2]), jnp.sin(q[2]), params["sides"]
    return jnp.stack([q[1] + s * x * a + c * y * b for x, y in BLOCK])


def block_slips(q, qdot, params):
    c, s, (a, b) = jnp.cos(q[2]), jnp.sin(q[2]), params["sides"]
    return jnp.stack([qdot[0] + qdot[2] * (-s * x * a - c * y * b) for x, y in BLOCK])


def time_of_rocking(rate, a, b):
    """A rise from flat over one corner, which holds, until the block is flat again."""
    r, start = np.hypot(a, b), np.arctan2(b, a)
    pull = 9.81 / (4 / 3 * r)
    top = 0.0
    for _ in range(12):
        top = 2 * np.arcsin(rate**2 / (4 * pull * np.cos(start + top / 2)))
    x, weights = np.polynomial.legendre.leggauss(40)
    u = 0.5 * (x + 1.0)  # of angles top (1 − u²), where sin α − sin β = 2 cos ½(α + β) sin ½(α − β)
    fall = 2 * np.cos(start + top * (1 - u**2 / 2)) * np.sin(top * u**2 / 2)
    return np.sum(weights * 2 * top * u / np.sqrt(2 * pull * fall))


@pytest.mark.slow
def test_a_block_that_friction_barely_holds_rocks_to_rest():
    """With μ = ab/(k² − a²) a corner of a flat block is about to slip: at ever smaller rates rounding would decide.

    From one corner to the other it keeps a part of its rate (Housner 1963); the sum of all times is that of its rest.
    """
    energy = lambda q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 * jnp.sum(p["sides"] ** 2) / 3)
    system = lagjax.System(
        lambda q, qdot, params: energy(q, qdot, params) - 9.81 * q[1],
        contacts=block_gaps, slip=block_slips, friction=lambda params: params["mu"],
    )  # fmt: skip
    for a, b in [(0.5, 0.5), (0.5, 0.4297574176026187), (0.5, 0.4708918362156634), (0.5, 0.40696801), (0.5, 0.37)]:
        squares = a**2 + b**2
        params = {"sides": np.array([a, b]), "mu": a * b / (4 / 3 * squares - a**2)}
        rate, part = 0.2, 1 - 1.5 * a**2 / squares
        run = lagjax.simulate(system, [0.0, b, 0.0], [-b * rate, a * rate, rate], np.array([0.0, 1.0]), params)
        expected = sum(time_of_rocking(rate * abs(part) ** k, a, b) for k in range(40) if abs(part) ** k > 1e-14)
        changes = run.contact_changes
        closes = np.asarray(changes.t)[np.asarray(changes.change) == 0]
        assert np.all(np.abs(run.end.qdot) < 1e-14) and abs(run.end.q[1] - b) < 1e-15
        assert abs(closes[-1] - expected) < 1e-12, (a, b, closes[-1] - expected)


# ---- friction against a body that turns, in a scene whose forces have borders ----------------------------------------


def test_a_particle_slides_up_a_drum_while_another_coordinate_stops():
    """With u = θ̇² on a circle of radius 1 u′ = −2g sin θ − 2μ (g cos θ + u); the third coordinate stops by itself."""
    mu, speed = 0.3, 3.0
    drum = weight_on(
        forces=lambda q, v: jnp.array([0.0, 0.0, -jnp.sign(v[2])]),
        contacts=lambda q: 1.0 - jnp.hypot(q[0], q[1]),
        friction=mu,
        slip=lambda q, v: (q[0] * v[1] - q[1] * v[0]) / jnp.hypot(q[0], q[1]),
    )
    run = lagjax.simulate(drum, np.array([0.0, -1.0, 0.0]), np.array([speed, 0.0, 0.2]), np.linspace(0.0, 0.35, 8))
    angle = np.arctan2(run.q[:, 0], -run.q[:, 1])
    b = -6 * mu * G / (1 + 4 * mu**2)
    a = 2 * G + 2 * mu * b
    square = (speed**2 - a) * np.exp(-2 * mu * angle) + a * np.cos(angle) + b * np.sin(angle)
    np.testing.assert_allclose(np.sum(run.qdot[:, :2] ** 2, axis=1), square, atol=1e-9)
    np.testing.assert_allclose(run.q[4:, 2], 0.02, atol=1e-12)
    assert run.stats["num_steps"] < 50


@pytest.mark.slow
def test_a_box_on_more_corners_than_it_needs_slides_to_rest():
    """Eight corners in space, 24 rows for 7 coordinates: it slides for v² / 2μg, and stays.

    The four on the floor depend on each other; three normal forces and three slips hold the box.
    """
    corners, half = np.array(list(itertools.product((-1.0, 1.0), repeat=3))), 0.5

    def places(q):
        w, u = q[3], q[4:]
        turned = (w**2 - u @ u) * corners + 2 * (corners @ u)[:, None] * u + 2 * w * jnp.cross(u, corners)
        return q[:3] + half * turned

    box = lagjax.System(
        lambda q, v: 0.5 * v[:3] @ v[:3] + v[3:] @ v[3:] / 3 - G * q[2], contacts=lambda q: places(q)[:, 2],
        constraints=lambda q: q[3:] @ q[3:] - 1.0, slip=lambda q, v: jax.jvp(places, (q,), (v,))[1][:, :2],
        friction=lambda params: params,
    )  # fmt: skip
    q0, v0 = jnp.array([0.0, 0.0, half, 1.0, 0.0, 0.0, 0.0]), jnp.zeros(7).at[0].set(2.0)
    ts, mu = jnp.array([0.0, 0.3, 5.0]), 0.3
    run = lagjax.simulate(box, q0, v0, ts, mu)
    q = np.asarray(run.q)
    sliding, stops = 2.0 * 0.3 - mu * G * 0.3**2 / 2, 2.0**2 / (2 * mu * G)
    np.testing.assert_allclose(q[:, 0], [0.0, sliding, stops], atol=1e-10)
    np.testing.assert_allclose(q[:, 1:], np.tile(q0[1:], (3, 1)), atol=1e-10)
    forces = np.asarray(run.contact_forces)
    np.testing.assert_allclose(forces.sum(axis=1), G, rtol=1e-10)  # of contacts that depend one has none
    assert run.contacts.closed[-1].sum() == 4 and run.contacts.held[-1].sum() == 6
    steep = jax.jacfwd(lambda mu: lagjax.simulate(box, q0, v0, ts, mu).q[1, 0])(mu)
    np.testing.assert_allclose(steep, -G * 0.3**2 / 2, rtol=1e-9)
