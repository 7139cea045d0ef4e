"""First results of scenes with contacts, each in a process of its own: `python -m benchmarks.contacts --first`.

    python -m benchmarks._contact_first "ball: value"     # one row in this process, as JSON

A row is a call and what its value is measured against: a closed form, what is conserved, or differences of values. CPU
seconds are those of the call, behind all imports, with `LAGJAX_CACHE=off`; of a row that runs again those of a later
one. The loops of the search are the same for all scenes: `loops kept` are the seconds where another scene ran before on
this machine. `before` is what this table was begun with, `goal` what is aimed at.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks._contacts import spinning_ball, system_of
from examples.cube import PUBLISHED, cube_scene, own_toss

LIMIT = 120  # CPU s of a row
G, E, LID, SPAN = 9.81, 0.7, 1.7, 2.0
CUBE_STEP = 3e-6


class First(NamedTuple):
    """A row: seconds aimed at and before, None where it was refused or cut off; `make` gives a call and its error.

    Of a row that is called `again` so often, a later call counts.
    """

    goal: float
    before: float | None
    make: Callable[[], tuple[Callable[[], Any], Callable[[Any], Any]]]
    again: int = 0


# ---- a ball between floor and lid ------------------------------------------------------------------------------------


def _bounced(x, count: int):
    """The height at the end of a ball that is let go at x[0] with 0.1 upwards, after `count` bounces with e = x[1]."""
    y, v, left = x[0] if count >= 0 else 0.0, 0.1, SPAN if count >= 0 else 0.0
    for k in range(count + 1):
        fall = (v + jnp.sqrt(v**2 + 2 * G * y)) / G
        if k < count:
            y, v, left = 0.0, x[1] * (G * fall - v), left - fall
    return y + v * left - G / 2 * left**2


def _bounces(height: float, e: float) -> int:
    """How many bounces there are in time; −1 where it rests by then."""
    fall, count = (0.1 + np.sqrt(0.01 + 2 * G * height)) / G, 0
    left, v = SPAN - fall, e * np.sqrt(0.01 + 2 * G * height)
    while left > 0:
        left, v, count = left - 2 * v / G, e * v, count + 1
        if v < 1e-9:
            return -1
    return count


BALL = lagjax.System(
    lambda q, v: 0.5 * v @ v - G * q[1], contacts=lambda q: jnp.stack([LID - q[1], q[1]]),
    restitution=lambda params: params,
)  # fmt: skip


def _ball(transform: Callable = lambda f: f) -> tuple:
    ts, v0, x = jnp.linspace(0.0, SPAN, 21), jnp.array([0.4, 0.1]), jnp.array([1.1, E])

    def height(x):
        return lagjax.simulate(BALL, jnp.array([0.0, x[0]]), v0, ts, x[1]).q[-1, 1]

    run, count = transform(height), _bounces(1.1, E)
    exact = transform(lambda x: _bounced(x, count))
    return lambda: run(x), lambda found: _off(found, exact(x))


def _balls(count: int) -> tuple:
    heights, ts = np.linspace(0.5, 1.5, count), jnp.linspace(0.0, SPAN, 21)
    q = np.stack([0 * heights, heights], axis=1)
    v, e = np.tile([0.4, 0.1], (count, 1)), np.linspace(0.5, 0.95, count)

    def right():
        return np.array([_bounced(np.array([h, r]), _bounces(h, r)) for h, r in zip(heights, e, strict=True)])

    def run():
        return lagjax.simulate_batch(BALL, q, v, ts, e, batch_axes=(0, 0, 0)).q[:, -1, 1]

    return run, lambda found: _off(found, right())


def _spinning(transform: str | None) -> tuple:
    row = spinning_ball(0.1)
    system, x, ts = system_of(row.scene), jnp.asarray(row.x), jnp.array([0.0, row.duration])

    def end(x):
        motion = lagjax.simulate(system, x[:3], x[3:6], ts, x[6:])
        return motion.q[-1, 0] if transform else jnp.concatenate([motion.q[-1], motion.qdot[-1]])

    if transform is None:
        return lambda: end(x), lambda found: _off(found, row.exact(x))
    by = np.array(row.columns)
    right = jax.grad(lambda x: row.exact(x)[0])
    return lambda: jax.grad(end)(x), lambda found: _off(found[by], right(x)[by])


# ---- many contacts ---------------------------------------------------------------------------------------------------


def _wheel() -> tuple:
    """A rimless wheel with eight spokes and friction that rolls until it stands on two of them."""
    turns = 2 * jnp.pi * (jnp.arange(8) + 0.5) / 8

    def feet(q):
        return jnp.stack([q[0] + jnp.sin(turns + q[2]), q[1] - jnp.cos(turns + q[2])], axis=1)

    wheel = lagjax.System(
        lambda q, v: 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.25 * v[2] ** 2) - G * q[1], contacts=lambda q: feet(q)[:, 1],
        slip=lambda q, v: jax.jvp(feet, (q,), (v,))[1][:, 0], friction=0.8, restitution=0.0,
    )  # fmt: skip
    ts = np.array([0.0, 8.0])

    def off(motion):  # from standing on two spokes at rest
        (_, y, turn), steps = np.asarray(motion.q[-1]), np.pi / 4
        return max(abs(y - np.cos(np.pi / 8)), abs(turn - steps * np.round(turn / steps)), abs(motion.qdot[-1]).max())

    start = np.array([0.0, np.cos(np.pi / 8) + 0.01, 0.02]), np.array([1.0, 0.0, -1.5])
    return lambda: lagjax.simulate(wheel, *start, ts), off


def _light_bodies(e: float, count: int = 24) -> tuple:
    """Light bodies from all sides that strike one at once: it stays, and they go back with e times their speed."""
    turns = 2 * np.pi * np.arange(count) / count
    around, masses = np.stack([np.cos(turns), np.sin(turns)], axis=1), np.array([1.0] + [1e-3] * count)
    scene = lagjax.System(
        lambda q, v: 0.5 * jnp.sum(masses[:, None] * v**2), restitution=e,
        contacts=lambda q: jnp.sqrt(jnp.sum((q[1:] - q[0]) ** 2, axis=1)) - 1.0,
    )  # fmt: skip
    none = np.zeros((1, 2))
    start = np.concatenate([none, 1.5 * around]), np.concatenate([none, -around])
    right = np.concatenate([none, (1.0 + 0.5 * e) * around])
    ts = np.array([0.0, 1.0])
    return lambda: lagjax.simulate(scene, *start, ts).q[-1], lambda found: _off(found, right)


def _beads(count: int, e: float) -> tuple:
    """Beads in a row, of which the first strikes the others: momentum is kept, and with e = 0 all go on together."""
    row = lagjax.System(
        lambda q, v: 0.5 * v @ v, contacts=lambda q: q[1:] - q[:-1] - 0.5, restitution=lambda params: params
    )  # fmt: skip
    q, v, ts = np.arange(float(count)), np.eye(count)[0], np.array([0.0, count * count / 4.0])

    def off(motion):
        end = np.asarray(motion.qdot[-1])
        return max(abs(end.sum() - 1.0), 0.0 if e else abs(end - 1.0 / count).max())

    return lambda: lagjax.simulate(row, q, v, ts, e, max_transitions=8192), off


def _chain(count: int) -> tuple:
    """A chain of springs that meets a wall: energy is kept but for what impacts take."""
    chain = lagjax.System(
        lambda q, v: 0.5 * jnp.sum(v**2) - 10.0 * jnp.sum(jnp.diff(q) ** 2), contacts=lambda q: 0.5 - q[-1],
        restitution=0.8,
    )  # fmt: skip
    ts = np.array([0.0, 2.0])

    def off(motion):
        q, v = motion.q[-1], motion.qdot[-1]
        energy = 0.5 * np.sum(v**2) + 10.0 * np.sum(np.diff(q) ** 2) + np.nansum(motion.impacts.energy_lost)
        return abs(energy / (0.5 * count) - 1.0)

    return lambda: lagjax.simulate(chain, np.zeros(count), np.ones(count), ts), off


# ---- a cube, modes, long motions -------------------------------------------------------------------------------------


def _cube(rough: bool, slopes: bool = False) -> tuple:
    """The toss of the example: the cube comes to rest on a face; slopes at 0.2 s, behind its first impacts."""
    scene, start = cube_scene(rough), own_toss()
    laws = {name: value for name, value in PUBLISHED.items() if rough or name != "friction"}
    ts = np.linspace(0.0, 0.2 if slopes else 1.2, 46)

    def place(laws, start):
        return lagjax.simulate(scene, *start, ts, laws).q["place"][-1, 0]

    if not slopes:

        def off(motion):
            energy, lost = motion.energy(), np.nansum(motion.impacts.energy_lost)
            return abs(motion.q["place"][-1, 2] - 1.0) if rough else abs((energy[-1] + lost) / energy[0] - 1.0)

        return lambda: lagjax.simulate(scene, *start, ts, laws), off

    def off_slopes(found):
        """From central differences, by the laws and by the first number of each part of the start."""
        errors, (leaves, structure) = [], jax.tree.flatten((laws, start))
        for k, by in enumerate(jax.tree.leaves(found)):
            if k in (of["turn"] for of in structure.unflatten(range(len(leaves)))[1]):  # these stay on a sphere
                continue
            ends = []
            for step in (CUBE_STEP, -CUBE_STEP):
                moved = [np.array(x, float) for x in leaves]
                moved[k].flat[0] += step
                ends.append(place(*structure.unflatten(moved)))
            errors.append(_off(np.ravel(by)[0], (ends[0] - ends[1]) / (2 * CUBE_STEP)))
        return max(errors)

    return lambda: jax.grad(place, (0, 1))(laws, start), off_slopes


def _modes(slopes: bool) -> tuple:
    """A mass that flies, and is on a spring below zero, k = 100: in closed form after one visit there."""
    flight = lagjax.System(lambda q, v: 0.5 * v**2 - G * q)
    spring = lagjax.System(lambda q, v, params: 0.5 * v**2 - G * q - 0.5 * params * q**2)
    over = [
        lagjax.Transition("flight", "spring", lambda q, v: q, -1),
        lagjax.Transition("spring", "flight", lambda q, v: q, 1),
    ]
    scene, ts = lagjax.Hybrid({"flight": flight, "spring": spring}, over, "flight"), jnp.array([0.0, 1.0])

    def end(x):
        return lagjax.simulate(scene, x[0], 0.0, ts, x[1]).q[-1]

    def exact(x):
        fall, w = jnp.sqrt(2 * x[0] / G), jnp.sqrt(x[1])
        visit = 2.0 / w * (jnp.pi - jnp.arctan2(G * fall / w, G / w**2))
        left = 1.0 - fall - visit
        return G * fall * left - 0.5 * G * left**2

    x = jnp.array([1.0, 100.0])
    if not slopes:
        return lambda: end(x), lambda found: _off(found, exact(x))
    return lambda: jax.value_and_grad(end)(x)[1], lambda found: _off(found, jax.grad(exact)(x))


def _long_motion(count: int = 1000) -> tuple:
    """A ball with e = 1 that bounces so often; seconds are those of one impact."""
    ball = lagjax.System(lambda q, v: 0.5 * v**2 - G * q, contacts=lambda q: q, restitution=1.0)
    period = 2 * np.sqrt(2 / G)
    ts = np.array([0.0, count * period])
    return lambda: lagjax.simulate(ball, 1.0, 0.0, ts, max_transitions=2 * count).q[-1], lambda q: abs(q - 1.0)


def _many_impacts(count: int = 10_000, bounces: int = 18) -> tuple:
    """Balls of many heights, with e = 1, that bounce 18 times each: seconds are those of one impact."""
    ball = lagjax.System(lambda q, v: 0.5 * v**2 - G * q, contacts=lambda q: q, restitution=1.0)
    h, end = np.linspace(0.95, 1.0, count), bounces * np.sqrt(8 / G)  # periods of the highest one
    period = np.sqrt(8 * h / G)
    right = h - G / 2 * (end - period * np.round(end / period)) ** 2

    def run():
        return lagjax.simulate_batch(ball, h, 0 * h, np.array([0.0, end])).q[:, -1]

    return run, lambda found: _off(found, right)


def _off(found, right) -> float:
    found, right = np.asarray(found), np.asarray(right)
    return float(np.nan_to_num(np.abs(found - right) / max(1.0, np.abs(right).max()), nan=np.inf).max())


ROWS = {
    "ball: value": First(0.5, 1.9, _ball),
    "ball: gradient": First(1.5, 10.1, lambda: _ball(jax.grad)),
    "ball: Hessian": First(4, 18.6, lambda: _ball(jax.hessian)),
    "ball: batch of 1000": First(0.8, 9.8, lambda: _balls(1000)),
    "ball: value, again": First(6e-4, 1.9e-3, _ball, 20),
    "ball: gradient, again": First(6e-4, 5e-2, lambda: _ball(jax.grad), 20),
    "ball: value within jit, again": First(1e-4, 1e-4, lambda: _ball(jax.jit), 100),
    "ball: gradient within jit, again": First(1.3e-3, 1.3e-3, lambda: _ball(lambda f: jax.jit(jax.grad(f))), 20),
    "ball with spin and friction: value": First(0.8, 2.2, lambda: _spinning(None)),
    "ball with spin and friction: gradient": First(2, 12.6, lambda: _spinning("grad")),
    "rimless wheel, 8 spokes, to rest": First(3, 52, _wheel),
    "24 light bodies strike one, e = 0.5": First(4, 50, lambda: _light_bodies(0.5)),
    "24 light bodies strike one, e = 0": First(4, None, lambda: _light_bodies(0.0)),
    "cube, 8 corners with friction: value": First(5, None, lambda: _cube(True)),
    "cube, 8 corners with friction: gradient": First(12, None, lambda: _cube(True, True)),
    "cube without friction: value": First(2, 12.1, lambda: _cube(False)),
    "1000 springs meet a wall": First(3, 25, lambda: _chain(1000)),
    "2000 springs meet a wall": First(6, None, lambda: _chain(2000)),
    "60 beads in a row, e = 0.9": First(3, None, lambda: _beads(60, 0.9)),
    "300 beads in a row, e = 0": First(20, None, lambda: _beads(300, 0.0)),
    "two modes: value": First(2, None, lambda: _modes(False)),
    "two modes: gradient": First(2, 5.2, lambda: _modes(True)),
    "1000 impacts, one of them": First(5e-6, 1.6e-5, _long_motion, 3),
    "10000 members, 18 impacts, one of them": First(7e-7, 1e-6, _many_impacts, 3),
}
_EACH = {"1000 impacts, one of them": 1000, "10000 members, 18 impacts, one of them": 180_000}


# ---- a row, in a process of its own ----------------------------------------------------------------------------------


def measure_row(name: str) -> dict[str, Any]:
    """CPU seconds of the row in this process, where no result was before, its peak memory, and its error."""
    row, begun = ROWS[name], time.process_time
    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.jit(lambda x: x @ x)(jnp.ones(3)))  # XLA is there
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (int(begun()) + LIMIT, hard))
    run, error = row.make()
    start = begun()
    found = jax.block_until_ready(run())
    spent = begun() - start
    if row.again:
        start = begun()
        for _ in range(row.again):
            found = jax.block_until_ready(run())
        spent = (begun() - start) / row.again / _EACH.get(name, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
    return {"CPU s": spent, "GiB": peak, "error": float(error(found))}


def measure_fresh(name: str, cache: str = "off") -> dict[str, Any]:
    """The row in a fresh process, with what the `cache` stores; of one that fails its last line."""
    settings = os.environ | {"LAGJAX_CACHE": cache, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "benchmarks._contact_first", name]
    done = subprocess.run(command, env=settings, capture_output=True, text=True)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    if done.returncode < 0:
        return {"failed": f"cut off at {LIMIT} CPU s"}
    if done.returncode:
        return {"failed": next((line for line in reversed(lines) if "Error" in line), lines[-1])[:200]}
    return json.loads(lines[-1])


def first(begins: str, count: int = 3) -> Iterator[dict[str, Any]]:
    """Every row whose name begins so: the least of `count` fresh processes."""
    for name, row in ROWS.items():
        if not name.startswith(begins):
            continue
        found = []
        for _ in range(count):
            found.append(measure_fresh(name))
            if "failed" in found[-1]:
                break
        best = found[-1] if "failed" in found[-1] else min(found, key=lambda x: x["CPU s"])
        shares = "failed" not in best and not row.again and not name.startswith("two modes")
        kept = min(_measure_kept(name) for _ in range(count)) if shares else None
        numbers = dict.fromkeys(("CPU s", "loops kept", "GiB", "error", "failed"))
        yield {"scene": name, "goal s": float(row.goal), "before s": row.before} | numbers | best | {"loops kept": kept}


def _measure_kept(name: str) -> float:
    with tempfile.TemporaryDirectory() as cache:
        measure_fresh("1000 impacts, one of them", cache)
        return measure_fresh(name, cache)["CPU s"]


if __name__ == "__main__":
    print(json.dumps(measure_row(sys.argv[1])))
