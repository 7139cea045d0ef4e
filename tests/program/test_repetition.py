"""A repeated step on the host, against `jax.lax.scan`: values and derivatives of two orders in every mode, batches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

from lagjax._primitives import HostFunction, Repetition, differentiable_where, solve

MATRIX = np.array([[2.0, 0.3, 0.1], [0.2, 1.5, -0.4], [0.0, 0.6, 3.0]])


def step(x, carry, _, row):
    """A step with a linear system, a slice, and a decision by the row."""
    (x,), (c, t), (row,) = x, carry, row
    grown = solve(MATRIX + x[0] * jnp.outer(c, c), c * x[1] + row[:3])
    behind = jnp.where(row[3] > 0, jnp.sin(grown), grown * grown[::-1] / (2.0 + c**2))
    later = t + x[2] * jnp.sum(behind[1:])
    return [behind, later], [jnp.append(behind, later * x[0])], [behind * t + x]


@pytest.mark.parametrize("reverse", [False, True])
def test_loops_and_searches_run_on_the_host(reverse):
    def function(knots, t, c):
        found = jnp.searchsorted(knots, t, side="right")
        last, each = jax.lax.scan(lambda x, row: (0.5 * x + row, x * c), c, t, reverse=reverse)
        return found, last, each

    rng = np.random.default_rng(0)
    knots, t = np.sort(rng.normal(size=(3, 100)), axis=1), rng.normal(size=(3, 20))
    knots[:, 50:52], t[0, :4] = [[-0.0, 0.0]], [0.0, -0.0, np.nan, knots[0, 7]]
    knots, c = np.sort(knots, axis=1), rng.normal(size=3)
    host = HostFunction(function, *(jax.ShapeDtypeStruct(x.shape[1:], float) for x in (knots, t, c)))
    with jax.enable_x64(True):
        expected = jax.vmap(function)(knots, t, c)
    for own, plain in zip(host(knots, t, c), expected, strict=True):
        np.testing.assert_allclose(own, plain, rtol=1e-14)


def repeat_by_scan(x, c, t, rows):
    def go(carry, row):
        carry, (of_round,), (part,) = step([x], carry, [], [row])
        return carry, (of_round, part)

    (c, t), (written, parts) = jax.lax.scan(go, [c, t], rows)
    return c, t, written, parts.sum(0)


REPETITION = Repetition(step, 1, 2, ((4,),), ((3,),))


def repeat_on_host(x, c, t, rows):
    (c, t), (written,), (total,) = REPETITION((x,), (c, t), (rows,), len(rows))
    return c, t, written, total


@pytest.fixture
def given():
    random = np.random.default_rng(5)
    rows = random.normal(size=(6, 4))
    return np.array([0.3, 0.8, -0.5]), random.normal(size=3), np.array(0.2), rows


def weigh(repeat, rows, x, c, t):
    """A number of all results."""
    return sum(jnp.sum(jnp.cos(a + 0.1)) for a in repeat(x, c, t, rows))


@pytest.mark.parametrize(
    "transform",
    [
        lambda f: f,
        lambda f: jax.grad(f, (0, 1, 2)),
        lambda f: jax.jacfwd(f, (0, 1, 2)),
        lambda f: jax.jit(jax.hessian(f, (0, 1, 2))),
        pytest.param(lambda f: jax.jit(jax.jacrev(jax.grad(f, (0, 1, 2)), (0, 1, 2))), marks=pytest.mark.slow),
        lambda f: jax.jit(jax.grad(f, (0, 1))),
        lambda f: jax.jit(jax.jacrev(jax.jacfwd(f, (0, 1)), (0, 1))),
    ],
    ids=["value", "reverse", "forward", "forward over reverse", "reverse over reverse", "jit", "reverse over forward"],
)
def test_derivatives(given, transform):
    *state, rows = given
    found = transform(functools.partial(weigh, repeat_on_host, rows))(*state)
    right = jax.jit(transform(functools.partial(weigh, repeat_by_scan, rows)))(*state)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-11, atol=1e-12), found, right)


@pytest.mark.parametrize("second", sweep([False, True], kept=[False]), ids=["gradients", "Hessians"])
def test_members(given, second):
    """Members have rounds of their own number, and what they share is shared."""
    x, c, t, rows = given
    counts, starts = np.array([0, 6, 2]), c * np.array([[1.0], [0.5], [-0.7]])
    derive = jax.hessian if second else jax.grad

    def on_host(x, c, count):
        (c, t_end), (written,), (total,) = REPETITION((x,), (c, t), (rows,), count)
        return jnp.sum(c**2) + t_end + jnp.sum(written) + jnp.sum(total**2)

    found = jax.jit(jax.vmap(derive(on_host), (None, 0, 0)))(x, starts, counts)
    for member, count in enumerate(counts):

        def by_scan(x, count=int(count), start=starts[member]):
            c, t_end, written, total = repeat_by_scan(x, start, t, rows[:count])
            return jnp.sum(c**2) + t_end + jnp.sum(written) + jnp.sum(total**2)

        np.testing.assert_allclose(found[member], jax.jit(derive(by_scan))(x), rtol=1e-11, atol=1e-12)


def test_lost_derivatives():
    """What is not differentiable in one round is NaN behind it, in both modes, and values are not."""

    def lose(x, carry, _, row):
        return [differentiable_where(row[0] > 0, carry[0] * x[0])], [], []

    def value(x, rows):
        return Repetition(lose, 1, 1, (), ())((x,), (jnp.array(1.0),), (rows,), 2)[0][0]

    good, bad = np.ones(2), np.array([1.0, -1.0])
    assert value(2.0, bad) == 4.0
    for derive in (jax.grad, jax.jacfwd):
        assert derive(value)(2.0, good) == 4.0
        assert np.isnan(derive(value)(2.0, bad))


FUNCTIONS = {
    "whole numbers divide with a rest": lambda x: jnp.array([7, -7, 9]) // jnp.floor(x[:1] * 0 + 2).astype(int),
    "a loop is no call": lambda x: jnp.searchsorted(jnp.arange(9.0), x * 2.0),
    "a loop": lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * 1.5 + x, x),
    "pads that cut": lambda x: jax.lax.pad(x, 7.0, [(-1, 2, 1)]),
    "products": lambda x: jnp.einsum("i,jk,k->ji", x, MATRIX, x) @ MATRIX,
    "a number beside an array": lambda x: jnp.where(x[0] > 0, x, 2.0 * x[1]) > x[2],
    "constants": lambda x: jnp.flip(x) + jnp.arange(3.0).at[1].set(5.0) + jnp.sum(jnp.ones(3), axis=0),
    "tables": lambda x: jnp.interp(x, jnp.array([-2.0, 0.0, 1.0]), jnp.array([1.0, 3.0, -2.0])),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations(name):
    """Members in front, or one row that all share, give what JAX gives of each."""
    function, rows = FUNCTIONS[name], np.random.default_rng(2).normal(size=(3, 3))
    compiled = jax.jit(function)
    on_host = HostFunction(function, jax.ShapeDtypeStruct((3,), float))
    for x in (rows, rows[:1]):
        right = np.stack([compiled(row) for row in x])
        np.testing.assert_allclose(on_host(x)[0], np.broadcast_to(right, on_host(x)[0].shape), rtol=1e-14)
        assert on_host(x)[0].dtype == right.dtype


def test_singular_systems():
    """A member without a solution is NaN, and others are not."""
    a = np.stack([np.eye(2), np.zeros((2, 2))])
    found = jax.vmap(solve, (0, None))(a, jnp.ones(2))
    np.testing.assert_array_equal(found, [[1.0, 1.0], [np.nan, np.nan]])


READS = {
    "an entry": (lambda x, i: x[i], (5,), ()), "rows": (lambda x, i: x[i], (5, 3), (4,)),
    "columns": (lambda x, i: x[:, i], (4, 5), (3,)), "a diagonal": (lambda x, i: x[i, i], (5, 5), (3,)),
    "what may be nowhere": (lambda x, i: x.at[i].get(mode="fill"), (5,), (4,)),
    "a window": (lambda x, i: jax.lax.dynamic_slice(x, (i,), (2,)), (5,), ()),
    "along an axis": (lambda x, i: jnp.take_along_axis(x, i, 1), (3, 5), (3, 2)),
    "an entry of each row": (lambda x, i: jax.vmap(lambda row, k: row[k])(x, i), (3, 5), (3,)),
}  # fmt: skip


@pytest.mark.parametrize("read", READS)
def test_places_that_are_known_at_run_time(read):
    """What is read, and the cotangents of what it is read from, as XLA has them."""
    function, shape, of_places = READS[read]
    rng = np.random.default_rng(0)
    x, places = rng.normal(size=(4, *shape)), rng.integers(-1 if "nowhere" in read else 0, 3, size=(4, *of_places))

    def both(x, places):
        found, pull = jax.vjp(lambda x: function(x, places), x)
        return [found, *pull(jnp.sin(found))]

    on_host = HostFunction(both, jax.ShapeDtypeStruct(shape, float), jax.ShapeDtypeStruct(of_places, int))
    for found, right in zip(on_host(x, places), jax.jit(jax.vmap(both))(x, places), strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-14)
