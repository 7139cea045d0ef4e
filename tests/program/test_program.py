"""Scalar programs: the same numbers as the function, by fewer operations, in every transformation."""

import itertools
import time

import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
import pytest
from jax import lax
from sweeps import sweep

import lagjax
from lagjax._equations import derivation_of
from lagjax._interface import Layout
from lagjax._program import Unlowerable, pullback
from lagjax._tracing import lower

TOLERANCE = 4e-15


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def scalars(*arrays):
    return [x for array in arrays for x in np.ravel(array)]


def flat(result):
    return np.concatenate([np.ravel(np.asarray(leaf, dtype=float)) for leaf in jax.tree.leaves(result)])


def assert_same(function, *arguments, tolerance=TOLERANCE, in_jax=False):
    """The program agrees with the function; also, if asked, where JAX compiles it: under jit, on lanes, under vmap."""
    program = lower(function, *arguments)
    expected = flat(jax.jit(function)(*arguments))
    xs = scalars(*jax.tree.leaves(arguments))
    size = np.max(np.abs(expected), initial=1.0, where=np.isfinite(expected))
    close = dict(rtol=tolerance, atol=tolerance * size)
    np.testing.assert_allclose(flat(program.evaluate(*map(np.asarray, xs))), expected, **close)
    if not in_jax:
        return program
    np.testing.assert_allclose(flat(jax.jit(program.__call__)(*xs)), expected, **close)
    lanes = [np.stack([x, x, x]) for x in xs]
    for outputs in (jax.jit(program.__call__)(*lanes), jax.jit(jax.vmap(program))(*lanes)):
        assert all(output.shape == (3,) for output in outputs)
        np.testing.assert_allclose(flat([output[1] for output in outputs]), expected, **close)
    return program


A = np.array([0.3, -0.7, 1.4])
B = np.array([0.9, 0.4, -0.2])
P = np.array([0.2, 0.5, 0.8])
M = np.arange(12.0).reshape(3, 4) / 7 - 0.6
SPREAD = np.array([[0.3, 1.2, -0.4, 0.7], [1.1, -0.2, 0.6, -0.9], [-0.5, 0.8, 1.3, 0.2]])
N = jnp.array([5, -3, 2], dtype=jnp.int32)


def both(*values):
    """Real and imaginary parts of everything."""
    leaves = [jnp.asarray(x) for x in jax.tree.leaves(values)]
    return [part(x) for x in leaves for part in ((jnp.real, jnp.imag) if jnp.iscomplexobj(x) else (jnp.asarray,))]


@jax.custom_vjp
def cube(x):
    return x**3


cube.defvjp(lambda x: (x**3, x), lambda x, ct: (3 * x**2 * ct,))

