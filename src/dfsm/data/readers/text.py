"""Tables of numbers in text, whoever wrote them: what all text readers share.

* Encodings: UTF-16 and UTF-8 by their marks, UTF-8, then Latin-1, whatever the locale.
* Numbers: also ``1.0D-01`` and ``1.000-101``, as Fortran writes them (the letter is left out where
  an exponent needs three digits; Fortran 2018 standard, 13.7.2.3.3), and ``1.#QNAN`` of Windows.
* A value that does not fit its field is written as stars (13.7.2.1): a missing value.
* A file that ends without a line end may be cut inside its last number.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.stamps import Stamps, read_stamps, tells_time
from dfsm.errors import DfsmError

# Fortran always writes the point: without one it is a label (08-01), or half a date.
_FORTRAN = re.compile(r"([-+]?(?:\d+\.\d*|\.\d+))(?:[dDqQ]([-+]?\d+)|([-+]\d{3}))")
_STARS = re.compile(r"\*+")
_MISSING = {"", "na", "n/a", "#n/a", "null", "none", "nan(ind)", "-nan(ind)"}
_WINDOWS_NAN = re.compile(r"[-+]?1\.#(QNAN|SNAN|IND|INF)0*", re.IGNORECASE)
_PLAIN = re.compile(r"[-+]?(\d*)\.?(\d*)(?:[eEdD]([-+]?\d+))?")
# Rows whose text tells how a column is printed, how many it takes, and digits that say all of a
# double.
_LOOKED_AT = 300
_FEWEST_DIGITS = 20
_EXACT_DIGITS = 15
# Rows before the last that tell what a whole one looks like.
_BEFORE = 100
_NAMED = 3


@dataclass(frozen=True)
class Row:
    """One line of a table: its number in the file, from 1, and its cells."""

    line: int
    cells: list[str]


@dataclass(frozen=True, eq=False)
class Table:
    """What the rows of a text file hold.

    Attributes
    ----------
    values
        Shape ``(row, column)``; NaN where a value is missing, and in columns of words.
    words
        Columns without a number.
    steps
        Per column the quantisation step that its digits state, see `printed_step`.
    stamps
        What the time column holds where that is time stamps.
    notes
        What was left out or is missing, one sentence each.
    """

    values: Array
    words: tuple[int, ...]
    steps: tuple[float | None, ...]
    stamps: Stamps | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Layout:
    """What a reader knows of its table.

    Attributes
    ----------
    path
        The file.
    names
        One per column.
    time
        The column of the time; None where there is none.
    ended
        Whether the file ends with a line end.
    columns
        What its columns are called in messages.
    ragged, wrong
        What to do about a row with more or fewer cells (by row), and about what is no number (by
        cell).
    """

    path: Path
    names: Sequence[str]
    time: int | None
    ended: bool
    columns: str
    ragged: Callable[[Row], str]
    wrong: Callable[[str], str]


def decode(path: Path, expected: str) -> str:
    """Text of a file in whatever encoding it has, with line feeds at the ends of its lines.

    Raises
    ------
    DfsmError
        A binary file, or damaged UTF-16.
    """
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ("utf-16",)
    elif b"\0" in raw:
        raise DfsmError(f"{path} is a binary file, {expected} was expected: check the file")
    else:
        # What is not UTF-8 comes from Windows or from an old code; there every byte is a letter.
        encodings = ("utf-8-sig", "latin-1")
    for encoding in encodings:
        try:
            return raw.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError:
            continue
    raise DfsmError(f"{path} is damaged UTF-16 text: save it as UTF-8")


def blank_cells(line: str) -> list[str]:
    """Cells of a line that is separated by blanks; stars that touch a number are a cell of theirs.

    A Fortran field that overflows leaves no blank before it.
    """
    return (_STARS.sub(r" \g<0> ", line) if "*" in line else line).split()


def number(text: str) -> float | None:
    """Value of a cell, NaN for a missing one, None for what is no number."""
    text = text.strip()
    try:
        # Python takes 12_3 for a number; in a file it is a label.
        return None if "_" in text else float(text)
    except ValueError:
        pass
    if text.lower() in _MISSING or _STARS.fullmatch(text):
        return np.nan
    if match := _FORTRAN.fullmatch(text):
        return float(f"{match[1]}e{match[2] or match[3]}")
    if match := _WINDOWS_NAN.fullmatch(text):
        return float("-inf" if text[0] == "-" else "inf") if match[1].upper() == "INF" else np.nan
    return None


def read_rows(rows: list[Row], layout: Layout) -> Table:
    """Turn rows of cells into numbers.

    Parameters
    ----------
    rows
        All rows behind the header but blank ones.
    layout
        What the header says.

    Raises
    ------
    DfsmError
        A row is ragged or holds something that is no number (the line is named).
    """
    notes: list[str] = []
    rows = _without_cut(rows, layout, notes)
    rows = _without_footer(rows, layout, notes)
    width = len(layout.names)
    for row in rows:
        if len(row.cells) != width:
            raise DfsmError(
                f"{layout.path}, line {row.line}: {len(row.cells)} values, but the header names "
                f"{width} {layout.columns}: {layout.ragged(row)}"
            )
    try:
        values = _plain([row.cells for row in rows]).reshape(len(rows), width)
        words, stamps = [], None
    except ValueError:
        values, words, stamps = _cell_by_cell(rows, layout)
    _tell_stars(rows, values, layout, notes)
    steps = tuple(
        None if j == layout.time or j in words else printed_step([r.cells[j] for r in seen], v)
        for seen in [rows[:: max(1, len(rows) // _LOOKED_AT)]]
        for j, v in enumerate(values.T)
    )
    return Table(values, tuple(words), steps, stamps, tuple(notes))


def _plain(cells: Sequence[str] | Sequence[Sequence[str]]) -> Array:
    """Numbers of cells that NumPy reads as they are, but for those that `number` takes for none.

    Raises
    ------
    ValueError
        Some are no such numbers.
    """
    if any("_" in cell if isinstance(cell, str) else "_" in "".join(cell) for cell in cells):
        raise ValueError
    return np.array(cells, dtype=np.float64)


def _cell_by_cell(rows: list[Row], layout: Layout) -> tuple[Array, list[int], Stamps | None]:
    """Numbers that only a closer look makes out, columns of words, and time stamps."""
    values = np.full((len(rows), len(layout.names)), np.nan)
    words, stamps, wrong = [], None, list[tuple[int, int, str]]()
    for j in range(len(layout.names)):
        cells = [row.cells[j] for row in rows]
        if j == layout.time and tells_time(cells[0]):
            stamps = read_stamps(layout.path, layout.names[j], cells)
            values[:, j] = stamps.seconds
            continue
        try:
            values[:, j] = _plain(cells)
            continue
        except ValueError:
            found = [number(cell) for cell in cells]
        if j != layout.time and all(f is None for f in found):
            words.append(j)
            continue
        if None in found:
            row = rows[found.index(None)]
            wrong.append((row.line, j, row.cells[j].strip()))
            continue
        values[:, j] = np.array(found, dtype=np.float64)
    # One column of one row tells nothing of words: a mistake is likelier there.
    if words and (len(rows) < 2 or len(words) == len(layout.names) - 1):
        wrong.append((rows[0].line, words[0], rows[0].cells[words[0]].strip()))
    if wrong:
        line, j, text = min(wrong)
        raise DfsmError(
            f"{layout.path}, line {line}: {text[:24]!r} in column {j + 1} is no number: "
            f"{layout.wrong(text)}"
        )
    return values, words, stamps


# -- what is no row -----------------------------------------------------------------------------


def _without_cut(rows: list[Row], layout: Layout, notes: list[str]) -> list[Row]:
    """Drop the last record where the file ends inside it: half a number is another number."""
    if layout.ended or not rows:
        return rows
    last, before = rows[-1], rows[-1 - _BEFORE : -1]
    whole = len(last.cells) == len(layout.names) and last.cells[-1].strip() != ""
    if whole and _is_value(last.cells[-1]) and not _shorter(last.cells[-1], before):
        return rows
    at = layout.time or 0
    first = last.cells[at if at < len(last.cells) else 0]
    # A footer in words is told as such.
    if not (_is_value(first) or tells_time(first)):
        return rows
    # Words may stand in the last column.
    if whole and before and not any(_is_value(row.cells[-1]) for row in before):
        return rows
    notes.append(
        f"the file ends without a line end inside the record of line {last.line}, as where a run "
        "was ended or a copy cut off: that record is left out"
    )
    return rows[:-1]


def _shorter(cell: str, before: Sequence[Row]) -> bool:
    """Whether a number has fewer decimals or digits of its exponent than its column usually has."""
    shapes = Counter(_shape(row.cells[-1]) for row in before)
    if sum(shapes.values()) < 5:
        return False
    usual = shapes.most_common(1)[0][0]
    here = _shape(cell)
    return here[0] < usual[0] or here[1] < usual[1]


def _shape(cell: str) -> tuple[int, int]:
    """Numbers of digits behind the point and in the exponent."""
    match = _PLAIN.fullmatch(cell.strip())
    if match is None:
        return -1, -1
    return len(match[2]), len((match[3] or "").lstrip("+-"))


def _without_footer(rows: list[Row], layout: Layout, notes: list[str]) -> list[Row]:
    """Drop lines of words below the last record."""
    end = len(rows)
    while end and _is_footer(rows[end - 1], layout):
        end -= 1
    if end in (0, len(rows)):
        return rows
    first, last = rows[end].line, rows[-1].line
    where = f"line {first} holds" if first == last else f"lines {first} to {last} hold"
    notes.append(f"{where} words below the last record: passed over")
    return rows[:end]


def _is_footer(row: Row, layout: Layout) -> bool:
    cells, width = row.cells, len(layout.names)
    at = layout.time if layout.time is not None and len(cells) == width else 0
    if _is_value(cells[at]) or (layout.time is not None and tells_time(cells[at])):
        return False
    return len(cells) != width or not any(_is_value(c) for c in cells)


def _is_value(cell: str) -> bool:
    return number(cell) is not None


def _tell_stars(rows: list[Row], values: Array, layout: Layout, notes: list[str]) -> None:
    if not np.isnan(values).any():
        return
    for j, name in enumerate(layout.names):
        missing = np.flatnonzero(np.isnan(values[:, j]))
        at = [i for i in missing if "*" in rows[i].cells[j]]
        if not at:
            continue
        if j == layout.time:
            raise DfsmError(
                f"{layout.path}, line {rows[at[0]].line}: the time is written as stars, it did "
                "not fit its column: rerun with a wider format for the time"
            )
        where = f"line {rows[at[0]].line}"
        if layout.time is not None:
            times = [f"{t:g}" for t in values[at[:_NAMED], layout.time]]
            where = ", ".join(times) + (" s, …" if len(at) > _NAMED else " s")
        notes.append(
            f"'{name}' has {len(at)} value{'s' * (len(at) > 1)} written as stars, too wide for "
            f"the column (at {where}): missing"
        )


# -- printed digits -----------------------------------------------------------------------------


def printed_step(cells: Sequence[str], values: Array) -> float | None:
    """Quantisation step that the digits of a printed column state.

    A column has either so many decimals or so many significant digits; zeros at the end may have
    been left away. With significant digits the step goes with the size of the value, and the root
    mean square stands for all: that is what the variance of the rounding error, step² / 12, needs.

    Parameters
    ----------
    cells
        Some of its cells, as they stand in the file.
    values
        All its values, shape ``(row,)``.

    Returns
    -------
    float or None
        In the column's unit; None where the digits say all that a double holds, or nothing.
    """
    decimals, digits = [], []
    for cell in cells:
        match = _PLAIN.fullmatch(cell.strip())
        if match is None or not (match[1] or match[2]):
            continue
        places = len(match[2]) - int(match[3] or 0)
        significant = len((match[1] + match[2]).lstrip("0"))
        decimals.append(places)
        if significant:
            digits.append(significant)
    finite = np.abs(values[np.isfinite(values) & (values != 0)])
    if len(digits) < _FEWEST_DIGITS or not len(finite) or max(digits) >= _EXACT_DIGITS:
        return None
    if finite.min() == finite.max() and np.ptp(np.sign(values[np.isfinite(values)])) == 0:
        return None  # a constant
    most, longest = max(decimals), max(digits)
    if decimals.count(most) / len(decimals) >= digits.count(longest) / len(digits):
        return float(f"1e{-most}") if -most > -300 else None
    steps = 10.0 ** (np.floor(np.log10(finite)) + 1 - longest)
    return float(np.sqrt(np.mean(steps**2))) or None
