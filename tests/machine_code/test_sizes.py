"""Gradients of scenes with many parts, against central differences.

Gradients are taken in another process, with the LLVM of users: that in llvmlite's wheels checks assertions, and one
that fails ends the process instead of raising.
"""

import concurrent.futures
import multiprocessing
from concurrent.futures.process import BrokenProcessPool

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

TS = np.linspace(0.0, 0.5, 3)
STEP = 1e-4  # of the differences; their error is a fifth derivative times STEP⁴, and rtol / STEP of rounding


def bodies(count, dimension):
    """Softened gravity between bodies of different masses, by positions: (system, q0, qdot0, params)."""
    first, second = np.triu_indices(count, 1)

    def lagrangian(q, qdot, params):
        x, v, m = q.reshape(count, dimension), qdot.reshape(count, dimension), params["m"]
        distance = jnp.sqrt(jnp.sum((x[first] - x[second]) ** 2, axis=1) + 0.05)
        return 0.5 * jnp.sum(m[:, None] * v**2) + jnp.sum(m[first] * m[second] / distance)

    rng = np.random.default_rng(0)
    q0, qdot0 = (scale * rng.normal(size=count * dimension) for scale in (2.0, 0.3))
    return lagjax.System(lagrangian, path="scalar"), q0, qdot0, {"m": np.linspace(1.0, 2.0, count) / count}


def chain(count):
    scene = lagjax.scenes.chain(count)
    return scene.system, np.asarray(scene.q0), np.asarray(scene.qdot0), scene.params


SCENES = {
    "bodies in the plane": lambda count: bodies(count, 2),
    "bodies in space": lambda count: bodies(count, 3),
    "chain": chain,
}


def slopes(name, count):
    """The derivative of a sum over the last state along one direction: by `jax.grad`, and by differences."""
    with jax.enable_x64(True):
        system, q0, qdot0, params = SCENES[name](count)
        weight = np.arange(1.0, len(q0) + 1)
        direction = np.random.default_rng(1).normal(size=len(q0))

        def value(q0):
            return jnp.sum(lagjax.simulate(system, q0, qdot0, TS, params, rtol=1e-12).q[-1] ** 2 * weight)

        starts = q0 + STEP * np.array([-2, -1, 1, 2])[:, None] * direction
        stack = np.broadcast_to(qdot0, starts.shape)
        ends = lagjax.simulate_batch(system, starts, stack, TS, params, rtol=1e-12).q[:, -1]
        differences = np.array([1, -8, 8, -1]) / (12 * STEP) @ np.sum(ends**2 * weight, axis=1)
        return float(jax.jit(jax.grad(value))(q0) @ direction), float(differences)


@pytest.fixture(scope="module")
def in_a_process():
    """What a function returns in another process, one for a file; where it ends without that, a test fails, no more."""
    pools = []

    def call(function, *arguments):
        if not pools:
            pools.append(concurrent.futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")))
        try:
            return pools[0].submit(function, *arguments).result()
        except BrokenProcessPool:
            pools.clear()
            raise

    yield call
    for pool in pools:
        pool.shutdown()


# Between the sizes of `test_derivative_sizes.py`, where five bodies are those that LLVM once did not survive.
LARGE = [("bodies in the plane", 7), ("chain", 10)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), LARGE)
def test_gradients_of_large_scenes(in_a_process, name, count):
    found, expected = in_a_process(slopes, name, count)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


# ---- what happens before a large kernel runs -------------------------------------------------------------------------


def energy_of(system, run, params):
    return np.array([float(system.energy(run.q[i], run.qdot[i], 0.0, params)) for i in (0, -1)])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("chain", 128), ("bodies in space", 60)])
def test_large_scenes_from_the_first_result_to_health(name, count):
    system, q0, qdot0, params = SCENES[name](count)
    assert lagjax.check(system, q0, qdot0, 0.0, params).ok
    run = lagjax.simulate(system, q0, qdot0, np.linspace(0.0, 0.1, 3), params, rtol=1e-10)
    assert "Taylor series in machine code" in str(system.explain(q0, qdot0, params=params))
    before, after = energy_of(system, run, params)
    assert abs(after - before) < 1e-8 * max(1.0, abs(before))
    assert not run.health().suspicious
