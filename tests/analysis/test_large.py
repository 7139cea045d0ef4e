"""Scenes of hundreds of coordinates whose matrices are sparse: analysed without n × n numbers, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

G = 9.81


def ring(q, v):
    """Equal masses and springs, that may move all together: a mode of frequency zero."""
    return 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum((q - jnp.roll(q, 1)) ** 2)


RING = lagjax.System(ring)


def weights(q, v):
    return 0.5 * jnp.sum(v**2) - G * jnp.sum(q[:, 1])


def links(q):
    joints = jnp.concatenate([jnp.zeros((1, 2)), q])
    return 0.5 * (jnp.sum(jnp.diff(joints, axis=0) ** 2, axis=1) - 1)


CHAIN = lagjax.System(weights, constraints=links)


def hanging(n):
    return jnp.stack([jnp.zeros(n), -jnp.arange(1.0, n + 1)], axis=1)


def test_modes_of_a_ring_are_waves():
    n, count = 1000, 21
    modes = lagjax.normal_modes(RING, jnp.full(n, 0.3), count=count)
    waves = np.sort(2 * np.abs(np.sin(np.pi * np.arange(n) / n)))[:count]
    np.testing.assert_allclose(modes.frequencies, waves, atol=1e-13)
    assert modes.shapes.shape == (count, n) and modes.stable
    np.testing.assert_allclose(modes.shapes @ modes.shapes.T, np.eye(count), atol=1e-12)


def test_modes_of_a_hanging_chain_with_constraints():
    n = 150
    tension = G * np.arange(n, 0, -1)
    sideways = np.diag(tension + np.append(tension[1:], 0)) - np.diag(tension[1:], 1) - np.diag(tension[1:], -1)
    down, up = (lagjax.normal_modes(CHAIN, sign * hanging(n), count=10) for sign in (1, -1))
    np.testing.assert_allclose(down.frequencies, np.sqrt(np.linalg.eigvalsh(sideways)[:10]), rtol=1e-12)
    assert down.stable and not up.stable
    np.testing.assert_allclose(up.exponents[0, 0], np.sqrt(np.linalg.eigvalsh(sideways)[-1]), rtol=1e-12)


def test_few_modes_of_a_small_scene():
    pendulums = lagjax.System(lambda q, v: 0.5 * v @ v + jnp.sum(jnp.cos(q)) - 0.5 * jnp.sum(jnp.diff(q) ** 2))
    all_modes, two = (lagjax.normal_modes(pendulums, jnp.zeros(4), count=count) for count in (None, 2))
    np.testing.assert_array_equal(two.frequencies, all_modes.frequencies[:2])
    np.testing.assert_array_equal(two.shapes, all_modes.shapes[:2])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: lagjax.normal_modes(RING, jnp.zeros(4000)), "take 0.12 GB.*normal_modes.*count=50"),
        (lambda: lagjax.normal_modes(RING, jnp.zeros(300), count=0), "count must be a positive integer"),
        (lambda: jax.jit(lambda q: lagjax.normal_modes(RING, q, count=5))(jnp.zeros(300)), "outside of jit"),
        (
            lambda: lagjax.normal_modes(
                lagjax.System(ring, dissipation=lambda q, v: jnp.sum(v**2)), jnp.zeros(300), count=5
            ),
            "have a potential: some of these damp",
        ),
    ],
)
def test_what_is_not_tried_is_said(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()
