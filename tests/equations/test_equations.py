"""The scalar and the array form of the equations give one motion; what `explain` says of them is true."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import free_particle
from scenes import FREE_POINTS, particle
from sweeps import KINDS, sweep

import lagjax
from lagjax import scenes
from lagjax._engine.diffrax import equations_of
from lagjax._equations import Derivation
from lagjax._interface import Layout


def derivations(scene, *paths):
    layout = Layout.from_state(scene.q0, scene.qdot0)
    params = jax.tree.map(jnp.asarray, scene.params)
    motion = scene.system._motion(layout, params)
    return layout, params, [Derivation(motion, layout, params, path=path) for path in paths]


# The projections of these take XLA four and five seconds.
FAST = [scenes.double_pendulum, scenes.damped_driven_oscillator, scenes.kepler]
SPECIAL = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v**2) - jnp.sum(jax.scipy.special.betainc(2.0, 3.0, q)), path="scalar"
)
INDEFINITE = lagjax.System(lambda q, v: v[0] * v[1] + v[2] * v[0] + 0.5 * v[2] ** 2 - 0.5 * jnp.sum(q**2))
COMPLEX_STIFFNESS = lagjax.System(lambda q, v, params: 0.5 * v @ v - 0.5 * jnp.abs(params["z"]) ** 2 * q @ q)


# Beside these every sixth scene: the motions of all, by the scalar form, are held to their laws in tests/scenes.
@pytest.mark.parametrize(
    "make", sweep([make for k, make in enumerate(scenes.ALL) if make in KINDS or k % 6 == 0], kept=FAST),
    ids=lambda make: make.__name__,
)  # fmt: skip
def test_both_forms_of_scenes_agree(make):
    scene = make()
    layout, params, of = derivations(scene, "auto", "array")
    reason = of[0].form_in_xla.reason
    assert reason is None or layout.size > 12
    if reason is not None:
        assert "operations" in reason or "pivoting" in reason
        return
    auto, array = map(equations_of, of)
    rng = np.random.default_rng(0)
    shift = 0.01 * rng.uniform(-1, 1, (2, 5, layout.size))

    def accelerations(form, q, qdot):
        acceleration, singular = form.acceleration(jnp.asarray(0.3), (q, qdot), params)
        return acceleration, singular

    q, qdot = layout.flatten(scene.q0) + shift[0], layout.flatten(scene.qdot0) + shift[1]
    fast, plain = (jax.jit(jax.vmap(lambda a, b, f=form: accelerations(f, a, b)))(q, qdot) for form in (auto, array))
    # Round-off times the condition of M (at most some hundreds here) on the scale of the accelerations.
    np.testing.assert_allclose(fast[0], plain[0], rtol=1e-12, atol=1e-13 * np.abs(plain[0]).max())
    assert not fast[1].any() and not plain[1].any()
    if auto.constrained and layout.size < 7:  # the projection of the largest takes XLA half a minute
        project = lambda form: jax.jit(jax.vmap(lambda a, b: form.projected(jnp.asarray(0.3), (a, b), params)))
        for one, other in zip(project(auto)(q, qdot), project(array)(q, qdot), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13 * np.abs(other).max())


@pytest.mark.slow
def test_both_forms_follow_one_motion_and_one_gradient():
    double = scenes.double_pendulum()
    ts = np.linspace(0.0, 2.0, 5)

    def final(path, params):
        system = lagjax.System(double.system.lagrangian.code.function, path=path)
        return lagjax.simulate(system, double.q0, double.qdot0, ts, params, rtol=1e-11).q[-1, 1]

    values, gradients = zip(
        *(jax.value_and_grad(lambda p, path=path: final(path, p))(double.params) for path in ("scalar", "array")),
        strict=True,
    )
    np.testing.assert_allclose(*values, rtol=1e-9)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9), *gradients)


@pytest.mark.parametrize(
    "lagrangian",
    [
        lambda q, v: 0.5 * v[0] ** 2 - q[1] ** 2,
        lambda q, v: 0.5 * (v[0] + 0.3 * v[1]) ** 2 - q[0],
        lambda q, v: 0.5 * (v[0] + 0.3 * v[1] + 0.7 * v[2]) ** 2 + (v[1] - 0.1 * v[2]) ** 2,
        lambda q, v: 0.5 * v[0] ** 2 + 0.5 * q[0] ** 2 * v[1] ** 2 + 0.5 * v[2] ** 2,
    ],
)
def test_both_forms_find_a_singular_mass_matrix(lagrangian):
    n = 3
    layout = Layout.from_state(np.zeros(n), np.zeros(n))
    motion = lagjax.System(lagrangian)._motion(layout)
    for path in ("scalar", "array"):
        form = equations_of(Derivation(motion, layout, None, path=path))
        _, singular = form.acceleration(np.asarray(0.0), (np.zeros(n), np.ones(n)), None)
        assert singular  # what no force acts on may stay 0: the flag stops the motion


def test_an_indefinite_mass_matrix():
    # L = ẋẏ + żẋ + ½ ż² − U: regular, with a zero on the diagonal of M.
    q = np.array([0.3, 0.7, 0.2])
    assert INDEFINITE.explain(q, q).path == "scalar"
    mass = np.array([[0, 1, 1], [1, 0, 0], [1, 0, 1]])
    end = lagjax.simulate(INDEFINITE, q, np.zeros(3), np.array([0.0, 1e-3]))
    np.testing.assert_allclose(end.qdot[-1] / 1e-3, -np.linalg.solve(mass, q), rtol=1e-5)


def test_forcing_a_path():
    with pytest.raises(
        ValueError, match="no scalar program: the primitive `regularized_incomplete_beta` has no scalar form"
    ):
        lagjax.simulate(SPECIAL, np.zeros(2), np.zeros(2), np.array([0.0, 1.0]))
    with pytest.raises(ValueError, match="path must be"):
        lagjax.System(free_particle, path="fast")


def closed(k, **options):
    """The end of an oscillator whose stiffness is no parameter but a number that its Lagrangian closes over."""
    scene = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * k * q**2)
    return lagjax.simulate(scene, 1.0, 0.0, jnp.array([0.0, 3.0]), **options).q[-1]


def slope(k):
    return -1.5 / np.sqrt(k) * np.sin(3 * np.sqrt(k))  # d cos(√k t)/dk at t = 3


@pytest.mark.slow
def test_a_closed_over_parameter_is_differentiated_like_a_passed_one():
    np.testing.assert_allclose(jax.grad(lambda k: closed(k, solver=diffrax.Tsit5()))(4.0), slope(4.0), rtol=1e-7)


@pytest.mark.slow
def test_each_value_of_a_closed_over_parameter_has_its_own_derivative():
    for k in (4.0, 5.0):
        np.testing.assert_allclose(jax.jit(jax.grad(closed))(k), slope(k), rtol=1e-7)
    batched = jax.jit(jax.vmap(jax.grad(closed)))(np.array([4.0, 5.0]))
    np.testing.assert_allclose(batched[1], slope(5.0), rtol=1e-7)


# ---- explain --------------------------------------------------------------------------------------------------------


def explained(make):
    scene = make()
    return scene.system.explain(scene.q0, scene.qdot0, params=scene.params)


def test_explain_reads_the_facts():
    wedge = explained(scenes.wedge)
    assert wedge.cyclic == ("q.X",) and wedge.mass_matrix == "constant, dense" and not wedge.velocity_terms
    central = explained(scenes.central_force)
    assert central.cyclic == ("q.phi",) and central.mass_matrix == "varying, diagonal"
    assert central.mass_matrix_depends_on == ("q.rho",) and central.velocity_terms and central.energy_conserved
    driven = explained(scenes.driven_pendulum)
    assert driven.explicit_time and not driven.energy_conserved
    damped = explained(scenes.damped_driven_oscillator)
    assert not damped.energy_conserved
    for facts in (wedge, central, driven, damped):
        assert facts.path == "scalar" and facts.operations < facts.traced_operations


def forces_with_borders(q, v, t):
    return jnp.where(t > 5, 1.0, 0.0) - 0.2 * jnp.sign(v) + jnp.floor(q) * jnp.exp(-((t / 0.01) ** 2))


BORDERED = lagjax.System(free_particle, forces=forces_with_borders)


def test_explain_names_borders_and_says_whether_they_are_located():
    facts = BORDERED.explain(0.0, 1.0)
    assert sorted(facts.borders) == ["the sign of dq", "the sign of t", "the whole part of q"]
    assert facts.narrow == ("a function of t",) and facts.borders_located and "steps end there" in str(facts)
    smooth = explained(scenes.double_pendulum)
    assert smooth.borders == () and smooth.narrow == () and smooth.borders_located
    assert "borders" not in str(smooth)
    single = BORDERED.explain(np.float32(0.0), np.float32(1.0))
    assert single.borders == facts.borders and single.borders_located
    arrays = particle(forces_with_borders, path="array").explain(0.0, 1.0)
    assert not arrays.borders_located


def test_explain_prints():
    text = str(explained(scenes.double_pendulum))
    assert "varying, dense; depends on q[0], q[1]" in text and "path              scalar" in text
    large = FREE_POINTS.explain(np.zeros(80), np.zeros(80))
    assert large.path == "scalar" and large.cyclic == large.coordinates and "68 more" in str(large)


@pytest.mark.slow
@pytest.mark.filterwarnings("error::numpy.exceptions.ComplexWarning")
@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
def test_parameters_may_be_complex():
    run = lagjax.simulate(
        COMPLEX_STIFFNESS, np.ones(2), np.zeros(2), np.linspace(0.0, np.pi, 3), {"z": np.array(0.6 + 0.8j)}
    )
    np.testing.assert_allclose(run.q[-1], [-1.0, -1.0], rtol=1e-7)
