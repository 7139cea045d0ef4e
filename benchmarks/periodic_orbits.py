"""The published periodic orbits of three equal masses in the plane, closed and refined to 20 digits, with stability.

    python -m benchmarks.periodic_orbits ../shared/data/li_liao_planar_equal_mass_695.csv

The file has rows of a name, v1, v2 and the period; bodies begin at (−1, 0), (1, 0), (0, 0) with velocities (v1, v2),
(v1, v2), (−2 v1, −2 v2). Each orbit is followed in the two positions relative to one of the bodies, that one of the
three that keeps the others farthest from each other: where two bodies come close, their distance is then a coordinate,
which has all its digits, and not a difference of two, which would lose those that decide about what follows. All are
closed as a batch by `lagjax.periodic_orbit`, and what comes out is brought back to the form above.

What closes is said twice. `arcs` is the largest defect between the arcs of `periodic_orbit`, in doubles: rounding in
close encounters, times what follows makes of it, limits it. `closure` is |φ_T(y) − y| of one motion over the whole
period, followed with 32 digits (`_orbits_extended`), of whose v1, v2 and T the table has the first 20; a start rounded
to doubles could not close better than `floor`. `change` is by how much v1, v2 and T of `periodic_orbit` differ.
Multipliers are those of `periodic_orbit` (`digits` 16) or, where rounding has spoilt these, those of differences of
motions with 32 digits (`_orbits_multipliers`). Many orbits have a pair at 1 to all the digits that are known.

Source of the orbits: X. Li, S. Liao, *More than six hundred new families of Newtonian periodic planar collisionless
three-body orbits*, Sci. China Phys. Mech. Astron. 60 (2017) 129511.
"""

import argparse
import csv
import time
from decimal import Decimal, localcontext
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._orbits_multipliers import multipliers
from benchmarks._orbits_refined import refined, start

# The other two bodies, by the one that positions are relative to.
OTHERS = ((1, 2), (0, 2), (0, 1))
# A pair of multipliers that is nearer to ±1 may stand on either side of the unit circle: its sum is known to 1e-6.
APART = 1e-3
VERDICTS = "stable", "neutral", "unstable", "unknown"
SPEEDS = np.array([1.0, 1.0, -2.0])  # of the bodies, in (v1, v2)
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
    v = published[:, None, :2] * SPEEDS[:, None]
    period = published[:, 2]
    centre, work = _best_centre(r, v, period)
    cpu = time.process_time()
    orbit = lagjax.periodic_orbit(BODIES, _relative(r, centre), _relative(v, centre), period)
    print(f"periodic_orbit: {time.process_time() - cpu:.0f} CPU seconds", flush=True)
    moved = _bodies(orbit.q0, centre), _bodies(orbit.qdot0, centre)
    v1, v2, period = _in_published_form(*moved, np.asarray(orbit.period))
    lost = ~np.isfinite(v1)
    v1, v2, period = (np.where(lost, y, x) for x, y in zip((v1, v2, period), published.T, strict=True))
    shape = np.einsum(
        "nk,ij->nkij", _relative(np.broadcast_to(SPEEDS[:, None] / 3, r.shape), centre)[..., 0], np.eye(2)
    )
    cpu = time.process_time()
    place = _relative(r, centre).reshape(-1, 4)
    fine = refined(place, shape.reshape(-1, 4, 2), np.stack([v1, v2], axis=1), period, work)
    print(f"with 32 digits: {time.process_time() - cpu:.0f} CPU seconds", flush=True)
    change = np.stack([v1 - fine.w[:, 0, 0] / 3, v2 - fine.w[:, 0, 1] / 3, (period - fine.period[:, 0]) / period])
    numbers = np.concatenate([fine.w.swapaxes(1, 2), fine.period[:, None]], axis=1)  # 3 v1, 3 v2, T: two doubles each
    columns = {"numbers": numbers, "closure": fine.closure, "step": fine.step, "floor": fine.floor}
    columns |= {"arcs": np.asarray(orbit.closure), "change": np.abs(change).max(axis=0)}
    columns |= {"ok": np.asarray(orbit.ok), "message": np.array(orbit.message, object)}
    y = start(place, shape.reshape(-1, 4, 2), fine.w)
    return columns | _stability(orbit, y, fine.period, work, centre)


def _stability(orbit: lagjax.Orbit, y, period, work, centre) -> dict[str, np.ndarray]:
    """Multipliers (N, 4), those that are not 1 by symmetry, and what follows: in 32 digits where doubles leave it open.

    `digits` (N,) tells with how many, `known` and `stable` (N,) whether the stability is known, and what it is.
    """
    values, stable = np.array(orbit.multipliers)[:, :4], np.array(orbit.stable)
    known = np.asarray(orbit.ok) & (np.array(orbit.message, object) == "")
    digits, (places,) = np.where(known, 16, 32), np.nonzero(~known)
    if len(places):
        cpu = time.process_time()
        fine = multipliers(y[places], period[places], work[places], centre[places])
        values[places], stable[places], known[places] = fine.values, fine.known & ~fine.unstable, fine.known
        print(f"their multipliers, of {len(places)}: {time.process_time() - cpu:.0f} CPU seconds", flush=True)
    return {"multipliers": values, "stable": stable, "known": known, "digits": digits}


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


