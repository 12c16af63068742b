"""Tables in text: CSV, and columns separated by semicolons, tabs or blanks.

The header is the first line that names a time; lines above it may say anything, and lines that
begin with ``#``, ``%`` or ``!`` are comments (NumPy's ``savetxt`` writes the header as one). Units
stand in the header as ``PtfmPitch [deg]``, or in a row of their own below it. Without a time there
may be a column, a comment or a line above that tells the rate: ``fs = 50``, ``Ts``, ``dt [ms]``.
Numbers may have decimal commas, see `dfsm.data.readers.decimals`.
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
    ALSO_TIME,
    TIME_NAMES,
    kept_columns,
    no_time,
    rate_step,
    seconds_per,
    since_1970,
    time_column,
    uniform_times,
)
from dfsm.data.readers.decimals import with_points
from dfsm.data.readers.guard import unguarded
from dfsm.data.readers.labels import (
    count_labels,
    label_rows,
    named_channels,
    without_more_times,
)
from dfsm.data.readers.lvm import TITLE, read_lvm
from dfsm.data.readers.stamps import is_stamp
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

_COMMENTS = ("#", "%", "!")
_HEADER_LINES = 200
_BLANKS = ""  # the separator of columns that blanks separate
_STAMP_NAMES = (
    *("timestamp", "datetime", "date", "date time", "date_time", "date/time", "datum"),
    "zeitstempel",
)
_NAME_AND_UNIT = re.compile(r"\S+?[ _]?(?:\([^()]*\)|\[[^\[\]]*\])|\S+")
_RATE = re.compile(
    r"((?:[^\W\d]\w*[ _])?[^\W\d]\w*)\s*[=:,;\t]\s*([-+]?[.\d][.\deE+-]*) *([^\s,;]*)"
)
# What spreadsheets write above a table to say how its cells are separated.
_SEPARATED = re.compile(r"sep=(.)", re.IGNORECASE)


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
    if text.startswith(TITLE):
        return read_lvm(path, text)
    lines = text.split("\n")
    header = _find_header(lines)
    if header is None:
        raise DfsmError(f"{path} holds blank lines only: check that it is the right file")
    rows, commas = with_points(path, _rows(path, lines, header), header.separator)
    channels = named_channels([unguarded(cell) for cell in header.names])
    labels = rows[: count_labels(rows)]
    units, words = label_rows(labels, lines, header.at, channels, header.separator == _BLANKS)
    if units:
        channels = [Channel(c.name, c.unit or u) for c, u in zip(channels, units, strict=True)]
        rows = rows[len(labels) :]
    time = _time(path, channels, rows)
    layout = Layout(
        path=path,
        names=[c.name for c in channels],
        time=time,
        ended=text.endswith("\n"),
        columns="columns",
        ragged=lambda row: _cure(row.cells, len(channels), header.separator),
        wrong=lambda _: "correct it",
    )
    table = read_rows(rows, layout)
    columns = list(table.values.T)
    channels = [Channel(c.name, c.unit, s) for c, s in zip(channels, table.steps, strict=True)]
    if time is None:
        told, rate, note = _uniform(path, lines[: header.at], channels, columns, step)
    else:
        told, rate, note = columns[time], time, ""
        if counted := _counted(channels[time], told) if table.stamps is None else None:
            told, what = counted
            name = channels[time].name
            note = f"'{name}' counts {what} since 1970: times are seconds since the first"
        elif table.stamps is None and (scale := seconds_per(channels[time].unit)) not in (
            1.0,
            None,
        ):
            told = told * scale
            note = f"'{channels[time].name}' is in {channels[time].unit}: times are converted to s"
    keep, notes = kept_columns(path, channels, columns, rate)
    if time is not None:
        keep, notes = without_more_times(path, channels, columns, time, (keep, notes))
    for j in table.words:
        if j in keep and rows:
            keep.remove(j)
            example = rows[0].cells[j].strip()[:24]
            notes.append(f"column '{channels[j].name}' left out: it holds words ('{example}')")
    if table.stamps is not None and time is not None:
        note = table.stamps.note(channels[time].name)
    notes += [text for text in (note, commas, words) if text]
    values = np.stack([columns[i] for i in keep], axis=1) if keep else np.empty((len(told), 0))
    return assemble(path, told, values, [channels[i] for i in keep], notes=(*table.notes, *notes))


# -- header -------------------------------------------------------------------------------------


def _find_header(lines: list[str]) -> _Header | None:
    """The line of the names: the first that names a time, else the first that is no comment."""
    seen = [(i, line) for i, line in enumerate(lines[: 5 * _HEADER_LINES]) if line.strip()]
    told = _SEPARATED.fullmatch(seen[0][1].strip(' \t\r"')) if seen else None
    if told:
        seen = seen[1:]
    separators = told[1] if told else ",;\t"
    plain = [(i, line) for i, line in seen[:_HEADER_LINES] if not _is_comment(line)]
    while len(plain) > 1 and _tells_rate(plain[0][1]):
        del plain[0]
    for i, line in seen[:_HEADER_LINES]:
        comment = _is_comment(line)
        names = line.lstrip(" " + "".join(_COMMENTS)) if comment else line
        header = _header(i, names, separators)
        # "Time" beside a time of day is what is told of a measurement, no name of a column.
        if not _names_time(header.names) or any(map(is_stamp, header.names)):
            continue
        first = plain and i == plain[0][0] and not comment
        below = next((text for j, text in plain if j > i), None)
        # A sentence may hold the word as well, but no row of as many cells stands below it.
        if first or (below and len(_cells(below, header.separator)) == len(header.names)):
            return header
    return _header(*plain[0], separators) if plain else None


def _header(at: int, line: str, separators: str) -> _Header:
    separator = max(separators, key=line.count)
    if separator in line:
        return _Header(at, separator, _cells(line, separator))
    return _Header(at, _BLANKS, _NAME_AND_UNIT.findall(line))


def _tells_rate(line: str) -> bool:
    match = _RATE.fullmatch(line.strip(" ,;\t"))
    return match is not None and _rate_of(match) is not None


def _rate_of(match: re.Match[str]) -> float | None:
    """Interval in s that ``fs = 50 Hz`` and the like tell; None for other words and numbers."""
    words, value = match[1].split(" "), number(match[2]) or 0.0
    return rate_step(match[1], value, match[3]) or rate_step(words[-1], value, match[3])


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _names_time(names: list[str]) -> bool:
    known = (*TIME_NAMES, *ALSO_TIME, *_STAMP_NAMES)
    return any(c.name.lower() in known for c in named_channels(names))


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


# -- time ---------------------------------------------------------------------------------------


def _time(path: Path, channels: list[Channel], rows: list[Row]) -> int | None:
    """The column of the time or of time stamps; None where there is neither."""
    first = rows[0].cells if rows else []
    for names in (TIME_NAMES, ALSO_TIME, _STAMP_NAMES):
        for i, channel in enumerate(channels):
            if channel.name.lower() in names and i < len(first) and is_stamp(first[i]):
                return i
    if any(c.name.lower() in (*TIME_NAMES, *ALSO_TIME) for c in channels):
        return time_column(path, channels, converts=True)
    for i, channel in enumerate(channels):
        if channel.name.lower() in _STAMP_NAMES and i < len(first):
            counts = np.array([np.nan if (value := number(first[i])) is None else value])
            if since_1970(counts, seconds=True):
                return i
    return None


def _counted(channel: Channel, time: Array) -> tuple[Array, str] | None:
    """Times that count from 1970 in a column whose unit nobody states."""
    return None if channel.unit else since_1970(time, seconds=channel.name.lower() in _STAMP_NAMES)


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
            step = rate_step(channels[j].name, float(finite[0]), channels[j].unit)
            if step is not None:
                at, source = j, f"stands in column '{channels[j].name}'"
                break
    for line in above if step is None else ():
        for match in _RATE.finditer(line):
            step = _rate_of(match) if step is None else step
            source = "stands in a comment" if _is_comment(line) else "stands above the table"
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
