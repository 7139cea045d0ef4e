"""Narrow features that are no exponentials, and collisions from far away: is any motion wrong without a word?

    python -m benchmarks.narrow_features --scenes 300              # --float32: in float32, without the x64 switch

A feature f((x − c) / w) of one of ten families, 1e-1 to 1e-7 wide, acts on a unit mass as a force in time, as a
potential in place, or is a function whose crossings of a level are counted; or the mass, 1e2 to 1e6 lengths away, flies
into an atom. The reference of a force or a potential is Gauss's quadrature on intervals that double with the distance
from the feature, of a guard the place where its level lies, of a collision SciPy's DOP853 at 1e-13 in such intervals.
A result is *wrong* where it is off by more than 1e4 tolerances times what a small error of the start becomes; a motion
that says so itself is *named*.
"""

import argparse
import collections
import itertools
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lagjax
from benchmarks import _singles

RTOL, SLACK, SPAN = 1e-9, 1e4, 10.0
SINGLE = 2.0**-24  # half a unit in the last place of float32
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)
DOUBLINGS = 2.0 ** np.arange(-3.0, 30.0)


class Family(NamedTuple):
    """A feature of (z, w) as JAX takes it, and in NumPy; `edge` where it has two sides; the least w of its digits."""

    of_jax: Callable[..., Any]
    of_numpy: Callable[..., Any]
    edge: bool = False
    least: float = 1e-7


def _even(w: float) -> int:
    """The power of cos(u / 2) that is as narrow as exp(−(u / w)²)."""
    return 2 * round(4 / w**2)


def _twice(function: Callable, **more) -> Family:
    """A family of arithmetic alone."""
    return Family(function, function, **more)


FAMILIES = {
    "2 ** -z²": _twice(lambda z, w: 2.0 ** -(z**2)),
    "(1 + z²) ** -n": _twice(lambda z, w: (1 + z**2) ** -2),
    "(1 + z²/9) ** -9": _twice(lambda z, w: (1 + z**2 / 9) ** -9),
    "1 / (1 + z¹⁰)": _twice(lambda z, w: 1 / (1 + z**10)),
    "(1 + z²) ** -2.5": _twice(lambda z, w: (1 + z**2) ** -2.5),
    "three Lorentzians": _twice(lambda z, w: 1 / ((1 + z**2) * (1 + (z - 0.5) ** 2) * (1 + 4 * (z + 0.3) ** 2))),
    "cos ** n": Family(
        lambda z, w: jnp.cos(0.5 * w * z) ** _even(w), lambda z, w: np.cos(0.5 * w * z) ** _even(w), least=1e-3
    ),
    "(cos²) ** x": Family(
        lambda z, w: (jnp.cos(0.5 * w * z) ** 2) ** (4 / w**2),
        lambda z, w: (np.cos(0.5 * w * z) ** 2) ** (4 / w**2),
        least=1e-3,
    ),
    "one Lorentzian": _twice(lambda z, w: 1 / (1 + z * z)),
    "z / √(1 + z²)": Family(lambda z, w: z / jnp.sqrt(1 + z**2), lambda z, w: z / np.sqrt(1 + z**2), edge=True),
    "norm ** -3": Family(
        lambda z, w: jnp.linalg.norm(jnp.stack([z, jnp.ones_like(z)])) ** -3, lambda z, w: (1 + z**2) ** -1.5
    ),
    "cbrt ** -4": Family(lambda z, w: jnp.cbrt(1 + z**2) ** -4, lambda z, w: np.cbrt(1 + z**2) ** -4),
}  # fmt: skip
COLLISIONS = {
    "Lennard-Jones": (lambda s: s**-6 - s**-3, lambda s: 12 * s**-7 - 6 * s**-4),
    "(q·q)⁻⁶": (lambda s: s**-6, lambda s: 12 * s**-7),
    "r⁻⁴": (lambda s: s**-2, lambda s: 4 * s**-3),
    "r⁻⁶": (lambda s: jnp.sqrt(s) ** -6, lambda s: 6 * s**-4),
    "softened": (lambda s: (s + 1e-2) ** -3, lambda s: 6 * (s + 1e-2) ** -4),
    "attractive 1/r": (lambda s: -1 / jnp.sqrt(s), lambda s: -(s**-1.5)),
}


