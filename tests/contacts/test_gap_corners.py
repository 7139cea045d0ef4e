"""Gaps with corners: open ones against the same scene with a gap for each side, closed ones against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweeps import sweep

import lagjax

G = 9.81
WALLS = {
    "abs": lambda q: {"walls": 1 - jnp.abs(q)},
    "minimum": lambda q: {"walls": jnp.minimum(1 - q, 1 + q)},
    "where": lambda q: {"walls": jnp.where(q > 0, 1 - q, 1 + q)},
    "interp": lambda q: {"walls": jnp.interp(q, jnp.array([-2.0, 0.0, 2.0]), jnp.array([-1.0, 1.0, -1.0]))},
}


def end_of(contacts, restitution, q, v, duration=5.0):
    system = lagjax.System(lambda q, v: 0.5 * v**2 - 0.1 * q, contacts=contacts, restitution=restitution)
    run = lagjax.simulate(system, q, v, jnp.stack([0.0 * jnp.asarray(duration), jnp.asarray(duration)]))
    return jnp.stack([run.q[-1], run.qdot[-1]]), run.impacts.count


def two_walls(q):
    return {"left": 1 + q, "right": 1 - q}


@functools.cache
def two_walls_apart():
    """Ends and counts of many starts between two walls with a gap for each, and the slopes of one end."""
    two = lambda x: end_of(two_walls, 0.9, *x)
    return jax.jit(jax.vmap(two)), jax.jit(jax.jacfwd(lambda x: two(x)[0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", WALLS)
def test_a_ball_between_walls_bounces_at_both(name):
    """From x = 0 too, where the two pieces of the gap meet; with derivatives in both modes, and in batches."""
    one = lambda x: end_of(WALLS[name], 0.9, *x)
    alone, expected, wanted = jax.jit(one), *two_walls_apart()
    for x in ([0.0, 1.0], [0.2, -1.0]):
        (state, count), (right, number) = alone(np.array(x)), expected(np.array([x]))
        assert count == number[0] >= 2
        np.testing.assert_allclose(state, right[0], rtol=0, atol=1e-13)
    x = np.array([0.0, 1.0])
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(lambda x: one(x)[0]))(x), wanted(x), rtol=0, atol=1e-12)
    states = np.array([[0.0, 1.0], [0.0, -2.0], [-0.5, 0.3]])
    np.testing.assert_allclose(jax.jit(jax.vmap(one))(states)[0], expected(states)[0], rtol=0, atol=1e-13)


@pytest.mark.slow
def test_walls_of_one_gap_in_float32_and_to_second_order():
    ones, twos = (
        end_of(of, 0.9, jnp.float32(0.0), jnp.float32(1.0), jnp.float32(5.0))[0] for of in (WALLS["abs"], two_walls)
    )
    assert ones.dtype == jnp.float32
    np.testing.assert_allclose(ones, twos, rtol=0, atol=2e-6)
    curves = [
        jax.jit(jax.hessian(lambda v, of=of: end_of(of, 0.9, 0.1, v, 3.0)[0][0]))(jnp.array(1.0))
        for of in (WALLS["abs"], two_walls)
    ]
    np.testing.assert_allclose(*curves, rtol=1e-11)


def planar(q, v):
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"]


def slide(gap, x, duration, params=None, **options):
    """(x, y, vx, vy) behind a start at (x, y) with velocity (vx, vy)."""
    system = lagjax.System(planar, contacts=gap, **options)
    q, v = {"x": x[0], "y": x[1]}, {"x": x[2], "y": x[3]}
    run = lagjax.simulate(system, q, v, jnp.array([0.0, duration]), params)
    return jnp.stack([run.q["x"][-1], run.q["y"][-1], run.qdot["x"][-1], run.qdot["y"][-1]])


def with_slopes(mode, function):
    """`x ↦ (function(x), its slopes)`, in one program."""

    def twice(x, *given):
        end = function(x, *given)
        return end, end

    def both(x, *given):
        slopes, end = mode(twice, has_aux=True)(x, *given)
        return end, slopes

    return jax.jit(both)


def test_a_block_that_slides_into_a_slope_strikes_it():
    """As with the slope for a contact of its own; it comes back, and strikes the floor."""
    x = np.array([-1.0, 0.0, 0.5, 0.0])

    def rising(q, params):
        return q["y"] - params["slope"] * jnp.maximum(q["x"], 0.0)

    def apart(q, params):
        return {"a": q["y"], "b": q["y"] - params["slope"] * q["x"]}

    of_one, of_two = (
        with_slopes(jax.jacfwd, lambda x, p, of=of: slide(of, x, 3.3, p, restitution=lambda params: params["e"]))
        for of in (rising, apart)
    )
    for slope, restitution in ((0.3, 0.0), (1.0, 0.5)):
        params = {"slope": slope, "e": restitution}
        (end, slopes), (right, right_slopes) = of_one(x, params), of_two(x, params)
        np.testing.assert_allclose(end, right, rtol=0, atol=1e-12)
        np.testing.assert_allclose(slopes, right_slopes, rtol=0, atol=1e-10)


EDGES = {
    "steep": lambda q: q["y"] + 1e3 * jnp.maximum(q["x"], 0.0),
    "jump": lambda q: jnp.where(q["x"] < 0, q["y"], 5.0),
    "table": lambda q: (
        q["y"] - jnp.interp(q["x"], jnp.array([-9.0, 0.0, 0.1, 9.0]), jnp.array([0.0, 0.0, -50.0, -60.0]))
    ),
}
RISING_FLOOR = lagjax.System(
    lambda q, v: 0.5 * v**2 - G * q, contacts=lambda q, t: q - 2.0 * jnp.maximum(t - 1.0, 0.0), restitution=1.0
)
BELT_THAT_ENDS = lagjax.System(
    planar, contacts=lambda q: q["y"], friction=0.2,
    slip=lambda q, v, t: v["x"] - jnp.where(t > 1.0, 3.0, 0.0),
)  # fmt: skip
STEP_BEFORE_A_WALL = lagjax.System(
    lambda q, v: 0.5 * v**2 - jnp.where(q > 0, 0.1, 0.0), contacts=lambda q: 1 - q, restitution=1.0
)


@pytest.mark.parametrize("name", sweep(EDGES, kept=["steep"]))
def test_a_block_slides_off_the_edge_of_a_table(name):
    x = np.array([-1.0, 0.0, 0.5, 0.0])
    fall = 1.3
    state, slopes = with_slopes(jax.jacrev, lambda x: slide(EDGES[name], x, 2.0 + fall))(x)
    np.testing.assert_allclose(state, [0.65, -G * fall**2 / 2, 0.5, -G * fall], rtol=0, atol=1e-11)
    np.testing.assert_allclose(slopes[1, 0], -2 * G * fall, rtol=1e-11)
    np.testing.assert_allclose(slopes[1, 2], -4 * G * fall, rtol=1e-11)


def test_a_step_in_time_strikes_what_rests_on_it():
    """A piston that sets out at t = 1 with speed 2; outputs at that very time are there."""
    run = lagjax.simulate(RISING_FLOOR, 0.0, 0.0, np.array([0.0, 1.0, 1.2]))
    np.testing.assert_allclose(run.q, [0.0, 0.0, 4 * 0.2 - G * 0.2**2 / 2], rtol=0, atol=1e-12)


def test_a_belt_that_ends_lets_slip_what_sticks_to_it():
    """From the belt, which is at rest, a block that a force pulls comes onto one that runs."""
    run = lagjax.simulate(BELT_THAT_ENDS, {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(run.qdot["x"], [0.0, 0.0, 0.2 * G], rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("gap", "x"),
    [
        (lambda q: q["y"] - jnp.abs(q["x"]), [0.0, 1.0, 0.0, 0.0]),  # the bottom of a valley
        (lambda q: q["y"] + jnp.abs(q["x"]), [0.0, 0.0, 0.0, 0.0]),  # rest on an edge
        (lambda q: q["y"] - jnp.where(q["x"] > 0, 1.0, 0.0), [-1.0, 0.3, 1.0, 0.0]),  # into a step
    ],
)
def test_what_is_struck_or_rests_on_a_corner_is_named(gap, x):
    system = lagjax.System(planar, contacts=gap, restitution=0.5)
    q, v = {"x": x[0], "y": x[1]}, {"x": x[2], "y": x[3]}
    ts = np.array([0.0, 1.5])
    assert lagjax.simulate(system, q, v, ts, throw=False).result == lagjax.RESULTS.contact_at_corner
    with pytest.raises(lagjax.SimulationError, match=r"corner or a jump of its gap.*a gap of its own"):
        lagjax.simulate(system, q, v, ts)


@pytest.mark.parametrize("gap", [jnp.abs, lambda q: q % 1.0, lambda q: 0.5 - jnp.abs(q % 1.0 - 0.5)])
def test_a_gap_that_is_zero_at_its_corner_is_refused(gap):
    """It would be passed, or struck, as rounding has it."""
    system = lagjax.System(lambda q, v: 0.5 * v**2, contacts=lambda q: {"wall": gap(q)}, restitution=1.0)
    with pytest.raises(ValueError, match=r"contacts\['wall'\] is zero where two of its pieces meet.*a gap of its own"):
        lagjax.simulate(system, 0.3, 1.0, np.array([0.0, 1.0]))


def test_a_potential_step_beside_a_contact():
    """L jumps by 0.1 at x = 0: ½ v² falls by that. Before, an open gap made the motion NaN."""
    run = lagjax.simulate(STEP_BEFORE_A_WALL, -0.5, 1.0, np.array([0.0, 1.0, 3.0]))
    slow = np.sqrt(0.8)
    np.testing.assert_allclose(run.q[1], 0.5 * slow, rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.qdot[2], -1.0, rtol=0, atol=1e-13)


TABLE_BESIDE = lagjax.System(
    lambda q, v, params: 0.5 * v**2 + q * jnp.interp(q, jnp.array([-2.0, 0.0, 2.0]), params),
    contacts=lambda q: 1 - q,
    restitution=1.0,
)


@pytest.mark.slow
def test_a_table_beside_a_contact_has_derivatives_by_its_entries():
    def end(entries):
        system = TABLE_BESIDE  # fmt: skip
        return lagjax.simulate(system, 0.2, 1.0, jnp.array([0.0, 2.0]), entries).q[-1]

    entries, moved = np.array([0.1, 0.0, 1.0]), 1e-6 * np.eye(3)
    above, below = (jax.jit(jax.vmap(end))(entries + side * moved) for side in (1, -1))
    np.testing.assert_allclose(jax.jit(jax.grad(end))(entries), (above - below) / 2e-6, atol=1e-8)


# ---- results with a name ---------------------------------------------------------------------------------------------


def drop(e=0.5, mu=0.1, last=1.0, **options):
    system = lagjax.System(
        planar, contacts=lambda q: {"floor": q["y"]}, slip=lambda q, v: {"floor": v["x"]},
        restitution=lambda params: params[0], friction=lambda params: params[1],
    )  # fmt: skip
    q, v = {"x": 0.0, "y": 0.2}, {"x": 1.0, "y": 0.0}
    ts = jnp.stack([jnp.asarray(0.0), jnp.asarray(last)])
    return lagjax.simulate(system, q, v, ts, jnp.stack([jnp.asarray(e), jnp.asarray(mu)]), **options)


def test_coefficients_out_of_range_and_times_that_fall_are_named_inside_jit_and_batches():
    results = jax.jit(jax.vmap(lambda *given: drop(*given, throw=False).result))(
        jnp.array([0.5, -0.1, 1.1, 0.5, 0.5, jnp.nan]), jnp.array([0.1, 0.1, 0.1, -0.1, 0.1, 0.1]),
        jnp.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0]),
    )  # fmt: skip
    of = lagjax.RESULTS
    expected = [of.successful, *[of.restitution_out_of_range] * 2, of.friction_out_of_range, of.contact_backwards,
                of.restitution_out_of_range]  # fmt: skip
    assert results._value.tolist() == [int(x._value) for x in expected]
    for given, match in (((0.5, -0.1), "friction must be"), ((0.5, 0.1, -1.0), "goes forward in time")):
        with pytest.raises(Exception, match=match):
            jax.block_until_ready(jax.jit(lambda *given: drop(*given).q)(*map(jnp.asarray, given)))


@pytest.mark.parametrize(
    ("options", "kind", "match"),
    [
        ({"restitution": "0.5"}, TypeError, "restitution must be a number, .* got '0.5'"),
        ({"friction": {"floor": 0.1, "wall": 0.2}}, ValueError, "friction names 'wall', and slip does not"),
        ({"one_way": lambda q, v: {"ratchet": q["x"]}}, ValueError, r"one_way\['ratchet'\] does not depend on qdot"),
    ],
)
def test_what_newcomers_write_is_named(options, kind, match):
    given = {
        "contacts": lambda q: {"floor": q["y"], "wall": q["x"] + 2}, "slip": lambda q, v: {"floor": v["x"]}, **options
    }  # fmt: skip
    with pytest.raises(kind, match=match):
        system = lagjax.System(planar, **given)
        lagjax.simulate(system, {"x": 0.0, "y": 1.0}, {"x": 0.0, "y": 0.0}, np.array([0.0, 0.1]))


@pytest.mark.slow
def test_a_gap_is_infinite_while_it_is_off():
    """A stone over a floor that begins at x = 0, or at x = 0 ends: where it is on, off, and on too late."""
    gap = lambda q: {"floor": jnp.where(q[0] > 0, q[1], jnp.inf)}
    stone, ts = lagjax.System(lambda q, v: 0.5 * v @ v - 2 * q[1], contacts=gap), np.array([0.0, 1.5, 3.0])
    q0, v0 = np.array([[-1.0, 1.0], [1.5, 1.0], [-1.5, 1.0]]), np.array([[2.0, 0.0], [-1.0, 0.0], [1.0, 0.0]])
    run = lagjax.simulate_batch(stone, q0, v0, ts)
    assert repr(run.result) == "lagjax.RESULTS<2 successful, 1 contact_at_corner>"
    # The first lands at t = 1 and rests; the second rests from t = 1 to 1.5 and falls on.
    np.testing.assert_allclose(run.q[0, 1:], [[2.0, 0.0], [5.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(run.q[1, 2], [-1.5, -(1.5**2)], atol=1e-9)
    np.testing.assert_allclose(run.contact_forces["floor"][0], [0.0, 2.0, 2.0], atol=1e-12)


EDGE = 0.05  # the radius of a ball, about the edge of a table at x = params


def over_edge(q, params):
    x = q[0] - params
    return jnp.where(x < 0, q[1], jnp.sqrt(jnp.where(x < 0, 1.0, x**2 + q[1] ** 2))) - EDGE


ROLLING = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q, params: {"table": over_edge(q, params)})


@pytest.mark.parametrize("edge", [0.0, 0.3])
def test_a_ball_rolls_over_an_edge_or_flies_off_it(edge):
    """The curvature of the gap jumps under the closed contact, and λ with it: at 0.3 from mg to mg cos θ − mv²/r, which
    ends where cos θ = (2 + v²/gr) / 3; at 1 and more below zero, where the ball flies on by itself."""

    def end(x, duration, rtol):
        speed, edge, begin = x
        start = jnp.stack([begin, EDGE]), jnp.stack([speed, 0.0])
        return lagjax.simulate(ROLLING, *start, jnp.stack([0.0, duration]), edge, rtol=rtol).q[-1]

    def flight(x, duration):
        speed, edge, begin = x
        return jnp.stack([begin + speed * duration, EDGE - 0.5 * G * (duration - (edge - begin) / speed) ** 2])

    for rtol in (1e-6, 1e-13):
        follow = jax.jit(lambda x, duration, rtol=rtol: end(x, duration, rtol))
        for speed in (1.0, 2.0, 10.0):
            x, duration = np.array([speed, edge, edge - 0.06]), 0.09 / speed
            np.testing.assert_allclose(follow(x, duration), flight(x, duration), rtol=0, atol=1e-13)
        slow = lagjax.simulate(
            ROLLING, np.array([edge - 0.06, EDGE]), np.array([0.3, 0.0]), np.array([0.0, 0.8]), edge, rtol=rtol
        )
        (leaves,) = np.flatnonzero(np.asarray(slow.contact_changes.change) == 1)
        place = (slow.contact_changes.q[leaves] - np.array([edge, 0.0])) / EDGE
        assert place[1] == pytest.approx((2 + 0.09 / (G * EDGE)) / 3, abs=max(1e-13, 30 * rtol))
    x, duration = np.array([1.0, edge, edge - 0.06]), 0.09
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(mode(lambda x: end(x, duration, 1e-12)))(x)
        np.testing.assert_allclose(slopes, jax.jacfwd(flight)(x, duration), rtol=0, atol=1e-11)
