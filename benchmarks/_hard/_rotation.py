"""Rigid bodies by unit quaternions: no chart, so no pole, but a mass matrix that is singular along the quaternion.

q = (w, x, y, z) turns the body's axes into those of space; the rates about the body's axes are 2 vec(q̄ q̇). Only the
constraint |q|² = 1 makes the equations regular. L = ½ ω·I ω − k·γ, with γ the upward vertical seen from the body.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import lagjax
from benchmarks._hard._case import EPS, Case, Experiment, Found, Path, follow_batch
from lagjax import scenes


def body_rates(q, qdot):
    """ω about the axes of the body; components in front."""
    (w, x, y, z), (a, b, c, d) = q, qdot
    return jnp.stack([w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a]) * 2


def vertical(q):
    """γ: the upward vertical in the axes of the body."""
    w, x, y, z = q
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


def third_axis(q):
    """The third axis of the body, in space."""
    w, x, y, z = q
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z])


def _body_lagrangian(q, qdot, params):
    rates = body_rates(q, qdot)
    return 0.5 * jnp.sum(params["I"] * rates**2) - params["k"] @ vertical(q)


def _unit(q):
    return {"unit": 0.5 * (q @ q - 1)}


_BODY = lagjax.System(_body_lagrangian, constraints=_unit)


def rigid_body(I, rates, k=(0.0, 0.0, 0.0), tilt: float = 0.0) -> scenes.Scene:
    """Moments of inertia `I`, turning at `rates` about the body's axes, the third one tilted by `tilt` from upright;
    `k` is weight times the place of the centre of mass."""
    q0 = np.array([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
    w, x, y, z = q0
    a, b, c = rates
    qdot0 = 0.5 * np.array(
        [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
    )
    params = {"I": np.asarray(I, float), "k": np.asarray(k, float)}
    return scenes.Scene(_BODY, params, q0, qdot0, 10.0, {"energy": _BODY.energy})


def along(function: Callable, path: Path) -> np.ndarray:
    """A function of (q, q̇) at every time, time in front."""
    return np.asarray(jax.jit(jax.vmap(function))(jnp.asarray(path.q), jnp.asarray(path.qdot)))


# ---- free bodies -----------------------------------------------------------------------------------------------------

# ẏ = (y2 y3, −y1 y3, −0.51 y1 y2) is a body with these moments, ω = scales · y.
MOMENTS = np.array([2.0, 3.0, 1.5])
SCALES = np.sqrt([4.59, 1.02, 8.0])


def _jacobi_error(scene: scenes.Scene, path: Path) -> float:
    y = along(body_rates, path) / SCALES
    return max(
        abs(value - float(mp.ellipfun(name, mp.mpf(t), m=mp.mpf("0.51"))))
        for t, row in zip(path.ts, y, strict=True)
        for name, value in zip(("sn", "cn", "dn"), row, strict=True)
    )


FLIPPING, SPIN = (0.3, 0.35, 0.4), (0.1, 15.0, 0.1)
FLIP = 6.1674729046695510  # published


def flipping_rates(t: float) -> np.ndarray:
    """ω of the body of Dzhanibekov, by Jacobi's functions; L² > 2 E I2 here. Landau & Lifshitz, Mechanics, §37."""
    with mp.workdps(40):
        amplitudes, rate, m, begin = _flipping()
        sn, cn, dn = (mp.ellipfun(name, begin + rate * mp.mpf(t), m=m) for name in ("sn", "cn", "dn"))
        return np.array([a * f for a, f in zip(amplitudes, (cn, sn, dn), strict=True)], float)


def flip_time() -> float:
    """Half the period of ω2."""
    with mp.workdps(40):
        _, rate, m, _ = _flipping()
        return float(2 * mp.ellipk(m) / rate)


