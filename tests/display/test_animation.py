"""`Trajectory.animate`: where the points are at every frame, and that the film takes as long as it should."""

import importlib.util
import shutil
import sys

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from scenes import RADIAL_FALL

import lagjax
from lagjax._show import course_of

SPRING = lagjax.System(lambda q, v, params: 0.5 * v["x"] ** 2 - 0.5 * params * q["x"] ** 2)
SPRING_OF_A_LIST = lagjax.System(lambda q, v, params: 0.5 * v["x"] ** 2 - 0.5 * params["k"][0] * q["x"] ** 2)
TS = np.linspace(0.0, 6.0, 31)


def stick(q, t, params):
    return {"bob": jnp.stack([q["x"], 0.0 * t]), "rod": jnp.array([[0.0, params], [1.0, 0.0]])}


@pytest.fixture(scope="module")
def run():
    return lagjax.simulate(SPRING, {"x": 1.0}, {"x": 0.0}, TS, 1.0)


def test_between_outputs_the_motion_is_a_cubic(run):
    film = run.animate(stick, fps=25.0)
    times = film.times()
    np.testing.assert_allclose(times, np.arange(151) / 25, atol=1e-13)
    positions = film.positions(times)
    assert positions["bob"].shape == (1, 151, 1, 2) and positions["rod"].shape == (1, 151, 2, 2)
    # The error of Hermite's cubic is h⁴/384 of the fourth derivative, here at most one.
    np.testing.assert_allclose(positions["bob"][0, :, 0, 0], np.cos(times), atol=0.2**4 / 384 + 1e-8)
    assert "6 s at 25 frames" in repr(film)


def test_speed_and_backward_motions():
    run = lagjax.simulate(SPRING, {"x": 1.0}, {"x": 0.0}, -TS, 1.0)
    film = run.animate(stick, speed=2.0, fps=10.0)
    times = film.times()
    assert len(times) == 31 and times[0] == 0 and times[-1] == -6
    np.testing.assert_allclose(film.positions(times)["bob"][0, :, 0, 0], np.cos(times), atol=1e-5)


def test_members_of_a_batch_have_their_own_parameters():
    rates = np.linspace(1.0, 2.0, 60)
    start = {"x": np.ones(60)}
    batch = lagjax.simulate_batch(SPRING, start, {"x": np.zeros(60)}, TS, rates, batch_axes=(0, 0, 0))
    positions = batch.animate(stick).positions(np.array([0.0, 3.0]))
    assert len(positions["bob"]) == 50
    np.testing.assert_allclose(positions["bob"][:, 1, 0, 0], np.cos(3 * np.sqrt(rates[:50])), atol=1e-4)
    np.testing.assert_array_equal(positions["rod"][:, 0, 0, 1], rates[:50])


def test_a_motion_that_fails_is_shown_as_far_as_it_came():
    fall = RADIAL_FALL  # into the centre at π/√8
    batch = lagjax.simulate_batch(fall, np.array([1.0, np.nan]), np.zeros(2), np.linspace(0.0, 2.0, 41))
    film = batch.animate(lambda q: jnp.stack([q, 0 * q]))
    assert film.span == (0.0, pytest.approx(1.1))
    assert np.isfinite(film.positions(film.times())[""][0]).all()
    with pytest.raises(ValueError, match="nothing to show"):
        lagjax.simulate_batch(fall, np.full(2, np.nan), np.zeros(2), TS).animate(lambda q: jnp.zeros(2))


