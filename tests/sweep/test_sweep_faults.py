"""Sweeps of functions that fail for some members, return what cannot be stored, or need more memory than there is."""

import os
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stores import run_sweep

import lagjax
import lagjax.__main__
from lagjax._sweep import Files, _batch, _begin, _job, axes_of

PENDULUM = lagjax.System(lambda q, qdot, params: 0.5 * params**2 * qdot**2 + 9.81 * params * jnp.cos(q))
TS = np.linspace(0.0, 2.0, 5)
OVER = {"length": np.linspace(0.5, 1.5, 6), "angle": np.linspace(0.0, 3.0, 7)}
RULE = dict(
    q0=lambda point: point["angle"], qdot0=0.0, params=lambda point: point["length"], progress=False,
    keep=lambda trajectory: {"end": trajectory.q[-1], "steps": trajectory.stats["num_steps"]},
)  # fmt: skip


def swept(store, over=OVER, ts=TS, **changes):
    return run_sweep(PENDULUM, over, ts, **{**RULE, "store": store, **changes})


# ---- members for which the user's functions raise --------------------------------------------------------------------


def refuse(angles):
    """A callback for all members at once, which raises because of some."""
    if np.any(angles == OVER["angle"][2]):
        raise OverflowError("two is too much")
    return angles


def by_callback(trajectory):
    angle = trajectory.q[0]
    angle = jax.pure_callback(refuse, jax.ShapeDtypeStruct((), angle.dtype), angle, vmap_method="expand_dims")
    return {"end": trajectory.q[-1], "steps": trajectory.stats["num_steps"], "angle_met": angle}


def by_error_if(trajectory):
    end = eqx.error_if(trajectory.q[-1], trajectory.q[0] == OVER["angle"][2], "two is too much")
    return {"end": end, "steps": trajectory.stats["num_steps"]}


@pytest.mark.slow
@pytest.mark.parametrize("keep", [by_callback, by_error_if])
def test_members_for_which_compiled_keep_raises(tmp_path, keep):
    run, plain = swept(tmp_path / "store", keep=keep, unit=14), swept(tmp_path / "plain", unit=14).open()
    told, data = run.status(), run.open()
    assert told.results == {"successful": 36, "keep_failed": 6} and not told.slow
    assert [f.member % 7 for f in told.failures] == [2] * 6 and "two is too much" in told.failures[0].why
    well = np.arange(7) != 2
    for name in ("end", "steps"):
        np.testing.assert_array_equal(data[name].values[:, well], plain[name].values[:, well])
    assert np.isnan(data.end.values[:, 2]).all() and (data.steps.values[:, 2] == np.iinfo(int).min).all()


@pytest.mark.slow
def test_what_raises_for_all_is_raised(tmp_path):
    always = lambda trajectory: {"end": eqx.error_if(trajectory.q[-1], trajectory.q[0] >= 0, "negative ones alone")}
    with pytest.raises(jax.errors.JaxRuntimeError, match="negative ones alone"):
        swept(tmp_path / "store", keep=always)
    with pytest.raises(AttributeError, match="summ"):
        swept(tmp_path / "store", keep=lambda trajectory: {"x": np.asarray(trajectory.q).summ()})
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_members_for_which_a_start_raises(tmp_path):
    def found_by_a_search(point):
        if float(point["angle"]) == OVER["angle"][2]:
            raise RuntimeError("no root")
        return float(point["angle"])

    told, plain = swept(tmp_path / "store", q0=found_by_a_search).status(), swept(tmp_path / "plain").open()
    assert told.results == {"successful": 36, "nonfinite_state": 6} and "q0" in told.slow
    assert {f.why for f in told.failures} == {"q0 raised RuntimeError: no root"}
    data, well = lagjax.Sweep(tmp_path / "store").open(), np.arange(7) != 2
    np.testing.assert_array_equal(data.end.values[:, well], plain.end.values[:, well])


