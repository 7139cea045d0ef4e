"""One figure: what the hard cases look like, and how near the truth each of them came."""

from collections.abc import Callable
from pathlib import Path as File

import numpy as np

from benchmarks._figures import COLOURS, GREY, STYLE, save
from benchmarks._hard import _borders, _chaos, _fields, _gravity, _rotation
from benchmarks._hard._case import Path, follow
from lagjax import scenes

OURS, PEER = COLOURS["lagjax"], COLOURS["diffrax, by hand"]
LEAST = 1e-17  # what is drawn for an error of zero


def _plane(path: Path) -> list:
    return [(path.q[:, 0], path.q[:, 1])]


def _bodies(path: Path) -> list:
    return [(path.q[:, body, 0], path.q[:, body, 1]) for body in range(path.q.shape[1])]


def _polar(path: Path) -> list:
    return [(path.q.r * np.cos(path.q.phi), path.q.r * np.sin(path.q.phi))]


def _swing(path: Path) -> list:
    return [(path.q.r * np.sin(path.q.theta), -path.q.r * np.cos(path.q.theta))]


def _axis(path: Path) -> list:
    return [tuple(_rotation.along(lambda q, v: _rotation.third_axis(q), path)[:, :2].T)]


def _vertical(path: Path) -> list:
    return [tuple(_rotation.along(lambda q, v: _rotation.vertical(q), path)[:, :2].T)]


def _blade(path: Path) -> list:
    return [(path.q.x, path.q.y)]


def _phases(path: Path) -> list:
    return [(path.q, path.qdot)]


# The first words of a case: its scene, the time shown, and the lines to draw.
PORTRAITS: dict[str, tuple[Callable, float, Callable]] = {
    "Arenstorf": (scenes.restricted_three_body, 17.0652, _plane),
    "Figure eight": (scenes.figure_eight, 6.3259, _bodies),
    "Burrau": (_gravity.pythagoras, 62.0, _bodies),
    "Schwarzschild": (_gravity.schwarzschild, 1500.0, _polar),
    "Swinging Atwood": (scenes.swinging_atwood, 60.0, _swing),
    "Störmer": (_fields.dipole, 250.0, _plane),
    "Lagrange": (_rotation.lagrange_top, 20.0, _axis),
    "Kovalevskaya": (_rotation.kovalevskaya_top, 60.0, _vertical),
    "Hénon": (_chaos.henon_heiles, 300.0, _plane),
    "Chaplygin": (scenes.chaplygin_sleigh, 5.0, _blade),
    **{name: (*portrait, _phases) for name, portrait in _borders.PORTRAITS.items()},  # velocity against place
}
IN_A_ROW = 5


def draw(rows: list[dict], folder: File) -> File | None:
    """`hard_cases.png` in that folder; nothing without matplotlib."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        return None
    rows = [row for row in rows if row["error"] is not None]
    shown = {name: p for name, p in PORTRAITS.items() if any(row["case"].startswith(name) for row in rows)}
    above, below = 2.6 * -(-len(shown) // IN_A_ROW), 1.2 + 0.3 * len(rows)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, above + below), layout="constrained")
        if shown:
            top, bottom = figure.subfigures(2, 1, height_ratios=[above, below])
            grid = top.subplots(-(-len(shown) // IN_A_ROW), IN_A_ROW, squeeze=False).ravel()
            for axes in grid:
                axes.set_axis_off()
            for axes, (name, portrait) in zip(grid, shown.items(), strict=False):
                _portrait(axes, name, *portrait)
        else:
            bottom = figure
        _errors(bottom.add_subplot(), rows)
        return save(figure, folder / "hard_cases.png", dpi=80)


def _portrait(axes, name: str, scene: Callable, time: float, lines: Callable) -> None:
    ts = np.linspace(0.0, time, 4001)
    run = follow(scene(), ts, 1e-12)
    for x, y in lines(Path(ts, run.q, run.qdot)):
        axes.plot(x, y, linewidth=0.7)
    axes.set_title(name, fontsize=10)
    axes.set_aspect("equal", adjustable="datalim")


def _errors(axes, rows: list[dict]) -> None:
    for y, row in enumerate(rows):
        error, bound = max(row["error"], LEAST), max(row["bound"], LEAST)
        axes.plot([error, bound], [y, y], color=OURS, linewidth=1, alpha=0.35)
        axes.plot(bound, y, "|", color=OURS, markersize=8)
        if row["its error"] is not None:
            axes.plot(max(row["its error"], LEAST), y, "o", color=PEER, markersize=6)
        axes.plot(error, y, "o", color=OURS, markersize=7)
        if row["good to"]:
            axes.plot(row["good to"], y, "d", color=GREY, markersize=4, zorder=0)
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), [row["case"] for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(True, axis="x")
    for label, style in {
        "lagjax": {"marker": "o", "color": OURS},
        "its bound in the tests": {"marker": "|", "color": OURS},
        "best peer, tightest setting": {"marker": "o", "color": PEER},
        "how good the reference is": {"marker": "d", "color": GREY},
    }.items():
        axes.plot([], [], linestyle="", label=label, **style)
    axes.set_xlabel("error, in the units of the case")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False, fontsize=9)
