"""The scenes that are compared, each with a batch of initial states.

A `Case` states one scene three times, because its readers differ:

- `scene` is what lagjax integrates, and its Lagrangian is the one that the autodiff peer differentiates;
- `symbolic(ops, q, v)` is the same Lagrangian in plain arithmetic on lists, where `ops` supplies sin, cos and sqrt:
  SymPy and heyoka derive their equations from it, and the tests compare it with the first;
- `acceleration(q, v)` is q̈ solved by hand, where a person would do that: from a sequence of coordinates to another.

Numbers are fixed by a seed. Lengths and masses of pendulums are 1 and their angles start in ±0.6 rad at rest: a batch
that swings widely, but is not so chaotic that the last digits lose their meaning.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _large
from lagjax import scenes

GRAVITY = 9.81


@dataclass(frozen=True)
class Case:
    """One scene with the states that its members start from: `q0`, `qdot0` of shape (batch, n)."""

    name: str
    scene: scenes.Scene
    q0: np.ndarray
    qdot0: np.ndarray
    duration: float
    symbolic: Callable | None
    acceleration: Callable | None = None
    equations: Callable | None = None  # q̈ by hand in the expressions of heyoka, where a Lagrangian takes it too long
    long_formulas: bool = False  # heyoka then runs its loops instead of writing them out: here faster, and it compiles

    @property
    def coordinates(self) -> int:
        return self.q0.shape[1]

    @property
    def batch(self) -> int:
        return len(self.q0)

    @property
    def states(self) -> np.ndarray:
        """(q, q̇) side by side, shape (batch, 2n)."""
        return np.concatenate([self.q0, self.qdot0], axis=1)

    def first(self, members: int) -> "Case":
        """The same scene with the first few members only."""
        return replace(self, q0=self.q0[:members], qdot0=self.qdot0[:members])

    def tree(self, rows: np.ndarray) -> Any:
        """Coordinates of shape (batch, n), or of one member, in the structure that the scene's Lagrangian expects."""
        (leaves, structure), pieces, start = jax.tree.flatten(self.scene.q0), [], 0
        for leaf in leaves:
            size = max(1, np.size(leaf))
            pieces.append(rows[..., start : start + size].reshape(rows.shape[:-1] + np.shape(leaf)))
            start += size
        return structure.unflatten(pieces)

    def lagrangian(self, q, qdot):
        """The scene's own Lagrangian of flat vectors."""
        return self.scene.system.lagrangian(self.tree(q), self.tree(qdot), t=0.0, params=self.scene.params)


def double_pendulum(batch: int = 1024) -> Case:
    scene, rng = scenes.double_pendulum(), np.random.default_rng(0)

    def symbolic(ops, q, v):
        kinetic = v[0] ** 2 + ops.cos(q[0] - q[1]) * v[0] * v[1] + 0.5 * v[1] ** 2
        return kinetic + GRAVITY * (2 * ops.cos(q[0]) + ops.cos(q[1]))

    return Case(
        name="double_pendulum",
        scene=scene,
        q0=rng.uniform(-0.6, 0.6, (batch, 2)),
        qdot0=np.zeros((batch, 2)),
        duration=5.0,
        symbolic=symbolic,
        acceleration=_double_pendulum_acceleration,
    )


def _double_pendulum_acceleration(q, v):
    # Two rows [2 c; c 1] q̈ = r, with c the cosine of the difference of the angles, by Cramer's rule.
    s, c = jnp.sin(q[0] - q[1]), jnp.cos(q[0] - q[1])
    r1 = -s * v[1] ** 2 - 2 * GRAVITY * jnp.sin(q[0])
    r2 = s * v[0] ** 2 - GRAVITY * jnp.sin(q[1])
    determinant = 2 - c * c
    return (r1 - c * r2) / determinant, (2 * r2 - c * r1) / determinant


def chain(links: int, batch: int = 1024) -> Case:
    rng = np.random.default_rng(links)
    scene = scenes.chain(links)
    params = {"m": np.ones(links), "l": np.ones(links), "g": GRAVITY}

    def symbolic(ops, q, v):
        vx = vy = y = total = 0
        for angle, rate in zip(q, v, strict=True):
            vx, vy, y = vx + ops.cos(angle) * rate, vy + ops.sin(angle) * rate, y - ops.cos(angle)
            total = total + 0.5 * (vx**2 + vy**2) - GRAVITY * y
        return total

    return Case(
        name=f"chain_{links}",
        scene=with_params(scene, params),
        q0=rng.uniform(-0.6, 0.6, (batch, links)),
        qdot0=np.zeros((batch, links)),
        duration=5.0,
        symbolic=symbolic,
        acceleration=_chain_acceleration,
        long_formulas=links > 6,
    )


