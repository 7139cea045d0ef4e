"""`Animation`: a motion that moves, by matplotlib. `Trajectory.animate` makes one.

    Trajectory ─► Course of each member ─► states at the frames ─► positions of points ─► pictures ─► a file

A trajectory is known at its output times alone. Between two of them the state follows the cubic that has q and q̇ of
both ends (Hermite); across a change of mode of a hybrid motion it ends with the state before it, and continues along
the parabola that meets the next output, since the velocity after a reset is not recorded.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._arguments import Function, accept
from lagjax._batch_members import Members
from lagjax._display._notebook import COLORS
from lagjax._display._summary import times_of_members
from lagjax._layout import Layout
from lagjax._platform import is_known, numbers_at

PyTree = Any
MEMBERS = 50  # that are drawn of a batch, the first ones
FRAMES = 20_000  # of which a film has fewer
TRAIL = 2.0  # seconds of the film over which a trace fades
_VIDEO, _PAGE = (".mp4", ".m4v", ".mov", ".webm"), (".html", ".htm")
_LARGEST = 2000.0  # megabytes of a page, more than `FRAMES` make
_SIZE, _DPI = 4.8, 100  # inches of a side, and dots in one
_INTERVALS = 8  # between numbers along a side of that length; twelve of six characters would touch


class Course(NamedTuple):
    """The places of one member between K knots: times (K,), q (K, n), and q̇ (K, n) just before and after each.

    NaN after a knot: the velocity there is not known.
    """

    t: np.ndarray
    q: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def coordinates_at(self, times: np.ndarray) -> np.ndarray:
        """q (F, n) at some times; NaN beyond the ends, but for what a float32 rounds away."""
        return self.states_at(times)[0]

    def states_at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q and q̇ (F, n) at some times: the cubic between two knots and its derivative; NaN beyond the ends."""
        low, high = sorted((self.t[0], self.t[-1]))
        slack = 1e-6 * (high - low)
        inside = ((times >= low - slack) & (times <= high + slack))[:, None]
        sign = np.sign(self.t[-1] - self.t[0])
        place = np.clip(np.searchsorted(sign * self.t, sign * times, side="left") - 1, 0, len(self.t) - 2)
        h = (self.t[place + 1] - self.t[place])[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = np.where(h == 0, 0.0, (times[:, None] - self.t[place][:, None]) / h)
            a, b, rate = self.q[place], self.q[place + 1], self.before[place + 1]
            begin, end, rise = h * self.after[place], h * rate, b - a
            begin = np.where(np.isnan(begin), 2 * rise - end, begin)
            second, third = 3 * rise - 2 * begin - end, begin + end - 2 * rise
            q = a + x * (begin + x * (second + x * third))
            qdot = (begin + x * (2 * second + 3 * x * third)) / h
            q, qdot = np.where(x == 1, b, q), np.where(x == 1, rate, qdot)
            return np.where(inside, q, np.nan), np.where(inside, qdot, np.nan)

    def smooth(self, points: int) -> tuple[np.ndarray, np.ndarray]:
        """q and q̇ (F, n) at the knots and evenly between them, at `points` times at least: for curves."""
        knots = np.arange(len(self.t))
        finer = max(1, -(-points // max(1, len(knots) - 1)))
        return self.states_at(np.interp(np.arange(finer * (len(knots) - 1) + 1) / finer, knots, self.t))


@dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """A motion as a film; made by `Trajectory.animate`. `save` writes it to a file, and a notebook shows it.

    - `positions(times)`: the positions of the points, a dict of arrays (members, frames, k, 2 or 3) by name.
    - `span`: the first and the last time; `speed`: units of time in a second of the film; `fps`: frames in a second.
    - `traces`: the points that leave a trace, (name, place) each.
    """

    positions: Callable[[np.ndarray], dict[str, np.ndarray]]
    span: tuple[float, float]
    speed: float
    fps: float
    traces: tuple[tuple[str, int], ...]

    def __repr__(self) -> str:
        begin, end = self.span
        seconds = f"{abs(end - begin) / self.speed:.3g} s at {self.fps:g} frames a second"
        return f"Animation from t = {begin:.6g} to {end:.6g}, {seconds}: save it to .gif, .mp4 or .html"

    def _repr_html_(self) -> str | None:
        """The film itself, for notebooks; None where it cannot be made."""
        try:
            return self._page()
        except Exception:  # a display must not fail
            return None

    def times(self, fps: float | None = None) -> np.ndarray:
        """The times of the frames, evenly spaced from the first to the last."""
        begin, end = self.span
        count = int(np.ceil(abs(end - begin) / self.speed * (fps or self.fps))) + 1
        times = begin + np.arange(count) * np.sign(end - begin) * self.speed / (fps or self.fps)
        return np.clip(times, min(self.span), max(self.span))

    def save(self, path) -> None:
        """Write the film: to a GIF, to MP4 (or .webm, .mov), or to a page of HTML, by the suffix of `path`.

        MP4 needs the program ffmpeg, or the package imageio-ffmpeg. A GIF has times in hundredths of a second: its
        frame rate is as close to `fps` as that allows, and its speed is right.

        Raises `ImportError` without matplotlib, `ValueError` for another suffix, `RuntimeError` without ffmpeg.
        """
        suffix = Path(path).suffix.lower()
        if suffix == ".gif":
            self._gif(path)
        elif suffix in _VIDEO:
            self._video(path)
        elif suffix in _PAGE:
            head = '<!doctype html><meta charset="utf-8"><title>A motion</title>'
            Path(path).write_text(head + self._page(), encoding="utf-8")
        else:
            raise ValueError(
                f"The suffix of {str(path)!r} names no film: write .gif, {', '.join(_VIDEO)}, .html; got {suffix!r}."
            )

    def _gif(self, path) -> None:
        """Write the pictures one after another, so that no more than one of them is in memory in its full colours."""
        from PIL import Image  # comes with matplotlib

        hundredths = max(2, round(100 / self.fps))  # browsers show frames of a hundredth for ten of them
        figure, show, count = self._figure(100 / hundredths)

        def picture(i: int):
            show(i)
            figure.canvas.draw()
            return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")

        rest = map(picture, range(1, count))
        picture(0).save(path, format="GIF", save_all=True, append_images=rest, duration=10 * hundredths, loop=0)

    def _video(self, path) -> None:
        matplotlib, program = _matplotlib(), _ffmpeg()
        if program is None:
            raise RuntimeError(
                "To write a video takes the program ffmpeg, which is not there: install it, or pip install "
                "imageio-ffmpeg. A .gif and an .html need none."
            )
        with matplotlib.rc_context({"animation.ffmpeg_path": program}):
            self._film(self.fps).save(path, writer=matplotlib.animation.FFMpegWriter(fps=self.fps), dpi=_DPI)

    def _page(self) -> str:
        """The film as HTML: a video where ffmpeg is there, else pictures and a few lines of JavaScript."""
        matplotlib, program = _matplotlib(), _ffmpeg()
        film = self._film(self.fps)
        # Beyond its limit matplotlib leaves frames out, or the whole video.
        with matplotlib.rc_context({"animation.embed_limit": _LARGEST, "savefig.dpi": _DPI}):
            if program is None:
                return film.to_jshtml(fps=self.fps)
            with matplotlib.rc_context({"animation.ffmpeg_path": program}):
                return film.to_html5_video()

    def _film(self, fps: float):
        """matplotlib's own animation, on a figure of its own."""
        figure, show, count = self._figure(fps)
        return _matplotlib().animation.FuncAnimation(
            figure, show, frames=count, init_func=lambda: (), interval=1000 / fps, cache_frame_data=False
        )

    def _figure(self, fps: float) -> tuple[Any, Callable, int]:
        """The figure, a function that sets it to frame i, and how many frames there are."""
        matplotlib, times = _matplotlib(), self.times(fps)
        positions = self.positions(times)
        figure = matplotlib.figure.Figure(figsize=_size(positions), layout="constrained", dpi=_DPI)
        matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
        show, moving = _draw_film(figure, positions, times, self.traces, max(1, round(TRAIL * fps)))
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # it is laid out: to do so for every frame takes most of the time
        _keep_the_rest(figure, moving)
        return figure, show, len(times)


def make_animation(trajectory, points: Callable, trace, speed: float, fps: float) -> Animation:
    """The `Animation` of a trajectory; see `Trajectory.animate`."""
    _require_positive(speed=speed, fps=fps)
    if not all(map(is_known, jax.tree.leaves((trajectory.ts, trajectory.q, trajectory.qdot)))):
        raise ValueError("animate draws numbers: call it outside of jit, vmap and grad.")
    function = accept(points, "points", ("q",))
    members = Members(trajectory)
    courses = [_course(trajectory, members, k) for k in range(min(members.count, MEMBERS))]
    reached = [course.t[np.isfinite(course.q).all(axis=1)] for course in courses]
    known = np.concatenate(reached)
    if not len(known):
        raise ValueError("None of the members was followed to any output: there is nothing to show.")
    begin = courses[0].t[0]
    end = float(known[np.argmax(np.abs(known - begin))])
    if end == begin:
        raise ValueError("The motion ended before its second output: there is nothing to show. Give closer ts.")
    seconds = abs(end - begin) / speed
    if not 2 <= seconds * fps + 1 <= FRAMES:
        raise ValueError(
            f"The motion takes {abs(end - begin):.6g}, which makes {seconds * fps + 1:.3g} frames at speed={speed:g} "
            f"and fps={fps:g}. speed={abs(end - begin) / 10:.2g} shows it in ten seconds."
        )

    def positions(times: np.ndarray) -> dict[str, np.ndarray]:
        each = [
            _positions(function, members, k, course.coordinates_at(times), times) for k, course in enumerate(courses)
        ]
        return {name: np.stack([one[name] for one in each]) for name in each[0]}

    shapes = {name: array.shape[2:] for name, array in positions(np.array([begin])).items()}
    if not shapes:
        raise ValueError("points returns an empty dict: there is nothing to show.")
    return Animation(positions, (float(begin), end), float(speed), float(fps), _parse_trace(trace, shapes))


def _require_positive(**numbers) -> None:
    for name, value in numbers.items():
        if isinstance(value, bool) or np.ndim(value) or not np.isreal(value) or not 0 < value < np.inf:
            raise ValueError(f"{name} must be a positive number; got {value!r}.")


# ---- where the points are --------------------------------------------------------------------------------------------


def courses_of(trajectory, places) -> tuple[Layout, list[Course]]:
    """The members in these places of a batch, between their outputs; place 0 of one motion is that motion."""
    members = Members(trajectory)
    return members.layout, [_course(trajectory, members, k) for k in places]


def course_of(trajectory) -> tuple[Layout, Course]:
    """One motion between its outputs. Raises `ValueError` for a batch."""
    members = Members(trajectory)
    if members.batch:
        raise ValueError(
            "Compare one motion, not a batch: jax.tree.map(lambda x: x[k], (batch.q, batch.qdot)) are the states of "
            "member k; simulate follows it alone."
        )
    return members.layout, _course(trajectory, members, 0)


def _course(trajectory, members: Members, k: int) -> Course:
    """The knots of a member: its outputs, and the states just before its transitions."""
    place = np.unravel_index(k, members.batch) if members.batch else ()

    def flatten_member(tree):
        leaves = [numbers_at(leaf, place) for leaf in jax.tree.leaves(tree)]
        return np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1).astype(float)

    t = times_of_members(trajectory).reshape(members.count, -1)[k].astype(float)
    q, qdot = flatten_member(trajectory.q), flatten_member(trajectory.qdot)
    changes = trajectory.transitions
    if changes is None:
        return Course(t, q, qdot, qdot)
    when = np.asarray(changes.t).reshape(members.count, -1)[k]
    there = np.isfinite(when)
    before = flatten_member(changes.qdot)[there]
    order = np.argsort(np.concatenate([t, when[there]]), kind="stable")
    return Course(
        np.concatenate([t, when[there]])[order],
        np.concatenate([q, flatten_member(changes.q)[there]])[order],
        np.concatenate([qdot, before])[order],
        np.concatenate([qdot, np.full_like(before, np.nan)])[order],
    )


def _positions(function: Function, members: Members, k: int, q: np.ndarray, times: np.ndarray) -> dict[str, np.ndarray]:
    """The points (frames, number, 2 or 3) of a member at its states q (frames, n), by name."""
    states = members.layout.restore(q.astype(members.layout.dtype))
    drawn = _evaluate_points(function, states, times.astype(members.layout.dtype), members.params_of(k))
    named = drawn if isinstance(drawn, dict) else {"": drawn}
    return {str(name): require_points(name, np.asarray(value), len(q)) for name, value in named.items()}


@eqx.filter_jit
def _evaluate_points(function: Function, states, times, params):
    def drawn(q, t):
        points = function(q, t=t, params=params)
        if isinstance(points, dict):
            return {name: jnp.asarray(value) for name, value in points.items()}
        return jnp.asarray(points)

    return jax.vmap(drawn)(states, times)


def require_points(name, value: np.ndarray, frames: int) -> np.ndarray:
    """The positions of one point or line at F frames, (F, k, 2 or 3). Raises `ValueError` for another shape."""
    if value.ndim == 2:  # one point
        value = value[:, None, :]
    if value.ndim != 3 or value.shape[-1] not in (2, 3):
        what = f"points[{name!r}]" if name != "" else "points"
        raise ValueError(
            f"{what} must be one point, shape (2,) or (3,), or a line through k points, shape (k, 2) or (k, 3); got "
            f"shape {value.shape[1:]}. Return a dict of such arrays to draw several."
        )
    return value


def _parse_trace(trace, shapes: dict[str, tuple[int, ...]]) -> tuple[tuple[str, int], ...]:
    """The points that leave a trace, (name, place) each, from the argument `trace`: a name is its line's last point."""
    if len({shape[-1] for shape in shapes.values()}) > 1:
        raise ValueError("points has some in the plane and some in space: give all of them two numbers, or three.")
    if trace is None:
        return ()
    listed = trace if isinstance(trace, list) else [trace]
    first = next(iter(shapes))
    pairs = [one if isinstance(one, tuple) else (one, -1) if isinstance(one, str) else (first, one) for one in listed]
    for name, place in pairs:
        known = isinstance(place, int | np.integer) and name in shapes and -shapes[name][0] <= place < shapes[name][0]
        if not known:
            lines = ", ".join(f"{name or 'points'!r} of {shape[0]} points" for name, shape in shapes.items())
            raise ValueError(
                f"trace={trace!r} names no point: there are {lines}. Give a name, a place, or (name, place)."
            )
    return tuple((name, int(place)) for name, place in pairs)


# ---- pictures --------------------------------------------------------------------------------------------------------


def _draw_film(
    figure, positions: dict[str, np.ndarray], times: np.ndarray, traces, trail: int
) -> tuple[Callable, list]:
    """Set the figure up; a function that sets it to frame i, and the artists to draw for it."""
    ax, space = _axes(figure, positions), next(iter(positions.values())).shape[-1] == 3
    count = len(next(iter(positions.values())))
    opacity = max(0.2, count**-0.5)
    lines, faded = [], []
    for color, (name, array) in zip(_cycle_colors(len(positions)), positions.items(), strict=True):
        style = dict(color=color, alpha=opacity, linewidth=2, marker="o", markersize=5, solid_capstyle="round")
        for member in array:
            lines.append((ax.plot(*([] for _ in range(member.shape[-1])), **style)[0], member))
        for place in [place for traced, place in traces if traced == name]:
            for member in array:
                faded.append((_trace(ax, color, space, opacity), member[:, place], color))
    # Above the scene; at a height of its own, as matplotlib looks for none of a title that is hidden.
    clock = ax.set_title(f"t = {times[-1]:.{_digits(times)}f}", loc="left", y=1.0, fontsize="medium")

    def show(i: int):
        for line, member in lines:
            if space:
                line.set_data_3d(*member[i].T)
            else:
                line.set_data(*member[i].T)
        for collection, path, color in faded:
            recent = path[max(0, i - trail) : i + 1]
            collection.set_segments(np.stack([recent[:-1], recent[1:]], axis=1))
            collection.set_color([(*_rgb(color), a * opacity) for a in np.linspace(0, 1, len(recent) - 1)])
        clock.set_text(f"t = {times[i]:.{_digits(times)}f}")
        return ()

    above = [] if space else [ax.spines["left"], ax.spines["bottom"]]  # these stand still, and on top
    return show, [clock, *above, *(line for line, _ in lines), *(collection for collection, *_ in faded)]


def _keep_the_rest(figure, moving: list) -> None:
    """Draw all but the `moving` artists once and for all: axes with their numbers take ten times as long as these.

    matplotlib draws a figure up to three times a frame; its own way to draw less, `blit`, is for windows, not files.
    """
    draw_all, kept = figure.draw, []
    order = figure.axes[0].get_children()
    moving = sorted(sorted(moving, key=order.index), key=lambda artist: artist.get_zorder())
    deep = [artist for artist in moving if hasattr(artist, "do_3d_projection")]  # which axes in space draw last
    flat = [artist for artist in moving if artist not in deep]

    def draw(renderer):
        if not kept:
            for artist in moving:
                artist.set_visible(False)
            draw_all(renderer)
            kept.append(renderer.copy_from_bbox(figure.bbox))
            for artist in moving:
                artist.set_visible(True)
        renderer.restore_region(kept[0])
        for artist in flat + sorted(deep, key=lambda artist: -artist.do_3d_projection()):
            artist.draw(renderer)

    figure.draw = draw


def _axes(figure, positions):
    """Axes of equal scale that hold the whole motion."""
    low, high = _limits(positions)
    ax = figure.add_subplot(projection="3d" if len(low) == 3 else None)
    limits = {f"{axis}lim": ends for axis, *ends in zip("xyz", low, high, strict=False)}
    ax.set(**limits)
    if len(low) == 3:
        ax.set_box_aspect(high - low)
        ax.set(xlabel="x", ylabel="y", zlabel="z")
        ax.locator_params(nbins=5)  # more would run into each other
        return ax
    ax.set_aspect("equal")
    for axis, share, middle in zip(
        (ax.xaxis, ax.yaxis), (high - low) / (high - low).max(), (low + high) / 2, strict=True
    ):
        if _INTERVALS * share < 2:  # a side of a motion along a line: there is room for one number
            axis.set_ticks([middle], [f"{middle:.3g}"])
        else:
            axis.get_major_locator().set_params(nbins=round(_INTERVALS * share))
    ax.grid(color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("0.55")
    ax.tick_params(color="0.55")
    return ax


def _limits(positions) -> tuple[np.ndarray, np.ndarray]:
    """The box of all points at all times, a twentieth wider, and no side less than a tenth of the longest."""
    every = np.concatenate([array.reshape(-1, array.shape[-1]) for array in positions.values()])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        raise ValueError("points returns no finite position at any time: there is nothing to show.")
    middle, half = (every.max(0) + every.min(0)) / 2, (every.max(0) - every.min(0)) / 2
    half = np.maximum(1.05 * half, 0.1 * (half.max() or 1.0))
    return middle - half, middle + half


def _size(positions) -> tuple[float, float]:
    """Width and height of the figure in inches, even numbers of dots, as videos need them."""
    low, high = _limits(positions)
    if len(low) == 3:
        return _SIZE, _SIZE
    width, height = (high - low) / (high - low).max()
    return _SIZE * max(width, 0.5), round(_SIZE * max(height, 0.4) * _DPI / 2) * 2 / _DPI


def _trace(ax, color: str, space: bool, opacity: float):
    """An empty line whose pieces have colours of their own."""
    matplotlib = _matplotlib()
    if space:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        return ax.add_collection3d(Line3DCollection([np.zeros((2, 3))], linewidths=1.2), autolim=False)
    return ax.add_collection(matplotlib.collections.LineCollection([], linewidths=1.2), autolim=False)


def _cycle_colors(count: int) -> list[str]:
    return [COLORS[k % len(COLORS)] for k in range(count)]


def _rgb(color: str) -> tuple[float, ...]:
    return tuple(int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))


def _digits(times: np.ndarray) -> int:
    """Decimal places that tell frames apart, up to 6."""
    step = abs(times[1] - times[0]) if len(times) > 1 else 1.0
    return int(np.clip(np.ceil(-np.log10(10 * step)), 0, 6))


def _ffmpeg() -> str | None:
    """The program that writes videos, of the system or of the package imageio-ffmpeg."""
    if program := shutil.which("ffmpeg"):
        return program
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]

        return get_ffmpeg_exe()
    except Exception:  # neither is there
        return None


def _matplotlib() -> Any:
    try:
        import matplotlib.animation
        import matplotlib.backends.backend_agg
        import matplotlib.collections
        import matplotlib.figure
    except ImportError:
        raise ImportError("animate needs the package matplotlib: pip install lagjax[examples].") from None
    return matplotlib
