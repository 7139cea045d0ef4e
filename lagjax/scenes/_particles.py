"""Particles in potentials: L = T − U in the coordinates of the textbooks.

A potential is a plain function with the parameters as its last argument: `U(x, params)`, `U(r, params)`.
Pass the same function object again and the scene has an equal `System`, which is compiled once.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._scene import System
from lagjax.scenes._coordinate_systems import Cartesian, Polar, angular_momentum_z, convert
from lagjax.scenes._scene import Scene, components, conservative_scene, total_momentum

__all__ = [
    "bead_on_rotating_hoop", "central_force", "free_particle", "harmonic_oscillator", "morse_oscillator",
    "one_dimension", "particle_in_potential", "particles", "uniform_gravity",
]  # fmt: skip


def _free_particle_lagrangian(q, qdot, params):
    return 0.5 * params["m"] * q.speed_squared(qdot)


def _free_particle_exact(t, q0, qdot0, params):
    return Cartesian(*(x + v * t for x, v in zip(q0, qdot0, strict=True))), qdot0


def free_particle() -> Scene:
    """A free particle, L = ½ m (ẋ² + ẏ² + ż²); `Cartesian` coordinates.

    A straight line at constant velocity. Landau & Lifshitz, Mechanics, §4.

    >>> scene = lagjax.scenes.free_particle(); scene.system.momentum(scene.q0, scene.qdot0, params=scene.params)
    """
    system, q0, qdot0 = System(_free_particle_lagrangian), Cartesian(1.0, -2.0, 0.5), Cartesian(0.3, 0.7, -1.1)
    more = components("p", system.momentum)
    return conservative_scene(system, {"m": 2.0}, q0, qdot0, duration=10.0, more=more, exact=_free_particle_exact)


def _uniform_gravity_lagrangian(q, qdot, params):
    m, g = params["m"], params["g"]
    return 0.5 * m * (qdot.x**2 + qdot.y**2 + qdot.z**2) - m * g * q.z


def _uniform_gravity_exact(t, q0, qdot0, params):
    g = params["g"]
    q = Cartesian(q0.x + qdot0.x * t, q0.y + qdot0.y * t, q0.z + qdot0.z * t - 0.5 * g * t**2)
    return q, Cartesian(qdot0.x, qdot0.y, qdot0.z - g * t)


def uniform_gravity() -> Scene:
    """A projectile, L = ½ m (ẋ² + ẏ² + ż²) − m g z; `Cartesian` coordinates, metres and seconds.

    x and y are cyclic, the path is a parabola. Goldstein, Classical Mechanics, §1.4.

    >>> scene = lagjax.scenes.uniform_gravity(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system, params = System(_uniform_gravity_lagrangian), {"m": 0.145, "g": 9.81}
    q0, qdot0 = Cartesian(0.0, 0.0, 1.8), Cartesian(20.0, 3.0, 15.0)
    more = components("p", system.momentum, "xy")
    return conservative_scene(system, params, q0, qdot0, duration=3.0, more=more, exact=_uniform_gravity_exact)


class _OneDimensionScene(eqx.Module):
    potential: Callable = eqx.field(static=True)

    def __call__(self, q, qdot, params):
        return 0.5 * params["m"] * qdot**2 - self.potential(q, params)


def double_well(x, params):
    """U = −½ a x² + ¼ b x⁴"""
    return -0.5 * params["a"] * x**2 + 0.25 * params["b"] * x**4


def one_dimension(potential=double_well, *, q0=0.1, qdot0=0.0, params=None) -> Scene:
    """A particle on a line, L = ½ m ẋ² − U(x), with your `potential(x, params)`; q is a scalar.

    Without a potential of your own: the double well, started near its top. Landau & Lifshitz, Mechanics, §11.

    >>> scene = lagjax.scenes.one_dimension(lambda x, params: jnp.cosh(x), params={"m": 1.0})
    """
    params = {"m": 1.0, "a": 1.0, "b": 1.0} if params is None else params
    return conservative_scene(System(_OneDimensionScene(potential)), params, q0, qdot0, duration=20.0)


def morse(x, params):
    """U = D (1 − exp(−a x))²"""
    return params["D"] * (1 - jnp.exp(-params["a"] * x)) ** 2


def _morse_exact(t, q0, qdot0, params):
    # exp(a x) swings harmonically about its mean: exp(a x) = (1 − √ε cos(w t + δ))/(1 − ε), with ε = E/D < 1.
    m, D, a = params["m"], params["D"], params["a"]
    bound = 1 - (0.5 * m * qdot0**2 + morse(q0, params)) / D
    w = a * jnp.sqrt(2 * D * bound / m)
    s0 = jnp.exp(a * q0)
    c, s = s0 - 1 / bound, a * qdot0 * s0 / w
    stretch = 1 / bound + c * jnp.cos(w * t) + s * jnp.sin(w * t)
    return jnp.log(stretch) / a, w * (s * jnp.cos(w * t) - c * jnp.sin(w * t)) / (a * stretch)


def morse_oscillator() -> Scene:
    """A diatomic bond, L = ½ m ẋ² − D (1 − exp(−a x))²; q is a scalar, the stretch of the bond.

    The closed solution holds below dissociation, E < D. P. M. Morse, Physical Review 34, 57 (1929).

    >>> scene = lagjax.scenes.morse_oscillator(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system, params = System(_OneDimensionScene(morse)), {"m": 1.0, "D": 1.0, "a": 1.0}
    return conservative_scene(system, params, q0=1.2, qdot0=0.3, duration=20.0, exact=_morse_exact)


class _ParticleInPotential(eqx.Module):
    potential: Callable = eqx.field(static=True)

    def __call__(self, q, qdot, params):
        return 0.5 * params["m"] * q.speed_squared(qdot) - self.potential(q, params)


def harmonic_potential(q, params):
    """U = ½ k r², in any coordinates."""
    return 0.5 * params["k"] * q.distance() ** 2


def anisotropic_well(q, params):
    """U = ½ (k_x x² + k_y y² + k_z z²) + ¼ b r⁴, in any coordinates."""
    (x, y, z), k = q.cartesian(), params["k"]
    r_squared = x**2 + y**2 + z**2
    return 0.5 * (k[0] * x**2 + k[1] * y**2 + k[2] * z**2) + 0.25 * params["b"] * r_squared**2


def particle_in_potential(potential=anisotropic_well, *, q0=None, qdot0=None, params=None) -> Scene:
    """A particle in space, L = ½ m v² − U(q), with your `potential(q, params)` in the coordinates of q0:

    - `Cartesian`    v² = ẋ² + ẏ² + ż²
    - `Polar`        v² = ρ̇² + ρ² φ̇²
    - `Cylindrical`  v² = ρ̇² + ρ² φ̇² + ż²
    - `Spherical`    v² = ṙ² + r² θ̇² + r² sin²θ φ̇²

    Without a potential of your own: a well without any symmetry axis. Landau & Lifshitz, Mechanics, (4.4)–(4.6).

    >>> start = lagjax.scenes.Cylindrical(1.0, 0.0, 0.5)
    >>> scene = lagjax.scenes.particle_in_potential(q0=start, qdot0=lagjax.scenes.Cylindrical(0.0, 1.0, 0.2))
    """
    params = {"m": 1.0, "k": np.array([1.0, 2.0, 3.0]), "b": 0.5} if params is None else params
    q0, qdot0 = Cartesian(1.0, 0.2, 0.5) if q0 is None else q0, Cartesian(-0.2, 0.9, 0.4) if qdot0 is None else qdot0
    return conservative_scene(System(_ParticleInPotential(potential)), params, q0, qdot0, duration=10.0)


def _harmonic_exact(t, q0, qdot0, params):
    x0, v0 = convert(q0, qdot0, Cartesian)
    w = jnp.sqrt(params["k"] / params["m"])
    c, s = jnp.cos(w * t), jnp.sin(w * t)
    x = Cartesian(*(x * c + v * s / w for x, v in zip(x0, v0, strict=True)))
    v = Cartesian(*(v * c - x * s * w for x, v in zip(x0, v0, strict=True)))
    return convert(x, v, type(q0))


def harmonic_oscillator(coordinates=Cartesian) -> Scene:
    """The isotropic oscillator, L = ½ m v² − ½ k r², in any of the coordinate classes.

    An ellipse about the origin, of period 2π √(m/k). Landau & Lifshitz, Mechanics, §23, problem 3.

    >>> scene = lagjax.scenes.harmonic_oscillator(lagjax.scenes.Spherical)
    """
    system, params = System(_ParticleInPotential(harmonic_potential)), {"m": 2.0, "k": 3.0}
    q0, qdot0 = convert(Cartesian(1.0, 0.2, 0.5), Cartesian(-0.2, 0.9, 0.4), coordinates)
    period, more = 2 * np.pi * np.sqrt(params["m"] / params["k"]), {"angular_momentum": _angular_momentum}
    return conservative_scene(system, params, q0, qdot0, period, more, _harmonic_exact)


def _angular_momentum(q, qdot, t, params):
    return params["m"] * angular_momentum_z(q, qdot)


class _CentralForce(eqx.Module):
    potential: Callable = eqx.field(static=True)

    def __call__(self, q, qdot, params):
        return 0.5 * params["m"] * q.speed_squared(qdot) - self.potential(q.distance(), params)


def yukawa(r, params):
    """U = −(k/r) exp(−r/a)"""
    return -params["k"] / r * jnp.exp(-r / params["a"])


def central_force(potential=yukawa, coordinates=Polar, *, params=None) -> Scene:
    """A central force, L = ½ m v² − U(r), with your `potential(r, params)`; in the plane L = ½ m (ρ̇² + ρ² φ̇²) − U(ρ).

    `coordinates` is `Polar`, `Cylindrical`, `Spherical` or `Cartesian`. φ is cyclic: p_φ = m ρ² φ̇ is constant, and
    m ρ̈ = p_φ²/(m ρ³) − U'(ρ). Without a potential of your own: Yukawa's, whose orbit is a rosette.
    Landau & Lifshitz, Mechanics, §14.

    >>> scene = lagjax.scenes.central_force(lambda r, params: -params["k"] / r, params={"m": 1.0, "k": 1.0})
    """
    q0, qdot0 = convert(Cartesian(1.0, 0.2, 0.5), Cartesian(-0.2, 0.7, 0.3), coordinates)
    params = {"m": 1.0, "k": 1.0, "a": 5.0} if params is None else params
    more = {"angular_momentum": _angular_momentum}
    return conservative_scene(System(_CentralForce(potential)), params, q0, qdot0, duration=20.0, more=more)


class _Particles(eqx.Module):
    one_body: Callable | None = eqx.field(static=True)
    two_body: Callable | None = eqx.field(static=True)

    def __call__(self, q, qdot, params):
        lagrangian = 0.5 * jnp.sum(params["m"] * jnp.sum(qdot**2, axis=1))
        if self.one_body is not None:
            lagrangian -= jnp.sum(jax.vmap(self.one_body, (0, None))(q, params))
        if self.two_body is not None:
            n, other = np.triu_indices(len(q), k=1)
            lagrangian -= jnp.sum(jax.vmap(self.two_body, (0, None))(q[n] - q[other], params))
        return lagrangian


def quartic_spring(separation, params):
    """U2 = ½ k d² + ¼ b d⁴, with d² = |separation|²"""
    d_squared = jnp.sum(separation**2)
    return 0.5 * params["k"] * d_squared + 0.25 * params["b"] * d_squared**2


def particles(one_body=None, two_body=quartic_spring, *, q0=None, qdot0=None, params=None) -> Scene:
    """N interacting particles, L = Σ ½ m_n v_n² − Σ U1(x_n) − Σ_{n<n'} U2(x_n − x_n'); q is an (N, 3) array.

    `one_body(x, params)` and `two_body(separation, params)` take vectors of length 3; either may be None.
    Without an outer potential U1 the total momentum is constant. Landau & Lifshitz, Mechanics, §5.

    >>> scene = lagjax.scenes.particles(one_body=lambda x, params: 9.81 * x[2], two_body=None)
    """
    system = System(_Particles(one_body, two_body))
    params = {"m": np.array([1.0, 2.0, 3.0]), "k": 1.0, "b": 0.5} if params is None else params
    q0 = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.2, 1.0]]) if q0 is None else q0
    qdot0 = np.array([[0.0, 0.5, 0.0], [0.3, 0.0, 0.2], [0.0, -0.1, 0.4]]) if qdot0 is None else qdot0
    more = components("p", total_momentum(system)) if one_body is None else None
    return conservative_scene(system, params, q0, qdot0, duration=10.0, more=more)


def _rotating_hoop_lagrangian(q, qdot, params):
    m, R, g, Omega = params["m"], params["R"], params["g"], params["Omega"]
    return 0.5 * m * R**2 * (qdot**2 + Omega**2 * jnp.sin(q) ** 2) + m * g * R * jnp.cos(q)


def bead_on_rotating_hoop() -> Scene:
    """A bead on a hoop turned at a constant rate, L = ½ m R² (θ̇² + Ω² sin²θ) + m g R cos θ; θ from the lowest point.

    The hoop does work on the bead: h = θ̇ ∂L/∂θ̇ − L is constant, and T + U = h + m R² Ω² sin²θ is not.
    Goldstein, Classical Mechanics, §2.7 (the energy function h).

    >>> scene = lagjax.scenes.bead_on_rotating_hoop(); scene.system.energy(scene.q0, scene.qdot0, params=scene.params)
    """
    params = {"m": 1.0, "R": 1.0, "g": 9.81, "Omega": 5.0}
    return conservative_scene(System(_rotating_hoop_lagrangian), params, q0=0.3, qdot0=0.0, duration=10.0)
