"""Posteriors and descents of several systems, against closed forms, and of one, against a quadrature."""

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax._fit import Point

TS = np.linspace(0.0, 3.0, 31)
TRUTH, FREE = {"k": 4.0, "c": 1.5}, {"k": True, "c": False}
STARTS = {"one": (1.0, 0.2), "two": (-0.5, 0.4)}


def energy(q, qdot, params):
    return 0.5 * jnp.sum(qdot**2) - 0.5 * params["k"] * jnp.sum(q**2)


def swing(start, k):
    """q of the oscillator (T,) in closed form."""
    w = jnp.sqrt(k)
    return start[0] * jnp.cos(w * TS) + start[1] / w * jnp.sin(w * TS)


SPRING, PLANE = lagjax.System(energy), lagjax.System(energy)
PUSHED = lagjax.System(energy, forces=lambda q, qdot, inputs, params: params["push"] * inputs)


def records(seed=0, sigma=0.05):
    """A record of the spring, whose start is fitted, and two of one in a plane: one start follows from c."""
    rng = np.random.default_rng(seed)
    one = swing(STARTS["one"], 4.0) + sigma * rng.normal(size=len(TS))
    two = []
    for start in (lagjax.Guess(np.array([-0.5, 1.5]), np.array([0.4, 0.0])), _of_c):
        values = np.stack([swing(STARTS["two"], 4.0), swing((1.5, 0.0), 4.0)], axis=1)
        two.append(lagjax.Record(TS, values + sigma * rng.normal(size=values.shape), start=start))
    return {"one": lagjax.Record(TS, one), "two": two}


def _of_c(params):
    return jnp.array([-0.5, params["c"]]), jnp.array([0.4, 0.0])


@pytest.fixture(scope="module")
def joint():
    return lagjax.fit({"one": SPRING, "two": PLANE}, records(), {"k": 3.8, "c": 1.4}, method="whole")


def test_a_trial_is_that_of_the_closed_form_and_one_that_is_not_finite_says_where(joint):
    residuals, starts = joint.residual_function, joint.states + 0.01
    trial = residuals.evaluate(Point(joint.u + 0.05, starts))
    # Of the spring, less the measurements, by its start and by k.
    q, slope = (jax.jit(f)(starts[0, :2], joint.u[1] + 0.05) for f in (swing, jax.jacfwd(swing, argnums=(0, 1))))
    np.testing.assert_allclose(trial.residuals[0][0, :, 0], q - records()["one"].values, atol=1e-7)
    np.testing.assert_allclose(trial.slopes[0][0, :, 0, :2], slope[0], atol=1e-7)
    np.testing.assert_allclose(trial.slopes[0][0, :, 0, 5], slope[1], atol=1e-7)
    with pytest.raises(ValueError, match=r"motion of records\['one'\]\[0\] from t = 0 failed. A parameter is not"):
        residuals.evaluate(Point(np.full(2, np.nan), starts))


def by_hand(x, shares):
    """log p of x = (c, k, start of one, start of two[0], log σ of three signals) in closed form."""
    c, k, (q, v), plane = x[0], x[1], x[2:4], x[4:8]
    sigma, data = jnp.exp(x[8:11]), records()
    left = [
        (0, swing((q, v), k) - data["one"].values),
        *((j + 1, swing((plane[j], plane[2 + j]), k) - data["two"][0].values[:, j]) for j in (0, 1)),
        *((j + 1, swing(((-0.5, c)[j], (0.4, 0.0)[j]), k) - data["two"][1].values[:, j]) for j in (0, 1)),
    ]
    return sum(shares[s] * jnp.sum(-0.5 * (rows / sigma[s]) ** 2 - jnp.log(sigma[s])) for s, rows in left)


@pytest.mark.slow
def test_the_density_of_several_systems_and_its_derivatives_are_those_of_closed_forms(joint):
    density = joint.log_density()
    assert density.names[:8] == (
        "params['c']", "params['k']", "starts['one'][0].q", "starts['one'][0].qdot",
        "starts['two'][0].q[0]", "starts['two'][0].q[1]", "starts['two'][0].qdot[0]", "starts['two'][0].qdot[1]",
    )  # fmt: skip
    assert density.names[8:] == ("log σ of one: q", "log σ of two: q[0]", "log σ of two: q[1]")
    rng, width = np.random.default_rng(1), np.sqrt(np.diag(density.covariance()))
    value_and_grad = jax.jit(jax.value_and_grad(density))
    for x in density.first + 2 * width * rng.normal(size=(3, len(density))):
        expected, slope = jax.value_and_grad(by_hand)(jnp.asarray(x), density.shares)
        value, gradient = value_and_grad(x)
        # Motions are right to rtol 1e-9, residuals of σ = 0.05 to 1e-7 of it.
        assert value == pytest.approx(float(expected), rel=1e-6)
        np.testing.assert_allclose(gradient * width, slope * width, rtol=1e-5, atol=1e-5)
    hessian = jax.hessian(by_hand)(np.asarray(density.first), density.shares)
    # Expected and observed information differ by what residuals and curvature have in common: a few times 1/√31.
    scale = np.outer(width, width)
    np.testing.assert_allclose(density.covariance() / scale, np.linalg.inv(-hessian) / scale, atol=0.2)


