"""Each worked problem runs as a script and comes to the book's number; its picture stands in the gallery."""

import re
import runpy
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name, tmp_path, monkeypatch, **sizes):
    """What `examples/NAME.py` defines when it runs as a script in `tmp_path`, with other constants at its top."""
    source = (EXAMPLES / f"{name}.py").read_text()
    for constant, value in sizes.items():
        source, count = re.subn(rf"^{constant} = .*$", f"{constant} = {value}", source, flags=re.MULTILINE)
        assert count == 1, f"{name}.py has no constant {constant}"
    monkeypatch.chdir(tmp_path)
    scope = {"__name__": "__main__"}
    with plt.rc_context():
        exec(compile(source, f"{name}.py", "exec"), scope)
        plt.close("all")
    pictures = list((tmp_path / "out").glob(f"{name}*.png"))
    assert pictures and all(picture.read_bytes().startswith(b"\x89PNG") for picture in pictures)
    return scope


def test_mercurys_perihelion(tmp_path, monkeypatch):
    # A century is 43″; the next order in GM/c²a is 1e-7 of that. A step is good to 1e-13, an angle of 2600 to 1e-12 of
    # itself, which is 1e-9 in units of 2e-4, the advance in a century.
    scope = run("mercury_perihelion", tmp_path, monkeypatch, YEARS=20.0)
    assert scope["turns"] == 83
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-5)
    assert f"{scope['ours']:.2f}" == "42.98"


@pytest.mark.slow
def test_a_driven_pendulum_comes_to_its_strange_attractor(tmp_path, monkeypatch):
    scope = run("driven_pendulum", tmp_path, monkeypatch, MEMBERS=200, PERIODS=60)
    np.testing.assert_allclose(float(scope["spectrum"].sum()), scope["total"], rtol=1e-6)  # rtol 1e-9 over 500 units
    # Four motions of 5000 units of time scatter by 4 % each.
    assert abs(scope["ours"] - scope["book"]) < 0.012
    assert scope["batch"].ok.all() and scope["density"].sum() == 200 * 49  # nobody leaves the frame of the picture


@pytest.mark.slow
def test_a_charge_in_crossed_fields(tmp_path, monkeypatch):
    scope = run("crossed_fields", tmp_path, monkeypatch, CHARGES=8)
    # Machine code keeps 1e-9 a step of a circle of unit size, and is better than that by two digits.
    np.testing.assert_allclose([scope["ours"], scope["height"]], [scope["book"], scope["book_height"]], rtol=1e-9)
    np.testing.assert_allclose(scope["fan"].q[:, -1], [[3 * scope["drift"] * scope["turn"], 0.0]] * 8, atol=1e-9)


@pytest.mark.slow
def test_foucaults_pendulum(tmp_path, monkeypatch):
    scope = run("foucault", tmp_path, monkeypatch, HOURS=3.0)
    # A swing of 0.5 m on 67 m turns by 3a²/8l² = 2.1e-5 slower than an infinitely small one.
    np.testing.assert_allclose(scope["ours"] / scope["book"] - 1, -2.09e-5, atol=2e-6)


@pytest.mark.slow
def test_a_bead_on_a_rotating_hoop(tmp_path, monkeypatch):
    scope = run("bead_on_hoop", tmp_path, monkeypatch)
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-14)  # Newton's method, to round-off
    assert scope["error"] < 1e-12 and scope["frequency_error"] < 1e-12 and scope["stable"].all()


@pytest.mark.slow
def test_a_tumbling_cube(tmp_path, monkeypatch):
    scope = run("tumbling_cube", tmp_path, monkeypatch)
    q, qdot = scope["end"]
    quarters = q["turn"] / (np.pi / 2)
    np.testing.assert_allclose([q["y"], quarters], [0.5, round(quarters)], atol=1e-13)
    np.testing.assert_allclose(list(qdot.values()), 0.0, atol=1e-30)
    np.testing.assert_allclose(scope["weight"].sum(), scope["G"], rtol=1e-12)
    assert scope["still"] < 2.0 and scope["run"].ok and all(np.isfinite(x) for x in scope["slopes"].values())


@pytest.mark.slow
def test_a_sliding_wedge(tmp_path, monkeypatch):
    scope = run("sliding_wedge", tmp_path, monkeypatch)
    for name in ("x", "X"):
        np.testing.assert_allclose(scope["ours"][name], scope["book"][name], rtol=1e-14)
    np.testing.assert_allclose(scope["end"], scope["exact"], rtol=1e-11)  # a parabola: one step
    # t² = 2/|ẍ| with 1/|ẍ| = (M + m s²)/((M + m) g s c), of which ∂/∂M is m c/((M + m)² g s).
    M, m, alpha, end = scope["M"], scope["m"], scope["alpha"], scope["end"]
    slope = m / np.tan(alpha) / ((M + m) ** 2 * 9.81) / end
    np.testing.assert_allclose(scope["by_mass"], slope, rtol=1e-9)


@pytest.mark.slow
def test_a_cylinder_rolls_and_flies_off(tmp_path, monkeypatch):
    scope = run("rolling_cylinder", tmp_path, monkeypatch)
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-9)  # rtol of a step is 1e-9
    assert (scope["runs"].transitions.count == 1).all() and (np.diff(scope["ours"]) > 0).all()


@pytest.mark.slow
def test_a_spring_pendulum_in_resonance(tmp_path, monkeypatch):
    scope = run("spring_pendulum", tmp_path, monkeypatch)
    # The last of two bounces has C = r₀/100; the growth differs from its limit by some C².
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=2e-4)
    share = scope["swinging"] / (scope["bouncing"] + scope["swinging"])
    assert share.max() > 0.99 and share[-1] < 0.1  # there and back


