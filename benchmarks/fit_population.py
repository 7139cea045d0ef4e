"""Random fits with one seeded mistake each: is any answer wrong without a word?

    python -m benchmarks.fit_population --fits 97 --sensors 60 --honest 30
    python -m benchmarks.fit_population --fits 0 --sensors 60 --honest 10 --float32
    python -m benchmarks.fit_population --fits 0 --honest 0 --kinds 16 --guesses 12

A pendulum with friction, a double pendulum, a cart with a pole, Duffing's oscillator and two masses on springs, three
records each, and one mistake in the data: angles modulo 2π, degrees, milliseconds, swapped signals, a constant signal,
a wrong sign, shifted times, one record mirrored, one record of another machine. `--sensors` draws what sensors do:
samples missing and written as 0.0, −9999 or 1e6, values rounded, rounded to 24 lines of a turn, or cut off at limits;
`--float32` hands records over in float32 without JAX's switch. `--kinds` draws this number of fits in each of seven
kinds of scene: hybrid motion, contact, stick and slip, numbers of every record, sampled inputs, correlated noise,
and candidate terms; half of them have a mistake. `--guesses` fits one record each of a rocking block, a block that
sticks and slips, a ball that bounces, and a puck between cushions from this number of guesses, each number up to three
times too large or small; what an impact leaves of a speed, below 1. An answer is

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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import coverage

G, RECORDS, MILLI = 9.81, 3, 1000.0
SIGMA = 3e-3  # noise, in rad or m: a fraction of a percent of the signals


class Case(NamedTuple):
    """A scene with the truth, the times, which coordinates are angles, which parameters a unit of time changes."""

    system: Any  # a System or a Hybrid
    truth: dict[str, float]
    ts: np.ndarray
    angles: tuple[int, ...]
    size: int
    by_time: dict[str, float] | None  # powers of time in the units of parameters; None where a clock drives the scene
    draw: Callable[..., Any] | None = None  # (rng, truth) to records and to the truth of what `more` begins
    more: Mapping[str, Any] = MappingProxyType({})  # where numbers begin that are not in `truth`
    options: Mapping[str, Any] = MappingProxyType({})  # of `fit`


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
    if case.draw is not None:
        return spoil_kind(case, case.draw, mistake, rng)
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


def spoil_kind(case: Case, draw: Callable[..., Any], mistake: str | None, rng) -> Spoiled:
    """Records of one of the `KINDS`, with one of the mistakes that each of them can have."""
    records, more = draw(rng, case.truth)
    which = int(rng.integers(len(records)))
    spoiled, words = records[which], re.escape(f"records[{which}]")
    if mistake == "shifted":
        late = int(rng.integers(15, 30))
        inputs = None if spoiled.inputs is None else spoiled.inputs[:-late]
        values = jax.tree.map(lambda x: x[late:], spoiled.values)
        spoiled = replace(spoiled, ts=spoiled.ts[:-late], values=values, inputs=inputs)
        words = rf"{words}|late|early|shift"
    elif mistake == "mirrored":
        spoiled = replace(spoiled, values=jax.tree.map(np.negative, spoiled.values))
        if "offset" in more:  # no mistake: the mirrored motion is one, too, and the sensor's offset has the other sign
            more["offset"][which] *= -1
    elif mistake == "another machine":
        name = rng.choice(list(case.truth))
        others, _ = draw(rng, {**case.truth, name: case.truth[name] * rng.choice([0.7, 1.4])})
        spoiled = others[which]
    records = [spoiled if k == which else record for k, record in enumerate(records)]
    return Spoiled(records, words if mistake else "", case.truth | more)


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
    return judge_from(case, spoiled, begin)


def judge_from(case: Case, spoiled: Spoiled, begin: dict[str, float]) -> tuple[str, str]:
    """What became of the fit that begins there, and what it says."""
    transforms = dict.fromkeys(begin, lagjax.positive) | dict.fromkeys(case.more)
    try:
        fit = lagjax.fit(case.system, spoiled.records, begin | dict(case.more), transforms=transforms, **case.options)
    except (ValueError, lagjax.SimulationError) as reason:
        return ("named" if spoiled.words and re.search(spoiled.words, str(reason)) else "told"), f"refused: {reason}"
    except Exception as reason:
        return "crash", f"{type(reason).__name__}: {reason}"
    numbers = jax.tree.map(lambda x: np.round(x, 5).tolist(), dict(fit.params))
    text = f"{numbers} {' '.join(fit.unseen)} {fit.message}"
    if not fit.ok:
        return ("named" if spoiled.words and re.search(spoiled.words, text) else "told"), text
    return "right" if holds(fit, spoiled.truth, 0.9999, 0.01) else "wrong", text


def holds(fit: lagjax.Fit, truth: dict[str, Any], level: float, relative: float = 0.0) -> bool:
    """Every number of the truth lies in its interval, or as near as `relative` says."""
    sides = [jax.tree.leaves({k: each[k] for k in truth}) for each in (*fit.intervals(level), fit.params, truth)]
    return all(
        np.all(((low <= x) & (x <= high)) | (np.abs(fitted - x) < relative * np.abs(x)))
        for low, high, fitted, x in zip(*map(lambda side: map(np.asarray, side), sides), strict=True)
    )


# ---- kinds of scene --------------------------------------------------------------------------------------------------

SLOW = 0.01  # what is slower at an impact rests from then on
STILL = lagjax.System(lambda q, v: 0.5 * v**2)


def meet(one: str, other: str, kept: str, side: int) -> list[lagjax.Transition]:
    """The end of a mode where q falls (side 1), or rises (−1), to 0: rest where it is slow, else the number `kept`."""
    return [
        lagjax.Transition(
            one, "rest", lambda q, v: jnp.where(side * v > -SLOW, q, float(side)), -side, lambda q, v: (0 * q, 0 * v)
        ),
        lagjax.Transition(
            one, other, lambda q, v: q, -side, lambda q, v, params: (q, (1 if one != other else -1) * params[kept] * v)
        ),
    ]


BALL = lagjax.Hybrid(
    {"flight": lagjax.System(lambda q, v, params: 0.5 * v**2 - params["g"] * q), "rest": STILL},
    meet("flight", "flight", "e", 1), "flight", max_transitions=64,
)  # fmt: skip
# Housner's block stands on one of two edges; p² = 3 g/(4 R), and r of its speed is left after an impact.
ROCKING = lagjax.Hybrid(
    {
        "right": lagjax.System(lambda q, v, params: 0.5 * v**2 - params["p2"] * jnp.cos(params["tilt"] - q)),
        "left": lagjax.System(lambda q, v, params: 0.5 * v**2 - params["p2"] * jnp.cos(params["tilt"] + q)),
        "rest": STILL,
    },
    meet("right", "left", "r", 1) + meet("left", "right", "r", -1), "right", max_transitions=128,
)  # fmt: skip
PUCK = lagjax.System(
    lambda q, v: 0.5 * v**2, dissipation=lambda q, v, params: 0.5 * params["drag"] * v**2,
    contacts=lambda q, params: {"left": q, "right": params["width"] - q}, restitution=lambda params: params["e"],
)  # fmt: skip
OSCILLATOR = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2,
    dissipation=lambda q, v, params: 0.5 * params["c"] * v**2,
)
DRAG = lagjax.terms({
    "coulomb": lambda v: -jnp.tanh(v / 1e-2), "viscous": lambda v: -v, "quadratic": lambda v: -v * jnp.abs(v),
})  # fmt: skip
DRAGGED = lagjax.System(
    lambda q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2,
    forces=lambda q, v, params: DRAG(v, params=params["friction"]),
)


def recorded(scene, start, ts, params, rng, sigma: float, known: bool = True, **kept) -> lagjax.Record:
    """One noisy record of a motion from this start, which the record tells where it is known."""
    exact = coverage.exact_values(
        scene, lagjax.Record(ts, jax.tree.map(lambda x: 0 * ts, start[0]), start=start, **kept), params
    )
    values = jax.tree.map(lambda x: coverage.add_noise(rng, np.asarray(x), sigma), exact)
    return lagjax.Record(ts, values, start=start if known else None, **kept)


def draw_balls(rng, truth):
    """Three falls onto a floor."""
    ts = np.linspace(0.0, 1.5, 76)
    return [recorded(BALL, (rng.uniform(0.5, 1.2), 0.0), ts, truth, rng, 2e-3) for _ in range(3)], {}


def draw_tosses(rng, truth):
    """Three tosses along a rough floor."""
    ts = np.linspace(0.0, 1.2, 61)
    starts = [({"x": 0.0, "y": rng.uniform(0.4, 1.2)}, {"x": rng.uniform(2.5, 4.0), "y": 0.0}) for _ in range(3)]
    return [recorded(coverage.TOSS, start, ts, truth, rng, 1e-3) for start in starts], {}


def draw_blocks(rng, truth):
    """Two records of a block on a belt."""
    ts = np.linspace(0.0, 8.0, 161)
    starts = [(rng.uniform(-0.4, -0.18), 0.0) for _ in range(2)]
    return [recorded(coverage.BLOCK, start, ts, truth, rng, 2e-3) for start in starts], {}


def draw_offsets(rng, truth):
    """Four records of an oscillator, each with an offset of its sensor."""
    ts, offsets, records = np.linspace(0.0, 8.0, 161), rng.normal(size=4) * 0.2, []
    for offset in offsets:
        record = recorded(OSCILLATOR, (rng.uniform(0.5, 1.2), rng.normal()), ts, truth, rng, SIGMA, False)
        records.append(replace(record, values=record.values + offset))
    return records, {"offset": offsets}


def draw_driven(rng, truth):
    """Two records of Duffing's oscillator, driven by random steps of 0.5 s."""
    ts = np.linspace(0.0, 15.0, 301)
    drives = [np.repeat(rng.normal(size=31), 10)[:301] for _ in range(2)]
    return [recorded(coverage.DUFFING, (0.0, 0.0), ts, truth, rng, 0.01, inputs=drive) for drive in drives], {}


