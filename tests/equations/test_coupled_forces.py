"""Forces that read the multipliers: dry friction on a wire and in a bearing, against closed forms and DOP853."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import weight_on
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from sweeps import sweep

import lagjax

G, LENGTH, MASS, INERTIA, RADIUS = 9.81, 0.7, 1.3, 0.2, 0.1


def gravity(q, v):
    return 0.5 * v @ v - G * q[1]


def rub(q, v, params, multipliers):
    """μ |N| against the motion along a hoop, with N = λ |∇f|."""
    along = jnp.array([-q[1], q[0]])
    return -params * jnp.abs(multipliers) * 2 * jnp.sqrt(q @ q) * jnp.sign(along @ v) * along


BEAD = lagjax.System(gravity, forces=rub, constraints=lambda q: q @ q - 1.0)
BY_ARRAYS = lagjax.System(gravity, forces=rub, constraints=lambda q: q @ q - 1.0, path="array")
BOTTOM = np.array([0.0, -1.0])


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
    assert np.abs(run.qdot[-1]).max() < 1e-28
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
    frictions = np.array([0.1, 0.3])
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
    state = BOTTOM, jnp.array([7.0, 0.0])
    for system in (BEAD, BY_ARRAYS):
        np.testing.assert_allclose(system.acceleration(*state, params=0.3), [-0.3 * (49 + G), 49.0], rtol=1e-14)
        assert float(system.multipliers(*state, params=0.3)) == pytest.approx(-(49 + G) / 2, rel=1e-14)
        np.testing.assert_allclose(system.generalized_force(*state, params=0.3), [-0.3 * (49 + G), -G], rtol=1e-14)


def test_forces_that_read_multipliers_follow_a_change_of_coordinates():
    polar = lagjax.change_coordinates(BEAD, lambda p: p["r"] * jnp.array([jnp.sin(p["phi"]), -jnp.cos(p["phi"])]))
    state = {"phi": 0.3, "r": 1.0}, {"phi": 2.0, "r": 0.0}
    found = polar.system.acceleration(*state, params=0.3)["phi"]
    assert float(found) == pytest.approx(-G * np.sin(0.3) - 0.3 * (4.0 + G * np.cos(0.3)), rel=1e-14)


# ---- a bearing: the size of its force, and a law that friction itself changes ----------------------------------------


def pendulum(q, v):
    return 0.5 * MASS * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * INERTIA * v["phi"] ** 2 - MASS * G * q["y"]


def bearing(q):
    return {"x": q["x"] - LENGTH * jnp.sin(q["phi"]), "y": q["y"] + LENGTH * jnp.cos(q["phi"])}


def length(force):
    return jnp.sqrt(force["x"] ** 2 + force["y"] ** 2)


def taxicab(force):
    return jnp.abs(force["x"]) + jnp.abs(force["y"])


def pendulum_that_rubs(size):
    """Its parameters: μ, and A and ω of a force A sin ωt that shakes it."""

    def forces(q, v, t, params, multipliers):
        friction, push, rate = params
        torque = -friction * RADIUS * size(multipliers) * jnp.sign(v["phi"])
        return {"x": push * jnp.sin(rate * t), "y": 0.0 * q["y"], "phi": torque}

    return lagjax.System(pendulum, forces=forces, constraints=bearing)


RUBBING = {length: pendulum_that_rubs(length), taxicab: pendulum_that_rubs(taxicab)}


def state_of(phi, rate):
    c, s = LENGTH * jnp.cos(phi), LENGTH * jnp.sin(phi)
    return {"x": s, "y": -c, "phi": phi}, {"x": c * rate, "y": s * rate, "phi": rate}


class ExactPendulum:
    """DOP853 for every mode, with sides 1, −1 of the motion and 0 of rest, between events."""

    def __init__(self, size, friction, push=0.0, rate=1.0):
        self.size = (lambda f: np.hypot(*f)) if size is length else lambda f: np.abs(f).sum()
        self.friction, self.push, self.rate, self.changes = friction, push, rate, []

    def force(self, t, phi, rate, torque):
        """φ̈ and the force of the bearing, under a torque of friction."""
        push, c, s = self.push * np.sin(self.rate * t), np.cos(phi), np.sin(phi)
        turns = (LENGTH * (push * c - MASS * G * s) + torque) / (INERTIA + MASS * LENGTH**2)
        along, towards = np.array([c, s]), np.array([-s, c])
        return turns, MASS * LENGTH * (turns * along + rate**2 * towards) - np.array([push, -MASS * G])

    def accelerate(self, t, phi, rate, side):
        torque, before = 0.0, np.inf
        for _ in range(100):  # contracts by μ r m L / (I + m L²)
            if torque == before:
                break
            before = torque
            torque = -side * self.friction * RADIUS * self.size(self.force(t, phi, rate, torque)[1])
        return self.force(t, phi, rate, torque)[0]

    def holds(self, t, phi):
        """How much more torque friction has than rest takes, and the side to which it gives way."""
        needed = LENGTH * (MASS * G * np.sin(phi) - self.push * np.sin(self.rate * t) * np.cos(phi))
        room = self.friction * RADIUS * self.size(self.force(t, phi, 0.0, needed)[1]) - abs(needed)
        return room, -np.sign(needed)

    def follow(self, phi, rate, end):
        t, y = 0.0, np.array([phi, rate])
        side = np.sign(rate) if rate else self.choose_side(t, phi)
        while t < end:
            self.changes.append((t, side))

            def changes(t, y, side=side):
                return y[1] if side else self.holds(t, y[0])[0]

            changes.terminal, changes.direction = True, -side if side else -1
            solution = solve_ivp(
                lambda t, y, side=side: [y[1], self.accelerate(t, *y, side) if side else 0.0],
                (t, end), y, method="DOP853", rtol=1e-13, atol=1e-14, max_step=0.05, events=changes,
            )  # fmt: skip
            t, y = solution.t[-1], solution.y[:, -1]
            if solution.status == 1:
                y[1] = 0.0
                side = self.choose_side(t, y[0]) if side else self.holds(t, y[0])[1]
        return y

    def choose_side(self, t, phi):
        room, side = self.holds(t, phi)
        return 0 if room >= 0 else side


MOTIONS = {
    "coasts": (0.3, 0.0, 1.0, 0.0, 6.0, 1.0),
    "coasts, heavily": (2.0, 0.0, 1.0, 0.0, 6.0, 0.8),
    "comes to rest": (2.0, 0.0, 1.0, 0.0, 6.0, 30.0),
    "stops at once": (5.0, 0.0, 1.0, 0.0, 6.0, 30.0),
    "sticks and slips": (2.0, 6.0, 3.0, 0.0, 0.0, 12.0),
    "is shaken": (1.0, 25.0, 9.0, 0.3, 0.0, 6.0),
    "slides at once": (2.0, 1.0, 3.0, 1.5, 0.0, 6.0),
}


SHOWN = [*((length, motion) for motion in MOTIONS if motion != "is shaken")]  # the rest takes long


@pytest.mark.parametrize(
    ("size", "motion"), sweep([(size, motion) for motion in MOTIONS for size in (length, taxicab)], kept=SHOWN)
)
def test_pendulum_with_a_bearing_that_rubs(size, motion):
    *numbers, phi, rate, duration = MOTIONS[motion]
    exact = ExactPendulum(size, *numbers)
    end = exact.follow(phi, rate, duration)
    ts = np.array([0.0, duration])
    run = lagjax.simulate(RUBBING[size], *state_of(phi, rate), ts, np.array(numbers), rtol=1e-13)
    assert (len(exact.changes) > 10) == (motion in ("sticks and slips", "is shaken"))
    np.testing.assert_allclose([run.q["phi"][-1], run.qdot["phi"][-1]], end, atol=1e-11, rtol=0)


# Where the force of the bearing is small beside what shakes it, steps become short, and a long one is taken once more.
SHAKEN_HARD = 0.3, 4200.0, 85.0


def end_when_shaken_hard(numbers, rtol):
    ts = jnp.array([0.0, 0.17])
    run = lagjax.simulate(RUBBING[length], *state_of(-0.9, 0.0), ts, numbers, rtol=rtol)
    return jnp.array([run.q["phi"][-1], run.qdot["phi"][-1]])


def test_a_step_that_is_taken_once_more_begins_where_it_began():
    exact = ExactPendulum(length, *SHAKEN_HARD).follow(-0.9, 0.0, 0.17)
    for rtol in (1e-9, 1e-10, 1e-13):
        np.testing.assert_allclose(end_when_shaken_hard(np.array(SHAKEN_HARD), rtol), exact, rtol=10 * rtol + 1e-11)


@pytest.mark.slow
def test_derivatives_pass_steps_that_are_taken_once_more():
    at, along, step = np.array(SHAKEN_HARD), np.array([1.0, 0.0, 0.0]), 1e-4
    ends = [end_when_shaken_hard(at + k * step * along, 1e-13) for k in (-2, -1, 0, 1, 2)]
    slopes = np.dot([1, -8, 0, 8, -1], ends) / (12 * step)
    forward = jax.jvp(lambda x: end_when_shaken_hard(x, 1e-12), (at,), (along,))[1]
    np.testing.assert_allclose(forward, slopes, rtol=1e-8)
    back = jax.jacrev(lambda x: end_when_shaken_hard(x, 1e-12))(at)
    np.testing.assert_allclose(back[:, 0], slopes, rtol=1e-8)


@pytest.mark.parametrize("size", sweep([length, taxicab], kept=[length]))
def test_bearing_rests_for_ever(size):
    """In doubles, in single precision, and 10 kg on 1 mm, at whose angle of rest a force of 1e5 N would take it."""
    phi, _ = ExactPendulum(size, 2.0).follow(0.0, 6.0, 20.0)
    numbers = jnp.array([2.0, 0.0, 1.0])
    run = lagjax.simulate(RUBBING[size], *state_of(0.0, 6.0), jnp.array([0.0, 20.0, 1e6]), numbers)
    assert float(run.q["phi"][1]) == pytest.approx(phi, abs=1e-8)
    assert run.q["phi"][2] == run.q["phi"][1]
    assert max(abs(float(v[2])) for v in jax.tree.leaves(run.qdot)) < 1e-20
    given = *state_of(0.0, 6.0), jnp.array([0.0, 20.0, 1e6]), numbers
    narrow = lagjax.simulate(RUBBING[size], *jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), given))
    assert float(narrow.q["phi"][1]) == pytest.approx(phi, abs=1e-5)
    assert narrow.q["phi"][2] == narrow.q["phi"][1]


@pytest.mark.slow
@pytest.mark.parametrize("size", [length, taxicab])
def test_bearing_that_sticks_and_slips_has_derivatives(size):
    def end(numbers):
        params = jnp.array([numbers[0], numbers[1], 3.0])
        return lagjax.simulate(RUBBING[size], *state_of(0.0, 0.0), jnp.array([0.0, 4.0]), params, rtol=1e-13).q["phi"][
            -1
        ]

    at, step = np.array([2.0, 6.0]), 1e-4
    slopes = [
        np.dot([1, -8, 0, 8, -1], [
            ExactPendulum(size, *(np.array(at) + k * step * along), 3.0).follow(0.0, 0.0, 4.0)[0]
            for k in (-2, -1, 0, 1, 2)
        ]) / (12 * step) for along in np.eye(2)
    ]  # fmt: skip
    np.testing.assert_allclose(jax.grad(end)(at), slopes, rtol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(end)(at), slopes, rtol=1e-8)
    bends = [
        np.dot([1, -8, 0, 8, -1], [jax.grad(end)(at + k * step * along) for k in (-2, -1, 0, 1, 2)]) / (12 * step)
        for along in np.eye(2)
    ]
    np.testing.assert_allclose(jax.hessian(end)(at), bends, rtol=1e-6)
    assert float(jax.jit(end)(at)) == float(end(at))
    several = np.stack([at, 1.1 * at])
    np.testing.assert_allclose(jax.vmap(end)(several), [end(x) for x in several], atol=1e-14)


@pytest.mark.slow
def test_frictions_that_change_each_others_normal_force_end_by_name_at_rest():
    """Two bearings of a double pendulum: what the one at rest holds says nothing about the force of the other."""
    above, below = LENGTH, 0.5 * LENGTH

    def constraints(q):
        c, s = jnp.cos(q[:, 2]), jnp.sin(q[:, 2])
        ends = jnp.stack([s[0], -c[0]]) * above
        return jnp.stack([q[0, :2] - ends, q[1, :2] - q[0, :2] - below * jnp.stack([s[1], -c[1]])])

    def forces(q, v, params, multipliers):
        torque = params * RADIUS * jnp.sqrt(jnp.sum(multipliers**2, axis=1)) * jnp.sign(jnp.diff(v[:, 2], prepend=0.0))
        return jnp.zeros_like(q).at[:, 2].set(-torque).at[0, 2].add(torque[1])

    def lagrangian(q, v):
        return 0.5 * MASS * jnp.sum(v[:, :2] ** 2) + 0.5 * INERTIA * jnp.sum(v[:, 2] ** 2) - MASS * G * jnp.sum(q[:, 1])

    system = lagjax.System(lagrangian, forces=forces, constraints=constraints)
    q0 = jnp.array([[0.0, -above, 0.0], [0.0, -above - below, 0.0]])
    qdot0 = jnp.array([[above, 0.0, 1.0], [above - below, 0.0, -1.0]])
    with pytest.raises(lagjax.SimulationError, match="jump"):
        lagjax.simulate(system, q0, qdot0, jnp.array([0.0, 20.0]), 2.0)


# ---- a rod with its end on a wire: friction changes the force that it is proportional to -----------------------------


def rod(q, v):
    (_, y, phi), (u, w, rate) = q, v
    along, up = u + 0.5 * jnp.cos(phi) * rate, w + 0.5 * jnp.sin(phi) * rate
    return 0.5 * (along**2 + up**2) + rate**2 / 24 - G * (y - 0.5 * jnp.cos(phi))


ROD = lagjax.System(
    rod, constraints=lambda q: q[1],
    forces=lambda q, v, params, multipliers: jnp.array([-params * jnp.abs(multipliers) * jnp.sign(v[0]), 0.0, 0.0]),
)  # fmt: skip
BOTH = lagjax.System(
    gravity,
    forces=lambda q, v, multipliers: 0 * v,
    constraints=lambda q: {"a": q[0]},
    contacts=lambda q: {"a": q[1]},
)
BALL = lagjax.System(
    lambda q, v: 0.5 * v @ v - G * q[1], restitution=1.0, contacts=lambda q: q[1],
    forces=lambda q, v, multipliers: jnp.array([-0.3 * multipliers, 0.0]),
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
        state = np.array([0.0, 0.0, phi]), np.array([side, 0.0, rate])
        found = np.asarray(ROD.acceleration(*state, params=friction))
        np.testing.assert_allclose(found[[0, 2]], exact[:2], rtol=1e-12)
        assert float(ROD.multipliers(*state, params=friction)) == pytest.approx(exact[2], rel=1e-12)


def test_paradox_of_a_rod_on_a_wire_is_not_a_number():
    """With none or two solutions the law says nothing: Painlevé's paradox."""
    state, friction = np.array([0.0, 0.0, 0.785]), 4.0
    counts = [len(list(rod_forces(0.785, 0.0, friction, side))) for side in (1.0, -1.0)]
    assert sorted(counts) == [0, 2]
    for side in (1.0, -1.0):
        velocity = np.array([side, 0.0, 0.0])
        assert np.isnan(ROD.acceleration(state, velocity, params=friction)).all()
    with pytest.raises(lagjax.SimulationError, match="Painlevé"):
        lagjax.simulate(ROD, state, velocity, np.array([0.0, 0.1]), friction)


