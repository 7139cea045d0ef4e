"""The vectorised elementary functions: accuracy against mpmath, special values, derivatives, dispatch."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from sweeps import sweep

from lagjax import _elementary as el

OWN = {
    "sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "asin": jnp.arcsin, "acos": jnp.arccos, "atan": jnp.arctan,
    "atan2": jnp.arctan2, "sinh": jnp.sinh, "cosh": jnp.cosh, "log": jnp.log, "log1p": jnp.log1p, "expm1": jnp.expm1,
    "pow": jnp.power,
}  # fmt: skip
NUMPY = {name: getattr(np, f.__name__) for name, f in OWN.items()}
EXACT = {name: getattr(mpmath, "power" if name == "pow" else name) for name in OWN}
UNARY = [name for name in OWN if name not in ("atan2", "pow")]
BOUND = dict.fromkeys(OWN, 2.0) | {"sin": 1.0, "cos": 1.0, "tan": 1.5, "asin": 1.5, "acos": 1.5, "atan": 1.5,
                                   "log": 1.5, "log1p": 1.5}  # fmt: skip
COUNT = 700


def signed(rng, low, high):
    """Log-spaced numbers of either sign, exponents of ten from low to high."""
    return 10 ** rng.uniform(low, high, COUNT) * rng.choice([-1.0, 1.0], COUNT)


def quarter_turns(counts):
    """The doubles nearest to multiples of pi/2."""
    with mpmath.workprec(200):
        return np.array([float(int(k) * mpmath.pi / 2) for k in counts])


def arguments(name):
    """Tuples of argument arrays for a function, everywhere but near its special values."""
    rng = np.random.default_rng(1)
    if name in ("sin", "cos", "tan"):
        near = quarter_turns(np.r_[1:200, rng.integers(1, 1_300_000, COUNT)])
        spread = rng.uniform(-(2**21), 2**21, COUNT)
        return [(signed(rng, -12, 6.3),), (near,), (np.nextafter(near, np.inf),), (spread,)]
    if name in ("asin", "acos"):
        return [(signed(rng, -12, 0),), (rng.uniform(-1, 1, COUNT),), (1 - np.abs(signed(rng, -15, -1)),)]
    if name == "atan":
        return [(signed(rng, -12, 12),), (rng.uniform(-3, 3, COUNT),)]
    if name == "log":
        return [(np.abs(signed(rng, -307, 307)),), (1 + signed(rng, -14, -1),), (rng.uniform(0.1, 3, COUNT),)]
    if name == "log1p":
        return [(np.abs(signed(rng, -12, 300)),), (rng.uniform(-1, 3, COUNT),), (signed(rng, -16, -0.01),)]
    if name == "atan2":
        wide = signed(rng, -150, 150), signed(rng, -150, 150)
        return [wide, (rng.normal(size=COUNT), rng.normal(size=COUNT))]
    if name == "pow":
        x, near_one = np.abs(signed(rng, -300, 300)), np.exp(signed(rng, -10, -1))
        reach = rng.uniform(-700, 700, COUNT)
        plain = [(np.abs(signed(rng, -2, 2)), np.full(COUNT, p)) for p in (0.5, 1.5, -1.5, 1 / 3)]
        return [(x, reach / np.log(x)), (near_one, reach / np.log(near_one)), *plain]
    return [(signed(rng, -12, 2.84),), (rng.uniform(-3, 3, COUNT),)]  # sinh, cosh, expm1


def errors(name, args, prec=160):
    """Signed errors of compiled code as floats, and the ulps of the exact results."""
    values = np.asarray(jax.jit(el.FAST[name])(*args))
    with mpmath.workprec(prec):
        exact = [EXACT[name](*(mpmath.mpf(float(a)) for a in point)) for point in zip(*args, strict=True)]
        error = [float(mpmath.mpf(float(v)) - e) for v, e in zip(values, exact, strict=True)]
    return np.abs(error), np.spacing(np.abs([float(e) for e in exact]))


@pytest.mark.parametrize("name", OWN)
def test_accuracy(name):
    for args in arguments(name):
        error, ulp = errors(name, args)
        worst = np.argmax(error / ulp)
        assert error[worst] <= BOUND[name] * ulp[worst], [a[worst] for a in args]


@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
def test_large_angles(name):
    rng = np.random.default_rng(2)
    for x in (signed(rng, 6, 15.95), quarter_turns(rng.integers(1_300_000, 2**52, COUNT))):
        error, ulp = errors(name, (x,), prec=250)
        slack = 2.0**-80 * (1 + np.tan(x) ** 2) if name == "tan" else 2.0**-80
        assert np.all(error <= BOUND[name] * ulp + slack)
    assert np.isfinite(el.FAST[name](jnp.float64(2.0**53)))
    assert np.isnan(el.FAST[name](jnp.float64(2.0**53 + 2)))


def test_constants_are_cut_without_loss():
    with mpmath.workprec(400):
        sums = [sum(map(mpmath.mpf, parts)) for parts in (el.PI_2, el.LN2, el.TURNS_EXCESS)]
        exact = [mpmath.pi / 2, mpmath.log(2), el.TURNS - 680060 * 2 * mpmath.pi]
        for total, value, bits in zip(sums, exact, (148, 132, 96), strict=True):
            assert abs(total - value) < mpmath.mpf(2) ** -bits


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 3.0, -3.0, 2.5, -2.5, 800.0, -800.0, 1e300, -1e300,
                    np.inf, -np.inf, np.nan])  # fmt: skip


def assert_same(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-15, atol=0)
    there = ~np.isnan(theirs)
    np.testing.assert_array_equal(np.signbit(ours)[there], np.signbit(theirs)[there])


@pytest.mark.parametrize("name", UNARY)
def test_special_values(name):
    x = SPECIAL[~(np.abs(SPECIAL) == 1e300)] if name in ("sin", "cos", "tan") else SPECIAL
    with np.errstate(all="ignore"):
        assert_same(np.asarray(jax.jit(el.FAST[name])(x)), NUMPY[name](x))


@pytest.mark.parametrize("name", ["atan2", "pow"])
def test_special_pairs(name):
    a, b = (v.ravel() for v in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        theirs = NUMPY[name](a, b)
        subnormal = np.abs(theirs) < np.finfo(float).tiny
        assert_same(np.asarray(jax.jit(el.FAST[name])(a, b)), np.where(subnormal, np.copysign(0.0, theirs), theirs))


def test_range_ends():
    with np.errstate(all="ignore"):
        for name in ("sinh", "cosh", "expm1"):
            x = np.array([709.7, 709.79, 710.4, 710.47, 710.48, -36.0, -38.0, -709.0])
            assert_same(np.asarray(jax.jit(el.FAST[name])(x)), NUMPY[name](x))
        x = np.array([2.0, 2.0, 2.0, 0.5, 10.0])
        y = np.array([1023.999, 1024.0, -1022.0, 1022.0, 308.2])
        assert_same(np.asarray(jax.jit(el.pow)(x, y)), x**y)


def test_subnormal_arguments():
    x = np.array([5e-324, -5e-324, 1e-310, -2.2e-308])
    for name in ("sin", "tan", "asin", "atan", "sinh", "expm1", "log1p"):
        np.testing.assert_array_equal(np.asarray(jax.jit(el.FAST[name])(x)).view(np.int64), x.view(np.int64))
    np.testing.assert_allclose(jax.jit(el.log)(np.abs(x)), np.log(np.abs(x)), rtol=1e-15)
    np.testing.assert_allclose(jax.jit(el.pow)(np.abs(x), 0.5), np.abs(x) ** 0.5, rtol=1e-15)
    assert np.isnan(el.log(jnp.float64(-5e-324)))


# ---- derivatives ----------------------------------------------------------------------------------------------------

POINT = 0.37


def derivatives(f, x):
    """Value and three derivatives: forward over reverse over forward."""
    first = jax.jacfwd(f)
    second = jax.grad(first)
    return [g(x) for g in (f, first, second, jax.jacfwd(second), jax.grad(second))]


@pytest.mark.parametrize("name", sweep(UNARY, kept=["sin", "log", "tanh"]))
def test_derivatives(name):
    exact = [float(mpmath.diff(EXACT[name], POINT, n)) for n in (0, 1, 2, 3, 3)]
    np.testing.assert_allclose(derivatives(el.FAST[name], jnp.float64(POINT)), exact, rtol=1e-13)
    batched = jax.jit(jax.vmap(lambda x: jnp.stack(derivatives(el.FAST[name], x))))(jnp.full(3, POINT))
    np.testing.assert_allclose(batched, np.tile(exact, (3, 1)), rtol=1e-13)


@pytest.mark.parametrize("name", ["atan2", "pow"])
def test_derivatives_of_two_arguments(name):
    f, g = el.FAST[name], EXACT[name]
    for fixed in (0.8, 2.0):
        for order in (1, -1):
            ours, exact = ((lambda x, h=h, c=fixed, o=order: h(*(x, c)[::o])) for h in (f, g))
            expected = [float(mpmath.diff(exact, POINT, n)) for n in (0, 1, 2, 3, 3)]
            np.testing.assert_allclose(derivatives(ours, jnp.float64(POINT)), expected, rtol=1e-12, atol=1e-14)


def test_derivative_of_sincos():
    s, c = np.sin(POINT), np.cos(POINT)
    values = derivatives(lambda x: el.sincos(x)[0], jnp.float64(POINT))
    np.testing.assert_allclose(values, (s, c, -s, -c, -c), rtol=1e-15)
    _, pull = jax.vjp(el.sincos, jnp.float64(POINT))
    np.testing.assert_allclose(pull((1.0, 2.0))[0], c - 2 * s, rtol=1e-15)


def test_power_of_a_negative_base_has_a_slope():
    assert jax.grad(lambda x: el.pow(x, 2.0))(jnp.float64(-3.0)) == -6
    assert jax.grad(jax.grad(lambda x: el.pow(x, 2.0)))(jnp.float64(0.0)) == 2
    assert jax.grad(lambda x: el.pow(x, 0.0))(jnp.float64(0.0)) == 0


# ---- dispatch and transformations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sweep(OWN, kept=["sin", "atan2"]))
def test_transformations_agree(name):
    args = tuple(np.clip(a[:64], -100, 100) for a in arguments(name)[-1])
    f = el.FAST[name]
    plain = np.asarray(f(*args))
    for other in (jax.jit(f), jax.vmap(f), jax.jit(jax.vmap(f)), jax.jit(jax.vmap(jax.vmap(f)))):
        shaped = [a.reshape(8, 8) for a in args]
        np.testing.assert_allclose(np.ravel(other(*shaped)), plain, rtol=5e-16)
    np.testing.assert_allclose(f(*(jnp.asarray(a[3]) for a in args)), plain[3], rtol=5e-16)


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize(
    "kind", sweep(["float32", "float16", "complex128", "int32", "python"], kept=["float32", "python"])
)
def test_everything_else_is_jax_numpy(name, kind):
    if name == "atan2" and kind == "complex128":
        pytest.skip("atan2 is real")
    value = 0.5 if kind == "python" else np.array([0.25, 0.5, 0.75]).astype(kind)
    args = (value,) * (2 if name in ("atan2", "pow") else 1)
    ours, theirs = el.FAST[name](*args), OWN[name](*args)
    assert ours.dtype == theirs.dtype and ours.weak_type == theirs.weak_type
    np.testing.assert_array_equal(ours, theirs)


def test_mixed_arguments():
    x = jnp.array([0.5, 2.0])
    assert el.pow(x, 1.5).dtype == x.dtype and not el.pow(x, 1.5).weak_type
    np.testing.assert_array_equal(el.pow(x, 2), x**2)
    np.testing.assert_allclose(el.pow(2.0, x), 2.0**x, rtol=5e-16)
    np.testing.assert_allclose(el.arctan2(x, x[:, None]), jnp.arctan2(x, x[:, None]), rtol=5e-16)


def test_compiled_code_calls_no_scalar_routine():
    """The point of it all: no transcendental instruction is left for XLA to expand into calls."""
    x = jnp.ones(8)
    for name, f in el.FAST.items():
        text = jax.jit(f).lower(*(x,) * (2 if name in ("atan2", "pow") else 1)).as_text()
        assert not any(op in text for op in ("stablehlo.sine", "stablehlo.cosine", "stablehlo.power", "stablehlo.log",
                                             "stablehlo.atan2", "stablehlo.exponential", "chlo."))  # fmt: skip


def test_import_leaves_global_state_alone():
    code = "import jax; import lagjax._elementary; import jax.numpy as n; assert n.ones(1).dtype == n.float32"
    environment = {"JAX_ENABLE_X64": "0", "JAX_PLATFORMS": "cpu", "PATH": ""}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
