"""The systems that several test files share: each is derived, and compiled for one call, once for all of them.

A test takes one of these where any system of its kind serves; a Lagrangian that it needs of its own stands at the top
of its file. The scenes that lagjax offers are `lagjax.scenes`.
"""

import jax.numpy as jnp
import lagrangians as of

from lagjax import System

FREE = System(of.free_particle)
FREE_POINTS = System(of.free_particles)
OSCILLATOR = System(of.oscillator)
OSCILLATORS = System(of.oscillators)
DAMPED_OSCILLATOR = System(of.oscillator, dissipation=lambda q, qdot: 0.1 * qdot**2)
SPRING = System(of.spring)
SPRING_K = System(of.spring_k)
PENDULUM = System(of.pendulum)
PENDULUM_G = System(of.pendulum_g)
PENDULUM_IN_GRAVITY = System(of.pendulum_in_gravity)
BALL = System(of.ball)
BALL_G = System(of.ball_g)
BALL_IN_GRAVITY = System(of.ball_in_gravity)
BALL_ON_THE_FLOOR = System(of.ball_in_gravity, constraints=lambda q: q)
RAMP = System(of.ramp)
WEIGHT = System(of.weight)
# Drawn along a sine in time.
WEIGHT_ON_A_SLIDE = System(of.weight, constraints=lambda q, t: q[0] - jnp.sin(t))
KEPLER = System(of.kepler)
RADIAL_FALL = System(of.radial_fall)
HENON_HEILES = System(lambda q, qdot: 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(q**2) - q[0] ** 2 * q[1] + q[1] ** 3 / 3)
VALLEY = System(lambda q, qdot: 0.5 * qdot**2 - jnp.abs(q))  # a corner at 0
HILL = System(lambda q, qdot: 0.5 * qdot**2 + 0.25 * q**4)  # to infinity in a finite time
EDGE = System(lambda q, qdot: 0.5 * qdot**2 - jnp.sqrt(q))  # ends at 0
CLIFF = System(lambda q, qdot, params: 0.5 * qdot**2 - params * q - jnp.where(q < -1.0, jnp.log(q + 1.0), 0.0))
RELAY = System(of.free_particle, forces=lambda q, qdot: -jnp.sign(q + qdot))  # slides along q + q̇ = 0
SADDLE = System(lambda q, qdot: qdot[0] * qdot[1] - q[0] * q[1])  # a mass of both signs


# Where a test is about a force, a potential or what holds a body, those alone are its own.


def particle(forces, **more):
    """A free particle under a force."""
    return System(of.free_particle, forces=forces, **more)


def particles(forces=None, **more):
    """Free particles under forces, between walls, or held."""
    return System(of.free_particles, forces=forces, **more)


def in_potential(potential, **more):
    """Particles of unit mass in V(q), or one."""
    return System(lambda q, qdot: 0.5 * jnp.sum(qdot**2) - potential(q), **more)


def weight_on(**held):
    """A weight in the plane, and what holds it."""
    return System(of.weight, **held)
