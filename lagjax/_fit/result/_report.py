"""Report: a fit in words, in figures drawn with matplotlib, and as a page of HTML with these inside.

It holds `lab_book` (what `print(fit)` shows), the functions that draw, `SystemDrawing` and `render_page`.

The figures do without the state machine of matplotlib, and `lagjax.plot` draws them too.
"""

import base64
import html
import io
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from lagjax._fit.model._records import Record
from lagjax._fit.result._information import LEVEL

BLUE, RED, GREY = "#0072B2", "#D55E00", "0.55"
_MOST = 4000  # samples in one curve: more do not show


def matplotlib_or_refuse(what: str) -> Any:
    """The module matplotlib. Raises `ImportError` with a sentence where it is missing."""
    try:
        import matplotlib.figure
    except ImportError:
        raise ImportError(f"{what} needs the package matplotlib: pip install lagjax[examples].") from None
    return matplotlib


def draw_record(axes, record: Record, residuals: np.ndarray, names: tuple[str, ...], sigma: np.ndarray) -> None:
    """Data over fit in the first row of `axes` (2, S), residuals (T, S) with ±2σ below, a column for each signal."""
    some = np.unique(np.linspace(0, len(record) - 1, _MOST).astype(int))
    ts, measured, left = record.ts[some], record.matrix[some], residuals[some]
    for s, name in enumerate(names):
        above, below = axes[0][s], axes[1][s]
        above.plot(ts, measured[:, s], ".", color=GREY, markersize=3.0, label="measured")
        above.plot(ts, measured[:, s] + left[:, s], color=BLUE, linewidth=1.3, label="fit")
        below.axhspan(-2 * sigma[s], 2 * sigma[s], color="0.92", linewidth=0, zorder=0, label="±2σ")
        below.plot(ts, left[:, s], ".", color=RED, markersize=2.5)
        above.set_title(name, fontsize="medium")
        below.set_xlabel("t")
        for ax in (above, below):
            style_axes(ax)
            ax.set_xlim(record.ts[0], record.ts[-1])
        above.tick_params(labelbottom=False)
    axes[0][0].set_ylabel("signal")
    axes[1][0].set_ylabel("residual")
    axes[0][0].legend(frameon=False, fontsize="small", ncols=2)


def draw_waterfall(ax, misfits: np.ndarray) -> None:
    known = np.isfinite(misfits)
    ax.plot(np.arange(1, len(misfits) + 1)[known], misfits[known], "o-", color=BLUE, markersize=3, linewidth=1)
    ax.set(yscale="log", xlabel="start, in order", ylabel="misfit / signals")
    style_axes(ax)


def draw_correlations(ax, matrix: np.ndarray, names: tuple[str, ...]) -> None:
    """A covariance as correlations, with numbers where there is room."""
    deviation = np.sqrt(np.where(np.isfinite(np.diag(matrix)), np.diag(matrix), np.nan))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = matrix / np.outer(deviation, deviation)
    image = ax.imshow(np.ma.masked_invalid(correlation), vmin=-1, vmax=1, cmap="RdBu_r")
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize="small")
    ax.set_yticks(range(len(names)), names, fontsize="small")
    if len(names) <= 12:
        for i, j in np.argwhere(np.isfinite(correlation)):
            dark = abs(correlation[i, j]) > 0.6
            ax.text(j, i, f"{correlation[i, j]:.2f}", ha="center", va="center", fontsize="x-small",
                    color="white" if dark else "black")  # fmt: skip
    ax.figure.colorbar(image, ax=ax, shrink=0.8)


def draw_residuals(ax, residuals: np.ndarray, sigma: np.ndarray, names: tuple[str, ...]) -> None:
    bins = np.linspace(-5, 5, 51)
    for s, name in enumerate(names[:6]):
        z = residuals[:, s] / sigma[s]
        ax.hist(np.clip(z[np.isfinite(z)], -5, 5), bins=bins, density=True, histtype="step", linewidth=1.3, label=name)
    x = np.linspace(-5, 5, 201)
    ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color=GREY, linewidth=1, label="normal")
    ax.set(yscale="log", ylim=(1e-4, 2), xlabel="residual / σ", ylabel="density")
    ax.legend(frameon=False, fontsize="small")
    style_axes(ax)