@pytest.mark.slow
def test_two_pendulums(tmp_path, monkeypatch):
    scope = run("double_pendulum_chaos", tmp_path, monkeypatch, NEIGHBOURS=4, DURATION=12.0)
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-13)
    np.testing.assert_allclose(scope["ratios"], [2**0.5, -(2**0.5)], rtol=1e-13)
    growth = np.log(scope["apart"][-1] / scope["apart"][0]) / 12.0
    assert abs(growth - scope["rate"]) < 0.15  # of 1.27, by the luck of where it begins and of its first tangent


@pytest.mark.slow
def test_a_symmetric_top_nods_and_sleeps(tmp_path, monkeypatch):
    scope = run("symmetric_top", tmp_path, monkeypatch)
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-8)  # rtol of a step is 1e-9
    # Exponents that grow are told from zero beyond 1e-7 of the largest, of which the spin is off by the square.
    np.testing.assert_allclose(scope["least"], scope["book_least"], rtol=1e-9)
    awake = np.asarray(scope["spins"]) < 5.5
    np.testing.assert_allclose(scope["lowest"][awake], scope["closed"][awake], rtol=2e-2)  # outputs each 0.02
    assert (scope["lowest"][~awake][3:] < 0.1).all()


@pytest.mark.slow
def test_the_restricted_problem_of_three_bodies(tmp_path, monkeypatch):
    scope = run("restricted_three_body", tmp_path, monkeypatch, ORBITS=20)
    np.testing.assert_allclose(scope["ours"], scope["book"], rtol=1e-12)
    np.testing.assert_allclose(scope["routh"], scope["book_routh"], rtol=1e-9)
    for orbits in scope["families"]:
        assert (orbits.closure < 1e-9).all() and orbits.period.size == 20
        assert np.all(np.diff(orbits.energy) > 0)


def test_every_worked_problem_has_its_picture():
    gallery, problems = (
        runpy.run_path(str(EXAMPLES / "gallery.py")),
        (EXAMPLES.parent / "docs" / "problems.md").read_text(),
    )
    assert sorted(path.stem for path in (EXAMPLES / "gallery").glob("*.png")) == sorted(gallery["NAMES"])
    for name in gallery["NAMES"]:
        picture = (EXAMPLES / "gallery" / f"{name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG") and 10_000 < len(picture) <= 120_000
        assert f'savefig("out/{name}.png")' in (EXAMPLES / f"{name}.py").read_text()
        assert f"`python examples/{name}.py`" in problems and f"examples/gallery/{name}.png" in problems


@pytest.mark.slow
def test_the_first_hour(tmp_path, monkeypatch, capsys):
    scope = run("first_hour", tmp_path, monkeypatch, SIDE=24)
    assert len(list((tmp_path / "out").glob("first_hour_*.png"))) == 4
    assert "write jnp.sum(v**2) and not" in " ".join(capsys.readouterr().out.split())
    assert scope["drift"] < 1e-14
    # From h = 1 the bead passes the lowest point with 5 g; outputs are 10 ms apart, 1 % of a swing.
    np.testing.assert_allclose(scope["force"].max(), 5 * 9.81, rtol=1e-2)
    # The map mirrored in y has the other two magnets.
    mirrored = np.array([0, 2, 1])[np.asarray(scope["nearest"])[::-1]]
    assert scope["batch"].ok.all() and np.mean(mirrored == scope["nearest"]) > 0.95
    # An amplitude of 0.01 lengthens the period by 0.01²/16.
    np.testing.assert_allclose([scope["time"], scope["slope"]], [scope["quarter"]] * 2, rtol=1e-5)
    # 361 frames with a noise of 0.01 tell the length to 4e-4 of itself, the friction to 3e-3 of itself.
    params = scope["fit"].params
    np.testing.assert_allclose(params["l"], 0.62, rtol=2e-3)
    np.testing.assert_allclose(params["c"], 0.02, rtol=2e-2)


@pytest.mark.slow
def test_a_chain_of_springs_returns(tmp_path, monkeypatch):
    scope = run("fput", tmp_path, monkeypatch, SPRINGS=64, MODE=2)
    # Zabusky's formula is a fit with one digit or two.
    np.testing.assert_allclose(scope["back"], scope["book"], rtol=0.15)
    assert scope["shares"][scope["back"], 1] > 0.8 and scope["shares"][:, 1].min() < 0.05
    assert scope["drift"] < 1e-5  # steps of 1e-7, some 10⁴ of them


@pytest.mark.slow
def test_kinks_and_breathers(tmp_path, monkeypatch):
    scope = run("sine_gordon", tmp_path, monkeypatch, SITES=(512, 1024))
    # The error is c h² + O(h⁴), at h = 3/32 and 3/64: the exponent is off by some 15 h² of a breather.
    assert abs(scope["orders"][0] - 2) < 0.2 and scope["errors"][1] < 0.02


@pytest.mark.slow
def test_a_membrane_is_struck(tmp_path, monkeypatch):
    scope = run("membrane", tmp_path, monkeypatch, SIDE=16, DURATION=200)
    np.testing.assert_allclose(scope["motion"].q[-1], scope["exact"], atol=1e-7)  # 1e-9 a step, some hundred of them
    np.testing.assert_allclose(scope["ours"], scope["lowest"], rtol=1e-12)


@pytest.mark.slow
def test_a_net_falls(tmp_path, monkeypatch):
    scope = run("net", tmp_path, monkeypatch, KNOTS=6, DURATION=0.3)
    assert scope["stretch"] < 1e-10
    np.testing.assert_allclose(scope["energy"], scope["energy"][0], atol=1e-5 * scope["fallen"])
