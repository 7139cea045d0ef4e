"""Columns of masses on springs that hang, are let go, and fall upon each other: is any of them not decided, or wrong?

    python -m benchmarks.contact_columns --sizes 2 3 5 8 12 24 --restitutions 0 0.3 0.9

Without friction velocities and accelerations are unique. Where several masses lie together and press upon each other
by nothing, only higher derivatives tell who opens: behind its last spring each mass leaves the one above by two powers
of the time more. The reference is a time stepping by Moreau's midpoint rule, whose projection is exact (non-negative
least squares). It is of first order: what two steps of it differ by, four times, is what it is known to.
"""

import argparse
import collections
import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

import lagjax

G, STIFFNESS, DURATION, STEP, KNOWN = 9.81, 200.0, 0.6, 5e-5, 1e-3


def column() -> lagjax.System:
    """Masses of 1 in a row, with springs of no length between them, which do not pass each other."""
    return lagjax.System(
        lambda q, v: 0.5 * jnp.sum(v**2) - G * jnp.sum(q) - 0.5 * STIFFNESS * jnp.sum((q[:-1] - q[1:]) ** 2),
        contacts=lambda q: q[:-1] - q[1:],
        restitution=lambda params: params,
    )


def hanging(n: int) -> np.ndarray:
    """Where n masses hang at rest from the first one."""
    return np.concatenate([np.zeros(1), -np.cumsum(G / STIFFNESS * np.arange(n - 1, 0, -1.0))])


def project(v, rows, least):
    """The velocities nearest to v (n,) with rows @ v >= least."""
    missing = least - rows @ v
    if not (missing > 0).any():
        return v
    dual = np.vstack([rows.T, missing])
    residual = dual @ nnls(dual, np.append(np.zeros(len(v)), 1.0))[0] - np.append(np.zeros(len(v)), 1.0)
    return v - residual[:-1] / residual[-1]


def stepped(n: int, e: float, step: float) -> np.ndarray:
    """Where the masses are at the end, by Moreau's steps."""
    q, v = hanging(n), np.zeros(n)
    rows = np.eye(n)[:-1] - np.eye(n)[1:]
    for _ in range(round(DURATION / step)):
        middle = q + 0.5 * step * v
        gaps = rows @ middle
        free = v + step * (-G - STIFFNESS * rows.T @ gaps)
        touch = rows[gaps <= 0]
        v = project(free, touch, -e * (touch @ v)) if len(touch) else free
        q = middle + 0.5 * step * v
    return q


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare columns, print a line of each, and count them: right, wrong, or not decided."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.contact_columns", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=list(range(2, 25)))
    parser.add_argument("--restitutions", type=float, nargs="+", default=[0.0, 0.3, 0.9])
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    counts, times = collections.Counter(), np.array([0.0, DURATION])
    for n in options.sizes:
        system = column()
        for e in options.restitutions:
            run = lagjax.simulate(system, hanging(n), np.zeros(n), times, e, max_transitions=4096, throw=False)
            coarse, fine = (stepped(n, e, step) for step in (2 * STEP, STEP))
            error, known = np.abs(run.q[-1] - fine).max(), KNOWN + 4 * np.abs(coarse - fine).max()
            verdict = "not decided" if not run.ok else "right" if error <= known else "wrong"
            counts[verdict] += 1
            changes = int(run.contact_changes.count)
            print(
                f"{n:3d} masses, e = {e}: {verdict}, off by {error:.1e} of {known:.1e}; {changes} changes", flush=True
            )
    print(dict(counts), file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
