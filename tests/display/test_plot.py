"""`lagjax.plot`: every function draws what it is given, into the axes it is given, and leaves the rest alone."""

import sys

import matplotlib
from scenes import DAMPED_OSCILLATOR, OSCILLATOR, OSCILLATORS, RAMP

matplotlib.use("agg")

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes

import lagjax
import lagjax.plot

TS = np.linspace(0.0, 5.0, 41)


@pytest.fixture(scope="module")
def single():
    return lagjax.simulate(OSCILLATORS, jnp.array([1.0, 0.0]), jnp.array([0.0, 0.5]), TS)


@pytest.fixture(scope="module")
def batch():
    q0 = jnp.linspace(0.5, 1.0, 80).reshape(40, 2).at[7].set(jnp.nan)
    return lagjax.simulate_batch(OSCILLATORS, q0, jnp.zeros((40, 2)), TS)


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
    for line, expected in zip(ax.lines, (jnp.cos, lambda t: 0.5 * jnp.sin(t)), strict=True):
        t, q = line.get_data()
        assert len(t) >= 2400 and np.isin(TS, t).all()
        np.testing.assert_allclose(q, expected(t), atol=0.125**4 / 384 + 1e-8)  # of the cubic, with h = 1/8
    assert len(lagjax.plot.trajectory(batch, members=5).lines) == 5 * 2


def test_projection(single, batch):
    ax = lagjax.plot.trajectory(single, lambda q, qdot: (q[0], qdot[1]))
    x, y = ax.lines[0].get_xydata().T
    assert np.isin(single.q[:, 0], x).all()
    np.testing.assert_allclose(y, 0.5 * x, atol=1e-5)  # cos and cos / 2
    assert len(lagjax.plot.trajectory(batch, lambda q, qdot: (q[0], q[1])).lines) == 30


def test_path(single):
    ax = lagjax.plot.path(single, lambda q, qdot: (q[0], 2 * q[1]), values=TS, label="t [s]")
    assert len(ax.collections) == 1 and len(ax.figure.axes) == 2
    segments, t = np.array(ax.collections[0].get_segments()), ax.collections[0].get_array()
    expected = np.stack([np.cos(t), np.sin(t)], axis=1)
    np.testing.assert_allclose(segments.mean(axis=1), expected, atol=1e-5)
    (line,) = lagjax.plot.path(single.q[:, 0], single.q[:, 1], label="orbit").lines
    np.testing.assert_array_equal(line.get_xydata(), single.q)


SPEEDS, FALL = np.linspace(0.1, 1.3, 20), np.linspace(0.0, 2.2, 12)
CHAIN = lagjax.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * jnp.sum(jnp.diff(q) ** 2))
SADDLE = lagjax.System(lambda q, v: 0.5 * v @ v + 0.5 * q[0] ** 2 - 2 * q[1] ** 2)
COUPLED_PAIR = lagjax.System(lambda q, v: 0.5 * v @ v - 0.5 * q @ q - 0.5 * (q[0] - q[1]) ** 2)


@pytest.fixture(scope="module")
def balls():
    """Twenty balls that bounce at t = 1, 2 and, with restitution 1, never elsewhere; at x = 1 they reappear at −1."""
    flight = lagjax.System(lambda q, v: 0.5 * v @ v - q[1])
    bounce = lagjax.Transition(
        "f", "f", lambda q, v: q[1], -1, lambda q, v, params: (q, v * jnp.stack([jnp.ones(()), -params]))
    )
    around = lagjax.Transition("f", "f", lambda q, v: 1 - q[0], -1, lambda q, v: (q - jnp.array([2.0, 0.0]), v))

    @jax.jit
    def run(restitution):
        def one(speed):
            start = jnp.array([0.0, 0.5]), jnp.stack([speed, 0.0 * speed])
            return lagjax.simulate(
                lagjax.Hybrid({"f": flight}, [bounce, around], "f"), *start, FALL, restitution, max_transitions=6
            )

        return jax.vmap(one)(SPEEDS)

    return run


