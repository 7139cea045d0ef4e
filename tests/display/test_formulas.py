"""`System.equations`: scenes look as in a textbook, and the formulas evaluate to the numbers of a scene."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes as shared

import lagjax
from lagjax import scenes
from lagjax._equations import Sample
from lagjax._interface import Layout

FUNCTIONS = {name: getattr(math, name) for name in dir(math)} | {
    "where": lambda condition, yes, no: yes if condition else no,
    "sign": np.sign, "round": np.round, "abs": abs, "max": max, "min": min, "cbrt": np.cbrt,
    "inf": math.inf, "logaddexp": np.logaddexp, "logistic": lambda x: 1 / (1 + math.exp(-x)), "rem": math.fmod,
}  # fmt: skip


def values_of(system, q, qdot, params, t, count=5, spread=0.3):
    """M, F, f, G and γ by the printed formulas and by the scene's programs, at states about this one."""
    equations, layout = system.equations(q, qdot, t, params), Layout.from_state(q, qdot)
    assert not equations.note
    rng = np.random.default_rng(0)
    places = np.array([np.ravel(layout.flatten(x)) for x in (q, qdot)])[:, None]
    positions, rates = places + spread * rng.uniform(-1, 1, (2, count, layout.size))
    names = ("mass_matrix", "force", "residual", "jacobian", "gamma")
    exact = Sample.from_scene(system, layout, positions, rates, t, params).quantities(*names)
    numbers = [x for leaf in jax.tree.leaves(params) for x in np.ravel(leaf).tolist()]
    coordinates, found = equations.variables[: layout.size], []
    rows = list(equations.constraints)
    for state in np.hstack([positions, rates]):
        known = FUNCTIONS | dict(zip(equations.variables, [*state.tolist(), t, *numbers], strict=True))

        def value(text, known=known):
            return float(eval(text, {"__builtins__": {}}, known))

        for name, text in equations.parts.items():
            known[name] = value(text)
        matrix = np.zeros((layout.size, layout.size))
        for (a, b), text in equations.mass_matrix.items():
            i, j = coordinates.index(a), coordinates.index(b)
            matrix[i, j] = matrix[j, i] = value(text)
        jacobian = np.zeros((len(rows), layout.size))
        for (a, b), text in equations.jacobian.items():
            jacobian[rows.index(a), coordinates.index(b)] = value(text)
        vectors = [
            [value(table[key]) if key in table else 0.0 for key in keys]
            for table, keys in ((equations.force, coordinates), (equations.constraints, rows), (equations.gamma, rows))
        ]
        found.append([matrix, vectors[0], vectors[1], jacobian, vectors[2]])
    return {name: (np.array([of[k] for of in found]), exact[name]) for k, name in enumerate(names)}


def require_equal(system, q, qdot, params=None, t=0.3, **more):
    for found, exact in values_of(system, q, qdot, params, t, **more).values():
        size = np.abs(exact).max(initial=1e-300)
        np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-12 * size)


def lines_of(system, q, params=None):
    return str(system.equations(q, q, params=params)).splitlines()[2:]


READY = [make for make in scenes.ALL if "system" not in make.__name__]


@pytest.mark.parametrize("make", READY, ids=lambda make: make.__name__)
def test_the_formulas_of_ready_scenes_evaluate_to_their_numbers(make):
    scene = make()
    require_equal(scene.system, scene.q0, scene.qdot0, scene.params, spread=0.05)


STARTS = {
    1: (0.7, 0.3), 2: (np.array([0.7, 0.4]), np.array([0.3, -0.2])),
}  # fmt: skip
PARAMS = {"SPRING": {"k": 2.0}, "SPRING_K": 2.0, "PENDULUM_G": 9.8, "BALL_G": 9.8, "CLIFF": 0.3}
PLANE = ("FREE_POINTS", "OSCILLATORS", "WEIGHT", "WEIGHT_ON_A_SLIDE", "KEPLER", "HENON_HEILES", "SADDLE")


@pytest.mark.parametrize("name", [name for name, of in vars(shared).items() if isinstance(of, lagjax.System)])
def test_the_formulas_of_shared_scenes_evaluate_to_their_numbers(name):
    params = PARAMS.get(name, {"g": 9.8} if name.endswith("IN_GRAVITY") or name == "BALL_ON_THE_FLOOR" else None)
    require_equal(getattr(shared, name), *STARTS[2 if name in PLANE else 1], params)


# ---- as in a textbook ------------------------------------------------------------------------------------------------

