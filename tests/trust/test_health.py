"""What `Trajectory.health` measures, against closed forms, NumPy and trajectories that were spoilt on purpose."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
from scenes import BALL, FREE, SPRING, WEIGHT, particles
from sweeps import KINDS, sweep

import lagjax
from lagjax import scenes

TS = jnp.linspace(0.0, 10.0, 41)


def run(scene, ts=21, **options):
    ts = jnp.linspace(0.0, scene.duration, ts) if isinstance(ts, int) else ts
    return lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params, **options)


def moved(trajectory, q=None, qdot=None):
    """The trajectory with other states."""
    q, qdot = (old if new is None else new for new, old in ((q, trajectory.q), (qdot, trajectory.qdot)))
    return dataclasses.replace(trajectory, q=q, qdot=qdot)


def flagged(health):
    return {name for name, flags in health.checks().items() if np.any(flags)}


def swinging(**options):
    return lagjax.simulate(SPRING, 1.0, 0.5, TS, {"k": 1.3}, **options)


# ---- no false alarm --------------------------------------------------------------------------------------------------


# More than one of every kind; all of `scenes.ALL` takes minutes to compile.
SCENES = (
    scenes.uniform_gravity, scenes.morse_oscillator, scenes.central_force, scenes.bead_on_rotating_hoop,
    scenes.double_pendulum, scenes.spherical_pendulum, scenes.damped_driven_oscillator, scenes.fermi_pasta_ulam,
    scenes.rolling_cylinder, scenes.cartesian_double_pendulum, scenes.chaplygin_sleigh, scenes.charge_in_fields,
    scenes.relativistic_charge_in_electric_field, scenes.kepler, scenes.figure_eight,
)  # fmt: skip
CARRIED = lagjax.System(
    lagrangians.free_particles, dissipation=lambda q, v: 0.1 * jnp.sum(v**2),
    velocity_constraints=lambda q, v, t: v[0] - jnp.sin(t),
)  # fmt: skip
FALL = lagjax.System(lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2 - jnp.log(2.0 - q) * params["c"])
DRIVEN_AND_BRAKED = lagjax.System(
    lambda q, v, t: 0.5 * v**2 - 0.5 * 4.0 * q**2 + 0.3 * q * jnp.cos(0.5 * t),
    forces=lambda q, v, t: 0.2 * jnp.cos(0.5 * t),
    dissipation=lambda q, v: 0.5 * 0.3 * v**2,
)
FAST_DRIVEN = lagjax.System(
    lagrangians.oscillator,
    forces=lambda q, v, t: jnp.sin(7 * t),
    dissipation=lambda q, v: 0.05 * v**2,
)
MOVING_ROD = lagjax.System(
    lagrangians.weight,
    constraints=lambda q, t: q[0] ** 2 + q[1] ** 2 - (1 + 0.1 * jnp.sin(t)) ** 2,
    dissipation=lambda q, v: 0.05 * v[0] ** 2,
)
BRAKED_BALL = lagjax.System(lagrangians.ball, dissipation=lambda q, v: 0.1 * v**2)
RAIL = lagjax.System(lagrangians.weight, constraints=lambda q: {"rail": q @ q - 1.0})


@pytest.mark.parametrize("make", sweep(SCENES, KINDS), ids=lambda make: make.__name__)
def test_nothing_is_suspicious_about_the_scenes(make):
    health = run(make()).health()
    assert not health.suspicious, str(health)
    assert health.findings() == () and str(health).endswith("nothing suspicious")
    # Limits that nothing comes near would find nothing either.
    assert health.energy_allowed < 0.1 * np.abs(run(make()).energy()).max() + 1e-3


# ---- conserved quantities --------------------------------------------------------------------------------------------


def test_energy_of_an_oscillator():
    trajectory = swinging(rtol=1e-5, solver=diffrax.Tsit5())
    health, q, v = trajectory.health(), np.asarray(trajectory.q), np.asarray(trajectory.qdot)
    drift = np.abs(0.5 * v**2 + 0.65 * q**2 - (0.5 * v[0] ** 2 + 0.65 * q[0] ** 2))
    np.testing.assert_allclose(health.energy.value, drift.max(), rtol=1e-9)
    assert health.energy.t == TS[drift.argmax()] and drift.max() > 1e-7
    assert not health.works and health.work_error == 0 and health.momentum_names == ()
    assert flagged(health) == set()
    # The limit: N steps, each with |k q| (rtol |q| + atol) + |v| (rtol |v| + atol) at the worst place of the path.
    slope = 1.3 * np.abs(q) * (1e-5 * np.abs(q) + 1e-8) + np.abs(v) * (1e-5 * np.abs(v) + 1e-8)
    expected = 10 * np.sqrt(2) * (trajectory.stats["num_accepted_steps"] + 1) * slope.max()
    np.testing.assert_allclose(health.energy_allowed, expected, rtol=1e-6)


def test_a_drift_beyond_the_tolerances_is_found():
    trajectory = swinging()
    late = TS > 6.0
    health = moved(trajectory, qdot=np.where(late, 1.001, 1.0) * trajectory.qdot).health()
    assert flagged(health) == {"energy"} and health.energy.t > 6.0
    assert "tighten rtol" in health.findings()[0] and "Energy" in str(health)


def test_power_balance_with_friction_and_a_driving_force():
    # x″ = −2γ x′ − ω² x + cos t/2 by forces, dissipation and an explicit time at once.
    trajectory = lagjax.simulate(DRIVEN_AND_BRAKED, 1.0, 0.0, TS)
    health = trajectory.health()
    lost = np.ptp(np.asarray(trajectory.energy()))
    assert health.works and lost > 0.5
    # A quintic is off by h⁶ q⁽⁶⁾/46080 at most: steps of 1/4, and frequencies up to 4 of the power.
    assert health.energy.value < health.work_error < 4e-4 * lost
    assert flagged(health) == set()
    finer = lagjax.simulate(DRIVEN_AND_BRAKED, 1.0, 0.0, np.linspace(0.0, 10.0, 401)).health()
    assert finer.work_error < 1e-5 * health.work_error and flagged(finer) == set()
    assert finer.energy.value < finer.energy_allowed + finer.work_error
    L, forces = DRIVEN_AND_BRAKED.lagrangian.code.function, DRIVEN_AND_BRAKED.forces.code.function
    forgotten = dataclasses.replace(trajectory, system=lagjax.System(L, forces=forces))
    assert flagged(forgotten.health()) == {"energy"}


def chain(q, v, params):
    springs = 0.5 * params["k"] * jnp.sum(jnp.diff(q) ** 2) + 0.25 * params["b"] * jnp.sum(jnp.diff(q) ** 4)
    return 0.5 * jnp.sum(v**2) - springs - 0.5 * q[0] ** 2 + params["g"] * jnp.cos(q[-1])


def test_coarse_outputs_cry_no_wolf_and_hide_no_wrong_force():
    """Ten chains with their own stiffness, damping and drive, and 4 to 101 outputs over 2: what is not known is said.

    The fastest mode turns by up to 100 radians in all, 30 of them between outputs where these are few.
    """

    def force(share):
        return lambda q, v, t, params: (
            -share * params["c"] * v + jnp.zeros(5).at[0].set(params["f"] * jnp.sin(params["w"] * t))
        )

    scene, wrong = (lagjax.System(chain, forces=force(share)) for share in (1.0, 0.9))
    rng, found = np.random.default_rng(3), 0
    for _ in range(10):
        params = {"k": 10 ** rng.uniform(0, 3), "b": 10 ** rng.uniform(-1, 3), "g": rng.uniform(0, 5)}
        params |= {"c": 10 ** rng.uniform(-2, 0), "f": rng.uniform(0, 3), "w": 10 ** rng.uniform(-0.3, 1.5)}
        start = 0.3 * rng.normal(size=5), 0.5 * rng.normal(size=5)
        for count in (4, 6, 9, 13, 101):
            ts = jnp.linspace(0.0, 2.0, count)
            health = lagjax.simulate(scene, *start, ts, params).health()
            assert flagged(health) == set(), str(health)
            assert health.energy.value < health.energy_allowed + 4 * health.work_error
        other = dataclasses.replace(lagjax.simulate(wrong, *start, ts, params), system=scene)
        found += flagged(other.health()) == {"energy"}
    assert found == 10  # with 101 outputs a damping that is a tenth too small, of 0.01 or more, is seen


def test_a_power_balance_that_so_few_outputs_cannot_tell():
    # Three outputs in twenty periods of a force that pumps and drains: the work between them is anybody's guess.
    few, more = (lagjax.simulate(FAST_DRIVEN, 1.0, 0.0, np.linspace(0.0, 20.0, T)).health() for T in (3, 81))
    assert few.energy.value > 1e3 * few.energy_allowed and flagged(few) == set()
    (sentence,) = few.findings()
    assert "cannot be told from 3 outputs" in sentence and f"about {few.outputs_needed:.0f} outputs" in sentence
    assert sentence[:60] in str(few) and "nothing suspicious" not in str(few)
    assert more.outputs_needed == 81 and more.findings() == () and more.energy.value < more.work_error


@pytest.mark.parametrize("amplitude", [1e-9, 1e-12, 1e-200])
def test_a_motion_that_is_small_beside_atol(amplitude):
    def swung(**options):
        run = lagjax.simulate(SPRING, amplitude, 0.0, TS, {"k": 1.0}, **options)
        return np.abs(run.q - amplitude * np.cos(TS)).max() / amplitude, run.health()

    error, health = swung()
    assert error < 1e-8 and flagged(health) == set() and health.findings() == ()  # the default is as small as it
    error, health = swung(atol=1e-12)
    assert error > 1e-5 and "amplitude" in flagged(health)
    advice = next(sentence for sentence in health.findings() if sentence.startswith("Amplitude"))
    error, health = swung(atol=float(advice.split("atol=")[1].rstrip(".")))
    assert error < 1e-9 and flagged(health) == set() and health.findings() == ()
    # What rests is not small, it is exact.
    assert lagjax.simulate(SPRING, 0.0, 0.0, TS, {"k": 1.0}).health().findings() == ()


def test_work_of_constraints_that_move():
    # A bead on a rod that turns at a given rate: the rod does work; r = cosh(ω t) from rest at 1.
    omega = 0.7
    bead = particles(constraints=lambda q, t: q[0] * jnp.sin(omega * t) - q[1] * jnp.cos(omega * t))
    ts = np.linspace(0.0, 2.0, 41)
    trajectory = lagjax.simulate(bead, np.array([1.0, 0.0]), np.array([0.0, omega]), ts)
    health = trajectory.health()
    gained = 0.5 * omega**2 * (np.cosh(2 * omega * 2.0) - 1)
    np.testing.assert_allclose(np.ptp(np.asarray(trajectory.energy())), gained, rtol=1e-7)
    assert health.works and health.energy.value < 1e-9 * gained
    # A platform that carries a skater along: its constraint asks for a velocity, and pays for the friction.
    skating = lagjax.simulate(CARRIED, np.zeros(2), np.array([0.0, 1.0]), ts).health()
    assert skating.works and skating.energy.value < 1e-8 and flagged(skating) == set()


def test_momenta_known_to_be_conserved():
    scene = scenes.spherical_pendulum()
    trajectory = run(scene)
    health = trajectory.health()
    assert len(health.momentum_names) == 1 and "phi" in health.momentum_names[0]
    p = np.asarray(trajectory.momentum().phi)
    np.testing.assert_allclose(health.momentum.value, [np.abs(p - p[0]).max()], rtol=1e-6)
    faster = trajectory.qdot._replace(phi=trajectory.qdot.phi.at[7].multiply(1.01))
    spoilt = moved(trajectory, qdot=faster).health()
    assert "momentum" in flagged(spoilt) and spoilt.momentum.t == trajectory.ts[7]
    # A force on the coordinate, be it that of a constraint, and its momentum is no constant any more.
    free = lagrangians.free_particles
    start = jnp.array([1.0, 0.5, 0.0]), jnp.array([0.0, 0.0, 1.0])
    pushed = lagjax.System(free, forces=lambda q, v: jnp.array([1.0, 0.0, 0.0]) * q[1])
    assert lagjax.simulate(pushed, *start, TS).health().momentum_names == ("q[1]", "q[2]")
    wire = lagjax.System(free, constraints=lambda q: q[0] * q[2] - 0.0)
    assert lagjax.simulate(wire, *start[:1], jnp.array([0.0, 1.0, 0.0]), TS).health().momentum_names == ("q[1]",)


# ---- constraints, mass matrix, gradients -----------------------------------------------------------------------------


def test_distances_from_the_constraints():
    trajectory = run(scenes.cartesian_pendulum())
    health = trajectory.health()
    size = 1 + np.abs(trajectory.q).max()
    assert health.constraint_names == ("constraints['rod']",) or len(health.constraint_names) == 1
    assert health.constraint_distance.value[0] < 1e-14 * size and health.constraint_rate.value[0] < 1e-13 * size
    late = np.arange(21)[:, None] == 13
    off = moved(trajectory, q=np.where(late, 1 + 1e-6, 1.0) * trajectory.q).health()
    length = np.linalg.norm(trajectory.q[13])
    np.testing.assert_allclose(off.constraint_distance.value, [1e-6 * length], rtol=1e-5)
    assert off.constraint_distance.t == trajectory.ts[13] and "constraints" in flagged(off)
    outward = np.where(late, 1e-5, 0.0) * trajectory.q  # along the rod
    off = moved(trajectory, qdot=trajectory.qdot + outward).health()
    np.testing.assert_allclose(off.constraint_rate.value, [1e-5 * length], rtol=1e-5)
    assert "constraints" in flagged(off)


@pytest.mark.parametrize("make", [scenes.double_pendulum, scenes.chain], ids=["two", "three"])
def test_eigenvalues_of_the_mass_matrix(make):
    trajectory = run(make())
    health = trajectory.health()
    M = np.asarray(jax.vmap(trajectory.system.mass_matrix, (0, 0, 0, None))(
        trajectory.q, trajectory.qdot, trajectory.ts, trajectory.params
    ))  # fmt: skip
    scale = 1 / np.sqrt(np.diagonal(M, axis1=1, axis2=2))
    for found, values, pick in (
        (health.smallest_eigenvalue, np.linalg.eigvalsh(M)[:, 0], np.argmin),
        (health.condition, np.linalg.cond(M), np.argmax),
        (health.scaled_condition, np.linalg.cond(scale[:, :, None] * M * scale[:, None, :]), np.argmax),
    ):
        np.testing.assert_allclose(found.value, values[pick(values)], rtol=1e-12)
        assert found.t == trajectory.ts[pick(values)]


def test_a_nearly_singular_mass_matrix_and_scaling():
    def two(q, v, params):
        m = params["m"]
        return 0.5 * (v[0] ** 2 + m**2 * v[1] ** 2 + 2 * params["c"] * m * v[0] * v[1]) - 0.5 * jnp.sum(q**2)

    def health(m, c):
        given = {"m": m, "c": c}
        start = jnp.array([1.0, m**2])
        return lagjax.simulate(lagjax.System(two), start, jnp.zeros(2), TS[:3] / 10, given, throw=False).health()

    light = health(1e-5, 0.5)  # a light mass alone is no danger: eigenvalues of ((1, ½), (½, 1)) after scaling
    np.testing.assert_allclose(light.scaled_condition.value, 3.0, rtol=1e-9)
    assert light.condition.value > 1e9 and flagged(light) == set()
    assert "mass_matrix" in flagged(health(1.0, 1 - 1e-9))


def force_of_trap(q, v):
    return -jnp.where(q > 0, jnp.sqrt(q) ** 9, 0.0)


TRAP = lagjax.System(lagrangians.free_particle, forces=force_of_trap)


def test_gradients_that_are_not_finite():
    # Where q < 0 the force is zero, but the derivative of the branch that is not taken is NaN.

    trajectory = lagjax.simulate(TRAP, 1.0, -1.0, TS[:9], solver=diffrax.Tsit5(), rtol=1e-6)
    health = trajectory.health()
    assert trajectory.ok and flagged(health) == {"gradients"}
    assert health.gradients_time == TS[int(np.argmax(trajectory.q <= 0))]
    assert "where" in health.findings()[0]


# ---- the error of the whole motion -----------------------------------------------------------------------------------


def test_global_error_from_a_reference():
    loose, tight = swinging(rtol=1e-5, solver=diffrax.Tsit5()), swinging(rtol=1e-9)
    health, w = loose.health(tight), np.sqrt(1.3)
    q = np.cos(w * TS) + 0.5 / w * np.sin(w * TS)
    v = -w * np.sin(w * TS) + 0.5 * np.cos(w * TS)
    errors = [np.abs(x - exact) / (np.abs(exact).max() + 1e-3) for x, exact in ((loose.q, q), (loose.qdot, v))]
    np.testing.assert_allclose(health.global_error.value, np.max(errors), rtol=1e-3)
    assert health.global_error.t == TS[np.max(errors, axis=0).argmax()] and "global error" in str(health)
    assert loose.health().global_error is None


def test_a_chaotic_motion_is_called_one():
    scene = dataclasses.replace(scenes.double_pendulum(), q0=np.array([2.0, 2.5]))
    loose, tight = (run(scene, np.linspace(0.0, 60.0, 61), rtol=rtol) for rtol in (1e-6, 1e-9))
    health = loose.health(tight)
    assert flagged(health) == {"global_error"} and "chaotic" in str(health)


def test_references_that_cannot_be_compared():
    given, params = swinging(rtol=1e-6), {"k": 1.3}
    tight = {"rtol": 1e-10}
    for reference, sentence in (
        (lagjax.simulate(SPRING, 1.0, 0.5, TS[:-1], params, **tight), "shapes"),
        (lagjax.simulate(SPRING, 1.0, 0.5, TS + 1e-3, params, **tight), "times"),
        (lagjax.simulate(SPRING, 1.0, 0.5, TS, {"k": 1.4}, **tight), "params"),
        (dataclasses.replace(given, system=FREE), "another system"),
        (swinging(rtol=2e-7), "at most 1e-07"),
    ):
        with pytest.raises(ValueError, match=sentence):
            given.health(reference)
    with pytest.raises(TypeError, match="must be a Trajectory"):
        given.health(tight)


# ---- batches and transformations -------------------------------------------------------------------------------------


def test_members_that_failed_do_not_spoil_the_others():
    # q″ = −k q + c/(2 − q): the member that starts beside q = 2 falls into it, one has no parameter.
    q0, k = jnp.array([0.1, 1.9, 0.2, 0.3]), jnp.array([1.0, 1.0, jnp.nan, 2.0])
    batch = lagjax.simulate_batch(
        FALL, q0, np.zeros(4), TS, {"k": k, "c": np.full(4, 0.5)}, batch_axes=(0, 0, {"k": 0, "c": 0})
    )
    assert batch.ok.tolist() == [True, False, False, True]
    health = batch.health()
    assert health.suspicious.tolist() == [False, True, True, False]
    for i in (0, 3):
        alone = lagjax.simulate(FALL, q0[i], 0.0, TS, {"k": k[i], "c": 0.5}).health()
        np.testing.assert_allclose(health.energy.value[i], alone.energy.value, rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(health.energy_allowed[i], alone.energy_allowed, rtol=1e-9)
        np.testing.assert_allclose(health.condition.value[i], alone.condition.value, rtol=1e-12)
    # One was followed for a while, of the other there is no more than its start.
    assert np.isfinite(health.energy.value[1]) and health.energy.t[1] < batch.end.t[1]
    assert np.isnan(health.energy.value[2]) and health.energy.t[2] == 0
    report = str(health)
    assert "of 4 members 2 successful" in report and "in 2 of 4 members, the first 1" in report
    assert len(report.splitlines()) < 24 and max(map(len, report.splitlines())) < 121


@pytest.mark.slow
def test_batch_vmap_and_jit_agree():
    k = jnp.array([0.7, 1.3, 2.0])

    def one(k):
        return lagjax.simulate(SPRING, 1.0, 0.5, TS, {"k": k}, throw=False)

    batch = lagjax.simulate_batch(SPRING, 1.0, 0.5, TS, {"k": k}, batch_axes=(None, None, 0)).health()
    mapped = jax.vmap(one)(k).health()
    inside = jax.jit(jax.vmap(lambda k: one(k).health()))(k)
    twice = jax.vmap(lambda c: lagjax.simulate_batch(
        SPRING, c, 0.5, TS, {"k": k}, batch_axes=(None, None, 0)
    ))(np.array([1.0, 2.0])).health()  # fmt: skip
    for other in (mapped, inside, jax.tree.map(lambda leaf: leaf[0], twice)):
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-6, atol=1e-14)
    assert twice.energy.value.shape == (2, 3) and "in member (" in str(twice)


@pytest.mark.slow
def test_numbers_and_traced_values_are_measured_alike():
    # By programs in NumPy, and in JAX: with constraints, forces, a conserved momentum, and modes.
    start = np.array([1.0, 0.0, 0.3]), np.array([0.1, 0.0, 1.0])
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    for run in (
        lagjax.simulate(MOVING_ROD, *start, np.linspace(0.0, 2.0, 21)),
        lagjax.simulate(
            lagjax.Hybrid({"flight": BRAKED_BALL}, [bounce], "flight"), 1.0, 0.0, np.linspace(0.0, 1.5, 31)
        ),
    ):
        eager, traced = run.health(), jax.jit(lambda run: run.health())(run)
        assert eager.works and (eager.work_error > 0).all() and flagged(eager) == set()
        assert jax.tree.structure(eager) == jax.tree.structure(traced)
        for of in (
            lambda health: (health.energy.value, health.energy_allowed, health.work_error, health.outputs_needed),
            lambda health: (health.amplitude, health.momentum.value, health.momentum_allowed),
            lambda health: (health.constraint_distance.value, health.constraint_rate.value, health.constraint_allowed),
            lambda health: (*health.smallest_eigenvalue, health.condition.value, health.gradients_finite),
        ):
            for a, b in zip(of(eager), of(traced), strict=True):
                np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-4, atol=1e-11)


def test_a_new_value_never_recompiles():
    traces = []

    def counted(q, v, params):
        traces.append(None)
        return 0.5 * v**2 - params["k"] * q**2

    system = lagjax.System(counted)
    first = lagjax.simulate(system, 1.0, 0.0, TS, {"k": 0.5}, rtol=1e-8)
    second = lagjax.simulate(system, 1.1, 0.0, 2 * TS, {"k": 2.0}, rtol=1e-6)
    first.health()
    count = len(traces)
    second.health()
    assert len(traces) == count


# ---- modes -----------------------------------------------------------------------------------------------------------


def test_energy_between_bounces():
    # Every bounce takes 0.36 of the energy; between them none is lost.
    ball = BALL
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    bouncing = lagjax.simulate(
        lagjax.Hybrid({"flight": ball}, [bounce], "flight"), 1.0, 0.0, jnp.linspace(0.0, 1.5, 31)
    )
    health = bouncing.health()
    energy = np.asarray(bouncing.energy())
    assert bouncing.transitions.count == 2 and np.ptp(energy) > 5
    assert health.energy.value < 1e-12 * energy[0] and flagged(health) == set()
    spoilt = moved(bouncing, q=bouncing.q.at[20].add(1e-3)).health()
    np.testing.assert_allclose(spoilt.energy.value, 9.81e-3, rtol=1e-6)
    assert flagged(spoilt) == {"energy"}


@pytest.mark.slow
def test_constraints_of_one_mode_and_not_of_another():
    # Down the inside of a circle to its lowest place, then straight on.
    free = WEIGHT
    off = lagjax.Transition("rail", "air", lambda q, v: q[0])
    modes, start = {"rail": RAIL, "air": free}, (np.array([-1.0, 0.0]), np.zeros(2))
    fallen = lagjax.simulate(lagjax.Hybrid(modes, [off], "rail"), *start, np.linspace(0.0, 1.0, 21))
    health = fallen.health()
    assert np.unique(fallen.mode).tolist() == [0, 1] and flagged(health) == set()
    assert health.constraint_names == ("rail: constraints['rail']",)
    assert health.constraint_distance.value[0] < 1e-13 < np.abs(np.sum(fallen.q[-1] ** 2) - 1)
    assert health.momentum_names == ("q[0]",)  # of the flight
    assert health.momentum.value[0] < 1e-12


# ---- how a motion may end, with diffrax ------------------------------------------------------------------------------

BY_DIFFRAX = {"solver": lagjax.FineOutput(diffrax.Dopri8()), "throw": False}


def held(constraint, q0, v0, end, **options):
    system = lagjax.System(lagrangians.free_particles, constraints=constraint)
    ts = jnp.linspace(0.0, end, 5)
    return lagjax.simulate(system, jnp.array(q0), jnp.array(v0), ts, **(BY_DIFFRAX | options))


@pytest.mark.slow
def test_a_constraint_that_loses_its_gradient():
    # Along y² = x³ into its cusp, at constant speed, where ∂f/∂q vanishes: the length of the curve is known.
    run = held(lambda q: q[1] ** 2 - q[0] ** 3, [1.0, 1.0], [-1.0, -1.5], 2.0)
    length, speed = (13**1.5 - 8) / 27, np.sqrt(3.25)
    assert run.result == lagjax.RESULTS.constraint_rank_lost and not run.ok
    np.testing.assert_allclose(run.end.t, length / speed, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(run.q).all(axis=1), run.ts > run.end.t)
    with pytest.raises(lagjax.SimulationError, match="no longer determine") as caught:
        held(lambda q: q[1] ** 2 - q[0] ** 3, [1.0, 1.0], [-1.0, -1.5], 2.0, throw=True)
    assert "t = 0.7986" in str(caught.value) and "last state was q[0]" in str(caught.value)


@pytest.mark.slow
def test_steps_too_long_for_the_projection():
    scene = scenes.cartesian_pendulum()
    for dt in (1.0, 2.0):  # so far from the circle that Newton's method comes back half the way at best
        failed = run(scene, np.linspace(0.0, 10.0, 5), dt=dt, throw=False)
        assert failed.result == lagjax.RESULTS.projection_failed and np.isnan(failed.q[1:]).all()
        assert "projection_failed" in str(failed.health())
    fine = run(scene, np.linspace(0.0, 10.0, 5), dt=0.1)
    assert fine.ok and flagged(fine.health()) == set()


@pytest.mark.slow
def test_a_constraint_that_jumps_is_not_followed_by_a_jump():
    run = held(lambda q, t: q[1] - jnp.where(t > 0.7, 0.1, 0.0), [0.0, 0.0], [1.0, 0.0], 2.0)
    assert not run.ok and abs(run.end.t - 0.7) < 1e-9 and np.isnan(run.q[2:]).all()


# ---- float32 ---------------------------------------------------------------------------------------------------------


SINGLE = [scenes.pendulum, scenes.kepler, scenes.wedge]


@pytest.mark.slow
@pytest.mark.parametrize("make", SINGLE, ids=lambda make: make.__name__)
def test_float32_end_to_end_is_as_accurate_as_stated(make):
    scene = make()
    q0, qdot0, params = jax.tree.map(jnp.float32, (scene.q0, scene.qdot0, scene.params))
    trajectory = lagjax.simulate(scene.system, q0, qdot0, jnp.linspace(0.0, scene.duration, 21), params)
    health = trajectory.health()
    kinds = {leaf.dtype for leaf in jax.tree.leaves((trajectory.q, trajectory.ts, trajectory.energy()))}
    assert kinds == {np.dtype("float32")} and flagged(health) == set()
    # From the same numbers, in float64.
    ts, start = np.asarray(trajectory.ts, float), jax.tree.map(lambda x: jnp.asarray(x, float), (q0, qdot0, params))
    exact = jax.jit(jax.vmap(lambda t: scene.exact(t, *start)))(ts)
    for x, truth in zip(jax.tree.leaves((trajectory.q, trajectory.qdot)), jax.tree.leaves(exact), strict=True):
        assert np.abs(x - truth).max() <= 4 * np.finfo(np.float32).eps * (np.abs(truth).max() + 1e-3)
