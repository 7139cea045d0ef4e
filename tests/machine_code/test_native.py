"""Machine code for batches: its arithmetic against NumPy and mpmath, its motions against closed forms and SciPy."""

import ctypes
import functools

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from llvmlite import ir
from scipy.integrate import solve_ivp
from sweeps import sweep

import lagjax
from lagjax import _native, scenes
from lagjax._engine import Problem
from lagjax._engine.taylor import flow_of
from lagjax._interface import Layout
from lagjax._native.code import _ir
from lagjax._native.motions import _kernel
from lagjax._native.series import _lanes
from lagjax._program import OPERATIONS
from lagjax._tracing import _scalars as xp
from lagjax._tracing import lower, lower_formula

EPS = 2.0**-52
WIDTH = _ir.lanes()


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


# ---- arithmetic in lanes --------------------------------------------------------------------------------------------


def lanewise(body, *columns):
    """Call `body(code, sincos, vectors)`, compiled, for numbers in columns; a list of columns comes back."""
    module = ir.Module("test")
    module.triple = ""
    sincos = _lanes.sincos_function(module, WIDTH)
    code = _ir.Code(module, "test", [_ir.POINTER, _ir.POINTER], WIDTH, public=True)
    given, results = code.arguments
    out = body(code, sincos, [code.load(code.element(given, i * WIDTH), code.vector) for i in range(len(columns))])
    for i, value in enumerate(out):
        is_bit = value.it.type.element == _ir.BIT
        code.store(code.as_number(value) if is_bit else value, code.element(results, i * WIDTH))
    code.finish()
    _engine, at = _ir.compile_module(module, ("test",))
    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(at["test"])
    count = len(columns[0])
    padded = np.zeros((len(columns), -(-count // WIDTH) * WIDTH))
    padded[:, :count] = columns
    found = np.empty((len(out), padded.shape[1]))
    x, y = _kernel.allocate_aligned(len(columns) * WIDTH), _kernel.allocate_aligned(len(out) * WIDTH)
    for k in range(0, padded.shape[1], WIDTH):
        x[: len(columns) * WIDTH] = padded[:, k : k + WIDTH].ravel()
        function(x.ctypes.data, y.ctypes.data)
        found[:, k : k + WIDTH] = y[: len(out) * WIDTH].reshape(len(out), WIDTH)
    return found[:, :count]


def sincos(x):
    return lanewise(lambda code, sincos, xs: _lanes.sines_and_cosines(code, sincos, xs[0]), x)


def ulps(found, exact):
    with mpmath.workprec(1200):
        error = [float(abs(mpmath.mpf(float(f)) - e)) for f, e in zip(found, exact, strict=True)]
    return np.array(error) / np.spacing(np.abs([float(e) for e in exact]))


def angles(where):
    rng = np.random.default_rng(0)
    if where == "small":
        return rng.choice([-1, 1], 400) * 10 ** rng.uniform(-12, 0.2, 400)
    if where == "reduced":
        return rng.choice([-1, 1], 600) * 10 ** rng.uniform(0, np.log10(2.0**20), 600)
    if where == "near quarter turns":  # where what is left of the angle has lost most digits
        with mpmath.workprec(200):
            k = np.r_[1:200, rng.integers(1, 660_000, 400)]
            return np.array([float(int(i) * mpmath.pi / 2) for i in k])
    if where == "far":
        return rng.choice([-1, 1], 200) * 10 ** rng.uniform(6.1, 300, 200)
    return np.array([5e-324, -5e-324, 1e-310, -2.3e-308, 2.0**20, -(2.0**20), np.nextafter(2.0**20, 0)])


@pytest.mark.parametrize("where", ["small", "reduced", "near quarter turns", "far", "edges"])
def test_sine_and_cosine(where):
    x = angles(where)
    with mpmath.workprec(1200):
        exact = [[f(mpmath.mpf(a)) for a in x] for f in (mpmath.sin, mpmath.cos)]
    for found, right in zip(sincos(x), exact, strict=True):
        assert ulps(found, right).max() <= 1.0


def test_sine_and_cosine_of_special_values():
    sine, cosine = sincos(np.array([0.0, -0.0, np.inf, -np.inf, np.nan]))
    np.testing.assert_array_equal(sine, [0, 0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(cosine, [1, 1, np.nan, np.nan, np.nan])


def test_a_lane_does_not_feel_its_neighbours():
    near = angles("reduced")
    far = np.where(np.arange(len(near)) % WIDTH == 1, 1e9, near)
    for alone, beside in zip(sincos(near), sincos(far), strict=True):
        np.testing.assert_array_equal(alone[near == far], beside[near == far])


LIBRARY = [  # those with one operand; sine and cosine have polynomials
    getattr(lax, row.lax or name) for name, row in OPERATIONS.items()
    if row.arity == 1 and isinstance(row.llvm, str) and name not in ("sin", "cos")
]  # fmt: skip
FAMILIES = {  # functions of two doubles and an integer; exact ones, and those of the C library
    "arithmetic": lambda a, b, n: (a + b, a - b, a * b, a / b, -a, jnp.sqrt(a)),
    "fused": lambda a, b, n: (a * b + 1.0, a * a - b * b),
    "rounding": lambda a, b, n: (jnp.floor(a), jnp.ceil(a), jnp.round(a), lax.round(a), jnp.trunc(b)),
    "pieces": lambda a, b, n: (abs(a), jnp.sign(a), jnp.maximum(a, b), jnp.minimum(a, b), jnp.clip(a, -0.5, 0.5)),
    "remainder": lambda a, b, n: (lax.rem(a, b), jnp.mod(a, 2.5)),
    "comparison": lambda a, b, n: (a < b, a <= b, a > b, a >= b, a == b, a != b, jnp.isfinite(a), n > 1, n == 2),
    "logic": lambda a, b, n: ((a < 0) & (b > 0), (a < 0) | (b > 0), ~(a < 0), (a < 0) ^ (b > 0)),
    "bits of integers": lambda a, b, n: (
        n & 6, n | 5, n ^ 9, ~n, n >> 1, n << 2, ~(n + 3).astype(jnp.uint8), (n * n) ^ n,
    ),
    "bits compared": lambda a, b, n: ((a < 0) == (b > 0), (a < 0) != (b > 0)),
    "select": lambda a, b, n: (
        jnp.where(a > b, a, b), jnp.where((a > 0) & (n > 0), a, 2.0), jnp.where(a > 0, b > 0, a < 1),
    ),
    "convert": lambda a, b, n: ((a > 0) * b, n * a, n.astype(float), n.astype(bool), jnp.round(a).astype(int) * b),
    "library": lambda a, b, n: (*(f(a) for f in LIBRARY), jnp.atan2(a, b), jnp.power(abs(a), b)),
    "of the library's": lambda a, b, n: (jax.nn.sigmoid(a), lax.rsqrt(a), jnp.logaddexp(a, b), jax.nn.softplus(a)),
    "circular": lambda a, b, n: (jnp.sin(a), jnp.cos(a), jnp.sin(b), jnp.cos(a + b)),
    "constants": lambda a, b, n: (1.5, True, a),
    "weights": lambda a, b, n: xp.stack(  # a formula: these come from no primitive
        [xp.binade(a), xp.binade(b), xp.where(xp.prefers(a, b), a, b)]
    ),
}  # fmt: skip
SPECIAL = [0.0, -0.0, 1.0, -1.0, 0.5, 2.5, -2.5, np.inf, -np.inf, np.nan, 1e-310]


def program_of(name):
    if name == "weights":
        shapes = [jax.ShapeDtypeStruct((), dtype) for dtype in (float, float, int)]
        return lower_formula(FAMILIES[name], *shapes, budget=100)
    return lower(FAMILIES[name], 0.5, 0.5, jnp.int64(1))


def test_every_operation_is_in_a_family():
    assert OPERATIONS.keys() <= {op for name in FAMILIES for op, _, _ in program_of(name).line.nodes}


@pytest.mark.parametrize("name", FAMILIES)
def test_operations(name):
    rng = np.random.default_rng(1)
    a, b = (np.r_[rng.normal(scale=2.0, size=60), SPECIAL, rng.permutation(SPECIAL)] for _ in range(2))
    if name == "convert":  # what an infinity is as an integer is nobody's business
        a, b = np.nan_to_num(a, posinf=7.0, neginf=-7.0), np.nan_to_num(b, posinf=7.0, neginf=-7.0)
    n = rng.integers(-3, 4, len(a))
    program = program_of(name)
    found = lanewise(lambda code, sincos, xs: _lanes.emit(code, program.line, lambda i: xs[i], sincos, None), a, b, n)
    expected = np.array([program.evaluate(*row) for row in zip(a, b, n, strict=True)], float).T
    # NumPy rounds the library's functions a little differently; a fused sum is as far from it as one of its roundings.
    size = np.where(np.isfinite(a * a + b * b), a * a + b * b + 1, 0) if name == "fused" else 0.0
    exact = name not in ("library", "fused", "circular", "of the library's", "remainder")
    with np.errstate(all="ignore"):
        for right, column in zip(expected, found, strict=True):
            np.testing.assert_allclose(column, right, rtol=0 if exact else 4 * EPS, atol=np.max(EPS * size))
            assert (np.signbit(column) == np.signbit(right))[(right != 0) & ~np.isnan(right)].all()


# ---- motions --------------------------------------------------------------------------------------------------------


def kernel_of(acceleration, n, *params, singular=lambda *params: False):
    def outputs(q, v, t, *params):
        return *jnp.ravel(acceleration(q, v, t, *params)), singular(*params)

    return _native.Kernel(lower(outputs, jnp.ones(n), jnp.ones(n), 1.0, *params), n)


def double_pendulum(q, v, t):
    c, s = jnp.cos(q[0] - q[1]), jnp.sin(q[0] - q[1])
    a, b = -s * v[1] ** 2 - 2 * 9.81 * jnp.sin(q[0]), s * v[0] ** 2 - 9.81 * jnp.sin(q[1])
    return jnp.stack([a - c * b, 2 * b - c * a]) / (2 - c**2)


SCENES = {  # acceleration, coordinates, parameters
    "free": (lambda q, v, t: 0 * q, 1, 0),
    "oscillator": (lambda q, v, t, w: -(w**2) * q, 1, 1),
    "mass": (lambda q, v, t, m: -q / m, 1, 1),
    "driven": (lambda q, v, t, w: jnp.cos(w * t) - q, 1, 1),
    "pendulum": (lambda q, v, t: -jnp.sin(q), 1, 0),
    "double pendulum": (double_pendulum, 2, 0),
    "Kepler": (lambda q, v, t, gm: -gm * q / jnp.sum(q**2) ** 1.5, 2, 1),
    "fall": (lambda q, v, t: -1 / q**2, 1, 0),
    "wedge": (lambda q, v, t: -jnp.sign(q), 1, 0),
    "walls": (lambda q, v, t, k: k * (jnp.maximum(-q, 0) - jnp.maximum(q - 1, 0)), 1, 1),
    "Hertz": (lambda q, v, t: jnp.maximum(-q, 0) ** 1.5 - 0.1, 1, 0),
    "bump": (lambda q, v, t: jnp.where(abs(q - 5) < 2.4, -0.05, 0.0), 1, 0),
    "wrapped": (lambda q, v, t: np.pi - jnp.mod(q + np.pi, 2 * np.pi), 1, 0),
    "brake": (lambda q, v, t: -jnp.sin(q) - jnp.where(q > 0.3, 2.0, 0.1) * v, 1, 0),
    "pulse": (lambda q, v, t: jnp.exp(-(((t - 5) / 0.1) ** 2)) - q, 1, 0),
}  # fmt: skip


@functools.cache
def kernel(name):
    acceleration, n, params = SCENES[name]
    singular = (lambda m: m == 0) if name == "mass" else lambda *params: False
    return kernel_of(acceleration, n, *[1.0] * params, singular=singular)


def run(name, ts, y0, params=None, rtol=1e-13, atol=None, max_steps=100_000):
    """Members in rows: y0 (N, 2n), params (N,) or one number for all; ts (T,) or (N, T)."""
    params = np.zeros((1, 0)) if params is None else np.reshape(params, (-1, 1))
    return kernel(name)(
        np.atleast_2d(np.asarray(ts, float)), np.atleast_2d(y0), params, rtol, rtol / 1e3 if atol is None else atol,
        max_steps,
    )  # fmt: skip


def assert_done(outcome):
    np.testing.assert_array_equal(outcome.code, _native.DONE)
    assert np.isfinite(outcome.path).all()
    np.testing.assert_array_equal(outcome.path[:, -1], outcome.y_end)


# A step leaves an error of about rtol; the tests below take at most some hundred steps.
TS = np.linspace(0, 10, 23)


@pytest.mark.parametrize("direction", [1, -1])
def test_oscillators(direction):
    w = np.linspace(0.2, 5, 13)
    outcome = run("oscillator", direction * TS, np.stack([1 / w, 1 + 0 * w], 1), w)
    assert_done(outcome)
    phase = w[:, None] * direction * TS
    np.testing.assert_allclose(outcome.path[..., 0] * w[:, None], np.cos(phase) + np.sin(phase), atol=1e-11)
    np.testing.assert_allclose(outcome.path[..., 1], np.cos(phase) - np.sin(phase), atol=1e-11)
    np.testing.assert_array_equal(outcome.t_end, direction * 10)


def test_time_in_the_equations():
    w = np.array([0.3, 2.0, 7.0])
    ts = TS - 3.7  # the start is not zero
    exact = lambda t: np.stack([np.cos(w * t), -w * np.sin(w * t)], -1) / (1 - w**2)[:, None]
    outcome = run("driven", ts, exact(ts[0]), w)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path, np.stack([exact(t) for t in ts], 1), atol=1e-11)


def test_free_motion_is_exact_in_a_few_steps():
    outcome = run("free", TS, [[1.0, 0.5], [0.0, 0.0]])
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], 1 + 0.5 * TS, rtol=2 * EPS)
    np.testing.assert_array_equal(outcome.path[1], 0)
    np.testing.assert_array_equal(outcome.steps, 3)  # 1/16 of the time, five times that, the rest


def ellipse(e, gm=1.0):
    """The state at the pericentre; semimajor axis 1."""
    return [1 - e, 0.0, 0.0, np.sqrt(gm * (1 + e) / (1 - e))]


def kepler_energy(y):
    return 0.5 * (y[..., 2] ** 2 + y[..., 3] ** 2) - 1 / np.hypot(y[..., 0], y[..., 1])


def test_an_orbit_closes():
    e = np.array([0.0, 0.3, 0.6, 0.9, 0.99])
    outcome = run("Kepler", [0, 2 * np.pi], [ellipse(x) for x in e], 1.0)
    assert_done(outcome)
    # An error of the energy, about rtol over r at the pericentre, becomes one of the phase, there magnified by v.
    np.testing.assert_allclose(outcome.y_end[:, 0], 1 - e, atol=1e-11)
    np.testing.assert_array_less(abs(outcome.y_end[:, 1]), 1e-10 / (1 - e))
    np.testing.assert_allclose(kepler_energy(outcome.y_end), -0.5, atol=1e-12)


def test_there_and_back():
    start = [[2.0, 1.0, 0.3, -0.2], [0.1, 0.2, 0.0, 0.0]]
    there = run("double pendulum", [0, 3.0], start)
    back = run("double pendulum", [3.0, 0], there.y_end)
    assert_done(there)
    np.testing.assert_allclose(back.y_end, start, atol=1e-9)  # chaotic: errors grow tenfold and more


# ---- output times ---------------------------------------------------------------------------------------------------


def test_many_and_very_close_output_times():
    close = np.unique(np.r_[np.linspace(0, 2, 5001), 1 + EPS * np.arange(20), 1e-300, 1e-17, 2 - EPS])
    outcome = run("oscillator", close, [[1.0, 0.0]], 1.0)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], np.cos(close), rtol=0, atol=1e-12)
    np.testing.assert_allclose(outcome.path[0, :, 1], -np.sin(close), rtol=1e-11, atol=1e-12)


