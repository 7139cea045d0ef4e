"""Motions that begin on the borders they rest on: their derivatives, and that nothing creeps.

Off a border, on either side, friction brings the motion back at once: derivatives are those of a start on it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import in_potential

import lagjax

T = 3.0
TS = np.array([0.0, T])
# Three bodies of unit mass: one on a belt, one with the sliding mode v = −c q, one whose friction is at its limit.
SCENE = lagjax.System(
    lambda q, v: 0.5 * v @ v,
    forces=lambda q, v, params: -jnp.sign(v - params["belt"] * jnp.array([1.0, 0.0, 0.0]) + params["c"] * q)
    * jnp.array([1.0, 4.0, 2.0]) + jnp.array([params["load"], 0.0, 2.0]),
)  # fmt: skip
FALL = lagjax.System(lambda q, v, params: 0.5 * v @ v - q[1])
CARRIED = lagjax.System(
    lambda q, v: 0.5 * v @ v,
    forces=lambda q, v, params: jnp.array([-params["mu"] * jnp.sign(v[0] - params["belt"]), 0.0]),
)
SLIDES_ALONG_A_LINE = lagjax.System(
    lambda q, v: 0.5 * v @ v,
    forces=lambda q, v, params: -params[0] * jnp.sign(v + params[1] * q) - 0.3 * q[::-1],
)
CORNER_WITH_FRICTION = lagjax.System(
    lambda q, v: 0.5 * v * v,
    forces=lambda q, v, params: params[1] - 2.0 * jnp.sign(q - params[0]) - params[2] * jnp.sign(v),
)
SLOPE_WITH_FRICTION = lagjax.System(
    lambda q, v, params: 0.5 * v * v - params[0] * q, forces=lambda q, v, params: -params[1] * jnp.sign(v)
)
ROOT_BESIDE_FRICTION = lagjax.System(
    lambda q, v: 0.5 * v**2,
    forces=lambda q, v, params: params * jnp.sign(v) - jnp.sign(q) * jnp.sqrt(jnp.abs(q) + 0.1),
)
TWO_SPELLINGS = lagjax.System(
    lambda q, v: 0.5 * v**2,
    forces=lambda q, v, params: 0.8 - jnp.sign(v) + 0.6 * jnp.where(v / params > 0, 1.0, 0.0),
)
X = {"v": np.array([0.5, -1.0, 0.0]), "belt": 0.5, "c": np.array([0.0, 1.0, 0.0]), "load": 0.25}
Q = np.array([0.0, 1.0, 0.0])


def ends(x, ts=TS):
    run = lagjax.simulate(SCENE, Q.astype(ts.dtype), x["v"], ts, {name: x[name] for name in ("belt", "c", "load")})
    return run.q[-1], run.qdot[-1]


def values(tree):
    return {name: np.asarray(x) for name, x in tree.items()}


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_first_derivatives_are_those_of_a_start_on_the_border(derivative):
    q, v = jax.jit(derivative(ends))(X)
    decay = np.exp(-T)
    for of_q, of_v, exact in (
        # q = u T; e^(−c T) and −c e^(−c T), whatever the velocity is at the start.
        (values(q)["belt"][:2], values(v)["belt"][:2], ([T, 0.0], [1.0, 0.0])),
        (values(q)["c"][1, 1], values(v)["c"][1, 1], (-T * decay, (T - 1.0) * decay)),
        (values(q)["v"][:2, :2], values(v)["v"][:2, :2], (np.zeros((2, 2)), np.zeros((2, 2)))),
        (values(q)["load"][:2], values(v)["load"][:2], (np.zeros(2), np.zeros(2))),
    ):
        np.testing.assert_allclose(of_q, exact[0], atol=1e-9)
        np.testing.assert_allclose(of_v, exact[1], atol=1e-9)
    # At the limit it goes on with what it gets forwards, and stops what it gets backwards.
    assert np.isnan(values(q)["v"][2, 2]) and values(q)["v"][0, 2] == 0.0


def test_in_single_precision():
    """Compiles one batch of motions and their transpose, for callers in float32."""
    with jax.enable_x64(False):
        x = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), X)
        ts = TS.astype(jnp.float32)
        many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), x)
        slopes = jax.jit(jax.vmap(jax.grad(lambda x: ends(x, ts)[0][:2].sum())))(many)
        np.testing.assert_allclose(slopes["belt"], T, rtol=1e-6)
        np.testing.assert_allclose(slopes["c"][:, 1], -T * np.exp(-T), rtol=1e-5)
        np.testing.assert_allclose(slopes["v"][:, :2], 0.0, atol=1e-6)


ALONG_THE_BORDER = lagjax.System(
    lambda q, v: 0.5 * v * v,
    forces=lambda q, v, params: -3.0 * jnp.sign(v + params[0] * q) - params[1] * q,
)


@pytest.mark.slow
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_exist_along_the_border_alone(inner, outer):
    def end(x):  # slope of the sliding mode, stiffness, velocity at the start
        scene = ALONG_THE_BORDER
        return lagjax.simulate(scene, x[3], x[2], TS, x[:2]).q[-1]

    second = jax.jit(outer(inner(end)))(jnp.array([1.0, 0.5, -1.0, 1.0]))
    # The end is q0 e^(−cT): c, the start and its velocity are varied off the border, the stiffness is not.
    assert np.isnan(second[np.ix_([0, 2, 3], [0, 2, 3])]).all()
    np.testing.assert_array_equal(second[1], 0.0)
    np.testing.assert_array_equal(second[:, 1], 0.0)


@pytest.mark.slow
def test_a_second_run_from_the_end_of_the_first():
    """Start and border move together there: second derivatives exist, and are those of one run."""
    q0, v0 = np.array([0.5, -0.3]), np.array([0.7, 0.1])

    def once(x):
        return jnp.sum(lagjax.simulate(SLIDES_ALONG_A_LINE, q0, v0, 2 * TS, x).q[-1] ** 2)

    def twice(x):
        run = lagjax.simulate(SLIDES_ALONG_A_LINE, q0, v0, TS, x)
        return jnp.sum(lagjax.simulate(SLIDES_ALONG_A_LINE, run.q[-1], run.qdot[-1], TS, x).q[-1] ** 2)

    x = jnp.array([2.0, 0.6])
    for derivative in (jax.grad, jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f)), lambda f: jax.jacrev(jax.jacrev(f))):
        found, expected = (jax.jit(derivative(function))(x) for function in (twice, once))
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_a_mode_that_begins_on_its_border():
    """A body falls on a belt that takes it along, whatever the velocity that the reset gives it."""

    def land(q, v, params):
        return q, jnp.array([params["reset"], 0.0])

    def end(x):
        law = [lagjax.Transition("fall", "carried", lambda q, v: q[1], -1, land)]
        start = jnp.array([0.0, 0.5]), jnp.zeros(2)
        return lagjax.simulate(lagjax.Hybrid({"fall": FALL, "carried": CARRIED}, law, "fall"), *start, TS, x).q[-1, 0]

    x = {"mu": 2.0, "belt": 0.25, "reset": 0.25}
    assert abs(end(x) - 0.5) < 1e-12  # it falls for a unit of time
    slopes = jax.grad(end)(x)
    np.testing.assert_allclose([slopes["belt"], slopes["reset"], slopes["mu"]], [2.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "slopes"), [(0.5, [0.0, 0.0, 1.0, 0.0]), (2.5, [1.0, 0.0, 0.0, 0.0])])
def test_a_body_in_a_corner_with_friction(friction, slopes):
    """Pushed by 2: from beside the corner it comes back to it in a time as the root of the way, or stays there."""

    def end(x):
        return lagjax.simulate(CORNER_WITH_FRICTION, x[0], x[1], TS, x[2:]).q[-1]

    x = jnp.array([0.5, 0.0, 0.5, 0.25, friction])
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(end)(x)[:4], slopes, atol=1e-12)
    if friction > 2.25:
        np.testing.assert_allclose(end(x.at[0].add(0.1)), 0.6, atol=1e-12)


# ---- creep -----------------------------------------------------------------------------------------------------------


def stack(q, v, params):
    """Three blocks on each other, the lowest on a belt; loads that they hold."""
    friction = params[0] * jnp.array([3.0, 2.0, 1.0]) * jnp.sign(jnp.diff(v, prepend=params[2]))
    return params[1] * jnp.array([0.5, 1.0, -0.3]) - friction + jnp.append(friction[1:], 0.0)


STACK = lagjax.System(lambda q, v: 0.5 * v @ (jnp.array([1.0, 2.0, 0.7]) * v), forces=stack)


def test_nothing_that_rests_creeps():
    """Motions at rest, or on a belt, for 1e8 units of time. Compiles one batch of motions."""
    random = np.random.default_rng(0)
    scene, count = STACK, 200
    mu = random.uniform(0.5, 5.0, count)
    speeds = np.where(np.arange(count) < 100, 0.0, random.uniform(-2.0, 2.0, count))
    params = np.asarray(np.stack([mu, 0.9 * mu * random.uniform(-1.0, 1.0, count), speeds], axis=1))
    q0, v0 = random.uniform(-1.0, 1.0, (count, 3)), np.repeat(speeds[:, None], 3, axis=1)
    run = lagjax.simulate_batch(scene, q0, v0, np.array([0.0, 1e4, 1e8]), params, batch_axes=(0, 0, 0))
    np.testing.assert_array_equal(run.q[:100, -1], q0[:100])
    np.testing.assert_allclose(run.q[100:, -1], q0[100:] + 1e8 * v0[100:], rtol=1e-15)
    np.testing.assert_array_equal(run.qdot[:, -1], v0)


def test_what_has_come_to_rest_stays_there():
    """A block that slides down and stops, and where it does, by the end of the time and long after."""

    def end(params, t):
        return lagjax.simulate(SLOPE_WITH_FRICTION, 0.0, 1.0, jnp.stack([0.0 * t, t]), params).q[-1]

    params = np.array([0.7, 1.1])  # it stops after v²/2 (g + μ)
    np.testing.assert_allclose(end(params, 1e8), 0.5 / 1.8, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(end)(params, 1e8), -0.5 / 1.8**2 * np.ones(2), rtol=1e-9)


# A law, where it is at rest, and 2 (q(1) − q(0)): both sides do not push onto the border, and the law is as it is
# written there, or moves on to where it is as it is written beyond.
LAWS = [
    (lambda q: jnp.where(q >= 0, 1.0, -1.0), 0.0, 1.0),
    (lambda q: jnp.where(q > 0, 1.0, -1.0), 0.0, -1.0),
    (lambda q: jnp.where(q >= 1, 1.0, 0.0), 1.0, 1.0),
    (lambda q: jnp.where(q > 1, 1.0, 0.0), 1.0, 0.0),
    (lambda q: jnp.where(q >= 0, 0.0, -1.0), 0.0, 0.0),
    (lambda q: jnp.sign(q), 0.0, 0.0),
    (lambda q: jnp.heaviside(q, 1.0), 0.0, 1.0),
    (lambda q: jnp.heaviside(q, 0.5), 0.0, 1.0),
    (lambda q: jnp.floor(q), 0.0, 0.0),
    (lambda q: 2 + jnp.floor(q), -1.0, 1.0),
    (lambda q: jnp.ceil(q), 0.0, 0.0),
    (lambda q: jnp.ceil(q), -1.0, -1.0),
    (lambda q: jnp.trunc(q), 1.0, 1.0),
    (lambda q: jnp.trunc(q), -1.0, -1.0),
    (lambda q: -jnp.floor(q), 1.0, 0.0),  # pushed onto it from both sides
    (lambda q: jnp.array([0.0, 1.0, 1.0])[q.astype(int)], 1.0, 1.0),
    (lambda q: 1.0 * jnp.searchsorted(jnp.array([0.0, 1.0]), q, side="right"), 1.0, 2.0),  # at the last entry
]


AS_WRITTEN = lagjax.System(
    lambda q, v: 0.5 * v @ v, forces=lambda q, v: jnp.stack([f(q[i]) for i, (f, *_) in enumerate(LAWS)])
)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_law_that_jumps_is_as_it_is_written_where_a_motion_begins_at_rest(dtype):
    """Compiles one motion."""
    with jax.enable_x64(dtype == np.float64):
        system = AS_WRITTEN
        starts, moves = np.array([[start, moved] for _, start, moved in LAWS], dtype).T
        run = lagjax.simulate(system, starts, 0 * starts, np.array([0.0, 1.0], dtype))
    np.testing.assert_allclose(2 * (run.q[-1] - starts), moves, atol=100 * np.finfo(dtype).eps)


TIES = {
    "max |q|": (lambda q: jnp.max(jnp.abs(q)), [1.0, 0.3, -0.2], [0.5, 0.3, -0.2]),
    "max": (lambda q: jnp.max(q), [0.0, 1.0, 0.0], [0.0, 0.5, 0.0]),
    "−max": (lambda q: -jnp.max(q), [1.0, 0.0, 0.5], [1.5, 0.0, 0.5]),
    "min |q|": (lambda q: jnp.min(jnp.abs(q)), [1.0, -0.3, 2.0], [1.0, 0.04, 2.0]),
    "|max|": (lambda q: jnp.abs(jnp.max(q)), [1.0, 0.3, 0.2], [0.5, 0.3, 0.2]),
}  # fmt: skip


@pytest.mark.parametrize("potential", TIES)
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_tie_that_a_motion_leaves_does_not_hold_it(potential, way):
    """Compiles one motion, forwards and back: one border reads what is decided at another one, all at q = 0."""
    V, speeds, ends = TIES[potential]
    run = lagjax.simulate(in_potential(V), np.zeros(3), way * np.array(speeds), way * np.array([0.0, 1.0]))
    np.testing.assert_allclose(run.q[-1], ends, atol=1e-12)


def test_a_force_without_a_value_beyond_its_border_leaves_friction_alone():
    """Compiles one motion: sign(q) √(|q| + c), on its other side, is the root of what is negative there."""
    held = lagjax.simulate(ROOT_BESIDE_FRICTION, 0.25, 0.0, np.array([0.0, 1.0]), -0.75)
    assert held.q[-1] == 0.25
    rough, smooth = (
        lagjax.simulate(ROOT_BESIDE_FRICTION, 0.25, 0.5, np.array([0.0, 0.2]), mu).q[-1] for mu in (-0.75, 0.0)
    )
    assert 0.9 * 0.02 * 0.75 < smooth - rough < 1.1 * 0.02 * 0.75  # ½ μ t², but for what the spring does beside it


@pytest.mark.parametrize(("scale", "moved"), [(2.0, 0.4), (-2.0, 0.0)])
def test_two_spellings_of_one_border_push_together(scale, moved):
    """Compiles one motion: v = 0 and v / scale = 0 are one border, and 0.8 − 1 + 0.6 is left above it."""
    run = lagjax.simulate(TWO_SPELLINGS, 0.0, 0.0, np.array([0.0, 1.0]), scale)
    np.testing.assert_allclose(2 * run.q[-1], moved, atol=1e-14)
