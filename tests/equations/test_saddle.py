"""The written-out elimination of saddle points: right against dense algebra, and it keeps the zeros of a mechanism."""

import jax
import numpy as np
import pytest

from lagjax._equations import SaddleElimination, elimination_order
from lagjax._tracing import concatenate, lower_formula, stack


def chain(links, rng):
    """M and G of a chain whose links couple neighbours: two coordinates and two constraints for each.

    The second constraint of a link depends on its coordinates alone, and the first on those of the next one too.
    """
    n = 2 * links
    neighbours = np.abs(np.arange(n)[:, None] // 2 - np.arange(n) // 2) <= 1
    matrix = np.where(neighbours, rng.normal(size=(n, n)), 0.0)
    matrix = matrix + matrix.T + 10 * np.eye(n)
    rows = np.zeros((2 * links - 1, n))
    for k, row in enumerate(rows):
        first = k // 2 * 2
        row[first : first + (4 if k % 2 else 2)] = rng.normal(size=4 if k % 2 else 2)
    return matrix, rows[1:]  # one coordinate more than constraints, and one for the first link


def solved(matrix, rows, b, c, zeros=None, **kind):
    zeros = (matrix == 0, rows == 0) if zeros is None else zeros
    elimination = SaddleElimination(zeros, np.float64, **{"augmented": False, "regular_only": False} | kind)
    entries = np.concatenate([matrix, rows])[tuple(elimination.entries.T)]

    def formula(*numbers):
        factors, singular = elimination.factors(stack(numbers[: len(entries)]))
        return concatenate([elimination.solve(factors, stack(numbers[len(entries) :])), stack([singular])])

    numbers = [*entries, *b, *c]
    program = lower_formula(formula, *[jax.ShapeDtypeStruct((), float)] * len(numbers), budget=100_000)
    *z, singular = program.evaluate(*numbers)
    return np.array(z[: len(b)]), -np.array(z[len(b) :]), bool(singular)


@pytest.mark.slow
@pytest.mark.parametrize("augmented", [False, True])
def test_a_chain_is_solved_as_by_dense_algebra(augmented):
    rng = np.random.default_rng(0)
    matrix, rows = chain(6, rng)
    n, m = len(matrix), len(rows)
    b, c = rng.normal(size=n), rng.normal(size=m)
    full = np.block([[matrix, -rows.T], [rows, np.zeros((m, m))]])
    expected = np.linalg.solve(full, np.concatenate([b, c]))
    x, multipliers, singular = solved(matrix, rows, b, c, augmented=augmented)
    found = np.concatenate([x, multipliers])
    assert not singular
    assert np.abs(found - expected).max() < 4 * n * np.finfo(float).eps * np.linalg.cond(full) * np.abs(expected).max()


@pytest.mark.slow
def test_constraints_that_depend_on_others_leave_the_solution():
    # Wherever the dependent rows stand: between the others they are eliminated between the others.
    rng = np.random.default_rng(1)
    matrix, rows = chain(5, rng)
    b, c = rng.normal(size=len(matrix)), rng.normal(size=len(rows))
    once, *_ = solved(matrix, rows, b, c)
    mix = np.zeros((3, len(rows)))
    mix[0, :2], mix[1, 3], mix[2, 4:7] = (1.0, -2.0), 1e3, (0.5, 1.0, 3.0)
    where = np.argsort(np.concatenate([np.arange(len(rows)), [0.5, 2.5, 8.5]]))
    more, right = (np.concatenate([x, mix @ x])[where] for x in (rows, c))
    x, multipliers, singular = solved(matrix, more, b, right)
    assert not singular and np.sum(multipliers == 0) == 3
    np.testing.assert_allclose(x, once, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(matrix @ x - more.T @ multipliers, b, atol=1e-10)
    assert solved(matrix, more, b, right, regular_only=True)[2]


@pytest.mark.slow
def test_coordinates_without_mass_are_held_by_constraints_or_reported():
    rng = np.random.default_rng(2)
    matrix, rows = chain(4, rng)
    matrix[2], matrix[:, 2] = 0.0, 0.0
    b, c = rng.normal(size=len(matrix)), rng.normal(size=len(rows))
    full = np.block([[matrix, -rows.T], [rows, np.zeros((len(rows),) * 2)]])
    expected = np.linalg.solve(full, np.concatenate([b, c]))
    x, multipliers, singular = solved(matrix, rows, b, c, augmented=True)
    assert not singular
    np.testing.assert_allclose(np.concatenate([x, multipliers]), expected, rtol=1e-9, atol=1e-10)
    dense = np.zeros_like(matrix, bool), np.zeros_like(rows, bool)  # zero in this state only
    assert solved(matrix, rows, b, c, dense, regular_only=True)[2]
    rows[:, 2] = 0.0  # nothing holds it any more
    assert solved(matrix, rows, b, c, dense, augmented=True)[2]


def test_a_chain_costs_in_proportion_to_its_length():
    # Operations go with the squares of the columns of L: so many for the ends of a chain, and so many for each link.
    rng, costs = np.random.default_rng(3), []
    for links in (10, 20, 40):
        shuffled = rng.permutation(2 * links)
        matrix, rows = chain(links, rng)
        order, filled = elimination_order((matrix != 0)[np.ix_(shuffled, shuffled)], (rows != 0)[:, shuffled])
        places = np.argsort(order)
        below = filled & (places[:, None] > places)
        assert np.all(
            np.argsort(order)[2 * links :][:, None] > np.where(rows[:, shuffled] != 0, places[: 2 * links], -1)
        )
        costs.append(np.sum(below.sum(axis=0) ** 2))
    assert costs[2] - costs[1] < 2.2 * (costs[1] - costs[0])  # 2 where they are proportional, 8 where they are cubic
