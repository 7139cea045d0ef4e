"""The path of diffrax lowers for NVIDIA GPUs, which needs none: a motion, a batch and a gradient, in both precisions.

Without a call of the host in it, if equinox is told not to raise from inside a program. It reads that from the
environment as it is imported, hence a process of its own. Otherwise two calls remain, outside of all loops: diffrax
looks whether the output times are in order, which `simulate` has seen to already.
"""

import os
import subprocess
import sys

import pytest

LOWERED = """
import sys
import diffrax, jax, numpy as np, lagjax

jax.config.update("jax_enable_x64", True)
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
    exported = jax.export.export(jax.jit(function), platforms=["cuda"])(q0, k)
    assert exported.platforms == ("cuda",) and exported.out_avals[0].dtype == dtype
    text = exported.mlir_module()
    assert "stablehlo.while" in text and "callback" not in text, function.__name__
"""


@pytest.mark.parametrize(
    ("dtype", "functions"),
    [
        ("float32", ("batch",)),
        pytest.param("float32", ("motion", "gradient"), marks=pytest.mark.slow),
        pytest.param("float64", ("motion", "batch", "gradient"), marks=pytest.mark.slow),
    ],
)
def test_lowering_without_a_call_of_the_host(dtype, functions):
    environment, command = {**os.environ, "EQX_ON_ERROR": "nan"}, [sys.executable, "-c", LOWERED, dtype, *functions]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
