"""Questions other than error against time. Each comparison takes the options of the command line and returns rows.

- `right_hand_sides`: is the derived right-hand side as fast as the best one written by hand?
- `single`: the latency of one trajectory;
- `derivation`: from a Lagrangian to a compiled right-hand side;
- `links`, `batches`: the cost against the number of coordinates and of members;
- `gradient`: the derivative by eight parameters, in units of a forward solve.
"""

import importlib.util
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _contenders
from benchmarks._cases import CASES, Case, chain, double_pendulum, with_params
from benchmarks._contenders import autodiff_acceleration
from benchmarks._measure import Comparison, compare, seconds
from lagjax._equations import Equations, equations
from lagjax._layout import Layout

TOLERANCE = 1e-9
Rows = list[dict[str, Any]]


# ---- right-hand sides ------------------------------------------------------------------------------------------------

EVALUATIONS = 100


def right_hand_sides(options) -> Rows:
    """Nanoseconds per lane and evaluation: derived by lagjax, best by hand, plain autodiff; four times the batch."""
    rows = []
    for name in options.cases:
        case = CASES[name](4 * options.batch)
        forms = {"lagjax": _derived(case), "autodiff": _autodiff(case)}
        if case.acceleration is not None:
            forms |= {"rows": _hand_on_rows(case), "array": _hand_on_arrays(case)}
        cost = _nanoseconds(forms, case.batch, options.repeats)
        hand = min((cost[key] for key in ("rows", "array") if key in cost), default=None)
        rows.append(
            {
                "case": name,
                "lagjax ns": cost["lagjax"],
                "by hand ns": hand,
                "autodiff ns": cost["autodiff"],
                "lagjax/by hand": hand and cost["lagjax"] / hand,
                "autodiff/lagjax": cost["autodiff"] / cost["lagjax"],
            }
        )
    return rows


def _nanoseconds(forms: dict[str, tuple[Callable, Any]], lanes: int, repeats: int) -> dict[str, float]:
    """A chain of evaluations, each at a state that depends (by nothing that matters) on the value before."""

    def chained(field):
        def once(_, y):
            return jax.tree.map(lambda x, slope: x + 1e-30 * slope, y, field(y))

        return jax.jit(lambda y: jax.lax.fori_loop(0, EVALUATIONS, once, y))

    runs = {}
    for name, (field, y) in forms.items():
        run = chained(jax.vmap(field))
        runs[name] = lambda run=run, y=y: jax.block_until_ready(run(y))
        runs[name]()
    times = {name: [] for name in runs}
    for _ in range(max(5, repeats)):
        for name, run in runs.items():
            times[name].append(seconds(run)[0])
    return {name: 1e9 * statistics.median(values) / (EVALUATIONS * lanes) for name, values in times.items()}


def derived_equations(case: Case) -> tuple[Equations, Any]:
    """The right-hand side as `lagjax.simulate` uses it, and the parameters as arrays."""
    params = jax.tree.map(jnp.asarray, case.scene.params)
    layout = Layout.of(case.tree(case.q0[0]), case.tree(case.qdot0[0]))
    return equations(case.scene.system.motion(layout, params), layout, params), params


def _derived(case: Case):
    form, params = derived_equations(case)
    y = jnp.asarray(case.q0), jnp.asarray(case.qdot0)
    return (lambda y: form.vector_field(0.0, y, params)), y


def _autodiff(case: Case):
    acceleration = autodiff_acceleration(case)
    return (lambda y: (y[1], acceleration(*y))), (jnp.asarray(case.q0), jnp.asarray(case.qdot0))


def _hand_on_rows(case: Case):
    y = tuple(map(jnp.asarray, case.q0.T.copy())), tuple(map(jnp.asarray, case.qdot0.T.copy()))
    return (lambda y: (y[1], tuple(case.acceleration(*y)))), y


def _hand_on_arrays(case: Case):
    acceleration = _contenders.by_hand(case)
    return (lambda y: (y[1], acceleration(*y))), (jnp.asarray(case.q0), jnp.asarray(case.qdot0))


# ---- error and time in other places ----------------------------------------------------------------------------------


def single(options) -> Rows:
    """One trajectory at a time: `lagjax.simulate` beside plain diffrax, heyoka, SciPy."""
    rows = []
    for name in options.cases:
        case = _shortened(CASES[name](options.batch).first(1), options)
        comparison = compare(case, _contenders.SINGLE, [1e-6, TOLERANCE], options.repeats, options.budget)
        rows += _rows(comparison, {"case": name})
    return rows


def links(options) -> Rows:
    """A chain of pendulums, ever longer; one second of its motion."""
    rows = []
    for n in (2, 4, 8, 12, 16, 32):
        case = replace(chain(n, min(options.batch, 256)), duration=min(1.0, options.duration or 1.0))
        names = ["lagjax"] + ["diffrax, autodiff"] * (n <= 16) + ["heyoka, SIMD"] * (n <= 16)
        rows += _rows(compare(case, _named(*names), [TOLERANCE], options.repeats, options.budget), {"links": n})
    return rows


def batches(options) -> Rows:
    """The double pendulum in batches of 1 to 10⁵, or to a hundred times `--batch`."""
    rows = []
    for size in (10**k for k in range(6) if 10**k <= 100 * options.batch):
        case = _shortened(double_pendulum(size), options)
        names = ["lagjax", "lagjax, in jit", "diffrax, by hand", "heyoka, SIMD"]
        rows += _rows(compare(case, _named(*names), [TOLERANCE], options.repeats, options.budget), {"batch": size})
    return rows


