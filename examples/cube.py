r"""A cube is tossed onto a board: its eight corners strike, slip and stick, until it lies on a face.

The unit of length is half an edge. The cube turns by a quaternion of length one, for which ½ ω² = 2 |Q̇|²; its centre
lies at `centre` from the mass centre x, in axes of the body. Corners are balls of radius ρ about points c inside: they
have a gap to the board, and a sliding velocity along it:

    L = ½ |ẋ|² + 2 J |Q̇|² − g z      |Q| = 1      n·(x + R c) − ρ − height ≥ 0      slip = (ẋ + ω × (R c − ρ n))_xy

Without a file the example tosses a cube of its own. The file is that of recorded tosses of an acrylic cube by cameras
(DAIRLab, contact-nets; `states` and `lengths` of an .npz). Of ten of them scene and board are read, and what is wanted
are tosses that were not among them: each is simulated from its start alone, which is measured in flight, until a corner
comes near the board, and compared with its record after 0.3 s.

- The board's tilt, and the height at which the centre rests on it: a plane through where the cube lies at the end.
- All else is fitted by `lagjax.fit` to flights and the eight pictures after the first impact, beyond which a motion
  depends on its start by jumps. How fast the cube falls gives the scale of lengths; the centre that the cameras see
  sways about the mass centre as the cube turns; how low the centre is at the impact gives the radius of corners, and
  what the impact changes gives inertia, friction and restitution. Pictures after it count less: there the scene is
  further from the truth than the cameras. Intervals are those that pictures give; impacts differ by more, and fits to
  other ten tosses scatter by two to three times as much.

    python examples/cube.py tosses.npz [--follow OTHER.npz]
"""

import argparse
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import lagjax

G, STEP = 187.21374, 1 / 148  # half edges of 52.4 mm per s²; s between pictures
FITTED, LATER = 10, 0.3  # tosses; s
NEAR = 0.04  # the height of the lowest corner at which a flight ends
AFTER, COUNT = 8, 1e-3  # pictures after a flight that are fitted, and how much each counts beside one of the flight
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
PUBLISHED = {"restitution": 0.125, "friction": 0.18, "radius": 0.0, "inertia": 0.7973, "centre": np.zeros(3)}
PUBLISHED |= {"scale": 1.0, "level": 1.0, "tilt": np.zeros(2)}  # half an edge; the centre's height at rest
GUESS = PUBLISHED | {"restitution": 0.2, "friction": 0.2, "radius": 0.1}
WITHIN = {"restitution": lagjax.between(0.0, 1.0)} | dict.fromkeys(["friction", "radius", "inertia"], lagjax.positive)


def rotate(turn, vectors):
    """Vectors (…, 3) turned by a quaternion (w, x, y, z)."""
    w, u = turn[0], turn[1:]
    return (w**2 - u @ u) * vectors + 2 * (vectors @ u)[..., None] * u + 2 * w * jnp.cross(u, vectors)


def points_at(q, params, points):
    """Where points (…, 3) of the cube are, which are given from its centre."""
    return q["place"] + rotate(q["turn"], params["centre"] + points)


def observe(q, qdot, params):
    """What the cameras see: the centre of the cube, and its turn."""
    return {"place": points_at(q, params, np.zeros(3)), "turn": q["turn"]}


def balls(q, params):
    """The centres (8, 3) of the rounded corners."""
    return points_at(q, params, (params["scale"] - params["radius"]) * CORNERS)


def gaps(q, params):
    """The distances (8,) of the corners from a board z = height + tilt·(x, y)."""
    at, height = balls(q, params), params["level"] - params["scale"]
    return at[:, 2] - params["radius"] - height - at[:, :2] @ params["tilt"]


