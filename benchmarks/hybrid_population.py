"""Random hybrid scenes that meet corners, and several guards within rounding: is any motion wrong without a word?

    python -m benchmarks.hybrid_population --scenes 300
    python -m benchmarks.hybrid_population --scenes 300 --float32

Two to six guards watch every scene: particles in boxes and polygons, beads on a line that touch, between walls and
without, balls that land together, a particle that falls in a box, and two modes that take turns at a line between
walls. Numbers have one or two digits, so that corners are hit, starts touch what they meet, and motions end at an
event; coordinates are off by 0 or 1e-16 … 1e-12. The reference goes from event to event in rational numbers, or in
parabolas of 60 digits. A motion is *wrong* whose end or count of transitions is another one; one that says so itself is
*named*, which only motions that come to rest may be. Where two reflections at one instant do not commute, as in the
corners of a triangle of 3, 4, 5, either order is right, and so is that of a start off by 2e-13.
"""

import argparse
import collections
import functools
import itertools
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import lagjax
from benchmarks._singles import EPS, SINGLE_NOISE, add_option, precision_of, rounded

MOST, MOST_AT_ONCE = 60, 200  # transitions of a motion; reflections at one instant, in exact arithmetic
# Some sixty transitions, each known to a hundred roundings at speeds of ten, for twenty units of time: 1e-10. A count
# and a velocity are compared where no event is within this of the end.
TOLERANCE, MOMENT = 1e-9, 1e-9
SIZES = (0.0, 1e-16, 1e-15, 3e-15, 1e-14, 3e-14, 1e-13, 1e-12)
NEARBY = Fraction(2, 10**13)  # of a start whose motion may be taken for the exact one, where reflections do not commute


class Digits(NamedTuple):
    """How exactly the numbers of all scenes came in, and what is asked of their motions."""

    precision: np.dtype = np.dtype(float)
    sizes: tuple[float, ...] = SIZES
    nearby: Fraction = NEARBY
    tolerance: float = TOLERANCE
    moment: float = MOMENT


# A start counts as on a surface within `SINGLE_NOISE` of coordinates up to 3, of which a guard has two, and each of the
# faces that it meets at once moves it by that; a result is rounded. Motions end, and are counted, that much beside.
SINGLE = Digits(
    np.dtype(np.float32), (0.0, *(k * EPS for k in (0.5, 1, 2, 16, 100, 1000))), Fraction(2 * SINGLE_NOISE),
    8 * SINGLE_NOISE, 32 * SINGLE_NOISE,
)  # fmt: skip
DOUBLE = digits_of = Digits()


class Motion(NamedTuple):
    """The end of a motion, how many transitions there were, and how near the last time the nearest one was."""

    q: Any
    v: Any
    count: int
    nearest: float


class Scene(NamedTuple):
    """One motion: its family, start, duration and params, and all motions that are right; none where it must be named.

    Those of one `family` share their code, and what `run(q, v, T, params)` of it returns.
    """

    family: str
    q: np.ndarray
    v: np.ndarray
    duration: float
    params: dict
    right: list[Motion]


# ---- the references --------------------------------------------------------------------------------------------------


def reflected(q, v, duration, normals, offsets, last: bool = False) -> Motion | None:
    """A free motion in the polyhedron n·q + c ≥ 0, reflected at its faces, in rational numbers.

    Of several faces at once the first one counts, or the `last`. None for a motion of too many reflections.
    """
    q, v, left, count, since = list(q), list(v), Fraction(duration), 0, Fraction(10**6)
    order = list(range(len(normals)))[:: -1 if last else 1]

    def dot(a, b):
        return sum((x * y for x, y in zip(a, b, strict=True) if x), Fraction(0))

    for _ in range(MOST_AT_ONCE * MOST):
        heights = [dot(n, q) + c for n, c in zip(normals, offsets, strict=True)]
        rates = [dot(n, v) for n in normals]
        hit = next((i for i in order if heights[i] <= 0 and rates[i] < 0), None)
        if hit is not None:
            n = normals[hit]
            v = [x - 2 * y * rates[hit] / dot(n, n) for x, y in zip(v, n, strict=True)]
            count, since = count + 1, Fraction(0)
            if count > MOST:
                return None
            continue
        ahead = min((h / -r for h, r in zip(heights, rates, strict=True) if r < 0), default=left + 10**6)
        step = min(ahead, left)
        q, left = [x + step * y for x, y in zip(q, v, strict=True)], left - step
        since += step
        if left == 0:
            return Motion(np.array(q, float), np.array(v, float), count, float(min(since, ahead - step)))
    return None


