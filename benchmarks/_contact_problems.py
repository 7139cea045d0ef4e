"""Worked problems with contacts, each against what is known of it: figures by name, and bounds that hold for them.

python -m benchmarks.contacts --only problems
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import lagjax
from benchmarks._contact_reference import Reference, Scene
from benchmarks._contacts import G, system_of


@dataclass(frozen=True)
class Problem:
    """A problem: `solve()` gives figures, of which those with a bound are errors."""

    name: str
    solve: Callable[[], dict[str, Any]]
    bounds: dict[str, float]


def _error(found, right) -> float:
    return float(np.nan_to_num(np.abs(np.asarray(found) - np.asarray(right)).max(), nan=np.inf))


# ---- a block that rocks (Housner, Bull. Seismol. Soc. Am. 53 (1963) 403) ---------------------------------------------

NODES, WEIGHTS = (jnp.asarray(x) for x in np.polynomial.legendre.leggauss(40))


def block(b: float, h: float) -> Scene:
    """A block of 2b by 2h on two rough feet, q = (x, y, tilt) of its middle, p = (g,)."""

    def feet(q):
        along, up = jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])]), jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return q[:2] + b * jnp.array([[-1.0], [1.0]]) * along - h * up

    return Scene(
        lambda q, v, t, p: 0.5 * (v[:2] @ v[:2] + (b**2 + h**2) / 3 * v[2] ** 2) - p[0] * q[1],
        gaps=lambda q, t, p: feet(q)[:, 1], slip=lambda q, v, t, p: jax.jvp(feet, (q,), (v,))[1][:, 0],
        friction=lambda p: 2.0,
    )  # fmt: skip


def rocking_times(tilt, g, b: float, h: float, count: int):
    """The times of its impacts from a `tilt` at rest: each keeps 1 − 3/2 sin²α of the angular velocity.

    Down from θ₀ it takes ∫ dθ / (2p √(sin(α − ½(θ₀ + θ)) sin ½(θ₀ − θ))), p² = 3g/4R: smooth in θ = θ₀ (1 − s²).
    """
    half, alpha = np.hypot(b, h), np.arctan2(b, h)
    keeps, s = (1 - 1.5 * np.sin(alpha) ** 2) ** 2, (1 + NODES) / 2

    def down(tilt):
        return WEIGHTS @ (
            tilt * s / jnp.sqrt(3 * g / half * jnp.sin(alpha - tilt * (1 - s * s / 2)) * jnp.sin(tilt * s * s / 2))
        )

    def next_tilt(tilt):
        rise = keeps * 2 * jnp.sin(alpha - tilt / 2) * jnp.sin(tilt / 2)
        tilt = rise / np.sin(alpha)
        for _ in range(6):
            slope = np.sin(alpha) * jnp.cos(tilt) - np.cos(alpha) * jnp.sin(tilt)
            tilt = tilt - (2 * jnp.sin(alpha - tilt / 2) * jnp.sin(tilt / 2) - rise) / slope
        return tilt

    def impact(carry, _):
        tilt, t = carry
        after = next_tilt(tilt)
        return (after, t + down(tilt) + down(after)), t + down(tilt)

    return jax.lax.scan(impact, (tilt, 0.0 * tilt), None, count)[1]


def rocking_block(b: float = 0.2, h: float = 0.6, tilt: float = 0.1, count: int = 8) -> dict[str, Any]:
    """Impacts one after the other on either foot, their slopes by tilt and g, and what is left of them at rest."""
    system, x = system_of(block(b, h)), jnp.array([tilt, G])

    def start(tilt):
        return jnp.stack([jnp.cos(tilt) * b - jnp.sin(tilt) * h, jnp.sin(tilt) * b + jnp.cos(tilt) * h, tilt])

    def run(x, end):
        return lagjax.simulate(system, start(x[0]), jnp.zeros(3), jnp.array([0.0, end]), x[1:], rtol=1e-13)

    def exact(x):
        return rocking_times(*x, b, h, count)

    end = float(exact(x)[-1]) + 0.02
    along = [jax.jvp(f, (x,), (jnp.ones(2),)) for f in (exact, lambda x: run(x, end).impacts.t[:count])]
    (times, slopes), (found, found_slopes) = along
    rests = run(x, 20.0)
    return {
        "times": _error(found, times), "slopes": _error(found_slopes, slopes),
        "impacts to rest": int(rests.impacts.count),
        "time of rest": _error(rests.impacts.t[rests.impacts.count - 1], rocking_times(*x, b, h, 400)[-1]),
        "at rest": _error(jnp.concatenate([rests.q[-1], rests.qdot[-1]]), [b, h, 0, 0, 0, 0]),
    }  # fmt: skip


# ---- billiards -------------------------------------------------------------------------------------------------------

STADIUM = Scene(  # two half-circles of radius 1, 2 apart
    lambda q, v, t, p: 0.5 * v @ v,
    gaps=lambda q, t, p: (1 - jnp.maximum(jnp.abs(q[:1]) - 1, 0.0) ** 2 - q[1:] ** 2) / 2, restitution=lambda p: 1.0,
)  # fmt: skip
SINAI = Scene(  # a square of side 2 around a disc of radius 0.4
    lambda q, v, t, p: 0.5 * v @ v,
    gaps=lambda q, t, p: jnp.concatenate([jnp.sqrt(q @ q)[None] - 0.4, 1 - q, 1 + q]), restitution=lambda p: 1.0,
)  # fmt: skip


def walls_of(name: str) -> list[tuple]:
    """(normal, offset) of lines n q = c and (middle, radius) of circles: a name, both, and where they count."""
    sides = [("line", *wall, lambda q: True) for wall in ((1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1))]
    if name == "Sinai":
        return [*sides, ("circle", 0, 0, "0.4", lambda q: True)]
    flat = [(*wall[:4], lambda q: abs(q[0]) <= 1) for wall in sides[2:]]
    return [*flat, ("circle", 1, 0, 1, lambda q: q[0] >= 1), ("circle", -1, 0, 1, lambda q: q[0] <= -1)]


def exact_vector(numbers):
    """An array of `mpmath` numbers."""
    return np.array([mpmath.mpf(x) for x in numbers])


def next_bounce(walls, q, v):
    """The place and the velocity behind the next reflection, of exact vectors."""
    found = []
    for kind, *middle, size, counts in walls:
        middle, size = exact_vector(middle), mpmath.mpf(size)
        if kind == "line":
            times = [(size - q @ middle) / (v @ middle)] if v @ middle > 0 else []
        else:
            b, c = (q - middle) @ v / (v @ v), ((q - middle) @ (q - middle) - size**2) / (v @ v)
            times = [-b - mpmath.sqrt(b * b - c), -b + mpmath.sqrt(b * b - c)] if b * b > c else []
        found += [(t, kind, middle, size) for t in times if t > 1e-9 and counts(q + t * v)]
    t, kind, middle, size = min(found, key=lambda x: x[0])
    q = q + t * v
    normal = middle if kind == "line" else (q - middle) / size
    return q, v - 2 * (v @ normal) * normal


def billiard_map(name: str, scene: Scene, start, duration: float, count: int = 100) -> dict[str, Any]:
    """Bounces beside a map in 80 digits: each from the one before it, and all from the start, as long as they tell.

    What is left of a start is its error times how much the map has grown, from 1e-40 apart.
    """
    q, v = (jnp.array(x) for x in start)
    run = lagjax.simulate(system_of(scene), q, v, jnp.array([0.0, duration]), jnp.zeros(0))
    found = np.stack([run.contact_changes.q_next, run.contact_changes.qdot_next], axis=1)
    each, whole, growth, walls = 0.0, 0.0, 1.0, walls_of(name)
    with mpmath.workdps(80):
        state = exact_vector(start[0]), exact_vector(start[1])
        near = state[0] + exact_vector(["1e-40", 0]), state[1]
        for k in range(count):
            if k:
                each = max(each, np.abs(next_bounce(walls, *map(exact_vector, found[k - 1])) - found[k]).max())
            state, near = next_bounce(walls, *state), next_bounce(walls, *near)
            growth = max(growth, float(np.abs(near[0] - state[0]).max() * 1e40))
            if growth < 1e13:
                whole = max(whole, np.abs(np.stack(state) - found[k]).max() / growth)
    return {
        "each bounce": float(each), "all, in parts of their growth": float(whole), "growth of all": growth,
        "energy": _error(found[count - 1, 1] @ found[count - 1, 1], v @ v), "bounces": int(run.impacts.count),
    }  # fmt: skip


# ---- a woodpecker on its rod -----------------------------------------------------------------------------------------

M_SLEEVE, M_BIRD, J_SLEEVE, J_BIRD, SPRING = 3e-4, 4.5e-3, 5e-9, 7e-7, 5.6e-3
R_ROD, R_SLEEVE, H_SLEEVE, L_SPRING, L_BIRD, H_BEAK, L_BEAK = 2.5e-3, 3.1e-3, 5.8e-3, 1e-2, 1.5e-2, 2e-2, 2.01e-2


def woodpecker(kg: float = 1.0, m: float = 1.0, s: float = 1.0) -> Scene:
    """Glocker's toy, q = (height, sleeve's angle, bird's angle), in units of so many per kg, m and s.

    A sleeve with play on a rod, and a bird that a spring holds to it: contacts of the beak and of the sleeve's edges.
    Numbers are those of Glocker, *Dynamik von Starrkörpersystemen mit Reibung und Stößen* (1995), as programs of
    others have them; p are restitutions and friction.
    """
    lever = np.array([[1.0, 0, 0], [1, L_SPRING, L_BIRD]]) * [1, m, m]
    mass = kg * (M_SLEEVE * np.outer(*lever[[0, 0]]) + M_BIRD * np.outer(*lever[[1, 1]]))
    mass = jnp.asarray(mass + kg * m * m * np.diag([0, J_SLEEVE, J_BIRD]))
    weight, spring = mass[0] * G * m / s**2, SPRING * kg * m**2 / s**2
    play, edges = m * (R_SLEEVE - R_ROD), m * H_SLEEVE * jnp.array([1, -1])
    return Scene(
        lambda q, v, t, p: 0.5 * v @ mass @ v - 0.5 * spring * (q[2] - q[1]) ** 2 - weight @ q,
        gaps=lambda q, t, p: jnp.append(m * (L_SPRING + L_BIRD - L_BEAK - R_ROD - H_BEAK * q[2]), play + edges * q[1]),
        slip=lambda q, v, t, p: v[0] + m * jnp.stack([
            L_SPRING * v[1] + (L_BIRD - L_BEAK) * v[2], R_SLEEVE * v[1], R_SLEEVE * v[1],
        ]),
        restitution=lambda p: p[:3], friction=lambda p: p[3],
    )  # fmt: skip


def pecking() -> dict[str, Any]:
    """Two pecks against the reference, from a published start, and the period and the depth of the limit cycle."""
    p, ts = jnp.array([0.5, 0.0, 0.0, 0.3]), jnp.linspace(0.0, 3.0, 2)
    q, v = jnp.array([0.0, -(R_SLEEVE - R_ROD) / H_SLEEVE, -0.2788]), jnp.array([-0.3411, 0.0, -7.4583])
    system = system_of(woodpecker())
    run = lagjax.simulate(system, q, v, 2 * ts, p, max_transitions=512)
    two = lagjax.simulate(system, q, v, 0.1 * ts, p, max_transitions=512)
    changes = run.contact_changes
    pecks = np.flatnonzero((np.asarray(changes.contact) == 0) & (np.asarray(changes.change) == 2))
    # The reference takes numbers that are near one: grams, centimetres, tenths of seconds.
    height, turn = np.array([100.0, 1, 1]), np.array([10.0, 0.1, 0.1])
    reference = Reference(woodpecker(1e3, 1e2, 10.0), q, p)
    right = reference.run(q * height, v * turn, 3.0, p).z
    return {
        "two pecks": _error(np.concatenate([two.q[-1] * height, two.qdot[-1] * turn]), right),
        "period s": float(changes.t[pecks[-1]] - changes.t[pecks[-3]]) / 2,
        "falls by m": float(changes.q[pecks[-3], 0] - changes.q[pecks[-1], 0]) / 2,
    }  # fmt: skip


# ---- a stone that slides and turns -----------------------------------------------------------------------------------

REACH, INERTIA, MU = 0.1, 0.02, 0.3


def feet_of(count: int) -> np.ndarray:
    """The places (count, 2) of so many feet around the middle of a stone."""
    angles = 2 * np.pi * np.arange(count) / count
    return REACH * np.stack([np.cos(angles), np.sin(angles)], axis=1).round(15)


def turned(feet, angle, xp=jnp):
    """The places of feet (…, 2) of a stone that has turned by an angle."""
    c, s = xp.cos(angle), xp.sin(angle)
    return xp.stack([c * feet[..., 0] - s * feet[..., 1], s * feet[..., 0] + c * feet[..., 1]], axis=-1)


def feet_slips(feet, q, v, xp=jnp):
    """The slips (…, 2) of feet, of q = (x, y, angle, …)."""
    return v[:2] + v[2] * turned(feet, q[2] + np.pi / 2, xp)


def stone(feet) -> Scene:
    """A stone on feet, q = (x, y, angle, height, two tilts)."""
    return Scene(
        lambda q, v, t, p: 0.5 * (v[:2] @ v[:2] + v[3] ** 2 + INERTIA * (v[2] ** 2 + v[4:] @ v[4:])) - G * q[3],
        gaps=lambda q, t, p: q[3] + feet @ q[4:], friction=lambda p: MU, slip=lambda q, v, t, p: feet_slips(feet, q, v),
    )  # fmt: skip


def curling(count: int) -> dict[str, Any]:
    """A stone on feet: all slide, one stops, it turns about that, rests; by DOP853 and a closed form behind it."""
    feet = feet_of(count)

    def flow(t, z):
        slips = feet_slips(feet, z, z[3:], np)
        forces = -MU * G / count * slips / np.linalg.norm(slips, axis=1)[:, None]
        torque = np.sum(turned(feet, z[2] + np.pi / 2, np) * forces)
        return np.array([*z[3:], *forces.sum(axis=0), torque / INERTIA])

    def slow(t, z):
        return np.linalg.norm(feet_slips(feet, z, z[3:], np), axis=1).min() - 1e-7

    slow.terminal = True
    v = np.array([1.0, 0.2, 8.0])
    slides = solve_ivp(flow, (0.0, 1.0), [0.0, 0, 0, *v], "DOP853", rtol=1e-12, atol=1e-14, events=slow)
    t, z = slides.t[-1], slides.y[:, -1]
    rate = flow(t, z)
    first = np.argmin(np.linalg.norm(feet_slips(feet, z, z[3:], np), axis=1))
    slows = feet_slips(feet[first], z, rate[3:], np) - z[5] ** 2 * turned(feet[first], z[2], np)
    later = 1e-7 / np.linalg.norm(slows)  # the foot's slip goes to zero along a line
    t, z = t + later, z + later * rate
    brake = MU * G / count * np.linalg.norm(feet - feet[first], axis=1).sum() / (INERTIA + REACH**2)
    turn = z[2] + z[5] ** 2 / (2 * brake)
    end = [*(z[:2] + turned(feet[first], z[2], np) - turned(feet[first], turn, np)), turn]
    ts, start = jnp.array([0.0, 1.0, 2.0]), (jnp.zeros(6), jnp.array([*v, 0, 0, 0]))
    run, long = (
        lagjax.simulate(system_of(stone(feet)), *start, times, jnp.zeros(0)) for times in (ts, ts.at[2].set(1e6))
    )
    changes = run.contact_changes
    stops = np.asarray(changes.t)[np.asarray(changes.change) == 3]
    return {
        "place": _error(run.q[-1, :3], end), "times": _error(stops, [t, t + z[5] / brake]),
        "place at 1e6": _error(long.q[-1, :3], end), "creep": _error(long.q[2, :3], long.q[1, :3]),
        "at rest": _error(long.qdot[1:], 0.0),
    }  # fmt: skip


# ---- optimal pushes (Zhong, Han, Dey & Brikis, arXiv 2305.00092) -----------------------------------------------------

BALL, EFFORT = 0.2, 0.01  # the radius of both balls, the cost of pushing; both have mass 1 and a second
PUSHES = {  # the start of the ball that is pushed, of the other one, a wall, and a first push
    "one collision": ([-1.0, -2.0], [-1.0, -1.0], None, [0.0, 3.0]),
    "collision and wall": ([0.25, -0.3], [-0.5, 0.6], 1.0, [-3.5, 3.0]),
}


def least_cost(start, other, wall):
    """The least of |q₂(1)|² + 0.01 ∫ u²: u is linear until it meets the other ball, at s with the normal at an angle.

    To come by d with a velocity v takes ∫ u² = 12 d²/s³ − 12 d v/s² + 4 v²/s. A wall is a mirror of all starts.
    """
    start, other = (np.array([x, y if wall is None else 2 * (wall - BALL) - y]) for x, y in (start, other))

    def cost(x):
        s, n = x[0], jnp.stack([jnp.cos(x[1]), jnp.sin(x[1])])
        d, v, end = other - start - 2 * BALL * n, x[2:], other + (1 - s) * (x[2:] @ n) * n
        return end @ end + EFFORT * (12 * d @ d / s**3 - 12 * d @ v / s**2 + 4 * v @ v / s)

    guess = np.arctan2(*(0 - other)[::-1])
    x = minimize(cost, [0.5, guess, *(2 * (0 - other))], jac=jax.grad(cost), method="BFGS").x
    for _ in range(4):
        x = x - np.linalg.solve(jax.hessian(cost)(x), jax.grad(cost)(x))
    return cost(x)


def optimal_push(name: str) -> dict[str, Any]:
    """The least cost by descent along gradients through the collision, of pushes that are cubic in time.

    Behind the collision nothing pushes: that is a second motion, from the state behind the first impact.
    """
    start, other, wall, first = PUSHES[name]

    def push(c, t):
        x = 2 * t - 1
        return jnp.stack([jnp.ones_like(t), x, 1.5 * x**2 - 0.5, 2.5 * x**3 - 1.5 * x]).T @ c.reshape(4, 2)

    def gaps(q):
        between = jnp.sqrt((q[1] - q[0]) @ (q[1] - q[0])) - 2 * BALL
        return {"balls": between} | ({} if wall is None else {"wall": wall - BALL - q[1, 1]})

    balls = dict(lagrangian=lambda q, v: 0.5 * jnp.sum(v**2), contacts=gaps, restitution=1.0)
    free = lagjax.System(**balls)
    pushed = lagjax.System(
        **balls, forces=lambda q, v, t, params: jnp.zeros((2, 2)).at[0].set(push(params, t))
    )  # fmt: skip
    nodes, weights = (jnp.asarray(x) for x in np.polynomial.legendre.leggauss(4))

    def cost(c):
        q = jnp.array([start, other])
        run = lagjax.simulate(pushed, q, jnp.zeros((2, 2)), jnp.array([0.0, 1.0]), c, throw=False)
        t, q, v = run.impacts.t[0], run.contact_changes.q_next[0], run.contact_changes.qdot_next[0]
        end = lagjax.simulate(free, q, v, jnp.stack([t, 1.0]), throw=False).q[-1, 1]
        return end @ end + EFFORT * (jnp.sum(push(c, t * (1 + nodes) / 2) ** 2, axis=1) @ weights) * t / 2

    value_and_gradient = jax.jit(jax.value_and_grad(cost))

    def descended(c):  # a push that misses costs more than any that does not
        value, slope = map(np.asarray, value_and_gradient(c))
        return (value, slope) if np.isfinite(value) else (1e3, np.zeros(8))

    found = minimize(descended, [*first, *np.zeros(6)], jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 200})
    return {"cost": _error(found.fun, least_cost(start, other, wall)), "least cost": float(found.fun),
            "bent": float(np.abs(found.x[4:]).max()), "gradients": int(found.nfev)}  # fmt: skip


PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem(
            "Housner's block rocks to rest", rocking_block,
            {"times": 1e-12, "slopes": 1e-11, "time of rest": 1e-11, "at rest": 1e-13},
        ),
        Problem(
            "stadium billiard, 100 bounces", lambda: billiard_map("stadium", STADIUM, ([0.3, -0.2], [0.8, 0.6]), 240.0),
            {"each bounce": 1e-12, "all, in parts of their growth": 1e-12, "energy": 1e-12},
        ),
        Problem(
            "Sinai billiard, 100 bounces", lambda: billiard_map("Sinai", SINAI, ([0.7, -0.2], [0.8, 0.6]), 140.0),
            {"each bounce": 1e-10, "all, in parts of their growth": 1e-12, "energy": 1e-12},
        ),
        Problem("woodpecker toy", pecking, {"two pecks": 1e-9}),
        *(
            Problem(
                f"stone on {count} feet", lambda count=count: curling(count),
                {"place": 1e-9, "times": 1e-9, "place at 1e6": 1e-9, "creep": 0.0, "at rest": 1e-30},
            )
            for count in (2, 3)
        ),
        Problem("optimal push, one collision", lambda: optimal_push("one collision"), {"cost": 1e-8}),
        Problem("optimal push, collision and wall", lambda: optimal_push("collision and wall"), {"cost": 1e-8}),
    )
}  # fmt: skip
