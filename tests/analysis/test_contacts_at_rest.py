"""Equilibria, modes and linear equations of what rests on contacts, against forces and frequencies by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

G = 9.81


def block(q, v, params):
    """A block of mass 1 on a floor, which a spring k pulls along it to x = a."""
    return 0.5 * v @ v - G * q[1] - 0.5 * params["k"] * (q[0] - params["a"]) ** 2


BLOCK = lagjax.System(block, contacts=lambda q: {"floor": q[1], "wall": q[0]})
ROUGH = lagjax.System(block, contacts=lambda q: q[1], friction=0.3, slip=lambda q, v: v[0])
ROD = lagjax.System(
    lambda q, v: 0.5 * v @ v - G * q[1] + 3 * q[0],
    constraints=lambda q: {"rod": q @ q - 1},
    contacts=lambda q: {"wall": 0.6 - q[0]},
)
PULLED, PRESSED = {"k": 50.0, "a": 1.0}, {"k": 50.0, "a": -0.2}


def test_closed_contacts_hold_a_scene_at_rest():
    rest = lagjax.equilibrium(BLOCK, np.array([0.3, 0.0]), PULLED)
    np.testing.assert_allclose(rest.q, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose([rest.contact_forces["floor"], rest.contact_forces["wall"]], [G, 0.0], rtol=1e-12)
    assert rest.multipliers is None and str(rest).endswith("contact_forces['floor'] = 9.81, contact_forces['wall'] = 0")


@pytest.mark.slow
def test_small_motions_of_what_rests_on_contacts():
    rest = np.array([1.0, 0.0])
    np.testing.assert_allclose(lagjax.normal_modes(BLOCK, rest, PULLED).frequencies, [50**0.5], rtol=1e-12)
    linear = lagjax.linearize(BLOCK, rest, params=PULLED)
    np.testing.assert_allclose(linear.A[2:], [[-50, 0, 0, 0], [0, 0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(linear.constraint_jacobian, [[0, 1]])
    assert "without load is linear on one side" in say(lagjax.normal_modes, np.zeros(2), {"k": 50.0, "a": 0.0})
    falling = np.array([1.0, 0.0]), np.array([0.0, -1.0]), PULLED
    assert "contacts['floor'] is struck" in say(lagjax.linearize, *falling)
    rising = lagjax.linearize(BLOCK, falling[0], -falling[1], PULLED)
    np.testing.assert_allclose(rising.B[3], [0, 1])  # it is open an instant later


@pytest.mark.slow
def test_derivatives_of_the_forces_of_contacts_at_rest():
    corner = lagjax.equilibrium(BLOCK, np.zeros(2), PRESSED)
    np.testing.assert_allclose(corner.contact_forces["wall"], 10.0, rtol=1e-12)
    force = jax.grad(lambda k: lagjax.equilibrium(BLOCK, jnp.zeros(2), {"k": k, "a": -0.2}).contact_forces["wall"])
    np.testing.assert_allclose(force(50.0), 0.2, rtol=1e-12)
    at = np.array([0.0, 0.0])  # which contacts are closed is known inside of jit, too, where q and gaps are
    traced = jax.jit(jax.vmap(lambda a: lagjax.equilibrium(BLOCK, at, {"k": 50.0, "a": a})))(np.array([-0.2, 0.2]))
    assert traced.ok.tolist() == [True, False] and np.isnan(traced.q[1]).all()


def say(call, *given, **more) -> str:
    with pytest.raises(ValueError) as error:
        call(BLOCK, *given, **more)
    return str(error.value)


@pytest.mark.slow
def test_the_sentence_says_which_contact_opens():
    assert "contacts['wall'] would have to pull" in say(lagjax.equilibrium, np.zeros(2), PULLED)
    assert not lagjax.equilibrium(BLOCK, np.zeros(2), PULLED, throw=False).ok
    assert "begin at a q with a gap of zero" in say(lagjax.equilibrium, np.array([0.3, 0.1]), PULLED)


def test_the_sentence_says_which_contact_closes():
    assert "contacts['wall'] is -0.2: this contact closes" in say(lagjax.equilibrium, np.array([0.3, 0.0]), PRESSED)
    assert "is negative at q" in say(lagjax.equilibrium, np.array([0.3, -0.1]), PULLED)
    assert "simulate this one" in say(lagjax.equilibrium, np.zeros(2), PRESSED, stable=True)
    with pytest.raises(ValueError, match="closed contacts with friction"):
        lagjax.equilibrium(ROUGH, np.array([1.0, 0.0]), PULLED)


@pytest.mark.slow
def test_four_feet_carry_a_load_wherever_they_can():
    """A table of height and two tilts: least-norm shares of a load far off its middle would pull at one foot."""
    feet = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    table = lagjax.System(
        lambda q, v, params: 0.5 * v @ v - q[0] - params @ q[1:], contacts=lambda q: q[0] + feet @ q[1:]
    )
    for load in ([0.0, 0.0], [0.3, 0.1], [0.6, 0.3]):
        forces = lagjax.equilibrium(table, np.zeros(3), np.array(load)).contact_forces
        assert (forces >= -1e-12).all()
        np.testing.assert_allclose([forces.sum(), *(forces @ feet)], [1.0, *load], atol=1e-9)
    with pytest.raises(ValueError, match="would have to pull"):
        lagjax.equilibrium(table, np.zeros(3), np.array([1.2, 0.0]))


@pytest.mark.slow
def test_constraints_come_along_and_singles_too():
    """A weight on a rod that leans against a wall, by statics."""
    for dtype, rtol in ((jnp.float64, 1e-12), (jnp.float32, 1e-6)):
        rest = lagjax.equilibrium(ROD, jnp.array([0.6, 0.8], dtype))
        np.testing.assert_allclose(rest.multipliers["rod"], G / 1.6, rtol=rtol)
        np.testing.assert_allclose(rest.contact_forces["wall"], 3 + 1.2 * G / 1.6, rtol=rtol)


BALL = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q: q[1], restitution=0.5)
HILL = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q: q @ q - 1)


def test_a_sample_time_has_the_impacts_within_it():
    """A ball falls from h onto the floor: after the impact v = 0.5 u − G (t − u/G) with u² = 2 G h."""
    height, dt = 0.1, 0.2
    linear, u = lagjax.linearize(BALL, np.array([0.0, height]), dt=dt), (2 * G * height) ** 0.5
    np.testing.assert_allclose(linear.Phi[3, 1], 1.5 * G / u, rtol=1e-9)
    np.testing.assert_allclose(linear.Phi[1, 1], 1.5 * G * dt / u - 2, rtol=1e-9)  # v at the impact: 0.5 u


def test_a_contact_that_opens_within_the_sample_time_is_an_error():
    top = np.array([np.sin(0.5), np.cos(0.5)]), 2.0 * np.array([np.cos(0.5), -np.sin(0.5)])
    with pytest.raises(ValueError, match="a contact that is closed at this state opens"):
        lagjax.linearize(HILL, *top, dt=0.5)
