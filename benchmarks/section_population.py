"""Random motions that begin on a section, or beside it: is any event or crossing wrong without a word?

    python -m benchmarks.section_population --scenes 300
    python -m benchmarks.section_population --scenes 300 --float32

A fall, an oscillator in the plane, a section that moves, and a bead on a circle, which is a constraint: all with closed
forms. Of each the crossings of one section are compared, and its event, in one direction or in both. Two thirds of the
starts are on the section as far as a user's arithmetic knows, whose level is a sum of products of short numbers. What a
start on it is expected to do is the rule of `simulate`: it has to leave first, and with a direction it is an event at
once where the motion goes that way. A motion is *wrong* whose crossings are others; one that says so is *named*.
"""

import argparse
import collections
import functools
import sys
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import lagjax
from benchmarks._singles import EPS, SINGLE_NOISE, add_option, precision_of, rounded

ROOM, GRID, RTOL = 32, 4000, 1e-9
# Two crossings so close to each other, or to the end, that rounding decides whether there are any: drawn again. So are
# starts on the section that leave it slower than this, and starts beside it that are not ten times the noise away.
APART = 1e-3


class Scene(NamedTuple):
    """One motion: its family, direction, start, duration and params; its section as a function of the time."""

    family: str
    direction: int
    q: np.ndarray
    v: np.ndarray
    duration: float
    params: dict
    section: Callable
    size: float  # Σ |∂s/∂x x| over all numbers that came in


def draw(rng, precision: np.dtype) -> Scene:
    """A random scene."""

    def given(x):
        return rounded(x, precision)

    def digits(low, high, count=None):
        return rng.integers(10 * low, 10 * high + 1, count) / 10

    family, on = str(rng.choice(list(FAMILIES))), rng.random() < 0.67
    beside = 0.0 if on else float(rng.choice([-1, 1])) * 10 ** rng.uniform(-3, -0.5)
    direction, duration = int(rng.choice([-1, 0, 1])), float(rng.choice([2.0, 5.0, 10.0]))
    q, v = digits(-2, 2, 2), digits(-2, 2, 2)
    n = np.array([1.0, 0.0]) if rng.random() < 0.4 else digits(-1, 1, 2)
    g, u = float(rng.choice([1.0, 9.81, 0.3])), 0.0
    if family == "ring":
        q, v = (np.array([0.6, 0.8]), float(digits(1, 2)) * np.array([-0.8, 0.6])) if rng.random() < 0.6 else (
            np.array([np.cos(x := rng.uniform(0, 6)), np.sin(x)]), np.array([-np.sin(x), np.cos(x)])
        )  # fmt: skip
    if family == "moving":
        u = float(digits(-1, 1))
    w = float(n @ q) - beside  # as a user computes it
    q, v, n, w, g, u = (given(x) for x in (q, v, n, w, g, u))
    params = {"n": n, "w": w, "g": g, "u": u}
    path = FAMILIES[family](q, v, params)
    size = float(np.abs(n * q).sum() * 2 + abs(w))
    return Scene(family, direction, q, v, duration, params, lambda t: n @ path(t) - w - u * t, size)


def fall(q, v, params):
    """Both coordinates fall."""
    return lambda t: q[:, None] + v[:, None] * t - 0.5 * params["g"] * t**2


def swing(q, v, params):
    """An oscillator of frequency 1."""
    return lambda t: q[:, None] * np.cos(t) + v[:, None] * np.sin(t)


def ring(q, v, params):
    """A bead on the circle through its start, without weight."""
    r = np.hypot(*q)
    rate = (q[0] * v[1] - q[1] * v[0]) / r**2
    return lambda t: np.stack([q[0] * np.cos(rate * t) - q[1] * np.sin(rate * t),
                               q[0] * np.sin(rate * t) + q[1] * np.cos(rate * t)])  # fmt: skip


FAMILIES = {"fall": fall, "swing": swing, "moving": swing, "ring": ring}


# ---- the reference ---------------------------------------------------------------------------------------------------


