"""What Lagrangians conserve, and which of them are of one motion: what textbooks say, and nothing else."""

import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
from scenes import FREE, FREE_POINTS, KEPLER

import lagjax


def names(system, q, qdot, params=None, **options):
    return [c.name for c in lagjax.conserved_quantities(system, q, qdot, params, **options)]


TOP = lagjax.System(
    lambda q, v: (
        0.5 * (v["th"] ** 2 + v["ph"] ** 2 * jnp.sin(q["th"]) ** 2)
        + 0.3 * (v["ps"] + v["ph"] * jnp.cos(q["th"])) ** 2
        - jnp.cos(q["th"])
    )
)


def bodies(q, v, params):
    d = q[:, None] - q[None]
    r = jnp.sqrt(jnp.sum(d**2, -1) + jnp.eye(len(q)))
    pairs = jnp.where(jnp.eye(len(q)) > 0, 0.0, params[:, None] * params / r)
    return 0.5 * jnp.sum(params[:, None] * v**2) + 0.5 * jnp.sum(pairs)


BODIES = lagjax.System(bodies)
BOOSTED = lagjax.System(lambda q, v, t: 1.5 * (v + 3 * q) ** 2 - 13.5 * q**2 + v * jnp.sin(t) + q * jnp.cos(t))
FIELD = lagjax.System(lambda q, v: 0.5 * v @ v + 0.7 * (q[0] * v[1] - q[1] * v[0]))
HEAVY = lagjax.System(lambda q, v: 0.5 * (v[0] ** 2 + 2 * v[1] ** 2) + 1 / jnp.sqrt(jnp.sum(q**2)))
WAVE = lagjax.System(lambda q, v, t: 0.5 * v @ v - jnp.cos(q[0] - t) - q[1] ** 2)
CURL = lagjax.System(lagrangians.free_particles, forces=lambda q, v: jnp.array([q[1], -q[0]]))
INVERSE_SQUARE = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 / (q @ q))
TODA = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.sum(jnp.exp(q - jnp.roll(q, -1))))
DAMPED = lagjax.System(lambda q, v, t: jnp.exp(0.4 * t) * (0.5 * v**2 - 0.5 * q**2))  # Caldirola and Kanai
HIDDEN = lagjax.System(lambda q, v: 0.5 * v @ v + jnp.cos(q[0]) * v[0] * q[1] + jnp.sin(q[0]) * v[1])
DRAG = lagjax.System(lagrangians.weight, forces=lambda q, v: jnp.array([0.0, -v[1]]))
SPHERE = lagjax.System(lambda q, v: 0.5 * v @ v - 9.81 * q[2], constraints=lambda q: q @ q - 1)
SPHERICAL = lagjax.System(lambda q, v: 0.5 * (v["th"] ** 2 + (jnp.sin(q["th"]) * v["ph"]) ** 2))
SPRING = lagjax.System(lambda q, v: 0.5 * v**2 + 0.5 * q**2)
WEDGE = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.abs(q[0]))
SLOPE = lagjax.System(lambda q, v: 0.5 * v @ v - q[0])
GALILEAN = [
    "energy",
    *(f"momentum along axis {i}" for i in range(3)),
    *(f"angular momentum in the plane {ij}" for ij in ("01", "02", "12")),
    *(f"centre of mass along axis {i}" for i in range(3)),
]


# ---- the heart -------------------------------------------------------------------------------------------------------


def test_kepler_conserves_energy_and_angular_momentum():
    q, qdot = np.array([1.0, 0.0]), np.array([0.0, 1.2])
    energy, turning = lagjax.conserved_quantities(KEPLER, q, qdot)
    assert (energy.name, turning.name) == ("energy", "angular momentum in the plane 01")
    assert energy.gauge is None and turning.gauge is None
    np.testing.assert_allclose([energy.charge(q, qdot), turning.charge(q, qdot)], [0.72 - 1, 1.2], rtol=1e-14)