# ---- two at once, and what has no multipliers ------------------------------------------------------------------------


def rub_each(q, v, params, multipliers):
    return jnp.stack([rub(q[k], v[k], params, multipliers[k]) for k in range(2)])


TWO_BEADS = lagjax.System(
    lambda q, v: gravity(q[0], v[0]) + gravity(q[1], v[1]), forces=rub_each,
    constraints=lambda q: jnp.sum(q * q, axis=1) - 1.0,
)  # fmt: skip


@pytest.mark.slow
def test_two_beads_rub_as_each_does_alone():
    qdot0 = np.array([[3.0, 0.0], [7.0, 0.0]])
    run = lagjax.simulate(TWO_BEADS, np.stack([BOTTOM] * 2), qdot0, np.linspace(0.0, 8.0, 3), 0.3)
    for k in range(2):
        np.testing.assert_allclose(run.q[-1, k], follow_bead(0.3, float(qdot0[k, 0]), 8.0).q[-1], atol=2e-11)


def rub_first_bearing(q, v, params, multipliers):
    along = jnp.array([-q[0, 1], q[0, 0]])
    return jnp.zeros_like(q).at[0].set(-params * jnp.abs(multipliers[0]) * jnp.sign(along @ v[0]) * along)


DOUBLE = lagjax.System(
    lambda q, v: gravity(q[0], v[0]) + gravity(q[1], v[1]), forces=rub_first_bearing,
    constraints=lambda q: jnp.stack([q[0] @ q[0], (q[1] - q[0]) @ (q[1] - q[0])]) - 1.0,
)  # fmt: skip


