"""Contacts as a user writes them, by name: what a trajectory tells of them, what is refused, how they transform."""

import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import ball_in_gravity
from scenes import in_potential, particles, weight_on

pytest.importorskip("scipy", reason="the references are computed with it")
sys.path.insert(0, str(Path(__file__).parents[2]))

import lagjax
from benchmarks._contact_reference import Reference, Scene
from benchmarks._contacts import SHAKEN, SHAKEN_REST, TIP, system_of, tip
from benchmarks.contacts import TOSS, fit_tosses

G = 9.81


def planar(q, v):
    """½ (ẋ² + ẏ²) − g y, by name"""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"]


BOX = lagjax.System(
    planar, contacts=lambda q: {"floor": q["y"] - 0.1, "wall": 0.9 - q["x"]}, restitution={"floor": 0.8, "wall": 0.5}
)
BALL = lagjax.System(ball_in_gravity, contacts=lambda q: q, restitution=lambda params: params["e"])
BLOCK = lagjax.System(
    lambda q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2)
    - G * (jnp.sin(params["a"]) * q["x"] + jnp.cos(params["a"]) * q["y"]),
    contacts=lambda q: {"floor": q["y"]}, friction=lambda params: params["mu"], slip=lambda q, v: {"floor": v["x"]},
)  # fmt: skip


def state(**values):
    return {name: jnp.asarray(value, float) for name, value in values.items()}


def test_what_a_trajectory_tells_of_its_impacts():
    u = np.sqrt(2 * G)  # a fall by 1, with 1 to the wall at 0.8
    ts = jnp.array([0.0, 0.6, 1.0])
    run = lagjax.simulate(BOX, state(x=0.0, y=1.1), state(x=1.0, y=0.0), ts)
    impacts = run.impacts
    assert int(impacts.count) == 2 and set(impacts.impulse) == {"floor", "wall"}
    np.testing.assert_allclose(impacts.t[:2], [u / G, 0.9], rtol=1e-14)
    np.testing.assert_allclose(impacts.impulse["floor"][:2], [1.8 * u, 0.0], atol=1e-13)
    np.testing.assert_allclose(impacts.impulse["wall"][:2], [0.0, 1.5], atol=1e-13)
    np.testing.assert_allclose(impacts.energy_lost[:2], [0.36 * u * u / 2, 0.75 / 2], atol=1e-13)
    for values in (impacts.t, impacts.impulse["floor"], impacts.impulse["wall"], impacts.energy_lost):
        assert np.isnan(values[2:]).all()
    left = 1.0 - u / G
    np.testing.assert_allclose(
        [run.q["x"][-1], run.q["y"][-1]], [0.9 - 0.05, 0.1 + 0.8 * u * left - G * left**2 / 2], rtol=1e-13
    )
    np.testing.assert_array_equal(run.contact_forces["floor"], np.zeros(3))


def test_forces_of_contacts_that_last():
    a = 0.3
    held = lagjax.simulate(
        BLOCK, state(x=0.0, y=0.0), state(x=0.0, y=0.0), np.linspace(0.0, 1e6, 5), {"a": a, "mu": 0.5}
    )  # fmt: skip
    np.testing.assert_allclose(held.contact_forces["floor"], np.full(5, G * np.cos(a)), rtol=1e-14)
    for values in (*held.q.values(), *held.qdot.values()):  # rest is rest
        np.testing.assert_array_equal(values, np.zeros(5))
    slides = lagjax.simulate(
        BLOCK, state(x=0.0, y=0.0), state(x=0.0, y=0.0), np.linspace(0.0, 1.0, 5), {"a": a, "mu": 0.2}
    )  # fmt: skip
    np.testing.assert_allclose(slides.qdot["x"], -G * (np.sin(a) - 0.2 * np.cos(a)) * slides.ts, atol=1e-13)


def test_a_particle_rests_in_a_corner_of_three_walls():
    force = np.array([1.0, 2.0, 3.0])
    system = in_potential(lambda q: force @ q, contacts=lambda q: q, restitution=0.5)
    run = lagjax.simulate(system, np.zeros(3), np.zeros(3), np.array([0.0, 5.0]))
    np.testing.assert_allclose(run.contact_forces[-1], force, rtol=1e-14)
    np.testing.assert_array_equal(run.q[-1], np.zeros(3))


def test_a_ball_on_a_shaken_table_comes_to_rest():
    run = lagjax.simulate(
        system_of(SHAKEN), np.array([0.3]), np.zeros(1), np.array([0.0, 2.5]), np.array([G, 0.6, 0.05, 10.0])
    )
    np.testing.assert_allclose(run.impacts.t[run.impacts.count - 1], SHAKEN_REST, atol=1e-11)
    np.testing.assert_allclose(run.q[-1], 0.05 * np.sin(25.0), atol=1e-12)


# ---- what is refused -------------------------------------------------------------------------------------------------


def test_a_start_inside_a_wall_is_named():
    with pytest.raises(ValueError, match="wall"):
        lagjax.simulate(BOX, state(x=1.0, y=1.1), state(x=0.0, y=0.0), np.array([0.0, 1.0]))
    assert "wall" in str(lagjax.check(BOX, state(x=1.0, y=1.1), state(x=0.0, y=0.0)))


