"""`lagjax.plot`: every function draws what it is given, into the axes it is given, and leaves the rest alone."""

import sys

import matplotlib

matplotlib.use("agg")

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from lagrangians import oscillator
from matplotlib.axes import Axes

import lagjax
import lagjax.plot

SCENE = lagjax.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * q @ q)
TS = jnp.linspace(0.0, 5.0, 41)


@pytest.fixture(scope="module")
def single():
    return lagjax.simulate(SCENE, jnp.array([1.0, 0.0]), jnp.array([0.0, 0.5]), TS)


@pytest.fixture(scope="module")
def batch():
    q0 = jnp.linspace(0.5, 1.0, 80).reshape(40, 2).at[7].set(jnp.nan)
    return lagjax.simulate_batch(SCENE, q0, jnp.zeros((40, 2)), TS)


@pytest.fixture(autouse=True)
def closed_figures():
    settings = dict(matplotlib.rcParams)
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()
    plt.close("all")
    assert dict(matplotlib.rcParams) == settings


def test_coordinates_against_time(single, batch):
    ax = lagjax.plot.trajectory(single)
    assert isinstance(ax, Axes)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["q[0]", "q[1]"]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), single.q[:, 1])
    assert len(lagjax.plot.trajectory(batch, members=5).lines) == 5 * 2


def test_projection(single, batch):
    ax = lagjax.plot.trajectory(single, lambda q, qdot: (q[0], qdot[1]))
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.stack([single.q[:, 0], single.qdot[:, 1]], axis=1))
    assert len(lagjax.plot.trajectory(batch, lambda q, qdot: (q[0], q[1])).lines) == 30


def test_path(single):
    ax = lagjax.plot.path(single.q[:, 0], single.q[:, 1], values=TS, label="t [s]")
    assert len(ax.collections) == 1 and len(ax.figure.axes) == 2
    assert len(lagjax.plot.path(single.q[:, 0], single.q[:, 1], label="orbit").lines) == 1


def test_energy_error(single, batch):
    ax = lagjax.plot.energy_error(single)
    h = np.asarray(single.energy())
    expected = np.abs(h - h[0])[1:] / abs(h[0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), np.where(expected > 0, expected, np.nan))
    assert ax.get_yscale() == "log" and not ax.collections
    banded = lagjax.plot.energy_error(batch, scale=2.0)
    assert len(banded.collections) == 1 and np.nanmax(banded.lines[0].get_ydata()) < 1e-7


def test_energy_error_needs_a_scale_and_a_member():
    at_rest = lagjax.simulate(SCENE, jnp.zeros(2), jnp.zeros(2), TS)
    with pytest.raises(ValueError, match="scale="):
        lagjax.plot.energy_error(at_rest)
    failed = lagjax.simulate_batch(SCENE, jnp.full((2, 2), jnp.nan), jnp.zeros((2, 2)), TS)
    with pytest.raises(ValueError, match="None of the members"):
        lagjax.plot.energy_error(failed)


@pytest.mark.slow
def test_energy_of_members_that_an_event_ends():
    q0 = jnp.array([[1.0, 0.0], [0.9, 0.1]])
    ended = lagjax.simulate_batch(SCENE, q0, jnp.zeros((2, 2)), TS, event=lambda q, qdot: q[0] < 0.5)
    assert ended.ok.all()
    assert lagjax.plot.energy_error(ended).lines[0].get_xdata().max() < 2.0


@pytest.mark.slow
def test_work_precision():
    start, solvers = (jnp.array([1.0, 0.0]), jnp.array([0.0, 0.5])), {"default": None, "fifth order": diffrax.Tsit5()}
    result = lagjax.work_precision(SCENE, *start, TS, solvers=solvers, tolerances=[1e-5, 1e-8], repeats=1)
    ax = lagjax.plot.work_precision(result)
    assert [line.get_label() for line in ax.lines] == list(solvers)
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), [row.error for row in result.rows[:2]])
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log") and ax.get_xlim()[0] < result.reference_error