def test_output_times_change_nothing():
    few, many = (run("double pendulum", ts, [[2.0, 1.0, 0.0, 0.0]]) for ts in ([0, 4.0], np.linspace(0, 4, 1000)))
    np.testing.assert_array_equal(few.y_end, many.y_end)
    np.testing.assert_array_equal(few.steps, many.steps)


@pytest.mark.parametrize("end", [9.0, -9.0])
def test_output_times_at_the_ends_of_steps(end):
    y0 = [[2.0, 1.0, 0.0, 0.0]]
    cut = [run("double pendulum", [0, end], y0, max_steps=k) for k in range(1, 9)]
    assert all(outcome.code == _native.OUT_OF_STEPS for outcome in cut)
    at = np.array([outcome.t_end[0] for outcome in cut])
    around = np.sort(np.r_[0, at, np.nextafter(at, -99), np.nextafter(at, 99), end])[:: int(np.sign(end))]
    outcome = run("double pendulum", around, y0)
    assert_done(outcome)
    for state, t in zip(cut, at, strict=True):
        for beside in (t, np.nextafter(t, -99), np.nextafter(t, 99)):
            np.testing.assert_allclose(outcome.path[0, around == beside][0], state.y_end[0], rtol=0, atol=2e-14)


def test_late_times():
    # At 2³⁰ an ulp of time is 2e-7: the steps keep what it drops.
    ts = 2.0**30 + np.arange(12)
    outcome = run("oscillator", ts, [[1.0, 0.0]], 1.0)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], np.cos(np.arange(12)), atol=1e-12)


