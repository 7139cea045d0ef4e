"""Motions on an NVIDIA GPU: their numbers where there is one, and that they lower for one where there is none.

Each in a process of its own, since the suite computes on CPUs. The GPU's motions are compared with machine code on the
CPU of the same machine.
"""

import os
import shutil
import subprocess
import sys

import pytest

PRELUDE = """
import sys
import diffrax, jax, jax.numpy as jnp, numpy as np, lagjax

jax.config.update("jax_enable_x64", True)
"""

# ---- on a GPU --------------------------------------------------------------------------------------------------------

COMPUTED = (
    PRELUDE
    + """
scene, cpu = lagjax.scenes.double_pendulum(), jax.devices("cpu")[0]
q0 = np.random.default_rng(0).uniform(-1.0, 1.0, (512, 2))
ts = np.linspace(0.0, 5.0, 11)

def batch(q0=q0, **how):
    return lagjax.simulate_batch(scene.system, q0, 0 * q0, ts, scene.params, **how)

def on_cpu(function, *args, **how):
    with jax.default_device(cpu):
        return function(*args, **how)

def double_precision():
    run, truth = batch(rtol=1e-10, atol=1e-10), on_cpu(batch, rtol=1e-13, atol=1e-13)
    assert {device.platform for device in run.q.devices()} == {"gpu"} and run.ok.all()
    assert {device.platform for device in truth.q.devices()} == {"cpu"}
    # Small angles: nothing grows, so that errors are a few dozen tolerances.
    assert np.abs(np.asarray(run.q) - np.asarray(truth.q)).max() < 1e-7

def single_precision():
    run = batch(q0.astype(np.float32), solver=diffrax.Tsit5(), rtol=1e-5, atol=1e-5)
    assert run.q.dtype == np.float32 and {device.platform for device in run.q.devices()} == {"gpu"}
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 1e-2

def gradient():
    def end(q0, params):
        return lagjax.simulate(scene.system, q0, 0 * q0, ts, params, rtol=1e-10, atol=1e-10).q[-1].sum()

    derivatives = jax.jit(jax.grad(end, argnums=(0, 1)))
    here = jax.tree.leaves(derivatives(q0[0], scene.params))
    there = jax.tree.leaves(on_cpu(derivatives, q0[0], scene.params))
    for mine, other in zip(here, there, strict=True):
        assert mine.devices().pop().platform == "gpu"
        np.testing.assert_allclose(np.asarray(mine), np.asarray(other), rtol=1e-6)

def constraint():
    scene = lagjax.scenes.cartesian_pendulum()

    def end():
        return lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params).end

    for mine, other in zip(jax.tree.leaves(end()), jax.tree.leaves(on_cpu(end)), strict=True):
        np.testing.assert_allclose(np.asarray(mine), np.asarray(other), atol=1e-6)

def the_default():
    run = batch()
    assert run.engine == "MachineCode" and {device.platform for device in run.q.devices()} == {"gpu"}
    # Equal to diffrax on the GPU and to machine code on the CPU, each at its own steps.
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 2e-8
    single = lagjax.simulate(scene.system, q0[0], 0 * q0[0], ts, scene.params)
    np.testing.assert_allclose(np.asarray(single.q), np.asarray(run.q[0]), rtol=0, atol=1e-12)
    chain = lagjax.scenes.chain(60)  # more than a thread remembers
    assert "diffrax" in str(chain.system.explain(chain.q0, chain.qdot0, params=chain.params))

def a_member_that_fails():
    fall = lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q)  # onto a centre, which a motion from rest meets
    q0 = np.array([1.0, np.nan, 1.0])
    run = lagjax.simulate_batch(fall, q0, np.array([2.0, 0.0, 0.0]), np.linspace(0.0, 3.0, 4))
    assert run.ok.tolist() == [True, False, False] and np.isnan(np.asarray(run.q[1])).all()
    sound = on_cpu(lagjax.simulate, fall, 1.0, 2.0, np.linspace(0.0, 3.0, 4))
    np.testing.assert_allclose(np.asarray(run.q[0]), np.asarray(sound.q), atol=1e-8)

def borders_and_events():
    block = lagjax.System(
        lambda q, v, params: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params: -params * jnp.sign(v)
    )

    def end(q0, v0, params):
        return lagjax.simulate(block, q0, v0, ts, params, event=lambda q, v: q + 0.3).end.q

    def stop(q0, v0, params):
        return lagjax.simulate(block, q0, v0, ts, params, event=lambda q, v: q + 0.3).end.t

    def rest(q0, v0, params):
        return lagjax.simulate(block, q0, v0, jnp.array([0.0, 9.0]), params).q[-1]

    for function in (end, stop, rest):
        derivatives = jax.jit(jax.vmap(jax.value_and_grad(function, (0, 1, 2)), (0, None, None)))
        starts = np.linspace(1.0, 1.5, 8), 0.2, 0.1
        pairs = zip(jax.tree.leaves(derivatives(*starts)), jax.tree.leaves(on_cpu(derivatives, *starts)), strict=True)
        for mine, other in pairs:
            assert mine.devices().pop().platform == "gpu"
            np.testing.assert_allclose(np.asarray(mine), np.asarray(other), rtol=1e-6, atol=1e-8)

def derivatives_with_constraints():
    scene = lagjax.scenes.cartesian_pendulum()

    def end(speed):
        qdot0 = jax.tree.map(lambda x: x * speed, scene.qdot0)
        run = lagjax.simulate(scene.system, scene.q0, qdot0, ts[:3], scene.params)
        return sum(x.sum() for x in jax.tree.leaves((run.end.q, run.end.qdot)))

    for function in (jax.grad(end), jax.grad(jax.grad(end))):
        function = jax.jit(function)
        np.testing.assert_allclose(np.asarray(function(1.1)), np.asarray(on_cpu(function, 1.1)), rtol=1e-5)

def hybrid_motion():
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    ball = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q)

    def run():
        return lagjax.simulate_hybrid({"flight": ball}, [bounce], "flight", 1.0, 0.0, ts[:3])

    try:
        run()
    except ValueError as error:
        assert "chooses a CPU" in str(error)
    else:
        raise AssertionError("hybrid motion ran on a GPU")
    assert on_cpu(run).ok

def machine_code_under_a_device_of_choice():
    run = batch(solver=lagjax.MachineCode())
    assert {device.platform for device in run.q.devices()} == {"gpu"}
    # Series of another order: both are some ten tolerances off.
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 2e-8
    run = on_cpu(jax.jit(lambda q0: batch(q0, solver=lagjax.MachineCode()).q), q0)
    np.testing.assert_array_equal(np.asarray(run), np.asarray(on_cpu(batch).q))

for name in sys.argv[1:]:
    globals()[name]()
"""
)


