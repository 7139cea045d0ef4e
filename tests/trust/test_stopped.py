"""A motion that stops is named by what it ran into, and by both engines alike, member by member."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import BALL, HILL, VALLEY

import lagjax
from lagjax._engine import End, find_stop_flags

TS = np.linspace(0.0, 2.0, 5)
BUDGET = {"max_steps": 2000}
NAMES = {
    # what befalls it, and q0, spring, kink, the time at which the force ends
    "successful": (1.0, 1.0, 0.0, 9.0),
    "nonfinite_state": (1.0, 1.0, 0.0, 0.5),
    "acceleration_discontinuous": (0.0, 0.0, 1.0, 9.0),
    "max_steps_reached": (1.0, 1e10, 0.0, 9.0),
}
Q0, SPRING, KINK, ENDS = np.array(list(NAMES.values())).T
PARAMS = {"spring": SPRING, "kink": KINK, "ends": ENDS}


def lagrangian(q, qdot, params):
    return 0.5 * qdot**2 - 0.5 * params["spring"] * q**2


def switched(q, qdot, t, kink=1.0):
    """A force that jumps more often than a budget of steps allows."""
    return kink * jnp.sign(jnp.sin(1e9 * kink * t))


def force(q, qdot, t, params):
    return jnp.where(t > params["ends"], jnp.nan, 0.0) + switched(q, qdot, t, params["kink"])


SCENE = lagjax.System(lagrangian, forces=force)
BLOCK = lagjax.System(
    lambda q, v: 0.5 * v @ v - 9.0 * q[1], contacts=lambda q: {"floor": q[1]},
    forces=lambda q, v, multipliers: jnp.array([0.0, -multipliers["floor"] ** 2]),
)  # fmt: skip
FORCE_THAT_ENDS = lagjax.System(
    lambda q, v: 0.5 * v["x"] ** 2 + 0.5 * v["y"] ** 2,
    forces=lambda q, v, t: {"x": 0.0, "y": jnp.sqrt(0.5 - t)},
)


def names(result):
    return [next(n for n in NAMES if bool(r == getattr(lagjax.RESULTS, n)._value)) for r in np.asarray(result._value)]


@pytest.mark.parametrize(
    "solver",
    [pytest.param(None, id="machine code"), pytest.param(diffrax.Tsit5(), id="diffrax", marks=pytest.mark.slow)],
)
def test_members_are_named_by_what_stopped_them(solver):
    batch = lagjax.simulate_batch(SCENE, Q0, 0 * Q0, TS, PARAMS, batch_axes=(0, 0, 0), solver=solver, **BUDGET)
    found = names(batch.result)
    if solver is not None and found[2] == "max_steps_reached":  # its steps, too, are far longer than from jump to jump
        found[2] = "acceleration_discontinuous"
    assert found == list(NAMES)
    assert batch.end.t[1] == pytest.approx(0.5, abs=1e-14) and batch.end.t[2] < 1e-5


def test_members_are_named_under_transformations():
    def end(q0, params):
        return lagjax.simulate(SCENE, q0, 0.0, TS, params, throw=False, **BUDGET).result

    assert names(jax.jit(jax.vmap(end))(Q0, PARAMS)) == list(NAMES)


def test_the_message_names_the_time_and_the_force_that_ends():
    q0 = {"x": 1.0, "y": 0.0}
    with pytest.raises(lagjax.SimulationError, match=r"beyond t = 0.5 of(.|\n)*ahead: the force on q\['y'\] \(nan\), "):
        lagjax.simulate(FORCE_THAT_ENDS, q0, q0, TS)


def kinetic(q, qdot):
    return 0.5 * jnp.sum(qdot**2)


def fades(q, qdot, t):
    return jnp.where(t > 0.5, jnp.nan, -1.0) * q


STOPS = {
    # L, forces, q0, qdot0, more arguments, and what the message says
    "a force that ends": (
        kinetic, fades, 1.0, 0.0, {},
        r"force on q \(nan\), from t = 0.5 on, whatever the state. It comes from where\(True, nan, -1\) at test_st",
    ),
    "a root": (
        kinetic, lambda q, v: -jnp.sqrt(1 - q), 0.0, 2.0, {}, r"on q \(nan\). It comes from sqrt\(-.*e-1\d\) at test",
    ),
    "a logarithm": (
        lambda q, v: 0.5 * v**2 - 5 * q * jnp.log(q - 0.2), None, 1.0, -1.0, {},
        r"derivative of L by q \(nan\). It comes from log\(-.*test_stopped",
    ),
    "a collision": (
        lambda q, v: 0.5 * v**2 + 1 / q, None, 1.0, 0.0, {}, r"near a pole of div\(1, .*e-\d+\) at test_stopped",
    ),
    "a logarithm of what is negative": (
        lambda q, v: 0.5 * v**2 - jnp.log(q), None, -1.0, 0.5, {}, r"of q grows .* pole of log\(-.*test_stopped",
    ),
    "an explosion": (kinetic, lambda q, v: 6 * q**2, 1.0, 2.0, {}, "q runs to infinity within a finite time"),
    "a stiff spring": (
        lambda q, v: 0.5 * v @ v - 5e7 * q[0] ** 2 - 0.5 * q[1] ** 2, None, np.array([0.1, 1.0]), np.zeros(2),
        {"max_steps": 100}, r"1.0e-04 to 1.0e\+00(.|\n)*100 steps led over 0.00\d+ of 2",
    ),
    "a pole of coordinates": (
        lambda q, v: 0.5 * (v["r"] ** 2 + q["r"] ** 2 * v["phi"] ** 2), None, {"r": 1.0, "phi": 0.0},
        {"r": -1.0, "phi": 1e-7}, {"max_steps": 100}, r"nearly singular there: along dq\['phi'\] it has come down from",
    ),
    "a mass that vanishes": (lambda q, v: 0.5 * q * v**2, None, 1.0, -1.0, {}, "nearly singular there: along dq it"),
}  # fmt: skip


@pytest.mark.parametrize("name", STOPS)
def test_the_message_tells_what_it_ran_into(name):
    lagrangian, forces, q0, qdot0, more, expected = STOPS[name]
    with pytest.raises(lagjax.SimulationError, match=expected):
        lagjax.simulate(lagjax.System(lagrangian, forces=forces), q0, qdot0, TS, **more)


POLES = (
    lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q**3),
    lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q**3),
)
KINKS = (
    lagjax.System(lambda q, v: 0.5 * v**2 - jnp.abs(q - 3.0)),
    lagjax.System(lambda q, v: 0.5 * v**2 - jnp.abs(q - 3.0)),
)


def test_scenes_of_one_text_are_told_their_own_lines():
    """They are derived once; the line is that of the functions of each."""
    lines = []
    for scene, kink in zip(POLES, KINKS, strict=True):
        with pytest.raises(lagjax.SimulationError) as stopped:
            lagjax.simulate(scene, 1.0, 0.0, TS)
        with pytest.raises(ValueError, match="is on a border") as rough:
            lagjax.linearize(kink, 3.0)
        said = str(stopped.value), str(rough.value), *map(str, lagjax.check(kink, 3.0, 0.0))
        lines.append([re.findall(r"test_stopped.py:(\d+)", text) for text in said])
        assert all(lines[-1])
    first, second = np.array(lines[0], int), np.array(lines[1], int)
    np.testing.assert_array_equal(second - first, 1)


def test_the_health_of_a_batch_tells_it_of_the_first_that_failed():
    batch = lagjax.simulate_batch(SCENE, Q0, 0 * Q0, TS, PARAMS, batch_axes=(0, 0, 0), **BUDGET)
    assert "from t = 0.5 on, whatever the state. It comes from where(True, nan, 0)" in batch.health().diagnosis
    broken = PARAMS | {"spring": np.array([1.0, np.nan, 1.0, 1.0])}
    batch = lagjax.simulate_batch(SCENE, Q0, 0 * Q0, TS, broken, batch_axes=(0, 0, 0), **BUDGET)
    assert "Of the first of them: params['spring'] is nan" in " ".join(str(batch.health()).split())


@pytest.mark.slow
def test_a_solver_that_goes_across_a_kink_names_its_line():
    scene = VALLEY
    with pytest.raises(lagjax.SimulationError, match="abs at scenes"):
        lagjax.simulate(scene, 1.0, 0.0, TS, solver=diffrax.Tsit5(), max_steps=60)


def long_function(q, qdot):
    x = q
    for k in range(5000):
        x = jnp.sin(x + 1e-3 * k)
    return 0.5 * qdot @ qdot + 1e-3 * jnp.sum(x)


LONG_FUNCTION = lagjax.System(kinetic, forces=lambda q, v, t: fades(q, v, t) + 0 * long_function(q, v))


@pytest.mark.slow
def test_a_large_scene_that_fails_is_looked_at_in_no_more_time_than_it_ran():
    """The operations that are gone through are bounded: a look at this one, line by line, would take minutes."""
    scene = LONG_FUNCTION
    with pytest.raises(lagjax.SimulationError, match=r"the force on q(.|\n)*from t = 0.5 on, whatever the state.$"):
        lagjax.simulate(scene, np.ones(2), np.zeros(2), TS)


OFTEN_SWITCHED = lagjax.System(lambda q, v: 0.5 * v**2, forces=lambda q, v, t: switched(q, v, t))


def test_jumps_that_spend_the_budget_are_called_jumps_and_not_stiff():
    kink = OFTEN_SWITCHED
    with pytest.raises(lagjax.SimulationError, match="has a jump or a corner there") as error:
        lagjax.simulate(kink, 0.0, 0.0, TS, **BUDGET)
    assert "stiff" not in str(error.value)


# ---- the search alone: accelerations of one coordinate, stopped at t = 1 after 100 steps, half of them rejected ------

STOPPED = {
    # name: q̈(t, q, v) at (q, v) = (0, 1), whether it ends just ahead, whether it jumps
    "a constant": (lambda t, q, v: 0 * q + 3.0, False, False),
    "a stiff spring": (lambda t, q, v: -1e16 * q, False, False),
    "a root": (lambda t, q, v: np.sqrt(np.abs(q)), False, False),
    "a cube root": (lambda t, q, v: np.cbrt(q), False, False),
    "friction that is rounded off": (lambda t, q, v: -np.tanh(q / 1e-9), False, False),
    "a step": (lambda t, q, v: np.where(q > 0, 1.0, 2.0), False, True),
    "a small step on a slope": (lambda t, q, v: 100 + q + np.where(q > 0, 1.0, 0.0), False, True),
    "a step of time": (lambda t, q, v: np.where(t > 1 + 1e-5, 1.0, 0.0), False, True),
    "a step elsewhere": (lambda t, q, v: np.where(q > 0.1, 1.0, 0.0), False, False),
    "a root that ends": (lambda t, q, v: np.sqrt(-q), True, False),
    "a pole that changes its sign": (lambda t, q, v: 1 / (q - 1e-15), False, False),
    "a pole that does not": (lambda t, q, v: 1 / (q - 1e-15) ** 2, False, False),
    "an infinity": (lambda t, q, v: 1 / np.maximum(-q, 0.0), True, False),
    "an end elsewhere": (lambda t, q, v: np.where(q > 0.1, np.nan, 1.0), False, False),
}


@pytest.mark.parametrize("name", STOPPED)
def test_what_stopped(name):
    function, ends, jumps = STOPPED[name]
    one, count = np.ones(2), np.full(2, 50)

    def acceleration(t, y):
        return function(t, y[..., 0], y[..., 1])[..., None]

    at = End(one, np.array([[0.0, 1.0]] * 2), 0 * one, 2 * one, count, count)
    shrank = np.array([True, False])
    not_finite, jumped = find_stop_flags(acceleration, at, shrank, ~shrank)
    assert not_finite.tolist() == [ends, False], "a spent budget does not ask what lies ahead"
    near = not (name == "a step of time")  # beyond the smallest steps
    assert jumped.tolist() == [jumps and near, jumps]


def test_every_result_has_its_text():
    for name in lagjax.RESULTS._name_to_item:
        assert name == "successful" or len(lagjax._interface._results.advice(getattr(lagjax.RESULTS, name))) > 20, name


def fourier(q, v, t):  # no scalar program, and it takes arrays of JAX only
    return jnp.abs(jnp.fft.fft(q.at[0].add(0.0))) * jnp.sqrt(1 - t)


FOURIER = lagjax.System(lambda q, v: 0.5 * v @ v, forces=fourier)


@pytest.mark.slow
def test_a_scene_without_programs_that_fails_keeps_its_error():
    scene = FOURIER
    with pytest.raises(lagjax.SimulationError, match="could not be followed beyond t = 1"):
        lagjax.simulate(scene, np.ones(2), np.zeros(2), np.linspace(0.0, 5.0, 6))


def test_a_power_has_no_pole():
    scene = HILL
    with pytest.raises(lagjax.SimulationError, match="runs to infinity within a finite time"):
        lagjax.simulate(scene, 1.0, 1.0, np.linspace(0.0, 5.0, 6))


@pytest.mark.slow
def test_steps_of_a_fixed_length_do_not_blame_the_start():
    scene = HILL
    with pytest.raises(lagjax.SimulationError, match="a step of a fixed length") as caught:
        lagjax.simulate(scene, 1.0, 1.0, np.linspace(0.0, 5.0, 6), dt=0.01)
    assert "q0 is" not in str(caught.value)


@pytest.mark.slow
def test_a_reset_that_is_not_finite_is_named():
    ball = BALL
    bounce = lagjax.Transition("fly", "fly", lambda q, v: q, direction=-1, reset=lambda q, v: (q, jnp.sqrt(v)))
    said = r"reset of the transition at t = 0.45\d* returned the velocity of q \(nan\): every number must be f"
    with pytest.raises(lagjax.SimulationError, match=said):
        lagjax.simulate(lagjax.Hybrid({"fly": ball}, [bounce], "fly"), 1.0, 0.0, TS)


def switched_push(q, v, t):
    return jnp.array([switched(q, v, t), 0.0])


SWITCHED_BLOCK = lagjax.System(
    lambda q, v: 0.5 * v @ v - 9.81 * q[1],
    forces=switched_push,
    contacts=lambda q: {"floor": q[1] - 0.1, "wall": q[0] + 3.0},
)


def test_a_motion_that_stops_in_contact_names_what_touches():
    block = SWITCHED_BLOCK  # fmt: skip
    with pytest.raises(lagjax.SimulationError, match=r"In touch there: contacts\['floor'\], whose gaps"):
        lagjax.simulate(block, jnp.array([0.0, 0.1]), jnp.array([1.0, 0.0]), TS, **BUDGET)


def test_a_law_without_a_normal_force_is_named_and_not_the_start():
    """λ = 9 + λ²: none."""
    with pytest.raises(lagjax.SimulationError, match="No multipliers satisfy the law of forces") as caught:
        lagjax.simulate(BLOCK, jnp.zeros(2), jnp.zeros(2), TS)
    assert "q0" not in str(caught.value)
