"""Large scenes: seconds to the first result, of a run, the peak memory and the error, each in a process of its own.

    python -m benchmarks.large_scenes                        # the table, benchmarks/results/large_scenes.json
    python -m benchmarks.large_scenes "ring 10000" "net 50"  # some of it
    python -m benchmarks.large_scenes --growth               # rings of 10 to 100 000, and the picture of it

Every motion lasts one unit of time at rtol 1e-9. *First* is what one waits for once lagjax is imported: patterns,
compilation and a run. *By hand* is what a careful person writes with NumPy for that scene, in SciPy's DOP853 at the
same tolerance; the error is the largest component at the end against that at 1e-12. *numba* is an evaluation of the
accelerations of bodies by a loop over pairs, and *µs a call* that of lagjax.
"""

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solveh_banded

import lagjax
from benchmarks import _report
from benchmarks._measure import seconds

STORE = Path(__file__).parent / "results" / "large_scenes.json"
T, RTOL, GRAVITY = 1.0, 1e-9, 9.81
TABLE = (
    "ring 1000", "ring 10000", "ring 100000", "membrane 100", "elements 10000", "double pendulums 3000", "bodies 40",
    "bodies 100", "bodies 300", "pairs 3000", "rods 1000", "net 50",
)  # fmt: skip
MORE = ("gradient ring 1000", "gradient ring 10000", "batch ring 3000", "check ring 10000", "health ring 10000",
        "modes ring 10000")  # fmt: skip
GROWTH = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)


class Large(NamedTuple):
    """A scene, its start, and q̈(q, q̇) by hand, of arrays in the shape of q; None where that is long."""

    system: lagjax.System
    q: np.ndarray
    qdot: np.ndarray
    by_hand: Callable | None = None


