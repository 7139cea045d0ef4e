"""Taylor recurrences: every operation, moved in every way, against derivatives that know nothing of them."""

import functools
import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from sweeps import sweep

from lagjax import scenes
from lagjax._equations import derivation_of
from lagjax._interface import Layout
from lagjax._program import OPERATIONS, Unlowerable, pullback, series
from lagjax._tracing import apply_function, emit, lower, lower_solution, stack

ORDER = 10
NAN = float("nan")


@pytest.fixture(autouse=True)
def _precision():
    with jax.enable_x64(True), mpmath.workdps(40):
        yield


def recurrences(function, q, *rest):
    """The program of q̈ (and what else `function` gives) and its recurrences."""
    program = lower(function, *map(jnp.asarray, (q, *rest)))
    return program, series(program, len(q), 2 * len(q) + 1)


def coefficients(function, order, q, v, t, *params):
    """The series of q, shape (n, order + 1)."""
    program, found = recurrences(function, q, v, t, *params)
    numbers = [*q, *v, t, *np.concatenate([np.ravel(p) for p in params] or [[]])]
    return coefficients_of(program, found, order, numbers)


def coefficients_of(program, found, order, numbers):
    """The series of q, from q, q̇, t and parameters: a run of the zeroth order, and one of the recursion per order."""
    n, (q, v) = found.size, np.split(np.array(numbers[: 2 * found.size]), 2)
    out = found.zeroth_order.evaluate(numbers)[:, 0]
    values = out[len(program.line.outputs) :]
    np.testing.assert_array_equal(out[:n], program.evaluate(*numbers)[:n])
    y, rows = np.zeros((2 * n, order + 1)), np.zeros((found.rows, order + 1))
    y[:, 0], y[:n, 1], y[n:, 1] = [*q, *v], v, out[:n]
    for k in range(1, order):
        sums = [sum(rows[a, j] * rows[b, k - j] for j in range(1, k)) for a, b in found.cauchy_products]
        out = found.order_recursion.evaluate([*y[:, k], float(k == 1), float(k), 1.0 / k, *values, *sums])[:, 0]
        rows[:, k] = out[n:]
        y[:n, k + 1], y[n:, k + 1] = y[n:, k] / (k + 1), np.array(out[:n]) / (k + 1)
    return y[:n]


def close(found, exact):
    """To round-off: the terms of a sum are as large as the largest coefficients, and some hundred roundings add up."""
    np.testing.assert_allclose(found, exact, rtol=2e-13, atol=2e-14 * np.max(np.abs(exact)))


# ---- one operation on known curves ----------------------------------------------------------------------------------

T0 = 0.25
SHAPE = {"u": (0.5, -0.4, 0.7), "w": (-0.3, 0.6, 0.2)}


def curve(name, start):
    """A cubic through `start` at T0."""
    b, c, d = SHAPE[name]
    return lambda t: start + (t - T0) * (b + (t - T0) * (c + (t - T0) * d))


def check(operation, reference, *operands, order=ORDER):
    """`operation` of curves (functions of t), parameters (lists of one number) and constants, against `reference`."""
    params = [np.array(x) for x in operands if isinstance(x, list)]

    def acceleration(q, v, t, *params):
        params = iter(params)
        xs = [x(t) if callable(x) else next(params)[0] if isinstance(x, list) else x for x in operands]
        return operation(*xs)

    def exact(t):
        return reference(*(x(t) if callable(x) else mpmath.mpf(x[0] if isinstance(x, list) else x) for x in operands))

    (found,) = coefficients(acceleration, order + 2, [0.0], [0.0], T0, *params)
    k = np.arange(order + 1)
    close(found[2:] * (k + 1) * (k + 2), [float(c) for c in mpmath.taylor(exact, mpmath.mpf(T0), order)])


def real_cbrt(x):
    return mpmath.sign(x) * mpmath.cbrt(abs(x))


def moving(arity):
    """The rows of operations whose results move along a motion; those of pieces are tested as pieces."""
    return {
        name: row for name, row in OPERATIONS.items()
        if row.arity == arity and not row.is_step and name not in ("convert", "select")
    }  # fmt: skip


def in_jax(row):
    return getattr(lax, row.lax or row.name, None) or getattr(jnp, row.name)


