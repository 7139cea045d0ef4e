"""What a fit is worth: how often intervals hold the truth, from how far off it is found, and how long it takes.

    python -m benchmarks.fit --draws 100

- coverage: a double pendulum, angles at 1 kHz with noise of 5 mrad, parameters 30 % off; the share of 95 % intervals
  that hold the truth, for white noise, Student's t with three degrees of freedom, and an autoregression of φ = 0.9.
- far: a pendulum over 50 s, begun at frequencies from 0.1 to 100 rad/s; and a chaotic double pendulum over nearly six
  Lyapunov times, by whole records alone and by growing segments.
- exact: a cart with a pole from its own trajectory, the largest relative error of its parameters.
- time: the first fit of 5 parameters and 20 starts of 4 numbers to 20 s at 1 kHz, compilation included, and the next.

The record goes to `benchmarks/results/fit.json`, with commit, versions and machine.
"""

import argparse
import functools
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report

SIGMA, PHI = 5e-3, 0.9
TRUTH = {"m1": 1.0, "m2": 0.6, "l1": 0.3, "a1": 0.17, "a2": 0.12, "I1": 0.02, "I2": 0.008, "k1": 0.02, "k2": 0.005}
FREE = {name: name != "m1" for name in TRUTH}  # a free motion sees masses only as ratios


def double_pendulum(q, qdot, p):
    """Two arms with their centres of mass and inertias, angles from the vertical."""
    first = 0.5 * (p["I1"] + p["m1"] * p["a1"] ** 2 + p["m2"] * p["l1"] ** 2) * qdot[0] ** 2
    second = 0.5 * (p["I2"] + p["m2"] * p["a2"] ** 2) * qdot[1] ** 2
    both = p["m2"] * p["l1"] * p["a2"] * jnp.cos(q[0] - q[1]) * qdot[0] * qdot[1]
    weight = 9.81 * ((p["m1"] * p["a1"] + p["m2"] * p["l1"]) * jnp.cos(q[0]) + p["m2"] * p["a2"] * jnp.cos(q[1]))
    return first + second + both + weight


def friction(q, qdot, p):
    """Rayleigh's function of both bearings."""
    return 0.5 * p["k1"] * qdot[0] ** 2 + 0.5 * p["k2"] * (qdot[1] - qdot[0]) ** 2


SCENE = lagjax.System(
    lambda q, v, params: double_pendulum(q, v, params), dissipation=lambda q, v, params: friction(q, v, params)
)
KNOWN = {**FREE, "a1": False, "l1": False, "I2": False}  # lengths are measured with a ruler, the second arm is weighed


def swings(count: int, ts: np.ndarray, rng, law: str = "none") -> list[lagjax.Record]:
    """Records of free swings from random starts, with noise of one of the laws."""
    q0, qdot0 = rng.uniform(-1.5, 1.5, (count, 2)), rng.normal(size=(count, 2))
    exact = np.asarray(lagjax.simulate_batch(SCENE, q0, qdot0, ts, TRUTH).q)
    return [lagjax.Record(ts, q + SIGMA * noise(law, q.shape, rng)) for q in exact]


def noise(law: str, shape: tuple[int, int], rng) -> np.ndarray:
    """Noise (T, S) of size one."""
    if law == "none":
        return np.zeros(shape)
    white = rng.standard_t(3, size=shape) if law == "student" else rng.normal(size=shape)
    if law == "correlated":
        for i in range(1, shape[0]):
            white[i] = PHI * white[i - 1] + np.sqrt(1 - PHI**2) * white[i]
    return white


def coverage(draws: int, segments: int) -> list[dict[str, Any]]:
    """The share of intervals that hold the truth, by law of noise."""
    rows, ts = [], np.linspace(0.0, 1.0, 1001)
    for law in ("white", "student", "correlated"):
        hits, ok = [], []
        for draw in range(draws):
            rng = np.random.default_rng([draw, len(law)])
            begin = {k: x * (rng.choice([0.7, 1.3]) if KNOWN[k] else 1.0) for k, x in TRUTH.items()}
            how = lagjax.StudentT() if law == "student" else None
            records = swings(segments, ts, rng, law)
            fit = lagjax.fit(SCENE, records, begin, free=KNOWN, transforms=lagjax.positive, noise=how)
            low, high = fit.intervals()
            hits += [low[k] <= TRUTH[k] <= high[k] for k in TRUTH if KNOWN[k]]
            ok.append(fit.ok)
        rows.append({"noise": law, "draws": draws, "converged": float(np.mean(ok)), "coverage": float(np.mean(hits))})
    return rows


