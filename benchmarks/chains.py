"""Chains of pendulums from short chunks of their motions, by candidate terms, and the errors of rollouts over 3 s.

The benchmark of Finzi, Wang and Wilson, "Simplifying Hamiltonian and Lagrangian neural networks via explicit
constraints" (NeurIPS 2020), for chains: chunks of five states, 30 ms apart, each of a motion of its own, and without
noise; then 100 other motions over 3 s from their starts. The error of a rollout is |ẑ − z| / |ẑ + z| for all positions
and velocities z of the masses; its geometric mean is over all times and motions. Starts have angles and rates of
standard normal distributions, rates halved; masses and lengths lie between 0.6 and 1.4, g = 1 (theirs are perturbed and
put back on constraints in addition, which makes a similar spread). Motions are SciPy's, to 1e-12.

L = ½ q̇₀² + Σ params · term: of the kinetic energy and of the potential every number is free but the first, which sets
the scale that no motion shows. The candidates are products of rates, alone and times the cosine and the sine of
differences of angles, cosines and sines of angles, of twice these, and of differences between neighbours. With
`--free` nothing is known of the potential: it is a sum of functions of every angle and of the differences between
neighbours, each a spline of 32 knots a turn (`lagjax.learned.potential`), and only the kinetic energy has candidates.

Further scenes of theirs are in `_spatial_scenes`: the magnet pendulum, coupled pendulums, the gyroscope, and the rotor.

python -m benchmarks.chains [--links 2 3] [--free] [--scenes magnet rotor] [--chunks 800] [--seed 0] [--output FOLDER]
"""

import argparse
import itertools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax
from benchmarks import _report
from benchmarks._spatial_scenes import SCENES

CHUNK, ROLLOUTS = 5, 100
KNOTS = 32
TOGETHER = 100  # motions in one system of SciPy's
PUBLISHED = {2: "CLNN 1.1e-4, DeLaN 1.3e-3", 3: "CLNN 3.3e-4, DeLaN 4.1e-2", 5: "CLNN 9.3e-4, DeLaN 0.33"}
CURVE = {10: "1.3e-2", 100: "6.4e-4", 1000: "9.7e-5", 10000: "2.5e-5"}