FAMILIES = {
    "arithmetic": (lambda a, b: (a + b, a - b, a * b, a / b, -a, a % b, lax.rem(a, b)), A, B),
    "constants": (
        lambda a: (2 * (3 * a), a / 4, a / 3, 0 * a + 1, a - a, 1 - a, jnp.negative(-a), a * -1, 0.5 * (2 * a) * a), A,
    ),
    "like terms": (lambda a, b: (a + a, 3 * a - a, -a * -b, a - (-b), (-a) / b + a, b - a + (a - b)), A, B),
    "integer powers": (lambda a: (a**2, a**3, a**7, a**-2, a**-1, a**0, jnp.square(a)), A),
    "powers": (lambda p, a: (p**a, p**1.5, p**-2.5, p**0.5, p**2.0, p**0.3, p**N, 2.0**a), P, A),
    "roots": (lambda p, a: (jnp.sqrt(p), lax.rsqrt(p), jnp.cbrt(a)), P, A),
    "exponentials": (lambda a: (jnp.exp(a), jnp.exp2(a), jnp.expm1(a), jax.nn.sigmoid(a), jax.nn.softplus(a)), A),
    "logarithms": (lambda p: (jnp.log(p), jnp.log1p(p), jnp.log(-p)), P),
    "circular": (lambda a: (jnp.sin(a), jnp.cos(a), jnp.tan(a), jnp.sin(-a), jnp.cos(-a)), A),
    "inverse circular": (lambda a, b, p: (jnp.asin(p), jnp.acos(p), jnp.atan(a), jnp.atan2(a, b)), A, B, P),
    "hyperbolic": (lambda a: (jnp.sinh(a), jnp.cosh(a), jnp.tanh(a)), A),
    "inverse hyperbolic": (lambda a, p: (jnp.asinh(a), jnp.acosh(1 + p), jnp.atanh(p)), A, P),
    "error function": (lambda a: (lax.erf(a), lax.erfc(a)), A),
    "pieces": (
        lambda a, b: (abs(a), jnp.sign(a), jnp.maximum(a, b), jnp.minimum(a, 0.1), jnp.clip(a, -0.5, 0.5)), A, B,
    ),
    "rounding": (lambda a: (jnp.floor(a), jnp.ceil(a), jnp.round(2.5 * a), lax.round(a), jnp.trunc(a)), A),
    "comparison": (lambda a, b: (a < b, a <= b, a > b, a >= b, a == b, a != b, jnp.isfinite(a / (b - b))), A, B),
    "logic": (lambda a, b: ((a < 0) & (b > 0), (a < 0) | (b > 0), ~(a < 0), (a < 0) ^ (b > 0)), A, B),
    "where": (lambda a, b: (jnp.where(a > 0, a, b), jnp.where(a > 0, a, a), jnp.where(True, a, b)), A, B),
    "select of many": (lambda n, a: lax.select_n(jnp.abs(n) % 3, a, 2 * a, 3 * a), N, A),
    "integers": (
        lambda n: (n + 1, n * n, n // 2, n % 3, -n, n & 3, n >> 1, n << 3, n.astype(float) / 2, jnp.sum(n), n > 0), N
    ),
    "conversion": (lambda a, n: ((a * 3).astype(jnp.int32), n.astype(bool), (a > 0) * a, (a > 0).astype(int)), A, N),
    "shapes": (lambda m: (m.T, m.reshape(2, 6), m[None], m[:, 0], m[::-1], jnp.tile(m, 2), jnp.rot90(m)), M),
    "pieces of arrays": (lambda m: (m[1:, ::2], m[-1], *jnp.split(m, 2, axis=1), jnp.roll(m, 1), list(m)), M),
    "joining": (
        lambda a, b: (jnp.concatenate([a, b]), jnp.stack([a, b], 1), jnp.pad(a, (2, 1)), jnp.append(a, 1.0)), A, B,
    ),
    "padding": (lambda m: lax.pad(m, 9.0, ((1, -1, 1), (-1, 2, 0))), M),
    "iota": (lambda a: a * jnp.arange(3) + jnp.eye(3)[1] + lax.broadcasted_iota(float, (2, 3), 0), A),
    "products": (lambda m, a: (a @ m, m.T @ m, jnp.outer(a, a), jnp.cross(a, a[::-1]), m.T @ a), M, A),
    "matrices of two kinds": (lambda m, n: (n @ m, (m > 0).T @ m, jnp.einsum("ij,i->j", m > 0, n)), M, N),
    "einsum": (lambda m: (jnp.einsum("ij,ik->ijk", m, m), jnp.einsum("ij,ij->j", m, m), jnp.trace(m @ m.T)), M),
    "diagonals": (lambda m: (jnp.diagonal(m[:, :3]), jnp.diag(m[0]), jnp.fill_diagonal(m, 2.0, inplace=False)), M),
    "reductions": (lambda m: (m.sum(), m.sum(0), m.prod(1), m.max(1), m.min(), (m > 0).any(0), (m > 0).all()), M),
    "cumulations": (lambda m: (m.cumsum(0), jnp.cumprod(m, 1), lax.cummax(m, 1), lax.cummin(m, 0, reverse=True)), M),
    "linear systems": (
        lambda m, a: (
            jnp.linalg.inv(m[:, :3]), jnp.linalg.solve(m[:, 1:], a), jnp.linalg.inv(m[:2, :2]),
            jax.vmap(jnp.linalg.solve)(jnp.stack([m[:, :3], m[:, 1:].T]), jnp.stack([m[:, :2], m[:, 2:]])),
        ),
        SPREAD, A,
    ),
    "Cholesky factors": (
        lambda m, a: (
            jnp.linalg.cholesky(m @ m.T), jsl.cho_solve(jsl.cho_factor(m @ m.T), a),
            jsl.solve_triangular(m[:, :3], a, trans=1), jsl.solve_triangular(m[:, :3], a, lower=True),
        ),
        SPREAD, A,
    ),
    "determinants": (
        lambda m: (
            jnp.linalg.slogdet(m[:, :3]), jnp.linalg.det(m.T @ m + jnp.eye(4)), jnp.linalg.det(m[:, :3]),
            jax.vmap(jnp.linalg.slogdet)(jnp.stack([m[:2, :2], m[1:, 1:3]])),
        ),
        SPREAD,
    ),
    "complex numbers": (
        lambda a, b: both(
            z := a + 1j * b, z * z[::-1], z / (1 + z[::-1]), z**3, z**-2, abs(z) ** 2, z.conj() @ z, jnp.angle(z),
            jnp.outer(z, a) @ z, z.prod(), z.cumsum(), jnp.where(a > 0, z, 1j), z.at[1].add(2j),
            z[::2] == z[:2],
            lax.scan(lambda c, x: (c * x + 1, c), 1j + 0 * a[0], z), lax.cond(a[0] > 0, jnp.conj, jnp.square, z),
        ),
        A, B,
    ),
    "complex functions": (
        lambda a, b: both(
            *(f(a + 1j * b) for f in (
                jnp.exp, jnp.log, jnp.sqrt, jnp.sin, jnp.cos, jnp.tan, jnp.sinh, jnp.cosh, jnp.tanh, lax.rsqrt,
            )),
            (a + 1j * b) ** 2.5, (a + 1j * b) ** (1 - 2j), 2.0 ** (a + 1j * b),
        ),
        A, B,
    ),
    "complex sign": (lambda a, b: both(jnp.sign(a + 1j * b)), A, B),
    "norms": (lambda a: (jnp.linalg.norm(a), jnp.hypot(a[0], a[1]), jnp.logaddexp(a[0], a[1]), jnp.sinc(a)), A),
    "gather": (
        lambda m: (m[jnp.array([0, 2, 0])], m[:, jnp.array([[1, 3]])], m[jnp.triu_indices(3)], m.at[5, 0].get()), M,
    ),
    "gather outside": (lambda a: (a.at[7].get(mode="fill"), a.at[7].get(mode="clip"), a[jnp.array([-1])]), A),
    "batched gather": (
        lambda m: (
            jnp.take_along_axis(m, jnp.array([[0], [3], [1]]), 1), jax.vmap(lambda r, i: r[i])(m, jnp.arange(3)),
        ),
        M,
    ),
    "scatter": (
        lambda m, a: (
            m.at[1].set(0.0), m.at[:, 1].add(a), m.at[jnp.array([0, 0])].add(1.0), m.at[0].multiply(a[0]),
        ),
        M, A,
    ),
    "scatter extremes": (
        lambda a: (a.at[jnp.array([0, 1])].max(0.5), a.at[1].min(-2.0), a.at[9].set(1.0, mode="drop")), A,
    ),
    "dynamic slices": (lambda a: (lax.dynamic_slice(a, (2,), (2,)), lax.dynamic_update_slice(a, a[:2] * 2, (2,))), A),
    "calls": (
        lambda a: (jax.jit(jnp.sin)(a), jax.checkpoint(jnp.sin)(a), cube(a), jax.nn.relu(a), lax.stop_gradient(a)), A,
    ),
    "fori_loop": (lambda a: lax.fori_loop(0, 4, lambda i, x: x * a + i, a), A),
    "while": (lambda a: lax.while_loop(lambda c: c[0] < 5, lambda c: (c[0] + 2, c[1] * a), (0, a))[1], A),
    "scan": (lambda m: lax.scan(lambda c, row: (c + row.sum(), c * row), 1.0, m), M),
    "scan backwards": (lambda m: lax.scan(lambda c, row: (c + row.sum(), c * row), 1.0, m, reverse=True), M),
    "cond": (lambda a: (lax.cond(a[0] > 0, jnp.sin, jnp.cos, a), lax.cond(True, jnp.sin, jnp.cos, a)), A),
    "switch": (
        lambda n, a: (lax.switch(n[2], [jnp.sin, jnp.cos, jnp.exp], a), lax.switch(n[1], [jnp.sin, jnp.exp], a)), N, A,
    ),
    "pytrees": (lambda d: {"x": d["a"] * d["b"][0], "y": d["b"][1]}, {"a": A, "b": (B, 2.0)}),
    "gradients": (
        jax.grad(lambda m: jnp.cumprod(m[0]).sum() + jnp.linalg.norm(m) * jnp.max(m) + m[jnp.array([0, 1]), 1].sum()),
        M,
    ),
    "hessian": (jax.hessian(lambda a: jnp.prod(jnp.sin(a)) + jnp.sum(a) ** 3), A),
}  # fmt: skip
SIGN_OF_A_COMPLEX_NUMBER = lagjax.System(lambda q, v: 0.5 * v**2 + jnp.real(jnp.sign(jnp.exp(0.7 + 1j * q))))


@pytest.mark.parametrize("family", FAMILIES)
def test_same_as_the_function(family):
    function, *arguments = FAMILIES[family]
    assert_same(function, *arguments)


@pytest.mark.slow
def test_all_families_in_jax():
    # On lanes, as one program: XLA takes nearly as long for each of fifty. Their numbers are of order ten.
    functions, arguments = zip(*((function, arguments) for function, *arguments in FAMILIES.values()), strict=True)
    program = lower(lambda *each: [f(*xs) for f, xs in zip(functions, each, strict=True)], *arguments)
    xs = scalars(*jax.tree.leaves(arguments))
    lanes, expected = [np.stack([x, x, x]) for x in xs], flat(program.evaluate(*map(np.asarray, xs)))
    for outputs in (jax.jit(program.__call__)(*lanes), jax.jit(jax.vmap(program))(*lanes)):
        assert all(output.shape == (3,) for output in outputs)
        found = flat([output[1] for output in outputs])
        np.testing.assert_allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE * 10)


