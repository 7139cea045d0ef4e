"""What a newcomer's mistakes in a scene's functions say: the error of Python or JAX, and beneath it what to write."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax


def test_a_key_that_is_not_there_is_told_with_those_that_are():
    def pendulum(q, qdot, params):
        return 0.5 * qdot["theta"] ** 2 + params["g"] * jnp.cos(q["theta"])

    with pytest.raises(KeyError) as error:
        lagjax.simulate(lagjax.System(pendulum), {"theta": 1.0}, {"theta": 0.0}, jnp.arange(3.0), {"G": 9.81})
    note = error.value.__notes__[0]
    assert note == (
        "This is pendulum, a function of a scene: it reads a key that is not there: q has 'theta'; params has 'G'."
    )


@pytest.mark.parametrize("params", [9.81, [9.81]])
def test_params_of_another_structure_are_told_with_what_reads_them(params):
    def pendulum(q, qdot, params):
        return 0.5 * qdot**2 + params["g"] * jnp.cos(q)

    with pytest.raises(TypeError) as error:
        lagjax.simulate(lagjax.System(pendulum), 1.0, 0.0, jnp.arange(3.0), params)
    assert 'it reads `params["g"]`, and the params that it is given are PyTreeDef(' in error.value.__notes__[0]


def test_a_sweep_over_a_parameter_without_its_batch_axis_is_told_of_batch_axes():
    scene = lagjax.System(lambda q, v, params: 0.5 * params["m"] * v @ v - q @ q)
    with pytest.raises(TypeError) as error:
        lagjax.simulate_batch(scene, jnp.ones((3, 2)), jnp.zeros((3, 2)), jnp.arange(3.0), {"m": jnp.ones(3)})
    assert "By batch_axes this is a batch of 3 members" in error.value.__notes__[-1]


@pytest.mark.parametrize("height", [lambda q: math.cos(q), lambda q: np.cos(q), lambda q: q if q > 0 else 0.0])
def test_functions_that_ask_for_values_are_told_what_to_write(height):
    with pytest.raises(TypeError) as error:
        lagjax.simulate(lagjax.System(lambda q, v: 0.5 * v**2 - height(q)), 1.0, 0.0, jnp.arange(3.0))
    note = error.value.__notes__[0]
    assert "write jnp.cos(q) for math.cos(q)" in note and "jnp.where(q > 0, a, b) for `if q > 0`" in note
