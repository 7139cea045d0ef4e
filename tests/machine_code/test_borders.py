"""Borders and narrow features: nothing is stepped over.

Every scene is a particle of unit mass on a line, so that what it does is known in closed form, or from SciPy's DOP853
at 1e-12 that is begun anew at every border.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particle
from scenes import in_potential
from scipy.integrate import solve_ivp
from sweeps import sweep

import lagjax


def particle(potential=None, force=None):
    """The scene of a unit mass with V(q) and a generalized force of (q, q̇, t, params)."""
    V = potential or (lambda q, params: 0.0 * q)
    return lagjax.System(lambda q, v, params: 0.5 * v * v - V(q, params), forces=force)


def end(scene, q0, v0, T, params=None, rtol=1e-9, **options):
    """The end state, and the trajectory."""
    run = lagjax.simulate(scene, q0, v0, np.array([0.0, T]), params, rtol=rtol, throw=False, **options)
    return np.array([float(run.end.q), float(run.end.qdot)]), run


@functools.cache
def reference(name, T):
    """DOP853 at 1e-13, in steps that see everything."""
    _, y0, acceleration, longest = (FEATURES | ABRUPT)[name]

    def rate(t, y):
        return [y[1], acceleration(*y, t)]

    return solve_ivp(rate, (0, T), y0, method="DOP853", rtol=1e-13, atol=1e-14, max_step=longest).y[:, -1]


def corner(t, a=1.0):
    """(q, v) in V = |q| from rest at a: parabolas of the time 2√(2a) between the crossings."""
    quarter = np.sqrt(2 * a)
    t = t + quarter
    half, s = int(t // (2 * quarter)), t % (2 * quarter)
    return (-1) ** half * np.array([quarter * s - s**2 / 2, quarter - s])


TOLERANCES = (1e-4, 1e-7, 1e-10, 1e-13)


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_a_corner(rtol):
    y, run = end(particle(lambda q, params: abs(q)), 1.0, 0.0, 50.0, rtol=rtol)
    np.testing.assert_allclose(y, corner(50.0), atol=1e-13)  # the pieces are parabolas
    assert run.stats["num_rejected_steps"] == 0 and run.stats["num_steps"] < 80


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_a_pulse_of_the_force(rtol):
    scene = particle(lambda q, params: 0.5 * q * q, lambda q, v, t: jnp.where(abs(t - 5.0) < 0.1, 10.0, 0.0))
    y, _ = end(scene, 1.0, 0.0, 10.0, rtol=rtol)
    # 10 ∫ (sin, cos)(10 − s) ds
    kick = 10 * np.array([np.cos(10 - 5.1) - np.cos(10 - 4.9), np.sin(10 - 4.9) - np.sin(10 - 5.1)])
    np.testing.assert_allclose(y, [np.cos(10) + kick[0], -np.sin(10) + kick[1]], atol=100 * rtol + 1e-13)


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_a_narrow_wall_reflects(rtol):
    # V is 0 or a slope up to 1 within 0.1 about q = 5, then 0 again: the energy 0.5 does not suffice.
    scene = particle(force=lambda q, v: jnp.where(abs(q - 5.0) < 0.1, -5.0, 0.0))
    y, run = end(scene, 0.0, 1.0, 10.0, rtol=rtol)
    # 4.9 in, 0.4 to stop and come back (1/5 s each way), then free.
    np.testing.assert_allclose(y, [4.9 - (10.0 - 4.9 - 0.4), -1.0], atol=1e-12)
    assert run.stats["num_steps"] < 30


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_pulses_in_a_row(rtol):
    # A force of duty 0.02 and period 0.1: over every period it adds 0.02 · 0.1 · 50 to the velocity.
    scene = particle(force=lambda q, v, t: jnp.where(t / 0.1 - jnp.floor(t / 0.1) < 0.02, 50.0, 0.0))
    y, run = end(scene, 0.0, 0.0, 10.0, rtol=rtol)
    n = np.arange(100)
    kick, begin = 50 * 0.002, 0.1 * n
    q = np.sum(kick * (10.0 - begin - 0.001))
    np.testing.assert_allclose(y, [q, 100 * kick], atol=1e-10)
    assert run.stats["num_rejected_steps"] == 0 and run.stats["num_steps"] < 320


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_ridges_of_a_sawtooth(rtol):
    # V rises by slope 1 over 0.05 and falls by slope 1 over the next: a ridge every 0.1, on which energy is kept.
    def V(q, params):
        return abs(jnp.mod(q, 0.1) - 0.05)

    y, _ = end(particle(V), 0.02, 1.0, 3.0, rtol=rtol)
    # In closed form: through each half ridge v goes between two values; times add up.
    E = 0.5 + abs(0.02 - 0.05)
    half = np.sqrt(2 * E) - np.sqrt(2 * (E - 0.05))  # the time over 0.05 at |a| = 1
    first = np.sqrt(2 * E) - 1.0  # to the bottom at 0.05
    left = 3.0 - first
    count = int(left // half)
    s = left - count * half
    slow, fast = np.sqrt(2 * (E - 0.05)), np.sqrt(2 * E)
    v0, a = (fast, -1.0) if count % 2 == 0 else (slow, 1.0)
    q = 0.05 + 0.05 * count + v0 * s + a * s * s / 2
    np.testing.assert_allclose(y, [q, v0 + a * s], atol=1e-10)


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_a_one_sided_spring(rtol):
    k = 400.0
    scene = particle(lambda q, params: 9.81 * q + 0.5 * params * jnp.where(q < 0, q * q, 0.0))
    y, _ = end(scene, 1.0, 0.0, 5.0, k, rtol=rtol)
    fall, w = np.sqrt(2 / 9.81), np.sqrt(k)
    v, g = 9.81 * fall, 9.81
    contact = 2 * (np.pi / 2 + np.arctan(g / (v * w))) / w
    s = (5.0 + fall) % (2 * fall + contact) - fall  # from the top, before or behind
    u = s - fall
    in_contact = [
        -v / w * np.sin(w * u) + (np.cos(w * u) - 1) * g / w**2, -v * np.cos(w * u) - g / w * np.sin(w * u)
    ]  # fmt: skip
    np.testing.assert_allclose(y, [1.0 - g * s * s / 2, -g * s] if s < fall else in_contact, atol=300 * rtol + 1e-11)


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_a_border_by_a_function_of_time_amid_steps_without_end(rtol):
    # Between two borders the motion is a parabola, whose series ends: only that of sin(20 t) bounds the step.
    scene = particle(force=lambda q, v, t: jnp.where(jnp.sin(20 * t) > 0, 1.0, -1.0))
    y, _ = end(scene, 0.0, 1.0, np.pi, rtol=rtol)
    # Ten whole periods π/10, in each of which v rises by π/20 and falls again, and q gains (π/20)² more.
    np.testing.assert_allclose(y, [np.pi + 10 * (np.pi / 20) ** 2, 1.0], atol=30 * rtol + 1e-12)


# ---- narrow features -------------------------------------------------------------------------------------------------

FEATURES = {  # the scene, its start, the acceleration in NumPy, and a step that sees everything
    "a barrier": (
        particle(lambda q, params: jnp.exp(-(((q - 5) / 0.1) ** 2) / 2)), (0.0, 1.0),
        lambda q, v, t: 100 * (q - 5) * np.exp(-(((q - 5) / 0.1) ** 2) / 2), 0.05,
    ),
    "a rotor with detents": (
        particle(lambda q, params: jnp.exp(100 * (jnp.cos(q) - 1))), (2.0, 1.5),
        lambda q, v, t: 100 * np.sin(q) * np.exp(100 * (np.cos(q) - 1)), 0.05,
    ),
    "a pulse in time": (
        particle(lambda q, params: 0.5 * q * q, lambda q, v, t: 10 * jnp.exp(-(((t - 5) / 0.01) ** 2))), (1.0, 0.0),
        lambda q, v, t: -q + 10 * np.exp(-(((t - 5) / 0.01) ** 2)), 0.005,
    ),
    "a step of tanh": (
        particle(lambda q, params: 0.6 * jnp.tanh((q - 5) / 0.03)), (0.0, 1.0),
        lambda q, v, t: -20 / np.cosh(min(abs(q - 5) / 0.03, 300)) ** 2, 0.01,
    ),
    "a ridge of sech": (
        particle(lambda q, params: 1 / jnp.cosh((q - 5) / 0.03)), (0.0, 1.0),
        lambda q, v, t: np.sinh(np.clip((q - 5) / 0.03, -99, 99)) / np.cosh(np.clip((q - 5) / 0.03, -99, 99)) ** 2
        / 0.03, 0.01,
    ),
    "pulses of a power": (
        particle(lambda q, params: 0.5 * q * q, lambda q, v, t: jnp.cos(t) ** 1000), (1.0, 0.0),
        lambda q, v, t: -q + np.cos(t) ** 1000, 0.02,
    ),
    "a constant to a power": (
        particle(lambda q, params: 0.6 * 2.0 ** -(((q - 5) / 0.03) ** 2)), (0.0, 1.0),
        lambda q, v, t: 0.6 * np.log(2) * 2 * (q - 5) / 0.03**2 * 2.0 ** -(((q - 5) / 0.03) ** 2), 0.01,
    ),
    "an edge of a root": (
        particle(lambda q, params: 0.2 * (q - 5) / jnp.sqrt((q - 5) ** 2 + 1e-4)), (0.0, 1.0),
        lambda q, v, t: -2e-5 * ((q - 5) ** 2 + 1e-4) ** -1.5, 0.005,
    ),
    "an exponent that moves": (
        particle(force=lambda q, v, t: 50 * (0.5 + 0.4 * jnp.sin(t)) ** (9 + 1e3 * (q - 5) ** 2)), (0.0, 1.0),
        lambda q, v, t: 50 * (0.5 + 0.4 * np.sin(t)) ** (9 + 1e3 * (q - 5) ** 2), 0.01,
    ),
}  # fmt: skip


ABRUPT = {  # where a root begins at a border: there is no series beyond it
    "a bump of a contact force": (
        particle(force=lambda q, v: -500 * jnp.maximum(0.1 - abs(q - 5), 0.0) ** 1.5), (0.0, 1.0),
        lambda q, v, t: -500 * max(0.1 - abs(q - 5), 0) ** 1.5, 0.01,
    ),
    "a wall": (
        particle(force=lambda q, v: -1e4 * jnp.maximum(q - 5, 0.0) ** 1.5), (0.0, 1.0),
        lambda q, v, t: -1e4 * max(q - 5, 0) ** 1.5, 0.01,
    ),
    "an arc in time": (
        particle(lambda q, params: 0.5 * q * q, lambda q, v, t: 20 * jnp.sqrt(jnp.maximum(0.01 - (t - 5) ** 2, 0.0))),
        (0.0, 1.0), lambda q, v, t: -q + 20 * np.sqrt(max(0.01 - (t - 5) ** 2, 0)), 0.01,
    ),
}  # fmt: skip
ATOM = lagjax.System(lambda q, v: 0.5 * v @ v - 4 * ((q @ q) ** -6 - (q @ q) ** -3))


@pytest.mark.parametrize("rtol", TOLERANCES)
@pytest.mark.parametrize("name", ABRUPT)
def test_a_force_that_begins_like_a_root(name, rtol):
    scene, y0, *_ = ABRUPT[name]
    y, run = end(scene, *y0, 10.0, rtol=rtol)
    np.testing.assert_allclose(y, reference(name, 10.0), atol=100 * rtol + 3e-9)
    assert run.stats["num_steps"] < 150


@pytest.mark.parametrize("rtol", TOLERANCES)
@pytest.mark.parametrize("name", FEATURES)
def test_a_narrow_feature(name, rtol):
    scene, y0, *_ = FEATURES[name]
    y, run = end(scene, *y0, 10.0, rtol=rtol)
    np.testing.assert_allclose(y, reference(name, 10.0), atol=300 * rtol + 1e-11)
    assert run.stats["num_steps"] < 150


@pytest.mark.parametrize("width", [1e-2, 1e-7])
def test_what_powers_make_narrow_is_seen_by_guards_and_derivatives(width):
    free = particle()

    def lorentzian(q, v, params):
        return 1 / (1 + ((q - 3.3) / params) ** 2) ** 2 - 0.25  # where (q − 3.3)² = params²

    found = lagjax.crossings(free, lorentzian, 0.0, 1.0, (0.0, 10.0), width, count=3)
    np.testing.assert_allclose(found.t, [3.3 - width, 3.3 + width, np.nan], atol=1e-4 * width + 1e-14)

    pulse = particle(force=lambda q, v, t, params: 2.0 ** -(((t - 3.3) / params) ** 2) / width)
    derivative = jax.grad(lambda w: last_q(pulse, 0.0, 0.0, 10.0, w))(width)
    np.testing.assert_allclose(derivative, 6.7 * np.sqrt(np.pi / np.log(2)) / width, rtol=1e-6)


def test_an_atom_is_hit_from_any_distance():
    def rate(t, y):
        return [*y[2:], *(48 * (y[:2] @ y[:2]) ** -7 - 24 * (y[:2] @ y[:2]) ** -4) * y[:2]]

    for distance in (1e2, 1e4, 1e6):
        run = lagjax.simulate(ATOM, np.array([-distance, 0.7]), np.array([2.0, 0.0]), np.array([0.0, distance]))
        # A hundred diameters away the force is 24e-14.
        exact = solve_ivp(rate, (0, 100), [-100, 0.7, 2.0, 0.0], "DOP853", rtol=1e-12, atol=1e-12, max_step=0.5)
        np.testing.assert_allclose(run.qdot[-1], exact.y[2:, -1], atol=1e-8)


def test_which_powers_are_watched():
    """What every motion sees from afar, or cannot change by much, costs nothing."""
    three = (np.arange(9.0) ** 1.5).reshape(3, 3)
    pairs = np.array([0, 0, 1]), np.array([1, 2, 2])

    def count(potential, q):
        return len(in_potential(potential).explain(q, q).narrow)

    def of_pairs(power, softening):
        return lambda q: jnp.sum((jnp.sum((q[pairs[0]] - q[pairs[1]]) ** 2, axis=1) + softening) ** power)

    for softening in (0.0, 0.1):
        assert count(of_pairs(-0.5, softening), three) == 0
        assert count(of_pairs(-3, softening), three) == 3

    def of_two(q):
        return -0.9 / jnp.sqrt((q[0] + 0.1) ** 2 + q[1] ** 2) - 0.1 / jnp.sqrt((q[0] - 0.9) ** 2 + q[1] ** 2)

    assert count(of_two, np.ones(2)) == 0
    assert count(lambda q: jnp.cos(q) / (2 - jnp.cos(q) ** 2), 1.0) == 0
    assert count(lambda q: jnp.cos(q) / (1 + 1e-4 - jnp.cos(q) ** 2), 1.0) == 1
    assert count(lambda q: q**4 + q**6, 1.0) == 0


# ---- derivatives -----------------------------------------------------------------------------------------------------


def last_q(scene, q0, v0, T, params=None):
    return lagjax.simulate(scene, q0, v0, np.array([0.0, T]), params).q[-1]


REGION = particle(force=lambda q, v: jnp.where(q > 1.0, -0.3, 0.0))
SWITCHED = particle(force=lambda q, v, t, params: jnp.where(t > params, 1.0, 0.0))
CORNER = particle(lambda q, params: abs(q))
SPRING = particle(lambda q, params: 9.81 * q + 0.5 * params * jnp.where(q < 0, q * q, 0.0))
SATURATED = particle(force=lambda q, v, params: -params * jnp.clip(q, -0.5, 0.5))
MOVING = particle(force=lambda q, v, t, params: jnp.where(q > params * t, -1.0, 0.2))
STAIRS = particle(force=lambda q, v, params: -jnp.floor(q / params))
FRICTION = particle(lambda q, params: 0.5 * q * q, lambda q, v, params: -params * jnp.sign(v))
# In closed form, or None: by differences, exact to 1e-8 for what is a polynomial in pieces and 1e-6 else.
DERIVATIVES = {
    "a region is entered": (lambda x: last_q(REGION, x, 1.0, 3.0), 0.0, 0.4),  # 1 − 0.3 · (3 − 1)
    "a force is switched on": (lambda x: last_q(SWITCHED, 0.0, 1.0, 3.0, x), 1.7, -1.3),
    "a corner, by where it starts": (lambda x: last_q(CORNER, x, 0.0, 7.3), 1.0, None),
    "a one-sided spring, by its stiffness": (lambda x: last_q(SPRING, 1.0, 0.0, 5.0, x), 400.0, None),
    "a saturated spring": (lambda x: last_q(SATURATED, 1.0, 0.0, 5.0, x), 3.0, None),
    "a border that moves": (lambda x: last_q(MOVING, 0.0, 1.0, 3.0, x), 0.7, 5.76),
    "stairs by their width": (lambda x: last_q(STAIRS, 0.05, 1.0, 3.0, x), 0.31, None),
    "friction": (lambda x: last_q(FRICTION, 5.0, 0.0, 10.0, x), 0.31, None),
}


def difference(f, x, h):
    h = h * abs(x)
    return (8 * (f(x + h) - f(x - h)) - (f(x + 2 * h) - f(x - 2 * h))) / (12 * h)


# A jump, a corner, a border of the parameters and one of the velocity; the rest are more of these kinds.
SHOWN = ("a region is entered", "a border that moves", "friction")


@pytest.mark.parametrize("name", sweep(DERIVATIVES, kept=SHOWN))
def test_first_derivatives_through_borders(name):
    f, x, exact = DERIVATIVES[name]
    exact = difference(f, x, 1e-4) if exact is None else exact
    both = jax.jit(lambda x: (jax.jvp(f, (x,), (1.0,))[1], jax.grad(f)(x)))(x)
    np.testing.assert_allclose(both, exact, rtol=2e-7)
    both = jax.jit(jax.vmap(jax.grad(f)))(np.array([x, x]))
    np.testing.assert_allclose(both, exact, rtol=2e-7)


@pytest.mark.parametrize(
    "name", sweep(["a one-sided spring, by its stiffness", "a saturated spring"], kept=["a saturated spring"])
)
def test_second_derivatives_where_the_force_is_continuous(name):
    f, x, _ = DERIVATIVES[name]
    exact = difference(jax.grad(f), x, 1e-4)
    for second in (jax.jacfwd(jax.jacfwd(f)), jax.jacfwd(jax.grad(f)), jax.grad(jax.grad(f))):
        np.testing.assert_allclose(jax.jit(second)(x), exact, rtol=1e-6)


# ---- sliding and sticking --------------------------------------------------------------------------------------------

BLOCK = particle(lambda q, params: 0.5 * q * q, lambda q, v, params: -params * jnp.sign(v))
CARTESIAN = lagjax.System(
    lambda q, v: 0.5 * v @ v - 9.81 * q[1], constraints=lambda q: {"rod": q @ q - 1.0},
    forces=lambda q, v: -0.5 * jnp.sign(v[0]) * jnp.array([1.0, 0.0]),
)  # fmt: skip
ANGLE = lagjax.System(lambda a, w: 0.5 * w * w + 9.81 * jnp.cos(a), forces=lambda a, w: -0.5 * jnp.sign(w) * jnp.cos(a))
HERTZ = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.maximum(q[0] - q[1], 0.0) ** 2.5)


def two_blocks():
    """Two blocks with dry friction in a row of springs."""
    return lagjax.System(
        lambda q, v: 0.5 * jnp.sum(v * v) - 0.5 * (q[1] - q[0] - 1) ** 2 - 0.5 * q[0] ** 2,
        forces=lambda q, v, params: -params * jnp.sign(v),
    )


@pytest.mark.parametrize("rtol", TOLERANCES)
def test_friction_that_sticks(rtol):
    # Half a swing takes π and 2μ of the amplitude: 2, −1.4, 0.8, −0.2, and there the spring is too weak.
    y, run = end(BLOCK, 2.0, 0.0, 1000.0, 0.3, rtol=rtol)
    np.testing.assert_allclose(y, [-0.2, 0.0], atol=30 * rtol + 1e-13)
    assert bool(run.ok) and run.stats["num_steps"] < 60


def test_friction_is_overcome():
    # At rest until sin(t)/2 > 0.3.
    scene = particle(force=lambda q, v, t: 0.5 * jnp.sin(t) - 0.3 * jnp.sign(v))
    run = lagjax.simulate(scene, 0.0, 0.0, np.array([0.0, 0.6, 1.0, 10.0]))
    begin = np.arcsin(0.6)
    np.testing.assert_allclose(run.qdot[1:3], [0.0, 0.5 * (0.8 - np.cos(1.0)) - 0.3 * (1 - begin)], atol=1e-9)


def test_a_relay_slides():
    # From (1, 0) with force −1 to q + v = 0 at t = √3 − 1; along it q falls like e⁻ᵗ.
    scene = particle(force=lambda q, v: -jnp.sign(q + v))
    y, run = end(scene, 1.0, 0.0, 10.0)
    q = (np.sqrt(3) - 1) * np.exp(-(10.0 - np.sqrt(3) + 1))
    np.testing.assert_allclose(y, [q, -q], atol=1e-9)
    assert run.stats["num_steps"] < 30


def test_a_block_that_starts_at_rest_stays_or_goes():
    for pull, a in ((0.2, 0.0), (0.5, 0.2), (-0.5, -0.2)):
        scene = particle(force=lambda q, v, params: params - 0.3 * jnp.sign(v))
        np.testing.assert_allclose(end(scene, 0.0, 0.0, 3.0, pull)[0], [a * 4.5, a * 3.0], atol=1e-10)


def test_derivatives_of_a_motion_that_sticks():
    def q(q0, mu):
        return last_q(BLOCK, q0, 0.0, 20.0, mu)

    for derivative in (jax.grad, jax.jacfwd):  # the end is −(q0 − 6 μ)
        np.testing.assert_allclose(jax.jit(derivative(q, (0, 1)))(2.0, 0.3), [-1.0, 6.0], rtol=1e-8)
    mu, slope = 0.31, jax.jit(jax.grad(q, 1))
    for _ in range(3):  # Newton's method for the friction with which it stops at −0.1
        mu -= (q(2.0, mu) + 0.1) / slope(2.0, mu)
    np.testing.assert_allclose(mu, 1.9 / 6, atol=1e-9)


def test_two_pieces_slide_in_both_forms(monkeypatch):
    ts, start = np.array([0.0, 40.0]), (np.array([1.0, 3.0]), np.zeros(2))
    by_line = lagjax.simulate(two_blocks(), *start, ts, np.array([0.2, 0.1]))
    monkeypatch.setattr(lagjax._native.series._taylor, "LARGEST_LINE", -1)
    scene = two_blocks()

    def at_end(mu):
        return lagjax.simulate(scene, *start, ts, mu).q[-1]

    mu = np.array([0.2, 0.1])
    np.testing.assert_allclose(at_end(mu), by_line.q[-1], atol=1e-12)
    assert abs(by_line.qdot[-1]).max() < 1e-12 and by_line.stats["num_steps"] < 60
    by_mu = jax.jit(jax.jacrev(at_end))(mu)
    np.testing.assert_allclose(by_mu, jax.jit(jax.jacfwd(at_end))(mu), rtol=1e-9)
    h = 1e-6
    differences = np.stack([(at_end(mu + h * e) - at_end(mu - h * e)) / (2 * h) for e in np.eye(2)], 1)
    np.testing.assert_allclose(by_mu, differences, rtol=1e-6)


def test_borders_and_features_in_tables(monkeypatch):
    scenes = {
        "kinks": lambda: particle(lambda q, params: abs(q) + jnp.exp(-(((q - 0.5) / 0.02) ** 2)) * params),
        "stairs": lambda: particle(
            lambda q, params: 0.5 * q * q, lambda q, v, t, params: params * jnp.floor(3 * q + t)
        ),
    }
    for of in scenes.values():
        with monkeypatch.context() as patch:
            by_line = end(of(), 1.0, 0.1, 10.0, 0.1)[0]
            patch.setattr(lagjax._native.series._taylor, "LARGEST_LINE", -1)
            np.testing.assert_allclose(end(of(), 1.0, 0.1, 10.0, 0.1)[0], by_line, atol=1e-10)


def test_every_member_of_a_batch_has_its_own_borders():
    q0 = np.linspace(0.5, 3.0, 37)
    run = lagjax.simulate_batch(BLOCK, q0, np.zeros(37), np.array([0.0, 7.0, 50.0]), 0.3, batch_axes=(0, 0, None))
    alone = np.stack([lagjax.simulate(BLOCK, x, 0.0, np.array([0.0, 7.0, 50.0]), 0.3).q for x in q0[::6]])
    np.testing.assert_allclose(run.q[::6], alone, atol=1e-12)


def test_back_in_time_through_borders():
    forth = lagjax.simulate(SWITCHED, 0.0, 1.0, np.array([0.0, 3.0]), 1.7)
    back = lagjax.simulate(SWITCHED, forth.q[-1], forth.qdot[-1], np.array([3.0, 0.0]), 1.7)
    np.testing.assert_allclose([back.q[-1], back.qdot[-1]], [0.0, 1.0], atol=1e-12)


def test_friction_on_a_constrained_motion():
    # A pendulum in Cartesian coordinates, with dry friction in x; and by its angle.
    ts = np.array([0.0, 5.0, 30.0])
    one = lagjax.simulate(CARTESIAN, np.array([0.6, -0.8]), np.zeros(2), ts)
    other = lagjax.simulate(ANGLE, np.arcsin(0.6), 0.0, ts)
    np.testing.assert_allclose(one.q[:, 0], np.sin(other.q), atol=1e-7)
    assert abs(one.qdot[-1]).max() < 1e-12 and one.stats["num_steps"] < 150


def test_pulses_over_a_hundred_thousand_periods():
    # v' = u − v with u = 1 over the first fifth of every period 0.01: v is what it was a period before.
    scene = particle(force=lambda q, v, t: jnp.where(jnp.mod(t, 0.01) < 0.002, 1.0, 0.0) - v)
    run = lagjax.simulate(scene, 0.0, 0.0, np.array([0.0, 200.0, 1000.0]), max_steps=400_000)
    v = (1 - np.exp(-0.002)) * np.exp(-0.008) / (1 - np.exp(-0.01))
    np.testing.assert_allclose(run.qdot[1:], v, atol=1e-10)
    assert run.stats["num_rejected_steps"] == 0


# ---- borders at one instant ------------------------------------------------------------------------------------------

AT_ONE_INSTANT = {
    "a sawtooth of both signs": lambda q, qdot: -jnp.sin(jnp.mod(q, 2.0)),
    "a sawtooth backward": lambda q, qdot: 2 * jnp.mod(q, -0.7),
    "stairs on a sawtooth": lambda q, qdot: -jnp.floor(jnp.mod(4 * q, 3.0)) - 0.1,
    "stiff contact by Hertz": lambda q, qdot: 40.0 * jnp.maximum(-q, 0.0) ** 1.5 - 1.0,
}


@pytest.mark.parametrize("name", sweep(AT_ONE_INSTANT, kept=("a sawtooth of both signs", "stairs on a sawtooth")))
def test_derivatives_where_several_borders_lie_at_one_instant(name):
    scene = lagjax.System(free_particle, forces=AT_ONE_INSTANT[name])

    def last(q0):
        return lagjax.simulate(scene, q0, -0.4, jnp.array([0.0, 3.0]), rtol=1e-11).q[-1]

    h = 1e-5
    difference = float(last(0.8 + h) - last(0.8 - h)) / (2 * h)
    for slope in (jax.grad(last)(0.8), jax.jvp(last, (0.8,), (1.0,))[1]):
        assert float(slope) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize(("rtol", "unit"), [(1e-6, 1.0), (1e-9, 1.0), (1e-8, 1e-6)])
def test_a_cradle_of_hertzian_contacts_that_touch_is_struck(rtol, unit):
    """Behind the blow all overlaps leave zero at one instant, each far less than the one before: 1e-9, 1e-21, 1e-44.

    In any unit of length: where steps are short next to a corner, velocities are told as well as elsewhere.
    """
    count, mass, spring = 8, 0.1, 3.27

    def lagrangian(q, v, params):
        potential = 0.5 * spring * jnp.sum(q * q) + 0.4 * params * jnp.sum(jnp.maximum(q[:-1] - q[1:], 0.0) ** 2.5)
        return 0.5 * mass * jnp.sum(v * v) - potential

    def rate(t, y):
        q, v = np.split(y, 2)
        push = 1e9 * np.maximum(q[:-1] - q[1:], 0.0) ** 1.5
        return np.concatenate([v, (np.append(0.0, push) - np.append(push, 0.0) - spring * q) / mass])

    omega, after = np.sqrt(spring / mass), 1e-3
    first, rest = np.eye(count)[0], np.zeros(count)
    start = np.append(rest, 0.05 * omega * first)  # a quarter of a swing later
    v = solve_ivp(rate, (0, after), start, method="DOP853", rtol=1e-12, atol=1e-15).y[count:, -1]
    scene, times = lagjax.System(lagrangian), np.array([0.0, 0.5 * np.pi / omega + after])
    run = lagjax.simulate(scene, -0.05 * unit * first, rest, times, 1e9 / np.sqrt(unit), rtol=rtol)
    np.testing.assert_allclose(run.qdot[-1] / unit, v, atol=100 * rtol)


@pytest.mark.parametrize(
    ("count", "gap", "power"),
    sweep(
        [(2, 0.0, 1.5), (3, 0.0, 1.5), (3, 1e-6, 1.5), (3, 0.0, 1.0), (3, 0.0, 2.0)],
        kept=[(3, 0.0, 1.0)],
    ),
)
def test_derivatives_of_a_cradle_that_is_struck(count, gap, power):
    """They rise to thousands while balls touch, and fall to one: steps past a corner are those of the tangents.

    Balls at rest that touch stand at a corner; by the speed of the one that comes there is a derivative all the same.
    """
    mass, stiffness, first = 0.1, 1e6 if power == 1 else 1e9, np.eye(count)[0]

    def potential(q):
        return stiffness / (power + 1) * jnp.sum(jnp.maximum(q[:-1] - q[1:] - gap, 0.0) ** (power + 1))

    def rate(t, y):
        q, v = y.reshape(2, count)
        push = stiffness * np.maximum(q[:-1] - q[1:] - gap, 0.0) ** power
        return np.concatenate([v, (np.append(0.0, push) - np.append(push, 0.0)) / mass])

    speed, way, after = 0.1, 0.05, 2.5e-3
    touch = (way + gap) / speed

    def last_by_scipy(v):
        start = np.concatenate([gap * first, v * first])  # at the end of a free flight
        ends = 0.0, touch + after - (way + gap) / v
        return solve_ivp(rate, ends, start, method="DOP853", rtol=1e-13, atol=1e-16).y[count:, -1]

    # By differences: whether balls that fly side by side touch is rounding, and their variation grows where they do.
    by_speed = (last_by_scipy(speed + 1e-7) - last_by_scipy(speed - 1e-7)) / 2e-7
    scene = lagjax.System(lambda q, v: 0.5 * mass * v @ v - potential(q))

    def last(v):
        return lagjax.simulate(scene, -way * first, v * first, np.array([0.0, touch + after]), rtol=1e-10).qdot[-1]

    for of in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(of(last))(speed), by_speed, rtol=1e-6, atol=1e-5)


def test_balls_at_rest_that_touch_have_derivatives_by_where_they_are():
    """By Hertz's law, whose slope is zero there."""
    for of in (jax.jacfwd, jax.jacrev):
        found = jax.jit(of(lambda q: lagjax.simulate(HERTZ, q, np.zeros(2), np.array([0.0, 1.0])).q[-1]))(np.zeros(2))
        np.testing.assert_array_equal(found, np.eye(2))