DROP = lagjax.System(lambda q, v: 0.5 * v**2 - G * q, contacts=lambda q: q, restitution=0.6)
CYLINDER = lagjax.System(
    lambda q, v, params: 0.5 * (v["r"] ** 2 + (q["r"] * v["one"]) ** 2) + 0.5 * params * A**2 * v["two"] ** 2
    - G * q["r"] * jnp.cos(q["one"]),
    constraints=lambda q: R * q["one"] - A * (q["two"] - q["one"]),
    contacts=lambda q: {"normal": q["r"] - R - A},
)  # fmt: skip
RACKET = lagjax.System(lambda q, v: 0.5 * v**2, contacts=lambda q, t: q - t, restitution=0.5)
ROD = lagjax.System(
    lambda q, v: 0.5 * (v[0] ** 2 + 0.1 * v[1] ** 2) - G * q[0], restitution=0.5,
    contacts=lambda q: q[0] + 0.5 * jnp.array([1.0, -1.0]) * jnp.sin(q[1]),
)  # fmt: skip
HIDDEN = lagjax.System(
    lambda q, v: 0.5 * v @ v, restitution=1.0,
    contacts=lambda q: 1 - jnp.sqrt(jnp.maximum(jnp.abs(q[0]) - 1, 0.0) ** 2 + q[1] ** 2),
)  # fmt: skip
FLOOR_AND_WALL = lagjax.System(
    planar, contacts=lambda q: {"floor": q["y"], "wall": q["x"]}, slip=lambda q, v: {"floor": v["x"]}, friction=0.1,
    impacts="poisson",
)  # fmt: skip
COLUMN = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v**2) - 9.81 * jnp.sum(q) - 100 * jnp.sum((q[:-1] - q[1:]) ** 2),
    contacts=lambda q: q[:-1] - q[1:],
)
LIFTED = lagjax.System(
    lambda q, v, params: 0.15 * v**2 - params * q - 0.35 * (q + 0.1) ** 2,
    forces=lambda q, v, t: 3 * t, contacts=lambda q: q,
)  # fmt: skip
BEADS = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v**2), contacts=lambda q: q[1:] - q[:-1] - 0.5, restitution=lambda params: params
)
DULL_BEADS = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2), contacts=lambda q: q[1:] - q[:-1] - 0.5)
THROWN_BALL = lagjax.System(
    lambda q, v: 0.5 * v @ v - 9.81 * q[1], contacts=lambda q: {"floor": q[1]}, restitution=lambda params: params
)


def test_a_motion_goes_on_from_where_it_came_to_an_impact():
    """Drops on q ≥ 0, cut where they first touch it, and starts at rest there that are rounding; one program.

    A gap that is the coordinate ends as ±1e-16 of the height, of which its own rounding is nothing.
    """
    for height in np.random.default_rng(5).uniform(0.1, 3.0, 20):
        at = np.sqrt(2 * height / G)
        first = lagjax.simulate(DROP, height, 0.0, np.array([0.0, at]))
        then = lagjax.simulate(DROP, first.q[-1], first.qdot[-1], np.array([at, 1.5 * at]))
        np.testing.assert_allclose(then.q[-1], 0.5 * at * (0.6 * G * at - 0.25 * G * at), rtol=1e-12)
    for gap in (-1e-16, -1e-17):
        assert lagjax.simulate(DROP, gap, 0.0, np.array([0.0, 1.0])).ok
    with pytest.raises(ValueError, match="starts inside"):
        lagjax.simulate(DROP, -1e-6, 1.0, np.array([0.0, 1.0]))


SPRING_OVER_A_FLOOR = lagjax.System(lambda q, v: 0.5 * v**2 - 0.5 * q**2, contacts=lambda q: q, restitution=0.8)


def test_a_stretch_of_many_steps_is_finished_in_threads_of_xla_too(monkeypatch):
    # These take the smallest numbers for zero: whether a kernel has more to do must not be one. A kernel of few rounds
    # needs a scene of its own.
    monkeypatch.setattr("lagjax._run.jumps._scene_code._ROUNDS", 1)

    def end(h):
        return lagjax.simulate(SPRING_OVER_A_FLOOR, h, 0.0, np.array([0.0, 2.0])).q[-1]

    slope = 0.8 * np.sin(2.0 - np.pi / 2)  # q = h cos t, and −0.8 h cos t behind the floor
    np.testing.assert_allclose(end(1.5), 1.5 * slope, rtol=1e-11)
    np.testing.assert_allclose(jax.value_and_grad(end)(1.5), [1.5 * slope, slope], rtol=1e-11)


@pytest.mark.slow
def test_the_impact_at_a_cut_varies_as_any_does():
    """200 drops of micrometres in milliseconds, cut at their first or second impact, against whole motions.

    Compiles a batch of three motions with its gradient.
    """

    def follow(q, v, *ts):
        return lagjax.simulate(DROP, q, v, jnp.stack(ts), max_transitions=9, throw=False)

    def change_by_cut(height, cut):
        falls = jnp.sqrt(2 * jax.lax.stop_gradient(height) / G)
        at, end = (1.0 + 1.2 * cut) * falls, 2.8 * falls
        first, whole = follow(height, 0.0, 0.0, at), follow(height, 0.0, 0.0, end)
        then = follow(first.q[-1], first.qdot[-1], at, end)
        return then.q[-1] - whole.q[-1], first.ok & then.ok & whole.ok

    rng = np.random.default_rng(5)
    given = 1e-6 * rng.uniform(0.3, 3.0, 200), rng.integers(0, 2, 200)
    (change, ok), slopes = jax.jit(jax.vmap(jax.value_and_grad(change_by_cut, has_aux=True)))(*given)
    assert ok.all()
    np.testing.assert_allclose(change, 0.0, atol=1e-19)
    np.testing.assert_allclose(slopes, 0.0, atol=1e-10)


def test_a_closed_gap_that_moves_inwards_is_an_impact_at_once_which_check_names():
    run = lagjax.simulate(BOX, state(x=0.0, y=0.1), state(x=0.0, y=-1.0), np.array([0.0, 0.1]))
    assert run.impacts.t[0] == 0.0 and run.impacts.impulse["floor"][0] == 1.8
    assert "floor" in str(lagjax.check(BOX, state(x=0.0, y=0.1), state(x=0.0, y=-1.0)))


@pytest.mark.parametrize("mu, turning", [(2, 0), (2, 8)])
def test_painleves_rod_is_a_named_end(mu, turning):
    q, v, p = (jnp.array(part, float) for part in tip(mu, turning))
    with pytest.raises(lagjax.SimulationError, match="Painlev"):
        lagjax.simulate(system_of(TIP), q, v, np.array([0.0, 1e-3]), p)


def test_painleves_rod_with_less_friction_slides_on():
    q, v, p = (jnp.array(part, float) for part in tip(1, 0))
    run = lagjax.simulate(system_of(TIP), q, v, np.array([0.0, 1e-3]), p)
    right = Reference(TIP, q, p).run(np.asarray(q), np.asarray(v), 1e-3, np.asarray(p)).z
    np.testing.assert_allclose(np.concatenate([run.q[-1], run.qdot[-1]]), right, atol=1e-11)


