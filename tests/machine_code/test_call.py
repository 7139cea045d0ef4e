"""A run inside compiled functions: what the handler does without Python is what a run outside of them does, to the bit.

The handler serves few members and short runs; what it leaves undone is gone on with. Both under every transformation,
on several threads and devices, after a fork, and with what fails.
"""

import ctypes
import functools
import os
import signal
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax import _native
from lagjax._engine.taylor import Flow, _call, _derivatives, _primitives

SCENE = lagjax.scenes.double_pendulum()
TS = np.linspace(0.0, 1.0, 4)
Q = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2))


@pytest.fixture
def on_host(monkeypatch):
    """The arguments of every run, or of what is left of one, that Python is asked for."""
    asked = []
    for owner, name in ((Flow, "run"), (_derivatives, "jvp"), (_derivatives, "vjp")):
        function = getattr(owner, name)

        def counted(*args, function=function, **settings):
            asked.append(args)
            return function(*args, **settings)

        monkeypatch.setattr(owner, name, counted)
    return asked


def run(q, ts=TS, params=SCENE.params, **options):
    found = lagjax.simulate(SCENE.system, q, np.zeros(2), ts, params, **options)
    return found.q, found.end, found.result._value, found.stats


def assert_equal(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_compiled_run_is_the_run_itself_and_takes_no_python(on_host):
    assert _call.NO_HANDLER is None
    compiled = jax.jit(run)
    for q in Q[:3]:
        assert_equal(compiled(q), run(q))
    masses = SCENE.params | {"m1": 1.0 + np.arange(6.0)}
    sets = {**dict.fromkeys(SCENE.params), "m1": 0}

    def of_each(q, params):
        return jax.vmap(lambda q, params: run(q, params=params), in_axes=(0, sets))(q, params)

    assert_equal(jax.jit(of_each)(Q, masses), of_each(Q, masses))
    times = TS * (1.0 + np.arange(3.0))[:, None]

    def at_all(q, ts):  # members with times of their own, and an axis that shares them
        return jax.vmap(lambda q: jax.vmap(lambda ts: run(q, ts))(ts))(q)

    eager = at_all(Q[:2], times)
    assert eager[0].shape == (2, 3, 4, 2)
    on_host.clear()
    assert_equal(jax.jit(at_all)(Q[:2], times), eager)
    assert not on_host


@pytest.mark.slow
def test_a_loop_of_short_runs_takes_no_python_and_has_derivatives(on_host):
    ts = np.linspace(0.0, 0.1, 2)

    def walk(q, params):
        def step(state, _):
            found = jax.checkpoint(lambda s: lagjax.simulate(SCENE.system, *s, ts, params))(state)
            return (found.q[-1], found.qdot[-1]), found.q[-1]

        return jax.lax.scan(step, (q, jnp.zeros(2)), None, length=10)[1]

    whole = lagjax.simulate(SCENE.system, Q[0], np.zeros(2), np.linspace(0.0, 1.0, 11), SCENE.params, rtol=1e-12)
    on_host.clear()
    np.testing.assert_allclose(jax.jit(walk)(Q[0], SCENE.params), whole.q[1:], atol=1e-8)
    assert not on_host
    slope = jax.jit(jax.grad(lambda m: walk(Q[0], SCENE.params | {"m1": m})[-1, 0]))(1.0)
    h = 1e-4
    low, high = (walk(Q[0], SCENE.params | {"m1": 1.0 + s})[-1, 0] for s in (-h, h))
    np.testing.assert_allclose(slope, (high - low) / (2 * h), atol=1e-6)


def end(q, m=1.0, ts=TS):
    found = lagjax.simulate(SCENE.system, q, np.zeros(2), ts, SCENE.params | {"m1": m}, rtol=1e-11)
    return jnp.sum(found.q**2) + jnp.sum(found.end.qdot)


def eagerly(function, monkeypatch):
    """What a derivative is on the host, with its steps taken once more."""
    with monkeypatch.context() as patch:
        patch.setattr(_call, "NO_HANDLER", "this test says so")
        _primitives.compile_once.cache_clear()
        return function()


@pytest.mark.slow
def test_derivatives_of_short_runs_take_no_python(on_host, monkeypatch):
    both = (0, 1)
    forms = {
        "grad": lambda: jax.grad(end, both),
        "jacobian": lambda: jax.jacfwd(end, both),
        "along": lambda: lambda q, m: jax.jvp(end, (q, m), (jnp.ones(2), 2.0)),
        "of a batch": lambda: jax.vmap(jax.grad(end, both), (0, None)),
        "of a batch, forward": lambda: jax.vmap(jax.jacfwd(end, both), (0, None)),
    }
    for name, form in forms.items():
        q = Q if "batch" in name else Q[0]
        expected = eagerly(lambda form=form, q=q: jax.jit(form())(q, 1.3), monkeypatch)
        assert on_host, name
        on_host.clear()
        found = jax.jit(form())(q, 1.3)
        assert not on_host, name
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12, err_msg=name)