def _chain_acceleration(q, v):
    # M_ij = N_ij cos(θi − θj), where N_ij counts the masses that hang below both joints.
    q, v = jnp.asarray(q), jnp.asarray(v)
    n = len(q)
    below = n - np.maximum.outer(np.arange(n), np.arange(n))
    difference = q[:, None] - q[None, :]
    force = -(below * jnp.sin(difference)) @ v**2 - GRAVITY * below.diagonal() * jnp.sin(q)
    return jnp.linalg.solve(below * jnp.cos(difference), force)


def with_params(scene: scenes.Scene, params: dict) -> scenes.Scene:
    """The scene with other numbers."""
    return scenes.Scene(scene.system, params, scene.q0, scene.qdot0, scene.duration, scene.invariants, scene.exact)


def wedge(batch: int = 1024) -> Case:
    """A constant mass matrix and constant accelerations: any solver is exact, so this is the cost of a step."""
    scene, rng = scenes.wedge(), np.random.default_rng(1)
    M, m, g, alpha = (scene.params[name] for name in ("M", "m", "g", "alpha"))
    tan = float(np.tan(alpha))

    def symbolic(ops, q, v):
        kinetic = 0.5 * (M + m) * v[0] ** 2 + m * v[0] * v[1] + 0.5 * m * (1 + tan**2) * v[1] ** 2
        return kinetic - m * g * tan * q[1]

    push = float(g * np.sin(alpha) * np.cos(alpha) / (M + m * np.sin(alpha) ** 2))
    return Case(
        name="wedge",
        scene=scene,
        q0=rng.uniform(0.5, 2.0, (batch, 2)),
        qdot0=rng.uniform(-1.0, 1.0, (batch, 2)),
        duration=5.0,
        symbolic=symbolic,
        acceleration=lambda q, v: (jnp.full_like(q[0], m * push), jnp.full_like(q[1], -(M + m) * push)),
    )


def kepler(batch: int = 1024, eccentricity: float = 0.9) -> Case:
    """One period from a random place on the ellipse: steps differ a thousandfold in size, and lanes wait."""
    scene, e, rng = scenes.kepler(eccentricity), eccentricity, np.random.default_rng(2)
    E = rng.uniform(0, 2 * np.pi, batch)
    b, r = np.sqrt(1 - e**2), 1 - e * np.cos(E)

    def acceleration(q, v):
        r_squared = q[0] * q[0] + q[1] * q[1]
        factor = -1 / (r_squared * jnp.sqrt(r_squared))
        return factor * q[0], factor * q[1]

    return Case(
        name="kepler",
        scene=scene,
        q0=np.stack([np.cos(E) - e, b * np.sin(E)], axis=1),
        qdot0=np.stack([-np.sin(E) / r, b * np.cos(E) / r], axis=1),
        duration=2 * np.pi,
        symbolic=lambda ops, q, v: 0.5 * (v[0] ** 2 + v[1] ** 2) + 1 / ops.sqrt(q[0] ** 2 + q[1] ** 2),
        acceleration=acceleration,
    )


def outer_planets(batch: int = 1024) -> Case:
    """Sun and giant planets from DE421, for about one orbit of Jupiter; members differ by 1e-3 in their velocities.

    Every Lagrangian here is multiplied by G, and the states are in AU and days.
    """
    de421, rng = scenes.de421, np.random.default_rng(3)
    bodies = [de421.BODIES.index(name) for name in ("sun", "jupiter", "saturn", "uranus", "neptune")]
    GM, x, v = de421.GM[bodies], de421.POSITIONS[bodies], de421.VELOCITIES[bodies]

    def symbolic(ops, q, v):
        total = 0
        for a, mass in enumerate(GM.tolist()):
            total = total + 0.5 * mass * sum(v[3 * a + axis] ** 2 for axis in range(3))
            for b in range(a):
                squared = sum((q[3 * a + axis] - q[3 * b + axis]) ** 2 for axis in range(3))
                total = total + mass * float(GM[b]) / ops.sqrt(squared)
        return total

    def acceleration(q, v):
        x = jnp.asarray(q).reshape(5, 3)
        r = x[None, :] - x[:, None]
        squared = jnp.sum(r**2, axis=-1) + np.eye(5)
        return jnp.einsum("ab,abk->ak", GM / (squared * jnp.sqrt(squared)), r).ravel()

    return Case(
        name="outer_planets",
        scene=scenes.n_body(GM, x, v, duration=4000.0),
        q0=np.tile(x.ravel(), (batch, 1)),
        qdot0=v.ravel() * (1 + 1e-3 * rng.uniform(-1, 1, (batch, 15))),
        duration=4000.0,
        symbolic=symbolic,
        acceleration=acceleration,
    )