def test_the_budget_of_events_is_named():
    with pytest.raises(lagjax.SimulationError, match="max_transitions"):
        lagjax.simulate(BALL, 1.0, 0.0, np.array([0.0, 2.0]), {"g": G, "e": 0.9}, max_transitions=3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"friction": 0.3}, "slip"),
        ({"friction": 0.3, "slip": lambda q, v: {"ground": v["x"]}}, "slip"),
        ({"restitution": {"ground": 0.5}}, "ground"),
        ({"restitution": 1.5}, "restitution"),
        ({"friction": -0.1, "slip": lambda q, v: {"floor": v["x"]}}, "friction"),
        ({"impacts": "at once"}, "sequential"),
        ({"restitution": {"floor": np.full(3, 0.5)}}, "one for each contact"),
    ],
)
def test_what_cannot_be_a_contact(options, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        system = lagjax.System(planar, contacts=lambda q: {"floor": q["y"]}, **options)
        lagjax.simulate(system, state(x=0.0, y=1.0), state(x=0.0, y=0.0), np.array([0.0, 0.1]))


# ---- how they transform ----------------------------------------------------------------------------------------------


def test_members_have_their_own_impacts():
    """One, batched, under vmap, and of float32: bounces of six heights, up to rest, of each as many as fill threads."""
    h, ts, params = (
        jnp.tile(jnp.array([0.2, 0.5, 1.0, 1.5, 2.0, 30.0]), 30),
        jnp.array([0.0, 1.0, 2.0]),
        {"g": G, "e": 0.5},
    )
    batch = lagjax.simulate_batch(BALL, h, jnp.zeros(h.size), ts, params)
    assert batch.ok.all() and int(batch.impacts.count[-1]) == 0
    assert (batch.impacts.count[:5] > 3).all()
    np.testing.assert_array_equal(batch.q[:6], batch.q[-6:])
    mapped = jax.jit(jax.vmap(lambda h: lagjax.simulate(BALL, h, jnp.zeros_like(h), ts, params)))(h)
    np.testing.assert_allclose(mapped.q, batch.q, atol=1e-14)
    for k in (0, 3):
        np.testing.assert_allclose(lagjax.simulate(BALL, h[k], 0.0, ts, params).q, batch.q[k], atol=1e-14)
    single = lagjax.simulate_batch(
        BALL, *jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (h, jnp.zeros(h.size), ts, params))
    )
    assert single.q.dtype == single.impacts.t.dtype == jnp.float32
    np.testing.assert_allclose(single.q, batch.q, rtol=1e-5, atol=3e-6)


@pytest.mark.slow
def test_a_batch_has_room_for_the_impacts_of_its_members():
    """An elastic ball falls on the floor at odd multiples of the time of its first fall: 3 to 78 times here."""
    h, ts, params = jnp.array([0.02, 0.1, 1.0, 9.0]), jnp.array([0.0, 10.0]), {"g": G, "e": 1.0}
    batch = lagjax.simulate_batch(BALL, h, np.zeros(4), ts, params)
    falls = np.sqrt(2 * h / G)
    odd = np.arange(1, 2 * batch.impacts.t.shape[1], 2)
    exact = np.where(odd * falls[:, None] < 10.0, odd * falls[:, None], np.nan)
    np.testing.assert_allclose(batch.impacts.t, exact, rtol=1e-13)
    np.testing.assert_allclose(batch.impacts.impulse, np.where(exact > 0, 2 * G * falls[:, None], np.nan), rtol=1e-12)
    np.testing.assert_array_equal(batch.impacts.count, np.isfinite(exact).sum(axis=1))
    spent = lagjax.simulate_batch(BALL, h, np.zeros(4), ts, params, max_transitions=40)
    np.testing.assert_array_equal(spent.result == lagjax.RESULTS.max_transitions_reached, [True, False, False, False])
    np.testing.assert_array_equal(spent.impacts.t, batch.impacts.t[:, :40])


WITHOUT_SWITCH = """
import jax, jax.numpy as jnp, lagjax
ball = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - params["g"] * q, contacts=lambda q: q, restitution=lambda params: params["e"]
)
run = lambda h: lagjax.simulate(ball, h, 0.0, jnp.array([0.0, 0.8]), {"g": 9.81, "e": 0.5})
t = lambda h: (2 * h / 9.81) ** 0.5
def exact(h):
    left = 0.8 - t(h)
    return 0.5 * 9.81 * t(h) * left - 9.81 * left**2 / 2
h = jnp.float32(1.0)
assert run(h).q.dtype == jnp.float32 and run(h).ok
assert abs(run(h).q[-1] - exact(1.0)) < 1e-6
assert abs(jax.grad(lambda h: run(h).q[-1])(h) - jax.grad(exact)(1.0)) < 1e-5
at_rest = lagjax.simulate(ball, h, 0.0, jnp.array([0.0, 9.0]), {"g": 9.81, "e": 0.5})
assert at_rest.q[-1] == 0 and at_rest.qdot[-1] == 0 and at_rest.ok
"""


