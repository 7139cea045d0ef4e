"""Events in machine code: where `event=` ends a motion, under every transformation, and which engine takes it."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scenes import BALL_G, FREE, PENDULUM

import lagjax

TS = np.linspace(0.0, 2.0, 9)


def floor(q, v):
    return q


def fall(h, g=9.81, ts=TS, event=floor, **options):
    return lagjax.simulate(BALL_G, h, 0.0, ts, g, event=event, solver=lagjax.MachineCode(), **options)


def flight(event, end=1.0, **options):
    """Along q = t."""
    ts = jnp.array([0.0, end])
    return lagjax.simulate(FREE, 0.0, 1.0, ts, event=event, solver=lagjax.MachineCode(), **options)


def test_outputs_and_the_end():
    run = fall(2.0)
    landing = np.sqrt(4 / 9.81)
    assert run.ok and run.result == lagjax.RESULTS.event_occurred
    np.testing.assert_allclose([run.end.t, run.end.qdot], [landing, -9.81 * landing], rtol=1e-14)
    assert abs(run.end.q) < 1e-15
    np.testing.assert_array_equal(np.isfinite(run.q), np.asarray(TS) <= landing)
    before = np.asarray(TS)[:3]
    np.testing.assert_allclose(run.q[:3], 2 - 9.81 * before**2 / 2, rtol=1e-14)
    assert fall(200.0).result == lagjax.RESULTS.successful
    back = fall(2.0, ts=-TS)
    np.testing.assert_allclose(back.end.t, -landing, rtol=1e-14)


def test_batches_are_one_run():
    h = np.array([0.5, 1.0, 2.0, 200.0])
    landing = np.where(h < 100, np.sqrt(2 * h / 9.81), 2.0)
    runs = lagjax.simulate_batch(BALL_G, h, np.zeros(4), TS, 9.81, event=floor, solver=lagjax.MachineCode())
    np.testing.assert_allclose(runs.end.t, landing, rtol=1e-14)
    assert runs.ok.all()
    mapped = jax.jit(jax.vmap(fall))(h)
    np.testing.assert_array_equal(mapped.end.t, runs.end.t)
    np.testing.assert_array_equal(mapped.q, runs.q)


@pytest.mark.slow
def test_how_the_end_varies():
    def outcome(x):
        run = fall(x[0], x[1], rtol=1e-12)
        return jnp.stack([run.end.t, run.end.q, run.end.qdot, run.q[2], run.qdot[2]])

    def closed(x):
        t = jnp.sqrt(2 * x[0] / x[1])
        return jnp.stack([t, 0 * t, -x[1] * t, x[0] - x[1] * TS[2] ** 2 / 2, -x[1] * TS[2]])

    x = np.array([2.0, 9.81])
    for mode in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(mode(outcome)(x), mode(closed)(x), atol=1e-12)
    assert np.isnan(jax.grad(lambda h: fall(h).q[-1])(2.0)), "it was not reached"


@pytest.mark.slow
def test_second_derivatives_of_the_end():
    # A pendulum to the bottom: the time is K(sin(q⁰/2)).
    scene = PENDULUM

    def bottom(q0):
        return lagjax.simulate(scene, q0, 0.0, jnp.array([0.0, 5.0]), event=floor, rtol=1e-13).end.t

    h, tight = 1e-3, [float(bottom(2.0 + k * 1e-3)) for k in (-2, -1, 0, 1, 2)]
    first = (tight[0] - 8 * tight[1] + 8 * tight[3] - tight[4]) / (12 * h)
    second = (-tight[0] + 16 * tight[1] - 30 * tight[2] + 16 * tight[3] - tight[4]) / (12 * h * h)
    np.testing.assert_allclose(jax.grad(bottom)(2.0), first, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(jax.grad(bottom))(2.0), second, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.hessian(bottom))(2.0), second, rtol=1e-5)


def test_which_of_several_and_in_which_direction():
    wave = lambda q, v: jnp.cos(jnp.pi * q)
    late = lambda q, v, t: t - 0.9
    for direction, end in ((None, 0.5), (False, 0.5), (True, 0.9)):
        event = diffrax.Event({"wave": wave, "late": late}, direction={"wave": direction, "late": None})
        np.testing.assert_allclose(flight(event).end.t, end, rtol=1e-14)
    np.testing.assert_allclose(flight(diffrax.Event(wave, direction=True), 3.0).end.t, 1.5, rtol=1e-14)


def test_a_pulse_that_no_sample_sees():
    dip = lambda q, v: 0.5 - 1 / (1 + ((q - 7.3) / 1e-3) ** 2)
    np.testing.assert_allclose(flight(dip, 20.0).end.t, 7.299, rtol=1e-13)


def test_nan_between_two_steps_is_seen():
    # NaN from 0.4 to 0.6 only.
    gap = lambda q, v: 2.0 + jnp.sqrt((q - 0.4) * (q - 0.6))
    with pytest.raises(lagjax.SimulationError, match="NaN or infinite"):
        flight(gap)


def test_simultaneous_events_and_a_start_on_one():
    both = diffrax.Event([lambda q, v: q - 0.3, lambda q, v: 1 - q / 0.3])
    np.testing.assert_allclose(flight(both).end.t, 0.3, rtol=1e-15)
    assert flight(floor).result == lagjax.RESULTS.successful


def test_a_start_on_an_event_ends_at_once_where_it_moves_on_in_the_direction():
    # From 0 at speed 1, through floor(q) = q: rising. Not with the other direction, nor with none.
    ends = [flight(diffrax.Event(floor, direction=way)).end.t for way in (True, False, None)]
    assert ends == [0.0, 1.0, 1.0]
    down = lambda q, v: -q
    assert [flight(diffrax.Event(down, direction=way)).end.t for way in (True, False)] == [1.0, 0.0]


def test_an_interval_of_a_few_roundings_of_the_time():
    ts = np.array([20.0 - 1e-14, 20.0])
    assert lagjax.simulate(FREE, 0.0, 1.0, ts, solver=lagjax.MachineCode()).end.t == 20.0


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (lambda q, v: (q < 0.0) & (v < 0.0), "the event is true or false"),
        (diffrax.Event(floor, optx.Newton(1e-8, 1e-8)), "a root finder of its own"),
        (jax.tree_util.Partial(lambda w, q, v: q - w, np.ones(())), "holds arrays of its own"),
    ],
)
def test_what_goes_to_diffrax(event, reason):
    with pytest.raises(ValueError, match=reason):
        flight(event)


COMPARISONS = {
    "q < 0": lambda q, v: q < 0.0,
    "not q >= 0": lambda q, v: jnp.logical_not(jnp.greater_equal(q, 0.0)),
}


@pytest.mark.parametrize("name", COMPARISONS)
def test_a_comparison_is_located(name):
    # √(2h/g) after the release, and there d/dg = −t/2g; a motion that begins below ends where it begins.
    event, (h, g) = COMPARISONS[name], (1.0, 9.81)
    t, slope = jax.jit(jax.value_and_grad(lambda g: fall(h, g, event=event).end.t))(g)
    np.testing.assert_allclose([t, slope], [np.sqrt(2 * h / g), -np.sqrt(2 * h / g) / (2 * g)], rtol=1e-12)
    assert fall(0.0, event=event).end.t == 0.0
    below = lambda h: fall(h, event=event).end
    assert (below(-1.0).t, below(-1.0).q, jax.grad(lambda h: below(h).q)(-1.0)) == (0.0, -1.0, 1.0)


@pytest.mark.slow
def test_booleans_of_diffrax():
    # The instant of a comparison is located there, too; that of another Boolean is the end of a step.
    def land(g, event):
        return lagjax.simulate(BALL_G, 1.0, 0.0, TS, g, event=event, solver=diffrax.Dopri8()).end.t

    t, slope = jax.value_and_grad(land)(9.81, COMPARISONS["q < 0"])
    np.testing.assert_allclose([t, slope], [np.sqrt(2 / 9.81), -np.sqrt(2 / 9.81) / (2 * 9.81)], rtol=1e-8)
    assert np.isnan(jax.grad(land)(9.81, lambda q, v: (q < 0.0) & (v < 0.0)))


def test_an_event_that_is_no_number():
    with pytest.raises(TypeError, match=r"one real number; got shape .2,."):
        flight(lambda q, v: jnp.stack([q, v]))


@pytest.mark.slow
def test_guards_of_a_large_scene():
    # As tables: twelve pendulums in a chain; alone and in a batch, with and without an event.
    scene = lagjax.scenes.chain()
    first = lambda q, v: jax.tree.leaves(q)[0].ravel()[0] - 0.1
    run = functools.partial(lagjax.simulate, scene.system, scene.q0, scene.qdot0, np.linspace(0.0, 1.0, 101))
    plain, ended = run(scene.params), run(scene.params, event=first, solver=lagjax.MachineCode())
    angle = np.asarray(jax.tree.leaves(plain.q)[0]).reshape(101, -1)[:, 0] - 0.1
    changes = np.flatnonzero(np.sign(angle[1:]) != np.sign(angle[:-1]))
    if len(changes):
        assert plain.ts[changes[0]] <= ended.end.t <= plain.ts[changes[0] + 1]
    else:
        assert ended.result == lagjax.RESULTS.successful


@pytest.mark.slow
def test_bits_of_events_do_not_depend_on_neighbours():
    # The search for an instant goes on in the lanes that need it, and in no other.
    scene, rng = lagjax.scenes.double_pendulum(), np.random.default_rng(0)
    q0, ts = rng.uniform(-np.pi, np.pi, (3000, 2)), jnp.array([0.0, 5.0])
    over = lambda q, qdot: jnp.pi**2 - jnp.max(q**2)
    runs = []
    for order in (np.arange(3000), rng.permutation(3000)):
        run = lagjax.simulate_batch(scene.system, q0[order], 0 * q0, ts, scene.params, event=over, rtol=1e-8)
        runs.append(np.column_stack([run.end.t, run.end.q, run.end.qdot])[np.argsort(order)])
    assert (runs[0][:, 0] < 5.0).sum() > 1000
    np.testing.assert_array_equal(*runs)


def test_which_of_thirty_events_ended_the_motion():
    """More than a whole number has bits: of what comes at the same instant all are named, under jit as well."""
    scene, ts = FREE, np.linspace(0.0, 40.0, 3)
    events = [lambda q, v, at=at: q - at for at in [*np.arange(35.0, 7.0, -1.0), 7.5, 7.5]]
    follow = lambda start: lagjax.simulate(scene, start, 1.0, ts, event=events)
    for run, t in ((follow(0.0), 7.5), (jax.jit(follow)(8.25), 0.75)):
        there = [bool(x) for x in run.event]
        np.testing.assert_array_equal(np.flatnonzero(there), [28, 29] if t == 7.5 else [26])
        assert abs(run.end.t - t) < 1e-12
    assert abs(jax.grad(lambda start: follow(start).end.t)(0.0) + 1.0) < 1e-12


def test_the_result_says_which_of_several_events_ended_the_motion():
    scene, ts = FREE, np.linspace(0.0, 10.0, 3)
    event = {"far": lambda q, v: q - 3.0, "near": lambda q, v: q - 2.0, "held": lambda q, v: q < -1.0}
    run = lagjax.simulate(scene, 0.0, 1.0, ts, event=event)
    assert {name: bool(x) for name, x in run.event.items()} == {"far": False, "near": True, "held": False}
    assert repr(run).endswith("ended at t = 2: event_occurred, by event['near']")
    assert bool(lagjax.simulate(scene, -2.0, 1.0, ts, event=event).event["held"])  # at once
    many = lagjax.simulate_batch(scene, np.array([0.0, 2.5, -0.5]), np.array([1.0, 1.0, -0.01]), ts, event=event)
    np.testing.assert_array_equal(np.stack([many.event[x] for x in event]), [[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    assert lagjax.simulate(scene, 0.0, 1.0, ts).event is None
    with pytest.raises(ValueError, match=r"of 3 functions is for machine code.*jnp.minimum"):
        lagjax.simulate(scene, 0.0, 1.0, ts, event=event, solver=diffrax.Dopri8())


@pytest.mark.slow
def test_the_result_of_diffrax_says_that_an_event_ended_the_motion():
    ts = np.linspace(0.0, 10.0, 3)
    one = lagjax.simulate(FREE, 0.0, 1.0, ts, event=[lambda q, v: q - 3.0], solver=diffrax.Dopri8())
    assert bool(one.event[0]) and abs(one.end.t - 3) < 1e-9
