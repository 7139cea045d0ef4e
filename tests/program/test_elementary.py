"""Sine and cosine, vectorised: accuracy against mpmath, special values, derivatives, dispatch."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from sweeps import sweep

from lagjax._program import _digits
from lagjax._program import _elementary as el

OWN, NUMPY, EXACT = ({name: getattr(of, name) for name in ("sin", "cos")} for of in (jnp, np, mpmath))
FAST = {"sin": lambda x: el.sincos(x)[0], "cos": lambda x: el.sincos(x)[1]}
COUNT = 700


def signed(rng, low, high):
    """Log-spaced numbers of either sign, exponents of ten from low to high."""
    return 10 ** rng.uniform(low, high, COUNT) * rng.choice([-1.0, 1.0], COUNT)


def quarter_turns(counts):
    """The doubles nearest to multiples of pi/2."""
    with mpmath.workprec(200):
        return np.array([float(int(k) * mpmath.pi / 2) for k in counts])


def angles():
    """Arrays of angles up to 2**21, many of them next to multiples of pi/2."""
    rng = np.random.default_rng(1)
    near = quarter_turns(np.r_[1:200, rng.integers(1, 1_300_000, COUNT)])
    return [signed(rng, -12, 6.3), near, np.nextafter(near, np.inf), rng.uniform(-(2**21), 2**21, COUNT)]


def errors(name, x, prec=160):
    """Errors of compiled code as floats, and the ulps of the exact results."""
    values = np.asarray(jax.jit(FAST[name])(x))
    with mpmath.workprec(prec):
        exact = [EXACT[name](mpmath.mpf(float(a))) for a in x]
        error = [float(mpmath.mpf(float(v)) - e) for v, e in zip(values, exact, strict=True)]
    return np.abs(error), np.spacing(np.abs([float(e) for e in exact]))


@pytest.mark.parametrize("name", OWN)
def test_accuracy(name):
    for x in angles():
        error, ulp = errors(name, x)
        worst = np.argmax(error / ulp)
        assert error[worst] <= ulp[worst], x[worst]


@pytest.mark.parametrize("name", OWN)
def test_large_angles(name):
    rng = np.random.default_rng(2)
    for x in (signed(rng, 6, 15.95), quarter_turns(rng.integers(1_300_000, 2**52, COUNT))):
        error, ulp = errors(name, x, prec=250)
        assert np.all(error <= ulp + 2.0**-80)
    assert np.isfinite(FAST[name](jnp.float64(2.0**53)))
    assert np.isnan(FAST[name](jnp.float64(2.0**53 + 2)))


def test_constants_are_cut_without_loss():
    with mpmath.workprec(400):
        sums = [sum(map(mpmath.mpf, parts)) for parts in (_digits.PI_2, el.TURNS_EXCESS)]
        exact = [mpmath.pi / 2, el.TURNS - 680060 * 2 * mpmath.pi]
        for total, value, bits in zip(sums, exact, (148, 96), strict=True):
            assert abs(total - value) < mpmath.mpf(2) ** -bits


@pytest.mark.parametrize("name", OWN)
def test_special_values(name):
    x = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -2.0, 3.0, -2.5, 800.0, -800.0, np.inf, -np.inf, np.nan])
    with np.errstate(all="ignore"):
        ours, theirs = np.asarray(jax.jit(FAST[name])(x)), NUMPY[name](x)
    np.testing.assert_allclose(ours, theirs, rtol=1e-15, atol=0)
    number = ~np.isnan(theirs)
    np.testing.assert_array_equal(np.signbit(ours)[number], np.signbit(theirs)[number])


def test_subnormal_arguments():
    x = np.array([5e-324, -5e-324, 1e-310, -2.2e-308])
    np.testing.assert_array_equal(np.asarray(jax.jit(FAST["sin"])(x)).view(np.int64), x.view(np.int64))


# ---- derivatives ----------------------------------------------------------------------------------------------------

POINT = 0.37


def derivatives(f, x):
    """Value and three derivatives: forward over reverse over forward."""
    first = jax.jacfwd(f)
    second = jax.grad(first)
    return [g(x) for g in (f, first, second, jax.jacfwd(second), jax.grad(second))]


@pytest.mark.parametrize("name", sweep(OWN, kept=["sin"]))
def test_derivatives(name):
    exact = [float(mpmath.diff(EXACT[name], POINT, n)) for n in (0, 1, 2, 3, 3)]
    np.testing.assert_allclose(derivatives(FAST[name], jnp.float64(POINT)), exact, rtol=1e-13)
    batched = jax.jit(jax.vmap(lambda x: jnp.stack(derivatives(FAST[name], x))))(jnp.full(3, POINT))
    np.testing.assert_allclose(batched, np.tile(exact, (3, 1)), rtol=1e-13)


def test_derivative_of_sincos():
    s, c = np.sin(POINT), np.cos(POINT)
    values = derivatives(lambda x: el.sincos(x)[0], jnp.float64(POINT))
    np.testing.assert_allclose(values, (s, c, -s, -c, -c), rtol=1e-15)
    _, pull = jax.vjp(el.sincos, jnp.float64(POINT))
    np.testing.assert_allclose(pull((1.0, 2.0))[0], c - 2 * s, rtol=1e-15)


# ---- dispatch and transformations -----------------------------------------------------------------------------------


def test_transformations_agree():
    x = np.clip(angles()[-1][:64], -100, 100)
    sin = FAST["sin"]
    plain = np.asarray(sin(x))
    for other in (jax.jit(sin), jax.vmap(sin), jax.jit(jax.vmap(sin)), jax.jit(jax.vmap(jax.vmap(sin)))):
        np.testing.assert_allclose(np.ravel(other(x.reshape(8, 8))), plain, rtol=5e-16)
    np.testing.assert_allclose(sin(jnp.asarray(x[3])), plain[3], rtol=5e-16)


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize(
    "kind", sweep(["float32", "float16", "complex128", "int32", "python"], kept=["float32", "python"])
)
def test_everything_else_is_jax_numpy(name, kind):
    value = 0.5 if kind == "python" else np.array([0.25, 0.5, 0.75]).astype(kind)
    ours, theirs = FAST[name](value), OWN[name](value)
    assert ours.dtype == theirs.dtype and ours.weak_type == theirs.weak_type
    np.testing.assert_array_equal(ours, theirs)


def test_compiled_code_calls_no_scalar_routine():
    """The point of it all: no transcendental instruction is left for XLA to expand into calls."""
    for f in FAST.values():
        text = jax.jit(f).lower(jnp.ones(8)).as_text()
        assert not any(op in text for op in ("stablehlo.sine", "stablehlo.cosine", "chlo."))


def test_import_leaves_global_state_alone():
    code = "import jax; import lagjax._program._elementary; import jax.numpy as n; assert n.ones(1).dtype == n.float32"
    environment = {"JAX_ENABLE_X64": "0", "JAX_PLATFORMS": "cpu", "PATH": ""}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
