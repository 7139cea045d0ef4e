"""The Lagrangians that several test files share; a number that is not in the formula is 1.

A name in the plural takes any number of coordinates. A name that ends with a letter takes that one number as `params`;
where a docstring lists letters in braces, `params` is a dictionary of them.
"""

import jax.numpy as jnp


def free_particle(q, qdot):
    """½ q̇²"""
    return 0.5 * qdot**2


def free_particles(q, qdot):
    """½ Σ q̇²"""
    return 0.5 * jnp.sum(qdot**2)


def oscillator(q, qdot):
    """½ q̇² − ½ q²"""
    return 0.5 * qdot**2 - 0.5 * q**2


def oscillators(q, qdot):
    """½ Σ q̇² − ½ Σ q²"""
    return 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(q**2)


def spring(q, qdot, params):
    """½ q̇² − ½ k q², {k}"""
    return 0.5 * qdot**2 - 0.5 * params["k"] * q**2


def spring_k(q, qdot, params):
    """½ q̇² − ½ k q²"""
    return 0.5 * qdot**2 - 0.5 * params * q**2


def mass_on_a_spring(q, qdot, params):
    """½ m q̇² − ½ k q², {m, k}"""
    return 0.5 * params["m"] * qdot**2 - 0.5 * params["k"] * q**2


def damping(q, qdot, params):
    """½ c q̇², {c}: a dissipation, beside a Lagrangian."""
    return 0.5 * params["c"] * qdot**2


def pendulum(q, qdot):
    """½ q̇² + cos q"""
    return 0.5 * qdot**2 + jnp.cos(q)


def pendulum_g(q, qdot, params):
    """½ q̇² + g cos q"""
    return 0.5 * qdot**2 + params * jnp.cos(q)


def pendulum_in_gravity(q, qdot, params):
    """½ q̇² + g cos q, {g}"""
    return 0.5 * qdot**2 + params["g"] * jnp.cos(q)


def ball(q, qdot):
    """½ q̇² − 9.81 q"""
    return 0.5 * qdot**2 - 9.81 * q


def ball_g(q, qdot, params):
    """½ q̇² − g q"""
    return 0.5 * qdot**2 - params * q


def ball_in_gravity(q, qdot, params):
    """½ q̇² − g q, {g}"""
    return 0.5 * qdot**2 - params["g"] * q


def ramp(q, qdot):
    """½ q̇² − q: down a slope"""
    return 0.5 * qdot**2 - q


def weight(q, qdot):
    """½ |q̇|² − 9.81 y, y = q[1]"""
    return 0.5 * jnp.sum(qdot**2) - 9.81 * q[1]


def weight_g(q, qdot, params):
    """½ |q̇|² − g y, y = q[1]"""
    return 0.5 * jnp.sum(qdot**2) - params * q[1]


def weight_in_gravity(q, qdot, params):
    """½ |q̇|² − g y, y = q[1], {g}"""
    return 0.5 * jnp.sum(qdot**2) - params["g"] * q[1]


def radial_fall(q, qdot):
    """½ q̇² + 1/q: into the centre, from rest at 1 within π/√8"""
    return 0.5 * qdot**2 + 1 / q


def kepler(q, qdot):
    """½ |q̇|² + 1/|q|"""
    return 0.5 * jnp.sum(qdot**2) + 1 / jnp.sqrt(jnp.sum(q**2))