def test_friction_by_one_multiplier_of_two_takes_what_it_works_and_lets_a_joint_rest():
    """A double pendulum of points, whose first rod rubs in its bearing: it stops while the second one swings."""
    ts = np.linspace(0.0, 1.0, 2001)
    run = lagjax.simulate(DOUBLE, np.array([[0.0, -1.0], [0.0, -2.0]]), np.array([[0.7, 0.0], [1.4, 0.0]]), ts, 0.1)
    first, rates = np.asarray(run.q)[:, 0], np.asarray(run.qdot)[:, 0]
    normal = np.asarray(run.multipliers)[:, 0]
    power = -0.1 * np.abs(normal * (first[:, 0] * rates[:, 1] - first[:, 1] * rates[:, 0]))
    lost = np.trapezoid(power, ts)
    assert lost < -0.05
    assert float(run.energy()[-1] - run.energy()[0]) == pytest.approx(float(lost), abs=1e-5)  # of 2000 trapezia


def push_by_both_multipliers(q, v, multipliers):
    torque = 0.3 * (multipliers["x"] - 2 * multipliers["y"])
    return {"x": 0.0 * q["x"], "y": 0.1 * multipliers["y"], "phi": torque}


LINEAR_LAW = lagjax.System(pendulum, forces=push_by_both_multipliers, constraints=bearing)