G = {"g": 9.81}
ANGLES = {"theta1": 0.3, "theta2": -0.4}
DOUBLE = {"m1": 1.0, "m2": 2.0, "l1": 1.5, "l2": 0.5, "g": 9.81}


def double_pendulum(q, v, params):
    """As the chapter has it."""
    m1, m2, l1, l2, g = (params[name] for name in DOUBLE)
    a, b = q["theta1"], q["theta2"]
    kinetic = 0.5 * (m1 + m2) * l1**2 * v["theta1"] ** 2 + 0.5 * m2 * l2**2 * v["theta2"] ** 2
    kinetic = kinetic + m2 * l1 * l2 * jnp.cos(a - b) * v["theta1"] * v["theta2"]
    return kinetic + (m1 + m2) * g * l1 * jnp.cos(a) + m2 * g * l2 * jnp.cos(b)


def double_pendulum_by_places(q, v, params):
    """The same, with places in the plane, differentiated by JAX."""
    m1, m2, l1, l2, g = (params[name] for name in DOUBLE)

    def places(q):
        x, y = l1 * jnp.sin(q["theta1"]), -l1 * jnp.cos(q["theta1"])
        return x, y, x + l2 * jnp.sin(q["theta2"]), y - l2 * jnp.cos(q["theta2"])

    (_, y1, _, y2), (vx1, vy1, vx2, vy2) = jax.jvp(places, (q,), (v,))
    return 0.5 * m1 * (vx1**2 + vy1**2) + 0.5 * m2 * (vx2**2 + vy2**2) - m1 * g * y1 - m2 * g * y2


def cart(q, v, params):
    m, l = params["m"], params["l"]
    vx, vy = v["x"] + l * jnp.cos(q["theta"]) * v["theta"], l * jnp.sin(q["theta"]) * v["theta"]
    return 0.5 * params["M"] * v["x"] ** 2 + 0.5 * m * (vx**2 + vy**2) + m * 9.81 * l * jnp.cos(q["theta"])


def central(q, v, params):
    x, y = q["x"], q["y"]
    return 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) + params["k"] / jnp.sqrt(x**2 + y**2)


def charge(q, v, params):
    """Fields in the third direction: A = B (−y, x, 0)/2."""
    m, e, B, E = (params[name] for name in ("m", "e", "B", "E"))
    kinetic = 0.5 * m * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2)
    return kinetic + e * E * q["z"] + 0.5 * e * B * (q["x"] * v["y"] - q["y"] * v["x"])


def damped(q, v, params):
    return 0.5 * params["m"] * v**2 - 0.5 * params["k"] * (q - params["l"]) ** 2


DOUBLE_PENDULUM, CART, CENTRAL, CHARGE = map(lagjax.System, (double_pendulum, cart, central, charge))
RUBBED = lagjax.System(damped, dissipation=lambda q, v, params: 0.5 * params["c"] * v**2)
DRIVEN = lagjax.System(lambda q, v, t: 0.5 * v**2 + jnp.cos(q), forces=lambda q, v, t: 0.5 * jnp.cos(2 * t) - v / 3)


IN_THE_CHAPTER = [
    "M[theta1, theta1] = (m1 + m2)*l1**2",
    "M[theta1, theta2] = m2*l1*l2*cos(theta1 - theta2)",
    "M[theta2, theta2] = m2*l2**2",
    "F[theta1] = -(m1 + m2)*g*l1*sin(theta1) - m2*l1*l2*sin(theta1 - theta2)*theta2_dot**2",
    "F[theta2] = m2*l1*l2*sin(theta1 - theta2)*theta1_dot**2 - m2*g*l2*sin(theta2)",
]


@pytest.mark.parametrize("system", [DOUBLE_PENDULUM, lagjax.System(double_pendulum_by_places)])
def test_a_double_pendulum_is_that_of_the_chapter(system):
    assert lines_of(system, ANGLES, DOUBLE) == IN_THE_CHAPTER


