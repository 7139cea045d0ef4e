"""Forces that read the multipliers: dry friction on a wire and in a bearing, against closed forms and DOP853."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lagjax

G, LENGTH, MASS, INERTIA, RADIUS = 9.81, 0.7, 1.3, 0.2, 0.1


def gravity(q, v):
    return 0.5 * v @ v - G * q[1]


def rub(q, v, params, multipliers):
    """μ |N| against the motion along a hoop, with N = λ |∇f|."""
    along = jnp.array([-q[1], q[0]])
    return -params * jnp.abs(multipliers) * 2 * jnp.sqrt(q @ q) * jnp.sign(along @ v) * along


BEAD = lagjax.System(gravity, forces=rub, constraints=lambda q: q @ q - 1.0)
BOTTOM = jnp.array([0.0, -1.0])


def follow_bead(friction, speed, duration, **options):
    return lagjax.simulate(BEAD, BOTTOM, jnp.array([speed, 0.0]), jnp.linspace(0.0, duration, 3), friction, **options)


def angle_of_rest(friction, speed):
    """From v² with dv²/dθ = −2g sin θ ∓ 2μ (v² + g cos θ), linear between the zeros of v and of N = v² + g cos θ."""
    angle, square, forward, side = 0.0, speed**2, 1.0, 1.0
    for _ in range(60):
        rate = 2 * friction * side * forward
        a, b = np.array([-6 * G * rate / 2, 2 * G * (1 - rate**2 / 2)]) / (1 + rate**2)
        start = (square - a * np.sin(angle) - b * np.cos(angle)) * np.exp(rate * angle)

        def squares(x, start=start, rate=rate, a=a, b=b):
            return start * np.exp(-rate * x) + a * np.sin(x) + b * np.cos(x)

        def normals(x, squares=squares):
            return squares(x) + G * np.cos(x)

        grid = angle + forward * np.linspace(1e-6, 8 * np.pi, 80_001)
        first = np.argmax((squares(grid) < 0) | (side * normals(grid) < 0))
        stops = squares(grid[first]) < 0
        angle = brentq(squares if stops else normals, grid[first - 1], grid[first], xtol=1e-15)
        square, side = (0.0, np.sign(np.cos(angle))) if stops else (squares(angle), -side)
        if stops and abs(np.tan(angle)) <= friction:
            return angle
        forward = -np.sign(np.sin(angle)) if stops else forward
    raise AssertionError("no rest")


def angle_of(trajectory):
    return jnp.arctan2(trajectory.q[-1, 0], -trajectory.q[-1, 1])


@pytest.mark.parametrize(("friction", "speed"), [(0.1, 9.0), (0.3, 3.0), (0.3, 7.0), (0.5, 6.5)])
def test_bead_on_hoop_stops_where_the_closed_form_does_and_rests(friction, speed):
    run = follow_bead(friction, speed, 40.0)
    assert float(angle_of(run)) == pytest.approx(
        (angle_of_rest(friction, speed) + np.pi) % (2 * np.pi) - np.pi, abs=2e-11
    )
    assert jnp.abs(run.qdot[-1]).max() < 1e-28
    # As exactly as the constraint brings it back.
    np.testing.assert_allclose(run.q[-1], run.q[-2], atol=1e-15)


@pytest.mark.slow
def test_bead_has_first_and_second_derivatives_by_its_friction():
    def angle(friction):
        return angle_of(follow_bead(friction, 7.0, 8.0))

    step = 1e-4
    exact = [angle_of_rest(0.3 + k * step, 7.0) for k in (-2, -1, 0, 1, 2)]
    slope = np.dot([1, -8, 0, 8, -1], exact) / (12 * step)
    bend = np.dot([-1, 16, -30, 16, -1], exact) / (12 * step**2)
    assert float(jax.grad(angle)(0.3)) == pytest.approx(slope, rel=1e-9)
    assert float(jax.jvp(angle, (0.3,), (1.0,))[1]) == pytest.approx(slope, rel=1e-9)
    assert float(jax.hessian(angle)(0.3)) == pytest.approx(bend, rel=1e-5)  # of the differences: eps / step²
    assert float(jax.jit(angle)(0.3)) == float(angle(0.3))
    frictions = jnp.array([0.1, 0.3])
    np.testing.assert_allclose(jax.vmap(angle)(frictions), [angle(x) for x in frictions], atol=1e-14)


@pytest.mark.slow
def test_a_friction_that_is_closed_over_has_the_same_slope():
    def end(friction):
        def forces(q, v, multipliers):
            return rub(q, v, friction, multipliers)

        system = lagjax.System(gravity, forces=forces, constraints=lambda q: q @ q - 1.0)
        return lagjax.simulate(system, BOTTOM, jnp.array([7.0, 0.0]), jnp.linspace(0.0, 0.4, 3)).q[-1, 0]

    given = jax.grad(lambda x: follow_bead(x, 7.0, 0.4).q[-1, 0])(0.3)
    assert float(jax.grad(end)(0.3)) == pytest.approx(float(given), rel=1e-12)


def test_bead_in_float32_and_by_arrays():
    given = [x.astype(jnp.float32) for x in (BOTTOM, jnp.array([7.0, 0.0]), jnp.linspace(0.0, 4.0, 3))]
    narrow = lagjax.simulate(BEAD, *given, jnp.float32(0.3))
    np.testing.assert_allclose(narrow.q, follow_bead(0.3, 7.0, 4.0).q, atol=1e-6)
    by_arrays = lagjax.System(gravity, forces=rub, constraints=lambda q: q @ q - 1.0, path="array")
    state = BOTTOM, jnp.array([7.0, 0.0])
    for system in (BEAD, by_arrays):
        np.testing.assert_allclose(system.acceleration(*state, params=0.3), [-0.3 * (49 + G), 49.0], rtol=1e-14)
        assert float(system.multipliers(*state, params=0.3)) == pytest.approx(-(49 + G) / 2, rel=1e-14)
        np.testing.assert_allclose(system.generalized_force(*state, params=0.3), [-0.3 * (49 + G), -G], rtol=1e-14)


def test_forces_that_read_multipliers_follow_a_change_of_coordinates():
    polar = lagjax.change_coordinates(BEAD, lambda p: p["r"] * jnp.array([jnp.sin(p["phi"]), -jnp.cos(p["phi"])]))
    state = {"phi": 0.3, "r": 1.0}, {"phi": 2.0, "r": 0.0}
    found = polar.system.acceleration(*state, params=0.3)["phi"]
    assert float(found) == pytest.approx(-G * np.sin(0.3) - 0.3 * (4.0 + G * np.cos(0.3)), rel=1e-14)


# ---- a bearing: the length of its force, and a law that friction itself changes --------------------------------------


def pendulum(q, v):
    return 0.5 * MASS * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * INERTIA * v["phi"] ** 2 - MASS * G * q["y"]


def bearing(q):
    return {"x": q["x"] - LENGTH * jnp.sin(q["phi"]), "y": q["y"] + LENGTH * jnp.cos(q["phi"])}


def turn_against(q, v, params, multipliers):
    force = jnp.sqrt(multipliers["x"] ** 2 + multipliers["y"] ** 2)
    return {"x": 0.0 * q["x"], "y": 0.0 * q["y"], "phi": -params * RADIUS * force * jnp.sign(v["phi"])}


def bearing_acceleration(phi, rate, friction, side):
    """φ̈ with N² = (radial force)² + (transverse force)², which is a quadratic equation for N."""
    whole, torque = INERTIA + MASS * LENGTH**2, MASS * G * LENGTH * np.sin(phi)
    radial = MASS * LENGTH * rate**2 + MASS * G * np.cos(phi)
    across = MASS * G * np.sin(phi) - MASS * LENGTH * torque / whole
    own = MASS * LENGTH * friction * RADIUS * side / whole
    left = 1 - own**2
    force = (-own * across + np.sqrt((own * across) ** 2 + left * (across**2 + radial**2))) / left
    return -(torque + friction * RADIUS * side * force) / whole


def follow_bearing_exactly(friction, rate, duration):
    t, y, side = 0.0, np.array([0.0, rate]), np.sign(rate)
    while t < duration:

        def stops(t, y):
            return y[1]

        stops.terminal, stops.direction = True, -side
        solution = solve_ivp(
            lambda t, y, side=side: [y[1], bearing_acceleration(*y, friction, side)],
            (t, duration), y, method="DOP853", rtol=1e-13, atol=1e-14, events=stops,
        )  # fmt: skip
        t, y = solution.t[-1], solution.y[:, -1]
        side = -np.sign(np.sin(y[0]))
        if solution.status == 1 and bearing_acceleration(y[0], 0.0, friction, side) * side <= 0:
            return y
    return y


@pytest.mark.parametrize(("friction", "duration"), [(0.3, 1.0), (2.0, 0.8), (2.0, 30.0), (5.0, 30.0)])
def test_pendulum_with_a_bearing_that_rubs(friction, duration):
    system = lagjax.System(pendulum, forces=turn_against, constraints=bearing)
    q0, qdot0 = {"x": 0.0, "y": -LENGTH, "phi": 0.0}, {"x": 6.0 * LENGTH, "y": 0.0, "phi": 6.0}
    run = lagjax.simulate(system, q0, qdot0, jnp.linspace(0.0, duration, 3), friction, rtol=1e-13)
    phi, rate = follow_bearing_exactly(friction, 6.0, duration)
    assert float(run.q["phi"][-1]) == pytest.approx(phi, abs=2e-11)
    assert float(run.qdot["phi"][-1]) == pytest.approx(rate, abs=2e-11)


# ---- a rod with its end on a wire: friction changes the force that it is proportional to -----------------------------


def rod(q, v):
    (_, y, phi), (u, w, rate) = q, v
    along, up = u + 0.5 * jnp.cos(phi) * rate, w + 0.5 * jnp.sin(phi) * rate
    return 0.5 * (along**2 + up**2) + rate**2 / 24 - G * (y - 0.5 * jnp.cos(phi))


ROD = lagjax.System(
    rod, constraints=lambda q: q[1],
    forces=lambda q, v, params, multipliers: jnp.array([-params * jnp.abs(multipliers) * jnp.sign(v[0]), 0.0, 0.0]),
)  # fmt: skip


def rod_forces(phi, rate, friction, side):
    """ẍ, φ̈ and N of every solution with friction −μ |N| in the direction of x."""
    for sign in (1, -1):
        c, s = 0.5 * np.cos(phi), 0.5 * np.sin(phi)
        matrix = np.array([[1, c, friction * sign * side], [c, 1 / 12 + 0.25, 0], [0, s, -1]])
        solution = np.linalg.solve(matrix, [s * rate**2, -G * s, -G - c * rate**2])
        if solution[2] * sign >= 0:
            yield solution


@pytest.mark.parametrize("friction", [0.1, 0.45])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_friction_that_changes_its_normal_force(friction, side):
    for phi, rate in [(0.4, 0.0), (1.2, 3.0), (3.0, 6.0), (-2.0, 8.0)]:
        (exact,) = rod_forces(phi, rate, friction, side)
        state = jnp.array([0.0, 0.0, phi]), jnp.array([side, 0.0, rate])
        np.testing.assert_allclose(ROD.acceleration(*state, params=friction)[jnp.array([0, 2])], exact[:2], rtol=1e-12)
        assert float(ROD.multipliers(*state, params=friction)) == pytest.approx(exact[2], rel=1e-12)


def test_paradox_of_a_rod_on_a_wire_is_not_a_number():
    """With none or two solutions the law says nothing: Painlevé's paradox."""
    state, friction = jnp.array([0.0, 0.0, 0.785]), 4.0
    counts = [len(list(rod_forces(0.785, 0.0, friction, side))) for side in (1.0, -1.0)]
    assert sorted(counts) == [0, 2]
    for side in (1.0, -1.0):
        velocity = jnp.array([side, 0.0, 0.0])
        assert jnp.isnan(ROD.acceleration(state, velocity, params=friction)).all()
    with pytest.raises(lagjax.SimulationError, match="Painlevé"):
        lagjax.simulate(ROD, state, velocity, jnp.array([0.0, 0.1]), friction)


