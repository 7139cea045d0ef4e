"""Profiles of a fit, intervals of its starts and bands of its predictions, on one scene: an oscillator."""

import numpy as np
import pytest
from lagrangians import mass_on_a_spring
from scipy.special import stdtrit

import lagjax
from lagjax._fit import Parameters

SIGMA = 0.02
TS = np.linspace(0.0, 6.0, 121)


def lagrangian(q, qdot, params):
    return 0.5 * qdot**2 - 0.5 * params["root"] ** 2 * q**2 + params["colour"] * qdot


def dissipation(q, qdot, params):
    return 0.5 * params["c"] * qdot**2


SCENE = lagjax.System(lagrangian, dissipation=dissipation)
DAMPED_SPRING = lagjax.System(
    mass_on_a_spring,
    forces=lambda q, v, params: -params["c"] * v,
)
TRUTH = {"root": 1.5, "c": 0.1, "colour": 1.0}


def record(seed=0, c=0.1, start=None):
    ringing = np.sqrt(1.5**2 - 0.25 * c**2)
    exact = np.exp(-0.5 * c * TS) * (np.cos(ringing * TS) + 0.5 * c / ringing * np.sin(ringing * TS))
    return lagjax.Record(TS, exact + SIGMA * np.random.default_rng(seed).normal(size=len(TS)), start=start)


def fitted(one=None, c=0.1, free=("root", "c"), positive=()):
    names = TRUTH.keys()
    return lagjax.fit(
        SCENE,
        record() if one is None else one,
        TRUTH | {"c": c},
        free={name: name in free for name in names},
        transforms={name: lagjax.positive if name in positive else None for name in names},
    )


@pytest.fixture(scope="module")
def done():
    return fitted()


def test_a_bounded_profile_has_the_ends_of_a_fit_with_the_value_kept(done):
    profile = done.profile("params['c']")
    assert profile.verdict == "bounded" and "bounded. The 95 % interval" in str(profile)
    low, high = done.intervals()
    # Nearly linear: the ends are those of the covariance, to a few per cent of their distance.
    np.testing.assert_allclose(profile.interval, (low["c"], high["c"]), atol=0.03 * (high["c"] - low["c"]))
    assert profile.deviance.min() == 0.0 and (np.diff(profile.values) > 0).all()
    # The definition itself, by a fit whose parameter is kept at the end, in units of the unbiased variance.
    kept = fitted(c=profile.interval[1], free=("root",))
    squares = [float(np.sum(np.square(fit.residuals[0]))) for fit in (done, kept)]
    deviance = (squares[1] - squares[0]) / (squares[0] / (len(TS) - 4))
    assert deviance == pytest.approx(profile.threshold, rel=1e-3)
    assert profile.threshold == pytest.approx(stdtrit(len(TS) - 4, 0.975) ** 2, rel=1e-6)


def test_a_profile_finds_the_other_minimum(done):
    # Only the square of `root` enters.
    profile = done.profile("params['root']")
    assert profile.verdict == "two minima"
    assert profile.minima[1][0] == pytest.approx(-done.params["root"], rel=1e-3) and abs(profile.minima[1][1]) < 0.1
    assert "Another minimum at -1." in str(profile)
    assert lagjax.plot.profile(profile).get_xlabel() == "params['root']"


def test_a_profile_is_flat_where_nothing_is_seen():
    fit = fitted(free=("root", "colour"), positive=("root", "colour"))
    profile = fit.profile("params['colour']")
    assert profile.verdict == "flat" and profile.interval == (-np.inf, np.inf)
    assert np.abs(profile.deviance).max() < 1e-6 and "is excluded" in str(profile)


def test_a_profile_is_one_sided_where_only_a_bound_is_seen():
    fit = fitted(record(c=0.0, seed=3), c=1e-3, positive=("c", "root"))
    profile = fit.profile("params['c']")
    assert profile.verdict == "one-sided" and 1e-4 < profile.interval[1] < 0.05
    assert profile.interval[0] == -np.inf and "it is below" in str(profile)


def test_only_single_numbers_that_are_free_have_profiles(done):
    with pytest.raises(ValueError, match="there are params"):
        done.profile("d")
    with pytest.raises(ValueError, match="level must be between"):
        done.profile("params['c']", level=95)