def thrown(q, v, duration, gravity, floor=0, ceiling=None, restitution: float = 1) -> Motion | None:
    """A fall along one coordinate between a floor and a ceiling; None where it comes to rest, or bounces too often."""
    with mpmath.workdps(60):
        q, v, left, g, e = (mpmath.mpf(x) for x in (q, v, duration, gravity, restitution))
        floor, count, since = mpmath.mpf(floor), 0, mpmath.inf
        top = None if ceiling is None else mpmath.mpf(ceiling)
        while count <= MOST:
            if q <= floor and v == 0:
                return None
            if (q <= floor and v < 0) or (top is not None and q >= top and v > 0):
                v, count, since = -e * v, count + 1, mpmath.mpf(0)
                continue
            down = (v + mpmath.sqrt(v * v + 2 * g * (q - floor))) / g
            if top is not None and v > 0 and v * v >= 2 * g * (top - q):
                down = (v - mpmath.sqrt(v * v - 2 * g * (top - q))) / g
            if down >= left:
                end, speed = q + v * left - g * left * left / 2, v - g * left
                return Motion(float(end), float(speed), count, float(min(since + left, down - left)))
            rising = top is not None and v - g * down > 0
            v, left, since = v - g * down, left - down, mpmath.mpf(0)
            q = top if rising else floor
        return None


def in_turns(q, v, duration, above, below) -> Motion:
    """Along ẍ = −above where x > 0 and ẍ = +below where x < 0; a start at zero goes where its velocity does."""
    with mpmath.workdps(60):
        q, v, left, count, since = *(mpmath.mpf(x) for x in (q, v, duration)), 0, mpmath.inf
        side = mpmath.sign(q) or mpmath.sign(v)
        while True:
            g = mpmath.mpf(above if side > 0 else below)
            back = (side * v + mpmath.sqrt(v * v + 2 * g * abs(q))) / g
            if back >= left:
                end, speed = q + v * left - side * g * left * left / 2, v - side * g * left
                return Motion(float(end), float(speed), count, float(min(since + left, back - left)))
            q, v, left, side = mpmath.mpf(0), v - side * g * back, left - back, -side
            count, since = count + 1, mpmath.mpf(0)


def together(parts: Sequence[Motion | None]) -> list[Motion]:
    """Independent motions of single coordinates as one; none where one of them comes to rest, or all bounce too often.

    A motion of several coordinates among them stands for these.
    """
    if any(part is None for part in parts) or sum(part.count for part in parts if part) > MOST:
        return []
    q, v = (np.concatenate([np.atleast_1d(part[k]) for part in parts if part]) for k in range(2))
    return [Motion(q, v, sum(p.count for p in parts if p), min(p.nearest for p in parts if p))]


# ---- the scenes ------------------------------------------------------------------------------------------------------


def digits(rng, low: int, high: int, count: int | None = None):
    """Numbers of one digit or of two behind the point, as decimals between low and high."""
    scale = int(rng.choice([1, 10, 10, 100]))
    return given(rng.integers(low * scale, high * scale + 1, count) / scale)


def given(x):
    """Numbers as they come in."""
    return rounded(x, digits_of.precision)[()]


def chosen(rng, numbers: Sequence[float]) -> float:
    """One of these numbers, as it comes in."""
    return float(given(rng.choice(numbers)))


def off(rng, x: np.ndarray, low, high) -> np.ndarray:
    """Some coordinates are moved by a little, not beyond low and high."""
    moved = x + rng.choice(digits_of.sizes, x.size) * rng.choice([-1, 1], x.size) * (rng.random(x.size) < 0.5)
    return given(np.clip(moved, low, high))