@pytest.mark.slow
def test_without_the_switch_for_double_precision():
    done = subprocess.run([sys.executable, "-c", WITHOUT_SWITCH], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_scan_over_pieces_is_the_whole():
    """Calls of 0.05 each, some of which begin at rest on the floor, or in the middle of bounces."""
    params, n = {"g": G, "e": 0.5}, 40

    def piece(carry, _):
        q, v = carry
        run = lagjax.simulate(BALL, q, v, jnp.array([0.0, 0.05]), params)
        return (run.q[-1], run.qdot[-1]), run.q[-1]

    _, pieces = jax.jit(lambda h: jax.lax.scan(piece, (h, jnp.zeros_like(h)), None, n))(np.array(1.0))
    whole = lagjax.simulate(BALL, 1.0, 0.0, 0.05 * np.arange(n + 1), params)
    np.testing.assert_allclose(pieces, whole.q[1:], atol=1e-12)


# ---- scenes with a history -------------------------------------------------------------------------------------------

R, A = 1.0, 0.25


@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_the_chapters_cylinder_flies_off_by_itself(alpha):
    """It rolls by a constraint, and leaves where cos θ₁ = 2 cos θ₁⁰/(3 + α)."""
    start, end = 0.3, 1.2
    q, ts = state(r=R + A, one=start, two=(R + A) / A * start), jnp.linspace(0.0, end, 7)
    run = lagjax.simulate(CYLINDER, q, jax.tree.map(jnp.zeros_like, q), ts, alpha)
    reduced = Scene(
        lambda q, v, t, p: 0.5 * (v[0] ** 2 + (q[0] ** 2 + p[0] * (R + A) ** 2) * v[1] ** 2) - G * q[0] * jnp.cos(q[1]),
        gaps=lambda q, t, p: q[:1] - R - A,
    )
    right = Reference(reduced, np.ones(2), [alpha]).run([R + A, start], [0.0, 0.0], end, [alpha])
    np.testing.assert_allclose(np.cos(right.events[0].after[1]), 2 * np.cos(start) / (3 + alpha), atol=1e-12)
    ours = [run.q["r"][-1], run.q["one"][-1], run.qdot["r"][-1], run.qdot["one"][-1]]
    np.testing.assert_allclose(ours, right.z, atol=1e-10)
    pressed = ts < right.events[0].t
    closed = ((3 + alpha) * np.cos(run.q["one"]) - 2 * np.cos(start)) * G / (1 + alpha)
    np.testing.assert_allclose(run.contact_forces["normal"], np.where(pressed, closed, 0.0), atol=1e-10)


ROUND = {
    "length": lambda q: 1.0 - jnp.hypot(q[0], q[1]),
    "logarithm": lambda q: 1.0 - jnp.exp(0.5 * jnp.log(q @ q)),
    "square": lambda q: 0.5 * (1.0 - q @ q),
}


def end_in_drum(gap, x):
    """A bounce on the inside of a circle, at t = 0.355, of a ball that falls from (x, −0.2)."""
    drum = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q: {"drum": gap(q)}, restitution=0.4)
    start = jnp.stack([x, jnp.full_like(x, -0.2)]), jnp.array([0.5, 0.0])
    return lagjax.simulate(drum, *start, jnp.array([0.0, 0.5])).q[-1]


@pytest.mark.slow
def test_a_bounce_is_the_same_by_every_gap_that_says_how_near_a_circle_is():
    """Its terms cancel to more than their rounding in the logarithm, whose gap falls once more as it moves apart."""
    starts = np.array([0.399, 0.3999, 0.4, 0.4001])
    ends = [jax.jit(jax.vmap(lambda x, gap=gap: end_in_drum(gap, x)))(starts) for gap in ROUND.values()]
    np.testing.assert_allclose(ends[0], ends[2], rtol=1e-12)
    np.testing.assert_allclose(ends[1], ends[2], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("gap", ROUND)
def test_second_derivatives_of_a_bounce_on_a_circle(gap):
    """Along the circle the argument of the root in |q| stands still, and its second derivative does not."""
    slope = jax.jit(lambda x: jax.jvp(lambda x: end_in_drum(ROUND[gap], x), (x,), (1.0,))[1])
    second = jax.jit(lambda x: jax.jvp(slope, (x,), (1.0,))[1])(0.4)
    h = 1e-4
    np.testing.assert_allclose(second, (slope(0.4 + h) - slope(0.4 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_housners_block_loses_what_he_says():
    """A block that rocks from one foot to the other keeps 1 − 3/2 sin²α of its angular velocity (Housner 1963)."""
    b, h, tilt = 0.2, 0.6, 0.1
    half, alpha = np.hypot(b, h), np.arctan2(b, h)
    feet = lambda q: jnp.stack([q[:2] + side * b * jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])
                                - h * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])]) for side in (-1, 1)])  # fmt: skip
    block = Scene(
        lambda q, v, t, p: 0.5 * (v[:2] @ v[:2] + half**2 / 3 * v[2] ** 2) - G * q[1],
        gaps=lambda q, t, p: feet(q)[:, 1], slip=lambda q, v, t, p: jax.jvp(feet, (q,), (v,))[1][:, 0],
        friction=lambda p: p[0],
    )  # fmt: skip
    corner = np.array([np.cos(tilt) * b - np.sin(tilt) * h, np.sin(tilt) * b + np.cos(tilt) * h])  # over its left foot
    q, v, p, T = np.array([*corner, tilt]), np.zeros(3), np.array([2.0]), 0.5  # between the first two blows
    right = Reference(block, q, p).run(q, v, T, p)
    (event,) = [e for e in right.events if e.impulse.any()]
    ratio = 1 - 1.5 * np.sin(alpha) ** 2
    np.testing.assert_allclose(event.after[5] / event.before[5], ratio, rtol=1e-9)
    run = lagjax.simulate(system_of(block), q, v, np.array([0.0, T]), p)
    lost = (1 - ratio**2) * G * half * (np.cos(alpha - tilt) - np.cos(alpha))
    np.testing.assert_allclose(run.impacts.energy_lost[0], lost, rtol=1e-10)
    np.testing.assert_allclose(np.concatenate([run.q[-1], run.qdot[-1]]), right.z, atol=1e-9)


@pytest.mark.slow
def test_contacts_in_a_text_about_the_system():
    assert "floor" in str(BOX.explain(state(x=0.0, y=1.0), state(x=0.0, y=0.0)))


@pytest.mark.slow
def test_intervals_of_restitution_and_friction_hold_them_as_often_as_they_say():
    """Four noisy tosses along a rough floor, 50 times: within three standard errors, of 3.1 %, of 95 %.

    The tosses, e and μ are drawn at random; the benchmark repeats one toss, too.
    """
    found = fit_tosses(50, True)
    assert found["not ok"] <= 3  # tosses that stop at once, and two that end at a kink
    for name in ("e", "mu"):
        assert abs(found[f"held {name}"] - 0.95) < 0.093 and abs(found[f"bias {name}"]) < 3


