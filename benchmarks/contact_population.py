"""Random scenes with one to four gaps, friction and joints: is any motion wrong without a word?

    python -m benchmarks.contact_population --scenes 300
    python -m benchmarks.contact_population --scenes 300 --float32

Particles in rough boxes, discs with spin in corners, rods that fall on their ends, two blocks on a floor that push each
other, a cart and its pendulum between stops, double pendulums over a floor (in angles, or as points with two rods that
are constraints), shafts with freewheels, balls one over the other on a shaken table. Numbers have few digits, so that
corners are hit, and a third of the motions begin in contact, at rest or sliding.

The reference (`_contact_reference.py`) enumerates all modes and follows every event by DOP853. A scene that the law
does not settle there, or whose sequence of events changes with a millionth of its numbers, is drawn again. A motion is
*right* whose end is that of the reference, within 1e-9 times how much it grows, and whose derivative along a random
direction is that of differences; *named* where it ends in an error that says so, or its derivative is NaN. Others are
run again with rtol = 1e-13, against differences that are ten times as wide: *right at 1e-13* is what agrees then (a
motion that grazes a stop, whose error grows more than nearby motions show; rests beside each other, where the reference
is off by 1e-10 and its differences by 1e-4), all else is *wrong*.
`--lifted` asks 200 weights, in seven units of length, that rest at zero when a load that grows lifts them off: their
motion has a closed form.

With `--float32` start and parameters come in float32, without the x64 switch.
"""

import argparse
import collections
import functools
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _singles
from benchmarks._contact_reference import Ambiguous, Reference, Scene
from benchmarks._contacts import system_of

G, NEARBY, GROWTH = 9.81, 1e-6, 1e3  # gravity; half of a difference; how much a motion may grow
WIDER = 1e-5  # half of a difference of scenes that are run again
TOLERANCE, SINGLE_TOLERANCE, SLOPES = 1e-9, 1e-5, 1e-4
MOST_DRAWS = 40


class Family(NamedTuple):
    """Scenes that share their code; `draw(rng)` gives (q, v, p, free): `free` are the numbers of p that may move.

    `system` is what lagjax runs where that is not the same in the same coordinates; `there` and `back` translate.
    """

    scene: Scene
    draw: Callable
    system: Callable[[], lagjax.System] | None = None
    there: Callable = lambda q, v, p: (q, v)
    back: Callable = lambda q, v, p: (q, v)


class Member(NamedTuple):
    """One motion, with the direction of its derivative; the end, its slope, its growth and its events."""

    family: str
    q: Any
    v: Any
    p: Any
    duration: float
    direction: Any
    end: Any
    slope: Any
    growth: float
    events: int


def tenths(rng, low, high, count=None):
    """Numbers of one digit behind the point."""
    return rng.integers(round(10 * low), round(10 * high) + 1, count) / 10


def touches(rng) -> bool:
    """Whether a start is in contact."""
    return bool(rng.random() < 1 / 3)


def laws(rng, k: int, most: float = 0.6):
    """Restitutions and frictions of k contacts."""
    return rng.choice([0.0, 0.3, 0.5, 0.8, 1.0], k, p=[0.2, 0.2, 0.3, 0.2, 0.1]), np.minimum(
        tenths(rng, 0, 0.6, k), most
    )


# ---- the families ----------------------------------------------------------------------------------------------------


