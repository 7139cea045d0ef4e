"""Learned functions: their splines beside SciPy's, in machine code, and what a fit learns from motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from scenes import in_potential

import lagjax
from lagjax.learned import dissipation, inertia, potential

WELL = potential((-1.5, 1.5), count=24)
well = lagjax.System(lambda q, v, params: 0.5 * v**2 - WELL(q, params=params))
FRICTION = dissipation((0.0, 2.0), count=10)
block = lagjax.System(
    lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params: FRICTION(v, params=params)
)  # fmt: skip
STILL = lagjax.Record([0.0, 1.0], [0.0, 0.0])


def double_well(q):
    return 0.25 * q**4 - 0.5 * q**2


duffing = lagjax.System(lambda q, v: 0.5 * v**2 - double_well(q))
spring = lagjax.System(lambda q, v: 0.5 * v**2 - 2.0 * q**2)


def oscillator_with(law, k=0.0):
    return lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * k * q**2 - law(q, params=params))


def damped_spring(law, size):
    return lagjax.System(
        lambda q, v, params: size * (0.5 * v**2 - 0.5 * params["k"] * q**2),
        forces=lambda q, v, params: law(v, params=params["R"]),
    )


def test_a_spline_is_the_natural_one_of_scipy():
    """Its second derivative is zero at the ends, and it is a straight line beyond them."""
    params, [knots] = WELL.interpolate(double_well), WELL.knots
    natural = scipy.interpolate.CubicSpline(knots, double_well(knots), bc_type="natural")
    x = np.concatenate([np.random.default_rng(0).uniform(-1.5, 1.5, 40), knots])
    value = lambda x: WELL(x, params=params)
    slope, bend = jax.vmap(jax.grad(value)), jax.vmap(jax.grad(jax.grad(value)))
    np.testing.assert_allclose(value(x), natural(x) - natural(0.0), atol=1e-13)
    np.testing.assert_allclose(slope(x), natural(x, 1), atol=1e-12)
    np.testing.assert_allclose(bend(x[:40]), natural(x[:40], 2), atol=1e-10)
    np.testing.assert_allclose(value(2.5), value(1.5) + natural(1.5, 1), rtol=1e-12)
    np.testing.assert_allclose(slope(np.array([-9.0, 9.0])), natural(np.array([-1.5, 1.5]), 1), rtol=1e-12)


def test_two_arguments_are_a_product_of_splines():
    V = potential(((-1.0, 1.0), (0.0, 2.0)), count=(6, 8))
    params = V.interpolate(lambda x, y: (1 + x) * (2 - y))  # a product of straight lines is one of splines
    x, y = np.random.default_rng(0).uniform([-1.0, 0.0], [1.0, 2.0], (10, 2)).T
    np.testing.assert_allclose(V(x, y, params=params), (1 + x) * (2 - y) - 1.0, atol=1e-12)
    np.testing.assert_allclose(V(jnp.stack([x, y], axis=1), params=params), V(x, y, params=params))


def test_a_period_closes():
    V = potential((-np.pi, np.pi), count=24, periodic=True)
    params, x = V.interpolate(np.cos), np.linspace(-9.0, 9.0, 50)
    np.testing.assert_allclose(V(x, params=params), np.cos(x) - 1.0, atol=2e-5)  # h⁴ max|S''''| 5/384
    np.testing.assert_allclose(V(x + 2 * np.pi, params=params), V(x, params=params), atol=1e-12)


def test_machine_code_follows_a_spline():
    """Beside diffrax, with derivatives by numbers and start, over knots and beyond the range."""
    import diffrax

    params, ts = WELL.interpolate(double_well), np.linspace(0.0, 6.0, 13)
    run = lambda start, params, **more: lagjax.simulate(well, start, 0.0, ts, params, **more).q
    by_diffrax = run(1.55, params, solver=diffrax.Dopri8(), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run(1.55, params), by_diffrax, atol=1e-7)
    slopes = jax.jit(jax.jacfwd(lambda start, params: run(start, params)[-1], argnums=(0, 1)))
    by_start, by_params = slopes(1.2, params)
    h = 1e-5
    np.testing.assert_allclose(by_start, (run(1.2 + h, params)[-1] - run(1.2 - h, params)[-1]) / (2 * h), rtol=1e-5)
    direction = np.random.default_rng(0).normal(size=24)
    ends = [run(1.2, params | {"spline": params["spline"] + s * direction})[-1] for s in (-h, h)]
    np.testing.assert_allclose(by_params["spline"] @ direction, (ends[1] - ends[0]) / (2 * h), rtol=1e-5)


def test_friction_never_drives_and_inertia_is_positive():
    rng, v = np.random.default_rng(0), np.linspace(-5.0, 5.0, 41)
    for R in (FRICTION, dissipation((0.0, 2.0), dry=False), dissipation((-2.0, 2.0), odd=False)):
        for _ in range(5):
            params = R.params0 | {"spline": 2 * rng.normal(size=R.params0["spline"].shape)}
            assert (R(v, params=params) * v <= 0.0).all()
    M = inertia((-1.0, 1.0), count=5)
    assert (M(v, params=M.params0 | {"spline": 3 * rng.normal(size=5)}) > 0).all()


def record_motion(system, starts, params=None, noise=1e-3, end=12.0):
    rng, ts = np.random.default_rng(1), np.linspace(0.0, end, 201)
    motions = [np.asarray(lagjax.simulate(system, *start, ts, params).q) for start in starts]
    return [lagjax.Record(ts, q + noise * rng.normal(size=q.shape)) for q in motions]


def deviations(fit, values):
    """By how many standard deviations `values(params)` (K,) are off those given."""

    def of_spline(spline):
        return values(fit.params | {"spline": spline})

    jacobian = jax.jacfwd(of_spline)(jnp.asarray(fit.params["spline"]))
    return np.sqrt(np.einsum("kf,fg,kg->k", jacobian, np.asarray(fit.covariance.matrix), jacobian))


def test_a_potential_is_learned_where_it_was_seen():
    true = WELL.interpolate(double_well)
    fit = lagjax.fit(well, record_motion(well, [(1.45, 0.1)], true), WELL.params0)
    assert fit.ok and not fit.unseen
    x = np.linspace(-1.2, 1.3, 11)
    values = lambda params: WELL(x, params=params) - WELL(0.9, params=params)
    off, spread = values(fit.params) - values(true), deviations(fit, values)
    assert np.abs(off).max() < 0.01 and (np.abs(off) < 4 * spread + 1e-9).all() and spread.max() < 0.02


@pytest.mark.slow  # another fit of the same
def test_a_place_that_was_not_seen_has_a_wide_interval():
    true = WELL.interpolate(double_well)
    fit = lagjax.fit(well, record_motion(well, [(1.3, 0.0)], true), WELL.params0)
    assert "was seen from 0." in fit.message
    values = lambda params: jnp.stack([WELL(x, params=params) - WELL(0.9, params=params) for x in (-1.0, 1.1)])
    unseen, seen = deviations(fit, values)
    assert unseen > 20 * seen


@pytest.mark.slow  # a fit of motion that sticks
def test_friction_is_learned():
    stribeck = lambda v: 0.05 + 0.05 * np.exp(-v / 0.3) + 0.03 * v
    true = FRICTION.interpolate(stribeck)
    start = FRICTION.interpolate(lambda v: 0.1)
    slow_and_fast = record_motion(block, [(0.8, 0.0), (1.8, 0.0)], true, noise=3e-4)
    fit = lagjax.fit(block, slow_and_fast, start)
    v = np.array([0.2, 0.5, 1.0, 1.3])
    np.testing.assert_allclose(-FRICTION(v, params=fit.params), stribeck(v), rtol=0.05)
    assert fit.ok, fit.message  # neither contradicts the other by what it alone has seen


def test_a_rougher_function_has_a_weaker_prior():
    """The strength of what is nearly a straight line, and of a double well."""
    found = []
    for bend in (0.02, 1.0):
        line = WELL.interpolate(lambda q, bend=bend: 0.5 * q + bend * double_well(q))
        records = record_motion(well, [(-0.9, 0.8)], line, end=2.0)
        message = lagjax.fit(well, records, WELL.params0).message
        found.append(float(message.split("Data determine ")[1].split()[0]))
    assert found[0] < found[1] - 0.5


def test_too_few_knots_are_not_ok():
    """The well of Duffing is no spline of eight knots: intervals would be ten times too narrow beside its ends."""
    [record] = record_motion(duffing, [(1.45, 0.1)], {})
    law = potential((-1.5, 1.5), count=8)
    fit = lagjax.fit(oscillator_with(law), record, law.params0)
    assert not fit.ok and "Take a larger count" in fit.message


@pytest.mark.parametrize(("ends", "ok", "words"), [
    ((5.0, 9.0), False, "no motion was measured between the ends of its range"),
    ((-3.0, 3.0), True, "a straight line, where motion saw it, from -1.67 to 1.67;"),
])  # fmt: skip
def test_a_straight_line_is_said_to_be_one_and_a_range_without_motion_is_not_ok(ends, ok, words):
    law = potential(ends, count=10)
    [record] = record_motion(spring, [(1.0, 0.0)], {})
    fit = lagjax.fit(oscillator_with(law, 4.0), record, law.params0)
    assert fit.ok == ok and words in fit.message, fit.message


@pytest.mark.parametrize(("size", "begin"), [pytest.param(1e-3, 1e-3, marks=pytest.mark.slow), (1e9, 1.0)])
def test_friction_that_begins_far_from_its_size_is_found(size, begin):
    """Nine orders too small, too; of a straight line in the logarithm evidence makes the prior as strong as it can be,
    and all that is free is seen beside it."""
    law = dissipation((0.0, 2.5), count=6, dry=False)
    scene = damped_spring(law, size)
    true = {"k": 4.0, "R": law.interpolate(lambda v: 0.1 * size)}
    ts, rng = np.linspace(0.0, 10.0, 101), np.random.default_rng(0)
    record = lagjax.Record(ts, lagjax.simulate(scene, 1.0, 0.0, ts, true).q + 1e-3 * rng.normal(size=ts.size))
    fit = lagjax.fit(scene, record, {"k": 3.0, "R": law.interpolate(lambda v: begin)})
    assert fit.ok and not fit.unseen, fit
    low, high = fit.intervals(0.999)
    assert low["k"] < 4.0 < high["k"]
    assert (low["R"]["spline"] < np.log(0.1 * size)).all() and (np.log(0.1 * size) < high["R"]["spline"]).all()
    np.testing.assert_allclose(law(1.0, params=fit.params["R"]), -0.1 * size, rtol=0.02)


@pytest.mark.parametrize("mass", [1e-9, pytest.param(1e24, marks=pytest.mark.slow)])
def test_other_units_change_no_digit(mass):
    """A potential in other units of energy, with a mass in other units, has the same motion and the same evidence."""

    def learn(mass):
        scene = lagjax.System(lambda q, v, params: 0.5 * mass * v**2 - WELL(q, params=params))
        return lagjax.fit(scene, records, WELL.params0)

    records = record_motion(well, [(1.45, 0.1)], WELL.interpolate(double_well), noise=1e-2, end=6.0)
    one, other = learn(1.0), learn(mass)
    scale = np.abs(one.params["spline"]).max()
    np.testing.assert_allclose(other.params["spline"] / mass, one.params["spline"], atol=1e-4 * scale)
    np.testing.assert_allclose(other.covariance.matrix / mass**2, one.covariance.matrix, rtol=1e-2, atol=1e-6 * scale)
    assert one.ok and other.ok and one.message == other.message


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: potential((1.0, 0.0)), "must increase"),
        (lambda: potential("wide"), "one to three"),
        (lambda: potential((0.0, 1.0), count=3), "4 or larger"),
        (lambda: dissipation((-1.0, 1.0)), "not negative"),
        (lambda: WELL(0.0, params={"spline": np.zeros(3)}), "shape"),
        (lambda: lagjax.fit(well, STILL, WELL.params0, transforms=lagjax.positive), "transform"),
        (lambda: lagjax.fit(well, STILL, WELL.params0, method="gradient"), "no smoothness"),
    ],
)  # fmt: skip
def test_a_mistake_is_a_sentence(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


@pytest.mark.slow
def test_a_curved_function_of_dense_knots_is_not_said_to_be_straight():
    ts = np.linspace(0.0, 10.0, 501)
    swing = lagjax.simulate(in_potential(lambda q: -9.81 * jnp.cos(q)), 1.0, 0.0, ts).q
    V = potential((-1.5, 1.5), count=60)
    scene = lagjax.System(lambda q, v, params: 0.5 * v**2 - V(q, params=params["V"]))
    record = lagjax.Record(ts, swing + 0.002 * np.random.default_rng(1).normal(size=501))
    fit = lagjax.fit(scene, record, {"V": V.params0})
    assert fit.ok and "which was seen from -1.0" in fit.message and "straight" not in fit.message, fit.message