def exact(x) -> list[Fraction]:
    """Numbers as they are, in binary."""
    return [Fraction(float(y)) for y in np.ravel(x)]


BOX = np.concatenate([np.eye(3), -np.eye(3)])
SHAPES = {
    "right triangle": (np.array([[1.0, 0], [0, 1], [-1, -1]]), lambda a: [0, 0, a], True),
    "diamond": (np.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]]), lambda a: [a, a, a, a], True),
    "triangle of 3, 4, 5": (np.array([[1.0, 0], [0, 1], [-3, -4]]), lambda a: [0, 0, 12 * a], False),
}


def box(rng) -> Scene:
    """A particle in a box of one, two or three dimensions; corners are hit where numbers have common factors."""
    d = int(rng.integers(1, 4))
    size = np.full(d, 1.0) if rng.random() < 0.5 else np.maximum(digits(rng, 0, 3, d), 0.5)
    q, v = off(rng, rng.integers(0, 11, d) / 10 * size, 0 * size, size), digits(rng, -3, 3, d)
    if rng.random() < 0.4:  # towards a corner, or along the diagonal
        q, v = np.full(d, q[0]), given(np.full(d, v[0]) * rng.choice([1, 2, 3], d))
        q, size = off(rng, q, 0, size[0]), np.full(d, size[0])
    normals = BOX[[*range(d), *range(3, 3 + d)], :d]
    return billiard(rng, q, v, normals, np.concatenate([0 * size, size]), True)


def polygon(rng) -> Scene:
    """A particle in a triangle or a diamond."""
    name = str(rng.choice(list(SHAPES)))
    normals, offsets, commute = SHAPES[name]
    size = float(rng.choice([1.0, 0.5, 2.0, 1.2]))
    while True:
        q = off(rng, rng.integers(-10, 11, 2) / 10 * size, -9, 9)
        # In float32 a start may be beyond a face, by rounding.
        if (normals @ q + offsets(size) >= (0 if digits_of is DOUBLE else -4 * EPS * size)).all():
            return billiard(rng, q, digits(rng, -3, 3, 2), normals, np.array(offsets(size)), commute)


def beads(rng) -> Scene:
    """Three or five beads of equal mass on a line, as wide as this or points; between walls or not; some touch."""
    n, walls, width = int(rng.choice([3, 5])), bool(rng.random() < 0.5), float(rng.choice([0.0, 0.1, 0.3, 0.7]))
    q = np.sort(rng.integers(0, 11, n) if rng.random() < 0.5 else rng.integers(0, 4, n) * 3) / 10
    v = digits(rng, -2, 2, n) * (rng.random(n) < 0.6)
    q = given(np.maximum.accumulate(off(rng, q, 0.0, 1.0)) + width * np.arange(n))
    apart = np.eye(n)[1:] - np.eye(n)[:-1]
    normals, offsets = apart, np.full(n - 1, -width)
    if walls:
        normals = np.concatenate([apart, np.eye(n)[:1], -np.eye(n)[-1:]])
        offsets = np.r_[offsets, 0.0, 1.0 + width * (n - 1)]
    return billiard(rng, q, v, normals, offsets, True)


def billiard(rng, q, v, normals, offsets, commute: bool) -> Scene:
    """A scene of reflections, whose offsets are hundredths: in float32 these are exact, and a start beside them."""
    hundredths = np.round(100 * np.asarray(offsets))
    offsets = hundredths / 100
    duration = chosen(rng, [0.5, 1.0, 2.0, 5.0, 10.0, 7.3])
    numbers = exact(v), duration, [exact(n) for n in normals], exact(offsets)
    right = [reflected(exact(q), *numbers)]
    if not commute:
        shifts = itertools.product((0, -digits_of.nearby, digits_of.nearby), repeat=len(q))
        near = [[x + dx for x, dx in zip(exact(q), shift, strict=True)] for shift in shifts]
        right += [reflected(x, *numbers, last=last) for x in near for last in (False, True)]
    if right[0] is None:  # too many: it is drawn again
        return billiard(rng, q, given(0.3 * np.round(v, 1)), normals, offsets, commute)
    params = {"normals": np.asarray(normals, float), "hundredths": hundredths}
    family = f"{len(normals)} reflections of {len(q)} coordinates"
    return Scene(family, q, v, duration, params, [motion for motion in right if motion])


