"""Motion on borders: many joints that stick, and corners that a motion comes to rest on.

Every scene has a closed form: parabolas and half swings, or the balance of forces at rest.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import particle, particles
from sweeps import sweep

import lagjax

GRAVITY = 9.81


def springs(count):
    """As many blocks, each on its own spring, with dry friction."""
    return lagjax.System(
        lambda q, v: 0.5 * jnp.sum(v * v) - 0.5 * jnp.sum(q * q), forces=lambda q, v, params: -params * jnp.sign(v)
    )


def swings(q0, mu, t):
    """q and v of a unit mass on a unit spring with dry friction: half a swing takes π, and 2μ of the amplitude."""
    side = np.sign(q0)
    amplitude, n = abs(q0), 0
    while amplitude > mu and (n + 1) * np.pi < t:
        amplitude, side, n = amplitude - 2 * mu, -side, n + 1
        amplitude, side = abs(amplitude), side * np.sign(amplitude)
    if amplitude <= mu:
        return side * amplitude, 0.0
    s = t - n * np.pi
    return side * (mu + (amplitude - mu) * np.cos(s)), -side * (amplitude - mu) * np.sin(s)


def chain(count):
    """A chain of pendulums of unit masses and rods, by absolute angles, with dry friction in its joints."""

    def lagrangian(q, v):
        x, y = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
        return 0.5 * jnp.sum(x * x + y * y) + GRAVITY * jnp.sum(jnp.cumsum(jnp.cos(q)))

    def friction(q, v, params):
        torque = -params * jnp.sign(jnp.diff(v, prepend=0.0))
        return torque - jnp.append(torque[1:], 0.0)

    return lagjax.System(lagrangian, forces=friction)


def torques(q):
    """What the joints of a chain at rest have to hold."""
    weights = GRAVITY * (len(q) - np.arange(len(q))) * np.sin(q)
    return np.cumsum(weights[::-1])[::-1]


MASS_BY_SPEED = lagjax.System(
    lambda q, v: 0.5 * v**2 + 0.3 * jnp.abs(v) ** 3 - 0.5 * q**2, forces=lambda q, v, params: -params * jnp.sign(v)
)


def test_a_block_whose_mass_depends_on_its_speed_rests_where_its_energy_is_spent():
    def end(mu):
        return lagjax.simulate(MASS_BY_SPEED, 1.0, 0.0, np.array([0.0, 20.0]), mu).q[-1]

    place, slope = jax.value_and_grad(end)(0.15)
    assert abs(place - (6 * 0.15 - 1)) < 1e-8  # three swings, each of 2 mu less
    assert abs(slope - 6) < 1e-8


def test_twenty_blocks_stick_each_at_its_place():
    q0, ts = np.linspace(-3.0, 2.5, 20), np.array([0.0, 3.0, 7.0, 40.0])
    run = lagjax.simulate(springs(20), q0, np.zeros(20), ts, 0.3)
    exact = np.array([[swings(x, 0.3, t) for x in q0] for t in ts[1:]])
    np.testing.assert_allclose(run.q[1:], exact[:, :, 0], atol=1e-8)
    np.testing.assert_allclose(run.qdot[1:], exact[:, :, 1], atol=1e-8)
    assert abs(run.qdot[-1]).max() < 1e-12 and run.stats["num_steps"] < 400


@pytest.mark.slow
def test_a_thousand_blocks_rest_from_the_start_or_stop_together():
    q0, ts = 2 * np.cos(0.7 * np.arange(1000)), np.array([0.0, 5.0])
    run = lagjax.simulate(springs(1000), q0, np.zeros(1000), ts, 0.3)
    exact = np.array([swings(x, 0.3, 5.0) for x in q0])
    np.testing.assert_allclose(run.q[-1], exact[:, 0], atol=1e-9)
    np.testing.assert_allclose(run.qdot[-1], exact[:, 1], atol=1e-9)
    rest = lagjax.simulate(springs(1000), 0.3 * np.cos(0.7 * np.arange(1000)), np.zeros(1000), ts, 0.3)
    assert (rest.q[-1] == rest.q[0]).all()


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_a_chain_rests_as_long_as_its_joints_hold(count):
    q0 = 0.4 + 0.1 * np.cos(np.arange(count))
    limit, scene, ts = np.abs(torques(q0)).max(), chain(count), np.array([0.0, 1.0])
    held = lagjax.simulate(scene, q0, np.zeros(count), ts, 1.001 * limit)
    np.testing.assert_allclose(held.q[-1], q0, atol=1e-12)
    # Of all joints the first gives way: the rest goes on as one body, with θ" = (what is not held) / I.
    moves = lagjax.simulate(scene, q0, np.zeros(count), 1e-2 * ts, 0.999 * limit)
    x, y = np.cumsum(np.sin(q0)), np.cumsum(np.cos(q0))
    rate = -1e-3 * limit / np.sum(x * x + y * y)
    np.testing.assert_allclose(moves.qdot[-1], 1e-2 * rate, rtol=1e-2)


@pytest.mark.slow
def test_twenty_joints_of_many_chains():
    q0 = np.linspace(0.2, 0.9, 300)[:, None] + np.zeros(20)
    run = lagjax.simulate_batch(chain(20), q0, np.zeros((300, 20)), np.array([0.0, 1.0]), 3.0, batch_axes=(0, 0, None))
    alone = lagjax.simulate(chain(20), q0[150], np.zeros(20), np.array([0.0, 1.0]), 3.0)
    assert bool(run.ok.all())
    np.testing.assert_allclose(run.q[150, -1], alone.q[-1], atol=1e-10)


@pytest.mark.slow
def test_derivatives_through_many_that_stick():
    q0 = np.linspace(-1.9, 2.3, 6)

    def last(mu):
        return lagjax.simulate(springs(6), q0, np.zeros(6), np.array([0.0, 30.0]), mu).q[-1]

    # Half swings n until |q| ≤ μ: the end is ±(|q0| − 2 n μ).
    turns = np.array([np.ceil((abs(x) - 0.3) / 0.6) for x in q0])
    exact = -2 * turns * np.sign(q0) * (-1.0) ** turns
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(last)(0.3), exact, atol=1e-7)


# ---- a corner at rest ------------------------------------------------------------------------------------------------

VALLEY = lagjax.System(
    lambda q, v: 0.5 * v * v - jnp.abs(q), forces=lambda q, v, t, params: params[1] * t - params[0] * jnp.sign(v)
)


def test_a_motion_comes_to_rest_in_a_corner():
    mu = 0.5
    # It falls with 1 − μ and rises with 1 + μ, a third as high each time: times are a geometric series.
    ratio = (1 - mu) / (1 + mu)
    whole = np.sqrt(2 / (1 - mu)) * (1 + ratio) / (1 - np.sqrt(ratio))
    run = lagjax.simulate(VALLEY, 1.0, 0.0, np.array([0.0, 0.99 * whole, 1.01 * whole, 50.0]), np.array([mu, 0.0]))
    assert abs(run.q[1]) > 1e-7
    np.testing.assert_allclose(run.q[2:], 0.0, atol=1e-12)
    np.testing.assert_allclose(run.qdot[2:], 0.0, atol=1e-13)
    assert run.stats["num_steps"] < 300


def test_a_motion_is_pulled_out_of_a_corner():
    # At rest in it until the force t/5 is 1 + μ.
    run = lagjax.simulate(VALLEY, 0.0, 0.0, np.array([0.0, 7.4, 8.5]), np.array([0.5, 0.2]))
    np.testing.assert_allclose(run.q[1:], [0.0, 0.2 / 6], atol=1e-9)
    np.testing.assert_allclose(run.qdot[1:], [0.0, 0.1], atol=1e-9)


def test_sites_that_stop_at_one_instant_are_as_exact_as_alone():
    count, mu, t = 40, 0.3, 5.0  # all come to rest at π at once, some for good, some begin at rest
    q0, step = 2.0 * np.cos(0.7 * np.arange(count)), 1e-6
    scene = springs(count)
    place = lambda mu: lagjax.simulate(scene, q0, 0.0 * q0, np.array([0.0, t]), mu).q[-1]
    exact = lambda mu: np.array([swings(x, mu, t)[0] for x in q0])
    np.testing.assert_allclose(place(mu), exact(mu), atol=1e-11)
    slopes = (exact(mu + step) - exact(mu - step)) / (2 * step)
    for derivative in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(derivative(place))(mu), slopes, atol=1e-8)


def forces_beside_coupled(q, v, params):
    between = jnp.sign(v[0] - v[1])
    return -params * jnp.sign(v) - 0.1 * between * jnp.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.0])


BESIDE_COUPLED = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q, forces=forces_beside_coupled)


def test_sites_that_stop_at_one_instant_stop_beside_coupled_ones():
    """Two sites that rub on each other, and stop as one does, among others that know nothing of them."""
    q0, ts = np.array([2.0, 2.0, 1.5, 1.5, 1.7, 0.2]), np.array([0.0, 5.0])

    run = lagjax.simulate(BESIDE_COUPLED, q0, 0.0 * q0, ts, 0.3)
    np.testing.assert_allclose(run.q[-1], [swings(x, 0.3, 5.0)[0] for x in np.array(q0)], atol=1e-11)


def test_a_corner_without_friction_is_passed_and_kept_at_rest():
    ts = np.array([0.0, 1.0, 50.0])
    at_rest = lagjax.simulate(VALLEY, 0.0, 0.0, ts, np.zeros(2))
    np.testing.assert_array_equal(at_rest.q, 0.0)
    moves = lagjax.simulate(VALLEY, 0.0, 1.0, ts, np.zeros(2))  # parabolas of the length 2
    np.testing.assert_allclose(moves.q[1:], [0.5, 0.0], atol=1e-12)


def static_and_kinetic(q, v, t, params):
    return 0.1 * t - jnp.where(jnp.abs(v) < params, 0.5, 0.3) * jnp.sign(v)


STATIC_AND_KINETIC = lagjax.System(lambda q, v: 0.5 * v * v, forces=static_and_kinetic)


def test_static_friction_is_larger_than_kinetic():
    # At rest until 0.1 t is 0.5, then with 0.3.

    run = lagjax.simulate(STATIC_AND_KINETIC, 0.0, 0.0, np.array([0.0, 4.9, 7.0]), 1e-9)
    np.testing.assert_allclose(run.qdot[1:], [0.0, 0.05 * (49 - 25) - 0.3 * 2], atol=1e-4)


TABLE = {"speed": np.array([0.0, 0.5, 1.0, 9.0]), "mu": np.array([0.4, 0.4, 0.4, 0.4])}
# Coulomb's law with 0.4 in other words, all of which decide on |v| where v itself is decided on.
COULOMB = {
    "where": lambda v, params: jnp.where(jnp.abs(v) > 0.0, *params["mu"][:2]) * jnp.sign(v),
    "equal": lambda v, params: jnp.where(v == 0.0, 0.0, 0.4 * jnp.sign(v)),
    "direction": lambda v, params: 0.4 * v / jnp.where(jnp.abs(v) > 0.0, jnp.abs(v), 1.0),
    "quotient": lambda v, params: 0.4 * v / jnp.abs(v),
    "twice": lambda v, params: jnp.where(2 * jnp.abs(v) <= 0.0, 0.0, 0.4) * jnp.sign(v),
    "threshold": lambda v, params: jnp.where(jnp.abs(v) > params["speed"][0], *params["mu"][:2]) * jnp.sign(v),
    "table": lambda v, params: jnp.interp(jnp.abs(v), *map(np.asarray, TABLE.values())) * jnp.sign(v),
    "table of parameters": lambda v, params: jnp.interp(jnp.abs(v), params["speed"], params["mu"]) * jnp.sign(v),
}


@pytest.mark.parametrize("law", sweep(COULOMB, kept=["where", "equal", "quotient", "table of parameters"]))
def test_friction_by_a_law_of_speed_that_begins_at_zero(law):
    """Two borders at one place, of which one has no lower side. Compiles a motion, and its transpose."""
    friction = lambda q, v, params: -COULOMB[law](v - params["belt"], params)
    scene = lagjax.System(lambda q, v: 0.5 * (v * v - q * q), forces=friction)

    def state(q0, belt, t):
        run = lagjax.simulate(scene, q0, 0.0, jnp.array([0.0, t]), TABLE | {"belt": belt}, solver=lagjax.MachineCode())
        return jnp.stack([run.q[-1], run.qdot[-1]])

    for q0, t in ((1.5, 2.0), (1.5, 9.0), (0.3, 9.0)):  # it sets out, comes to rest, and has never moved
        np.testing.assert_allclose(state(q0, 0.0, t), swings(q0, 0.4, t), atol=1e-8)

    slope = jax.grad(lambda q0: state(q0, 0.0, 5.0)[0])(1.5)  # after one half swing
    near = [swings(1.5 + h, 0.4, 5.0)[0] for h in (1e-6, -1e-6)]
    np.testing.assert_allclose(slope, (near[0] - near[1]) / 2e-6, atol=1e-8)

    # A belt drags it at its own speed for a second, until the spring pulls 0.4; from there it swings about q = 0.4.
    params = TABLE | {"belt": 0.3}
    dragged = lagjax.simulate(scene, 0.1, 0.3, np.array([0.0, 4.0]), params, solver=lagjax.MachineCode())
    np.testing.assert_allclose(dragged.q[-1], 0.4 + 0.3 * np.sin(3.0), atol=1e-8)


def force_of_changing_belt(q, v, t):
    return -jnp.sign(v - jnp.where(t < 1.0, 0.5, jnp.where(t < 2.0, -0.25, 0.0)))


ON_A_CHANGING_BELT = lagjax.System(lambda q, v: 0.5 * v * v, forces=force_of_changing_belt)


def test_a_belt_that_changes_its_speed():
    # With friction 1: it goes along with 0.5, from t = 1 on it brakes to −0.25, from t = 2 on to rest.

    run = lagjax.simulate(ON_A_CHANGING_BELT, 0.0, 0.5, np.array([0.0, 1.0, 1.5, 1.75, 2.0, 2.25, 3.0]))
    np.testing.assert_allclose(run.q, [0.0, 0.5, 0.625, 0.59375, 0.53125, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(run.qdot, [0.5, 0.5, 0.0, -0.25, -0.25, 0.0, 0.0], atol=1e-12)


def force_of_three_contacts(q, v, t):
    between = -0.3 * jnp.sign(v[0] - v[1]) * jnp.array([1.0, -1.0])
    return between - 0.3 * jnp.sign(v) + jnp.array([0.1 * t, 0.0])


THREE_CONTACTS = lagjax.System(lambda q, v: 0.5 * v @ v, forces=force_of_three_contacts)


def test_three_contacts_of_two_blocks_share_what_they_hold():
    # Two blocks on the ground and against each other, all with friction of 0.3: one that is pulled holds up to 0.6.

    run = lagjax.simulate(THREE_CONTACTS, np.zeros(2), np.zeros(2), np.array([0.0, 5.9, 7.0, 12.0]))
    np.testing.assert_allclose(run.qdot[1:], [[0.0, 0.0], [0.05, 0.0], [1.8, 0.0]], atol=1e-12)


def force_held_to_rounding(q, v, params):
    between = -0.1 * jnp.sign(v[0] - v[1]) * jnp.array([1.0, -1.0])
    return params * (between - 0.2 * jnp.sign(v) + jnp.array([1.2, 0.0]) - q)


HELD_TO_ROUNDING = lagjax.System(lambda q, v: 0.5 * jnp.sum(v * v), forces=force_held_to_rounding)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_contacts_that_hold_to_rounding_are_settled_at_one_instant(size):
    """Of the contacts of two blocks one yields at once; what the others hold is exact to the rounding of the forces.

    Whether that moves a block within a step, by its own tolerance, depends on the size of the forces and of the step.
    Compiles one motion.
    """

    for duration in (0.1, 1.0, 3.0):
        for second in (0.1, 0.11, 0.099999):  # held back by its own friction, up to 0.3
            ts = np.array([0.0, duration / np.sqrt(size)])
            run = lagjax.simulate(HELD_TO_ROUNDING, np.array([0.0, second]), np.zeros(2), ts, size)
            np.testing.assert_allclose(run.q[-1], [0.9 * (1 - np.cos(duration)), second], atol=1e-8)


@pytest.mark.parametrize("power", [0.5, 1.5, 1.75, 2.5])
def test_an_oscillator_of_a_broken_power(power):
    """The root and the sign change at one place, where the power has no series. Compiles two batches."""
    q0, ts = np.linspace(0.1, 1.0, 10), np.array([0.0, 8.0])
    for force in (
        lambda q, v: -jnp.sign(q) * jnp.abs(q) ** power,
        lambda q, v: -(jnp.where(q > 0, q, -q) ** power) * jnp.where(q < 0, -1.0, 1.0),
    ):
        scene = particle(force)
        run = lagjax.simulate_batch(scene, q0, np.zeros(10), ts, solver=lagjax.MachineCode())
        energy = 0.5 * run.qdot[:, -1] ** 2 + np.abs(run.q[:, -1]) ** (power + 1) / (power + 1)
        np.testing.assert_allclose(energy, q0 ** (power + 1) / (power + 1), atol=1e-8)


# ---- borders of every kind -------------------------------------------------------------------------------------------

LEVELS, HEIGHTS = jnp.array([-1.3, -0.4, 0.7, 1.1]), jnp.array([-2.0, -0.7, 0.2, 0.9, 2.5])
# A step function, one of its levels, and its values below and above that.
STEPS = {
    "floor": (jnp.floor, 1.0, 0.0, 1.0),
    "trunc": (jnp.trunc, -1.0, -1.0, 0.0),
    "whole parts": (lambda u: u // 0.5, 0.5, 0.0, 1.0),
    "parity": (lambda u: 1.0 * (jnp.ceil(2 * u) % 2 == 0), 0.5, 0.0, 1.0),
    "branches": (lambda u: jax.lax.switch(jnp.int32(u // 1) + 2, [lambda x=x: x for x in HEIGHTS]), 0.0, -0.7, 0.2),
    "bins, left": (lambda u: HEIGHTS[jnp.searchsorted(LEVELS, u)], 0.7, 0.2, 0.9),
    "sign of another": (lambda u: jnp.copysign(0.5, u), 0.0, -0.5, 0.5),
}  # fmt: skip
FUNCTIONS, AT, BELOW, ABOVE = zip(*STEPS.values(), strict=True)
STEPPED = lagjax.System(
    lambda q, v: 0.5 * v @ v,
    forces=lambda q, v, t, params: (
        params[0] + params[1] * t - 4 * jnp.stack([f(v[i]) for i, f in enumerate(FUNCTIONS)])
    ),
)
STAIRS_OF_SPEEDS = lagjax.System(lambda q, v: 0.5 * v @ v, forces=lambda q, v, params: 0.3 - params * jnp.ceil(v))
CORNER_AWAY_FROM_ZERO = lagjax.System(
    lambda q, v: 0.5 * v * v, forces=lambda q, v, params: 3.0 - 4 * jnp.ceil(q - params) - 0.5 * jnp.sign(v)
)


def held_and_left(x, level, below, above, end):
    """v and q at the end, from x = (q, v, load, rate): it speeds up to the level, is held there, and goes on beyond."""
    q, v, load, rate = x
    a = load - 4 * below
    t1 = (jnp.sqrt(a * a + 2 * rate * (level - v)) - a) / rate
    t2 = (4 * above - load) / rate
    q = q + v * t1 + a * t1**2 / 2 + rate * t1**3 / 6
    return q + level * (end - t1) + rate * (end - t2) ** 3 / 6, level + rate * (end - t2) ** 2 / 2


def last(x):
    """The end of `STEPPED` from x = (q, v, load, rate)."""
    run = lagjax.simulate(STEPPED, x[0], x[1], jnp.array([0.0, 2.0]), x[2:])
    return jnp.stack([run.q[-1], run.qdot[-1]])


def exact(x):
    """The same in closed form."""
    return jnp.stack(jax.vmap(held_and_left, in_axes=(1, 0, 0, 0, None))(x, *map(jnp.array, (AT, BELOW, ABOVE)), 2.0))


def start():
    """All come to their levels one after the other, and leave them at one instant."""
    level, above, rates = np.array(AT), np.array(ABOVE), 0.8 + 0.05 * np.arange(len(STEPS))
    return np.stack([0.1 + 0 * level, level - 0.3, 4 * above - 1.3 * rates, rates])


def test_a_motion_slides_along_borders_of_every_kind():
    """All kinds in one scene."""
    np.testing.assert_allclose(last(start()), exact(start()), atol=1e-10)


@pytest.mark.slow
def test_derivatives_along_borders_of_every_kind():
    x, weights = start(), np.sin(np.arange(2.0 * len(STEPS))).reshape(2, -1)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(last)(x), jax.jit(jax.jacfwd(exact))(x), atol=1e-8)
    moved = x[None] + np.array([0.0, 0.02])[:, None, None]
    np.testing.assert_allclose(jax.vmap(last)(moved), jax.jit(jax.vmap(exact))(moved), atol=1e-10)
    along = lambda f: jax.jvp(jax.grad(lambda x: jnp.sum(weights * f(x) ** 2)), (x,), (jnp.cos(x),))[1]
    np.testing.assert_allclose(along(last), jax.jit(lambda: along(exact))(), atol=1e-7)


@pytest.mark.parametrize("count", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_borders_that_are_come_to_at_one_instant_each_shift_their_own_tangents(count):
    def ends(v0):
        return lagjax.simulate(STAIRS_OF_SPEEDS, jnp.zeros(count), v0, jnp.array([0.0, 2.0]), 1.5).q[-1]

    # Down to v = 0 with 1.2, to rest there: q = v0² / 2.4.
    np.testing.assert_allclose(ends(np.full(count, 0.9)), 0.81 / 2.4, atol=1e-10)
    np.testing.assert_allclose(jax.jacrev(ends)(np.full(count, 0.9)), np.eye(count) * 0.9 / 1.2, atol=1e-10)


def test_a_corner_away_from_zero_is_rested_in():
    """Bounces end where rounding of the place hides them; at rest from the start, too."""
    for level in (0.7, 100.0):
        for q0, v0 in ((level + 0.2, 0.3), (level, 0.0)):
            run = lagjax.simulate(CORNER_AWAY_FROM_ZERO, q0, v0, np.array([0.0, 50.0]), level)
            np.testing.assert_allclose([run.q[-1] - level, run.qdot[-1]], 0.0, atol=1e-12)


@pytest.mark.slow
def test_an_output_moves_along_the_border_that_is_slid_on():
    """The rate at an output, where the program looks up tables: v = 1 − q/2 along the border, so that v̇ = −v/2."""
    pushes = lagjax.samples(np.linspace(0.0, 4.0, 9), np.linspace(1.5, 1.8, 9), hold="linear")
    scene = particle(lambda q, v, t: pushes(t) - 3 * HEIGHTS[jnp.digitize(v + 0.5 * q, LEVELS)])
    end = lambda t: lagjax.simulate(scene, 0.0, 0.65, jnp.array([0.0, t]))
    rate, v = jax.grad(lambda t: end(t).qdot[-1])(2.0), end(2.0).qdot[-1]
    np.testing.assert_allclose(rate, -0.5 * v, atol=1e-9)


# ---- dry friction in the plane ---------------------------------------------------------------------------------------


def guarded(v):
    """v / |v| by the double `where` that keeps gradients at rest finite."""
    square = v @ v
    return jnp.where(square > 0, v / jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


DIRECTIONS = [
    lambda v: v / jnp.linalg.norm(v),
    lambda v: v / jnp.hypot(v[0], v[1]),
    lambda v: v / jnp.maximum(jnp.sqrt(v @ v), 1e-12),
    lambda v: v / jnp.where(v @ v == 0, 1.0, jnp.linalg.norm(v)),
    guarded,
]
PUCK = lagjax.System(
    lambda q, v: 0.5 * v @ v,
    forces=lambda q, v, t, params: params[0:2] + t * params[2:4] - params[4] * v / jnp.linalg.norm(v),
)
DISCS = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v * v),
    forces=lambda q, v: -2.0 * jnp.stack([f(v[i]) for i, f in enumerate(DIRECTIONS)] + [0.0 * v[-1]]),
    dissipation=lambda q, v: 2.0 * jnp.linalg.norm(v[-1]),
)


def puck(v0, params, *ts):
    return lagjax.simulate(PUCK, jnp.zeros(2), jnp.array(v0), jnp.array([0.0, *ts]), jnp.array(params))


def test_discs_stop_and_rest_in_every_spelling():
    """Each disc stops after v/μ at v²/2μ, and stays there."""
    v0 = np.array([[0.3, 0.4], [-0.6, 0.2], [0.1, 0.7], [0.5, -0.5], [0.4, 0.1], [0.2, 0.3]])
    run = lagjax.simulate(DISCS, np.zeros((6, 2)), v0, np.array([0.0, 1.0, 1e6]))
    exact = v0 * np.linalg.norm(v0, axis=1, keepdims=True) / 4
    np.testing.assert_allclose(run.q[1:], np.stack([exact, exact]), atol=1e-12)
    np.testing.assert_array_equal(run.qdot[1:], 0.0)


def test_a_puck_rests_until_its_load_is_larger_than_friction():
    held = puck([0.0, 0.0], [1.2, 1.59, 0.0, 0.0, 2.0], 1e6)  # 1.992 of 2
    np.testing.assert_array_equal(held.q[-1], 0.0)
    slips = puck([0.0, 0.0], [1.8, 2.4, 0.0, 0.0, 2.0], 2.0)  # 3 of 2
    np.testing.assert_allclose(slips.q[-1], [1.2, 1.6], atol=1e-9)
    ramp = puck([0.0, 0.0], [0.0, 0.0, 0.6, 0.8, 2.0], 1.99, 5.0)  # from t = 2 on
    np.testing.assert_allclose(ramp.q[1:], [[0.0, 0.0], [2.7, 3.6]], atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_puck_through_its_stop():
    """Down a slope that friction holds. Compiles a motion, its tangents and its transpose."""
    params = jnp.array([1.0, 0.0, 0.0, 0.0, 2.0])

    def place(x):
        run = lagjax.simulate(PUCK, jnp.zeros(2), x[:2], jnp.array([0.0, 2.0]), params.at[4].set(x[2]))
        return run.q[-1]

    x, step = jnp.array([0.3, 0.4, 2.0]), 1e-4
    slopes = jnp.stack([(place(x + step * e) - place(x - step * e)) / (2 * step) for e in jnp.eye(3)], axis=1)
    for derivative in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(derivative(place)(x), slopes, atol=1e-6)
    sets_out = lambda limit: puck([0.0, 0.0], [0.0, 0.0, 0.6, 0.8, limit], 5.0).q[-1, 0]
    assert jnp.isnan(jax.grad(sets_out)(2.0))  # of directions behind a release nothing is known


def test_a_turning_table_carries_a_body_along():
    turn = 0.8
    scene = particles(lambda q, v: -2.0 * (lambda u: u / jnp.linalg.norm(u))(v - turn * jnp.stack([-q[1], q[0]])))
    q0, v0, ts = np.array([[1.0, 0.0], [4.0, 0.0]]), np.array([[0.5, 0.2], [0.0, 3.2]]), np.array([0.0, 5.0, 50.0])
    run = lagjax.simulate_batch(scene, q0, v0, ts)
    u = run.qdot - turn * np.stack([-run.q[..., 1], run.q[..., 0]], axis=-1)
    np.testing.assert_allclose(u[0, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(run.q[0, 2]), np.linalg.norm(run.q[0, 1]), rtol=1e-9)
    assert np.linalg.norm(run.q[1, 2]) > 10.0  # where ω² r is more than friction, it flies off
