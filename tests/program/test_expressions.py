"""Derivatives of expressions where a rule leaves something out: at zero, at ties, at whole numbers, next to nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scenes import in_potential, particle
from sweeps import sweep

import lagjax
from benchmarks import expression_population
from lagjax._equations import derivation_of
from lagjax._interface import Layout
from lagjax._program import pullback, pushforward
from lagjax._tracing import lower


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def derivatives(function, x):
    """First and second derivatives of a function of x (n,), each in both modes, by programs in NumPy."""
    n, program = len(x), lower(function, np.asarray(x))
    types = [np.dtype(float)] * (n + 1)
    reverse, units = pullback(program.line, types[:n], range(n), [0]), np.eye(n)
    forward = pushforward(program.line, types[:n], range(n), [0])
    over, under = pushforward(reverse, types, range(n), range(n)), pullback(reverse, types, range(n), range(n))
    with np.errstate(all="ignore"):
        first = [reverse.evaluate([*x, 1.0])[:, 0], [forward.evaluate([*x, *e])[0, 0] for e in units]]
        second = [np.stack([line.evaluate([*x, 1.0, *e])[:, 0] for e in units]) for line in (over, under)]
    return first, second


# Functions around exponentials. What is divided by one, or a function of one, is left out where that has overflown.
AROUND = {
    "log(1 + e)": lambda u: jnp.log(1 + jnp.exp(u)), "log e": lambda u: jnp.log(jnp.exp(u)),
    "1/(1 + e)": lambda u: 1 / (1 + jnp.exp(u)), "root": lambda u: jnp.sqrt(1 + jnp.exp(u)),
    "power": lambda u: (1 + jnp.exp(u)) ** 1.3, "half power": lambda u: jnp.exp(u) ** 0.5,
    "atan": lambda u: jnp.arctan(jnp.exp2(u)), "sin": lambda u: jnp.sin(jnp.exp(u)),
    "tanh": lambda u: jnp.tanh(jnp.expm1(u)), "exp": lambda u: jnp.exp(-u - jnp.exp(-u)),
    "1/(2 + sinh)": lambda u: 1 / (2 + jnp.sinh(u)), "sech²": lambda u: 1 / jnp.cosh(u) ** 2,
    "log(1 + e^sin)": lambda u: jnp.log1p(jnp.exp(jnp.sin(u))), "erf": lambda u: jax.scipy.special.erf(jnp.exp(u)),
    "asinh": lambda u: jnp.arcsinh(jnp.sinh(u)), "quotient": lambda u: u / (1 + jnp.exp(u)),
    "rsqrt": lambda u: jax.lax.rsqrt(jnp.cosh(u)), "cbrt": lambda u: jnp.cbrt(2 + jnp.expm1(u)),
}  # fmt: skip


@pytest.mark.parametrize("name", sweep(AROUND, kept=("log(1 + e)", "1/(1 + e)", "power", "tanh", "exp", "quotient")))
def test_functions_of_exponentials_have_slopes_where_the_exponent_is_zero(name):
    """Also where their argument is next to nothing, or a product or difference that is zero."""
    function = lambda x: AROUND[name](x[0] + x[1] - x[0] * x[1]) + AROUND[name](2 * (x[0] - x[1]))
    exact = jax.jit(lambda x: (jax.grad(function)(x), jax.hessian(function)(x)))
    for x in ([0.0, 0.0], [0.25, 0.25], [1e-300, 0.0], [1e-165, -1e-165], [0.0, 0.4]):
        (first, second), (slope, bend) = derivatives(function, x), exact(np.array(x))
        for found in first:
            np.testing.assert_allclose(found, slope, rtol=1e-14, atol=1e-15)
        for found in second:
            np.testing.assert_allclose(found, bend, rtol=1e-13, atol=1e-14)


FLAT, STEEP = np.zeros(2), np.full(2, np.nan)  # the slopes at u = −800 and 800


@pytest.mark.parametrize(
    ("name", "right"),
    [("1/(1 + e)", FLAT), ("atan", FLAT), ("tanh", FLAT), ("erf", FLAT), ("sech²", FLAT), ("rsqrt", FLAT),
     ("exp", FLAT), ("quotient", [1.0, 0.0]), ("log(1 + e)", [0.0, np.nan]), ("root", [0.0, np.nan]),
     ("asinh", STEEP), ("cbrt", [0.0, np.nan]), ("sin", [0.0, np.nan])],
)  # fmt: skip
def test_what_has_overflown_is_flat_or_no_number(name, right):
    """A slope that is lost with what has overflown, as that of a logarithm, is NaN, and not zero."""
    for u, expected in zip((-800.0, 800.0), right, strict=True):
        first, second = derivatives(lambda x: AROUND[name](x[0]), [u])
        np.testing.assert_allclose(np.ravel(first), expected, atol=1e-200)
        np.testing.assert_allclose(np.ravel(second), 0.0 * expected, atol=1e-200)


def test_a_quotient_of_what_is_large_has_a_slope_where_it_is_zero():
    """tanh u by exponentials of 500 ± u, whose difference is zero at u = 0."""
    function = lambda x: (jnp.exp(500 + x[0]) - jnp.exp(500 - x[0])) / (jnp.exp(500 + x[0]) + jnp.exp(500 - x[0]))
    first, second = derivatives(function, [0.0])
    np.testing.assert_allclose(np.ravel(first), 1.0, rtol=1e-15)
    np.testing.assert_allclose(np.ravel(second), 0.0, atol=1e-15)


BRANCHES = {
    "root": lambda q: lax.cond(q[0] > 0, lambda: jnp.sqrt(q[0]) * q[1], lambda: q[1] * q[0]),
    "power": lambda q: lax.cond(q[0] > 0, lambda: q[0] ** 1.5, lambda: q[0] ** 2),
    "shared": lambda q: lax.cond(
        q[0] > 0, lambda: jnp.sin(q[0] * q[1]) * jnp.log(q[0]), lambda: 2 * jnp.sin(q[0] * q[1])
    ),
    "switch": lambda q: lax.switch(
        (q[0] > 0) * 1 + (q[0] > 0.4), [lambda: q[1] ** 2, lambda: jnp.sqrt(q[0]), lambda: jnp.log(q[0] - 0.4) / q[0]]
    ),
    "nested": lambda q: lax.cond(
        q[0] > 0,
        lambda: lax.cond(q[1] > 0, lambda: jnp.sqrt(q[0]) * jnp.log(q[1]), lambda: jnp.sqrt(q[0]) + jnp.sqrt(-q[1])),
        lambda: lax.cond(q[1] > 0, lambda: jnp.sqrt(q[1]), lambda: q[0] * q[1]),
    ),
}


@pytest.mark.parametrize("name", BRANCHES)
def test_a_branch_that_is_not_taken_has_no_slope(name):
    """Of `cond` and `switch`, whatever the branch is there: NaN, or infinite at zero."""
    potential = BRANCHES[name]
    scene = in_potential(potential)
    derivation = derivation_of(scene, Layout.from_state(np.zeros(2), np.zeros(2)), None)
    points = np.array([[-0.5, 0.3], [0.5, 0.3], [-0.5, -0.3], [0.3, -0.2], [0.0, 0.3], [0.0, 0.0]])
    columns = [*points.T, *np.zeros((3, len(points)))]
    found = derivation.evaluate(["lagrangian_by_q"], columns)["lagrangian_by_q"]
    np.testing.assert_allclose(found, -jax.jit(jax.vmap(jax.grad(potential)))(points), rtol=1e-14)
    exact = jax.jit(lambda x: (jax.grad(potential)(x), jax.hessian(potential)(x)))
    for x in points[:4]:
        (first, second), (slope, bend) = derivatives(potential, x), exact(x)
        np.testing.assert_allclose(first, 2 * [slope], rtol=1e-14)
        np.testing.assert_allclose(second, 2 * [bend], rtol=1e-13, atol=1e-14)


EXTREMES = {
    "max": jnp.max, "min": jnp.min, "|q|": lambda q: jnp.linalg.norm(q, jnp.inf), "median": jnp.median,
    "sorted": lambda q: jnp.sort(q) @ jnp.arange(1.0, 5.0), "quantile": lambda q: jnp.quantile(q, 0.3),
}  # fmt: skip


@pytest.mark.parametrize("function", EXTREMES.values(), ids=EXTREMES)
def test_equal_extremes_share_a_slope_alike(function):
    """The slope of the largest of numbers of which k are equal is 1/k of each, as in JAX; sorted, each has its own."""
    points = np.array([[0.4, 0.4, 0.4, 0.4], [0.4, 0.4, 0.1, 0.4], [-0.1, 0.4, 0.4, 0.4], [0.1, -0.4, 0.4, -0.4]])
    derivation = derivation_of(
        lagjax.System(lambda q, v: 0.5 * v @ v + function(q)), Layout.from_state(np.zeros(4), np.zeros(4)), None
    )
    found = derivation.evaluate(["lagrangian_by_q"], [*points.T, *np.zeros((5, 4))])["lagrangian_by_q"]
    right = jax.jit(jax.vmap(jax.grad(function)))(points)
    np.testing.assert_allclose(found, right, rtol=1e-15)
    first, _ = derivatives(function, points[1])
    np.testing.assert_allclose(first, 2 * [right[1]], rtol=1e-15)


LENGTHS = {
    "hypot": lambda q: jnp.exp(-(jnp.hypot(*q) ** 2)), "norm": lambda q: jnp.log1p(jnp.linalg.norm(q) ** 2.0),
    "root": lambda q: 1 / (1 + jnp.sqrt(q @ q) ** 4), "modulus": lambda q: jnp.abs(q[0] + 1j * q[1]) ** 2 * 0.5,
    "cube": lambda q: jnp.hypot(*q) ** 3,
}  # fmt: skip
SMOOTH = {
    "hypot": lambda r: jnp.exp(-r), "norm": jnp.log1p, "root": lambda r: 1 / (1 + r**2), "modulus": lambda r: 0.5 * r,
    "cube": lambda r: r**1.5,
}  # fmt: skip


@pytest.mark.parametrize("name", LENGTHS)
def test_powers_of_lengths_have_slopes_at_zero(name):
    """Those of the same function of the square; of a cube the second ones do not exist at zero."""
    smooth = lambda q: SMOOTH[name](q @ q)
    exact = jax.jit(lambda x: (jax.grad(smooth)(x), jax.hessian(smooth)(x)))
    for x in (np.zeros(2), np.array([0.3, -0.4])):
        (first, second), (slope, bend) = derivatives(LENGTHS[name], x), exact(x)
        np.testing.assert_allclose(first, 2 * [slope], rtol=1e-14)
        if name != "cube" or x.any():
            np.testing.assert_allclose(second, 2 * [bend], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.5])
def test_a_motion_begins_and_passes_where_a_length_is_zero(power):
    """Along a line through the centre of |z|ᵖ, and of Re zᵖ along its real axis, it is that of one coordinate."""
    one = in_potential(lambda q: abs(q) ** power)
    modulus = lambda q: jnp.abs(q[0] + 1j * q[1]) ** power
    cases = [(modulus, 0.0), (modulus, -0.05), (lambda q: jnp.real((q[0] + 1j * q[1]) ** power), 0.0)]
    for potential, q0 in cases[: 3 if power > 1 else 2]:
        plane = in_potential(potential)
        ts = np.array([0.0, 0.25])
        run = lagjax.simulate(plane, np.array([q0, 0.0]), np.array([0.3, 0.0]), ts)
        np.testing.assert_allclose(run.q[-1], [lagjax.simulate(one, q0, 0.3, ts).q[-1], 0.0], atol=1e-8)


ROUNDED = 6755399441055744.0  # 1.5 · 2⁵²: what is added to it, and is less than 2⁵¹, is rounded to a whole number


@pytest.mark.parametrize(
    "function",
    [lambda x: (x + ROUNDED) - ROUNDED, lambda x: ROUNDED - (ROUNDED - 2 * x), lambda x: (x - 3e12) - 1 + 3e12,
     lambda x: (x + 1.5 * 2**40) - 1.5 * 2**40, lambda x: (x + 1e16) - 1e16, lambda x: (x + ROUNDED) - (ROUNDED - 2),
     lambda x: 1e-200 * (1e-200 * jnp.exp(500 + x)), lambda x: (1e200 * (x * 1e-300)) * 1e200],
)  # fmt: skip
def test_constants_are_not_collected_where_that_is_no_rounding(function):
    program = lower(function, 0.3)
    for x in (0.3, -1.7, 2.5, 7.0):
        np.testing.assert_allclose(program.evaluate(x)[0], function(np.array(x)), rtol=1e-14)
    assert lower(lambda x: ((x + 1.0) - 1.0) * 2.0 * 0.5, 0.3).operations == 0


WAVES = {
    "arccos of a cosine": (lambda u: jnp.arccos(jnp.cos(u)), lambda u: np.sign(np.sin(u))),
    "arcsin of a sine": (lambda u: jnp.arcsin(jnp.sin(u)), lambda u: np.sign(np.cos(u))),
    "arcsin of a cosine": (lambda u: jnp.arcsin(-jnp.cos(2 * u)), lambda u: 2 * np.sign(np.sin(2 * u))),
    "arccos of a sine": (lambda u: jnp.arccos(jnp.sin(u)), lambda u: -np.sign(np.cos(u))),
}


@pytest.mark.parametrize("name", WAVES)
def test_triangular_waves_have_slopes_on_both_sides_of_their_corners(name):
    wave, slope = WAVES[name]
    points = np.array([-7.3, -1.58, -1.57, 0.3, 1.57, 1.58, 3.1, 3.2, 40.0])
    derivation = derivation_of(lagjax.System(lambda q, v: 0.5 * v**2 + wave(q)), Layout.from_state(0.0, 0.0), None)
    names, columns = ["lagrangian", "lagrangian_by_q"], [np.r_[points, 0.0, np.pi, np.pi / 2], *np.zeros((2, 12))]
    values, slopes = (np.ravel(derivation.evaluate(names, columns)[of]) for of in names)
    np.testing.assert_allclose(slopes[:9], slope(points))
    np.testing.assert_allclose(np.abs(slopes[9:]), np.abs(slope(0.3)))  # at a corner it is one of both
    np.testing.assert_allclose(values, wave(columns[0]), atol=1e-14)


@pytest.mark.parametrize("exponent", [0.0, 0.3, 1.0, 2.0])
def test_powers_have_mixed_slopes_where_the_exponent_is_zero(exponent):
    """∂²uᵛ/∂u∂v = uᵛ⁻¹ (1 + v log u), also where v = 0 and ∂uᵛ/∂u is zero."""
    u, v = 1.5, exponent
    (reverse, forward), seconds = derivatives(lambda x: x[0] ** x[1], [u, v])
    for first in (reverse, forward):
        np.testing.assert_allclose(first, [v * u ** (v - 1), u**v * np.log(u)], rtol=1e-14)
    mixed = u ** (v - 1) * (1 + v * np.log(u))
    for second in seconds:
        right = [[v * (v - 1) * u ** (v - 2), mixed], [mixed, u**v * np.log(u) ** 2]]
        np.testing.assert_allclose(second, right, rtol=1e-14, atol=1e-15)
    assert derivatives(lambda x: x[0] ** x[1], [0.0, 0.0])[0][0][0] == 0.0


@pytest.mark.parametrize("number", sweep(range(3, 60, 4), kept=(19,)))
def test_random_expressions_agree_with_jax(number):
    scene, verdict, about = expression_population.judge(number, 0, False, 20)
    assert verdict in expression_population.FINE, (scene, verdict, about)


@pytest.mark.parametrize("u", [3.0, -1e9, 1e12, 1e16, -1e200])
def test_an_angle_less_whole_turns_is_right_or_nan(u):
    """Against NumPy, to the rounding of u; where that leaves nothing of a turn there is no angle."""
    laws = {
        "atan2": (lambda q: jnp.arctan2(jnp.sin(q), jnp.cos(q)), np.arctan2(np.sin(u), np.cos(u))),
        "atan": (lambda q: jnp.arctan(jnp.tan(q)), np.arctan(np.tan(u))),
        "asin": (lambda q: jnp.arcsin(jnp.sin(q)), np.arcsin(np.sin(u))),
        "acos": (lambda q: jnp.arccos(jnp.cos(q)), np.arccos(np.cos(u))),
    }
    for law, exact in laws.values():
        found = float(particle(lambda q, v, law=law: law(q)).acceleration(u, 0.0))
        assert np.isnan(found) if abs(u) > 1e15 else found == pytest.approx(exact, abs=1e-12 + np.spacing(abs(u)))