def box() -> Family:
    """A particle in a box, under a force that is not along its walls. p: fx, fy, width, height, e, mu."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * v @ v + p[:2] @ q,
        gaps=lambda q, t, p: jnp.stack([q[1], q[0], p[3] - q[1], p[2] - q[0]]),
        slip=lambda q, v, t, p: jnp.stack([v[0], v[1], v[0], v[1]]),
        restitution=lambda p: p[4:8], friction=lambda p: p[8:12],
    )  # fmt: skip

    def draw(rng):
        size = np.maximum(tenths(rng, 0.5, 2, 2), 0.5)
        q, v = rng.integers(1, 10, 2) / 10 * size, tenths(rng, -3, 3, 2)
        force = np.array([tenths(rng, -3, 3), -rng.choice([G, 5.0, 2.0])])
        if touches(rng):
            q[1], v[1] = 0.0, max(v[1], 0.0) * (rng.random() < 0.3)
            if rng.random() < 0.4:
                q[0], v[0] = 0.0, max(v[0], 0.0) * (rng.random() < 0.3)
        return q, v, np.concatenate([force, size, *laws(rng, 4)]), np.r_[0:2, 4:12]

    return Family(scene, draw)


def disc() -> Family:
    """A disc of radius 0.2 between a floor and two walls. p: g, side, width, spin inertia, e, mu."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + p[3] * v[2] ** 2) - p[0] * q[1] + p[1] * q[0],
        gaps=lambda q, t, p: jnp.stack([q[1] - 0.2, q[0] - 0.2, p[2] - 0.2 - q[0]]),
        slip=lambda q, v, t, p: jnp.stack([v[0] + 0.2 * v[2], v[1] - 0.2 * v[2], v[1] + 0.2 * v[2]]),
        restitution=lambda p: p[4:7], friction=lambda p: p[7:10],
    )  # fmt: skip

    def draw(rng):
        width = float(rng.choice([1.0, 1.5]))
        q, v = np.array([rng.uniform(0.3, width - 0.3), 0.2 + tenths(rng, 0.1, 1), 0.0]), tenths(rng, -3, 3, 3)
        v[2] *= 5
        if touches(rng):
            q[1], v[1] = 0.2, 0.0
            if rng.random() < 0.3:  # it rolls
                v[2] = -v[0] / 0.2
        inertia = float(rng.choice([0.02, 0.04]))
        return q, v, np.concatenate([[G, tenths(rng, -2, 2), width, inertia], *laws(rng, 3)]), np.r_[0, 1, 3:10]

    return Family(scene, draw)


def rod() -> Family:
    """A rod of length 1 that falls on its ends, beside a wall or not. p: g, where the wall is, e, mu."""

    def ends(q):
        return jnp.stack([q[:2], q[:2]]) + 0.5 * jnp.stack([jnp.ones(1), -jnp.ones(1)]) * jnp.stack(
            [jnp.cos(q[2]), jnp.sin(q[2])]
        )

    def speeds(q, v):
        across = 0.5 * v[2] * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return jnp.stack([v[:2] + across, v[:2] - across])

    scene = Scene(
        lambda q, v, t, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 12) - p[0] * q[1],
        gaps=lambda q, t, p: jnp.concatenate([ends(q)[:, 1], ends(q)[:, 0] - p[1]]),
        slip=lambda q, v, t, p: jnp.concatenate([speeds(q, v)[:, 0], speeds(q, v)[:, 1]]),
        restitution=lambda p: p[2:6], friction=lambda p: p[6:10],
    )  # fmt: skip

    def draw(rng):
        q = np.array([0.0, 0.5 + tenths(rng, 0.1, 0.8), rng.uniform(-1.5, 1.5)])
        v = np.array([*tenths(rng, -2, 2, 2), tenths(rng, -3, 3)])
        if touches(rng):
            q[1] = 0.5 * abs(np.sin(q[2]))
            v[:] = 0.0
        return q, v, np.concatenate([[G, -float(rng.choice([0.7, 5.0]))], *laws(rng, 4, 0.5)]), np.r_[0, 2:10]

    return Family(scene, draw)


