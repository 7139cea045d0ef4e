"""What a newcomer's mistakes in a scene's functions say: the error of Python or JAX, and beneath it what to write."""

import math
import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OSCILLATOR, OSCILLATORS, RAMP, in_potential, particle

import lagjax


def pendulum(q, qdot, params):
    return 0.5 * qdot["theta"] ** 2 + params["g"] * jnp.cos(q["theta"])


PENDULUM_WITH_KEYS = lagjax.System(pendulum)


def test_a_key_that_is_not_there_is_told_with_those_that_are():
    with pytest.raises(KeyError) as error:
        lagjax.simulate(PENDULUM_WITH_KEYS, {"theta": 1.0}, {"theta": 0.0}, np.arange(3.0), {"G": 9.81})
    note = error.value.__notes__[0]
    assert note == (
        "This is pendulum, a function of a scene: it reads a key that is not there: q has 'theta'; params has 'G'."
    )


def pendulum_of_a_pair(q, qdot, params):
    return 0.5 * qdot**2 + params["g"] * jnp.cos(q)


PENDULUM_OF_A_PAIR = lagjax.System(pendulum_of_a_pair)


@pytest.mark.parametrize("params", [9.81, [9.81]])
def test_params_of_another_structure_are_told_with_what_reads_them(params):
    with pytest.raises(TypeError) as error:
        lagjax.simulate(PENDULUM_OF_A_PAIR, 1.0, 0.0, np.arange(3.0), params)
    assert 'it reads `params["g"]`, and the params that it is given are PyTreeDef(' in error.value.__notes__[0]


MASS_AS_PARAMS = lagjax.System(lambda q, v, params: 0.5 * params["m"] * v @ v - q @ q)


def test_a_sweep_over_a_parameter_without_its_batch_axis_is_told_of_batch_axes():
    scene = MASS_AS_PARAMS
    with pytest.raises(TypeError) as error:
        lagjax.simulate_batch(scene, np.ones((3, 2)), np.zeros((3, 2)), np.arange(3.0), {"m": np.ones(3)})
    assert "By batch_axes this is a batch of 3 members" in error.value.__notes__[-1]


@pytest.mark.parametrize("height", [lambda q: math.cos(q), lambda q: np.cos(q), lambda q: q if q > 0 else 0.0])
def test_functions_that_ask_for_values_are_told_what_to_write(height):
    with pytest.raises(TypeError) as error:
        lagjax.simulate(in_potential(height), 1.0, 0.0, np.arange(3.0))
    text, line = str(error.value), height.__code__.co_firstlineno
    assert f"<lambda>, line {line} of test_mistakes.py, `" in text and "traced array" not in text
    assert "Write jnp.cos(q) for math.cos(q)" in text and "jnp.where(q > 0, a, b) for `if q > 0`" in text
    assert not [note for note in getattr(error.value, "__notes__", []) if "lagrangian" in note]


SPRING = lagjax.System(lambda q, v, params: 0.5 * params["m"] * v**2 - 0.5 * q**2)
NETWORK = lagjax.System(lambda q, v, params: 0.5 * v**2 - params(q[None]))
MASS, TS = {"m": 1.0}, np.linspace(0.0, 1.0, 3)
BALL = lagjax.Hybrid(
    {"f": RAMP},
    [lagjax.Transition("f", "f", lambda q, v: q, -1, lambda q, v: (q, -0.5 * v))],
    "f",
)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: SPRING.explain(1.0, 0.0, MASS), "t must be a real number; .* Parameters come behind it"),
        (lambda: lagjax.check(SPRING, 1.0, 0.0, MASS), "t must be a real number; .* Parameters come behind it"),
        (
            lambda: lagjax.lyapunov_exponent(SPRING, 1.0, 0.0, MASS, 9.0),
            "duration must be a real .* Parameters",
        ),
        (lambda: lagjax.periodic_orbit(SPRING, 1.0, 0.0, MASS), "period must be a real number; .* Parameters"),
        (lambda: lagjax.simulate(SPRING, 1.0, 0.0, MASS, TS), "ts must be an array .* got dict. Parameters"),
        (lambda: _sweep(MASS), "ts must be an array of output times; got dict"),
        (
            lambda: _sweep(lambda point: TS, {"section": lambda q, v: q}, lambda run, crossings: {"q": run.q[-1]}),
            "crossings of sweep: for members that share their times. Give ts as an array",
        ),
        (
            lambda: _sweep(TS, {"section": lambda q, v: q}),
            r"ask for them by name: write keep\(trajectory",
        ),
        (
            lambda: lagjax.simulate_batch(OSCILLATORS, jnp.ones((3, 2)), jnp.ones((3, 2)), jnp.ones((3, 5))),
            r"not between ts\[0, 0\]",
        ),
        (
            lambda: lagjax.normal_modes(OSCILLATORS, jnp.zeros(2), jnp.ones(2)),
            "asks for params, .* name velocities, qdot=",
        ),
        (lambda: lagjax.find_path(BALL, 1.0, 0.0, 0.0, 1.0), "^This is for one System: a lagjax.Hybrid is"),
        (lambda: lagjax.lyapunov_exponent(BALL, 1.0, 0.0, 1.0), "^This is for one System: a lagjax.Hybrid is taken by"),
        (lambda: lagjax.work_precision(BALL, 1.0, 0.0, TS), "^This is for one System: a lagjax.Hybrid is taken by"),
        (lambda: lagjax.simulate(BALL, 1.0, 0.0, TS, event=lambda q, v: q), "takes no event for a .*lagjax.crossings"),
        (lambda: lagjax.simulate(OSCILLATORS, 1.0, 0.0, TS, t_eval=TS), "takes no t_eval=: .* are ts"),
        (lambda: lagjax.simulate_batch(OSCILLATORS, 1.0, 0.0, TS, args=(1.0,)), "takes no args=: .* is params"),
        (lambda: lagjax.simulate(OSCILLATORS, 1.0, 0.0, np.arange("2020-01", "2020-04", dtype="M8[D]")), "timedelta64"),
        (
            lambda: lagjax.simulate(lambda q, v: 0.5 * v**2, 1.0, 0.0, TS),
            r"lagjax.System\(lagrangian\) is; got <lam",
        ),
        (
            lambda: _follow_held(lambda q, v: q @ q - 1),
            "does not depend on qdot .* pass what depends on q alone as",
        ),
        (lambda: _follow_pulses(1000.0), r"Where the motion merely crosses them, .* raise max_steps[\s\S]*some \d+\.$"),
    ],
)
def test_mistakes_are_told_with_what_to_do(call, said):
    with pytest.raises((TypeError, ValueError, lagjax.SimulationError), match=said):
        call()


