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
    modes = lagjax.normal_modes(RING, np.full(n, 0.3), count=count)
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


def beads(q, v):
    """A string of length one under the tension one, with unit masses."""
    rise, n = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)])), len(q) + 1
    return 0.5 * jnp.sum(v**2) - n * jnp.sum(jnp.sqrt(1.0 / n**2 + rise**2))


STRING = lagjax.System(beads)


@pytest.mark.slow
def test_modes_of_beads_on_a_string():
    """The terms of each second derivative cancel to n⁻² away from rest, where patterns of zeros are tested."""
    n = 250
    modes = lagjax.normal_modes(STRING, np.zeros(n), count=10)
    waves = 2 * (n + 1) * np.sin(np.pi * np.arange(1, 11) / (2 * (n + 1)))
    np.testing.assert_allclose(modes.frequencies, waves, rtol=1e-10)


def phi4(q, v):
    return ring(q, v) - 0.25 * jnp.sum((q**2 - 1) ** 2)


PHI4 = lagjax.System(phi4)
TRAIN = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * jnp.sum((jnp.diff(q) - 1) ** 2))
LOOSE = lagjax.System(lambda q, v: PHI4.lagrangian(q[1:], v[1:]) + 0.5 * v[0] ** 2 * (1 + q[1] ** 2))
PENDULUMS = lagjax.System(lambda q, v: 0.5 * v @ v + jnp.sum(jnp.cos(q)) - 0.5 * jnp.sum(jnp.diff(q) ** 2))


def test_equilibrium_of_a_ring():
    start = 1 + 0.15 * np.random.default_rng(0).normal(size=1000)
    np.testing.assert_allclose(lagjax.equilibrium(PHI4, jnp.asarray(start)).q, 1.0, rtol=1e-14)
    narrow = lagjax.equilibrium(PHI4, np.float32(start[:300]))
    assert narrow.ok and narrow.q.dtype == np.float32


def test_a_family_of_equilibria_is_met_where_it_is_nearest():
    rest = lagjax.equilibrium(TRAIN, 1.1 * np.arange(300.0)).q
    np.testing.assert_allclose(rest, 0.05 * 299 + np.arange(300.0), rtol=1e-12)


def test_equilibrium_of_a_chain_between_two_points():
    n, span = 150, 0.8

    def links_between(q):
        joints = jnp.concatenate([jnp.zeros((1, 2)), q, jnp.array([[span * n, 0.0]])])
        return 0.5 * (jnp.sum(jnp.diff(joints, axis=0) ** 2, axis=1) - 1)

    part = np.arange(1, n) / n
    guess = np.stack([span * n * part, -1.2 * n * part * (1 - part)], axis=1)
    rest = lagjax.equilibrium(lagjax.System(weights, constraints=links_between), np.asarray(guess))
    steps = np.diff(np.concatenate([np.zeros((1, 2)), rest.q, [[span * n, 0.0]]]), axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 1.0, rtol=1e-12)
    # A weight at each joint, and the same tension to the side in all links: slopes are an arithmetic sequence.
    slopes = steps[:, 1] / steps[:, 0]
    np.testing.assert_allclose(np.diff(slopes), slopes[1] - slopes[0], rtol=1e-9)
    np.testing.assert_allclose(rest.multipliers * steps[:, 0], rest.multipliers[0] * steps[0, 0], rtol=1e-9)


@pytest.mark.slow
def test_a_ring_falls_from_its_unstable_equilibrium():
    assert np.asarray(lagjax.equilibrium(PHI4, np.zeros(300)).q == 0).all()
    stable = lagjax.equilibrium(PHI4, np.zeros(300), stable=True)
    modes = lagjax.normal_modes(PHI4, stable.q, count=3)
    assert modes.stable and np.abs(stable.q).max() > 0.9


THRICE = lagjax.System(lambda q, v: 3 * phi4(q, v))


