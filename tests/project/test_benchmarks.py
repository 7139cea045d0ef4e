"""The benchmarks run and mean what they say. Nothing here depends on how fast anything is."""

import importlib
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from sweeps import sweep

import lagjax

TOLERANCES = (1e-4, 1e-8)


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


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
        return of_benchmarks("_report").read_json(tmp_path / "results.json")["errors"]

    return run


CONTENDERS = {
    "lagjax": (),
    "lagjax, diffrax": (),
    "diffrax, by hand": (),
    "diffrax, autodiff": (),
    "heyoka, SIMD": ("heyoka",),
    "heyoka, threads": ("heyoka",),
    "heyoka, single": ("heyoka",),
    "gradsolve": ("gradsolve", "warp"),
    "numba": ("numba", "scipy"),
    "MuJoCo": ("mujoco",),
    "SciPy + SymPy": ("scipy", "sympy"),
}


@pytest.mark.parametrize(("contender", "packages"), sweep(CONTENDERS.items(), kept=()))
def test_error_against_time(record, tmp_path, contender, packages):
    for package in packages:
        pytest.importorskip(package, reason=f"{contender} needs {package}")
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    written = record(contender)
    (comparison,) = written["rows"]
    assert not comparison["absent"]
    loose, tight = comparison["rows"]
    assert (loose["tol"], tight["tol"]) == TOLERANCES
    assert tight["median_error"] < loose["median_error"] < 1e-3
    assert tight["median_error"] < 1e-7
    assert comparison["batch"] == 4 and loose["seconds"] > 0 and loose["worst_error"] >= loose["median_error"]
    assert comparison["reference_error"] < 1e-10
    circumstances = written["circumstances"]
    assert {"commit", "dirty", "versions", "machine", "date"} <= circumstances.keys()
    assert {"jax", "diffrax", "numpy"} <= circumstances["versions"].keys()
    assert circumstances["machine"]["cpu"] and circumstances["machine"]["cores"] >= 1


@pytest.mark.slow
def test_one_trajectory_after_the_other():
    contenders, measure = of_benchmarks("_contenders"), of_benchmarks("_measure")
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    case = of_benchmarks("_cases").double_pendulum(2)
    single = [contender for contender in contenders.SINGLE if "lagjax" in contender.name]
    for row in measure.compare(replace(case, duration=0.5), single, [1e-8], repeats=1).rows:
        assert row.members == 2 and row.worst_error < 1e-6


OPTIONS = SimpleNamespace(
    batch=4,
    links=2,
    duration=0.2,
    repeats=1,
    budget=1e3,
    tolerances=[1e-6, 1e-10],
    cases=["wedge"],
    contenders=None,
    device="cpu",
)


@pytest.fixture
def lagjax_alone(monkeypatch):
    """The parts that measure series, without peers."""
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    comparisons = of_benchmarks("_comparisons")
    ours = of_benchmarks("_contenders").named("lagjax")
    monkeypatch.setattr(comparisons, "named", lambda *names: list(ours))
    return comparisons


@pytest.mark.slow
def test_batches(lagjax_alone):
    rows = lagjax_alone.batches(OPTIONS)
    assert [row["batch"] for row in rows] == [1, 10, 100, 1000]
    assert all(row["median error"] < 1e-7 and row["µs/step"] < row["µs/trajectory"] for row in rows)


@pytest.mark.slow
def test_sizes():
    """Two links, three and five bodies: all peers that are here agree with DOP853 on equations of another hand."""
    pytest.importorskip("scipy", reason="the reference needs SciPy")
    rows = of_benchmarks("_sizes").sizes(OPTIONS)
    assert {(row["family"], row["size"]) for row in rows} == {("chain", 2), ("bodies", 3), ("bodies", 5)}
    assert {"lagjax", "diffrax, by hand"} <= {row["contender"] for row in rows}
    assert all(row["median error"] < 100 * row["tol"] + 1e-10 for row in rows)


