"""Scenes with contacts as users wrote them with modes and guards, and with `contacts=`: lines and seconds of both.

Each pair of functions returns the end of the same motion. Lines are those of the function's body.
"""

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

G = 9.81


def ball_in_a_box_by_hand():
    """One mode, a guard and a reset for each wall; it must not come to rest."""
    fall = lagjax.System(lambda q, v: 0.5 * v @ v - G * q[1])

    def wall(name, guard, i, e):
        return lagjax.Transition(name, name, guard, -1, lambda q, v: (q, v.at[i].multiply(-e)))

    walls = [
        wall("free", lambda q, v: q[1], 1, 0.9),
        wall("free", lambda q, v: q[0], 0, 0.8),
        wall("free", lambda q, v: 1 - q[0], 0, 0.8),
    ]
    q, v, ts = jnp.array([0.3, 1.0]), jnp.array([1.3, 0.0]), jnp.array([0.0, 3.0])
    run = lagjax.simulate(lagjax.Hybrid({"free": fall}, walls, "free"), q, v, ts)
    return run.q[-1]


def ball_in_a_box():
    """Three gaps."""
    box = lagjax.System(
        lambda q, v: 0.5 * v @ v - G * q[1],
        contacts=lambda q: {"floor": q[1], "left": q[0], "right": 1 - q[0]},
        restitution={"floor": 0.9, "left": 0.8, "right": 0.8},
    )
    q, v, ts = jnp.array([0.3, 1.0]), jnp.array([1.3, 0.0]), jnp.array([0.0, 3.0])
    return lagjax.simulate(box, q, v, ts).q[-1]


def ladder_by_hand():
    """Both contacts as constraints, then one of them; the guard is the wall's multiplier."""

    def law(q, v):
        return 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 12) - G * q[1]

    def floor(q):
        return q[1] - jnp.sin(q[2]) / 2

    def wall(q):
        return q[0] - jnp.cos(q[2]) / 2

    modes = {
        "both": lagjax.System(law, constraints=lambda q: {"floor": floor(q), "wall": wall(q)}),
        "floor": lagjax.System(law, constraints=lambda q: {"floor": floor(q)}),
    }
    leave = lagjax.Transition("both", "floor", lambda q, v, multipliers: multipliers["wall"], -1)
    q, ts = jnp.array([np.cos(1.2) / 2, np.sin(1.2) / 2, 1.2]), jnp.array([0.0, 0.9])
    return lagjax.simulate(lagjax.Hybrid(modes, [leave], "both"), q, jnp.zeros(3), ts).q[-1]


def ladder():
    """Two gaps."""
    scene = lagjax.System(
        lambda q, v: 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 12) - G * q[1],
        contacts=lambda q: {"floor": q[1] - jnp.sin(q[2]) / 2, "wall": q[0] - jnp.cos(q[2]) / 2},
    )
    q, ts = jnp.array([np.cos(1.2) / 2, np.sin(1.2) / 2, 1.2]), jnp.array([0.0, 0.9])
    return lagjax.simulate(scene, q, jnp.zeros(3), ts).q[-1]


def bead_row_by_hand():
    """Four beads on a line between walls: a guard and a reset for each neighbour."""

    def exchange(i):
        return lambda q, v: (q, v.at[i].set(v[i + 1]).at[i + 1].set(v[i]))

    def meet(i):
        return lagjax.Transition("free", "free", lambda q, v: q[i + 1] - q[i] - 0.1, -1, exchange(i))

    def turn(i):
        return lambda q, v: (q, v.at[i].multiply(-1.0))

    walls = [
        lagjax.Transition("free", "free", lambda q, v: q[0], -1, turn(0)),
        lagjax.Transition("free", "free", lambda q, v: 1.3 - q[3], -1, turn(3)),
    ]
    modes = {"free": lagjax.System(lambda q, v: 0.5 * v @ v)}
    q, v, ts = jnp.array([0.1, 0.4, 0.7, 1.0]), jnp.array([0.7, -0.3, 0.1, 0.5]), jnp.array([0.0, 4.0])
    return lagjax.simulate(lagjax.Hybrid(modes, [*map(meet, range(3)), *walls], "free"), q, v, ts).q[-1]


def bead_row():
    """Five gaps."""
    beads = lagjax.System(
        lambda q, v: 0.5 * v @ v,
        contacts=lambda q: {"between": q[1:] - q[:-1] - 0.1, "walls": jnp.stack([q[0], 1.3 - q[3]])},
        restitution=1.0,
    )
    q, v, ts = jnp.array([0.1, 0.4, 0.7, 1.0]), jnp.array([0.7, -0.3, 0.1, 0.5]), jnp.array([0.0, 4.0])
    return lagjax.simulate(beads, q, v, ts).q[-1]