def fermi_pasta_ulam(batch: int = 1024, springs: int = 16) -> Case:
    """The chain of Hairer, Lubich & Wanner, §I.5.1, with 32 masses instead of 6: many coordinates, sparse forces."""
    scene, rng = scenes.fermi_pasta_ulam(), np.random.default_rng(4)
    omega, n = float(scene.params["omega"]), springs
    zeros = scenes.SlowAndFast(np.zeros(n), np.zeros(n))

    def symbolic(ops, q, v):
        left = [slow - fast for slow, fast in zip(q[:n], q[n:], strict=True)]
        right = [slow + fast for slow, fast in zip(q[:n], q[n:], strict=True)]
        soft = left[0] ** 4 + right[-1] ** 4 + sum((left[i + 1] - right[i]) ** 4 for i in range(n - 1))
        return 0.5 * sum(rate**2 for rate in v) - 0.5 * omega**2 * sum(x**2 for x in q[n:]) - 0.25 * soft

    def acceleration(q, v):
        slow, fast = jnp.asarray(q).reshape(2, n)
        left, right = slow - fast, slow + fast
        cubes = jnp.concatenate([left[:1], left[1:] - right[:-1], -right[-1:]]) ** 3
        return jnp.concatenate([cubes[1:] - cubes[:-1], cubes[1:] + cubes[:-1] - omega**2 * fast])

    stretch = np.repeat([0.5, 1 / omega], n)
    return Case(
        name=f"fermi_pasta_ulam_{2 * n}",
        scene=scenes.Scene(scene.system, scene.params, zeros, zeros, 2.0, {}),
        q0=stretch * rng.uniform(-1, 1, (batch, 2 * n)),
        qdot0=rng.uniform(-1, 1, (batch, 2 * n)),
        duration=2.0,
        symbolic=symbolic,
        acceleration=acceleration,
    )


def spherical_pendulum(batch: int = 1024) -> Case:
    scene, rng = scenes.spherical_pendulum(), np.random.default_rng(5)

    def acceleration(q, v):
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        return s * (c * v[1] ** 2 - GRAVITY), -2 * v[0] * v[1] * c / s

    return Case(
        name="spherical_pendulum",
        scene=scene,
        q0=np.stack([rng.uniform(0.5, 1.5, batch), rng.uniform(-3, 3, batch)], axis=1),
        qdot0=np.stack([rng.uniform(-1, 1, batch), rng.uniform(1.5, 3.0, batch)], axis=1),
        duration=5.0,
        symbolic=lambda ops, q, v: 0.5 * (v[0] ** 2 + ops.sin(q[0]) ** 2 * v[1] ** 2) + GRAVITY * ops.cos(q[0]),
        acceleration=acceleration,
    )


def bodies(count: int, batch: int = 8) -> Case:
    """The cluster of `_large.bodies`; members differ by 1e-3 in their velocities."""
    system, x, v, params = _large.bodies(count)
    m, rng = params["m"], np.random.default_rng(6)

    def acceleration(q, qdot):
        x = jnp.asarray(q).reshape(count, 3)
        r = x[None, :] - x[:, None]
        squared = jnp.sum(r**2, axis=-1) + _large.SOFTENING**2
        return jnp.einsum("ab,abk->ak", m / (squared * jnp.sqrt(squared)), r).ravel()

    def equations(hy, q, v):
        parts: list[list] = [[] for _ in q]
        for a in range(count):
            for b in range(a):
                r = [q[3 * b + axis] - q[3 * a + axis] for axis in range(3)]
                inverse = hy.sum([*(d**2 for d in r), hy.expression(_large.SOFTENING**2)]) ** -1.5
                for axis, d in enumerate(r):
                    parts[3 * a + axis].append(float(m[b]) * d * inverse)
                    parts[3 * b + axis].append(-float(m[a]) * d * inverse)
        return [hy.sum(part) for part in parts]

    return Case(
        name=f"bodies_{count}",
        scene=scenes.Scene(system, params, x, v, 2.0, {}),
        q0=np.tile(x.ravel(), (batch, 1)),
        qdot0=v.ravel() * (1 + 1e-3 * rng.uniform(-1, 1, (batch, v.size))),
        duration=2.0,
        symbolic=None,
        acceleration=acceleration,
        equations=equations,
        long_formulas=True,
    )


CASES = {
    "double_pendulum": double_pendulum,
    "chain_4": lambda batch=1024: chain(4, batch),
    "chain_8": lambda batch=1024: chain(8, batch),
    "wedge": wedge,
    "kepler": kepler,
    "outer_planets": outer_planets,
    "fermi_pasta_ulam": fermi_pasta_ulam,
    "spherical_pendulum": spherical_pendulum,
    "chain_16": lambda batch=1024: chain(16, max(1, batch // 4)),  # the longest
}