def test_known_scenes_look_as_in_a_textbook():
    assert lines_of(CART, {"theta": 0.3, "x": 0.0}, {"M": 2.0, "m": 1.0, "l": 0.5}) == [
        "M[theta, theta] = m*l**2", "M[theta, x] = m*l*cos(theta)", "M[x, x] = M + m",
        "F[theta] = -9.81*m*l*sin(theta)", "F[x] = m*l*sin(theta)*theta_dot**2",
    ]  # fmt: skip
    assert lines_of(CENTRAL, {"x": 1.0, "y": 0.2}, {"m": 1.0, "k": 2.0})[2:] == [
        "F[x] = -k*x/(x**2 + y**2)**(3/2)", "F[y] = -k*y/(x**2 + y**2)**(3/2)",
    ]  # fmt: skip
    numbers = {"m": 1.0, "e": 2.0, "B": 0.5, "E": 0.1}
    assert lines_of(CHARGE, {"x": 1.0, "y": 0.2, "z": 0.0}, numbers)[3:] == [
        "F[x] = B*e*y_dot", "F[y] = -B*e*x_dot", "F[z] = E*e",
    ]  # fmt: skip
    assert lines_of(RUBBED, 1.0, {"m": 1.0, "k": 2.0, "l": 0.5, "c": 0.1}) == [
        "M[q, q] = m",
        "F[q] = -k*(q - l) - c*q_dot",
    ]
    assert lines_of(DRIVEN, 1.0) == ["M[q, q] = 1", "F[q] = 0.5*cos(2*t) - sin(q) - q_dot/3"]
    rod = scenes.cartesian_pendulum()
    assert lines_of(rod.system, rod.q0, rod.params)[3:] == [
        "f[rod] = -0.5*(q0**2 + q1**2 - l**2)/l", "G[rod, q0] = -q0/l", "G[rod, q1] = -q1/l",
        "gamma[rod] = (q0_dot**2 + q1_dot**2)/l",
    ]  # fmt: skip
    sphere = scenes.spherical_pendulum()
    assert lines_of(sphere.system, sphere.q0, sphere.params)[1:] == [
        "M[phi, phi] = m*l**2*sin(theta)**2",
        "F[theta] = m*l**2*sin(theta)*cos(theta)*phi_dot**2 - m*g*l*sin(theta)",
        "F[phi] = -2*m*l**2*sin(theta)*cos(theta)*phi_dot*theta_dot",
    ]


def test_parts_that_come_twice_have_names():
    equations = scenes.figure_eight().system.equations(
        np.ones((3, 2)), np.ones((3, 2)), params=scenes.figure_eight().params
    )
    assert equations.parts["x1"] == "(q00 - q10)**2 + (q01 - q11)**2"
    assert "x1**(3/2)" in equations.force["q00"]


def piecewise(q, v):
    return 0.5 * v**2 - jnp.where(q > 1.0, q**2, jnp.abs(q)) - jnp.maximum(q, 0.5) - 0.1 * jnp.minimum(q, -2.0)


PIECES = lagjax.System(piecewise, forces=lambda q, v: -0.3 * jnp.sign(v) - jnp.floor(q) + jnp.round(v) - v % 2.0)


def test_branches_stand_by_their_names():
    text = str(PIECES.equations(0.3, 0.2))
    for word in ("where(q > 1, ", "sign(q_dot)", "floor(q)", "round(q_dot)"):
        assert word in text
    require_equal(PIECES, 0.3, 0.2, spread=2.0, count=40)


NAMES = lagjax.System(
    lambda q, v, params: 0.5 * params["x"] * v["x"] ** 2 - params["t"] * q["x"] ** 2 * params["lambda"]
)


def test_names_that_coincide_are_told_apart():
    params = {"x": 2.0, "t": 0.5, "x1": 1.0, "lambda": 3.0, "sin": 4.0}
    equations = NAMES.equations({"x": 1.0}, {"x": 1.0}, params=params)
    assert equations.variables == ("q_x", "q_x_dot", "t", "lambda_", "sin_", "params_t", "params_x", "x1")
    assert r"\lambda" in equations.latex and "lambda_}" not in equations.latex
    require_equal(NAMES, {"x": 1.0}, {"x": 0.3}, params)


RATES = lagjax.System(lambda q, v, params: 0.5 * v["x"] ** 2 - params["x_dot"] * q["x"])


def test_a_parameter_is_not_taken_for_a_velocity():
    equations = RATES.equations({"x": 1.0}, {"x": 1.0}, params={"x_dot": 2.0})
    assert equations.variables == ("x", "x_dot", "t", "params_x_dot")
    require_equal(RATES, {"x": 1.0}, {"x": 0.3}, {"x_dot": 2.0})


def of_a_tree(q, v, params):
    power = q[0]["a"][1] ** params["n"]
    return 0.5 * v[0]["a"] @ v[0]["a"] + v[1] ** 2 * power - q[1] ** 2 * params["of"][1]


TREE = lagjax.System(of_a_tree)


def test_q_may_be_any_pytree_and_params_may_hold_whole_numbers():
    q = ({"a": np.array([1.1, 0.7])}, 0.4)
    require_equal(TREE, q, q, {"n": 3, "of": np.array([1.0, 2.0])})
    require_equal(TREE, q, q, {"n": 0.5, "of": np.array([1.0, 2.0])})


