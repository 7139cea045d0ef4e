"""Contacts: errors of motions, of their first and second derivatives, impacts and seconds, against closed forms.

    python -m benchmarks.contacts                       # all parts, benchmarks/results/contacts.json
    python -m benchmarks.contacts puck --only rows      # of one part what begins so
    python -m benchmarks.contacts --first --write       # first results in fresh processes; a scene by its beginning
    python -m benchmarks.contacts --peers peers.json    # stores what `python benchmarks/_contact_peers.py` printed

*First* is a motion as a user waits for it, with its compilation; *again* the same once more. Errors of derivatives are
in parts of the largest. *Rows* are motions in closed form, *many* random ones of one scene, *sizes* long motions, large
batches and many contacts, *problems* worked ones, *coverage* intervals of fits, *by_hand* the same scenes as modes and
guards. Their docstrings say what they are measured against. *First* alone (`_contact_first`) counts CPU seconds, not
those of a clock on the wall.
"""

import argparse
import functools
import gc
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report
from benchmarks._contact_by_hand import PAIRS, lines
from benchmarks._contact_first import first
from benchmarks._contact_problems import PROBLEMS
from benchmarks._contacts import (
    BRAX,
    BRAX_RADIUS,
    BRAX_SPEED,
    FALL,
    MANY,
    ROWS,
    G,
    end_of,
    rest_time,
    swinging,
    system_of,
)
from benchmarks._measure import seconds

STORE = Path(__file__).parent / "results" / "contacts.json"


def _timed(run: Callable) -> tuple[float, float, Any]:
    """Seconds of the first and of a later call, and the value."""

    def ready():
        return jax.block_until_ready(run())

    gc.collect()
    gc.freeze()  # a first result is not to wait for a search through what the scenes before it left
    (first, _), (again, value) = seconds(ready), min((seconds(ready) for _ in range(3)), key=lambda x: x[0])
    return first, again, value


def _off(found, right) -> float:
    """The largest difference, in parts of the largest number above 1; infinite where one is NaN."""
    found, right = np.asarray(found), np.asarray(right)
    error = np.abs(found - right).max(initial=0.0) / max(1.0, np.abs(right).max(initial=0.0))
    return float(np.nan_to_num(error, nan=np.inf))


def rows(begins: str) -> Iterator[dict[str, Any]]:
    """Every row: its motion, its gradient in forward and reverse mode, its Hessian."""
    for row in ROWS.values():
        if row.name.startswith(begins):
            yield {"scene": row.name} | _attempt(lambda row=row: _row(row))


def _row(row) -> dict[str, Any]:
    system, x, columns = system_of(row.scene), jnp.asarray(row.x), jnp.array(row.columns, int)
    ts = jnp.array([0.0, row.duration])

    def run():
        return lagjax.simulate(system, x[: row.n], x[row.n : 2 * row.n], ts, x[2 * row.n :])

    first, again, motion = _timed(run)
    end = end_of(system, row.n, row.duration)

    def measured(y):
        return row.measure(end(x.at[columns].set(y)))

    def exact(y):
        return jnp.asarray(row.exact(x.at[columns].set(y)))

    line = {
        "value": float(np.abs(measured(x[columns]) - exact(x[columns])).max()), "slopes": None, "reverse": None,
        "second": None, "impacts": int(motion.impacts.count), "first s": first, "again s": again,
    }  # fmt: skip
    if row.columns:
        slopes = jax.jacfwd(exact)(x[columns])
        line["slopes"] = _off(jax.jit(jax.jacfwd(measured))(x[columns]), slopes)
        line["reverse"] = _off(jax.jit(jax.jacrev(measured))(x[columns]), slopes)
    if row.columns and row.second:
        second = jax.jacfwd(jax.jacfwd(measured)) if row.only_forward else jax.hessian(measured)
        line["second"] = _off(jax.jit(second)(x[columns]), jax.hessian(exact)(x[columns]))
    return line


def many(begins: str) -> Iterator[dict[str, Any]]:
    """Random motions of one scene, in one batch."""
    for case in MANY.values():
        if case.name.startswith(begins):
            yield {"scene": case.name, "members": case.count} | _attempt(lambda case=case: _many(case))


