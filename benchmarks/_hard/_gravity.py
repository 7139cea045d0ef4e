"""Gravity: close passages, closed orbits of three bodies, relativity in the solar system and near a black hole."""

import csv
from pathlib import Path as File
from typing import NamedTuple

import jax
import mpmath as mp
import numpy as np

import lagjax
from benchmarks._hard._case import EPS, RTOL, Case, Experiment, Found, Path, drift, follow_batch
from lagjax import scenes
from lagjax.scenes import de421

DATA = File(__file__).parents[3] / "shared" / "data"  # beside the repository: measured and published numbers


# ---- Kepler ----------------------------------------------------------------------------------------------------------


def kepler_position(q0, qdot0, t) -> np.ndarray:
    """The position after the time t from the pericentre on the x axis, GM = 1, from the numbers as they are.

    A double next to 1 − e = 0.0001 is off by 1e-13 of it, which moves the end by more than an integrator does: the
    ellipse is that of the rounded start.
    """
    with mp.workdps(50):
        r, v, t = mp.mpf(q0[0]), mp.mpf(qdot0[1]), mp.mpf(t)
        a = 1 / (2 / r - v**2)
        e = 1 - r / a
        M = mp.fmod(t / a**1.5, 2 * mp.pi)
        low, high = mp.mpf(0), 2 * mp.pi
        for _ in range(170):  # bisection: E − e sin E is monotonous, and that is all that is certain near e = 1
            E = (low + high) / 2
            low, high = (E, high) if E - e * mp.sin(E) < M else (low, E)
        return np.array([a * (mp.cos(E) - e), a * mp.sqrt(1 - e**2) * mp.sin(E)], float)


def _kepler_error(scene: scenes.Scene, path: Path) -> float:
    return np.abs(path.end[0] - kepler_position(scene.q0, scene.qdot0, path.ts[-1])).max()


def _kepler_symbolic(ops, q, v):
    return 0.5 * (v[0] ** 2 + v[1] ** 2) + 1 / ops.sqrt(q[0] ** 2 + q[1] ** 2)


def _kepler(e: float, bound: float) -> Case:
    return Case(
        name=f"Kepler, e = {e:g}, t = 20",
        reference="Kepler's equation by mpmath",
        accuracy=EPS,
        bound=bound,
        because="round-off of r at the pericentre, magnified by 1/(1 − e) into the energy and by t into the phase",
        scene=lambda: scenes.kepler(e),
        ts=np.linspace(0.0, 20.0, 11),
        error=_kepler_error,
        drift_bound=1e-12,
        symbolic=_kepler_symbolic,
    )


PERIODS, STARTS = 100_000, 8


def kepler_for_long(short: bool) -> Found:
    """The energy after 10⁵ periods at e = 0.2, in units of ε√steps; root mean square over starts around the ellipse."""
    periods = 1000 if short else PERIODS
    _, (energy,), (place,), (steps,), seconds = long_kepler(0.2, [periods], STARTS)
    remark = f"energy error {energy:.1e}, place {place:.1e} after {periods} periods"
    return Found(float(energy / (EPS * np.sqrt(steps))), float(energy), int(STARTS * steps), seconds, remark)


def long_kepler(e: float, periods, starts: int):
    """Root mean squares of the relative energy error and of the error in place after so many periods; steps; seconds.

    The ellipse of every start is that of its rounded numbers, its mean anomaly by mpmath.
    """
    scene, E = scenes.kepler(e), 2 * np.pi * (0.1 + np.arange(starts)) / starts
    b, r = np.sqrt(1 - e**2), 1 - e * np.cos(E)
    q0 = np.stack([np.cos(E) - e, b * np.sin(E)], axis=1)
    qdot0 = np.stack([-np.sin(E) / r, b * np.cos(E) / r], axis=1)
    energy, place, steps, total = [], [], [], 0.0
    for count in periods:  # ends of runs: states between steps carry the rounding of the series besides
        ts = np.array([0.0, 2 * np.pi * count])
        # Below round-off: truncation has a sign, and adds up.
        seconds, run = follow_batch(scene, q0, qdot0, ts, scene.params, (0, 0, None), rtol=1e-16)
        end_q, end_v = np.asarray(run.q[:, -1]), np.asarray(run.qdot[:, -1])
        energies = [np.array([_energy(q, v) for q, v in zip(*state, strict=True)]) for state in
                    ((q0, qdot0), (end_q, end_v))]  # fmt: skip
        errors = np.array([float((after - before) / before) for before, after in zip(*energies, strict=True)])
        exact = np.array([_on_ellipse(q, v, ts[-1]) for q, v in zip(q0, qdot0, strict=True)])
        energy.append(np.sqrt(np.mean(errors**2)))
        place.append(np.sqrt(np.mean(np.sum((end_q - exact) ** 2, axis=1))))
        steps.append(float(np.mean(run.stats["num_accepted_steps"])))
        total += seconds
    return np.array(periods), np.array(energy), np.array(place), np.array(steps), total


