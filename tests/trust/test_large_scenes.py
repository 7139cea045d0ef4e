"""What judges and explains a large scene goes by products with its matrices, and names the coordinate to blame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import FREE_POINTS

import lagjax
from lagjax._equations import Motion, Sample, derivation_of, sparse_spectrum
from lagjax._interface import Layout

SIZE, BLAMED = 1000, 37
Q0, QDOT0 = 0.3 * np.random.default_rng(1).normal(size=(2, SIZE))
TS = np.linspace(0.0, 1.0, 5)


@jax.custom_jvp
def quartic(q, off):
    return 0.25 * jnp.sum(q**4)


@quartic.defjvp
def _(primals, tangents):
    q, off = primals
    return quartic(q, off), jnp.sum(q**3 * (1 + off) * tangents[0])


def lattice(q, qdot, t, params):
    """A ring with masses of its own; a part of its derivative may be wrong, and a force may end."""
    springs = 0.5 * jnp.sum((q - jnp.roll(q, 1)) ** 2) + quartic(q, params["off"])
    return 0.5 * jnp.sum(params["mass"] * qdot**2) - springs - jnp.sum(jnp.sqrt(params["until"] - t))


RING = lagjax.System(lattice)
CHAIN = lagjax.System(
    lambda q, qdot: 0.5 * jnp.sum(qdot**2) - jnp.sum(q[:, 1]),
    constraints=lambda q: jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1) - 1.0,
)


def numbers(**changed):
    """The parameters of the ring, some with another value for the coordinate that is to be blamed."""
    params = {"mass": np.ones(SIZE), "off": np.zeros(SIZE), "until": np.full(SIZE, 9.0)}
    for name, value in changed.items():
        params[name][BLAMED] = value
    return params


@pytest.fixture(scope="module")
def run():
    return lagjax.simulate(RING, Q0, QDOT0, TS, numbers(mass=5.0))


def test_a_large_scene_explains_itself_in_groups():
    facts = RING.explain(Q0, QDOT0, params=numbers())
    assert facts.path == "array" and "diagonal" in facts.reason
    assert facts.mass_matrix == "constant, diagonal" and facts.mass_matrix_depends_on == ()
    assert (facts.cyclic, facts.velocity_terms, facts.explicit_time) == ((), False, True)
    assert "q[0] … q[999]" in str(facts) and len(str(facts)) < 1000


def kinetic_of_links(q, qdot):
    return 0.5 * jnp.sum((1 + q[:, 1:] ** 2) * qdot**2) - jnp.sum(q[:, 1])


def links(q):
    return jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1) - 2.0


LINKED = lagjax.System(kinetic_of_links, constraints=links, path="array")


def test_products_are_those_of_the_matrices():
    """A chain of links between two points: constraints, and a mass matrix that varies, against their arrays."""
    count = 60
    q = np.stack([np.arange(1.0, count + 1), np.random.default_rng(2).normal(size=count)], axis=1)
    v = np.random.default_rng(3).normal(size=q.shape)

    system, layout = LINKED, Layout.from_state(q, v)
    derivation = derivation_of(system, layout, None)
    assert derivation.form.is_sparse
    state = q.ravel(), v.ravel(), np.zeros(()), None
    names = ("energy_by_qdot", "mass_diagonal", "row_lengths", "unit_lengths", "multipliers", "acceleration")
    given = Sample.from_scene(system, layout, q.reshape(1, -1), v.reshape(1, -1), np.zeros(()), None)
    of = {name: value[0] for name, value in given.quantities(*names).items()}
    plain = Motion(*list(vars(derivation.motion).values())[:4])
    exact = jax.jit(lambda *state: {name: plain.quantities(*state)[name] for name in ("mass_matrix", "jacobian")})(
        *state
    )
    mass, rows = (np.asarray(exact[name]) for name in ("mass_matrix", "jacobian"))
    diagonal = np.diagonal(mass)
    np.testing.assert_allclose(of["energy_by_qdot"], mass @ v.ravel(), rtol=1e-13)
    np.testing.assert_allclose(of["mass_diagonal"], diagonal, rtol=1e-13)
    np.testing.assert_allclose(of["row_lengths"], np.linalg.norm(rows, axis=1), rtol=1e-13)
    np.testing.assert_allclose(of["unit_lengths"], np.linalg.norm(rows / np.sqrt(diagonal), axis=1), rtol=1e-13)
    balance = mass @ of["acceleration"] - rows.T @ of["multipliers"]
    size = np.abs(mass @ of["acceleration"]).max()
    np.testing.assert_allclose(balance, jax.jit(plain.force)(*state), atol=1e-10 * size)


def test_health_is_that_of_the_numbers(run):
    health = run.health()
    assert not health.suspicious
    mass = np.ones(SIZE)
    mass[BLAMED] = 5.0
    q, v = np.asarray(run.q), np.asarray(run.qdot)
    energy = 0.5 * (mass * v**2 + (q - np.roll(q, 1, axis=1)) ** 2).sum(axis=1) + 0.25 * (q**4).sum(axis=1)
    drift = np.abs(energy - energy[0]).max()  # without the roots of the time, of which the balance takes account
    assert float(health.energy.value) == pytest.approx(drift, abs=1e-11 * energy[0])
    assert drift < float(health.energy_allowed) < 1e-3 * energy[0]
    assert float(health.condition.value) == 5.0 and float(health.smallest_eigenvalue.value) == 1.0
    assert health.gradients_finite


def test_check_names_what_is_wrong_with_one_of_many_coordinates():
    healthy = lagjax.check(RING, Q0, QDOT0, params=numbers())
    assert healthy.kinds == {"explicit_time"} and "1000 coordinates" in healthy.omitted
    for kind, changed in {
        "velocity_unused": {"mass": 0.0},
        "indefinite_mass_matrix": {"mass": -1.0},
        "wrong_derivative": {"off": 0.01},
        "value_not_finite": {"until": -1.0},
    }.items():
        found = [
            finding for finding in lagjax.check(RING, Q0, QDOT0, params=numbers(**changed)) if finding.kind == kind
        ]
        assert len(found) == 1
        assert kind == "value_not_finite" or found[0].where[0] == f"q[{BLAMED}]"


def test_a_motion_that_fails_names_the_coordinate():
    with pytest.raises(lagjax.SimulationError, match=rf"no kinetic energy in the velocity of q\[{BLAMED}\]"):
        lagjax.simulate(RING, Q0, QDOT0, TS, numbers(mass=0.0))


def test_a_start_off_one_of_many_constraints_is_named():
    count = 80
    q = np.stack([np.arange(count) * 1.0, np.zeros(count)], axis=1)
    off = q + 1e-3 * (np.arange(count) > 41)[:, None] * [1.0, 0.0]
    with pytest.raises(ValueError, match=r"does not satisfy constraints\[41\]"):
        lagjax.simulate(CHAIN, off, np.zeros_like(q), TS)
    with pytest.raises(ValueError, match=r"constraints\[41\] has zero gradient"):
        lagjax.simulate(CHAIN, q - (np.arange(count) > 41)[:, None] * [1.0, 0.0], np.zeros_like(q), TS)


@pytest.mark.parametrize("kind", ["band", pytest.param("blocks", marks=pytest.mark.slow)])
def test_the_spectrum_of_a_sparse_mass_matrix(kind):
    def kinetic(q, qdot):
        coupled = qdot[1:] + qdot[:-1] if kind == "band" else qdot[::2] + 0.9 * qdot[1::2]
        return 0.5 * jnp.sum(coupled**2) + 0.05 * jnp.sum(jnp.cos(q) * qdot**2) - qdot[9] ** 2 - jnp.sum(q**4)

    derivation = derivation_of(lagjax.System(kinetic), Layout.from_state(Q0, QDOT0), None)
    (near, direction), (lowest, _), largest = sparse_spectrum(derivation, (Q0, QDOT0, 0.0, None))
    coupling = np.eye(SIZE)[:-1] + np.eye(SIZE)[1:] if kind == "band" else np.eye(SIZE)[::2] + 0.9 * np.eye(SIZE)[1::2]
    mass = coupling.T @ coupling + np.diag(0.1 * np.cos(Q0) - 2.0 * (np.arange(SIZE) == 9))
    scale = 1 / np.sqrt(np.abs(np.diagonal(mass)))
    values = np.linalg.eigvalsh(scale[:, None] * mass * scale)
    assert near == pytest.approx(values[np.argmin(np.abs(values))], rel=0.02)
    assert (lowest, largest) == pytest.approx((values[0], np.abs(values).max()), rel=0.02)
    assert np.abs(mass @ direction).max() < 0.1 * np.abs(direction).max()


def attraction(q, qdot):
    apart = jnp.sum((q[:, None] - q) ** 2, axis=-1)
    return 0.5 * jnp.sum(qdot**2) + jnp.sum(1 / jnp.sqrt(apart + 1.0))


BODIES = lagjax.System(attraction)


def test_a_scene_too_large_for_the_machine_says_so():
    many, still = np.zeros((10**6, 3)), np.zeros((10**6, 3))
    for ask in (lambda: lagjax.simulate(BODIES, many, still, TS), lambda: BODIES.acceleration(many, still)):
        with pytest.raises(ValueError, match=r"gradient of this L, of 3000000 coordinates, would take some .* GiB"):
            ask()
    free = FREE_POINTS
    with pytest.raises(ValueError, match="mass matrix of 3000000 coordinates would take some"):
        free.mass_matrix(many, still)
    with pytest.raises(ValueError, match=r"with 10000000 outputs would take some .* GiB of memory"):
        lagjax.simulate(RING, Q0, QDOT0, np.linspace(0.0, 1.0, 10**7), numbers())