def _many(case) -> dict[str, Any]:
    q, v, p, right = case.drawn()
    system, ts = system_of(case.scene), np.array([0.0, case.duration])
    first, again, batch = _timed(lambda: lagjax.simulate_batch(system, q, v, ts, p, batch_axes=(0, 0, 0)))
    errors = np.nan_to_num(np.abs(batch.qdot[:, -1] - right).max(axis=1), nan=np.inf)
    named = ~np.asarray(batch.ok)
    return {
        "worst": float(errors[~named].max(initial=0.0)), "named": int(named.sum()),
        "wrong": int((errors[~named] > 1e-9).sum()), "first s": first, "again s": again,
    }  # fmt: skip


# ---- sizes -----------------------------------------------------------------------------------------------------------


def time_of_rest() -> dict[str, Any]:
    """A ball of e = 0.5 … 0.95, 64 of them: the time of rest and its gradient and Hessian."""
    system = system_of(FALL)

    def last(x):
        impacts = lagjax.simulate(system, x[:1], x[1:2], jnp.array([0.0, 50.0]), x[2:]).impacts
        return impacts.t[impacts.count - 1]

    x = jnp.stack([jnp.array([1.0, 0.1, G, e]) for e in np.linspace(0.5, 0.95, 64)])
    right = jax.vmap(rest_time)(x), jax.vmap(jax.grad(rest_time))(x), jax.vmap(jax.hessian(rest_time))(x)
    first, again, value = _timed(lambda: jax.vmap(last)(x))
    return {
        "value": _off(value, right[0]), "slopes": _off(jax.jit(jax.vmap(jax.grad(last)))(x), right[1]),
        "second": _off(jax.jit(jax.vmap(jax.hessian(last)))(x), right[2]), "first s": first, "again s": again,
    }  # fmt: skip


def brax_drop() -> dict[str, Any]:
    """Brax 317: 10⁴ heights of a ball that comes down without gravity, and the slopes of all ends."""
    system, h, ts = system_of(BRAX), jnp.linspace(2.9, 3.0, 10_000)[:, None], jnp.array([0.0, 1.0])
    v = jnp.full_like(h, -BRAX_SPEED)
    first, again, batch = _timed(lambda: lagjax.simulate_batch(system, h, v, ts, jnp.zeros(0)))

    def ends(h):
        return lagjax.simulate_batch(system, h, v, ts, jnp.zeros(0)).q[:, -1].sum()

    slopes = jax.jit(jax.grad(ends))(h)
    right = 2 * BRAX_RADIUS + BRAX_SPEED - h
    return {"value": _off(batch.q[:, -1], right), "slopes": _off(slopes, -1.0), "first s": first, "again s": again}


def cradle() -> dict[str, Any]:
    """Newton's cradle of five touching balls on strings, e = 1: 1000 impacts one after the other; energy too."""
    row = swinging(125)
    system, x, ts = system_of(row.scene), row.x, jnp.array([0.0, row.duration])

    def run():
        return lagjax.simulate(system, x[:5], x[5:10], ts, x[10:], max_transitions=1100)

    first, again, motion = _timed(run)
    end = np.concatenate([motion.q[-1], motion.qdot[-1]])

    def energy(z):
        return 0.5 * (z[5:] @ z[5:] + x[10] * z[:5] @ z[:5])

    return {
        "value": _off(end, row.exact(x)), "energy": float(abs(energy(end) / energy(x[:10]) - 1)),
        "impacts": int(motion.impacts.count), "first s": first, "again s": again,
    }  # fmt: skip


def twelve_contacts() -> dict[str, Any]:
    """Thirteen balls of radius 0.1 on a line, with 12 gaps, e = 0.9; momentum is what is known."""
    system = lagjax.System(
        lambda q, v: 0.5 * v @ v, contacts=lambda q: q[1:] - q[:-1] - 0.2, restitution=0.9
    )  # fmt: skip
    q, v = np.arange(13.0), np.random.default_rng(0).normal(size=13)
    first, again, motion = _timed(lambda: lagjax.simulate(system, q, v, jnp.array([0.0, 5.0])))
    lost = np.nansum(motion.impacts.energy_lost)
    return {
        "value": float(abs(motion.qdot[-1].sum() - v.sum())),
        "energy": float(abs(0.5 * v @ v - 0.5 * motion.qdot[-1] @ motion.qdot[-1] - lost)),
        "impacts": int(motion.impacts.count), "first s": first, "again s": again,
    }  # fmt: skip