def free(q, v):
    """L of a free unit mass."""
    return 0.5 * v**2


FREE = lagjax.System(free)


def quadrature(function: Callable, a: float, b: float, c: float, w: float) -> float:
    """∫ f from a to b, where f varies about c on the scale w."""
    breaks = np.unique(np.clip([a, b, c, *(c + w * DOUBLINGS), *(c - w * DOUBLINGS)], a, b))
    middle, half = (breaks[1:] + breaks[:-1]) / 2, (breaks[1:] - breaks[:-1]) / 2
    return float(np.sum(function(middle[:, None] + half[:, None] * NODES) * WEIGHTS * half[:, None]))


def in_time(family: Family, c: float, w: float, rng) -> tuple[Any, np.ndarray, Any]:
    """The end of a motion under a force A f((t − c) / w), and the exact one."""
    strength = rng.uniform(0.3, 2.0) / (1.0 if family.edge else w)
    numbers = jnp.asarray([strength, c, w], float)

    def push(q, v, t, params):
        return params[0] * family.of_jax((t - params[1]) / params[2], w)

    run = end(lagjax.System(free, forces=push), 0.0, 0.7, SPAN, numbers)
    strength, c, w = np.asarray(numbers, float)

    def force(t):
        return strength * family.of_numpy((t - c) / w, w)

    v = 0.7 + quadrature(force, 0.0, SPAN, c, w)
    q = 0.7 * SPAN + quadrature(lambda t: (SPAN - t) * force(t), 0.0, SPAN, c, w)
    return run, np.array([q, v]), c


def in_place(family: Family, c: float, w: float, rng) -> tuple[Any, np.ndarray, Any]:
    """The end of a motion over, or back from, a potential A f((q − c) / w), and the exact one."""
    height = rng.uniform(-0.6, 0.3)
    numbers = jnp.asarray([height, c, w], float)

    def lagrangian(q, v, params):
        return 0.5 * v**2 - params[0] * family.of_jax((q - params[1]) / params[2], w)

    height, c, w = np.asarray(numbers, float)

    def speed(q):
        return np.sqrt(1 - 2 * height * (family.of_numpy((q - c) / w, w) - family.of_numpy(-c / w, w)))

    last = SPAN - 0.5
    run = end(lagjax.System(lagrangian), 0.0, 1.0, quadrature(lambda q: 1 / speed(q), 0.0, last, c, w), numbers)
    return run, np.array([last, speed(last)]), c


def as_guard(family: Family, c: float, w: float, rng) -> tuple[Any, np.ndarray, Any]:
    """The times at which f((x − c) / w) of the time, or of a free motion, crosses a level, and the exact ones."""
    level, by_time = rng.uniform(0.2, 0.8), rng.random() < 0.5
    numbers = jnp.asarray([level, c, w], float)
    level, c, w = np.asarray(numbers, float)

    def guard(q, v, t, params):
        return family.of_jax(((t if by_time else q) - params[1]) / params[2], w) - params[0]

    found = lagjax.crossings(FREE, guard, 0.0, 1.0, (0.0, SPAN), numbers, count=4)
    z = np.linspace(-40, 40, 4001)
    at = family.of_numpy(z, w) - level
    roots = np.flatnonzero(at[1:] * at[:-1] < 0)
    exact = [brentq(lambda z: family.of_numpy(z, w) - level, *z[[i, i + 1]]) for i in roots]
    times = np.asarray(found.t, float)
    times = times[np.isfinite(times)]
    if len(times) != len(exact):
        times = np.full(len(exact), np.nan)  # wrong
    return found, c + w * np.array(exact), times