@pytest.mark.slow
def test_a_toss_that_stops_at_once_says_of_friction_only_that_it_is_larger():
    """A search from below ends at the least μ that stops it, or beyond, where nothing depends on it: both are told.

    Of the velocity that is left below it 2.8 standard errors may be chance.
    """
    truth, ts, rng = {"e": 0.5, "mu": 0.4}, np.linspace(0.0, 1.0, 51), np.random.default_rng(0)
    start = (state(x=0.0, y=0.8), state(x=1.7, y=0.0))
    run, fits = lagjax.simulate(TOSS, *start, ts, truth), []
    for _ in range(12):
        seen = {name: values + 1e-3 * rng.normal(size=51) for name, values in run.q.items()}
        fits.append(lagjax.fit(TOSS, lagjax.Record(ts, seen, start=start), {"e": 0.6, "mu": 0.2}))
    assert sum(fit.ok for fit in fits) <= 1
    assert sum("a larger params['mu']" in fit.message for fit in fits) >= 5


@pytest.mark.slow
def test_later_fits_of_a_scene_compile_nothing_and_see_what_changes():
    """A ball that bounces, whose time of flight is fitted by e; gravity is a number outside of the scene."""
    planet, traces = {"g": 9.81}, []

    def restitution(params):
        traces.append(1)
        return params["e"]

    system = lagjax.System(lambda q, v: 0.5 * v**2 - planet["g"] * q, contacts=lambda q: q, restitution=restitution)
    ts = np.linspace(0.0, 1.2, 41)
    start = np.array(1.0), np.array(0.0)

    def fitted(e, g):
        hit = np.sqrt(2 / g)
        after = e * g * hit * (ts - hit) - g * (ts - hit) ** 2 / 2
        heights = np.where(ts < hit, 1 - g * ts**2 / 2, after)
        cut = after > -1e-9
        record = lagjax.Record(ts[cut | (ts < hit)], heights[cut | (ts < hit)], start=start)
        return lagjax.fit(system, record, {"e": 0.6}).params["e"]

    assert np.isclose(fitted(0.7, 9.81), 0.7, rtol=1e-9, atol=0)
    many = len(traces)
    assert np.isclose(fitted(0.7, 9.81), 0.7, rtol=1e-9, atol=0)
    assert len(traces) == many
    planet["g"] = 8.0
    assert np.isclose(fitted(0.7, 8.0), 0.7, rtol=1e-9, atol=0)


@pytest.mark.slow
def test_poissons_law_throws_up_the_foot_that_rests():
    """A rod turns on foot A until B strikes: Newton's law keeps A down, whose velocity was zero; Poisson's gives back

    e of the impulse by which A was pressed, against which B holds (Glocker, *Set-Valued Force Laws*, §9.4).
    """
    mass, inertia, half, turning = 1.0, 0.1, 0.5, 2.0

    def feet(q):
        return {"A": q[0] - half * q[1], "B": q[0] + half * q[1]}

    def rates_behind(e, impacts):
        def lagrangian(q, v):
            return 0.5 * mass * v[0] ** 2 + 0.5 * inertia * v[1] ** 2

        rod = lagjax.System(
            lagrangian, contacts=feet, restitution=lambda params: {"A": params, "B": 0.0}, impacts=impacts
        )
        start = jnp.array([0.1, 0.2]), jnp.array([-half * turning, -turning])
        y, phi = lagjax.simulate(rod, *start, jnp.linspace(0.0, 0.2, 3), e).qdot[-1]
        return jnp.stack([y - half * phi, y + half * phi])

    own, shared = 1 / mass + half**2 / inertia, 1 / mass - half**2 / inertia
    alone = own - shared**2 / own
    pressed = -shared / own * 2 * half * turning / alone
    np.testing.assert_allclose(rates_behind(0.6, "poisson"), [0.6 * pressed * alone, 0.0], atol=1e-13)
    np.testing.assert_allclose(rates_behind(0.6, "simultaneous"), 0.0, atol=1e-13)
    slopes = jax.jacfwd(rates_behind)(0.6, "poisson")
    np.testing.assert_allclose(slopes, [pressed * alone, 0.0], atol=1e-13)


def gaps_in_a_row(q):
    return q[1:] - q[:-1]


def test_both_laws_agree_where_all_contacts_press_alike():
    """Balls in a row: with one e for all, Poisson's law is Newton's, and one that strikes goes back."""

    def rates_behind(impacts, e):
        balls = particles(contacts=gaps_in_a_row, restitution=lambda params: params, impacts=impacts)
        start = jnp.array([-0.5, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0])
        return lagjax.simulate(balls, *start, jnp.linspace(0.0, 1.0, 3), e).qdot[-1]

    e = np.array([1.0, 0.5])
    exact = np.stack([1 / 3 - 2 * e / 3, (1 + e) / 3, (1 + e) / 3], axis=1)
    ends = [jax.jit(jax.vmap(functools.partial(rates_behind, law)))(e) for law in ("poisson", "simultaneous")]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-14)
    np.testing.assert_allclose(ends[0], exact, atol=1e-14)


@pytest.mark.parametrize("impacts", ["simultaneous", "sequential"])
def test_health_says_where_laws_of_impacts_differ(impacts):
    balls = particles(contacts=gaps_in_a_row, restitution=1.0, impacts=impacts)
    start = jnp.array([-0.5, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0])
    health = lagjax.simulate(balls, *start, jnp.linspace(0.0, 1.0, 3)).health()
    assert int(health.impacts[2]) == 1 and float(health.impacts[3]) == 0.5
    assert "another law" in str(health)
    apart = start[0].at[2].set(3.0)
    assert "another law" not in str(lagjax.simulate(balls, apart, start[1], jnp.linspace(0.0, 1.0, 3)).health())


def slender_rod(impacts):
    """A rod above a rough incline, of which one end may touch it."""

    def end(q):
        return jnp.stack([q[0] + 0.5 * jnp.cos(q[2]), q[1] + 0.5 * jnp.sin(q[2])])

    return lagjax.System(
        lambda q, v: 0.5 * (v[:2] @ v[:2] + 0.02 * v[2] ** 2) + 1.95 * q[0] - 9.6 * q[1], contacts=lambda q: end(q)[1],
        restitution=0.9, friction=1.0, slip=lambda q, v: jax.jvp(end, (q,), (v,))[1][0], impacts=impacts,
    )  # fmt: skip


