"""The figure of `benchmarks.scaling`: error, training time and evaluation cost over inputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

# Colours that colour-blind readers can tell apart (Okabe and Ito), and markers for those who print
# in grey. The linear fit is the reference, and dashed.
_LOOKS: dict[str, dict[str, Any]] = {
    "linear fit": {"color": "#6b757f", "marker": "", "linestyle": (0, (4, 2))},
    "rbf, equal": {"color": "#e69f00", "marker": "s"},
    "rbf, per_input": {"color": "#d55e00", "marker": "D"},
    "rbf_incremental": {"color": "#a64d8c", "marker": "v"},
    "gp": {"color": "#00916a", "marker": "^"},
    "mlp": {"color": "#0072b2", "marker": "o", "linewidth": 1.8},
}
_PANELS = (
    ("derivative", 100.0, "Error of the derivative", "% of the signal"),
    ("training_s", 1.0, "Training time", "s"),
    ("evaluation_ratio", 1.0, "Cost of one evaluation", "relative to the linear fit"),
)
_STYLE: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 6.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#5a6570",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
    "svg.hashsalt": "dfsm",  # with no date inside, the same figures are the same file
}


def draw(figures: Mapping[str, Any], path: Path) -> None:
    """Write the figure; the ending of the file's name chooses the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(_STYLE):
        sheet = Figure(figsize=(7.5, 2.7), layout="constrained")
        FigureCanvasAgg(sheet)
        axes = sheet.subplots(1, len(_PANELS))
        for place, panel in zip(axes, _PANELS, strict=True):
            _panel(place, figures, *panel)
        handles, names = axes[0].get_legend_handles_labels()
        sheet.legend(
            handles,
            names,
            loc="outside upper center",
            ncols=len(names),
            frameon=False,
            handlelength=2.0,
            columnspacing=1.6,
        )
        stamp = {"Date": None} if path.suffix == ".svg" else {}
        sheet.savefig(path, metadata=stamp, dpi=200)


def _panel(
    place: Axes, figures: Mapping[str, Any], key: str, factor: float, title: str, unit: str
) -> None:
    inputs = [found["inputs"] for found in figures.values()]
    for name, look in _LOOKS.items():
        values = [found["results"][name][key] for found in figures.values()]
        # A kind that corrects nothing has no cost of evaluation: its curve ends there.
        heights = [float("nan") if v is None else factor * v for v in values]
        place.plot(inputs, heights, label=name, clip_on=False, **look)
    place.set_xscale("log")
    place.set_yscale("log")
    place.set_xticks(inputs, [str(i) for i in inputs])
    place.set_xlabel("inputs")
    place.set_title(f"{title}\n")
    place.text(0, 1.02, unit, transform=place.transAxes, color="#5a6570")
    place.yaxis.set_major_locator(LogLocator(subs=(1.0,)))
    place.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for axis in (place.xaxis, place.yaxis):
        axis.set_minor_formatter(NullFormatter())
    place.xaxis.set_tick_params(which="minor", length=0)
    place.grid(axis="y", linewidth=0.4, color="#d9dee3")
