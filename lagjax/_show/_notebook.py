"""The HTML of a result in a notebook: its text, and a small picture beneath it if matplotlib is installed.

A picture shows a few members and a few hundred outputs, however many there are, so that it is as fast for a large
batch. Without matplotlib, or for traced values, the text is shown alone; the display of a result must not raise.
"""

import base64
import html
import io
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from lagjax._interface import ENDED_WELL, is_known
from lagjax._show._course import Course, courses_of, join_curve

MEMBERS, OUTPUTS, COORDINATES = 30, 400, 6  # that are drawn
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # of Okabe & Ito (2008)
_SIZE, _DPI = (5.2, 1.9), 144  # inches, and the dots of a fine screen


def html_cell(text: str, draw: Callable[[Any], None], size: tuple[float, float] = _SIZE) -> str | None:
    """Return HTML with a text and the picture that `draw(figure)` makes beneath it; None if drawing fails."""
    try:
        image = render_picture(size, draw)
    except Exception:  # no matplotlib, values that are no numbers, a font that is missing: the text says it all
        return None
    return (
        f'<div><pre style="margin:0;white-space:pre-wrap">{html.escape(text)}</pre><img alt="a small figure" '
        f'style="width:{96 * size[0]:.0f}px;max-width:100%" src="data:image/png;base64,{image}"></div>'
    )


def render_picture(size: tuple[float, float], draw: Callable[[Any], None], dpi: int = _DPI) -> str:
    """Return the picture that `draw(figure)` makes, as a PNG in base 64."""
    from matplotlib.figure import Figure

    figure, file = Figure(figsize=size, dpi=dpi, layout="constrained"), io.BytesIO()
    draw(figure)
    figure.savefig(file, format="png", metadata={"Software": None})
    return base64.b64encode(file.getvalue()).decode()


def trajectory_html(trajectory) -> str | None:
    """Return HTML of a trajectory: its summary, and coordinates against time; None for traced values."""
    leaves = [*jax.tree.leaves(trajectory.q), trajectory.ts, trajectory.result._value, trajectory.end.t]
    if not all(map(is_known, leaves)) or not leaves[0].size:
        return None
    return html_cell(repr(trajectory), lambda figure: _draw_curves(figure, trajectory))


def _draw_curves(figure, trajectory) -> None:
    codes = np.asarray(trajectory.result._value).ravel()
    members, ax = even_places(codes.size, MEMBERS), figure.subplots()
    layout, courses = courses_of(trajectory, members)
    curves = [_thin_curve(course) for course in courses]
    for name, color, i in zip(layout.names, COLORS, range(COORDINATES), strict=False):
        draw_curves(ax, [join_curve(t, q[:, i]) for t, q in curves], color, name)
    if layout.size > COORDINATES:
        ax.plot([], [], " ", label=f"… ({layout.size - COORDINATES} more)")
    for member in members[~np.isin(codes[members], ENDED_WELL)]:
        ax.axvline(np.ravel(trajectory.end.t)[member], color="0.4", linewidth=0.8, linestyle=":")
    simplify_axes(ax, width=0.6).tick_params(labelsize="small")
    ax.set_xlabel("t", fontsize="small")
    legend = ax.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    for handle in legend.legend_handles:
        handle.set_alpha(1.0)


def draw_curves(ax, curves: list, color: str, label: str | None = None, width: float = 1.2) -> None:
    """Plot curves (2, F) of some members in one colour; the first gets the label."""
    for k, curve in enumerate(curves):
        style = dict(color=color, alpha=max(0.15, len(curves) ** -0.5), linewidth=width)
        ax.plot(*curve, label=None if k else label, **style)


def _thin_curve(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return times (F,) and coordinates (F, n) of a curve; of many outputs only `OUTPUTS` evenly spaced times."""
    if len(course.t) <= OUTPUTS:
        return course.curve()[:2]
    times = np.linspace(course.t[0], course.t[-1], OUTPUTS)
    return times, course.states_at(times)[0]


def simplify_axes(ax, width: float = 0.8):
    """Give the axes a light grid behind the data and no box; return them."""
    ax.grid(color="0.9", linewidth=width)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("0.55")
    ax.tick_params(color="0.55")
    return ax


def even_places(count: int, most: int) -> np.ndarray:
    """Return at most `most` evenly spaced indices among 0 … count − 1."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
