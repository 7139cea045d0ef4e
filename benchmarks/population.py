"""Random scenes with borders and narrow features: is any motion wrong without a word?

    python -m benchmarks.population --scenes 300
    python -m benchmarks.population --scenes 300 --float32

Every scene is a unit mass on a line, or two of them with a spring between, under some of: steps, walls, pulses, kinks,
saturation, stairs, pulse trains, contact forces, Gaussians, tanh, erf, the logistic function, poles and dry friction,
in q, v, t or combinations of these, 1e-4 to 1 of the path wide. The reference is SciPy's DOP853 at 1e-12, which is told
every border, begins anew at each of them and takes short steps within narrow features. An end is *wrong* where it is
off by more than 1e4 tolerances times what a small error of the start becomes; a motion that says so itself is *named*.
In float32 half of the motions start on a border, to rounding, and rounding of the end is allowed as well.
"""

import argparse
import collections
import math
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax
from benchmarks._singles import EPS, add_option, precision_of, rounded

T, RTOL, SLACK, EDGE, MOMENT = 5.0, 1e-9, 1e4, 9.0, 1e-11
MOST_BREAKS, MOST_EVALUATIONS = 300, 100_000


class Live:
    """The operations of a term in JAX."""

    exp, tanh, logistic, erf = map(staticmethod, (jnp.exp, jnp.tanh, jax.nn.sigmoid, jax.scipy.special.erf))

    def above(self, u):
        """1 where u > 0, else 0."""
        return jnp.where(u > 0, 1.0, 0.0)

    def size(self, u):
        """|u|."""
        return jnp.abs(u)

    def part(self, u):
        """max(u, 0)."""
        return jnp.maximum(u, 0.0)

    def floor(self, u):
        """The whole number below u."""
        return jnp.floor(u)

    def friction(self, v):
        """The sign of v, which may stick."""
        return jnp.sign(v)

    def feature(self, u):
        """The argument of a narrow feature, in units of its width."""
        return u


class Frozen:
    """The same with numbers on fixed pieces; `guards` are positive as long as these hold."""

    exp, tanh, erf = math.exp, math.tanh, math.erf

    def __init__(self):
        self.pieces, self.kinds, self.narrow, self.stuck = None, [], [], False

    def begin(self):
        """Before a term is evaluated once more."""
        self.i, self.guards, self.friction_of = 0, [], None
        if self.pieces is None:
            self.kinds, self.narrow = [], []

    def _next(self, u, kind):
        if self.pieces is None:
            self.kinds.append(kind)
            p = math.floor(u) if kind == "floor" else float(u > 0) if kind != "friction" else float(np.sign(u))
        else:
            p = self.pieces[self.i]
        self.i += 1
        self.guards.append(
            min(u - p, p + 1 - u) if kind == "floor" else u * p if kind == "friction" else u * (2 * p - 1)
        )
        return p

    def above(self, u):
        """1 where u > 0, else 0."""
        return self._next(u, "above")

    def size(self, u):
        """|u|."""
        return u * (2 * self._next(u, "above") - 1)

    def part(self, u):
        """max(u, 0)."""
        return u * self._next(u, "above")

    def floor(self, u):
        """The whole number below u."""
        return self._next(u, "floor")

    def friction(self, v):
        """The sign of v, which may stick."""
        return self._next(v, "friction")

    def logistic(self, u):
        """1 / (1 + exp(−u))."""
        return 1 / (1 + math.exp(-u)) if u > -700 else 0.0

    def feature(self, u):
        """The argument of a narrow feature, in units of its width."""
        below, above = self._next(u + EDGE, "edge"), self._next(u - EDGE, "edge")
        if self.pieces is None:
            self.narrow.append(self.i - 2)
        return u if below and not above else math.copysign(max(EDGE, min(abs(u), 26.0)), u) if abs(u) > 26 else u


class Rejected(Exception):
    """A scene that the reference cannot follow, or that has no motion of its own: it is drawn again."""


# ---- scenes ----------------------------------------------------------------------------------------------------------


