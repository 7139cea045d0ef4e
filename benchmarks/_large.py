"""Scenes as they come from real machines and many bodies: what users meet first beyond pendulums.

Each is a function that returns (system, q0, qdot0, params). Lengths are in metres, masses in kilograms.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from lagjax import scenes

GRAVITY = 9.81
Scene = tuple[lagjax.System, Any, Any, Any]


def rotation(axis: str, angle) -> jax.Array:
    """The matrix of a rotation about a coordinate axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    rows = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return jnp.array(rows[axis])


def _spin(R, rate):
    """The angular velocity of a body with the rotation matrix R and its rate, in axes of the body."""
    W = R.T @ rate
    return jnp.stack([W[2, 1], W[0, 2], W[1, 0]])


def arm() -> Scene:
    """A robot arm of six joints, its kinetic energy written with rotation matrices and angular velocities."""
    axes = "zyyxyx"
    offsets = np.array([[0, 0, 0.3], [0, 0, 0.4], [0.1, 0, 0.35], [0.3, 0, 0], [0.1, 0, 0], [0.08, 0, 0.02]])

    def lagrangian(q, qdot, params):
        R, p, velocity, spin, total = jnp.eye(3), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), 0.0
        for k, axis in enumerate(axes):
            R = R @ rotation(axis, q[k])
            spin = spin + R[:, "xyz".index(axis)] * qdot[k]
            d = R @ offsets[k]
            at, of_centre, of_body = p + 0.5 * d, velocity + jnp.cross(spin, 0.5 * d), R.T @ spin
            kinetic = params["m"][k] * of_centre @ of_centre + jnp.sum(params["I"][k] * of_body**2)
            total = total + 0.5 * kinetic - params["m"][k] * GRAVITY * at[2]
            p, velocity = p + d, velocity + jnp.cross(spin, d)
        return total

    params = {"m": np.linspace(4, 1, 6), "I": np.outer(np.linspace(0.4, 0.02, 6), [1, 1.2, 0.7])}
    return lagjax.System(lagrangian), np.linspace(0.1, 0.6, 6), np.full(6, 0.1), params


def bicycle() -> Scene:
    """A bicycle of four bodies, upright, rolling at 4 m/s and beginning to fall: two contacts, four rolling conditions.

    q (9,): the centre of the rear wheel, yaw, roll and pitch of the frame, steering angle, angles of both wheels.
    """
    radii, tilt, axle = (0.3, 0.35), 0.3, jnp.array([0.0, 1.0, 0.0])
    centres = jnp.array([[0.3, 0, 0.5], [0.02, 0, -0.1]])  # of the frame from the rear axle, of the fork from the head
    moments = np.array([[9, 11, 2.8], [0.06, 0.06, 0.01], [0.06, 0.12, 0.06], [0.14, 0.28, 0.14]])

    def parts(q):
        frame = rotation("z", q[3]) @ rotation("x", q[4]) @ rotation("y", q[5])
        fork = frame @ rotation("y", -tilt) @ rotation("z", q[6]) @ rotation("y", tilt)
        head = q[:3] + frame @ jnp.array([0.85, 0.0, 0.4])
        return frame, fork, q[:3], head, head + fork @ jnp.array([0.17, 0.0, -0.4])

    def lagrangian(q, qdot, params):
        (frame, fork, rear, head, front), rates = jax.jvp(parts, (q,), (qdot,))
        of_frame, of_fork = _spin(frame, rates[0]), _spin(fork, rates[1])
        spins = of_frame, of_fork, of_frame + axle * qdot[7], of_fork + axle * qdot[8]
        places = rear + frame @ centres[0], head + fork @ centres[1], rear, front
        speeds = rates[2] + rates[0] @ centres[0], rates[3] + rates[1] @ centres[1], rates[2], rates[4]
        total = 0.0
        for m, moment, spin, place, speed in zip(params["m"], moments, spins, places, speeds, strict=True):
            total = total + 0.5 * (m * speed @ speed + jnp.sum(moment * spin**2)) - m * GRAVITY * place[2]
        return total

    def contact(R, radius):
        """From the centre of a wheel to its lowest point."""
        down = R[2, 1] * R[:, 1] - jnp.array([0.0, 0.0, 1.0])
        return radius * down / jnp.sqrt(down @ down)

    def on_the_ground(q):
        frame, fork, rear, _, front = parts(q)
        return {"rear": (rear + contact(frame, radii[0]))[2], "front": (front + contact(fork, radii[1]))[2]}

    def rolling(q, qdot):
        (frame, fork, *_), rates = jax.jvp(parts, (q,), (qdot,))
        slips = {}
        for name, R, rate, speed, wheel, radius in (
            ("rolling rear", frame, rates[0], rates[2], qdot[7], radii[0]),
            ("rolling front", fork, rates[1], rates[4], qdot[8], radii[1]),
        ):
            spin = R @ (_spin(R, rate) + axle * wheel)
            slips[name] = (speed + jnp.cross(spin, contact(R, radius)))[:2]
        return slips

    def heights(q):
        return jnp.stack(jax.tree.leaves(on_the_ground(q)))

    q = np.zeros(9)
    for _ in range(10):  # Newton for height and pitch
        q[[2, 5]] -= np.linalg.solve(np.asarray(jax.jacfwd(heights)(q))[:, [2, 5]], heights(q))

    def conditions(qdot):
        return jnp.concatenate([*jax.tree.leaves(rolling(q, qdot)), jax.jvp(heights, (q,), (qdot,))[1]])

    guess = np.array([4.0, 0, 0, 0, 0.2, 0, 0, 4 / radii[0], 4 / radii[1]])
    matrix = np.asarray(jax.jacfwd(conditions)(guess))
    qdot = guess - np.linalg.lstsq(matrix, matrix @ guess, rcond=None)[0]
    system = lagjax.System(lagrangian, constraints=on_the_ground, velocity_constraints=rolling)
    return system, q, qdot, {"m": np.array([85.0, 4, 2, 3])}


