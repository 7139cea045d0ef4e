"""Every row of `benchmarks/_contacts.py`: motion, gradient and Hessian through contacts against the closed form."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

pytest.importorskip("scipy", reason="the references are computed with it")
sys.path.insert(0, str(Path(__file__).parents[2]))

import lagjax
from benchmarks._contact_reference import Reference
from benchmarks._contacts import MANY, ROWS, billiard, end_of, rest_time, system_of, two_balls

# One of every law: a blow, blows at one instant, rest after bounces, opening, a freewheel, and friction.
FAST = ("two balls, m = 1, 3, e = 0.5", "rod falls flat", "spinning ball on a rough floor, mu = 0.5", "one-way clutch")
# Friction in a blow and blows at one instant have cheaper tests in `test_contacts.py`: Routh's construction, and balls
# in a row.
CHEAP = (FAST[0], FAST[3])
SMOOTH = ("two balls, m = 1, 3, e = 0.5", "block slides up an incline, rests to 1e6")


def by_columns(row):
    """The measured numbers as a function of those that the row differentiates by."""
    end, columns = end_of(system_of(row.scene), row.n, row.duration), np.array(row.columns, int)
    return (lambda y: row.measure(end(jnp.asarray(row.x).at[columns].set(y)))), np.asarray(row.x, float)[columns]


def exact_by_columns(row):
    columns = np.array(row.columns, int)
    return lambda y: jnp.asarray(row.exact(jnp.asarray(row.x, float).at[columns].set(y)))


@pytest.mark.parametrize(
    "row", sweep(ROWS.values(), kept=lambda row: row.name.startswith(CHEAP)), ids=lambda row: row.name
)
def test_motion_and_first_derivatives(row):
    measured, y = by_columns(row)
    exact = exact_by_columns(row)
    values, slopes = jax.jit(lambda y: _along(measured, y))(y)
    right, right_slopes = jax.jit(lambda y: (exact(y), jax.jacfwd(exact)(y)))(y)
    np.testing.assert_allclose(values[0], right, rtol=row.value, atol=row.value)
    if row.columns:
        _assert_slopes(slopes.T, right_slopes, row.slopes)


def _along(function, y):
    """Values and derivatives along every direction, in one program: values (m, n), one row for each of them."""
    directions = jnp.eye(max(y.size, 1), y.size)
    return jax.vmap(lambda direction: jax.jvp(function, (y,), (direction,)))(directions)


def _assert_slopes(found, right, tolerance):
    """They agree in parts of the largest one; without a tolerance they do not exist, and are NaN."""
    if tolerance is None:
        assert np.isnan(found).all()
        return
    scale = max(1.0, float(np.abs(right).max()))
    np.testing.assert_allclose(found / scale, right / scale, rtol=0.0, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("row", [row for row in ROWS.values() if row.name.startswith(FAST)], ids=lambda row: row.name)
def test_reverse_mode(row):
    measured, y = by_columns(row)
    found, right = jax.jit(jax.jacrev(measured))(y), jax.jit(jax.jacfwd(exact_by_columns(row)))(y)
    if row.only_forward:
        assert np.isnan(found).any()
        right = np.where(np.isnan(found), np.nan, right)
    _assert_slopes(found, right, row.slopes)


@pytest.mark.slow
def test_a_rod_that_falls_flat_has_no_derivative_by_its_angle():
    row = ROWS["rod falls flat on two feet, e = 0.5"]
    end = end_of(system_of(row.scene), row.n, row.duration)
    directions = np.eye(len(row.x))[np.array([1, 3])]
    slopes = jax.jit(jax.vmap(lambda d: jax.jvp(end, (jnp.asarray(row.x),), (d,))[1]))(directions)
    assert np.isnan(slopes).all()


def test_second_derivative_of_two_balls():
    row = two_balls(3, 0.5)
    (measured, y), exact = by_columns(row), exact_by_columns(row)
    direction = np.cos(np.arange(y.size))

    def second(function):
        first = lambda y: jax.jvp(function, (y,), (direction,))[1]
        return jax.jvp(first, (y,), (direction,))[1]

    found, right = jax.jit(lambda: (second(measured), second(exact)))()
    np.testing.assert_allclose(found, right, rtol=row.second, atol=row.second)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_hessian(name):
    row = ROWS[name]
    measured, y = by_columns(row)
    second = jax.jit(jax.hessian(exact_by_columns(row)))(y)
    scale = max(1.0, float(np.abs(second).max()))
    found = jax.jit(jax.jacfwd(jax.jacfwd(measured)))(y)
    np.testing.assert_allclose(found / scale, second / scale, rtol=0.0, atol=row.second)


@pytest.mark.slow
def test_two_equal_balls_exchange_their_velocities():
    row = two_balls(1, 1)
    end = end_of(system_of(row.scene), 2, 1.0)
    slopes = jax.jit(jax.grad(lambda x: end(x)[1]))(np.asarray(row.x))
    np.testing.assert_allclose(slopes[:4], [1.0, 0.0, 1.0, 0.0], atol=1e-14)


@pytest.mark.slow
def test_the_time_of_rest_and_its_derivatives():
    """The last impact is the point of accumulation, for e = 0.5, 0.8 and 0.95 in one batch."""
    system = system_of(ROWS["bouncing ball at rest, e = 0.5"].scene)

    def last(x):
        impacts = lagjax.simulate(system, x[:1], x[1:2], jnp.array([0.0, 50.0]), x[2:]).impacts
        return impacts.t[impacts.count - 1]

    x = np.array([[1.0, 0.0, 9.81, e] for e in (0.5, 0.8, 0.95)])
    found, right = (jax.jit(jax.vmap(lambda x, of=of: _along(of, x)))(x) for of in (last, rest_time))
    for ours, exact in zip(found, right, strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_of_the_time_of_rest():
    system = system_of(ROWS["bouncing ball at rest, e = 0.5"].scene)

    def last(x):
        impacts = lagjax.simulate(system, x[:1], x[1:2], jnp.array([0.0, 50.0]), x[2:]).impacts
        return impacts.t[impacts.count - 1]

    x = np.array([1.0, 0.1, 9.81, 0.8])
    exact = jax.jit(jax.hessian(rest_time))(x)
    np.testing.assert_allclose(jax.jit(jax.hessian(last))(x), exact, rtol=0.0, atol=1e-12 * np.abs(exact).max())


def _members(many, count):
    q, v, p, right = many.drawn(count)
    batch = lagjax.simulate_batch(
        system_of(many.scene), q, v, np.array([0.0, many.duration]), p, batch_axes=(0, 0, 0), rtol=1e-13
    )  # fmt: skip
    assert batch.ok.all()
    np.testing.assert_allclose(batch.qdot[:, -1], right, rtol=0.0, atol=many.value)


def test_a_few_shaken_blocks():
    _members(MANY["shaken blocks: stick, slip, reverse"], 6)


@pytest.mark.slow
@pytest.mark.parametrize("many", MANY.values(), ids=lambda many: many.name)
def test_all_of_many(many):
    _members(many, many.count)


# ---- the closed forms themselves, by a reference that enumerates modes ----------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "row", [row for row in ROWS.values() if row.name.startswith(FAST)] + [billiard(10.0)], ids=lambda row: row.name
)  # fmt: skip
def test_closed_forms_are_those_of_a_reference_that_enumerates_modes(row):
    q, v, p = np.split(row.x, [row.n, 2 * row.n])
    duration = min(row.duration, 20.0)  # all that last longer rest by then, for which DOP853 takes long
    motion = Reference(row.scene, q, p).run(q, v, duration, p)
    np.testing.assert_allclose(row.measure(motion.z), row.exact(row.x), atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("many", MANY.values(), ids=lambda many: many.name)
def test_piecewise_closed_forms_are_those_of_a_reference_that_enumerates_modes(many):
    q, v, p, right = many.drawn(2)
    reference = Reference(many.scene, q[0], p[0])
    for member in zip(q, v, p, right, strict=True):
        motion = reference.run(member[0], member[1], many.duration, member[2])
        np.testing.assert_allclose(motion.z[reference.n :], member[3], atol=1e-11)