def draw_correlated(rng, truth):
    """Two swings, with noise that forgets itself over ten samples."""
    ts, records = np.linspace(0.0, 12.0, 601), []
    for _ in range(2):
        motion = lagjax.simulate(coverage.PENDULUM, rng.uniform(0.8, 1.4), rng.normal(), ts, truth)
        records.append(lagjax.Record(ts, coverage.add_noise(rng, np.asarray(motion.q), 0.01, 0.9)))
    return records, {}


def draw_terms(rng, truth):
    """Three records of an oscillator with one or two of three candidate terms of friction."""
    kept = rng.choice(["coulomb", "viscous", "quadratic"], int(rng.integers(1, 3)), replace=False)
    friction = (
        DRAG.params0 | {str(name): 0.0 for name in DRAG.params0} | {str(name): rng.uniform(0.05, 0.15) for name in kept}
    )
    ts, params = np.linspace(0.0, 12.0, 241), truth | {"friction": friction}
    starts = [(rng.uniform(0.8, 2.0), 0.0) for _ in range(3)]
    return [recorded(DRAGGED, start, ts, params, rng, 1e-3, False) for start in starts], {"friction": friction}


def add_offset(q, v, params):
    return q + params["offset"]


NO_TIMES = np.zeros(0)
KINDS = {
    "hybrid": Case(BALL, {"g": G, "e": 0.8}, NO_TIMES, (), 1, None, draw_balls),
    "contact": Case(coverage.TOSS, {"e": 0.6, "mu": 0.15}, NO_TIMES, (), 2, None, draw_tosses),
    "stick and slip": Case(coverage.BLOCK, coverage.FRICTION, NO_TIMES, (), 1, None, draw_blocks),
    "per record": Case(
        OSCILLATOR, {"k": 4.0, "c": 0.2}, NO_TIMES, (), 1, None, draw_offsets, {"offset": 0.0},
        {"free": {"k": True, "c": True, "offset": lagjax.per_record}, "observe": add_offset},
    ),
    "sampled inputs": Case(coverage.DUFFING, coverage.SPRING, NO_TIMES, (), 1, None, draw_driven),
    "correlated noise": Case(coverage.PENDULUM, coverage.SWING, NO_TIMES, (0,), 1, None, draw_correlated),
    "terms": Case(DRAGGED, {"k": 4.0}, NO_TIMES, (), 1, None, draw_terms, {"friction": DRAG.params0}),
}  # fmt: skip