def test_several_cotangents_of_a_short_run_take_no_python(on_host):
    """Members have starts, parameters or times of their own; forward mode gives the same by other code."""

    def ends(q, m, ts):
        found = lagjax.simulate(SCENE.system, q, np.zeros(2), ts, SCENE.params | {"m1": m}, rtol=1e-11)
        return jnp.concatenate([found.q.ravel(), found.end.qdot])

    q, m, ts = Q[:3], np.array([1.0, 1.3, 0.8]), np.array([[0.0, 0.1, 0.2], [0.0, 0.2, 0.3], [0.0, 0.1, 0.3]])

    def slopes(jacobian):
        of_all = jax.vmap(jacobian(ends, (0, 1, 2)), (0, 0, None))(q, m, ts[0])
        return (
            of_all,
            jax.vmap(jacobian(ends, (0, 2)), (None, None, 0))(q[0], 1.3, ts),
            jacobian(ends)(q[0], 1.3, ts[0]),
        )

    on_host.clear()
    found = jax.jit(lambda: slopes(jax.jacrev))()
    assert not on_host
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(jax.jit(lambda: slopes(jax.jacfwd))()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_a_derivative_inside_of_loops_takes_no_python(on_host):
    def walk(q, m):
        def step(q, _):
            slope = jax.checkpoint(jax.grad(end))(q, m, np.array([0.0, 0.05]))
            return q - 0.1 * slope, None

        return jnp.sum(jax.lax.scan(step, q, None, length=8)[0])

    compiled, h = jax.jit(walk), 1e-4
    on_host.clear()
    compiled(Q[0], 1.0)
    assert not on_host
    slope = jax.jit(jax.grad(walk, 1))(Q[0], 1.0)  # a second derivative of every run
    np.testing.assert_allclose(slope, (compiled(Q[0], 1.0 + h) - compiled(Q[0], 1.0 - h)) / (2 * h), atol=1e-7)


def test_derivatives_of_long_runs_and_of_rest_are_those_of_the_host(on_host, monkeypatch):
    long = np.linspace(0.0, 40.0, 5)
    for arguments in ((Q[0], 1.3, long), (np.zeros(2), 1.3, 10 * TS)):  # at rest steps are too long for derivatives
        compiled = jax.jit(jax.grad(end, (0, 1)))
        on_host.clear()
        found = compiled(*arguments)
        assert on_host
        expected = eagerly(lambda given=arguments: jax.jit(jax.grad(end, (0, 1)))(*given), monkeypatch)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


def test_a_long_run_is_gone_on_with(on_host, monkeypatch):
    plan = _native.Kernel.plan
    monkeypatch.setattr(_native.Kernel, "plan", lambda *args: short(plan(*args)))

    def short(plan):
        plan.rounds = 3
        return plan

    found = jax.jit(lambda q: run(q))(Q[0])
    (begun,) = on_host
    assert np.array(begun[-1].rest)[-1:].view(np.int64) == 1  # there was more to do
    assert_equal(found, run(Q[0]))
    many = jax.jit(jax.vmap(lambda q: run(q)))
    assert_equal(many(np.tile(Q, (2, 1))), jax.vmap(run)(np.tile(Q, (2, 1))))


def test_without_a_handler_python_does_all(on_host, monkeypatch):
    monkeypatch.setattr(_call, "NO_HANDLER", "this test says so")
    compiled = jax.jit(lambda q: run(q))(Q[1])
    assert len(on_host) == 1
    assert_equal(compiled, run(Q[1]))


def fall(q, qdot):  # towards the centre, which it reaches at t = 1.11
    return 0.5 * jnp.sum(qdot**2) + 1.0 / jnp.sqrt(jnp.sum(q**2))


def test_what_fails_is_explained_and_costs_the_others_nothing():
    scene, ts, starts = (
        lagjax.System(fall),
        np.array([0.0, 0.5, 2.0]),
        np.array([[1.0, 0.0], [3.0, 0.0], [np.nan, 0.0]]),
    )

    def path(q):
        found = lagjax.simulate(scene, q, jnp.zeros(2), ts, throw=False)
        return found.q, found.result._value, found.end

    compiled, eager = jax.jit(jax.vmap(path))(starts), lagjax.simulate_batch(scene, starts, np.zeros((3, 2)), ts)
    assert_equal(compiled, (eager.q, eager.result._value, eager.end))
    assert list(eager.ok) == [False, True, False]
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"could not be followed beyond t = 1\.11"):
        jax.block_until_ready(jax.jit(lambda q: lagjax.simulate(scene, q, jnp.zeros(2), ts).q)(starts[0]))


