"""Random motions that slide along borders of every kind: does any stop, or go wrong in value or gradient?

    python -m benchmarks.sliding --scenes 8

One to three bodies, whose masses may be coupled, are held by −K S(u) with u = a (v + c q) + b sin(ω t) − w. S is a step
function in each of its spellings: signs, comparisons, floor and what is made of it, tables, branches, bits. Values and
gradients, in reverse and forward, by starts, K, load and w are compared with SciPy's DOP853, mode by mode: every level
that is come to and every release is located, and along a level the acceleration is Filippov's convex combination of
both sides. A part of the scenes runs in float32, JAX's default, too. Shown are, for each spelling, how many of its
scenes slide, how many are refused, and the largest errors of values and gradients.
"""

import argparse
import sys
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax

T, STEP, SIDES = 2.0, 1e-6, 1e-4  # of a difference; by how much both sides may differ, in parts of the gradient
MOST_MODES = 400


class Steps(NamedTuple):
    """A step function: S(u) = `values[i]` + `slope` u between the levels i − 1 and i."""

    function: Callable
    levels: np.ndarray
    values: np.ndarray
    slope: float = 0.0


WHOLE = np.arange(-40.0, 41.0)
BINS = np.array([-1.3, -0.4, 0.7, 1.1])
HEIGHTS = np.array([-2.0, -0.7, 0.2, 0.9, 2.5])
_below = np.append(WHOLE[0] - 1, WHOLE)  # what floor is between the levels


def _index(u):
    """The number of the interval of BINS, as a floor: of levels −2, −1, 0, 1."""
    return jnp.clip(jnp.floor(u) + 3.0, 0, 4).astype(int)


def _of_levels(function, levels, values, slope=0.0):
    return Steps(function, np.asarray(levels, float), np.asarray(values, float), slope)


