"""An article's figures for print, by Matplotlib: one PDF and one PNG each."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.core.files import write_file
from dfsm.errors import DfsmError
from dfsm.report.article import Article, Curve, Figure, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Sheet

# Colours that colour-blind readers can tell apart (Okabe and Ito), darkened for white paper.
_COLOURS = ("#8c959d", "#0072b2", "#d55e00", "#00916a", "#a64d8c", "#8a6d00")
_WIDTH, _HEIGHT, _LEGEND = 7.1, 1.85, 0.32  # in: two columns of a paper, a row, the legend
_STACKED = 1.0  # in: a row of panels that share their horizontal axis
_MOST_COLUMNS = 4
_STYLE: dict[Any, Any] = {
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 7.5,
    "axes.linewidth": 0.5,
    "axes.edgecolor": "#5a6570",
    "axes.titlepad": 4.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.2,
    "ytick.minor.size": 1.2,
    "lines.linewidth": 0.9,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
    "pdf.fonttype": 42,  # editable text
    "savefig.dpi": 300,
}

_SMALL_LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 6, "handlelength": 1.6}


def write_figures(article: Article, folder: str | Path) -> list[Path]:
    """Draw the figures of an article.

    Parameters
    ----------
    article
        What to draw.
    folder
        Where to; it is made if need be. Files of the same names are replaced.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    DfsmError
        Matplotlib is not installed, or a file cannot be written.
    """
    folder = Path(folder)
    written = []
    with _styled():
        folder.mkdir(parents=True, exist_ok=True)
        for figure in article.figures():
            sheet = sheet_of(figure)
            for suffix in (".pdf", ".png"):
                path = folder / (figure.key + suffix)
                with write_file(path) as temporary:
                    # No date inside: the same figure is the same file.
                    stamp = {"CreationDate": None} if suffix == ".pdf" else {}
                    sheet.savefig(temporary, format=suffix[1:], metadata=stamp)
                written.append(path)
    return written


def sheet_of(figure: Figure) -> Sheet:
    """Return a Matplotlib figure.

    Raises
    ------
    DfsmError
        Matplotlib is not installed.
    """
    with _styled():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as Sheet

        sheet = Sheet(layout="constrained")
        FigureCanvasAgg(sheet)
        _draw(sheet, figure)
    return sheet


def _styled() -> AbstractContextManager[None]:
    try:
        import matplotlib as mpl
    except ImportError:
        raise DfsmError(
            "figures for print need matplotlib: pip install 'dfsm[figures]', or do without"
        ) from None
    return mpl.rc_context(_STYLE)


def _draw(sheet: Any, figure: Figure) -> None:
    count = len(figure.panels)
    columns = 1 if figure.stacked else _columns(count)
    rows = -(-count // columns)
    height = _STACKED if figure.stacked else _HEIGHT
    sheet.set_size_inches(_WIDTH, rows * height + _LEGEND)
    axes = sheet.subplots(rows, columns, squeeze=False, sharex=figure.stacked).ravel()
    for place in axes[count:]:
        place.remove()
    for place, panel in zip(axes, figure.panels, strict=False):
        _panel(place, panel)
    if figure.stacked:
        for place in axes[: count - 1]:
            place.set_xlabel("")
        sheet.align_ylabels()
    if not figure.shares_legend:
        for place in axes[:count]:
            place.legend(loc="upper left", bbox_to_anchor=(-0.1, -0.3), **_SMALL_LEGEND)
        return
    handles: dict[str, Any] = {}
    for place in axes[:count]:
        for line, name in zip(*place.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, line)
    if len(handles) < 2 and figure.stacked:
        return
    sheet.legend(
        handles.values(),
        handles.keys(),
        loc="outside upper center",
        ncols=max(1, min(len(handles), 5)),
        frameon=False,
        handlelength=2.2,
        columnspacing=1.6,
    )


def _columns(count: int) -> int:
    """Panels per row: four, unless fewer fill the rows better."""
    return min(range(min(count, _MOST_COLUMNS), 0, -1), key=lambda n: (-count % n, -n))


def _panel(place: Axes, panel: Panel) -> None:
    for curve in panel.curves:
        _curve(place, curve)
    place.set_title(_plain(panel.title), loc="left")
    place.set_xlabel(_plain(panel.x))
    place.set_ylabel(_plain(panel.y))
    if "x" in panel.log:
        place.set_xscale("log")
    if "y" in panel.log:
        place.set_yscale("log")
    if panel.y_range:
        place.set_ylim(*panel.y_range)
    if panel.x_range:
        place.set_xlim(*panel.x_range)
    if panel.x_ticks:
        values, texts = zip(*panel.x_ticks, strict=True)
        place.set_xticks(values, [_plain(t) for t in texts])
        place.minorticks_off()
    if panel.ticks:
        values, texts = zip(*panel.ticks, strict=True)
        place.set_yticks(values, [_plain(t) for t in texts])
        place.grid(axis="y", linewidth=0.3, color="#d9dee3")


def _plain(text: str) -> str:
    """Names are data: no part of one is read as a formula."""
    return text.replace("$", r"\$")


def _curve(place: Axes, curve: Curve) -> None:
    colour = _COLOURS[0] if curve.colour == 0 else _COLOURS[1 + (curve.colour - 1) % 5]
    name = _plain(curve.name)
    if curve.style == "points":
        place.plot(curve.x, curve.y, "o", label=name, mfc="none", mec=colour, ms=4, mew=1.0)
        return
    if curve.style == "steps":
        place.step(curve.x, curve.y, where="mid", label=name, color=colour)
        return
    if curve.style == "band" and curve.upper is not None:
        place.fill_between(
            curve.x,
            curve.y,
            curve.upper,
            label=name,
            color=colour,
            alpha=0.2,
            linewidth=0,
        )
        return
    dashed = curve.style == "dashed"
    # The truth stays visible under what agrees with it.
    width = 2.0 if curve.colour == 0 and not dashed else 0.9
    dash = (0, (4, 2.5)) if dashed else "-"
    values = np.asarray(curve.y)
    place.plot(curve.x, values, label=name, color=colour, linewidth=width, linestyle=dash)
