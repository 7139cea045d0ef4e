"""What a store knows of the user's functions: two that may compute other numbers have two texts, here and elsewhere."""

import enum
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
from lagjax._interface.reads import identity


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


def of_class(text):
    """An object of a class that is written with another number."""

    def make(a):
        space = {"__name__": "__main__", "enum": enum, "sys": sys}
        exec(text.replace("A", str(a)), space)
        return space["keep"]

    return make


BY_CLASSES = {
    "private method": "class K:\n def _f(self): return A\n def __call__(self, x): return self._f()\nkeep = K()",
    "private attribute": "class K:\n _k = A\n def __call__(self, x): return self._k\nkeep = K()",
    "private static method": (
        "class K:\n @staticmethod\n def _f(): return A\n def __call__(self, x): return self._f()\nkeep = K()"
    ),
    "operator": "class K:\n def __matmul__(self, x): return A\nk = K()\ndef keep(x): return k @ x",
    "setter's class": "class K:\n @property\n def _k(self): return A\nk = K()\ndef keep(x): return k._k",
    "base": "class B:\n _k = A\nclass K(B):\n def __call__(self, x): return self._k\nkeep = K()",
    "enumeration": "class E(enum.Enum):\n X = A\ndef keep(x): return E.X.value * x",
    "member of an enumeration": "class E(enum.Enum):\n X = A\nX = E.X\ndef keep(x): return X.value * x",
    "whole enumeration": "class E(enum.IntEnum):\n X = int(A)\nX = E.X\ndef keep(x): return X * x",
    "number on a function": "def K(): pass\nK.c = A\ndef keep(x): return K.c * x",
    "number of its own class": "class F(float): pass\nk = F(A)\ndef keep(x): return k * x",
    "nested class": "class K:\n class _In:\n  k = A\ndef keep(x): return K._In.k",
    "deque": "import collections\nk = collections.deque([A])\ndef keep(x): return k[0]",
}


def of_import(a):
    sys.modules["inside_of_keep"] = module = types.ModuleType("inside_of_keep")
    exec(f"def h(): return {a}", vars(module))
    return of_class("def keep(x):\n from inside_of_keep import h\n return h()")(a)


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
    "module imported inside": of_import,
    "default": with_default,
    "solver": lambda a: (diffrax.Tsit5(), diffrax.Kvaerno5(), diffrax.Kvaerno3())[int(a)],
    "event": lambda a: diffrax.Event(times(3.0), direction=(None, True, False)[int(a)]),
}


KINDS_IN_MEMORY = {kind: of_class(text) for kind, text in BY_CLASSES.items()}


@pytest.mark.parametrize("kind", KINDS | KINDS_IN_MEMORY)
def test_another_value_is_another_text(kind):
    make = (KINDS | KINDS_IN_MEMORY)[kind]
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
    kinds = KINDS | KINDS_IN_MEMORY
    functions = {kind: make(1.0) for kind, make in kinds.items() if make not in (of_module, of_import)}
    texts = {kind: identity(function) for kind, function in functions.items()}
    code = (
        "import pickle, sys; from lagjax._interface.reads import identity\n"
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
