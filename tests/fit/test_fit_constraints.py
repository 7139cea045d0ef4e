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


def test_what_cannot_be_with_starts_on_constraints_is_a_sentence():
    record, _ = measured(1e-3)
    with pytest.raises(ValueError, match="starts must be 1 where starts on constraints are fitted"):
        lagjax.fit(SCENE, record, TRUTH, free=FREE, starts=4)
