"""Sensors that round, that are at their limits, and samples that are no measurements.

`benchmarks/coverage.py` counts how often intervals hold the truth. Most tests share one pendulum.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import damping
from scipy.optimize import minimize
from scipy.stats import norm

import lagjax
from lagjax._fit.model._noise import find_sensor, rounding_square, sample_worths
from lagjax._fit.model._sensor_faults import require_measurements

TS = np.linspace(0.0, 12.0, 601)
TRUTH = {"w2": 9.0, "c": 0.1}
SCENE = lagjax.System(lambda q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q), dissipation=damping)
FALL = lagjax.System(lambda q, v, params: 0.5 * v**2 + params["g"] * q)
EXACT = np.asarray(lagjax.simulate(SCENE, 1.2, 0.0, TS, TRUTH).q)
NOISE = 5e-3 * np.random.default_rng(0).normal(size=601)
PLACES = np.random.default_rng(1).choice(601, 60, replace=False)
STEP = 2 * np.pi / 24


def fit(values, **options):
    return lagjax.fit(SCENE, lagjax.Record(TS, values), {"w2": 7.0, "c": 0.13}, transforms=lagjax.positive, **options)


def is_right(found, level=0.9999):
    low, high = found.intervals(level)
    return found.ok and all(low[k] <= x <= high[k] for k, x in TRUTH.items())


def spoiled(places, value, values=EXACT + NOISE):
    values = values.copy()
    values[places] = value
    return values


# ---- samples that are no measurements --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (spoiled(PLACES, 0.0), "60 of 601 samples of q in .* exactly 0, among values that never repeat: missing"),
        (spoiled(PLACES[:6], -9999.0), "6 of 601 samples of q in .* are -9999, 4300 times the spread of the others"),
        (spoiled(PLACES[:1], 1e6), r"1 of 601 samples of q in records\[0\] are 1e\+06"),
        (spoiled(PLACES, 0.0, np.round(EXACT, 3)), "60 of 601 samples .* exactly 0, among values that are far from it"),
        (spoiled(PLACES, 0.0).astype(np.float32), "60 of 601 samples of q"),
        (spoiled([40, 163, 300, 309], 0.5, 3 * EXACT + 100 * NOISE), "4 of 601 samples of q .* exactly 0.5"),
    ],
)
def test_samples_that_stand_for_missing_ones_are_said_before_the_first_trial(values, sentence):
    with pytest.raises(ValueError, match=rf"{sentence}.*Put NaN there, or take noise=lagjax.StudentT\(\)"):
        fit(values)


def test_their_cures_are_right():
    values = spoiled(PLACES, 0.0)
    assert is_right(fit(values, noise=lagjax.StudentT()))
    assert is_right(fit(spoiled(PLACES, np.nan)))


def test_what_may_stand_for_measurements_is_let_through():
    rest = np.where(TS < 4.0, 0.0, EXACT)  # released later
    pulse = 1e-4 * NOISE + np.exp(-(((TS - 6.0) / 0.1) ** 2))
    bounce = np.abs(EXACT)
    square = np.sign(np.sin(TS))
    coarse = EXACT[::30] + NOISE[::30]
    encoder = np.mod(np.round(40 * EXACT + 180), 360.0)
    names, at = ("q",), np.linspace(0.0, 1.0, 601)
    for values in (EXACT, rest, pulse, bounce, square, 3.0 * NOISE, np.cumsum(NOISE), np.round(EXACT / STEP)):
        require_measurements([lagjax.Record(at, values)], names, np.array([np.inf]))
    require_measurements([lagjax.Record(at, encoder)], names, np.array([360.0]))
    require_measurements([lagjax.Record(at[: len(coarse)], coarse)], names, np.array([np.inf]))
    weights = np.where(np.isin(np.arange(601), PLACES), 0.0, 1.0)
    require_measurements([lagjax.Record(at, spoiled(PLACES, 0.0), weights=weights)], names, np.array([np.inf]))


# ---- limits ----------------------------------------------------------------------------------------------------------


def test_a_fit_with_limits_is_that_of_the_censored_likelihood():
    # A fall from rest, whose sensor ends at 0.6; the same likelihood by SciPy, without lagjax.
    ts = np.linspace(0.0, 0.5, 40)
    shown = np.minimum(0.5 * 9.81 * ts**2 + 0.05 * np.random.default_rng(2).normal(size=40), 0.6)
    found = lagjax.fit(FALL, lagjax.Record(ts, shown, start=(0.0, 0.0)), {"g": 7.0}, noise=lagjax.Clipped(high=0.6))

    def cost(x):
        e, sigma = 0.5 * x[0] * ts**2 - shown, np.exp(x[1])
        return -np.sum(np.where(shown < 0.6, norm.logpdf(e / sigma) - x[1], norm.logcdf(e / sigma)))

    best = minimize(cost, [9.0, -3.0], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10})
    hessian = 1e-3**-2 * (cost(best.x + [1e-3, 0.0]) + cost(best.x - [1e-3, 0.0]) - 2 * best.fun)
    deviation = np.sqrt(found.covariance["params['g']", "params['g']"])
    assert abs(found.params["g"] - best.x[0]) < 0.05 * deviation  # what ends a search
    assert found.noise["values" if "values" in found.noise else "q"].sigma == pytest.approx(np.exp(best.x[1]), rel=1e-3)
    assert found.log_likelihood == pytest.approx(-best.fun, abs=2e-3)
    assert deviation == pytest.approx(hessian**-0.5, rel=0.1)  # Fisher's information for the observed one, and n − 1


def test_limits_are_seen_and_said():
    shown = np.clip(EXACT + NOISE, -0.8, 0.8)
    found, told = fit(shown), fit(shown, noise=lagjax.Clipped(-0.8, 0.8))
    assert is_right(found) and "73 of 601 samples of q are 0.8, the largest value, in runs" in found.message
    assert "Clipped(low=-0.8)" in found.message and "Clipped" not in told.message
    assert found.params == told.params
    assert found.noise["q"].sigma == pytest.approx(5e-3, rel=0.1)
    student = fit(shown, noise=lagjax.StudentT())
    assert not student.ok and "take noise=lagjax.Clipped(high=0.8)" in student.message


def test_a_converter_of_few_bits_at_its_limits():
    for step in (2e-3, 1e-2):
        found = fit(np.clip(np.round((EXACT + 0.8 * NOISE) / step) * step, -0.8, 0.8))
        assert is_right(found) and "Clipped(low=-0.8)" in found.message and "Clipped(high=0.8)" in found.message
    assert "Quantised(0.01)" in found.message


@pytest.mark.parametrize(("step", "limit"), [(0.1, 0.5), (0.1, 0.55), (0.05, 0.8)])
def test_a_sensor_of_few_lines_at_its_limits(step, limit):
    """What is shown as a limit on a line begins half a step before it; one between lines at the next of them."""
    shown = np.clip(np.round((EXACT + 4 * NOISE) / step) * step, -limit, limit)
    found, told = fit(shown), fit(shown, noise=lagjax.Clipped(-limit, limit))
    assert is_right(found) and "Clipped(low" in found.message and "Clipped(high" in found.message
    assert is_right(told) and f"multiples of {step:g}" in told.message


@pytest.mark.parametrize("limit", [0.8, 0.85, 0.82])
def test_a_coarse_sensor_shows_its_limit_from_half_a_step_before(limit):
    shown = np.clip(np.round((EXACT + 4 * NOISE) / 0.1) * 0.1, -limit, limit)
    found = fit(shown, noise=lagjax.Clipped(shown.min(), shown.max()))
    assert is_right(found, 0.999) and found.residual_function.sensor.step[0] == pytest.approx(0.1)
    predicted = found.predict(found.records[0]).values
    assert np.allclose(found.residuals[0] + shown, predicted, atol=1e-3)  # less what is shown


def test_a_limit_that_lines_do_not_tell_is_asked_for():
    shown = np.clip(np.round((EXACT + 4 * NOISE) / 0.2) * 0.2, -0.8, 0.8)
    found = fit(shown)
    assert not found.ok and "take noise=lagjax.Clipped(low=-0.8, high=0.8)" in found.message
    assert is_right(fit(shown, noise=lagjax.Clipped(shown.min(), shown.max())))


def test_the_ends_of_a_coarse_sensor_that_has_no_limit_are_none():
    for step, many in ((0.1, 4), (0.3, 4), (0.3, 0.1), (0.1, 20)):
        assert is_right(fit(np.round((EXACT + many * NOISE) / step) * step))


def test_the_density_has_the_limits_and_their_gradient():
    found = fit(np.clip(EXACT + 10 * NOISE, -0.8, 9.0), noise=lagjax.Clipped(low=-0.8))
    density = found.log_density()
    slope = np.asarray(jax.jit(jax.grad(density))(density.first))
    unit = np.sqrt(np.diag(density.covariance()))
    values = jax.jit(density)
    for k in range(len(unit)):
        step = 1e-2 * unit[k] * np.eye(len(unit))[k]
        difference = (values(density.first + step) - values(density.first - step)) / (2e-2 * unit[k])
        assert slope[k] * unit[k] == pytest.approx(float(difference) * unit[k], abs=1e-3)
        assert abs(slope[k] * unit[k]) < 0.2  # the fit is the mode
    assert found.profile("c").verdict == "bounded"


# ---- rounding --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [0.0, 0.03, 0.4, 7.3])
def test_what_rounding_makes_of_least_squares_is_its_mean_over_offsets(speed):
    t = np.arange(300.0)
    x, rows = speed * t + 0.3 * np.sin(t / 9), np.stack([np.ones(300), np.sin(t / 40)], axis=1)
    offsets = (np.arange(2000) + 0.5)[:, None] / 2000
    errors = np.round(x + offsets) - x - offsets
    exact = np.einsum("ki,kj->ij", errors @ rows, errors @ rows) / 2000
    ours = rounding_square([rows[None]], [x[None]], 1.0, 12**-0.5) + 0.03 / 12 * rows.T @ rows
    np.testing.assert_allclose(ours, exact, atol=0.1 * np.abs(exact).max())


def test_worths():
    still, fast, noisy = np.zeros(500), 3.0 * np.arange(500), 2.0
    assert sample_worths(still, 1.0, 12**-0.5).sum() == pytest.approx(1.0, rel=0.2)
    assert sample_worths(fast, 1.0, 12**-0.5).sum() == 500
    assert sample_worths(still, 1.0, noisy).sum() == pytest.approx(500, rel=1e-6)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.6])
def test_a_coarse_encoder_is_honest(offset):
    swing = np.asarray(lagjax.simulate(SCENE, 0.4, 0.0, TS, TRUTH).q)
    found = fit(np.round(swing / STEP + offset) * STEP - offset * STEP)
    assert is_right(found, 0.95) and "Quantised(0.2618)" in found.message


def test_what_no_law_of_rounding_helps_is_not_ok():
    swing = np.asarray(lagjax.simulate(SCENE, 0.2, 0.0, TS, TRUTH).q)
    found = fit(np.round(swing / STEP) * STEP)
    assert not found.ok and "q moves by less than 2.5 steps of its sensor" in found.message
    student = fit(np.round(EXACT / STEP) * STEP, noise=lagjax.StudentT())
    assert not student.ok and "take noise=lagjax.Quantised(0.2618)" in student.message


def test_rest_counts_once():
    # A damped pendulum, and then twice as long at rest, between two lines of its encoder.
    ts = np.linspace(0.0, 24.0, 1201)
    swing = np.asarray(lagjax.simulate(SCENE, 1.0, 0.0, ts, {"w2": 9.0, "c": 1.5}).q)
    shown, step = {}, 0.02
    for end in (401, 1201):
        record = lagjax.Record(ts[:end], np.round((swing[:end] - 0.008) / step) * step + 0.008)
        found = lagjax.fit(SCENE, record, {"w2": 8.0, "c": 1.3}, noise=lagjax.Quantised(step))
        shown[end] = found.noise["q"].effective, found.covariance["params['c']", "params['c']"]
        low, high = found.intervals()
        assert found.ok and low["w2"] < 9.0 < high["w2"] and low["c"] < 1.5 < high["c"]
    assert shown[1201][0] < shown[401][0] + 2
    assert shown[1201][1] == pytest.approx(shown[401][1], rel=0.3)


def test_rounding_of_some_signals_of_a_dict_in_float32():
    with jax.enable_x64(False):
        values = {"angle": np.round(EXACT / 0.05) * 0.05, "tip": np.sin(EXACT) + NOISE}
        values = {name: column.astype(np.float32) for name, column in values.items()}
        observe = lambda q, qdot: {"angle": q, "tip": jnp.sin(q)}
        record = lagjax.Record(TS, values, start=lagjax.Guess(1.1, 0.0))
        law = lagjax.Quantised({"angle": 0.05, "tip": None})
        told = lagjax.fit(SCENE, record, {"w2": 8.0, "c": 0.13}, observe=observe, noise=law)
        seen = lagjax.fit(SCENE, record, {"w2": 8.0, "c": 0.13}, observe=observe)
    assert is_right(told) and is_right(seen)
    assert told.noise["values['angle']"].sigma == pytest.approx(0.05 / 12**0.5, rel=0.1)
    assert "All values of values['angle'] are multiples of 0.05" in seen.message and "multiples" not in told.message


def test_steps_and_limits_that_records_show():
    records = [lagjax.Record(TS, values) for values in (np.round(EXACT / 0.0025) * 0.0025, EXACT[::-1])]
    assert find_sensor(records[:1]).step[0] == pytest.approx(0.0025)
    assert np.isnan(find_sensor(records).step[0])  # of one encoder, and not of both records
    assert np.isnan(find_sensor([lagjax.Record(TS, EXACT + NOISE)])).all()
    text = np.array([float(f"{x:.6g}") for x in np.round(EXACT * 65.19) / 65.19])  # an encoder's angles as text
    assert find_sensor([lagjax.Record(TS, text)]).step[0] == pytest.approx(1 / 65.19, rel=1e-3)
    stopped = np.round(np.maximum.accumulate(EXACT - 0.2 * TS) / 0.01) * 0.01  # comes to rest at its largest value
    assert np.isnan(find_sensor([lagjax.Record(TS, stopped)]).high[0])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: lagjax.Quantised(0.0), r"Quantised\(step\) needs a positive step"),
        (lambda: lagjax.Clipped(), r"Clipped\(low, high\) needs a limit or two"),
        (lambda: fit(np.round(EXACT, 2), noise=lagjax.Quantised(0.03)), "do not differ by multiples of 0.03"),
        (lambda: fit(EXACT, noise=lagjax.Clipped(high=1.0)), r"q in records\[0\] are beyond the limits nan and 1"),
        (lambda: fit(EXACT, noise=lagjax.Quantised({"a": 0.1})), "step must be one number, or a prefix"),
    ],
)
def test_laws_that_cannot_be_are_a_sentence(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()
