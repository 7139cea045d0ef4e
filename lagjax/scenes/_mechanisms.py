"""Masses on wedges, rods, strings and springs. Angles in radians, from the downward vertical."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lagjax._scene import System
from lagjax.scenes._scene import Scene, conservative_scene

__all__ = [
    "Direction", "SlowAndFast", "Swing", "WedgeAndMass", "chain", "damped_driven_oscillator", "double_pendulum",
    "double_pendulum_frequencies", "driven_oscillator", "driven_pendulum", "fermi_pasta_ulam", "oscillatory_energies",
    "pendulum", "spherical_pendulum", "swinging_atwood", "wedge", "wedge_accelerations",
]  # fmt: skip


class WedgeAndMass(NamedTuple):
    """The position X of the wedge on the ground; the horizontal position x of the mass along the wedge."""

    X: ArrayLike
    x: ArrayLike


def _wedge_lagrangian(q, qdot, params):
    M, m, g, tan = params["M"], params["m"], params["g"], jnp.tan(params["alpha"])
    kinetic = 0.5 * (M + m) * qdot.X**2 + m * qdot.X * qdot.x + 0.5 * m * (1 + tan**2) * qdot.x**2
    return kinetic - m * g * q.x * tan


def wedge_accelerations(params):
    """ẍ = −(M+m) g sin α cos α/(M + m sin²α) and Ẍ = m g sin α cos α/(M + m sin²α), as a `WedgeAndMass`.

    >>> lagjax.scenes.wedge_accelerations({"M": 3.0, "m": 1.0, "g": 9.81, "alpha": 0.6})
    """
    M, m, g, sin, cos = params["M"], params["m"], params["g"], jnp.sin(params["alpha"]), jnp.cos(params["alpha"])
    acceleration = g * sin * cos / (M + m * sin**2)
    return WedgeAndMass(X=m * acceleration, x=-(M + m) * acceleration)


def _wedge_exact(t, q0, qdot0, params):
    a = wedge_accelerations(params)
    q = WedgeAndMass(q0.X + qdot0.X * t + 0.5 * a.X * t**2, q0.x + qdot0.x * t + 0.5 * a.x * t**2)
    return q, WedgeAndMass(qdot0.X + a.X * t, qdot0.x + a.x * t)


def wedge() -> Scene:
    """A mass m on a wedge M that slides without friction,

    L = ½ (M+m) Ẋ² + m Ẋ ẋ + ½ m (1 + tan²α) ẋ² − m g x tan α.

    X is cyclic and the mass matrix constant: both accelerations are constant. Goldstein, Classical Mechanics, ch. 1–2.

    >>> scene = lagjax.scenes.wedge(); scene.system.acceleration(scene.q0, scene.qdot0, params=scene.params)
    """
    system, params = System(_wedge_lagrangian), {"M": 3.0, "m": 1.0, "g": 9.81, "alpha": 0.6}
    q0, qdot0 = WedgeAndMass(0.0, 2.0), WedgeAndMass(0.0, 0.0)
    more = {"p_X": lambda q, qdot, t, params: (params["M"] + params["m"]) * qdot.X + params["m"] * qdot.x}
    return conservative_scene(system, params, q0, qdot0, duration=1.0, exact=_wedge_exact, more=more)


def _pendulum_lagrangian(q, qdot, params):
    m, l, g = params["m"], params["l"], params["g"]
    return 0.5 * m * l**2 * qdot**2 + m * g * l * jnp.cos(q)


def _jacobi_elliptic(u, m):
    """sn(u | m), cn(u | m), dn(u | m) for a parameter 0 ≤ m < 1, by descending Landen steps (DLMF §22.20(ii))."""
    steps = 7  # the arithmetic-geometric mean doubles its digits at each: enough for 1 − m down to 1e-16
    a, b = jnp.ones_like(m), jnp.sqrt(1 - m)
    ratios = []
    for _ in range(steps):
        ratios.append((a - b) / (a + b))
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    phi = 2**steps * a * u
    for ratio in reversed(ratios):
        phi = (phi + jnp.arcsin(ratio * jnp.sin(phi))) / 2
    return jnp.sin(phi), jnp.cos(phi), jnp.sqrt(1 - m * jnp.sin(phi) ** 2)


def _pendulum_exact(t, q0, qdot0, params):
    # sin(θ/2) = k sn(w t + u0 | k²) with cos(θ/2) = dn; the addition theorem (DLMF 22.8.1, 22.8.3) spares us u0.
    w = jnp.sqrt(params["g"] / params["l"])
    sin0, cos0, rate0 = jnp.sin(q0 / 2), jnp.cos(q0 / 2), qdot0 / (2 * w)
    m = sin0**2 + rate0**2
    sn, cn, dn = _jacobi_elliptic(w * t, m)
    denominator = 1 - (sin0 * sn) ** 2
    sine = (sin0 * cn * dn + rate0 * cos0 * sn) / denominator
    cosine = (cos0 * dn - sin0 * rate0 * sn * cn) / denominator
    rate = (rate0 * cn - sin0 * cos0 * sn * dn) / denominator
    return 2 * jnp.arctan2(sine, cosine), 2 * w * rate


def pendulum() -> Scene:
    """The plane pendulum, L = ½ m l² θ̇² + m g l cos θ; q is the scalar θ.

    The closed solution holds for swings: ½ l θ̇² < g (1 + cos θ). Landau & Lifshitz, Mechanics, §11, problem 1.

    >>> scene = lagjax.scenes.pendulum(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system, params = System(_pendulum_lagrangian), {"m": 1.0, "l": 1.0, "g": 9.81}
    return conservative_scene(system, params, q0=2.0, qdot0=1.0, duration=10.0, exact=_pendulum_exact)


def _double_pendulum_lagrangian(q, qdot, params):
    m1, m2, l1, l2, g = params["m1"], params["m2"], params["l1"], params["l2"], params["g"]
    (th1, th2), (w1, w2) = q, qdot
    kinetic = 0.5 * (m1 + m2) * l1**2 * w1**2 + m2 * l1 * l2 * jnp.cos(th1 - th2) * w1 * w2 + 0.5 * m2 * l2**2 * w2**2
    return kinetic + (m1 + m2) * g * l1 * jnp.cos(th1) + m2 * g * l2 * jnp.cos(th2)


def double_pendulum() -> Scene:
    """The plane double pendulum; q is the array (θ1, θ2), both angles from the vertical,

    L = ½ (m1+m2) l1² θ̇1² + m2 l1 l2 cos(θ1−θ2) θ̇1 θ̇2 + ½ m2 l2² θ̇2² + (m1+m2) g l1 cos θ1 + m2 g l2 cos θ2.

    Chaotic at large angles. Landau & Lifshitz, Mechanics, §5, problem 1.

    >>> scene = lagjax.scenes.double_pendulum(); scene.system.mass_matrix(scene.q0, scene.qdot0, params=scene.params)
    """
    params = {"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0, "g": 9.81}
    q0, qdot0 = np.array([1.0, 1.5]), np.array([0.0, 0.0])
    return conservative_scene(System(_double_pendulum_lagrangian), params, q0, qdot0, duration=10.0)


def double_pendulum_frequencies(params):
    """Angular frequencies of the small oscillations, the lower (in phase) first.

    ω² = ω0² [(1+β) ∓ √((1−β)² + 4αβ)]/(2β(1−α)), with α = m2/(m1+m2), β = l2/l1, ω0² = g/l1.

    >>> lagjax.scenes.double_pendulum_frequencies(lagjax.scenes.double_pendulum().params)
    """
    alpha, beta = params["m2"] / (params["m1"] + params["m2"]), params["l2"] / params["l1"]
    root = jnp.sqrt((1 - beta) ** 2 + 4 * alpha * beta)
    squares = params["g"] / params["l1"] * (1 + beta + jnp.stack([-root, root])) / (2 * beta * (1 - alpha))
    return jnp.sqrt(squares)


def _chain_lagrangian(q, qdot, params):
    m, l, g = params["m"], params["l"], params["g"]
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    y = -jnp.cumsum(l * jnp.cos(q))
    return jnp.sum(0.5 * m * (vx**2 + vy**2) - m * g * y)


def chain(n=3) -> Scene:
    """n pendulums hung one from another; q is the array of the n angles from the vertical,

    L = Σ ½ m_i (ẋ_i² + ẏ_i²) − m_i g y_i with x_i = Σ_{j≤i} l_j sin θ_j, y_i = −Σ_{j≤i} l_j cos θ_j.

    Total length and mass 1, horizontal at the start; n = 2 is the double pendulum. Landau & Lifshitz, Mechanics, §5.

    >>> scene = lagjax.scenes.chain(10); scene.system.energy(scene.q0, scene.qdot0, params=scene.params)
    """
    params = {"m": np.full(n, 1 / n), "l": np.full(n, 1 / n), "g": 9.81}
    return conservative_scene(System(_chain_lagrangian), params, q0=np.full(n, 1.0), qdot0=np.zeros(n), duration=2.0)


class Direction(NamedTuple):
    """A direction: the angle theta from the downward vertical, and the azimuth phi."""

    theta: ArrayLike
    phi: ArrayLike


def _spherical_pendulum_lagrangian(q, qdot, params):
    m, l, g = params["m"], params["l"], params["g"]
    return 0.5 * m * l**2 * (qdot.theta**2 + jnp.sin(q.theta) ** 2 * qdot.phi**2) + m * g * l * jnp.cos(q.theta)


def spherical_pendulum() -> Scene:
    """The spherical pendulum, L = ½ m l² (θ̇² + sin²θ φ̇²) + m g l cos θ; coordinates `Direction(theta, phi)`.

    φ is cyclic. The chart is singular at θ = 0 and π. Landau & Lifshitz, Mechanics, §14, problem 1.

    >>> scene = lagjax.scenes.spherical_pendulum(); scene.system.momentum(scene.q0, scene.qdot0, params=scene.params)
    """
    params, q0, qdot0 = {"m": 1.0, "l": 1.0, "g": 9.81}, Direction(1.0, 0.0), Direction(0.0, 2.0)
    more = {"p_phi": lambda q, qdot, t, params: params["m"] * (params["l"] * jnp.sin(q.theta)) ** 2 * qdot.phi}
    return conservative_scene(System(_spherical_pendulum_lagrangian), params, q0, qdot0, duration=10.0, more=more)


def _driven_pendulum_lagrangian(q, qdot, t, params):
    m, l, g, a, Omega = params["m"], params["l"], params["g"], params["a"], params["Omega"]
    height, lift = a * jnp.cos(Omega * t), -a * Omega * jnp.sin(Omega * t)
    kinetic = 0.5 * m * (l**2 * qdot**2 + 2 * l * qdot * lift * jnp.sin(q) + lift**2)
    return kinetic - m * g * (height - l * jnp.cos(q))


def driven_pendulum() -> Scene:
    """Kapitza's pendulum, its pivot shaken up and down as Y = a cos Ωt,

    L = ½ m (l² θ̇² + 2 l θ̇ Ẏ sin θ + Ẏ²) − m g (Y − l cos θ); q is the scalar θ.

    Upside down, θ = π, it is stable for a² Ω² > 2 g l, and started there. Landau & Lifshitz, Mechanics, §30.

    >>> scene = lagjax.scenes.driven_pendulum(); scene.system.energy(scene.q0, scene.qdot0, 0.1, scene.params)
    """
    params = {"m": 1.0, "l": 1.0, "g": 9.81, "a": 0.1, "Omega": 80.0}
    return Scene(System(_driven_pendulum_lagrangian), params, q0=3.0, qdot0=0.0, duration=3.0, invariants={})


def _driven_oscillator_lagrangian(q, qdot, t, params):
    return 0.5 * params["m"] * qdot**2 - 0.5 * params["k"] * q**2 + q * params["f"] * jnp.cos(params["omega"] * t)


def _friction(q, qdot, params):
    return 0.5 * params["c"] * qdot**2


def _driven_oscillator_exact(t, q0, qdot0, params):
    # The steady swing Re(X exp(iωt)), and the free decay of what the start differs from it.
    m, k, c, f, omega = (params[name] for name in ("m", "k", "c", "f", "omega"))
    amplitude = f / (k - m * omega**2 + 1j * c * omega)
    steady = amplitude * jnp.exp(1j * omega * t)
    x0, v0 = q0 - amplitude.real, qdot0 + omega * amplitude.imag
    decay, w = c / (2 * m), jnp.sqrt(k / m - (c / (2 * m)) ** 2)
    slope = (v0 + decay * x0) / w
    free = jnp.exp(-decay * t) * (x0 * jnp.cos(w * t) + slope * jnp.sin(w * t))
    free_rate = -decay * free + w * jnp.exp(-decay * t) * (slope * jnp.cos(w * t) - x0 * jnp.sin(w * t))
    return steady.real + free, -omega * steady.imag + free_rate


def driven_oscillator(damping=0.0) -> Scene:
    """A driven oscillator, L = ½ m ẋ² − ½ k x² + x f cos ωt, with the friction −c ẋ from the dissipation ½ c ẋ².

    q is a scalar, `damping` is c; the closed solution needs c² < 4 m k and, undamped, ω² ≠ k/m.
    Landau & Lifshitz, Mechanics, §22 and §26.

    >>> scene = lagjax.scenes.driven_oscillator(damping=0.2); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system = System(_driven_oscillator_lagrangian, dissipation=_friction)
    params = {"m": 1.0, "k": 4.0, "c": damping, "f": 1.5, "omega": 1.3}
    return Scene(system, params, 0.5, -0.2, duration=20.0, invariants={}, exact=_driven_oscillator_exact)


def damped_driven_oscillator() -> Scene:
    """`driven_oscillator` with the friction c = 0.3.

    >>> scene = lagjax.scenes.damped_driven_oscillator()
    """
    return driven_oscillator(damping=0.3)


class Swing(NamedTuple):
    """The length r of the string to the swinging mass, and its angle theta from the downward vertical."""

    r: ArrayLike
    theta: ArrayLike


def _swinging_atwood_lagrangian(q, qdot, params):
    mu = params["mu"]
    return 0.5 * (1 + mu) * qdot.r**2 + 0.5 * q.r**2 * qdot.theta**2 + q.r * jnp.cos(q.theta) - mu * q.r


def _swinging_atwood_invariant(q, qdot, t, params):
    sin, cos = jnp.sin(q.theta / 2), jnp.cos(q.theta / 2)
    return q.r**2 * qdot.theta * (qdot.r * cos - 0.5 * q.r * qdot.theta * sin) + q.r**2 * sin * cos**2


def swinging_atwood() -> Scene:
    """Atwood's machine with one mass free to swing, L = ½ (1+μ) ṙ² + ½ r² θ̇² + r cos θ − μ r, in units m = g = 1.

    Coordinates `Swing(r, theta)`. At the mass ratio μ = 3, the default, there is a second constant,
    r² θ̇ (ṙ cos(θ/2) − ½ r θ̇ sin(θ/2)) + r² sin(θ/2) cos²(θ/2); for other μ only the energy is constant.
    N. B. Tufillaro, American Journal of Physics 54, 142 (1986).

    >>> scene = lagjax.scenes.swinging_atwood(); scene.invariants["second"](scene.q0, scene.qdot0, 0.0, scene.params)
    """
    system, params, more = System(_swinging_atwood_lagrangian), {"mu": 3.0}, {"second": _swinging_atwood_invariant}
    return conservative_scene(system, params, Swing(1.0, np.pi / 2), Swing(0.0, 0.0), duration=10.0, more=more)


class SlowAndFast(NamedTuple):
    """The scaled centre `slow` and the scaled stretch `fast` of each stiff spring: arrays of equal length."""

    slow: ArrayLike
    fast: ArrayLike


def _fermi_pasta_ulam_lagrangian(q, qdot, params):
    left, right = q.slow - q.fast, q.slow + q.fast  # √2 times the displacements of the two ends of each stiff spring
    soft = left[0] ** 4 + jnp.sum((left[1:] - right[:-1]) ** 4) + right[-1] ** 4
    kinetic = 0.5 * jnp.sum(qdot.slow**2 + qdot.fast**2)
    return kinetic - 0.5 * params["omega"] ** 2 * jnp.sum(q.fast**2) - 0.25 * soft


def oscillatory_energies(q, qdot, params):
    """I_j = ½ ẋ_fast² + ½ ω² x_fast² of each stiff spring in `fermi_pasta_ulam`.

    They trade energy; their sum is an adiabatic invariant, constant up to O(1/ω) over exponentially long times.

    >>> scene = lagjax.scenes.fermi_pasta_ulam(); oscillatory_energies(scene.q0, scene.qdot0, scene.params)
    """
    return 0.5 * qdot.fast**2 + 0.5 * params["omega"] ** 2 * q.fast**2


def fermi_pasta_ulam() -> Scene:
    """Six masses, soft quartic and stiff linear springs in turn, walls at both ends; coordinates `SlowAndFast`,

    L = ½ Σ (ẋ0_i² + ẋ1_i²) − ½ ω² Σ x1_i²
        − ¼ [(x01 − x11)⁴ + Σ (x0_{i+1} − x1_{i+1} − x0_i − x1_i)⁴ + (x0m + x1m)⁴], x0 slow, x1 fast.

    Hairer, Lubich & Wanner, Geometric Numerical Integration, §I.5.1, with their ω = 50 and start, H = 2.00120008.

    >>> scene = lagjax.scenes.fermi_pasta_ulam(); scene.system.energy(scene.q0, scene.qdot0, params=scene.params)
    """
    omega, first = 50.0, np.array([1.0, 0.0, 0.0])
    q0, qdot0 = SlowAndFast(slow=first, fast=first / omega), SlowAndFast(slow=first, fast=first)
    return conservative_scene(System(_fermi_pasta_ulam_lagrangian), {"omega": omega}, q0, qdot0, duration=20.0)
