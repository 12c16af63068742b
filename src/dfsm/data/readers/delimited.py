"""Tables in text: CSV, and columns separated by semicolons, tabs or blanks.

The header is the first line that names a time; lines above it may say anything, and lines that
begin with ``#``, ``%`` or ``!`` are comments (NumPy's ``savetxt`` writes the header as one). Units
stand in the header as ``PtfmPitch [deg]``, or in a row of their own below it. Without a time there
may be a column or a comment that tells the rate: ``fs = 50``, ``Ts``, ``dt``.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import (
    SECONDS,
    TIME_NAMES,
    kept_columns,
    no_time,
    rate_step,
    split_header,
    time_column,
    uniform_times,
)
from dfsm.data.readers.guard import unguarded
from dfsm.data.readers.stamps import is_stamp
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

_COMMENTS = ("#", "%", "!")
_HEADER_LINES = 200
_BLANKS = ""  # the separator of columns that blanks separate
_STAMP_NAMES = ("timestamp", "datetime", "date", "date time", "date_time")
_NAME_AND_UNIT = re.compile(r"\S+?[ _]?(?:\([^()]*\)|\[[^\[\]]*\])|\S+")
_UNITS = re.compile(r"\([^()]*\)|\[[^\[\]]*\]|\S+")
_RATE = re.compile(r"(\w+)\s*[=:]\s*([-+.\deE]+)\s*(?:Hz|s|sec)?\s*[,;]?", re.IGNORECASE)


@dataclass(frozen=True)
class _Header:
    """Where the names stand, how cells are separated, and what they are."""

    at: int
    separator: str
    names: list[str]


def read_delimited(path: Path, step: float | None = None) -> Trajectory:
    """Read a run from an existing text table, see `dfsm.data.readers.tables.read_table`.

    Raises
    ------
    DfsmError
        No table, no time and no rate, or rows that do not fit.
    """
    text = decode(path, "a CSV table")
    lines = text.split("\n")
    header = _find_header(lines)
    if header is None:
        raise DfsmError(f"{path} holds blank lines only: check that it is the right file")
    rows = _rows(path, lines, header)
    channels = [Channel(*split_header(unguarded(cell))) for cell in header.names]
    if rows and (units := _units_row(lines, rows[0], header, channels)):
        channels = [
            Channel(c.name, c.unit or _bare(u)) for c, u in zip(channels, units, strict=True)
        ]
        rows = rows[1:]
    time = _time(path, channels, rows)
    layout = Layout(
        path=path,
        names=[c.name for c in channels],
        time=time,
        ended=text.endswith("\n"),
        columns="columns",
        ragged=lambda row: _cure(row.cells, len(channels), header.separator),
        wrong=_cure_cell,
    )
    table = read_rows(rows, layout)
    columns = list(table.values.T)
    channels = [Channel(c.name, c.unit, s) for c, s in zip(channels, table.steps, strict=True)]
    if time is None:
        told, rate, note = _uniform(path, lines[: header.at], channels, columns, step)
    else:
        told, rate, note = columns[time], time, ""
    keep, notes = kept_columns(path, channels, columns, rate)
    for j in table.words:
        if j in keep and rows:
            keep.remove(j)
            example = rows[0].cells[j].strip()[:24]
            notes.append(f"column '{channels[j].name}' left out: it holds words ('{example}')")
    if table.stamps is not None and time is not None:
        note = table.stamps.note(channels[time].name)
    notes += [note] if note else []
    values = np.stack([columns[i] for i in keep], axis=1) if keep else np.empty((len(told), 0))
    return assemble(path, told, values, [channels[i] for i in keep], notes=(*table.notes, *notes))


# -- header -------------------------------------------------------------------------------------


def _find_header(lines: list[str]) -> _Header | None:
    """The line of the names: the first that names a time, else the first that is no comment."""
    seen = [(i, line) for i, line in enumerate(lines[: 5 * _HEADER_LINES]) if line.strip()]
    plain = [(i, line) for i, line in seen[:_HEADER_LINES] if not _is_comment(line)]
    for i, line in seen[:_HEADER_LINES]:
        comment = _is_comment(line)
        header = _header(i, line.lstrip(" " + "".join(_COMMENTS)) if comment else line)
        if not _names_time(header.names):
            continue
        first = plain and i == plain[0][0] and not comment
        below = next((text for j, text in plain if j > i), None)
        # A sentence may hold the word as well, but no row of as many cells stands below it.
        if first or (below and len(_cells(below, header.separator)) == len(header.names)):
            return header
    return _header(*plain[0]) if plain else None


def _header(at: int, line: str) -> _Header:
    separator = max(",;\t", key=line.count)
    if separator in line:
        return _Header(at, separator, _cells(line, separator))
    return _Header(at, _BLANKS, _NAME_AND_UNIT.findall(line))


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _names_time(names: list[str]) -> bool:
    known = (*TIME_NAMES, *_STAMP_NAMES)
    return any(split_header(name)[0].lower() in known for name in names)


def _cells(line: str, separator: str) -> list[str]:
    if separator == _BLANKS:
        return blank_cells(line)
    return next(csv.reader([line], delimiter=separator), [])


def _rows(path: Path, lines: list[str], header: _Header) -> list[Row]:
    """All rows below the header, without blank lines and comments."""
    numbered = [
        (i + 1, line)
        for i, line in enumerate(lines)
        if i > header.at and line.strip() and not _is_comment(line)
    ]
    if header.separator == _BLANKS:
        return [Row(n, blank_cells(line)) for n, line in numbered]
    # A quoted cell may go over several lines.
    reader = csv.reader((line for _, line in numbered), delimiter=header.separator)
    try:
        return [Row(numbered[reader.line_num - 1][0], cells) for cells in reader]
    except csv.Error as error:
        line = numbered[min(reader.line_num, len(numbered)) - 1][0]
        raise DfsmError(f"{path}, line {line}: {error}; it is no CSV table") from None


def _units_row(
    lines: list[str], row: Row, header: _Header, channels: list[Channel]
) -> list[str] | None:
    """Units below the names: texts in brackets, or the time's unit in its place."""
    cells = row.cells
    if header.separator == _BLANKS:
        cells = _UNITS.findall(lines[row.line - 1])
    if len(cells) != len(channels) or any(number(c) is not None and c.strip() for c in cells):
        return None
    bracketed = any(re.fullmatch(r"\s*(\(.*\)|\[.*\])\s*", c) for c in cells)
    seconds = any(
        c.name.lower() in TIME_NAMES and u.strip() and u.strip().lower() in SECONDS
        for c, u in zip(channels, cells, strict=True)
    )
    return cells if bracketed or seconds else None


