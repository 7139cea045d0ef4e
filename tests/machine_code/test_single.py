"""float32 in and out: what runs in machine code is computed in float64 and rounded once.

In most tests the switch for float64 is off, as it is for whoever has not heard of it. The numbers are compared with
closed forms at the float32 numbers that were given, and with the run in float64 from the same numbers, whose rounding
they have to be: the same machine code takes the same steps.
"""

import os
import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import lagrangians
import numpy as np
import pytest
from scenes import BALL_G, FREE_POINTS, KEPLER, OSCILLATOR, RAMP, particle
from sweeps import sweep

import lagjax
from lagjax._primitives import compute_in_doubles

EPS = float(np.finfo(np.float32).eps)
TS = np.linspace(0, 10, 11, dtype=np.float32)
START, LENGTH = np.float32(1.0), np.float32(0.3)


def pendulum(q, qdot, params):
    return 0.5 * params["m"] * (params["l"] * qdot) ** 2 + params["m"] * 9.81 * params["l"] * jnp.cos(q)


SCENE, BALL = lagjax.System(pendulum), lagjax.System(lagrangians.ball)
BOUNCE = lagjax.Transition("flight", "flight", lambda q, v: q, -1, lambda q, v, params: (q, (params - 1.2) * v))


@pytest.fixture
def off():
    with jax.enable_x64(False):
        yield


def last_angle(start, length, **options):
    return lagjax.simulate(SCENE, start, 0.0 * start, TS, {"m": 1.0, "l": length}, **options).q[-1]


def second(start, length):
    params = {"m": 1.0, "l": length}
    return lagjax.crossings(SCENE, lambda q, v: q, start, 0.0 * start, TS, params, direction=1, count=16).t[1]


def rest(start, length):
    return lagjax.simulate(SCENE, start, -0.1 * start, TS, {"m": 1.0, "l": length}, event=lambda q, v: v).end.t


def bounced(start, elasticity):
    run = lagjax.simulate(lagjax.Hybrid({"flight": BALL}, [BOUNCE], "flight"), start, 0.0 * start, TS[:3], elasticity,
                                 max_transitions=8)  # fmt: skip
    return run.q[-1]


def frequency(start, length):
    return lagjax.normal_modes(SCENE, 0.0 * start, {"m": 1.0, "l": length}).frequencies[0]


def in_double(function, *arguments):
    """`function` with float64 on, from the same numbers."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, function(*(np.asarray(x, np.float64) for x in arguments)))


def agrees(found, truth, ulps):
    """Whether float32 numbers are those of float64, to so many roundings of the largest of them."""
    for x, exact in zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True):
        assert x.dtype == np.float32
        assert np.abs(np.asarray(x, np.float64) - exact).max() <= ulps * EPS * np.abs(exact).max()


# ---- values ----------------------------------------------------------------------------------------------------------


def test_an_oscillator_is_right_to_the_last_digit(off):
    """From the closed form: half a unit of rounding, and what the error of 1e-9 per step adds."""
    ts = np.linspace(0, 60, 61, dtype=np.float32)
    run = lagjax.simulate(OSCILLATOR, 1.0, 0.25, ts)
    t = ts.astype(np.float64)
    agrees(run.q, np.cos(t) + 0.25 * np.sin(t), 0.6)
    agrees(run.qdot, 0.25 * np.cos(t) - np.sin(t), 0.6)
    assert run.engine == "MachineCode" and run.ts.dtype == np.float32


ELLIPSE = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) + 1.0 / jnp.sqrt(jnp.sum(q**2)))


def test_an_ellipse_is_right_to_the_last_digit(off):
    """Kepler's equation, solved in float64 for the orbit through the float32 start."""
    q0, v0, ts = np.float32([0.5, 0.0]), np.float32([0.0, 1.7]), np.linspace(0, 12, 25, dtype=np.float32)
    run = lagjax.simulate(ELLIPSE, q0, v0, ts)
    r, v = float(q0[0]), float(v0[1])
    a = 1 / (2 / r - v**2)
    e, anomaly = 1 - r / a, ts.astype(np.float64) / a**1.5
    eccentric = anomaly.copy()
    for _ in range(50):
        eccentric -= (eccentric - e * np.sin(eccentric) - anomaly) / (1 - e * np.cos(eccentric))
    exact = a * np.stack([np.cos(eccentric) - e, np.sqrt(1 - e**2) * np.sin(eccentric)], axis=1)
    agrees(run.q, exact, 0.6)


