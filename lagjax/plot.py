"""Figures of motions and of what they cost. Needs matplotlib: `pip install lagjax[examples]`.

Every function draws into its argument `ax`, or into a new figure, and returns the Axes: titles, units, limits and
saving are matplotlib's business, `ax.figure.savefig(...)`. The line colours are those of Okabe & Ito (2008) and the
colour maps are perceptually uniform, so that all of them can be told apart with any colour vision and in grey.

    import lagjax.plot

    ax = lagjax.plot.trajectory(trajectory)
    ax.set_xlabel("t [s]")
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lagjax._analysis import Modes
from lagjax._fit import Fit, Record, draw_record
from lagjax._interface import Function, Layout, accept, join_names
from lagjax._run import Crossings, Impacts, Members, Trajectory, simulate
from lagjax._run.hybrid import Hybrid
from lagjax._scene import System
from lagjax._show import (
    COLORS,
    columns_of,
    course_of,
    courses_of,
    draw_curves,
    even_places,
    import_package,
    join_curve,
    require_numbers,
    require_points,
    simplify_axes,
    spans_of,
    spread_prefix,
    wrap_curve,
)
from lagjax._sweep import axes_of
from lagjax._trust import WorkPrecision
from lagjax._trust.health import does_work

MARKERS = ("o", "s", "^", "D", "v", "P", "X")
GREY = "0.55"
STRIP = 0.04  # of the height of axes, for what one contact does

__all__ = [
    "bifurcation", "compare", "energy_error", "fit", "modes", "path", "phase", "poincare", "profile", "return_map",
    "space_time", "state_map", "trajectory", "work_precision",
]  # fmt: skip


def __dir__() -> list[str]:
    """The figures alone."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


def trajectory(trajectory: Trajectory, projection: Callable | None = None, *, members: int = 30, period: Any = None,
               ax=None):  # fmt: skip
    """Coordinates against time, one colour each, the first seven of more; or, with a `projection`, curves in the plane.

    Between two outputs curves are the cubic that has q and q̇ of both (Hermite); of a hybrid motion they go through the
    states before and after every transition, and end where a reset moves what is drawn. `space_time` shows all
    coordinates of a chain or a lattice. One hybrid motion has its modes shaded. At the lower edge stand the contacts,
    one above the other: marks are their impacts, and of one motion spans are the times during which they are closed.

    - `projection`: a function of one state, (q, qdot) or q alone, that returns (x, y): `lambda q, qdot: (q, qdot)` for
      the phase portrait of one coordinate, or where a body is in space.
    - `members`: of a batch, draw this many, evenly chosen.
    - `period`: 2π for angles: they are drawn from −π to π, lines that leave there come in again, and ticks are parts of
      π. A number for all coordinates, or a pytree prefix of q with None where there is none; of a `projection` the
      number for x, or a pair for x and y.

    >>> lagjax.plot.trajectory(trajectory); lagjax.plot.trajectory(trajectory, lambda q, qdot: (q[0], qdot[0]))
    """
    (layout, curves), ax = _member_curves(trajectory, members), _prepare_axes(ax)
    if projection is not None:
        periods = _pair_of_periods(period, ax)
        projected = _project_curves(layout, curves, projection)
        draw_curves(ax, [join_curve(*wrap_curve(*line, *periods)) for line in projected], COLORS[0])
        return ax
    shown, periods = _coordinate_places(layout, ()), _angle_periods(layout, period)
    for color, i in zip(COLORS, shown, strict=False):
        lines = [join_curve(*wrap_curve(t, q[:, i], None, periods[i])) for t, q, _ in curves]
        draw_curves(ax, lines, color, layout.names[i], 1.5)
    _draw_angles(ax.yaxis, [periods[i] for i in shown])
    ax.set_xlabel("t")
    shaded = _shade_spans(ax, trajectory)
    marked = trajectory.impacts is not None and _mark_impacts(ax, trajectory.impacts, members)
    if layout.size == 1:
        ax.set_ylabel(layout.names[0])
        return _add_legend(ax) if marked or shaded else ax
    return _add_legend(ax, len(shown), layout)


def _shade_spans(ax, trajectory: Trajectory) -> bool:
    """Draw the spans of modes, and at the lower edge those of closed contacts; return False without any."""
    spans = spans_of(trajectory) if np.size(trajectory.ok) == 1 else {}
    for k, (color, (name, times)) in enumerate(zip(reversed(COLORS), spans.items(), strict=False)):
        low, high, opacity = (STRIP * k, STRIP * (k + 1), 0.4) if trajectory.mode is None else (0.0, 1.0, 0.12)
        for label, (first, last) in zip([name, *["_"] * len(times)], times, strict=False):
            ax.axvspan(first, last, low, high, color=color, alpha=opacity, linewidth=0, zorder=0, label=label)
    return any(spans.values())


