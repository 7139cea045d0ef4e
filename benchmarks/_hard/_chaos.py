"""Stiff, long and chaotic motions: what remains true of them however sensitive they are."""

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._hard._case import RTOL, Case, Experiment, Found, Path, changes, drift, follow_batch, timed
from lagjax import scenes

# ---- stiff springs ---------------------------------------------------------------------------------------------------

FPU_ENERGY, FPU_TIME = 2.00120008, 1000.0


def _fpu_energy_error(scene: scenes.Scene, path: Path) -> float:
    start = float(scene.system.energy(scene.q0, scene.qdot0, 0.0, scene.params))
    return max(changes(scene, path, "energy").max(), abs(start - FPU_ENERGY)) / FPU_ENERGY


def _fpu_adiabatic_error(scene: scenes.Scene, path: Path) -> float:
    """How far the sum of the oscillatory energies moves, in units of 1/ω; it starts at 1."""
    parts = jax.vmap(lambda q, v: scenes.oscillatory_energies(q, v, scene.params))(path.q, path.qdot)
    total = np.asarray(parts).sum(axis=1)
    return np.abs(total - total[0]).max() * scene.params["omega"]


def _fpu_symbolic(ops, q, v):
    slow, fast = q[:3], q[3:]
    left = [s - f for s, f in zip(slow, fast, strict=True)]
    right = [s + f for s, f in zip(slow, fast, strict=True)]
    soft = left[0] ** 4 + right[2] ** 4 + sum((left[i + 1] - right[i]) ** 4 for i in range(2))
    return 0.5 * sum(x**2 for x in v) - 0.5 * 50.0**2 * sum(x**2 for x in fast) - 0.25 * soft


# ---- Hénon and Heiles ------------------------------------------------------------------------------------------------


def _henon_heiles_lagrangian(q, qdot):
    x, y = q
    return 0.5 * qdot @ qdot - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3


_HENON_HEILES = lagjax.System(_henon_heiles_lagrangian)


def henon_heiles() -> scenes.Scene:
    """The star of Hénon and Heiles at E = 1/6 − 1e-4, where almost all is chaos. Astronomical Journal 69 (1964) 73."""
    y, up, energy = -0.1, 0.1, 1 / 6 - 1e-4
    push = np.sqrt(2 * (energy - 0.5 * y**2 + y**3 / 3) - up**2)
    return scenes.Scene(
        _HENON_HEILES, {}, np.array([0.0, y]), np.array([push, up]), 1e4, {"energy": _HENON_HEILES.energy}
    )


def _energy_error(scene: scenes.Scene, path: Path) -> float:
    return drift(scene, path) or 0.0


def _henon_heiles_symbolic(ops, q, v):
    x, y = q
    return 0.5 * (v[0] ** 2 + v[1] ** 2) - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3.0


# ---- double pendulums ------------------------------------------------------------------------------------------------


def uneven(ratio: float) -> scenes.Scene:
    """A double pendulum whose lower mass is `ratio` times the upper one, swinging widely."""
    scene = scenes.double_pendulum()
    return scenes.Scene(scene.system, scene.params | {"m2": ratio}, scene.q0, scene.qdot0, 20.0, scene.invariants)


def _rods_lagrangian(q, qdot):
    (a, b), (u, v) = q, qdot
    return (4 * u**2 + v**2 + 3 * u * v * jnp.cos(a - b)) / 6 + 0.5 * 9.81 * (3 * jnp.cos(a) + jnp.cos(b))


_RODS = lagjax.System(_rods_lagrangian)


def no_flips(short: bool) -> Found:
    """Flips of double pendulums let go at rest where their energy forbids them, over a long time.

    Point masses: 2 cos θ1 + cos θ2 > 1; equal rods: 3 cos θ1 + cos θ2 > 2. J. S. Heyl, *The double pendulum fractal*
    (2008). As many members outside show that a flip would be seen.
    """
    members, rng, ts = (
        (32 if short else 512),
        np.random.default_rng(5),
        np.linspace(0.0, 50.0 if short else 1000.0, 501),
    )
    point_masses, rods = scenes.double_pendulum(), scenes.Scene(_RODS, None, np.zeros(2), np.zeros(2), 1.0, {})
    flips, outside, worst, steps, seconds = 0, 0, 0.0, 0, 0.0
    for scene, weight, least in ((point_masses, 2.0, 1.0), (rods, 3.0, 2.0)):
        theta = rng.uniform(-np.pi, np.pi, (8 * members, 2))
        height = weight * np.cos(theta[:, 0]) + np.cos(theta[:, 1])
        inside = theta[height > least][:members]
        q0 = np.concatenate([inside, theta[height < least][:members]])
        took, run = follow_batch(scene, q0, np.zeros_like(q0), ts, scene.params, (0, 0, None))
        flipped = np.abs(np.asarray(run.q)).max(axis=(1, 2)) > np.pi  # angles start within ±π and are continuous
        assert len(inside) == members and bool(run.ok.all())
        energy = np.asarray(run.energy())
        flips, outside = flips + int(flipped[:members].sum()), outside + int(flipped[members:].sum())
        worst = max(worst, float(np.abs(energy - energy[:, :1]).max()) / 9.81)
        steps, seconds = steps + int(run.stats["num_steps"].sum()), seconds + took
    assert outside > 0
    return Found(float(flips), worst, steps, seconds, f"{outside} of {2 * members} just outside do flip")