def _arms(floor: float | None) -> lagjax.System:
    def lagrangian(q, v):
        both = 2 * v[0] ** 2 + v[1] ** 2 + 2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
        return 0.5 * both + G * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    if floor is None:
        return lagjax.System(lagrangian)
    return lagjax.System(
        lagrangian, contacts=lambda q: {"floor": floor - jnp.cos(q[0]) - jnp.cos(q[1])}, restitution=0.7, friction=0.3,
        slip=lambda q, v: {"floor": v[0] * jnp.cos(q[0]) + v[1] * jnp.cos(q[1])},
    )  # fmt: skip


def batches() -> Iterator[tuple[str, dict[str, Any]]]:
    """4096 double pendulums without a floor, over one that is too low, and over one that they hit."""
    rng, ts = np.random.default_rng(0), jnp.array([0.0, 2.0])
    q, v = rng.uniform(0.5, 1.2, (4096, 2)), np.zeros((4096, 2))
    for name, floor in (("no floor", None), ("a floor too low", 2.1), ("a floor", 1.95)):
        yield f"4096 double pendulums, {name}", _attempt(lambda floor=floor: _batch(_arms(floor), q, v, ts))


def _batch(system, q, v, ts) -> dict[str, Any]:
    first, again, batch = _timed(lambda: lagjax.simulate_batch(system, q, v, ts))
    steps = int(np.sum(batch.stats["num_steps"]))
    return {
        "ok": int(batch.ok.sum()), "steps": steps, "µs a step": 1e6 * again / steps,
        "impacts": int(batch.impacts.count.sum()) if system.contacts is not None else 0, "first s": first,
        "again s": again,
    }  # fmt: skip


def sizes(begins: str) -> Iterator[dict[str, Any]]:
    """Long motions, large batches, many contacts."""
    alone = {
        "time of rest, 64 restitutions": time_of_rest, "brax 317, 10000 members": brax_drop,
        "cradle, 1000 impacts": cradle, "twelve contacts": twelve_contacts,
    }  # fmt: skip
    for name, call in alone.items():
        if name.startswith(begins):
            yield {"scene": name} | _attempt(call)
    if begins in ("", "4096"):
        for name, line in batches():
            yield {"scene": name} | line


TOSS = lagjax.System(
    lambda q, v: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"], contacts=lambda q: {"floor": q["y"]},
    restitution=lambda params: params["e"], friction=lambda params: params["mu"], slip=lambda q, v: {"floor": v["x"]},
)  # fmt: skip


def coverage(begins: str, count: int = 400) -> Iterator[dict[str, Any]]:
    """How often 95 % intervals of e and μ hold them: fits of four noisy tosses along a rough floor.

    The truth and the tosses are the same in all of them, or drawn anew for each.
    """
    for name, draws in (("noisy tosses", False), ("random noisy tosses", True)):
        if name.startswith(begins):
            yield {"scene": name} | _attempt(lambda draws=draws: fit_tosses(count, draws))


