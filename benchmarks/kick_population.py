"""Random scenes in which L jumps, in every spelling, by place and by time: is any value or gradient wrong?

    python -m benchmarks.kick_population --scenes 200
    python -m benchmarks.kick_population --scenes 200 --float32

What jumps is the potential, the mass or a vector potential; the spellings are those of `benchmarks.jump_population`.
The reference goes from level to level with DOP853 (SciPy) on equations by hand, with the momentum along a border and
the energy (or, by time, the whole momentum) as they were before it; where the energy does not suffice, it reflects.
"""

import functools
import sys
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax
from benchmarks import jump_population
from benchmarks.jump_population import DURATION, NEAREST, SLOWEST, Spelling

STENCIL = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60  # a slope to order six, of forms that vary over 1
STEP = 2e-3
OPTIONS = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "max_step": 0.02}  # no level is stepped over twice
NEARLY = 0.02  # how near the energy behind a border may be to what it takes, in units of that before it


def slope(form: Callable, u: float, k: int) -> float:
    """The derivative of a smooth form."""
    return sum(w * float(form(u + i * STEP, k)) for i, w in zip(range(-3, 4), STENCIL, strict=True)) / STEP


def integrate(spelling: Spelling, rates: Callable, number: Callable, kick: Callable, y0) -> np.ndarray | None:
    """The end of ẏ = `rates(t, y, J, J′)`, J the value of the spelling at u = `number(t, y)`.

    At a level `kick(y, J⁻, J⁺)` gives the state behind it and how far it is from being reflected, or None.
    """
    t, y, levels = 0.0, np.array(y0, float), np.r_[-np.inf, spelling.levels, np.inf]
    k = int(np.searchsorted(spelling.levels, number(t, y)))
    for _ in range(200):

        def field(t, y, k=k):
            u = number(t, y)
            return rates(t, y, float(spelling.form(u, k)), slope(spelling.form, u, k))

        ends = []
        for level, direction in ((levels[k], -1), (levels[k + 1], 1)):
            if np.isfinite(level):
                ends.append(lambda t, y, level=level: number(t, y) - level)
                ends[-1].terminal, ends[-1].direction = True, direction
        done = solve_ivp(field, (t, DURATION), y, events=ends or None, **OPTIONS)
        t, y = float(done.t[-1]), done.y[:, -1]
        if done.status == 0:
            return y
        after = (number(t + 1e-6, y + 1e-6 * np.array(field(t, y))) - number(t, y)) / 1e-6
        if abs(after) < SLOWEST or DURATION - t < NEAREST:
            return None
        beyond, u = k + int(np.sign(after)), number(t, y)
        y, part = kick(y, float(spelling.form(u, k)), float(spelling.form(u, beyond)))
        if abs(part) < NEARLY:
            return None
        k = beyond if part > 0 else k
        leaves = (number(t + 1e-6, y + 1e-6 * np.array(field(t, y, k))) - number(t, y)) / 1e-6
        if abs(leaves) < SLOWEST:
            return None
    return None


def _passes(y, i: int, squared: float) -> tuple[np.ndarray, float]:
    """The state whose velocity i is kicked to ±√squared, or reflected."""
    y, part = np.array(y), squared / y[i] ** 2
    y[i] = np.copysign(np.sqrt(squared), y[i]) if squared > 0 else -y[i]
    return y, part


def _kind(lagrangian: Callable, rates: Callable, kick: Callable, in_time: bool, size: int) -> Callable:
    """A function of spellings that gives the run and the reference of p = (a, b, c, q, q̇)."""

    @functools.cache
    def of(spelling: Spelling):
        def L(q, v, t, params):
            u = t - 3 if in_time else q if size == 1 else q[0]
            return lagrangian(q, v, params[0] * spelling.function(params[1] * u + params[2]))

        scene = lagjax.System(L)

        def start(p, library):
            return (p[3], p[4]) if size == 1 else (library.stack([p[3], 0 * p[3] + 0.5]), library.stack([p[4], p[3]]))

        def run(p):
            q, v = start(p, jnp)
            found = lagjax.simulate(scene, q, v, jnp.array([0.0, DURATION], p.dtype), p[:3])
            return jnp.concatenate([jnp.ravel(found.q[-1]), jnp.ravel(found.qdot[-1])])

        def reference(p):
            a, b, c = p[:3]
            return integrate(
                spelling, lambda t, y, J, slope: rates(y, a * J, a * b * slope),
                lambda t, y: b * (t - 3 if in_time else y[0]) + c, lambda y, J, K: kick(y, a * J, a * K),
                np.ravel(start(p, np)),
            )  # fmt: skip

        return run, reference

    return of


# In every one the force of a spring besides, of strength one; slopes are those by u's place or time.
KINDS: dict[str, Callable] = {
    "potential by place": _kind(
        lambda q, v, J: 0.5 * v**2 - 0.5 * q**2 - J, lambda y, J, slope: [y[1], -y[0] - slope],
        lambda y, J, K: _passes(y, 1, y[1] ** 2 - 2 * (K - J)), False, 1),
    "mass by place": _kind(
        lambda q, v, J: 0.5 * jnp.exp(0.4 * J) * v**2 - 0.5 * q**2,
        lambda y, J, slope: [y[1], -y[0] / np.exp(0.4 * J) - 0.2 * slope * y[1] ** 2],
        lambda y, J, K: _passes(y, 1, y[1] ** 2 * np.exp(0.4 * (J - K))), False, 1),
    "field by place": _kind(
        lambda q, v, J: 0.5 * v @ v - 0.5 * q @ q + J * v[1],
        lambda y, J, slope: [y[2], y[3], -y[0] + slope * y[3], -y[1] - slope * y[2]],
        lambda y, J, K: _sheet(y, K - J), False, 2),
    "field by time": _kind(
        lambda q, v, J: 0.5 * v**2 - 0.5 * q**2 + J * v, lambda y, J, slope: [y[1], -y[0] - slope],
        lambda y, J, K: (y - np.array([0.0, K - J]), 1.0), True, 1),
    "mass by time": _kind(
        lambda q, v, J: 0.5 * jnp.exp(0.4 * J) * v**2 - 0.5 * q**2,
        lambda y, J, slope: [y[1], -y[0] / np.exp(0.4 * J) - 0.4 * slope * y[1]],
        lambda y, J, K: (y * np.array([1.0, np.exp(0.4 * (J - K))]), 1.0), True, 1),
}  # fmt: skip


def _sheet(y, change: float) -> tuple[np.ndarray, float]:
    """A sheet of magnetic field across x: p along it and the speed stay."""
    along = y[3] - change
    kicked, part = _passes(y, 2, y[2] ** 2 + y[3] ** 2 - along**2)
    if part > 0:
        kicked[3] = along
    return kicked, part


def main(arguments: list[str] | None = None):
    """Compare so many scenes, print those that are not right, and count them."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    kinds = [] if "--kinds" in arguments else ["--kinds", *KINDS]
    jump_population.KINDS.update(KINDS)
    return jump_population.main([*arguments, *kinds])


if __name__ == "__main__":
    main()
