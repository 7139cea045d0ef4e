"""Charges in electromagnetic fields, E = −∇φ − ∂A/∂t and B = ∇ × A. Positions are arrays (x, y, z); units with SI form.

The force depends on the velocity, and so does the momentum on the position: p = m v + e A.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lagjax._scene import System
from lagjax.scenes._scene import Scene, components, conservative_scene

__all__ = [
    "charge_in_fields", "charge_in_uniform_fields", "gyration", "relativistic_charge_in_electric_field",
    "relativistic_charge_in_magnetic_field",
]  # fmt: skip


class _ChargeInFields(eqx.Module):
    phi: Callable = eqx.field(static=True)
    A: Callable = eqx.field(static=True)

    def __call__(self, q, qdot, t, params):
        m, e = params["m"], params["e"]
        return 0.5 * m * qdot @ qdot - e * self.phi(q, t, params) + e * qdot @ self.A(q, t, params)


def no_potential(x, t, params):
    """φ = 0"""
    return jnp.zeros_like(x[0])


def plane_wave(x, t, params):
    """A = (E/ω) (0, cos(k x − ω t), 0): a linearly polarised wave along x."""
    y = params["E"] / params["omega"] * jnp.cos(params["k"] * x[0] - params["omega"] * t)
    return jnp.stack([jnp.zeros_like(y), y, jnp.zeros_like(y)])


def charge_in_fields(phi=no_potential, A=plane_wave, *, q0=None, qdot0=None, params=None) -> Scene:
    """A charge in any fields, L = ½ m v² − e φ(x, t) + e v·A(x, t), with your `phi(x, t, params)`, `A(x, t, params)`.

    The motion obeys Lorentz' force m a = e (E + v × B). Without fields of your own: a plane wave.
    Goldstein, Classical Mechanics, (1.63).

    >>> scene = lagjax.scenes.charge_in_fields(phi=lambda x, t, params: -x[0] * jnp.cos(t))
    """
    params = {"m": 1.0, "e": 1.0, "E": 0.5, "omega": 2.0, "k": 2.0} if params is None else params
    q0 = np.array([0.0, 0.0, 0.0]) if q0 is None else q0
    qdot0 = np.array([0.1, 0.2, 0.3]) if qdot0 is None else qdot0
    return Scene(System(_ChargeInFields(phi, A)), params, q0, qdot0, duration=10.0, invariants={})


def _uniform_fields_lagrangian(q, qdot, params):
    m, e, E, B = params["m"], params["e"], params["E"], params["B"]
    A = 0.5 * jnp.cross(B, q)
    return 0.5 * m * qdot @ qdot + e * E @ q + e * qdot @ A


def _uniform_fields_exact(t, q0, qdot0, params):
    m, e, E, B = params["m"], params["e"], params["E"], params["B"]
    strength = jnp.sqrt(B @ B)
    b, w = B / strength, e * strength / m
    drift = jnp.cross(E, B) / strength**2
    parallel, acceleration = b * (b @ qdot0), b * (b @ E) * e / m
    u = qdot0 - parallel - drift  # turns about b in the drifting frame
    turned = u * jnp.cos(w * t) + jnp.cross(u, b) * jnp.sin(w * t)
    q = q0 + (parallel + drift) * t + acceleration * t**2 / 2
    q = q + (u * jnp.sin(w * t) + jnp.cross(u, b) * (1 - jnp.cos(w * t))) / w
    return q, parallel + drift + acceleration * t + turned


def _pseudomomentum(q, qdot, t, params):
    m, e, E, B = params["m"], params["e"], params["E"], params["B"]
    return m * qdot + e * jnp.cross(B, q) - e * E * t


def charge_in_uniform_fields(E=(0.3, 0.0, 0.1), B=(0.0, 0.0, 2.0)) -> Scene:
    """A charge in uniform E and B, L = ½ m v² + e E·x + e v·A with A = ½ B × x.

    It gyrates at e B/m while its centre drifts with E × B/B² and falls along B. The pseudomomentum
    m v + e B × x − e E t is constant. Landau & Lifshitz, The Classical Theory of Fields, §22.

    >>> scene = lagjax.scenes.charge_in_uniform_fields(E=(1.0, 0.0, 0.0), B=(0.0, 0.0, 5.0))
    """
    system, m, e = System(_uniform_fields_lagrangian), 1.5, 1.0
    params = {"m": m, "e": e, "E": np.asarray(E, float), "B": np.asarray(B, float)}
    q0, qdot0 = np.array([1.0, 0.0, -0.5]), np.array([0.2, 1.0, 0.3])
    turn = 2 * np.pi * m / (e * float(np.linalg.norm(B)))
    more = components("pseudomomentum", _pseudomomentum)
    return conservative_scene(system, params, q0, qdot0, turn, more, _uniform_fields_exact)


def gyration() -> Scene:
    """A charge in a uniform magnetic field only: a helix about B, one turn in 2π m/(e B).

    L = ½ m v² + e v·A with A = ½ B × x. Landau & Lifshitz, The Classical Theory of Fields, §21.

    >>> scene = lagjax.scenes.gyration(); scene.exact(scene.duration, scene.q0, scene.qdot0, scene.params)
    """
    return charge_in_uniform_fields(E=(0.0, 0.0, 0.0), B=(0.0, 0.0, 2.0))


def _relativistic_lagrangian(q, qdot, params):
    m, e, c, E, B = params["m"], params["e"], params["c"], params["E"], params["B"]
    A = 0.5 * jnp.cross(B, q)
    return -m * c**2 * jnp.sqrt(1 - qdot @ qdot / c**2) + e * E @ q + e * qdot @ A


def _lorentz_factor(qdot, c):
    return 1 / jnp.sqrt(1 - qdot @ qdot / c**2)


def _relativistic_electric_exact(t, q0, qdot0, params):
    # The momentum grows as p0 + e E t; the velocity is c² p/ε, integrated along the force and across it.
    m, e, c, E = params["m"], params["e"], params["c"], params["E"]
    force = e * E
    strength = jnp.sqrt(force @ force)
    n = force / strength
    p0 = _lorentz_factor(qdot0, c) * m * qdot0
    across = p0 - n * (n @ p0)
    rest = jnp.sqrt(m**2 * c**4 + c**2 * across @ across)
    rapidity0, rapidity = jnp.arcsinh(c * (n @ p0) / rest), jnp.arcsinh(c * (n @ p0 + strength * t) / rest)
    q = q0 + n * rest * (jnp.cosh(rapidity) - jnp.cosh(rapidity0)) / strength
    q = q + across * c * (rapidity - rapidity0) / strength
    return q, c**2 * (p0 + force * t) / (rest * jnp.cosh(rapidity))


def relativistic_charge_in_electric_field() -> Scene:
    """A relativistic charge in a uniform electric field, L = −m c² √(1 − v²/c²) + e E·x.

    Hyperbolic motion: from rest x = (√(1 + (e E t/m c)²) − 1) m c²/(e E). Units m = e = c = 1, E = 3.
    Landau & Lifshitz, The Classical Theory of Fields, (16.4) and §20.

    >>> scene = lagjax.scenes.relativistic_charge_in_electric_field()
    """
    system, rest = System(_relativistic_lagrangian), np.zeros(3)
    params = {"m": 1.0, "e": 1.0, "c": 1.0, "E": np.array([3.0, 0.0, 0.0]), "B": np.zeros(3)}
    return conservative_scene(system, params, rest, rest, duration=10.0, exact=_relativistic_electric_exact)


def _relativistic_magnetic_exact(t, q0, qdot0, params):
    # The speed is constant: a Newtonian gyration of the mass γ m.
    heavy = params | {"m": params["m"] * _lorentz_factor(qdot0, params["c"])}
    return _uniform_fields_exact(t, q0, qdot0, heavy)


def relativistic_charge_in_magnetic_field() -> Scene:
    """A relativistic charge in a uniform magnetic field, L = −m c² √(1 − v²/c²) + e v·A with A = ½ B × x.

    A helix like the slow one, at the gyrofrequency e B/(γ m). Landau & Lifshitz, The Classical Theory of Fields, §21.

    >>> scene = lagjax.scenes.relativistic_charge_in_magnetic_field()
    """
    system = System(_relativistic_lagrangian)
    params = {"m": 1.0, "e": 1.0, "c": 1.0, "E": np.zeros(3), "B": np.array([0.0, 0.0, 2.0])}
    q0, qdot0 = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.9, 0.3])
    more = {"speed_squared": lambda q, qdot, t, params: qdot @ qdot}
    return conservative_scene(system, params, q0, qdot0, duration=20.0, exact=_relativistic_magnetic_exact, more=more)
