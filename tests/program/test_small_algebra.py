"""Lagrangians with small matrices and complex numbers: closed forms, and the same scene written with real numbers."""

import math
import re

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import mpmath
import numpy as np
import pytest
import scipy.linalg
from jax import lax
from scenes import in_potential
from sweeps import sweep

import lagjax
from lagjax._program import OPERATIONS, Unlowerable
from lagjax._tracing import apply_in_jax, lower


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def in_machine_code(system, q, v, params=None):
    return system.explain(q, v, params=params).solver.startswith("Taylor series in machine code")


# ---- matrices -------------------------------------------------------------------------------------------------------


def symmetric(x):
    return x[np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]


def by_inverse(q, v):
    rate = jnp.linalg.inv(symmetric(q)) @ symmetric(v)
    return 0.5 * jnp.trace(rate @ rate)


def by_cholesky(q, v):
    rate = jsl.cho_solve(jsl.cho_factor(symmetric(q)), symmetric(v))
    return 0.5 * jnp.trace(rate @ rate)


Q, V = np.array([1.0, 1.5, 2.0, 0.1, 0.2, 0.3]), np.array([0.3, -0.2, 0.1, 0.4, -0.1, 0.2])
TS = np.array([0.0, 0.5, 1.0])
GEODESICS = lagjax.System(by_inverse)


def geodesic(scale):
    """g(1) = g exp(g⁻¹ ġ) from g = `symmetric(Q)`, with ġ = scale `symmetric(V)`."""
    g, rate = symmetric(Q), scale * symmetric(V)
    return (g @ jsl.expm(jnp.linalg.solve(g, rate)))[jnp.array([0, 1, 2, 0, 0, 1]), jnp.array([0, 1, 2, 1, 2, 2])]


@pytest.mark.parametrize("lagrangian", [pytest.param(way, marks=pytest.mark.slow) for way in (by_inverse, by_cholesky)])
def test_geodesics_of_positive_matrices(lagrangian):
    system = lagjax.System(lagrangian)
    assert in_machine_code(system, Q, V)
    end = lambda scale: lagjax.simulate(system, Q, scale * V, TS, rtol=1e-12).q[-1]
    np.testing.assert_allclose(end(1.0), geodesic(1.0), rtol=1e-11)
    batch = lagjax.simulate_batch(system, np.stack([Q, Q]), np.stack([V, -0.5 * V]), TS, rtol=1e-12)
    np.testing.assert_allclose(batch.q[:, -1], [geodesic(1.0), geodesic(-0.5)], rtol=1e-11)


@pytest.mark.slow
def test_derivatives_of_geodesics():
    end = lambda scale: lagjax.simulate(GEODESICS, Q, scale * V, TS, rtol=1e-12).q[-1]
    slopes = jax.jacfwd(geodesic)
    first, second = jax.jit(lambda scale: (slopes(scale), jax.jacfwd(slopes)(scale)))(1.0)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(1.0), first, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacrev(end))(1.0), first, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(end)))(1.0), second, rtol=1e-7, atol=1e-8)


def matrix_with_vanishing_minors(x):
    """Regular for all x (its determinant is −0.85 − x²); its first entry vanishes at x = 0."""
    return jnp.array([[x, 1.0, 0.0], [1.0, -x, 0.5], [0.3, 0.0, 1.0]])


@pytest.mark.slow
def test_a_motion_through_vanishing_minors():
    # The same potential by an adjugate, written out: no pivot, no border, the same steps.
    b = np.array([1.0, -0.5, 0.3])

    def by_solve(q, v):
        return 0.5 * v**2 - b @ jnp.linalg.solve(matrix_with_vanishing_minors(q), b) - 0.2 * q**2

    def by_adjugate(q, v):
        first, second, third = matrix_with_vanishing_minors(q)
        inverse = jnp.stack([jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)], 1)
        return 0.5 * v**2 - b @ inverse @ b / (first @ jnp.cross(second, third)) - 0.2 * q**2

    ts = np.linspace(0.0, 12.0, 13)
    one, other = (lagjax.simulate(lagjax.System(of), -1.0, 1.5, ts, rtol=1e-12) for of in (by_solve, by_adjugate))
    assert one.q.min() < 0 < one.q.max()
    np.testing.assert_allclose(one.q, other.q, rtol=1e-9, atol=1e-9)
    assert abs(int(one.stats["num_steps"]) - int(other.stats["num_steps"])) <= 3
    assert lagjax.System(by_solve).explain(-1.0, 1.5).borders == ()


