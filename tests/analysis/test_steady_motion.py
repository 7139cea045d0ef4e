"""Steady motions and their stability, of what spins and of what rolls: against closed forms and published digits."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax

G, R, MASS = 9.81, 0.3, 2.0
EXAMPLES = Path(__file__).parents[2] / "examples"


def wheel(q, v, params):
    """A round body on its edge: x, y is where it touches the ground; A, C are its moments of inertia over m R²."""
    ahead = jnp.array([jnp.cos(q["yaw"]), jnp.sin(q["yaw"])])
    aside = jnp.array([-ahead[1], ahead[0]])
    s, c = jnp.sin(q["lean"]), jnp.cos(q["lean"])
    centre = jnp.array([v["x"], v["y"]]) - R * (c * v["lean"] * aside - s * v["yaw"] * ahead)
    spin = v["spin"] + v["yaw"] * s
    turning = params["A"] * (v["lean"] ** 2 + (v["yaw"] * c) ** 2) + params["C"] * spin**2
    return 0.5 * MASS * (centre @ centre + (R * s * v["lean"]) ** 2 + R**2 * turning) - MASS * G * R * c


def roll(q, v):
    return v["x"] - R * v["spin"] * jnp.cos(q["yaw"]), v["y"] - R * v["spin"] * jnp.sin(q["yaw"])


WHEEL = lagjax.System(wheel, velocity_constraints=roll)
DISC, HOOP = {"A": 0.25, "C": 0.5}, {"A": 0.5, "C": 1.0}
NAMES = ("lean", "spin", "x", "y", "yaw")
REST = dict.fromkeys(NAMES, 0.0)


def rolling(spin, **more):
    return REST | {"spin": spin, "x": R * spin} | more


def sleeping_top(q, v):
    """A top about the vertical, tilted by angles about a fixed and a moving axis; I1 = 1, I3 = 0.4, m g l = 2."""
    a, b = q[0], q[1]
    across = v[0] ** 2 * jnp.cos(b) ** 2 + v[1] ** 2
    return 0.5 * (across + 0.4 * (v[2] + v[0] * jnp.sin(b)) ** 2) - 2.0 * jnp.cos(a) * jnp.cos(b)


SLEEPING = lagjax.System(sleeping_top)
TOP = lagjax.System(
    lambda q, v: (
        0.5 * (v["t"] ** 2 + (v["p"] * jnp.sin(q["t"])) ** 2 + 0.4 * (v["s"] + v["p"] * jnp.cos(q["t"])) ** 2)
        - 2.0 * jnp.cos(q["t"])
    )
)
# A sleigh of Chaplygin: its blade is at x, y, its centre of mass a = 0.2 ahead of it; m = 1, J = 0.1.
SLEIGH = lagjax.System(
    lambda q, v: (
        0.5 * ((v[0] - 0.2 * v[2] * jnp.sin(q[2])) ** 2 + (v[1] + 0.2 * v[2] * jnp.cos(q[2])) ** 2) + 0.05 * v[2] ** 2
    ),
    velocity_constraints=lambda q, v: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]),
)
CAR = lagjax.System(
    lambda q, v: 0.5 * v["x"] ** 2 + 0.5 * v["w"] ** 2 - 0.5 * q["w"] ** 2 - q["w"] * v["x"],
    forces=lambda q, v, params: {"x": params - 0.5 * v["x"], "w": 0.0 * v["w"]},
)

# A cylinder of radius ½ that a force rolls without slip, x − ½ w = 0, and a row of rotors.
ROLLER = lagjax.System(
    lambda q, v: 0.5 * v["x"] ** 2 + 0.25 * v["w"] ** 2,
    constraints=lambda q: q["x"] - 0.5 * q["w"],
    forces=lambda q, v, params: {"x": params - 0.2 * v["x"], "w": 0.0 * v["w"]},
)
ROTORS = lagjax.System(lambda q, v: 0.5 * v @ v - jnp.sum(1 - jnp.cos(q[1:] - q[:-1])))


def exponents(system, motion, params=None):
    return np.linalg.eigvals(lagjax.linearize(system, motion.q, motion.qdot, params).reduced(motion).A)


@pytest.mark.parametrize(("body", "critical"), [(DISC, G / (3 * R)), (HOOP, G / (4 * R))])
def test_a_wheel_that_rolls_straight_on_is_stable_beyond_its_critical_speed(body, critical):
    """s² = −(C (C + 1) Ω² / A − G/R) / (A + 1), in units of m R²: Ω² > G/(3R) of a disc, G/(4R) of a hoop."""
    for factor in (0.9, 1.1):
        motion = lagjax.steady_motion(WHEEL, REST, rolling((factor * critical) ** 0.5), body, hold="qdot['spin']")
        assert motion.cyclic == REST | {"lean": False, "spin": True, "x": True, "y": True, "yaw": True}
        found = exponents(WHEEL, motion, body)
        a, c = body["A"], body["C"]
        square = -(c * (c + 1) / a * factor * critical - G / R) / (a + 1)
        np.testing.assert_allclose(np.sort_complex(found**2)[[0, -1] if square < 0 else [-1, -2]][0], square, rtol=1e-9)
        assert (found.real.max() > 1e-6) == (factor < 1)
        assert found.shape == (4,)


@pytest.mark.slow
def test_a_wheel_that_goes_in_a_circle():
    motion = lagjax.steady_motion(
        WHEEL, REST | {"lean": 0.3, "yaw": 0.4}, rolling(5.0, yaw=-2.0), DISC, hold=("q['lean']", "qdot['spin']")
    )
    run = lagjax.simulate(WHEEL, motion.q, motion.qdot, np.linspace(0, 3, 4), DISC)
    for name in ("lean", "yaw", "spin"):
        np.testing.assert_allclose(run.qdot[name], motion.qdot[name], atol=1e-8)
    np.testing.assert_allclose(run.q["lean"], 0.3, atol=1e-8)
    # Its exponents are those of any other instant, at which velocities point elsewhere.
    later = jax.tree.map(lambda x: x[2], (run.q, run.qdot))
    again = lagjax.steady_motion(WHEEL, *later, DISC, hold=("q['lean']", "qdot['spin']"))
    np.testing.assert_allclose(
        np.abs(exponents(WHEEL, again, DISC)).max(), np.abs(exponents(WHEEL, motion, DISC)).max(), rtol=1e-8
    )
    # So they are in coordinates of the centre, which the yaw does not turn.
    small = rolling(5.0, yaw=float(motion.qdot["yaw"])) | {k: float(motion.qdot[k]) for k in ("x", "y", "spin")}
    off = lagjax.simulate(WHEEL, motion.q | {"lean": 0.3 + 1e-5}, small, np.linspace(0, 1.2, 1201), DISC).q["lean"]
    rate = np.abs(exponents(WHEEL, motion, DISC)).max()
    middle = (off.max() + off.min()) / 2
    falls = np.flatnonzero((off[:-1] > middle) & (off[1:] <= middle))
    rises = np.flatnonzero((off[:-1] <= middle) & (off[1:] > middle))
    np.testing.assert_allclose(abs(rises[0] - falls[0]) * 1e-3, np.pi / rate, rtol=1e-2)


@pytest.mark.slow
def test_a_sleeping_top_needs_its_critical_spin():
    critical = (4 * 2.0 * 1.0) ** 0.5 / 0.4  # ω² > 4 m g l I1/I3²
    for factor in (0.99, 1.01):
        spin = jnp.array([0.0, 0.0, factor * critical])
        motion = lagjax.steady_motion(SLEEPING, np.zeros(3), spin, hold=("qdot[2]", "q"))
        found = exponents(SLEEPING, motion)
        assert (found.real.max() > 0.01) == (factor < 1)
        half = 0.4 * factor * critical / 2
        np.testing.assert_allclose(np.abs(found).max(), np.abs(half + np.emath.sqrt(half**2 - 2.0)), rtol=1e-7)


def test_a_top_precesses():
    """0.4 ω p − p² cos θ = 2 with ω = s + p cos θ, of I1 = 1: the slow precession."""
    guess = {"p": 0.5, "s": 10.0, "t": 0.0}
    motion = lagjax.steady_motion(TOP, {"p": 0.0, "s": 0.0, "t": 1.0}, guess, hold=("q['t']", "qdot['s']"))
    p, c = float(motion.qdot["p"]), np.cos(1.0)
    np.testing.assert_allclose(0.4 * (10.0 + p * c) * p - p**2 * c, 2.0, rtol=1e-12)
    assert motion.multipliers is None and "qdot['s'] = 10" in str(motion)


@pytest.mark.slow
def test_a_sleigh_is_stable_with_its_weight_ahead():
    motion = lagjax.steady_motion(SLEIGH, np.zeros(3), np.array([1.5, 0.0, 0.0]), hold="qdot[0]")
    found = exponents(SLEIGH, motion)
    np.testing.assert_allclose(found.real.min(), -0.2 * 1.5 / (0.1 + 0.04), rtol=1e-10)  # −m a v/(J + m a²)
    back = lagjax.steady_motion(SLEIGH, np.zeros(3), np.array([-1.5, 0.0, 0.0]), hold="qdot[0]")
    assert exponents(SLEIGH, back).real.max() > 2


@pytest.mark.slow
def test_a_driven_car_settles_at_its_speed():
    motion = lagjax.steady_motion(CAR, {"w": 0.1, "x": 0.3}, {"w": 0.0, "x": 1.0}, 2.0)
    np.testing.assert_allclose([motion.qdot["x"], motion.q["w"], motion.q["x"]], [4.0, -4.0, 0.3], rtol=1e-12)


def test_coordinates_may_move_together():
    motion = lagjax.steady_motion(ROLLER, {"w": 0.0, "x": 0.0}, {"w": 7.0, "x": 3.0}, 1.0)
    np.testing.assert_allclose([motion.qdot["x"], motion.qdot["w"]], [5.0, 10.0], rtol=1e-12)
    np.testing.assert_allclose(exponents(ROLLER, motion, 1.0), [-0.2 / 3], rtol=1e-12)


@pytest.mark.slow
def test_a_row_of_rotors_turns_as_one():
    motion = lagjax.steady_motion(ROTORS, np.zeros(6), np.full(6, 2.0), hold="qdot[4]")
    np.testing.assert_allclose(motion.qdot, np.full(6, 2.0), rtol=1e-12)
    assert motion.cyclic.tolist() == [False] * 4 + [True, False]
    found = np.sort(np.abs(exponents(ROTORS, motion)))
    expected = np.append(0.0, np.repeat(2 * np.sin(np.pi * np.arange(1, 6) / 12), 2))
    np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.slow
def test_transformations():
    def lean(spin, params=DISC):
        guess = REST | {"lean": 0.2}, rolling(spin, yaw=-2.0)
        return lagjax.steady_motion(WHEEL, *guess, params, hold=("qdot['yaw']", "qdot['spin']")).q["lean"]

    def of_two(spin, c):
        return lean(spin, DISC | {"C": c})

    h = 1e-4
    slope = (lean(5.0 + h) - lean(5.0 - h)) / (2 * h)
    by_c = (of_two(5.0, 0.5 + h) - of_two(5.0, 0.5 - h)) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(lean)(5.0), slope, rtol=1e-6)
    gradients = jax.jit(jax.vmap(jax.grad(of_two, (0, 1)), (0, None)))(np.array([4.0, 5.0]), 0.5)
    np.testing.assert_allclose(np.array(gradients)[:, 1], [slope, by_c], rtol=1e-6)
    h = 1e-2
    bend = (lean(5.0 + h) - 2 * lean(5.0) + lean(5.0 - h)) / h**2
    np.testing.assert_allclose(jax.grad(jax.grad(lean))(5.0), bend, rtol=1e-4)
    single = jax.tree.map(np.float32, (REST | {"lean": 0.2}, rolling(5.0, yaw=-2.0)))
    found = lagjax.steady_motion(WHEEL, *single, DISC, hold=("qdot['yaw']", "qdot['spin']"))
    assert found.q["lean"].dtype == np.float32
    np.testing.assert_allclose(found.q["lean"], lean(5.0), rtol=1e-6)


def test_wrong_arguments():
    with pytest.raises(ValueError, match=r"hold names 'lean', and the numbers are q\['lean'\]"):
        lagjax.steady_motion(WHEEL, REST, rolling(1.0), DISC, hold="lean")
    with pytest.raises(TypeError, match=r"hold is a name, such as .*; got 3"):
        lagjax.steady_motion(WHEEL, REST, rolling(1.0), DISC, hold=3)
    with pytest.raises(ValueError, match=r"qdot\['lean'\] cannot be held at 1.0"):
        lagjax.steady_motion(WHEEL, REST, rolling(1.0, lean=1.0), DISC, hold="qdot['lean']")
    with pytest.raises(ValueError, match="No steady motion was found near the state"):
        lagjax.steady_motion(WHEEL, REST | {"lean": 0.5}, rolling(0.0), DISC, hold=("q", "qdot"))
    lost = lagjax.steady_motion(WHEEL, REST | {"lean": 0.5}, rolling(0.0), DISC, hold=("q", "qdot"), throw=False)
    assert not lost.ok and np.isnan(lost.q["lean"]) and str(lost) == "No steady motion was found"


# Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007), eqs. (6.1) to (6.4).
M = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
K0 = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
K2 = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])
C1 = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 3.0, 5.0, 8.0])
def test_the_benchmark_bicycle(monkeypatch, speed):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    found = importlib.import_module("bicycle").exponents(speed)
    lower = np.linalg.solve(M, np.hstack([-(G * K0 + speed**2 * K2), -speed * C1]))
    published = np.linalg.eigvals(np.vstack([np.eye(4)[2:], lower]))
    np.testing.assert_allclose(found, np.sort_complex(published), rtol=1e-11, atol=1e-11)
    if speed == 5.0:  # of Table 2
        np.testing.assert_allclose(found[[0, 2, 3]], [-14.07838969, -0.77534188 + 4.46486771j, -0.32286643], atol=1e-8)
