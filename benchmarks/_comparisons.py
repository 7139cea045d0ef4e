"""Questions other than error against time, one after the other. Each takes the options and returns rows.

- `right_hand_sides`: is the derived right-hand side as fast as the best one written by hand?
- `batches`: the cost against the number of members;
- `cores`: what a second core is worth.
"""

import ctypes
import os
import statistics
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import ir

from benchmarks import _contenders
from benchmarks._cases import CASES, Case, double_pendulum
from benchmarks._contenders import Contender, autodiff_acceleration, named
from benchmarks._measure import Comparison, compare, seconds
from lagjax._engine._problem import Problem
from lagjax._engine.diffrax._equations import MotionEquations, equations_of
from lagjax._engine.taylor import MachineCode
from lagjax._equations._derivation import derivation_of
from lagjax._interface._layout import Layout
from lagjax._native.code._ir import DOUBLE, INTEGER, POINTER, Code, compile_module, lanes
from lagjax._native.series._lanes import emit, sincos_function
from lagjax._tracing import lower

TOLERANCE = 1e-9
Rows = list[dict[str, Any]]


# ---- right-hand sides ------------------------------------------------------------------------------------------------

EVALUATIONS = 100


def right_hand_sides(options) -> Rows:
    """Nanoseconds per lane and evaluation on one core: derived by lagjax, best by hand, plain autodiff.

    "lagjax" is what `simulate` runs by default, in machine code, where a scene has it; "in XLA" is what diffrax gets.
    """
    rows = []
    for name in options.cases:
        case = CASES[name](options.batch)
        forms = {"in XLA": _derived(case), "autodiff": _autodiff(case)}
        if case.acceleration is not None:
            forms |= {"rows": _hand_on_rows(case), "array": _hand_on_arrays(case)}
        times = _nanoseconds(forms, case, options.repeats)
        cost = {form: statistics.median(values) for form, values in times.items()}
        hand = min((form for form in ("rows", "array") if form in cost), key=cost.get, default=None)
        rows.append(
            {
                "case": name,
                "lagjax ns": cost["lagjax"],
                "in XLA ns": cost["in XLA"],
                "by hand ns": hand and cost[hand],
                "autodiff ns": cost["autodiff"],
                "lagjax/by hand": hand and _median_ratio(times["lagjax"], times[hand]),
                "autodiff/lagjax": _median_ratio(times["autodiff"], times["lagjax"]),
                "in XLA/by hand": hand and _median_ratio(times["in XLA"], times[hand]),
            }
        )
    return rows


