"""Random lattices on arrays, against right-hand sides in NumPy: is any motion wrong, or M not what its pattern says?

    python -m benchmarks.lattice_population --scenes 100
    python -m benchmarks.lattice_population --scenes 100 --float32
    python -m benchmarks.lattice_population --couplings --scenes 300    # benchmarks/results/couplings.json

A lattice has one or two dimensions, is periodic or has free ends, and has springs with a quadratic and a quartic term
and an on-site potential of φ⁴ or sine-Gordon. One mass may be a thousand times the others, one spring be cut, the mass
matrix is lumped (diagonal) or consistent (of linear elements along the rows: tridiagonal), a part may have masses that
depend on their place, drag and drive. The reference is SciPy's DOP853 at 1e-12 with derivatives by hand. An end is
*wrong* where it is off by more than 1000 tolerances times the growth of a small error of the start.

`--couplings`: accelerations of random couplings (`_couplings`), in masses and in constraints, put into the equations of
motion by products of derivatives alone: *wrong* where these are missed by more than 1e-8 of their terms.
"""

import argparse
import collections
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

import lagjax
from benchmarks import _report
from benchmarks._couplings import CoupledScene

STORE = Path(__file__).parent / "results" / "couplings.json"
LONGEST = 120  # CPU seconds that a coupling may take

T, RTOL, SLACK = 2.0, 1e-9, 1e3


class Lattice(NamedTuple):
    """A lattice of `shape` N sites. `springs` (S, 3): both ends and the stiffness; `masses` (N,)."""

    shape: tuple[int, ...]
    springs: np.ndarray
    masses: np.ndarray
    consistent: bool
    varying: float
    on_site: str
    quartic: float
    drag: float
    drive: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Lattice":
        """A lattice of 1000 to 3000 sites."""
        plane, periodic = rng.random() < 0.5, rng.random() < 0.5
        shape = (int(rng.integers(30, 50)), int(rng.integers(34, 60))) if plane else (int(rng.integers(1000, 3000)),)
        sites, ends = np.arange(np.prod(shape)).reshape(shape), []
        for axis in range(len(shape)):
            ahead = np.roll(sites, -1, axis)
            inside = np.ones(shape, bool)
            inside[(slice(None),) * axis + (-1,)] = periodic
            ends.append(np.stack([sites[inside], ahead[inside]], axis=1))
        ends = np.concatenate(ends)
        stiffness = np.ones(len(ends)) * rng.uniform(0.5, 2.0)
        if rng.random() < 0.5:
            stiffness[rng.integers(len(ends))] = 0.0
        masses = np.ones(sites.size) * rng.uniform(0.5, 2.0)
        if rng.random() < 0.5:
            masses[rng.integers(sites.size)] *= 1e3
        consistent = bool(rng.random() < 0.4)
        return cls(
            shape,
            np.column_stack([ends, stiffness]),
            masses,
            consistent,
            0.0 if consistent else float(rng.choice([0.0, 0.2])),
            str(rng.choice(["none", "phi4", "sine"])),
            float(rng.choice([0.0, 0.3])),
            float(rng.choice([0.0, 0.1])),
            float(rng.choice([0.0, 0.5])),
        )

    @property
    def name(self) -> str:
        """What is special about it."""
        mass = "consistent" if self.consistent else "varying" if self.varying else "lumped"
        return f"{'plane' if len(self.shape) == 2 else 'line'}, {mass}"

    def system(self) -> lagjax.System:
        """The scene, as a user writes it: sums over arrays."""
        first, second = self.springs[:, :2].astype(int).T
        stiffness, m = self.springs[:, 2], self.masses

        def lagrangian(q, qdot):
            u, v = q.ravel(), qdot.ravel()
            if self.consistent:  # (2 1; 1 2)/6 for the element between each site and the next one in memory
                kinetic = jnp.sum(m[1:] * (v[1:] ** 2 + v[1:] * v[:-1] + v[:-1] ** 2)) / 6
            else:
                kinetic = 0.5 * jnp.sum(m * (1 + self.varying * jnp.sin(u) ** 2) * v**2)
            d = u[second] - u[first]
            potential = jnp.sum(stiffness * (0.5 * d**2 + 0.25 * self.quartic * d**4))
            if self.on_site == "phi4":
                potential += 0.25 * jnp.sum((u**2 - 1) ** 2)
            elif self.on_site == "sine":
                potential += jnp.sum(1 - jnp.cos(u))
            return kinetic - potential

        def forces(q, qdot, t):
            push = self.drive * jnp.cos(3 * t) * (jnp.arange(q.size) % 7 == 0)
            return -self.drag * qdot + push.reshape(q.shape)

        return lagjax.System(lagrangian, forces=forces if self.drag or self.drive else None)

    def field(self):
        """ẏ = f(t, y) by hand."""
        first, second = self.springs[:, :2].astype(int).T
        stiffness, m, n = self.springs[:, 2], self.masses, len(self.masses)
        pushed = np.arange(n) % 7 == 0
        if self.consistent:
            diagonal, beside = np.zeros(n), m[1:] / 6
            diagonal[1:] += m[1:] / 3
            diagonal[:-1] += m[1:] / 3
            i = np.arange(n - 1)
            rows, columns = np.r_[np.arange(n), i, i + 1], np.r_[np.arange(n), i + 1, i]
            solve = splu(csc_array((np.r_[diagonal, beside, beside], (rows, columns)))).solve

        def f(t, y):
            u, v = np.split(y, 2)
            d = u[second] - u[first]
            pull = stiffness * (d + self.quartic * d**3)
            force = np.bincount(first, pull, n) - np.bincount(second, pull, n)
            if self.on_site == "phi4":
                force -= u * (u**2 - 1)
            elif self.on_site == "sine":
                force -= np.sin(u)
            force += self.drive * np.cos(3 * t) * pushed - self.drag * v
            if self.consistent:
                return np.concatenate([v, solve(force)])
            by_place = self.varying * np.sin(2 * u)  # of 1 + varying sin² u
            return np.concatenate([v, (force / m - 0.5 * by_place * v**2) / (1 + self.varying * np.sin(u) ** 2)])

        return f


