"""What size costs: ever longer chains, ever more bodies, and real machines.

    python -m benchmarks._sizes "bicycle"       # seconds to the first result, of `check`, `health`, the first gradient

- `sizes`: time of a trajectory against the number of coordinates, beside other programs, at equal error;
- `first_results`: what one waits for, once, in a process that knows nothing of the scene.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _large
from benchmarks._cases import Case, bodies, chain
from benchmarks._comparisons import compared
from benchmarks._contenders import by_hand, dop853_of_all, named
from benchmarks._measure import Comparison, ratio_at_equal_error, seconds

Rows = list[dict[str, Any]]
PROGRAMS = ("lagjax", "diffrax, by hand", "heyoka, threads", "numba", "REBOUND")
LINKS, COUNTS, MEMBERS, DURATION = (2, 4, 8, 16, 24, 32, 64, 128), (3, 5, 10, 20, 50, 100, 300), 8, 2.0
TOLERANCES = (1e-6, 1e-9, 1e-12)


def sizes(options) -> Rows:
    """Eight members over two units of time, of chains of pendulums and of clusters of bodies."""
    rows = []
    for family, make, every in (("chain", chain, LINKS), ("bodies", bodies, COUNTS)):
        contenders = list(named(*PROGRAMS))
        for n in (n for n in every if n <= options.links or (family == "bodies" and n <= 3 * options.links)):
            case = _short(make(n, MEMBERS))
            truth = tuple(dop853_of_all(case, by_hand(case), tol) for tol in (1e-13, 1e-12))
            found = compared(case, contenders, options, lambda s: max(s[0], 8 * s[1]), TOLERANCES, truth)
            rows += _rows(found, family, n)
    return rows


def _short(case: Case) -> Case:
    return case if case.duration == DURATION else Case(**{**vars(case), "duration": DURATION})


def _rows(comparison: Comparison, family: str, size: int) -> Rows:
    """Each program at each tolerance; its time as a multiple of lagjax's at the error that lagjax makes at 1e-9."""
    ours = [row for row in comparison.rows if row.contender == "lagjax"]
    error = next((row.median_error for row in ours if row.tol == 1e-9), None)
    rows = []
    for row in comparison.rows:
        same = [other for other in comparison.rows if other.contender == row.contender]
        at_nine = row.tol == 1e-9 and error is not None
        rows.append(
            {
                "family": family,
                "size": size,
                "contender": row.contender,
                "tol": row.tol,
                "median error": row.median_error,
                "µs/trajectory": 1e6 * row.seconds,
                "steps": row.steps,
                "compile s": row.compile_seconds,
                "times lagjax at equal error": ratio_at_equal_error(ours, same, error) if at_nine else None,
            }
        )
    return rows


# ---- first results ---------------------------------------------------------------------------------------------------

WHAT = ("first result", "second", "check", "health", "first gradient")
FIRST = (
    *_large.MACHINES,
    *(f"chain {n}" for n in (3, 6, 9, 16, 24, 32, 64, 128)),
    *(f"bodies {n}" for n in (4, 8, 20, 50, 100, 300)),
    "cartesian chain 8",
)


def first_results(options) -> Rows:
    """Seconds, each scene in a process of its own, which has imported lagjax before the clock starts."""
    rows = []
    for name in FIRST:
        rows.append({"scene": name} | _in_new_process(name, 10 * options.budget))
        print(json.dumps(rows[-1]), flush=True)
    return rows


def _in_new_process(name: str, limit: float) -> dict[str, float | None]:
    """What was done within the limit; None for the rest."""
    command = [sys.executable, "-m", "benchmarks._sizes", name]
    run = subprocess.Popen(command, cwd=Path(__file__).parent.parent, stdout=subprocess.PIPE, text=True)
    try:
        printed, _ = run.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        run.kill()
        printed, _ = run.communicate()
    done = dict(json.loads(line) for line in printed.splitlines() if line.startswith("["))
    return {f"{what} s": done.get(what) for what in WHAT} | {"operations": done.get("operations")}


def _one_after_the_other(name: str) -> None:
    """Print a line as soon as its work is done."""
    jax.config.update("jax_enable_x64", True)
    jnp.zeros(1).block_until_ready()  # XLA is there
    system, q, qdot, params = _large.scene_of(name)

    def run(q=q):
        trajectory = lagjax.simulate(system, q, qdot, np.linspace(0.0, 0.5, 3), params)
        return trajectory, jax.block_until_ready(trajectory.q)

    def gradient():
        return jax.block_until_ready(jax.grad(lambda q: jnp.sum(jnp.stack(jax.tree.leaves(run(q)[1])) ** 2))(q))

    work: dict[str, Callable] = {
        "first result": run,
        "second": run,
        "check": lambda: lagjax.check(system, q, qdot, 0.0, params),
        "health": lambda: run()[0].health(),
        "first gradient": gradient,
    }
    for what, call in work.items():
        print(json.dumps([what, seconds(call)[0]]), flush=True)


if __name__ == "__main__":
    _one_after_the_other(sys.argv[1])
