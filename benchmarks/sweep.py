"""What a sweep costs beside the motions, and what it survives: 10⁷ double pendulums, kills, many workers.

    python -m benchmarks.sweep rate --members 1000000      # against bare batches; resident memory; hours for 10⁸
    python -m benchmarks.sweep map --side 2048             # the map of first flips, as a picture
    python -m benchmarks.sweep kills --count 100           # kill -9 at random moments: the bits of an undisturbed run
    python -m benchmarks.sweep workers                     # processes, dask, two parts: one SHA-256
    python -m benchmarks.sweep poison --members 1000000    # ten members that fail, and cost the others nothing
    python -m benchmarks.sweep plan                        # 10⁸ members described: seconds and memory

Members start from rest at all pairs of angles, run over T = 5 with a median error of 1e-8, and keep the last state and
the time of the first flip, over which their motion goes on. The record goes to `benchmarks/results/sweep.json`, with
commit, versions and machine.
"""

import argparse
import hashlib
import itertools
import json
import math
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lagjax
from benchmarks import _report
from benchmarks._figures import write_picture
from lagjax._sweep import Files, Progress, read_status, run_store
from lagjax._sweep._batch import run_batch
from lagjax._sweep._description import Description, Sections

SCENE = lagjax.scenes.double_pendulum()
DURATION, RTOL = 5.0, 5e-9  # of which the median error is 1e-8
BARE = 4096
GOLDEN = (5**0.5 - 1) / 2  # whose multiples are spread evenly between whole numbers
ROOT = Path(__file__).parent.parent


def both_below(q, qdot):
    """Positive from the start until an arm goes over the top."""
    return (jnp.pi**2 - q[0] ** 2) * (jnp.pi**2 - q[1] ** 2)


FLIPS = {"section": both_below, "direction": -1, "count": 1}


def keep(trajectory, crossings):
    return {"q": trajectory.end.q, "qdot": trajectory.end.qdot, "flip": crossings.t[0]}


def start(point):
    return jnp.stack([point["theta1"], point["theta2"]])


def grid(members: int) -> dict[str, np.ndarray]:
    """All pairs of angles, about so many."""
    side = math.isqrt(members)
    angles = -np.pi + 2 * np.pi * (np.arange(side) + 0.5) / side
    return {"theta1": angles, "theta2": angles}


RULE = dict(
    q0=start, qdot0=jnp.zeros(2), params=SCENE.params, keep=keep,
)  # fmt: skip


def run(path: Path, over: dict, unit: int | None = None, max_steps: int = 65_536, **more) -> lagjax.Sweep:
    """The sweep of this file."""
    store = lagjax.Store(path, unit=unit, max_steps=max_steps, crossings=FLIPS, rtol=RTOL)
    return lagjax.sweep(SCENE.system, over, jnp.array([0.0, DURATION]), store=store, **{**RULE, **more})


# ---- rate ------------------------------------------------------------------------------------------------------------


def rate(options: argparse.Namespace) -> dict[str, Any]:
    """Seconds and CPU seconds of a member, bare and in a sweep, taken in turns; the memory of the sweep.

    Bare are batches of 4096 with the same crossings, of which nothing is kept; `plain` ones have only their last state.
    """
    over, members = grid(options.members), math.isqrt(options.members) ** 2
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        place, memory = Path(folder) / "store", _Memory()
        _begin(place, over)
        store, parts = Files(place), {"bare": _bare(over), "plain": _bare(over, None)}
        units = math.ceil(_left(place) / options.rounds)
        spent = {"sweep": np.zeros(2), **{name: np.zeros(2) for name in parts}}
        show = Progress(store, store.spec(), options.progress)
        with memory:
            for turn in range(options.rounds):
                for name, part in sorted(parts.items(), reverse=bool(turn % 2)):
                    spent[name] += _spent(part, options.bare)
                spent["sweep"] += _spent(lambda count: run_store(store, show, count), units)
        told = read_status(store)
        size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
    counts: dict[str, int] = dict.fromkeys(parts, options.bare * options.rounds * BARE) | {"sweep": members}
    each: dict[str, np.ndarray] = {name: seconds / counts[name] for name, seconds in spent.items()}
    record: dict[str, Any] = {"members": members, "units": told.units, "done": told.done, "results": told.results}
    for k, clock in enumerate(("wall", "CPU")):
        record |= {f"{name} µs ({clock})": 1e6 * seconds[k] for name, seconds in each.items()}
        record |= {f"over {name} ({clock})": each["sweep"][k] / each[name][k] - 1 for name in parts}
    return record | {
        "resident MiB": memory.most, "resident MiB before": memory.before, "stored bytes": size,
        "hours for 1e8": 1e8 * each["sweep"][0] / 3600, "worst energy change": told.drift and told.drift[0],
    }  # fmt: skip