def balls(rng) -> Scene:
    """Two or three balls over a floor, dropped or thrown, often from one height."""
    d, e = int(rng.choice([2, 3])), chosen(rng, [1.0, 0.9, 0.5])
    g, duration = chosen(rng, [10.0, 9.81, 1.0]), chosen(rng, [1.0, 2.0, 0.8])
    q, v = np.abs(digits(rng, 0, 2, d)) * (rng.random(d) < 0.8), digits(rng, -2, 2, d) * (rng.random(d) < 0.5)
    if rng.random() < 0.7:
        q, v = np.full(d, q[0]), np.full(d, v[0])
    q = off(rng, q, 0.0, 9.0)
    right = together([thrown(x, y, duration, g, restitution=e) for x, y in zip(q, v, strict=True)])
    return Scene(f"{d} balls", q, v, duration, {"g": g, "e": e}, right)


def falling(rng) -> Scene:
    """A particle that falls in a box."""
    g, duration = float(rng.choice([10.0, 2.0, 1.0])), float(rng.choice([1.0, 2.0, 5.0]))
    q, v = off(rng, rng.integers(0, 11, 2) / 10, 0.0, 1.0), digits(rng, -3, 3, 2)
    across = reflected(
        exact(q[:1]), exact(v[:1]), duration, [[Fraction(1)], [Fraction(-1)]], [Fraction(0), Fraction(1)]
    )
    return Scene("falling", q, v, duration, {"g": g}, together([across, thrown(q[1], v[1], duration, g, 0, 1)]))


def turns(rng) -> Scene:
    """A particle that is pulled back to x = 0 by one force on either side, between walls in y; each side is a mode."""
    above, below = (float(x) for x in rng.choice([1.0, 2.0, 0.5, 4.0], 2))
    duration = float(rng.choice([1.0, 4.0, 6.0]))
    q, v = np.array([digits(rng, -1, 1), rng.integers(0, 11) / 10]), digits(rng, -2, 2, 2)
    v[0] = v[0] or 1.0
    q = off(rng, q, (-9.0, 0.0), (9.0, 1.0))
    q[0] *= abs(q[0]) > 1e-11  # a start beside the line belongs to a side, that on it to the one it goes to
    across = reflected(
        exact(q[1:]), exact(v[1:]), duration, [[Fraction(1)], [Fraction(-1)]], [Fraction(0), Fraction(1)]
    )
    side = "above" if (q[0] or v[0]) > 0 else "below"
    right = together([in_turns(q[0], v[0], duration, above, below), across])
    return Scene(f"turns from {side}", q, v, duration, {"above": above, "below": below}, right)


FAMILIES = (box, box, polygon, beads, beads, balls, falling, turns)


# ---- the same with lagjax --------------------------------------------------------------------------------------------


def flip(i: int, e: Callable = lambda params: 1.0) -> Callable:
    """A reset that turns one velocity round."""
    return lambda q, v, params: (q, v.at[i].multiply(-e(params)))


def face(name: str, guard: Callable, reset: Callable | None, target: str | None = None) -> lagjax.Transition:
    """A guard that is positive inside."""
    return lagjax.Transition(name, target or name, guard, -1, reset)