def _median_ratio(over: list[float], under: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def _nanoseconds(forms: dict[str, tuple[Callable, Any]], case: Case, repeats: int) -> dict[str, list[float]]:
    """A chain of evaluations, each at a state that depends (by nothing that matters) on the value before; in rounds."""

    def chained(field):
        def once(_, y):
            return jax.tree.map(lambda x, slope: x + 1e-30 * slope, y, field(y))

        return jax.jit(lambda y: jax.lax.fori_loop(0, EVALUATIONS, once, y))

    runs = {}
    for name, (field, y) in forms.items():
        run = chained(jax.vmap(field))
        runs[name] = lambda run=run, y=y: jax.block_until_ready(run(y))
    runs["lagjax"] = _in_machine_code(case) or runs["in XLA"]
    for run in runs.values():
        run()
    times = {name: [] for name in runs}
    for _ in range(max(5, repeats)):
        for name, run in runs.items():
            times[name].append(1e9 * seconds(run)[0] / (EVALUATIONS * case.batch))
    return times


def _in_machine_code(case: Case) -> Callable[[], None] | None:
    """The same chain in the lanes of vectors, as the integrator evaluates them; None without machine code."""
    layout = Layout.from_state(case.tree(case.q0[0]), case.tree(case.qdot0[0]))
    problem = Problem.from_system(case.scene.system, layout, case.scene.params)
    if MachineCode().refuses(problem) is not None:
        return None
    acceleration = problem.derivation.accelerations.program
    n, width = layout.size, lanes()
    numbers = [np.ravel(leaf) for leaf in jax.tree.leaves(eqx.filter(case.scene.params, eqx.is_array_like))]
    constants = [float(x) for leaf in numbers for x in leaf]  # as for the others: XLA knows them
    shape = jax.ShapeDtypeStruct((n,), np.float64)
    program = lower(lambda q, v: jnp.stack(acceleration(*q, *v, 0.0, *constants)[:n]), shape, shape)
    vector, module = ir.VectorType(DOUBLE, width), ir.Module("right_hand_side")
    module.triple = ""
    sincos = sincos_function(module, width)
    code = Code(module, "evaluate", [POINTER, INTEGER], width, public=True)
    states, groups = code.arguments
    line = program.line
    with code.loop(EVALUATIONS), code.loop(groups) as group:
        places = [code.element(states, (group * (2 * n) + i) * width) for i in range(2 * n)]
        y = [code.load(place, vector) for place in places]
        for place, x, slope in zip(places, y, [*y[n:], *emit(code, line, y.__getitem__, sincos, None)], strict=True):
            code.store(slope * 1e-30 + x, place)
    code.finish()
    engine, at = compile_module(module, ("evaluate",))
    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)(at["evaluate"])
    rows = -(-case.batch // width)
    padded = np.resize(np.asarray(case.states, float), (rows * width, 2 * n)).reshape(rows, width, 2 * n)
    memory = np.zeros(padded.size + 8)
    memory = memory[(-memory.ctypes.data // 8) % 8 :][: padded.size]
    memory[:] = padded.swapaxes(1, 2).ravel()
    return lambda held=engine: function(memory.ctypes.data, rows)


def derived_equations(case: Case) -> tuple[MotionEquations, Any]:
    """The right-hand side as `lagjax.simulate` uses it, and the parameters as arrays."""
    params = jax.tree.map(jnp.asarray, case.scene.params)
    layout = Layout.from_state(case.tree(case.q0[0]), case.tree(case.qdot0[0]))
    return equations_of(derivation_of(case.scene.system, layout, params)), params


def _derived(case: Case):
    form, params = derived_equations(case)
    y = jnp.asarray(case.q0), jnp.asarray(case.qdot0)
    return (lambda y: (y[1], form.acceleration(0.0, y, params)[0])), y


def _autodiff(case: Case):
    acceleration = autodiff_acceleration(case)
    return (lambda y: (y[1], acceleration(*y))), (jnp.asarray(case.q0), jnp.asarray(case.qdot0))


def _hand_on_rows(case: Case):
    y = tuple(map(jnp.asarray, case.q0.T.copy())), tuple(map(jnp.asarray, case.qdot0.T.copy()))
    return (lambda y: (y[1], tuple(case.acceleration(*y)))), y


def _hand_on_arrays(case: Case):
    acceleration = _contenders.by_hand(case)
    return (lambda y: (y[1], acceleration(*y))), (jnp.asarray(case.q0), jnp.asarray(case.qdot0))


# ---- members, cores --------------------------------------------------------------------------------------------------

SIZES = tuple(10**k for k in range(7))


def batches(options) -> Rows:
    """The double pendulum in batches of 1 to 10⁶, or to 250 times `--batch`."""
    names = ("lagjax", "lagjax, diffrax", "diffrax, by hand", "heyoka, SIMD", "heyoka, threads", "numba")
    contenders = list(named(*names))
    if options.device == "gpu":  # where lagjax is diffrax
        contenders = [*map(_on_cpus, named("lagjax")), *(c for c in contenders if c.name != "lagjax, diffrax")]
    rows = []
    for size in (size for size in SIZES if size <= 250 * options.batch):
        case = _shortened(double_pendulum(size), options)
        rows += _rows(compared(case, contenders, options, grown=lambda s: 10 * s[1]), {"batch": size})
    return rows


def cores(options) -> Rows:
    """The same batch on one core, on two, and so on to all that this process may use, in turns."""
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    counts = sorted({2**k for k in range(len(available).bit_length())} | {len(available)}) if available else []
    rows = []
    for name in ("double_pendulum", "chain_8"):
        case = _shortened(CASES[name](options.batch), options)
        contenders = [_on(available[:count], c) for c in named("lagjax", "heyoka, threads") for count in counts]
        found = compare(case, contenders, [TOLERANCE], options.repeats, options.budget).rows
        for row in found:
            program, _, count = row.contender.rpartition(" on ")
            one = next(other for other in found if other.contender == f"{program} on 1")
            ratio = _median_ratio(one.times, [row.times[k % len(row.times)] for k in range(len(one.times))])
            rows.append(
                {
                    "case": name,
                    "contender": program,
                    "cores": int(count),
                    "µs/trajectory": 1e6 * row.seconds,
                    "times faster than one": ratio,
                    "median error": row.median_error,
                }
            )
    return rows


def _on(allowed: list[int], contender: Contender) -> Contender:
    """The contender when this thread, and those it starts, may use only these cores."""

    @contextmanager
    def confined():
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, allowed)
        try:
            yield
        finally:
            os.sched_setaffinity(0, before)

    return _within(confined, contender, f"{contender.name} on {len(allowed)}")


def _on_cpus(contender: Contender) -> Contender:
    """The contender on the CPUs of a machine with a GPU."""
    return _within(lambda: jax.default_device(jax.devices("cpu")[0]), contender, f"{contender.name}, CPUs")


def _within(place: Callable, contender: Contender, name: str) -> Contender:
    """The contender whenever it prepares or solves within what `place()` sets up."""

    def prepare(case):
        with place():
            solve = contender.prepare(case)

        def limited(tol):
            with place():
                return solve(tol)

        return limited

    return replace(contender, name=name, prepare=prepare)


def compared(
    case: Case, contenders: list[Contender], options, grown: Callable, tolerances=(TOLERANCE,), truth=None
) -> Comparison:
    """One point of a series. `grown` says from (compile, run) seconds what the next one takes; if that is more than the
    budget, the contender is removed.
    """
    comparison = compare(case, contenders, tolerances, options.repeats, options.budget, truth=truth)
    for row in comparison.rows:
        if row.contender not in [contender.name for contender in contenders]:
            continue
        spent = row.compile_seconds, row.seconds * row.members
        if grown(spent) > options.budget:
            contenders[:] = [contender for contender in contenders if contender.name != row.contender]
            took = f"{spent[0]:.2g} s to compile and {spent[1]:.2g} s to run"
            print(f"{row.contender} ends with {case.batch} members of {case.name}: {took}; more exceeds the budget")
    return comparison


def _shortened(case: Case, options) -> Case:
    return case if options.duration is None else replace(case, duration=options.duration)


def _rows(comparison: Comparison, label: dict[str, Any]) -> Rows:
    """Each measured point, and its time as a multiple of lagjax's at the same *setting* of the tolerance."""
    ours = {row.tol: row.seconds for row in comparison.rows if row.contender == "lagjax"}
    return [
        label
        | {
            "contender": row.contender,
            "µs/trajectory": 1e6 * row.seconds,
            "µs/step": 1e6 * row.seconds / row.steps,
            "times lagjax": row.seconds / ours[row.tol] if row.tol in ours else None,
            "median error": row.median_error,
            "compile s": row.compile_seconds,
        }
        for row in comparison.rows
    ]