def _spent(part: Callable[[int], Any], count: int) -> np.ndarray:
    """Seconds and CPU seconds of a part of the work."""
    wall, cpu = time.perf_counter(), time.process_time()
    part(count)
    return np.array([time.perf_counter() - wall, time.process_time() - cpu])


def _bare(over: dict, flips: dict | None = FLIPS) -> Callable[[int], None]:
    """Runs batches of 4096 neighbours in the grid, from places all over it."""
    shape = tuple(map(len, over.values()))
    members, places = math.prod(shape), itertools.count()
    settings = dict(rtol=RTOL, atol=None, max_steps=65_536, event=None, solver=None)
    sections = None if flips is None else Sections.from_arguments(flips, keep, settings)
    ts = np.array([0.0, DURATION])
    description = Description(SCENE.system, ts, None, None, SCENE.params, keep, {}, settings, sections)

    def batches(count: int) -> None:
        for _ in range(count):
            first = int(members * (next(places) * GOLDEN % 1.0))
            which = np.unravel_index((first + np.arange(BARE)) % members, shape)
            q0 = np.stack([angles[i] for angles, i in zip(over.values(), which, strict=True)], axis=1)
            values = {"q0": q0, "qdot0": np.zeros_like(q0), "params": SCENE.params}
            one, _ = run_batch(description, values, jnp.asarray(ts), (0, 0, None))
            jax.block_until_ready(one.q)

    batches(1)
    return batches


class _Memory:
    """The largest resident memory of this process within a `with`, in MiB."""

    def __enter__(self):
        self.before = self.most = self._now()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.05):
            self.most = max(self.most, self._now())

    @staticmethod
    def _now() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


# ---- the map ---------------------------------------------------------------------------------------------------------