@pytest.mark.parametrize("function", sweep([last_angle, second, rest, bounced, frequency], kept=[last_angle, bounced]))
def test_a_result_is_that_of_float64_rounded(off, function):
    found = function(START, LENGTH)
    assert found.dtype == np.float32 and found == np.float32(in_double(function, START, LENGTH))


def test_a_batch_is_that_of_float64_rounded(off):
    starts = np.linspace(0.1, 3, 200, dtype=np.float32)
    given = {"m": 1.0, "l": 0.5}
    batch = lagjax.simulate_batch(SCENE, starts, 0 * starts, TS, given)
    with jax.enable_x64(True):
        double = lagjax.simulate_batch(SCENE, starts.astype(float), 0.0 * starts.astype(float), TS.astype(float), given)
    assert batch.q.dtype == np.float32 and batch.ok.all() and batch.engine == double.engine == "MachineCode"
    np.testing.assert_array_equal(batch.q, np.float32(double.q))
    np.testing.assert_array_equal(jax.vmap(lambda q: last_angle(q, np.float32(0.5)))(starts), batch.q[:, -1])
    np.testing.assert_array_equal(jax.jit(jax.vmap(lambda q: last_angle(q, np.float32(0.5))))(starts), batch.q[:, -1])


SWING = lagjax.System(lambda q, v: 0.5 * v**2 + 0.1 * q)


def test_constants_keep_their_digits_and_times_do_not_drift(off):
    """0.1 of L is that of float64; t is summed in float64, where steps of float32 would be off by 0.1 after 1e6."""
    end = lagjax.simulate(SWING, 0.0, 0.0, np.float32([1e6, 1e6 + 1])).q[-1]
    assert end == np.float32(0.05)


def rod(q):
    return jnp.sum(q**2) - 1.0


ON_A_ROD = lagjax.System(lagrangians.weight, constraints=rod)
FALLS = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) + 1.0 / jnp.sqrt(jnp.sum(q**2)))


@pytest.mark.slow
def test_constraints_and_failures(off):
    run = lagjax.simulate(ON_A_ROD, np.float32([0.6, -0.8]), np.zeros(2, np.float32), TS)
    assert np.abs(run.constraint_residual()).max() <= 2 * EPS and run.multipliers.dtype == np.float32
    with pytest.raises(lagjax.SimulationError, match=r"beyond t = 1\.11072"):  # π/√8
        lagjax.simulate(FALLS, np.float32([1.0, 0.0]), np.zeros(2, np.float32), TS)
    lost = jax.value_and_grad(
        lambda x: lagjax.simulate(FALLS, jnp.array([x, 0.0]), jnp.zeros(2), TS, throw=False).q[-1, 0]
    )
    assert np.isnan(lost(1.0)).all()


# ---- derivatives -----------------------------------------------------------------------------------------------------

# Each is computed in float64 and rounded once; a second one passes a rounding of the first. Between float64 runs that
# differ in their steps, as second derivatives do, an error of 1e-9 times the growth of the motion is far below that.
WAYS = {
    "grad": lambda f: jax.grad(f, (0, 1)),
    "jit grad": lambda f: jax.jit(jax.grad(f, (0, 1))),
    "jacfwd": lambda f: jax.jacfwd(f, (0, 1)),
    "jit jacfwd": lambda f: jax.jit(jax.jacfwd(f, (0, 1))),
    "hessian": lambda f: jax.jit(jax.hessian(f, (0, 1))),
    "jit of reverse over reverse": lambda f: jax.jit(jax.grad(lambda x, y: jax.grad(f)(x, y), (0, 1))),
}


@pytest.mark.parametrize("way", sweep(WAYS, kept=["jit grad", "jit jacfwd"]))
def test_derivatives_of_a_motion(off, way):
    derivative = WAYS[way](last_angle)
    agrees(derivative(START, LENGTH), in_double(WAYS[way](last_angle), START, LENGTH), 4)


