"""Where L jumps: momentum and energy decide on the velocities behind a border, in values and derivatives."""

import functools
import itertools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sweeps import sweep

import lagjax

TIGHT: Any = dict(rtol=1e-9, atol=1e-10)


def kinetic(v):
    return 0.5 * jnp.sum(v**2)


def end(scene, q, v, duration=3.0, params=None):
    found = lagjax.simulate(scene, q, v, jnp.array([0.0, duration]), params)
    return found.q[-1], found.qdot[-1]


# ---- at known instants -----------------------------------------------------------------------------------------------

KNOTS = np.linspace(0.0, 2.0, 9)
PLACES = 0.1 * np.sin(5 * KNOTS)


def pendulum_on(pivot):
    """A pendulum on a pivot that moves across: its equation is that of a fixed one but for the pivot's acceleration."""

    def lagrangian(q, v, t, params):
        def place(q, t):
            return jnp.stack([jnp.sin(q) + pivot(params)(t), -jnp.cos(q)])

        _, speed = jax.jvp(place, (q, t), (v, jnp.ones_like(t)))
        return 0.5 * speed @ speed - 9.81 * place(q, t)[1]

    return lagjax.System(lagrangian)


def pendulum_by_hand(q, v, begin, ts, knots, places):
    """The same from knot to knot, where the pivot's speed jumps by Δ and q̇ by −Δ cos q; at a knot that behind it."""
    speeds, t, y, states = np.diff(places) / np.diff(knots), begin, [q, v], []
    for later in ts:
        for k in [k for k in range(1, len(knots) - 1) if t < knots[k] <= later]:
            y = _swing(t, knots[k], y)
            t, y[1] = knots[k], y[1] - (speeds[k] - speeds[k - 1]) * np.cos(y[0])
        y = _swing(t, later, y)
        t = later
        states.append(list(y))
    return np.array(states)


def _swing(t, later, y):
    if later <= t:
        return list(y)
    done = solve_ivp(lambda t, y: [y[1], -9.81 * np.sin(y[0])], (t, later), y, method="DOP853", rtol=1e-12, atol=1e-14)
    return list(done.y[:, -1])


MEASURED = pendulum_on(lambda params: lagjax.samples(*params, hold="linear"))


def test_measured_pivot():
    ts = np.array([0.03, 0.4, 0.75, 1.0, 1.95])
    found = lagjax.simulate(MEASURED, 0.3, 0.0, np.array(ts), (KNOTS, PLACES))
    right = pendulum_by_hand(0.3, 0.0, ts[0], ts[1:], KNOTS, PLACES)
    np.testing.assert_allclose(np.c_[found.q, found.qdot][1:], right, **TIGHT)
    once_more = pendulum_on(lambda params: lambda t: jnp.interp(t, KNOTS, PLACES))
    found = lagjax.simulate(once_more, 0.3, 0.0, np.array(ts))
    np.testing.assert_allclose(np.c_[found.q, found.qdot][1:], right, **TIGHT)


def test_windows_end_at_knots():
    """A motion in pieces that end where the velocity jumps is that in one, forward and back."""
    ts = [0.1, 0.25, 0.6, 1.0]
    state = 0.3, -0.2
    for window in itertools.pairwise(ts):
        found = lagjax.simulate(MEASURED, *state, np.array(window), (KNOTS, PLACES))
        state = found.q[-1], found.qdot[-1]
    np.testing.assert_allclose(state, pendulum_by_hand(0.3, -0.2, 0.1, [1.0], KNOTS, PLACES)[-1], **TIGHT)
    for window in itertools.pairwise(ts[::-1]):
        found = lagjax.simulate(MEASURED, *state, np.array(window), (KNOTS, PLACES))
        state = found.q[-1], found.qdot[-1]
    np.testing.assert_allclose(state, (0.3, -0.2), **TIGHT)