def test_files(run, tmp_path, monkeypatch):
    image = pytest.importorskip("PIL.Image")
    settings = dict(matplotlib.rcParams)
    film = run.animate(stick, trace=["bob", ("rod", 1)], speed=60.0, fps=30.0)
    film.save(tmp_path / "film.GIF")
    with image.open(tmp_path / "film.GIF") as gif:
        assert gif.n_frames == 5  # 0.1 s at 100/3 frames a second, and the last
        assert gif.info["duration"] == 30
    monkeypatch.setenv("PATH", "")  # of ffmpeg, and of no other program that a film takes
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    film.save(tmp_path / "film.html")
    text = (tmp_path / "film.html").read_text()
    assert text.startswith("<!doctype html>") and "data:image/png" in text
    with pytest.raises(RuntimeError, match="takes the program ffmpeg"):
        film.save(tmp_path / "film.mp4")
    with pytest.raises(ValueError, match="names no film"):
        film.save(tmp_path / "film.png")
    assert dict(matplotlib.rcParams) == settings


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which("ffmpeg") or importlib.util.find_spec("imageio_ffmpeg")), reason="ffmpeg is not there"
)
def test_videos_and_space(run, tmp_path):
    film = run.animate(lambda q: jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]) * q["x"], trace=1, speed=30.0)
    film.save(tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").stat().st_size > 1000 and "<video" in film._repr_html_()


def test_mistakes_are_sentences(run):
    for more, words in (
        ({"trace": "bot"}, r"trace='bot' names no point: there are 'bob' of 1 points, 'rod' of 2"),
        ({"trace": ("rod", 2)}, "names no point"),
        ({"speed": 1e-9}, r"e\+11 frames at speed=1e-09 and fps=30. speed=0.6 shows it in ten seconds"),
        ({"fps": 0}, "fps must be a positive number"),
    ):
        with pytest.raises(ValueError, match=words):
            run.animate(stick, **more)
    with pytest.raises(ValueError, match=r"one point, shape \(2,\) or \(3,\).*got shape \(\)"):
        run.animate(lambda q: q["x"])
    with pytest.raises(ValueError, match="some in the plane and some in space"):
        run.animate(lambda q: {"a": jnp.zeros(2), "b": jnp.zeros(3)})
    with pytest.raises(TypeError, match=r"points\(q\), which may also ask"):
        run.animate(lambda q, v: jnp.zeros(2))
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda x: lagjax.simulate(SPRING, {"x": x}, {"x": 0.0}, TS, 1.0).animate(stick).fps)(1.0)


def test_beyond_the_outputs_nothing_is_known(run):
    _, course = course_of(run)
    at, _ = course.states_at(np.array([-3.0, 0.0, 6.0, 8.0]))
    assert np.isnan(at[[0, 3]]).all()
    np.testing.assert_allclose(at[1:3, 0], np.cos([0.0, 6.0]), atol=1e-8)


def test_points_in_a_list_and_by_a_whole_number():
    params = {"k": np.array([1.0, 2.0]), "which": np.array(1)}
    run = lagjax.simulate(SPRING_OF_A_LIST, {"x": 1.0}, {"x": 0.0}, TS, params)
    film = run.animate(lambda q, params: [[0.0, 0.0], [q["x"], params["k"][params["which"]]]])
    (positions,) = film.positions(np.array([0.0, 6.0])).values()
    np.testing.assert_allclose(positions[0, :, 1], [[1.0, 2.0], [np.cos(6.0), 2.0]], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("space", [False, True])
def test_a_frame_is_the_whole_figure_drawn_again(run, space):
    """All but what moves is drawn once and kept: pixel by pixel that is what matplotlib draws of the whole."""

    def points(q):
        bob = jnp.stack([q["x"], 0.5 * q["x"] ** 2, jnp.sin(3 * q["x"])])[: 3 if space else 2]
        return {"bob": bob, "rod": jnp.stack([0.3 * bob, bob, -bob])}

    figure, show, count = run.animate(points, trace=["bob", ("rod", 0)])._figure(10.0)
    for frame in (0, 25, 3, count - 1):
        show(frame)
        figure.canvas.draw()
        quick = np.array(figure.canvas.buffer_rgba())
        figure.canvas.get_renderer().clear()
        type(figure).draw(figure, figure.canvas.get_renderer())
        np.testing.assert_array_equal(quick, np.asarray(figure.canvas.buffer_rgba()))
