"""Derivatives of machine code: the transpose of its steps, against sensitivities and against what is known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
import lagjax._engine as engine
import lagjax._flow as flows
from lagjax._flow import Tolerances
from lagjax._layout import Layout

TOLERANCES = Tolerances(1e-11, 1e-11, 4096)


def chain(q, v, params):
    """A chain of point masses on rods."""
    m, l = params["m"], params["l"]

    def places(q):
        return jnp.stack([jnp.cumsum(l * jnp.sin(q)), -jnp.cumsum(l * jnp.cos(q))])

    velocity = jax.jvp(places, (q,), (v,))[1]
    return 0.5 * jnp.sum(m * velocity**2) - params["g"] * jnp.sum(m * places(q)[1])


def sliding(q, v, params):
    """A bead in the plane, its L; the ellipse it slides on is a constraint."""
    return 0.5 * params["m"] * jnp.sum(v**2) - params["m"] * 9.81 * q[1]


def ellipse(q, params):
    return (q[0] / params["a"]) ** 2 + q[1] ** 2 - 1.0


@pytest.fixture(scope="module")
def double():
    params = {"m": jnp.ones(2), "l": jnp.ones(2), "g": 9.81}
    return engine.scene_flow(lagjax.System(chain), Layout.of(jnp.zeros(2), jnp.zeros(2)), params)


def batch(members: int, seed: int = 0):
    """States and numbers of members that differ."""
    rng = np.random.default_rng(seed)
    numbers = np.concatenate([rng.uniform(0.5, 1.5, (members, 4)), np.full((members, 1), 9.81)], axis=1)
    numbers = numbers[:, [4, 2, 3, 0, 1]]  # the leaves of params in their order: g, l, m
    return rng.uniform(-1, 1, (members, 4)), numbers, rng


def by_sensitivities(flow, ts, y0, numbers, path_bar, y_bar):
    larger = flow.varied(True, tuple(range(numbers.shape[1])))
    found, _ = larger.run(ts, larger.start(y0), numbers, TOLERANCES.patient)
    path, end = larger.sensitivities(found.path), larger.sensitivities(found.y_end)
    return np.einsum("rnts,nts->nr", path, path_bar) + np.einsum("rns,ns->nr", end, y_bar)


@pytest.mark.parametrize("times", [np.linspace(0, 2, 41), np.array([0.5, -1.0]), np.array([0.0, 1e-3, 1.1, 1.2])])
def test_transposed_steps_are_sensitivities(double, times):
    # Many outputs in one step, none, and backwards in time; more members than lanes, of different lengths.
    y0, numbers, rng = batch(19)
    ts, path_bar, y_bar = times[None], rng.normal(size=(19, len(times), 4)), rng.normal(size=(19, 4))
    path_bar[:, -1] = 0  # the caller adds that of the last output to that of the end
    outcome, _ = double.run(ts, y0, numbers, TOLERANCES)
    found = double.pull(ts, y0, numbers, outcome.accepted, path_bar, y_bar, TOLERANCES)
    expected = by_sensitivities(double, ts, y0, numbers, path_bar, y_bar)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(np.concatenate([found.y0, found.params], axis=1), expected, atol=1e-9 * scale)


def test_portions_do_not_change_a_cotangent(double, monkeypatch):
    y0, numbers, rng = batch(23)
    ts, path_bar, y_bar = np.array([[0.0, 0.7, 1.5]]), rng.normal(size=(23, 3, 4)), rng.normal(size=(23, 4))
    outcome, _ = double.run(ts, y0, numbers, TOLERANCES)
    given = ts, y0, numbers, outcome.accepted, path_bar, y_bar, TOLERANCES
    whole = double.pull(*given)
    monkeypatch.setattr(lagjax._native, "LARGEST_RECORD", 100)
    for part, all_ in zip(double.pull(*given), whole, strict=True):
        np.testing.assert_array_equal(part, all_)


def test_kept_steps_do_not_change_a_cotangent(double, monkeypatch):
    y0, numbers, rng = batch(23)
    ts, path_bar, y_bar = np.array([[0.0, 0.7, 1.5]]), rng.normal(size=(23, 3, 4)), rng.normal(size=(23, 4))

    def pull(numbers):
        return double.pull(ts, y0, numbers, outcome.accepted, path_bar, y_bar, TOLERANCES)

    outcome, _ = double.run(ts, y0, numbers, TOLERANCES)
    plain, other = pull(numbers), pull(1.01 * numbers)
    followed = []
    integrate = type(double.kernel)._integrate
    monkeypatch.setattr(
        type(double.kernel), "_integrate", lambda self, *given: followed.append(self) or integrate(self, *given)
    )
    for asked, expected, runs in ((numbers, plain, 1), (1.01 * numbers, other, 2)):  # those of this run, or of another
        followed.clear()
        double.run(ts, y0, numbers, TOLERANCES, keep=True)
        for kept, again in zip(pull(asked), expected, strict=True):
            np.testing.assert_array_equal(kept, again)
        assert len(followed) == runs and not lagjax._native._last_run
    reused = np.array(y0 + 0.1, order="C")  # memory of the caller, who puts other numbers there
    double.run(ts, reused, numbers, TOLERANCES, keep=True)
    reused[:] = y0
    asked = double.pull(ts, reused, numbers, outcome.accepted, path_bar, y_bar, TOLERANCES)
    np.testing.assert_array_equal(asked.y0, plain.y0)
    monkeypatch.setattr(lagjax._native, "LARGEST_KEPT", 23 * 6 * 3)  # room for three steps of each
    double.run(ts, y0, numbers, TOLERANCES, keep=True)
    np.testing.assert_array_equal(pull(numbers).y0, plain.y0)


def loss(system, ts, rtol=1e-11):
    def of(q0, qdot0, params):
        trajectory = lagjax.simulate(system, q0, qdot0, ts, params, rtol=rtol, atol=rtol, throw=False)
        return jnp.sum(trajectory.q[1:] ** 2) + jnp.sum(trajectory.end.qdot)

    return of


def test_reverse_is_forward_for_members_of_a_batch():
    y0, numbers, _ = batch(6)
    system, ts = lagjax.System(chain), jnp.linspace(0, 1.5, 4)
    value = lambda y, p: loss(system, ts)(y[:2], y[2:], {"g": p[0], "l": p[1:3], "m": p[3:]})
    reverse = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1))))(y0, numbers)
    forward = jax.jit(jax.vmap(jax.jacfwd(value, argnums=(0, 1))))(y0, numbers)
    for a, b in zip(reverse, forward, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8 * float(jnp.max(jnp.abs(b))))
    # Parameters that all members share get the sum of what the members say.
    shared = jax.grad(lambda p: jnp.sum(jax.vmap(value, (0, None))(y0, p)))(numbers[0])
    alone = sum(jax.grad(value, argnums=1)(y, numbers[0]) for y in y0[:2])
    rest = sum(jax.grad(value, argnums=1)(y, numbers[0]) for y in y0[2:])
    np.testing.assert_allclose(shared, alone + rest, rtol=1e-10)


def test_many_numbers_are_varied_along_one_direction(monkeypatch):
    system, ts = lagjax.System(chain), jnp.array([0.0, 0.6, 1.0])
    params = {"g": 9.81, "l": jnp.array([1.0, 0.8, 1.2]), "m": jnp.array([1.0, 2.0, 0.5])}
    value = lambda p: loss(system, ts)(jnp.array([0.5, -0.2, 0.9]), jnp.zeros(3), p)
    reverse = jax.grad(value)(params)
    monkeypatch.setattr(flows, "LARGEST_JACOBIAN", 0)
    forward = jax.jacfwd(value)(params)
    for a, b in zip(jax.tree.leaves(reverse), jax.tree.leaves(forward), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    along = jax.jvp(value, (params,), (jax.tree.map(lambda x: 1e-30 * jnp.ones_like(x), params),))[1]
    np.testing.assert_allclose(along, 1e-30 * sum(jnp.sum(x) for x in jax.tree.leaves(reverse)), rtol=1e-9)


def test_a_jacobian_row_by_row_is_that_column_by_column(monkeypatch):
    scene = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params * q**2)
    path = lambda x: lagjax.simulate(scene, x[0], x[1], jnp.linspace(0, 2, 9), x[2], rtol=1e-11).q
    x, ts = jnp.array([1.0, 0.3, 4.0]), jnp.linspace(0, 2, 9)
    exact = jax.jacfwd(
        lambda x: x[0] * jnp.cos(jnp.sqrt(x[2]) * ts) + x[1] * jnp.sin(jnp.sqrt(x[2]) * ts) / jnp.sqrt(x[2])
    )
    np.testing.assert_allclose(jax.jacrev(path)(x), exact(x), atol=1e-9)  # more rows than numbers: by sensitivities
    monkeypatch.setattr(flows, "LARGEST_JACOBIAN", 0)
    np.testing.assert_allclose(jax.jacrev(path)(x), exact(x), atol=1e-9)


def test_gradients_on_a_constraint():
    # The bead's ellipse depends on a parameter; outputs are put on it, and so are the ends of steps.
    system = lagjax.System(sliding, constraints=ellipse)
    value = lambda p: loss(system, jnp.linspace(0, 1.2, 5))(jnp.array([0.0, -1.0]), jnp.array([1.5, 0.0]), p)
    params = {"m": 1.3, "a": 1.7}
    reverse, forward = jax.grad(value)(params), jax.jacfwd(value)(params)
    np.testing.assert_allclose(reverse["a"], forward["a"], rtol=1e-8)
    by_differences = (value(params | {"a": 1.7 + 1e-5}) - value(params | {"a": 1.7 - 1e-5})) / 2e-5
    np.testing.assert_allclose(reverse["a"], by_differences, rtol=1e-7)
    np.testing.assert_allclose(reverse["m"], 0.0, atol=1e-8)  # all masses fall alike


def test_members_that_stop_early_have_the_derivative_of_what_they_did():
    # Free fall to the edge of what is defined; the others are as if alone.
    scene = lagjax.System(lambda q, v, params: 0.5 * v**2 - params * q - jnp.where(q < -1.0, jnp.log(q + 1.0), 0.0))
    ts = jnp.array([0.0, 0.5, 3.0])

    def middle(q0, g):
        trajectory = lagjax.simulate(scene, q0, 0.0, ts, g, rtol=1e-10, throw=False)
        return trajectory.q[1], trajectory.ok

    of_q0, of_g = jax.vmap(jax.grad(middle, argnums=(0, 1), has_aux=True))(
        jnp.array([0.5, 50.0]), jnp.array([9.81, 9.81])
    )[0]
    ok = jax.vmap(middle)(jnp.array([0.5, 50.0]), jnp.array([9.81, 9.81]))[1]
    assert ok.tolist() == [False, True]
    np.testing.assert_allclose(of_q0, 1.0, rtol=1e-12)
    np.testing.assert_allclose(of_g, -0.125, rtol=1e-10)
