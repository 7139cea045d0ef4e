"""Random hybrid scenes whose guards may be beyond zero where a mode begins: is any motion wrong without a word?

    python -m benchmarks.guard_population --scenes 300
    python -m benchmarks.guard_population --scenes 300 --float32

Balls that rest on shaken tables, blocks that stick and slip (by a constraint with a multiplier, statically as much held
as kinetically or more), blocks under inputs that are held from call to call, freewheels, particles that begin beyond
the wall of a box, jumps that carry a particle beyond another guard, and balls on a sphere that are too fast for it. All
motions between events are in closed form, so that the reference goes from event to event in 40 digits; a guard that is
zero there to 20 of them is decided by where it is a little later. Scenes in which a guard comes nearer to zero than a
millionth without going through are drawn again.

A motion is *right* whose end and whose count of transitions are those of the reference, *named* where it ends in an
error that says so, and else *wrong*. With `--float32` the state and the parameters come in float32, without the x64
switch; the reference begins with the numbers as rounded.
"""

import argparse
import collections
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from scipy.integrate import quad

import lagjax
from benchmarks import _singles

G, MOST, STEPS = 9.81, 60, 12  # gravity; transitions of a motion; calls of a control loop
# Some sixty transitions, each known to a hundred roundings of numbers up to a hundred: 1e-10. Of float32 the same with
# 1e-7 in place of 1e-16, beyond which an end says nothing.
TOLERANCE, SINGLE_TOLERANCE = 1e-8, 2e-3
POINTS, NEAR, MOMENT = 4000, 1e-6, 1e-3  # of a stretch; of a guard that almost goes through; of an event near the end
ZERO, LATER = mpmath.mpf(10) ** -20, mpmath.mpf(10) ** -8


class Ambiguous(Exception):
    """A scene that rounding decides: it is drawn again."""


class Edge(NamedTuple):
    """A transition of the reference: its guard, a function of (xp, t, q, v), its direction, and what follows."""

    guard: Callable
    direction: int
    target: str
    reset: Callable = lambda t, q, v: (q, v)


class Motion(NamedTuple):
    """The end of a motion, and how many transitions there were."""

    q: Any
    v: Any
    mode: str
    count: int


class Scene(NamedTuple):
    """One motion: its family, the mode it begins in, its start, duration and params, and its end.

    Those of one `family` and `start` share their code.
    """

    family: str
    start: str
    q: Any
    v: Any
    duration: float
    params: dict
    right: Motion


# ---- the reference ---------------------------------------------------------------------------------------------------


def followed(motions: dict, edges: Mapping[str, Sequence[Edge]], mode: str, t, end, q, v) -> Motion:
    """The motion in closed form: `motions[mode](xp, t0, q, v)` gives t ↦ (q, v), `edges[mode]` what leaves the mode."""
    with mpmath.workdps(40):
        t, end, count = mpmath.mpf(t), mpmath.mpf(end), 0
        q, v = ([mpmath.mpf(float(x)) for x in np.ravel(part)] for part in (q, v))
        while count <= MOST:
            path = motions[mode](mpmath, t, q, v)
            values = [_value(edge, mpmath, path, t) for edge in edges[mode]]
            hit = next(
                (k for k, edge in enumerate(edges[mode]) if _fires_at_once(edge, mode, path, t, values[k])), None
            )
            if hit is None:
                hit, at = _first_crossing(edges[mode], motions[mode], path, (t, q, v), end)
                if hit is None:
                    return Motion(*(np.array(part, float) for part in path(end)), mode, count)
                if end - at < MOMENT:
                    raise Ambiguous
                t = at
            q, v = edges[mode][hit].reset(t, *path(t))
            mode, count = edges[mode][hit].target, count + 1
        raise Ambiguous


def _value(edge: Edge, xp, path, t):
    return edge.direction * edge.guard(xp, t, *path(t))