def _height(t):
    """Of a ball that falls from 1/2, with restitution 1/2: it bounces at 1 and 2."""
    since = np.where(t < 1, t, np.abs(t - 1.5))
    return np.where(
        t < 1, 0.5 * (1 - since**2), np.where(t < 2, 0.5 * (0.25 - since**2), (t - 2) / 4 - (t - 2) ** 2 / 2)
    )


def _smooth(line, most):
    """Whether the points of a line follow each other at this distance at most, but for gaps."""
    steps = np.linalg.norm(np.diff(np.asarray(line), axis=0), axis=1)
    return np.nanmax(steps) < most


def test_curves_reach_floors_and_jumps_are_gaps(balls):
    runs = balls(0.5)
    lines = [np.array(line.get_data()).T for line in lagjax.plot.trajectory(runs).lines]
    for speed, of_x, of_y in zip(SPEEDS, lines[:20], lines[20:], strict=True):
        np.testing.assert_allclose(of_y[:, 1], np.where(np.isnan(of_y[:, 1]), np.nan, _height(of_y[:, 0])), atol=1e-9)
        for bounce in (1.0, 2.0):  # between outputs or not, the floor is touched
            assert np.nanmin(np.abs(of_y - (bounce, 0.0)).max(axis=1)) < 1e-12
        turns = (of_x[:, 1] - speed * of_x[:, 0]) / 2
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
        assert _smooth(of_x, 0.01) and np.nanmax(of_x[:, 1]) <= 1 + 1e-12
    assert _smooth(lagjax.plot.phase(runs, "q[1]", members=1).lines[0].get_xydata(), 0.01)
    assert _smooth(lagjax.plot.trajectory(runs, lambda q, v: (q[0], q[1]), members=1).lines[0].get_xydata(), 0.01)


def test_films_of_bounces(balls):
    film = balls(0.5).animate(lambda q: {"floor": jnp.array([[-1.0, 0.0], [1.0, 0.0]]), "ball": q}, "ball", fps=7.0)
    times = np.linspace(0.0, 2.2, 23)  # of frames, two of them at bounces
    np.testing.assert_allclose(film.positions(times)["ball"][:, :, 0, 1], np.tile(_height(times), (20, 1)), atol=1e-9)
    for _, t, path in film._traces(film.times()):
        np.testing.assert_allclose(path[:, 1], np.where(np.isnan(path[:, 1]), np.nan, _height(t)), atol=1e-9)
        assert np.nanmin(np.abs(path[np.abs(t - 1) < 1e-6, 1])) < 1e-12 and _smooth(path, 0.1)
    figure, show, count = film._figure(7.0)
    show(count - 1)
    assert {len(line.get_xdata()): line.get_marker() for line in figure.axes[0].lines} == {1: "o", 2: ""}
    assert figure.axes[0].get_ylim()[0] < 0


def test_energy_that_is_lost_by_design_is_no_error(balls):
    labels = [lagjax.plot.energy_error(balls(restitution)).get_ylabel() for restitution in (1.0, 0.5)]
    assert labels == ["relative error of the energy", "relative change of the energy"]
    rubbing = DAMPED_OSCILLATOR
    ax = lagjax.plot.energy_error(lagjax.simulate(rubbing, 1.0, 0.0, TS))
    assert ax.get_ylabel() == "relative change of the energy"


def test_a_curve_ends_at_its_event():
    fall = RAMP
    run = lagjax.simulate(fall, 0.5, 0.0, np.linspace(0.0, 3.0, 4) * 0.7, event=lambda q, v: q)
    (line,) = lagjax.plot.trajectory(run).lines
    t, q = line.get_data()
    np.testing.assert_allclose(q, np.where(t <= 1 + 1e-12, 0.5 * (1 - t**2), np.nan), atol=1e-9)
    assert np.nanmin(q) < 1e-12


