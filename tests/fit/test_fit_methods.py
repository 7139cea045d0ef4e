"""Transforms of whole leaves, many starts, sampling, reports and other methods of a fit."""

import importlib
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import lagjax
from lagjax._fit import Parameters, Unbounded

TS = np.linspace(0.0, 4.0, 101)
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def examples_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


# ---- transforms ------------------------------------------------------------------------------------------------------


def body(rng):
    """The ten inertial numbers of thirty points, and their pseudo-inertia."""
    points, masses = np.append(rng.normal(size=(30, 3)), np.ones((30, 1)), axis=1), rng.uniform(0.1, 1.0, 30)
    pseudo = points.T @ (masses[:, None] * points)
    moments = np.trace(pseudo[:3, :3]) * np.eye(3) - pseudo[:3, :3]
    xy = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    return np.array([pseudo[3, 3], *pseudo[:3, 3], *(moments[place] for place in xy)]), pseudo


TEN, PSEUDO = body(np.random.default_rng(0))


@pytest.mark.parametrize(
    "transform, start",
    [
        (lagjax.inertia, TEN),
        (lagjax.inertia, PSEUDO),
        (lagjax.simplex, np.array([0.2, 0.5, 0.1, 1.0])),
        (lagjax.angle, np.array([1.0, -3.0])),
        (lagjax.between(-1.0, 4.0), np.array([0.1, 3.0])),
    ],
)
def test_transforms_of_leaves_are_inverses_with_the_derivatives_of_differences(transform, start):
    x, rng = start.ravel(), np.random.default_rng(1)
    own = transform.specialize(x, start.shape)
    assert own.refuses(x) is None
    u = own.inverse(x)
    assert len(u) == own.count_unknowns(len(x))
    np.testing.assert_allclose(own.value(u), x, atol=1e-12)
    other = u + 0.3 * rng.normal(size=len(u))
    central = [(own.value(other + e) - own.value(other - e)) / 2e-6 for e in 1e-6 * np.eye(len(u))]
    np.testing.assert_allclose(own.jacobian(other), np.transpose(central), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(own.value(np.asarray(u), jnp), x, rtol=1e-6)
    if start.shape != (4, 4):  # a matrix holds every product twice
        volume = [0.5 * np.linalg.slogdet(own.jacobian(at).T @ own.jacobian(at))[1] for at in (u, other)]
        assert own.log_volume(u) - own.log_volume(other) == pytest.approx(volume[0] - volume[1])
    low, high = own.ends(x, 0.1 * np.ones(len(x)))
    assert (low < x).all() and (x < high).all()


def test_an_interval_that_does_not_exclude_a_bound_ends_there_and_is_no_power_of_ten():
    x, spread = np.array([4e-4, 1.0, 1.0, 2.0]), np.array([0.04, 0.1, np.inf, 2.0])
    low, high = lagjax.positive.ends(x, spread)
    np.testing.assert_allclose(low, [0.0, np.exp(-0.1), 0.0, 0.0])
    np.testing.assert_allclose(high, [0.0404, np.exp(0.1), np.inf, 4.0])
    low, high = lagjax.between(0.0, 1.0).ends(np.array([0.5, 0.99, 0.01]), np.array([0.1, 0.1, np.inf]))
    np.testing.assert_allclose(low, [1 / (1 + np.exp(0.4)), 0.89, 0.0])
    np.testing.assert_allclose(high, [1 / (1 + np.exp(-0.4)), 1.0, 1.0])
    low, high = Unbounded().ends(np.array([1.0, 1.0]), np.array([2.0, np.inf]))
    assert (low == [-1.0, -np.inf]).all() and (high == [3.0, np.inf]).all()


def masses(q, qdot, params):
    return 0.5 * jnp.sum(params["m"] * qdot**2) - 0.5 * jnp.sum(q**2) - 0.5 * params["k"] * (q[0] - q[1]) ** 2


MASSES = lagjax.System(masses)


def test_numbers_of_an_array_are_free_one_by_one():
    # Two masses that swing apart from each other: a factor of all masses and springs is not seen, and one mass is kept.

    truth = {"k": 2.0, "m": np.array([1.5, 0.7])}
    q = lagjax.simulate(MASSES, np.array([1.0, -0.3]), np.zeros(2), TS, truth).q
    fit = lagjax.fit(
        MASSES, lagjax.Record(TS, np.asarray(q)), {"k": 2.0, "m": np.array([1.5, 1.0])},
        free={"k": True, "m": np.array([False, True])}, transforms=lagjax.positive,
    )  # fmt: skip
    assert fit.covariance.names == ("params['k']", "params['m'][1]") and fit.ok
    assert fit.params["m"][0] == 1.5 and fit.params["m"][1] == pytest.approx(0.7, rel=1e-6)
    assert fit.intervals()[0]["m"][0] == 1.5
    shares = {"shares": np.array([0.2, 0.3, 0.5])}
    with pytest.raises(ValueError, match=r"array of them of the shape \(3,\) for params\['shares'\]; got one of"):
        Parameters.from_pytree(shares, {"shares": np.array([True, False])})
    with pytest.raises(ValueError, match=r"free as a whole or not at all: its transform is lagjax\.simplex"):
        Parameters.from_pytree(shares, {"shares": np.array([True, False, True])}, lagjax.simplex)


def test_every_u_is_an_inertia_that_a_body_can_have():
    for u in np.random.default_rng(2).normal(size=(50, 10)):
        x = lagjax.inertia.value(u)
        m, *_, xx, yy, zz, _, _, _ = x
        assert m > 0 and xx + yy > zz and yy + zz > xx and zz + xx > yy
        assert lagjax.inertia.refuses(x) is None


def lagrangian(q, qdot, params):
    """An oscillator under three springs, whose strengths are shares; and a bead in the field of a turned dipole."""
    spring = jnp.sum(params["shares"] * jnp.array([1.0, 4.0, 9.0]))
    return 0.5 * jnp.sum(qdot**2) - 0.5 * spring * q[0] ** 2 - 0.5 * q[1] ** 2 + jnp.cos(q[1] - params["phase"])


SCENE = lagjax.System(lagrangian)


def record(params, sigma=1e-2, seed=0):
    start = np.array([1.0, 0.5]), np.array([0.0, 1.0])
    q = np.asarray(lagjax.simulate(SCENE, *start, TS, params).q)
    return lagjax.Record(TS, q + sigma * np.random.default_rng(seed).normal(size=q.shape))


def test_an_angle_is_found_over_the_turn_and_a_simplex_keeps_its_sum():
    truth = {"shares": np.array([0.5, 0.3, 0.2]), "phase": np.array(3.1)}
    fit = lagjax.fit(
        SCENE,
        record(truth),
        {"shares": np.array([0.2, 0.3, 0.5]), "phase": np.array(-2.9)},
        transforms={"shares": lagjax.simplex, "phase": lagjax.angle},
    )
    low, high = fit.intervals(0.999)
    assert low["phase"] < 3.1 < high["phase"] and -np.pi < fit.params["phase"] <= np.pi
    assert np.sum(fit.params["shares"]) == pytest.approx(1.0, abs=1e-12) and len(fit.u) == 3
    # One frequency tells one combination of two free shares, and its intervals are those of nothing.
    assert fit.params["shares"] @ [1.0, 4.0, 9.0] == pytest.approx(0.5 + 1.2 + 1.8, rel=0.02)
    assert len(fit.unseen) == 1 and "params['shares'][0], params['shares'][1]" in fit.unseen[0], fit.unseen
    assert (low["shares"] == 0).all() and (high["shares"] == 1).all()
    assert fit.covariance.matrix.shape == (4, 4)
    with pytest.raises(ValueError, match="moves only together with the other numbers of"):
        fit.profile("params['shares'][1]")


PARAMS = {"shares": np.ones(3), "phase": 0.0}


@pytest.mark.parametrize(
    "start, transform, message",
    [
        (np.array([1.0]), lagjax.simplex, "several numbers above zero"),
        (np.array([1.0, 0.0]), lagjax.simplex, "several numbers above zero"),
        (np.ones(9), lagjax.inertia, r"shape \(10,\) or \(4, 4\)"),
        (np.array([1.0, 0, 0, 0, 1.0, 1.0, 5.0, 0, 0, 0]), lagjax.inertia, "density is positive everywhere"),
    ],
)
def test_a_leaf_that_starts_outside_of_its_set_is_refused(start, transform, message):
    with pytest.raises(ValueError, match=message):
        lagjax.fit(
            SCENE,
            lagjax.Record(TS, np.zeros((len(TS), 2))),
            PARAMS | {"x": start},
            transforms={"shares": None, "phase": None, "x": transform},
        )


def test_the_sum_of_a_simplex_is_that_of_its_start():
    own = lagjax.simplex.specialize(np.array([1.0, 2.0, 4.0]), (3,))
    assert np.sum(own.value(np.array([0.3, -2.0]))) == pytest.approx(7.0)


# ---- the density and its draws ---------------------------------------------------------------------------------------


def spring(q, qdot, params):
    return 0.5 * qdot**2 - 0.5 * params["k"] * q**2


SPRING = lagjax.System(spring, forces=lambda q, v, params: -params["c"] * v)
TWO_MINIMA = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * (2 + jnp.cos(3 * params) + 0.1 * params) * q**2)
DRIVEN_SPRING = lagjax.System(spring, forces=lambda q, v, params, inputs: inputs - params["c"] * v)
SHORT = np.linspace(0.0, 3.0, 61)