def test_derivatives_at_knots():
    """By the start, every sample and every knot; of an output at a knot, too."""
    ts = np.array([0.03, 0.5, 1.1])

    def loss(q, v, knots, places):
        found = lagjax.simulate(MEASURED, q, v, ts, (knots, places))
        return found.q[1] + 2 * found.qdot[2] + found.q[2] + 0.5 * found.qdot[1]

    def by_hand(q, v, knots, places):
        (q1, v1), (q2, v2) = pendulum_by_hand(q, v, 0.03, np.array(ts[1:]), knots, places)
        return q1 + 2 * v2 + q2 + 0.5 * v1

    given = 0.3, -0.2, KNOTS, PLACES
    back, forward = (
        jax.jit(derivative(loss, (0, 1, 3)))(*given) for derivative in (jax.grad, jax.jacfwd)
    )  # at a fixed output the knot itself must not move
    for place, one, other in zip((0, 1, 3), back, forward, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)
        for i in range(np.size(given[place])):
            moved = [np.array(x, float) for x in given]
            pair = []
            for sign in (1, -1):
                moved[place] = np.array(given[place], float)
                moved[place].ravel()[i : i + 1] += sign * 1e-5
                pair.append(by_hand(*moved))
            np.testing.assert_allclose(np.ravel(one)[i], (pair[0] - pair[1]) / 2e-5, rtol=1e-6, atol=1e-6)


def test_derivatives_by_knots():
    ts = np.array([0.03, 1.1])

    def loss(knots):
        found = lagjax.simulate(MEASURED, 0.3, -0.2, ts, (knots, PLACES))
        return found.q[1] + 2 * found.qdot[1]

    back, forward = (np.array(jax.jit(derivative(loss))(KNOTS)) for derivative in (jax.grad, jax.jacfwd))
    np.testing.assert_allclose(back, forward, rtol=1e-9, atol=1e-11)
    for i in range(6):
        pair = [
            pendulum_by_hand(0.3, -0.2, 0.03, [1.1], KNOTS + sign * 1e-5 * np.eye(9)[i], PLACES)[-1] for sign in (1, -1)
        ]
        np.testing.assert_allclose(back[i], (pair[0] - pair[1]) @ [1, 2] / 2e-5, rtol=1e-6, atol=1e-6)


SWITCHED = {  # L, and the state at t = 3 from (0.2, 1)
    "a vector potential": (lambda q, v, t: 0.5 * v**2 + jnp.where(t > 1, 1.0, 0.0) * v, (1.2, 0.0)),
    "a mass that doubles": (lambda q, v, t: 0.5 * v**2 * jnp.where(t >= 1, 2.0, 1.0), (2.2, 0.5)),
    "a clock": (lambda q, v, t: 0.5 * v**2 * jnp.exp(jnp.log(2.0) * jnp.floor(t / 2)), (2.7, 0.5)),
    "both at once": (
        lambda q, v, t: 0.5 * v**2 * jnp.where(t > 1, 2.0, 1.0) + jnp.heaviside(t - 1, 0.5) * v, (1.2, 0.0)),
}  # fmt: skip


@pytest.mark.parametrize("what", SWITCHED)
def test_switched_in_time(what):
    lagrangian, right = SWITCHED[what]
    np.testing.assert_allclose(end(lagjax.System(lagrangian), 0.2, 1.0), right, **TIGHT)


def switched_field(q, v, t, params):
    return kinetic(v) + 0.5 * params * jnp.where(t > 1, 1.0, 0.0) * (q[0] * v[1] - q[1] * v[0])


SWITCHED_FIELD = lagjax.System(switched_field)


def test_field_that_is_switched_on():
    """A charge in the plane: B is switched on by its vector potential ½ B (−y, x), whose jump is a blow by E."""
    scene, b = SWITCHED_FIELD, 0.7

    def right(b):
        q, v = np.array([0.3, 0.1]) + np.array([1.0, 0.5]), np.array([1.0, 0.5])
        v = v - 0.5 * b * np.array([-q[1], q[0]])
        z, w = complex(*q), complex(*v)  # ẇ = −i b w
        z += w * (1 - np.exp(-2j * b)) / (1j * b)
        return np.array([z.real, z.imag])

    def place(b):
        return lagjax.simulate(scene, np.array([0.3, 0.1]), np.array([1.0, 0.5]), np.array([0.0, 3.0]), b).q[-1]

    np.testing.assert_allclose(place(b), right(b), **TIGHT)
    slope = (right(b + 1e-6) - right(b - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.jit(jax.jacrev(place))(b), slope, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(place))(b), slope, rtol=1e-7, atol=1e-8)


# ---- in space --------------------------------------------------------------------------------------------------------