# ---- Lyapunov exponents ----------------------------------------------------------------------------------------------


def lyapunov(short: bool) -> Found:
    """The spectrum of a chaotic double pendulum is ±λ1, ±λ2, from derivatives of the flow in canonical coordinates.

    Over pieces of half a second the derivative is symplectic. In the order (q1, q2, p2, p1) its QR decomposition is
    Iwasawa's, whose diagonal holds a number and its inverse: the pairs hold at every time, not in the limit alone.
    """
    scene, pieces, length = scenes.double_pendulum(), (40 if short else 2000), 0.5
    system, params = scene.system, scene.params
    ts = length * np.arange(pieces + 1)
    run = lagjax.simulate(system, np.array([2.0, 2.5]), np.zeros(2), ts, params, rtol=RTOL)
    states = jnp.concatenate([run.q, run.qdot], axis=1)

    def canonical(y):
        return jnp.concatenate([y[:2], system.momentum(y[:2], y[2:], 0.0, params)[::-1]])

    def end(y):
        piece = lagjax.simulate(system, y[:2], y[2:], np.array([0.0, length]), params, rtol=1e-14, throw=False)
        return jnp.concatenate([piece.q[-1], piece.qdot[-1]])

    flow = jax.jit(jax.vmap(jax.jacfwd(end)))
    changes_of_chart = np.asarray(jax.jit(jax.vmap(jax.jacfwd(canonical)))(states))
    flow(states[:-1])  # compiles
    seconds, moved = timed(lambda: flow(states[:-1]))
    derivatives = changes_of_chart[1:] @ np.asarray(moved) @ np.linalg.inv(changes_of_chart[:-1])
    frame, growth = np.eye(4), np.zeros(4)
    for derivative in derivatives:
        frame, upper = np.linalg.qr(derivative @ frame)
        growth += np.log(np.abs(np.diag(upper)))
    exponents = growth / ts[-1]
    pairs = np.abs(exponents + exponents[::-1]).max()
    J = np.array([[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [-1, 0, 0, 0]], float)
    forms = np.swapaxes(derivatives, 1, 2) @ J @ derivatives - J
    sizes = np.linalg.norm(derivatives, axis=(1, 2)) ** 2
    remark = "exponents " + ", ".join(f"{x:+.3f}" for x in exponents)
    return Found(float(pairs), float((np.abs(forms).max(axis=(1, 2)) / sizes).max()), None, seconds, remark)


# ---- Kapitza ---------------------------------------------------------------------------------------------------------


def kapitza(short: bool) -> Found:
    """Upside down, with its pivot shaken by a cos Ωt, a pendulum becomes unstable where Mathieu's a0 says.

    Small angles obey Mathieu's equation with q = 2a/l and a characteristic value −4g/(lΩ²); on the border, a0(q), the
    derivative of the flow over a period has the trace 2.
    """
    from scipy.special import mathieu_a

    scene = scenes.driven_pendulum()
    amplitudes = np.array([0.02, 0.05, 0.1, 0.15, 0.2])
    Omega = np.sqrt(4 * scene.params["g"] / -mathieu_a(0, 2 * amplitudes / scene.params["l"]))
    # In units of 1/Ω every member has the period 2π; then lengths are in l and g becomes g/Ω².
    g = scene.params["g"] / Omega**2

    def over_a_period(y, a, g):
        params = scene.params | {"a": a, "g": g, "Omega": 1.0}
        run = lagjax.simulate(scene.system, y[0], y[1], np.array([0.0, 2 * np.pi]), params, rtol=1e-14, throw=False)
        return jnp.stack([run.q[-1], run.qdot[-1]])

    flow = jax.jit(jax.vmap(jax.jacfwd(over_a_period), in_axes=(None, 0, 0)))
    upright = jnp.array([np.pi, 0.0])
    flow(upright, amplitudes, g)
    seconds, derivatives = timed(lambda: flow(upright, amplitudes, g))
    derivatives = np.asarray(derivatives)
    # The trace turns by −2(2π)²·(change of g): what it is off by is an error of g, and so of the border.
    error = np.abs(np.trace(derivatives, axis1=1, axis2=2) - 2).max()
    return Found(float(error), float(np.abs(np.linalg.det(derivatives) - 1).max()), None, seconds)


# ---- chains ----------------------------------------------------------------------------------------------------------

# Straight chains of N unit links: printed conditions of the mass matrix, in angles from the vertical and from link to
# link, as strings, for their last digit says how good they are.
CONDITIONS = {
    2: ("6.9", "34"),
    5: ("45", "1.4e3"),
    10: ("175", "1.8e4"),
    20: ("678", "2.5e5"),
    50: ("4131", "8.7e6"),
    100: ("16370", "1.3e8"),
}


def _jointed_lagrangian(q, qdot, params):
    return scenes.chain(2).system.lagrangian(jnp.cumsum(q), jnp.cumsum(qdot), t=0.0, params=params)


_JOINTED = lagjax.System(_jointed_lagrangian)


def chain_conditions(short: bool) -> Found:
    """Conditions of straight chains, in half units of the last printed digit, and those of uneven double pendulums:
    1/r for a light lower mass, which a scaling of the coordinates removes, and 4r for a heavy one, which none does."""
    errors = []
    for n, printed in CONDITIONS.items():
        if short and n > 20:
            break
        params = {"m": np.ones(n), "l": np.ones(n), "g": 9.81}
        for system, text in zip((scenes.chain(n).system, _JOINTED), printed, strict=True):
            M = np.asarray(system.mass_matrix(np.zeros(n), np.zeros(n), 0.0, params))
            errors.append(abs(np.linalg.cond(M) - float(text)) / _half_unit(text))
    double = scenes.double_pendulum()
    for ratio, expected, scaled in ((1e-6, 1e6, 1.0), (1e6, 4e6, 4e6)):
        M = np.asarray(double.system.mass_matrix(np.zeros(2), np.zeros(2), 0.0, double.params | {"m2": ratio}))
        size = np.sqrt(np.diag(M))
        conditions = np.linalg.cond(M), np.linalg.cond(M / np.outer(size, size))
        # Both are the leading terms for extreme ratios: the next is √r of them.
        errors += [abs(found / truth - 1) / 1e-2 for found, truth in zip(conditions, (expected, scaled), strict=True)]
    return Found(float(max(errors)), None, None, None)


def _half_unit(text: str) -> float:
    mantissa, _, exponent = text.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 0.5 * 10.0 ** (int(exponent or 0) - decimals)


CASES = (
    Case(
        name="FPU chain, ω = 50, t = 1000",
        reference="energy, published at the start",
        accuracy=5e-9,
        bound=1e-8,
        because="the start is 2.00120008 to all digits; 30 000 steps of round-off lie far below its last",
        scene=scenes.fermi_pasta_ulam,
        ts=np.linspace(0.0, FPU_TIME, 2001),
        error=_fpu_energy_error,
        symbolic=_fpu_symbolic,
    ),
    Case(
        name="FPU chain, adiabatic invariant (units of 1/ω)",
        reference="O(1/ω), Hairer, Lubich & Wanner §XIII.6",
        accuracy=1.0,
        bound=5.0,
        because="a theorem, with a constant of order one",
        scene=scenes.fermi_pasta_ulam,
        ts=np.linspace(0.0, FPU_TIME, 2001),
        error=_fpu_adiabatic_error,
        peers=False,
    ),
    Case(
        name="Hénon and Heiles, chaotic, t = 10 000",
        reference="energy",
        accuracy=0.0,
        bound=1e-13,
        because="round-off of 20 000 steps, which adds like a random walk",
        scene=henon_heiles,
        ts=np.linspace(0.0, 1e4, 1001),
        error=_energy_error,
        symbolic=_henon_heiles_symbolic,
    ),
    Case(
        name="Double pendulum, masses 1 : 1e-6",
        reference="energy",
        accuracy=0.0,
        bound=1e-12,
        because="the mass matrix is scaled by its diagonal, after which it is as good as any",
        scene=lambda: uneven(1e-6),
        ts=np.linspace(0.0, 20.0, 201),
        error=_energy_error,
    ),
    Case(
        name="Double pendulum, masses 1 : 1e6",
        reference="energy",
        accuracy=0.0,
        bound=1e-9,
        because="aligned links have the condition 4e6, which magnifies round-off of the accelerations",
        scene=lambda: uneven(1e6),
        ts=np.linspace(0.0, 20.0, 201),
        error=_energy_error,
        drift_bound=1e-9,
        rtol=1e-12,  # tighter, round-off of the accelerations would halve every step
    ),
    Experiment(
        name="Double pendulums that cannot flip (flips)",
        reference="a theorem (Heyl)",
        accuracy=0.0,
        bound=0.0,
        because="a flip would need energy that is not there",
        run=no_flips,
        drift_bound=1e-9,
    ),
    Experiment(
        name="Lyapunov spectrum: λ and −λ",
        reference="pairs, by symplecticity",
        accuracy=0.0,
        bound=1e-9,
        because="round-off of half a second of chaos, times the growth in it, averaged over pieces",
        run=lyapunov,
    ),
    Experiment(
        name="Kapitza's pendulum at its border of stability",
        reference="Mathieu's a0 (SciPy)",
        accuracy=1e-14,
        bound=1e-11,
        because="derivatives are as accurate as the motion, some 1e-14 over one period",
        run=kapitza,
    ),
    Experiment(
        name="Condition of long chains (half units)",
        reference="printed digits",
        accuracy=1.0,
        bound=1.0,
        because="the mass matrix is exact to round-off; what is printed was rounded",
        run=chain_conditions,
    ),
)
