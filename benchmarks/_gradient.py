"""d(Σ qᵢ²)/dx at the end of a double pendulum, in units of a solve; x are eight numbers of each member: two masses, two
lengths, four of the initial state.

The swings are small and long: about five hundred steps, without the chaos in which no derivative would mean anything.
Reverse mode is compared with forward mode, number by number. Each is accurate to its tolerance and takes steps of its
own, so how well they agree is a matter of the tolerance: there are two.
"""

import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._cases import Case, chain, with_params
from benchmarks._contenders import autodiff_acceleration, diffeqsolve, installed
from benchmarks._gradsolve import of_double_pendulums
from benchmarks._measure import seconds

TOLERANCES, DURATION, MAX_STEPS = (1e-9, 1e-11), 50.0, 4096
PEER_MEMBERS = 256  # plain diffrax: its cost is proportional


def gradient(options) -> Iterator[dict[str, Any]]:
    """Two and a half times the batch: 10⁴ members by default."""
    duration = DURATION if options.duration is None else options.duration
    case = replace(chain(2, round(2.5 * options.batch)), duration=duration)
    case = replace(case, q0=0.3 * case.q0)
    peer = case.first(PEER_MEMBERS)
    for tol in TOLERANCES:
        ours, derivative = _measured("lagjax", _with_lagjax(case, tol), tol, case, options)
        theirs, check = _measured("diffrax, autodiff", _with_diffrax(peer, tol), tol, peer, options)
        for row in (ours, theirs):  # the two programs against each other: they differ by their tolerance
            row["the other's, median"] = float(np.median(_difference(derivative[: len(check)], check)))
            yield row
        if installed("gradsolve"):
            yield _of_gradsolve(peer, tol, derivative, options)


def _measured(name: str, run: Callable, tol: float, case: Case, options) -> tuple[dict[str, Any], np.ndarray]:
    """One row, and the derivatives by forward mode; `run(x, adjoint)` is the loss and the number of steps of a member.

    lagjax is called with everything at its default, its peer with the adjoint that diffrax has for each mode.
    """
    reverse, forward = (
        (None, None) if name == "lagjax" else (diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode())
    )
    functions = {
        "solve": lambda x: run(x, reverse),
        "reverse": jax.grad(lambda x: run(x, reverse)[0]),
        "forward": jax.jacfwd(lambda x: run(x, forward)[0]),
    }
    numbers = np.concatenate([np.ones((case.batch, 4)), case.states], axis=1)
    value, compiled, runs = {}, {}, {}
    for mode, function in functions.items():
        batch = jax.jit(jax.vmap(function))
        runs[mode] = lambda batch=batch: jax.tree.map(np.asarray, batch(numbers))
        compiled[mode], value[mode] = seconds(runs[mode])
    times = {mode: [] for mode in runs}
    for _ in range(options.repeats):
        for mode, again in runs.items():
            if sum(times[mode]) < options.budget:
                times[mode].append(seconds(again)[0])
    difference = _difference(value["reverse"], value["forward"])
    row = {
        "contender": name,
        "tol": tol,
        "members": case.batch,
        "steps": float(value["solve"][1].mean()),
        "solve µs": 1e6 * statistics.median(times["solve"]) / case.batch,
        "reverse/solve": _ratio(times["reverse"], times["solve"]),
        "forward/solve": _ratio(times["forward"], times["solve"]),
        "compile reverse s": compiled["reverse"] - min(times["reverse"]),
        "|reverse − forward|, median": float(np.median(difference)),
        "largest": float(difference.max()),
    }
    return row, value["forward"]


def _of_gradsolve(case: Case, tol: float, derivative: np.ndarray, options) -> dict[str, Any]:
    """Its row: reverse mode, which records the steps and goes back over them; it has no forward mode."""
    numbers = np.concatenate([np.ones((case.batch, 4)), case.states], axis=1)
    solve, record = of_double_pendulums(case, numbers, tol)

    def reverse():
        end = record()
        y0_ct, p_ct = jax.grad(lambda y0, p: jnp.sum(end(y0, p)[:, :2] ** 2), (0, 1))(numbers[:, 4:], numbers[:, :4])
        return np.concatenate([p_ct, y0_ct], axis=1)

    _, steps = seconds(solve)
    compiled, value = seconds(reverse)
    rounds = [(seconds(solve)[0], seconds(reverse)[0]) for _ in range(options.repeats)]
    solves, reverses = map(list, zip(*rounds, strict=True))
    return {
        "contender": "gradsolve",
        "tol": tol,
        "members": case.batch,
        "steps": float(steps.mean()),
        "solve µs": 1e6 * statistics.median(solves) / case.batch,
        "reverse/solve": _ratio(reverses, solves),
        "forward/solve": float("nan"),
        "compile reverse s": compiled - min(reverses),
        "the other's, median": float(np.median(_difference(value, derivative[: case.batch]))),
    }


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest of each member, in units of its largest derivative."""
    return np.abs(a - b).max(axis=1) / np.abs(b).max(axis=1)


def _ratio(over: list[float], under: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(over, under, strict=False))


def _params(case: Case, x) -> dict[str, Any]:
    return case.scene.params | {"m": x[:2], "l": x[2:4]}


def _with_lagjax(case: Case, tol: float) -> Callable:
    ts = np.array([0.0, case.duration])

    def run(x, adjoint):
        trajectory = lagjax.simulate(
            case.scene.system, x[4:6], x[6:8], ts, _params(case, x),
            rtol=tol, max_steps=MAX_STEPS, adjoint=adjoint, throw=False,
        )  # fmt: skip
        return jnp.sum(trajectory.q[-1] ** 2), trajectory.stats["num_steps"]

    return run


def _with_diffrax(case: Case, tol: float) -> Callable:
    def run(x, adjoint):
        scene = replace(case, scene=with_params(case.scene, _params(case, x)))
        solve = diffeqsolve(scene, autodiff_acceleration(scene), max_steps=MAX_STEPS, adjoint=adjoint)
        y, steps = solve(x[4:], tol)
        return jnp.sum(y[:2] ** 2), steps

    return run