def test_every_member_may_have_its_own_output_times():
    ts = np.stack([TS, 2 + TS / 3, -TS, TS[::-1], TS * 1e-9])
    w = np.linspace(1, 2, 5)
    y0 = np.stack([np.cos(w * ts[:, 0]), -w * np.sin(w * ts[:, 0])], 1)
    outcome = run("oscillator", ts, y0, w)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[..., 0], np.cos(w[:, None] * ts), atol=1e-11)


# ---- batches --------------------------------------------------------------------------------------------------------


def crowd(count):
    """Slow and fast members, and some whose angles are beyond what the polynomials take.

    An ulp of those is 5e-10, so that no velocity can be good to less than that: rtol below is as large.
    """
    rng = np.random.default_rng(2)
    y0 = rng.uniform(-2, 2, (count, 2))
    y0[::7, 0] += 2.0**20 * 3
    y0[3::11, 1] *= 20
    return y0


@pytest.mark.parametrize("count", [*range(1, 10), 33])
def test_a_member_does_not_depend_on_the_batch(count):
    y0 = crowd(40)
    whole = run("pendulum", TS, y0, rtol=1e-9)
    assert_done(whole)
    part = run("pendulum", TS, y0[5 : 5 + count], rtol=1e-9)
    np.testing.assert_array_equal(part.path, whole.path[5 : 5 + count])
    np.testing.assert_array_equal(part.steps, whole.steps[5 : 5 + count])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_and_order_change_nothing(monkeypatch, threads):
    y0 = crowd(301)
    expected = run("pendulum", TS, y0[:40], rtol=1e-9)
    order = np.random.default_rng(3).permutation(301)
    monkeypatch.setattr(_kernel, "cores", lambda: threads)
    outcome = run("pendulum", TS, y0[order], rtol=1e-9)
    assert_done(outcome)
    np.testing.assert_array_equal(outcome.path[np.argsort(order)][:40], expected.path)


