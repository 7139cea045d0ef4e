"""Random motions that begin on the borders they rest on: is any derivative wrong without a word? Does anything creep?

    python -m benchmarks.border_starts --scenes 100

One to three bodies, whose masses may be coupled and depend on their places, with dry friction on belts, against each
other, or on lines of sliding modes v = w − C q; all or some of these borders are touched at the start, or after the
reset of a hybrid motion. Other scenes rest by their position in a corner, with friction. Derivatives by starts, belts,
loads and stiffnesses are compared, in reverse and forward, with finite differences of both sides of a reference:
SciPy's DOP853, mode by mode, with every border and every release located. Where both sides differ, as those of a start
that leaves its border at once, there is no derivative: NaN is right, a number is *one-sided*. A part of the scenes runs
in float32, JAX's default, too. What creeps in 1e8 is shown for loads at rest, stacks and belts.
"""

import argparse
import collections
import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax

T, STEP, SIDES = 1.5, 1e-6, 1e-4  # of a difference; by how much both sides may differ, in parts of the gradient
# In parts of the largest slope. Both sides bend differently, so that a difference over STEP is off by some 3e-6.
WRONG = {np.dtype("float64"): 1e-5, np.dtype("float32"): 2e-3}
MOST_MODES = 200


class Bodies:
    """Bodies with friction −μₖ sign(uₖ) Aₖ on borders u = A v + C q − w, from x = (q, v, w, load, stiffness)."""

    def __init__(self, random: np.random.Generator):
        n = int(random.integers(1, 4))
        self.n, self.names = n, ["q"] * n + ["v"] * n + ["w"] * n + ["load"] * n + ["stiffness"]
        rows = {"belts": np.eye(n), "stack": np.eye(n) - np.eye(n, k=-1), "mixed": np.tril(np.ones((n, n)))}
        self.kind = str(random.choice([*rows]))
        self.rows, self.hybrid = rows[self.kind], bool(random.random() < 0.25)
        self.slope = np.diag(random.choice([0.0, 0.0, 0.5, 1.0], n)) * (not self.hybrid)
        self.mu = random.uniform(1.5, 4.0, n)
        coupling = random.uniform(-0.3, 0.3, (n, n)) * (random.random() < 0.5)
        self.mass = np.diag(random.uniform(0.5, 2.0, n)) + 0.5 * (coupling + coupling.T)
        self.bend, self.drive = random.choice([0.0, 0.2]), random.choice([0.0, 0.3])
        # Binary fractions, so that the start lies on its borders exactly.
        q, w = random.integers(-16, 17, n) / 32, random.integers(-16, 17, n) / 64
        beside = np.where(random.random(n) < 0.25, random.integers(1, 9, n) / 16, 0.0)
        beside[int(random.integers(n))] = 0.0
        v = np.linalg.solve(self.rows, w - self.slope @ q + beside).round(12)
        self.x = np.concatenate([q, v, w, random.uniform(-0.4, 0.4, n), [random.uniform(0.2, 1.0)]])
        self.weights = random.normal(size=2 * n)

    def split(self, x):
        """q, v, w, load and stiffness."""
        n = self.n
        return x[:n], x[n : 2 * n], x[2 * n : 3 * n], x[3 * n : 4 * n], x[4 * n]

    def smooth(self, q, load, stiffness, t, library):
        """All forces but friction."""
        return load * (1 + self.drive * library.sin(3 * t)) - stiffness * q

    def simulate(self, x):
        """The weighted end, by lagjax."""
        q0, v0, w, load, stiffness = self.split(x)

        def lagrangian(q, v):
            return 0.5 * v @ self.mass @ v + 0.5 * self.bend * jnp.sum(jnp.cos(q) * v * v)

        def forces(q, v, t, params):
            w, load, stiffness = params[:3]
            friction = self.rows.T @ (self.mu * jnp.sign(self.rows @ v + self.slope @ q - w))
            return self.smooth(q, load, stiffness, t, jnp) - friction

        def free(q, v, t, params):
            return self.smooth(q, params[1], params[2], t, jnp)

        params, dtype = (w, load, stiffness), x.dtype
        if not self.hybrid:
            run = lagjax.simulate(lagjax.System(lagrangian, forces=forces), q0, v0, jnp.array([0.0, T], dtype), params)
            return self.weights @ jnp.concatenate([run.q[-1], run.qdot[-1]])
        modes = {"free": lagjax.System(lagrangian, forces=free), "rubs": lagjax.System(lagrangian, forces=forces)}
        touch = lagjax.Transition("free", "rubs", lambda q, v, t: t - 0.5, 1, lambda q, v, params: (q, params[3]))
        ts = jnp.array([0.0, T], dtype)
        run = lagjax.simulate(lagjax.Hybrid(modes, [touch], "free"), q0, jnp.zeros(self.n, dtype), ts, (*params, v0))
        return self.weights @ jnp.concatenate([run.q[-1], run.qdot[-1]])

    def refer(self, x):
        """The same by SciPy, mode by mode."""
        q, v, w, load, stiffness = self.split(x)
        t = 0.0
        if self.hybrid:
            q, _ = self._follow(q, np.zeros(self.n), 0.0, 0.5, np.zeros(self.n), (w, load, stiffness))
            t = 0.5
        return self.weights @ np.concatenate(self._follow(q, v, t, T, self.mu, (w, load, stiffness)))

    def _solve(self, t, y, modes, mu, numbers):
        """The accelerations, and what borders hold, in units of their friction; `modes` are signs, 0 at rest."""
        n, (_, load, stiffness) = self.n, numbers
        q, v = y[:n], y[n:]
        mass = self.mass + np.diag(self.bend * np.cos(q))
        force = self.smooth(q, load, stiffness, t, np) + 0.5 * self.bend * np.sin(q) * v * v
        rests = modes == 0
        force = force - self.rows.T @ (mu * modes)
        held = self.rows[rests]
        a, response = np.linalg.solve(mass, force), np.linalg.solve(mass, held.T)
        shares = np.zeros(n)
        if rests.any() and mu.any():
            multipliers = np.linalg.solve(held @ response, held @ a + self.slope[rests] @ v)
            a, shares[rests] = a - response @ multipliers, multipliers / mu[rests]
        return a, shares

    def _follow(self, q, v, t, end, mu, numbers):
        y, n = np.concatenate([q, v]), self.n

        def beside(y):
            return self.rows @ y[n:] + self.slope @ y[:n] - numbers[0]

        modes = np.where(np.abs(beside(y)) < 1e-14, 0.0, np.sign(beside(y))) * (mu > 0)
        for _ in range(MOST_MODES):
            shares = self._solve(t, y, modes, mu, numbers)[1]
            if abs(shares[worst := np.abs(shares).argmax()]) > 1 + 1e-12:
                modes[worst] = np.sign(shares[worst])
                continue
            events = [lambda t, y, k=k: beside(y)[k] if modes[k] else 1.0 for k in range(n)]
            events += [
                lambda t, y, k=k: 1.0 if modes[k] else 1 - abs(self._solve(t, y, modes, mu, numbers)[1][k])
                for k in range(n)
            ]
            for k, event in enumerate(events):
                event.terminal, event.direction = bool(mu.any()), -modes[k] if k < n else -1
            run = solve_ivp(
                lambda t, y: np.append(y[n:], self._solve(t, y, modes, mu, numbers)[0]),
                (t, end), y, "DOP853", events=events, rtol=1e-12, atol=1e-13,
            )  # fmt: skip
            t, y = run.t[-1], run.y[:, -1]
            if t >= end:
                return y[:n], y[n:]
            k = next(k for k, found in enumerate(run.t_events) if len(found))
            if k < n:
                modes[k] = 0.0
            else:
                modes[k - n] = np.sign(self._solve(t, y, modes, mu, numbers)[1][k - n])
        raise ArithmeticError("too many modes")