NUMBERS = lagjax.System(lambda q, v: 0.5 * v**2 - 3 * 0.1 * q - q**2 / 6 + 1e-9 * q**3 + 2.5e12 * q**4 - np.pi * q**5)
OSCILLATOR_OF_DIGITS = lagjax.System(lambda q, v: 0.5 * v**2 - 4.905 * q**2, forces=lambda q, v: -0.3 * v)


def test_numbers_print_short_and_come_back():
    """0.1 · 3 is 0.30000000000000004, a third is a fraction, and large and small ones have exponents."""
    (force,) = NUMBERS.equations(1.0, 1.0).force.values()
    assert force == "3e-9*q**2 + 1e13*q**3 - q/3 - 15.707963267948966*q**4 - 0.3"
    require_equal(NUMBERS, 1.0, 1.0)


def test_numbers_of_float32_have_its_digits():
    with jax.enable_x64(False):
        assert OSCILLATOR_OF_DIGITS.equations(1.0, 1.0).force["q"] == "-9.81*q - 0.3*q_dot"


ENDLESS = lagjax.System(lambda q, v: 0.5 * v**2 - jnp.where(q == jnp.inf, 1.0, q**2))
SMOOTH = lagjax.System(lambda q, v: 0.5 * v**2 - jnp.logaddexp(q, v) - jax.nn.softplus(2 * q))


def test_infinity_is_a_number_of_formulas():
    equations = ENDLESS.equations(0.3, 0.2)
    assert " == inf" in str(equations) and r"\infty" in equations.latex
    require_equal(ENDLESS, 0.3, 0.2)


def test_logarithms_of_sums_of_exponentials_are_one_function():
    equations = SMOOTH.equations(0.3, 0.2)
    assert "logistic" in str(equations) and "where" not in str(equations)
    require_equal(SMOOTH, 0.3, 0.2)


LOOKED_UP = lagjax.System(lambda q, v, params: 0.5 * v**2, forces=lambda q, v, params: jnp.interp(q, *params))


def test_tables_have_numbers_and_their_ends():
    knots, values = np.array([0.0, 0.5, 2.0]), np.array([1.0, 3.0, 0.0])
    equations = LOOKED_UP.equations(0.0, 0.0, params=(knots, values))
    assert equations.tables == {"table1": "params00 … params02", "table2": "params10 … params12"}
    assert "table1 = params00 … params02" in str(equations)
    known = FUNCTIONS | {"table1": lambda i: knots[int(i)], "table2": lambda i: values[int(i)], "q": 1.1}
    known["locate1"] = lambda x: np.searchsorted(knots, x, side="right") - 1.0
    known |= zip(equations.variables[-6:], [*knots, *values], strict=True)
    for name, text in equations.parts.items():
        known[name] = eval(text, known)
    np.testing.assert_allclose(eval(equations.force["q"], known), np.interp(1.1, knots, values), rtol=1e-15)


def test_a_notebook_shows_them_in_latex():
    text = DOUBLE_PENDULUM.equations(ANGLES, ANGLES, params=DOUBLE)._repr_latex_()
    assert text.startswith("$$\n\\begin{aligned}") and text.endswith("\\end{aligned}\n$$")
    assert r"\left(m_{1} + m_{2}\right) \, l_{1}^{2}" in text and r"\dot{\theta}_{2}^{2}" in text
    assert r"\cos\left(\theta_{1} - \theta_{2}\right)" in text
    kepler = scenes.kepler()
    assert (
        r"\frac{\mathrm{GM} \, q_{0}}" in kepler.system.equations(kepler.q0, kepler.qdot0, params=kepler.params).latex
    )


SORTED = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.linalg.svd(jnp.outer(q, q))[1][0])


def test_what_is_not_read_is_said():
    chain = scenes.chain(12)
    note = str(chain.system.equations(chain.q0, chain.qdot0, params=chain.params))
    assert "operations" in note and "to_c" in note
    assert "no formulas to read: " in str(SORTED.equations(np.ones(40), np.ones(40)))
    with pytest.raises(TypeError, match="one scalar"):
        shared.FREE.equations(np.ones(2), np.ones(2))


def test_sympy_reads_them():
    sympy = pytest.importorskip("sympy")
    equations = DOUBLE_PENDULUM.equations(ANGLES, ANGLES, params=DOUBLE)
    force = sympy.sympify(equations.force["theta2"], locals={name: sympy.Symbol(name) for name in equations.variables})
    assert sympy.diff(force, "theta1_dot").subs({"theta1": 0, "theta2": 0}) == 0
