"""TRAPPIST-1: the masses and orbits of seven planets from the times at which they pass in front of their star.

Two files go in: transit times (planet 1 … 7, epoch, days, their errors), and a published fit to begin from and to
compare with (mass over the star's, period, a time of transit, e cos ω, e sin ω). All orbits lie in one plane. Agol,
Dorn, Grimm et al., "Refining the transit-timing and photometric analysis of TRAPPIST-1", Planet. Sci. J. 2 (2021) 1.

The elements are those of Jacobi coordinates, planet k about the centre of mass of the star and of those inside, at the
epoch at which they hold. Lengths scale out of transit times, and so does the mass of the star; the time that light
takes is left out, as there.

python examples/trappist1.py trappist1_transit_times.csv trappist1_elements_agol2021.csv
"""

import argparse
import csv
import time

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

EPOCH = 7257.93115525  # days, of the elements: BJD − 2 450 000
PLANETS = "bcdefgh"
GM = 0.0898 * 0.00029591220828559104  # of the star, AU³/day²
FIRST, SECOND = np.triu_indices(1 + len(PLANETS), 1)
ELEMENTS = dict(
    ecosw="ecosw", esinw="esinw", mass="mass_over_star", period="period_days", transit="transit_time_days"
)  # fmt: skip
KEPLER_STEPS = 6  # of Newton: eccentricities are below 0.02


def lagrangian(q, qdot, params):
    """The star and its planets, q (8, 2), in units of the star's mass."""
    mass = jnp.concatenate([jnp.ones(1), params["mass"]])
    apart = q[FIRST] - q[SECOND]
    potential = GM * jnp.sum(mass[FIRST] * mass[SECOND] / jnp.sqrt(jnp.sum(apart**2, axis=1)))
    return 0.5 * jnp.sum(mass[:, None] * qdot**2) + potential


def start(params):
    """Positions and velocities at the epoch, (8, 2) each, about the centre of mass, from the elements.

    The observer looks along the second axis, from below: a planet passes in front of the star at the longitude −π/2.
    """
    mass, n = params["mass"], 2 * jnp.pi / params["period"]
    e = jnp.hypot(params["ecosw"], params["esinw"])
    pericentre = jnp.arctan2(params["esinw"], params["ecosw"])
    size = (GM * (1 + jnp.cumsum(mass)) / n**2) ** (1 / 3)
    root = jnp.sqrt(1 - e**2)
    at_transit = 2 * jnp.arctan2(jnp.sqrt(1 - e) * jnp.tan(-0.25 * jnp.pi - 0.5 * pericentre), jnp.sqrt(1 + e))
    mean = at_transit - e * jnp.sin(at_transit) + n * (EPOCH - params["transit"])
    anomaly = mean
    for _ in range(KEPLER_STEPS):
        anomaly = anomaly - (anomaly - e * jnp.sin(anomaly) - mean) / (1 - e * jnp.cos(anomaly))
    c, s = jnp.cos(anomaly), jnp.sin(anomaly)
    rate = n / (1 - e * c)
    turn = jnp.stack([jnp.cos(pericentre), jnp.sin(pericentre)]), jnp.stack([-jnp.sin(pericentre), jnp.cos(pericentre)])
    r = (size * ((c - e) * turn[0] + root * s * turn[1])).T
    v = (size * rate * (-s * turn[0] + root * c * turn[1])).T
    return barycentric(r, mass), barycentric(v, mass)


def barycentric(jacobi, mass):
    """Vectors (8, 2) of star and planets about their common centre, from those of Jacobi (7, 2)."""
    inner, centre, vectors = 1.0, jnp.zeros(2), [jnp.zeros(2)]
    for m, own in zip(mass, jacobi, strict=True):
        vectors.append(centre + own)
        centre = (inner * centre + m * vectors[-1]) / (inner + m)
        inner = inner + m
    return jnp.stack(vectors) - centre


class Transit:
    """How far a planet is beside its star; it passes in front of it where that rises."""

    def __init__(self, planet):
        self.planet = planet

    def __call__(self, q, qdot):
        """The distance."""
        return q[1 + self.planet, 0] - q[0, 0]

    def __eq__(self, other):
        return isinstance(other, Transit) and self.planet == other.planet

    def __hash__(self):
        return hash(self.planet)


SCENE = lagjax.System(lagrangian)
SECTIONS = {name: Transit(k) for k, name in enumerate(PLANETS)}


def published(file):
    """The elements of a published fit, arrays (7,) by name."""
    with open(file) as lines:
        rows = [row for row in csv.DictReader(lines) if row["body"] in PLANETS]
    return {name: np.array([float(row[column]) for row in rows]) for name, column in ELEMENTS.items()}


def observations(file, elements):
    """The transits as `lagjax.Timings`. Which transit each is follows from the elements: they are off by minutes."""
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    of = {name: table[table[:, 0] == k + 1] for k, name in enumerate(PLANETS)}
    orbits = (elements["transit"] - EPOCH) / elements["period"]
    first = elements["transit"] - np.floor(orbits) * elements["period"]
    numbers = {
        name: np.round((rows[:, 2] - first[k]) / elements["period"][k]) for k, (name, rows) in enumerate(of.items())
    }
    return lagjax.Timings(
        SECTIONS, {name: rows[:, 2] for name, rows in of.items()}, t0=EPOCH, start=start, numbers=numbers, direction=1,
        weights={name: 1.0 / rows[:, 3] ** 2 for name, rows in of.items()},
    )  # fmt: skip


def squares(timings, residuals):
    """Σ (residual/error)², and how many there are."""
    z = np.concatenate([np.sqrt(timings.flat.weights[timings.flat.which == k]) * r for k, r in enumerate(residuals)])
    return float(np.sum(z**2)), len(z)


def main(arguments=None):
    """The best fit, and how far it is from the published one."""
    parser = argparse.ArgumentParser(description="Masses and orbits of the planets of TRAPPIST-1.")
    parser.add_argument("times", help="transit times: planet, epoch, days, error")
    parser.add_argument("elements", help="a published fit")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)

    elements = published(options.elements)
    timings = observations(options.times, elements)
    began = time.perf_counter()
    transforms = {**dict.fromkeys(elements), "mass": lagjax.positive}
    fit = lagjax.fit(SCENE, timings, elements, transforms=transforms, noise=lagjax.StudentT())
    took = time.perf_counter() - began
    chi, count = squares(timings, fit.residuals[0].values())
    print(fit)
    print(f"χ² {chi:.1f} of {count} transits, fitted in {took:.0f} s")
    deviation = np.sqrt(np.diag(fit.covariance.matrix)).reshape(len(elements), -1)
    off = {name: (np.asarray(fit.params[name]) - elements[name]) / deviation[k] for k, name in enumerate(ELEMENTS)}
    print("\nfrom the published fit, in standard deviations\nplanet " + "".join(f"{name:>9}" for name in off))
    for k, planet in enumerate(PLANETS):
        print(f"{planet:<7}" + "".join(f"{off[name][k]:>9.2f}" for name in off))
    return fit


if __name__ == "__main__":
    main()
