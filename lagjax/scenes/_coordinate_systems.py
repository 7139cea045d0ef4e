"""Coordinates of one particle, named so that a Lagrangian reads as in a textbook: `q.rho**2 * qdot.phi**2`.

The velocity is the same class as the position: `qdot.phi` is the rate of change of `q.phi`.
Each class knows the square of the speed, the distance from the origin, and its way to and from Cartesian coordinates.
"""

from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

__all__ = ["Cartesian", "Cylindrical", "Polar", "Spherical", "convert"]


class Cartesian(NamedTuple):
    """Cartesian coordinates (x, y, z) of a particle."""

    x: ArrayLike
    y: ArrayLike
    z: ArrayLike

    def speed_squared(self, qdot: Self):
        """v² = ẋ² + ẏ² + ż²"""
        return qdot.x**2 + qdot.y**2 + qdot.z**2

    def distance(self):
        return jnp.sqrt(self.x**2 + self.y**2 + self.z**2)

    def cartesian(self):
        return self

    @classmethod
    def from_cartesian(cls, point):
        return point


class Polar(NamedTuple):
    """Polar coordinates (rho, phi) in the plane z = 0: x = ρ cos φ, y = ρ sin φ."""

    rho: ArrayLike
    phi: ArrayLike

    def speed_squared(self, qdot: Self):
        """v² = ρ̇² + ρ² φ̇²"""
        return qdot.rho**2 + self.rho**2 * qdot.phi**2

    def distance(self):
        return self.rho

    def cartesian(self):
        return Cartesian(self.rho * jnp.cos(self.phi), self.rho * jnp.sin(self.phi), jnp.zeros_like(self.rho))

    @classmethod
    def from_cartesian(cls, point):
        return cls(jnp.hypot(point.x, point.y), jnp.arctan2(point.y, point.x))


class Cylindrical(NamedTuple):
    """Cylindrical coordinates (rho, phi, z): x = ρ cos φ, y = ρ sin φ."""

    rho: ArrayLike
    phi: ArrayLike
    z: ArrayLike

    def speed_squared(self, qdot: Self):
        """v² = ρ̇² + ρ² φ̇² + ż²"""
        return qdot.rho**2 + self.rho**2 * qdot.phi**2 + qdot.z**2

    def distance(self):
        return jnp.sqrt(self.rho**2 + self.z**2)

    def cartesian(self):
        return Cartesian(self.rho * jnp.cos(self.phi), self.rho * jnp.sin(self.phi), self.z)

    @classmethod
    def from_cartesian(cls, point):
        return cls(jnp.hypot(point.x, point.y), jnp.arctan2(point.y, point.x), point.z)


class Spherical(NamedTuple):
    """Spherical coordinates (r, theta, phi), θ from the z axis: x = r sin θ cos φ, y = r sin θ sin φ, z = r cos θ."""

    r: ArrayLike
    theta: ArrayLike
    phi: ArrayLike

    def speed_squared(self, qdot: Self):
        """v² = ṙ² + r² θ̇² + r² sin²θ φ̇²"""
        return qdot.r**2 + self.r**2 * qdot.theta**2 + (self.r * jnp.sin(self.theta) * qdot.phi) ** 2

    def distance(self):
        return self.r

    def cartesian(self):
        rho = self.r * jnp.sin(self.theta)
        return Cartesian(rho * jnp.cos(self.phi), rho * jnp.sin(self.phi), self.r * jnp.cos(self.theta))

    @classmethod
    def from_cartesian(cls, point):
        rho = jnp.hypot(point.x, point.y)
        return cls(jnp.hypot(rho, point.z), jnp.arctan2(rho, point.z), jnp.arctan2(point.y, point.x))


def convert(q, qdot, coordinates):
    """The state (q, qdot) in other `coordinates`, one of these classes; angles are principal values.

    Into `Polar` the state is projected on the plane z = 0. On the z axis the curvilinear charts are singular: nan.

    >>> q, qdot = lagjax.scenes.convert(Cartesian(1.0, 0.0, 1.0), Cartesian(0.0, 2.0, 0.0), Spherical)
    """
    return jax.jvp(lambda q: coordinates.from_cartesian(q.cartesian()), (q,), (qdot,))


def angular_momentum_z(q, qdot):
    """The angular momentum per unit mass x ẏ − y ẋ of a state in any of these coordinates."""
    (x, y, _), (vx, vy, _) = convert(q, qdot, Cartesian)
    return x * vy - y * vx