def test_only_figures_are_offered():
    offered = [name for name in dir(lagjax.plot) if not name.startswith("_")]
    assert offered == sorted(lagjax.plot.__all__) and all(callable(getattr(lagjax.plot, name)) for name in offered)
    assert not {"motion", "require_present", "split_by_constraint", "constraint_structure"} & set(dir(lagjax.System))


def test_energy_error(single, batch):
    ax = lagjax.plot.energy_error(single)
    h = np.asarray(single.energy())
    expected = np.abs(h - h[0])[1:] / abs(h[0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), np.where(expected > 0, expected, np.nan))
    assert ax.get_yscale() == "log" and not ax.collections and ax.get_ylabel() == "relative error of the energy"
    banded = lagjax.plot.energy_error(batch, scale=2.0)
    assert len(banded.collections) == 1 and np.nanmax(banded.lines[0].get_ydata()) < 1e-7


def test_energy_error_needs_a_scale_and_a_member():
    at_rest = lagjax.simulate(OSCILLATORS, np.zeros(2), np.zeros(2), TS)
    with pytest.raises(ValueError, match="scale="):
        lagjax.plot.energy_error(at_rest)
    failed = lagjax.simulate_batch(OSCILLATORS, np.full((2, 2), np.nan), np.zeros((2, 2)), TS)
    with pytest.raises(ValueError, match="None of the members"):
        lagjax.plot.energy_error(failed)


@pytest.mark.slow
def test_energy_of_members_that_an_event_ends():
    q0 = np.array([[1.0, 0.0], [0.9, 0.1]])
    ended = lagjax.simulate_batch(OSCILLATORS, q0, np.zeros((2, 2)), TS, event=lambda q, qdot: q[0] < 0.5)
    assert ended.ok.all()
    assert lagjax.plot.energy_error(ended).lines[0].get_xdata().max() < 2.0


@pytest.mark.slow
def test_work_precision():
    start, solvers = (np.array([1.0, 0.0]), np.array([0.0, 0.5])), {"default": None, "fifth order": diffrax.Tsit5()}
    result = lagjax.work_precision(OSCILLATORS, *start, TS, solvers=solvers, tolerances=[1e-5, 1e-8], repeats=1)
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
    assert np.isin(single.q[:, 1], curve[:, 0]).all() and np.isin(single.qdot[:, 1], curve[:, 1]).all()
    # An ellipse of half axes 0.5; the rate of the cubic between outputs that are h = 1/8 apart is off by h³/72 √3.
    np.testing.assert_allclose(np.linalg.norm(curve, axis=1), 0.5, atol=0.5 * 0.125**3 / (72 * 3**0.5) + 1e-8)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q[1]", "qdot[1]") and ax.get_legend() is None
    assert len(lagjax.plot.phase(batch, members=5).lines) == 2 * (5 + 1)
    with pytest.raises(ValueError, match=r"no coordinate 'x'; there are q\[0\], q\[1\]"):
        lagjax.plot.phase(single, "x")


def test_of_many_coordinates_some_are_drawn_and_the_legend_says_so():
    run = lagjax.simulate(CHAIN, jnp.zeros(100).at[50].set(1.0), jnp.zeros(100), TS)
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
    modes = lagjax.normal_modes(COUPLED_PAIR, np.zeros(2))  # 1, in step, and √3, against each other
    axes = lagjax.plot.modes(modes)
    assert [ax.get_title() for ax in axes] == ["ω = 1", "ω = 1.732"]
    heights = [[bar.get_height() for bar in ax.patches] for ax in axes]
    np.testing.assert_allclose(np.abs(heights), 1.0, atol=1e-12)
    assert heights[0][0] * heights[0][1] > 0 > heights[1][0] * heights[1][1]

    def points(q):
        return jnp.stack([jnp.arange(2.0) + q, jnp.zeros(2)], axis=1)

    axes = lagjax.plot.modes(modes, points, np.zeros(2), largest=0.2, count=1)
    moved = [line.get_xdata() for line in axes[0].lines]
    np.testing.assert_allclose(moved[0], [0, 1])
    np.testing.assert_allclose(np.abs(moved[2] - moved[0]), 0.2, atol=1e-12)
    with pytest.raises(ValueError, match="give the equilibrium too"):
        lagjax.plot.modes(modes, points)


