"""`fit` of contacts and of hybrid motion by segments, of starts on closed contacts, and of one start for a record and
the times of its impacts."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import stdtrit

import lagjax

ALONG, UP = np.array([np.cos(0.5), np.sin(0.5)]), np.array([-np.sin(0.5), np.cos(0.5)])
INCLINE = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v**2) - 9.81 * q[1],
    contacts=lambda q: {"floor": UP @ q},
    slip=lambda q, v: {"floor": ALONG @ v},
    friction=lambda params: params["mu"],
    restitution=0.3,
)
BALL = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - params["g"] * q,
    contacts=lambda q: {"floor": q},
    restitution=lambda params: params["e"],
)
SHAKING = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - params["g"] * q,
    contacts=lambda q, t, params: q - params["a"] * jnp.sin(10 * np.pi * t),
    restitution=lambda params: params["e"],
)


def swing(q, v, params):
    return 0.5 * v**2 - 0.5 * params["k"] * q**2


DRIVEN = {
    "forces": lambda q, v, t: jnp.cos(2.8 * t),
    "dissipation": lambda q, v, params: 0.5 * params["c"] * v**2,
}
STOPPED = lagjax.Hybrid(
    {
        "free": lagjax.System(swing, **DRIVEN),
        "touching": lagjax.System(lambda q, v, params: swing(q, v, params) - 0.5 * params["s"] * q**2, **DRIVEN),
    },
    [
        lagjax.Transition("free", "touching", lambda q, v: q, 1),
        lagjax.Transition("touching", "free", lambda q, v: q, -1),
    ],
    "free",
    max_transitions=128,
)
BOUNDED = {"g": lagjax.positive, "a": lagjax.positive, "e": lagjax.between(0.0, 1.0)}


def noisy(values, sigma: float, seed: int = 0):
    return np.asarray(values) + sigma * np.random.default_rng(seed).normal(size=np.shape(values))


def assert_truth_in_intervals(fit, truth, level=0.99):
    low, high = fit.intervals(level)
    for name, x in truth.items():
        assert low[name] <= x <= high[name], (name, low[name], high[name])


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, -1.0])
def test_a_block_that_slides_from_its_start_stays_on_the_incline(speed):
    """Along the incline s = s₀ + v₀t − at²/2, a = g (sin α − μ cos α): the least squares of a parabola. From rest the
    block has no v₀: what sticks at the guess does so in the fit."""
    truth, ts = {"mu": 0.3}, np.linspace(0.0, 1.0, 41)
    motion = lagjax.simulate(INCLINE, 0.0 * ALONG, speed * ALONG, ts, truth)
    values = noisy(motion.q, 1e-3)
    record = lagjax.Record(ts, values, start=lagjax.Guess(0.01 * ALONG, 1.1 * speed * ALONG))
    fit = lagjax.fit(INCLINE, record, {"mu": 0.4}, transforms=lagjax.positive)
    columns = np.stack([np.ones_like(ts), -0.5 * ts**2, *([ts] if speed else [])], axis=1)
    best = np.linalg.lstsq(columns, values @ ALONG, rcond=None)[0]
    assert float(fit.params["mu"]) == pytest.approx((np.sin(0.5) - best[1] / 9.81) / np.cos(0.5), abs=1e-4)
    (q0, qdot0), lengths = fit.starts[0], 1e-12
    assert abs(UP @ q0) < lengths and abs(UP @ qdot0) < lengths and ALONG @ q0 == pytest.approx(best[0], abs=1e-5)
    assert ALONG @ qdot0 == pytest.approx(best[2] if speed else 0.0, abs=1e-4)
    assert fit.ok
    assert_truth_in_intervals(fit, truth)


def test_a_record_and_the_times_of_its_impacts_have_one_start():
    """A record says little about e, and the sound of the impacts little about where the ball began."""
    truth, ts = {"g": 9.81, "e": 0.8}, np.linspace(0.0, 3.2, 41)
    motion = lagjax.simulate(BALL, 1.0, 0.0, ts, truth)
    struck = np.asarray(motion.impacts.t)[: int(motion.impacts.count)]
    record = lagjax.Record(ts, noisy(motion.q, 5e-3))
    heard = lagjax.Timings("floor", noisy(struck, 1e-4, 1), 0.0, record)
    first = {"g": 9.0, "e": 0.7}
    both = lagjax.fit(BALL, [heard, record], first, transforms={k: BOUNDED[k] for k in first})
    assert both.ok and both.starts[0] == both.starts[1]
    assert_truth_in_intervals(both, truth)
    apart = lagjax.Timings("floor", heard.times, 0.0, lagjax.Guess(1.0, 0.0))
    separate = lagjax.fit(BALL, [apart, record], first, transforms={k: BOUNDED[k] for k in first})
    assert both.information.covariance[1, 1] < 0.8 * separate.information.covariance[1, 1]  # of g
    assert both.log_density().names.count("starts[1].q") == 1 and len(both.log_density()) == 2 + 2 + 2


def test_three_times_do_not_tell_how_exact_they_are():
    """e, and what a record leaves open of the start, meet three times exactly, whatever their noise is."""
    ts = np.linspace(0.0, 1.9, 41)
    motion = lagjax.simulate(BALL, 1.0, 0.0, ts, {"g": 9.81, "e": 0.8})
    record = lagjax.Record(ts, noisy(motion.q, 5e-3))
    struck = noisy(np.asarray(motion.impacts.t)[:3], 1e-3, 1)
    first = {"g": 9.0, "e": 0.7}
    fit = lagjax.fit(BALL, [lagjax.Timings("floor", struck, 0.0, record), record], first)
    assert not fit.ok and "meets all that was measured of times, 3 in number" in fit.message
    assert fit.information.fitted == pytest.approx([1.0, 3.0], abs=1e-3)  # of g, e, and a start
    assert fit.information.quantile(0.95) == pytest.approx(stdtrit(1, 0.975))


def test_a_record_that_times_begin_with_must_be_there_and_begin_then():
    record = lagjax.Record(np.linspace(0.0, 1.0, 11), np.linspace(1.0, 0.5, 11))
    with pytest.raises(ValueError, match=r"begins at 0, and not at t0 = 0\.1"):
        lagjax.Timings("floor", [0.5], 0.1, record)
    with pytest.raises(ValueError, match=r"records\[0\] begins with a record that is not among"):
        lagjax.fit(BALL, [lagjax.Timings("floor", [0.5], 0.0, record)], {"g": 9.0, "e": 0.7})


@pytest.mark.slow
def test_a_ball_that_forgets_its_start_on_a_shaking_table_is_fitted_in_pieces():
    """Motions that begin side by side part by 1e8: no single start follows the record."""
    truth, ts = {"g": 9.81, "a": 0.03, "e": 0.7}, np.linspace(0.0, 9.0, 1801)
    motion = lagjax.simulate(SHAKING, 0.1, 0.0, ts, truth)
    record = lagjax.Record(ts, noisy(motion.q, 2e-4), start=lagjax.Guess(0.1, 0.0))
    fit = lagjax.fit(SHAKING, record, {"g": 10.5, "a": 0.026, "e": 0.6}, transforms=BOUNDED)
    assert fit.ok and "pieces" in fit.message and int(motion.impacts.count) > 25
    assert_truth_in_intervals(fit, truth)


@pytest.mark.slow
def test_a_chaotic_oscillator_with_a_stop_is_fitted_in_pieces_that_begin_in_their_modes():
    """Free for q < 0, against a stiff spring for q > 0."""
    truth, ts = {"k": 1.0, "c": 0.05, "s": 100.0}, np.linspace(0.0, 80.0, 1601)
    record = lagjax.Record(ts, noisy(lagjax.simulate(STOPPED, -0.2, 0.0, ts, truth).q, 5e-3))
    first = {"k": 1.2, "c": 0.04, "s": 120.0}
    fit = lagjax.fit(STOPPED, record, first, transforms=lagjax.positive, method="segments")
    assert fit.ok
    assert_truth_in_intervals(fit, truth)
