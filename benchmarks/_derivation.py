"""From a Lagrangian to the first result: what one waits for, once, in a new process.

    python -m benchmarks._derivation "heyoka, SIMD" 4       # seconds to the first result, and to the second

Every program gets a process of its own, started and imported before the clock: nothing is left over from another run.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks._cases import Case, chain
from benchmarks._contenders import Contender, named
from benchmarks._measure import seconds
from lagjax import _native
from lagjax._equations._derivation import Derivation
from lagjax._interface._layout import Layout

LINKS = (2, 4, 8, 16)
PROGRAMS = ("lagjax", "lagjax, diffrax", "diffrax, by hand", "diffrax, autodiff", "heyoka, SIMD", "SciPy + SymPy")
MEMBERS, TOLERANCE = 64, 1e-9


def derivation(options) -> list[dict[str, Any]]:
    """Chains of pendulums: seconds to the first result; of lagjax also those to derive, and to make machine code."""
    rows = []
    for links in (n for n in LINKS if n <= options.links):
        for contender in named(*PROGRAMS):
            if reason := _missing(contender):
                print(f"without {contender.name}: {reason}")
                continue
            row = {"links": links, "contender": contender.name} | _in_new_process(contender.name, links, options.budget)
            if contender.name == "lagjax":
                row["derive s"], row["machine code s"] = _stages(chain(links, 1))
            rows.append(row)
    return rows


def _missing(contender: Contender) -> str | None:
    return replace(contender, suits=lambda case: None).available(None)


def _in_new_process(name: str, links: int, budget: float) -> dict[str, float | None]:
    """None for one that was not done after ten times the budget."""
    command = [sys.executable, "-m", "benchmarks._derivation", name, str(links)]
    root = Path(__file__).parent.parent
    try:
        run = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, timeout=10 * budget)
    except subprocess.TimeoutExpired:
        print(f"{name}, {links} links: nothing after {10 * budget:.0f} s")
        return {"first result s": None, "second s": None}
    return json.loads(run.stdout.splitlines()[-1])


def _stages(case: Case) -> tuple[float, float]:
    params = jax.tree.map(jnp.asarray, case.scene.params)
    layout = Layout.from_state(case.tree(case.q0[0]), case.tree(case.qdot0[0]))
    motion = case.scene.system._motion(layout, params)
    numbers = eqx.filter(params, eqx.is_array_like)
    derive, program = seconds(lambda: Derivation(motion, layout, numbers).accelerations.program)
    return derive, seconds(lambda: _native.Kernel(program, layout.size))[0]


def _first_results(name: str, links: int) -> dict[str, float]:
    jax.config.update("jax_enable_x64", True)
    jnp.zeros(1).block_until_ready()  # XLA is there
    (contender,), case = named(name), chain(links, MEMBERS)
    case = replace(case if contender.members is None else case.first(contender.members), duration=1.0)

    def first():
        solve = contender.prepare(case)
        solve(TOLERANCE)
        return solve

    to_first, solve = seconds(first)
    return {"first result s": to_first, "second s": seconds(lambda: solve(TOLERANCE))[0]}


if __name__ == "__main__":
    print(json.dumps(_first_results(sys.argv[1], int(sys.argv[2]))))
