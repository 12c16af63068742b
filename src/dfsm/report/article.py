"""What a study reports, before it becomes a page, a print or text: sections, tables, figures.

One definition serves the terminal, the HTML page, the printed figures and the documentation, so
that a number cannot differ between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dfsm.core.types import Array

MISSING = "–"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

Style = Literal["line", "dashed", "points", "steps", "band"]


@dataclass(frozen=True)
class Table:
    """Rows of texts and numbers; numbers align right and are rounded for show.

    Attributes
    ----------
    key
        Short name, by which documentation refers to it.
    caption
        What it shows.
    columns
        Heads, with units.
    rows
        Texts, and numbers of which None and those not finite show as a dash.
    note
        What a reader must know to read it.
    digits
        Significant digits.
    """

    key: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float | None, ...], ...]
    note: str = ""
    digits: int = 3

    def texts(self) -> list[list[str]]:
        """Cells as they are shown."""
        return [[cell_text(c, self.digits) for c in row] for row in self.rows]

    def is_text(self, column: int) -> bool:
        """Whether a column holds texts, which align left."""
        return any(isinstance(row[column], str) for row in self.rows)

    def markdown(self) -> list[str]:
        """Lines of a Markdown table."""
        marks = ["---" if self.is_text(j) else "---:" for j in range(len(self.columns))]
        rows = [list(self.columns), marks, *self.texts()]
        return ["| " + " | ".join(row) + " |" for row in rows]


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a panel.

    Attributes
    ----------
    name
        Curves of one name share one entry of the legend.
    x, y
        Shape ``(point,)``; "steps" draws a histogram, x being the middles of its bins.
    upper
        Upper end of a "band", whose lower end is `y`.
    colour
        0 for the truth, 1, 2, … for what is compared with it.
    style
        How it is drawn.
    """

    name: str
    x: Array
    y: Array
    colour: int = 1
    style: Style = "line"
    upper: Array | None = None


@dataclass(frozen=True)
class Panel:
    """Axes with curves.

    Attributes
    ----------
    title
        Short, above the axes.
    x, y
        Axis titles with units.
    curves
        In the order drawn.
    log
        Axes that are logarithmic: "", "x", "y" or "xy".
    ticks, x_ticks
        Labels for values of y and of x, in place of numbers.
    y_range, x_range
        None takes all that is drawn.
    """

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    log: Literal["", "x", "y", "xy"] = ""
    ticks: tuple[tuple[float, str], ...] = ()
    x_ticks: tuple[tuple[float, str], ...] = ()
    y_range: tuple[float, float] | None = None
    x_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Figure:
    """Panels side by side, or above each other.

    Attributes
    ----------
    key
        Name of its files.
    caption
        What it shows.
    panels
        In reading order.
    stacked
        Panels stand above each other and share their horizontal axis.
    """

    key: str
    caption: str
    panels: tuple[Panel, ...]
    stacked: bool = False

    @property
    def shares_legend(self) -> bool:
        """Whether one legend serves all panels: they hold the same curves, or nearly so."""
        if self.stacked:
            return True
        names = [{c.name for c in p.curves} for p in self.panels]
        return all(names[0] & other for other in names)


def legend(panels: Sequence[Panel]) -> list[Curve]:
    """One curve for each name, in the order of their first appearance."""
    shown: dict[str, Curve] = {}
    for panel in panels:
        for curve in panel.curves:
            shown.setdefault(curve.name, curve)
    return list(shown.values())


@dataclass(frozen=True)
class Section:
    """Text, tables and figures under a heading; `key` is the anchor in a page."""

    key: str
    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Article:
    """A study, told.

    Attributes
    ----------
    key
        Name of its files.
    title, lede
        Heading, and what it is about.
    sections
        In reading order.
    """

    key: str
    title: str
    lede: str
    sections: tuple[Section, ...] = field(default=())

    def tables(self) -> list[Table]:
        """All tables in reading order."""
        return [t for s in self.sections for t in s.tables]

    def figures(self) -> list[Figure]:
        """All figures in reading order."""
        return [f for s in self.sections for f in s.figures]

    def to_dict(self) -> dict[str, Any]:
        """JSON values: every table by its key, one mapping per row, numbers as computed."""
        return {
            t.key: [dict(zip(t.columns, row, strict=True)) for row in t.rows] for t in self.tables()
        }


def cell_text(value: str | float | None, digits: int = 3) -> str:
    """A cell as it is shown; numbers are rounded to significant digits."""
    if isinstance(value, str):
        return value
    if value is None or not math.isfinite(value):
        return MISSING
    if isinstance(value, int):
        return str(value)
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if not -3 <= power < 6:
        text = f"{mantissa}·10{str(power).translate(_SUPERSCRIPTS)}"
    else:
        text = f"{value:.{max(0, digits - 1 - power)}f}"
    return text.replace("-", "\N{MINUS SIGN}")


def listed(items: Sequence[str]) -> str:
    """Join as "a, b and c"."""
    return " and ".join(part for part in (", ".join(items[:-1]), items[-1]) if part)
