"""Chains of pendulums from short chunks of their motions, by candidate terms, and the errors of rollouts over 3 s.

The benchmark of Finzi, Wang and Wilson, "Simplifying Hamiltonian and Lagrangian neural networks via explicit
constraints" (NeurIPS 2020), for chains: chunks of five states, 30 ms apart, each of a motion of its own, and without
noise; then 100 other motions over 3 s from their starts. The error of a rollout is |ẑ − z| / |ẑ + z| for all positions
and velocities z of the masses; its geometric mean is over all times and motions. Starts have angles and rates of
standard normal distributions, rates halved; masses and lengths lie between 0.6 and 1.4, g = 1 (theirs are perturbed and
put back on constraints in addition, which makes a similar spread). Motions are SciPy's, to 1e-12.

L = ½ q̇₀² + Σ params · term: of the kinetic energy and of the potential every number is free but the first, which sets
the scale that no motion shows. The candidates are products of rates, alone and times the cosine and the sine of
differences of angles, cosines and sines of angles, of twice these, and of differences between neighbours.

python -m benchmarks.chains [--links 2 3] [--chunks 800] [--seed 0] [--out FILE]
"""

import argparse
import itertools
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax

STEP, CHUNK, LONG, ROLLOUTS = 0.03, 5, 3.0, 100
PUBLISHED = {2: "CLNN 1.1e-4, DeLaN 1.3e-3", 3: "CLNN 3.3e-4, DeLaN 4.1e-2", 5: "CLNN 9.3e-4, DeLaN 0.33"}
CURVE = {10: "1.3e-2", 100: "6.4e-4", 1000: "9.7e-5", 10000: "2.5e-5"}


class Chain:
    """A chain of point masses on massless rods, by the angles of the rods from the vertical."""

    def __init__(self, links: int, rng: np.random.Generator):
        self.links = links
        self.masses, self.lengths = rng.uniform(0.6, 1.4, (2, links))
        below = np.cumsum(self.masses[::-1])[::-1]
        places = np.arange(links)
        self.inertia = np.outer(self.lengths, self.lengths) * below[np.maximum.outer(places, places)]
        self.weight = self.lengths * below

    def rate(self, t, y):
        """The rates of a state (2n,)."""
        q, v = np.split(y, 2)
        apart = q[:, None] - q
        right = -(self.inertia * np.sin(apart)) @ v**2 - self.weight * np.sin(q)
        return np.concatenate([v, np.linalg.solve(self.inertia * np.cos(apart), right)])

    def starts(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Random states (count, 2n)."""
        return rng.normal(size=(count, 2 * self.links)) * np.repeat([1.0, 0.5], self.links)

    def follow(self, start: np.ndarray, ts: np.ndarray) -> np.ndarray:
        """The states (T, 2n) at times from 0 on."""
        return solve_ivp(self.rate, (0.0, ts[-1]), start, "DOP853", ts, rtol=1e-12, atol=1e-12).y.T

    def masses_at(self, q, v) -> np.ndarray:
        """Positions and velocities (..., 4n) of the masses."""
        parts = np.sin(q), -np.cos(q), np.cos(q) * v, np.sin(q) * v
        return np.concatenate([np.cumsum(self.lengths * part, axis=-1) for part in parts], axis=-1)

    def chunks(self, count: int, rng: np.random.Generator) -> list[lagjax.Record]:
        """Chunks of motions, each from a random time of its own on."""
        found, ts = [], STEP * np.arange(CHUNK)
        for start in self.starts(count, rng):
            begin = STEP * rng.integers(0, round(LONG / STEP) - CHUNK)
            states = self.follow(start, np.append(0.0, begin + ts) if begin else ts)[-CHUNK:]
            q, v = np.split(states, 2, axis=1)
            found.append(lagjax.Record(ts, {"q": q, "v": v}, start=(q[0], v[0])))
        return found


def candidates(links: int) -> lagjax.terms:
    """The terms of the Lagrangian of some chain."""
    found = {f"½ v{i}²": lambda q, v, i=i: 0.5 * v[i] ** 2 for i in range(1, links)}
    for i, j in itertools.combinations(range(links), 2):
        found[f"v{i} v{j}"] = lambda q, v, i=i, j=j: v[i] * v[j]
        found[f"v{i} v{j} cos"] = lambda q, v, i=i, j=j: v[i] * v[j] * jnp.cos(q[i] - q[j])
        found[f"v{i} v{j} sin"] = lambda q, v, i=i, j=j: v[i] * v[j] * jnp.sin(q[i] - q[j])
    for i in range(links):
        found[f"cos q{i}"] = lambda q, v, i=i: jnp.cos(q[i])
        found[f"sin q{i}"] = lambda q, v, i=i: jnp.sin(q[i])
        found[f"cos 2 q{i}"] = lambda q, v, i=i: jnp.cos(2 * q[i])
    for i in range(links - 1):
        found[f"cos q{i} - q{i + 1}"] = lambda q, v, i=i: jnp.cos(q[i] - q[i + 1])
    return lagjax.terms(found)


def measure(links: int, chunks: int, seed: int) -> dict:
    """The fit of one chain, its rollouts, and what both took."""
    rng = np.random.default_rng(seed)
    chain = Chain(links, rng)
    records, law = chain.chunks(chunks, rng), candidates(links)
    scene = lagjax.System(lambda q, v, params: 0.5 * v[0] ** 2 + law(q, v, params=params))
    begun = time.process_time()
    first = law.params0 | {f"½ v{i}²": 1.0 for i in range(1, links)}
    fit = lagjax.fit(scene, records, first, observe=lambda q, qdot: {"q": q, "v": qdot}, method="whole")
    spent = time.process_time() - begun
    ts, starts = STEP * np.arange(round(LONG / STEP) + 1), chain.starts(ROLLOUTS, rng)
    rolled = lagjax.simulate_batch(scene, *np.split(starts, 2, axis=1), ts, fit.params, rtol=1e-12)
    here = chain.masses_at(np.asarray(rolled.q), np.asarray(rolled.qdot))
    true = np.stack([chain.follow(start, ts) for start in starts])
    there = chain.masses_at(*np.split(true, 2, axis=2))
    error = np.linalg.norm(here - there, axis=2) / np.linalg.norm(here + there, axis=2)
    error = float(np.exp(np.mean(np.log(np.maximum(error[:, 1:], 1e-16)))))
    return {
        "links": links, "chunks": chunks, "seed": seed, "terms": len(law.terms), "kept": list(fit.selection.kept),
        "ok": fit.ok, "error": error, "cpu_s": round(spent, 1),
        "message": fit.message,
    }  # fmt: skip


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--links", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--chunks", type=int, nargs="+", default=[800])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a file for the results")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    found = []
    for links, chunks in itertools.product(options.links, options.chunks):
        found.append(measure(links, chunks, options.seed))
        one, theirs = found[-1], CURVE.get(chunks) if links == 2 and chunks != 800 else PUBLISHED.get(links)
        print(
            f"{links} links, {chunks} chunks: error {one['error']:.2g} (theirs {theirs}), {len(one['kept'])} of "
            f"{one['terms']} terms, {one['cpu_s']} CPU s{'' if one['ok'] else ', NOT OK: ' + one['message']}",
            flush=True,
        )
        if options.out:
            options.out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return found


if __name__ == "__main__":
    main()