REFERENCES = {  # where mpmath has another name, or none
    "neg": lambda x: -x,
    "rsqrt": lambda x: 1 / mpmath.sqrt(x),
    "cbrt": real_cbrt,
    "exp2": lambda x: mpmath.mpf(2) ** x,
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)),
    "abs": abs,
}
STARTS = {  # where (0.4, -2) does not suit
    **dict.fromkeys(("sqrt", "rsqrt", "log"), (0.6, 20.0)),
    **dict.fromkeys(("asin", "acos", "atanh"), (0.2, -0.3)),
    "cbrt": (0.6, -0.8), "sin": (0.4, -7.0), "cos": (0.4, -7.0), "tan": (0.4, -2.8), "expm1": (1e-9, -3.0),
    "log1p": (1e-9, -0.3), "acosh": (1.8, 5.0), "abs": (0.7, -0.7),
}  # fmt: skip
UNARY = {  # in JAX, in mpmath, where
    **{
        name: (in_jax(row), REFERENCES.get(name) or getattr(mpmath, name), STARTS.get(name, (0.4, -2.0)))
        for name, row in moving(1).items()
    },
    "square": (jnp.square, lambda x: x * x, (0.4, 0.0)),
    "cube": (lambda x: x**3, lambda x: x**3, (0.4, 0.0)),
    "inverse cube": (lambda x: x**-3, lambda x: x**-3, (0.6, -0.8)),
    "20th power": (lambda x: x**20, lambda x: x**20, (0.9,)),
    "to the 1.5": (lambda x: x**1.5, lambda x: x ** mpmath.mpf(1.5), (0.6,)),
    "hypotenuse": (lambda x: jnp.hypot(x, 1.0), lambda x: mpmath.sqrt(x * x + 1), (0.4, 0.0)),
}


@pytest.mark.parametrize("name", UNARY)
def test_functions_of_one_number(name):
    operation, reference, starts = UNARY[name]
    for start in starts:
        check(operation, reference, curve("u", start))


POINTS = {  # in mpmath, pairs of values
    "add": (lambda a, b: a + b, [(0.4, -0.9)]),
    "sub": (lambda a, b: a - b, [(0.4, -0.9)]),
    "mul": (lambda a, b: a * b, [(0.4, -0.9), (0.4, 0.0)]),
    "div": (lambda a, b: a / b, [(0.4, -0.9), (0.0, 0.7)]),
    "pow": (mpmath.power, [(0.6, 1.7), (1.3, -0.7)]),
    "atan2": (mpmath.atan2, [(0.7, 0.5), (0.7, -0.5), (-0.7, -0.5), (-0.7, 0.5), (0.7, 1e-3), (1e-3, -2.0)]),
    "logaddexp": (
        lambda a, b: mpmath.log(mpmath.exp(a) + mpmath.exp(b)), [(0.4, -0.9), (0.7, 0.7), (25.0, 0.3), (-800.0, 0.3)]
    ),
    "max": (max, [(0.4, -0.9), (-0.4, 0.9)]),
    "min": (min, [(0.4, -0.9), (-0.4, 0.9)]),
    "rem": (lambda a, b: a - b * int(a / b), [(7.5, 2.0), (-7.5, 2.0), (7.5, -2.0), (0.5, 2.0)]),
}  # fmt: skip
BINARY = {name: (in_jax(row), *POINTS[name]) for name, row in moving(2).items()}


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("moves", ["both", "first", "second"])
@pytest.mark.parametrize("still", ["constant", "parameter"])
def test_functions_of_two_numbers(name, moves, still):
    operation, reference, points = BINARY[name]
    rest = (lambda x: x) if still == "constant" else (lambda x: [x])
    for a, b in points:
        first = rest(a) if moves == "second" else curve("u", a)
        second = rest(b) if moves == "first" else curve("w", b)
        check(operation, reference, first, second)


def test_operands_that_are_one_and_the_same():
    u = curve("u", 0.7)
    check(lambda x: x * x + x / (x * x * x), lambda x: x * x + 1 / x**2, u)
    check(lambda x: jnp.atan2(x, x + 1), lambda x: mpmath.atan2(x, x + 1), u)
    check(lambda x: x**x, lambda x: x**x, u)


