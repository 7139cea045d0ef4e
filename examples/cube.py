r"""A cube is tossed onto a board: its eight corners strike, slip and stick, until it lies on a face.

The unit of length is half an edge, so that corners are (±1, ±1, ±1). The cube turns by a quaternion of length one, for
which ½ ω² = 2 |Q̇|²; a corner has a gap to the board, and a sliding velocity along it:

    L = ½ |ẋ|² + 2 J |Q̇|² − g z      |Q| = 1      n·(x + R c) − height ≥ 0      slip = (ẋ + Ṙ c)_xy

Without a file the example tosses a cube of its own. The file is that of recorded tosses of an acrylic cube by cameras
(DAIRLab, contact-nets; `states` and `lengths` of an .npz). Of ten of them the board and the laws of contact are read,
and what is wanted are tosses that were not among them: each is simulated from its start alone, which is measured in
flight on its first four samples, and compared with its record after 0.3 s.

- The board's height and its tilt: a plane through the corners that carry the cube where it lies at the end.
- Restitution and friction: after ten strikes a motion depends on its start by jumps, and no curvature of a sum of
  squares says how well a number is known. So the ten tosses are simulated, as one batch, at many pairs of the two
  numbers, and a paraboloid through the logarithms of their errors has its least there. Its interval is that of draws
  of ten tosses among the ten (the bootstrap).

    python examples/cube.py tosses.npz [--follow OTHER.npz]
"""

import argparse
import itertools
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

import lagjax

G, INERTIA, STEP = 187.21374, 0.7973, 1 / 148  # half edges of 52.4 mm per s²; over the mass; s between pictures
PUBLISHED = {"restitution": 0.125, "friction": 0.18, "height": 0.0, "tilt": np.zeros(2)}
LATER = 0.3  # s
FLIGHT = 4  # samples of a toss before a corner comes near the board
LOW, HIGH = (0.0, 0.12), (0.3, 0.22)  # restitution and friction between which ten tosses are simulated
PAIRS, DRAWS = 32, 400
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def rotate(turn, vectors):
    """Vectors (…, 3) turned by a quaternion (w, x, y, z)."""
    w, u = turn[0], turn[1:]
    return (w**2 - u @ u) * vectors + 2 * (vectors @ u)[..., None] * u + 2 * w * jnp.cross(u, vectors)


def corners(q):
    return q["place"] + rotate(q["turn"], CORNERS)


def sliding(q, qdot):
    return jax.jvp(corners, (q,), (qdot,))[1][:, :2]


def gaps(q, params):
    """The distances (8,) of the corners from a board z = height + tilt·(x, y)."""
    places = corners(q)
    return places[:, 2] - params["height"] - places[:, :2] @ params["tilt"]


def cube_scene(rough=True):
    """The cube and its board, with friction or without."""
    friction = {"friction": lambda params: params["friction"], "slip": sliding} if rough else {}
    return lagjax.System(
        lambda q, v: 0.5 * v["place"] @ v["place"] + 2 * INERTIA * v["turn"] @ v["turn"] - G * q["place"][2],
        constraints=lambda q: q["turn"] @ q["turn"] - 1.0, contacts=gaps,
        restitution=lambda params: params["restitution"], **friction,
    )  # fmt: skip


def state_of(place, turn, velocity, spin):
    """(q, q̇) of a place, a quaternion, a velocity and an angular velocity in the axes of the body."""
    turn = np.array(turn) / np.linalg.norm(turn)
    w, u = turn[0], turn[1:]
    rate = 0.5 * np.concatenate([[-u @ spin], w * np.array(spin) + np.cross(u, spin)])
    return {"place": np.array(place), "turn": turn}, {"place": np.array(velocity), "turn": rate}


def own_toss():
    """The start of a toss of our own."""
    return state_of([0.0, 0.0, 3.0], [0.9, 0.3, -0.2, 0.1], [14.0, 5.0, 2.0], [3.0, 2.0, -1.0])


# ---- recorded tosses -------------------------------------------------------------------------------------------------


def read_tosses(file):
    """The recorded states (T, 13) of each toss."""
    with np.load(file) as data:
        return np.split(np.asarray(data["states"], float), np.cumsum(data["lengths"])[:-1])


def measured_start(toss):
    """(q, q̇) at the first sample of a toss: a flight through its first samples, whose spin in body axes is constant."""
    t = STEP * np.arange(FLIGHT)
    places = toss[:FLIGHT, :3] + 0.5 * G * np.outer(t**2, [0.0, 0.0, 1.0])
    velocity, place = np.polyfit(t, places, 1)
    return state_of(place, toss[0, 3:7], velocity, toss[:FLIGHT, 10:].mean(axis=0))


class Errors(NamedTuple):
    """How far simulated tosses are from their records after `LATER`, (…, N): places in half sides, angles in rad; NaN
    where the motion did not come there."""

    place: np.ndarray
    angle: np.ndarray

    def medians(self):
        """Those of place and angle over all tosses."""
        return np.nanmedian(self.place), np.nanmedian(self.angle)