def test_state_map():
    values = np.arange(12.0).reshape(3, 4)
    values[1, 1] = np.nan
    ax = lagjax.plot.state_map(np.arange(4.0), np.arange(3.0), values, label="v")
    assert ax.images[0].get_extent() == [-0.5, 3.5, -0.5, 2.5] and ax.images[0].get_array().mask.sum() == 1
    with pytest.raises(ValueError, match=r"\(3, 4\); got \(4, 3\)"):
        lagjax.plot.state_map(np.arange(4.0), np.arange(3.0), values.T)


def test_draws_into_the_axes_it_is_given(single):
    _, ax = plt.subplots()
    before = plt.get_fignums()
    assert lagjax.plot.trajectory(single, ax=ax) is ax and lagjax.plot.energy_error(single, ax=ax) is ax
    assert plt.get_fignums() == before


def test_without_matplotlib_it_says_what_to_install(single, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install lagjax\[examples\]"):
        lagjax.plot.trajectory(single)


def test_phase_portraits_by_name(single, batch):
    ax = lagjax.plot.phase(single, "q[1]")
    curve = ax.lines[0].get_xydata()
    outputs = curve[:: (len(curve) - 1) // (len(TS) - 1)]
    np.testing.assert_array_equal(outputs, np.stack([single.q[:, 1], single.qdot[:, 1]], axis=1))
    # An ellipse of half axes 0.5; the rate of the cubic between outputs that are h = 1/8 apart is off by h³/72 √3.
    np.testing.assert_allclose(np.linalg.norm(curve, axis=1), 0.5, atol=0.5 * 0.125**3 / (72 * 3**0.5) + 1e-8)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q[1]", "qdot[1]") and ax.get_legend() is None
    assert len(lagjax.plot.phase(batch, members=5).lines) == 2 * (5 + 1)
    with pytest.raises(ValueError, match=r"no coordinate 'x'; there are q\[0\], q\[1\]"):
        lagjax.plot.phase(single, "x")


def test_of_many_coordinates_some_are_drawn_and_the_legend_says_so():
    chain = lagjax.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * jnp.sum(jnp.diff(q) ** 2))
    run = lagjax.simulate(chain, jnp.zeros(100).at[50].set(1.0), jnp.zeros(100), TS)
    for draw in (lagjax.plot.phase, lagjax.plot.trajectory):
        assert draw(run).get_legend().get_title().get_text() == "7 of 100 coordinates"
    ax = lagjax.plot.space_time(run)
    np.testing.assert_array_equal(ax.collections[0].get_array().reshape(100, len(TS)), run.q.T)
    assert ax.get_ylim() == (-0.5, 99.5)


def test_motions_and_data_are_compared(single, batch):
    ts = np.linspace(0.0, 5.0, 23)  # others than those of the motion
    above, below = lagjax.plot.compare(single, (ts, np.stack([np.cos(ts), np.full(23, np.nan)], axis=1)))
    assert above[0].get_title() == "q[0]" and below.shape == (2,)
    # h⁴/384 of the cubic between outputs that are h = 1/8 apart
    np.testing.assert_allclose(below[0].lines[0].get_ydata(), 0.0, atol=0.125**4 / 384 + 1e-8)
    _, below = lagjax.plot.compare(single, single, "q[1]")
    assert not below[0].lines[0].get_ydata().any()
    with pytest.raises(ValueError, match="1 numbers at a time, and q has 2"):
        lagjax.plot.compare(single, (ts, ts))
    with pytest.raises(ValueError, match="one motion, not a batch"):
        lagjax.plot.compare(batch, single)
    with pytest.raises(TypeError, match="must be a Trajectory, a Record, or a pair"):
        lagjax.plot.compare(single, ts)


def test_shapes_of_modes():
    scene = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q - 0.5 * (q[0] - q[1]) ** 2)
    modes = lagjax.normal_modes(scene, jnp.zeros(2))  # 1, in step, and √3, against each other
    axes = lagjax.plot.modes(modes)
    assert [ax.get_title() for ax in axes] == ["ω = 1", "ω = 1.732"]
    heights = [[bar.get_height() for bar in ax.patches] for ax in axes]
    np.testing.assert_allclose(np.abs(heights), 1.0, atol=1e-12)
    assert heights[0][0] * heights[0][1] > 0 > heights[1][0] * heights[1][1]

    def points(q):
        return jnp.stack([jnp.arange(2.0) + q, jnp.zeros(2)], axis=1)

    axes = lagjax.plot.modes(modes, points, jnp.zeros(2), largest=0.2, count=1)
    moved = [line.get_xdata() for line in axes[0].lines]
    np.testing.assert_allclose(moved[0], [0, 1])
    np.testing.assert_allclose(np.abs(moved[2] - moved[0]), 0.2, atol=1e-12)
    with pytest.raises(ValueError, match="give the equilibrium too"):
        lagjax.plot.modes(modes, points)