@pytest.mark.slow
def test_an_impact_that_gains_energy_is_suspicious():
    """Kane's rods: in energies of the velocities on both sides. With Routh's construction none gains any."""
    inertia, count = np.array([1.0, 1.0, 0.02]), 24
    rng = np.random.default_rng(5)
    q = np.stack([np.zeros(count), np.full(count, 1.0), rng.uniform(-3, 3, count)], axis=1)
    v = rng.normal(size=(count, 3)) * [1.0, 1.0, 6.0] - [0.0, 2.0, 0.0]
    for impacts in ("simultaneous", "poisson"):
        runs = lagjax.simulate_batch(slender_rod(impacts), q, v, np.array([0.0, 0.5]))
        before, after = (
            np.asarray(x) ** 2 @ inertia for x in (runs.contact_changes.qdot, runs.contact_changes.qdot_next)
        )
        gained = np.sum(after > before * (1 + 1e-12), axis=1)
        health = runs.health()
        np.testing.assert_array_equal(runs.contact_changes.doubts[:, 0], gained)
        np.testing.assert_array_equal(health.checks()["gained_energy"], gained > 0)
        np.testing.assert_array_equal(np.isfinite(health.doubts[1][:, 0]), gained > 0)
        assert (gained.sum() > 3) == (impacts == "simultaneous") and not (impacts == "poisson" and gained.any())
        assert any("impacts='poisson'" in text for text in health.findings()) == (impacts == "simultaneous")


def test_a_racket_that_hits_a_ball_gains_no_energy_by_its_law():
    run = lagjax.simulate(RACKET, 1.0, -1.0, np.array([0.0, 1.0]))
    assert float(run.impacts.energy_lost[0]) == pytest.approx(0.5 - 2.0) and not run.health().suspicious


@pytest.mark.slow
def test_health_counts_the_derivatives_that_are_lost():
    """Two feet of a rod that falls flat close at once; a tilt makes that two impacts, each with its derivatives."""
    tilts, ts = jnp.array([0.0, 0.1, 0.0]), jnp.array([0.0, 0.5])

    def run(tilt):
        return lagjax.simulate(ROD, jnp.stack([1.0 + 0.0 * tilt, tilt]), jnp.zeros(2), ts)

    runs, slopes = jax.jit(jax.vmap(lambda tilt: (run(tilt), jax.jacfwd(lambda tilt: run(tilt).q[-1])(tilt))))(tilts)
    lost = ~np.isfinite(slopes).all(axis=1)
    health = runs.health()
    np.testing.assert_array_equal(health.doubts[0][:, 1] > 0, lost)
    np.testing.assert_array_equal(lost, [True, False, True])
    np.testing.assert_allclose(health.doubts[1][0, 1], np.sqrt(2 / G), rtol=1e-14)
    (text,) = health.findings()
    assert "in 2 of 3 members, the first 0" in text and "part them do not exist" in text and "t = 0.451524" in text


@pytest.mark.slow
def test_impacts_in_turn_that_accumulate_are_shared_by_rounding_and_counted():
    """A wedge of two walls that move inwards: a point bounces between them faster and faster. Compiles one motion."""
    left, right = 1.23597994147044, 1.3381894906231333

    def gaps(q, t):
        return (
            jnp.sin(left) * q[0] + jnp.cos(left) * q[1] - 1.7235077705954625 * t**2,
            jnp.cos(right) * q[1] - jnp.sin(right) * q[0] - 2.302046437737974 * t**2,
        )

    def slips(q, v):
        return (
            jnp.cos(left) * v[0] - jnp.sin(left) * v[1],
            jnp.cos(right) * v[0] + jnp.sin(right) * v[1],
        )

    wedge = lagjax.System(lambda q, v: 0.5 * v @ v - q[1], contacts=gaps, slip=slips, friction=0.1, restitution=0.3)
    start = jnp.array([-0.08731105583085375, 0.5]), jnp.array([-1.0115259840204927, -0.017136269045231536])
    run = lagjax.simulate(wedge, *start, np.array([0.0, 1.5]))
    assert run.ok and run.contact_changes.doubts.tolist() == [0, 1, 0]
    assert "t = 0.272844" in str(run.health().findings())


# ---- Routh's construction --------------------------------------------------------------------------------------------


def strike(angle, friction, e, slip, mass=1.0, inertia=1 / 12, half=0.5):
    """The velocities of a rod behind a fall on its end, at an angle, with velocities 1 downwards and `slip` aside."""

    def tip(q):
        return jnp.array([q[0] + half * jnp.sin(q[2]), q[1] - half * jnp.cos(q[2])])

    rod = lagjax.System(
        lambda q, v: 0.5 * mass * v[:2] @ v[:2] + 0.5 * inertia * v[2] ** 2, contacts=lambda q: tip(q)[1],
        slip=lambda q, v: jax.jvp(tip, (q,), (v,))[1][0], friction=lambda params: params[1],
        restitution=lambda params: params[2], impacts="poisson",
    )  # fmt: skip
    start = jnp.array([0.0, half * jnp.cos(angle) + 0.5, angle]), jnp.array([slip, -1.0, 0.0])
    run = lagjax.simulate(rod, *start, jnp.array([0.0, 0.6]), jnp.array([angle, friction, e]))
    return run.qdot[-1]


def strike_exactly(angle, friction, e, slip, mass=1.0, inertia=1 / 12, half=0.5):
    """The same in small parts of the impulse, between which the slip of the moment decides (Darboux, Keller)."""
    rows = np.array([[0, 1, half * np.sin(angle)], [1, 0, half * np.cos(angle)]])
    response = rows / np.array([mass, mass, inertia])
    (n, m), (_, t) = response @ rows.T
    rates, impulses, end = np.array([-1.0, slip]), np.zeros(2), np.inf
    for _ in range(6):  # phases of the impact
        side = np.sign(rates[1]) if abs(rates[1]) > 1e-13 else np.sign(m) * (abs(m / t) > friction)
        ratio = -friction * side if side else -m / t
        by_impulse = np.array([n + m * ratio, m + t * ratio])
        parts = [end - impulses[0]]
        if rates[1] * by_impulse[1] < 0 and abs(rates[1]) > 1e-13:
            parts.append(-rates[1] / by_impulse[1])
        if end == np.inf and by_impulse[0] > 0:
            parts.append(-rates[0] / by_impulse[0])
        part = min(parts)
        rates, impulses = rates + part * by_impulse, impulses + part * np.array([1.0, ratio])
        if end == np.inf and abs(rates[0]) < 1e-13:
            end = (1 + e) * impulses[0]
        if impulses[0] >= end * (1 - 1e-14):
            return np.array([slip, -1.0, 0.0]) + impulses @ response
    raise AssertionError("the impact does not end")


