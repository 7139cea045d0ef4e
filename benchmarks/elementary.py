"""Sine and cosine: time per element and largest error, ours beside XLA's.  CPU, float64, one batch, one fusion.
Run it pinned to one core: `taskset -c 0 python benchmarks/elementary.py`.
"""

import time

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from lagjax import _elementary as el

BATCH, REPEATS, RUNS, CHECKED = 4096, 200, 15, 1000

# Primitive name: XLA's function, mpmath's, range of the arguments timed and checked.
CASES = {
    "sin": (jnp.sin, mpmath.sin, (-100, 100)),
    "cos": (jnp.cos, mpmath.cos, (-100, 100)),
}


def seconds(f, args):
    """Per element: a chain, in which each argument depends (by nothing that matters) on the value before."""

    @jax.jit
    def chain(x, *rest):
        return jax.lax.fori_loop(0, REPEATS, lambda _, y: x + 1e-30 * f(y, *rest), x)

    chain(*args).block_until_ready()
    best = np.inf
    for _ in range(RUNS):
        start = time.perf_counter()
        chain(*args).block_until_ready()
        best = min(best, time.perf_counter() - start)
    return best / (REPEATS * BATCH)


def max_ulp(f, exact, args):
    args = [a[:CHECKED] for a in args]
    values = np.asarray(jax.jit(f)(*args))
    truth = [exact(*(mpmath.mpf(float(a)) for a in point)) for point in zip(*args, strict=True)]
    return max(
        float(abs(mpmath.mpf(float(v)) - t)) / np.spacing(abs(float(t))) for v, t in zip(values, truth, strict=True)
    )


def main():
    jax.config.update("jax_enable_x64", True)
    mpmath.mp.prec = 200
    rng = np.random.default_rng(0)
    print(f"{'':8}{'ours ns':>9}{'XLA ns':>9}{'ratio':>8}{'ours ulp':>10}{'XLA ulp':>9}")
    for name, (own, exact, *ranges) in CASES.items():
        args = [rng.uniform(*r, BATCH) for r in ranges]
        ours, theirs = (1e9 * seconds(f, args) for f in (el.FAST[name], own))
        errors = [max_ulp(f, exact, args) for f in (el.FAST[name], own)]
        print(f"{name:8}{ours:9.2f}{theirs:9.2f}{theirs / ours:8.1f}{errors[0]:10.2f}{errors[1]:9.2f}")
    pair = 1e9 * seconds(lambda x: sum(el.sincos(x)), [rng.uniform(-100, 100, BATCH)])
    print(f"{'sincos':8}{pair:9.2f}")


if __name__ == "__main__":
    main()