def _named(*names: str) -> list[_contenders.Contender]:
    return [contender for contender in _contenders.BATCHED if contender.name in names]


def _shortened(case: Case, options) -> Case:
    return case if options.duration is None else replace(case, duration=options.duration)


def _rows(comparison: Comparison, label: dict[str, Any]) -> Rows:
    """Each measured point, and its time as a multiple of lagjax's at the same *setting* of the tolerance."""
    ours = {row.tol: row.seconds for row in comparison.rows if row.contender == "lagjax"}
    return [
        label
        | {
            "contender": row.contender,
            "tol": row.tol,
            "µs/trajectory": 1e6 * row.seconds,
            "times lagjax": row.seconds / ours[row.tol],
            "median error": row.median_error,
            "compile s": row.compile_seconds,
        }
        for row in comparison.rows
    ]


# ---- derivation ------------------------------------------------------------------------------------------------------


def derivation(options) -> Rows:
    """Seconds from a Lagrangian to a right-hand side that can be called: deriving it, and compiling it."""
    rows = []
    for name in options.cases:
        case = CASES[name](1)
        jax.clear_caches()
        derive, (form, params) = seconds(lambda case=case: derived_equations(case))
        state = (jnp.asarray(case.q0[0]), jnp.asarray(case.qdot0[0]))
        row = {"case": name, "form": type(form).__name__.removesuffix("Equations").lower(), "lagjax derives": derive}
        row["lagjax compiles"] = _compile_seconds(lambda y, form=form, p=params: form.vector_field(0.0, y, p), state)
        field, states = _autodiff(case)
        row["autodiff compiles"] = _compile_seconds(field, jax.tree.map(lambda leaf: leaf[0], states))
        rows.append(row | {f"{peer} s": value for peer, value in _peers_derive(case).items()})
    return rows


def _compile_seconds(field: Callable, y: Any) -> float:
    return seconds(lambda: jax.jit(field).lower(y).compile())[0]


def _peers_derive(case: Case) -> dict[str, float | None]:
    """SymPy to a lambdified function, heyoka to an integrator (its right-hand side is not compiled by itself)."""
    sympy = _installed("sympy") and not case.long_formulas
    return {
        "SymPy": seconds(lambda: _contenders.sympy_functions(case))[0] if sympy else None,
        "heyoka": seconds(lambda: _heyoka_from_scratch(case))[0] if _installed("heyoka") else None,
    }


def _heyoka_from_scratch(case: Case):
    import heyoka as hy

    system = _contenders.heyoka_system(case)
    return hy.taylor_adaptive(system, case.states[0].copy(), tol=TOLERANCE, compact_mode=case.long_formulas)


def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


# ---- gradients -------------------------------------------------------------------------------------------------------


def gradient(options) -> Rows:
    """d(Σ qᵢ²)/dx at the end of a double pendulum, x its masses, lengths and initial state: eight numbers a member."""
    case = _shortened(replace(chain(2, options.batch), duration=2.0), options)
    numbers = np.concatenate([np.ones((case.batch, 4)), case.states], axis=1)
    rows = []
    for name, loss in {"lagjax": _loss_lagjax(case), "diffrax, autodiff": _loss_diffrax(case)}.items():
        reverse = jax.vmap(jax.grad(lambda x, loss=loss: loss(x, diffrax.RecursiveCheckpointAdjoint())))
        forward = jax.vmap(jax.jacfwd(lambda x, loss=loss: loss(x, diffrax.ForwardMode())))
        plain = jax.vmap(lambda x, loss=loss: loss(x, diffrax.RecursiveCheckpointAdjoint()))
        cost, value, compiled = {}, {}, {}
        for mode, function in {"solve": plain, "reverse": reverse, "forward": forward}.items():
            run = jax.jit(function)
            compiled[mode], value[mode] = seconds(lambda run=run: np.asarray(run(numbers)))
            times = [seconds(lambda run=run: jax.block_until_ready(run(numbers)))[0] for _ in range(options.repeats)]
            cost[mode] = statistics.median(times)
        difference = np.abs(value["reverse"] - value["forward"]).max(axis=1)
        rows.append(
            {
                "program": name,
                "solve µs": 1e6 * cost["solve"] / case.batch,
                "reverse/solve": cost["reverse"] / cost["solve"],
                "forward/solve": cost["forward"] / cost["solve"],
                "reverse − forward, median": float(np.median(difference)),
                "largest": float(difference.max()),
                "compile reverse s": compiled["reverse"],
            }
        )
    return rows


def _params(case: Case, x) -> dict[str, Any]:
    return case.scene.params | {"m": x[:2], "l": x[2:4]}


def _loss_lagjax(case: Case) -> Callable:
    ts = np.array([0.0, case.duration])

    def loss(x, adjoint):
        end = lagjax.simulate(
            case.scene.system, x[4:6], x[6:8], ts, _params(case, x),
            rtol=TOLERANCE, atol=TOLERANCE, max_steps=4096, adjoint=adjoint, throw=False,
        ).q[-1]  # fmt: skip
        return jnp.sum(end**2)

    return loss


def _loss_diffrax(case: Case) -> Callable:
    def loss(x, adjoint):
        scene = replace(case, scene=with_params(case.scene, _params(case, x)))
        solve = _contenders.diffeqsolve(scene, autodiff_acceleration(scene), max_steps=4096, adjoint=adjoint)
        y = solve(x[4:], TOLERANCE)
        return jnp.sum(y[:2] ** 2)

    return loss


COMPARISONS = {
    "right_hand_sides": right_hand_sides,
    "single": single,
    "derivation": derivation,
    "links": links,
    "batches": batches,
    "gradient": gradient,
}
