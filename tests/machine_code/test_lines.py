"""Straight lines that NumPy evaluates, as functions of JAX: values and derivatives are those of the function itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

from lagjax._engine.taylor._line_functions import Line
from lagjax._program import lower


def function(x):
    """Quotients, a root and a power whose slopes are steep, and a border."""
    a, b, c, d = x
    return jnp.stack([a * jnp.sin(b) / (1.0 + c**2), jnp.sqrt(a + b * d) + jnp.abs(c - 2.0) * d, jnp.exp(-a * c) * d])


PROGRAM = lower(function, jnp.ones(4))
LINE = Line(PROGRAM.line, 4, 4)
X, D = np.array([0.7, 1.1, 0.4, 0.9]), np.array([0.3, -0.5, 0.2, 0.8])

MODES = {
    "value": lambda f: f(X),
    "jvp": lambda f: jax.jvp(f, (X,), (D,))[1],
    "jacrev": lambda f: jax.jacrev(f)(X),
    "jacfwd": lambda f: jax.jacfwd(f)(X),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f))(X),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f))(X),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f))(X),
    "third": lambda f: jax.jacfwd(jax.jacrev(jax.jacfwd(f)))(X),
    "vmap of grad": lambda f: jax.vmap(jax.grad(lambda x: f(x)[1]))(np.stack([X, 1.1 * X])),
    "grad of vmap": lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(x)))(np.stack([X, 1.1 * X])),
    "shared in vmap": lambda f: jax.vmap(lambda d: jax.jvp(f, (X,), (d,))[1])(np.stack([D, 2.0 * D])),
    "jit of hessian": lambda f: jax.jit(jax.hessian(lambda x: f(x)[0]))(X),
    "jit of vmap": lambda f: jax.jit(jax.vmap(f))(np.stack([X, 1.1 * X])),
}


@pytest.mark.parametrize("mode", sweep(MODES, kept=("value", "jvp", "jit of hessian")))
def test_derivatives_in_every_mode(mode):
    # Both are exact but for the rounding of some ten operations on numbers of order one.
    np.testing.assert_allclose(MODES[mode](LINE), MODES[mode](function), rtol=1e-13, atol=1e-13)