def sliding(q, qdot, params):
    """The velocities (8, 2) of the lowest points of the corners."""
    (w, u), (rate, change) = ((x["turn"][0], x["turn"][1:]) for x in (q, qdot))
    spin = 2 * (w * change - rate * u + jnp.cross(u, change))
    velocities = jax.jvp(lambda q: balls(q, params), (q,), (qdot,))[1]
    return velocities[:, :2] + params["radius"] * jnp.stack([-spin[1], spin[0]])


def lagrangian(q, qdot, params):
    kinetic = 0.5 * qdot["place"] @ qdot["place"] + 2 * params["inertia"] * qdot["turn"] @ qdot["turn"]
    return kinetic - G * params["scale"] * q["place"][2]


def cube_scene():
    """The cube and its board."""
    return lagjax.System(
        lagrangian, constraints=lambda q: q["turn"] @ q["turn"] - 1.0, contacts=gaps, slip=sliding,
        restitution=lambda params: params["restitution"], friction=lambda params: params["friction"],
    )  # fmt: skip


def rate_of(turn, spin):
    """The rate of a quaternion, of an angular velocity in the axes of the board."""
    return 0.5 * np.concatenate([[-turn[1:] @ spin], turn[0] * spin + np.cross(spin, turn[1:])])


def own_toss():
    """The start (q, q̇) of a toss of our own."""
    turn = np.array([0.9, 0.3, -0.2, 0.1]) / np.linalg.norm([0.9, 0.3, -0.2, 0.1])
    rate = rate_of(turn, np.array([3.2, 0.2, -1.9]))
    return {"place": np.array([0.0, 0.0, 3.0]), "turn": turn}, {"place": np.array([14.0, 5.0, 2.0]), "turn": rate}


# ---- recorded tosses -------------------------------------------------------------------------------------------------


def read_tosses(file):
    """The recorded places and quaternions (T, 7) of each toss."""
    with np.load(file) as data:
        return np.split(np.asarray(data["states"], float)[:, :7], np.cumsum(data["lengths"])[:-1])


def seen_state(picture):
    """The coordinates of a cube in pictures (…, 7), as the cameras see it."""
    return {"place": picture[..., :3], "turn": picture[..., 3:]}


def flight_length(toss):
    """How many pictures show the cube before a corner comes near the board."""
    lowest = np.array(
        [np.min(points_at(seen_state(one), PUBLISHED, CORNERS)[:, 2]) for one in toss[: round(LATER / STEP)]]
    )
    return max(2, int(np.argmax(np.append(lowest < NEAR, True))))


def measured_start(toss):
    """A function of the parameters: (q, q̇) at the first picture of a toss, a flight of constant spin through all of its
    pictures."""
    flight = toss[: flight_length(toss)]
    t = STEP * np.arange(len(flight))
    turns = Rotation.from_quat(flight[:, 3:], scalar_first=True)
    spin, angle = np.polyfit(t, (turns * turns[0].inv()).as_rotvec(), 1)
    turns = Rotation.from_rotvec(angle + np.outer(t, spin)) * turns[0]
    turn = turns[0].as_quat(scalar_first=True)
    turn *= np.sign(turn @ toss[0, 3:])
    line = np.linalg.lstsq(np.column_stack([np.ones_like(t), t]), np.eye(len(t)))[0]

    def start(params):
        falls = 0.5 * G * params["scale"] * np.outer(t**2, [0.0, 0.0, 1.0])
        place, velocity = line @ (flight[:, :3] - turns.as_matrix() @ params["centre"] + falls)
        return {"place": place, "turn": turn}, {"place": velocity, "turn": rate_of(turn, spin)}

    return start


def follow_tosses(scene, tosses, law, numbers):
    """Pictures (N, T, 7) of N tosses simulated by a law, parameters of the scene; `numbers` (N, T) counts them from the
    start."""
    starts = jax.tree.map(lambda *x: np.stack(x), *(measured_start(toss)(law) for toss in tosses))

    @jax.jit
    @jax.vmap
    def follow(start, ts):
        run = lagjax.simulate(scene, *start, ts, law, throw=False, max_transitions=1024)  # a face may clatter
        seen = jax.vmap(observe, in_axes=(0, 0, None))(run.q, run.qdot, law)
        return jnp.concatenate([seen["place"], seen["turn"]], axis=1)

    times = STEP * np.pad(numbers, ((0, 0), (1, 0)))
    return np.asarray(follow(starts, times))[:, 1:]


