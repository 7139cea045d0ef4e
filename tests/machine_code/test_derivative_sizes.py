"""Derivatives of scenes of every size, by everything: state, velocity, parameters, duration; first and second ones.

Scenes are differentiated in another process, as in `test_sizes`, and compared with central differences.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sizes import SCENES, STEP, in_a_process  # noqa: F401, a fixture

import lagjax

DURATION, RTOL = 0.5, 1e-12
WEIGHTS = np.array([1, -8, 8, -1]) / (12 * STEP)
PLACES = STEP * np.array([-2, -1, 1, 2])[:, None]


def problem(name, count):
    """A value, what it is differentiated by as one vector, and a direction; the last number is the duration."""
    system, q0, qdot0, params = SCENES[name](count)
    leaves, structure = jax.tree.flatten(params)
    parts = [q0, qdot0, *(np.asarray(leaf, float) for leaf in leaves), np.array([DURATION])]
    ends = np.cumsum([part.size for part in parts])
    weight = np.arange(1.0, len(q0) + 1)

    def value(x):
        q, qdot, *others, duration = (
            part.reshape(like.shape) for part, like in zip(jnp.split(x, ends[:-1]), parts, strict=True)
        )
        ts = np.linspace(0.0, 1.0, 3) * duration[0]
        found = lagjax.simulate(system, q, qdot, ts, jax.tree.unflatten(structure, others), rtol=RTOL)
        return jnp.sum(found.q[1:] ** 2 * weight) + jnp.sum(found.end.qdot * weight)

    x = np.concatenate([part.ravel() for part in parts])
    rng = np.random.default_rng(1)
    # A part of each number, and of the length of the rest where that is zero.
    return value, x, rng.normal(size=x.size) * np.where(x == 0.0, 0.3, np.minimum(np.abs(x), 1.0))


def first_derivatives(name, count):
    """Along a direction: by reverse mode, by forward mode and by differences."""
    with jax.enable_x64(True):
        value, x, direction = problem(name, count)
        slope = float(jax.jit(jax.grad(value))(x) @ direction)
        along = float(jax.jit(lambda x: jax.jvp(value, (x,), (direction,))[1])(x))
        return slope, along, float(WEIGHTS @ np.array([value(y) for y in x + PLACES * direction]))


def second_derivatives(name, count):
    """The Hessian times a direction: forward over reverse, and by differences of gradients."""
    with jax.enable_x64(True):
        value, x, direction = problem(name, count)
        gradient = jax.jit(jax.grad(value))
        product = jax.jit(lambda x: jax.jvp(gradient, (x,), (direction,))[1])(x)
        return np.asarray(product), WEIGHTS @ np.array([gradient(y) for y in x + PLACES * direction])


# Between them lie those of `test_sizes`: seven bodies, and a chain of ten.
LARGE = [
    *(("bodies in the plane", count) for count in (3, 5, 12)),
    ("bodies in space", 4),
    *(("chain", count) for count in (2, 4, 16)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), LARGE)
def test_first_derivatives_of_every_size(in_a_process, name, count):  # noqa: F811
    slope, along, differences = in_a_process(first_derivatives, name, count)
    np.testing.assert_allclose([slope, along], differences, rtol=1e-7)
    np.testing.assert_allclose(slope, along, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("bodies in space", 8), ("chain", 16)])
def test_second_derivatives_of_every_size(in_a_process, name, count):  # noqa: F811
    product, differences = in_a_process(second_derivatives, name, count)
    np.testing.assert_allclose(product, differences, rtol=0, atol=1e-6 * np.abs(differences).max())
