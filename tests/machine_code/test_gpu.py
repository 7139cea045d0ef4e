"""Machine code for GPUs: without one its lowering, and its PTX run on the CPU; and the numbers of one, where it is.

Under `on_the_ptx` the rules for CUDA stand in the place of those for CPUs, and what XLA would launch on a GPU runs
here, translated from the PTX (`ptx.PtxOnCpu`), so that all of `simulate` around it is the one of a GPU. What runs on a
GPU does so in a process of its own, since the suite computes on CPUs, and is compared with machine code on the CPU.
"""

import functools
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import mlir
from jax.sharding import AbstractMesh
from jax.sharding import PartitionSpec as P

import lagjax
from benchmarks._ptx import PtxOnCpu, outputs_of
from lagjax import scenes
from lagjax._engine.taylor import _gpu_launch, _primitives
from lagjax._engine.taylor._call import call_host
from lagjax._native.motions._gpu import MOTION, TRANSPOSE, GpuForm, OneLane, form_for, grid_size, libdevice

TS, MACHINE_CODE = np.linspace(0.0, 1.0, 5), lagjax.MachineCode()
translated = functools.lru_cache(maxsize=64)(PtxOnCpu)


def transforms_are_new():
    """What was lowered by other rules is forgotten."""
    _primitives.compile_once.cache_clear()
    jax.clear_caches()


@pytest.fixture
def on_the_ptx(monkeypatch):
    """A function that runs another one on the PTX; and then `launches`, the members of each launch."""
    launches = []

    def launch(entry, program, members, arrays, shapes):
        def host(*arrays):
            arrays, outputs = outputs_of(entry, arrays, shapes)
            places = [x.ctypes.data for x in (*arrays, *outputs)]
            launches.append(members)
            for thread in (2, 0, 1):  # the first one takes all members, the others find none
                translated(program).thread(thread, 3, 0, 1, *places)
            assert outputs[0][0] == members + 3, "threads share the counter"
            return outputs[1:]

        results = [jax.ShapeDtypeStruct(shape, float) for shape in shapes]
        return call_host(host, results, *(arrays[name] for name in entry.arguments))

    def run(function, *args):
        places = {
            _primitives.run_p: (_primitives._run_for_gpus, _primitives._run_compiled),
            _primitives.jvp_p: (_primitives._jvp_for_gpus, _primitives._jvp_compiled),
            _primitives.vjp_p: (_primitives._vjp_for_gpus, _primitives._vjp_compiled),
        }

        def register(for_gpus):
            for primitive, (on_gpus, on_cpus) in places.items():
                rule = (
                    mlir.lower_fun(on_gpus, multiple_results=True) if for_gpus else _primitives._lowering_rule(on_cpus)
                )
                mlir.register_lowering(primitive, rule, platform="cpu")
            transforms_are_new()

        register(for_gpus=True)
        try:
            return jax.tree.map(np.asarray, jax.jit(function)(*args))
        finally:
            register(for_gpus=False)

    monkeypatch.setattr(_gpu_launch, "launch", launch)
    run.launches = launches
    return run


def motion(scene, q0, qdot0, ts=TS, params=None, **how):
    """The results of a motion; `scene` may be a system."""
    params = getattr(scene, "params", None) if params is None else params
    system = getattr(scene, "system", scene)
    run = lagjax.simulate(system, q0, qdot0, ts, params, solver=MACHINE_CODE, throw=False, **how)
    return run.q, run.qdot, run.end, run.result._value, run.stats["num_accepted_steps"]


def agree(here, there, tolerance=1e-9):
    for mine, other in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
        scale = max(1.0, np.nanmax(np.abs(np.asarray(other, float)), initial=0.0))
        np.testing.assert_allclose(np.asarray(mine, float), np.asarray(other, float), atol=tolerance * scale, rtol=0)


