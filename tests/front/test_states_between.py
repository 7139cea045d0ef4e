"""`Trajectory.at`: states between outputs, against closed forms and outputs there, of every kind of motion."""

import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALL_IN_GRAVITY, EDGE, OSCILLATOR, RELAY, SPRING_K, WEIGHT_ON_A_SLIDE

import lagjax

TS = np.linspace(0.0, 3.0, 10)
TIMES = np.array([0.0, 0.1, 1.0, 1.2, 2.9, 3.0])  # the first, the third and the last are outputs
BOUNCING = lagjax.System(
    lambda q, qdot: 0.5 * qdot**2 - 9.81 * q, contacts=lambda q: {"floor": q}, restitution=lambda params: params
)
FLIGHT = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
KINDS = {
    "smooth": (OSCILLATOR, 1.0, 0.3, {}),
    "sliding": (RELAY, 1.0, 0.5, {}),
    "constrained": (WEIGHT_ON_A_SLIDE, np.zeros(1), np.ones(1), {}),
    "contacts": (BOUNCING, 1.0, 0.0, {"params": 0.8}),
    "hybrid": (lagjax.Hybrid({"flight": BALL_IN_GRAVITY}, [FLIGHT], "flight"), 1.0, 0.0, {"params": {"g": 9.81}}),
}
BY_DIFFRAX = {"solver": diffrax.Dopri8(), "rtol": 1e-10}


def same(a, b, **tolerance):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **tolerance), a, b)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_state_of_an_output_there(kind):
    scene, q0, qdot0, more = KINDS[kind]
    run = lagjax.simulate(scene, q0, qdot0, TS, **more)
    every = np.union1d(TS, TIMES)
    there = lagjax.simulate(scene, q0, qdot0, every, **more)
    at, where = run.at(TIMES), np.searchsorted(every, TIMES)
    same((at.q, at.qdot), jax.tree.map(lambda x: x[where], (there.q, there.qdot)), rtol=1e-8, atol=1e-9)
    # Outputs are what they were, to the bit.
    again = run.at(TS)
    jax.tree.map(np.testing.assert_array_equal, (again.q, again.qdot, again.t), (run.q, run.qdot, run.ts))


@pytest.mark.parametrize("kind", ["smooth", pytest.param("contacts", marks=pytest.mark.slow),
                                  pytest.param("hybrid", marks=pytest.mark.slow)])  # fmt: skip