def collision(name: str, rng):
    """The velocity after a collision, the exact one, and that of a start moved a little."""
    potential, push = COLLISIONS[name]
    d, b, v = 10 ** rng.uniform(2, 6), rng.uniform(-1.5, 1.5), rng.uniform(0.5, 3.0)
    b, T = (math.copysign(0.3, b) + b if name == "attractive 1/r" else b), 2 * d / v

    def lagrangian(q, qdot):
        return 0.5 * qdot @ qdot - potential(q @ q)

    start = np.asarray(jnp.asarray([-d, b], float), float)
    ts, system = jnp.array([0.0, T]), lagjax.System(lagrangian)
    run = lagjax.simulate(system, jnp.asarray(start, float), jnp.array([v, 0.0]), ts, throw=False)

    def after(b, v):
        def rate(t, y):
            return [*y[2:], *(push(y[0] ** 2 + y[1] ** 2) * y[:2])]

        breaks = np.unique(np.clip(d / v + np.append(np.append(-DOUBLINGS, 0.0), DOUBLINGS), 0.0, T))
        breaks, y = np.unique([0.0, *breaks, T]), np.array([start[0], b, v, 0.0])
        for a, e in itertools.pairwise(breaks):
            y = solve_ivp(rate, (a, e), y, "DOP853", rtol=1e-13, atol=1e-13, max_step=(e - a) / 3).y[:, -1]
        return y[2:]

    exact = after(start[1], v)
    return run, exact, after(start[1] + 1e-7, v * (1 + 1e-7))


def end(system, q, v, T, params):
    """A motion from 0 to T."""
    return lagjax.simulate(system, q, v, jnp.array([0.0, T]), params, throw=False)


SETTINGS = {"time": in_time, "place": in_place, "guard": as_guard}


def compared(seed: int, single: bool) -> tuple[str, float, int, str]:
    """What became of one scene: its name, its error in parts of what is allowed, steps, and its text."""
    rng = np.random.default_rng(seed)
    digits, growth = SINGLE if single else 0.0, 1.0
    if seed % 4 == 3:
        name = list(COLLISIONS)[seed // 4 % len(COLLISIONS)]
        text = f"collision with {name}"
        run, exact, near = collision(name, rng)
        got, growth = np.asarray(run.qdot[-1], float), np.abs(near - exact).max() / 1e-7
        allowed = SLACK * RTOL * (1 + growth) + 100 * digits * (1 + growth)
    else:
        setting, name = list(SETTINGS)[seed % 4], list(FAMILIES)[seed // 4 % len(FAMILIES)]
        family, c = FAMILIES[name], rng.uniform(3.8, 6.2)
        w = 10 ** rng.uniform(math.log10(family.least), -1)
        if single:
            w = max(w, 1e-5)  # what float32 tells from its neighbours at c
        text = f"{name} in {setting}, c = {c:.4f}, w = {w:.1e}"
        run, exact, more = SETTINGS[setting](family, c, w, rng)
        got = more if setting == "guard" else np.array([run.q[-1], run.qdot[-1]], float)
        allowed = SLACK * RTOL + 100 * digits
        if setting == "guard":  # whose times are known to a part of the width, or to rounding
            allowed = max(0.01 * w, 1e-12) + 100 * digits * SPAN
    steps = int(run.stats["num_steps"]) + int(run.stats["num_rejected_steps"]) if hasattr(run, "stats") else 0
    if not bool(run.ok):
        return "named", math.nan, steps, f"{str(getattr(run, 'result', ''))[:100]} {text}"
    error = float(np.abs(got - exact).max(initial=0.0) / allowed)
    return ("right" if error <= 1.0 else "wrong"), error, steps, f"{text}: {got} for {exact}"


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.narrow_features", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    _singles.add_option(parser)
    options = parser.parse_args(arguments)
    _singles.precision_of(options)
    counts, steps = collections.Counter(), []
    for seed in range(options.first, options.first + options.scenes):
        name, error, taken, text = compared(seed, options.float32)
        counts[name] += 1
        steps.append(taken)
        if name != "right":
            print(f"{seed} {name}: {error:.1e} of what is allowed, {taken} steps: {text}", flush=True)
        if sum(counts.values()) % 50 == 0:
            print(f"up to {seed}: {dict(counts)}", file=sys.stderr, flush=True)
    print(f"{dict(counts)}; steps: median {np.median(steps):.0f}, most {max(steps)}", file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