# ---- the numbers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "form",  # that of its own is unrolled, of a lower order
    [None, *(pytest.param(GpuForm(13, unrolled=x), marks=pytest.mark.slow) for x in (True, False))],
)
def test_a_batch_is_that_of_the_cpu(on_the_ptx, monkeypatch, form):
    scene = scenes.double_pendulum()
    q0 = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 2))
    batch = jax.vmap(lambda q0: motion(scene, q0, 0 * q0, rtol=1e-9))
    if form is not None:
        monkeypatch.setattr("lagjax._native.motions._gpu.form_for", lambda entry, lane, order: form)
    *here, steps = on_the_ptx(batch, q0)
    *there, of_cpu = jax.jit(batch)(q0)
    agree(here, there)
    assert on_the_ptx.launches == [7]
    # A form of its own has a lower order, and more steps of the same error.
    assert (steps > of_cpu).all() if form is None else (steps == of_cpu).all()


def test_coefficients_that_are_few_are_unrolled(monkeypatch):
    programs = {form: program_of(scenes.pendulum(), monkeypatch, form) for form in (True, False)}
    assert ".local" not in programs[True] and ".local" in programs[False]
    few, more, many, large = (
        OneLane("", 0, 4, 0, 8, *of) for of in [(10, False), (21, False), (45, False), (10, True)]
    )
    assert form_for(MOTION, few, 13) == (13, True) and form_for(MOTION, more, 13) == (11, True)
    assert form_for(TRANSPOSE, more, 13) == (9, True)
    assert form_for(MOTION, many, 13) == form_for(MOTION, large, 13) == (13, False)


@pytest.mark.slow
def test_every_member_may_have_its_own_times_and_parameters(on_the_ptx):
    scene = scenes.pendulum()
    params = jax.tree.map(lambda x: jnp.asarray(x) * jnp.linspace(0.5, 1.5, 3), scene.params)
    ends = np.array([1.0, 2.0, -1.0])

    def one(end, params):
        return motion(scene, 1.0, 0.0, end * TS, params)

    agree(on_the_ptx(jax.vmap(one), ends, params), jax.jit(jax.vmap(one))(ends, params))


VANISHING_MASS = lagjax.System(lambda q, qdot: 0.5 * q * qdot**2 - q)


def test_a_failure_has_the_result_of_the_cpu(on_the_ptx):
    scene = scenes.double_pendulum()

    def spent(q0):
        return motion(scene, q0, 0 * q0, 100.0 * TS, max_steps=9)

    def singular(q0):  # a mass that vanishes
        system = VANISHING_MASS
        return motion(system, q0, 0.0)

    for run, start in ((spent, scene.q0), (singular, 0.0)):
        here, there = on_the_ptx(run, start), jax.jit(run)(start)
        assert here[3] == there[3] != 0
        np.testing.assert_array_equal(np.isnan(here[0]), np.isnan(there[0]))


@pytest.mark.slow
def test_an_event_and_its_gradient(on_the_ptx):
    scene = scenes.pendulum()

    def swung(q0):
        run = lagjax.simulate(
            scene.system, q0, 0.0, 3.0 * TS, scene.params, solver=MACHINE_CODE, event=lambda q, qdot: q
        )
        return run.end.t

    agree(on_the_ptx(jax.value_and_grad(swung), 1.0), jax.jit(jax.value_and_grad(swung))(1.0), 1e-7)


def test_constraints(on_the_ptx):
    scene = scenes.cartesian_pendulum()
    here = on_the_ptx(lambda q0: motion(scene, q0, scene.qdot0), scene.q0)
    agree(here, jax.jit(lambda q0: motion(scene, q0, scene.qdot0))(scene.q0))


@pytest.mark.slow
def test_derivatives_with_constraints(on_the_ptx):
    """By starts that leave the constraints, too: those of the nearest ones that do not."""
    scene = scenes.cartesian_pendulum()

    def total(q0, params):
        return jnp.sum(motion(scene, q0, scene.qdot0, params=params)[0][-1])

    def on_circle(angle):
        return total(jnp.array([jnp.sin(angle), -jnp.cos(angle)]), scene.params)

    at = scene.q0, scene.params
    for function, given in (jax.grad(total, (0, 1)), at), (jax.jacfwd(total), at), (jax.hessian(on_circle), (0.6,)):
        agree(on_the_ptx(function, *given), jax.jit(function)(*given), 1e-8)


PIECEWISE = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - jnp.abs(q))


@pytest.mark.slow
def test_borders_of_a_piecewise_scene(on_the_ptx):
    here = on_the_ptx(lambda q0: motion(PIECEWISE, q0, 0.0, 5.0 * TS), 1.0)
    agree(here, jax.jit(lambda q0: motion(PIECEWISE, q0, 0.0, 5.0 * TS))(1.0))


