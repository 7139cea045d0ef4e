"""Sweeps: what is stored is what `simulate_batch` gives, whoever computed it, and whatever happened meanwhile."""

import contextlib
import errno
import hashlib
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stores import run_sweep

import lagjax
from lagjax import __main__ as command_line
from lagjax import designs
from lagjax._sweep import Files, _files, _job, _statistics, _workers
from lagjax._sweep._members import Grid, axes_of

GRAVITY = 9.81


def lagrangian(q, qdot, params):
    return 0.5 * params**2 * qdot**2 + GRAVITY * params * jnp.cos(q)


def keep(trajectory):
    return {"end": trajectory.q[-1], "fastest": jnp.abs(trajectory.qdot).max(), "steps": trajectory.stats["num_steps"]}


def angle_of(point):
    return point["angle"]


def length_of(point):
    return point["length"]


PENDULUM = lagjax.System(lagrangian)
TS = np.linspace(0.0, 2.0, 5)
OVER = {"length": np.linspace(0.5, 1.5, 6), "angle": np.linspace(0.0, 3.0, 7)}
RULE = dict(q0=angle_of, qdot0=0.0, params=length_of, keep=keep, unit=10, progress=False)  # units of one length


def swept(folder, over=OVER, **changes):
    return run_sweep(PENDULUM, over, TS, **{**RULE, "store": folder / "store", **changes})


