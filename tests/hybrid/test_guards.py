"""Guards that are beyond zero where a mode begins, or zero to rounding: what happens at once, waits, and is said."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALL_IN_GRAVITY, BALL_ON_THE_FLOOR, FREE, RELAY, particle
from scipy.integrate import solve_ivp

import lagjax

G = 9.81
T = lagjax.Transition
FALL = lambda q, v: 0.5 * v @ v - G * q[1]
SPHERE = {"on": lagjax.System(FALL, constraints=lambda q: q @ q - 1), "off": lagjax.System(FALL)}
ROD = lagjax.System(lambda q, v: 0.5 * v[0] ** 2 + v[1] ** 2 / 6 - G * q[0])
BEADS = lagjax.System(lambda q, v, params: 0.5 * params @ v**2)
ZENO, IN_TURN = lagjax.RESULTS.zeno, lagjax.RESULTS.transitions_in_turn


def on_sphere(speed, **options):
    """From 0.6 rad along the sphere, which the multiplier lets go."""
    s, c = np.sin(0.6), np.cos(0.6)
    leave = T("on", "off", lambda q, v, multipliers: multipliers, -1, **options)
    v = speed * jnp.array([c, -s])
    return lagjax.simulate(lagjax.Hybrid(SPHERE, [leave], "on"), jnp.array([s, c]), v, jnp.array([0.0, 0.2]))


def test_a_mode_whose_guard_is_beyond_zero_ends_at_once():
    runs = jax.jit(jax.vmap(on_sphere))(np.array([3.0, 1.0]))  # it is too fast from √(g cos 0.6) = 2.85 on
    s, c = np.sin(0.6), np.cos(0.6)
    flight = [s + 3 * c * 0.2, c - 3 * s * 0.2 - 0.5 * G * 0.04]
    np.testing.assert_allclose(runs.q[0, -1], flight, rtol=1e-14)
    assert runs.transitions.count.tolist() == [1, 0] and runs.transitions.t[0, 0] == 0.0
    held = on_sphere(3.0, fires="crossing")
    assert held.transitions.count == 0 and abs(np.linalg.norm(held.q[-1]) - 1) < 1e-12


BOUNCE = T("f", "f", lambda q, v: q, -1, lambda q, v: (q, -0.9 * v))


@pytest.mark.slow
def test_a_blow_beyond_its_wall_happens_where_the_motion_goes_on():
    # A millionth below the floor: downwards it bounces; upwards it is let out, which is said. At rest the floor pushes.
    def run(v, transitions, q=-1e-6):
        ts, params = jnp.array([0.0, 0.05]), {"g": G}
        return lagjax.simulate(lagjax.Hybrid({"f": BALL_IN_GRAVITY}, transitions, "f"), q, v, ts, params, throw=False)

    runs = jax.jit(jax.vmap(lambda v: run(v, [BOUNCE])))(np.array([-0.5, 0.5, 0.0]))
    rise = np.array([0.45, 0.5]) * 0.05 - 0.5 * G * 0.05**2 - 1e-6
    np.testing.assert_allclose(runs.q[:2, -1], rise, rtol=1e-12)
    assert runs.transitions.count[:2].tolist() == [1, 0] and runs.result._value[2] == ZENO._value
    np.testing.assert_array_equal(runs.transitions.let_out[:2, 0], [0.0, 0.0])
    health = run(0.5, [BOUNCE]).health()
    assert health.suspicious and "came back instead of a blow" in str(health)
    # What a reset does not turn round is no blow: a section, and kicks by place and by the clock, wait for a crossing.
    waiting = [
        T("f", "f", lambda q, v: q, -1),
        T("f", "f", lambda q, v: q, -1, lambda q, v: (q, v - 0.1)),
        T("f", "f", lambda q, v, t: 0.5 * (t - 0.1), -1, lambda q, v: (q, -v)),
    ]
    for v in (-0.5, 0.5):
        assert not np.isfinite(run(v, waiting, -0.5).transitions.let_out).any()
        assert run(v, waiting, -0.5).transitions.count == 0
    assert run(0.5, [T("f", "f", lambda q, v: q, -1, lambda q, v: (q, v - 0.1), fires="beyond")]).result == ZENO


@pytest.mark.slow
def test_a_reset_that_carries_beyond_another_guard():
    """From x to 1, back by d, and beyond −1 at once: a fall from there on, with derivatives by all of it."""
    modes = {"f": FREE, "g": BALL_IN_GRAVITY}
    jump = T("f", "f", lambda q, v: 1 - q, -1, lambda q, v, params: (q - params["d"], v))
    law = [jump, T("f", "g", lambda q, v: q + 1, -1)]

    def end(x):
        run = lagjax.simulate(lagjax.Hybrid(modes, law, "f"), x[0], x[1], jnp.array([0.0, 1.5]), {"d": x[2], "g": x[3]})
        return jnp.stack([run.q[-1], run.qdot[-1], run.transitions.t[1]])

    def closed(x):
        q, v, d, g = x
        met = (1 - q) / v
        left = 1.5 - met
        return jnp.stack([1 - d + v * left - 0.5 * g * left**2, v - g * left, met])

    x = np.array([0.1, 1.2, 3.0, 2.0])
    np.testing.assert_allclose(jax.jit(end)(x), closed(x), rtol=1e-14)
    first, second = jax.jit(lambda x: (jax.jacrev(end)(x), jax.jacfwd(jax.jacrev(end))(x)))(x)
    np.testing.assert_allclose(first, jax.jit(jax.jacfwd(closed))(x), atol=1e-12)
    np.testing.assert_allclose(second, jax.jit(jax.hessian(closed))(x), atol=1e-10)


def test_a_block_that_stops_where_its_load_is_beyond_the_static_limit_goes_on():
    load = lambda t, xp=jnp: 12 * xp.sin(6 * t) * t / (1 + t) - G * np.sin(0.1)
    static, kinetic = 0.6 * G * np.cos(0.1), 0.3 * G * np.cos(0.1)
    stop = lambda q, v: (q, 0 * v)
    slip = lambda s: particle(lambda q, v, t: load(t) - s * kinetic)
    stick = particle(lambda q, v, t: load(t), velocity_constraints=lambda q, v: v)
    law = [
        T("stick", "up", lambda q, v, t: load(t) - static, 1),
        T("stick", "down", lambda q, v, t: load(t) + static, -1),
        T("up", "stick", lambda q, v: v, -1, stop),
        T("down", "stick", lambda q, v: v, 1, stop),
    ]
    modes = {"stick": stick, "up": slip(1), "down": slip(-1)}
    run = lagjax.simulate(lagjax.Hybrid(modes, law, "stick"), 0.0, 0.0, np.array([0.0, 6.0]))

    t, q, side, tries = 0.0, 0.0, 0, 0
    while t < 6.0 and (tries := tries + 1) < 50:
        over = load(t, np)
        if side == 0:  # sticks until the load exceeds the limit, at once or at a zero of the difference
            grid = np.linspace(t, 6.0, 60_001)
            beyond = np.flatnonzero(np.abs(load(grid, np)) > static)
            if not beyond.size:
                break
            low, high = (grid[max(beyond[0] - 1, 0)], grid[beyond[0]]) if abs(over) <= static else (t, t)
            for _ in range(60):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if abs(load(middle, np)) > static else (middle, high)
            t, side = high, int(np.sign(load(high, np)))
        stopped = lambda t, y, s=side, begun=t: s * y[1] + (1e-12 if t <= begun + 1e-9 else 0.0)
        stopped.terminal, stopped.direction = True, -1
        force = lambda t, y, s=side: [y[1], load(t, np) - s * kinetic]
        done = solve_ivp(force, (t, 6.0), [q, 0.0], "DOP853", rtol=1e-12, atol=1e-14, events=stopped, max_step=0.02)
        t, q, side = done.t[-1], done.y[0, -1], 0
    np.testing.assert_allclose(run.q[-1], q, atol=1e-9)
    assert abs(q + 2.672) < 1e-3


def test_transitions_that_go_back_and_forth_are_both_named():
    push = lambda s: particle(lambda q, v: s + 0.0 * q)
    law = [T("left", "right", lambda q, v: q + v, -1), T("right", "left", lambda q, v: q + v, 1)]
    with pytest.raises(lagjax.SimulationError, match=r"(?s)one instant.*sign or where.*'left' → 'right'") as caught:
        lagjax.simulate(
            lagjax.Hybrid({"left": push(-1.0), "right": push(1.0)}, law, "left"), 1.0, 0.2, np.array([0.0, 5.0])
        )
    assert "'right' → 'left'" in str(caught.value) and caught.value.trajectory.result == IN_TURN
    slides = RELAY  # as the sentence advises
    assert abs(lagjax.simulate(slides, 1.0, 0.2, np.array([0.0, 5.0])).q[-1]) < 0.1


def test_a_bouncing_ball_comes_to_rest_as_the_sentence_advises():
    rest = BALL_ON_THE_FLOOR
    bounce = T("f", "f", lambda q, v: q, -1, lambda q, v: (q, -0.5 * v))
    small = lambda q, v, params: 0.5 * v**2 + params["g"] * q - 1e-6
    law, ts = [bounce, T("f", "rest", small, -1, lambda q, v: (0 * q, 0 * v))], np.array([0.0, 3.0])
    run = lagjax.simulate(lagjax.Hybrid({"f": BALL_IN_GRAVITY, "rest": rest}, law, "f"), 1.0, 0.0, ts, {"g": G})
    assert run.mode.tolist() == [0, 1] and run.q[-1] == 0.0
    with pytest.raises(lagjax.SimulationError, match=r"(?s)add up to a finite one.*'f' → 'f'"):
        lagjax.simulate(
            lagjax.Hybrid({"f": BALL_IN_GRAVITY}, [bounce], "f"), 1.0, 0.0, ts, {"g": G}, max_transitions=64
        )


def test_blows_at_one_instant_that_do_not_commute_are_said():
    def end(side):
        def reset(q, v):
            n, inverse = jnp.stack([1.0, side * jnp.cos(q[1])]), jnp.array([1.0, 3.0])
            return q, v - 1.5 * (n @ v) / (n @ (inverse * n)) * inverse * n

        return T("f", "f", lambda q, v: q[0] + side * jnp.sin(q[1]), -1, reset)

    def run(angle):
        q, ts = jnp.stack([1.0, angle]), jnp.array([0.0, 0.5])
        return lagjax.simulate(lagjax.Hybrid({"f": ROD}, [end(1), end(-1)], "f"), q, jnp.zeros(2), ts)

    flat = run(0.0)
    assert flat.transitions.order_matters.tolist()[:3] == [True, False, False] and flat.health().suspicious
    assert "another order of the list" in str(flat.health())
    assert not run(0.01).transitions.order_matters.any()
    # Equal beads exchange their velocities in whatever order; of unequal ones that meet at once, one is in the way.
    masses = jnp.array([1.0, 1.0, 1.0]), jnp.array([1.0, 3.0, 1.0])

    def collide(i):
        def reset(q, v, params):
            m = params[i : i + 2]
            return q, v.at[i : i + 2].set(2 * (m @ v[i : i + 2]) / m.sum() - v[i : i + 2])

        return T("f", "f", lambda q, v: q[i + 1] - q[i], -1, reset)

    meet = lambda m: lagjax.simulate(
        lagjax.Hybrid({"f": BEADS}, [collide(0), collide(1)], "f"), jnp.array([-1.0, 0.0, 1.0]),
        jnp.array([1.0, 0.0, -1.0]), jnp.array([0.0, 1.5]), m,
    )  # fmt: skip
    assert [bool(meet(m).transitions.order_matters.any()) for m in masses] == [False, True]


# ---- releases at zero relative acceleration -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_freewheel_and_a_block_let_go_where_nothing_moves_yet():
    def two(q, v):
        return 0.5 * v[0] ** 2 + v[1] ** 2

    drive = lambda q, v, t, params: jnp.stack([params[0] * jnp.cos(params[1] * t), 0.0 * t])
    lock = lagjax.System(two, forces=drive, velocity_constraints=lambda q, v: v[0] - v[1])
    modes = {"lock": lock, "free": lagjax.System(two, forces=drive)}
    law = [T("lock", "free", lambda q, v, multipliers: multipliers, 1), T("free", "lock", lambda q, v: v[0] - v[1], 1)]
    rng = np.random.default_rng(0)
    params = np.stack([rng.uniform(0.1, 3, 20), rng.uniform(0.5, 1.5, 20)], 1)
    run = lambda p: lagjax.simulate(
        lagjax.Hybrid(modes, law, "lock"), jnp.zeros(2), jnp.zeros(2), jnp.stack([0.0, np.pi / p[1]]), p, throw=False
    )
    runs = jax.jit(jax.vmap(run))(params)
    a, w = params.T
    assert runs.ok.all() and (runs.transitions.count == 1).all()
    np.testing.assert_allclose(runs.transitions.t[:, 0], np.pi / 2 / w, rtol=1e-12)
    # It drives both up to a/(3w), then the second goes on, and the first is slowed by itself.
    np.testing.assert_allclose(runs.end.qdot, np.stack([a / w / 3 - a / w, a / w / 3], 1), rtol=1e-10, atol=1e-12)

    stop, load = lambda q, v: (q, 0 * v), lambda t, p: p[0] * jnp.sin(p[1] * t)
    slip = lambda s: particle(lambda q, v, t, params: load(t, params) - s * params[2])
    stick = lambda q, v, t, params: load(t, params)
    modes = {"stick": particle(stick, velocity_constraints=lambda q, v: v)}
    modes |= {"up": slip(1), "down": slip(-1)}
    law = [
        T("stick", "up", lambda q, v, multipliers, params: -multipliers - params[2], 1),
        T("stick", "down", lambda q, v, multipliers, params: -multipliers + params[2], -1),
        T("up", "stick", lambda q, v: v, -1, stop), T("down", "stick", lambda q, v: v, 1, stop),
    ]  # fmt: skip
    friction = lambda q, v, t, params: load(t, params) - params[2] * jnp.sign(v)
    one, ts = particle(friction), np.linspace(0.0, 6.0, 4)
    params = np.stack([rng.uniform(1, 3, 20), rng.uniform(0.5, 3, 20), rng.uniform(0.2, 0.9, 20)], 1)
    run = lambda p: lagjax.simulate(lagjax.Hybrid(modes, law, "stick"), 0.0, 0.0, ts, p, throw=False)
    runs = jax.jit(jax.vmap(run))(params)
    right = jax.jit(jax.vmap(lambda p: lagjax.simulate(one, 0.0, 0.0, ts, p, rtol=1e-12).q))(params)
    assert runs.ok.all()
    np.testing.assert_allclose(runs.q, right, atol=1e-9)


# ---- many random scenes ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 1, 8])
def test_scenes_of_one_family_against_closed_forms(monkeypatch, first):
    """Of the benchmark: shaken tables, 27 and 23 of 40 of which begin beyond; blocks; control loops."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    population = importlib.import_module("benchmarks.guard_population")
    family = population.FAMILIES[first]
    monkeypatch.setattr(population, "FAMILIES", (family,))
    assert population.main(["--scenes", "8"]) == {"right": 8}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [({"fires": "always"}, 'fires must be "beyond"'), ({"fires": "beyond"}, "needs a direction")],
)
def test_what_cannot_be_said_of_a_transition(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        T("f", "f", lambda q, v: q, **options)