def test_parameters_of_every_member_or_of_all():
    w = np.array([1.0, 2.0, 3.0])
    y0 = np.ones((3, 2))
    each, shared = run("oscillator", TS, y0, w), run("oscillator", TS, y0, 2.0)
    np.testing.assert_array_equal(each.path[1], shared.path[0])
    assert not np.array_equal(each.path[0], shared.path[0])


# ---- failures -------------------------------------------------------------------------------------------------------

FAILURES = {  # scene, healthy state and parameter, failing ones, code, where it ends
    "collision": ("fall", [9.0, 1.0], None, [1.0, 0.0], None, _native.STEP_TOO_SMALL, np.pi / 8**0.5),
    "NaN": ("fall", [9.0, 1.0], None, [np.nan, 0.0], None, _native.NOT_FINITE, 0.0),
    "infinite": ("pendulum", [1.0, 1.0], None, [0.0, np.inf], None, _native.NOT_FINITE, 0.0),
    "infinite force": ("fall", [9.0, 1.0], None, [0.0, 0.0], None, _native.NOT_FINITE, 0.0),
    "singular": ("mass", [1.0, 0.0], 2.0, [1.0, 0.0], 0.0, _native.SINGULAR, 0.0),
    "bad parameter": ("mass", [1.0, 0.0], 2.0, [1.0, 0.0], np.nan, _native.NOT_FINITE, 0.0),
    "too many steps": ("oscillator", [1.0, 0.0], 1.0, [1.0, 0.0], 1e4, _native.OUT_OF_STEPS, None),
}  # fmt: skip