def blocks() -> Family:
    """Two blocks of width 1 over a floor, beside a wall; they push each other. p: g, push, wall, masses, e, mu."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * (p[3] * (v[0] ** 2 + v[1] ** 2) + p[4] * (v[2] ** 2 + v[3] ** 2))
        - p[0] * (p[3] * q[1] + p[4] * q[3]),
        gaps=lambda q, t, p: jnp.stack([q[1], q[3], q[2] - q[0] - 1, p[2] - q[2]]),
        slip=lambda q, v, t, p: jnp.stack([v[0], v[2], v[3] - v[1], v[3]]),
        forces=lambda q, v, t, p: jnp.stack([p[1] * jnp.cos(2 * t), 0 * t, 0 * t, 0 * t]),
        restitution=lambda p: p[5:9], friction=lambda p: p[9:13],
    )  # fmt: skip

    def draw(rng):
        gap = tenths(rng, 0, 0.5)
        lift = tenths(rng, 0, 0.4, 2) * (rng.random() < 0.4)
        q = np.array([0.0, lift[0], 1.0 + gap, lift[1]])
        v = np.array([tenths(rng, -2, 3), 0.0, tenths(rng, -1, 1), 0.0])
        if gap == 0:
            v[2] = max(v[0], v[2])
        e, mu = laws(rng, 4)
        mu[2:] = 0.0 if rng.random() < 0.7 else mu[2:]
        p = np.concatenate([[G, tenths(rng, -8, 8), q[2] + tenths(rng, 0.1, 1), *tenths(rng, 0.5, 2, 2)], e, mu])
        return q, v, p, np.r_[0, 1, 3:13]

    return Family(scene, draw)


def cart() -> Family:
    """A cart between two buffers, with a pendulum between two stops. p: g, mass, reach, stop, e."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * p[1] * v[0] ** 2
        + 0.5 * (v[0] ** 2 + v[1] ** 2 + 2 * v[0] * v[1] * jnp.cos(q[1])) + p[0] * jnp.cos(q[1]),
        gaps=lambda q, t, p: jnp.stack([q[0] + p[2], p[2] - q[0], q[1] + p[3], p[3] - q[1]]),
        restitution=lambda p: p[4:8],
    )  # fmt: skip

    def draw(rng):
        reach, stop = tenths(rng, 0.3, 1), tenths(rng, 0.3, 1.2)
        q = np.array([reach * tenths(rng, -0.9, 0.9), stop * tenths(rng, -0.9, 0.9)])
        v = tenths(rng, -3, 3, 2)
        if touches(rng):
            q[1], v[1] = -stop, max(v[1], 0.0) * (rng.random() < 0.5)
        return q, v, np.concatenate([[G, tenths(rng, 0.5, 3), reach, stop], laws(rng, 4)[0]]), np.r_[0, 1, 4:8]

    return Family(scene, draw)


def _points(q):
    first = jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
    return first, first + jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])


def _velocities(q, v):
    return jax.jvp(_points, (q,), (v,))[1]


def arms(points: bool) -> Family:
    """A double pendulum of rods of length 1 over a floor and beside a wall. p: g, floor, wall, e, mu.

    With `points` lagjax has it as two points and two constraints.
    """

    def lagrangian(q, v, t, p):
        (_, y1), (_, y2) = _points(q)
        w1, w2 = _velocities(q, v)
        return 0.5 * (w1 @ w1 + w2 @ w2) - p[0] * (y1 + y2)

    scene = Scene(
        lagrangian, gaps=lambda q, t, p: jnp.stack([_points(q)[1][1] + p[1], _points(q)[1][0] + p[2]]),
        slip=lambda q, v, t, p: _velocities(q, v)[1], restitution=lambda p: p[3:5], friction=lambda p: p[5:7],
    )  # fmt: skip

    def draw(rng):
        q = np.array([rng.uniform(-1.2, 1.5), 0.0])
        q[1] = q[0] + rng.uniform(-0.8, 0.8)
        v, floor, wall = tenths(rng, -2, 2, 2), tenths(rng, 1.2, 1.8), tenths(rng, 0.2, 1.5)
        if touches(rng):
            floor, v = np.cos(q[0]) + np.cos(q[1]), np.zeros(2)
        if not (np.cos(q).sum() < floor + 1e-15 and np.sin(q).sum() > -wall):
            return draw(rng)
        e, mu = laws(rng, 2, 0.4)
        return q, v, np.concatenate([[G, floor, wall], e, mu]), np.r_[0, 3:7]

    def system():
        return lagjax.System(
            lambda q, qdot, params: 0.5 * jnp.sum(qdot**2) - params[0] * jnp.sum(q[:, 1]),
            constraints=lambda q: jnp.stack([q[0] @ q[0] - 1, (q[1] - q[0]) @ (q[1] - q[0]) - 1]) / 2,
            contacts=lambda q, params: jnp.stack([q[1, 1] + params[1], q[1, 0] + params[2]]),
            slip=lambda q, qdot: qdot[1], restitution=lambda params: params[3:5], friction=lambda params: params[5:7],
        )  # fmt: skip

    def there(q, v, p):
        return jnp.stack(_points(q)), jnp.stack(_velocities(q, v))

    def back(q, v, p):
        lengths, turns = jnp.stack([q[0], q[1] - q[0]]), jnp.stack([v[0], v[1] - v[0]])
        angles = jnp.arctan2(lengths[:, 0], -lengths[:, 1])
        return angles, lengths[:, 0] * turns[:, 1] - lengths[:, 1] * turns[:, 0]

    return Family(scene, draw, system, there, back) if points else Family(scene, draw)