def _fires_at_once(edge: Edge, mode: str, path, t, value) -> bool:
    later = _value(edge, mpmath, path, t + LATER)
    if abs(value) > ZERO and abs(value) < 1e-12:
        raise Ambiguous
    if value < -ZERO or (abs(value) <= ZERO and edge.target != mode and later <= 0):
        return False
    return edge.target != mode or later > value


def _first_crossing(edges: Sequence[Edge], motion: Callable, path, start, end):
    t, q, v = start
    times = np.linspace(float(t), float(end), POINTS)
    floats = motion(np, float(t), *([float(x) for x in part] for part in (q, v)))
    found = None, end
    for k, edge in enumerate(edges):
        values = np.broadcast_to(edge.direction * edge.guard(np, times, *floats(times)), times.shape)
        scale = np.abs(values).max()
        rises = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
        rises = rises[(rises > 0) | (values[0] < -1e-12)]  # at zero rounding has decided the first value
        tops = (values[1:-1] <= 0) & (values[1:-1] > values[:-2]) & (values[1:-1] > values[2:])
        last = rises[0] if rises.size else POINTS
        if (np.abs(values[1:-1][tops]) < NEAR * scale)[: last - 1].any():
            raise Ambiguous
        if rises.size:
            between = mpmath.mpf(times[rises[0]]), mpmath.mpf(times[rises[0] + 1])
            root = mpmath.findroot(functools.partial(_value, edge, mpmath, path), between, solver="anderson", tol=1e-60)
            found = (k, root) if root < found[1] else found
    return found


def _drawn(draw: Callable, rng) -> Scene:
    while True:
        try:
            return draw(rng)
        except (Ambiguous, ValueError, ZeroDivisionError):
            continue


def driven(force: Callable) -> Callable:
    """The motion of `force(xp, q, v)` = (a, w, φ, b, m): m q̈ = a sin(wt + φ) + b, coordinate by coordinate."""

    def motion(xp, t0, q, v):
        parts = [_driven_part(xp, t0, x, y, *f) for x, y, f in zip(q, v, force(xp, q, v), strict=True)]
        return lambda t: tuple([part(t)[i] for part in parts] for i in range(2))

    return motion


def _driven_part(xp, t0, x, y, a, w, phase, b, m):
    def part(t):
        s, c, of_s, of_c = *(f(w * t0 + phase) for f in (xp.sin, xp.cos)), xp.sin(w * t + phase), xp.cos(w * t + phase)
        past = t - t0
        speed = y + (a / w * (c - of_c) + b * past) / m
        return x + y * past + (a / w * (c * past - (of_s - s) / w) + b * past**2 / 2) / m, speed

    return part


# ---- the scenes ------------------------------------------------------------------------------------------------------


def rounded(number: float) -> float:
    """A number that float32 has, too."""
    return float(np.float32(number))


def uniform(rng, low: float, high: float) -> float:
    """A random number of a few digits, as float32 has it."""
    return rounded(np.round(rng.uniform(low, high), 2))


def load(rng) -> dict:
    """The numbers of a sin(wt + φ) + b."""
    return {"a": uniform(rng, 0.3, 6), "w": uniform(rng, 0.5, 4), "phase": uniform(rng, 0, 6), "b": uniform(rng, -1, 1)}


def pull(p, xp, t):
    """a sin(wt + φ) + b."""
    return p["a"] * xp.sin(p["w"] * t + p["phase"]) + p["b"]


