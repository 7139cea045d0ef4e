"""Rods, wires, wheels, skates and linkages: L without constraints, and the constraints as they are written by hand.

The multiplier λ of f = 0 acts with the force λ ∂f/∂q. A rod of length l along d is written (l² − d·d)/(2l) = 0, so that
its λ is the tension; a wire or a surface so that λ is the push outwards. Angles in radians.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lagjax._scene import System
from lagjax.scenes._coordinate_systems import Cartesian, angular_momentum_z
from lagjax.scenes._mechanisms import _pendulum_exact
from lagjax.scenes._particles import _uniform_gravity_lagrangian
from lagjax.scenes._scene import Scene, conservative_scene

__all__ = [
    "Blade", "Disc", "Rolling", "SliderCrank", "Squeezer", "andrews_squeezer", "bead_on_wire", "cartesian_chain",
    "cartesian_double_pendulum", "cartesian_of_angles", "cartesian_pendulum", "chaplygin_sleigh", "knife_edge",
    "particle_on_sphere", "rolling_cylinder", "rolling_cylinder_multipliers", "rolling_disc", "slider_crank",
    "wire_multiplier",
]  # fmt: skip

# ---- rolling off a half-cylinder -------------------------------------------------------------------------------------


class Rolling(NamedTuple):
    """The distance r of the axes, the angle theta1 of their line from the vertical, the turn theta2 of the cylinder."""

    r: ArrayLike
    theta1: ArrayLike
    theta2: ArrayLike


def _rolling_cylinder_lagrangian(q, qdot, params):
    M, a, g = params["M"], params["a"], params["g"]
    inertia = params["alpha"] * M * a**2
    kinetic = 0.5 * M * (qdot.r**2 + q.r**2 * qdot.theta1**2) + 0.5 * inertia * qdot.theta2**2
    return kinetic - M * g * q.r * jnp.cos(q.theta1)


def _rolling_cylinder_constraints(q, params):
    R, a = params["R"], params["a"]
    return {"contact": q.r - R - a, "rolling": R * q.theta1 - a * (q.theta2 - q.theta1)}


def _rolling_cylinder_exact(t, q0, qdot0, params):
    # (1+α)(R+a) θ̈1 = g sin θ1: a pendulum, upside down and longer.
    R, a = params["R"], params["a"]
    pendulum = {"g": params["g"], "l": (1 + params["alpha"]) * (R + a)}
    angle, rate = _pendulum_exact(t, q0.theta1 - jnp.pi, qdot0.theta1, pendulum)
    theta1, turns = angle + jnp.pi, (R + a) / a
    return Rolling(R + a, theta1, turns * theta1), Rolling(jnp.zeros_like(rate), rate, turns * rate)


def rolling_cylinder_multipliers(theta1, theta1_start, params):
    """λ of both constraints at θ1, after a start from rest at `theta1_start`,

    λ1 = M g/(1+α) · ((3+α) cos θ1 − 2 cos θ1⁰), the normal force, and λ2 = −α M g sin θ1/(1+α).

    The cylinder leaves at cos θ1 = 2 cos θ1⁰/(3+α), where λ1 = 0.

    >>> lagjax.scenes.rolling_cylinder_multipliers(0.5, 0.3, lagjax.scenes.rolling_cylinder().params)
    """
    alpha, weight = params["alpha"], params["M"] * params["g"]
    contact = weight / (1 + alpha) * ((3 + alpha) * jnp.cos(theta1) - 2 * jnp.cos(theta1_start))
    return {"contact": contact, "rolling": -alpha / (1 + alpha) * weight * jnp.sin(theta1)}


def rolling_cylinder() -> Scene:
    """A cylinder of radius a that rolls off a fixed half-cylinder of radius R; `Rolling(r, theta1, theta2)`,

    L = ½ M (ṙ² + r² θ̇1²) + ½ I θ̇2² − M g r cos θ1 with I = α M a², f1 = r − R − a, f2 = R θ1 − a (θ2 − θ1),

    the constraints "contact" and "rolling". From rest (1+α) M (R+a) θ̇1² = 2 M g (cos θ1⁰ − cos θ1). Both are kept here
    also beyond the place where λ1 < 0 and a real cylinder has left. Goldstein, Classical Mechanics, §2.4 and ch. 2.

    >>> scene = lagjax.scenes.rolling_cylinder(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    R, a, start = 1.0, 0.25, 0.2
    system = System(_rolling_cylinder_lagrangian, constraints=_rolling_cylinder_constraints)
    params = {"M": 2.0, "R": R, "a": a, "alpha": 0.5, "g": 9.81}
    q0, qdot0 = Rolling(R + a, start, (R + a) / a * start), Rolling(0.0, 0.0, 0.0)
    return conservative_scene(system, params, q0, qdot0, duration=0.9, exact=_rolling_cylinder_exact)


# ---- rods ------------------------------------------------------------------------------------------------------------


def _masses_lagrangian(q, qdot, params):
    m, g = params["m"], params["g"]
    return jnp.sum(0.5 * m * jnp.sum(qdot**2, axis=-1) - m * g * q[..., 1])


def _rod_lengths(q, params):
    rods = jnp.diff(q, axis=0, prepend=0.0)
    return (params["l"] ** 2 - jnp.sum(rods**2, axis=-1)) / (2 * params["l"])


def _rod_constraint(q, params):
    return {"rod": (params["l"] ** 2 - q @ q) / (2 * params["l"])}


def _two_rod_lengths(q, params):
    return dict(zip(("upper", "lower"), _rod_lengths(q, params), strict=True))


def cartesian_of_angles(theta, theta_dot, l):
    """Positions and velocities, shape (n, 2), of masses on a chain of rods `l` at `theta` from the downward vertical.

    >>> q, qdot = cartesian_of_angles(jnp.array([0.3, 0.5]), jnp.array([0.0, 1.0]), jnp.array([1.0, 2.0]))
    """
    step = l * jnp.stack([jnp.sin(theta), -jnp.cos(theta)])
    rate = l * theta_dot * jnp.stack([jnp.cos(theta), jnp.sin(theta)])
    return jnp.cumsum(step, axis=1).T, jnp.cumsum(rate, axis=1).T


def _cartesian_pendulum_exact(t, q0, qdot0, params):
    l = params["l"]
    angle, rate = jnp.arctan2(q0[0], -q0[1]), (q0[0] * qdot0[1] - q0[1] * qdot0[0]) / l**2
    angles, rates = (jnp.atleast_1d(x) for x in _pendulum_exact(t, angle, rate, params))
    q, qdot = cartesian_of_angles(angles, rates, l)
    return q[0], qdot[0]


def cartesian_pendulum() -> Scene:
    """A mass on a rod, L = ½ m (ẋ² + ẏ²) − m g y, (l² − x² − y²)/(2l) = 0; q is the array (x, y), y upwards.

    λ of "rod" is the tension. The start is that of the benchmark A01 of the IFToMM library of computational dynamics
    (González, Dopico, Lugrís & Cuadrado, Multibody System Dynamics 16 (2006) 23): at rest, horizontal.

    >>> scene = lagjax.scenes.cartesian_pendulum(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system, params = System(_masses_lagrangian, constraints=_rod_constraint), {"m": 1.0, "l": 1.0, "g": 9.81}
    q0, qdot0 = np.array([-1.0, 0.0]), np.array([0.0, 0.0])
    return conservative_scene(system, params, q0, qdot0, duration=10.0, exact=_cartesian_pendulum_exact)


def _chain_at_rest(theta, params, constraints) -> Scene:
    system = System(_masses_lagrangian, constraints=constraints)
    q0 = np.cumsum(params["l"] * np.array([np.sin(theta), -np.cos(theta)]), axis=1).T
    return conservative_scene(system, params, q0, np.zeros_like(q0), duration=2.0)


def cartesian_double_pendulum() -> Scene:
    """The double pendulum of masses and rods, L = Σ ½ m_i ṙ_i² − m_i g y_i; q is the array ((x1, y1), (x2, y2)).

    The constraints are the rods "upper" and "lower", (l1² − r1²)/(2 l1) = 0 and (l2² − (r2 − r1)²)/(2 l2) = 0; their
    λ are the tensions. `cartesian_of_angles` gives its state from that of `double_pendulum`.
    Goldstein, Classical Mechanics, §1.3–1.4.

    >>> scene = cartesian_double_pendulum(); scene.system.multipliers(scene.q0, scene.qdot0, params=scene.params)
    """
    params = {"m": np.ones(2), "l": np.ones(2), "g": 9.81}
    return _chain_at_rest(np.array([1.0, 1.5]), params, _two_rod_lengths)


def cartesian_chain(n=3) -> Scene:
    """n masses on rods, hung one from another; q is the array of their positions, shape (n, 2),

    L = Σ ½ m_i ṙ_i² − m_i g y_i, (l_i² − (r_i − r_{i−1})²)/(2 l_i) = 0 with r_0 = 0.

    λ_i is the tension of rod i. The same motion as that of `chain`. Goldstein, Classical Mechanics, §1.3–1.4.

    >>> scene = cartesian_chain(5); scene.system.multipliers(scene.q0, scene.qdot0, params=scene.params)
    """
    return _chain_at_rest(np.full(n, 1.0), {"m": np.full(n, 1 / n), "l": np.full(n, 1 / n), "g": 9.81}, _rod_lengths)


# ---- wires and surfaces ----------------------------------------------------------------------------------------------


def parabola(x, params):
    """y = ½ k x²"""
    return 0.5 * params["k"] * x**2


class _OnWire(eqx.Module):
    shape: Callable = eqx.field(static=True)

    def __call__(self, q, params):
        return {"wire": q[1] - self.shape(q[0], params)}


def wire_multiplier(q, qdot, params, shape=parabola):
    """λ = m (g + y″ ẋ²)/(1 + y′²), the vertical force of a wire y(x) on a bead; the whole force is λ √(1 + y′²).

    >>> scene = bead_on_wire(); wire_multiplier(scene.q0, scene.qdot0, scene.params)
    """
    slope = jax.grad(shape)
    bend = jax.grad(slope)(q[0], params)
    return params["m"] * (params["g"] + bend * qdot[0] ** 2) / (1 + slope(q[0], params) ** 2)


def bead_on_wire(shape=parabola, *, params=None, x0=1.0) -> Scene:
    """A bead on a wire of the shape y = `shape(x, params)`: L = ½ m (ẋ² + ẏ²) − m g y, y − shape(x) = 0; q is (x, y).

    Started at rest at `x0`; without a shape of your own, on the parabola y = ½ k x². `wire_multiplier` gives λ of
    "wire" in closed form. Goldstein, Classical Mechanics, §1.3 (a bead on a wire), §2.4.

    >>> scene = bead_on_wire(lambda x, params: jnp.cosh(x), params={"m": 1.0, "g": 9.81})
    """
    params = {"m": 1.0, "g": 9.81, "k": 1.5} if params is None else params
    system, q0 = System(_masses_lagrangian, constraints=_OnWire(shape)), np.array([x0, float(shape(x0, params))])
    return conservative_scene(system, params, q0, np.zeros(2), duration=5.0)


def _sphere_constraint(q, params):
    return {"sphere": (q.x**2 + q.y**2 + q.z**2 - params["R"] ** 2) / (2 * params["R"])}


def _particle_on_sphere_exact(t, q0, qdot0, params):
    # From rest it falls along a meridian, like a pendulum of length R; θ from the upward vertical.
    R, rho = params["R"], jnp.hypot(q0.x, q0.y)
    angle, rate = _pendulum_exact(t, jnp.arctan2(rho, q0.z) - jnp.pi, 0.0, {"g": params["g"], "l": R})
    across, height = -R * jnp.sin(angle) / rho, -R * jnp.cos(angle)
    across_dot, height_dot = -R * jnp.cos(angle) * rate / rho, R * jnp.sin(angle) * rate
    q = Cartesian(q0.x * across, q0.y * across, height)
    return q, Cartesian(q0.x * across_dot, q0.y * across_dot, height_dot)


def particle_on_sphere() -> Scene:
    """A particle that slides without friction on a sphere, L = ½ m v² − m g z, (r² − R²)/(2R) = 0; `Cartesian`.

    λ of "sphere" is the normal force m (g z/R − v²/R), from rest m g (3 cos θ − 2 cos θ0): the particle leaves at
    cos θ = ⅔ cos θ0, which the constraint alone does not know. The closed solution is for a start from rest.
    Goldstein, Classical Mechanics, ch. 1–2 (particle on a hemisphere).

    >>> scene = particle_on_sphere(); scene.system.multipliers(scene.q0, scene.qdot0, params=scene.params)
    """
    R, theta, phi = 1.0, 0.3, 0.7
    system = System(_uniform_gravity_lagrangian, constraints=_sphere_constraint)
    params = {"m": 1.0, "R": R, "g": 9.81}
    rho, rest = R * np.sin(theta), Cartesian(0.0, 0.0, 0.0)
    q0 = Cartesian(rho * np.cos(phi), rho * np.sin(phi), R * np.cos(theta))
    more = {"L_z": lambda q, qdot, t, params: params["m"] * angular_momentum_z(q, qdot)}
    return conservative_scene(system, params, q0, rest, duration=0.6, exact=_particle_on_sphere_exact, more=more)


# ---- wheels and skates: constraints on velocities --------------------------------------------------------------------


class Disc(NamedTuple):
    """The point of contact x (down the slope), y; the heading phi from the x axis; the angle psi that was rolled."""

    x: ArrayLike
    y: ArrayLike
    phi: ArrayLike
    psi: ArrayLike


class Blade(NamedTuple):
    """The point of contact x (down the slope), y; the heading phi from the x axis."""

    x: ArrayLike
    y: ArrayLike
    phi: ArrayLike


def _turning_motion(t, speed, acceleration, phi, rate):
    """The way of a body, its components x and y, its speed and its heading φ after t, φ turning at `rate`.

    A force along the heading accelerates the body by `acceleration` cos φ.
    """
    # u̇ = k cos φ with φ = φ0 + ω t, so u = c + (k/ω) sin φ, and ẋ = u cos φ, ẏ = u sin φ are integrated by parts.
    end, k = phi + rate * t, acceleration / rate
    c = speed - k * jnp.sin(phi)
    d_sin, d_cos = jnp.sin(end) - jnp.sin(phi), jnp.cos(end) - jnp.cos(phi)
    x = (c * d_sin + 0.5 * k * (jnp.sin(end) ** 2 - jnp.sin(phi) ** 2)) / rate
    y = (-c * d_cos - 0.25 * k * (jnp.sin(2 * end) - jnp.sin(2 * phi))) / rate + 0.5 * k * t
    return c * t - k * d_cos / rate, x, y, c + k * jnp.sin(end), end


def _rolling_disc_lagrangian(q, qdot, params):
    return _knife_edge_lagrangian(q, qdot, params) + 0.5 * params["I"] * qdot.psi**2


def _rolling_without_slipping(q, qdot, params):
    speed = params["R"] * qdot.psi
    return {"along": qdot.x - speed * jnp.cos(q.phi), "across": qdot.y - speed * jnp.sin(q.phi)}


def _rolling_disc_exact(t, q0, qdot0, params):
    m, R = params["m"], params["R"]
    acceleration = m * params["g"] * jnp.sin(params["slope"]) * R / (m * R**2 + params["I"])
    rolled, x, y, spin, phi = _turning_motion(t, qdot0.psi, acceleration, q0.phi, qdot0.phi)
    q = Disc(q0.x + R * x, q0.y + R * y, phi, q0.psi + rolled)
    return q, Disc(R * spin * jnp.cos(phi), R * spin * jnp.sin(phi), qdot0.phi, spin)


def rolling_disc(slope=0.3) -> Scene:
    """An upright disc that rolls without slipping on a plane tilted by `slope`; coordinates `Disc(x, y, phi, psi)`,

    L = ½ m (ẋ² + ẏ²) + ½ J φ̇² + ½ I ψ̇² + m g x sin(slope), ẋ = R ψ̇ cos φ, ẏ = R ψ̇ sin φ.

    The velocity constraints "along" and "across" cannot be integrated. φ̇ is constant and, where it is not zero, the
    disc does not go down but sideways. Neimark & Fufaev, Dynamics of Nonholonomic Systems, ch. III; Bloch,
    Nonholonomic Mechanics and Control, §1.4.

    >>> scene = rolling_disc(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    m, R, phi, spin = 1.5, 0.4, 0.5, 2.0
    system = System(_rolling_disc_lagrangian, velocity_constraints=_rolling_without_slipping)
    params = {"m": m, "R": R, "I": 0.5 * m * R**2, "J": 0.25 * m * R**2, "g": 9.81, "slope": slope}
    q0, qdot0 = Disc(0.0, 0.0, phi, 0.0), Disc(R * spin * np.cos(phi), R * spin * np.sin(phi), 1.3, spin)
    more = {"turning rate": lambda q, qdot, t, params: qdot.phi}
    return conservative_scene(system, params, q0, qdot0, duration=5.0, exact=_rolling_disc_exact, more=more)


def _no_slip_across(q, qdot):
    return {"blade": qdot.y * jnp.cos(q.phi) - qdot.x * jnp.sin(q.phi)}


def _knife_edge_lagrangian(q, qdot, params):
    m = params["m"]
    kinetic = 0.5 * m * (qdot.x**2 + qdot.y**2) + 0.5 * params["J"] * qdot.phi**2
    return kinetic + m * params["g"] * jnp.sin(params["slope"]) * q.x


def _knife_edge_exact(t, q0, qdot0, params):
    speed = qdot0.x * jnp.cos(q0.phi) + qdot0.y * jnp.sin(q0.phi)
    acceleration = params["g"] * jnp.sin(params["slope"])
    _, x, y, speed, phi = _turning_motion(t, speed, acceleration, q0.phi, qdot0.phi)
    return Blade(q0.x + x, q0.y + y, phi), Blade(speed * jnp.cos(phi), speed * jnp.sin(phi), qdot0.phi)


def knife_edge() -> Scene:
    """A knife edge (a skate over its centre of mass) on a plane tilted by the angle `slope`; `Blade(x, y, phi)`,

    L = ½ m (ẋ² + ẏ²) + ½ J φ̇² + m g x sin(slope), ẏ cos φ − ẋ sin φ = 0 (the velocity constraint "blade").

    From rest at φ = 0, turning at ω: x = g sin(slope)/(2ω²) sin² ωt, y = g sin(slope)/(2ω²) (ωt − ½ sin 2ωt), a
    cycloid: on average it does not go down. Bloch, Nonholonomic Mechanics and Control, §1.6.

    >>> scene = knife_edge(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system = System(_knife_edge_lagrangian, velocity_constraints=_no_slip_across)
    params = {"m": 1.0, "J": 0.3, "g": 9.81, "slope": 0.4}
    q0, qdot0 = Blade(0.0, 0.0, 0.0), Blade(0.0, 0.0, 1.5)
    more = {"turning rate": lambda q, qdot, t, params: qdot.phi}
    return conservative_scene(system, params, q0, qdot0, duration=6.0, exact=_knife_edge_exact, more=more)


def _sleigh_lagrangian(q, qdot, params):
    m, a, sin, cos = params["m"], params["a"], jnp.sin(q.phi), jnp.cos(q.phi)
    x, y = qdot.x - a * sin * qdot.phi, qdot.y + a * cos * qdot.phi  # of the centre of mass
    return 0.5 * m * (x**2 + y**2) + 0.5 * params["I"] * qdot.phi**2


def _sleigh_exact(t, q0, qdot0, params):
    m, a = params["m"], params["a"]
    inertia = params["I"] + m * a**2
    u0, w0 = qdot0.x * jnp.cos(q0.phi) + qdot0.y * jnp.sin(q0.phi), qdot0.phi
    U, k = jnp.sqrt(u0**2 + inertia * w0**2 / m), m * a / inertia
    c = jnp.arctanh(u0 / U)
    turned = jnp.sign(w0) * jnp.sqrt(inertia / m) / a  # heading per angle of Gudermann

    def speed_rate_heading(t):
        s = k * U * t + c
        phi = q0.phi + turned * 2 * (jnp.arctan(jnp.tanh(s / 2)) - jnp.arctan(jnp.tanh(c / 2)))
        return U * jnp.tanh(s), turned * k * U / jnp.cosh(s), phi

    # Speed and heading have closed forms; the position is their integral from 0 to t, by quadrature.
    nodes, weights = np.polynomial.legendre.leggauss(100)
    speeds, _, headings = speed_rate_heading(t / 2 * (1 + nodes))
    x, y = (t / 2 * jnp.sum(weights * speeds * turn(headings)) for turn in (jnp.cos, jnp.sin))
    u, w, phi = speed_rate_heading(t)
    return Blade(q0.x + x, q0.y + y, phi), Blade(u * jnp.cos(phi), u * jnp.sin(phi), w)


def chaplygin_sleigh() -> Scene:
    """A sleigh on a blade, its centre of mass at c, the distance a ahead of the blade; coordinates `Blade(x, y, phi)`,

    L = ½ m ċ² + ½ I φ̇², ẏ cos φ − ẋ sin φ = 0 (the velocity constraint "blade").

    With the speed u along the blade and w = φ̇: u̇ = a w², ẇ = −m a/(I + m a²) u w. The energy is constant, and yet every
    motion ends straight on, centre of mass first. Chaplygin (1911), Regular and Chaotic Dynamics 13 (2008) 369; Bloch,
    Nonholonomic Mechanics and Control, §1.7.

    >>> scene = chaplygin_sleigh(); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system = System(_sleigh_lagrangian, velocity_constraints=_no_slip_across)
    params = {"m": 1.0, "I": 0.1, "a": 0.1}
    q0, qdot0 = Blade(0.0, 0.0, 0.0), Blade(-0.5, 0.0, 2.0)
    return conservative_scene(system, params, q0, qdot0, duration=5.0, exact=_sleigh_exact)


# ---- linkages --------------------------------------------------------------------------------------------------------


class SliderCrank(NamedTuple):
    """The angles of crank and rod from the x axis, along which the slider moves; the position x of the slider."""

    crank: ArrayLike
    rod: ArrayLike
    x: ArrayLike


def _slider_crank_lagrangian(q, qdot, params):
    (m1, m2, m3), (l1, l2), g = params["m"], params["l"], params["g"]
    sin1, sin2 = jnp.sin(q.crank), jnp.sin(q.rod)
    across = qdot.crank * qdot.rod * l1 * l2 * jnp.cos(q.crank - q.rod)
    crank = m1 * l1**2 * qdot.crank**2 / 6
    rod = 0.5 * m2 * (l1**2 * qdot.crank**2 + across + l2**2 * qdot.rod**2 / 3)
    return crank + rod + 0.5 * m3 * qdot.x**2 - g * (0.5 * m1 * l1 * sin1 + m2 * (l1 * sin1 + 0.5 * l2 * sin2))


def _slider_crank_constraints(q, params):
    l1, l2 = params["l"]
    along = l1 * jnp.cos(q.crank) + l2 * jnp.cos(q.rod) - q.x
    return {"along": along, "across": l1 * jnp.sin(q.crank) + l2 * jnp.sin(q.rod)}


def slider_crank(l1=1.0, l2=2.0) -> Scene:
    """A slider on the x axis, driven by a crank `l1` through a rod `l2`; coordinates `SliderCrank(crank, rod, x)`,

    L = m1 l1² θ̇1²/6 + ½ m2 (l1² θ̇1² + l1 l2 θ̇1 θ̇2 cos(θ1−θ2) + l2² θ̇2²/3) + ½ m3 ẋ² − g (½ m1 y1 + m2 (y1 + ½ y2)),

    y1 = l1 sin θ1, y2 = l2 sin θ2, for uniform bars, closed by l1 cos θ1 + l2 cos θ2 = x ("along") and y1 + y2 = 0
    ("across"). With l1 = l2 the constraints lose rank wherever the crank stands upright, and the bars may also turn
    together there. Shabana, Dynamics of Multibody Systems, §3.6; Haug, Computer Aided Kinematics and Dynamics, §10.3.

    >>> scene = slider_crank(); scene.system.multipliers(scene.q0, scene.qdot0, params=scene.params)
    """
    crank, rate = 0.5, 4.0
    rod = -np.arcsin(l1 * np.sin(crank) / l2)
    rod_rate = -l1 * np.cos(crank) * rate / (l2 * np.cos(rod))
    slide = -l1 * np.sin(crank) * rate - l2 * np.sin(rod) * rod_rate
    params = {"m": np.array([1.0, 1.0, 2.0]), "l": np.array([l1, l2]), "g": 9.81}
    q0, qdot0 = SliderCrank(crank, rod, l1 * np.cos(crank) + l2 * np.cos(rod)), SliderCrank(rate, rod_rate, slide)
    system = System(_slider_crank_lagrangian, constraints=_slider_crank_constraints)
    return conservative_scene(system, params, q0, qdot0, duration=3.0)


class Squeezer(NamedTuple):
    """The seven angles of `andrews_squeezer`, as its source names them."""

    beta: ArrayLike
    Theta: ArrayLike
    gamma: ArrayLike
    Phi: ArrayLike
    delta: ArrayLike
    Omega: ArrayLike
    epsilon: ArrayLike


_SQUEEZER = {
    "m": np.array([0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498]),
    "I": np.array([2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5]),
    "xa": -0.06934, "ya": -0.00227, "xb": -0.03635, "yb": 0.03273, "xc": 0.014, "yc": 0.072, "c0": 4530.0,
    "d": 28e-3, "da": 115e-4, "e": 2e-2, "ea": 1421e-5, "rr": 7e-3, "ra": 92e-5, "l0": 7785e-5,
    "ss": 35e-3, "sa": 1874e-5, "sb": 1043e-5, "sc": 18e-3, "sd": 2e-2, "ta": 2308e-5, "tb": 916e-5,
    "u": 4e-2, "ua": 1228e-5, "ub": 449e-5, "zf": 2e-2, "zt": 4e-2, "fa": 1421e-5, "mom": 33e-3,
}  # fmt: skip


def _squeezer_kinetic(q, qdot, p):
    """½ q̇ᵀ M q̇, body by body: of the crank K1, the bars K2, K4, K6, and the triangles K3, K5, K7."""
    m, I = p["m"], p["I"]
    e, f, zt, u = p["e"] - p["ea"], p["zf"] - p["fa"], p["zt"], p["u"]
    be, Th, ga, Ph, de, Om, ep = qdot
    arm, lever4, lever6 = p["da"] * p["rr"] * jnp.cos(q.Theta), zt * e * jnp.sin(q.Phi), u * f * jnp.sin(q.Omega)
    bodies = (
        (m[0] * p["ra"] ** 2 + I[0]) * be**2,
        m[1] * (p["rr"] ** 2 * be**2 - 2 * arm * be * (be + Th)) + (m[1] * p["da"] ** 2 + I[1]) * (be + Th) ** 2,
        (m[2] * (p["sa"] ** 2 + p["sb"] ** 2) + I[2]) * ga**2,
        m[3] * (e**2 * (Ph + de) ** 2 + 2 * lever4 * de * (Ph + de) + zt**2 * de**2) + I[3] * (Ph + de) ** 2,
        (m[4] * (p["ta"] ** 2 + p["tb"] ** 2) + I[4]) * de**2,
        m[5] * (f**2 * (Om + ep) ** 2 - 2 * lever6 * ep * (Om + ep) + u**2 * ep**2) + I[5] * (Om + ep) ** 2,
        (m[6] * (p["ua"] ** 2 + p["ub"] ** 2) + I[6]) * ep**2,
    )
    return 0.5 * sum(bodies)


def _squeezer_lagrangian(q, qdot, params):
    p, sin, cos = params, jnp.sin(q.gamma), jnp.cos(q.gamma)
    x = p["sd"] * cos + p["sc"] * sin + p["xb"] - p["xc"]
    y = p["sd"] * sin - p["sc"] * cos + p["yb"] - p["yc"]
    spring = 0.5 * p["c0"] * (jnp.sqrt(x**2 + y**2) - p["l0"]) ** 2
    return _squeezer_kinetic(q, qdot, p) - spring + p["mom"] * q.beta


def _squeezer_constraints(q, params):
    p, sin, cos = params, jnp.sin, jnp.cos
    be, Th, ga, Ph, de, Om, ep = q
    x = p["rr"] * cos(be) - p["d"] * cos(be + Th)
    y = p["rr"] * sin(be) - p["d"] * sin(be + Th)
    return {
        "x through B": x - p["ss"] * sin(ga) - p["xb"],
        "y through B": y + p["ss"] * cos(ga) - p["yb"],
        "x through A by delta": x - p["e"] * sin(Ph + de) - p["zt"] * cos(de) - p["xa"],
        "y through A by delta": y + p["e"] * cos(Ph + de) - p["zt"] * sin(de) - p["ya"],
        "x through A by epsilon": x - p["zf"] * cos(Om + ep) - p["u"] * sin(ep) - p["xa"],
        "y through A by epsilon": y - p["zf"] * sin(Om + ep) + p["u"] * cos(ep) - p["ya"],
    }


_SQUEEZER_START = Squeezer(
    beta=-0.0617138900142764496358948458001, Theta=0.0, gamma=0.455279819163070380255912382449,
    Phi=0.222668390165885884674473185609, delta=0.487364979543842550225598953530,
    Omega=-0.222668390165885884674473185609, epsilon=1.23054744454982119249735015568,
)  # fmt: skip


def andrews_squeezer() -> Scene:
    """Andrews' squeezing mechanism: seven bodies in a plane, closed in three loops; `Squeezer`, seven angles.

    A motor of constant torque turns the crank β against a spring; kilograms, metres, seconds. Seven coordinates and six
    constraints leave one way to move. The parameters bear the names of the source: Hairer & Wanner, Solving Ordinary
    Differential Equations II, §VII.7; Mazzia & Magherini, Test Set for IVP Solvers (release 2.4), "Andrews".

    >>> scene = andrews_squeezer(); scene.system.constraint_residual(scene.q0, scene.qdot0, params=scene.params)
    """
    system = System(_squeezer_lagrangian, constraints=_squeezer_constraints)
    return conservative_scene(system, dict(_SQUEEZER), _SQUEEZER_START, Squeezer(*[0.0] * 7), duration=0.03)