@pytest.mark.parametrize("failure", FAILURES)
def test_failures_beside_healthy_members(failure):
    scene, good, good_param, bad, bad_param, code, t_end = FAILURES[failure]
    fails = np.isin(np.arange(11), [0, 4, 5, 10])  # the first, the last, and neighbours
    y0 = np.where(fails[:, None], bad, good) * np.linspace(1, 1.2, 11)[:, None] ** (~fails[:, None])
    params = None if good_param is None else np.where(fails, bad_param, good_param)
    clean_params = None if good_param is None else np.full(11, good_param)
    with np.errstate(invalid="ignore"):
        outcome = run(scene, TS, y0, params, rtol=1e-10, max_steps=800)
    clean = run(scene, TS, np.where(fails[:, None], good, y0), clean_params, rtol=1e-10, max_steps=800)
    assert_done(clean)
    np.testing.assert_array_equal(outcome.code, np.where(fails, code, _native.DONE))
    np.testing.assert_array_equal(outcome.path[~fails], clean.path[~fails])
    np.testing.assert_array_equal(outcome.steps[~fails], clean.steps[~fails])
    for i in np.flatnonzero(fails):
        reached = outcome.t_end[i] >= TS
        assert np.isnan(outcome.path[i, ~reached]).all()
        np.testing.assert_array_equal(outcome.path[i, 0], y0[i] if np.isfinite(y0[i]).all() else np.nan)
        if t_end:
            assert np.isfinite(outcome.path[i, reached]).all() and reached.sum() > 1
    if t_end is None:
        assert (outcome.steps + outcome.rejected)[fails].max() <= 801
    else:
        np.testing.assert_allclose(outcome.t_end[fails], t_end, atol=1e-8)


def test_stopping_at_the_last_step_is_no_failure():
    steps = run("pendulum", [0, 10], [[1.0, 0.0]]).steps[0]
    assert run("pendulum", [0, 10], [[1.0, 0.0]], max_steps=int(steps)).code == _native.DONE
    assert run("pendulum", [0, 10], [[1.0, 0.0]], max_steps=int(steps) - 1).code == _native.OUT_OF_STEPS


# ---- pieces and narrow features: what no series shows ---------------------------------------------------------------


