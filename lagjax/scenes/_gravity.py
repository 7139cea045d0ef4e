"""Bodies under gravity, from Kepler's ellipse to the post-Newtonian solar system."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._scene import System
from lagjax.scenes import _de421 as de421
from lagjax.scenes._scene import Scene, components, conservative_scene, total_momentum

__all__ = [
    "eccentric_anomaly", "figure_eight", "kepler", "n_body", "newtonian_solar_system", "restricted_three_body",
    "solar_system",
]  # fmt: skip


def _kepler_lagrangian(q, qdot, params):
    return 0.5 * qdot @ qdot + params["GM"] / jnp.sqrt(q @ q)


def eccentric_anomaly(M, e):
    """Solve Kepler's equation E − e sin E = M for 0 ≤ e < 1, to round-off.

    >>> E = lagjax.scenes.eccentric_anomaly(0.1, 0.9999)
    """
    turns = 2 * jnp.pi * jnp.round(M / (2 * jnp.pi))
    sign = jnp.where(M < turns, -1, 1)
    M = sign * (M - turns)
    # On [0, π] the equation is convex and rising: Newton's steps from any upper bound fall monotonically to the root.
    bounds = [M / (1 - e), M + e, jnp.cbrt(jnp.pi**2 * M), jnp.full_like(M, jnp.pi)]
    E = jax.lax.stop_gradient(jnp.min(jnp.stack(jnp.broadcast_arrays(*bounds)), axis=0))
    for _ in range(8):  # seven are enough for e = 1 − 1e-10; derivatives are those of the last step, and exact
        E = E - (E - e * jnp.sin(E) - M) / (1 - e * jnp.cos(E))
    return turns + sign * E


def _kepler_exact(t, q0, qdot0, params):
    # Lagrange's f and g functions of the change x of the eccentric anomaly: free of angles, regular for a circle.
    GM = params["GM"]
    r0 = jnp.sqrt(q0 @ q0)
    a = 1 / (2 / r0 - qdot0 @ qdot0 / GM)
    n = jnp.sqrt(GM / a**3)
    c, s = 1 - r0 / a, q0 @ qdot0 / jnp.sqrt(GM * a)  # e cos E0 and e sin E0
    e, E0 = jnp.sqrt(c**2 + s**2), jnp.arctan2(s, c)
    E = eccentric_anomaly(E0 - s + n * t, e)
    sin, versine = jnp.sin(E - E0), 2 * jnp.sin((E - E0) / 2) ** 2
    r = a * (1 - e * jnp.cos(E))
    q = (1 - a / r0 * versine) * q0 + (r0 / a * sin + s * versine) / n * qdot0
    return q, -n * a**2 / (r * r0) * sin * q0 + (1 - a / r * versine) * qdot0


def _kepler_angular_momentum(q, qdot, t, params):
    return q[0] * qdot[1] - q[1] * qdot[0]


def _laplace_runge_lenz(q, qdot, t, params):
    # v × L/GM − q/r: points to the pericentre, as long as the orbit is eccentric.
    L = _kepler_angular_momentum(q, qdot, t, params)
    return jnp.stack([qdot[1], -qdot[0]]) * L / params["GM"] - q / jnp.sqrt(q @ q)


def kepler(eccentricity=0.6) -> Scene:
    """Kepler's problem in the plane, L = ½ (ẋ² + ẏ²) + GM/r; q is the array (x, y).

    Units GM = a = 1, started at the pericentre, one period in 2π. The closed solution holds for any ellipse.
    Landau & Lifshitz, Mechanics, §15; f and g functions: Battin, Astrodynamics, §3.6 and §4.3.

    >>> scene = lagjax.scenes.kepler(0.9); scene.exact(1.0, scene.q0, scene.qdot0, scene.params)
    """
    system, params, e = System(_kepler_lagrangian), {"GM": 1.0}, eccentricity
    q0, qdot0 = np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])
    more = components("laplace_runge_lenz", _laplace_runge_lenz, "xy")
    more["angular_momentum"] = _kepler_angular_momentum
    return conservative_scene(system, params, q0, qdot0, duration=2 * np.pi, exact=_kepler_exact, more=more)


def _restricted_three_body_lagrangian(q, qdot, params):
    (x, y), (vx, vy), mu = q, qdot, params["mu"]
    to_earth, to_moon = jnp.sqrt((x + mu) ** 2 + y**2), jnp.sqrt((x - (1 - mu)) ** 2 + y**2)
    return 0.5 * ((vx - y) ** 2 + (vy + x) ** 2) + (1 - mu) / to_earth + mu / to_moon


def restricted_three_body() -> Scene:
    """A small body near two that circle each other, in the frame that turns with them; q is the array (x, y),

    L = ½ [(ẋ − y)² + (ẏ + x)²] + (1 − μ)/|q + (μ, 0)| + μ/|q − (1 − μ, 0)|.

    Its energy is half the negative Jacobi constant. The start is Arenstorf's closed orbit between Earth and Moon.
    Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, §II.0.

    >>> scene = lagjax.scenes.restricted_three_body()
    """
    system, params = System(_restricted_three_body_lagrangian), {"mu": 0.012277471}
    q0, qdot0 = np.array([0.994, 0.0]), np.array([0.0, -2.00158510637908252240537862224])
    return conservative_scene(system, params, q0, qdot0, duration=17.0652165601579625588917206249)


def _inverse_distances(q):
    """1/r_ab for every pair of bodies, and 0 where a = b.

    The identity keeps the distance of a body to itself away from zero, so that derivatives are finite too.
    """
    own = np.eye(len(q))
    separations = q[:, None, :] - q[None, :, :]
    return (1 - own) / jnp.sqrt(jnp.sum(separations**2, axis=-1) + own)


def _newtonian_lagrangian(q, qdot, params):
    GM = params["GM"]
    kinetic = jnp.sum(0.5 * GM * jnp.sum(qdot**2, axis=-1))
    return kinetic + 0.5 * GM @ _inverse_distances(q) @ GM


def _n_body_angular_momentum(q, qdot, t, params):
    return jnp.sum(params["GM"] * (q[:, 0] * qdot[:, 1] - q[:, 1] * qdot[:, 0]))


def n_body(GM, q0, qdot0, duration) -> Scene:
    """Newtonian bodies, G L = Σ ½ GM_a v_a² + Σ_{a<b} GM_a GM_b/r_ab; q is an (N, 2) or (N, 3) array.

    L is multiplied by the gravitational constant, so that only the well measured products GM occur.

    >>> scene = lagjax.scenes.n_body([1.0, 1e-3], [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], duration=6.3)
    """
    system, (GM, q0, qdot0) = System(_newtonian_lagrangian), (np.asarray(x, float) for x in (GM, q0, qdot0))
    more = components("p", total_momentum(system), "xyz"[: q0.shape[1]])
    more["angular_momentum_z"] = _n_body_angular_momentum
    return conservative_scene(system, {"GM": GM}, q0, qdot0, duration, more)


def figure_eight() -> Scene:
    """Three equal masses that chase each other along one figure eight; `n_body` in the plane with GM = 1.

    A. Chenciner, R. Montgomery, Annals of Mathematics 152, 881 (2000); digits: X. Li, S. Liao,
    Science China Physics 60, 129511 (2017).

    >>> scene = lagjax.scenes.figure_eight()
    """
    q0, v = [[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0]], np.array([0.34711688811904, 0.53272494538798])
    return n_body([1.0, 1.0, 1.0], q0, [v, v, -2 * v], duration=6.32591398292657)


def _einstein_infeld_hoffmann_lagrangian(q, qdot, params):
    GM, c = params["GM"], params["c"]
    inverse_r = _inverse_distances(q)
    v_squared = jnp.sum(qdot**2, axis=-1)
    potential = inverse_r @ GM
    newtonian = jnp.sum(GM * (0.5 * v_squared + 0.5 * potential))

    n = (q[:, None, :] - q[None, :, :]) * inverse_r[:, :, None]  # unit vector from b to a
    along_a, along_b = jnp.einsum("abi,ai->ab", n, qdot), jnp.einsum("abi,bi->ab", n, qdot)
    pairs = GM @ (inverse_r * (7 * qdot @ qdot.T + along_a * along_b)) @ GM
    one_body = GM * (v_squared**2 / 8 + 1.5 * v_squared * potential - 0.5 * potential**2)
    return newtonian + (jnp.sum(one_body) - pairs / 4) / c**2


def solar_system() -> Scene:
    """Sun, planets, Moon and Pluto by Einstein, Infeld & Hoffmann: general relativity to the order 1/c²,

    L = Σ ½ m v² + Σ G m_a m_b/(2r) + (1/c²) {Σ m v⁴/8 + Σ (3/2) G m_a m_b v_a²/r
        − Σ G m_a m_b/(4r) [7 v_a·v_b + (v_a·n)(v_b·n)] − Σ G² m_a m_b m_c/(2 r_ab r_ac)},

    sums over all ordered pairs b ≠ a and c ≠ a; the last is −½ Σ m_a (Σ_b G m_b/r_ab)². L is multiplied by G.
    q is an (11, 3) array in the order of `de421.BODIES`: barycentric, ICRF axes, AU, days, from 1969 June 28 on.
    The mass matrix depends on positions and velocities. Landau & Lifshitz, The Classical Theory of Fields, (106.17);
    start and masses: JPL DE421.

    >>> scene = lagjax.scenes.solar_system()
    """
    system = System(_einstein_infeld_hoffmann_lagrangian)
    params, more = {"GM": de421.GM, "c": de421.C}, components("p", total_momentum(system))
    return conservative_scene(system, params, de421.POSITIONS, de421.VELOCITIES, duration=365.25, more=more)


def newtonian_solar_system() -> Scene:
    """The solar system of `solar_system`, without relativity: `n_body` with the same masses and the same start.

    >>> scene = lagjax.scenes.newtonian_solar_system()
    """
    return n_body(de421.GM, de421.POSITIONS, de421.VELOCITIES, duration=365.25)