def flip_map(options: argparse.Namespace) -> dict[str, Any]:
    """The map of first flips, of which at most 720² members are drawn, a pixel each."""
    import matplotlib
    from PIL import Image

    store = Path(options.folder or tempfile.mkdtemp()) / f"flips_{options.side}.zarr"
    wall = time.perf_counter()
    swept = run(store, grid(options.side**2), progress=options.progress)
    wall = time.perf_counter() - wall
    picture = options.output / "flip_map.png"
    flip, stride = swept.open().flip.values, -(-options.side // 720)
    colors = matplotlib.colormaps["magma_r"](matplotlib.colors.LogNorm(0.5, DURATION, clip=True)(flip))
    colors[np.isnan(flip)] = (1.0, 1.0, 1.0, 1.0)
    pixels = (255 * colors[::-stride, ::stride, :3]).round().astype(np.uint8)
    write_picture(Image.fromarray(pixels), picture)
    print(swept, picture, sep="\n")
    return {"side": options.side, "seconds": wall, "flipped": float(np.isfinite(flip).mean())}


# ---- what it survives ------------------------------------------------------------------------------------------------


def digest(store: Path) -> str:
    """One SHA-256 of all chunks of a store."""
    total = hashlib.sha256()
    for file in sorted(file for file in store.glob("*/c/**/*") if file.is_file()):
        total.update(str(file.relative_to(store)).encode() + file.read_bytes())
    return total.hexdigest()


def kills(options: argparse.Namespace) -> dict[str, Any]:
    """`kill -9` at random moments of workers in another process, until the store is done; and the bits."""
    over, unit, rng = grid(options.members), max(1, options.members // 40), np.random.default_rng(options.seed)
    killed, lost = 0, 0
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        expected = digest(run(Path(folder) / "undisturbed", over, unit=unit, progress=False).store)
        round_ = 0
        while killed < options.count:
            store = Path(folder) / f"store_{round_}"
            _begin(store, over, unit)
            while _left(store):
                worker = _worker(store)
                done = _done(store)
                try:
                    worker.wait(rng.uniform(0.0, options.longest))
                except subprocess.TimeoutExpired:
                    os.kill(worker.pid, signal.SIGKILL)
                    worker.wait()
                    killed += 1
                    lost += not done <= _done(store)  # a unit that was done and is not any more
                if killed >= options.count:  # the rest undisturbed
                    _worker(store).wait()
            assert digest(store) == expected, f"after {killed} kills the bits are others"
            shutil.rmtree(store)
            round_ += 1
            print(f"{killed} kills, {round_} sweeps with the bits of an undisturbed run", flush=True)
    return {
        "members": options.members,
        "kills": killed,
        "sweeps": round_,
        "finished units lost": lost,
        "sha256": expected,
    }


def _begin(store: Path, over: dict, unit: int | None = None) -> None:
    """A store of which nothing is done."""
    from lagjax import _sweep

    work, _sweep.compute_units = _sweep.compute_units, lambda *_: 0
    try:
        run(store, over, unit=unit, progress=False)
    finally:
        _sweep.compute_units = work


def _worker(store: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "lagjax", "sweep", "run", str(store), "--quiet", *more]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)


def _done(store: Path) -> set[str]:
    return {name for name in os.listdir(store / ".sweep" / "done") if name.endswith(".json")}


def _left(store: Path) -> int:
    spec = json.loads((store / ".sweep" / "spec.json").read_text())
    units = math.prod(math.ceil(a / b) for a, b in zip(spec["shape"], spec["chunk"], strict=True))
    return units - len(_done(store))


def workers(options: argparse.Namespace) -> dict[str, Any]:
    """One SHA-256 of the arrays, whoever computes them."""
    over, unit, found = grid(options.members), max(1, options.members // 40), {}
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        places = iter(Path(folder) / f"store_{k}" for k in range(100))
        found["this process"] = digest(run(next(places), over, unit=unit, progress=False).store)
        for count in (1, 2, 7):
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(count, mp_context=context) as pool:
                found[f"{count} processes"] = digest(
                    run(next(places), over, unit=unit, executor=pool, progress=False).store
                )
            print(found, flush=True)
        found["two parts"] = _two_parts(next(places), over, unit)
        found |= _by_dask(next(places), over, unit)
    print("\n".join(f"{sha}  {who}" for who, sha in found.items()))
    return {"members": options.members, "sha256": found, "one": len(set(found.values())) == 1}


def _two_parts(store: Path, over: dict, unit: int) -> str:
    _begin(store, over, unit)
    shells = [_worker(store, "--part", k, "--of", "2") for k in "01"]
    assert [shell.wait() for shell in shells] == [0, 0]
    return digest(store)


def _by_dask(store: Path, over: dict, unit: int) -> dict[str, str]:
    """By a scheduler and workers that are processes; nothing where dask is not installed."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        return {}
    cluster = LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None)
    with cluster, Client(cluster) as client:
        return {"dask": digest(run(store, over, unit=unit, executor=client.get_executor(), progress=False).store)}


KEY = ("theta1", "theta2", "poison")
NAN, SINGULAR, ENDLESS = 1.0, 2.0, 3.0


def poison(options: argparse.Namespace) -> dict[str, Any]:
    """Ten members that fail among many; the others are what they are without them, bit for bit."""
    over, bad = _poisoned(options.members, np.random.default_rng(options.seed))
    rule = dict(
        q0=poisoned_start, params=poisoned_params, keep=keep, max_steps=2000,
        unit=max(1, options.members // 8), progress=options.progress,
    )  # fmt: skip
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        swept = run(Path(folder) / "poisoned", over, **rule)
        print(swept)
        told, data = swept.status(), swept.open()
        other = run(Path(folder) / "clean", {KEY: (*over[KEY][:2], np.zeros(options.members))}, **rule).open()
        well = np.setdiff1d(np.arange(options.members), list(bad))
        same = all(
            np.array_equal(data[name].values[well], other[name].values[well], equal_nan=True)
            for name in ("q", "qdot", "flip", "result")
        )
    named = {int(failure.member): failure.result for failure in told.failures}
    kinds = {NAN: "NaN", SINGULAR: "singular", ENDLESS: "endless"}
    return {
        "members": options.members, "poisoned": {k: kinds[kind] for k, kind in bad.items()}, "named": named,
        "all named": sorted(named) == sorted(bad), "others the same": same,
    }  # fmt: skip


def _poisoned(members: int, rng: np.random.Generator) -> tuple[dict, dict[int, float]]:
    kinds, bad = np.zeros(members), np.sort(rng.choice(members, 10, replace=False))
    kinds[bad] = rng.permutation([NAN] * 4 + [SINGULAR] * 3 + [ENDLESS] * 3)
    angles = rng.uniform(-np.pi, np.pi, (2, members))
    return {KEY: (*angles, kinds)}, {int(k): float(kinds[k]) for k in bad}


def poisoned_start(point):
    small = jnp.where(point["poison"] == ENDLESS, 0.01, 1.0)
    return jnp.where(point["poison"] == NAN, jnp.nan, small * start(point))


def poisoned_params(point):
    weightless = jnp.where(point["poison"] == SINGULAR, 0.0, 1.0)
    params = {name: jnp.asarray(x) * weightless for name, x in SCENE.params.items()}
    fast = jnp.where(point["poison"] == ENDLESS, 1e12, 1.0)  # oscillations for which no budget of steps suffices
    return params | {"g": fast * params["g"], "poison": point["poison"]}


def plan(options: argparse.Namespace) -> dict[str, Any]:
    """10⁸ members described, and their store made: seconds, and memory beside that of Python and JAX."""
    found = {}
    over = {"a grid": grid(10**8), "random": {("theta1", "theta2"): lagjax.designs.random(10**8, 1, -math.pi, math.pi)}}
    for name, axes in over.items():
        with tempfile.TemporaryDirectory(dir=options.folder) as folder, _Memory() as memory:
            began = time.perf_counter()
            _begin(Path(folder) / "store", axes, 10**6)
            seconds, left = time.perf_counter() - began, _left(Path(folder) / "store")
        found[name] = {"seconds": seconds, "units": left, "MiB more": memory.most - memory.before}
    return found


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run one part, print it, and store it beside the others."""
    options = _options().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_platforms", "cpu")
    options.output.mkdir(parents=True, exist_ok=True)
    part = {"rate": rate, "map": flip_map, "kills": kills, "workers": workers, "poison": poison, "plan": plan}
    found = part[options.part](options)
    path = options.output / "sweep.json"
    record = _report.read_json(path)
    record[options.part] = {"circumstances": _report.circumstances(), **found}
    _report.write_json(path, record)
    print(json.dumps(found, indent=1, ensure_ascii=False, default=float))
    return found


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["rate", "map", "kills", "workers", "poison", "plan"])
    parser.add_argument("--members", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=8, help="turns of the rate (default: %(default)s)")
    parser.add_argument("--bare", type=int, default=20, help="bare batches of a turn (default: %(default)s)")
    parser.add_argument("--side", type=int, default=2048, help="of the map (default: %(default)s)")
    parser.add_argument("--count", type=int, default=100, help="kills (default: %(default)s)")
    parser.add_argument("--longest", type=float, default=8.0, help="seconds until a kill (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where stores are made (default: the system's temporary folder)")
    parser.add_argument("--progress", action="store_true")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    return parser


if __name__ == "__main__":
    main()
