"""The linear solves on arrays: right against LAPACK outside of JAX, and without LAPACK inside of it."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import weight
from sweeps import sweep

import lagjax
from lagjax._equations import _linear
from lagjax._interface import Layout


def symmetric(n, eigenvalues, seed=0):
    """A symmetric matrix with these eigenvalues."""
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]
    matrix = basis @ np.diag(np.broadcast_to(eigenvalues, n)) @ basis.T
    return 0.5 * (matrix + matrix.T)


def definite(n, seed=0):
    return symmetric(n, np.geomspace(0.1, 10, n), seed)


def indefinite(n, seed=0):
    return symmetric(n, np.geomspace(0.1, 10, n) * (-1) ** np.arange(n), seed)


@jax.jit
def solved(matrix, b):
    return _linear.factorize(matrix).solve(b)


@jax.jit
def solved_or_singular(matrix, b):
    factorization = _linear.factorize(matrix)
    return factorization.solve(b), factorization.singular


SIZES = [(n, np.float64) for n in (1, 40, 2, 7, 16, 17, 200)] + [(n, np.float32) for n in (1, 17, 200)]


@pytest.mark.parametrize("kind", [definite, indefinite])
@pytest.mark.parametrize(("n", "dtype"), sweep(SIZES, kept=SIZES[:2]))  # one panel and no other; some and a part of one
def test_the_solution_is_that_of_lapack(n, kind, dtype):
    matrix, b = kind(n), np.random.default_rng(n).normal(size=n)
    x = solved(jnp.asarray(matrix, dtype), jnp.asarray(b, dtype))
    exact = np.linalg.solve(matrix, b)
    # cond = 100 at most; sqrt(n) for sums of n round-offs.
    assert x.dtype == dtype
    assert np.abs(x - exact).max() < 100 * 4 * np.sqrt(n) * np.finfo(dtype).eps * np.abs(exact).max()


def test_masses_of_very_different_size_cost_no_accuracy():
    n, scale = 20, np.geomspace(1e-9, 1e9, 20)
    matrix, x = scale[:, None] * definite(n) * scale, 1 / scale
    solution = solved(matrix, matrix @ x)
    assert np.abs(solution / x - 1).max() < 1e-10


def test_pivots_that_are_zero_at_first_are_passed_over():
    for matrix in ([[0.0, 1.0], [1.0, 0.0]], [[0.0, 2.0, 1.0], [2.0, 0.0, 3.0], [1.0, 3.0, 0.0]]):
        matrix, b = np.array(matrix), np.arange(1.0, 1 + len(matrix))
        np.testing.assert_allclose(solved(np.asarray(matrix), np.asarray(b)), np.linalg.solve(matrix, b), rtol=1e-14)


@pytest.mark.parametrize("n", sweep([1, 5, 33], kept=[1, 5]))
def test_a_singular_matrix_gives_nan_and_says_so(n):
    part = np.arange(n) > 0
    for matrix, truth in ((np.zeros((n, n)), True), (definite(n) * part * part[:, None], True), (definite(n), False)):
        x, singular = solved_or_singular(matrix, np.ones(n))
        assert singular == truth and (np.isnan(x) == truth).all()


@pytest.mark.parametrize("n", sweep([5, 33], kept=[5]))
def test_a_nan_stays_a_nan_and_is_not_called_singular(n):
    for place in ((0, 0), (n - 1, 0), (n - 1, n - 1)):
        matrix = definite(n)
        matrix[place] = matrix[place[::-1]] = np.nan
        x, singular = solved_or_singular(matrix, np.ones(n))
        assert not singular and np.isnan(x).all()


@pytest.mark.parametrize("n", sweep([2, 5, 20], kept=[5]))
def test_derivatives_of_the_solution(n):
    """x = A(s)⁻¹ b with A = A₀ + s A₁: x′ = −A⁻¹ A₁ x, x″ = 2 A⁻¹ A₁ A⁻¹ A₁ x, in every order of the modes."""
    start, slope, b = indefinite(n), 0.1 * definite(n, 1), np.linspace(1, 2, n)
    weights = np.linspace(-1, 1, n)
    first = -np.linalg.solve(start, slope @ np.linalg.solve(start, b))
    second = -2 * np.linalg.solve(start, slope @ first)

    def number(s):
        return weights @ solved(start + s * slope, jnp.asarray(b))

    def derivatives(s):
        return jax.jacfwd(number)(s), jax.grad(number)(s), jax.hessian(number)(s), jax.grad(jax.grad(number))(s)

    found = jax.jit(jax.vmap(derivatives))(np.array([0.0, 1e-3]))
    exact = [weights @ first] * 2 + [weights @ second] * 2
    np.testing.assert_allclose([x[0] for x in found], exact, rtol=1e-10)  # cond = 100, squared by the second


# ---- least norm ------------------------------------------------------------------------------------------------------


def gram(rows, metric=None):
    return rows @ (np.eye(rows.shape[1]) if metric is None else metric) @ rows.T


REDUNDANT = {
    "none": np.array([[1.0, 0.0, 2.0], [0.0, 3.0, 1.0]]),
    "one of three": np.array([[1.0, 0.0, 2.0], [0.0, 3.0, 1.0], [1.0, 3.0, 3.0]]),
    "twice the same": np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [-1.0, 0.0, 1.0]]),
    "an empty row": np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]),
    "a large sum": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1e6, 1e6, 0.0], [0.0, 0.0, 1e-3]]),
    "large copies": np.array([[1.0, 1.0, 0.0], [1e6, 1e6, 0.0], [-1e6, -1e6, 0.0]]),
    "more than coordinates": np.random.default_rng(3).normal(size=(12, 4)),
}


@pytest.mark.parametrize("name", sweep(REDUNDANT, kept=["one of three", "large copies"]))
def test_the_shortest_multipliers(name):
    """Of all λ with the same force Gᵀλ the shortest has no part in the kernel of Gᵀ."""
    rows = REDUNDANT[name]
    matrix = gram(rows)
    truth = rows @ np.linspace(1.0, 2.0, rows.shape[1])  # in the range of S: no part in the kernel
    found = np.asarray(jax.jit(_linear.least_norm)(np.asarray(matrix), np.asarray(matrix @ truth)))
    rounding = np.finfo(float).eps * np.abs(matrix) @ np.abs(truth)  # of b alone
    assert (np.abs(found - truth) * np.diag(matrix) <= 100 * rounding).all()


def test_multipliers_of_an_indefinite_mass_matrix():
    """M = diag(1, −1) with one constraint along (1, 2), whose S = G K⁻¹ Gᵀ is negative."""
    matrix, rows = jnp.diag(jnp.array([1.0, -1.0])), jnp.array([[1.0, 2.0]])
    b, c = np.array([0.3, 0.7]), np.array([0.5])
    x, multipliers, singular = jax.jit(_linear.saddle)(matrix, b, rows, c)
    full = np.block([[np.asarray(matrix), -np.asarray(rows).T], [np.asarray(rows), np.zeros((1, 1))]])
    np.testing.assert_allclose(np.append(x, multipliers), np.linalg.solve(full, np.append(b, c)), rtol=1e-13)
    assert not singular


def test_a_nan_in_redundant_constraints_stays_a_nan():
    matrix = gram(REDUNDANT["one of three"])
    matrix[2, 0] = matrix[0, 2] = np.nan
    assert np.isnan(jax.jit(_linear.least_norm)(matrix, np.ones(3))).all()


@pytest.mark.slow
def test_derivatives_of_the_shortest_multipliers():
    """Against NumPy's pseudo-inverse by differences of order four; the rows are redundant on both sides."""
    rows, turn = REDUNDANT["one of three"], np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.5], [0.0, 0.2, 0.0]])

    def matrix(s):
        return rows @ (np.eye(3) + s * turn) @ (np.eye(3) + s * turn).T @ rows.T

    def number(s):
        return jnp.sum(_linear.least_norm(matrix(s), matrix(0.0) @ np.ones(3)) ** 2)

    def exact(s):
        return np.sum((np.linalg.pinv(matrix(s), rcond=1e-10) @ matrix(0.0) @ np.ones(3)) ** 2)

    h = 1e-2
    first = (8 * (exact(h) - exact(-h)) - (exact(2 * h) - exact(-2 * h))) / (12 * h)
    second = (16 * (exact(h) + exact(-h)) - (exact(2 * h) + exact(-2 * h)) - 30 * exact(0)) / (12 * h * h)

    def derivatives(s):
        return jax.jacfwd(number)(s), jax.grad(number)(s), jax.hessian(number)(s), jax.grad(jax.grad(number))(s)

    found = jax.jit(derivatives)(0.0)
    np.testing.assert_allclose(found[:2], first, rtol=1e-5)
    np.testing.assert_allclose(found[2:], second, rtol=1e-4)