PIECES = {  # in JAX, what it is on the piece, where
    "select yes": (lambda x: jnp.where(x > 0, jnp.sin(x), x**2), mpmath.sin, 0.7),
    "select no": (lambda x: jnp.where(x > 0, jnp.sin(x), x**2), lambda x: x**2, -0.7),
    "select a constant": (lambda x: jnp.where(x > 0, jnp.sin(x), 2.0), lambda x: mpmath.mpf(2), -0.7),
    "select not": (lambda x: jnp.where(~(x > 0), 2.0, jnp.sin(x)), mpmath.sin, 0.7),
    "both conditions": (lambda x: jnp.where((x > 0) & (x < 1), x**3, -x), lambda x: x**3, 0.7),
    "sign": (lambda x: jnp.sign(x) * x**2, lambda x: -(x**2), -0.7),
    "floor": (lambda x: jnp.floor(x) * x, lambda x: -2 * x, -1.3),
    "ceil": (lambda x: jnp.ceil(x) * x, lambda x: -x, -1.3),
    "round": (lambda x: jnp.round(x) * x, lambda x: 2 * x, 1.6),
    "as integer": (lambda x: x.astype(int) * x, lambda x: 2 * x, 2.6),
    "clip below": (lambda x: jnp.clip(x, 1.0, 2.0) * x, lambda x: x, 0.5),
    "clip inside": (lambda x: jnp.clip(x, 1.0, 2.0) * x, lambda x: x**2, 1.5),
    "mod": (lambda x: jnp.mod(x, 2 * np.pi) ** 2, lambda x: (x + 2 * mpmath.mpf(np.pi)) ** 2, -1.0),
    "guarded yes": (lambda x: jnp.where(x > 0, jnp.sin(x), NAN), mpmath.sin, 0.7),
    "guarded no": (lambda x: jnp.where(x < 0, NAN, jnp.sin(x)), mpmath.sin, 0.7),
    "NaN not taken": (lambda x: jnp.where(x > 0, jnp.sqrt(x), x**2), lambda x: x**2, -0.7),
    # Flat where the outer function has no slope:
    "Hertz": (lambda x: jnp.maximum(x, 0.0) ** 1.5 + x, lambda x: x, -0.7),
    "power": (lambda x: jnp.maximum(x, 0.0) ** 1.7 + x, lambda x: x, -0.7),
    "cube root": (lambda x: jnp.cbrt(jnp.maximum(x, 0.0)) + x, lambda x: x, -0.7),
    "asin": (lambda x: jnp.asin(jnp.clip(x, -1.0, 1.0)) + x, lambda x: mpmath.pi / 2 + x, 1.7),
    "acos": (lambda x: jnp.acos(jnp.clip(x, -1.0, 1.0)) + x, lambda x: mpmath.pi + x, -1.7),
    "acosh": (lambda x: jnp.acosh(jnp.maximum(x, 1.0)) + x, lambda x: x, 0.3),
    "atan2": (lambda x: jnp.atan2(jnp.maximum(x, 0.0), jnp.maximum(x, 0.0)) + x, lambda x: x, -0.7),
    "20th power at zero": (lambda x: jnp.maximum(x, 0.0) ** 20 + x, lambda x: x, -0.7),
}  # fmt: skip


@pytest.mark.parametrize("name", PIECES)
def test_pieces(name):
    operation, reference, start = PIECES[name]
    check(operation, reference, curve("u", start))


def test_a_guard_that_strikes_shows():
    values = coefficients(lambda q, v, t: jnp.where(q > 0, q, NAN), 3, [-1.0], [0.0], 0.0)
    assert np.isnan(values[0, 2])


def test_compositions():
    check(
        lambda u, w, p: jnp.exp(jnp.sin(u) * jnp.log1p(w * w)) / jnp.sqrt(1 + (u - p) ** 2) - jnp.tanh(w / (2 + u)),
        lambda u, w, p: mpmath.exp(mpmath.sin(u) * mpmath.log1p(w * w)) / mpmath.sqrt(1 + (u - p) ** 2)
        - mpmath.tanh(w / (2 + u)),
        curve("u", 0.7), curve("w", -0.4), [0.3],
    )  # fmt: skip


def test_every_operation_has_a_series():
    for name, row in OPERATIONS.items():  # `convert` changes no double
        assert row.is_step or row.recurrence or len(row.slopes) == row.arity or name == "convert", name


# ---- motions --------------------------------------------------------------------------------------------------------