def test_its_derivative_is_the_velocity(kind):
    scene, q0, qdot0, more = KINDS[kind]
    run = lagjax.simulate(scene, q0, qdot0, TS, **more)

    @jax.jit
    def rates(run, times):  # a motion that came in has its system, its tolerances and its budgets
        return run.at(times), jax.vmap(jax.jacfwd(run.at))(times), jax.vmap(jax.jacrev(run.at))(times)

    at, forward, reverse = rates(run, jnp.asarray(TIMES))
    same(at, run.at(TIMES), rtol=1e-12, atol=1e-12)
    same(forward, reverse, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(forward.q, at.qdot, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(forward.qdot, -at.q if kind == "smooth" else -9.81, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("t", [2.5, TS[5]])
def test_derivatives_of_the_motion(t):
    def position(q0, k, t):
        return lagjax.simulate(SPRING_K, q0, 0.0, TS, k).at(t).q

    w, given = np.sqrt(1.3), (1.0, 1.3, t)
    phase, by_k = w * t, -0.5 * t / w * np.sin(w * t)
    expected = np.cos(phase), by_k, -w * np.sin(phase)
    same(jax.jit(jax.grad(position, (0, 1, 2)))(*given), expected, rtol=1e-9)
    same(jax.jit(jax.grad(lambda q0, k: position(q0, k, t), (0, 1)))(*given[:2]), expected[:2], rtol=1e-9)
    second = jax.jit(jax.hessian(position, (1, 2)))(*given)
    np.testing.assert_allclose(second[1][1], -(w**2) * np.cos(phase), rtol=1e-8)
    mixed = -0.5 / w * np.sin(phase) - 0.5 * t * np.cos(phase)
    np.testing.assert_allclose([second[0][1], second[1][0]], mixed, rtol=1e-8)


def test_batches():
    k, q0 = np.linspace(1.0, 2.0, 4), np.linspace(0.5, 1.0, 4)
    w = np.sqrt(k)[:, None]
    run = lagjax.simulate_batch(SPRING_K, q0, np.zeros(4), TS, k, batch_axes=(0, 0, 0))
    assert run.at(0.7).q.shape == (4,)
    for times in (TIMES, TIMES[None], np.linspace(0.0, 2.0, 4)[:, None] + [0.0, 0.5], np.full((4, 1), 0.3)):
        at = run.at(times)
        np.testing.assert_allclose(at.q, q0[:, None] * np.cos(w * times), atol=1e-9)
        np.testing.assert_array_equal(at.t, np.broadcast_to(times, at.q.shape))
    mapped = jax.vmap(lambda q0, k: lagjax.simulate(SPRING_K, q0, 0.0, TS, k))(q0, k)
    np.testing.assert_array_equal(mapped.at(TIMES).q, run.at(TIMES).q)
    np.testing.assert_allclose(jax.vmap(lambda run: run.at(0.7).q)(mapped), run.at(0.7).q, rtol=1e-14)
    with pytest.raises(ValueError, match=r"shape \(3, 2\), and the batch \(4,\)"):
        run.at(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="t = 4 lies outside of the motion of member 2, from ts"):
        run.at([[0.0], [1.0], [4.0], [2.0]])


def test_times_of_each_member():
    begin = np.arange(3.0)[:, None]
    ts = begin + np.linspace(0.0, 2.0, 5)
    ts[1] = ts[1, ::-1]  # back in time
    run = lagjax.simulate_batch(OSCILLATOR, np.ones(3), np.zeros(3), ts)
    np.testing.assert_allclose(run.q, np.cos(ts - ts[:, :1]), atol=1e-9)
    np.testing.assert_allclose(run.at(begin + 0.7).q[:, 0], np.cos(begin[:, 0] + 0.7 - ts[:, 0]), atol=1e-9)
    np.testing.assert_allclose(run.energy(), 0.5, rtol=1e-9)
    each = jax.vmap(lambda ts: lagjax.simulate(OSCILLATOR, 1.0, 0.0, ts))(ts)
    same((each.q, each.energy()), (run.q, run.energy()), rtol=1e-13, atol=1e-14)
    assert "t from 0 … 3 to 1 … 4" in repr(run) and len(run.to_pandas()) == 15 and "t" in run.to_xarray().coords
    slopes = jax.grad(lambda ts: lagjax.simulate_batch(OSCILLATOR, np.ones(3), np.zeros(3), ts).q[:, -1].sum())(ts)
    np.testing.assert_allclose(slopes[:, -1], run.qdot[:, -1], rtol=1e-9)
    with pytest.raises(ValueError, match="same number of members; ts has 2, q0 has 3"):
        lagjax.simulate_batch(OSCILLATOR, np.ones(3), np.zeros(3), ts[:2])
    with pytest.raises(ValueError, match=r"not between ts\[1, 0\] and the next"):
        lagjax.simulate_batch(OSCILLATOR, np.ones(3), np.zeros(3), np.array([[0.0, 1.0], [1.0, 1.0], [0.0, 2.0]]))
    with pytest.raises(ValueError, match=r"simulate_batch\(system, q0, qdot0, ts\) takes a row"):
        lagjax.simulate(OSCILLATOR, 1.0, 0.0, ts)


def test_jumping_members_have_times_of_their_own():
    ts = np.array([[0.0, 0.6, 1.0], [0.2, 1.1, 2.0]])
    for kind in ("contacts", "hybrid"):
        scene, _, _, more = KINDS[kind]
        run = lagjax.simulate_batch(scene, np.ones(2), np.zeros(2), ts, **more)
        for k in range(2):
            alone = lagjax.simulate(scene, 1.0, 0.0, ts[k], **more)
            same((run.q[k], run.qdot[k]), (alone.q, alone.qdot), rtol=1e-13, atol=1e-13)


def test_impacts_and_ends():
    run = lagjax.simulate(BOUNCING, 1.0, 0.0, TS, 0.8)
    hit = float(run.impacts.t[0])
    np.testing.assert_allclose(hit, np.sqrt(2 / 9.81), rtol=1e-14)
    before, after = run.at(hit - 1e-6).qdot, run.at(hit + 1e-6).qdot
    np.testing.assert_allclose(after, -0.8 * before, rtol=1e-5)
    exact = lagjax.simulate(BOUNCING, 1.0, 0.0, np.array([0.0, hit, 1.0]), 0.8).qdot[1]
    np.testing.assert_allclose(run.at(hit).qdot, exact, rtol=1e-9)
    ended = lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, event=lambda q, qdot: q)
    at = ended.at([1.5, 1.6, TS[-1]])
    np.testing.assert_allclose(at.q[0], np.cos(1.5), atol=1e-9)
    assert np.isnan(at.q[1:]).all() and np.isnan(at.qdot[1:]).all()
    failed = lagjax.simulate(EDGE, 1.0, -3.0, TS, throw=False)
    at = failed.at([0.2, float(failed.end.t) + 0.01])
    assert np.isfinite(at.q[0]) and np.isnan(at.q[1])


def test_single_precision_and_back_in_time():
    with jax.enable_x64(False):
        at = lagjax.simulate(OSCILLATOR, 1.0, 0.0, -TS).at(-TIMES)
        assert at.q.dtype == at.t.dtype == np.float32
        np.testing.assert_allclose(at.q, np.cos(TIMES), atol=3e-7)


@pytest.mark.slow
def test_diffrax_states():
    run = lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, **BY_DIFFRAX)
    np.testing.assert_allclose(run.at(TIMES).q, np.cos(TIMES), atol=1e-8)
    reverse = jax.jit(jax.vmap(jax.grad(lambda t: run.at(t).q)))(jnp.asarray(TIMES))
    np.testing.assert_allclose(reverse, -np.sin(TIMES), atol=1e-7)


def test_what_can_be_wrong():
    run = lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS)
    with pytest.raises(ValueError, match=r"t = 3.5 lies outside of the motion, from ts\[0\] = 0 to ts\[-1\] = 3"):
        run.at([1.0, 3.5])
    assert np.isnan(jax.jit(lambda t: run.at(t).q)(3.5))
    with pytest.raises(ValueError, match="t is nan"):
        run.at(np.nan)
    with pytest.raises(TypeError, match="t must hold numbers"):
        run.at("1")
    with pytest.raises(ValueError, match="does not say how it was integrated"):
        eqx.tree_at(lambda run: run.system, run, None).at(1.0)
    assert pickle.loads(pickle.dumps(run)).at(1.2).q == run.at(1.2).q
    assert run.at(3).q == run.q[-1]  # a whole number