def table(rng) -> Scene:
    """A ball on a table at A sin(wt + φ), at rest there or thrown; where it lands it takes the table's speed."""
    p = {"A": uniform(rng, 0.1, 1), "w": uniform(rng, 2, 6), "phase": uniform(rng, 0, 6)}

    def height(xp, t, k=0):
        of = (xp.sin, xp.cos, lambda x: -xp.sin(x))[k]
        return p["A"] * p["w"] ** k * of(p["w"] * t + p["phase"])

    def rest(xp, t0, q, v):
        return lambda t: ([height(xp, t)], [height(xp, t, 1)])

    def flight(xp, t0, q, v):
        return lambda t: ([q[0] + v[0] * (t - t0) - G * (t - t0) ** 2 / 2], [v[0] - G * (t - t0)])

    edges = {
        "rest": [Edge(lambda xp, t, q, v: G + height(xp, t, 2), -1, "flight")],
        "flight": [
            Edge(lambda xp, t, q, v: q[0] - height(xp, t), -1, "rest", lambda t, q, v: (q, [height(mpmath, t, 1)]))
        ],
    }
    start, duration = str(rng.choice(["rest", "flight"])), uniform(rng, 2, 5)
    q, v = height(np, 0.0), height(np, 0.0, 1)
    if start == "flight":
        q, v = rounded(q + uniform(rng, 0.05, 2)), uniform(rng, -3, 3)
    return Scene(
        "table", start, q, v, duration, p, followed({"rest": rest, "flight": flight}, edges, start, 0, duration, q, v)
    )


def block_motions(p) -> tuple[dict, dict]:
    """Block of mass 1 under a load, held up to `static`, slowed by `kinetic`."""
    rest = driven(lambda xp, q, v: [(0, p["w"], p["phase"], 0, 1)])
    slip = {
        s: driven(lambda xp, q, v, s=s: [(p["a"], p["w"], p["phase"], p["b"] - s * p["kinetic"], 1)]) for s in (1, -1)
    }

    def stop(t, q, v):
        return (q, [mpmath.mpf(0)])

    edges = {
        "stick": [
            Edge(lambda xp, t, q, v: pull(p, xp, t) - p["static"], 1, "up"),
            Edge(lambda xp, t, q, v: pull(p, xp, t) + p["static"], -1, "down"),
        ],
        "up": [Edge(lambda xp, t, q, v: v[0], -1, "stick", stop)],
        "down": [Edge(lambda xp, t, q, v: v[0], 1, "stick", stop)],
    }
    return {"stick": rest, "up": slip[1], "down": slip[-1]}, edges


def block(rng) -> Scene:
    """A block that sticks and slips; in half of the scenes static friction is no more than kinetic."""
    p = load(rng) | {"kinetic": uniform(rng, 0.2, 2)}
    p["static"] = p["kinetic"] if rng.random() < 0.5 else rounded(p["kinetic"] * uniform(rng, 1.05, 2))
    start, duration = str(rng.choice(["stick", "up", "down"])), uniform(rng, 2, 6)
    v = {"stick": 0.0, "up": uniform(rng, 0, 2), "down": -uniform(rng, 0, 2)}[start] * (rng.random() < 0.7)
    return Scene("block", start, 0.0, v, duration, p, followed(*block_motions(p), start, 0, duration, 0.0, v))


def loop(rng) -> Scene:
    """The same under inputs that are held for a while: a motion for each, from where the last one ended."""
    p = {"static": uniform(rng, 0.5, 1.5), "w": 1.0, "phase": 0.0, "a": 0.0}
    p["kinetic"], duration, u = (
        rounded(0.8 * p["static"]),
        uniform(rng, 0.1, 0.6),
        np.float32(rng.normal(0, 1.2, STEPS)),
    )
    right = Motion([0.0], [0.0], "stick", 0)
    for x in u:
        begun = followed(*block_motions(p | {"b": float(x)}), right.mode, 0, duration, right.q, right.v)
        right = begun._replace(count=right.count + begun.count)
    return Scene("loop", "stick", 0.0, 0.0, duration, p | {"b": u}, right)


