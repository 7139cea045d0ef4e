"""Data with a mistake: the right parameters, or a fit that is not ok and a sentence that names the mistake.

`benchmarks/fit_population.py` draws many of these. Most tests share one pendulum.
"""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import damping, spring

import lagjax
from lagjax._fit.model._autocorrelation import correlated_power, first_lag_products
from lagjax._fit.model._sensors import require_no_jumps, wrap_residuals

SIGMA = 3e-3
TS = np.linspace(0.0, 8.0, 401)
TRUTH = {"w2": 9.0, "c": 0.1}
SCENE = lagjax.System(
    lambda q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q),
    dissipation=damping,
)


def motion(q0, v0, params=TRUTH, seed=0, sigma=SIGMA):
    q = np.asarray(lagjax.simulate(SCENE, q0, v0, TS, params).q)
    return q + sigma * np.random.default_rng(seed).normal(size=q.shape)


def fit(values, ts=TS, observe=None, noise=None, start=None):
    values = values if isinstance(values, list) else [values]
    records = [lagjax.Record(ts, one, start=start) for one in values]
    begin = {"w2": 7.0, "c": 0.13}
    return lagjax.fit(SCENE, records, begin, transforms=lagjax.positive, observe=observe, noise=noise)


def is_right(found):
    low, high = found.intervals(0.9999)
    return all(low[k] <= x <= high[k] for k, x in TRUTH.items())


ROUND = motion(0.5, 13.0)  # nine turns, then swings


def modulo(period, values=ROUND):
    return np.mod(values * period / (2 * np.pi) + period / 2, period) - period / 2


# ---- angles less whole turns -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("period", "text"), [(2 * np.pi, "2π"), (360.0, "360"), (4096.0, "about 40")])
def test_a_jump_by_a_period_is_said_before_the_first_trial(period, text):
    place = int(np.argmax(np.abs(np.diff(modulo(period))) > period / 2))
    sentence = (
        rf"q of records\[0\] jumps by {text}.* between samples {place} and {place + 1}, t = {TS[place]:g}:.*unwrap"
    )
    with pytest.raises(ValueError, match=sentence):
        fit(modulo(period))


def test_no_jump_is_seen_where_there_is_none():
    steep = np.where(TS > 2.0, 1.0, 0.0) + 1e-3 * np.random.default_rng(0).normal(size=TS.shape)  # of no period
    spike = motion(0.5, 1.0)
    spike[100] += 2 * np.pi
    for values in (ROUND, steep, spike):
        lagjax.fit(SCENE, lagjax.Record(TS, values), TRUTH, free={"w2": True, "c": False}, method="whole")


def test_white_noise_is_no_angle():
    # Some pair of neighbours is as far apart as the range, or a turn, but many others nearly are.
    noise = np.random.default_rng(0).normal(size=(60, 501))
    for scale in (0.005, 1.0, 1.5, 60.0, 100.0):
        for place, values in enumerate(scale * noise):
            require_no_jumps(lagjax.Record(np.arange(501.0), values), f"records[{place}]", ("q",), True)
    turning = lagjax.Record(np.arange(501.0), 0.7 * np.mod(0.016 * np.arange(501) + 0.02 * noise[0], 1.0))
    with pytest.raises(ValueError, match=r"jumps by about 0\.\d+ between"):
        require_no_jumps(turning, "records[0]", ("q",), True)


@pytest.mark.parametrize("q0", [None, 0.5 + 4 * np.pi])
def test_wrapped_data_give_the_parameters_of_continuous_ones(q0):
    # With a start that is known, and whole turns away from what the sensor shows, as well.
    start = None if q0 is None else (q0, 13.0)
    found, plain = fit(modulo(2 * np.pi), observe=lagjax.wrapped(2 * np.pi), start=start), fit(ROUND)
    assert found.ok and is_right(found)
    assert found.rms["q"] == pytest.approx(plain.rms["q"], rel=0.02)


def test_wrapped_sensors_of_their_own_and_gaps():
    holes = np.where((TS > 2.0) & (TS < 2.6), np.nan, modulo(2 * np.pi))
    observe = lambda q, qdot: jnp.arctan2(jnp.sin(q), jnp.cos(q))
    assert is_right(fit(holes, observe=lagjax.wrapped(2 * np.pi, observe)))