def kepler(q, v, t, gm):
    return -gm * q / jnp.sum(q**2) ** 1.5


def pendulum(q, v, t):
    return -jnp.sin(q)


def driven(q, v, t, k, w):
    """Damped, driven, with a mass that depends on the place: q, v and t all at work."""
    return (k * jnp.cos(w * t) - q * v**2 - q * jnp.exp(-t) * v) / (1 + q**2)


def charge(q, v, t):
    """In a magnetic field that grows with time and distance, beside a soft wall."""
    field = (1 + t) * jnp.array([0.3, q[0] * q[1], jnp.cos(q[2])])
    return jnp.cross(v, field) + jnp.array([jnp.maximum(-q[0], 0.0) ** 1.5, 0.0, jnp.tanh(q[1])])


def double_pendulum(q, v, t):
    c, s = jnp.cos(q[0] - q[1]), jnp.sin(q[0] - q[1])
    a, b = -s * v[1] ** 2 - 2 * 9.81 * jnp.sin(q[0]), s * v[0] ** 2 - 9.81 * jnp.sin(q[1])
    return jnp.stack([a - c * b, 2 * b - c * a]) / (2 - c**2)


MOTIONS = {
    "pendulum": (pendulum, [2.0], [0.3]),
    "Kepler": (kepler, [0.8, -0.3], [0.2, 1.1], 1.3),
    "driven": (driven, [0.4], [0.9], 0.7, 1.9),
    "charge": (charge, [-0.7, -0.5, 0.2], [-0.3, 0.8, 0.5]),
    "double pendulum": (double_pendulum, [1.0, -0.6], [0.4, -0.9]),
}


def total_derivatives(function, q, v, t, *params, count):
    """q⁽²⁾, q⁽³⁾ …: d/dt g = ∂g/∂q v + ∂g/∂v f + ∂g/∂t, again and again."""
    q, v, t = map(jnp.asarray, (q, v, t))
    f = lambda q, v, t: function(q, v, t, *params)

    def along(g):
        return lambda q, v, t: jax.jvp(g, (q, v, t), (v, f(q, v, t), jnp.ones(())))[1]

    found, g = [], f
    for _ in range(count):
        found.append(g(q, v, t))
        g = along(g)
    return jnp.stack(found, axis=1)


@pytest.mark.parametrize("name", sweep(MOTIONS, kept=("pendulum", "Kepler", "driven")))
def test_motions(name):
    function, q, v, *params = MOTIONS[name]
    exact = jax.jit(lambda *state: total_derivatives(function, *state, count=5))(
        *map(jnp.asarray, (q, v, 0.4, *params))
    )
    found = coefficients(function, 6, q, v, 0.4, *params)
    factorials = np.cumprod(np.arange(1.0, 7))[1:]
    close(found[:, 2:], np.asarray(exact) / factorials)


def test_high_orders_of_a_closed_form():
    # q' = q², q(0) = 1/2 is 1 / (2 − t): q'' = 2 q q'.
    (found,) = coefficients(lambda q, v, t: 2 * q * v, 30, [0.5], [0.25], 0.0)
    np.testing.assert_allclose(found, 0.5 ** np.arange(1, 32), rtol=1e-14)
    (found,) = coefficients(lambda q, v, t: -q, 20, [1.0], [0.0], 0.0)
    np.testing.assert_allclose(found[::2], [(-1) ** k / float(mpmath.factorial(2 * k)) for k in range(11)], rtol=1e-15)


# ---- linear systems -------------------------------------------------------------------------------------------------

