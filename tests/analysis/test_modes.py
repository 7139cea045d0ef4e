"""Equilibria, linearised motions and normal modes against closed forms, with their derivatives."""

import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
import scipy.linalg
from scenes import PENDULUM, PENDULUM_G, RAMP
from scipy.special import roots_laguerre
from sweeps import sweep

import lagjax
from lagjax._analysis import exponents_and_modes
from lagjax._equations import derivation_of
from lagjax._interface import Layout

G = 9.81


def double_pendulum(q, v, params):
    m1, m2, l1, l2, g = params
    kinetic = 0.5 * (m1 + m2) * l1**2 * v[0] ** 2 + m2 * l1 * l2 * jnp.cos(q[0] - q[1]) * v[0] * v[1]
    return kinetic + 0.5 * m2 * l2**2 * v[1] ** 2 + (m1 + m2) * g * l1 * jnp.cos(q[0]) + m2 * g * l2 * jnp.cos(q[1])


DOUBLE = lagjax.System(double_pendulum)
EQUAL = np.array([1.0, 1.0, 1.0, 1.0, G])


def double_frequencies(params):
    return lagjax.normal_modes(DOUBLE, jnp.zeros(2), params).frequencies


def closed_form(params):
    m1, m2, l1, l2, g = params
    alpha, beta = m2 / (m1 + m2), l2 / l1
    root = jnp.sqrt((1 - beta) ** 2 + 4 * alpha * beta)
    return jnp.sqrt(g / l1 * jnp.stack([1 + beta - root, 1 + beta + root]) / (2 * beta * (1 - alpha)))


def chain(q, v, params):
    """Equal beads on a hanging thread of n pieces, by their angles."""
    vx, vy, height = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v), -jnp.cumsum(jnp.cos(q))
    return 0.5 * jnp.sum(vx**2 + vy**2) - params * jnp.sum(height)


CHAIN = lagjax.System(chain)

HOOP = lagjax.System(lambda q, v, params: 0.5 * v**2 + 0.5 * (params * jnp.sin(q)) ** 2 + G * jnp.cos(q))


def hoop_rest(speed):
    return lagjax.equilibrium(HOOP, 1.0, speed).q


ROD = lagjax.System(lagrangians.weight_g, constraints=lambda q: {"rod": q @ q - 1.0})
BOND = lagjax.System(lambda q, v, params: 0.5 * v @ v - 0.5 * (q[1] - q[0] - params) ** 2)
FALLS = lagjax.System(lambda q, v: 0.5 * v["x"] ** 2 - G * q["x"])
SLOPE = lagjax.System(lambda q, v: 0.5 * v**2 - jnp.exp(-q))
DRIVEN = lagjax.System(lambda q, v, t: 0.5 * v**2 - 0.5 * (q - jnp.sin(t)) ** 2)


# ---- the heart -------------------------------------------------------------------------------------------------------


def test_equal_pendulums():
    modes = lagjax.normal_modes(DOUBLE, np.zeros(2), EQUAL)
    np.testing.assert_allclose(modes.frequencies**2 / G, [2 - np.sqrt(2), 2 + np.sqrt(2)], rtol=1e-13)
    np.testing.assert_allclose(modes.shapes[:, 0] / modes.shapes[:, 1], [1 / np.sqrt(2), -1 / np.sqrt(2)], rtol=1e-13)
    assert modes.stable and "oscillates" in str(modes)
    with pytest.raises(ValueError, match=r"q is not an equilibrium.*lagjax\.equilibrium"):
        lagjax.normal_modes(DOUBLE, np.array([0.1, 0.0]), EQUAL)


def test_bead_on_a_hoop():
    np.testing.assert_allclose(hoop_rest(5.0), np.arccos(G / 25), rtol=1e-14)


