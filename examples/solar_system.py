"""The solar system for a year from JPL's DE421, with and without general relativity, against JPL's own positions.

python examples/solar_system.py --out out
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax
from lagjax import scenes
from lagjax.scenes import de421

COMPARED = ("mercury", "venus", "earth", "mars", "jupiter", "saturn", "uranus", "neptune", "pluto")
DRAWN = {"mercury": "0.45", "venus": "#E69F00", "earth": "#0072B2", "mars": "#D55E00"}
DAYS = tuple(de421.LATER_POSITIONS)
SHARPEST = {"rtol": 1e-13, "atol": 1e-16}  # AU and AU/day: the integration then adds less than a metre


def heliocentric(positions):
    """Positions as seen from the Sun, which is the first body; (..., body, 3)."""
    return positions - positions[..., :1, :]


def integrate(scene, days):
    """Heliocentric positions in AU at these days, which begin with 0."""
    trajectory = lagjax.simulate(scene.system, scene.q0, scene.qdot0, jnp.asarray(days), scene.params, **SHARPEST)
    return np.asarray(heliocentric(trajectory.q))


def distances_to_jpl(positions, days):
    """{day: km for every body}, for each of JPL's days among `days`."""
    errors = {}
    for day in DAYS:
        difference = positions[np.flatnonzero(days == day)[0]] - heliocentric(de421.LATER_POSITIONS[day])
        errors[day] = np.linalg.norm(difference, axis=-1) * de421.AU
    return errors


def print_table(relativistic, newtonian):
    print("Distance to JPL DE421, heliocentric, in km")
    print(f"{'':10s}" + "".join(f"{f'after {day:g} days':>26s}" for day in DAYS))
    print(f"{'':10s}" + f"{'relativistic':>15s}{'Newton':>11s}" * len(DAYS))
    for name in COMPARED:
        body = de421.BODIES.index(name)
        cells = [f"{relativistic[day][body]:15.4f}{newtonian[day][body]:11.3f}" for day in DAYS]
        print(f"{name:10s}" + "".join(cells))


def draw_orbits(positions):
    """The inner planets as seen from the Sun, in the plane of the Earth's orbit, and where they are at the end."""
    tilt = np.deg2rad(23.4393)  # of the Earth's axis, between the ICRF's equator and the ecliptic
    x, y = positions[..., 0], np.cos(tilt) * positions[..., 1] + np.sin(tilt) * positions[..., 2]
    _, ax = plt.subplots(figsize=(6.4, 6.4), layout="constrained")
    for name, color in DRAWN.items():
        body = de421.BODIES.index(name)
        ax.plot(x[:, body], y[:, body], color=color, linewidth=1.5)
        end = np.array([x[-1, body], y[-1, body]])
        ax.plot(*end, "o", color=color, markersize=7)
        outward = 19 * end / np.linalg.norm(end)
        name = name.capitalize()
        ax.annotate(name, end, outward, textcoords="offset points", color=color, ha="center", va="center", size="small")
    ax.plot(0, 0, "o", color="#F0E442", markeredgecolor="#E69F00", markersize=13)
    ax.grid(color="0.92")
    ax.spines[["top", "right"]].set_visible(False)
    ax.set(aspect="equal", xlim=(-1.75, 1.75), ylim=(-1.75, 1.75))
    ax.set(xlabel="x [AU]", ylabel="y [AU]", title="One year from 28 June 1969, in the ecliptic")
    return ax.figure


def draw_errors(days, einstein, newton, relativistic, newtonian):
    """Lines: what relativity does. Circles: Newton against JPL. Dots: relativity against JPL."""
    _, ax = plt.subplots(figsize=(7.2, 4.8), layout="constrained")
    for name, color in DRAWN.items():
        body = de421.BODIES.index(name)
        effect = np.linalg.norm(newton[:, body] - einstein[:, body], axis=-1) * de421.AU
        ax.plot(days[1:], effect[1:], color=color, linewidth=1.3)
        ax.plot(DAYS, [newtonian[day][body] for day in DAYS], "o", color=color, markerfacecolor="white")
        ax.plot(DAYS, [relativistic[day][body] for day in DAYS], "o:", color=color, label=name.capitalize())
    ax.text(1.3, 40, "Newton: circles from JPL,\nlines from the relativistic motion", color="0.35")
    ax.text(110, 2e-3, "with relativity,\nfrom JPL", color="0.35")
    ax.set(xscale="log", yscale="log", xlabel="days", ylabel="heliocentric distance [km]")
    ax.set(title="What general relativity does to the planets", xlim=(1, 450))
    ax.grid(color="0.92")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, loc="lower right", ncols=2)
    return ax.figure


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures (default: %(default)s)")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    days = np.union1d(np.linspace(0.0, max(DAYS), 731), DAYS)
    einstein, newton = (integrate(scene(), days) for scene in (scenes.solar_system, scenes.newtonian_solar_system))
    relativistic, newtonian = distances_to_jpl(einstein, days), distances_to_jpl(newton, days)
    print_table(relativistic, newtonian)

    figures = {
        "solar_system_orbits.png": draw_orbits(einstein),
        "solar_system_relativity.png": draw_errors(days, einstein, newton, relativistic, newtonian),
    }
    for name, figure in figures.items():
        figure.savefig(options.out / name, dpi=200)
        plt.close(figure)
    return [options.out / name for name in figures], relativistic, newtonian


if __name__ == "__main__":
    for picture in main()[0]:
        print(picture)