@pytest.mark.parametrize(
    ("angle", "friction", "e", "slip"),
    [
        (0.6, 0.05, 0.5, 1.0),  # slides all along
        (0.6, 0.3, 0.5, -0.1),  # the slip turns in compression
        (0.6, 0.05, 0.5, -1.0),  # in expansion
        (-0.9, 0.4, 0.6, 0.7),
        (0.6, 0.3, 0.7, 0.0),  # begins in compression
        (0.8, 3.0, 0.5, -1.0),  # it stops, and sticks
        (0.8, 3.0, 0.5, 1.0),  # friction would jam: the slip stops first
    ],
)
def test_rouths_construction(angle, friction, e, slip):
    exact = strike_exactly(angle, friction, e, slip)
    np.testing.assert_allclose(strike(angle, friction, e, slip), exact, atol=1e-13)
    assert np.sum(np.array([1, 1, 1 / 12]) * exact**2) <= slip**2 + 1 + 1e-14
    slopes = jax.jacfwd(lambda mu, e: strike(angle, mu, e, slip), argnums=(0, 1))(friction, e)
    h = 1e-6
    for slope, d in zip(slopes, ((h, 0.0), (0.0, h)), strict=True):
        above, below = (strike_exactly(angle, friction + s * d[0], e + s * d[1], slip) for s in (1, -1))
        np.testing.assert_allclose(slope, (above - below) / (2 * h), atol=1e-8)


def test_poissons_law_with_friction_is_for_one_contact_in_a_plane():
    with pytest.raises(ValueError, match="one contact in a plane"):
        lagjax.simulate(FLOOR_AND_WALL, state(x=1.0, y=1.0), state(x=0.0, y=0.0), np.array([0.0, 0.1]))


@pytest.mark.parametrize("duration", [5.9, 30.0])
def test_a_gap_that_hides_a_corner_is_named(duration):
    """1 - sqrt(y**2) below y = 0 is 1 + y on its series: a wall at y = 1 is nowhere on it."""
    q, v = jnp.array([0.24765335, -1.0]), jnp.array([0.02608, 1.54014415])
    run = lagjax.simulate(HIDDEN, q, v, np.array([0.0, duration]), throw=False)
    assert run.result == lagjax.RESULTS.contact_missed


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"contacts": lambda q: {"floor": q * jnp.nan}}, r"contacts\['floor'\]"),
        ({"one_way": lambda q, v: {"ratchet": v + q * jnp.inf}}, r"one_way\['ratchet'\]"),
    ],
)
def test_a_gap_that_is_no_number_is_named(options, name):
    system = lagjax.System(lambda q, v: 0.5 * v**2, **options)
    with pytest.raises(lagjax.SimulationError, match=f"The gap {name} is (nan|inf)"):
        lagjax.simulate(system, 1.0, 0.0, np.array([0.0, 1.0]))


def struck(mass, restitution=0.5):
    """Where all of ones, which meets q₀ = 0 at t = 1 with velocities of −1, is at t = 2."""
    column = np.linalg.inv(mass)[:, 0]
    return -1.0 + (1 + restitution) * column / column[0]


@pytest.mark.parametrize("impacts", ["simultaneous", pytest.param("poisson", marks=pytest.mark.slow)])
def test_a_mass_matrix_among_the_parameters(impacts):
    scene = lagjax.System(
        lambda q, v, params: 0.5 * v @ params @ v, contacts=lambda q: q[0], restitution=0.5, impacts=impacts
    )
    masses, ts = np.stack([np.eye(4) + 0.1, np.diag([1.0, 2.0, 3.0, 4.0]) - 0.2, np.eye(4)]), np.array([0.0, 2.0])
    run = lagjax.simulate(scene, np.ones(4), -np.ones(4), ts, masses[1])
    np.testing.assert_allclose(run.q[-1], struck(masses[1]), atol=1e-12)
    if impacts == "poisson":
        return
    batch = lagjax.simulate_batch(scene, np.ones((3, 4)), -np.ones((3, 4)), ts, masses, batch_axes=(0, 0, 0))
    np.testing.assert_allclose(batch.q[:, -1], [struck(mass) for mass in masses], atol=1e-12)
    with pytest.raises(ValueError, match="mass matrix is not positive definite and needs pivoting"):
        lagjax.simulate(scene, np.ones(4), -np.ones(4), ts, np.diag([1.0, 2.0, 3.0, -4.0]))


@pytest.mark.parametrize("n", [8, pytest.param(12, marks=pytest.mark.slow)])
def test_a_column_that_falls_together_is_one_mass(n):
    """Springs of no length hold it up until it is let go; where masses lie together only high derivatives part them."""
    start = np.concatenate([np.zeros(1), -np.cumsum(9.81 / 200 * np.arange(n - 1, 0, -1.0))])
    end = 0.6  # all masses have met by then
    run = lagjax.simulate(COLUMN, start, np.zeros(n), np.array([0.0, end]))
    np.testing.assert_allclose(run.q[-1], np.full(n, start.mean() - 0.5 * 9.81 * end**2), atol=1e-9)


def test_light_bodies_that_strike_a_heavy_one_without_rebound_rest():
    """What is left of their velocities is rounding: contacts neither open nor close by it."""
    n = 3
    turns = 0.3 + 2 * np.pi * np.arange(n) / n
    sides, centre = np.stack([np.cos(turns), np.sin(turns)], axis=1), np.zeros((1, 2))
    masses = np.array([1.0] + [1e-3] * n)
    system = lagjax.System(
        lambda q, v: 0.5 * jnp.sum(masses[:, None] * v**2),
        contacts=lambda q: jnp.sqrt(jnp.sum((q[1:] - q[0]) ** 2, axis=1)) - 1.0,
    )
    start = np.concatenate([centre, 1.5 * sides]), np.concatenate([centre, -sides])
    run = lagjax.simulate(system, *start, np.array([0.0, 1.0]))
    np.testing.assert_allclose(run.q[-1], np.concatenate([centre, sides]), atol=1e-14)
    assert run.contact_changes.count <= n


