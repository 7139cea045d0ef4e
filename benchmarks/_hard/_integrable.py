"""Motions with as many constants as coordinates, or a closed form: nothing is chaotic, so every digit counts."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np

import lagjax
from benchmarks._hard._case import EPS, Case, Path, changes
from lagjax import scenes

# ---- swinging Atwood machine -----------------------------------------------------------------------------------------

SECOND_CONSTANT = 0.353553390593274  # published, at μ = 3


def _atwood_error(scene: scenes.Scene, path: Path) -> float:
    start = scene.invariants["second"](scene.q0, scene.qdot0, 0.0, scene.params)
    return max(changes(scene, path, "second").max(), abs(float(start) - SECOND_CONSTANT) - 5e-16)


def _atwood_symbolic(ops, q, v):
    return 2 * v[0] ** 2 + 0.5 * q[0] ** 2 * v[1] ** 2 + q[0] * ops.cos(q[1]) - 3.0 * q[0]


# ---- Toda ------------------------------------------------------------------------------------------------------------

SITES = 6


def _toda_lagrangian(q, qdot):
    return 0.5 * jnp.sum(qdot**2) - jnp.sum(jnp.exp(q - jnp.roll(q, -1)))


_TODA = lagjax.System(_toda_lagrangian)


def toda() -> scenes.Scene:
    """Toda's periodic lattice, L = ½ Σ q̇² − Σ exp(q_i − q_{i+1}). M. Toda, J. Phys. Soc. Japan 22 (1967) 431."""
    rng = np.random.default_rng(11)
    v = rng.uniform(-1.0, 1.0, SITES)
    return scenes.Scene(_TODA, {}, np.zeros(SITES), v - v.mean(), 100.0, {"energy": _TODA.energy})


def _lax_error(scene: scenes.Scene, path: Path) -> float:
    """The eigenvalues of Lax's matrix do not move. H. Flaschka, Physical Review B 9 (1974) 1924."""

    def spectrum(q, v):
        a = 0.5 * np.exp((q - np.roll(q, -1)) / 2)
        lax, next_ = np.diag(0.5 * v), np.roll(np.arange(SITES), -1)
        lax[np.arange(SITES), next_] = lax[next_, np.arange(SITES)] = a
        return np.linalg.eigvalsh(lax)

    spectra = np.array([spectrum(q, v) for q, v in zip(path.q, path.qdot, strict=True)])
    return np.abs(spectra - spectra[0]).max()


def _toda_symbolic(ops, q, v):
    kinetic = sum(0.5 * rate**2 for rate in v)
    return kinetic - sum(ops.exp(q[i] - q[(i + 1) % SITES]) for i in range(SITES))


# ---- Calogero and Moser ----------------------------------------------------------------------------------------------


def _calogero_lagrangian(q, qdot):
    i, j = np.triu_indices(len(q), 1)
    return 0.5 * jnp.sum(qdot**2) - jnp.sum(1 / (q[i] - q[j]) ** 2)


_CALOGERO = lagjax.System(_calogero_lagrangian)


def calogero() -> scenes.Scene:
    """Particles on a line that repel each other by 1/x², running into each other. F. Calogero, J. Math. Phys. 12 (1971)
    419; J. Moser, Advances in Mathematics 16 (1975) 197."""
    q0, v = np.array([-4.0, -1.9, 0.3, 2.1, 4.4]), np.array([3.0, 1.5, 0.2, -1.1, -3.5])
    return scenes.Scene(_CALOGERO, {}, q0, v, 10.0, {"energy": _CALOGERO.energy})


def calogero_places(q0, qdot0, t) -> np.ndarray:
    """The eigenvalues of X + t L, with X = diag(q0) and L = diag(q̇0) + i/(x_j − x_k) beside the diagonal."""
    with mp.workdps(30):
        n = len(q0)
        matrix = mp.matrix(n, n)
        for j in range(n):
            for k in range(n):
                x = mp.mpf(q0[j]) - mp.mpf(q0[k])
                matrix[j, k] = x + mp.mpf(q0[k]) + t * mp.mpf(qdot0[j]) if j == k else mp.mpc(0, 1) * t / x
        return np.sort(np.array([float(x) for x in mp.eighe(matrix, eigvals_only=True)]))


def _calogero_error(scene: scenes.Scene, path: Path) -> float:
    errors = [
        np.abs(np.sort(q) - calogero_places(scene.q0, scene.qdot0, mp.mpf(t))).max()
        for t, q in zip(path.ts, path.q, strict=True)
    ]
    return max(errors)


def _calogero_symbolic(ops, q, v):
    pairs = [(i, j) for i in range(5) for j in range(i)]
    return sum(0.5 * rate**2 for rate in v) - sum((q[i] - q[j]) ** -2.0 for i, j in pairs)


# ---- a cycloid, and Foucault -----------------------------------------------------------------------------------------


def _cycloid_lagrangian(q, qdot):
    # x = φ − sin φ, y = 1 + cos φ: by half angles, as 1 − cos φ loses its digits where the mass matrix is small.
    return 4 * jnp.sin(q / 2) ** 2 * 0.5 * qdot**2 - 2 * 9.81 * jnp.cos(q / 2) ** 2


