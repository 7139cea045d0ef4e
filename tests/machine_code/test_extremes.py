"""Numbers at the ends of the range of doubles: motions end, and are right, however small or large they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import particle, particles

import lagjax

PENDULUM = lagjax.System(lambda q, v: 0.5 * v**2 + 9.81 * jnp.cos(q))
CLOCK = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params**2 * q**2)
SQUARE_DRAG = lagjax.System(lambda q, v: 0.5 * v**2, forces=lambda q, v: -v - jnp.abs(v) * v)
TWO_SPRINGS = lagjax.System(lambda q, v: 0.5 * v**2, forces=lambda q, v: -jnp.where(q > 0, 4 * q, q))


# ---- times -----------------------------------------------------------------------------------------------------------


def test_times_next_to_each_other_end():
    spans = np.array([[0.0, 1.0], [0.0, 5e-324], [0.0, 1e-323], [0.0, 4e-323], [0.0, -5e-324], [5e-324, 0.0],
                      [5e-324, 1e-323], [0.0, 1e-320], [0.0, 1e-300], [0.0, -1.0]])  # fmt: skip
    alone = [lagjax.simulate(PENDULUM, 1.0, 0.5, ts).q[-1] for ts in spans]
    np.testing.assert_array_equal(alone[1:-1], 1.0)
    together = jax.jit(jax.vmap(lambda ts: lagjax.simulate(PENDULUM, 1.0, 0.5, ts).q[-1]))(spans)
    np.testing.assert_allclose(together, alone, rtol=1e-13)


# ---- motions that die out --------------------------------------------------------------------------------------------


def drag(q, v, params):
    a, b, width = params
    air = -a * v[0] - b * jnp.abs(v[0]) * v[0]
    dead_zone = -jnp.where(jnp.abs(q[1]) < 0.5, 0.0, q[1] - 0.5 * jnp.sign(q[1])) - 3 * v[1]
    return jnp.array([air, dead_zone, -v[2] / (jnp.abs(v[2]) + width), -5 * v[3] - 0.1 * jnp.abs(v[3]) * v[3]])


DRAGGED = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q[3] ** 2, forces=drag)


def test_motions_that_die_out_towards_a_corner():
    def end(params, duration):
        return lagjax.simulate(DRAGGED, *start, np.array([0.0, duration]), params)

    def rest(params):
        a, b, width = params
        return jnp.array([jnp.log1p(b / a) / b, 0.5, 0.5 + width, 0.0])

    start, params = (np.array([0.0, 1.0, 0.0, 1.0]), np.array([1.0, 0.0, 1.0, 0.0])), np.array([1.0, 0.7, 0.1])
    found = end(params, 1000.0)
    np.testing.assert_allclose(found.q[-1], jax.jit(rest)(params), atol=1e-9)
    assert found.stats["num_steps"] < 4000
    slopes = jax.jit(jax.jacrev(lambda params: end(params, 250.0).q[-1]))(params)
    np.testing.assert_allclose(slopes, jax.jit(jax.jacobian(rest))(params), atol=1e-8)


def test_a_motion_that_died_out_long_ago():
    found = lagjax.simulate(SQUARE_DRAG, 0.0, 1.0, np.array([0.0, 1e6]))
    np.testing.assert_allclose(found.q[-1], np.log(2.0), atol=1e-9)
    assert found.stats["num_steps"] < 1000


@pytest.mark.parametrize("size", [1e-30, 1e-200])
def test_a_border_is_crossed_with_any_amplitude(size):
    ts = np.array([0.0, 1.0, 10 * (np.pi / 2 + np.pi)])
    found = lagjax.simulate(TWO_SPRINGS, size, 0.0, ts, atol=1e-13 * size)
    np.testing.assert_allclose(found.q[1:], size * np.array([2 * np.sin(np.pi / 4 - 1.0), 1.0]), rtol=1e-9)


# ---- what overflows where it no longer matters -----------------------------------------------------------------------


@pytest.mark.parametrize("width", [1e-3, pytest.param(1e-6, marks=pytest.mark.slow)])
def test_narrow_pulses_are_met_from_where_cosh_is_infinite(width):
    def pulses(q, v, params):
        soliton, logistic = 1 / jnp.cosh(q[0] / width) ** 2, 1 / (1 + jnp.exp(q[1] / width))
        return params * jnp.array([soliton, logistic, jnp.exp(-q[2] / width - jnp.exp(-q[2] / width))])

    def end(params):
        return lagjax.simulate(system, np.full(3, -1.0), np.ones(3), np.array([0.0, 2.5]), params)

    system, strength = particles(pulses), 1.0
    found = end(strength)
    assert found.stats["num_steps"] < 1000
    # The energies that these forces give: 2 a width, a and a width.
    speeds = np.sqrt(1.0 + 2 * strength * np.array([2 * width, 1.0, width]))
    np.testing.assert_allclose(found.qdot[-1], speeds, rtol=2e-9 / width * 1e-3 + 1e-9)
    slopes = jax.jit(jax.jacfwd(lambda a: end(a).qdot[-1]))(strength)
    np.testing.assert_allclose(slopes, np.array([2 * width, 1.0, width]) / speeds, rtol=1e-5, atol=1e-9)
    first = jax.jit(jax.grad(lambda a: end(a).qdot[-1][1]))(strength)
    np.testing.assert_allclose(first, 1.0 / speeds[1], rtol=1e-6)


# ---- fast motions ----------------------------------------------------------------------------------------------------


def test_rates_whose_powers_overflow():
    """ω²⁰ is beyond all doubles: of series of lower order it is not asked for."""

    def end(q, rate, rtol=1e-12):
        return lagjax.simulate(CLOCK, q, 0.0, jnp.array([0.0, 3.0]) / jax.lax.stop_gradient(rate), rate, rtol=rtol)

    for rate, rtol in ((1e16, 1e-14), (1e20, 1e-12), (1e30, 1e-9)):
        np.testing.assert_allclose(end(1.0, rate, rtol).q[-1], np.cos(3.0), atol=100 * rtol)
    rates = np.array([1.0, 1e20])
    for slope in (jax.grad, jax.jacfwd):
        by_q, by_rate = jax.jit(jax.vmap(slope(lambda *x: end(*x).q[-1], (0, 1)), (None, 0)))(1.0, rates)
        np.testing.assert_allclose(by_q, np.cos(3.0), atol=1e-10)
        np.testing.assert_allclose(by_rate * rates, -3.0 * np.sin(3.0), atol=1e-10)


def test_rates_whose_powers_overflow_on_the_way():
    """A pulse 1e-15 m wide at the speed of atoms, 1.5e18 per second, is met after a flight that knows no rate."""

    def end(length, time):
        pulse = lambda q, v: -0.3 * length / time**2 * 1e3 / jnp.cosh((q / length - 0.2) * 1e5) ** 2
        system = particle(pulse)
        return lagjax.simulate(system, 0.0, 1.5 * length / time, jnp.array([0.0, 10 * time])).q[-1] / length

    np.testing.assert_allclose(end(1e-10, 1e-13), end(1.0, 1.0), rtol=1e-8)


def force_by_exponentials(q, v, params):
    beyond = jnp.where(q > 0.3, 1 / (1 + jnp.exp(5 * q)), -1.0 / jnp.cosh(params * q) ** 2)
    return beyond - jnp.tanh(jnp.exp(q)) * jnp.floor(2 * q)


BY_EXPONENTIALS = lagjax.System(lambda q, v: 0.5 * v**2 - 0.1 * jnp.log(1 + jnp.exp(q)), forces=force_by_exponentials)


def test_slopes_over_borders_of_functions_of_exponentials():
    """Behind a border, too, and in reverse: what masks an overflow there asks of values, not of tangents."""

    def end(x):
        return lagjax.simulate(BY_EXPONENTIALS, x[0], x[1], jnp.array([0.0, 3.0]), x[2]).q[-1]

    x = np.array([-0.4, 1.3, 1.0])
    differences = [(end(x + 1e-6 * e) - end(x - 1e-6 * e)) / 2e-6 for e in np.eye(3)]
    np.testing.assert_allclose(jax.grad(end)(x), differences, rtol=1e-6)