# ---- two at once, and what has no multipliers ------------------------------------------------------------------------


@pytest.mark.slow
def test_two_beads_rub_as_each_does_alone():
    def forces(q, v, params, multipliers):
        return jnp.stack([rub(q[k], v[k], params, multipliers[k]) for k in range(2)])

    both = lagjax.System(
        lambda q, v: gravity(q[0], v[0]) + gravity(q[1], v[1]), forces=forces,
        constraints=lambda q: jnp.sum(q * q, axis=1) - 1.0,
    )  # fmt: skip
    qdot0 = jnp.array([[3.0, 0.0], [7.0, 0.0]])
    run = lagjax.simulate(both, jnp.stack([BOTTOM] * 2), qdot0, jnp.linspace(0.0, 8.0, 3), 0.3)
    for k in range(2):
        np.testing.assert_allclose(run.q[-1, k], follow_bead(0.3, float(qdot0[k, 0]), 8.0).q[-1], atol=2e-11)


def test_friction_by_one_multiplier_of_two_takes_what_it_works_and_lets_a_joint_rest():
    """A double pendulum of points, whose first rod rubs in its bearing: it stops while the second one swings."""

    def forces(q, v, params, multipliers):
        along = jnp.array([-q[0, 1], q[0, 0]])
        return jnp.zeros_like(q).at[0].set(-params * jnp.abs(multipliers[0]) * jnp.sign(along @ v[0]) * along)

    double = lagjax.System(
        lambda q, v: gravity(q[0], v[0]) + gravity(q[1], v[1]), forces=forces,
        constraints=lambda q: jnp.stack([q[0] @ q[0], (q[1] - q[0]) @ (q[1] - q[0])]) - 1.0,
    )  # fmt: skip
    ts = jnp.linspace(0.0, 1.0, 2001)
    run = lagjax.simulate(double, jnp.array([[0.0, -1.0], [0.0, -2.0]]), jnp.array([[0.7, 0.0], [1.4, 0.0]]), ts, 0.1)
    first, rates = run.q[:, 0], run.qdot[:, 0]
    power = -0.1 * jnp.abs(run.multipliers[:, 0] * (first[:, 0] * rates[:, 1] - first[:, 1] * rates[:, 0]))
    lost = jnp.trapezoid(power, ts)
    assert lost < -0.05
    assert float(run.energy()[-1] - run.energy()[0]) == pytest.approx(float(lost), abs=1e-5)  # of 2000 trapezia