def wheel(rng) -> Scene:
    """Two shafts of inertia m and M with a freewheel between them: the first drives the second, and may fall behind."""
    p = load(rng) | {"m": uniform(rng, 0.5, 2), "M": uniform(rng, 0.5, 3)}
    share = p["M"] / (p["m"] + p["M"])
    load_of = (p["a"], p["w"], p["phase"], p["b"])
    modes = {
        "lock": driven(lambda xp, q, v: [(*load_of, p["m"] + p["M"])] * 2),
        "free": driven(lambda xp, q, v: [(*load_of, p["m"]), (0, p["w"], p["phase"], 0, p["M"])]),
    }

    def join(t, q, v):
        return (q, [v[0] * (1 - share) + v[1] * share] * 2)

    edges = {
        "lock": [Edge(lambda xp, t, q, v: pull(p, xp, t) * share, -1, "free")],
        "free": [Edge(lambda xp, t, q, v: v[0] - v[1], 1, "lock", join)],
    }
    start, duration, v = str(rng.choice(["lock", "free"])), uniform(rng, 2, 8), uniform(rng, -1, 1)
    v = np.array([v, v if start == "lock" or rng.random() < 0.3 else uniform(rng, -1, 1)])
    return Scene(
        "wheel", start, np.zeros(2), v, duration, p, followed(modes, edges, start, 0, duration, np.zeros(2), v)
    )


def wall(rng) -> Scene:
    """A particle in a unit box that begins inside or up to 0.3 beyond one of its walls, or by very little."""
    d, e = int(rng.integers(1, 4)), uniform(rng, 0.5, 1)
    q, v = (np.array([uniform(rng, low, 1) for _ in range(d)]) for low in (0, -2))
    beyond = rng.random(d) < 0.6
    depth = np.where(rng.random(d) < 0.5, 10.0 ** rng.uniform(-5, -2, d), rng.uniform(0, 0.3, d))
    q = np.float32(np.where(beyond, np.where(rng.random(d) < 0.5, -depth, 1 + depth), q)).astype(float)
    motion = driven(lambda xp, q, v: [(0, 1, 0, 0, 1)] * d)

    def face(i, side):
        def reset(t, q, v):
            return (q, [-e * y if j == i else y for j, y in enumerate(v)])

        return Edge(lambda xp, t, q, v: q[i] if side < 0 else 1 - q[i], -1, "in", reset)

    edges, duration = {"in": [face(i, side) for i in range(d) for side in (-1, 1)]}, uniform(rng, 0.5, 3)
    return Scene(f"wall {d}", "in", q, v, duration, {"e": e}, followed({"in": motion}, edges, "in", 0, duration, q, v))


def jump(rng) -> Scene:
    """A particle that jumps back by d where it comes to x = 1, and changes its mode, and its weight, below x = −c."""
    p = {"d": uniform(rng, 0.5, 4), "c": uniform(rng, 0, 2), "g": uniform(rng, 0.1, 2)}
    fall = driven(lambda xp, q, v: [(0, 1, 0, -p["g"], 1)])
    motions = {"f": driven(lambda xp, q, v: [(0, 1, 0, 0, 1)]), "g": fall}
    edges = {
        "f": [
            Edge(lambda xp, t, q, v: 1 - q[0], -1, "f", lambda t, q, v: ([q[0] - p["d"]], v)),
            Edge(lambda xp, t, q, v: q[0] + p["c"], -1, "g"),
        ],
        "g": [],
    }
    q, v, duration = uniform(rng, -3, 2), uniform(rng, -2, 2), uniform(rng, 1, 4)
    return Scene("jump", "f", q, v, duration, p, followed(motions, edges, "f", 0, duration, q, v))


def sphere(rng) -> Scene:
    """A particle on a sphere of radius 1, perhaps too fast for it; it flies where the multiplier changes its sign."""
    angle, speed, duration = uniform(rng, 0.1, 1.4), uniform(rng, 0.05, 4), uniform(rng, 0.2, 1)
    q, v = np.array([np.sin(angle), np.cos(angle)]), speed * np.array([np.cos(angle), -np.sin(angle)])
    cosine, t = (2 * np.cos(angle) + speed**2 / G) / 3, 0.0
    if abs(cosine - np.cos(angle)) < 1e-3:
        raise Ambiguous
    if cosine < np.cos(angle):

        def rate(x):
            return np.sqrt(speed**2 + 2 * G * (np.cos(angle) - np.cos(x)))

        t = quad(lambda x: 1 / rate(x), angle, np.arccos(cosine), epsabs=1e-13, epsrel=1e-13)[0]
        q = np.array([np.sqrt(1 - cosine**2), cosine])
        v = rate(np.arccos(cosine)) * np.array([q[1], -q[0]])
    left, begun = duration - t, (np.array([np.sin(angle), np.cos(angle)]), speed)
    if left < 0.02:
        raise Ambiguous
    right = Motion(q + v * left - [0, G * left**2 / 2], v - [0, G * left], "off", 1)
    return Scene(
        "sphere", "on", begun[0], begun[1] * np.array([np.cos(angle), -np.sin(angle)]), duration, {"g": G}, right
    )


