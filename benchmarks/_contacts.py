"""Scenes with contacts whose motion is known in closed form: what `contacts.py` and `tests/contacts` compare with.

A scene is written once, for vectors, as `_contact_reference.Scene`; `system_of` hands its functions to lagjax. The
numbers of a motion are x = (q0, v0, params).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import lagjax
from benchmarks._contact_reference import Scene, no_numbers

G = 9.81


def system_of(scene: Scene, rough: bool | None = None) -> lagjax.System:
    """The scene in lagjax; its functions of vectors ask for time and parameters."""
    options: dict[str, Any] = {}
    if scene.gaps is not no_numbers:
        options |= {
            "contacts": lambda q, t, params: scene.gaps(q, t, params), "impacts": scene.impacts,
            "restitution": lambda params: scene.restitution(params),
        }  # fmt: skip
    if scene.one_way is not no_numbers:
        options["one_way"] = lambda q, qdot, t, params: scene.one_way(q, qdot, t, params)
    slip = scene.slip
    if slip is not None and rough is not False:
        options |= {
            "slip": lambda q, qdot, t, params: slip(q, qdot, t, params),
            "friction": lambda params: scene.friction(params),
        }  # fmt: skip
    return lagjax.System(
        lambda q, qdot, t, params: scene.lagrangian(q, qdot, t, params),
        forces=lambda q, qdot, t, params: scene.forces(q, qdot, t, params),
        **options,
    )


def end_of(system: lagjax.System, n: int, duration: float, **options) -> Callable:
    """x -> (q, v) at the end, of a system of n coordinates; by default to the last digits, rtol = 1e-13."""
    options = {"rtol": 1e-13} | options

    def end(x):
        ts = jnp.array([0.0, duration], x.dtype)
        run = lagjax.simulate(system, x[:n], x[n : 2 * n], ts, x[2 * n :], **options)
        return jnp.concatenate([run.q[-1], run.qdot[-1]])

    return end


@dataclass(frozen=True)
class Row:
    """A motion and what is known of it: `measure((q, v) at the end)` is `exact(x)`, with derivatives by `columns`."""

    name: str
    scene: Scene
    q: Any
    v: Any
    params: Any
    duration: float
    exact: Callable
    columns: tuple[int, ...]
    measure: Callable = lambda z: z
    value: float = 1e-12  # largest errors of values, of slopes and, in parts of the largest, of second derivatives
    slopes: float | None = 1e-12  # None: they do not exist
    second: float | None = 1e-10  # None: it does not exist, or takes long
    only_forward: bool = False  # in reverse mode, which knows no direction, they are NaN

    @property
    def n(self) -> int:
        return len(self.q)

    @property
    def x(self) -> np.ndarray:
        return np.concatenate([np.asarray(part, float) for part in (self.q, self.v, self.params)])


FALL = Scene(
    lambda q, v, t, p: 0.5 * v[0] ** 2 - p[0] * q[0], gaps=lambda q, t, p: q[:1], restitution=lambda p: p[1]
)  # fmt: skip
SLIDE = Scene(
    lambda q, v, t, p: 0.5 * v @ v - p[0] * q[-1], gaps=lambda q, t, p: q[-1:], friction=lambda p: p[1],
    slip=lambda q, v, t, p: v[:1],
)  # fmt: skip


# ---- blows -----------------------------------------------------------------------------------------------------------

BALLS = Scene(
    lambda q, v, t, p: 0.5 * p[:2] @ v**2, gaps=lambda q, t, p: q[1:] - q[:1] - 0.2, restitution=lambda p: p[2]
)  # fmt: skip


def two_balls(m2: float, e: float) -> Row:
    """Two balls of radius 0.1 on a line."""

    def exact(x):
        q, v, m, e = x[:2], x[2:4], x[4:6], x[6]
        t = (q[1] - q[0] - 0.2) / (v[0] - v[1])
        u = (m @ v + e * (v[0] - v[1]) * m[::-1] * jnp.array([-1, 1])) / m.sum()
        return jnp.concatenate([q + v * t + u * (1 - t), u])

    columns = tuple(range(7 if e else 6))  # e = 0 is the end of its interval
    return Row(f"two balls, m = 1, {m2}, e = {e}", BALLS, [0, 0.6], [1, 0], [1, m2, e], 1.0, exact, columns)


BRAX_SPEED, BRAX_RADIUS = 5.0, 0.1
BRAX = Scene(
    lambda q, v, t, p: 0.5 * v @ v, gaps=lambda q, t, p: q - BRAX_RADIUS, restitution=lambda p: 1.0
)  # fmt: skip


def brax_drop(h: float = 2.95) -> Row:
    """An elastic ball that comes down at 5 without gravity: a higher start is a lower end (brax 317)."""

    def exact(x):
        return jnp.stack([2 * BRAX_RADIUS - x[0] - x[1], -x[1]])

    return Row("brax 317: a drop without gravity", BRAX, [h], [-BRAX_SPEED], [], 1.0, exact, (0, 1))


def bounces(count: int, e: float = 0.7) -> Row:
    """A ball after so many bounces, at the top of the next one."""
    u0 = np.sqrt(2 * G)
    duration = u0 / G + sum(2 * e**k * u0 / G for k in range(1, count)) + e**count * u0 / G

    def exact(x):
        y, v, g, e = x
        u = jnp.sqrt(v * v + 2 * g * y)
        left = duration - (v + u) / g - 2 * u / g * sum(e**k for k in range(1, count))
        w = e**count * u
        return jnp.stack([w * left - 0.5 * g * left**2, w - g * left])

    return Row(f"a ball after {count} bounces, e = {e}", FALL, [1], [0], [G, e], duration, exact, (0, 1, 2, 3))


def rest(e: float, duration: float = 50.0) -> Row:
    """A ball that bounces to rest: nothing of its start is left."""
    return Row(
        f"bouncing ball at rest, e = {e}",
        FALL,
        [1],
        [0],
        [G, e],
        duration,
        lambda x: jnp.zeros(2) * x[:2],
        (0, 1, 2, 3),
    )


def rest_time(x):
    """When a ball with x = (y, v, g, e) comes to rest."""
    y, v, g, e = x
    u = jnp.sqrt(v * v + 2 * g * y)
    return (v + u + 2 * e * u / (1 - e)) / g


# A cart that is pushed by the height of the ball above the floor keeps account of the time.
CLOCK = Scene(
    lambda q, v, t, p: 0.5 * v @ v - p[0] * q[0], gaps=lambda q, t, p: q[:1], restitution=lambda p: p[1],
    forces=lambda q, v, t, p: jnp.stack([0.0 * q[0], q[0]]),
)  # fmt: skip


def clock(e: float, duration: float) -> Row:
    """A cart pushed by y(t) of a bouncing ball: its velocity is the area below all bounces, its place knows when."""

    def exact(x):
        y, cart, v, w, g, e = x
        u = jnp.sqrt(v * v + 2 * g * y)
        fall = (v + u) / g  # until the first blow
        area = y * fall + v * fall**2 / 2 - g * fall**3 / 6
        moment = y * fall**2 / 2 + v * fall**3 / 3 - g * fall**4 / 8  # the integral of t y(t)
        r = e**3  # a bounce with u has the area 2 u^3 / (3 g^2), its middle u / g after its start
        first = e * u
        areas = 2 * first**3 / (3 * g**2) / (1 - r)
        # start of the k-th: fall + 2 first (1 - e^k) / (g (1 - e)), its middle first e^k / g later
        a, b = fall + 2 * first / (g * (1 - e)), first / g - 2 * first / (g * (1 - e))
        moments = 2 * first**3 / (3 * g**2) * (a / (1 - r) + b / (1 - r * e))
        speed = w + area + areas
        place = cart + w * duration + duration * (area + areas) - moment - moments
        return jnp.stack([0 * y, place, 0 * y, speed])

    return Row(
        f"area and moment below all bounces, e = {e}", CLOCK, [1, 0], [0, 0.1], [G, e], duration, exact,
        (0, 1, 2, 3, 4, 5), value=1e-11, slopes=1e-11, second=1e-10,
    )  # fmt: skip


ROD = Scene(
    lambda q, v, t, p: (v[0] ** 2 + v[1] ** 2 / 12) / 2 - p[0] * q[0],
    gaps=lambda q, t, p: q[0] + jnp.array([-0.5, 0.5]) * jnp.sin(q[1]), restitution=lambda p: p[1],
)  # fmt: skip


def flat_rod() -> Row:
    """A rod that falls flat on its two ends: the derivatives are those along which it stays flat."""

    def exact(x):
        y, _, v, _, g, e = x
        u = jnp.sqrt(v * v + 2 * g * y)
        r = 0.6 - (v + u) / g
        return jnp.stack([e * u * r - g * r * r / 2, 0 * y, e * u - g * r, 0 * y])

    return Row(
        "rod falls flat on two feet, e = 0.5",
        ROD,
        [1, 0],
        [0, 0],
        [G, 0.5],
        0.6,
        exact,
        (0, 2, 4, 5),
        only_forward=True,
    )


CORNER = Scene(lambda q, v, t, p: 0.5 * v @ v, gaps=lambda q, t, p: q, restitution=lambda p: p)


def corner() -> Row:
    """A particle that meets three walls at one instant, which know nothing of each other."""

    def exact(x):
        q, v, e = x[:3], x[3:6], x[6:]
        return jnp.concatenate([-e * v * (1 + q / v), -e * v])

    return Row(
        "three walls at one instant", CORNER, [0.3, 0.3, 0.3], [-0.5, -0.5, -0.5], [1.0, 0.8, 0.5], 1.0, exact,
        tuple(range(9)), second=None,
    )  # fmt: skip


CRADLE = Scene(
    lambda q, v, t, p: 0.5 * (v @ v - p[0] * q @ q), gaps=lambda q, t, p: q[1:] - q[:-1], restitution=lambda p: 1.0
)  # fmt: skip


def cradle(impacts: str) -> Row:
    """Five touching balls, hit by the first; what a blow does is linear in its velocity."""
    after = [0, 0, 0, 0, 1] if impacts == "sequential" else [-0.6, 0.4, 0.4, 0.4, 0.4]

    def exact(x):
        return x[5] * jnp.array(after)

    return Row(
        f"cradle of 5 touching balls, {impacts}", CRADLE._replace(impacts=impacts), [-0.3, 0, 0, 0, 0],
        [1, 0, 0, 0, 0], [0.0], 1.0, exact, (5,), measure=lambda z: z[5:],
    )  # fmt: skip


def swinging(swings: float) -> Row:
    """The cradle on strings: the first and the last ball in turn, for so many whole swings and an eighth of one."""
    w = np.pi
    duration = 2.0 * swings + 0.25

    def exact(x):
        return -0.3 * np.cos(w / 4) * jnp.eye(10)[0] + 0.3 * w * np.sin(w / 4) * jnp.eye(10)[5] + 0.0 * x[:10]

    return Row(
        f"the same, swinging {swings:g} times", CRADLE._replace(impacts="sequential"), [-0.3, 0, 0, 0, 0], [0] * 5,
        [w * w], duration, exact, (), value=1e-11,
    )  # fmt: skip


SPIN = Scene(
    lambda q, v, t, p: (v[0] ** 2 + v[1] ** 2 + 0.4 * v[2] ** 2) / 2 - p[0] * q[1], gaps=lambda q, t, p: q[1:2],
    restitution=lambda p: p[1], friction=lambda p: p[2], slip=lambda q, v, t, p: v[:1] + v[2:],
)  # fmt: skip


def spinning_ball(mu: float) -> Row:
    """A ball with spin that bounces once on a rough floor, sliding through the blow or not."""

    def exact(x):
        (vx, w), (g, e, mu) = x[3:6:2], x[6:]
        u = jnp.sqrt(2 * g * x[1])
        J, r = jnp.clip(-(vx + w) / 3.5, -mu * (1 + e) * u, mu * (1 + e) * u), 0.6 - u / g
        return jnp.stack([
            x[0] + vx * 0.6 + J * r, e * u * r - g * r * r / 2, x[2] + w * 0.6 + 2.5 * J * r,
            vx + J, e * u - g * r, w + 2.5 * J,
        ])  # fmt: skip

    return Row(
        f"spinning ball on a rough floor, mu = {mu}", SPIN, [0, 1, 0], [3, 0, 2], [G, 0.7, mu], 0.6, exact,
        (0, 1, 2, 3, 5, 6, 7, 8),
    )  # fmt: skip


DISC = Scene(lambda q, v, t, p: 0.5 * v @ v, gaps=lambda q, t, p: 1 - (q @ q)[None], restitution=lambda p: 1.0)


def billiard(duration: float = 93.0) -> Row:
    """A particle in a circle."""

    def flight(q, v):
        b = q @ v / (v @ v)
        return -b + jnp.sqrt(b * b - (q @ q - 1) / (v @ v))

    def bounce(state):
        q, v, left = state
        t = flight(q, v)
        q = q + v * t
        return q, v - 2 * (q @ v) * q / (q @ q), left - t

    def exact(x):
        start = x[:2], x[2:], jnp.asarray(duration)
        q, v, left = jax.lax.while_loop(lambda state: flight(*state[:2]) <= state[2], bounce, start)
        return jnp.append(q + v * left, v)

    return Row(
        f"circular billiard, {duration:g} long", DISC, [0.3, -0.2], [0.8, 0.6], [], duration, exact, (0, 1, 2, 3),
        value=1e-9, slopes=1e-9, second=None,
    )  # fmt: skip


# ---- lasting contacts ------------------------------------------------------------------------------------------------

FASTER = FALL._replace(gaps=lambda q, t, p: q + p[1] * t**3 / 6, restitution=lambda p: 0.0)


def falling_table() -> Row:
    """A ball on a table that falls ever faster, 8 t: they part where that is g."""

    def exact(x):
        t = x[2] / x[3]
        place = -x[3] * t**3 / 6 - x[3] * t * t / 2 * (2 - t) - x[2] * (2 - t) ** 2 / 2
        return jnp.stack([place, -x[3] * t * t / 2 - x[2] * (2 - t)])

    return Row("ball on a table that falls ever faster", FASTER, [0], [0], [G, 8], 2.0, exact, (2, 3))


SHAKEN = FALL._replace(gaps=lambda q, t, p: q - p[2] * jnp.sin(p[3] * t))
SHAKEN_REST = 0.92368024058936  # in extended precision, from y = 0.3 with g = 9.81, e = 0.6, a = 0.05, w = 10
TABLE = FALL._replace(gaps=lambda q, t, p: q - p[1] * jnp.sin(p[2] * t), restitution=lambda p: 0.0)


LADDER = Scene(
    lambda q, v, t, p: (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 12) / 2 - p[0] * q[1],
    gaps=lambda q, t, p: q[1::-1] - jnp.stack([jnp.sin(q[2]), jnp.cos(q[2])]) / 2,
)  # fmt: skip


def ladder(angle: float = 1.2) -> Row:
    """A ladder slides down: from where it leaves the wall, at 2/3 of its height, its middle keeps its velocity."""
    s, c = np.sin(angle), np.cos(angle)

    def exact(x):
        return jnp.sqrt(x[6] * s**3)[None] / 3

    return Row(
        "ladder leaves the wall: velocity", LADDER, [c / 2, s / 2, angle], [0, 0, 0], [G], 0.9, exact, (6,),
        measure=lambda z: z[3:4], slopes=1e-12,
    )  # fmt: skip


HEMISPHERE = Scene(
    lambda q, v, t, p: 0.5 * v @ v - p[0] * q[1], gaps=lambda q, t, p: jnp.sqrt(q @ q)[None] - 1
)  # fmt: skip


def hemisphere(angle: float = 0.1) -> Row:
    """A particle slides off a hemisphere: from cos = 2/3 cos of its start on, its horizontal velocity stays."""

    def exact(x):
        return jnp.sqrt(x[4] * (2 / 3 * np.cos(angle)) ** 3)[None]

    return Row(
        "ball leaves a hemisphere: velocity", HEMISPHERE, [np.sin(angle), np.cos(angle)], [0, 0], [G], 1.5, exact, (4,),
        measure=lambda z: z[2:3],
    )  # fmt: skip


# The chapter's last example: q = (x, y, turn) of a cylinder's axis, on a half-cylinder of radius 1. With friction it
# sticks, then slides for a moment, then flies.
RADIUS = 0.25
CYLINDER = Scene(
    lambda q, v, t, p: 0.5 * (v[:2] @ v[:2] + p[1] * RADIUS**2 * v[2] ** 2) - p[0] * q[1],
    gaps=lambda q, t, p: jnp.sqrt(q[:2] @ q[:2])[None] - 1 - RADIUS, friction=lambda p: p[2],
    slip=lambda q, v, t, p: ((v[0] * q[1] - v[1] * q[0]) / jnp.sqrt(q[:2] @ q[:2]) - RADIUS * v[2])[None],
)  # fmt: skip


def smooth_cylinder(angle: float = 0.15) -> Row:
    """The cylinder without friction."""

    def exact(x):
        return jnp.sqrt((1 + RADIUS) * x[6] * (2 / 3 * np.cos(angle)) ** 3)[None]

    start = (1 + RADIUS) * np.array([np.sin(angle), np.cos(angle)])
    return Row(
        "smooth cylinder flies off a half-cylinder", CYLINDER, [*start, 0], [0, 0, 0], [G, 0.5, 0.0], 1.5, exact, (6,),
        measure=lambda z: z[3:4],
    )  # fmt: skip


# ---- velocities that stay positive ----------------------------------------------------------------------------------

CLUTCH = Scene(
    lambda q, v, t, p: 0.5 * v[0] ** 2 + v[1] ** 2, one_way=lambda q, v, t, p: v[1:] - v[:1],
    forces=lambda q, v, t, p: jnp.stack([p[0] * jnp.cos(t), 0 * t]),
)  # fmt: skip


def clutch() -> Row:
    """A drive of inertia 1 under A cos t, which a freewheel lets drive a load of inertia 2, and not hold it back."""

    def exact(x):
        A, d = x[4], 4 - jnp.pi / 2
        return A * jnp.stack([1 / 3 - 2 * d / 3 - jnp.cos(4.0), (1 + d) / 3, jnp.sin(4.0) - 2 / 3, 1 / 3 + 0 * A])

    return Row("one-way clutch that releases at zero force", CLUTCH, [0, 0], [0, 0], [0.3], 4.0, exact, (4,))


def _load(p, t, xp=jnp):
    return p[0] * xp.cos(p[1] * t) + p[2] * xp.sin(p[3] * t) + p[4]


FREEWHEEL = CLUTCH._replace(forces=lambda q, v, t, p: jnp.stack([_load(p, t), 0 * t]))


# ---- friction --------------------------------------------------------------------------------------------------------

INCLINE = SLIDE._replace(
    lagrangian=lambda q, v, t, p: 0.5 * v @ v - p[0] * (jnp.sin(p[2]) * q[0] + jnp.cos(p[2]) * q[1])
)


def incline() -> Row:
    """A block slides up an incline, stops, and stays for a million."""

    def exact(x):
        y = x[0] + x[2] ** 2 / (2 * x[4] * (jnp.sin(x[6]) + x[5] * jnp.cos(x[6])))
        return jnp.stack([y, 0 * y, 0 * y, 0 * y])

    return Row(
        "block slides up an incline, rests to 1e6", INCLINE, [0, 0], [3, 0], [G, 0.5, 0.3], 1e6, exact, (0, 2, 4, 5, 6)
    )


PUCK = SLIDE._replace(
    slip=lambda q, v, t, p: v[None, :2], forces=lambda q, v, t, p: p[2] * t * jnp.array([0.6, 0.8, 0])
)


def puck() -> Row:
    """A puck in space slides over a floor, stops, and stays for a million."""

    def exact(x):
        stop = x[:2] + x[3:5] * jnp.sqrt(x[3:5] @ x[3:5]) / (2 * x[6] * x[7])
        return jnp.append(stop, jnp.zeros(4))

    return Row(
        "puck in space stops, rests to 1e6", PUCK, [0, 0, 0], [2, 1, 0], [G, 0.3, 0], 1e6, exact, (0, 1, 3, 4, 6, 7),
        slopes=1e-9, second=None,
    )  # fmt: skip


def break_away() -> Row:
    """A puck under a growing force, from the instant on at which friction has nothing left."""

    def exact(x):
        r = 2 - x[6] * x[7] / x[8]
        return x[8] * jnp.outer(jnp.stack([r**3 / 6, r * r / 2]), jnp.array([0.6, 0.8, 0])).ravel()

    start = [0] * 3, [0] * 3, [G, 0.3, 3]
    none = {"slopes": None, "second": None}  # of a slip in space that begins from rest
    return Row("puck under a growing force breaks away", PUCK, *start, 2.0, exact, (6, 7, 8), **none)


SHAKEN_BLOCK = SLIDE._replace(forces=lambda q, v, t, p: jnp.stack([p[2] * jnp.sin(p[3] * t), 0 * t]))


# A rod that slides on its tip, at 45 degrees: Painleve's paradox for mu > 4/3.
TIP = Scene(
    lambda q, v, t, p: (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 12) / 2 - p[0] * q[1],
    gaps=lambda q, t, p: q[1:2] - jnp.sin(q[2:]) / 2, friction=lambda p: p[1],
    slip=lambda q, v, t, p: v[:1] + jnp.sin(q[2:]) / 2 * v[2:],
)  # fmt: skip


def tip(mu: float, turning: float) -> tuple[list, list, list]:
    """A start on the tip, moving to the left at 9."""
    a = np.pi / 4
    return [0, np.sin(a) / 2, a], [-9, np.cos(a) / 2 * turning, turning], [G, mu]


ROWS = {
    row.name: row
    for row in (
        two_balls(1, 1), two_balls(3, 1), two_balls(3, 0.5), two_balls(3, 0), brax_drop(), bounces(1), bounces(4),
        rest(0.5), rest(0.8), rest(0.95), clock(0.5, 3.0), clock(0.8, 6.0), flat_rod(), corner(), cradle("sequential"),
        cradle("simultaneous"), swinging(10), spinning_ball(0.1), spinning_ball(0.5), billiard(), falling_table(),
        ladder(), hemisphere(), smooth_cylinder(), clutch(), incline(), puck(), break_away(),
    )
}  # fmt: skip


# ---- many motions of one scene, against piecewise closed forms ------------------------------------------------------


@dataclass(frozen=True)
class Many:
    """Random motions of a scene; `reference(params, T)` is the velocity at the end."""

    name: str
    scene: Scene
    draw: Callable
    reference: Callable
    duration: float
    count: int
    value: float = 1e-12

    def drawn(self, count: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Starts, velocities and parameters, with an axis of members, and the velocities at the end."""
        rng = np.random.default_rng(1)
        q, v, p = map(np.array, zip(*(self.draw(rng) for _ in range(count or self.count)), strict=True))
        return q, v, p, np.array([self.reference(x, self.duration) for x in p])


