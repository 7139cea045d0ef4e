"""The same motion in other coordinates, in phase space, and without its cyclic coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particles
from scenes import FREE, KEPLER
from scipy.integrate import solve_ivp

import lagjax

TIGHT = {"rtol": 1e-13, "atol": 1e-15}
TS = np.linspace(0.0, 5.0, 6)
START = np.array([1.0, 0.2]), np.array([0.0, 1.1])

CENTRAL = lagjax.System(lambda q, v: 0.5 * (v["r"] ** 2 + (q["r"] * v["phi"]) ** 2) + 1 / q["r"])
CIRCLE = lagjax.System(free_particles, constraints=lambda q: q @ q - 4.0)
ROD = lagjax.System(free_particles, constraints=lambda q: q @ q - 1)
TWO_DRAGS = lagjax.System(free_particles, forces=lambda q, v: -v, dissipation=lambda q, v: 0.1 * v @ v)
DRAG = lagjax.System(free_particles, forces=lambda q, v: -v)


def polar(p):
    return p["r"] * jnp.array([jnp.cos(p["phi"]), jnp.sin(p["phi"])])


def turned(p, t):
    return jnp.array([jnp.cos(t) * p[0] - jnp.sin(t) * p[1], jnp.sin(t) * p[0] + jnp.cos(t) * p[1]])


# ---- the heart -------------------------------------------------------------------------------------------------------


def test_the_energy_in_polar_coordinates():
    changed = lagjax.change_coordinates(KEPLER, polar)
    state = {"r": 2.0, "phi": 0.3}, {"r": 0.5, "phi": 0.7}
    np.testing.assert_allclose(changed.system.energy(*state), CENTRAL.energy(*state), rtol=1e-14)


def test_three_lines_each():
    for one in (lagjax.change_coordinates(KEPLER, polar), lagjax.hamiltonian(KEPLER)):
        assert len(repr(one).splitlines()) == 3 and "0x" not in repr(one)


# ---- coordinates -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_motion_in_polar_and_in_turning_coordinates():
    plain = lagjax.simulate(KEPLER, *START, TS, **TIGHT)
    for place, guess in ((polar, {"r": 1.0, "phi": 0.1}), (turned, np.ones(2))):
        changed = lagjax.change_coordinates(KEPLER, place)
        run = lagjax.simulate(changed.system, *changed.new_from_old(*START, guess), TS, **TIGHT)
        q, qdot = jax.vmap(changed.old_from_new)(run.q, run.qdot, TS)
        np.testing.assert_allclose(q, plain.q, atol=1e-11)
        np.testing.assert_allclose(qdot, plain.qdot, atol=1e-11)


@pytest.mark.slow
def test_forces_and_constraints_come_along():
    changed = lagjax.change_coordinates(TWO_DRAGS, polar)
    state = {"r": 2.0, "phi": 0.3}, {"r": 0.5, "phi": 0.7}
    q, qdot = changed.old_from_new(*state)
    power = TWO_DRAGS.generalized_force(q, qdot) @ qdot
    force = changed.system.generalized_force(*state)
    kinetic = {"r": 2.0 * 0.7**2, "phi": 0.0}  # ∂L/∂Q
    np.testing.assert_allclose(sum((force[k] - kinetic[k]) * state[1][k] for k in force), power, rtol=1e-13)
    assert np.abs(lagjax.change_coordinates(CIRCLE, polar).system.constraint_residual(*state)) < 1e-14
    with pytest.raises(ValueError, match="There are 1 new coordinates for 2 old ones"):
        lagjax.change_coordinates(KEPLER, lambda a: jnp.array([a, a])).new_from_old(*START, 1.0)
    lost, _ = changed.new_from_old(*START, {"r": 0.0, "phi": 0.1})
    assert not np.isfinite(lost["r"]) or np.isclose(abs(lost["r"]), np.sqrt(1.04))


# ---- phase space -----------------------------------------------------------------------------------------------------


def double_by_places(q, v, t, params):  # driven, and with a term linear in the velocities, so that p is not M q̇
    kinetic = v[0] ** 2 + jnp.cos(q[0] - q[1]) * v[0] * v[1] + 0.5 * v[1] ** 2
    return kinetic + params * (2 * jnp.cos(q[0]) + jnp.cos(q[1])) + jnp.sin(t) * q[1] * v[0]


DAMPED_DOUBLE = lagjax.System(double_by_places, forces=lambda q, v: -0.1 * v)


@pytest.mark.slow
def test_canonical_motions_obey_hamiltons_equations():
    canonical = lagjax.hamiltonian(DAMPED_DOUBLE)
    q0, v0, g = jnp.array([1.0, 0.5]), jnp.array([0.3, -0.2]), 9.81
    p0 = canonical.momentum(q0, v0, 0.0, g)
    np.testing.assert_allclose(canonical.velocity(q0, p0, 0.0, g), v0, atol=1e-15)
    run = canonical.simulate(q0, p0, TS, g, **TIGHT)
    assert run.ok
    rates = jax.jit(lambda t, z: jnp.concatenate(canonical.equations(z[:2], z[2:], t, g)))
    there = solve_ivp(rates, (0.0, 5.0), np.concatenate([q0, p0]), "DOP853", np.asarray(TS), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(np.concatenate([run.q, run.p], axis=1), there.y.T, atol=1e-9)
    slope = jax.jit(jax.grad(lambda p: canonical.simulate(q0, p, TS, g).p[-1, 0]))(p0)
    moved = [canonical.simulate(q0, p0.at[0].add(h), TS, g).p[-1, 0] for h in (1e-5, -1e-5)]
    np.testing.assert_allclose(slope[0], (moved[0] - moved[1]) / 2e-5, rtol=1e-5)


BOUNDED = lagjax.System(lambda q, v: -jnp.sqrt(1 - v @ v) - 0.5 * q @ q)


@pytest.mark.slow
def test_legendre_where_velocities_are_bounded():
    canonical = lagjax.hamiltonian(BOUNDED)
    q, v = jnp.array([1.0, 0.5]), jnp.array([0.9, -0.4])
    p = canonical.momentum(q, v)
    np.testing.assert_allclose(canonical.velocity(q, p), v, rtol=1e-12)
    np.testing.assert_allclose(canonical.energy(q, p), np.sqrt(1 + p @ p) + 0.5 * q @ q, rtol=1e-12)
    by_q, by_p = jax.grad(canonical.energy, argnums=(0, 1))(q, p)
    rate, force = canonical.equations(q, p)
    np.testing.assert_allclose(rate, by_p, rtol=1e-11)
    np.testing.assert_allclose(force, -by_q, rtol=1e-11)


# ---- without cyclic coordinates --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_central_problem_is_one_dimensional():
    state = {"r": 1.0, "phi": 0.3}, {"r": 0.1, "phi": 1.1}
    radial = lagjax.routhian(CENTRAL, *state)
    assert radial.names == ("q['r']",) and radial.cyclic == ("q['phi']",)
    s, sdot, params = radial.reduce(*state)
    assert s.shape == (1,)
    # r̈ = p²/r³ − 1/r²
    np.testing.assert_allclose(radial.system.acceleration(s, sdot, params=params), [1.1**2 - 1], rtol=1e-13)
    plain = radial.simulate(*state, TS, **TIGHT)
    run = lagjax.simulate(radial.system, s, sdot, TS, params, **TIGHT)
    np.testing.assert_allclose(run.q[:, 0], plain.q["r"], atol=1e-11)
    q, qdot = jax.vmap(lambda s, v, c: radial.restore(s, v, c, params))(run.q, run.qdot, plain.q["phi"][:, None])
    for name in ("r", "phi"):
        np.testing.assert_allclose(q[name], plain.q[name], atol=1e-11)
        np.testing.assert_allclose(qdot[name], plain.qdot[name], atol=1e-11)
    assert run.engine == "MachineCode"


@pytest.mark.slow
def test_what_cannot_be_reduced_is_said():
    with pytest.raises(ValueError, match="no coordinate is cyclic"):
        lagjax.routhian(KEPLER, *START)
    with pytest.raises(ValueError, match="every coordinate is cyclic"):
        lagjax.routhian(FREE, 0.0, 1.0)
    with pytest.raises(ValueError, match="without constraints, forces"):
        lagjax.routhian(DRAG, *START)
    with pytest.raises(ValueError, match="without constraints"):
        lagjax.hamiltonian(ROD)