@pytest.mark.parametrize(
    "family",
    sweep(
        sorted(FAMILIES.keys() - {"calls", "while", "integers", "complex sign"}),
        kept=("powers",),
    ),
)
def test_derivatives_of_each_family(family):
    """Those of a Lagrangian that consists of its outputs, against forward mode in JAX; `cube` and `while` have none.

    JAX 0.10 has zero for that of the sign of a complex number.
    """
    function, *arguments = FAMILIES[family]
    leaves, structure = jax.tree.flatten(arguments)
    moving = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]

    def lagrangian(q, v):
        put = dict(zip(moving, [x + 0.5 * jnp.sin(u) for x, u in zip(q, v, strict=True)], strict=True))
        outputs = function(*structure.unflatten([put.get(k, leaf) for k, leaf in enumerate(leaves)]))
        return sum(jnp.sum(x * jnp.cos(1.0 + jnp.arange(x.size).reshape(x.shape))) for x in jax.tree.leaves(outputs))

    q = [jnp.asarray(leaves[k]) for k in moving]
    v = [0.1 * jnp.ones_like(x) for x in q]
    derivation = derivation_of(lagjax.System(lagrangian), Layout.from_state(q, v), None)
    values = derivation.evaluate(["momentum", "lagrangian_by_q", "mass_matrix"], [*scalars(*q, *v), 0.0])
    y, unravel = jax.flatten_util.ravel_pytree((q, v))
    flat_lagrangian, n = lambda y: lagrangian(*unravel(y)), y.size // 2
    slopes, bend = jax.jit(lambda y: (jax.jacfwd(flat_lagrangian)(y), jax.jacfwd(jax.jacfwd(flat_lagrangian))(y)))(y)
    for name, expected in (("lagrangian_by_q", slopes[:n]), ("momentum", slopes[n:]), ("mass_matrix", bend[n:, n:])):
        size = 1 + np.max(np.abs(expected), initial=0.0, where=np.isfinite(expected))
        np.testing.assert_allclose(values[name][0], expected, rtol=1e-13, atol=1e-13 * size, err_msg=name)