def test_the_interface_is_compared_with_the_header(tmp_path):
    header = tmp_path / "xla" / "ffi" / "api" / "c_api.h"
    assert "there is no" in _native.unavailable(str(tmp_path))
    header.parent.mkdir(parents=True)
    text = (tmp_path.__class__(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()
    header.write_text(text.replace("API_MAJOR 0", "API_MAJOR 1"))
    assert "version of the interface is 1" in _native.unavailable(str(tmp_path))
    header.write_text(text)
    assert _native.unavailable(str(tmp_path)) is None


# ---- processes -------------------------------------------------------------------------------------------------------


def derivatives(q):
    return jax.grad(end)(q), jax.jacfwd(lambda q: run(q)[0])(q)


def on_two_devices():
    from jax.sharding import PartitionSpec as P

    assert len(jax.devices()) == 2
    mesh = jax.make_mesh((2,), ("members",), axis_types=(jax.sharding.AxisType.Auto,))
    function = jax.vmap(lambda q: run(q)[0])
    sharded = jax.shard_map(function, mesh=mesh, in_specs=P("members"), out_specs=P("members"), check_vma=False)
    assert_equal(jax.jit(sharded)(Q), function(Q))
    function = jax.vmap(derivatives)
    sharded = jax.shard_map(function, mesh=mesh, in_specs=P("members"), out_specs=P("members"), check_vma=False)
    for a, b in zip(jax.tree.leaves(jax.jit(sharded)(Q)), jax.tree.leaves(jax.jit(function)(Q)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)  # other members side by side, to the last digits


def over_devices():
    """Each device has its own members, all share a parameter, whose cotangents are summed over the devices.

    `derivative(shard_map(…))` and `shard_map(derivative(…))`, with the types that JAX checks by default and without.
    Some members have more impacts than others.
    """
    from jax.sharding import PartitionSpec as P

    mesh = jax.make_mesh((4,), ("members",), axis_types=(jax.sharding.AxisType.Auto,))

    def lagrangian(q, v, params):
        return 0.5 * v**2 - 0.5 * params * q**2

    spring = lagjax.System(lagrangian)
    rubbed = lagjax.System(lagrangian, forces=lambda q, v, params: -0.1 * params * jnp.sign(v))
    ring = lagjax.System(
        lambda q, v, params: 0.5 * v @ v - params * q[1], constraints=lambda q: q[0] ** 2 + q[1] ** 2 - 1.0
    )
    wall = lagjax.Transition("f", "f", lambda q, v: q - 0.1, -1, lambda q, v: (q, -v))
    corner = lagjax.System(
        lambda q, v, params: 0.5 * v @ v + params * (q[0] - q[1]),
        contacts=lambda q: {"floor": q[1] + 0.5, "wall": 2.0 - q[0]},
        slip=lambda q, v: {"floor": v[0], "wall": v[1]}, friction=lambda params: {"floor": 0.1 * params, "wall": 0.2},
        restitution=0.5,
    )  # fmt: skip

    def end(system, q, params):
        return lagjax.simulate(system, q, 0.0 * q, jnp.array([0.0, 1.0]), params).end.q

    functions = {
        "simulate": lambda q, k: end(spring, q, k),
        "with a border": lambda q, k: end(rubbed, q, k),
        "with a constraint": lambda q, k: end(ring, jnp.stack([jnp.cos(q), jnp.sin(q)]), k)[1],
        "with contacts": lambda q, k: end(corner, jnp.stack([1.6 * q, q - 0.4]), k)[1],
        "crossings": lambda q, k: lagjax.crossings(spring, lambda q, v: q - 0.3, q, 0.0, (0.0, 2.0), k, count=2).t[0],
        "a hybrid motion": lambda q, k: (
            lagjax.simulate(
                lagjax.Hybrid({"f": spring}, [wall], "f"), q, 0.0, jnp.array([0.0, 2.0]), k, max_transitions=3
            ).end.q
        ),
    }
    starts, stiffness = jnp.linspace(0.5, 1.2, 8), 2.0
    for name, function in functions.items():
        members = jax.vmap(function, (0, None))
        both = jax.vmap(jax.value_and_grad(function, (0, 1)), (0, None))
        value, slopes = jax.jit(both)(starts, stiffness)
        checked, unchecked = (
            functools.partial(
                jax.shard_map, mesh=mesh, in_specs=(P("members"), P()), out_specs=P("members"), check_vma=x
            )
            for x in (True, False)
        )
        # Where JAX does not check them, two functions are enough: one of a plain motion, one of a motion in pieces.
        for over in (checked, unchecked) if name in ("simulate", "a hybrid motion") else (checked,):
            outside = jax.grad(lambda *given, over=over, members=members: over(members)(*given).sum(), (0, 1))
            found = jax.jit(over(members))(starts, stiffness), jax.jit(outside)(starts, stiffness)
            expected = value, (slopes[0], slopes[1].sum())
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11, err_msg=name)
        inside = unchecked(jax.vmap(jax.grad(function), (0, None)))
        np.testing.assert_allclose(jax.jit(inside)(starts, stiffness), slopes[0], rtol=1e-11, atol=1e-11)


def on_many_threads():
    compiled, found = jax.jit(lambda q: (run(q)[0], derivatives(q))), [None] * 8
    expected = [compiled(q) for q in Q]

    def work(place):
        found[place] = [compiled(q) for _ in range(20) for q in Q]

    threads = [threading.Thread(target=work, args=(place,)) for place in range(8)]
    for step in (threading.Thread.start, threading.Thread.join):
        for thread in threads:
            step(thread)
    for results in found:
        assert_equal(results, expected * 20)


def after_a_fork():
    """A child has none of JAX's threads, which take up most programs; a run by itself needs none."""
    compiled = jax.jit(lambda q: run(q)[0])
    expected = np.asarray(compiled(Q[0]))
    slopes = jax.jit(derivatives)
    before = jax.tree.map(np.asarray, slopes(Q[0]))
    child = os.fork()
    if child == 0:
        signal.alarm(30)
        assert_equal(slopes(Q[0]), before)
        assert_equal((compiled(Q[0]), run(Q[0])[0]), (expected, expected))
        run(Q[0], np.linspace(0.0, 1.0, 7))  # of a shape that was never sent before
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


def in_many_programs():
    """A program that is gone takes its kernel with it; one that is compiled and kept does not need its function."""
    kept = jax.jit(lambda q: run(q)[0]).lower(Q[0]).compile()
    expected = np.asarray(run(Q[0])[0])
    jax.clear_caches()
    from lagjax._engine import taylor as _machine_code
    from lagjax._equations import _derivation

    _machine_code._make_flow.cache_clear()
    _derivation._derived_once.cache_clear()
    _primitives.compile_once.cache_clear()
    import gc

    gc.collect()
    np.testing.assert_array_equal(kept(Q[0]), expected)


@pytest.mark.slow
def test_on_devices_threads_and_after_a_fork():
    start = "import jax; jax.config.update('jax_enable_x64', True); import test_call as t; "
    call = "t.on_two_devices(); t.on_many_threads(); t.in_many_programs(); t.after_a_fork()"
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", start + call], cwd=os.path.dirname(__file__), timeout=200,
        env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_under_shard_map():
    """Twenty seconds: a new process compiles every transformation for four devices."""
    start = "import jax; jax.config.update('jax_enable_x64', True); import test_call as t; t.over_devices()"
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", start], cwd=os.path.dirname(__file__), timeout=300,
        env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_a_plan_has_eight_bytes_a_field():
    assert ctypes.sizeof(_native.Plan) == 8 * len(_native.Plan._fields_)
