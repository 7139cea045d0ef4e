"""The magnet pendulum, the coupled pendulums, the gyroscope and the rotor of Finzi, Wang and Wilson (NeurIPS 2020).

Each has the numbers, the starts, the time steps and the lengths of rollouts of their published code, in angles: from
the x axis and about it for bobs, Euler's z–x–z for the gyroscope; the rotor has a unit quaternion. Inertias of the
gyroscope and the rotor are second moments of their meshes. Of each Lagrangian one number is 1, the scale that no motion
shows.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

MAGNETS = np.array([[0.1, 0.0, -1.05], [-0.1, 0.0, -1.05]])
GYROSCOPE = (1.0, 0.4827568 / 0.3274790, 0.2217285 * 9.81 / 0.3274790)  # J₂/J₁, J₃/J₁ about the pivot, m g h/J₁
ROTOR = (0.0240936 / 0.1201719, 0.1020485 / 0.1201719)  # J₂/J₁, J₃/J₁


class SpatialScene(NamedTuple):
    """A scene: `known` and the candidate `terms` are functions of (q, v), `true` the numbers of the latter that are not
    zero, `first` those of them that a fit begins with; `points` are positions (K, 3) of masses at q. `rate` is a
    reference of another source than the Lagrangian."""

    name: str
    theirs: str
    step: float
    long: float
    known: Callable
    terms: dict[str, Callable]
    true: dict[str, float]
    first: dict[str, float]
    points: Callable
    starts: Callable
    constraints: Callable | None = None
    rate: Callable | None = None

    @property
    def free(self) -> dict:
        """Potentials that are learned: none."""
        return {}

    @property
    def law(self) -> lagjax.terms:
        """The candidate terms as one law."""
        return lagjax.terms(self.terms)

    def make_rate(self) -> Callable:
        """A function of states (N, 2n) that returns their rates, `rate` or by derivatives of the true Lagrangian."""
        if self.rate is not None:
            return self.rate

        def lagrangian(q, v):
            return self.known(q, v) + sum(number * self.terms[name](q, v) for name, number in self.true.items())

        def rate(y):
            q, v = jnp.split(y, 2)
            momentum = jax.grad(lagrangian, 1)
            moved = jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
            inertia = jax.jacfwd(lambda v: momentum(q, v))(v)
            return jnp.concatenate([v, jnp.linalg.solve(inertia, jax.grad(lagrangian)(q, v) - moved)])

        return jax.jit(jax.vmap(rate))

    def masses_at(self, q, v) -> np.ndarray:
        """Positions and velocities of the points, (..., 6K)."""
        moved = jax.vmap(lambda q, v: jnp.ravel(jnp.stack(jax.jvp(self.points, (q,), (v,)))))
        flat = moved(q.reshape(-1, q.shape[-1]), v.reshape(-1, q.shape[-1]))
        return np.asarray(flat).reshape(*q.shape[:-1], -1)


def _bob(q):
    """The place of a bob on a rod of length 1."""
    phi, theta = q
    return jnp.stack([-jnp.cos(theta), jnp.sin(theta) * jnp.sin(phi), jnp.sin(theta) * jnp.cos(phi)])


def magnet_pendulum() -> SpatialScene:
    """A bob of mass 3 with a dipole along its rod, over two magnets."""
    terms = {
        "½ θ̇²": lambda q, v: 0.5 * v[1] ** 2, "½ φ̇²": lambda q, v: 0.5 * v[0] ** 2, "φ̇ θ̇": lambda q, v: v[0] * v[1],
        "x": lambda q, v: _bob(q)[0], "y": lambda q, v: _bob(q)[1], "z": lambda q, v: _bob(q)[2],
        "x²": lambda q, v: _bob(q)[0] ** 2, "y²": lambda q, v: _bob(q)[1] ** 2,
    }  # fmt: skip
    for k, magnet in enumerate(MAGNETS):

        def dipole(q, v, magnet=magnet):
            place = _bob(q)
            away = magnet - place
            square = away @ away
            return (3.0 * (place @ away) * away[2] + square * place[2]) / square**2.5

        terms[f"dipole {k}"] = dipole
        terms[f"1/r{k}"] = lambda q, v, magnet=magnet: 1.0 / jnp.linalg.norm(magnet - _bob(q))
        terms[f"1/r{k}³"] = lambda q, v, magnet=magnet: 1.0 / jnp.linalg.norm(magnet - _bob(q)) ** 3
    strength = 0.3**2 / (4 * np.pi) / 3.0
    true = {"½ θ̇²": 1.0, "z": -9.81, "dipole 0": strength, "dipole 1": strength}
    centre, scatter = np.array([np.pi, np.pi / 2, 0.0, 0.0]), np.array([0.3, 0.2, 0.05, 0.4])
    return SpatialScene(
        "magnet pendulum", "1.0e-2", 0.05, 5.0, lambda q, v: 0.5 * jnp.sin(q[1]) ** 2 * v[0] ** 2, terms, true,
        {"½ θ̇²": 1.0}, lambda q: _bob(q)[None],
        lambda count, rng: centre + scatter * rng.normal(size=(count, 4)),
    )  # fmt: skip


def coupled_pendulums(bobs: int = 3) -> SpatialScene:
    """Bobs of mass 1 a unit apart, with springs of stiffness 10 between neighbours."""

    def place(q, k):
        return _bob(q[2 * k : 2 * k + 2]) + jnp.array([k, 0.0, 0.0])

    terms, true, first = {}, {}, {}
    for k in range(bobs):
        if k:
            terms[f"½ θ̇{k}²"] = lambda q, v, k=k: 0.5 * v[2 * k + 1] ** 2
        terms[f"½ φ̇{k}²"] = lambda q, v, k=k: 0.5 * v[2 * k] ** 2
        terms[f"½ sin² φ̇{k}²"] = lambda q, v, k=k: 0.5 * (jnp.sin(q[2 * k + 1]) * v[2 * k]) ** 2
        for axis, name in enumerate("xyz"):
            terms[f"{name}{k}"] = lambda q, v, k=k, axis=axis: place(q, k)[axis]
        true |= {f"½ sin² φ̇{k}²": 1.0, f"z{k}": -10.0} | ({f"½ θ̇{k}²": 1.0} if k else {})
        first |= {f"½ φ̇{k}²": 1.0} | ({f"½ θ̇{k}²": 1.0} if k else {})
    for k in range(bobs - 1):
        for power in (1, 2, 3, 4):
            terms[f"d{k}^{power}"] = lambda q, v, k=k, power=power: (
                jnp.linalg.norm(place(q, k + 1) - place(q, k)) ** power
            )
        true |= {f"d{k}^1": 10.0, f"d{k}^2": -5.0}
    centre = np.concatenate([np.tile([np.pi, np.pi / 2], bobs), np.zeros(2 * bobs)])
    return SpatialScene(
        "coupled pendulums", "7.4e-3", 0.05, 5.0, lambda q, v: 0.5 * v[1] ** 2, terms, true, first,
        lambda q: jnp.stack([place(q, k) for k in range(bobs)]),
        lambda count, rng: centre + 0.3 * rng.normal(size=(count, 4 * bobs)),
    )  # fmt: skip


def _spin(q, v):
    """The angular velocity (3,) about the axes of a body."""
    (_, b, c), (da, db, dc) = q, v
    return jnp.stack([
        da * jnp.sin(b) * jnp.sin(c) + db * jnp.cos(c), da * jnp.sin(b) * jnp.cos(c) - db * jnp.sin(c),
        da * jnp.cos(b) + dc,
    ])  # fmt: skip


def _frame(q):
    """The axes of a body as columns (3, 3)."""

    def turn(angle, i, j):
        flat = jnp.eye(3).at[jnp.array([i, j]), jnp.array([i, j])].set(jnp.cos(angle))
        return flat.at[i, j].set(-jnp.sin(angle)).at[j, i].set(jnp.sin(angle))

    return turn(q[0], 0, 1) @ turn(q[1], 1, 2) @ turn(q[2], 0, 1)


def _turning_terms(spin: Callable, frame: Callable) -> dict[str, Callable]:
    """Products of angular velocities, but the first square, and what gravity does to a body, by functions of (q, v) and
    of q that return the angular velocity and the axes."""
    terms = {}
    for i in range(3):
        for j in range(i, 3):
            if i + j:
                half = 0.5 if i == j else 1.0
                terms[f"ω{i + 1} ω{j + 1}"] = lambda q, v, i=i, j=j, half=half: half * spin(q, v)[i] * spin(q, v)[j]
    for axis, name in enumerate("xyz"):
        for i in range(3):
            terms[f"{name} of axis {i + 1}"] = lambda q, v, i=i, axis=axis: frame(q)[axis, i]
    return terms


def gyroscope() -> SpatialScene:
    """A top about its foot."""
    height = 0.2217285

    def starts(count, rng):
        found = rng.uniform(-1.5, 1.5, (count, 6)) * [1, 1, 1, 3, 0.2, 1]
        found[:, 5] = rng.choice([-1.0, 1.0], count) * 1.5 * (7.0 + rng.normal(size=count))
        return found

    def points(q):
        axes = _frame(q).T
        return height * axes[2] + jnp.concatenate([jnp.zeros((1, 3)), axes])

    true = {"ω2 ω2": GYROSCOPE[0], "ω3 ω3": GYROSCOPE[1], "z of axis 3": -GYROSCOPE[2]}
    return SpatialScene(
        "gyroscope", "1.7e-5", 0.02, 2.0, lambda q, v: 0.5 * _spin(q, v)[0] ** 2, _turning_terms(_spin, _frame),
        true, {"ω2 ω2": 1.0, "ω3 ω3": 1.0}, points, starts,
    )  # fmt: skip


def _multiply(a, b):
    """The product (…, 4) of quaternions."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(axis=-1, keepdims=True)
    xp = np if isinstance(a, np.ndarray) else jnp
    return xp.concatenate(
        [real, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + xp.cross(a[..., 1:], b[..., 1:])], -1
    )


CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _rotor_rate(y: np.ndarray) -> np.ndarray:
    """The rates of states (N, 14) of place and quaternion, by Euler's equations: without a Lagrangian."""
    v, (p, dp), inertia = y[:, 7:], (y[:, 3:7], y[:, 10:]), np.array([1.0, *ROTOR])
    spin = 2.0 * _multiply(CONJUGATE * p, dp)
    spin[:, 0] = 0.0
    pulled = np.zeros_like(spin)
    pulled[:, 1:] = np.cross(inertia * spin[:, 1:], spin[:, 1:]) / inertia
    return np.concatenate([v, np.zeros((len(y), 3)), 0.5 * (_multiply(dp, spin) + _multiply(p, pulled))], axis=1)


def rotor() -> SpatialScene:
    """A body without forces, by place and unit quaternion: a tumbling body passes the poles of Euler's angles."""

    def spin(q, v):
        return 2.0 * _multiply(CONJUGATE * q[3:], v[3:])[1:]

    def frame(q):
        turned = [_multiply(_multiply(q[3:], jnp.eye(4)[k]), CONJUGATE * q[3:])[1:] for k in (1, 2, 3)]
        return jnp.stack(turned, axis=1)

    def starts(count, rng):
        given = np.clip(2.0 * rng.normal(size=(count, 12)), -3, 3) * np.where(np.arange(12) % 6 < 3, 0.1, 1)
        (a, b, c), rates = given[:, 3:6].T, given[:, 9:].T
        zero = np.zeros(count)
        about = [np.stack([np.cos(x / 2), *(np.sin(x / 2) * np.array(e)[:, None])], axis=1)
                 for x, e in ((a, (0, 0, 1)), (b, (1, 0, 0)), (c, (0, 0, 1)))]  # fmt: skip
        p = _multiply(_multiply(about[0], about[1]), about[2])
        da, db, dc = rates
        turning = [zero, da * np.sin(b) * np.sin(c) + db * np.cos(c), da * np.sin(b) * np.cos(c) - db * np.sin(c),
                   da * np.cos(b) + dc]  # fmt: skip
        return np.concatenate([given[:, :3], p, given[:, 6:9], 0.5 * _multiply(p, np.stack(turning, axis=1))], axis=1)

    terms = _turning_terms(spin, frame)
    for axis, name in enumerate("xyz"):
        terms[name] = lambda q, v, axis=axis: q[axis]
        terms[f"{name}²"] = lambda q, v, axis=axis: q[axis] ** 2
    return SpatialScene(
        "rotor", "5.8e-6", 0.05, 5.0, lambda q, v: 0.5 * v[:3] @ v[:3] + 0.5 * spin(q, v)[0] ** 2, terms,
        {"ω2 ω2": ROTOR[0], "ω3 ω3": ROTOR[1]}, {"ω2 ω2": 1.0, "ω3 ω3": 1.0},
        lambda q: q[:3] + jnp.concatenate([jnp.zeros((1, 3)), frame(q).T]), starts,
        lambda q: q[3:] @ q[3:] - 1.0, _rotor_rate,
    )  # fmt: skip


SCENES = {
    "magnet": magnet_pendulum, "coupled": coupled_pendulums, "gyroscope": gyroscope, "rotor": rotor,
}  # fmt: skip