def test_a_law_that_is_linear_in_several_multipliers_needs_no_sign():
    """Against one linear system for accelerations and multipliers."""
    phi, rate = 0.4, 2.0
    c, s = LENGTH * np.cos(phi), LENGTH * np.sin(phi)
    q, v = {"x": s, "y": -c, "phi": phi}, {"x": c * rate, "y": s * rate, "phi": rate}
    matrix = np.array([  # phi, x, y, λ_x, λ_y
        [INERTIA, 0, 0, c - 0.3, s + 0.6], [0, MASS, 0, -1, 0], [0, 0, MASS, 0, -1.1],
        [-c, 1, 0, 0, 0], [-s, 0, 1, 0, 0],
    ])  # fmt: skip
    exact = np.linalg.solve(matrix, [0, 0, -MASS * G, -s * rate**2, c * rate**2])
    found = LINEAR_LAW.acceleration(q, v)
    np.testing.assert_allclose([found["phi"], found["x"], found["y"]], exact[:3], rtol=1e-12)


def test_forces_ask_for_multipliers_of_what_there_is():
    with pytest.raises(ValueError, match="which this System has not"):
        lagjax.System(gravity, forces=rub)
    with pytest.raises(ValueError, match="contacts and one_way have the same name: a"):
        BOTH.acceleration(jnp.zeros(2), jnp.zeros(2))


