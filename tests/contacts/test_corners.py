"""Corners of billiards: a particle that meets two walls at one instant, against the closed form of unfolding."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import particles

import lagjax

LAWS = ("simultaneous", "sequential")
T = 1.7  # from a start at distance 1 with speed 1


@functools.cache
def runs(impacts):
    """`(x, (e, turn, angle))`: the state after T, whether it came there, and the number of impacts; and its slopes."""

    def walls(q, params):
        ways = params[1], params[1] + params[2]
        return jnp.stack([q[1] * jnp.cos(ways[0]) - q[0] * jnp.sin(ways[0]),
                          q[0] * jnp.sin(ways[1]) - q[1] * jnp.cos(ways[1])])  # fmt: skip

    system = lagjax.System(
        lambda q, v: 0.5 * v @ v, contacts=walls, restitution=lambda params: params[0], impacts=impacts
    )

    def end(x, p):
        run = lagjax.simulate(system, x[:2], x[2:], jnp.array([0.0, T]), p)
        return jnp.concatenate([run.q[-1], run.qdot[-1]]), run.impacts.count

    return jax.jit(end), jax.jit(jax.jacfwd(lambda x, p: end(x, p)[0])), jax.jit(jax.jacrev(lambda x, p: end(x, p)[0]))


def straight(x):
    """Where a free motion is after T."""
    return np.concatenate([x[:2] + T * x[2:], x[2:]])


def aimed(turn, angle, part, aside=0.0):
    """A start from which the corner is hit, or missed by so much; `part` of its angle above its first wall."""
    way = turn + part * angle
    out, across = np.array([np.cos(way), np.sin(way)]), np.array([-np.sin(way), np.cos(way)])
    return np.concatenate([out + aside * across, -out]), across


def unfolded(turn, angle, n):
    """What n reflections in turn at walls of an angle π/n do; it is the same whichever wall is the first."""
    product = np.eye(2)
    for k in range(n):
        way = turn + angle * (k % 2)
        normal = np.array([-np.sin(way), np.cos(way)])
        product = (np.eye(2) - 2 * np.outer(normal, normal)) @ product
    return product


@pytest.mark.slow
@pytest.mark.parametrize("impacts", LAWS)
@pytest.mark.parametrize("e", [1.0, 0.6])
def test_a_right_angled_corner_throws_back_and_has_derivatives(impacts, e):
    """Its walls know nothing of each other: every velocity turns by itself, whichever wall is hit first."""
    run, forward, backward = runs(impacts)
    moves = -e * np.block([[np.eye(2), T * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    for turn, part in ((0.0, 0.3), (0.4, 0.5), (1.1, 0.81)):
        x, p = aimed(turn, np.pi / 2, part)[0], np.array([e, turn, np.pi / 2])
        z, count = run(x, p)
        assert count == 2
        np.testing.assert_allclose(z, -e * straight(x), rtol=0, atol=1e-14)
        np.testing.assert_allclose(forward(x, p), moves, rtol=0, atol=1e-14)
        np.testing.assert_allclose(backward(x, p), moves, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("impacts", LAWS)
@pytest.mark.parametrize("n", [3, 4, 5, 7])
def test_other_corners_follow_the_law_and_have_derivatives_along_the_ray_alone(impacts, n):
    """At once the velocity turns back; in turn it does what unfolding says. Beside the ray both walls close apart."""
    run, _, backward = runs(impacts)
    for turn, part in ((0.0, 0.5), (0.4, 0.3), (1.1, 0.81)):
        (x, across), p = aimed(turn, np.pi / n, part), np.array([1.0, turn, np.pi / n])
        back = -np.eye(2) if impacts == "simultaneous" else unfolded(turn, np.pi / n, n)
        z, _ = run(x, p)
        np.testing.assert_allclose(z, np.kron(np.eye(2), back) @ straight(x), rtol=0, atol=1e-14)
        assert np.isnan(backward(x, p)).all()
        for way, is_known in ((x[:2], True), (across, False)):
            slopes = jax.jvp(lambda x, p=p: run(x, p)[0], (x,), (np.concatenate([way, 0 * way]),))[1]
            if is_known:
                np.testing.assert_allclose(slopes, np.concatenate([back @ way, [0, 0]]), rtol=0, atol=1e-13)
            else:
                assert np.isnan(slopes).all()


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 4, 5, 7])
@pytest.mark.parametrize("aside", [-1e-6, 1e-6])
def test_a_corner_that_is_missed_by_a_hair_unfolds(n, aside):
    """n reflections, on either side."""
    run, forward, _ = runs("simultaneous")
    angle, turn = np.pi / n, 0.4
    x, p = aimed(turn, angle, 0.3, aside)[0], np.array([1.0, turn, angle])
    z, count = run(x, p)
    twice = np.kron(np.eye(2), unfolded(turn, angle, n))
    moves = twice @ np.block([[np.eye(2), T * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    assert count == n
    np.testing.assert_allclose(z, twice @ straight(x), rtol=0, atol=1e-13)
    np.testing.assert_allclose(forward(x, p), moves, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("impacts", LAWS)
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_particle_goes_from_corner_to_corner_of_a_square(impacts, turn):
    """A hundred corners, along one diagonal; its walls may be turned against the coordinates."""
    way = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])  # into the square's coordinates
    walls = lambda q: jnp.concatenate([1 + way @ q, 1 - way @ q])
    square = particles(contacts=walls, restitution=1.0, impacts=impacts)
    duration = 200.3

    def end(x):
        run = lagjax.simulate(square, x[:2], x[2:], jnp.array([0.0, duration]), max_transitions=300)
        return jnp.concatenate([run.q[-1], run.qdot[-1]])

    def exact(x):
        """Of each coordinate: a straight line that is folded back between −1 and 1."""
        q, v = way @ x[:2], way @ x[2:]
        far = q + duration * v + 1
        turned = jnp.floor(far / 2) % 2 == 1
        folded = jnp.where(turned, 1 - far % 2, far % 2 - 1)
        return jnp.concatenate([way.T @ folded, way.T @ jnp.where(turned, -v, v)])

    x = np.concatenate([way.T @ np.zeros(2), way.T @ np.array([1.0, -1.0])])
    np.testing.assert_allclose(jax.jit(end)(x), exact(x), rtol=0, atol=1e-11)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(x), jax.jit(jax.jacfwd(exact))(x), rtol=0, atol=1e-9)