def style_axes(ax) -> None:
    """A light grid behind the data and no box around it."""
    ax.grid(color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(GREY)
    ax.tick_params(color=GREY)


_RECORDS, _SIGNALS = 6, 6  # that are drawn
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2.2rem }
table { border-collapse: collapse } td, th { padding: .2rem .9rem .2rem 0; text-align: right; font-weight: normal }
th { border-bottom: 1px solid #999; color: #555 } td:first-child, th:first-child { text-align: left }
img { max-width: 100% } pre { background: #f4f4f4; padding: .7rem; overflow-x: auto } .no { color: #a33 }
"""


def render_page(
    title: str, message: str, ok: bool, unseen: Sequence[str], tables: dict[str, list[list[str]]],
    figures: dict[str, list[str]], texts: dict[str, str],
) -> str:  # fmt: skip
    """The file: a verdict, what is not seen, tables by their headings, pictures, and texts as they are printed."""
    escaped = html.escape
    parts = [f"<h1>{escaped(title)}</h1>", f"<p{'' if ok else ' class=no'}>{escaped(message)}</p>"]
    parts += [f'<p class="no">Not seen: {escaped(sentence)}</p>' for sentence in unseen]
    for heading, (head, *rows) in tables.items():
        cells = "".join(f"<th>{escaped(cell)}</th>" for cell in head)
        body = "".join("<tr>" + "".join(f"<td>{escaped(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        parts.append(f"<h2>{escaped(heading)}</h2><table><tr>{cells}</tr>{body}</table>")
    for heading, text in texts.items():
        parts.append(f"<h2>{escaped(heading)}</h2><pre>{escaped(text)}</pre>")
    for heading, pictures in figures.items():
        images = "".join(f'<p><img alt="{escaped(heading)}" src="data:image/png;base64,{one}"></p>' for one in pictures)
        parts.append(f"<h2>{escaped(heading)}</h2>{images}")
    head = f'<meta charset="utf-8"><title>{escaped(title)}</title><style>{_STYLE}</style>'
    return f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _render_picture(size: tuple[float, float], draw: Callable[[Any], None]) -> str:
    matplotlib = matplotlib_or_refuse("Fit.report")
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained", dpi=110)
    draw(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return base64.b64encode(file.getvalue()).decode()


class SystemDrawing(NamedTuple):
    """Records of one system, their residuals (T, S), and its signals with their noise (S,); `name` None: the only."""

    name: str | None
    records: list
    residuals: list[np.ndarray]
    names: tuple[str, ...]
    sigma: np.ndarray


def build_pictures(systems: list[SystemDrawing], covariance, waterfall) -> dict[str, list[str]]:
    figures = {}
    for system in systems:
        of_one = "" if system.name is None else f"{system.name}: "
        figures |= {of_one + heading: pictures for heading, pictures in _record_figures(*system[1:]).items()}
    side = min(3.2 + 0.45 * len(covariance.names), 12.0)
    if covariance.names:
        figures["Correlations of the parameters"] = [
            _render_picture(
                (side + 1.0, side), lambda f: draw_correlations(f.subplots(), covariance.matrix, covariance.names)
            )
        ]
    if waterfall is not None:
        figures["Waterfall of the starts"] = [
            _render_picture((6.4, 3.2), lambda figure: draw_waterfall(figure.subplots(), waterfall.misfits))
        ]
    return figures


def _record_figures(records, residuals: list[np.ndarray], names, sigma) -> dict[str, list[str]]:
    """Data over fit of the records of one system, whose residuals are (T, S), by their headings."""
    count = min(len(names), _SIGNALS)

    def draw_one(k):
        def draw(figure):
            axes = figure.subplots(2, count, squeeze=False, gridspec_kw={"height_ratios": [2, 1]})
            draw_record(axes, records[k], residuals[k], names[:count], sigma)
            figure.suptitle(f"records[{k}]", fontsize="medium")

        return _render_picture((max(6.4, 3.6 * count), 4.2), draw)

    figures = {}
    if len(records):
        shown = np.unique(np.linspace(0, len(records) - 1, min(len(records), _RECORDS)).astype(int))
        heading = "Data over fit, and residuals"
        if len(shown) < len(records) or count < len(names):
            heading += f" (records {', '.join(map(str, shown))} of {len(records)}; {count} of {len(names)} signals)"
        figures[heading] = [draw_one(k) for k in shown]
        every = np.concatenate(residuals)
        figures["Residuals against the normal distribution"] = [
            _render_picture((6.4, 3.6), lambda figure: draw_residuals(figure.subplots(), every, sigma, names))
        ]
    return figures


_LISTED = 8  # numbers of one array that a table lists; of more it says how many there are


def lab_book(fit) -> str:
    """The table of parameters, the noise of the signals, what is not seen, and the verdict."""
    lines = [
        build_title(fit),
        "",
        *_table_of_parameters(fit),
        "",
        *_table_of_noise(fit),
        "",
    ]
    lines += [f"not seen    {sentence}" for sentence in fit.unseen]
    if fit.waterfall is not None:
        lines.append(f"starts      {fit.waterfall}")
    lines.append(f"verdict     {fit.message}")
    return "\n".join(lines)


def build_title(fit) -> str:
    samples = sum(noise.samples for noise in fit.noise.values())
    spans = [record.ts[-1] - record.ts[0] for record in fit.records]
    plural = "s" if len(fit.records) > 1 else ""
    of_records = f"{len(fit.records)} record{plural}, {sum(spans):g} long, {samples} values"
    return f"Fit of {len(fit.u)} parameter{'s' * (len(fit.u) != 1)} to {of_records}"


def cells_of_parameters(fit) -> list[list[str]]:
    low, high = fit._ends(LEVEL)
    rows = [["parameter", "value", "from", f"to ({100 * LEVEL:g} %)", "± relative"]]
    for name, x, a, b in zip(fit.parameters.names, fit.parameters.values(fit.u), low, high, strict=True):
        half = 50 * (b - a) / abs(x) if x else np.inf
        rows.append([name, f"{x:.6g}", f"{a:.6g}", f"{b:.6g}", f"{half:.2g} %" if np.isfinite(half) else "not seen"])
    return rows


def cells_of_noise(fit) -> list[list[str]]:
    rows = [["signal", "RMS", "σ", "ν", "samples", "effective", "Durbin–Watson"]]
    for (name, noise), rms in zip(fit.noise.items(), fit.rms.values(), strict=True):
        numbers = f"{rms:.3g}", f"{noise.sigma:.3g}", f"{noise.dof:.3g}", f"{noise.samples}", f"{noise.effective:.0f}"
        rows.append([name, *numbers, f"{noise.durbin_watson:.2f}"])
    return rows


def _table_of_parameters(fit) -> list[str]:
    if not fit.parameters.names:
        return ["All parameters are kept: starts and noise were fitted."]
    low, high = fit._ends(LEVEL)
    values = fit.parameters.values(fit.u)
    width = max(len(name) for name in (*fit.parameters.names, "parameter"))
    rows = [f"{'parameter':<{width}}  {'value':>12}  {f'{100 * LEVEL:g} % interval':>27}  relative"]
    owners = [part.label for part in fit.parameters.parts for _ in part.places]
    many = {label: count for label, count in Counter(owners).items() if count > _LISTED}
    for label, count in many.items():
        rows.append(f"{label:<{width}}  {f'{count} numbers':>12}")
    for owner, name, x, a, b in zip(owners, fit.parameters.names, values, low, high, strict=True):
        if owner in many:
            continue
        relative = 100 * (b - a) / 2 / abs(x) if x else np.inf
        shown = f"± {relative:.2g} %" if np.isfinite(relative) else "not seen"
        rows.append(f"{name:<{width}}  {x:>12.6g}  {a:>12.6g} … {b:>12.6g}  {shown}")
    return rows


def _table_of_noise(fit) -> list[str]:
    width = max(len(name) for name in (*fit.noise, "signal"))
    has_tails = any(np.isfinite(noise.dof) for noise in fit.noise.values())
    tails = "         ν" if has_tails else ""
    head = f"{'signal':<{width}}  {'RMS':>10}  {'noise σ':>10}{tails}"
    rows = [f"{head}  {'samples':>8}  {'effective':>9}  Durbin–Watson"]
    for (name, noise), rms in zip(fit.noise.items(), fit.rms.values(), strict=True):
        tail = f"{noise.dof:>10.3g}" if has_tails else ""
        rows.append(
            f"{name:<{width}}  {rms:>10.3g}  {noise.sigma:>10.3g}{tail}  {noise.samples:>8}  {noise.effective:>9.0f}  "
            f"{noise.durbin_watson:.2f}"
        )
    return rows


def record_matrix(values: Any, record) -> np.ndarray:
    """Signals in the structure of a record's values, side by side (T, S); times end to end (M, 1)."""
    if not isinstance(record, Record):
        return record.columns(values)
    return np.concatenate([np.reshape(leaf, (len(record), -1)) for leaf in jax.tree.leaves(values)], axis=1)