@pytest.mark.parametrize("matrix", [
    [[0.0, 1.0], [1.0, 0.0]], [[0.0, 1.0, 2.0], [1.0, 0.0, 3.0], [2.0, 3.0, 0.0]],
    [[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]],
    np.fliplr(np.diag(np.arange(1.0, 9.0))), np.diag([1e-9, 2.0, 3e5, 1.0]), np.eye(5)[[1, 2, 0, 4, 3]] * 3,
])  # fmt: skip
def test_regular_matrices_without_pivots(matrix):
    matrix = np.array(matrix)
    program = lower(jnp.linalg.inv, matrix)
    found = np.reshape(program.evaluate(*matrix.ravel()), matrix.shape)
    np.testing.assert_allclose(found, np.linalg.inv(matrix), rtol=1e-13, atol=1e-15 * np.abs(found).max())
    found = lower(jnp.linalg.slogdet, matrix).evaluate(*matrix.ravel())
    np.testing.assert_allclose(found, np.linalg.slogdet(matrix), rtol=1e-13, atol=1e-14)


def exact_solution(a, b):
    with mpmath.workdps(60):
        return np.array([float(x) for x in mpmath.lu_solve(mpmath.matrix(a.tolist()), mpmath.matrix(b.tolist()))])


@pytest.mark.parametrize("n", [2, 3, 5, 8])
@pytest.mark.parametrize("condition", [1e3, 1e8, 1e13])
def test_digits_lost_are_those_of_the_condition(n, condition):
    # One direction much longer than all others is where Cramer's rule would lose the square of the condition.
    rng = np.random.default_rng(n)
    u, v = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    b, scale = rng.normal(size=n), np.where(np.arange(n) == 0, 1.0, 1 / condition)
    for a in ((u * scale) @ v.T, (u * np.geomspace(1, 1 / condition, n)) @ v.T):
        found = np.array(lower(jnp.linalg.solve, a, b).evaluate(*a.ravel(), *b))
        error = np.abs(found - exact_solution(a, b)).max() / np.abs(found).max()
        assert error < 10 * n * condition * np.finfo(float).eps
        (determinant,) = lower(jnp.linalg.det, a).evaluate(*a.ravel())
        if n != 3:  # which JAX itself expands
            with mpmath.workdps(60):
                exact = float(mpmath.det(mpmath.matrix(a.tolist())))
            assert abs(determinant / exact - 1) < 10 * n * condition * np.finfo(float).eps
    # Units of rows and columns lose nothing: |X| of a well-conditioned matrix is what counts.
    rows, columns = np.geomspace(1.0, condition, n), rng.permutation(np.geomspace(1.0, condition, n))
    a = rng.normal(size=(n, n)) + 3 * np.eye(n)
    found = np.array(lower(jnp.linalg.solve, a, b).evaluate(*(a * rows[:, None] * columns).ravel(), *(b * rows)))
    np.testing.assert_allclose(found * columns, exact_solution(a, b), rtol=1e-12, atol=1e-13)


def test_singular_matrices_are_never_solved_silently():
    for matrix in (np.zeros((3, 3)), np.diag([1.0, 0.0, 2.0]), np.ones((4, 4)), np.outer([1, 2, 3.0], [1, 1, 1.0])):
        found = lower(jnp.linalg.inv, matrix).evaluate(*matrix.ravel())
        assert not np.isfinite(found).all() or np.abs(found).max() > 1e14
    found = lower(jnp.linalg.cholesky, np.eye(3)).evaluate(*np.diag([1.0, -1.0, 2.0]).ravel())
    assert np.isnan(found).any()


