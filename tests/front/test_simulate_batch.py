"""`simulate_batch`: the same numbers as `jax.vmap(simulate)`, over states and parameters; bad members stay alone."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OSCILLATOR

import lagjax


def pendulum(q, qdot, params):
    return 0.5 * params["l"] ** 2 * qdot**2 + params["g"] * params["l"] * jnp.cos(q)


SCENE = lagjax.System(pendulum)
TWO_STIFFNESSES = lagjax.System(lambda q, qdot: 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(jnp.array([1.0, 4.0]) * q**2))
ENDS_AT_ZERO = lagjax.System(lambda q, qdot, params: 0.5 * params * qdot**2 - jnp.sqrt(q))
FREE_POINT_AND_ANGLE = lagjax.System(lambda q, qdot: 0.5 * jnp.sum(qdot["r"] ** 2) + 0.5 * qdot["phi"] ** 2)
PARAMS = {"l": 0.7, "g": 9.81}
TS = np.linspace(0.0, 2.0, 5)
Q0, QDOT0 = jnp.linspace(-2.5, 2.5, 8), jnp.linspace(-1.0, 1.0, 8)


FIELDS = ("q", "qdot", "end")


def assert_same(batch, reference):
    counts = {name: batch.stats[name] for name in reference.stats}
    for got, expected in ((counts, reference.stats), *((getattr(batch, x), getattr(reference, x)) for x in FIELDS)):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14), got, expected)
    np.testing.assert_array_equal(batch.ok, reference.ok)
    np.testing.assert_allclose(batch.energy(), reference.energy(), rtol=1e-13)
    np.testing.assert_allclose(batch.momentum(), reference.momentum(), rtol=1e-13, atol=1e-14)


def test_batch_of_states_is_vmap_of_simulate():
    reference = jax.vmap(lambda q, v: lagjax.simulate(SCENE, q, v, TS, PARAMS))(Q0, QDOT0)
    batch = lagjax.simulate_batch(SCENE, Q0, QDOT0, TS, PARAMS)
    assert_same(batch, reference)
    assert batch.q.shape == (8, 5) and batch.ts.shape == (5,) and batch.ok.shape == (8,)


@pytest.mark.slow
def test_batch_is_loop():
    # With fixed steps: adaptive ones may differ by a step where a decision hangs on the last digit.
    fixed = {"dt": 0.01, "solver": diffrax.Tsit5()}
    batch = lagjax.simulate_batch(SCENE, Q0, QDOT0, TS, PARAMS, **fixed)
    for i in range(8):
        one = lagjax.simulate(SCENE, Q0[i], QDOT0[i], TS, PARAMS, **fixed)
        np.testing.assert_allclose(batch.q[i], one.q, rtol=1e-12, atol=1e-13)


def test_batch_over_parameters_only():
    params = {"l": np.linspace(0.5, 1.0, 8), "g": 9.81}
    run = lambda p: lagjax.simulate(SCENE, 0.3, 0.0, TS, p)
    reference = jax.vmap(run, in_axes=({"l": 0, "g": None},))(params)
    batch = lagjax.simulate_batch(SCENE, 0.3, 0.0, TS, params, batch_axes=(None, None, {"l": 0, "g": None}))
    assert_same(batch, reference)


def test_batch_axis_in_the_middle_of_arrays():
    q0 = np.stack([Q0, QDOT0])  # coordinates first, members second
    batch = lagjax.simulate_batch(TWO_STIFFNESSES, q0, np.zeros((8, 2)), TS, batch_axes=(1, 0, None))
    expected = q0.T[:, None, :] * np.cos(np.array([1.0, 2.0]) * TS[:, None])
    np.testing.assert_allclose(batch.q, expected, atol=1e-8)


def test_a_bad_member_is_reported_and_changes_nothing_for_the_others():
    clean = lagjax.simulate_batch(SCENE, Q0, QDOT0, TS, PARAMS)
    broken = lagjax.simulate_batch(SCENE, Q0.at[2].set(jnp.nan).at[5].set(jnp.inf), QDOT0, TS, PARAMS)
    good = np.array([0, 1, 3, 4, 6, 7])
    np.testing.assert_array_equal(np.asarray(broken.q)[good], np.asarray(clean.q)[good])
    np.testing.assert_array_equal(broken.ok, np.isin(np.arange(8), good))
    np.testing.assert_array_equal(broken.result == lagjax.RESULTS.nonfinite_state, ~np.isin(np.arange(8), good))
    assert np.isnan(broken.q[2]).all() and np.isnan(broken.q[5]).all()
    assert broken.stats["num_steps"][2] == 0


def test_a_bad_parameter_and_a_member_that_fails_on_the_way():
    q0, params = np.array([1.0, 1.0, 9.0, 9.0]), np.array([0.0, 1.0, 1.0, np.nan])
    batch = lagjax.simulate_batch(ENDS_AT_ZERO, q0, -np.ones(4), TS, params, batch_axes=(0, 0, 0))
    np.testing.assert_array_equal(batch.ok, [False, False, True, False])
    assert (batch.result == lagjax.RESULTS.mass_matrix_singular)[0]
    assert (batch.result == lagjax.RESULTS.nonfinite_state)[1] and 0 < batch.end.t[1] < 2  # the root of less than zero
    assert (batch.result == lagjax.RESULTS.nonfinite_state)[3]
    assert batch.stats["num_steps"].max() < 1000  # nobody burns the budget


@pytest.mark.parametrize("members", [17_000, 40_000])
@pytest.mark.parametrize("n", [3, 6])
def test_large_batches_of_products_are_right(members, n):
    # jax 0.10.2 computes jit(vmap(|J v|²)) wrongly on CPU beyond 16 384 rows of float64 (jax issue 39103).
    jacobian = np.random.default_rng(0).normal(size=(n, n))
    scene = lagjax.System(lambda q, qdot: 0.5 * jnp.sum((jnp.asarray(jacobian) @ qdot) ** 2))
    qdot = np.random.default_rng(1).normal(size=(members, n))
    energy = jax.jit(jax.vmap(scene.energy))(np.zeros((members, n)), np.asarray(qdot))
    np.testing.assert_allclose(energy, 0.5 * np.sum((qdot @ jacobian.T) ** 2, axis=1), rtol=1e-12)


def test_to_xarray():
    xarray = pytest.importorskip("xarray")
    q0 = {"r": jnp.ones((8, 3)), "phi": Q0}
    labelled = lagjax.simulate_batch(FREE_POINT_AND_ANGLE, q0, q0, TS).to_xarray()
    assert isinstance(labelled, xarray.Dataset)
    assert labelled["q.r"].dims == ("member", "time", "q.r_0") and labelled["qdot.phi"].shape == (8, 5)
    one = lagjax.simulate(SCENE, 0.3, 0.0, TS, PARAMS).to_xarray()
    assert one["q"].dims == ("time",)
    np.testing.assert_array_equal(one["time"], TS)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"batch_axes": (None, None, None)}, "maps over nothing"),
        ({"batch_axes": (0, 0)}, "tuple of three"),
        ({"batch_axes": (1, 0, None)}, "q0 has shape \\(8,\\): it has no axis 1"),
        ({"qdot0": np.zeros(7)}, "same number of members; q0 has 8, qdot0 has 7"),
        ({"batch_axes": (0, 0, {"mass": 0})}, "batch_axes for params"),
        ({"params": {"l": np.nan, "g": 9.81}}, r"params\['l'\] is nan"),
        ({"q0": 0.1}, "q0 has shape \\(\\)"),
        ({"q0": np.zeros(0), "qdot0": np.zeros(0)}, "batch is empty"),
        ({"ts": np.array([0.0])}, "at least two"),
    ],
)
def test_bad_input_gets_a_sentence(changes, sentence):
    arguments = {"q0": Q0, "qdot0": QDOT0, "ts": TS, "params": PARAMS} | changes
    with pytest.raises(ValueError, match=sentence):
        lagjax.simulate_batch(SCENE, **arguments)


def test_a_batch_that_comes_again_and_again_stays_what_it_is():
    """After some calls its arrays are sent to JAX by a compiled function (`_simulate._device_arrays`)."""
    scene = OSCILLATOR
    q0, ts = np.linspace(0.1, 0.4, 3), np.linspace(0.0, 1.0, 5)
    first, *_, last = (lagjax.simulate_batch(scene, q0 + k, np.zeros(3), ts) for k in (*[0.0] * 60, 1.0))
    np.testing.assert_allclose(first.q, q0[:, None] * np.cos(ts), atol=1e-8)
    np.testing.assert_allclose(last.q, (q0 + 1)[:, None] * np.cos(ts), atol=1e-8)
    assert all(isinstance(x, jax.Array) for run in (first, last) for x in (run.q, run.qdot, run.ts, run.result._value))
