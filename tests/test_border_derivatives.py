"""Derivatives through borders: first and second ones, in every mode, against closed forms of motions in pieces.

One scene has a particle of unit mass for each kind of border, so that all of them share their machine code.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

T = 3.0
# A region is entered, V = |q|, a one-sided spring, a border that moves, friction that comes to rest.
START, VELOCITY = jnp.array([0.0, 1.0, 1.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0, 1.0, 0.0])
# Where the first starts; its velocity; where the second starts; the stiffness; when a force on the third is switched
# off; how fast the border moves; the coefficient of friction; where the last one starts.
X = jnp.array([0.0, 1.1, 1.0, 40.0, 0.2, 0.7, 1.0, 0.4])


def forces(q, v, t, params):
    region = jnp.where(q[0] > 1.0, -0.3, 0.0)
    corner = -jnp.sign(q[1])
    spring = -9.81 + jnp.where(t > params[4], 0.0, 1.0) - params[3] * jnp.minimum(q[2], 0.0)
    moving = jnp.where(q[3] > params[5] * t, -1.0, 0.2)
    friction = -params[6] * jnp.sign(v[4]) - 4 * q[4]
    return jnp.array([region, corner, spring, moving, friction])


SCENE = lagjax.System(lambda q, v, params: 0.5 * v @ v, forces=forces)
WEIGHTS = jnp.array([1.0, 0.7, 0.3, 1.3, 2.0])


def value(x, **options):
    start, velocity = START.at[0].set(x[0]).at[1].set(x[2]).at[4].set(x[7]), VELOCITY.at[0].set(x[1])
    run = lagjax.simulate(SCENE, start, velocity, jnp.array([0.0, T]), x, rtol=1e-11, **options)
    return jnp.sum(WEIGHTS * run.q[-1] ** 2)


def exact(x):
    """The same in closed form."""
    t = (1.0 - x[0]) / x[1]
    region = 1.0 + x[1] * (T - t) - 0.15 * (T - t) ** 2
    quarter = jnp.sqrt(2 * x[2])
    s = T + quarter - 2 * quarter
    corner = -(quarter * s - s**2 / 2)
    # Falling with 8.81, then 9.81 until q = 0, and in contact.
    g, w = 9.81, jnp.sqrt(x[3])
    h, u = 1.0 - 4.405 * x[4] ** 2, -8.81 * x[4]
    down = jnp.sqrt(u * u + 2 * g * h)
    contact = 2 * (jnp.pi / 2 + jnp.arctan(g / (down * w))) / w
    flight = 2 * down / g
    s = T - x[4] - (down + u) / g - 2 * contact - flight  # after the second contact
    spring = down * s - g * s**2 / 2
    t = 2 * (1 - x[5])
    moving = x[5] * t + (1 - t) * (T - t) + 0.1 * (T - t) ** 2
    # Half a swing, of time π/2, to the other side, 2 μ/4 short of it; there it stays, as 4 |q| < μ.
    friction = x[6] / 2 - x[7]
    return jnp.sum(WEIGHTS * jnp.array([region, corner, spring, moving, friction]) ** 2)


def test_first_derivatives():
    np.testing.assert_allclose(value(X), exact(X), rtol=1e-10)
    expected = jax.grad(exact)(X)
    np.testing.assert_allclose(jax.grad(value)(X), expected, atol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(value)(X), expected, atol=1e-8)


def test_products_with_the_hessian():
    along = jnp.linspace(1.0, -1.0, X.size)
    product = jax.jvp(jax.grad(value), (X,), (along,))[1]
    np.testing.assert_allclose(product, jax.hessian(exact)(X) @ along, atol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_in_every_mode(inner, outer):
    np.testing.assert_allclose(outer(inner(value))(X), jax.hessian(exact)(X), atol=2e-7)


@pytest.mark.slow
def test_hessians_of_many_members_at_once():
    members = X + jnp.linspace(-0.01, 0.01, 64)[:, None]
    np.testing.assert_allclose(
        jax.jit(jax.vmap(jax.hessian(value)))(members), jax.vmap(jax.hessian(exact))(members), atol=2e-7
    )


@pytest.mark.slow
def test_output_times_of_a_motion_that_slides():
    # A relay: from q + v = 0 on v falls like −e⁻ᵗ, which the program alone, ±1 beside the border, does not say.
    relay = lagjax.System(lambda q, v: 0.5 * v * v, forces=lambda q, v: -jnp.sign(q + v))

    def speed(t):
        return lagjax.simulate(relay, 1.0, 0.0, jnp.array([0.0, t]), rtol=1e-11).qdot[-1]

    v = float(speed(2.0))
    np.testing.assert_allclose(v, -(np.sqrt(3) - 1) * np.exp(-(2.0 - np.sqrt(3) + 1)), rtol=1e-9)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(speed)(2.0), -v, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(jax.grad(speed))(2.0), v, rtol=1e-9)