def test_names_of_another_package_are_told_ours():
    run = lagjax.simulate(OSCILLATORS, np.ones(1), np.zeros(1), TS)
    with pytest.raises(AttributeError, match="Its times are `ts`"):
        _ = run.t
    assert not hasattr(run, "nothing") and pickle.loads(pickle.dumps(eqx.tree_at(lambda r: r.system, run, None))).ok


def _sweep(ts, crossings=None, keep=lambda run, found: {"q": run.q[-1]}):
    more = {"params": MASS, "keep": keep, "store": lagjax.Store("not-made", crossings=crossings)}
    return lagjax.sweep(SPRING, {"a": np.linspace(0.0, 1.0, 3)}, ts, q0=lambda point: point["a"], qdot0=0.0, **more)


def _follow_held(constraint):
    held = lagjax.System(lambda q, v: 0.5 * v @ v, velocity_constraints=constraint)
    return lagjax.simulate(held, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), TS)


def _follow_pulses(rate):
    switched = lagjax.System(lambda q, v: 0.5 * v**2, forces=lambda q, v, t: jnp.where((rate * t) % 1 < 0.5, 1.0, -1.0))
    return lagjax.simulate(switched, 0.0, 0.0, jnp.array([0.0, 5.0]), max_steps=1200)


@pytest.mark.parametrize("force", [lambda q, v: 1 - 3 * (v > 0.1), lambda q, v: v < 0.1])
def test_whole_numbers_and_comparisons_are_forces(force):
    system = particle(force)
    np.testing.assert_allclose(lagjax.simulate(system, 1.0, 0.0, np.array([0.0, 5.0])).q[-1], 1.495, rtol=1e-12)


def test_a_hybrid_is_taken_where_a_motion_is_followed():
    one = lagjax.simulate(BALL, 0.5, 0.0, TS * 1.5, rtol=1e-9)
    for run in (one, lagjax.simulate(lagjax.Hybrid(BALL.modes, BALL.transitions, 0), 0.5, 0.0, TS * 1.5)):
        np.testing.assert_allclose(run.q, [0.5, 0.5 - 0.75**2 / 2, 0.25 - 0.125], atol=1e-14)
    starts = np.array([0.5, 0.3])
    many = lagjax.simulate_batch(BALL, starts, 0.0, TS * 1.5, batch_axes=(0, None, None), max_transitions=2)
    np.testing.assert_allclose(many.q[0], one.q, atol=1e-14)
    assert many.ts.shape == TS.shape and many.transitions.t.shape == (2, 2) and many.energy().shape == (2, len(TS))
    with pytest.raises(TypeError, match="takes no dt for a lagjax"):
        lagjax.simulate_batch(BALL, starts, starts, TS, dt=0.1)


@pytest.mark.slow
def test_networks_in_a_batch():
    keys = jax.random.split(jax.random.key(0), 3)
    nets = eqx.filter_vmap(lambda key: eqx.nn.MLP(1, "scalar", 4, 1, key=key))(keys)
    batch = lagjax.simulate_batch(NETWORK, np.ones(3), np.zeros(3), TS, nets, batch_axes=(0, 0, 0))
    one = jax.tree.map(lambda leaf: leaf[2] if eqx.is_array(leaf) else leaf, nets)
    run = lagjax.simulate(NETWORK, 1.0, 0.0, TS, one)
    np.testing.assert_allclose(batch.q[2], run.q, rtol=1e-12)
    np.testing.assert_allclose(batch.energy()[2], run.energy(), rtol=1e-12)


def test_motions_of_lambdas_are_pickled():
    run = lagjax.simulate(OSCILLATORS, np.ones(2), np.zeros(2), TS)
    again = pickle.loads(pickle.dumps(run))
    np.testing.assert_array_equal(again.q, run.q)
    np.testing.assert_array_equal(again.energy(), run.energy())


@pytest.mark.slow
def test_implicit_solvers_are_not_told_to_be_implicit():
    scene = OSCILLATOR
    for solver in (None, diffrax.Kvaerno5()):
        with pytest.raises(lagjax.SimulationError, match="The budget of steps was spent") as error:
            lagjax.simulate(scene, 1.0, 0.0, np.array([0.0, 1e4]), solver=solver, max_steps=20)
        assert ("Kvaerno5" in str(error.value)) == (solver is None) and "make a constraint of" in str(error.value)