def _mark_impacts(ax, impacts: Impacts, members: int) -> bool:
    """Mark the impacts of up to seven contacts at the lower edge; return False if there are none."""
    t, before = np.atleast_2d(impacts.t), len(ax.lines)
    t = t.reshape(-1, t.shape[-1])
    chosen, columns = even_places(len(t), members), columns_of({"impact": impacts.impulse}, np.ndim(impacts.t))
    for row, (marker, (name, impulses)) in enumerate(zip(MARKERS, columns.items(), strict=False)):
        when = t[chosen][impulses.reshape(t.shape)[chosen] > 0]
        if len(when):
            at_edge = dict(transform=ax.get_xaxis_transform(), color=GREY, linestyle="none", markersize=4)
            ax.plot(when, np.full(len(when), STRIP * (row + 0.5)), marker=marker, label=name, **at_edge)
    return len(ax.lines) > before


def space_time(trajectory: Trajectory, row: str | None = None, *, period: float | None = None, label: str | None = None,
               cmap: str | None = None, ax=None):  # fmt: skip
    """All coordinates of one motion against time, by colour: waves along a chain, or in the modes of a field.

    - `row`: one array of coordinates, by its name: "q['u']"; or of velocities, "qdot['u']".
    - `period`: 2π for angles: colours go around with them, and the ticks of the colour bar are parts of π.
    - `label`: what the colour bar is called; by default "q", or the row.

    The coordinates stand above each other, in the order in which messages name them; every output time is the middle
    of its column.

    >>> lagjax.plot.space_time(trajectory)
    """
    _require_numbers(trajectory, "trajectory")
    layout, course = course_of(trajectory)
    kind, names = ("qdot" if row and row.startswith("qdot") else "q"), list(layout.names)
    names = [kind + name.removeprefix("q") for name in names]
    chosen = [i for i, name in enumerate(names) if row in (None, kind, name) or name.startswith(f"{row}[")]
    if not chosen:
        raise ValueError(f"There is no row {row!r}; there are {join_names(layout.paths)}, and their velocities.")
    ax, values = _prepare_axes(ax), np.ma.masked_invalid(getattr(course, kind).T[chosen])
    style = dict(cmap=cmap or "viridis")
    if period is not None:
        _require_period(period)
        values = _wrap_values(values, period)
        style = dict(cmap=cmap or "twilight", vmin=-period / 2, vmax=period / 2)
    mesh = ax.pcolormesh(course.t, np.arange(len(chosen)), values, shading="nearest", rasterized=True, **style)
    ax.set(xlabel="t", ylabel="coordinate")
    ax.locator_params(axis="y", integer=True)
    if len(chosen) <= len(COLORS):
        ax.set_yticks(np.arange(len(chosen)), [names[i] for i in chosen])
    ax.grid(False)
    _draw_angles(_add_colorbar(mesh, ax, label or row or "q").ax.yaxis, [period])
    return ax


def phase(trajectory: Trajectory, *coordinates: str, members: int = 30, period: Any = None, ax=None):
    """The phase portrait: the velocity of each coordinate against it, from the dot on; a colour for each coordinate.

    The curves are those of `trajectory`: they end at a reset, and continue behind it.

    - `coordinates`: their names, as messages and tables have them: "q['theta']", "q[0]"; by default all, the first
      seven of more.
    - `members`, `period`: as in `trajectory`.

    >>> lagjax.plot.phase(trajectory, "q['theta']")
    """
    (layout, curves), ax = _member_curves(trajectory, members), _prepare_axes(ax)
    places, periods = _coordinate_places(layout, coordinates), _angle_periods(layout, period)
    for color, i in zip(COLORS, places, strict=False):
        lines = [wrap_curve(q[:, i], qdot[:, i], periods[i]) for _, q, qdot in curves]
        draw_curves(ax, lines, color, layout.names[i])
        ax.plot(*np.array([(x[0], y[0]) for x, y in lines]).T, ".", color=color, markersize=5)
    _draw_angles(ax.xaxis, [periods[i] for i in places])
    if len(places) == 1:
        name = layout.names[places[0]]
        ax.set(xlabel=name, ylabel="qdot" + name.removeprefix("q"))
        return ax
    ax.set(xlabel="coordinate", ylabel="velocity")
    return _add_legend(ax, len(places), layout)


def _coordinate_places(layout: Layout, coordinates: tuple[str, ...], most: int = len(COLORS)) -> list[int]:
    """The indices of named coordinates; of the first `most` if none is named."""
    if not coordinates:
        return list(range(min(layout.size, most)))
    if unknown := [name for name in coordinates if name not in layout.names]:
        raise ValueError(f"There is no coordinate {unknown[0]!r}; there are {join_names(layout.names)}.")
    if len(coordinates) > most:
        raise ValueError(f"At most {most} coordinates are drawn at once; got {len(coordinates)}.")
    return [layout.names.index(name) for name in coordinates]