def test_a_matrix_falls_into_blocks():
    blocks = lambda x: scipy.linalg.block_diag(*[np.ones((2, 2))] * 3) * x
    x = np.random.default_rng(0).uniform(1.0, 2.0, (6, 6)) + np.eye(6)
    program = lower(lambda x: jnp.linalg.solve(blocks(x), jnp.arange(6.0)), x)
    np.testing.assert_allclose(program.evaluate(*x.ravel()), np.linalg.solve(blocks(x), np.arange(6.0)), rtol=1e-13)
    assert program.operations <= 36  # twelve for each


def large_matrix(q, v):
    mass = jnp.eye(30) + 0.1 * jnp.outer(q, q)
    return 0.5 * v @ v - 0.5 * q @ jnp.linalg.solve(mass, q)


LARGE_MATRIX = lagjax.System(large_matrix)


def test_large_matrices_are_left_to_diffrax():
    facts = LARGE_MATRIX.explain(np.ones(30), np.zeros(30))
    assert "a linear system of 30 rows is larger than the 8" in facts.solver and facts.path == "array"


def test_weights_jump_without_a_border():
    for x in (0.0, 1.0, -3.0, 0.7, 1e-300, 5e300):
        expected = 2.0 ** np.floor(np.log2(abs(x))) if x else 1.0
        assert OPERATIONS["binade"].value(np.float64(x)) == apply_in_jax("binade", x) == expected


# ---- complex numbers ------------------------------------------------------------------------------------------------


def well(q, v):
    z = q[0] + 1j * q[1]
    return 0.5 * v @ v - jnp.abs(z**2 - 1) ** 2


def real_well(q, v):
    x, y = q
    return 0.5 * v @ v - ((x * x - y * y - 1) ** 2 + 4 * x * x * y * y)


WELL = lagjax.System(well)
REAL_WELL = lagjax.System(real_well)


@pytest.mark.parametrize("q, v", [((0.3, 0.4), (0.1, -0.2)), ((1.0, 0.0), (0.3, 0.0))])  # the second in its minimum
def test_a_complex_well_is_the_real_one(q, v):
    ts, system, real = np.linspace(0.0, 5.0, 6), WELL, REAL_WELL
    one, other = (lagjax.simulate(of, np.array(q), np.array(v), ts) for of in (system, real))
    assert in_machine_code(system, np.array(q), np.array(v))
    np.testing.assert_allclose(one.q, other.q, rtol=1e-11, atol=1e-12)
    slopes = [jax.jit(jax.grad(lambda a, of=of: lagjax.simulate(of, a * np.array(q), np.array(v), ts).q[-1, 0]))(1.0)
              for of in (system, real)]  # fmt: skip
    np.testing.assert_allclose(*slopes, rtol=1e-8)


def joukowski(q, v):
    z, speed = q[0] + 1j * q[1], v[0] + 1j * v[1]
    image, rate = z + 1 / z, speed * (1 - 1 / z**2)
    return 0.5 * jnp.abs(rate) ** 2 - 0.5 * (image.real**2 + 4 * image.imag**2)


JOUKOWSKI = lagjax.System(joukowski)


def test_oscillators_behind_a_conformal_map():
    ts, q, v = np.linspace(0.0, 3.0, 7), np.array([1.5, 0.7]), np.array([0.1, -0.2])
    path = lagjax.simulate(JOUKOWSKI, q, v, ts, rtol=1e-12)
    z = path.q[:, 0] + 1j * path.q[:, 1]
    start = complex(q[0], q[1])
    image, rate = start + 1 / start, complex(v[0], v[1]) * (1 - start**-2)
    np.testing.assert_allclose((z + 1 / z).real, image.real * np.cos(ts) + rate.real * np.sin(ts), atol=1e-10)
    np.testing.assert_allclose(
        (z + 1 / z).imag, image.imag * np.cos(2 * ts) + 0.5 * rate.imag * np.sin(2 * ts), atol=1e-10
    )


