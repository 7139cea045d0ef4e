"""Report: a fit in words (`lab_book`), in figures drawn with matplotlib, and as a page of HTML with these inside.

The figures do without the state machine of matplotlib, and `lagjax.plot` draws them too.
"""

import html
from collections import Counter

import numpy as np

from lagjax._fit.model._records import Record
from lagjax._fit.model._residuals import SystemResiduals
from lagjax._fit.result._information import LEVEL
from lagjax._show import even_places, import_package, render_picture, simplify_axes

BLUE, RED, GREY = "#0072B2", "#D55E00", "0.55"
_MOST_DRAWN = 4000  # samples in one curve: more do not show


def draw_record(figure, record: Record, residuals: np.ndarray, names: tuple[str, ...], sigma: np.ndarray):
    """Axes (2, S) with data over fit above and residuals (T, S) with ±2σ below, a column for each signal."""
    axes = figure.subplots(2, len(names), squeeze=False, sharex="col", gridspec_kw={"height_ratios": [2, 1]})
    some = even_places(len(record), _MOST_DRAWN)
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
            simplify_axes(ax)
            ax.set_xlim(record.ts[0], record.ts[-1])
    axes[0][0].set_ylabel("signal")
    axes[1][0].set_ylabel("residual")
    axes[0][0].legend(frameon=False, fontsize="small", ncols=2)
    return axes


def draw_waterfall(ax, misfits: np.ndarray) -> None:
    known = np.isfinite(misfits)
    ax.plot(np.arange(1, len(misfits) + 1)[known], misfits[known], "o-", color=BLUE, markersize=3, linewidth=1)
    ax.set(yscale="log", xlabel="start, in order", ylabel="misfit / signals")
    simplify_axes(ax)


def draw_correlations(ax, matrix: np.ndarray, names: tuple[str, ...]) -> None:
    deviation = np.sqrt(np.where(np.isfinite(np.diag(matrix)), np.diag(matrix), np.nan))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = matrix / np.outer(deviation, deviation)
    image = ax.imshow(np.ma.masked_invalid(correlation), vmin=-1, vmax=1, cmap="RdBu_r")
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize="small")
    ax.set_yticks(range(len(names)), names, fontsize="small")
    if len(names) <= 12:
        for i, j in np.argwhere(np.isfinite(correlation)):
            color = "white" if abs(correlation[i, j]) > 0.6 else "black"
            ax.text(j, i, f"{correlation[i, j]:.2f}", ha="center", va="center", fontsize="x-small", color=color)
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
    simplify_axes(ax)


