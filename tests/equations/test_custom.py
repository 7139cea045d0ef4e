"""Values with the derivatives of another expression, where `jax.custom_jvp` would lose its rule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax._primitives import attach_derivative


def moved(t, y):
    """t and y, plus what is zero and has first and second derivatives."""
    change = y**2 - jax.lax.stop_gradient(y**2)
    return t + change + 0.5 * change**2 * jax.lax.stop_gradient(y), y * (1 + change)


def repeated(x, scan: bool, step):
    def body(carry, _):
        t, y = step(*carry)
        y = jnp.sin(y) * t
        return (t, y), y

    carry = x[0], x[1]
    if scan:
        return jax.lax.scan(body, carry, jnp.arange(3))[1][-1]
    for _ in range(3):
        carry, y = body(carry, None)
    return y


def step(t, y):
    return attach_derivative(moved, (t, y), t, y)


@pytest.mark.slow
@pytest.mark.parametrize("scan", [False, True])
def test_derivatives_are_those_of_the_expression_in_every_order_of_modes(scan):
    x = np.array([0.7, 1.1])
    exact = jax.jit(jax.jacfwd(jax.jacfwd(lambda x: repeated(x, False, moved))))(x)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            found = jax.jit(outer(inner(lambda x: repeated(x, scan, step))))(x)
            np.testing.assert_allclose(found, exact, rtol=1e-12)
    batch = np.stack([x, 2 * x])
    found = jax.jit(jax.vmap(jax.hessian(lambda x: repeated(x, scan, step))))(batch)
    np.testing.assert_allclose(found[0], exact, rtol=1e-12)


def test_the_value_is_what_is_given():
    assert attach_derivative(lambda x: (2 * x,), (jnp.float64(5.0),), 3.0)[0] == 5.0