def test_the_end_of_a_name_is_enough_where_it_is_the_only_one(done):
    assert done.profile("c").name == "params['c']"
    parameters = Parameters.from_pytree({"a": {"l": np.ones(2), "dry": 1.0}, "b": {"dry": 1.0, "1": 2.0}})
    assert parameters.names[parameters.row("l[1]")] == "params['a']['l'][1]"
    assert parameters.names[parameters.row("1")] == "params['b']['1']"
    with pytest.raises(ValueError, match=r"'dry' may be params\['a'\]\['dry'\], params\['b'\]\['dry'\]; there are"):
        parameters.row("dry")
    with pytest.raises(ValueError, match="No free parameter is called 'l'"):
        parameters.row("l")


def test_starts_have_the_intervals_of_the_whole_covariance(done):
    # Against the dense inverse with the derivatives of the closed form by differences.
    def motion(x):
        root, c, q, v = x
        ringing = np.sqrt(root**2 - 0.25 * c**2)
        return np.exp(-0.5 * c * TS) * (q * np.cos(ringing * TS) + (v + 0.5 * c * q) / ringing * np.sin(ringing * TS))

    x = np.array([done.params["root"], done.params["c"], *np.ravel(done.starts[0])])
    steps = 1e-6 * np.eye(4)
    slopes = np.stack([(motion(x + e) - motion(x - e)) / 2e-6 for e in steps], axis=-1)
    sigma2 = np.sum(np.square(done.residuals[0])) / (len(TS) - 4)
    deviation = np.sqrt(sigma2 * np.diag(np.linalg.inv(slopes.T @ slopes)))
    np.testing.assert_allclose(np.sqrt(np.diag(done.covariance.matrix))[::-1], deviation[:2], rtol=1e-3)


def test_bands_hold_new_samples_and_widen_away_from_the_data(done):
    half, exact, inside = len(TS) // 2, record().values - SIGMA * np.random.default_rng(0).normal(size=len(TS)), []
    fresh = exact + SIGMA * np.random.default_rng(1).normal(size=(100, len(TS)))
    for seed in range(20):
        values = np.where(np.arange(len(TS)) < half, record(seed).values, np.nan)
        prediction = fitted(lagjax.Record(TS[:half], values[:half])).predict(lagjax.Record(TS, values))
        low, high = prediction.bands()
        inside.append(np.mean((low < fresh) & (fresh < high)))
    # 20 fits of four unknowns to 60 samples: their errors move the share by 1.2 %, and it is 0.94 for so few.
    assert 0.90 < np.mean(inside) < 0.98, np.mean(inside)
    assert prediction.deviation[-20:].mean() > 2 * prediction.deviation[20:40].mean()
    assert np.isnan(prediction.residuals[half:]).all() and np.isfinite(prediction.values).all()
    assert str(prediction).startswith(f"Prediction, which misses {len(TS)} samples by 0.0")
    # With all data the standard deviation of the curve is that of the least squares: the trace of the hat matrix.
    whole = done.predict(done.records[0]).deviation
    with pytest.raises(TypeError, match=r"Only a .* is predicted"):
        done.predict(TS)
    assert np.sum((whole / done.noise["q"].sigma) ** 2) == pytest.approx(4 * len(TS) / (len(TS) - 4), rel=0.02)


def test_a_prediction_that_depends_on_what_is_seen_has_a_band():
    # Only the products m root² and m c enter beside m: a common factor is free, and moves no prediction.
    one = record()
    free, kept = (
        lagjax.fit(DAMPED_SPRING, one, {"m": 1.0, "k": 2.25, "c": 0.1}, free={"m": m, "k": True, "c": True})
        for m in (True, False)
    )
    assert len(free.unseen) == 1
    np.testing.assert_allclose(free.predict(one).deviation, kept.predict(one).deviation, rtol=1e-3)


def test_what_is_computed_from_parameters_has_the_deviation_of_their_covariance(done):
    frequency = done.deviation(lambda params: {"f": params["root"] / (2 * np.pi), "zero": 0 * params["c"]})
    variance = done.covariance["params['root']", "params['root']"]
    assert frequency["f"] == pytest.approx(np.sqrt(variance) / (2 * np.pi), rel=1e-9) and frequency["zero"] == 0.0
    # Of a mass and a stiffness of which only the ratio is seen, the ratio alone has a finite one.
    free = lagjax.fit(DAMPED_SPRING, record(), {"m": 1.0, "k": 2.25, "c": 0.1})
    found = free.deviation(
        lambda params: np.array([1.0, 0.0]) * params["k"] / params["m"] + np.array([0.0, 1.0]) * params["m"]
    )
    assert found[0] == pytest.approx(np.sqrt(variance) * 2 * done.params["root"], rel=1e-2) and np.isinf(found[1])