def fit_tosses(count: int, draws: bool) -> dict[str, Any]:
    rng, ts, begun = np.random.default_rng(0), np.linspace(0.0, 1.2, 61), time.process_time()
    truth, heights, speeds = {"e": 0.7, "mu": 0.25}, np.linspace(0.4, 1.2, 4), np.full(4, 3.0)
    held, off, sound = dict.fromkeys(truth, 0), dict.fromkeys(truth, 0.0), 0
    for _ in range(count):
        if draws:
            truth = {"e": rng.uniform(0.3, 0.9), "mu": rng.uniform(0.05, 0.4)}
            heights, speeds = rng.uniform(0.4, 1.2, 4), rng.uniform(1.0, 4.0, 4)
        zero = np.zeros(())
        starts = [({"x": zero, "y": h}, {"x": v, "y": zero}) for h, v in zip(heights, speeds, strict=True)]
        records = []
        for start in starts:
            motion = lagjax.simulate(TOSS, *start, ts, truth)
            seen = {name: x + 1e-3 * rng.normal(size=x.size) for name, x in motion.q.items()}
            records.append(lagjax.Record(ts, seen, start=start))
        found = lagjax.fit(TOSS, records, {"e": 0.6, "mu": 0.2})
        low, high = found.intervals(0.95)
        if not found.ok:  # a toss that stops at once says of μ only that it is larger: the fit tells
            continue
        sound += 1
        for name, value in truth.items():
            held[name] += int(low[name] <= value <= high[name])
            off[name] += (found.params[name] - value) / (high[name] - low[name]) * 2 * 1.96
    shares = {f"held {name}": held[name] / sound for name in truth}
    # The mean distance from the truth, in parts of its own standard error: a bias is beyond 3.
    biases = {f"bias {name}": float(off[name]) / sound**0.5 for name in truth}
    return {"fits": count, "not ok": count - sound} | shares | biases | {"all CPU s": time.process_time() - begun}


def by_hand(begins: str) -> Iterator[dict[str, Any]]:
    """The same scenes as modes and guards, and as contacts."""
    for name, pair in PAIRS.items():
        if name.startswith(begins):
            yield {"scene": name} | _attempt(lambda pair=pair: _pair(*pair))


def _pair(old: Callable, new: Callable) -> dict[str, Any]:
    (first_old, again_old, right), (first, again, found) = _timed(old), _timed(new)
    return {
        "lines by hand": lines(old), "lines": lines(new), "differ": _off(found, right), "first by hand s": first_old,
        "first s": first, "again by hand s": again_old, "again s": again,
    }  # fmt: skip


def _attempt(call: Callable) -> dict[str, Any]:
    """The row, or its error in a line: one that fails does not hide the others."""
    start = time.perf_counter()
    try:
        return call()
    except Exception as error:
        text = next(iter(str(error).strip().splitlines()), "")
        return {"failed": f"{type(error).__name__}: {text[:160]}", "first s": time.perf_counter() - start}


def problems(begins: str) -> Iterator[dict[str, Any]]:
    """Worked problems: their figures, and the seconds of all of it."""
    for problem in PROBLEMS.values():
        if problem.name.startswith(begins):
            spent, figures = seconds(lambda problem=problem: _attempt(problem.solve))
            yield {"scene": problem.name} | figures | {"all s": spent}


PARTS = {"rows": rows, "many": many, "sizes": sizes, "problems": problems, "coverage": coverage, "by_hand": by_hand}


def main() -> None:
    """Print the rows and store them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("begins", nargs="?", default="", help="scenes whose names begin so")
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    parser.add_argument("--peers", type=Path, help="what `_contact_peers.py` printed; nothing else is run")
    parser.add_argument("--first", action="store_true", help="first results, each in a fresh process; nothing else")
    parser.add_argument("--count", type=int, default=3, help="processes for a first result: the least counts")
    parser.add_argument("--write", action="store_true", help="store the first results; other parts are always stored")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.jit(lambda x: x @ x)(jnp.ones(3)))  # XLA is there
    record = _report.read_json(STORE)
    if options.peers:
        _report.write_json(STORE, record | {"peers": json.loads(options.peers.read_text())})
        return
    parts = PARTS
    if options.first:
        parts = {"first": functools.partial(first, count=options.count)}
    for part in parts if options.first else options.only:
        found = []
        for line in parts[part](options.begins):
            found.append(line)
            print(
                json.dumps({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in line.items()}), flush=True
            )
        if not found:
            print(f"{part}: no scene begins with {options.begins!r}", file=sys.stderr)
            continue
        names = [line["scene"] for line in found]
        others = [line for line in record.get(part, {}).get("rows", []) if line["scene"] not in names]
        record[part] = {"circumstances": _report.circumstances(), "rows": [*others, *found]}
        if options.write or not options.first:
            _report.write_json(STORE, record)
        print(_report.table(record[part]["rows"]), file=sys.stderr)


if __name__ == "__main__":
    main()