@pytest.mark.slow
def test_other_forms_of_a_large_scene():
    n = 4000
    q, v = np.asarray(np.random.default_rng(0).normal(size=(2, n)))
    assert lagjax.cyclic_coordinates(LOOSE, q, v) == ("q[0]",)
    canonical = lagjax.hamiltonian(LOOSE)
    p = canonical.momentum(q, v)
    np.testing.assert_allclose(canonical.velocity(q, p), v, rtol=1e-12)
    np.testing.assert_allclose(canonical.energy(q, p), LOOSE.energy(q, v), rtol=1e-12)
    assert lagjax.same_motion(PHI4, THRICE, q, v)
    total = lagjax.noether_charge(RING, jnp.ones_like)
    np.testing.assert_allclose(total(q, v), np.sum(v), rtol=1e-12)


def test_advice_for_large_scenes():
    n, q = 1000, np.ones(1000)
    along = np.cos(np.arange(n))
    _, change = jax.jvp(lambda q: PHI4.acceleration(q, jnp.zeros(n)), (q,), (along,))
    by_hand = jnp.roll(along, 1) + jnp.roll(along, -1) - 4 * along
    np.testing.assert_allclose(change, by_hand, atol=1e-12)
    ends = [lagjax.simulate(PHI4, q + x * along, np.zeros(n), np.array([0.0, 1.0])).q[-1] for x in (0.0, 1e-8)]
    part = (ends[1] - ends[0]) / 1e-8
    waves = 2 + 2 * (1 - np.cos(1.0))  # of cos(i), but for the seam of the ring
    np.testing.assert_allclose(part[100:-100], along[100:-100] * np.cos(np.sqrt(waves)), atol=1e-5)


def test_few_modes_of_a_small_scene():
    all_modes, two = (lagjax.normal_modes(PENDULUMS, np.zeros(4), count=count) for count in (None, 2))
    np.testing.assert_array_equal(two.frequencies, all_modes.frequencies[:2])
    np.testing.assert_array_equal(two.shapes, all_modes.shapes[:2])


DAMPED_RING = lagjax.System(ring, dissipation=lambda q, v: jnp.sum(v**2))
PULLED_RING = lagjax.System(lambda q, v: ring(q, v) - jnp.sum(q))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: lagjax.normal_modes(RING, jnp.zeros(4000)), "take 0.12 GB.*normal_modes.*count=50"),
        (lambda: lagjax.normal_modes(RING, jnp.zeros(300), count=0), "count must be a positive integer"),
        (lambda: jax.jit(lambda q: lagjax.normal_modes(RING, q, count=5))(jnp.zeros(300)), "outside of jit"),
        (
            lambda: lagjax.normal_modes(DAMPED_RING, jnp.zeros(300), count=5),
            "have a potential: some of these damp",
        ),
        (
            lambda: lagjax.equilibrium(PULLED_RING, jnp.zeros(300)),
            "the derivative of the forces is singular at the guess",
        ),
        (lambda: lagjax.linearize(RING, jnp.zeros(4000)), r"not tried for 4000 coordinates.*0.13 GB.*normal_modes"),
        (lambda: lagjax.conserved_quantities(RING, *jnp.zeros((2, 4000))), "search for symmetries.*noether_charge"),
        (lambda: lagjax.periodic_orbit(RING, *jnp.zeros((2, 4000)), 1.0), "Periodic orbits: not tried.*two runs"),
        (lambda: lagjax.find_path(RING, *jnp.zeros((2, 4000)), 0.0, 1.0), "Paths: not tried"),
        (lambda: lagjax.routhian(PHI4, *jnp.ones((2, 4000))), "no coordinate is cyclic"),
        (lambda: jax.grad(lambda q: jnp.sum(lagjax.equilibrium(PHI4, q).q))(jnp.ones(300)), "outside of jit"),
    ],
)
def test_what_is_not_tried_is_said(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()
