"""Accelerations by the recursion in a Lagrangian, against M q̈ = F with M as a whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax import scenes
from lagjax._equations import Accelerations, columns_of, derivation_of, numbers_of
from lagjax._interface import Layout


def of(system, q, qdot, params=None):
    return derivation_of(system, Layout.from_state(q, qdot), params)


def chain(n):
    scene = scenes.chain(n)
    return scene.system, scene.params


def beam(n):
    """Links with the velocities of their middles, which are half of the first one and differences of the others."""

    def lagrangian(q, qdot):
        vx, vy = -jnp.sin(q) * qdot, jnp.cos(q) * qdot
        x, y = jnp.cumsum(vx) - 0.5 * vx, jnp.cumsum(vy) - 0.5 * vy
        return 0.5 * jnp.sum(x**2 + y**2) + jnp.sum(qdot**2) / 24 - 3.0 * jnp.sum(jnp.diff(q, prepend=0.0) ** 2)

    return lagjax.System(lagrangian), None


def tree(n):
    """Rotors with shafts that branch, in a turning frame, with a velocity that is squared apart and a magnetic term."""

    def lagrangian(q, qdot, t):
        total, speeds = 0.0, []
        for k in range(n):
            before = speeds[(k - 1) // 2] if k else 0.1 * jnp.sin(t)
            speeds.append(jnp.cos(q[k]) * qdot[k] + before + 0.3 * q[k])
            total = total + 0.5 * (1 + k) * speeds[k] ** 2 + 0.05 * qdot[k] ** 2
        return total + jnp.sum(jnp.sin(q) * qdot) - 0.5 * jnp.sum(q**2)

    return lagjax.System(lagrangian), None


def relativistic(n):
    """A chain whose kinetic energies are not quadratic in its velocities."""

    def lagrangian(q, qdot):
        vx, vy = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
        return jnp.sum(0.5 * (vx**2 + vy**2) + 1e-3 * (vx**2 + vy**2) ** 2) + jnp.sum(jnp.cos(q))

    return lagjax.System(lagrangian), None


def gimbals(n):
    """Rings in rings with full matrices of inertia: ½ ω·(Iω), where no component of ω is squared in the trace."""
    axes = np.eye(3)[np.arange(n) % 3]
    inertias = [np.diag([1.0, 2.0, 2.5]) + 0.1 * (k + 1) for k in range(n)]

    def lagrangian(q, qdot):
        omega, total = jnp.zeros(3), 0.0
        for k, a in enumerate(axes):
            turned = jnp.cos(q[k]) * omega + (1 - jnp.cos(q[k])) * a * (a @ omega) - jnp.sin(q[k]) * jnp.cross(a, omega)
            omega = turned + a * qdot[k]
            total = total + 0.5 * omega @ (inertias[k] @ omega)
        return total

    return lagjax.System(lagrangian), None


def products(n):
    """Velocities built one from another, of which only products of different ones are in the energy."""

    def lagrangian(q, qdot):
        a, b, total = 0.0, 0.0, 0.0
        for k in range(0, n, 2):
            a = jnp.cos(q[k]) * a + qdot[k] + qdot[k + 1]
            b = jnp.cos(q[k + 1]) * b + qdot[k] - 2.0 * qdot[k + 1]
            total = total + a * b
        return total - jnp.sum(q**2)

    return lagjax.System(lagrangian), None


@pytest.mark.parametrize("make", [chain, beam, tree, relativistic, gimbals])
def test_accelerations_are_those_of_the_whole_mass_matrix(make):
    n = 12
    system, params = make(n)
    rng = np.random.default_rng(0)
    q, qdot, t = rng.uniform(-2, 2, (3, n)), rng.uniform(-1, 1, (3, n)), 0.3
    derivation = of(system, q[0], qdot[0], params)
    program, columns = derivation.accelerations.program, columns_of(q, qdot, t, numbers_of(params))
    assert program.otherwise is not None  # M as a whole is what is left to others
    assert program.operations < program.complete.operations
    *found, singular = program.evaluate_many(columns)
    values = derivation.evaluate(["mass_matrix", "force"], columns)
    exact = np.linalg.solve(values["mass_matrix"], values["force"][:, :, None])[:, :, 0]
    condition = np.linalg.cond(values["mass_matrix"]).max()
    assert not np.any(singular)
    error = np.abs(np.array(found).T - exact).max()
    assert error <= 10 * condition * np.finfo(float).eps * np.abs(exact).max()


def test_an_energy_of_products_alone_is_left_to_the_whole_mass_matrix():
    system, _ = products(4)
    q, qdot = np.array([0.3, -0.4, 1.0, 0.2]), np.array([0.5, 0.1, -0.2, 0.7])
    assert "machine code" in str(system.explain(q, qdot))  # by elimination with pivots: M is not definite
    momentum_rate = jax.jvp(lambda q: jax.grad(system.lagrangian, 1)(q, qdot), (q,), (qdot,))[1]
    exact = np.linalg.solve(system.mass_matrix(q, qdot), jax.grad(system.lagrangian)(q, qdot) - momentum_rate)
    np.testing.assert_allclose(system.acceleration(q, qdot), exact, rtol=1e-12)


@pytest.mark.slow
def test_operations_grow_as_the_number_of_links():
    counts = [of(system, np.ones(n), np.ones(n), params).accelerations.program.operations
              for n in (16, 32, 48) for system, params in [chain(n)]]  # fmt: skip
    assert counts[2] - counts[1] == counts[1] - counts[0]


@pytest.mark.slow
def test_motions_and_derivatives_are_those_of_a_small_scene_without_recursion():
    # In other words, without what L computes twice, the same Lagrangian has no recursion.
    n, system = 7, chain(7)[0]
    first, second = np.triu_indices(n, 1)

    def expanded(q, qdot, params):
        m, l, g = params["m"], params["l"], params["g"]
        carried = jnp.cumsum(m[::-1])[::-1]
        pairs = carried[second] * l[first] * l[second] * jnp.cos(q[first] - q[second]) * qdot[first] * qdot[second]
        return 0.5 * jnp.sum(carried * l**2 * qdot**2) + jnp.sum(pairs) + g * jnp.sum(carried * l * jnp.cos(q))

    params = {"m": np.linspace(0.5, 1.5, n) / n, "l": np.full(n, 1 / n), "g": 9.81}
    q0, qdot0, ts = np.linspace(0.3, 1.2, n), np.zeros(n), np.linspace(0.0, 0.3, 3)
    one, other = lagjax.System(expanded), system
    assert of(one, q0, qdot0, params).accelerations.program.otherwise is None
    assert of(other, q0, qdot0, params).accelerations.program.otherwise is not None

    def end(system, params, q0):
        return lagjax.simulate(system, q0, qdot0, ts, params, rtol=1e-11).q[-1]

    np.testing.assert_allclose(end(other, params, q0), end(one, params, q0), rtol=1e-10)
    weights = np.arange(1.0, n + 1)
    slopes = [jax.grad(lambda q0, s=system: weights @ end(s, params, q0))(q0) for system in (one, other)]
    np.testing.assert_allclose(*slopes, rtol=1e-8)


@pytest.mark.slow
def test_a_link_without_mass_is_singular_and_says_so():
    system, params = chain(8)
    params = params | {"m": np.where(np.arange(8) < 7, 0.1, 0.0)}
    program = of(system, np.ones(8), np.ones(8), params).accelerations.program
    columns = columns_of(np.linspace(0.1, 1.0, 8)[None], np.ones((1, 8)), 0.0, numbers_of(params))
    assert program.evaluate_many(columns)[-1, 0] == 1.0
    with pytest.raises(Exception, match="singular"):
        lagjax.simulate(system, np.linspace(0.1, 1.0, 8), np.ones(8), np.linspace(0.0, 0.1, 3), params)


@pytest.mark.slow
def test_a_motion_that_fails_does_not_wait_for_the_elimination_of_the_whole_mass_matrix(monkeypatch):
    """Which takes n³/3 operations: for a hundred links a minute, to fail once more."""

    def asked_for(self):
        raise AssertionError("the program without the recursion was derived")

    monkeypatch.setattr(Accelerations, "general", property(asked_for))
    n, (system, params) = 8, chain(8)
    ends = lagjax.System(system.lagrangian.code.function, forces=lambda q, qdot, t: -jnp.sqrt(0.05 - t) * qdot)
    run = lagjax.simulate(ends, np.ones(n), np.zeros(n), np.linspace(0.0, 0.1, 3), params, throw=False)
    assert run.result == lagjax.RESULTS.nonfinite_state and float(run.end.t) == pytest.approx(0.05, abs=1e-6)


def test_an_energy_of_parts_that_is_negative_leaves_the_mass_matrix_to_decide():
    # Each velocity counts negative on its own, and M is positive definite all the same.
    def lagrangian(q, qdot):
        w = jnp.cumsum(jnp.cos(q) * qdot)
        return 0.5 * jnp.sum(qdot**2) * 20 - 0.1 * jnp.sum(w**2) - 0.5 * jnp.sum(q**2)

    n, rng = 8, np.random.default_rng(1)
    derivation = of(lagjax.System(lagrangian), np.ones(n), np.ones(n))
    columns = columns_of(rng.uniform(-1, 1, (5, n)), rng.uniform(-1, 1, (5, n)), 0.0, [])
    *found, singular = derivation.accelerations.program.evaluate_many(columns)
    exact = np.array(derivation.accelerations.program.complete.evaluate_many(columns)[:-1])
    usable = np.asarray(singular) == 0
    np.testing.assert_allclose(np.array(found)[:, usable], exact[:, usable], rtol=1e-10, atol=1e-12)
    run = lagjax.simulate(lagjax.System(lagrangian), np.ones(n), np.ones(n), np.linspace(0.0, 1.0, 3))
    assert run.ok


def test_the_program_has_the_derivative_of_the_whole_mass_matrix_in_jax():
    system, params = chain(7)
    program = of(system, np.ones(7), np.ones(7), params).accelerations.program
    assert program.otherwise is not None
    rng = np.random.default_rng(2)
    x, direction = rng.uniform(0.3, 1.2, (2, program.size))
    step = 1e-5 * direction[:, None] * np.array([-2, -1, 1, 2])
    ends = program.evaluate_many(list(x[:, None] + step))[:-1]
    expected = ends @ np.array([1, -8, 8, -1]) / 12e-5
    values, slopes = jax.jvp(lambda *xs: jnp.stack(program(*xs)[:-1]), tuple(x), tuple(direction))
    np.testing.assert_allclose(values, program.evaluate_many(list(x[:, None]))[:-1, 0], rtol=1e-11)
    np.testing.assert_allclose(slopes, expected, rtol=1e-7)