# ---- what cannot be stored -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, words",
    [
        (dict(keep=lambda x: {"name": "a"}), "'name', which is of type str"),
        (dict(keep=lambda x: {"end": None}), "not empty.*returned {'end': None}"),
        (dict(keep=lambda x: {"a": {"b": x.q[0]}, "a.b": x.q[1]}), "two quantities with the name 'a.b'"),
        (dict(keep=lambda x: {"end": x.q, "end_0": x.q[0]}), "an axis 'end_0'"),
        (dict(keep=lambda x: {"zarr.json": x.q[0]}), "zarr.json"),
        (dict(keep=lambda x: {"z": 1j * x.q[0]}, reduce={"z": lagjax.Statistics()}), "complex"),
        (dict(over={"length": [1.0], "angel": [1.0]}), "asks for 'angle'.* which are length, angel"),
        (dict(over={"length": [[1.0], [1.0, 2.0]], "angle": [1.0]}), "1-D array"),
        (dict(store=None), "store must be the name of a folder"),
        (dict(store=""), "store must be the name of a folder"),
    ],
)
def test_mistakes_are_sentences(tmp_path, changes, words):
    with pytest.raises((TypeError, ValueError), match=words):
        swept(**{"store": tmp_path / "store", **changes})
    assert not list(tmp_path.iterdir())


# ---- memory ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_first_look_stays_within_the_memory(tmp_path, monkeypatch):
    sizes, call = [], _job.Batches.__call__
    monkeypatch.setattr(_job.Batches, "__call__", lambda self, x: sizes.append(x["angle"].size) or call(self, x))
    over = {"length": np.linspace(0.5, 1.5, 64), "angle": np.linspace(0.0, 3.0, 64)}
    swept(tmp_path / "small", over)
    assert max(sizes) == 4096
    sizes.clear()
    monkeypatch.setattr(_begin, "UNIT_BYTES", 2**20)
    large = lambda trajectory: {"large": trajectory.q[-1] * jnp.ones(1000)}
    swept(tmp_path / "kept", over, keep=large, reduce={"large": lagjax.Statistics()})
    assert 64 < max(sizes) <= 2**20 / 8000
    sizes.clear()
    monkeypatch.setattr(_batch, "PATH_BYTES", 2**20)
    swept(tmp_path / "path", over, np.linspace(0.0, 2.0, 1000))
    assert 32 < max(sizes) <= 2**20 / 16000


def test_the_first_look_at_many_axes_is_as_small():
    over = {f"x{k}": [0.0, 1.0] for k in range(40)}
    points = _begin._sample_points(axes_of(over), None)
    assert 2048 < len(points["x0"]) <= 4096


# ---- stores that are begun -------------------------------------------------------------------------------------------


def test_of_several_who_make_a_store_the_first_one_stays(tmp_path):
    store = Files(tmp_path / "store")
    store.path.mkdir()  # an empty folder is nothing yet

    def make(aside, text):
        (aside.job).mkdir(parents=True)
        (aside.job / "spec.json").write_text(text)

    with store.create_aside() as second:
        with store.create_aside() as first:
            make(first, "first")
            assert not store.exists()
        assert store.exists()
        make(second, "second")
    assert (store.job / "spec.json").read_text() == "first" and os.listdir(tmp_path) == ["store"]
    with pytest.raises(KeyboardInterrupt), Files(tmp_path / "other").create_aside() as aside:
        make(aside, "half")
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == ["store"]
    gone = tmp_path / ".store.begun-1-abc"
    gone.mkdir()
    os.utime(gone, (0, 0))  # of a process that was killed
    with store.create_aside() as third:
        make(third, "third")
    assert (store.job / "spec.json").read_text() == "first" and os.listdir(tmp_path) == ["store"]


