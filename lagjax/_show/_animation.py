"""`Animation`: a motion that moves, by matplotlib. `Trajectory.animate` makes one.

Trajectory ─► Course of each member ─► states at the frames ─► positions of points ─► pictures ─► a file
"""

import itertools
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax._interface import Function, accept
from lagjax._run import Members
from lagjax._show._course import course_of_member
from lagjax._show._notebook import COLORS, simplify_axes
from lagjax._show._summary import import_package, require_numbers

MEMBERS = 50  # that are drawn of a batch, the first ones
FRAMES = 20_000  # of which a film has fewer
TRAIL = 2.0  # seconds of the film over which a trace fades
FINER = 8  # pieces of a trace from one frame to the next: half a turn in a frame is round, and half as many has corners
_VIDEO, _PAGE = (".mp4", ".m4v", ".mov", ".webm"), (".html", ".htm")
_LARGEST_PAGE = 2000.0  # megabytes of a page, more than `FRAMES` make
_SIZE, _DPI = 4.8, 100  # inches of a side, and dots in one
_INTERVALS = 8  # between numbers along a side of that length; twelve of six characters would touch


@dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """A motion as a film; made by `Trajectory.animate`. `save` writes it to a file, and a notebook shows it.

    - `positions(times)`: the positions of the points, a dict of arrays (members, frames, k, 2 or 3) by name.
    - `paths(times)`: the times (F,) and positions (F, k, 2 or 3) along the path of each member, which are those at
      `times` and at all of its outputs and transitions; NaN where it jumps.
    - `span`: the first and the last time; `speed`: units of time in a second of the film; `fps`: frames in a second.
    - `traces`: the points that leave a trace, (name, place) each.
    """

    positions: Callable[[np.ndarray], dict[str, np.ndarray]]
    paths: Callable[[np.ndarray], list[tuple[np.ndarray, dict[str, np.ndarray]]]]
    span: tuple[float, float]
    speed: float
    fps: float
    traces: tuple[tuple[str, int], ...]

    def __repr__(self) -> str:
        begin, end = self.span
        seconds = f"{abs(end - begin) / self.speed:.3g} s at {self.fps:g} frames a second"
        return f"Animation from t = {begin:.6g} to {end:.6g}, {seconds}: save it to .gif, .mp4 or .html"

    def _repr_html_(self) -> str | None:
        """Return the film as HTML for notebooks; None if it cannot be made."""
        try:
            return self._film_html()
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
            self._write_gif(path)
        elif suffix in _VIDEO:
            self._write_video(path)
        elif suffix in _PAGE:
            head = '<!doctype html><meta charset="utf-8"><title>A motion</title>'
            Path(path).write_text(head + self._film_html(), encoding="utf-8")
        else:
            known = f".gif, {', '.join(_VIDEO)}, .html"
            raise ValueError(f"The suffix of {str(path)!r} names no film: write {known}; got {suffix!r}.")

    def _write_gif(self, path) -> None:
        """Write a GIF frame by frame, so that only one frame is in memory in full colour."""
        from PIL import Image  # comes with matplotlib

        hundredths = max(2, round(100 / self.fps))  # browsers show frames of a hundredth for ten of them
        figure, show, count = self._figure(100 / hundredths)

        def picture(i: int):
            show(i)
            figure.canvas.draw()
            return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")

        rest = map(picture, range(1, count))
        picture(0).save(path, format="GIF", save_all=True, append_images=rest, duration=10 * hundredths, loop=0)

    def _write_video(self, path) -> None:
        matplotlib, program = _import_matplotlib(), _find_ffmpeg()
        if program is None:
            raise RuntimeError(
                "To write a video takes the program ffmpeg, which is not there: install it, or pip install "
                "imageio-ffmpeg. A .gif and an .html need none."
            )
        with matplotlib.rc_context({"animation.ffmpeg_path": program}):
            self._film().save(path, writer=matplotlib.animation.FFMpegWriter(fps=self.fps), dpi=_DPI)

    def _film_html(self) -> str:
        """Return the film as HTML: a video if ffmpeg is installed, else images with a little JavaScript."""
        matplotlib, program = _import_matplotlib(), _find_ffmpeg()
        # Beyond its limit matplotlib leaves frames out, or the whole video.
        options = {"animation.embed_limit": _LARGEST_PAGE, "savefig.dpi": _DPI}
        with matplotlib.rc_context(options | ({} if program is None else {"animation.ffmpeg_path": program})):
            return self._film().to_jshtml(fps=self.fps) if program is None else self._film().to_html5_video()

    def _film(self):
        figure, show, count = self._figure(self.fps)
        options = dict(frames=count, init_func=lambda: (), interval=1000 / self.fps, cache_frame_data=False)
        return _import_matplotlib().animation.FuncAnimation(figure, show, **options)

    def _figure(self, fps: float) -> tuple[Any, Callable, int]:
        """Return the figure, a function that draws frame i in it, and the number of frames."""
        matplotlib, times = _import_matplotlib(), self.times(fps)
        positions, traces = self.positions(times), self._traces(times)
        limits = _axis_limits([*positions.values(), *(path for _, _, path in traces)])
        figure = matplotlib.figure.Figure(figsize=_figure_size(*limits), layout="constrained", dpi=_DPI)
        matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
        show, moving = _draw_film(_build_axes(figure, *limits), positions, times, traces, max(1, round(TRAIL * fps)))
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # it is laid out: to do so for every frame takes most of the time
        _cache_background(figure, moving)
        return figure, show, len(times)

    def _traces(self, times: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Return (name, times (F,), positions (F, 2 or 3)) of the trace of every traced point in every member."""
        if not self.traces:
            return []
        finer = np.interp(np.arange(FINER * (len(times) - 1) + 1) / FINER, np.arange(len(times)), times)
        paths = self.paths(finer)
        return [(name, t, path[name][:, place]) for name, place in self.traces for t, path in paths]


def make_animation(trajectory, points: Callable, trace, speed: float, fps: float) -> Animation:
    """Return the `Animation` of a trajectory; see `Trajectory.animate`."""
    for name, value in (("speed", speed), ("fps", fps)):
        if isinstance(value, bool) or np.ndim(value) or not np.isreal(value) or not 0 < value < np.inf:
            raise ValueError(f"{name} must be a positive number; got {value!r}.")
    require_numbers(trajectory, "animate draws")
    function = accept(points, "points", ("q",))
    members = Members(trajectory)
    courses = [course_of_member(members, k) for k in range(min(members.count, MEMBERS))]
    reached = [course.t[np.isfinite(course.q).all(axis=1)] for course in courses]
    if not len(known := np.concatenate(reached)):
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
        each = [_positions(function, members, k, course.states_at(times)[0], times) for k, course in enumerate(courses)]
        return {name: np.stack([one[name] for one in each]) for name in each[0]}

    def paths(times: np.ndarray) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
        curves = [course.curve(times)[:2] for course in courses]
        longest = np.arange(max(len(t) for t, _ in curves))  # paths of one length are compiled once
        filled = [tuple(x[np.minimum(longest, len(x) - 1)] for x in curve) for curve in curves]
        return [(t, _positions(function, members, k, q, t)) for k, (t, q) in enumerate(filled)]

    shapes = {name: array.shape[2:] for name, array in positions(np.array([begin])).items()}
    if not shapes:
        raise ValueError("points returns an empty dict: there is nothing to show.")
    return Animation(positions, paths, (float(begin), end), float(speed), float(fps), _parse_trace(trace, shapes))


# ---- where the points are --------------------------------------------------------------------------------------------


def _positions(function: Function, members: Members, k: int, q: np.ndarray, times: np.ndarray) -> dict[str, np.ndarray]:
    """Evaluate the points of member k at its states q (frames, n): {name: (frames, k, 2 or 3)}; NaN where q is."""
    states = members.layout.restore(q.astype(members.layout.dtype))
    named = _evaluate_points(function, states, times.astype(members.layout.dtype), members.params_of(k))
    known = np.all(np.isfinite(q), axis=1)[:, None, None]
    positions = {str(name): require_points(name, np.asarray(value)) for name, value in named.items()}
    return {name: np.where(known, value, np.nan) for name, value in positions.items()}


@eqx.filter_jit
def _evaluate_points(function: Function, states, times, params):
    def points_at(q, t):
        points = function(q, t=t, params=params)
        named = points if isinstance(points, dict) else {"": points}
        return {name: jnp.asarray(value) for name, value in named.items()}

    return jax.vmap(points_at)(states, times)


def require_points(name, value: np.ndarray) -> np.ndarray:
    """Return the positions of a point or line at F frames as (F, k, 2 or 3); raise `ValueError` for other shapes."""
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
    """Return (name, index) of each point that leaves a trace; a name alone in `trace` means its line's last point."""
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
            advice = "Give a name, a place, or (name, place)."
            raise ValueError(f"trace={trace!r} names no point: there are {lines}. {advice}")
    return tuple((name, int(place)) for name, place in pairs)


# ---- pictures --------------------------------------------------------------------------------------------------------


def _draw_film(ax, positions: dict[str, np.ndarray], times: np.ndarray, traces, trail: int) -> tuple[Callable, list]:
    """Create the artists; return a function that draws frame i, and the artists that change between frames."""
    space = ax.name == "3d"
    opacity = max(0.2, len(next(iter(positions.values()))) ** -0.5)
    lines, faded, forward = [], [], np.sign(times[-1] - times[0])
    colors = dict(zip(positions, itertools.cycle(COLORS), strict=False))
    for name, array in positions.items():
        stands = array.shape[2] > 1 and not np.ptp(array, axis=(0, 1)).any()  # a floor has no ends
        style = dict(color=colors[name], alpha=opacity, linewidth=2, marker="" if stands else "o", markersize=5)
        for member in array:
            line = ax.plot(*([] for _ in range(member.shape[-1])), **style, solid_capstyle="round")[0]
            lines.append((line, member))
    for name, t, path in traces:
        seen = np.searchsorted(forward * t, forward * times, side="right")  # of the path, at every frame
        faded.append((_add_trace(ax, space), t, path, seen, colors[name]))
    # Above the scene; at a height of its own, as matplotlib looks for none of a title that is hidden.
    clock = ax.set_title(f"t = {times[-1]:.{_time_digits(times)}f}", loc="left", y=1.0, fontsize="medium")

    def show(i: int):
        for line, member in lines:
            (line.set_data_3d if space else line.set_data)(*member[i].T)
        for collection, t, path, seen, color in faded:
            begin, recent = times[max(0, i - trail)], slice(max(0, seen[max(0, i - trail)] - 1), seen[i])
            collection.set_segments(np.stack([path[recent][:-1], path[recent][1:]], axis=1))
            age = (t[recent][1:] - begin) / (times[i] - begin if i else 1.0)
            collection.set_color([(color, a * opacity) for a in np.clip(age, 0.0, 1.0)])
        clock.set_text(f"t = {times[i]:.{_time_digits(times)}f}")
        return ()

    above = [] if space else [ax.spines["left"], ax.spines["bottom"]]  # these stand still, and on top
    return show, [clock, *above, *(artist for artist, *_ in lines + faded)]


def _cache_background(figure, moving: list) -> None:
    """Make the figure draw everything but the `moving` artists only once: axes are slow, and `blit` needs a window."""
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


def _build_axes(figure, low: np.ndarray, high: np.ndarray):
    ax = figure.add_subplot(projection="3d" if len(low) == 3 else None)
    ax.set(**{f"{axis}lim": ends for axis, *ends in zip("xyz", low, high, strict=False)})
    if len(low) == 3:
        ax.set_box_aspect(high - low)
        ax.set(xlabel="x", ylabel="y", zlabel="z")
        ax.locator_params(nbins=5)  # more would run into each other
        return ax
    ax.set_aspect("equal")
    sides = (high - low) / (high - low).max()
    for axis, share, middle in zip((ax.xaxis, ax.yaxis), sides, (low + high) / 2, strict=True):
        if _INTERVALS * share < 2:  # a side of a motion along a line: there is room for one number
            axis.set_ticks([middle], [f"{middle:.3g}"])
        else:
            axis.get_major_locator().set_params(nbins=round(_INTERVALS * share))
    return simplify_axes(ax)


def _axis_limits(points: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corners of a box around all points, 5 % wider; no side below 10 % of the longest."""
    every = np.concatenate([array.reshape(-1, array.shape[-1]) for array in points])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        raise ValueError("points returns no finite position at any time: there is nothing to show.")
    middle, half = (every.max(0) + every.min(0)) / 2, (every.max(0) - every.min(0)) / 2
    half = np.maximum(1.05 * half, 0.1 * (half.max() or 1.0))
    return middle - half, middle + half


def _figure_size(low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """Return width and height of the figure in inches: even numbers of pixels, which video codecs require."""
    if len(low) == 3:
        return _SIZE, _SIZE
    width, height = (high - low) / (high - low).max()
    return _SIZE * max(width, 0.5), round(_SIZE * max(height, 0.4) * _DPI / 2) * 2 / _DPI


def _add_trace(ax, space: bool):
    """Add an empty line collection to the axes, whose segments have a colour each."""
    if space:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        return ax.add_collection3d(Line3DCollection([np.zeros((2, 3))], linewidths=1.2), autolim=False)
    return ax.add_collection(_import_matplotlib().collections.LineCollection([], linewidths=1.2), autolim=False)


def _time_digits(times: np.ndarray) -> int:
    """Return the number of decimals, at most 6, that distinguishes the times of neighbouring frames."""
    step = abs(times[1] - times[0]) if len(times) > 1 else 1.0
    return int(np.clip(np.ceil(-np.log10(10 * step)), 0, 6))


def _find_ffmpeg() -> str | None:
    if program := shutil.which("ffmpeg"):
        return program
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]

        return get_ffmpeg_exe()
    except Exception:  # neither is there
        return None


def _import_matplotlib() -> Any:
    parts = "animation", "backends.backend_agg", "collections", "figure"
    return import_package("animate", "matplotlib", "lagjax[examples]", *parts)