def follow_tosses(scene, tosses, laws):
    """The `Errors` (N,) of N tosses by the laws given, a pytree; (M, N) where its arrays have an axis of M more."""
    many = np.shape(laws["friction"])
    axes = jax.tree.map(lambda x: 0 if many else None, laws)
    last = [min(round(LATER / STEP), len(toss) - 1) for toss in tosses]
    ts = STEP * np.array([[0.0, k] for k in last])
    starts = jax.tree.map(lambda *x: np.stack(x), *map(measured_start, tosses))

    def follow(q0, v0, ts, laws):
        run = lagjax.simulate(scene, q0, v0, ts, laws, throw=False)
        return run.end.q

    over_tosses = jax.vmap(follow, in_axes=(0, 0, 0, None))
    over_laws = jax.vmap(over_tosses, in_axes=(None, None, None, axes)) if many else over_tosses
    q = jax.jit(over_laws)(*starts, ts, laws)
    shown = np.stack([toss[k] for toss, k in zip(tosses, last, strict=True)])
    turns = shown[..., 3:7] / np.linalg.norm(shown[..., 3:7], axis=-1, keepdims=True)
    place = np.linalg.norm(np.asarray(q["place"]) - shown[..., :3], axis=-1)
    cosine = np.abs(np.sum(np.asarray(q["turn"]) * turns, axis=-1))
    return Errors(place, 2 * np.arccos(np.minimum(1.0, cosine)))


# ---- what ten tosses say ---------------------------------------------------------------------------------------------


class Interval(NamedTuple):
    """A number, and half the width of its interval of 95 %."""

    value: float
    half: float

    def __str__(self):
        return f"{self.value:.4f} ± {self.half:.4f}"


def fit_board(tosses):
    """The plane z = height + tilt·(x, y) through the four lowest corners at the end of each toss: three `Interval`s."""
    lying = np.stack([corners_of(toss[-1]) for toss in tosses])
    lowest = np.take_along_axis(lying, np.argsort(lying[..., 2:], axis=1)[:, :4], axis=1).reshape(-1, 3)
    columns = np.column_stack([np.ones(len(lowest)), lowest[:, :2]])
    plane, *_ = np.linalg.lstsq(columns, lowest[:, 2])
    left = lowest[:, 2] - columns @ plane
    of_tosses = (columns * left[:, None]).reshape(len(tosses), 4, 3).sum(axis=1)  # the corners of one cube are no four
    inverse = np.linalg.inv(columns.T @ columns)
    spread = np.sqrt(np.diag(inverse @ of_tosses.T @ of_tosses @ inverse))
    return [Interval(*map(float, pair)) for pair in zip(plane, 2 * spread, strict=True)]


def corners_of(state):
    """The places (8, 3) of the corners of a recorded state (13,)."""
    return np.asarray(corners(state_of(*np.split(state, [3, 7, 10]))[0]))


def fit_laws(scene, tosses, board):
    """The restitution and the friction of which tosses at `PAIRS` pairs are followed best, as two `Interval`s."""
    pairs = qmc.scale(qmc.Sobol(2, rng=np.random.default_rng(0)).random(PAIRS), LOW, HIGH)
    laws = {"restitution": pairs[:, 0], "friction": pairs[:, 1]}
    laws |= {name: np.broadcast_to(x, (PAIRS, *np.shape(x))) for name, x in board.items()}
    off = follow_tosses(scene, tosses, laws)
    scores = np.log(off.place) + np.log(off.angle)
    draws = np.random.default_rng(0).integers(len(tosses), size=(DRAWS, len(tosses)))
    best = lowest_place(pairs, np.nanmean(scores, axis=1))
    drawn = np.array([lowest_place(pairs, np.nanmean(scores[:, draw], axis=1)) for draw in draws])
    ends = np.percentile(drawn, [2.5, 97.5], axis=0)
    return [Interval(float(x), float(half)) for x, half in zip(best, (ends[1] - ends[0]) / 2, strict=True)]


def lowest_place(pairs, scores):
    """The lowest place, in the rectangle, of the paraboloid that scores (M,) at pairs (M, 2) lie about."""
    low, high = np.array(LOW), np.array(HIGH)

    def columns(pairs):
        x, y = (2 * (pairs - low) / (high - low) - 1).T
        return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])

    surface, *_ = np.linalg.lstsq(columns(pairs), scores)
    value = lambda pair: float((columns(pair[None]) @ surface)[0])  # noqa: E731
    return minimize(value, pairs[np.argmin(columns(pairs) @ surface)], bounds=np.column_stack([low, high])).x


def fit_tosses(scene, tosses):
    """The laws that ten tosses give, as parameters of the scene, printed with their intervals."""
    height, *tilt = fit_board(tosses)
    board = {"height": height.value, "tilt": np.array([one.value for one in tilt])}
    restitution, friction = fit_laws(scene, tosses, board)
    print(f"Of {len(tosses)} tosses, with intervals of 95 %:")
    print(f"restitution {restitution} (published 0.125), friction {friction} (published 0.18)")
    print(f"the board: {height} half sides high, rises by {tilt[0]} along x and {tilt[1]} along y")
    return {"restitution": restitution.value, "friction": friction.value, **board}