# What is left of a speed, and an angle that the motion knows up to whole turns.
BOUNDS = {"e": lagjax.between(0.0, 1.0), "r": lagjax.between(0.0, 1.0), "tilt": lagjax.between(0.0, 0.5 * np.pi)}


class Guessed(NamedTuple):
    """A scene, the truth, and where its one record begins, lasts and how noisy it is."""

    scene: Any
    truth: dict[str, float]
    start: tuple[float, float]
    end: float
    sigma: float


GUESSED = {
    "rocking block": Guessed(ROCKING, {"p2": 12.0, "tilt": 0.32, "r": 0.9}, (0.2, 0.0), 4.0, 2e-3),
    "stick and slip": Guessed(coverage.BLOCK, coverage.FRICTION, (-0.2, 0.0), 8.0, 2e-3),
    "bouncing ball": Guessed(BALL, {"g": G, "e": 0.8}, (1.0, 0.0), 2.5, 2e-3),
    "puck between cushions": Guessed(PUCK, {"width": 1.5, "e": 0.7, "drag": 0.1}, (0.3, 2.0), 5.0, 2e-3),
}


def print_guesses(count: int, names: Iterable[str]) -> None:
    """One line for each scene: how many of the fits from these guesses are right, not ok, and wrong and ok.

    "in 95 %" counts where all numbers lie in their intervals at once: each interval is of 1 − 0.05/(their number).
    """
    head = ("in 95 %", "right", "not ok", "wrong", "CPU s")
    print(f"\n{f'one record, {count} guesses':<26}" + "".join(f"{word:>8}" for word in head))
    for name in names:
        scene, truth, start, end, sigma = GUESSED[name]
        rng, begun = np.random.default_rng(0), time.process_time()
        record = recorded(scene, start, np.linspace(0.0, end, 161), truth, rng, sigma)
        became, held = collections.Counter(), 0
        for k in range(count):
            begin = {key: x * 3 ** rng.uniform(-1, 1) for key, x in truth.items()}
            begin |= {key: min(begin[key], 0.95) for key in ("e", "r") if key in begin}
            try:
                transforms = {key: BOUNDS.get(key, lagjax.positive) for key in begin}
                fit = lagjax.fit(scene, record, begin, transforms=transforms)
            except (ValueError, lagjax.SimulationError) as reason:
                became["not ok"] += 1
                print(f"    {name} {k} from {begin}: refused: {reason}", flush=True)
                continue
            verdict = "not ok" if not fit.ok else "right" if holds(fit, truth, 0.9999) else "wrong"
            became[verdict] += 1
            held += verdict == "right" and holds(fit, truth, 1 - 0.05 / len(truth))
            if verdict != "right":
                print(f"    {name} {k} from {begin}: {verdict}: {fit.params} {fit.message}", flush=True)
        used = time.process_time() - begun
        columns = [held, *(became[verdict] for verdict in ("right", "not ok", "wrong"))]
        print(f"{name:<26}" + "".join(f"{x:>8}" for x in columns) + f"{used:>8.1f}", flush=True)