class Chain:
    """A chain of point masses on massless rods, by the angles of the rods from the vertical."""

    def __init__(self, links: int, rng: np.random.Generator):
        self.links, self.name, self.step, self.long = links, f"chain of {links}", 0.03, 3.0
        self.theirs, self.constraints = PUBLISHED.get(links, "none"), None
        self.masses, self.lengths = rng.uniform(0.6, 1.4, (2, links))
        below = np.cumsum(self.masses[::-1])[::-1]
        places = np.arange(links)
        self.inertia = np.outer(self.lengths, self.lengths) * below[np.maximum.outer(places, places)]
        self.weight = self.lengths * below

    @property
    def free(self) -> dict[str, tuple]:
        """Potentials that are learned: none."""
        return {}

    def make_rate(self):
        """A function of states (N, 2n) that returns their rates."""

        def rate(y):
            q, v = np.split(y, 2, axis=1)
            apart = q[:, :, None] - q[:, None]
            right = -np.matmul(self.inertia * np.sin(apart), v[..., None] ** 2)[..., 0] - self.weight * np.sin(q)
            return np.concatenate([v, np.linalg.solve(self.inertia * np.cos(apart), right[..., None])[..., 0]], axis=1)

        return rate

    def known(self, q, v):
        """The part of the Lagrangian that is known."""
        return 0.5 * v[0] ** 2

    @property
    def first(self) -> dict[str, float]:
        """The numbers of terms with which a fit begins, where they are not zero."""
        return {f"½ v{i}²": 1.0 for i in range(1, self.links)}

    def starts(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Random states (count, 2n)."""
        return rng.normal(size=(count, 2 * self.links)) * np.repeat([1.0, 0.5], self.links)

    def masses_at(self, q, v) -> np.ndarray:
        """Positions and velocities (..., 4n) of the masses."""
        parts = np.sin(q), -np.cos(q), np.cos(q) * v, np.sin(q) * v
        return np.concatenate([np.cumsum(self.lengths * part, axis=-1) for part in parts], axis=-1)

    @property
    def law(self) -> lagjax.terms:
        """The terms of the Lagrangian of some chain."""
        found = {f"½ v{i}²": lambda q, v, i=i: 0.5 * v[i] ** 2 for i in range(1, self.links)}
        for i, j in itertools.combinations(range(self.links), 2):
            found[f"v{i} v{j}"] = lambda q, v, i=i, j=j: v[i] * v[j]
            found[f"v{i} v{j} cos"] = lambda q, v, i=i, j=j: v[i] * v[j] * jnp.cos(q[i] - q[j])
            found[f"v{i} v{j} sin"] = lambda q, v, i=i, j=j: v[i] * v[j] * jnp.sin(q[i] - q[j])
        for i in range(self.links):
            found[f"cos q{i}"] = lambda q, v, i=i: jnp.cos(q[i])
            found[f"sin q{i}"] = lambda q, v, i=i: jnp.sin(q[i])
            found[f"cos 2 q{i}"] = lambda q, v, i=i: jnp.cos(2 * q[i])
        for i in range(self.links - 1):
            found[f"cos q{i} - q{i + 1}"] = lambda q, v, i=i: jnp.cos(q[i] - q[i + 1])
        return lagjax.terms(found)


class FreeChain(Chain):
    """The chain whose potential is learned."""

    def __init__(self, links: int, rng: np.random.Generator):
        super().__init__(links, rng)
        self.name += ", V free"

    @property
    def law(self) -> lagjax.terms:
        """The terms of the kinetic energy of some chain."""
        return lagjax.terms({name: term for name, term in super().law.terms.items() if name.startswith(("½", "v"))})

    @property
    def free(self) -> dict[str, tuple]:
        """The learned potentials by name, each with the angle that it is a function of."""
        learned = lagjax.learned.potential((-np.pi, np.pi), count=KNOTS, periodic=True)
        found = {f"V{i}": (learned, lambda q, i=i: q[i]) for i in range(self.links)}
        return found | {f"V{i}{i + 1}": (learned, lambda q, i=i: q[i] - q[i + 1]) for i in range(self.links - 1)}


def follow(scene, starts: np.ndarray, step: float, long: float) -> np.ndarray:
    """The states (N, T, 2n) of motions at times `step` apart, from SciPy, many of them in one system."""
    rate, ts, found = scene.make_rate(), step * np.arange(round(long / step) + 1), []
    for some in np.array_split(starts, -(-len(starts) // TOGETHER)):

        def flat_rate(t, y, shape=some.shape):
            return np.ravel(rate(y.reshape(shape)))

        done = solve_ivp(flat_rate, (0.0, ts[-1]), some.ravel(), "DOP853", ts, rtol=1e-12, atol=1e-12)
        found.append(done.y.reshape(*some.shape, len(ts)).swapaxes(1, 2))
    return np.concatenate(found)


def make_chunks(scene, count: int, rng: np.random.Generator) -> list[lagjax.Record]:
    """Chunks of motions, each from a random time of its own on."""
    ts, found = scene.step * np.arange(CHUNK), []
    for states in follow(scene, scene.starts(count, rng), scene.step, scene.long):
        begin = rng.integers(0, len(states) - CHUNK)
        q, v = np.split(states[begin : begin + CHUNK], 2, axis=1)
        found.append(lagjax.Record(ts, {"q": q, "v": v}, start=(q[0], v[0])))
    return found


def measure(made, chunks: int, seed: int) -> dict:
    """The fit of one scene, its rollouts, and what both took."""
    rng = np.random.default_rng(seed)
    records, law = make_chunks(made, chunks, rng), made.law

    def lagrangian(q, v, params):
        learned = sum(V(angle(q), params=params[name]) for name, (V, angle) in made.free.items())
        return made.known(q, v) + law(q, v, params=params["law"]) - learned

    scene = lagjax.System(lagrangian, constraints=made.constraints)
    begun, wall = time.process_time(), time.perf_counter()
    first = {"law": law.params0 | made.first} | {name: V.params0 for name, (V, _) in made.free.items()}
    fit = lagjax.fit(scene, records, first, observe=lambda q, qdot: {"q": q, "v": qdot})
    spent, waited = time.process_time() - begun, time.perf_counter() - wall
    starts = made.starts(ROLLOUTS, rng)
    true = follow(made, starts, made.step, made.long)
    ts = made.step * np.arange(true.shape[1])
    rolled = lagjax.simulate_batch(scene, *np.split(starts, 2, axis=1), ts, fit.params, rtol=1e-12)
    here = made.masses_at(np.asarray(rolled.q), np.asarray(rolled.qdot))
    there = made.masses_at(*np.split(true, 2, axis=2))
    error = np.linalg.norm(here - there, axis=2) / np.linalg.norm(here + there, axis=2)
    error = float(np.exp(np.mean(np.log(np.maximum(error[:, 1:], 1e-16)))))
    return {
        "scene": made.name, "chunks": chunks, "seed": seed, "terms": len(law.terms), "kept": len(fit.selection.kept),
        "ok": fit.ok, "error": error, "theirs": made.theirs, "cpu_s": round(spent, 1), "wall_s": round(waited, 1),
        "names": list(fit.selection.kept), "message": fit.message,
    }  # fmt: skip


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--links", type=int, nargs="*", default=[2, 3])
    parser.add_argument("--free", action="store_true", help="the potential of chains is learned, not of known terms")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=[])
    parser.add_argument("--chunks", type=int, nargs="+", default=[800])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="a folder for the record, chains.json, which is added to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    kind = FreeChain if options.free else Chain
    makers = [lambda links=links: kind(links, np.random.default_rng(options.seed)) for links in options.links]
    makers += [SCENES[name] for name in options.scenes]
    found = []
    for make, chunks in itertools.product(makers, options.chunks):
        made = make()
        one = measure(made, chunks, options.seed)
        if made.name.startswith("chain of 2") and chunks in CURVE:
            one["theirs"] = CURVE[chunks]
        found.append(one)
        print(
            f"{made.name}, {chunks} chunks: error {one['error']:.2g} (theirs {one['theirs']}), {one['kept']} of "
            f"{one['terms']} terms, {one['cpu_s']} CPU s{'' if one['ok'] else ', NOT OK: ' + one['message']}",
            flush=True,
        )
        if options.output:
            path = options.output / "chains.json"
            known = _report.read_json(path)["fits"] if path.exists() else []
            known = [old for old in known if (old["scene"], old["chunks"]) != (one["scene"], one["chunks"])]
            _report.write_json(path, {"circumstances": _report.circumstances(), "fits": [*known, one]})
    return found


if __name__ == "__main__":
    main()