FAMILIES = (table, block, wheel, wall, jump, block, wheel, table, loop, sphere)


# ---- the same with lagjax --------------------------------------------------------------------------------------------


def scenes_of(family: str) -> tuple[dict, list]:
    """The modes and transitions of a family."""
    made = {"table": _table, "wheel": _wheel, "jump": _jump, "sphere": _sphere, "block": _block, "loop": _block}
    made |= {f"wall {d}": functools.partial(_walls, d) for d in (1, 2, 3)}
    return made[family]()


def _table():
    def height(t, p):
        return p["A"] * jnp.sin(p["w"] * t + p["phase"])

    def speed(t, p):
        return p["A"] * p["w"] * jnp.cos(p["w"] * t + p["phase"])

    def law(q, v):
        return 0.5 * v**2 - G * q

    modes = {
        "rest": lagjax.System(law, constraints=lambda q, t, params: q - height(t, params)),
        "flight": lagjax.System(law),
    }

    def land(q, v, t, params):
        return (height(t, params), speed(t, params))

    return modes, [
        lagjax.Transition("rest", "flight", lambda q, v, multipliers: multipliers, -1),
        lagjax.Transition("flight", "rest", lambda q, v, t, params: q - height(t, params), -1, land),
    ]


def _block():
    law, stop = lambda q, v: 0.5 * v**2, lambda q, v: (q, 0 * v)

    def force(s):
        return lambda q, v, t, params: pull(params, jnp, t) - s * params["kinetic"]

    modes = {"stick": lagjax.System(law, forces=force(0), velocity_constraints=lambda q, v: v)}
    modes |= {name: lagjax.System(law, forces=force(s)) for name, s in (("up", 1), ("down", -1))}
    return modes, [
        lagjax.Transition("stick", "up", lambda q, v, multipliers, params: -multipliers - params["static"], 1),
        lagjax.Transition("stick", "down", lambda q, v, multipliers, params: -multipliers + params["static"], -1),
        lagjax.Transition("up", "stick", lambda q, v: v, -1, stop),
        lagjax.Transition("down", "stick", lambda q, v: v, 1, stop),
    ]


def _wheel():
    def law(q, v, params):
        return 0.5 * params["m"] * v[0] ** 2 + 0.5 * params["M"] * v[1] ** 2

    def force(q, v, t, params):
        return jnp.stack([pull(params, jnp, t), 0 * t])

    modes = {
        "lock": lagjax.System(law, forces=force, velocity_constraints=lambda q, v: v[0] - v[1]),
        "free": lagjax.System(law, forces=force),
    }

    def join(q, v, params):
        joint = (params["m"] * v[0] + params["M"] * v[1]) / (params["m"] + params["M"])
        return q, jnp.stack([joint, joint])

    return modes, [
        lagjax.Transition("lock", "free", lambda q, v, multipliers: -multipliers, -1),
        lagjax.Transition("free", "lock", lambda q, v: v[0] - v[1], 1, join),
    ]


def _walls(d: int):
    def face(i, side):
        def reset(q, v, params):
            return (q, v.at[i].multiply(-params["e"]))

        return lagjax.Transition("in", "in", lambda q, v: q[i] if side < 0 else 1 - q[i], -1, reset)

    modes = {"in": lagjax.System(lambda q, v: 0.5 * v @ v)}
    return modes, [face(i, side) for i in range(d) for side in (-1, 1)]