# ---- equilibria ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_derivatives_of_an_equilibrium():
    slope = 2 * G / 5**3 / np.sin(np.arccos(G / 25))
    np.testing.assert_allclose(jax.grad(hoop_rest)(5.0), slope, rtol=1e-13)
    np.testing.assert_allclose(jax.jacfwd(hoop_rest)(5.0), slope, rtol=1e-13)
    closed = jax.grad(jax.grad(lambda w: jnp.arccos(G / w**2)))(5.0)
    np.testing.assert_allclose(jax.grad(jax.grad(hoop_rest))(5.0), closed, rtol=1e-12)
    speeds = np.linspace(4.0, 6.0, 3)
    np.testing.assert_allclose(jax.jit(jax.vmap(hoop_rest))(speeds), np.arccos(G / speeds**2), rtol=1e-13)


@pytest.mark.slow
def test_equilibrium_on_a_constraint():
    down = lagjax.equilibrium(ROD, np.array([0.6, -0.8]), G)
    np.testing.assert_allclose(down.q, [0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(down.multipliers["rod"], -G / 2, rtol=1e-14)


@pytest.mark.slow
def test_a_family_of_equilibria_is_met_where_it_is_nearest():
    rest = lambda length: lagjax.equilibrium(BOND, jnp.array([0.0, 2.0]), length).q
    np.testing.assert_allclose(rest(1.0), [0.5, 1.5], atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(rest))(1.0), [-0.5, 0.5], atol=1e-12)


@pytest.mark.slow
def test_what_has_no_equilibrium_is_said():
    with pytest.raises(ValueError, match=r"no equilibrium.*force of q\['x'\] is not zero"):
        lagjax.equilibrium(FALLS, {"x": 1.0})
    with pytest.raises(ValueError, match="No equilibrium was found from q = 1"):
        lagjax.equilibrium(SLOPE, 1.0)
    lost = lagjax.equilibrium(SLOPE, 1.0, throw=False)
    assert not lost.ok and np.isnan(lost.q)
    with pytest.raises(ValueError, match="does not depend on the time"):
        lagjax.equilibrium(DRIVEN, 1.0)
    with pytest.raises(ValueError, match=r"q\['r'\]: has a velocity, but is not cyclic"):
        lagjax.equilibrium(ORBIT, {"r": 0.8, "phi": 1.0}, qdot={"r": 1.0, "phi": 1.0})


ORBIT = lagjax.System(lambda q, v: 0.5 * (v["r"] ** 2 + q["r"] ** 2 * v["phi"] ** 2) + 1 / q["r"])
PLANE = lagjax.System(
    lambda q, v, params: 0.5 * v @ v - 0.5 * q @ jnp.array([[params[0], params[2]], [params[2], params[1]]]) @ q
)
FIELD = lagjax.System(lambda q, v: 0.5 * v @ v + q[0] * v[1] - q[1] * v[0] - 0.5 * q @ q)
DAMPED = lagjax.System(lagrangians.oscillators, dissipation=lambda q, v, params: 0.5 * params * v @ v)
WEDGE = lagjax.System(lambda q, v: v["X"] ** 2 + v["X"] * v["x"] + v["x"] ** 2 - 0.5 * q["x"] ** 2)
SLIDING = lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - 0.5 * q @ q)
ROD_TWICE = lagjax.System(ROD.lagrangian.code.function, constraints=lambda q: [q @ q - 1.0, 2 * (q @ q) - 2.0])


@pytest.mark.slow
def test_steady_motion():
    turns = {"r": 0.0, "phi": 1.0}
    circle = lagjax.equilibrium(ORBIT, {"r": 0.8, "phi": 1.0}, qdot=turns)
    np.testing.assert_allclose(circle.q["r"], 1.0, rtol=1e-14)
    assert circle.q["phi"] == 1.0
    modes = lagjax.normal_modes(ORBIT, circle.q, qdot=turns)
    np.testing.assert_allclose(modes.frequencies, [0.0, 1.0], atol=1e-14)  # Kepler's orbits close
    assert modes.stable


