"""The table of operations: its rows are consistent, and a new row is all that a new operation takes."""

import inspect

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from scipy import special

from lagjax import _native
from lagjax._equations import borders
from lagjax._program import OPERATIONS, Operation, Unlowerable
from lagjax._tracing import WRITTEN, lower


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", OPERATIONS)
def test_rows_are_whole(name):
    row = OPERATIONS[name]
    assert row.name == name and callable(WRITTEN.get(name) or getattr(lax, row.lax or name))
    for functions, before in ((row.slopes, 3), (row.cotangents, 4)):
        assert len(functions) in (0, row.arity)
        for function in filter(None, functions):
            assert len(inspect.signature(function).parameters) == before + row.arity
    if row.side:
        inspect.signature(row.side).bind(None, None, None, *[None] * row.arity)
    # What jumps has sides, what moves has derivatives.
    assert row.is_step or len(row.transpose()) == row.arity
    assert not row.is_step or row.side or name in ("is_finite", "and", "or", "xor", "not", "binade", "prefers")


def newton(code, x):
    """The inverse error function by Newton's method, from Winitzki's start (2e-3)."""
    log = code.library("log1p", -(x * x))
    half = 2 / (np.pi * 0.147) + 0.5 * log
    root = code.intrinsic("sqrt", half * half - log / 0.147)
    w = code.intrinsic("copysign", code.intrinsic("sqrt", root - half), x)
    for _ in range(3):
        w = w - (code.library("erf", w) - x) * (0.5 * np.sqrt(np.pi)) * code.library("exp", w * w)
    return w


ERF_INV = Operation(
    "erf_inv", 1, special.erfinv, newton,
    slopes=(lambda f, c, w, u: f("mul", c(0.5 * np.sqrt(np.pi)), f("exp", f("mul", w, w))),),
)  # fmt: skip


def test_a_new_operation_is_one_row(monkeypatch):
    x, y = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 7))
    function = lambda x, y: lax.erf_inv(0.9 * x) * y
    with pytest.raises(Unlowerable, match="`erf_inv` has no scalar form"):
        lower(function, 0.5, 0.5)
    monkeypatch.setitem(OPERATIONS, "erf_inv", ERF_INV)
    program = lower(function, 0.5, 0.5)
    # In NumPy with its transposed derivative, and in JAX.
    np.testing.assert_allclose(program.evaluate_many([x, y])[0], function(x, y), rtol=1e-12)
    np.testing.assert_allclose(jax.jit(program.__call__)(x, y)[0], function(x, y), rtol=1e-12)
    exact = jax.vmap(jax.grad(function, (0, 1)))(x, y)
    np.testing.assert_allclose(program.line.vjp([x, y], [1.0]), exact, rtol=1e-11)
    # Its Taylor series in machine code: q = erf(s t) solves q̈ = −2 s² erf⁻¹(q) q̇ / s.
    s = 0.8
    motion = lower(lambda q, v, t: (-2 * s * lax.erf_inv(q[0]) * v[0], False), np.ones(1), np.ones(1), 0.0)
    ts = np.linspace(0.0, 1.5, 7)
    outcome = _native.Kernel(motion, 1)(ts[None], [[0.0, 2 * s / np.sqrt(np.pi)]], np.zeros((1, 0)), 1e-12, 1e-15, 100)
    assert outcome.code == _native.DONE
    np.testing.assert_allclose(outcome.path[0, :, 0], [float(mpmath.erf(s * t)) for t in ts], atol=1e-10)


def test_a_border_is_a_field_of_its_row(monkeypatch):
    function = lambda q, v, t, params: lax.erf_inv(q) * v
    state = jnp.float64(0.3), jnp.float64(1.0), 0.0, None
    assert borders([function], *state) == []
    with_side = Operation("erf_inv", 1, special.erfinv, newton, side=lambda f, c, w, u: f("ge", u, c(0.0)))
    monkeypatch.setitem(OPERATIONS, "erf_inv", with_side)
    assert [(name, float(side)) for name, _, side in borders([function], *state)] == [("erf_inv", 1.0)]
