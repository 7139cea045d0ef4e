"""Transforms of whole leaves, many starts, sampling, reports and other methods of a fit."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax._fit import _transforms

TS = np.linspace(0.0, 4.0, 101)


# ---- transforms ------------------------------------------------------------------------------------------------------


def body(rng):
    """The ten inertial numbers of thirty points, and their pseudo-inertia."""
    points, masses = np.append(rng.normal(size=(30, 3)), np.ones((30, 1)), axis=1), rng.uniform(0.1, 1.0, 30)
    pseudo = points.T @ (masses[:, None] * points)
    moments = np.trace(pseudo[:3, :3]) * np.eye(3) - pseudo[:3, :3]
    xy = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    return np.array([pseudo[3, 3], *pseudo[:3, 3], *(moments[place] for place in xy)]), pseudo


TEN, PSEUDO = body(np.random.default_rng(0))


@pytest.mark.parametrize(
    "transform, start",
    [
        (lagjax.inertia, TEN),
        (lagjax.inertia, PSEUDO),
        (lagjax.simplex, np.array([0.2, 0.5, 0.1, 1.0])),
        (lagjax.angle, np.array([1.0, -3.0])),
        (lagjax.between(-1.0, 4.0), np.array([0.1, 3.0])),
    ],
)
def test_transforms_of_leaves_are_inverses_with_the_derivatives_of_differences(transform, start):
    x, rng = start.ravel(), np.random.default_rng(1)
    own = transform.of(x, start.shape)
    assert own.refuses(x) is None
    u = own.inverse(x)
    assert len(u) == own.unknowns(len(x))
    np.testing.assert_allclose(own.value(u), x, atol=1e-12)
    other = u + 0.3 * rng.normal(size=len(u))
    central = [(own.value(other + e) - own.value(other - e)) / 2e-6 for e in 1e-6 * np.eye(len(u))]
    np.testing.assert_allclose(own.jacobian(other), np.transpose(central), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(own.value(jnp.asarray(u), jnp), x, rtol=1e-6)
    if start.shape != (4, 4):  # a matrix holds every product twice
        volume = [0.5 * np.linalg.slogdet(own.jacobian(at).T @ own.jacobian(at))[1] for at in (u, other)]
        assert own.log_volume(u) - own.log_volume(other) == pytest.approx(volume[0] - volume[1])
    low, high = own.ends(x, 0.1 * np.ones(len(x)))
    assert (low < x).all() and (x < high).all()


def test_every_u_is_an_inertia_that_a_body_can_have():
    for u in np.random.default_rng(2).normal(size=(50, 10)):
        x = lagjax.inertia.value(u)
        m, *_, xx, yy, zz, _, _, _ = x
        assert m > 0 and xx + yy > zz and yy + zz > xx and zz + xx > yy
        assert lagjax.inertia.refuses(x) is None


def lagrangian(q, qdot, params):
    """An oscillator under three springs, whose strengths are shares; and a bead in the field of a turned dipole."""
    spring = jnp.sum(params["shares"] * jnp.array([1.0, 4.0, 9.0]))
    return 0.5 * jnp.sum(qdot**2) - 0.5 * spring * q[0] ** 2 - 0.5 * q[1] ** 2 + jnp.cos(q[1] - params["phase"])


SCENE = lagjax.System(lagrangian)


def record(params, sigma=1e-2, seed=0):
    start = np.array([1.0, 0.5]), np.array([0.0, 1.0])
    q = np.asarray(lagjax.simulate(SCENE, *start, TS, params).q)
    return lagjax.Record(TS, q + sigma * np.random.default_rng(seed).normal(size=q.shape))


def test_an_angle_is_found_over_the_turn_and_a_simplex_keeps_its_sum():
    truth = {"shares": np.array([0.5, 0.3, 0.2]), "phase": np.array(3.1)}
    fit = lagjax.fit(
        SCENE,
        record(truth),
        {"shares": np.array([0.2, 0.3, 0.5]), "phase": np.array(-2.9)},
        transforms={"shares": lagjax.simplex, "phase": lagjax.angle},
    )
    low, high = fit.intervals(0.999)
    assert low["phase"] < 3.1 < high["phase"] and -np.pi < fit.params["phase"] <= np.pi
    assert np.sum(fit.params["shares"]) == pytest.approx(1.0, abs=1e-12) and len(fit.u) == 3
    # One frequency tells one combination of two free shares, and its intervals are those of nothing.
    assert fit.params["shares"] @ [1.0, 4.0, 9.0] == pytest.approx(0.5 + 1.2 + 1.8, rel=0.02)
    assert len(fit.unseen) == 1 and "params['shares'][0], params['shares'][1]" in fit.unseen[0], fit.unseen
    assert (low["shares"] == 0).all() and (high["shares"] == 1).all()
    assert fit.covariance.matrix.shape == (4, 4)
    with pytest.raises(ValueError, match="moves only together with the other numbers of"):
        fit.profile("params['shares'][1]")


PARAMS = {"shares": np.ones(3), "phase": 0.0}


@pytest.mark.parametrize(
    "start, transform, message",
    [
        (np.array([1.0]), lagjax.simplex, "several numbers above zero"),
        (np.array([1.0, 0.0]), lagjax.simplex, "several numbers above zero"),
        (np.ones(9), lagjax.inertia, r"shape \(10,\) or \(4, 4\)"),
        (np.array([1.0, 0, 0, 0, 1.0, 1.0, 5.0, 0, 0, 0]), lagjax.inertia, "density is positive everywhere"),
    ],
)
def test_a_leaf_that_starts_outside_of_its_set_is_refused(start, transform, message):
    with pytest.raises(ValueError, match=message):
        lagjax.fit(
            SCENE,
            lagjax.Record(TS, np.zeros((len(TS), 2))),
            PARAMS | {"x": start},
            transforms={"shares": None, "phase": None, "x": transform},
        )


def test_the_sum_of_a_simplex_is_that_of_its_start():
    own = _transforms.simplex.of(np.array([1.0, 2.0, 4.0]), (3,))
    assert np.sum(own.value(np.array([0.3, -2.0]))) == pytest.approx(7.0)