def schedule(fits: int, honest: int, sensors: int = 0, kinds: int = 0) -> list[tuple[int, str, str | None]]:
    """(seed, scene, mistake): every mistake in every scene that can have it, in turn, then honest fits, then kinds."""
    rows: list[tuple[int, str, str | None]] = []
    for first, count, mistakes in ((0, fits, MISTAKES), (5_000, sensors, SENSORS)):
        pairs = [(scene, mistake) for mistake, can in mistakes.items() for scene, case in CASES.items() if can(case)]
        order = np.random.default_rng(0).permutation(len(pairs))
        rows += [(first + seed, *pairs[order[seed % len(pairs)]]) for seed in range(count)]
    rows += [(10_000 + seed, list(CASES)[seed % len(CASES)], None) for seed in range(honest)]
    turn = (None, "shifted", None, "mirrored", None, "another machine")
    return rows + [(20_000 + seed, kind, turn[seed % len(turn)]) for kind in KINDS for seed in range(kinds)]


def main(argv=None) -> dict[str, Any]:
    """Run the population, print what is wrong, told or an alarm, and return the counts by mistake."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=100, help="fits with a mistake")
    parser.add_argument("--sensors", type=int, default=0, help="fits with what sensors do to numbers")
    parser.add_argument("--float32", action="store_true", help="records in float32, without JAX's switch")
    parser.add_argument("--honest", type=int, default=30, help="fits without one")
    parser.add_argument("--kinds", type=int, default=0, help="fits in each kind of scene, every other with a mistake")
    parser.add_argument("--guesses", type=int, default=0, help="guesses from which one record of each scene is fitted")
    parser.add_argument(
        "--scenes", nargs="+", choices=tuple(GUESSED), default=tuple(GUESSED), help="those of --guesses"
    )
    parser.add_argument("--only", type=int, nargs="*", help="seeds to run alone, with all that they say")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", not options.float32)
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for seed, scene, mistake in schedule(options.fits, options.honest, options.sensors, options.kinds):
        if options.only and seed not in options.only:
            continue
        case, rng, used = (CASES | KINDS)[scene], np.random.default_rng(seed), time.process_time()
        became, text = judge(case, spoil(case, mistake, rng), rng)
        used = time.process_time() - used
        if mistake is None and became == "told":
            became = "alarm"
        counts[f"{scene}, {'mistake' if mistake else 'honest'}" if scene in KINDS else mistake or "honest"][became] += 1
        if options.only or became in ("wrong", "told", "alarm", "crash") or used > 20:
            print(f"{seed:>5} {scene}, {mistake}: {became}, {used:.1f} s. {text}", flush=True)
    kinds = ("right", "named", "told", "wrong", "alarm", "crash")
    print(f"\n{'':<26}" + "".join(f"{kind:>8}" for kind in kinds))
    for mistake, count in counts.items():
        print(f"{mistake:<26}" + "".join(f"{count[kind]:>8}" for kind in kinds))
    total = functools.reduce(
        lambda a, b: a + b, (c for k, c in counts.items() if "honest" not in k), collections.Counter()
    )
    print(f"{'all mistakes':<26}" + "".join(f"{total[kind]:>8}" for kind in kinds))
    if options.guesses:
        print_guesses(options.guesses, options.scenes)
    return {mistake: dict(count) for mistake, count in counts.items()}


if __name__ == "__main__":
    main()