def test_derivatives_of_the_sign_of_a_complex_number():
    """z/|z| = e^(iθ): for L = v²/2 + Re z/|z| of z = e^(x + iq) the force is −sin q, whatever x is."""
    derivation = derivation_of(SIGN_OF_A_COMPLEX_NUMBER, Layout.from_state(1.0, 0.0), None)
    slope = derivation.evaluate(["lagrangian_by_q"], [np.array(1.0), np.array(0.0), 0.0])["lagrangian_by_q"]
    np.testing.assert_allclose(np.ravel(slope), -np.sin(1.0), rtol=1e-15)


AT_EDGES = {
    "abs": jnp.abs, "sign": jnp.sign, "sqrt": jnp.sqrt, "relu": jax.nn.relu, "clip": lambda x: jnp.clip(x, -1.0, 1.0),
    "clamp": lambda x: lax.clamp(0.0, x, 1.0), "max": lambda x: jnp.maximum(x, 0.0), "floor": jnp.floor,
    "where": lambda x: jnp.where(x > 0, x, x**2), "norm": lambda x: jnp.linalg.norm(jnp.array([x, 0.0])),
    "hypot": lambda x: jnp.hypot(x, 0.0), "x |x|": lambda x: x * jnp.abs(x), "asin": jnp.asin, "atanh": jnp.atanh,
    "log": jnp.log, "reciprocal": lambda x: 1 / x, "sinc": jnp.sinc, "logsumexp": lambda x: jnp.logaddexp(x, 0.0),
    "root of a square": lambda x: jnp.sqrt(x**2), "product": lambda x: jnp.prod(jnp.array([x, x, 0.0])),
    **{f"x**{p}": lambda x, p=p: x**p for p in (-1, 0, 0.5, 1, 1.5, 2, 2.5, 3)},
}  # fmt: skip


@pytest.mark.parametrize("name", sweep(AT_EDGES, kept=("abs", "clamp", "max", "x**1.5", "root of a square")))
def test_derivatives_at_edges_are_those_of_jax(name):
    """Where a function has a kink, or ends, a derivative is a convention: also there both forms have the same."""
    function, points = AT_EDGES[name], np.array([0.0, 1.0, -1.0, 0.5])
    derivation = derivation_of(lagjax.System(lambda q, v: 0.5 * v**2 + function(q)), Layout.from_state(0.0, 0.0), None)
    columns = [points, np.zeros(4), np.zeros(4)]
    derived = derivation.evaluate(["lagrangian_by_q"], columns)["lagrangian_by_q"][:, 0]
    if name in ("root of a square", "norm", "hypot"):  # is |x|, whose direction x / |x| has both sides at zero
        points, derived = points[1:], derived[1:]
    np.testing.assert_allclose(derived, jax.jit(jax.vmap(jax.grad(function)))(points), rtol=1e-15)


@pytest.mark.parametrize("single", [False, True])
def test_a_network_of_softplus_has_no_borders(single):
    """log(eᵃ + eᵇ) is smooth, where JAX writes it with a maximum and a modulus."""
    weights = np.random.default_rng(0).normal(size=(5, 2))

    def potential(q, weights):
        return jax.nn.softplus(weights @ q).sum() + jnp.logaddexp(q[0], 2 * q[1]) - jax.nn.log_sigmoid(q[1])

    system = lagjax.System(lambda q, v, params: 0.5 * v @ v - potential(q, params))
    with jax.enable_x64(not single):
        q = jnp.asarray([0.3, -0.2])
        derivation = derivation_of(system, Layout.from_state(q, q), weights)
        assert derivation.borders.decisions == () and not derivation.has_rules
        assert system.explain(q, q, params=weights).borders == ()
        found = jax.jit(jax.vmap(lambda q: system.acceleration(q, q, params=weights)))(jnp.stack([q, -30 * q]))
        exact = jax.vmap(lambda q: -jax.grad(potential)(q, weights))(jnp.stack([q, -30 * q]))
        np.testing.assert_allclose(found, exact, rtol=1e-5 if single else 1e-13)


# ---- mechanics ------------------------------------------------------------------------------------------------------