# ---- no LAPACK -------------------------------------------------------------------------------------------------------


def redundant(q):
    return jnp.stack([q[0] ** 2 + q[1] ** 2 - 1.0, q[2] - 0.5, q[0] ** 2 + q[1] ** 2 + q[2] - 1.5])


def programs():
    """Name, and a function of a batch of states, for everything that solves on the array path."""
    free = lagjax.System(weight, dissipation=lambda q, v: 0.1 * jnp.sum(v**2), path="array")
    held = lagjax.System(weight, constraints=redundant, path="array")
    q, v, zero = jnp.array([0.6, -0.8, 0.5]), jnp.zeros(3), jnp.zeros(())
    motion = held._motion(Layout.from_state(q, v), None)
    yield "acceleration", free.acceleration
    yield "its second derivatives", lambda q, v: jax.hessian(lambda q: free.acceleration(q, v).sum())(q)
    yield "constrained acceleration", held.acceleration
    yield "multipliers and their gradient", lambda q, v: jax.grad(lambda q: held.multipliers(q, v).sum())(q)
    yield "projection", held.project
    yield "one step of projection", lambda q, v: motion.projected(q, v, zero, None)
    yield "loss of rank", lambda q, v: motion.rank_lost((q, v, zero, None), (v, v, zero, None))