def test_samples_too_far_apart_to_tell_a_turn_ask_for_a_start():
    with pytest.raises(
        ValueError, match=r"records\[0\] needs a start, because a wrapped signal moves by more than a third"
    ):
        fit(modulo(2 * np.pi)[::20], TS[::20], observe=lagjax.wrapped(2 * np.pi))


def test_periods_by_signal():
    residuals = np.array([[7.0, 7.0, 350.0]])
    np.testing.assert_allclose(
        wrap_residuals(residuals, np.array([np.inf, 2 * np.pi, 360.0])), [[7.0, 7.0 - 2 * np.pi, -10.0]]
    )
    record = lagjax.Record(TS, {"theta": np.zeros((401, 2)), "x": np.zeros(401)})
    sensors = lagjax.wrapped({"theta": np.array([2.0, 3.0]), "x": None})
    np.testing.assert_array_equal(sensors.periods(record), [2.0, 3.0, np.inf])
    with pytest.raises(ValueError, match="period must be one number, or a prefix"):
        lagjax.wrapped({"phi": 1.0}).periods(record)
    with pytest.raises(ValueError, match="A period must be positive; got -1"):
        lagjax.wrapped(-1.0)
    with pytest.raises(TypeError, match="A delay goes outside"):
        lagjax.wrapped(1.0, lagjax.Delayed(lambda params: 0.1, 0.2))


# ---- what a fit leaves -----------------------------------------------------------------------------------------------


def test_a_false_minimum_is_not_ok_and_says_its_share():
    # Sine and cosine of an angle that goes round, from a start that is a little off: one turn too few.
    values = np.stack([np.sin(ROUND), np.cos(ROUND)], axis=-1)
    observe = lambda q, qdot: jnp.stack([jnp.sin(q), jnp.cos(q)])
    found = fit(values, observe=observe, start=lagjax.Guess(0.4, 11.5))
    assert not found.ok and "The fit leaves" in found.message and "% of values[0]" in found.message


def test_noise_as_large_as_the_signal_is_honest():
    found = fit(motion(0.3, 0.0, sigma=0.3))
    assert found.ok and "The noise is" in found.message and is_right(found)


def test_structure_is_what_white_noise_is_not():
    rng, counted = np.random.default_rng(0), np.ones((2, 2000), bool)
    white, slow = rng.normal(size=(2, 2000)), np.sin(np.arange(2000) / 20.0)
    none, half = (correlated_power(first_lag_products(x, counted), counted.sum(axis=1)) for x in (white, white + slow))
    assert (none == 0.0).all()
    np.testing.assert_allclose(half, 0.5, rtol=0.1)  # the mean square of a sine


def test_an_outlier_is_no_bound():
    values = motion(1.0, 1.0)
    values[100:110], values[200] = 0.0, 1e6
    found = fit(values, noise=lagjax.StudentT())
    assert found.ok and is_right(found) and "bound" not in found.message


def test_a_record_of_another_machine_is_not_ok():
    values = [motion(1.0, 0.0), motion(-0.5, 2.0, seed=1), motion(0.8, 1.0, TRUTH | {"w2": 9.5}, seed=2)]
    found = fit(values)
    assert not found.ok and "records[2] disagrees with the others" in found.message
    assert "without it params['w2'] would move down" in found.message


def test_two_records_that_contradict_each_other():
    values = [motion(1.0, 0.0), motion(-0.5, 2.0, seed=1)]
    assert fit(values).ok
    values[1] = motion(-0.5, 2.0, TRUTH | {"w2": 9.5}, seed=1)
    found = fit(values)
    assert not found.ok and "contradicts the other record: without it params['w2'] would move" in found.message


def test_what_the_scene_lacks_is_told_and_is_no_other_machine():
    # A vibration of six σ, and a difference of 0.6 %: that is beyond chance, and little of what is left.
    shaken = [6 * SIGMA * np.sin(25.0 * TS + phase) for phase in (0.3, 2.0)]
    values = [motion(1.0, 0.0) + shaken[0], motion(-0.5, 2.0, TRUTH | {"w2": 9.055}, seed=1) + shaken[1]]
    found = fit(values)
    assert found.ok and "the scene lacks something that differs from record to record" in found.message


# ---- mistakes that can be undone -------------------------------------------------------------------------------------


def test_degrees_are_named():
    found = fit(np.degrees(motion(1.5, 1.0)))
    assert not found.ok and "The data are followed with q in degrees" in found.message