def test_a_boost_is_the_same_motion():
    same = lagjax.same_motion(FREE, BOOSTED, 0.0, 1.0)
    assert same.same is True and same
    np.testing.assert_allclose(same.factor, 1 / 3, rtol=1e-13)


# ---- conserved quantities --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_drift_along_a_trajectory():
    q, qdot = np.array([1.0, 0.0]), np.array([0.0, 1.2])
    found = lagjax.conserved_quantities(KEPLER, q, qdot)
    run = lagjax.simulate(KEPLER, q, qdot, np.linspace(0.0, 20.0, 11), rtol=1e-12)
    assert all(c.drift(run) < 1e-11 for c in found)
    assert "largest drift" in found.report(run)
    batch = lagjax.simulate_batch(KEPLER, np.stack([q, 1.1 * q]), np.stack([qdot, qdot]), run.ts, rtol=1e-12)
    assert found[1].drift(batch).shape == (2,)


@pytest.mark.slow
def test_bodies_have_ten_galilean_charges():
    q, v = (jax.random.normal(jax.random.key(k), (3, 3)) for k in range(2))
    masses = np.array([1.0, 2.0, 3.0])
    found = lagjax.conserved_quantities(BODIES, q, v, masses)
    assert [c.name for c in found] == GALILEAN
    assert [c.gauge is not None for c in found] == [False] * 7 + [True] * 3
    np.testing.assert_allclose(found[7].gauge(q, 0.0, masses), -masses @ q[:, 0], rtol=1e-13)
    centre = found[7].charge(q, v, 2.0, masses)  # M X − P t
    np.testing.assert_allclose(centre, masses @ q[:, 0] - 2 * masses @ v[:, 0], rtol=1e-12)
    assert names(FREE_POINTS, np.ones((1, 3)), np.ones((1, 3)))[0] == "energy"


@pytest.mark.slow
def test_twenty_bodies():
    q, v = np.random.default_rng(0).normal(size=(2, 20, 3))
    assert names(BODIES, q, v, np.linspace(1.0, 2.0, 20)) == GALILEAN


@pytest.mark.slow
def test_symmetric_top():
    state = {"th": 0.8, "ph": 0.0, "ps": 0.0}, {"th": 0.1, "ph": 0.5, "ps": 2.0}
    assert names(TOP, *state) == ["energy", "momentum of q['ph']", "momentum of q['ps']"]
    assert lagjax.cyclic_coordinates(TOP, *state) == ("q['ph']", "q['ps']")


@pytest.mark.slow
def test_charge_in_a_uniform_field():
    q, v = np.array([1.0, 0.5, 0.0]), np.array([1.0, 0.5, 0.2])
    found = {c.name: c for c in lagjax.conserved_quantities(FIELD, q, v)}
    momenta = [f"momentum of q[{i}]" for i in range(3)]
    assert list(found) == ["energy", *momenta, "angular momentum in the plane 01", "centre of mass along axis 2"]
    assert [found[name].gauge is not None for name in momenta] == [True, True, False]
    np.testing.assert_allclose(found[momenta[0]].charge(q, v), v[0] - 1.4 * q[1], rtol=1e-13)
    run = lagjax.simulate(FIELD, q, v, np.linspace(0.0, 5.0, 6), rtol=1e-12)
    assert all(c.drift(run) < 1e-11 for c in found.values())


@pytest.mark.slow
def test_what_is_no_symmetry_is_not_reported():
    assert names(HEAVY, np.array([1.0, 0.0]), np.array([0.0, 1.2])) == ["energy"]


def general(q, v, params):
    mass = params["m"] @ params["m"].T + jnp.eye(3)
    waves = jnp.sum(params["a"] * jnp.cos(params["k"] @ q + params["f"]))
    return 0.5 * v @ mass @ v + waves + jnp.sum(params["c"] * jnp.sin(params["k"] @ q)) * (params["b"] @ v)


