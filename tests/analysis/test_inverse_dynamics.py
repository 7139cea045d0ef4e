"""The forces that an acceleration takes: beside closed forms, SymPy's equations, Pinocchio and accelerations."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from scenes import weight_on

import lagjax
from lagjax import System

sys.path.insert(0, str(Path(__file__).parents[2]))
from examples import robot

G, M, A = 9.81, 1.5, 0.7


def double_pendulum(q, v, params):
    m, a = params["m"], params["a"]
    kinetic = 0.5 * m * a**2 * (2 * v[0] ** 2 + v[1] ** 2 + 2 * v[0] * v[1] * jnp.cos(q[0] - q[1]))
    return kinetic + m * G * a * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


DOUBLE, PARAMS = System(double_pendulum), {"m": M, "a": A}
# A bead on a circle: forces push it along, or press it against the wire.
BEAD = System(lambda q, v: 0.5 * v @ v - G * q[1], constraints=lambda q: {"wire": q @ q - 1.0})
Q, V = np.array([0.6, 0.8]), 0.5 * np.array([-0.8, 0.6])
ALONG = np.array([-0.8, 0.6])
SINGULAR = System(lambda q, v: 0.5 * v[0] ** 2 + v[1] * q[0] - q @ q)
SLIDE = System(lambda q, v: 0.5 * v @ v, constraints=lambda q, t: q[0] - jnp.sin(10 * t))
BALL = System(lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q: {"floor": q[1]})
RING = System(lambda q, v: 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum((q - jnp.roll(q, 1)) ** 2) - jnp.sum(jnp.cos(q)))
FALL = System(lambda q, v, params: 0.5 * params * v**2 - q)
STATES = np.random.default_rng(0).uniform(-2.0, 2.0, (3, 5, 2))


def closed_form(q, v, a):
    cos, sin = np.cos(q[0] - q[1]), np.sin(q[0] - q[1])
    inertial = np.array([2 * a[0] + a[1] * cos + v[1] ** 2 * sin, a[1] + a[0] * cos - v[0] ** 2 * sin])
    return M * A**2 * inertial + M * G * A * np.array([2 * np.sin(q[0]), np.sin(q[1])])


def of_double(q, v, a, params=PARAMS):
    return lagjax.inverse_dynamics(DOUBLE, q, v, a, params=params)


@pytest.mark.parametrize("how", [lambda f: f, jax.jit, lambda f: lambda *xs: jax.vmap(f)(*(x[None] for x in xs))[0]])
def test_a_double_pendulum_is_that_of_the_textbook(how):
    for q, v, a in STATES.transpose(1, 0, 2):
        np.testing.assert_allclose(how(of_double)(q, v, a), closed_form(q, v, a), rtol=1e-12, atol=1e-12)


def lagrangian_for_sympy(q, v, t):
    kinetic = 0.5 * (1 + q["x"] ** 2) * v["y"] ** 2 + 0.5 * jnp.exp(-t / 3) * v["x"] ** 2
    return kinetic + q["x"] * v["y"] - jnp.cos(q["x"] * q["y"])


AGAINST_SYMPY = System(lagrangian_for_sympy, dissipation=lambda q, v: (v["x"] ** 4 + v["y"] ** 4) / 20)


def test_it_is_what_sympy_derives():
    """Of a Lagrangian with an explicit time, a velocity-dependent potential and a dissipation."""
    t, (x, y) = sympy.Symbol("t"), sympy.symbols("x y", cls=sympy.Function)
    x, y = x(t), y(t)
    L = (1 + x**2) * y.diff(t) ** 2 / 2 + sympy.exp(-t / 3) * x.diff(t) ** 2 / 2 + x * y.diff(t) - sympy.cos(x * y)
    numbers = dict(zip((x, y, x.diff(t), y.diff(t), x.diff(t, 2), y.diff(t, 2)), STATES[:, 0].ravel(), strict=True))
    expected = [L.diff(c.diff(t)).diff(t) - L.diff(c) + c.diff(t) ** 3 / 5 for c in (x, y)]
    order = sorted(numbers, key=lambda c: -sympy.diff(c, t).count_ops() if c.is_Derivative else 0)
    order.sort(key=lambda c: -(c.derivative_count if c.is_Derivative else 0))
    expected = [e.subs([(c, numbers[c]) for c in order]).subs(t, 0.4) for e in expected]

    q, v, a = ({"x": x, "y": y} for x, y in STATES[:, 0])
    found = lagjax.inverse_dynamics(AGAINST_SYMPY, q, v, a, t=0.4)
    np.testing.assert_allclose([found["x"], found["y"]], np.array(expected, float), rtol=1e-12)


def test_a_robot_takes_what_it_takes_in_pinocchio():
    if importlib.util.find_spec("pinocchio") is None:
        pytest.skip("pinocchio is not installed")
    of = robot.read(robot.ARM)
    theirs, scene, params = robot.Pinocchio(robot.ARM, of), robot.system(of), robot.parameters(of)
    for q, v, a in np.random.default_rng(1).uniform(-1.0, 1.0, (3, 3, len(of.moving))):
        found = lagjax.inverse_dynamics(scene, q, v, a, params=params)
        np.testing.assert_allclose(found, theirs.forces(q, v, a), rtol=1e-10, atol=1e-12)


def test_with_these_forces_the_acceleration_is_that():
    """And the power of all forces is the rate of the energy."""
    q, v, a = STATES[:, 1]
    tau = of_double(q, v, a)
    driven = System(double_pendulum, forces=lambda q, v: tau)
    np.testing.assert_allclose(driven.acceleration(q, v, params=PARAMS), a, rtol=1e-12)
    rates = jax.jvp(lambda q, v: DOUBLE.energy(q, v, params=PARAMS), (q, v), (v, a))[1]
    np.testing.assert_allclose(tau @ v, rates, rtol=1e-12)


def test_derivatives():
    """∂τ/∂q̈ is M in both modes; those by q and q̇ are those of the closed form, the second ones as well."""
    q, v, a = STATES[:, 2]
    mass = DOUBLE.mass_matrix(q, v, params=PARAMS)
    for jacobian in (jax.jacfwd, jax.jacrev):
        found = jax.jit(jacobian(of_double, (0, 1, 2)))(q, v, a)
        np.testing.assert_allclose(found[2], mass, rtol=1e-13, atol=1e-14)
        for k in (0, 1):
            step = [1e-6 * np.eye(2)[i] for i in range(2)]
            sides = [[closed_form(*(x + s * d if j == k else x for j, x in enumerate((q, v, a)))) for d in step]
                     for s in (1, -1)]  # fmt: skip
            numeric = (np.array(sides[0]) - np.array(sides[1])).T / 2e-6
            np.testing.assert_allclose(found[k], numeric, atol=1e-7)
    forces = lambda q: of_double(q, v, a)[0]
    for second in (jax.hessian(forces), jax.jacrev(jax.grad(forces)), jax.jacrev(jax.jacfwd(forces))):
        angle = q[0] - q[1]
        bend = M * A**2 * (a[1] * np.cos(angle) + v[1] ** 2 * np.sin(angle))
        right = [[-bend - 2 * M * G * A * np.sin(q[0]), bend], [bend, -bend]]
        np.testing.assert_allclose(jax.jit(second)(q), right, rtol=1e-10)
    slope = jax.grad(lambda m: of_double(q, v, a, {"m": m, "a": A})[0])(M)
    np.testing.assert_allclose(slope, closed_form(q, v, a)[0] / M, rtol=1e-12)


def test_float32_without_doubles():
    with jax.enable_x64(False):
        q, v, a = STATES[:, 3].astype("float32")
        for call in (of_double, jax.jit(of_double)):
            found = call(q, v, a)
            assert found.dtype == np.float32
            np.testing.assert_allclose(found, closed_form(q, v, a), rtol=3e-7)


def test_a_singular_mass_matrix_is_no_obstacle():
    (x, y), (u, w), (a, _) = STATES[:, 0]
    np.testing.assert_allclose(lagjax.inverse_dynamics(SINGULAR, *STATES[:, 0]), [a - w + 2 * x, u + 2 * y], rtol=1e-14)


# ---- constraints ---------------------------------------------------------------------------------------------------


def test_the_constraint_carries_all_that_it_can():
    own = np.asarray(BEAD.acceleration(Q, V))
    np.testing.assert_allclose(lagjax.inverse_dynamics(BEAD, Q, V, own), 0.0, atol=1e-14)
    found = lagjax.inverse_dynamics(BEAD, Q, V, own + 2.0 * ALONG)
    np.testing.assert_allclose(found, 2.0 * ALONG, rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(lagjax.inverse_dynamics, 3)(BEAD, Q, V, own), np.eye(2), atol=1e-14)


def test_the_force_is_the_shortest_in_the_metric_of_the_inverse_mass():
    mass = np.array([[2.0, 0.4], [0.4, 1.0]])
    lagrangian = lambda q, v: 0.5 * v @ mass @ v - q[0]
    system = System(lagrangian, constraints=lambda q: q[0] + 2 * q[1])
    a = np.array([2.0, -1.0])
    tau = lagjax.inverse_dynamics(system, np.zeros(2), np.zeros(2), a)
    normal = np.array([1.0, 2.0])
    assert abs(normal @ np.linalg.solve(mass, tau)) < 1e-14
    driven = System(lagrangian, forces=lambda q, v: tau, constraints=lambda q: q[0] + 2 * q[1])
    np.testing.assert_allclose(driven.acceleration(np.zeros(2), np.zeros(2)), a, rtol=1e-13)


def test_friction_that_reads_the_multiplier_is_counted():
    def friction(q, v, multipliers):
        along = jnp.stack([-q[1], q[0]])
        return -0.2 * jnp.abs(2 * multipliers["wire"]) * jnp.sign(v @ along) * along

    bead = lambda more: weight_on(
        constraints=lambda q: {"wire": q @ q - 1.0},
        forces=lambda q, v, multipliers: friction(q, v, multipliers) + more,
    )
    a = np.asarray(bead(np.zeros(2)).acceleration(Q, V)) + 1.5 * ALONG
    tau = lagjax.inverse_dynamics(bead(np.zeros(2)), Q, V, a)
    np.testing.assert_allclose(bead(tau).acceleration(Q, V), a, rtol=1e-12)


def test_an_acceleration_that_a_constraint_forbids_is_an_error():
    a = np.asarray(BEAD.acceleration(Q, V)) + np.array([0.1, 0.0])
    with pytest.raises(ValueError, match=r"violates the constraint constraints\['wire'\]"):
        lagjax.inverse_dynamics(BEAD, Q, V, a)
    assert np.isnan(jax.jit(lagjax.inverse_dynamics)(BEAD, Q, V, a)).all()
    assert np.isnan(jax.vmap(lambda a: lagjax.inverse_dynamics(BEAD, Q, V, a))(a[None])).all()
    # What the sentence advises.
    free = lambda q, v: 0.5 * v @ v - G * q[1]
    tau = lagjax.inverse_dynamics(System(free), Q, V, a)
    pushed = System(free, constraints=lambda q: {"wire": q @ q - 1.0}, forces=lambda q, v: tau)
    nearest = pushed.acceleration(Q, V)
    assert np.isfinite(lagjax.inverse_dynamics(BEAD, Q, V, nearest)).all()


def test_rounding_is_no_violation():
    """γ is −100 sin 10t, whose value at a zero of the sine is that of the rounding of t."""
    q, v, t = np.zeros(2), np.array([-10.0, 0.0]), np.pi / 10
    np.testing.assert_allclose(lagjax.inverse_dynamics(SLIDE, q, v, np.array([0.0, 1.0]), t=t), [0.0, 1.0], atol=1e-12)
    with pytest.raises(ValueError, match="violates"):
        lagjax.inverse_dynamics(SLIDE, q, v, np.array([1e-8, 0.0]), t=t)


def test_contacts_that_press_are_held_and_open_ones_left_out():
    v, a = np.array([1.0, 0.0]), np.array([2.0, 0.0])
    np.testing.assert_allclose(lagjax.inverse_dynamics(BALL, np.zeros(2), v, a), [2.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(lagjax.inverse_dynamics(BALL, np.array([0.0, 1.0]), v, a), [2.0, G], rtol=1e-14)
    with pytest.raises(ValueError, match=r"contacts\['floor'\] is closed at this state"):
        lagjax.inverse_dynamics(BALL, np.zeros(2), v, np.array([0.0, 1.0]))


# ---- scenes of all kinds -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["array", "scalar", "auto"])
def test_every_form_of_a_scene_gives_the_same(path):
    system = System(double_pendulum, path=path)
    q, v, a = STATES[:, 4]
    found = lagjax.inverse_dynamics(system, q, v, a, params=PARAMS)
    np.testing.assert_allclose(found, closed_form(q, v, a), rtol=1e-12)


def test_a_large_scene_of_neighbours():
    q, v, a = np.random.default_rng(2).normal(size=(3, 1500))
    right = a + 2 * q - np.roll(q, 1) - np.roll(q, -1) - np.sin(q)
    np.testing.assert_allclose(lagjax.inverse_dynamics(RING, q, v, a), right, atol=1e-12)


def test_along_a_path():
    """A bead's own accelerations take nothing; members of a batch with parameters of their own; what is not allowed."""
    run = lagjax.simulate(BEAD, Q, V, np.linspace(0.0, 1.0, 4))
    own = jax.vmap(BEAD.acceleration)(run.q, run.qdot)
    np.testing.assert_allclose(run.required_forces(own), 0.0, atol=1e-13)
    with pytest.raises(ValueError, match="At t = 0 qddot violates"):
        run.required_forces(own + 1.0)
    with pytest.raises(ValueError, match="must have the structure and the shapes"):
        run.required_forces(own[:2])
    masses, zeros = np.arange(1.0, 4.0), np.zeros(3)
    runs = lagjax.simulate_batch(FALL, zeros, zeros, np.linspace(0.0, 1.0, 4), masses, batch_axes=(0, 0, 0))
    required = lambda runs: runs.required_forces(np.ones((3, 4)))
    for call in (required, jax.jit(required)):
        np.testing.assert_allclose(call(runs), np.repeat(masses[:, None] + 1.0, 4, axis=1), rtol=1e-14)


def test_structures_that_differ_are_named():
    with pytest.raises(ValueError, match=r"q has shape \(2,\), but its acceleration has shape \(3,\)"):
        of_double(Q, V, np.zeros(3))
    with pytest.raises(ValueError, match="q and qddot must have the same structure"):
        of_double(Q, V, {"a": 1.0})