def _energy(q, v):
    with mp.workdps(40):
        (x, y), (u, w) = map(mp.mpf, q), map(mp.mpf, v)
        return (u**2 + w**2) / 2 - 1 / mp.sqrt(x**2 + y**2)


def _on_ellipse(q, v, t) -> np.ndarray:
    """Lagrange's f and g functions, in forty digits."""
    with mp.workdps(40):
        (x, y), (u, w), t = map(mp.mpf, q), map(mp.mpf, v), mp.mpf(t)
        r0, radial = mp.sqrt(x**2 + y**2), x * u + y * w
        a = 1 / (2 / r0 - u**2 - w**2)
        c, s, n = 1 - r0 / a, radial / mp.sqrt(a), a**-1.5
        e, E0 = mp.sqrt(c**2 + s**2), mp.atan2(s, c)
        M = E0 - s + n * t
        turns = 2 * mp.pi * mp.floor(M / (2 * mp.pi))
        E = mp.findroot(lambda E: E - e * mp.sin(E) - (M - turns), M - turns)
        d = E - E0
        f, g = 1 - a / r0 * (1 - mp.cos(d)), (r0 / a * mp.sin(d) + s * (1 - mp.cos(d))) / n
        return np.array([f * x + g * u, f * y + g * w], float)


# ---- closed orbits ---------------------------------------------------------------------------------------------------


def _closure(scene: scenes.Scene, path: Path) -> float:
    return np.abs(path.end[0] - scene.q0).max()


def _three_body_symbolic(ops, q, v):
    to_earth = ops.sqrt((q[0] + 0.012277471) ** 2 + q[1] ** 2)
    to_moon = ops.sqrt((q[0] - (1 - 0.012277471)) ** 2 + q[1] ** 2)
    kinetic = 0.5 * ((v[0] - q[1]) ** 2 + (v[1] + q[0]) ** 2)
    return kinetic + (1 - 0.012277471) / to_earth + 0.012277471 / to_moon


def _bodies_symbolic(masses):
    def symbolic(ops, q, v):
        total = sum(0.5 * m * (v[2 * a] ** 2 + v[2 * a + 1] ** 2) for a, m in enumerate(masses))
        for a, m in enumerate(masses):
            for b in range(a):
                apart = ops.sqrt((q[2 * a] - q[2 * b]) ** 2 + (q[2 * a + 1] - q[2 * b + 1]) ** 2)
                total = total + m * masses[b] / apart
        return total

    return symbolic


def published_orbits() -> tuple[np.ndarray, np.ndarray]:
    """Velocities (v1, v2) and periods of 695 periodic orbits of three equal masses, to ten digits: X. Li, S. Liao,
    Science China Physics 60, 129511 (2017)."""
    with (DATA / "li_liao_planar_equal_mass_695.csv").open() as file:
        numbers = [[float(x) for x in row[1:4]] for row in csv.reader(file) if row and not row[0].startswith("#")]
    rows = np.array(numbers)
    return rows[:, :2], rows[:, 2]


def _no_orbits() -> str | None:
    return None if (DATA / "li_liao_planar_equal_mass_695.csv").exists() else "the list of orbits is not there"