def chain(q, v):
    """n-link pendulum, unit masses and lengths, absolute angles."""
    x, y = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
    return 0.5 * (x @ x + y @ y) + 9.81 * jnp.cumsum(jnp.cos(q)).sum()


def chain_in_loop(q, v):
    def link(carry, angle_and_speed):
        (angle, speed), (x, y, height) = angle_and_speed, carry
        carry = (x + jnp.cos(angle) * speed, y + jnp.sin(angle) * speed, height - jnp.cos(angle))
        return carry, 0.5 * (carry[0] ** 2 + carry[1] ** 2) - 9.81 * carry[2]

    return lax.scan(link, (0.0, 0.0, 0.0), (q, v))[1].sum()


def relative_double(q, v):
    """Double pendulum with a relative second angle and unequal masses."""
    angle, speed = q[0] + q[1], v[0] + v[1]
    x = jnp.cos(q[0]) * v[0] * 1.2 + jnp.array([0.0, 0.7]) * jnp.cos(angle) * speed
    y = jnp.sin(q[0]) * v[0] * 1.2 + jnp.array([0.0, 0.7]) * jnp.sin(angle) * speed
    heights = -1.2 * jnp.cos(q[0]) - jnp.array([0.0, 0.7]) * jnp.cos(angle)
    masses = jnp.array([1.3, 0.4])
    return jnp.sum(masses * (0.5 * (x**2 + y**2) - 9.81 * heights))


def kepler(q, v):
    return 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2) + 1.0 / q[0]


def kepler_cartesian(q, v):
    return 0.5 * v @ v + 1.0 / jnp.linalg.norm(q)


def spherical(q, v):
    return 0.5 * (v[0] ** 2 + (jnp.sin(q[0]) * v[1]) ** 2) + 9.81 * jnp.cos(q[0])


def wedge(q, v):
    """A block (mass 1) slides on a wedge (mass 3) of slope 0.5: the mass matrix is constant."""
    x, y = v[0] + v[1] * np.cos(0.5), -v[1] * np.sin(0.5)
    return 0.5 * (3 * v[0] ** 2 + x**2 + y**2) + 9.81 * q[1] * np.sin(0.5)


def stop_spring(q, v):
    stretch = jnp.where(q > 0.2, q - 0.2, 0.0)
    work = lax.fori_loop(0, 3, lambda i, total: total + stretch[i] ** 2 * (i + 1.0), 0.0)
    return 0.5 * jnp.sum(v**2 * (1 + q**2)) - work


def solve(matrix, right):
    """Gauss-Jordan for a symmetric positive matrix, written out; `right` is a vector."""
    rows = [list(row) + [b] for row, b in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k], strict=True)]
    for k in reversed(range(len(rows))):
        known = sum(rows[k][j] * rows[j][-1] for j in range(k + 1, len(rows)))
        rows[k][-1] = (rows[k][-1] - known) / rows[k][k]
    return jnp.stack([row[-1] for row in rows])


def acceleration(lagrangian):
    def qddot(q, v):
        momentum = jax.grad(lagrangian, 1)
        mass = jax.jacfwd(momentum, 1)(q, v)
        drift = jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
        return solve(mass, jax.grad(lagrangian)(q, v) - drift)

    return qddot


def state(n):
    return np.linspace(0.3, 0.9, n), np.linspace(-0.5, 0.4, n)


SCENES = {  # lagrangian, coordinates, most operations an acceleration may take
    "pendulum": (chain, 1, 2),
    "double pendulum": (chain, 2, 45),
    "relative angles": (relative_double, 2, 114),
    "chain of 4": (chain, 4, 170),
    "chain of 4, scan": (chain_in_loop, 4, 170),
    "Kepler": (kepler, 2, 9),
    "Kepler, Cartesian": (kepler_cartesian, 3, 16),
    "spherical pendulum": (spherical, 2, 13),
    "wedge": (wedge, 2, 0),
    "stops": (stop_spring, 3, 46),
}


@pytest.mark.parametrize("in_jax", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["", "in JAX"])
@pytest.mark.parametrize("scene", SCENES)
def test_accelerations(scene, in_jax):
    lagrangian, n, most = SCENES[scene]
    program = assert_same(acceleration(lagrangian), *state(n), tolerance=2e-13, in_jax=in_jax)
    assert program.operations <= most
    assert program.operations <= program.traced_operations


def test_chain_of_8_is_lean():
    program = lower(acceleration(chain), *state(8))
    assert program.operations <= 770 < 2000 < program.traced_operations


def test_squares_and_common_factors():
    def operations(function):
        assert_same(function, 0.3, 0.4, 0.5, 0.6)
        return lower(function, *[0.1] * 4).operations

    assert operations(lambda x, y, a, b: (x * (x * (x * y)), x * (x * a))) == 4  # x², x y, x² x y, x² a
    assert operations(lambda x, y, a, b: a * x + b * x) == 2
    assert operations(lambda x, y, a, b: a * x - x * b + y * x) == 3
    assert operations(lambda x, y, a, b: (a * x + b * x, a * x, b * x)) == 3  # nothing is added
    assert operations(lambda x, y, a, b: a * jnp.cos(x) ** 2 + b * jnp.cos(x) ** 2 + (a + b) * jnp.sin(x) ** 2) == 1
    assert operations(lambda x, y, a, b: (a * x + b * x) / (y * x)) == 4  # not cancelled: x may be zero