SCRIPT = """
import sys, time, numpy as np, jax, jax.numpy as jnp, lagjax
jax.config.update("jax_enable_x64", True)
system = lagjax.System(lambda q, qdot, params: 0.5 * params**2 * qdot**2 + 9.81 * params * jnp.cos(q))
while time.time() < float(sys.argv[2]):
    time.sleep(0.001)
run = lagjax.sweep(
    system, {"length": np.linspace(0.5, 1.5, 6), "angle": np.linspace(0.0, 3.0, 7)}, jnp.linspace(0.0, 2.0, 5),
    q0=lambda point: point["angle"], qdot0=0.0, params=lambda point: point["length"], progress=False,
    keep=lambda trajectory: {"end": trajectory.q[-1]}, store=lagjax.Store(sys.argv[1], 7),
)
assert run.status().done == 42 and not run.damaged()
"""


@pytest.mark.slow
def test_two_that_begin_a_store_at_the_same_moment_and_compute_the_same_units(tmp_path):
    """Both write the same bits, which their records prove; the time is that of two processes that import JAX."""
    store, root = tmp_path / "Läufe und mehr" / "store.zarr", str(Path(lagjax.__file__).parents[1])
    command = [sys.executable, "-c", SCRIPT, str(store), str(time.time() + 6.0)]
    both = [subprocess.Popen(command, env=os.environ | {"PYTHONPATH": root}) for _ in range(2)]
    assert [one.wait(120) for one in both] == [0, 0] and os.listdir(store.parent) == ["store.zarr"]
    assert lagjax.Sweep(store).status().done == 42


# ---- stores that grow ------------------------------------------------------------------------------------------------


def drawn(count, seed=3, kind=lagjax.designs.random):
    return {("length", "angle"): kind(count, seed=seed, low=(0.5, 0.0), high=(1.5, 3.0))}


@pytest.mark.slow
def test_to_extend_a_design_reads_none_of_its_values(tmp_path, monkeypatch):
    monkeypatch.setattr("lagjax._sweep.compute_units", lambda *_: None)
    few = swept(tmp_path / "few", drawn(10**6), unit=10**5)
    monkeypatch.setattr(Files, "coordinates", lambda *_: pytest.fail("read values"))
    swept(tmp_path / "many", drawn(2 * 10**6), unit=10**5, extend=few.store)


@pytest.mark.slow
def test_a_store_goes_on_without_the_one_it_began_with(tmp_path):
    few = swept(tmp_path / "few", drawn(20), unit=10)
    many = swept(tmp_path / "many", drawn(40), unit=10, extend=few.store)
    os.rename(few.store, tmp_path / "elsewhere")
    (many.store / ".sweep" / "done" / "3.json").unlink()
    assert swept(tmp_path / "many", drawn(40), unit=10, extend=few.store).status().done == 40
    with pytest.warns(UserWarning, match="no member that is also in `over`.*seeds"):
        swept(tmp_path / "others", drawn(40, seed=4), extend=tmp_path / "elsewhere")


@pytest.mark.slow
def test_a_later_end_of_stores_that_were_moved(tmp_path):
    keep_end = lambda trajectory: {"end": trajectory.end}
    first = swept(tmp_path / "here" / "first", ts=TS[:3], keep=keep_end)
    rule = dict(ts=TS[2:], keep=keep_end, unit=7)
    swept(tmp_path / "here" / "rest", extend=first.store, **rule)
    os.rename(tmp_path / "here", tmp_path / "there")
    rest, record = tmp_path / "there" / "rest", tmp_path / "there" / "rest" / ".sweep" / "done"
    (record / "0.json").unlink()
    assert lagjax.__main__.main(["sweep", "run", str(rest), "--quiet"]) == 0
    (record / "0.json").unlink()
    assert swept(rest, extend=tmp_path / "there" / "first", **rule).status().done == 42
    os.rename(tmp_path / "there" / "first", tmp_path / "there" / "gone")  # its states were copied
    (record / "0.json").unlink()
    _job._open_job.cache_clear()
    assert lagjax.__main__.main(["sweep", "run", str(rest), "--quiet"]) == 0