RANDOM = lagjax.System(general)


@pytest.mark.slow
def test_no_false_report_on_random_systems():
    for seed in range(25):
        draw = np.random.default_rng(seed).normal
        shapes = {"m": (3, 3), "a": (4,), "k": (4, 3), "f": (4,), "c": (4,), "b": (3,)}
        params = {name: draw(size=shape) for name, shape in shapes.items()}
        assert names(RANDOM, np.asarray(draw(size=3)), np.asarray(draw(size=3)), params) == ["energy"], seed


def screw(q, v):
    return 0.5 * v @ v - jnp.cos(jnp.arctan2(q[1], q[0]) - 2 * q[2]) * (q[0] ** 2 + q[1] ** 2)


SCREW = lagjax.System(screw)


@pytest.mark.slow
def test_combinations():
    found = names(SCREW, jnp.array([1.0, 0.3, 0.2]), jnp.array([1.0, 0.5, 0.2]))
    assert found == ["energy", "combination: +0.5 translation of q[2], +1 rotation from q[0] to q[1]"]
    assert names(WAVE, np.ones(2), np.ones(2)) == ["combination: +1 time translation, +1 translation of q[0]"]


def attract(q, v, params):
    return -params * q / jnp.sum(q**2) ** 1.5


KEPLER_BY_FORCE = lagjax.System(lagrangians.free_particles, forces=attract)


@pytest.mark.slow
def test_forces_with_a_potential_conserve_what_l_would():
    """Kepler's force, on an orbit whose chords pass the centre: the energy is that of L = T − V but for a constant."""
    state = np.array([1.0, 0.0]), np.array([0.0, 1.2])
    found = {c.name: c for c in lagjax.conserved_quantities(KEPLER_BY_FORCE, *state, 1.3)}
    assert list(found) == ["energy", "angular momentum in the plane 01"]
    run = lagjax.simulate(KEPLER_BY_FORCE, *state, np.linspace(0.0, 20.0, 50), 1.3)
    energy = jax.jit(jax.vmap(lambda q, v: found["energy"].charge(q, v, params=1.3)))(run.q, run.qdot)
    exact = 0.5 * np.sum(run.qdot**2, axis=1) - 1.3 / np.linalg.norm(run.q, axis=1)
    np.testing.assert_allclose(energy - energy[0], exact - exact[0], atol=1e-9)
    by_params = jax.jit(jax.grad(lambda k: found["energy"].charge(run.q[7], run.qdot[7], params=k)))(1.3)
    np.testing.assert_allclose(by_params, 1.0 - 1 / np.linalg.norm(run.q[7]), rtol=1e-9)
    assert "energy" not in names(CURL, *state)


def test_a_dilation():
    """De Alfaro, Fubini & Furlan, Nuovo Cimento A 34 (1976) 569: D = h t − ½ p·q of an inverse square."""
    state = np.array([1.0, 0.0]), np.array([0.2, 1.2])
    found = {c.name: c for c in lagjax.conserved_quantities(INVERSE_SQUARE, *state)}
    assert list(found) == ["energy", "angular momentum in the plane 01", "dilation"]
    np.testing.assert_allclose(found["dilation"].charge(*state, 2.0), 2.0 * (0.5 * 1.48 + 0.5) - 0.5 * 0.2, rtol=1e-12)


LOGARITHM = lagjax.System(lambda q, v: 0.5 * v**2 + jnp.log(q))


@pytest.mark.slow
def test_toda_and_a_damped_oscillator():
    assert names(TODA, np.zeros(3), np.ones(3)) == ["energy", "total momentum", "centre of all coordinates"]
    assert names(DAMPED, 1.0, 0.5) == ["combination: +1 time translation, -0.2 scaling of q"]
    with pytest.raises(ValueError, match="finite at no state"):
        names(LOGARITHM, -5.0, 0.5)