def compare(one: Trajectory, other, *coordinates: str, figure=None):
    """Two motions, or a motion and data, above each other, and their difference below; a column for each coordinate.

    - `one`: a motion. Where `other` has different times it follows the cubic through its outputs (Hermite).
    - `other`: a `Trajectory`, a `Record`, or a pair (ts, values) with values in the structure of q; NaN is missing.
    - `coordinates`: their names, as in `phase`; by default the first four.

    Draws into `figure`, or a new one, and returns the Axes (2, S).

    >>> lagjax.plot.compare(trajectory, (ts, measured))
    """
    _require_numbers(one, "one")
    layout, course = course_of(one)
    t, q, _ = course.curve()
    ts, values, style = _comparison_curve(other, layout)
    places = _coordinate_places(layout, coordinates, most=4)
    figure = _new_wide_figure(len(places)) if figure is None else figure
    axes = figure.subplots(2, len(places), squeeze=False, sharex="col", gridspec_kw={"height_ratios": [2, 1]})
    left = course.states_at(ts)[0] - values
    for (above, below), i in zip(axes.T, places, strict=True):
        _prepare_axes(above).plot(t, q[:, i], color=COLORS[0], linewidth=1.5, label="motion")
        above.plot(ts, values[:, i], style, color=COLORS[1], markersize=3.0, linewidth=1.2, label="other")
        _prepare_axes(below).plot(ts, left[:, i], style[0], color=COLORS[1], markersize=3.0, linewidth=1)
        above.set_title(layout.names[i], fontsize="medium")
        below.set_xlabel("t")
    axes[1][0].set_ylabel("motion − other")
    axes[0][0].legend(frameon=False, fontsize="small", ncols=2)
    return axes


def _comparison_curve(other, layout: Layout) -> tuple[np.ndarray, np.ndarray, str]:
    """Times (T,), values (T, n) and line style of `other`: a trajectory, a record, or a pair (ts, values)."""
    if isinstance(other, Trajectory):
        _require_numbers(other, "other")
        of_other, course = course_of(other)
        if of_other.names != layout.names:
            raise ValueError("The two motions have different coordinates: there is nothing to compare.")
        t, q, _ = course.curve()
        q[1:][np.isnan(q[:-1]).any(axis=1)] = np.nan  # at the instant of a jump the difference is that before it
        return t, q, "--"
    if isinstance(other, tuple) and len(other) == 2:
        other = Record(*other)
    if not isinstance(other, Record):
        raise TypeError(f"other must be a Trajectory, a Record, or a pair (ts, values); got {type(other).__name__}.")
    if other.matrix.shape[1] != layout.size:
        raise ValueError(
            f"The data have {other.matrix.shape[1]} numbers at a time, and q has {layout.size}: give values in the "
            "structure of q, with NaN for what was not measured."
        )
    return np.asarray(other.ts), other.matrix, "."


def modes(modes: Modes, points: Callable | None = None, q: Any = None, params: Any = None, *, largest: float = 0.3,
          count: int = 6, figure=None):  # fmt: skip
    """The shapes of small oscillations with their frequencies: bars, a panel for each mode; or where things are.

    - `points`, `q`, `params`: as in `Trajectory.animate`, and the equilibrium: the points there, in grey, and at the
      two ends of the swing, of which the largest deviation of a coordinate is `largest`. In the plane.
    - `count`: draw this many modes, the slowest first.

    Draws into `figure`, or a new one, and returns the Axes (M,). A complex shape, where something turns or damps, is
    drawn at the instant of its largest deviation.

    >>> lagjax.plot.modes(lagjax.normal_modes(scene, q, params))
    """
    _require_result(modes, "modes", Modes, "normal_modes")
    frequencies = np.asarray(modes.frequencies)
    if frequencies.ndim != 1:
        raise ValueError(f"Draw the modes of one equilibrium at a time; these are {frequencies.shape[:-1]} of them.")
    if points is not None and q is None:
        raise ValueError("To draw points give the equilibrium too: lagjax.plot.modes(modes, points, q, params).")
    if points is not None:
        given, shape = (jax.tree.map(jnp.shape, x) for x in (q, jax.tree.map(lambda leaf: leaf[0], modes.shapes)))
        if given != shape:
            raise ValueError(f"q must be the equilibrium of these modes, with shapes {shape}; got {given}.")
    shown, shapes = min(_require_count(count, "count"), len(frequencies)), _align_phases(modes.shapes)
    matplotlib = _import_matplotlib()
    if figure is None:
        figure = matplotlib.pyplot.figure(figsize=(min(2.4 * shown + 1.0, 12.8), 3.2), layout="constrained")
    axes = figure.subplots(1, shown, squeeze=False, sharey=True, sharex=points is not None)[0]
    for k, ax in enumerate(axes):
        shape = jax.tree.map(lambda leaf, k=k: leaf[k], shapes)
        if points is None:
            _deviation_bars(_prepare_axes(ax), shape)
        else:
            _draw_swings(_prepare_axes(ax), accept(points, "points", ("q",)), q, shape, params, largest)
        ax.set_title(_describe_rates(modes, k), fontsize="medium")
    return axes