def _first(f, t, T) -> float | None:
    """Where f falls through zero on [t, T], or None."""
    grid = np.linspace(t, T, 20001)
    i = np.flatnonzero((f(grid[:-1]) > 0) & (f(grid[1:]) <= 0))
    return float(brentq(f, grid[i[0]], grid[i[0] + 1], xtol=1e-15)) if len(i) else None  # pyright: ignore


def _on_table(p, T):
    """A ball on a shaken table, without bounce: it stays while the table falls less than g, and flies else."""
    g, a, w = p
    t, presses = 0.0, lambda t: g - a * w * w * np.sin(w * t)
    while True:
        t = t if presses(t + 1e-12) < 0 else _first(presses, t, T)
        if t is None:
            return np.array([a * w * np.cos(w * T)])
        y, v = a * np.sin(w * t), a * w * np.cos(w * t)
        land = _first(lambda r, y=y, v=v, t=t: y + v * (r - t) - g * (r - t) ** 2 / 2 - a * np.sin(w * r), t + 1e-4, T)
        if land is None:
            return np.array([v - g * (T - t)])
        t = land


def _draw_table(rng):
    w = rng.uniform(5, 30)
    a = rng.uniform(0.5, 4) * G / w**2
    return np.zeros(1), np.array([a * w]), np.array([G, a, w])


