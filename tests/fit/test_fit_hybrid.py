"""`fit` of hybrid motion: restitution from bounces, friction of a block that sticks and slips, by closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particle, spring
from scenes import FREE
from scipy.optimize import least_squares

import lagjax
from lagjax._fit import Point
from lagjax._primitives import Repetition

G, E, V0 = 9.81, 0.9, 3.0

FLIGHT = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - G * q)
BOUNCE = lagjax.Transition(
    "flight", "flight", guard=lambda q, v: q, direction=-1, reset=lambda q, v, params: (q, -params["e"] * v)
)
BALL = lagjax.Hybrid({"flight": FLIGHT}, [BOUNCE], "flight", max_transitions=16)


def thrown(params):
    """The ball leaves the table with the velocity v0."""
    return 0.0, params["v0"]


def times_of(e, v0, count=12):
    """When a ball that leaves the table at t = 0 comes back: Σ 2 v₀ eʲ/g."""
    return np.cumsum(2 * v0 * e ** np.arange(count) / G)


# A block on a belt of speed BELT, held by a spring: it sticks until the spring wins, and slips until it is as fast.
BELT, BEGIN = 0.5, (-0.2, 0.0)
SLIP = lagjax.System(spring, forces=lambda q, v, params: params["kinetic"])
STICKS = lagjax.Transition("slip", "stick", lambda q, v: v - BELT, direction=1, reset=lambda q, v: (q, BELT + 0 * v))
SLIPS = lagjax.Transition("stick", "slip", lambda q, v, params: params["k"] * q - params["static"], direction=1)
BLOCK = lagjax.Hybrid({"slip": SLIP, "stick": FREE}, [STICKS, SLIPS], "slip")
FRICTION = {"k": 4.0, "kinetic": 0.6, "static": 1.2}
TS = np.linspace(0.0, 8.0, 161)


def block(ts, k, kinetic, static):
    """q of the block in closed form: arcs of an oscillator about kinetic/k, and lines."""
    w, q, v, t, middle, found = np.sqrt(k), *BEGIN, 0.0, kinetic / k, np.full(len(ts), np.nan)
    while t < ts[-1]:
        size, phase = np.hypot(q - middle, v / w), np.arctan2(-v / w, q - middle)
        # −size·w·sin(w s + phase) = BELT, rising: on the way up before the middle.
        begin = np.pi + np.arcsin(BELT / (size * w))
        slips = (begin - phase) % (2 * np.pi) / w
        slips = slips if slips > 1e-9 else slips + 2 * np.pi / w
        inside = (ts >= t) & (ts <= t + slips)
        found[inside] = middle + size * np.cos(w * (ts[inside] - t) + phase)
        q, t = middle + size * np.cos(w * slips + phase), t + slips
        sticks = (static / k - q) / BELT
        inside = (ts >= t) & (ts <= t + sticks)
        found[inside] = q + BELT * (ts[inside] - t)
        q, v, t = static / k, BELT, t + sticks
    return found


@pytest.mark.slow
def test_restitution_from_times_of_bounces_is_that_of_least_squares_on_the_closed_form():
    times = times_of(E, V0) + 1e-3 * np.random.default_rng(0).normal(size=12)
    timings = lagjax.Timings(BOUNCE, times, 0.0, thrown)
    fit = lagjax.fit(BALL, timings, {"e": 0.8, "v0": 2.5})
    alone = least_squares(lambda x: times_of(*x) - times, [0.8, 2.5], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    width = np.sqrt(np.diag(fit.information.white))
    # A search ends within 0.05 standard deviations.
    np.testing.assert_allclose(fit.u / width, alone.x / width, rtol=0, atol=0.05)
    expected = 2 * alone.cost / 12 * np.linalg.inv(alone.jac.T @ alone.jac)
    lost = 12 / (12 - 2)
    np.testing.assert_allclose(fit.information.white * lost, expected * lost, rtol=1e-2)
    assert fit.ok and fit.noise["times"].sigma == pytest.approx(1e-3, rel=0.5)


@pytest.fixture(scope="module")
def stuck():
    values = block(TS, **FRICTION) + 2e-3 * np.random.default_rng(1).normal(size=len(TS))
    return lagjax.Record(TS, values, start=lagjax.Guess(-0.25, 0.05))


@pytest.mark.slow
def test_static_and_kinetic_friction_come_out_of_a_block_that_sticks_and_slips(stuck):
    fit = lagjax.fit(BLOCK, stuck, {"k": 3.8, "kinetic": 0.5, "static": 1.1}, transforms=lagjax.positive)
    low, high = fit.intervals(0.9999)
    assert fit.ok and all(low[name] < FRICTION[name] < high[name] for name in FRICTION)
    # Four slips and sticks: each friction shows in where they begin, at 2 mm noise.
    assert all(0.5 * (high[name] - low[name]) < 0.02 * FRICTION[name] for name in FRICTION)
    assert fit.noise["q"].sigma == pytest.approx(2e-3, rel=0.2)
    shown = fit.predict(stuck)
    assert set(np.asarray(shown.trajectory.mode).tolist()) == {0, 1}
    np.testing.assert_allclose(shown.values, block(TS, **FRICTION), atol=4e-3)


@pytest.mark.slow
def test_slopes_and_the_density_of_hybrid_motion_are_those_of_differences(stuck):
    heard = lagjax.Timings(STICKS, np.array([0.1, 2.5, 4.8]) + 0.5, 0.0, BEGIN)
    fit = lagjax.fit(
        {"seen": BLOCK, "heard": BLOCK}, {"seen": stuck, "heard": heard}, {"k": 3.9, "kinetic": 0.6, "static": 1.2},
        free={"k": True, "kinetic": True, "static": True}, method="whole",
    )  # fmt: skip
    function, point, h = fit.residual_function, fit._point, 1e-6
    for k in range(5):
        moved = []
        for sign in (-h, h):
            u, starts = fit.u.copy(), fit.states.copy()
            if k < 3:
                u[k] += sign
            else:
                starts[0, k - 3] += sign
            moved.append(function.evaluate(Point(u, starts)))
        column = k + 2 if k < 3 else k - 3
        for residuals, slopes in zip(zip(*(one.residuals for one in moved), strict=True), point.slopes, strict=True):
            change = (residuals[1] - residuals[0]) / (2 * h)
            # Motions are right to rtol 1e-9, differences then to 1e-9 / 1e-6.
            np.testing.assert_allclose(slopes[..., column], change, atol=2e-3, rtol=1e-3)
    density = fit.log_density()
    width, value_and_grad = np.sqrt(np.diag(density.covariance())), jax.jit(jax.value_and_grad(density))
    slope = value_and_grad(jnp.asarray(density.first))[1] * width
    for k in range(len(density)):
        step = 1e-3 * width[k] * np.eye(len(density))[k]
        change = (value_and_grad(density.first + step)[0] - value_and_grad(density.first - step)[0]) / 2e-3
        assert change == pytest.approx(float(slope[k]), rel=1e-2, abs=5e-3), density.names[k]


FALLS = lagjax.Record(np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 11), start=(0.5, 0.0))
FIRST = {"e": 0.9, "v0": 3.0}
OTHER = lagjax.Transition("flight", "flight", guard=lambda q, v: q - 9.0)
TWICE = lagjax.Hybrid({"flight": FLIGHT}, [BOUNCE, OTHER], "flight")


def heard(section, times=(0.5, 1.0), **options):
    return lagjax.Timings(section, np.array(times), 0.0, thrown, **options)


@pytest.mark.parametrize(
    ("system", "records", "options", "sentence"),
    [
        (
            BALL,
            FALLS,
            {"observe": lagjax.Delayed(lambda params: 0.1, 0.2)},
            "hybrid motion cannot be lagjax.Delayed",
        ),
        (BALL, heard(lambda q, v: q), {}, "only the times of its transitions"),
        (FLIGHT, heard(BOUNCE), {}, "are of a lagjax.Hybrid"),
        (BALL, heard(OTHER), {}, "is none of Hybrid"),
        (TWICE, heard(BOUNCE), {}, "2 transitions lead from 'flight' to 'flight'"),
        (BALL, heard(BOUNCE, np.arange(1.0, 18.0)), {}, "follows no more than that"),
    ],
)
def test_what_a_fit_of_hybrid_motion_cannot_do_is_a_sentence(system, records, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        lagjax.fit(system, records, FIRST, **options)


def test_timings_of_transitions_and_functions_do_not_mix():
    with pytest.raises(TypeError, match="all of one kind"):
        lagjax.Timings({"a": BOUNCE, "b": lambda q, v: q}, {"a": [1.0], "b": [2.0]}, 0.0, thrown)
    with pytest.raises(ValueError, match="a transition, or a contact, has its own"):
        heard(BOUNCE, direction=-1)
    with pytest.raises(ValueError, match="is no mode"):
        lagjax.Hybrid({"flight": FLIGHT}, [BOUNCE], "rest")


@pytest.mark.slow
def test_bounces_that_a_motion_does_not_have_are_counted():
    late = lagjax.Timings(BOUNCE, np.array([0.6, 1.2]), 0.0, (0.5, 0.0), numbers=np.array([0, 9]))
    with pytest.raises(ValueError, match=r"There are \d transitions from 'flight' to 'flight' up to .* but number 9"):
        lagjax.fit(BALL, late, {"e": 0.95}, starts=1)
    found = lagjax.fit(BALL, late, {"e": 0.95})  # of the closest that any ball can do
    assert "The motion with params0 could not be followed" in found.message and found.rms["times"] > 0.1


@pytest.mark.slow
def test_where_the_first_guess_cannot_be_followed_other_starts_are_tried_and_said(stuck, capfd):
    begin = {"k": 4.6, "kinetic": 0.71, "static": 0.61}  # it cannot stick where it slips: static below kinetic
    with pytest.raises(ValueError, match="Begin nearer"):
        lagjax.fit(BLOCK, stuck, begin, transforms=lagjax.positive, starts=1)
    fit = lagjax.fit(BLOCK, stuck, begin, transforms=lagjax.positive, progress=True)
    low, high = fit.intervals(0.9999)
    assert fit.ok and all(low[name] < FRICTION[name] < high[name] for name in FRICTION)
    assert "The motion with params0 could not be followed" in fit.message and len(fit.waterfall.misfits) % 16 == 0
    said = capfd.readouterr().err
    assert "One start is not enough, others are tried: The motion of records[0]" in said and "start 16 of 16:" in said


def test_a_trial_plays_its_motion_once(monkeypatch):
    """The values are those of the search; the rounds are played for the derivatives alone."""
    played, play = [], Repetition.run

    def count(self, *given, **options):
        played.append(self)
        return play(self, *given, **options)

    def path(e):
        return lagjax.simulate(BALL, 0.5, 0.0, TS[:20], {"e": e}).q

    monkeypatch.setattr(Repetition, "run", count)
    tangent = jax.jit(lambda e: jax.jvp(path, (e,), (1.0,))[1])(0.9)
    assert len(played) == 1
    step = 1e-6
    change = (np.asarray(path(0.9 + step)) - np.asarray(path(0.9 - step))) / (2 * step)
    np.testing.assert_allclose(tangent, change, atol=1e-6)


# ---- contacts: where one search ends beside the truth ----------------------------------------------------------------

PUCK = lagjax.System(
    free_particle,
    forces=lambda q, v, params: -params["mu"] * 9.81 * jnp.sign(v),
    contacts=lambda q: jnp.stack([q, 1 - q]),
    restitution=lambda params: params["e"],
)
CUSHION = lagjax.System(
    lambda q, v: 0.5 * v @ v, contacts=lambda q: q[1], slip=lambda q, v: v[0],
    restitution=lambda params: params["e"], friction=lambda params: params["mu"],
)  # fmt: skip


@pytest.mark.slow
def test_a_puck_between_walls_is_found_from_far_or_said_not_to_be():
    ts, truth = np.linspace(0.0, 4.0, 201), {"mu": 0.05, "e": 0.85}
    noise = 0.002 * np.random.default_rng(0).normal(size=201)
    exact = np.asarray(lagjax.simulate(PUCK, 0.5, 2.0, ts, truth).q)

    def fit(values, mu, e, speed, **options):
        record = lagjax.Record(ts, values, start=lagjax.Guess(0.5, speed))
        maps = {"mu": lagjax.positive, "e": lagjax.between(0.0, 1.0)}
        return lagjax.fit(PUCK, record, {"mu": mu, "e": e}, transforms=maps, **options)

    for first in ((0.1, 0.9, 1.5), (0.2, 0.6, 2.5)):
        found = fit(exact + noise, *first)
        low, high = found.intervals(0.999)
        assert found.ok and found.rms["q"] < 2.2e-3 and all(low[k] <= x <= high[k] for k, x in truth.items())
    other = fit(exact + noise + 0.06 * np.sin(5 * ts), 0.05, 0.8, 2.0)  # of another scene
    assert not other.ok and "Take starts=256" in other.message


@pytest.mark.slow
@pytest.mark.parametrize("mu, starts", [(0.05, 1), (0.1, 1), (0.3, None)])
def test_an_oblique_impact_that_slides_is_found_from_where_it_sticks(mu, starts):
    ts, start = np.linspace(0.0, 2.0, 101), (jnp.array([0.0, 1.0]), jnp.array([0.2772, -1.0]))
    exact = np.asarray(lagjax.simulate(CUSHION, *start, ts, {"mu": 0.15, "e": 0.8}).q)  # from 0.154 on it sticks
    record = lagjax.Record(ts, exact + 0.002 * np.random.default_rng(0).normal(size=exact.shape), start=start)
    found = lagjax.fit(CUSHION, record, {"mu": mu, "e": 0.7}, transforms=lagjax.positive, starts=starts)
    assert found.ok and found.params["mu"] == pytest.approx(0.15, abs=0.003)
    assert (found.waterfall is None) == (starts == 1)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.1, 0.3])
def test_an_oblique_impact_that_sticks_does_not_tell_its_friction(mu):
    ts, start = np.linspace(0.0, 2.0, 101), (jnp.array([0.0, 1.0]), jnp.array([0.2772, -1.0]))
    exact = np.asarray(lagjax.simulate(CUSHION, *start, ts, {"mu": 0.3, "e": 0.8}).q)
    record = lagjax.Record(ts, exact + 0.002 * np.random.default_rng(0).normal(size=exact.shape), start=start)
    found = lagjax.fit(CUSHION, record, {"mu": mu, "e": 0.7}, transforms=lagjax.positive, starts=1)
    assert not found.ok and "params['mu']" in found.unseen[0] and found.params["e"] == pytest.approx(0.8, abs=0.003)
    assert found.waterfall is None


# ---- sampled inputs --------------------------------------------------------------------------------------------------


def fall(q, qdot):
    return 0.5 * qdot**2 - 9.81 * q


def add_input_forces(damped):
    return lambda q, qdot, params, inputs: params["gain"] * inputs - damped * params["c"] * qdot


def push_by_time(change):
    known = lambda t: jnp.where(t < change, 2.0, -1.0)
    return lambda damped: lambda q, qdot, t, params: params["gain"] * known(t) - damped * params["c"] * qdot


def pushed_ball(force):
    laws = {"contacts": lambda q: {"floor": q}, "restitution": lambda params: params["e"]}
    return lagjax.System(fall, forces=force(0.0), **laws)


def pushed_modes(force):
    """A spring, beyond an edge in oil."""
    edge = lambda q, qdot, params: q - params["edge"]
    modes = {
        name: lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2, forces=force(damped))
        for name, damped in (("free", 0.0), ("damped", 1.0))
    }
    there = lagjax.Transition("free", "damped", edge, direction=1, reset=lambda q, qdot, params: (q, qdot))
    return lagjax.Hybrid(modes, [there, lagjax.Transition("damped", "free", edge, direction=-1)], "free")


@pytest.mark.slow
@pytest.mark.parametrize(
    "build, begin, change, ts, truth, params0",
    [
        (pushed_ball, 1.0, 0.5, np.linspace(0.0, 1.2, 121), {"gain": 0.8, "e": 0.7}, {"gain": 0.5, "e": 0.6}),
        (pushed_modes, -1.0, 1.0, np.linspace(0.0, 5.0, 251), {"k": 4.0, "gain": 0.4, "c": 0.6, "edge": 0.1},
         {"k": 3.8, "gain": 0.3, "c": 0.4, "edge": 0.12}),
    ],
)  # fmt: skip
def test_motion_that_jumps_is_driven_by_samples(build, begin, change, ts, truth, params0):
    more = {"c": 0.0} | truth
    q = np.asarray(lagjax.simulate(build(push_by_time(change)), begin, 0.0, ts, more).q)
    u = np.where(ts < change - 1e-9, 2.0, -1.0)
    rows = [
        lagjax.Record(ts, q + 1e-3 * np.random.default_rng(k).normal(size=len(ts)), inputs=u, start=start)
        for k, start in enumerate(((begin, 0.0), lagjax.Guess(0.95 * begin, 0.1)))
    ]
    free = dict.fromkeys({"c": 0.0} | params0, True) | {"c": "c" in truth}
    fit = lagjax.fit(build(add_input_forces), rows, {"c": 0.0} | params0, free=free)
    low, high = fit.intervals(0.999)
    assert fit.ok and all(low[key] < value < high[key] for key, value in truth.items())
    assert fit.starts[1][0] == pytest.approx(begin, abs=2e-3)
