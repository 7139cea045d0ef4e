"""Random fits with one seeded mistake each: is any answer wrong without a word?

    python -m benchmarks.fit_population --fits 97 --sensors 60 --honest 30
    python -m benchmarks.fit_population --fits 0 --sensors 60 --honest 10 --float32

A pendulum with friction, a double pendulum, a cart with a pole, Duffing's oscillator and two masses on springs, three
records each, and one mistake in the data: angles modulo 2π, degrees, milliseconds, swapped signals, a constant signal,
a wrong sign, shifted times, one record mirrored, one record of another machine. `--sensors` draws what sensors do:
samples missing and written as 0.0, −9999 or 1e6, values rounded, rounded to 24 lines of a turn, or cut off at limits;
`--float32` hands records over in float32 without JAX's switch. An answer is

- *right* where the fit is ok and every parameter is within four standard deviations or 1 % of the truth; of a mistake
  that only changes units, of the truth in these units;
- *named* where the fit is not ok, or refused, and a sentence says what the mistake is, or which record has it;
- *told* where the fit is not ok, and no sentence says why;
- *wrong* where the fit is ok and a parameter is not right; a *crash* is an error that is no sentence.

Honest fits, with no mistake, are the control: one that is not ok is an *alarm*.
"""

import argparse
import collections
import functools
import re
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax

G, RECORDS, MILLI = 9.81, 3, 1000.0
SIGMA = 3e-3  # noise, in rad or m: a fraction of a percent of the signals


class Case(NamedTuple):
    """A scene with the truth, the times, which coordinates are angles, which parameters a unit of time changes."""

    system: lagjax.System
    truth: dict[str, float]
    ts: np.ndarray
    angles: tuple[int, ...]
    size: int
    by_time: dict[str, float] | None  # powers of time in the units of parameters; None where a clock drives the scene


def _pendulum(q, v, params):
    return 0.5 * v[0] ** 2 + params["w2"] * jnp.cos(q[0])


def _double(q, v, params):
    a, b = params["a"], params["b"]
    kinetic = v[0] ** 2 * a**2 + 0.5 * b**2 * v[1] ** 2 + a * b * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + G * (2 * a * jnp.cos(q[0]) + b * jnp.cos(q[1]))


def _cart(q, v, params):
    m, length = params["m"], params["l"]
    pole = 0.5 * (v[0] ** 2 + 2 * length * v[0] * v[1] * jnp.cos(q[1]) + (length * v[1]) ** 2)
    return 0.5 * m * v[0] ** 2 + pole + G * length * jnp.cos(q[1])


