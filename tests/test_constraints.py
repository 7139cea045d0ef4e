"""Constraints: their forces, their drift, and the same motion in coordinates that need none.

There are two ways to a motion, machine code and diffrax, and two forms of its equations, scalar programs and arrays.
`WAYS` are their pairs; what follows from the equations alone is asked of all of them, the rest of the default. A run at
the tolerance r is off by about r times its number of steps and the growth of its own small errors.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import lagjax
from lagjax import scenes
from lagjax._linear import rank_tolerance

# The default; the array form on diffrax; the scalar form on diffrax.
WAYS = [("auto", None), ("array", None), ("auto", diffrax.Dopri8())]
IDS = ["machine code", "arrays", "diffrax"]
DRIFT = 1e-12


def drift(trajectory):
    return max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(trajectory.constraint_residual()))


def code(function):
    """The plain function behind what a `System` holds."""
    return None if function is None else function.code


def rebuilt(system, path="auto", **changed):
    parts = {name: code(getattr(system, name)) for name in ("constraints", "velocity_constraints")} | changed
    return lagjax.System(code(system.lagrangian), path=path, **parts)


def weight(q, qdot):
    return 0.5 * jnp.sum(qdot**2) - 9.81 * q[1]


def rod(q):
    return {"rod": 0.5 * (1 - q @ q)}


def hung(angle, rate=0.0):
    """The state of a pendulum of length 1."""
    return jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


# ---- forces of constraints -------------------------------------------------------------------------------------------


def test_the_force_between_rolling_cylinders_is_the_closed_form():
    scene, rng = scenes.rolling_cylinder(), np.random.default_rng(0)
    alpha, start = rng.uniform(0, 1, 200), rng.uniform(0.05, 0.5, 200)
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


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_chaplygin_sleigh(path, solver):
    scene = scenes.chaplygin_sleigh()
    system = rebuilt(scene.system, path)
    run = lagjax.simulate(system, scene.q0, scene.qdot0, [0.0, 5.0], scene.params, rtol=1e-12, solver=solver)
    u = run.qdot.x * jnp.cos(run.q.phi) + run.qdot.y * jnp.sin(run.q.phi)
    found = u[-1], run.qdot.phi[-1], run.q.phi[-1]
    np.testing.assert_allclose(found, [0.8271576446616773, 0.22982663184842, 7.047223949515657], rtol=1e-10)
    assert drift(run) < DRIFT


def vakonomic_knife_edge(t, y, g, J):
    """L + μ (ẏ cos φ − ẋ sin φ) varied as a whole, for unit mass: y = (x, y, φ, u, φ̇, μ)."""
    _, _, phi, u, w, mu = y
    return [u * np.cos(phi), u * np.sin(phi), w, g * np.cos(phi) - mu * w, mu * u / J, g * np.sin(phi) + w * u]


def test_a_velocity_constraint_is_nonholonomic_and_not_vakonomic():
    scene = scenes.knife_edge()
    run = lagjax.simulate(scene.system, scene.q0, scene.qdot0, [0.0, 2.0], scene.params, rtol=1e-12)
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


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_doubled_and_scaled_constraints_change_no_motion(path, solver):
    def many(q):
        return {"rod": rod(q)["rod"], "twice": 1e6 * rod(q)["rod"]}

    q0, qdot0 = hung(1.2, 0.5)
    ts, options = np.linspace(0, 2, 3), {"rtol": 1e-11, "solver": solver}
    once = lagjax.simulate(lagjax.System(weight, constraints=rod, path=path), q0, qdot0, ts, **options)
    scaled = lagjax.System(weight, constraints=lambda q: 1e6 * rod(q)["rod"], path=path)
    scaled = lagjax.simulate(scaled, q0, qdot0, ts, **options)
    twice = lagjax.System(weight, constraints=many, path=path)
    run = lagjax.simulate(twice, q0, qdot0, ts, **options)
    for other in (scaled, run):
        assert np.max(np.abs(other.q - once.q)) < 1e-10 and np.max(np.abs(other.qdot - once.qdot)) < 1e-10
    np.testing.assert_allclose(1e6 * scaled.multipliers, once.multipliers["rod"], rtol=1e-9)
    # Of all λ with λ₁ + 1e6 λ₂ = λ the shortest.
    shortest = {"rod": once.multipliers["rod"] / (1 + 1e12), "twice": 1e6 * once.multipliers["rod"] / (1 + 1e12)}
    for name, force in run.multipliers.items():
        np.testing.assert_allclose(force, shortest[name], rtol=1e-9)
    facts = twice.explain(q0, qdot0)
    assert facts.constraints == ("constraints['rod']", "constraints['twice']")
    assert facts.dependent_constraints == {"constraints['twice']": ("constraints['rod']",)}


def test_explain_says_what_constraints_cost_and_which_depend():
    q, v = jnp.array([0.6, -0.8, 0.0]), jnp.zeros(3)
    mixed = lambda q: {"a rod": rod(q)["rod"], "floor": q[2], "mix": rod(q)["rod"] + 3 * q[2]}
    facts = lagjax.System(weight, constraints=mixed).explain(q, v)
    assert facts.dependent_constraints == {"constraints['mix']": ("constraints['a rod']", "constraints['floor']")}
    assert facts.projection_operations > 0 and facts.energy_conserved
    assert "dependent         constraints['mix'] on constraints['a rod'], constraints['floor']" in str(facts)
    free = lagjax.System(weight).explain(q, v)
    assert free.constraints == () and free.projection_operations is None and "constraints" not in str(free)
    # A part of one constraint beside the other, squared, just above and below the stated tolerance.
    for part, dependent in ((2.0, False), (0.5, True)):
        near = np.sqrt(part * rank_tolerance(np.float64))
        leaning = lagjax.System(weight, constraints=lambda q, near=near: jnp.stack([q[0], q[0] + near * q[1]]))
        assert bool(leaning.explain(v, v).dependent_constraints) == dependent


def test_explain_knows_which_constraints_do_work():
    q = jnp.zeros(2)
    belt = lagjax.System(weight, velocity_constraints=lambda q, v: v[0] - 1.0)
    moving = lagjax.System(weight, constraints=lambda q, t: q[0] - jnp.sin(t))
    skate = lagjax.System(weight, velocity_constraints=lambda q, v: v[0] - q[1] * v[1])
    kept = [scene.explain(q, q).energy_conserved for scene in (belt, moving, skate)]
    assert kept == [False, False, True]
    assert [scene.explain(q, q).explicit_time for scene in (belt, moving, skate)] == [False, True, False]


# ---- constraints that move, mass matrices that are singular, ranks that drop -----------------------------------------


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_a_pendulum_on_a_shaken_support(path, solver):
    # ∂f/∂t and ∂²f/∂t² are all there is of the shaking. Its closed form is that of `driven_pendulum`.
    minimal = scenes.driven_pendulum()
    params = minimal.params | {"a": 0.3, "Omega": 5.0}

    def held(q, t, params):
        height = q[1] - params["a"] * jnp.cos(params["Omega"] * t)
        return {"rod": 0.5 * (1 - q[0] ** 2 - height**2)}

    system = lagjax.System(weight, constraints=held, path=path)
    angle, ts = 1.0, np.linspace(0, 2, 3)
    free = lagjax.simulate(minimal.system, angle, 0.0, ts, params, rtol=1e-12)
    q0 = jnp.array([jnp.sin(angle), 0.3 - jnp.cos(angle)])
    run = lagjax.simulate(system, q0, jnp.zeros(2), ts, params, rtol=1e-12, solver=solver)
    height = 0.3 * np.cos(5.0 * ts)
    expected = np.stack([np.sin(free.q), height - np.cos(free.q)], axis=1)
    assert np.max(np.abs(run.q - expected)) < 1e-10 and drift(run) < DRIFT


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_a_coordinate_without_mass_that_a_constraint_holds(path, solver):
    # The spring acts on z, which has no kinetic energy; z = x² ties it to the mass: ½ ẋ² − ½ (x²)².
    system = lagjax.System(
        lambda q, v: 0.5 * v[0] ** 2 - 0.5 * q[1] ** 2, constraints=lambda q: q[1] - q[0] ** 2, path=path
    )
    minimal = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**4)
    ts = np.linspace(0, 3, 3)
    free = lagjax.simulate(minimal, 1.1, 0.3, ts, rtol=1e-12)
    run = lagjax.simulate(
        system, jnp.array([1.1, 1.21]), jnp.array([0.3, 0.66]), ts, rtol=1e-12, solver=solver
    )
    np.testing.assert_allclose(run.q[:, 0], free.q, atol=1e-10)
    np.testing.assert_allclose(run.multipliers, run.q[:, 1], rtol=1e-12)  # λ = ∂U/∂z, all that acts on z
    assert drift(run) < DRIFT


def test_a_singular_saddle_point_is_reported():
    # Neither L nor the constraint holds q[1].
    system = lagjax.System(lambda q, v: 0.5 * v[0] ** 2 - q[1], constraints=lambda q: q[0] - 1.0)
    assert np.isnan(system.acceleration(jnp.array([1.0, 0.0]), jnp.zeros(2))).all()
    with pytest.raises(lagjax.SimulationError, match=r"singular"):
        lagjax.simulate(system, jnp.array([1.0, 0.0]), jnp.zeros(2), [0.0, 1.0])


def crank_alone(q, qdot, params):
    """A slider crank of equal bars in the angle of its crank alone: rod = −crank, x = 2 l cos(crank)."""
    l = params["l"][0]
    whole, moving = jax.jvp(lambda a: scenes.SliderCrank(a, -a, 2 * l * jnp.cos(a)), (q,), (qdot,))
    return code(scenes.slider_crank(1.0, 1.0).system.lagrangian)(whole, moving, params)


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_a_slider_crank_of_equal_bars_through_its_dead_centre(path, solver):
    # At crank = π/2 the second constraint has no gradient, and the bars might go on together instead.
    scene = scenes.slider_crank(1.0, 1.0)
    ts = np.linspace(0, 1.5, 4)
    free = lagjax.simulate(lagjax.System(crank_alone), scene.q0.crank, scene.qdot0.crank, ts, scene.params, rtol=1e-12)
    run = lagjax.simulate(
        rebuilt(scene.system, path), scene.q0, scene.qdot0, ts, scene.params, rtol=1e-12, solver=solver
    )
    assert free.q[-1] > np.pi / 2 + 1
    # A step that ends near the dead centre loses digits in proportion to how near.
    np.testing.assert_allclose(run.q.crank, free.q, atol=1e-8)
    np.testing.assert_allclose(run.q.x, 2 * np.cos(free.q), atol=1e-8)
    assert drift(run) < DRIFT


def linkage(q, qdot):
    """Three bars of unit mass about pivots at 0 and `GROUND`, in the angles of the bars; gravity along −y."""
    a, b, c = q
    crank, follower = qdot[0] ** 2 / 6, qdot[2] ** 2 / 6
    coupler = 0.5 * (qdot[0] ** 2 + 2 * qdot[0] * qdot[1] * jnp.cos(a - b) + 4 * qdot[1] ** 2 / 3)
    return crank + coupler + follower - 9.81 * (1.5 * jnp.sin(a) + jnp.sin(b) + 0.5 * jnp.sin(c))


GROUND = 2.0, 0.3  # length and direction of the line between the pivots


def closed_linkage(q):
    length, lean = GROUND
    x = jnp.cos(q[0]) + length * jnp.cos(q[1]) - jnp.cos(q[2]) - length * jnp.cos(lean)
    y = jnp.sin(q[0]) + length * jnp.sin(q[1]) - jnp.sin(q[2]) - length * jnp.sin(lean)
    return {"x": x, "y": y}


def parallelogram(a, qdot):
    """The branch in which opposite bars stay parallel, in the angle of the crank."""
    return linkage((a, GROUND[1], a), (qdot, 0.0, qdot))


@pytest.mark.parametrize("path", ["scalar", "array"])
def test_accelerations_where_a_parallelogram_is_flat(path):
    # In line, both constraints hold the same direction; the motion goes on as that of the parallelogram.
    system, minimal = lagjax.System(linkage, constraints=closed_linkage, path=path), lagjax.System(parallelogram)
    state = lambda angle: (jnp.stack([angle, GROUND[1] + 0 * angle, angle]), jnp.array([3.0, 0.0, 3.0]))
    away = np.array([0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-2])
    found = jax.vmap(lambda angle: system.acceleration(*state(angle)))(GROUND[1] + away)
    expected = jax.vmap(lambda angle: minimal.acceleration(angle, 3.0))(GROUND[1] + away)
    assert np.isfinite(found).all()
    # Where the rank counts as full, the second direction is known to eps/away² at worst eps^(1/3) = 6e-6.
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-5)


@pytest.mark.parametrize(("path", "solver"), WAYS, ids=IDS)
def test_a_parallelogram_linkage_through_the_flat_configuration(path, solver):
    system = lagjax.System(linkage, constraints=closed_linkage, path=path)
    ts = np.linspace(0, 1, 4)
    free = lagjax.simulate(lagjax.System(parallelogram), 1.0, -3.0, ts, rtol=1e-12)
    run = lagjax.simulate(
        system, jnp.array([1.0, GROUND[1], 1.0]), jnp.array([-3.0, 0, -3.0]), ts, rtol=1e-11, solver=solver
    )
    assert free.q[-1] < GROUND[1] - 0.5
    np.testing.assert_allclose(run.q, np.stack([free.q, 0 * free.q + GROUND[1], free.q], axis=1), atol=1e-7)
    assert drift(run) < DRIFT