@pytest.mark.slow
def test_members_are_drawn_at_times_of_their_own():
    spring = lagjax.System(oscillator)
    ends, ts = jnp.arange(1.0, 4.0), jnp.linspace(0.0, 1.0, 9)
    runs = jax.vmap(lambda end: lagjax.simulate(spring, 1.0, 0.0, end * ts))(ends)
    ax = lagjax.plot.trajectory(runs)
    for line, times in zip(ax.lines, runs.ts, strict=True):
        np.testing.assert_array_equal(line.get_xdata(), times)
        np.testing.assert_allclose(line.get_ydata(), np.cos(times), atol=1e-8)
    assert ax.get_ylabel() == "q" and ax.get_legend() is None
    with pytest.raises(ValueError, match="times of their own"):
        lagjax.plot.energy_error(runs)


@pytest.mark.slow
def test_modes_tell_what_grows_and_are_drawn_at_their_largest():
    saddle = lagjax.System(lambda q, v: 0.5 * v @ v + 0.5 * q[0] ** 2 - 2 * q[1] ** 2)
    modes = lagjax.normal_modes(saddle, jnp.zeros(2))
    titles = [ax.get_title() for ax in lagjax.plot.modes(modes)]
    assert titles == ["grows as exp(1 t)", "ω = 2"]
    # The phase of a complex shape is anybody's choice: i times a shape is the shape.
    turned = eqx.tree_at(lambda m: m.shapes, modes, 1j * modes.shapes)
    for one, other in zip(lagjax.plot.modes(modes), lagjax.plot.modes(turned), strict=True):
        heights = [[bar.get_height() for bar in ax.patches] for ax in (one, other)]
        np.testing.assert_allclose(np.abs(heights[1]), np.abs(heights[0]), atol=1e-12)
    rubbing = lagjax.System(oscillator, dissipation=lambda q, v: 0.1 * v**2)
    assert lagjax.plot.modes(lagjax.normal_modes(rubbing, 0.0))[0].get_title() == "ω = 0.995, ζ = 0.1"


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda run: lagjax.plot.trajectory(SCENE), "must be what lagjax.simulate returns; got System"),
        (lambda run: lagjax.plot.phase(run, members=0), "members must be a whole number, one at least; got 0"),
        (lambda run: lagjax.plot.compare((run.ts, run.q), run), "one must be what lagjax.simulate returns; got tuple"),
        (lambda run: lagjax.plot.trajectory(run, lambda q, v: q[0]), "two numbers, .* for one state; got shapes"),
        (lambda run: lagjax.plot.energy_error(None), "got NoneType"),
        (lambda run: lagjax.plot.modes(run), "modes must be what lagjax.normal_modes returns; got Trajectory"),
        (lambda run: lagjax.plot.fit(run), "fit must be what lagjax.fit returns"),
        (lambda run: lagjax.plot.work_precision(run), "result must be what lagjax.work_precision returns"),
        (lambda run: lagjax.plot.state_map(np.zeros(1), np.zeros(3), np.zeros((3, 1))), "two columns and two rows"),
        (lambda run: jax.eval_shape(lambda r: lagjax.plot.phase(r) and 0, run), "call it outside of jit"),
        (lambda run: jax.eval_shape(lambda r: r.to_pandas() and 0, run), "copies numbers: call it outside of jit"),
    ],
)
def test_what_cannot_be_drawn_is_said_in_a_sentence(single, draw, said):
    with pytest.raises((TypeError, ValueError), match=said):
        draw(single)
