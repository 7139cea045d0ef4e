"""Poincaré sections of Hénon and Heiles' star and of a double pendulum: the time beside the same run without them.

    python -m benchmarks._orbits_sections --starts 10000 --crossings 1000

Starts lie on the section at one energy. Of a few the crossings are found again by bracketing and bisection on states of
the motion at 1e-15, which an integration to the time in question gives.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import lagjax
from benchmarks._figures import save
from lagjax import scenes

CHUNK, RTOL = 2000, 1e-9


def _henon_heiles(q, qdot):
    return 0.5 * qdot @ qdot - 0.5 * q @ q - q[0] ** 2 * q[1] + q[1] ** 3 / 3


HENON_HEILES = lagjax.System(_henon_heiles)


def _first(q, qdot):
    return q[0]


def main() -> None:
    """Find the crossings of both scenes, print times and errors, draw the sections."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks._orbits_sections", description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=10_000)
    parser.add_argument("--crossings", type=int, default=1000, help="of each start, about")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    options.output.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for name, (system, params, q0, qdot0, period) in {
        "henon_heiles": _stars(rng, options.starts),
        "double_pendulum": _pendulums(rng, options.starts),
    }.items():
        end = period * options.crossings
        seconds, plain, total, shown = _measured(system, params, q0, qdot0, end, options.crossings)
        print(
            f"{name}: {total} crossings of {len(q0)} starts in {seconds:.1f} CPU s; without them {plain:.1f} CPU s",
            end="",
        )
        print(f" ({seconds / plain:.2f}); against brackets {_error(system, params, q0, qdot0, 20 * period):.1e}")
        _figure(name, shown, options.output / f"section_{name}.png")


def _stars(rng, count: int):
    """Starts at x = 0 with E = 1/8, moving to larger x."""
    energy, y, up = 1 / 8, rng.uniform(-0.4, 0.55, 4 * count), rng.uniform(-0.45, 0.45, 4 * count)
    left = 2 * (energy - 0.5 * y**2 + y**3 / 3) - up**2
    y, up, left = (x[left > 1e-6][:count] for x in (y, up, left))
    return HENON_HEILES, None, np.stack([0 * y, y], 1), np.stack([np.sqrt(left), up], 1), 6.3


def _pendulums(rng, count: int):
    """Starts with θ1 = 0, rising, at an energy 9 above rest."""
    scene = scenes.double_pendulum()
    energy, th2, w2 = 9.0, rng.uniform(-1.4, 1.4, 4 * count), rng.uniform(-4.0, 4.0, 4 * count)
    g, c = scene.params["g"], np.cos(th2)
    # w1² + c w1 w2 + w2²/2 + g (1 − c) = E, the larger root.
    inside = (c * w2) ** 2 / 4 - (w2**2 / 2 + g * (1 - c) - energy)
    th2, w2, c, inside = (x[inside > 1e-6][:count] for x in (th2, w2, c, inside))
    w1 = -c * w2 / 2 + np.sqrt(inside)
    return scene.system, scene.params, np.stack([0 * th2, th2], 1), np.stack([w1, w2], 1), 2.2


def _measured(system, params, q0, qdot0, end: float, room: int):
    """CPU seconds with crossings and without, how many there were, and the crossings of some starts for a figure."""
    ts, count = jnp.array([0.0, end]), room + room // 2 + 8

    @jax.jit
    @jax.vmap
    def crossed(q, qdot):
        return lagjax.crossings(
            system, _first, q, qdot, ts, params, direction=1, count=count, rtol=RTOL, max_steps=2**22, throw=False
        )

    @jax.jit
    @jax.vmap
    def followed(q, qdot):
        return lagjax.simulate(system, q, qdot, ts, params, rtol=RTOL, max_steps=2**22, throw=False).q

    total, shown = 0, None
    for function in (crossed, followed):
        jax.block_until_ready(function(q0[:1], qdot0[:1]))
    seconds = [0.0, 0.0]
    for k in range(0, len(q0), CHUNK):
        chunk = q0[k : k + CHUNK], qdot0[k : k + CHUNK]
        for place, function in enumerate((crossed, followed)):
            begin = time.process_time()
            result = jax.block_until_ready(function(*chunk))
            seconds[place] += time.process_time() - begin
            if function is crossed:
                total += int(result.count.sum())
                shown = jax.tree.map(lambda leaf: leaf[:60], result) if shown is None else shown
    return seconds[0], seconds[1], total, shown


def _error(system, params, q0, qdot0, end: float) -> float:
    """The largest difference of crossing times from roots between outputs, relative to the time, of five starts."""
    worst = 0.0
    for q, qdot in zip(q0[:5], qdot0[:5], strict=True):
        ts = np.linspace(0.0, end, 4001)
        found = lagjax.crossings(system, _first, q, qdot, ts, params, direction=1, count=200, rtol=1e-15)
        run = np.asarray(lagjax.simulate(system, q, qdot, ts, params, rtol=1e-15).q[:, 0])

        def at(t, q=q, qdot=qdot):
            return float(lagjax.simulate(system, q, qdot, np.array([0.0, t]), params, rtol=1e-15).q[-1, 0])

        places = np.flatnonzero((run[1:-1] < 0) & (run[2:] >= 0)) + 1
        roots = np.array([brentq(at, ts[k], ts[k + 1], xtol=1e-15, rtol=1e-15) for k in places])
        assert len(roots) == int(found.count)
        worst = max(worst, float(np.abs(np.asarray(found.t[: len(roots)]) / roots - 1).max()))
    return worst


def _figure(name: str, crossings, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    ax = lagjax.plot.poincare(crossings, lambda q, qdot: (q[1], qdot[1]), size=0.4)
    ax.set(xlabel="y" if name == "henon_heiles" else "θ2", ylabel="ẏ" if name == "henon_heiles" else "θ̇2")
    save(ax.figure, path)


if __name__ == "__main__":
    main()
