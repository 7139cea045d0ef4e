"""A batch whose members need very different numbers of steps: who waits for the slowest?

Ellipses of eccentricity 0.5 around masses GM from 1 to 10⁵, log-uniformly, so that periods differ 300-fold: the busiest
member takes more than five times as many steps as the mean. Beside it the same batch with one mass for all, and as many
steps in total. What a program gains from the first to the second is its answer. The truth is the closed solution.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._cases import Case, kepler
from benchmarks._contenders import MAX_STEPS, Contender, Solve, rows_of
from benchmarks._measure import REFERENCE_MEMBERS, Comparison, compare

RATES = 300.0  # the fastest mean motion, in units of the slowest


def mixed(options) -> Iterator[Comparison]:
    """First with masses that differ, then with one for all."""
    case = kepler(options.batch, eccentricity=0.5)
    spread = RATES ** np.random.default_rng(6).permutation(np.linspace(0.0, 1.0, case.batch))
    duration = 2.0 if options.duration is None else options.duration
    for name, rates in {"mixed": spread, "uniform": np.full(case.batch, spread.mean())}.items():
        moving = replace(case, name=name, qdot0=case.qdot0 * rates[:, None], duration=duration)
        GM = rates**2
        contenders = [Contender(title, of(GM)) for title, of in CONTENDERS.items()]
        truth = _closed_solution(moving.first(REFERENCE_MEMBERS), GM[:REFERENCE_MEMBERS])
        yield compare(moving, contenders, options.tolerances, options.repeats, options.budget, truth=(truth, truth))


def waiting(comparison: Comparison) -> float:
    """Most steps over mean steps, in plain `vmap` at the tightest tolerance."""
    row = [row for row in comparison.rows if row.contender == "lagjax, plain vmap"][-1]
    return row.most_steps / row.steps


def _closed_solution(case: Case, GM: np.ndarray) -> np.ndarray:
    def end(q0, qdot0, GM):
        return jnp.concatenate(case.scene.exact(case.duration, q0, qdot0, {"GM": GM}))

    return np.asarray(jax.jit(jax.vmap(end))(case.q0, case.qdot0, GM))


def _lagjax(GM: np.ndarray, **options) -> Callable[[Case], Solve]:
    def prepare(case):
        def solve(tol):
            run = lagjax.simulate_batch(
                case.scene.system, case.q0, case.qdot0, np.array([0.0, case.duration]), {"GM": GM},
                batch_axes=(0, 0, 0), rtol=tol, atol=tol, max_steps=MAX_STEPS, **options,
            )  # fmt: skip
            return rows_of(run.end, case.batch), np.asarray(run.stats["num_steps"])

        return solve

    return prepare


def _plain_vmap(GM: np.ndarray) -> Callable[[Case], Solve]:
    def prepare(case):
        def one(q0, qdot0, GM, tol):
            run = lagjax.simulate(
                case.scene.system, q0, qdot0, np.array([0.0, case.duration]), {"GM": GM},
                rtol=tol, atol=tol, max_steps=MAX_STEPS, solver=diffrax.Dopri8(), throw=False,
            )  # fmt: skip
            return jnp.concatenate([run.end.q, run.end.qdot]), run.stats["num_steps"]

        batch = jax.jit(jax.vmap(one, in_axes=(0, 0, 0, None)))
        return lambda tol: tuple(map(np.asarray, batch(case.q0, case.qdot0, GM, tol)))

    return prepare


def _by_hand(GM: np.ndarray) -> Callable[[Case], Solve]:
    def field(t, y, GM):
        square = y[0] ** 2 + y[1] ** 2
        return jnp.concatenate([y[2:], -GM / (square * jnp.sqrt(square)) * y[:2]])

    def prepare(case):
        def one(y0, GM, tol):
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field), diffrax.Dopri8(), 0.0, case.duration, None, y0, GM,
                stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol), max_steps=MAX_STEPS, throw=False,
            )  # fmt: skip
            return solution.ys[-1], solution.stats["num_steps"]

        batch = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))
        return lambda tol: tuple(map(np.asarray, batch(case.states, GM, tol)))

    return prepare


CONTENDERS = {
    "lagjax": _lagjax,
    "lagjax, diffrax": lambda GM: _lagjax(GM, solver=diffrax.Dopri8()),
    "lagjax, plain vmap": _plain_vmap,
    "diffrax, by hand": _by_hand,
}