class Corner:
    """A body with dry friction that is pushed into a corner at w, from x = (q, v, w, load): it comes back at once."""

    kind, hybrid = "corner", False

    def __init__(self, random: np.random.Generator):
        self.names, (self.push, self.mu) = ["q", "v", "w", "load"], random.uniform([1.5, 0.3], [3.0, 1.0])
        w = random.integers(-8, 9) / 16
        self.x = np.array([w, 0.0, w, random.uniform(-0.3, 0.3)])

    def simulate(self, x):
        """The end, by lagjax."""
        scene = lagjax.System(
            lambda q, v: 0.5 * v * v,
            forces=lambda q, v, params: -self.push * jnp.sign(q - params[0]) - self.mu * jnp.sign(v) + params[1],
        )
        return lagjax.simulate(scene, x[0], x[1], jnp.array([0.0, T], x.dtype), x[2:]).q[-1]

    def refer(self, x):
        """Bounces end before T, as a geometric series does."""
        return x[2]


def compare(scene, dtype) -> str:
    """How the derivatives of a scene compare with differences of both sides."""
    x = jnp.asarray(scene.x, dtype)
    unit, middle = np.eye(len(scene.x)), scene.refer(scene.x)
    above, below = (np.array([(scene.refer(scene.x + h * e) - middle) / h for e in unit]) for h in (STEP, -STEP))
    size = np.abs([above, below]).max() + 1e-3
    exists = np.abs(above - below) <= SIDES * size
    value, reverse = jax.value_and_grad(scene.simulate)(x)
    forward = jax.jacfwd(scene.simulate)(x)
    if abs(value - middle) > WRONG[np.dtype(dtype)] * (1 + abs(middle)):
        return "wrong value"
    for name, slopes in (("reverse", np.asarray(reverse)), ("forward", np.asarray(forward))):
        off = np.abs(slopes - 0.5 * (above + below)) > WRONG[np.dtype(dtype)] * size
        if (off & exists).any():
            return f"wrong, {name}"
        if (np.isfinite(slopes) & ~exists).any():
            return "one-sided"
        if np.isnan(slopes[exists]).any():
            return "NaN without need"
    return "right"