def _flipping():
    I1, I2, I3 = map(mp.mpf, ("0.3", "0.35", "0.4"))
    w = [mp.mpf("0.1"), mp.mpf(15), mp.mpf("0.1")]
    E2 = I1 * w[0] ** 2 + I2 * w[1] ** 2 + I3 * w[2] ** 2
    L2 = (I1 * w[0]) ** 2 + (I2 * w[1]) ** 2 + (I3 * w[2]) ** 2
    high, low = E2 * I3 - L2, L2 - E2 * I1
    amplitudes = (mp.sqrt(high / (I1 * (I3 - I1))), mp.sqrt(high / (I2 * (I3 - I2))), mp.sqrt(low / (I3 * (I3 - I1))))
    m = (I2 - I1) * high / ((I3 - I2) * low)
    return amplitudes, mp.sqrt((I3 - I2) * low / (I1 * I2 * I3)), m, mp.ellipf(mp.asin(w[1] / amplitudes[1]), m)


def _flip_error(scene: scenes.Scene, path: Path) -> float:
    exact = np.array([flipping_rates(t) for t in path.ts])
    return np.abs(along(body_rates, path) - exact).max() / 15.0


# ---- tops ------------------------------------------------------------------------------------------------------------

TOP, WEIGHT, TOP_SPIN, TOP_TILT = (1.0, 1.0, 0.5), 3.0, 9.0, 0.6


def top_axis(t: float) -> np.ndarray:
    """The axis in space of Lagrange's top, let go with its axis at rest: u = cos θ by sn, the azimuth by quadrature.

    u̇² = (u0 − u)(β(1 − u²) − a²(u0 − u)), φ̇ = a(u0 − u)/(1 − u²), a = I3 ω3/I1, β = 2 M g l/I1. E. T. Whittaker,
    Analytical Dynamics, §71.
    """
    from scipy.special import ellipj, ellipk

    a, beta, u0 = TOP[2] * TOP_SPIN / TOP[0], 2 * WEIGHT / TOP[0], np.cos(TOP_TILT)
    root = np.sqrt(a**4 - 4 * beta * (a**2 * u0 - beta))
    u1, u3 = (a**2 - root) / (2 * beta), (a**2 + root) / (2 * beta)
    m, rate = (u0 - u1) / (u3 - u1), np.sqrt(beta * (u3 - u1)) / 2

    def fallen(t):
        """u0 − u, which is cn² at K − rate t."""
        return (u0 - u1) * ellipj(ellipk(m) - rate * t, m)[1] ** 2

    nodes, weights = np.polynomial.legendre.leggauss(400)
    drop = fallen(t / 2 * (1 + nodes))
    azimuth = t / 2 * np.sum(weights * a * drop / (1 - (u0 - drop) ** 2))
    height = u0 - fallen(t)
    across = np.sqrt(1 - height**2)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), height])


def _top_error(scene: scenes.Scene, path: Path) -> float:
    return np.abs(along(lambda q, v: third_axis(q), path)[-1] - top_axis(path.ts[-1])).max()


def sleeping_top(short: bool) -> Found:
    """Upright tops with spins about the critical one, I3²ω3² = 4 I1 M g l, all tilted by 1e-6 and let go.

    To first order in the tilt ζ, a complex number, I1 ζ̈ − i I3 ω3 ζ̇ − M g l ζ = 0: two circles above the critical spin,
    growth below it. Euler angles cannot even start here.
    """
    tilt, t = 1e-6, 3.0
    critical = np.sqrt(4 * TOP[0] * WEIGHT) / TOP[2]
    spins = critical * np.array([0.5, 0.8, 0.95, 0.99, 1.01, 1.05, 1.2, 2.0])
    starts = [rigid_body(TOP, (0.0, 0.0, spin), (0.0, 0.0, WEIGHT), tilt) for spin in spins]
    q0, qdot0 = (np.stack([getattr(s, name) for s in starts]) for name in ("q0", "qdot0"))
    scene = starts[0]
    seconds, run = follow_batch(scene, q0, qdot0, np.array([0.0, t]), scene.params, (0, 0, None))
    axis = np.asarray(jax.vmap(third_axis)(run.q[:, -1]))
    # ζ = e^{iλt} with I1 λ² − I3 ω3 λ + M g l = 0, from ζ = tilt and ζ̇ = 0.
    half = TOP[2] * spins / (2 * TOP[0])
    root = np.sqrt(half**2 - WEIGHT / TOP[0] + 0j)
    first, second = half + root, half - root
    exact = tilt * (first * np.exp(1j * second * t) - second * np.exp(1j * first * t)) / (first - second)
    error = np.abs(axis[:, 0] + 1j * axis[:, 1] - exact) / np.abs(exact)
    residual = float(jnp.abs(run.constraint_residual()["unit"]).max())
    return Found(float(error.max()), residual, int(run.stats["num_steps"].sum()), seconds)