def far() -> list[dict[str, Any]]:
    """Fits from far off: how large the residuals are, in units of the noise."""
    rng, rows, ts = np.random.default_rng(0), [], np.linspace(0.0, 50.0, 2501)
    pendulum = lagjax.System(lambda q, v, params: 0.5 * v**2 + params["w"] ** 2 * jnp.cos(q))
    q = np.asarray(lagjax.simulate(pendulum, 1.2, 0.0, ts, {"w": 3.7}).q)
    record = lagjax.Record(ts, q + SIGMA * rng.normal(size=q.shape))
    for begin in np.geomspace(0.1, 100.0, 13):
        fit = lagjax.fit(pendulum, record, {"w": float(begin)}, transforms=lagjax.positive)
        rows.append({"case": f"pendulum from {begin:.3g} rad/s", "rms": fit.rms["q"] / SIGMA, "trials": fit.trials})
    ts, q0 = np.linspace(0.0, 4.0, 4001), np.array([2.6, 2.9])
    q = np.asarray(lagjax.simulate(SCENE, q0, np.zeros(2), ts, TRUTH).q)
    chaotic = lagjax.Record(ts, q + SIGMA * rng.normal(size=q.shape))
    begin = {k: x * (1.3 if KNOWN[k] else 1.0) for k, x in TRUTH.items()}
    for method in ("whole", "auto"):
        fit = lagjax.fit(SCENE, chaotic, begin, free=KNOWN, transforms=lagjax.positive, method=method)
        worst = max(fit.rms.values()) / SIGMA
        rows.append({"case": f"double pendulum over 4 s, {method}", "rms": worst, "trials": fit.trials})
    return rows


def exact() -> list[dict[str, Any]]:
    """A cart with a pole that a known force drives, from its own trajectory without noise."""

    def lagrangian(q, v, params):
        mc, mp, length = params["mc"], params["mp"], params["l"]
        kinetic = (
            0.5 * (mc + mp) * v[0] ** 2 + mp * length * v[0] * v[1] * jnp.cos(q[1]) + 0.5 * mp * (length * v[1]) ** 2
        )
        return kinetic + mp * 9.81 * length * jnp.cos(q[1])

    scene = lagjax.System(lagrangian, forces=lambda q, v, t: jnp.array([5.0 * jnp.sin(3.0 * t), 0.0]))
    truth, ts = {"mc": 10.0, "mp": 1.0, "l": 0.5}, np.linspace(0.0, 5.0, 501)
    q = np.asarray(lagjax.simulate(scene, np.array([0.0, 1.0]), np.zeros(2), ts, truth).q)
    record = lagjax.Record(ts, q)
    fit = lagjax.fit(scene, record, {"mc": 7.0, "mp": 1.3, "l": 0.65}, transforms=lagjax.positive)
    return [{"case": "cart and pole", "relative error": max(abs(fit.params[k] / truth[k] - 1) for k in truth)}]


def seconds() -> list[dict[str, Any]]:
    """Wall and processor time of the first fit and of the next."""
    records, rows = swings(20, np.linspace(0.0, 1.0, 1001), np.random.default_rng(1), "white"), []
    for which in ("first", "next"):
        begin = {k: x * (1.3 if KNOWN[k] else 1.0) for k, x in TRUTH.items()}
        wall, used = time.perf_counter(), time.process_time()
        fit = lagjax.fit(SCENE, records, begin, free=KNOWN, transforms=lagjax.positive)
        spent = time.perf_counter() - wall, time.process_time() - used
        rows.append({"fit": which, "wall s": spent[0], "processor s": spent[1], "trials": fit.trials, "ok": fit.ok})
    return rows


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100, help="fits for each law of noise")
    parser.add_argument("--segments", type=int, default=26, help="records of 1 s in one of them")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results", help="folder for fit.json")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    record = {"circumstances": _report.circumstances()}
    intervals = functools.partial(coverage, options.draws, options.segments)
    for name, part in (("time", seconds), ("exact", exact), ("far", far), ("coverage", intervals)):
        record[name] = part()
        print(f"{name}\n{_report.table(record[name])}\n")
        sys.stdout.flush()
    options.output.mkdir(parents=True, exist_ok=True)
    _report.write_json(options.output / "fit.json", record)
    return record


if __name__ == "__main__":
    main()