@pytest.mark.slow
def test_first_results():
    done = of_benchmarks("_sizes")._in_new_process("bodies 4", 200.0)
    assert all(done[f"{what} s"] > 0 for what in of_benchmarks("_sizes").WHAT)
    late = of_benchmarks("_sizes")._in_new_process("bodies 4", 1e-3)
    assert late["first result s"] is None


@pytest.mark.slow
def test_latency(monkeypatch):
    latency = of_benchmarks("_latency")
    monkeypatch.setattr(latency, "CALLS", 1)
    rows = {row["way"]: row["µs"] for row in latency.latency(OPTIONS)}
    assert min(rows.values()) > 0 and {"machine code", "lagjax, jit", "lagjax, no jit"} <= rows.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "bicycle", "bricard", "charges"])
def test_machines_move_as_their_laws_say(name):
    """Energy and constraints over half a unit of time; the beam and the families are checked by their peers."""
    system, q, qdot, params = of_benchmarks("_large").scene_of(name)
    health = lagjax.simulate(system, q, qdot, np.linspace(0.0, 0.5, 21), params).health()
    assert not health.findings(), health


@pytest.mark.slow
def test_a_series_ends_with_a_reason(lagjax_alone, capsys):
    rows = lagjax_alone.batches(SimpleNamespace(**vars(OPTIONS) | {"budget": 1e-9}))
    assert [row["batch"] for row in rows] == [1]
    assert "lagjax ends with 1 members of double_pendulum" in capsys.readouterr().out


@pytest.mark.slow
def test_cores(lagjax_alone):
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system does not confine a thread to a core")
    before = os.sched_getaffinity(0)
    rows = lagjax_alone.cores(OPTIONS)
    assert os.sched_getaffinity(0) == before
    assert [row["cores"] for row in rows if row["case"] == "chain_8"][-1] == len(before)
    assert all(row["times faster than one"] == 1 for row in rows if row["cores"] == 1)


def test_right_hand_sides():
    (row,) = of_benchmarks("_comparisons").right_hand_sides(OPTIONS)
    assert row["case"] == "wedge" and row["lagjax/by hand"] > 0 and row["autodiff/lagjax"] > 0


@pytest.mark.slow
def test_first_result_of_a_new_process():
    derivation = of_benchmarks("_derivation")
    found = derivation._in_new_process("lagjax", 2, budget=60)
    assert found["first result s"] > found["second s"] > 0
    assert all(stage > 0 for stage in derivation._stages(of_benchmarks("_cases").chain(2, 1)))


@pytest.mark.slow
def test_gradient():
    gradient = of_benchmarks("_gradient")
    case = replace(of_benchmarks("_cases").chain(2, 3), duration=1.0)
    row, derivative = gradient._measured("lagjax", gradient._with_lagjax(case, 1e-9), 1e-9, case, OPTIONS)
    assert derivative.shape == (3, 8) and row["largest"] < 1e-8 and row["steps"] > 5


@pytest.mark.slow
def test_mixed():
    mixed = of_benchmarks("_mixed")
    comparison = next(iter(mixed.mixed(SimpleNamespace(**vars(OPTIONS) | {"batch": 64}))))
    assert mixed.waiting(comparison) > 2
    assert {row.contender for row in comparison.rows} == set(mixed.CONTENDERS)
    assert all(row.median_error < 1e-4 for row in comparison.rows if row.tol == 1e-10)


@pytest.mark.parametrize(
    ("name", "alone"),
    sweep([("pendulum", False), ("rolling_cylinder", False), ("pendulum", True)], kept=[("pendulum", False)]),
)
def test_the_price_of_constraints(name, alone):
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    constraints = of_benchmarks("_constraints")
    pair = constraints.PAIRS[name](8).of_duration(0.2)
    pair = replace(pair, minimal=None) if alone else pair  # as the squeezer, for which there is no minimal form
    comparison = constraints.compared(pair, OPTIONS)
    names = [constraints.HELD] if alone else [constraints.HELD, constraints.MINIMAL]
    assert list(dict.fromkeys(row.contender for row in comparison.rows)) == names
    assert all(row.worst_error < 1e-8 for row in comparison.rows if row.tol == 1e-10)
    row = comparison.as_dict() | {"equal_error": of_benchmarks("_report").equal_error(comparison)}
    assert all(times > 0 for times in constraints.price(row).values())