@pytest.mark.parametrize("share", [2.0, 1.0, -0.3])
def test_a_law_whose_piece_ends_beyond_zero(share):
    """min(λ, 5) of one multiplier: the piece of what is found, and not of the force without the law."""

    def forces(q, v, multipliers):
        return jnp.array([multipliers, share * jnp.minimum(multipliers, 5.0)])

    pressed = weight_on(forces=forces, constraints=lambda q: q[1])
    exact = G / (1 + share) if G / (1 + share) < 5 else G - 5 * share
    assert float(pressed.acceleration(jnp.zeros(2), jnp.zeros(2))[0]) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("of_contact", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("second", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_rolling_resistance_stops_a_disc(of_contact, second):
    """c N against the rotation, on a floor that is a constraint, or a contact: it slows by 2 c g / 3 R, and rests."""

    def resist(q, v, params, multipliers):
        return jnp.array([0.0, 0.0, -params * multipliers["floor"] * jnp.sign(v[2])])

    def disc(q, v):
        return v[:2] @ v[:2] + 0.5 * RADIUS**2 * v[2] ** 2 - 2 * G * q[1]

    def floor(q):
        return {"floor": q[1] - RADIUS}

    def rolls(q, v):
        return {"floor" if of_contact else "rolls": v[0] + RADIUS * v[2]}

    held = {"contacts": floor, "friction": 0.4, "slip": rolls}
    rolling = lagjax.System(
        disc, forces=resist, **held if of_contact else {"constraints": floor, "velocity_constraints": rolls}
    )

    def places(c):
        ts, start = np.array([0.0, 2.0, 20.0]), (np.array([0.0, RADIUS, 0.0]), np.array([1.0, 0.0, -1 / RADIUS]))
        return lagjax.simulate(rolling, *start, ts, c).q[1:, 0]

    c, slows = 0.003, 2 * 0.003 * G / (3 * RADIUS)
    np.testing.assert_allclose(places(c), [2 - 2 * slows, 1 / (2 * slows)], rtol=1e-12)
    slopes = [-2 * slows / c, -1 / (2 * slows * c)]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(places))(c), slopes, rtol=1e-11)
    if of_contact:
        np.testing.assert_allclose(jax.vmap(places)(np.array([c, 2 * c]))[1, 1], 0.25 / slows, rtol=1e-12)
    if second:  # by default in `test_a_brake_that_changes_its_own_normal_force`
        backward, bends = jax.jit(lambda c: (jax.jacrev(places)(c), jax.hessian(places)(c)))(c)
        np.testing.assert_allclose(backward, slopes, rtol=1e-11)
        np.testing.assert_allclose(bends, [0.0, 1 / (slows * c**2)], rtol=1e-10, atol=1e-8)