def test_a_jump_of_the_force():
    # q̈ = −sign q from rest at a: parabolas, and a full swing takes 4 √(2a).
    a = np.array([0.3, 1.0, 2.5])
    swings = run("wedge", [0, 1], np.zeros((1, 2)))  # resting in the corner
    np.testing.assert_array_equal(swings.y_end, 0)
    for k in (1, 5):
        ts = k * 4 * np.sqrt(2 * a)[:, None] * np.array([0, 0.25, 1])
        outcome = run("wedge", ts, np.stack([a, 0 * a], 1), rtol=1e-10)
        assert_done(outcome)
        # Each of 2k crossings may change the velocity by (p + 1) rtol |v|; then the swings take longer or less long.
        np.testing.assert_allclose(outcome.y_end, np.stack([a, 0 * a], 1), atol=3 * 2 * k**2 * 15 * 1e-10)


def test_walls():
    # A particle between two springs, free in between: it flies for 1/v and turns in π/ω.
    k, v = 1e4, np.array([1.0, 3.0])
    period = 2 * (1 / v + np.pi / np.sqrt(k))
    ts = 3 * period[:, None] * np.array([0, 0.5, 1])
    outcome = run("walls", ts, np.stack([np.full(2, 0.5), v], 1), k, rtol=1e-11)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.y_end, np.stack([np.full(2, 0.5), v], 1), atol=1e-7)
    np.testing.assert_allclose(outcome.path[:, 1], np.stack([np.full(2, 0.5), -v], 1), atol=1e-7)


def test_a_bump_amid_free_flight():
    # From q = 2.6 to 7.4 against the force 0.05. Before and after, the series ends with its second term and allows any
    # step: only the checks along it see the bump (and not one much narrower).
    outcome = run("bump", [0, 10.0], [[0.0, 1.0]], rtol=1e-11)
    assert_done(outcome)
    after = np.sqrt(1 - 2 * 0.05 * 4.8)
    left = 10 - 2.6 - (1 - after) / 0.05
    np.testing.assert_allclose(outcome.y_end[0], [7.4 + left * after, after], atol=1e-8)


def test_a_wrapped_angle():
    # An oscillator in the angle from −π to π: it runs over the top, for the time 2 asin(π/4) each turn.
    turns = np.array([0, 0.5, 3, 7])
    outcome = run("wrapped", 2 * np.arcsin(np.pi / 4) * turns, [[0.0, 4.0]], rtol=1e-11)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], 2 * np.pi * turns, atol=1e-7)
    np.testing.assert_allclose(outcome.path[0, 2:, 1], 4, atol=1e-7)


def by_scipy(name, t_end, y0, border=None):
    """DOP853 to 1e-12, begun anew where q crosses the border."""
    rhs = lambda t, y: [y[1], float(jnp.reshape(SCENES[name][0](y[0], y[1], t), ()))]
    events = None if border is None else [lambda t, y: y[0] - border]
    if events:
        events[0].terminal = True
    t, y = 0.0, np.array(y0)
    while t < t_end:
        done = solve_ivp(rhs, (t, t_end), y, "DOP853", rtol=1e-12, atol=1e-14, events=events, max_step=0.2)
        t, y = done.t[-1], done.y[:, -1]
        if t < t_end:  # a little further, so as not to find the same crossing again
            y, t = y + 1e-9 * np.array(rhs(t, y)), t + 1e-9
    return y


@pytest.mark.parametrize(("name", "y0", "border"), [("brake", [0.0, 1.5], 0.3), ("Hertz", [0.4, -0.5], 0.0)])
def test_pieces_against_scipy(name, y0, border):
    outcome = run(name, [0, 8.0], [y0], rtol=1e-10)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.y_end[0], by_scipy(name, 8.0, y0, border), atol=1e-7)


def test_a_pulse_is_not_stepped_over():
    # q̈ + q = exp(−((t−5)/w)²), w = 0.1: Duhamel's integral, with all of the pulse behind.
    for rtol in (1e-9, 1e-12):
        outcome = run("pulse", [0, 10.0], [[1.0, 0.0]], rtol=rtol)
        assert_done(outcome)
        push = np.sqrt(np.pi) * 0.1 * np.exp(-(0.1**2) / 4)
        expected = [np.cos(10) + push * np.sin(5), -np.sin(10) + push * np.cos(5)]
        np.testing.assert_allclose(outcome.y_end[0], expected, atol=100 * rtol)


# ---- accuracy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum", "Kepler"])
def test_errors_follow_the_tolerance(name):
    y0, params = ([[2.5, 0.3]], None) if name == "pendulum" else ([ellipse(0.6)], 1.0)
    best = run(name, TS, y0, params, rtol=1e-15)
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    errors = {rtol: abs(run(name, TS, y0, params, rtol=rtol).path - best.path).max() for rtol in tolerances}
    assert all(error < 1e3 * rtol for rtol, error in errors.items()), errors
    assert errors[1e-12] < 1e-6 * errors[1e-4]


