"""What one call costs: a double pendulum over T = 5, by different ways of calling, beside the time of its steps alone.

"machine code" is the kernel called from Python with arrays that are ready: what the machine has to compute. All ways
take turns, round after round, so that a disturbance of the machine falls on all of them.
"""

import functools
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._cases import Case, double_pendulum
from benchmarks._contenders import SINGLE, installed
from benchmarks._measure import seconds
from lagjax._engine._problem import Problem
from lagjax._engine.taylor import MachineCode, flow_of
from lagjax._interface._layout import Layout

TOLERANCE, CALLS, INSIDE = 1e-9, 20, 100


def latency(options) -> list[dict[str, Any]]:
    """Microseconds a call, and beyond the machine code."""
    case = double_pendulum(1)
    ways = {
        "machine code": _machine_code(case),
        "lagjax, jit": _compiled(case),
        "lagjax, jit, a step of lax.scan": _inside_a_scan(case),
        "lagjax, no jit": _plain(case),
        **{name: _peer(name, case) for name in ("heyoka, single", "diffrax, by hand") if _is_there(name)},
    }
    for way in ways.values():
        way()
    times = {name: [] for name in ways}
    for _ in range(4 * options.repeats):
        for name, way in ways.items():
            outside, inside = (1, INSIDE) if "scan" in name else (CALLS, 1)
            spent = seconds(lambda way=way, count=outside: [way() for _ in range(count)])[0]
            times[name].append(1e6 * spent / (outside * inside))
    computing = statistics.median(times["machine code"])
    return [
        {
            "way": name,
            "µs": statistics.median(values),
            "least µs": min(values),
            "µs beyond machine code": statistics.median(values) - computing,
        }
        for name, values in times.items()
    ]


def _simulation(case: Case) -> Callable:
    ts, scene = np.array([0.0, case.duration]), case.scene

    def run(q, qdot):
        return lagjax.simulate(scene.system, q, qdot, ts, scene.params, rtol=TOLERANCE).end

    return run


def _start(case: Case) -> tuple[jax.Array, jax.Array]:
    return jax.tree.map(jnp.asarray, (case.tree(case.q0[0]), case.tree(case.qdot0[0])))


def _plain(case: Case) -> Callable:
    run, start = _simulation(case), _start(case)
    return lambda: jax.block_until_ready(run(*start))


def _compiled(case: Case) -> Callable:
    run, start = jax.jit(_simulation(case)), _start(case)
    return lambda: jax.block_until_ready(run(*start))


def _inside_a_scan(case: Case) -> Callable:
    run, start = _simulation(case), _start(case)

    @jax.jit
    def many(q, qdot):
        def step(total, _):
            end = run(q + 1e-30 * total, qdot)
            return total + jnp.sum(jnp.stack(jax.tree.leaves(end.q))), None

        return jax.lax.scan(step, 0.0, length=INSIDE)[0]

    return lambda: jax.block_until_ready(many(*start))


def _machine_code(case: Case) -> Callable:
    start, ts = _start(case), np.array([[0.0, case.duration]])
    problem = Problem.from_arguments(
        case.scene.system, Layout.from_state(*start), *start, ts[0], case.scene.params, rtol=TOLERANCE
    )
    kernel, y0, numbers = flow_of(problem).kernel.select_width(1), problem.y0, problem.vector
    rtol, atol = map(float, MachineCode().tolerances(problem, y0))
    return functools.partial(kernel, ts, y0[None], numbers[None], rtol, atol, problem.max_steps)


def _is_there(name: str) -> bool:
    return all(map(installed, _contender(name).packages))


def _contender(name: str):
    return next(contender for contender in SINGLE if contender.name == name)


def _peer(name: str, case: Case) -> Callable:
    solve = _contender(name).prepare(case)
    return lambda: solve(TOLERANCE)