def errors_of(simulated, recorded):
    """How far simulated pictures (N, 7) are from recorded ones: places in half sides and angles in rad, (2, N)."""
    place = np.linalg.norm(simulated[:, :3] - recorded[:, :3], axis=1)
    turns = recorded[:, 3:] / np.linalg.norm(recorded[:, 3:], axis=1, keepdims=True)
    return np.stack([place, 2 * np.arccos(np.minimum(1.0, np.abs(np.sum(simulated[:, 3:] * turns, axis=1))))])


def fit_tosses(scene, tosses):
    """The `lagjax.Fit` of the scene to tosses, printed with its intervals."""
    rest = np.array([toss[-1, :3] for toss in tosses])
    columns = np.column_stack([np.ones(len(rest)), rest[:, :2]])
    (level, *tilt), *_ = np.linalg.lstsq(columns, rest[:, 2])
    records = []
    for toss in tosses:
        n = flight_length(toss)
        shown = toss[: n + AFTER]
        weights = np.where(np.arange(len(shown)) < n, 1.0, COUNT)
        ts, start = STEP * np.arange(len(shown)), measured_start(toss)
        records.append(lagjax.Record(ts, seen_state(shown), start=start, weights=weights))
    guess = GUESS | {"level": float(level), "tilt": np.array(tilt)}
    free = {name: name not in ("level", "tilt") for name in guess}
    transforms = dict.fromkeys(guess) | WITHIN
    noise = lagjax.StudentT()
    fit = lagjax.fit(
        scene, records, guess, observe=observe, free=free, transforms=transforms, noise=noise, method="whole"
    )
    height = level - fit.params["scale"]
    print(f"{fit}\nthe board: {height:.4f} high, rises by {tilt[0]:.4f} along x and {tilt[1]:.4f} along y")
    return fit


# ---- pictures --------------------------------------------------------------------------------------------------------

EDGES = [(i, j) for i in range(8) for j in range(i) if np.abs(CORNERS[i] - CORNERS[j]).sum() == 2]
BOARD = np.array([[-2.0, -3, 0], [9, -3, 0], [9, 5, 0], [-2, 5, 0], [-2, -3, 0]])
BOARD_BELOW = 1.8 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
SHOWN = (0.1, 0.2, LATER)  # s


