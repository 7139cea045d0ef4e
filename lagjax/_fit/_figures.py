"""Figures of a fit, drawn with matplotlib, without its state machine: for reports, and for `lagjax.plot`."""

from typing import Any

import numpy as np

from lagjax._fit._records import Record

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
            plain(ax)
            ax.set_xlim(record.ts[0], record.ts[-1])
        above.tick_params(labelbottom=False)
    axes[0][0].set_ylabel("signal")
    axes[1][0].set_ylabel("residual")
    axes[0][0].legend(frameon=False, fontsize="small", ncols=2)


def draw_waterfall(ax, misfits: np.ndarray) -> None:
    """Misfits in order."""
    known = np.isfinite(misfits)
    ax.plot(np.arange(1, len(misfits) + 1)[known], misfits[known], "o-", color=BLUE, markersize=3, linewidth=1)
    ax.set(yscale="log", xlabel="start, in order", ylabel="misfit / signals")
    plain(ax)


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
    """The distribution of residuals (M, S) over σ, beside the normal one."""
    bins = np.linspace(-5, 5, 51)
    for s, name in enumerate(names[:6]):
        z = residuals[:, s] / sigma[s]
        ax.hist(np.clip(z[np.isfinite(z)], -5, 5), bins=bins, density=True, histtype="step", linewidth=1.3, label=name)
    x = np.linspace(-5, 5, 201)
    ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color=GREY, linewidth=1, label="normal")
    ax.set(yscale="log", ylim=(1e-4, 2), xlabel="residual / σ", ylabel="density")
    ax.legend(frameon=False, fontsize="small")
    plain(ax)


def plain(ax) -> None:
    """A light grid behind the data and no box around it."""
    ax.grid(color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(GREY)
    ax.tick_params(color=GREY)
