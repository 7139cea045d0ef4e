"""Large scenes of one member alone: alike operations of one program in the lanes of vectors."""

import gc
import itertools
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax import _native
from lagjax._native import _kernel, _packed, _packs, _schedule, _taylor
from lagjax._native._packs import ANYWHERE, ONE, SIDE_BY_SIDE
from lagjax._program import OPERATIONS, lower

LANES = 8


def everything(x, y, s):
    """Sums and products in long chains, several results of one node, outputs that are inputs, numbers, or alike."""
    for k in range(12):
        x, y = x + y * jnp.cos(x) - jnp.roll(y, k) * jnp.roll(x, 1), (x - y / (2.0 + x * x)) * s
    angle = jnp.sum(x)
    return x, y, s, jnp.cos(angle), jnp.where(x[0] > 0, x, y), x[0] > y[0], jnp.ones(2), jnp.sqrt(1 + y * y), x[:2]


def cluster(count):
    """The accelerations of so many bodies in a plane that attract each other."""
    i, j = np.triu_indices(count, 1)

    def acceleration(q, v, t):
        d = q.reshape(count, 2)[i] - q.reshape(count, 2)[j]
        pull = d / jnp.sqrt(jnp.sum(d**2, axis=1) + 0.1)[:, None] ** 3
        return jnp.zeros((count, 2)).at[i].add(-pull).at[j].add(pull).ravel(), False

    states = jax.ShapeDtypeStruct((2 * count,), float)
    return lower(acceleration, states, states, 1.0)


