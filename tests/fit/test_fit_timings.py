"""`fit` of crossing times: when a pendulum passes a gate, alone and beside records, and sentences for what is wrong."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import damping, pendulum_in_gravity

import lagjax
from lagjax._fit import Point

TRUTH = {"g": 9.81, "c": 0.05}
START = (1.0, 0.0)


def bottom(q, qdot):
    return q


def gate(q, qdot, params):
    return q - 0.3


SCENE = lagjax.System(pendulum_in_gravity, dissipation=damping)
SECTIONS = {"bottom": bottom, "gate": gate}
DIRECTIONS = {"bottom": 0, "gate": 1}
FIRST = {"g": 9.0, "c": 0.02}
FILES = ("transit_times", "elements_agol2021")


def measured(sigma=0.0, params=TRUTH):
    """Times of both sections within ten units of time, and which of them are missing."""
    found = lagjax.crossings(SCENE, SECTIONS, *START, jnp.array([0.0, 10.0]), params, direction=DIRECTIONS)
    rng = np.random.default_rng(0)
    times = {name: np.asarray(x.t)[: int(x.count)] for name, x in found.items()}
    return {name: t + sigma * rng.normal(size=len(t)) for name, t in times.items()}


def timings(times, start=START, **more):
    return lagjax.Timings(SECTIONS, times, t0=0.0, start=start, direction=DIRECTIONS, **more)


@pytest.fixture(scope="module")
def exact():
    return measured()


def test_parameters_and_start_come_out_of_crossing_times(exact):
    times = {name: t.copy() for name, t in exact.items()}
    times["gate"][1] = np.nan
    fit = lagjax.fit(SCENE, timings(times, lagjax.Guess(0.9, 0.1)), FIRST)
    # Times are exact to rtol 1e-9 of a motion of ten units of time.
    assert fit.params["g"] == pytest.approx(9.81, rel=1e-6) and fit.params["c"] == pytest.approx(0.05, rel=1e-4)
    assert np.allclose(fit.starts[0], START, atol=1e-5) and np.isnan(fit.residuals[0]["gate"][1])
    assert list(fit.noise) == ["times"] and fit.noise["times"].samples == sum(map(len, times.values())) - 1
    assert "times" in repr(fit) and np.abs(fit.residuals[0]["bottom"]).max() < 1e-8


@pytest.mark.slow
def test_times_have_the_derivatives_of_differences_forward_and_in_reverse(exact):
    fit = lagjax.fit(SCENE, timings(exact, lagjax.Guess(*START)), TRUTH)
    residuals, starts = fit.residual_function, np.array([START])
    point, h = residuals.evaluate(Point(fit.u, starts)), 1e-5
    for k, step in enumerate(h * np.eye(4)):
        ends = [
            residuals.evaluate(Point(fit.u + way * step[2:], starts + way * step[:2])).residuals[0] for way in (1, -1)
        ]
        np.testing.assert_allclose(point.slopes[0][..., k], (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-8)
    [clock] = residuals.systems[0].clocks.values()
    times, back = jax.vjp(clock.times, starts[0], fit.parameters.numbers(fit.u))
    weights = np.linspace(-1.0, 2.0, len(times))
    np.testing.assert_allclose(np.concatenate(back(weights)), weights @ point.slopes[0][0, :, 0], rtol=1e-8, atol=1e-11)


def test_records_and_timings_of_one_motion_are_fitted_together(exact):
    ts = np.linspace(0.0, 4.0, 81)
    shown = np.asarray(lagjax.simulate(SCENE, *START, ts, TRUTH).q)
    noisy = shown + 5e-3 * np.random.default_rng(1).normal(size=len(ts))
    times = measured(1e-4)
    both = lagjax.fit(SCENE, [timings(times), lagjax.Record(ts, noisy)], FIRST)
    alone = lagjax.fit(SCENE, timings(times), FIRST)
    assert list(both.noise) == ["q", "times"] and [len(record) for record in both.records] == [len(both.records[0]), 81]
    assert both.noise["times"].sigma == pytest.approx(1e-4, rel=0.5)
    assert both.noise["q"].sigma == pytest.approx(5e-3, rel=0.3)
    deviation = np.sqrt(np.diag(both.covariance.matrix))
    assert (np.abs([both.params["c"] - 0.05, both.params["g"] - 9.81]) < 4 * deviation).all()
    assert abs(both.params["g"] - alone.params["g"]) < 3 * deviation[1]
    assert both.predict(both.records[1]).residuals.std() == pytest.approx(both.rms["q"], rel=0.1)
    # Four times, of which two unknowns can follow as many, hardly tell their scatter.
    first = {name: t[:2] for name, t in times.items()}
    few = lagjax.fit(SCENE, [timings(first), lagjax.Record(ts, noisy)], FIRST)
    assert "The scatter of times is told by 4 samples" in few.message and "The scatter" not in both.message


def test_a_record_that_is_not_of_the_scene_beside_timings_ends_in_a_verdict(exact):
    ts = np.linspace(0.0, 4.0, 81)
    fit = lagjax.fit(SCENE, [timings(exact), lagjax.Record(ts, np.sin(7 * ts))], FIRST, method="whole")
    assert not fit.ok and "of q: its motion is not that of the scene" in fit.message


@pytest.mark.slow
def test_given_errors_are_weights_and_their_common_factor_is_found():
    rng = np.random.default_rng(3)
    errors = {name: rng.uniform(1e-4, 1e-3, len(t)) for name, t in measured().items()}
    noisy = {name: t + 2.0 * errors[name] * rng.normal(size=len(t)) for name, t in measured().items()}
    fit = lagjax.fit(SCENE, timings(noisy, weights={name: e**-2 for name, e in errors.items()}), FIRST)
    # Of some thirty times: to one part in √60 of its standard deviation.
    assert fit.noise["times"].sigma == pytest.approx(2.0, rel=0.4)


@pytest.mark.slow
def test_the_density_of_timings_and_records_has_the_gradient_of_differences_also_in_a_batch():
    ts = np.linspace(0.0, 4.0, 41)
    shown = np.asarray(lagjax.simulate(SCENE, *START, ts, TRUTH).q)
    noisy = shown + 5e-3 * np.random.default_rng(1).normal(size=len(ts))
    fit = lagjax.fit(SCENE, [timings(measured(1e-3)), lagjax.Record(ts, noisy)], FIRST)
    density = fit.log_density()
    off = density.first + 0.5 * np.sqrt(np.diag(density.covariance())) * np.array([[1.0], [-1.0]])
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(density)))(off)
    assert value[0] == pytest.approx(float(density(off[0])), rel=1e-12)
    for k in range(len(density)):
        h = 1e-4 * np.sqrt(density.covariance()[k, k]) * np.eye(len(density))[k]
        ends = [float(density(off[1] + way * h)) for way in (1, -1)]
        central = (ends[0] - ends[1]) / (2 * h[k])
        assert float(slope[1, k]) == pytest.approx(central, rel=1e-5, abs=1e-6 * float(abs(slope[1]).max()))


@pytest.mark.slow
def test_the_transit_times_of_trappist_1_are_those_of_the_published_fit(monkeypatch, capsys):
    root = Path(__file__).parents[2]
    files = [root.parent / "shared" / "data" / f"trappist1_{name}.csv" for name in FILES]
    if not all(file.exists() for file in files):
        pytest.skip(f"the transit times are not at {files[0]}")
    monkeypatch.syspath_prepend(str(root / "examples"))
    trappist1 = importlib.import_module("trappist1")
    fit = trappist1.main([str(file) for file in files])
    elements, deviation = trappist1.published(files[1]), np.sqrt(np.diag(fit.covariance.matrix)).reshape(5, 7)
    for k, name in enumerate(trappist1.ELEMENTS):
        assert (np.abs(fit.params[name] - elements[name]) < 0.1 * deviation[k]).all()
    assert "χ² 679." in capsys.readouterr().out and 1.0 < fit.noise["times"].dof < 6.0


# ---- what can be wrong -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(times=[1.0]), "times must be a dict with the names of the sections, 'bottom', 'gate'"),
        (dict(times={"bottom": [1.0], "gate": [[1.0]]}), r"times must be of one dimension.*got shape \(1, 1\)"),
        (dict(times={"bottom": [np.nan], "gate": []}), "times holds no time"),
        (dict(times={"bottom": [-1.0], "gate": []}), "The time -1 is not after t0 = 0"),
        (dict(times={"bottom": [2.0, 1.0], "gate": []}), "a later time must have a larger number"),
        (dict(numbers={"bottom": [0, 1.5], "gate": [0]}), "numbers must be whole numbers from 0 on"),
        (dict(numbers={"bottom": [0], "gate": [0]}), "numbers must have the shape of times"),
        (dict(weights=-1.0), "weights must be finite and not negative"),
        (dict(start=None), "needs a start"),
        (dict(start=1.0), "start must be"),
        (dict(t0=np.nan), "t0 must be a finite number"),
        (dict(section={}), "section is an empty dict"),
    ],
)
def test_timings_that_cannot_be_are_refused(change, message):
    arguments = dict(section=SECTIONS, times={"bottom": [1.0, 2.0], "gate": [1.5]}, t0=0.0, start=START)
    with pytest.raises((TypeError, ValueError), match=message):
        lagjax.Timings(**{**arguments, **change})


def test_a_crossing_that_does_not_happen_is_named(exact):
    few = {"bottom": exact["bottom"][:3], "gate": exact["gate"][:1]}
    numbers = {"bottom": [0, 1, 2], "gate": [40]}
    with pytest.raises(ValueError, match=r"There are \d+ crossings of section\['gate'\] up to t = .*, but number 40"):
        lagjax.fit(SCENE, timings(few, numbers=numbers), TRUTH)


def test_times_with_stated_errors_beside_a_record_are_fitted_whole():
    # In units of the stated errors σ of the times is about one, which says nothing about how far segments are followed.
    ts = np.linspace(0.0, 8.0, 161)
    q = np.asarray(lagjax.simulate(SCENE, *START, ts, TRUTH).q) + 1e-3 * np.random.default_rng(0).normal(size=161)
    times = measured(1e-3)
    of_times = timings(times, lagjax.Guess(1.0, 0.0), weights={name: np.full(len(t), 1e6) for name, t in times.items()})
    fit = lagjax.fit(SCENE, [of_times, lagjax.Record(ts, q)], {"g": 9.5, "c": 0.05})
    assert fit.ok and list(fit.noise) == ["q", "times"] and "pieces" not in fit.message, fit.message
    assert fit.params["g"] == pytest.approx(9.81, rel=1e-3)


BALL = lagjax.System(
    lambda q, v: 0.5 * v**2 - 9.81 * q,
    contacts=lambda q: {"floor": q, "lids": jnp.stack([1.2 - q, 9.0 - q])},
    restitution=lambda params: params["e"],
)


def bounces(e, count):
    """The times at which a ball, let fall from 1, bounces: each flight takes e of the one before."""
    return np.sqrt(2 / 9.81) * (1 + 2 * np.cumsum(np.append(0.0, e ** np.arange(1, count))))


@pytest.mark.slow
def test_a_gap_that_an_impact_only_touches_is_said_with_what_to_write():
    heard = lagjax.Timings(bottom, bounces(0.8, 3), t0=0.0, start=(1.0, 0.0))
    with pytest.raises(ValueError, match=r"0 crossings up to .*closes a gap is no crossing: Timings\('floor', times"):
        lagjax.fit(BALL, heard, {"e": 0.8})


@pytest.mark.slow
def test_a_ball_tells_its_restitution_by_the_times_of_its_bounces():
    """By name, or in a dict beside a contact in an array; and by the times between, of a section."""
    fit = lagjax.fit(BALL, lagjax.Timings("floor", bounces(0.8, 5), t0=0.0, start=(1.0, 0.0)), {"e": 0.7})
    assert fit.ok and fit.params["e"] == pytest.approx(0.8, abs=1e-8)
    up = lagjax.simulate(BALL, 1.0, 3.0, np.array([0.0, 2.5]), {"e": 0.8})
    t, on_lid = np.asarray(up.impacts.t), np.asarray(up.impacts.impulse["lids"][:, 0]) > 0
    assert on_lid.sum() == 1
    names, times = {"low": "floor", "high": "lids[0]"}, {"low": t[:4][~on_lid[:4]], "high": t[on_lid]}
    fit = lagjax.fit(BALL, lagjax.Timings(names, times, t0=0.0, start=(1.0, 3.0)), {"e": 0.75})
    assert fit.params["e"] == pytest.approx(0.8, abs=1e-8)
    tops = (bounces(0.8, 5)[1:] + bounces(0.8, 5)[:-1]) / 2
    of_velocity = lagjax.Timings(lambda q, qdot: qdot, tops, t0=0.0, start=(1.0, 0.0), direction=-1)
    assert lagjax.fit(BALL, of_velocity, {"e": 0.75}).params["e"] == pytest.approx(0.8, abs=1e-8)


@pytest.mark.slow
def test_restitution_from_noisy_bounces_is_as_far_off_as_the_fit_says():
    """Of 20 fits some 18 intervals of 90 % hold the truth: less than 14 do in two of a thousand cases."""
    held = []
    for seed in range(20):
        noise = 2e-3 * np.random.default_rng(seed).normal(size=6)
        fit = lagjax.fit(BALL, lagjax.Timings("floor", bounces(0.8, 6) + noise, t0=0.0, start=(1.0, 0.0)), {"e": 0.7})
        low, high = np.asarray(jax.tree.leaves(fit.intervals(0.9)))
        assert fit.ok and 0.795 < fit.params["e"] < 0.805, seed
        held.append(low <= 0.8 <= high)
    assert sum(held) >= 14


@pytest.mark.parametrize(
    ("scene", "name", "sentence"),
    [
        (BALL, "lid", r"names the contact 'lid', and the contacts are 'floor', 'lids\[0\]', 'lids\[1\]'"),
        (BALL, "lids", r"names the contact 'lids', and the contacts are"),
        (SCENE, "floor", "names the contact 'floor', and this System has none"),
        (BALL, {"a": "floor", "b": bottom}, "all of one kind"),
    ],
)
def test_a_contact_that_is_not_there_is_named(scene, name, sentence):
    times = {key: jnp.array([0.5]) for key in name} if isinstance(name, dict) else jnp.array([0.5])
    with pytest.raises((TypeError, ValueError), match=sentence):
        params = {"e": 0.8} if scene is BALL else FIRST
        lagjax.fit(scene, lagjax.Timings(name, times, t0=0.0, start=(1.0, 0.0)), params)