def _of_freewheel(p, T):
    """A drive of inertia 1 and a load of inertia 2: one body while the load is positive, else two."""

    def whole(t):
        return p[0] * np.sin(p[1] * t) / p[1] - p[2] * np.cos(p[3] * t) / p[3] + p[4] * t

    t, v, locked = 0.0, np.zeros(2), _load(p, 0.0, np) > 0
    while True:

        def apart(r, v=v, t=t):
            return v[1] - v[0] - whole(r) + whole(t)

        end = _first((lambda r: _load(p, r, np)) if locked else apart, t + 1e-9, T)
        gain = whole(end or T) - whole(t)
        v = v + (gain / 3 if locked else np.array([gain, 0]))
        if end is None:
            return v
        t, locked = end, not locked


def _of_shaken_block(p, T):
    """A block under A sin(w t) on a rough floor: it sticks, slips, and turns round."""
    g, mu, A, w = p
    F, P, t, v, side = lambda t: A * np.sin(w * t), lambda t: -A * np.cos(w * t) / w, 0.0, 0.0, 0.0
    while True:

        def later(r, v=v, t=t, side=side):
            return v + P(r) - P(t) - side * mu * g * (r - t)

        def slides(r, side=side, later=later):
            return side * later(r)

        end = _first(slides if side else (lambda r: mu * g - abs(F(r))), t + 1e-6, T)
        if end is None:
            return np.array([later(T) if side else 0.0, 0.0])
        side, v, t = np.sign(F(end)) * (abs(F(end)) >= mu * g * (1 - 1e-9)), 0.0, end


MANY = {
    many.name: many
    for many in (
        Many("shaken tables without bounce", TABLE, _draw_table, _on_table, 3.0, 300),
        Many(
            "freewheels under random loads", FREEWHEEL,
            lambda rng: (np.zeros(2), np.zeros(2), rng.uniform([0.2, 0.5, 0.2, 0.5, -0.3], [1, 3, 1, 3, 0.3])),
            _of_freewheel, 20.0, 200,
        ),
        Many(
            "shaken blocks: stick, slip, reverse", SHAKEN_BLOCK,
            lambda rng: (np.zeros(2), np.zeros(2), np.array([G, 0.3, rng.uniform(3, 9), rng.uniform(1, 4)])),
            _of_shaken_block, 10.0, 30, value=1e-11,
        ),
    )
}  # fmt: skip