def roots(scene: Scene) -> tuple[np.ndarray, np.ndarray, int] | None:
    """The times at which the section changes sign after the start, and its rates there; the direction at the start.

    That is 0 where it does not begin on the section. None where rounding decides what happens.
    """
    noise = (SINGLE_NOISE if SINGLE else 1e-13) * scene.size
    s, first, way = scene.section, float(scene.section(np.zeros(1))[0]), 0
    t = np.linspace(0, scene.duration, GRID)
    rate = float((s(np.array([1e-6])) - s(np.zeros(1)))[0] / 1e-6)
    if abs(first) <= noise:
        if abs(rate) < 0.05:
            return None
        way, level = int(np.sign(rate)), first
        values = s(t) - level
        values[0] = 0.0
        begin = 1
    elif abs(first) < 100 * noise:
        return None
    else:
        level, values, begin = 0.0, s(t), 0
    found = [
        brentq(lambda x: float(s(np.array([x]))[0] - level), t[k], t[k + 1], xtol=1e-14)
        for k in range(begin, GRID - 1) if values[k] * values[k + 1] < 0
    ]  # fmt: skip
    found = np.array(found)
    slopes = np.array([float((s(np.array([x + 1e-6])) - s(np.array([x - 1e-6])))[0] / 2e-6) for x in found])
    edges = np.concatenate([[0.0] if way else [], found, [scene.duration]])
    sizes = np.abs(values)
    turns = sizes[1:-1][(sizes[1:-1] < sizes[:-2]) & (sizes[1:-1] < sizes[2:])]
    near = (np.diff(edges) < 20 * APART).any() or (np.abs(slopes) < 0.05).any()
    grazes = ((turns < APART) & (turns > 0)).sum() > len(found) + bool(way)
    return None if near or grazes else (found, slopes, way)


# ---- the same with lagjax --------------------------------------------------------------------------------------------


@functools.cache
def runs(family: str, direction: int) -> Callable:
    """`(q, v, T, params)`: times and count of the crossings, and the time of the event, of members of one family."""

    def section(q, v, t, params):
        return params["n"] @ q - params["w"] - params["u"] * t

    potential = {"fall": lambda q, p: p["g"] * jnp.sum(q), "ring": lambda q, p: 0.0 * jnp.sum(q)}
    of = potential.get(family, lambda q, p: 0.5 * jnp.sum(q**2))
    bound = {"constraints": lambda q, params: q @ q - params["r"]} if family == "ring" else {}
    system = lagjax.System(lambda q, v, params: 0.5 * v @ v - of(q, params), **bound)
    event = diffrax.Event(section, direction={0: None, 1: True, -1: False}[direction])

    def run(q, v, duration, params):
        ts, params = jnp.stack([jnp.zeros_like(duration), duration]), {**params, "r": q @ q}
        found = lagjax.crossings(system, section, q, v, ts, params, direction=direction, count=ROOM, throw=False)
        ended = lagjax.simulate(system, q, v, ts, params, event=event, throw=False)
        return found.t, found.count, found.ok, ended.end.t, ended.ok

    return jax.jit(jax.vmap(run))


SINGLE = False


def judge(scene: Scene, found: tuple, t, count, ok, ended, ended_ok) -> tuple[str, str]:
    """What became of a scene, and what was expected."""
    times, slopes, way = found
    counts = slopes * scene.direction >= 0
    times, slopes = times[counts], slopes[counts]
    # The level is off by the rounding of the start, the time by its own and by that of the motion.
    eps, noise = (EPS, SINGLE_NOISE) if SINGLE else (1e-15, 1e-13)
    allowed = 4 * (noise * scene.size + RTOL + eps) / np.abs(slopes) + eps * (1 + times) * 4
    at_once = way and scene.direction == way
    first = 0.0 if at_once else times[0] if len(times) else scene.duration
    of_first = 4 * eps * scene.duration + (0.0 if at_once or not len(times) else allowed[0])
    text = f"expected {times}, event at {first}"
    if not (ok and ended_ok):
        return "named", text
    right = (
        count == len(times) and (np.abs(t[: len(times)] - times) <= allowed).all() and abs(ended - first) <= of_first
    )
    return ("right" if right else "wrong"), text


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.section_population", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    add_option(parser)
    options = parser.parse_args(arguments)
    precision = precision_of(options)
    global SINGLE
    SINGLE = options.float32
    scenes, counts = {}, collections.Counter()
    for seed in range(options.first, options.first + options.scenes):
        rng = np.random.default_rng(seed)
        while (found := roots(scene := draw(rng, precision))) is None:
            pass
        scenes[seed] = scene, found
    for kind in sorted({(scene.family, scene.direction) for scene, _ in scenes.values()}):
        of_kind = {seed: pair for seed, pair in scenes.items() if (pair[0].family, pair[0].direction) == kind}
        given = [(s.q, s.v, s.duration, s.params) for s, _ in of_kind.values()]
        columns = jax.tree.map(lambda *xs: np.stack(xs).astype(precision), *given)
        results = zip(*map(np.asarray, runs(*kind)(*columns)), strict=True)
        for (seed, (scene, found)), result in zip(of_kind.items(), results, strict=True):
            name, text = judge(scene, found, *result)
            counts[name] += 1
            if name != "right":
                start = f"{kind} from {scene.q.tolist()}, {scene.v.tolist()} to {scene.duration}, {scene.params}"
                print(f"{seed} {name}: {start}: {result}; {text}", flush=True)
    print(dict(counts), file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
