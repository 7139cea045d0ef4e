"""`simulate`: accuracy against closed forms, the options of diffrax, derivatives, compile counts, bad input."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lagrangians import ball_in_gravity, mass_on_a_spring
from scenes import EDGE, SPRING_K
from sweeps import sweep

import lagjax
from lagjax._engine import _problem

SCENE = lagjax.System(mass_on_a_spring)
PARAMS = {"m": 2.0, "k": 8.0}  # ω = 2
TS = np.linspace(0.0, 3.0, 31)


def exact(ts, q0=1.0, qdot0=0.5, omega=2.0):
    return q0 * np.cos(omega * ts) + qdot0 / omega * np.sin(omega * ts)


def run(**options):
    return lagjax.simulate(SCENE, 1.0, 0.5, options.pop("ts", TS), options.pop("params", PARAMS), **options)


# ---- physics and options --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rtol", [1e-5, 1e-8, 1e-11])
def test_error_follows_the_tolerance(rtol):
    # Local errors of rtol per step add up over some tens of steps; the amplitude is about 1.
    np.testing.assert_allclose(run(rtol=rtol).q, exact(TS), atol=100 * rtol)


ORDERS = [
    (diffrax.Tsit5(), 5), (diffrax.Dopri8(), 8), (diffrax.Heun(), 2), (diffrax.Euler(), 1), (diffrax.Midpoint(), 2),
]  # fmt: skip


@pytest.mark.parametrize(("solver", "order"), sweep(ORDERS, kept=lambda case: case[1] == 5))
def test_fixed_steps_converge_at_the_order_of_the_solver(solver, order):
    dt = 0.25 if order == 8 else 0.02
    coarse, fine = (
        abs(float(run(solver=solver, dt=step, ts=np.array([0.0, 3.0])).q[-1]) - exact(3.0)) for step in (dt, dt / 2)
    )
    assert coarse / fine > 0.8 * 2**order


@pytest.mark.slow
def test_backward_time_returns_to_the_start():
    there = run(rtol=1e-12)
    back = lagjax.simulate(SCENE, there.q[-1], there.qdot[-1], TS[::-1], PARAMS, rtol=1e-12)
    np.testing.assert_allclose(back.q[-1], 1.0, atol=1e-10)
    np.testing.assert_allclose(back.qdot[-1], 0.5, atol=1e-10)
    fixed = run(dt=0.01, ts=np.array([3.0, 0.0]))
    np.testing.assert_allclose(fixed.q[-1], exact(-3.0), atol=1e-11)


def test_the_outputs_are_where_they_were_asked_for():
    ts = np.array([0.3, 0.31, 1.7, 2.0])  # ts[0] is the start
    trajectory = run(ts=ts, rtol=1e-10)
    np.testing.assert_allclose(trajectory.q, exact(ts - 0.3), atol=1e-8)
    assert trajectory.q[0] == 1.0 and trajectory.qdot[0] == 0.5
    assert trajectory.end.t == ts[-1] and trajectory.ok and trajectory.result == lagjax.RESULTS.successful
    stats = trajectory.stats
    assert stats["num_steps"] == stats["num_accepted_steps"] + stats["num_rejected_steps"]


def test_energy_and_momentum_along_the_trajectory():
    trajectory = run(rtol=1e-11)
    np.testing.assert_allclose(trajectory.energy(), 0.5 * 2.0 * 0.25 + 0.5 * 8.0, rtol=1e-8)
    np.testing.assert_allclose(trajectory.momentum(), 2.0 * trajectory.qdot, rtol=1e-15)


def driven(q, qdot, t):
    return 0.5 * qdot**2 - 0.5 * (1 + 0.3 * jnp.sin(t)) * q**2


DRIVEN = lagjax.System(driven, forces=lambda q, v, t: jnp.cos(3 * t), dissipation=lambda q, v: 0.2 * v**2)


def test_power_balance_of_a_driven_and_damped_motion():
    # dh/dt = −∂L/∂t + (Q − ∂D/∂q̇)·q̇, h integrated beside the motion by the trapezoidal rule (error ~ Δt²).

    def power(q, v, t):
        partial_t = jax.grad(driven, argnums=2)(q, v, t)
        return -partial_t + (jnp.cos(3 * t) - 0.4 * v) * v

    ts = np.linspace(0.0, 10.0, 4001)
    trajectory = lagjax.simulate(DRIVEN, 1.0, 0.0, ts, rtol=1e-11)
    rate = np.asarray(jax.jit(jax.vmap(power))(trajectory.q, trajectory.qdot, ts))
    work = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(ts))])
    np.testing.assert_allclose(trajectory.energy() - trajectory.energy()[0], work, atol=2e-5)
    assert np.ptp(trajectory.energy()) > 0.1


@pytest.mark.slow
def test_implicit_solver():
    trajectory = run(solver=diffrax.Kvaerno5(), rtol=1e-9)
    np.testing.assert_allclose(trajectory.q, exact(TS), atol=1e-6)


@pytest.mark.slow
def test_progress_is_printed(capsys):
    run(progress=True, solver=diffrax.Euler(), dt=0.01)
    jax.effects_barrier()
    assert "%" in capsys.readouterr().out


# ---- events ---------------------------------------------------------------------------------------------------------


def fall(g):
    return lagjax.simulate(
        lagjax.System(ball_in_gravity), 2.0, 0.0, jnp.linspace(0, 5, 11), {"g": g}, event=floor, rtol=1e-12
    )


def test_event_stops_where_the_guard_changes_sign():
    trajectory = fall(9.81)
    assert trajectory.ok and trajectory.result == lagjax.RESULTS.event_occurred
    landing = np.sqrt(2 * 2.0 / 9.81)
    np.testing.assert_allclose(trajectory.end.t, landing, rtol=1e-13)
    np.testing.assert_allclose(trajectory.end.qdot, -9.81 * landing, rtol=1e-12)
    after = np.asarray(trajectory.ts) > landing
    assert np.isnan(trajectory.q[after]).all() and np.isfinite(trajectory.q[~after]).all()


@pytest.mark.slow
def test_the_time_of_an_event_is_differentiable():
    landing = np.sqrt(2 * 2.0 / 9.81)  # d t/d g = −t/(2g)
    np.testing.assert_allclose(jax.grad(lambda g: fall(g).end.t)(9.81), -landing / (2 * 9.81), rtol=1e-10)


def floor(q, qdot):
    return q


@pytest.mark.slow
def test_event_with_a_direction_and_by_name():
    rising = diffrax.Event(lambda q, qdot, t, params: q - 0.5 * params["m"] / 2.0, direction=True)
    trajectory = run(event=rising, rtol=1e-12)
    phase = np.arctan2(0.25, 1.0)  # q = A cos(2t − phase)
    expected = (2 * np.pi - np.arccos(0.5 / np.hypot(1, 0.25)) + phase) / 2
    np.testing.assert_allclose(trajectory.end.t, expected, rtol=1e-10)


# ---- derivatives ----------------------------------------------------------------------------------------------------


def final_position(params, adjoint):
    return run(params=params, adjoint=adjoint, rtol=1e-11).q[-1]


@pytest.mark.slow
def test_forward_reverse_and_central_differences_agree():
    reverse = jax.grad(lambda p: final_position(p, None))(PARAMS)
    forward = jax.jacfwd(lambda p: final_position(p, diffrax.ForwardMode()))(PARAMS)
    for name in PARAMS:
        step = 1e-5  # central differences: h² truncation and 1e-11/h of solver noise, about 1e-6
        up, down = (final_position(PARAMS | {name: PARAMS[name] + sign * step}, None) for sign in (1, -1))
        np.testing.assert_allclose(reverse[name], forward[name], rtol=1e-6)
        np.testing.assert_allclose(reverse[name], (up - down) / (2 * step), rtol=1e-6, atol=1e-6)
    # q(T) = q0 cos ωT + q̇0/ω sin ωT with ω² = k/m.
    of_omega = jax.grad(lambda w: jnp.cos(3 * w) + 0.5 / w * jnp.sin(3 * w))(2.0)
    np.testing.assert_allclose(reverse["k"], of_omega / (2 * 2.0 * 2.0), rtol=1e-7)


def test_vmap_of_grad():
    stiffness, slope = np.linspace(4.0, 12.0, 5), jax.grad(lambda k: final_position({"m": 2.0, "k": k}, None))
    batched, single = jax.jit(jax.vmap(slope))(stiffness), [jax.jit(slope)(k) for k in stiffness]
    np.testing.assert_allclose(batched, single, rtol=1e-9)


@pytest.mark.slow
def test_gradient_with_more_steps_than_checkpoints():
    # Recomputed steps must be the steps that were taken: several hundred of them against few checkpoints.
    adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=20)
    long = lambda k, adjoint: lagjax.simulate(
        SCENE, 1.0, 0.5, jnp.array([0.0, 100.0]), {"m": 2.0, "k": k}, adjoint=adjoint, rtol=1e-10
    )
    assert long(8.0, None).stats["num_steps"] > 200
    reverse = jax.grad(lambda k: long(k, adjoint).q[-1])(8.0)
    forward = jax.jacfwd(lambda k: long(k, diffrax.ForwardMode()).q[-1])(8.0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-6)


@pytest.mark.slow
def test_reverse_mode_backward_in_time_by_the_output_times_and_beside_a_failure():
    # q(T) = q0 cos ωT + q̇0/ω sin ωT and dq(T)/dT = q̇(T), in either direction of time.
    final = lambda k, t1: run(params={"m": 2.0, "k": k}, ts=jnp.array([0.0, 1.0]) * t1, rtol=1e-11)
    for end in (3.0, -3.0):
        by_k, by_t = jax.grad(lambda k, t1: final(k, t1).q[-1], argnums=(0, 1))(8.0, end)
        of_omega = jax.grad(lambda w, t=end: jnp.cos(t * w) + 0.5 / w * jnp.sin(t * w))(2.0)
        np.testing.assert_allclose(by_k, of_omega / 8.0, rtol=1e-7)
        np.testing.assert_allclose(by_t, final(8.0, end).qdot[-1], rtol=1e-7)

    def first_output(q0):  # the second member runs into the wall at q = 0
        scene = EDGE
        return lagjax.simulate_batch(scene, q0, -jnp.ones(2), jnp.array([0.0, 0.5, 2.0])).q[:, 1].sum()

    q0, step = jnp.array([9.0, 1.0]), 1e-5
    central = [(first_output(q0.at[i].add(step)) - first_output(q0.at[i].add(-step))) / (2 * step) for i in (0, 1)]
    np.testing.assert_allclose(jax.grad(first_output)(q0), central, rtol=1e-6)


# ---- compile counts -------------------------------------------------------------------------------------------------


def test_a_new_value_never_recompiles():
    traces = []

    def counted(q, qdot, params):
        traces.append(None)
        return 0.5 * params["m"] * qdot**2 - 0.5 * params["k"] * q**2

    def solve(q0, ts, m, rtol, scene):
        return lagjax.simulate(scene, q0, 0.5, ts, {"m": m, "k": 8.0}, rtol=rtol).q

    solve(1.0, TS, 2.0, 1e-8, lagjax.System(counted))
    first = len(traces)
    assert first > 0
    solve(1.1, TS, 2.0, 1e-8, lagjax.System(counted))  # an equal System is the same System
    solve(1.0, 2 * TS, 3.0, 1e-9, lagjax.System(counted))
    assert len(traces) == first
    solve(1.0, TS[:-1], 2.0, 1e-8, lagjax.System(counted))  # machine code serves any number of output times
    assert len(traces) == first


@pytest.mark.slow
def test_simulate_inside_jit_and_vmap():
    inside = jax.jit(lambda q0: run_from(q0).q[-1])
    np.testing.assert_allclose(inside(1.0), run_from(1.0).q[-1], rtol=1e-13)
    batch = jax.vmap(run_from)(np.array([1.0, 2.0]))
    assert batch.q.shape == (2, 31) and batch.energy().shape == (2, 31)
    np.testing.assert_allclose(batch.q[0], run_from(1.0).q, rtol=1e-13)


def run_from(q0):
    # Fixed steps: adaptive ones may differ by a step where a decision hangs on the last digit.
    return lagjax.simulate(SCENE, q0, 0.5, TS, PARAMS, dt=0.02, solver=diffrax.Heun())


# ---- failures that only the integration can find --------------------------------------------------------------------


def failing(lagrangian, q0, qdot0, **options):
    with pytest.raises(lagjax.SimulationError) as caught:
        lagjax.simulate(lagjax.System(lagrangian), q0, qdot0, jnp.linspace(0.0, 2.0, 5), **options)
    return str(caught.value), caught.value.trajectory


@pytest.mark.parametrize("options", sweep([{}, {"dt": 0.01, "solver": diffrax.Tsit5()}], kept=[{}]))
def test_singular_mass_matrix_names_the_coordinate(options):
    message, trajectory = failing(lambda q, v: 0.5 * v["x"] ** 2 - q["phi"] ** 2, ONE, ONE, **options)
    assert "mass matrix" in message and "q['phi']" in message and "q['x'] (" not in message
    assert trajectory.result == lagjax.RESULTS.mass_matrix_singular and not trajectory.ok
    message, _ = failing(lambda q, v: 0.5 * (v["x"] + 2 * v["phi"]) ** 2, ONE, ONE, **options)
    assert "no kinetic energy along" in message and "dq['phi']" in message


ONE = {"phi": 1.0, "x": 1.0}


def test_a_wall_in_the_domain_ends_in_a_sentence():
    message, trajectory = failing(lambda q, v: 0.5 * v**2 - jnp.sqrt(q), 1.0, -1.0)
    assert "NaN or infinite" in message and "velocities" in message
    assert "Not finite just ahead: the derivative of L by q (nan). It comes from sqrt(-" in message
    reached = np.isfinite(trajectory.q)
    assert reached[0] and not reached[-1] and trajectory.end.t < 1.0


@pytest.mark.slow
def test_nan_with_fixed_steps_is_reported():
    message, trajectory = failing(lambda q, v: 0.5 * v**2 - jnp.sqrt(q), 1.0, -1.0, dt=0.01, solver=diffrax.Tsit5())
    assert "NaN" in message
    assert trajectory.result == lagjax.RESULTS.nonfinite_state


def test_nan_at_the_start_is_reported():
    message, _ = failing(lambda q, v: 0.5 * jnp.sum(v**2) + jnp.linalg.norm(q), np.zeros(2), np.zeros(2))
    assert "norm at zero" in message and "t = 0 " in message


def test_step_budget():
    message, trajectory = failing(lambda q, v: 0.5 * v**2 - 0.5 * 1e6 * q**2, 1.0, 0.0, max_steps=50)
    assert "max_steps" in message and trajectory.stats["num_steps"] == 50
    quiet = lagjax.simulate(SCENE, 1.0, 0.5, TS, PARAMS, max_steps=3, throw=False)
    assert not quiet.ok and np.isnan(quiet.q[-1])


def test_failure_inside_jit_raises_at_run_time():
    with pytest.raises(Exception, match="max"):
        jax.block_until_ready(jax.jit(lambda q0: run_with_budget(q0))(1.0))


def run_with_budget(q0):
    return lagjax.simulate(SCENE, q0, 0.5, TS, PARAMS, max_steps=3).q


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"q0": np.nan}, ValueError, "q0 is nan"),
        ({"qdot0": np.inf}, ValueError, "qdot0 is inf"),
        ({"params": {"m": np.nan, "k": 1.0}}, ValueError, r"params\['m'\] is nan"),
        ({"ts": [0.0, np.nan]}, ValueError, r"ts\[1\] is nan"),
        ({"ts": [0.0, 2.0, 1.0]}, ValueError, "strictly increasing or strictly decreasing"),
        ({"ts": [0.0, 0.0]}, ValueError, "strictly increasing"),
        ({"ts": [1.0]}, ValueError, "at least two output times"),
        ({"ts": 3.0}, ValueError, "at least two output times"),
        ({"ts": "later"}, TypeError, "ts must be an array"),
        ({"ts": [0j, 1j]}, TypeError, "ts must hold real numbers"),
        ({"q0": 1}, TypeError, "got int"),
        ({"q0": 1j}, TypeError, "got complex"),
        ({"qdot0": jnp.ones(2)}, ValueError, "must agree"),
        ({"rtol": 1e-17}, ValueError, "float64 cannot meet rtol"),
        ({"rtol": -1e-3}, ValueError, "rtol must be positive"),
        ({"rtol": np.nan}, ValueError, "rtol must be positive"),
        ({"atol": 0.0}, ValueError, "atol must be positive"),
        ({"atol": jnp.ones(2)}, ValueError, "atol must be one number"),
        ({"dt": 0.1, "rtol": 1e-3}, ValueError, "one or the other"),
        ({"dt": -0.1}, ValueError, "dt must be a positive step"),
        ({"dt": 1e-9}, ValueError, "more than max_steps"),
        ({"max_steps": None}, ValueError, "max_steps must be a positive integer"),
        ({"max_steps": 0}, ValueError, "max_steps must be a positive integer"),
        ({"solver": diffrax.Tsit5}, TypeError, "instance of a diffrax solver"),
        ({"solver": "rk4"}, TypeError, "instance of a diffrax solver"),
        ({"solver": diffrax.Euler()}, ValueError, "no error estimate"),
        ({"solver": diffrax.SemiImplicitEuler(), "dt": 0.1}, ValueError, "several terms"),
        ({"solver": diffrax.ImplicitEuler(), "dt": 0.1}, ValueError, "nothing says how well"),
        ({"event": lambda q: q}, TypeError, "event must have the form"),
        (
            {"q0": jnp.float32(1), "qdot0": jnp.float32(1), "rtol": 1e-12, "solver": diffrax.Tsit5()},
            ValueError,
            "float32 cannot meet",
        ),
    ],
)
def test_bad_input_gets_a_sentence(changes, error, sentence):
    arguments = {"q0": 1.0, "qdot0": 0.5, "ts": TS, "params": PARAMS} | changes
    with pytest.raises(error, match=sentence):
        lagjax.simulate(SCENE, **arguments)


def test_a_misspelt_parameter_is_a_key_error():
    with pytest.raises(KeyError, match="k"):
        run(params={"m": 1.0, "K": 1.0})


def test_sensitivities_of_second_order():
    # q = cos √k t from rest at 1: d²q/dk² by sensitivities of sensitivities.
    scene = SPRING_K
    end = lambda k: lagjax.simulate(scene, 1.0, 0.0, np.array([0.0, 3.0]), k, rtol=1e-11).q[-1]
    twice = lambda f: jax.grad(jax.grad(f))
    of_exact, *found = jax.jit(
        lambda k: (twice(lambda k: jnp.cos(3.0 * jnp.sqrt(k)))(k), twice(end)(k), jax.jacfwd(jax.jacrev(end))(k))
    )(2.0)
    np.testing.assert_allclose(found, 2 * [of_exact], rtol=1e-8)


COUNTED_SPRING = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 - 0.5 * params["k"] * q**2)


def test_a_call_looks_its_scene_up_once_and_never_remembers_a_number(monkeypatch):
    scene, asked = COUNTED_SPRING, []
    kept, derivation_of = [], _problem.derivation_of
    monkeypatch.setattr(_problem, "derivation_of", lambda *args: asked.append(1) or derivation_of(*args))
    ts, start, params = np.linspace(0.0, 2.0, 5), np.array(1.0), {"k": np.array(1.0)}
    for k, q, last in ((1.0, 1.0, 2.0), (4.0, 1.0, 2.0), (4.0, 0.5, 2.0), (4.0, 0.5, 3.0)):
        params["k"][()], start[()], ts[-1] = k, q, last  # arrays of the user, changed in place
        asked.clear()
        trajectory = lagjax.simulate(scene, start, 0.0, ts, params)
        assert len(asked) == 1
        assert isinstance(trajectory.q, jax.Array) and isinstance(trajectory.ts, jax.Array)
        np.testing.assert_allclose(trajectory.q, q * np.cos(np.sqrt(k) * ts), atol=1e-8)
        kept.append((trajectory, *(np.array(x) for x in (trajectory.ts, trajectory.q, trajectory.end.t))))
    for trajectory, ts, q, t_end in kept:
        for later, then in zip((trajectory.ts, trajectory.q, trajectory.end.t), (ts, q, t_end), strict=True):
            np.testing.assert_array_equal(later, then)