# ---- normal forces of contacts -----------------------------------------------------------------------------------

ANGLE = 0.3


def slope(law, **more):
    """A block on a slope, x along it and y off it."""
    down, into = G * np.sin(ANGLE), G * np.cos(ANGLE)
    return lagjax.System(
        lambda q, v: 0.5 * v @ v + down * q[0] - into * q[1], forces=law, contacts=lambda q: {"slope": q[1]}, **more
    )


def brake(q, v, params, multipliers):
    """c N against the motion, and d N off the slope or into it: N depends on the direction."""
    return -jnp.sign(v[0]) * params * multipliers["slope"]


def test_a_brake_that_changes_its_own_normal_force():
    block, ts = slope(brake), np.array([0.0, 2.0])

    def end(params, start=1.0, dtype=jnp.float64):
        at = [jnp.asarray(x, dtype) for x in (np.zeros(2), np.array([start, 0.0]), ts, params)]
        run = lagjax.simulate(block, *at)
        return jnp.stack([run.q[-1, 0], run.qdot[-1, 0]])

    def slows(params, side=1.0):
        c, d = params
        return -G * np.sin(ANGLE) + side * c * G * np.cos(ANGLE) / (1 - side * d)

    def derivatives(function, params):  # the gradient, and what it was on the way to the Hessian
        slopes = jax.grad(function)
        return jax.jit(jax.jacfwd(lambda p: (slopes(p),) * 2, has_aux=True))(params)

    strong, weak = np.array([0.5, 0.3]), np.array([0.2, 0.3])
    stops = lambda params: 0.5 / slows(params)  # and rests there
    np.testing.assert_allclose(end(strong), [stops(strong), 0.0], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(end(strong, dtype=jnp.float32), [stops(strong), 0.0], rtol=1e-6, atol=1e-7)
    back = -slows(weak) * (2.0 - 1 / -slows(weak, -1.0))  # it turns, and the other force holds
    assert float(end(weak, -1.0)[1]) == pytest.approx(float(back), rel=1e-11)
    (hessian, slopes), (second, right) = derivatives(lambda p: end(p)[0], strong), derivatives(stops, strong)
    np.testing.assert_allclose(slopes, right, rtol=1e-10)
    np.testing.assert_allclose(hessian, second, rtol=1e-8)
    lifted = lagjax.simulate(block, np.zeros(2), np.array([1.0, 0.0]), ts, np.array([0.0, 1.5]), throw=False)
    assert not lifted.ok  # 1.5 N into the slope: no N, or any


@pytest.mark.parametrize("law", [lambda n: n**2 / 40, lambda n: jnp.minimum(2 * n, 4.0), lambda n: 0.4 * jnp.abs(n)])
def test_a_law_that_is_not_linear_in_a_normal_force(law):
    block = slope(lambda q, v, multipliers: jnp.array([-1.0, -1.0]) * 0.5 * law(multipliers["slope"]))
    run = lagjax.simulate(block, jnp.zeros(2), jnp.zeros(2), jnp.array([0.0, 1.0]))
    force = run.contact_forces["slope"][-1]
    assert float(force - 0.5 * law(force)) == pytest.approx(G * np.cos(ANGLE), rel=1e-12)
    assert float(run.qdot[-1, 0]) == pytest.approx(G * np.sin(ANGLE) - 0.5 * float(law(force)), rel=1e-11)


def lift_and_drag(q, v, t, params, multipliers):
    return jnp.array([-params * multipliers["floor"], (t - 1) * (3 - t)])


LIFTED_BLOCK = lagjax.System(lambda q, v: 0.5 * v @ v, forces=lift_and_drag, contacts=lambda q: {"floor": q[1]})


def test_a_normal_force_that_is_read_while_its_contact_opens_and_closes():
    """LiftedParams by g + (t − 1)(3 − t) it leaves the floor at 1 and falls upon it at 5; impacts bring none."""
    ts = jnp.array([0.0, 0.5, 3.0, 6.0])

    def run(c):
        return lagjax.simulate(LIFTED_BLOCK, jnp.zeros(2), jnp.array([1.0, 0.0]), ts, c)

    found = run(0.03)
    np.testing.assert_allclose(found.contact_forces["floor"], [3.0, 1.25, 0.0, 15.0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.qdot[1:, 0], [1 - 0.03 * 25 / 24, 0.96, 1 - 0.03 * 38 / 3], rtol=1e-12)
    assert float(jax.grad(lambda c: run(c).qdot[-1, 0])(0.03)) == pytest.approx(-38 / 3, rel=1e-11)
    bounced = lagjax.simulate(BALL, jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]), jnp.array([0.0, 4.0]))
    assert bounced.impacts.count == 4 and bounced.qdot[-1, 0] == 1.0