STEPS = {
    "where": lambda q, h: jnp.where(q > 0, h, 0.0),
    ">": lambda q, h: h * (q > 0),
    "heaviside": lambda q, h: h * jnp.heaviside(q, 0.5),
    "sign": lambda q, h: 0.5 * h * jnp.sign(q),
    "floor": lambda q, h: h * jnp.floor(q / 5),
    "samples": lambda q, h: lagjax.samples(np.array([-9.0, 0.0]), jnp.stack([0.0 * h, h]), hold="zero")(q),
}
RATCHET = lagjax.System(lambda q, v: 0.5 * v**2 - 0.1 * (q - jnp.floor(q)) + 0.05 * q)
WELL = lagjax.System(
    lambda q, v: 0.5 * v**2 + jnp.where(jnp.abs(q) < 1, 0.5, 0.0), forces=lambda q, v: -0.02 * jnp.sign(v)
)
SMOOTH = lagjax.System(lambda q, v: -jnp.sqrt(1 - v**2) - 0.15 * (1 + jnp.tanh(q / 0.01)))
WIRE = lagjax.System(lambda q, v: 0.5 * v @ v, constraints=lambda q: q[1] - jnp.abs(q[0]))
PUSHED = lagjax.System(lambda q, v: 0.5 * v @ v - 0.4 * q[0], constraints=lambda q: q[1] - jnp.maximum(q[0], 0.0))
WIRE_OVER_A_STEP = lagjax.System(
    lambda q, v: kinetic(v) - jnp.where(q[0] > 0, 0.3, 0.0), constraints=lambda q: q[1] - 0.5 * q[0]
)


@functools.cache
def step(spelling):
    return lagjax.System(lambda q, v, params: kinetic(v) - STEPS[spelling](q, params))


@pytest.mark.parametrize("spelling", sweep(STEPS, kept=("where", ">", "samples")))
def test_step_of_a_potential(spelling):
    """Up with less speed, down with more, and thrown back where the energy does not suffice."""
    q, v = jnp.array([-1.0, -1.0, 1.0]), jnp.array([1.0, 0.5, -0.5])
    batch = lagjax.simulate_batch(step(spelling), q, v, jnp.array([0.0, 3.0]), 0.3)
    up, down = np.sqrt(1 - 0.6), -np.sqrt(0.25 + 0.6)
    np.testing.assert_allclose(batch.q[:, -1], [2 * up, -0.5, down], **TIGHT)
    np.testing.assert_allclose(batch.qdot[:, -1], [up, -0.5, down], **TIGHT)
    single = [
        end(step(spelling), jnp.float32(x), jnp.float32(y), params=jnp.float32(0.3))[0] for x, y in ((-1, 1), (-1, 0.5))
    ]
    np.testing.assert_allclose(single, [2 * up, -0.5], rtol=1e-6)


def beyond_a_step(x):
    """q(3) = √(v² − 2h) (3 + q/v), and −q − 3 v where it is reflected, of x = (h, q, v)."""
    h, q, v = x
    return jnp.where(v**2 > 2 * h, jnp.sqrt(jnp.abs(v**2 - 2 * h)) * (3 + q / v), -q - 3 * v)


def found_beyond_a_step(x):
    return end(step("where"), x[1], x[2], params=x[0])[0]


