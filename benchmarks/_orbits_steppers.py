"""Do structure-preserving steps pay? Energy against time for the star of Hénon and Heiles, over many periods.

    python -m benchmarks._orbits_steppers --periods 10000

Störmer–Verlet, the variational integrator of order 2, and symmetric compositions of it of order 4 (3 stages), 6 (9)
and 8 (15), compiled by numba, with summation that carries rounding errors; against Taylor series of lagjax for one
motion. Each at several steps or tolerances: CPU seconds, and the largest relative error of the energy.

Source: Yoshida, Phys. Lett. A 150 (1990) 262; Kahan & Li, Math. Comp. 66 (1997) 1089; Hairer, Lubich & Wanner,
*Geometric Numerical Integration*, §V.3, §VI.6 and §VIII.5.
"""

import argparse
import time

import jax
import numba
import numpy as np

import lagjax
from benchmarks._orbits_sections import HENON_HEILES

STAGES = {
    2: [1.0],
    4: [1 / (2 - 2 ** (1 / 3)), 1 - 2 / (2 - 2 ** (1 / 3))],
    6: [0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.08221359629355080023,
        0.79854399093482996340],
    8: [0.74167036435061295345, -0.40910082580003159400, 0.19075471029623837995, -0.57386247111608226666,
        0.29906418130365592384, 0.33462491824529818378, 0.31529309239676659663, -0.79688793935291635402],
}  # fmt: skip
STEPS = {2: (400, 1600, 6400), 4: (100, 400, 1600), 6: (20, 40, 80, 160), 8: (10, 20, 40, 80)}  # in a period
PERIOD, OUTPUTS = 6.3, 1000
START = np.array([0.0, 0.2]), np.array([0.4, 0.1])


@numba.njit(cache=False)
def _follow(q, v, h, stages, steps, outputs):
    """The largest |E(t) − E(0)|/E(0) at the outputs, of drift–kick–drift compositions."""
    x, y = q
    u, w = v
    first = 0.5 * (u * u + w * w + x * x + y * y) + x * x * y - y * y * y / 3
    worst, cx, cy, cu, cw = 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(outputs):
        for _ in range(steps):
            for s in stages:
                for half in range(2):
                    d = 0.5 * h * s * u - cx
                    t = x + d
                    cx, x = (t - x) - d, t
                    d = 0.5 * h * s * w - cy
                    t = y + d
                    cy, y = (t - y) - d, t
                    if half == 0:
                        d = -h * s * (x + 2 * x * y) - cu
                        t = u + d
                        cu, u = (t - u) - d, t
                        d = -h * s * (y + x * x - y * y) - cw
                        t = w + d
                        cw, w = (t - w) - d, t
        energy = 0.5 * (u * u + w * w + x * x + y * y) + x * x * y - y * y * y / 3
        worst = max(worst, abs(energy / first - 1))
    return worst


def main() -> None:
    """Print a row for each stepper and step, and what is fastest at each accuracy."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks._orbits_steppers", description=__doc__.splitlines()[0])
    parser.add_argument("--periods", type=int, default=10_000)
    periods = parser.parse_args().periods
    rows = [*_splittings(periods), *_series(periods)]
    for name, seconds, error in rows:
        print(f"{name:34s} {seconds:9.3f} CPU s   energy {error:.1e}")
    for wanted in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13, 1e-14):
        enough = [row for row in rows if row[2] <= wanted]
        if enough:
            print(f"energy to {wanted:.0e} over {periods} periods: {min(enough, key=lambda row: row[1])[0]}")


def _splittings(periods: int):
    for order, half in STAGES.items():
        stages = np.array([*half, *half[-2::-1]])
        for per_period in STEPS[order]:
            steps = max(1, round(periods * per_period / OUTPUTS))
            _follow(*START, PERIOD / per_period, stages, 1, 1)
            begin = time.process_time()
            error = _follow(*START, PERIOD / per_period, stages, steps, OUTPUTS)
            yield f"splitting {order}, {per_period} steps a period", time.process_time() - begin, error


def _series(periods: int):
    ts = np.linspace(0.0, PERIOD * periods, OUTPUTS + 1)
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14, 1e-15):
        lagjax.simulate(HENON_HEILES, *START, ts[:2], rtol=rtol)
        begin = time.process_time()
        run = lagjax.simulate(HENON_HEILES, *START, ts, rtol=rtol, max_steps=2**30)
        seconds, energy = time.process_time() - begin, np.asarray(run.energy())
        yield f"series, rtol = {rtol:.0e}", seconds, float(np.abs(energy / energy[0] - 1).max())


if __name__ == "__main__":
    main()