def brake_foot(q, v, multipliers):
    torque = -0.1 * multipliers["floor"] + 0.0 * multipliers["rod"]
    return jnp.array([torque, 0.0, torque, 0.0])


STANDING = lagjax.System(
    lambda q, v: 0.5 * v @ v - G * (q[1] + q[3]), forces=brake_foot,
    constraints=lambda q: {"rod": q[3] - q[1] - 1.0}, contacts=lambda q: {"floor": q[1]},
)  # fmt: skip


def test_constraints_beside_closed_contacts_have_their_own_multipliers():
    """A mass that stands on a rod, and the rod on a foot which a brake slows: λ is g of the rod, 2 g of the floor."""
    run = lagjax.simulate(STANDING, jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 0, 1.0, 0]), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(run.multipliers["rod"], [G, G], rtol=1e-12)
    np.testing.assert_allclose(run.contact_forces["floor"], [2 * G, 2 * G], rtol=1e-12)
    np.testing.assert_allclose(run.constraint_force()[1], [0, -G, 0, G], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.qdot[-1], [1 - 0.2 * G, 0, 1 - 0.2 * G, 0], rtol=1e-11, atol=1e-12)
    with pytest.raises(ValueError, match="for forces that read no multipliers"):
        lagjax.equilibrium(STANDING, run.q[0])


