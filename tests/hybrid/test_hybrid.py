"""Hybrid motion: transitions where and when they are in closed form, their derivatives, and what must not happen."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particle
from scenes import BALL_IN_GRAVITY, BALL_ON_THE_FLOOR, EDGE, FREE, FREE_POINTS, HENON_HEILES, OSCILLATOR, particle
from sweeps import sweep

import lagjax

G = 9.81
BOUNCE = lagjax.Transition(
    "flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v, params: (q, -params["e"] * v)
)


def bouncing(h, e, g=G, v=0.0, ts=None, **options):
    ts = jnp.linspace(0.0, 2.0, 9) if ts is None else ts
    return lagjax.simulate(
        lagjax.Hybrid({"flight": BALL_IN_GRAVITY}, [BOUNCE], "flight"), h, v, ts, {"e": e, "g": g}, **options
    )


def hybrid(modes, transitions, q0=0.0, v0=1.0, ts=(0.0, 1.0), params=None, **options):
    """From the first mode."""
    ts = jnp.asarray(ts, float)
    return lagjax.simulate(lagjax.Hybrid(modes, transitions, next(iter(modes))), q0, v0, ts, params, **options)


def times(run):
    return np.asarray(run.transitions.t[: int(run.transitions.count)])


def central(function, x, step=1e-5):
    """∂f/∂x by differences: truncation ~ step², and what an integration to 1e-12 leaves, ~ 1e-12/step."""
    moved = step * jnp.eye(x.size)
    up, down = jax.jit(jax.vmap(function))(jnp.concatenate([x + moved, x - moved])).reshape(2, x.size, -1)
    return ((up - down) / (2 * step)).T


# ---- a cylinder rolls off a cylinder --------------------------------------------------------------------------------
#
# Radius a on radius R, moment of inertia α M a². It leaves where cos θ = 2 cos θ⁰ / (3 + α). (r, θ, its own angle)

M, R, A = 1.3, 1.0, 0.3


def cylinder(q, v, params):
    r, theta, _ = q
    inertia = params["alpha"] * M * A**2
    return 0.5 * M * (v[0] ** 2 + r**2 * v[1] ** 2) + 0.5 * inertia * v[2] ** 2 - M * G * r * jnp.cos(theta)


ROLLING = {
    "rolling": lagjax.System(
        cylinder, constraints=lambda q: {"contact": q[0] - R - A, "rolling": R * q[1] - A * (q[2] - q[1])}
    ),
    "flight": lagjax.System(cylinder),
}
SOFT = lagjax.System(lambda q, v, params: 0.5 * v**2 - params["g"] * q - 0.5 * 1e3 * q**2)
PLANE = lagjax.System(lambda q, v: 0.5 * v @ v)
BALLS = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - G * jnp.sum(q))
LEAVE = lagjax.Transition("rolling", "flight", lambda q, v, multipliers: multipliers["contact"], direction=-1)
ROLL_TS = np.linspace(0.0, 3.0, 13)


def rolling(alpha, theta, **options):
    q0 = jnp.stack([jnp.asarray(R + A), theta, theta * (R + A) / A])
    options = {"rtol": 1e-12, "max_transitions": 1, "throw": False} | options
    return lagjax.simulate(
        lagjax.Hybrid(ROLLING, [LEAVE], "rolling"), q0, jnp.zeros(3), ROLL_TS, {"alpha": alpha}, **options
    )


def place(q, v):
    """x, y and their rates, in the last axis."""
    r, theta, rd, thetad = q[..., 0], q[..., 1], v[..., 0], v[..., 1]
    s, c = np.sin(theta), np.cos(theta)
    return np.stack([r * s, r * c], -1), np.stack([rd * s + r * thetad * c, rd * c - r * thetad * s], -1)


def members(count):
    rng = np.random.default_rng(0)
    return np.concatenate([[0.0, 1.0], rng.uniform(0, 1, count - 2)]), rng.uniform(0.1, 0.8, count)


@pytest.mark.slow
def test_rolling_cylinder_leaves_where_it_must_and_then_flies():
    alpha, theta = members(1000)
    runs = jax.jit(jax.vmap(rolling))(alpha, theta)
    assert runs.ok[1:].all() and (runs.transitions.count == 1).all() and runs.ok.shape == (1000,)
    # A cylinder without inertia leaves like any other, and then nothing says how it turns.
    assert runs.result._value[0] == lagjax.RESULTS.mass_matrix_singular._value
    event = jax.tree.map(np.asarray, runs.transitions)
    # Tolerances: 1e-12 a step over some tens of steps.
    np.testing.assert_allclose(event.q[:, 0, 1], np.arccos(2 * np.cos(theta) / (3 + alpha)), atol=1e-12)
    np.testing.assert_allclose(event.q[:, 0, 0], R + A, atol=1e-14)
    energy = M * G * (R + A) * np.cos(theta)
    np.testing.assert_allclose(runs.energy()[1:], np.broadcast_to(energy[1:, None], (999, 13)), rtol=1e-10)

    modes, q, v, ts = np.asarray(runs.mode), np.asarray(runs.q), np.asarray(runs.qdot), np.asarray(ROLL_TS)
    flying = ts > event.t
    assert (modes[1:] == flying[1:]).all() and (modes[0] == np.where(flying[0], -1, 0)).all()
    flying[0] = False
    elapsed = (ts - event.t)[..., None]
    at, rate = place(event.q, event.qdot)
    ballistic = at + rate * elapsed - 0.5 * G * elapsed**2 * np.array([0.0, 1.0])
    np.testing.assert_allclose(place(q, v)[0][flying], ballistic[flying], atol=1e-10)
    turned = event.q[:, :, 2] + event.qdot[:, :, 2] * elapsed[..., 0]
    np.testing.assert_allclose(q[..., 2][flying], turned[flying], rtol=1e-11)

    # λ = M g / (1 + α) ((3 + α) cos θ − 2 cos θ⁰) as long as it rolls.
    with pytest.raises(ValueError, match=r"trajectory.system\['rolling'\].multipliers"):
        _ = runs.multipliers
    which, when = np.nonzero(modes == 0)
    at = q[which, when], v[which, when], 0.0, {"alpha": alpha[which]}
    given = jax.jit(jax.vmap(runs.system["rolling"].multipliers, (0, 0, None, 0)))(*at)
    expected = M * G / (1 + alpha) * ((3 + alpha) * np.cos(q[..., 1].T) - 2 * np.cos(theta))
    np.testing.assert_allclose(given["contact"], expected.T[which, when], atol=1e-10)


@pytest.mark.slow
def test_the_departure_and_the_flight_vary_as_they_must():
    alpha, theta = members(20)

    def outcome(x):
        run = rolling(x[0], x[1])
        return jnp.stack([run.transitions.q[0, 1], run.transitions.t[0], run.q[-1, 0], run.end.q[1], run.q[1, 1]])

    places = np.stack([alpha, theta], 1)
    slopes = jax.jit(jax.vmap(jax.jacrev(outcome)))(places)
    # cos θ* = x = 2 cos θ⁰ / (3 + α).
    x = 2 * np.cos(theta) / (3 + alpha)
    by_alpha, by_theta = x / (3 + alpha) / np.sqrt(1 - x**2), 2 * np.sin(theta) / (3 + alpha) / np.sqrt(1 - x**2)
    np.testing.assert_allclose(slopes[:, 0], np.stack([by_alpha, by_theta], 1), atol=1e-10)
    np.testing.assert_allclose(slopes[5], central(outcome, places[5]), rtol=1e-6, atol=1e-6)


# ---- a bouncing ball ------------------------------------------------------------------------------------------------


def bounce_times(h, e, g, count):
    first = np.sqrt(2 * h / g)
    return first * np.concatenate([[1.0], 1 + 2 * np.cumsum(e ** np.arange(1.0, count))])


def test_a_force_read_off_samples_of_parameters_in_a_mode():
    """q̈ = a t to a wall that returns the speed: roots of a cubic. The values of the samples are parameters."""
    a, knots = 0.6, np.linspace(0.0, 4.0, 9)

    def force(q, v, t, params):
        return lagjax.samples(knots, params["u"], "linear")(t)

    wall = lagjax.Transition("free", "free", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -v))
    modes = {"free": particle(force)}
    run = lagjax.simulate(lagjax.Hybrid(modes, [wall], "free"), 1.0, -1.0, np.array([0.0, 3.0]), {"u": a * knots})
    met = min(root.real for root in np.roots([a / 6, 0.0, -1.0, 1.0]) if abs(root.imag) < 1e-12 and root.real > 0)
    back, left = 1.0 - 0.5 * a * met**2, 3.0 - met
    np.testing.assert_allclose(run.q[-1], (back - 0.5 * a * met**2) * left + a / 6 * (27.0 - met**3), rtol=1e-8)


def test_every_bounce_of_a_ball():
    h, e = np.array([1.0, 0.4, 2.5]), np.array([0.9, 1.0, 0.5])
    ts = np.linspace(0.0, 2.0, 45)
    runs = jax.jit(jax.vmap(lambda h, e: bouncing(h, e, ts=ts, rtol=1e-12)))(h, e)
    assert runs.ok.all()
    for i in range(3):
        count = int(runs.transitions.count[i])
        expected = bounce_times(h[i], e[i], G, count + 1)
        assert expected[count - 1] <= 2.0 < expected[count]
        # Rounding and the tolerance, once for every flight.
        np.testing.assert_allclose(runs.transitions.t[i, :count], expected[:-1], rtol=1e-12)
        impact = np.sqrt(2 * G * h[i]) * e[i] ** np.arange(count)
        np.testing.assert_allclose(runs.transitions.qdot[i, :count], -impact, rtol=1e-11)
        assert abs(runs.transitions.q[i, :count]).max() < 1e-14
        assert np.isnan(runs.transitions.t[i, count:]).all() and np.isnan(runs.transitions.q[i, count:]).all()
        assert (runs.transitions.source[i, :count] == 0).all() and (runs.transitions.target[i, count:] == -1).all()
        # Between bounces energy is that with which it left the floor.
        bounces = np.searchsorted(expected[:count], ts, side="left")
        np.testing.assert_allclose(runs.energy()[i], G * h[i] * e[i] ** (2.0 * bounces), rtol=1e-10)
        left = np.where(bounces > 0, expected[bounces - 1], 0)
        speed = np.where(bounces > 0, np.sqrt(2 * G * h[i]) * e[i] ** bounces, 0)
        flown = np.asarray(ts) - left
        height = np.where(bounces > 0, 0, h[i]) + speed * flown - 0.5 * G * flown**2
        np.testing.assert_allclose(runs.q[i], height, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [-1, 0])
def test_bounces_that_pile_up_are_reported_and_never_fall_through(direction):
    # Heights shrink beyond the digits that a position at 0.37 has, times beyond those that a time has.
    bounce = lagjax.Transition(
        "flight", "flight", lambda q, v, params: q - params["floor"], direction,
        reset=lambda q, v, params: (q, -params["e"] * v),
    )  # fmt: skip
    ts, floor, e = jnp.linspace(0.0, 6.0, 25), np.array([0.0, 0.0, 0.37, 0.37]), np.array([0.5, 0.8, 0.5, 0.8])
    run = lambda floor, e: hybrid(
        {"flight": BALL_IN_GRAVITY}, [bounce], 1.0 + floor, 0.0, ts, {"e": e, "g": G, "floor": floor},
        max_transitions=200, throw=False,
    )  # fmt: skip
    runs = jax.jit(jax.vmap(run))(floor, e)
    assert (runs.result._value == lagjax.RESULTS.zeno._value).all() and not runs.ok.any()
    still = np.sqrt(2 / G) * (1 + 2 * e / (1 - e))
    np.testing.assert_allclose(runs.end.t, still, atol=1e-6)
    for i in range(4):
        np.testing.assert_allclose(runs.transitions.t[i, :20], bounce_times(1.0, e[i], G, 20), rtol=1e-8)
    beyond = np.asarray(ts) > still[:, None]
    np.testing.assert_array_equal(np.isnan(runs.q), beyond)
    np.testing.assert_array_equal(runs.mode, np.where(beyond, -1, 0))
    np.testing.assert_array_equal(np.isnan(runs.energy()), beyond)
    assert np.nanmin(runs.q - floor[:, None]) > -1e-9


@pytest.mark.slow
def test_the_budget_of_transitions():
    with pytest.raises(lagjax.SimulationError, match="max_transitions") as caught:
        bouncing(1.0, 0.9, max_transitions=2)
    run = caught.value.trajectory
    assert "mode 'flight'" in str(caught.value) and run.transitions.count == 2
    third = bounce_times(1.0, 0.9, G, 3)[2]
    np.testing.assert_allclose(run.end.t, third, rtol=1e-12)
    assert (np.isnan(run.q) == (np.asarray(run.ts) > third)).all()
    assert bouncing(1.0, 0.9, max_transitions=3).ok
    with pytest.raises(Exception, match="max_transitions"):
        jax.block_until_ready(jax.jit(lambda h: bouncing(h, 0.9, max_transitions=2).q)(1.0))


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd, jax.hessian])
def test_what_was_not_reached_has_no_derivative_and_never_zero(mode):
    # The second bounce, at 1.264, is not allowed: outputs after it are not reached.
    def outcome(h):
        run = bouncing(h, 0.9, max_transitions=1, throw=False)
        return run.q, run.transitions.t

    q, t = jax.jit(mode(outcome))(1.0)
    np.testing.assert_array_equal(np.isfinite(q), np.linspace(0.0, 2.0, 9) < 1.264)
    np.testing.assert_allclose(t[0], (-0.25 if mode is jax.hessian else 0.5) * np.sqrt(2 / G), rtol=1e-8)


@pytest.mark.slow
def test_a_spent_budget_is_told_from_bounces_that_pile_up():
    # They add up to sqrt(2 h/g) (1 + e)/(1 − e): 4.06 for e = 0.8 and h = 1. Those of e = 1 never end.
    run = lambda e, end, **options: bouncing(1.0, e, ts=jnp.linspace(0.0, 1.0, 5) * end, throw=False, **options)
    zeno, spent = lagjax.RESULTS.zeno, lagjax.RESULTS.max_transitions_reached
    assert run(0.8, 4.2, max_transitions=8).result == zeno
    assert run(0.8, 4.0, max_transitions=8).result == spent, "a larger budget reaches the end"
    assert run(0.8, 4.0).ok
    found = jax.vmap(lambda e: run(e, 200.0).result._value)(np.array([0.5, 0.9, 0.95, 1.0]))
    assert found.tolist() == [zeno._value] * 3 + [spent._value]
    with pytest.raises(lagjax.SimulationError, match=r"ever shorter times .* let it come to rest") as caught:
        bouncing(1.0, 0.8, ts=np.array([0.0, 5.0]))
    assert caught.value.trajectory.result == zeno
    # What the sentence says, and one who resets a slow ball to rest, which gravity pushes onto the floor at once.
    line = str(caught.value).partition("its surface: ")[2].partition(".\n")[0]
    to_rest = eval(line, {"Transition": lagjax.Transition, "jnp": jnp})
    modes = {"flight": BALL_IN_GRAVITY, "rest": BALL_ON_THE_FLOOR}

    def stopped(q, v, params):
        return q, jnp.where(jnp.abs(v) < params["stop"], 0.0, -0.8 * v)

    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, -1, stopped)
    for stop in (0.0, 1.0):
        run = hybrid(modes, [to_rest, bounce], 1.0, 0.0, (0.0, 5.0), {"g": G, "stop": stop})
        assert run.mode[-1] == 1 and abs(run.q[-1]) < 1e-12
    with pytest.raises(lagjax.SimulationError, match=r"^(?!.*ever shorter).*The guard is pushed at its surface"):
        hybrid({"flight": BALL_IN_GRAVITY}, [bounce], 1.0, 0.0, (0.0, 5.0), {"g": G, "stop": 1.0})
    # Two modes that take turns, one above and one below the floor, which is soft: flight and contact alternate.
    land = lagjax.Transition("flight", "floor", lambda q, v: q, direction=-1)
    leave = lagjax.Transition("floor", "flight", lambda q, v: q, direction=1, reset=lambda q, v: (q, 0.7 * v))
    run = hybrid(
        {"flight": BALL_IN_GRAVITY, "floor": SOFT}, [land, leave], 1.0, 0.0, (0.0, 20.0), {"g": G}, throw=False
    )
    assert run.result == spent, "a contact lasts as long for a small bounce as for a large one: no sum is finite"


@pytest.mark.slow
def test_derivatives_of_the_bouncing_ball():
    # After three bounces: times, states before them, outputs on the way, the end. By height, speed, e and g.
    ts = jnp.linspace(0.5, 2.7, 9)

    def outcome(x):
        h, v, e, g = x
        run = bouncing(h, e, g, v, ts, rtol=1e-12)
        t, impact = run.transitions.t[:3], run.transitions.qdot[:3]
        return jnp.concatenate([t, impact, run.q[1:], run.qdot[1:], run.end.q[None]])

    def closed(x):
        h, v, e, g = x
        down = jnp.sqrt(v**2 + 2 * g * h)
        t = 0.5 + (v + down) / g + 2 * down / g * jnp.stack([0 * e, e, e + e**2])
        impact = down * e ** jnp.arange(3)
        after = jnp.sum(ts[1:, None] > t, axis=1)
        left = jnp.where(after > 0, t[after - 1], 0.5)
        speed, start = jnp.where(after > 0, e * impact[after - 1], v), jnp.where(after > 0, 0, h)
        s = ts[1:] - left
        q = start + speed * s - 0.5 * g * s**2
        return jnp.concatenate([t, -impact, q, speed - g * s, q[-1:]])

    x = jnp.array([1.1, 0.7, 0.8, G])
    batch = jnp.stack([x, x.at[0].set(1.0), x.at[2].set(0.82)])
    outcomes = jax.vmap(lambda x: (outcome(x), jax.jacrev(outcome)(x), jax.jacfwd(outcome)(x)))
    values, reverse, forward = jax.jit(outcomes)(batch)
    np.testing.assert_allclose(values, jax.jit(jax.vmap(closed))(batch), atol=1e-11)
    np.testing.assert_allclose(reverse, jax.jit(jax.vmap(jax.jacfwd(closed)))(batch), atol=1e-10)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    np.testing.assert_allclose(reverse[0], central(outcome, x), atol=1e-6)


@pytest.mark.slow
def test_derivatives_by_the_times():
    # By output times a state changes at its rate, by the start of the motion everything is later.
    def outcome(ts):
        run = bouncing(1.0, 0.9, ts=ts, rtol=1e-12)
        return jnp.concatenate([run.q, run.end.q[None], run.transitions.t[:1], run.end.t[None]]), run.qdot

    slopes, rates = jax.jit(jax.jacrev(outcome, has_aux=True))(np.linspace(0.2, 1.7, 4))
    expected = np.diag(rates)
    expected[:, 0] -= rates
    expected = np.concatenate([expected, [[-rates[-1], 0, 0, rates[-1]], [1, 0, 0, 0], [0, 0, 0, 1]]])
    np.testing.assert_allclose(slopes, expected, atol=1e-9)


# ---- other scenes ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_particle_leaves_a_smooth_sphere():
    # From rest on top at cos θ = 2/3; from θ⁰ with speed v at cos θ = (2 cos θ⁰ + v²/(g R)) / 3. Cartesian coordinates.
    radius = 0.7
    fall = lambda q, v: 0.5 * jnp.sum(v**2) - G * q[1]
    modes = {"on": lagjax.System(fall, constraints=lambda q: q @ q - radius**2), "off": lagjax.System(fall)}
    leave = lagjax.Transition("on", "off", lambda q, v, multipliers: multipliers, direction=-1)

    def departure(angle, speed):
        q0 = radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        v0 = speed * jnp.stack([jnp.cos(angle), -jnp.sin(angle)])
        return hybrid(modes, [leave], q0, v0, (0.0, 4.0), rtol=1e-12, max_transitions=2).transitions.q[0] / radius

    angle, speed = np.array([1e-3, 0.2, 0.5]), np.array([0.0, 0.0, 0.8])
    cosine = (2 * np.cos(angle) + speed**2 / (G * radius)) / 3
    found = jax.vmap(departure)(angle, speed)
    np.testing.assert_allclose(found[:, 1], cosine, atol=1e-9)  # slow at the top: errors grow e^(ωt), here by 10³
    assert abs(found[0, 1] - 2 / 3) < 1e-6
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-14)


@pytest.mark.slow
def test_poincare_section_of_henon_heiles():
    scene = HENON_HEILES
    section = lagjax.Transition("all", "all", lambda q, v: q[0], direction=1)
    q0, v0 = np.array([0.0, 0.1]), np.array([0.4, 0.05])
    run = hybrid({"all": scene}, [section], q0, v0, (0.0, 60.0), rtol=1e-12)
    # All of them, and no other; the start, on the section and rising, is the first.
    dense = lagjax.simulate(scene, q0, v0, np.linspace(0.0, 60.0, 3001), rtol=1e-12)
    x = np.asarray(dense.q[1:, 0])
    assert run.transitions.count == 1 + np.sum((x[:-1] < 0) & (x[1:] >= 0)) > 6 and run.transitions.t[0] == 0.0
    ts = np.concatenate([times(run), [60.0]])
    plain = lagjax.simulate(scene, q0, v0, np.asarray(ts), rtol=1e-12)
    count = int(run.transitions.count)
    np.testing.assert_allclose(run.transitions.q[:count], plain.q[:-1], atol=1e-10)
    np.testing.assert_allclose(run.transitions.qdot[:count], plain.qdot[:-1], atol=1e-10)
    assert abs(run.transitions.q[:count, 0]).max() < 1e-15 and run.transitions.qdot[:count, 0].min() > 0
    np.testing.assert_allclose(run.q[-1], plain.q[-1], atol=1e-9)  # a reset that changes nothing changes nothing


@pytest.mark.slow
def test_a_kicked_rotor_is_the_standard_map():
    # Kicks by the clock: p → p + K sin θ at t = 1, 2, …, free between. The first free step would be of six periods.
    kick = lagjax.Transition(
        "free", "free", lambda q, v, t: jnp.sin(2 * jnp.pi * t), 1, lambda q, v, params: (q, v + params * jnp.sin(q))
    )
    ts = np.arange(0.5, 100.0)
    run = hybrid({"free": FREE}, [kick], 0.3, 0.2, ts, 0.9, max_transitions=100)
    q, p, expected = 0.3 + 0.5 * 0.2, 0.2, []
    for _ in range(99):
        expected.append(q)
        p = p + 0.9 * np.sin(q)
        q = q + p
    np.testing.assert_allclose(times(run), np.arange(1.0, 100.0), rtol=1e-14)
    np.testing.assert_allclose(run.transitions.q[:40], expected[:40], atol=1e-9)  # then chaos takes the digits


def test_a_guard_that_jumps():
    # mod(t, 1) falls to zero at every second, which is not asked for, and rises through a half after it.
    half = lagjax.Transition("free", "free", lambda q, v, t: jnp.mod(t, 1.0) - 0.5, 1, lambda q, v: (q, v + 1.0))
    run = hybrid({"free": FREE}, [half], ts=(0.0, 9.9))
    np.testing.assert_allclose(times(run), np.arange(10) + 0.5, rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("guard", [lambda q, v: jnp.sign(q - 0.5), lambda q, v, t: jnp.floor(2 * t) - 0.5])
def test_a_guard_that_only_jumps_is_crossed_once(guard):
    double = lagjax.Transition("a", "a", guard, 1, lambda q, v: (q, 2 * v))
    run = hybrid({"a": FREE}, [double], 0.1, 0.8, max_transitions=3)
    np.testing.assert_allclose([run.transitions.t[0], run.end.q], [0.5, 1.3], rtol=1e-14)
    assert run.transitions.count == 1


@pytest.mark.slow
def test_two_balls_that_land_at_the_same_instant_both_bounce():
    first = lagjax.Transition("f", "f", lambda q, v: q[0], -1, lambda q, v: (q, v.at[0].multiply(-0.8)))
    second = lagjax.Transition("f", "f", lambda q, v: q[1], -1, lambda q, v: (q, v.at[1].multiply(-0.8)))
    run = hybrid({"f": BALLS}, [first, second], jnp.ones(2), jnp.zeros(2), (0.0, 1.0, 1.8))
    one = bounce_times(1.0, 0.8, G, 3)
    np.testing.assert_allclose(times(run), np.repeat(one[one < 1.8], 2), rtol=1e-12)
    np.testing.assert_allclose(run.q[:, 0], run.q[:, 1], rtol=1e-12)
    np.testing.assert_allclose(run.q[-1, 0], bouncing(1.0, 0.8, ts=jnp.array([0.0, 1.8])).q[-1], rtol=1e-9)


# ---- which transitions, and when ------------------------------------------------------------------------------------


def test_directions():
    # cos πt falls twice and rises twice; q[1] counts 1 for what only falls, 100 for what only rises, 10 for both.
    counter = lambda weight: lambda q, v: (q.at[1].add(weight), v)
    guard = lambda q, v: jnp.cos(jnp.pi * q[0])
    sections = [lagjax.Transition("a", "a", guard, d, counter(w)) for d, w in ((-1, 1.0), (0, 10.0), (1, 100.0))]
    run = hybrid({"a": PLANE}, sections, jnp.zeros(2), jnp.array([1.0, 0.0]), (0.0, 1.0, 2.0, 4.0))
    np.testing.assert_allclose(times(run), np.repeat([0.5, 1.5, 2.5, 3.5], 2), rtol=1e-14)
    assert run.q[:, 1].tolist() == [0.0, 11.0, 121.0, 242.0]


THREE = {"a": FREE, "b": FREE, "c": FREE}


def at(name, source, target, scale=1.0, **options):
    """Where q is params[name]."""
    return lagjax.Transition(source, target, lambda q, v, params: scale * (q - params[name]), **options)


@pytest.mark.slow
def test_the_earliest_wins_and_of_several_at_once_the_first_listed():
    # Within what would be one step; the last two at one instant, to rounding.
    places = {"x": np.array([0.5, 0.3, 0.3, 0.2]), "y": np.array([0.3, 0.5, 0.3, 0.2 + 1e-16])}
    both = [at("x", "a", "b"), at("y", "a", "c", -1 / 3)]
    runs = jax.vmap(lambda p: hybrid(THREE, both, params=p))(places)
    np.testing.assert_allclose(runs.transitions.t[:, 0], [0.3, 0.3, 0.3, 0.2], rtol=1e-15)
    assert runs.transitions.target[:, 0].tolist() == [2, 1, 1, 1] and (runs.transitions.count == 1).all()
    # One after the other, and not back again: on the surface of x in b, the motion has left it.
    chain = [at("x", "a", "b"), at("y", "b", "c"), at("z", "c", "a"), at("x", "b", "a")]
    run = hybrid(THREE, chain, params={"x": 0.1, "y": 0.1 + 1e-9, "z": 0.2}, max_transitions=4)
    np.testing.assert_allclose(times(run), [0.1, 0.1 + 1e-9, 0.2], rtol=1e-15)
    assert run.transitions.source.tolist() == [0, 1, 2, -1] and run.transitions.target.tolist() == [1, 2, 0, -1]


@pytest.mark.parametrize("direction", sweep([-1, 0, 1], kept=[]))
def test_a_surface_crossed_twice_within_a_step(direction):
    # Two crossings 2e-3, 2e-6 apart in a step of 0.06: between them the guard has the other sign.
    band = lambda q, v, params: (q - params["middle"]) ** 2 - params["half"] ** 2
    half, middle = np.array([1e-3, 1e-6, 1e-3, 1e-6]), np.array([0.47, 0.47, 0.499, 1e-4])
    leave = lagjax.Transition("a", "b", band, direction, fires="crossing")  # +1 is where it starts
    run = lambda half, middle: hybrid({"a": FREE, "b": FREE}, [leave], params={"half": half, "middle": middle})
    found = jax.jit(jax.vmap(run))(half, middle).transitions
    np.testing.assert_allclose(found.t[:, 0], middle + (half if direction > 0 else -half), rtol=1e-12)
    assert (found.count == 1).all()


def test_touching_is_not_crossing():
    guards = [
        lambda q, v: (q - 0.47) ** 2, lambda q, v: -((q - 0.5) ** 2), lambda q, v: 1e-9 + (q - 0.47) ** 2,
        lambda q, v, t: 1 + jnp.cos(3 * jnp.pi * t), lambda q, v: 0.0 * q, lambda q, v: v - 1.0,
    ]  # fmt: skip
    run = hybrid({"a": FREE, "b": FREE}, [lagjax.Transition("a", "b", guard) for guard in guards])
    assert run.ok and run.transitions.count == 0 and (run.mode == 0).all()
    assert run.stats["num_steps"] < 50


@pytest.mark.parametrize("direction", sweep([-1, 0, 1], kept=[]))
def test_a_start_on_the_surface_fires_where_it_moves_on_in_the_direction(direction):
    section = at("x", "all", "all", direction=direction)
    run = lambda q, v, x: hybrid({"all": OSCILLATOR}, [section], q, v, (0.0, 5.0), {"x": x}, max_transitions=3)
    # q = v⁰ sin t from q = 0, exactly or off by rounding: in a direction the start has been met if it goes there, else
    # the crossing at π is the first, as it is for both directions. Very near is not on it. And at rest on it, to
    # whichever side it then goes: q = ±0.3 cos t.
    q = jnp.array([0.0, 0.0, 1e-17, 1e-17, -1e-17, -1e-17, 0.0, 0.3, -0.3])
    v = jnp.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 0.0, 0.0])
    x = jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1e-10, 0.3, -0.3])
    found = jax.jit(jax.vmap(run))(q, v, x).transitions
    met = direction * v[:6] > 0
    assert found.count[:6].tolist() == [1] * 6
    np.testing.assert_allclose(found.t[:6, 0], np.where(met, 0.0, np.pi), rtol=1e-8)
    assert found.count[6] == (2 if direction == 0 else 1)
    assert found.count[7:].tolist() == [direction == -1, direction == 1] and np.nansum(found.t[7:]) == 0.0
    if direction < 1:
        np.testing.assert_allclose(found.t[6, 0], 1e-10, rtol=1e-5)


@pytest.mark.slow
def test_a_start_along_the_surface_does_not_fire():
    plane = FREE_POINTS
    circle = lagjax.Transition("all", "all", lambda q, v: q @ q - 1)
    angle = np.linspace(0.0, 6.0, 50)
    q0, v0 = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)
    runs = jax.vmap(lambda q, v: hybrid({"all": plane}, [circle], q, v, max_transitions=2))(q0, v0)
    assert (runs.transitions.count == 0).all()


# ---- guards met together, and starts on guards ---------------------------------------------------------------------


def flip(i):
    return lambda q, v: (q, v.at[i].multiply(-1.0))


def unit_box(direction, q, v, end):
    walls = [lambda q, v: 1 - q[0], lambda q, v: 1 - q[1], lambda q, v: q[0], lambda q, v: q[1]]
    walls = [lagjax.Transition("a", "a", wall, direction, flip(k % 2)) for k, wall in enumerate(walls)]
    ts = jnp.stack([jnp.zeros(()), end])
    return lagjax.simulate(lagjax.Hybrid({"a": FREE_POINTS}, walls, "a"), q, v, ts, max_transitions=100, throw=False)


@pytest.mark.parametrize("direction", sweep([-1, 0], kept=[-1]))
def test_walls_met_within_rounding_all_reflect(direction):
    # Start, velocity, duration, transitions, end: beside the corner by e; through a corner at t = 5; from a corner into
    # it, and along a wall; and to corners at the last instant, which is before the reflections or after both.
    e = [0.0, 1e-17, 1e-16, 3e-16, 1e-15, 3e-15, 1e-14, 2e-14, 1e-13, 1e-12]
    cases = [([0.3, 0.3 + s * x], [0.7, 0.7], 1.5, [2], [0.65, 0.65]) for x in e for s in (1, -1)]
    cases += [([0.0, 0.5], [1.0, 0.3], 19.6, [25], [0.4, 0.38]), ([0.0, 0.0], [1.0, 3.0], 20.0, [78, 80], [0.0, 0.0])]
    if direction:
        cases += [([0.0, 0.0], [-1.0, -3.0], 0.5, [3], [0.5, 0.5]), ([1.0, 0.0], [0.0, -1.0], 0.5, [1], [1.0, 0.5])]
    q, v, end, counts, expected = zip(*cases, strict=True)
    runs = jax.jit(jax.vmap(lambda *x: unit_box(direction, *x)))(*map(jnp.array, (q, v, end)))
    assert runs.ok.all()
    assert all(int(n) in possible for n, possible in zip(runs.transitions.count, counts, strict=True))
    np.testing.assert_allclose(runs.end.q, expected, atol=1e-11)  # eighty reflections, each to rounding


def test_beads_that_touch_pass_the_blow_on():
    # Velocities are exchanged: the beads do what as many would that pass through each other.
    def exchange(i):
        return lambda q, v: (q, v.at[i].set(v[i + 1]).at[i + 1].set(v[i]))

    row = [lagjax.Transition("a", "a", _gap(i), -1, exchange(i)) for i in range(4)]
    run = lambda q, v: hybrid({"a": FREE_POINTS}, row, q, v)
    q = [[-0.5, 0, 0, 0, 0], [0, 0, 0, 0, 0], [-0.3, 0, 0, 0, 0.3], [-0.3, -0.3, 0, 0, 0], [0.1, 0.1, 0.1, 0.1, 0.1]]
    v = [[1, 0, 0, 0, 0], [1, 0, 0, 0, -1], [1, 0, 0, 0, -1], [1, 1, 0, 0, 0], [0.7, 0.7, 0.7, 0.7, 0.7]]
    q, v = (np.array(x, float) for x in (q, v))
    runs = jax.jit(jax.vmap(run))(q, v)
    assert runs.ok.all() and runs.transitions.count.tolist() == [4, 7, 7, 6, 0]
    np.testing.assert_allclose(runs.end.q, np.sort(q + v, axis=1), atol=1e-14)


def _gap(i):
    return lambda q, v: q[i + 1] - q[i]


DROPPED_TOGETHER = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - G * jnp.sum(q))


@pytest.mark.slow
def test_balls_dropped_together_stay_above_the_floor():
    floors = [lagjax.Transition("a", "a", lambda q, v: q[0], -1, lambda q, v: (q, v.at[0].multiply(-0.9))),
              lagjax.Transition("a", "a", lambda q, v: q[1], -1, lambda q, v: (q, v.at[1].multiply(-0.9)))]  # fmt: skip
    h, e = (x.ravel() for x in np.meshgrid(np.linspace(0.5, 3.0, 40), [0.0, 3e-15, 1e-14, -1e-14, 1e-13, 1e-12]))
    run = lambda h, e: hybrid({"a": DROPPED_TOGETHER}, floors, jnp.stack([h, h * (1 + e)]), jnp.zeros(2), (0.0, 2.0))
    runs = jax.jit(jax.vmap(run))(h, e)
    alone = jax.jit(jax.vmap(lambda h: bouncing(h, 0.9, ts=jnp.array([0.0, 2.0]))))(h)
    # Rounding of the height, and of the time at the speed of the fall.
    np.testing.assert_allclose(runs.end.q, np.stack([alone.end.q] * 2, 1), atol=2e-11)
    np.testing.assert_array_equal(runs.transitions.count, 2 * alone.transitions.count)


def test_a_ball_that_starts_on_the_floor():
    # Into it: it bounces at once. Away from it: it is waited for. At rest, or turned round in no time: it stays.
    v = jnp.array([-1.0, 1.0, 0.0, -1e-17, 1e-17])
    runs = jax.vmap(lambda v: bouncing(0.0, 0.9, v=v, ts=jnp.array([0.0, 0.15]), throw=False))(v)
    assert runs.ok.tolist() == [True, True, False, False, False]
    assert (runs.result._value[2:] == lagjax.RESULTS.zeno._value).all()
    assert runs.transitions.count[:2].tolist() == [1, 0] and runs.transitions.t[0, 0] == 0.0
    rise = np.array([0.9, 1.0]) * 0.15 - 0.5 * G * 0.15**2
    np.testing.assert_allclose(runs.end.q[:2], rise, rtol=1e-13)


@pytest.mark.slow
def test_derivatives_through_transitions_at_one_instant():
    # In the corner reflections commute: q = 2 c − q⁰ − v⁰ T whatever moves, and nothing is quadratic but v⁰ T.
    x = jnp.array([0.3, 0.3, 0.7, 0.7, 1.5])

    def outcome(x):
        run = unit_box(-1, x[:2], x[2:4], x[4])
        return jnp.concatenate([run.end.q, run.end.qdot, run.transitions.t[:2]])

    def closed(x):
        q, v, t = x[:2], x[2:4], x[4]
        return jnp.concatenate([2 - q - v * t, -v, (1 - q) / v])

    np.testing.assert_allclose(outcome(x), closed(x), atol=1e-14)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(outcome))(x), jax.jit(jax.jacfwd(closed))(x), atol=1e-11)
        second = jax.jit(jax.vmap(jax.jacfwd(mode(outcome))))(np.stack([x, x]))
        np.testing.assert_allclose(second, np.stack([jax.jit(jax.hessian(closed))(x)] * 2), atol=1e-10)


# ---- members in different modes -------------------------------------------------------------------------------------
#
# A spring of stiffness k on the left and another on the right: half periods π/√k of one and the other.

SPRING = lambda name: lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params[name] * q**2)
POLE = lagjax.System(lambda q, v, params: 0.5 * v**2 + params / (1 - q))
SIDES = {"right": SPRING("right"), "left": SPRING("left")}
CROSS = [
    lagjax.Transition("right", "left", lambda q, v: q, -1),
    lagjax.Transition("left", "right", lambda q, v: q, 1),
]
SIDE_TS = np.linspace(0.0, 6.0, 25)


def two_springs(right, left, v=1.0):
    params = {"right": right, "left": left}
    return lagjax.simulate(lagjax.Hybrid(SIDES, CROSS, "right"), 0.0, v, SIDE_TS, params, rtol=1e-12)


def exact_springs(right, left, v=1.0):
    a, b = jnp.sqrt(right), jnp.sqrt(left)
    half, period = jnp.pi / a, jnp.pi / a + jnp.pi / b
    s = SIDE_TS % period
    return jnp.where(s <= half, v / a * jnp.sin(a * s), -v / b * jnp.sin(b * (s - half)))


@pytest.mark.slow
def test_every_member_switches_at_its_own_time_in_its_own_order():
    right, left = np.array([1.0, 9.0, 0.2, 0.01]), np.array([4.0, 0.3, 25.0, 1.0])
    runs = jax.jit(jax.vmap(two_springs))(right, left)
    assert runs.ok.all()
    modes = np.asarray(runs.mode)
    assert (modes.min(axis=0) != modes.max(axis=0)).any()  # different modes at one time
    for i in range(4):
        np.testing.assert_allclose(runs.q[i], exact_springs(right[i], left[i]), atol=1e-10)
        halves = np.tile(np.pi / np.sqrt([right[i], left[i]]), 20).cumsum()
        count = int(runs.transitions.count[i])
        np.testing.assert_allclose(runs.transitions.t[i, :count], halves[halves < 6.0], rtol=1e-11)
        assert runs.transitions.source[i, :count].tolist() == [k % 2 for k in range(count)]
        alone = two_springs(right[i], left[i])
        np.testing.assert_allclose(runs.q[i], alone.q, atol=1e-12)
        np.testing.assert_array_equal(runs.mode[i], alone.mode)
    # The energy is that of the mode.
    stiffness = np.where(modes == 0, right[:, None], left[:, None])
    np.testing.assert_allclose(runs.energy(), 0.5 * runs.qdot**2 + 0.5 * stiffness * runs.q**2, rtol=1e-14)
    np.testing.assert_allclose(runs.energy(), 0.5, rtol=1e-10)
    np.testing.assert_allclose(runs.momentum(), runs.qdot, rtol=1e-15)
    data = runs.to_xarray()
    assert data["mode"].dims == ("member", "time") and (data["mode"].values == modes).all()


@pytest.mark.slow
def test_derivatives_through_different_modes_in_a_batch():
    x = jnp.array([[1.0, 4.0, 1.0], [9.0, 0.3, 0.7], [0.2, 25.0, 1.3]])

    def outcome(x):
        run = two_springs(*x)
        return run.q, jnp.sum(run.energy())

    states, energy = jax.jit(jax.vmap(jax.jacfwd(outcome)))(x)
    np.testing.assert_allclose(states, jax.vmap(jax.jacfwd(lambda x: exact_springs(*x)))(x), atol=1e-9)
    np.testing.assert_allclose(energy, [[0, 0, 25 * v] for v in x[:, 2]], atol=1e-8)


@pytest.mark.slow
def test_laws_that_are_singular_elsewhere_leave_no_nan_in_derivatives():
    # The first mode has a pole at q = 1, which the motion passes in the second.
    transition = lagjax.Transition("pole", "free", lambda q, v, params: q - 0.5)

    def outcome(p):
        ts = (0.0, 0.25, 1.0, 2.0)
        run = hybrid({"pole": POLE, "free": FREE}, [transition], 0.0, 0.5, ts, p[0], rtol=1e-12, max_transitions=2)
        return jnp.stack([run.q[-1], jnp.sum(run.energy()), run.transitions.t[0], run.end.q])

    p = np.array([0.1])
    assert outcome(p)[0] > 1
    np.testing.assert_allclose(jax.jit(jax.jacrev(outcome))(p), central(outcome, p), rtol=1e-6, atol=1e-9)
    late = lagjax.Transition("free", "pole", lambda q, v: q - 2.0)

    def energy(p):  # at q = 1, where the mode with the pole is not
        run = hybrid({"free": FREE, "pole": POLE}, [late], 0.0, 1.0, (0.0, 1.0, 1.5), p, max_transitions=1)
        return jnp.sum(run.energy()) + run.q[1]

    assert jax.jit(jax.grad(energy))(0.1) == 0.0


# ---- times ----------------------------------------------------------------------------------------------------------


def test_an_output_at_the_instant_of_a_transition_belongs_to_the_mode_before():
    push = lagjax.Transition("a", "b", lambda q, v, t: t - 3.0, reset=lambda q, v: (q + 10.0, 2 * v))
    run = hybrid({"a": FREE, "b": FREE}, [push], 0.0, 1.0, (2.0, 2.5, 3.0, 3.5), max_transitions=3)
    np.testing.assert_allclose(run.q, [0.0, 0.5, 1.0, 12.0], rtol=1e-15)
    assert run.mode.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(run.transitions.t, [3.0, np.nan, np.nan], rtol=1e-15)
    np.testing.assert_allclose(run.transitions.q, [1.0, np.nan, np.nan], rtol=1e-15)
    assert run.transitions.source.tolist() == [0, -1, -1] and run.transitions.target.tolist() == [1, -1, -1]
    assert run.transitions.count == 1 and run.end.q == run.q[-1] and run.end.t == 3.5
    np.testing.assert_array_equal(run.energy(), [0.5, 0.5, 0.5, 2.0])


@pytest.mark.slow
def test_pytrees_and_quantities_of_like_constraints():
    # A pendulum on a rod that is caught by a nail: another length from then on. Named coordinates and constraints.
    fall = lambda q, v: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"]
    modes = {
        "long": lagjax.System(fall, constraints=lambda q: {"rod": q["x"] ** 2 + q["y"] ** 2 - 1.0}),
        "short": lagjax.System(fall, constraints=lambda q: {"rod": q["x"] ** 2 + (q["y"] + 0.5) ** 2 - 0.25}),
    }
    catch = lagjax.Transition("long", "short", lambda q, v: q["x"], -1)
    angle = 0.4
    q0 = {"x": np.sin(angle), "y": -np.cos(angle)}
    run = hybrid(modes, [catch], q0, {"x": 0.0, "y": 0.0}, np.linspace(0.0, 0.9, 10), rtol=1e-12, max_transitions=1)
    quantities = lambda run: (run.energy(), run.multipliers["rod"], run.constraint_residual(), run.constraint_force())
    energy, multiplier, residual, force = jax.jit(quantities)(run)
    assert run.transitions.count == 1 and set(run.mode.tolist()) == {0, 1}
    np.testing.assert_allclose(energy, -G * np.cos(angle), rtol=1e-10)
    np.testing.assert_allclose(run.transitions.qdot["x"][0] ** 2, 2 * G * (1 - np.cos(angle)), rtol=1e-10)
    # Tension over length: λ = −(v² / l + g cos φ) / 2l, for a constraint of gradient 2l.
    length = np.where(run.mode == 0, 1.0, 0.5)
    cosine = -(run.q["y"] + np.where(run.mode == 0, 0.0, 0.5)) / length
    tension = (run.qdot["x"] ** 2 + run.qdot["y"] ** 2) / length + G * cosine
    np.testing.assert_allclose(multiplier, -tension / (2 * length), rtol=1e-9)
    assert abs(residual["rod"]).max() < 1e-13
    np.testing.assert_allclose(np.hypot(force["x"], force["y"]), tension, rtol=1e-9)
    assert set(run.to_xarray()) == {"ok", "q.x", "q.y", "qdot.x", "qdot.y", "mode"}


# ---- a motion in pieces ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_motion_goes_on_in_a_scan_of_short_ones_from_the_mode_where_it_is():
    # A free particle that is reflected at q = 1, into another mode, and at q = 0 back: |q| is the way to the next even
    # number.
    turn = lambda q, v: (q, -v)
    back = [
        lagjax.Transition("out", "in", lambda q, v: q - 1.0, 1, turn),
        lagjax.Transition("in", "out", lambda q, v: q, -1, turn),
    ]
    start_in = lambda mode: lagjax.Hybrid({"out": FREE, "in": FREE}, back, mode, 2)
    count, dt = 40, 0.17

    def pieces(speed):
        def step(carry, _):
            q, v, mode = carry
            run = lagjax.simulate(start_in(mode), q, v, jnp.array([0.0, dt]))
            return (run.q[-1], run.qdot[-1], run.mode[-1]), (run.q[-1], run.mode[-1])

        return jax.lax.scan(step, (0.0 * speed, speed, jnp.asarray(0)), None, length=count)[1]

    speeds = jnp.array([1.0, 1.3, 2.9])
    q, mode = jax.jit(jax.vmap(pieces))(speeds)
    way = np.asarray(speeds)[:, None] * dt * np.arange(1, count + 1)
    np.testing.assert_allclose(q, np.abs(way - 2 * np.round(way / 2)), atol=1e-12)
    np.testing.assert_array_equal(mode, np.floor(way) % 2)
    slopes = jax.jit(jax.jacrev(lambda speed: pieces(speed)[0]))(1.3)
    np.testing.assert_allclose(slopes, dt * np.arange(1, count + 1) * np.where(mode[1] == 0, 1, -1), rtol=1e-12)
    # A place that is none, as that of what was not reached, is no motion.
    lost = jax.jit(lambda mode: lagjax.simulate(start_in(mode), 0.0, 1.0, jnp.arange(2.0), throw=False))(-1)
    assert not lost.ok and np.isnan(lost.q).all()
    assert lagjax.simulate(start_in("in"), 0.5, -1.0, jnp.array([0.0, 1.0])).q[-1] == 0.5
    with jax.enable_x64(False):
        assert lagjax.simulate(start_in(1), 0.5, -1.0, jnp.array([0.0, 1.0])).q[-1] == 0.5


# ---- bad input ------------------------------------------------------------------------------------------------------


def stay(source="a", target="a", guard=lambda q, v: q - 0.5, **options):
    return lagjax.Transition(source, target, guard, **options)


ROD = lagjax.System(lambda q, v: 0.5 * v @ v, constraints=lambda q: q[1])
MASSLESS = lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2)


WITHOUT_MACHINE_CODE = lagjax.System(lambda q, v: v @ v + jax.scipy.special.betainc(2.0, 3.0, q[0]))


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"start": "z"}, ValueError, "start is 'z', which is no mode: the modes are 'a'"),
        ({"start": 1}, ValueError, "start is 1, which is no mode: the modes are 'a'"),
        ({"start": True}, ValueError, "start is True, which is no mode"),
        ({"start": jnp.arange(2)}, ValueError, "start is Array.*, which is no mode"),
        ({"transitions": [stay("y")]}, ValueError, "source 'y', which is no mode"),
        ({"transitions": [stay("a", "y")]}, ValueError, "target 'y', which is no mode"),
        ({"modes": THREE, "transitions": [stay("a", "c"), stay("b", "a")]}, ValueError, "'a' to 'b': unreachable"),
        ({"transitions": [lambda q, v: q]}, TypeError, "must be lagjax.Transition"),
        ({"transitions": stay()}, TypeError, "must be a list of lagjax.Transition"),
        ({"modes": FREE}, TypeError, "modes must be a dict of lagjax.System"),
        ({"modes": {"a": lambda q, v: v}}, TypeError, "modes must be a dict of lagjax.System"),
        ({"modes": {}}, TypeError, "modes must be a dict"),
        ({"max_transitions": 0}, ValueError, "max_transitions must be a positive integer"),
        ({"max_transitions": 2.0}, ValueError, "max_transitions must be a positive integer"),
        ({"ts": [1.0, 0.0]}, ValueError, "ts must increase"),
        ({"ts": [0.0, 2.0, 1.0]}, ValueError, "strictly increasing"),
        ({"q0": np.nan}, ValueError, "q0 is nan"),
        (
            {"modes": {"a": WITHOUT_MACHINE_CODE},
             "q0": np.zeros(2), "qdot0": np.zeros(2), "transitions": [stay(guard=lambda q, v: q[0])]},
            ValueError, "'a' has no machine code: .*regularized_incomplete_beta",
        ),
        ({"transitions": [stay(guard=lambda q, v: jnp.stack([q, v]))]}, TypeError, "one real number; got shape .2,."),
        ({"transitions": [stay(guard=lambda q, v: (q, v))]}, TypeError, "one real number; got tuple"),
        ({"transitions": [stay(guard=lambda q, v: q > 0)]}, TypeError, "one real number; got shape .* bool"),
        ({"transitions": [stay(guard=lambda q, v, multipliers: q)]}, ValueError, "mode has no constraints"),
        ({"transitions": [stay(reset=lambda q, v: q)]}, TypeError, r"from 'a' to 'a' must return the pair \(q, qdot\)"),
        ({"transitions": [stay(reset=lambda q, v: (q, v, v))]}, TypeError, "must return the pair"),
        ({"transitions": [stay(reset=lambda q, v: (jnp.stack([q, q]), v))]}, TypeError, "must agree"),
        ({"transitions": [stay(reset=lambda q, v: (q[None], v[None]))]}, TypeError, "the shapes of the initial state"),
        ({"transitions": [stay(reset=lambda q, v: ({"x": q}, {"x": v}))]}, TypeError, "structure and the shapes"),
        ({"modes": {"a": ROD}, "q0": np.ones(2), "qdot0": np.zeros(2)}, ValueError, "q0 does not satisfy constr"),
        (
            {"transitions": [stay(guard=jax.tree_util.Partial(lambda w, q, v: q - w, np.ones(())))]},
            ValueError, "holds arrays of its own",
        ),
    ],
)  # fmt: skip
def test_bad_input_gets_a_sentence(changes, error, sentence):
    given = {"modes": {"a": FREE}, "transitions": [stay()], "start": "a", "q0": 0.0, "qdot0": 1.0, "ts": [0.0, 1.0]}
    given |= changes
    of_scene = [given.pop(name) for name in ("modes", "transitions", "start")]
    with pytest.raises(error, match=sentence):
        lagjax.simulate(lagjax.Hybrid(*of_scene), **given)


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        (("a", "b", None), TypeError, "from 'a' to 'b' has no guard"),
        (("a", "b", 1.0), TypeError, "guard must be a function"),
        (("a", "b", lambda q: q), TypeError, "guard must have the form"),
        (("a", "b", lambda q, v, mass: q), TypeError, "guard asks for `mass`"),
        (("a", "b", lambda q, v: q, 2), ValueError, "direction must be"),
        (("a", "b", lambda q, v: q, 0, lambda q, v, multipliers: (q, v)), TypeError, "reset asks for `multipliers`"),
    ],
)
def test_what_cannot_be_a_transition(arguments, error, sentence):
    with pytest.raises(error, match=sentence):
        lagjax.Transition(*arguments)


@pytest.mark.slow
def test_a_reset_that_leaves_the_constraints_of_the_mode_is_not_repaired():
    # Onto the rod y = 0: with a velocity across it, to a place beside it, or rightly.
    flight = {"flight": FREE_POINTS, "rod": ROD}
    q0, v0 = jnp.array([0.0, 1.0]), jnp.array([1.0, -1.0])

    landing = lagjax.Transition(
        "flight", "rod", lambda q, v: q[1], -1,
        lambda q, v, params: (q.at[1].set(params["off"]), v.at[1].set(params["speed"])),
    )  # fmt: skip

    def land(off, speed):
        params = {"off": off, "speed": speed}
        return hybrid(flight, [landing], q0, v0, (0.0, 0.5, 2.0), params, throw=False, max_transitions=2)

    off, speed = jnp.array([0.0, 1e-3, 0.0, 1e-9]), jnp.array([0.0, 0.0, 0.3, 0.0])
    runs = jax.vmap(land)(off, speed)
    assert runs.ok.tolist() == [True, False, False, True]
    for i in (1, 2):
        assert runs.result._value[i] == lagjax.RESULTS.inconsistent_start._value
        assert runs.transitions.count[i] == 1 and runs.mode[i].tolist() == [0, 0, -1] and np.isnan(runs.q[i, -1]).all()
        np.testing.assert_allclose([runs.end.t[i], *runs.end.q[i]], [1.0, 1.0, off[i]], atol=1e-14)
    np.testing.assert_allclose(runs.q[0, -1], [2.0, 0.0], atol=1e-14)

    # A start that is off, where it is not a number yet.
    start = lambda y: hybrid({"a": ROD}, [], jnp.stack([0.0, y]), jnp.array([1.0, 0.0]), throw=False)
    runs = jax.vmap(start)(jnp.array([0.0, 0.1]))
    assert runs.ok.tolist() == [True, False] and np.isnan(runs.q[1]).all() and (runs.mode[1] == -1).all()
    assert runs.result._value[1] == lagjax.RESULTS.inconsistent_start._value


@pytest.mark.slow
def test_a_failure_names_the_mode():
    with pytest.raises(lagjax.SimulationError, match=r"off the constraints of 'rod'[^$]*mode 'rod'"):
        stuck = lagjax.Transition("flight", "rod", lambda q, v: q[1], -1)
        start = np.array([0.0, 1.0]), np.array([1.0, -1.0])
        hybrid({"flight": FREE_POINTS, "rod": ROD}, [stuck], *start, (0.0, 2.0), max_transitions=1)
    wall = EDGE
    with pytest.raises(lagjax.SimulationError, match=r"just ahead: the derivative of L by q[^$]*mode 'wall'") as caught:
        hybrid({"a": FREE, "wall": wall}, [lagjax.Transition("a", "wall", lambda q, v: q - 1.0)], 2.0, -1.0, (0.0, 3.0))
    assert caught.value.trajectory.system["wall"] is wall


@pytest.mark.slow
def test_a_failure_names_the_coordinate_without_mass_and_the_mode():
    with pytest.raises(lagjax.SimulationError, match=r"q\[1\][^$]*mode 'b'"):
        pass_on = lagjax.Transition("a", "b", lambda q, v: q[0] - 0.5)
        hybrid({"a": FREE_POINTS, "b": MASSLESS}, [pass_on], np.zeros(2), np.array([1.0, 0.0]))


@pytest.mark.slow
def test_guards_and_resets_that_are_nan():
    blind = lagjax.Transition("a", "a", lambda q, v: jnp.sqrt(-1.0 - q) + q - 0.5)
    broken = lagjax.Transition("a", "a", lambda q, v: q - 0.5, reset=lambda q, v: (q, jnp.sqrt(-q)))
    for transition in (blind, broken):
        with pytest.raises(lagjax.SimulationError, match=r"NaN or infinite[^$]*mode 'a'"):
            hybrid({"a": FREE}, [transition], 0.0, 1.0, (0.0, 1.0, 2.0), max_transitions=2)


# ---- compile counts -------------------------------------------------------------------------------------------------


def test_a_new_value_never_recompiles():
    traces = []

    def counted(q, v, params):
        traces.append(None)
        return 0.5 * v**2 - params["g"] * q

    def guard(q, v):
        traces.append(None)
        return q

    reset = lambda q, v, params: (q, -params["e"] * v)

    def fall(h, e, ts=jnp.linspace(0.0, 2.0, 9)):  # noqa: B008
        modes, bounce = {"flight": lagjax.System(counted)}, lagjax.Transition("flight", "flight", guard, -1, reset)
        return hybrid(modes, [bounce], h, 0.0, ts, {"e": e, "g": G})

    first = fall(1.0, 0.9)
    count = len(traces)
    np.testing.assert_array_equal(first.q, fall(1.0, 0.9).q)
    fall(1.1, 0.5, ts=np.linspace(0.1, 1.0, 9))
    assert len(traces) == count > 0
    fall(1.0, 0.9, ts=np.array([0.0, 1.0]))  # machine code serves any number of output times
    assert len(traces) == count


# ---- modes that differ by numbers -----------------------------------------------------------------------------------
#
# Stairs: the acceleration is g + n in mode n, until q = 1 + n/2; the reset halves the velocity and then adds n/10.

STAIRS = 5


def stair(n):
    return lagjax.System(lambda q, v, params: 0.5 * v**2 + (params + 1.0 * n) * q)


def edge(n, target=None):
    return lagjax.Transition(
        f"{n}",
        f"{n + 1 if target is None else target}",
        lambda q, v: q - (1.0 + 0.5 * n),
        direction=1,
        reset=lambda q, v: (q, 0.5 * v + 0.1 * n),
    )


def down_the_stairs(g, modes, v=0.2):
    """The times at the edges, in closed form."""
    t, q, times = 0.0, 0.0, []
    for n in modes:
        a, fall = g + n, 1.0 + 0.5 * n - q
        fast = jnp.sqrt(v**2 + 2 * a * fall)
        t, q, v = t + (fast - v) / a, q + fall, 0.5 * fast + 0.1 * n
        times.append(t)
    return jnp.stack(times)


def test_modes_that_differ_by_numbers():
    modes, edges = {f"{n}": stair(n) for n in range(STAIRS)}, [edge(n) for n in range(STAIRS - 1)]
    run = hybrid(modes, edges, v0=0.2, ts=(0.0, 4.0), params=1.3, rtol=1e-12)
    assert run.transitions.source[:5].tolist() == [0, 1, 2, 3, -1] and run.mode.tolist() == [0, 4]
    np.testing.assert_allclose(times(run), down_the_stairs(1.3, range(4)), rtol=1e-12)


@pytest.mark.slow
def test_derivatives_through_modes_that_differ_by_numbers():
    modes, edges = {f"{n}": stair(n) for n in range(STAIRS)}, [edge(n) for n in range(STAIRS - 1)]

    def at_edges(g):
        return hybrid(modes, edges, v0=0.2, ts=(0.0, 4.0), params=g, max_transitions=4, rtol=1e-12).transitions.t

    exact = functools.partial(down_the_stairs, modes=range(4))
    for derivative, tolerance in ((jax.jacrev, 1e-10), (jax.hessian, 1e-8)):
        found, right = (derivative(lambda g, f=f: f(g)[3])(1.3) for f in (at_edges, exact))
        np.testing.assert_allclose(found, right, rtol=tolerance)
    many = np.array([0.5, 1.3, 2.9])
    np.testing.assert_allclose(jax.vmap(at_edges)(many), jax.jit(jax.vmap(exact))(many), rtol=1e-12)


ON_A_LINE = lagjax.System(free_particle, constraints=lambda q: q - 2.5)


def test_modes_of_a_ladder_keep_their_targets_and_constraints():
    modes = {"0": stair(0), "1": stair(1), "2": stair(2), "3": stair(3)}
    edges = [edge(0, target=2), edge(2, target=3), edge(1, target=0)]
    modes |= {"line": ON_A_LINE}
    edges += [edge(3, target="line")]
    edges += [lagjax.Transition("line", "1", lambda q, v: q - 9.0)]  # never: it stands still
    run = hybrid(modes, edges, v0=0.2, ts=(0.0, 1.0, 6.0), params=1.3, rtol=1e-12, throw=False)
    np.testing.assert_allclose(times(run), down_the_stairs(1.3, (0, 2, 3)), rtol=1e-12)
    assert run.transitions.target[:3].tolist() == [2, 3, 4]
    assert run.result == lagjax.RESULTS.inconsistent_start  # it is not at rest there
    said = r"Behind the transition '3' → 'line' .* the constraints of 'line': qdot does not .* rate of change is 1.59 "
    with pytest.raises(lagjax.SimulationError, match=said + ".* reset=lambda q, v: "):
        hybrid(modes, edges, v0=0.2, ts=(0.0, 1.0, 6.0), params=1.3, rtol=1e-12)


BALL_ALONE = lagjax.System(lambda q, v: 0.5 * v**2 - 9.81 * q)


def test_a_reset_without_machine_code_is_named():
    def shorten(q, v):
        return q, jax.lax.while_loop(lambda v: jnp.abs(v) > 1.0, lambda v: 0.5 * v, -v)

    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=shorten)
    scene = lagjax.Hybrid({"flight": BALL_ALONE}, [bounce], "flight")
    with pytest.raises(ValueError, match=r"with the reset .*shorten.*while"):
        lagjax.simulate(scene, 1.0, 0.0, np.linspace(0.0, 1.0, 3))


def test_short_motions_from_a_traced_mode_on_are_one_motion_in_a_batch():
    flight, soft = (lagjax.System(lambda q, v, k=k: 0.5 * v**2 - 9.81 * q - k * q**2) for k in (0.0, 500.0))
    enter = lagjax.Transition("flight", "soft", lambda q, v: q, direction=-1)
    leave = lagjax.Transition("soft", "flight", lambda q, v: q, direction=1, reset=lambda q, v: (q, 0.9 * v))
    scene = lagjax.Hybrid({"flight": flight, "soft": soft}, [enter, leave], "flight")

    def follow_part(carry, _):
        begun = lagjax.Hybrid(scene.modes, scene.transitions, carry[2])
        run = lagjax.simulate(begun, *carry[:2], jnp.array([0.0, 0.5]), throw=False)
        return (run.q[-1], run.qdot[-1], run.mode[-1]), run.q[-1]

    def in_parts(q0):
        return jax.lax.scan(follow_part, (q0, 0.0, 0), None, length=6)[1][-1]

    def whole(q0):
        return lagjax.simulate(scene, q0, 0.0, jnp.array([0.0, 3.0]), throw=False).q[-1]

    starts = np.linspace(0.8, 1.2, 4)
    given, expected = (jax.jit(jax.vmap(jax.value_and_grad(of)))(starts) for of in (in_parts, whole))
    np.testing.assert_allclose(given, expected, rtol=1e-9)