def term(rng, i: int, one: bool):
    """The text of a random force on coordinate i; and whether it is a narrow feature."""
    a, c, w = rng.uniform(-2, 2), rng.uniform(-1.5, 1.5), 10 ** rng.uniform(-4, 0)
    tc, slope = rng.uniform(0.3, 4.7), rng.uniform(-0.6, 0.6)
    x = str(
        rng.choice(
            [f"(q[{i}] - {c:.4f})", f"(t - {tc:.4f})", f"(v[{i}] - {c:.4f})", f"(q[{i}] + {slope:.3f} * t - {c:.4f})",
             f"(q[{i}] + {slope:.3f} * v[{i}] - {c:.4f})"], p=[0.4, 0.25, 0.1, 0.15, 0.1]
        )
    )  # fmt: skip
    high = a * min(w**-0.7, 60.0)
    u, k = f"({x} / {w!r})", rng.integers(17 if one else 16)
    period = rng.uniform(0.15, 1.2)
    return [
        f"{high!r} * op.above({w!r} - op.size({x}))",
        f"{a!r} * op.above({x})",
        f"{high!r} * op.exp(-(op.feature({u}) ** 2))",
        f"{a!r} * op.tanh(op.feature({u}))",
        f"{high!r} / (1 + {u} ** 2)" if w > 3e-3 else f"{a!r} * op.erf(op.feature({u}))",
        f"{a!r} * op.logistic(op.feature({u}))",
        f"{a!r} * op.erf(op.feature({u}))",
        f"{a!r} * op.size({x})",
        f"-{abs(high)!r} * op.part({x})",
        f"{a!r} * (op.part({u} + 1) - op.part({u} - 1) - 1)",
        f"{0.5 * a!r} * op.floor({x} / {max(w, 0.03)!r})" if w < 0.3 else f"{0.5 * a!r} * op.floor(3.1 * {x})",
        f"{a!r} * op.above({min(w, 0.5)!r} - (t / {period!r} - op.floor(t / {period!r})))",
        f"{high!r} * op.part(1 - op.size({x}) / {w!r}) ** 1.5",
        f"{a!r} * op.above({x}) * op.above(t - {tc!r})",
        f"{a!r} * op.size({x}) * v[{i}]",
        f"{high!r} * op.exp(op.feature(-op.size({u})))" if w > 1e-2 else f"{a!r} * op.part({x}) ** 2",
        f"-{abs(a)!r} * op.friction(v[{i}])",
    ][k]


def scene(rng):
    """A random scene: its force as a function of (op, q, v, t), its text, and its start."""
    d = 1 if rng.random() < 0.7 else 2
    rows = []
    for i in range(d):
        terms = [term(rng, i, d == 1) for _ in range(rng.integers(1, 4))]
        hold = rng.choice([0.0, 0.3, 1.0, 3.0])
        coupling = f" - 0.4 * (q[{i}] - q[{1 - i}])" if d == 2 else ""
        rows.append(" + ".join(terms) + f" - {hold!r} * q[{i}]{coupling}")
    text = "lambda op, q, v, t: [" + ", ".join(rows) + "]"
    return eval(text), text, rng.uniform(-1, 1, d), rng.uniform(-1.5, 1.5, d)


# ---- the reference ---------------------------------------------------------------------------------------------------


def reference(force, q0, v0) -> np.ndarray:
    """(q, v) at T by DOP853, piece by piece."""
    d, op, y, t = len(q0), Frozen(), np.concatenate([q0, v0]), 0.0
    evaluations, stuck = 0, None

    def rate(t, y):
        nonlocal evaluations
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise Rejected
        op.begin()
        a = force(op, y[:d], y[d:], t)
        return np.concatenate([y[d:], a])

    def held(t, y):  # what friction has to hold, and holds at most
        j = op.kinds.index("friction")
        op.pieces[j] = 1.0
        below = rate(t, y)[d]
        op.pieces[j] = -1.0
        above = rate(t, y)[d]
        op.pieces[j] = 0.0
        return (below + above) / 2, abs(above - below) / 2

    def guard(t, y):
        if stuck is not None:
            f, most = held(t, y)
            rate(t, y)
            return min([most - abs(f), *(g for g, k in zip(op.guards, op.kinds, strict=True) if k != "friction")])
        rate(t, y)
        return min(op.guards, default=1.0)

    guard.terminal, guard.direction = True, -1
    rate(t, y)
    op.pieces = None
    rate(t, y)
    op.pieces = _pieces(op, force, y, t, d)
    for _ in range(MOST_BREAKS):
        run = solve_ivp(
            (lambda t, y: np.zeros(2)) if stuck is not None else rate, (t, T), y, "DOP853", events=guard, rtol=1e-12,
            atol=1e-13, max_step=_longest_step(op, rate, t, y),
        )  # fmt: skip
        if run.status < 0 or abs(run.y[:, -1]).max() > 50:
            raise Rejected
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 0:
            return y
        stuck = _beyond(op, rate, held, t, y, d, stuck)
        if stuck is None:  # so that every guard is positive
            t, y = t + MOMENT, y + MOMENT * rate(t, y)
    raise Rejected


def _longest_step(op, rate, t, y) -> float:
    """A fifth of the time in which a narrow feature passes, where one is near."""
    slope, longest, ahead = rate(t, y), 0.02, 1e-7
    for j in op.narrow:
        if op.pieces[j] and not op.pieces[j + 1]:
            before = list(op.guards)
            rate(t + ahead, y + ahead * slope)
            speed = abs(op.guards[j] - before[j]) / ahead
            longest = min(longest, max(0.2 / (speed + 1e-3), 1e-6))
            rate(t, y)
    return longest


def _pieces(op, force, y, t, d) -> list:
    op.pieces = None
    op.begin()
    found, record = [], op._next

    def noted(u, kind):
        p = record(u, kind)
        found.append(p)
        return p

    op._next = noted
    force(op, y[:d], y[d:], t)
    del op._next
    if any(k == "friction" and p == 0 for k, p in zip(op.kinds, found, strict=True)):
        raise Rejected
    return found


