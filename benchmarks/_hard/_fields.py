"""Charges: near the speed of light, in a magnetic field, and trapped by a dipole."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np

import lagjax
from benchmarks._hard._case import EPS, Case, Path, changes
from lagjax import scenes


def _accelerated_error(scene: scenes.Scene, path: Path) -> float:
    """x = (√(1 + (E t)²) − 1)/E from rest, E = 3; relative."""
    exact = [(mp.sqrt(1 + (3 * mp.mpf(t)) ** 2) - 1) / 3 for t in path.ts[1:]]
    return max(abs(float(x / y - 1)) for x, y in zip(path.q[1:, 0], exact, strict=True))


SPEED, TURNS = 0.9999, 100  # γ = 71


def fast_gyration() -> scenes.Scene:
    """A charge with γ = 71 across B = 2: its mass matrix has the condition γ²."""
    scene, B = scenes.relativistic_charge_in_magnetic_field(), 2.0
    gamma = 1 / np.sqrt((1 - SPEED) * (1 + SPEED))
    return scenes.Scene(
        scene.system, scene.params, np.array([SPEED * gamma / B, 0.0, 0.0]), np.array([0.0, -SPEED, 0.0]),
        TURNS * 2 * np.pi * gamma / B, scene.invariants,
    )  # fmt: skip


def _gyration_error(scene: scenes.Scene, path: Path) -> float:
    """A circle of radius r0 at the frequency B/γ, from the doubles that the run starts from; relative to the radius."""
    with mp.workdps(30):
        v = mp.mpf(scene.qdot0[1])
        w = 2 * mp.sqrt(1 - v**2)
        radius = -v / w
        centre = mp.mpf(scene.q0[0]) - radius
        turned = [(centre + radius * mp.cos(w * mp.mpf(t)), -radius * mp.sin(w * mp.mpf(t))) for t in path.ts]
    return np.abs(path.q[:, :2] - np.array(turned, float)).max() / float(radius)


def _dipole_lagrangian(q, qdot):
    r = jnp.sqrt(q @ q)
    return 0.5 * qdot @ qdot + (q[0] * qdot[1] - q[1] * qdot[0]) / r**3


def _canonical_momentum(q, qdot, t, params):
    return q[0] * qdot[1] - q[1] * qdot[0] + (q[0] ** 2 + q[1] ** 2) / (q @ q) ** 1.5


_DIPOLE = lagjax.System(_dipole_lagrangian)


def dipole() -> scenes.Scene:
    """Störmer's problem: a charge in the field of a dipole along z, A = (−y, x, 0)/r³, trapped as in a radiation belt.

    C. Störmer, The Polar Aurora (1955); A. J. Dragt, Reviews of Geophysics 3 (1965) 255.
    """
    return scenes.Scene(
        system=_DIPOLE,
        params={},
        q0=np.array([0.7, 0.0, 0.0]),
        qdot0=np.array([0.1, 0.0, 0.15]),
        duration=500.0,
        invariants={"energy": _DIPOLE.energy, "p_phi": _canonical_momentum},
    )


def _dipole_error(scene: scenes.Scene, path: Path) -> float:
    return changes(scene, path, "p_phi").max()


def _dipole_symbolic(ops, q, v):
    r = ops.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    return 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2) + (q[0] * v[1] - q[1] * v[0]) / r**3


CASES = (
    Case(
        name="Charge from rest to v = 0.9994",
        reference="hyperbola, mpmath",
        accuracy=EPS,
        bound=1e-14,
        because="some tens of steps of round-off, and 1 − v² keeps its digits only as far as v does",
        scene=scenes.relativistic_charge_in_electric_field,
        ts=np.linspace(0.0, 10.0, 11),
        error=_accelerated_error,
        drift_bound=1e-11,
    ),
    Case(
        name="Charge at γ = 71, 100 turns in B",
        reference="circle at B/γ, mpmath",
        accuracy=EPS,
        bound=1e-8,
        because="a rounding error of v is one of γ, γ² = 5000 times larger, and adds up in the phase over 32 000 steps",
        scene=fast_gyration,
        ts=np.linspace(0.0, fast_gyration().duration, 101),
        error=_gyration_error,
    ),
    Case(
        name="Störmer's dipole, trapped, t = 500",
        reference="p_φ",
        accuracy=0.0,
        bound=1e-12,
        because="round-off of thousands of steps, which adds like a random walk",
        scene=dipole,
        ts=np.linspace(0.0, 500.0, 501),
        error=_dipole_error,
        symbolic=_dipole_symbolic,
    ),
)
