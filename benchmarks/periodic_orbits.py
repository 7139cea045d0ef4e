"""The published periodic orbits of three equal masses in the plane, closed to round-off, with their stability.

    python -m benchmarks.periodic_orbits ../shared/data/li_liao_planar_equal_mass_695.csv

The file has rows of a name, v1, v2 and the period; bodies begin at (−1, 0), (1, 0), (0, 0) with velocities (v1, v2),
(v1, v2), (−2 v1, −2 v2). Each orbit is followed in the two positions relative to one of the bodies, that one of the
three that keeps the others farthest from each other: where two bodies come close, their distance is then a coordinate,
which has all its digits, and not a difference of two, which would lose those that decide about what follows. All are
closed as a batch by `lagjax.periodic_orbit`, and what comes out is brought back to the form above. The exact orbit has
that form; how far the closed one is from it (`asymmetry`) tells how many digits are right: nothing has asked for it.

Source of the orbits: X. Li, S. Liao, *More than six hundred new families of Newtonian periodic planar collisionless
three-body orbits*, Sci. China Phys. Mech. Astron. 60 (2017) 129511.
"""

import argparse
import csv
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

# The other two bodies, by the one that positions are relative to.
OTHERS = ((1, 2), (0, 2), (0, 1))
GLANCES = 2000  # states of an orbit among which the smallest distances are looked for


def _lagrangian(q, qdot):
    (x, y), (dx, dy) = q, qdot
    kinetic = 0.5 * (dx @ dx + dy @ dy) - jnp.sum((dx + dy) ** 2) / 6
    return kinetic + 1 / jnp.sqrt(x @ x) + 1 / jnp.sqrt(y @ y) + 1 / jnp.sqrt((x - y) @ (x - y))


BODIES = lagjax.System(_lagrangian)


def main() -> None:
    """Read the file, close its orbits, print a summary, store the table."""
    jax.config.update("jax_enable_x64", True)
    options = _options().parse_args()
    with options.file.open() as lines:
        published = [row for row in csv.reader(lines) if row and not row[0].startswith(("#", "name"))]
    published = published[:: options.every]
    names, numbers = [row[0] for row in published], np.array([[float(x) for x in row[1:4]] for row in published])
    wall, cpu = time.perf_counter(), time.process_time()
    table = refine(numbers)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    _summary(names, numbers, table, wall, cpu)
    options.output.mkdir(exist_ok=True)
    _store(options.output / "periodic_orbits.csv", names, table)


def refine(published: np.ndarray) -> dict[str, np.ndarray]:
    """From v1, v2 and T (N, 3) the columns of the table, each with N rows."""
    r = np.zeros((len(published), 3, 2))
    r[:, 0, 0], r[:, 1, 0] = -1.0, 1.0
    v = published[:, None, :2] * np.array([1.0, 1.0, -2.0])[:, None]
    period = published[:, 2]
    centre = _best_centre(r, v, period)
    orbit = lagjax.periodic_orbit(BODIES, _relative(r, centre), _relative(v, centre), period)
    r, v = _bodies(orbit.q0, centre), _bodies(orbit.qdot0, centre)
    v1, v2, period, asymmetry = _in_published_form(r, v, np.asarray(orbit.period))
    columns = {"v1": v1, "v2": v2, "period": period, "asymmetry": asymmetry}
    columns |= {name: np.asarray(getattr(orbit, name)) for name in ("closure", "stable", "ok", "multipliers")}
    return columns | {"message": np.array(orbit.message, object)}


def _relative(x, centre) -> np.ndarray:
    """Of the bodies' x (N, 3, 2) those of the other two relative to the one that is the centre, (N, 2, 2)."""
    rows = np.arange(len(x))
    others = np.array(OTHERS)[centre]
    return np.stack([x[rows, others[:, k]] - x[rows, centre] for k in range(2)], axis=1)


def _bodies(x, centre) -> np.ndarray:
    """The bodies' x (N, 3, 2), their mean at rest at zero, from those relative to the centre."""
    x, rows = np.asarray(x), np.arange(len(centre))
    bodies = np.zeros((len(centre), 3, 2))
    for k in range(2):
        bodies[rows, np.array(OTHERS)[centre, k]] = x[:, k]
    return bodies - bodies.mean(axis=1, keepdims=True)