def judge(lattice: Lattice, seed: int, dtype) -> tuple[str, float]:
    """ "right", "wrong" or how the motion ended, and its error in tolerances times the growth."""
    rng, n = np.random.default_rng(seed), len(lattice.masses)
    q, v = (rng.normal(size=n).astype(dtype) * dtype(0.4) for _ in range(2))
    trajectory = lagjax.simulate(
        lattice.system(), q.reshape(lattice.shape), v.reshape(lattice.shape), np.array([0.0, T], dtype), throw=False
    )
    if not trajectory.ok:
        return str(lagjax.RESULTS[trajectory.result])[:40], np.nan
    start = np.concatenate([q, v]).astype(float)
    beside = start + 1e-6 * rng.normal(size=2 * n)
    exact, other = (
        solve_ivp(lattice.field(), (0.0, T), y, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1] for y in (start, beside)
    )
    growth = max(np.abs(other - exact).max() / 1e-6, 1.0)
    end = np.concatenate([np.ravel(trajectory.q[-1]), np.ravel(trajectory.qdot[-1])])
    rtol = RTOL if dtype is np.float64 else 1e-5
    error = np.abs(end - exact).max() / (rtol * growth * np.abs(exact).max())
    return "right" if error <= SLACK else "WRONG", error


def judge_coupling(seed: int) -> dict:
    """The row of a coupling: "right", "wrong", "undetermined", "hangs", or the error that it raised."""
    rng = np.random.default_rng((7, seed))
    scene = CoupledScene.draw(rng)
    state, start = scene.state(rng), time.process_time()
    system = lagjax.System(scene.functions[0], constraints=scene.functions[1], path=scene.path)
    row = {"seed": seed, "n": scene.n, "path": scene.path, "terms": list(scene.names)}
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        multipliers = None if scene.functions[1] is None else system.multipliers(*state)
        acceleration = system.acceleration(*state)
        missed = scene.missing(acceleration, multipliers, state)
        row |= {"verdict": "undetermined" if np.isnan(missed) else "right" if missed < 1e-8 else "WRONG", "by": missed}
    except _TooLong:
        row["verdict"] = "hangs"
    except Exception as error:  # a sentence or a raw one: who reads the row tells
        row |= {"verdict": type(error).__name__, "says": str(error)[:300]}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return row | {"seconds": round(time.process_time() - start, 2)}


class _TooLong(Exception):
    pass


def judge_couplings(seeds: range) -> int:
    """Print and store the verdicts; the exit status says whether any acceleration is not right."""

    def stop(*_):
        raise _TooLong

    signal.signal(signal.SIGPROF, stop)  # CPU time: a busy machine makes no hang
    rows = {row["seed"]: row for row in _report.read_json(STORE).get("couplings", {}).get("rows", [])}
    for seed in seeds:
        rows[seed] = row = judge_coupling(seed)
        if row["verdict"] != "right":
            print(row, flush=True)
        record = {"circumstances": _report.circumstances(), "rows": [rows[k] for k in sorted(rows)]}
        _report.write_json(STORE, {"couplings": record})  # a long run may be interrupted
        jax.clear_caches()
    counts = collections.Counter(rows[seed]["verdict"] for seed in seeds)
    print(dict(counts), f"longest {max(rows[seed]['seconds'] for seed in seeds):.1f} s")
    return set(counts) != {"right"}


def main() -> int:
    """Print the verdicts by kind; the exit status says whether any motion is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of lattices, or the first of couplings")
    parser.add_argument("--couplings", action="store_true")
    parser.add_argument("--float32", action="store_true", help="states in float32, without the x64 switch")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", not options.float32)
    if options.couplings:
        return judge_couplings(range(options.seed, options.seed + options.scenes))
    verdicts, errors = collections.Counter(), []
    for k in range(options.scenes):
        lattice = Lattice.draw(np.random.default_rng((options.seed, k)))
        verdict, error = judge(lattice, k, np.float32 if options.float32 else np.float64)
        verdicts[lattice.name, verdict] += 1
        errors.append(error)
        if verdict != "right":
            print(k, lattice.name, lattice.shape, verdict, error, flush=True)
    for (name, verdict), count in sorted(verdicts.items()):
        print(f"{name:20s} {verdict:10s} {count}")
    print(f"errors in tolerances times growth: median {np.nanmedian(errors):.2g}, largest {np.nanmax(errors):.2g}")
    return any(verdict == "WRONG" for _, verdict in verdicts)


if __name__ == "__main__":
    sys.exit(main())