def lanes_of(run, memory):
    """What every operand of a run reads, (m, lanes) for each vector."""
    vectors = -(-run.count // LANES)
    for first in range(0, vectors * LANES, LANES):
        at = first + np.arange(LANES)
        yield at, [
            memory[np.pad(x, (0, vectors * LANES - run.count), mode="edge")[at]] if mode == ANYWHERE
            else memory[x + at] if mode == SIDE_BY_SIDE else np.full(LANES, memory[x])
            for x, mode in zip(run.operands, run.modes, strict=True)
        ]  # fmt: skip


def results(kind, operands):
    xs = [next(operands) if part is None else results(part, operands)[0] for part in kind.parts]
    if kind.op == "sincos":
        return [np.sin(xs[0]), np.cos(xs[0])]
    xs = [x != 0 if of == "bool" else x for x, of in zip(xs, kind.kinds, strict=True)]
    return [OPERATIONS[kind.op].value(*xs, *(() if kind.attribute is None else (kind.attribute,)))]


def computed(line, numbers, few_modes):
    """The outputs of a program by its runs, vector by vector, in a memory that is used again; and the runs."""
    kinds, operations = _schedule.join_operations(line)
    kinds, program = kinds.all, _packs.stages(operations, len(line.nodes), line.outputs)
    memory, places, after = np.full(100_000, np.nan), np.full(len(line.nodes), -1), itertools.count(10)
    for node, (op, _, attribute) in enumerate(line.nodes):
        if op in ("input", "constant"):
            places[node] = next(after)
            memory[places[node]] = numbers[attribute] if op == "input" else attribute
    plan = _packs.arrangement(program, places, 2000, LANES)
    runs = _packs.limit_modes(plan.runs, LANES) if few_modes else plan.runs
    with np.errstate(all="ignore"):  # lanes beyond the last operation hold anything
        for run in runs:
            for at, operands in lanes_of(run, memory):
                for begin, x in zip(run.results, results(kinds[run.kind], iter(operands)), strict=True):
                    memory[begin + at] = x
    assert np.isnan(memory[2000 + plan.size :]).all()
    return memory[plan.places[list(line.outputs)]], runs, plan


@pytest.mark.parametrize("few_modes", [False, True])
def test_runs_compute_the_program(few_modes):
    program = lower(everything, jnp.ones(7), jnp.ones(7), 1.0)
    numbers = np.random.default_rng(0).uniform(0.5, 1.5, 15)
    found, _, plan = computed(program.line, numbers, few_modes)
    np.testing.assert_allclose(found, np.array(program.evaluate(*numbers), float), rtol=1e-14)
    assert plan.size < 4 * len(program.line.nodes)


def test_what_is_alike_in_a_scene_stands_side_by_side():
    count = 16
    program = cluster(count)
    numbers = np.random.default_rng(0).normal(size=4 * count + 1)
    found, runs, _ = computed(program.line, numbers, True)
    # A sum over 16 bodies in another order than NumPy's.
    np.testing.assert_allclose(found, np.array(program.evaluate(*numbers), float), rtol=1e-12)
    operations = sum(run.count for run in runs)
    vectors = sum(-(-run.count // LANES) for run in runs)
    assert vectors < operations / 5
    read = sum(-(-run.count // LANES) * len(run.modes) for run in runs)
    assert sum(-(-run.count // LANES) * run.modes.count(ANYWHERE) for run in runs) < read / 2


def test_how_operands_lie():
    i = np.arange(6)
    (run,) = _packs.vector_runs(3, np.array([10 + i, 0 * i + 5, 7 * i]), np.array([100]))
    assert run[:3] == (3, (SIDE_BY_SIDE, ONE, ANYWHERE), 6) and run.operands[:2] == (10, 5) and run.results == (100,)
    # Rows of a triangle: a number for each row, columns side by side, and a third operand that lies anywhere.
    row, column = np.tril_indices(12)
    at = np.array([1000 + row, column, 3 * row**2 + 5 * column, 2000 + np.arange(len(row))])
    runs = _packs.vector_runs(0, at, np.array([0]))
    assert sum(run.count for run in runs) == len(row)
    long = [run for run in runs if run.modes == (ONE, SIDE_BY_SIDE, ANYWHERE, SIDE_BY_SIDE)]
    assert [run.count for run in long] == [5, 6, 7, 8, 9, 10, 11, 12]
    assert [run.results[0] for run in runs] == np.cumsum([0, *(run.count for run in runs)]).tolist()[:-1]


def test_products_come_in_long_runs():
    """Two families of products of the same rows, whose pairs alternate."""
    i = np.arange(50)
    at = np.stack([np.repeat(i, 2), np.stack([100 + i, 300 + i], axis=1).ravel()])
    parts = list(_packs.product_runs(at, 0))
    assert len(parts) == 2 and all(run.modes == (SIDE_BY_SIDE, SIDE_BY_SIDE) for run, _ in parts)
    assert sorted(np.concatenate([members for _, members in parts])) == list(range(100))


def test_no_products():
    assert not list(_packs.product_runs(np.zeros((2, 0), int), 0)) and not _packs.vector_runs(0, np.zeros((1, 0)), [0])


def test_members_of_a_large_scene_are_integrated_one_after_the_other(monkeypatch):
    """As they are side by side, to the last bit."""
    monkeypatch.setattr(_taylor, "LARGEST_LINE", -1)
    monkeypatch.setattr(_packs, "LEAST_FILLED", 0)
    program = cluster(5)
    kernel = _native.Kernel(program, 10)
    assert kernel.select_kernel(8) is kernel
    monkeypatch.setattr(_kernel, "LARGEST_SHARED", 0)
    kernel = _native.Kernel(program, 10)
    alone = kernel.select_kernel(8)
    assert alone.width == 1 and kernel.select_width(8) is kernel
    y0, ts = np.random.default_rng(1).normal(size=(3, 20)), np.linspace(0.0, 1.0, 5)[None]
    runs = [k(ts, y0, np.zeros((1, 0)), 1e-9, 1e-12, 1000) for k in (kernel, alone)]
    for side_by_side, one_by_one in zip(*(run[:6] for run in runs), strict=True):
        np.testing.assert_array_equal(one_by_one, side_by_side)


def test_the_choice_is_made_once_and_nothing_stays_of_the_compilation(monkeypatch):
    monkeypatch.setattr(_taylor, "LARGEST_LINE", -1)
    monkeypatch.setattr(_kernel, "LARGEST_SHARED", 0)
    made = []

    def note_stages(*arguments):
        found = _packs.stages(*arguments)
        made.extend(weakref.ref(stage.operands) for stage in found)
        return found

    monkeypatch.setattr(_packed, "stages", note_stages)
    kernel = _native.Kernel(cluster(9), 18)
    alone = kernel.select_kernel(8)
    kernel.select_kernel(8)._forward  # noqa: B018
    monkeypatch.setattr(_kernel, "fills_lanes", None)
    assert kernel.select_kernel(3) is alone is kernel.select_width(1)
    gc.collect()
    assert made and all(of() is None for of in made)


def test_a_scene_in_which_everything_waits_for_what_comes_before_keeps_members_in_lanes(monkeypatch):
    monkeypatch.setattr(_taylor, "LARGEST_LINE", -1)
    monkeypatch.setattr(_kernel, "LARGEST_SHARED", 0)

    def row(q, v, t):  # each of forty coordinates drives the next
        x = [jnp.sin(q[0])]
        for k in range(1, 40):
            x.append(jnp.sin(q[k]) * x[-1] + q[k] / (2.0 + x[-1] * x[-1]))
        return jnp.stack(x), False

    states = jax.ShapeDtypeStruct((40,), float)
    assert _native.Kernel(lower(row, states, states, 1.0), 40).select_kernel(8).width > 1
    assert _native.Kernel(cluster(16), 32).select_kernel(8).width == 1


def test_the_code_does_not_grow_with_the_scene(monkeypatch):
    from lagjax._native._integrator import Integrator
    from lagjax._native._motion_parts import MotionParts

    def instructions(count):
        module = Integrator(MotionParts.from_program(cluster(count), 2 * count), width=1).motion.module
        return sum(len(block.instructions) for function in module.functions for block in function.blocks)

    monkeypatch.setattr(_taylor, "LARGEST_LINE", -1)
    monkeypatch.setattr(_packs, "LEAST_FILLED", 0)
    assert instructions(20) < 2 * instructions(5)