@pytest.mark.parametrize("function", sweep([second, rest, bounced, frequency], kept=[rest]))
@pytest.mark.parametrize("way", ["jit grad", pytest.param("hessian", marks=pytest.mark.slow)])
def test_derivatives_of_what_is_found_on_the_way(off, function, way):
    if (function, way) == (frequency, "hessian"):
        pytest.skip("second derivatives are of the sum of squares alone")
    truth = in_double(WAYS[way](function), START, LENGTH)
    size = max(np.abs(x).max() for x in jax.tree.leaves(truth))
    for x, exact in zip(jax.tree.leaves(WAYS[way](function)(START, LENGTH)), jax.tree.leaves(truth), strict=True):
        assert x.dtype == np.float32 and abs(x - exact) <= 4 * EPS * size


@pytest.mark.slow
def test_batches_of_gradients_loops_and_branches(off):
    starts = np.linspace(0.5, 1.5, 5, dtype=np.float32)
    slopes = jax.vmap(jax.grad(last_angle), (0, None))
    truth = in_double(slopes, starts, LENGTH)
    agrees(slopes(starts, LENGTH), truth, 4)
    agrees(jax.jit(slopes)(starts, LENGTH), truth, 4)

    def total(length, starts):
        def add(sum, start):
            moved = jax.lax.cond(start > 1.2, lambda: last_angle(start, length), lambda: last_angle(-start, length))
            return sum + moved, None

        return jax.lax.scan(add, 0.0 * length, starts)[0]

    agrees(jax.jit(jax.grad(total))(LENGTH, starts), in_double(jax.grad(total), LENGTH, starts), 16)


# ---- starts on surfaces ----------------------------------------------------------------------------------------------

# Levels are k/10 in float64, k a number of float32: the start float32(k/10) is up to half a rounding beside them.
TENTHS, FREE = np.arange(1, 20, dtype=np.float32), FREE_POINTS
SECOND = np.float32([0.0, 1.0])


def wall(guard, i=0, modes=("a", "a")):
    return lagjax.Transition(*modes, guard, -1, lambda q, v: (q, v.at[i].multiply(-1.0)))


def swap(i, guard, modes=("a", "a")):
    return lagjax.Transition(*modes, guard, -1, lambda q, v: (q, v.at[i].set(v[i + 1]).at[i + 1].set(v[i])))


def end_of(transitions, q, v, ts, params, modes=("a",)):
    run = lagjax.simulate(
        lagjax.Hybrid(dict.fromkeys(modes, FREE), transitions, "a"), q, v, ts, params, max_transitions=8
    )
    return run.end.q, run.end.qdot, run.transitions.count


def test_a_body_bounces_off_a_wall_on_which_it_starts(off):
    def bounce(k, start):
        return end_of([wall(lambda q, v, params: params / 10 - q[0])], start[None], jnp.ones(1), SECOND, k)[0][0]

    starts = np.float32(TENTHS / 10.0)
    ends, (by_k, by_start) = jax.jit(jax.vmap(lambda *x: (bounce(*x), jax.jacfwd(bounce, (0, 1))(*x))))(TENTHS, starts)
    np.testing.assert_allclose(ends, TENTHS / 10.0 - 1, atol=2 * EPS)
    np.testing.assert_allclose(by_start, -1, atol=EPS)  # the wall stands, and the bounce is later or earlier
    np.testing.assert_allclose(by_k, 0.2, atol=EPS)


@pytest.mark.parametrize("modes", [("a", "a"), pytest.param(("a", "b"), marks=pytest.mark.slow)])
def test_a_blow_goes_through_balls_that_touch(off, modes):
    """Newton's cradle; with two modes the guard of a contact is one of the mode that begins at the blow before."""

    def gap(i):
        return lambda q, v, params: q[i + 1] - q[i] - params / 10

    def blow(k, q):
        contacts = [swap(i, gap(i), modes[:: 1 - 2 * (i % 2)]) for i in range(3)]
        return end_of(contacts, q.at[0].add(-1.0), jnp.eye(4)[0], 2 * SECOND, k, modes)

    places = np.float32(TENTHS / 10.0)[:, None] * np.arange(4, dtype=np.float32)
    _, v, count = jax.jit(jax.vmap(blow))(TENTHS, places)
    np.testing.assert_array_equal(count, 3)
    np.testing.assert_array_equal(v, np.tile([0, 0, 0, 1], (len(TENTHS), 1)))