@pytest.mark.slow
def test_a_gauge_that_is_no_polynomial():
    found = {c.name: c for c in lagjax.conserved_quantities(HIDDEN, jnp.ones(2), jnp.ones(2))}
    run = lagjax.simulate(HIDDEN, np.ones(2), np.array([0.3, 0.2]), np.linspace(0.0, 3.0, 4), rtol=1e-12)
    assert found["momentum of q[0]"].gauge is not None
    assert found["momentum of q[0]"].drift(run) < 1e-11


@pytest.mark.slow
def test_forces_and_constraints_are_respected():
    found = lagjax.conserved_quantities(DRAG, jnp.ones(2), jnp.ones(2))
    assert "momentum of q[0]" in [c.name for c in found] and "energy" not in [c.name for c in found]
    assert "not conserved: energy, by a symmetry of L that a force or a constraint breaks" in found.notes
    state = np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.0, 0.0])
    assert names(SPHERE, *state) == ["energy", "angular momentum in the plane 01"]


@pytest.mark.slow
def test_the_users_own_generators():
    state = {"th": 0.8, "ph": 0.3}, {"th": 0.1, "ph": 0.5}

    def about_x(q):
        return {"th": -jnp.sin(q["ph"]), "ph": -jnp.cos(q["ph"]) / jnp.tan(q["th"])}

    assert "about x" in names(SPHERICAL, *state, generators={"about x": about_x})
    charge = lagjax.noether_charge(SPHERICAL, about_x)
    run = lagjax.simulate(SPHERICAL, *state, np.linspace(0.0, 3.0, 4), rtol=1e-12)
    values = jax.vmap(charge)(run.q, run.qdot)
    np.testing.assert_allclose(values, values[0], atol=1e-11)
    with pytest.raises(TypeError, match="a generator must return the change of every coordinate"):
        lagjax.noether_charge(SPHERICAL, lambda q: q["th"])(*state)
    with pytest.raises(TypeError, match="generator must have the form"):
        lagjax.noether_charge(SPHERICAL, lambda: 1.0)


def test_charges_by_hand():
    # Kepler's scaling q → e^{2ε} q, t → e^{3ε} t is no symmetry of the action; a free particle's q/2, t is one.
    dilation = lagjax.noether_charge(FREE, lambda q, t: (0.5 * q, t))
    first, later = dilation(1.0, 2.0, 0.0), dilation(1.0 + 2.0 * 3.0, 2.0, 3.0)
    np.testing.assert_allclose(first, later, rtol=1e-14)
    boost = lagjax.noether_charge(FREE, lambda q, t: t, gauge=lambda q: q)
    np.testing.assert_allclose(boost(1.0, 2.0, 0.0), boost(7.0, 2.0, 3.0), rtol=1e-14)


# ---- the same motion -------------------------------------------------------------------------------------------------


NOTHING = lagjax.System(lambda q, v: q * v)


@pytest.mark.slow
def test_what_is_not_the_same_motion_is_said_where():
    other = lagjax.same_motion(FREE, SPRING, 0.0, 1.0)
    assert other.same is False and other.residual > 1e-2 and "the equation of q at q = (" in other.where
    assert not lagjax.same_motion(FREE, NOTHING, 0.0, 1.0).same
    assert not lagjax.same_motion(NOTHING, FREE, 0.0, 1.0).same


@pytest.mark.slow
def test_one_piece_is_not_the_whole():
    # From q = 1 on |q| looks like q, under whose constant force L changes by dG/dt when it is moved.
    conserved = lagjax.conserved_quantities(WEDGE, np.array([1.0, 0.2]), np.array([0.3, 1.0]))
    assert [one.name for one in conserved] == ["energy", "momentum of q[1]", "centre of mass along axis 1"]
    assert "piecewise" in str(conserved)
    assert not lagjax.same_motion(WEDGE, SLOPE, np.array([1.0, 0.2]), np.array([0.3, 1.0]))
