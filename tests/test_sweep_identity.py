"""What a store knows of the user's functions: two that may compute other numbers have two texts, here and elsewhere."""

import functools
import os
import subprocess
import sys
import types
from pathlib import Path

import cloudpickle
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks

import lagjax
from lagjax._sweep._identity import identity


class Scale:
    def __init__(self, factor):
        self.factor = factor

    def of(self, trajectory):
        return {"x": self.factor * trajectory.q[-1]}

    def __call__(self, trajectory):
        return self.of(trajectory)


class Module(eqx.Module):
    factor: float

    def __call__(self, trajectory):
        return {"x": self.factor * trajectory.q[-1]}


def times(a):
    return lambda x: a * x


def applied(function):
    return lambda trajectory: {"x": function(trajectory.q)}


def of_module(a):
    module, inner = types.ModuleType("helpers"), types.ModuleType("helpers.inner")
    vars(module)["inner"] = inner
    vars(inner).update(f=times(a), up=module)  # a cycle, as of modules that import each other
    return lambda trajectory: {"x": module.inner.f(module.inner.up.inner.f(trajectory.q))}


def with_default(a):
    return lambda trajectory, *, factor=a: {"x": factor * trajectory.q}


def spline(a):
    return applied(CubicSpline(np.arange(5.0), a * np.arange(5.0) ** 2))


LARGE = np.arange(1e5)
KINDS = {
    "closure": times,
    "closure over a function": lambda a: applied(times(a)),
    "jitted": lambda a: jax.jit(times(a)),
    "closure over a jitted function": lambda a: applied(jax.jit(times(a))),
    "partial": lambda a: functools.partial(times, a),
    "partial of a function": lambda a: functools.partial(applied, times(a)),
    "dict of functions": lambda a: times({"f": times(a)}),
    "method": lambda a: Scale(a).of,
    "object": Scale,
    "closure over an object": lambda a: applied(Scale(a)),
    "module of equinox": Module,
    "closure over jax.vmap": lambda a: applied(jax.vmap(times(a))),
    "large array": lambda a: times(LARGE + 1e-9 * a),
    "array of jax": lambda a: times(jnp.ones(3) * a),
    "key": lambda a: times(jax.random.key(int(a))),
    "spline": spline,
    "user's module": of_module,
    "default": with_default,
    "solver": lambda a: (diffrax.Tsit5(), diffrax.Kvaerno5(), diffrax.Kvaerno3())[int(a)],
    "event": lambda a: diffrax.Event(times(3.0), direction=(None, True, False)[int(a)]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_another_value_is_another_text(kind):
    make = KINDS[kind]
    assert identity(make(1.0)) == identity(make(1.0)) != identity(make(2.0))


def test_libraries_are_named_and_not_read():
    def keep(trajectory):
        return {"peaks": len(find_peaks(np.asarray(trajectory.q))[0])}

    assert "scipy.signal._peak_finding.find_peaks" in identity(keep) and len(identity(keep).split("\n")) < 10
    assert "numpy.linalg" in identity(times(np.linalg.norm))


def test_many_functions_that_call_each_other():
    layers, wide = 40, 6  # 6^40 ways from the first to the last
    names: dict = {}
    for k in reversed(range(layers)):
        called = " + ".join(f"f{k + 1}_{j}(x)" for j in range(wide)) if k + 1 < layers else "x"
        exec("\n".join(f"def f{k}_{j}(x): return {called}" for j in range(wide)), names)
    names["f39_0"].__globals__["f39_5"] = names["f0_0"]  # and in a circle
    assert identity(names["f0_0"]).count("code = ") == (layers - 1) * wide


@pytest.mark.slow
def test_texts_are_the_same_in_another_process(tmp_path):
    # Modules go to another process by name, as files; cloudpickle has no end with those that only stand in memory.
    functions = {kind: make(1.0) for kind, make in KINDS.items() if make is not of_module}
    texts = {kind: identity(function) for kind, function in functions.items()}
    code = (
        "import pickle, sys; from lagjax._sweep._identity import identity\n"
        "functions, texts = pickle.load(open(sys.argv[1], 'rb'))\n"
        "other = {kind: (identity(f), texts[kind]) for kind, f in functions.items() if identity(f) != texts[kind]}\n"
        "assert not other, other"
    )
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    try:
        (tmp_path / "functions.pkl").write_bytes(cloudpickle.dumps((functions, texts)))
    finally:
        cloudpickle.unregister_pickle_by_value(sys.modules[__name__])
    place = str(Path(lagjax.__file__).parents[1])
    there = dict(os.environ, JAX_ENABLE_X64="1")  # a worker counts in the precision of its store
    subprocess.run(
        [sys.executable, "-c", code, tmp_path / "functions.pkl"], check=True, cwd=place, env=there, timeout=120
    )
