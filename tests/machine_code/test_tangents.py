"""Forward-mode derivatives of runs in machine code: over the steps of the motion; directions or members in lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import CLIFF, PENDULUM_G

import lagjax
from lagjax import _native
from lagjax._engine import Problem
from lagjax._engine.taylor import Tolerances, _derivatives, flow_of
from lagjax._interface import Layout
from lagjax._native.motions import _kernel

TOLERANCES = Tolerances(1e-10, 1e-13, 4096)
TS = np.array([[0.0, 0.4, 0.5, 1.3, 2.0]])
SIMPLE_ALONG_AN_AXIS = lagjax.System(lambda q, v: 0.5 * v @ v - q[1] ** 2 / (1.0 + 25.0 * q[0] ** 2))


def swing(q, v, params):
    """Two pendulums, coupled by a spring."""
    m, k = params["m"], params["k"]
    return 0.5 * m @ v**2 + 9.81 * m @ jnp.cos(q) - 0.5 * k * (q[0] - q[1]) ** 2


@pytest.fixture(scope="module")
def flow():
    params = {"m": jnp.ones(2), "k": 1.0}
    return flow_of(Problem.from_system(lagjax.System(swing), Layout.from_state(jnp.zeros(2), jnp.zeros(2)), params))


def starts(members):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (members, 4)), rng.uniform(0.5, 2.0, (members, 3)), rng


def along(flow, y0, numbers, dy0, dparams, ts=TS):
    run = flow.run(ts, y0, numbers, TOLERANCES)
    motions = _derivatives.Motions.from_solution(ts, y0, numbers, run)
    return _derivatives.jvp(flow, motions, dy0, dparams, TOLERANCES)


def test_tangents_are_central_differences(flow):
    y0, numbers, rng = starts(1)
    dy0, dparams = rng.normal(size=(1, 3, 4)), rng.normal(size=(1, 3, 3))
    path, end = along(flow, y0, numbers, dy0, dparams)
    h = 1e-3 * np.array([-2, -1, 1, 2])[:, None]
    for k in range(3):
        runs = flow.run(TS, y0 + h * dy0[0, k], numbers + h * dparams[0, k], TOLERANCES)
        weights = np.array([1, -8, 8, -1]) / 0.012
        # h⁴/30 of a fifth derivative, some hundred in this motion, and the tolerance over h
        np.testing.assert_allclose(path[0, k], np.einsum("s,stk->tk", weights, runs.path), atol=2e-6)
        np.testing.assert_allclose(end[0, k], path[0, k, -1])
    np.testing.assert_array_equal(path[:, :, 0], dy0)


@pytest.mark.parametrize(("members", "directions"), [(1, 2), (1, 19), (3, 9), (2, 1), (17, 3)])
def test_lanes_and_threads_do_not_change_a_tangent(flow, members, directions):
    y0, numbers, rng = starts(members)
    dy0, dparams = rng.normal(size=(members, directions, 4)), rng.normal(size=(members, directions, 3))
    together = along(flow, y0, numbers, dy0, dparams)
    for i, k in ((0, 0), (members - 1, directions - 1)):
        one = slice(i, i + 1), slice(k, k + 1)
        alone = along(flow, y0[one[0]], numbers[one[0]], dy0[one], dparams[one])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[one], b, rtol=1e-13, atol=1e-13)


def test_straight_lines_and_tables_have_the_same_tangents(flow, monkeypatch):
    y0, numbers, rng = starts(2)
    dy0, dparams = rng.normal(size=(2, 5, 4)), rng.normal(size=(2, 5, 3))
    written = along(flow, y0, numbers, dy0, dparams)
    for module in (_native.series._taylor, _native.motions._recorded_steps):
        monkeypatch.setattr(module, "is_large", lambda *_, **__: True)
    again = type(flow)(lambda: (flow.program, None), flow.size, flow.numbers)
    for a, b in zip(along(again, y0, numbers, dy0, dparams), written, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_tangents_of_a_motion_at_rest():
    """At rest the series of a motion ends, and its steps could have any length: its tangents oscillate."""
    scene = PENDULUM_G
    ts = np.linspace(0.0, 10.0, 7)

    def path(x):
        return lagjax.simulate(scene, x[0], x[1], ts, 9.81, rtol=1e-10).q

    omega = np.sqrt(9.81)
    expected = np.stack([np.cos(omega * ts), np.sin(omega * ts) / omega], axis=1)
    assert lagjax.simulate(scene, 0.0, 0.0, ts, 9.81).stats["num_steps"] < 5
    for start in (np.zeros(2), np.array([1e-9, 0.0])):
        np.testing.assert_allclose(jax.jacfwd(path)(start), expected, atol=1e-8)
        np.testing.assert_allclose(jax.grad(lambda x: path(x)[-1])(start), expected[-1], atol=1e-8)


def test_tangents_across_a_motion_that_is_simpler_than_they_are():
    """Along the ridge y = 0 of V = y²/(1 + x²) nothing acts on the motion, and its steps could have any length."""
    ts = np.array([0.0, 3.0])

    def end(y):
        return lagjax.simulate(SIMPLE_ALONG_AN_AXIS, jnp.array([-1.5, y]), jnp.array([1.0, 0.0]), ts, rtol=1e-10).q[
            -1, 1
        ]

    beside = (end(1e-4) - end(-1e-4)) / 2e-4  # of motions that need their steps; 1e-8 of a third derivative
    assert abs(beside) > 0.1
    np.testing.assert_allclose([jax.jit(jax.jacfwd(end))(0.0), jax.jit(jax.grad(end))(0.0)], beside, rtol=1e-7)


PENDULUM = lagjax.System(lambda q, v: 0.5 * v**2 + jnp.cos(q))


def swing_with_narrow_friction(q, v, params):
    return -0.1 * v - params["c"] * params["law"](v / params["width"])


NARROW = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2, forces=swing_with_narrow_friction)


@pytest.mark.parametrize("law", [jnp.tanh, jax.nn.sigmoid])
@pytest.mark.parametrize("width", [1e-3, 1e-9])
def test_tangents_by_the_weight_of_a_narrow_function_that_is_zero(law, width):
    """A motion knows nothing of a term of weight zero: its steps are as long as they may be, and its tangents turn
    within them. For friction that is sgn(v), or half of that and a half, the tangent has a closed form."""
    ts = np.linspace(0.0, 10.0, 101)

    def end(c):
        return lagjax.simulate(NARROW, 1.0, 0.0, ts, {"c": c, "width": width, "law": law}).q[-1]

    w, decay = np.sqrt(1 - 0.05**2), 0.05
    s = np.concatenate([[0.0], np.arange(1, 4) * np.pi / w, [10.0]])  # where v changes its sign, which begins as -1

    def response(t):
        """The integral from 0 to t of exp(−a t) sin(w t) / w."""
        return (1 - np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t))) / (w**2 + decay**2)

    signs = [-1.0, 1.0, -1.0, 1.0]
    exact = -sum(sign * (response(10 - a) - response(10 - b)) for sign, a, b in zip(signs, s[:-1], s[1:], strict=True))
    if law is jax.nn.sigmoid:
        exact = 0.5 * exact - 0.5 * response(10.0)
    for derive in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derive(end)(0.0), exact, rtol=1e-7 if width < 1e-6 else 1e-3)


def test_tangents_are_none_where_a_step_passes_a_jump_unseen():
    params = {"width": 1e-6, "law": jnp.atan}

    def end(c):
        return lagjax.simulate(NARROW, 1.0, 0.0, np.linspace(0.0, 10.0, 101), params | {"c": c}).q[-1]

    assert np.isnan(jax.jacfwd(end)(0.0)) and np.isnan(jax.jacrev(end)(0.0))


def test_steps_that_suit_no_tangent_give_none(monkeypatch):
    monkeypatch.setattr(_derivatives, "TRIES", 0)
    slope = jax.jacfwd(lambda q: lagjax.simulate(PENDULUM, q, 0.0, jnp.array([0.0, 10.0]), throw=False).q[-1])(0.0)
    assert np.isnan(slope)


def test_a_failed_motion_has_the_tangents_of_what_it_did():
    scene = CLIFF
    ts = np.array([0.0, 0.5, 3.0])
    path = lambda g: lagjax.simulate(scene, 0.5, 0.0, ts, g, throw=False).q
    np.testing.assert_allclose(jax.jacfwd(path)(9.81), [0.0, -0.125, np.nan], atol=1e-10)


@pytest.mark.slow
def test_the_adjoints_of_two_vectors_of_members_go_on_two_threads_with_the_same_bits(flow, monkeypatch):
    members = 2 * _native.lanes()
    y0, numbers, rng = starts(members)
    run = flow.run(TS, y0, numbers, TOLERANCES)
    motions = _derivatives.Motions.from_solution(TS, y0, numbers, run)
    path_ct, end_ct = rng.normal(size=(members, 1, TS.size, 4)), rng.normal(size=(members, 1, 4))
    asked, found, together = [], [], _kernel.run_on_threads
    monkeypatch.setattr(_kernel, "run_on_threads", lambda work, count: (asked.append(count), together(work, count))[1])
    for cores in (1, 2):
        monkeypatch.setattr(_kernel, "cores", lambda cores=cores: cores)
        found.append(_derivatives.vjp(flow, motions, path_ct, end_ct, TOLERANCES))
    assert asked[-1] == 2 and set(asked[:-1]) == {1}  # each time the motion once more, and back over it
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)