def test_chains_of_rods_start_where_the_angles_say():
    pair = of_benchmarks("_constraints").PAIRS["chain_4"](3)
    rates = np.random.default_rng(0).normal(size=(3, 4))
    q, v = (x.reshape(3, 4, 2) for x in pair.carried(pair.minimal.q0, rates))
    along, moving = (np.diff(x, axis=1, prepend=0.0) for x in (q, v))
    np.testing.assert_allclose(np.linalg.norm(along, axis=-1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(np.arctan2(along[..., 0], -along[..., 1]), pair.minimal.q0, rtol=1e-12)
    np.testing.assert_allclose(along[..., 1] * moving[..., 0] - along[..., 0] * moving[..., 1], -rates, rtol=1e-12)


def comparison_of(times):
    """Programs with straight lines in the figure of errors against times; the record as it is stored."""
    measure, report = of_benchmarks("_measure"), of_benchmarks("_report")
    rows = [
        measure.Row(name, tol, 4, 0.0, tol, tol, [4 * time * scale * slower for scale in (1.0, 3.0, 2.0)], 10.0, 12)
        for name, time in times.items()
        for tol, slower in ((1e-4, 1.0), (1e-12, 2.0))
    ]
    comparison = measure.Comparison("double_pendulum", 4, 2, 1.0, 1e-15, rows, {})
    return {"rows": [comparison.as_dict() | {"equal_error": report.equal_error(comparison)}]}


def test_a_stored_record_is_small_and_reads_back(tmp_path):
    report = of_benchmarks("_report")
    here, there = ({"date": day} | {key: value for key, value in report.circumstances().items() if key != "date"}
                   for day in ("today", "yesterday"))  # fmt: skip
    rows = [{"case": "a", "error": 0.125, "best": None}, {"case": "b", "error": 2.0, "best": "numba"}]
    record = {"one": {"circumstances": here, "rows": rows}, "two": {"circumstances": there, "rows": rows[:1]}}
    path = tmp_path / "record.json"
    report.write_json(path, record)
    text = path.read_text()
    assert text.count('"versions"') == 1 and text.count('"error"') == 2  # one machine; one table, and one row alone
    found = report.read_json(path)
    for part, origin in (("one", here), ("two", there)):
        assert found[part]["circumstances"] == origin | {"load": found[part]["circumstances"]["load"]}
        assert found[part]["rows"] == record[part]["rows"]
    report.write_json(path, {"part": {"error": np.float64(1.23456), "lost": np.nan}})
    assert report.read_json(path) == {"part": {"error": 1.23, "lost": None}}


def test_a_stored_picture_is_small(tmp_path, monkeypatch):
    image = pytest.importorskip("PIL.Image", reason="pictures are written by it")
    figures, rng = of_benchmarks("_figures"), np.random.default_rng(0)
    monkeypatch.setattr(figures, "LARGEST_PICTURE", 8000)  # of 100 × 100 pixels 256 colours take 10 000 bytes
    noise = image.fromarray(rng.integers(0, 256, (100, 100, 3), dtype=np.uint8))
    figures.write_picture(noise, tmp_path / "noise.png")
    assert (tmp_path / "noise.png").stat().st_size <= 8000
    plain = image.fromarray(np.repeat(np.arange(200, dtype=np.uint8), 3 * 200).reshape(200, 200, 3))
    figures.write_picture(plain, tmp_path / "plain.png")
    assert len(image.open(tmp_path / "plain.png").convert("RGB").getcolors(1 << 16)) == 200


@pytest.mark.slow
def test_parts_that_were_not_run_again_are_kept(tmp_path):
    pytest.importorskip("scipy", reason="the reference needs SciPy or heyoka")
    main = of_benchmarks("__main__").main
    of_benchmarks("_report").write_json(tmp_path / "results.json", {"errors": comparison_of({"lagjax": 1.0})})
    tiny = ["--cases", "wedge", "--contenders", "lagjax", "--batch", "2", "--repeats", "1", "--tolerances", "1e-6"]
    for _ in range(2):
        record = main(["--only", "errors", *tiny, "--output", str(tmp_path)])
    assert [row["case"] for row in record["errors"]["rows"]] == ["double_pendulum", "wedge"]
    assert record["errors"]["rows"][1]["circumstances"]["versions"]


SERIES = [{"contender": name, "x": x, "y": x} for name in ("lagjax", "numba") for x in (1, 10)]
RECORD = {
    "sizes": [
        {"family": family, "size": r["x"], "tol": 1e-9, "µs/trajectory": r["y"], **r}
        for r in SERIES
        for family in ("chain", "bodies")
    ],
    "first_results": [{"scene": "arm", "first result s": 2.0, "first gradient s": None, "check s": 0.1}],
    "latency": [{"way": "machine code", "µs": 50.0}, {"way": "lagjax, jit", "µs": 80.0}],
    "batches": [{"batch": r["x"], "µs/trajectory": r["y"], **r} for r in SERIES],
    "derivation": [{"links": r["x"], "first result s": r["y"], **r} for r in SERIES],
    "cores": [{"case": "chain_8", "cores": r["x"], "times faster than one": r["y"], **r} for r in SERIES],
    "right_hand_sides": [{"case": "wedge", "lagjax ns": 1.0, "by hand ns": None, "autodiff ns": 9.0}],
    "gradient": [{"contender": "lagjax", "tol": 1e-9, "steps": 500.0, "reverse/solve": 3.0, "forward/solve": 4.0}],
}


@pytest.mark.parametrize(
    "part", sweep(["errors", "mixed", "constraints", *RECORD], kept=["errors", "sizes", "latency"])
)
def test_figure(tmp_path, part):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    record = {part: {"rows": RECORD[part]} if part in RECORD else comparison_of({"lagjax": 1.0, "numba": 1.01})}
    (path,) = of_benchmarks("_figures").draw(part, record, tmp_path)
    assert path.stat().st_size > 1000


def test_names_beside_lines_do_not_overlap():
    places = of_benchmarks("_figures")._apart(np.array([0.5, 0.1, 0.52, 0.49]), gap=0.1)
    assert np.diff(np.sort(places)).min() > 0.1 - 1e-12
    assert places[1] == 0.1 and places[2] > places[0] > places[3]


CASES = ("double_pendulum", "chain_4", "wedge", "kepler", "outer_planets", "fermi_pasta_ulam", "spherical_pendulum")


@pytest.mark.parametrize("name", sweep(CASES, kept=["double_pendulum", "wedge", "kepler"]))
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


FRESH = lagjax.System(lambda q, v, params: 0.5 * v**2 - params["emitted"] * q**2)  # nobody has its kernel yet


def test_a_change_of_emitted_text_is_seen(tmp_path, monkeypatch, capsys):
    emitted = of_benchmarks("emitted")
    monkeypatch.setattr(emitted, "scenes", lambda: {"fresh": (FRESH, 1.0, 0.0, {"emitted": 0.7})})
    monkeypatch.setattr(emitted, "FORMS", (emitted.motion,))
    found = emitted.texts()
    for name, text in found.items():
        (tmp_path / name).write_text(text)
    assert found and emitted.compare(found, tmp_path) == 0
    first = min(found)
    (tmp_path / first).write_text(found[first].replace("fmul", "fadd", 1))
    assert emitted.compare(found, tmp_path) == 1 and f"{first}: " in capsys.readouterr().out
