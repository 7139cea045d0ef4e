"""How often intervals of 95 % hold the truth, in each kind of scene that `fit` takes.

    python -m benchmarks.coverage                            all kinds, some ten minutes
    python -m benchmarks.coverage --kinds contact clipped    some of them, which are not stored
    python -m benchmarks.coverage --draws 1000 --seed 1

Every draw makes records by the scene itself, adds noise, and fits them from parameters that are 10 % off, without a
word about what the sensor does. Each free number of a draw counts as an interval of its own, though those of one draw
are not independent. Intervals of fits that are not `ok` do not count: how many these are stands beside. The standard
error is binomial, √(0.95 · 0.05/intervals).

The record goes to `benchmarks/results/coverage.json`, with commit, versions and machine.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report

G, OFF = 9.81, 0.1
LEVEL = 0.95


class Draw(NamedTuple):
    """Records of a scene with noise, and its parameters."""

    scene: Any
    records: list[lagjax.Record]
    truth: dict[str, float]


def exact_values(scene, record: lagjax.Record, truth: dict[str, float]) -> Any:
    """What sensors show of the motion from the known start of a record, without noise."""
    kept = lagjax.fit(scene, record, truth, free=False)
    return jax.tree.map(np.add, kept.residuals[0], record.values)


def add_noise(rng, exact: np.ndarray, sigma: float, phi: float = 0.0) -> np.ndarray:
    """Values (T, …) with normal noise, of an autoregression where φ is not zero."""
    white = rng.normal(size=exact.shape)
    for i in range(1, len(white) if phi else 0):
        white[i] = phi * white[i - 1] + np.sqrt(1 - phi**2) * white[i]
    return exact + sigma * white


def round_values(values: np.ndarray, step: float, offset: float) -> np.ndarray:
    """The values at a sensor that rounds, whose lines are `offset` of a step from zero."""
    return step * (np.round(values / step + offset) - offset)


# ---- scenes ----------------------------------------------------------------------------------------------------------

PENDULUM = lagjax.System(
    lambda q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q),
    dissipation=lambda q, v, params: 0.5 * params["c"] * v**2,
)
SWING, TIMES = {"w2": 9.0, "c": 0.1}, np.linspace(0.0, 12.0, 601)
DUFFING = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2 - 0.25 * params["k3"] * q**4,
    forces=lambda q, v, params, inputs: params["gain"] * inputs - params["c"] * v,
)
SPRING = {"k": 2.0, "k3": 0.7, "gain": 1.5, "c": 0.3}
MOTOR = lagjax.System(
    lambda q, v: 0.5 * v**2,
    forces=lambda q, v, params, inputs: params["K"] * inputs - params["B"] * v - params["F"] * jnp.sign(v),
)
AXIS = {"K": 8.0, "B": 1.5, "F": 2.0}
LINKS = lagjax.System(
    lambda q, v, params: (
        v[0] ** 2 * params["a"] ** 2
        + 0.5 * (params["b"] * v[1]) ** 2
        + params["a"] * params["b"] * v[0] * v[1] * jnp.cos(q[0] - q[1])
        + G * (2 * params["a"] * jnp.cos(q[0]) + params["b"] * jnp.cos(q[1]))
    )
)
ARMS = {"a": 0.4, "b": 0.3}
TOSS = lagjax.System(
    lambda q, v: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"], contacts=lambda q: {"floor": q["y"]},
    restitution=lambda params: params["e"], friction=lambda params: params["mu"], slip=lambda q, v: {"floor": v["x"]},
)  # fmt: skip
BELT = 0.5  # its speed; the block on it sticks until the spring wins, and slips until it is as fast
BLOCK = lagjax.Hybrid(
    {
        "slip": lagjax.System(
            lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2, forces=lambda q, v, params: params["kinetic"]
        ),
        "stick": lagjax.System(lambda q, v: 0.5 * v**2),
    },
    [
        lagjax.Transition("slip", "stick", lambda q, v: v - BELT, direction=1, reset=lambda q, v: (q, BELT + 0 * v)),
        lagjax.Transition("stick", "slip", lambda q, v, params: params["k"] * q - params["static"], direction=1),
    ],
    "slip",
)
FRICTION = {"k": 4.0, "kinetic": 0.6, "static": 1.2}


# ---- draws -----------------------------------------------------------------------------------------------------------


def draw_swing(rng, size: float, sensor: Callable, knows_start: bool = False, ts=TIMES) -> Draw:
    """A swing of about this size, from any phase of it, as a sensor shows it."""
    size, phase = size * rng.uniform(0.95, 1.05), rng.uniform(0, 2 * np.pi)
    start = size * np.cos(phase), 3 * size * np.sin(phase)
    shown = sensor(np.asarray(lagjax.simulate(PENDULUM, *start, ts, SWING).q))
    return Draw(PENDULUM, [lagjax.Record(ts, shown, start=start if knows_start else None)], SWING)


def draw_free(rng) -> Draw:
    """A pendulum from a known start."""
    return draw_swing(rng, 1.2, lambda q: add_noise(rng, q, 0.01), True, np.linspace(0.0, 8.0, 161))


def draw_correlated(rng) -> Draw:
    """A pendulum, with noise that forgets itself over ten samples."""
    return draw_swing(rng, 1.2, lambda q: add_noise(rng, q, 0.01, 0.9))


def draw_clipped(rng) -> Draw:
    """A pendulum whose sensor ends at two thirds of its swing."""
    return draw_swing(rng, 1.2, lambda q: np.clip(add_noise(rng, q, 5e-3), -0.8, 0.8))


def draw_quantised(rng) -> Draw:
    """A pendulum seen by an encoder of 64 lines, with noise of up to half a line."""
    step = 2 * np.pi / 64
    return draw_swing(
        rng, 0.6, lambda q: round_values(add_noise(rng, q, rng.uniform(0, 0.5) * step), step, rng.random())
    )


def draw_lines(rng, sigma: float) -> Draw:
    """A pendulum that swings over three lines of an encoder of 24."""
    step = 2 * np.pi / 24
    return draw_swing(rng, 0.4, lambda q: round_values(add_noise(rng, q, sigma), step, rng.random()))


def draw_saturated(rng) -> Draw:
    """A pendulum whose coarse sensor ends at half of its swing."""
    return draw_swing(rng, 1.2, lambda q: np.clip(round_values(add_noise(rng, q, 0.02), 0.1, 0.0), -0.6, 0.6))


def draw_short(rng) -> Draw:
    """Eight records of a pendulum, twelve samples each, from starts that no one knows."""
    ts, records = np.linspace(0.0, 2.0, 12), []
    for _ in range(8):
        records += draw_swing(rng, rng.uniform(0.5, 1.5), lambda q: add_noise(rng, q, 0.01), False, ts).records
    return Draw(PENDULUM, records, SWING)


def draw_driven(rng) -> Draw:
    """Duffing's oscillator, driven from rest by random steps of 0.5 s."""
    ts = np.linspace(0.0, 15.0, 301)
    record = lagjax.Record(ts, np.zeros(301), inputs=np.repeat(rng.normal(size=31), 10)[:301], start=(0.0, 0.0))
    values = add_noise(rng, exact_values(DUFFING, record, SPRING), 0.01)
    return Draw(DUFFING, [lagjax.Record(ts, values, inputs=record.inputs, start=(0.0, 0.0))], SPRING)


