"""Limit cycles and Lyapunov exponents of motions with contacts and with modes, against closed forms and exact maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import FREE, particles

import lagjax

G = 9.81


RIMLESS_WHEEL = lagjax.System(lambda q, v: 0.5 * v**2 - G * jnp.cos(q))


@pytest.mark.slow
def test_the_rimless_wheel_walks_as_its_map_says():
    """Spokes of length one, 2α apart, on a slope γ: ω² → cos²2α ω² + 4 g sin α sin γ in a step."""
    alpha, slope = 0.3, 0.08
    step = lagjax.Transition(
        "roll", "roll", lambda q, v: q - (slope + alpha), 1, lambda q, v: (q - 2 * alpha, jnp.cos(2 * alpha) * v)
    )
    scene = lagjax.Hybrid({"roll": RIMLESS_WHEEL}, [step], "roll")
    orbit = lagjax.periodic_orbit(scene, 0.0, 1.0, 0.6)
    fast = 4 * G * np.sin(alpha) * np.sin(slope) / np.sin(2 * alpha) ** 2  # ω² before a step
    here = np.sqrt(fast + 2 * G * (np.cos(slope + alpha) - np.cos(orbit.q0)))
    np.testing.assert_allclose(orbit.qdot0, here, rtol=1e-13)
    # The energy lost in a step is a square of the speed, and one multiplier is that of the time shift.
    np.testing.assert_allclose(orbit.multipliers, [np.cos(2 * alpha) ** 2, 1.0], rtol=1e-12)
    assert orbit.stable and orbit.closure < 1e-14
    with pytest.raises(ValueError, match="is not conserved"):
        lagjax.periodic_orbit(scene, 0.0, 1.0, 0.6, energy=1.0)
    with pytest.raises(TypeError, match="This is for one System"):
        lagjax.family(scene, orbit)
    modes = {"a": RIMLESS_WHEEL, "b": RIMLESS_WHEEL}
    over = [lagjax.Transition(x, y, lambda q, v: q - 0.2, 1) for x, y in ("ab", "ba")]
    with pytest.raises(lagjax.SimulationError, match="ends in another mode"):
        lagjax.periodic_orbit(lagjax.Hybrid(modes, over, "a"), 0.0, 1.0, 0.3)


@pytest.mark.slow
def test_a_ball_bounces_once_in_a_period_of_its_table():
    """Table a sin ωt, period T: it bounces where the table moves at w = gT/2 (1 − e)/(1 + e), and leaves at gT/2."""
    e, omega, a, period = 0.5, 2 * np.pi, 0.1, 1.0
    ball = lagjax.System(lambda q, v: 0.5 * v**2 - q, contacts=lambda q, t: q - a * jnp.sin(omega * t), restitution=e)
    up, table = period / 2, period / 2 * (1 - e) / (1 + e)
    phase = np.arccos(table / (a * omega))
    since = period - phase / omega  # the last bounce
    q0, v0 = a * np.sin(phase) + up * since - 0.5 * since**2, up - since
    orbit = lagjax.periodic_orbit(ball, q0 + 1e-3, v0 - 2e-3, period)
    np.testing.assert_allclose([orbit.q0, orbit.qdot0], [q0, v0], atol=1e-14)
    # The map of time and velocity of a bounce, (dt, dv) → dt′ = dt + T dv / (w + v), dv′.
    later = np.array([1.0, period / (table + up)])
    bend = -a * omega**2 * np.sin(phase)
    speed = np.array([0.0, -e]) + e * (later - np.array([1.0, 0.0])) + (1 + e) * bend * later
    expected = np.linalg.eigvals(np.stack([later, speed]))
    np.testing.assert_allclose(np.sort(orbit.multipliers.real), np.sort(expected), rtol=1e-12)
    assert not orbit.stable


def billiard(q, v, end, radius, wall):
    """The end of a flight in a square box around a disc, and the product of its tangent maps, hit by hit."""
    growth, t, eye, none = np.eye(4), 0.0, np.eye(2), np.zeros((2, 2))
    while True:
        hits = [((wall - s * q[i]) / (s * v[i]), -s * eye[i]) for i in (0, 1) for s in (1, -1) if s * v[i] > 0]
        speed, toward = v @ v, q @ v
        inside = toward**2 - speed * (q @ q - radius**2)
        if toward < 0 < inside:
            hits.append(((-toward - np.sqrt(inside)) / speed, None))
        flight, normal = min(hits, key=lambda hit: hit[0])
        last = min(flight, end - t)
        q, t, growth = q + last * v, t + last, np.block([[eye, last * eye], [none, eye]]) @ growth
        if last < flight:
            return q, growth
        bend = none
        if normal is None:
            normal = q / radius
            bend = (eye - np.outer(normal, normal)) / radius
        onto = eye - np.outer(v, normal) / (v @ normal)  # dq where it hits, at the instant that varies
        mirror = eye - 2 * np.outer(normal, normal)
        after = mirror @ v
        turned = -2 * (np.outer(normal, v) + v @ normal * eye) @ bend @ onto
        at_once = onto + np.outer(after, normal) / (v @ normal)
        v, growth = after, np.block([[at_once, none], [turned, mirror]]) @ growth


@pytest.mark.slow
def test_lyapunov_exponents_of_the_sinai_billiard_are_those_of_its_tangent_maps():
    radius, wall, end = 0.5, 2.0, 24.0

    def gaps(q):
        return jnp.stack([jnp.sqrt(q @ q) - radius, *(wall - q), *(wall + q)])

    scene = particles(contacts=gaps, restitution=1.0)
    q0, v0 = np.array([1.0, 0.3]), np.array([-1.0, 0.1])  # of size one: states are in their own units
    q, growth = billiard(q0, v0, end, radius, wall)
    run = lagjax.simulate(scene, q0, v0, np.array([0.0, end]), rtol=1e-13)
    np.testing.assert_allclose(run.q[-1], q, atol=1e-14 * np.linalg.norm(growth))
    order = [0, 1, 3, 2]  # q₁ q₂ p₂ p₁
    stretch = np.abs(np.diag(np.linalg.qr(growth[np.ix_(order, order)])[1]))
    found = lagjax.lyapunov_spectrum(scene, q0, v0, end)
    # The product of all maps has lost the smallest numbers to the largest: the two largest are compared.
    np.testing.assert_allclose(found[:2], np.sort(np.log(stretch) / end)[:1:-1], rtol=1e-9)
    np.testing.assert_allclose(found, -found[::-1], atol=1e-13)


def falling_ball(kind):
    if kind == "contacts":
        return lagjax.System(lambda q, v: 0.5 * v**2 - q, contacts=lambda q: q, restitution=lambda params: params)
    turn = lagjax.Transition("f", "f", lambda q, v: q, -1, lambda q, v, params: (q, -params * v))
    return lagjax.Hybrid({"f": lagjax.System(lambda q, v: 0.5 * v**2 - q)}, [turn], "f")


def bounce_crossings(kind, h, e, count=8):
    """A dropped ball through the height 0.3, by gravity one; and its tops, after each bounce."""
    sections = {"through": lambda q, v: q - 0.3, "top": lambda q, v: v, "floor": lambda q, v: q}
    ts = jnp.array([0.0, 6.0])
    return lagjax.crossings(falling_ball(kind), sections, h, 0.0, ts, e, count=count, throw=False)


def crossings_of_a_bounce(h, e):
    speed, met = jnp.sqrt(2 * h), jnp.sqrt(2 * h)
    through, tops = [jnp.sqrt(2 * (h - 0.3))], []
    for _ in range(2):
        speed = e * speed
        tops.append(met + speed)
        through += [met + speed + sign * jnp.sqrt(speed**2 - 0.6) for sign in (-1, 1)]
        met = met + 2 * speed
    return jnp.stack(through), jnp.stack(tops)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["contacts", "hybrid"])
def test_crossings_of_a_ball_that_bounces_are_those_of_its_parabolas(kind):
    # Of the third flight only the top is within reach: it rises to 0.26.
    h, e = 1.0, 0.8
    found = bounce_crossings(kind, h, e)
    through, tops = crossings_of_a_bounce(h, e)
    np.testing.assert_allclose(found["through"].t[:5], through, rtol=1e-9)
    np.testing.assert_allclose(found["top"].t[:2], tops, rtol=1e-9)
    assert found["through"].count == 5 and found["floor"].count == 0, "a blow turns round: it is no crossing"
    np.testing.assert_allclose(found["through"].q[:5], 0.3, atol=1e-14)
    by_both = jax.jit(jax.jacrev(lambda x: bounce_crossings(kind, *x)["through"].t))(np.array([h, e]))
    exact = jax.jacfwd(lambda x: crossings_of_a_bounce(*x)[0])(np.array([h, e]))
    np.testing.assert_allclose(by_both[:5], exact, rtol=1e-7)
    assert np.isnan(by_both[5:]).all()
    little = bounce_crossings(kind, h, e, count=3)
    assert little["through"].count >= 4 and not little["through"].ok and np.isfinite(little["through"].t).all()


def test_crossings_in_every_mode_and_where_the_mode_changes():
    """A particle goes round: out to q = 1, back to q = 0, at speed one."""
    free = FREE
    back = [
        lagjax.Transition("out", "in", lambda q, v: q - 1.0, 1, lambda q, v: (q, -v)),
        lagjax.Transition("in", "out", lambda q, v: q, -1, lambda q, v: (q, -v)),
    ]
    scene = lagjax.Hybrid({"out": free, "in": free}, back, "out")
    sections = {"half": lambda q, v: q - 0.5, "rising": lambda q, v: q - 0.25, "clock": lambda q, v, t: t - 2.0}
    found = lagjax.crossings(
        scene, sections, 0.5, 1.0, np.array([0.0, 5.1]), direction={"half": 0, "rising": 1, "clock": 1}
    )
    np.testing.assert_allclose(found["half"].t[:6], [1.0, 2.0, 3.0, 4.0, 5.0, np.nan], atol=1e-13)
    np.testing.assert_allclose(found["rising"].t[:3], [1.75, 3.75, np.nan], atol=1e-13)
    np.testing.assert_allclose(found["clock"].t[:2], [2.0, np.nan], atol=1e-13)


SLIDING_BLOCK = lagjax.System(
    lambda q, v: 0.5 * v @ v - q[1], contacts=lambda q: {"floor": q[1]}, slip=lambda q, v: {"floor": v[0]},
    friction=lambda params: {"floor": params},
)  # fmt: skip


@pytest.mark.slow
def test_crossings_of_a_block_that_slides_and_stops():
    """On the floor, with friction μ and gravity one: x = v t − ½ μ t² to the stop at v²/2μ, where it stays."""
    sections = {"near": lambda q, v: q[0] - 1.0, "stop": lambda q, v: v[0] - 1e-3, "beyond": lambda q, v: q[0] - 4.01}

    def found(v, mu):
        start = jnp.zeros(2), jnp.stack([v, 0.0])
        return lagjax.crossings(SLIDING_BLOCK, sections, *start, jnp.array([0.0, 9.0]), mu, count=3)

    v, mu = 2.0, 0.5
    crossed = found(v, mu)
    root = np.sqrt(v**2 - 2 * mu)
    np.testing.assert_allclose(crossed["near"].t, [(v - root) / mu, np.nan, np.nan], rtol=1e-12)
    np.testing.assert_allclose(crossed["stop"].t[0], (v - 1e-3) / mu, rtol=1e-12)
    assert crossed["beyond"].count == 0 and crossed["stop"].count == 1
    slope = jax.jacrev(lambda v: found(v, mu)["near"].t[0])(v)
    np.testing.assert_allclose(slope, (1 - v / root) / mu, rtol=1e-11)
    with pytest.raises(lagjax.SimulationError, match="more crossings"):
        lagjax.crossings(falling_ball("contacts"), lambda q, v: q - 0.3, 1.0, 0.0, np.array([0.0, 6.0]), 0.8, count=4)