def test_long_products_and_sums():
    def long(x, a):
        return jnp.prod(a) * x, x * jnp.sum(a * x), jnp.prod(a * a * x)

    many = np.linspace(0.9, 1.1, 3000)
    found = lower(long, 0.999, many).evaluate(0.999, *many)
    np.testing.assert_allclose(found, long(0.999, many), rtol=1e-11)


def test_masses_as_parameters_do_not_move_the_diagonal_of_a_chain():
    def lagrangian(q, v, m):
        vx, vy = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
        return 0.5 * jnp.sum(m * (vx**2 + vy**2)) + jnp.sum(m * jnp.cumsum(jnp.cos(q)))

    mass = lower(jax.hessian(lagrangian, 1), *state(3), np.ones(3))
    assert all(mass.depends(4 * i) <= {6, 7, 8} for i in range(3)) and mass.depends(1) >= {0, 1}


def test_writing_it_differently_makes_the_same_program():
    masses = [lower(jax.hessian(L, 1), *state(4)).operations for L in (chain, chain_in_loop)]
    assert masses[0] == masses[1]


# ---- facts read off -------------------------------------------------------------------------------------------------


def test_constants_are_found():
    mass = lower(jax.hessian(wedge, 1), *state(2))
    assert mass.operations == 0
    np.testing.assert_allclose([mass.constant(i) for i in range(4)], [4, np.cos(0.5), np.cos(0.5), 1], rtol=1e-15)
    assert all(mass.depends(i) == frozenset() for i in range(4))
    assert lower(jax.hessian(chain, 1), *state(2)).constant(1) is None


def test_cyclic_coordinates_are_the_inputs_nothing_depends_on():
    program = lower(spherical, *state(2))
    assert program.depends(0) == {0, 2, 3}
    forces = lower(jax.grad(spherical), *state(2))
    assert forces.constant(1) == 0 and forces.depends(0) == {0, 3}


def test_dead_and_repeated_work_is_dropped():
    def wasteful(x):
        jnp.linalg.inv(jnp.eye(3) * x)
        return jnp.sin(x) * jnp.cos(x) + jnp.cos(x) * jnp.sin(x)

    program = lower(wasteful, 0.3)
    assert program.operations == 4  # sin, cos, their product, twice it


def test_a_program_inside_a_lowered_function_dissolves():
    inner = lower(lambda x, y: (jnp.sin(x) * y, jnp.cos(x)), 0.3, 0.4)

    def outer(x, y):
        sine, cosine = inner(x, y)
        return sine**2 + (cosine * y) ** 2

    assert_same(outer, 0.3, 0.4)
    assert lower(outer, 0.3, 0.4).operations == 1  # y**2
    jax.block_until_ready(jax.jit(outer)(0.3, 0.4))  # a cached trace must not bring the polynomials back
    assert lower(jax.jit(outer), 0.3, 0.4).operations == 1
    assert lower(jax.grad(outer), 0.3, 0.4).operations <= 11


def name_like(name, function):
    """A function that is jitted under a name of NumPy's."""
    function.__name__ = name
    return jax.jit(function)


OWN = {  # functions of a user's own that have a name of NumPy's, and agree with NumPy's at most numbers, not at all
    "trunc": (lambda x: jnp.clip(jnp.trunc(x), -8.0, 8.0), 20.3),
    "remainder": (lambda x, y: jnp.where(y == 0, x, x - y * jnp.floor(x / jnp.where(y == 0, 1.0, y))), 2.3, 0.0),
    "floor_divide": (lambda x, y: jnp.floor(x / jnp.where(jnp.abs(y) < 1e-4, jnp.inf, y)), 3.3, 1e-5),
    "divmod": (lambda x, y: (jnp.where(x > 50.0, 0.0, jnp.floor(x / y)), x - y * jnp.floor(x / y)), 70.0, 3.0),
    "signbit": (lambda x: jnp.sin(x) < 0.0, 4.0),
    "hypot": (lambda x, y: jnp.sqrt(x**2 + y**2 + 1.0), 3.0, 4.0),
    "searchsorted": (lambda knots, x: jnp.clip(jnp.ceil(x).astype(int), 0, 3), jnp.array([0.0, 0.1, 2.0]), 1.5),
}


@pytest.mark.parametrize("name", OWN)
def test_functions_of_a_user_s_own_with_a_name_of_numpy_s_are_what_they_are(name):
    function, *arguments = OWN[name]
    assert_same(name_like(name, function), *arguments)
    assert_same(
        jax.vmap(name_like(name, function), (None, 0) if name == "searchsorted" else 0),
        *(
            np.stack([x, x]) if k == len(arguments) - 1 or name != "searchsorted" else x
            for k, x in enumerate(arguments)
        ),
    )