@pytest.mark.slow
def test_members_are_drawn_at_times_of_their_own():
    spring = OSCILLATOR
    ends, ts = np.arange(1.0, 4.0), np.linspace(0.0, 1.0, 9)
    runs = jax.vmap(lambda end: lagjax.simulate(spring, 1.0, 0.0, end * ts))(ends)
    ax = lagjax.plot.trajectory(runs)
    for line, times in zip(ax.lines, runs.ts, strict=True):
        t, q = line.get_data()
        assert np.isin(times, t).all()
        np.testing.assert_allclose(q, np.cos(t), atol=(times[1] ** 4) / 384 + 1e-8)
    assert ax.get_ylabel() == "q" and ax.get_legend() is None
    with pytest.raises(ValueError, match="times of their own"):
        lagjax.plot.energy_error(runs)


@pytest.mark.slow
def test_modes_tell_what_grows_and_are_drawn_at_their_largest():
    modes = lagjax.normal_modes(SADDLE, np.zeros(2))
    titles = [ax.get_title() for ax in lagjax.plot.modes(modes)]
    assert titles == ["grows as exp(1 t)", "ω = 2"]
    # The phase of a complex shape is anybody's choice: i times a shape is the shape.
    turned = eqx.tree_at(lambda m: m.shapes, modes, 1j * modes.shapes)
    for one, other in zip(lagjax.plot.modes(modes), lagjax.plot.modes(turned), strict=True):
        heights = [[bar.get_height() for bar in ax.patches] for ax in (one, other)]
        np.testing.assert_allclose(np.abs(heights[1]), np.abs(heights[0]), atol=1e-12)
    rubbing = DAMPED_OSCILLATOR
    assert lagjax.plot.modes(lagjax.normal_modes(rubbing, 0.0))[0].get_title() == "ω = 0.995, ζ = 0.1"


def _driven_spring(q, v, params, t):
    return 0.5 * v**2 - 0.5 * q**2 + params["A"] * q * jnp.cos(params["w"] * t)


DRIVEN = lagjax.System(_driven_spring, dissipation=lambda q, v: 0.25 * v**2)
LIFTED = lagjax.System(
    lambda q, v: 0.5 * v @ v - q[0] - q[1],
    forces=lambda q, v, t: jnp.stack([t, 0.0 * t]),
    contacts=lambda q: {"floor": q[0], "lid": 5.0 - q[0], "step": q[1]},
)
STIFF = lagjax.System(lambda q, v: 0.5 * v**2 - 2 * q**2)
ROW = lagjax.System(lambda q, v: 0.5 * jnp.sum(v["u"] ** 2) + 0.5 * v["x"] ** 2)


def test_a_bifurcation_diagram_of_a_driven_spring():
    drives, rates = np.linspace(0.0, 2.0, 5), np.linspace(0.5, 2.0, 4)

    def seen(A, w):  # of A cos wt, once in a period
        return A * (1 - w**2) / ((1 - w**2) ** 2 + (0.5 * w) ** 2)

    start = dict(q0=1.0, params={"A": 0.0, "w": 2.0}, transient=20, points=3)
    ax = lagjax.plot.bifurcation(DRIVEN, {"A": drives}, np.pi, **start)
    x, y = ax.collections[0].get_offsets().T
    np.testing.assert_array_equal(x, np.repeat(drives, 3))
    np.testing.assert_allclose(y, seen(x, 2.0), atol=2e-7)  # exp(-0.25 * 21π) of the start is left
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("A", "q")
    start["params"] = lambda point: {"A": 2.0, "w": point["w"]}
    ax = lagjax.plot.bifurcation(
        DRIVEN,
        {"w": rates},
        lambda point: 2 * jnp.pi / point["w"],
        **start,
        value=lambda q, v: 10 * q,
        period=2 * np.pi,
    )
    x, y = ax.collections[0].get_offsets().T
    exact = 10 * seen(2.0, x)
    np.testing.assert_allclose(y, exact - 2 * np.pi * np.round(exact / (2 * np.pi)), atol=2e-5)