_CYCLOID = lagjax.System(_cycloid_lagrangian)
HIGH = 0.01  # rad from the cusp, where the mass matrix is 1e-4 of what it is below


def cycloid() -> scenes.Scene:
    """A bead on a cycloid, let go next to its cusp, where the chart ends. Huygens, Horologium Oscillatorium (1673)."""
    period = 4 * np.pi / np.sqrt(9.81)
    return scenes.Scene(_CYCLOID, {}, HIGH, 0.0, 10 * period, {"energy": _CYCLOID.energy})


def _cycloid_error(scene: scenes.Scene, path: Path) -> float:
    """The arc from the bottom, 4 cos(φ/2), is harmonic at any amplitude: ω² = g/4."""
    with mp.workdps(30):
        omega, high = mp.sqrt(mp.mpf(9.81)) / 2, mp.cos(mp.mpf(HIGH) / 2)
        exact = np.array([high * mp.cos(omega * mp.mpf(t)) for t in path.ts], float)
    return 4 * np.abs(np.cos(path.q / 2) - exact).max()


OMEGA, TURN = np.sqrt(9.81 / 67.0), 7.2921159e-5 * np.sin(np.radians(48.8462))  # the Panthéon


def _foucault_lagrangian(q, qdot):
    return 0.5 * qdot @ qdot + TURN * (q[0] * qdot[1] - q[1] * qdot[0]) - 0.5 * OMEGA**2 * q @ q


_FOUCAULT = lagjax.System(_foucault_lagrangian)


def foucault() -> scenes.Scene:
    """Foucault's pendulum in the Panthéon, 67 m, for a day: small swings, seen from the turning floor."""
    return scenes.Scene(_FOUCAULT, {}, np.array([3.0, 0.0]), np.zeros(2), 86164.0, {"energy": _FOUCAULT.energy})


def _foucault_error(scene: scenes.Scene, path: Path) -> float:
    """z = x + i y obeys z̈ + 2 i Ω ż + ω² z = 0, two circles; metres."""
    with mp.workdps(30):
        turn, w = mp.mpf(TURN), mp.sqrt(mp.mpf(OMEGA) ** 2 + mp.mpf(TURN) ** 2)
        places = []
        for t in map(mp.mpf, path.ts):
            # z = e^{−iΩt} (3 cos wt + B sin wt) with ż = 0 at the start: B = 3 iΩ/w.
            z = mp.expj(-turn * t) * 3 * (mp.cos(w * t) + mp.mpc(0, 1) * turn / w * mp.sin(w * t))
            places.append((float(z.real), float(z.imag)))
    return np.abs(path.q - np.array(places)).max()


def _foucault_symbolic(ops, q, v):
    turning = float(TURN) * (q[0] * v[1] - q[1] * v[0])
    return 0.5 * (v[0] ** 2 + v[1] ** 2) + turning - 0.5 * float(OMEGA) ** 2 * (q[0] ** 2 + q[1] ** 2)


CASES = (
    Case(
        name="Swinging Atwood machine, t = 100",
        reference="its second constant, published at the start",
        accuracy=5e-16,
        bound=1e-13,
        because="round-off of some hundred steps, which adds like a random walk",
        scene=scenes.swinging_atwood,
        ts=np.linspace(0.0, 100.0, 101),
        error=_atwood_error,
        symbolic=_atwood_symbolic,
    ),
    Case(
        name="Toda lattice of 6, t = 100",
        reference="eigenvalues of Lax's matrix",
        accuracy=0.0,
        bound=1e-13,
        because="round-off of some hundred steps, which adds like a random walk",
        scene=toda,
        ts=np.linspace(0.0, 100.0, 101),
        error=_lax_error,
        symbolic=_toda_symbolic,
    ),
    Case(
        name="Calogero and Moser, 5 collide, t = 10",
        reference="eigenvalues of X + t L by mpmath",
        accuracy=EPS,
        bound=1e-12,
        because="velocities keep a rounding error of the collision, which moves places linearly after it",
        scene=calogero,
        ts=np.linspace(0.0, 10.0, 11),
        error=_calogero_error,
        symbolic=_calogero_symbolic,
    ),
    Case(
        name="Bead on a cycloid, from its cusp, 10 periods",
        reference="cosine by mpmath",
        accuracy=EPS,
        bound=1e-10,
        because="twenty visits to the cusp, where the chart magnifies round-off by 1/φ, 1e2, in place and in speed",
        scene=cycloid,
        ts=np.linspace(0.0, cycloid().duration, 81),
        error=_cycloid_error,
    ),
    Case(
        name="Foucault's pendulum, a day (m)",
        reference="two circles by mpmath",
        accuracy=EPS,
        bound=1e-9,
        because="5000 swings of 3 m: a rounding error of the frequency, or of time, is one of the phase",
        scene=foucault,
        ts=np.linspace(0.0, 86164.0, 25),
        error=_foucault_error,
        symbolic=_foucault_symbolic,
    ),
)