def _beyond(op, rate, held, t, y, d, stuck):
    """Cross the border that was reached; returns what is stuck."""
    if stuck is not None:
        f, most = held(t, y)
        rate(t, y)
        others = [g for g, k in zip(op.guards, op.kinds, strict=True) if k != "friction"]
        if most - abs(f) <= min(others, default=1.0):
            op.pieces[op.kinds.index("friction")] = float(np.sign(f))
            return None
    rate(t, y)
    order = sorted(
        range(len(op.guards)), key=lambda j: op.guards[j] if not (stuck and op.kinds[j] == "friction") else 9
    )
    j = order[0]
    if len(order) > 1 and abs(op.guards[order[1]]) < 1e-11 and op.kinds[order[1]] != "edge":
        raise Rejected  # two at one instant
    kind, old = op.kinds[j], op.pieces[j]
    if kind == "floor":
        f0, ahead = rate(t, y), 1e-7
        op.pieces[j] = old + 10**6
        rate(t + ahead, y + ahead * f0)
        later = op.guards[j]
        rate(t, y)
        op.pieces[j] = old + (1 if later > op.guards[j] else -1)
    elif kind == "friction":
        op.pieces[j] = -old
        f, most = held(t, y)
        if abs(f) <= most:
            y[d:] = 0.0
            op.pieces[j] = 0.0
            return True
        op.pieces[j] = -old
    else:
        op.pieces[j] = 1.0 - old
    rate(t, y)
    for i, g in enumerate(op.guards):  # what jumps with it
        if i != j and g < -1e-9 and op.kinds[i] in ("above", "edge"):
            op.pieces[i] = 1.0 - op.pieces[i]
    if stuck is not None:  # what it has to hold may jump
        f, most = held(t, y)
        if abs(f) > most:
            op.pieces[op.kinds.index("friction")] = float(np.sign(f))
            stuck = None
    rate(t, y)
    if min(g for g, k in zip(op.guards, op.kinds, strict=True) if k != "friction" or stuck is None) < -1e-9:
        raise Rejected
    if kind != "edge" and stuck is None:
        f0, ahead = rate(t, y), 1e-6
        rate(t + ahead, y + ahead * f0)
        if op.guards[j] < -1e-13:
            raise Rejected  # it slides, or touches
    return stuck


# ---- both ------------------------------------------------------------------------------------------------------------


def on_border(text: str, q0: np.ndarray, rng) -> np.ndarray:
    """A start with one coordinate at the place of a term, for half of the scenes that have such a term."""
    places = re.findall(r"\(q\[(\d)\] - (-?[\d.]+)\)", text)
    if places and rng.random() < 0.5:
        i, c = places[rng.integers(len(places))]
        q0[int(i)] = float(c)
    return q0


def compared(rng, precision: np.dtype) -> tuple[str, float, float, int, str]:
    """What became of one scene: its name, the error, how errors grow, steps, and the text."""
    while True:
        force, text, q0, v0 = scene(rng)
        if precision == np.float32:
            q0, v0 = rounded(on_border(text, q0, rng), precision), rounded(v0, precision)
        try:
            with np.errstate(all="ignore"):
                exact, near = reference(force, q0, v0), reference(force, q0 * (1 + 1e-7) + 1e-8, v0 * (1 - 1e-7))
        except (Rejected, OverflowError, ValueError, ZeroDivisionError):
            continue
        if (growth := np.abs(near - exact).max() / 1e-7) < 1e3:
            break
    op = Live()

    def forces(q, qdot, t):
        return jnp.stack([jnp.asarray(x, float) for x in force(op, q, qdot, t)])

    system = lagjax.System(lambda q, v: 0.5 * jnp.sum(v * v), forces=forces)
    given = q0.astype(precision), v0.astype(precision), np.array([0.0, T], precision)
    run = lagjax.simulate(system, *given, rtol=RTOL, throw=False)
    steps = int(run.stats["num_steps"]) + int(run.stats["num_rejected_steps"])
    if not bool(run.ok):
        return "named", math.nan, growth, steps, f"{str(run.result)[:100]} {text}; {q0.tolist()}, {v0.tolist()}"
    error = float(np.abs(np.concatenate([run.q[-1], run.qdot[-1]]) - exact).max())
    rounding = EPS * np.abs(exact).max() if precision == np.float32 else 0.0
    name = "right" if error <= SLACK * RTOL * (1 + growth) + rounding else "wrong"
    return name, error, growth, steps, f"{text}; {q0.tolist()}, {v0.tolist()}"


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.population", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    add_option(parser)
    options = parser.parse_args(arguments)
    precision = precision_of(options)
    counts, steps = collections.Counter(), []
    for seed in range(options.first, options.first + options.scenes):
        name, error, growth, taken, text = compared(np.random.default_rng(seed), precision)
        counts[name] += 1
        steps.append(taken)
        if name != "right":
            print(f"{seed} {name}: error {error:.1e}, growth {growth:.0e}, {taken} steps: {text}", flush=True)
        if sum(counts.values()) % 50 == 0:
            print(f"up to {seed}: {dict(counts)}", file=sys.stderr, flush=True)
    print(f"{dict(counts)}; steps: median {np.median(steps):.0f}, most {max(steps)}", file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