def draw_motor(rng) -> Draw:
    """An axis with dry friction that comes to rest between strokes."""
    ts = np.linspace(0.0, 4.0, 401)
    strokes = rng.uniform(0.5, 1.2, 4) * rng.choice([-1, 1], 4)
    driven = np.where(ts % 1.0 < rng.uniform(0.3, 0.5), strokes[np.minimum(ts.astype(int), 3)], 0.0)
    record = lagjax.Record(ts, np.zeros(401), inputs=driven, start=(0.0, 0.0))
    values = add_noise(rng, exact_values(MOTOR, record, AXIS), 5e-3)
    return Draw(MOTOR, [lagjax.Record(ts, values, inputs=driven, start=(0.0, 0.0))], AXIS)


def draw_encoder(rng) -> Draw:
    """A square wave for 3 s of 4, then rest, of an axis seen by an encoder of 2.5 mrad."""
    ts = np.linspace(0.0, 4.0, 2000)
    driven = np.where(ts < 3.0, rng.uniform(1.5, 3.0) * np.sign(np.sin(2 * np.pi * ts / 0.8 + rng.uniform(0, 6))), 0.0)
    record = lagjax.Record(ts, np.zeros(2000), inputs=driven, start=(0.0, rng.uniform(-1, 1)))
    values = round_values(exact_values(MOTOR, record, AXIS), 2.5e-3, rng.random())
    return Draw(MOTOR, [lagjax.Record(ts, values, inputs=driven)], AXIS)


def draw_chaotic(rng) -> Draw:
    """A double pendulum that goes over the top, so long that it has to be followed in pieces."""
    ts = np.linspace(0.0, 12.0, 601)
    start = rng.uniform(2.3, 3.0, 2), rng.uniform(-0.5, 0.5, 2)
    values = np.asarray(lagjax.simulate(LINKS, *start, ts, ARMS).q)
    return Draw(LINKS, [lagjax.Record(ts, add_noise(rng, values, 0.01))], ARMS)


