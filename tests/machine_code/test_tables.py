"""Kernels as tables against kernels that are written down operation by operation: the same numbers by both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax
from lagjax import _native
from lagjax._equations import derivation_of, numbers_of
from lagjax._interface import Layout
from lagjax._native.motions._integrator import Integrator
from lagjax._native.series import _schedule, _taylor
from lagjax._native.series._motion_parts import MotionParts
from lagjax._program import OPERATIONS, Unlowerable
from lagjax._tracing import lower

MEMBERS, RTOL, ROOM = 3, 1e-9, 300
# Every operation is rounded as often in both forms. But of two products in a sum the processor rounds one with the sum,
# and which one LLVM takes depends on what stands around them: that is round-off of some hundred operations of a step,
# which a motion of some hundred steps carries along.
ROUND_OFF = 1e-11


def in_all_forms(*parts, **options):
    """A kernel written down operation by operation, one as tables, and one as tables of a single lane."""
    for border, width in ((10**9, None), (-1, None), (-1, 1)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_taylor, "LARGEST_LINE", border)
            kernel = _native.Kernel(*parts, **options, width=width)
            if width is None:
                kernel._backward  # noqa: B018  (compiled in the same form)
            else:
                kernel._forward  # noqa: B018
        yield kernel


def run_and_back(kernel, ts, y0, params):
    """A run, and the cotangents of its start and of the parameters, from those of its outputs and its end."""
    run = kernel(ts[None], y0, params, RTOL, 1e-3 * RTOL, 10_000, ROOM * len(y0))
    counts = np.where(run.complete, run.steps, 0)
    first = np.cumsum(counts) - counts
    cotangents = np.random.default_rng(0).normal(size=run.path.shape), np.ones_like(y0)
    record = _native.Steps(run.table, first, counts, _native.choose_order(RTOL))
    return run, kernel.vjp(ts[None], params, record, *cotangents)


def assert_same(kernels, ts, y0, params):
    by_line, by_table, alone = kernels
    (written, back), (table, back_by_table) = (run_and_back(kernel, ts, y0, params) for kernel in (by_line, by_table))
    one_by_one = alone(ts[None], y0, params, RTOL, 1e-3 * RTOL, 10_000)
    np.testing.assert_array_equal(one_by_one.steps, table.steps)
    np.testing.assert_array_equal(one_by_one.code, table.code)
    np.testing.assert_allclose(one_by_one.path, table.path, rtol=0, atol=ROUND_OFF * np.nanmax(abs(table.path)))
    np.testing.assert_array_equal(table.code, written.code)
    np.testing.assert_array_equal(table.steps, written.steps)
    np.testing.assert_allclose(table.path, written.path, rtol=0, atol=ROUND_OFF * np.nanmax(abs(written.path)))
    for tabled, expected in zip(back_by_table, back, strict=True):
        if expected.size:
            np.testing.assert_allclose(tabled, expected, rtol=0, atol=ROUND_OFF * np.nanmax(abs(expected)))


# Two by default; the others in the slow part. Written down, the solar system takes LLVM six minutes, which nobody runs:
# as a table it is held to JPL's ephemeris.
QUICK = ("double_pendulum", "driven_pendulum")


@pytest.mark.parametrize(
    "scene",
    [pytest.param(scene, id=scene.__name__, marks=() if scene.__name__ in QUICK else pytest.mark.slow)
     for k, scene in enumerate(lagjax.scenes.ALL) if scene.__name__ in QUICK or k % 4 == 0],
)  # fmt: skip
def test_ready_scenes(scene):
    made = scene()
    layout = Layout.from_state(made.q0, made.qdot0)
    derivation = derivation_of(made.system, layout, made.params)
    try:
        parts = derivation.accelerations.program, layout.size, derivation.accelerations.projection
    except Unlowerable as reason:
        pytest.skip(str(reason))
    params = np.array([numbers_of(made.params)], float)
    y0 = np.concatenate([layout.flatten(made.q0), layout.flatten(made.qdot0)])
    assert_same(in_all_forms(*parts), np.linspace(0.0, 1.0, 4), np.tile(y0, (MEMBERS, 1)), params)


@pytest.mark.slow
def test_piecewise_operations_parameters_that_are_integers_and_guards():
    def acceleration(q, v, t, k, n):
        wall = jnp.maximum(-q[0], 0) ** 1.5 - jnp.minimum(q[0], 1) * jnp.where((q[1] > 0.3) | ~(v[0] < 0), k, 0.5)
        turned = jnp.sin(jnp.mod(q[1], 2.0)) * jnp.cos(q[1]) / (1 + abs(v[1])) + jnp.tanh(v[0]) + n * jnp.cos(t)
        return wall, -turned, False

    shapes = np.ones(2), np.ones(2), 1.0
    program = lower(acceleration, *shapes, 1.0, 2)

    def value(q, v, t, k, n):
        return q[0] * q[1] - 0.7

    def guards(q, v, t, k, n):
        g = value(q, v, t, k, n)
        return g, v[0] * q[1] + q[0] * v[1], abs(g) + 1.4, abs(v[0] * q[1]) + abs(q[0] * v[1])

    events = _native.Guards(lower(value, *shapes, 1.0, 2), lower(guards, *shapes, 1.0, 2), (0,))
    y0 = np.random.default_rng(1).uniform(-0.5, 0.5, (MEMBERS, 4)) + np.array([0.5, 0.5, 0, 0])
    kernels = list(in_all_forms(program, 2, guards=events))
    assert_same(kernels, np.linspace(0.0, 2.0, 5), y0, np.array([[2.0, 1.0]]))
    for kernel in kernels[1:]:
        codes = kernel(np.array([[0.0, 9.0]]), y0, np.array([[2.0, 1.0]]), RTOL, RTOL, 10_000).code
        assert (codes >= _native.EVENT).any()


# ---- the order in which a table runs --------------------------------------------------------------------------------


def everything(x, y, s):
    """Sums and products in long chains, several results of one node, outputs that are inputs, numbers, or alike."""
    for k in range(12):
        x, y = x + y * jnp.cos(x) - jnp.roll(y, k) * jnp.roll(x, 1), (x - y / (2.0 + x * x)) * s
    angle = jnp.sum(x)
    return x, y, s, jnp.cos(angle), jnp.where(x[0] > 0, x, y), x[0] > y[0], jnp.ones(2), jnp.sqrt(1 + y * y), x[:2]


@pytest.mark.parametrize("stored", [0, 9, 30])
def test_a_schedule_computes_the_program(stored):
    program = lower(everything, np.ones(7), np.ones(7), 1.0)
    numbers = np.random.default_rng(0).uniform(0.5, 1.5, 15)
    plan, memory = _schedule.schedule(program.line, stored), {}
    count, nodes = len(program.line.outputs), len(program.line.nodes)
    node_at = {nodes + k: ("slot", plan.size + k) for k in range(count)}  # what is stored, behind the slots
    node_at |= {node: ("slot", slot) for node, slot in plan.slots.items()}
    for node, position in plan.inputs.items():
        node_at[node] = "input", position
        memory[node_at[node]] = numbers[position]
    for node, number in plan.constants.items():
        node_at[node] = "constant", node
        memory[node_at[node]] = number

    def results(kind, operands):
        xs = [next(operands) if part is None else results(part, operands)[0] for part in kind.parts]
        if kind.op in ("copy", "store"):
            return xs
        if kind.op == "sincos":
            return [np.sin(xs[0]), np.cos(xs[0])]
        return [OPERATIONS[kind.op].value(*xs, *(() if kind.attribute is None else (kind.attribute,)))]

    for group in plan.groups:
        made = {}  # a group may read all before it writes any
        for kind, operands, nodes in group:
            values = results(plan.kinds[kind], iter([memory[node_at[x]] for x in operands]))
            made |= {node_at[x]: value for x, value in zip(nodes, values, strict=True) if x >= 0}
        memory |= made
    found = [memory["slot", k if k < plan.staying else plan.size + k] for k in range(count)]
    assert plan.staying == count - stored
    np.testing.assert_allclose(np.array(found, float), np.array(program.evaluate(*numbers), float), rtol=1e-14)
    assert plan.size < len(program.line.nodes) / 2  # slots are used again


def test_what_comes_often_is_one_operation():
    program = lower(everything, np.ones(7), np.ones(7), 1.0)
    plan = _schedule.schedule(program.line, 0)
    done = [operation for group in plan.groups for operation in group]
    assert len(done) < 0.8 * program.operations
    assert max(plan.kinds[operation.kind].operands for operation in done) > 3
    alike = sum(len(group) for group in plan.groups if len(group) >= 4)
    assert alike > 0.5 * len(done)


# ---- size -----------------------------------------------------------------------------------------------------------


def instructions(acceleration, size):
    """How many instructions the kernel of q̈ = `acceleration(q, v, t)` has, as tables."""
    states = jax.ShapeDtypeStruct((size,), float)
    program = lower(lambda q, v, t: (acceleration(q, v, t), False), states, states, 1.0)
    parts = MotionParts.from_program(program, size).append_guards(_native.Nesting(size), None, program)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_taylor, "LARGEST_LINE", -1)
        functions = Integrator(parts, width=8).motion.module.functions
    return sum(len(block.instructions) for function in functions for block in function.blocks)


def test_the_code_of_a_table_does_not_grow_with_the_scene():
    """Thirty times the pairs of bodies: the tables are longer, and the code is the same but for a few kinds."""

    def of_bodies(count):
        i, j = np.triu_indices(count, 1)

        def acceleration(q, v, t):
            distance = jnp.sqrt(jnp.sum((q.reshape(count, 2)[i] - q.reshape(count, 2)[j]) ** 2, axis=1) + 0.1)
            pull = (q.reshape(count, 2)[i] - q.reshape(count, 2)[j]) / distance[:, None] ** 3
            return jnp.zeros((count, 2)).at[i].add(-pull).at[j].add(pull).ravel()

        return instructions(acceleration, 2 * count)

    small, large = of_bodies(4), of_bodies(20)
    assert large < 1.5 * small


def test_the_code_of_narrow_features_does_not_grow_with_their_number():
    """Ten times the bonds, each with an exponential that is examined along every step."""

    def of_chain(count):
        def acceleration(q, v, t):
            pull = jnp.exp(q - jnp.roll(q, -1))
            return jnp.roll(pull, 1) - pull

        return instructions(acceleration, count)

    assert of_chain(60) < 1.5 * of_chain(6)


@pytest.mark.parametrize("count", [32, 80])  # written down, and as tables
def test_a_soliton_of_the_toda_lattice(count):
    """qₙ = ln [cosh(κ (n − 1) − β t) / cosh(κ n − β t)], β = sinh κ (Toda, Phys. Rep. 18 (1975) 1), between walls.

    These are so far away that it comes to them as e^(−2 κ 12) at most.
    """
    kappa = 1.0

    def soliton(t):
        n = np.arange(-1, count + 1) - count / 2
        return np.log(np.cosh(kappa * (n - 1) - np.sinh(kappa) * t) / np.cosh(kappa * n - np.sinh(kappa) * t))

    left, *_, right = soliton(0.0)

    def lattice(q, qdot):
        q = jnp.concatenate([jnp.array([left]), q, jnp.array([right])])
        return 0.5 * jnp.sum(qdot**2) - jnp.sum(jnp.exp(q[:-1] - q[1:]))

    h = 1e-3
    rate = (np.array([1, -8, 8, -1]) / (12 * h)) @ np.stack([soliton(x * h) for x in (-2, -1, 1, 2)])  # to 1e-13
    run = lagjax.simulate(lagjax.System(lattice), soliton(0.0)[1:-1], rate[1:-1], np.array([0.0, 2.0]), rtol=1e-12)
    np.testing.assert_allclose(run.q[-1], soliton(2.0)[1:-1], atol=1e-9)