def _describe_rates(modes: Modes, k: int) -> str:
    """The frequency of a mode, its damping ratio if it has one, and how fast it grows if it does."""
    exponents, ratio = np.asarray(modes.exponents), float(modes.damping_ratios[k])
    growth, rounding = float(exponents[k].real.max()), 10 * np.finfo(exponents.dtype).eps ** 0.5
    if growth > rounding * np.abs(exponents).max():
        oscillates = f"ω = {modes.frequencies[k]:.4g},\n" if modes.frequencies[k] > 0 else ""
        return f"{oscillates}grows as exp({growth:.4g} t)"
    return f"ω = {modes.frequencies[k]:.4g}" + (f", ζ = {ratio:.2g}" if ratio > rounding else "")


def _align_phases(shapes):
    """Real shapes from complex ones, each turned by the phase that maximises the sum of squares."""
    total = sum(jnp.sum(jnp.square(leaf).reshape(len(leaf), -1), axis=1) for leaf in jax.tree.leaves(shapes))
    turn = jnp.exp(-0.5j * jnp.angle(total))
    return jax.tree.map(lambda leaf: jnp.real(leaf * turn.reshape(-1, *[1] * (leaf.ndim - 1))), shapes)


def _deviation_bars(ax, shape) -> None:
    """The deviation of every coordinate as a bar, the largest one of length one."""
    layout = Layout.from_state(shape, shape)
    deviation = np.asarray(layout.flatten(shape))
    ax.bar(np.arange(layout.size), deviation / np.abs(deviation).max(), color=COLORS[0], width=0.7)
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    if layout.size <= 12:
        ax.set_xticks(np.arange(layout.size), layout.names, rotation=45, ha="right", fontsize="small")


def _draw_swings(ax, points: Function, q, shape, params, largest: float) -> None:
    """Draw the points at an equilibrium, and displaced along a shape to both sides by at most `largest`."""
    size = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(shape))
    for swing, color, style in ((0.0, GREY, "-"), (-largest, COLORS[5], "--"), (largest, COLORS[0], "-")):
        at = jax.tree.map(lambda x, dx, s=swing: jnp.asarray(x) + s / size * dx, q, shape)
        drawn = points(at, t=jnp.zeros(()), params=params)
        for name, value in (drawn if isinstance(drawn, dict) else {"": drawn}).items():
            line = require_points(name, np.asarray(value)[None])[0]
            if line.shape[-1] != 2:
                raise ValueError("plot.modes draws in the plane: return points of two numbers, a projection of them.")
            ax.plot(*line.T, style, color=color, marker="o", markersize=4, linewidth=1.5)
    ax.set_aspect("equal", adjustable="box")


def path(x, y, *, values=None, label: str | None = None, cmap: str = "viridis", ax=None):
    """A curve in the plane, both axes on one scale.

    - `x`, `y`: a trajectory and its projection, as in `trajectory`, whose curve it is; or arrays of shape (T,), which
      straight lines join.
    - `values`: shape (T,); colours the curve, by time for instance, with a colour bar called `label`. Without it the
      curve has one colour, and `label` is its entry in a legend.

    >>> lagjax.plot.path(trajectory, lambda q, qdot: (q[0], q[1]), values=trajectory.ts, label="t [s]")
    """
    matplotlib = _import_matplotlib()
    if isinstance(x, Trajectory):
        _require_numbers(x, "x")
        layout, course = course_of(x)
        curve = course.curve()
        if values is not None:
            order = np.argsort(np.asarray(x.ts))
            values = np.interp(curve[0], np.asarray(x.ts)[order], np.asarray(values)[order])
        ((x, y),) = _project_curves(layout, [curve], y)
    ax = _prepare_axes(ax)
    ax.set_aspect("equal", adjustable="datalim")
    if values is None:
        ax.plot(x, y, linewidth=1.2, label=label)
        return ax
    points, values = np.stack([np.asarray(x), np.asarray(y)], axis=-1), np.asarray(values)
    # The palest end of a map does not show as a line on white.
    inks = matplotlib.colors.ListedColormap(matplotlib.colormaps[cmap](np.linspace(0.0, 0.9, 256)))
    pieces = [*np.stack([points[:-1], points[1:]], axis=1)]
    lines = matplotlib.collections.LineCollection(pieces, cmap=inks, linewidth=1.4)
    lines.set(array=(values[:-1] + values[1:]) / 2, capstyle="round")
    ax.add_collection(lines)
    ax.autoscale_view()
    _add_colorbar(lines, ax, label)
    return ax


def poincare(crossings: Crossings, projection: Callable, *, values=None, label: str | None = None, size=None,
             period: Any = None, ax=None):  # fmt: skip
    """A Poincaré section: a point for every crossing, of one motion or of a batch; a batch has a colour per member.

    - `projection`: a function of one state (q, qdot) that returns (x, y), the coordinates on the section.
    - `values`: shape (N,), one number per member of a batch, such as its energy or its Lyapunov exponent, by which
      points are coloured instead, with a colour bar called `label`. `size` is that of the points, by default as suits
      how many there are.
    - `period`: 2π where x is an angle, or a pair for x and y with None for what is none, as in `trajectory`.

    >>> lagjax.plot.poincare(crossings, lambda q, qdot: (q[1], qdot[1]))
    """
    x, y, members = _section_points(crossings, projection)
    ax = _prepare_axes(ax)
    x, y = map(_wrap_values, (x, y), _pair_of_periods(period, ax))
    if values is None:
        _scatter_points(ax, x, y, np.array(COLORS)[members % len(COLORS)], size)
        return ax
    points = _scatter_points(ax, x, y, np.asarray(values)[members], size, cmap="viridis")
    _add_colorbar(points, ax, label)
    return ax