def draw_tosses(rng) -> Draw:
    """Two tosses along a rough floor."""
    ts, records, truth = np.linspace(0.0, 1.2, 61), [], {"e": rng.uniform(0.4, 0.8), "mu": rng.uniform(0.05, 0.3)}
    for _ in range(2):
        start = {"x": 0.0, "y": rng.uniform(0.4, 1.2)}, {"x": rng.uniform(2.5, 4.0), "y": 0.0}
        motion = lagjax.simulate(TOSS, *start, ts, truth)
        values = {name: add_noise(rng, np.asarray(x), 1e-3) for name, x in motion.q.items()}
        records.append(lagjax.Record(ts, values, start=start))
    return Draw(TOSS, records, truth)


def draw_block(rng) -> Draw:
    """A block on a belt that sticks and slips."""
    ts, start = np.linspace(0.0, 8.0, 161), (rng.uniform(-0.4, -0.18), 0.0)
    record = lagjax.Record(ts, np.zeros(161), start=start)
    values = add_noise(rng, exact_values(BLOCK, record, FRICTION), 2e-3)
    return Draw(BLOCK, [lagjax.Record(ts, values, start=start)], FRICTION)


class Kind(NamedTuple):
    """One kind of scene: how it is drawn from a generator, and how often."""

    draw: Callable[[Any], Draw]
    draws: int


KINDS = {
    "free": Kind(draw_free, 400), "driven": Kind(draw_driven, 200), "dry friction, rest": Kind(draw_motor, 200),
    "chaotic, in pieces": Kind(draw_chaotic, 100), "contact": Kind(draw_tosses, 200),
    "stick and slip": Kind(draw_block, 200), "correlated noise": Kind(draw_correlated, 400),
    "quantised": Kind(draw_quantised, 400), "clipped": Kind(draw_clipped, 400), "unknown starts": Kind(draw_short, 400),
}  # fmt: skip
# Beside the ten: sensors that do more than one thing.
SENSORS = {
    "rest, encoder": Kind(draw_encoder, 100), "24 lines": Kind(lambda rng: draw_lines(rng, 0.0), 200),
    "24 lines, noise": Kind(lambda rng: draw_lines(rng, 0.08), 200), "coarse and clipped": Kind(draw_saturated, 200),
}  # fmt: skip


def count_held(name: str, draw: Callable[[Any], Draw], seeds: range) -> dict[str, Any]:
    """The share of intervals that hold the truth, by parameter and of all, and of fits that are not ok."""
    held: dict[str, list[bool]] = {}
    refused, begun = 0, time.process_time()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        scene, records, truth = draw(rng)
        begin = {k: x * (1 + OFF * rng.choice([-1, 1])) for k, x in truth.items()}
        fit = lagjax.fit(scene, records, begin, transforms=lagjax.positive)
        if not fit.ok:
            refused += 1
            continue
        low, high = fit.intervals(LEVEL)
        for k, x in truth.items():
            held.setdefault(k, []).append(bool(low[k] <= x <= high[k]))
    every = [x for each in held.values() for x in each]
    return {
        "kind": name, "intervals": len(every), "held": float(np.mean(every)) if every else np.nan,
        "standard error": float(np.sqrt(LEVEL * (1 - LEVEL) / max(len(every), 1))),
        **{"by number": ", ".join(f"{k} {np.mean(each):.3f}" for k, each in held.items())},
        "fits": len(seeds), "not ok": refused, "CPU s": time.process_time() - begun,
    }  # fmt: skip


def main(argv=None) -> list[dict[str, Any]]:
    """Count, print a row of each kind, and store them where all kinds were counted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = KINDS | SENSORS
    parser.add_argument("--kinds", nargs="+", choices=tuple(every), default=tuple(every), metavar="KIND")
    parser.add_argument("--draws", type=int, help="fits of each kind instead of its own number")
    parser.add_argument("--seed", type=int, default=0, help="the seeds are those from this times a million on")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results", help="folder for the record")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    rows, first = [], 1_000_000 * options.seed
    for name in options.kinds:
        kind = every[name]
        rows.append(count_held(name, kind.draw, range(first, first + (options.draws or kind.draws))))
        print(_report.table(rows[-1:]).splitlines()[-1] if len(rows) > 1 else _report.table(rows), flush=True)
    if {*every} <= {*options.kinds} and not options.draws:
        options.output.mkdir(parents=True, exist_ok=True)
        record = {"circumstances": _report.circumstances(), "level": LEVEL, "coverage": rows}
        _report.write_json(options.output / "coverage.json", record)
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