def _best_centre(r, v, period) -> np.ndarray:
    """The body of each orbit whose others stay farthest from each other, (N,)."""
    centre = np.full(len(r), 2)  # to look at them

    def path(q, u, end):
        ts = end * jnp.arange(GLANCES) / GLANCES
        return lagjax.simulate(BODIES, q, u, ts, rtol=1e-12, throw=False).q

    q = np.asarray(jax.jit(jax.vmap(path))(_relative(r, centre), _relative(v, centre), period / 2))
    x, y = q[:, :, 0], q[:, :, 1]
    apart = np.stack([np.nanmin(np.linalg.norm(side, axis=2), axis=1) for side in (y, x, x - y)])
    return np.argmax(apart, axis=0)


def _in_published_form(r, v, period) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """v1, v2, the period, and how far the state is from the published form where it comes nearest to it, each (N,).

    The start is shifted along the orbit to where the third body passes the middle of the others, turned, and scaled.
    """
    pull = np.asarray(jax.vmap(jax.grad(_attraction))(jnp.asarray(r)))
    offset, speed = (x[:, 2] - (x[:, 0] + x[:, 1]) / 2 for x in (r, v))
    dt = -(np.sum(offset * speed, axis=1) / np.sum(speed**2, axis=1))[:, None, None]
    r, v = r + dt * v + dt**2 / 2 * pull, v + dt * pull  # 1e-8 at most: its square is round-off
    side = r[:, 1] - r[:, 0]
    length = np.linalg.norm(side, axis=1)
    (c, s), a = (side / length[:, None]).T, 2 / length
    turn = np.moveaxis(np.array([[c, s], [-s, c]]), 2, 0)
    r, v = np.einsum("nij,nkj->nki", turn, r) * a[:, None, None], np.einsum("nij,nkj->nki", turn, v)
    v = v / np.sqrt(a)[:, None, None]
    mean = (v[:, 0] + v[:, 1]) / 2
    off = np.abs(r[:, 2] - (r[:, 0] + r[:, 1]) / 2).max(axis=1), np.abs(v[:, 1] - v[:, 0]).max(axis=1)
    return mean[:, 0], mean[:, 1], period * a**1.5, np.maximum(*off)


def _attraction(r):
    a, b, c = r
    return sum(1 / jnp.sqrt(jnp.sum((x - y) ** 2)) for x, y in ((a, b), (a, c), (b, c)))


def _summary(names, published, table, wall: float, cpu: float) -> None:
    ok, well = table["ok"], table["closure"] < 1e-12
    print(f"{ok.sum()} of {len(ok)} closed, {(ok & well).sum()} of them to below 1e-12, in {wall:.0f} s")
    print(f"({cpu:.0f} CPU seconds); {table['stable'].sum()} are linearly stable. Median, 90 % and largest:")
    new = np.stack([table["v1"], table["v2"], table["period"]], axis=1)
    shown = {
        "closure": table["closure"],
        "asymmetry": table["asymmetry"],
        "|μ1 μ2 − 1|": _pairs(table["multipliers"]),
        "change of the published numbers": np.abs(new - published).max(axis=1),
    }
    for what, values in shown.items() if ok.any() else ():
        print("{:34s}{:10.1e}{:10.1e}{:10.1e}".format(what, *np.quantile(values[ok], (0.5, 0.9, 1.0))))
    for k in np.flatnonzero(~ok).tolist():
        print(f"{names[k]}: {table['message'][k]}")


def _pairs(multipliers) -> np.ndarray:
    return np.abs(multipliers[:, 0:4:2] * multipliers[:, 1:4:2] - 1).max(axis=1)


def _store(path: Path, names, table) -> None:
    """One row an orbit; of the multipliers the four that are not 1 by symmetry."""
    with path.open("w", newline="") as file:
        write = csv.writer(file).writerow
        write(["name", "v1", "v2", "period", "closure", "asymmetry", "stable", "mu1", "mu2", "mu3", "mu4", "message"])
        for k, name in enumerate(names):
            digits = [f"{table[column][k]:.15g}" for column in ("v1", "v2", "period")]
            sizes = [f"{table[column][k]:.1e}" for column in ("closure", "asymmetry")]
            values = [f"{x.real:.9g}{x.imag:+.9g}i" for x in table["multipliers"][k, :4]]
            known = table["ok"][k] and not table["message"][k]
            stable = ("stable" if table["stable"][k] else "unstable") if known else ""
            write([name, *digits, *sizes, stable, *values, table["message"][k].split("\n")[0]])


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.periodic_orbits", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="csv of names, v1, v2, periods")
    parser.add_argument("--every", type=int, default=1, help="only every so many-th row")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    return parser


if __name__ == "__main__":
    main()