@pytest.mark.slow
@pytest.mark.parametrize("spin", [1.9, 2.1])
def test_sleeping_top(spin):
    # Stable if and only if I3² ω3² > 4 I1 M g l; two angles that are regular at the upright top.
    def top(q, v):
        x, y = q
        z = jnp.sqrt(1 - x**2 - y**2)
        vz = -(x * v[0] + y * v[1]) / z
        turns = (x * v[1] - y * v[0]) / (1 + z)  # of the figure axis, at constant spin
        return 0.5 * (v[0] ** 2 + v[1] ** 2 + vz**2) - spin * turns - z

    modes = lagjax.normal_modes(lagjax.System(top), np.zeros(2))
    assert bool(modes.stable) == (spin > 2)
    s = np.roots([1, 0, spin**2 - 2, 0, 1])
    np.testing.assert_allclose(modes.frequencies, np.sort(s.imag)[2:], atol=2e-8)


# ---- modes -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_double_pendulums_and_their_derivatives():
    params = jax.random.uniform(jax.random.key(0), (20, 5), minval=0.3, maxval=3.0)
    many, exact = jax.vmap(double_frequencies), jax.vmap(closed_form)
    np.testing.assert_allclose(many(params), exact(params), rtol=1e-13)
    first, first_exact = (jax.vmap(jax.jacrev(f))(params) for f in (double_frequencies, closed_form))
    np.testing.assert_allclose(first, first_exact, atol=1e-12)
    over = lagjax.normal_modes(DOUBLE, np.array([np.pi, 0.0]), EQUAL)
    assert not over.stable and "grows" in str(over) and over.frequencies[0] == 0


@pytest.mark.slow
def test_design_for_a_frequency_by_gradient_descent():
    wanted = np.array([2.0, 7.0])

    @jax.jit
    def down(logs, _):
        miss = lambda x: jnp.sum(jnp.log(double_frequencies(jnp.array([1.0, *jnp.exp(x), 1.0, G])) / wanted) ** 2)
        value, slope = jax.value_and_grad(miss)(logs)
        return logs - 0.3 * slope, value

    logs, _ = jax.lax.scan(down, np.zeros(2), length=2000)
    designed = np.array([1.0, *np.exp(logs), 1.0, G])
    np.testing.assert_allclose(closed_form(designed), wanted, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 50])
def test_hanging_chain_of_beads(n):
    """ω² are the zeros of Laguerre's polynomial of degree n, in units of g/l."""
    zeros = np.sort(roots_laguerre(n)[0])
    modes = lagjax.normal_modes(CHAIN, np.zeros(n), 1.0)
    np.testing.assert_allclose(modes.frequencies**2, zeros, rtol=1e-12)
    if n == 10:
        lowest = jax.grad(lambda g: lagjax.normal_modes(CHAIN, jnp.zeros(n), g).frequencies[0])(1.0)
        np.testing.assert_allclose(lowest, 0.5 * np.sqrt(zeros[0]), rtol=1e-12)


@pytest.mark.slow
def angles_of_a_chain(q, qdot):
    """Equal links and masses: L in absolute angles, with a dense mass matrix."""
    sideways, upwards = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(sideways**2 + upwards**2) + G * jnp.sum(jnp.cumsum(jnp.cos(q)))


ANGLES = lagjax.System(angles_of_a_chain)


@pytest.mark.parametrize("n", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_a_chain_of_pendulums_in_angles(n):
    """Equal angles and a curve of angles, against M and K that are written by hand."""
    hanging = np.arange(n, 0.0, -1.0)
    squares = scipy.linalg.eigh(np.diag(G * hanging), np.minimum.outer(hanging, hanging), eigvals_only=True)
    modes = lagjax.normal_modes(ANGLES, np.zeros(n))
    np.testing.assert_allclose(modes.frequencies, np.sqrt(squares), rtol=1e-11)
    assert modes.shapes.dtype == float and modes.stable
    found = lagjax.linearize(ANGLES, np.zeros(n)).A[n:, :n]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(-found).real), squares, rtol=1e-9)
    rest = lagjax.equilibrium(ANGLES, 0.01 * np.cos(np.arange(n)))
    np.testing.assert_allclose(rest.q, 0, atol=1e-12)