def return_map(crossings: Crossings, value: Callable, *, ax=None):
    """The first return map of a section: a `value` of the state at each crossing against that at the one before it.

    - `value`: a function of one state (q, qdot) that returns one number.

    >>> lagjax.plot.return_map(crossings, lambda q, qdot: q[1])
    """
    ax = _prepare_axes(ax)
    x, _, members = _section_points(crossings, lambda q, qdot: (value(q, qdot), value(q, qdot)))
    same = members[1:] == members[:-1]
    _scatter_points(ax, x[:-1][same], x[1:][same], COLORS[0])
    low, high = (float(end) for end in (x.min(initial=0.0), x.max(initial=0.0)))
    ax.plot([low, high], [low, high], color=GREY, linewidth=0.8)
    ax.set(xlabel="at one crossing", ylabel="at the next")
    return ax


def _section_points(crossings: Crossings, projection: Callable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x and y of all crossings, and the member of each. Raises `ValueError` if there are none."""
    _require_result(crossings, "crossings", Crossings, "crossings", " for one section")
    t = np.asarray(crossings.t)
    if not np.isfinite(t).any():
        advice = "Follow the motion longer, or move it."
        raise ValueError(f"The section was never crossed: there is nothing to draw. {advice}")
    state = crossings.q, crossings.qdot
    states = jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(-1, *leaf.shape[t.ndim :]), state)
    x, y = map(np.asarray, jax.vmap(_checked_projection(projection))(*states))
    there = np.isfinite(t.ravel())
    members = np.repeat(np.arange(t.size // t.shape[-1]), t.shape[-1])
    return x[there], y[there], members[there]


def bifurcation(system, over, strobe=None, q0=0.0, qdot0=0.0, params=None, *, value: Callable | None = None,
                transient: int = 200, points: int = 100, period: float | None = None, ax=None):  # fmt: skip
    """A bifurcation diagram: where a driven motion is once in every period of its drive, over a parameter.

    All members are one batch; members that fail are left out. Call it again with the same `ax` and another start for an
    attractor that is there as well.

    - `system`: a `System` or a `Hybrid`; or the values (V,) of a parameter, and for `over` the points (V, …), such as
      a `Sweep` has kept.
    - `over`: a dict with one name and its values (V,), as in `sweep`.
    - `strobe`: the period of the drive. Seen are the states at `transient` + 1 to `transient` + `points` times it.
    - `strobe`, `q0`, `qdot0`, `params`: values, or functions of one member's point, a dict with its value by the name.
      Where `params` is a dict with that name, its entry is the value.
    - `value`: a function of one state (q, qdot) that returns the number to draw; by default the first coordinate.
    - `period`: 2π where that is an angle: it is drawn from −π to π, with parts of π as ticks.

    >>> lagjax.plot.bifurcation(scene, {"drive": np.linspace(0.9, 1.5, 1000)}, 2 * np.pi / 0.7, params=params)
    """
    if isinstance(system, System | Hybrid):
        x, y, names = _stroboscopic_points(system, over, (strobe, q0, qdot0, params), value, transient, points)
    else:
        names = [getattr(of, "name", None) or name for of, name in ((system, "parameter"), (over, "value"))]
        x, y = np.asarray(system, float), np.asarray(over, float)
        if x.ndim != 1 or y.shape[:1] != x.shape:
            raise ValueError(f"Points (V, …) belong to values (V,) of a parameter; got {y.shape} and {x.shape}.")
    x, y = np.broadcast_to(x[:, None], (len(x), y[0].size)).ravel(), y.ravel()
    x, y = x[known := np.isfinite(y)], y[known]
    if not len(x):
        raise ValueError("No member has a finite point: simulate one of them, whose message says why.")
    ax = _prepare_axes(ax)
    _scatter_points(ax, x, _wrap_values(y, period), COLORS[len(ax.collections) % len(COLORS)])
    _draw_angles(ax.yaxis, [period if period is None else _require_period(period)])
    ax.set(xlabel=names[0], ylabel=names[1])
    return ax


def _stroboscopic_points(scene, over, start: tuple, value: Callable | None, transient, points):
    """The values (V,) of the parameter, the points (V, P) of its members, and the names of both."""
    axes = axes_of(over)
    if len(axes) != 1:
        raise ValueError(f"over must have one axis; got {join_names([axis.dimension for axis in axes])}.")
    names, count = axes[0].names, _require_count(points, "points")
    times = 1 + _require_count(transient, "transient", 0) + np.arange(count)
    if start[0] is None:
        raise ValueError("strobe is the period of the drive, 2π/ω: give it, or a function of the point.")
    if not any(map(callable, start)) and not (isinstance(start[3], dict) and {*names} & {*start[3]}):
        raise ValueError(f"Nothing depends on {join_names(names)}: give params as a dict with that name, or functions.")
    columns, shown = np.concatenate([values for _, values in axes[0].pieces()]).T, []

    def follow(point):
        strobe, q0, qdot0, params = (of(point) if callable(of) else of for of in start)
        if isinstance(params, dict) and not callable(start[3]):
            params = params | {name: x for name, x in point.items() if name in params}
        ts = jnp.asarray(strobe) * jnp.concatenate([jnp.zeros(1), times])
        run = simulate(scene, q0, qdot0, ts, params, throw=False)
        seen = jax.tree.map(lambda x: x[1:], (run.q, run.qdot))
        if value is not None:
            return jax.vmap(value)(*seen), strobe
        shown.append(Layout.from_state(*jax.tree.map(lambda x: x[0], seen)).names[0])
        return jax.tree.leaves(seen[0])[0].reshape(len(times), -1)[:, 0], strobe

    found, strobes = jax.jit(jax.vmap(follow))(dict(zip(names, columns, strict=True)))
    if not (right := (np.asarray(strobes) > 0) & np.isfinite(strobes)).all():
        wrong = np.asarray(strobes)[~right][0]
        raise ValueError(f"strobe is the period of the drive, a positive number; got {wrong:g}.")
    if found.shape != (columns.shape[1], len(times)):
        raise ValueError(f"value must return one number for one state; got shape {found.shape[2:]}.")
    return columns[0], np.asarray(found), (names[0], *(shown or ["value"]))


def energy_error(trajectory: Trajectory, *, scale: float | None = None, ax=None):
    """|h(t) − h(0)| / |h(0)| against time, on a logarithmic axis; of a batch the median, and 5 to 95 % of the members.

    It is an error where h should be constant. Where something does work, a force, friction, a drive, or a reset that
    takes energy, the axis says that it is a change. `scale` takes the place of |h(0)|; give it where the energy at the
    start is zero or close to it. Members that failed are left out.

    >>> lagjax.plot.energy_error(trajectory, scale=params["m"] * params["g"] * params["l"])
    """
    _require_numbers(trajectory, "trajectory")
    h = np.atleast_2d(trajectory.energy())[np.atleast_1d(trajectory.ok)]
    if not len(h):
        raise ValueError("None of the members reached its end: there is no energy to draw.")
    unit = np.abs(h[:, :1]) if scale is None else np.asarray(scale, float)
    if not np.all(unit > 0):
        raise ValueError("The energy at the start is zero: say with scale=... which energy counts as one.")
    ax = _prepare_axes(ax)
    error = np.abs(h - h[:, :1]) / unit
    known = np.array(np.isfinite(error).any(axis=0))  # nothing is left of members that an event has ended
    known[0] = False  # zero, which has no logarithm
    ts = Members(trajectory).shared(trajectory.ts, 1)
    if (ts != ts[0]).any():
        raise ValueError("The members have times of their own, at which no median is taken: draw one at a time.")
    times, error = ts[0, known], error[:, known]
    low, median, high = np.nanquantile(error, (0.05, 0.5, 0.95), axis=0)
    if len(h) > 1:
        ax.fill_between(times, low, high, color=COLORS[0], alpha=0.2, linewidth=0, label="5 to 95 % of the members")
    ax.plot(times, np.where(median > 0, median, np.nan), color=COLORS[0], linewidth=1.5, label="median")
    what = "change" if does_work(trajectory) or _loses_at_transitions(trajectory, h) else "error"
    ax.set(yscale="log", xlabel="t", ylabel=f"relative {what} of the energy")
    return _add_legend(ax) if len(h) > 1 else ax


def _loses_at_transitions(trajectory: Trajectory, h: np.ndarray) -> bool:
    """True if a transition changes the energy h by more than rounding."""
    if (changes := trajectory.transitions) is None:
        return False
    sides = (changes.q, changes.qdot, changes.source), (changes.q_next, changes.qdot_next, changes.target)
    at = functools.partial(dataclasses.replace, trajectory, ts=changes.t)
    before, after = (at(q=q, qdot=qdot, mode=mode).energy() for q, qdot, mode in sides)
    rounding = np.finfo(h.dtype).eps ** 0.5 * np.nanmax(np.abs(h))
    return bool(np.nanmax(np.abs(np.asarray(after - before)), initial=0.0) > rounding)


def work_precision(result: WorkPrecision, *, ax=None):
    """Time for one trajectory against its error, one line per solver, both axes logarithmic: lower left is better.

    Grey is what the reference cannot resolve.

    >>> lagjax.plot.work_precision(lagjax.work_precision(scene, q0, qdot0, ts, params))
    """
    _require_result(result, "result", WorkPrecision, "work_precision")
    ax = _prepare_axes(ax)
    for i, solver in enumerate(dict.fromkeys(row.solver for row in result)):
        rows = [row for row in result if row.solver == solver]
        color, marker = COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]
        errors, seconds = [row.error for row in rows], [row.seconds_per_trajectory for row in rows]
        ax.plot(errors, seconds, label=solver, color=color, marker=marker, linewidth=1.5, markersize=5.5)
    ax.set(xscale="log", yscale="log", xlabel="error", ylabel="time per trajectory [s]")
    left = min(ax.get_xlim()[0], result.reference_error / 3)
    ax.axvspan(left, result.reference_error, color="0.92", linewidth=0, zorder=0, label="not resolved")
    ax.set_xlim(left=left)
    return _add_legend(ax)


def fit(fit: Fit, record: int = 0, *, figure=None):
    """Data over fit of one record of a `Fit`, and the residuals with ±2σ below, a column for each signal.

    Draws into `figure`, or a new one, and returns the Axes (2, S). Records of several systems are counted through.

    >>> lagjax.plot.fit(fit, record=3)
    """
    _require_result(fit, "fit", Fit, "fit")
    one, columns = fit.records[record], fit.residual_function.columns(record)
    names = fit.residual_function.names[columns]
    figure = _new_wide_figure(len(names)) if figure is None else figure
    return draw_record(figure, one, fit.residual_matrices[record], names, fit.noise_scale.sigma[columns])


def profile(profile, *, ax=None):
    """The deviance of a `Profile` against its parameter: grey is what the level excludes, dashed lines are the ends.

    Only what is within three times the threshold is shown, but for other minima.

    >>> lagjax.plot.profile(fit.profile("params['friction']"))
    """
    ax = _prepare_axes(ax)
    values, deviance = np.asarray(profile.values), np.asarray(profile.deviance)
    near = deviance <= 3.0 * profile.threshold
    first, last = (0, len(near) - 1) if not near.any() else np.flatnonzero(near)[[0, -1]]
    shown = slice(max(first - 1, 0), last + 2)
    ax.plot(values[shown], deviance[shown], color=COLORS[0], marker="o", markersize=3.5, linewidth=1.5)
    for value, _ in profile.minima:
        ax.axvline(value, color=GREY, linewidth=0.8)
    for end in profile.interval:
        if np.isfinite(end):
            ax.axvline(end, color=COLORS[1], linewidth=1.2, linestyle="--")
    top = 3.0 * profile.threshold
    ax.axhspan(profile.threshold, top, color="0.92", linewidth=0, zorder=0, label=f"excluded at {profile.level:.0%}")
    ax.set(xlabel=profile.name, ylabel="deviance", ylim=(min(0.0, float(deviance.min())) - 0.02 * top, top))
    ax.locator_params(axis="x", nbins=6)
    return _add_legend(ax)


def state_map(x, y, values, *, label: str | None = None, cmap: str = "magma", norm=None, ax=None):
    """Values over a plane of initial states or parameters; NaN is left white.

    - `x`, `y`: the evenly spaced centres of the columns and rows, shapes (X,) and (Y,).
    - `values`: shape (Y, X). `label` names the colour bar, `norm` is any of matplotlib's.

    >>> lagjax.plot.state_map(th1, th2, flip_time, label="first flip [s]")
    """
    values = np.ma.masked_invalid(np.asarray(values))
    if values.shape != (len(y), len(x)):
        raise ValueError(f"values must have shape (len(y), len(x)) = {(len(y), len(x))}; got {values.shape}.")
    ax = _prepare_axes(ax)
    ax.grid(False)
    colors, extent = _import_matplotlib().colormaps[cmap].with_extremes(bad="white"), (*_cell_edges(x), *_cell_edges(y))
    style: dict[str, Any] = dict(origin="lower", aspect="auto", interpolation="nearest", cmap=colors, norm=norm)
    _add_colorbar(ax.imshow(values, extent=extent, **style), ax, label)
    return ax


def _import_matplotlib():
    return import_package("lagjax.plot", "matplotlib", "lagjax[examples]", "collections", "colors", "pyplot")


def _prepare_axes(ax):
    """`ax`, or the one of a new figure, with a light grid behind the data and no box around it."""
    if ax is None:
        _, ax = _import_matplotlib().pyplot.subplots(figsize=(6.4, 4.2), layout="constrained")
    return simplify_axes(ax)


def _require_period(period) -> float:
    if isinstance(period, bool) or np.ndim(period) or not np.isreal(period) or not 0 < period < np.inf:
        raise ValueError(f"period must be a positive number, 2π for an angle; got {period!r}.")
    return float(period)


def _angle_periods(layout: Layout, period) -> list[float | None]:
    """The period of every coordinate, None of those that are no angles."""
    leaves = spread_prefix(period, layout.restore(np.zeros(layout.size)), "period", "a number")
    sizes = [int(np.prod(shape)) for shape in layout.shapes]
    return [x if x is None else _require_period(x) for x, size in zip(leaves, sizes, strict=True) for _ in range(size)]


def _pair_of_periods(period, ax) -> tuple[float | None, float | None]:
    """The periods of x and y, whose axes get ticks of angles."""
    given = period if isinstance(period, tuple) and len(period) == 2 else (period, None)
    of_x, of_y = (None if one is None else _require_period(one) for one in given)
    for axis, one in ((ax.xaxis, of_x), (ax.yaxis, of_y)):
        _draw_angles(axis, [one])
    return of_x, of_y


def _wrap_values(x, period: float | None):
    """Values in −P/2 … P/2."""
    return x if period is None else x - period * np.floor(x / period + 0.5)


def _draw_angles(axis, periods: list[float | None]) -> None:
    """The limits of an axis and ticks at the quarters of the period that all of these share, as parts of π."""
    if len({*periods}) != 1 or (period := periods[0]) is None:
        return
    quarters = period * np.arange(-2, 3) / 4
    parts = [Fraction(x / np.pi).limit_denominator(24) for x in quarters]
    in_pi = np.allclose(np.array(parts, float) * np.pi, quarters, rtol=1e-6)
    axis.set_ticks(quarters, list(map(_name_angle, parts)) if in_pi else None)
    if axis.axes.get_label() != "<colorbar>":
        getattr(axis.axes, f"set_{axis.axis_name}lim")(1.02 * quarters[[0, -1]])


def _name_angle(part: Fraction) -> str:
    """This many π: "−π/2", "0", "3π/4"."""
    if not part:
        return "0"
    whole = "" if abs(part.numerator) == 1 else str(abs(part.numerator))
    return f"{'−' * (part < 0)}{whole}π{'' if part.denominator == 1 else f'/{part.denominator}'}"


def _scatter_points(ax, x, y, colors, size: float | None = None, **more):
    """Points whose `size` is by default what suits how many there are."""
    size = float(np.clip(2e4 / max(1, len(x)), 0.02, 9.0)) if size is None else size
    return ax.scatter(x, y, c=colors, s=size, linewidths=0, rasterized=True, **more)


def _new_wide_figure(columns: int):
    return _import_matplotlib().pyplot.figure(figsize=(max(6.4, 3.6 * columns), 4.6), layout="constrained")


def _add_legend(ax, shown: int = 0, layout: Layout | None = None):
    """The axes with a legend, whose title says how many coordinates are `shown` where these are not all."""
    title = None if layout is None or shown == layout.size else f"{shown} of {layout.size} coordinates"
    ax.legend(frameon=False, title=title)
    return ax


def _add_colorbar(mappable, ax, label):
    bar = ax.figure.colorbar(mappable, ax=ax, label=label, pad=0.02)
    bar.outline.set_visible(False)
    return bar


def _cell_edges(centres) -> tuple[float, float]:
    """The outer edges of evenly spaced cells."""
    if len(centres) < 2:
        raise ValueError("A map needs two columns and two rows at least: x and y are the centres of its cells.")
    half = (centres[-1] - centres[0]) / (len(centres) - 1) / 2
    return float(centres[0] - half), float(centres[-1] + half)


def _require_result(value, name: str, kind: type, function: str, more: str = "") -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be what lagjax.{function} returns{more}; got {type(value).__name__}.")


def _require_numbers(trajectory, name: str) -> None:
    _require_result(trajectory, name, Trajectory, "simulate")
    require_numbers(trajectory, "lagjax.plot draws")


def _require_count(count, name: str, least: int = 1) -> int:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < least:
        raise ValueError(f"{name} must be a whole number, {('zero', 'one')[least]} at least; got {count!r}.")
    return int(count)


def _member_curves(trajectory: Trajectory, members: int) -> tuple[Layout, list[tuple[np.ndarray, ...]]]:
    """The curves (t, q, q̇) of at most this many members, evenly chosen, and the layout of their coordinates."""
    _require_numbers(trajectory, "trajectory")
    chosen = even_places(max(1, np.size(trajectory.ok)), _require_count(members, "members"))
    layout, courses = courses_of(trajectory, chosen)
    return layout, [course.curve() for course in courses]


def _project_curves(layout: Layout, curves: list, projection: Callable) -> list[tuple[np.ndarray, np.ndarray]]:
    """The curves in the plane, x and y of each; NaN where a state jumps."""
    q, qdot = (np.concatenate([curve[part] for curve in curves]).astype(layout.dtype) for part in (1, 2))
    states = map(layout.restore, map(jnp.asarray, (q, qdot)))
    xy = np.where(np.isfinite(q).all(axis=1), np.stack(jax.vmap(_checked_projection(projection))(*states)), np.nan)
    return [tuple(part) for part in np.split(xy, np.cumsum([len(t) for t, _, _ in curves])[:-1], axis=1)]


def _checked_projection(projection: Callable) -> Callable:
    """A projection, with a sentence where it does not return two numbers."""

    try:
        inspect.signature(projection).bind(None, None)
        alone = False
    except TypeError:
        alone = True  # a function of q, as films take them
    except ValueError:  # without a signature
        alone = False

    def two_numbers(q, qdot):
        values = projection(q) if alone else projection(q, qdot)
        shapes = [jnp.shape(value) for value in values] if isinstance(values, tuple | list) else jnp.shape(values)
        if shapes not in ([(), ()], (2,)):
            raise ValueError(f"projection must return two numbers, (x, y), for one state; got shapes {shapes}.")
        return values[0], values[1]

    return two_numbers