@pytest.mark.parametrize(
    "name, function",
    sweep(list(programs()), kept=lambda case: case[0] in ("acceleration", "multipliers and their gradient")),
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_programs_hold_no_lapack(name, function):
    """jaxlib's LAPACK kernels deadlock side by side in a batch (`_linear`); the text shows whether one is left."""
    states = jax.ShapeDtypeStruct((8, 3), np.float64)
    text = jax.jit(jax.vmap(function)).lower(states, states).as_text()
    assert "custom_call" not in text and "cholesky" not in text and "triangular_solve" not in text


# Each of these hung within a few calls where LAPACK solved: the child says how far it came.
CALLED_AGAIN_AND_AGAIN = """
import sys, jax, jax.numpy as jnp, numpy as np, lagjax
from lagjax import scenes
jax.config.update("jax_enable_x64", True)

def double(q, qdot, params):
    return scenes.double_pendulum().system.lagrangian(q, qdot, t=0.0, params=params)

def rods(q, params):
    return scenes.cartesian_double_pendulum().system.constraints(q, t=0.0, params=params)

def friction(q, qdot):
    return 0.05 * sum(jnp.sum(x**2) for x in jax.tree.leaves(qdot))

def batch(scene, *shape):
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(x + 0.1 * rng.normal(size=(*shape, *np.shape(x)))), scene.q0)

def side_by_side(scene, system, members):
    states = [batch(scene, members) for _ in range(4)]
    one = jax.vmap(lambda q: system.acceleration(q, q, params=scene.params))
    several = jax.jit(lambda states: [one(q) for q in states])
    return lambda: jax.block_until_ready(several(states))

def health():
    scene = scenes.double_pendulum()
    damped = lagjax.System(double, dissipation=friction)
    rest = jax.tree.map(jnp.zeros_like, batch(scene, 26))
    run = lagjax.simulate_batch(damped, batch(scene, 26), rest, jnp.linspace(0, 20, 2667), params=scene.params)
    return lambda: jax.block_until_ready(run.health().energy.value)

def acceleration():
    return side_by_side(scenes.double_pendulum(), lagjax.System(double, path="array"), 65536)

def constrained():
    scene = scenes.cartesian_double_pendulum()
    free = lambda q, qdot, params: scene.system.lagrangian(q, qdot, t=0.0, params=params)
    return side_by_side(scene, lagjax.System(free, constraints=rods, path="array"), 16384)

call = globals()[sys.argv[1]]()
for count in range(10):
    call()
    print(count + 1, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ["health", "acceleration", "constrained"])
def test_large_batches_return_again_and_again(case):
    child = subprocess.run(
        [sys.executable, "-c", CALLED_AGAIN_AND_AGAIN, case], capture_output=True, text=True, timeout=600
    )
    assert child.returncode == 0 and child.stdout.split()[-1] == "10", child.stderr[-2000:]
