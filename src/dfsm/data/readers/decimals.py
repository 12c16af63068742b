"""Decimal commas, and commas and points between thousands, as spreadsheets export them.

``0,05;1.234,5`` of a European export and ``0.05;1,234.5`` of an American one say the same. Which is
meant shows in the cells that can be read in one way only: ``0,05`` is no number with a comma
between thousands, and ``1,234.5`` none with a decimal comma.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from dfsm.data.readers.text import Row, number
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

_EXPONENT = r"(?:[eEdD][-+]?\d+)?"
_COMMA = re.compile(rf"\s*[-+]?(?:\d+|[1-9]\d{{0,2}}(?:\.\d{{3}})+)?,\d*{_EXPONENT}\s*")
_POINT = re.compile(rf"\s*[-+]?(?:\d+|[1-9]\d{{0,2}}(?:,\d{{3}})+)?\.\d*{_EXPONENT}\s*")
# What else stands between thousands: blanks of any width and apostrophes.
_BETWEEN = re.compile(r"\d[ \u00a0\u2009\u202f'\u2019]\d")
_GROUPED = re.compile(
    r"\s*[-+]?[1-9]\d{0,2}([ \u00a0\u2009\u202f'\u2019])\d{3}(?:\1\d{3})*(?:[.,]\d*)?\s*"
)
_PERCENT = re.compile(r"\s*[-+]?[\d.,]*\d[\d.,]*\s*%\s*")
# Rows in which percent signs are looked for.
_LOOKED_AT = 200
# Such a number in a table whose cells blanks separate: what stands before its blank, and behind it.
_BEFORE_BLANK = re.compile(r"[-+]?[1-9]\d{0,2}")
_BEHIND_BLANK = re.compile(r"\d{3}(?:[.,]\d*)?")
# Whole numbers, in either way of writing: one alone does not tell which.
_THOUSANDS = {sign: re.compile(rf"\s*[-+]?[1-9]\d{{0,2}}(?:[{sign}]\d{{3}})+\s*") for sign in ",."}

Sign = Literal[",", "."]


def with_points(path: Path, rows: list[Row], separator: str) -> tuple[list[Row], str]:
    """Write the numbers of some rows with decimal points and nothing between thousands.

    Parameters
    ----------
    path
        The file, for messages.
    rows
        Cells as they stand there.
    separator
        Of the cells; where all could be read in either way, a semicolon tells that commas are
        decimal.

    Returns
    -------
    tuple[list[Row], str]
        The rows, themselves where no number has a comma, and what to tell ("" for nothing).

    Raises
    ------
    DfsmError
        Some numbers have decimal commas and others decimal points, or nothing tells which is meant.
    """
    rows, grouped = _ungrouped(rows, separator)
    commas = [cell for row in rows for cell in row.cells if "," in cell]
    if not any(k.fullmatch(c) for k in (_COMMA, _THOUSANDS[","], _POINT) for c in commas):
        return rows, grouped
    point = _decimal_sign(path, rows, separator)
    other: Sign = "." if point == "," else ","
    whole = _THOUSANDS[other]
    written = _COMMA if point == "," else _POINT
    found = 0

    def plain(cell: str) -> str:
        nonlocal found
        if other in cell and whole.fullmatch(cell):
            found += 1
            return cell.replace(other, "")
        if (point == "," or other in cell) and point in cell and written.fullmatch(cell):
            return cell.replace(other, "").replace(point, ".")
        return cell

    tidy = [Row(row.line, [plain(cell) for cell in row.cells]) for row in rows]
    between = ", and points between thousands" if found else ""
    told = f"decimals have commas{between}: read as numbers"
    if point == ".":
        told = "commas between thousands, as in 1,234.5: read as whole numbers"
    return tidy, f"{told}; {grouped}" if grouped else told


def _ungrouped(rows: list[Row], separator: str) -> tuple[list[Row], str]:
    """Rows without what separates thousands besides commas and points, and what to tell.

    Where blanks separate cells, none does.
    """
    if not separator or not any(_BETWEEN.search("\n".join(row.cells)) for row in rows):
        return rows, ""
    first = ""

    def whole(cell: str) -> str:
        nonlocal first
        match = _GROUPED.fullmatch(cell)
        if match is None:
            return cell
        first = first or cell.strip()
        return cell.replace(match[1], "")

    tidy = [Row(row.line, [whole(cell) for cell in row.cells]) for row in rows]
    if not first:
        return rows, ""
    return tidy, f"thousands are set apart, as in {first}: read as whole numbers"


def split_thousands(cells: Sequence[str]) -> str:
    """First number that a blank between its thousands may have made two cells of; "" for none."""
    for before, behind in pairwise(cells):
        if _BEFORE_BLANK.fullmatch(before) and _BEHIND_BLANK.fullmatch(behind):
            return f"{before} {behind}"
    return ""


def thousands_in_columns(names: Sequence[str], rows: Sequence[Row]) -> str:
    """Tell of two columns that are one number with a blank between its thousands, by their digits.

    Parameters
    ----------
    names
        Of the columns.
    rows
        Of a table whose cells blanks separate.

    Returns
    -------
    str
        "" where no column has three digits everywhere, zeros at the head among them, behind one of
        whole numbers.
    """
    full = [row.cells for row in rows if len(row.cells) == len(names)]
    for j, (before, behind) in enumerate(pairwise(names)):
        zeros = next((cells for cells in full if re.match(r"0\d\d", cells[j + 1])), None)
        if zeros is None:
            continue
        if all(split_thousands(cells[j : j + 2]) for cells in full):
            return (
                f"'{before}' and '{behind}' look like one number with a blank between its "
                f"thousands, {zeros[j]} {zeros[j + 1]}: if so, save the table without such blanks"
            )
    return ""


def without_percent(rows: list[Row], channels: Sequence[Channel]) -> tuple[list[Row], set[int]]:
    """Rows without the percent signs of columns that have one in every cell, and these columns.

    Parameters
    ----------
    rows
        Cells as they stand in the file.
    channels
        One per column; one in another unit than % keeps its signs.
    """
    full = [row.cells for row in rows if len(row.cells) == len(channels)]
    if not any("%" in cell for cells in full[:_LOOKED_AT] for cell in cells):
        return rows, set()
    columns = {
        j
        for j, channel in enumerate(channels)
        if channel.unit in ("", "%") and _is_percent([cells[j] for cells in full])
    }
    if not columns:
        return rows, columns
    return [
        Row(r.line, [c.replace("%", "") if j in columns else c for j, c in enumerate(r.cells)])
        for r in rows
    ], columns


def _decimal_sign(path: Path, rows: Iterable[Row], separator: str) -> Sign:
    """What stands before the decimals, by the first cell that can be read in one way only."""
    first: dict[str, tuple[int, str]] = {}
    for row in rows:
        for cell in row.cells:
            for sign, written in ((",", _COMMA), (".", _POINT)):
                if sign in cell and sign not in first and written.fullmatch(cell):
                    other = _THOUSANDS[sign].fullmatch(cell)
                    first |= {} if other else {sign: (row.line, cell.strip())}
        if len(first) == 2:
            break
    if len(first) == 2:
        (line, cell), (other_line, other_cell) = first[","], first["."]
        raise DfsmError(
            f"{path}: line {line} has a decimal comma ({cell[:24]!r}) and line {other_line} a "
            f"decimal point ({other_cell[:24]!r}): save the table with points alone"
        )
    if first:
        return "," if "," in first else "."
    if separator == ";":
        return ","
    raise DfsmError(
        f"{path}: whether a comma stands before decimals or between thousands is open, for every "
        "number that has one has three digits behind it: save the table with points"
    )


def _is_percent(cells: Sequence[str]) -> bool:
    """Whether all cells but missing ones, and words at the head, are numbers with a sign."""
    start = next((i for i, cell in enumerate(cells) if _PERCENT.fullmatch(cell)), None)
    return (
        start is not None
        and all(number(cell) is None or not cell.strip() for cell in cells[:start])
        and all(_PERCENT.fullmatch(c) or np.isnan(number(c) or 0.0) for c in cells[start:])
    )
