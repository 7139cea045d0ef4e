"""Powers whose base comes to zero: exponents that are numbers of a member, and slopes that are infinite there.

A unit mass in V = k |q|ᵖ, from rest at 1, is at zero after T/4 = √(π/2k) Γ(1 + 1/p) / Γ(1/2 + 1/p), with speed √(2k).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import digamma, gamma

import lagjax

WELL = lagjax.System(lambda q, v, params: 0.5 * v**2 - params["k"] * abs(q) ** params["p"])
DRAG = lagjax.System(
    lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params: -params * jnp.sign(v) * abs(v) ** 1.7
)
POWER_WELL = lagjax.System(lambda q, v, params: 0.5 * v**2 - q**params)
EXPONENTS = np.array([1.5, 1.9, 2.0, 2.1, 3.0, 7.0, 10.0, 12.5])


def quarter(p):
    return np.sqrt(np.pi / 2) * gamma(1 + 1 / p) / gamma(0.5 + 1 / p)


def test_an_exponent_of_params_may_be_whole_or_not_where_its_base_is_zero():
    ts, scaled = np.array([0.0, 2.0]), {"p": EXPONENTS, "k": quarter(EXPONENTS) ** 2}
    run = lagjax.simulate_batch(WELL, np.ones(8), np.zeros(8), ts, scaled, batch_axes=(0, 0, 0))
    np.testing.assert_allclose(run.q[:, -1], -1.0, atol=1e-8)
    with jax.enable_x64(False):
        run = lagjax.simulate(WELL, 1.0, 0.0, ts, {"p": np.int32(2), "k": (np.pi / 2) ** 2 / 2})
    assert run.q.dtype == jnp.float32 and abs(run.q[-1] + 1) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("p", [2.0, 2.6, 3.0])
def test_the_slope_by_an_exponent(p):
    # At the end of a period the motion is where it began, with the acceleration -p.
    by_p = -4 * quarter(p) / p**2 * (digamma(1 + 1 / p) - digamma(0.5 + 1 / p))
    ts = np.array([0.0, 4 * quarter(p)])
    speed = lambda p: lagjax.simulate(WELL, 1.0, 0.0, ts, {"p": p, "k": 1.0}).qdot[-1]
    for slope in (jax.grad(speed)(p), jax.jvp(speed, (p,), (1.0,))[1]):
        assert abs(slope - p * by_p) < 1e-5


@pytest.mark.slow
def test_the_slope_by_a_whole_exponent_has_no_series_from_zero():
    end = lambda q0, p: lagjax.simulate(WELL, q0, 1.0, np.array([0.0, 0.5]), {"p": p, "k": 2.0}).q[-1]
    by_start, by_p = jax.grad(end, (0, 1))(0.0, 2.0)
    assert abs(by_start - np.cos(1.0)) < 1e-9 and not np.isfinite(by_p)


@pytest.mark.slow
def test_drag_of_a_start_at_rest_has_the_same_slopes_in_both_modes():
    speed = lambda c: lagjax.simulate(DRAG, 1.0, 0.0, np.array([0.0, 2.0]), c).qdot[-1]
    assert abs(jax.grad(speed)(0.3) - jax.jvp(speed, (0.3,), (1.0,))[1]) < 1e-12


def test_a_power_that_is_no_number_is_named():
    assert (
        abs(lagjax.simulate(POWER_WELL, 1.0, 0.0, np.array([0.0, np.pi]), 2).q[-1] - np.cos(np.sqrt(2) * np.pi)) < 1e-9
    )
    with pytest.raises(lagjax.SimulationError, match=r"derivative of L by q \(nan\). It comes from pow\(-"):
        lagjax.simulate(POWER_WELL, 1.0, 0.0, np.array([0.0, np.pi]), 2.5)
