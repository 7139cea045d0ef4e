"""A figure for each comparison, drawn from the stored record. A program has the same colour in all of them."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

Record = dict[str, Any]

COLOURS = {
    "lagjax": "#c1121f",
    "minimal coordinates": "#1d4e89",
    "lagjax, diffrax": "#ef8d7a",
    "lagjax, CPUs": "#ef8d7a",
    "lagjax, plain vmap": "#b07aa1",
    "lagjax, no jit": "#b07aa1",
    "diffrax, by hand": "#1d4e89",
    "diffrax, autodiff": "#6fa8dc",
    "heyoka, SIMD": "#3a9d5d",
    "heyoka, threads": "#14532d",
    "heyoka, single": "#9bc995",
    "numba": "#e09f3e",
    "REBOUND": "#17a2b8",
    "MuJoCo": "#7b4fa3",
    "SciPy + SymPy": "#7a6c5d",
}
GREY = "0.55"
LARGEST_PICTURE = 100_000  # bytes: the repository holds seven pictures, and all results well under a megabyte
COLOUR_COUNTS = (256, 192, 128, 96, 64, 48, 32, 24, 16)
STYLE = {
    "font.size": 10,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "0.4",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.8,
    "xtick.color": "0.3",
    "ytick.color": "0.3",
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.markersize": 4.5,
}


def draw(part: str, record: Record, folder: Path) -> list[Path]:
    """The figures of one part; none without matplotlib, or where there is nothing to show."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        return []
    paths = []
    with matplotlib.rc_context(STYLE):
        for name, size, fill in _figures_of(part, record[part]["rows"]):
            figure = Figure(figsize=size, layout="constrained")
            fill(figure)
            paths.append(save(figure, folder / f"{name}.png"))
    return paths


def save(figure, path: Path, dpi: int = 120) -> Path:
    """Write the figure as a small PNG file, and return its path."""
    from PIL import Image

    figure.savefig(path, dpi=dpi)
    write_picture(Image.open(path).convert("RGB"), path)
    return path