def test_points_that_are_known_make_a_bifurcation_diagram():
    drives, points = np.arange(3.0), np.array([[1.0, 2.0], [np.nan, 4.0], [5.0, 6.0]])
    ax = lagjax.plot.bifurcation(drives, points)
    np.testing.assert_array_equal(ax.collections[0].get_offsets(), [[0, 1], [0, 2], [1, 4], [2, 5], [2, 6]])
    assert len(lagjax.plot.bifurcation(drives, points[:, 0], ax=ax).collections) == 2
    first, second = (points.get_facecolor()[0] for points in ax.collections)
    assert (first != second).any()
    with pytest.raises(ValueError, match="No member has a finite point"):
        lagjax.plot.bifurcation(drives, np.nan * points)


@pytest.fixture(scope="module")
def rotor():
    """An angle that turns by −3 a second from 1, and a place that does not."""
    free = lagjax.System(lambda q, v: 0.5 * v["a"] ** 2 + 0.5 * v["x"] ** 2)
    return lagjax.simulate(free, {"a": 1.0, "x": 0.0}, {"a": -3.0, "x": 2.0}, TS)


def test_angles_leave_at_one_edge_and_come_in_at_the_other(rotor):
    ax = lagjax.plot.trajectory(rotor, period={"a": 2 * np.pi, "x": None})
    t, angle = ax.lines[0].get_data()
    known = np.isfinite(angle)
    assert np.abs(angle[known]).max() == np.pi and _smooth(np.stack([t, angle], axis=1), 0.02)
    turns = (angle[known] - (1.0 - 3.0 * t[known])) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    gaps = np.flatnonzero(~known)
    exact = (1 + np.pi * np.array([1, 3, 5])) / 3  # where 1 − 3t is an odd multiple of −π
    np.testing.assert_allclose(t[gaps - 1], exact[exact < 5], atol=1e-9)
    np.testing.assert_array_equal([angle[gaps - 1], angle[gaps + 1]], [[-np.pi] * len(gaps), [np.pi] * len(gaps)])
    np.testing.assert_allclose(ax.lines[1].get_ydata(), 2 * ax.lines[1].get_xdata(), atol=1e-9)
    for ax in (
        lagjax.plot.phase(rotor, "q['a']", period=2 * np.pi),
        lagjax.plot.trajectory(rotor, lambda q, v: (q["a"], v["a"]), period=2 * np.pi),
    ):
        assert np.nanmax(np.abs(ax.lines[0].get_xdata())) == np.pi
        assert np.isnan(ax.lines[0].get_xdata()).sum() == len(gaps)
        assert [label.get_text() for label in ax.get_xticklabels()] == ["−π", "−π/2", "0", "π/2", "π"]
    ax = lagjax.plot.trajectory(rotor, lambda q, v: (q["x"], q["a"]), period=(None, 90.0))
    np.testing.assert_array_equal(ax.get_yticks(), [-45.0, -22.5, 0.0, 22.5, 45.0])


def test_modes_and_closed_contacts_are_shaded():
    run = lagjax.simulate(LIFTED, np.array([0.0, 0.5]), np.zeros(2), np.linspace(0.0, 2.0, 11))
    ax = lagjax.plot.trajectory(run)  # the force is as large as the weight at t = 1, when the other has fallen by 1/2
    spans = {span.get_label(): span.get_bbox().extents for span in ax.patches}
    assert list(spans) == ["contacts['floor']", "contacts['step']"]
    np.testing.assert_allclose(spans["contacts['floor']"], [0.0, 0.0, 1.0, 0.04], atol=1e-9)
    np.testing.assert_allclose(spans["contacts['step']"], [1.0, 0.08, 2.0, 0.12], atol=1e-9)
    (mark,) = [line for line in ax.lines if line.get_label() == "impact['step']"]
    np.testing.assert_allclose(mark.get_xydata(), [[1.0, 0.1]], atol=1e-9)