def orbits_close(short: bool) -> Found:
    """All orbits in one batch, and again with each printed number half a unit of its last digit off.

    Ten digits of an unstable orbit do not close it. What half a unit does to the end says how near it can come; the
    error is the median failure to close in units of that, or infinite where an orbit did not arrive; the drift is the
    median change of the energy. The time is scaled to the period: G m becomes G m T².
    """
    velocities, periods = published_orbits()
    if short:
        velocities, periods = velocities[:40], periods[:40]
    nudges = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 5e-11
    v = np.concatenate([velocities + nudge[:2] for nudge in nudges])
    T = np.concatenate([periods + nudge[2] for nudge in nudges])
    scene = scenes.figure_eight()
    qdot0 = np.stack([v, v, -2 * v], axis=1) * T[:, None, None]
    GM = np.repeat(T[:, None] ** 2, 3, axis=1)
    ends, kept = np.full((len(T), 6), np.nan), np.full(len(T), np.inf)
    left, steps, seconds, refused = np.arange(len(T)), 0, 0.0, []
    for rtol in (RTOL, 1e-13, 1e-11, 1e-9):  # bodies that nearly touch refuse what is tighter than their round-off
        took, run = follow_batch(
            scene, scene.q0, qdot0[left], np.array([0.0, 1.0]), {"GM": GM[left]}, (None, 0, 0), rtol=rtol
        )
        ok, energy = np.asarray(run.ok), np.asarray(run.energy())
        ends[left[ok]] = np.asarray(run.q)[ok, -1].reshape(-1, 6)
        kept[left[ok]] = np.abs(energy[ok, -1] / energy[ok, 0] - 1)
        seconds, steps, left = seconds + took, steps + int(run.stats["num_steps"].sum()), left[~ok]
        if not len(left):
            break
        refused.append(f"{len(left)} refused {rtol:.0e}")
    ends = ends.reshape(len(nudges), len(periods), 6)
    apart = np.abs(ends[0] - scene.q0.ravel()).max(axis=1)
    permitted = np.abs(ends[1:] - ends[0]).max(axis=2).sum(axis=0)
    known = np.isfinite(ends).all(axis=(0, 2))
    ratio = (apart / permitted)[known]
    remark = f"{np.sum(ratio <= 1)} of {len(ratio)} close within that, 99 % within {np.quantile(ratio, 0.99):.0f} times"
    remark += f"; of {len(T)} runs " + (", ".join(refused) or "none refused")
    arrived = np.isfinite(apart).all()
    return Found(float(np.median(ratio)) if arrived else np.inf, float(np.median(kept)), steps, seconds, remark)


# ---- three bodies meet -----------------------------------------------------------------------------------------------


def pythagoras() -> scenes.Scene:
    """Masses 3, 4, 5 at rest on the corners opposite the sides 3, 4, 5: Burrau's problem. C. Burrau, Astronomische
    Nachrichten 195 (1913) 113; V. Szebehely, C. F. Peters, Astronomical Journal 72 (1967) 876."""
    return scenes.n_body([3.0, 4.0, 5.0], [[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]], np.zeros((3, 2)), duration=70.0)


def _momentum_and_energy(scene: scenes.Scene, path: Path) -> float:
    return drift(scene, path) or 0.0


# ---- relativity ------------------------------------------------------------------------------------------------------

# Heliocentric distance to DE421 after 365.25 days, km, by an independent program: with and without relativity.
KILOMETRES = {
    "mercury": (0.132, 335.0),
    "venus": (0.026, 95.4),
    "earth": (0.230, 50.6),
    "mars": (0.332, 32.1),
    "jupiter": (0.084, 0.573),
}


def distances_to_jpl(scene: scenes.Scene, path: Path) -> dict[str, float]:
    """Kilometres from the positions of DE421 at the end of the year, seen from the Sun."""
    q, jpl = path.end[0], de421.LATER_POSITIONS[365.25]
    apart = np.linalg.norm((q - q[0]) - (jpl - jpl[0]), axis=1) * de421.AU
    return dict(zip(de421.BODIES, apart, strict=True))


def _relativistic_error(scene: scenes.Scene, path: Path) -> float:
    found = distances_to_jpl(scene, path)
    return max(abs(found[body] - km) for body, (km, _) in KILOMETRES.items())


def _newtonian_error(scene: scenes.Scene, path: Path) -> float:
    found = distances_to_jpl(scene, path)
    return max(abs(found[body] / km - 1) for body, (_, km) in KILOMETRES.items())


class Geodesic(NamedTuple):
    """Schwarzschild's time, radius and angle, in units of the mass."""

    t: jax.Array
    r: jax.Array
    phi: jax.Array


def _geodesic_lagrangian(q, qdot):
    lapse = 1 - 2 / q.r
    return 0.5 * (-lapse * qdot.t**2 + qdot.r**2 / lapse + q.r**2 * qdot.phi**2)


_SCHWARZSCHILD = lagjax.System(_geodesic_lagrangian)
LATUS, ECCENTRICITY = 7.2, 0.5  # p/M and e: close to the last stable orbit, p = 6 + 2e


def schwarzschild() -> scenes.Scene:
    """A zoom-whirl orbit from its pericentre r = p/(1 + e), by its proper time; M is indefinite.

    E² = ((p−2)² − 4e²)/(p(p−3−e²)), L² = p²/(p−3−e²). S. Chandrasekhar, The Mathematical Theory of Black Holes, §19.
    """
    p, e = LATUS, ECCENTRICITY
    E, L = np.sqrt(((p - 2) ** 2 - 4 * e**2) / (p * (p - 3 - e**2))), p / np.sqrt(p - 3 - e**2)
    r = p / (1 + e)
    return scenes.Scene(
        system=_SCHWARZSCHILD,
        params={},
        q0=Geodesic(0.0, r, 0.0),
        qdot0=Geodesic(E / (1 - 2 / r), 0.0, L / r**2),
        duration=2000.0,
        invariants={"norm": _SCHWARZSCHILD.energy},
    )


