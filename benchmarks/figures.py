"""The figures of the documentation: `benchmarks.scaling`, and orders of `benchmarks.control`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

# Colours that colour-blind readers can tell apart (Okabe and Ito), and markers for those who print
# in grey. The linear fit is the reference, and dashed.
_KINDS: dict[str, dict[str, Any]] = {
    "linear fit": {"color": "#6b757f", "marker": "", "linestyle": (0, (4, 2))},
    "rbf, equal": {"color": "#e69f00", "marker": "s"},
    "rbf, per_input": {"color": "#d55e00", "marker": "D"},
    "rbf_incremental": {"color": "#a64d8c", "marker": "v"},
    "gp": {"color": "#00916a", "marker": "^"},
    "mlp": {"color": "#0072b2", "marker": "o", "linewidth": 1.8},
}
_SCHEMES: dict[str, tuple[str, dict[str, Any]]] = {
    "trapezoidal": ("trapezoidal, h²", {"color": "#e69f00", "marker": "s"}),
    "radau 2": ("Radau 2, h³", {"color": "#00916a", "marker": "^"}),
    "hermite_simpson": ("Hermite–Simpson, h⁴", {"color": "#0072b2", "marker": "o"}),
    "radau 3": ("Radau 3, h⁵", {"color": "#d55e00", "marker": "D"}),
}
_PANELS = (
    ("derivative", 100.0, "Error of the derivative", "% of the signal"),
    ("training_s", 1.0, "Training time", "s"),
    ("evaluation_ratio", 1.0, "Cost of one evaluation", "relative to the linear fit"),
)
GREY, _PALE = "#5a6570", "#d9dee3"
_DASHED: dict[str, Any] = {"linewidth": 0.8, "linestyle": (0, (4, 3))}
STYLE: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 6.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
    "svg.hashsalt": "dfsm",  # with no date inside, the same figures are the same file
}
# Smallest error that the figure of orders shows; an exact answer lies on its edge.
_LEAST = 1e-15


def draw_scaling(figures: Mapping[str, Any], path: Path) -> None:
    """Error, training time and evaluation cost over inputs; the file's ending is the format."""
    with mpl.rc_context(STYLE):
        page, axes = sheet(2.7, len(_PANELS))
        for place, panel in zip(axes, _PANELS, strict=True):
            _scaling_panel(place, figures, *panel)
        save(page, axes[0], path)


def draw_orders(figures: Mapping[str, Any], path: Path) -> None:
    """Relative error over intervals, a panel per problem; the file's ending is the format."""
    problems = list(dict.fromkeys(curve["problem"] for curve in figures.values()))
    with mpl.rc_context(STYLE):
        page, axes = sheet(3.4, len(problems), sharey=True)
        for place, problem in zip(axes, problems, strict=True):
            _orders_panel(place, [f for f in figures.values() if f["problem"] == problem])
            place.set_title(f"{problem}\n")
        axes[0].text(
            0, 1.02, "relative error of the objective", transform=axes[0].transAxes, color=GREY
        )
        save(page, axes[0], path)


def sheet(
    height: float, panels: int, sharey: bool = False, stacked: bool = False
) -> tuple[Figure, Sequence[Axes]]:
    """A sheet of a page's width, `height` in inches, with panels side by side or stacked."""
    page = Figure(figsize=(7.5, height), layout="constrained")
    FigureCanvasAgg(page)
    if stacked:
        return page, list(page.subplots(panels, 1, sharex=True, squeeze=False)[:, 0])
    return page, page.subplots(1, panels, sharey=sharey, squeeze=False)[0]


def save(page: Figure, named: Axes, path: Path) -> None:
    """Put the names of a panel's curves above all panels and write the sheet."""
    handles, names = named.get_legend_handles_labels()
    page.legend(
        handles,
        names,
        loc="outside upper center",
        ncols=len(names),
        frameon=False,
        handlelength=2.0,
        columnspacing=1.6,
    )
    stamp = {"Date": None} if path.suffix == ".svg" else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    page.savefig(path, metadata=stamp, dpi=200)


def _logarithmic(place: Axes, across: Sequence[int], what: str) -> None:
    """Both axes logarithmic, ticks at the values across and at powers of ten."""
    place.set_xscale("log")
    place.set_yscale("log")
    place.set_xticks(across, [str(i) for i in across])
    place.set_xlabel(what)
    place.yaxis.set_major_locator(LogLocator(subs=(1.0,)))
    for axis in (place.xaxis, place.yaxis):
        axis.set_minor_formatter(NullFormatter())
    place.xaxis.set_tick_params(which="minor", length=0)
    place.grid(axis="y", linewidth=0.4, color=_PALE)


def _scaling_panel(
    place: Axes, figures: Mapping[str, Any], key: str, factor: float, title: str, unit: str
) -> None:
    inputs = [size["inputs"] for size in figures.values()]
    for name, look in _KINDS.items():
        values = [size["results"][name][key] for size in figures.values()]
        # A kind that corrects nothing has no cost of evaluation: its curve ends there.
        heights = [float("nan") if v is None else factor * v for v in values]
        place.plot(inputs, heights, label=name, clip_on=False, **look)
    _logarithmic(place, inputs, "inputs")
    place.set_title(f"{title}\n")
    place.text(0, 1.02, unit, transform=place.transAxes, color=GREY)
    place.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _orders_panel(place: Axes, curves: Sequence[Mapping[str, Any]]) -> None:
    """Errors of every scheme, and below each a line as steep as theory says."""
    intervals, tolerance = curves[0]["intervals"], curves[0]["tolerance"]
    place.axhspan(_LEAST, tolerance, color="#eef1f4", linewidth=0, zorder=0)
    place.text(intervals[0], 3 * _LEAST, "below the solver's tolerance", va="center", color=GREY)
    for curve in sorted(curves, key=lambda curve: list(_SCHEMES).index(curve["scheme"])):
        name, look = _SCHEMES[curve["scheme"]]
        errors = [max(e, _LEAST) for e in curve["errors"]]
        place.plot(intervals, errors, label=name, clip_on=False, zorder=3, **look)
        guide = _guide(intervals, errors, curve["theory"], tolerance)
        place.plot(*guide, color=look["color"], zorder=2, **_DASHED)
    place.plot([], [], color=GREY, label="slope in theory", **_DASHED)
    _logarithmic(place, intervals, "intervals")
    place.set_ylim(_LEAST, 0.1)
    place.yaxis.set_major_locator(LogLocator(subs=(1.0,), numticks=5))
    place.yaxis.set_major_formatter(LogFormatterMathtext())


def _guide(
    intervals: Sequence[int], errors: Sequence[float], order: int, tolerance: float
) -> tuple[list[float], list[float]]:
    """Ends of a line below the errors that the solver's tolerance does not spoil."""
    anchor = max(i for i, e in enumerate(errors) if i == 0 or e > tolerance)
    height = 0.3 * errors[anchor] * intervals[anchor] ** order
    last = min(float(intervals[-1]), (height / (30 * _LEAST)) ** (1 / order))
    across = [float(intervals[0]), last]
    return across, [height * n**-order for n in across]