def test_derivatives_at_a_step():
    back, forward = (jax.jit(of(found_beyond_a_step)) for of in (jax.grad, jax.jacfwd))
    slopes = jax.jit(jax.grad(beyond_a_step))
    for x in (np.array([0.3, -1.0, 1.0]), np.array([0.9, -1.0, 1.0])):
        np.testing.assert_allclose(back(x), slopes(x), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(forward(x), slopes(x), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_at_a_step():
    found, right, x = found_beyond_a_step, beyond_a_step, np.array([0.3, -1.0, 1.0])
    np.testing.assert_allclose(jax.jit(jax.hessian(found))(x), jax.hessian(right)(x), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacrev(jax.grad(found)))(x), jax.hessian(right)(x), rtol=1e-8, atol=1e-8)


def test_refraction():
    """Snell's law at a slanted border: the momentum along it stays, in the metric of M."""
    normal, mass = np.array([0.6, 0.8]), np.array([[2.0, 0.3], [0.3, 1.0]])

    def lagrangian(q, v, params):
        return 0.5 * v @ mass @ v - params * (normal @ q > 0.2)

    scene, q, v = lagjax.System(lagrangian), np.array([-0.5, -0.3]), np.array([1.0, 0.9])
    for height in (0.4, 3.0):
        after = np.array(end(scene, q, v, params=height)[1])
        kick = mass @ (after - np.array(v))
        np.testing.assert_allclose(kick @ np.array([-0.8, 0.6]), 0.0, atol=1e-12)
        energy = 0.5 * v @ mass @ v
        passes = normal @ after > 0
        assert passes == (height < 1)
        np.testing.assert_allclose(0.5 * after @ mass @ after + height * passes, energy, rtol=1e-12)


def test_other_jumps_by_place():
    ends = {
        "a mass": (lambda q, v: 0.5 * v**2 * jnp.where(q > 0, 2.0, 1.0), (np.sqrt(2), np.sqrt(0.5))),
        "a gauge": (lambda q, v: 0.5 * v**2 + jnp.where(q > 0, 2.0, 0.0) * v, (2.0, 1.0)),
        "no jump": (lambda q, v: 0.5 * v**2 - jnp.where(q > 0, 0.1 * q, 0.0), (2 - 0.2, 1 - 0.2)),
    }
    for what, (lagrangian, right) in ends.items():
        np.testing.assert_allclose(end(lagjax.System(lagrangian), -1.0, 1.0), right, **TIGHT, err_msg=what)


def test_well_and_ratchet_keep_their_energy():
    """A thousand steps of a ratchet down a slope, friction at the walls of a well: nothing is lost at borders."""
    found = lagjax.simulate(RATCHET, 0.5, 0.6, np.linspace(0, 150, 40))
    assert found.q[-1] > 500
    np.testing.assert_allclose(found.energy(), found.energy()[0], rtol=1e-9)
    found = lagjax.simulate(WELL, 0.0, 0.9, np.linspace(0, 60, 7))
    way = (0.81 / 2) / 0.02  # until friction has taken all of it: it stays inside, and rests
    assert np.abs(found.q).max() < 1
    np.testing.assert_allclose(found.qdot[-1], 0.0, atol=1e-12)
    place = 1 - abs((way + 1) % 4 - 2)  # folded between the walls at ±1, from 0
    np.testing.assert_allclose(found.q[-1], place, atol=1e-8)


def test_constraint_beside_a_step():
    """A bead on a wire y = x/2 meets the step of a potential: as a mass of 1.25 along x."""
    q, v = end(WIRE_OVER_A_STEP, np.array([-1.0, -0.5]), np.array([1.0, 0.5]))
    speed = np.sqrt(1 - 0.6 / 1.25)
    np.testing.assert_allclose(q, [2 * speed, speed], rtol=1e-8)
    np.testing.assert_allclose(v, [speed, 0.5 * speed], rtol=1e-8)


# ---- what is refused -------------------------------------------------------------------------------------------------


def test_refused_before_the_run():
    ts = np.array([0.0, 1.0])
    with pytest.raises(ValueError, match="jumps at a border: the velocities jump there"):
        lagjax.simulate(step("where"), -1.0, 1.0, ts, 0.3, solver=diffrax.Tsit5())
    for lagrangian, what in (
        (lambda q, v: 0.5 * v**2 + jnp.abs(v), "no law gives"),
        (lambda q, v: -jnp.sqrt(1 - v**2) - jnp.where(q > 0, 0.3, 0.0), "not quadratic in qdot"),
    ):
        with pytest.raises(ValueError, match=what):
            lagjax.simulate(lagjax.System(lagrangian), -1.0, 0.5, ts)
    found = lagjax.simulate(SMOOTH, -1.0, 0.9, np.array([0.0, 3.0]))
    np.testing.assert_allclose(found.energy()[-1], found.energy()[0], rtol=1e-8)


def test_constraint_with_a_speed_that_jumps():
    pivot = {hold: lagjax.samples(KNOTS, PLACES, hold=hold) for hold in ("linear", "cubic")}

    def scene(hold):
        return lagjax.System(lambda q, v: kinetic(v) - q[1], constraints=lambda q, t: q[0] - pivot[hold](t))

    def start(hold):
        return [jnp.stack([x, 0.0]) for x in jax.value_and_grad(pivot[hold])(0.0)]

    with pytest.raises(ValueError, match=r"prescribes a speed that jumps.*hold='cubic'"):
        lagjax.simulate(scene("linear"), *start("linear"), np.array([0.0, 1.0]))
    found = lagjax.simulate(scene("cubic"), *start("cubic"), np.array([0.0, 1.0]))
    np.testing.assert_allclose(found.q[-1, 0], pivot["cubic"](1.0), rtol=1e-9)


def test_a_corner_of_a_constraint_ends_the_motion_that_comes_to_it():
    """A bead on y = |x| slides from x = −1 at speed √2 without a force, and reaches the corner after t = 1."""
    q, v = np.array([-1.0, 1.0]), np.array([1.0, -1.0])
    run = lagjax.simulate(WIRE, q, v, np.array([0.0, 0.75]))
    np.testing.assert_allclose(run.q[-1], [-0.25, 0.25], rtol=1e-9)
    with pytest.raises(lagjax.SimulationError, match=r"beyond t = 1 of 2"):
        lagjax.simulate(WIRE, q, v, np.array([0.0, 2.0]))
    with pytest.raises(lagjax.SimulationError, match=r"(?s)beyond t = 0.56350\d* of 2.*constraint has a corner"):
        lagjax.simulate(PUSHED, np.array([-0.5, 0.0]), np.array([1.0, 0.0]), np.array([0.0, 2.0]))


@pytest.mark.parametrize("spelling", STEPS)
def test_check_sees_every_spelling(spelling):
    found = lagjax.check(step(spelling), -0.9, 1.0, params=0.3)
    assert [f.kind for f in found if "velocities jump there" in f.message] == ["discontinuity"]


def test_jumps_that_are_decided_in_several_steps():
    """A look-up by searchsorted decides at one level about the next one; a level of zero is one like others."""
    levels, values = jnp.array([-0.5, 0.0, 0.2, 0.9, 1.4]), jnp.array([0.0, 0.8, -0.4, 0.6, 0.1, 0.5])

    def look_up(u):
        return values[jnp.searchsorted(levels, u)]

    by_place = lagjax.System(lambda q, v: 0.5 * v @ v + 0.3 * look_up(q[0]) * v[1])
    run = lagjax.simulate(by_place, np.array([-1.0, 0.0]), np.array([1.0, 0.0]), np.array([0.0, 3.0]))
    np.testing.assert_allclose(run.qdot[-1], [np.sqrt(1 - 0.15**2), -0.15], rtol=1e-14)
    ts = np.array([0.0, 0.7, 1.1, 1.5, 2.2, 2.8])
    by_time = lagjax.System(
        lambda q, v, t: 0.5 * v @ v + look_up(t - 1) * v[1],
        forces=lambda q, v, t: look_up(t - 1) * jnp.array([1.0, 0.0]),
    )
    run = lagjax.simulate(by_time, np.zeros(2), np.zeros(2), ts)
    np.testing.assert_allclose(run.qdot[:, 1], -values[np.searchsorted(levels, ts - 1)], atol=1e-14)
    np.testing.assert_allclose(run.qdot[:, 0], [0.0, 0.16, 0.36, 0.5, 0.77, 0.99], rtol=1e-14)


@pytest.mark.parametrize("rtol", [pytest.param(1e-6, marks=pytest.mark.slow), 1e-11])
def test_a_wire_whose_curvature_jumps_kicks_nothing(rtol):
    """A bead on a table and around its edge, whose gap has a corner at x = 0 elsewhere: against the angle alone."""
    radius, g, duration = 0.05, 9.81, 0.09

    def wire(q):
        return jnp.where(q[0] < 0, q[1], jnp.sqrt(jnp.where(q[0] < 0, 1.0, q @ q))) - radius

    bead = lagjax.System(lambda q, v: 0.5 * v @ v - g * q[1], constraints=wire)

    def angle(speed):
        start, ts = (np.array([-0.06, radius]), jnp.array([speed, 0.0])), np.array([0.0, duration])
        return jnp.arctan2(*lagjax.simulate(bead, *start, ts, rtol=rtol).q[-1])

    def exact(t, y):  # with its derivative by the speed
        return [y[1], g / radius * np.sin(y[0]), y[3], g / radius * np.cos(y[0]) * y[2]]

    begun = [0.0, 1 / radius, 0.0, 1 / radius]
    found = solve_ivp(exact, (0.0, duration - 0.06), begun, rtol=1e-12, atol=1e-14).y[:, -1]
    later = 0.06 * found[1]  # a faster one comes to the edge sooner, by 0.06 dv
    np.testing.assert_allclose(angle(1.0), found[0], rtol=30 * rtol + 1e-10)
    np.testing.assert_allclose(jax.jit(jax.grad(angle))(1.0), found[2] + later, rtol=1e3 * rtol + 1e-9)