@pytest.mark.slow
def test_a_start_on_a_section_has_to_leave_it_first(off):
    """A throw returns to its level, once; with a direction a motion that goes that way ends where it starts."""
    throw = RAMP

    def section(q, v, params):
        return params / 10 - q

    def times(k, start, speed):
        given = throw, section, start, speed, 9 * SECOND, k
        found = lagjax.crossings(*given, count=4)
        ends = [
            lagjax.simulate(*given[:1], *given[2:], event=diffrax.Event(section, direction=way)).end.t
            for way in (None, False, True)
        ]
        return found.count, found.t[0], jnp.stack(ends)

    for speed, expected in ((2.0, [4, 0, 4]), (-2.0, [9, 9, 0])):
        many, first, ends = jax.jit(jax.vmap(times, (0, 0, None)))(TENTHS, np.float32(TENTHS / 10.0), speed)
        np.testing.assert_array_equal(many, int(speed > 0))
        np.testing.assert_allclose(ends, np.tile(expected, (len(TENTHS), 1)), atol=8 * EPS)
        if speed > 0:
            np.testing.assert_allclose(first, 4, atol=8 * EPS)


FAST_ROTOR = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - 0.5 * (1e3 * q[1]) ** 2 - 1e-6 * q[0])


@pytest.mark.slow
def test_a_motion_that_leaves_slowly_has_not_met_the_surface(off):
    """In steps of 1e-3 that a fast coordinate needs it is within the rounding of its start for hundreds of steps."""
    starts = np.stack([TENTHS / 10.0, np.ones(19)], 1).astype(np.float32)
    ts = np.float32([0.0, 0.1])

    def run(k, q):
        def guard(q, v, params):
            return params / 10 - q[0]

        met = lagjax.simulate(lagjax.Hybrid({"a": FAST_ROTOR}, [wall(guard)], "a"), q, 0 * q, ts, k, max_transitions=2)
        event = lagjax.simulate(FAST_ROTOR, q, 0 * q, ts, k, event=guard)
        return met.transitions.count, event.end.t, lagjax.crossings(FAST_ROTOR, guard, q, 0 * q, ts, k, count=2).count

    count, t_end, many = jax.jit(jax.vmap(run))(TENTHS, starts)
    assert not np.any(count) and not np.any(many) and np.all(t_end == ts[1])


def loop_in_a_box(q, v, steps):
    """A loop of motions of a hundredth, whose state is rounded after each; whether every one was followed."""
    walls = [wall(lambda q, v, i=i: q[i], i) for i in range(2)]
    walls += [wall(lambda q, v: 0.7 - q[0], 0), wall(lambda q, v: 0.3 - q[1], 1)]

    def step(state, _):
        q, v, ok = state
        run = lagjax.simulate(lagjax.Hybrid({"a": FREE}, walls, "a"), q, v, np.float32([0.0, 0.01]), max_transitions=8,
                                     throw=False)  # fmt: skip
        return (run.end.q, run.end.qdot, ok & run.ok), None

    return jax.jit(jax.vmap(lambda q, v: jax.lax.scan(step, (q, v, True), length=steps)[0]))(q, v)


def folded(q, v, t):
    """The place in the box of 0.7 × 0.3 after so long."""
    box = np.array([0.7, 0.3])
    x = np.mod(q.astype(float) + v.astype(float) * t, 2 * box)
    return np.minimum(x, 2 * box - x)


@pytest.mark.slow
def test_a_loop_of_motions_stays_in_its_box(off):
    """Steps end on the walls to rounding: 0.35 to the wall and 0.7 back in whole numbers of steps."""
    k = np.arange(1, 17)
    q, v = np.float32(np.tile([0.35, 0.15], (16, 1))), np.float32(np.stack([35.0 / k, 15.0 / k[::-1]], 1))
    ends, _, ok = loop_in_a_box(q, v, 60)
    assert np.all(ok) and np.abs(ends - folded(q, v, 0.6)).max() < 60 * EPS


