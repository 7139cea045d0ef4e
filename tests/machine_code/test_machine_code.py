"""`MachineCode` insists: the run that is taken by default, or a sentence that says why there is none."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import oscillator
from scenes import OSCILLATOR

import lagjax
import lagjax._engine.taylor as machine_code

BY_ARRAYS = lagjax.System(oscillator, path="array")
TS = np.linspace(0.0, 10.0, 21)
INSIST = {"solver": lagjax.MachineCode()}


def test_it_is_the_run_that_is_taken_by_default():
    single = lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, **INSIST)
    np.testing.assert_array_equal(single.q, lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS).q)
    batch = lagjax.simulate_batch(OSCILLATOR, jnp.ones(3), jnp.zeros(3), TS, **INSIST)
    np.testing.assert_array_equal(batch.q, np.broadcast_to(single.q, (3, 21)))


def test_it_is_taken_inside_transformations():
    @jax.jit
    @jax.grad
    def slope(q0):
        return lagjax.simulate(OSCILLATOR, q0, 0.0, TS, **INSIST).q[-1]

    assert slope(1.0) == pytest.approx(np.cos(10.0), abs=1e-8)


@pytest.mark.parametrize(
    ("scene", "options", "reason"),
    [
        (BY_ARRAYS, {}, "the array path was asked for"),
        (OSCILLATOR, {"dt": 0.1}, "fixed steps were asked for"),
        (OSCILLATOR, {"event": lambda q, qdot: (q > 0) & (qdot < 0)}, "the event is true or false"),
        (OSCILLATOR, {"adjoint": diffrax.ForwardMode()}, "an adjoint was asked for"),
    ],
)
def test_a_run_without_it_is_an_error_that_says_why(scene, options, reason):
    with pytest.raises(ValueError, match=rf"MachineCode\(\) cannot integrate this: .*{reason}"):
        lagjax.simulate(scene, 1.0, 0.0, TS, **INSIST, **options)
    with pytest.raises(ValueError, match=reason):
        lagjax.simulate_batch(scene, np.ones(2), np.zeros(2), TS, **INSIST, **options)


def test_traced_tolerances_are_an_error_too():
    with pytest.raises(ValueError, match="the tolerances are being traced"):
        jax.jit(lambda rtol: lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, rtol=rtol, **INSIST).q)(1e-6)


@pytest.mark.parametrize(
    ("scene", "solver"),
    [
        (lagjax.scenes.double_pendulum(), "Taylor series in machine code"),
        (lagjax.scenes.chain(16), "because a thread of a GPU would have to remember"),
    ],
    ids=["fits", "too large"],
)
def test_on_a_gpu_the_default_follows_the_size_of_the_scene(monkeypatch, scene, solver):
    """Compiles nothing: an integrator of one lane is written down for each, and the first one's PTX."""
    for name in ("default_platform", "has_nvidia_gpu"):
        monkeypatch.setattr(machine_code, name, lambda: "gpu")
    explained = " ".join(str(scene.system.explain(scene.q0, scene.qdot0, params=scene.params)).split())
    assert solver in explained


def test_where_it_runs_is_asked_anew_for_every_run(monkeypatch):
    """A machine with a GPU, where the device of a run may be the one and then the other."""
    with monkeypatch.context() as context:
        context.setattr(machine_code, "default_platform", lambda: "gpu")
        explained = " ".join(str(OSCILLATOR.explain(1.0, 0.0)).split())
        assert re.search(r"diffrax.*default device is a gpu.*jax\.default_device.*chooses a CPU", explained)
        assert lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, **INSIST).ok
    assert lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, **INSIST).ok
    with jax.default_device(jax.devices("cpu")[0]):
        assert lagjax.simulate(OSCILLATOR, 1.0, 0.0, TS, **INSIST).ok
