"""Numbers at the ends of the range of doubles: motions end, and are right, however small or large they are."""

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

PENDULUM = lagjax.System(lambda q, v: 0.5 * v**2 + 9.81 * jnp.cos(q))


# ---- times -----------------------------------------------------------------------------------------------------------


def test_times_next_to_each_other_end():
    spans = np.array([[0.0, 1.0], [0.0, 5e-324], [0.0, 1e-323], [0.0, 4e-323], [0.0, -5e-324], [5e-324, 0.0],
                      [5e-324, 1e-323], [0.0, 1e-320], [0.0, 1e-300], [0.0, -1.0]])  # fmt: skip
    alone = [lagjax.simulate(PENDULUM, 1.0, 0.5, ts).q[-1] for ts in spans]
    np.testing.assert_array_equal(alone[1:-1], 1.0)
    together = jax.jit(jax.vmap(lambda ts: lagjax.simulate(PENDULUM, 1.0, 0.5, ts).q[-1]))(spans)
    np.testing.assert_allclose(together, alone, rtol=1e-13)