SYSTEMS = {  # a scene, and the products that its series takes, with the recurrences of its elimination and without
    "double_pendulum": (scenes.double_pendulum, 17, 13),  # Cramer's rule
    "chain": (functools.partial(scenes.chain, 4), 71, 52),
    "spherical_pendulum": (scenes.spherical_pendulum, 10, 10),  # a quotient
    "cartesian_double_pendulum": (scenes.cartesian_double_pendulum, 26, 16),  # a saddle point
    "rolling_cylinder": (scenes.rolling_cylinder, 14, 9),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_solution_of_a_linear_system_without_its_elimination(name):
    make, by_elimination, by_system = SYSTEMS[name]
    scene = make()
    layout = Layout.from_state(scene.q0, scene.qdot0)
    program = derivation_of(scene.system, layout, scene.params).accelerations.program
    rng, n = np.random.default_rng(3), layout.size
    states = np.concatenate([layout.flatten(scene.q0), layout.flatten(scene.qdot0)]) + rng.uniform(-0.1, 0.1, 2 * n)
    numbers = [*states, 0.2, *np.concatenate([np.ravel(p) for p in jax.tree.leaves(scene.params)])]
    given, without = program, replace(program, linear=None)
    found, exact = (series(p, n, 2 * n + 1) for p in (given, without))
    close(coefficients_of(given, found, 12, numbers), coefficients_of(without, exact, 12, numbers))
    assert (len(exact.cauchy_products), len(found.cauchy_products)) == (by_elimination, by_system)


def test_a_linear_system_of_any_entries():
    # Entries that move, that stay and that are zero; a right-hand side with time; divisions in the solution.
    def numbers_of(x):
        q, v, t, k = x[:3], x[3:6], x[6], x[7]
        entries = 2 + jnp.sin(q[0]), k * v[1], 3.0 + k, q[2] * t, 4 + q[1] ** 2
        return jnp.stack([*entries, -k * q[0], v[0] * v[1], jnp.sin(t)])

    def system(*scalars):
        x = apply_function(numbers_of, stack(scalars))
        a, b, c, d, e = (x[i] for i in range(5))
        places = np.array([[0, 0], [1, 0], [1, 1], [2, 1], [2, 2]])
        return places, x[:5], x[5:], (x[:5], a * c * e - a * d * d - b * b * e), a > 0.0

    def solve(factors, right):  # Cramer's rule
        entries, determinant = factors
        (a, b, c, d, e), r = (entries[i] for i in range(5)), [right[i] for i in range(3)]
        solution = [
            r[0] * (c * e - d * d) - b * (r[1] * e - d * r[2]),
            a * (r[1] * e - d * r[2]) - b * e * r[0],
            a * (c * r[2] - d * r[1]) - b * (b * r[2] - d * r[0]),
        ]
        return stack(solution) / determinant

    q, v, t, k = [0.3, -0.2, 0.5], [0.4, 0.1, -0.3], 0.2, 1.5
    scalar = jax.ShapeDtypeStruct((), float)
    program = lower_solution(system, solve, 3, *[scalar] * 8, budget=1000)
    found, exact = (series(p, 3, 7) for p in (program, replace(program, linear=None)))
    numbers = [*q, *v, t, k]
    close(coefficients_of(program, found, 10, numbers), coefficients_of(program, exact, 10, numbers))
    assert len(found.cauchy_products) < len(exact.cauchy_products)


# ---- what is kept ---------------------------------------------------------------------------------------------------


def operations(line):
    return sum(op not in ("input", "constant") for op, _, _ in line.nodes)


def test_a_linear_motion_needs_no_products():
    _, found = recurrences(lambda q, v, t, k: -k * q - 0.1 * v + 2 * t, [0.1], [0.2], 0.0, 3.0)
    assert found.cauchy_products == () and found.rows == 0
    assert operations(found.order_recursion) == 5


@pytest.mark.parametrize(
    ("function", "products", "rows"),
    [
        (pendulum, 2, 3),  # Σ j qⱼ cₖ₋ⱼ and Σ j qⱼ sₖ₋ⱼ
        (lambda q, v, t: q * q, 1, 1),
        (lambda q, v, t: q * v + jnp.exp(t) * 0, 1, 2),
        (lambda q, v, t: (q * v) * (q * v) + q * v, 2, 3),  # one q v, and its square
        (lambda q, v, t: jnp.exp(q), 1, 2),
        (lambda q, v, t: q * jnp.sin(3.0) + jnp.abs(v), 0, 0),
        (lambda q, v, t: jnp.where(q > v * t, q, v), 0, 0),  # the product decides, but does not move
    ],
)
def test_products_are_shared_and_counted(function, products, rows):
    _, found = recurrences(function, [0.3], [0.4], 0.1)
    assert (len(found.cauchy_products), found.rows) == (products, rows)
    assert all(a < found.rows and b < found.rows for a, b in found.cauchy_products)


def test_squares_come_last():
    _, found = recurrences(lambda q, v, t: q * q + v * v + q * v, [0.3], [0.4], 0.1)
    assert [a == b for a, b in found.cauchy_products] == [False, True, True]


def test_what_only_other_outputs_need_is_dropped():
    plain = recurrences(pendulum, [0.3], [0.4], 0.1)[1]
    _, more = recurrences(lambda q, v, t: (pendulum(q, v, t), jnp.exp(q * v) > 3, q * v * t), [0.3], [0.4], 0.1)
    assert (more.cauchy_products, more.rows, more.values) == (plain.cauchy_products, plain.rows, plain.values)
    assert operations(more.order_recursion) == operations(plain.order_recursion)


def test_the_state_may_be_of_first_order():
    # ẏ = f(t, y), with time first, as the inputs come: e^{t²/2} by y' = t y
    program = lower(lambda t, y, p: p * t * y, 0.0, 1.0, 1.0)
    found = series(program, 1, 2)
    start = found.zeroth_order.evaluate([0.0, 1.0, 1.0])[:, 0]
    values, y, rows = start[1:], [1.0, start[0]], np.zeros((found.rows, 12))
    for k in range(1, 12):
        sums = [sum(rows[a, j] * rows[b, k - j] for j in range(1, k)) for a, b in found.cauchy_products]
        out = found.order_recursion.evaluate([float(k == 1), y[k], float(k), 1.0 / k, *values, *sums])[:, 0]
        rows[:, k] = out[1:]
        y.append(out[0] / (k + 1))
    expected = [0.5 ** (k // 2) / float(mpmath.factorial(k // 2)) if k % 2 == 0 else 0.0 for k in range(13)]
    np.testing.assert_allclose(y, expected, rtol=1e-14)


def test_an_operation_without_a_series_is_named(monkeypatch):
    monkeypatch.setitem(OPERATIONS, "erf", replace(OPERATIONS["erf"], slopes=()))
    with pytest.raises(Unlowerable, match="`erf` has no Taylor series"):
        recurrences(lambda q, v, t: lax.erf(q) * v, [0.3], [0.4], 0.1)
    for harmless in (lambda q, v, t: lax.erf(jnp.sin(2.0) + 0 * q) * v, lambda q, v, t: (v, lax.erf(q))):
        recurrences(harmless, [0.3], [0.4], 0.1)


@pytest.mark.slow
def test_all_moving_inputs_may_be_any_mixture():
    # Each of q, v, t alone, in pairs, and all: what does not move has no coefficients, and the rest stays right.
    for which in itertools.chain.from_iterable(itertools.combinations("qvt", r) for r in range(4)):
        function = lambda q, v, t, which=which: (
            jnp.sin(sum(c * x for c, x, name in ((0.7, q, "q"), (1.1, v, "v"), (0.4, t, "t")) if name in which) + 0.3)
            + jnp.zeros(1)
        )
        exact = total_derivatives(function, [0.4], [0.9], 0.2, count=4)
        found = coefficients(function, 5, [0.4], [0.9], 0.2)
        close(found[:, 2:], np.asarray(exact) / [2, 6, 24, 120])


def test_pullback_is_the_transposed_derivative():
    function = lambda x, y, z: (jnp.exp(x), jnp.where(z > 0, x * x / y, 0.0), jnp.exp(x) * jnp.sin(y) + z)
    scalar = jax.ShapeDtypeStruct((), np.float64)
    program = lower(function, scalar, scalar, scalar)
    line = program.line
    inputs, bars, by, of = (0.7, -1.3, 0.4), (0.9, -0.2), [0, 1], [0, 1]
    exact = jax.jit(lambda: jax.vjp(lambda x, y: function(x, y, inputs[2])[:2], *inputs[:2])[1](bars))()
    plain = pullback(line, [np.dtype(float)] * 3, by, of)
    np.testing.assert_allclose(emit(plain, (*inputs, *bars)), exact, rtol=1e-14)
    # With eˣ from outside it is not computed again.
    known = pullback(line, [np.dtype(float)] * 3, by, [0, 2], known=[0])
    assert "exp" not in {op for op, _, _ in known.nodes}
    value = function(*inputs)
    again = jax.vjp(lambda x, y: function(x, y, inputs[2])[::2], *inputs[:2])[1](bars)
    np.testing.assert_allclose(emit(known, (*inputs, *bars, value[0])), again, rtol=1e-14)