def bricard() -> Scene:
    """Bricard's linkage of six bars and six joints along the edges of a cube: it moves, though counting forbids it.

    Each joint is perpendicular to both of its bars. Five angles, and five conditions that close the sixth, of which one
    depends on the others.
    """
    bars, axes = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0], [-1, 0, 0]]), "xzyxz"

    def joints(q):
        R, p, places = jnp.eye(3), jnp.zeros(3), [jnp.zeros(3)]
        for axis, angle, bar in zip(axes, q, bars, strict=True):
            R = R @ rotation(axis, angle)
            p = p + R @ bar
            places.append(p)
        return jnp.stack(places), R

    def lagrangian(q, qdot, params):
        (x, _), (v, _) = jax.jvp(joints, (q,), (qdot,))
        a, b = v[:-1], v[1:]
        kinetic = params["m"] / 6 * jnp.sum(a * a + a * b + b * b)
        return kinetic - 0.5 * params["m"] * GRAVITY * jnp.sum(x[:-1, 1] + x[1:, 1])

    def closed(q):
        x, R = joints(q)
        return {"point": x[-1] - bars.sum(axis=0), "axis": R[::2, 1]}

    slopes = jnp.concatenate(jax.tree.leaves(jax.jacfwd(closed)(jnp.zeros(5))))
    free = np.linalg.svd(slopes)[2][-1]  # the one direction in which it moves
    return lagjax.System(lagrangian, constraints=closed), np.zeros(5), free, {"m": 1.0}


def charges(count: int = 20) -> Scene:
    """Equal charges that repel each other on the unit sphere, in Cartesian coordinates with a constraint for each."""
    first, second = np.triu_indices(count, 1)

    def lagrangian(q, qdot, params):
        distance = jnp.sqrt(jnp.sum((q[first] - q[second]) ** 2, axis=1))
        return 0.5 * jnp.sum(qdot**2) - params["k"] * jnp.sum(1 / distance)

    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(2, count, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    v -= x * np.sum(x * v, axis=1, keepdims=True)
    system = lagjax.System(lagrangian, constraints=lambda q: 0.5 * (jnp.sum(q**2, axis=1) - 1))
    return system, x, 0.1 * v, {"k": 0.05}


def beam(links: int = 40) -> Scene:
    """An elastic beam of stiff links, clamped at one end (Hairer & Wanner, *Solving ODEs II*, §IV.1), released bent."""
    h = 1.0 / links

    def lagrangian(q, qdot, params):
        vx, vy = -h * jnp.sin(q) * qdot, h * jnp.cos(q) * qdot
        x, y = jnp.cumsum(vx) - 0.5 * vx, jnp.cumsum(vy) - 0.5 * vy  # velocities of the middles
        kinetic = 0.5 * h * jnp.sum(x**2 + y**2) + 0.5 * h**3 / 12 * jnp.sum(qdot**2)
        bend = jnp.diff(q, prepend=0.0)
        return kinetic - 0.5 * params["stiffness"] * links * (2 * bend[0] ** 2 + jnp.sum(bend[1:] ** 2))

    return lagjax.System(lagrangian), np.linspace(0, 0.5, links), np.zeros(links), {"stiffness": 1.0}


def bodies(count: int, dimensions: int = 3) -> Scene:
    """Bodies of total mass 1 that attract each other with a softened force, in units where their cluster has size 1."""
    first, second = np.triu_indices(count, 1)

    def lagrangian(q, qdot, params):
        m = params["m"]
        squared = jnp.sum((q[first] - q[second]) ** 2, axis=1) + SOFTENING**2
        return 0.5 * jnp.sum(m[:, None] * qdot**2) + jnp.sum(m[first] * m[second] / jnp.sqrt(squared))

    rng = np.random.default_rng(count)
    x, v = rng.normal(size=(count, dimensions)), 0.5 * rng.normal(size=(count, dimensions))
    return lagjax.System(lagrangian), x, v, {"m": np.full(count, 1 / count)}


SOFTENING = 0.1


def chain(links: int) -> Scene:
    """Links of a pendulum, in their angles."""
    scene = scenes.chain(links)
    return scene.system, scene.q0, scene.qdot0, scene.params


def cartesian_chain(links: int) -> Scene:
    """Links of a pendulum, in Cartesian coordinates with a constraint for each."""
    scene = scenes.cartesian_chain(links)
    return scene.system, scene.q0, scene.qdot0, scene.params


MACHINES: dict[str, Callable[[], Scene]] = {
    "arm": arm, "bicycle": bicycle, "bricard": bricard, "charges": charges, "beam": beam,
}  # fmt: skip
FAMILIES: dict[str, Callable[[int], Scene]] = {"chain": chain, "bodies": bodies, "cartesian chain": cartesian_chain}


def scene_of(name: str) -> Scene:
    """A scene by its name: of a machine, or of a family with the number behind it, as "chain 16"."""
    if name in MACHINES:
        return MACHINES[name]()
    family, _, size = name.rpartition(" ")
    return FAMILIES[family](int(size))