def test_what_rests_at_zero_is_lifted():
    """A weight on a spring, at rest at q = 0, rises when a growing load exceeds it: in closed form, for 20 weights.

    Compiles one batch. What rounding leaves of q before it rises, 1e-50, is no size of the motion.
    """
    weights, ts = jnp.arange(1, 21) / 10, jnp.linspace(0.0, 12.0, 5)
    run = lagjax.simulate_batch(LIFTED, np.zeros(20), np.zeros(20), ts, weights, batch_axes=(0, 0, 0))
    aloft, omega = np.maximum(ts - (weights[:, None] + 0.07) / 3, 0.0), np.sqrt(0.7 / 0.3)
    assert run.ok.all()
    np.testing.assert_allclose(run.q, 3 / 0.7 * (aloft - np.sin(omega * aloft) / omega), atol=1e-8)


def exchange(starts, speeds, restitution, end, wall=np.inf):
    """Where equal beads in a row, of one length, are at the end: from collision to collision, of two each."""
    q, v, t = np.array(starts, float), np.array(speeds, float), 0.0
    while True:
        closing = v[:-1] - v[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            times = np.where(closing > 0, (q[1:] - q[:-1] - 0.5) / closing, np.inf)
        first = int(np.argmin(times))
        if t + times[first] > end:
            return q + v * (end - t), v
        t, q = t + times[first], q + v * times[first]
        mean, half = 0.5 * (v[first] + v[first + 1]), 0.5 * restitution * closing[first]
        v[first], v[first + 1] = mean - half, mean + half


@pytest.mark.parametrize("restitution", [1.0, 0.9])
def test_thirty_beads_in_a_row(restitution):
    """Equal ones that do not lose energy exchange velocities; more contacts than a whole number has bits."""
    n, rng = 30, np.random.default_rng(3)
    start, speeds = np.arange(n) + rng.uniform(-0.2, 0.2, n), rng.normal(size=n)
    run = lagjax.simulate(BEADS, start, speeds, np.array([0.0, 1.5]), restitution, max_transitions=1024)
    q, v = exchange(start, speeds, restitution, 1.5)
    np.testing.assert_allclose(run.q[-1], q, atol=1e-12)
    np.testing.assert_allclose(run.qdot[-1], v, atol=1e-12)
    if restitution == 1:
        np.testing.assert_allclose(np.sort(run.qdot[-1]), np.sort(speeds), atol=1e-12)


def test_beads_that_do_not_rebound_share_their_momentum():
    n = 40
    run = lagjax.simulate(DULL_BEADS, np.arange(n) * 1.0, np.eye(n)[0], np.array([0.0, 1000.0]))
    moving = 0.5 * np.arange(1, n)  # k beads take 0.5 k for the next gap
    np.testing.assert_allclose(run.impacts.t[: n - 1], np.cumsum(moving), rtol=1e-12)
    np.testing.assert_allclose(run.qdot[-1], np.full(n, 1 / n), atol=1e-14)


ROW_OF_BEADS = lagjax.System(
    lambda q, v: 0.5 * jnp.sum(v**2), contacts=lambda q: q[1:] - q[:-1] - 0.5, restitution=lambda params: params
)


def test_derivatives_of_thirty_contacts():
    """The last bead of a row that passes a blow on has a speed in closed form, ((1 + e)/2)ⁿ⁻¹."""
    n = 26

    def last(e):
        return lagjax.simulate(ROW_OF_BEADS, np.arange(n) * 1.0, np.eye(n)[0], np.array([0.0, 20.0]), e).qdot[-1, -1]

    e, blows = 0.95, n - 1
    value, slope = jax.jit(jax.value_and_grad(last))(e)
    np.testing.assert_allclose(value, ((1 + e) / 2) ** blows, rtol=1e-12)
    np.testing.assert_allclose(slope, blows / 2 * ((1 + e) / 2) ** (blows - 1), rtol=1e-10)


@pytest.mark.parametrize("up", [0.0, -1.0])
def test_outputs_at_the_start_vary_where_a_contact_closes_there(up):
    """At rest on a floor, or moving into it: the first output is behind what happens at the start."""

    def first(x, along, e):
        run = lagjax.simulate(THROWN_BALL, jnp.stack([x, 0.0]), jnp.stack([along, up]), np.array([0.0, 0.05, 0.1]), e)
        return jnp.concatenate([run.q[0], run.qdot[0]])

    expected = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -up]])
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(derivative(first, (0, 1, 2)))(0.3, 1.5, 0.6)
        np.testing.assert_allclose(np.stack(slopes, 1), expected, atol=1e-14)


@pytest.mark.parametrize("law", [pytest.param("linear", marks=pytest.mark.slow), "pieces"])
def test_forces_read_normal_forces_in_a_scene_whose_first_motion_is_traced(law):
    """It falls and slides on against a drag c N ẋ: x = t₁ + (1 − exp(−c g (2 − t₁))) / (c g)."""

    def drag(q, v, params, multipliers):
        n = multipliers["floor"]
        return jnp.array([-params * (n if law == "linear" else jnp.minimum(n, 20.0)) * v[0], 0.0])

    block = weight_on(forces=drag, contacts=lambda q: {"floor": q[1]})

    def last(c):
        return lagjax.simulate(block, np.array([0.0, 1.0]), np.array([1.0, 0.0]), np.array([0.0, 2.0]), c).q[-1, 0]

    def closed(c):
        fall = jnp.sqrt(2 / 9.81)
        return fall + (1 - jnp.exp(-c * 9.81 * (2 - fall))) / (c * 9.81)

    found, expected = (jax.jit(jax.value_and_grad(f))(0.3) for f in (last, closed))
    np.testing.assert_allclose(found, expected, rtol=1e-10)