def _duffing(q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2 - 0.25 * params["k3"] * q[0] ** 4


def _springs(q, v, params):
    kinetic = 0.5 * v[0] ** 2 + 0.5 * 2.0 * v[1] ** 2
    return kinetic - 0.5 * params["k1"] * q[0] ** 2 - 0.5 * params["k2"] * (q[1] - q[0]) ** 2


def _friction(q, v, params):
    return 0.5 * params["c"] * jnp.sum(v**2)


CASES = {
    "pendulum": Case(
        lagjax.System(_pendulum, dissipation=_friction), {"w2": 9.0, "c": 0.1}, np.linspace(0, 8, 401), (0,), 1,
        {"w2": -2, "c": -1},
    ),
    "double pendulum": Case(
        lagjax.System(_double), {"a": 0.4, "b": 0.3}, np.linspace(0, 3, 301), (0, 1), 2, {"a": 2, "b": 2}
    ),
    "cart and pole": Case(
        lagjax.System(_cart, forces=lambda q, v, t: jnp.array([4.0 * jnp.sin(2.3 * t), 0.0])),
        {"m": 2.0, "l": 0.5}, np.linspace(0, 4, 301), (1,), 2, None,
    ),
    "Duffing": Case(
        lagjax.System(_duffing, forces=lambda q, v, t: jnp.array([1.5 * jnp.cos(1.3 * t)]), dissipation=_friction),
        {"k": 1.0, "k3": 0.7, "c": 0.15}, np.linspace(0, 8, 401), (), 1, None,
    ),
    "two masses": Case(
        lagjax.System(_springs, dissipation=_friction), {"k1": 6.0, "k2": 3.0, "c": 0.1}, np.linspace(0, 8, 301), (), 2,
        {"k1": -2, "k2": -2, "c": -1},
    ),
}  # fmt: skip


class Spoiled(NamedTuple):
    """Records with a mistake, the words that name it, and the truth in the units of the records."""

    records: list[lagjax.Record]
    words: str
    truth: dict[str, float]


def drawn(case: Case, rng, fast: bool = False) -> list[np.ndarray]:
    """The values (T, n) of three records without a mistake; `fast` angles go over the top."""
    q0, v0 = rng.uniform(-1.2, 1.2, (RECORDS, case.size)), rng.normal(size=(RECORDS, case.size))
    if fast:
        v0[:, case.angles[0]] = rng.choice([-1, 1]) * rng.uniform(7.0, 10.0, RECORDS)
    return [motion(case, q, v, case.truth, rng) for q, v in zip(q0, v0, strict=True)]


def motion(case: Case, q0, v0, params, rng) -> np.ndarray:
    """One motion (T, n) with noise."""
    q = np.asarray(lagjax.simulate(case.system, q0, v0, case.ts, params).q)
    return q + SIGMA * rng.normal(size=q.shape)


def spoil(case: Case, mistake: str | None, rng) -> Spoiled:
    """Records of a scene with one mistake, None for none."""
    values, ts, truth = drawn(case, rng, mistake == "wrapped"), case.ts, case.truth
    which, column = int(rng.integers(RECORDS)), int(rng.integers(case.size))
    mine = re.escape(f"records[{which}]")
    times, words = [ts] * RECORDS, ""
    if mistake == "wrapped":
        words = r"jumps by"
        for one in values:
            one[:, case.angles] = np.mod(one[:, case.angles] + np.pi, 2 * np.pi) - np.pi
    elif mistake == "degrees":
        words = "degrees"
        for one in values:
            one[:, case.angles] *= 180 / np.pi
    elif mistake == "milliseconds":
        times, words = [MILLI * ts] * RECORDS, "milliseconds"
        if case.by_time is not None:
            truth = {k: x * MILLI ** case.by_time[k] for k, x in truth.items()}
    elif mistake == "swapped":
        values, words = [one[:, ::-1] for one in values], "swapped"
    elif mistake == "constant":
        words = "at all .* samples"
        for one in values:
            one[:, column] = one[0, column]
    elif mistake == "wrong sign":
        words = "sign"
        for one in values:
            one[:, column] *= -1
    elif mistake == "shifted":
        times[which], words = ts + rng.uniform(0.4, 0.9), rf"{mine}|late|early|shift"
    elif mistake == "mirrored":
        values[which], words = -values[which], mine
    elif mistake == "another machine":
        name, words = rng.choice(list(truth)), mine
        other = {**truth, name: truth[name] * rng.choice([0.7, 1.4])}
        values[which] = motion(case, *rng.uniform(-1.2, 1.2, (2, case.size)), other, rng)
    elif mistake in PLACEHOLDERS:
        words, share = "missing", rng.uniform(0.02, 0.1)
        for one in values:
            one[rng.random(one.shape) < share] = PLACEHOLDERS[mistake]
    elif mistake == "rounded":
        values = [_round(one, rng.uniform(0.01, 0.1), offset) for offset in [rng.random()] for one in values]
    elif mistake == "24 lines":
        values = [_round(one, 2 * np.pi / 24, offset) for offset in [rng.random()] for one in values]
    elif mistake == "clipped":
        ends = rng.uniform(0.5, 0.9) * np.max([np.abs(one).max(axis=0) for one in values], axis=0)
        values = [np.clip(one, -ends, ends) for one in values]
    if not jax.config.jax_enable_x64:
        values = [one.astype(np.float32) for one in values]
    return Spoiled([lagjax.Record(t, one) for t, one in zip(times, values, strict=True)], words, truth)


def _round(values: np.ndarray, step: float, offset: float) -> np.ndarray:
    """The values at a sensor that rounds, whose lines are `offset` of a step from zero."""
    return step * (np.round(values / step + offset) - offset)


PLACEHOLDERS = {"zeros": 0.0, "-9999": -9999.0, "1e6": 1e6}
SENSORS: dict[str, Callable[[Case], bool]] = {
    name: lambda case: True for name in (*PLACEHOLDERS, "rounded", "24 lines", "clipped")
}
MISTAKES: dict[str, Callable[[Case], bool]] = {
    "wrapped": lambda case: bool(case.angles),
    "degrees": lambda case: bool(case.angles),
    "milliseconds": lambda case: True,
    "swapped": lambda case: case.size > 1,
    "constant": lambda case: True,
    "wrong sign": lambda case: True,
    "shifted": lambda case: True,
    "mirrored": lambda case: True,
    "another machine": lambda case: True,
}


def judge(case: Case, spoiled: Spoiled, rng) -> tuple[str, str]:
    """What became of one fit, and what it says."""
    begin = {k: x * rng.choice([0.75, 1.3]) for k, x in case.truth.items()}
    try:
        fit = lagjax.fit(case.system, spoiled.records, begin, transforms=lagjax.positive)
    except (ValueError, lagjax.SimulationError) as reason:
        return ("named" if spoiled.words and re.search(spoiled.words, str(reason)) else "told"), f"refused: {reason}"
    except Exception as reason:
        return "crash", f"{type(reason).__name__}: {reason}"
    text = f"{ {k: float(f'{x:.4g}') for k, x in fit.params.items()} } {' '.join(fit.unseen)} {fit.message}"
    if not fit.ok:
        return ("named" if spoiled.words and re.search(spoiled.words, text) else "told"), text
    low, high = fit.intervals(0.9999)
    right = all(
        low[k] <= x <= high[k] or abs(fit.params[k] / x - 1) < 0.01 for k, x in spoiled.truth.items()
    )  # fmt: skip
    return "right" if right else "wrong", text


def schedule(fits: int, honest: int, sensors: int = 0) -> list[tuple[int, str, str | None]]:
    """(seed, scene, mistake): every mistake in every scene that can have it, in turn, and honest fits last."""
    rows: list[tuple[int, str, str | None]] = []
    for first, count, mistakes in ((0, fits, MISTAKES), (5_000, sensors, SENSORS)):
        pairs = [(scene, mistake) for mistake, can in mistakes.items() for scene, case in CASES.items() if can(case)]
        order = np.random.default_rng(0).permutation(len(pairs))
        rows += [(first + seed, *pairs[order[seed % len(pairs)]]) for seed in range(count)]
    return rows + [(10_000 + seed, list(CASES)[seed % len(CASES)], None) for seed in range(honest)]


def main(argv=None) -> dict[str, Any]:
    """Run the population, print what is wrong, told or an alarm, and return the counts by mistake."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=100, help="fits with a mistake")
    parser.add_argument("--sensors", type=int, default=0, help="fits with what sensors do to numbers")
    parser.add_argument("--float32", action="store_true", help="records in float32, without JAX's switch")
    parser.add_argument("--honest", type=int, default=30, help="fits without one")
    parser.add_argument("--only", type=int, nargs="*", help="seeds to run alone, with all that they say")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", not options.float32)
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for seed, scene, mistake in schedule(options.fits, options.honest, options.sensors):
        if options.only and seed not in options.only:
            continue
        rng, used = np.random.default_rng(seed), time.process_time()
        became, text = judge(CASES[scene], spoil(CASES[scene], mistake, rng), rng)
        used = time.process_time() - used
        if mistake is None and became == "told":
            became = "alarm"
        counts[mistake or "honest"][became] += 1
        if options.only or became in ("wrong", "told", "alarm", "crash") or used > 20:
            print(f"{seed:>5} {scene}, {mistake}: {became}, {used:.1f} s. {text}", flush=True)
    kinds = ("right", "named", "told", "wrong", "alarm", "crash")
    print(f"\n{'':<16}" + "".join(f"{kind:>8}" for kind in kinds))
    for mistake, count in counts.items():
        print(f"{mistake:<16}" + "".join(f"{count[kind]:>8}" for kind in kinds))
    total = functools.reduce(lambda a, b: a + b, (c for k, c in counts.items() if k != "honest"), collections.Counter())
    print(f"{'all mistakes':<16}" + "".join(f"{total[kind]:>8}" for kind in kinds))
    return {mistake: dict(count) for mistake, count in counts.items()}


if __name__ == "__main__":
    main()
