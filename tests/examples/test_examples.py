"""The examples run, write their pictures, and find what they claim to find."""

import importlib
import shutil
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
import pytest

from lagjax.scenes import de421

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def examples_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))


def assert_pictures(paths, folder, count):
    assert len(paths) == count
    for path in paths:
        assert path.parent == folder and path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


@pytest.mark.slow
def test_solar_system(tmp_path, capsys):
    pictures, relativistic, newtonian = importlib.import_module("solar_system").main(["--out", str(tmp_path)])
    assert_pictures(pictures, tmp_path, 2)
    mercury = de421.BODIES.index("mercury")
    assert relativistic[365.25][mercury] < 0.2 and newtonian[365.25][mercury] > 100
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("mercury"))
    assert float(row.split()[-2]) < 0.2 and float(row.split()[-1]) > 100


@pytest.mark.slow
def test_double_pendulum(tmp_path, capsys):
    sizes = ["--members", "8", "--duration", "2", "--resolution", "7"]
    pictures = importlib.import_module("double_pendulum").main([*sizes, "--out", str(tmp_path)])
    assert_pictures(pictures, tmp_path, 4)
    printed = capsys.readouterr().out
    assert "8 reached the end" in printed and "default: Taylor (machine code)" in printed and "; 0 of the " in printed


@pytest.mark.slow
def test_flip_map_is_symmetric_and_empty_where_pendulums_hang_low():
    _, times = importlib.import_module("double_pendulum").flip_times(7, 2.0)
    np.testing.assert_array_equal(times, times[::-1, ::-1])
    assert 0 < np.isfinite(times).sum() < times.size and np.nanmin(times) > 0 and np.nanmax(times) < 2
    assert np.isnan(times[2:5, 2:5]).all()


def test_tour(tmp_path, monkeypatch, capsys):
    tour = importlib.import_module("tour")
    calls = []
    monkeypatch.setattr(tour.solar_system, "main", lambda argv: (calls.append(argv) or [tmp_path / "a.png"], {}, {}))
    monkeypatch.setattr(tour.double_pendulum, "main", lambda argv: calls.append(argv) or [tmp_path / "b.png"])
    assert tour.main(tmp_path) == [tmp_path / "a.png", tmp_path / "b.png"]
    assert all(argv[:2] == ["--out", str(tmp_path)] for argv in calls) and len(calls) == 2
    assert str(tmp_path) in capsys.readouterr().out


def test_equations_are_printed_and_run_in_c(capsys):
    importlib.import_module("equations")
    printed = capsys.readouterr().out
    assert "M[q0, q1] = m2*l1*l2*cos(q0 - q1)" in printed
    if shutil.which("cc"):
        assert float(printed.split()[-1]) < 1e-9  # the step is 1 ms, of order 4


TOSSES = Path(__file__).parents[3] / "shared" / "data" / "cube_tosses_identification.npz"


@pytest.mark.slow
def test_a_cube_comes_to_rest_on_a_face(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = importlib.import_module("cube").main([])
    np.testing.assert_allclose(run.q["place"][-1, 2], 1.0, atol=1e-12)
    np.testing.assert_allclose(run.qdot["place"][-1], 0.0, atol=1e-12)
    assert (tmp_path / "out" / "cube.gif").exists()
    assert_pictures([tmp_path / "out" / "cube.png"], tmp_path / "out", 1)


@pytest.mark.slow  # five recorded tosses by each of 32 laws, whose corners strike ten times each
@pytest.mark.skipif(not TOSSES.exists(), reason="the recorded tosses are not here")
def test_recorded_tosses_of_a_cube(tmp_path, monkeypatch, capsys):
    """Half a side and 20° would be those of another face in a third of the tosses."""
    monkeypatch.chdir(tmp_path)
    with np.load(TOSSES) as data:
        few = int(data["lengths"][:8].sum())
        np.savez(tmp_path / "few.npz", states=data["states"][:few], lengths=data["lengths"][:8])
    laws, off = importlib.import_module("cube").main(
        [str(TOSSES), "--tosses", "5", "--follow", str(tmp_path / "few.npz")]
    )
    assert 0.1 < laws["friction"] < 0.25 and abs(laws["height"]) < 0.05
    place, angle = off["fitted"].medians()
    assert place < 0.5 and angle < 0.35 and np.isfinite(off["fitted"].place).all()
    assert capsys.readouterr().out.splitlines()[-1].startswith("followed: 8 tosses, place ")
    assert_pictures([tmp_path / "out" / "cube_followed.png"], tmp_path / "out", 1)