def test_energy_over_a_thousand_orbits():
    e = np.linspace(0.05, 0.9, 24)
    outcome = run("Kepler", [0, 2000 * np.pi], [ellipse(x) for x in e], 1.0, rtol=1e-15, max_steps=10**7)
    assert_done(outcome)
    # What the sum drops is carried along. Left is what each increment, a fraction of the state, is wrong by: at random,
    # 0.15 ulp a step. Uncarried it would be 0.6.
    drift = (kepler_energy(outcome.y_end) + 0.5) / (EPS * np.sqrt(outcome.steps))
    assert np.sqrt(np.mean(drift**2)) < 0.3 and abs(drift).max() < 1


def test_long_runs_keep_time():
    ts = np.linspace(0, 20_000, 501)
    outcome = run("oscillator", ts, [[1.0, 0.0]], 1.0, rtol=1e-15, max_steps=10**6)
    assert_done(outcome)
    # A step is cut off at its 20th order, about ε/4 each; the steps are equal, and so are their errors.
    np.testing.assert_allclose(outcome.path[0, :, 0], np.cos(ts), atol=0.5 * EPS * outcome.steps[0] + 1e-12)


# ---- units ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [-400, -40, 40, 400])
def test_units_of_length_change_no_digit(power):
    unit, y0 = 2.0**power, np.array([[1.0, 0.3], [0.0, -2.0]])
    plain, scaled = run("oscillator", TS, y0, 1.3), run("oscillator", TS, y0 * unit, 1.3, atol=1e-16 * unit)
    assert_done(scaled)
    np.testing.assert_array_equal(scaled.path, plain.path * unit)


@pytest.mark.parametrize("power", [-40, 40])
def test_units_of_length_of_an_orbit(power):
    unit = 2.0**power  # 1e-12, 1e12
    plain = run("Kepler", TS, [ellipse(0.7)], 1.0)
    scaled = run("Kepler", TS, np.array([ellipse(0.7)]) * unit, unit**3, atol=1e-16 * unit)
    np.testing.assert_array_equal(scaled.path, plain.path * unit)


@pytest.mark.parametrize("w", [1e-15, 1e-12, 1e-6, 1e6, 1e12])
def test_units_of_time(w):
    outcome = run("oscillator", TS / w, [[1.0, 0.0]], w)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], np.cos(TS), atol=1e-11)
    np.testing.assert_allclose(outcome.path[0, :, 1] / w, -np.sin(TS), atol=1e-11)


@pytest.mark.parametrize("atol", [1e-100, 1e-30, 1e-3])
def test_absolute_tolerance(atol):
    outcome = run("pendulum", TS, [[1e-6, 0.0]], rtol=1e-9, atol=atol)
    assert_done(outcome)
    np.testing.assert_allclose(outcome.path[0, :, 0], 1e-6 * np.cos(TS), atol=max(1e-14, 1e2 * atol))


# ---- as the user sees it --------------------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch):
    """How often machine code was called."""
    found, original = [], _native.Kernel.__call__
    monkeypatch.setattr(_native.Kernel, "__call__", lambda self, *args: found.append(0) or original(self, *args))
    return found


def chain(q, qdot, params):
    """A bead on a spring around a turning arm; `n` is an integer."""
    kinetic = 0.5 * (params["m"] @ qdot["x"] ** 2) + 0.5 * (1 + q["x"] @ q["x"]) * qdot["phi"] ** 2
    return kinetic - 0.5 * params["n"] * jnp.sum((q["x"] - 1) ** 2) + params["g"] * jnp.cos(q["phi"])


CHAIN = lagjax.System(chain)
START = {"x": np.array([1.1, 0.8]), "phi": np.array(0.7)}, {"x": np.array([0.0, 0.3]), "phi": np.array(-0.2)}
PARAMS = {"m": np.array([1.0, 2.0]), "n": 3, "g": 9.81}
BY_DIFFRAX = dict(adjoint=diffrax.RecursiveCheckpointAdjoint(), rtol=1e-11, atol=1e-13)


def assert_same(found, expected, tolerance=1e-7):
    # Both with errors of about the tolerance, here 1e-9 and 1e-11, in each of some hundred steps.
    assert np.asarray(found.ok).all() and np.asarray(expected.ok).all()
    for name in ("q", "qdot"):
        mine, theirs = getattr(found, name), getattr(expected, name)
        assert jax.tree.structure(mine) == jax.tree.structure(theirs)
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
            assert a.dtype == b.dtype and isinstance(a, jax.Array)
            np.testing.assert_allclose(a, b, atol=tolerance)


@pytest.mark.slow
def test_simulate_is_diffrax(calls):
    ts = np.linspace(0, 5, 11)
    found = lagjax.simulate(CHAIN, *START, ts, PARAMS)
    assert len(calls) == 1
    assert_same(found, lagjax.simulate(CHAIN, *START, ts, PARAMS, **BY_DIFFRAX))
    assert len(calls) == 1
    np.testing.assert_allclose(found.energy(), found.energy()[0], rtol=1e-8)
    assert set(found.stats) >= {"num_steps", "num_accepted_steps", "num_rejected_steps"}