def _bare(unit: str) -> str:
    return unit.strip().strip("()[]").strip()


# -- time ---------------------------------------------------------------------------------------


def _time(path: Path, channels: list[Channel], rows: list[Row]) -> int | None:
    """The column of the time or of time stamps; None where there is neither."""
    first = rows[0].cells if rows else []
    for names in (TIME_NAMES, _STAMP_NAMES):
        for i, channel in enumerate(channels):
            if channel.name.lower() in names and i < len(first) and is_stamp(first[i]):
                return i
    if any(c.name.lower() in TIME_NAMES for c in channels):
        return time_column(path, channels)
    return None


def _uniform(
    path: Path,
    above: list[str],
    channels: list[Channel],
    columns: list[Array],
    step: float | None,
) -> tuple[Array, int | None, str]:
    """Times of a record without any, the column that holds its rate, and what to tell.

    The rate is told, or stands in a column or in a comment.
    """
    at, source = None, "was told"
    for j, values in enumerate(columns) if step is None else ():
        finite = values[np.isfinite(values)]
        if len(finite) and finite.min() == finite.max():
            step = rate_step(channels[j].name, float(finite[0]))
            if step is not None:
                at, source = j, f"stands in column '{channels[j].name}'"
                break
    for line in above if step is None else ():
        for name, value in _RATE.findall(line):
            step = rate_step(name, number(value) or 0.0) if step is None else step
            source = "stands in a comment"
    if step is None:
        raise no_time(path, channels)
    note = f"there is no time column: samples every {step:g} s, which {source}"
    return uniform_times(path, len(columns[0]), step), at, note


# -- what to do ---------------------------------------------------------------------------------


def _cure(row: list[str], columns: int, separator: str) -> str:
    # A comma between digits that was meant as a decimal point makes two cells of one.
    whole = all(re.fullmatch(r"\s*[-+]?\d+\s*", cell) for cell in row)
    if separator == "," and whole and columns < len(row) <= 2 * columns:
        return "if its decimals have commas, save it with points; else correct or remove the line"
    return "correct or remove the line"


def _cure_cell(text: str) -> str:
    if re.fullmatch(r"[-+]?\d*,\d*(e[-+]?\d+)?", text, re.IGNORECASE):
        return "decimals have a comma here, save the table with points"
    return "correct it"