def test_an_angle_from_the_upright_is_named():
    found = fit(motion(1.0, 1.0) - np.pi)
    assert not found.ok and "counted from the opposite direction" in found.message


def test_a_signal_that_hangs_is_named():
    with pytest.raises(ValueError, match=r"q is 1 at all 401 samples of records\[0\].*nothing moves"):
        fit(np.ones(401))


COUPLED = lagjax.System(
    lambda q, v, params: (
        0.5 * v[0] ** 2 + v[1] ** 2 - 0.5 * params["k1"] * q[0] ** 2 - 0.5 * params["k2"] * (q[1] - q[0]) ** 2
    )
)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [(lambda q: q[:, ::-1], r"q\[0\] and q\[1\] swapped"), (lambda q: q * [1.0, -1.0], r"the other sign of q")],
)
def test_two_signals_of_springs(spoil, sentence):
    truth, rng = {"k1": 6.0, "k2": 3.0}, np.random.default_rng(0)
    q = np.asarray(lagjax.simulate(COUPLED, np.array([1.0, -0.4]), np.zeros(2), TS, truth).q)
    record = lagjax.Record(TS, spoil(q + SIGMA * rng.normal(size=q.shape)))
    found = lagjax.fit(COUPLED, record, {"k1": 5.0, "k2": 4.0}, transforms=lagjax.positive)
    assert not found.ok
    assert re.search(sentence, found.message), found.message


# ---- chaotic records -------------------------------------------------------------------------------------------------


def double(q, v, params):
    a, b = params["a"], params["b"]
    kinetic = v[0] ** 2 * a**2 + 0.5 * b**2 * v[1] ** 2 + a * b * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + 9.81 * (2 * a * jnp.cos(q[0]) + b * jnp.cos(q[1]))


DOUBLE = lagjax.System(double)


@pytest.mark.slow
def test_a_long_chaotic_record_is_followed_in_pieces():
    truth, ts = {"a": 1.0, "b": 0.8}, np.linspace(0.0, 60.0, 6001)
    q = np.asarray(lagjax.simulate(DOUBLE, np.array([2.0, 2.5]), np.zeros(2), ts, truth).q)
    record = lagjax.Record(ts, q + SIGMA * np.random.default_rng(0).normal(size=q.shape))
    found = lagjax.fit(DOUBLE, record, {"a": 1.3, "b": 1.04}, transforms=lagjax.positive)
    assert found.ok and "pieces, each with a start of its own" in found.message
    low, high = found.intervals(0.9999)
    assert all(low[k] <= x <= high[k] and high[k] - low[k] < 1e-3 for k, x in truth.items())
    # Residuals and starts are those of the user's one record.
    assert found.residuals[0].shape == (6001, 2) and len(found.starts) == 1
    assert max(found.rms.values()) == pytest.approx(SIGMA, rel=0.05)
    np.testing.assert_allclose(found.starts[0][0], [2.0, 2.5], atol=3 * SIGMA)


SPRING = lagjax.System(spring)
PULLED = lagjax.System(lambda q, v, params: spring(q, v, params) - params["f"] * q)


@pytest.mark.parametrize("step", [None, 0.02])
def test_the_size_of_all_weights_changes_nothing(step):
    """Only their ratios count: in metres or kilometres, with weights 1/σ² or 1; also where a sensor rounds."""
    ts, rng = np.linspace(0.0, 10.0, 201), np.random.default_rng(0)
    values = np.cos(2.0 * ts) + 1e-3 * rng.normal(size=ts.size)
    values = values if step is None else step * np.round(values / step)
    each = 1.0 if step else rng.uniform(0.5, 2.0, ts.size)
    fits = [lagjax.fit(SPRING, lagjax.Record(ts, values, weights=w * each), {"k": 3.0}) for w in (1.0, 1e-24, 1e24)]
    for fit in fits:
        assert fit.ok and fit.message == fits[0].message
        np.testing.assert_allclose(fit.params["k"], 4.0, atol=4e-3)
        for end, other in zip(fit.intervals(), fits[0].intervals(), strict=True):
            np.testing.assert_allclose(end["k"], other["k"], rtol=1e-9)


def test_a_whole_number_that_stays_is_named():
    ts = np.linspace(0.0, 10.0, 201)
    fit = lagjax.fit(PULLED, lagjax.Record(ts, np.cos(2.0 * ts)), {"k": 1, "f": 0.1})
    assert not fit.ok and "params['k']. Write 3.0 instead of 3" in fit.message
