r"""A cube is tossed onto a board: its eight corners strike, slip and stick, until it lies on a face.

The unit of length is half an edge, so that corners are (±1, ±1, ±1). The cube turns by a quaternion of length one, for
which ½ ω² = 2 |Q̇|²; a corner has a gap, and a sliding velocity along the board:

    L = ½ |ẋ|² + 2 J |Q̇|² − g z      |Q| = 1      z + (R c)_z ≥ 0      slip = (ẋ + Ṙ c)_xy

Without a file the example tosses a cube of its own. The file is that of 60 recorded tosses of an acrylic cube by
cameras (DAIRLab, contact-nets; `states` and `lengths` of an .npz): each is followed from its first sample on, with the
published restitution 0.125 and friction 0.18 alone, and compared with its record after 0.3 s.

    python examples/cube.py [tosses.npz] [--count 60]
"""

import argparse
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import lagjax

G, INERTIA, STEP = 187.21374, 0.7973, 1 / 148  # half edges of 52.4 mm per s²; over the mass; s between pictures
LAWS = {"restitution": 0.125, "friction": 0.18}  # published
LATER = 0.3  # s
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def rotate(turn, vectors):
    """Vectors (…, 3) turned by a quaternion (w, x, y, z)."""
    w, u = turn[0], turn[1:]
    return (w**2 - u @ u) * vectors + 2 * (vectors @ u)[..., None] * u + 2 * w * jnp.cross(u, vectors)


def corners(q):
    return q["place"] + rotate(q["turn"], CORNERS)


def sliding(q, qdot):
    return jax.jvp(corners, (q,), (qdot,))[1][:, :2]


def cube_scene(rough=True):
    """The cube and its board, with friction or without."""
    friction = {"friction": lambda params: params["friction"], "slip": sliding} if rough else {}
    return lagjax.System(
        lambda q, v: 0.5 * v["place"] @ v["place"] + 2 * INERTIA * v["turn"] @ v["turn"] - G * q["place"][2],
        constraints=lambda q: q["turn"] @ q["turn"] - 1.0, contacts=lambda q: corners(q)[:, 2],
        restitution=lambda params: params["restitution"], **friction,
    )  # fmt: skip


def state_of(place, turn, velocity, spin):
    """(q, q̇) of a place, a quaternion, a velocity and an angular velocity in the axes of the body."""
    turn = np.array(turn) / np.linalg.norm(turn)
    w, u = turn[0], turn[1:]
    rate = 0.5 * np.concatenate([[-u @ spin], w * np.array(spin) + np.cross(u, spin)])
    return {"place": np.array(place), "turn": turn}, {"place": np.array(velocity), "turn": rate}


def toss():
    """The start of a toss of our own."""
    return state_of([0.0, 0.0, 3.0], [0.9, 0.3, -0.2, 0.1], [14.0, 5.0, 2.0], [3.0, 2.0, -1.0])


def follow_tosses(file, count):
    """How far the motions are from the records after `LATER`: of places, and of angles; and whether all came there."""
    with np.load(file) as data:
        lengths, states = data["lengths"], data["states"]
    scene, off = cube_scene(), []
    for record in np.split(states, np.cumsum(lengths)[:-1])[:count]:
        ts = STEP * np.arange(len(states))[: len(record)]
        run = lagjax.simulate(scene, *state_of(*np.split(record[0], [3, 7, 10])), ts, LAWS, throw=False)
        k = round(LATER / STEP)
        q = jax.tree.map(lambda x, k=k: np.asarray(x[k]), run.q)
        cosine = min(1.0, abs(q["turn"] @ record[k, 3:7]) / np.linalg.norm(record[k, 3:7]))
        off.append((np.linalg.norm(q["place"] - record[k, :3]), 2 * np.arccos(cosine), bool(run.ok)))
    return np.array(off)


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


def draw(run):
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


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="recorded tosses, an .npz")
    parser.add_argument("--count", type=int, help="so many of them")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    plt.style.use("lagjax.figures")

    run = lagjax.simulate(cube_scene(), *toss(), np.linspace(0.0, 1.0, 149), LAWS)
    impacts = int(run.impacts.count)
    print(f"{impacts} impacts; at rest at z = {float(run.q['place'][-1, 2]):.12f} half edges")
    draw(run)
    if options.file is None:
        return run
    off = follow_tosses(options.file, options.count)
    place, angle = np.median(off[:, :2], axis=0)
    print(f"{int(off[:, 2].sum())} of {len(off)} came to the end of their records")
    print(f"rolled out: {len(off)} tosses, place {place:.3f} and angle {angle:.3f} at {LATER} s")
    return off


if __name__ == "__main__":
    main()