def test_modes_are_shaded():
    modes = {"slow": OSCILLATOR, "fast": STIFF}
    there, back = (lagjax.Transition(*names, lambda q, v: q, 0) for names in (("slow", "fast"), ("fast", "slow")))
    run = lagjax.simulate(lagjax.Hybrid(modes, [there, back], "slow"), 1.0, 0.0, np.linspace(0.0, 4.0, 9))
    ax = lagjax.plot.trajectory(run)
    spans = [(span.get_label(), *span.get_bbox().intervalx) for span in ax.patches]
    quarters = np.pi * np.array([0.0, 0.5, 1.0])  # a quarter of a slow period, half a fast one
    assert [name for name, *_ in spans] == ["slow", "_", "fast"]
    np.testing.assert_allclose([first for _, first, _ in spans], quarters[[0, 2, 1]], atol=1e-9)
    np.testing.assert_allclose([last for *_, last in spans], [*quarters[[1]], 4.0, quarters[2]], atol=1e-9)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["q", "slow", "fast"]


def test_rows_of_a_lattice(rotor):
    start = {"u": np.zeros(9), "x": 0.0}, {"u": np.arange(9.0), "x": 1.0}
    run = lagjax.simulate(ROW, *start, TS)
    ax = lagjax.plot.space_time(run, "qdot['u']")
    np.testing.assert_array_equal(ax.collections[0].get_array().reshape(9, len(TS)), run.qdot["u"].T)
    ax = lagjax.plot.space_time(run, "q['u']", period=2 * np.pi)
    shown, turns = ax.collections[0].get_array().reshape(9, len(TS)), run.q["u"].T / (2 * np.pi)
    np.testing.assert_allclose(shown, 2 * np.pi * (turns - np.floor(turns + 0.5)), atol=1e-12)
    assert ax.collections[0].get_clim() == (-np.pi, np.pi)
    with pytest.raises(ValueError, match=r"no row \"q\['w'\]\"; there are q\['u'\], q\['x'\], and their velocities"):
        lagjax.plot.space_time(run, "q['w']")


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda run: lagjax.plot.trajectory(OSCILLATORS), "must be what lagjax.simulate returns; got System"),
        (lambda run: lagjax.plot.phase(run, members=0), "members must be a whole number, one at least; got 0"),
        (lambda run: lagjax.plot.compare((run.ts, run.q), run), "one must be what lagjax.simulate returns; got tuple"),
        (lambda run: lagjax.plot.trajectory(run, lambda q, v: q[0]), "two numbers, .* for one state; got shapes"),
        (lambda run: lagjax.plot.energy_error(None), "got NoneType"),
        (lambda run: lagjax.plot.modes(run), "modes must be what lagjax.normal_modes returns; got Trajectory"),
        (lambda run: lagjax.plot.phase(run, period=0.0), "period must be a positive number, 2π for an angle; got 0.0"),
        (lambda run: lagjax.plot.phase(run, period={"a": 1.0}), "period is .*, which does not fit the structure of q"),
        (lambda run: lagjax.plot.bifurcation(OSCILLATORS, np.ones(3)), "over must be a dict"),
        (lambda run: lagjax.plot.bifurcation(OSCILLATORS, {"A": [1.0]}), "strobe is the period of the drive"),
        (lambda run: lagjax.plot.bifurcation(OSCILLATORS, {"A": [1.0]}, lambda of: 0 * of["A"]), "number; got 0"),
        (lambda run: lagjax.plot.bifurcation(OSCILLATORS, {"A": [1.0]}, 1.0), "Nothing depends on A: give params as"),
        (lambda run: lagjax.plot.bifurcation(OSCILLATORS, {"A": [1.0], "B": [1.0]}, 1.0), "over must have one axis"),
        (lambda run: lagjax.plot.bifurcation(run.ts, run.q[:-1]), r"got \(40, 2\) and \(41,\)"),
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