def hopper_by_hand():
    """Two masses and a spring: in the air and on the ground, where the foot is held; it must not stay there."""

    def law(q, v):
        return v[0] ** 2 + 0.1 * v[1] ** 2 - G * (2 * q[0] + 0.2 * q[1]) - 200 * (q[0] - q[1] - 1) ** 2

    modes = {"air": lagjax.System(law), "ground": lagjax.System(law, constraints=lambda q: q[1])}
    land = lagjax.Transition("air", "ground", lambda q, v: q[1], -1, lambda q, v: (q, v.at[1].set(0.0)))
    leave = lagjax.Transition("ground", "air", lambda q, v, multipliers: multipliers, -1)
    q, ts = jnp.array([1.5, 0.5]), jnp.array([0.0, 2.0])
    return lagjax.simulate(lagjax.Hybrid(modes, [land, leave], "air"), q, jnp.zeros(2), ts).q[-1]


def hopper():
    """One gap."""
    scene = lagjax.System(
        lambda q, v: v[0] ** 2 + 0.1 * v[1] ** 2 - G * (2 * q[0] + 0.2 * q[1]) - 200 * (q[0] - q[1] - 1) ** 2,
        contacts=lambda q: q[1],
    )
    return lagjax.simulate(scene, jnp.array([1.5, 0.5]), jnp.zeros(2), jnp.array([0.0, 2.0])).q[-1]


def ratchet_by_hand():
    """A lever that swings, and a wheel that it drives one way: locked and free; the guard is the multiplier."""

    def law(q, v):
        return 0.5 * v[0] ** 2 + v[1] ** 2 - 2 * q[0] ** 2

    def drag(q, v):
        return jnp.stack([0.0, -0.3 * v[1]])

    modes = {
        "free": lagjax.System(law, forces=drag),
        "locked": lagjax.System(law, forces=drag, velocity_constraints=lambda q, v: v[1] - v[0]),
    }
    lock = lagjax.Transition("free", "locked", lambda q, v: v[1] - v[0], -1)
    free = lagjax.Transition("locked", "free", lambda q, v, multipliers: multipliers, -1)
    q, v, ts = jnp.array([-1.0, 0.0]), jnp.zeros(2), jnp.array([0.0, 10.0])
    return lagjax.simulate(lagjax.Hybrid(modes, [lock, free], "locked"), q, v, ts).q[-1]


def ratchet():
    """One velocity that stays positive."""
    scene = lagjax.System(
        lambda q, v: 0.5 * v[0] ** 2 + v[1] ** 2 - 2 * q[0] ** 2,
        forces=lambda q, v: jnp.stack([0.0, -0.3 * v[1]]),
        one_way=lambda q, v: v[1] - v[0],
    )
    return lagjax.simulate(scene, jnp.array([-1.0, 0.0]), jnp.zeros(2), jnp.array([0.0, 10.0])).q[-1]


def dominoes_by_hand():
    """Two thin dominoes: the first falls alone, strikes, and pushes the other, until they part."""

    def law(q, v):
        return jnp.sum(v**2) / 6 - 0.5 * G * jnp.sum(jnp.cos(q - 0.1))

    def between(q):
        return (0.4 - jnp.sin(q[0])) * jnp.cos(q[1]) + jnp.cos(q[0]) * jnp.sin(q[1])

    def strike(q, v):
        slope = jax.grad(between)(q)
        return q, v - slope * (slope @ v) / (slope @ slope)

    modes = {
        "one": lagjax.System(law, constraints=lambda q: q[1]),
        "both": lagjax.System(law, constraints=between),
        "apart": lagjax.System(law),
    }
    meet = lagjax.Transition("one", "both", lambda q, v: between(q), -1, strike)
    part = lagjax.Transition("both", "apart", lambda q, v, multipliers: multipliers, -1)
    again = lagjax.Transition("apart", "both", lambda q, v: between(q), -1, strike)
    q, v, ts = jnp.array([0.15, 0.0]), jnp.zeros(2), jnp.array([0.0, 0.9])
    return lagjax.simulate(lagjax.Hybrid(modes, [meet, part, again], "one"), q, v, ts).q[-1]


def dominoes():
    """A gap between them, and one between the second and the ground on which it stands."""
    scene = lagjax.System(
        lambda q, v: jnp.sum(v**2) / 6 - 0.5 * G * jnp.sum(jnp.cos(q - 0.1)),
        contacts=lambda q: {
            "strike": (0.4 - jnp.sin(q[0])) * jnp.cos(q[1]) + jnp.cos(q[0]) * jnp.sin(q[1]),
            "stand": q[1],
        },
    )
    return lagjax.simulate(scene, jnp.array([0.15, 0.0]), jnp.zeros(2), jnp.array([0.0, 0.9])).q[-1]


PAIRS = {
    "ball in a box": (ball_in_a_box_by_hand, ball_in_a_box),
    "ladder on wall and floor": (ladder_by_hand, ladder),
    "four beads between walls": (bead_row_by_hand, bead_row),
    "hopper on a spring": (hopper_by_hand, hopper),
    "ratchet": (ratchet_by_hand, ratchet),
    "two dominoes": (dominoes_by_hand, dominoes),
}


def lines(function: Callable) -> int:
    """The lines of a function's body that are not empty."""
    text = inspect.getsource(function).split('"""')[2]
    return sum(bool(line.strip()) for line in text.splitlines())


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for name, (old, new) in PAIRS.items():
        print(name, lines(old), lines(new), old(), new())