@pytest.mark.parametrize(
    "function, arguments, most",
    [
        (lambda x: (x % 2, divmod(x, 2), x // 2, jnp.mod(x, 2.0)), (2.3,), 4),  # x/2, its whole part, twice it, a rest
        (jax.vmap(lambda x: (x % 2, jnp.trunc(x), jnp.divmod(x, 2))), (A,), 15),
        (jax.vmap(lambda x, y: x % y, (None, 0)), (jnp.array(0.3), B), 12),
        (lambda x: jnp.hypot(x, 1.0), (0.4,), 3),
        (jax.vmap(jnp.hypot), (A, B), 21),
        (lambda k, x: [jnp.searchsorted(k, x, "right", method=m) for m in ("scan", "compare_all")], (A, 0.4), 3),
        (jax.vmap(lambda x: jnp.searchsorted(jnp.arange(4.0), x)), (A,), 15),
        (lambda x: 1.0 * jnp.signbit(jnp.float32(x)), (0.4,), 3),
    ],
)  # fmt: skip
def test_functions_of_jax_have_few_borders(function, arguments, most):
    """Each is a formula with one border, however it is written; JAX's own have up to five."""
    assert lower(function, *arguments).operations <= most


def test_an_index_by_a_loop_takes_no_longer_than_the_loop():
    """Halving in twenty steps, each of which uses the one before three times."""

    def index(x):
        middle = lambda of: (of[0] + of[1]) // 2
        halve = lambda k, of: lax.cond(x < middle(of), lambda: (of[0], middle(of)), lambda: (middle(of), of[1]))
        return jnp.arange(1000.0)[lax.fori_loop(0, 20, halve, (0, 1000))[0]]

    assert_same(index, 314.5)


def test_identity():
    program, again = (lower(jnp.sin, 0.3) for _ in range(2))
    assert program != again and len({program, again, program}) == 2
    with pytest.raises(AttributeError):
        program.line = None


# ---- refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "function, argument, words",
    [
        (lambda a: jnp.linalg.svd(jnp.outer(a, a))[1], A, "`svd`"),
        (lambda a: jnp.linalg.cholesky(jnp.diag(jnp.tile(a, 3))), A, "9 rows is larger than the 8"),
        (lambda a: jsl.lu_factor(jnp.outer(a, a))[0], A, "`jnp.linalg.solve`"),
        (lambda a: jnp.linalg.solve(1j * jnp.eye(3), a + 0j).real, A, "`custom_linear_solve` of complex numbers"),
        (lambda a: lax.while_loop(lambda x: x.sum() < 9, lambda x: 2 * x, a), A, "`while` loop"),
        (lambda a: jnp.cumprod(jnp.tile(a, 300)[:300])[jnp.floor(a[0]).astype(int)], A, "pass the array in params"),
        (lambda a: jnp.cumprod(jnp.tile(a, 300)[:300])[jnp.floor(a[0]).astype(int)], A, "pass the array in params"),
        (lambda a: a + 1j, A, "complex number"),
        (lambda a: lax.while_loop(lambda c: c[0] >= 0, lambda c: (c[0] + 0, c[1] * 2), (0, a))[1], A, "budget"),
    ],
)
def test_refusals_say_why(function, argument, words):
    with pytest.raises(Unlowerable, match=words):
        lower(function, argument, budget=500)


@pytest.mark.parametrize(
    "function, shape",
    [
        (lambda x: x @ x, (1000, 1000)),
        (lambda x: jnp.sum(jnp.outer(x, x)), (10_000,)),
        (lambda x: lax.fori_loop(0, 10**9, lambda i, y: jnp.sin(y), x), ()),
        (lambda x: jnp.zeros(10**8) + x, ()),
    ],
)
def test_too_large_is_refused_at_once(function, shape):
    start = time.perf_counter()
    with pytest.raises(Unlowerable, match="budget"):
        lower(function, jax.ShapeDtypeStruct(shape, float), budget=2000)
    assert time.perf_counter() - start < 3


def test_the_budget_counts_what_is_kept():
    many = lambda x: jnp.sum(jnp.sin(x * jnp.arange(100.0)))
    assert lower(many, 0.3, budget=300).operations < 300
    with pytest.raises(Unlowerable, match="the 200 scalar operations"):
        lower(many, 0.3, budget=200)


def test_closing_over_a_traced_value_is_refused():
    with pytest.raises(Unlowerable, match="pass it as an argument"):
        jax.jit(lambda x: lower(lambda y: x * y, 0.3)(0.3))(0.3)


# ---- derivatives ----------------------------------------------------------------------------------------------------


@jax.custom_jvp
def safe_norm(x):
    return jnp.sqrt(jnp.sum(x**2))


@safe_norm.defjvp
def _(primals, tangents):
    (x,), (dx,) = primals, tangents
    norm = safe_norm(x)
    return norm, jnp.where(norm > 0, x @ dx / jnp.where(norm > 0, norm, 1.0), 0.0)


def surface(x):
    return jnp.sin(x[0]) * jnp.exp(x[1] * x[2]) / (1 + x[0] ** 2) + jnp.where(x[1] > 0, x[2] ** 3, jnp.tanh(x[2]))


def packed(program):
    return lambda x: program(*x)[0]


TRANSFORMS = {
    "grad": jax.grad,
    "jacfwd": jax.jacfwd,
    "jacrev": jax.jacrev,
    "grad of grad": lambda f: jax.grad(lambda x: jax.grad(f)(x) @ B),
    "hessian": lambda f: jax.jit(jax.hessian(f)),
    "jacfwd of jacfwd": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "vmap of grad": lambda f: lambda x: jax.vmap(jax.grad(f))(jnp.stack([x, 2 * x])),
    "grad of vmap": lambda f: lambda x: jax.grad(lambda y: jnp.sum(jax.vmap(f)(y) ** 2))(jnp.stack([x, -x])),
    "checkpoint": lambda f: jax.grad(jax.checkpoint(lambda x: lax.fori_loop(0, 3, lambda i, s: s * f(x * s), 0.9))),
}


@pytest.mark.parametrize("function", sweep([surface, lambda x: safe_norm(x) * jnp.cos(x[0])], kept=[surface]))
@pytest.mark.parametrize("transform", sweep(TRANSFORMS, kept=["grad", "jacfwd", "hessian", "grad of vmap"]))
def test_derivatives(function, transform):
    program = lower(function, A)
    of = TRANSFORMS[transform]
    found, right = jax.jit(lambda x: (of(packed(program))(x), of(function)(x)))(A)
    np.testing.assert_allclose(found, right, rtol=1e-13, atol=1e-14)


def test_derivatives_of_some_inputs_and_mixed_outputs():
    function = lambda n, a: (n + 1, a**3 * n, a > 0, jnp.float64(2.0))
    program = lower(function, 2, 0.3)
    value, slope = jax.jvp(lambda a: program(2, a), (0.5,), (1.0,))
    assert value == (3, 0.25, True, 2.0)
    assert slope[1] == pytest.approx(1.5) and slope[3] == 0


def test_derivatives_on_lanes():
    program = lower(surface, A)
    lanes = [np.linspace(0.1, 1.0, 4) * a for a in A]
    slopes = jax.jit(jax.grad(lambda xs: jnp.sum(program(*xs)[0])))(lanes)
    right = jax.jit(jax.vmap(jax.grad(surface)))(np.stack(lanes, 1))
    np.testing.assert_allclose(np.stack(slopes, 1), right, rtol=1e-13)


# ---- precision ------------------------------------------------------------------------------------------------------


def test_precision_is_that_of_the_inputs():
    program = lower(lambda x, n: (jnp.sin(x) * 0.1 + x**1.5, x * n, n * 2, 2.0), 0.3, jnp.int32(2))
    for dtype in (jnp.float32, jnp.float64):
        x = jnp.asarray(0.3, dtype)
        assert [y.dtype for y in program(x, 2)] == [dtype, dtype, jnp.int32, dtype]
        assert jax.grad(lambda x: program(x, 2)[0])(x).dtype == dtype
        np.testing.assert_allclose(program(x, 2)[0], np.sin(0.3) * 0.1 + 0.3**1.5, rtol=3 * jnp.finfo(dtype).eps)


def test_lanes_broadcast():
    program = lower(lambda x, y: (x * y, x + 1, 3.0), 0.3, 0.4)
    outputs = program(np.ones((2, 1)), np.ones(3))
    assert [output.shape for output in outputs] == [(2, 3)] * 3


# ---- derivatives in NumPy --------------------------------------------------------------------------------------------


def test_derivatives_in_numpy_are_those_of_the_transposed_program(monkeypatch):
    # Pairs of bodies, of which some are beyond a border where the branch not taken has no derivative.
    i, j = np.triu_indices(20, 1)

    def forces(x, k):
        d = x[i] - x[j]
        near = jnp.where(d > 0, jnp.sqrt(jnp.where(d > 0, d, 1.0)), jnp.abs(d) ** 3) * (k + i % 3)
        far = jnp.exp(-jnp.abs(d)) / (1 + d**2)
        sums = [jnp.zeros(20).at[i].add(near), jnp.zeros(20).at[j].add(far)]
        return [sums[0][0], sums[1][-1], *(a @ sums[0] for a in jnp.eye(20)[:10]), jnp.floor(3 * x[1]), x[0]]

    x = np.random.default_rng(0).normal(size=(20, 7))
    program = lower(forces, x[:, 0], jnp.asarray(2))
    columns = [*x, np.asarray(2)]
    transposed = pullback(program.line, program.dtypes, range(20), range(14))
    one, many = [*x[:, 0], np.asarray(2)], [x[k] for k in range(14)]
    cases = [(columns, [1.0, -2.0] * 7), (columns, [None, x[0], *[None] * 12]), (one, many)]
    for kept, (at, cotangents) in itertools.product([2**24, 3_000], cases):  # all states together; a few at a time
        monkeypatch.setattr("lagjax._program._line._MOST_KEPT", kept)
        bars = [np.zeros(7) if x is None else np.broadcast_to(x, 7) for x in cotangents]
        *found, of_integer = program.line.vjp(at, cotangents)
        assert of_integer is None
        for part, other in zip(found, transposed.evaluate([*at, *bars]), strict=True):
            np.testing.assert_allclose(0.0 if part is None else part, other, rtol=1e-11, atol=1e-12)