@pytest.mark.slow
def test_no_member_of_many_leaves_its_box(off):
    rng = np.random.default_rng(0)
    q, v = np.float32(rng.uniform(0, [0.7, 0.3], (50, 2))), np.float32(rng.uniform(-1, 1, (50, 2)))
    ends, _, ok = loop_in_a_box(q, v, 200)
    # Every step rounds the place by half a unit of 0.7, and its time, 0.01, is off by a ten-millionth.
    assert np.all(ok) and np.abs(ends - folded(q, v, 2.0)).max() < 200 * EPS


@pytest.mark.parametrize("place", [0.3, 0.7])
def test_a_motion_that_starts_on_a_border_of_its_force(off, place):
    """−sign(q − place): from there with v = ½ it comes back after 1, and as far on the other side after 2."""
    system = particle(lambda q, v: -jnp.sign(q - place))
    for speed in (0.5, -0.5):
        run = lagjax.simulate(system, place, speed, np.float32([0.0, 0.5, 1.5, 3.5]))
        np.testing.assert_allclose(run.q - place, speed * np.array([0, 0.25, -0.25, -0.25]), atol=4 * EPS)


# ---- units in which float32 is narrow --------------------------------------------------------------------------------


ATOM = lagjax.System(lambda q, v: 0.5e-46 * v**2 - 0.5e-46 * q**2)
HEAVY_BEAD = lagjax.System(lambda q, v: 0.5e24 * v @ v - 1e21 * q[0], constraints=lambda q: jnp.sum(q**4) - 1.5e11**4)


def gravity_in_si(q, v, params):
    of = 0.5 * jnp.array([1.989e30, 5.97e24]) @ jnp.sum(v**2, 1)
    return of + params * 1.989e30 * 5.97e24 / jnp.sqrt(jnp.sum((q[1] - q[0]) ** 2))


PLANETS = lagjax.System(gravity_in_si)


def test_planets_and_atoms_in_si_units(off):
    """Masses whose product is 1e55, and constants of 1e-46: every quantity is computed in float64."""
    system, q, v = PLANETS, jnp.array([[0.0, 0], [1.496e11, 0]]), jnp.array([[0.0, 0], [0, 29780.0]])
    pull = 6.674e-11 * 1.989e30 / 1.496e11**2
    energy = 0.5 * 5.97e24 * 29780**2 - pull * 1.496e11 * 5.97e24
    for at in (lambda name: getattr(system, name), lambda name: jax.jit(getattr(system, name))):
        found = at("acceleration")(q, v, 0.0, 6.674e-11)
        assert found.dtype == np.float32 and found[1, 0] == pytest.approx(-pull, rel=4 * EPS)
        assert at("energy")(q, v, 0.0, 6.674e-11) == pytest.approx(energy, rel=4 * EPS)
    assert jax.grad(lambda g: system.acceleration(q, v, 0.0, g)[1, 0])(6.674e-11) == pytest.approx(-pull / 6.674e-11)
    health = lagjax.simulate(system, q, v, np.linspace(0, 3e7, 5, dtype=np.float32), 6.674e-11).health()
    assert "nothing suspicious" in str(health)
    assert ATOM.acceleration(1.0, 0.0) == -1 and jax.grad(lambda k: ATOM.acceleration(k, 0.0))(1.0) == -1
    given = jnp.array([[1.5e11, 0.0], [1.6e11, 0.0]]), jnp.array([[0.0, 1e4], [0.0, 1e4]])
    np.testing.assert_array_equal(lagjax.simulate_batch(HEAVY_BEAD, *given, np.float32([0.0, 1e5])).ok, [True, False])


HEAVY = lagjax.System(lambda q, v, params: 0.5 * params["m"] * v**2 - 0.5 * params["m"] * q**2)


def test_params_that_float32_cannot_hold_are_refused(off):
    for mass in (1e-46, 1e40, np.array(3e-45)):
        for use in (lambda m: lagjax.simulate(HEAVY, 1.0, 0.0, TS, {"m": m}),
                    lambda m: HEAVY.acceleration(1.0, 0.0, params={"m": m})):  # fmt: skip
            with pytest.raises(ValueError, match=r"params\['m'\] is .*, and float32 holds 1.2e-38 to 3.4e\+38"):
                use(mass)
    assert lagjax.simulate(HEAVY, 1e-50, 0.0, TS, {"m": 1.0}).ok  # a coordinate that is nothing, beside others