def test_equal_frequencies_have_derivatives():
    total = lambda params: lagjax.normal_modes(PLANE, jnp.zeros(2), params).frequencies.sum()
    both = np.array([2.0, 2.0, 0.0])
    np.testing.assert_allclose(jax.grad(total)(both), np.array([1, 1, 0]) / np.sqrt(8), atol=1e-14)
    squares = lambda params: jnp.sum(lagjax.normal_modes(PLANE, jnp.zeros(2), params).frequencies ** 2)
    np.testing.assert_allclose(jax.hessian(squares)(np.array([2.0, 2.0, 0.0])), np.zeros((3, 3)), atol=1e-13)


@pytest.mark.slow
def test_gyroscopic_and_damped_modes():
    np.testing.assert_allclose(
        lagjax.normal_modes(FIELD, np.zeros(2)).frequencies, np.sqrt(2) + np.array([-1, 1]), rtol=1e-13
    )

    def modes(c):
        return lagjax.normal_modes(DAMPED, jnp.zeros(2), c)

    np.testing.assert_allclose(modes(0.1).frequencies, np.sqrt(1 - 0.0025), rtol=1e-13)
    np.testing.assert_allclose(modes(0.1).damping_ratios, 0.05, rtol=1e-13)
    np.testing.assert_allclose(modes(5.0).exponents[0].real, [-2.5 + np.sqrt(5.25), -2.5 - np.sqrt(5.25)], rtol=1e-13)
    slope = jax.grad(lambda c: modes(c).frequencies.sum())(0.1)
    np.testing.assert_allclose(slope, -0.1 / 2 / np.sqrt(1 - 0.0025), rtol=1e-12)


@pytest.mark.slow
def test_modes_on_constraints():
    def frequency(g):
        rest = lagjax.equilibrium(ROD, jnp.array([0.3, -0.9]), g)
        return lagjax.normal_modes(ROD, rest.q, g).frequencies[0]

    np.testing.assert_allclose(frequency(G), np.sqrt(G), rtol=1e-13)
    np.testing.assert_allclose(jax.grad(frequency)(G), 0.5 / np.sqrt(G), rtol=1e-12)
    np.testing.assert_allclose(lagjax.normal_modes(ROD_TWICE, np.array([0.0, -1.0]), G).frequencies, [np.sqrt(G)])


@pytest.mark.slow
def test_zero_modes_of_cyclic_coordinates():
    modes = lagjax.normal_modes(WEDGE, {"X": 0.3, "x": 0.0})
    np.testing.assert_allclose(modes.frequencies, [0.0, np.sqrt(2 / 3)], atol=1e-14)
    np.testing.assert_allclose(modes.shapes["X"][1] / modes.shapes["x"][1], -0.5, rtol=1e-13)
    assert modes.stable and "zero mode" in str(modes)


@pytest.mark.slow
def test_what_has_no_modes_is_said():
    with pytest.raises(ValueError, match="mass matrix is singular or not positive definite"):
        lagjax.normal_modes(SLIDING, np.zeros(2))
    down, twice = np.array([0.0, -1.0]), lambda q: [q @ q - 1.0, 2 * (q @ q) - 2.0]
    redundant = lagjax.System(lagrangians.weight_g, constraints=twice)
    with pytest.raises(ValueError, match="Drop the redundant ones"):
        jax.jit(lambda g: lagjax.normal_modes(redundant, down, g).frequencies)(G)


def molecule(q, v, params):
    masses = jnp.array([16.0, 1.0, 1.0])
    stretched = [jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2)) - r for i, j, r in ((0, 1, 1.0), (0, 2, 1.0), (1, 2, 1.5))]
    return 0.5 * jnp.sum(masses[:, None] * v**2) - 0.5 * params * sum(x**2 for x in stretched)


MOLECULE = lagjax.System(molecule)