def test_a_law_that_is_linear_in_several_multipliers_needs_no_sign():
    """Against one linear system for accelerations and multipliers."""

    def forces(q, v, multipliers):
        torque = 0.3 * (multipliers["x"] - 2 * multipliers["y"])
        return {"x": 0.0 * q["x"], "y": 0.1 * multipliers["y"], "phi": torque}

    system = lagjax.System(pendulum, forces=forces, constraints=bearing)
    phi, rate = 0.4, 2.0
    c, s = LENGTH * np.cos(phi), LENGTH * np.sin(phi)
    q, v = {"x": s, "y": -c, "phi": phi}, {"x": c * rate, "y": s * rate, "phi": rate}
    matrix = np.array([  # phi, x, y, λ_x, λ_y
        [INERTIA, 0, 0, c - 0.3, s + 0.6], [0, MASS, 0, -1, 0], [0, 0, MASS, 0, -1.1],
        [-c, 1, 0, 0, 0], [-s, 0, 1, 0, 0],
    ])  # fmt: skip
    exact = np.linalg.solve(matrix, [0, 0, -MASS * G, -s * rate**2, c * rate**2])
    found = system.acceleration(q, v)
    np.testing.assert_allclose([found["phi"], found["x"], found["y"]], exact[:3], rtol=1e-12)


def test_forces_ask_for_multipliers_of_constraints_alone():
    with pytest.raises(ValueError, match="which this System has not"):
        lagjax.System(gravity, forces=rub)
    with pytest.raises(ValueError, match="their friction is friction="):
        lagjax.System(gravity, forces=rub, constraints=lambda q: q @ q - 1.0, contacts=lambda q: q[1] + 2.0)
