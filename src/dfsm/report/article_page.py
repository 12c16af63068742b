"""An article as one self-contained HTML page, for the browser, the phone and for print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.report.article import Article, Curve, Figure, Panel, Section, Table, legend
from dfsm.report.blobs import Blobs
from dfsm.report.document import document, write_document
from dfsm.report.elements import Cell, Markup, element, join, table

# Longer texts in tables are broken into lines.
_LONG = 40


def write_article(article: Article, path: str | Path) -> None:
    """Write an article as an HTML page.

    Parameters
    ----------
    article
        What to tell.
    path
        File to write; an existing one is replaced when the new one is complete.

    Raises
    ------
    DfsmError
        The file cannot be written.
    """
    blobs = Blobs()
    figures = {f.key: [_panel(p, blobs) for p in f.panels] for f in article.figures()}
    data = {"figures": figures, "blobs": blobs.encoded}
    header = element("header", element("h1", article.title), element("p", article.lede, cls="lede"))
    body = join(header, element("main", *[_section(s) for s in article.sections]))
    text = document(article.title, body, data, scripts=("article.js",), css=("article.css",))
    write_document(text, path)


def _section(section: Section) -> Markup:
    return element(
        "section",
        element("h2", section.heading),
        *[element("p", text) for text in section.paragraphs],
        *[_table(t) for t in section.tables],
        *[_figure(f) for f in section.figures],
        id=section.key,
    )


def _table(content: Table) -> Markup:
    def cell(text: str, column: int) -> object:
        if not content.is_text(column):
            return element("span", text)  # a number that is written out aligns right
        return Cell(text, "long") if len(text) > _LONG else text

    rows = [[cell(text, j) for j, text in enumerate(row)] for row in content.texts()]
    made = table(content.caption, [], list(content.columns), rows)
    return join(made, element("p", content.note, cls="note") if content.note else "")


def _figure(figure: Figure) -> Markup:
    shared = figure.shares_legend
    panels = [
        element(
            "div",
            element("p", panel.title, cls="panel-title"),
            "" if shared else _legend([panel]),
            element("div", cls="plot", role="img", aria_label=f"{panel.title}: {figure.caption}"),
            cls="panel",
        )
        for panel in figure.panels
    ]
    return element(
        "figure",
        _legend(figure.panels) if shared else "",
        element(
            "div", *panels, cls="panels " + ("stacked" if figure.stacked else f"of-{len(panels)}")
        ),
        element("figcaption", figure.caption),
        element("noscript", "The figures need JavaScript; every number in a table does not."),
        id=figure.key,
        cls="article",
    )


def _legend(panels: Sequence[Panel]) -> Markup:
    entries = [
        element(
            "li",
            element("span", cls=f"swatch {c.style}", data_colour=c.colour),
            element("span", c.name),
        )
        for c in legend(panels)
    ]
    return element("ul", *entries, cls="legend")


def _panel(panel: Panel, blobs: Blobs) -> dict[str, Any]:
    return {
        "x": panel.x,
        "y": panel.y,
        "log": panel.log,
        "ticks": [list(tick) for tick in panel.ticks],
        "x_ticks": [list(tick) for tick in panel.x_ticks],
        "range": panel.y_range,
        "x_range": panel.x_range,
        "curves": [_curve(c, blobs) for c in panel.curves],
    }


def _curve(curve: Curve, blobs: Blobs) -> dict[str, Any]:
    return {
        "name": curve.name,
        "colour": curve.colour,
        "style": curve.style,
        "x": blobs.add(_floats(curve.x)),
        "y": blobs.add(_floats(curve.y)),
    }


def _floats(values: Array) -> Array:
    return np.asarray(values, dtype=np.float64)