def geodesic_radius(phi: float) -> float:
    """r(φ) of that orbit: p/r = 1 + e cos χ with sin(χ/2 − π/2) = sn, an elliptic function of φ."""
    with mp.workdps(25):
        p, e = mp.mpf(LATUS), mp.mpf(ECCENTRICITY)
        m = 4 * e / (p - 6 + 2 * e)
        half = mp.ellipk(m) - mp.sqrt((p - 6 + 2 * e) / p) * mp.mpf(phi) / 2
        return float(p / (1 - e * (1 - 2 * mp.ellipfun("sn", half, m=m) ** 2)))


def _geodesic_error(scene: scenes.Scene, path: Path) -> float:
    return max(abs(r - geodesic_radius(phi)) for r, phi in zip(path.q.r, path.q.phi, strict=True))


CASES = (
    _kepler(0.6, 1e-12),
    _kepler(0.99, 2e-10),
    _kepler(0.9999, 2e-8),
    Experiment(
        name="Kepler, e = 0.2, 10⁵ periods (units of ε√steps)",
        reference="energy, Brouwer's law",
        accuracy=0.0,
        bound=10.0,
        because="rounding errors of one step are independent of those of the next: their sum is a random walk",
        run=kepler_for_long,
    ),
    Case(
        name="Arenstorf's orbit closes",
        reference="published start and period",
        accuracy=6.5e-13,
        bound=1e-10,
        because="two close passages of the Moon magnify a rounding error 1e5 times",
        scene=scenes.restricted_three_body,
        ts=np.linspace(0.0, scenes.restricted_three_body().duration, 101),
        error=_closure,
        symbolic=_three_body_symbolic,
    ),
    Case(
        name="Figure eight closes",
        reference="published start and period",
        accuracy=1.2e-13,
        bound=2e-12,
        because="a stable orbit in some fifty steps, and fourteen published digits",
        scene=scenes.figure_eight,
        ts=np.linspace(0.0, scenes.figure_eight().duration, 101),
        error=_closure,
        symbolic=_bodies_symbolic((1.0, 1.0, 1.0)),
    ),
    Experiment(
        name="695 orbits of three bodies close",
        reference="published ten digits; median in units of them",
        accuracy=1.0,
        bound=1.0,
        because="the sum over three numbers bounds, to first order, what rounding them does",
        run=orbits_close,
        missing=_no_orbits,
        drift_bound=1e-9,  # bodies within 1e-3 of each other: there the energy is a difference of large numbers
    ),
    Case(
        name="Burrau's three bodies, t = 70",
        reference="energy and momenta",
        accuracy=0.0,
        bound=1e-9,
        because="passages at 1e-4 lift the kinetic energy, and its round-off, 1e4 times above the total",
        scene=pythagoras,
        ts=np.linspace(0.0, 70.0, 701),
        error=_momentum_and_energy,
        drift_bound=1e-9,
        symbolic=_bodies_symbolic((3.0, 4.0, 5.0)),
    ),
    Case(
        name="Solar system, one year, relativistic (km)",
        reference="distance to JPL DE421",
        accuracy=2e-3,
        bound=3e-3,
        because="the distances to compare with are good to metres; the integration is good to centimetres",
        scene=scenes.solar_system,
        ts=np.array([0.0, 365.25]),
        error=_relativistic_error,
        rtol=1e-14,  # diffrax integrates: its error control is over all bodies at once
    ),
    Case(
        name="Solar system, one year, Newton (relative)",
        reference="distance to JPL DE421",
        accuracy=1e-3,
        bound=3e-3,
        because="the published distances have three digits",
        scene=scenes.newtonian_solar_system,
        ts=np.array([0.0, 365.25]),
        error=_newtonian_error,
        rtol=1e-13,
    ),
    Case(
        name="Schwarzschild, zoom-whirl orbit",
        reference="r(φ) by sn, mpmath",
        accuracy=EPS,
        bound=1e-9,
        because="next to the last stable orbit a rounding error grows by the whirl, e^(1..3) a turn",
        scene=schwarzschild,
        ts=np.linspace(0.0, 2000.0, 11),
        error=_geodesic_error,
    ),
)