def shafts() -> Family:
    """Three shafts under loads, each of which drives the next by a freewheel. p: amplitudes, rates, constants."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * v @ (jnp.array([1.0, 2.0, 0.5]) * v), one_way=lambda q, v, t, p: v[1:] - v[:-1],
        forces=lambda q, v, t, p: p[:3] * jnp.cos(p[3:6] * t) + p[6:9],
    )  # fmt: skip

    def draw(rng):
        v = np.sort(tenths(rng, 0, 1, 3)) * (rng.random() < 0.5)
        p = np.concatenate([tenths(rng, -3, 3, 3), tenths(rng, 0.5, 3, 3), tenths(rng, -1, 1, 3)])
        return np.zeros(3), v, p, np.arange(9)

    return Family(scene, draw)


def tables() -> Family:
    """Two balls, one over the other, on a shaken table. p: g, amplitude, rate, masses, e."""
    scene = Scene(
        lambda q, v, t, p: 0.5 * p[3:5] @ v**2 - p[0] * p[3:5] @ q,
        gaps=lambda q, t, p: jnp.stack([q[0] - p[1] * jnp.sin(p[2] * t), q[1] - q[0]]), restitution=lambda p: p[5:7],
    )  # fmt: skip

    def draw(rng):
        a, w = rng.choice([0.0, 0.05, 0.1, 0.2]), tenths(rng, 3, 12)
        q, v = np.cumsum(tenths(rng, 0.1, 0.5, 2)), np.zeros(2)
        if touches(rng):
            q, v = np.zeros(2), np.full(2, a * w)
        return q, v, np.concatenate([[G, a, w], tenths(rng, 0.5, 2, 2), laws(rng, 2)[0]]), np.r_[0, 3:7]

    return Family(scene, draw)


FAMILIES = {
    "box": box(), "disc": disc(), "rod": rod(), "blocks": blocks(), "cart": cart(), "arms": arms(False),
    "points": arms(True), "shafts": shafts(), "tables": tables(),
}  # fmt: skip


# ---- the reference ---------------------------------------------------------------------------------------------------


@functools.cache
def reference(name: str) -> Reference:
    """The reference of a family, compiled once."""
    q, _, p, _ = FAMILIES[name].draw(np.random.default_rng(0))
    return Reference(FAMILIES[name].scene, q, p)


def drawn(name: str, rng, dtype) -> Member:
    """A scene that the law settles, and whose events stay the same close by."""
    for _ in range(MOST_DRAWS):
        q, v, p, free = FAMILIES[name].draw(rng)
        q, v, p = (_singles.rounded(part, dtype) for part in (q, v, p))
        n, duration = len(q), float(rng.choice([0.5, 1.0, 1.5]) * (5 if name == "shafts" else 1))
        # A start in contact stays there: it moves along with its parameters alone. Others move with their start too.
        touching = (np.abs(np.asarray(FAMILIES[name].scene.gaps(q, 0.0, p))) < 1e-6).any()
        direction = np.zeros(2 * n + len(p))
        direction[2 * n + free] = rng.uniform(-1, 1, len(free))
        if not touching and FAMILIES[name].scene.gaps(q, 0.0, p).size:
            direction[: 2 * n] = rng.uniform(-1, 1, 2 * n)
        x = np.concatenate([q, v, p])
        # Restitutions end at 0 and 1, frictions at 0: numbers that are at an end stay there.
        direction[2 * n :] *= ~((p == 0) | (p == 1))
        member = _followed(name, x, n, duration, direction)
        if member is not None:
            return member
    raise RuntimeError(f"no scene of {name!r} that the law settles in {MOST_DRAWS} draws")


def _followed(name, x, n, duration, direction, nearby: float = NEARBY) -> Member | None:
    run = reference(name)
    try:
        middle, above, below = (
            run.run(y[:n], y[n : 2 * n], duration, y[2 * n :])
            for y in (x, x + nearby * direction, x - nearby * direction)
        )
    except Ambiguous:
        return None
    slope = (above.z - below.z) / (2 * nearby)
    sides = [np.abs(m.z - middle.z).max() / nearby for m in (above, below)]
    growth = max(sides)
    order = [[event.contact for event in m.events] for m in (middle, above, below)]
    steady = order[0] == order[1] == order[2] or bool(middle.rests)
    if growth > GROWTH or not steady or np.abs(above.z + below.z - 2 * middle.z).max() / nearby > 1e-3 * (1 + growth):
        return None
    return Member(name, x[:n], x[n : 2 * n], x[2 * n :], duration, direction, middle.z, slope, growth, len(order[0]))


# ---- the same with lagjax --------------------------------------------------------------------------------------------


@functools.cache
def runs(name: str, n: int, rtol: float | None = None) -> Callable:
    """`(x, direction, T)`: end, slope, whether it came there, and how many impacts; members are the first axis."""
    family = FAMILIES[name]
    system = family.system() if family.system else system_of(family.scene)

    def end(x, duration):
        q, v = family.there(x[:n], x[n : 2 * n], x[2 * n :])
        ts = jnp.stack([jnp.zeros_like(duration), duration])
        done = lagjax.simulate(system, q, v, ts, x[2 * n :], rtol=rtol, throw=False)
        return jnp.concatenate(family.back(done.q[-1], done.qdot[-1], x[2 * n :])), (done.ok, done.impacts.count)

    def run(x, direction, duration):
        z, slope, (ok, count) = jax.jvp(lambda x: end(x, duration), (x,), (direction,), has_aux=True)
        return z, slope, ok, count

    return jax.jit(jax.vmap(run))


def judged(member: Member, z, slope, ok, tolerance) -> tuple[str, float, float]:
    """The name of a motion, the error of its end and of its slope."""
    if not ok:
        return "named", np.nan, np.nan
    error = np.abs(z - member.end).max() / (1 + np.abs(member.end).max()) / (1 + member.growth)
    off = np.abs(slope - member.slope).max() / (1 + np.abs(member.slope).max())
    if not error <= tolerance:
        return "wrong", error, off
    if np.isnan(slope).any():
        return "named derivative", error, np.nan
    return ("right" if off <= SLOPES * max(1.0, tolerance / TOLERANCE / 100) else "wrong derivative"), error, off


def compared(members: dict[int, Member], dtype, tolerance, rtol=None) -> Iterator[tuple[int, tuple, tuple]]:
    """Seeds of members of one family, how they were judged, and their end with the number of impacts."""
    first = next(iter(members.values()))
    x = np.stack([np.concatenate([m.q, m.v, m.p]) for m in members.values()]).astype(dtype)
    along, T = np.stack([m.direction for m in members.values()]), np.array([m.duration for m in members.values()])
    done = runs(first.family, len(first.q), rtol)(x, along.astype(dtype), T.astype(dtype))
    for (seed, member), (z, slope, ok, count) in zip(
        members.items(), zip(*map(np.asarray, done), strict=True), strict=True
    ):
        yield seed, judged(member, z, slope, ok, tolerance), (z, count)


def is_right_closer(member: Member) -> bool:
    """Whether lagjax with rtol = 1e-13 agrees with the end, and with the slope of wider differences."""
    x = np.concatenate([member.q, member.v, member.p])
    wider = _followed(member.family, x, len(member.q), member.duration, member.direction, WIDER)
    if wider is None:
        return False
    [(_, (verdict, *_), _)] = compared({0: wider}, np.dtype(float), TOLERANCE, rtol=1e-13)
    return verdict == "right"


def described(member: Member, z, count) -> str:
    """A scene in numbers, its end and that of the reference."""
    return (
        f"{member.family}, q = {member.q}, v = {member.v}, p = {member.p}, T = {member.duration}: "
        f"{z} for {member.end}, {count} impacts, {member.events} events"
    )


def follow_lifted(dtype, rtol: float | None) -> collections.Counter:
    """How many weights on a spring are right, to a millionth, that rest at zero until a load lifts them."""
    weight, unit = (x.ravel() for x in np.meshgrid(np.arange(1, 201) / 50, 10.0 ** np.arange(-9, 10, 3)))
    ts, rate, spring, mass = np.linspace(0.0, 16.0, 9), 3.0, 0.7, 0.3

    def lagrangian(q, v, params):
        length, force = params["unit"], params["weight"]
        return 0.5 * mass * v**2 - force * length * q - 0.5 * spring * (q + 0.1 * length) ** 2

    def load(q, v, t, params):
        return rate * params["unit"] * t

    system = lagjax.System(lagrangian, forces=load, contacts=lambda q: q)
    numbers = {"weight": jnp.asarray(weight, dtype), "unit": jnp.asarray(unit, dtype)}
    rest = jnp.zeros(weight.size, dtype)
    run = lagjax.simulate_batch(system, rest, rest, jnp.asarray(ts, dtype), numbers, batch_axes=(0, 0, 0), rtol=rtol)
    weight, unit = (np.asarray(numbers[name], float)[:, None] for name in ("weight", "unit"))
    aloft, omega = np.maximum(ts - (weight + 0.1 * spring) / rate, 0.0), np.sqrt(spring / mass)
    exact = unit * rate / spring * (aloft - np.sin(omega * aloft) / omega)
    off = np.abs(np.asarray(run.q, float) - exact).max(axis=1) / exact[:, -1]
    verdicts = np.where(np.asarray(run.ok), np.where(off <= 1e-6, "right", "wrong"), "named")
    print(f"rtol {rtol}: {collections.Counter(verdicts.tolist())}, at most {np.nanmax(off):.1e} off", file=sys.stderr)
    return collections.Counter(verdicts.tolist())


def main(arguments: list[str] | None = None) -> collections.Counter:
    """Compare so many scenes, print those that are not right, and count them."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.contact_population", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="the seed of the first one")
    parser.add_argument("--families", nargs="+", choices=tuple(FAMILIES), default=tuple(FAMILIES))
    parser.add_argument("--dry", action="store_true", help="the references alone")
    parser.add_argument("--lifted", action="store_true", help="weights that are lifted off from rest at zero")
    _singles.add_option(parser)
    options = parser.parse_args(arguments)
    if options.lifted:
        dtype = _singles.precision_of(options)
        return sum((follow_lifted(dtype, rtol) for rtol in (None, 1e-9, 1e-12)), collections.Counter())
    dtype, tolerance = np.dtype(np.float32 if options.float32 else np.float64), TOLERANCE
    jax.config.update("jax_enable_x64", True)  # of the references
    seeds = range(options.first, options.first + options.scenes)
    names = {seed: options.families[seed % len(options.families)] for seed in seeds}
    members = {seed: drawn(names[seed], np.random.default_rng(seed), dtype) for seed in seeds}
    _singles.precision_of(options)
    tolerance = SINGLE_TOLERANCE if options.float32 else TOLERANCE
    counts, worst = collections.Counter(), np.zeros(2)
    for name in sorted(set(names.values())):
        some = {seed: m for seed, m in members.items() if m.family == name}
        print(f"{name}: {len(some)} scenes, {sum(m.events for m in some.values())} events", file=sys.stderr, flush=True)
        if options.dry:
            continue
        for seed, judgement, found in compared(some, dtype, tolerance):
            verdict, error, off = judgement
            if verdict.startswith("wrong") and not options.float32 and is_right_closer(some[seed]):
                verdict = "right at 1e-13"
            counts[verdict] += 1
            worst = np.maximum(worst, [error, off] if verdict == "right" else 0.0)
            if verdict != "right":
                print(f"{seed} {verdict}: {described(some[seed], *found)} ({error:.1e}), slopes {off:.1e}", flush=True)
    print(
        f"{dict(counts)}; the largest errors of a right one {worst[0]:.1e}, of its slope {worst[1]:.1e}",
        file=sys.stderr,
    )
    return counts


if __name__ == "__main__":
    main()
