"""A walk along a straight line gives its values, and the running errors that a program of its own would."""

import jax.numpy as jnp
import numpy as np

from lagjax._native import LineWalk
from lagjax._program import lower


def function(x):
    """All operations that a walk knows, some of them at a tie, with terms that cancel."""
    u, v, w = x[0], x[1], x[2]
    pieces = jnp.where(u > v, jnp.sqrt(v), -u) + jnp.where(v == 0.25, jnp.abs(w), w / v) + jnp.where(w <= v, u, 2.0)
    finite = jnp.where(jnp.isfinite(1.0 / (v - 0.25)), 3.0 * u, 0.5)
    more = jnp.where(w >= 1.0, u * v, w) + jnp.where(w < -3.0, 1.0, u)
    return jnp.stack([pieces, finite, jnp.sin(u) * jnp.cos(w) - u, (u + 1e6) - 1e6, more])


def test_values_and_running_errors():
    program = lower(function, jnp.zeros(3), moving=2)
    walk = LineWalk(program.line, 3)
    assert walk.is_known and len(walk) == len(program.line.nodes)
    errors = program.rounding_of(range(5), 2)
    for x in (np.array([0.7, 0.25, -1.2]), np.array([0.25, 0.25, 0.25]), np.array([-2.0, 3.0, 0.0])):
        columns = list(x[:, None])
        values, running = walk(x, 2)
        np.testing.assert_allclose(values, program.line.evaluate(columns)[:, 0], rtol=1e-15)
        np.testing.assert_allclose(running, errors.line.evaluate(columns)[:, 0], rtol=1e-14)


def test_a_line_with_other_operations_is_not_walked():
    assert not LineWalk(lower(lambda x: jnp.exp(x), jnp.zeros(())).line, 1).is_known