def look(points):
    """Points of space (…, 3) seen from aside and above, (…, 2)."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return jnp.stack([x - 0.45 * y, z + 0.25 * y - 0.12 * x], axis=-1)


def cube_edges(q):
    """The edges (12, 2, 2) of the cube as they are seen."""
    return look(points_at(q, PUBLISHED, CORNERS))[np.array(EDGES)]


def edge_lines(q):
    """The edges as what `plot` draws: x and y, (2, 2, 12)."""
    return np.asarray(cube_edges(q)).transpose(2, 1, 0)


def picture(q):
    """The edges of the cube and its board."""
    return {f"edge {k}": edge for k, edge in enumerate(cube_edges(q))} | {"board": look(BOARD)}


def draw_own_toss(run):
    """The film, and some of its pictures in one."""
    Path("out").mkdir(exist_ok=True)
    run.animate(picture, speed=0.3).save("out/cube.gif")
    figure, axes = plt.subplots(figsize=(7.6, 3.6))
    axes.plot(*np.asarray(look(BOARD)).T, color="0.6")
    for k in range(0, len(run.ts), 8):
        lines = edge_lines(jax.tree.map(lambda x, k=k: x[k], run.q))
        axes.plot(*lines, color=plt.colormaps["viridis"](0.9 * k / len(run.ts)), linewidth=1)
    axes.set(aspect="equal", title="Tossed, and at rest on a face")
    axes.axis("off")
    figure.savefig("out/cube.png")


def draw_followed(scene, tosses, laws, off):
    """How far all tosses are off, and the toss of median error beside its record, at a few times."""
    figure, axes = plt.subplots(1, 4, figsize=(11.0, 3.4), width_ratios=[1.5, 1, 1, 1], layout="constrained")
    colors = dict(zip(laws, ("C0", "C1"), strict=True))
    for name, errors in off.items():
        axes[0].scatter(*errors, s=12, color=colors[name], label=name)
        axes[0].scatter(*np.nanmedian(errors, axis=1), s=220, marker="+", color=colors[name])
    axes[0].set(xscale="log", yscale="log", xlabel="place [half sides]", ylabel="angle [rad]")
    axes[0].set_title(f"off after {LATER} s (+ medians)")
    axes[0].set_xticks([0.05, 0.1, 0.2, 0.5], ["0.05", "0.1", "0.2", "0.5"])
    axes[0].minorticks_off()
    axes[0].legend(fontsize=8, loc="upper left")

    places = off["fitted"][0]
    toss = tosses[int(np.nanargmin(np.abs(places - np.nanmedian(places))))]
    numbers = np.minimum(np.round(np.array(SHOWN) / STEP).astype(int), len(toss) - 1)
    cubes = {"recorded": (toss[numbers], "0.75", 5)}
    for name, law in laws.items():
        cubes[name] = follow_tosses(scene, [toss], law, numbers[None])[0], colors[name], 1
    for k, axis in enumerate(axes[1:]):
        below = toss[numbers[k], :3] * [1.0, 1.0, 0.0]  # on the board
        axis.plot(*np.asarray(look(below + BOARD_BELOW)).T, color="0.85")
        x, y = look(below)
        for name, (pictures, color, width) in cubes.items():
            lines = edge_lines(seen_state(pictures[k]))
            axis.plot(*lines, color=color, lw=width, solid_capstyle="round", label=[name] + 11 * ["_"])
        axis.set_title(f"{SHOWN[k]} s")
        axis.set(aspect="equal", xlim=(x - 2.7, x + 2.7), ylim=(y - 1.2, y + 4.0))
        axis.axis("off")
    axes[2].legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, title="a toss of median error")
    Path("out").mkdir(exist_ok=True)
    figure.savefig("out/cube_followed.png")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="recorded tosses, an .npz; without it, a toss of our own")
    parser.add_argument("--follow", type=Path, help="other tosses, to be simulated; by default those left of FILE")
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
    chosen = np.linspace(0, len(tosses), FITTED, endpoint=False).astype(int)  # of the whole session
    fit = fit_tosses(scene, [tosses[k] for k in chosen])
    others = [toss for k, toss in enumerate(tosses) if k not in chosen]
    others = read_tosses(options.follow) if options.follow else others
    last = np.array([min(round(LATER / STEP), len(toss) - 1) for toss in others])
    ends = np.stack([toss[k] for toss, k in zip(others, last, strict=True)])
    laws = {"fitted": fit.params, "published": PUBLISHED}
    off = {name: errors_of(follow_tosses(scene, others, law, last[:, None])[:, 0], ends) for name, law in laws.items()}
    draw_followed(scene, others, laws, off)
    for name, errors in off.items():
        if lost := int(np.isnan(errors[0]).sum()):
            print(f"{name}: {lost} of {len(others)} tosses did not come to {LATER} s, and are not counted")
    medians = {name: "place {:.3f} and angle {:.3f}".format(*np.nanmedian(x, axis=1)) for name, x in off.items()}
    print(f"by the published numbers: {medians['published']} at {LATER} s")
    print(f"followed: {len(others)} tosses, {medians['fitted']} at {LATER} s")
    return fit, off


if __name__ == "__main__":
    main()