@pytest.mark.slow
def test_a_molecule_has_three_zero_modes_in_the_plane():
    system, guess = MOLECULE, np.array([[0.0, 0.0], [0.8, 0.7], [-0.8, 0.6]])

    def frequencies(stiffness):
        return lagjax.normal_modes(system, lagjax.equilibrium(system, guess, stiffness).q, stiffness).frequencies

    found = frequencies(1.0)
    np.testing.assert_array_equal(found[:3], 0.0)
    np.testing.assert_allclose(jax.jacfwd(frequencies)(1.0), 0.5 * found, atol=1e-10)


@pytest.mark.slow
def test_linearization():
    q, v = jnp.array([0.3, 0.2]), jnp.array([1.0, 2.0])
    linear = lagjax.linearize(DOUBLE, q, v, EQUAL)

    def rate(y):
        return jnp.concatenate([y[2:], DOUBLE.acceleration(y[:2], y[2:], params=EQUAL)])

    np.testing.assert_allclose(linear.A, jax.jacfwd(rate)(np.concatenate([q, v])), atol=1e-13)
    np.testing.assert_allclose(linear.B[2:] @ linear.mass_matrix, np.eye(2), atol=1e-14)
    lower = np.linalg.solve(linear.mass_matrix, -linear.stiffness)
    np.testing.assert_allclose(linear.A[2:, :2], lower, atol=1e-13)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_eigenvalues_have_the_precision_of_the_matrix_on_accelerators_too(monkeypatch, dtype):
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *arrays, cpu, default: default(*arrays))
    values, vectors = exponents_and_modes(jnp.asarray([[0.0, 1.0], [-4.0, 0.0]], dtype))
    np.testing.assert_allclose(values, [2j, -2j], rtol=1e-6)
    assert values.dtype == vectors.dtype == np.result_type(dtype, np.complex64)


@pytest.mark.slow
def test_sympy_agrees():
    sympy = pytest.importorskip("sympy")
    a, b = sympy.symbols("a b")
    height = -2 * sympy.cos(a) - sympy.cos(b) * sympy.Rational(7, 10)
    mass = sympy.Matrix([[2, sympy.Rational(7, 10)], [sympy.Rational(7, 10), sympy.Rational(49, 100)]])
    stiffness = sympy.hessian(height, (a, b)).subs({a: 0, b: 0})
    squares = sorted(complex(x).real for x in sympy.roots((stiffness - sympy.Symbol("w") * mass).det()))
    found = double_frequencies(np.array([1.0, 1.0, 1.0, 0.7, 1.0]))
    np.testing.assert_allclose(found**2, squares, rtol=1e-13)


@pytest.mark.slow
def test_more_coordinates_in_one_array_than_are_unfolded():
    """Scenes of more than 256 coordinates in one array had no equations: an IndexError."""
    derivation = derivation_of(CHAIN, Layout.from_state(np.zeros(257), np.zeros(257)), np.ones(()))
    assert derivation.shape("mass_matrix") == (257, 257)


def test_a_structure_that_the_lagrangian_does_not_read():
    pendulum = PENDULUM
    with pytest.raises(TypeError, match=r"lagrangian was called with q\['th'\] of shape \(\)"):
        lagjax.equilibrium(pendulum, {"th": 1.0})


# ---- at borders ------------------------------------------------------------------------------------------------------


def _well(q, qdot):
    return 0.5 * qdot**2 - q**2