@pytest.mark.slow
def test_derivatives_forward_and_reverse(on_the_ptx):
    scene = scenes.double_pendulum()

    def total(q0, params):
        q, qdot, *_ = motion(scene, q0, 0 * q0, TS, params)
        return jnp.sum(q * jnp.arange(1.0, 6.0)[:, None]) + jnp.sum(qdot[2])

    for derivative in (jax.grad(total, (0, 1)), jax.jacfwd(total, (0, 1))):
        agree(on_the_ptx(derivative, scene.q0, scene.params), jax.jit(derivative)(scene.q0, scene.params), 1e-7)


def swung(q0, scene=None, ts=TS, **how):
    """A number of all outputs of a motion, from rest."""
    scene = scenes.pendulum() if scene is None else scene
    q, qdot, *_ = motion(scene, q0, 0 * q0, ts, **how)
    return jnp.sum(jnp.sin(q) * jnp.arange(1.0, 6.0).reshape(5, *[1] * (q.ndim - 1))) + jnp.sum(qdot[-1])


@pytest.mark.slow
def test_a_gradient_is_one_launch_for_all_members(on_the_ptx):
    """Compiles a pendulum's motion, transpose and tangents, as the two tests below."""
    q0 = np.linspace(0.3, 2.8, 9)
    gradient = jax.vmap(jax.grad(swung))
    agree(on_the_ptx(gradient, q0), jax.jit(gradient)(q0), 1e-7)
    assert on_the_ptx.launches == [9, 9]  # the motion itself, and there and back


@pytest.mark.slow
def test_members_whose_steps_do_not_do_take_tangents(on_the_ptx, monkeypatch):
    """At rest a pendulum takes steps that its tangents cannot; and there may be no room for all steps."""
    gradient, rest = jax.vmap(jax.grad(swung)), np.array([0.0, 0.5, 1.0])
    agree(on_the_ptx(gradient, rest), jax.jit(gradient)(rest), 1e-7)
    assert sorted(on_the_ptx.launches) == [3, 3, 15]  # tangents by two states and three parameters of each
    on_the_ptx.launches.clear()
    monkeypatch.setattr("lagjax._native.motions._gpu.LARGEST_RECORD", 64 * 5 * 6)  # five steps
    agree(on_the_ptx(gradient, rest + 1.0), jax.jit(gradient)(rest + 1.0), 1e-7)
    assert sorted(on_the_ptx.launches) == [3, 3, 15]


@pytest.mark.parametrize("of", [pytest.param("outputs", marks=pytest.mark.slow), "end"])
def test_gradients_of_motions_that_fail_are_those_of_the_cpu(on_the_ptx, of):
    q0, far = np.array([0.01, 2.0]), 20.0 * TS

    def of_outputs(q0):
        q = motion(scenes.pendulum(), q0, 0.0, far, max_steps=30, rtol=1e-9)[0]
        return jnp.sum(jnp.where(jnp.isfinite(q), q, 0.0))

    def of_end(q0):
        return motion(scenes.pendulum(), q0, 0.0, far, max_steps=30, rtol=1e-9)[0][-1]

    gradient = jax.vmap(jax.grad(of_end if of == "end" else of_outputs))
    here, there = on_the_ptx(gradient, q0), jax.jit(gradient)(q0)
    np.testing.assert_array_equal(np.isnan(here), np.isnan(there))
    agree(here, there, 1e-6)
    assert np.isnan(there).any() == (of == "end")