_RECORDS, _SIGNALS, _DPI = 6, 6, 110  # that are drawn; dots of an inch
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2.2rem }
img { max-width: 100% } pre { background: #f4f4f4; padding: .7rem; overflow-x: auto } .no { color: #a33 }
"""


def render_page(fit, texts: dict[str, str]) -> str:
    """The file of a fit: its verdict, lab book, pictures, and texts by their headings. Raises without matplotlib."""
    import_package("Fit.report", "matplotlib", "lagjax[examples]")
    escaped, title = html.escape, build_title(fit)
    parts = [f"<h1>{escaped(title)}</h1>", f"<p{'' if fit.ok else ' class=no'}>{escaped(fit.message)}</p>"]
    for heading, text in {"Parameters and noise": lab_book(fit), **texts}.items():
        parts.append(f"<h2>{escaped(heading)}</h2><pre>{escaped(text)}</pre>")
    for heading, pictures in _build_pictures(fit).items():
        images = "".join(f'<p><img alt="{escaped(heading)}" src="data:image/png;base64,{one}"></p>' for one in pictures)
        parts.append(f"<h2>{escaped(heading)}</h2>{images}")
    head = f'<meta charset="utf-8"><title>{escaped(title)}</title><style>{_STYLE}</style>'
    return f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _build_pictures(fit) -> dict[str, list[str]]:
    figures = {}
    for part in fit.residual_function.parts:
        of_one = "" if part.name is None else f"{part.name}: "
        figures |= {of_one + heading: pictures for heading, pictures in _draw_records(fit, part).items()}
    names, matrix = fit.covariance
    shared = np.flatnonzero(np.array(names) == np.array(fit.parameters.elements))  # one line a record hides the others
    names, matrix = tuple(names[k] for k in shared), matrix[np.ix_(shared, shared)]
    if names:
        side = min(3.2 + 0.45 * len(names), 12.0)
        picture = render_picture((side + 1.0, side), lambda f: draw_correlations(f.subplots(), matrix, names), _DPI)
        figures["Correlations of the parameters"] = [picture]
    if fit.waterfall is not None:
        picture = render_picture((6.4, 3.2), lambda f: draw_waterfall(f.subplots(), fit.waterfall.misfits), _DPI)
        figures["Waterfall of the starts"] = [picture]
    return figures


def recordings(fit, part: SystemResiduals) -> list[tuple[Record, np.ndarray]]:
    """The records of one system of a fit, each with its residuals (T, S)."""
    pairs = zip(part.records, fit.residual_matrices[part.frame.records], strict=True)
    return [pair for pair in pairs if isinstance(pair[0], Record)]


def _draw_records(fit, part: SystemResiduals) -> dict[str, list[str]]:
    pairs, names, sigma = recordings(fit, part), part.signals.names, part.sensor_noise(fit.noise_scale).sigma
    if not pairs:
        return {}
    count = min(len(names), _SIGNALS)

    def draw_one(k: int) -> str:
        def draw(figure):
            draw_record(figure, *pairs[k], names[:count], sigma)
            figure.suptitle(f"records[{k}]", fontsize="medium")

        return render_picture((max(6.4, 3.6 * count), 4.2), draw, _DPI)

    shown = even_places(len(pairs), _RECORDS)
    heading = "Data over fit, and residuals"
    if len(shown) < len(pairs) or count < len(names):
        heading += f" (records {', '.join(map(str, shown))} of {len(pairs)}; {count} of {len(names)} signals)"
    every = np.concatenate([r for _, r in pairs])
    against = render_picture((6.4, 3.6), lambda f: draw_residuals(f.subplots(), every, sigma, names), _DPI)
    return {heading: [draw_one(k) for k in shown], "Residuals against the normal distribution": [against]}


_LISTED = 8  # numbers of one array that a table lists; of more it says how many there are


def lab_book(fit) -> str:
    """The table of parameters, the noise of the signals, what is not seen, and the verdict."""
    parameters = ["All parameters are kept: starts and noise were fitted."]
    if fit.parameters.names:
        parameters = _align(_parameter_cells(fit), {"value": 12, f"{100 * LEVEL:g} % interval": 27})
    noise = _align(_noise_cells(fit), {"RMS": 10, "noise σ": 10, "ν": 8, "samples": 8, "effective": 9})
    lines = [build_title(fit), "", *parameters, "", *noise, ""]
    lines += [] if fit.selection is None else [*fit.selection.text.splitlines(), ""]
    lines += [f"not seen    {sentence}" for sentence in fit.unseen]
    if fit.waterfall is not None:
        lines.append(f"starts      {fit.waterfall}")
    lines.append(f"verdict     {fit.message}")
    return "\n".join(lines)


def build_title(fit) -> str:
    samples = sum(noise.samples for noise in fit.noise.values())
    long, plural = sum(record.ts[-1] - record.ts[0] for record in fit.records), "s" * (len(fit.records) > 1)
    of_records = f"{len(fit.records)} record{plural}, {long:g} long, {samples} values"
    return f"Fit of {len(fit.u)} parameter{'s' * (len(fit.u) != 1)} to {of_records}"


def _parameter_cells(fit) -> list[list[str]]:
    """The table of the free numbers, its head first: of long arrays their number."""
    rows = [["parameter", "value", f"{100 * LEVEL:g} % interval", "relative"]]
    low, high = fit._ends(LEVEL)
    names, values, elements = fit.parameters.names, fit.parameters.values(fit.u), np.array(fit.parameters.elements)
    owners = [part.label for part in fit.parameters.parts for _ in part.places]
    count_of, told = Counter(owners), set()
    for k, (owner, element, name) in enumerate(zip(owners, elements.tolist(), names, strict=True)):
        if element != name and element not in told:
            own = elements == element
            rows.append(_record_cells(element, values[own], 0.5 * (high - low)[own]))
        elif element == name and count_of[owner] <= _LISTED:
            relative = 50 * (high[k] - low[k]) / abs(values[k]) if values[k] else np.inf
            shown = f"± {relative:.2g} %" if np.isfinite(relative) else "not seen"
            rows.append([name, f"{values[k]:.6g}", f"{low[k]:>12.6g} … {high[k]:>12.6g}", shown])
        elif element == name and owner not in told:
            rows.append([owner, f"{count_of[owner]} numbers", "", ""])
        told |= {owner, element}
    return rows


def _record_cells(name: str, values: np.ndarray, half_widths: np.ndarray) -> list[str]:
    """The line of a number that has a value in every record: the mean, the scatter, and how well one is known."""
    scatter = np.std(values, ddof=1) if len(values) > 1 else 0.0
    each = f"each ± {np.median(half_widths):.2g}" if np.isfinite(half_widths).all() else "not seen in every record"
    return [name, f"{np.mean(values):.6g}", f"scatter {scatter:.3g} over {len(values)} records", each]


def _noise_cells(fit) -> list[list[str]]:
    rows = [["signal", "RMS", "noise σ", "ν", "samples", "effective", "Durbin–Watson"]]
    for (name, noise), rms in zip(fit.noise.items(), fit.rms.values(), strict=True):
        numbers = f"{rms:.3g}", f"{noise.sigma:.3g}", f"{noise.dof:.3g}", f"{noise.samples}", f"{noise.effective:.0f}"
        rows.append([name, *numbers, f"{noise.durbin_watson:.2f}"])
    has_tails = any(np.isfinite(noise.dof) for noise in fit.noise.values())
    return rows if has_tails else [row[:3] + row[4:] for row in rows]


def _align(rows: list[list[str]], widths: dict[str, int]) -> list[str]:
    """The lines of a table: the first and last column to the left, others to the right, as wide as `widths` by head."""
    first, each = max(len(row[0]) for row in rows), [widths[head] for head in rows[0][1:-1]]
    middles = [[f"{x:>{width}}" for x, width in zip(row[1:-1], each, strict=True)] for row in rows]
    return ["  ".join([f"{row[0]:<{first}}", *some, row[-1]]).rstrip() for row, some in zip(rows, middles, strict=True)]