def _start(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return 0.3 * rng.normal(size=shape), 0.3 * rng.normal(size=shape)


def ring(n: int) -> Large:
    """A ring of φ⁴ sites with springs between neighbours; one of them is five times as heavy."""
    m = np.ones(n)
    m[n // 3] = 5.0

    def lagrangian(q, qdot):
        bonds = 0.5 * (q - jnp.roll(q, 1)) ** 2
        return 0.5 * jnp.sum(m * qdot**2) - jnp.sum(bonds + 0.25 * (q**2 - 1) ** 2)

    def by_hand(q, qdot):
        return (np.roll(q, 1) + np.roll(q, -1) - 2 * q - q * (q * q - 1)) / m

    return Large(lagjax.System(lagrangian), *_start(n), by_hand)


def membrane(n: int) -> Large:
    """n × n pendulums that follow their neighbours."""

    def lagrangian(q, qdot):
        along, across = jnp.diff(q, axis=0), jnp.diff(q, axis=1)
        return 0.5 * jnp.sum(qdot**2) - jnp.sum(1 - jnp.cos(along)) - jnp.sum(1 - jnp.cos(across))

    def by_hand(q, qdot):
        along, across = np.sin(np.diff(q, axis=0)), np.sin(np.diff(q, axis=1))
        force = np.zeros_like(q)
        force[:-1] += along
        force[1:] -= along
        force[:, :-1] += across
        force[:, 1:] -= across
        return force

    return Large(lagjax.System(lagrangian), *_start(n, n), by_hand)


def elements(n: int) -> Large:
    """A bar of linear finite elements with its consistent mass, and springs that stiffen."""

    def lagrangian(q, qdot):
        kinetic = jnp.sum(qdot[1:] ** 2 + qdot[1:] * qdot[:-1] + qdot[:-1] ** 2) / 6
        return kinetic - jnp.sum(0.5 * jnp.diff(q) ** 2 + 0.05 * jnp.diff(q) ** 4)

    band = np.full((2, n), 2 / 3)
    band[0], band[1, [0, -1]] = 1 / 6, 1 / 3

    def by_hand(q, qdot):
        d = np.diff(q)
        pull, force = d + 0.2 * d**3, np.zeros(n)
        force[:-1] += pull
        force[1:] -= pull
        return solveh_banded(band, force)

    return Large(lagjax.System(lagrangian), *_start(n), by_hand)


def double_pendulums(n: int) -> Large:
    """Double pendulums in a row with springs between them."""

    def lagrangian(q, qdot):
        cosine = jnp.cos(q[:, 0] - q[:, 1])
        kinetic = jnp.sum(qdot[:, 0] ** 2 + 0.5 * qdot[:, 1] ** 2 + qdot[:, 0] * qdot[:, 1] * cosine)
        return kinetic + jnp.sum(2 * jnp.cos(q[:, 0]) + jnp.cos(q[:, 1])) - 0.1 * jnp.sum(jnp.diff(q, axis=0) ** 2)

    def by_hand(q, qdot):
        s, c = np.sin(q[:, 0] - q[:, 1]), np.cos(q[:, 0] - q[:, 1])
        d, bonds = 0.2 * np.diff(q, axis=0), np.zeros_like(q)
        bonds[:-1] += d
        bonds[1:] -= d
        one = -2 * np.sin(q[:, 0]) - s * qdot[:, 1] ** 2 + bonds[:, 0]
        two = -np.sin(q[:, 1]) + s * qdot[:, 0] ** 2 + bonds[:, 1]
        return np.stack([one - c * two, 2 * two - c * one], axis=1) / (2 - c * c)[:, None]

    return Large(lagjax.System(lagrangian), *_start(n, 2), by_hand)


def bodies(n: int) -> Large:
    """Bodies that attract each other with a softened force, as a user writes it: all pairs, twice."""

    def lagrangian(q, qdot):
        d = q[:, None] - q[None]
        apart = jnp.sqrt(jnp.sum(d * d, axis=-1) + 1e-2)
        return (0.5 * jnp.sum(qdot**2) + 0.5 * jnp.sum((1 - jnp.eye(n)) / apart) / n) / n

    def by_hand(q, qdot):
        d = q[None] - q[:, None]
        return np.einsum("ijk,ij->ik", d, (np.sum(d * d, axis=-1) + 1e-2) ** -1.5) / n

    return Large(lagjax.System(lagrangian), *_start(n, 3), by_hand)


def pairs(n: int) -> Large:
    """Particles with 100 000 random pairs of them that repel each other."""
    first, second = np.random.default_rng(0).integers(0, n, (2, 100_000))

    def lagrangian(q, qdot):
        return 0.5 * jnp.sum(qdot**2) - jnp.sum(jnp.exp(-jnp.sum((q[first] - q[second]) ** 2, axis=-1)))

    def by_hand(q, qdot):
        d = q[first] - q[second]
        push = 2 * np.exp(-np.sum(d * d, axis=1))[:, None] * d
        return np.stack([np.bincount(first, x, n) - np.bincount(second, x, n) for x in push.T], axis=1)

    return Large(lagjax.System(lagrangian), *_start(n, 3), by_hand)


def rods(n: int) -> Large:
    """Rods of length 1 between two points, 0.8 n apart, in Cartesian coordinates: it falls from a V."""
    down = np.where(np.arange(n) < n // 2, -0.6, 0.6)
    ends = np.zeros((1, 2)), np.array([[0.8 * n, 0.0]])

    def links(q):
        return 0.5 * (jnp.sum(jnp.diff(jnp.concatenate([ends[0], q, ends[1]]), axis=0) ** 2, axis=1) - 1)

    def lagrangian(q, qdot):
        return 0.5 * jnp.sum(qdot**2) - GRAVITY * jnp.sum(q[:, 1])

    q = np.cumsum(np.stack([np.full(n, 0.8), down], axis=1), axis=0)[:-1]
    return Large(lagjax.System(lagrangian, constraints=links), q, np.zeros_like(q))


def net(n: int) -> Large:
    """n × n knots with rigid links of length 1 between neighbours, held at two corners, folded along x."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    q = np.stack([0.8 * i, 1.0 * j, 0.6 * (i % 2)], axis=-1)
    held = q[0, 0], q[0, -1]

    def links(q):
        along, across = (jnp.sum(jnp.diff(q, axis=axis) ** 2, axis=-1) - 1 for axis in (0, 1))
        return {"along": along, "across": across, "held": jnp.stack([q[0, 0] - held[0]])}

    def lagrangian(q, qdot):
        return 0.5 * jnp.sum(qdot**2) - GRAVITY * jnp.sum(q[..., 2])

    return Large(lagjax.System(lagrangian, constraints=links), q, np.zeros_like(q))


FAMILIES = {
    "ring": ring, "membrane": membrane, "elements": elements, "double pendulums": double_pendulums, "bodies": bodies,
    "pairs": pairs, "rods": rods, "net": net,
}  # fmt: skip


def scene_of(name: str) -> Large:
    """A scene by its family and size, as "ring 1000"."""
    family, _, size = name.rpartition(" ")
    return FAMILIES[family](int(size))


# ---- in a process of its own -----------------------------------------------------------------------------------------


def measure(name: str) -> dict[str, Any]:
    """The row of a scene."""
    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.jit(lambda x: x @ x)(jnp.ones(3)))  # XLA is there
    for what, call in TASKS.items():
        if name.startswith(what):
            return _measure_task(call, scene_of(name.removeprefix(what).strip())) | {"scene": name}
    scene, ts = scene_of(name), np.array([0.0, T])

    def run():
        trajectory = lagjax.simulate(scene.system, scene.q, scene.qdot, ts)
        jax.block_until_ready(trajectory.q)
        return trajectory

    (first, trajectory), again = seconds(run), min(seconds(run)[0] for _ in range(3))
    row = {
        "scene": name,
        "first s": first,
        "again s": again,
        "MB": _peak(),
        "steps": int(trajectory.stats["num_steps"]),
    }
    row["engine"] = trajectory.engine
    if scene.system.constraints is not None:
        values = scene.system.constraint_residual(trajectory.q[-1], trajectory.qdot[-1])
        row["off constraints"] = max(float(jnp.abs(x).max()) for x in jax.tree.leaves(values))
    if scene.by_hand is not None:
        exact = _by_hand(scene, 1e-12)[1]
        row["error"] = float(
            np.abs(np.concatenate([*map(np.ravel, (trajectory.q[-1], trajectory.qdot[-1]))]) - exact).max()
        )
        row["by hand s"] = min(_by_hand(scene, RTOL)[0] for _ in range(3))
        row["times by hand"] = again / row["by hand s"]
    if name.startswith("bodies"):
        row |= _evaluations(scene)
    return row


def _evaluations(scene: Large) -> dict[str, float]:
    """Microseconds of an evaluation of the accelerations of bodies, by numba and by lagjax within a run."""
    import numba

    @numba.njit(fastmath=True)
    def by_numba(q, acceleration):
        n = len(q)
        acceleration[:] = 0.0
        for i in range(n):
            for j in range(i):
                x, y, z = q[j, 0] - q[i, 0], q[j, 1] - q[i, 1], q[j, 2] - q[i, 2]
                squared = x * x + y * y + z * z + 1e-2
                pull = 1 / (n * squared * np.sqrt(squared))
                for k, d in enumerate((x, y, z)):
                    acceleration[i, k] += pull * d
                    acceleration[j, k] -= pull * d

    out = np.empty_like(scene.q)
    by_numba(scene.q, out)
    assert scene.by_hand is not None
    np.testing.assert_allclose(out, scene.by_hand(scene.q, scene.qdot), rtol=1e-10, atol=1e-12)
    count = 200
    loop = jax.jit(lambda q: jax.lax.fori_loop(0, count, lambda _, q: q + 1e-9 * scene.system.acceleration(q, q), q))
    jax.block_until_ready(loop(scene.q))
    ours = min(seconds(lambda: jax.block_until_ready(loop(scene.q)))[0] for _ in range(5)) / count
    theirs = min(seconds(lambda: [by_numba(scene.q, out) for _ in range(count)])[0] for _ in range(5)) / count
    return {"numba µs": 1e6 * theirs, "µs a call": 1e6 * ours}


def _by_hand(scene: Large, rtol: float) -> tuple[float, np.ndarray]:
    """Seconds and the end of the motion by SciPy."""
    assert scene.by_hand is not None
    shape = scene.q.shape

    def f(t, y):
        q, qdot = (x.reshape(shape) for x in np.split(y, 2))
        return np.concatenate([qdot.ravel(), scene.by_hand(q, qdot).ravel()])

    y = np.concatenate([scene.q.ravel(), scene.qdot.ravel()])
    time, solution = seconds(lambda: solve_ivp(f, (0.0, T), y, "DOP853", rtol=rtol, atol=rtol / 1e3))
    return time, solution.y[:, -1]


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def _measure_task(call: Callable, scene: Large) -> dict[str, Any]:
    run = call(scene)
    return {"first s": seconds(run)[0], "again s": seconds(run)[0], "MB": _peak()}


def gradient(scene: Large) -> Callable:
    """The derivative of a number of the end by all starts."""

    def of(q, qdot):
        return jnp.sum(lagjax.simulate(scene.system, q, qdot, np.array([0.0, T])).q[-1] ** 2)

    derivative = jax.jit(jax.grad(of, argnums=(0, 1)))
    return lambda: jax.block_until_ready(derivative(scene.q, scene.qdot))


def batch(scene: Large) -> Callable:
    """64 members."""
    q = scene.q * np.linspace(0.5, 1.0, 64)[:, None]
    qdot = np.broadcast_to(scene.qdot, q.shape)
    return lambda: jax.block_until_ready(lagjax.simulate_batch(scene.system, q, qdot, np.array([0.0, T])).q)


def check(scene: Large) -> Callable:
    """`check` of the start."""
    return lambda: lagjax.check(scene.system, scene.q, scene.qdot)


def health(scene: Large) -> Callable:
    """`health` of a motion, which is made before."""
    trajectory = lagjax.simulate(scene.system, scene.q, scene.qdot, np.linspace(0.0, T, 5))
    return lambda: trajectory.health()


def modes(scene: Large) -> Callable:
    """The 50 lowest modes about the ring's state of rest q = 1."""
    return lambda: lagjax.normal_modes(scene.system, np.ones_like(scene.q), count=50)


TASKS = {"gradient": gradient, "batch": batch, "check": check, "health": health, "modes": modes}


# ---- the table and the picture ---------------------------------------------------------------------------------------


def _in_new_process(name: str, limit: float) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.large_scenes", "--measure", name]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=limit, cwd=STORE.parents[2])
    except subprocess.TimeoutExpired:
        return {"scene": name, "failed": f"no result in {limit:.0f} s"}
    if run.returncode:
        return {"scene": name, "failed": run.stderr.strip().splitlines()[-1][:200] if run.stderr.strip() else "aborted"}
    return json.loads(run.stdout.splitlines()[-1])


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    from benchmarks._figures import save

    sizes = [int(row["scene"].split()[-1]) for row in rows]
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for label, column, style in (
        ("first result", "first s", "o-"),
        ("a run", "again s", "s-"),
        ("NumPy and DOP853 by hand", "by hand s", "^--"),
    ):
        axes.loglog(sizes, [row.get(column, np.nan) for row in rows], style, label=label)
    engines = [row.get("engine") for row in rows]
    changes = [k for k in range(1, len(rows)) if engines[k] != engines[k - 1]]
    for k in changes:
        axes.axvline(np.sqrt(sizes[k - 1] * sizes[k]), color="0.6", lw=0.8)
        axes.text(np.sqrt(sizes[k - 1] * sizes[k]), axes.get_ylim()[0] * 1.3, " arrays", color="0.4", ha="left")
        axes.text(np.sqrt(sizes[k - 1] * sizes[k]), axes.get_ylim()[0] * 1.3, "machine code ", color="0.4", ha="right")
    axes.set(xlabel="sites of the ring", ylabel="seconds")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    save(figure, path)


def main() -> None:
    """Print the rows and store them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds that a scene may take")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure)))
        return
    part = "growth" if options.growth else "scenes"
    names = [f"ring {n}" for n in GROWTH] if options.growth else options.scenes or [*TABLE, *MORE]
    rows = []
    for name in names:
        rows.append(_in_new_process(name, options.limit))
        print({k: round(v, 4) if isinstance(v, float) and v > 1e-3 else v for k, v in rows[-1].items()}, flush=True)
    record = _report.read_json(STORE)
    others = [] if options.growth else [r for r in record.get(part, {}).get("rows", []) if r["scene"] not in names]
    record[part] = {"circumstances": _report.circumstances(), "rows": [*others, *rows]}
    _report.write_json(STORE, record)
    print(_report.table(record[part]["rows"]))
    if options.growth:
        _draw(rows, STORE.with_name("large_scenes.png"))


if __name__ == "__main__":
    main()
