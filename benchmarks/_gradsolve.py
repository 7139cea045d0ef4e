"""gradsolve: ensembles for GPUs, whose kernels (NVIDIA's Warp) run on a CPU too, on one core; explicit Tsit5, float64.

Its equations are those by hand, for it derives none. A kernel is made of scalar operations: a linear solve is refused,
and so are arrays that the function closes over. The gradient replays the accepted steps in JAX (`grad_closure`).
Outputs along the motion come from its engines in JAX alone; there are no events and no constraints.

Spurio Mancini, arXiv:2609.02876.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from benchmarks._cases import GRAVITY, Case


def why_not(case: Case) -> str | None:
    if case.acceleration is None:
        return "nobody writes these equations by hand"
    return "its kernels have no linear solve" if case.coordinates > 2 else None


class Problem:
    """A case as gradsolve takes it: an object with these members, and `f_jax`, the rate of one state."""

    is_stiff, t0 = False, 0.0

    def __init__(self, name: str, case: Case, acceleration: Callable):
        self.name, self.dim, self.t1 = name, 2 * case.coordinates, case.duration
        self.acceleration = acceleration

    def f_jax(self, t, y, p):
        q, v = np.split(np.arange(self.dim), 2)
        q, v = [y[i] for i in q], [y[i] for i in v]
        return jnp.stack([*v, *self.acceleration(q, v, p)])


def prepare(case: Case) -> Callable:
    import gradsolve
    import warp

    warp.config.quiet = True
    problem = Problem(f"benchmark_{case.name}", case, lambda q, v, p: case.acceleration(q, v))
    numbers = np.zeros((case.batch, 1))

    def solve(tol):
        run = gradsolve.solve(
            problem, case.states, numbers, engine="warp_ode", fused=True, rtol=tol, atol=tol, device="cpu"
        )
        return np.asarray(run.y_final), np.asarray(run.accepted_steps) + np.asarray(run.rejected_steps)

    return solve


def double_pendulum(q, v, p):
    """q̈ of a double pendulum with masses p[0], p[1] and lengths p[2], p[3], by Cramer's rule."""
    m1, m2, l1, l2 = (p[i] for i in range(4))
    c, s = l1 * l2 * m2 * jnp.cos(q[0] - q[1]), l1 * l2 * m2 * jnp.sin(q[0] - q[1])
    a, b = (m1 + m2) * l1 * l1, m2 * l2 * l2
    r1 = -s * v[1] ** 2 - (m1 + m2) * GRAVITY * l1 * jnp.sin(q[0])
    r2 = s * v[0] ** 2 - m2 * GRAVITY * l2 * jnp.sin(q[1])
    determinant = a * b - c * c
    return (b * r1 - c * r2) / determinant, (a * r2 - c * r1) / determinant


def of_double_pendulums(case: Case, x, tol: float) -> tuple[Callable, Callable]:
    """Two functions of nothing, for members with masses, lengths and starts `x` = (m, l, q, v), (members, 8).

    The first gives the steps of each member of a solve; the second records the steps, and gives the ends (members, 4)
    as a function of starts and numbers, (members, 4) each, over these steps.
    """
    import gradsolve

    given = Problem("benchmark_double_pendulum_of_parameters", case, double_pendulum), x[:, 4:], x[:, :4]
    how = {"engine": "tsit5_replay", "fused": False, "rtol": tol, "atol": tol, "device": "cpu"}
    return (
        lambda: np.asarray(gradsolve.solve(*given, **how).accepted_steps),
        lambda: gradsolve.grad_closure(*given, wrt=("y0", "params"), **how),
    )