def _jump():
    def law(q, v):
        return 0.5 * v**2

    modes = {"f": lagjax.System(law), "g": lagjax.System(lambda q, v, params: 0.5 * v**2 - params["g"] * q)}
    return modes, [
        lagjax.Transition("f", "f", lambda q, v: 1 - q, -1, lambda q, v, params: (q - params["d"], v)),
        lagjax.Transition("f", "g", lambda q, v, params: q + params["c"], -1),
    ]


def _sphere():
    def law(q, v, params):
        return 0.5 * v @ v - params["g"] * q[1]

    modes = {"on": lagjax.System(law, constraints=lambda q: q @ q - 1), "off": lagjax.System(law)}
    return modes, [lagjax.Transition("on", "off", lambda q, v, multipliers: multipliers, -1)]


@functools.cache
def runs(family: str, start: str) -> Callable:
    """`(q, v, T, params)`: the motions of scenes of one family, each with an axis of members in front."""
    modes, transitions = scenes_of(family)

    def run(q, v, duration, params):
        ts = jnp.stack([jnp.zeros_like(duration), duration])
        done = lagjax.simulate(
            lagjax.Hybrid(modes, transitions, start), q, v, ts, params, max_transitions=MOST + 4, throw=False
        )
        return done.ok, done.end.q, done.end.qdot, done.transitions.count, done.mode[-1]

    return jax.jit(jax.vmap(run))


def run_loops(q, v, duration, params):
    """The ends of control loops: one call for each input, in the mode in which the last one ended."""
    names, inputs = ("stick", "up", "down"), params["b"]
    mode, ok, count = np.zeros(len(q), int), np.ones(len(q), bool), np.zeros(len(q), int)
    for k in range(STEPS):
        held = (q, v, duration, params | {"b": inputs[:, k]})
        parts = [[np.asarray(x) for x in runs("loop", name)(*held)] for name in names]
        of_mode = [np.stack(column)[mode, np.arange(len(mode))] for column in zip(*parts, strict=True)]
        well, q, v, more, mode = of_mode
        ok, count = ok & well, count + more
        mode = np.maximum(mode, 0)
    return ok, q, v, count, mode


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.guard_population", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    _singles.add_option(parser)
    options = parser.parse_args(arguments)
    _singles.precision_of(options)
    dtype, tolerance = (np.float32, SINGLE_TOLERANCE) if options.float32 else (np.float64, TOLERANCE)
    seeds = range(options.first, options.first + options.scenes)
    scenes = {seed: _drawn(FAMILIES[seed % len(FAMILIES)], np.random.default_rng(seed)) for seed in seeds}
    counts, worst = collections.Counter(), 0.0
    for family, start in sorted({(scene.family, scene.start) for scene in scenes.values()}):
        some = {seed: scene for seed, scene in scenes.items() if (scene.family, scene.start) == (family, start)}
        given = [(s.q, s.v, s.duration, s.params) for s in some.values()]
        given = jax.tree.map(lambda *xs: np.stack(xs).astype(dtype), *given)
        done = run_loops(*given) if family == "loop" else runs(family, start)(*given)
        names = list(scenes_of(family)[0])
        for (seed, scene), (ok, q, v, count, mode) in zip(
            some.items(), zip(*map(np.asarray, done), strict=True), strict=True
        ):
            right, reached = scene.right, np.append(q, v)
            end = np.append(right.q, right.v)
            error = np.abs(reached - end).max() / (1 + np.abs(end).max())
            same = (count, names[mode]) == (right.count, right.mode) and error <= tolerance
            name = "named" if not ok else "right" if same else "wrong"
            worst = max(worst, error) if name == "right" else worst
            counts[name] += 1
            if name != "right":
                print(
                    f"{seed} {name}: {family} from {start!r}: {reached}, {names[mode]!r}, {count} for {right}",
                    flush=True,
                )
    print(f"{dict(counts)}; the largest error of a right one {worst:.1e}", file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
