"""HTML from Python values in which every text is escaped, so that data never becomes markup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

MISSING = "—"


class Markup(str):
    """HTML that `element` made; any other string counts as text and is escaped."""

    __slots__ = ()


def element(tag: str, *children: object, **attributes: object) -> Markup:
    """Return one element; children and attribute values are escaped unless they are `Markup`.

    Parameters
    ----------
    tag
        Element name, written in the code and never taken from data.
    *children
        Text, numbers or `Markup`.
    **attributes
        ``cls`` stands for ``class`` and ``_`` for ``-``; None and False leave one out.
    """
    parts = []
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        name = "class" if key == "cls" else key.replace("_", "-")
        parts.append(f" {name}" if value is True else f' {name}="{escape(str(value))}"')
    return Markup(f"<{tag}{''.join(parts)}>{join(*children)}</{tag}>")


def join(*children: object) -> Markup:
    """Put children side by side."""
    return Markup("".join(c if isinstance(c, Markup) else escape(str(c)) for c in children))


def number(value: float | None, digits: int = 3) -> str:
    """Round to significant digits, with thin spaces between thousands; '—' where there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    size = abs(value)
    if not 1e-4 <= size < 1e8:
        return f"{value:.{digits - 1}e}".replace("-", "\N{MINUS SIGN}")
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(rounded))))
    text = f"{rounded:,.{decimals}f}".replace("-", "\N{MINUS SIGN}")
    # Four-digit numbers read well without a gap.
    return text.replace(",", "\N{NARROW NO-BREAK SPACE}" if size >= 1e4 else "")


def percent(value: float | None) -> str:
    """Signed percentage of a ratio, one decimal."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{100 * value:+.1f} %".replace("-", "\N{MINUS SIGN}")


def plural(count: int, noun: str) -> str:
    """Return e.g. "1 test run" or "2 test runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


@dataclass(frozen=True)
class Cell:
    """A table cell with a class, e.g. ``best``; `content` as in `table`."""

    content: object
    cls: str


def table(
    caption: object,
    groups: Sequence[tuple[object, int]],
    heads: Sequence[object],
    rows: Sequence[Sequence[object]],
) -> Markup:
    """Return a table in a container of its own that scrolls sideways where it is too wide.

    Parameters
    ----------
    caption
        What the table shows.
    groups
        Cells of a first header row with the number of columns they span; may be empty.
    heads
        Column headers.
    rows
        Cells: text aligns left; numbers, and None for "—", align right. The first heads its row.
    """
    left = [any(_is_text(row[j]) for row in rows) for j in range(len(heads))]
    head = [
        element("th", h, scope="col", cls="left" if text else None)
        for h, text in zip(heads, left, strict=True)
    ]
    top = [
        element("th", text, colspan=span, scope="colgroup", cls="group" if text else "none")
        for text, span in groups
    ]
    body = [
        element(
            "tr",
            *[_cell(value, "th" if j == 0 else "td", left[j]) for j, value in enumerate(row)],
        )
        for row in rows
    ]
    content = element(
        "table",
        element("thead", element("tr", *top) if top else "", element("tr", *head)),
        element("tbody", *body),
    )
    # The caption stands outside of what scrolls, or a phone would show half of it.
    return join(
        element("p", caption, cls="caption"),
        element("div", content, cls="scroll", tabindex="0", role="region", aria_label=caption),
    )


def _is_text(value: object) -> bool:
    value = value.content if isinstance(value, Cell) else value
    return isinstance(value, str) and not isinstance(value, Markup)


def _cell(value: object, tag: str, left: bool) -> Markup:
    cls = "left" if left else None
    if isinstance(value, Cell):
        cls, value = f"{cls or ''} {value.cls}".strip(), value.content
    if value is None or isinstance(value, float):
        value = number(value)
    return element(tag, value, cls=cls, scope="row" if tag == "th" else None)
