"""Decimal commas, and commas and points between thousands, as spreadsheets export them.

``0,05;1.234,5`` of a European export and ``0.05;1,234.5`` of an American one say the same. Which is
meant shows in the cells that can be read in one way only: ``0,05`` is no number with a comma
between thousands, and ``1,234.5`` none with a decimal comma.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from dfsm.data.readers.text import Row
from dfsm.errors import DfsmError

_EXPONENT = r"(?:[eEdD][-+]?\d+)?"
_COMMA = re.compile(rf"\s*[-+]?(?:\d+|[1-9]\d{{0,2}}(?:\.\d{{3}})+)?,\d*{_EXPONENT}\s*")
_POINT = re.compile(rf"\s*[-+]?(?:\d+|[1-9]\d{{0,2}}(?:,\d{{3}})+)?\.\d*{_EXPONENT}\s*")
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
    commas = [cell for row in rows for cell in row.cells if "," in cell]
    if not any(_COMMA.fullmatch(c) or _THOUSANDS[","].fullmatch(c) for c in commas):
        return rows, ""
    point = _decimal_sign(path, rows, separator)
    other: Sign = "." if point == "," else ","
    whole = _THOUSANDS[other]
    number = _COMMA if point == "," else _POINT
    found = 0

    def plain(cell: str) -> str:
        nonlocal found
        if other in cell and whole.fullmatch(cell):
            found += 1
            return cell.replace(other, "")
        if (point == "," or other in cell) and point in cell and number.fullmatch(cell):
            return cell.replace(other, "").replace(point, ".")
        return cell

    tidy = [Row(row.line, [plain(cell) for cell in row.cells]) for row in rows]
    if point == ".":
        return tidy, "commas between thousands, as in 1,234.5: read as whole numbers"
    between = ", and points between thousands" if found else ""
    return tidy, f"decimals have commas{between}: read as numbers"


def _decimal_sign(path: Path, rows: Iterable[Row], separator: str) -> Sign:
    """What stands before the decimals, by the first cell that can be read in one way only."""
    first: dict[str, tuple[int, str]] = {}
    for row in rows:
        for cell in row.cells:
            for sign, number in ((",", _COMMA), (".", _POINT)):
                if sign in cell and sign not in first and number.fullmatch(cell):
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