# ---- pictures --------------------------------------------------------------------------------------------------------

EDGES = [(i, j) for i in range(8) for j in range(i) if np.abs(CORNERS[i] - CORNERS[j]).sum() == 2]


def picture(q):
    """The edges of the cube and its board, seen from aside and above."""

    def seen(points):
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return jnp.stack([x - 0.45 * y, z + 0.25 * y - 0.12 * x], axis=-1)

    c = corners(q)
    board = jnp.array([[-2.0, -3, 0], [9, -3, 0], [9, 5, 0], [-2, 5, 0], [-2, -3, 0]])
    edges = {f"edge {k}": seen(jnp.stack([c[i], c[j]])) for k, (i, j) in enumerate(EDGES)}
    return edges | {"board": seen(board)}


def draw_own_toss(run):
    """The film, and some of its pictures in one."""
    Path("out").mkdir(exist_ok=True)
    run.animate(picture, speed=0.3).save("out/cube.gif")
    figure, axes = plt.subplots(figsize=(7.6, 3.6))
    axes.plot(*np.asarray(picture(run.end.q)["board"]).T, color="0.6")
    for k in range(0, len(run.ts), 8):
        lines = picture(jax.tree.map(lambda x, k=k: x[k], run.q))
        color = plt.colormaps["viridis"](0.9 * k / len(run.ts))
        for name in lines:
            if name != "board":
                axes.plot(*np.asarray(lines[name]).T, color=color, linewidth=1)
    axes.set(aspect="equal", title="Tossed, and at rest on a face")
    axes.axis("off")
    figure.savefig("out/cube.png")


def draw_followed(scene, tosses, laws, off):
    """How far all tosses are off, and the toss of median error: its centre and its lowest corner, and their record."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6))
    for name, (errors, color) in off.items():
        left.scatter(errors.place, errors.angle, s=14, color=color, label=name)
        left.scatter(*errors.medians(), s=140, marker="+", color=color)
    left.set(yscale="log", xlabel="place [half sides]", ylabel="angle [rad]")
    left.set_title(f"off after {LATER} s (+ medians)")
    left.legend(fontsize=8)

    errors, _ = off["fitted"]
    toss = tosses[int(np.nanargmin(np.abs(errors.place - np.nanmedian(errors.place))))]
    ts = STEP * np.arange(min(len(toss), round(2 * LATER / STEP)))
    run = lagjax.simulate(scene, *measured_start(toss), np.linspace(0.0, ts[-1], 400), laws, throw=False)
    simulated = np.asarray(jax.vmap(corners)(run.q))
    recorded = np.array([corners_of(state) for state in toss[: len(ts)]])
    right.plot(run.ts, run.q["place"][:, 2], color="C0", label="centre, simulated")
    right.plot(run.ts, simulated[..., 2].min(axis=1), color="C1", label="lowest corner, simulated")
    right.plot(ts, toss[: len(ts), 2], ".", color="0.3", markersize=4, label="recorded")
    right.plot(ts, recorded[..., 2].min(axis=1), ".", color="0.3", markersize=4)
    right.axvline(LATER, color="0.8", linewidth=1)
    right.set(xlabel="time [s]", ylabel="height [half sides]", title="a toss of median error")
    right.legend(fontsize=8)
    Path("out").mkdir(exist_ok=True)
    figure.savefig("out/cube_followed.png")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="recorded tosses, an .npz; without it, a toss of our own")
    parser.add_argument(
        "--follow", type=Path, help="other tosses, simulated by what was fitted; else those left of FILE"
    )
    parser.add_argument("--tosses", type=int, default=10, help="how many tosses of the file are fitted")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    plt.style.use("lagjax.figures")

    scene = cube_scene()
    if options.file is None:
        run = lagjax.simulate(scene, *own_toss(), np.linspace(0.0, 1.0, 149), PUBLISHED)
        print(f"{int(run.impacts.count)} impacts; at rest at z = {float(run.q['place'][-1, 2]):.12f} half edges")
        draw_own_toss(run)
        return run
    tosses = read_tosses(options.file)
    fitted = np.linspace(0, len(tosses), options.tosses, endpoint=False).astype(int)  # of the whole session
    laws = fit_tosses(scene, [tosses[k] for k in fitted])
    others = [toss for k, toss in enumerate(tosses) if k not in fitted]
    others = read_tosses(options.follow) if options.follow else others
    off = {name: follow_tosses(scene, others, law) for name, law in (("fitted", laws), ("published", PUBLISHED))}
    draw_followed(scene, others, laws, {name: (x, f"C{k}") for k, (name, x) in enumerate(off.items())})
    for name, errors in off.items():
        if lost := int(np.isnan(errors.place).sum()):
            print(f"{name}: {lost} of {len(others)} tosses did not come to {LATER} s, and are not counted")
    place, angle = off["published"].medians()
    print(f"by the published numbers: place {place:.3f} and angle {angle:.3f} at {LATER} s")
    place, angle = off["fitted"].medians()
    print(f"followed: {len(others)} tosses, place {place:.3f} and angle {angle:.3f} at {LATER} s")
    return laws, off


if __name__ == "__main__":
    main()
