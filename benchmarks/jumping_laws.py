"""Random forces that jump, from starts on their borders: does a motion go as the forces are written there?

    python -m benchmarks.jumping_laws --scenes 100

One to three coordinates, whose forces are sums of `floor`, `sign`, `where`, `heaviside`, tables, … of few of the
coordinates, velocities and the time; starts are whole numbers and zero, at rest or not. The reference takes 20 000
steps of Euler's symplectic method, whose first one is by the forces as they are written at the start. Members are
compared where the reference, begun 1e-7 away, ends at the same place: elsewhere more than one motion begins.
"""

import argparse
import collections

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

T, STEPS, ALLOWED, AWAY = 0.8, 20_000, 4e-3, 1e-7
LAWS = {
    "floor": jnp.floor, "ceil": jnp.ceil, "sign": jnp.sign, "trunc": jnp.trunc, "round": jnp.round, "abs": jnp.abs,
    ">=": lambda u: jnp.where(u >= 0, 1.0, 0.0), ">": lambda u: jnp.where(u > 0, 1.0, -1.0),
    "heaviside": lambda u: jnp.heaviside(u, 0.5), "maximum": lambda u: jnp.maximum(u, 0.0), "%": lambda u: u % 1.0,
    "clip": lambda u: jnp.clip(u, -0.5, 0.5), "pulse": lambda u: jnp.where((u >= 0) & (u < 1), 1.0, 0.0),
    "interp": lambda u: jnp.interp(u, jnp.arange(-2.0, 3.0), jnp.array([0.0, 1.0, 0.0, -1.0, 0.5])),
    "table": lambda u: jnp.array([0.5, -1.0, 0.0, 2.0, 1.0])[jnp.clip(jnp.floor(u).astype(int) + 2, 0, 4)],
    "searchsorted": lambda u: 1.0 * jnp.searchsorted(jnp.array([-1.0, 0.0, 1.0]), u, side="right"),
    "root": lambda u: jnp.sign(u) * jnp.sqrt(jnp.abs(u) + 0.1),
    "cond": lambda u: jax.lax.cond(u < 0, lambda: -0.5, lambda: 0.75),
}  # fmt: skip


def draw(seed: int) -> tuple:
    """The forces (q, qdot, t) of a scene, what they are, and 16 starts."""
    rng = np.random.default_rng(seed)
    n, terms = int(rng.integers(1, 4)), []
    for _ in range(int(rng.integers(1, 4))):
        row = np.zeros(2 * n + 1)
        row[rng.choice(2 * n, min(int(rng.integers(1, 3)), 2 * n), replace=False)] = rng.choice([1.0, -1.0, 2.0])
        row[-1] = rng.choice([0.0, 0.0, 0.0, 0.0, 1.0, -1.0])
        terms.append((str(rng.choice([*LAWS])), row, rng.normal(size=n) * rng.choice([0.5, 1.0, 2.0])))
    constant = rng.choice([0.0, 0.0, 0.3, -1.0], size=n)

    def forces(q, qdot, t):
        x = jnp.concatenate([q, qdot, jnp.atleast_1d(t)])
        return constant + sum(LAWS[name](row @ x) * weights for name, row, weights in terms)

    starts = rng.choice([0.0, 0.0, 1.0, -1.0, 0.5, 0.25], (16, n)), rng.choice([0.0, 0.0, 0.0, 1.0, -0.5], (16, n))
    return forces, terms, starts


def judge(seed: int) -> collections.Counter:
    """How many members are right, wrong, ambiguous, or stopped with a reason."""
    forces, terms, (q, v) = draw(seed)
    h = T / STEPS

    @jax.jit
    @jax.vmap
    def reference(q, v):
        def step(i, state):
            q, v = state
            faster = v + h * forces(q, v, i * h)
            return q + h * (v + faster) / 2, faster

        return jnp.concatenate(jax.lax.fori_loop(0, STEPS, step, (q, v)))

    ends, moved, rng = reference(q, v), np.zeros(len(q)), np.random.default_rng(seed)
    for _ in range(4):
        away = reference(*(x + AWAY * rng.normal(size=x.shape) for x in (q, v)))
        moved = np.maximum(moved, np.abs(away - ends).max(axis=1))
    system = lagjax.System(lambda q, v: 0.5 * v @ v, forces=forces)
    run = lagjax.simulate_batch(system, q, v, np.array([0.0, T]))
    found = np.concatenate([run.q[:, -1], run.qdot[:, -1]], axis=1)
    allowed = ALLOWED * (1.0 + np.abs(ends).max(axis=1))
    verdicts = np.where(np.abs(found - ends).max(axis=1) < allowed, "right", "wrong")
    verdicts = np.where(moved > allowed / 4, "ambiguous", verdicts)
    verdicts = np.where(np.asarray(run.ok), verdicts, "stopped")
    for kind in ("wrong", "stopped"):
        for k in np.flatnonzero(verdicts == kind)[:1]:
            print(f"{seed}: {kind} from {q[k]}, {v[k]}: {found[k]}, reference {ends[k]}; {terms}", flush=True)
    return collections.Counter(verdicts.tolist())


def main() -> dict[str, int]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    counts: collections.Counter = collections.Counter()
    for seed in range(options.first, options.first + options.scenes):
        counts += judge(seed)
        jax.clear_caches()
    print(dict(counts))
    return dict(counts)


if __name__ == "__main__":
    main()