@pytest.mark.skipif(shutil.which("nvidia-smi") is None, reason="there is no NVIDIA GPU")
@pytest.mark.parametrize(
    "name",
    [
        "double_precision",
        "single_precision",
        "gradient",
        "constraint",
        "the_default",
        "a_member_that_fails",
        "borders_and_events",
        "derivatives_with_constraints",
        "hybrid_motion",
        "machine_code_under_a_device_of_choice",
    ],
)
def test_on_a_gpu(name):
    run(COMPUTED, name, JAX_PLATFORMS="cuda,cpu", XLA_PYTHON_CLIENT_PREALLOCATE="false")


# ---- for a GPU -------------------------------------------------------------------------------------------------------

# No call of the host is in it, if equinox is told not to raise from inside a program. It reads that from the
# environment as it is imported. Otherwise two calls remain, outside of all loops: diffrax looks whether the output
# times are in order, which `simulate` has seen to already.
LOWERED = (
    PRELUDE
    + """
dtype = np.dtype(sys.argv[1])
pendulum = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 + params * jax.numpy.cos(q))
ts, how = np.linspace(0.0, 1.0, 3), {"solver": diffrax.Tsit5(), "max_steps": 64}

def motion(q0, k):
    run = lagjax.simulate(pendulum, q0, dtype.type(0), ts, k, throw=False, **how)
    return run.q, run.result._value

def batch(q0, k):
    run = lagjax.simulate_batch(pendulum, q0, 0 * q0, ts, k, **how)
    return run.q, run.result._value

def gradient(q0, k):
    return jax.grad(lambda q0, k: motion(q0, k)[0][-1], argnums=(0, 1))(q0, k)

one, many, k = dtype.type(1), np.ones(8, dtype), dtype.type(9.81)
starts = {"motion": one, "batch": many, "gradient": one}
for name in sys.argv[2:]:
    function, q0 = globals()[name], starts[name]
    exported = jax.export.export(jax.jit(function), platforms=["cuda", "cpu"])(q0, k)
    assert exported.platforms == ("cuda", "cpu") and exported.out_avals[0].dtype == dtype
    for mine, other in zip(exported.call(q0, k), jax.jit(function)(q0, k), strict=True):
        np.testing.assert_allclose(mine, other, rtol=10 * np.finfo(dtype).eps)  # compiled twice
    text = exported.mlir_module()
    assert "stablehlo.while" in text and "callback" not in text, function.__name__
"""
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "functions"), [("float32", ("batch", "motion", "gradient")), ("float64", ("motion", "batch", "gradient"))]
)
def test_lowering_without_a_call_of_the_host(dtype, functions):
    run(LOWERED, dtype, *functions, EQX_ON_ERROR="nan")


def run(program: str, *arguments: str, **environment: str):
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