ROD = lagjax.System(lagrangians.weight, constraints=lambda q: jnp.sum(q**2) - 1.0)


def test_a_start_off_its_constraints_is_refused_or_followed(off):
    """Whatever is taken for consistent is within what the first step brings back; more is told what to do."""
    for far in (16 * EPS, 1e-5, 1e-3):
        given = ROD, np.float32([0.6, -0.8]) * np.float32(1 + far), np.zeros(2, np.float32), TS[:2]
        if far < 5e-6 * 0.8:
            assert abs(np.sum(np.float64(lagjax.simulate(*given).q[-1]) ** 2) - 1) < 4 * EPS
        else:
            with pytest.raises(ValueError, match=r"q0 does not satisfy constraints: .* system\.project"):
                lagjax.simulate(*given)


# ---- the rules of the one primitive ----------------------------------------------------------------------------------


def test_what_is_computed_in_doubles_is_differentiated_and_batched(off):
    """A third derivative, a batch over one argument, integers, and a sum that float32 would lose: 1e8 + 1 − 1e8."""

    def lost(x, k):
        return {"sum": (x + 1e8) - 1e8 + x**3, "twice": 2 * k, "name": "kept"}

    def of(x, k=3):
        return compute_in_doubles(lost, x, jnp.asarray(k))

    found = of(np.float32(0.3))
    assert found["sum"] == np.float32(float(np.float32(0.3)) + float(np.float32(0.3)) ** 3) and found["name"] == "kept"
    assert jax.jit(lambda k: of(np.float32(0.3), k)["twice"])(4) == 8
    value = lambda x: of(x)["sum"]
    for function in (value, jax.jit(value)):
        assert jax.grad(function)(2.0) == 13 and jax.jacfwd(jax.grad(function))(2.0) == 12
        assert jax.grad(jax.grad(jax.grad(function)))(2.0) == 6
        np.testing.assert_array_equal(jax.vmap(jax.grad(function))(jnp.arange(3.0)), [1, 4, 13])
    both = jax.grad(lambda x, y: compute_in_doubles(lambda x, y: x * y, x, y), (0, 1))
    np.testing.assert_array_equal(jax.vmap(both, (0, None))(jnp.arange(2.0), 5.0), [[5, 5], [0, 1]])


# ---- which precision -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("q0", "qdot0", "ts", "params", "dtype"),
    [
        (np.float32(1), np.float32(0), TS, 9.81, np.float32),
        (np.float32(1), np.float32(0), TS.astype(float), np.float64(9.81), np.float32),  # the state decides
        (np.float32(1), np.float64(0), TS, np.float32(9.81), np.float64),  # as JAX promotes
        (1.0, 0.0, np.arange(4), np.float32(9.81), np.float64),
        (jnp.float32(1), jnp.float32(0), np.arange(4), 10, np.float32),
    ],
)
def test_the_state_decides_about_the_precision(q0, qdot0, ts, params, dtype):
    system = BALL_G
    run = lagjax.simulate(system, q0, qdot0, ts, params)
    kinds = {x.dtype for x in jax.tree.leaves((run.q, run.qdot, run.ts, run.end.q, run.end.t))}
    assert kinds == {np.dtype(dtype)} and run.engine == "MachineCode"
    end = 1 - 0.5 * float(params) * float(ts[-1]) ** 2
    assert run.q[-1] == pytest.approx(end, rel=float(2 * np.finfo(dtype).eps))
    if isinstance(params, float):
        slope = jax.grad(lambda params: lagjax.simulate(system, q0, qdot0, ts, params).q[-1])(params)
        assert slope.dtype == np.result_type(params) and slope == pytest.approx(-0.5 * float(ts[-1]) ** 2, rel=1e-7)


def test_solvers_of_diffrax_compute_in_the_precision_of_the_state(off):
    run = lagjax.simulate(SCENE, START, 0 * START, TS, {"m": 1.0, "l": 0.5}, solver=diffrax.Tsit5())
    assert run.engine == "Diffrax" and run.tolerances[0] == np.float32(1e-5)
    with pytest.raises(ValueError, match="float32 cannot meet rtol=1e-09"):
        lagjax.simulate(SCENE, START, 0 * START, TS, {"m": 1.0, "l": 0.5}, solver=diffrax.Tsit5(), rtol=1e-9)


