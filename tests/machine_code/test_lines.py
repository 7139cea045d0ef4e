"""Straight lines that NumPy evaluates, as functions of JAX: values and derivatives are those of the function itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

from lagjax._engine.taylor import Line
from lagjax._native import LineCode
from lagjax._tracing import lower


def function(x):
    """Quotients, a root and a power whose slopes are steep, and a border."""
    a, b, c, d = x
    return jnp.stack([a * jnp.sin(b) / (1.0 + c**2), jnp.sqrt(a + b * d) + jnp.abs(c - 2.0) * d, jnp.exp(-a * c) * d])


PROGRAM = lower(function, np.ones(4))
LINE = Line(PROGRAM.line, 4, 4)
X, D = np.array([0.7, 1.1, 0.4, 0.9]), np.array([0.3, -0.5, 0.2, 0.8])

MODES = {
    "value": lambda f: f(X),
    "jvp": lambda f: jax.jvp(f, (X,), (D,))[1],
    "jacrev": lambda f: jax.jacrev(f)(X),
    "jacfwd": lambda f: jax.jacfwd(f)(X),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f))(X),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f))(X),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f))(X),
    "third": lambda f: jax.jacfwd(jax.jacrev(jax.jacfwd(f)))(X),
    "vmap of grad": lambda f: jax.vmap(jax.grad(lambda x: f(x)[1]))(np.stack([X, 1.1 * X])),
    "grad of vmap": lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(x)))(np.stack([X, 1.1 * X])),
    "shared in vmap": lambda f: jax.vmap(lambda d: jax.jvp(f, (X,), (d,))[1])(np.stack([D, 2.0 * D])),
    "jit of hessian": lambda f: jax.jit(jax.hessian(lambda x: f(x)[0]))(X),
    "jit of vmap": lambda f: jax.jit(jax.vmap(f))(np.stack([X, 1.1 * X])),
}


@pytest.mark.parametrize("mode", sweep(MODES, kept=("value", "jvp", "jit of hessian")))
def test_derivatives_in_every_mode(mode):
    # Both are exact but for the rounding of some ten operations on numbers of order one.
    right = jax.jit(lambda: MODES[mode](function))()
    np.testing.assert_allclose(MODES[mode](LINE), right, rtol=1e-13, atol=1e-13)


def test_a_root_bends_where_its_argument_stands_still():
    """Of h = |x| and a product with it, along what leaves h as it is, or where a factor is zero: slopes of 0 times."""

    def root(x):
        h = jnp.sqrt(x[0] ** 2 + x[1] ** 2)
        return jnp.stack([h, x[2] * h, jnp.maximum(x[2], -h), jnp.arctan2(x[1], x[0])])

    x, across = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    line = Line(lower(root, np.ones(3)).line, 3, 3)
    for derivative in (
        lambda f: jax.jvp(lambda x: jax.jvp(f, (x,), (across,))[1], (x,), (across,))[1],
        lambda f: jax.jacfwd(jax.jacfwd(f))(x),
        lambda f: jax.jacfwd(jax.jacrev(f))(x),
        lambda f: jax.jacrev(jax.jacfwd(f))(x),
        lambda f: jax.jacrev(jax.jacrev(f))(x),
    ):
        found, right = jax.jit(lambda derivative=derivative: (derivative(line), derivative(root)))()
        np.testing.assert_allclose(found, right, atol=1e-14)


def test_a_long_line_is_what_its_operations_are():
    """Beyond the border machine code walks along rows; NumPy evaluates the same operations."""

    def steps(x):
        y, whole = x, jnp.arange(20)
        for k in range(5):
            turned, up = jnp.sin(0.3 * y) * jnp.roll(y, 1), y > 0.1 * k
            whole = jnp.where(up, whole + k, whole // 2) ^ 3
            y = 0.3 * (turned + jnp.where(up & (y < 2.0), jnp.exp(-y), jnp.sqrt(abs(y)))) + 0.2 * jnp.cos(y) ** 3
        return jnp.concatenate([y, jnp.zeros(3), y > 0.2, jnp.array([2.5]), x[:2], whole + 0.0])

    program, rows = lower(steps, np.zeros(20)), np.random.default_rng(0).normal(size=(21, 20))
    expected = program.line.evaluate(list(rows.T)).T
    assert len(program.line.nodes) > 1700
    for made in ({}, {"lanes": 8}, {"largest": 20_000}, {"largest": 20_000, "lanes": 8}):
        code = LineCode(program.line, 20, **made)
        for count in (1, 8, 21):
            np.testing.assert_allclose(code(rows[:count]), expected[:count], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("mode", ["jvp", "jacrev", "jacfwd", "forward over reverse", "vmap of grad", "grad of vmap"])
def test_of_parts_that_stand_still_there_are_no_derivatives(mode):
    """Where the last ones do not vary, the lines of derivatives know nothing of them."""
    still = X[2:]

    def by_part(call):
        return lambda x: call(x[:2], jnp.broadcast_to(still, (*x.shape[:-1], 2)))

    of_line = lambda x: jnp.pad(by_part(LINE)(x), (0, 0))
    of_function = by_part(lambda x, rest: function(jnp.concatenate([x, rest])))
    found, right = jax.jit(lambda: (MODES[mode](of_line), MODES[mode](of_function)))()
    np.testing.assert_allclose(found, right, rtol=1e-13, atol=1e-13)


def test_running_errors_of_a_walk_are_those_of_a_program_of_their_own():
    """Terms that cancel, ties, and what is exact beside an infinite slope; the last input is not rounded."""

    def function(x):
        u, v, w = x[0], x[1], x[2]
        pieces = jnp.where(u > v, jnp.sqrt(v), -u) + jnp.where(v == 0.25, jnp.abs(w), w / v) + jnp.where(w <= v, u, 2.0)
        finite = jnp.where(jnp.isfinite(1.0 / (v - 0.25)), 3.0 * u, 0.5)
        more = jnp.where(w >= 1.0, u * v, w) + jnp.where(w < -3.0, 1.0, u)
        return jnp.stack([pieces, finite, jnp.sin(u) * jnp.cos(w) - u, (u + 1e6) - 1e6, more, jnp.exp(w) * u])

    program = lower(function, np.zeros(3), moving=2)
    errors, walk = program.rounding_of(range(6), 2), LineCode(program.line, 3, moving=2)
    rows = np.array([[0.7, 0.25, -1.2], [0.25, 0.25, 0.25], [-2.0, 3.0, 0.0]])
    np.testing.assert_allclose(walk(rows), errors.line.evaluate(list(rows.T)).T, rtol=1e-14)


def test_long_runs_of_one_output_are_written_by_a_loop():
    """As rows of contacts have: zeros beside a few numbers, and a number that is repeated."""

    def rows(x):
        repeated = jnp.broadcast_to(x[0] * x[1], (50,))
        return jnp.concatenate([jnp.zeros(100), x[:1] > 0.5, jnp.zeros(40), repeated, x[1:], jnp.zeros(3)])

    program = lower(rows, np.ones(3))
    code = Line(program.line, 3, 3).code
    assert code is not None
    inputs = np.array([[0.3, 1.1, 0.4], [0.7, -2.0, 3.0]])
    np.testing.assert_array_equal(code(inputs), [rows(x) for x in inputs])


def test_rows_of_many_numbers_stay_off_the_stack_of_a_thread():
    program = lower(lambda x, more: x * jnp.sin(x[0]) + more[7], jnp.ones(3), jnp.ones(100_000))
    line = Line(program.line, program.size, 3)
    rows = np.concatenate([np.random.default_rng(0).normal(size=(9, 3)), np.ones((9, 100_000))], axis=1)
    found = jax.jit(lambda x: line(x))(rows)
    np.testing.assert_allclose(found, rows[:, :3] * np.sin(rows[:, :1]) + 1.0, rtol=1e-14)


def test_what_rows_share_is_computed_once_with_the_same_digits():
    """Inputs, floats and decisions of shared numbers alone, beside those of rows, in lanes and without."""

    def function(x):
        still, moving = x[:4], x[4:]
        common, side = jnp.sin(still[0]) * jnp.exp(still[1]), still[2] > still[3]
        rows = jnp.where(side, common * moving[0], moving[1] / (2.0 + common)) + jnp.cos(moving[2]) * still[3]
        return jnp.stack([rows, still[2], common, jnp.where(still[0] > 0.5, 1.0, moving[0]), moving[1] * still[0], 0.0])

    program, rng = lower(function, np.zeros(7)), np.random.default_rng(3)
    rows, given = rng.uniform(0.1, 1.0, (21, 3)), rng.uniform(0.1, 1.0, 4)
    for shared in ((0, 1, 2, 3), (0, 2)):
        all_of = np.concatenate([np.broadcast_to(given, (21, 4)), rows], axis=1)
        own = [i for i in range(7) if i not in shared]
        for lanes in (1, 8):
            code = LineCode(program.line, 7, lanes=lanes, shared=shared)
            found = code(all_of[:, own], all_of[0, list(shared)])
            np.testing.assert_array_equal(found, LineCode(program.line, 7)(all_of))


@pytest.mark.slow
def test_axes_of_rows_broadcast():
    """Parts that rows share, in every order of batches; forward, reverse, and once more."""
    parts = X[:2], X[2:]

    def call(x, rest):
        return LINE(x, rest)

    def right(x, rest):
        return function(jnp.concatenate([x, rest]))

    x, rest = (np.random.default_rng(k).uniform(0.2, 1.0, (5, 2)) for k in (1, 2))
    for of in (
        lambda f: jax.vmap(f, (0, None))(x, parts[1]),
        lambda f: jax.vmap(f, (None, 0))(parts[0], rest),
        lambda f: jax.vmap(jax.vmap(f, (None, 0)), (0, None))(x, rest),
        lambda f: jax.vmap(jax.jacfwd(f, (0, 1)), (0, None))(x, parts[1]),
        lambda f: jax.vmap(jax.jacrev(f, (0, 1)), (None, 0))(parts[0], rest),
        lambda f: jax.jacfwd(lambda x: jax.vmap(f, (None, 0))(x, rest))(parts[0]),
        lambda f: jax.jacrev(lambda x: jax.vmap(f, (None, 0))(x, rest).sum(0))(parts[0]),
        lambda f: jax.vmap(lambda x: jax.hessian(lambda x: f(x, parts[1]).sum())(x))(x),
        lambda f: jax.vmap(jax.vmap(jax.jacrev(f), (0, None)), (None, 0))(x, rest),
    ):
        expected = jax.jit(lambda of=of: of(right))()
        for found in (of(call), jax.jit(lambda of=of: of(call))()):
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)