def spring_records(noise=lambda rng, shape: rng.normal(size=shape), count=2, seed=0):
    rng = np.random.default_rng(seed)
    values = np.asarray(
        lagjax.simulate_batch(SPRING, np.linspace(1.0, 2.0, count), np.zeros(count), SHORT, {"k": 4.0, "c": 0.3}).q
    )
    return [lagjax.Record(SHORT, y + 0.02 * noise(rng, y.shape)) for y in values]


def spring_fit(noise=None, **more):
    return lagjax.fit(SPRING, spring_records(**more), {"k": 3.0, "c": 0.2}, transforms=lagjax.positive, noise=noise)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [lagjax.Gaussian(), lagjax.StudentT(4.0), lagjax.StudentT()])
def test_the_density_has_the_gradient_of_differences_and_the_curvature_of_the_fit(noise):
    fit = spring_fit(noise)
    density = fit.log_density(prior=lambda params: -0.1 * params["k"])
    value, gradient = (jax.jit(f) for f in (density, jax.grad(density)))
    x = density.first + 0.01 * np.random.default_rng(0).normal(size=len(density))
    steps = 1e-5 * np.eye(len(x))
    central = [(value(x + step) - value(x - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(gradient(x), central, rtol=1e-5, atol=1e-4)
    # Expected and observed information differ like the inverse root of the samples.
    curvature = -np.stack([(gradient(density.first + s) - gradient(density.first - s)) / 2e-5 for s in steps])
    known = 2 + 2 * 2
    ratio = np.sqrt(np.diag(np.linalg.inv(curvature)) / np.diag(density.covariance()))[:known]
    np.testing.assert_allclose(ratio, 1.0, atol=0.05 if isinstance(noise, lagjax.Gaussian) else 0.2)
    assert density.names[:3] == ("params['c']", "params['k']", "starts[0].q") and len(density) == len(density.names)
    assert density(jnp.full(len(x), 500.0)) == -jnp.inf


def test_what_is_not_seen_has_no_covariance_to_draw_by():
    params = {"k": 3.0, "c": 0.2, "colour": 1.0}
    fit = lagjax.fit(SPRING, spring_records(), params)
    with pytest.raises(ValueError, match=r"Nothing that was measured depends on params\['colour'\]"):
        fit.log_density().covariance()


# ---- many starts -----------------------------------------------------------------------------------------------------


def many(**more):
    # Sensors of no structure that a start could be read off: whole records from the first trial on.
    ts = np.linspace(0.0, 20.0, 201)
    q = np.asarray(lagjax.simulate(SPRING, 1.0, 0.0, ts, {"k": 36.0, "c": 0.02}).q)
    values = {"seen": q + 0.02 * np.random.default_rng(0).normal(size=q.shape)}
    one = lagjax.Record(ts, values, start=lagjax.Guess(1.0, 0.0))
    return lagjax.fit(
        SPRING, one, {"k": 900.0, "c": 0.02}, transforms=lagjax.positive, observe=lambda q, v: {"seen": q}, **more
    )


@pytest.mark.slow
def test_many_starts_find_a_frequency_that_one_does_not(capfd):
    one, fit = many(), many(starts=64, progress=True)
    assert abs(one.params["k"] - 36.0) > 1.0 and one.waterfall is None
    assert abs(fit.params["k"] - 36.0) < 0.05 and max(fit.rms.values()) < 0.025
    falls = fit.waterfall.misfits
    assert len(falls) == 64 and (np.diff(falls) >= 0).all() and falls[-1] > 10 * falls[0]
    assert "starts      64, of which" in str(fit)
    assert "motions, residuals" in capfd.readouterr().err
    again = many(starts=64)
    np.testing.assert_array_equal(again.u, fit.u)
    np.testing.assert_array_equal(again.waterfall.misfits, falls)


def test_many_starts_find_the_deeper_of_two_minima():
    # A stiffness that rises and falls with x: from 1.0 the way down ends at the bound.
    q = np.asarray(lagjax.simulate(TWO_MINIMA, 1.0, 0.0, TS, 2.2).q)
    one = lagjax.Record(TS, q + 0.01 * np.random.default_rng(0).normal(size=q.shape))
    stuck, fit = (lagjax.fit(TWO_MINIMA, one, 1.0, transforms=lagjax.between(0.8, 4.0), starts=k) for k in (1, 8))
    assert stuck.rms["q"] > 0.3 and fit.rms["q"] < 0.012


def test_starts_are_a_whole_number():
    with pytest.raises(ValueError, match="starts must be a positive whole number"):
        many(starts=0)


# ---- what to measure next, and the report ----------------------------------------------------------------------------


def plan(duration, start=(1.0, 0.0), **more):
    ts = np.linspace(0.0, duration, 61)
    return lagjax.Record(ts, np.full(len(ts), np.nan), start=start, **more)


def test_the_gain_of_an_experiment_is_that_of_the_fit_with_its_data():
    fit = spring_fit()
    plans = {"rest": plan(3.0, (0.0, 0.0)), "long": plan(9.0), "unknown start": plan(9.0, lagjax.Guess(1.0, 0.0))}
    table = fit.next_experiment(plans)
    assert table.names == ("long", "unknown start", "rest") and table.gain[2] == pytest.approx(0.0, abs=1e-9)
    assert (table.deviations[0] < table.deviations[1]).all() and (table.deviations <= 1 + 1e-9).all()
    assert "long" in str(table).splitlines()[1]
    # Measured: noise of the size that the fit estimated, at the fitted parameters.
    exact = fit.predict(lagjax.Record(plans["long"].ts, np.zeros(61), start=(1.0, 0.0))).values
    values = exact + fit.noise["q"].sigma * np.random.default_rng(5).normal(size=61)
    more = [*spring_records(), lagjax.Record(plans["long"].ts, values, start=(1.0, 0.0))]
    after = lagjax.fit(SPRING, more, fit.params, transforms=lagjax.positive)
    logs = [np.linalg.slogdet(f.information.covariance)[1] for f in (fit, after)]
    assert logs[0] - logs[1] == pytest.approx(table.gain[0], rel=0.2)


def magnet(q, v, params):
    return 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2 - jnp.exp(5.0 * (q - 8.0))


MAGNET = lagjax.System(magnet)


def test_an_experiment_that_sees_what_is_not_seen_comes_first():
    # Free motion tells k/m alone; the force of a magnet at large q tells m.

    values = np.asarray(lagjax.simulate(MAGNET, 1.0, 0.0, SHORT, {"m": 1.0, "k": 4.0}).q)
    one = lagjax.Record(SHORT, values + 0.02 * np.random.default_rng(0).normal(size=values.shape))
    fit = lagjax.fit(MAGNET, one, {"m": 1.0, "k": 3.0}, transforms=lagjax.positive)
    assert len(fit.unseen) == 1
    table = fit.next_experiment([plan(9.0), plan(1.0, (7.0, 0.0))])
    assert table.names == ("[1]", "[0]") and table.newly_seen.tolist() == [1, 0]


def test_a_planned_record_needs_a_start_and_there_must_be_one():
    fit = spring_fit()
    with pytest.raises(ValueError, match=r"planned record \[0\] needs a start"):
        fit.next_experiment([plan(1.0, None)])
    with pytest.raises(ValueError, match="candidates is empty"):
        fit.next_experiment([])


@pytest.mark.slow
def test_a_report_is_one_file_with_everything(tmp_path):
    file = tmp_path / "fit.html"
    fit = lagjax.fit(SPRING, spring_records(), {"k": 3.0, "c": 0.2}, transforms=lagjax.positive, starts=4)
    fit.report(file, experiments={"a long one": plan(9.0)})
    text = file.read_text()
    for part in (
        "params[&#x27;k&#x27;]",
        "converged",
        "noise σ",
        "Data over fit",
        "Waterfall",
        "Correlations",
        "a long one",
    ):
        assert part in text
    assert text.count("data:image/png;base64,") == 2 + 3 and "http" not in text
    axes = lagjax.plot.fit(fit, record=1)
    assert axes.shape == (2, 1) and axes[1][0].get_ylabel() == "residual"


# ---- first values that are far off, and gradients --------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_accelerations_of_local_cubics_begin_where_parameters_are_far_off(factor):
    ts = np.linspace(0.0, 12.0, 241)
    q = np.asarray(lagjax.simulate(SPRING, 2.0, 0.0, ts, {"k": 4.0, "c": 0.3}).q)
    one = lagjax.Record(ts, q + 0.02 * np.random.default_rng(0).normal(size=q.shape))
    fit = lagjax.fit(SPRING, one, {"k": 4.0 * factor, "c": 0.3 * factor}, transforms=lagjax.positive)
    assert fit.ok and fit.params["k"] == pytest.approx(4.0, rel=0.01) and fit.params["c"] == pytest.approx(0.3, rel=0.1)


OSCILLATOR = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
PENDULUM = lagjax.System(lambda q, v, params: 0.5 * v**2 + params["k"] * jnp.cos(q))


def test_first_samples_find_a_frequency_where_starts_are_known():
    # Over seven periods the sum of squares has many minima; the sine of an angle is no position to read a start off.
    ts = np.linspace(0.0, 20.0, 401)
    motion = lagjax.simulate(PENDULUM, 1.0, 0.0, ts, {"k": 5.0})
    values = {"sine": np.sin(np.asarray(motion.q)) + 1e-3 * np.random.default_rng(0).normal(size=ts.size)}
    record = lagjax.Record(ts, values, start=(1.0, 0.0))
    settings = {"observe": lambda q, v: {"sine": jnp.sin(q)}, "transforms": lagjax.positive}
    assert not lagjax.fit(PENDULUM, record, {"k": 2.0}, method="whole", **settings).ok
    found = lagjax.fit(PENDULUM, record, {"k": 2.0}, **settings)
    assert found.ok and found.params["k"] == pytest.approx(5.0, abs=1e-3)


@pytest.mark.parametrize("fitted", [False, True])
def test_hundreds_of_records_have_the_least_squares_of_scipy(fitted):
    rng, ts = np.random.default_rng(0), 0.2 * np.arange(5)
    starts = rng.normal(size=(400, 2))

    def motions(k, starts):
        w, (q, v) = np.sqrt(k), starts.T[..., None]
        return q * np.cos(w * ts) + v / w * np.sin(w * ts)

    shown = motions(2.0, starts) + 1e-2 * rng.normal(size=(400, 5))
    begin = lagjax.Guess if fitted else lambda *pair: pair
    records = [lagjax.Record(ts, {"x": x}, start=begin(*y)) for x, y in zip(shown, starts, strict=True)]
    found = lagjax.fit(OSCILLATOR, records, {"k": 1.0}, observe=lambda q, v: {"x": q})

    def residuals(x):
        if not fitted:
            return np.ravel(motions(x[0], starts) - shown)
        w = np.sqrt(x[0])  # the starts enter linearly, and alike for all records
        shape = np.stack([np.cos(w * ts), np.sin(w * ts) / w], axis=1)
        return np.ravel(shown @ (shape @ np.linalg.pinv(shape)) - shown)

    best = least_squares(residuals, [1.0], xtol=1e-12, ftol=1e-12)
    error = 1e-2 / np.linalg.norm(best.jac)
    assert found.ok and found.params["k"] == pytest.approx(best.x[0], abs=0.05 * error)
    assert np.sqrt(found.covariance.matrix[0, 0]) == pytest.approx(error, rel=0.2)


@pytest.mark.slow
def test_gradients_come_to_the_same_as_gauss_and_newton():
    whole, fit = (
        lagjax.fit(SPRING, spring_records(), {"k": 3.0, "c": 0.2}, transforms=lagjax.positive, method=method)
        for method in ("whole", "gradient")
    )
    deviation = np.sqrt(np.diag(whole.covariance.matrix))
    values = [np.array([f.params["c"], f.params["k"]]) for f in (whole, fit)]
    np.testing.assert_allclose((values[1] - values[0]) / deviation, 0.0, atol=0.1)
    np.testing.assert_allclose(fit.covariance.matrix, whole.covariance.matrix, rtol=0.05)
    assert "came to rest" in fit.message


@pytest.mark.slow  # takes half a minute: the one fit of a network, to all of the example's nine records
def test_a_network_learns_the_potential_of_its_recordings():
    example = importlib.import_module("learned_potential")
    values, exact, starts = example.recordings()
    fit = example.learned(values[:9])
    assert fit.rms["q"] < 1.1 * example.SIGMA and fit.params["c"] == pytest.approx(example.FRICTION, rel=0.2)
    assert max(example.held_out_errors(fit, exact[9:], starts[9:])) < 3 * example.SIGMA
    assert any("layers[2].bias[0]" in sentence for sentence in fit.unseen)
    assert "144 numbers" in str(fit) and len(str(fit).splitlines()) < 30


def test_gradients_begin_once_and_need_optax(monkeypatch):
    with pytest.raises(ValueError, match="leave `starts` at 1"):
        many(method="gradient", starts=2)
    monkeypatch.setitem(sys.modules, "optax", None)
    with pytest.raises(ImportError, match="needs the package optax"):
        many(method="gradient")


@pytest.mark.slow
def test_inputs_drive_the_density_and_many_starts():
    ts, rng = np.linspace(0.0, 6.0, 121), np.random.default_rng(0)
    push = np.sin(1.3 * ts) + 0.3 * rng.normal(size=len(ts))
    truth = lagjax.System(spring, forces=lambda q, v, t, params: lagjax.samples(ts, push)(t) - 0.3 * v)
    q = np.asarray(lagjax.simulate(truth, 1.0, 0.0, ts, {"k": 4.0}).q)
    one = lagjax.Record(ts, q + 0.01 * rng.normal(size=q.shape), inputs=push)
    fit = lagjax.fit(DRIVEN_SPRING, one, {"k": 0.3, "c": 0.2}, transforms=lagjax.positive, starts=8)
    assert fit.params["k"] == pytest.approx(4.0, rel=0.02) and fit.params["c"] == pytest.approx(0.3, rel=0.1)
    density = fit.log_density()
    value, x = jax.jit(density), density.first + 0.01 * rng.normal(size=len(density))
    central = [(value(x + step) - value(x - step)) / 2e-5 for step in 1e-5 * np.eye(len(x))]
    np.testing.assert_allclose(jax.jit(jax.grad(density))(x), central, rtol=1e-5, atol=1e-4)