@pytest.mark.slow
def test_draws_by_blackjax_are_those_of_a_quadrature():
    # A posterior of k and σ that bends: half a swing in noise of a third of its amplitude, at nine instants.
    ts = np.linspace(0.0, 2.0, 9)
    values = np.cos(2.0 * ts) + 0.3 * np.random.default_rng(4).normal(size=len(ts))
    record = lagjax.Record(ts, values, start=(1.0, 0.0))
    density = lagjax.fit(SPRING, record, {"k": 3.0}, transforms=lagjax.positive).log_density()
    metric = density.covariance()
    axes = [x + np.linspace(-6.0, 6.0, 161) * w for x, w in zip(density.first, np.sqrt(np.diag(metric)), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    log = np.asarray(jax.jit(jax.vmap(density))(np.asarray(grid.reshape(-1, 2)))).reshape(grid.shape[:2])
    share = np.cumsum(np.exp(log - log.max()).sum(axis=1))
    expected = np.exp(np.interp([0.1, 0.5, 0.9], share / share[-1], axes[0]))

    sampler = blackjax.nuts(density, 0.5, metric)

    @jax.jit
    @jax.vmap
    def chain(key):
        move = lambda state, key: (sampler.step(key, state)[0],) * 2
        return jax.lax.scan(move, sampler.init(jnp.asarray(density.first)), jax.random.split(key, 550))[1].position

    draws = chain(jax.random.split(jax.random.key(0), 4))[:, 50:]
    k = jax.vmap(jax.vmap(density.params))(draws)["k"]
    # A quantile of n independent draws is one of the share 0.5 ± 0.5/√n: 0.06 is three of their deviations for 700.
    assert blackjax.ess(draws).min() > 700
    np.testing.assert_allclose([np.mean(k < x) for x in expected], [0.1, 0.5, 0.9], atol=0.06)


@pytest.mark.slow
def test_gradients_bring_several_systems_to_where_least_squares_do(joint):
    far = {"k": 3.0, "c": 1.4}
    fit = lagjax.fit({"one": SPRING, "two": PLANE}, records(), far, method="gradient")
    width = np.sqrt(np.diag(joint.covariance.matrix))
    np.testing.assert_allclose((fit.u - joint.u) / width, 0.0, atol=0.3)
    assert fit.log_likelihood == pytest.approx(joint.log_likelihood, abs=0.5)


DRIVEN = lagjax.System(energy, forces=lambda q, qdot, t, params: params["push"] * jnp.sin(t))


@pytest.mark.slow
def test_driven_free_and_timed_systems_have_one_density():
    # A driven record, one without inputs, and crossing times of a third system, with Student's noise.
    rng = np.random.default_rng(2)
    driven = np.asarray(
        lagjax.simulate(
            DRIVEN, 0.5, 0.0, TS,
            {"k": 4.0, "push": 2.0},
        ).q
    )  # fmt: skip
    passed = np.pi / 4 + np.pi / 2 * np.arange(5)
    given = {
        "driven": lagjax.Record(TS, driven + 0.02 * rng.normal(size=31), np.sin(TS)),
        "free": records(1)["one"],
        "gate": lagjax.Timings(lambda q, v: q, passed + 0.01 * rng.normal(size=5), 0.0, (1.0, 0.0)),
    }
    fit = lagjax.fit(
        {"driven": PUSHED, "free": SPRING, "gate": SPRING}, given, {"k": 3.9, "push": 1.9}, hold="linear",
        noise=lagjax.StudentT(), method="whole",
    )  # fmt: skip
    density = fit.log_density(prior=lambda params: -0.5 * params["push"] ** 2)
    width = np.sqrt(np.diag(density.covariance()))
    value_and_grad = jax.jit(jax.value_and_grad(density))
    x = density.first + 0.5 * width * rng.normal(size=len(density))
    slope = value_and_grad(x)[1]
    for k in range(len(density)):
        h = 1e-3 * width[k] * np.eye(len(density))[k]
        change = (value_and_grad(x + h)[0] - value_and_grad(x - h)[0]) / 2e-3
        # The difference bends by h², and both values are rounded at rtol 1e-9 of the motion.
        assert change == pytest.approx(float(slope[k] * width[k]), rel=1e-3, abs=1e-3), density.names[k]