def test_a_new_value_compiles_nothing(off):
    gradient = jax.jit(jax.grad(last_angle))
    gradient(1.0, 0.5)
    last_angle(1.0, 0.5)
    with jax.no_tracing():
        gradient(1.1, 0.4)
        last_angle(1.1, 0.4)


# ---- what is done with motions ---------------------------------------------------------------------------------------


DOUBLED_BALL = lagjax.System(lambda q, v: v**2 - 2 * 9.81 * q)


def test_what_a_scene_does(off):
    params = {"m": 1.0, "l": LENGTH}
    rest = lagjax.equilibrium(SCENE, 0.3, params)
    assert rest.q.dtype == np.float32 and abs(rest.q) < 1e-7 and rest.ok
    flat = lagjax.linearize(SCENE, 0.0, params=params)
    agrees(flat.A, np.array([[0, 1], [-9.81 / float(LENGTH), 0]]), 1)
    kepler = KEPLER
    found = lagjax.conserved_quantities(kepler, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.2]))
    assert [charge.name for charge in found] == ["energy", "angular momentum in the plane 01"]
    assert lagjax.same_motion(BALL, DOUBLED_BALL, 0.0, 1.0).same


@pytest.mark.slow
def test_what_motions_of_a_scene_do(off):
    params = {"m": 1.0, "l": LENGTH}
    orbit = lagjax.periodic_orbit(SCENE, 1.0, 0.0, 1.2, params)
    agrees(orbit.period, in_double(lambda *x: lagjax.periodic_orbit(SCENE, 1.0, 0.0, 1.2, params).period), 2)
    path = lagjax.find_path(BALL, 0.0, 1.0, 0.0, 0.5)
    assert abs(path.trajectory.q[-1] - 1.0) <= 2 * EPS
    assert lagjax.lyapunov_spectrum(SCENE, 1.0, 0.0, 5.0, params).dtype == np.float32


def test_parameters_from_recordings(off):
    ts = np.linspace(0, 5, 201, dtype=np.float32)
    clean = lagjax.simulate(SCENE, 1.0, 0.0, ts, {"m": 1.0, "l": 0.3}).q
    noise = 0.01 * np.random.default_rng(0).normal(size=ts.shape)
    params0, free = {"m": 1.0, "l": 0.35}, {"m": False, "l": True}
    record = lagjax.Record(ts, np.asarray(clean + noise, np.float32))
    found = lagjax.fit(SCENE, record, params0, free=free)
    low, high = found.intervals()
    assert found.ok and low["l"] < 0.3 < high["l"] and "converged" in str(found)
    again = found.predict(record)
    assert np.abs(np.asarray(again.values) - clean).max() < 0.01


@pytest.mark.slow
def test_the_first_script_of_a_newcomer():
    """In a process where nobody has touched the switch: the digits of the README, and a line that says what is off."""
    script = """
import jax, jax.numpy as jnp, lagjax
def pendulum(q, qdot, params):
    kinetic = 0.5 * params["m"] * params["l"] ** 2 * qdot**2
    return kinetic + params["m"] * 9.81 * params["l"] * jnp.cos(q)
scene, ts, params = lagjax.System(pendulum), jnp.linspace(0, 10, 101), {"m": 1.0, "l": 0.5}
trajectory = lagjax.simulate(scene, q0=1.0, qdot0=0.0, ts=ts, params=params)
print(trajectory)
print(f"{trajectory.q[-1]:.6f}")
print(lagjax.simulate_batch(scene, jnp.linspace(0, 3, 1000), jnp.zeros(1000), ts, params))
print(f"{jax.grad(lambda l: lagjax.simulate(scene, 1.0, 0.0, ts, {'m': 1.0, 'l': l}).q[-1])(0.5):.4f}")
"""
    clean = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    ran = subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", script], env=clean, capture_output=True,
                         text=True, check=True)  # fmt: skip
    lines = ran.stdout.splitlines()
    assert lines[0] == "Trajectory, float32, as jax_enable_x64 is off: q (101,), and qdot"
    assert "121 steps (0 rejected)" in lines[1] and lines[3] == "-0.772879" and "1000 of 1000" in lines[6]
    assert abs(float(lines[7]) + 26.2499) < 2e-4
