"""Draws of a posterior: along the second-order expansion of the residuals, corrected by the exact density."""

import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax._fit.model._parameters import Parameters
from lagjax._fit.result import _expansion, _sample
from lagjax._fit.result._expansion import Chart

SHORT = np.linspace(0.0, 3.0, 61)


def spring(q, qdot, params):
    return 0.5 * qdot**2 - 0.5 * params["k"] * q**2


def gain(q, qdot, params):
    return params["gain"] * q + params["gain"] ** 2


@pytest.mark.parametrize(
    "noise, terms",
    [
        pytest.param(lagjax.Gaussian(), 10, marks=pytest.mark.slow),
        pytest.param(lagjax.StudentT(4.0), 61, marks=pytest.mark.slow),
    ],
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
    chart = Chart.from_density(density)
    surrogate = _expansion.expand_residuals(chart)
    assert not isinstance(surrogate, str)
    assert [block.rows.shape for block in surrogate.blocks] == [(2, terms, 1, 10)]
    z = 3.0 * rng.normal(size=(20, len(density)))
    exact = jax.vmap(chart.log_density)(z)
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
    polynomials = _expansion._polynomials
    monkeypatch.setattr(_expansion, "_polynomials", lambda r, slopes, bends: polynomials(r, slopes, kept * bends))
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
    monkeypatch.setattr(_expansion.Surrogate, "__call__", lambda self, z: jnp.sqrt(0.0 * z[0]))
    drawn = bent.sample(20, seed=1, chains=2)
    assert "the chains did not move" in drawn.attrs["sampler"]
    assert len(np.unique(drawn.posterior["params['k']"].values)) > 20


def test_an_expansion_that_would_not_fit_says_so(bent, monkeypatch):
    monkeypatch.setattr(_expansion, "_LARGEST", 5)
    with pytest.raises(_expansion.Unexpanded, match="more than 5"):
        _expansion.expand_residuals(Chart.from_density(bent.log_density()))


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


# ---- beside a bound --------------------------------------------------------------------------------------------------

BOUNDED = {"a": lagjax.positive, "b": None, "c": lagjax.between(-1.0, 3.0), "d": lagjax.between(0.0, 1e-3)}


class Correlated:
    """Stands in for a density: numbers inside of their sets, beside a bound, and far better known than a bound."""

    def __init__(self, y):
        self.residuals = SimpleNamespace(parameters=Parameters.from_pytree(y, None, BOUNDED))
        self.first = np.append(self.residuals.parameters.inverse(self.residuals.parameters.first), -2.0)
        self.point, self.dtype = SimpleNamespace(u=self.first[:-1]), np.dtype(float)

    def __len__(self):
        return len(self.first)

    def covariance(self):
        by_u = np.append(np.diag(self.residuals.parameters.jacobian(self.point.u)), 1.0)
        rows = np.random.default_rng(1).normal(size=(9, len(self))) / np.array([0.1, 2.0, 0.01, 1.0, 0.3])
        return np.linalg.inv(rows.T @ rows) / np.outer(by_u, by_u)


@pytest.mark.parametrize("a, c", [(0.3, 2.99999), (1e-9, -0.999), (50.0, 1.0)])
def test_the_volume_of_a_chart_is_the_determinant_of_its_derivative(a, c):
    chart = Chart.from_density(Correlated({"a": a, "b": 0.5, "c": c, "d": 4e-4}))
    z = np.random.default_rng(0).normal(size=(40, 5)) * np.array([3.0, 1.0, 3.0, 3.0, 1.0])
    by_z = jax.vmap(jax.jacfwd(lambda z: chart(z)[0]))(z)
    change = jax.vmap(lambda z: chart(z)[2])(z) - jnp.linalg.slogdet(by_z)[1]
    np.testing.assert_allclose(change, change[0], atol=1e-9)  # distances from bounds of 1e-9 are rounded at 1e-16
    # ζ and x belong together, and z = 0 is the centre, inside of all bounds by what the data leave open.
    x, zeta, _ = jax.vmap(chart)(z)
    near = np.abs(z).max(axis=1) < 2.0
    np.testing.assert_allclose([chart.evaluate_unknowns(row) for row in np.asarray(zeta)[near]], x[near], rtol=1e-6)
    np.testing.assert_allclose(chart(jnp.zeros(5))[1], 0.0, atol=1e-9)
    step = 1e-4 * np.eye(5)
    slopes = np.stack([chart.evaluate_unknowns(h) - chart.evaluate_unknowns(-h) for h in step], axis=1) / 2e-4
    np.testing.assert_allclose(chart.jacobian(np.zeros(5)), slopes, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_of_an_array_with_a_number_that_is_kept_the_others_are_drawn():
    def springs(q, qdot, params):
        return 0.5 * qdot**2 - 0.5 * jnp.sum(params["k"]) * q**2

    rng = np.random.default_rng(0)
    record = lagjax.Record(SHORT, np.cos(2.0 * SHORT) + 0.1 * rng.normal(size=len(SHORT)), start=(1.0, 0.0))
    free = {"k": np.array([False, True])}
    fit = lagjax.fit(lagjax.System(springs), record, {"k": np.array([1.5, 2.0])}, free=free)
    drawn = fit.sample(100, chains=4).posterior
    assert set(drawn.data_vars) == {"params['k'][1]", "sigma"}
    assert float(drawn["params['k'][1]"].mean()) == pytest.approx(2.5, abs=0.3)


def test_chains_that_disagree_are_told_of():
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=(4, 300, 1)), axis=1)
    x = np.concatenate([rng.normal(size=(4, 300, 1)), walk], axis=2)
    density = SimpleNamespace(names=("params['k']", "params['dry']"))
    drawn = _sample.Draws(x, *np.zeros((4, 4, 300)), "")
    with pytest.warns(UserWarning, match=r"1200 draws of params\['dry'\] are worth .* independent .* r-hat"):
        worst = _sample._check_agreement(density, drawn)
    assert worst["effective_draws"] < 50 and worst["r_hat"] > 1.2
    with pytest.warns(UserWarning, match="worth nan independent"):
        _sample._check_agreement(density, drawn._replace(x=x[:1, :3]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _sample._check_agreement(density, drawn._replace(x=x[..., :1]))["effective_draws"] > 800


COLUMNS = np.stack([np.cos(2 * SHORT), SHORT, np.ones(61), SHORT**2, np.sin(2 * SHORT)], axis=1)


def sensor(q, qdot, t, params):
    columns = jnp.stack([q, t, jnp.ones_like(t), t**2, -qdot / 2])
    return columns[: len(params)] @ jnp.stack([params[name] for name in sorted(params)])


# Of each parameter the best value without bounds and the ends of its set, in standard errors; ∓∞ without one.
NEAR = (0.7, 0.0, np.inf)
CASES = {
    "near zero": [NEAR, (0.0, -np.inf, np.inf)],
    "to zero": [(-0.5, 0.0, np.inf), (0.0, -np.inf, np.inf)],
    "both bounds near": [(0.5, 0.0, 2.0), (3.0, 0.0, np.inf)],
    "no transform": [(0.7, -np.inf, np.inf), (0.0, -np.inf, np.inf)],
    "five": [NEAR, (3.0, -np.inf, np.inf), (1.0, 0.0, 4.0), (6.0, 0.0, np.inf), (0.3, 0.0, np.inf)],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_draws_of_numbers_beside_their_bounds_are_those_of_a_normal_density_that_is_cut_off(case):
    # The signal is a sum of known columns, times the parameters: without bounds, and with log σ integrated out, their
    # posterior is Student's t in closed form; independent draws of it that lie outside of the bounds are left out.
    best, low, high = np.array(CASES[case]).T
    rng, size, names = np.random.default_rng(5), len(best), "abcde"
    columns = COLUMNS[:, :size]
    noise = 0.1 * rng.normal(size=61)
    noise -= columns @ np.linalg.lstsq(columns, noise)[0]
    inverse = np.linalg.inv(columns.T @ columns)
    error = np.sqrt(noise @ noise / 61 * np.diag(inverse))
    maps = [
        None if np.isinf(a) else lagjax.positive if np.isinf(b) else lagjax.between(a * e, b * e)
        for a, b, e in zip(low, high, error, strict=True)
    ]
    fit = lagjax.fit(
        lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2),
        lagjax.Record(SHORT, columns @ (best * error) + noise, start=(1.0, 0.0)),
        {name: abs(b) * e + 0.01 * e for name, b, e in zip(names, best, error, strict=False)},
        observe=sensor, transforms=dict(zip(names, maps, strict=False)),
    )  # fmt: skip
    [of_signal] = fit.noise.values()
    dof = of_signal.effective - size
    normal = rng.multivariate_normal(np.zeros(size), noise @ noise / dof * inverse, size=2_000_000)
    exact = best * error + normal / np.sqrt(rng.chisquare(dof, size=(len(normal), 1)) / dof)
    exact = exact[((exact > low * error) & (exact < high * error)).all(axis=1)]
    assert len(exact) > 20_000  # shares of it are known to 0.2 %
    drawn = fit.sample(150, seed=2, chains=8)
    assert drawn.attrs["effective_draws"] > 300 and drawn.attrs["r_hat"] < 1.05
    assert drawn.sample_stats.acceptance_rate.mean() > 0.99  # residuals are linear in the numbers
    shares = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
    for k in range(size):
        found = [np.mean(drawn.posterior[f"params['{names[k]}']"].values < q) for q in np.quantile(exact[:, k], shares)]
        # Three deviations of the share of 300 independent draws.
        assert (np.abs(found - shares) < 3 * np.sqrt(shares * (1 - shares) / 300)).all(), (names[k], found)


@pytest.mark.slow
def test_where_the_expansion_is_too_narrow_the_exact_density_is_followed(bent, monkeypatch):
    residuals = _expansion.Surrogate._residuals
    monkeypatch.setattr(_expansion.Surrogate, "_residuals", staticmethod(lambda *of: 3.0 * residuals(*of)))
    drawn = bent.sample(150, seed=1, chains=8)
    assert drawn.attrs["sampler"].startswith("The No-U-Turn sampler along the exact density")
    shares = [np.mean(drawn.posterior["params['k']"].values < x) for x in quadrature(bent)]
    np.testing.assert_allclose(shares, [0.1, 0.5, 0.9], atol=0.08)


@pytest.mark.slow
def test_dry_friction_that_may_be_zero():
    def friction(q, qdot, params):
        return -params["c"] * qdot - params["dry"] * jnp.sign(qdot)

    scene = lagjax.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q), forces=friction)
    ts, truth = np.linspace(0.0, 6.0, 121), {"c": 0.1, "dry": 0.03}
    q = np.asarray(lagjax.simulate(scene, 1.0, 0.0, ts, truth).q)
    record = lagjax.Record(ts, q + 6e-3 * np.random.default_rng(0).normal(size=121), start=(1.0, 0.0))
    fit = lagjax.fit(scene, record, {"c": 0.1, "dry": 0.05}, transforms={"c": None, "dry": lagjax.positive})
    drawn = fit.sample(100, seed=1, chains=8)
    # By a quadrature of the exact density over c and dry, log σ integrated out in closed form.
    density, best = fit.log_density(), np.array([float(fit.params["c"]), float(fit.params["dry"])])
    matrix = fit.covariance.matrix
    slope, width = matrix[0, 1] / matrix[1, 1], np.sqrt(matrix[0, 0] - matrix[0, 1] ** 2 / matrix[1, 1])
    dry = np.linspace(1e-6, best[1] + 6 * np.sqrt(matrix[1, 1]), 81)
    c = best[0] + slope * (dry[:, None] - best[1]) + width * np.linspace(-5.0, 5.0, 31)
    at = np.stack([c, np.broadcast_to(np.log(dry)[:, None], c.shape), np.full(c.shape, density.first[-1])], axis=-1)
    log = np.asarray(jax.jit(jax.vmap(density.log_likelihood))(at.reshape(-1, 3))).reshape(c.shape)
    count = 121 * density.shares[0]
    log = -0.5 * count * np.log(-2 * (log + count * density.first[-1]))
    share = np.exp(log - log.max()).sum(axis=1)
    share = np.append(0.0, np.cumsum(0.5 * (share[1:] + share[:-1])))
    shares = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
    found = [np.mean(drawn.posterior["params['dry']"].values < x) for x in np.interp(shares, share / share[-1], dry)]
    assert drawn.attrs["effective_draws"] > 300
    assert (np.abs(found - shares) < 3 * np.sqrt(shares * (1 - shares) / 300)).all(), found