FALLING = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - jnp.abs(q))
QUARTIC = lagjax.System(lambda q, v: 0.5 * v**2 - q**4)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["few", "many", "no numbers", "borders", "in memory", "own times"])
def test_transposes(on_the_ptx, case):
    chain, pendulum, ends = scenes.chain(4), scenes.pendulum(), np.arange(-1.0, 2.0)  # back, not at all, and on
    derivative, given = {
        "few": (jax.jacrev(lambda q0: motion(pendulum, q0, 0.0)[0][1:3]), (1.0,)),
        "many": (jax.jacrev(lambda q0: motion(pendulum, q0, 0.0)[0]), (1.0,)),
        "no numbers": (jax.grad(lambda q0: swung(q0, QUARTIC)), (1.0,)),
        "borders": (jax.grad(lambda q0: swung(q0, FALLING, 5.0 * TS)), (1.0,)),
        "in memory": (jax.grad(lambda q0, p: swung(q0, chain, params=p), (0, 1)), (chain.q0, chain.params)),
        "own times": (jax.vmap(jax.grad(lambda q0, end: swung(q0, ts=end * TS), (0, 1))), (np.ones(3), ends)),
    }[case]  # fmt: skip
    agree(on_the_ptx(derivative, *given), jax.jit(derivative)(*given), 1e-7)


@pytest.mark.slow
def test_second_derivatives(on_the_ptx):
    scene = scenes.pendulum()
    second = jax.hessian(lambda q0: motion(scene, q0, 0.0)[0][-1])
    agree(on_the_ptx(second, 1.0), jax.jit(second)(1.0), 1e-6)


def test_single_precision(on_the_ptx):
    scene = scenes.double_pendulum()
    q0 = np.asarray(scene.q0, np.float32)
    params = jax.tree.map(np.float32, scene.params)

    def single(q0):
        return motion(scene, q0, 0 * q0, TS.astype(np.float32), params)[:2]

    here, there = on_the_ptx(single, q0), jax.jit(single)(q0)
    assert here[0].dtype == np.float32
    agree(here, there, 1e-6)


def singles(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, np.float32), tree)


def in_single(scene, q0, ts=TS, **how):
    """A motion of float32: its states, and its result."""
    q0, qdot0, ts, params = singles((q0, scene.qdot0, ts, scene.params))
    run = lagjax.simulate(scene.system, q0, qdot0, ts, params, solver=MACHINE_CODE, throw=False, **how)
    return run.q, run.qdot, run.result._value


DRIVEN_IN_TIME = lagjax.System(lambda q, qdot, t, params: 0.5 * qdot**2 + q * jnp.cos(params["w"] * t))


def test_the_time_of_single_precision_is_a_double(on_the_ptx):
    """After a thousand turns of the drive it has four digits as a float: the force would be wrong by a hundredth."""
    scene = SimpleNamespace(system=DRIVEN_IN_TIME, qdot0=0.0, params={"w": 3.7})

    def driven(q0):
        return in_single(scene, q0, 2000.0 + TS)[:2]

    agree(on_the_ptx(driven, np.float32(0.0)), jax.jit(driven)(np.float32(0.0)), 1e-6)


@pytest.mark.slow
def test_derivatives_of_single_precision(on_the_ptx):
    scene = scenes.pendulum()

    def end(q0):
        return jnp.sum(in_single(scene, q0)[0] * jnp.arange(5.0, dtype=np.float32))

    q0 = np.float32([0.3, 1.0, 2.5])
    for derivative in (jax.vmap(jax.grad(end)), jax.vmap(jax.jacfwd(end))):
        agree(on_the_ptx(derivative, q0), jax.jit(derivative)(q0), 1e-5)
    assert on_the_ptx.launches == [3, 3, 3]  # the motion, there and back; and the motion with its tangents


WEDGE = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - jnp.abs(q))


@pytest.mark.slow
def test_borders_and_events_are_found_in_doubles(on_the_ptx):
    wedge = WEDGE
    wedge = SimpleNamespace(system=wedge, qdot0=0.0, params=None)

    def to_event(q0):
        ts, q0 = singles((3.0 * TS, q0))
        how = dict(solver=MACHINE_CODE, event=lambda q, qdot: q)
        return lagjax.simulate(scenes.pendulum().system, q0, 0 * q0, ts, singles(scenes.pendulum().params), **how).end.t

    for function in (lambda q0: in_single(wedge, q0, 5.0 * TS)[0], to_event):
        agree(on_the_ptx(function, np.float32(1.0)), jax.jit(function)(np.float32(1.0)), 2.0**-23)