_CLIPPED = (np.array([-2.0, -1.0, 0.0, 1.0]), HEIGHTS)
KINDS = {
    "sign": _of_levels(jnp.sign, [0], [-1, 1]),
    "where": _of_levels(lambda u: jnp.where(u > 0, 1.0, -1.0), [0], [-1, 1]),
    "comparison": _of_levels(lambda u: (u >= 0.3).astype(u.dtype), [0.3], [0, 1]),
    "direction": _of_levels(lambda u: u / jnp.abs(u), [0], [-1, 1]),
    "copysign": _of_levels(lambda u: jnp.copysign(0.8, u), [0], [-0.8, 0.8]),
    "signbit": _of_levels(lambda u: jnp.where(jnp.signbit(u), -1.0, 0.5), [0], [-1, 0.5]),
    "floor": _of_levels(jnp.floor, WHOLE, _below),
    "ceil": _of_levels(jnp.ceil, WHOLE, _below + 1),
    "round": _of_levels(jnp.round, WHOLE + 0.5, _below + 1),
    "trunc": _of_levels(jnp.trunc, np.delete(WHOLE, 40), np.where(_below < 0, _below + 1, _below)[np.arange(82) != 40]),
    "astype(int)": _of_levels(
        lambda u: u.astype(int).astype(u.dtype), np.delete(WHOLE, 40),
        np.where(_below < 0, _below + 1, _below)[np.arange(82) != 40],
    ),
    "//": _of_levels(lambda u: u // 0.5, WHOLE / 2, _below),
    "mod": _of_levels(lambda u: -jnp.mod(u, 1.0), WHOLE, _below, -1.0),
    "parity": _of_levels(
        lambda u: jnp.where(jnp.ceil(2 * u) % 2 == 0, 1.0, -1.0), WHOLE / 2, np.where((_below + 1) % 2 == 0, 1.0, -1.0)
    ),
    "digitize": _of_levels(
        lambda u: jnp.asarray(HEIGHTS, u.dtype)[jnp.digitize(u, jnp.asarray(BINS, u.dtype))], BINS, HEIGHTS
    ),
    "searchsorted left": _of_levels(
        lambda u: jnp.asarray(HEIGHTS, u.dtype)[jnp.searchsorted(jnp.asarray(BINS, u.dtype), u)], BINS, HEIGHTS
    ),
    "searchsorted right": _of_levels(
        lambda u: jnp.asarray(HEIGHTS, u.dtype)[jnp.searchsorted(jnp.asarray(BINS, u.dtype), u, side="right")],
        BINS, HEIGHTS,
    ),
    "table of a floor": _of_levels(lambda u: jnp.asarray(HEIGHTS, u.dtype)[_index(u)], *_CLIPPED),
    "dynamic_index": _of_levels(
        lambda u: jax.lax.dynamic_index_in_dim(jnp.asarray(HEIGHTS, u.dtype), _index(u), keepdims=False), *_CLIPPED
    ),
    "switch": _of_levels(
        lambda u: jax.lax.switch(_index(u), [lambda u, x=x: x + 0.0 * u for x in HEIGHTS], u), *_CLIPPED
    ),
    "samples": _of_levels(
        lambda u: lagjax.samples(np.append(-9.0, BINS), HEIGHTS, hold="zero")(u), BINS, HEIGHTS
    ),
}  # fmt: skip


class Bodies:
    """Bodies with −K S(u), from x = (q, v, K, load, w), each with a number for every body."""

    def __init__(self, kind: str, random: np.random.Generator):
        self.steps = KINDS[kind]
        n = self.n = int(random.choice([1, 1, 2, 3]))
        self.a, self.c = random.uniform(0.7, 1.5, n), random.choice([0.0, 0.5, 1.0], n)
        self.b, self.omega = random.choice([0.0, 0.3]), random.uniform(0.5, 2.0)
        coupling = random.uniform(-0.3, 0.3, (n, n)) * (random.random() < 0.5)
        self.mass = np.diag(random.uniform(0.5, 2.0, n)) + 0.5 * (coupling + coupling.T)
        self.stiffness, self.twins = random.uniform(0.2, 1.0), n > 1 and random.random() < 0.3
        k = random.uniform(2.0, 5.0, n)
        load = random.uniform(-1.0, 1.0, n) * k
        x = np.stack([random.uniform(-1, 1, n), random.uniform(-2, 2, n), k, load, random.uniform(-0.4, 0.4, n)])
        if self.twins:  # alike, so that all come to their borders at one instant
            self.mass, self.a, self.c = np.eye(n), np.full(n, self.a[0]), np.full(n, self.c[0])
            x[:] = x[:, :1]
        self.x, self.weights = x.ravel(), random.normal(size=2 * n)

    def numbers(self, q, v, t, w, library):
        """u."""
        return self.a * (v + self.c * q) + self.b * library.sin(self.omega * t) - w

    def simulate(self, x):
        """The weighted end, by lagjax."""
        q0, v0, *params = x.reshape(5, -1)

        def forces(q, v, t, params):
            k, load, w = params
            u = self.numbers(q, v, t, w, jnp)
            return load - self.stiffness * q - k * jnp.stack([self.steps.function(u[i]) for i in range(self.n)])

        scene = lagjax.System(lambda q, v: 0.5 * v @ self.mass @ v, forces=forces)
        run = lagjax.simulate(scene, q0, v0, jnp.array([0.0, T], x.dtype), tuple(params))
        return self.weights @ jnp.concatenate([run.q[-1], run.qdot[-1]])

    def refer(self, x, slid: set | None = None):
        """The same by SciPy, mode by mode; notes in `slid` the bodies that have slid."""
        q, v, k, load, w = x.reshape(5, -1)
        steps, n, levels = self.steps, self.n, np.concatenate([[-np.inf], self.steps.levels, [np.inf]])
        t, y = 0.0, np.concatenate([q, v])

        def u_of(t, y):
            return self.numbers(y[:n], y[n:], t, w, np)

        def solve(t, y, places, on):
            """Accelerations and, of the bodies on a level, the shares of the upper side; `places` number intervals."""
            u = u_of(t, y)
            s = steps.values[places] + steps.slope * u
            rate = self.a * self.c * y[n:] + self.b * self.omega * np.cos(self.omega * t)
            force = load - self.stiffness * y[:n] - k * s
            a, shares = np.linalg.solve(self.mass, force), np.full(n, 0.5)
            if on.any():
                jump = k * (steps.values[np.minimum(places + 1, len(steps.values) - 1)] - steps.values[places])
                effect = np.linalg.solve(self.mass, -np.diag(jump)[:, on])
                alpha = np.linalg.solve(self.a[on][:, None] * effect[on], -(self.a * a + rate)[on])
                a, shares[on] = a + effect @ alpha, alpha
            return a, shares

        places = np.searchsorted(levels[1:-1], u_of(t, y))
        on, idle = np.zeros(n, bool), 0
        for _ in range(MOST_MODES):
            here, held = places.copy(), on.copy()
            shares = solve(t, y, places, on)[1]
            off = np.abs(shares - 0.5)
            if off.max() > 0.5 + 1e-12:
                worst = off.argmax()
                places[worst] += shares[worst] > 0.5
                on[worst] = False
                continue
            events = []
            for i in range(n):
                for side in (0, 1):
                    level = levels[places[i] + side]

                    def event(t, y, i=i, side=side, level=level, p=here, on=held):
                        if on[i]:
                            return solve(t, y, p, on)[1][i] * (1 - 2 * side) + side
                        return (u_of(t, y)[i] - level) * (1 - 2 * side) if np.isfinite(level) else 1.0

                    event.terminal, event.direction = True, -1
                    events.append(event)
            run = solve_ivp(
                lambda t, y, p=here, on=held: np.append(y[n:], solve(t, y, p, on)[0]),
                (t, T), y, "DOP853", events=events, rtol=1e-12, atol=1e-13,
            )  # fmt: skip
            idle = idle + 1 if run.t[-1] - t < 1e-12 else 0
            if slid is not None and run.t[-1] - t > 1e-2:
                slid |= set(np.flatnonzero(on))
            t, y = run.t[-1], run.y[:, -1]
            if t >= T:
                return self.weights @ y
            first = next(e for e, found in enumerate(run.t_events) if len(found))
            leaves, rested = on[first // 2], on.copy()
            for e, event in enumerate(events):
                if e != first and (leaves or rested[e // 2] or on[e // 2] or abs(event(t, y)) > 1e-12):
                    continue  # of several borders that are come to at one instant, none is seen twice
                i, side = divmod(e, 2)
                if on[i]:
                    on[i] = False
                    places[i] += side
                else:  # on it, between the intervals p and p + 1; where it is passed the share says so
                    on[i] = True
                    places[i] -= side == 0
                    gap = k[i] * (steps.values[places[i] + 1] - steps.values[places[i]])
                    if gap <= 0:
                        on[i] = False
                        places[i] += side
        raise ArithmeticError("too many modes")


def compare(scene: Bodies, dtype) -> tuple[float, float, bool]:
    """The errors of value and gradients, relative, and whether it slides; NaN where there is no derivative."""
    x, slid = jnp.asarray(scene.x, dtype), set()
    exact = np.asarray(x, float)
    unit, middle = np.eye(len(exact)), scene.refer(exact, slid)
    above, below = (np.array([(scene.refer(exact + h * e) - middle) / h for e in unit]) for h in (STEP, -STEP))
    size = np.abs([above, below]).max() + 1e-3
    exists = np.abs(above - below) <= SIDES * size
    value, reverse = jax.value_and_grad(scene.simulate)(x)
    forward = jax.jacfwd(scene.simulate)(x)
    slopes = 0.5 * (above + below)
    off = [np.abs(np.asarray(of) - slopes)[exists] / size for of in (reverse, forward)]
    of_value = abs(float(value) - middle) / (1 + abs(middle))
    return of_value, float(np.max(off)) if exists.any() else 0.0, bool(slid)


def main(arguments=None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=8, help="of each spelling")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--float32", action="store_true", help="in float32, JAX's default")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", not given.float32)
    dtype = np.float32 if given.float32 else np.float64
    print(f"{'spelling':20s} {'slide':>6s} {'refused':>8s} {'value':>9s} {'gradient':>9s}")
    for kind in given.kinds:
        slides, refused, values, gradients = 0, 0, [0.0], [0.0]
        for k in range(given.scenes):
            scene = Bodies(kind, np.random.default_rng([given.seed, k]))
            try:
                of_value, of_gradient, slid = compare(scene, dtype)
            except (lagjax.SimulationError, NotImplementedError) as error:
                refused += 1
                print(f"  scene {k}: {str(error).strip()[:160]!r}")
                continue
            slides += slid
            values.append(of_value)
            gradients.append(of_gradient)
            if of_value > 1e-6 or not of_gradient <= 1e-4:
                print(f"  scene {k}, {scene.n} bodies{', alike' * scene.twins}: {of_value:.1e}, {of_gradient:.1e}")
        print(f"{kind:20s} {slides:6d} {refused:8d} {np.max(values):9.1e} {np.max(gradients):9.1e}", flush=True)
    jax.config.update("jax_enable_x64", before)


if __name__ == "__main__":
    main(sys.argv[1:])
