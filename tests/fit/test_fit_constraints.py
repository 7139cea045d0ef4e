"""`fit` of starts that lie on constraints: a weight on a rod, in Cartesian coordinates."""

import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import weight_in_gravity

import lagjax
from lagjax._fit import Point

TRUTH = {"g": 9.81, "c": 0.2, "length": 0.8}
TS = np.linspace(0.0, 3.0, 61)


def rod(q, params):
    return q @ q - params["length"] ** 2


def air(q, qdot, params):
    return 0.5 * params["c"] * jnp.sum(qdot**2)


SCENE = lagjax.System(weight_in_gravity, dissipation=air, constraints=rod)
FREE = {"g": True, "c": True, "length": False}


def measured(sigma, angle=0.9, rate=0.4, seed=0):
    length = TRUTH["length"]
    start = length * np.array([np.sin(angle), -np.cos(angle)])
    moving = length * rate * np.array([np.cos(angle), np.sin(angle)])
    values = np.asarray(lagjax.simulate(SCENE, start, moving, TS, TRUTH).q)
    noise = np.random.default_rng(seed).normal(size=values.shape)
    return lagjax.Record(TS, values + sigma * noise), np.concatenate([start, moving])


def test_starts_on_constraints_are_found_and_stay_there():
    (one, first), (other, second) = measured(2e-3), measured(2e-3, -0.5, 1.0, 1)
    fit = lagjax.fit(SCENE, [one, other], {**TRUTH, "g": 9.0, "c": 0.1}, free=FREE)
    deviation = np.sqrt(np.diag(fit.covariance.matrix))
    assert fit.ok and (np.abs([fit.params["c"] - 0.2, fit.params["g"] - 9.81]) < 4 * deviation).all()
    for state, truth in zip(fit.states, (first, second), strict=True):
        q, qdot = state[:2], state[2:]
        assert abs(q @ q - 0.64) < 1e-12 and abs(q @ qdot) < 1e-12
        np.testing.assert_allclose(state, truth, atol=2e-2)


@pytest.mark.slow
def test_the_derivatives_are_those_of_differences_also_by_the_length_of_the_rod():
    record, truth = measured(0.0)
    fit = lagjax.fit(SCENE, record, TRUTH, method="whole")
    u, states = fit.parameters.inverse(np.asarray(fit.parameters.first)), truth[None]
    point = fit.residual_function.evaluate(Point(u, states))
    for k, step in enumerate(1e-5 * np.eye(4 + len(u))):
        ends = [
            fit.residual_function.evaluate(Point(u + w * step[4:], states + w * step[:4])).residuals[0] for w in (1, -1)
        ]
        np.testing.assert_allclose(point.slopes[0][..., k], (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-6)
    assert fit.params["length"] == pytest.approx(0.8, rel=1e-7)


def test_many_starts_come_to_one_end_where_starts_lie_on_constraints():
    record, _ = measured(1e-3)
    one, four = (lagjax.fit(SCENE, record, TRUTH, free=FREE, starts=k) for k in (1, 4))
    # A search ends within 0.05 standard deviations.
    np.testing.assert_allclose(four.u, one.u, atol=0.05 * np.sqrt(np.diag(one.information.white)).max())
    assert four.ok and len(four.waterfall.misfits) == 4


# ---- driven, between walls, and in modes -----------------------------------------------------------------------------

SWING = np.linspace(0.0, 3.0, 301)


def on_circle(q):
    return q @ q - 1.0


def weight(q, qdot, params):
    return 0.5 * qdot @ qdot - params["g"] * q[1]


def bob(q, qdot, params):
    """The same weight by its angle, which has no constraint: the truth."""
    return 0.5 * qdot**2 + params["g"] * jnp.cos(q)


def fit_swing(scene, angle_scene, truth, params0, **more):
    theta = np.asarray(lagjax.simulate(angle_scene, 1.0, 0.0, SWING, truth).q)
    values = np.stack([np.sin(theta), -np.cos(theta)], axis=1)
    noise = 1e-3 * np.random.default_rng(0).normal(size=values.shape)
    guess = lagjax.Guess(np.array([0.8, -0.5]), np.zeros(2))
    record = lagjax.Record(SWING, values + noise, start=guess, **more)
    fit = lagjax.fit(scene, record, params0, hold="cubic")
    low, high = fit.intervals(0.999)
    assert fit.ok and all(low[key] < value < high[key] for key, value in truth.items())
    [(q, qdot)] = fit.starts
    assert abs(q @ q - 1.0) < 1e-12 and abs(q @ qdot) < 1e-12
    np.testing.assert_allclose(q, [np.sin(1.0), -np.cos(1.0)], atol=2e-3)
    assert np.std(fit.predict(record).residuals) == pytest.approx(1e-3, rel=0.1)


def push(q, qdot, params, inputs):
    return params["gain"] * inputs * jnp.array([1.0, 0.0])


def push_angle(q, qdot, t, params):
    return params["gain"] * 2.0 * jnp.sin(3.0 * t) * jnp.cos(q)


def drag(q, qdot, params):
    return -params["c"] * qdot


def bounce(params):
    return params["e"]


DRIVEN = lagjax.System(weight, forces=push, constraints=on_circle), lagjax.System(bob, forces=push_angle)
WALLED = (
    lagjax.System(weight, constraints=on_circle, contacts=lambda q: {"wall": q[0] + 0.3}, restitution=bounce),
    lagjax.System(bob, contacts=lambda q: {"wall": jnp.sin(q) + 0.3}, restitution=bounce),
)
MODES = tuple(
    lagjax.Hybrid({"air": air, "oil": oil}, [lagjax.Transition("air", "oil", guard)], "air")
    for air, oil, guard in (
        (
            lagjax.System(weight, constraints=on_circle),
            lagjax.System(weight, constraints=on_circle, forces=drag),
            lambda q, qdot: q[0],
        ),
        (lagjax.System(bob), lagjax.System(bob, forces=drag), lambda q, qdot: q),
    )
)
MOVED = lagjax.System(weight, constraints=lambda q, inputs: (q[0] - inputs) ** 2 + q[1] ** 2 - 1.0)


@pytest.mark.slow
def test_a_start_on_a_constraint_of_a_driven_scene():
    u = 2.0 * np.sin(3.0 * SWING)
    fit_swing(*DRIVEN, {"g": 9.81, "gain": 0.8}, {"g": 9.7, "gain": 0.5}, inputs=u)


@pytest.mark.slow
def test_a_start_on_a_constraint_beside_a_contact():
    fit_swing(*WALLED, {"g": 9.81, "e": 0.8}, {"g": 9.7, "e": 0.78})


@pytest.mark.slow
def test_a_start_on_a_constraint_of_hybrid_motion():
    fit_swing(*MODES, {"g": 9.81, "c": 0.5}, {"g": 9.7, "c": 0.4})


def test_a_start_on_a_constraint_that_is_driven_is_refused():
    record = lagjax.Record(SWING, np.stack([np.sin(SWING), -np.cos(SWING)], axis=1), inputs=0.1 * np.sin(SWING))
    with pytest.raises(ValueError, match="A start on constraints that ask for `inputs` cannot be fitted"):
        lagjax.fit(MOVED, record, {"g": 9.81}, hold="cubic")