@functools.cache
def runs(family: str, d: int, guards: int) -> Callable:
    """`(q, v, T, params)`: the motions of scenes of one family, each with an axis of members in front."""
    start, modes, faces = "a", {}, []
    if "reflections" in family:
        modes["a"] = lagjax.System(lambda q, v: 0.5 * v @ v)

        def reset(i):
            def reflect(q, v, params):
                n = params["normals"][i]
                return q, v - 2 * n * (n @ v) / (n @ n)

            return reflect

        def guard(i):
            return lambda q, v, params: params["normals"][i] @ q + params["hundredths"][i] / 100

        faces = [face("a", guard(i), reset(i)) for i in range(guards)]
    elif "balls" in family:
        modes["a"] = lagjax.System(lambda q, v, params: 0.5 * v @ v - params["g"] * jnp.sum(q))
        faces = [face("a", _coordinate(i), flip(i, lambda params: params["e"])) for i in range(d)]
    elif family == "falling":
        modes["a"] = lagjax.System(lambda q, v, params: 0.5 * v @ v - params["g"] * q[1])
        faces = [face("a", _coordinate(i), flip(i)) for i in range(2)]
        faces += [face("a", _beyond(i), flip(i)) for i in range(2)]
    else:
        start = family.split()[-1]
        modes["above"] = lagjax.System(lambda q, v, params: 0.5 * v @ v - params["above"] * q[0])
        modes["below"] = lagjax.System(lambda q, v, params: 0.5 * v @ v + params["below"] * q[0])
        faces = [
            face("above", _coordinate(0), None, "below"), face("below", lambda q, v: -q[0], None, "above"),
            *[face(name, guard, flip(1)) for name in modes for guard in (_coordinate(1), _beyond(1))],
        ]  # fmt: skip

    def run(q, v, duration, params):
        ts = jnp.stack([jnp.zeros(()), duration])
        return lagjax.simulate(
            lagjax.Hybrid(modes, faces, start), q, v, ts, params, max_transitions=MOST + 4, throw=False
        )

    return jax.jit(jax.vmap(run))


def _coordinate(i: int) -> Callable:
    return lambda q, v: q[i]


def _beyond(i: int) -> Callable:
    return lambda q, v: 1 - q[i]


# ---- both ------------------------------------------------------------------------------------------------------------


def error_of(motion: Motion, q, v, count: int) -> float:
    """How far an end is from a right one; infinite where the number of transitions is another."""
    error = np.abs(q - motion.q).max() / (1 + np.abs(motion.q).max())
    if motion.nearest > digits_of.moment:
        error = max(error, np.abs(v - motion.v).max() / (1 + np.abs(motion.v).max()))
        error = error if count == motion.count else np.inf
    return float(error) if np.isfinite(error) else np.inf


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hybrid_population", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    add_option(parser)
    global digits_of
    options = parser.parse_args(arguments)
    precision = precision_of(options)
    digits_of = SINGLE if options.float32 else DOUBLE
    seeds = range(options.first, options.first + options.scenes)
    scenes = {seed: FAMILIES[seed % len(FAMILIES)](np.random.default_rng(seed)) for seed in seeds}
    counts, worst = collections.Counter(), 0.0
    for family in sorted({scene.family for scene in scenes.values()}):
        of_family = {seed: scene for seed, scene in scenes.items() if scene.family == family}
        numbers = [(s.q, s.v, s.duration, s.params) for s in of_family.values()]
        q, v, duration, params = jax.tree.map(lambda *xs: np.stack(xs).astype(precision), *numbers)
        done = runs(family, q.shape[1], len(params.get("hundredths", [()])[0]))(q, v, duration, params)
        ends = zip(*(np.asarray(x) for x in (done.ok, done.end.q, done.end.qdot, done.transitions.count)), strict=True)
        for (seed, scene), (ok, q_end, v_end, count) in zip(of_family.items(), ends, strict=True):
            error = min((error_of(motion, q_end, v_end, count) for motion in scene.right), default=np.inf)
            rests = not scene.right
            name = ("rests" if rests else "named") if not ok else "right" if error <= digits_of.tolerance else "wrong"
            worst = max(worst, error) if name == "right" else worst
            counts[name] += 1
            if name in ("wrong", "named"):
                is_right = scene.right[0] if scene.right else "it comes to rest"
                text = f"{scene.family} from {scene.q.tolist()}, {scene.v.tolist()} to {scene.duration}"
                print(f"{seed} {name}: {text}: {q_end}, {v_end}, {count} for {is_right}", flush=True)
    print(f"{dict(counts)}; the largest error of a right one {worst:.1e}", file=sys.stderr)
    return counts


if __name__ == "__main__":
    main()
