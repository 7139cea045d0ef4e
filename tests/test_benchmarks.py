"""The benchmarks run and mean what they say. Nothing here depends on how fast anything is."""

import importlib
import json
from pathlib import Path

import jax
import numpy as np
import pytest

TOLERANCES = (1e-4, 1e-8)


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent))


def of_benchmarks(name):
    return importlib.import_module(f"benchmarks.{name}")


@pytest.fixture
def record(tmp_path):
    """A run of the main comparison by the command line, as small as can be: what was written to the file."""
    main = of_benchmarks("__main__").main

    def run(contender):
        arguments = ["--only", "errors", "--cases", "double_pendulum", "--contenders", contender, "--batch", "4"]
        arguments += ["--duration", "0.5", "--repeats", "1", "--output", str(tmp_path), "--tolerances"]
        main([*arguments, *map(str, TOLERANCES)])
        return json.loads((tmp_path / "results.json").read_text())

    return run


CONTENDERS = {
    "lagjax": (),
    "lagjax, in jit": (),
    "diffrax, by hand": (),
    "diffrax, autodiff": (),
    "heyoka, SIMD": ("heyoka",),
    "heyoka, threads": ("heyoka",),
    "heyoka, single": ("heyoka",),
    "SciPy + SymPy": ("scipy", "sympy"),
}


@pytest.mark.parametrize(("contender", "packages"), CONTENDERS.items())
def test_error_against_time(record, tmp_path, contender, packages):
    for package in packages:
        pytest.importorskip(package, reason=f"{contender} needs {package}")
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    written = record(contender)
    (comparison,) = written["errors"]
    assert not comparison["absent"]
    loose, tight = comparison["rows"]
    assert (loose["tol"], tight["tol"]) == TOLERANCES
    assert tight["median_error"] < loose["median_error"] < 1e-3
    assert tight["median_error"] < 1e-7
    assert loose["members"] == 4 and loose["seconds"] > 0
    assert comparison["reference_error"] < 1e-10
    circumstances = written["circumstances"]
    assert {"commit", "dirty", "versions", "machine", "date"} <= circumstances.keys()
    assert {"jax", "diffrax", "numpy"} <= circumstances["versions"].keys()
    assert circumstances["machine"]["cpu"] and circumstances["machine"]["cores"] >= 1


def test_figure(tmp_path):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    measure = of_benchmarks("_measure")
    rows = [measure.Row("lagjax", tol, 4, 0.0, tol, tol, [1.0 / tol]) for tol in TOLERANCES]
    comparison = measure.Comparison("anything", 4, 2, 1.0, 1e-15, rows, {})
    assert of_benchmarks("_report").draw(comparison, tmp_path / "anything.png")
    assert (tmp_path / "anything.png").stat().st_size > 1000


CASES = ("double_pendulum", "chain_4", "wedge", "kepler", "outer_planets", "fermi_pasta_ulam", "spherical_pendulum")


@pytest.mark.parametrize("name", CASES)
def test_the_three_forms_of_a_scene_agree(name):
    case = of_benchmarks("_cases").CASES[name](3)
    rng = np.random.default_rng(0)
    rates = case.qdot0 + 0.1 * np.abs(case.qdot0).max() * rng.uniform(-1, 1, case.qdot0.shape)
    autodiff = of_benchmarks("_contenders").autodiff_acceleration(case)
    by_hand = of_benchmarks("_contenders").by_hand(case)
    for q, v in zip(case.q0, rates, strict=True):
        np.testing.assert_allclose(case.symbolic(np, list(q), list(v)), float(case.lagrangian(q, v)), rtol=1e-10)
        derived = np.asarray(jax.jit(autodiff)(q, v))
        np.testing.assert_allclose(np.asarray(by_hand(q, v)), derived, atol=1e-11 * np.abs(derived).max())


def test_time_at_equal_error():
    measure = of_benchmarks("_measure")
    rows = [measure.Row("x", 0.0, 1, 0.0, error, error, [time]) for error, time in [(1e-4, 1.0), (1e-8, 4.0)]]
    assert measure.at_equal_error(rows, 1e-6) == (pytest.approx(2.0), False)  # halfway on log-log axes
    assert measure.at_equal_error(rows, 1e-2) == (1.0, True)  # more accurate than asked for, at this cost
    assert measure.at_equal_error(rows, 1e-10) is None  # nothing is extrapolated
    slow_and_bad = measure.Row("x", 0.0, 1, 0.0, 1e-5, 1e-5, [100.0])
    assert measure.at_equal_error([*rows, slow_and_bad], 1e-6) == (pytest.approx(2.0), False)
    assert measure.at_equal_error([measure.Row("x", 0.0, 1, 0.0, np.inf, np.inf, [1.0])], 1.0) is None


def test_reference_without_heyoka(monkeypatch):
    pytest.importorskip("scipy", reason="the reference without heyoka is SciPy's DOP853")
    contenders = of_benchmarks("_contenders")
    case = of_benchmarks("_cases").wedge(2)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        contenders.importlib.util, "find_spec", lambda name: None if name == "heyoka" else find_spec(name)
    )
    truth, check = contenders.reference(case)
    constant = np.stack(case.acceleration(case.q0.T, case.qdot0.T), axis=1)
    exact = case.q0 + case.qdot0 * case.duration + 0.5 * constant * case.duration**2
    np.testing.assert_allclose(truth[:, :2], exact, rtol=1e-11)
    np.testing.assert_allclose(check, truth, rtol=1e-11)
