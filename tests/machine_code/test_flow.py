"""Derivatives of machine code: the transpose of its steps, against sensitivities and against what is known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import CLIFF, SPRING_K

import lagjax
from lagjax._engine import Problem
from lagjax._engine.taylor import Tolerances, _derivatives, flow_of
from lagjax._interface import Layout

TOLERANCES = Tolerances(1e-11, 1e-11, 4096)


def chain(q, v, params):
    """A chain of point masses on rods."""
    m, l = params["m"], params["l"]

    def places(q):
        return jnp.stack([jnp.cumsum(l * jnp.sin(q)), -jnp.cumsum(l * jnp.cos(q))])

    velocity = jax.jvp(places, (q,), (v,))[1]
    return 0.5 * jnp.sum(m * velocity**2) - params["g"] * jnp.sum(m * places(q)[1])


CHAIN = lagjax.System(chain)


def sliding(q, v, params):
    """A bead in the plane, its L; the ellipse it slides on is a constraint."""
    return 0.5 * params["m"] * jnp.sum(v**2) - params["m"] * 9.81 * q[1]


def ellipse(q, params):
    return (q[0] / params["a"]) ** 2 + q[1] ** 2 - 1.0


@pytest.fixture(scope="module")
def double():
    params = {"m": jnp.ones(2), "l": jnp.ones(2), "g": 9.81}
    return flow_of(Problem.from_system(CHAIN, Layout.from_state(jnp.zeros(2), jnp.zeros(2)), params))


def batch(members: int, seed: int = 0):
    """States and numbers of members that differ."""
    rng = np.random.default_rng(seed)
    numbers = np.concatenate([rng.uniform(0.5, 1.5, (members, 4)), np.full((members, 1), 9.81)], axis=1)
    numbers = numbers[:, [4, 2, 3, 0, 1]]  # the leaves of params in their order: g, l, m
    return rng.uniform(-1, 1, (members, 4)), numbers, rng


def by_tangents(flow, ts, y0, numbers, run, path_bar, y_bar):
    """The cotangents of (y0, params) from the whole Jacobian, (N, 2n + P)."""
    inputs, motions = y0.shape[1] + numbers.shape[1], _derivatives.Motions.from_solution(ts, y0, numbers, run)
    directions = np.split(np.broadcast_to(np.eye(inputs), (len(y0), inputs, inputs)), [y0.shape[1]], axis=2)
    path, end = _derivatives.jvp(flow, motions, *directions, TOLERANCES)
    return np.einsum("nrts,nts->nr", path, path_bar) + np.einsum("nrs,ns->nr", end, y_bar)


def vjp(flow, ts, y0, numbers, run, path_bar, y_bar):
    """One cotangent for each member."""
    motions = _derivatives.Motions.from_solution(ts, y0, numbers, run)
    y0_bar, params_bar = _derivatives.vjp(flow, motions, path_bar[:, None], y_bar[:, None], TOLERANCES)
    return np.concatenate([y0_bar[:, 0], params_bar[:, 0]], axis=1)


@pytest.mark.parametrize("times", [np.linspace(0, 2, 41), np.array([0.5, -1.0]), np.array([0.0, 1e-3, 1.1, 1.2])])
def test_transposed_steps_are_tangents(double, times):
    # Many outputs in one step, none, and backwards in time; more members than lanes, of different lengths.
    y0, numbers, rng = batch(19)
    ts, path_bar, y_bar = times[None], rng.normal(size=(19, len(times), 4)), rng.normal(size=(19, 4))
    run = double.run(ts, y0, numbers, TOLERANCES)
    found = vjp(double, ts, y0, numbers, run, path_bar, y_bar)
    expected = by_tangents(double, ts, y0, numbers, run, path_bar, y_bar)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())  # of the same steps: to round-off


def test_portions_do_not_change_a_cotangent(double, monkeypatch):
    y0, numbers, rng = batch(23)
    ts, path_bar, y_bar = np.array([[0.0, 0.7, 1.5]]), rng.normal(size=(23, 3, 4)), rng.normal(size=(23, 4))
    run = double.run(ts, y0, numbers, TOLERANCES)
    whole = vjp(double, ts, y0, numbers, run, path_bar, y_bar)
    monkeypatch.setattr(_derivatives, "LARGEST_PORTION", 100)
    np.testing.assert_array_equal(vjp(double, ts, y0, numbers, run, path_bar, y_bar), whole)


def test_members_in_another_order_have_the_same_cotangents(double):
    y0, numbers, rng = batch(23)
    ts, path_bar, y_bar = np.array([[0.0, 0.7, 1.5]]), rng.normal(size=(23, 3, 4)), rng.normal(size=(23, 4))
    run = double.run(ts, y0, numbers, TOLERANCES)
    plain = vjp(double, ts, y0, numbers, run, path_bar, y_bar)
    shuffled = rng.permutation(23)
    turned = type(run)(*(x[shuffled] for x in run[:-1]))
    found = vjp(double, ts, y0[shuffled], numbers[shuffled], turned, path_bar[shuffled], y_bar[shuffled])
    np.testing.assert_array_equal(found, plain[shuffled])


def loss(system, ts, rtol=1e-11):
    def of(q0, qdot0, params):
        trajectory = lagjax.simulate(system, q0, qdot0, ts, params, rtol=rtol, atol=rtol, throw=False)
        return jnp.sum(trajectory.q[1:] ** 2) + jnp.sum(trajectory.end.qdot)

    return of


def test_reverse_is_forward_for_members_of_a_batch():
    y0, numbers, _ = batch(6)
    system, ts = CHAIN, np.linspace(0, 1.5, 4)
    value = lambda y, p: loss(system, ts)(y[:2], y[2:], {"g": p[0], "l": p[1:3], "m": p[3:]})
    reverse = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1))))(y0, numbers)
    forward = jax.jit(jax.vmap(jax.jacfwd(value, argnums=(0, 1))))(y0, numbers)
    for a, b in zip(reverse, forward, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8 * float(np.max(np.abs(b))))
    # Parameters that all members share get the sum of what the members say.
    shared = jax.jit(jax.grad(lambda p: jnp.sum(jax.vmap(value, (0, None))(y0, p))))(numbers[0])
    alone = jax.jit(jax.grad(value, argnums=1))
    np.testing.assert_allclose(shared, sum(np.asarray(alone(y, numbers[0])) for y in y0), rtol=1e-10)


@pytest.mark.slow
def test_directions_side_by_side_are_those_one_by_one():
    system, ts = CHAIN, np.array([0.0, 0.6, 1.0])
    params = {"g": 9.81, "l": np.array([1.0, 0.8]), "m": np.array([1.0, 2.0])}
    value = lambda p: loss(system, ts)(jnp.array([0.5, -0.2]), jnp.zeros(2), p)
    reverse, forward = jax.grad(value)(params), jax.jacfwd(value)(params)
    for a, b in zip(jax.tree.leaves(reverse), jax.tree.leaves(forward), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)
    along = jax.jvp(value, (params,), (jax.tree.map(lambda x: 1e-30 * jnp.ones_like(x), params),))[1]
    np.testing.assert_allclose(along, 1e-30 * sum(np.sum(x) for x in jax.tree.leaves(forward)), rtol=1e-11)


@pytest.mark.slow
def test_a_jacobian_row_by_row_is_that_column_by_column():
    scene = SPRING_K
    path = lambda x: lagjax.simulate(scene, x[0], x[1], jnp.linspace(0, 2, 9), x[2], rtol=1e-11).q
    x, ts = jnp.array([1.0, 0.3, 4.0]), jnp.linspace(0, 2, 9)
    exact = jax.jacfwd(
        lambda x: x[0] * jnp.cos(jnp.sqrt(x[2]) * ts) + x[1] * jnp.sin(jnp.sqrt(x[2]) * ts) / jnp.sqrt(x[2])
    )
    np.testing.assert_allclose(jax.jacrev(path)(x), exact(x), atol=1e-9)  # more rows than numbers: by tangents
    np.testing.assert_allclose(jax.jacrev(lambda x: path(x)[-1:])(x), exact(x)[-1:], atol=1e-9)


# The bead's ellipse depends on a parameter; outputs are put on it, and so are the ends of steps.
ON_A_CONSTRAINT = lagjax.System(sliding, constraints=ellipse)


@pytest.mark.slow
def test_gradients_on_a_constraint():
    value = lambda p: loss(ON_A_CONSTRAINT, jnp.linspace(0, 1.2, 5))(jnp.array([0.0, -1.0]), jnp.array([1.5, 0.0]), p)
    params = {"m": 1.3, "a": 1.7}
    reverse, forward = jax.grad(value)(params), jax.jacfwd(value)(params)
    np.testing.assert_allclose(reverse["a"], forward["a"], rtol=1e-8)
    by_differences = (value(params | {"a": 1.7 + 1e-5}) - value(params | {"a": 1.7 - 1e-5})) / 2e-5
    np.testing.assert_allclose(reverse["a"], by_differences, rtol=1e-7)
    np.testing.assert_allclose(reverse["m"], 0.0, atol=1e-8)  # all masses fall alike


def test_members_that_stop_early_have_the_derivative_of_what_they_did():
    # Free fall to the edge of what is defined; the others are as if alone.
    scene = CLIFF
    ts = np.array([0.0, 0.5, 3.0])

    def middle(q0, g):
        trajectory = lagjax.simulate(scene, q0, 0.0, ts, g, rtol=1e-10, throw=False)
        return trajectory.q[1], trajectory.ok

    (of_q0, of_g), ok = jax.jit(jax.vmap(jax.grad(middle, argnums=(0, 1), has_aux=True)))(
        np.array([0.5, 50.0]), np.array([9.81, 9.81])
    )
    assert ok.tolist() == [False, True]
    np.testing.assert_allclose(of_q0, 1.0, rtol=1e-12)
    np.testing.assert_allclose(of_g, -0.125, rtol=1e-10)