def program_of(scene, monkeypatch=None, unrolled=None):
    """The PTX of a scene's motion. Skips the test where libdevice is needed and not here."""
    programs = []
    if monkeypatch is not None:
        monkeypatch.setattr("lagjax._native.motions._gpu.form_for", lambda entry, lane, order: GpuForm(order, unrolled))
    transforms_are_new()

    def launch(entry, program, members, arrays, shapes):
        programs.append(program)
        return [jnp.zeros(shape) for shape in shapes]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_gpu_launch, "launch", launch)
        try:
            q0, qdot0, ts, params = jax.tree.map(jnp.asarray, (scene.q0, scene.qdot0, TS, scene.params))
            jax.jit(lambda q0: motion(scene, q0, qdot0, ts, params)[0]).trace(q0).lower(lowering_platforms=("cuda",))
        except ValueError as reason:
            if "a CPU is the better choice" in str(reason):
                assert scene.q0 is not None and len(jax.flatten_util.ravel_pytree(scene.q0)[0]) > 20, reason
                pytest.skip(str(reason))
            if libdevice() is None and "libdevice" in str(reason):
                pytest.skip(str(reason))
            raise
        finally:
            transforms_are_new()
    return programs[0]


@pytest.mark.slow
@pytest.mark.parametrize("make", scenes.ALL[1::8], ids=lambda make: make.__name__)
def test_every_eighth_ready_scene(make, on_the_ptx):
    scene = make()
    if "begin inline asm" in program_of(scene):
        pytest.skip("libdevice has assembly of its own for a tangent, which is not translated")
    function = jax.jit(lambda q0: motion(scene, q0, scene.qdot0)[:4])
    agree(on_the_ptx(lambda q0: motion(scene, q0, scene.qdot0)[:4], scene.q0), function(scene.q0), 1e-8)


ONE_OF_A_KIND = (
    scenes.chain, scenes.spherical_pendulum, scenes.driven_pendulum, scenes.fermi_pasta_ulam, scenes.kepler,
    scenes.cartesian_double_pendulum, scenes.rolling_disc, scenes.slider_crank, scenes.swinging_atwood,
    scenes.relativistic_charge_in_electric_field,
)  # fmt: skip