BATCHES = {
    "states": ((0, 0, None), lambda q, v, p: (stacked(q), stacked(v), p)),
    "a shared q0": ((None, 0, None), lambda q, v, p: (q, stacked(v), p)),
    "parameters": ((None, None, {"m": 1, "n": 0, "g": None}), lambda q, v, p: (q, v, varied(p))),
    "all": (
        ({"x": -1, "phi": 0}, 0, {"m": 1, "n": 0, "g": None}),
        lambda q, v, p: (last(stacked(q)), stacked(v), varied(p)),
    ),
}  # fmt: skip


def stacked(tree):
    return jax.tree.map(lambda x: x * jnp.linspace(0.9, 1.1, 5).reshape(5, *[1] * x.ndim), tree)


def last(q):
    return {**q, "x": q["x"].T}


def varied(p):
    return {"m": jnp.outer(p["m"], jnp.linspace(1, 2, 5)), "n": jnp.arange(2, 7), "g": p["g"]}


@pytest.mark.parametrize("name", sweep(BATCHES, kept=["states", "a shared q0", "parameters"]))
def test_simulate_batch_is_simulate(calls, name):
    axes, spread = BATCHES[name]
    values, ts = spread(*START, PARAMS), np.linspace(0, 3, 7)
    found = lagjax.simulate_batch(CHAIN, *values[:2], ts, values[2], batch_axes=axes)
    assert len(calls) == 1 and found.q["x"].shape == (5, 7, 2) and found.ok.all()
    each = tuple(jax.tree.broadcast(*pair, is_leaf=lambda x: x is None) for pair in zip(axes, values, strict=True))
    for i in (0, 3):
        q, v, p = jax.tree.map(lambda x, axis: x if axis is None else jnp.take(x, i, axis), values, each)  # noqa: B023
        one = lagjax.simulate(CHAIN, q, v, ts, p)
        np.testing.assert_array_equal(one.q["x"], found.q["x"][i])
        np.testing.assert_array_equal(one.qdot["phi"], found.qdot["phi"][i])
    if name == "all":
        assert_same(found, lagjax.simulate_batch(CHAIN, *values[:2], ts, values[2], batch_axes=axes, **BY_DIFFRAX))


def test_kernels_may_come_and_go():
    # Each engine of LLVM owns its target machine: a kernel that is dropped must not take that of others along.
    kept = kernel_of(lambda q, v, t: -q, 1)
    for k in range(3):
        kernel_of(lambda q, v, t, k=k: -(k + 2.0) * q, 1)
    outcome = kept(TS[None], np.ones((1, 2)), np.zeros((1, 0)), 1e-12, 1e-15, 100)
    np.testing.assert_allclose(outcome.path[0, :, 0], np.cos(TS) + np.sin(TS), atol=1e-11)


# ---- one member alone ------------------------------------------------------------------------------------------------


MADE = (
    scenes.cartesian_pendulum, scenes.double_pendulum, scenes.chaplygin_sleigh, scenes.kepler, scenes.chain,
    scenes.andrews_squeezer,
)  # fmt: skip
TWO_TIMES = np.array([0.0, 0.5])


@pytest.mark.parametrize("make", sweep(MADE, kept=MADE[:1]))
def test_a_member_alone_is_bit_for_bit_the_member_of_a_batch(make):
    scene = make()
    y0 = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(z)]) for z in (scene.q0, scene.qdot0)]
    kernel = flow_of(
        Problem.from_arguments(
            scene.system, Layout.from_state(scene.q0, scene.qdot0), scene.q0, scene.qdot0, TWO_TIMES, scene.params
        )
    ).kernel
    numbers = np.concatenate([np.zeros(0), *(np.ravel(x) for x in jax.tree.leaves(scene.params))])[None]
    states, ts = np.tile(np.concatenate(y0), (3, 1)), TWO_TIMES[None]
    runs = [kernel.select_width(len(y))(ts, y, numbers, 1e-9, 1e-12, 1000, 3000) for y in (states[:1], states)]
    alone, together = runs
    for one, all_ in zip(alone[:6], together[:6], strict=True):
        np.testing.assert_array_equal(one[0], all_[1])
    assert kernel.select_width(1).width == 1 and kernel.select_width(2) is kernel
    order, cotangents = _kernel.choose_order(1e-9), (np.ones_like(together.path), np.ones_like(together.y_end))
    back = [
        kernel.select_width(len(run.steps)).vjp(
            ts, numbers, _native.Steps(run.table, run.steps.cumsum() - run.steps, run.steps, order),
            *(c[: len(run.steps)] for c in cotangents),
        )
        for run in runs
    ]  # fmt: skip
    for one, all_ in zip(*back, strict=True):
        np.testing.assert_array_equal(one[0], all_[1])