FUNCTIONS = {
    "exp": mpmath.exp, "log": mpmath.log, "sqrt": mpmath.sqrt, "sin": mpmath.sin, "cos": mpmath.cos, "tan": mpmath.tan,
    "sinh": mpmath.sinh, "cosh": mpmath.cosh, "tanh": mpmath.tanh,
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_complex_functions_have_the_digits_of_real_ones(name):
    def parts(x, y):
        w = getattr(lax, name)(lax.complex(x, y))
        return w.real, w.imag

    program = lower(parts, 0.5, 0.5)
    for z in (0.3 + 0.4j, -1.7 + 0.2j, 2.5 - 3.1j, -0.4 - 0.9j, 1e-9 + 2e-9j, 5 + 30j, -40 + 0.1j):
        with mpmath.workdps(40):
            found, exact = complex(*program.evaluate(z.real, z.imag)), complex(FUNCTIONS[name](mpmath.mpc(z)))
        assert abs(found - exact) <= 1e-14 * max(abs(exact), 1.0 if name == "log" else 0.0), z


# ---- functions that are left to XLA ----------------------------------------------------------------------------------

special = jax.scipy.special
LEFT_TO_XLA = {  # potentials V of one coordinate with V', and what their sentence names
    "log Γ": (special.gammaln, lambda x: float(mpmath.digamma(x)), "`lgamma`"),
    "Bessel functions": (special.i0, lambda x: float(mpmath.besseli(1, x)), "`bessel_i0e`"),
    "eigenvalues": (
        lambda x: jnp.linalg.eigvalsh(jnp.array([[x, 1.0], [1.0, -x]]))[1], lambda x: x / math.hypot(x, 1.0), "`eigh`",
    ),
    "Hermitian eigenvalues": (
        lambda x: jnp.linalg.eigvalsh(jnp.array([[1.0, 1j * x], [-1j * x, 1.0]]))[1], lambda x: 1.0, "`eigh`",
    ),
    "exponential integrals": (
        special.exp1, lambda x: -math.exp(-x) / x, "depends on the values of the inputs",
    ),
    "incomplete Γ functions": (
        lambda x: special.gammainc(2.5, x), lambda x: x**1.5 * math.exp(-x) / math.gamma(2.5), "`igamma`",
    ),
    "complex log1p": (lambda x: jnp.log1p(x + 0j).real, lambda x: 1 / (1 + x), "`log1p` of complex numbers"),
    "Fourier transforms": (
        lambda x: 0.25 * jnp.sum(jnp.abs(jnp.fft.fft(jnp.stack([x, 0.0 * x]))) ** 2), lambda x: x, "`fft`",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LEFT_TO_XLA)
def test_functions_that_xla_has_are_not_lowered(name):
    potential, _, reason = LEFT_TO_XLA[name]
    with pytest.raises(Unlowerable, match=re.escape(reason)):
        lower(potential, 1.5)


@pytest.mark.parametrize("name", sweep(LEFT_TO_XLA, kept=("eigenvalues",)))
def test_functions_that_xla_has_run_on_arrays(name):
    potential, slope, reason = LEFT_TO_XLA[name]
    system = in_potential(potential)
    facts = system.explain(1.5, -0.5)
    assert "diffrax" in facts.solver and reason in facts.solver
    assert float(system.acceleration(1.5, 0.0)) == pytest.approx(-slope(1.5), rel=1e-13)
    path = lagjax.simulate(system, 1.5, 0.0, np.linspace(0.0, 0.5, 3), rtol=1e-10, atol=1e-12)
    energy = 0.5 * path.qdot**2 + jax.vmap(potential)(path.q)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