_PUSH = lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2 - jnp.maximum(q, 0.0) ** 2  # a stop that begins where q is at rest
JUMPS = "along dq: the force jumps"
ROUGH = {
    "dry friction": (lagjax.System(_well, forces=lambda q, qdot: -0.1 * jnp.sign(qdot)), JUMPS),
    "friction by D": (lagjax.System(_well, dissipation=lambda q, qdot: 0.1 * jnp.abs(qdot)), JUMPS),
    "a stop": (lagjax.System(_PUSH), "along q: the force has another slope"),
    "a table": (
        lagjax.System(_well, forces=lambda q, qdot: -jnp.interp(q, jnp.arange(-1.0, 2.0), jnp.array([-1.0, 0.0, 2.0]))),
        "along q: the force has another slope",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", sweep(ROUGH, kept=["a stop"]))
def test_nothing_is_linear_at_a_border(name):
    system, words = ROUGH[name]
    for function in (lagjax.normal_modes, lagjax.linearize):
        with pytest.raises(ValueError, match=rf"does not exist at this state.*{words}.* at .*test_modes\.py"):
            function(system, 0.0)
    assert np.isnan(jax.jit(lambda q: lagjax.normal_modes(system, q).frequencies)(0.0)).all()
    assert np.isnan(jax.jit(lambda q: lagjax.linearize(system, q).A)(0.0)[1]).all()


BEGINS = lagjax.System(lambda q, qdot: 0.5 * qdot**2, forces=lambda q, qdot: -(jnp.maximum(q, 0.0) ** 2))


def test_a_force_that_begins_without_a_slope_is_smooth():
    np.testing.assert_array_equal(lagjax.linearize(BEGINS, 0.0).A, [[0, 1], [0, 0]])


@pytest.mark.parametrize(
    "force, frequency",
    [
        (lambda q, qdot: -0.1 * qdot * jnp.abs(qdot), np.sqrt(2)),  # smooth at rest, though abs is not
        pytest.param(lambda q, qdot: -3 * jnp.maximum(q, 0.0) ** 2, np.sqrt(2), marks=pytest.mark.slow),
        pytest.param(lambda q, qdot: -jnp.clip(q, -1.0, 1.0), np.sqrt(3), marks=pytest.mark.slow),  # no border here
        (lambda q, qdot: -q * jnp.where(jnp.abs(qdot) < 1e-6, 1.0, 2.0), np.sqrt(3)),  # one that is beside
    ],
)
def test_borders_that_linearization_does_not_mind(force, frequency):
    found = lagjax.normal_modes(lagjax.System(_well, forces=force), 0.0).frequencies
    np.testing.assert_allclose(found, [frequency], atol=1e-12)


# ---- where a scene comes to rest -------------------------------------------------------------------------------------


def test_a_pendulum_comes_to_rest_below():
    pendulum = PENDULUM_G
    np.testing.assert_allclose(lagjax.equilibrium(pendulum, np.pi, 9.81).q, np.pi)  # where it is, upright
    np.testing.assert_allclose(np.cos(lagjax.equilibrium(pendulum, np.pi, 9.81, stable=True).q), 1.0)
    with pytest.raises(ValueError, match="leave qdot out"):
        lagjax.equilibrium(pendulum, 0.1, 9.81, qdot=0.0, stable=True)
    with pytest.raises(ValueError, match="cannot be traced"):
        jax.jit(lambda q: lagjax.equilibrium(pendulum, q, 9.81, stable=True).q)(0.1)
    with pytest.raises(ValueError, match="not come to rest"):
        lagjax.equilibrium(RAMP, 0.3, stable=True)


@pytest.mark.slow
def test_a_chain_hangs():
    """From a zig-zag and from above its supports: all rods below, and their angles those of a catenary of rods.

    The force in all rods has one horizontal part H, and the vertical parts rise by a weight at each node, so that the
    tangents of their angles are equally spaced.
    """
    n, span, weight = 12, 8.0, 9.81

    def lengths(q):
        nodes = jnp.concatenate([jnp.zeros((1, 2)), q, jnp.array([[span, 0.0]])])
        return jnp.sum(jnp.diff(nodes, axis=0) ** 2, axis=1) - 1.0

    chain = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - weight * jnp.sum(q[:, 1]), constraints=lengths)
    x = np.linspace(0.0, span, n + 1)[1:-1]
    for y in (0.7 * (-1.0) ** np.arange(n - 1), 2.0 * np.sin(np.pi * x / span)):
        rest = lagjax.equilibrium(chain, np.stack([x, y], axis=1), stable=True)
        nodes = np.concatenate([np.zeros((1, 2)), rest.q, [[span, 0.0]]])
        rods = np.diff(nodes, axis=0)
        assert (nodes[1:-1, 1] < 0).all()
        np.testing.assert_allclose(np.diff(rods[:, 1] / rods[:, 0], n=2), 0.0, atol=1e-9)