def write_picture(image, path: Path) -> None:
    """Write an RGB image as a PNG file of at most 100 kB, with as many colours as fit into it.

    The least are 16 colours, with which a picture of noise of more than 450 × 450 pixels may be larger.
    """
    from PIL import Image

    for colours in COLOUR_COUNTS:
        image.quantize(colours, kmeans=3, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size <= LARGEST_PICTURE:
            return


def _figures_of(part: str, rows: list[dict]) -> Iterable[tuple[str, tuple[float, float], Callable]]:
    if not rows:
        return
    if part in ("errors", "single", "mixed", "constraints"):
        for row in rows:
            name = row["case"] if part in ("errors", row["case"]) else f"{part}_{row['case']}"
            yield name, (8, 5), lambda figure, row=row: _error_against_time(figure.add_subplot(), row, part)
    if part in ("errors", "constraints") and len(rows) > 1:
        yield part, (12, 3.4 * -(-len(rows) // 3)), lambda figure: _overview(figure, rows)
    elif part in PLOTS:
        fill, size = PLOTS[part]
        yield part, size(rows) if callable(size) else size, lambda figure: fill(figure, rows)


# ---- errors against times --------------------------------------------------------------------------------------------


def _error_against_time(axes, row: dict, part: str) -> None:
    _curves(axes, row)
    axes.set_xlabel(f"median error at T = {row['duration']:.4g}")
    axes.set_ylabel("µs per trajectory")
    which = "one trajectory after the other" if part == "single" else f"{row['batch']} members"
    held = " with constraints" if part == "constraints" else ""
    axes.set_title(f"{_title(row['case'])}{held}, {which}")
    _name_the_lines(axes)


def _overview(figure, rows: list[dict]) -> None:
    """All scenes beside each other, with one legend."""
    grid = figure.subplots(-(-len(rows) // 3), 3, squeeze=False).ravel()
    for axes, row in zip(grid, rows, strict=False):
        _curves(axes, row)
        axes.set_title(f"{_title(row['case'])}", fontsize=10)
    for axes in grid[len(rows) :]:
        axes.set_visible(False)
    figure.supxlabel("median error at the end", fontsize=10)
    figure.supylabel("µs per trajectory", fontsize=10)
    lines = {line.get_label(): line for axes in grid for line in axes.get_lines() if line.get_label() in COLOURS}
    names = [name for name in COLOURS if name in lines]
    figure.legend([lines[name] for name in names], names, loc="outside upper center", ncols=5, frameon=False)


def _curves(axes, row: dict) -> None:
    for name in dict.fromkeys(point["contender"] for point in row["rows"]):
        points = [p for p in row["rows"] if p["contender"] == name and p["median_error"] is not None]
        errors = [max(p["median_error"], 1e-17) for p in points]
        _line(axes, name, errors, [1e6 * p["seconds"] for p in points])
    if row["reference_error"]:
        axes.axvline(row["reference_error"], color=GREY, linestyle=":", linewidth=1, zorder=0)
    axes.set_xscale("log")
    axes.invert_xaxis()
    _log(axes.yaxis)


# ---- series ----------------------------------------------------------------------------------------------------------


def _sizes(figure, rows: list[dict]) -> None:
    families = {"chain": ("links of the chain", "Chains of pendulums"), "bodies": ("bodies", "Softened gravity")}
    left, right = figure.subplots(1, 2)
    for axes, (family, (label, title)) in zip((left, right), families.items(), strict=True):
        some = [row for row in rows if row["family"] == family and row["tol"] == 1e-9]
        _series(axes, some, "size", "µs/trajectory")
        axes.set(xlabel=label, title=f"{title}, T = 2, tolerance 1e-9", ylabel="µs per trajectory")
        _ticks_at(axes, some, "size")
        _log(axes.yaxis)
        _name_the_lines(axes)


def _first_results(figure, rows: list[dict]) -> None:
    """Three marks for each scene: its first result, its first gradient, and `check`."""
    axes = figure.add_subplot()
    names = [row["scene"] for row in rows]
    kinds = (("first result s", "o", "#c1121f"), ("first gradient s", "D", "#1d4e89"), ("check s", "|", GREY))
    for kind, marker, colour in kinds:
        points = [(row[kind], place) for place, row in enumerate(rows) if row[kind] is not None]
        axes.plot(*zip(*points, strict=True), marker, color=colour, label=kind.removesuffix(" s"), linestyle="none")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="seconds", title="What one waits for, once")
    axes.legend(frameon=False)


def _latency(figure, rows: list[dict]) -> None:
    axes = figure.add_subplot()
    names = [row["way"] for row in rows]
    axes.barh(
        names, [row["µs"] for row in rows], color=[COLOURS.get(name.partition(", jit")[0], GREY) for name in names]
    )
    for place, row in enumerate(rows):
        axes.annotate(
            f"{row['µs']:.3g}", (row["µs"], place), (4, 0), textcoords="offset points", va="center", fontsize=9
        )
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="µs a call", title="One double pendulum over T = 5, tolerance 1e-9")


def _batches(figure, rows: list[dict]) -> None:
    axes = figure.add_subplot()
    _series(axes, rows, "batch", "µs/trajectory")
    device = f" ({rows[0]['device']} for JAX)" if "device" in rows[0] else ""
    axes.set(xscale="log", xlabel="members of the batch", ylabel="µs per trajectory")
    _log(axes.yaxis)
    axes.set_title(f"Double pendulum, tolerance 1e-9{device}")
    _name_the_lines(axes)


def _derivation(figure, rows: list[dict]) -> None:
    axes = figure.add_subplot()
    _series(axes, rows, "links", "first result s")
    axes.set(xlabel="links of the chain", ylabel="seconds", title="First result of a new process")
    _ticks_at(axes, rows, "links")
    _log(axes.yaxis)
    _name_the_lines(axes)


def _cores(figure, rows: list[dict]) -> None:
    cases = list(dict.fromkeys(row["case"] for row in rows))
    most = max(row["cores"] for row in rows)
    for axes, case in zip(figure.subplots(1, len(cases), sharey=True, squeeze=False)[0], cases, strict=True):
        axes.plot([1, most], [1, most], color=GREY, linestyle=":", linewidth=1)
        _series(axes, [row for row in rows if row["case"] == case], "cores", "times faster than one")
        axes.set(xlabel="cores", ylabel="times faster than one core", title=_title(case))
        axes.set_xticks(sorted({row["cores"] for row in rows}))
        axes.label_outer()
        _name_the_lines(axes)


def _series(axes, rows: list[dict], x: str, y: str) -> None:
    for name in dict.fromkeys(row["contender"] for row in rows):
        points = [row for row in rows if row["contender"] == name and row[y] is not None]
        _line(axes, name, [p[x] for p in points], [p[y] for p in points])


def _ticks_at(axes, rows: list[dict], column: str) -> None:
    values = sorted({row[column] for row in rows})
    axes.set_xscale("log")
    axes.set_xticks(values, [str(value) for value in values], minor=False)
    axes.set_xticks([], minor=True)


def _log(axis) -> None:
    """A logarithmic axis with plain numbers, and with some between the powers of ten where there are few of those."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    (axis.axes.set_xscale if axis.axis_name == "x" else axis.axes.set_yscale)("log")
    low, high = np.log10(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if abs(high - low) < 2 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


# ---- rows of dots ----------------------------------------------------------------------------------------------------


def _right_hand_sides(figure, rows: list[dict]) -> None:
    axes = figure.add_subplot()
    columns = {"lagjax ns": "lagjax", "by hand ns": "diffrax, by hand", "autodiff ns": "diffrax, autodiff"}
    labels = {"lagjax ns": "lagjax", "by hand ns": "by hand, XLA", "autodiff ns": "autodiff, XLA and LAPACK"}
    for column, name in columns.items():
        _dots(axes, [row[column] for row in rows], COLOURS[name], labels[column])
    _rungs(axes, [_title(row["case"]) for row in rows])
    axes.set_xlabel("ns per evaluation and member")
    _log(axes.xaxis)
    _legend_above(axes, "One evaluation of the accelerations")


def _gradient(figure, rows: list[dict]) -> None:
    axes = figure.add_subplot()
    columns = {"reverse/solve": "reverse mode", "forward/solve": "forward mode"}
    for (column, label), colour in zip(columns.items(), ("#c1121f", "#1d4e89"), strict=True):
        _dots(axes, [row[column] for row in rows], colour, label)
    _rungs(axes, [f"{row['contender']}, {row['tol']:.0e}" for row in rows])
    axes.set_xlabel("times a solve")
    _log(axes.xaxis)
    _legend_above(axes, f"Gradient by 8 parameters, {rows[0]['steps']:.0f} steps")


def _dots(axes, values: list[float | None], colour: str, label: str) -> None:
    known = [(value, y) for y, value in enumerate(values) if value is not None]
    axes.plot(*zip(*known, strict=True), "o", color=colour, markersize=8, label=label, markeredgecolor="white")


def _rungs(axes, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(True, axis="x")
    axes.tick_params(axis="y", length=0)


def _legend_above(axes, title: str) -> None:
    axes.set_title(title, pad=26)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3, frameon=False, handletextpad=0.2, fontsize=9)


# ---- lines and their names -------------------------------------------------------------------------------------------


def _line(axes, name: str, x: list[float], y: list[float]) -> None:
    ours = name == "lagjax"
    axes.plot(
        x, y, "o-", color=COLOURS.get(name, GREY), label=name, linewidth=2.6 if ours else 1.4, zorder=3 if ours else 2
    )


def _name_the_lines(axes) -> None:
    """The name of each line beside its last point, moved apart where they would overlap."""
    lines = [line for line in axes.get_lines() if line.get_label() in COLOURS and len(line.get_xdata())]
    if not lines:
        return
    axes.autoscale_view()
    to_axes = axes.transData + axes.transAxes.inverted()
    ends = np.array([to_axes.transform((line.get_xdata()[-1], line.get_ydata()[-1])) for line in lines])
    for line, (x, y), place in zip(lines, ends, _apart(ends[:, 1]), strict=True):
        colour = line.get_color()
        axes.plot(
            [x, 1.02], [y, place], ":", color=colour, alpha=0.6, linewidth=1, transform=axes.transAxes, clip_on=False
        )
        weight = "bold" if line.get_label() == "lagjax" else "normal"
        axes.text(1.03, place, line.get_label(), color=colour, transform=axes.transAxes, va="center", fontsize=9,
                  fontweight=weight)  # fmt: skip


def _apart(heights: np.ndarray, gap: float = 0.055) -> np.ndarray:
    """The heights, moved as little as need be for neighbours to be `gap` apart: those that overlap share their mean."""
    order = np.argsort(heights)
    groups = []  # (height of the lowest, members, index of the lowest)
    for k, wish in enumerate(heights[order]):
        groups.append([wish, 1, k])
        while len(groups) > 1 and groups[-2][0] + gap * groups[-2][1] > groups[-1][0]:
            (low, m, start), (high, n, _) = groups[-2], groups.pop()
            groups[-1] = [(m * low + n * (high - gap * m)) / (m + n), m + n, start]
    places = np.empty_like(heights)
    for low, members, start in groups:
        places[order[start : start + members]] = low + gap * np.arange(members)
    return places


def _title(case: str) -> str:
    return case.replace("_", " ").capitalize()


PLOTS: dict[str, tuple[Callable, Any]] = {
    "sizes": (_sizes, (13, 5)),
    "first_results": (_first_results, (8, 6)),
    "latency": (_latency, (8, 3)),
    "batches": (_batches, (8, 5)),
    "gpu": (_batches, (8, 5)),
    "derivation": (_derivation, (8, 5)),
    "cores": (_cores, (11, 4.5)),
    "right_hand_sides": (_right_hand_sides, (8, 4.5)),
    "gradient": (_gradient, (7, 3.2)),
}
