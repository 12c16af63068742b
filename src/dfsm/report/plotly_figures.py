"""Figures as Plotly draws them from Python, for notebooks and scripts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dfsm.report.article import Curve, Figure, Panel

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Sheet

# Colours that colour-blind readers can tell apart (Okabe and Ito), as on the pages.
_COLOURS = ("#4a5259", "#0072b2", "#d55e00", "#00916a", "#a64d8c", "#8a6d00")
_INK, _SOFT, _RULE, _FAINT = "#1d2329", "#5a6570", "#b9c1c9", "#eef1f4"
# In px: a panel above others, one beside others, what lies between, above and below.
_STACKED, _BESIDE, _GAP, _HEAD, _FOOT = 110, 270, 34, 84, 46
_LEGEND_LINE, _IN_A_LINE = 20, 90
_MOST_COLUMNS = 3


def plotly_figure(figure: Figure) -> Sheet:
    """Return a Plotly figure; names and units are shown as text, whatever they hold."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    count = len(figure.panels)
    columns = 1 if figure.stacked else min(count, _MOST_COLUMNS)
    rows = -(-count // columns)
    height, gap = (_STACKED, _GAP) if figure.stacked else (_BESIDE, 2 * _GAP)
    inner = rows * height + (rows - 1) * gap
    sheet = make_subplots(
        rows=rows,
        cols=columns,
        shared_xaxes=figure.stacked,
        vertical_spacing=gap / inner if rows > 1 else 0,
        horizontal_spacing=0.22 / columns if columns > 1 else 0,
    )
    named: set[str] = set()
    for k, panel in enumerate(figure.panels):
        row, column = k // columns + 1, k % columns + 1
        for curve in panel.curves:
            for trace in _traces(curve, curve.name not in named):
                sheet.add_trace(go.Scatter(**trace), row=row, col=column)
            named.add(curve.name)
        last = not figure.stacked or k == count - 1
        sheet.update_xaxes(_axis(panel, "x", panel.x if last else ""), row=row, col=column)
        sheet.update_yaxes(_axis(panel, "y", panel.y), row=row, col=column)
        sheet.add_annotation(**_title(panel.title, k))
    shown = len(named) > 1 or not figure.stacked
    lines = 1 + sum(len(n) + 8 for n in named) // _IN_A_LINE if shown else 0
    head = _HEAD + _LEGEND_LINE * lines
    sheet.update_layout(
        title={"text": _text(figure.caption), "font": {"size": 15}, "x": 0, "xref": "paper"},
        height=inner + head + _FOOT,
        margin={"l": 70, "r": 16, "t": head, "b": _FOOT},
        template="plotly_white",
        font={"color": _INK, "size": 12},
        hovermode="x unified" if figure.stacked else "closest",
        showlegend=shown,
        legend={
            "orientation": "h",
            "x": 0,
            "y": 1 + 24 / inner,
            "yanchor": "bottom",
            "tracegroupgap": 0,
        },
    )
    return sheet


def _text(text: str) -> str:
    """Plotly reads tags in texts."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _title(text: str, k: int) -> dict[str, Any]:
    n = "" if k == 0 else str(k + 1)
    return {
        "text": _text(text),
        "xref": f"x{n} domain",
        "yref": f"y{n} domain",
        "x": 0,
        "y": 1,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 12.5},
    }


def _axis(panel: Panel, letter: str, title: str) -> dict[str, Any]:
    log = letter in panel.log
    axis: dict[str, Any] = {
        "title": {"text": _text(title), "standoff": 6, "font": {"size": 12}},
        "type": "log" if log else "linear",
        "showline": True,
        "linecolor": _RULE,
        "gridcolor": _FAINT,
        "zeroline": False,
        "ticks": "outside",
        "ticklen": 3,
        "tickcolor": _RULE,
        "tickfont": {"color": _SOFT, "size": 11},
        "exponentformat": "power",
        # Times are read as numbers, however large.
        "minexponent": 4 if letter == "y" else 9,
        "nticks": 8 if letter == "x" else 5,
    }
    ticks = panel.x_ticks if letter == "x" else panel.ticks
    if ticks:
        axis |= {
            "tickmode": "array",
            "tickvals": [value for value, _ in ticks],
            "ticktext": [_text(text) for _, text in ticks],
            "automargin": True,
        }
    span = panel.y_range if letter == "y" else panel.x_range
    if span and not log:
        axis["range"] = list(span)
    return axis


def _traces(curve: Curve, shown: bool) -> list[dict[str, Any]]:
    """One trace, or the two ends of a band; one entry of the legend for all of a name."""
    colour = _COLOURS[0] if curve.colour == 0 else _COLOURS[1 + (curve.colour - 1) % 5]
    name = _text(curve.name)
    made: dict[str, Any] = {
        "x": curve.x,
        "y": curve.y,
        "name": name,
        "legendgroup": name,
        "showlegend": shown,
        "mode": "lines",
        "hovertemplate": "%{y:.5~g}",
    }
    if curve.style == "points":
        hollow = {"color": colour, "size": 9, "symbol": "circle-open", "line": {"width": 2}}
        hover = "%{x:.4~g}, %{y:.4~g}"
        return [made | {"mode": "markers", "marker": hollow, "hovertemplate": hover}]
    if curve.style == "band":
        ends = made | {"line": {"width": 0}, "hoverinfo": "skip", "hovertemplate": None}
        filled = {"y": curve.upper, "fill": "tonexty", "fillcolor": colour + "30"}
        return [ends | {"showlegend": False}, ends | filled]
    dashed = curve.style == "dashed"
    # What comes first stays visible under what agrees with it.
    made["line"] = {
        "color": colour,
        "width": 1.4 if dashed else max(2.4 - 0.4 * curve.colour, 1.2),
        "dash": "6px,4px" if dashed else "solid",
        "shape": "hvh" if curve.style == "steps" else "linear",
    }
    return [made]
