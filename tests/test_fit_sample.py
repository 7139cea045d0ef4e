"""Draws of a posterior: along the second-order expansion of the residuals, corrected by the exact density."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax._fit import _sample, _surrogate

SHORT = np.linspace(0.0, 3.0, 61)


def spring(q, qdot, params):
    return 0.5 * qdot**2 - 0.5 * params["k"] * q**2


def gain(q, qdot, params):
    return params["gain"] * q + params["gain"] ** 2


@pytest.mark.parametrize(
    "noise, terms", [pytest.param(lagjax.Gaussian(), 10, marks=pytest.mark.slow), (lagjax.StudentT(4.0), 61)]
)
def test_an_expansion_to_second_order_is_exact_where_signals_are_quadratic(noise, terms):
    # q is linear in its start, so gain · q + gain² is of second order in the gain and the start, and none is left out.
    # Of Gaussian noise only the sum of squares matters: as many rows as there are terms, 1 + 3 + 6.
    rng, records = np.random.default_rng(0), []
    for amplitude in (1.0, 2.0):
        q = amplitude * np.cos(2.0 * SHORT)
        records.append(lagjax.Record(SHORT, 1.5 * q + 1.5**2 + 0.3 * rng.normal(size=61), start=None))
    records[1] = lagjax.Record(SHORT, records[1].values, start=(2.0, 0.0))
    scene, starts = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2), (0.9, 0.1)
    records[0] = lagjax.Record(SHORT, records[0].values, start=lagjax.Guess(*starts))
    fit = lagjax.fit(scene, records, {"gain": 1.2}, observe=gain, noise=noise)
    density = fit.log_density(prior=lambda params: -params["gain"])
    surrogate = _surrogate.expanded(density)
    assert not isinstance(surrogate, str)
    assert [block.rows.shape for block in surrogate.blocks] == [(2, terms, 1, 10)]
    z = 3.0 * rng.normal(size=(20, len(density)))
    exact = jax.vmap(lambda z: density(surrogate.x(z)))(z)
    np.testing.assert_allclose(jax.vmap(surrogate)(z), exact, rtol=1e-7)


# ---- draws against a quadrature --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bent():
    """A posterior of k and σ that bends: half a swing in noise of a third of its amplitude, at nine instants."""
    ts = np.linspace(0.0, 2.0, 9)
    values = np.cos(2.0 * ts) + 0.3 * np.random.default_rng(4).normal(size=len(ts))
    return lagjax.fit(
        lagjax.System(spring), lagjax.Record(ts, values, start=(1.0, 0.0)), {"k": 3.0}, transforms=lagjax.positive
    )  # fmt: skip


def quadrature(fit):
    """The quantiles of k at 10, 50 and 90 %, by the density on a grid."""
    density = fit.log_density()
    width = np.sqrt(np.diag(density.covariance()))
    axes = [x + np.linspace(-6.0, 6.0, 161) * w for x, w in zip(density.first, width, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    log = np.asarray(jax.jit(jax.vmap(density))(jnp.asarray(grid.reshape(-1, 2)))).reshape(grid.shape[:2])
    share = np.cumsum(np.exp(log - log.max()).sum(axis=1))
    return np.exp(np.interp([0.1, 0.5, 0.9], share / share[-1], axes[0]))


@pytest.mark.slow
@pytest.mark.parametrize("kept", [1.0, 0.0])
def test_draws_are_those_of_the_exact_density_whatever_the_expansion_is(bent, kept, monkeypatch):
    # Kept whole, and without what bends: the exact density corrects for both.
    polynomials = _surrogate._polynomials
    monkeypatch.setattr(_surrogate, "_polynomials", lambda r, slopes, bends: polynomials(r, slopes, kept * bends))
    drawn = bent.sample(500, seed=3)
    assert drawn.attrs["sampler"].endswith(f"it accepts {float(drawn.sample_stats.acceptance_rate.mean()):.2f}.")
    k, expected = drawn.posterior["params['k']"].values, quadrature(bent)
    # A quantile of n independent draws is one of the share 0.5 ± 0.5/√n; of 2000 draws 700 or more are independent,
    # and 0.06 is three of their deviations.
    shares = [np.mean(k < x) for x in expected]
    np.testing.assert_allclose(shares, [0.1, 0.5, 0.9], atol=0.06)


@pytest.mark.slow
def test_where_few_draws_of_the_expansion_are_accepted_the_sampler_follows_the_exact_density(bent, monkeypatch):
    monkeypatch.setattr(_sample, "_LEAST", 1.1)
    drawn = bent.sample(1000, seed=1)
    assert drawn.attrs["sampler"].startswith("The No-U-Turn sampler along the exact density")
    assert "the exact density accepts 0." in drawn.attrs["sampler"]
    shares = [np.mean(drawn.posterior["params['k']"].values < x) for x in quadrature(bent)]
    np.testing.assert_allclose(shares, [0.1, 0.5, 0.9], atol=0.04)


@pytest.mark.slow
def test_chains_that_stand_still_along_the_expansion_are_not_kept(bent, monkeypatch):
    # A gradient that is not finite stops every trajectory at its first step.
    monkeypatch.setattr(_surrogate.Surrogate, "__call__", lambda self, z: jnp.sqrt(0.0 * z[0]))
    drawn = bent.sample(20, seed=1, chains=2)
    assert "the chains did not move" in drawn.attrs["sampler"]
    assert len(np.unique(drawn.posterior["params['k']"].values)) > 20


def test_an_expansion_that_would_not_fit_says_so(bent, monkeypatch):
    monkeypatch.setattr(_surrogate, "_LARGEST", 5)
    assert "more than 5" in str(_surrogate.expanded(bent.log_density()))


@pytest.mark.slow
def test_a_prior_that_excludes_half_of_the_fit(monkeypatch):
    # With flat weight above the best k only, the posterior is half of a normal one: mean k + σ √(2/π).
    rng = np.random.default_rng(0)
    values = np.cos(2.0 * SHORT) + 0.1 * rng.normal(size=len(SHORT))
    fit = lagjax.fit(lagjax.System(spring), lagjax.Record(SHORT, values, start=(1.0, 0.0)), {"k": 3.5})
    best, width = float(fit.params["k"]), float(np.sqrt(fit.covariance.matrix[0, 0]))

    def prior(params):
        return jnp.where(params["k"] > best, 0.0, -jnp.inf)

    drawn = fit.sample(200, seed=1, prior=prior).posterior["params['k']"].values
    assert drawn.min() > best and len(np.unique(drawn[:, -1])) == len(drawn)
    assert abs(drawn.mean() - (best + width * np.sqrt(2 / np.pi))) < 0.2 * width
    with pytest.raises(ValueError, match="prior is zero where the records put"):
        fit.sample(10, prior=lambda params: jnp.where(params["k"] > 2 * best, 0.0, -jnp.inf))
