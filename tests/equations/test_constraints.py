"""Constraints: their forces, their drift, and the same motion in coordinates that need none.

There are two ways to a motion: machine code from scalar programs, and diffrax, here with the array form of the
equations. Both must do what is hard (`WAYS`); that both forms are the same equations is tested in `test_equations`. A
run at the tolerance r is off by about r times its number of steps and the growth of its own small errors.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from lagrangians import free_particles, weight
from scenes import WEIGHT, WEIGHT_ON_A_SLIDE, particles, weight_on
from sweeps import sweep

import lagjax
from lagjax import scenes
from lagjax._engine.diffrax import equations_of
from lagjax._equations import Derivation, derivation_of, rank_tolerance
from lagjax._interface import Layout

WAYS = pytest.mark.parametrize(
    "path", [pytest.param("auto", id="machine code"), pytest.param("array", id="diffrax", marks=pytest.mark.slow)]
)
LEANING = lagjax.System(weight, constraints=lambda q, params: jnp.stack([q[0], q[0] + params * q[1]]))
BELT = lagjax.System(weight, velocity_constraints=lambda q, v: v[0] - 1.0)
SKATE = lagjax.System(weight, velocity_constraints=lambda q, v: v[0] - q[1] * v[1])
DRIFT = 1e-12


def drift(trajectory):
    return max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(trajectory.constraint_residual()))


def code(function):
    """The plain function behind what a `System` holds."""
    return None if function is None else function.code.function


def rebuilt(system, path="auto", **changed):
    parts = {name: code(getattr(system, name)) for name in ("constraints", "velocity_constraints")} | changed
    return lagjax.System(code(system.lagrangian), path=path, **parts)


def rod(q):
    return {"rod": 0.5 * (1 - q @ q)}


WEIGHT_ON_A_ROD = lagjax.System(weight, constraints=rod)
HELD_WITHOUT_MASS = lagjax.System(
    lambda q, v: 0.5 * v[0] ** 2 - 0.5 * q[1] ** 2, constraints=lambda q: q[1] - q[0] ** 2
)
QUARTIC = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**4)


def hung(angle, rate=0.0):
    """The state of a pendulum of length 1."""
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


# ---- forces of constraints -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_force_between_rolling_cylinders_is_the_closed_form():
    scene, rng = scenes.rolling_cylinder(), np.random.default_rng(0)
    alpha, start = rng.uniform(0, 1, 200), rng.uniform(0.05, 0.5, 200)
    alpha[:4] = 0.0, 1e-15, 1e-8, 1e-3  # without inertia, and with hardly any
    turns = (scene.params["R"] + scene.params["a"]) / scene.params["a"]
    q0 = scenes.Rolling(np.full(200, scene.q0.r), start, turns * start)
    rest = jax.tree.map(np.zeros_like, q0)
    params, axes = scene.params | {"alpha": alpha}, dict.fromkeys(scene.params) | {"alpha": 0}
    run = lagjax.simulate_batch(
        scene.system, q0, rest, np.linspace(0, 0.5, 6), params, batch_axes=(0, 0, axes), rtol=1e-12
    )
    assert run.ok.all() and drift(run) < DRIFT
    columns = scene.params | {"alpha": alpha[:, None]}
    closed = scenes.rolling_cylinder_multipliers(run.q.theta1, start[:, None], columns)
    heavy = scene.params["M"] * scene.params["g"]
    for name, force in run.multipliers.items():
        assert np.max(np.abs(force - closed[name])) < 1e-10 * heavy, name
    # The force of the constraints: outwards along r, and the torque of the friction that turns the cylinder.
    forces = run.constraint_force()
    np.testing.assert_allclose(forces.r, closed["contact"], atol=1e-10 * heavy)
    np.testing.assert_allclose(forces.theta2, -scene.params["a"] * closed["rolling"], atol=1e-10 * heavy)
    assert np.all(forces.r[:, 0] > 0) and np.all(forces.theta2[:, 0] >= 0)


def tensions(q, qdot, accelerations):
    """Of the rods of a double pendulum of unit masses and lengths, from the accelerations of its angles."""
    (a, b), (v, w), (dv, dw) = (np.moveaxis(np.asarray(x), -1, 0) for x in (q, qdot, accelerations))

    def pull(angle, rate, slope):
        """The acceleration along x and y that a unit rod adds."""
        x = np.cos(angle) * slope - np.sin(angle) * rate**2
        return np.stack([x, np.sin(angle) * slope + np.cos(angle) * rate**2])

    up = np.array([0, 9.81]).reshape(2, *[1] * a.ndim)
    upper, lower = pull(a, v, dv), pull(b, w, dw)
    towards = [np.stack([-np.sin(angle), np.cos(angle)]) for angle in (a, b)]
    hanging = upper + lower + up
    return np.sum((upper + up + hanging) * towards[0], axis=0), np.sum(hanging * towards[1], axis=0)


@pytest.mark.slow
def test_a_double_pendulum_of_rods_is_the_double_pendulum():
    members, rng = 1000, np.random.default_rng(1)
    angles, rates = rng.uniform(-2, 2, (members, 2)), rng.uniform(-2, 2, (members, 2))
    rods, minimal = scenes.cartesian_double_pendulum(), scenes.double_pendulum()
    q0, qdot0 = jax.vmap(scenes.cartesian_of_angles, (0, 0, None))(angles, rates, np.ones(2))
    ts = np.linspace(0, 2, 5)
    free = lagjax.simulate_batch(minimal.system, angles, rates, ts, minimal.params, rtol=1e-12)
    held = lagjax.simulate_batch(rods.system, q0, qdot0, ts, rods.params, rtol=1e-12)
    assert free.ok.all() and held.ok.all() and drift(held) < DRIFT
    q, _ = jax.vmap(jax.vmap(scenes.cartesian_of_angles, (0, 0, None)), (0, 0, None))(free.q, free.qdot, np.ones(2))
    # 1e-12 times the growth of an error in 2 s, which for the wildest of a thousand starts is a few thousand.
    assert np.max(np.abs(q - held.q)) < 1e-8 and np.median(np.abs(q - held.q)) < 1e-12
    accelerate = jax.jit(jax.vmap(jax.vmap(lambda q, v: minimal.system.acceleration(q, v, 0.0, minimal.params))))
    upper, lower = tensions(free.q, free.qdot, accelerate(free.q, free.qdot))
    force = held.multipliers
    for found, expected in ((force["upper"], upper), (force["lower"], lower)):
        assert np.max(np.abs(found - expected)) < 1e-7 and np.median(np.abs(found - expected)) < 1e-11


@pytest.mark.slow
def test_the_forces_on_a_wire_and_a_sphere():
    wire = scenes.bead_on_wire()
    run = lagjax.simulate(wire.system, wire.q0, wire.qdot0, np.linspace(0, 3, 7), wire.params, rtol=1e-12)
    closed = jax.vmap(scenes.wire_multiplier, (0, 0, None))(run.q, run.qdot, wire.params)
    np.testing.assert_allclose(run.multipliers["wire"], closed, rtol=1e-12)
    sphere = scenes.particle_on_sphere()
    ts = np.linspace(0, sphere.duration, 7)
    run = lagjax.simulate(sphere.system, sphere.q0, sphere.qdot0, ts, sphere.params, rtol=1e-12)
    normal = 9.81 * (3 * run.q.z - 2 * sphere.q0.z)  # m g (3 cos θ − 2 cos θ0): it would leave at cos θ = ⅔ cos θ0
    np.testing.assert_allclose(run.multipliers["sphere"], normal, atol=1e-9)
    assert run.multipliers["sphere"][0] > 0 > run.multipliers["sphere"][-1]


# ---- published and closed numbers ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_andrews_squeezer_ends_where_two_tolerances_agree():
    # hard_cases.md, "OWN": self-consistent to 8e-13 in q and 7e-12 in the velocities.
    q_end = [15.810771195153698, -15.756371058411844, 0.04082224011963757, -0.534730116342094, 0.5244099658799517,
             0.534730116342091, 1.0480807410419395]  # fmt: skip
    v_end = [1139.9203022591046, -1424.3792951775397, 11.032911910618903, 19.29337410503229, 0.5735699148296738,
             -19.29337410503276, 0.32317914924887164]  # fmt: skip
    scene = scenes.andrews_squeezer()
    ts = np.linspace(0, scene.duration, 4)
    run = lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params, rtol=1e-13)
    np.testing.assert_allclose(np.array(run.q)[:, -1], q_end, rtol=0, atol=1e-11)
    np.testing.assert_allclose(np.array(run.qdot)[:, -1], v_end, rtol=1e-11)
    assert drift(run) < DRIFT


def test_a_pendulum_of_a_rod_for_2000_seconds():
    # IFToMM A01. Errors in the angle grow with the square of the time, by the change of the period with the energy.
    scene, ts = scenes.cartesian_pendulum(), np.array([0.0, 10.0, 100.0, 2000.0])
    run = lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params, rtol=1e-13, max_steps=100_000)
    exact = [(-0.27508746257611676, -0.9614192050991250), (-0.18151335142703138, -0.9833884803340575),
             (0.8146030685890321, -0.5800188178269355)]  # fmt: skip
    assert np.max(np.abs(run.q[1:] - np.array(exact))) < 1e-7
    assert drift(run) < DRIFT


@WAYS
def test_chaplygin_sleigh(path):
    scene = scenes.chaplygin_sleigh()
    system = rebuilt(scene.system, path)
    run = lagjax.simulate(system, scene.q0, scene.qdot0, np.array([0.0, 5.0]), scene.params, rtol=1e-12)
    u = run.qdot.x * np.cos(run.q.phi) + run.qdot.y * np.sin(run.q.phi)
    found = u[-1], run.qdot.phi[-1], run.q.phi[-1]
    np.testing.assert_allclose(found, [0.8271576446616773, 0.22982663184842, 7.047223949515657], rtol=1e-10)
    assert drift(run) < DRIFT


def vakonomic_knife_edge(t, y, g, J):
    """L + μ (ẏ cos φ − ẋ sin φ) varied as a whole, for unit mass: y = (x, y, φ, u, φ̇, μ)."""
    _, _, phi, u, w, mu = y
    return [u * np.cos(phi), u * np.sin(phi), w, g * np.cos(phi) - mu * w, mu * u / J, g * np.sin(phi) + w * u]


def test_a_velocity_constraint_is_nonholonomic_and_not_vakonomic():
    scene = scenes.knife_edge()
    run = lagjax.simulate(scene.system, scene.q0, scene.qdot0, np.array([0.0, 2.0]), scene.params, rtol=1e-12)
    exact = scene.exact(2.0, scene.q0, scene.qdot0, scene.params)
    end = np.array([leaf[-1] for leaf in run.q])
    np.testing.assert_allclose(end, exact[0], atol=1e-11)
    push = scene.params["g"] * np.sin(scene.params["slope"])
    for mu in (0.0, 1.0):  # a start that the constraint does not fix: what makes the variational problem another one
        other = scipy.integrate.solve_ivp(
            vakonomic_knife_edge, (0, 2), [*scene.q0, 0, 1.5, mu], args=(push, scene.params["J"]), rtol=1e-9, atol=1e-9
        )
        assert np.max(np.abs(other.y[:3, -1] - end)) > 0.1


# ---- what must not matter --------------------------------------------------------------------------------------------


STIFF_ROD = lagjax.System(weight, constraints=lambda q: 1e6 * rod(q)["rod"])


@pytest.mark.slow
def test_doubled_and_scaled_constraints_change_no_motion():
    def many(q):
        return {"rod": rod(q)["rod"], "twice": 1e6 * rod(q)["rod"]}

    q0, qdot0 = hung(1.2, 0.5)
    ts = np.linspace(0, 2, 3)
    systems = [WEIGHT_ON_A_ROD, STIFF_ROD]
    systems += [weight_on(constraints=many, path=path) for path in ("auto", "array")]
    once, scaled, *twice = (lagjax.simulate(system, q0, qdot0, ts, rtol=1e-11) for system in systems)
    for other in (scaled, *twice):
        assert np.max(np.abs(other.q - once.q)) < 1e-10 and np.max(np.abs(other.qdot - once.qdot)) < 1e-10
    tension = once.multipliers["rod"]
    np.testing.assert_allclose(1e6 * scaled.multipliers, tension, rtol=1e-9)
    # Of all λ with λ₁ + 1e6 λ₂ = λ the shortest.
    force = twice[0].multipliers
    largest = 1e-6 * np.max(tension)
    np.testing.assert_allclose(force["rod"], 1e-12 * tension, atol=1e-9 * largest)
    np.testing.assert_allclose(force["twice"], 1e-6 * tension, rtol=1e-9)
    facts = systems[2].explain(q0, qdot0)
    assert facts.constraints == ("constraints['rod']", "constraints['twice']")
    assert facts.dependent_constraints == {"constraints['twice']": ("constraints['rod']",)}


def test_explain_says_what_constraints_cost_and_which_depend():
    q, v = jnp.array([0.6, -0.8, 0.0]), jnp.zeros(3)
    mixed = lambda q: {"a rod": rod(q)["rod"], "floor": q[2], "mix": rod(q)["rod"] + 3 * q[2]}
    facts = weight_on(constraints=mixed).explain(q, v)
    assert facts.dependent_constraints == {"constraints['mix']": ("constraints['a rod']", "constraints['floor']")}
    assert facts.projection_operations > 0 and facts.energy_conserved
    assert "dependent         constraints['mix'] on constraints['a rod'], constraints['floor']" in str(facts)
    free = WEIGHT.explain(q, v)
    assert free.constraints == () and free.projection_operations is None and "constraints" not in str(free)
    # The part of one constraint beside the other, squared, above and below the stated tolerance.
    for part, dependent in ((10.0, False), (0.1, True)):
        near = np.sqrt(part * rank_tolerance(np.float64))
        assert bool(LEANING.explain(v, v, params=near).dependent_constraints) == dependent


def test_explain_knows_which_constraints_do_work():
    q = jnp.zeros(2)
    moving = WEIGHT_ON_A_SLIDE
    kept = [scene.explain(q, q).energy_conserved for scene in (BELT, moving, SKATE)]
    assert kept == [False, False, True]
    assert [scene.explain(q, q).explicit_time for scene in (BELT, moving, SKATE)] == [False, True, False]


# ---- constraints that move, mass matrices that are singular, ranks that drop -----------------------------------------


@WAYS
def test_a_pendulum_on_a_shaken_support(path):
    # ∂f/∂t and ∂²f/∂t² are all there is of the shaking. Its closed form is that of `driven_pendulum`.
    minimal = scenes.driven_pendulum()
    params = minimal.params | {"a": 0.3, "Omega": 5.0}

    def held(q, t, params):
        height = q[1] - params["a"] * jnp.cos(params["Omega"] * t)
        return {"rod": 0.5 * (1 - q[0] ** 2 - height**2)}

    system = weight_on(constraints=held, path=path)
    angle, ts = 1.0, np.linspace(0, 2, 3)
    free = lagjax.simulate(minimal.system, angle, 0.0, ts, params, rtol=1e-12)
    q0 = np.array([np.sin(angle), 0.3 - np.cos(angle)])
    run = lagjax.simulate(system, q0, np.zeros(2), ts, params, rtol=1e-12)
    height = 0.3 * np.cos(5.0 * ts)
    expected = np.stack([np.sin(free.q), height - np.cos(free.q)], axis=1)
    assert np.max(np.abs(run.q - expected)) < 1e-10 and drift(run) < DRIFT


@pytest.mark.slow
def test_a_coordinate_without_mass_that_a_constraint_holds():
    # The spring acts on z, which has no kinetic energy; z = x² ties it to the mass: ½ ẋ² − ½ (x²)².
    ts = np.linspace(0, 3, 3)
    free = lagjax.simulate(QUARTIC, 1.1, 0.3, ts, rtol=1e-12)
    run = lagjax.simulate(HELD_WITHOUT_MASS, np.array([1.1, 1.21]), np.array([0.3, 0.66]), ts, rtol=1e-12)
    np.testing.assert_allclose(run.q[:, 0], free.q, atol=1e-10)
    np.testing.assert_allclose(run.multipliers, run.q[:, 1], rtol=1e-12)  # λ = ∂U/∂z, all that acts on z
    assert drift(run) < DRIFT
    by_arrays = jax.jit(rebuilt(HELD_WITHOUT_MASS, "array").acceleration)(run.q[1], run.qdot[1])
    np.testing.assert_allclose(HELD_WITHOUT_MASS.acceleration(run.q[1], run.qdot[1]), by_arrays, rtol=1e-13)


WITHOUT_MASS = lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1], constraints=lambda q: q[0] - 1.0)
MASSES_AS_PARAMS = lagjax.System(lambda q, v, params: 0.5 * params @ v**2 - q[1], constraints=lambda q: q[0] - 1.0)


@pytest.mark.slow
def test_a_singular_saddle_point_is_reported():
    # Neither L nor the constraint holds q[1]; in the second only because a parameter is zero.
    system = WITHOUT_MASS
    assert np.isnan(system.acceleration(np.array([1.0, 0.0]), np.zeros(2))).all()
    with pytest.raises(lagjax.SimulationError):
        lagjax.simulate(system, np.array([1.0, 0.0]), np.zeros(2), np.array([0.0, 1.0]))
    system = MASSES_AS_PARAMS
    q0, masses = np.array([1.0, 0.0]), np.array([[1.0, 2.0], [0.0, 2.0], [1.0, 0.0]])
    run = lagjax.simulate_batch(system, q0, 0 * q0, np.array([0.0, 1.0]), masses, batch_axes=(None, None, 0))
    assert (run.result == lagjax.RESULTS.mass_matrix_singular).tolist() == [False, False, True]
    np.testing.assert_allclose(run.q[:2, -1, 1], -0.25, rtol=1e-13)


@pytest.mark.slow
def test_masses_in_params_are_taken_for_what_they_are():
    # Where they are regular the program is the lean one; where they are not, or hardly, the one for any mass matrix
    # takes over, also where JAX does not know them while it traces, and in derivatives.
    rods = scenes.cartesian_double_pendulum()
    layout = Layout.from_state(rods.q0, rods.qdot0)
    lean = derivation_of(rods.system, layout, rods.params).accelerations.program
    assert 2 * lean.operations < lean.complete.operations
    scene = scenes.rolling_cylinder()
    rest = scenes.Rolling(0.0, 0.0, 0.0)

    def end(alpha):
        params = scene.params | {"alpha": alpha}
        return lagjax.simulate(scene.system, scene.q0, rest, np.array([0.0, 0.6]), params, rtol=1e-12).q.theta2[-1]

    def exact(alpha):
        return scene.exact(0.6, scene.q0, rest, scene.params | {"alpha": alpha})[0].theta2

    alpha = np.array([0.0, 1e-15, 1e-3, 0.5])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(alpha)
    np.testing.assert_allclose(values, jax.jit(jax.vmap(exact))(alpha), rtol=1e-10)
    central = (jax.jit(jax.vmap(exact))(alpha + 1e-4) - jax.jit(jax.vmap(exact))(alpha - 1e-4)) / 2e-4
    np.testing.assert_allclose(slopes, central, rtol=1e-6)  # 1e-8 of third derivatives
    np.testing.assert_allclose(end(0.0), values[0], rtol=1e-14)


def crank_alone(q, qdot, params):
    """A slider crank of equal bars in the angle of its crank alone: rod = −crank, x = 2 l cos(crank)."""
    l = params["l"][0]
    whole, moving = jax.jvp(lambda a: scenes.SliderCrank(a, -a, 2 * l * jnp.cos(a)), (q,), (qdot,))
    return code(scenes.slider_crank(1.0, 1.0).system.lagrangian)(whole, moving, params)


CRANK_ALONE = lagjax.System(crank_alone)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [pytest.param(None, id="machine code"), pytest.param(diffrax.Dopri8(), id="diffrax")]
)
def test_slider_cranks_of_equal_bars_pass_their_dead_centre(solver):
    # At crank = π/2 the second constraint has no gradient, and the bars might go on together instead.
    scene, members = scenes.slider_crank(1.0, 1.0), 100
    start, rate, ts = np.random.default_rng(0).uniform(0.2, 1.2, members), np.full(members, 4.0), np.linspace(0, 1.5, 4)
    q0 = scenes.SliderCrank(start, -start, 2 * np.cos(start))
    qdot0 = scenes.SliderCrank(rate, -rate, -2 * rate * np.sin(start))
    free = lagjax.simulate_batch(CRANK_ALONE, start, rate, ts, scene.params, rtol=1e-12)
    assert np.mean(free.q[:, -1] > np.pi / 2) > 0.9
    # Not tighter: diffrax's steps must span the dead centre, near which rounding decides, and cannot be taken again.
    run = lagjax.simulate_batch(scene.system, q0, qdot0, ts, scene.params, rtol=1e-8, solver=solver)
    assert run.ok.all() and drift(run) < DRIFT
    np.testing.assert_allclose(run.q.crank, free.q, atol=1e-7)
    np.testing.assert_allclose(run.q.x, 2 * np.cos(free.q), atol=1e-7)


def turning_cranks(members):
    """Slider cranks of equal bars, most of which pass their dead centre many times: (start, rate, q0, qdot0)."""
    rng = np.random.default_rng(5)
    start = rng.uniform(-1.4, 1.4, members)
    rate = rng.uniform(1, 15, members) * rng.choice([-1, 1], members)
    q0 = scenes.SliderCrank(start, -start, 2 * np.cos(start))
    return start, rate, q0, scenes.SliderCrank(rate, -rate, -2 * rate * np.sin(start))


@pytest.mark.slow
def test_a_dead_centre_is_passed_rightly_or_not_at_all():
    # A step must not end where round-off decides between the branches; one that does is taken again.
    scene, ts = scenes.slider_crank(1.0, 1.0), np.linspace(0, 1.5, 6)
    start, rate, q0, qdot0 = turning_cranks(1000)
    free = lagjax.simulate_batch(CRANK_ALONE, start, rate, ts, scene.params, rtol=1e-13)
    for rtol in (1e-6, 1e-8, 1e-10, 1e-12, 1e-13, 1e-14):
        run = lagjax.simulate_batch(scene.system, q0, qdot0, ts, scene.params, rtol=rtol)
        ok = np.asarray(run.ok)
        assert ok.all() if rtol > 1e-14 else ok.mean() > 0.9  # at 1e-14 the equations are rounded by more than that
        assert np.max(np.abs(run.q.crank + run.q.rod)[ok]) < 1e-12
        np.testing.assert_allclose(run.q.crank[ok], free.q[ok], atol=100 * rtol + 2e-12)
        assert set(run.result._value[~ok].tolist()) <= {int(lagjax.RESULTS.projection_failed._value)}


@pytest.mark.slow
def test_derivatives_through_steps_that_are_taken_again():
    scene, ts = scenes.slider_crank(1.0, 1.0), np.linspace(0, 1.5, 3)
    start, rate, *_ = turning_cranks(40)

    def place(start, rate):
        q0 = scenes.SliderCrank(start, -start, 2 * jnp.cos(start))
        qdot0 = scenes.SliderCrank(rate, -rate, -2 * rate * jnp.sin(start))
        return lagjax.simulate(scene.system, q0, qdot0, ts, scene.params, rtol=1e-11).q.x[-1]

    def place_alone(start, rate):
        run = lagjax.simulate(CRANK_ALONE, start, rate, ts, scene.params, rtol=1e-12)
        return 2 * jnp.cos(run.q[-1])

    found, expected = (jax.vmap(jax.grad(f, argnums=(0, 1)))(start, rate) for f in (place, place_alone))
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_reverse_mode_through_constraints_needs_no_parameters():
    system, ts, angle, step = WEIGHT_ON_A_ROD, np.linspace(0, 1, 3), 1.0, 1e-4

    def inside(angle):
        return lagjax.simulate(system, *hung(angle, 0.5), ts, rtol=1e-12).q[1, 0]

    # Central differences are off by step²/6 times the third derivative, some tens here.
    difference = (inside(angle + step) - inside(angle - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(inside)(angle), difference, atol=1e-6)


def bars_in_a_row(loops):
    """So many parallelograms side by side, of uniform bars of unit mass and length, by their upper joints."""

    def bar(a, b, va, vb):
        return jnp.sum(va**2 + va * vb + vb**2) / 6 - 9.81 * (a[1] + b[1]) / 2

    def lagrangian(q, qdot):
        q, v, fixed = q.reshape(-1, 2), qdot.reshape(-1, 2), jnp.zeros(2)
        cranks = [bar(fixed, q[i], fixed, v[i]) for i in range(loops + 1)]
        return sum(cranks) + sum(bar(q[i], q[i + 1], v[i], v[i + 1]) for i in range(loops))

    def lengths(q):
        q = q.reshape(-1, 2)
        cranks = jnp.sum((q - jnp.stack([jnp.arange(loops + 1.0), jnp.zeros(loops + 1)], 1)) ** 2, axis=1)
        return {"cranks": cranks - 1, "couplers": jnp.sum((q[1:] - q[:-1]) ** 2, axis=1) - 1}

    return lagjax.System(lagrangian, constraints=lengths)


def row_alone(a, qdot, params):
    """The same in the angle of its cranks alone, as long as they stay parallel."""
    loops = params["loops"]
    return 0.5 * ((loops + 1) / 3 + loops) * qdot**2 - 9.81 * ((loops + 1) / 2 + loops) * jnp.sin(a)


ROW_ALONE = lagjax.System(row_alone)


@pytest.mark.slow
@pytest.mark.parametrize("loops", [1, 2, 3, 10])
def test_rows_of_four_bars_pass_flat_configurations(loops):
    # In line, one rank is lost for every loop, about twenty times for each member here.
    members, ts = 40, np.linspace(0, 2, 5)
    rng = np.random.default_rng(0)
    start = rng.uniform(0.3, 2.8, members)
    rate = rng.uniform(3, 30, members) * rng.choice([-1, 1], members)
    free = lagjax.simulate_batch(ROW_ALONE, start, rate, ts, {"loops": loops}, rtol=1e-13)

    def joints(x, y):
        return np.stack([f for i in range(loops + 1) for f in (i + x, y)], axis=-1)

    q0 = joints(np.cos(start), np.sin(start))
    qdot0 = np.tile(np.stack([-np.sin(start), np.cos(start)], 1) * rate[:, None], loops + 1)
    system = bars_in_a_row(loops)
    assert system.explain(q0[0], qdot0[0]).path == "scalar"  # 22 coordinates and 21 constraints, too
    for rtol in (1e-7, 1e-8, 1e-9, 1e-11, *([1e-12] if loops < 10 else [])):
        run = lagjax.simulate_batch(system, q0, qdot0, ts, rtol=rtol)
        ok = np.asarray(run.ok)
        assert ok.all() if rtol > 1e-12 else ok.mean() > 0.9
        expected = joints(np.cos(free.q), np.sin(free.q))
        np.testing.assert_allclose(run.q[ok], expected[ok], atol=10 * rtol)


ARM, SIDE = 2.0, 1.0  # of the Peaucellier linkage


def peaucellier(q, qdot):
    """Unit masses at the corners A, B, C, D of its rhombus; gravity along −y."""
    return 0.5 * jnp.sum(qdot**2) - 3.0 * jnp.sum(q.reshape(-1, 2)[:, 1])


def closed_peaucellier(q):
    """A and C are an arm away from the origin, and D is on a circle through it: B then moves on a straight line."""
    a, b, c, d = q.reshape(-1, 2)
    radius = 0.5 * (ARM + SIDE)  # the largest that lets D all around: the rhombus is flat where D is farthest
    arms = jnp.stack([a @ a, c @ c]) - ARM**2
    sides = jnp.stack([x @ x for x in (a - b, b - c, c - d, d - a)]) - SIDE**2
    return {"arms": arms, "sides": sides, "circle": jnp.sum((d - jnp.array([radius, 0.0])) ** 2) - radius**2}


def corners(angle):
    """A, B, C, D, where the line from the origin to D has this angle; A and C change sides at zero."""
    away = (ARM + SIDE) * jnp.cos(angle)
    out, side = (jnp.stack(x) for x in ((jnp.cos(angle), jnp.sin(angle)), (-jnp.sin(angle), jnp.cos(angle))))
    # sin²(α/2) = (l² − (L − d)²) / 4Ld by the law of cosines, with L + l − d = 2 (L + l) sin²(angle/2) taken out.
    half = jnp.sin(angle / 2) * jnp.sqrt((SIDE - ARM + away) * (ARM + SIDE) / (2 * ARM * away))
    along, across = ARM * (1 - 2 * half**2) * out, ARM * 2 * half * jnp.sqrt(1 - half**2) * side
    a, c, d = along + across, along - across, away * out
    return jnp.concatenate([a, a + c - d, c, d])


PEAUCELLIER = lagjax.System(peaucellier, constraints=closed_peaucellier)


def peaucellier_alone(angle, rate):
    return peaucellier(*jax.jvp(corners, (angle,), (rate,)))


PEAUCELLIER_ALONE = lagjax.System(peaucellier_alone)


@pytest.mark.slow
def test_a_peaucellier_linkage_passes_its_flat_rhombus():
    members, ts, rng = 60, np.linspace(0, 0.3, 4), np.random.default_rng(4)
    start, rate = rng.uniform(-0.9, -0.3, members), rng.uniform(2, 4, members)

    free = lagjax.simulate_batch(PEAUCELLIER_ALONE, start, rate, ts, rtol=1e-13)
    assert np.mean(free.q[:, -1] > 0) > 0.9
    q0, qdot0 = jax.vmap(lambda angle, rate: jax.jvp(corners, (angle,), (rate,)))(start, rate)
    for rtol in (1e-7, 1e-9, 1e-10):
        run = lagjax.simulate_batch(PEAUCELLIER, q0, qdot0, ts, rtol=rtol)
        assert run.ok.all() and drift(run) < DRIFT
        np.testing.assert_allclose(run.q, jax.vmap(jax.vmap(corners))(free.q), atol=10 * rtol)


def linkage(q, qdot):
    """Three bars of unit mass about pivots at 0 and `GROUND`, in the angles of the bars; gravity along −y."""
    a, b, c = q
    crank, follower = qdot[0] ** 2 / 6, qdot[2] ** 2 / 6
    coupler = 0.5 * (qdot[0] ** 2 + 2 * qdot[0] * qdot[1] * jnp.cos(a - b) + 4 * qdot[1] ** 2 / 3)
    return crank + coupler + follower - 9.81 * (1.5 * jnp.sin(a) + jnp.sin(b) + 0.5 * jnp.sin(c))


GROUND = 2.0, 0.3  # length and direction of the line between the pivots
LED = lagjax.System(weight, constraints=lambda q, t: jnp.stack([q[0] - t**2, q[1], q[0] + q[1] - t**2]))


def closed_linkage(q):
    length, lean = GROUND
    x = jnp.cos(q[0]) + length * jnp.cos(q[1]) - jnp.cos(q[2]) - length * jnp.cos(lean)
    y = jnp.sin(q[0]) + length * jnp.sin(q[1]) - jnp.sin(q[2]) - length * jnp.sin(lean)
    return {"x": x, "y": y}


LINKAGE = lagjax.System(linkage, constraints=closed_linkage)


def parallelogram(a, qdot):
    """The branch in which opposite bars stay parallel, in the angle of the crank."""
    return linkage((a, GROUND[1], a), (qdot, 0.0, qdot))


PARALLELOGRAM = lagjax.System(parallelogram)
TURNING_LADDER = lagjax.System(lambda a, v: ladder(jnp.stack([a, GROUND[1], a, a, a]), jnp.stack([v, 0, v, v, v])))


@pytest.mark.slow
def test_accelerations_where_a_parallelogram_is_flat():
    # In line, both constraints hold the same direction; the motion goes on as that of the parallelogram.
    minimal = PARALLELOGRAM
    away = np.array([0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-2])
    expected = jax.vmap(lambda angle: minimal.acceleration(angle, 3.0))(GROUND[1] + away)
    layout = Layout.from_state(np.zeros(3), np.zeros(3))
    motion = LINKAGE._motion(layout)
    for path in ("scalar", "array"):
        form = equations_of(Derivation(motion, layout, None, path=path))

        def accelerate(angle, form=form):
            state = jnp.stack([angle, GROUND[1] + 0 * angle, angle]), jnp.array([3.0, 0.0, 3.0])
            return form.acceleration(0.0, state, None)[0]

        found = jax.jit(jax.vmap(accelerate))(GROUND[1] + away)
        # Beyond `rank_tolerance`, 6e-6 away, the second direction is known to eps/away²; within, it is not held at all
        # and off by what the forces do in it, in proportion to the distance.
        np.testing.assert_allclose(found, np.stack([expected, 0 * expected, expected], axis=1), rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_parallelogram_linkages_pass_the_flat_configuration():
    members = 100
    start, ts = GROUND[1] + np.random.default_rng(0).uniform(0.2, 1.2, members), np.linspace(0, 1.5, 4)
    still, turning = np.zeros(members), np.full(members, -3.0)
    system = LINKAGE
    free = lagjax.simulate_batch(PARALLELOGRAM, start, turning, ts, rtol=1e-12)
    q0, qdot0 = np.stack([start, GROUND[1] + still, start], 1), np.stack([turning, still, turning], 1)
    run = lagjax.simulate_batch(system, q0, qdot0, ts, rtol=1e-8)
    assert np.all(free.q[:, -1] < GROUND[1] - 0.5) and run.ok.all() and drift(run) < DRIFT
    # The coupler hardly turns: it is measured by what carries it, and costs no steps of its own.
    assert np.mean(run.stats["num_accepted_steps"]) < 2 * np.mean(free.stats["num_accepted_steps"])
    np.testing.assert_allclose(run.q, np.stack([free.q, GROUND[1] + 0 * free.q, free.q], axis=-1), atol=1e-6)


def in_units(q, qdot):  # the first coordinate in millimetres
    return weight(jnp.stack([q[0] / 1e3, q[1]]), jnp.stack([qdot[0] / 1e3, qdot[1]]))


SCALED_ROD = lagjax.System(in_units, constraints=lambda q: rod(jnp.stack([q[0] / 1e3, q[1]])))


def test_units_of_constrained_coordinates_do_not_matter():
    (q0, qdot0), ts, unit = hung(1.0, 0.5), np.linspace(0, 5, 3), np.array([1e3, 1])
    plain = lagjax.simulate(WEIGHT_ON_A_ROD, q0, qdot0, ts)
    scaled = lagjax.simulate(SCALED_ROD, q0 * unit, qdot0 * unit, ts)
    np.testing.assert_allclose(scaled.q / unit, plain.q, rtol=1e-10, atol=1e-10)
    assert abs(int(scaled.stats["num_accepted_steps"]) - int(plain.stats["num_accepted_steps"])) <= 2


@pytest.mark.slow
def test_more_constraints_than_coordinates():
    # A sphere four times over, in three coordinates.
    scene = scenes.particle_on_sphere()
    sphere = code(scene.system.constraints)
    many = rebuilt(scene.system, constraints=lambda q, params: sphere(q, params)["sphere"] * jnp.array([1, -2, 1e3, 1]))
    ts = np.linspace(0, 0.6, 3)
    once, often = (
        lagjax.simulate(system, scene.q0, scene.qdot0, ts, scene.params, rtol=1e-11) for system in (scene.system, many)
    )
    np.testing.assert_allclose(np.array(often.q), np.array(once.q), atol=1e-10)
    np.testing.assert_allclose(often.multipliers @ np.array([1, -2, 1e3, 1]), once.multipliers["sphere"], rtol=1e-9)


def test_a_prescribed_motion_leaves_nothing_to_move_but_something_to_carry_it_out():
    ts = np.linspace(0, 0.6, 3)
    run = lagjax.simulate(LED, np.zeros(2), np.zeros(2), ts)
    np.testing.assert_allclose(run.q[:, 0], ts**2, atol=1e-12)
    np.testing.assert_allclose(run.constraint_force(), np.tile([2, 9.81], (3, 1)), rtol=1e-9)


def ladder(q, qdot):
    """`linkage`, with two more bars of unit mass in the middle that are pivoted on the ground and on the coupler."""
    middle = qdot[3] ** 2 / 6 + qdot[4] ** 2 / 6 - 9.81 * 0.5 * (jnp.sin(q[3]) + jnp.sin(q[4]))
    return linkage(q[:3], qdot[:3]) + middle


def closed_ladder(q):
    length, lean = GROUND
    closed = {}
    for name, part, bar in (("end", 1.0, q[2]), ("first", 0.3, q[3]), ("second", 0.6, q[4])):
        across = part * length * (jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])]) - np.array([np.cos(lean), np.sin(lean)]))
        closed[name] = jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])]) + across - jnp.stack([jnp.cos(bar), jnp.sin(bar)])
    return closed


# Six constraints on five coordinates, four of them independent.
TRUSS = lagjax.System(ladder, constraints=closed_ladder)


TORN_TRUSS = lagjax.System(ladder, constraints=lambda q: closed_ladder(q) | {"wrong": q[2] - q[0] - 0.1})


@pytest.mark.slow
def test_a_linkage_held_by_more_bars_than_it_needs():
    ts, start, lean = np.linspace(0, 0.5, 3), 1.4, GROUND[1]
    free = lagjax.simulate(TURNING_LADDER, start, 0.4, ts, rtol=1e-11)
    q0, qdot0 = np.array([start, lean, start, start, start]), np.array([0.4, 0, 0.4, 0.4, 0.4])
    run = lagjax.simulate(TRUSS, q0, qdot0, ts, rtol=1e-11)
    np.testing.assert_allclose(run.q, np.stack([free.q, lean + 0 * free.q, *[free.q] * 3], axis=1), atol=1e-9)
    assert drift(run) < DRIFT
    facts = TRUSS.explain(run.q[1], run.qdot[1])
    assert len(facts.constraints) == 6 and len(facts.dependent_constraints) == 2
    with pytest.raises(ValueError, match=r"constraints\['wrong'\] contradicts"):
        lagjax.simulate(TORN_TRUSS, run.q[0], run.qdot[0], ts)


# ---- derivatives and other transformations ---------------------------------------------------------------------------


def outcome(system, x, beside=0.0, **options):
    """A number that depends on where a pendulum ends and on its tension there, after a start beside its circle."""
    angle, params = x[0], {"m": 1.0, "l": x[1], "g": x[2]}
    q0, qdot0 = x[1] * jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), 0.3 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    if beside:
        q0, qdot0 = system.project((1 + beside) * q0 + beside, qdot0 + beside, params=params)
    run = lagjax.simulate(system, q0, qdot0, np.array([0.0, 1.0]), params, **options)
    return run.q[-1, 0] + 0.3 * run.qdot[-1, 1] + 0.1 * run.multipliers["rod"][-1]


POINTS = np.array([[0.8, 1.3, 9.0], [0.9, 1.4, 9.1]])  # angle, length, g


@pytest.mark.slow
def test_gradients_through_projection_motion_and_multipliers():
    def of(x):
        return outcome(scenes.cartesian_pendulum().system, x, beside=0.1, rtol=1e-11)

    value = jax.jit(jax.vmap(of))
    # The error of a central difference: 1e-8 of third derivatives of size one, and 1e-11/1e-4.
    central = np.stack([(value(POINTS + e) - value(POINTS - e)) / 2e-4 for e in 1e-4 * np.eye(3)], axis=1)
    reverse = jax.jit(jax.vmap(jax.grad(of)))(POINTS)
    np.testing.assert_allclose(reverse, central, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_gradients_by_machine_code_are_those_along_the_steps_of_diffrax():
    def of(x, **options):
        return outcome(scenes.cartesian_pendulum().system, x, **options)

    forward = jax.jit(jax.jacfwd(lambda x: of(x, rtol=1e-11)))(POINTS[0])
    for derivative, solver, adjoint in (
        (jax.grad, lagjax.FineOutput(diffrax.Tsit5()), None),
        (jax.jacfwd, diffrax.Tsit5(), diffrax.ForwardMode()),  # where forward mode must be asked for
    ):
        by_steps = derivative(lambda x, s=solver, a=adjoint: of(x, solver=s, adjoint=a, rtol=1e-9))
        np.testing.assert_allclose(jax.jit(by_steps)(POINTS[0]), forward, rtol=1e-6)


@pytest.mark.slow
def test_jit_and_vmap_change_nothing():
    scene = scenes.cartesian_pendulum()
    q0, qdot0 = jax.vmap(hung)(np.array([0.5, 1.0, 1.5]), np.array([0.0, 0.3, -0.5]))
    ts = np.linspace(0, 1, 3)

    def run(q, v):
        trajectory = lagjax.simulate(scene.system, q, v, ts, scene.params)
        return trajectory.q, trajectory.multipliers["rod"], trajectory.constraint_residual()["rod"]

    mapped, batch = jax.jit(jax.vmap(run))(q0, qdot0), lagjax.simulate_batch(scene.system, q0, qdot0, ts, scene.params)
    np.testing.assert_allclose(mapped[0], batch.q, rtol=1e-14)
    np.testing.assert_allclose(mapped[1], batch.multipliers["rod"], rtol=1e-13)
    assert mapped[2].shape == (3, 3) and np.max(np.abs(mapped[2])) < DRIFT
    np.testing.assert_allclose(run(q0[1], qdot0[1])[0], mapped[0][1], rtol=1e-14)


@pytest.mark.slow
def test_single_precision():
    system = WEIGHT_ON_A_ROD
    q0, qdot0 = (np.float32(x) for x in hung(1.0, 0.5))
    ts = np.linspace(0, 2, 5)
    fine = lagjax.simulate(system, *hung(1.0, 0.5), ts)
    run = lagjax.simulate(system, q0, qdot0, ts)
    assert run.q.dtype == run.multipliers["rod"].dtype == jnp.float32
    assert drift(run) < 1e-6  # a few units of round-off
    np.testing.assert_allclose(run.q, fine.q, atol=1e-3)
    np.testing.assert_allclose(run.multipliers["rod"], fine.multipliers["rod"], rtol=1e-3)


def test_backward_in_time():
    system = WEIGHT_ON_A_ROD
    there = lagjax.simulate(system, *hung(1.0, 0.5), np.linspace(0, 3, 4), rtol=1e-12)
    back = lagjax.simulate(system, there.q[-1], there.qdot[-1], np.linspace(3, 0, 4), rtol=1e-12)
    np.testing.assert_allclose(back.q, there.q[::-1], atol=1e-10)
    assert drift(back) < DRIFT


# ---- projection ------------------------------------------------------------------------------------------------------


def two_masses(q, qdot):
    return 0.5 * (qdot[0] ** 2 + 9 * qdot[1] ** 2) - 9.81 * q[1]


def bow(q):
    return {"bow": q[1] - q[0] ** 2}


TWO_MASSES = lagjax.System(two_masses, constraints=bow)
TORN_VELOCITIES = lagjax.System(free_particles, velocity_constraints=lambda q, v: jnp.stack([v[0], v[0] - q[0]]))
NOWHERE = lagjax.System(weight, constraints=lambda q: 1 + q[0] ** 2)
HERE_AND_THERE = lagjax.System(weight, constraints=lambda q: {"here": q[0], "there": q[0] - 1.0})


@pytest.mark.slow
def test_projection_goes_to_the_nearest_state_in_the_metric_of_the_masses():
    system, M = TWO_MASSES, np.diag([1.0, 9.0])
    q0, v0 = np.array([0.8, -0.5]), np.array([1.0, 2.0])
    q, v = system.project(q0, v0)
    x = np.linspace(-1, 1, 200_001)
    distances = (x - q0[0]) ** 2 + 9 * (x**2 - q0[1]) ** 2
    assert abs(q[0] - x[np.argmin(distances)]) < 1e-5 and abs(q[1] - q[0] ** 2) < 1e-15
    J = np.array([-2 * q[0], 1.0])
    across = np.array([J[1], -J[0]])
    # What was moved is M⁻¹Jᵀμ: of no work along the constraint.
    assert abs(across @ M @ (q - q0)) < 1e-14 and abs(across @ M @ (v - v0)) < 1e-14
    assert abs(J @ v) < 1e-15
    again = system.project(q, v)
    np.testing.assert_allclose(again, (q, v), atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_projection_is_differentiated_as_the_function_it_is(derivative):
    system = TWO_MASSES
    state = np.array([0.8, -0.5, 1.0, 2.0])
    project = jax.jit(lambda x: jnp.concatenate(system.project(x[:2], x[2:])))
    central = [(project(state + e) - project(state - e)) / 2e-5 for e in 1e-5 * np.eye(4)]
    np.testing.assert_allclose(derivative(project)(state), np.stack(central, axis=1), atol=1e-8)


def circle(q):
    return q @ q - 1


def nearest_on_circle(x):
    u = x[:2] / jnp.linalg.norm(x[:2])
    return jnp.concatenate([u, x[2:] - u * (u @ x[2:])])  # the velocity without its radial part


def derivatives_of(function):
    """Value and two derivatives of a curve of states, forward, and the third of a number along it, reverse."""
    start, turn = jnp.array([1.3, 0.7, 0.2, -0.4]), jnp.array([0.6, -0.8, 0.3, 1.1])

    def orders(s):
        both = lambda s: jax.jvp(lambda s: function(start + s * turn), (s,), (1.0,))
        (value, first), (_, second) = jax.jvp(both, (s,), (1.0,))
        return second @ turn, (value, first, second)

    return orders, jax.value_and_grad(orders, has_aux=True)


ON_A_CIRCLE = lagjax.System(free_particles, constraints=circle)


@pytest.mark.slow
@pytest.mark.parametrize("reverse", [False, True])
def test_projection_has_the_derivatives_of_its_closed_form(reverse):
    found, exact = (
        jax.jit(derivatives_of(of)[reverse])(0.0)
        for of in (lambda x: jnp.concatenate(ON_A_CIRCLE.project(x[:2], x[2:])), nearest_on_circle)
    )
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-14)


def test_velocities_that_cannot_be_met_have_nan_for_derivatives():
    velocity, slope = jax.jvp(
        jax.jit(lambda q: TORN_VELOCITIES.project(q, jnp.zeros(2))[1]), (np.ones(2),), (np.ones(2),)
    )
    assert np.isnan(velocity).all() and np.isnan(slope).all()


@pytest.mark.slow
def test_a_state_without_a_nearest_one_has_nan_for_derivatives_and_leaves_its_neighbours_alone():
    root = lambda q: jnp.sqrt(q[0] - 1.0) + q[1]
    states = np.array([[1.3, -0.4, 0.2, -0.4], [0.5, 0.2, 0.2, -0.4]])
    system = particles(constraints=root)
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda x: jnp.concatenate(system.project(x[:2], x[2:])))))(states)
    assert np.isfinite(slopes[0]).all() and np.isnan(slopes[1]).all()


@pytest.mark.slow
def test_projection_of_moving_and_velocity_constraints():
    moving = WEIGHT_ON_A_SLIDE
    q, v = moving.project(jnp.array([3.0, 1.0]), jnp.array([5.0, -1.0]), 0.4)
    np.testing.assert_allclose((q, v), ([np.sin(0.4), 1.0], [np.cos(0.4), -1.0]), rtol=1e-15)
    blade = scenes.knife_edge()
    _, v = blade.system.project(blade.q0, scenes.Blade(1.0, 2.0, 3.0), params=blade.params)
    np.testing.assert_allclose(v, (1.0, 0.0, 3.0), atol=1e-15)


@pytest.mark.slow
def test_projection_is_nan_where_there_is_nothing_to_find():
    assert np.isnan(NOWHERE.project(np.array([0.7, 0.2]), np.zeros(2))[0]).all()
    assert np.isnan(HERE_AND_THERE.project(np.zeros(2), np.zeros(2))[0]).all()


# ---- what is refused -------------------------------------------------------------------------------------------------

ORIGIN, REST = np.zeros(2), np.zeros(2)


STARTS = [
    (lambda q: {"rod": q @ q - 1}, [0.0, -1.1], REST, r"not satisfy .*\['rod'\]: it is 0.21 .* of 0.0955. .*project"),
    (lambda q: {"rod": q @ q - 1}, [0.0, -1.0], [0.1, 0.2], r"qdot0 does not satisfy constraints\['rod'\]"),
    (lambda q: jnp.stack([q[0], q[1], q[0] + q[1]]), ORIGIN, REST, r"3 constraints .* for 2 coordinates, and 2"),
    (lambda q: jnp.stack([q[0], 2 * q[0], q[0] + 1.0]), ORIGIN, REST, r"\[2\] contradicts .*\[0\]"),
    (lambda q: {"root": jnp.sqrt(q[0] - 1)}, ORIGIN, REST, r"constraints\['root'\] is not finite"),
    (lambda q: {"flat": q[0] ** 2}, ORIGIN, REST, r"constraints\['flat'\] has zero gradient"),
    (lambda q: {"a": q[0], "b": q[0] - 1.0}, ORIGIN, REST, r"\['b'\] contradicts constraints\['a'\]: .*of q0"),
    (lambda q, t: {"a": q[0], "b": q[0] - t}, ORIGIN, REST, r"\['b'\] contradicts .* another value of qdot0"),
    (lambda q, t: {"a": q[0], "b": q[0] - t**2}, ORIGIN, REST, r"contradicts .* value of the acceleration"),
    # They hold the same circle, also where they ask for different steps towards it.
    (lambda q: [q @ q - 1, jnp.sqrt(q @ q) - 1], [0.0, -2.0], REST, r"q0 does not satisfy constraints\[0\]"),
]
KEPT = ("project", "qdot0 does not", "not finite", "zero gradient", "value of qdot0", "value of the acceleration")


@pytest.mark.parametrize(
    ("constraints", "q0", "qdot0", "sentence"),
    sweep(STARTS, kept=lambda start: any(words in start[-1] for words in KEPT)),
)
def test_starts_that_cannot_be(constraints, q0, qdot0, sentence):
    system = weight_on(constraints=constraints)
    with pytest.raises(ValueError, match=sentence):
        lagjax.simulate(system, np.array(q0), np.array(qdot0), np.array([0.0, 1.0]))


def test_members_that_start_off_their_constraints_are_refused_alone():
    system = WEIGHT_ON_A_ROD
    q0 = np.array([[0.0, -1.0], [0.0, -1.2], [1.0, 0.0]])
    run = lagjax.simulate_batch(system, q0, np.zeros((3, 2)), np.linspace(0, 1, 3))
    assert run.ok.tolist() == [True, False, True]
    assert (run.result == lagjax.RESULTS.inconsistent_start).tolist() == [False, True, False]
    assert np.isnan(run.q[1]).all() and np.isfinite(run.q[::2]).all()


LINKS = lagjax.System(  # coordinates that are deviations from a drawn pose begin at zero, beside links of 0.1 to 0.3 m
    lambda q, v: 0.5 * v @ v - 0.5 * q @ q,
    constraints=lambda q, params: params[0] + q[0] + params[1] - q[1] - params[2],
    velocity_constraints=lambda q, v, params: params[0] + v[1] + params[1] - v[2] - params[2],
)
GIVEN_MASSES = lagjax.System(lambda q, v, params: 0.5 * v @ params @ v - q[1], constraints=lambda q: jnp.sum(q) - 3.0)
METRES = [(metre, np.array([0.1, 0.2, 0.3]) * metre, 1e-12 * metre * np.eye(3)[0]) for metre in (1.0, 1e-10, 1e11)]


def test_starts_at_zero_are_off_by_rounding_of_the_terms():
    rest, ts = np.zeros(3), np.array([0.0, 1.0])
    for metre, links, off in METRES:
        assert abs(lagjax.simulate(LINKS, rest, rest, ts, links).q).max() < 1e-15 * metre
        batch = lagjax.simulate_batch(LINKS, np.stack([rest, off]), np.zeros((2, 3)), ts, links)
        assert batch.ok.tolist() == [True, False]
        with pytest.raises(ValueError, match="q0 does not satisfy constraints: it is "):
            lagjax.simulate(LINKS, off, rest, ts, links)
        assert "inconsistent_start" not in lagjax.check(LINKS, rest, rest, params=links).kinds


@pytest.mark.slow
def test_what_is_found_at_zero_is_exact_to_rounding_of_the_terms():
    rest, many = np.zeros(3), jax.jit(jax.vmap(LINKS.project, in_axes=(0, 0, None, None)))
    for metre, links, off in METRES:
        starts = np.stack([rest, off, 1e6 * off])
        q, qdot = many(starts, starts, 0.0, links)
        np.testing.assert_allclose(q, starts[:, :1] * [0.5, 0.5, 0], atol=3e-16 * metre)
        np.testing.assert_allclose(qdot, starts[:, :1] * np.ones(3) / 3, atol=3e-16 * metre)
        np.testing.assert_allclose(LINKS.project(off, off, 0.0, links)[0], q[1], atol=3e-16 * metre)
        assert abs(lagjax.equilibrium(LINKS, rest, links).q).max() < 1e-15 * metre


NAMED_TWICE = lagjax.System(weight, constraints=lambda q: {"x": q[0]}, velocity_constraints=lambda q, v: {"x": v[1]})


def test_signatures_and_names_that_are_refused():
    with pytest.raises(TypeError, match=r"constraints must have the form constraints\(q\)"):
        weight_on(constraints=lambda: 0.0)
    with pytest.raises(TypeError, match="asks for `qdot`"):
        weight_on(constraints=lambda q, qdot: q[0])
    with pytest.raises(TypeError, match=r"velocity_constraints must have the form"):
        weight_on(velocity_constraints=lambda q: q[0])
    with pytest.raises(ValueError, match="have the same name: x"):
        NAMED_TWICE.acceleration(ORIGIN, REST)
    for nothing in (lambda q: {}, lambda q: jnp.zeros(0)):
        with pytest.raises(TypeError, match="at least one number"):
            weight_on(constraints=nothing).acceleration(ORIGIN, REST)
    with pytest.raises(TypeError, match="real floating-point"):
        weight_on(constraints=lambda q: q[0] > 0).acceleration(ORIGIN, REST)
    for question in ("multipliers", "constraint_force", "constraint_residual", "project"):
        with pytest.raises(ValueError, match="no constraints"):
            getattr(WEIGHT, question)(ORIGIN, REST)


@pytest.mark.parametrize("first", [1.3, pytest.param(-1.3, marks=pytest.mark.slow)])
def test_a_constrained_mass_matrix_among_the_parameters(first):
    """In machine code where it is positive definite as given; else diffrax pivots, and `explain` says why."""
    mass, ones = np.diag([first, 2.0, 3.0]) + 0.1, np.ones((1, 3))
    pull = np.linalg.solve(np.block([[mass, ones.T], [ones, np.zeros((1, 1))]]), [0.0, -1.0, 0.0, 0.0])[:3]
    run = lagjax.simulate(GIVEN_MASSES, np.ones(3), np.array([1.0, -1.0, 0.0]), np.array([0.0, 1.0]), mass)
    np.testing.assert_allclose(run.q[-1], np.array([2.0, 0.0, 1.0]) + pull / 2, atol=1e-9)
    said = str(GIVEN_MASSES.explain(np.ones(3), np.zeros(3), params=mass))
    assert ("Taylor series in machine code" if first > 0 else "needs pivoting") in said