def digests(folder, store="store"):
    """The hashes of all chunks of a store, by file."""
    chunks = (folder / store).glob("*/c/**/*")
    return {
        str(file.relative_to(folder / store)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in chunks
        if file.is_file()
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    swept(folder)
    return digests(folder)


# ---- what is stored --------------------------------------------------------------------------------------------------


def test_store_has_names_and_the_bits_of_a_batch(tmp_path):
    data = swept(tmp_path).open()
    assert data.end.dims == ("length", "angle") and set(data.data_vars) == {"end", "fastest", "steps", "result"}
    np.testing.assert_array_equal(data.length, OVER["length"])
    length, angle = (x.ravel() for x in np.meshgrid(*OVER.values(), indexing="ij"))
    bare = lagjax.simulate_batch(PENDULUM, angle, np.zeros_like(angle), TS, length, batch_axes=(0, 0, 0))
    np.testing.assert_array_equal(data.end.values.ravel(), bare.q[:, -1])
    np.testing.assert_array_equal(data.steps.values.ravel(), bare.stats["num_steps"])
    assert data.result.dtype == np.int16 and (data.result == 0).all()


@pytest.mark.slow
def test_status_tells_results_and_the_worst_energy(tmp_path):
    told = swept(tmp_path).status()
    assert told.done == told.members == 42 and told.results == {"successful": 42} and not told.failures
    change, member, point = told.drift
    assert 0 < change < 1e-6 and point == {"length": OVER["length"][member // 7], "angle": OVER["angle"][member % 7]}
    assert "42 of 42 members" in str(told) and f"length = {point['length']}" in str(told)


@pytest.mark.slow
def test_designs_and_names_that_vary_together(tmp_path):
    over = {("length", "mass"): ([0.5, 1.0], [1.0, 3.0]), "angle": designs.random(5, seed=1, low=0.0, high=2.0)}
    data = swept(tmp_path, over, unit=None).open()
    assert data.end.dims == ("length_mass", "angle") and data.end.shape == (2, 5)
    np.testing.assert_array_equal(data.mass, [1.0, 3.0])
    bare = lagjax.simulate(PENDULUM, float(data.angle[3]), 0.0, TS, 1.0)
    assert float(data.end[1, 3]) == float(bare.q[-1])


def at_the_bottom(q, qdot):
    return q


def keep_end_and_crossings(trajectory, crossings):
    return {"end": trajectory.q[-1], "first": crossings.t[0], "speed": crossings.qdot[0], "count": crossings.count}


BOTTOM = {"section": at_the_bottom, "direction": -1, "count": 2}
WITH_CROSSINGS = dict(keep=keep_end_and_crossings, crossings=BOTTOM)


@pytest.mark.parametrize("times", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_last_state_and_first_crossing_from_one_sweep(tmp_path, times):
    ts = np.linspace(0.0, 2.0, times)
    data = run_sweep(PENDULUM, OVER, ts, **{**RULE, **WITH_CROSSINGS, "store": tmp_path / "store"}).open()
    length, angle = (x.ravel() for x in np.meshgrid(*OVER.values(), indexing="ij"))
    starts = (angle, np.zeros_like(angle), ts, length)
    bare = lagjax.simulate_batch(PENDULUM, *starts, batch_axes=(0, 0, 0))
    np.testing.assert_allclose(data.end.values.ravel(), bare.q[:, -1], rtol=1e-7)  # of twenty steps of 1e-9
    alone = lagjax.crossings(PENDULUM, at_the_bottom, angle[40], 0.0, ts, length[40], direction=-1, count=2)
    assert data["first"].values.ravel()[40] == alone.t[0] and data["count"].values.ravel()[40] == alone.count
    down = lagjax.simulate_batch(
        PENDULUM, *starts, batch_axes=(0, 0, 0), event=diffrax.Event(at_the_bottom, direction=False)
    )
    fell = np.asarray(down.result._value) == lagjax.RESULTS.event_occurred._value
    assert 20 < fell.sum() < 42 and (fell == np.isfinite(data["first"].values.ravel())).all()
    np.testing.assert_allclose(data["first"].values.ravel()[fell], down.end.t[fell], rtol=1e-9)
    np.testing.assert_allclose(data.speed.values.ravel()[fell], down.end.qdot[fell], rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("how", [dict(unit=1), dict(unit=42)])
def test_crossings_do_not_depend_on_neighbours_and_workers(tmp_path, how, monkeypatch):
    ts, rule = np.array([0.0, 2.0]), {**RULE, **WITH_CROSSINGS}
    whole = run_sweep(PENDULUM, OVER, ts, **{**rule, "store": tmp_path / "whole"}).open().load()
    store = tmp_path / "store"
    stopped = lambda job, left, tell: _workers.compute_units(job, left[:2], tell)
    monkeypatch.setattr("lagjax._sweep.compute_units", stopped)
    run_sweep(PENDULUM, OVER, ts, **{**rule, "store": store, **how})
    monkeypatch.undo()
    data = run_sweep(PENDULUM, OVER, ts, **{**rule, "store": store, **how}).open()
    for name, values in whole.items():
        np.testing.assert_array_equal(data[name].values, values.values)
    with pytest.raises(ValueError, match=r"'count': 2.* in the store, now .*'count': 3"):
        run_sweep(PENDULUM, OVER, ts, **{**rule, "store": store, "crossings": BOTTOM | {"count": 3}})
    with pytest.raises(ValueError, match=r"(?s)crossings of section.*-    return q.*\+    return q - 0.1"):
        run_sweep(PENDULUM, OVER, ts, **{**rule, "store": store, "crossings": BOTTOM | {"section": beside_it}})


def beside_it(q, qdot):
    return q - 0.1


DISK = lagjax.System(lambda q, v: 0.5 * jnp.sum(v**2) - GRAVITY * q[1], constraints=lambda q: jnp.sum(q**2) - 1.0)


@pytest.mark.slow
def test_crossings_of_several_sections_under_constraints(tmp_path):
    sections = {"bottom": lambda q, v: q[0], "height": lambda q, v, t: q[1] + 0.8 + 0.01 * t}
    angles = np.linspace(0.1, 1.5, 9)
    on_it = lambda angle: jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    q0 = lambda point: (1.0 + 1e-3 * (point["angle"] > 1.4)) * on_it(point["angle"])
    keep = lambda trajectory, crossings: {"times": {name: x.t for name, x in crossings.items()}}
    run = run_sweep(
        DISK, {"angle": angles}, np.array([0.0, 1.0]), q0=q0, qdot0=np.zeros(2), keep=keep,
        crossings={"section": sections, "count": 3}, store=tmp_path / "store", progress=False,
    )  # fmt: skip
    data = run.open()
    assert run.status().results == {"successful": 8, "inconsistent_start": 1}
    assert np.isnan(data["times.bottom"][8]).all()
    alone = lagjax.crossings(DISK, sections, on_it(angles[3]), jnp.zeros(2), jnp.array([0.0, 1.0]), count=3)
    for name in sections:
        np.testing.assert_allclose(data[f"times.{name}"][3], alone[name].t, rtol=1e-9)


def test_statistics_are_those_of_the_members(tmp_path):
    how = lagjax.Statistics(edges=np.linspace(-3, 3, 7), quantiles=(0.0, 0.3, 1.0))
    twice = lambda trajectory: {"end": trajectory.q[-1], "also": trajectory.q[-1]}
    run = swept(tmp_path, keep=twice, reduce={"also": how}, unit=5)
    (got,) = run.statistics().values()
    x = run.open().end.values.ravel()
    assert set(run.open().data_vars) == {"end", "result"} and got.count == 42 and got.missing == 0
    np.testing.assert_allclose([got.mean, got.variance], [x.mean(), x.var(ddof=1)], rtol=1e-13)
    assert (got.min, got.min_member, got.max, got.max_member) == (x.min(), x.argmin(), x.max(), x.argmax())
    np.testing.assert_array_equal(got.histogram, np.histogram(x, how.edges)[0])
    exact = np.quantile(x, how.quantiles, method="lower")
    np.testing.assert_allclose(got.quantiles, exact, rtol=1.1 * _statistics.RELATIVE)


def test_statistics_leave_out_what_is_not_finite():
    values, ok = np.array([[1.0], [np.nan], [5.0], [-2.0]]), np.array([True, True, False, True])
    how = lagjax.Statistics(quantiles=(0.5,))
    part = _statistics.unit_statistics(how, values, ok, np.arange(10, 14))
    nothing = _statistics.unit_statistics(how, values[1:3], ok[1:3], np.arange(2))
    for total in (part, _statistics.merge_statistics(part, nothing), _statistics.merge_statistics(nothing, part)):
        got = _statistics.summarize(how, total, ())
        assert got.count == 2 and got.mean == -0.5 and got.variance == 4.5 and got.min_member == 13
    assert np.isnan(_statistics.summarize(how, nothing, ()).mean)


# ---- members and units -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1,), (1000,), (7, 11, 13), (3, 1, 50), (2, 2, 2, 2)])
@pytest.mark.parametrize("size", [1, 4, 60, 10**6])
def test_units_tile_the_members_in_order(shape, size):
    grid = Grid.from_shape(shape, size)
    numbers = [grid.numbers(unit, np.arange(grid.unit_size(unit))) for unit in range(grid.unit_count)]
    np.testing.assert_array_equal(np.concatenate(numbers), np.arange(np.prod(shape)))
    assert max(map(len, numbers)) <= size


def test_a_hundred_million_members_are_no_list(monkeypatch):
    monkeypatch.setattr(designs, "SLICE", 1000)
    over = {"a": np.linspace(0, 1, 10_000), "b": designs.random(10_000)}
    grid = Grid.from_shape(tuple(axis.size for axis in axes_of(over)), 10**6)
    assert grid.member_count == 10**8 and grid.unit_count == 100 and grid.box(99)[0] == slice(9900, 10_000)
    (axis,) = axes_of({("x", "y"): designs.random(10**8, seed=3)})
    start, first = next(axis.pieces())
    assert start == 0 and len(first) == 1000


@pytest.mark.parametrize("design", [designs.random, pytest.param(designs.sobol, marks=pytest.mark.slow)])
def test_more_members_begin_with_the_same_ones(design, monkeypatch):
    def all_of(count, seed=4):
        (axis,) = axes_of({("x", "y", "z"): design(count, seed, low=(0, 1, 2), high=(1, 3, 9))})
        return np.concatenate([values for _, values in axis.pieces()])

    few, many, others = all_of(100), all_of(1000), all_of(100, seed=5)
    np.testing.assert_array_equal(few, many[:100])
    assert ((many >= [0, 1, 2]) & (many < [1, 3, 9])).all() and not np.isin(few, others).any()
    monkeypatch.setattr(designs, "SLICE", 32)  # member k is a function of (seed, k)
    np.testing.assert_array_equal(all_of(1000), many)


@pytest.mark.slow
def test_latin_hypercube_has_one_point_in_each_part():
    (axis,) = axes_of({("x", "y"): designs.latin_hypercube(50, seed=1)})
    ((_, values),) = axis.pieces()
    np.testing.assert_array_equal(np.sort(np.floor(50 * values), axis=0).T, [np.arange(50)] * 2)


# ---- to continue -----------------------------------------------------------------------------------------------------


def begun(folder, units=0, **changes):
    """A store of which so many units are done."""
    with pytest.MonkeyPatch.context() as patch:
        run = _workers.compute_units
        patch.setattr("lagjax._sweep.compute_units", lambda job, left, tell: run(job, left[:units], tell))
        swept(folder, **changes)
    return Files(folder / "store")


def test_goes_on_where_it_stopped(tmp_path, undisturbed):
    store = begun(tmp_path, 2)
    assert len(store.finished_units()) == 2
    times = {unit: (store.job / "done" / f"{unit}.json").stat().st_mtime_ns for unit in store.finished_units()}
    swept(tmp_path)
    assert all((store.job / "done" / f"{unit}.json").stat().st_mtime_ns == t for unit, t in times.items())
    assert digests(tmp_path) == undisturbed


def test_another_process_goes_on(tmp_path, undisturbed, capsys):
    begun(tmp_path, 1)
    _job._open_job.cache_clear()
    assert command_line.main(["sweep", "run", str(tmp_path / "store"), "--quiet"]) == 0
    assert digests(tmp_path) == undisturbed and "42 of 42" in capsys.readouterr().out
    assert command_line.main(["sweep", "check", str(tmp_path / "store")]) == 0
    assert command_line.main(["sweep", "status", str(tmp_path / "nothing")]) == 1
    assert "is no store of a sweep" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1, 7, 42, None])
def test_members_do_not_depend_on_their_neighbours(tmp_path, undisturbed, unit):
    run, whole = swept(tmp_path, unit=unit), tmp_path / "other"
    np.testing.assert_array_equal(run.open().fastest, swept(whole).open().fastest)


def heavier(q, qdot, params):
    return 0.5 * params**2 * qdot**2 + 2 * GRAVITY * params * jnp.cos(q)


HEAVIER = lagjax.System(heavier)


def test_changed_descriptions_are_refused_with_the_difference(tmp_path, undisturbed):
    swept(tmp_path)

    def by_constant(gravity):
        return lagjax.System(lambda q, qdot, params: 0.5 * params**2 * qdot**2 + gravity * params * jnp.cos(q))

    common = {**RULE, "store": tmp_path / "store"}
    with pytest.raises(ValueError, match=r"(?s)another description.*\+.*2 \* GRAVITY \* params"):
        run_sweep(HEAVIER, OVER, TS, **common)
    with pytest.raises(ValueError, match=r"length.*angle.*in the store, now"):
        swept(tmp_path, OVER | {"angle": np.linspace(0.0, 3.0, 8)})
    with pytest.raises(ValueError, match="rtol: None in the store, now 1e-06"):
        swept(tmp_path, rtol=1e-6)
    with pytest.raises(ValueError, match="keep"):
        swept(tmp_path, keep=lambda trajectory: {"end": trajectory.q[-2]})
    run_sweep(by_constant(1.0), OVER, TS, **{**common, "store": tmp_path / "constant"})
    with pytest.raises(ValueError, match="its text is the same; a value that it uses is not"):
        run_sweep(by_constant(2.0), OVER, TS, **{**common, "store": tmp_path / "constant"})
    assert digests(tmp_path) == undisturbed


@pytest.mark.slow
def test_changed_solvers_and_events_are_refused(tmp_path):
    swept(tmp_path, solver=diffrax.Dopri5())
    with pytest.raises(ValueError, match=r"(?s)solver: .*Dopri5.* in the store, now .*Tsit5"):
        swept(tmp_path, solver=diffrax.Tsit5())
    falling, rising, timed = (diffrax.Event(at_the_bottom, direction=way) for way in (False, True, None))
    swept(tmp_path, store=tmp_path / "event", event=falling)
    for event in (rising, timed, None):
        with pytest.raises(ValueError, match=r"(?s)What differs:\nevent"):
            swept(tmp_path, store=tmp_path / "event", event=event)


# ---- what goes wrong -------------------------------------------------------------------------------------------------


def outwards(q, qdot, params):  # q¨ = 1 where nothing pulls; a collision where something does, stiff where k is large
    return 0.5 * qdot**2 + q + params["pull"] / q - 0.5 * params["k"] * q**2


OUTWARDS = lagjax.System(outwards)


def test_failures_cost_the_others_nothing(tmp_path):
    start, pull, k = 1.0 + np.arange(300) / 300, np.zeros(300), np.zeros(300)
    start[5], pull[[20, 150]], k[77] = -1.0, 9.0, 1e12
    over = {("start", "pull", "k"): (start, pull, k)}
    system, of = OUTWARDS, lambda point: {"pull": point["pull"], "k": point["k"]}
    q0 = lambda point: jnp.where(point["start"] < 0, jnp.nan, point["start"])
    rule = {**RULE, "store": tmp_path / "store", "q0": q0, "params": of, "unit": 70, "max_steps": 300}
    told = run_sweep(system, over, TS, **rule).status()
    assert {f.member for f in told.failures} == {5, 20, 77, 150} and told.results["successful"] == 296
    assert {f.result for f in told.failures} == {"nonfinite_state", "dt_min_reached", "max_steps_reached"}
    ends, well = lagjax.Sweep(tmp_path / "store").open().end.values, (start > 0) & (pull == 0) & (k == 0)
    np.testing.assert_allclose(ends[well], start[well] + 0.5 * TS[-1] ** 2, rtol=1e-12)
    params = {"pull": pull[well], "k": k[well]}
    bare = lagjax.simulate_batch(system, start[well], 0 * start[well], TS, params, batch_axes=(0, 0, 0), max_steps=300)
    np.testing.assert_array_equal(ends[well], bare.q[:, -1])
    assert np.isnan(ends[~well]).all()


def test_members_have_times_of_their_own(tmp_path):
    def times(point):  # periods of small swings; for one length none that can be followed
        period = jnp.where(point["length"] > 1.4, jnp.nan, 2 * jnp.pi * jnp.sqrt(point["length"] / GRAVITY))
        return jnp.linspace(0.0, 3 * period, 7)

    def keep_times(run):
        return {"t": run.ts, "q": run.q, "between": run.at(0.4 * run.ts[-1]).q}

    rule = {**RULE, "store": tmp_path / "store", "keep": keep_times}
    run = run_sweep(PENDULUM, OVER, times, **rule)
    data, periods = run.open(), 2 * np.pi * np.sqrt(OVER["length"] / GRAVITY)
    np.testing.assert_allclose(data.t[:-1, 3, -1], 3 * periods[:-1], rtol=1e-14)
    for k, ts in enumerate(data.t[:-1, 2].values):
        alone = lagjax.simulate(PENDULUM, OVER["angle"][2], 0.0, ts, OVER["length"][k])
        np.testing.assert_allclose(data.q[k, 2], alone.q, rtol=1e-12)
        np.testing.assert_allclose(data.between[k, 2], alone.at(0.4 * ts[-1]).q, rtol=1e-9)
    told = run.status()
    assert told.results == {"successful": 35, "keep_failed": 7} and np.isnan(data.q[-1]).all()
    assert "ts returned times that are not finite" in told.failures[0].why
    with pytest.raises(ValueError, match="ts"):
        run_sweep(PENDULUM, OVER, lambda point: times(point)[:5], **rule)


def test_keep_in_numpy_may_fail_for_a_member(tmp_path):
    def uneven(trajectory):
        if trajectory.params == 0.7:
            raise OverflowError("too short")
        return {"late": np.asarray(trajectory.q)[np.asarray(trajectory.ts) > (1.0 if trajectory.params < 1 else 0.2)]}

    run = swept(tmp_path, {"length": np.array([0.5, 0.7, 0.9, 1.1])}, q0=1.0, keep=uneven, unit=2)
    told = run.status()
    assert told.results == {"successful": 2, "keep_failed": 2} and "keep" in told.slow
    assert "OverflowError: too short" in told.failures[0].why and "shape (4,), of other members (2,)" in str(told)
    np.testing.assert_array_equal(np.isnan(run.open().late).all(axis=1), [False, True, False, True])


def test_a_name_that_is_too_long_is_a_sentence(tmp_path):
    with pytest.raises(OSError, match="no store can be there: the name of the folder is too long") as error:
        Files(tmp_path / ("x" * 300 + ".zarr")).spec()
    assert error.value.errno == errno.ENAMETOOLONG


@pytest.mark.parametrize("number, words", [(errno.ENOSPC, "disk is full"), (errno.EROFS, "read-only")])
def test_disks_that_refuse(tmp_path, undisturbed, monkeypatch, number, words):
    write, count = _files.write_through, []

    def refuse(file, data):
        count.append(file)
        if len(count) > 30:
            raise OSError(number, os.strerror(number))
        write(file, data)

    monkeypatch.setattr(_files, "write_through", refuse)
    with pytest.raises(OSError, match=words) as error:
        swept(tmp_path)
    assert error.value.errno == number and "unit" in str(error.value)
    store = Files(tmp_path / "store")
    with pytest.raises(OSError, match=f"nothing was computed: .*{words}"):
        store.require_writable()
    done = store.finished_units()
    assert 0 < len(done) < 6 and not store.find_damage(store.spec(), done, whole=True)
    monkeypatch.undo()
    swept(tmp_path)
    assert digests(tmp_path) == undisturbed


def flip(file):
    data = bytearray(file.read_bytes())
    data[5] ^= 1
    file.write_bytes(data)


DAMAGES = {
    "end/c/0/0": (flip, "its chunk of 'end' is not what was written"),
    "end/c/1/0": (lambda file: os.truncate(file, 7), "its chunk of 'end' has 7 bytes, where it should have 60"),
    "fastest/c/2/0": (Path.unlink, "its chunk of 'fastest' is not there"),
    ".sweep/done/3.json": (lambda file: file.write_text("{}"), "its record cannot be read"),
    ".sweep/done/4.json": (lambda file: file.write_bytes(b"\xff"), "its record cannot be read"),
    ".sweep/done/7.json": (lambda file: file.write_text("{}"), "there are but 6 units"),
}


@pytest.mark.parametrize("by_command", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_is_damaged_is_told_and_computed_again(tmp_path, undisturbed, by_command):
    run = swept(tmp_path)
    for name, (damage, _) in DAMAGES.items():
        damage(run.store / name)
    with pytest.raises(ValueError, match="checksum"), pytest.warns(UserWarning, match="computes them again"):
        run.open().end.load()
    told, seen = run.damaged(), run.status().damaged
    assert set(told) == {0, 1, 2, 3, 4, 7} and set(seen) == {1, 2, 3, 4, 7}  # the status reads no contents
    assert all(words in text for text, (_, words) in zip(told.values(), DAMAGES.values(), strict=True))
    with pytest.warns(UserWarning, match=r"unit 1: .*computed again"):
        command_line.main(["sweep", "run", "--quiet", str(run.store)]) if by_command else swept(tmp_path)
    assert digests(tmp_path) == undisturbed and not run.damaged() and run.status().units_done == 6


def test_a_damaged_description_is_a_sentence(tmp_path):
    store = swept(tmp_path).store
    file, damaged = (
        store / ".sweep" / "spec.json",
        r"spec\.json cannot be read \(.*the store is damaged\. Begin the same",
    )
    spec = json.loads(file.read_bytes())
    changed = [json.dumps(spec | change).encode() for change in ({"chunk": [0, 7]}, {"axes": 3}, {"rtol": 1e-3})]
    for content in (*changed, b"\xff\xfe", b"[]", b"{", b"", b"3"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=damaged):
            lagjax.Sweep(store)
    del spec["sha256"]
    for name in ("../../x", "/x"):  # of a stranger, who knows how it is written
        own = spec | {"kept": [{"name": name, "shape": [], "dtype": "<f8"}]}
        file.write_bytes(_files._read_json({"sha256": _files._file_hash(_files._read_json(own)), **own}))
        with pytest.raises(ValueError, match=damaged):
            lagjax.Sweep(store)


def test_damaged_metadata_are_a_sentence_whose_advice_helps(tmp_path, undisturbed, capsys):
    run, other = swept(tmp_path), tmp_path / "other"
    (other / "store").parent.mkdir()
    swept(other)
    broken = {"zarr.json": b"{", "end/zarr.json": b"\xff", "length/c/0": b"\0" * 48, ".sweep/spec.json": b""}
    for name, content in broken.items():
        (run.store / name).write_bytes(content)
        for use in (lambda: swept(tmp_path), run.status, run.open):
            with pytest.raises(ValueError, match=r"the store is damaged\. Begin the same sweep, with the same `unit`"):
                use()
        assert command_line.main(["sweep", "run", str(run.store)]) == 1 and "is damaged" in capsys.readouterr().err
        shutil.copy(other / "store" / name, run.store / name)
    swept(tmp_path)
    moved = run.store / "end" / "c"
    moved.rename(other / "elsewhere")
    moved.symlink_to(other / "elsewhere")
    with pytest.raises(ValueError, match="is a link, or its chunks are"):
        swept(tmp_path)
    (run.store / ".sweep" / "scene.pkl").write_bytes(b"x")
    moved.unlink()
    assert command_line.main(["sweep", "run", str(run.store)]) == 1 and "scene.pkl, cannot" in capsys.readouterr().err
    with pytest.warns(UserWarning, match="computed again"):
        swept(tmp_path)
    assert digests(tmp_path) == undisturbed


def test_units_whose_chunks_are_gone_are_not_done(tmp_path, capsys):
    run, count = swept(tmp_path), 6
    whole = run.open().load()
    assert run.status().units_done == count
    gone = sorted((tmp_path / "store" / "end" / "c").glob("*/*"))[2]
    gone.unlink()
    told = run.status()
    assert told.units_done == count - 1 and told.done < told.members and sum(told.results.values()) == told.done
    assert command_line.main(["sweep", "status", str(tmp_path / "store")]) == 0
    assert "unit 2: its chunk of 'end' is not there" in capsys.readouterr().out
    with pytest.warns(UserWarning, match="computes them again"):
        data = run.open().load()
    lost = np.isnan(data.end.values) & ~np.isnan(whole.end.values)
    assert lost.any() and (data.result.values[lost] == -1).all()
    np.testing.assert_array_equal(data.result.values[~lost], whole.result.values[~lost])
    assert data.result.attrs == whole.result.attrs
    for name in ("end", "result"):
        shutil.rmtree(tmp_path / "store" / name / "c")
    assert run.status().done == 0 and not run.status().results
    with pytest.warns(UserWarning, match="computed again"):
        swept(tmp_path)
    assert run.status().done == told.members


def test_stores_of_another_version_are_left_alone(tmp_path, undisturbed, monkeypatch):
    swept(tmp_path)
    here = _job.package_versions()
    monkeypatch.setattr(_job, "package_versions", lambda: here | {"jax": "0.1"})
    with pytest.raises(ValueError, match=r"begun with jax .*, here 0.1: its numbers would not be of one program"):
        swept(tmp_path)
    monkeypatch.setattr(_files, "FORMAT", 7)
    with pytest.raises(ValueError, match=r"is a store of format 5, .*this lagjax writes format 7"):
        swept(tmp_path)
    assert digests(tmp_path) == undisturbed


def test_another_kind_of_cpu_goes_on_and_is_told(tmp_path, undisturbed, monkeypatch):
    begun(tmp_path, 2)
    here = _job.cpu_kind()
    monkeypatch.setattr(_job, "cpu_kind", lambda: "an abacus")
    with pytest.warns(UserWarning, match=r"begun on a CPU of the kind .*, and continues here on an abacus"):
        told = swept(tmp_path).status()
    assert told.cpus == (here, "an abacus") and "an abacus: their members" in str(told)
    assert digests(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_store_whose_creation_was_interrupted_is_made_anew(tmp_path, undisturbed, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(_files.Files, "write", interrupted)
        swept(tmp_path)
    assert not list(tmp_path.iterdir())
    swept(tmp_path)
    assert digests(tmp_path) == undisturbed
    (tmp_path / "store" / ".sweep" / "spec.json").unlink()
    with pytest.raises(FileNotFoundError, match="name another folder, or empty this one"):
        swept(tmp_path)


@pytest.mark.parametrize(
    "changes, words",
    [
        (dict(over={}), "must be a dict"),
        (dict(over={"angle": np.zeros((2, 2))}), "1-D array"),
        (dict(over={"result": [1.0]}), "twice"),
        (dict(over={("a", "b"): ([1.0], [1.0, 2.0])}), "one length"),
        (dict(over={"angle": [np.nan]}), "not finite"),
        (dict(q0=0.0, params=1.0), "None of q0, qdot0, params and ts"),
        (dict(keep=lambda trajectory: trajectory.q), "must return a dict"),
        (dict(keep=lambda trajectory: {"angle": trajectory.q}), "another name"),
        (dict(reduce={"nothing": lagjax.Statistics()}), "does not return"),
        (dict(unit=0), "positive whole number"),
        (dict(keep=keep_end_and_crossings), "keep asks for `crossings`"),
        (dict(crossings=BOTTOM), "does not ask for them"),
        (dict(keep=keep_end_and_crossings, crossings=at_the_bottom), "must be a dict"),
        (dict(**WITH_CROSSINGS, event=at_the_bottom), "ends the motion"),
        (dict(**WITH_CROSSINGS, solver=diffrax.Tsit5()), "leave solver at None"),
        (dict(executor=3), "must be a concurrent.futures.Executor"),
        (dict(part=(20, 20)), r"of which 0 ≤ k < n, as in \(3, 20\); got \(20, 20\)"),
        (dict(part=3), "part must be two whole numbers"),
    ],
)
def test_mistakes_are_sentences(tmp_path, changes, words):
    with pytest.raises((TypeError, ValueError), match=words):
        swept(tmp_path, **changes)


# ---- to grow ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_finer_grid_takes_what_is_known(tmp_path, monkeypatch):
    coarse = swept(tmp_path, store=tmp_path / "coarse").store
    finer = {"length": np.append(OVER["length"], 1.7), "angle": np.linspace(0.0, 3.0, 13)}
    whole = swept(tmp_path, finer, store=tmp_path / "whole")
    batch, sizes = _job.Batches.__call__, []
    monkeypatch.setattr(
        _job.Batches, "__call__", lambda self, points: sizes.append(points["angle"].size) or batch(self, points)
    )
    grown = swept(tmp_path, finer, store=tmp_path / "grown", extend=coarse)
    assert sum(sizes[2:]) == 7 * 13 - 42  # after two looks
    assert digests(tmp_path, "grown") == digests(tmp_path, "whole") and grown.status().done == 91
    with pytest.raises(ValueError, match=r"rtol: None in the store, now 1e-05"):
        swept(tmp_path, finer, store=tmp_path / "other", extend=coarse, rtol=1e-5)
    with pytest.raises(ValueError, match=r"(?s)ts: .*give ts that begin at 2, where"):
        run_sweep(PENDULUM, OVER, 2 * TS, **{**RULE, "store": tmp_path / "other", "extend": coarse})
    assert not (tmp_path / "other").exists() and whole.status().done == 91


@pytest.mark.slow
@pytest.mark.parametrize("slice", [16, 2**20])
def test_more_members_of_a_design(tmp_path, slice, monkeypatch):
    monkeypatch.setattr(designs, "SLICE", slice)  # coordinates of more are written by those who compute the members
    over = lambda count: {("length", "angle"): designs.random(count, seed=2, low=(0.5, 0.0), high=(1.5, 3.0))}
    few = begun(tmp_path, 3, over=over(45)).path  # of which 30 are done
    swept(tmp_path, over(75), store=tmp_path / "whole")
    many = swept(tmp_path, over(75), store=tmp_path / "many", extend=few)
    assert digests(tmp_path, "many") == digests(tmp_path, "whole") and not many.open().angle.isnull().any()
    assert many.status().results == {"successful": 75}


def keep_end(trajectory):
    return {"end": trajectory.end, "fastest": jnp.abs(trajectory.qdot).max()}


TO_ONE, TO_TWO = TS[:3], TS[2:]


def in_pieces(folder, **changes):
    """The sweeps from 0 to 1, and from there to 2."""
    rule = {**RULE, "keep": keep_end, **changes}
    first = run_sweep(PENDULUM, OVER, TO_ONE, **{**rule, "store": folder / "first"})
    return first, run_sweep(PENDULUM, OVER, TO_TWO, **{**rule, "store": folder / "rest", "extend": first.store})


def test_a_later_end_goes_on_from_the_states_that_are_kept(tmp_path):
    first, rest = in_pieces(tmp_path)
    one, two = first.open(), rest.open()
    length, angle = (x.ravel() for x in np.meshgrid(*OVER.values(), indexing="ij"))
    whole = lagjax.simulate_batch(PENDULUM, angle, np.zeros_like(angle), TS, length, batch_axes=(0, 0, 0))
    np.testing.assert_allclose(two["end.q"].values.ravel(), whole.q[:, -1], atol=1e-7)  # of forty steps of 1e-9
    fastest = np.maximum(one.fastest, two.fastest).values.ravel()
    np.testing.assert_allclose(fastest, np.abs(whole.qdot).max(axis=1), atol=1e-7)
    state = (one[name].values.ravel() for name in ("end.q", "end.qdot"))
    bare = lagjax.simulate_batch(PENDULUM, *state, TO_TWO, length, batch_axes=(0, 0, 0))
    np.testing.assert_array_equal(two["end.q"].values.ravel(), bare.q[:, -1])
    other = {**RULE, "store": tmp_path / "other", "extend": first.store}
    with pytest.raises(ValueError, match=r"axes: .* in the store, now"):
        run_sweep(PENDULUM, {**OVER, "length": [1.0]}, TO_TWO, **other)
    with pytest.raises(ValueError, match=r"(?s)which cannot continue.*q0"):
        run_sweep(PENDULUM, OVER, TO_TWO, **{**other, "q0": 0.5})
    with pytest.raises(ValueError, match="does not have the states in which its motions ended"):
        run_sweep(PENDULUM, OVER, TS + 2.0, **{**other, "extend": swept(tmp_path).store})
    with pytest.raises(ValueError, match=r"continues: .* in the store, now None"):
        run_sweep(PENDULUM, OVER, TO_TWO, **{**RULE, "keep": keep_end, "store": rest.store})
    (first.store / ".sweep" / "done" / "0.json").unlink()
    with pytest.raises(ValueError, match="1 units are not done"):
        run_sweep(PENDULUM, OVER, TO_TWO, **other)
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_a_later_end_of_members_that_have_ended_and_by_other_workers(tmp_path, monkeypatch):
    first, rest = in_pieces(tmp_path, event=at_the_bottom)
    whole = swept(tmp_path, keep=keep_end, event=at_the_bottom)
    one, two, both = (run.open().load() for run in (first, rest, whole))
    np.testing.assert_array_equal(two.result, both.result)
    fell = (one.result == lagjax.RESULTS.event_occurred._value).values
    assert 10 < fell.sum() < 42 and np.isnan(two["end.t"].values[fell]).all()
    for name in ("end.t", "end.q", "end.qdot"):
        np.testing.assert_allclose(np.where(fell, one[name], two[name]), both[name], atol=1e-7)
    rule = {**RULE, "keep": keep_end, "extend": first.store, "event": at_the_bottom}
    monkeypatch.setattr("lagjax._sweep.compute_units", lambda *_: None)
    begun = run_sweep(PENDULUM, OVER, TO_TWO, **{**rule, "store": tmp_path / "shell"})
    assert worker(Files(begun.store)).wait() == 0
    assert digests(tmp_path, "rest") == digests(tmp_path, "shell")


# ---- other processes -------------------------------------------------------------------------------------------------


def worker(store, *more):
    command = [sys.executable, "-m", "lagjax", "sweep", "run", str(store.path), "--quiet", *more]
    root = str(Path(lagjax.__file__).parents[1])
    return subprocess.Popen(command, env=os.environ | {"PYTHONPATH": root}, stdout=subprocess.PIPE, text=True)


def test_parts_of_an_array(tmp_path, undisturbed, capsys):
    store = begun(tmp_path)
    swept(tmp_path, part=(1, 4))
    assert store.finished_units() == {1, 5}
    run = ["sweep", "run", str(store.path), "--quiet"]
    assert command_line.main([*run, "--part", "3", "--of", "4"]) == 0 and store.finished_units() == {1, 3, 5}
    assert command_line.main([*run, "--part", "4", "--of", "4"]) == 1
    assert "0 ≤ k < n" in capsys.readouterr().err
    assert command_line.main(run) == 0 and "3 units done here" in capsys.readouterr().out  # what is missing
    assert digests(tmp_path) == undisturbed


@pytest.mark.slow
def test_kills_lose_nothing_but_the_unit_in_work(tmp_path, undisturbed):
    store, rng = begun(tmp_path), np.random.default_rng(0)
    for _ in range(2):  # `benchmarks.sweep kills` does it a hundred times
        shell = worker(store, "--units", "1")
        while not os.listdir(store.job / "aside") and shell.poll() is None:  # it computes, or writes
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.3))
        before = store.finished_units()
        shell.kill()
        shell.communicate()
        assert before <= store.finished_units() and not store.find_damage(
            store.spec(), store.finished_units(), whole=True
        )
    swept(tmp_path)
    assert digests(tmp_path) == undisturbed


@pytest.mark.slow
def test_executors(tmp_path, undisturbed):
    with ThreadPoolExecutor(3) as pool:
        swept(tmp_path, store=tmp_path / "threads", executor=pool)
    assert digests(tmp_path, "threads") == undisturbed
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        swept(tmp_path, store=tmp_path / "processes", executor=pool)
    assert digests(tmp_path, "processes") == undisturbed
    with pytest.raises(ValueError, match="forks"):
        swept(tmp_path, executor=ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")))


def digits_of_a_thread(x):
    """How a thread computes that has chosen nothing, as XLA's have, which call callbacks of large batches."""
    with ThreadPoolExecutor(1) as pool:
        return np.full(np.shape(x), pool.submit(lambda: jnp.finfo(jnp.zeros(()).dtype).precision).result(), float)


def keep_digits(trajectory):
    length = trajectory.params
    digits = jax.pure_callback(
        digits_of_a_thread, jax.ShapeDtypeStruct((), length.dtype), length, vmap_method="expand_dims"
    )
    return {"digits": digits}


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["this thread", "threads", "processes"])
def test_callbacks_count_in_the_precision_of_the_caller(tmp_path, workers):
    pools = {
        "this thread": contextlib.nullcontext,
        "threads": lambda: ThreadPoolExecutor(2),
        "processes": lambda: ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")),
    }
    jax.config.update("jax_enable_x64", False)
    try:
        with jax.enable_x64(True), pools[workers]() as pool:
            data = swept(tmp_path, keep=keep_digits, executor=pool).open()
        assert not jax.config.jax_enable_x64  # as it was
    finally:
        jax.config.update("jax_enable_x64", True)
    assert (data.digits == np.finfo(float).precision).all()


class Jobs:
    """An executor whose tasks are no futures, but can be asked, as those of submitit."""

    def __init__(self):
        self.pool = ThreadPoolExecutor(2)

    def submit(self, *task):
        future = self.pool.submit(*task)
        return Task(future)


class Task:
    def __init__(self, future):
        self.done, self.result = future.done, future.result
        self.cancel, self.cancelled = future.cancel, future.cancelled


class Broken(Jobs):
    def submit(self, *task):
        return super().submit(lambda: 1 / 0)


@pytest.mark.slow
def test_tasks_that_are_no_futures(tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(_workers, "_POLL", 0.001)
    with pytest.raises(ZeroDivisionError):
        swept(tmp_path, executor=Broken())
    swept(tmp_path, executor=Jobs())
    assert digests(tmp_path) == undisturbed


def test_an_interrupt_takes_back_the_tasks_that_wait(tmp_path):
    begun(tmp_path)
    waiting = [Task(Future()) for _ in range(6)]
    tasks = iter(waiting)

    def interrupt():
        raise KeyboardInterrupt

    for task in waiting:
        task.done = interrupt
    with pytest.raises(KeyboardInterrupt):
        swept(tmp_path, executor=SimpleNamespace(submit=lambda *_: next(tasks)))
    assert all(task.cancelled() for task in waiting)


@pytest.mark.slow
def test_submitit(tmp_path, undisturbed):
    submitit = pytest.importorskip("submitit")
    (tmp_path / "logs").mkdir()
    executor = submitit.LocalExecutor(tmp_path / "logs")
    executor.update_parameters(timeout_min=5)
    swept(tmp_path, executor=executor, unit=10)
    assert digests(tmp_path) == undisturbed


@pytest.mark.slow
def test_dask(tmp_path, undisturbed):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        swept(tmp_path, executor=client.get_executor())
    assert digests(tmp_path) == undisturbed


def abort_at(lengths):
    if multiprocessing.parent_process() and np.any(lengths == OVER["length"][3]):  # not at the first look
        os.abort()
    return lengths


def keep_or_abort(trajectory):
    length = jax.pure_callback(abort_at, jax.ShapeDtypeStruct((), float), trajectory.params, vmap_method="expand_dims")
    return keep(trajectory) | {"length_met": length}


@pytest.mark.slow
def test_a_worker_that_dies_is_told_with_its_members(tmp_path):  # two workers, which import JAX and compile
    lengths = {"length": OVER["length"][2:4]}
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    with pool, pytest.raises(RuntimeError, match=r"over unit 1 \(members 1 to 1\)\. What is done is kept"):
        swept(tmp_path, lengths, unit=1, keep=keep_or_abort, q0=OVER["angle"][2], executor=pool)
    told = lagjax.Sweep(tmp_path / "store").status()
    assert told.results == {"successful": 1} and told.units_done == 1


@pytest.mark.slow
def test_example(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(lagjax.__file__).parents[1] / "examples"))
    pytest.importorskip("matplotlib").use("agg")
    import flip_map

    (picture,) = flip_map.main(["--side", "12", "--duration", "2", "--out", str(tmp_path)])
    assert picture.stat().st_size > 10_000
    flip = lagjax.Sweep(tmp_path / "flips.zarr").open().flip.values
    np.testing.assert_array_equal(flip, flip[::-1, ::-1])  # mirrored starts flip at the same time
    assert 0 < np.isfinite(flip).sum() < flip.size


PENDULUM_ALONE = lagjax.System(lambda q, v: 0.5 * v**2 + jnp.cos(q))


def test_the_first_look_finds_a_type_for_all_members(tmp_path):
    """1 of one member and 1.5 of another are floats: `keep` in plain Python, called member by member."""

    def keep(trajectory):
        fastest = float(np.abs(trajectory.qdot).max())
        return {"speed": 1 if fastest < 0.5 else 1.5, "count": len(trajectory.ts)}

    pendulum = PENDULUM_ALONE
    angles = np.array([0.1, 0.2, 1.0, 2.0])
    swept = run_sweep(
        pendulum, {"angle": angles}, jnp.linspace(0.0, 5.0, 6), q0=lambda p: p["angle"], qdot0=0.0, keep=keep,
        store=tmp_path / "types.zarr", progress=False,
    )  # fmt: skip
    data = swept.open()
    np.testing.assert_array_equal(data["speed"], [1.0, 1.0, 1.5, 1.5])
    assert data["count"].dtype.kind == "i" and swept.status().results == {"successful": 4}


def test_a_store_opens_without_its_script_and_without_a_writable_disk(tmp_path):
    pendulum = lagjax.System(lambda q, v: 0.5 * v**2 + jnp.cos(q))

    def again():
        return run_sweep(
            pendulum, {"angle": np.linspace(0.1, 1.0, 4)}, jnp.linspace(0.0, 1.0, 3), q0=lambda p: p["angle"],
            qdot0=0.0, keep=lambda trajectory: {"q": trajectory.q[-1]}, store=tmp_path / "s.zarr", progress=False,
        )  # fmt: skip

    swept = again()
    there = lagjax.Sweep(str(tmp_path / "s.zarr"))
    assert there == swept and there.status().done == 4 and there.damaged() == {} and there.statistics() == {}
    writes = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Files, "write", lambda self, file, data, name: writes.append(name))
        assert again() == swept and not writes
    with pytest.raises(FileNotFoundError, match="is no store of a sweep"):
        lagjax.Sweep(tmp_path / "other.zarr")


# ---- hybrid motion ---------------------------------------------------------------------------------------------------


def bouncing(restitution=0.8, **how):
    """A ball on a floor, one law and one transition; its functions read `restitution`."""
    ball = lagjax.System(lambda q, v, params: 0.5 * v**2 - params["g"] * q)

    def bounce(q, v):
        return q, -restitution * v

    floor = lagjax.Transition("flight", "flight", lambda q, v: q, direction=-1, reset=bounce)
    return lagjax.Hybrid({"flight": ball}, [floor], "flight", **how)


BOUNCES = dict(
    over={"height": np.linspace(0.3, 1.0, 9)}, ts=np.linspace(0.0, 1.5, 4), q0=lambda point: point["height"],
    qdot0=0.0, params={"g": 9.81}, progress=False,
    keep=lambda run: {"q": run.q[-1], "bounces": run.transitions.count, "first": run.transitions.t[0]},
)  # fmt: skip


@pytest.mark.slow
def test_a_hybrid_scene(tmp_path):  # compiles the motion of a ball for one shape, and for one member
    scene = bouncing()
    kept = run_sweep(scene, **BOUNCES, store=tmp_path / "store").open()
    heights, g = BOUNCES["over"]["height"], 9.81
    np.testing.assert_allclose(kept["first"], np.sqrt(2 * heights / g), rtol=1e-12)  # the fall from rest
    falls = np.sqrt(2 * heights / g)[:, None] * np.cumsum([1.0, *(2 * 0.8**k for k in range(1, 12))])
    np.testing.assert_array_equal(kept.bounces, (falls < 1.5).sum(axis=1))
    one = lagjax.simulate(
        lagjax.Hybrid(scene.modes, scene.transitions, "flight"), heights[4], 0.0, BOUNCES["ts"], BOUNCES["params"]
    )
    assert float(kept.q[4]) == float(one.q[-1])
    for other, words in ((bouncing(0.7), "reset of transition 0"), (bouncing(max_transitions=5), "transitions")):
        with pytest.raises(ValueError, match=f"What differs:\n{words}"):
            run_sweep(other, **BOUNCES, store=tmp_path / "store")
    for name, value in (("event", lambda q, v: q), ("crossings", {"section": lambda q, v: v}), ("solver", "Tsit5")):
        with pytest.raises(ValueError, match=f"{name} of sweep: for the motion of one System"):
            run_sweep(scene, **BOUNCES, store=tmp_path / "other", **{name: value})
    with pytest.raises(ValueError, match="A hybrid motion cannot continue from a store"):
        later = BOUNCES | {"ts": np.linspace(1.5, 2.0, 3)}
        run_sweep(scene, **later, store=tmp_path / "later", extend=tmp_path / "store")