def rub_box(q, v, multipliers):
    return jnp.array([-0.2 * sum(multipliers.values()) * jnp.sign(v[0]), 0.0, 0.0])


def corners_of_box(q):
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return {f"{x}{y}": q[1] + s * x + c * y for x in (-1, 1) for y in (-1, 1)}


BOX = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], forces=rub_box, contacts=corners_of_box)


@pytest.mark.slow
def test_normal_forces_of_more_contacts_than_a_body_needs():
    """A box on four corners, of which two touch the floor: their sum is its weight, whichever carries it."""
    run = lagjax.simulate(BOX, jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.2, 2.0]))
    np.testing.assert_allclose(run.q[1:, 0], [0.2 - 0.004 * G, 1 / (0.4 * G)], rtol=1e-11)


def test_many_contacts_each_with_a_drag_by_its_own_force():
    """Twenty bodies that fall and then slide, v = exp(−k (t − t₁)) with k = c g: more than a table has of one array."""
    n, c, height = 20, 0.3, np.linspace(0.1, 1.0, 20)
    bodies = lagjax.System(
        lambda q, v: 0.5 * jnp.sum(v**2) - 9.81 * jnp.sum(q[n:]), contacts=lambda q: {"floor": q[n:]},
        forces=lambda q, v, multipliers: jnp.concatenate([-c * multipliers["floor"] * v[:n], jnp.zeros(n)]),
    )  # fmt: skip
    start = np.concatenate([np.zeros(n), height]), np.concatenate([np.ones(n), np.zeros(n)])
    run = lagjax.simulate(bodies, *start, np.array([0.0, 2.0]))
    landed, k = np.sqrt(2 * height / 9.81), c * 9.81
    np.testing.assert_allclose(run.q[-1, :n], landed + (1 - np.exp(-k * (2 - landed))) / k, rtol=1e-10)