# Kovalevskaya's top: I1 = I2 = 2 I3, the centre of mass on the first axis.
KOVALEVSKAYA, PULL = (2.0, 2.0, 1.0), 1.5


def _kovalevskaya_error(scene: scenes.Scene, path: Path) -> float:
    """The change of |(ω1 + i ω2)² − (M g l/I3)(γ1 + i γ2)|², relative to its parts."""

    def parts(q, v):
        rates, up = body_rates(q, v), vertical(q)
        return jnp.stack([rates[0] ** 2 - rates[1] ** 2, 2 * rates[0] * rates[1], PULL * up[0], PULL * up[1]])

    values = along(parts, path)
    xi = (values[:, 0] - values[:, 2]) ** 2 + (values[:, 1] - values[:, 3]) ** 2
    return np.abs(xi - xi[0]).max() / np.sum(values**2, axis=1).max()


def lagrange_top() -> scenes.Scene:
    """Let go with its axis at rest in space: no rate across it."""
    return rigid_body(TOP, (0.0, 0.0, TOP_SPIN), (0.0, 0.0, WEIGHT), TOP_TILT)


def kovalevskaya_top() -> scenes.Scene:
    """S. Kowalevski, Acta Mathematica 12 (1889) 177."""
    return rigid_body(KOVALEVSKAYA, (0.3, 0.8, 0.5), (PULL, 0.0, 0.0), 0.9)


CASES = (
    Case(
        name="Free rigid body, t = 12",
        reference="sn, cn, dn by mpmath",
        accuracy=EPS,
        bound=1e-13,
        because="some fifty steps of round-off; the phase grows linearly",
        scene=lambda: rigid_body(MOMENTS, SCALES * np.array([0.0, 1.0, 1.0])),
        ts=np.linspace(0.0, 12.0, 13),
        error=_jacobi_error,
    ),
    Case(
        name="Dzhanibekov's body, 10 flips",
        reference="sn, cn, dn by mpmath",
        accuracy=EPS,
        bound=1e-9,
        because="each flip starts 1e-2 from an unstable axis, which magnifies what rounding leaves e^(rate·time) times",
        scene=lambda: rigid_body(FLIPPING, SPIN),
        ts=FLIP * np.linspace(0.0, 10.0, 21),
        error=_flip_error,
    ),
    Case(
        name="Lagrange's top: nutation, precession",
        reference="cn and quadrature by SciPy",
        accuracy=1e-14,
        bound=1e-11,
        because="a phase that grows linearly over some ten nutations",
        scene=lagrange_top,
        ts=np.linspace(0.0, 12.0, 13),
        error=_top_error,
    ),
    Experiment(
        name="Sleeping top, about its critical spin",
        reference="first order in a tilt of 1e-6",
        accuracy=1e-8,
        bound=1e-7,
        because="the next order is the square of the tilt, 1e-4 where it has grown; its round-off is 1e-16/1e-6",
        run=sleeping_top,
    ),
    Case(
        name="Kovalevskaya's top, t = 100",
        reference="her integral",
        accuracy=0.0,
        bound=1e-12,
        because="some thousand steps of round-off, which add like a random walk",
        scene=kovalevskaya_top,
        ts=np.linspace(0.0, 100.0, 101),
        error=_kovalevskaya_error,
    ),
)