# ---- creep -----------------------------------------------------------------------------------------------------------


def creep(count: int) -> dict[str, float]:
    """How far bodies at rest have moved after 1e8, in parts of what they may by the rounding of their place."""
    random, end = np.random.default_rng(0), jnp.array([0.0, 1e8])
    block = lagjax.System(lambda q, v: 0.5 * v * v, forces=lambda q, v, params: params[0] - params[1] * jnp.sign(v))
    mu = random.uniform(0.5, 5.0, count)
    loads = jnp.asarray(np.stack([random.uniform(-0.99, 0.99, count) * mu, mu], axis=1))
    still = lagjax.simulate_batch(block, jnp.zeros(count), jnp.zeros(count), end, loads, batch_axes=(0, 0, 0)).q[:, -1]
    belt = lagjax.System(
        lambda q, v: 0.5 * v * v, forces=lambda q, v, params: params[0] - params[1] * jnp.sign(v - params[2])
    )
    speeds = jnp.asarray(random.uniform(-2.0, 2.0, count))
    carried = lagjax.simulate_batch(
        belt, jnp.zeros(count), speeds, end, jnp.concatenate([loads, speeds[:, None]], axis=1), batch_axes=(0, 0, 0)
    ).q[:, -1]  # fmt: skip

    def stack(q, v, params):
        friction = params[1] * jnp.sign(jnp.diff(v, prepend=0.0)) * jnp.array([3.0, 2.0, 1.0])
        return params[0] * jnp.array([0.5, 1.0, -0.3]) - friction + jnp.append(friction[1:], 0.0)

    stacked = lagjax.System(lambda q, v: 0.5 * v @ (jnp.array([1.0, 2.0, 0.7]) * v), forces=stack)
    zeros = jnp.zeros((count, 3))
    still3 = lagjax.simulate_batch(stacked, zeros, zeros, end, loads, batch_axes=(0, 0, 0)).q[:, -1]
    slope = jax.vmap(jax.grad(lambda load: lagjax.simulate(block, 0.0, 0.0, end, load).q[-1]))(loads)
    return {
        "block": float(jnp.abs(still).max()),
        "belt, relative": float(jnp.abs(carried / (speeds * 1e8) - 1).max()),
        "stack of three": float(jnp.abs(still3).max()),
        "slope of the block by its load": float(jnp.abs(slope).max()),
    }


def count_kinds(scenes: int, seed: int, dtype) -> dict[str, int]:
    """How many scenes are right, and how others are not."""
    found: collections.Counter = collections.Counter()
    for k in range(scenes):
        random = np.random.default_rng([seed, k])
        scene = Corner(random) if k % 10 == 9 else Bodies(random)
        try:
            kind = compare(scene, dtype)
        except lagjax.SimulationError as error:
            kind = f"named: {str(error)[:60]}"
        if kind != "right":
            print(f"  scene {k} ({scene.kind}{', hybrid' * scene.hybrid}), {np.dtype(dtype)}: {kind}", flush=True)
        found[kind] += 1
    return dict(found)


def main(arguments=None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--float32", type=int, default=None, help="scenes in float32; by default a fifth of all")
    parser.add_argument("--loads", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    print("After 1e8:", {name: float(f"{x:.2g}") for name, x in creep(given.loads).items()})
    print("float64:", count_kinds(given.scenes, given.seed, np.float64))
    jax.config.update("jax_enable_x64", False)
    single = given.scenes // 5 if given.float32 is None else given.float32
    print("float32:", count_kinds(single, given.seed, np.float32))
    jax.config.update("jax_enable_x64", before)


if __name__ == "__main__":
    main(sys.argv[1:])