def _best_centre(r, v, period) -> tuple[np.ndarray, np.ndarray]:
    """The body of each orbit whose others stay farthest from each other, (N,), and how many steps it takes, (N,)."""
    centre = np.full(len(r), 2)  # to look at them

    def path(q, u, end):
        ts = end * jnp.arange(GLANCES) / GLANCES
        run = lagjax.simulate(BODIES, q, u, ts, rtol=1e-12, throw=False)
        return run.q, run.stats["num_steps"]

    q, steps = map(np.asarray, jax.jit(jax.vmap(path))(_relative(r, centre), _relative(v, centre), period / 2))
    x, y = q[:, :, 0], q[:, :, 1]
    apart = np.stack([np.nanmin(np.linalg.norm(side, axis=2), axis=1) for side in (y, x, x - y)])
    return np.argmax(apart, axis=0), steps


def _in_published_form(r, v, period) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """v1, v2 and the period of the published form, each (N,).

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
    return mean[:, 0], mean[:, 1], period * a**1.5


def _attraction(r):
    a, b, c = r
    return sum(1 / jnp.sqrt(jnp.sum((x - y) ** 2)) for x, y in ((a, b), (a, c), (b, c)))


def _summary(names, published, table, wall: float, cpu: float) -> None:
    well, ok = table["closure"] < 1e-12, table["ok"]
    sure, fine = table["known"], table["digits"] == 32
    print(f"{well.sum()} of {len(well)} closed to below 1e-12 over a whole period, {(~well).sum()} not.")
    print(
        f"In doubles periodic_orbit closes {ok.sum()}, {(ok & (table['arcs'] < 1e-12)).sum()} of them to below 1e-12;"
    )
    print(f"the stability of {sure.sum()} is known, of {(sure & fine).sum()} from motions with 32 digits;", end=" ")
    print(", ".join(f"{(_verdicts(table) == word).sum()} are {word}" for word in VERDICTS), end=f". {wall:.0f} s, ")
    print(f"{cpu:.0f} CPU seconds. Median, 90 % and largest of")
    numbers = table["numbers"][..., 0] / np.array([3.0, 3.0, 1.0])
    shown = {
        "closure (32 digits)": table["closure"][well],
        "last change of v1, v2, T": table["step"][well],
        "floor of a start in doubles": table["floor"][well],
        "arcs of periodic_orbit": table["arcs"][ok],
        "change of v1, v2, T since then": table["change"][ok],
        "|μ1 μ2 − 1|": _pairs(table["multipliers"])[ok & ~fine],
        "change of the published numbers": np.abs(numbers - published).max(axis=1)[well],
    }
    for what, values in shown.items() if ok.any() else ():
        print("{:34s}{:10.1e}{:10.1e}{:10.1e}".format(what, *np.quantile(values, (0.5, 0.9, 1.0))))
    for k in np.flatnonzero(~ok | ~well).tolist():
        print(f"{names[k]}: closure {table['closure'][k]:.1e}; {table['message'][k]}")


def _pairs(multipliers) -> np.ndarray:
    return np.abs(multipliers[:, 0:4:2] * multipliers[:, 1:4:2] - 1).max(axis=1)


SIZES = ("closure", "step", "floor", "arcs", "change")


def _store(path: Path, names, table) -> None:
    """One row an orbit, v1, v2 and T with 20 digits, and the four multipliers that are not 1 by symmetry with six."""
    with path.open("w", newline="") as file, localcontext(prec=40):
        write = csv.writer(file, lineterminator="\n").writerow
        write(["name", "v1", "v2", "period", *SIZES, "limit", "stable", "digits", "mu1", "mu2", "mu3", "mu4"])
        for k, name in enumerate(names):
            pairs = zip(table["numbers"][k].tolist(), (3, 3, 1), strict=True)
            digits = [f"{(Decimal(high) + Decimal(low)) / by:.20g}" for (high, low), by in pairs]
            values = [f"{x.real:.6g}{x.imag:+.6g}i" if abs(x.imag) > 1e-9 * abs(x) else f"{x.real:.6g}"
                      for x in table["multipliers"][k, :4]]  # fmt: skip
            sizes = [f"{table[column][k]:.1e}" for column in SIZES]
            write([name, *digits, *sizes, _limit(table, k), _verdicts(table)[k], table["digits"][k], *values])


def _verdicts(table) -> np.ndarray:
    """Words (N,): stable, neutral, unstable, unknown.

    Neutral orbits have a pair at ±1 as far as digits tell, and none outside of the unit circle: it takes more digits to
    see on which side the pair has parted. Those of a high resonance with a stable orbit are so.
    """
    at_one = (np.abs(np.abs(table["multipliers"].real) - 1 + 1j * table["multipliers"].imag) < APART).any(axis=1)
    verdicts = np.where(table["stable"], np.where(at_one, "neutral", "stable"), "unstable")
    return np.where(table["known"], verdicts, "unknown")


def _limit(table, k: int) -> str:
    """What keeps doubles from 1e-12: that the start has 53 bits, or rounding on the way; "" where they reach it."""
    if table["arcs"][k] < 1e-12 and table["floor"][k] < 1e-12 and table["ok"][k]:
        return ""
    return "start" if table["floor"][k] >= 1e-12 else "encounters"


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.periodic_orbits", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="csv of names, v1, v2, periods")
    parser.add_argument("--every", type=int, default=1, help="only every so many-th row")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    return parser


if __name__ == "__main__":
    main()
