"""The derivation at one state: Lagrange's equations against hand calculation, in every form of coordinates."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particle, free_particles
from scenes import SADDLE, particle
from sweeps import sweep

import lagjax
from lagjax._interface import Layout


class Polar(NamedTuple):
    rho: jax.Array
    phi: jax.Array


def central(q, qdot, params):
    return 0.5 * params["m"] * (qdot.rho**2 + q.rho**2 * qdot.phi**2) + params["k"] / q.rho


CENTRAL = lagjax.System(central)
GROWING_MASS = lagjax.System(lambda q, qdot, t: 0.5 * (1 + t**2) * qdot**2 - 0.5 * 3.0 * q**2)
PUSHED_AND_BRAKED = lagjax.System(
    lambda q, qdot: 0.5 * 2.0 * jnp.sum(qdot**2),
    forces=lambda q, qdot, t, params: params * jnp.array([t, 1.0]),
    dissipation=lambda q, qdot: 0.5 * 0.3 * qdot[0] ** 2,
)


PARAMS = {"m": 2.0, "k": 3.0}
Q, QDOT = Polar(1.5, 0.3), Polar(0.2, -0.7)


def test_central_force_by_hand():
    scene = CENTRAL
    m, k = PARAMS["m"], PARAMS["k"]
    acceleration = scene.acceleration(Q, QDOT, params=PARAMS)
    np.testing.assert_allclose(acceleration.rho, Q.rho * QDOT.phi**2 - k / (m * Q.rho**2), rtol=1e-14)
    np.testing.assert_allclose(acceleration.phi, -2 * QDOT.rho * QDOT.phi / Q.rho, rtol=1e-14)
    np.testing.assert_allclose(scene.mass_matrix(Q, QDOT, params=PARAMS), np.diag([m, m * Q.rho**2]), rtol=1e-15)
    momentum = scene.momentum(Q, QDOT, params=PARAMS)
    np.testing.assert_allclose(momentum, (m * QDOT.rho, m * Q.rho**2 * QDOT.phi), rtol=1e-15)
    force = scene.generalized_force(Q, QDOT, params=PARAMS)
    np.testing.assert_allclose(force, (m * Q.rho * QDOT.phi**2 - k / Q.rho**2, 0.0), rtol=1e-14)
    energy = 0.5 * m * (QDOT.rho**2 + Q.rho**2 * QDOT.phi**2) - k / Q.rho
    np.testing.assert_allclose(scene.energy(Q, QDOT, params=PARAMS), energy, rtol=1e-14)


def test_time_dependence_enters_through_the_momentum():
    # L = ½ m(t) q̇² − ½ k q²  gives  m q̈ = −k q − ṁ q̇, with m = 1 + t²; h = ½ m q̇² + ½ k q².
    q, v, t = 0.4, 1.3, 0.8
    np.testing.assert_allclose(GROWING_MASS.acceleration(q, v, t), (-3.0 * q - 2 * t * v) / (1 + t**2), rtol=1e-15)
    np.testing.assert_allclose(GROWING_MASS.energy(q, v, t), 0.5 * (1 + t**2) * v**2 + 1.5 * q**2, rtol=1e-15)


def test_forces_and_dissipation_add_up():
    q, v = np.zeros(2), np.array([1.0, 2.0])
    np.testing.assert_allclose(PUSHED_AND_BRAKED.acceleration(q, v, 4.0, 5.0), [(20.0 - 0.3) / 2, 2.5], rtol=1e-15)
    np.testing.assert_allclose(PUSHED_AND_BRAKED.generalized_force(q, v, 4.0, 5.0), [20.0 - 0.3, 5.0], rtol=1e-15)


def test_indefinite_but_regular_mass_matrix():
    # L = ẋẏ − xy: M = [[0, 1], [1, 0]], and ẍ = −x, ÿ = −y.
    scene = SADDLE
    np.testing.assert_allclose(scene.acceleration(np.array([0.3, 0.7]), np.zeros(2)), [-0.3, -0.7], rtol=1e-15)


def test_masses_of_very_different_size_cost_no_accuracy():
    # ½ m₁ẋ² + ½ m₂(ẋ + ẏ)² − m₁ x − m₂ y: ẍ = (m₂ − m₁)/m₁, ẍ + ÿ = −1; m₁/m₂ = 1e-12.
    m1, m2 = 1e-6, 1e6
    scene = lagjax.System(lambda q, v: 0.5 * m1 * v[0] ** 2 + 0.5 * m2 * (v[0] + v[1]) ** 2 - m1 * q[0] - m2 * q[1])
    x, _ = scene.acceleration(np.zeros(2), np.zeros(2))
    np.testing.assert_allclose(x, (m2 - m1) / m1, rtol=1e-3)  # cond(M) = 4e12 is not removed by scaling here
    light = lagjax.System(lambda q, v: 0.5 * m1 * v[0] ** 2 + 0.5 * m2 * v[1] ** 2 + 1e-3 * v[0] * v[1] - m1 * q[0])
    x, _ = light.acceleration(np.zeros(2), np.zeros(2))
    np.testing.assert_allclose(x, -m1 * m2 / (m1 * m2 - 1e-6), rtol=1e-14)  # cond(M) = 1e12, removed by scaling


@pytest.mark.parametrize("singular", ["absent", "linear", "combination", "three"])
def test_singular_mass_matrix_gives_nan_not_a_number(singular):
    lagrangian = {
        "absent": lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2,
        "linear": lambda q, v: 0.5 * v[0] ** 2 + q[0] * v[1],
        "combination": lambda q, v: 0.5 * (v[0] + 0.3 * v[1]) ** 2 - q[0],
        "three": lambda q, v: 0.5 * (v[0] + 0.3 * v[1] + 0.7 * v[2]) ** 2 + (v[1] - 0.1 * v[2]) ** 2,
    }[singular]
    n = 3 if singular == "three" else 2
    assert np.isnan(lagjax.System(lagrangian).acceleration(np.ones(n), np.ones(n))).all()


def oscillator_of_a_pytree(q, qdot):
    squares = jax.tree.map(lambda x, v: jnp.sum(0.5 * v**2 - 0.5 * 4.0 * x**2), q, qdot)
    return sum(jax.tree.leaves(squares))


OF_A_PYTREE = lagjax.System(oscillator_of_a_pytree)


@pytest.mark.parametrize(
    ("q", "qdot"),
    [
        (0.3, 0.7),
        (np.array([0.3]), np.array([0.7])),
        (np.array([[0.3, 0.1], [0.2, 0.5]]), np.ones((2, 2))),
        ({"a": 0.3, "b": np.array([0.1, 0.2])}, {"a": 0.7, "b": np.ones(2)}),
        (Polar(0.3, 0.1), Polar(0.7, 1.0)),
        ([0.3, (0.1, np.array([1.0]))], [0.7, (1.0, np.array([2.0]))]),
    ],
)
def test_any_pytree_of_coordinates(q, qdot):
    acceleration = OF_A_PYTREE.acceleration(q, qdot)
    assert jax.tree.structure(acceleration) == jax.tree.structure(q)
    jax.tree.map(lambda a, x: np.testing.assert_allclose(a, -4.0 * jnp.asarray(x), rtol=1e-15), acceleration, q)


@pytest.mark.slow
def test_transformations_of_the_derivation():
    scene = CENTRAL
    states = Polar(np.linspace(1, 2, 5), np.linspace(0, 1, 5)), Polar(np.linspace(-1, 1, 5), np.ones(5))
    batched = jax.jit(jax.vmap(lambda q, v: scene.acceleration(q, v, 0.0, PARAMS)))(*states)
    for i in range(5):
        one = scene.acceleration(*jax.tree.map(lambda leaf: leaf[i], states), 0.0, PARAMS)  # noqa: B023
        np.testing.assert_allclose([leaf[i] for leaf in batched], one, rtol=1e-14)
    # ∂ρ̈/∂k = −1/(m ρ²), forward, reverse and batched.
    of_k = lambda k, rho: scene.acceleration(Polar(rho, 0.3), QDOT, 0.0, {"m": 2.0, "k": k}).rho
    for derivative in (jax.grad(of_k), jax.jacfwd(of_k)):
        np.testing.assert_allclose(derivative(3.0, 1.5), -1 / (2.0 * 1.5**2), rtol=1e-14)
        np.testing.assert_allclose(
            jax.vmap(derivative, (None, 0))(3.0, states[0].rho), -1 / (2.0 * states[0].rho ** 2), rtol=1e-14
        )


def hinges(q, v, t, params):
    """A driven pendulum of two hinges with a spring: quotients, roots and an integer parameter."""
    x = jnp.cumsum(params["l"] * jnp.sin(q)) + 0.1 * jnp.cos(3.0 * t)
    u = jnp.cumsum(params["l"] * jnp.cos(q) * v)
    w = jnp.cumsum(params["l"] * jnp.sin(q) * v)
    return 0.5 * (u @ u + w @ w) + jnp.sum(jnp.cos(q)) / (2.0 + x[1] ** 2) - params["k"] * jnp.sqrt(1.0 + q[0] ** 2)


HINGES = lagjax.System(hinges, forces=lambda q, v: -0.1 * v * jnp.abs(v), dissipation=lambda q, v: 0.05 * v @ v)
AT = np.array([0.3, 0.9]), np.array([0.2, -0.4]), np.array(0.7)
NUMBERS = {"l": np.array([0.7, 1.1]), "k": 3}


def plain_acceleration(q, v, t, params):
    return HINGES._motion(Layout.from_state(q, v), params).acceleration(q, v, t, params)


DERIVATIVES = {
    "forward": lambda f: jax.jacfwd(f, (0, 1, 2))(*AT, NUMBERS),
    "reverse": lambda f: jax.jacrev(lambda q, lengths: f(q, *AT[1:], {"l": lengths, "k": 3}), (0, 1))(
        AT[0], NUMBERS["l"]
    ),
    "second": lambda f: jax.hessian(lambda q: f(q, *AT[1:], NUMBERS)[0])(AT[0]),
    "third": lambda f: jax.jacfwd(jax.jacrev(jax.jacfwd(lambda q: f(q, *AT[1:], NUMBERS)[1])))(AT[0]),
    "batched": lambda f: jax.vmap(lambda q: jax.jacfwd(f)(q, *AT[1:], NUMBERS))(jnp.stack([AT[0], AT[1]])),
}


@pytest.mark.parametrize("name", sweep(DERIVATIVES, kept=("forward", "reverse")))
def test_derivatives_of_accelerations_are_those_of_the_derivation_in_jax(name):
    found, expected = (jax.jit(lambda f=f: DERIVATIVES[name](f))() for f in (HINGES.acceleration, plain_acceleration))
    # Both are exact but for the rounding of some hundred operations on numbers of order one.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13), found, expected)


def test_derivatives_of_accelerations_trace_no_lagrangian():
    # XLA gets a call of the scene's program, and not L differentiated three times.
    def count(function):
        text = str(jax.make_jaxpr(jax.jacfwd(function))(*AT, NUMBERS))
        return text.count("lagjax_line"), sum(text.count(f" {name} ") for name in ("sin", "cos", "sqrt"))

    calls, operations = count(HINGES.acceleration)
    assert calls and operations == 0 and count(plain_acceleration)[1] > 20


def test_rules_and_tables_of_the_user_are_followed_in_derivatives():
    @jax.custom_jvp
    def square(x):
        return x**2

    square.defjvp(lambda x, dx: (square(*x), 7.0 * dx[0]))
    ruled = particle(lambda q, v: square(q))
    assert jax.jacfwd(ruled.acceleration)(0.5, 0.0) == 7.0
    table = lagjax.samples(np.linspace(0.0, 1.0, 3), np.array([0.0, 1.0, 0.0]), hold="linear")
    pushed = particle(lambda q, v, t: table(t) * q)
    slopes = jax.jacfwd(pushed.acceleration, (0, 2))(0.5, 0.0, 0.3)
    np.testing.assert_allclose(slopes, [0.6, 1.0], rtol=1e-14)


def test_float32_stays_float32():
    scene = CENTRAL
    q, v = jax.tree.map(jnp.float32, (Q, QDOT))
    assert scene.acceleration(q, v, params=jax.tree.map(jnp.float32, PARAMS)).rho.dtype == jnp.float32


# ---- signatures and returned values ---------------------------------------------------------------------------------


def test_accepted_signatures():
    def with_mass(q, qdot, mass, params):
        return 0.5 * mass * params * qdot**2

    class Learned:
        def __call__(self, position, velocity, *, t):
            return 0.5 * velocity**2 + t

    for lagrangian in (
        free_particle,
        lambda q, qdot, t, params: 0.5 * v_squared(qdot),
        lambda q, qdot, params, t: 0.5 * v_squared(qdot),
        lambda q, qdot, *, t: 0.5 * v_squared(qdot),
        functools.partial(with_mass, mass=2.0),
        jax.jit(lambda q, qdot, params: 0.5 * v_squared(qdot)),
        Learned(),
    ):
        assert lagjax.System(lagrangian).acceleration(0.1, 0.2, 0.5, 1.0) == 0.0


def v_squared(v):
    return v**2


@pytest.mark.parametrize(
    ("lagrangian", "sentence"),
    [
        (lambda q: 0.0, "must have the form lagrangian\\(q, qdot\\)"),
        (lambda: 0.0, "must have the form"),
        (lambda t, q, qdot: 0.0, "must have the form"),
        (lambda q, qdot, parms: 0.0, "asks for `parms`"),
        (lambda q, qdot, parms=(0.0,) * 99: 0.0, "asks for `parms`, which"),
        (lambda q, qdot, time=1.0: 0.0, "asks for `time=1.0`"),
        (lambda *state: 0.0, "must have the form"),
        (lambda q, qdot, **rest: 0.0, "asks for `\\*\\*rest`"),
        (lambda q, *, qdot: 0.0, "must have the form"),
        (3.0, "must be a function"),
    ],
)
def test_refused_signatures(lagrangian, sentence):
    with pytest.raises(TypeError, match=sentence):
        lagjax.System(lagrangian)


@pytest.mark.parametrize(
    ("scene", "q", "qdot", "error", "sentence"),
    [
        (lambda q, v: v**2, np.ones(2), np.ones(2), TypeError, r"one scalar; got an array of shape \(2,\)"),
        (lambda q, v: (v**2, q), 1.0, 1.0, TypeError, "lagrangian must return one scalar"),
        (lambda q, v: v**2 + 1j, 1.0, 1.0, TypeError, "real floating-point number; got complex"),
        (lambda q, v: None, 1.0, 1.0, TypeError, "lagrangian must return one scalar"),
        (lambda q, v: v**2, 1, 1, TypeError, "q must hold real floating-point numbers; got int"),
        (lambda q, v: v**2, 1.0 + 1j, 1.0, TypeError, "q must hold real floating-point numbers; got complex"),
        (lambda q, v: v**2, 1.0, "fast", TypeError, "qdot must be a real number or array; got 'fast'"),
        (lambda q, v: v**2, {"x": 1.0}, {"y": 1.0}, ValueError, "same structure"),
        (lambda q, v: jnp.sum(v**2), np.ones(2), np.ones(3), ValueError, r"q has shape \(2,\), but its velocity"),
        (lambda q, v: 0.0, {}, {}, ValueError, "q has no coordinates"),
    ],
)
def test_refused_states_and_values(scene, q, qdot, error, sentence):
    with pytest.raises(error, match=sentence):
        lagjax.System(scene).acceleration(q, qdot)


def test_refused_forces_and_dissipation():
    kinetic = free_particles
    with pytest.raises(TypeError, match="forces must return the structure of q"):
        lagjax.System(kinetic, forces=lambda q, v: 1.0).acceleration(np.ones(2), np.ones(2))
    with pytest.raises(TypeError, match="dissipation must return one scalar"):
        lagjax.System(kinetic, dissipation=lambda q, v: v).acceleration(np.ones(2), np.ones(2))


def test_a_default_of_a_function_is_taken_as_it_is():
    """The usual way to bind a number in a loop."""
    scenes = [lagjax.System(lambda q, v, m=m, table=(3.0,) * 99: 0.5 * m * v**2 - table[9] * q) for m in (1.0, 2.0)]
    assert [float(scene.acceleration(0.0, 0.0)) for scene in scenes] == [-3.0, -1.5]
