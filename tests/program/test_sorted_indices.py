"""Indices by the order of coordinates, as scalars: what a sort gives is shared by many paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

N = 32


def lagrangian(q, v):
    return jnp.sum(v**2) + 0.2 * jnp.sum(v[jnp.argsort(q)] * v) - 0.5 * jnp.sum(q**2)


SORTED = lagjax.System(lagrangian)


@pytest.mark.slow
def test_indices_by_the_order_of_coordinates_are_followed_once():
    q, v = jnp.sin(0.37 * jnp.arange(1.0, N + 1)), jnp.cos(0.3 * jnp.arange(N))
    mass = SORTED.mass_matrix(q, v)
    np.testing.assert_allclose(mass, jax.hessian(lagrangian, argnums=1)(q, v), atol=1e-14)