# ---- the lowering ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "count"),
    [
        (np.float64, 3),
        pytest.param(np.float32, None, marks=pytest.mark.slow),
        pytest.param(np.float64, None, marks=pytest.mark.slow),
    ],
)
def test_the_lowering_launches_and_calls_nothing_else(dtype, count):
    scene = scenes.pendulum()
    params = jax.tree.map(dtype, scene.params)

    def one(q0, **how):
        ts = TS.astype(dtype)
        return lagjax.simulate(scene.system, q0, 0 * q0, ts, params, solver=MACHINE_CODE, throw=False, **how).q[-1]

    def to_event(q0):
        return one(q0, event=lambda q, qdot: q)

    def repeated(q0):
        return jax.lax.scan(lambda q, _: (one(q), q), q0, length=3)

    one_member, many, over = dtype(1), np.ones(1000, dtype), P("members")
    mesh = AbstractMesh((4,), ("members",))
    on_four_gpus = jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=over, out_specs=over)
    # A gradient needs the motion itself, its transpose, and tangents where the steps of that do not do.
    every = (
        (jax.vmap(one), many, 1), (jax.vmap(jax.grad(one)), many, 3), (on_four_gpus, many, 1), (one, one_member, 1),
        (jax.grad(one), one_member, 3), (to_event, one_member, None), (jax.hessian(one), one_member, None),
        (repeated, one_member, 1),
    )  # fmt: skip
    for function, q0, calls in every[:count]:
        text = jax.export.export(jax.jit(function), platforms=["cuda"], disabled_checks=[
            jax.export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.ptx")])(q0).mlir_module()  # fmt: skip
        assert "callback" not in text
        targets = [line for line in text.splitlines() if "custom_call @" in line]
        assert targets and all("@__gpu$xla.gpu.ptx" in line for line in targets)
        assert calls is None or len(targets) == calls


def test_the_grid_covers_the_members_and_is_bounded():
    assert grid_size(MOTION, 1) == (1, 64) and grid_size(MOTION, 65) == (2, 64)
    assert grid_size(MOTION, 10**8) == (528, 64) and grid_size(TRANSPOSE, 10**8) == (264, 64)


def test_words_are_the_bits_of_doubles():
    given = MOTION.words(members=3, times=2, ts_stride=0, params_stride=0, max_steps=9, room_of_notes=0, rtol=0.5,
                  atol=0.0)  # fmt: skip
    assert given[:2] == [3, 2] and np.array(given[-2:]).view(float).tolist() == [0.5, 0.0]
    assert MOTION.aliases == {4: 0, 5: 1}  # the counter and the path are written to where they are


def test_a_scene_that_cannot_go_to_a_gpu_says_why():
    knots = np.linspace(0.0, 1.0, 4)
    system = lagjax.System(lambda q, qdot, t: 0.5 * qdot**2 - q * jnp.interp(t, knots, knots**2))

    def function(q0):
        return lagjax.simulate(system, q0, 0.0, TS, solver=MACHINE_CODE, throw=False).q

    with pytest.raises(ValueError, match="on a GPU: its tables of numbers"):
        jax.jit(function).trace(1.0).lower(lowering_platforms=("cuda",))


@pytest.mark.slow
def test_instructions_are_counted(monkeypatch):
    monkeypatch.setattr(
        "lagjax._native.motions._gpu.form_for", lambda entry, lane, order: GpuForm(order, unrolled=False)
    )
    # Of a pendulum's step at order 13: every product of two series of 13 terms alone has 91 products.
    gpu_estimate = importlib.import_module("benchmarks.gpu_estimate")
    counted = gpu_estimate.counted(gpu_estimate.Run(scenes.pendulum()))
    assert counted.program.count(".entry") == 1 and 10 < counted.steps < 200
    once = counted.a_step
    assert 300 < once["float64"] < 3000 and 0 < once["local stores"] < once["local loads"] < 3000
    thread = {"registers": 128, "stack": 4096, "spills": 0}
    more = counted._replace(a_step={name: 2 * count for name, count in once.items()})
    twice = gpu_estimate.bounds(more, thread)
    for name, bound in gpu_estimate.bounds(counted, thread).items():
        assert twice[name] == pytest.approx(2 * bound) and bound > 0


# ---- assembled -------------------------------------------------------------------------------------------------------


def ptxas():
    found = (file for folder in sys.path for file in Path(folder or ".").glob("nvidia/*/bin/ptxas"))
    return next(found, None)


# The most that a ready scene takes on any of these processors; a thread has 255 registers at most.
STACK, SPILLS = 40_000, 4_000


def assembled(program, folder):
    """The bytes of stack and of spills of a program on each processor."""
    source = folder / "k.ptx"
    source.write_text(program)
    for processor in ("sm_80", "sm_90", "sm_120"):
        command = [ptxas(), "-v", "-arch", processor, source, "-o", folder / "k.cubin"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        report = done.stdout + done.stderr
        stack, *spills = (int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", report))
        yield stack, max(spills)


@pytest.mark.slow
@pytest.mark.skipif(ptxas() is None, reason="there is no ptxas: the extra `ptxas` has it")
@pytest.mark.parametrize("make", (*ONE_OF_A_KIND, scenes.andrews_squeezer), ids=lambda make: make.__name__)
def test_ptxas_assembles_a_scene_of_every_kind(make, tmp_path):
    assert all(stack <= STACK and spills <= SPILLS for stack, spills in assembled(program_of(make()), tmp_path))


PRELUDE = """
import sys
import diffrax, jax, jax.numpy as jnp, numpy as np, lagjax

jax.config.update("jax_enable_x64", True)
"""

# ---- on a GPU --------------------------------------------------------------------------------------------------------

COMPUTED = (
    PRELUDE
    + """
scene, cpu = lagjax.scenes.double_pendulum(), jax.devices("cpu")[0]
q0 = np.random.default_rng(0).uniform(-1.0, 1.0, (512, 2))
ts = np.linspace(0.0, 5.0, 11)

def batch(q0=q0, **how):
    return lagjax.simulate_batch(scene.system, q0, 0 * q0, ts, scene.params, **how)

def on_cpu(function, *args, **how):
    with jax.default_device(cpu):
        return function(*args, **how)

def double_precision():
    run, truth = batch(rtol=1e-10, atol=1e-10), on_cpu(batch, rtol=1e-13, atol=1e-13)
    assert {device.platform for device in run.q.devices()} == {"gpu"} and run.ok.all()
    assert {device.platform for device in truth.q.devices()} == {"cpu"}
    # Small angles: nothing grows, so that errors are a few dozen tolerances.
    assert np.abs(np.asarray(run.q) - np.asarray(truth.q)).max() < 1e-7

def single_precision():
    run = batch(q0.astype(np.float32), solver=diffrax.Tsit5(), rtol=1e-5, atol=1e-5)
    assert run.q.dtype == np.float32 and {device.platform for device in run.q.devices()} == {"gpu"}
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 1e-2

def gradient():
    def end(q0, params):
        return lagjax.simulate(scene.system, q0, 0 * q0, ts, params, rtol=1e-10, atol=1e-10).q[-1].sum()

    derivatives = jax.jit(jax.grad(end, argnums=(0, 1)))
    here = jax.tree.leaves(derivatives(q0[0], scene.params))
    there = jax.tree.leaves(on_cpu(derivatives, q0[0], scene.params))
    for mine, other in zip(here, there, strict=True):
        assert mine.devices().pop().platform == "gpu"
        np.testing.assert_allclose(np.asarray(mine), np.asarray(other), rtol=1e-6)

def constraint():
    scene = lagjax.scenes.cartesian_pendulum()

    def end():
        return lagjax.simulate(scene.system, scene.q0, scene.qdot0, ts, scene.params).end

    for mine, other in zip(jax.tree.leaves(end()), jax.tree.leaves(on_cpu(end)), strict=True):
        np.testing.assert_allclose(np.asarray(mine), np.asarray(other), atol=1e-6)

def the_default():
    run = batch()
    assert run.engine == "MachineCode" and {device.platform for device in run.q.devices()} == {"gpu"}
    # Equal to diffrax on the GPU and to machine code on the CPU, each at its own steps.
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 2e-8
    single = lagjax.simulate(scene.system, q0[0], 0 * q0[0], ts, scene.params)
    np.testing.assert_allclose(np.asarray(single.q), np.asarray(run.q[0]), rtol=0, atol=1e-12)
    chain = lagjax.scenes.chain(60)  # more than a thread remembers
    assert "diffrax" in str(chain.system.explain(chain.q0, chain.qdot0, params=chain.params))

def a_member_that_fails():
    fall = lagjax.System(lambda q, v: 0.5 * v**2 + 1 / q)  # onto a centre, which a motion from rest meets
    q0 = np.array([1.0, np.nan, 1.0])
    run = lagjax.simulate_batch(fall, q0, np.array([2.0, 0.0, 0.0]), np.linspace(0.0, 3.0, 4))
    assert run.ok.tolist() == [True, False, False] and np.isnan(np.asarray(run.q[1])).all()
    sound = on_cpu(lagjax.simulate, fall, 1.0, 2.0, np.linspace(0.0, 3.0, 4))
    np.testing.assert_allclose(np.asarray(run.q[0]), np.asarray(sound.q), atol=1e-8)

def borders_and_events():
    block = lagjax.System(
        lambda q, v, params: 0.5 * v**2 - 0.5 * q**2, forces=lambda q, v, params: -params * jnp.sign(v)
    )

    def end(q0, v0, params):
        return lagjax.simulate(block, q0, v0, ts, params, event=lambda q, v: q + 0.3).end.q

    def stop(q0, v0, params):
        return lagjax.simulate(block, q0, v0, ts, params, event=lambda q, v: q + 0.3).end.t

    def rest(q0, v0, params):
        return lagjax.simulate(block, q0, v0, jnp.array([0.0, 9.0]), params).q[-1]

    for function in (end, stop, rest):
        derivatives = jax.jit(jax.vmap(jax.value_and_grad(function, (0, 1, 2)), (0, None, None)))
        starts = np.linspace(1.0, 1.5, 8), 0.2, 0.1
        pairs = zip(jax.tree.leaves(derivatives(*starts)), jax.tree.leaves(on_cpu(derivatives, *starts)), strict=True)
        for mine, other in pairs:
            assert mine.devices().pop().platform == "gpu"
            np.testing.assert_allclose(np.asarray(mine), np.asarray(other), rtol=1e-6, atol=1e-8)

def derivatives_with_constraints():
    scene = lagjax.scenes.cartesian_pendulum()

    def end(speed):
        qdot0 = jax.tree.map(lambda x: x * speed, scene.qdot0)
        run = lagjax.simulate(scene.system, scene.q0, qdot0, ts[:3], scene.params)
        return sum(x.sum() for x in jax.tree.leaves((run.end.q, run.end.qdot)))

    for function in (jax.grad(end), jax.grad(jax.grad(end))):
        function = jax.jit(function)
        np.testing.assert_allclose(np.asarray(function(1.1)), np.asarray(on_cpu(function, 1.1)), rtol=1e-5)

def hybrid_motion():
    bounce = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=lambda q, v: (q, -0.8 * v))
    ball = lagjax.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q)

    def run():
        return lagjax.simulate(lagjax.Hybrid({"flight": ball}, [bounce], "flight"), 1.0, 0.0, ts[:3])

    try:
        run()
    except ValueError as error:
        assert "chooses a CPU" in str(error)
    else:
        raise AssertionError("hybrid motion ran on a GPU")
    assert on_cpu(run).ok

def machine_code_under_a_device_of_choice():
    run = batch(solver=lagjax.MachineCode())
    assert {device.platform for device in run.q.devices()} == {"gpu"}
    # Series of another order: both are some ten tolerances off.
    assert np.abs(np.asarray(run.q) - np.asarray(on_cpu(batch).q)).max() < 2e-8
    run = on_cpu(jax.jit(lambda q0: batch(q0, solver=lagjax.MachineCode()).q), q0)
    np.testing.assert_array_equal(np.asarray(run), np.asarray(on_cpu(batch).q))

for name in sys.argv[1:]:
    globals()[name]()
"""
)


@pytest.mark.skipif(shutil.which("nvidia-smi") is None, reason="there is no NVIDIA GPU")
@pytest.mark.parametrize(
    "name",
    [
        "double_precision",
        "single_precision",
        "gradient",
        "constraint",
        "the_default",
        "a_member_that_fails",
        "borders_and_events",
        "derivatives_with_constraints",
        "hybrid_motion",
        "machine_code_under_a_device_of_choice",
    ],
)
def test_on_a_gpu(name):
    run_apart(COMPUTED, name, JAX_PLATFORMS="cuda,cpu", XLA_PYTHON_CLIENT_PREALLOCATE="false")


# ---- diffrax for a GPU -----------------------------------------------------------------------------------------------

# No call of the host is in it, if equinox is told not to raise from inside a program. It reads that from the
# environment as it is imported. Otherwise two calls remain, outside of all loops: diffrax looks whether the output
# times are in order, which `simulate` has seen to already.
LOWERED = (
    PRELUDE
    + """
pendulum = lagjax.System(lambda q, qdot, params: 0.5 * qdot**2 + params * jax.numpy.cos(q))
ts, how = np.linspace(0.0, 1.0, 3), {"solver": diffrax.Tsit5(), "max_steps": 64}

def motion(q0, k):
    run = lagjax.simulate(pendulum, q0, 0 * q0, ts, k, throw=False, **how)
    return run.q, run.result._value

def batch(q0, k):
    run = lagjax.simulate_batch(pendulum, q0, 0 * q0, ts, k, **how)
    return run.q, run.result._value

def gradient(q0, k):
    return jax.grad(lambda q0, k: motion(q0, k)[0][-1], argnums=(0, 1))(q0, k)

for function, dtype, shape in ((motion, np.float64, ()), (gradient, np.float64, ()), (batch, np.float32, 8)):
    q0, k = np.ones(shape, dtype), dtype(9.81)
    exported = jax.export.export(jax.jit(function), platforms=["cuda", "cpu"])(q0, k)
    assert exported.platforms == ("cuda", "cpu") and exported.out_avals[0].dtype == dtype
    for mine, other in zip(exported.call(q0, k), jax.jit(function)(q0, k), strict=True):
        np.testing.assert_allclose(mine, other, rtol=10 * np.finfo(dtype).eps)  # compiled twice
    text = exported.mlir_module()
    assert "stablehlo.while" in text and "callback" not in text, function.__name__
"""
)


@pytest.mark.slow
def test_lowering_without_a_call_of_the_host():
    run_apart(LOWERED, EQX_ON_ERROR="nan")


def run_apart(program: str, *arguments: str, **environment: str):
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
